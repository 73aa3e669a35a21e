"""Numbers of a joint from a drive: play, wind-up and orders of its teeth, friction from its losses, and draws."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.analysis import series_compliance, solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.constants import DAMPING_TIME, INPUT_PRESLIDING_ANGLE, OUTPUT_PRESLIDING_ANGLE
from cycloid_fmu.fmu.model_losses import ModelLosses, model_losses
from cycloid_fmu.joint.document import Number, number, unknown
from cycloid_fmu.surfaces.posterior import drawn_surfaces
from cycloid_fmu.surfaces.sampling import Tolerances, sample_surface

Array = NDArray[np.float64]
LOADS = (0.01, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Torques of the wind-up, of the rated one."""
ORDERS_AT = 2
"""Number of that at which the transmission error and the play are resolved into orders."""
EACH_TURN = 24
ODD = 13  # more angles, so that their number has no factor in common with those of teeth and pins
WINDUP_ANGLES = 61  # over a turn of the output, which resolve no orders: the wind-up is a mean
ORDERS = 5
DRAWS = 100
SPEED = 100.0  # rad/s of the motor, 955 rpm
_RANGE = (2.5, 97.5)


def angles_of(drive: DriveValue, angles: int | None = None) -> Array:
    """Return crank angles over one turn of the output, rad; as many as the orders of the pins need."""
    turns = abs(drive.pair.ratio)
    count = round(EACH_TURN * turns) + ODD if angles is None else angles
    return np.linspace(0.0, 2.0 * math.pi * turns, count, endpoint=False)


def waves(drive: DriveValue, values: Array) -> tuple[Array, Array]:
    """Return amplitudes and phases of the orders 0, 1, … of a turn: A sin(order · output angle + phase)."""
    found = np.fft.rfft(values) * 2.0 / values.size
    found[0] *= 0.5
    side = math.copysign(1.0, drive.pair.ratio)
    return np.abs(found), 0.5 * math.pi + side * np.angle(found)


class Teeth:
    """Play, wind-up and orders of a drive's teeth at one angle after the other, solved once.

    Raises
    ------
    edge.InputError
        If there is no rated torque, or it can't be carried.
    """

    def __init__(self, drive: DriveValue, crank_angle: Array, compliance: float, workers: int) -> None:
        rated = drive.pair.rated_load()
        self.drive, self.loads = drive, rated * np.array(LOADS)
        load = self.loads[ORDERS_AT]
        found = solve(drive, [load, -load], crank_angle, with_stiffness=False, workers=workers)
        high, low = found.transmission_error
        self.error, self.loose = 0.5 * (high + low), high - low - (high - low).mean()
        few = np.linspace(0.0, 2.0 * math.pi * abs(drive.pair.ratio), WINDUP_ANGLES, endpoint=False)
        found = solve(drive, [*self.loads, *-self.loads], few, with_stiffness=False, workers=workers)
        half = 0.5 * (found.transmission_error[: len(LOADS)] - found.transmission_error[len(LOADS) :]).mean(axis=1)
        self.play = float(np.mean(found.backlash))  # NaN where the teeth interfere
        self.windup = half - 0.5 * self.play + compliance * self.loads
        self.runs = math.isfinite(self.play) and bool((np.diff(self.windup, prepend=0.0) > 0.0).all())

    def orders(self, count: int) -> dict[str, list[int]]:
        """Return the numbers of the largest orders of the transmission error and of the play, ascending."""
        largest = {}
        for name, values in (("te_orders", self.error), ("play_orders", self.loose)):
            sizes = waves(self.drive, values)[0]
            largest[name] = sorted(int(k) for k in np.argsort(-sizes, kind="stable")[:count])
        return largest

    def values(self, orders: Mapping[str, Sequence[int]]) -> dict[str, float]:
        """Return the values by dotted name, with given orders."""
        found = {"play": self.play, "stiffness.0.torque": 0.0, "stiffness.0.windup": 0.0}
        for k, (load, windup) in enumerate(zip(self.loads, self.windup, strict=True), 1):
            found |= {f"stiffness.{k}.torque": float(load), f"stiffness.{k}.windup": float(windup)}
        for name, values in (("te_orders", self.error), ("play_orders", self.loose)):
            sizes, phases = waves(self.drive, values)
            for k, order in enumerate(orders[name]):
                row = {"order": float(order), "amplitude": float(sizes[order]), "phase": float(phases[order])}
                found |= {f"{name}.{k}.{member}": value for member, value in row.items()}
        return found

    def left_out(self, orders: Mapping[str, Sequence[int]]) -> tuple[str, ...]:
        """Return what the orders leave out, one sentence each."""
        texts = []
        for what, name, values in (
            ("transmission error", "te_orders", self.error),
            ("play", "play_orders", self.loose),
        ):
            sizes = waves(self.drive, values)[0]
            rest = np.delete(sizes, orders[name])
            arcsec = math.sqrt(0.5 * float(np.sum(rest**2))) * edge.ARCSEC
            torque = self.loads[ORDERS_AT]
            texts.append(f"Other orders of the {what} at {torque:.4g} N·m: {arcsec:.2g} arcsec (rms).")
        return tuple(texts)


