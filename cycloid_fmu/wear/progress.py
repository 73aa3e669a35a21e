"""Wear of gear and pins: Archard's law over the Hertz pressure, with the profile updated as it wears.

A point of a flank loses the depth k_0 p per metre that the other surface slides past while the pressure p acts on it.
Summed over the sweep of the Hertz pressure this is h = N ∫ k_0 p(s - s_c(φ)) |v_12| dφ: bounded, and it conserves k_0 ∫
F |v_12| exactly on any grid, because each contact gives every element the part of the pressure's ellipse over it
(loaded-contact-wear equations 18 to 22; docs/theory/wear.md explains why 2a|σ| is not used).
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import correlate1d

from cycloid_fmu import contact
from cycloid_fmu.analysis import solve
from cycloid_fmu.contact.loaded_contacts import LoadedContacts
from cycloid_fmu.contact.transmission import ANGLE_ELEMENTS, PART, PROFILE_ELEMENTS
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge.kernels import kept_njit
from cycloid_fmu.geometry.pair import LOST_MOTION_LOAD, Pair
from cycloid_fmu.geometry.profile import flank_points, flank_speed
from cycloid_fmu.supports.loaded_contacts import Mounted, loaded_contacts, mounted
from cycloid_fmu.surfaces.surface import ErrorSurface, alike
from cycloid_fmu.wear.law import Load, Regression, WearLaw
from cycloid_fmu.wear.sliding import velocities

Array = NDArray[np.float64]

# Crank angles in a crank turn: where the sweep is one pin pitch, where every pin or tooth meets each phase once, and
# where it meets it many times, each time slightly shifted. Compared with ten times as many, the wear of a contact has
# an error of 0.7 % at most.
ANGLES = (5120, 1280, 240)
# Where a tooth meets more pins than these, or a pin more teeth, the additional phases replace crank angles: 39/40 has
# 120 in a turn, so a rate is twice as fast; its largest error is 1.0 % when worn by 10 µm.
_SHIFTED = 20
# A rate that only leads to the middle of a step uses one of so many crank angles: 1.5 times as fast.
_LEADING = 3
# Half length, in half widths, of the arc over which a contact feels the loss. The pressure's ellipse, centred on a
# crest, wears ripples shorter than 1.64 a in their valleys (its transform, 2 J_1(ka)/ka, is negative there); a mean
# over this length no longer shows them, so they cannot grow. Over a shorter length the depth depends on the elements.
_FELT = 1.5
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
    as loaded-contact-wear equation 20 gives it), Ra = sqrt(Ra_1² + Ra_2²): printed without the squares, which is not a
    length.
    """
    load = np.asarray(line_load) / (modulus * np.asarray(radius))
    roughness = math.hypot(regression.roughness_gear, regression.roughness_pin) / np.asarray(radius)
    viscosity = regression.pressure_viscosity * modulus
    return np.asarray(3.981e29 / modulus * load**1.219 * viscosity**-7.377 * roughness**1.589)


def contact_coefficients(law: WearLaw, drive: contact.Problem, contacts: LoadedContacts) -> Array:
    """k_0 at each contact by the law of the wear file, shape (contacts,), m²/N."""
    if law.regression is None:
        assert law.coefficient is not None
        return np.full(contacts.force.size, law.coefficient)
    modulus = 1.0 / (drive.compliance_gear + drive.compliance_pin)
    return regression_coefficient(law.regression, contacts.force / drive.slice_width, contacts.radius, modulus)


@dataclass(frozen=True)
class Sweep:
    """The crank angles that represent all: after them the mesh repeats, on other pins and teeth if these are equal."""

    crank_angle: Array
    teeth_alike: bool
    pins_alike: bool


