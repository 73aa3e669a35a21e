"""The drive between two flanges with prescribed motion: angles and speeds in, torques out.

Contacts, series compliance and friction store one energy E(θ, φ_b) whose derivatives are the torques, so a closed cycle
gains no energy; damping, losses and sliding friction only dissipate. Between communication points the flanges continue
at their speeds, so that the torques at the end of a step are not a step late. The motion of internal inertias is solved
here, in sub-steps that conserve the energy balance (a discrete gradient: O. Gonzalez, Time integration and discrete
Hamiltonian systems, J. Nonlinear Sci. 6, 1996).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.constants import (
    CRANK_STEP,
    DEVIATION_STEP,
    FRICTION_ELEMENTS,
    LARGEST_LOAD,
    LARGEST_TRANSMISSION_ERROR,
    LAST_CHANGE,
    LAST_SHARE,
    MESH_STEP,
    MOST_DOUBLED,
    MOST_ITERATIONS,
    MOST_PARTS,
    MOST_SUB_STEPS,
    SAME_PLACE,
    STEP_TOLERANCE,
    SUB_STEP,
    SUGGESTED_STEP,
)
from cycloid_fmu.fmu.friction import UNSTRAINED, Pressed, Slid
from cycloid_fmu.fmu.mesh import StepError
from cycloid_fmu.fmu.model import DriveModel
from cycloid_fmu.fmu.stepped_model import State, SteppedModel, state_fields
from cycloid_fmu.fmu.variables import LARGEST_STEP, LOSSLESS

# Fields of the state that are copied to a quasi-static drive at the same position.
_SHARED = (
    "errors",
    "pin_arrays",
    "crank_angle",
    "crank_speed",
    "series_compliance",
    "backlash_on",
)


_FREE = Slid(list(UNSTRAINED), 0.0, 0.0, 0.0, 0.0)


@state_fields
class CompliantState(State):
    """State of a drive between two flanges.

    Attributes
    ----------
    output_angle, output_speed
        Angle and speed of the output, rad and rad/s, counter-clockwise positive: inputs, or states of an output
        inertia.
    mesh_damping
        Damping of the contacts at the output, N·m·s/rad. Its torque is at most the contacts' own (as in Modelica's
        `ElastoBacklash2`): it acts in contact only and never pulls.
    output_inertia, crank_inertia
        Internal moments of inertia, kg·m²; 0 for none. Within a step, a crank without inertia moves linearly to the
        position given by its angle and speed at the step's start.
    crank_angle_start, crank_speed_start
        Start values of a crank with an inertia, rad and rad/s.
    largest_step
        Longest internal step, s: `advance` divides longer ones.
    dissipated_energy
        Energy dissipated since the start, J.
    """

    output_angle: float = 0.0
    output_speed: float = 0.0
    mesh_damping: float = 0.0
    output_inertia: float = 0.0
    crank_inertia: float = 0.0
    crank_angle_start: float = 0.0
    crank_speed_start: float = 0.0
    largest_step: float = LARGEST_STEP
    dissipated_energy: float = 0.0
    _load_torque: float = 0.0  # load on the output's inertia, N·m
    _driving_torque: float = 0.0  # torque on the crank's inertia, N·m
    _turned: float = 0.0  # present crank angle, rad: `crank_angle` may already be set to the next one
    _mean_torque: float = 0.0  # mean crank torque in the last step, N·m
    _mean_loss: float = 0.0  # mean power loss in the last step, W
    _mean_output: float = 0.0  # mean output torque in the last step, N·m
    _seen: float = 0.0  # output angle up to which friction is evaluated, rad
    _solved_at: Sequence[float] = ()
    _solved: Sequence[float] = ()


class Place(NamedTuple):
    """Contacts and series compliance: energy (J), its derivatives by crank and output angle (N·m), and stiffness."""

    energy: float
    by_angle: float
    by_rotation: float
    stiffness: float


def _mean_over(
    way: float, shortest: float, difference: float, at_start: float, at_end: float, slope: float
) -> tuple[float, float]:
    """Mean slope over a displacement as a difference quotient, and its derivative by the displacement's end.

    For a displacement too short for a difference it is the mean of the slopes at both ends.
    """
    if abs(way) > shortest:
        value = difference / way
        return value, (at_end - value) / way
    return 0.5 * (at_start + at_end), 0.5 * slope


class CompliantModel(SteppedModel, CompliantState):
    """A cycloid-pin drive between two flanges, stepped by `advance`.

    Parameters
    ----------
    pair, surface, losses
        As for `SteppedModel`.
    output_inertia, crank_inertia
        As for `CompliantState`.
    """

    def __init__(
        self,
        drive: DriveValue,
        losses: Sequence[Sequence[float]] = LOSSLESS,
        output_inertia: float = 0.0,
        crank_inertia: float = 0.0,
    ) -> None:
        super().__init__(drive, losses)
        self._held, self._led = output_inertia == 0.0, crank_inertia == 0.0
        self._geared = 1.0  # turns of the crank per turn of the driven shaft
        self.output_inertia, self.crank_inertia = output_inertia, crank_inertia

    def _rebuild(self) -> None:
        super()._rebuild()
        self._solved_at = self._solved = ()
        self._stiffest = 0.0

    def _check_deviation(self, deviation: float) -> None:
        if -LARGEST_TRANSMISSION_ERROR < deviation < LARGEST_TRANSMISSION_ERROR:
            return
        said, step = f"flange_b.phi is {deviation:g} rad from flange_a.phi/ratio", self._step
        allowed = f"it must stay within {LARGEST_TRANSMISSION_ERROR:g} rad"
        if not (self._held and step > SUGGESTED_STEP):
            raise StepError(f"{said}: {allowed}")
        raise StepError(
            f"{said} after a step of {step:g} s: {allowed}; make shorter "
            f"steps ({SUGGESTED_STEP:g} s is suggested), or build the FMU with the inertias inside (--output-inertia, "
            "--crank-inertia)"
        )

    def _gear_compliance(self) -> float:
        """The compliance in series, referred to the gear's torque and angle, rad/(N·m)."""
        return self.series_compliance

    def _still(self) -> DriveModel:
        """Return the quasi-static drive."""
        return DriveModel(DriveValue(self.pair, self.surface))

    def _contact(self, theta: float, deviation: float) -> tuple[float, float, float]:
        """Energy of contacts and series compliance (J), with its derivatives by crank and output angle (N·m)."""
        self._check_deviation(deviation)
        flange, rate = deviation, 0.0
        self._play = self._crank = self._sharing = None
        self._theta = theta
        if not self.backlash_on:
            low, high, interference = self._solve_play()
            if interference == 0.0:
                self._side = 1.0 if deviation >= 0.5 * (low + high) else -1.0
                flange += self._shift(self._side)
                rate = self._shift_rate(self._side, self._teeth, theta)
        self._x, self._stiffness, energy, by_angle, by_rotation = self._teeth.press(
            theta, flange, self._gear_compliance(), self._x
        )
        return energy, by_angle + rate * by_rotation, by_rotation

    def _damping(self, elastic: float, speed: float) -> float:
        """Torque of the contacts' damping at the output, N·m."""
        return math.copysign(min(self.mesh_damping * abs(speed), abs(elastic)), speed)

    def _lose(self, energy: float) -> None:
        self.dissipated_energy += energy

    def _solve(self) -> Sequence[float]:
        """Energy and torques of the contacts at flanges a and b, with damping, at the flanges' present position."""
        crank = self.crank_angle if self._held else self._turned
        crank_speed, output, speed = self.crank_speed, self.output_angle, self.output_speed
        at = [
            crank,
            crank_speed,
            output,
            speed,
            self.series_compliance,
            self.mesh_damping,
            self.backlash_on,
        ]
        if at != self._solved_at:
            energy, by_angle, by_rotation = self._contact(self._reduced(crank), output - crank / self._ratio)
            damping = 0.0
            if self.mesh_damping > 0.0:
                damping = self._damping(by_rotation, speed - crank_speed / self._ratio)
            transmitted = by_angle - damping / self._ratio
            self._solved_at, self._solved = at, [energy, transmitted, by_rotation, damping]
        return self._solved

    def _pressing(self, flange: int) -> Pressed:
        """Friction of a flange at its present position and speed."""
        _, transmitted, torque, _ = self._solve()
        if flange == 0:
            way = self.crank_angle - self._crank_seen if self._held else 0.0
            return self._press(0, way, self.crank_speed, transmitted)
        return self._press(1, self.output_angle - self._seen, self.output_speed, torque)

    def forget_history(self) -> None:
        """Remove the history before the next step: friction unstrained, inertias at rest under the load."""
        self._strains, self.dissipated_energy = [list(UNSTRAINED), list(UNSTRAINED)], 0.0
        if not self._held:
            if not self._led:
                self.crank_angle = self.crank_angle_start - self._support_angle
                self.crank_speed = self.crank_speed_start - self._support_speed
            self._turned = self.crank_angle
            still = self._still()
            shared = {name: getattr(self, name) for name in _SHARED}
            still.restore({**still.state(), **shared, "torque": self._load_torque})
            still.advance()
            self.output_angle, self.output_speed = still.output_angle, still.output_speed
            for _ in range(5 if self._load_torque != 0.0 else 0):
                # The torque from the energy differs slightly from that of the quasi-static balance
                # (`contact.elastic_energy`).
                torque = self._contact(self._reduced(self.crank_angle), self.transmission_error)[2]
                if self._stiffness > 0.0:
                    self.output_angle += (self._load_torque - torque) * (1.0 / self._stiffness + self.series_compliance)
        self._crank_seen, self._seen = self.crank_angle, self.output_angle
        if not self._held:
            at_crank = self._pressing(0)
            self._mean_torque = self._solve()[1] + at_crank.torque
            self._mean_loss = self._damping_power() + at_crank.power + self._pressing(1).power
            self._mean_output = self._load_torque

    def _move(self, step: float) -> None:
        """Move the flanges for a step, from the inputs' values at its start."""
        if self._held:
            self._follow(step)
        else:
            self._swing(step)
        self._support_angle += self._support_speed * step
        self._solve()

    def _follow(self, step: float) -> None:
        """Both flanges move at their speeds."""
        ways = (self.crank_speed * step, self.output_speed * step)
        rubbing, count = [flange for flange in (0, 1) if self._rubs[flange]], 1
        if rubbing or self.mesh_damping > 0.0:
            shift = max(abs(ways[0]) / CRANK_STEP, abs(ways[1] - ways[0] / self._ratio) / DEVIATION_STEP)
            chunks = max(math.ceil(step / self.largest_step * (1.0 - STEP_TOLERANCE)), 1)
            count = max(chunks, math.ceil(min(shift, chunks * MOST_PARTS)))
            if count > MOST_SUB_STEPS:
                raise StepError(
                    f"a step of {step:g} s is divided into more than {MOST_SUB_STEPS} parts: make it shorter"
                )
        loads = self._solve()[1:3] if rubbing else ()
        # Friction follows a flange whose position was set.
        for flange, way in ((0, self.crank_angle - self._crank_seen), (1, self.output_angle - self._seen)):
            if flange in rubbing:
                self._move_on(flange, self._rub(flange, way, 0.0, loads[flange]))
        crank, output = self.crank_angle, self.output_angle
        power = self._damping_power() if self.mesh_damping > 0.0 else 0.0
        for i in range(1, count + 1):
            self._seen = self.output_angle = output + ways[1] * i / count
            self._crank_seen = self.crank_angle = crank + ways[0] * i / count
            if rubbing:
                before, loads = loads, self._solve()[1:3]
                for flange in rubbing:
                    load = 0.5 * (before[flange] + loads[flange])
                    self._move_on(flange, self._rub(flange, ways[flange] / count, step / count, load))
            if self.mesh_damping > 0.0:
                following = self._damping_power()
                self.dissipated_energy += 0.5 * (power + following) * step / count
                power = following

    def _move_on(self, flange: int, slid: Slid) -> None:
        self._put_strains(flange, slid.strains)
        self.dissipated_energy += slid.lost

    def _damping_power(self) -> float:
        """Power of the contacts' damping, W."""
        return self._solve()[3] * (self.output_speed - self.crank_speed / self._ratio)

    def _longest(self, crank_speed: float) -> float:
        """The longest sub-step, s: a fraction of the fastest oscillation's period and of the mesh period."""
        if self._stiffest == 0.0:
            largest = LARGEST_LOAD * (self.pair.rated_torque or 100.0)
            _, self._stiffest = self._made_teeth().equilibrium(0.0, largest, 0.0)
        stiffness = 1.0 / (1.0 / self._stiffest + self.series_compliance)
        swing = (stiffness + FRICTION_ELEMENTS * self._elements[1]) / self.output_inertia
        if not self._led:
            swing += (stiffness / self._ratio**2 + FRICTION_ELEMENTS * self._elements[0]) / self.crank_inertia
        return min(
            self.largest_step, SUB_STEP / math.sqrt(swing), MESH_STEP / max(abs(crank_speed * self._geared), 1e-30)
        )

    def _swing(self, step: float) -> None:
        """Move the inertias under external torques and contacts; a crank without inertia follows its input."""
        goal, before, left = self.crank_angle + self.crank_speed * step, self.dissipated_energy, step
        speed_before = self.output_speed
        if self._led and step == 0.0:
            self._turned = self.crank_angle
        work, count, fewest = 0.0, 0, 1
        at = self._pressed(self._turned, self.output_angle - self._turned / self._ratio)
        while left > 0.0:
            speed = (goal - self._turned) / left if self._led else self.crank_speed
            parts = max(math.ceil(min(left / self._longest(speed), 1e9) * (1.0 - STEP_TOLERANCE)), fewest)
            count += 1
            if max(count, parts) > MOST_SUB_STEPS:
                raise StepError(
                    f"a step of {step:g} s is divided into more than {MOST_SUB_STEPS} parts: it is too long for so "
                    "fast a motion or so small an inertia"
                )
            part = left / parts
            made = self._sub_step(part, speed * part, at)
            if made is None:
                fewest = 2 * parts
                continue
            turn, torque, at = made
            fewest = max(1, parts - 1)
            work += torque * part
            self._turned = self._turned + turn if parts > 1 or not self._led else goal
            left = left - part if parts > 1 else 0.0
        self.crank_angle = self._turned
        if step > 0.0:
            self._mean_torque, self._mean_loss = work / step, (self.dissipated_energy - before) / step
            self._mean_output = self._load_torque - self.output_inertia * (self.output_speed - speed_before) / step

    def _pressed(self, crank_angle: float, deviation: float) -> Place:
        return Place(*self._contact(self._reduced(crank_angle), deviation), self._stiffness)

    def _by_phase(self, at: Place) -> float:
        return at.by_angle + at.by_rotation / self._ratio

    def _sub_step(self, part: float, turn: float, at: Place) -> tuple[float, float, Place] | None:
        """One sub-step by the implicit midpoint rule, with mean slopes in place of derivatives.

        The crank makes half of its rotation at constant deviation, the deviation changes, the crank makes the other
        half; all work done is stored or dissipated. Returns the crank's rotation (rad; the given one without inertia),
        its torque (N·m) and the position at the end; None if the sub-step is too long to be solved.
        """
        # Long as it runs thousands of times in a step, and its unknowns depend on each other.
        ratio, led, start, speed = self._ratio, self._led, self._turned, self.output_speed
        rubs_crank, rubs_output = self._rubs
        crank_speed, deviation = self.crank_speed, self.output_angle - self._turned / self._ratio
        a, b = 2.0 * self.crank_inertia / part**2, 2.0 * self.output_inertia / part**2
        way = part * speed + (self._load_torque - at.by_rotation) / b
        if not led:
            turn = part * crank_speed + (self._driving_torque - at.by_angle) / a
        before = end = at
        torque = change_a = 0.0
        at_crank = at_output = _FREE
        last = False
        for i in range(MOST_ITERATIONS):
            if i == 0 or not led:
                before = self._pressed(start + 0.5 * turn, deviation)
            off = way - turn / ratio
            after = self._pressed(start + 0.5 * turn, deviation + off)
            if last or not led:
                end = self._pressed(start + turn, deviation + off)
            mean, slope = _mean_over(
                off,
                SAME_PLACE,
                after.energy - before.energy,
                before.by_rotation,
                after.by_rotation,
                max(before.stiffness, after.stiffness),
            )
            damping = self._damping(mean, off / part)
            damped = self.mesh_damping / part if abs(damping) < abs(mean) else math.copysign(slope, off * mean)
            if rubs_output:
                at_output = self._rub(1, way, part, mean)
            k = slope + damped
            r = b + at_output.slope + k
            missing = self._load_torque - mean - damping - at_output.torque - b * (way - part * speed)
            if last or not led:
                stored = before.energy - at.energy + end.energy - after.energy
                phase, _ = _mean_over(
                    turn, SAME_PLACE * abs(ratio), stored, self._by_phase(at), self._by_phase(end), 0.0
                )
                torque = phase - (mean + damping) / ratio
                if rubs_crank:
                    at_crank = self._rub(0, turn, part, torque)
            if last:
                if rubs_crank or rubs_output:
                    self._strains = [
                        at_crank.strains if rubs_crank else self._strains[0],
                        at_output.strains if rubs_output else self._strains[1],
                    ]
                self._seen = self.output_angle = self.output_angle + way
                self.output_speed = 2.0 * way / part - speed
                if not led:
                    self.crank_speed = 2.0 * turn / part - crank_speed
                self.dissipated_energy += at_output.lost + damping * off + at_crank.lost
                return turn, torque + at_crank.torque, end
            if led:
                change = missing / r
            else:
                missing_a = self._driving_torque - torque - at_crank.torque - a * (turn - part * crank_speed)
                q, k = a + at_crank.slope, k / ratio
                determinant = q * r + (r - k * ratio) * k / ratio
                change = (missing * (q + k / ratio) + missing_a * k) / determinant
                change_a = (missing_a * r + missing * k) / determinant
            share = math.ldexp(LAST_SHARE, min(i, MOST_DOUBLED))
            last = abs(change) <= LAST_CHANGE + share * abs(way) and abs(change_a) <= LAST_CHANGE * abs(
                ratio
            ) + share * abs(turn)
            way, turn = way + change, turn + change_a
        return None

    @property
    def crank_torque(self) -> float:
        """Torque into the drive at the crank, N·m; with an internal inertia, its mean over the last step."""
        if not self._held:
            return self._mean_torque
        transmitted = self._solve()[1]
        return transmitted + self._pressing(0).torque if self._rubs[0] else transmitted

    @crank_torque.setter
    def crank_torque(self, value: float) -> None:
        self._driving_torque = value

    @property
    def torque(self) -> float:
        """Torque into the drive at the output, N·m; with an output inertia, the load on it."""
        if not self._held:
            return self._load_torque
        _, _, torque, damping = self._solve()
        return torque + damping + (self._pressing(1).torque if self._rubs[1] else 0.0)

    @torque.setter
    def torque(self, value: float) -> None:
        self._load_torque = value

    @property
    def support_torque(self) -> float:
        """Torque into the drive at the housing, N·m; with an internal inertia, its mean over the last step."""
        return -(self.crank_torque + (self.torque if self._held else self._mean_output))

    def _turn_housing(self, angle: float, speed: float) -> None:
        super()._turn_housing(angle, speed)
        self._turned -= angle
        self.output_angle -= angle
        self.output_speed -= speed

    @property
    def transmission_error(self) -> float:
        """φ_b - φ_a/ratio, rad."""
        return self.output_angle - (self.crank_angle if self._held else self._turned) / self._ratio

    @property
    def elastic_energy(self) -> float:
        """Energy stored in contacts, series compliance and friction, J."""
        return self._solve()[0] + sum(self._pressing(flange).stored for flange in (0, 1) if self._rubs[flange])

    @property
    def power_loss(self) -> float:
        """Power lost to damping, losses and sliding friction, W; the mean over the last step with an inertia."""
        if not self._held:
            return self._mean_loss
        return self._damping_power() + sum(self._pressing(flange).power for flange in (0, 1) if self._rubs[flange])

    def _settle(self) -> float:
        self._solve()
        return self.output_angle
