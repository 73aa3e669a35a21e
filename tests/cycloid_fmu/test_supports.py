"""Drives on bearings: an independent solver's results, closed forms, symmetries, and checks of files."""

import dataclasses
import itertools
import json
import math

import numpy as np
import pytest
from benches_as_they_are import on_bearings
from common import ARCSEC, DATA, EXAMPLES
from hypothesis import given, settings
from hypothesis import strategies as st
from sampled_drives import SMALL, random_drive
from scipy.integrate import quad

import cycloid_fmu as cy
from cycloid_fmu import edge
from cycloid_fmu.analysis import sensitivity, solve
from cycloid_fmu.contact import contact_rows
from cycloid_fmu.contact import transmission as on_rigid
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import parse_pair, read_pair
from cycloid_fmu.supports import energy
from cycloid_fmu.supports.assembly import Kind, by_kind, joint_list, kinds_of
from cycloid_fmu.supports.balance import Load
from cycloid_fmu.supports.bearing import LAW, linear, push, rollers, stored
from cycloid_fmu.supports.figures import remaining
from cycloid_fmu.supports.joints import (
    CARRIER,
    FIRST_DISC_BODY,
    HOUSING,
    add_turning,
    derivatives,
    displacement,
    orient,
    reaction,
    stored_energy,
    work_of,
)
from cycloid_fmu.supports.sensitivity import (
    CLEARANCE,
    PARAMETERS,
    STIFFNESS,
    sweep_supported_sensitivities,
)
from cycloid_fmu.supports.sweeps import sweep_supported
from cycloid_fmu.supports.transmission import assembly_of, empty, no_derivatives, problem_of
from cycloid_fmu.surfaces.structured import displacement_layout, displacements
from cycloid_fmu.surfaces.surface import surface_of_pair

CASES = DATA / "supports-cases"
SIZES = {
    "gear_teeth": 39,
    "pin_circle_radius": 64e-3,
    "pin_radius": 3e-3,
    "eccentricity": 1.3e-3,
    "face_width": 0.01,
    "rated_torque": 181.0,
    "modification": {"isometric": -15e-6, "offset": -40e-6},
}
CRANKS = {"kind": "cranks", "count": 3, "circle_radius": 0.036, "first_angle": 0.3}
ROLLERS = {"kind": "output_rollers", "count": 6, "circle_radius": 0.032, "first_angle": 0.1}
SOFT = {"turning_arm": {"stiffness": 4e8}, "crank_shaft": {"stiffness": 3e8}, "main": {"stiffness": 1.2e9}}
ANGLES = np.linspace(0.0, 2.0 * np.pi, 40, endpoint=False)


def solved(pair, torque, angles=ANGLES, **options):
    return solve(DriveValue.as_stated(pair), torque, angles, **options)


@pytest.mark.parametrize("case", sorted(p.stem for p in CASES.glob("*.toml")))
def test_reference_case(case, record_property):
    wanted = json.loads((CASES / f"{case}.json").read_text())
    pair = read_pair(CASES / f"{case}.toml")
    found = solved(pair, [r["torque"] for r in wanted["results"]], wanted["crank_angle"])
    shifts = {"disc_shift_x", "disc_shift_y"}
    for load, result in enumerate(wanted["results"]):
        torque = result.pop("torque")
        limits = {"transmission_error": 1e-3 * ARCSEC, "backlash": 5e-3 * ARCSEC, "crank_torque": 1e-6 * abs(torque)}
        for name, values in result.items():
            got = found.backlash if name == "backlash" else getattr(found, name)[load]
            values = np.array(values)
            away = np.abs(got.reshape(values.shape) - values).max()
            if name == "torsional_stiffness":
                away, limit = np.abs(got / values - 1.0).max(), 1e-3
            else:
                limit = 1e-9 if name in shifts else limits.get(name, 0.05)
            assert away < limit, name
            record_property(f"{name} at {torque:g} N·m, away from the independent solver (SI)", f"{away:.2g}")


@given(st.floats(0.0, 20e-6), st.floats(1e-7, 60e-6))
def test_rollers_are_the_integral_over_the_loaded_zone(clearance, beyond):
    r, bearing = 0.5 * clearance + beyond, rollers(15, 9e-3, clearance)
    each = 8.06e4 / 2.0 ** (10 / 9) * 9.0 ** (8 / 9) * 1e3 ** (10 / 9)
    end = math.acos(0.5 * clearance / r)
    integral, _ = quad(lambda a: (r * math.cos(a) - 0.5 * clearance) ** (10 / 9) * math.cos(a), 0.0, end, epsrel=1e-12)
    force, stiffness = push(bearing, r)
    assert force == pytest.approx(2.0 * 15 / (2.0 * math.pi) * each * integral, rel=1e-7)
    step = 1e-4 * beyond
    assert stiffness == pytest.approx((push(bearing, r + step)[0] - push(bearing, r - step)[0]) / (2 * step), rel=1e-5)


@given(st.floats(0.0, 20e-6), st.floats(1e-7, 60e-6))
def test_a_bearing_stores_what_its_force_did(clearance, beyond):
    for bearing in (rollers(15, 9e-3, clearance), linear(4e8, clearance)):
        end = 0.5 * clearance + beyond
        work, _ = quad(lambda r, bearing=bearing: push(bearing, r)[0], 0.5 * clearance, end, epsabs=0.0, epsrel=1e-10)
        assert stored(bearing, end) == pytest.approx(work, rel=1e-8)
        assert stored(bearing, 0.499 * clearance) == 0.0


def test_a_bearing_carries_nothing_inside_its_clearance():
    for bearing in (rollers(15, 9e-3, 8e-6), linear(4e8, 8e-6)):
        assert push(bearing, 3.999e-6) == (0.0, 0.0)
        assert push(bearing, 4.01e-6)[0] > 0.0


