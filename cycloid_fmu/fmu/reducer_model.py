"""The whole RV reducer in a system model: the drive with an involute stage before it and its crank bearings.

The sun turns the planets, the planets the cranks, and the cycloid discs turn the carrier, in which the planets are
mounted: so the crank angle is θ = a φ_b - b (φ_a + δ) with b = z_1/z_2, a = 1 + b and δ the sun's position within its
play, and depends on the output angle that it causes. With s = 1/(1 + a/z_c) the output deviates by φ_b - φ_a/i = δ/i +
s (x(θ) - β) from the ideal reducer, with x the gear's deviation at its own torque and β the carrier's position in the
crank bearings. Virtual work gives the torques: T = M + a τ at the output and -b τ at the sun, with M at the gear and τ
at the crank.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.compliant_model import CompliantModel, Place
from cycloid_fmu.fmu.constants import STAGE_DIFFERENCE, STAGE_ITERATIONS, STAGE_SHARE, STAGE_STEP
from cycloid_fmu.fmu.model import DriveModel, DriveState
from cycloid_fmu.fmu.stepped_model import SteppedModel, state_fields
from cycloid_fmu.fmu.variables import LOSSLESS
from cycloid_fmu.geometry.first_stage import FirstStage, sun_locked_share

_FREE = 1e-7  # J: largest stored energy of gears that are free in the plays around them


class _Staged(SteppedModel):
    """A drive behind a first stage; `crank_angle` is the sun's."""

    _stage: FirstStage

    def _stand_behind(self, first_stage: FirstStage | None) -> None:
        assert first_stage is not None
        self._stage = first_stage
        self._a, self._b = first_stage.crank_share, first_stage.sun_share
        self._s = sun_locked_share(self._a, self.pair.gear_teeth)
        self._ratio = self.pair.gear_teeth / (self._b * self._s)
        self._period = 2.0 * math.pi * self._ratio
        self._settle_friction(self._rated())

    @property
    def _sun_play(self) -> float:
        return self._stage.sun_play if self.backlash_on else 0.0

    @property
    def _outer(self) -> float:
        """Half of the play of sun and bearings, referred to the output, rad."""
        return 0.5 * (self._sun_play / self._ratio + self._s * self._stage.bearing_play) if self.backlash_on else 0.0

    def _crank_at(self, sun: float, deviation: float, side: float) -> float:
        """Crank angle (rad) for a reduced sun angle and an output deviation, with the sun's play on a side (±1)."""
        ideal = -sun * self.pair.gear_teeth / self._ratio
        return ideal + self._a * deviation - 0.5 * self._b * side * self._sun_play

    @property
    def backlash(self) -> float:
        """Free rotation of the output with the sun locked, rad; without play in the gears, that of the other stages."""
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


@state_fields
class ReducerState(DriveState):
    """State of a whole reducer; `crank_angle` and `crank_speed` are the sun's."""

    _torque_rate: float | None = None  # derivative of the crank's torque by its angle, N·m/rad


class ReducerModel(_Staged, DriveModel, ReducerState):
    """An RV reducer with history; `crank_angle` and `crank_torque` are the sun's.

    Parameters
    ----------
    pair, surface
        The cycloid stage and its errors; its output is the gear.
    first_stage
        The first stage: its teeth and the plays around the cycloid stage.
    losses
        As for `DriveModel`, at the sun.
    """

    def __init__(
        self,
        drive: DriveValue,
        losses: Sequence[Sequence[float]] = LOSSLESS,
    ) -> None:
        first_stage = drive.first_stage
        super().__init__(drive.stage, losses)
        self._stand_behind(first_stage)
        self._lever = -self._b

    def _turn_crank(self, deviation: float, side: float) -> None:
        """Set the crank angle for the sun and an output deviation (rad), with the sun's play on the given side (±1)."""
        self._theta = self._crank_at(self._reduced(self.crank_angle), deviation, side)
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
        """Derivative of the crank's torque by its angle at constant torque on the gear, N·m/rad."""
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
        """Output speed dφ_b/dt at the present torque, rad/s; 0 while friction or play holds the output."""
        if self.crank_speed == 0.0 or self._pushed == 0.0:
            self._settle()
            return 0.0
        rate = self._crank_side()[1]
        if math.isnan(rate):
            return 0.0
        if self._stiffness > 0.0:
            # The gear's torque changes with the crank's: ∂τ/∂M = -∂φ/∂θ (Maxwell's reciprocity).
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


