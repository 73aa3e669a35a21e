import dataclasses
import math
import os
import subprocess
import sys

import numba
import numpy as np
import pytest
import second_drive
import tilted_gear
from common import ARCSEC, CASES, EXAMPLES, PAIR, make_pair
from hypothesis import given, settings
from hypothesis import strategies as st

from cycloid_fmu import contact, edge
from cycloid_fmu.analysis import error_sensitivity, notes, sensitivity, solve, step_notes
from cycloid_fmu.analysis.validity import tilt_error
from cycloid_fmu.contact import compiling, internals
from cycloid_fmu.contact.deviations import Facing, added_curvature
from cycloid_fmu.contact.transmission import rigid_problem
from cycloid_fmu.drive import Drive, read_drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.errors.kinds import structured_names
from cycloid_fmu.geometry import ANGLES
from cycloid_fmu.geometry.pair import parse_pair, read_pair, write_pair
from cycloid_fmu.surfaces.files import write_surface
from cycloid_fmu.surfaces.structured import structured_value, with_structured
from cycloid_fmu.surfaces.surface import nominal_surface, surface_of_pair

STEEL = (1 - 0.3**2) / 206e9


@given(
    force=st.floats(1e-3, 2e4),
    curvature=st.floats(-330.0, 500.0),
    radius=st.floats(1e-3, 2e-2),
    width=st.floats(1e-3, 5e-2),
    ratio=st.floats(0.3, 3.0),
    guess=st.sampled_from([0.0, 1.0, 1e4]),
)
def test_force_and_approach_are_inverse(force, curvature, radius, width, ratio, guess):
    """The papers' δ(F), written out here, and the kernel's F(δ)."""
    if 1 / radius + curvature < 1.0 or abs(curvature) < 1e-3:
        return
    gear, pin = STEEL, ratio * STEEL
    equivalent = 1 / (1 / radius + curvature)
    half = math.sqrt(4 * force * equivalent * (gear + pin) / (math.pi * width))
    if half > 0.1 * min(radius, 1 / abs(curvature)):
        return  # far outside Hertz's assumptions
    log_radius = min(1 / abs(curvature), 0.064)
    approach = (2 * force / (math.pi * width)) * (
        gear * (math.log(4 * log_radius / half) - 0.5) + pin * (math.log(4 * radius / half) - 0.5)
    )
    found, stiffness, _ = contact.hertz(approach, curvature, radius, width, gear, pin, 0.064, guess)
    assert found == pytest.approx(force, rel=1e-10)
    assert contact.half_width(found, curvature, radius, width, gear, pin) == pytest.approx(half, rel=1e-9, abs=0.0)
    step = 1e-5 * approach
    ends = [contact.hertz(approach + s, curvature, radius, width, gear, pin, 0.064, 0.0)[0] for s in (-step, step)]
    assert stiffness == pytest.approx((ends[1] - ends[0]) / (2 * step), rel=1e-6)


def test_force_grows_without_end():
    """Beyond the law's validity the force is continued, so that the search for an equilibrium always ends."""
    approach = np.geomspace(1e-9, 1.0, 400)
    force = [contact.hertz(a, 100.0, 3e-3, 1e-2, STEEL, STEEL, 0.064, 0.0)[0] for a in approach]
    assert (np.diff(force) > 0).all()


def test_moment_arm_of_the_ideal_pair():
    """L = e z_c sin φ/S."""
    drive = rigid_problem(DriveValue(make_pair(), nominal_surface(make_pair())))
    contacts = contact.contact_rows(drive)
    theta = 0.3
    contact.place_contacts(drive, theta, 0.0, contacts, True, np.inf, np.inf)
    phi = 2 * np.pi * np.arange(40) / 40 - theta
    k = 1.3 * 40 / 64
    arm = 1.3e-3 * 39 * np.sin(phi) / np.sqrt(1 + k * k - 2 * k * np.cos(phi))
    assert contacts["arm"][::2] == pytest.approx(arm, abs=1e-12)


@pytest.mark.parametrize("output", ["gear", "ring"])
@pytest.mark.parametrize("cold", [True, False])
def test_arms_on_teeth_that_pitch_errors_turn_are_the_fall_of_their_gaps(output, cold):
    """-∂g/∂x and ∂g/∂θ by differences; a ring's arm is about its own centre, seen from the tooth as the pin is."""
    _, drive, rows = drive_and_rows("errors-39-40", output)
    turned = np.random.default_rng(4).uniform(-2e-4, 2e-4, drive.tooth_turn.shape)  # 13 µm
    drive, theta, x, step = drive._replace(tooth_turn=turned), 0.3, 1e-4, 2e-7

    def placed(theta, x, field="gap"):
        contact.place_contacts(drive, theta, x, rows, cold, math.inf, math.inf)
        return rows[field][::2].copy()

    contact.place_contacts(drive, theta, x, rows, True, math.inf, math.inf)
    arm, by_crank = placed(theta, x, "arm"), placed(theta, x, "gap_by_crank")
    fall = (placed(theta, x - step) - placed(theta, x + step)) / (2.0 * step)
    rise = (placed(theta + step, x) - placed(theta - step, x)) / (2.0 * step)
    assert np.abs(arm).max() > 0.03
    assert arm == pytest.approx(fall, abs=1e-8)
    assert by_crank == pytest.approx(rise, abs=1e-8)


def test_linear_check_of_the_load_sharing():
    """Equal stiffness: F_i = T L_i/Σ L² over the pushing pins, with 20 pins at crank angle 0.3 rad.

    2.560 N for each N·m belong to e = 1.0 mm, 1.974 N to 1.3 mm.
    """
    for eccentricity, peak in (("1.0 mm", 2.560), ("1.3 mm", 1.974)):
        pair = make_pair(eccentricity=eccentricity)
        drive = rigid_problem(DriveValue(pair, nominal_surface(pair)))
        contacts = contact.contact_rows(drive)
        contact.place_contacts(drive, 0.3, 0.0, contacts, True, np.inf, np.inf)
        arm = contacts["arm"][::2]
        arm = arm[arm > 0]
        assert arm.size == 20
        assert (arm / (arm**2).sum()).max() == pytest.approx(peak, abs=5e-4)