def test_rigid_supports_are_the_drive_on_rigid_bearings():
    """Centre distance and eccentricity errors included: the housing's seats are off the pin circle's centre."""
    errors = {"centre_distance_x": 4e-6, "centre_distance_y": -3e-6, "eccentricity": 1e-6, "pin_radius": -1e-6}
    rigid = cy.Pair(**SIZES, discs=2, errors=errors)
    held = rigid.replace(supports=CRANKS)
    want = solve(DriveValue.as_stated(rigid), [181.0, -20.0], ANGLES)
    found = solved(held, [181.0, -20.0])
    assert found.transmission_error == pytest.approx(want.transmission_error, abs=1e-3 * ARCSEC)
    assert found.pin_force == pytest.approx(want.pin_force, abs=0.01)
    assert found.torsional_stiffness == pytest.approx(want.torsional_stiffness, rel=1e-4)
    jammed = {"offset": 20e-6, "isometric": 0.0}
    want = solve(DriveValue.as_stated(rigid.replace(**jammed)), 0.0, ANGLES)
    found = solved(held.replace(**jammed), 0.0)
    assert found.interference == pytest.approx(want.interference, abs=1e-9)
    assert found.pin_force == pytest.approx(want.pin_force, abs=1e-4 * want.pin_force.max())
    assert found.preload == pytest.approx(want.pin_force.max(axis=(0, 2, 3)), rel=1e-4)


@pytest.mark.parametrize("kind", ["cranks", "output_rollers"])
def test_interference_is_that_of_a_rigid_drive_where_the_disc_then_stands(kind):
    """A disc that bearings hold off its place by a shift is a disc on rigid bearings with that centre distance."""
    supports = {"cranks": CRANKS, "output_rollers": {**ROLLERS, "output_roller": {"stiffness": 2e8}}}[kind] | SOFT
    supports["turning_arm"] = {"stiffness": 4e8, "clearance": 4e-6}
    errors = {"pin_radial": {"order_1": ["5 um", "40 deg"]}, "pin_radius": "12 um"}
    pair = cy.Pair(**SIZES, supports=supports, errors=errors).replace(offset=-15e-6)
    angles = ANGLES[::8]
    found = solved(pair, 0.0, angles)
    assert found.interference.min() > 1e-6
    assert np.abs(found.disc_shift_x).max() > 1e-6
    for i, angle in enumerate(angles):
        here = {"centre_distance_x": found.disc_shift_x[0, i, 0], "centre_distance_y": found.disc_shift_y[0, i, 0]}
        placed = cy.Drive(pair.replace(supports=None)).replace(errors=here)
        assert float(placed.analyze(0.0, crank_angle=[angle]).interference[0, 0]) == pytest.approx(
            found.interference[i], abs=1e-10
        )


def test_a_drive_with_play_presses_nothing_without_a_torque():
    """Its discs stand free in clearances that the centring springs of the solution alone decide."""
    pair = cy.Pair(
        **SIZES,
        discs=2,
        supports={**CRANKS, **SOFT, "turning_arm": {"rollers": 15, "roller_length": 9e-3, "clearance": 8e-6}},
    )
    found = solved(pair, [0.0, 181.0])
    assert found.interference.max() == found.preload.max() == found.preload_count.max() == 0.0
    assert found.pin_force[0].max() == found.max_contact_pressure[0].max() == 0.0
    assert found.torsional_stiffness[0].max() == 0.0
    assert found.backlash.min() > 0.0


@pytest.mark.parametrize("discs", [1, 2])
@pytest.mark.parametrize("kind", ["cranks", "output_rollers"])
def test_stiffness_without_mesh_is_the_closed_form(kind, discs):
    """1/K of a drive with stiff flanks is that of its bearings: K_t of cranks or rollers, K_r of the disc's bearings.

    The flanks' own compliance is taken off by solving the drive on rigid bearings as well.
    """
    stiff = {"gear": {"youngs_modulus": "2000000 GPa"}, "pin": {"youngs_modulus": "2000000 GPa"}}
    plain = {**SIZES, "modification": {}, "discs": discs, "material": stiff}
    a, n, e, teeth = 0.036, 4, 1.3e-3, 39
    ka, ks, km, kw, r = 4e8, 3e8, 1.2e9, 2e8, e * teeth
    supports = {"kind": kind, "count": n, "circle_radius": a, "first_angle": 0.2, **SOFT}
    if kind == "cranks":
        turning = n * a**2 / (1 / (discs * ka) + 1 / ks)
        radial = discs * n * ka * r**2 if discs > 1 else r**2 / (1 / (n * ka) + 1 / (n * ks) + 1 / km)
    else:
        supports["output_roller"] = {"stiffness": kw}
        supports["main"] = {"rigid": True}
        turning = discs * kw * a**2 * n / 4
        radial = discs * ka * r**2 if discs > 1 else r**2 / (1 / ka + 1 / ks)
    found = solved(cy.Pair(**plain, supports=supports), [20.0])
    mesh = solve(DriveValue.as_stated(cy.Pair(**plain)), [20.0], ANGLES)
    wanted = 1.0 / (1.0 / turning + 1.0 / radial + 1.0 / mesh.torsional_stiffness)
    assert found.torsional_stiffness[0] == pytest.approx(wanted[0], rel=2e-2)
    assert found.torsional_stiffness[0].mean() == pytest.approx(wanted[0].mean(), rel=5e-3)
    if discs > 1:
        assert np.abs(found.main_bearing_force).max() < 0.05
        held = discs * (n if kind == "cranks" else 1) * r * ka
        shift = np.hypot(found.disc_shift_x, found.disc_shift_y)
        assert shift.mean() == pytest.approx(20.0 / held, rel=0.02)


