import dataclasses

import numpy as np
import pytest
from common import ARCSEC, WEAR_PAIR, make_pair
from tangent_contact import first_touch, unloaded_error

from cycloid_fmu import contact
from cycloid_fmu.analysis import solve
from cycloid_fmu.contact.loaded_contacts import contact_ratio, loaded_contacts
from cycloid_fmu.contact.transmission import rigid_problem
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import parse_pair
from cycloid_fmu.geometry.profile import flank_points
from cycloid_fmu.surfaces.surface import nominal_surface
from cycloid_fmu.wear.sliding import ideal_velocities, slip_pole, velocities

PITCH = 2.0 * np.pi / 40


def wear_pair(**keys):
    return make_pair(WEAR_PAIR, **keys)


def unmodified(**keys):
    return make_pair(WEAR_PAIR.split("[modification]")[0], **keys)


def with_errors(pair, size=1e-7):
    """Errors of every kind that unloaded contact knows, small enough to leave some play."""
    rng, g = np.random.default_rng(3), pair
    return dataclasses.replace(
        nominal_surface(pair),
        pin_radial=rng.normal(size=g.pins) * size,
        pin_tangential=rng.normal(size=g.pins) * size,
        pin_radius_deviation=rng.normal(size=g.pins) * size,
        tooth_cumulative_pitch=rng.normal(size=(g.discs, g.gear_teeth)) * size,
        centre_distance_x=2 * size,
        eccentricity=-size,
        offset=size,
        isometric=size,
    )


def phase_of_pin(pair, crank_angle, disc, pin):
    """Angle of a pin from its disc's crank, in -π to π, rad; the output without error."""
    ring = crank_angle / pair.pins if pair.output == "ring" else 0.0
    angle = 2.0 * np.pi * (pin / pair.pins - disc / pair.discs) + ring - crank_angle
    return (angle + np.pi) % (2.0 * np.pi) - np.pi


@pytest.mark.parametrize("keys", [{}, {"output": "ring"}, {"discs": 2}], ids=["gear", "ring", "two discs"])
@pytest.mark.parametrize("errors", [False, True], ids=["nominal", "with errors"])
def test_the_comprehensive_curve_is_the_end_of_the_play(keys, errors):
    """Tangency by one scalar equation, against smallest gaps by Newton's method in the kernel."""
    pair = wear_pair(**keys)
    surface = with_errors(pair) if errors else nominal_surface(pair)
    theta = np.linspace(0.0, 2 * np.pi, 150)
    play = solve(DriveValue(pair, surface), 0.0, theta)
    assert np.isfinite(play.backlash).all()
    for side, end in ((-1, play.play_low), (1, play.play_high)):
        found, _ = first_touch(unloaded_error(pair, surface, theta, side), side)
        np.testing.assert_allclose(found, end, atol=1e-6 * ARCSEC)


@pytest.mark.parametrize("output", ["gear", "ring"])
def test_at_its_own_transmission_error_a_pin_has_no_gap(output):
    pair = wear_pair(output=output)
    drive = rigid_problem(DriveValue(pair, with_errors(pair)))
    contacts = contact.contact_rows(drive)
    for side in (-1, 1):
        (error,) = unloaded_error(pair, with_errors(pair), [0.3], side)[:, 0]
        near = np.abs(error) < 60 * ARCSEC
        assert near.sum() >= 8
        for pin in np.flatnonzero(near):
            contact.place_contacts(drive, 0.3, error[pin], contacts, True, np.inf, np.inf)
            row = 2 * pin + np.argmin(np.abs(contacts["gap"][2 * pin : 2 * pin + 2]))
            assert abs(contacts[row]["gap"]) < 1e-12
            assert side * contacts[row]["arm"] > 0


def test_figures_of_the_wear_pair_unloaded():
    """The wear paper's pair; peak to peak it takes 0.606″ and 0.733″ at 16 angles a pitch, these are converged."""
    pair = wear_pair()
    theta = np.linspace(0.0, PITCH, 1600, endpoint=False)
    low, high = (first_touch(unloaded_error(pair, nominal_surface(pair), theta, s), s)[0] for s in (-1, 1))
    assert low.mean() / ARCSEC == pytest.approx(-3.360, abs=0.001)
    assert np.ptp(low) / ARCSEC == pytest.approx(0.611, abs=0.001)
    assert (high - low).mean() / ARCSEC == pytest.approx(6.720, abs=0.001)
    assert np.ptp(high - low) / ARCSEC == pytest.approx(0.740, abs=0.002)
    assert np.ptp(low[::100]) / ARCSEC == pytest.approx(0.606, abs=0.005)


def test_the_paper_s_unloaded_figure_is_of_a_smaller_modification():
    """0.018″ peak to peak is 0.028 of the stated modification; ±0.018″ is twice that."""
    pair = parse_pair(WEAR_PAIR.replace("-50 um", "-1.4 um").replace("-30 um", "-0.84 um"), "small")
    error, _ = first_touch(unloaded_error(pair, nominal_surface(pair), np.linspace(0.0, PITCH, 1000), -1), -1)
    assert np.ptp(error) / ARCSEC == pytest.approx(0.018, abs=0.001)


