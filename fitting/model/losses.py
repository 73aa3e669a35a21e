"""Friction of the drive in a fit: curves of a turning crank with that of `[losses]`, and its unknown coefficients.

A friction that the pair file takes from the table of materials is known within a range: its logarithm is an unknown
whose prior has the range as that of two standard deviations either way. Friction stated as numbers is as stated.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.analysis import sensitivity
from cycloid_fmu.contact.transmission import Sensitivity
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.geometry.friction_values import VALUES
from cycloid_fmu.geometry.losses import LARGEST_COEFFICIENT, Friction, Losses
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.losses.sensitivity import motion_sensitivity
from fitting.transmission_error.curve import Curve

Array = NDArray[np.float64]

BENCH_HYSTERESIS = 1e-5
"""Usual size of half the difference between the directions that a bench makes beside the friction of the drive, rad."""
SLOW = 1e-3
"""Speed of the crank of recordings without times, rad/s: friction is that of slow motion."""
SCATTER_OF_COEFFICIENTS = 1.25
"""Distance of fitted coefficients from the truth in standard errors of the linear model, rms of 20 random drives; of
110 fits from the truth it is 1.1, so a part is that searches end a little beside the optimum
(docs/identify_coverage.md)."""
_ALIKE = 0.9  # correlation of two unknowns
_OF_FRICTION = "_friction_coefficient"


def unknown_coefficients(pair: Pair) -> tuple[str, ...]:
    """Return the unknown friction coefficients, such as `flank_friction_coefficient`: those with a range."""
    if pair.losses is None or pair.supports is None:
        return ()
    return tuple(f"{table}{_OF_FRICTION}" for table in pair.losses.from_table)


def is_coefficient(name: str) -> bool:
    """Return whether an unknown is one of `unknown_coefficients`."""
    return name.endswith(_OF_FRICTION)


def key_of(name: str) -> str:
    """Return a coefficient's name in `cycloid-fit friction`, such as `flank.friction_coefficient`."""
    return f"{name.removesuffix(_OF_FRICTION)}.{_OF_FRICTION[1:]}"


def _ranges(losses: Losses, name: str) -> tuple[float, float]:
    """Return half the range of a coefficient's logarithm, at speed and at rest."""
    value = VALUES[losses.from_table[name.removesuffix(_OF_FRICTION)]]
    return 0.5 * math.log(value.high / value.low), 0.5 * math.log(value.static_high / value.static_low)


def size_of(pair: Pair, name: str) -> float:
    """Return the prior standard deviation of a coefficient's logarithm."""
    assert pair.losses is not None
    return 0.5 * _ranges(pair.losses, name)[0]


def coefficient_of(pair: Pair, name: str, change: float) -> float:
    """Return a coefficient at speed whose logarithm is larger than the stated one's by a change."""
    assert pair.losses is not None
    table = getattr(losses_with(pair.losses, {name: change}), name.removesuffix(_OF_FRICTION))
    return float(table.friction_coefficient)


def losses_with(losses: Losses, changes: dict[str, float], *, rounded: bool = False) -> Losses:
    """Return losses with other coefficients.

    Parameters
    ----------
    losses
        As the pair file states them.
    changes
        {name as of `unknown_coefficients`: change of the logarithm of the coefficient at speed}; the one at rest moves
        with it, so that both are at the ends of their ranges together.
    rounded
        Whether the coefficients have six digits.
    """
    changed = {}
    for name, change in changes.items():
        table = name.removesuffix(_OF_FRICTION)
        stated, (half, half_at_rest) = getattr(losses, table), _ranges(losses, name)
        if change == 0.0:
            continue
        values = {
            "friction_coefficient": stated.friction_coefficient * math.exp(change),
            "static_friction_coefficient": stated.static * math.exp(change * half_at_rest / half),
        }
        values = {key: min(value, LARGEST_COEFFICIENT) for key, value in values.items()}
        if rounded:
            values = {key: float(f"{value:.6g}") for key, value in values.items()}
        changed[table] = stated.replace(friction=None, **values)
    return losses.replace(**changed) if changed else losses


