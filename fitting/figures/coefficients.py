"""Coefficients of a drive's `[losses]` from runs on the bench, as far as these can tell them apart.

The torque of a run is predicted by the friction in the balance (`cycloid_fmu.losses`) at its loads and speeds, and
fitted with the derivatives by the coefficients (Gauss and Newton). Most coefficients act alike: two that grow in
proportion to the load can't both be found. The first of its kind is fitted, and the others are held as stated.
"""

from __future__ import annotations

import dataclasses
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

from cycloid_fmu import edge
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.losses import Drag, Losses
from cycloid_fmu.losses.figures import breakaway
from cycloid_fmu.losses.sensitivity import sensitivity
from cycloid_fmu.losses.solver import Rubbed, losses_of, solve
from fitting.figures.figure import Figure
from fitting.figures.friction import Fit, FrictionFit, Stretches, fit_columns, loop_growth, separate

Array = NDArray[np.float64]
ORDER = (
    "flank.friction_coefficient",
    "input_drag.coulomb",
    "input_drag.viscous",
    "pin.friction_coefficient",
    "output_contact.friction_coefficient",
    "output_roller.friction_coefficient",
    "turning_arm.friction_coefficient",
    "turning_arm.load_factor",
    "crank_shaft.friction_coefficient",
    "crank_shaft.load_factor",
    "main.friction_coefficient",
    "main.load_factor",
)
"""Coefficients in the order in which they are taken, as far as the file states them; drags of the input always."""
MOST = 3  # coefficients
STATIC = "flank.static_friction_coefficient"
_LOOP, _ROUGHEST, _JAMS = 10.0, 1.5, 1e3  # N·m without a rated torque; largest coefficient; growth of a drive that jams
_ANGLES = 29  # crank angles of a prediction over one turn: a prime, so that it is not in step with the pins
_SPEEDS, _LOADS = 4, 5  # of the grid that is predicted
_ITERATIONS, _CLOSE = 8, 1e-4


def loss_coefficients(fit: FrictionFit, drive: DriveValue, loop: str | os.PathLike[str] | None = None) -> FrictionFit:
    """Return a fit of friction with the coefficients of a drive's [losses] that its runs can tell apart.

    Parameters
    ----------
    fit
        Of `fitting.friction`: its stretches, its loads, and the torques of the inertia and of a drift, whose sizes are
        fitted again with the coefficients.
    drive
        The drive as stated, with [losses] and [supports], without a first stage. What is not fitted is held.
    loop
        Figures of loops, `cycloid-fit metrics -o`, whose friction per load is that of the flanks from rest.

    Returns
    -------
    fit
        With `coefficients`, {"flank.friction_coefficient": …, "input_drag.coulomb": …}, at most three with 95 %
        intervals, and notes on those that act alike and are held.

    Raises
    ------
    edge.InputError
        If no friction is stated, there is a first stage, or the drive jams at a load of the runs.

    Examples
    --------
    >>> import numpy as np, cycloid_fmu as cy, fitting
    >>> pair = cy.Pair(
    ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm",
    ...     supports={"kind": "cranks", "count": 3, "circle_radius": "36 mm", "main": {"stiffness": "900 N/um"}},
    ...     losses={"flank": {"friction_coefficient": 0.06}},
    ... )
    >>> time = np.linspace(0.0, 60.0, 6001)
    >>> speed = 2.0 * np.sin(np.pi * time / 30.0)
    >>> angle = 60.0 / np.pi * (1.0 - np.cos(np.pi * time / 30.0))
    >>> run = fitting.Run(input_angle=0.0, output_angle=angle, torque=3.9 * np.sign(speed), time=time)
    >>> fit = fitting.loss_coefficients(fitting.friction(run), cy.Drive(pair))
    >>> round(fit.coefficients["input_drag.coulomb"].value, 3)
    0.1
    """
    figures, notes = _coefficients(fit, drive)
    if loop is not None:
        moved = with_coefficients(drive, {name: figure.value for name, figure in figures.items()})
        at_rest, remarks = _static_of(moved, loop)
        figures, notes = figures | at_rest, notes + remarks
    return dataclasses.replace(fit, coefficients=figures, notes=(*fit.notes, *notes))


