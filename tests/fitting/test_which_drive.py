"""Of which drive a recording, an identification and its surface are."""

import json

import numpy as np
import pytest

import cycloid_fmu as cy
import drivers
import fitting
from fitting.model.loops import observed_curves

PAIR = cy.Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
DRIVE = cy.Drive(PAIR).replace(errors={"eccentricity": "1 um"})
OTHER = cy.Drive(PAIR).replace(face_width=0.011)


@pytest.fixture
def recorded(tmp_path):
    """A recording of a bench that states its pair in these words."""

    def run(pair):
        path = tmp_path / "run.arrows"
        with drivers.simulate_bench(
            ratio=PAIR.ratio, pair=pair, torque=20.0, turns=9, motion=drivers.SimulatedMotion(24), bus="virtual"
        ) as bench:
            bench.record(path)
        return fitting.read_recordings(path)

    return run


@pytest.mark.parametrize("stated", [DRIVE.hash, PAIR.hash, cy.Drive(PAIR).hash, "", "drive 7, second try", "9/10"])
def test_a_recording_of_this_drive_or_of_its_nominal_pair_is_taken(recorded, stated):
    (recording,) = recorded(stated)
    assert recording.open().read().pair == (stated or "ideal")
    assert len(observed_curves(recording, DRIVE)) == 1


@pytest.mark.parametrize("stated", [OTHER.hash, OTHER.pair.hash])
def test_a_recording_of_another_drive_is_refused(recorded, stated):
    with pytest.raises(cy.InputError) as problem:
        fitting.identify(recorded(stated), DRIVE)
    (sentence,) = str(problem.value).splitlines()
    assert all(one in sentence for one in ("run.arrows", stated, DRIVE.hash, PAIR.hash))


@pytest.fixture(scope="module")
def result():
    """The identification with a drive whose surface has a form unknown to the fit."""
    made, angle = DRIVE.replace(errors={"eccentricity": "3 um"}), np.linspace(0.0, 2.0 * np.pi * 9, 120)
    generator = np.random.default_rng(0)

    def run(load):
        error = made.analyze(load, crank_angle=angle).transmission_error.values[0]
        output = angle / PAIR.ratio + error + generator.normal(0.0, 1e-6, angle.size)
        return fitting.Run(angle, output, load, common_zero=True, known_index=True)

    form = DRIVE.replace(surface=DRIVE.surface.replace(gear_deviation=np.zeros((1, 9, 4, 1))))
    return fitting.identify([run(load) for load in (20.0, -20.0, 100.0, -100.0)], form, held_out=False)


def test_its_file_states_the_drive_that_was_identified(result, tmp_path):
    result.write(tmp_path / "found.json")
    result.drive.write(tmp_path / "found.nc")
    stated = json.loads((tmp_path / "found.json").read_text())
    (tmp_path / "nominal.toml").write_text(stated["pair"])
    nominal = cy.read_drive(tmp_path / "nominal.toml")
    assert nominal == cy.Drive(PAIR)
    assert cy.read_drive(tmp_path / "nominal.toml", tmp_path / "found.nc").hash == stated["drive"]
    assert stated["drive"] not in (DRIVE.hash, nominal.hash)


def test_form_that_the_fit_ignores_is_noted(result):
    (note,) = (note for note in result.notes if "form of single elements" in note)
    assert "gear_deviation" in note
    assert "not part of the fit" in note
