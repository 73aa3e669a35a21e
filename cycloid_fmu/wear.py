"""Wear of gear and pins: Archard's law over the Hertz pressure, with the profile updated as it wears.

A point of a flank loses k_0 p for each metre that the other surface slides past while the pressure p is on it. Summed
over the sweep of the Hertz pressure this is h = N ∫ k_0 p(s - s_c(φ)) |v_12| dφ: bounded, and it conserves
k_0 ∫ F |v_12| exactly on any grid, because each contact gives every element the part of the pressure's ellipse that
lies on it (loaded-contact-wear equations 18 to 22; docs/theory/wear.md says why not 2a|σ|).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import correlate1d

from cycloid_fmu import contact
from cycloid_fmu.pair import Pair
from cycloid_fmu.profile import flank_points, flank_speed
from cycloid_fmu.sliding import velocities
from cycloid_fmu.surface import ErrorSurface
from cycloid_fmu.tooth_contact import LoadedContacts, loaded_contacts
from cycloid_fmu.transmission import ANGLE_ELEMENTS, PART, PROFILE_ELEMENTS, drive_of, slices_needed, solve
from cycloid_fmu.wear_law import Load, Regression, WearLaw

Array = NDArray[np.float64]

# Crank angles for each pin pitch: where one pitch is all there is, where every pin or tooth meets each phase once, and
# where it meets it many times, each time a little on.
ANGLES = (128, 64, 12)
SENSIBLE_COEFFICIENTS = (1e-22, 1e-14)  # m²/N


def regression_coefficient(regression: Regression, line_load: ArrayLike, radius: ArrayLike, modulus: float) -> Array:
    """Dynamic wear coefficient k_0 of mixed lubrication, m²/N.

    Parameters
    ----------
    regression
        Pressure-viscosity coefficient and roughness of both surfaces.
    line_load
        F' = F/b, N/m.
    radius
        Equivalent curvature radius ρ*, m.
    modulus
        E_q = 1/[(1 - ν²)/E of both], Pa.

    Notes
    -----
    k_0 = 3.981e29/E_q L^1.219 G^-7.377 S^1.589, L = F'/(E_q ρ*), G = α E_q, S = Ra/ρ* (Janakiraman, Li, Kahraman 2014
    as loaded-contact-wear equation 20 gives it), Ra = sqrt(Ra_1² + Ra_2²): printed without the squares, which is no
    length.
    """
    load = np.asarray(line_load) / (modulus * np.asarray(radius))
    roughness = math.hypot(regression.roughness_gear, regression.roughness_pin) / np.asarray(radius)
    viscosity = regression.pressure_viscosity * modulus
    return np.asarray(3.981e29 / modulus * load**1.219 * viscosity**-7.377 * roughness**1.589)


def contact_coefficients(law: WearLaw, drive: contact.Drive, contacts: LoadedContacts) -> Array:
    """k_0 at each contact by the law that the wear file states, shape (contacts,), m²/N."""
    if law.regression is None:
        assert law.coefficient is not None
        return np.full(contacts.force.size, law.coefficient)
    modulus = 1.0 / (drive.compliance_gear + drive.compliance_pin)
    return regression_coefficient(law.regression, contacts.force / drive.slice_width, contacts.radius, modulus)


@dataclass(frozen=True)
class Sweep:
    """The crank angles that stand for all: after them the mesh repeats, on other pins and teeth if these are alike."""

    crank_angle: Array
    teeth_alike: bool
    pins_alike: bool


def sweep_of(pair: Pair, surface: ErrorSurface) -> Sweep:
    """Return the shortest sweep of a pair with its errors: one pin pitch, one turn, or a whole turn of the output."""
    g = pair.pair
    devs = (surface.gear_deviation, surface.tooth_cumulative_pitch)
    teeth = all(d is None or bool((d == d[:1, :1]).all()) for d in devs)
    pins = all(
        d is None or bool((d == d[:1]).all())
        for d in (surface.pin_radial, surface.pin_tangential, surface.pin_radius_deviation, surface.pin_deviation)
    )
    frame = not any(
        (surface.centre_distance_x, surface.centre_distance_y, surface.misalignment_xz, surface.misalignment_yz)
    )
    fixed, moving = (g.pins, g.gear_teeth) if g.output == "gear" else (g.gear_teeth, g.pins)
    fixed_alike, moving_alike = (pins, teeth) if g.output == "gear" else (teeth, pins)
    fixed_alike = fixed_alike and frame
    meshes = (1 if fixed_alike else fixed) * (1 if moving_alike else moving)
    alike = fixed_alike + moving_alike
    count = 1 + meshes * ANGLES[2] if alike == 0 else meshes * ANGLES[2 - alike]
    angle = np.linspace(0.0, 2.0 * np.pi * meshes / fixed, count, endpoint=False)
    ring = g.output == "ring"
    return Sweep(angle, moving_alike if not ring else fixed_alike, fixed_alike if not ring else moving_alike)


@dataclass(frozen=True)
class Depth:
    """Wear depth of every element, > 0 material lost, m (or a rate of it, m for each crank turn).

    `gear` has the shape (discs, teeth, profile, width), `pin` (pins, angle, width), elements as an `ErrorSurface` has.
    """

    gear: Array
    pin: Array

    def __add__(self, other: Depth) -> Depth:
        return Depth(self.gear + other.gear, self.pin + other.pin)

    def __mul__(self, factor: float) -> Depth:
        return Depth(self.gear * factor, self.pin * factor)

    @property
    def largest(self) -> float:
        """The deepest element's, m."""
        return float(max(np.abs(self.gear).max(), np.abs(self.pin).max()))


