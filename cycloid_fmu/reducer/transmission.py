"""A drive behind its first stage: motion of the output with the sun locked, over the sun's angle.

The cranks turn with the output that they drive: θ = a φ_b - b φ_a + w with b = z_1/z_2, a = 1 + b and w the rotation of
the cranks by the first stage, -τ/κ and half its play against the load. Virtual work gives the torques: T = M + a τ at
the output and -b τ at the sun, M at the cycloid stage and τ at the cranks. With s = 1/(1 + a/z_c) the output deviates
by d = φ_b - φ_a/i = s (x(θ, M) - w/z_c) from the ideal reducer (docs/theory/reducer.md).
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import contact, edge
from cycloid_fmu.contact.transmission import Interrupted, Transmission, drive_of
from cycloid_fmu.geometry.pair import LOST_MOTION_LOAD, Pair
from cycloid_fmu.reducer.first_stage import FirstStage, sun_locked_share
from cycloid_fmu.supports import transmission as of_stage
from cycloid_fmu.supports.figures import Share, remaining
from cycloid_fmu.supports.figures import compliance as of_bearings
from cycloid_fmu.surfaces.provenance import drive_hash
from cycloid_fmu.surfaces.surface import ErrorSurface

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]
_ITERATIONS = 30
_STEP = 1e-12  # rad at the output: convergence limit of the deviation
_SHARE = 1e-8  # of the torque: convergence limit of the cranks' torque
_DIFFERENCE = 2e-5  # rad of the cranks, half the central difference for derivatives


@dataclass(frozen=True)
class _Settled:
    """The cycloid stage in balance with the sun locked; arrays of shape (angles,), SI.

    `found` is solved at the cranks' angles `crank`, `gear_torque` is M and `deviation` d.
    """

    crank: Array
    gear_torque: Array
    deviation: Array
    found: Transmission


class _Stage:
    """The cycloid stage behind its first stage."""

    def __init__(self, pair: Pair, surface: ErrorSurface, first_stage: FirstStage, slices: int, workers: int) -> None:
        self.pair, self.surface, self.slices, self.workers = pair, surface, slices, workers
        self.problem = None if pair.supports is not None else drive_of(pair, surface, slices)
        self.first = first_stage
        self.a, self.b = first_stage.crank_share, first_stage.sun_share
        self.s = sun_locked_share(self.a, pair.gear_teeth)
        self.soft = 1.0 / first_stage.crank_stiffness

    def solve(self, torque: Array, crank: Array, **options: Any) -> Transmission:
        """Solve the stage at one torque (N·m) per crank angle (rad), with the cranks' torque."""
        found = of_stage.solve(
            self.pair,
            self.surface,
            torque[None],
            crank,
            self.slices,
            workers=self.workers,
            **{"with_play": False, **options},
        )
        if self.problem is None:
            return found
        crank_torque = np.empty((1, crank.size))
        contact.sweep_crank_side(
            self.problem, crank, found.transmission_error[0].copy(), crank_torque[0], np.empty(crank.size)
        )
        return dataclasses.replace(found, crank_torque=crank_torque)

    def turned(self, side: float, crank_torque: ArrayLike) -> Array:
        """Return w, the rotation of the cranks by the first stage, rad."""
        return np.asarray(-np.multiply(self.soft, crank_torque) - 0.5 * side * self.first.crank_play)

    def output(self, x: ArrayLike, side: float, w: ArrayLike) -> Array:
        """Return the deviation d (rad) for the stage's deviation x (rad)."""
        beside = 0.5 * side * self.first.bearing_play
        return np.asarray(self.s * (np.add(x, beside) - np.divide(w, self.pair.gear_teeth)))

    def settle(self, torque: float, crank: Array, with_elements: bool = False) -> _Settled:
        """Solve a torque on the output (N·m), with the sun where ideal gears have the cranks at `crank` (rad)."""
        side = float(np.sign(torque))
        crank_torque = np.full(crank.size, (1.0 - self.s) / self.a * torque)
        w = self.turned(side, crank_torque)
        d = self.output(0.0, side, w)
        for _ in range(_ITERATIONS):
            place = crank + self.a * d + w
            gear_torque = np.full(crank.size, torque) - self.a * crank_torque
            found = self.solve(gear_torque if torque != 0.0 else np.zeros(crank.size), place)
            assert found.crank_torque is not None
            # The cranks' torque is 1/z_c of the stage's, apart from its errors.
            change = self.s * (found.crank_torque[0] - crank_torque) if torque != 0.0 else np.zeros(crank.size)
            crank_torque = crank_torque + change
            w = self.turned(side, crank_torque)
            before, d = d, self.output(found.transmission_error[0], side, w)
            if np.abs(d - before).max() < _STEP and np.abs(change).max() <= _SHARE * abs(torque):
                if with_elements:
                    found = self.solve(gear_torque, place, with_elements=True)
                return _Settled(place, gear_torque, d, found)
        raise edge.InputError(
            f"torque = {torque:g} N*m: the reducer can't balance it behind its first stage; give a smaller one."
        )

    def moved(self, settled: _Settled) -> tuple[Array, Array, Array]:
        """Return derivatives of the output by torque (rad/(N·m)) and by x for an error (dimensionless), and dx/dθ.

        The effect of an error on the cranks' torque is neglected.
        """
        places, torques = [], []
        for step in (-_DIFFERENCE, _DIFFERENCE):
            found = self.solve(settled.gear_torque, settled.crank + step)
            assert found.crank_torque is not None
            places.append(found.transmission_error[0])
            torques.append(found.crank_torque[0])
        by_angle = (places[1] - places[0]) / (2.0 * _DIFFERENCE)
        torque_rate = (torques[1] - torques[0]) / (2.0 * _DIFFERENCE)
        compliance = 1.0 / settled.found.torsional_stiffness[0]
        # Derivative of the cranks' torque by the stage's (Maxwell's reciprocity), with the first stage's wind-up.
        coupling = 1.0 / self.pair.gear_teeth - by_angle
        held = 1.0 + torque_rate * self.soft + coupling * self.a
        back = coupling * self.soft - self.a * compliance
        by_error = self.s / (1.0 - self.s * self.a * (by_angle + torque_rate * back / held))
        return by_error * (compliance + coupling * back / held), by_error, by_angle

    def play(self, crank: Array) -> dict[str, Any]:
        """Return the fields of `Transmission` that tell of the drive without a torque, with the sun locked."""
        if self.pair.supports is not None:
            return self._play_on_bearings(crank)
        ends, interference = [], np.zeros(crank.size)
        for side in (-1.0, 1.0):
            w = self.turned(side, 0.0)
            d = self.output(np.zeros(crank.size), side, w)
            for _ in range(_ITERATIONS):
                place = crank + self.a * np.where(np.isnan(d), 0.0, d) + w
                found = self.solve(np.zeros(crank.size), place, with_play=True)
                before, d = d, self.output(found.play_low if side < 0.0 else found.play_high, side, w)
                if np.nanmax(np.abs(d - before), initial=0.0) < _STEP:
                    break
            ends.append(d)
            interference = np.maximum(interference, found.interference)
        play = {"play_low": ends[0], "play_high": ends[1], "interference": interference}
        return play | {"preload": None, "preload_count": None}

    def _play_on_bearings(self, crank: Array) -> dict[str, Any]:
        ends = []
        for torque in of_stage.play_loads(self.pair):
            settled = self.settle(torque, crank)
            ends.append(settled.deviation - torque * self.moved(settled)[0])
        middle = 0.5 * (ends[0] + ends[1])
        rest = self.solve(np.zeros(crank.size), crank + self.a * middle, with_play=True)
        play = {"play_low": np.minimum(ends[0], middle), "play_high": np.maximum(ends[1], middle)}
        return play | {name: getattr(rest, name) for name in ("interference", "preload", "preload_count")}


