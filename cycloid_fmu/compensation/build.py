"""From a drive to its compensator."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.compensation.compensator import Compensator
from cycloid_fmu.compensation.inverse import Inverse, Model, inverse_of
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import ArgumentError, InputError
from cycloid_fmu.fmu.chain import with_chain
from cycloid_fmu.fmu.constants import LARGEST_LOAD
from cycloid_fmu.fmu.friction import Law, factor
from cycloid_fmu.fmu.friction_file import Friction
from cycloid_fmu.fmu.variables import Interface
from cycloid_fmu.geometry.temperature import BODIES, Temperatures
from cycloid_fmu.surfaces.posterior import drawn_surfaces
from cycloid_fmu.surfaces.sampling import Tolerances, sample_surface
from cycloid_fmu.surfaces.surface import ErrorSurface

Array = NDArray[np.float64]
DRAWS = 40  # of the fit, or of the tolerances, for the band
_BAND_ANGLES = 60
_SPEEDS = 3.5 * np.linspace(0.0, 1.0, 25)  # of the Stribeck speed: beyond, 5e-6 of its extra are left
_UNLIMITED = (253.15, 373.15)  # K: friction's temperatures where none are stated
_WARMTHS = 25
_TORQUE_ACCURACY = 0.01  # of the rated torque
_TEMPERATURES = 3  # at which the table knows the drive


def drive_compensator(
    drive: DriveValue,
    ratio: float,
    *,
    friction: Friction | None,
    stiffness: float | None,
    series_compliance: float,
    temperatures: Sequence[float] | None,
    torque_accuracy: float | None,
    largest_torque: float | None,
    tolerances: Tolerances | None,
    workers: int,
    **options: Any,
) -> Compensator:
    """Return the compensator of a drive; parameters are those of `Drive.compensator` and `compensator_of`."""
    pair, surface, first_stage = drive.pair, drive.surface, drive.first_stage
    for name, value in (("torque_accuracy", torque_accuracy), ("largest_torque", largest_torque)):
        if value is None and pair.rated_torque is None:
            raise InputError(f"rated_torque is missing: {name} follows from it; state either of them.")
    rated = pair.rated_torque or 0.0
    chain = Interface(stiffness=stiffness, series_compliance=series_compliance)
    compliance = with_chain(chain, drive).series_compliance
    # What gives way at the cranks is in the chain then.
    rigid = None if first_stage is None else dataclasses.replace(first_stage, crank_stiffness=math.inf)
    if temperatures is None:
        models = [Model(0.0, pair, surface, rigid, workers)]
    else:
        low, high = temperatures
        if not low < high:
            raise ArgumentError("temperatures", "the first must be below the second", f"{low:g} K, {high:g} K")
        models = []
        for at in np.linspace(low, high, _TEMPERATURES):
            warm = pair.replace(temperature=Temperatures(**dict.fromkeys(BODIES, float(at))))
            models.append(Model(float(at), warm, surface.replace(pair=warm), rigid, workers))
    others: Sequence[ErrorSurface] = ()
    if tolerances is not None:
        others = [sample_surface(models[0].pair, tolerances, seed) for seed in range(DRAWS)]
    elif models[0].surface.covariance is not None:
        others = drawn_surfaces(models[0].pair, models[0].surface, DRAWS, 0)
    return compensator_of(
        models,
        (friction or Friction()).law(1),
        compliance,
        ratio,
        others=others,
        largest_torque=LARGEST_LOAD * rated if largest_torque is None else largest_torque,
        torque_accuracy=_TORQUE_ACCURACY * rated if torque_accuracy is None else torque_accuracy,
        **options,
    )


def compensator_of(
    models: Sequence[Model],
    law: Law,
    compliance: float,
    ratio: float,
    *,
    others: Sequence[ErrorSurface],
    largest_torque: float,
    torque_accuracy: float,
    torque_share: float,
    residual: float,
    sensor: float,
    total: Callable[[int], None] = lambda angles: None,
    progress: Callable[[int], None] = lambda angles: None,
) -> Compensator:
    """Return the compensator of a drive.

    Parameters
    ----------
    models
        The drive at each temperature, ascending.
    law
        Friction at the output.
    compliance
        In series with the drive, rad/(N·m).
    ratio
        Of the motor's rotation to the output's.
    others
        What may have been made instead of the first one's surface: their spread around it goes into the band.
    largest_torque, torque_accuracy, residual, total, progress
        As of `inverse_of`.
    torque_share
        Share of the torque, added to its standard deviation for the band.
    sensor
        Standard deviation of an output encoder, rad.

    Raises
    ------
    edge.InputError
        As `inverse_of`, or if a number is out of range.
    """
    for name, value in (("torque_accuracy", torque_accuracy), ("residual", residual), ("sensor", sensor)):
        if not 0.0 < value < math.inf:
            raise ArgumentError(name, "it must be finite and above zero", value)
    if not 0.0 <= torque_share < 1.0:
        raise ArgumentError("torque_share", "it must be between 0 and 1", torque_share)
    if not 0.0 < largest_torque < math.inf:
        raise ArgumentError("largest_torque", "it must be finite and above zero (N*m)", largest_torque)
    inverse = inverse_of(
        models,
        largest_torque=largest_torque,
        torque_accuracy=torque_accuracy,
        residual=residual,
        total=total,
        progress=progress,
    )
    first, last = (inverse.temperature[0], inverse.temperature[-1]) if len(models) > 1 else _UNLIMITED
    warmth = np.linspace(first, last, _WARMTHS) if law.temperature_coefficient else np.zeros(1)
    table = inverse.residual**2 / 9.0  # largest of as good as normal errors: three standard deviations
    give = compliance + np.gradient(inverse.mean, inverse.torque, axis=1)
    stated = (compliance * torque_accuracy) ** 2 + (give * torque_share * inverse.torque) ** 2
    return Compensator(
        ratio=ratio,
        crank_ratio=models[0].pair.ratio,
        inverse=inverse,
        compliance=compliance,
        coulomb=law.coulomb,
        load_share=law.load_share,
        stribeck=law.stribeck,
        viscous=law.viscous,
        presliding_angle=law.presliding_angle,
        stribeck_speed=law.stribeck_speed * _SPEEDS,
        stribeck_share=np.exp(-(_SPEEDS**2)),
        warmth_temperature=warmth,
        warmth=np.array([factor(law, t) for t in warmth]) if law.temperature_coefficient else np.ones(1),
        variance=inverse.spread + stated + _spread(models[0], inverse, others) + table,
        ripple_variance=inverse.ripple_variance,
        sensor=sensor,
    )


def _spread(model: Model, inverse: Inverse, others: Sequence[ErrorSurface]) -> Array:
    """Return the mean square deviation of others from a drive at each torque; 0 without others, rad².

    The ends of the play represent zero torque.
    """
    if not others:
        return np.zeros(inverse.torque.size)
    # Whatever they are, all repeat after as many crank turns as there are teeth.
    crank = np.sort(np.random.default_rng(3).uniform(0.0, 2.0 * math.pi * model.pair.gear_teeth, _BAND_ANGLES))
    torque = inverse.torque
    some = np.unique(np.round(np.linspace(0, torque.size - 1, 9)).astype(int))
    some = some[torque[some] != 0.0]
    best = model.solved(torque[some], crank)
    off = [model._replace(surface=other).solved(torque[some], crank) - best for other in others]
    return np.asarray(np.interp(torque, torque[some], np.mean(np.square(off), axis=(0, 2))))