@dataclass(frozen=True)
class WearRate:
    """How fast a drive wears in one state.

    Attributes
    ----------
    depth
        m for each crank turn.
    volume
        k_0 ∫ F |v_12| of each body, m³ for each crank turn: what the depths must add up to.
    sliding_work
        ∫ F |v_12|, J for each crank turn: friction work at a friction coefficient of 1.
    coefficient
        Largest k_0, m²/N.
    half_width, pressure
        Largest of the contacts, m and Pa.
    """

    depth: Depth
    volume: float
    sliding_work: float
    coefficient: float
    half_width: float
    pressure: float


@dataclass(frozen=True)
class WearModel:
    """What stays the same while a drive wears.

    Attributes
    ----------
    pair, surface
        The pair and its errors when new, with deviations of elements (`wear_model` adds them).
    law
        Wear coefficient, motion of the pins, step.
    loads
        The duty cycle: torques with the share of the crank turns that each has.
    sweep
        The crank angles that stand for all.
    tooth_arc
        Arc length of one tooth's flanks, root to root, m.
    """

    pair: Pair
    surface: ErrorSurface
    law: WearLaw
    loads: tuple[Load, ...]
    sweep: Sweep
    tooth_arc: float

    @property
    def unworn(self) -> Depth:
        """No wear."""
        assert self.surface.gear_deviation is not None
        assert self.surface.pin_deviation is not None
        return Depth(np.zeros_like(self.surface.gear_deviation), np.zeros_like(self.surface.pin_deviation))

    @property
    def heaviest_torque(self) -> float:
        """The duty cycle's torque of the largest magnitude, N·m."""
        return max((load.torque for load in self.loads), key=abs, default=0.0)

    @property
    def gear_element(self) -> float:
        """Arc length of an element of the flanks, m."""
        assert self.surface.gear_deviation is not None
        return self.tooth_arc / float(self.surface.gear_deviation.shape[2])

    @property
    def pin_element(self) -> float:
        """Arc length of an element of the pins, m."""
        assert self.surface.pin_deviation is not None
        return math.pi * self.pair.pair.pin_radius / float(self.surface.pin_deviation.shape[1])


