"""The balance of elastic bodies by a slow reference: against rigid analyses, and against an independent solver."""

import functools
import json

import elastic_equilibrium
import numpy as np
import platformdirs
import pytest
from test_bodies import CASES

import cycloid_fmu as cy
from cycloid_fmu.bodies.matrices import BodyMatrices, matrices_of
from cycloid_fmu.geometry.bodies import Bodies
from cycloid_fmu.geometry.pair import parse_pair

HALF_SHELL = {"rv-all-bodies": 2e-6}  # diametral clearance of its seats, m
SLOW = [
    pytest.param("rollers-one-disc", marks=pytest.mark.slow(5)),
    pytest.param("rv-all-bodies", marks=pytest.mark.slow(20)),
    pytest.param("rv-fan-windows", marks=pytest.mark.slow(20)),
]


@functools.cache
def case(name):
    """A case's expected results, and its pair."""
    expected = json.loads((CASES / f"{name}.json").read_text())
    return expected, parse_pair((CASES / f"{name}.toml").read_text(), name).replace(bodies=None)


def rigid(name):
    """Without bodies: the part of the law beyond the patch is the contact's again."""
    expected, pair = case(name)
    return expected, pair, BodyMatrices()


@pytest.mark.parametrize("name", ["rollers-one-disc", "rv-fan-windows"])
def test_rigid_bodies_are_the_drive_on_its_bearings(name):
    """C = 0 with the ordinary law: `analyze`, another code. 48 sectors of a rigid bore are its continuum of rollers."""
    expected, pair, matrices = rigid(name)
    torque = expected["results"][0]["torque"]
    angles = expected["crank_angle"][3:5]
    analysis = cy.Drive(pair).analyze(torque, crank_angle=angles)
    for number, angle in enumerate(angles):
        solution = elastic_equilibrium.Drive(pair, matrices, angle).solution(torque)
        assert solution.x == pytest.approx(float(analysis.transmission_error[0, number]), abs=2e-3 / cy.ARCSEC)
        forces = analysis.pin_force[0, number].values
        assert np.abs(solution.pin_force - forces).max() < 2e-3 * forces.max()
        assert solution.stiffness == pytest.approx(float(analysis.torsional_stiffness[0, number]), rel=2e-3)


@pytest.mark.parametrize("name", SLOW)
def test_elastic_bodies_move_the_load_as_an_independent_solver_finds(name, tmp_path, monkeypatch):
    """x within 1 % of the bodies' part, pin forces 1.5 % of the largest, stiffness and other forces 1 %, shares 2 %."""
    monkeypatch.setattr(platformdirs, "user_cache_dir", lambda *words, **options: str(tmp_path / "cache"))
    drawn = tmp_path / "drive.toml"
    drawn.write_text((CASES / f"{name}.toml").read_text())
    pair = cy.read_drive(drawn).pair
    expected, matrices = case(name)[0], matrices_of(pair, pair.bodies)
    for result in expected["results"]:
        for number in (0, 5):
            drive = elastic_equilibrium.Drive(pair, matrices, expected["crank_angle"][number], HALF_SHELL.get(name))
            solution, want = (
                drive.solution(result["torque"]),
                {k: v[number] for k, v in result.items() if k != "torque"},
            )
            bodies_part = sum(want["compliance"].get(part, 0.0) for part in drive.parts) * abs(result["torque"])
            assert abs(solution.x - want["transmission_error"]) < max(0.05 / cy.ARCSEC, 0.01 * bodies_part)
            assert solution.stiffness == pytest.approx(want["torsional_stiffness"], rel=0.01)
            for force, share in (
                ("pin_force", 0.015),
                ("turning_arm_force", 0.01),
                ("crank_bearing_force", 0.01),
                ("output_roller_force", 0.01),
            ):
                wanted = np.array(want.get(force, getattr(solution, force)))
                if wanted.size:
                    assert np.abs(getattr(solution, force) - wanted).max() < share * wanted.max(), force
            assert solution.main_bearing_force == pytest.approx(want["main_bearing_force"], rel=0.01, abs=1.0)
            shift = np.column_stack([want["disc_shift_x"], want["disc_shift_y"]])
            assert np.abs(solution.disc_shift - shift).max() < 5e-8
            power = abs(result["torque"]) / pair.gear_teeth
            assert abs(solution.crank_torque - want["crank_torque"]) < 1e-3 * power
            total = 1.0 / want["torsional_stiffness"]
            for part, share in solution.compliance.items():
                assert share == pytest.approx(want["compliance"].get(part, 0.0), rel=0.02, abs=1e-3 * total), part


def test_stiffness_is_the_slope_of_the_torque_over_the_output():
    """With pins that bend; the flank's radius of curvature is held while differentiating, which is worth 5e-4."""
    expected, pair, _ = rigid("rollers-one-disc")
    matrices = matrices_of(pair, Bodies(pin={"ends": "supported", "span": "20 mm"}))
    drive = elastic_equilibrium.Drive(pair, matrices, expected["crank_angle"][2])
    low, middle, high = (drive.solution(torque) for torque in (59.9, 60.0, 60.1))
    assert 0.2 / (high.x - low.x) == pytest.approx(middle.stiffness, rel=1e-3)