@pytest.mark.parametrize("output", ["gear", "ring"])
@pytest.mark.parametrize(
    ("case", "slices"),
    [("errors-39-40", 1), ("two-discs-39-40", 1), ("misaligned-31-32", 5), ("interference-21-22", 1)],
)
def test_sensitivities_are_the_derivatives(case, slices, output):
    text = (CASES / f"{case}.toml").read_text().replace("[pair]", f'[pair]\noutput = "{output}"')
    pair = parse_pair(text, case)
    surface = surface_of_pair(pair)
    names = structured_names((1, 2, 3))
    angles = np.random.default_rng(1).uniform(0.0, 200.0, 6)
    _, jacobian = error_sensitivity(DriveValue(pair, surface), -150.0, angles, names, slices)
    found = sensitivity(DriveValue(pair, surface), -150.0, angles, slices)

    def deviation(surface, torque=-150.0, angles=angles):
        return solve(DriveValue(pair, surface), torque, angles, slices, with_play=False).transmission_error[0]

    for column, name in enumerate(names):
        if name.startswith("misalignment") and slices == 1:
            assert not jacobian[:, column].any()
            continue
        step = 4e-7 if name.startswith("misalignment") else 4e-9
        value = structured_value(surface, name)
        ends = [deviation(with_structured(surface, {name: value + s})) for s in (-step, step)]
        wanted = (ends[1] - ends[0]) / (2 * step)
        assert jacobian[:, column] == pytest.approx(wanted, abs=2e-3 * np.abs(wanted).max()), name
    by_angle = (deviation(surface, angles=angles + 1e-7) - deviation(surface, angles=angles - 1e-7)) / 2e-7
    assert found.by_crank_angle == pytest.approx(by_angle, abs=2e-3 * np.abs(by_angle).max())
    by_torque = (deviation(surface, -149.99) - deviation(surface, -150.01)) / 0.02
    assert found.by_torque == pytest.approx(by_torque, rel=1e-4)


@pytest.mark.parametrize(
    ("case", "output"), [("error-free-39-40", "gear"), ("errors-39-40", "gear"), ("errors-39-40", "ring")]
)
def test_forces_balance_the_torque_and_the_crank_gets_the_power(case, output):
    """Σ F L = T at each angle; over a whole turn of the output the crank's work is what the output takes, T Δφ_b.

    It is so to 3e-4: a pin loads and unloads at different curvatures of the flank, so Hertz's force has no potential.
    """
    pair = parse_pair((CASES / f"{case}.toml").read_text().replace("[pair]", f'[pair]\noutput = "{output}"'), case)
    drive = rigid_problem(DriveValue.as_stated(pair))
    contacts = contact.contact_rows(drive)
    x, cold, work = 0.0, True, 0.0
    angles = np.linspace(0.0, 2 * np.pi * abs(pair.ratio), 39 * 300, endpoint=False)
    for theta in angles:
        x, _ = contact.equilibrium(drive, theta, 120.0, x, contacts, cold)
        cold = False
        balance = contacts["force"] @ contacts["arm"]
        assert balance == pytest.approx(120.0, rel=1e-6)
        work += contact.crank_side(drive, theta, x, contacts)[0] * (angles[1] - angles[0])
    assert work == pytest.approx(-120.0 * 2 * np.pi * np.sign(pair.ratio), rel=5e-4)


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    size=st.floats(0.0, 5e-6),
    clearance=st.floats(2e-5, 1e-4),
    torque=st.floats(1.0, 500.0),
    sign=st.sampled_from([-1.0, 1.0]),
    teeth=st.integers(6, 120),
)
def test_any_pair_balances_from_any_start(seed, size, clearance, torque, sign, teeth):
    """Warm or cold, forwards or backwards through the crank angles: the same equilibrium.

    Only where pins clear the roots: a pin forced into a root between two displaced teeth has several solutions.
    """
    pair = make_pair(
        gear_teeth=teeth,
        pins=teeth + 1,
        eccentricity=f"{0.7 * 64 / (teeth + 1):.6f} mm",
        pin_radius=f"{0.4 * 64 / (teeth + 1):.6f} mm",
    )
    rng = np.random.default_rng(seed)
    surface = dataclasses.replace(
        nominal_surface(pair),
        pin_radial=rng.normal(0.0, size, teeth + 1),
        pin_tangential=rng.normal(0.0, size, teeth + 1),
        tooth_cumulative_pitch=rng.normal(0.0, 0.3 * size, (1, teeth)),
        centre_distance_x=rng.normal(0.0, size),
        pin_radius=-clearance,
    )
    angles = rng.uniform(0.0, 2 * np.pi) + np.linspace(0.0, 0.4, 12)
    there = solve(DriveValue(pair, surface), sign * torque, angles)
    back = solve(DriveValue(pair, surface), sign * torque, angles[::-1])
    alone = [
        solve(DriveValue(pair, surface), sign * torque, a, with_play=False).transmission_error[0, 0] for a in angles
    ]
    assert there.transmission_error[0] == pytest.approx(back.transmission_error[0, ::-1], abs=1e-9)
    assert there.transmission_error[0] == pytest.approx(alone, abs=1e-9)
    assert (np.isnan(there.backlash) == (there.interference > 0)).all()
    free = ~np.isnan(there.backlash)
    assert (there.backlash[free] >= 0.0).all()
    assert there.backlash[free] == pytest.approx(back.backlash[::-1][free], abs=1e-9)
    if sign > 0:
        assert (there.transmission_error[0][free] >= there.play_high[free] - 1e-10).all()


@settings(max_examples=60, deadline=None, derandomize=True)  # one draw in some 200 is as the two drives below
@given(
    seed=st.integers(0, 10**6),
    teeth=st.integers(6, 120),
    k=st.floats(0.3, 0.92),
    size=st.floats(1e-6, 1e-4),
    step=st.floats(1e-3, 0.3),
    sign=st.sampled_from([-1.0, 1.0]),
    output=st.sampled_from(["gear", "ring"]),
)
def test_a_pin_left_as_it_was_stands_clear(seed, teeth, k, size, step, sign, output):
    """From crank angle to crank angle: every pin that was not solved again has a gap above the bound, solved afresh."""
    _assert_left_pins_clear(seed, teeth, k, size, step, sign, output)


