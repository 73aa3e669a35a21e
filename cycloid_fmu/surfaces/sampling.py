"""Error surfaces sampled from tolerances.

The error-surface paper, section 2: every manufacturing error is distributed within its tolerance, and the pitch
deviations also meet the tolerance of the total cumulative pitch deviation. The file is TOML, `cycloid-tolerances/1`.

Errors of size, position and assembly are within ± their tolerance, the single pitch too. The two that standards define
as a range are ranges here (ISO 1328-1): the total profile deviation is the largest minus the smallest deviation over a
tooth's or pin's surface, the total cumulative pitch deviation the largest minus the smallest position of all teeth.
"""

from __future__ import annotations

import functools
import json
import math
import os
import types
import zlib
from collections.abc import Callable, Mapping
from typing import Annotated, Any, Literal, Self, TypeVar, cast

import numpy as np
import pydantic
from numba import njit
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.edge import Angle, Config, Length
from cycloid_fmu.errors.kinds import KINDS, LARGEST_DEVIATION, LARGEST_MISALIGNMENT, ErrorKind
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.surface import LARGEST_ELEMENT, Elements, ErrorSurface

Array = NDArray[np.float64]
Distribution = Literal["normal", "uniform"]
FORMAT = "cycloid-tolerances/1"
LARGEST_SEED = 2**63 - 1
# The axes of a study's points that the first version had: a seed's drives stay the same, other kinds follow.
_FIRST_AXES = (
    "gear_profile", "pin_profile", "gear_pitch", "pin_pitch", "pin_circle_diameter", "pin_radius", "pin_radius_each",
    "eccentricity", "centre_distance_x", "centre_distance_y", "misalignment_xz", "misalignment_yz", "isometric",
    "offset",
)  # fmt: skip
_OTHERS = ("limits", "costs")
# How far a pitch may go of what is allowed: rounding in the sums that make positions from it must not exceed the limit.
_WITHIN = 1.0 - 1e-9
# Times that each pitch is met: with ten no figure of 3000 circles differs from four hundred's by more than chance.
_SWEEPS = 20


def _up_to(largest: float, shown: str) -> pydantic.AfterValidator:
    def check(value: float) -> float:
        if not 0.0 <= value <= largest:
            raise ValueError(f"tolerances must be between 0 and {shown}")
        return value

    return pydantic.AfterValidator(check)


def _not_below_zero(value: float) -> float:
    if value < 0.0:
        raise ValueError("a limit is the largest size allowed; it must not be below zero")
    return value


LargestAngle = Annotated[Angle, pydantic.AfterValidator(_not_below_zero)]
LargestLength = Annotated[Length, pydantic.AfterValidator(_not_below_zero)]
LargestPressure = Annotated[edge.Pressure, pydantic.AfterValidator(_not_below_zero)]
LengthTolerance = Annotated[Length, _up_to(LARGEST_DEVIATION, "1 mm")]
AngleTolerance = Annotated[Angle, _up_to(LARGEST_MISALIGNMENT, "20 mrad")]
ZoneTolerance = Annotated[Length, _up_to(2.0 * LARGEST_ELEMENT, "1 mm")]


class LengthError(Config):
    """An error within ± `tolerance` (m); a normal distribution is cut off there, at three standard deviations."""

    tolerance: LengthTolerance
    distribution: Distribution = "normal"


class AngleError(Config):
    """An angle within ± `tolerance` (rad); a normal distribution is cut off there, at three standard deviations."""

    tolerance: AngleTolerance
    distribution: Distribution = "normal"


