"""The names of `fitting` in a notebook: loaded on first use, and the whole path from arrays to errors."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from common import BENCH, EXAMPLES

import fitting
from cycloid_fmu import edge
from cycloid_fmu.drive import read_drive


@pytest.mark.system
def test_importing_costs_next_to_nothing_and_every_name_is_there():
    code = "import sys, time; t = time.process_time(); import fitting; assert 'numpy' not in sys.modules; "
    run = subprocess.run(
        [sys.executable, "-c", code + "print(time.process_time() - t)"], capture_output=True, text=True, check=True
    )
    assert float(run.stdout) < 0.1
    assert 10 <= len(fitting.__all__) <= 24
    assert set(fitting.__all__) <= set(dir(fitting))
    assert all(getattr(fitting, name).__doc__ for name in fitting.__all__)
    with pytest.raises(AttributeError, match="no attribute 'identity'"):
        fitting.identity  # noqa: B018


def test_files_by_pattern_are_sorted_into_curves_and_named_where_they_are_bad(tmp_path):
    drive = read_drive(BENCH / "pair.toml")
    recordings = fitting.read_recordings(str(BENCH / "*-forward.csv"))
    assert [one.path.name for one in recordings] == ["100Nm-forward.csv", "250Nm-forward.csv", "30Nm-forward.csv"]
    (tmp_path / "bad.csv").write_text("a,b\n1,2\n")
    both = [*recordings[:1], *fitting.read_recordings([tmp_path / "bad.csv"])]
    found = fitting.metrics(both, drive)
    assert len(found.problems) == 1
    assert found.problems[0].startswith(str(tmp_path / "bad.csv"))
    assert found.problems[0] in found.notes
    assert "angular_transmission_error" in found.figures
    with pytest.raises(edge.InputError, match=r"bad\.csv"):
        fitting.identify(both, drive)
    with pytest.raises(edge.InputError, match="matches this pattern"):
        fitting.read_recordings(str(tmp_path / "*.parquet"))


def test_arrays_give_the_same_curve_as_the_file_they_are_in():
    drive = read_drive(BENCH / "pair.toml")
    (recording,) = fitting.read_recordings(BENCH / "30Nm-forward.csv")
    whole = recording.open().read()
    run = fitting.Run(
        input_angle=np.mod(whole.input_angle, 2 * np.pi),
        output_angle=whole.output_angle,
        torque=whole.torque,
        time=whole.time,
    )
    (from_file,), (from_arrays,) = fitting.curves(recording, drive), fitting.curves([run], drive.pair.ratio)
    assert from_arrays.transmission_error == pytest.approx(from_file.transmission_error, abs=1e-12)


@pytest.mark.parametrize(
    ("arguments", "problem"),
    [
        ({"ratio": 0.0}, "ratio = 0.0: give the signed ratio"),
        ({"rated_torque": "167"}, 'rated_torque = "167": write one number'),
        ({"rated_torque": -1.0}, "rated_torque = -1.0: it must be above zero"),
    ],
)
def test_errors_name_the_argument(arguments, problem):
    run = fitting.Run(input_angle=0.0, output_angle=np.zeros(9), torque=0.0)
    with pytest.raises(edge.InputError, match=problem):
        fitting.metrics(run, **{"ratio": -39.0, **arguments})
    with pytest.raises(edge.InputError, match="torque has the shape"):
        fitting.Run(input_angle=0.0, output_angle=np.zeros(9), torque=np.zeros(8)).open()


@pytest.mark.parametrize("recordings", ["run.csv", ["run.csv", "other.csv"], Path("run.csv")])
def test_a_path_is_to_be_read_first(recordings):
    drive = read_drive(BENCH / "pair.toml")
    for takes in (fitting.curves, fitting.identify, fitting.maps, fitting.metrics):
        with pytest.raises(
            edge.ArgumentError, match=r"recordings = .*read it first: fitting.read_recordings\('run.csv'\)"
        ):
            takes(recordings, drive)


def test_simulated_runs_without_noise_are_refused_in_a_sentence():
    drive = read_drive(EXAMPLES / "drive-39-40.toml").replace(gear_teeth=9, pins=10, eccentricity=0.003)
    angle = np.linspace(0.0, 2 * np.pi * 9, 120)
    error = drive.replace(errors={"eccentricity": "3 um"}).analyze([20.0, -20.0, 100.0, -100.0], crank_angle=angle)
    generator = np.random.default_rng(0)

    def runs(noise):
        return [
            fitting.Run(
                input_angle=angle,
                output_angle=curve - angle / 9 + noise * generator.normal(size=angle.size),
                torque=load,
                common_zero=True,
                known_index=True,
            )
            for load, curve in zip(error.torque.values, error.transmission_error.values, strict=True)
        ]

    with pytest.raises(edge.InputError, match="curves without noise"):
        fitting.identify(runs(0.0), drive, held_out=False)
    prior = fitting.identify(runs(1e-6), drive, held_out=False)
    with pytest.raises(edge.InputError, match="curves without noise"):
        fitting.identify(runs(0.0), drive, prior=prior)
