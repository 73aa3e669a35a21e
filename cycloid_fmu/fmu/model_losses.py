"""Losses of an FMU from the friction that a pair file states, solved in the balance of the drive.

Friction at the contacts and bearings goes into Modelica's loss table, its change over the crank angle into orders of
that angle, drags of both shafts that do not depend on the lubricant into the friction of the flanges. Whatever the
lubricant does depends on speed times viscosity alone, so the table is over the speed at one viscosity, and the FMU
looks it up at the speed times ν(T)/ν_ref (docs/theory/fmu.md).
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.constants import INPUT_STRIBECK_SPEED, MOST_RIPPLE_ORDERS
from cycloid_fmu.fmu.friction_file import Friction
from cycloid_fmu.fmu.variables import FRICTIONLESS, LOSSLESS, Interface, LossRipple, LossRow
from cycloid_fmu.geometry.losses import Drag, Losses, Lubricant
from cycloid_fmu.losses.heat import at_oil_temperature
from cycloid_fmu.losses.solver import losses_of, solve, sun_rate

Array = NDArray[np.float64]
LARGEST_SPEED = 200.0 * math.pi
"""Speed of flange_a up to which the table follows the model, rad/s; 6000 rpm."""
COLDEST, HOTTEST = 293.15, 373.15
"""Temperatures between which it does where [thermal] does not state others, K."""
SHARES = (0.1, 0.3, 0.65, 1.0)
"""Loads, of the rated torque, at which the model is solved."""
_COMPARED = (0.1, 0.45, 1.0)  # of the rated torque
_ANGLES = 37  # of one crank turn: no common divisor with numbers of pins near it
_CLOSE = 2e-3  # of the load's torque at flange_a: largest change of a row that is not inserted
_MOST_ROWS = 32
_RIPPLE_ANGLES = 8  # for each pin
_LEAST_RIPPLE = 1e-4  # of the load's torque at flange_a: smaller orders are left out


@dataclass(frozen=True)
class ModelLosses:
    """Losses and friction of an FMU, computed from `[losses]`, SI.

    Attributes
    ----------
    rows, input_friction, output_friction, lubricant
        As for `Interface`.
    mean_deviation
        Largest difference of the mean torque at `flange_a` from that with friction in the balance, over the load's own
        torque there, dimensionless: of the efficiency.
    angle_deviation
        The same at single crank angles.
    loads, temperatures
        Smallest and largest of those compared, N·m on the output and K.
    ripple
        As `loss_ripple` of an `Interface`; None where the losses do not change over the crank angle.
    from_table
        Names of `friction_values.VALUES` whose geometric mean was taken.
    """

    rows: tuple[LossRow, ...]
    input_friction: Friction
    output_friction: Friction
    lubricant: Lubricant | None
    mean_deviation: float
    angle_deviation: float
    loads: tuple[float, float]
    temperatures: tuple[float, float]
    ripple: LossRipple | None = None
    from_table: tuple[str, ...] = ()

    @property
    def summary(self) -> str:
        """What was computed, how well it agrees, and what does not follow the temperature, each on its line."""
        low, high = (kelvin - 273.15 for kelvin in self.temperatures)
        means = f" with the geometric means of {', '.join(map(repr, self.from_table))}" if self.from_table else ""
        orders = f"{0 if self.ripple is None else len(self.ripple.orders)} orders of the crank angle"
        warm = "" if low == high else f", {low:.4g} to {high:.4g} °C"
        # The difference printed includes their change.
        clearances = (
            "" if low == high else "\nClearances and play do not follow the temperature: they are those of the file."
        )
        return (
            f"losses from [losses]{means}, {len(self.rows)} rows of the loss table, {orders}; for "
            f"{self.loads[0]:.4g} to {self.loads[1]:.4g} N·m, up to {LARGEST_SPEED * 30.0 / math.pi:.4g} rpm{warm}.\n"
            "The torque at flange_a differs from that with friction in the balance by at most "
            f"{100.0 * self.mean_deviation:.2g} % of the load's, at single crank angles by "
            f"{100.0 * self.angle_deviation:.2g} %.{clearances}"
        )


def states_friction(interface: Interface) -> bool:
    """Return whether losses or friction are stated for an interface; then they are not computed from `[losses]`."""
    frictions = (interface.input_friction, interface.output_friction)
    return interface.losses != LOSSLESS or any(friction != FRICTIONLESS for friction in frictions)


def with_model_losses(interface: Interface, drive: DriveValue) -> tuple[Interface, ModelLosses | None]:
    """Return an interface with the losses of `[losses]`, and what was computed.

    It is as it was, with None, where the pair states no losses or no supports for them to act on, or the interface
    states losses or friction.

    Raises
    ------
    edge.InputError
        As `model_losses`.
    """
    if drive.pair.losses is None or drive.pair.supports is None or states_friction(interface):
        return interface, None
    found = model_losses(drive)
    names = ("input_friction", "output_friction", "lubricant")
    values = {name: getattr(found, name) for name in names}
    return dataclasses.replace(interface, losses=found.rows, loss_ripple=found.ripple, **values), found


def model_losses(drive: DriveValue) -> ModelLosses:
    """Return the losses of an FMU of a drive with `[losses]`.

    Raises
    ------
    edge.InputError
        As `losses.solver.solve`; if there is no rated torque; or if the drive jams, or locks itself under every load,
        which a loss table can't state.
    """
    losses = losses_of(drive)
    model = _Model(drive)
    rows = _rows(model)
    lubricant = losses.lubricant
    if lubricant is not None and all(row[1:] == rows[-1][1:] for row in rows[1:]):
        lubricant = None  # nothing depends on its viscosity
    found = ModelLosses(
        rows,
        Friction(viscous=losses.input_drag.viscous),
        Friction(coulomb=losses.output_drag.coulomb, viscous=losses.output_drag.viscous),
        lubricant,
        0.0,
        0.0,
        (SHARES[0] * model.rated, model.rated),
        (0.0, 0.0),
        _ripple(drive),
        tuple(sorted(set(losses.from_table.values()))),
    )
    return _compared(model, found)


def table_torque(rows: tuple[LossRow, ...], speed: float, asked: Array) -> Array:
    """Return the torque at flange_a with the losses of a table, N·m, as `fmu/clockwork/losses.c` has it.

    Parameters
    ----------
    rows
        As for `Interface.losses`.
    speed
        |w| of flange_a, rad/s; times ν(T)/ν_ref where there is a lubricant.
    asked
        Torque of the teeth at flange_a, N·m, above 0 where it drives.
    """
    table = np.array(rows)
    forward, backward, friction, friction_back = (np.interp(speed, table[:, 0], column) for column in table[:, 1:].T)
    # Two lines; LossyGear changes over where they cross, so it has the larger one.
    needed: Array = np.maximum((asked + friction) / forward, backward * (asked + friction_back))
    return needed


class _Model:
    """The drive with friction in its balance, without the drags that an FMU has at its flanges."""

    def __init__(self, drive: DriveValue, angles: int = _ANGLES) -> None:
        self.drive, self.losses, self.rate, self.ratio = drive, losses_of(drive), sun_rate(drive), abs(drive.ratio)
        self.rated = drive.pair.rated_load("the pair")
        self.loads = self.rated * np.array(SHARES)
        self.angles = np.linspace(0.0, 2.0 * math.pi, angles, endpoint=False)
        drags = {
            "input_drag": self.losses.input_drag.replace(viscous=0.0),
            "output_drag": Drag(churning=self.losses.output_drag.churning),
        }
        self.places = dict[tuple[float, ...], Array]()
        self.contacts = _with_losses(drive, self.losses.replace(**drags))

    def input_torque(self, drive: DriveValue, loads: Array, direction: int, speed: float) -> Array:
        """Return the torque at flange_a in the direction of its motion, shape (loads, angles), N·m.

        `speed` is that of flange_a, rad/s; a drive that jams is refused.
        """
        at = (direction, *loads)
        rubbed = solve(drive, loads, self.angles, direction, speed / abs(self.rate), near=self.places.get(at))
        if np.isfinite(rubbed.place).all():
            self.places[at] = rubbed.place
        torque: Array = direction * math.copysign(1.0, self.rate) * rubbed.input_torque
        if np.isnan(torque).any():
            load = loads[np.isnan(torque).any(axis=1)][0]
            mode = "drives" if load * direction > 0.0 else "is back-driven by"
            raise edge.InputError(
                f"[losses]: the drive jams where it {mode} {abs(load):.4g} N*m at {speed * 30.0 / math.pi:.4g} rpm, "
                "which a loss table can't state; state --losses, or leave [losses] out."
            )
        return torque

    def row(self, speed: float) -> LossRow:
        """Return the row of the table at a speed of flange_a, rad/s, at the lubricant's stated temperature."""
        teeth = self.loads / self.ratio
        lines = []
        for direction in (1, -1):
            torque = self.input_torque(self.contacts, self.loads, direction, speed).mean(axis=1)
            lines.append(nearest_line(teeth, torque - direction * teeth))
        (lost, friction), (lost_back, friction_back) = lines
        if lost_back >= 1.0:
            raise edge.InputError(
                f"[losses]: the drive locks itself: at {speed * 30.0 / math.pi:.4g} rpm the output can't turn flange_a "
                "with any load, which a loss table can't state; state --losses, or leave [losses] out."
            )
        efficiency = 1.0 - lost_back
        return speed, 1.0 / (1.0 + lost), efficiency, friction / (1.0 + lost), friction_back / efficiency


