"""Quantities: numbers with units."""

from __future__ import annotations

import functools
import math
import re
from decimal import Decimal, DecimalException
from typing import TYPE_CHECKING, Any

from cycloid_fmu.edge.problems import shown

if TYPE_CHECKING:
    import pint

ARCSEC = 648000.0 / math.pi
"""Arcseconds in a radian, for reports."""
ARCMIN = ARCSEC / 60.0
FIELD_UNITS = {
    "rad": ("arcsec", ARCSEC),
    "N*m/rad": ("N*m/arcmin", 1.0 / ARCMIN),
    "Pa": ("MPa", 1e-6),
    "m": ("um", 1e6),
}
"""The units of drawings and reports in which results are shown, and how many are one in SI."""
RATIO = "−gear_teeth with a fixed ring, +pins with a fixed carrier"
"""The ratio input/output of a single stage, for questions and messages."""

_NUMBER = r"[+-]?\d+(?:\.\d*)?(?:[eE][+-]?\d+)?"
_QUANTITY = re.compile(rf"((?>{_NUMBER}))(?: |(?=[^\W\d]|[°%]))(\S.*)")
_NEWTON_METRE = re.compile(r"([mkM]?)N(m|mm|cm)")
_LONGEST = 60  # characters of a unit, and of a number
_EXPONENT = 9  # largest exponent of a unit
_RAISED = str.maketrans("⁰¹²³⁴⁵⁶⁷⁸⁹⁻⁺", "0123456789-+")
_SYMBOL = re.compile(r"(?:\*\*|\^)\s*(?P<exponent>[+-]?\d+)|(?P<sign>[*·⋅×/()])|(?P<unit>[°%]?[^\W\d]\w*|[°%1])|\s+")
EXAMPLES = {
    "m": "64 mm",
    "rad": "0.5 arcmin",
    "N": "5 N",
    "N*m": "181 N*m",
    "Pa": "206 GPa",
    "s": "10 ms",
    "rad/s": "15 rpm",
    "K": "20 degC",
    "1/K": "11.5e-6 1/K",
    "rad/(N*m)": "0.02 arcsec/(N*m)",
    "1/Pa": "2.2e-8 1/Pa",
    "m^2/N": "1e-18 m^2/N",
    "m^2/s": "150 mm^2/s",
    "kg*m^2": "0.05 kg*m^2",
    "N/m": "400 N/um",
    "N*m/rad": "49 N*m/arcmin",
    "N*m*s/rad": "1e-3 N*m*s/rad",
    "m/s": "0.5 m/s",
    "W/m^2": "20 W/mm^2",
    "W/(m^2*K)": "20 W/(m^2*K)",
    "K/W": "0.5 K/W",
    "J/K": "4 kJ/K",
    "m^2": "0.1 m^2",
}
# The usual units, so that reading them takes no half a second to load pint; a test compares each with pint.
USUAL = {
    "m": {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "µm": 1e-6, "μm": 1e-6, "nm": 1e-9},
    "rad": {
        "rad": 1.0,
        "mrad": 1e-3,
        "urad": 1e-6,
        "µrad": 1e-6,
        "deg": math.pi / 180.0,
        "°": math.pi / 180.0,
        "arcmin": 0.00029088820866572163,
        "arcsec": 4.84813681109536e-06,
        "rev": 2.0 * math.pi,
        "turn": 2.0 * math.pi,
    },
    "N": {"N": 1.0, "kN": 1e3},
    "N*m": {
        "N*m": 1.0,
        "Nm": 1.0,
        "N·m": 1.0,
        "N m": 1.0,
        "mN*m": 1e-3,
        "mNm": 1e-3,
        "N*mm": 1e-3,
        "Nmm": 1e-3,
        "kN*m": 1e3,
        "kNm": 1e3,
    },
    "Pa": {"Pa": 1.0, "kPa": 1e3, "MPa": 1e6, "GPa": 1e9},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6, "min": 60.0, "h": 3600.0},
    "rad/s": {"rad/s": 1.0, "deg/s": math.pi / 180.0, "rpm": 0.10471975511965977},
    "K": {"K": 1.0},
    "1/K": {"1/K": 1.0, "um/(m*K)": 1e-6},
    "1/Pa": {"1/Pa": 1.0},
    "m^2/N": {"m^2/N": 1.0},
    "m^2/s": {"m^2/s": 1.0, "mm^2/s": 1e-6},
    "kg*m^2": {"kg*m^2": 1.0},
    "N*m/rad": {
        "N*m/rad": 1.0,
        "N*m/arcmin": 3437.7467707849396,
        "kN*m/rad": 1e3,
    },
    "N*m*s/rad": {"N*m*s/rad": 1.0},
    "m/s": {"m/s": 1.0, "mm/s": 1e-3},
    "W/m^2": {"W/m^2": 1.0, "W/mm^2": 1e6},
    "W/(m^2*K)": {"W/(m^2*K)": 1.0},
    "K/W": {"K/W": 1.0},
    "J/K": {"J/K": 1.0, "kJ/K": 1e3},
    "m^2": {"m^2": 1.0, "cm^2": 1e-4},
    "N/m": {"N/m": 1.0, "N/mm": 1e3, "N/um": 1e6, "N/µm": 1e6, "kN/mm": 1e6},
}
_CELSIUS, _ICE = ("degC", "°C"), 273.15  # the one unit with an offset: a temperature, never a difference


