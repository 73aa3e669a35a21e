"""The quasi-static drive in a system model: inputs and parameters in, output angle with its history out.

This module does not depend on FMI; the slaves wrap its class. Friction and play form one rate-independent hysteresis:
the output is where teeth and friction elements balance the torque. Once all elements slide, the output is carried
along, at its position for torque - friction or torque + friction. At zero torque without friction these two limits are
the ends of the play.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.constants import FRICTION_ROUNDING, FRICTION_SHARE, MOST_LOAD_SHARE
from cycloid_fmu.fmu.friction import UNSTRAINED, Pressed, balanced, held_strains
from cycloid_fmu.fmu.mesh import StepError
from cycloid_fmu.fmu.stepped_model import State, SteppedModel, Teeth, state_fields
from cycloid_fmu.fmu.variables import LOSSLESS


@state_fields
class DriveState(State):
    """State of a quasi-static drive.

    Attributes
    ----------
    torque
        Input: torque of the environment on the output, counter-clockwise positive, N·m.
    """

    torque: float = 0.0
    _output_angle: float | None = None  # rad; None before the first step
    _deviation: float = 0.0  # of the output from its ideal angle, rad
    _pushed: float = 0.0  # side that carries the output, ±1; 0 if the output rests


class DriveModel(SteppedModel, DriveState):
    """A quasi-static cycloid-pin drive with history, stepped by `advance`."""

    def __init__(self, drive: DriveValue, losses: Sequence[Sequence[float]] = LOSSLESS) -> None:
        super().__init__(drive, losses)
        self._lever = 1.0  # torque at the driven shaft per torque at the crank

    def _rebuild(self) -> None:
        super()._rebuild()
        self._pushed = 0.0

    def _pressed(self, theta: float, x: float, teeth: Teeth | None = None) -> tuple[float, float]:
        """Crank torque (N·m) of teeth in contact, by default the model's own, and dφ_b/dθ at constant torque."""
        teeth = teeth or self._teeth
        torque, rate = teeth.crank_side(theta, x)
        if not self.backlash_on:
            # The flange is pressed by its deviation and by the disabled play.
            gone = self._shift_rate(self._side, teeth, theta)
            torque += gone * teeth.torque
            rate -= gone
        return torque, rate

    def _elastic(self, torque: float, end: float) -> float:
        """Flange deviation (rad) at a torque (N·m) of the teeth; at 0 an end (±1) or the middle (0) of the play."""
        if torque == 0.0:
            low, high, interference = self._solve_play()
            if interference == 0.0:
                self._side = end
                self._x = 0.5 * (low + high) + 0.5 * end * (high - low)
                self._stiffness = 0.0
                return self._x - self._shift(end)
        self._x, self._stiffness = self._teeth.equilibrium(self._theta, torque, self._x)
        self._side = math.copysign(1.0, torque)
        deviation = self._x + self.series_compliance * torque
        return deviation if self.backlash_on else deviation - self._shift(self._side)

    def _hold(self, deviation: float) -> None:
        """Solve the teeth with the flange at rest at a deviation (rad) inside the hysteresis."""
        if not self.backlash_on:
            low, high, _ = self._solve_play()
            self._side = 1.0 if deviation > 0.5 * (low + high) else -1.0
            deviation += self._shift(self._side)
        self._x, self._stiffness = self._teeth.behind(self._theta, deviation, self.series_compliance, self._x)

    def forget_history(self) -> None:
        """Remove the history before the next step: at zero torque the output starts in the middle of the play."""
        self._output_angle = None
        self._strains = [list(UNSTRAINED), list(UNSTRAINED)]

    def _settle(self) -> float:
        """Return the output angle, solved without history before the first step."""
        if self._output_angle is None:
            self.advance()
        assert self._output_angle is not None
        return self._output_angle

    def _move(self, step: float) -> None:
        self._theta = self._reduced(self.crank_angle)
        self._play = self._crank = self._sharing = None
        if not math.isfinite((self._viscous(0) + self._viscous(1)) * self.crank_speed * self.crank_speed):
            raise StepError(f"flange_a.w = {self.crank_speed:g} rad/s: viscous friction is beyond the range of numbers")
        ideal = self.crank_angle / self._ratio
        if self._output_angle is None:
            deviation = self._elastic(self.torque, 0.0)
            self._pushed = 1.0 if self.torque != 0.0 else 0.0
            self._crank_seen = self.crank_angle
        elif self._rubs[1]:
            deviation = self._carried(self._output_angle - ideal)
        elif self.torque != 0.0:
            deviation = self._elastic(self.torque, 0.0)
            self._pushed = 1.0
        else:
            deviation = self._floating(self._output_angle - ideal)
        if not math.isfinite(deviation):
            raise StepError(f"flange_a.phi = {self.crank_angle:g} rad: the output can't be found there")
        self._output_angle = ideal + deviation
        self._deviation = deviation
        if self._elements[0] > 0.0:
            yields = self._yields(0, self._lever * self._crank_side()[0], self.crank_speed)
            way = self.crank_angle - self._crank_seen
            self._put_strains(0, held_strains(self._strains[0], way, self._elements[0], *yields)[0])
        self._crank_seen = self.crank_angle

    def _floating(self, before: float) -> float:
        """Deviation of the output at zero torque, rad: its last one, limited to the ends of the play."""
        self._pushed = 0.0
        high = self._elastic(0.0, 1.0)
        if before > high:
            self._pushed = 1.0
            return high
        low = self._elastic(0.0, -1.0)
        if before < low:
            self._pushed = -1.0
            return low
        if low < high:
            self._hold(before)
            return before
        return low

    def _carried(self, before: float) -> float:
        """Deviation of the output with friction (rad), from `before`: M + f(displacement) = T, teeth M, friction f.

        If all elements slide, the friction follows from the torque. Otherwise it is in between: the teeth have one
        deviation x at T - f, which decreases with f, and the elements have one f at each deviation, which increases
        with it.
        """
        load, stiffness = self.torque - self._viscous(1) * self._output_pace(), self._elements[1]
        self._pushed = 1.0
        if stiffness == 0.0:
            return self._elastic(load, 0.0) if load != 0.0 else self._floating(before)

        def held(deviation: float, borne: float) -> tuple[float, float]:
            """Friction and its slope with the output at a deviation, while the teeth carry a torque."""
            strains, slope = held_strains(
                self._strains[1], deviation - before, stiffness, *self._yields(1, borne, self._output_pace())
            )
            at[:] = deviation, strains
            return stiffness * sum(strains), slope

        def kept() -> float:
            deviation, strains = at
            self._put_strains(1, strains)
            return float(deviation)

        at: list[Any] = []
        low, high = -self._sliding(-load), self._sliding(load)
        most = max(-low, high)
        for sliding, side in ((low, 1.0), (high, -1.0)):
            deviation = self._elastic(load - sliding, side)
            reached, _ = held(deviation, load - sliding)
            slides = reached * sliding >= sliding * sliding * (1.0 - FRICTION_ROUNDING)
            if slides and (deviation - before) * side <= 0.0:
                self._pushed = side
                return kept()
        if low < load < high:
            # Friction may carry all of the torque: within the play, or between teeth that press only on each other.
            places = [self._elastic(0.0, side) for side in (-1.0, 1.0)]
            ends = [held(place, 0.0)[0] for place in places]
            if ends[0] <= load <= ends[1]:

                def more(place: float) -> tuple[float, float]:
                    reached, slope = held(place, 0.0)
                    return reached - load, slope

                balanced(more, places[0], places[1], before, FRICTION_ROUNDING * self._laws[1].presliding_angle)
                self._pushed = 0.0
                self._hold(at[0])
                return kept()
            low, high = (low, load) if load > ends[1] else (load, high)
        end = -1.0 if load == low else 1.0

        def missing(force: float) -> tuple[float, float]:
            deviation = self._elastic(load - force, math.copysign(1.0, load - force) if load != force else end)
            reached, slope = held(deviation, load - force)
            compliance = self.series_compliance + (1.0 / self._stiffness if self._stiffness > 0.0 else 0.0)
            return force - reached, 1.0 + slope * compliance

        force = balanced(missing, low, high, stiffness * sum(self._strains[1]), FRICTION_SHARE * most)
        self._pushed = math.copysign(1.0, load - force)
        return kept()

    def _output_pace(self) -> float:
        """Ideal speed of the output, rad/s, at which its friction is evaluated."""
        return self.crank_speed / self._ratio

    def _sliding(self, towards: float) -> float:
        """Friction F of the output while all elements slide, with its share of the teeth's torque, N·m.

        `towards` is the torque on the output, with the sign of the motion: the teeth carry |towards - F|.
        """
        bare = self._yields(1, 0.0, self._output_pace())[1]
        share = self._yields(1, 1.0, self._output_pace())[1] - bare
        sliding = (bare + share * towards) / (1.0 + share)
        return sliding if sliding <= towards else (bare - share * towards) / (1.0 - min(share, MOST_LOAD_SHARE))

    @property
    def output_angle(self) -> float:
        """φ_b, rad."""
        return self._settle() if self._output_angle is None else self._output_angle

    @property
    def transmission_error(self) -> float:
        """φ_b - φ_a/ratio, rad."""
        if self._output_angle is None:
            self._settle()
        return self._deviation

    def _crank_side(self) -> tuple[float, float]:
        if self._crank is None:
            if self._output_angle is None:
                self._settle()
            if self._stiffness > 0.0:
                pressed = self._teeth.crank_side if self.backlash_on else self._pressed
                self._crank = pressed(self._theta, self._x)
            elif self.backlash_on:
                self._crank = 0.0, self._teeth.touch_rate(self._theta, self._x, self._pushed)
            else:
                rate = self._teeth.touch_rate(self._theta, self._solve_play()[1], 1.0)
                self._crank = 0.0, rate - self._shift_rate(1.0, self._teeth, self._theta)
        return self._crank

    @property
    def output_speed(self) -> float:
        """Output speed dφ_b/dt at the present torque, rad/s; 0 while friction or play holds the output."""
        if self.crank_speed == 0.0:
            return 0.0
        rate = (self._crank or self._crank_side())[1]
        carried = self._pushed != 0.0 or not (self.backlash_on or self._rubs[1])
        return self.crank_speed * rate * self._yielding(rate) if carried and not math.isnan(rate) else 0.0

    def _yielding(self, rate: float) -> float:
        """Factor on the output's speed while friction elements stick; `rate` has the sign of the speed."""
        stiffness = self._elements[1]
        if stiffness == 0.0 or self._stiffness <= 0.0:
            return 1.0
        way = math.copysign(FRICTION_ROUNDING, self.crank_speed * rate) * self._laws[1].presliding_angle
        yields = self._yields(1, self.torque - stiffness * sum(self._strains[1]), self._output_pace())
        return 1.0 / (1.0 + held_strains(self._strains[1], way, stiffness, *yields)[1] / self.torsional_stiffness)

    def _pressing(self, flange: int) -> Pressed:
        """Friction of a flange at the present speeds."""
        if flange == 0:
            return self._press(0, 0.0, self.crank_speed, self._lever * (self._crank or self._crank_side())[0])
        stiffness = self._elements[1]
        return self._press(1, 0.0, self.output_speed, self.torque - stiffness * sum(self._strains[1]), 0.0)

    @property
    def crank_torque(self) -> float:
        """Torque required at the crank, friction and losses included, N·m."""
        torque = self._lever * (self._crank or self._crank_side())[0]
        return torque + self._pressing(0).torque if self._rubs[0] else torque

    @property
    def power_loss(self) -> float:
        """Power lost in mesh, bearings and friction, W."""
        return sum(self._pressing(flange).power for flange in (0, 1) if self._rubs[flange])

    @property
    def support_torque(self) -> float:
        """Torque into the drive at the housing, N·m."""
        return -(self.crank_torque + self.torque)
