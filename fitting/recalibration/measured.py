"""Measurements of a joint in the field: curves with a coarse output reference, and values of the lost motion."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from cycloid_fmu.surfaces.structured import profile_names, profile_wave
from fitting.arguments import positive
from fitting.model.observations import (
    CHAIN,
    COMPLIANCE_SHARE,
    CREEP,
    LOST_MOTION,
    PROFILE_ORDERS,
    Linear,
    Observations,
    State,
    form_columns,
    linearise,
    observations,
)
from fitting.model.posterior import Posterior
from fitting.transmission_error.curve import Curve, noise_of

Array = NDArray[np.float64]

# Means over steps wider than a pin pitch hide single pins: with 4000 points of a 39/40 drive the backlash changed by up
# to three standard errors.
POINTS = 10000  # largest number in an update: more samples are averaged
_LEAST = 12  # smallest number of points per crank turn
_AVERAGED = 1.3  # points per step from which on they are averaged
TORQUE_SHARE = 0.05
"""Standard deviation of the scale of a torque from the motor's current or the load's weight."""
FRICTION_SHARE = 0.01  # unknown friction at the output over the rated torque, or over the largest measured one
FRICTION_OF = "friction_torque_of_"  # a run
_OWN_FRICTION = 0.5  # standard deviation of a single run's friction over this friction
_REFERENCE_ORDERS = (2, 3, 4)  # per output turn: errors of the encoder; order 1 is its eccentricity
_REFERENCE = 1e-4  # rad: standard deviation of each order
SIZES = {CREEP: 1e-6}
"""Standard deviation of a common zero's creep from one recording to the next, rad."""
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
    index = np.floor(curve.input_angle / (2.0 * np.pi) * each).astype(np.int64)
    _, of = np.unique(index, return_inverse=True)
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


def sides(lost_motion: LostMotion, teeth: int, number: int, ratio: float) -> Curve:
    """Return the points of a lost motion: the output loaded in either direction at the same crank angles."""
    # One angle more than a whole number per crank turn, so that no order of pins or teeth is aliased.
    count = _ANGLES * teeth + 1
    every = np.arange(count) * 2.0 * np.pi * teeth / count
    angle = every if lost_motion.crank_angle is None else np.array([lost_motion.crank_angle])
    half = np.repeat([0.5, -0.5], angle.size)
    return Curve(
        input_angle=np.tile(angle, 2),
        transmission_error=lost_motion.value * half,
        standard_error=np.full(half.size, np.nan),
        sample_count=np.ones(half.size, dtype=np.int64),
        torque=0.0,
        torque_deviation=0.0,
        direction=1,
        ratio=ratio,
        common_zero=False,
        known_index=True,
        source=f"lost motion {number + 1}",
        checksum="",
        torque_each=2.0 * lost_motion.torque * half,
        branch=LOST_MOTION,
    )


def observed_in_place(
    curves: Sequence[Curve],
    lost_motions: Sequence[LostMotion],
    earlier: Posterior,
    *,
    bits: int | None = None,
    torque_share: float = TORQUE_SHARE,
    noise: Sequence[float] | None = None,
) -> Observations:
    """Return measurements of a joint as observations: points of the curves, then those of the lost motions.

    Parameters
    ----------
    curves, lost_motions
        Measurements, at least one of either kind.
    earlier
        What is known of the drive at this date.
    bits
        Resolution of the output reference, bits per turn; None if the noise of the curves includes it.
    torque_share
        Standard deviation of the torque's scale.
    noise
        Noise of a sample of each curve, rad, for a plan.

    Raises
    ------
    edge.InputError
        If nothing was measured.
    """
    pair = earlier.drive.pair
    means, shown = list(curves), []
    if noise is None:
        noise = [noise_of(c) * np.sqrt(np.median(c.sample_count)) for c in curves]
        turns = max(sum(float(np.ptp(c.input_angle)) for c in curves if not c.branch) / (2.0 * np.pi), 1.0)
        means = [averaged(c, max(_LEAST, round(POINTS / turns))) for c in curves]
    for curve, white in zip(means, noise, strict=True):
        coarse = 0.0 if bits is None or curve.branch else quantised(curve, bits)
        shown.append(max(white / np.sqrt(np.median(curve.sample_count)), coarse, 1e-9))
    ratio = pair.ratio if not means else means[0].ratio
    pseudo = [sides(lost_motion, pair.gear_teeth, i, ratio) for i, lost_motion in enumerate(lost_motions)]
    if not means and not pseudo:
        raise edge.InputError("nothing was measured: give recordings or a lost motion.")
    level = float(np.median(shown)) if shown else 1e-6
    profile = {n: _FORM for n in earlier.errors if profile_wave(n, 1) is not None}
    every = [*shown, *[level] * len(pseudo)]
    friction = FRICTION_SHARE * (pair.rated_torque or max(abs(c.torque) for c in means or pseudo))
    means = [_with_friction(c, friction) for c in means]
    whole = observations([*means, *pseudo], pair, every, profile, earlier.drive.first_stage, earlier=earlier)
    return _with_reference(whole, [lost_motion.standard_error for lost_motion in lost_motions], torque_share, friction)


