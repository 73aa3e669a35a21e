"""Sweeps: every combination of several values of a pair file, each drive solved by itself.

An invalid combination is part of the result: its figures are NaN, with a sentence that gives the reason.
"""

from __future__ import annotations

import functools
import math
import os
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.analysis import series_compliance, solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry import ANGLES
from cycloid_fmu.losses import figures as rubbing
from cycloid_fmu.losses.back_driving import back_driving
from cycloid_fmu.losses.solver import solve as rub
from cycloid_fmu.studies.checkpoint import Checkpoint, checkpoint_of
from cycloid_fmu.studies.limits import whole_stiffness
from cycloid_fmu.studies.machines import Numbers, Solved, complete, versions
from cycloid_fmu.studies.tolerance import FIGURES as OF_STUDIES
from cycloid_fmu.studies.tolerance import free_figures, loaded_figures
from cycloid_fmu.studies.varied import Varied, drive_with, varied

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]
FORMAT = "cycloid-sweep/1"
MOST = 1_000_000  # drives of a sweep
LOADED: Mapping[str, tuple[str, str]] = {
    "angular_transmission_error": OF_STUDIES["angular_transmission_error"],
    "ripple": ("rad", "root mean square of the transmission error about its mean over the crank angles"),
    "mean_transmission_error": OF_STUDIES["mean_transmission_error"],
    "torsional_stiffness": ("N*m/rad", "mean torsional stiffness over the crank angles, up to a catalogue's stiffness"),
    "max_contact_pressure": OF_STUDIES["max_contact_pressure"],
    "loaded_pins": ("1", "mean share of the pins that carry more than 1 % of the most loaded one's force"),
}
FREE = {name: OF_STUDIES[name] for name in ("mean_backlash", "backlash", "lost_motion", "interference")}
LOADED_RUBBING = {
    "efficiency": ("1", "efficiency of the driving drive at the crank's speed; NaN where it jams"),
    "back_driving_efficiency": ("1", "efficiency of the back-driven drive at this speed; not above 0: self-locking"),
}
FREE_RUBBING = {
    "starting_torque": ("N*m", "largest torque of the input without a load, from rest"),
    "back_driving_torque": ("N*m", "torque on the output that turns the drive backwards from rest; NaN: none"),
}
"""Figures of a drive with [losses]."""


@dataclass(frozen=True)
class Sweep:
    """Definition of a sweep; two sweeps with equal fields have equal results.

    Attributes
    ----------
    drive
        The drive whose values vary; its pair states its errors.
    vary
        The varied values; the last one varies fastest.
    torque
        Loads on the output, N·m, not zero.
    angles, turns
        Crank angles evenly from 0 over so many crank turns, end excluded.
    crank_speed
        Speed of the crank for the efficiency of a drive with [losses], rad/s; at 0 friction is that at rest.
    """

    drive: DriveValue
    vary: tuple[Varied, ...]
    torque: tuple[float, ...]
    angles: int = ANGLES
    turns: int = 1
    crank_speed: float = 0.0

    @property
    def rubs(self) -> bool:
        """Whether the drive states its friction."""
        return self.drive.pair.losses is not None and self.drive.pair.supports is not None

    @property
    def loaded(self) -> Mapping[str, tuple[str, str]]:
        """The figures at each torque: {name: (unit, meaning)}."""
        return {**LOADED, **LOADED_RUBBING} if self.rubs else LOADED

    @property
    def free(self) -> Mapping[str, tuple[str, str]]:
        """The figures without a torque."""
        return {**FREE, **FREE_RUBBING} if self.rubs else FREE

    @property
    def shape(self) -> tuple[int, ...]:
        """Number of values of each variable."""
        return tuple(len(one.values) for one in self.vary)

    @property
    def drives(self) -> int:
        """Number of the combinations."""
        return math.prod(self.shape)

    @functools.cached_property
    def columns(self) -> tuple[tuple[str, int | None], ...]:
        """Name and index of the torque (None where there is none) of each number that a drive yields."""
        return (*((n, k) for n in self.loaded for k in range(len(self.torque))), *((n, None) for n in self.free))

    def stated(self, number: int) -> dict[str, str]:
        """Return the varied values of a drive as a file has them."""
        place = np.unravel_index(number, self.shape)
        return {one.name: one.texts[k] for one, k in zip(self.vary, place, strict=True)}

    def identity(self) -> dict[str, Any]:
        """Return the identity of this sweep, for a checkpoint."""
        first = self.drive.first_stage
        return {
            "pair": self.drive.pair.text,
            "surface": self.drive.surface.hash,
            "vary": {one.name: list(one.texts) for one in self.vary},
            "torque": list(self.torque),
            "angles": self.angles,
            "turns": self.turns,
            "versions": versions(),
            **({} if self.drive.pair.losses is None else {"crank_speed": self.crank_speed}),
            **({} if first is None else {"first_stage": first.text}),
        }


