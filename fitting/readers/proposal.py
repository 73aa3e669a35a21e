"""Interpretation of transmission error tables and file names, proposed for the user to check.

Published recordings are often tables of output angle and transmission error, forward and backward side by side, with
torque, speed and temperature in the file names.
"""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cycloid_fmu import edge
from fitting.readers.first_samples import FirstSamples
from fitting.readers.formats import measures, stem_of, unit_text

_ERROR = r"(?<![a-z])(a|m|s)?te(?![a-z])|transmi\w*[\s_.-]*err|error|fehler|deviation|abweich"
_ANGLE = r"pos|angle|winkel|phi|theta|rot|out|abtrieb|flange|(?<![a-z])deg"
_FORWARD = r"(?<![a-z])(f|fw|fwd|forward\w*|vor|vorw\w*|ccw|hin|up)(?![a-z])|正"
_BACKWARD = r"(?<![a-z])(b|bw|bwd|backward\w*|rev|reverse\w*|r(ü|ue)ck\w*|zur(ü|ue)ck|cw|down)(?![a-z])|反"
_SMALL = ("arcsec", "arcmin", "mrad", "urad", "microrad")
_UNITS = r"(arcsec|arcmin|mrad|rad|deg|°|″|′|\"|')"
_MOST = {"deg": 5.0, "arcmin": 300.0, "arcsec": 18000.0, "mrad": 90.0, "rad": 0.09}  # 5° of transmission error


@dataclass(frozen=True)
class ErrorRun:
    """One run of a table of transmission errors: name, the two channels and the order of its rows."""

    name: str
    output_angle: FirstSamples
    transmission_error: FirstSamples
    last_row_first: bool = False


def stated_unit(first_samples: FirstSamples) -> str:
    """Return a channel's unit as stated by the file or by its name: `TE_arcsec`, `TE (arcsec) CW`."""
    if first_samples.channel.unit:
        return unit_text(first_samples.channel.unit)
    name = first_samples.channel.name.strip()
    match = re.search(rf"[\[(]{_UNITS}[\])]", name) or re.search(rf"[\s_/,.-]{_UNITS}$", name, re.IGNORECASE)
    return unit_text(match[1]) if match else ""


def _known(unit: str) -> bool:
    try:
        edge.parse_unit(unit)
    except ValueError:
        return False
    return True


def _way(name: str) -> str:
    forward, backward = (bool(re.search(p, name, re.IGNORECASE)) for p in (_FORWARD, _BACKWARD))
    return "" if forward == backward else "forward" if forward else "backward"


def error_runs(looks: Sequence[FirstSamples]) -> list[ErrorRun]:
    """Return the runs that a table of output angles and transmission errors seems to contain; none for other tables.

    Each error belongs to the angle of the same direction (forward or backward), otherwise to the only angle, otherwise,
    with as many angles as errors, to the angle of the same position.
    """
    free = [look for look in looks if np.isfinite(look.values).sum() > 1]
    errors = [look for look in free if _is_error(look, free)]
    angles = [
        look
        for look in free
        if look not in errors
        and look.travel > 0.0
        and (
            measures(stated_unit(look), "rad")
            or (not look.channel.unit and re.search(_ANGLE, look.channel.name, re.IGNORECASE))
        )
    ]
    if not errors or not angles or len(angles) > len(errors):
        return []
    runs: list[ErrorRun] = []
    for number, error in enumerate(errors, start=1):
        direction = _way(error.channel.name)
        same = [a for a in angles if direction and _way(a.channel.name) == direction]
        same = same or (angles if len(angles) == 1 else [angles[number - 1]] if len(angles) == len(errors) else [])
        if not same:
            return []
        runs.append(ErrorRun(direction or f"run {number}", same[0], error))
    if len({run.name for run in runs}) < len(runs):
        runs = [dataclasses.replace(run, name=f"run {n}") for n, run in enumerate(runs, start=1)]
    ahead = {run.name: _grows(run.output_angle) for run in runs}
    if ahead.get("forward") is not None and ahead.get("forward") == ahead.get("backward"):
        runs = [dataclasses.replace(run, last_row_first=run.name == "backward") for run in runs]
    return runs