def _with_friction(curve: Curve, friction: float) -> Curve:
    """Return a run with the expected friction in its torque: friction opposes the motion, so its mean is not zero."""
    if curve.branch:
        return curve
    by = -float(curve.direction) * float(np.sign(curve.ratio)) * friction
    each = curve.torque_each
    return dataclasses.replace(curve, torque=curve.torque + by, torque_each=None if each is None else each + by)


def _with_reference(
    observed: Observations, standard_errors: Sequence[float], torque_share: float, friction: float
) -> Observations:
    """Return observations with errors of a coarse reference and of the torque; lost motions are the last curves."""
    running, weight = ~observed.of_lost_motions, observed.weight.copy()
    sizes = [c.input_angle.size for c in observed.curves[len(observed.curves) - len(standard_errors) :]]
    weight[~running] = np.repeat(1.0 / np.array(standard_errors), sizes)
    angle = np.concatenate([c.input_angle for c in observed.curves]) / abs(observed.curves[0].ratio)
    names, columns = [], [observed.bench]
    for order in _REFERENCE_ORDERS if running.any() else ():
        names += [f"output_encoder_order_{order}_{part}" for part in ("cos", "sin")]
        columns += [np.cos(order * angle)[:, None], np.sin(order * angle)[:, None]]
    bench, prior = np.hstack(columns), np.concatenate([observed.bench_prior, np.full(len(names), _REFERENCE)])
    at_chain = observed.bench_names.index(CHAIN)
    # A lost motion is measured at one position of the reference, so its errors cancel.
    bench[np.ix_(~running, np.arange(bench.shape[1]) != at_chain)] = 0.0
    prior[at_chain] *= np.hypot(COMPLIANCE_SHARE, torque_share) / COMPLIANCE_SHARE
    return dataclasses.replace(
        observed,
        weight=weight,
        bench=bench,
        bench_prior=prior,
        bench_names=(*observed.bench_names, *names),
        friction_prior=max(observed.friction_prior, friction),
    )


def linear_near(observed: Observations, drive: Drive, state: State) -> tuple[Observations, Linear]:
    """Return observations with all that is linear near a state, and the model there.

    These are the orders of the flank form, for drives on bearings finite differences and the slowest part, and the
    friction of each run beside the common one.
    """
    at = [profile_names(PROFILE_ORDERS).index(n) for n in observed.profile]
    observed = dataclasses.replace(observed, form=np.zeros((observed.measured.size, len(at))))
    linear = linearise(drive.pair, observed, state)
    if at:
        form = form_columns(drive.pair, observed, state, linear, _FORM)[:, at]
        observed = dataclasses.replace(observed, form=form)
        linear.structured[:, [observed.errors.index(n) for n in observed.profile]] = form
    number = np.repeat(np.arange(len(observed.curves)), [c.input_angle.size for c in observed.curves])
    own = linear.by_friction[:, None] * (number[:, None] == observed.running)
    names = [f"{FRICTION_OF}{i}" for i in observed.running]
    rest = [i for i, n in enumerate(observed.bench_names) if not n.startswith(FRICTION_OF)]
    return dataclasses.replace(
        observed,
        bench=np.hstack([observed.bench[:, rest], own]),
        bench_names=(*(observed.bench_names[i] for i in rest), *names),
        bench_prior=np.append(observed.bench_prior[rest], [_OWN_FRICTION * observed.friction_prior] * len(names)),
    ), linear
