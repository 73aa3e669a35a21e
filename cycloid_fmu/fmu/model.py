"""The drive as a system model sees it: inputs and parameters in, output angle with its history out.

Nothing of FMI here; every slave wraps this class. Friction and play are one rate-independent hysteresis: the output
stays where it is as long as that lies between what it would be at torque - friction and at torque + friction, else it
is carried along by the nearer end. At zero torque without friction these ends are the ends of the play.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np

from cycloid_fmu.contact.transmission import drive_of, slices_needed
from cycloid_fmu.errors.kinds import structured_names
from cycloid_fmu.fmu.losses import check_losses, loss_torque
from cycloid_fmu.fmu.table_teeth import Interpolation, TableTeeth
from cycloid_fmu.fmu.teeth import ContactTeeth, StepError, Teeth
from cycloid_fmu.fmu.variables import LOSSLESS, ORDERS
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.structured import structured_value, with_structured
from cycloid_fmu.surfaces.surface import ErrorSurface, surface_after


class DriveModel:
    """A cycloid-pin drive with history, stepped by `advance`.

    Parameters
    ----------
    pair, surface
        The nominal pair and its errors.
    losses
        Rows of the loss table (`variables.Interface.losses`).
    tables
        What is interpolated in place of the contacts; its errors are those it was made with.

    Attributes
    ----------
    crank_angle, crank_speed, torque
        Inputs: rad, rad/s, N·m of the environment on the output.
    friction_torque, series_compliance
        Parameters: dry friction at the output (N·m) and compliance of the rest of the chain (rad/(N·m)).
    backlash_on
        Whether the play acts; without it the flanks of both sides touch at zero torque.
    loss_table
        Rows as `losses`, checked by `check`.
    """

    def __init__(
        self,
        pair: Pair,
        surface: ErrorSurface,
        losses: Sequence[Sequence[float]] = LOSSLESS,
        tables: Interpolation | None = None,
    ) -> None:
        self.pair, self.surface, self.tables = pair, surface, tables
        self.crank_angle = self.crank_speed = self.torque = 0.0
        self.friction_torque = self.series_compliance = 0.0
        self.backlash_on = True
        self.loss_table = [list(row) for row in losses]
        self._as_built, self._pin_arrays = surface, dict[str, list[float]]()
        self._stated = self._structured()
        self.errors = dict(self._stated)
        self._crank_turns_worn = math.nan if surface.life is None else float(surface.life.crank_turns[-1])
        self._ratio = pair.ratio
        # Everything repeats after one turn of the gear in the ring; a reduced angle keeps its digits.
        self._period = 2.0 * math.pi * (pair.gear_teeth if pair.output == "gear" else pair.pins)
        self._output_angle: float | None = None
        self._deviation = self._theta = 0.0  # θ: the crank's angle, reduced
        self._moved = operator.attrgetter(*self._MOVED)
        self._lever = 1.0  # of the driven shaft on the crank's torque
        # Of no use but with tables, whose errors stay.
        self._contacts = functools.cache(self._contact_teeth)
        self._rebuild()

    def _structured(self) -> dict[str, float]:
        return {name: structured_value(self.pair, self.surface, name) for name in structured_names(ORDERS)}

    def _changed(self) -> dict[str, float]:
        return {n: v for n, v in self.errors.items() if v != self._stated[n]}

    def check(self) -> None:
        """Refuse parameters that contradict each other; a `ValueError` says which in one sentence."""
        check_losses(self.loss_table)

    def _rebuild(self) -> None:
        self._teeth = self._made_teeth()
        self._x, self._stiffness = 0.0, 0.0
        self._pushed = self._side = 0.0
        self._forget()

    def _made_teeth(self) -> Teeth:
        return self._contact_teeth() if self.tables is None else TableTeeth(self.tables, self._contacts)

    def _contact_teeth(self) -> ContactTeeth:
        worn = self.surface if self.surface.life is None else surface_after(self.surface, self._crank_turns_worn)
        surface = with_structured(self.pair, worn, self._changed())
        drive = drive_of(self.pair, surface, slices_needed(surface))
        return ContactTeeth(drive, (self.pair.discs, self.pair.pins))

    def _forget(self) -> None:
        self._play: tuple[float, float, float] | None = None
        self._crank: tuple[float, float] | None = None
        self._sharing: tuple[int, float] | None = None

    def set_error(self, name: str, value: float) -> None:
        """Set a structured error (m or rad), from the next step on."""
        if self.errors[name] != value:
            self.errors[name] = value
            self._rebuild()

    def pin_errors(self, name: str) -> list[float]:
        """Return the errors of each pin (m), one of `ARRAYS`, the structured errors set since included."""
        values: list[float] = getattr(with_structured(self.pair, self.surface, self._changed()), name).tolist()
        return values

    def set_pin_errors(self, name: str, values: Sequence[float]) -> None:
        """Set the errors of each pin (m), from the next step on; the structured errors then say what they hold."""
        if list(values) != self.pin_errors(name):
            self._put_pin_errors({**self._pin_arrays, name: list(values)})
            held = {n: v for n, v in self._stated.items() if n.startswith(f"{name}_")}
            self.errors.update(held)
            self._rebuild()

    def _put_pin_errors(self, arrays: Mapping[str, Sequence[float]]) -> None:
        self._pin_arrays = {name: list(values) for name, values in arrays.items()}
        given: dict[str, Any] = {name: np.array(values) for name, values in self._pin_arrays.items()}
        self.surface = dataclasses.replace(self._as_built, **given)
        self._stated = self._structured()

    @property
    def crank_turns_worn(self) -> float:
        """Crank turns since new, of a surface that holds a life: how far it is worn, from the next step on."""
        return self._crank_turns_worn

    @crank_turns_worn.setter
    def crank_turns_worn(self, turns: float) -> None:
        if turns != self._crank_turns_worn:
            surface_after(self.surface, turns)
            self._crank_turns_worn = turns
            self._rebuild()

    def _reduced(self, crank_angle: float) -> float:
        return crank_angle - self._period * math.floor(crank_angle / self._period)

    def _solve_play(self) -> tuple[float, float, float]:
        if self._play is None:
            self._play = self._teeth.play(self._theta, self._x)
        return self._play

    def _shift(self, side: float) -> float:
        """How far the play that does not act would let the output go to a side (±1), rad."""
        if self.backlash_on:
            return 0.0
        low, high, interference = self._solve_play()
        return 0.5 * side * (high - low) if interference == 0.0 else 0.0

    def _shift_rate(self, side: float, teeth: Teeth, theta: float) -> float:
        """Change of `_shift` with the crank's angle (1)."""
        if self.backlash_on:
            return 0.0
        low, high, interference = self._solve_play() if theta == self._theta else teeth.play(theta, self._x)
        if interference > 0.0:
            return 0.0
        return 0.5 * side * (teeth.touch_rate(theta, high, 1.0) - teeth.touch_rate(theta, low, -1.0))

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

    def advance(self, step: float = 0.0) -> None:
        """Move to the inputs' present values, from the state before.

        Parameters
        ----------
        step
            How long that takes, s: the drive is quasi-static, so it does not matter.

        Raises
        ------
        StepError
            If the step is refused; nothing has moved then.
        """
        if not 0.0 <= step < math.inf:
            raise StepError(f"a step of {step:g} s: it must be finite and not below 0")
        kept = self._moved(self)
        self._teeth.begin()
        try:
            self._move(step)
        except StepError:
            self._teeth.undo()
            for name, value in zip(self._MOVED, kept, strict=True):
                setattr(self, name, value)
            raise

    # What a step changes besides the teeth.
    _MOVED: tuple[str, ...] = (
        "_theta", "_x", "_stiffness", "_pushed", "_side", "_play", "_crank", "_sharing",
    )  # fmt: skip

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
        return torque + loss_torque(self.loss_table, self.crank_speed, torque)

    @property
    def power_loss(self) -> float:
        """Power lost in the mesh and bearings and to the friction at the output, W."""
        lost = loss_torque(self.loss_table, self.crank_speed, self._lever * self._crank_side()[0])
        return lost * self.crank_speed + self.friction_torque * abs(self.output_speed)

    @property
    def backlash(self) -> float:
        """Free rotation of the output with the crank locked, rad; 0 where there is none."""
        self._settle()
        low, high, interference = self._solve_play()
        return high - low if interference == 0.0 and self.backlash_on else 0.0

    @property
    def torsional_stiffness(self) -> float:
        """Stiffness at the flange, the compliance in series included, N·m/rad."""
        self._settle()
        if self._stiffness <= 0.0:
            return 0.0
        return 1.0 / (1.0 / self._stiffness + self.series_compliance)

    def _load_sharing(self) -> tuple[int, float]:
        if self._sharing is None:
            self._settle()
            if self._stiffness > 0.0:
                self._sharing = self._teeth.sharing(self._theta)
            else:
                self._sharing = (0, 0.0)
        return self._sharing

    @property
    def pin_force(self) -> list[float]:
        """Force on each pin, disc by disc, N."""
        return self._pin_loads(self._teeth.pin_force)

    @property
    def pin_pressure(self) -> list[float]:
        """Largest pressure on each pin, disc by disc, Pa."""
        return self._pin_loads(self._teeth.pin_pressure)

    def _pin_loads(self, told: Callable[[float], list[float]]) -> list[float]:
        self._load_sharing()
        return told(self._theta) if self._stiffness > 0.0 else [0.0] * (self.pair.discs * self.pair.pins)

    @property
    def contact_count(self) -> int:
        """Pins that carry more than 1 % of the most loaded pin's force."""
        return self._load_sharing()[0]

    @property
    def max_contact_pressure(self) -> float:
        """Pa."""
        return self._load_sharing()[1]

    _STATE: tuple[str, ...] = (
        "crank_angle", "crank_speed", "torque", "friction_torque", "series_compliance", "_output_angle", "_deviation",
        "_theta",
        "_x", "_stiffness", "_pushed", "_side", "backlash_on",
    )  # fmt: skip

    # What was found from the state since; kept with it so that reading an output is the same before and after.
    _CACHES: tuple[str, ...] = ("_play", "_crank", "_sharing")

    def state(self) -> dict[str, Any]:
        """Return everything that later steps and outputs depend on, as plain values (for JSON)."""
        return {
            **{name: getattr(self, name) for name in (*self._STATE, *self._CACHES)},
            "errors": dict(self.errors),
            "pin_errors": dict(self._pin_arrays),
            "loss_table": [list(row) for row in self.loss_table],
            "crank_turns_worn": self._crank_turns_worn,
            "teeth": self._teeth.state(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Return to a state given by `state`."""
        if state["pin_errors"] != self._pin_arrays:
            self._put_pin_errors(state["pin_errors"])
        self.errors = dict(state["errors"])
        self.loss_table = [list(row) for row in state["loss_table"]]
        self._crank_turns_worn = state["crank_turns_worn"]
        self._rebuild()
        for name in (*self._STATE, *self._CACHES):
            setattr(self, name, state[name])
        self._teeth.restore(state["teeth"])
