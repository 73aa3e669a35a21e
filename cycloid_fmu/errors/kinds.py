"""The kinds of error, each defined once: `KINDS`.

A kind states the name of an error in files, datasets, FMUs and identifications, its unit, sign and limit, the
displacements it causes, the parts it makes unequal, and its name in tolerance files. Everything else follows from it:
the keys of a pair file's `[errors]`, the variables of an error surface, the contact problem, the columns of its
sensitivities, the FMU's parameters, the samples of tolerance studies and the unknowns of an identification.
`register_error_kind` adds a kind.
"""

from __future__ import annotations

import functools
import re
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import Literal, Protocol

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


class Sizes(Protocol):
    """The dimensions of a pair that an error kind needs."""

    @property
    def pins(self) -> int:
        """z_p."""

    @property
    def places(self) -> Mapping[str, tuple[int, ...]]:
        """Shape of an error's values by `ErrorKind.of`: {"pin": (40,), …}."""

    @property
    def pin_circle_radius(self) -> float:
        """R_p, m."""


Displacement = Callable[[Sizes, Array], Array]

Of = Literal["drive", "pin", "tooth", "hole", "crank", "eccentric", "roller", "roller_hole"]

LARGEST_DEVIATION = 1e-3
ORDERS = (1, 2, 3)  # orders of the waves among the FMU's parameters and the sensitivities
LARGEST_MISALIGNMENT = 0.02
BODIES = (
    "centre_x",
    "centre_y",
    "tilt_x",
    "tilt_y",
    "crank_throw",
    "generating_pin_radius",
    "generating_circle_radius",
)
"""Displacements by one value: the gear's centre at mid-width (m), the tilt of its axis (rad), the crank's eccentricity,
and radius and circle radius of the generating pin, from which the flank is made (m)."""
EACH_PIN = ("pin_radial", "pin_tangential", "pin_radius")
"""Displacements of each pin: its place outwards and counter-clockwise, as arc at the pin circle radius, and its radius,
m. After these comes the rotation of each tooth about the gear's centre, `tooth_turn`, rad."""
EACH_SUPPORT = {
    "hole_x": "hole",
    "hole_y": "hole",
    "carrier_x": "support",
    "carrier_y": "support",
    "eccentric_throw": "eccentric",
    "eccentric_phase": "eccentric",
    "hole_play": "roller_hole",
}
"""Displacements of each part of the supports, with the parts concerned: holes in the disc's frame, cranks or
rollers in the carrier's frame, throw and phase of each eccentric, and the additional radial play of a roller in its
hole; m, phases in rad. They come last."""


@dataclass(frozen=True)
class Tolerance:
    """The name and form of a kind in a tolerance file.

    Attributes
    ----------
    key
        The table's name.
    form
        "each" is a number within ± a tolerance, one for the drive or one for each pin or tooth; "pitch" is a position
        round the circle with a single and a cumulative tolerance.
    share
        The error per unit of the toleranced quantity: 0.5 for a radius whose diameter has the tolerance.
    """

    key: str
    form: Literal["each", "pitch"] = "each"
    share: float = 1.0


@dataclass(frozen=True)
class ErrorKind:
    """One kind of error.

    Attributes
    ----------
    name
        Name of the variable in error surfaces and datasets, of the FMU's parameter and in identifications.
    text, sign
        Its meaning, and the meaning of a value above zero.
    of
        The parts that have one value each: the drive, each pin, each tooth of each disc; with supports each hole of
        each disc, each crank (cranks) or roller (output rollers) in the carrier, each eccentric and each output
        roller's hole of each disc.
    displaces
        By the names of `BODIES`, `EACH_PIN`, "tooth_turn" and `EACH_SUPPORT`: the displacement (m, or rad for tilts and
        turns) as a linear function of the pair and the error's values, shape () or (pins,) or (..., teeth).
    breaks
        The parts whose symmetry it breaks: "frame" (the parts at rest) if it is not zero, "pins" or "teeth" if it is
        not the same for all of them; "" if all stay equal.
    unit
        "m" or "rad".
    key
        Key in a pair file's `[errors]`; the name if empty.
    waves
        Whether its Fourier orders around the circle are structured errors, with a cosine and a sine part each.
    tolerance
        Its tolerance, None if it has none.

    Examples
    --------
    >>> from cycloid_fmu.errors.kinds import KINDS
    >>> KINDS["pin_radius"].description, KINDS["pin_radius"].unit
    ('radius error of all pins, > 0 thicker', 'm')
    """

    name: str
    text: str
    sign: str
    of: Of
    displaces: Mapping[str, Displacement]
    breaks: Literal["", "frame", "pins", "teeth"] = ""
    unit: Literal["m", "rad"] = "m"
    key: str = ""
    waves: bool = False
    tolerance: Tolerance | None = None

    @property
    def limit(self) -> float:
        """Largest plausible magnitude, m or rad."""
        return LARGEST_MISALIGNMENT if self.unit == "rad" else LARGEST_DEVIATION

    @property
    def file_key(self) -> str:
        """Key in a pair file's `[errors]`."""
        return self.key or self.name

    @property
    def description(self) -> str:
        """Meaning and sign in one phrase."""
        return f"{self.text}, {self.sign}"

    def shape(self, pair: Sizes) -> tuple[int, ...]:
        """Shape of its values for a pair: (), (pins,), (discs, teeth)…."""
        return pair.places[self.of]

    @property
    def of_supports(self) -> bool:
        """Whether it is an error of the supports, in a pair file's `[errors.supports]`."""
        return self.of not in ("drive", "pin", "tooth")


