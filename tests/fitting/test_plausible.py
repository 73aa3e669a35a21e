"""Implausible samples are left out of every figure and counted, for recordings of any recorder."""

import json

import numpy as np
import pytest
from common import BENCH

import fitting
from drivers.recording_format import GAP, IMPLAUSIBLE, Channel, Header, RecordingWriter, Samples
from fitting.figures.metrics import figures_json
from fitting.samples.plausible import PlausibleBlocks
from fitting.transmission_error.curve import curves_json

ANGLE = np.linspace(0.0, 2.0 * np.pi * 80, 8000)
OUTPUT = -ANGLE / 39 + 1e-4 * np.sin(ANGLE)
TIME = np.arange(ANGLE.size) / 1000


def run(angle=ANGLE, output=OUTPUT, name="run"):
    return fitting.Run(input_angle=angle, output_angle=output, torque=20.0, time=TIME, name=name)


def stuck(at=3000, samples=1000):
    output = OUTPUT.copy()
    output[at : at + samples] = output[at]
    return run(output=output)


def test_a_stuck_encoder_moves_no_curve_and_is_said():
    (clean,) = fitting.curves(run(), -39.0)
    (curve,) = fitting.curves(stuck(), -39.0)
    assert clean.implausible == 0
    assert curve.implausible == 999
    assert np.ptp(curve.transmission_error) == pytest.approx(np.ptp(clean.transmission_error), rel=1e-3)
    (note,) = [n for n in curve.notes if "implausible" in n]
    assert note.startswith("run: 999 of 8000 samples are implausible and were left out: output_angle is constant at ")
    assert note.endswith("(from 3.001 s).")
    data = curves_json([curve])
    assert data["implausible"].tolist() == [999]
    assert note in data["notes"]


def test_figures_count_what_they_left_out():
    found = fitting.metrics([run(), stuck()], ratio=-39.0)
    data = json.loads(json.dumps(figures_json(found), default=float))
    assert data["implausible"]["run"] == 999
    assert any("implausible" in n for n in data["notes"])
    assert data["angular_transmission_error"]["value"] == pytest.approx(2e-4, rel=0.05)


def test_an_input_that_jumped_is_left_out_from_there_on():
    angle = ANGLE.copy()
    angle[5000:] += np.pi
    (curve,) = fitting.curves(run(angle=angle), -39.0)
    assert curve.implausible == 3000
    assert np.ptp(curve.transmission_error) == pytest.approx(2e-4, rel=0.05)


def write(path, bits=None, output=OUTPUT, **conditions):
    roles = ("input_angle", "output_angle", "torque")
    units = {"torque": "N*m"}
    channels = tuple(Channel(n, n, "test", units.get(n, "rad"), None, 1, 0.0, "absolute", "", "host") for n in roles)
    with RecordingWriter(path, Header(channels, conditions, -39.0, "", "2025-01-01T00:00:00Z")) as writer:
        values = {"input_angle": ANGLE, "output_angle": output, "torque": np.full(ANGLE.size, 20.0)}
        for role in roles:
            for part in np.array_split(np.arange(ANGLE.size), 20):
                status = None if bits is None or role != "output_angle" else bits[part]
                writer.write(Samples.checked(role, TIME[part], values[role][part], status=status))
    return path


def test_what_the_recorder_marked_is_left_out_and_what_follows_is_behind_a_gap(tmp_path):
    bits = np.zeros(ANGLE.size, np.uint8)
    bits[2000:2010] = IMPLAUSIBLE
    path = write(tmp_path / "run.arrows", bits=bits)
    (source,) = fitting.read_recordings(path)
    blocks = PlausibleBlocks(source.open(), -39.0)
    kept = list(blocks)
    status = np.concatenate([b.status for b in kept])
    assert (blocks.count, blocks.samples, status.size) == (10, 8000, 7990)
    assert np.flatnonzero(status & GAP).tolist() == [2000]
    assert "10 were marked in the file" in blocks.notes()[0]
    assert fitting.curves(source, -39.0)[0].implausible == 10


def test_the_recordings_own_limits_are_used(tmp_path):
    """A bench file that lets the angles be half a turn apart has no stuck encoder in a quarter turn."""
    output = OUTPUT.copy()
    output[3000:3500] = output[3000]
    for stated, left_out in (({}, 499), ({"largest_deviation": np.pi}, 0)):
        path = write(tmp_path / f"{left_out}.arrows", output=output, **stated)
        assert fitting.metrics(fitting.read_recordings(path)).surveyed[0].implausible == left_out


@pytest.mark.parametrize("path", sorted(BENCH.glob("*.csv")), ids=lambda path: path.stem)
def test_nothing_of_the_reference_bench_is_implausible(path):
    (source,) = fitting.read_recordings(path)
    blocks = PlausibleBlocks(source.open(), -39.0)
    assert sum(b.time.size for b in blocks) == blocks.samples > 1000
    assert blocks.notes() == []


def test_an_identification_says_how_many_samples_it_left_out():
    import cycloid_fmu as cy

    pair = cy.Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
    drive = cy.Drive(pair)
    made, angle = drive.replace(errors={"eccentricity": "3 um"}), np.linspace(0.0, 2.0 * np.pi * 9, 240)
    noise = np.random.default_rng(0)

    def recorded(load, name):
        error = made.analyze(load, crank_angle=angle).transmission_error.values[0]
        output = angle / -9 + error + noise.normal(0.0, 1e-6, angle.size)
        return fitting.Run(
            input_angle=angle, output_angle=output, torque=load, name=name, common_zero=True, known_index=True
        )

    runs = [recorded(load, f"{load:g}") for load in (20.0, -20.0, 100.0, -100.0)]
    runs[0].output_angle[100:110] += 1.0
    result = fitting.identify(runs, drive, held_out=False)
    assert result.implausible == {"20": 10, "-20": 0, "100": 0, "-100": 0}
    assert sum("implausible" in n for n in result.notes) == 1
    assert round(next(p for p in result.parameters if p.name == "eccentricity").value * 1e6) == 3