@pytest.mark.xfail(
    strict=True,
    reason="with errors of 60 µm and more a pin may overlap the edge of two teeth; which "
    "of them it is solved on then depends on the start",
)
@pytest.mark.parametrize(
    "drawn",
    [
        (24126, 29, 0.90625, 6.0321692817514744e-05, 0.15625, -1.0, "gear"),
        (0, 106, 0.875, 8.367794352741115e-05, 0.25, -1.0, "ring"),
    ],
)
def test_a_pin_that_overlaps_the_edge_of_two_teeth_has_one_gap(drawn):
    _assert_left_pins_clear(*drawn)


def _assert_left_pins_clear(seed, teeth, k, size, step, sign, output):
    pair = make_pair(
        gear_teeth=teeth,
        pins=teeth + 1,
        eccentricity=f"{k * 64 / (teeth + 1):.6f} mm",
        output=output,
        pin_radius=f"{0.4 * 64 / (teeth + 1):.6f} mm",
    )
    rng = np.random.default_rng(seed)
    scalars = ("centre_distance_x", "eccentricity", "pin_circle_radius", "pin_radius", "offset", "isometric")
    surface = dataclasses.replace(
        nominal_surface(pair),
        pin_radial=rng.normal(0.0, size, teeth + 1),
        pin_tangential=rng.normal(0.0, size, teeth + 1),
        tooth_cumulative_pitch=rng.normal(0.0, size, (1, teeth)),
        **{name: rng.normal(0.0, size) for name in scalars},
    )
    drive = rigid_problem(DriveValue(pair, surface))
    kept, anew = contact.contact_rows(drive), contact.contact_rows(drive)
    theta, x, clear = rng.uniform(0.0, 40.0), rng.normal(0.0, 50.0 * size), 5e-7
    contact.place_contacts(drive, theta, x, kept, True, math.inf, math.inf)
    for i in range(30):
        if i % 5 == 4:
            x += rng.normal(0.0, 5e-3)  # a flange that is thrown about
        else:
            theta += sign * step * rng.uniform(0.5, 1.0)
            x += rng.normal(0.0, size)
        contact.place_contacts(drive, theta, x, kept, False, clear, math.inf)
        contact.place_contacts(drive, theta, x, anew, True, math.inf, math.inf)
        smallest = np.minimum(anew["gap"][::2], anew["gap"][1::2])
        left = (kept["crank_angle"][::2] != theta) | (kept["transmission_error"][::2] != x)
        assert (smallest[left] > 0.8 * clear).all()  # by rotation a gap is foretold to second order
        solved = ~left & (smallest < clear)
        again = np.minimum(kept["gap"][::2], kept["gap"][1::2])[solved]
        assert again == pytest.approx(smallest[solved], abs=1e-12)


@pytest.mark.parametrize("output", ["gear", "ring"])
@pytest.mark.parametrize("case", ["errors-39-40", "interference-21-22"])
def test_an_equilibrium_s_contacts_are_those_solved_at_its_deviation(case, output):
    """Its last steps move the contacts by their rates; some pins are on the edge between two teeth here."""
    text = (CASES / f"{case}.toml").read_text().replace("[pair]", f'[pair]\noutput = "{output}"')
    pair = parse_pair(text, case)
    drive = rigid_problem(DriveValue.as_stated(pair))
    rows, solved = contact.contact_rows(drive), contact.contact_rows(drive)
    edges = 0
    for theta in np.linspace(0.0, 44.0, 800):
        x, _ = contact.equilibrium(drive, theta, -120.0, 0.0, rows, True)
        x, _ = contact.equilibrium(drive, theta, -120.0, x + 4e-7, rows, False)
        contact.place_contacts(drive, theta, x, solved, True, math.inf, math.inf)
        held = (rows["force"] > 0.0) & np.isfinite(solved["gap"])
        # Where the ring turns, arms leave out that a tooth with a pitch error turns the gear's centre.
        assert rows["gap"][held] == pytest.approx(solved["gap"][held], abs=2e-14 if output == "gear" else 2e-13)
        assert rows["arm"][held] == pytest.approx(solved["arm"][held], abs=1e-8)
        tooth = rows["profile_parameter"][held] * drive.teeth / (2.0 * np.pi)
        edges += int((np.abs(tooth - np.rint(tooth)) < 1e-6).sum())
    assert edges > 0 or case == "errors-39-40"


@pytest.mark.parametrize("output", ["gear", "ring"])
def test_the_derivative_by_a_larger_flank_is_exact(output):
    """No contact comes or goes within the differences, which are of fifth order."""
    pair, _, _ = drive_and_rows("errors-39-40", output)
    surface, angles, step = surface_of_pair(pair), np.random.default_rng(1).uniform(0.0, 200.0, 6), 4e-8
    _, jacobian = error_sensitivity(DriveValue(pair, surface), -150.0, angles, ["offset"])
    value = structured_value(surface, "offset")
    at = [
        solve(
            DriveValue(pair, with_structured(surface, {"offset": value + i * step})),
            -150.0,
            angles,
            with_play=False,
        ).transmission_error[0]
        for i in (-2, -1, 1, 2)
    ]
    assert jacobian[:, 0] == pytest.approx((at[0] - 8 * at[1] + 8 * at[2] - at[3]) / (12 * step), rel=3e-5)


def test_curvature_between_two_elements_is_linear():
    pair = parse_pair(PAIR, "pair.toml")
    curvature = np.random.default_rng(0).normal(0.0, 1.0, (1, 39, 8, 1))
    flat, round_pins = np.zeros_like(curvature), np.zeros((40, 12, 1))
    surface = dataclasses.replace(
        nominal_surface(pair),
        gear_deviation=flat,
        gear_curvature=curvature,
        pin_deviation=round_pins,
        pin_curvature=round_pins,
    )
    deviations = rigid_problem(DriveValue(pair, surface)).deviations
    for i in range(1, 8):
        alpha = 0.3 * deviations.flank_alpha[i] + 0.7 * deviations.flank_alpha[i + 1]
        found = added_curvature(deviations, Facing(0, 0, 5, 0, 0.0, 0.0, 1.0, 0.0), alpha, 0.0)
        assert found == pytest.approx(0.3 * curvature[0, 5, i - 1, 0] + 0.7 * curvature[0, 5, i, 0], abs=1e-9)


