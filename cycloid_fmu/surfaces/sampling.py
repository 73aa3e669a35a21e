"""Error surfaces sampled from tolerances: the drives that a drawing allows.

The error-surface paper, section 2: every manufacturing error is distributed within its tolerance, and the pitch
deviations also meet the tolerance of the total cumulative pitch deviation. The file is TOML, `cycloid-tolerances/1`.

Errors of size, position and assembly lie within ± their tolerance, the single pitch too. The two that standards define
as a range are one here (ISO 1328-1): the total profile deviation is the largest less the smallest deviation over a
tooth's or pin's surface, the total cumulative pitch deviation the largest less the smallest position of all teeth.
"""

from __future__ import annotations

import dataclasses
import os
import zlib
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, TypeVar, cast

import numpy as np
import pydantic
from numba import njit
from numpy.typing import NDArray
from scipy.special import ndtr, ndtri

from cycloid_fmu import edge
from cycloid_fmu.contact import SCALAR_ERRORS
from cycloid_fmu.edge import Angle, Config, Length
from cycloid_fmu.geometry.pair import LARGEST_DEVIATION, LARGEST_MISALIGNMENT, Pair
from cycloid_fmu.surfaces.surface import LARGEST_ELEMENT, Elements, ErrorSurface, nominal_surface

Array = NDArray[np.float64]
Distribution = Literal["normal", "uniform"]
FORMAT = "cycloid-tolerances/1"
LARGEST_SEED = 2**63 - 1
_SINGLE = (*SCALAR_ERRORS, "pin_circle_diameter")  # errors that are one number
# How far a pitch may go of what is allowed: rounding in the sums that make positions from it must not exceed the limit.
_WITHIN = 1.0 - 1e-9
# Times that each pitch is met: with ten no figure of 3000 circles differs from four hundred's by more than chance.
_SWEEPS = 20


def _up_to(largest: float, shown: str) -> pydantic.AfterValidator:
    def check(value: float) -> float:
        if not 0.0 <= value <= largest:
            raise ValueError(f"tolerances must lie between 0 and {shown}")
        return value

    return pydantic.AfterValidator(check)


LengthTolerance = Annotated[Length, _up_to(LARGEST_DEVIATION, "1 mm")]
AngleTolerance = Annotated[Angle, _up_to(LARGEST_MISALIGNMENT, "20 mrad")]
ZoneTolerance = Annotated[Length, _up_to(2.0 * LARGEST_ELEMENT, "1 mm")]


class LengthError(Config):
    """An error that lies within ± `tolerance` (m); normal means three standard deviations there, cut off there."""

    tolerance: LengthTolerance
    distribution: Distribution = "normal"


class AngleError(Config):
    """An angle that lies within ± `tolerance` (rad); normal means three standard deviations there, cut off there."""

    tolerance: AngleTolerance
    distribution: Distribution = "normal"


class PitchErrors(Config):
    """Positions of teeth or pins round the circle, as arc length at the pin circle radius, m.

    Attributes
    ----------
    single
        Each single pitch deviation lies within ± this.
    cumulative
        The largest less the smallest position of all teeth stays within this.
    distribution
        Of each single pitch, before the circle is closed and the cumulative limit kept.
    """

    single: LengthTolerance
    cumulative: LengthTolerance
    distribution: Distribution = "normal"

    @pydantic.field_validator("cumulative")
    @classmethod
    def _possible(cls, cumulative: float, others: pydantic.ValidationInfo) -> float:
        single = others.data.get("single", 0.0)
        if cumulative < single:
            raise ValueError(
                "it is below what is possible: one pitch off by the single tolerance is a cumulative deviation as "
                f'large, so it must be at least "{single * 1e6:.6g} um"'
            )
        return cumulative


class Correlation(Config):
    """How far a form deviation resembles itself: correlation lengths as parts of the profile and of the face width.

    Deviations that lie the length apart correlate with exp(-1/2). The defaults leave about two waves along a tooth's
    profile and one across its width.
    """

    profile: float = pydantic.Field(default=0.15, ge=0.005, le=100.0)
    width: float = pydantic.Field(default=0.5, ge=0.005, le=100.0)


def _correlation(value: Any) -> Any:
    if value == "none" or isinstance(value, dict):
        return None if value == "none" else value
    raise ValueError('write { profile = 0.15, width = 0.5 }, parts of profile and face width, or "none"')