class CompliantReducer(_Staged, CompliantModel):
    """An RV reducer between two flanges, those of the sun and of the output.

    The reducer's energy is the cycloid stage's energy E(θ, φ) under a linear change of coordinates, and the torques are
    its derivatives. Within the plays the massless crank takes the position of least energy: at an end of them, or where
    nothing is pressed.

    Parameters
    ----------
    pair, surface, losses, output_inertia, crank_inertia
        As for `CompliantModel`; losses and inertia at the sun.
    first_stage
        The first stage: its teeth and the plays around the cycloid stage.
    """

    def __init__(
        self,
        drive: DriveValue,
        losses: Sequence[Sequence[float]] = LOSSLESS,
        output_inertia: float = 0.0,
        crank_inertia: float = 0.0,
    ) -> None:
        pair, first_stage = drive.pair, drive.first_stage
        super().__init__(drive.stage, losses, output_inertia, crank_inertia)
        self._stand_behind(first_stage)
        self._geared = pair.gear_teeth / self._ratio

    def _still(self) -> DriveModel:
        return ReducerModel(DriveValue(self.pair, self.surface, self._stage))

    def _gear_compliance(self) -> float:
        return self.series_compliance / self._s**2

    def _contact(self, theta: float, deviation: float) -> tuple[float, float, float]:
        """Energy of contacts and series compliance (J), with its derivatives by sun and output angle (N·m)."""
        self._check_deviation(deviation)
        first = 1.0 if deviation >= 0.0 else -1.0
        found = self._within_plays(theta, deviation, first if self.backlash_on else 0.0)
        if not self.backlash_on or self._outer == 0.0 or first * found[3] < 0.0:
            return found[:3]
        other = self._within_plays(theta, deviation, -first)
        if -first * other[3] < 0.0:
            return other[:3]
        if min(found[0], other[0]) <= _FREE:
            return (other if other[0] <= found[0] else self._within_plays(theta, deviation, first))[:3]
        # Pressed gears between free plays: the position of least energy.
        ends = [(-first, other[3]), (first, found[3])]
        for _ in range(STAGE_ITERATIONS):
            (a, rate_a), (b, rate_b) = ends
            at = min(max((a * rate_b - b * rate_a) / (rate_b - rate_a), min(a, b)), max(a, b))
            found = self._within_plays(theta, deviation, at)
            if abs(found[3]) <= STAGE_SHARE * abs(rate_b) or abs(b - a) < STAGE_SHARE:
                break
            keeps = (found[3] > 0.0) == (rate_a > 0.0)
            ends = [(at, found[3]), (b, 0.5 * rate_b)] if keeps else [(at, found[3]), (a, 0.5 * rate_a)]
        return found[:3]

    def _within_plays(self, sun: float, deviation: float, side: float) -> tuple[float, float, float, float]:
        """As `_contact` with the plays at a fraction of their range (-1 to 1), and the derivative by that fraction."""
        # Numbers without names as it runs thousands of times in a step.
        teeth, outer = self.pair.gear_teeth, self._outer
        theta = self._crank_at(sun, deviation, side)
        energy, by_angle, gear = super()._contact(theta, (deviation - side * outer) / self._s)
        by_crank = by_angle - gear / teeth  # at the same deviation of the gear
        by_output = gear / self._s + self._a * by_crank
        by_side = -0.5 * self._b * self._sun_play * by_crank - outer / self._s * gear
        return energy, -self._b * by_angle, by_output, by_side

    def _pressed(self, crank_angle: float, deviation: float) -> Place:
        at = super()._pressed(crank_angle, deviation)
        return at._replace(stiffness=at.stiffness / self._s**2)

    @property
    def torsional_stiffness(self) -> float:
        """Stiffness at the flange with the sun locked, the compliance in series included, N·m/rad."""
        self._settle()
        if self._stiffness <= 0.0:
            return 0.0
        rate = self._teeth.crank_side(self._theta, self._x)[1]
        stiffness = self._stiffness * (1.0 if math.isnan(rate) else 1.0 - self._a * rate) ** 2
        return 1.0 / (1.0 / stiffness + self.series_compliance)