def check_sweep(sweep: Sweep) -> None:
    """Refuse a sweep that can't be made.

    Raises
    ------
    edge.InputError
        If nothing is varied, something is varied twice, there are too many drives, a load is zero or missing, the speed
        is below zero, or no combination is valid.
    """
    names = [one.name for one in sweep.vary]
    if not names:
        raise edge.ArgumentError("vary", "is missing; a sweep varies at least one value")
    if twice := [name for name in names if names.count(name) > 1]:
        raise edge.ArgumentError("vary", "it is varied twice", twice[0])
    if sweep.drives > MOST:
        raise edge.ArgumentError("vary", f"makes {sweep.drives} drives; a sweep has at most {MOST}")
    if 0.0 in sweep.torque:
        raise edge.ArgumentError("torque", "a sweep's loads must not be zero; the play has its own figures", 0.0)
    if len(set(sweep.torque)) != len(sweep.torque):
        raise edge.ArgumentError("torque", "the loads must be different", edge.listed(map(str, sweep.torque)))
    if not sweep.crank_speed >= 0.0:
        raise edge.ArgumentError(
            "crank_speed", "it must not be below zero; both directions are solved", sweep.crank_speed
        )
    reason = ""
    for number in range(sweep.drives):
        try:
            drive_with(sweep.drive, sweep.stated(number))
        except edge.InputError as problem:
            reason = reason or str(problem).rstrip(".")
        else:
            return
    shown = ", ".join(f"{one.name} {one.texts[0]} … {one.texts[-1]}" for one in sweep.vary)
    raise edge.ArgumentError("vary", f"none of these values is a valid drive; the first one: {reason}", shown)


def figures_of(sweep: Sweep, number: int) -> tuple[Array, str]:
    """Return the figures of one drive in the order of `Sweep.columns`, NaN where missing, and the reason, or ""."""
    loads = len(sweep.torque)
    found: dict[str, Any] = {name: np.full(loads, math.nan) for name in sweep.loaded} | dict.fromkeys(
        sweep.free, math.nan
    )
    reasons: list[str] = []
    try:
        drive = drive_with(sweep.drive, sweep.stated(number))
        pair = drive.pair
        angle = np.linspace(0.0, 2.0 * np.pi * sweep.turns, sweep.angles, endpoint=False)
        series = series_compliance(sweep.drive)
        found.update(free_figures(drive, angle, series))
        if found["interference"] > 0.0:
            reasons.append(f"no free position: interference of {found['interference'] * 1e6:.3g} um")
            if pair.supports is None:  # in clearances of bearings the output moves all the same
                found["mean_backlash"] = found["backlash"] = math.nan
                reasons[-1] += ", so no backlash"
        for k, torque in enumerate(sweep.torque):
            try:
                one = solve(drive, torque, angle, with_play=False)
            except edge.InputError as problem:  # of this load only
                reasons.append(str(problem).rstrip("."))
                continue
            figures = {
                **loaded_figures(one),
                "ripple": one.transmission_error.std(axis=1),
                "torsional_stiffness": whole_stiffness(one.torsional_stiffness, series).mean(axis=1),
                "loaded_pins": one.contact_count.mean(axis=1) / (pair.discs * pair.pins),
            }
            for name, values in figures.items():
                found[name][k] = values[0]
        if "efficiency" in sweep.loaded:
            _add_friction(sweep, drive, angle, found)
    except edge.InputError as problem:
        reasons.append(str(problem).rstrip("."))
    return np.array([found[n] if k is None else found[n][k] for n, k in sweep.columns]), "; ".join(reasons)


