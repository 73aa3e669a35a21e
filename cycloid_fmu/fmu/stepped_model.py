"""Common part of all drives with history: errors, contacts, outputs, and steps that are made or refused as a whole."""

from __future__ import annotations

import dataclasses
import math
import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, TypeVar, dataclass_transform

import numpy as np

from cycloid_fmu.contact.transmission import rigid_problem
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.errors.kinds import names_of
from cycloid_fmu.fmu.constants import REFERENCE_TEMPERATURE, UNRATED_LOAD
from cycloid_fmu.fmu.friction import NO_FRICTION, UNSTRAINED, FrictionState, Law
from cycloid_fmu.fmu.losses import check_losses
from cycloid_fmu.fmu.mesh import ContactTeeth, StepError
from cycloid_fmu.fmu.on_bearings import SupportedTeeth
from cycloid_fmu.fmu.variables import LOSSLESS
from cycloid_fmu.surfaces.structured import structured_value, with_structured

_Kind = TypeVar("_Kind")
Teeth = ContactTeeth | SupportedTeeth


@dataclass_transform()
def state_fields(kind: type[_Kind]) -> type[_Kind]:
    """Make a dataclass of a class and remove its class-level defaults, which would slow down each attribute access."""
    made = dataclass(eq=False)(kind)
    for name in kind.__annotations__:
        if name in kind.__dict__:
            delattr(kind, name)
    return made


@state_fields
class State:
    """The complete state for later steps and outputs; every field is part of rollback and serialization.

    Results computed from the state are stored with it, so that a rollback does not change outputs. Dictionaries and
    lists are replaced, never modified, because copies share them.

    Attributes
    ----------
    crank_angle, crank_speed
        Inputs: angle and speed of the crank, rad and rad/s, counter-clockwise positive.
    temperature
        Input: temperature of the friction, K.
    series_compliance
        Parameter: compliance of the rest of the drivetrain, in series at the output, rad/(N·m).
    backlash_on
        Whether the play is included; without it the flanks of both sides touch at zero torque.
    errors
        Structured errors by name, m or rad.
    pin_arrays
        Errors of each pin that were set, by name, shape (pins,), m.
    loss_table
        Rows of the loss table (`variables.Interface.losses`).
    friction
        Values of `friction.Law` at both flanges.
    """

    crank_angle: float = 0.0
    crank_speed: float = 0.0
    temperature: float = REFERENCE_TEMPERATURE
    series_compliance: float = 0.0
    backlash_on: bool = True
    errors: dict[str, float] = field(default_factory=dict)
    pin_arrays: dict[str, list[float]] = field(default_factory=dict)
    loss_table: list[list[float]] = field(default_factory=list)
    friction: list[list[float]] = field(default_factory=lambda: [list(law) for law in NO_FRICTION])
    _strains: list[list[float]] = field(default_factory=lambda: [list(UNSTRAINED), list(UNSTRAINED)])
    _crank_seen: float = 0.0  # crank angle up to which friction is evaluated, rad
    _support_angle: float = 0.0  # of the housing, to which all other angles are relative, rad
    _support_speed: float = 0.0
    _theta: float = 0.0  # crank angle, reduced, rad
    _x: float = 0.0  # deviation of the flange due to the teeth only, rad
    _stiffness: float = 0.0  # of the teeth, N·m/rad; 0 without contact
    _side: float = 0.0  # side of the play on which the teeth are, ±1; 0 for neither
    _play: tuple[float, float, float] | None = None  # both ends (rad), and interference (m), above 0 without play
    _crank: tuple[float, float] | None = None  # torque of the crank (N·m), and dφ_b/dθ
    _sharing: tuple[int, float] | None = None  # pins in contact, and the largest pressure (Pa)
    _teeth: Teeth = field(init=False)

    def state(self) -> dict[str, Any]:
        """Return a copy of the state as plain values (for JSON)."""
        found = {one.name: getattr(self, one.name) for one in dataclasses.fields(self)}
        return {**found, "_teeth": self._teeth.state()}

    def assign(self, state: Mapping[str, Any]) -> None:
        """Restore a state returned by `state`, of the same errors."""
        for one in dataclasses.fields(self):
            if one.name != "_teeth":
                setattr(self, one.name, state[one.name])
        self._teeth.restore(state["_teeth"])


def _absolute(name: str, of_housing: str) -> property:
    """An angle or speed relative to the housing."""

    def get(self: Any) -> float:
        return float(getattr(self, name) + getattr(self, of_housing))

    def put(self: Any, value: float) -> None:
        setattr(self, name, value - getattr(self, of_housing))

    return property(get, put)


