"""The whole RV reducer as a system model sees it: the drive with an involute stage before it and its crank bearings.

The sun turns the planets, these the cranks, and the cycloid gears turn the carrier, on which the planets sit: so the
crank angle is θ = a φ_b - b (φ_a + δ) with b = z_1/z_2, a = 1 + b and δ the sun's place within its play, and depends
on the output that it moves. With s = 1/(1 + a/z_c) the output deviates by φ_b - φ_a/i = δ/i + s (x(θ) - β) from the
ideal reducer, x the gear's deviation at its own torque and β the carrier's place in the crank bearings. Virtual work
gives the torques: T = M + a τ at the output and -b τ at the sun, M at the gear and τ at the crank.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from cycloid_fmu.fmu.constants import STAGE_DIFFERENCE, STAGE_ITERATIONS, STAGE_SHARE, STAGE_STEP
from cycloid_fmu.fmu.model import DriveModel, DriveState
from cycloid_fmu.fmu.stepped_model import state_fields
from cycloid_fmu.fmu.variables import LOSSLESS
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.reducer.first_stage import FirstStage, sun_locked_share
from cycloid_fmu.surfaces.surface import ErrorSurface


@state_fields
class ReducerState(DriveState):
    """State of a whole reducer; `crank_angle` and `crank_speed` are the sun's."""

    _torque_rate: float | None = None  # of the crank's torque with its angle, N·m/rad


class ReducerModel(DriveModel, ReducerState):
    """An RV reducer with history; `crank_angle` and `crank_torque` are the sun's.

    Parameters
    ----------
    pair, surface
        The cycloid stage and its errors; its output is the gear.
    first_stage
        Teeth and plays around it.
    losses
        As of `DriveModel`, at the sun.
    """

    def __init__(
        self,
        pair: Pair,
        surface: ErrorSurface,
        first_stage: FirstStage,
        losses: Sequence[Sequence[float]] = LOSSLESS,
    ) -> None:
        super().__init__(pair, surface, losses)
        self._a, self._b = first_stage.crank_share, first_stage.sun_share
        self._s = sun_locked_share(self._a, pair.gear_teeth)
        self._ratio = pair.gear_teeth / (self._b * self._s)
        self._lever = -self._b
        self._stage = first_stage
        self._settle_friction(self._rated())

    @property
    def _sun_play(self) -> float:
        return self._stage.sun_play if self.backlash_on else 0.0

    @property
    def _outer(self) -> float:
        """Half of what the sun's and the bearings' play are at the output, rad."""
        return 0.5 * (self._sun_play / self._ratio + self._s * self._stage.bearing_play) if self.backlash_on else 0.0

    def _turn_crank(self, deviation: float, side: float) -> None:
        """Put the crank where the sun and an output that deviates so have it, the sun's play on the given side."""
        turns = self.crank_angle / (2.0 * math.pi * self._ratio)
        reduced = 2.0 * math.pi * self._ratio * (turns - math.floor(turns))
        self._theta = (
            -reduced * self.pair.gear_teeth / self._ratio + self._a * deviation - 0.5 * self._b * side * self._sun_play
        )
        self._forget()

    def _forget(self) -> None:
        super()._forget()
        self._torque_rate = None

    def _elastic(self, torque: float, end: float) -> float:
        side = math.copysign(1.0, torque) if torque != 0.0 else end
        deviation = side * self._outer + self._s * (self._x - self._shift(side))
        crank_torque = (1.0 - self._s) / self._a * torque
        for _ in range(STAGE_ITERATIONS):
            self._turn_crank(deviation, side)
            super()._elastic(0.0 if torque == 0.0 else torque - self._a * crank_torque, end)
            following = side * self._outer + self._s * (self._x - self._shift(side))
            before = crank_torque
            if self._stiffness > 0.0:
                crank_torque, _ = self._pressed(self._theta, self._x)
            moved, deviation = abs(following - deviation), following
            if moved < STAGE_STEP and abs(crank_torque - before) <= STAGE_SHARE * abs(torque):
                break
        return deviation + self.series_compliance * torque

    def _hold(self, deviation: float) -> None:
        self._turn_crank(deviation, 0.0)
        low, high, interference = self._solve_play()
        if interference > 0.0:
            self._x, _ = self._teeth.equilibrium(self._theta, 1e-9, self._x)
            low = high = self._x
        elif not self.backlash_on:
            low = high = 0.5 * (low + high)
        side = 1.0 if deviation > self._s * high else -1.0
        beyond = abs(deviation - self._s * (high if side > 0.0 else low)) - self._outer
        if self._s * low <= deviation <= self._s * high or beyond <= 0.0:
            self._x = min(max(deviation / self._s, low), high)
            self._stiffness = 0.0
            return
        self._turn_crank(deviation, side)
        self._side = side
        flange = (deviation - side * self._outer) / self._s + self._shift(side)
        compliance = self.series_compliance / self._s**2
        self._x, self._stiffness = self._teeth.behind(self._theta, flange, compliance, self._x)

    def _crank_torque_rate(self) -> float:
        """Change of the crank's torque with its angle at constant torque on the gear, N·m/rad."""
        if self._torque_rate is None:
            gear_torque, teeth, found = self._teeth.torque, self._teeth.copy(), []
            for step in (-STAGE_DIFFERENCE, STAGE_DIFFERENCE):
                theta = self._theta + step
                x, _ = teeth.equilibrium(theta, gear_torque, self._x)
                found.append(self._pressed(theta, x, teeth)[0])
            self._torque_rate = (found[1] - found[0]) / (2.0 * STAGE_DIFFERENCE)
        return self._torque_rate

    @property
    def output_speed(self) -> float:
        """dφ_b/dt at the present torque, rad/s; 0 while friction or play hold the output."""
        if self.crank_speed == 0.0 or self._pushed == 0.0:
            self._settle()
            return 0.0
        rate = self._crank_side()[1]
        if math.isnan(rate):
            return 0.0
        if self._stiffness > 0.0:
            # The gear's torque changes with the crank's: ∂τ/∂M = -∂φ/∂θ (Maxwell).
            rate -= self._a * self._crank_torque_rate() / ((1.0 - self._a * rate) * self._stiffness)
        rate *= -self._b / (1.0 - self._a * rate)
        return self.crank_speed * rate * self._yielding(rate)

    @property
    def torsional_stiffness(self) -> float:
        """Stiffness at the flange with the sun locked, the compliance in series included, N·m/rad."""
        self._settle()
        if self._stiffness <= 0.0:
            return 0.0
        turned = 1.0 - self._a * self._crank_side()[1]
        stiffness = self._stiffness * turned**2 + self._a**2 * self._crank_torque_rate()
        return 1.0 / (1.0 / stiffness + self.series_compliance)

    @property
    def backlash(self) -> float:
        """Free rotation of the output with the sun locked, rad; that of the outer stages where the gears have none."""
        self._settle()
        if not self.backlash_on:
            return 0.0
        ends = []
        for side in (-1.0, 1.0):
            x = self._x
            for _ in range(STAGE_ITERATIONS):
                theta = self._theta + self._a * (side * self._outer + self._s * (x - self._x))
                low, high, interference = self._teeth.play(theta, x)
                if interference > 0.0:
                    return 2.0 * self._outer
                moved, x = abs((low if side < 0.0 else high) - x), low if side < 0.0 else high
                if moved < STAGE_STEP:
                    break
            ends.append(x)
        return 2.0 * self._outer + self._s * (ends[1] - ends[0])