def wear_model(
    pair: Pair,
    surface: ErrorSurface,
    law: WearLaw,
    loads: Sequence[Load],
    profile: int = PROFILE_ELEMENTS,
    angle: int = ANGLE_ELEMENTS,
) -> WearModel:
    """Return the wear problem of a drive.

    Parameters
    ----------
    pair, surface
        The pair and its errors when new.
    law, loads
        Of the wear file and the duty cycle.
    profile, angle
        Elements along a tooth and round the half of a pin, where the surface has fewer.
    """
    g = pair.pair
    width = slices_needed(surface)
    gear = np.zeros((g.discs, g.gear_teeth, 1, 1)) if surface.gear_deviation is None else surface.gear_deviation
    pin = np.zeros((g.pins, 1, 1)) if surface.pin_deviation is None else surface.pin_deviation
    refined = dataclasses.replace(
        surface,
        gear_deviation=_finer(_finer(gear, 2, profile), 3, width),
        pin_deviation=_finer(_finer(pin, 1, angle), 2, width),
    )
    alpha = np.linspace(0.0, 2.0 * np.pi / g.gear_teeth, 4001)
    arc = float(np.trapezoid(flank_speed(pair, alpha), alpha))
    total = sum(load.crank_turns for load in loads)
    shares = (
        tuple(load.model_copy(update={"crank_turns": load.crank_turns / total}) for load in loads)
        if total > 0.0
        else ()
    )
    return WearModel(pair, refined, law, shares, sweep_of(pair, surface), arc)


def _finer(values: Array, axis: int, count: int) -> Array:
    """Values at the middles of more elements of equal length, linear between the middles of the given ones."""
    given = values.shape[axis]
    if given >= count:
        return values
    place = np.clip((np.arange(count) + 0.5) / count * given - 0.5, 0.0, given - 1.0)
    low = np.minimum(place.astype(int), max(given - 2, 0))
    high = np.minimum(low + 1, given - 1)
    share = (place - low).reshape([-1 if k == axis else 1 for k in range(values.ndim)])
    return np.asarray((1.0 - share) * values.take(low, axis) + share * values.take(high, axis))


def worn_surface(model: WearModel, depth: Depth, smoothing: float) -> ErrorSurface:
    """Return the error surface of a worn drive.

    Parameters
    ----------
    model, depth
        The wear problem and what was lost.
    smoothing
        Half length of the arc over which a parabola gives the curvature that wear adds, m: what a contact feels is the
        curvature over its width.
    """
    pin_bend = (
        np.zeros_like(depth.pin) if model.law.pins == "free" else _curvature(depth.pin, 1, model.pin_element, smoothing)
    )
    assert model.surface.gear_deviation is not None
    assert model.surface.pin_deviation is not None
    return dataclasses.replace(
        model.surface,
        gear_deviation=model.surface.gear_deviation - depth.gear,
        pin_deviation=model.surface.pin_deviation - depth.pin,
        gear_curvature=_curvature(depth.gear, 2, model.gear_element, smoothing),
        pin_curvature=pin_bend,
        origin="worn",
    )