class SteppedModel(State, FrictionState):
    """A cycloid-pin drive with history, stepped by `advance`; a subclass defines its motion (`_move`).

    Parameters
    ----------
    drive
        The drive.
    losses
        Rows of the loss table (`variables.Interface.losses`).
    """

    absolute_crank_angle = _absolute("crank_angle", "_support_angle")
    absolute_crank_speed = _absolute("crank_speed", "_support_speed")
    absolute_output_angle = _absolute("output_angle", "_support_angle")
    absolute_output_speed = _absolute("output_speed", "_support_speed")

    def __init__(self, drive: DriveValue, losses: Sequence[Sequence[float]] = LOSSLESS) -> None:
        pair, surface = drive.pair, drive.surface
        super().__init__()
        self._step = 0.0  # being made, s, for its message; 0 outside a step
        self._fields = tuple(one.name for one in dataclasses.fields(self))
        self._values = operator.attrgetter(*self._fields)
        self.pair, self.surface = pair, surface
        self.loss_table = [list(row) for row in losses]
        self._as_built = surface
        self._stated = self._structured()
        self.errors = dict(self._stated)
        self._ratio = pair.ratio
        # Everything repeats after one turn of the gear in the ring; reducing the angle preserves its precision.
        self._period = 2.0 * math.pi * (pair.gear_teeth if pair.output == "gear" else pair.pins)
        self._settle_friction(self._rated())
        self._rebuild()

    def _structured(self) -> dict[str, float]:
        return {name: structured_value(self.surface, name) for name in names_of(self.pair)}

    def _changed(self) -> dict[str, float]:
        return {n: v for n, v in self.errors.items() if v != self._stated[n]}

    def check(self) -> None:
        """Check parameters against each other; raise a `ValueError` with one sentence if they contradict."""
        check_losses(self.loss_table)

    def _rebuild(self) -> None:
        """Create the contacts for the present errors."""
        self._teeth = self._made_teeth()
        self._x = self._stiffness = self._side = 0.0
        self._forget()

    def _made_teeth(self) -> Teeth:
        drive = DriveValue(self.pair, with_structured(self.surface, self._changed()))
        if self.pair.supports is not None:
            return SupportedTeeth(drive, drive.slices)
        return ContactTeeth(rigid_problem(drive, drive.slices), (self.pair.discs, self.pair.pins))

    def _forget(self) -> None:
        self._play = self._crank = self._sharing = None

    def set_error(self, name: str, value: float) -> None:
        """Set a structured error (m or rad), from the next step on."""
        if self.errors[name] != value:
            self.errors = {**self.errors, name: value}
            self._rebuild()

    def pin_errors(self, name: str) -> list[float]:
        """Return the errors of each pin (m) for a kind of pin errors, including structured errors set since."""
        values: list[float] = getattr(with_structured(self.surface, self._changed()), name).tolist()
        return values

    def set_pin_errors(self, name: str, values: Sequence[float]) -> None:
        """Set the errors of each pin (m), from the next step on; the structured errors are updated."""
        if list(values) != self.pin_errors(name):
            self._put_pin_errors({**self.pin_arrays, name: list(values)})
            self.errors = {**self.errors, **{n: v for n, v in self._stated.items() if n.startswith(f"{name}_")}}
            self._rebuild()

    def _put_pin_errors(self, arrays: Mapping[str, Sequence[float]]) -> None:
        self.pin_arrays = {name: list(values) for name, values in arrays.items()}
        given: dict[str, Any] = {name: np.array(values) for name, values in self.pin_arrays.items()}
        self.surface = self._as_built.replace(**given)
        self._stated = self._structured()

    def set_loss(self, row: int, column: int, value: float) -> None:
        """Set a cell of the loss table, counted from 0."""
        table = [list(cells) for cells in self.loss_table]
        table[row][column] = value
        self.loss_table = table
        self._follow_friction()

    def set_friction(self, flange: int, **values: float) -> None:
        """Set values of the friction (`friction.Law`) at `flange_a`, 0, or `flange_b`, 1.

        Elements whose stiffness changes start unstrained; their stored energy is lost.
        """
        laws = [list(law) for law in self.friction]
        laws[flange] = list(Law(*laws[flange])._replace(**values))
        if laws != self.friction:
            self.friction = laws
            self._follow_friction()

    def _follow_friction(self) -> None:
        before = self._elements
        self._settle_friction(self._rated())
        for flange in (0, 1):
            if before[flange] != self._elements[flange]:
                self._lose(0.5 * before[flange] * sum(z * z for z in self._strains[flange]))
                self._put_strains(flange, UNSTRAINED)

    def _lose(self, energy: float) -> None:
        """Count the energy stored in friction as lost, J."""

    def _rated(self) -> tuple[float, float]:
        """The rated torque at both flanges, N·m."""
        rated = self.pair.rated_torque or UNRATED_LOAD
        return rated / self._ratio, rated

    @property
    def friction_torque(self) -> float:
        """Coulomb friction at the output, N·m."""
        return self._laws[1].coulomb

    @friction_torque.setter
    def friction_torque(self, value: float) -> None:
        self.set_friction(1, coulomb=value)

    @property
    def support_angle(self) -> float:
        """Angle of the housing, rad. All angles and speeds except the `absolute` ones are relative to it."""
        return self._support_angle

    @support_angle.setter
    def support_angle(self, angle: float) -> None:
        self._turn_housing(angle - self._support_angle, 0.0)
        self._support_angle = angle

    @property
    def support_speed(self) -> float:
        """Speed of the housing, rad/s."""
        return self._support_speed

    @support_speed.setter
    def support_speed(self, speed: float) -> None:
        self._turn_housing(0.0, speed - self._support_speed)
        self._support_speed = speed

    def _turn_housing(self, angle: float, speed: float) -> None:
        """Convert values that are absolute to the housing's new angle and speed."""
        self.crank_angle -= angle
        self.crank_speed -= speed

    @property
    def support_torque(self) -> float:
        """Torque into the drive at the housing, N·m."""
        raise NotImplementedError

    def _reduced(self, crank_angle: float) -> float:
        return crank_angle - self._period * math.floor(crank_angle / self._period)

    def _solve_play(self) -> tuple[float, float, float]:
        if self._play is None:
            self._play = self._teeth.play(self._theta, self._x)
        return self._play

    def _shift(self, side: float) -> float:
        """Shift of the output to a side (±1) by the disabled play, rad."""
        if self.backlash_on:
            return 0.0
        low, high, interference = self._solve_play()
        return 0.5 * side * (high - low) if interference == 0.0 else 0.0

    def _shift_rate(self, side: float, teeth: Teeth, theta: float) -> float:
        """Derivative of `_shift` by the crank angle, dimensionless."""
        if self.backlash_on:
            return 0.0
        low, high, interference = self._solve_play() if theta == self._theta else teeth.play(theta, self._x)
        if interference > 0.0:
            return 0.0
        return 0.5 * side * (teeth.touch_rate(theta, high, 1.0) - teeth.touch_rate(theta, low, -1.0))

    def _settle(self) -> float:
        """Return the output angle, solved before the first step."""
        raise NotImplementedError

    def _move(self, step: float) -> None:
        """Move for a step (s), from the state before; raise a `StepError` if it is refused."""
        raise NotImplementedError

    def forget_history(self) -> None:
        """Remove the history before the next step."""
        raise NotImplementedError

    def advance(self, step: float = 0.0) -> None:
        """Move to the inputs' present values, from the state before.

        Parameters
        ----------
        step
            Duration, s; has no effect on a quasi-static drive.

        Raises
        ------
        StepError
            If the step is refused; the state is unchanged.
        """
        if not 0.0 <= step < math.inf:
            raise StepError(f"a step of {step:g} s: it must be finite and not below 0")
        kept, self._step = self._values(self), step
        self._teeth.begin()
        try:
            self._move(step)
        except StepError:
            self._teeth.undo()
            for name, value in zip(self._fields, kept, strict=True):
                setattr(self, name, value)
            raise
        finally:
            self._step = 0.0

    @property
    def ratio(self) -> float:
        """Ratio of the driven shaft's angle to the output's in the ideal drive, signed."""
        return self._ratio

    @property
    def outside_range(self) -> bool:
        """Whether a torque exceeds the tables of a native FMU; always False, as every torque is solved."""
        return False

    @property
    def backlash(self) -> float:
        """Free rotation of the output with the crank locked, rad; 0 if there is none."""
        self._settle()
        low, high, interference = self._solve_play()
        return high - low if interference == 0.0 and self.backlash_on else 0.0

    @property
    def torsional_stiffness(self) -> float:
        """Stiffness at the output flange, with the compliance in series, N·m/rad."""
        self._settle()
        if self._stiffness <= 0.0:
            return 0.0
        return 1.0 / (1.0 / self._stiffness + self.series_compliance)

    def _load_sharing(self) -> tuple[int, float]:
        if self._sharing is None:
            self._settle()
            self._sharing = self._teeth.sharing() if self._stiffness > 0.0 else (0, 0.0)
        return self._sharing

    @property
    def pin_force(self) -> list[float]:
        """Force on each pin, disc by disc, N."""
        return self._pin_loads(self._teeth.pin_force)

    @property
    def pin_pressure(self) -> list[float]:
        """Largest pressure on each pin, disc by disc, Pa."""
        return self._pin_loads(self._teeth.pin_pressure)

    def _pin_loads(self, found: Callable[[], list[float]]) -> list[float]:
        self._load_sharing()
        return found() if self._stiffness > 0.0 else [0.0] * (self.pair.discs * self.pair.pins)

    @property
    def contact_count(self) -> int:
        """Number of pins that carry more than 1 % of the most loaded pin's force."""
        return self._load_sharing()[0]

    @property
    def max_contact_pressure(self) -> float:
        """Largest contact pressure, Pa."""
        return self._load_sharing()[1]

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore a state returned by `state`."""
        if state["pin_arrays"] != self.pin_arrays:
            self._put_pin_errors(state["pin_arrays"])
        errors = ("errors", "pin_arrays")
        remade = any(state[name] != getattr(self, name) for name in errors)
        if remade:
            for name in errors:
                setattr(self, name, state[name])
            self._rebuild()
        self.assign(state)
        self._settle_friction(self._rated())