def _coefficients(fit: FrictionFit, drive: DriveValue) -> tuple[dict[str, Figure], list[str]]:
    losses_of(drive)
    if drive.first_stage is not None:
        raise edge.InputError("a drive with a first stage: coefficients from runs are those of a cycloid stage alone.")
    used = ~np.isnan(fit.fitted)
    renumbered = np.unique(fit.stretches.block[used], return_inverse=True)[1]
    stretches = dataclasses.replace(fit.stretches.chosen(used), block=renumbered)
    load, measured = _loads_of(fit, stretches)
    others = {} if measured else _offsets(fit, stretches)
    others |= {name: torque[used] for name, torque in fit.removed.items() if torque[used].any()}
    _, by = _predict(drive, stretches, load, measured)
    chosen, alike = _separable(by, list(others.values()), drive)
    notes = [
        f"{name} acts like {edge.listed(chosen)} in these runs and is held as stated, {_value(drive, name):g}."
        for name in alike
    ]
    values = {name: _value(drive, name) for name in chosen}
    result: Fit | None = None
    while chosen:
        result, values = _fitted(drive, stretches, load, measured, values, others)
        if not (negative := [name for name in chosen if values[name] < 0.0]):
            break
        chosen = [name for name in chosen if name != negative[0]]
        notes.append(f"{negative[0]} is not resolved and is held as stated, {_value(drive, negative[0]):g}.")
        values = {name: _value(drive, name) for name in chosen}
    if result is None or not chosen:
        return {}, [*notes, "The runs resolve no coefficient of [losses]."]
    notes += [f"The interval of {n} contains zero." for n in chosen if values[n] < result.linear({n: 1.0})[1]]
    return {name: _figure(name, values[name], result, drive, fit.speeds) for name in chosen}, notes


def _static_of(drive: DriveValue, loop: str | os.PathLike[str]) -> tuple[dict[str, Figure], list[str]]:
    """Return the flanks' coefficient at rest with which loops have the friction per load that was measured."""
    from scipy.optimize import brentq

    growth, _ = loop_growth(loop)
    angle = np.linspace(0.0, 2.0 * np.pi, _ANGLES, endpoint=False)
    load = drive.pair.rated_torque or _LOOP

    def beyond(coefficient: float) -> float:
        moved = with_coefficients(drive, {STATIC: coefficient})
        return min(breakaway(moved, load, angle).per_load, _JAMS) - growth.value

    if not beyond(0.0) < 0.0 < beyond(_ROUGHEST):
        return {}, [f"{loop}: no coefficient of the flanks at rest gives a friction per load of {growth.value:.3g}."]
    value = float(brentq(beyond, 0.0, _ROUGHEST, xtol=1e-5))
    slope = (beyond(1.02 * value) - beyond(0.98 * value)) / (0.04 * value)
    text = "[losses.flank] static_friction_coefficient by loops, with all other coefficients as the file states them"
    half = growth.uncertainty / abs(slope)
    return {STATIC: Figure(value, half, "1", text, None, "", growth.count, growth.counted)}, [
        f"{STATIC} has all of the loops' growth with load that the other coefficients at rest do not have."
    ]


def _loads_of(fit: FrictionFit, stretches: Stretches) -> tuple[Array, bool]:
    """Return the torque of the environment on the output at each stretch, and whether it was measured."""
    if np.isfinite(stretches.load).all():
        return -stretches.load, True
    by_number = np.array([fit.loads.get(source, 0.0) for source in fit.data])
    return -by_number[stretches.recording], False


def _offsets(fit: FrictionFit, stretches: Stretches) -> dict[str, Array]:
    """Return columns of the sensor's zero where a single torque drives: one, or with loads one of each recording."""
    if not fit.loads:
        return {"offset": np.ones(stretches.speed.size)}
    numbers = np.unique(stretches.recording)
    return {f"offset {k}": (stretches.recording == k).astype(float) for k in numbers}


def _grid(values: Array, most: int) -> Array:
    """Return places over the range of values, 0 among them if it is inside; two at least."""
    low, high = float(values.min()), float(values.max())
    if high - low < 1e-6 * max(abs(low), abs(high), 1e-9):
        return np.array([low, low + max(abs(low), 1e-3)])
    places = np.linspace(low, high, most)
    return np.unique([*places, 0.0]) if low < 0.0 < high else np.asarray(places)