def made(kind, seed, discs=2):
    """A drive with errors of everything, on bearings with clearance."""
    random = np.random.default_rng(seed)
    supports = dict(CRANKS if kind == "cranks" else ROLLERS)
    supports |= {
        "turning_arm": {"rollers": 15, "roller_length": 9e-3, "clearance": 6e-6},
        "crank_shaft": {"stiffness": 3e8, "clearance": 2e-6},
        "main": {"stiffness": 1.2e9},
        "pin_seat": {"stiffness_per_width": "30 GPa"},
    }
    if kind == "output_rollers":
        supports["output_roller"] = {"stiffness": 2e8, "clearance": 6e-6}
    pair = cy.Pair(**SIZES, discs=discs, supports=supports)
    errors = {"pin_radial": random.normal(0, 1e-6, 40), "centre_distance_x": 3e-6, "eccentricity": 1e-6}
    errors["tooth_cumulative_pitch"] = random.normal(0, 1e-6, (discs, 39))
    sizes = {"hole_x": "hole", "hole_y": "hole", "crank_throw": "eccentric", "crank_phase": "eccentric"}
    sizes |= {"crank_x": "crank", "crank_y": "crank"} if kind == "cranks" else {"roller_x": "roller"}
    for name, place in sizes.items():
        scale = 1e-4 if name == "crank_phase" and kind == "cranks" else 2e-6
        errors[name] = random.normal(0, scale, pair.places[place])
    return pair.replace(errors={k: np.asarray(v).tolist() for k, v in errors.items()})


@pytest.mark.parametrize("kind", ["cranks", "output_rollers"])
def test_every_body_is_in_balance(kind):
    """Loads of pins, bearings and rollers on each disc, and the carrier's moment, from the stated forces only."""
    pair = made(kind, 3)
    found = solved(pair, [150.0], with_play=False)
    for disc in range(2):
        # Radially a disc's pins and its bearings do the same work: the crank's work equals the output's.
        assert found.pin_force[0, :, disc].sum(axis=-1).min() > 0.0
    mean = found.crank_torque[0].mean()
    assert mean == pytest.approx(150.0 / 39, rel=0.02)


@pytest.mark.parametrize(("kind", "turns"), [("cranks", 13), ("output_rollers", 39)])
def test_mean_crank_torque_is_the_ratio_over_a_whole_period(kind, turns):
    """The work that the crank does in a period is the output's: no energy is made or lost."""
    supports = {**(CRANKS if kind == "cranks" else ROLLERS), **SOFT}
    supports["turning_arm"] = {"rollers": 15, "roller_length": 9e-3, "clearance": 8e-6}
    if kind == "output_rollers":
        supports["output_roller"] = {"stiffness": 2e8, "clearance": 6e-6}
    pair = cy.Pair(**SIZES, discs=2, supports=supports)
    pitches = turns * 2.0 * np.pi / 40.0
    angles = np.linspace(0.0, pitches, 40 * turns, endpoint=False)
    found = solved(pair, [150.0], angles, with_play=False)
    assert found.crank_torque[0].mean() == pytest.approx(150.0 / 39, rel=2e-4)


@pytest.mark.parametrize("kind", ["cranks", "output_rollers"])
def test_crank_torque_is_the_energy_s_derivative(kind):
    """Virtual work at constant torque: dx/dθ at equilibrium and τ are one energy's, so dτ/dT = ∂(x - θ/z)/∂θ sign by
    sign: the torque that a load puts on the crank is how the crank moves the loaded output."""
    pair = made(kind, 4)
    step = 1e-4
    for theta in (0.3, 2.0, 4.4):
        found = solved(pair, [149.0, 151.0], np.array([theta]), with_play=False)
        by_load = (found.crank_torque[1, 0] - found.crank_torque[0, 0]) / 2.0
        around = solved(pair, [150.0], np.array([theta - step, theta + step]), with_play=False)
        by_angle = (around.transmission_error[0, 1] - around.transmission_error[0, 0]) / (2.0 * step)
        assert by_load == pytest.approx(1.0 / 39 - by_angle, abs=1e-4)


@pytest.mark.parametrize("kind", ["cranks", "output_rollers"])
def test_stiffness_is_the_slope_of_the_deviation(kind):
    pair = made(kind, 5)
    found = solved(pair, [149.5, 150.0, 150.5], ANGLES[:6], with_play=False)
    slope = 1.0 / (found.transmission_error[2] - found.transmission_error[0])
    assert found.torsional_stiffness[1] == pytest.approx(slope, rel=1e-3)


def test_mirrored_drives_mirror():
    """θ, torque, deviation, tangential errors and ψ_0 change sign; pins, teeth and cranks are counted backwards."""
    pair = made("cranks", 6, discs=1)
    errors = dict(pair.errors)

    def backwards(values):
        return [values[0], *values[:0:-1]]

    mirrored = {
        "pin_radial": backwards(errors["pin_radial"]),
        # A tooth begins at its root, so tooth i becomes the one that ends there.
        "tooth_cumulative_pitch": [[-v for v in row[::-1]] for row in errors["tooth_cumulative_pitch"]],
        "hole_x": [backwards(row) for row in errors["hole_x"]],
        "hole_y": [[-v for v in backwards(row)] for row in errors["hole_y"]],
        "crank_x": backwards(errors["crank_x"]),
        "crank_y": [-v for v in backwards(errors["crank_y"])],
        "crank_throw": [backwards(row) for row in errors["crank_throw"]],
        "crank_phase": [[-v for v in backwards(row)] for row in errors["crank_phase"]],
    }
    other = pair.replace(supports=pair.supports.replace(first_angle=-0.3), errors=mirrored)
    found, image = solved(pair, [150.0], ANGLES), solved(other, [-150.0], -ANGLES)
    assert image.transmission_error == pytest.approx(-found.transmission_error, abs=1e-5 * ARCSEC)
    assert image.backlash == pytest.approx(found.backlash, abs=1e-3 * ARCSEC)
    assert image.disc_shift_y == pytest.approx(-found.disc_shift_y, abs=1e-10)
    assert image.main_bearing_force == pytest.approx(found.main_bearing_force, abs=1e-3)