def _with_losses(drive: DriveValue, losses: Losses) -> DriveValue:
    return DriveValue(drive.pair.replace(losses=losses), drive.surface, drive.first_stage)


def nearest_line(load: Array, loss: Array) -> tuple[float, float]:
    """Return slope and constant, not below 0, of the line with the smallest largest difference over the load."""
    from scipy.optimize import linprog

    one = np.ones(load.size)
    rising = np.column_stack([one, one / load, -one])
    falling = np.column_stack([-one, -one / load, -one])
    shares = loss / load
    found = linprog([0.0, 0.0, 1.0], np.vstack([rising, falling]), np.concatenate([shares, -shares]))
    return float(found.x[0]), float(found.x[1])


def _rows(model: _Model) -> tuple[LossRow, ...]:
    """Return the table: rows between two are inserted where the model is not linear.

    Friction at rest, which may be another than at the slightest speed, ends at the first row after it: slow enough that
    the drive moves at any temperature from `INPUT_STRIBECK_SPEED` on.
    """
    teeth = model.loads / model.ratio
    thickest, thinnest = (_thinning(model.losses.lubricant, kelvin) for kelvin in _range(model.drive))
    ends = 0.0, INPUT_STRIBECK_SPEED * thinnest, LARGEST_SPEED * thickest
    rows = {speed: model.row(speed) for speed in ends}
    pending = [tuple(sorted(rows))[1:]]
    while pending and len(rows) < _MOST_ROWS:
        low, high = pending.pop(0)
        between = math.sqrt(low * high)
        row, linear = model.row(between), (rows[low], rows[high])
        off = max(
            float(np.abs((table_torque((row,), between, asked) - table_torque(linear, between, asked)) / teeth).max())
            for asked in (teeth, -teeth)
        )
        if off > _CLOSE:
            rows[between] = row
            pending += [(low, between), (between, high)]
    return tuple(rows[speed] for speed in sorted(rows))


