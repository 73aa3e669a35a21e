"""Losses of an FMU from the friction that a pair file states, solved in the balance of the drive.

Friction at the contacts and bearings goes into Modelica's loss table, and its change over the crank angle into orders
of the crank's turn relative to the ring and to the output carrier. Drags of both shafts that do not depend on the
lubricant go into the friction of the flanges. Whatever the lubricant does depends on speed times viscosity alone, so
the table is over the speed at one viscosity, and the FMU looks it up at the speed times ν(T)/ν_ref
(docs/theory/fmu.md).
"""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.constants import INPUT_STRIBECK_SPEED, MOST_RIPPLE_ORDERS, MOST_RIPPLE_SPEEDS
from cycloid_fmu.fmu.friction_file import Friction
from cycloid_fmu.fmu.variables import FRICTIONLESS, LOSSLESS, Interface, LossRipple, LossRow
from cycloid_fmu.geometry.losses import Drag, Losses, Lubricant
from cycloid_fmu.losses.heat import at_oil_temperature
from cycloid_fmu.losses.solver import losses_of, solve, sun_rate

Array = NDArray[np.float64]
Value = TypeVar("Value")
LARGEST_SPEED = 200.0 * math.pi
"""Speed of flange_a up to which the table follows the model, rad/s; 6000 rpm."""
COLDEST, HOTTEST = 293.15, 373.15
"""Temperatures between which it does where [thermal] does not state others, K."""
SHARES = (0.1, 0.3, 0.65, 1.0)
"""Loads, of the rated torque, at which the model is solved."""
_COMPARED = (0.1, 0.45, 1.0)  # of the rated torque
_ANGLES = 37  # of an output turn, at least
_CLOSE = 2e-3  # of the load's torque at flange_a: largest change by a speed that is not inserted
_RIPPLE_CLOSE = 5e-4  # the same, of an order
_MOST_ROWS = 32
_BESIDE_PASSAGE = 3  # orders above a pin's passage that are candidates
_ANGLES_OF_AN_ORDER = 6  # by which it is fitted
_RIPPLE_SPEED = 0.1 * LARGEST_SPEED  # at which orders are chosen
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
    computed = model_losses(drive)
    names = ("input_friction", "output_friction", "lubricant")
    values = {name: getattr(computed, name) for name in names}
    return dataclasses.replace(interface, losses=computed.rows, loss_ripple=computed.ripple, **values), computed


def model_losses(drive: DriveValue) -> ModelLosses:
    """Return the losses of an FMU of a drive with `[losses]`.

    Raises
    ------
    edge.InputError
        As `losses.solver.solve`; if there is no rated torque; or if the drive jams, or locks itself under every load,
        which a loss table can't state.
    """
    losses = losses_of(drive)
    model = _Model(drive, _even_angles(drive))
    rows = _rows(model)
    lubricant = losses.lubricant
    if lubricant is not None and all(row[1:] == rows[-1][1:] for row in rows[1:]):
        lubricant = None  # nothing depends on its viscosity
    computed = ModelLosses(
        rows,
        Friction(viscous=losses.input_drag.viscous),
        Friction(coulomb=losses.output_drag.coulomb, viscous=losses.output_drag.viscous),
        lubricant,
        0.0,
        0.0,
        (SHARES[0] * model.rated, model.rated),
        (0.0, 0.0),
        _ripple(drive, rows),
        tuple(sorted(set(losses.from_table.values()))),
    )
    return _compared(model, computed)


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

    def __init__(self, drive: DriveValue, angles: Array) -> None:
        self.drive, self.losses, self.rate, self.ratio = drive, losses_of(drive), sun_rate(drive), abs(drive.ratio)
        self.rated = drive.pair.rated_load("the pair")
        self.loads = self.rated * np.array(SHARES)
        self.angles = angles
        drags = {
            "input_drag": self.losses.input_drag.replace(viscous=0.0),
            "output_drag": Drag(churning=self.losses.output_drag.churning),
        }
        self.starts, self.smooth = dict[tuple[float, ...], Array](), dict[tuple[float, ...], Array]()
        self.contacts = _with_losses(drive, self.losses.replace(**drags))

    def input_torque(self, drive: DriveValue, loads: Array, direction: int, speed: float) -> Array:
        """Return the torque at flange_a in the direction of its motion, shape (loads, angles), N·m.

        `speed` is that of flange_a, rad/s; a drive that jams is refused.
        """
        key = (direction, *loads)
        rubbed = solve(drive, loads, self.angles, direction, speed / abs(self.rate), near=self.starts.get(key))
        if np.isfinite(rubbed.coordinates).all():
            self.starts[key] = rubbed.coordinates
        torque: Array = direction * math.copysign(1.0, self.rate) * rubbed.input_torque
        if np.isnan(torque).any():
            load = loads[np.isnan(torque).any(axis=1)][0]
            mode = "drives" if load * direction > 0.0 else "is back-driven by"
            raise edge.InputError(
                f"[losses]: the drive jams where it {mode} {abs(load):.4g} N*m at {speed * 30.0 / math.pi:.4g} rpm, "
                "which a loss table can't state; state --losses, or leave [losses] out."
            )
        return torque

    def smooth_torque(self, loads: Array, direction: int) -> Array:
        """Return the torque at flange_a without friction, as `input_torque`; solved once for all speeds."""
        key = (direction, *loads)
        if key not in self.smooth:
            self.smooth[key] = self.input_torque(_with_losses(self.drive, Losses()), loads, direction, 0.0)
        return self.smooth[key]

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

    ones = np.ones(load.size)
    rising = np.column_stack([ones, ones / load, -ones])
    falling = np.column_stack([-ones, -ones / load, -ones])
    shares = loss / load
    optimum = linprog([0.0, 0.0, 1.0], np.vstack([rising, falling]), np.concatenate([shares, -shares]))
    return float(optimum.x[0]), float(optimum.x[1])


