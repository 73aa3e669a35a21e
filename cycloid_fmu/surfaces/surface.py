"""The error surface: the actual errors of manufacturing and assembly, in addition to the nominal pair.

Its errors are of the kinds of `cycloid_fmu.errors.kinds`; signs are those of docs/theory/errors.md.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import math
import types
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import edge
from cycloid_fmu.errors.kinds import KINDS, ErrorKind, by_file_key, kinds_of
from cycloid_fmu.errors.stated import Errors, values_of
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.supports import BEARINGS
from cycloid_fmu.geometry.temperature import Expansions

Array = NDArray[np.float64]
ORIGINS = ("nominal", "sampled", "measured", "identified", "worn")
_FLANKS, _PINS = ("disc", "tooth", "profile", "width"), ("pin", "angle", "width")
DEVIATIONS = {
    "gear_deviation": _FLANKS,
    "pin_deviation": _PINS,
    "gear_curvature": _FLANKS,
    "pin_curvature": _PINS,
}
DEVIATION_TEXTS = {
    "gear_deviation": "normal deviation of each element of the flanks, > 0 material added",
    "pin_deviation": "normal deviation of each element of the pins, > 0 material added",
    "gear_curvature": "curvature that wear adds to each element of the flanks, > 0 convex",
    "pin_curvature": "curvature that wear adds to each element of the pins, > 0 convex",
}
LARGEST_ELEMENT = 5e-4
# Fields of a pair that do not describe the manufactured parts: loads, limits and temperatures.
_OF_NO_SURFACE: Mapping[str, Any] = {
    "rated_torque": None,
    "pressure_limit": None,
    "contact_law": "capped",
    "temperature": None,
    "expansion": Expansions(),
}


@dataclass(frozen=True)
class Elements:
    """Numbers of elements: along a tooth's profile, across the width, and around the inner half of a pin."""

    profile: int = 200
    width: int = 20
    angle: int = 100

    def __post_init__(self) -> None:
        for name in ("profile", "width", "angle"):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"{name} = {getattr(self, name)}: a surface has at least one element in each direction"
                )


@dataclass(frozen=True)
class Ageing:
    """Ageing rates that a forecast adds to the states of a wear run.

    Attributes
    ----------
    crank_turns_per_second
        Crank turns per second of age.
    age, largest_age
        Age of the surface's present deviations, and the largest age of the life for any wear factor, s.
    smallest_wear_factor, largest_wear_factor
        Interval of the ratio of the wear coefficient to its median.
    clearance_per_second
        Growth of the diametral clearance of `bearing`, m/s.
    bearing
        Name of the wearing bearing in `[supports]`; empty if there is none.
    """

    crank_turns_per_second: float
    age: float
    largest_age: float
    smallest_wear_factor: float = 1.0
    largest_wear_factor: float = 1.0
    clearance_per_second: float = 0.0
    bearing: str = ""


@dataclass(frozen=True)
class Life:
    """Deviations of a wearing drive over its life; the first axis of each array is the state.

    `crank_turns` (states,) ascends from 0; the other arrays are as in an `ErrorSurface`. `ageing` has the rates of a
    forecast.
    """

    crank_turns: Array
    gear_deviation: Array
    pin_deviation: Array
    gear_curvature: Array
    pin_curvature: Array
    ageing: Ageing | None = dataclasses.field(default=None, kw_only=True)

    @property
    def arrays(self) -> dict[str, Array]:
        """The arrays of the states by name."""
        return {name: values for name, values in vars(self).items() if name != "ageing"}


