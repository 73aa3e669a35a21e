"""Whether a fit explains its data: tests that can fail, and the most likely causes of failure.

The reference is never the noise fitted with the model, which absorbs effects outside the model. It is the scatter of
turns and repetitions, and without repetitions the floor between the orders of the residual: errors of a drive and its
bench are at orders, noise is also between them.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import special

from cycloid_fmu.edge import ARCSEC
from cycloid_fmu.surfaces.structured import structured_value
from fitting.estimation.fit import Estimate
from fitting.estimation.run_out import RunOut
from fitting.model.discrepancy import BESIDE_THE_GEAR, FORM, RUN_OUT_CAUSE, SENTENCES, SHIFTS, is_whole, waves, way
from fitting.model.gaussian import Gaussian, truncated
from fitting.model.observations import CHAIN, CREEP, MISFIT, Observations, with_scatter
from fitting.transmission_error.spectrum import coefficients_of

Array = NDArray[np.float64]

FALSE_ALARM = 2e-3  # how often a test alarms where there is nothing, all that it looks at together
_MORE = 1.15  # times the yardstick: a larger residual counts as more than noise
_SEEN = 1e-3  # of a column's square outside the span of the errors; below it a cause is not separable from them
_SHARED = 0.02  # of what curves show of the fit's unknowns: directions that they alone show can't contradict others
_ORDERS = 12  # most orders that are named
_HIGHEST = 4096  # order of the output that is looked at
_REPEATED = 100  # points of a curve with several turns from which its noise is estimated
_ALIKE = 0.8  # of the best cause's gain: a cause with this gain is not separable from it
_SMALL = 0.01  # of the largest cause, or of the noise: a smaller contribution is not stated
_WHOLE = 0.15  # of the resolution of the turns: an order so near a whole number is one
_PULLED = {"chain_compliance": "compliance", "friction_torque": "friction"}  # the cause, where it is far from its prior
_FREE = 0.9  # of a prior's variance: if more of it is left, the data do not show how far the unknown is from the prior
_NAMED = 4  # causes and orders that a sentence names
_STEADY = 0.2  # of a point's standard error: what the scatter of its samples' angles may add to it
SAME_LOAD = 0.05  # of the largest torque: loads that differ by less are the same


@dataclass(frozen=True)
class Misfit:
    """An effect outside the model of the pair.

    Attributes
    ----------
    cause
        As in `fitting.model.discrepancy.SENTENCES`, or "orders".
    size
        rms of its contribution to the transmission error, rad.
    alike
        Other causes that these curves can't separate from it.
    orders
        Orders of the output, if nothing else is known of the cause.
    run_out
        Of run-out, the amplitude of each order; the size is then that of all of them.
    """

    cause: str
    size: float
    alike: tuple[str, ...] = ()
    orders: tuple[float, ...] = ()
    run_out: tuple[RunOut, ...] = ()


@dataclass(frozen=True)
class Verdict:
    """Whether the errors of the pair explain the curves.

    Attributes
    ----------
    state
        "explained"; "explained but for" causes that are part of the fit, so that the intervals allow for them; or "not
        explained", where no interval is stated.
    misfits
        Effects outside the model of the pair, most likely first.
    noise, residual
        Noise of a point by the reference, and rms of the residual, rad: geometric means over the curves.
    failed
        Failed tests, in words; none if the curves are explained.
    descriptions
        Number of sets of errors with the same curves, each with another disc as the first.
    disagreeing
        Number of starts from which the fit ended in different optima; 0 if two agreed.
    """

    state: str
    misfits: tuple[Misfit, ...]
    noise: float
    residual: float
    failed: tuple[str, ...]
    descriptions: int = 1
    disagreeing: int = 0

    @property
    def sentence(self) -> str:
        """The verdict in one line."""
        named = ", ".join(_in_words(m) for m in self.misfits[:_NAMED])
        several = f" {self.descriptions} sets of errors make these curves." if self.descriptions > 1 else ""
        if self.disagreeing:
            several += f" But no two of {self.disagreeing} starts reached the same optimum: "
            several += "a better one may have been missed."
        if self.state == "explained":
            return (
                f"Explained: the residual of the curves, {self.residual * ARCSEC:.2f}″, is their noise, at every "
                f"order, load and direction.{several}"
            )
        if self.state == "explained but for":
            return f"Explained but for {named}; the intervals allow for it.{several}"
        likely = f" Likely causes: {named}." if named else ""
        return f"Not explained: {'; '.join(self.failed)}.{likely} No intervals are stated."


def _in_words(misfit: Misfit) -> str:
    if misfit.orders:
        named = ", ".join(f"{order:.4g}" for order in misfit.orders[:_NAMED])
        more = " and others" if len(misfit.orders) > _NAMED else ""
        of = "" if all(is_whole(order) for order in misfit.orders) else ", not whole: another stage or shaft"
        kind = "orders" if len(misfit.orders) > 1 else "order"
        return f"{kind} {named}{more} of the output{of} ({misfit.size * ARCSEC:.2g}″)"
    named = " or ".join(SENTENCES[cause] for cause in (misfit.cause, *misfit.alike))
    seen = sorted((one for one in misfit.run_out if one.is_seen), key=lambda one: -one.amplitude)
    size = ", ".join(one.text for one in seen[:_NAMED]) or f"{misfit.size * ARCSEC:.2g}″"
    return f"{named} ({size})"


def with_run_out(verdict: Verdict, run_out: Sequence[RunOut]) -> Verdict:
    """Return the verdict with the amplitudes of run-out, if that is among the causes."""
    size = float(np.sqrt(0.5 * sum(one.amplitude**2 for one in run_out)))
    misfits = [
        dataclasses.replace(m, size=size, run_out=tuple(run_out)) if m.cause == RUN_OUT_CAUSE else m
        for m in verdict.misfits
    ]
    return dataclasses.replace(verdict, misfits=tuple(misfits))


@dataclass(frozen=True)
class HeldOut:
    """Held-out curves, predicted by the pair's errors: loads in words, rms of the residual, and noise, rad.

    The noise is from repetitions, or from between the orders of the residual of these curves; NaN with too few points
    for either.
    """

    loads: str
    residual: float
    noise: float


def mispredicted(verdict: Verdict, predicted: HeldOut) -> Verdict:
    """Return the verdict if a fit of the others does not predict the held-out curves."""
    share = predicted.residual / predicted.noise
    failed = f"{predicted.loads}, held out of the fit, were predicted to {share:.2g} times their noise"
    return dataclasses.replace(verdict, state="not explained", failed=(*verdict.failed, failed))


class Residual:
    """The residual of a fit in units of its noise, and its derivatives by the unknowns.

    `pulls` gives, for causes with an unknown of the bench, the probability that it is so far from zero, and by how
    much it lowers -2 log likelihood to take the cause instead.

    Parameters
    ----------
    estimate
        The end of the fit.
    """

    def __init__(self, estimate: Estimate) -> None:
        unknowns, precision = estimate.unknowns, estimate.precision
        self.observed, self.scale = estimate.observed, unknowns.scale
        self.weight, self.columns, self.posterior = self.observed.weight, estimate.columns, estimate.posterior
        # The fit ends where a step gains little; the tests are made at the optimum.
        step = self.posterior.mean
        self.left = estimate.residual - self.columns @ step
        self.pulls = _creeps_with_load(estimate)
        for name, cause in _PULLED.items():
            at = unknowns.names.index(name)
            unit = np.zeros(step.size)
            unit[at] = 1.0
            # The prior pulls an estimate towards zero; one whose size is estimated as well scatters about the truth.
            usual = (self.observed.chain_prior / unknowns.scale[at]) ** 2 if name == CHAIN else 1.0 / precision[at]
            variance = float(self.posterior.solve(unit)[at])
            spread = usual + variance if name in self.observed.estimated else usual - variance
            if spread > (1.0 - _FREE) * usual:
                square = float(estimate.vector[at] + step[at]) ** 2 / spread
                pull = float(special.chdtrc(1, square)), square
                self.pulls[cause] = min(pull, self.pulls.get(cause, pull))

    def beyond(self, columns: Array) -> Array:
        """Part of columns outside the span of the fit's unknowns, in units of the noise, shape (points, columns)."""
        own = self.weight[:, None] * columns
        outside: Array = own - self.columns @ self.posterior.solve(self.columns.T @ own)
        return outside

    def score(self, columns: Array) -> tuple[float, Array]:
        """Probability that noise resembles these columns as much, and their part of the residual.

        A score test (Rao, Proc. Camb. Phil. Soc. 44 (1948) 50): the model is not fitted again.
        """
        own, beyond = self.weight[:, None] * columns, self.beyond(columns)
        size = np.sqrt((own**2).sum(axis=0))
        square, count, coefficients = truncated(own.T @ self.left, own.T @ beyond, size, _SEEN)
        return (float(special.chdtrc(count, square)) if count else 1.0), np.asarray(beyond @ coefficients)

    def take(self, columns: Array) -> None:
        """Add columns to the unknowns of the fit."""
        own = self.weight[:, None] * columns
        _, part = self.score(columns)
        size = (own**2).sum(axis=0)
        cross = self.columns.T @ own
        self.posterior = self.posterior.extended(cross, own.T @ own + np.diag(_SEEN * size))
        self.columns = np.hstack([self.columns, own])
        self.left = self.left - part

    def is_zero(self, numbers: Sequence[int], values: Array) -> bool:
        """Whether unknowns of the fit, in their scale, are compatible with zero (Wald)."""
        square = Gaussian(self.posterior.information, along=self.posterior.along).score(numbers, values)
        return float(special.chdtrc(values.size, square)) > FALSE_ALARM

    def contradicts(self, numbers: Sequence[int]) -> float:
        """Probability that noise makes some curves and the others disagree as much on the fit's unknowns."""
        places = np.split(np.arange(self.left.size), self.observed.ends)
        part = np.concatenate([places[n] for n in numbers])
        columns = self.columns[part]
        own = columns.T @ columns
        size = np.sqrt(np.maximum(np.diag(own), 1e-12 * np.diag(own).max()))
        spread = own - own @ self.posterior.solve(own)
        square, count, _ = truncated(columns.T @ self.left[part], spread, size, _SHARED)
        return float(special.chdtrc(max(count, 1), square))


