"""A drive on its bearings in a model: the interface of `mesh.ContactTeeth` for discs that float on bearings."""

from __future__ import annotations

import base64
import copy
import math
from typing import Any, Self

import numpy as np

from cycloid_fmu import contact
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.mesh import StepError
from cycloid_fmu.supports import energy
from cycloid_fmu.supports.balance import Load
from cycloid_fmu.supports.bearing import CENTRING
from cycloid_fmu.supports.joints import work_of
from cycloid_fmu.supports.transmission import assembly_of, play_loads, problem_of

_STIFFEST = 1e12  # N·m/rad: in place of a flange without compliance; it turns by some 1e-5″
_PRESSED_CENTRING = 1e4  # N/m: with two prescribed flanges the discs cross their clearances at every reversal
_BALANCED = 1e-6  # N: smaller residuals are within rounding
_NEAR = 1.0  # rad: a solution farther away is no useful start
_CRANK_STEP = 1e-5  # rad: crank step for the derivative of an end of the play
_PLACE = ("place", "pose", "moved")


class _Stand:
    """The last solution of the drive, from which the next one starts."""

    def __init__(self, drive: DriveValue, slices: int) -> None:
        pair = drive.pair
        shift_x, shift_y, turn = (np.zeros(pair.discs) for _ in range(3))
        self._drive = problem_of(drive, slices)._replace(shift_x=shift_x, shift_y=shift_y, turn=turn)
        assembly = assembly_of(drive)
        self._assembly = assembly._replace(balanced=max(assembly.balanced, _BALANCED))
        self.rows, self.found, self.theta = contact.contact_rows(self._drive), np.zeros(energy.FOUND), math.nan
        self._make(work_of(assembly))

    def _make(self, work: Any) -> None:
        self.work = work
        self.box = energy.held(self._drive, self._assembly, work)
        # Bytes, which NumPy copies ten times as fast as records.
        self._seen = [self.rows.view(np.uint8), self.found, *(getattr(work, name) for name in _PLACE)]
        self._spare = [array.copy() for array in self._seen]
        self._before = self.theta

    def solve(
        self, theta: float, torque: float, spring: float = 0.0, flange: float = 0.0, pressed: bool = False
    ) -> bool:
        """Solve a position of the flanges; return whether a solution was found."""
        cold = not abs(theta - self.theta) < _NEAR
        pull = Load(torque, spring, flange, _PRESSED_CENTRING if pressed else CENTRING)
        self.theta = theta
        if not energy.stand(self.box, theta, pull, self.rows, cold, self.found):
            self.theta = math.nan
        return self.theta == theta

    def begin(self) -> None:
        self._before = self.theta
        for spare, seen in zip(self._spare, self._seen, strict=True):
            np.copyto(spare, seen)

    def undo(self) -> None:
        self.theta = self._before
        for spare, seen in zip(self._spare, self._seen, strict=True):
            np.copyto(seen, spare)

    def copy(self) -> Self:
        other = copy.copy(self)
        drive = self._drive
        moved = {name: getattr(drive, name).copy() for name in ("shift_x", "shift_y", "turn")}
        other._drive = drive._replace(**moved)
        other.rows, other.found = self.rows.copy(), self.found.copy()
        other._make(type(self.work)(*(array.copy() for array in self.work)))
        return other

    def state(self) -> dict[str, Any]:
        kept = [base64.b64encode(seen.tobytes()).decode() for seen in self._seen]
        return {"theta": None if math.isnan(self.theta) else self.theta, "kept": kept}

    def restore(self, state: dict[str, Any]) -> None:
        self.theta = math.nan if state["theta"] is None else state["theta"]
        for seen, kept in zip(self._seen, state["kept"], strict=True):
            seen[...] = np.frombuffer(base64.b64decode(kept), seen.dtype).reshape(seen.shape)