@dataclass(frozen=True, eq=False, init=False)
class ErrorSurface:
    """The actual errors of one pair, SI, validated against it.

    Each kind of error is an attribute too: `surface.pin_radius` is a float, `surface.pin_radial` an array (pins,),
    `surface.tooth_cumulative_pitch` one (discs, teeth). Surfaces are equal if their pairs, errors, deviations and lives
    are; arrays are read-only.

    Attributes
    ----------
    pair
        The nominal pair.
    errors
        Values of every kind by its name, m or rad; those not given are zero.
    gear_deviation
        Normal deviation of each element of the flanks, > 0 material added, shape (discs, teeth, profile, width), m; or
        None if the flanks are nominal. Elements have equal arc length from a tooth's first root to its second
        (`profile.equal_arc_parameters`) and equal width from -z to +z; values are those at their middles.
    pin_deviation
        Normal deviation of each element of the pins, > 0 material added, shape (pins, angle, width), m; or None.
        Elements have equal angles over the half of the pin that faces the pin circle's centre: the angle is counted
        counter-clockwise about the pin's axis, from -90° to +90° from the direction to that centre.
    gear_curvature, pin_curvature
        Curvature that wear adds to the same elements, > 0 convex, shapes as for the deviations, 1/m; or None if the
        deviations do not change the curvature (form and roughness too fine for the contact to follow).
    life
        States of a worn surface from new to the present deviations, in a forecast beyond them; otherwise None.
    origin
        One of `ORIGINS`.
    covariance_of, covariance
        Names of fitted parameters, shape (parameters,), and their covariance, shape (parameters, parameters).
    attributes
        Further provenance (seed, turns, data checksum), written as attributes of the file.

    Raises
    ------
    edge.InputError
        If a kind is unknown, an array does not have the pair's shape, or a value is not finite or beyond its kind's
        limit.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> pair = cy.Pair(
    ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
    ... )
    >>> surface = cy.ErrorSurface(pair, pin_radius="-1 um")
    >>> surface.pin_radius, surface.pin_radial.shape
    (-1e-06, (40,))
    >>> surface.replace(pin_radial=[1e-6, 2e-6, 3e-6])
    Traceback (most recent call last):
    ...
    cycloid_fmu.edge.problems.InputError: pin_radial has the shape (3,); the pair needs (40,).
    """

    pair: Pair
    errors: Mapping[str, Any]
    gear_deviation: Array | None
    pin_deviation: Array | None
    gear_curvature: Array | None
    pin_curvature: Array | None
    life: Life | None
    origin: str
    covariance_of: tuple[str, ...]
    covariance: Array | None
    attributes: Mapping[str, Any]

    def __init__(
        self,
        pair: Pair,
        errors: Mapping[str, Any] | None = None,
        *,
        gear_deviation: ArrayLike | None = None,
        pin_deviation: ArrayLike | None = None,
        gear_curvature: ArrayLike | None = None,
        pin_curvature: ArrayLike | None = None,
        life: Life | None = None,
        origin: str = "nominal",
        covariance_of: tuple[str, ...] = (),
        covariance: Array | None = None,
        attributes: Mapping[str, Any] | None = None,
        **kinds: Any,
    ) -> None:
        given = {**(errors or {}), **kinds}
        for name in given:
            if name not in KINDS:
                raise edge.InputError(_unknown(name))
        self._set("pair", pair.nominal)
        possible = kinds_of(pair)
        for name in given:
            if name not in possible:
                raise edge.InputError(f"{name}: the pair has no supports that can have this error.")
        values = {n: _checked(k, given[n], pair) if n in given else _zero(k, pair) for n, k in possible.items()}
        self._set("errors", types.MappingProxyType(values))
        for name, array in zip(DEVIATIONS, (gear_deviation, pin_deviation, gear_curvature, pin_curvature), strict=True):
            self._set(name, _checked_deviation(name, array, pair))
        for name, value in (
            ("life", life),
            ("origin", origin),
            ("covariance_of", covariance_of),
            ("covariance", covariance),
            ("attributes", dict(attributes or {})),
        ):
            self._set(name, value)
        self._check_together()

    def _set(self, name: str, value: object) -> None:
        object.__setattr__(self, name, value)

    def _check_together(self) -> None:
        """Check deviations, curvatures and life against each other."""
        _check_curvatures(self)
        if self.life is not None:
            _check_life(self)
        if self.origin not in ORIGINS:
            raise edge.InputError(f'origin = "{self.origin}": it must be one of {", ".join(ORIGINS)}.')

    def __getattr__(self, name: str) -> Any:
        errors = self.__dict__.get("errors")
        if errors is None or name not in errors:
            raise AttributeError(f"an error surface has no {name}")
        return errors[name]

    def replace(self, **changes: Any) -> Self:
        """Return a copy with changed errors (by the names of their kinds) or attributes; the rest is kept.

        Raises
        ------
        edge.InputError
            As in construction.
        """
        errors = {name: changes.pop(name) for name in list(changes) if name in KINDS}
        if "pair" in changes or "errors" in changes:
            values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)} | changes
            return type(self)(**{**values, "errors": {**values["errors"], **errors}})
        new = object.__new__(type(self))
        new.__dict__.update({n: v for n, v in self.__dict__.items() if n in self.__dataclass_fields__})
        checked = {name: _checked(KINDS[name], value, self.pair) for name, value in errors.items()}
        new._set("errors", types.MappingProxyType({**self.errors, **checked}))
        for name, value in changes.items():
            if name not in self.__dataclass_fields__:
                raise edge.InputError(_unknown(name))
            new._set(name, _checked_deviation(name, value, self.pair) if name in DEVIATIONS else value)
        new._check_together()
        return new

    def __reduce__(self) -> Any:
        values = {f.name: getattr(self, f.name) for f in dataclasses.fields(self)}
        return (_unpickled, (type(self), {**values, "errors": dict(self.errors)}))

    @functools.cached_property
    def hash(self) -> str:
        """Fingerprint of the values: the first 16 hexadecimal digits of SHA-256 over pair, errors and deviations."""
        made = self.pair.replace(**_OF_NO_SURFACE)
        digest = hashlib.sha256(made.text.encode())
        for name, value in self._values().items():
            # An error that is zero everywhere is the same drive as an unstated one.
            if value is not None and (name in DEVIATIONS or np.any(value)):
                array = np.asarray(value, dtype="<f8") + 0.0
                digest.update(f"{name}{array.shape}".encode() + array.tobytes())
        return digest.hexdigest()[:16]

    def _values(self) -> dict[str, Any]:
        life: dict[str, Any] = {}
        if self.life is not None:
            life = {f"life_{n}": v for n, v in self.life.arrays.items()}
            if self.life.ageing is not None:
                life["life_ageing"] = [v for v in vars(self.life.ageing).values() if not isinstance(v, str)]
        return {**self.errors, **{n: getattr(self, n) for n in DEVIATIONS}, **life}

    def __eq__(self, other: object) -> bool:
        return self.hash == other.hash if isinstance(other, ErrorSurface) else NotImplemented

    def __hash__(self) -> int:
        return hash(self.hash)