@functools.cache
def units() -> pint.UnitRegistry[Any]:
    """Return the shared unit registry (pint, imported on first use because this takes half a second)."""
    import pint

    registry: pint.UnitRegistry[Any] = pint.UnitRegistry()
    registry.define("@alias turn = rev")  # drives and controllers write it so; pint itself knows "revolution"
    return registry


def _factors(text: str) -> list[tuple[str, int]]:
    """Return the units in a text, each with its exponent; a `ValueError` if the text is not a product of units."""
    if len(text) > _LONGEST:
        raise ValueError
    text = re.sub("[⁻⁺]?[⁰¹²³⁴-⁹]+", lambda raised: f"**{raised[0].translate(_RAISED)}", text)
    place, side, follows, opened = 0, 1, False, list[tuple[int, int]]()
    found: list[tuple[str, int]] = []
    last = (0, 0)  # range of factors to which a following exponent applies
    while place < len(text):
        symbol = _SYMBOL.match(text, place)
        if symbol is None:
            raise ValueError
        place = symbol.end()
        if unit := symbol["unit"]:
            newton_metre = _NEWTON_METRE.fullmatch(unit)  # to pint "Nm" is a number of metres
            parts = (f"{newton_metre[1]}N", newton_metre[2]) if newton_metre else (unit,)
            last = (len(found), len(found) + len(parts))
            found += [(part, side) for part in parts]
            side, follows = 1, True
        elif exponent := symbol["exponent"]:
            power = int(exponent)
            if last[0] == last[1] or not -_EXPONENT <= power <= _EXPONENT:
                raise ValueError
            found[slice(*last)] = [(name, power * before) for name, before in found[slice(*last)]]
            last = (0, 0)
        elif symbol["sign"] == "(":
            opened.append((len(found), side))
            side, follows = 1, False
        elif symbol["sign"] == ")":
            if not opened or not follows:
                raise ValueError
            begin, turned = opened.pop()
            found[begin:] = [(name, turned * before) for name, before in found[begin:]]
            last = (begin, len(found))
        elif symbol["sign"]:
            if not follows:
                raise ValueError
            side, follows = -1 if symbol["sign"] == "/" else 1, False
            last = (0, 0)
    if opened or not follows or max(abs(power) for _, power in found) > _EXPONENT:
        raise ValueError
    return found


