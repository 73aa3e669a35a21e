"""Draws of an identification in an FMU: each is its drive, together they have the fit's covariance."""

import fmpy
import numpy as np
import pytest
from common import ARCSEC, EXAMPLES

import cycloid_fmu as cy
import fitting
from cycloid_fmu.fmu.core import Core, model_of
from cycloid_fmu.surfaces.posterior import displacements_of, drawn_surfaces
from cycloid_fmu.surfaces.structured import structured_value, with_structured

NAMES = ("eccentricity", "pin_radial_2_cos", "profile_deviation_1", "pin_radial_at_3", "tooth_cumulative_pitch_at_5")
SPREAD = np.array([1e-6, 0.6e-6, 0.5e-6, 0.8e-6, 0.7e-6])  # m
TORQUE, ANGLE = 60.0, 0.7  # N·m, rad


@pytest.fixture(scope="module")
def identified():
    """The drive as made with the covariance of a fit, two of whose errors go together."""
    drive = cy.read_drive(EXAMPLES / "drive-39-40-as-made.toml")
    covariance = np.diag(SPREAD**2)
    covariance[0, 1] = covariance[1, 0] = -0.7 * SPREAD[0] * SPREAD[1]
    return cy.Drive(drive.pair, drive.surface.replace(covariance=covariance, covariance_of=NAMES))


@pytest.fixture(scope="module")
def built(identified, tmp_path_factory):
    path = tmp_path_factory.mktemp("draws") / "drive.fmu"
    identified.build_fmu(path, draws=150, seed=4)
    return path


@pytest.fixture(scope="module")
def of_draw(built, tmp_path_factory):
    """Transmission error (rad) of a draw under `TORQUE` at `ANGLE`, from the FMU in fmpy."""
    folder = fmpy.extract(str(built), unzipdir=str(tmp_path_factory.mktemp("unpacked")))
    description = fmpy.read_model_description(str(built))
    references = {v.name: v.valueReference for v in description.modelVariables}

    def one(number, **errors):
        fmu = fmpy.fmi2.FMU2Slave(
            guid=description.guid,
            unzipDirectory=folder,
            instanceName="drive",
            modelIdentifier=description.coSimulation.modelIdentifier,
        )
        fmu.instantiate()
        fmu.setupExperiment()
        fmu.setInteger([references["draw"]], [number])
        values = {"flange_a.phi": ANGLE, "flange_b.tau": TORQUE, **errors}
        fmu.setReal([references[name] for name in values], list(values.values()))
        fmu.enterInitializationMode()
        fmu.exitInitializationMode()
        (found,) = fmu.getReal([references["transmission_error"]])
        fmu.terminate()
        fmu.freeInstance()
        return found

    return one


def error_of(drive):
    return drive.analyze(TORQUE, crank_angle=[ANGLE]).transmission_error.item()


@pytest.mark.slow(7)
def test_each_draw_is_the_drive_that_the_ensemble_draws(identified, of_draw):
    drawn = fitting.ensemble(identified, 150, seed=4)
    assert of_draw(0) == pytest.approx(error_of(identified), abs=1e-6 * ARCSEC)
    for number in (1, 7, 150):
        assert of_draw(number) == pytest.approx(error_of(drawn[number - 1]), abs=1e-6 * ARCSEC)


def test_what_a_draw_adds_comes_upon_an_error_that_is_set(identified, of_draw):
    """Hosts set every parameter to its start: no draw may be lost by it."""
    start = identified.surface.eccentricity
    assert of_draw(7, eccentricity=start) == of_draw(7)
    moved = fitting.ensemble(identified, 7, seed=4)[6].surface
    moved = cy.Drive(identified.pair, moved.replace(eccentricity=moved.eccentricity + 2e-6))
    assert of_draw(7, eccentricity=start + 2e-6) == pytest.approx(error_of(moved), abs=1e-6 * ARCSEC)


@pytest.mark.slow(3)
def test_draws_spread_as_the_covariance_says_to_first_order(identified, of_draw):
    pair, surface = identified.pair, identified.surface
    radial, pitch = np.zeros(40), np.zeros((1, 39))
    radial[3], pitch[0, 5] = 1e-8, 1e-8
    moved = [with_structured(pair, surface, {n: structured_value(pair, surface, n) + 1e-8}) for n in NAMES[:3]]
    moved += [surface.replace(pin_radial=surface.pin_radial + radial)]
    moved += [surface.replace(tooth_cumulative_pitch=surface.tooth_cumulative_pitch + pitch)]
    slopes = np.array([error_of(cy.Drive(pair, one)) - error_of(identified) for one in moved]) / 1e-8
    expected = np.sqrt(slopes @ surface.covariance @ slopes)
    spread = np.std([of_draw(number) for number in range(1, 81)], ddof=1)
    assert expected > 0.3 * ARCSEC
    assert spread == pytest.approx(expected, rel=0.25)  # 80 draws know it within 8 %


