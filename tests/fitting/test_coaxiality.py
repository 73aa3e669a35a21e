"""The coaxiality error of a single read head: the paper's shaft, and a recording freed of it."""

import numpy as np
import pytest
from common import EXAMPLES

from cycloid_fmu import edge
from fitting.readers.read_head import (
    Displacement,
    ReadHead,
    angle_error,
    fit_displacement,
    read_read_head,
    without_coaxiality_error,
)
from fitting.readers.recording import Recording

HEAD = read_read_head(EXAMPLES / "rv-20e-read-head.toml")


def recording(torque, angle):
    time = np.arange(torque.size) * 0.01
    return Recording(
        time=time,
        input_angle=0.0 * time,
        output_angle=angle,
        torque=torque,
        status=np.zeros(time.size, np.uint8),
        common_zero=True,
        known_index=True,
        ratio=None,
        source="r.csv",
        checksum="",
    )


def test_the_paper_s_output_shaft():
    """Y ≈ 2.140e-5 mm/(N·m) T - 1.7e-5 mm (docs/theory/papers.md)."""
    assert HEAD.displacement.slope == pytest.approx(2.140e-8, rel=1e-3)
    assert HEAD.displacement.offset == pytest.approx(-1.7e-8, rel=0.02)


def test_a_displaced_disc_seen_by_its_lines():
    """A point of the disc under the head, followed in the plane: its motion along the head over the radius."""
    radius, moved = 0.05, 4e-6
    for direction in np.radians([0.0, 30.0, 90.0, 200.0]):
        line = Displacement(moved / 200.0, 0.0, np.zeros((2, 2)), 0.0, 0.0, 200.0)
        shift = moved * np.array([np.cos(direction), np.sin(direction)])
        under_head = np.array([radius, 0.0]) + shift  # the head is on +x
        error, _ = angle_error(ReadHead(radius, 0.0, direction, line), 200.0)
        assert error == pytest.approx(np.arctan2(under_head[1], under_head[0]), abs=moved**2 / radius**2)


def test_correction_brings_back_the_angle():
    torque = np.linspace(10.0, 200.0, 50)
    true = 1e-6 * torque
    read = true + angle_error(HEAD, torque)[0]
    assert np.ptp(read - true) * 648000 / np.pi > 10.0  # arcsec: it matters
    freed = without_coaxiality_error(recording(torque, read), HEAD)
    assert freed.output_angle == pytest.approx(true, abs=1e-15)
    assert len(freed.notes) == 1
    assert "standard uncertainty" in freed.notes[0]
    assert len(without_coaxiality_error(recording(2.0 * torque, read), HEAD).notes) == 2  # beyond the known range


def test_uncertainty_is_that_of_repeated_calibrations():
    """Monte Carlo of the whole chain: calibration with scatter, a radius with its own, one bench position."""
    generator = np.random.default_rng(3)
    torque = np.linspace(10.0, 200.0, 12)
    scatter, radius, spread = 2e-8, 0.05, 5e-5
    true = 2e-8 * torque
    errors, claimed = [], []
    for _ in range(2000):
        line = fit_displacement(torque, true + generator.normal(0.0, scatter, torque.size))
        head = ReadHead(radius + generator.normal(0.0, spread), spread, np.pi / 2, line)
        error, uncertainty = angle_error(head, 150.0)
        errors.append(error - (2e-8 * 150.0 + generator.normal(0.0, scatter)) / radius)
        claimed.append(uncertainty**2)
    assert np.std(errors) == pytest.approx(np.sqrt(np.mean(claimed)), rel=0.05)


@pytest.mark.parametrize(
    ("old", "new", "table", "said"),
    [
        ('"50 mm"', '"-50 mm"', None, "h.toml: [read_head] radius"),
        ('"rv-20e-tilt.csv"', '"none.csv"', None, "none.csv: No such file"),
        ('"90 deg"', "90", None, "h.toml: [read_head] direction = 90"),
        ("", "", "torque,displacement [mm]\n1,2\n", "has no unit"),
        ("", "", "torque [N*m],displacement [mm]\n1,2\n1,3\n1,4\n", "two torques"),
        ("", "", "torque [N*m],displacement [mm]\n1,2\n2,x\n3,4\n", 'rv-20e-tilt.csv: line 3: displacement = "x"'),
    ],
)
def test_bad_heads_are_one_sentence(tmp_path, old, new, table, said):
    (tmp_path / "h.toml").write_text((EXAMPLES / "rv-20e-read-head.toml").read_text().replace(old, new))
    (tmp_path / "rv-20e-tilt.csv").write_text(table or (EXAMPLES / "rv-20e-tilt.csv").read_text())
    with pytest.raises(edge.InputError, match=r".") as caught:
        read_read_head(tmp_path / "h.toml")
    assert said in str(caught.value)
    assert str(caught.value).count("\n") == 0


def test_curve_without_the_head_s_error(command, tmp_path, measured_csv):
    """The same bench with and without the error: corrected curves agree, the others are apart by it."""
    import json

    for name in ("rv-20e-read-head.toml", "rv-20e-tilt.csv"):
        (tmp_path / name).write_text((EXAMPLES / name).read_text())
    pair, plain, torque = measured_csv(lambda t: 0.0)
    measured_csv(lambda t: float(angle_error(HEAD, t)[0]), "wrong.csv")
    words = ("cycloid-fit", "curve", "wrong.csv", "--pair", pair, "--json")
    corrected = command(*words, "--read-head", "rv-20e-read-head.toml")
    assert corrected.returncode == 0, corrected.stderr
    assert any("standard uncertainty" in note for note in json.loads(corrected.stdout)["notes"])
    found = {
        n: np.array(json.loads(text)["transmission_error"][0])
        for n, text in (
            ("corrected", corrected.stdout),
            ("as read", command(*words).stdout),
            ("true", command("cycloid-fit", "curve", plain, "--pair", pair, "--json").stdout),
        )
    }
    assert found["corrected"] == pytest.approx(found["true"], abs=1e-9)
    assert (found["as read"] - found["true"]) == pytest.approx(float(angle_error(HEAD, torque)[0]), abs=1e-9)


@pytest.fixture
def measured_csv(tmp_path):
    """Write the recording of an error-free drive at 100 N·m whose output angle is off by a function of the torque."""
    (tmp_path / "pair.toml").write_text((EXAMPLES / "drive-39-40.toml").read_text())

    def write(error, name="plain.csv"):
        angle = np.linspace(0.0, 2 * np.pi, 100)
        rows = np.column_stack(
            [angle, np.degrees(angle), np.degrees(-angle / 39 + 1e-4 + error(100.0)), 0 * angle + 100.0]
        )
        header = "time [s],input_angle [deg],output_angle [deg],torque [N*m]"
        np.savetxt(tmp_path / name, rows, delimiter=",", header=header, comments="", fmt="%.15g")
        return "pair.toml", name, 100.0

    return write