def curve_sensitivity(
    drive: DriveValue,
    torque: Array,
    crank_angle: Array,
    curve: Curve,
    nominal: Pair,
    first_stage: FirstStage | None = None,
    near: Array | None = None,
) -> tuple[Sensitivity, Array]:
    """Return the transmission error of a curve and its derivatives, the second by `unknown_coefficients`.

    Where the crank turns it is that with the friction of [losses]; a branch of a loop has a friction of its own.

    Parameters
    ----------
    drive
        The drive without its first stage.
    torque, crank_angle
        Of the points, N·m and rad, shape (points,).
    curve
        Its direction and speed count.
    nominal
        The pair as its file states it.
    first_stage
        What is before the drive: friction changes the cranks' torque, and so what the carrier takes of the load.
    near
        On bearings, `coordinates` of these points of a drive near this one, to start from.

    Raises
    ------
    edge.InputError
        If the drive can't carry a torque or jams.
    """
    names = unknown_coefficients(nominal)
    losses, stated = drive.pair.losses, nominal.losses
    if losses is None or stated is None or drive.pair.supports is None or curve.branch:
        return sensitivity(drive, torque, crank_angle, near=near), np.zeros((torque.size, len(names)))
    if losses.first_stage is not None:
        drive = DriveValue(drive.pair.replace(losses=losses.replace(first_stage=None)), drive.surface)
    speed = curve.crank_speed or SLOW
    with_friction = motion_sensitivity(drive, torque, crank_angle, curve.direction, speed, near=near)
    motion = with_friction.motion
    if first_stage is not None:
        more = _more_load(losses, first_stage, curve.direction, with_friction.crank_torque, torque, nominal.gear_teeth)
        error = motion.transmission_error + motion.by_torque * more * torque
        motion = dataclasses.replace(motion, transmission_error=error)
    columns = [_by_logarithm(stated, losses, name, with_friction.by_coefficient) for name in names]
    return motion, np.array(columns).T if names else np.zeros((torque.size, 0))


def _more_load(
    losses: Losses, stage: FirstStage, direction: int, crank_torque: Array, torque: Array, teeth: int
) -> float:
    """Return how much more load the cycloid stage has with friction than without, as a share.

    Its carrier takes M = T + τ_sun - τ of the load T, where τ = M/z_c without friction; of both the means.
    """
    loss = 0.0 if losses.first_stage is None else losses.first_stage.share(stage.sun_teeth, stage.planet_teeth)
    by_load = float(crank_torque.mean() / torque.mean())
    of_sun = stage.sun_share * (1.0 / (1.0 - loss) if direction * crank_torque.mean() > 0.0 else 1.0 - loss)
    return (1.0 + (1.0 + stage.sun_share) / teeth) / (1.0 + (1.0 + of_sun) * by_load) - 1.0


def _by_logarithm(stated: Losses, losses: Losses, name: str, by: dict[str, Array]) -> Array:
    """Return derivatives by the change of a coefficient's logarithm, shape (points,), rad."""
    table = name.removesuffix(_OF_FRICTION)
    friction, (half, half_at_rest) = getattr(losses, table), _ranges(stated, name)
    at_rest = by[f"{table}.static_friction_coefficient"] * friction.static * half_at_rest / half
    found: Array = by[f"{table}.friction_coefficient"] * friction.friction_coefficient + at_rest
    return found


def friction_notes(pair: Pair, curves: Sequence[Curve]) -> list[str]:
    """Return notes on what a fit takes as known of a drive's friction, and on recordings that hardly show it."""
    losses = pair.losses
    if losses is None:
        return []
    if pair.supports is None:
        return ["[losses] is not used: friction depends on the bearings' forces, and [supports] is missing."]
    tables = {name: one for name in type(losses).model_fields if (one := getattr(losses, name)) is not None}
    numbers = [
        name
        for name, table in tables.items()
        if isinstance(table, Friction)
        and name not in losses.from_table
        and any(getattr(table, n) for n in table.linear_in)
    ]
    notes = []
    if numbers:
        notes.append(
            f"[losses] states the friction of {edge.listed(numbers)} as numbers: they are held, and no interval allows "
            'for their errors. Sliding friction by a pair of materials, friction = "…", is fitted within its range.'
        )
    if losses.from_table:
        notes.append(
            f"Intervals of friction coefficients are {SCATTER_OF_COEFFICIENTS:g} times those of the linear model, as "
            "wide as fits of random drives need."
        )
    running = [c for c in curves if not c.branch]
    ways = {(np.sign(c.torque), c.direction) for c in running}
    if losses.from_table and len(ways) == len({sign for sign, _ in ways}):
        notes.append(
            "Each side of the teeth was loaded in one direction only, where friction acts like compliance: run a load "
            "in both directions."
        )
    if any(getattr(table, "stribeck_speed", None) for table in tables.values()):
        without = dict.fromkeys(c.source for c in running if c.crank_speed is None)
        notes += [f"{source}: it has no times, so its friction is taken as that of slow motion." for source in without]
    return notes


def separation_notes(names: Sequence[str], covariance: Array, fitted: Sequence[str]) -> list[str]:
    """Return a note on each fitted coefficient that curves hardly separate from another unknown.

    `names` are those of the unknowns in the covariance, which the scatter of single pins and teeth follows.
    """
    notes, deviations = [], np.sqrt(np.diag(covariance))
    for name in (n for n in fitted if is_coefficient(n)):
        at = list(names).index(name)
        correlation = covariance[at] / (deviations * deviations[at])
        correlation[at] = 0.0
        other = int(np.argmax(np.abs(correlation)))
        if abs(correlation[other]) > _ALIKE:
            notes.append(
                f"{key_of(name)} and {names[other]} act alike in these curves (correlation {correlation[other]:.2f}): "
                "the interval of each allows for the other."
            )
    return notes
