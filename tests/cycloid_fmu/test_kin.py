"""Few and many teeth, and drives of any size: a second solver, and similarity, which Hertz's law keeps exactly."""

import math

import brute_force
import numpy as np
import pytest
from common import ARCSEC

from cycloid_fmu import edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import LEAST_TEETH, MOST_TEETH, Pair, smallest_convex_radius

RADIUS = 64e-3


def a_pair(generator, teeth, size=1.0, shortening=None, **more):
    """A random pair with errors whose lengths all go with its size; of many teeth the shapes are smaller."""
    pins = teeth + 1
    k = generator.uniform(0.4, 0.85) if shortening is None else shortening
    eccentricity = k * RADIUS / pins
    largest = min(RADIUS * math.sin(math.pi / pins), smallest_convex_radius(RADIUS, eccentricity, pins))
    tooth = min(1.0, 40.0 / pins)
    um = 1e-6 * tooth * size
    return Pair(
        gear_teeth=teeth,
        pin_circle_radius=RADIUS * size,
        pin_radius=generator.uniform(0.3, 0.9) * largest * size,
        eccentricity=eccentricity * size,
        face_width=0.01 * size,
        modification={"isometric": generator.uniform(-10.0, 10.0) * um, "offset": generator.uniform(-50.0, -20.0) * um},
        errors={
            "pin_radial": (2.0 * um * generator.normal(size=pins)).tolist(),
            "pin_tangential": (2.0 * um * generator.normal(size=pins)).tolist(),
            "tooth_cumulative_pitch": (2.0 * um * generator.normal(size=teeth)).tolist(),
            "centre_distance_x": 2.0 * um,
            "eccentricity": um,
        },
        **more,
    )


def as_tables(pair):
    """The pair that `brute_force.load_pair` makes of its file."""
    names = ("gear_teeth", "pins", "pin_circle_radius", "pin_radius", "eccentricity", "face_width", "discs")
    errors = {key: list(value) if isinstance(value, tuple) else value for key, value in pair.errors.items()}
    drawn = {"isometric": pair.modification.isometric, "offset": pair.modification.offset}
    return {"pair": {name: getattr(pair, name) for name in names}, "modification": drawn, "errors": errors}


@pytest.mark.parametrize(
    ("teeth", "size"),
    [
        (LEAST_TEETH, 1.0),
        (3, 1.0),
        (5, 1.0),
        (5, 10.0),
        (39, 10.0),
        (39, 0.2),
        pytest.param(150, 1.0, marks=pytest.mark.slow(1)),
        pytest.param(119, 10.0, marks=pytest.mark.slow(1)),
        (MOST_TEETH, 1.0),
    ],
)
def test_any_teeth_and_size_against_the_second_solver(teeth, size, record_property):
    generator = np.random.default_rng([teeth, round(10 * size)])
    pair = a_pair(generator, teeth, size)
    angle = generator.uniform(0.0, 2.0 * np.pi)
    torque = generator.choice([-1.0, 1.0]) * generator.uniform(20.0, 100.0) * size**3
    wanted = brute_force.solve(as_tables(pair), angle, torque, points=40)
    found = solve(DriveValue.as_stated(pair), torque, angle)
    away = abs(found.transmission_error[0, 0] - wanted["transmission_error"]) / ARCSEC
    record_property(f"transmission error of {teeth} teeth, size {size:g}, away from the second solver", f"{away:.1g}″")
    assert away < 1e-3
    assert found.backlash[0] == pytest.approx(wanted["backlash"], abs=1e-3 * ARCSEC, nan_ok=True)
    assert found.max_contact_pressure[0, 0] == pytest.approx(wanted["max_contact_pressure"], rel=1e-4)
    largest = wanted["pin_force"].max()
    assert found.pin_force[0, 0] == pytest.approx(wanted["pin_force"], abs=1e-4 * largest)


def held(kind, size):
    """Bearings whose stiffness goes with the size, and forces then with its square: springs and rollers."""
    supports = {
        "kind": kind,
        "count": 3,
        "circle_radius": 0.036 * size,
        "turning_arm": {"stiffness": 4e8 * size, "clearance": 8e-6 * size},
        "crank_shaft": {"rollers": 20, "roller_length": 8e-3 * size, "clearance": 4e-6 * size},
        "main": {"stiffness": 1.2e9 * size},
        "pin_seat": {"stiffness_per_width": 3e10},
    }
    if kind == "output_rollers":
        supports["output_roller"] = {"stiffness": 3e8 * size}
    return supports


