"""Numbers of a joint from files: stated or measured ones, figures of loops, and friction of turning drives."""

from __future__ import annotations

import json
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from cycloid_fmu import edge
from cycloid_fmu.fmu.friction_file import FORMAT as FRICTION_FILE
from cycloid_fmu.fmu.friction_file import read_friction
from cycloid_fmu.joint import joint_drive
from cycloid_fmu.joint.document import Number, number, unknown

STATED_FORMAT = "cycloid-joint-figures/1"
FIGURES_FORMAT = "cycloid-figures/1"
FRICTION_FIT_FORMAT = "cycloid-friction-fit/1"
_NAMES = {
    "1": ("ratio", "efficiency_driving", "efficiency_back_driving", "load_share", "order"),
    "kg*m^2": ("rotor_inertia",),
    "N*m": ("rated_torque", "peak_torque", "coulomb", "stribeck", "torque"),
    "rad/s": ("motor_speed_limit", "stribeck_speed"),
    "rad": ("play", "presliding_angle", "windup", "amplitude", "phase"),
    "N*m*s/rad": ("mesh_damping", "viscous"),
    "K": ("temperature",),
}
UNITS = {name: unit for unit, names in _NAMES.items() for name in names}
"""Unit of a number by the last part of its name."""
_WHOLE = "part of the friction that is measured at the output as a whole"
_File = str | os.PathLike[str]


def numbers_of(path: _File, rated_torque: float | None) -> dict[str, Number]:
    """Return the numbers of a file by dotted name.

    Parameters
    ----------
    path
        Stated numbers (cycloid-joint-figures/1), figures of loops (`cycloid-fit metrics -o`), or friction
        (cycloid-friction/1, or the JSON of `cycloid-fit friction -o`).
    rated_torque
        Torque up to which a measured stiffness holds, N·m, where the file states none.

    Raises
    ------
    edge.InputError
        If it can't be read, or is none of these.
    """
    readers: dict[str, Callable[[], dict[str, Number]]] = {
        STATED_FORMAT: lambda: stated(
            edge.toml_table(edge.read_text(path, STATED_FORMAT), STATED_FORMAT, str(path)).get("joint", {}), str(path)
        ),
        FRICTION_FILE: lambda: _friction_file(path),
        FIGURES_FORMAT: lambda: _loop(edge.json_table(path, FIGURES_FORMAT, "figures"), str(path), rated_torque),
        FRICTION_FIT_FORMAT: lambda: _friction_fit(edge.json_table(path, FRICTION_FIT_FORMAT, "a fit of friction")),
    }
    form = _format_of(path)
    if form not in readers:
        raise edge.InputError(f"{path}: figures of a joint are in a file of the format {edge.listed(readers)}.")
    return readers[form]()


def _format_of(path: _File) -> object:
    """Return the format that a file states, TOML or JSON; None if it states none."""
    if Path(path).suffix.lower() != ".json":
        return edge.format_of(path)
    try:
        content = json.loads(edge.read_text(path))
    except ValueError:
        return None
    return content.get("format") if isinstance(content, dict) else None


def stated(given: Mapping[str, Any], source: str) -> dict[str, Number]:
    """Return stated numbers: a quantity as text with its unit or from Python in SI, or a table with an interval.

    Such a table is {"value", "interval": [lowest, highest], "origin": "measured"}; names may be dotted or nested, and
    `stiffness`, `te_orders` and `play_orders` are lists of tables.

    Raises
    ------
    edge.InputError
        If there is no such number, or a value is not a quantity.
    """
    found: dict[str, Number] = {}

    def take(name: str, value: Any) -> None:
        last = name.rpartition(".")[2]
        if name in joint_drive.LISTS and isinstance(value, list):
            for k, row in enumerate(value):
                for member in joint_drive.LISTS[name]:
                    take(f"{name}.{k}.{member}", row.get(member) if isinstance(row, Mapping) else None)
        elif isinstance(value, Mapping) and not {"value", "interval", "origin", "reason"} & value.keys():
            for key, inner in value.items():
                take(f"{name}.{key}" if name else key, inner)
        elif name not in joint_drive.SCALARS and name.split(".")[0] not in joint_drive.LISTS:
            known = edge.did_you_mean(name, [*joint_drive.SCALARS, *joint_drive.LISTS])
            raise edge.InputError(f"{source}: a joint has no number {name}; {known}.")
        else:
            found[name] = _number(name, value, UNITS[last], source)

    take("", dict(given))
    return found


