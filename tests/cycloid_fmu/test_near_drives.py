"""Drives near the error-free pair, solved side by side, against the same drives each solved alone."""

import numpy as np
import pytest
from common import EXAMPLES, draws, make_pair
from hypothesis import strategies as st

from cycloid_fmu import contact, edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.contact import near_drives, side_by_side
from cycloid_fmu.contact.near_drives import NearDrives
from cycloid_fmu.contact.transmission import rigid_problem
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.errors.kinds import KINDS
from cycloid_fmu.geometry.pair import parse_pair, read_pair
from cycloid_fmu.surfaces.structured import displacement_vector
from cycloid_fmu.surfaces.surface import ErrorSurface, nominal_surface

DRIVE = read_pair(EXAMPLES / "drive-39-40.toml")


def with_modification(isometric, offset):
    text = DRIVE.text.replace('isometric = "-15 um"', f'isometric = "{isometric} um"')
    return parse_pair(text.replace('offset = "-40 um"', f'offset = "{offset} um"'), "test.toml")


PAIRS = {
    "39/40": DRIVE,
    "two discs": make_pair(DRIVE.text, discs=2),
    "ring": make_pair(DRIVE.text, output="ring"),
    "printed law": make_pair(DRIVE.text, contact_law="as_printed"),
    "9/10": make_pair(DRIVE.text, gear_teeth=9, pins=10, eccentricity="3 mm", pin_radius="6 mm"),
    "hardly modified": with_modification(-1, -3),
    # With this eccentricity pins beside a root have a foot on either tooth.
    "two feet": make_pair(with_modification(0, -40).text, eccentricity="1.45 mm"),
    "ten times as large": make_pair(
        DRIVE.text.replace('"-15 um"', '"-150 um"').replace('"-40 um"', '"-400 um"'),
        pin_circle_radius="640 mm",
        pin_radius="30 mm",
        eccentricity="13 mm",
        face_width="100 mm",
    ),
    "warm": parse_pair(DRIVE.text + '[temperature]\nring = "50 degC"\ndiscs = "70 degC"\n', "test.toml"),
}
# Each error's largest value in µm or µrad, times a share.
KINDS_OF_RIGID = [kind for kind in KINDS.values() if kind.of in ("drive", "pin", "tooth")]


def drawn(pair, random, largest, few):
    """Errors up to a length (m): every kind, or but a few."""
    errors = {}
    for kind in KINDS_OF_RIGID:
        if kind.name.startswith("misalignment") or (few and random.random() < 0.7):
            continue
        errors[kind.name] = largest * random.uniform(-1.0, 1.0, kind.shape(pair))
    return ErrorSurface(pair, errors)


def compare(pair, surfaces, torque, angles, slices=1):
    """Where drives interfere an equilibrium can depend on where the search begins: it is one of those found alone."""
    exact = NearDrives(DriveValue(pair, nominal_surface(pair)), [(torque, angles), (0.0, angles)], slices)
    made = exact.displaced(np.array([displacement_vector(pair, s) for s in surfaces]))
    deviation, pressure = exact.loaded(0, made)
    backlash, interference = exact.play(1, made)
    for j, surface in enumerate(surfaces):
        following = solve(DriveValue(pair, surface), torque, angles, slices)
        for i in range(angles.size):
            found = [(following, i)]
            if following.interference[i] > 0.0 or interference[j, i] > 0.0:
                found.append((solve(DriveValue(pair, surface), torque, angles[i : i + 1], slices), 0))
            # An equilibrium's last step may cross the first touch of a pin.
            assert any(
                deviation[j, i] == pytest.approx(one.transmission_error[0, at], rel=1e-9, abs=2e-10)
                and pressure[j, i] == pytest.approx(one.max_contact_pressure[0, at], rel=1e-5, abs=1e5)
                for one, at in found
            )
            assert any(
                backlash[j, i] == pytest.approx(one.backlash[at], rel=1e-9, abs=1e-12, nan_ok=True)
                and interference[j, i] == pytest.approx(one.interference[at], rel=1e-6, abs=1e-12)
                for one, at in found
            )


@draws(
    20,
    100,
    2,
    name=st.sampled_from(sorted(PAIRS)),
    seed=st.integers(0, 2**32),
    largest=st.floats(-7.5, -5.0),
    load=st.floats(-1.5, 1.0),
    side=st.sampled_from([1.0, -1.0]),
    few=st.booleans(),
    step=st.sampled_from([0.002, 0.0175, 0.17, 2.4]),
)
def test_drives_side_by_side_are_as_each_alone(name, seed, largest, load, side, few, step):
    """Errors from 0.03 to 10 µm, loads from 0.03 to 10 times the rated one, near and far crank angles."""
    pair, random = PAIRS[name], np.random.default_rng(seed)
    angles = random.uniform(0.0, 6.0) + step * np.arange(7)
    surfaces = [drawn(pair, random, 10**largest, few) for _ in range(random.integers(1, 6))]
    compare(pair, surfaces, side * 181.0 * 10**load, angles)


def test_of_two_feet_the_nearer_one_says_whether_a_pin_is_clear():
    pair = PAIRS["two feet"]
    thicker = ErrorSurface(pair, {"pin_radius_deviation": np.where(np.arange(40) == 0, 25.9e-6, 0.0)})
    compare(pair, [thicker], 181.0, np.linspace(0.0, 2.0 * np.pi / 39.0, 7))