def _add_friction(sweep: Sweep, drive: DriveValue, angle: Array, found: dict[str, Any]) -> None:
    """Add the figures of a drive with friction."""
    torque = np.array(sweep.torque)
    by_direction = [rubbing.load_cases(drive, rub(drive, torque, angle, s, sweep.crank_speed)) for s in (1, -1)]
    for k, cases in enumerate(zip(*by_direction, strict=True)):
        by_mode = {case.mode: case.efficiency for case in cases}
        found["efficiency"][k], found["back_driving_efficiency"][k] = by_mode["driving"], by_mode["back-driving"]
    found["starting_torque"] = float(rubbing.starting(drive, [0.0], angle)[0].max())
    largest = drive.pair.rated_torque or float(np.abs(torque).max())
    found["back_driving_torque"] = float(back_driving(drive, largest, angle).max())


def _task(sweep: Sweep, numbers: Numbers) -> Solved:
    """Solve some drives in any process."""
    values, reasons = zip(*(figures_of(sweep, number) for number in numbers.tolist()), strict=True)
    return numbers, np.array(values), reasons


def run(
    sweep: Sweep,
    output: str | os.PathLike[str] | None = None,
    *,
    workers: int = 1,
    progress: Callable[[int], None] = lambda drives: None,
) -> xr.Dataset:
    """Solve a sweep.

    Parameters
    ----------
    output
        The file that `sweep_files.conduct` will write: until then solved drives are kept in a file of that name with
        `.checkpoint` appended, and the same sweep continues from there.
    workers
        Processes; the result does not depend on them.
    progress
        Called with the number of drives just finished, first those of the checkpoint.

    Raises
    ------
    edge.InputError
        If the sweep is invalid or the checkpoint is that of another one.
    KeyboardInterrupt
        As `machines.complete`.
    """
    check_sweep(sweep)
    kept = Checkpoint(None if output is None else checkpoint_of(output), sweep)
    complete(kept, _task, lambda numbers: (sweep, numbers), together=1, workers=workers, progress=progress)
    return _dataset(sweep, kept.values, [kept.notes.get(k, "") for k in range(sweep.drives)])


def _dataset(sweep: Sweep, values: Array, reasons: list[str]) -> xr.Dataset:
    import xarray as xr

    names = [one.name for one in sweep.vary]
    data: dict[str, Any] = {}
    for name, (unit, text) in {**sweep.loaded, **sweep.free}.items():
        columns = [i for i, (n, _) in enumerate(sweep.columns) if n == name]
        figure = values[:, columns].reshape(*sweep.shape, len(columns))
        loaded = name in sweep.loaded
        dims = (*names, "torque") if loaded else tuple(names)
        data[name] = (dims, figure if loaded else figure[..., 0], {"units": unit, "long_name": text})
    reason = np.array(reasons, dtype=object).reshape(sweep.shape)
    data["reason"] = (names, reason, {"long_name": "reason for missing figures, empty if none are missing"})
    places: dict[str, Any] = {
        "torque": (
            "torque",
            list(sweep.torque),
            {"units": "N*m", "long_name": "torque of the environment on the output"},
        )
    }
    for one in sweep.vary:
        places[one.name] = (one.name, list(one.values), {"units": one.si, "shown_units": one.unit})
    about = {name: value for name, value in sweep.identity().items() if name in ("pair", "surface", "first_stage")}
    return xr.Dataset(data, places, {"format": FORMAT, "angles": sweep.angles, "turns": sweep.turns, **about})


def figures_in(data: xr.Dataset) -> list[str]:
    """Return the names of the figures in a sweep's dataset; those at each torque have this dimension."""
    return [name for name in (*LOADED, *LOADED_RUBBING, *FREE, *FREE_RUBBING) if name in data]


def vary_of(given: Mapping[str, str | Iterable[float | str]]) -> tuple[Varied, ...]:
    """Return the varied values from {name: its values}; an `edge.InputError` names invalid ones."""
    return tuple(varied(name, values) for name, values in given.items())