def _ripple(drive: DriveValue) -> LossRipple | None:
    """Return the change of the losses over a crank turn at the loads of `SHARES`, at a tenth of the largest speed.

    It is what the balance loses more than the line through its means, at the torque of the teeth at each angle.
    """
    model, speed = _Model(drive, _RIPPLE_ANGLES * drive.pair.pins), 0.1 * LARGEST_SPEED
    row, smooth, turn = (model.row(speed),), _with_losses(drive, Losses()), math.copysign(1.0, model.rate)
    parts = np.empty((2, 2, len(SHARES), model.angles.size // 2 + 1), np.complex128)
    for direction, drives in itertools.product((1, -1), (True, False)):
        loads = direction * model.loads if drives else -direction * model.loads
        asked = model.input_torque(smooth, loads, direction, 0.0)
        more = model.input_torque(model.contacts, loads, direction, speed) - table_torque(row, speed, asked)
        spectrum = 2.0 * np.fft.rfft(more) / model.angles.size
        parts[int((direction * turn > 0.0) != drives), int(not drives)] = spectrum.conj()
    teeth = model.loads / model.ratio
    largest = (np.abs(parts) / teeth[:, None]).max(axis=(0, 1, 2))
    largest[[0, -1]] = 0.0
    orders = np.sort(np.argsort(-largest)[:MOST_RIPPLE_ORDERS])
    orders = orders[largest[orders] > _LEAST_RIPPLE]
    if orders.size == 0:
        return None
    chosen = parts[..., orders]
    both = np.stack([chosen.real, chosen.imag], axis=-1).tolist()
    return LossRipple(orders=tuple(orders.tolist()), loads=tuple(teeth.tolist()), parts=both)


def _range(drive: DriveValue) -> tuple[float, float]:
    """Return the lowest and the highest temperature that the model is compared at, K."""
    lubricant, thermal = losses_of(drive).lubricant, drive.pair.thermal
    low = COLDEST if thermal is None else thermal.ambient
    high = HOTTEST if thermal is None or thermal.largest is None else thermal.largest
    stated = [] if lubricant is None else [lubricant.temperature]
    return min([low, *stated]), max([high, *stated])


def _thinning(lubricant: Lubricant | None, kelvin: float) -> float:
    """Return the viscosity at a temperature over that at the stated one, 1."""
    return 1.0 if lubricant is None else lubricant.replace(temperature=kelvin).viscosity / lubricant.viscosity


def _at_temperature(drive: DriveValue, kelvin: float) -> DriveValue:
    """Return the drive with its lubricant, and with [thermal] its parts, at a temperature."""
    lubricant = losses_of(drive).lubricant
    if drive.pair.thermal is not None:
        return at_oil_temperature(drive, kelvin)
    if lubricant is None:
        return drive
    return _with_losses(drive, losses_of(drive).replace(lubricant=lubricant.replace(temperature=kelvin)))


def _compared(model: _Model, found: ModelLosses) -> ModelLosses:
    """Return losses with their largest differences from the model."""
    low, high = _range(model.drive)
    stated = model.losses.lubricant
    temperatures = {low, high} if model.drive.pair.thermal is not None or stated is not None else {COLDEST}
    temperatures |= set() if stated is None else {stated.temperature}
    compared, problem, mean, single = list[float](), None, 0.0, 0.0
    for kelvin in sorted(temperatures):
        try:
            warm = _at_temperature(model.drive, kelvin)
            off = np.array(
                [
                    _differences(model, found, warm, direction, side * model.rated * np.array(_COMPARED), kelvin)
                    for direction, side in itertools.product((1, -1), (1.0, -1.0))
                ]
            )
        except edge.InputError as refused:  # a clearance is used up there, or the drive jams
            problem = refused
            continue
        compared.append(kelvin)
        mean = max(mean, float(np.abs(off.mean(axis=-1)).max()))
        single = max(single, float(np.abs(off).max()))
    if problem is not None and not compared:
        raise problem
    return dataclasses.replace(
        found, mean_deviation=mean, angle_deviation=single, temperatures=(compared[0], compared[-1])
    )


def _differences(
    model: _Model, found: ModelLosses, warm: DriveValue, direction: int, loads: Array, kelvin: float
) -> Array:
    """Return differences of the torque at flange_a from the model's over the load's torque there.

    Shape (speeds, loads, angles); `loads` are torques of the environment on the output, N·m.
    """
    smooth = model.input_torque(_with_losses(model.drive, Losses()), loads, direction, 0.0)
    thinning, off = _thinning(model.losses.lubricant, kelvin), list[Array]()
    for speed in (0.0, INPUT_STRIBECK_SPEED, 0.1 * LARGEST_SPEED, LARGEST_SPEED):
        drag = found.output_friction.coulomb + found.output_friction.viscous * speed / model.ratio
        asked = smooth * (1.0 + drag / (direction * loads))[:, None]
        of_fmu = _of_fmu(model, found, asked, direction, speed * thinning) + found.input_friction.viscous * speed
        off.append(model.input_torque(warm, loads, direction, speed) - of_fmu)
    return np.array(off) / (np.abs(loads) / model.ratio)[:, None]


def _of_fmu(model: _Model, found: ModelLosses, asked: Array, direction: int, reduced: float) -> Array:
    """Return the torque at flange_a with the losses of an FMU, shape (loads, angles), N·m.

    Parameters
    ----------
    asked
        That of the teeth; both in the direction of the flange's motion.
    direction
        Of the crank's rotation.
    reduced
        Speed of flange_a, rad/s, times the lubricant's viscosity over the stated one.
    """
    lost = table_torque(found.rows, reduced, asked) - asked
    if found.ripple is not None:
        turn = direction * math.copysign(1.0, model.rate)
        for k, mean in enumerate(asked.mean(axis=1).tolist()):
            lost[k] = np.maximum(lost[k] + found.ripple.torque(model.angles, turn * mean, mean > 0.0), 0.0)
    needed: Array = asked + lost
    return needed
