"""The drive as a system model sees it: inputs and parameters in, output angle with its history out.

Nothing of FMI here; every slave wraps this class. Friction and play are one rate-independent hysteresis: the output
stays where it is as long as that lies between what it would be at torque - friction and at torque + friction, else it
is carried along by the nearer end. At zero torque without friction these ends are the ends of the play.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from cycloid_fmu.fmu.losses import loss_torque
from cycloid_fmu.fmu.mesh import StepError
from cycloid_fmu.fmu.stepped_model import State, SteppedModel, Teeth, state_fields
from cycloid_fmu.fmu.variables import LOSSLESS
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.surface import ErrorSurface


@state_fields
class DriveState(State):
    """State of a quasi-static drive.

    Attributes
    ----------
    torque
        Input: of the environment on the output, N·m.
    """

    torque: float = 0.0
    _output_angle: float | None = None  # rad; None before the first step
    _deviation: float = 0.0  # of the output from its ideal place, rad
    _pushed: float = 0.0  # side that carries the output, 0 where it stands


class DriveModel(SteppedModel, DriveState):
    """A quasi-static cycloid-pin drive with history, stepped by `advance`."""

    def __init__(self, pair: Pair, surface: ErrorSurface, losses: Sequence[Sequence[float]] = LOSSLESS) -> None:
        super().__init__(pair, surface, losses)
        self._lever = 1.0  # of the driven shaft on the crank's torque

    def _rebuild(self) -> None:
        super()._rebuild()
        self._pushed = 0.0

    def _pressed(self, theta: float, x: float, teeth: Teeth | None = None) -> tuple[float, float]:
        """Torque of the crank by teeth in contact, the model's own or others, and dφ_b/dθ at constant torque."""
        teeth = teeth or self._teeth
        torque, rate = teeth.crank_side(theta, x)
        if not self.backlash_on:
            # The flange is pressed by its deviation and by the play that is not there.
            gone = self._shift_rate(self._side, teeth, theta)
            torque += gone * teeth.torque
            rate -= gone
        return torque, rate

    def _elastic(self, torque: float, end: float) -> float:
        """Flange deviation at a torque through the teeth; at torque 0 the given end of the play (-1, 0, 1)."""
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
        """Find the teeth's state when the flange stands still at a deviation inside the hysteresis."""
        if not self.backlash_on:
            low, high, _ = self._solve_play()
            self._side = 1.0 if deviation > 0.5 * (low + high) else -1.0
            deviation += self._shift(self._side)
        self._x, self._stiffness = self._teeth.behind(self._theta, deviation, self.series_compliance, self._x)

    def forget_history(self) -> None:
        """Make the next step start without history: at zero torque from the middle of the play."""
        self._output_angle = None

    def _settle(self) -> float:
        """Return the output angle, solved without history where no step was made yet."""
        if self._output_angle is None:
            self.advance()
        assert self._output_angle is not None
        return self._output_angle

    def _move(self, step: float) -> None:
        self._theta = self._reduced(self.crank_angle)
        self._play = self._crank = self._sharing = None
        ideal = self.crank_angle / self._ratio
        if self._output_angle is None:
            deviation = self._elastic(self.torque, 0.0)
            self._pushed = 1.0 if self.torque != 0.0 else 0.0
        elif self.friction_torque == 0.0 and self.torque != 0.0:
            deviation = self._elastic(self.torque, 0.0)
            self._pushed = 1.0
        else:
            before = self._output_angle - ideal
            deviation, self._pushed = before, 0.0
            high = self._elastic(self.torque + self.friction_torque, 1.0)
            if before > high:
                deviation, self._pushed = high, 1.0
            else:
                low = self._elastic(self.torque - self.friction_torque, -1.0)
                if before < low:
                    deviation, self._pushed = low, -1.0
                elif low == high:
                    deviation = low
                else:
                    self._hold(before)
        if not math.isfinite(deviation):
            raise StepError(f"flange_a.phi = {self.crank_angle:g} rad: the output can't be found there")
        self._output_angle = ideal + deviation
        self._deviation = deviation

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
        """dφ_b/dt at the present torque, rad/s; 0 while friction or play hold the output."""
        if self.crank_speed == 0.0:
            return 0.0
        rate = (self._crank or self._crank_side())[1]
        carried = self._pushed != 0.0 or not (self.backlash_on or self.friction_torque > 0.0)
        return self.crank_speed * rate if carried and not math.isnan(rate) else 0.0

    @property
    def crank_torque(self) -> float:
        """Torque that the crank must be given, losses included, N·m."""
        torque = self._lever * (self._crank or self._crank_side())[0]
        return torque + loss_torque(self.loss_table, self.crank_speed, torque)[0]

    @property
    def power_loss(self) -> float:
        """Power lost in the mesh and bearings and to the friction at the output, W."""
        lost, _ = loss_torque(self.loss_table, self.crank_speed, self._lever * self._crank_side()[0])
        return lost * self.crank_speed + self.friction_torque * abs(self.output_speed)

    @property
    def support_torque(self) -> float:
        """Torque into the drive at the housing, N·m."""
        return -(self.crank_torque + self.torque)
