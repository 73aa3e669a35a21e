"""What stands behind a model's flanges: the exact contacts here, their tables in `table_teeth`.

Both keep how they stand, so that a model has its history and nothing of contact rows or table nodes.
"""

from __future__ import annotations

import copy
import math
from typing import Any, Protocol, Self

import numpy as np
from numba import types
from numba.experimental import structref

from cycloid_fmu import contact
from cycloid_fmu.contact import Array, Problem, Rows, compiled
from cycloid_fmu.contact.transmission import balances, carried


class StepError(ValueError):
    """A step that the model refuses; the text is one sentence."""


class Teeth(Protocol):
    """Gear and pins at a crank angle θ (rad), the output off its ideal place by x (rad) and under a torque (N·m).

    Where a method takes `x`, the search starts there. What `equilibrium`, `behind` or `press` solved last is what
    `crank_side`, `torque`, `sharing`, `pin_force` and `pin_pressure` tell of. A torque or place at which nothing can be
    found is a `StepError`.
    """

    def play(self, theta: float, x: float) -> tuple[float, float, float]:
        """Ends of the free rotation (rad), and above 0 that there is none (m)."""

    def touch_rate(self, theta: float, x: float, side: float) -> float:
        """How the crank moves the end x of the play on a side (±1) with it: dφ_b/dθ (1)."""

    def equilibrium(self, theta: float, torque: float, x: float) -> tuple[float, float]:
        """Deviation (rad) and stiffness (N·m/rad) under a torque; at torque 0 where there is no play."""

    def behind(self, theta: float, flange: float, compliance: float, x: float) -> tuple[float, float]:
        """Likewise with the flange held at a deviation (rad) behind a compliance (rad/(N·m)): that of the teeth."""

    def press(
        self, theta: float, flange: float, compliance: float, x: float
    ) -> tuple[float, float, float, float, float]:
        """Likewise, and the stored energy (J) with its derivatives by θ and φ_b (N·m)."""

    def crank_side(self, theta: float, x: float) -> tuple[float, float]:
        """Torque that the crank must be given (N·m), and dφ_b/dθ at constant torque (1)."""

    @property
    def torque(self) -> float:
        """Torque through the teeth, N·m."""

    def sharing(self, theta: float) -> tuple[int, float]:
        """Pins in contact, and the largest pressure (Pa)."""

    def pin_force(self, theta: float) -> list[float]:
        """Force on each pin after `sharing`, disc by disc, N."""

    def pin_pressure(self, theta: float) -> list[float]:
        """Largest pressure on each pin after `sharing`, disc by disc, Pa."""

    def begin(self) -> None:
        """Keep how all stands, for `undo`."""

    def undo(self) -> None:
        """Return to how all stood at `begin`."""

    def copy(self) -> Self:
        """Return teeth that stand alike and move by themselves."""

    def state(self) -> dict[str, Any]:
        """Return how all stands, as plain values."""

    def restore(self, state: dict[str, Any]) -> None:
        """Return to a state given by `state`."""


@structref.register
class _BoxType(types.StructRef):  # type: ignore[misc]
    def preprocess_fields(self, fields: Any) -> Any:
        return tuple((name, types.unliteral(kind)) for name, kind in fields)