class ProfileErrors(Config):
    """The form of flanks or pins: normal deviations of their elements, m.

    Attributes
    ----------
    tolerance
        Total profile deviation: the elements of a tooth lie within ± half of it, so their range within it.
    distribution
        Of each element; normal means three standard deviations at half the tolerance, cut off there.
    correlation
        None (in the file "none") is every element by itself, which is what the error-surface paper draws.
    """

    tolerance: ZoneTolerance
    distribution: Distribution = "normal"
    correlation: Annotated[Correlation | None, pydantic.BeforeValidator(_correlation)] = Correlation()


class Limits(Config):
    """What a drive must keep to be good, each the largest allowed.

    Attributes
    ----------
    angular_transmission_error
        Largest less smallest transmission error over the crank angles, rad; at every load.
    backlash, lost_motion
        Largest over the crank angles, rad.
    interference
        Largest over the crank angles, m.
    max_contact_pressure
        Pa; at every load.
    """

    angular_transmission_error: Angle | None = None
    backlash: Angle | None = None
    lost_motion: Angle | None = None
    interference: Length | None = None
    max_contact_pressure: edge.Pressure | None = None

    def stated(self) -> dict[str, float]:
        """Return the limits that are stated, SI."""
        return {n: v for n in type(self).model_fields if (v := getattr(self, n)) is not None}


class Tolerances(Config):
    """The tolerances of a drive; what is not named has none and is sampled as nominal.

    `pin_circle_diameter` is the circle's diameter, `pin_radius` common to all pins, `pin_radius_each` each pin's own;
    the other names are those of the pair file's `[errors]`. `limits` are what a good drive keeps, `costs` what each
    tolerance costs at its stated width, relative to the others (1 where not stated).
    """

    gear_profile: ProfileErrors | None = None
    pin_profile: ProfileErrors | None = None
    gear_pitch: PitchErrors | None = None
    pin_pitch: PitchErrors | None = None
    pin_circle_diameter: LengthError | None = None
    pin_radius: LengthError | None = None
    pin_radius_each: LengthError | None = None
    eccentricity: LengthError | None = None
    centre_distance_x: LengthError | None = None
    centre_distance_y: LengthError | None = None
    misalignment_xz: AngleError | None = None
    misalignment_yz: AngleError | None = None
    isometric: LengthError | None = None
    offset: LengthError | None = None
    limits: Limits = Limits()
    costs: dict[str, Annotated[float, pydantic.Field(gt=0.0)]] = pydantic.Field(default_factory=dict)
    text: str = ""

    @pydantic.model_validator(mode="after")
    def _costs_belong_to_tolerances(self) -> Tolerances:
        for name in self.costs:
            if name not in self.factors:
                raise ValueError(f"[costs] {name}: there is no tolerance of this name; give it one or remove its cost")
        return self

    @property
    def factors(self) -> tuple[str, ...]:
        """Names of the errors that have a tolerance."""
        others = ("limits", "costs", "text")
        return tuple(n for n in type(self).model_fields if n not in others and getattr(self, n) is not None)


def parse_tolerances(text: str, source: str) -> Tolerances:
    """Return the tolerances that a TOML text states.

    Raises
    ------
    edge.InputError
        If it is not a valid table of tolerances; one sentence a problem, naming field, value and `source`.
    """
    table = edge.toml_table(text, FORMAT, source)
    if "text" in table:
        raise edge.InputError(f"{source}: text is not a key known here; check its spelling or remove it.")
    return edge.validated(Tolerances, {**table, "text": text}, source)


def read_tolerances(path: str | os.PathLike[str]) -> Tolerances:
    """Return the tolerances of a file; an `edge.InputError` names what is wrong in it."""
    return parse_tolerances(edge.read_text(path), str(path))