class SupportedTeeth:
    """Gear, pins and bearings at a crank angle θ (rad), with the methods and units of `mesh.ContactTeeth`.

    Below the share `PLAY_LOAD` of the rated torque, the output follows the tangent at that share, so that the play
    remains at zero torque (`supports.transmission.play_loads`). `press` solves every torque; inside the play, torques
    are smaller than that.

    Parameters
    ----------
    pair, surface
        The pair with its supports and a rated torque, and its errors.
    slices
        Number of slices across the face width.

    Raises
    ------
    edge.InputError
        If the pair has no rated torque.
    """

    def __init__(self, drive: DriveValue, slices: int) -> None:
        pair = drive.pair
        self._load = play_loads(pair)[1]
        self._ratio = pair.ratio
        self._main = _Stand(drive, slices)
        self._ends = {-1.0: self._main.copy(), 1.0: self._main.copy()}
        self._side, self._share = 0.0, 1.0  # side (±1) of the tangent in use, 0 for none; fraction of its torque
        self._pin_force, self._pin_pressure = (np.zeros((pair.discs, pair.pins)) for _ in range(2))
        self._before = self._side, self._share

    @property
    def _now(self) -> _Stand:
        return self._main if self._side == 0.0 else self._ends[self._side]

    def _end(self, theta: float, side: float) -> tuple[float, float]:
        """End of the play on a side (±1), rad, and the stiffness there, N·m/rad."""
        stand = self._ends[side]
        if stand.theta != theta and not stand.solve(theta, side * self._load):
            raise StepError(f"flange_b.tau = {side * self._load:g} N.m: no contacts of this drive can balance it")
        stiffness = float(stand.found[energy.STIFFNESS])
        return float(stand.found[energy.X]) - side * self._load / stiffness, stiffness

    def play(self, theta: float, x: float) -> tuple[float, float, float]:
        """Return both ends of the free rotation (rad), and a number that is above 0 if there is no free rotation."""
        low, high = self._end(theta, -1.0)[0], self._end(theta, 1.0)[0]
        middle = 0.5 * (low + high)
        return (low, high, 0.0) if low < high else (middle, middle, math.ulp(1.0))

    def touch_rate(self, theta: float, x: float, side: float) -> float:
        """Return dφ_b/dθ (dimensionless) at the end of the play on a side (±1); NaN for side 0."""
        if side == 0.0:
            return math.nan
        before, after = (self._end(theta + step, side)[0] for step in (-_CRANK_STEP, _CRANK_STEP))
        return 1.0 / self._ratio + (after - before) / (2.0 * _CRANK_STEP)

    def equilibrium(self, theta: float, torque: float, x: float) -> tuple[float, float]:
        """Return deviation (rad) and stiffness (N·m/rad) under a torque (N·m), which is 0 only without play."""
        self._side, self._share = 0.0, 1.0
        if abs(torque) >= self._load:
            if not self._main.solve(theta, torque):
                raise StepError(f"flange_b.tau = {torque:g} N.m: no contacts of this drive can balance it")
            return self._solved()
        return self._tangent(theta, torque, math.copysign(1.0, torque))

    def _tangent(self, theta: float, torque: float, side: float) -> tuple[float, float]:
        low, high, _ = self.play(theta, 0.0)
        _, stiffness = self._end(theta, side)
        self._side, self._share = side, abs(torque) / self._load
        return (high if side > 0.0 else low) + torque / stiffness, stiffness

    def _solved(self) -> tuple[float, float]:
        return float(self._main.found[energy.X]), float(self._main.found[energy.STIFFNESS])

    def behind(self, theta: float, flange: float, compliance: float, x: float) -> tuple[float, float]:
        """Return deviation and stiffness of the teeth for a flange at a deviation behind a compliance, rad/(N·m)."""
        low, high, interference = self.play(theta, x)
        side = 1.0 if flange > 0.5 * (low + high) else -1.0
        if interference == 0.0 and low <= flange <= high:
            self._side, self._share = side, 0.0
            return flange, 0.0
        end, stiffness = high if side > 0.0 else low, self._end(theta, side)[1]
        torque = (flange - end) / (1.0 / stiffness + compliance)
        if abs(torque) < self._load:
            return self._tangent(theta, torque, side)
        self._press(theta, flange, compliance, False)
        return self._solved()

    def _press(self, theta: float, flange: float, compliance: float, pressed: bool) -> None:
        self._side, self._share = 0.0, 1.0
        spring = min(1.0 / compliance, _STIFFEST) if compliance > 0.0 else _STIFFEST
        if not self._main.solve(theta, 0.0, spring, flange, pressed):
            raise StepError("the contacts could not be solved at these flange angles")

    def press(
        self, theta: float, flange: float, compliance: float, x: float
    ) -> tuple[float, float, float, float, float]:
        """Return the same as `behind`, and the stored energy (J) with its derivatives by θ and φ_b (N·m)."""
        self._press(theta, flange, compliance, True)
        found = self._main.found.tolist()
        return (
            found[energy.X],
            found[energy.STIFFNESS],
            found[energy.ENERGY],
            found[energy.BY_ANGLE],
            found[energy.BY_FLANGE],
        )

    def crank_side(self, theta: float, x: float) -> tuple[float, float]:
        """Return the torque required at the crank (N·m), and dφ_b/dθ at constant torque (dimensionless)."""
        found = self._now.found
        rate = float(found[energy.RATE])
        if self._side == 0.0:
            return float(found[energy.CRANK_TORQUE]), rate
        torque, end = self.torque, self.touch_rate(theta, x, self._side)
        bent = self._share * (rate - end)
        return -torque * (end + 0.5 * bent), end + bent

    @property
    def torque(self) -> float:
        """Torque on the carrier, N·m."""
        return self._share * float(self._now.found[energy.TORQUE])

    def sharing(self) -> tuple[int, float]:
        """Return the number of pins in contact, and the largest pressure (Pa)."""
        now = self._now
        count, pressure = energy.shared(now.box, now.rows, self._pin_force, self._pin_pressure)
        # Along the tangent, forces are proportional to the torque and pressures to its square root.
        self._pin_force *= self._share
        self._pin_pressure *= math.sqrt(self._share)
        return count, pressure * math.sqrt(self._share)

    def pin_force(self) -> list[float]:
        """Return the force on each pin, disc by disc, N; valid after `sharing`."""
        return self._pin_force.ravel().tolist()

    def pin_pressure(self) -> list[float]:
        """Return the largest pressure on each pin, disc by disc, Pa; valid after `sharing`."""
        return self._pin_pressure.ravel().tolist()

    @property
    def _stands(self) -> tuple[_Stand, ...]:
        return self._main, self._ends[-1.0], self._ends[1.0]

    def begin(self) -> None:
        """Save the state for `undo`."""
        self._before = self._side, self._share
        for stand in self._stands:
            stand.begin()

    def undo(self) -> None:
        """Restore the state saved by `begin`."""
        self._side, self._share = self._before
        for stand in self._stands:
            stand.undo()

    def copy(self) -> Self:
        """Return an independent copy."""
        other = copy.copy(self)
        other._main, other._ends = self._main.copy(), {side: stand.copy() for side, stand in self._ends.items()}
        other._pin_force, other._pin_pressure = self._pin_force.copy(), self._pin_pressure.copy()
        return other

    def state(self) -> dict[str, Any]:
        """Return the state as plain values."""
        pins = [self._pin_force.tolist(), self._pin_pressure.tolist()]
        return {"stands": [s.state() for s in self._stands], "tangent": [self._side, self._share], "pins": pins}

    def restore(self, state: dict[str, Any]) -> None:
        """Restore a state returned by `state`."""
        self._side, self._share = state["tangent"]
        self._pin_force[...], self._pin_pressure[...] = state["pins"]
        for stand, kept in zip(self._stands, state["stands"], strict=True):
            stand.restore(kept)
