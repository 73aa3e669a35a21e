"""Backlash, lost motion and transmission error of a drive, with intervals from the distribution of its errors."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.drive import Drive
from cycloid_fmu.geometry.pair import LOST_MOTION_LOAD
from fitting.estimation.parameter import NORMAL
from fitting.model.gaussian import factor_of
from fitting.model.loops import NO_TORQUE
from fitting.model.observations import State
from fitting.model.posterior import Posterior
from fitting.model.unknowns import Unknowns
from fitting.recalibration.measured import LostMotion, linear_near, observed_in_place
from fitting.transmission_error.curve import Curve

Array = NDArray[np.float64]

EACH = 12  # angles per crank turn at which the transmission error is evaluated
_DRAWS = 200


@dataclass(frozen=True)
class FigureOfDrive:
    """A figure of a drive: value, 95 % interval and standard deviation, rad at the output."""

    value: float
    interval: tuple[float, float]
    standard_error: float


class Gradient:
    """Play, lost motion and transmission error, and their derivatives with respect to errors, bearings and scatter.

    Attributes
    ----------
    values
        {figure: rad}, means over an output turn: `backlash`, and with a rated torque `lost_motion` at ± 3 % of it.
    gradients
        {figure: derivatives by the unknowns of the posterior}; those with respect to the bench are 0.
    error, by_error
        With a rated torque, the transmission error at this torque over an output turn, rad, shape (angles,), and its
        derivatives.
    """

    def __init__(self, posterior: Posterior) -> None:
        drive, pair, rated = posterior.drive, posterior.drive.pair, posterior.drive.pair.rated_torque
        wanted = [LostMotion(0.0, 1.0, NO_TORQUE)]
        turn = _turn(drive) if rated is not None else []
        if rated is not None:
            wanted.append(LostMotion(0.0, 1.0, LOST_MOTION_LOAD * rated))
        observed = observed_in_place(turn, wanted, posterior, noise=[1.0] * len(turn))
        bench = np.zeros(len(observed.bench_names))
        observed, linear = linear_near(observed, drive, State(drive.surface, posterior.scatter_mean, bench))
        observed = dataclasses.replace(observed, weight=np.ones_like(observed.weight))
        unknowns = Unknowns(pair, observed, posterior.errors)
        columns = unknowns.columns(observed, linear) / unknowns.scale
        by_gear = np.zeros((linear.model.size, len(posterior.names)))
        for number, name in enumerate(posterior.names):
            if name in unknowns.names and name not in observed.bench_names:
                by_gear[:, number] = columns[:, unknowns.names.index(name)]
        value, slope = observed.rows(linear.model), observed.rows(by_gear)
        running = len(value) - len(wanted)
        names = ("backlash", "lost_motion")[: len(wanted)]
        self.values = {n: max(float(v), 0.0) for n, v in zip(names, value[running:], strict=True)}
        self.gradients = dict(zip(names, slope[running:], strict=True))
        self.error, self.by_error = value[:running], slope[:running]


def _turn(drive: Drive) -> list[Curve]:
    """Return one output turn at the rated torque."""
    pair = drive.pair
    assert pair.rated_torque is not None
    angle = np.arange(EACH * pair.gear_teeth) * 2.0 * np.pi / EACH
    return [
        Curve(
            input_angle=angle,
            transmission_error=np.zeros(angle.size),
            standard_error=np.full(angle.size, np.nan),
            sample_count=np.ones(angle.size, dtype=np.int64),
            torque=pair.rated_torque,
            torque_deviation=0.0,
            direction=1,
            ratio=pair.ratio,
            common_zero=True,
            known_index=True,
            source="figures",
            checksum="",
        )
    ]


def figures_of(posterior: Posterior) -> dict[str, FigureOfDrive]:
    """Return a drive's figures with their intervals.

    `backlash` is the mean over an output turn. With a rated torque there are also `lost_motion`, the mean at ± 3 % of
    it, and `transmission_error`, peak to peak over an output turn at this torque: median and interval of drives drawn
    from the distribution. All are in rad.
    """
    gradient, covariance = Gradient(posterior), posterior.covariance
    figures = {}
    for name, value in gradient.values.items():
        slope = gradient.gradients[name]
        sigma = float(np.sqrt(max(slope @ covariance @ slope, 0.0)))
        figures[name] = FigureOfDrive(value, (max(value - NORMAL * sigma, 0.0), value + NORMAL * sigma), sigma)
    if gradient.error.size:
        normal = np.random.default_rng(0).standard_normal((_DRAWS, len(covariance)))
        drawn = gradient.error + normal @ (gradient.by_error @ factor_of(covariance)).T
        sizes = np.ptp(drawn, axis=1)
        # Deviations of single pins increase the peak of every drawn drive above that of the most likely drive.
        low, middle, high = (float(q) for q in np.quantile(sizes, (0.025, 0.5, 0.975)))
        figures["transmission_error"] = FigureOfDrive(middle, (low, high), float(sizes.std()))
    return figures
