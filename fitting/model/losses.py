"""Friction of the drive in a fit: curves of a turning crank with that of `[losses]`, and its unknown coefficients.

A friction that the pair file takes from the table of materials is known within a range: its logarithm is an unknown
whose prior has the range as that of two standard deviations either way. Friction stated as numbers is as stated.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.analysis import sensitivity
from cycloid_fmu.contact.transmission import Sensitivity
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.friction_values import VALUES
from cycloid_fmu.geometry.losses import LARGEST_COEFFICIENT, Losses
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.losses.sensitivity import motion_sensitivity
from fitting.transmission_error.curve import Curve

Array = NDArray[np.float64]

BENCH_HYSTERESIS = 1e-5
"""Usual size of half the difference between the directions that a bench makes beside the friction of the drive, rad."""
SLOW = 1e-3
"""Speed of the crank of recordings without times, rad/s: friction is that of slow motion."""
_OF_FRICTION = "_friction_coefficient"


def rubs(pair: Pair) -> bool:
    """Return whether curves of a pair are those with the friction of its [losses], which needs [supports]."""
    return pair.losses is not None and pair.supports is not None


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
    drive: DriveValue, torque: Array, crank_angle: Array, curve: Curve, nominal: Pair
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

    Raises
    ------
    edge.InputError
        If the drive can't carry a torque or jams.
    """
    names = unknown_coefficients(nominal)
    losses, stated = drive.pair.losses, nominal.losses
    if losses is None or stated is None or drive.pair.supports is None or curve.branch:
        return sensitivity(drive, torque, crank_angle), np.zeros((torque.size, len(names)))
    if losses.first_stage is not None:
        drive = DriveValue(drive.pair.replace(losses=losses.replace(first_stage=None)), drive.surface)
    speed = curve.crank_speed or SLOW
    with_friction = motion_sensitivity(drive, torque, crank_angle, curve.direction, speed)
    columns = [_by_logarithm(stated, losses, name, with_friction.by_coefficient) for name in names]
    return with_friction.motion, np.array(columns).T if names else np.zeros((torque.size, 0))


def _by_logarithm(stated: Losses, losses: Losses, name: str, by: dict[str, Array]) -> Array:
    """Return derivatives by the change of a coefficient's logarithm, shape (points,), rad."""
    table = name.removesuffix(_OF_FRICTION)
    friction, (half, half_at_rest) = getattr(losses, table), _ranges(stated, name)
    at_rest = by[f"{table}.static_friction_coefficient"] * friction.static * half_at_rest / half
    return by[f"{table}.friction_coefficient"] * friction.friction_coefficient + at_rest


def needs_times(pair: Pair, curves: Sequence[Curve]) -> list[str]:
    """Return a note where friction depends on the speed and recordings have no times; none otherwise."""
    losses = pair.losses
    if not rubs(pair) or losses is None:
        return []
    stated = [getattr(losses, name) for name in type(losses).model_fields]
    if not any(getattr(one, "stribeck_speed", None) for one in stated):
        return []
    without = dict.fromkeys(c.source for c in curves if not c.branch and c.crank_speed is None)
    return [f"{source}: it has no times, so its friction is taken as that of slow motion." for source in without]
