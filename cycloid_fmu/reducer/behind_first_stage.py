"""A drive behind its first stage: motion of the output with the sun locked, over the sun's angle.

The cranks turn with the output that they drive: θ = a φ_b - b φ_a + w with b = z_1/z_2, a = 1 + b and w the rotation of
the cranks by the first stage, -τ/κ and half its play against the load. Virtual work gives the torques: T = M + a τ at
the output and -b τ at the sun, M at the cycloid stage and τ at the cranks. With s = 1/(1 + a/z_c) the output deviates
by d = φ_b - φ_a/i = s (x(θ, M) - w/z_c) from the ideal reducer (docs/theory/reducer.md).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import contact, edge
from cycloid_fmu.contact.transmission import Interrupted, Options, Transmission, rigid_problem
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.first_stage import sun_locked_share
from cycloid_fmu.supports import transmission as stage

Array = NDArray[np.float64]
_ITERATIONS = 30
_STEP = 1e-12  # rad at the output: convergence limit of the transmission error
_SHARE = 1e-8  # of the torque: convergence limit of the cranks' torque
_DIFFERENCE = 2e-5  # rad of the cranks, half the central difference for derivatives


@dataclass(frozen=True)
class _Settled:
    """The cycloid stage in balance with the sun locked; arrays of shape (angles,), SI.

    `found` is solved at the cranks' angles `crank`, `gear_torque` is M and `transmission_error` d.
    """

    crank: Array
    gear_torque: Array
    transmission_error: Array
    found: Transmission


class _Stage:
    """The cycloid stage behind its first stage."""

    def __init__(self, drive: DriveValue, options: Options) -> None:
        assert drive.first_stage is not None
        self.drive, self.pair, self.first = drive.stage, drive.pair, drive.first_stage
        self.options = dataclasses.replace(options, with_play=False, with_elements=False, progress=lambda angles: None)
        self.problem = None if self.pair.supports is not None else rigid_problem(self.drive, options.slices)
        self.a, self.b = self.first.crank_share, self.first.sun_share
        self.s = sun_locked_share(self.a, self.pair.gear_teeth)
        self.soft = 1.0 / self.first.crank_stiffness

    def solve(self, torque: Array, crank: Array, **options: Any) -> Transmission:
        """Solve the stage at one torque (N·m) per crank angle (rad), with the cranks' torque."""
        found = stage.solve(self.drive, torque[None], crank, dataclasses.replace(self.options, **options))
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
        """Return the transmission error d (rad) for the stage's transmission error x (rad)."""
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
        for torque in stage.play_loads(self.pair):
            settled = self.settle(torque, crank)
            ends.append(settled.transmission_error - torque * self.moved(settled)[0])
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


def solve(drive: DriveValue, torque: Array, crank_angle: Array, options: Options) -> Transmission:
    """Solve a drive behind its first stage; see `cycloid_fmu.analysis.solve`.

    The sun is locked where ideal gears have the cranks at `crank_angle`; `torque` has shape (torques,).
    """
    cycloid = _Stage(drive, options)
    rows = []
    try:
        missing = np.full(crank_angle.size, np.nan)
        play: dict[str, Any] = {"play_low": missing, "play_high": missing, "interference": missing}
        play |= {"preload": None, "preload_count": None}
        if options.with_play or 0.0 in torque:
            play = cycloid.play(crank_angle)
        middle = 0.5 * (play["play_low"] + play["play_high"])
        for load in torque:
            rows.append(_row(cycloid, float(load), crank_angle, middle, options))
            options.progress(crank_angle.size)
    except Interrupted:
        # Its partial results are those of the stage's sweep, not of this one.
        raise KeyboardInterrupt from None
    if not rows:
        rows = [_of_no_torque(cycloid.solve(np.zeros(crank_angle.size), crank_angle))]
    return _whole(rows, torque, crank_angle, **play)


def _of_no_torque(found: Transmission) -> Transmission:
    values: dict[str, Any] = {f.name: getattr(found, f.name) for f in dataclasses.fields(found)}
    empty: dict[str, Any] = {name: None if v is None else v[:0] for name, v in values.items() if name != "crank_angle"}
    return dataclasses.replace(found, **empty)


def _row(cycloid: _Stage, torque: float, crank: Array, middle: Array, options: Options) -> Transmission:
    if torque == 0.0 and cycloid.pair.supports is not None:
        found = cycloid.solve(np.zeros(crank.size), crank + cycloid.a * middle)
        return dataclasses.replace(found, transmission_error=middle[None])
    settled = cycloid.settle(torque, crank, options.with_elements)
    stiffness = np.zeros(crank.size) if torque == 0.0 else np.full(crank.size, np.nan)
    if options.with_stiffness and torque != 0.0:
        stiffness = 1.0 / cycloid.moved(settled)[0]
    return dataclasses.replace(
        settled.found, transmission_error=settled.transmission_error[None], torsional_stiffness=stiffness[None]
    )


def moved_by_errors(
    drive: DriveValue, torque: float, crank_angle: Array, slices: int
) -> tuple[Array, Array, Array, Array]:
    """Return where a torque (N·m) on the output holds a drive behind its first stage, and how the output follows.

    Returns
    -------
    transmission_error, gear_torque, crank, by_stage
        Shape (angles,): of the output (rad), the stage's torque (N·m) and its crank angle (rad), and the derivative of
        the output by an error's effect on the stage. The effect of an error on the cranks' torque is neglected: 0.2 %
        of a derivative at rated torque.
    """
    cycloid = _Stage(drive, Options(slices))
    settled = cycloid.settle(torque, crank_angle)
    return settled.transmission_error, settled.gear_torque, settled.crank, cycloid.moved(settled)[1]