def _curvature(depth: Array, axis: int, element: float, smoothing: float) -> Array:
    """Curvature that a loss of material adds, > 0 convex: h'' along the arc, by least squares over the smoothing."""
    reach = min(max(2, round(smoothing / element)), (depth.shape[axis] - 1) // 2)
    place = np.arange(-reach, reach + 1.0)
    # Second derivative of the parabola that fits best: it gives 0 for a line and 2 for the square of the place.
    weight = place**2 - np.mean(place**2)
    weight *= 2.0 / (weight @ place**2) / element**2
    return np.asarray(correlate1d(depth, weight, axis=axis, mode="nearest"))


def wear_rate(model: WearModel, surface: ErrorSurface, workers: int = 1) -> WearRate:
    """Return how fast the drive wears, on a surface with the elements of the model's.

    Parameters
    ----------
    workers
        Threads; the result is the same bits whatever their number.
    """
    width = model.unworn.gear.shape[3]
    drive = drive_of(model.pair, surface, width)
    angle = model.sweep.crank_angle
    parts = [
        (load, part)
        for load in model.loads
        if load.torque != 0.0
        for part in np.array_split(angle, math.ceil(angle.size / PART))
    ]
    with ThreadPoolExecutor(workers) as pool:
        found = list(pool.map(lambda part: _part_of_rate(model, drive, *part), parts))
    depth = model.unworn
    for one in found:
        depth.gear.__iadd__(one.depth.gear)
        depth.pin.__iadd__(one.depth.pin)
    gear, pin = depth.gear, depth.pin
    if model.sweep.teeth_alike:
        gear = np.broadcast_to(gear.mean(axis=(0, 1)), gear.shape).copy()
    # Every disc runs on its own part of the pins' length; a surface knows only one, so the discs' mean.
    pin = pin / drive.crank_phase.size
    if model.sweep.pins_alike:
        pin = np.broadcast_to(pin.mean(axis=0), pin.shape).copy()
    if model.law.pins == "free":
        # A pin that turns in its hole shares the loss among all of its circumference, twice what an element row spans.
        pin = np.broadcast_to(0.5 * pin.mean(axis=1, keepdims=True), pin.shape).copy()
    return WearRate(
        Depth(gear, pin),
        sum(o.volume for o in found),
        sum(o.sliding_work for o in found),
        *(max((getattr(o, n) for o in found), default=0.0) for n in ("coefficient", "half_width", "pressure")),
    )


def _part_of_rate(model: WearModel, drive: contact.Drive, load: Load, crank_angle: Array) -> WearRate:
    contacts = loaded_contacts(drive, crank_angle, load.torque)
    depth = model.unworn
    per_turn = load.crank_turns * 2.0 * np.pi / model.sweep.crank_angle.size
    if drive.ring:
        per_turn *= drive.teeth / (drive.teeth + 1)
    slid = np.abs(velocities(drive, contacts).sliding) * per_turn
    coefficient = contact_coefficients(model.law, drive, contacts)
    work = contacts.force * slid
    area = coefficient * work / drive.slice_width
    cells = depth.gear.shape[2]
    ends = np.concatenate([[0.0], np.arange(cells) + 0.5, [cells]])
    place = np.interp(contacts.place, drive.flank_alpha, ends)
    # Elements of a disc's teeth in a row for each slice: a contact at a root lies on both its teeth.
    rows = np.zeros((depth.gear.shape[0] * depth.gear.shape[3], drive.teeth * cells))
    _deposit(
        rows, contacts.disc * depth.gear.shape[3] + contacts.slice_, place + contacts.tooth * cells,
        contacts.half_width / model.gear_element, area / model.gear_element, True,
    )  # fmt: skip
    gear = rows.reshape(depth.gear.shape[0], depth.gear.shape[3], drive.teeth, cells)
    around = depth.pin.shape[1]
    rows = np.zeros((depth.pin.shape[0] * depth.pin.shape[2], around))
    _deposit(
        rows, contacts.pin * depth.pin.shape[2] + contacts.slice_, (contacts.pin_direction / np.pi + 0.5) * around,
        contacts.half_width / model.pin_element, area / model.pin_element, False,
    )  # fmt: skip
    pin = rows.reshape(depth.pin.shape[0], depth.pin.shape[2], around)
    return WearRate(
        Depth(np.moveaxis(gear, 1, 3), np.moveaxis(pin, 1, 2)),
        float((coefficient * work).sum()),
        float(work.sum()),
        *(float(v.max(initial=0.0)) for v in (coefficient, contacts.half_width, contacts.pressure)),
    )


@njit(cache=True, nogil=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _deposit(rows: Array, row: NDArray[np.int64], middle: Array, reach: Array, amount: Array, around: bool) -> None:
    """Spread amounts over elements as the ellipse of the Hertz pressure lies on them; all lengths in elements."""
    size = rows.shape[1]
    for i in range(row.size):
        first, last = math.floor(middle[i] - reach[i]), math.floor(middle[i] + reach[i])
        before = 0.0
        for cell in range(first, last + 1):
            u = (cell + 1.0 - middle[i]) / reach[i]
            upto = 0.5 + (u * math.sqrt(1.0 - u * u) + math.asin(u)) / math.pi if u < 1.0 else 1.0
            on = cell % size if around else min(max(cell, 0), size - 1)
            rows[row[i], on] += amount[i] * (upto - before)
            before = upto


@dataclass(frozen=True)
class WearState:
    """A drive at one time of its life.

    Attributes
    ----------
    crank_turns
        Turns since new.
    depth
        What was lost, m.
    difference
        Largest difference between the step that led here and two half steps, m.
    """

    crank_turns: float
    depth: Depth
    difference: float


def wear_states(
    model: WearModel, crank_turns: float, start: WearState | None = None, workers: int = 1
) -> Iterator[WearState]:
    """Wear a drive step by step, with gap and curvature of the profile updated.

    A step is as long as wears the deepest element by the law's `largest_step`, and is halved until it differs from two
    half steps by no more than a tenth of that; the rate in its middle counts. Nothing but the state is carried over, so
    a history goes on from any of its states as if it had not been interrupted.

    Parameters
    ----------
    model, crank_turns
        The wear problem and the turns at which to end; it ends before where `wear_limit` is reached.
    start
        A state to go on from; None for a new drive.

    Yields
    ------
    state
        First the start, then the state after each step.
    """
    new = wear_rate(model, model.surface, workers)
    smoothing, largest = new.half_width, model.law.largest_step
    limit = wear_limit(model)

    def rate_at(depth: Depth) -> WearRate:
        return wear_rate(model, worn_surface(model, depth, smoothing), workers)

    state = start or WearState(0.0, model.unworn, 0.0)
    rate = rate_at(state.depth) if start else new
    yield state
    while state.crank_turns < crank_turns and state.depth.largest < limit:
        left = crank_turns - state.crank_turns
        fastest = rate.depth.largest
        turns = min(left, min(largest, limit - state.depth.largest) / fastest) if fastest > 0.0 else left
        while True:
            middle = rate_at(state.depth + rate.depth * (0.5 * turns))
            difference = 0.5 * turns * (middle.depth + rate.depth * -1.0).largest
            if difference <= 0.1 * largest:
                break
            turns *= 0.5
        reached = crank_turns if turns == left else state.crank_turns + turns
        state = WearState(reached, state.depth + middle.depth * turns, difference)
        yield state
        rate = rate_at(state.depth)


def tooth_thickness(pair: Pair) -> float:
    """Chord between both flanks of a tooth halfway between root and tip, m."""
    half = np.pi / pair.pair.gear_teeth
    alpha = np.linspace(0.0, half, 2001)
    point = np.array([1.0, 1.0j]) @ np.stack(flank_points(pair, alpha))
    at = np.interp(0.5 * (abs(point[0]) + abs(point[-1])), np.abs(point), np.angle(point))
    return float((abs(point[0]) + abs(point[-1])) * np.sin(half - at))


def wear_limit(model: WearModel) -> float:
    """Depth at which the drive counts as worn out, m: the law's, or 5 % of the tooth's thickness (the paper's)."""
    return model.law.limit if model.law.limit is not None else 0.05 * tooth_thickness(model.pair)


def depth_as_printed(model: WearModel, crank_turns: float) -> tuple[LoadedContacts, Array, Array]:
    """Wear depth of gear and pin at each contact of the new drive by the paper's slip distance, for comparison only.

    Returns
    -------
    contacts, gear, pin
        The contacts of the heaviest load, and k_0 p 2a|σ| for each of them over the turns, m, p being the mean pressure
        F/(2ab); the pin's has a pole, so its largest value is that of the crank angles chosen.

    Notes
    -----
    loaded-contact-wear equations 21 and 22. The paper does not say which pressure p is; with the mean one the gear's
    largest depth comes nearest to its 60 µm.
    """
    drive = drive_of(model.pair, model.surface, model.unworn.gear.shape[3])
    contacts = loaded_contacts(drive, model.sweep.crank_angle, model.heaviest_torque)
    speed = velocities(drive, contacts)
    each = crank_turns * contact_coefficients(model.law, drive, contacts) * contacts.force / drive.slice_width
    return contacts, each * np.abs(speed.gear_slip), each * np.abs(speed.pin_slip)


@dataclass(frozen=True)
class Accuracy:
    """Transmission error under the heaviest load and backlash over the sweep, rad; arrays of shape (states,)."""

    transmission_error: Array
    transmission_error_range: Array
    backlash: Array
    backlash_range: Array


def accuracy(model: WearModel, depths: Sequence[Depth], smoothing: float, workers: int = 1) -> Accuracy:
    """Return mean and peak-to-peak transmission error and mean and peak-to-peak backlash of worn states."""
    angle = model.sweep.crank_angle[: 3 * PART]
    rows = []
    for depth in depths:
        surface = worn_surface(model, depth, smoothing)
        found = solve(model.pair, surface, model.heaviest_torque, angle, model.unworn.gear.shape[3], workers=workers)
        error, play = found.transmission_error[0], found.backlash
        rows.append([error.mean(), np.ptp(error), play.mean(), np.ptp(play)])
    return Accuracy(*np.array(rows).T)