def _unpickled(cls: type[ErrorSurface], values: dict[str, Any]) -> ErrorSurface:
    return cls(**values)


def _unknown(name: str) -> str:
    return f"{name}: an error surface has no error of this kind; {edge.did_you_mean(name, KINDS) or 'check its name.'}"


def _frozen(values: ArrayLike) -> Array:
    array = np.array(values, dtype=float)
    array.flags.writeable = False
    return array


def _zero(kind: ErrorKind, pair: Pair) -> Array | float:
    shape = kind.shape(pair)
    return _frozen(np.zeros(shape)) if shape else 0.0


def _checked(kind: ErrorKind, given: Any, pair: Pair) -> Array | float:
    """Check the values of one kind against its shape and limit."""
    shape = kind.shape(pair)
    if isinstance(given, str):
        given = edge.parse_quantity(given, kind.unit)
    array = _frozen(given)
    if array.shape != shape:
        raise edge.InputError(f"{kind.name} has the shape {array.shape}; the pair needs {shape}.")
    # Written so that NaN is refused too.
    if not (np.abs(array) <= kind.limit).all():
        if not np.isfinite(array).all():
            raise edge.InputError(f"{kind.name} holds a value that is not finite.")
        unit = "mrad" if kind.unit == "rad" else "mm"
        raise edge.InputError(
            f"{kind.name} reaches {np.abs(array).max() * 1e3:.4g} {unit}; "
            f"it must be within ± {kind.limit * 1e3:g} {unit}."
        )
    return array if shape else float(array)


def _checked_deviation(name: str, given: Any, pair: Pair) -> Array | None:
    """Check one array of deviations; profile, angle and width may have any number of elements."""
    if given is None:
        return None
    values = _frozen(given)
    dimensions = DEVIATIONS[name]
    if values.ndim != len(dimensions):
        raise edge.InputError(
            f"{name} has the shape {values.shape}; it needs one axis each for {', '.join(dimensions)}."
        )
    sizes = {"disc": pair.discs, "tooth": pair.gear_teeth, "pin": pair.pins}
    for dimension, size in zip(dimensions, values.shape, strict=True):
        if size == 0 or size != sizes.get(dimension, size):
            raise edge.InputError(
                f"{name} has {size} of {dimension}; the pair needs {sizes.get(dimension, 'at least 1')}."
            )
    if not np.isfinite(values).all():
        raise edge.InputError(f"{name} holds a value that is not finite.")
    if name.endswith("_deviation") and (largest := np.abs(values).max()) > LARGEST_ELEMENT:
        raise edge.InputError(f"{name} reaches {largest * 1e3:.4g} mm; deviations must be within half a millimetre.")
    return values