def test_turning_the_whole_drive_by_a_pin_changes_nothing():
    pair = made("cranks", 7, discs=1)
    errors, pitch = dict(pair.errors), 2.0 * math.pi / 40
    c, s = math.cos(pitch), math.sin(pitch)
    seat = errors.pop("centre_distance_x")
    turned = {**errors, "centre_distance_x": seat * c, "centre_distance_y": seat * s}
    turned["pin_radial"] = [errors["pin_radial"][-1], *errors["pin_radial"][:-1]]
    # The gear turns with the frame by one pin, its crank too: the gear's own angle is as before.
    found = solved(pair, [150.0], ANGLES, with_play=False)
    first = pair.supports.first_angle + pitch * (1.0 + 1.0 / 39)
    for x, y, out in (("hole_x", "hole_y", 1), ("crank_x", "crank_y", 0)):
        rotation = pitch * (1.0 + 1.0 / 39)
        cr, sr = math.cos(rotation), math.sin(rotation)
        vx, vy = np.array(errors[x]), np.array(errors[y])
        turned[x], turned[y] = (cr * vx - sr * vy).tolist(), (sr * vx + cr * vy).tolist()
        assert out in (0, 1)
    teeth = np.array(errors["tooth_cumulative_pitch"])
    turned["tooth_cumulative_pitch"] = np.roll(teeth, 1, axis=1).tolist()
    other = pair.replace(supports=pair.supports.replace(first_angle=first), errors=turned)
    image = solved(other, [150.0], ANGLES + pitch, with_play=False)
    assert image.transmission_error == pytest.approx(found.transmission_error, abs=1e-4 * ARCSEC)


def test_seats_and_clearances_only_soften():
    """With each further compliance the drive gives way more, by the order of the contract's table."""
    base = {**CRANKS}
    steps = [
        {},
        {"turning_arm": {"rollers": 15, "roller_length": 9e-3}},
        {"crank_shaft": {"stiffness": 3e8}},
        {"pin_seat": {"stiffness_per_width": "30 GPa"}},
        {"turning_arm": {"rollers": 15, "roller_length": 9e-3, "clearance": 10e-6}},
    ]
    last = math.inf
    for step in steps:
        base |= step
        found = solved(cy.Pair(**SIZES, discs=2, supports=base), [181.0], ANGLES)
        stiffness = found.torsional_stiffness[0].mean()
        assert stiffness < 0.99 * last
        last = stiffness


def test_a_drive_that_hangs_in_its_clearances_is_balanced():
    """A carrier with clearance in a ring that leaves much play: no other place than this takes so many steps."""
    drawn = read_pair(EXAMPLES / "drive-39-40-bearings.toml").nominal
    main = drawn.supports.main.replace(clearance=5e-6)
    pair = drawn.replace(errors={"pin_circle_radius": 22e-6}, supports=drawn.supports.replace(main=main))
    found = solved(pair, [-0.181], np.array([187 * 2.0 * np.pi / 367]), with_play=False)
    assert found.pin_force.max() > 0.1


def test_play_on_bearings_is_the_same_from_any_neighbour():
    """The balance at the play's small torque does not depend on where its search began: a near angle, a far or none."""
    pair = read_pair(EXAMPLES / "drive-39-40-bearings.toml")
    angles = np.linspace(0.0, 2.0 * np.pi, 360, endpoint=False)[:60]
    near, far = solved(pair, [], angles), solved(pair, [], angles[::6])
    alone = [solved(pair, [], angles[k : k + 1]) for k in range(0, 60, 12)]
    for name in ("play_low", "play_high"):
        wanted = getattr(near, name)
        assert getattr(far, name) == pytest.approx(wanted[::6], abs=1e-4 * ARCSEC)
        assert np.concatenate([getattr(one, name) for one in alone]) == pytest.approx(wanted[::12], abs=1e-4 * ARCSEC)


@pytest.mark.slow(6)
def test_contact_lines_lie_where_the_discs_then_stand():
    """Rigid bearings have those of the rigid drive; on bearings they add up to the pins' forces, by any threads."""
    pair = cy.Pair(**SIZES, discs=2, supports={"kind": "cranks", "count": 3, "circle_radius": "36 mm"})
    angles = np.linspace(0.0, 0.3, 66)
    bare = pair.replace(supports=None)
    known = solve(DriveValue.as_stated(bare), [150.0], angles, 3, with_play=False, with_elements=True)
    rigid = solve(DriveValue.as_stated(pair), [150.0], angles, 3, with_play=False, with_elements=True)
    assert rigid.slice_force == pytest.approx(known.slice_force, rel=1e-3, abs=0.5)
    assert rigid.slice_direction == pytest.approx(known.slice_direction, abs=1e-5)
    assert rigid.gear_element_pressure == pytest.approx(known.gear_element_pressure, rel=1e-3, abs=2e6)
    assert rigid.pin_element_pressure == pytest.approx(known.pin_element_pressure, rel=1e-3, abs=2e6)
    soft = made("cranks", 2)
    found = [
        solve(DriveValue.as_stated(soft), [150.0, -20.0], angles, 3, with_elements=True, workers=workers)
        for workers in (1, 2)
    ]
    assert found[0].slice_force.sum(axis=-1) == pytest.approx(found[0].pin_force, rel=1e-5)
    for load in range(2):
        largest = found[0].max_contact_pressure[load].max()
        assert 0.9 * largest < found[0].pin_element_pressure[load].max() <= (1.0 + 1e-9) * largest
    for name in ("slice_force", "slice_direction", "gear_element_pressure", "pin_element_pressure"):
        assert (getattr(found[0], name) == getattr(found[1], name)).all()