@functools.lru_cache(maxsize=512)
def parse_unit(text: str) -> pint.Unit:
    """Return the unit that a text names: units of pint's registry, multiplied, divided and raised to whole numbers.

    Limits are needed because pint evaluates the text: `m**9**9**9` would never finish.

    Parameters
    ----------
    text
        At most 60 characters, exponents of at most 9: "N*m/rad", "kg m^2", "µm", "1/Pa", "m·s⁻²".

    Raises
    ------
    ValueError
        If it is anything else.
    """
    factors = _factors(text)
    unit = units().Unit("")
    for name, power in factors:
        if name == "1":
            continue
        try:
            unit = unit * units().Unit(name) ** power
        except Exception as problem:  # pint raises various classes for an invalid unit
            raise ValueError(f"{name} is not a unit") from problem
    return unit


@functools.lru_cache(maxsize=512)
def unit_scale(unit: str, si: str) -> float:
    """Return the number of `si` units in one `unit`.

    Raises
    ------
    ValueError
        If the unit is unknown, measures something else, or has an offset (degrees Celsius).
    """
    usual = USUAL.get(si, {}).get(unit)
    if usual is not None:
        return usual
    example = EXAMPLES[si].split(" ", 1)[1] if si in EXAMPLES else shown(si).strip('"')
    try:
        parsed, wanted = parse_unit(unit), parse_unit(si)  # both come from files: FMUs and tables of encoders
        zero, one = (float(units().Quantity(x, parsed).to(wanted).magnitude) for x in (0.0, 1.0))
    except Exception as problem:
        reason = "measures something else" if "convert" in str(problem) else "is not a known unit"
        raise ValueError(f"the unit {shown(unit)} {reason}; use one such as {example}") from None
    if zero != 0.0:
        raise ValueError(f"the unit {shown(unit)} has an offset; use one such as {example}")
    if not 0.0 < one < math.inf:
        raise ValueError(f"the unit {shown(unit)} is beyond the range of numbers; use one such as {example}")
    return one


def parse_quantity(value: object, si: str) -> float:
    """Return a quantity written as text, such as "64 mm", in SI units.

    Pint by itself accepts too much: it reads "1,5 mm" as 15 mm, "0.3" as radians, "nan mm" and "2*3 mm".

    Parameters
    ----------
    value
        One finite number with a decimal point, a space (optional before a letter) and a unit. Newton metres may be
        written as Nm.
    si
        The required SI unit, as pint writes it: "m", "rad", "N*m". A temperature, "K", may be in "degC".

    Raises
    ------
    ValueError
        If the text is anything else; the message shows the correct form.

    Examples
    --------
    >>> parse_quantity("64 mm", "m"), parse_quantity("181 Nm", "N*m")
    (0.064, 181.0)
    """
    how = f'write one number with a decimal point, a space and a unit, such as "{EXAMPLES.get(si, f"1 {si}")}"'
    match = _QUANTITY.fullmatch(value) if isinstance(value, str) else None
    if match is None or len(match[1]) > _LONGEST:
        raise ValueError(how)
    # In decimal arithmetic, so that "1.3 mm" gives the same float as "0.0013 m", not one that differs in the last bit.
    celsius = si == "K" and match[2].strip() in _CELSIUS
    scale, offset = (1.0, _ICE) if celsius else (unit_scale(match[2].strip(), si), 0.0)
    try:
        number = float(Decimal(match[1]) * Decimal(repr(scale)) + Decimal(repr(offset)))
    except DecimalException:  # out of range
        raise ValueError(how) from None
    if not math.isfinite(number):
        raise ValueError(how)
    return number


def format_quantity(value: float, si: str, unit: str) -> str:
    """Write an SI value as text that `parse_quantity` reads back to the same number (to 15 digits).

    Examples
    --------
    >>> format_quantity(0.064, "m", "mm")
    '64 mm'
    """
    if si == "K" and unit in _CELSIUS:
        return f"{float(Decimal(repr(value)) - Decimal(repr(_ICE))):.15g} {unit}"
    return f"{value / unit_scale(unit, si):.15g} {unit}"