class PitchErrors(Config):
    """Positions of teeth or pins around the circle, as arc length at the pin circle radius, m.

    Attributes
    ----------
    single
        Each single pitch deviation is within ± this.
    cumulative
        The largest minus the smallest position of all teeth is within this.
    distribution
        Of each single pitch, before the circle is closed and the cumulative limit applied.
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
                "it is below the possible minimum: one pitch off by the single tolerance is a cumulative deviation as "
                f'large, so it must be at least "{single * 1e6:.6g} um"'
            )
        return cumulative


class Correlation(Config):
    """Correlation lengths of a form deviation, as parts of the profile and of the face width.

    Deviations at this distance correlate with exp(-1/2). The defaults leave about two waves along a tooth's
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
        Total profile deviation: the elements of a tooth are within ± half of it, so their range is within it.
    distribution
        Of each element; a normal distribution is cut off at half the tolerance, at three standard deviations.
    correlation
        None (in the file "none") for independent elements, as in the error-surface paper.
    """

    tolerance: ZoneTolerance
    distribution: Distribution = "normal"
    correlation: Annotated[Correlation | None, pydantic.BeforeValidator(_correlation)] = Correlation()


class Limits(Config):
    """Limits of a good drive, each the largest allowed value.

    Attributes
    ----------
    angular_transmission_error
        Largest minus smallest transmission error over the crank angles, rad; at every load.
    backlash, lost_motion
        Largest over the crank angles, rad.
    interference
        Largest over the crank angles, m.
    max_contact_pressure
        Pa; at every load.
    """

    angular_transmission_error: LargestAngle | None = None
    backlash: LargestAngle | None = None
    lost_motion: LargestAngle | None = None
    interference: LargestLength | None = None
    max_contact_pressure: LargestPressure | None = None

    def stated(self) -> dict[str, float]:
        """Return the stated limits, SI."""
        return {n: v for n in type(self).model_fields if (v := getattr(self, n)) is not None}


class Tolerances(Config):
    """The tolerances of a drive; errors without tolerance are nominal.

    The kinds of error are named by their tolerances' keys (`pin_circle_diameter` is the circle's diameter, `pin_radius`
    common to all pins, `pin_radius_each` each pin's own; `gear_pitch` and `pin_pitch` are positions round the circle),
    each a `LengthError`, `AngleError` or `PitchErrors`, or a table of its values. `limits` are what a good drive keeps,
    `costs` what each tolerance costs at its stated width, relative to the others (1 where not stated).

    Raises
    ------
    edge.InputError
        One sentence for each key that is unknown and each value out of range.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> tolerances = cy.Tolerances(
    ...     pin_radius={"tolerance": "2 um"}, gear_pitch={"single": "4 um", "cumulative": "12 um"},
    ...     limits={"backlash": "1 arcmin"},
    ... )
    >>> tolerances.factors
    ('gear_pitch', 'pin_radius')
    """

    model_config = pydantic.ConfigDict(extra="allow")

    gear_profile: ProfileErrors | None = None
    pin_profile: ProfileErrors | None = None
    limits: Limits = Limits()
    costs: dict[str, Annotated[float, pydantic.Field(gt=0.0)]] = pydantic.Field(default_factory=dict)

    def __init__(self, /, **values: Any) -> None:
        checked = file_model()(**values)
        super().__init__(**{n: v for n in type(checked).model_fields if (v := getattr(checked, n)) is not None})
        for name in self.costs:
            if name not in self.factors:
                raise edge.InputError(
                    f"[costs] {name}: there is no tolerance of this name; give it one or remove its cost."
                )

    def replace(self, **changes: Any) -> Self:
        """Return the tolerances with changes; None removes one and its cost."""
        values = {n: getattr(self, n) for n in (*self.factors, "limits")} | changes
        costs = {n: cost for n, cost in self.costs.items() if values.get(n) is not None}
        return type(self)(**{"costs": costs, **values})

    def of(self, factor: str) -> LengthError | AngleError | PitchErrors | ProfileErrors | None:
        """Return the tolerance of this name, None if there is none."""
        found: LengthError | AngleError | PitchErrors | ProfileErrors | None = getattr(self, factor, None)
        return found

    @functools.cached_property
    def factors(self) -> tuple[str, ...]:
        """Names of the errors that have a tolerance."""
        return tuple(n for n in _keys() if self.of(n) is not None)

    @property
    def text(self) -> str:
        """The tolerances as JSON, from their values alone (SI)."""
        return json.dumps({n: v.model_dump() for n in (*self.factors, "limits") if (v := getattr(self, n))})


def _keys() -> Mapping[str, ErrorKind | None]:
    """Every tolerance's key with its kind of error, None for form."""
    return _keys_of(tuple(map(id, KINDS.values())))