def test_a_pin_passes_a_root_between_unlike_teeth_without_a_jump():
    """It is on one of the two at any time; on both, or on none, floating discs moved the output by 3.7 arcsec."""
    generator, drawn = np.random.default_rng(0), cy.Pair(**SMALL, face_width=0.012, rated_torque=200.0)
    floating, surface = on_bearings(drawn, random_drive(drawn, generator, 0.3e-6)[0])
    angles = -89.53944349327529 + np.arange(-5e-3, 5e-3, 1e-4)
    for pair in (floating, drawn):
        place = solve(DriveValue(pair, surface), [-60.0], angles, with_play=False).transmission_error[0]
        assert np.abs(np.diff(place)).max() < 0.1 * ARCSEC


@pytest.mark.parametrize(("example", "column"), [("drive-39-40-bearings", 2), ("rv-20e-bearings", 3)])
def test_stiffness_of_the_examples_is_the_theory_page_s(example, column):
    """Every number of the page's table, including the remainder to the catalogue's stiffness."""
    page = (EXAMPLES.parent / "docs" / "theory" / "supports.md").read_text(encoding="utf-8")
    lines = page.split("| with one part more")[1].splitlines()
    rows = [[cell.strip() for cell in line.split("|")] for line in lines[2:] if line.startswith("|")]
    drive, arcmin = cy.read_drive(EXAMPLES / f"{example}.toml"), edge.unit_scale("N*m/arcmin", "N*m/rad")
    shares = drive.compliance()
    each = [one.compliance for one in shares]
    stiffness = [f"{1.0 / soft / arcmin:.0f}" for soft in np.cumsum(each)]
    assert [row[column] for row in rows] == [*stiffness, *(["–", "–", "–"] if column == 2 else ["–", "49"])]
    if (catalogue := drive.pair.supports.catalogue_stiffness) is not None:
        each += [remaining(drive.pair.supports, shares), 1.0 / catalogue]
        assert [row[4] for row in rows] == [f"{soft * 1e6:.3f}" for soft in each]
        assert [row[5] for row in rows[:-1]] == [f"{soft * catalogue:.1%}".replace("%", " %") for soft in each[:-1]]


def test_two_cranks_with_clearance_make_order_80_and_three_do_not():
    """Order 80 of the crank in the output, without any error, as the contract states."""
    angles = np.linspace(0.0, 2.0 * np.pi * 39, 39 * 240, endpoint=False)
    found = []
    for count in (2, 3):
        supports = {**CRANKS, "count": count, "turning_arm": {"rollers": 15, "roller_length": 9e-3, "clearance": 8e-6}}
        pair = cy.Pair(**SIZES, discs=2, supports={**supports, "crank_shaft": {"stiffness": 3e8}})
        te = solved(pair, [181.0], angles, with_play=False).transmission_error[0]
        spectrum = np.abs(np.fft.rfft(te)) * 2.0 / te.size
        # In turns of the carrier: the angle spans 39 crank turns, one of the output.
        found.append(spectrum[80] / ARCSEC)
    assert found[0] > 10.0 * found[1]


SUPPORTED = """format = "cycloid-pair/1"
[pair]
gear_teeth = 39
pin_circle_radius = "64 mm"
pin_radius = "3 mm"
eccentricity = "1.3 mm"
face_width = "10 mm"
rated_torque = "181 N*m"
[supports]
kind = "cranks"
count = 3
circle_radius = "36 mm"
"""


def test_what_is_left_out_is_rigid_and_the_text_comes_back():
    pair = parse_pair(SUPPORTED, "p.toml")
    assert pair.supports.turning_arm.is_rigid
    assert pair.supports.main.is_rigid
    for one in (pair, made("cranks", 1), made("output_rollers", 2)):
        assert parse_pair(one.text, "again") == one
        assert parse_pair(one.text, "again").text == one.text
        assert (
            cy.Drive(one).hash
            != cy.Drive(one.replace(supports=None, errors={k: 0.0 for k in ()}) if not one.errors else one.nominal).hash
        )


@pytest.mark.parametrize(
    ("more", "sentence"),
    [
        ("[supports.turning_arm]\nclearance = '3 um'", "a clearance needs a stiffness or rollers"),
        ("[supports.turning_arm]\nstiffness = '4 N/um'\nrollers = 12\nroller_length = '9 mm'", "state one of"),
        ("[supports.turning_arm]\nrollers = 12", "rollers and roller_length belong together"),
        ("[supports.turning_arm]\nstiffnes = '4 N/um'", "did you mean stiffness"),
        ("[supports.main]\nstiffness = '4 um'", "measures something else"),
        ("[errors.supports]\nhole_x = [['1 um', '0 um', '0 um']]", "turning_arm is rigid"),
        ("[errors.supports]\nroller_x = ['1 um', '0 um', '0 um']", 'supports of kind = "cranks"'),
        ("[errors]\nhole_x = [['1 um', '0 um', '0 um']]", r"hole_x belongs in \[errors.supports\]"),
        ("[errors.supports]\npin_radius = '1 um'", r"pin_radius belongs in \[errors\]"),
        ("[supports.turning_arm]\nstiffness='4 N/um'\n[errors.supports]\nhole_x = [['1 um']]", "one for each hole, 3"),
        ("[supports.output_roller]\nstiffness = '4 N/um'", 'output_roller belongs to kind = "output_rollers"'),
        ("[errors]\nmisalignment_xz = '1 mrad'", "a drive with supports is plane"),
    ],
)
def test_contradictory_supports_are_refused_in_a_sentence(more, sentence):
    with pytest.raises(edge.InputError, match=sentence) as problem:
        parse_pair(SUPPORTED + more, "p.toml")
    assert "p.toml" in str(problem.value)
    assert "\n" not in str(problem.value)