def error_stream(seed: int, error: str) -> np.random.Generator:
    """Return the random stream of one error: a child of the seed by the error's name, whatever else is sampled."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(zlib.crc32(error.encode()),)))


def within_tolerance(probability: Array, tolerance: float, distribution: Distribution) -> Array:
    """Return the values below which an error within ± `tolerance` lies with the given probability (its quantiles).

    Parameters
    ----------
    probability
        Between 0 and 1, any shape.
    tolerance
        m or rad, ≥ 0.
    distribution
        "uniform", or "normal" with three standard deviations at the tolerance, cut off there.
    """
    if distribution == "uniform":
        return tolerance * (2.0 * probability - 1.0)
    tail = ndtr(-3.0)
    return np.asarray(np.clip(ndtri(tail + probability * (1.0 - 2.0 * tail)) / 3.0, -1.0, 1.0) * tolerance)


_Function = TypeVar("_Function", bound=Callable[..., None])


def _compiled(function: _Function) -> _Function:
    # No NaN, and zeros have no sign: smallest and largest are found by vector instructions.
    return cast(_Function, njit(cache=True, fastmath={"nnan", "nsz"})(function))


@_compiled
def _exchange(
    positions: Array, first: NDArray[np.int64], last: NDArray[np.int64], chances: Array, single: float,
    cumulative: float, sigma: float,
) -> None:  # fmt: skip
    """Markov chain over the positions of one circle of teeth, in place: pitch `first` gains what pitch `last` loses.

    Teeth first + 1 … last move together by an even draw over all moves that keep both limits; a sigma above zero
    accepts it by the ratio of normal densities (Metropolis), so that the limits only cut the distribution off.
    """
    n = positions.size
    for move in range(first.size):
        i, j = first[move], last[move]
        # The moved teeth first + 1 … last are one run of the array, or with first > last all but one.
        low_end, high_end = min(i, j) + 1, max(i, j) + 1
        run_low, run_high, rest_low, rest_high = np.inf, -np.inf, np.inf, -np.inf
        for k in range(low_end, high_end):
            run_low, run_high = min(run_low, positions[k]), max(run_high, positions[k])
        for k in range(low_end):
            rest_low, rest_high = min(rest_low, positions[k]), max(rest_high, positions[k])
        for k in range(high_end, n):
            rest_low, rest_high = min(rest_low, positions[k]), max(rest_high, positions[k])
        if i < j:
            moved_low, moved_high, kept_low, kept_high = run_low, run_high, rest_low, rest_high
        else:
            moved_low, moved_high, kept_low, kept_high = rest_low, rest_high, run_low, run_high
        gains, loses = positions[(i + 1) % n] - positions[i], positions[(j + 1) % n] - positions[j]
        low = max(kept_high - moved_low - cumulative, -single - gains, loses - single)
        high = min(cumulative - moved_high + kept_low, single - gains, loses + single)
        if high <= low:
            continue
        shift = low + chances[move, 0] * (high - low)
        if sigma > 0.0:
            energy = ((gains + shift) ** 2 - gains**2 + (loses - shift) ** 2 - loses**2) / (2.0 * sigma * sigma)
            if chances[move, 1] >= np.exp(-energy):
                continue
        if i < j:
            for k in range(low_end, high_end):
                positions[k] += shift
        else:
            for k in range(low_end):
                positions[k] += shift
            for k in range(high_end, n):
                positions[k] += shift


def sample_pitch(generator: np.random.Generator, teeth: int, errors: PitchErrors) -> Array:
    """Return the positions of the teeth of one circle, their mean zero, shape (teeth,), m.

    The single pitches are independent, of the stated distribution, on the condition that the circle closes (they sum
    to zero), that each keeps the single limit and their running sum the cumulative one: the density is the product of
    theirs, cut off at the limits and nowhere bent. It is reached by a Markov chain from the error-free circle that
    exchanges deviation between two pitches, neighbours and strangers in turn, many times each: nothing is rejected
    until it fits, so a tight cumulative limit costs no more than a wide one.
    """
    if errors.single == 0.0:
        return np.zeros(teeth)
    moves = 2 * _SWEEPS * teeth
    first = generator.integers(teeth, size=moves)
    apart = np.where(np.arange(moves) % 2 == 0, 1, generator.integers(1, teeth, size=moves))
    # In units of the single limit, so that the chain is the same one at every scale.
    positions = np.zeros(teeth)
    _exchange(
        positions, first, (first + apart) % teeth, generator.random((moves, 2)), _WITHIN,
        _WITHIN * errors.cumulative / errors.single, 1.0 / 3.0 if errors.distribution == "normal" else 0.0,
    )  # fmt: skip
    return np.asarray((positions - positions.mean()) * errors.single)


def _waves(length: float, count: int) -> Array:
    """Waves whose random sum is smooth with the given correlation length, at `count` elements, shape (count, waves).

    The spectrum is that of the correlation exp(-u²/(2 length²)) with a period beyond the surface by four lengths, so
    that its two ends know nothing of each other. The waves don't depend on `count`: finer elements show the same form.
    """
    u = (np.arange(count) + 0.5) / count
    step = 2.0 * np.pi * length / (1.0 + 4.0 * length)
    order = np.arange(1, int(np.ceil(5.3 / step)) + 1)
    power = np.exp(-0.5 * (step * order) ** 2)
    scale = np.sqrt(2.0 * power / (1.0 + 2.0 * power.sum()))
    argument = np.outer(u, order) * step / length
    constant = np.full((count, 1), 1.0 / np.sqrt(1.0 + 2.0 * power.sum()))
    return np.hstack([constant, scale * np.cos(argument), scale * np.sin(argument)])


def sample_profile(
    generator: np.random.Generator, surfaces: int, profile: int, width: int, errors: ProfileErrors
) -> Array:
    """Return the normal deviations of the elements of teeth or pins, shape (surfaces, profile, width), m.

    A standard normal field, smooth by its correlation lengths or white, is taken element by element through the stated
    distribution (a Gaussian copula): each element has exactly that distribution and the range keeps its tolerance.
    """
    if errors.correlation is None:
        field = generator.standard_normal((surfaces, profile, width))
    else:
        along, across = _waves(errors.correlation.profile, profile), _waves(errors.correlation.width, width)
        weights = generator.standard_normal((surfaces, along.shape[1], across.shape[1]))
        # einsum sums in one order, always; a threaded matrix product need not.
        field = np.einsum("spn,wn->spw", np.einsum("pm,smn->spn", along, weights), across)
    return within_tolerance(ndtr(field), 0.5 * errors.tolerance, errors.distribution)


def sample_surface(pair: Pair, tolerances: Tolerances, seed: int, elements: Elements | None = None) -> ErrorSurface:
    """Return one drive that the tolerances allow, as an error surface of origin "sampled".

    Parameters
    ----------
    pair
        The nominal pair; the errors that its file states are another drive's and are not part of the sample.
    tolerances
        What is sampled; the seed and the tolerances' text go into the surface's attributes.
    seed
        0 … 2^63 - 1. The same seed gives the same surface, each error the same whatever others are sampled.
    elements
        Sizes of the deviation arrays; the default is `Elements()`.

    Raises
    ------
    edge.InputError
        If the seed is out of range.
    """
    if not 0 <= seed <= LARGEST_SEED:
        raise edge.InputError(f"seed = {seed}: it must lie between 0 and {LARGEST_SEED}.")
    streams = {name: error_stream(seed, name) for name in tolerances.factors}
    return dataclasses.replace(
        _drawn(pair, tolerances, streams, {}, elements or Elements()),
        attributes={"seed": seed, "tolerances": tolerances.text},
    )


def surface_at(
    pair: Pair, tolerances: Tolerances, point: Mapping[str, float], elements: Elements | None = None
) -> ErrorSurface:
    """Return the drive at a point of the unit cube that has one axis for each of the tolerances' `factors`.

    A single error is its distribution's quantile there. Errors that are many (pitch, form, each pin's radius) are drawn
    from a stream that the coordinate seeds: any even spread of points spreads the single errors as evenly, and the many
    are as random as before.
    """
    many = (name for name in tolerances.factors if name not in _SINGLE)
    streams = {name: error_stream(int(point[name] * 2.0**53), name) for name in many}
    return _drawn(pair, tolerances, streams, point, elements or Elements())


def _drawn(
    pair: Pair,
    tolerances: Tolerances,
    streams: Mapping[str, np.random.Generator],
    point: Mapping[str, float],
    size: Elements,
) -> ErrorSurface:
    """Draw each error from its stream, single ones at the probability that `point` says where it says one."""
    g = pair.pair
    changes: dict[str, Any] = {}
    for name in (*_SINGLE, "pin_radius_each"):
        # The circle's radius is toleranced by its diameter.
        error = getattr(tolerances, name, None)
        if error is None:
            continue
        single = name in _SINGLE
        chance = np.array([point[name]]) if single and name in point else streams[name].random(1 if single else g.pins)
        values = within_tolerance(chance, error.tolerance, error.distribution)
        if name == "pin_radius_each":
            changes["pin_radius_deviation"] = values
        elif name == "pin_circle_diameter":
            changes["pin_circle_radius"] = 0.5 * float(values[0])
        else:
            changes[name] = float(values[0])
    if tolerances.gear_pitch is not None:
        rows = [sample_pitch(streams["gear_pitch"], g.gear_teeth, tolerances.gear_pitch) for _ in range(g.discs)]
        changes["tooth_cumulative_pitch"] = np.array(rows)
    if tolerances.pin_pitch is not None:
        changes["pin_tangential"] = sample_pitch(streams["pin_pitch"], g.pins, tolerances.pin_pitch)
    if (form := tolerances.gear_profile) is not None:
        flanks = sample_profile(streams["gear_profile"], g.discs * g.gear_teeth, size.profile, size.width, form)
        changes["gear_deviation"] = flanks.reshape(g.discs, g.gear_teeth, size.profile, size.width)
    if (form := tolerances.pin_profile) is not None:
        changes["pin_deviation"] = sample_profile(streams["pin_profile"], g.pins, size.angle, size.width, form)
    return dataclasses.replace(nominal_surface(pair), origin="sampled", **changes)