# Kinds may be added. With `Tolerances.factors` kept, 1.5 times as many drives are drawn a second.
@functools.lru_cache(maxsize=4)
def _keys_of(kinds: tuple[int, ...]) -> Mapping[str, ErrorKind | None]:
    found = {kind.tolerance.key: kind for kind in KINDS.values() if kind.tolerance is not None}
    return types.MappingProxyType({**{name: found.get(name) for name in _FIRST_AXES}, **found})


def file_model() -> type[Config]:
    """Return the model of a tolerance file: a table for each kind that has a tolerance, for form, limits and costs."""
    return _file_model(tuple(_keys()))


@functools.cache
def _file_model(keys: tuple[str, ...]) -> type[Config]:
    def model(kind: ErrorKind | None) -> type[Config]:
        if kind is None:
            return ProfileErrors
        assert kind.tolerance is not None
        if kind.tolerance.form == "pitch":
            return PitchErrors
        return AngleError if kind.unit == "rad" else LengthError

    fields: dict[str, Any] = {key: (model(kind) | None, None) for key, kind in _keys().items()}
    fields |= {name: (Tolerances.model_fields[name].annotation, Tolerances.model_fields[name]) for name in _OTHERS}
    return pydantic.create_model("Tolerances", __base__=Config, **fields)


def parse_tolerances(text: str, source: str) -> Tolerances:
    """Return the tolerances of a TOML text.

    Raises
    ------
    edge.InputError
        If it is not a valid table of tolerances; one sentence for each problem, with field, value and `source`.
    """
    read = edge.validated(file_model(), edge.toml_table(text, FORMAT, source), source)
    try:
        return Tolerances(**{name: value for name, value in read if value is not None})
    except edge.InputError as problem:
        raise edge.InputError(f"{source}: {problem}") from None


def read_tolerances(path: str | os.PathLike[str]) -> Tolerances:
    """Return the tolerances of a file; an `edge.InputError` names the invalid entries.

    Examples
    --------
    >>> import cycloid_fmu as cy, pathlib
    >>> lines = ['format = "cycloid-tolerances/1"', "[pin_radius]", 'tolerance = "2 um"']
    >>> _ = pathlib.Path("tolerances.toml").write_text(chr(10).join(lines))
    >>> cy.read_tolerances("tolerances.toml").pin_radius.tolerance
    2e-06
    """
    return parse_tolerances(edge.read_text(path), str(path))


def error_stream(seed: int, error: str) -> np.random.Generator:
    """Return the random stream of one error: a child of the seed by the error's name, independent of other errors."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(zlib.crc32(error.encode()),)))


def within_tolerance(probability: Array, tolerance: float, distribution: Distribution) -> Array:
    """Return the quantiles of an error within ± `tolerance`.

    Parameters
    ----------
    probability
        Between 0 and 1, any shape.
    tolerance
        m or rad, ≥ 0.
    distribution
        "uniform", or "normal" cut off at the tolerance, at three standard deviations.
    """
    if distribution == "uniform":
        return tolerance * (2.0 * probability - 1.0)
    from scipy.special import ndtr, ndtri  # only here: a drive's file is read without

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

    The single pitches are independent, of the stated distribution, under the conditions that the circle closes (they
    sum to zero), that each keeps the single limit and their running sum the cumulative one: the density is the product
    of theirs, cut off at the limits. It is sampled by a Markov chain from the error-free circle that exchanges
    deviation between two pitches, neighbouring and distant ones in turn, many times each. There is no rejection until
    all limits hold, so a tight cumulative limit costs no more than a wide one.
    """
    if errors.single == 0.0:
        return np.zeros(teeth)
    moves = 2 * _SWEEPS * teeth
    first = generator.integers(teeth, size=moves)
    apart = generator.integers(1, teeth, size=moves)
    apart[::2] = 1
    # In units of the single limit, so that the chain is the same one at every scale.
    positions = np.zeros(teeth)
    _exchange(
        positions, first, (first + apart) % teeth, generator.random((moves, 2)), _WITHIN,
        _WITHIN * errors.cumulative / errors.single, 1.0 / 3.0 if errors.distribution == "normal" else 0.0,
    )  # fmt: skip
    return np.asarray((positions - positions.mean()) * errors.single)