def _is_error(first_samples: FirstSamples, all_of_them: Sequence[FirstSamples]) -> bool:
    unit = stated_unit(first_samples)
    if unit and not measures(unit, "rad") and _known(unit):
        return False
    named = bool(re.search(_ERROR, first_samples.channel.name, re.IGNORECASE))
    larger = any(
        measures(stated_unit(o), "rad") and stated_unit(o) not in _SMALL for o in all_of_them if o is not first_samples
    )
    finite = first_samples.values[np.isfinite(first_samples.values)]
    reach = _MOST.get({"°": "deg"}.get(unit, unit), np.inf)
    return (named or (unit in _SMALL and larger)) and float(np.ptp(finite)) <= reach


def _grows(first_samples: FirstSamples) -> bool:
    """Whether an angle increases from row to row, except at rollovers."""
    steps = np.diff(first_samples.values[np.isfinite(first_samples.values)])
    return bool(np.median(np.sign(steps[steps != 0.0])) > 0.0) if steps.any() else True


_NUMBER = r"[+\-−]?(?:\d+(?:[.,]\d+)?|[.,]\d+)"
_BEHIND = {  # a unit after the number
    "torque": (r"([kmMµu]?)[ _]?N[ .·*]?m(?![a-z])", "N*m"),
    "speed": (r"[ _]?(?:rpm|r[ _]?min|min-1|U[ _]?min)(?![a-z])", "rpm"),
    "temperature": (r"[ _]?(?:°|deg)?[ _]?C(?:els\w*)?(?![a-z])", "degC"),
}
_BEFORE = {  # the quantity's name before the number
    "torque": r"(?:torque|load|moment|trq|M|T)",
    "speed": r"(?:speed|rpm|drehzahl|n)",
    "temperature": r"(?:temperature|temperatur|temp|theta)",
}


def name_patterns(path: str | Path) -> dict[str, tuple[str, str, str]]:
    """Return the values that a file's name seems to state: {role: (pattern with {} for the number, unit, comment)}.

    If the name is ambiguous the pattern is empty, and the comment states the alternatives.

    Examples
    --------
    >>> name_patterns("RV160N_500Nm_10rpm_25C.csv")["speed"][:2]
    ('_{}rpm', 'rpm')
    >>> name_patterns("T=500_n=10_temp=30.txt")["torque"][:2]
    ('T={}', 'N*m')
    """
    name = stem_of(path)
    patterns: dict[str, tuple[str, str, str]] = {}
    hyphens = re.findall(rf"(?<=[^\W_])-(?={_NUMBER})", name)
    for role, (unit_pattern, unit) in _BEHIND.items():
        matches = list(re.finditer(rf"(?<![\d.,])({_NUMBER})({unit_pattern})", name, re.IGNORECASE))
        if role == "torque":
            matches = [m for m in matches if not m[2].strip(" _").endswith("nm")]  # nanometres
        if matches:
            patterns[role] = _behind(name, matches, unit, role, len(hyphens))
            continue
        matches = list(re.finditer(rf"(?<![^\W_])({_BEFORE[role]})([ _=:]*)({_NUMBER})(?![\d]|[^\W_])", name))
        if not matches and role != "torque" and role != "speed":
            matches = list(re.finditer(rf"(?<![^\W_])({_BEFORE[role]})([ _=:]*)({_NUMBER})", name, re.IGNORECASE))
        if len(matches) == 1:
            before = matches[0][1] + matches[0][2]
            patterns[role] = (f"{before}{{}}", unit, "the name does not state the unit; check")
    if patterns.get("torque", ("",))[0] in ("T={}", "T{}", "T_{}") and "temperature" not in patterns:
        patterns["torque"] = ("", "", 'is T torque or temperature? Write "T={}" here or in [temperature]')
    return patterns


def _behind(name: str, matches: list[re.Match[str]], unit: str, role: str, hyphens: int) -> tuple[str, str, str]:
    if len(matches) > 1:
        several = ", ".join(m[0] for m in matches)
        return "", unit, f"the name has {several}: which one? Write the text around it, with {{}} for the number"
    number, behind = matches[0][1], matches[0][2]
    at = matches[0].start()
    prefix = re.match(r"[ _]?([kmMµu]?)N", behind) if role == "torque" else None
    if prefix and prefix[1]:
        unit = f"{prefix[1]}N*m"
    before = name[at - 1] if at and not (name[at - 1].isalnum() or name[at - 1] in "-−") else ""
    comment = ""
    if number[0] == "-" and at and name[at - 1].isalnum():
        if hyphens < 2:
            return (
                "",
                unit,
                (f'is the - of {number}{behind} a minus or a separator? Write "{{}}{behind}" or "-{{}}{behind}"'),
            )
        before, comment = "-", "its - is a separator, like the others in the name; check"
    return f"{before}{{}}{behind}", unit, comment