def _number(name: str, given: Any, unit: str, source: str) -> Number:
    def quantity(value: Any) -> float:
        try:
            if unit == "1" and isinstance(value, int | float) and not isinstance(value, bool):
                return float(value)
            return edge.quantity(value, unit)
        except ValueError as problem:
            raise edge.InputError(f"{source}: {name} = {edge.shown(value)}: {problem}.") from None

    if not isinstance(given, Mapping):
        return number(quantity(given), "stated")
    if "value" not in given:
        raise edge.InputError(f"{source}: {name} has an interval without its value.")
    interval = given.get("interval")
    if interval is not None and (not isinstance(interval, list | tuple) or len(interval) != 2):
        raise edge.InputError(f"{source}: {name} has the interval {edge.shown(interval)}; it is [lowest, highest].")
    ends = None if interval is None else (quantity(interval[0]), quantity(interval[1]))
    return number(quantity(given["value"]), given.get("origin", "stated"), ends)


def _friction_file(path: _File) -> dict[str, Number]:
    """Return the friction of a friction file at both flanges; it doesn't say where its numbers are from."""
    found: dict[str, Number] = {}
    tables = read_friction(path)
    for flange, (side, table) in enumerate((("motor", tables.input), ("output", tables.output))):
        law = table.law(flange)
        for name in joint_drive.LAW:
            found[f"friction.{side}.{name}"] = number(getattr(law, name), "stated")
        if side == "output":
            found["friction.output.load_share"] = number(law.load_share, "stated")
        else:
            found["friction.motor.efficiency_driving"] = number(1.0 / (1.0 + law.load_share), "stated")
            found["friction.motor.efficiency_back_driving"] = number(1.0 - law.load_share, "stated")
    return found


def _measured(figure: Any, change: Callable[[float], float] = float) -> Number | None:
    """Return a measured figure, changed by a monotone function; None if there is none."""
    if not isinstance(figure, Mapping) or not isinstance(figure.get("value"), int | float):
        return None
    value, half = figure["value"], figure.get("uncertainty")
    if not math.isfinite(value):
        return None
    interval = None
    if isinstance(half, int | float) and math.isfinite(half):
        low, high = sorted((change(value - half), change(value + half)))
        interval = (low, high)
    return number(change(value), "measured", interval)


def _loop(content: Mapping[str, Any], source: str, rated: float | None) -> dict[str, Number]:
    """Return play and stiffness of measured loops, without friction where it grows with the load."""
    free, figure = content.get("friction_free"), content.get("torsional_stiffness")
    grows = isinstance(free, Mapping) and isinstance(figure, Mapping) and "remark" in figure
    of = free if grows and free else content
    found = {}
    if (play := _measured(of.get("backlash"), lambda value: max(value, 0.0))) is not None:
        found["play"] = play
    torque = content.get("rated_torque") or rated
    stiffness = _measured(of.get("torsional_stiffness"))
    if stiffness is not None:
        if torque is None:
            raise edge.InputError(f"{source}: torsional_stiffness needs the rated torque up to which it holds.")
        found["stiffness.0.torque"] = found["stiffness.0.windup"] = number(0.0, "measured")
        found["stiffness.1.torque"] = number(torque, "stated")
        windup = _measured(of.get("torsional_stiffness"), lambda value: torque / value if value > 0.0 else math.inf)
        found["stiffness.1.windup"] = windup or stiffness
    if not found:
        raise edge.InputError(f"{source}: backlash and torsional_stiffness are missing; figures of a loop have them.")
    return found


def _friction_fit(content: Mapping[str, Any]) -> dict[str, Number]:
    """Return friction measured on a turning drive, which is that of the output as a whole."""
    share = _measured(content.get("friction_per_load"))
    rest = 1.0 - (0.0 if share is None else share["value"])
    reason = "the recordings do not resolve it"
    found = {f"friction.motor.{name}": unknown(_WHOLE) for name in (*joint_drive.LAW, *joint_drive.EFFICIENCIES)}
    for name in joint_drive.LAW:
        scale = rest if name in ("coulomb", "stribeck", "viscous") else 1.0
        figure = _measured(content.get(name), lambda value, scale=scale: scale * value)  # type: ignore[misc]
        found[f"friction.output.{name}"] = figure or unknown(reason)
    found["friction.output.load_share"] = share or unknown(reason)
    return found
