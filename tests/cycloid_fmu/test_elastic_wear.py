"""Wear of drives on bearings with elastic bodies: limits, and a second computation from the analysis."""

import dataclasses

import numpy as np
import pytest
from test_elastic_drive import CRANKS, PAIR, SOFT_CRANKS, solved

from cycloid_fmu import edge
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import write_pair
from cycloid_fmu.surfaces.surface import nominal_surface
from cycloid_fmu.wear.law import Load, WearLaw
from cycloid_fmu.wear.progress import Sweep, wear_model, wear_rate
from cycloid_fmu.wear.sliding import ideal_velocities

COEFFICIENT, TORQUE = 1e-18, 20.0
LAW = WearLaw(pins="fixed", coefficient=COEFFICIENT)
STIFF = {"pin": {"ends": "supported", "span": "26 mm", "youngs_modulus": 1e25}}
RIGID = PAIR.replace(supports={"kind": "cranks", "count": 3, "circle_radius": "20 mm"}, discs=2)


def model(pair, sweep=None):
    drive = DriveValue(pair, nominal_surface(pair))
    whole = wear_model(drive, LAW, [Load(torque=TORQUE, crank_turns=1.0)], 200, 100)
    return whole if sweep is None else dataclasses.replace(whole, sweep=sweep)


def rate(pair, sweep=None):
    new = model(pair, sweep)
    return wear_rate(new, new.surface)


def output_turn(pair, pitches, each, pins_alike):
    """A sweep over pin pitches of the crank."""
    angle = np.arange(pitches * each) / each * 2.0 * np.pi / pair.pins
    return Sweep(angle, teeth_alike=False, pins_alike=pins_alike)


def test_rigid_bearings_wear_as_no_bearings():
    """Up to the stiffness of "rigid", and to the crank angles of single teeth."""
    held, free = rate(RIGID), rate(RIGID.replace(supports=None))
    assert held.volume == pytest.approx(free.volume, rel=1e-5)
    assert held.pressure == pytest.approx(free.pressure, rel=1e-6)
    assert held.depth.pin == pytest.approx(free.depth.pin, abs=1e-4 * free.depth.pin.max())
    assert held.depth.gear == pytest.approx(free.depth.gear, abs=3e-3 * free.depth.gear.max())


def test_bodies_without_compliance_wear_as_rigid_ones():
    stiff, rigid = rate(CRANKS.replace(bodies=STIFF)), rate(CRANKS)
    assert stiff.depth.gear == pytest.approx(rigid.depth.gear, abs=1e-6 * rigid.depth.gear.max())
    assert stiff.depth.pin == pytest.approx(rigid.depth.pin, abs=1e-6 * rigid.depth.pin.max())
    assert stiff.volume == pytest.approx(rigid.volume, rel=1e-6)


def test_teeth_and_pins_lose_what_their_forces_slide():
    """k_0 Σ F s of every pin and tooth, forces of the analysis, sliding of the unmodified pair in closed form.

    Teeth differ as they stand against the three cranks; modifications change the sliding by some 0.1 %.
    """
    pair, each = SOFT_CRANKS, 16
    sweep = output_turn(pair, pair.gear_teeth * pair.pins, each, pins_alike=False)
    worn = model(pair, sweep)
    depth = wear_rate(worn, worn.surface).depth
    force = solved(pair, TORQUE, sweep.crank_angle).pin_force[0]
    disc, pin = np.arange(pair.discs)[:, None], np.arange(pair.pins)
    crank = sweep.crank_angle[:, None, None] + 2.0 * np.pi * disc / pair.discs
    step = 2.0 * np.pi / sweep.crank_angle.size
    slid = np.abs(ideal_velocities(pair, 2.0 * np.pi * pin / pair.pins - crank).sliding) * step
    volume = COEFFICIENT * force * slid
    by_pin = depth.pin.sum(axis=(1, 2)) * worn.pin_element * pair.face_width * pair.discs
    assert by_pin == pytest.approx(volume.sum(axis=(0, 1)), rel=2e-3)
    around = 2.0 * np.pi * pin / pair.pins + crank / pair.gear_teeth
    tooth = np.floor(around * pair.gear_teeth / (2.0 * np.pi)).astype(int) % pair.gear_teeth
    by_tooth = np.zeros((pair.discs, pair.gear_teeth))
    np.add.at(by_tooth, (np.broadcast_to(disc, tooth.shape), tooth), volume)
    assert depth.gear.sum(axis=(2, 3)) * worn.gear_element * pair.face_width == pytest.approx(by_tooth, rel=2e-3)
    assert np.ptp(by_tooth[0]) > 0.02 * by_tooth.mean()


def test_a_crank_turn_stands_for_a_turn_of_the_output():
    """Pins of a ring are alike on any bearings, teeth are not; the sweep of a wear model has this length."""
    pair, each = SOFT_CRANKS, 16
    whole = rate(pair, output_turn(pair, pair.gear_teeth * pair.pins, each, pins_alike=False)).depth
    short = rate(pair, output_turn(pair, pair.gear_teeth, each, pins_alike=True)).depth
    assert short.gear == pytest.approx(whole.gear, abs=1e-3 * whole.gear.max())
    assert short.pin == pytest.approx(whole.pin, abs=1e-4 * whole.pin.max())
    sweep = model(pair).sweep
    assert (sweep.teeth_alike, sweep.pins_alike) == (False, True)
    reach = sweep.crank_angle[-1] + sweep.crank_angle[1]
    assert reach == pytest.approx(2.0 * np.pi * pair.gear_teeth / pair.pins)


def test_a_torque_that_can_not_be_carried_gets_a_sentence():
    worn = model(CRANKS)
    heavy = dataclasses.replace(worn, loads=(Load(torque=1e9, crank_turns=1.0),))
    with pytest.raises(edge.InputError, match="torque = 1e\\+09"):
        wear_rate(heavy, heavy.surface)


@pytest.mark.slow(20)
def test_the_command_wears_a_drive_with_elastic_bodies(command, tmp_path):
    write_pair(SOFT_CRANKS, tmp_path / "pair.toml")
    (tmp_path / "wear.toml").write_text(
        'format = "cycloid-wear/1"\n[wear]\npins = "fixed"\ncoefficient = "1e-17 m^2/N"\n'
    )
    words = ["wear", "pair.toml", "--wear", "wear.toml", "--crank-turns", "1e4", "-o", "worn.nc", "--plot", "wear.png"]
    run = command("cycloid-fmu", *words)
    assert run.returncode == 0, run.stderr
    assert "deepest" in run.stdout
    run = command("cycloid-fmu", "analyze", "pair.toml", "--surface", "worn.nc", "--torque", "20 N*m")
    assert run.returncode == 0, run.stderr
