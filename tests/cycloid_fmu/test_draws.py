"""FMUs of drives drawn from an identification: one for each, together they have the fit's covariance."""

import numpy as np
import pytest
from common import ARCSEC, EXAMPLES

import cycloid_fmu as cy
import fitting
from cycloid_fmu.surfaces.structured import structured_value, with_structured

NAMES = ("eccentricity", "pin_radial_2_cos", "profile_deviation_1", "pin_radial_at_3", "tooth_cumulative_pitch_at_5")
SPREAD = np.array([1e-6, 0.6e-6, 0.5e-6, 0.8e-6, 0.7e-6])  # m
TORQUE, ANGLES = 60.0, [0.7, 0.8]  # N·m, rad


@pytest.fixture(scope="module")
def identified():
    """The drive as made with the covariance of a fit, two of whose errors go together."""
    drive = cy.read_drive(EXAMPLES / "drive-39-40-as-made.toml")
    covariance = np.diag(SPREAD**2)
    covariance[0, 1] = covariance[1, 0] = -0.7 * SPREAD[0] * SPREAD[1]
    return cy.Drive(drive.pair, drive.surface.replace(covariance=covariance, covariance_of=NAMES))


def error_of(drive):
    return drive.analyze(TORQUE, crank_angle=ANGLES).transmission_error.values[0]


@pytest.mark.slow(1)
def test_each_fmu_is_its_drive_and_together_they_are_numbered(identified, tmp_path):
    drawn = fitting.ensemble(identified, 2, seed=4)
    paths = cy.build_fmus(drawn, tmp_path / "drive.fmu")
    assert [path.name for path in paths] == ["drive-0000.fmu", "drive-0001.fmu"]
    for path, drive in zip(paths, drawn, strict=True):
        found = cy.simulate_fmu(path, crank_angle=ANGLES, torque=TORQUE)["transmission_error"]
        assert found == pytest.approx(error_of(drive), abs=1e-6 * ARCSEC)


@pytest.mark.slow(3)
def test_draws_spread_as_the_covariance_says_to_first_order(identified):
    pair, surface = identified.pair, identified.surface
    radial, pitch = np.zeros(40), np.zeros((1, 39))
    radial[3], pitch[0, 5] = 1e-8, 1e-8
    moved = [with_structured(surface, {n: structured_value(surface, n) + 1e-8}) for n in NAMES[:3]]
    moved += [surface.replace(pin_radial=surface.pin_radial + radial)]
    moved += [surface.replace(tooth_cumulative_pitch=surface.tooth_cumulative_pitch + pitch)]
    slopes = np.array([(error_of(cy.Drive(pair, one)) - error_of(identified))[0] for one in moved]) / 1e-8
    expected = np.sqrt(slopes @ surface.covariance @ slopes)
    spread = np.std([error_of(one)[0] for one in fitting.ensemble(identified, 80, seed=4)], ddof=1)
    assert expected > 0.3 * ARCSEC
    assert spread == pytest.approx(expected, rel=0.25)  # 80 draws know it within 8 %


@pytest.mark.slow(2)
def test_the_command_draws_as_python_does(command, identified, tmp_path):
    identified.write(tmp_path / "identified.nc")
    cy.build_fmus(fitting.ensemble(identified, 2), tmp_path / "python.fmu")
    given = ("cycloid-fmu", "build", EXAMPLES / "drive-39-40.toml", "--surface", "identified.nc", "-o", "drive.fmu")
    run = command(*given, "--draws", "2")
    assert run.returncode == 0, run.stderr
    names = sorted(path.name for path in tmp_path.glob("drive*.fmu"))
    assert names == ["drive-0000.fmu", "drive-0001.fmu", "drive.fmu"]
    for number in ("0000", "0001"):
        theirs, ours = (tmp_path / f"{stem}-{number}.fmu" for stem in ("python", "drive"))
        assert ours.read_bytes() == theirs.read_bytes()
    for more, said in (
        (("--draws", "2", "--age", "5 h"), "--draws, --age and --crank-turns each choose the drives"),
        (("--wear-factor", "1.1"), "--wear-factor is only for --age"),
        (("--age", "5 h"), "needs a drive with a forecast"),
    ):
        run = command(*given, *more)
        assert run.returncode == 2
        assert said in run.stderr


def test_without_a_covariance_it_is_refused(command, tmp_path):
    run = command("cycloid-fmu", "build", EXAMPLES / "drive-39-40.toml", "--draws", "3", "-o", "none.fmu")
    assert run.returncode == 2
    assert "has no covariance of a fit; give a surface written by identify" in run.stderr
    assert not (tmp_path / "none.fmu").exists()
