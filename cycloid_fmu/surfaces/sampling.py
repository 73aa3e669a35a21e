"""Error surfaces sampled from tolerances.

The error-surface paper, section 2: every manufacturing error is distributed within its tolerance, and the pitch
deviations also meet the tolerance of the total cumulative pitch deviation. The file is TOML, `cycloid-tolerances/1`.

Errors of size, position, assembly and single pitch are within ± their tolerance. Two tolerances are ranges, as in the
standard (ISO 1328-1): the total profile deviation is the largest minus the smallest deviation over a tooth's or pin's
surface, the total cumulative pitch deviation the largest minus the smallest position of all teeth.
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
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.edge import Angle, Config, Length
from cycloid_fmu.edge.kernels import kept_njit
from cycloid_fmu.errors.kinds import KINDS, LARGEST_DEVIATION, LARGEST_MISALIGNMENT, ErrorKind
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.surface import LARGEST_ELEMENT, Elements, ErrorSurface

Array = NDArray[np.float64]
Distribution = Literal["normal", "uniform"]
FORMAT = "cycloid-tolerances/1"
LARGEST_SEED = 2**63 - 1
# Axes of a study's points in the first version, in this order, so that a seed's drives stay the same; other kinds
# follow.
_FIRST_AXES = (
    "gear_profile",
    "pin_profile",
    "gear_pitch",
    "pin_pitch",
    "pin_circle_diameter",
    "pin_radius",
    "pin_radius_each",
    "eccentricity",
    "centre_distance_x",
    "centre_distance_y",
    "misalignment_xz",
    "misalignment_yz",
    "isometric",
    "offset",
)
_OTHERS = ("limits", "costs")
# Share of the permitted pitch deviation that is used, so that rounding in the sums of positions stays within the limit.
_WITHIN = 1.0 - 1e-9
# Visits of each pitch: with ten, statistics of 3000 circles do not differ significantly from those with 400.
_SWEEPS = 20
_ABOVE_ZERO = pydantic.Field(gt=0.0, allow_inf_nan=False)


def _up_to(largest: float, shown: str) -> pydantic.AfterValidator:
    def check(value: float) -> float:
        if not 0.0 <= value <= largest:
            raise ValueError(f"tolerances must be between 0 and {shown}")
        return value

    return pydantic.AfterValidator(check)


def _not_below_zero(value: float) -> float:
    if value < 0.0:
        raise ValueError("a limit must not be below zero")
    return value


LargestAngle = Annotated[Angle, pydantic.AfterValidator(_not_below_zero)]
LargestLength = Annotated[Length, pydantic.AfterValidator(_not_below_zero)]
LargestPressure = Annotated[edge.Pressure, pydantic.AfterValidator(_not_below_zero)]
LengthTolerance = Annotated[Length, _up_to(LARGEST_DEVIATION, "1 mm")]
AngleTolerance = Annotated[Angle, _up_to(LARGEST_MISALIGNMENT, "20 mrad")]
ZoneTolerance = Annotated[Length, _up_to(2.0 * LARGEST_ELEMENT, "1 mm")]


class LengthError(Config):
    """An error within ± its tolerance.

    Attributes
    ----------
    tolerance
        Largest magnitude of the error, m.
    distribution
        Distribution of the error; a normal one is truncated at the tolerance, at three standard deviations.
    """

    tolerance: LengthTolerance
    distribution: Distribution = "normal"


class AngleError(Config):
    """An angle within ± its tolerance.

    Attributes
    ----------
    tolerance
        Largest magnitude of the angle, rad.
    distribution
        Distribution of the angle; a normal one is truncated at the tolerance, at three standard deviations.
    """

    tolerance: AngleTolerance
    distribution: Distribution = "normal"


class PitchErrors(Config):
    """Positions of teeth or pins around the circle, as arc length at the pin circle radius, m.

    Attributes
    ----------
    single
        Tolerance of single pitch deviations, ± m.
    cumulative
        Largest permitted range of the positions of all teeth, m.
    distribution
        Distribution of each single pitch, before closing the circle and applying the cumulative limit.
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
                "it is too small: one pitch at the single tolerance already causes this cumulative deviation, "
                f'so it must be at least "{single * 1e6:.6g} um"'
            )
        return cumulative


class Correlation(Config):
    """Correlation lengths of a form deviation: deviations at this distance have a correlation of exp(-1/2).

    The defaults give about two waves along a tooth's profile and one across its width.

    Attributes
    ----------
    profile
        Correlation length along the profile, as a fraction of it.
    width
        Correlation length across the face width, as a fraction of it.
    """

    profile: float = pydantic.Field(default=0.15, ge=0.005, le=100.0)
    width: float = pydantic.Field(default=0.5, ge=0.005, le=100.0)


