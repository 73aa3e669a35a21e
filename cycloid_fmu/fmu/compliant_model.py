"""The drive between two flanges whose motion comes from outside: angles and speeds in, torques out.

Contacts, series compliance and friction store one energy E(θ, φ_b) whose derivatives are the torques, so nothing is
gained over a closed cycle; damping, losses and sliding friction only take. Between communication points the flanges
move on at their speeds: the torques at the end of a step are not a step late. With an inertia on the output inside,
its motion is solved here, in sub-steps that keep the energy's balance (a discrete gradient: O. Gonzalez, Time
integration and discrete Hamiltonian systems, J. Nonlinear Sci. 6, 1996, in one dimension).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from cycloid_fmu.fmu.constants import (
    CRANK_STEP,
    DEVIATION_STEP,
    FRICTION_DISPLACEMENT,
    LARGEST_TRANSMISSION_ERROR,
    LAST_CHANGE,
    LAST_SHARE,
    MOST_ITERATIONS,
    MOST_PARTS,
    MOST_SUB_STEPS,
    SAME_PLACE,
    STEP_TOLERANCE,
    SUB_STEP,
)
from cycloid_fmu.fmu.losses import loss_torque
from cycloid_fmu.fmu.mesh import StepError
from cycloid_fmu.fmu.model import DriveModel
from cycloid_fmu.fmu.stepped_model import State, SteppedModel, state_fields
from cycloid_fmu.fmu.variables import LARGEST_STEP, LOSSLESS
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.surface import ErrorSurface

_NO_LOSSES = [list(row) for row in LOSSLESS]  # a longer table that takes nothing is walked through in vain
# What a quasi-static drive at the same place has of the state.
_SHARED = (
    "errors", "pin_arrays", "_crank_turns_worn", "crank_angle", "crank_speed", "series_compliance", "backlash_on",
)  # fmt: skip


@state_fields
class CompliantState(State):
    """State of a drive between two flanges.

    Attributes
    ----------
    output_angle, output_speed
        Of the output, rad and rad/s: inputs, but with an output inertia its state.
    mesh_damping
        Damping of the contacts at the output, N·m·s/rad. Its torque is at most the contacts' own (as in Modelica's
        `ElastoBacklash2`): it acts in contact only and never pulls.
    output_inertia
        Moment of inertia on the output inside, kg·m²; 0 where there is none.
    largest_step
        Communication step above which `advance` refuses, s.
    dissipated_energy
        J since the start.
    """

    output_angle: float = 0.0
    output_speed: float = 0.0
    mesh_damping: float = 0.0
    output_inertia: float = 0.0
    largest_step: float = LARGEST_STEP
    dissipated_energy: float = 0.0
    _load_torque: float = 0.0  # on the inertia, N·m
    _bristle: float = 0.0  # how far friction is strained, rad
    _seen: float = 0.0  # the output angle that friction has followed to, rad
    _solved_at: Sequence[float] = ()
    _solved: Sequence[float] = ()


class CompliantModel(SteppedModel, CompliantState):
    """A cycloid-pin drive between two flanges, stepped by `advance`.

    `friction_torque` is that of an elastic-plastic element that slides beyond `FRICTION_DISPLACEMENT`.

    Parameters
    ----------
    pair, surface, losses
        As of `SteppedModel`.
    output_inertia
        As of `CompliantState`.
    """

    def __init__(
        self,
        pair: Pair,
        surface: ErrorSurface,
        losses: Sequence[Sequence[float]] = LOSSLESS,
        output_inertia: float = 0.0,
    ) -> None:
        super().__init__(pair, surface, losses)
        self._held, self.output_inertia = output_inertia == 0.0, output_inertia

    def _rebuild(self) -> None:
        super()._rebuild()
        self._solved_at = self._solved = ()
        self._stiffest = 0.0

    def _contact(self, theta: float, deviation: float) -> tuple[float, float, float]:
        """Energy of contacts and series compliance, with its derivatives by crank and output angle."""
        flange, rate = deviation, 0.0
        if not -LARGEST_TRANSMISSION_ERROR < deviation < LARGEST_TRANSMISSION_ERROR:
            raise StepError(
                f"flange_b.phi is {deviation:g} rad from flange_a.phi/ratio: it must stay within "
                f"{LARGEST_TRANSMISSION_ERROR:g} rad"
            )
        self._play = self._crank = self._sharing = None
        self._theta = theta
        if not self.backlash_on:
            low, high, interference = self._solve_play()
            if interference == 0.0:
                self._side = 1.0 if deviation >= 0.5 * (low + high) else -1.0
                flange += self._shift(self._side)
                rate = self._shift_rate(self._side, self._teeth, theta)
        self._x, self._stiffness, energy, by_angle, by_rotation = self._teeth.press(
            theta, flange, self.series_compliance, self._x
        )
        return energy, by_angle + rate * by_rotation, by_rotation

    def _damping(self, elastic: float, speed: float) -> float:
        """Torque of the contacts' damping at the output, N·m."""
        return math.copysign(min(self.mesh_damping * abs(speed), abs(elastic)), speed)

    def _rub(self, way: float) -> tuple[float, float]:
        """Move the friction's bristle by a way of the output: work done on it and what of it is lost, J."""
        if self.friction_torque == 0.0:  # where it acts anew it begins unstrained, without energy
            self._bristle = 0.0
            return 0.0, 0.0
        before = self._bristle
        self._bristle = min(max(before + way, -FRICTION_DISPLACEMENT), FRICTION_DISPLACEMENT)
        lost = self.friction_torque * abs(before + way - self._bristle)
        stored = 0.5 * self.friction_torque / FRICTION_DISPLACEMENT * (self._bristle**2 - before**2)
        return stored + lost, lost

    def _strained(self) -> float:
        """How far friction is strained at the present output angle, rad; more than it can be while it slides."""
        return self._bristle + (self.output_angle - self._seen)

    def _solve(self) -> Sequence[float]:
        """Energy, torques at a (without losses) and b, and damping at the flanges' present place."""
        crank, crank_speed, output, speed = self.crank_angle, self.crank_speed, self.output_angle, self.output_speed
        at = [
            crank, crank_speed, output, speed, self._bristle, self._seen, self.friction_torque, self.series_compliance,
            self.mesh_damping, self.backlash_on,
        ]  # fmt: skip
        if at != self._solved_at:
            energy, by_angle, by_rotation = self._contact(self._reduced(crank), output - crank / self._ratio)
            torque, transmitted, damping = by_rotation, by_angle, 0.0
            if self.mesh_damping > 0.0:
                damping = self._damping(by_rotation, speed - crank_speed / self._ratio)
                torque += damping
                transmitted -= damping / self._ratio
            if self.friction_torque > 0.0:
                strain = min(max(self._strained() / FRICTION_DISPLACEMENT, -1.0), 1.0)
                energy += 0.5 * self.friction_torque * FRICTION_DISPLACEMENT * strain**2
                torque += self.friction_torque * strain
            self._solved_at, self._solved = at, [energy, transmitted, torque, damping]
        return self._solved

    def _lost(self, transmitted: float) -> float:
        """Torque that losses add at flange_a, N·m: not kept, for their table is set cell by cell."""
        return 0.0 if self.loss_table == _NO_LOSSES else loss_torque(self.loss_table, self.crank_speed, transmitted)

    def forget_history(self) -> None:
        """Make the next step start without history: friction unstrained and, with an inertia, at rest on the load."""
        self._bristle = self.dissipated_energy = 0.0
        if not self._held:
            still = DriveModel(self.pair, self.surface)
            shared = {name: getattr(self, name) for name in _SHARED}
            still.restore({**still.state(), **shared, "torque": self._load_torque})
            still.advance()
            self.output_angle, self.output_speed = still.output_angle, still.output_speed
            for _ in range(5 if self._load_torque != 0.0 else 0):
                # The energy's torque and that of the quasi-static balance differ a little (`contact.elastic_energy`).
                torque = self._contact(self._reduced(self.crank_angle), self.transmission_error)[2]
                self.output_angle += (self._load_torque - torque) * (1.0 / self._stiffness + self.series_compliance)
        self._seen = self.output_angle

    def _move(self, step: float) -> None:
        """Move the flanges on for a step, from the inputs' values at its start."""
        if step > self.largest_step * (1.0 + STEP_TOLERANCE):
            raise StepError(f"a step of {step:g} s: largest_step is {self.largest_step:g} s")
        if self._held:
            self._follow(step)
        else:
            self._swing(step)
        self._solve()

    def _follow(self, step: float) -> None:
        """Both flanges move at their speeds."""
        way, crank_way = self.output_speed * step, self.crank_speed * step
        rubbing, count, power = self.friction_torque > 0.0 or self._bristle != 0.0, 1, 0.0
        if rubbing:
            self.dissipated_energy += self._rub(self.output_angle - self._seen)[1]
            self._seen = self.output_angle
        losing = self.mesh_damping > 0.0 or self.loss_table != _NO_LOSSES
        if losing:
            parts = max(abs(crank_way) / CRANK_STEP, abs(way - crank_way / self._ratio) / DEVIATION_STEP)
            count = min(max(math.ceil(parts), 1), MOST_PARTS)
            power = self._power()
        if rubbing:
            self.dissipated_energy += self._rub(way)[1]
        crank, output = self.crank_angle, self.output_angle
        for i in range(1, count + 1):
            self._seen = self.output_angle = output + way * i / count
            self.crank_angle = crank + crank_way * i / count
            if losing:
                following = self._power()
                self.dissipated_energy += 0.5 * (power + following) * step / count
                power = following

    def _power(self) -> float:
        """Power of damping and losses, W."""
        _, transmitted, _, damping = self._solve()
        return self._lost(transmitted) * self.crank_speed + damping * (
            self.output_speed - self.crank_speed / self._ratio
        )

    def _sub_steps(self, step: float) -> int:
        if self._stiffest == 0.0:
            rated = self.pair.rated_torque or 100.0
            _, self._stiffest = self._made_teeth().equilibrium(0.0, rated, 0.0)
        stiffness = 1.0 / (1.0 / self._stiffest + self.series_compliance)
        stiffness += self.friction_torque / FRICTION_DISPLACEMENT
        count = max(1, math.ceil(step * math.sqrt(stiffness / self.output_inertia) / SUB_STEP))
        if count > MOST_SUB_STEPS:
            raise StepError(
                f"output_inertia = {self.output_inertia:g} kg.m2: so small a one swings {count} sub-steps in a step of "
                f"{step:g} s, and at most {MOST_SUB_STEPS} are made"
            )
        return count

    def _swing(self, step: float) -> None:
        """The output's inertia moves under load, contacts and friction while the crank turns at its speed."""
        count = self._sub_steps(step)
        part, crank = step / count, self.crank_angle
        for i in range(count if step > 0.0 else 0):
            self.crank_angle = crank + self.crank_speed * step * (i + 0.5) / count
            self._sub_step(part)
        self.crank_angle = crank + self.crank_speed * step

    def _sub_step(self, part: float) -> None:
        theta, ideal = self._reduced(self.crank_angle), self.crank_angle / self._ratio
        start, speed, bristle = self.output_angle, self.output_speed, self._bristle
        turning = self.crank_speed / self._ratio
        energy, crank_torque, elastic = self._contact(theta, start - ideal)
        stiffness, inertia = self._stiffness, self.output_inertia
        way = part * speed + 0.5 * part**2 / inertia * (self._load_torque - elastic)
        lost = damping = 0.0
        for _ in range(MOST_ITERATIONS):
            following, crank_torque, at_end = self._contact(theta, start + way - ideal)
            mean = (following - energy) / way if abs(way) > SAME_PLACE else 0.5 * (elastic + at_end)
            damping = self._damping(mean, way / part - turning)
            self._bristle = bristle
            work, lost = self._rub(way)
            friction = work / way if abs(way) > SAME_PLACE else self.friction_torque * bristle / FRICTION_DISPLACEMENT
            short = self._load_torque - mean - damping - friction - 2.0 * inertia * (way - part * speed) / part**2
            stiff = 0.5 * max(stiffness, self._stiffness) + self.mesh_damping / part
            change = short / (2.0 * inertia / part**2 + stiff)
            if abs(change) <= LAST_CHANGE + LAST_SHARE * abs(way):
                break
            way += change
        self._seen = self.output_angle = start + way
        self.output_speed = 2.0 * way / part - speed
        crank_loss = self._lost(crank_torque - damping / self._ratio)
        self.dissipated_energy += lost + damping * (way - turning * part) + crank_loss * self.crank_speed * part

    @property
    def crank_torque(self) -> float:
        """Torque into the drive at the crank, N·m."""
        transmitted = self._solve()[1]
        return transmitted + self._lost(transmitted)

    @property
    def torque(self) -> float:
        """Torque into the drive at the output, N·m; with an output inertia the load on that."""
        if not self._held:
            return self._load_torque
        return self._solve()[2]

    @torque.setter
    def torque(self, value: float) -> None:
        self._load_torque = value

    @property
    def transmission_error(self) -> float:
        """φ_b - φ_a/ratio, rad."""
        return self.output_angle - self.crank_angle / self._ratio

    @property
    def elastic_energy(self) -> float:
        """Energy stored in contacts, series compliance and friction, J."""
        return self._solve()[0]

    @property
    def power_loss(self) -> float:
        """Power of damping, losses and sliding friction, W."""
        sliding = abs(self._strained()) >= FRICTION_DISPLACEMENT
        return self._power() + (self.friction_torque * abs(self.output_speed) if sliding else 0.0)

    def _settle(self) -> float:
        self._solve()
        return self.output_angle