FLANGES = pytest.mark.parametrize(
    ("case", "output"),
    [
        ("errors-39-40", "gear"),
        ("errors-39-40", "ring"),
        ("two-discs-39-40", "gear"),
        ("interference-21-22", "ring"),
        ("pins that are too small", "gear"),
    ],
)
SMALL_PINS = PAIR + '[errors]\npin_radius = "-8 um"\n'


def drive_and_rows(case, output):
    text = SMALL_PINS if case == "pins that are too small" else (CASES / f"{case}.toml").read_text()
    pair = parse_pair(text.replace("[pair]", f'[pair]\noutput = "{output}"'), case)
    drive = rigid_problem(DriveValue.as_stated(pair))
    return pair, drive, contact.contact_rows(drive)


@FLANGES
@pytest.mark.parametrize("compliance", [0.0, 1e-6])
def test_torques_of_both_flanges_are_derivatives_of_the_stored_energy(case, output, compliance):
    """And a drive behind a compliance is wound up by the torque through it."""
    pair, drive, rows = drive_and_rows(case, output)
    for theta, flange in ((0.7, 4e-4), (41.3, -5e-4)):

        def pressed(theta=theta, flange=flange):
            return contact.press(drive, theta, flange, compliance, 0.0, rows, True)

        x, _, energy, by_angle, by_flange = pressed()
        d, turn = 1e-7, 1e-5
        assert by_flange == pytest.approx(
            (pressed(flange=flange + d)[2] - pressed(flange=flange - d)[2]) / (2 * d), rel=1e-5
        )
        # At a held deviation the output turns with the crank by the ratio.
        assert by_angle + by_flange / pair.ratio == pytest.approx(
            (pressed(theta=theta + turn)[2] - pressed(theta=theta - turn)[2]) / (2 * turn), abs=1e-5 * abs(by_angle)
        )
        assert flange - x == pytest.approx(compliance * by_flange, abs=1e-12)
        assert energy > 0.0
        assert energy == pytest.approx(0.5 * by_flange * flange, rel=0.9)
        # The torque of the forces leaves out that a flank's curvature changes under the pin (docs/theory/fmu.md).
        balance = rows["force"] @ rows["arm"]
        assert balance == pytest.approx(by_flange, rel=0.02)
        held, stiffness_held = contact.behind_compliance(drive, theta, flange, compliance, 0.0, rows, True)
        forces = rows["force"] @ rows["arm"]
        assert held + compliance * forces == pytest.approx(flange, abs=1e-11)
        there, stiffness_there = contact.equilibrium(drive, theta, forces, 0.0, rows, True)
        assert (there, stiffness_there) == (pytest.approx(held, abs=1e-11), pytest.approx(stiffness_held, rel=1e-4))


@pytest.mark.parametrize(("output", "inward"), [("gear", 100e-6), ("ring", 200e-6)])
def test_a_pin_that_presses_at_its_crest_does_not_hide_the_balance(output, inward):
    """One pin stands inwards into the flank: where its arm passes zero it presses, and its torque falls with rotation.

    The small torque of the lost motion is carried by another pin, whose flank is still some arcmin away.
    """
    modified = {
        "output": output,
        "material": {"gear": {"name": "printed PLA"}, "pin": {"name": "bearing steel"}},
        "modification": {"isometric": "88 um"},
        "errors": {"pin_radial": [0, 0, 0, 0, -inward]},
    }
    sizes = {"pin_circle_radius": "23 mm", "pin_radius": "5 mm", "eccentricity": "2.95 mm", "face_width": "2.5 mm"}
    pair = make_pair(pins=5, gear_teeth=4, **sizes).replace(**modified)
    drive = rigid_problem(DriveValue.as_stated(pair))
    rows = contact.contact_rows(drive)
    for theta in np.linspace(0.0, 2.0 * np.pi, 181, endpoint=False):
        for torque in (0.03, -0.03):
            _, stiffness = contact.equilibrium(drive, theta, torque, 0.0, rows, True)
            assert contact.carried(rows) == pytest.approx(torque, rel=1e-3)
            assert stiffness > 0.0


@FLANGES
def test_what_the_crank_does_at_constant_torque(case, output):
    """Its rate of the output is the equilibria's difference, and the stiffness that of two torques."""
    pair, drive, rows = drive_and_rows(case, output)

    def rest(theta, torque):
        return contact.equilibrium(drive, theta, torque, 0.0, rows, True)

    for theta, torque in ((0.7, 150.0), (41.3, -60.0)):
        turn, more = 1e-5, 1e-3 * torque
        rate = (rest(theta + turn, torque)[0] - rest(theta - turn, torque)[0]) / (2 * turn)
        slope = (rest(theta, torque + more)[0] - rest(theta, torque - more)[0]) / (2 * more)
        x, stiffness = rest(theta, torque)
        assert stiffness == pytest.approx(1.0 / slope, rel=1e-4)
        crank_torque, found = contact.crank_side(drive, theta, x, rows)
        # The deviation is the output's rotation minus the ideal motion.
        assert found - 1.0 / pair.ratio == pytest.approx(rate, abs=1e-3 * abs(1.0 / pair.ratio))
        assert crank_torque == pytest.approx(-torque / pair.ratio, rel=0.3)