def _correlation(value: Any) -> Any:
    if value is None or isinstance(value, (dict, Correlation)):
        return value
    if value == "none":
        return None
    raise ValueError('write { profile = 0.15, width = 0.5 }, fractions of profile and face width, or "none"')


class ProfileErrors(Config):
    """The form of flanks or pins: normal deviations of their elements, m.

    Attributes
    ----------
    tolerance
        Total profile deviation, m: the elements of a tooth are within ± half of it, so their range is within it.
    distribution
        Distribution of each element; a normal one is truncated at half the tolerance, at three standard deviations.
    correlation
        Correlation lengths; None (in the file "none") for independent elements, as in the error-surface paper.
    """

    tolerance: ZoneTolerance
    distribution: Distribution = "normal"
    correlation: Annotated[Correlation | None, pydantic.BeforeValidator(_correlation)] = Correlation()


class Limits(Config):
    """Limits of an acceptable drive, each the largest allowed value unless stated otherwise.

    Attributes
    ----------
    angular_transmission_error
        Largest minus smallest transmission error over the crank angles, rad, at every load.
    backlash, lost_motion
        Largest backlash and lost motion over the crank angles, rad.
    interference
        Largest interference over the crank angles, m.
    max_contact_pressure
        Largest contact pressure, Pa, at every load.
    efficiency
        Smallest allowed of the driving drive, at every row of the duty that turns under load; by [losses].
    starting_torque
        Largest allowed at the input without a load, from rest, over the crank angles, N·m.
    back_driving_torque
        Largest allowed on the output that turns the drive backwards from rest, over the crank angles, N·m.
    self_locking
        Whether no torque up to the rated one may turn the drive backwards from rest (true: at no crank angle; false: at
        every crank angle some torque must).
    """

    angular_transmission_error: LargestAngle | None = None
    backlash: LargestAngle | None = None
    lost_motion: LargestAngle | None = None
    interference: LargestLength | None = None
    max_contact_pressure: LargestPressure | None = None
    efficiency: float | None = pydantic.Field(default=None, gt=0.0, le=1.0)
    starting_torque: Annotated[edge.Torque, _ABOVE_ZERO] | None = None
    back_driving_torque: Annotated[edge.Torque, _ABOVE_ZERO] | None = None
    self_locking: bool | None = pydantic.Field(default=None, strict=True)

    def stated(self) -> dict[str, float]:
        """Return the stated limits, SI."""
        return {n: v for n in type(self).model_fields if (v := getattr(self, n)) is not None}


class Tolerances(Config):
    """The tolerances of a drive; errors without tolerance are nominal.

    The arguments are the keys of the tolerances (`pin_circle_diameter` is the circle's diameter, `pin_radius` is common
    to all pins, `pin_radius_each` is that of each pin; `gear_pitch` and `pin_pitch` are positions around the circle),
    each a `LengthError`, `AngleError` or `PitchErrors`, or a table of its values. `limits` are those of an acceptable
    drive.

    Attributes
    ----------
    costs
        Relative cost of each tolerance at its stated width, by the tolerance's name; 1 where not stated.

    Raises
    ------
    edge.InputError
        If a key is unknown or a value is out of range; one sentence for each.

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
        """Return a copy with changed tolerances; None removes a tolerance and its cost."""
        values = {n: getattr(self, n) for n in (*self.factors, "limits")} | changes
        costs = {n: cost for n, cost in self.costs.items() if values.get(n) is not None}
        return type(self)(**{"costs": costs, **values})

    def of(self, factor: str) -> LengthError | AngleError | PitchErrors | ProfileErrors | None:
        """Return the tolerance of this name; None if there is none."""
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
    """Key of every tolerance with its kind of error; None for form deviations."""
    return _keys_of(tuple(map(id, KINDS.values())))


# Cached by the registered kinds, which may change. With cached `Tolerances.factors`, sampling is 1.5 times as fast.
@functools.lru_cache(maxsize=4)
def _keys_of(kinds: tuple[int, ...]) -> Mapping[str, ErrorKind | None]:
    found = {kind.tolerance.key: kind for kind in KINDS.values() if kind.tolerance is not None}
    return types.MappingProxyType({**{name: found.get(name) for name in _FIRST_AXES}, **found})


def file_model() -> type[Config]:
    """Return the model of a tolerance file: a table for each kind with a tolerance, for form, limits and costs."""
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
    """Return the tolerances of a file; raise an `edge.InputError` that names invalid entries.

    Examples
    --------
    >>> import cycloid_fmu as cy, pathlib
    >>> lines = ['format = "cycloid-tolerances/1"', "[pin_radius]", 'tolerance = "2 um"']
    >>> _ = pathlib.Path("tolerances.toml").write_text(chr(10).join(lines))
    >>> cy.read_tolerances("tolerances.toml").pin_radius.tolerance
    2e-06
    """
    return parse_tolerances(edge.read_text(path, FORMAT), str(path))


def error_stream(seed: int, error: str) -> np.random.Generator:
    """Return the random stream of one error, derived from seed and name, independent of other errors."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(zlib.crc32(error.encode()),)))


