"""The contacts of a model, with the state of their solver; the model itself holds only its history."""

from __future__ import annotations

import base64
import copy
import math
from typing import Any, Self

import numpy as np
from numba import types
from numba.experimental import structref

from cycloid_fmu import contact
from cycloid_fmu.contact import Array, Problem, Rows, compiled
from cycloid_fmu.contact.transmission import balances, carried


class StepError(ValueError):
    """A step that can't be made; the text is one sentence."""


@structref.register
class _BoxType(types.StructRef):  # type: ignore[misc]
    def preprocess_fields(self, fields: Any) -> Any:
        return tuple((name, types.unliteral(kind)) for name, kind in fields)


class _Box(structref.StructRefProxy):  # type: ignore[misc]
    """A contact problem as one pointer: passing its thirty fields to a kernel takes longer than a warm solution."""


structref.define_proxy(_Box, _BoxType, ["drive"])


@compiled
def _boxed(drive: Problem) -> _Box:
    return _Box(drive)


@compiled
def _play(box: _Box, theta: float, x: float, rows: Rows, cold: bool) -> tuple[float, float, float]:
    return contact.play(box.drive, theta, x, rows, cold)


@compiled
def _touch_rate(box: _Box, theta: float, x: float, rows: Rows, cold: bool, side: float) -> float:
    contact.place(box.drive, theta, x, rows, cold, math.inf, math.inf)
    return contact.touch_rate(box.drive, theta, x, rows, side)


@compiled
def _equilibrium(box: _Box, theta: float, torque: float, x: float, rows: Rows, cold: bool) -> tuple[float, float]:
    return contact.equilibrium(box.drive, theta, torque, x, rows, cold)


@compiled
def _behind(
    box: _Box, theta: float, flange: float, compliance: float, x: float, rows: Rows, cold: bool
) -> tuple[float, float]:
    return contact.behind_compliance(box.drive, theta, flange, compliance, x, rows, cold)


@compiled
def _press(
    box: _Box, theta: float, flange: float, compliance: float, x: float, rows: Rows, cold: bool
) -> tuple[float, float, float, float, float]:
    return contact.press(box.drive, theta, flange, compliance, x, rows, cold)


@compiled
def _crank_side(box: _Box, theta: float, x: float, rows: Rows) -> tuple[float, float]:
    return contact.crank_side(box.drive, theta, x, rows)


@compiled
def _load_sharing(box: _Box, rows: Rows, pin_force: Array, pin_pressure: Array) -> tuple[int, float]:
    return contact.load_sharing(box.drive, rows, pin_force, pin_pressure)