def _check_curvatures(surface: ErrorSurface) -> None:
    """Check that curvatures are given for both bodies, each with deviations of the same elements."""
    if surface.gear_curvature is None and surface.pin_curvature is None:
        return
    for name in DEVIATIONS:
        if getattr(surface, name) is None:
            raise edge.InputError(f"the variable {name} is missing; curvatures need all of {', '.join(DEVIATIONS)}.")
    for body in ("gear", "pin"):
        mine, theirs = (getattr(surface, f"{body}_{kind}").shape for kind in ("curvature", "deviation"))
        if mine != theirs:
            raise edge.InputError(
                f"{body}_curvature has the shape {mine}; it must have that of {body}_deviation, {theirs}."
            )


def _check_life(surface: ErrorSurface) -> None:
    """Check that the states of the life match the surface's deviations."""
    life = surface.life
    assert life is not None
    turns = life.crank_turns
    if turns.ndim != 1 or turns.size == 0 or turns[0] != 0.0 or not (np.diff(turns) > 0.0).all():
        raise edge.InputError("life_crank_turns must grow from 0, one value for each state.")
    for name in DEVIATIONS:
        own, given = getattr(surface, name), getattr(life, name)
        if own is None or given.shape != (turns.size, *own.shape):
            raise edge.InputError(f"life_{name} is missing or its shape is not that of {name} for each state.")
        if not np.isfinite(given).all():
            raise edge.InputError(f"life_{name} holds a value that is not finite.")
    if life.ageing is not None:
        _check_ageing(life.ageing, float(turns[-1]))


def _check_ageing(ageing: Ageing, crank_turns: float) -> None:
    """Check that the ageing is within the life."""
    numbers = [v for v in vars(ageing).values() if not isinstance(v, str)]
    given = ageing.largest_age * ageing.crank_turns_per_second * ageing.largest_wear_factor
    low, high = ageing.smallest_wear_factor, ageing.largest_wear_factor
    if not (
        np.isfinite(numbers).all()
        and ageing.crank_turns_per_second > 0.0
        and 0.0 <= ageing.age <= ageing.largest_age
        and 0.0 < low <= 1.0 <= high
        and ageing.clearance_per_second >= 0.0
        and ageing.bearing in ("", *BEARINGS)
        and given <= crank_turns * (1.0 + 1e-9)
    ):
        raise edge.InputError("life_ageing: its ages and wear factors must be finite and within the life's states.")


def nominal_surface(pair: Pair) -> ErrorSurface:
    """Return the surface without errors of a pair."""
    return ErrorSurface(pair)


def surface_of_pair(pair: Pair) -> ErrorSurface:
    """Return the surface with the stated errors of a pair."""
    return ErrorSurface(pair, stated_values(pair, pair.errors))


def stated_values(pair: Pair, errors: Errors) -> dict[str, Any]:
    """Return the values of the stated errors by their kinds' names, m or rad, in the shapes of the pair."""
    kinds = by_file_key()
    return {kinds[key].name: values_of(kinds[key], stated, kinds[key].shape(pair)) for key, stated in errors.items()}


def surface_after(surface: ErrorSurface, crank_turns: float) -> ErrorSurface:
    """Return a worn surface at another time of its life, linear between its states.

    Raises
    ------
    edge.ArgumentError
        If it has no life, or the life ends earlier.
    """
    life = surface.life
    if life is None:
        problem = "needs a worn drive; give a surface written by cycloid-fmu wear -o or cycloid-fit forecast --twin"
        raise edge.ArgumentError("crank_turns", problem)
    turns, last = life.crank_turns, life.crank_turns.size - 1
    if not 0.0 <= crank_turns <= turns[-1]:
        limit = f"it must be between 0 and {turns[-1]:g}, the end of the life"
        raise edge.ArgumentError("crank_turns", limit, crank_turns)
    after = min(max(int(np.searchsorted(turns, crank_turns)), 1), last)
    before = min(after - 1, last)
    span = turns[after] - turns[before]
    share = (crank_turns - turns[before]) / span if span > 0.0 else 0.0
    mixed = {n: (1.0 - share) * getattr(life, n)[before] + share * getattr(life, n)[after] for n in DEVIATIONS}
    return surface.replace(**mixed)