def test_a_pin_s_mesh_interval_is_one_pitch():
    """2π/40 without errors, whatever the side, and each pin hands over to its neighbour."""
    pair, steps = wear_pair(), 2000
    theta = 2.0 * np.pi * np.arange(steps + 1) / steps
    for side in (-1, 1):
        _, pin = first_touch(unloaded_error(pair, nominal_surface(pair), theta, side), side)
        at = np.flatnonzero(np.diff(pin))
        assert at.size == 40
        np.testing.assert_allclose(np.diff(theta[at]), PITCH, atol=1.01 * 2.0 * np.pi / steps)
        assert ((pin[at] - pin[at + 1]) % 40 == (pin[at[0]] - pin[at[0] + 1]) % 40).all()


def test_as_the_torque_vanishes_the_contact_that_carries_it_is_the_first_to_touch():
    pair = wear_pair()
    surface, theta = with_errors(pair), np.linspace(0.0, 1.0, 60)
    for side in (-1, 1):
        found = loaded_contacts(rigid_problem(DriveValue(pair, surface)), theta, 1e-7 * side)
        error, pin = first_touch(unloaded_error(pair, surface, theta, side), side)
        assert contact_ratio(found) < 1.1
        assert (found.pin[np.searchsorted(found.angle, np.arange(60))] == pin).mean() > 0.95
        np.testing.assert_allclose(found.transmission_error, error, atol=1e-3 * ARCSEC)


def test_an_unmodified_pair_touches_at_every_pin_of_its_side():
    pair = unmodified()
    error = unloaded_error(pair, nominal_surface(pair), np.linspace(0.1, 6.0, 40), -1)
    assert ((np.abs(error) < 1e-7 * ARCSEC).sum(axis=(1, 2)) >= 18).all()
    assert np.abs(first_touch(error, -1)[0]).max() < 1e-7 * ARCSEC


@pytest.mark.parametrize(
    ("torque", "error", "pressure", "least", "most"),
    [(-200.0, -18.175, 1547e6, 5, 6), (-400.0, -26.206, 2022e6, 6, 7), (-800.0, -38.654, 2687e6, 7, 8)],
)
def test_figures_of_the_wear_pair_loaded(torque, error, pressure, least, most):
    """Pins that carry load and the loaded transmission error at the paper's torques."""
    pair = wear_pair()
    found = loaded_contacts(
        rigid_problem(DriveValue(pair, nominal_surface(pair))), np.arange(200) / 200 * PITCH, torque
    )
    assert found.transmission_error.mean() / ARCSEC == pytest.approx(error, abs=0.002)
    assert found.pressure.max() == pytest.approx(pressure, rel=0.003)
    count = np.bincount(found.angle)
    assert (count.min(), count.max()) == (least, most)
    assert contact_ratio(found) == pytest.approx(count.mean())
    np.testing.assert_allclose(np.bincount(found.angle, found.force * found.moment_arm), torque, rtol=1e-6)


def test_contact_ratio_as_printed():
    """6.25 at 400 and 5.05 at 200 N·m; the paper's 8.94 takes 1268 N·m or 0.347 of its modification."""
    drive = rigid_problem(DriveValue(wear_pair(contact_law="as_printed"), nominal_surface(wear_pair())))
    theta = np.arange(400) / 400 * PITCH
    for torque, ratio in ((-400.0, 6.25), (-200.0, 5.05), (-1268.0, 8.94)):
        assert contact_ratio(loaded_contacts(drive, theta, torque)) == pytest.approx(ratio, abs=0.04)
    text = WEAR_PAIR.replace("-50 um", "-17.35 um").replace("-30 um", "-10.41 um")
    less = make_pair(text, contact_law="as_printed")
    found = loaded_contacts(rigid_problem(DriveValue(less, nominal_surface(less))), theta, -400.0)
    assert contact_ratio(found) == pytest.approx(8.94, abs=0.04)


