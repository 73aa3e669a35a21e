"""Measurements of a joint in the field: curves with a coarse output reference, and values of the lost motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.structured import profile_names, profile_wave
from fitting.arguments import positive
from fitting.model.observations import (
    COMPLIANCE_SHARE,
    PROFILE_ORDERS,
    Linear,
    Observations,
    State,
    form_columns,
    linearise,
    observations,
)
from fitting.transmission_error.curve import Curve, noise_of

Array = NDArray[np.float64]

# Means over steps wider than a pin pitch hide single pins: with 4000 points of a 39/40 drive the backlash changed by up
# to three standard errors.
POINTS = 10000  # largest number in an update: more samples are averaged
_COARSE = 2500  # number of points in the first steps of an update
_LEAST = 12  # smallest number of points per crank turn
_AVERAGED = 1.3  # points per step from which on they are averaged
TORQUE_SHARE = 0.05
"""Standard deviation of the scale of a torque from the motor's current or the load's weight."""
FRICTION_SHARE = 0.01  # unknown friction at the output over the rated torque, or over the largest measured one
_OWN_FRICTION = 0.5  # standard deviation of a single run's friction over this friction
_REFERENCE_ORDERS = (2, 3, 4)  # per output turn: errors of the encoder; order 1 is its eccentricity
_REFERENCE = 1e-4  # rad: standard deviation of each order
_FORM = 1e-6  # m: scale of the orders of the profile deviation
_ANGLES = 10  # angles per crank turn, over an output turn, for a mean lost motion


@dataclass(frozen=True)
class LostMotion:
    """A measured lost motion: rotation of the output while the torque reverses, with the motor at rest.

    Attributes
    ----------
    value, standard_error
        Value (≥ 0) and standard error (> 0), rad at the output; the standard error includes the hysteresis of the
        reference.
    torque
        Torque on either flank from friction or load, N·m, > 0.
    crank_angle
        Crank angle of the measurement, rad; None for a mean over many angles.

    Examples
    --------
    >>> from fitting.recalibration.measured import LostMotion
    >>> LostMotion(value="58 arcsec", standard_error="3 arcsec", torque="5 N*m").torque
    5.0
    """

    value: float
    standard_error: float
    torque: float
    crank_angle: float | None = None

    def __post_init__(self) -> None:
        for name, unit, zero in (("value", "rad", True), ("standard_error", "rad", False), ("torque", "N*m", False)):
            object.__setattr__(self, name, positive(getattr(self, name), unit, name, zero=zero))


def averaged(curve: Curve, each: int) -> Curve:
    """Average the points of a curve in equal steps of the crank angle; few points, and loops, stay unchanged."""
    if not _is_dense(curve, each):
        return curve
    of, count = _steps(curve, each)

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(of, curve.sample_count * values) / count)

    def mean_of(values: Array | None) -> Array | None:
        return None if values is None else mean(values)

    return dataclasses.replace(
        curve,
        input_angle=mean(curve.input_angle),
        transmission_error=mean(curve.transmission_error),
        standard_error=np.full(count.size, np.nan),
        sample_count=np.rint(count).astype(np.int64),
        torque_each=mean_of(curve.torque_each),
        travel=mean_of(curve.travel),
        speed=mean_of(curve.speed),
        angle_variance=None,
        each_turn=None,
        grid=(0, 0.0),
    )


def _is_dense(curve: Curve, each: int) -> bool:
    """Return whether a curve has clearly more than `each` points per crank turn; False for a branch of a loop."""
    turns = float(np.ptp(curve.input_angle)) / (2.0 * np.pi)
    return not curve.branch and curve.input_angle.size > _AVERAGED * each * turns


def _steps(curve: Curve, each: int) -> tuple[NDArray[np.int64], Array]:
    """Return the step of the crank angle of each point, numbered without empty steps, and the samples of each step."""
    place = np.floor(curve.input_angle / (2.0 * np.pi) * each).astype(np.int64)
    _, of = np.unique(place, return_inverse=True)
    return of.astype(np.int64), np.bincount(of, curve.sample_count).astype(float)


def quantised(curve: Curve, bits: int) -> float:
    """Return the quantisation noise of a point of a curve for a reference of `bits` bits per turn, rad.

    The uniform error of a step is averaged over the samples of a point, at most over as many as there are steps:
    samples within one step have the same error.
    """
    step = 2.0 * np.pi / 2**bits
    samples = float(np.median(curve.sample_count))
    passed = float(np.ptp(curve.input_angle)) / abs(curve.ratio) / max(curve.input_angle.size - 1, 1) / step
    return float(step / np.sqrt(12.0) / np.sqrt(max(min(samples, max(passed, 1.0) * max(curve.turns, 1.0)), 1.0)))


@dataclass(frozen=True)
class Field:
    """Measurements as observations of a pair: points of the curves, then those of lost motions, used as differences.

    Attributes
    ----------
    observed
        All points; the weights of lost motions are 1.
    lost_motions
        The measured values, in the order of their curves, which are the last ones of `observed.curves`.
    own_friction
        Standard deviation of the friction of a single run at the output, N·m.
    """

    observed: Observations
    lost_motions: tuple[LostMotion, ...]
    own_friction: float = 0.0

    @property
    def running(self) -> int:
        """Number of points that are rows of their own: those of the curves."""
        count = len(self.observed.curves) - len(self.lost_motions)
        return int(sum(c.input_angle.size for c in self.observed.curves[:count]))

    def thinned(self) -> Field:
        """Return the field with fewer points, for the first steps of an update, or the same field if it has few."""
        pairs = self.observed.measured.size - self.running
        if self.running <= _COARSE:
            return self
        few = self.observed.thinned(round(_COARSE * (1.0 + pairs / self.running)))
        return dataclasses.replace(self, observed=few)

    def reduced(self, points: Array) -> Array:
        """Return rows from points: the points of a lost motion become one row in units of its standard error."""
        rows = [points[: self.running]]
        at = self.running
        for one, curve in zip(self.lost_motions, self.observed.curves[-len(self.lost_motions) or None :], strict=False):
            half = curve.input_angle.size // 2
            there = points[at : at + 2 * half]
            rows.append((there[:half] - there[half:]).mean(axis=0, keepdims=True) / one.standard_error)
            at += 2 * half
        return np.concatenate(rows)


def sides(pair: Pair, torque: float, crank_angle: float | None, number: int, ratio: float) -> Curve:
    """Return the points of a lost motion: the output loaded in either direction (N·m) at the same crank angles."""
    # One angle more than a whole number per crank turn, so that no order of pins or teeth is aliased.
    count = _ANGLES * pair.gear_teeth + 1
    every = np.arange(count) * 2.0 * np.pi * pair.gear_teeth / count
    angle = every if crank_angle is None else np.array([crank_angle])
    count = angle.size
    return Curve(
        input_angle=np.tile(angle, 2),
        transmission_error=np.zeros(2 * count),
        standard_error=np.full(2 * count, np.nan),
        sample_count=np.ones(2 * count, dtype=np.int64),
        torque=0.0,
        torque_deviation=0.0,
        direction=1,
        ratio=ratio,
        common_zero=False,
        known_index=True,
        source=f"lost motion {number + 1}",
        checksum="",
        torque_each=np.repeat([torque, -torque], count),
        branch="lost motion",
    )


def linearised(pair: Pair, observed: Observations, state: State, form: Array | None = None) -> tuple[Linear, Array]:
    """Evaluate the model and its derivatives, including those with respect to the orders of the flank form.

    Returns
    -------
    linear, form
        The model, and its derivatives with respect to `observed.profile`, shape (points, orders): the given ones, or
        those at the state if they are None. For drives on bearings they are finite differences, the slowest part.
    """
    plain = dataclasses.replace(observed, errors=tuple(n for n in observed.errors if n not in observed.profile))
    linear = linearise(pair, plain, state)
    if form is None:
        names = profile_names(PROFILE_ORDERS)
        every = form_columns(pair, observed, state, linear, _FORM) if observed.profile else np.zeros((0, 0))
        form = every[:, [names.index(n) for n in observed.profile]] if observed.profile else linear.structured[:, :0]
    return dataclasses.replace(linear, structured=np.hstack([linear.structured, form])), form


def field_of(
    curves: Sequence[Curve],
    lost_motions: Sequence[LostMotion],
    drive: Drive,
    errors: Sequence[str],
    *,
    bits: int | None = None,
    torque_share: float = TORQUE_SHARE,
    noise: Sequence[float] | None = None,
) -> Field:
    """Return measurements as observations.

    Parameters
    ----------
    curves, lost_motions
        Measurements, at least one of either kind.
    drive, errors
        The drive at its last state, and the structured errors with a known distribution.
    bits
        Resolution of the output reference, bits per turn; None if the noise of the curves includes it.
    torque_share
        Standard deviation of the torque's scale.
    noise
        Noise of a sample of each curve, rad, for a plan.
    """
    pair = drive.pair
    means, shown = list(curves), []
    if noise is None:
        noise = [noise_of(c) * np.sqrt(np.median(c.sample_count)) for c in curves]
        turns = max(sum(float(np.ptp(c.input_angle)) for c in curves if not c.branch) / (2.0 * np.pi), 1.0)
        means = [averaged(c, max(_LEAST, round(POINTS / turns))) for c in curves]
    for curve, white in zip(means, noise, strict=True):
        coarse = 0.0 if bits is None or curve.branch else quantised(curve, bits)
        shown.append(max(white / np.sqrt(np.median(curve.sample_count)), coarse, 1e-9))
    ratio = pair.ratio if not means else means[0].ratio
    pseudo = [sides(pair, one.torque, one.crank_angle, i, ratio) for i, one in enumerate(lost_motions)]
    if not means and not pseudo:
        raise edge.InputError("nothing was measured: give recordings or a lost motion.")
    level = float(np.median(shown)) if shown else 1e-6
    profile = {n: _FORM for n in errors if profile_wave(n, 1) is not None}
    every = [*shown, *[level] * len(pseudo)]
    torques = [abs(c.torque) for c in means] or [0.0]
    friction = FRICTION_SHARE * (pair.rated_torque or max(torques))

    observed = observations([*means, *pseudo], pair, every, profile, drive.first_stage)
    whole = _in_place(observed, len(means), torque_share, friction)
    return Field(whole, tuple(lost_motions), _OWN_FRICTION * whole.friction_prior)


def _in_place(observed: Observations, running: int, torque_share: float, friction: float) -> Observations:
    """Return observations with the errors of a coarse reference and of the torque; the first curves are the runs."""
    count = sum(c.input_angle.size for c in observed.curves[:running])
    weight = observed.weight.copy()
    weight[count:] = 1.0
    angle = np.concatenate([c.input_angle for c in observed.curves]) / abs(observed.curves[0].ratio)
    names, columns = [], []
    for order in _REFERENCE_ORDERS if running else ():
        names += [f"output_encoder_order_{order}_{part}" for part in ("cos", "sin")]
        columns += [np.cos(order * angle), np.sin(order * angle)]
    extra = np.array(columns).T if columns else np.zeros((angle.size, 0))
    # A lost motion is measured at one position of the reference, so its errors cancel.
    bench = np.hstack([observed.bench, extra])
    at_chain = observed.bench_names.index("chain_compliance")
    others = [i for i in range(bench.shape[1]) if i != at_chain]
    bench[np.ix_(range(count, len(bench)), others)] = 0.0
    prior = np.concatenate([observed.bench_prior, np.full(len(names), _REFERENCE)])
    prior[at_chain] *= np.hypot(COMPLIANCE_SHARE, torque_share) / COMPLIANCE_SHARE
    return dataclasses.replace(
        observed,
        weight=weight,
        bench=bench,
        bench_prior=prior,
        bench_names=(*observed.bench_names, *names),
        friction_prior=max(observed.friction_prior, friction),
    )