def _waves(length: float, count: int) -> Array:
    """Waves whose random sum is smooth with the given correlation length, at `count` elements, shape (count, waves).

    The spectrum is that of the correlation exp(-u²/(2 length²)) with a period longer than the surface by four lengths,
    so that its two ends are uncorrelated. The waves don't depend on `count`: finer elements have the same form.
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

    A standard normal field, smooth by its correlation lengths or white, is mapped element by element to the stated
    distribution (a Gaussian copula): each element has exactly that distribution and the range keeps its tolerance.
    """
    from scipy.special import ndtr

    if errors.correlation is None:
        field = generator.standard_normal((surfaces, profile, width))
    else:
        along, across = _waves(errors.correlation.profile, profile), _waves(errors.correlation.width, width)
        weights = generator.standard_normal((surfaces, along.shape[1], across.shape[1]))
        # einsum sums in one order, always; a threaded matrix product need not.
        field = np.einsum("spn,wn->spw", np.einsum("pm,smn->spn", along, weights), across)
    return within_tolerance(ndtr(field), 0.5 * errors.tolerance, errors.distribution)


def sample_surface(pair: Pair, tolerances: Tolerances, seed: int, elements: Elements | None = None) -> ErrorSurface:
    """Draw one drive within tolerances, as an error surface of origin "sampled".

    Parameters
    ----------
    pair
        The nominal pair; the errors stated in its file are not part of the sample.
    tolerances
        The tolerances; they and the seed are stated in the surface's attributes.
    seed
        0 … 2^63 - 1. The same seed gives the same surface; each error is independent of the other tolerances.
    elements
        Sizes of the deviation arrays; the default is `Elements()`.

    Raises
    ------
    edge.InputError
        If the seed is out of range.
    """
    if not 0 <= seed <= LARGEST_SEED:
        raise edge.InputError(f"seed = {seed}: it must be between 0 and {LARGEST_SEED}.")
    streams = {name: error_stream(seed, name) for name in tolerances.factors}
    drawn = _drawn(pair, tolerances, streams, {}, elements or Elements())
    return drawn.replace(attributes={"seed": seed, "tolerances": tolerances.text})


def surface_at(
    pair: Pair, tolerances: Tolerances, point: Mapping[str, float], elements: Elements | None = None
) -> ErrorSurface:
    """Return the drive at a point of the unit cube that has one axis for each of the tolerances' `factors`.

    A single error is its distribution's quantile there. Errors with many values (pitch, form, each pin's radius) are
    drawn from a stream that the coordinate seeds: evenly spread points spread the single errors evenly, and the others
    stay random.
    """
    many = (name for name in tolerances.factors if (kind := _keys()[name]) is None or kind.of != "drive")
    streams = {name: error_stream(int(point[name] * 2.0**53), name) for name in many}
    return _drawn(pair, tolerances, streams, point, elements or Elements())


def _drawn(
    pair: Pair,
    tolerances: Tolerances,
    streams: Mapping[str, np.random.Generator],
    point: Mapping[str, float],
    size: Elements,
) -> ErrorSurface:
    """Draw each error from its stream, single ones at the probability in `point` if it has one."""
    changes: dict[str, Any] = {}
    for name in tolerances.factors:
        kind, error = _keys()[name], tolerances.of(name)
        if isinstance(error, ProfileErrors):
            if name == "gear_profile":
                flanks = sample_profile(streams[name], pair.discs * pair.gear_teeth, size.profile, size.width, error)
                changes["gear_deviation"] = flanks.reshape(pair.discs, pair.gear_teeth, size.profile, size.width)
            else:
                changes["pin_deviation"] = sample_profile(streams[name], pair.pins, size.angle, size.width, error)
            continue
        assert kind is not None
        assert kind.tolerance is not None
        assert error is not None
        if kind.of not in pair.places:
            raise edge.InputError(f"[{name}]: the pair has no supports that can have this error.")
        shape = kind.shape(pair)
        if isinstance(error, PitchErrors):
            circles = [sample_pitch(streams[name], shape[-1], error) for _ in range(math.prod(shape[:-1]))]
            changes[kind.name] = np.reshape(circles, shape)
            continue
        chance = np.array(point[name]) if name in point and not shape else streams[name].random(shape)
        changes[kind.name] = kind.tolerance.share * within_tolerance(chance, error.tolerance, error.distribution)
    return ErrorSurface(pair, origin="sampled").replace(**changes)
