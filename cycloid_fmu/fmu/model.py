"""The drive as a system model sees it: inputs and parameters in, output angle with its history out.

Nothing of FMI here; every slave wraps this class. Friction and play are one rate-independent hysteresis: the output
stays where it is as long as that lies between what it would be at torque - friction and at torque + friction, else it
is carried along by the nearer end. At zero torque without friction these ends are the ends of the play.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cycloid_fmu import contact
from cycloid_fmu.pair import Pair
from cycloid_fmu.surface import ErrorSurface, structured_names, structured_value, surface_after, with_structured
from cycloid_fmu.transmission import drive_of, slices_needed

ORDERS = (1, 2, 3)


class DriveModel:
    """A cycloid-pin drive with history, stepped by `advance`.

    Parameters
    ----------
    pair, surface
        The nominal pair and its errors.

    Attributes
    ----------
    crank_angle, crank_speed, torque
        Inputs: rad, rad/s, N·m of the environment on the output.
    friction_torque, series_compliance
        Parameters: dry friction at the output (N·m) and compliance of the rest of the chain (rad/(N·m)).
    """

    def __init__(self, pair: Pair, surface: ErrorSurface) -> None:
        self.pair, self.surface = pair, surface
        self.crank_angle = self.crank_speed = self.torque = 0.0
        self.friction_torque = self.series_compliance = 0.0
        self.errors = {name: structured_value(pair, surface, name) for name in structured_names(ORDERS)}
        self._stated = dict(self.errors)
        self._crank_turns_worn = math.nan if surface.life is None else float(surface.life.crank_turns[-1])
        self._ratio = pair.ratio
        # Everything repeats after one turn of the gear in the ring; a reduced angle keeps its digits.
        self._period = 2.0 * math.pi * (pair.pair.gear_teeth if pair.pair.output == "gear" else pair.pair.pins)
        self._output_angle: float | None = None
        self._rebuild()

    def _rebuild(self) -> None:
        changed = {n: v for n, v in self.errors.items() if v != self._stated[n]}
        worn = self.surface if self.surface.life is None else surface_after(self.surface, self._crank_turns_worn)
        surface = with_structured(self.pair, worn, changed)
        self._drive = drive_of(self.pair, surface, slices_needed(surface))
        self._contacts = contact.contact_rows(self._drive)
        self._play_contacts = contact.contact_rows(self._drive)
        shape = (self.pair.pair.discs, self.pair.pair.pins)
        self._pin_force, self._pin_pressure = np.zeros(shape), np.zeros(shape)
        self._cold = self._play_cold = True
        self._x, self._stiffness, self._load = 0.0, 0.0, 0.0
        self._pushed = 0.0
        self._forget()

    def _forget(self) -> None:
        self._play: tuple[float, float, float] | None = None
        self._crank: tuple[float, float] | None = None
        self._sharing: tuple[int, float] | None = None

    def set_error(self, name: str, value: float) -> None:
        """Set a structured error (m or rad), from the next step on."""
        if self.errors[name] != value:
            self.errors[name] = value
            self._rebuild()

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

    @property
    def _theta(self) -> float:
        return self.crank_angle - self._period * math.floor(self.crank_angle / self._period)

    def _solve_play(self) -> tuple[float, float, float]:
        if self._play is None:
            self._play = contact.play(self._drive, self._theta, self._x, self._play_contacts, self._play_cold)
            self._play_cold = math.isnan(self._play[0])
        return self._play

    def _elastic(self, torque: float, end: float) -> float:
        """Flange deviation at a torque through the teeth; at torque 0 the given end of the play (-1, 0, 1)."""
        if torque == 0.0:
            low, high, interference = self._solve_play()
            if interference == 0.0:
                self._x = 0.5 * (low + high) + 0.5 * end * (high - low)
                self._stiffness, self._load = 0.0, 0.0
                return self._x
        self._x, self._stiffness = contact.equilibrium(
            self._drive, self._theta, torque, self._x, self._contacts, self._cold
        )
        self._cold, self._load = False, torque
        return self._x + self.series_compliance * torque

    def _hold(self, deviation: float) -> None:
        """Find the teeth's state when the flange stands still at a deviation inside the hysteresis."""
        self._x, self._stiffness = contact.behind_compliance(
            self._drive, self._theta, deviation, self.series_compliance, self._x, self._contacts, self._cold
        )
        self._cold = False
        self._load = (deviation - self._x) / self.series_compliance if self.series_compliance > 0.0 else math.nan

    def forget_history(self) -> None:
        """Make the next step start without history: at zero torque from the middle of the play."""
        self._output_angle = None

    def _settle(self) -> float:
        """Return the output angle, solved without history where no step was made yet."""
        if self._output_angle is None:
            self.advance()
        assert self._output_angle is not None
        return self._output_angle

    def advance(self) -> None:
        """Move to the inputs' present values, from the state before."""
        self._forget()
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
        self._output_angle = ideal + deviation
        self._deviation = deviation

    @property
    def output_angle(self) -> float:
        """φ_b, rad."""
        return self._settle()

    @property
    def transmission_error(self) -> float:
        """φ_b - φ_a/ratio, rad."""
        self._settle()
        return self._deviation

    def _crank_side(self) -> tuple[float, float]:
        if self._crank is None:
            self._settle()
            if self._stiffness > 0.0:
                self._crank = contact.crank_side(self._drive, self._theta, self._x, self._contacts)
            else:
                contact.place(self._drive, self._theta, self._x, self._play_contacts, self._play_cold, math.inf)
                self._crank = (
                    0.0,
                    contact.touch_rate(self._drive, self._theta, self._x, self._play_contacts, self._pushed),
                )
        return self._crank

    @property
    def output_speed(self) -> float:
        """dφ_b/dt at the present torque, rad/s; 0 while friction or play hold the output."""
        if self.crank_speed == 0.0:
            return 0.0
        rate = self._crank_side()[1]
        carried = self._pushed != 0.0
        return self.crank_speed * rate if carried and not math.isnan(rate) else 0.0

    @property
    def crank_torque(self) -> float:
        """Torque that the crank must be given, N·m."""
        return self._crank_side()[0]

    @property
    def backlash(self) -> float:
        """Free rotation of the output with the crank locked, rad; 0 where there is none."""
        self._settle()
        low, high, interference = self._solve_play()
        return high - low if interference == 0.0 else 0.0

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
                self._sharing = contact.load_sharing(self._drive, self._contacts, self._pin_force, self._pin_pressure)
            else:
                self._sharing = (0, 0.0)
        return self._sharing

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
        "_x", "_stiffness", "_load", "_pushed", "_cold", "_play_cold",
    )  # fmt: skip

    def state(self) -> dict[str, Any]:
        """Return everything that later steps depend on, as plain values (for JSON)."""
        kept = {name: getattr(self, name, None) for name in self._STATE}
        return {
            **kept,
            "errors": dict(self.errors),
            "crank_turns_worn": self._crank_turns_worn,
            "contacts": self._contacts.tolist(),
            "play_contacts": self._play_contacts.tolist(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Return to a state given by `state`."""
        self.errors = dict(state["errors"])
        self._crank_turns_worn = state["crank_turns_worn"]
        self._rebuild()
        for name in self._STATE:
            setattr(self, name, state[name])
        self._contacts = np.array(state["contacts"])
        self._play_contacts = np.array(state["play_contacts"])