def sweep_of(drive: DriveValue) -> Sweep:
    """Return the shortest sweep of a pair with its errors: one pin pitch, one turn, or a whole turn of the output.

    On stated bearings a tooth's load depends on where it stands against its disc's holes.
    """
    pair, surface = drive.pair, drive.surface
    g = pair
    teeth, pins = alike(surface)
    teeth = teeth and pair.supports is None
    fixed, moving = (g.pins, g.gear_teeth) if g.output == "gear" else (g.gear_teeth, g.pins)
    fixed_alike, moving_alike = (pins, teeth) if g.output == "gear" else (teeth, pins)
    meshes = (1 if fixed_alike else fixed) * (1 if moving_alike else moving)
    both = fixed_alike + moving_alike
    each = ANGLES[2 - both] / fixed
    if both == 0:
        each *= min(_SHIFTED / fixed, 1.0)
    count = (both == 0) + meshes * math.ceil(each)
    angle = np.linspace(0.0, 2.0 * np.pi * meshes / fixed, count, endpoint=False)
    return Sweep(angle, teeth, pins)


@dataclass(frozen=True)
class Depth:
    """Wear depth of every element, > 0 material lost, m (or its rate, m per crank turn).

    `gear` has the shape (discs, teeth, profile, width), `pin` (pins, angle, width), elements as in an `ErrorSurface`.
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
    """Wear rate of a drive in one state.

    Attributes
    ----------
    depth
        m for each crank turn.
    volume
        k_0 ∫ F |v_12| of each body, m³ per crank turn: the sum of the depths.
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
    """The constant data of a wear run.

    Attributes
    ----------
    pair, surface
        The pair and its errors when new, with deviations of elements (`wear_model` adds them).
    law
        Wear coefficient, motion of the pins, step.
    loads
        The duty cycle: torques with the share of the crank turns that each has.
    cycle
        Crank turns of one duty cycle.
    sweep
        The crank angles that represent all.
    tooth_arc
        Arc length of one tooth's flanks, root to root, m.
    """

    pair: Pair
    surface: ErrorSurface
    law: WearLaw
    loads: tuple[Load, ...]
    cycle: float
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
        return math.pi * self.pair.pin_radius / float(self.surface.pin_deviation.shape[1])