@pytest.mark.parametrize("torque", [-400.0, 400.0])
@pytest.mark.parametrize("keys", [{}, {"output": "ring"}, {"discs": 2}], ids=["gear", "ring", "two discs"])
def test_loaded_contacts_are_those_of_the_sweep(keys, torque):
    """Force and pressure of each pin agree with `solve`; the contacts are on the flank that they state."""
    pair = wear_pair(**keys)
    surface = with_errors(pair)
    drive, theta = rigid_problem(DriveValue(pair, surface)), np.linspace(0.0, 0.5, 20)
    found = loaded_contacts(drive, theta, torque)
    sweep = solve(DriveValue(pair, surface), torque, theta, with_play=False)
    force = np.zeros(sweep.pin_force.shape[1:])
    np.add.at(force, (found.angle, found.disc, found.pin), found.force)
    np.testing.assert_allclose(force, sweep.pin_force[0], rtol=1e-6, atol=1e-6)
    assert found.pressure.max() == pytest.approx(sweep.max_contact_pressure.max(), rel=1e-6)
    np.testing.assert_allclose(found.transmission_error, sweep.transmission_error[0], atol=1e-12)
    # The arm is that of the normal about the centre of the output's rotation.
    if not drive.ring:
        arm = (found.pin_axis * np.conj(found.normal)).imag
        np.testing.assert_allclose(np.abs(arm), np.abs(found.moment_arm), rtol=1e-6)
    np.testing.assert_allclose(found.phase, phase_of_pin(pair, theta[found.angle], found.disc, found.pin), atol=1e-3)


@pytest.mark.parametrize("output", ["gear", "ring"])
def test_closed_forms_against_differences_of_the_contact_point(output):
    """v_1r, v_2r and v_12 of the unmodified pair against where the contact is a little later, to 1e-7 m/rad."""
    pair = unmodified(output=output)
    drive = rigid_problem(DriveValue(pair, nominal_surface(pair)))
    step, pins = 1e-5, np.arange(40)
    ring = 1.0 / 40 if output == "ring" else 0.0

    def places(theta):
        """Contact points of all pins: in the gear's frame, and about the pin's axis in the ring's."""
        rows = contact.contact_rows(drive)
        contact.place_contacts(drive, theta, 0.0, rows, True, np.inf, np.inf)
        assert np.abs(rows["gap"][::2]).max() < 1e-12
        on_gear = np.array([1, 1j]) @ flank_points(pair, rows["profile_parameter"][::2])
        gear = 0.0 if output == "ring" else -theta / 39
        point = on_gear * np.exp(1j * gear) + drive.eccentricity * np.exp(1j * theta)
        return on_gear, point * np.exp(-1j * ring * theta) - drive.pin_x - 1j * drive.pin_y

    for theta in (0.3, 1.234):
        (gear_before, pin_before), (gear_after, pin_after) = places(theta - step), places(theta + step)
        between = 2.0 * step * (1.0 - ring)
        ideal = ideal_velocities(pair, phase_of_pin(pair, theta, 0, pins))
        np.testing.assert_allclose(np.abs(gear_after - gear_before) / between, np.abs(ideal.gear), atol=1e-7)
        turned = np.angle(pin_after / pin_before) * 3e-3 / between
        np.testing.assert_allclose(np.abs(turned), np.abs(ideal.pin), atol=1e-7)
        same = np.sign(turned * ideal.pin)[np.abs(turned) > 1e-6]
        assert (same == same[0]).all()
        np.testing.assert_allclose(ideal.gear - ideal.pin, ideal.sliding, atol=1e-12)


@pytest.mark.parametrize("output", ["gear", "ring"])
def test_velocities_of_the_unmodified_pair_are_the_closed_forms(output):
    pair = unmodified(output=output)
    drive = rigid_problem(DriveValue(pair, nominal_surface(pair)))
    found = loaded_contacts(drive, np.linspace(0.0, PITCH, 60), -1.0)
    for mine, ideal in zip(velocities(drive, found), ideal_velocities(pair, found.phase), strict=True):
        np.testing.assert_allclose(mine, ideal, atol=3e-6)


def test_slip_of_the_ideal_pair():
    """σ_1 = 1 at the pole, cos φ = K = 0.66344 rad for R_p 66; σ_2 changes sign there through infinity."""
    pair = unmodified()
    pole = slip_pole(pair)
    assert pole == pytest.approx(0.66344, abs=5e-6)
    at = ideal_velocities(pair, [pole - 1e-9, pole, pole + 1e-9])
    np.testing.assert_allclose(at.gear_slip, 1.0, atol=1e-6)
    assert abs(at.pin_slip[1]) > 1e12
    assert at.pin_slip[0] * at.pin_slip[2] < 0
    # There the moment arm e z_c sin φ/S is largest.
    k = 1.3 * 40 / 66
    arm = [np.sin(p) / np.sqrt(1 + k * k - 2 * k * np.cos(p)) for p in (pole - 1e-3, pole, pole + 1e-3)]
    assert arm[1] > max(arm[0], arm[2])


def test_modified_flanks_roll_otherwise():
    """At 400 N·m v_2r differs from the closed form by a third where the mesh ends, v_12 by about one per cent."""
    pair = wear_pair()
    drive = rigid_problem(DriveValue(pair, nominal_surface(pair)))
    found = loaded_contacts(drive, np.linspace(0.0, PITCH, 400), -400.0)
    mine, ideal = velocities(drive, found), ideal_velocities(pair, found.phase)
    assert 0.25 < np.abs(mine.gear / ideal.gear - 1).max() < 0.45
    assert 0.005 < np.abs(mine.sliding / ideal.sliding - 1).max() < 0.02