@pytest.mark.parametrize(
    ("case", "output"), [("errors-39-40", "gear"), ("errors-39-40", "ring"), ("two-discs-39-40", "gear")]
)
def test_the_play_ends_where_flanks_touch(case, output):
    """Smallest gaps over a scan of rotations are 0 at both ends and more between; they move with the crank."""
    pair, drive, rows = drive_and_rows(case, output)

    def smallest(theta, x):
        contact.place_contacts(drive, theta, x, rows, True, math.inf, math.inf)
        return rows["gap"].min()

    for theta in (0.7, 41.3):
        low, high, interference = contact.play(drive, theta, 0.0, rows, True)
        assert interference == 0.0
        assert low < high
        for end in (low, high):
            assert smallest(theta, end) == pytest.approx(0.0, abs=1e-12)
        inside = [smallest(theta, x) for x in np.linspace(low, high, 9)[1:-1]]
        assert min(inside) > 0.0
        assert smallest(theta, low - 1e-6) < 0.0
        assert smallest(theta, high + 1e-6) < 0.0
        turn = 1e-6
        before, after = (contact.play(drive, theta + d, 0.0, rows, True)[:2] for d in (-turn, turn))
        for side, (first, second, end) in ((-1.0, (before[0], after[0], low)), (1.0, (before[1], after[1], high))):
            smallest(theta, end)
            rate = contact.touch_rate(drive, theta, end, rows, side)
            assert rate - 1.0 / pair.ratio == pytest.approx((second - first) / (2 * turn), abs=1e-4 / abs(pair.ratio))
    # A free flank is pushed by nothing.
    rows["gap"] = math.inf
    assert math.isnan(contact.touch_rate(drive, 0.7, 0.0, rows, 1.0))


@pytest.mark.parametrize("output", ["gear", "ring"])
@pytest.mark.parametrize(("case", "larger"), [("errors-39-40", 8e-6), ("nearly-conformal-13-14", 4e-6)])
def test_play_followed_from_angle_to_angle_is_that_of_each_angle_alone(case, larger, output):
    """Where it comes and goes too: pins larger by this interfere at some crank angles."""
    _, drive, rows = drive_and_rows(case, output)
    angles = np.linspace(0.0, 2.0 * np.pi, 73)[:-1]
    for by in (0.0, larger):
        one = drive._replace(pin_radius=drive.pin_radius + by)
        found = np.empty((3, angles.size))
        contact.sweep_play(one, angles, 0, angles.size, *found)
        assert np.isnan(found[0]).any() == (by > 0.0)
        assert np.isfinite(found[0]).any()
        alone = np.array([contact.play(one, theta, 0.0, rows, True) for theta in angles]).T
        assert found == pytest.approx(alone, rel=0.0, abs=1e-13, nan_ok=True)


def test_interference_is_told_by_its_depth():
    """Pins that are too large by more than the play: the gap that is left at the rotation where it is largest."""
    _, drive, rows = drive_and_rows("interference-21-22", "gear")
    low, high, interference = contact.play(drive, 0.7, 0.0, rows, True)
    assert math.isnan(low)
    assert math.isnan(high)

    def smallest(x):
        contact.place_contacts(drive, 0.7, x, rows, True, math.inf, math.inf)
        return rows["gap"].min()

    assert interference == pytest.approx(-max(smallest(x) for x in np.linspace(-3e-4, 3e-4, 121)), rel=0.05)


@pytest.mark.parametrize("case", ["errors-39-40", "two-discs-39-40"])
def test_load_sharing_adds_up(case):
    """Forces of the pins are the rows'; pressures are Hertz's for them, 2F/(π a b); hardly loaded ones don't count."""
    pair, drive, rows = drive_and_rows(case, "gear")
    contact.equilibrium(drive, 0.7, 200.0, 0.0, rows, True)
    force, pressure = np.zeros((pair.discs, 40)), np.zeros((pair.discs, 40))
    count, largest = contact.load_sharing(drive, rows, force, pressure)
    by_row = rows["force"].reshape(pair.discs, -1, 40, 2)
    assert force == pytest.approx(by_row.sum(axis=(1, 3)))
    assert largest == pressure.max()
    assert count == (force > 0.01 * force.max()).sum()
    disc, pin = np.unravel_index(np.argmax(force), force.shape)
    row = (disc * by_row.shape[1] * 40 + pin) * 2 + int(np.argmax(by_row[disc, 0, pin]))
    curvature, radius = rows[row]["curvature"], drive.pin_radius[pin]
    compliance = drive.compliance_gear + drive.compliance_pin
    half = math.sqrt(4 * force[disc, pin] * compliance / (math.pi * drive.slice_width * abs(1 / radius + curvature)))
    assert pressure[disc, pin] == pytest.approx(2 * force[disc, pin] / (math.pi * half * drive.slice_width), rel=1e-9)


@pytest.mark.parametrize("slices", [20, 21])
def test_slices_between_five_are_as_they_are_alone(slices):
    """Across the width of a tilted drive with many slices most clear pins are interpolated, each to 1 nm."""
    pair, _, _ = drive_and_rows("errors-39-40", "gear")
    drive = rigid_problem(DriveValue(pair, dataclasses.replace(surface_of_pair(pair), misalignment_xz=3e-4)), slices)
    together = contact.contact_rows(drive)
    contact.place_contacts(drive, 0.3, 0.0, together, True, np.inf, np.inf)
    together = together.reshape(slices, -1)
    between = np.arange(slices) * 4 % (slices - 1) > 0
    interpolated = 0
    for i in np.flatnonzero(between):
        alone = drive._replace(
            **{name: getattr(drive, name)[i : i + 1] for name in ("centre_x", "centre_y", "slice_z")}
        )
        rows = contact.contact_rows(alone)
        contact.place_contacts(alone, 0.3, 0.0, rows, True, np.inf, np.inf)
        assert together[i]["gap"] == pytest.approx(rows["gap"], abs=1e-9)
        assert together[i]["arm"][::2] == pytest.approx(rows["arm"][::2], abs=1e-6)
        interpolated += np.count_nonzero(together[i]["gap"][::2] != rows["gap"][::2])
    assert interpolated > 0.5 * drive.pin_x.size * between.sum()


@pytest.mark.parametrize("output", ["gear", "ring"])
def test_a_form_of_all_teeth_moves_the_deviation_as_its_derivative_says(output):
    pair = make_pair(PAIR + '[modification]\noffset = "-70 um"\nisometric = "-25 um"\n', output=output)
    angles, step = np.array([0.37, 1.93, 3.1]), 2e-8
    jacobian = error_sensitivity(DriveValue(pair, nominal_surface(pair)), 150.0, angles, ["profile_deviation_2"])[1][
        :, 0
    ]
    low, high = (
        solve(
            DriveValue(pair, with_structured(nominal_surface(pair), {"profile_deviation_2": d})),
            150.0,
            angles,
            with_play=False,
        ).transmission_error[0]
        for d in (-step, step)
    )
    assert jacobian == pytest.approx((high - low) / (2.0 * step), rel=2e-3)