def wear_model(
    drive: DriveValue,
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
    pair, surface = drive.pair, drive.surface
    g = pair
    width = drive.slices
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
    shares = tuple(load.replace(crank_turns=load.crank_turns / total) for load in loads) if total > 0.0 else ()
    return WearModel(pair, refined, law, shares, total, sweep_of(drive), arc)


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


def surface_loss(model: WearModel, depth: Depth, half_width: float) -> Depth:
    """Return the depth that the surfaces lose: what Hertz's pressure removes, averaged along the arc of a contact.

    Parameters
    ----------
    model, depth
        The wear problem and what contacts removed from each element, of `wear_rate`, m.
    half_width
        Hertz's a of the widest contact, m.

    Notes
    -----
    The weight is (15/16L)(1 - s²/L²)² over L = 1.5 a: a smooth profile that no volume is lost to. Across the width
    nothing is averaged.
    """
    # The flanks of neighbouring teeth are continuous at the roots.
    gear = np.moveaxis(depth.gear, 3, 1)
    flanks = gear.reshape(*gear.shape[:2], -1)
    averaged = correlate1d(flanks, _weights(model.gear_element, half_width), axis=2, mode="wrap")
    pin = correlate1d(depth.pin, _weights(model.pin_element, half_width), axis=1, mode="reflect")
    return Depth(np.moveaxis(averaged.reshape(gear.shape), 1, 3), pin)


def _weights(element: float, half_width: float) -> Array:
    """Shares of the neighbouring elements in the mean along the arc of a contact."""
    length = max(_FELT * half_width / element, 2.0)
    reach = math.ceil(length - 0.5)
    u = np.clip(np.arange(-reach - 0.5, reach + 1.0) / length, -1.0, 1.0)
    return np.asarray(np.diff(15.0 / 16.0 * (u - 2.0 / 3.0 * u**3 + 0.2 * u**5)))


def worn_surface(model: WearModel, depth: Depth) -> ErrorSurface:
    """Return the error surface of a worn drive: its deviations less the depth, and the curvature that the loss adds.

    Parameters
    ----------
    model, depth
        The wear problem and the depth that the surfaces lost (`WearState.depth`, or `surface_loss`), m.
    """
    assert model.surface.gear_deviation is not None
    assert model.surface.pin_deviation is not None
    gear = np.moveaxis(depth.gear, 3, 1)
    bend = _second_difference(gear.reshape(*gear.shape[:2], -1), 2, "wrap") / model.gear_element**2
    return dataclasses.replace(
        model.surface,
        gear_deviation=model.surface.gear_deviation - depth.gear,
        pin_deviation=model.surface.pin_deviation - depth.pin,
        gear_curvature=np.moveaxis(bend.reshape(gear.shape), 1, 3),
        pin_curvature=_second_difference(depth.pin, 1, "reflect") / model.pin_element**2,
        origin="worn",
    )


def _second_difference(values: Array, axis: int, beyond: str) -> Array:
    return np.asarray(correlate1d(values, [1.0, -2.0, 1.0], axis=axis, mode=beyond))


def wear_rate(model: WearModel, surface: ErrorSurface, workers: int = 1) -> WearRate:
    """Return the wear rate of the drive, on a surface with the elements of the model.

    Parameters
    ----------
    workers
        Threads; the result is the same bits for any number.
    """
    width = model.unworn.gear.shape[3]
    drive = mounted(DriveValue(model.pair, surface), width)
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
    # Every disc runs on its own part of the pins' length; a surface has one part only: the mean of the discs.
    pin = pin / model.pair.discs
    if model.sweep.pins_alike:
        pin = np.broadcast_to(pin.mean(axis=0), pin.shape).copy()
    if model.law.pins == "free":
        # A pin that turns in its hole wears evenly over its circumference, twice the span of an element row.
        pin = np.broadcast_to(0.5 * pin.mean(axis=1, keepdims=True), pin.shape).copy()
    return WearRate(
        Depth(gear, pin),
        sum(o.volume for o in found),
        sum(o.sliding_work for o in found),
        *(max((getattr(o, n) for o in found), default=0.0) for n in ("coefficient", "half_width", "pressure")),
    )


def _part_of_rate(model: WearModel, held: Mounted, load: Load, crank_angle: Array) -> WearRate:
    drive, contacts = held.problem, loaded_contacts(held, crank_angle, load.torque)
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
    assert drive.deviations is not None  # a wearing surface has elements
    place = np.interp(contacts.profile_parameter, drive.deviations.flank_alpha, ends)
    # Elements of a disc's teeth in a row for each slice: a contact at a root is on both of its teeth.
    rows = np.zeros((depth.gear.shape[0] * depth.gear.shape[3], drive.teeth * cells))
    _deposit(
        rows,
        contacts.disc * depth.gear.shape[3] + contacts.slice_,
        place + contacts.tooth * cells,
        contacts.half_width / model.gear_element,
        area / model.gear_element,
        True,
    )
    gear = rows.reshape(depth.gear.shape[0], depth.gear.shape[3], drive.teeth, cells)
    around = depth.pin.shape[1]
    rows = np.zeros((depth.pin.shape[0] * depth.pin.shape[2], around))
    _deposit(
        rows,
        contacts.pin * depth.pin.shape[2] + contacts.slice_,
        (contacts.pin_direction / np.pi + 0.5) * around,
        contacts.half_width / model.pin_element,
        area / model.pin_element,
        False,
    )
    pin = rows.reshape(depth.pin.shape[0], depth.pin.shape[2], around)
    return WearRate(
        Depth(np.moveaxis(gear, 1, 3), np.moveaxis(pin, 1, 2)),
        float((coefficient * work).sum()),
        float(work.sum()),
        *(float(v.max(initial=0.0)) for v in (coefficient, contacts.half_width, contacts.pressure)),
    )


@kept_njit(nogil=True, error_model="numpy")
def _deposit(rows: Array, row: NDArray[np.int64], middle: Array, reach: Array, amount: Array, around: bool) -> None:
    """Distribute amounts over elements by the ellipse of the Hertz pressure; all lengths in elements."""
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
        Depth that the surfaces lost, m: `surface_loss` of all that contacts removed.
    whole
        The same with whole steps instead of two halves, from new on, m.
    reach
        Largest depth of the next step, m.
    """

    crank_turns: float
    depth: Depth
    whole: Depth
    reach: float = math.inf

    @property
    def difference(self) -> float:
        """Largest effect of halving every step since new, m."""
        return (self.depth + self.whole * -1.0).largest


def wear_states(model: WearModel, crank_turns: float, workers: int = 1) -> Iterator[WearState]:
    """Wear a drive step by step, with gap and curvature of the profile updated.

    Every step is made twice: as two halves, each of which wears the deepest element by the law's `largest_step` at
    most, and as one; where they differ by more than a tenth of `largest_step`, the step is shortened. Both histories
    continue from their own states, so `WearState.difference` is the effect of halving all steps. The midpoint rule is
    of second order.

    Parameters
    ----------
    model, crank_turns
        The wear problem and the turns at which to end; it ends earlier if `wear_limit` is reached.

    Yields
    ------
    state
        First the new drive, then the state after each step.
    """
    new = wear_rate(model, model.surface, workers)
    largest, limit = model.law.largest_step, wear_limit(model)
    periods = _periods(model, new)

    def rate_at(loaded: WearModel, depth: Depth) -> Depth:
        removed = wear_rate(loaded, worn_surface(model, depth), workers).depth
        return surface_loss(model, removed, new.half_width)

    def leading_rate(loaded: WearModel, depth: Depth) -> Depth:
        sweep = dataclasses.replace(loaded.sweep, crank_angle=loaded.sweep.crank_angle[::_LEADING].copy())
        return rate_at(dataclasses.replace(loaded, sweep=sweep), depth)

    def after(loaded: WearModel, depth: Depth, rate: Depth, turns: float) -> Depth:
        return depth + rate_at(loaded, depth + rate * (0.5 * turns)) * turns

    state = WearState(0.0, model.unworn, model.unworn)
    yield state
    while state.crank_turns < crank_turns and state.depth.largest < 0.999 * limit:
        loaded, end = _period_at(periods, state.crank_turns)
        left = min(end, crank_turns) - state.crank_turns
        rate = leading_rate(loaded, state.depth)
        whole_rate = leading_rate(loaded, state.whole)
        fastest = rate.largest
        reach = min(2.0 * largest, limit - state.depth.largest, state.reach)
        turns = min(left, reach / fastest) if fastest > 0.0 else left
        while True:
            half = after(loaded, state.depth, rate, 0.5 * turns)
            depth = after(loaded, half, leading_rate(loaded, half), 0.5 * turns)
            whole = after(loaded, state.whole, whole_rate, turns)
            parted = (depth + state.depth * -1.0 + (whole + state.whole * -1.0) * -1.0).largest
            # Both results differ in proportion to the cube of the step.
            longer = 0.9 * (0.1 * largest / max(parted, 1e-6 * largest)) ** (1.0 / 3.0)
            if parted <= 0.1 * largest:
                break
            turns *= max(longer, 0.2)
        reached = min(end, crank_turns) if turns == left else state.crank_turns + turns
        # A step that ended with its load does not shorten the next one.
        following = max(min(longer, 3.0) * fastest * turns, state.reach if turns == left else 0.0)
        state = WearState(reached, depth, whole, following)
        yield state


def _periods(model: WearModel, new: WearRate) -> list[tuple[float, WearModel]]:
    """The loads of a duty cycle in order: their crank turns, and the problem at that load.

    If a cycle wears less than one step its order has no effect, and its loads wear together.
    """
    if len(model.loads) == 1 or model.cycle * new.depth.largest <= model.law.largest_step:
        return [(math.inf, model)]
    alone = [dataclasses.replace(model, loads=(load.replace(crank_turns=1.0),)) for load in model.loads]
    return [(load.crank_turns * model.cycle, single) for load, single in zip(model.loads, alone, strict=True)]


def _period_at(periods: list[tuple[float, WearModel]], crank_turns: float) -> tuple[WearModel, float]:
    """The problem at a number of crank turns, and those at which its period ends."""
    if math.isinf(periods[0][0]):
        return periods[0][1], math.inf
    ends = np.cumsum([turns for turns, _ in periods])
    cycle = float(ends[-1])
    # A period ends at the sum of the turns, up to rounding.
    begun = math.floor(crank_turns / cycle + 1e-9)
    at = int(np.searchsorted(ends, crank_turns - begun * cycle + 1e-9 * cycle, side="right"))
    return periods[at][1], begun * cycle + float(ends[at])


def tooth_thickness(pair: Pair) -> float:
    """Chord between both flanks of a tooth halfway between root and tip, m."""
    half = np.pi / pair.gear_teeth
    alpha = np.linspace(0.0, half, 2001)
    point = np.array([1.0, 1.0j]) @ np.stack(flank_points(pair, alpha))
    at = np.interp(0.5 * (abs(point[0]) + abs(point[-1])), np.abs(point), np.angle(point))
    return float((abs(point[0]) + abs(point[-1])) * np.sin(half - at))


def wear_limit(model: WearModel) -> float:
    """Depth at which the drive is worn out, m: that of the law, or 5 % of the tooth's thickness (as in the paper)."""
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
    loaded-contact-wear equations 21 and 22. The paper does not state which pressure p is; with the mean one the gear's
    largest depth is nearest to its 60 µm.
    """
    held = mounted(DriveValue(model.pair, model.surface), model.unworn.gear.shape[3])
    drive, contacts = held.problem, loaded_contacts(held, model.sweep.crank_angle, model.heaviest_torque)
    speed = velocities(drive, contacts)
    each = crank_turns * contact_coefficients(model.law, drive, contacts) * contacts.force / drive.slice_width
    return contacts, each * np.abs(speed.gear_slip), each * np.abs(speed.pin_slip)


@dataclass(frozen=True)
class Accuracy:
    """Accuracy over the sweep, mean and peak to peak: rad; arrays of shape (states,).

    The transmission error is that under the heaviest load; backlash is 0 where there is no free position. Lost motion
    is between + and - `pair.LOST_MOTION_LOAD` of the rated torque; where the pair states none, of the heaviest load.
    """

    transmission_error: Array
    transmission_error_range: Array
    backlash: Array
    backlash_range: Array
    lost_motion: Array
    lost_motion_range: Array


def accuracy(model: WearModel, depths: Sequence[Depth], workers: int = 1) -> Accuracy:
    """Return the accuracy of worn states, by the depth that their surfaces lost."""
    angle = model.sweep.crank_angle[: 3 * PART]
    rated = model.pair.rated_torque or abs(model.heaviest_torque)
    torques = [model.heaviest_torque, LOST_MOTION_LOAD * rated, -LOST_MOTION_LOAD * rated]
    rows = []
    for depth in depths:
        surface = worn_surface(model, depth)
        found = solve(DriveValue(model.pair, surface), torques, angle, model.unworn.gear.shape[3], workers=workers)
        error, up, down = found.transmission_error
        backlash = np.nan_to_num(found.backlash)
        # Without any load the lost motion is the play.
        lost = up - down if rated > 0.0 else backlash
        rows.append([figure(values) for values in (error, backlash, lost) for figure in (np.mean, np.ptp)])
    return Accuracy(*np.array(rows).T)