class ContactTeeth:
    """Gear and pins at a crank angle θ (rad), an output deviation x from its ideal angle (rad) and a torque (N·m).

    Each solution is the start of the next; methods with `x` start their search there. `crank_side`, `torque`,
    `sharing`, `pin_force` and `pin_pressure` refer to the last solution of `equilibrium`, `behind` or `press`. A torque
    or position without a solution raises a `StepError`.

    Parameters
    ----------
    drive
        The contact problem.
    pins
        Number of discs, and number of pins.
    """

    def __init__(self, drive: Problem, pins: tuple[int, int]) -> None:
        self._drive = _boxed(drive)
        self._rows, self._play_rows = contact.contact_rows(drive), contact.contact_rows(drive)
        self._cold = self._play_cold = True
        self._pin_force, self._pin_pressure = np.zeros(pins), np.zeros(pins)
        self._view_bytes()
        self._spare, self._play_spare = self._bytes.copy(), self._play_bytes.copy()
        self._before = (True, True)
        self._moved = self._play_moved = True

    def _view_bytes(self) -> None:
        """View the rows as bytes, which NumPy copies ten times as fast as records."""
        self._bytes, self._play_bytes = self._rows.view(np.uint8), self._play_rows.view(np.uint8)

    def play(self, theta: float, x: float) -> tuple[float, float, float]:
        """Return both ends of the free rotation (rad) and the interference (m), which is above 0 if there is none."""
        self._keep_play()
        found = _play(self._drive, theta, x, self._play_rows, self._play_cold)
        self._play_cold = math.isnan(found[0])
        return found

    def _keep_play(self) -> None:
        if not self._play_moved:
            np.copyto(self._play_spare, self._play_bytes)
            self._play_moved = True

    def touch_rate(self, theta: float, x: float, side: float) -> float:
        """Return dφ_b/dθ (dimensionless) at the end x (rad) of the play on a side (±1)."""
        self._keep_play()
        return _touch_rate(self._drive, theta, x, self._play_rows, self._play_cold, side)

    def _start(self) -> bool:
        """Save the rows before the first solution of a step; return whether they are still empty."""
        if not self._moved:
            np.copyto(self._spare, self._bytes)
            self._moved = True
        cold, self._cold = self._cold, False
        return cold

    def equilibrium(self, theta: float, torque: float, x: float) -> tuple[float, float]:
        """Return deviation (rad) and stiffness (N·m/rad) under a torque (N·m), which is 0 only without play."""
        cold = self._start()
        found: tuple[float, float] = _equilibrium(self._drive, theta, torque, x, self._rows, cold)
        falling = torque != 0.0 and not found[1] > 0.0  # as with worn flanks, or if nothing can balance the torque
        if not math.isfinite(found[0]) or (falling and not balances(torque, self.torque)):
            self._cold = True
            raise StepError(f"flange_b.tau = {torque:g} N.m: no contacts of this pair can balance it")
        return found

    def behind(self, theta: float, flange: float, compliance: float, x: float) -> tuple[float, float]:
        """Return deviation and stiffness of the teeth for a flange at a deviation behind a compliance, rad/(N·m)."""
        return _behind(self._drive, theta, flange, compliance, x, self._rows, self._start())

    def press(
        self, theta: float, flange: float, compliance: float, x: float
    ) -> tuple[float, float, float, float, float]:
        """Return the same as `behind`, and the stored energy (J) with its derivatives by θ and φ_b (N·m)."""
        cold = self._start()
        found: tuple[float, float, float, float, float] = _press(
            self._drive, theta, flange, compliance, x, self._rows, cold
        )
        if not math.isfinite(found[4]):
            self._cold = True
            raise StepError("the contacts could not be solved at these flange angles")
        return found

    def crank_side(self, theta: float, x: float) -> tuple[float, float]:
        """Return the torque required at the crank (N·m), and dφ_b/dθ at constant torque (dimensionless)."""
        return _crank_side(self._drive, theta, x, self._rows)

    @property
    def torque(self) -> float:
        """Torque through the teeth, N·m."""
        return float(carried(self._rows))

    def sharing(self) -> tuple[int, float]:
        """Return the number of pins in contact, and the largest pressure (Pa)."""
        return _load_sharing(self._drive, self._rows, self._pin_force, self._pin_pressure)

    def pin_force(self) -> list[float]:
        """Return the force on each pin, disc by disc, N; valid after `sharing`."""
        return self._pin_force.ravel().tolist()

    def pin_pressure(self) -> list[float]:
        """Return the largest pressure on each pin, disc by disc, Pa; valid after `sharing`."""
        return self._pin_pressure.ravel().tolist()

    def begin(self) -> None:
        """Save the state for `undo`; rows are saved when they are first solved."""
        self._before = self._cold, self._play_cold
        self._moved = self._play_moved = False

    def undo(self) -> None:
        """Restore the state saved by `begin`."""
        self._cold, self._play_cold = self._before
        if self._moved:
            np.copyto(self._bytes, self._spare)
        if self._play_moved:
            np.copyto(self._play_bytes, self._play_spare)

    def copy(self) -> Self:
        """Return an independent copy."""
        other = copy.copy(self)
        for name in (*_ARRAYS, "_spare", "_play_spare"):
            setattr(other, name, getattr(self, name).copy())
        other._view_bytes()
        return other

    def state(self) -> dict[str, Any]:
        """Return the state as plain values."""
        arrays = {name: base64.b64encode(getattr(self, name).tobytes()).decode() for name in _ARRAYS}
        return {"cold": self._cold, "play_cold": self._play_cold, **arrays}

    def restore(self, state: dict[str, Any]) -> None:
        """Restore a state returned by `state`."""
        self._cold, self._play_cold = state["cold"], state["play_cold"]
        for name in _ARRAYS:
            kept = getattr(self, name)
            kept[...] = np.frombuffer(base64.b64decode(state[name]), kept.dtype).reshape(kept.shape)


_ARRAYS = ("_rows", "_play_rows", "_pin_force", "_pin_pressure")