def test_equivalent_errors():
    """Isometric as -pin radius; a centre offset as the pins' displacement by its opposite."""
    pair = read_pair(CASES / "errors-39-40.toml")
    base = surface_of_pair(pair)
    angles = np.linspace(0.0, 6.0, 40)

    def te(**changes):
        values = {n: structured_value(base, n) + d for n, d in changes.items()}
        return solve(
            DriveValue(pair, with_structured(base, values)), 120.0, angles, with_play=False
        ).transmission_error[0]

    assert te(isometric=5e-6) == pytest.approx(te(pin_radius=-5e-6), abs=5e-10)
    moved = te(pin_radial_1_cos=-5e-6, pin_tangential_1_sin=5e-6)
    assert te(centre_distance_x=5e-6) == pytest.approx(moved, abs=1e-8)
    assert te(pin_circle_radius=5e-6) == pytest.approx(te(offset=-5e-6), abs=2e-7)


def test_two_discs_cancel_an_order_one_pin_error():
    """Two discs opposite each other cancel an error that gives one disc 24″."""

    def amplitude(discs):
        pair = make_pair(PAIR + '[modification]\noffset = "-70 um"\nisometric = "-25 um"\n', discs=discs)
        surface = with_structured(nominal_surface(pair), {"pin_radial_1_cos": 1e-5})
        angles = np.linspace(0.0, 2 * np.pi, 360, endpoint=False)
        te = solve(DriveValue(pair, surface), 100.0 * discs, angles, with_play=False).transmission_error[0]
        return np.abs(np.fft.rfft(te))[1] / 180 * 648000 / np.pi

    assert amplitude(1) == pytest.approx(24.3, abs=2.5)
    assert amplitude(2) < 0.1


NOT_KEPT = bool(numba.config.DISABLE_JIT) or compiling.internals is None


@pytest.mark.skipif(NOT_KEPT, reason="nothing is compiled")
def test_views_of_angles_and_torques_do_not_compile_the_kernels_again():
    """A step between values or a read-only array is another type to the compiler: it took seconds, of every user."""
    pair = read_pair(CASES / "errors-39-40.toml")
    surface, angles, torques = surface_of_pair(pair), np.linspace(0.0, 1.0, 4), np.array([50.0, -50.0])

    def compiled(angles, torques, torque):
        solve(DriveValue(pair, surface), torques, angles)
        error_sensitivity(DriveValue(pair, surface), torque, angles, ["offset"])
        kernels = (contact.sweep, contact.sweep_sensitivities)
        return [list(kernel.dispatcher().signatures) for kernel in kernels]

    before = compiled(angles, torques, 50.0)
    fixed = np.full(2, 50.0)
    fixed.flags.writeable = False
    assert compiled(angles[::2], torques[::-1], fixed) == before


@pytest.mark.skipif(NOT_KEPT, reason="nothing is compiled")
def test_compiled_code_is_kept_until_a_file_of_the_room_changes(monkeypatch, tmp_path):
    """A kernel includes the functions that it calls in other files: without a check, changed ones give old numbers."""
    monkeypatch.setattr(numba.config, "CACHE_DIR", str(tmp_path))

    def twice(x):
        return 2.0 * x

    def loaded():
        kernel = contact.compiled(twice)
        assert kernel(3.0) == 6.0
        return sum(kernel.dispatcher().stats.cache_hits.values())

    assert [loaded(), loaded()] == [0, 1]
    monkeypatch.setattr(compiling, "SOURCES", (*compiling.SOURCES, (1, "changed.py")))
    assert [loaded(), loaded()] == [0, 1]


@pytest.mark.slow(120)
@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="nothing is compiled")
def test_numba_s_own_way_gives_the_same_numbers():
    """Where the private names of `internals` are missing, kernels are compiled by the public ones alone."""
    code = f"""
import sys
import numpy as np
from cycloid_fmu.analysis import sensitivity, solve
from cycloid_fmu.contact import compiling
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.surfaces.surface import surface_of_pair
print(compiling.internals is None, file=sys.stderr)
numbers = []
for path in ({str(CASES / "errors-39-40.toml")!r}, {str(CASES.parent / "supports-cases" / "rollers.toml")!r}):
    pair = read_pair(path)
    drive, angles = DriveValue(pair, surface_of_pair(pair)), np.linspace(0.0, 1.0, 5)
    result = solve(drive, 90.0, angles, with_play=pair.supports is None)
    by_errors = sensitivity(drive, 90.0, angles).by_displacement
    numbers += [result.transmission_error, result.max_contact_pressure, by_errors]
print(*[value.hex() for array in numbers for value in array.ravel().tolist()])
"""
    shown = []
    for plain in ("0", "1"):
        settings = {**os.environ, "CYCLOID_PLAIN_NUMBA": plain}
        run = subprocess.run([sys.executable, "-c", code], env=settings, check=True, capture_output=True, text=True)
        assert run.stderr.split()[-1] == str(plain == "1")
        shown.append([float.fromhex(word) for word in run.stdout.split()])
    assert len(shown[0]) > 1000
    scale = max(map(abs, shown[0]))
    assert shown[1] == pytest.approx(shown[0], rel=1e-9, abs=1e-12 * scale)


@pytest.mark.slow(4)
@pytest.mark.skipif(NOT_KEPT, reason="nothing is compiled")
def test_processes_that_begin_together_compile_a_kernel_once(tmp_path):
    """The first does it, the others wait for it and take it from its file."""
    lines = (
        "from cycloid_fmu.contact.hertz import hertz",
        "hertz(1e-6, 100.0, 3e-3, 0.01, 4e-12, 4e-12, 0.1)",
        "print(len(hertz.dispatcher().stats.cache_misses))",
    )
    settings = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    running = [
        subprocess.Popen([sys.executable, "-c", "; ".join(lines)], env=settings, stdout=subprocess.PIPE, text=True)
        for _ in range(3)
    ]
    assert sorted(process.communicate()[0].strip() for process in running) == ["0", "0", "1"]