def drawn(
    drive: DriveValue,
    tolerances: Tolerances | None,
    count: int | None,
    seed: int,
    solved: Callable[[DriveValue], Teeth],
    progress: Callable[[int], None],
) -> list[Teeth]:
    """Return the teeth of drives from the posterior of a fit, or within tolerances; none without either.

    Those whose teeth interfere are left out.
    """
    number_of = DRAWS if count is None else count
    if tolerances is not None:
        surfaces = (sample_surface(drive.pair, tolerances, seed + k) for k in range(number_of))
        drives = (DriveValue(drive.pair.nominal, surface, drive.first_stage) for surface in surfaces)
    elif drive.surface.covariance is not None:
        drives = (drive.with_surface(one) for one in drawn_surfaces(drive.pair, drive.surface, number_of, seed))
    else:
        return []
    found = []
    for each in drives:
        found.append(solved(each))
        progress(1)
    return [teeth for teeth in found if teeth.runs]


def rows_of(
    values: Mapping[str, float], teeth: Sequence[Teeth], orders: Mapping[str, Sequence[int]]
) -> list[dict[str, float]]:
    """Return the draws after the most likely values; phases are those within half a turn of its own."""
    rows = [dict(values)]
    for each in teeth:
        row = each.values(orders)
        for name in row:
            if name.endswith(".phase"):
                off = row[name] - values[name]
                row[name] -= 2.0 * math.pi * round(off / (2.0 * math.pi))
        rows.append(row)
    return rows


def with_intervals(values: Mapping[str, float], rows: Sequence[Mapping[str, float]], origin: str) -> dict[str, Number]:
    """Return numbers, with the range of 95 % of the draws where there are draws."""
    found = {}
    for name, value in values.items():
        several = np.array([row[name] for row in rows[1:]])
        spread = several.size > 1 and np.ptp(several) > 0.0
        low, high = np.percentile(several, _RANGE) if spread else (0.0, 0.0)
        found[name] = number(value, origin, (min(low, value), max(high, value)) if spread else None)
    return found


def damping(windup: Array, loads: Array) -> Number:
    """Return the damping of the teeth as an FMU has it: a fixed time of the stiffness at the rated torque."""
    return number(DAMPING_TIME * float((loads[-1] - loads[-2]) / (windup[-1] - windup[-2])), "predicted")


def friction(drive: DriveValue, speed: float) -> tuple[dict[str, Number], tuple[str, ...]]:
    """Return friction from `[losses]`, with efficiencies at a speed of the motor (rad/s), and what it leaves out."""
    names = [f"friction.{side}.{name}" for side in ("motor", "output") for name in _LAW]
    names += [f"friction.motor.{name}" for name in ("efficiency_driving", "efficiency_back_driving")]
    missing = "[losses]" if drive.pair.losses is None else "[supports]" if drive.pair.supports is None else ""
    if missing:
        reason = f"the pair states no {missing}"
        return {name: unknown(reason) for name in (*names, "friction.output.load_share")}, ()
    found = model_losses(drive)
    table = np.array(found.rows)
    at = [float(np.interp(speed, table[:, 0], column)) for column in table[:, 1:].T]
    motor, output = _without_load(found), found.output_friction
    values = {
        **{f"friction.motor.{name}": value for name, value in motor.items()},
        "friction.motor.presliding_angle": INPUT_PRESLIDING_ANGLE,
        "friction.motor.efficiency_driving": at[0],
        "friction.motor.efficiency_back_driving": at[1],
        "friction.output.coulomb": output.coulomb,
        "friction.output.viscous": output.viscous,
        "friction.output.presliding_angle": OUTPUT_PRESLIDING_ANGLE,
    }
    rest, low, high = (100.0 * float(end) for end in (table[0, 1], table[1:, 1].min(), table[1:, 1].max()))
    numbers = {name: number(value, "predicted") for name, value in values.items()}
    for name in ("friction.output.stribeck", "friction.output.stribeck_speed"):
        numbers[name] = unknown("[losses] states no Stribeck friction of the output's own drag")
    numbers["friction.output.load_share"] = unknown("losses that grow with the load are in the motor's efficiencies")
    text = (
        f"Efficiency over the speed: that at {speed:.4g} rad/s of the motor; driving it is {low:.3g} to {high:.3g} %, "
        f"at rest {rest:.3g} %."
    )
    return numbers, (text, "Friction over the temperature of the lubricant.")


_LAW = ("coulomb", "stribeck", "stribeck_speed", "viscous", "presliding_angle")


def _without_load(found: ModelLosses) -> dict[str, float]:
    """Return Coulomb, Stribeck and viscous friction of the motor nearest to the table's torque without a load."""
    from scipy.optimize import nnls

    table = np.array(found.rows)
    speed = table[:, 0]
    drag = 0.5 * (table[:, 3] / table[:, 1] + table[:, 4] * table[:, 2])
    (coulomb, viscous), _ = nnls(np.column_stack([np.ones(speed.size - 1), speed[1:]]), drag[1:])
    return {
        "coulomb": float(coulomb),
        "stribeck": max(float(drag[0] - coulomb), 0.0),
        "stribeck_speed": float(speed[1]),
        "viscous": float(viscous) + found.input_friction.viscous,
    }


def compliance_of(drive: DriveValue, series: float) -> float:
    """Return the compliance in series: that stated, or that up to a catalogue's stiffness, rad/(N·m)."""
    return series if series > 0.0 else series_compliance(drive)