def test_a_drive_on_bearings_needs_its_rated_torque():
    pair = parse_pair(SUPPORTED, "p.toml").replace(rated_torque=None)
    with pytest.raises(edge.InputError, match="rated_torque is missing"):
        solved(pair, [100.0])


@settings(max_examples=6, deadline=None)
@given(st.integers(0, 10_000), st.sampled_from(["cranks", "output_rollers"]), st.floats(-170.0, 170.0))
def test_any_torque_of_either_sign_is_balanced_whatever_was_solved_before(seed, kind, torque):
    """A cold start at one angle and a sweep that comes there from its neighbours find the same place."""
    pair = made(kind, seed)
    torque = math.copysign(max(abs(torque), 2.0), torque)
    angles = 0.1 + 0.02 * np.arange(12)
    swept = solved(pair, [torque], angles, with_play=False)
    alone = solved(pair, [torque], angles[-1:], with_play=False)
    assert alone.transmission_error[0, 0] == pytest.approx(swept.transmission_error[0, -1], abs=1e-4 * ARCSEC)
    assert alone.pin_force[0, 0] == pytest.approx(swept.pin_force[0, -1], abs=0.05)


def swept(pair, problem, assembly, torque, angles, near=None):
    """Result of the kernel for any list of joints."""
    found = empty(pair, 1, angles.size)
    here = type(found)(*(array[0] for array in found))._replace(force=np.zeros((angles.size, assembly.joints.size)))
    work = work_of(assembly)
    if near is not None:
        here.coordinates[:] = near
    torques, lines = np.full(angles.size, torque), on_rigid.no_lines(1)
    sweep_supported(problem, assembly, angles, torques, here, work, lines, near is not None)
    return here


@pytest.mark.parametrize("kind", ["cranks", "output_rollers"])
def test_a_balance_is_the_same_wherever_its_solution_starts(kind):
    """From ideal positions, from those of another drive under another load, from far away, and from the balance."""
    pair, angles = made(kind, 11), np.array([0.4, 1.1, 3.0])
    drive = DriveValue.as_stated(pair)
    first = sensitivity(drive, 150.0, angles)
    of_another = sensitivity(DriveValue.as_stated(made(kind, 12)), 60.0, angles).coordinates
    for near in (of_another, np.full_like(of_another, 1e-4)):
        again = sensitivity(drive, 150.0, angles, near=near)
        assert again.transmission_error == pytest.approx(first.transmission_error, abs=1e-12)
        largest = np.abs(first.by_displacement).max()
        assert again.by_displacement == pytest.approx(first.by_displacement, abs=1e-6 * largest)
    of_kernel = pair, problem_of(drive), assembly_of(drive), 150.0, angles
    assert (swept(*of_kernel, near=first.coordinates).steps <= 2).all()
    assert (swept(*of_kernel).steps > 2).all()


@pytest.mark.parametrize("kind", ["cranks", "output_rollers"])
def test_sensitivities_are_differences(kind):
    """Every displacement and every bearing, against the drive solved with a little of it."""
    pair = made(kind, 11)
    angles, step = np.array([0.4, 0.42, 3.0]), 2e-9
    surface = surface_of_pair(pair)
    drive = DriveValue(pair, surface)
    found = sensitivity(drive, 150.0, angles)
    problem, assembly = problem_of(drive), assembly_of(drive)
    kinds, made_of = kinds_of(pair), displacements(pair, surface, {})

    def te(problem, assembly, torque=150.0, at=angles):
        return swept(pair, problem, assembly, torque, at).coordinates[:, 0]

    def check(by, plus, minus, scale=step):
        differences = (plus - minus) / (2.0 * scale)
        assert by == pytest.approx(differences, rel=2e-3, abs=2e-3 * np.abs(differences).max() + 1e-4)

    layout = displacement_layout(pair)
    assert found.transmission_error == pytest.approx(te(problem, assembly))
    for name in ("hole_x", "hole_y", "carrier_x", "carrier_y", "eccentric_throw", "eccentric_phase", "hole_play"):
        if name in layout:
            columns = found.by_displacement[:, layout[name]]
            most = np.abs(columns).max(axis=0).argmax()  # the place that matters most
            ends, scale = [], 1e-6 if name == "eccentric_phase" else step
            for sign in (1.0, -1.0):
                moved = made_of[name].copy()
                moved.flat[most] += sign * scale
                ends.append(te(problem, joint_list(pair, kinds, made_of | {name: moved})))
            check(columns[:, most], *ends, scale)
    for name in ("centre_x", "centre_y", "crank_throw"):
        ends = [te(problem, joint_list(pair, kinds, made_of | {name: made_of[name] + d})) for d in (step, -step)]
        check(found.by_displacement[:, layout[name]][:, 0], *ends)
    for name in ("pin_radial", "pin_tangential", "pin_radius"):
        columns = found.by_displacement[:, layout[name]]
        pin = np.abs(columns).max(axis=0).argmax()
        direction = 2.0 * np.pi * pin / 40
        ends = []
        for d in (step, -step):
            x, y, radius = problem.pin_x.copy(), problem.pin_y.copy(), problem.pin_radius.copy()
            if name == "pin_radius":
                radius[pin] += d
            else:
                turn = direction + (0.0 if name == "pin_radial" else np.pi / 2)
                x[pin], y[pin] = x[pin] + d * np.cos(turn), y[pin] + d * np.sin(turn)
            ends.append(te(problem._replace(pin_x=x, pin_y=y, pin_radius=radius), assembly))
        check(columns[:, pin], *ends)
    columns = found.by_displacement[:, layout["tooth_turn"]]
    tooth = np.abs(columns).max(axis=0).argmax()
    ends = []
    for d in (step, -step):
        turned = problem.tooth_turn.copy()
        turned.reshape(-1)[tooth] += d / 0.064
        ends.append(te(problem._replace(tooth_turn=turned), assembly))
    check(columns[:, tooth], *ends, step / 0.064)
    ends = [te(problem._replace(circle_radius=problem.circle_radius + d), assembly) for d in (step, -step)]
    check(found.by_displacement[:, layout["generating_circle_radius"]][:, 0], *ends)
    check(found.by_torque, te(problem, assembly, 150.01), te(problem, assembly, 149.99), 0.01)
    check(found.by_crank_angle, te(problem, assembly, at=angles + 1e-6), te(problem, assembly, at=angles - 1e-6), 1e-6)
    for at, kind_of_joint in enumerate(kinds):
        if kind_of_joint.size == 0:
            continue
        law = kind_of_joint.law
        stiffer = [law._replace(stiffness=law.stiffness * math.exp(d)) for d in (1e-3, -1e-3)]
        looser = [law._replace(half_clearance=law.half_clearance + 0.5 * d) for d in (step, -step)]
        for column, laws, scale in ((2 * at, stiffer, 1e-3), (2 * at + 1, looser, step)):
            others = [[*kinds[:at], dataclasses.replace(kind_of_joint, law=one), *kinds[at + 1 :]] for one in laws]
            # The main bearing has no clearance to take from.
            if kind_of_joint.name != "main" or column == 2 * at:
                check(found.by_bearing[:, column], *(te(problem, joint_list(pair, o, made_of)) for o in others), scale)