def at_age(pair: Pair, surface: ErrorSurface, age: float, wear_factor: float = 1.0) -> tuple[Pair, ErrorSurface]:
    """Return a drive with a forecast at an age: the pair with its grown clearance, and the worn surface without life.

    Parameters
    ----------
    pair, surface
        The nominal pair, and its errors with a life and its `Ageing`.
    age
        Running time since new, s.
    wear_factor
        Ratio of the wear coefficient to the forecast's median.

    Raises
    ------
    edge.ArgumentError
        If the surface has no forecast, or the age or the factor is outside of it.
    """
    ageing = None if surface.life is None else surface.life.ageing
    if surface.life is None or ageing is None:
        problem = "needs a drive with a forecast; give a surface written by cycloid-fit forecast --twin"
        raise edge.ArgumentError("age", problem, age)
    low, high = ageing.smallest_wear_factor, ageing.largest_wear_factor
    if not 0.0 <= age <= ageing.largest_age:
        last = ageing.largest_age
        limit = f"it must be between 0 and {last:g} s ({last / 3600.0:g} h), the end of the forecast"
        raise edge.ArgumentError("age", limit, age)
    if not low <= wear_factor <= high:
        raise edge.ArgumentError("wear_factor", f"it must be between {low:g} and {high:g}", wear_factor)
    # Rounding must not exceed the life's end.
    turns = min(age * ageing.crank_turns_per_second * wear_factor, float(surface.life.crank_turns[-1]))
    return _with_clearance(pair, surface_after(surface, turns), ageing, age)


def at_own_age(pair: Pair, surface: ErrorSurface) -> tuple[Pair, ErrorSurface]:
    """Return a drive as its surface is now, without life; with a forecast, the pair has the clearance of this age."""
    if surface.life is None:
        return pair, surface
    if surface.life.ageing is None:
        return pair, surface.replace(life=None)
    return _with_clearance(pair, surface, surface.life.ageing, surface.life.ageing.age)


def _with_clearance(pair: Pair, surface: ErrorSurface, ageing: Ageing, age: float) -> tuple[Pair, ErrorSurface]:
    if ageing.bearing and pair.supports is not None:
        pair = pair.replace(supports=pair.supports.grown(ageing.bearing, ageing.clearance_per_second * age))
    return pair, surface.replace(pair=pair.nominal, life=None)


def alike(surface: ErrorSurface) -> tuple[bool, bool]:
    """Return whether all teeth of each disc are equal, and whether all pins are equal, including errors of the frame.

    Errors of the frame make the parts at rest unequal: the pins if the gear is the output, the teeth if the ring is. If
    both are equal, everything repeats from pin to pin.
    """
    parts = {"pins": True, "teeth": True, "frame": True}
    for name, values in surface.errors.items():
        kind = KINDS[name]
        if kind.breaks:
            # One value makes parts unequal if it is not zero, many values if they are not the same.
            parts[kind.breaks] &= not np.any(values if kind.of == "drive" else np.ptp(values, axis=-1))
    for name, axis, part in (("gear", 1, "teeth"), ("pin", 0, "pins")):
        for what in ("deviation", "curvature"):
            values = getattr(surface, f"{name}_{what}")
            parts[part] &= values is None or not np.ptp(values, axis=axis).any()
    still = "pins" if surface.pair.output == "gear" else "teeth"
    parts[still] &= parts["frame"]
    return parts["teeth"], parts["pins"]


def _shown(value: Any) -> str:
    """Return the value of a pair's field as text for a message."""
    if value is None or isinstance(value, edge.Config):
        return "not stated" if value is None else "stated"
    return f"{value:.9g}" if isinstance(value, float) else str(value)


def _difference(field: str, one: Any, other: Any) -> tuple[str, Any, Any] | None:
    """Return the first field in which two values differ by more than rounding, with both values; None if equal."""
    if isinstance(one, edge.Config) and isinstance(other, edge.Config):
        parts = (
            _difference(f"[{field.split()[-1]}] {name}", getattr(one, name), getattr(other, name))
            for name in type(one).model_fields
        )
        return next((found for found in parts if found is not None), None)
    same = (
        math.isclose(one, other, rel_tol=1e-12) if isinstance(one, float) and isinstance(other, float) else one == other
    )
    return None if same else (field, one, other)


def check_surface(pair: Pair, surface: ErrorSurface, pair_source: str, surface_source: str) -> None:
    """Check that a surface was made for a pair: geometry, modification and material must be the same.

    Raises
    ------
    edge.InputError
        If they differ; it names the first differing field, both values and both files.
    """
    mine, theirs = pair.nominal, surface.pair
    for name in type(pair).model_fields:
        if name in _OF_NO_SURFACE:
            continue
        field, one, other = _difference(f"[pair] {name}", getattr(mine, name), getattr(theirs, name)) or ("", 0, 0)
        if field:
            raise edge.InputError(
                f"{surface_source}: this surface belongs to another pair: {field} is {_shown(other)} there and "
                f"{_shown(one)} in {pair_source}."
            )