def _even_angles(drive: DriveValue) -> Array:
    """Return crank angles over an output turn, after which a drive repeats, evenly over crank turns in both frames."""
    turns, count = round(abs(drive.pair.ratio)), _ANGLES
    while math.gcd(count, turns * (turns * turns - 1)) > 1:
        count += 1
    return np.linspace(0.0, 2.0 * math.pi * turns, count, endpoint=False)


def _scattered_angles(drive: DriveValue, count: int) -> Array:
    """Return random crank angles over an output turn, ascending: no two orders look alike there."""
    angles: Array = 2.0 * math.pi * abs(drive.pair.ratio) * np.sort(np.random.default_rng(0).random(count))
    return angles


def _speeds(losses: Losses, drive: DriveValue) -> tuple[float, float, float]:
    """Return rest, the slowest and the fastest speed of flange_a, rad/s, at the lubricant's stated viscosity.

    Friction at rest, which may be another than at the slightest speed, ends at the second: slow enough that the drive
    moves at any temperature from `INPUT_STRIBECK_SPEED` on.
    """
    thickest, thinnest = (_thinning(losses.lubricant, kelvin) for kelvin in _range(drive))
    return 0.0, INPUT_STRIBECK_SPEED * thinnest, LARGEST_SPEED * thickest


def _refined(
    value: Callable[[float], Value],
    ends: tuple[float, float, float],
    change: Callable[[float, Value, tuple[float, Value], tuple[float, Value]], float],
    most: int,
    close: float,
) -> dict[float, Value]:
    """Return values at speeds: those of the ends, and between two moving ones where they are not linear.

    `change` is that of the load's torque at flange_a, as a share, by a speed and its value between two others.
    """
    values = {speed: value(speed) for speed in ends}
    pending = [ends[1:]]
    while pending and len(values) < most:
        low, high = pending.pop(0)
        between = math.sqrt(low * high)
        at = value(between)
        if change(between, at, (low, values[low]), (high, values[high])) > close:
            values[between] = at
            pending += [(low, between), (between, high)]
    return dict(sorted(values.items()))


def _rows(model: _Model) -> tuple[LossRow, ...]:
    """Return the table."""
    teeth = model.loads / model.ratio

    def change(speed: float, row: LossRow, low: tuple[float, LossRow], high: tuple[float, LossRow]) -> float:
        linear = low[1], high[1]
        return max(
            float(np.abs((table_torque((row,), speed, asked) - table_torque(linear, speed, asked)) / teeth).max())
            for asked in (teeth, -teeth)
        )

    return tuple(_refined(model.row, _speeds(model.losses, model.drive), change, _MOST_ROWS, _CLOSE).values())


def _candidate_orders(drive: DriveValue) -> Array:
    """Return orders of the crank's turn relative to the ring: whole ones, and those whole relative to the carrier."""
    ratio, whole = round(drive.pair.ratio), np.arange(1, drive.pair.pins + _BESIDE_PASSAGE + 1)
    lines = np.concatenate([whole * abs(ratio), whole * abs(ratio - 1)])  # of an output turn
    orders: Array = np.unique(lines) / abs(ratio)
    return orders