def _whole(rows: Sequence[Transmission], torque: Array, crank: Array, **play: Any) -> Transmission:
    """Join sweeps of one torque each."""
    joined = dict[str, Any]()
    for field in dataclasses.fields(rows[0]):
        if field.name not in ("torque", "crank_angle", *play) and getattr(rows[0], field.name) is not None:
            joined[field.name] = np.concatenate([getattr(row, field.name) for row in rows])
    joined.update(play)
    return dataclasses.replace(rows[0], torque=torque, crank_angle=crank, **joined)


def solve(
    pair: Pair,
    surface: ErrorSurface,
    first_stage: FirstStage | None,
    torque: ArrayLike,
    crank_angle: ArrayLike,
    slices: int = 1,
    *,
    with_play: bool = True,
    with_stiffness: bool = True,
    with_elements: bool = False,
    workers: int = 1,
    progress: Callable[[int], None] = lambda angles: None,
) -> Transmission:
    """Solve a drive at every torque and crank angle, behind a first stage if there is one.

    Parameters and errors are those of `contact.transmission.solve`, and:

    Parameters
    ----------
    first_stage
        The sun is then locked where ideal gears have the cranks at `crank_angle`, and transmission error, stiffness and
        play are those of the output of the whole reducer.
    with_stiffness
        Whether to compute the torsional stiffness behind a first stage; NaN otherwise.

    Raises
    ------
    edge.InputError
        If a torque can't be carried.
    """
    if first_stage is None:
        return of_stage.solve(
            pair,
            surface,
            torque,
            crank_angle,
            slices,
            with_play=with_play,
            with_elements=with_elements,
            workers=workers,
            progress=progress,
        )
    torques, angles = np.array(torque, dtype=float, ndmin=1), np.array(crank_angle, dtype=float, ndmin=1)
    if not (np.isfinite(torques).all() and np.isfinite(angles).all()):
        raise ValueError("torque and crank_angle must be finite")
    stage = _Stage(pair, surface, first_stage, slices, workers)
    rows = []
    try:
        missing = np.full(angles.size, np.nan)
        play: dict[str, Any] = {"play_low": missing, "play_high": missing, "interference": missing}
        play |= {"preload": None, "preload_count": None}
        if with_play or 0.0 in torques:
            play = stage.play(angles)
        middle = 0.5 * (play["play_low"] + play["play_high"])
        for load in torques:
            rows.append(_row(stage, float(load), angles, middle, with_stiffness, with_elements))
            progress(angles.size)
    except Interrupted:
        # Its partial results are those of the stage's sweep, not of this one.
        raise KeyboardInterrupt from None
    if not rows:
        found = stage.solve(np.zeros(angles.size), angles)
        rows = [_of_no_torque(found)]
    return _whole(rows, torques, angles, **play)