def _predict(drive: DriveValue, stretches: Stretches, load: Array, measured: bool) -> tuple[Array, dict[str, Array]]:
    """Return the torque of each stretch by the drive's friction, and its derivatives by the coefficients, N·m.

    By interpolation over loads and speeds.
    """
    ratio, angle = drive.ratio, np.linspace(0.0, 2.0 * np.pi, _ANGLES, endpoint=False)
    torque, by = np.empty(load.size), dict[str, Array]()
    for sign in np.unique(np.sign(stretches.speed)):
        here = np.sign(stretches.speed) == sign
        loads, speeds = _grid(load[here], _LOADS), _grid(np.abs(stretches.speed[here]), _SPEEDS)
        direction = int(np.sign(ratio * sign))
        rows: list[list[dict[str, float]]] = []
        for speed in np.abs(ratio) * speeds:
            rubbed = solve(drive, loads, angle, direction, float(speed))
            if np.isnan(rubbed.input_torque).any():
                raise edge.InputError("the drive jams at a load of the runs with the friction that its file states.")
            row = []
            for k in range(loads.size):
                slopes = _slopes(drive, rubbed, k)
                slopes |= {"input_drag.coulomb": direction, "input_drag.viscous": direction * float(speed)}
                row.append({"": float(rubbed.input_torque[k].mean()), **slopes})
            rows.append(row)
        at = np.column_stack([np.abs(stretches.speed[here]), load[here]])
        for name in {name: None for row in rows for each in row for name in each}:
            values = np.array([[ratio * each.get(name, 0.0) for each in row] for row in rows])
            target = torque if name == "" else by.setdefault(name, np.zeros(load.size))
            target[here] = RegularGridInterpolator((speeds, loads), values)(at)
    return torque + load if measured else torque, by


def _slopes(drive: DriveValue, rubbed: Rubbed, load: int) -> dict[str, float]:
    """Return the mean derivatives of the crank's torque; none without a load, where nothing presses the flanks."""
    try:
        return {name: float(values.mean()) for name, values in sensitivity(drive, rubbed, load).items()}
    except ValueError:
        if rubbed.motion.torque[load] != 0.0:
            raise edge.InputError(
                f"the balance is singular at {rubbed.motion.torque[load]:g} N·m: the drive jams."
            ) from None
        return {}


def _separable(by: Mapping[str, Array], others: Sequence[Array], drive: DriveValue) -> tuple[list[str], list[str]]:
    """Return the coefficients whose columns differ from each other's, at most three, and those that act like them."""
    chosen, alike = list[str](), list[str]()
    stated = [name for name in ORDER if name in by and _is_stated(drive, name)]
    for name in stated:
        if len(chosen) < MOST and separate(by[name], [*others, *(by[other] for other in chosen)]):
            chosen.append(name)
        elif np.abs(by[name]).max() > 0.0:
            alike.append(name)
    return chosen, alike


def _is_stated(drive: DriveValue, name: str) -> bool:
    table, key = name.split(".")
    return table == "input_drag" or bool(getattr(getattr(losses_of(drive), table), key, None))


def _value(drive: DriveValue, name: str) -> float:
    table, key = name.split(".")
    return float(getattr(getattr(losses_of(drive), table), key))


def with_coefficients(drive: DriveValue, values: Mapping[str, float]) -> DriveValue:
    """Return a drive with other coefficients, {"flank.friction_coefficient": 0.05, …}."""
    losses = losses_of(drive)
    for name, value in values.items():
        table, key = name.split(".")
        stated: Any = getattr(losses, table)
        changes: dict[str, Any] = {key: max(value, 0.0)}
        if getattr(stated, "friction", None) is not None:
            changes |= {"friction": None}
        losses = losses.replace(**{table: stated.replace(**changes)})
    return DriveValue(drive.pair.replace(losses=losses), drive.surface, drive.first_stage)


def _fitted(
    drive: DriveValue,
    stretches: Stretches,
    load: Array,
    measured: bool,
    values: Mapping[str, float],
    others: Mapping[str, Array],
) -> tuple[Fit, dict[str, float]]:
    """Return the fit of the runs by coefficients, from given values of them, and the coefficients."""
    now = dict(values)
    for _ in range(_ITERATIONS):
        predicted, by = _predict(with_coefficients(drive, now), stretches, load, measured)
        linear = sum((max(now[name], 0.0) * by[name] for name in now), np.zeros(load.size))
        residual = dataclasses.replace(stretches, torque=stretches.torque - predicted + linear)
        result = fit_columns({**{name: by[name] for name in now}, **others}, residual)
        before, now = now, {name: float(result.values[result.names.index(name)]) for name in now}
        if all(abs(now[name] - before[name]) <= _CLOSE * abs(now[name]) for name in now):
            break
    return result, now


def _figure(name: str, value: float, result: Fit, drive: DriveValue, speeds: tuple[float, float]) -> Figure:
    table, key = name.split(".")
    kind = type(getattr(losses_of(drive), table)) if table != "input_drag" else Drag
    unit = edge.unit_of_field(kind.model_fields[key]) or "1"
    uncertainty = result.linear({name: 1.0})[1]
    text = f"[{Losses.__name__.lower()}.{table}] {key}, with all other coefficients as the file states them"
    return Figure(value, uncertainty, unit, text, speeds, "rad/s", result.blocks, "blocks", degrees=result.degrees)