def within_tolerance(probability: Array, tolerance: float, distribution: Distribution) -> Array:
    """Return the quantiles of an error within ± `tolerance`.

    Parameters
    ----------
    probability
        Between 0 and 1, any shape.
    tolerance
        Tolerance, m or rad, ≥ 0.
    distribution
        "uniform", or "normal" truncated at the tolerance, which is three standard deviations.
    """
    if distribution == "uniform":
        return tolerance * (2.0 * probability - 1.0)
    from scipy.special import ndtr, ndtri  # imported here, because reading a drive does not need it

    tail = ndtr(-3.0)
    share = ndtri(tail + probability * (1.0 - 2.0 * tail)) / 3.0
    return np.asarray(np.minimum(np.maximum(share, -1.0), 1.0) * tolerance)


_Function = TypeVar("_Function", bound=Callable[..., None])


def _compiled(function: _Function) -> _Function:
    # Without NaN and signed zeros, minimum and maximum use vector instructions.
    return cast(_Function, kept_njit(fastmath={"nnan", "nsz"})(function))


@_compiled
def _exchange(
    positions: Array,
    first: NDArray[np.int64],
    apart: NDArray[np.int64],
    chances: Array,
    single: float,
    cumulative: float,
    sigma: float,
) -> None:
    """Run a Markov chain over the tooth positions of one circle, in place: a pitch gains as another one loses.

    Every second move, from the first on, is between neighbours, the others `apart`. Teeth between both pitches move
    together by a uniform draw over all moves that meet both limits; with a sigma above zero it is accepted by the ratio
    of normal densities (Metropolis), so that the limits only truncate the distribution.
    """
    n = positions.size
    lowest, highest = positions.min(), positions.max()
    width = 2.0 * sigma * sigma if sigma > 0.0 else np.inf
    for move in range(first.size):
        alone = move % 2 == 0
        i = first[move]
        j = i + (1 if alone else apart[move])
        j -= n if j >= n else 0
        # The moved teeth i + 1 … j are one contiguous run of the array, or for i > j all but one.
        low_end, high_end = min(i, j) + 1, max(i, j) + 1
        if alone:
            # Only tooth j moves: the others reach as far as all do, unless it is the outermost.
            moved_low = moved_high = positions[j]
            kept_low, kept_high = lowest, highest
            if moved_low == lowest or moved_high == highest:
                kept_low, kept_high = np.inf, -np.inf
                for k in range(j):
                    kept_low, kept_high = min(kept_low, positions[k]), max(kept_high, positions[k])
                for k in range(j + 1, n):
                    kept_low, kept_high = min(kept_low, positions[k]), max(kept_high, positions[k])
        else:
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
        after_i, after_j = i + 1 if i + 1 < n else 0, j + 1 if j + 1 < n else 0
        gains, loses = positions[after_i] - positions[i], positions[after_j] - positions[j]
        low = max(kept_high - moved_low - cumulative, -single - gains, loses - single)
        high = min(cumulative - moved_high + kept_low, single - gains, loses + single)
        shift = low + chances[move, 0] * (high - low)
        energy = ((gains + shift) ** 2 - gains**2 + (loses - shift) ** 2 - loses**2) / width
        # Not a branch, which the processor would predict wrong half of the time. With the above 1.7 times as fast.
        shift = shift if (high > low) & (chances[move, 1] < np.exp(-energy)) else 0.0
        if alone:
            positions[j] += shift
        elif i < j:
            for k in range(low_end, high_end):
                positions[k] += shift
        else:
            for k in range(low_end):
                positions[k] += shift
            for k in range(high_end, n):
                positions[k] += shift
        lowest, highest = min(moved_low + shift, kept_low), max(moved_high + shift, kept_high)