def _same(pair: Sizes, value: Array) -> Array:
    return value


def _all_pins(pair: Sizes, value: Array) -> Array:
    return np.full(pair.pins, value)


def _turn(pair: Sizes, value: Array) -> Array:
    return value / pair.pin_circle_radius


KINDS: dict[str, ErrorKind] = {}
"""Every kind by its name, in the order of files and FMUs.

:meta hide-value:
"""


def register_error_kind(kind: ErrorKind) -> ErrorKind:
    """Add an error kind; files, surfaces, sensitivities, studies, FMUs and identifications then support it.

    Raises
    ------
    ValueError
        If a kind of this name or key exists, or a displacement is unknown to the contact problem.

    Examples
    --------
    >>> import cycloid_fmu as cy, numpy as np
    >>> def three_lobes(pair, amount):
    ...     return amount * np.cos(3 * 2 * np.pi * np.arange(pair.pins) / pair.pins)
    >>> lobes = cy.ErrorKind("three_lobes", "ring held by three jaws", "> 0 outwards at pin 0", "drive",
    ...                      {"pin_radial": three_lobes}, breaks="pins")
    >>> _ = cy.register_error_kind(lobes)
    >>> cy.Pair(gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm",
    ...         errors={"three_lobes": "2 um"}).errors.three_lobes
    2e-06
    >>> from cycloid_fmu.errors.kinds import remove_error_kind
    >>> remove_error_kind("three_lobes")
    """
    known = {*BODIES, *EACH_PIN, "tooth_turn", *EACH_SUPPORT}
    if unknown := set(kind.displaces) - known:
        raise ValueError(f'displaces = "{sorted(unknown)[0]}": it must be one of {", ".join(sorted(known))}')
    for other in KINDS.values():
        if kind.name == other.name or kind.file_key == other.file_key:
            raise ValueError(f'name = "{kind.name}": a kind of this name or key exists')
    KINDS[kind.name] = kind
    _wave_names.cache_clear()
    return kind


def remove_error_kind(name: str) -> None:
    """Remove an added kind."""
    del KINDS[name]
    _wave_names.cache_clear()


@functools.cache
def _wave_names() -> re.Pattern[str]:
    names = "|".join(re.escape(k.name) for k in KINDS.values() if k.waves)
    return re.compile(rf"({names})_([1-9]\d*)_(cos|sin)")


def by_file_key() -> dict[str, ErrorKind]:
    """Return every kind by its key in a pair file's `[errors]`."""
    return {kind.file_key: kind for kind in KINDS.values()}


def kinds_of(pair: Sizes) -> dict[str, ErrorKind]:
    """Return the kinds that a pair can have, by their names."""
    places = pair.places
    return {name: kind for name, kind in KINDS.items() if kind.of in places}


def structured_names(orders: Collection[int]) -> list[str]:
    """Return the names of the structured errors.

    These are the kinds with one value, and the cosine and sine parts of the kinds with waves at the given orders.
    """
    found = []
    for kind in KINDS.values():
        if kind.of == "drive":
            found.append(kind.name)
        elif kind.waves:
            found += [f"{kind.name}_{order}_{part}" for order in orders for part in ("cos", "sin")]
    return found


def names_of(pair: Sizes) -> list[str]:
    """Return the structured errors of a pair: waves of the orders that its number of teeth can distinguish."""
    teeth = pair.places["tooth"][-1]
    return structured_names([order for order in ORDERS if 2 * order <= teeth])


def wave_of(name: str) -> tuple[ErrorKind, int, str] | None:
    """Return kind, order and part ("cos" or "sin") of a structured error that is a wave, None for any other name."""
    match = _wave_names().fullmatch(name)
    return None if match is None else (KINDS[match[1]], int(match[2]), match[3])


def kind_of(name: str) -> ErrorKind | None:
    """Return the kind of an error or of a wave, None for other names."""
    wave = wave_of(name)
    return KINDS.get(name) if wave is None else wave[0]