def with_other_joints(kind):
    """A drive with two kinds of joints that no file has: a second main bearing of balls, and output pins."""
    pair, at = made(kind, 5, discs=1), np.array([0.2, 1.9, 4.1])
    seat = {"outer_x": ("centre_x",), "outer_y": ("centre_y",)}
    balls = Kind("balls", linear(4e10, 1e-6, 1.5), {}, HOUSING, CARRIER, errors=seat)
    places = {"place_x": 0.02 * np.cos(at), "place_y": 0.02 * np.sin(at), "reach": pair.eccentricity}
    errors = {"outer_x": 1e-6, "inner_y": [2e-6, 0.0, -1e-6]}
    pins = Kind("pins", linear(2e9, 2e-6, 10 / 9), {"pin": 3}, FIRST_DISC_BODY, CARRIER, places | errors)
    surface = surface_of_pair(pair)
    return pair, [*kinds_of(pair), balls, pins], displacements(pair, surface, {}), problem_of(DriveValue(pair, surface))


@pytest.mark.parametrize("kind", ["cranks", "output_rollers"])
def test_a_new_kind_of_joint_is_one_definition(kind):
    """It carries, its bodies stay in balance, and its sensitivities are differences."""
    pair, kinds, displaced, problem = with_other_joints(kind)
    assembly, angles, step = joint_list(pair, kinds, displaced), np.array([0.4, 0.42, 3.0]), 2e-9
    found = swept(pair, problem, assembly, 150.0, angles)
    bare = swept(pair, problem, joint_list(pair, kinds[:-2], displaced), 150.0, angles)
    assert (found.stiffness > 1.01 * bare.stiffness).all()
    force = {one.name: values for one, values in by_kind(kinds, found.force)}
    assert force["balls"].min() > 10.0
    assert force["pins"].max() > 100.0
    # The two main bearings displace alike and share the load by their laws, whatever these are.
    length = np.hypot(*(found.coordinates[:, 1:3] - [displaced["centre_x"], displaced["centre_y"]]).T)
    assert force["balls"] == pytest.approx(4e10 * (length - 0.5e-6) ** 1.5, rel=1e-6)
    assert force["main"] == pytest.approx(1.2e9 * length, rel=1e-6)

    by = no_derivatives(pair, assembly, 3)
    by_joint, by_angle, by_torque = by.by_joint, by.by_angle, by.by_torque
    work, torques = work_of(assembly), np.full(3, 150.0)
    assert sweep_supported_sensitivities(problem, assembly, angles, torques, found.coordinates, by, work)

    def te(change=0.0, **changed):
        """Transmission error with a joint's or law's field of all new joints changed."""
        other = assembly._replace(joints=assembly.joints.copy(), laws=assembly.laws.copy())
        for field, value in changed.items():
            records = other.laws if field in LAW.names else other.joints
            new = slice(-2, None) if field in LAW.names else other.joints["law"] >= len(kinds) - 2
            records[field][new] = value(records[field][new])
        return swept(pair, problem, other, 150.0 + change, angles).coordinates[:, 0]

    new = assembly.joints["law"] >= len(kinds) - 2
    for at, name in enumerate(PARAMETERS[:7]):
        if name not in ("throw", "phase"):
            ends = [te(**{name: lambda v, d=d: v + d}) for d in (step, -step)]
            wanted = (ends[0] - ends[1]) / (2.0 * step)
            assert by_joint[:, new, at].sum(axis=1) == pytest.approx(wanted, rel=1e-4, abs=1e-4)
    ends = [te(stiffness=lambda v, d=d: v * math.exp(d)) for d in (1e-3, -1e-3)]
    assert by_joint[:, new, STIFFNESS].sum(axis=1) == pytest.approx((ends[0] - ends[1]) / 2e-3, rel=1e-4)
    ends = [te(half_clearance=lambda v, d=d: v + 0.5 * d) for d in (step, -step)]
    wanted = (ends[0] - ends[1]) / (2.0 * step)
    assert by_joint[:, new, CLEARANCE].sum(axis=1) == pytest.approx(wanted, rel=1e-4)
    assert by_torque == pytest.approx((te(0.01) - te(-0.01)) / 0.02, rel=1e-4)
    around = [swept(pair, problem, assembly, 150.0, angles + d).coordinates[:, 0] for d in (1e-6, -1e-6)]
    assert by_angle == pytest.approx((around[0] - around[1]) / 2e-6, rel=1e-4, abs=1e-8)