def sample_pitch(generator: np.random.Generator, teeth: int, errors: PitchErrors) -> Array:
    """Return the position errors of the teeth of one circle with zero mean, shape (teeth,), m.

    The single pitches are independent with the stated distribution, under the conditions that the circle closes (they
    sum to zero), that each meets the single limit and their running sum the cumulative limit: the density is the
    product of theirs, truncated at the limits. It is sampled by a Markov chain from the error-free circle that
    exchanges deviation between two pitches, alternating between neighbouring and distant ones, many times each. There
    is no rejection sampling, so a tight cumulative limit costs no more than a wide one.
    """
    if errors.single == 0.0:
        return np.zeros(teeth)
    moves = 2 * _SWEEPS * teeth
    first = generator.integers(teeth, size=moves)
    apart = generator.integers(1, teeth, size=moves)
    # In units of the single limit, so that the chain does not depend on the scale.
    positions = np.zeros(teeth)
    _exchange(
        positions,
        first,
        apart,
        generator.random((moves, 2)),
        _WITHIN,
        _WITHIN * errors.cumulative / errors.single,
        1.0 / 3.0 if errors.distribution == "normal" else 0.0,
    )
    return np.asarray((positions - positions.mean()) * errors.single)


def _waves(length: float, count: int) -> Array:
    """Waves at `count` elements whose random sum has the given correlation length, shape (count, waves).

    The spectrum is that of the correlation exp(-u²/(2 length²)) with a period four lengths longer than the surface, so
    that its two ends are uncorrelated. The waves do not depend on `count`: finer elements have the same form.
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

    A standard normal field, correlated or white, is mapped element by element to the stated distribution (a Gaussian
    copula): each element has exactly that distribution, and the range is within its tolerance.
    """
    from scipy.special import ndtr

    if errors.correlation is None:
        field = generator.standard_normal((surfaces, profile, width))
    else:
        along, across = _waves(errors.correlation.profile, profile), _waves(errors.correlation.width, width)
        weights = generator.standard_normal((surfaces, along.shape[1], across.shape[1]))
        # einsum always sums in the same order; a threaded matrix product may not.
        field = np.einsum("spn,wn->spw", np.einsum("pm,smn->spn", along, weights), across)
    return within_tolerance(ndtr(field), 0.5 * errors.tolerance, errors.distribution)


def sample_surface(pair: Pair, tolerances: Tolerances, seed: int, elements: Elements | None = None) -> ErrorSurface:
    """Draw one drive within tolerances, as an error surface of origin "sampled".

    Parameters
    ----------
    pair
        The nominal pair; its stated errors are not part of the sample.
    tolerances
        The tolerances; they and the seed are stored in the surface's attributes.
    seed
        0 … 2^63 - 1. The same seed gives the same surface; each error is independent of the other tolerances.
    elements
        Numbers of elements of the deviations; by default `Elements()`.

    Raises
    ------
    edge.ArgumentError
        If the seed is out of range.
    """
    if not 0 <= seed <= LARGEST_SEED:
        raise edge.ArgumentError("seed", f"it must be between 0 and {LARGEST_SEED}", seed)
    streams = {name: error_stream(seed, name) for name in tolerances.factors}
    drawn = _drawn(pair, tolerances, streams, {}, elements or Elements())
    return drawn.replace(attributes={"seed": seed, "tolerances": tolerances.text})


def surface_at(
    pair: Pair, tolerances: Tolerances, point: Mapping[str, float], elements: Elements | None = None
) -> ErrorSurface:
    """Return the drive at a point of the unit cube with one axis for each of the tolerances' `factors`.

    An error with one value is the quantile of its distribution at its coordinate. Errors with many values (pitch, form,
    each pin's radius) are drawn from a stream seeded by the coordinate: evenly spread points spread the former evenly,
    and the latter remain random.
    """
    kinds = _keys()
    many = (name for name in tolerances.factors if (kind := kinds[name]) is None or kind.of != "drive")
    streams = {name: error_stream(int(point[name] * 2.0**53), name) for name in many}
    return _drawn(pair, tolerances, streams, point, elements or Elements())


def _drawn(
    pair: Pair,
    tolerances: Tolerances,
    streams: Mapping[str, np.random.Generator],
    point: Mapping[str, float],
    size: Elements,
) -> ErrorSurface:
    """Draw each error from its stream, or an error with one value at its probability in `point`."""
    changes: dict[str, Any] = {}
    kinds = _keys()
    for name in tolerances.factors:
        kind, error = kinds[name], tolerances.of(name)
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
    return ErrorSurface(pair, origin="sampled", **changes)