for _kind in (
    ErrorKind(
        "centre_distance_x",
        "position error of the gear's centre",
        "> 0 along +x",
        "drive",
        {"centre_x": _same},
        "frame",
        tolerance=Tolerance("centre_distance_x"),
    ),
    ErrorKind(
        "centre_distance_y",
        "position error of the gear's centre",
        "> 0 along +y",
        "drive",
        {"centre_y": _same},
        "frame",
        tolerance=Tolerance("centre_distance_y"),
    ),
    ErrorKind(
        "misalignment_xz",
        "tilt of the gear's axis about mid-width",
        "> 0 its +z end towards +x",
        "drive",
        {"tilt_x": _same},
        "frame",
        "rad",
        tolerance=Tolerance("misalignment_xz"),
    ),
    ErrorKind(
        "misalignment_yz",
        "tilt of the gear's axis about mid-width",
        "> 0 its +z end towards +y",
        "drive",
        {"tilt_y": _same},
        "frame",
        "rad",
        tolerance=Tolerance("misalignment_yz"),
    ),
    ErrorKind(
        "eccentricity",
        "error of the crank's eccentricity",
        "> 0 longer",
        "drive",
        {"crank_throw": _same},
        tolerance=Tolerance("eccentricity"),
    ),
    ErrorKind(
        "pin_circle_radius",
        "error of the pin circle's radius",
        "> 0 larger",
        "drive",
        {"pin_radial": _all_pins},
        tolerance=Tolerance("pin_circle_diameter", share=0.5),
    ),
    ErrorKind(
        "pin_radius",
        "radius error of all pins",
        "> 0 thicker",
        "drive",
        {"pin_radius": _all_pins},
        tolerance=Tolerance("pin_radius"),
    ),
    ErrorKind(
        "isometric",
        "error of the isometric modification",
        "> 0 material removed",
        "drive",
        {"generating_pin_radius": _same},
        tolerance=Tolerance("isometric"),
    ),
    ErrorKind(
        "offset",
        "error of the offset modification",
        "> 0 material added",
        "drive",
        {"generating_circle_radius": _same},
        tolerance=Tolerance("offset"),
    ),
    ErrorKind(
        "pin_radial",
        "radial position error of each pin",
        "> 0 outwards",
        "pin",
        {"pin_radial": _same},
        "pins",
        waves=True,
    ),
    ErrorKind(
        "pin_tangential",
        "tangential position error of each pin as arc length",
        "> 0 counter-clockwise",
        "pin",
        {"pin_tangential": _same},
        "pins",
        waves=True,
        tolerance=Tolerance("pin_pitch", "pitch"),
    ),
    ErrorKind(
        "pin_radius_deviation",
        "radius error of each pin",
        "> 0 thicker",
        "pin",
        {"pin_radius": _same},
        "pins",
        key="pin_radius_each",
        tolerance=Tolerance("pin_radius_each"),
    ),
    ErrorKind(
        "tooth_cumulative_pitch",
        "cumulative pitch error of each tooth at the pin circle radius",
        "> 0 counter-clockwise",
        "tooth",
        {"tooth_turn": _turn},
        "teeth",
        waves=True,
        tolerance=Tolerance("gear_pitch", "pitch"),
    ),
):
    register_error_kind(_kind)

FIRST_KINDS = tuple(KINDS)
"""The kinds that every surface file contains; a kind added later is zero if a file does not contain it."""

for _kind in (
    ErrorKind(
        "hole_x",
        "position error of each disc's hole for a crank or output roller",
        "> 0 along +x of the disc at crank angle 0",
        "hole",
        {"hole_x": _same},
        tolerance=Tolerance("hole_x"),
    ),
    ErrorKind(
        "hole_y",
        "position error of each disc's hole for a crank or output roller",
        "> 0 along +y of the disc at crank angle 0",
        "hole",
        {"hole_y": _same},
        tolerance=Tolerance("hole_y"),
    ),
    ErrorKind(
        "crank_x",
        "position error of each crank's bearings in the carrier",
        "> 0 along +x of the carrier at crank angle 0",
        "crank",
        {"carrier_x": _same},
        tolerance=Tolerance("crank_x"),
    ),
    ErrorKind(
        "crank_y",
        "position error of each crank's bearings in the carrier",
        "> 0 along +y of the carrier at crank angle 0",
        "crank",
        {"carrier_y": _same},
        tolerance=Tolerance("crank_y"),
    ),
    ErrorKind(
        "roller_x",
        "position error of each output roller in the carrier",
        "> 0 along +x of the carrier at crank angle 0",
        "roller",
        {"carrier_x": _same},
        tolerance=Tolerance("roller_x"),
    ),
    ErrorKind(
        "roller_y",
        "position error of each output roller in the carrier",
        "> 0 along +y of the carrier at crank angle 0",
        "roller",
        {"carrier_y": _same},
        tolerance=Tolerance("roller_y"),
    ),
    ErrorKind(
        "crank_throw",
        "throw error of each crank's eccentric for each disc",
        "> 0 longer",
        "eccentric",
        {"eccentric_throw": _same},
        tolerance=Tolerance("crank_throw"),
    ),
    ErrorKind(
        "crank_phase",
        "phase error of each crank's eccentric for each disc",
        "> 0 counter-clockwise",
        "eccentric",
        {"eccentric_phase": _same},
        unit="rad",
        tolerance=Tolerance("crank_phase"),
    ),
    ErrorKind(
        "hole_radius",
        "radius error of each output roller's hole relative to its roller",
        "> 0 larger",
        "roller_hole",
        {"hole_play": _same},
        tolerance=Tolerance("hole_radius"),
    ),
):
    register_error_kind(_kind)