def test_a_joint_off_the_centre_needs_bodies_that_rotate_alike():
    pair, kinds, displaced, _ = with_other_joints("cranks")
    off = Kind("off", linear(1e9), {}, HOUSING, CARRIER, {"place_x": 0.01})
    with pytest.raises(ValueError, match="place_x and place_y must be 0"):
        joint_list(pair, [*kinds, off], displaced)


@pytest.mark.parametrize("kind", ["cranks", "output_rollers"])
def test_every_joint_is_its_energy_s_gradient(kind):
    """Forces, stiffnesses and the crank's torque of any joint, at a place that is no balance."""
    pair, kinds, displaced, _ = with_other_joints(kind)
    assembly, random = joint_list(pair, kinds, displaced), np.random.default_rng(7)
    drawn, theta, n = random.normal(0.0, 2e-5, assembly.unknowns), 0.7, assembly.unknowns
    work, step, pressed = work_of(assembly), 1e-9, set()
    for joint, q in itertools.product(assembly.joints, (drawn, -drawn)):

        def state(q, theta=theta, joint=joint):
            work.coordinates[:] = q
            orient(assembly, theta, work)
            d = displacement(assembly, joint, work)
            acting, count, force, turned = (
                reaction(assembly, joint, d, 10.0),
                derivatives(assembly, joint, d, work),
                *np.zeros((2, n)),
            )
            by = np.array([d.normal_x, d.normal_y]) @ work.by[:, :count]
            np.add.at(force, work.indices[:count], acting.force * by)
            rate = add_turning(assembly, joint, d, acting, work, count, turned)
            return stored_energy(assembly, joint, d, 10.0), force, rate, turned, acting.force

        _, force, rate, turned, size = state(q)
        if size > 1.0:
            pressed.add(kinds[joint.law].name)
        ends = [[state(q + d * unit) for d in (step, -step)] for unit in np.eye(n)]
        gradient = np.array([plus[0] - minus[0] for plus, minus in ends]) / (2.0 * step)
        assert force == pytest.approx(gradient, rel=1e-5, abs=1e-5 * max(size, 1.0))
        ahead, behind = state(q, theta + 1e-6), state(q, theta - 1e-6)
        assert rate == pytest.approx((ahead[0] - behind[0]) / 2e-6, rel=1e-5, abs=1e-7 * max(size, 1.0))
        assert turned == pytest.approx((ahead[1] - behind[1]) / 2e-6, rel=1e-5, abs=1e-5 * max(size, 1.0))
    assert pressed == {kind.name for kind in kinds if kind.size}


@pytest.mark.parametrize("kind", ["cranks", "output_rollers"])
def test_a_drive_with_other_joints_stores_what_its_flanges_did(kind):
    """The energy's differences between two prescribed flanges are their torques, with any kind of joint."""
    pair, kinds, displaced, problem = with_other_joints(kind)
    assembly = joint_list(pair, kinds, displaced)
    work = work_of(assembly)
    box = energy.held(problem, assembly, work)

    def stood(theta, flange):
        found = np.zeros(energy.FOUND)
        pull = Load(0.0, 1e8, flange, 10.0)
        assert energy.stand(box, theta, pull, contact_rows(problem), True, found)
        return found

    for theta in (0.3, 2.2):
        here, step = stood(theta, 1e-3), 1e-7
        by_flange = (stood(theta, 1e-3 + step)[energy.ENERGY] - stood(theta, 1e-3 - step)[energy.ENERGY]) / (2 * step)
        assert here[energy.BY_FLANGE] == pytest.approx(by_flange, rel=1e-5)
        # The flange is held at an angle φ_b = flange - θ/z.
        ends = [stood(theta + d, 1e-3 + d / pair.gear_teeth)[energy.ENERGY] for d in (1e-5, -1e-5)]
        assert here[energy.BY_ANGLE] == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-4, abs=1e-4)


def test_a_drive_s_sensitivity_knows_its_bearings():
    drive = cy.Drive(made("cranks", 11))
    by = drive.sensitivity(150.0, ["pin_circle_radius", "turning_arm_clearance"], angles=24)
    wider = drive.pair.supports.turning_arm.replace(clearance=6.02e-6)
    other = drive.replace(supports=drive.pair.supports.replace(turning_arm=wider))
    angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
    change = [solved(d.pair, [150.0], angles, with_play=False).transmission_error[0] for d in (drive, other)]
    assert by.sel(error="turning_arm_clearance").values == pytest.approx((change[1] - change[0]) / 2e-8, rel=0.05)
    with pytest.raises(edge.ArgumentError, match="profile"):
        drive.sensitivity(150.0, ["profile_deviation_1"])


def test_a_tolerance_study_draws_errors_of_holes_and_cranks():
    """Each drive of a study is the drive that analyze solves; a part that a pair lacks can't have a tolerance."""
    supports = {**CRANKS, **SOFT}
    drive = cy.Drive(cy.Pair(**SIZES, discs=2, supports=supports))
    tolerances = cy.Tolerances(hole_x={"tolerance": "5 um"}, crank_phase={"tolerance": "0.3 mrad"})
    found = drive.study(tolerances, [100.0], samples=8, seed=3, angles=41, workers=1)
    made_one = drive.sample(tolerances, seed=3)
    assert np.ptp(made_one.surface.hole_x) > 1e-6
    assert np.abs(made_one.surface.crank_phase).max() <= 3e-4
    spread = found.result.figure("angular_transmission_error")
    drawn = np.ptp(drive.analyze(100.0, angles=41)["transmission_error"].values)
    # Errors of ± 5 µm on 36 mm make some arcseconds; the drive as drawn has only the ripple of its mesh.
    assert np.median(spread) > 4.0 * drawn
    rigid = cy.Drive(cy.Pair(**SIZES))
    with pytest.raises(edge.InputError, match="no supports"):
        rigid.sample(tolerances, seed=1)