class _Box(structref.StructRefProxy):  # type: ignore[misc]
    """A drive as one pointer: handing its thirty fields to a kernel takes longer than a warm solution."""


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
    """`Teeth` of the exact contact model: each solution is the start of the next.

    Parameters
    ----------
    drive
        The contact problem.
    pins
        Discs, and pins of each.
    """

    def __init__(self, drive: Problem, pins: tuple[int, int]) -> None:
        self._drive = _boxed(drive)
        self._rows, self._play_rows = contact.contact_rows(drive), contact.contact_rows(drive)
        self._cold = self._play_cold = True
        self._pin_force, self._pin_pressure = np.zeros(pins), np.zeros(pins)
        self._spare, self._play_spare = self._rows.copy(), self._rows.copy()
        self._before = (True, True)
        self._moved = self._play_moved = True

    def play(self, theta: float, x: float) -> tuple[float, float, float]:
        """As of `Teeth`."""
        self._keep_play()
        found = _play(self._drive, theta, x, self._play_rows, self._play_cold)
        self._play_cold = math.isnan(found[0])
        return found

    def _keep_play(self) -> None:
        if not self._play_moved:
            np.copyto(self._play_spare, self._play_rows)
            self._play_moved = True

    def touch_rate(self, theta: float, x: float, side: float) -> float:
        """As of `Teeth`."""
        self._keep_play()
        return _touch_rate(self._drive, theta, x, self._play_rows, self._play_cold, side)

    def _start(self) -> bool:
        """Keep the rows before the first solution of a step; whether they hold nothing yet."""
        if not self._moved:
            np.copyto(self._spare, self._rows)
            self._moved = True
        cold, self._cold = self._cold, False
        return cold

    def equilibrium(self, theta: float, torque: float, x: float) -> tuple[float, float]:
        """As of `Teeth`."""
        cold = self._start()
        found: tuple[float, float] = _equilibrium(self._drive, theta, torque, x, self._rows, cold)
        falling = torque != 0.0 and not found[1] > 0.0  # as on worn flanks, or where nothing can balance the torque
        if not math.isfinite(found[0]) or (falling and not balances(torque, self.torque)):
            self._cold = True
            raise StepError(f"flange_b.tau = {torque:g} N.m: no contacts of this pair can balance it")
        return found

    def behind(self, theta: float, flange: float, compliance: float, x: float) -> tuple[float, float]:
        """As of `Teeth`."""
        return _behind(self._drive, theta, flange, compliance, x, self._rows, self._start())

    def press(
        self, theta: float, flange: float, compliance: float, x: float
    ) -> tuple[float, float, float, float, float]:
        """As of `Teeth`."""
        cold = self._start()
        found: tuple[float, float, float, float, float] = _press(
            self._drive, theta, flange, compliance, x, self._rows, cold
        )
        if not math.isfinite(found[4]):
            self._cold = True
            raise StepError("the contacts could not be solved at this place of the flanges")
        return found

    def crank_side(self, theta: float, x: float) -> tuple[float, float]:
        """As of `Teeth`."""
        return _crank_side(self._drive, theta, x, self._rows)

    @property
    def torque(self) -> float:
        """As of `Teeth`."""
        return float(carried(self._rows))

    def sharing(self, theta: float) -> tuple[int, float]:
        """As of `Teeth`."""
        return _load_sharing(self._drive, self._rows, self._pin_force, self._pin_pressure)

    def pin_force(self, theta: float) -> list[float]:
        """As of `Teeth`."""
        return self._pin_force.ravel().tolist()

    def pin_pressure(self, theta: float) -> list[float]:
        """As of `Teeth`."""
        return self._pin_pressure.ravel().tolist()

    def begin(self) -> None:
        """As of `Teeth`; rows are kept when they are first solved."""
        self._before = self._cold, self._play_cold
        self._moved = self._play_moved = False

    def undo(self) -> None:
        """As of `Teeth`."""
        self._cold, self._play_cold = self._before
        if self._moved:
            np.copyto(self._rows, self._spare)
        if self._play_moved:
            np.copyto(self._play_rows, self._play_spare)

    def copy(self) -> Self:
        """As of `Teeth`."""
        other = copy.copy(self)
        for name in ("_rows", "_play_rows", "_spare", "_play_spare", "_pin_force", "_pin_pressure"):
            setattr(other, name, getattr(self, name).copy())
        return other

    def state(self) -> dict[str, Any]:
        """As of `Teeth`."""
        return {
            "contacts": self._rows.view(float).tolist(), "play_contacts": self._play_rows.view(float).tolist(),
            "cold": self._cold, "play_cold": self._play_cold,
            "pins": [self._pin_force.tolist(), self._pin_pressure.tolist()],
        }  # fmt: skip

    def restore(self, state: dict[str, Any]) -> None:
        """As of `Teeth`."""
        self._rows, self._play_rows = (np.array(state[n]).view(contact.ROW) for n in ("contacts", "play_contacts"))
        self._cold, self._play_cold = state["cold"], state["play_cold"]
        self._pin_force, self._pin_pressure = (np.array(values) for values in state["pins"])
