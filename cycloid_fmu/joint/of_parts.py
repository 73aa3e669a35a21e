"""The joint of a drive, drawn or identified, and of what is measured or stated."""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.joint import joint_drive, of_drive
from cycloid_fmu.joint.document import Joint, Number, number, unknown
from cycloid_fmu.joint.of_files import numbers_of, stated
from cycloid_fmu.surfaces.sampling import Tolerances

_WIDTH = 3.92  # of an interval of 95 % over its standard deviation
_REASONS = {
    "rotor_inertia": "not stated; a pair file has no motor",
    "peak_torque": "not stated",
    "motor_speed_limit": "not stated",
    "temperature": "not stated",
}


@dataclasses.dataclass(frozen=True)
class Settings:
    """How the numbers of a drive are computed and drawn.

    Attributes
    ----------
    tolerances
        Draws are within these; without them from the covariance of a fit.
    draws, seed
        Number of draws after the most likely values, by default 100 where there are any; and their seed.
    orders
        Number of orders of the transmission error and of the play.
    angles
        Crank angles over a turn of the output; None for as many as the orders need.
    series_compliance
        Compliance in series with the drive, rad/(N·m); 0 for that up to the pair's catalogue stiffness.
    speed
        Speed of the motor at which predicted efficiencies are taken, rad/s.
    workers, progress
        Number of threads; function called with 1 for each drive solved.
    """

    tolerances: Tolerances | None = None
    draws: int | None = None
    seed: int = 0
    orders: int = of_drive.ORDERS
    angles: int | None = None
    series_compliance: float = 0.0
    speed: float = of_drive.SPEED
    workers: int = 1
    progress: Callable[[int], None] = lambda drives: None


def joint_of(
    drive: DriveValue | None,
    files: Sequence[str | os.PathLike[str]] = (),
    given: Mapping[str, Any] | None = None,
    settings: Settings | None = None,
) -> Joint:
    """Return the joint of a drive with the numbers of files and those given, which replace the drive's own.

    Parameters
    ----------
    drive
        The drive; None if all numbers are from files.
    files, given
        As `of_files.numbers_of` and `of_files.stated` have them; the last one counts.
    settings
        How the drive's own numbers are computed.

    Raises
    ------
    edge.InputError
        If a file can't be read, a number is out of range, or there is neither drive nor file.
    """
    how = settings or Settings()
    numbers: dict[str, Number] = {}
    rows: list[dict[str, float]] = []
    source: dict[str, Any] = {"files": [str(path) for path in files]}
    left_out: tuple[str, ...] = ()
    if drive is None and not files and not given:
        raise edge.ArgumentError("figures", "is missing; a joint needs a drive, or files with its figures")
    if drive is not None:
        if not 1 <= how.orders <= joint_drive.MOST:
            raise edge.ArgumentError("orders", f"it must be from 1 to {joint_drive.MOST}", how.orders)
        numbers, rows, left_out = _of_drive(drive, how)
        torque = drive.pair.rated_load() * of_drive.LOADS[of_drive.ORDERS_AT]
        source |= {"drive": drive.hash, "surface": drive.surface.origin, "transmission_error_torque": torque}
    of_files: dict[str, Number] = {}
    for path in files:
        _replace(of_files, numbers_of(path, {**numbers, **of_files}.get("rated_torque", {}).get("value")))
    _replace(of_files, stated(given or {}, "stated"))
    _replace(numbers, of_files)
    rows = _with_files(rows, numbers, of_files, how)
    _fill(numbers)
    source["seed"] = how.seed if rows else None
    return Joint(numbers, tuple(rows), source, left_out)