@pytest.mark.parametrize(("teeth", "kind"), [(5, None), (39, None), (11, "cranks"), (11, "output_rollers")])
def test_drives_of_all_sizes_are_similar(teeth, kind):
    """All lengths times λ, forces times λ²: angles, pressures and contacts stay, without a logarithm left over.

    Hertz's approach is F/b times a logarithm of ρ/a and R_rp/a; F/b goes with λ and so does a, the ratios stay.
    """
    angle = np.linspace(0.1, 6.3, 25)

    def at(size):
        more = {} if kind is None else {"supports": held(kind, size)}
        pair = a_pair(np.random.default_rng(teeth), teeth, size, 0.7, rated_torque=100.0 * size**3, **more)
        return solve(DriveValue.as_stated(pair), [100.0 * size**3, -7.0 * size**3], angle)

    one = at(1.0)
    for size in (0.3, 10.0):
        other = at(size)
        assert other.transmission_error == pytest.approx(one.transmission_error, abs=1e-3 * ARCSEC)
        assert other.backlash == pytest.approx(one.backlash, abs=1e-2 * ARCSEC, nan_ok=True)
        assert other.max_contact_pressure == pytest.approx(one.max_contact_pressure, rel=1e-4)
        assert other.pin_force / size**2 == pytest.approx(one.pin_force, abs=1e-4 * one.pin_force.max())
        assert other.torsional_stiffness / size**3 == pytest.approx(one.torsional_stiffness, rel=1e-4)
        assert other.interference / size == pytest.approx(one.interference, abs=1e-9)


def path_in_gear(teeth, pins, pin, crank):
    """Position of a pin's axis seen from the gear, whose rotation is that of a pair with such numbers."""
    rotation = -(pins - teeth) * crank / teeth
    return (RADIUS * np.exp(2j * np.pi * pin / pins) - 1e-3 * np.exp(1j * crank)) * np.exp(-1j * rotation)


def test_with_one_pin_more_all_pins_draw_one_flank_and_with_two_they_cross():
    crank = np.linspace(0.0, 40.0 * np.pi, 40001)
    for teeth, pins, cross in ((20, 21, False), (20, 22, True), (19, 20, False)):
        one, other = (path_in_gear(teeth, pins, pin, crank) for pin in (0, 1))
        order = np.argsort(np.angle(one))
        radius = np.interp(np.angle(other), np.angle(one)[order], np.abs(one)[order], period=2.0 * np.pi)
        apart = np.abs(other) - radius
        if cross:  # by the eccentricity, either way
            assert apart.min() < -1e-3 < 1e-3 < apart.max()
        else:
            assert np.abs(apart).max() < 1e-6


def test_one_tooth_has_dead_points_and_two_have_none():
    """The arm of a pin's normal goes with sin φ of its angle from the crank; only arms of one sign can carry."""
    crank = np.linspace(0.0, 2.0 * np.pi, 3601)[:, None]
    best = [np.sin(2.0 * np.pi * np.arange(n) / n - crank).max(axis=1).min() for n in (2, LEAST_TEETH + 1)]
    assert best[0] == pytest.approx(0.0, abs=1e-12)
    assert best[1] == pytest.approx(0.5, abs=1e-12)


@pytest.mark.parametrize(
    ("size", "clearance", "allowed"), [(1.0, 2e-4, True), (1.0, 2.1e-4, False), (10.0, 1.7e-3, True)]
)
def test_clearances_are_limited_by_the_size(size, clearance, allowed):
    supports = held("cranks", size)
    supports["turning_arm"] = {"stiffness": 4e8, "clearance": clearance}
    if allowed:
        a_pair(np.random.default_rng(0), 39, size, supports=supports)
    else:
        with pytest.raises(edge.InputError, match=r"turning_arm\] clearance is 0.21 mm; it must be between 0 and 0.2"):
            a_pair(np.random.default_rng(0), 39, size, supports=supports)


@pytest.mark.parametrize(
    ("size", "offset", "allowed"), [(1.0, -1.1e-3, False), (10.0, -2e-3, True), (10.0, -0.011, False)]
)
def test_modifications_are_limited_by_the_size(size, offset, allowed):
    pair = a_pair(np.random.default_rng(0), 39, size)
    if allowed:
        assert pair.replace(offset=offset).modification.offset == offset
    else:
        with pytest.raises(
            edge.InputError, match=rf"^offset = .*: it must be between -{size:g} mm and {size:g} mm for"
        ):
            pair.replace(offset=offset)
