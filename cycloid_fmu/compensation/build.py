"""From a drive to its compensator."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable, Sequence

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
    torque_share: float,
    residual: float | None,
    sensor: float | None,
    workers: int,
    total: Callable[[int], None],
    progress: Callable[[int], None],
) -> Compensator:
    """Return the compensator of a drive of a ratio of motor to output; other parameters as of `Drive.compensator`."""
    assert residual is not None  # unlike the torques it does not follow from the drive
    assert sensor is not None
    pair = drive.pair
    for name, value in (("torque_accuracy", torque_accuracy), ("largest_torque", largest_torque)):
        if value is None and pair.rated_torque is None:
            raise InputError(f"rated_torque is missing: {name} follows from it; state either of them.")
    rated = pair.rated_torque or 0.0
    accuracy = _TORQUE_ACCURACY * rated if torque_accuracy is None else torque_accuracy
    largest = LARGEST_LOAD * rated if largest_torque is None else largest_torque
    chain = Interface(stiffness=stiffness, series_compliance=series_compliance)
    compliance = with_chain(chain, drive).series_compliance
    models = _models(drive, temperatures, workers)
    others = _alternatives(models[0], tolerances)
    _check_accuracy(accuracy, torque_share, residual, sensor)
    if not 0.0 < largest < math.inf:
        raise ArgumentError("largest_torque", "it must be finite and above zero (N*m)", largest)
    inverse = inverse_of(
        models, largest_torque=largest, torque_accuracy=accuracy, residual=residual, total=total, progress=progress
    )
    give = compliance + np.gradient(inverse.mean, inverse.torque, axis=1)
    stated = (compliance * accuracy) ** 2 + (give * torque_share * inverse.torque) ** 2
    table = inverse.residual**2 / 9.0  # largest of as good as normal errors: three standard deviations
    law = (friction or Friction()).law(1)
    warmth_temperature, warmth = _warmth(law, inverse if len(models) > 1 else None)
    return Compensator(
        ratio=ratio,
        crank_ratio=pair.ratio,
        inverse=inverse,
        compliance=compliance,
        coulomb=law.coulomb,
        load_share=law.load_share,
        stribeck=law.stribeck,
        viscous=law.viscous,
        presliding_angle=law.presliding_angle,
        stribeck_speed=law.stribeck_speed * _SPEEDS,
        stribeck_share=np.exp(-(_SPEEDS**2)),
        warmth_temperature=warmth_temperature,
        warmth=warmth,
        variance=inverse.spread + stated + _spread(models[0], inverse, others) + table,
        ripple_variance=inverse.ripple_variance,
        sensor=sensor,
    )


def _models(drive: DriveValue, temperatures: Sequence[float] | None, workers: int) -> list[Model]:
    """Return the drive as it stands, or at temperatures of a range, ascending."""
    pair, surface, first_stage = drive.pair, drive.surface, drive.first_stage
    # What gives way at the cranks is in the chain then.
    rigid = None if first_stage is None else dataclasses.replace(first_stage, crank_stiffness=math.inf)
    if temperatures is None:
        return [Model(0.0, pair, surface, rigid, workers)]
    low, high = temperatures
    if not low < high:
        given = f"{low - 273.15:.6g} degC, {high - 273.15:.6g} degC"
        raise ArgumentError("temperatures", "the first must be below the second", given)
    models = []
    for at in np.linspace(low, high, _TEMPERATURES):
        warm = pair.replace(temperature=Temperatures(**dict.fromkeys(BODIES, float(at))))
        models.append(Model(float(at), warm, surface.replace(pair=warm), rigid, workers))
    return models


def _alternatives(model: Model, tolerances: Tolerances | None) -> Sequence[ErrorSurface]:
    """Return what may have been made instead of a drive, within tolerances or its fit; none if neither is known."""
    if tolerances is not None:
        return [sample_surface(model.pair, tolerances, seed) for seed in range(DRAWS)]
    return [] if model.surface.covariance is None else drawn_surfaces(model.pair, model.surface, DRAWS, 0)


def _check_accuracy(torque: float, torque_share: float, residual: float, sensor: float) -> None:
    """Refuse standard deviations and residuals that are no such numbers."""
    for name, number in (("torque_accuracy", torque), ("residual", residual), ("sensor", sensor)):
        if not 0.0 < number < math.inf:
            raise ArgumentError(name, "it must be finite and above zero", number)
    if not 0.0 <= torque_share < 1.0:
        raise ArgumentError("torque_share", "it must be between 0 and 1", torque_share)


def _warmth(law: Law, inverse: Inverse | None) -> tuple[Array, Array]:
    """Return temperatures, K, of the table's range if it has one, and the factor on friction at each."""
    if not law.temperature_coefficient:
        return np.zeros(1), np.ones(1)
    first, last = _UNLIMITED if inverse is None else (inverse.temperature[0], inverse.temperature[-1])
    temperature = np.linspace(first, last, _WARMTHS)
    return temperature, np.array([factor(law, t) for t in temperature])


def _spread(model: Model, inverse: Inverse, others: Sequence[ErrorSurface]) -> Array:
    """Return the mean square of others' transmission errors less a drive's at each torque; 0 without others, rad².

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
    difference = [model._replace(surface=other).solved(torque[some], crank) - best for other in others]
    return np.asarray(np.interp(torque, torque[some], np.mean(np.square(difference), axis=(0, 2))))