@pytest.mark.parametrize("seed", [139, 188])
def test_printed_drives_with_errors_that_cancel_along_the_flank(seed):
    """Pins displaced by 0.1 mm along the flank, and rotated back by the torque."""
    pair, random = with_modification(100, -100), np.random.default_rng(seed)
    names = ("pin_tangential", "tooth_cumulative_pitch")
    surfaces = [
        ErrorSurface(pair, {name: 1e-4 * random.uniform(-1.0, 1.0, KINDS[name].shape(pair))})
        for name in names
        for _ in range(10)
    ]
    compare(pair, surfaces, -181.0, np.linspace(0.0, 6.0, 20))


@pytest.mark.parametrize("name", ["39/40", "two discs"])
def test_tilted_drives_side_by_side_are_as_each_alone(name):
    pair, random = PAIRS[name], np.random.default_rng(7)
    surfaces = [drawn(pair, random, 3e-6, False).replace(misalignment_xz=2e-4, misalignment_yz=-1e-4) for _ in range(2)]
    compare(pair, surfaces, 150.0, np.linspace(0.0, 6.0, 15), 20)


@pytest.mark.parametrize("name", ["39/40", "two discs", "ring"])
def test_gaps_and_feet_move_as_displacements_say(name):
    """The bounds rest on both: a micrometre of each error, against the pins placed on the flanks of a drive with it."""
    pair, angle, random = PAIRS[name], np.array([0.7]), np.random.default_rng(1)
    exact = NearDrives(DriveValue(pair, nominal_surface(pair)), [(100.0, angle)], 1)
    guide = next(exact._along(0))
    x = guide.transmission_error[0]
    before = placed(pair, ErrorSurface(pair), angle[0], x)
    problem = rigid_problem(DriveValue(pair, ErrorSurface(pair)))
    for kind in KINDS_OF_RIGID:
        if kind.unit != "m":
            continue
        surface = ErrorSurface(pair, {kind.name: 1e-6 * random.uniform(0.5, 1.0, kind.shape(pair))})
        after = placed(pair, surface, angle[0], x)
        work = side_by_side.memory(len(guide.rows[0]), exact.displaced(displacement_vector(pair, surface)[None]).errors)
        side_by_side._displace(guide.rows[0], pair.pins, work)
        for row in range(0, len(before), 2):
            linear, frame = work.linear[row // 2], contact.local_frame(problem, angle[0], x, before, row)
            # Far from roots, where a micrometre is little beside the curvature radius.
            if abs(frame.bend) < 2e3 and before[row].gap < 1.0 and after[row].gap < 1.0:
                # Beside a root the nearer of two teeth counts.
                assert linear.gap[0] + linear.beyond[0] <= after[row].gap + 5e-9
                assert linear.gap[0] == pytest.approx(after[row].gap, abs=5e-9)
                assert after[row].foot - before[row].foot == pytest.approx(
                    linear.along[0] * frame.foot, abs=1e-8 * abs(frame.foot)
                )


def placed(pair, surface, angle, x):
    problem = rigid_problem(DriveValue(pair, surface))
    rows = contact.contact_rows(problem)
    contact.place_contacts(problem, angle, x, rows, True, np.inf, np.inf)
    return rows


@pytest.mark.parametrize("name", ["39/40", "two discs", "ring"])
def test_what_a_drive_gives_does_not_depend_on_the_others(name):
    pair = PAIRS[name]
    angles, random = np.linspace(0.0, 2.0 * np.pi, 90), np.random.default_rng(3)
    exact = NearDrives(DriveValue(pair, nominal_surface(pair)), [(181.0, angles), (0.0, angles)], 1)
    errors = np.array([displacement_vector(pair, drawn(pair, random, 5e-6, False)) for _ in range(70)])
    made = exact.displaced(errors)
    together = (*exact.loaded(0, made), *exact.play(1, made))
    for some in (slice(0, 1), slice(33, 34), slice(5, 12), slice(20, 69)):
        made = exact.displaced(errors[some])
        for one, every in zip((*exact.loaded(0, made), *exact.play(1, made)), together, strict=True):
            assert np.array_equal(one, every[some], equal_nan=True)


def test_what_no_drive_can_be_is_refused():
    exact = NearDrives(DriveValue(DRIVE, nominal_surface(DRIVE)), [(181.0, np.zeros(1))], 1)
    thin = ErrorSurface(DRIVE, {"pin_radius_deviation": np.where(np.arange(40) == 3, -1e-3, 0.0)})
    thinner = 3.1 * displacement_vector(DRIVE, thin)
    with pytest.raises(edge.InputError, match=r"a pin's radius is -0\.1 mm; it must stay above zero"):
        exact.displaced(np.array([0.0 * thinner, thinner]))


def test_guides_in_parts(monkeypatch):
    """Long sweeps do not hold the error-free drive's contacts at all of their crank angles."""
    angles, random = np.linspace(0.0, 2.0 * np.pi, 50), np.random.default_rng(4)
    errors = np.array([displacement_vector(DRIVE, drawn(DRIVE, random, 3e-6, False)) for _ in range(3)])

    def solved():
        exact = NearDrives(DriveValue(DRIVE, nominal_surface(DRIVE)), [(181.0, angles), (0.0, angles)], 1)
        made = exact.displaced(errors)
        return *exact.loaded(0, made), *exact.play(1, made)

    whole = solved()
    monkeypatch.setattr(near_drives, "_GUIDE_BYTES", 7 * 40 * side_by_side.GUIDE.itemsize)
    parts = solved()
    monkeypatch.setattr(near_drives, "_CACHE_BYTES", 3 * 7 * 40 * side_by_side.GUIDE.itemsize)
    for one, part, again in zip(whole, parts, solved(), strict=True):
        assert part == pytest.approx(one, rel=1e-9, abs=1e-14, nan_ok=True)
        assert np.array_equal(again, part, equal_nan=True)
