"""Native FMUs of drives on bearings: their period, their tables, and the compiled FMU."""

import math

import numpy as np
import pytest
from c_host import Slave, Tabled, native_of
from clockworks import compliant_drive, kinematic_drive

import cycloid_fmu as cy
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu import tables
from cycloid_fmu.fmu.variables import Interface
from cycloid_fmu.supports.transmission import PLAY_LOAD
from cycloid_fmu.surfaces.surface import surface_of_pair

ARCSEC = math.pi / 648000
SIZES = {
    "gear_teeth": 9,
    "pin_circle_radius": 40e-3,
    "pin_radius": 4e-3,
    "eccentricity": 2.2e-3,
    "face_width": 0.01,
    "rated_torque": 40.0,
    "modification": {"isometric": -10e-6, "offset": -30e-6},
}
HELD = {
    "circle_radius": 0.02,
    "first_angle": 0.3,
    "crank_shaft": {"stiffness": 3e8},
    "main": {"stiffness": 1e9},
    "turning_arm": {"rollers": 12, "roller_length": 8e-3, "clearance": 6e-6},
}


def pair_on(kind, count, **changes):
    supports = {"kind": kind, "count": count, **HELD}
    if kind == "output_rollers":
        supports["output_roller"] = {"stiffness": 2e8, "clearance": 8e-6}
    return cy.Pair(**{**SIZES, **changes}, supports=supports)


@pytest.fixture(scope="module")
def held():
    pair = pair_on("cranks", 3)
    surface = surface_of_pair(pair)
    with pytest.MonkeyPatch.context() as patch:
        for name, few in (("PROBES", 600), ("_SPREAD", 120), ("_WORST", 30)):
            patch.setattr(tables, name, few)
        made = tables.compute(DriveValue(pair, surface), accuracy=0.5 * ARCSEC, largest_load=60.0)
    return Tabled(pair, surface, tables=made)