def _of_no_torque(found: Transmission) -> Transmission:
    values: dict[str, Any] = {f.name: getattr(found, f.name) for f in dataclasses.fields(found)}
    empty: dict[str, Any] = {name: None if v is None else v[:0] for name, v in values.items() if name != "crank_angle"}
    return dataclasses.replace(found, **empty)


def _row(
    stage: _Stage, torque: float, crank: Array, middle: Array, with_stiffness: bool, with_elements: bool
) -> Transmission:
    if torque == 0.0 and stage.pair.supports is not None:
        found = stage.solve(np.zeros(crank.size), crank + stage.a * middle)
        return dataclasses.replace(found, transmission_error=middle[None])
    settled = stage.settle(torque, crank, with_elements)
    stiffness = np.zeros(crank.size) if torque == 0.0 else np.full(crank.size, np.nan)
    if with_stiffness and torque != 0.0:
        stiffness = 1.0 / stage.moved(settled)[0]
    return dataclasses.replace(
        settled.found, transmission_error=settled.deviation[None], torsional_stiffness=stiffness[None]
    )


def error_sensitivity(
    pair: Pair,
    surface: ErrorSurface,
    first_stage: FirstStage | None,
    torque: float,
    crank_angle: ArrayLike,
    names: list[str],
    slices: int = 1,
) -> tuple[Array, Array]:
    """Return the transmission error at one torque and its derivatives, as `supports.transmission.error_sensitivity`.

    Behind a first stage, the effect of an error on the cranks' torque is neglected: 0.2 % of a derivative at rated
    torque.
    """
    if first_stage is None:
        return of_stage.error_sensitivity(pair, surface, torque, crank_angle, names, slices)
    stage = _Stage(pair, surface, first_stage, slices, 1)
    settled = stage.settle(float(torque), np.array(crank_angle, dtype=float, ndmin=1))
    _, jacobian = of_stage.error_sensitivity(pair, surface, settled.gear_torque, settled.crank, names, slices)
    return settled.deviation, stage.moved(settled)[1][:, None] * jacobian