@pytest.mark.slow(4)
@pytest.mark.skipif(NOT_KEPT, reason="nothing is compiled")
def test_a_process_killed_while_it_compiles_holds_up_no_other(tmp_path):
    settings = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    call = "from cycloid_fmu.contact.hertz import hertz; hertz(1e-6, 100.0, 3e-3, 0.01, 4e-12, 4e-12, 0.1)"
    with subprocess.Popen([sys.executable, "-c", call], env=settings) as killed:
        while not list(tmp_path.rglob("*.lock")):  # its turn has begun
            assert killed.poll() is None
        killed.kill()
    assert not list(tmp_path.rglob("*.nbc"))
    subprocess.run([sys.executable, "-c", call], env=settings, check=True, timeout=internals._LONGEST_TURN / 2)
    assert list(tmp_path.rglob("*.nbc"))


@pytest.mark.slow(3)
@pytest.mark.skipif(NOT_KEPT or not hasattr(os, "fork"), reason="nothing is compiled, or no fork")
def test_a_forked_process_compiles_as_well(tmp_path):
    code = """
import os
from cycloid_fmu.contact.hertz import hertz
child = os.fork()
hertz(1e-6, 100.0, 3e-3, 0.01, 4e-12, 4e-12, 0.1)
if child:
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
"""
    settings = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    subprocess.run([sys.executable, "-c", code], env=settings, check=True)


def test_a_tiny_torque_rests_on_its_own_flank():
    """The balance of 1e-6 N·m is the limit of small torques, at each crank angle separately and after reverse load."""
    pair = make_pair().replace(offset=-70e-6, isometric=-25e-6, errors={"centre_distance_x": 30e-6})
    surface, angles = surface_of_pair(pair), np.linspace(0.0, 2.0 * np.pi, 72, endpoint=False)
    limit = solve(DriveValue(pair, surface), [1e-2], angles).transmission_error[0]
    for torque in (1e-6, 1e-5, 1e-4):
        swept = solve(DriveValue(pair, surface), [-10.0, torque], angles).transmission_error[1]
        alone = [solve(DriveValue(pair, surface), [torque], [angle]).transmission_error[0, 0] for angle in angles[::6]]
        assert swept == pytest.approx(limit, abs=0.01 * ARCSEC)
        assert alone == pytest.approx(limit[::6], abs=0.01 * ARCSEC)


@pytest.mark.parametrize(
    ("errors", "sentence"),
    [
        ({"isometric": 9e-4, "offset": -9e-4}, "the flank is undercut above"),
        ({"eccentricity": -1e-3}, "the eccentricity is -0.01 mm"),
        ({"pin_tangential": {20: (1e-3, 0.0)}}, "pins .* overlap by"),
        ({"pin_radius": 9.9e-4}, "overlap"),
    ],
)
def test_a_drive_that_can_not_have_been_made_is_refused(errors, sentence):
    """As drawn it can be made, with its errors it can't: files, Python and surfaces are all held to it."""
    pair = make_pair().replace(eccentricity=0.99e-3, pin_radius="4.2 mm")
    if "isometric" in errors:
        pair = make_pair().replace(pin_radius="4.4 mm")
    with pytest.raises(edge.InputError, match=sentence):
        rigid_problem(DriveValue(pair, surface_of_pair(pair.replace(errors=errors))))


def test_the_file_whose_errors_can_not_have_been_made_is_named(tmp_path):
    """Pair files, reducer files and surfaces are refused as they are read."""
    drawn, file, surface = (
        make_pair(eccentricity="0.99 mm", pin_radius="4.2 mm"),
        tmp_path / "a.toml",
        tmp_path / "a.nc",
    )
    made = drawn.replace(errors={"pin_radius": 9.9e-4})
    write_pair(made, file)
    with pytest.raises(edge.InputError, match=r"a\.toml: errors: with these, pins \d+ and \d+ overlap by"):
        read_drive(file)
    write_pair(drawn, file)
    write_surface(surface_of_pair(made), surface)
    with pytest.raises(edge.InputError, match=r"a\.nc: errors: with these, pins \d+ and \d+ overlap by"):
        read_drive(file, surface)
    (tmp_path / "rv.toml").write_text(
        (EXAMPLES / "rv-20e.toml").read_text().replace('eccentricity = "5 um"', 'eccentricity = "-0.95 mm"')
    )
    with pytest.raises(edge.InputError, match=r"rv\.toml: deviations: with these, the eccentricity is -0\.05 mm"):
        read_drive(tmp_path / "rv.toml")


def test_results_outside_the_model_say_so():
    pair = make_pair().replace(rated_torque=181.0)
    angles = np.linspace(0.0, 0.2, 4)
    assert notes(DriveValue.as_stated(pair), solve(DriveValue.as_stated(pair), [150.0], angles)) == []
    said = notes(DriveValue.as_stated(pair), solve(DriveValue.as_stated(pair), [1e5], angles))
    assert [word in one for word, one in zip(("MPa", "half width", "rated"), said, strict=True)] == [True] * 3
    limited = pair.replace(pressure_limit="300 MPa")
    assert (
        "above 300 MPa"
        in notes(
            DriveValue(limited, surface_of_pair(pair)),
            solve(DriveValue(limited, surface_of_pair(pair)), [150.0], angles),
        )[0]
    )
    wrong = make_pair().replace(offset=40e-6)
    assert "no play" in notes(DriveValue.as_stated(wrong), solve(DriveValue.as_stated(wrong), [10.0], angles))[-1]