@pytest.mark.parametrize(
    ("kind", "count", "errors", "pitches"),
    [
        ("cranks", 3, {}, 3),
        ("cranks", 2, {}, 9),
        ("output_rollers", 6, {}, 3),
        ("output_rollers", 4, {}, 9),
        ("cranks", 3, {"supports": {"crank_x": ["1 um", "0 um", "0 um"]}}, 9),
        ("cranks", 3, {"pin_radial": [1e-6 * (3 * i % 10) for i in range(10)]}, 30),
        ("cranks", 3, {"centre_distance_x": 3e-6}, 30),
    ],
)
def test_all_repeats_after_a_period_and_not_before(kind, count, errors, pitches):
    """Cranks meet the pins in the same way when the carrier has moved by one of them: z_c over the common divisor."""
    pair = pair_on(kind, count, errors=errors, discs=2)
    surface = surface_of_pair(pair)
    assert tables.mesh_pitches(DriveValue(pair, surface)) == pitches
    pitch = 2.0 * math.pi / pair.pins
    angles = np.linspace(0.0, pitch, 3)
    parts = [pitches // prime for prime in (2, 3, 5) if pitches % prime == 0]
    whole = np.concatenate([angles + shift * pitch for shift in (0, pitches, *parts)])
    found = solve(DriveValue(pair, surface), [30.0, -2.0], whole, with_play=False)
    for values, least in ((found.transmission_error, 1e-3 * ARCSEC), (found.crank_torque, 1e-6)):
        first, again, *others = np.split(values, len(parts) + 2, axis=1)
        assert np.abs(again - first).max() < 1e-2 * least
        for other in others:
            assert np.abs(other - first).max() > least


def test_tables_are_what_analyze_says_within_their_accuracy(held):
    generator = np.random.default_rng(3)
    angles = np.sort(generator.uniform(0.0, 40.0, 60))
    for torque in (55.0, -21.0, 1.3, -0.06):
        want = solve(DriveValue(held.pair, held.surface), [torque], angles)
        found = tables.interpolated(held.tables, angles, np.full(angles.size, torque)).transmission_error
        assert np.abs(found - want.transmission_error[0]).max() < 0.5 * ARCSEC
    ends = np.full(angles.size, 1e-9)
    high, low = (tables.interpolated(held.tables, angles, way * ends).transmission_error for way in (1.0, -1.0))
    assert high - low == pytest.approx(want.backlash, abs=0.5 * ARCSEC)


def test_the_compiled_fmu_is_the_exact_model(held, tmp_path):
    (tmp_path / "kinematic").mkdir()
    path = native_of(tmp_path / "kinematic", held, held.tables, Interface())
    slave, exact = (
        Slave(path, tmp_path / "kinematic" / "unpacked"),
        kinematic_drive(DriveValue(held.pair, held.surface)),
    )
    slave.start(friction_torque=0.5)
    exact.friction_torque = 0.5
    names = ("transmission_error", "flange_a.tau", "backlash", "torsional_stiffness")
    away = []
    for i in range(200):
        crank, torque = 0.11 * i, 25.0 * math.sin(0.4 * i) * (i % 50 > 10)
        slave.put(flange_a_phi=crank, flange_b_tau=torque)
        slave.fmi.doStep(0.01 * i, 0.01)
        exact.crank_angle, exact.torque = crank, torque
        exact.advance()
        wanted = exact.transmission_error, exact.crank_torque, exact.backlash, exact.torsional_stiffness
        away.append(np.subtract(slave.get(*names), wanted))
    largest = np.abs(away).max(axis=0)
    slave.fmi.freeInstance()
    assert largest[0] < 0.5 * ARCSEC
    assert largest[2] < 0.5 * ARCSEC
    assert largest[1] < 5e-3 * 25.0 / 9
    assert np.sqrt(np.mean(np.square(away), axis=0))[3] < 2e-2 * exact.pair.rated_torque / (20.0 * ARCSEC)


def test_between_two_flanges_it_gives_the_exact_torques_and_keeps_its_energy(held, tmp_path):
    (tmp_path / "compliant").mkdir()
    path = native_of(tmp_path / "compliant", held, held.tables, Interface("compliant"))
    slave, exact = (
        Slave(path, tmp_path / "compliant" / "unpacked"),
        compliant_drive(DriveValue(held.pair, held.surface)),
    )
    stiffness = held.pair.rated_torque / (50.0 * ARCSEC)
    slave.start(mesh_damping=0.0)
    ratio, pressed = held.pair.ratio, 0
    for crank, deviation in ((0.4, 1.25e-3), (1.7, -1.2e-3), (5.0, 1.3e-3), (2.2, 1e-5)):
        output = crank / ratio + deviation

        def energy(crank, output):
            slave.put(flange_a_phi=crank, flange_b_phi=output)
            return slave.get("elastic_energy")[0]

        by_crank = (energy(crank + 1e-6, output) - energy(crank - 1e-6, output)) / 2e-6
        by_output = (energy(crank, output + 1e-8) - energy(crank, output - 1e-8)) / 2e-8
        slave.put(flange_a_phi=crank, flange_b_phi=output)
        found = slave.get("flange_a.tau", "flange_b.tau")
        assert found == pytest.approx([by_crank, by_output], rel=1e-5, abs=1e-6)
        exact.crank_angle, exact.output_angle = crank, output
        # Errors of the tables become torque by the stiffness.
        assert found[1] == pytest.approx(exact.torque, abs=0.5 * ARCSEC * 4.0 * stiffness + 5e-3 * abs(exact.torque))
        assert found[0] == pytest.approx(exact.crank_torque, abs=2e-2 * abs(exact.torque) / 9 + PLAY_LOAD * 40.0)
        pressed += abs(found[1]) > 5.0
    slave.fmi.freeInstance()
    assert pressed >= 2