def _with_files(
    rows: list[dict[str, float]],
    numbers: Mapping[str, Number],
    of_files: Mapping[str, Number],
    how: Settings,
) -> list[dict[str, float]]:
    """Return the draws without what the files replace, and with what they give an interval, drawn independently."""
    spread = {name: each for name, each in of_files.items() if each.get("interval") is not None}
    if not rows and spread:
        rows = [{} for _ in range(1 + (of_drive.DRAWS if how.draws is None else how.draws))]
    if not rows and how.draws:
        raise edge.ArgumentError(
            "draws",
            "the drive has no covariance of a fit; give a surface written by identify, or tolerances",
            how.draws,
        )
    kept = [name for name in (rows[0] if rows else ()) if name in numbers and name not in of_files]
    generator = np.random.default_rng([how.seed, 1])
    normal = generator.standard_normal((len(rows), len(spread)))
    normal[:1] = 0.0
    found = []
    for row, off in zip(rows, normal, strict=True):
        own = {}
        for (name, each), by in zip(spread.items(), off, strict=True):
            low, high = each["interval"]
            value = each["value"] + by * (high - low) / _WIDTH
            own[name] = float(max(value, 0.0) if each["value"] >= 0.0 else value)
        found.append({**{name: row[name] for name in kept}, **own})
    return found


def _of_drive(drive: DriveValue, how: Settings) -> tuple[dict[str, Number], list[dict[str, float]], tuple[str, ...]]:
    """Return the numbers of a drive, its draws, and what they leave out."""
    crank_angle, compliance = (
        of_drive.angles_of(drive, how.angles),
        of_drive.compliance_of(drive, how.series_compliance),
    )

    def solved(each: DriveValue) -> of_drive.Teeth:
        return of_drive.Teeth(each, crank_angle, compliance, how.workers)

    teeth = solved(drive)
    how.progress(1)
    if not teeth.runs:
        raise edge.InputError(
            "The teeth of this drive interfere at some crank angles: as a joint it has no play to state."
        )
    largest = teeth.orders(how.orders)
    values = teeth.values(largest)
    several = of_drive.drawn(drive, how.tolerances, how.draws, how.seed, solved, how.progress)
    rows = of_drive.rows_of(values, several, largest) if several else []
    wanted = of_drive.DRAWS if how.draws is None else how.draws
    origin = "identified" if drive.surface.covariance is not None and how.tolerances is None else "drawn"
    rubbing, left_out = of_drive.friction(drive, how.speed)
    numbers = {
        **of_drive.with_intervals(values, rows, origin),
        **rubbing,
        "ratio": number(drive.ratio, "drawn"),
        "rated_torque": number(drive.pair.rated_load(), "stated"),
        "mesh_damping": of_drive.damping(teeth.windup, teeth.loads),
    }
    if drive.pair.losses is not None and drive.pair.losses.lubricant is not None:
        numbers["temperature"] = number(drive.pair.losses.lubricant.temperature, "stated")
    texts = (
        f"Transmission error and play over the load: those at {teeth.loads[of_drive.ORDERS_AT]:.4g} N·m.",
        *teeth.left_out(largest),
        "Stiffness over the crank angle.",
        *([f"{wanted - len(several)} of {wanted} draws: their teeth interfere."] if 0 < len(several) < wanted else []),
        *left_out,
    )
    return numbers, rows, texts


def _replace(numbers: dict[str, Number], others: Mapping[str, Number]) -> None:
    """Take other numbers in place of those there are; a list is replaced as a whole."""
    for name in joint_drive.LISTS:
        if any(other.split(".")[0] == name for other in others):
            for old in [old for old in numbers if old.split(".")[0] == name]:
                del numbers[old]
    numbers.update(others)


def _fill(numbers: dict[str, Number]) -> None:
    """Add the numbers that no source has, as unknown ones."""
    for name in joint_drive.SCALARS:
        numbers.setdefault(name, unknown(_REASONS.get(name, "no source states it")))
    for name, members in joint_drive.LISTS.items():
        if name not in numbers and f"{name}.0.{members[0]}" not in numbers:
            numbers[name] = unknown("no source states it")