@pytest.mark.slow(1)
@pytest.mark.parametrize(
    ("sizes", "torque"), [({}, -181.0), ({"gear_teeth": 13, "pins": 14, "eccentricity": "2.5 mm"}, 120.0)]
)
@pytest.mark.parametrize("direction", [1.0, np.exp(0.7j)])
def test_slices_of_a_tilted_gear_err_by_less_than_the_note_says(sizes, torque, direction):
    """Against horizontal sections of the gear in three dimensions; the error grows with the square of the tilt."""
    pair = make_pair(PAIR + '[modification]\nisometric = "-15 um"\noffset = "-40 um"\n', **sizes)
    lengths = ("gear_teeth", "pin_circle_radius", "pin_radius", "eccentricity", "face_width")
    made = second_drive.body({n: getattr(pair, n) for n in lengths}, isometric=-15e-6, offset=-40e-6)
    limit = np.sqrt(2.0 * pair.shortening * 0.02 * ARCSEC)
    assert tilt_error(pair, limit) == pytest.approx(0.02 * ARCSEC)
    angles, errors = np.array([1.0, 2.0]), {}
    for tilt in (0.0, 1e-3):
        surface = surface_of_pair(pair).replace(
            misalignment_xz=(tilt * direction).real, misalignment_yz=(tilt * direction + 0j).imag
        )
        found = solve(DriveValue(pair, surface), [torque], angles, 5)
        exact = [tilted_gear.transmission_error(made, angle, torque, tilt * direction, 5) for angle in angles]
        errors[tilt] = np.abs(found.transmission_error[0] - exact).max()
        assert any("tilted by" in note for note in notes(DriveValue(pair, surface), found)) == (tilt > limit)
    assert errors[0.0] < 0.002 * ARCSEC
    assert 0.3 * tilt_error(pair, 1e-3) < errors[1e-3] < tilt_error(pair, 1e-3)


@pytest.mark.parametrize(("angles", "turns"), [(40, 1), (360, 1), (367, 1), (20, 39), (1, 1), (23, 1)])
def test_angles_in_step_with_the_pins_are_noted(angles, turns):
    """The phases of the mesh, counted; all teeth alike, the transmission error has as many values at most."""
    pair = make_pair(PAIR, pins=40, gear_teeth=39, rated_torque="100 N*m")
    crank = np.linspace(0.0, 2.0 * np.pi * turns, angles, endpoint=False)
    phases = np.unique(np.round(crank * pair.pins / (2.0 * np.pi) % 1.0, 9) % 1.0).size
    (error,) = solve(DriveValue(pair, surface_of_pair(pair)), [100.0], crank).transmission_error
    assert np.unique(np.round(error, 12)).size <= phases
    noted = step_notes(pair.pins, angles, turns)
    assert [f"meet only {phases} phase" in note for note in noted] == [True] * (phases < min(angles, 24))


@pytest.mark.slow(2)
@pytest.mark.parametrize(("tilt", "noted"), [("0.3 mrad", False), ("2 mrad", True)])
def test_every_command_notes_a_tilt_beyond_the_first_order(tilt, noted, command, tmp_path):
    """As a stated error, as a tolerance and as a value that is varied; 0.02″ is at 0.4 mrad for K = 0.81."""
    pair = make_pair(PAIR, rated_torque="100 N*m")
    Drive(pair.replace(errors={"misalignment_yz": tilt})).write(tmp_path / "tilted.toml")
    Drive(pair).write(tmp_path / "pair.toml")
    (tmp_path / "t.toml").write_text(f'format = "cycloid-tolerances/1"\n[misalignment_xz]\ntolerance = "{tilt}"\n')
    few = ["--angles", "20"]
    for words in (
        ["analyze", "tilted.toml", *few],
        ["draw", "tilted.toml", "-o", "t.svg"],
        ["build", "tilted.toml", "-o", "t.fmu"],
        ["sweep", "tilted.toml", "--vary", "offset=-40, -30 um", *few],
        ["sweep", "pair.toml", "--vary", f"errors.misalignment_xz=0, {tilt}", *few],
        ["tolerance", "pair.toml", "--tolerances", "t.toml", "--samples", "2", "--workers", "1", *few],
    ):
        run = command("cycloid-fmu", *words)
        assert run.returncode == 0, run.stderr
        assert (f"tilted by {'up to ' * ('--vary' in words)}{tilt}, modelled to first order" in run.stderr) == noted, (
            words
        )
        assert ("meet only 1 phase of the mesh" in run.stderr) == ("--angles" in words)


def test_default_crank_angles_are_out_of_step_with_any_pins():
    assert all(ANGLES % pins for pins in range(2, 122))


@given(st.lists(st.integers(-2, 2), min_size=3, max_size=30), st.sampled_from([150.0, -30.0]))
@settings(max_examples=60, deadline=None)
def test_a_crank_that_turns_back_or_rests_meets_the_same_deviations(steps, torque):
    """Each angle starts from those before it, which may be the same, in any order."""
    pair = read_pair(CASES / "errors-39-40.toml")
    surface, places = surface_of_pair(pair), 1.0 + 0.01 * np.arange(-60, 61)
    wanted = solve(DriveValue(pair, surface), [torque], places, with_play=False).transmission_error[0]
    at = 60 + np.cumsum(steps)
    found = solve(DriveValue(pair, surface), [torque], places[at], with_play=False).transmission_error[0]
    np.testing.assert_allclose(found, wanted[at], rtol=0.0, atol=1e-11)
    derived = error_sensitivity(DriveValue(pair, surface), torque, places[at], ["eccentricity"])[0]
    np.testing.assert_allclose(derived, wanted[at], rtol=0.0, atol=1e-11)


@given(st.lists(st.floats(0.1, 400.0), min_size=2, max_size=20), st.booleans())
@settings(max_examples=60, deadline=None)
def test_a_crank_at_rest_under_changing_torques_deviates_as_under_each_alone(torques, with_errors):
    """Each torque starts from the one before it at the same angle, by its stiffness."""
    pair = read_pair(CASES / ("errors-39-40.toml" if with_errors else "error-free-39-40.toml"))
    surface, both = surface_of_pair(pair), np.repeat([0.3, 0.7], len(torques))
    found = solve(DriveValue(pair, surface), np.tile(torques, 2)[None], both, with_play=False)
    alone = [solve(DriveValue(pair, surface), [t], [0.3], with_play=False) for t in torques]
    wanted = np.array([one.transmission_error[0, 0] for one in alone])
    np.testing.assert_allclose(found.transmission_error[0, : wanted.size], wanted, rtol=0.0, atol=1e-10)
    stiffness = np.array([one.torsional_stiffness[0, 0] for one in alone])
    np.testing.assert_allclose(found.torsional_stiffness[0, : wanted.size], stiffness, rtol=1e-2)


def test_angles_in_step_with_the_pins_warn_from_python_too():
    drive = Drive(read_pair(EXAMPLES / "drive-39-40.toml"))
    with pytest.warns(edge.InputWarning, match="80 crank angles meet only 2 phases .* take 81"):
        drive.analyze(angles=80)