def _parts(model: _Model, rows: tuple[LossRow, ...], orders: Array, speed: float, shares: Array) -> Array:
    """Return cosine and sine parts of the losses' change over the crank angle, shape (2, 2, loads, orders, 2), N·m.

    It is what the balance loses more than the table, at the torque of the teeth at each angle, but for its mean; loads
    are shares of the rated one. Axes as for `LossRipple`.
    """
    turn, angles = math.copysign(1.0, model.rate), np.multiply.outer(model.angles, orders)
    design = np.column_stack([np.ones(model.angles.size), np.cos(angles), np.sin(angles)])
    parts = np.empty((2, 2, shares.size, orders.size, 2))
    for direction, drives in itertools.product((1, -1), (True, False)):
        loads = (direction if drives else -direction) * model.rated * shares
        asked = model.smooth_torque(loads, direction)
        more = model.input_torque(model.contacts, loads, direction, speed) - table_torque(rows, speed, asked)
        fitted = np.linalg.lstsq(design, more.T, rcond=None)[0][1:]
        parts[int((direction * turn > 0.0) != drives), int(not drives)] = fitted.T.reshape(
            shares.size, 2, orders.size
        ).swapaxes(1, 2)
    return parts


def _ripple(drive: DriveValue, rows: tuple[LossRow, ...]) -> LossRipple | None:
    """Return the change of the losses over the crank angle, with its largest orders.

    It is none without a load, and solved at those of `SHARES`.
    """
    candidates, ends = _candidate_orders(drive), np.array([SHARES[0], SHARES[-1]])
    wide = _Model(drive, _scattered_angles(drive, _ANGLES_OF_AN_ORDER * candidates.size))
    sizes = np.hypot(*np.moveaxis(_parts(wide, rows, candidates, _RIPPLE_SPEED, ends), -1, 0))
    largest = (sizes / (ends * wide.rated / wide.ratio)[:, None]).max(axis=(0, 1, 2))
    chosen = np.sort(np.argsort(-largest)[:MOST_RIPPLE_ORDERS])
    orders = candidates[chosen[largest[chosen] > _LEAST_RIPPLE]]
    if orders.size == 0:
        return None
    model = _Model(drive, _scattered_angles(drive, _ANGLES_OF_AN_ORDER * orders.size + _ANGLES))
    teeth = model.loads / model.ratio

    def change(speed: float, parts: Array, low: tuple[float, Array], high: tuple[float, Array]) -> float:
        share = (speed - low[0]) / (high[0] - low[0])
        off = parts - (1.0 - share) * low[1] - share * high[1]
        return float((np.hypot(off[..., 0], off[..., 1]) / teeth[:, None]).max())

    def at_speed(speed: float) -> Array:
        return _parts(model, rows, orders, speed, np.array(SHARES))

    by_speed = _refined(at_speed, _speeds(model.losses, drive), change, MOST_RIPPLE_SPEEDS, _RIPPLE_CLOSE)
    return LossRipple(
        orders=tuple(orders.tolist()),
        speeds=tuple(by_speed),
        loads=(0.0, *teeth.tolist()),
        parts=np.pad(list(by_speed.values()), [(0, 0)] * 3 + [(1, 0), (0, 0), (0, 0)]).tolist(),
    )


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


def _compared(model: _Model, computed: ModelLosses) -> ModelLosses:
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
                    _differences(model, computed, warm, direction, side * model.rated * np.array(_COMPARED), kelvin)
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
        computed, mean_deviation=mean, angle_deviation=single, temperatures=(compared[0], compared[-1])
    )


def _differences(
    model: _Model, computed: ModelLosses, warm: DriveValue, direction: int, loads: Array, kelvin: float
) -> Array:
    """Return differences of the torque at flange_a from the model's over the load's torque there.

    Shape (speeds, loads, angles); `loads` are torques of the environment on the output, N·m.
    """
    smooth = model.smooth_torque(loads, direction)
    thinning, off = _thinning(model.losses.lubricant, kelvin), list[Array]()
    for speed in (0.0, INPUT_STRIBECK_SPEED, 0.1 * LARGEST_SPEED, LARGEST_SPEED):
        drag = computed.output_friction.coulomb + computed.output_friction.viscous * speed / model.ratio
        asked = smooth * (1.0 + drag / (direction * loads))[:, None]
        of_fmu = _of_fmu(model, computed, asked, direction, speed * thinning) + computed.input_friction.viscous * speed
        off.append(model.input_torque(warm, loads, direction, speed) - of_fmu)
    return np.array(off) / (np.abs(loads) / model.ratio)[:, None]


def _of_fmu(model: _Model, computed: ModelLosses, asked: Array, direction: int, reduced: float) -> Array:
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
    lost = table_torque(computed.rows, reduced, asked) - asked
    if computed.ripple is not None:
        turn = direction * math.copysign(1.0, model.rate)
        for k, mean in enumerate(asked.mean(axis=1).tolist()):
            lost[k] = np.maximum(lost[k] + computed.ripple.torque(model.angles, turn * mean, mean > 0.0, reduced), 0.0)
    needed: Array = asked + lost
    return needed