def labelled(
    pair: Pair,
    surface: ErrorSurface,
    first_stage: FirstStage | None,
    found: Transmission,
    slices: int,
    *,
    complete: bool,
) -> xr.Dataset:
    """Return results as a dataset (format `cycloid-analysis/1`), with angle and torque of the sun if there is one."""
    data = of_stage.labelled(pair, surface, found, slices, complete=complete)
    if first_stage is None or found.crank_torque is None:
        return data
    grid = ("torque", "crank_angle")
    sun = {"units": "rad", "long_name": "angle of the sun"}
    data = data.assign_coords(
        sun_angle=("crank_angle", -found.crank_angle * first_stage.ratio(pair.gear_teeth) / pair.gear_teeth, sun)
    )
    data["crank_torque"] = (
        grid,
        found.crank_torque,
        {"units": "N*m", "long_name": "total torque of the first stage on the cranks"},
    )
    data["sun_torque"] = (
        grid,
        -first_stage.sun_share * found.crank_torque,
        {"units": "N*m", "long_name": "torque of the environment on the sun"},
    )
    data["crank_angle"].attrs["long_name"] = "crank angle of ideal gears at the sun's angle"
    for name in ("transmission_error", "backlash", "torsional_stiffness"):
        data[name].attrs["long_name"] += ", sun locked"
    data.attrs["first_stage"] = first_stage.text
    data.attrs["drive"] = drive_hash(pair, surface, first_stage.text)
    return data


def compliance(
    pair: Pair, first_stage: FirstStage | None, *, progress: Callable[[int], None] = lambda parts: None
) -> list[Share]:
    """Return the shares of compliance and lost motion of a drive as drawn, as `supports.figures.compliance`.

    Behind a first stage each part's share is that with the sun locked, and the first stage has its own.
    """
    if first_stage is None or pair.rated_torque is None:
        return of_bearings(pair, progress=progress)
    teeth = pair.gear_teeth
    s = sun_locked_share(first_stage.crank_share, teeth)
    # The cranks take their share of the output's torque, in parallel to the stage.
    shares = of_bearings(pair.replace(rated_torque=s * pair.rated_torque), progress=progress)
    soft = (s / teeth) ** 2 / first_stage.crank_stiffness
    play = s * (first_stage.crank_play / teeth + first_stage.bearing_play)
    beside = Share("first stage", soft, play + 2.0 * LOST_MOTION_LOAD * pair.rated_torque * soft)
    return [*(Share(one.part, s * s * one.compliance, s * one.lost_motion) for one in shares), beside]


def analyze(
    pair: Pair,
    surface: ErrorSurface,
    first_stage: FirstStage | None,
    torque: ArrayLike,
    crank_angle: ArrayLike,
    slices: int = 1,
    **options: Any,
) -> xr.Dataset:
    """Return the labelled dataset of `solve`, with its `options`.

    If interrupted, it returns the finished crank angles, and the attribute `complete` is 0.
    """
    complete = True
    try:
        found = solve(pair, surface, first_stage, torque, crank_angle, slices, **options)
    except Interrupted as interrupted:
        found, complete = interrupted.result, False
    return labelled(pair, surface, first_stage, found, slices, complete=complete)


@functools.lru_cache(maxsize=16)
def series_compliance(pair: Pair, first_stage: FirstStage | None) -> float:
    """Return the compliance of the parts that the model takes as rigid, from a stated catalogue stiffness, rad/(N·m).

    It is the catalogue's compliance less that of the drive as drawn (`compliance`): the same for a drive with errors.
    It is 0 without a catalogue stiffness, and where the drive as drawn is softer than that.

    Raises
    ------
    edge.InputError
        As `compliance`.
    """
    if pair.supports is None or pair.supports.catalogue_stiffness is None:
        return 0.0
    return max(remaining(pair.supports, compliance(pair, first_stage)), 0.0)