def test_a_draw_there_is_none_of_is_refused_and_a_state_keeps_its_draw(built, of_draw, tmp_path):
    fmpy.extract(str(built), unzipdir=str(tmp_path))
    core, other = (Core(tmp_path / "resources", "2.0") for _ in range(2))
    (variable,) = (v for v in core.table.values() if v.name == "draw")
    assert (variable.kind, variable.variability, variable.least, variable.most) == ("integer", "fixed", 0.0, 150.0)
    reference = next(i for i, v in core.table.items() if v.name == "draw")
    for value in (-1, 151):
        assert core.put(reference, value, "integer") == f"draw = {value}: it must be finite and lie between 0 and 150"
    core.put(reference, 7, "integer")
    core.model.crank_angle, core.model.torque = ANGLE, TORQUE
    core.begin()
    core.start()
    with pytest.raises(ValueError, match="draw can't be set after initialization"):
        core.put(reference, 0, "integer")
    other.restore(core.state())
    other.step(0.0, 1e-3)
    assert other.values([reference], "integer") == [7]
    assert other.model.transmission_error == pytest.approx(of_draw(7), abs=1e-6 * ARCSEC)


def test_the_seed_decides_the_draws(identified, built, tmp_path):
    for name, seed in (("same", 4), ("other", 5)):
        identified.build_fmu(tmp_path / f"{name}.fmu", draws=150, seed=seed)
    assert (tmp_path / "same.fmu").read_bytes() == built.read_bytes()
    assert (tmp_path / "other.fmu").read_bytes() != built.read_bytes()


def test_between_two_flanges_a_draw_is_its_drive(identified):
    """Inertias inside start at rest on the drawn drive."""
    drawn = drawn_surfaces(identified.pair, identified.surface, 3, 4)
    interface = cy.Interface("compliant", output_inertia=2.0, crank_inertia=1e-3)
    found = []
    for surface, draw in ((identified.surface, 2), (drawn[1], 0)):
        model = model_of(identified.pair, surface, interface)
        model.draws = displacements_of(identified.surface, drawn)
        model.draw, model.torque = draw, TORQUE
        model.advance(1e-3)
        model.advance(1e-3)
        found.append((model.output_angle, model.crank_angle, model.elastic_energy))
    assert found[0] == pytest.approx(found[1], rel=1e-9)


def test_without_a_covariance_and_beyond_the_most_it_is_refused(command, tmp_path):
    drive = cy.read_drive(EXAMPLES / "drive-39-40.toml")
    with pytest.raises(cy.InputError, match=r"draws = 3: the drive's errors have no covariance to draw from"):
        drive.build_fmu(tmp_path / "none.fmu", draws=3)
    with pytest.raises(cy.InputError, match=r"draws = 10001: it must be between 0 and 10000"):
        drive.build_fmu(tmp_path / "none.fmu", draws=10001, native=True)
    run = command("cycloid-fmu", "build", EXAMPLES / "drive-39-40.toml", "--draws", "3", "-o", "none.fmu")
    assert run.returncode == 2
    assert (
        "--draws = 3: the drive's errors have no covariance to draw from; give a surface written by identify"
        in run.stderr
    )
    assert not (tmp_path / "none.fmu").exists()


def test_the_command_draws_as_python_does(command, identified, tmp_path):
    identified.write(tmp_path / "identified.nc")
    identified.build_fmu(tmp_path / "python.fmu", draws=150)
    run = command(
        "cycloid-fmu",
        "build",
        EXAMPLES / "drive-39-40.toml",
        "--surface",
        "identified.nc",
        "--draws",
        "150",
        "-o",
        "drive.fmu",
    )
    assert run.returncode == 0, run.stderr
    found = []
    for number, path in enumerate((tmp_path / "drive.fmu", tmp_path / "python.fmu")):
        fmpy.extract(str(path), unzipdir=str(tmp_path / str(number)))
        found.append(Core(tmp_path / str(number) / "resources", "2.0").model.draws)
    assert found[0].keys() == found[1].keys()
    assert all((found[0][name] == found[1][name]).all() for name in found[0])