def _creeps_with_load(estimate: Estimate) -> dict[str, tuple[float, float]]:
    """Whether recordings' zeros are on a line over the torque, which is compliance and not creep.

    The line may have a step where the torque changes sign: by play that held errors do not account for.
    """
    part = estimate.observed.estimated.get(CREEP)
    if part is None or part.stop - part.start < 5:
        return {}
    zero, torque = (
        estimate.state.bench[part],
        np.array(
            [
                np.mean(np.concatenate([c.torque_at_points for c in estimate.observed.curves])[column > 0.0])
                for column in estimate.observed.bench[:, part].T
            ]
        ),
    )
    line = np.column_stack([np.ones_like(torque), torque, np.sign(torque)])
    residual = float(np.sum((zero - line @ np.linalg.lstsq(line, zero, rcond=None)[0]) ** 2))
    every, free = float(np.sum((zero - zero.mean()) ** 2)), zero.size - 3
    if not every > residual > 0.0:
        return {}
    chance = float(special.fdtrc(2, free, 0.5 * free * (every / residual - 1.0)))
    return {"compliance": (chance, zero.size * float(np.log(every / residual)))}


def order_powers(observed: Observations, residual: Array) -> tuple[int, list[Array]]:
    """Return the power of the residual at the orders of the output.

    Returns
    -------
    turns
        Of the output in every curve: entry k of a power is order (k + 1)/turns.
    powers
        Of each running curve, in units of what white noise has.
    """
    parts = np.split(np.arange(residual.size), observed.ends)
    ways = {i: way(observed.curves[i]) for i in observed.running}
    turns = max(1, min(round(float(np.ptp(one))) for one in ways.values()))
    found = []
    for number, turned in ways.items():
        part = parts[number]
        highest = min(part.size // 2, _HIGHEST * turns)
        points = 1 << int(np.ceil(np.log2(32 * max(highest, 2))))
        phase = np.mod(turned / turns, 1.0)
        gathered = np.bincount((phase * points).astype(np.int64) % points, residual[part], points)
        count = max(int(np.count_nonzero(observed.weight[part])), 1)
        found.append(np.abs(coefficients_of(gathered, count)[1 : highest + 1]) ** 2 * (0.25 * count))
    return turns, found


def yardsticks(observed: Observations, residual: Array, unknown: float) -> Array:
    """Noise of a point of each running curve, in units of that of `residual`, from repetitions or between orders.

    `unknown`: of curves with too few points for either.
    """
    found = []
    parts = np.split(np.arange(residual.size), observed.ends)
    for number, power in zip(observed.running, order_powers(observed, residual)[1], strict=True):
        curve, part = observed.curves[number], parts[number]
        slope = np.abs(np.gradient(curve.transmission_error, curve.input_angle)) if part.size > 2 else np.zeros(1)
        spread = np.zeros(1) if curve.angle_variance is None else np.sqrt(curve.angle_variance)
        told = np.isfinite(curve.standard_error) & (slope * spread < _STEADY * curve.standard_error)
        if np.count_nonzero(told) > _REPEATED:
            scatter = (curve.standard_error * observed.weight[part])[told]
            found.append(float(np.sqrt(np.mean(scatter**2))))
        else:
            found.append(float(np.sqrt(np.median(power) / np.log(2.0))) if power.size > 20 else unknown)
    return np.array(found)


def peak(observed: Observations, residual: Array) -> float | None:
    """Order of the output with the largest peak in the residual of one curve or all together; None without a peak."""
    turns, powers = order_powers(observed, residual)
    least = min(p.size for p in powers)
    looked = least + sum(p.size for p in powers)
    together = np.sum([p[:least] for p in powers], axis=0)
    chances = [special.gammaincc(len(powers), together), *(np.exp(-p) for p in powers)]
    best = min(chances, key=lambda one: float(one.min()))
    if float(best.min()) * looked > FALSE_ALARM:
        return None
    # Between the orders that the turns resolve.
    near = (int(np.argmin(best)) + 1 + np.linspace(-1.0, 1.0, 41)) / turns
    parts = np.split(np.arange(residual.size), observed.ends)
    power = sum(
        np.abs(np.exp(-2j * np.pi * np.outer(near, way(observed.curves[i]))) @ residual[parts[i]]) ** 2
        for i in observed.running
    )
    order = float(near[int(np.argmax(power))])
    return float(round(order)) if abs(order - round(order)) * turns < _WHOLE and round(order) else order


def by_load(torque: Array) -> list[NDArray[np.int64]]:
    """Return which curves have the same load, the smallest first."""
    sizes = np.abs(torque)
    order = np.argsort(sizes)
    return np.split(order, np.flatnonzero(np.diff(sizes[order]) > SAME_LOAD * sizes.max()) + 1)


def groups_of(observed: Observations) -> dict[str, list[int]]:
    """Curves with a common load or direction, in words, if there are others to compare with."""
    running = observed.running
    torque = np.array([observed.curves[i].torque for i in running])
    found = {f"{np.abs(torque[one]).mean():.4g} N·m": [running[i] for i in one] for one in by_load(torque)}
    if len(found) < 2:
        found = {}
    ways = {
        name: [running[i] for i in np.flatnonzero(np.sign(torque) == sign)]
        for name, sign in (("the positive torques", 1.0), ("the negative torques", -1.0))
    }
    return {**found, **({} if min(map(len, ways.values())) == 0 else ways)}


def failures(residual: Residual, left: Array) -> tuple[list[str], Array]:
    """Return the failed tests of the residual, in words, and the references."""
    observed = residual.observed
    failed = []
    order = peak(observed, left)
    if order is not None:
        failed.append(f"order {order:.4g} of the output is above the noise")
    yardstick = yardsticks(observed, left, 1.0)
    excess = float(np.exp(-np.mean(np.log(np.maximum(yardstick, 1e-9)))))
    # A median of n squares of noise is uncertain by 1.44/√n of it.
    if excess > max(_MORE, np.exp(4.0 * 0.72 / np.sqrt(0.5 * np.count_nonzero(~observed.of_loops)))):
        failed.append(f"the residual is {excess:.2g} times the noise")
    groups = groups_of(observed)
    contradicting = [name for name, group in groups.items() if residual.contradicts(group) * len(groups) < FALSE_ALARM]
    if contradicting:
        failed.append(f"{', '.join(contradicting)} and the others contradict each other")
    return failed, yardstick


@dataclass(frozen=True)
class Likely:
    """Causes that the residual resembles: {cause: columns}, causes inseparable from each, orders of "orders".

    `formed` states whether a form of the flanks may be among them, which is not a column but an error.
    """

    columns: dict[str, Array]
    alike: dict[str, tuple[str, ...]]
    orders: tuple[float, ...]
    formed: bool = False


def likely_causes(
    residual: Residual, columns: Mapping[str, Array], known: Likely | None = None, alarm: float = FALSE_ALARM
) -> Likely:
    """Return causes that the residual resembles, and then its further orders, as `causes_of` does.

    The arguments are those of `causes_of`.
    """
    likely = causes_of(residual, columns, known, alarm)
    orders = list(likely.orders)
    for _ in range(_ORDERS):
        order = peak(residual.observed, residual.left)
        if order is None or order in orders:
            break
        orders.append(order)
        residual.take(waves(residual.observed, order))
    if not orders:
        return likely
    columns = {**likely.columns, "orders": np.hstack([waves(residual.observed, order) for order in orders])}
    return dataclasses.replace(likely, columns=columns, orders=tuple(orders))


def causes_of(
    residual: Residual, columns: Mapping[str, Array], known: Likely | None = None, alarm: float = FALSE_ALARM
) -> Likely:
    """Return causes that the residual resembles, the most likely first, each given the previous ones.

    Parameters
    ----------
    residual
        The residual of the fit; the causes are added to its unknowns.
    columns
        As `fitting.model.discrepancy.causes` returns them.
    known
        Those already in the fit.
    alarm
        How often noise alone may resemble one of them.
    """
    found = {name: columns[name] for name in known.columns if name in columns} if known else {}
    pulls, formed = residual.pulls, False
    alike = dict(known.alike) if known else {}
    rest = {name: column for name, column in columns.items() if name not in found}
    while rest:
        scores = {name: residual.score(one) for name, one in rest.items()}
        chances = {n: min(chance, pulls.get(n, (1.0, 0.0))[0]) for n, (chance, _) in scores.items()}
        told = [n for n, chance in chances.items() if chance * len(columns) < alarm]
        formed = formed or FORM in told
        told = [n for n in told if n != FORM]
        if not told:
            break
        gains = {
            n: max(float(residual.left @ scores[n][1]) - rest[n].shape[1], pulls.get(n, (1.0, 0.0))[1]) for n in told
        }
        best = max(told, key=lambda n: gains[n])
        alike[best] = tuple(n for n in told if n != best and gains[n] > _ALIKE * gains[best])
        for name in SHIFTS if best in SHIFTS else (best,):  # the sizes of both tell shifts with the load from play
            if name in rest:
                found[name] = rest.pop(name)
                residual.take(found[name])
    return Likely(found, alike, known.orders if known else (), formed)


def _form_of(estimate: Estimate, residual: Residual) -> float:
    """Size of a form that all flanks share, rms of its contribution, rad; 0 if the data need none."""
    observed = estimate.observed
    surface = with_scatter(estimate.state.surface, -estimate.state.scatter)
    values = np.array([structured_value(surface, name) for name in observed.profile])
    if residual.is_zero([estimate.chosen.index(n) for n in observed.profile], values / [*observed.profile.values()]):
        return 0.0
    columns = estimate.linear.structured[:, [observed.errors.index(n) for n in observed.profile]]
    used = (observed.weight > 0.0) & ~observed.of_loops
    return float(np.sqrt(np.mean((columns[used] @ values) ** 2)))


def verdict_of(estimate: Estimate, likely: Likely, formed: bool = False) -> Verdict:
    """Return the verdict on a fit.

    Parameters
    ----------
    estimate
        The end of the fit, with the causes among its unknowns.
    likely
        These causes.
    formed
        Whether the errors include a form of the flanks that was not stated.
    """
    observed, residual = estimate.observed, Residual(estimate)
    failed, yardstick = failures(residual, residual.left)
    used = (observed.weight > 0.0) & ~observed.of_loops
    misfits = []
    for group, part in observed.estimated.items():
        cause = group.removeprefix(f"{MISFIT}_")
        if cause in BESIDE_THE_GEAR:
            # It may have been suspected before the errors were found.
            numbers = range(len(estimate.chosen) + part.start, len(estimate.chosen) + part.stop)
            if residual.is_zero(numbers, estimate.state.bench[part] / residual.scale[numbers.start : numbers.stop]):
                continue
        if cause in likely.columns:
            size = float(np.sqrt(np.mean((observed.bench[used, part] @ estimate.state.bench[part]) ** 2)))
            misfits.append(Misfit(cause, size, likely.alike.get(cause, ()), likely.orders if cause == "orders" else ()))
    if formed and (size := _form_of(estimate, residual)):
        misfits.append(Misfit(FORM, size))
    noise = float(np.exp(np.mean(np.log(yardstick * estimate.noises[observed.running]))))
    largest = max((m.size for m in misfits), default=0.0)
    misfits = [m for m in misfits if m.size > _SMALL * max(largest, noise)]
    state = "not explained" if failed else "explained but for" if misfits else "explained"
    rms = float(np.sqrt(np.mean((residual.left[used] / observed.weight[used]) ** 2)))
    return Verdict(state, tuple(misfits), noise, rms, tuple(failed))
