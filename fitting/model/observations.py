"""Transmission error curves as observations of a drive: the exact model at every point, and its derivatives.

In addition to the errors of the drive the curves contain those of the bench: the zeros of its angles, eccentric
encoders, further compliance between the two encoders, and friction. These are nuisances: fitted with the errors, never
part of the surface.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.analysis import sensitivity, solve
from cycloid_fmu.contact.transmission import form_sensitivity
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.errors.kinds import KINDS, kinds_of, structured_names
from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.supports.transmission import parameters_of
from cycloid_fmu.surfaces.posterior import DISC_PHASE
from cycloid_fmu.surfaces.structured import (
    displacement_columns,
    displacement_layout,
    displacement_vector,
    profile_names,
    profile_wave,
    structured_value,
    with_structured,
)
from cycloid_fmu.surfaces.surface import ErrorSurface
from fitting.model.bearings import lowest_of, pair_with, sizes_of, unknown_bearings
from fitting.model.constraints import Constraints
from fitting.model.first_stage import share_of, turned
from fitting.model.losses import BENCH_HYSTERESIS, curve_sensitivity, is_coefficient, unknown_coefficients
from fitting.model.near_drive import NearDrive
from fitting.model.posterior import Posterior
from fitting.transmission_error.curve import Curve, noise_of

Array = NDArray[np.float64]

ORDERS = (1, 2, 3)  # of pins and teeth that are structured errors; the rest is scatter
PROFILE_ORDERS = (1, 2, 3, 4)  # of the profile deviation that all teeth share, where it is fitted

# What an encoder errs once a turn of its own shaft before anything is measured, rad; its order shows the shaft.
OUTPUT_ENCODER, INPUT_ENCODER = 2e-4, 5e-5
DRIFT = 5e-5  # rad an output turn: how far the angles' zeros may creep while the bench warms up
CREEP = "output_angle_creep"  # change of a common zero from one recording to the next; its size is estimated
CHAIN = "chain_compliance"  # in series with the gear pair; its size is estimated
HYSTERESIS = "output_angle_hysteresis"  # half of a common zero's difference between directions; its size is estimated
MISFIT = "misfit"  # effects outside the model, by cause; their size is estimated
GIVES = ("centre_distance_x", "centre_distance_y", "eccentricity")  # displacements where supports give way
NO_CREEP = 1e-8  # rad
PIN_RADIUS = "pin_radius_deviation"
RADIUS_SPREAD = 0.3e-6  # m: usual of single pins' radii, as a sort of rollers is 2 µm of diameter wide (ISO 3096, G2)
_GOLDEN = 0.5 * (np.sqrt(5.0) - 1.0)
_LEAST_TORQUE = 1e-3  # of a curve's mean: without any the output is free in its play
_OTHER_LOAD = 1.2  # times the smallest load: one at which wind-up differs from play
FRICTION_SHARE = 0.002  # of the largest torque: usual friction at the output
LARGE_FRICTION_SHARE = 0.01  # the same of a bench or drive that rubs
LOOP_FRICTION_PER_LOAD = 0.5  # growth of a loop's friction with load: measured drives have up to 0.7
_SELF_LOCKING = 0.95  # largest growth in the model: from 1 on a drive does not unload
LOST_MOTION = "lost motion"
"""Branch of points whose second half is taken from the first, as one measurement of the mean difference."""
COMPLIANCE_SHARE = 0.02  # of the gear pair's own compliance; a softer chain is a cause of misfit, whose size is found
KNOWN_SIZES = {
    DISC_PHASE: 10e-6,
    "hole_x": 5e-6,
    "hole_y": 5e-6,
    "crank_x": 5e-6,
    "crank_y": 5e-6,
    "roller_x": 5e-6,
    "roller_y": 5e-6,
    "crank_throw": 3e-6,
    "crank_phase": 3e-4,
    "hole_radius": 3e-6,
}
"""Prior standard deviation of elements of which a drive has too few to estimate it, m or rad."""


@dataclass(frozen=True)
class Discrepancy:
    """Causes of misfit in a fit, and the model near which their effect is linear.

    Attributes
    ----------
    columns
        {cause: shape (points, columns)}, whose coefficients are rad.
    give, ripple
        As in `Observations`.
    taken
        Contribution of the columns of `give` and `ripple` which is already in the model, shape (points,), rad.
    """

    columns: Mapping[str, Array]
    give: Array | None = None
    ripple: Array | None = None
    taken: Array | float = 0.0


@dataclass(frozen=True)
class Observations:
    """Curves as one long vector.

    Attributes
    ----------
    curves
        The curves.
    measured, weight
        Shape (points,): transmission error (rad) and 1/noise of each point (1/rad; 0 leaves a point out).
    bench_names, bench, bench_prior
        Nuisances in which the transmission error is linear: names, columns (points, nuisances) and prior standard
        deviations (infinite: unknown).
    fit_crank
        Whether the crank's zero is unknown too.
    friction_prior
        Prior standard deviation of the friction torque of curves, N·m.
    with_loops
        Whether there are branches of loops, which have their own friction, growing with load.
    errors, profile
        The structured errors considered, and {order of the profile deviation: prior size, m} of those among them.
    give
        Displacements of the supports in each curve, shape (curves, 4): `GIVES`, m, and the crank, rad.
    ripple
        Torque at each point beyond the stated one, as a share of it, shape (points,).
    bearing_names, bearing_prior, bearing_lowest
        Unknowns of the drive's own bearings, elastic bodies, friction and first stage, their prior deviations, and
        their largest decreases, as in `fitting.model.bearings`.
    first_stage
        First stage, for curves of a whole reducer.
    chain_prior
        Usual size of the chain's compliance, rad/(N·m): a small share of the gear pair's own.
    constraints
        What a user has decided of the unknowns.
    earlier
        What earlier measurements have told of the unknowns.
    form
        Derivatives by the orders of `profile`, shape (points, orders), rad/m; None: those of the model, which has none
        on bearings.
    """

    curves: tuple[Curve, ...]
    measured: Array
    weight: Array
    bench_names: tuple[str, ...]
    bench: Array
    bench_prior: Array
    fit_crank: bool
    friction_prior: float
    with_loops: bool
    errors: tuple[str, ...]
    profile: Mapping[str, float]
    give: Array | None = None
    ripple: Array | None = None
    bearing_names: tuple[str, ...] = ()
    bearing_prior: Array = field(default_factory=lambda: np.zeros(0))
    bearing_lowest: Array = field(default_factory=lambda: np.zeros(0))
    first_stage: FirstStage | None = None
    chain_prior: float = 0.0
    constraints: Constraints | None = None
    earlier: Posterior | None = None
    form: Array | None = None

    @property
    def running(self) -> list[int]:
        """Which of the curves were taken with the crank turning, the others being branches of loops."""
        return [i for i, c in enumerate(self.curves) if not c.branch]

    @property
    def of_loops(self) -> NDArray[np.bool_]:
        """Which points are of loops, shape (points,)."""
        return np.concatenate([np.full(c.input_angle.size, bool(c.branch)) for c in self.curves])

    @property
    def of_lost_motions(self) -> NDArray[np.bool_]:
        """Which points are of lost motions, shape (points,)."""
        return np.concatenate([np.full(c.input_angle.size, c.branch == LOST_MOTION) for c in self.curves])

    def rows_of_curves(self, rows: Array) -> list[Array]:
        """Return the rows of each curve from all rows of a fit."""
        sizes = [1 if c.branch == LOST_MOTION else c.input_angle.size for c in self.curves]
        return np.split(rows, np.cumsum(sizes)[:-1])

    def rows(self, points: Array) -> Array:
        """Return the rows of a fit from its points, the first axis: each lost motion is one row, a mean difference."""
        if not any(c.branch == LOST_MOTION for c in self.curves):
            return points
        parts = np.split(points, self.ends)
        for number, curve in enumerate(self.curves):
            if curve.branch == LOST_MOTION:
                first, second = np.split(parts[number], 2)
                parts[number] = (first - second).mean(axis=0, keepdims=True)
        return np.concatenate(parts)

    @property
    def torque(self) -> Array:
        """Torque at each point with the part that its sensor did not show, shape (points,), N·m."""
        return np.concatenate([self.torque_of(number) for number in range(len(self.curves))])

    def torque_of(self, number: int) -> Array:
        """Torque of a curve at its points with the part that its sensor did not show, N·m."""
        torque = self.curves[number].torque_at_points
        return torque if self.ripple is None else torque * (1.0 + np.split(self.ripple, self.ends)[number])

    @property
    def friction_names(self) -> tuple[str, ...]:
        """Friction at the output while it turns and, with loops, while it is only wound up, which grows with load."""
        of_loops = ("loop_friction_torque", "loop_friction_per_load") if self.with_loops else ()
        return ("friction_torque", *of_loops)

    @property
    def friction_priors(self) -> Array:
        """Prior standard deviations of `friction_names`, N·m and 1; infinite: unknown."""
        return np.array([self.friction_prior, *((np.inf, LOOP_FRICTION_PER_LOAD) if self.with_loops else ())])

    @property
    def estimated(self) -> dict[str, slice]:
        """Groups of the bench's nuisances whose common size the fit estimates.

        Creeping zeros, causes of misfit, and compliance and hysteresis of the chain between the encoders as far as the
        curves separate these from the drive's play.
        """
        groups: dict[str, slice] = {}
        of_chain = self._of_chain
        for i, name in enumerate(self.bench_names):
            if name.startswith((CREEP, MISFIT)):
                group = name.rpartition("_")[0]
                groups[group] = slice(groups[group].start if group in groups else i, i + 1)
            elif name in of_chain:
                groups[name] = slice(i, i + 1)
        return groups

    @property
    def _of_chain(self) -> set[str]:
        """Which of compliance and hysteresis of the chain the curves separate from the drive's play."""
        zeros = [self.curves[i] for i in self.running if self.curves[i].common_zero]
        sizes = np.array([abs(c.torque) for c in zeros])
        ways = {(np.sign(c.torque), c.direction) for c in zeros}
        several_loads = sizes.size > 0 and bool(sizes.max() > _OTHER_LOAD * sizes.min())
        # Where further compliance is among the causes of misfit, the chain's own has the usual size.
        is_cause = any(name.startswith(f"{MISFIT}_compliance_") for name in self.bench_names)
        found = {CHAIN} if (several_loads or self.with_loops) and not is_cause else set()
        return found | ({HYSTERESIS} if len(ways) > len({sign for sign, _ in ways}) else set())

    def least(self, group: str) -> float:
        """Smallest size of a group of `estimated`: rad, of the chain rad/(N·m)."""
        if group == HYSTERESIS and any(map(is_coefficient, self.bearing_names)):
            return BENCH_HYSTERESIS  # unknown friction must not be certain from what the bench does between directions
        return self.chain_prior if group == CHAIN else NO_CREEP

    def with_sizes(self, sizes: Mapping[str, float]) -> Observations:
        """The same with the sizes of these groups, rad, of the chain rad/(N·m), as prior of their nuisances."""
        prior = self.bench_prior.copy()
        for group, part in self.estimated.items():
            prior[part] = max(sizes.get(group, 0.0), self.least(group))
        return dataclasses.replace(self, bench_prior=prior)

    def with_misfit(self, misfit: Discrepancy) -> Observations:
        """The same with the contributions of causes of misfit."""
        names = [f"{MISFIT}_{cause}_{i}" for cause, column in misfit.columns.items() for i in range(column.shape[1])]
        bench = self.bench.copy()
        if misfit.ripple is not None:
            bench[:, self.bench_names.index(CHAIN)] *= 1.0 + misfit.ripple
        return dataclasses.replace(
            self,
            bench_names=(*self.bench_names, *names),
            bench=np.hstack([bench, *misfit.columns.values()]),
            bench_prior=np.concatenate([self.bench_prior, np.full(len(names), NO_CREEP)]),
            give=misfit.give,
            ripple=misfit.ripple,
            measured=self.measured + misfit.taken,
        )

    def with_form(self, columns: Array, form: float) -> Observations:
        """The same with the orders of a form that all flanks share (`form_columns`) as nuisances of this size, m."""
        names = [f"form_{i}" for i in range(columns.shape[1])]
        return dataclasses.replace(
            self,
            bench_names=(*self.bench_names, *names),
            bench=np.hstack([self.bench, columns]),
            bench_prior=np.concatenate([self.bench_prior, np.full(len(names), form)]),
        )

    @property
    def ends(self) -> NDArray[np.int64]:
        """Where one curve ends and the next begins, shape (curves - 1,)."""
        return np.cumsum([c.input_angle.size for c in self.curves])[:-1]

    def thinned(self, points: int) -> Observations:
        """A subset of about this many points of all curves, evenly over the crank angle, and all points of loops."""
        share = points / self.measured.size
        # Multiples of the golden section fall into step with nothing.
        chosen = [bool(c.branch) | (np.mod(np.arange(c.input_angle.size) * _GOLDEN, 1.0) < share) for c in self.curves]
        curves = tuple(c.points(one) for c, one in zip(self.curves, chosen, strict=True))
        every = np.concatenate(chosen)
        return dataclasses.replace(
            self,
            curves=curves,
            measured=self.measured[every],
            weight=self.weight[every],
            bench=self.bench[every],
            ripple=None if self.ripple is None else self.ripple[every],
            form=None if self.form is None else self.form[every],
        )

    def some(self, numbers: Sequence[int] | NDArray[np.int64]) -> Observations:
        """A subset of the curves."""
        places = np.split(np.arange(self.measured.size), self.ends)
        part = np.concatenate([places[n] for n in numbers])
        return dataclasses.replace(
            self,
            curves=tuple(self.curves[n] for n in numbers),
            measured=self.measured[part],
            weight=self.weight[part],
            bench=self.bench[part],
            give=None if self.give is None else self.give[list(numbers)],
            ripple=None if self.ripple is None else self.ripple[part],
            form=None if self.form is None else self.form[part],
        )


def observations(
    curves: Sequence[Curve],
    pair: Pair,
    noise: Sequence[float] | None = None,
    profile: Mapping[str, float] | None = None,
    first_stage: FirstStage | None = None,
    constraints: Constraints | None = None,
    earlier: Posterior | None = None,
    friction_share: float = FRICTION_SHARE,
) -> Observations:
    """Return curves as observations of a pair.

    Parameters
    ----------
    curves
        One or more, branches of loops among them.
    pair
        The nominal pair.
    noise
        Noise of a single point of each curve, rad; by default that of the curves.
    profile
        Orders of the profile deviation to consider too, with their prior sizes, m.
    first_stage
        First stage of the curves, which are over the angle of ideal cranks (`fitting.model.first_stage.of_cranks`).
    constraints, earlier
        As in `Observations`.
    friction_share
        Prior size of the friction at the output over the largest torque.
    """
    shown = np.array([noise_of(c) for c in curves] if noise is None else noise)
    floor = max(float(np.median(shown)), 1e-9)
    weight = [
        np.sqrt(c.sample_count / np.median(c.sample_count)) / max(n, 0.1 * floor, 1e-9)
        for c, n in zip(curves, shown, strict=True)
    ]
    sizes = [c.input_angle.size for c in curves]
    crank = np.concatenate([c.input_angle for c in curves])
    torque = np.concatenate([c.torque_at_points for c in curves])
    names, columns, priors = [], [], []
    # The branches of a loop share its zero and its creep.
    recordings: dict[str | int, list[int]] = {}
    for number, curve in enumerate(curves):
        recordings.setdefault(curve.source if curve.branch else number, []).append(number)
    absolute = [group for group in recordings.values() if curves[group[0]].common_zero]
    own = [group for group in recordings.values() if not curves[group[0]].common_zero]
    groups = [[i for group in absolute for i in group]] if absolute else []
    groups += [g for g in own if not curves[g[0]].branch]
    zeros = {"output_angle_offset" if len(groups) == 1 else f"output_angle_offset_{n}": g for n, g in enumerate(groups)}
    zeros |= {f"loop_angle_offset_{n}": g for n, g in enumerate(g for g in own if curves[g[0]].branch)}
    for name, group in zeros.items():
        names.append(name)
        columns.append(np.repeat([float(i in group) for i in range(len(curves))], sizes))
        priors.append(np.inf)
    for group in absolute if len(absolute) > 1 else []:
        names.append(f"{CREEP}_{group[0]}")
        columns.append(np.repeat([float(i in group) for i in range(len(curves))], sizes))
        priors.append(NO_CREEP)
    ratio = abs(curves[0].ratio)
    whole = ratio if first_stage is None else first_stage.ratio(pair.gear_teeth)
    shafts = (
        ("output", crank / ratio, 1.0, OUTPUT_ENCODER),
        ("input", crank * whole / ratio, 1.0 / whole, INPUT_ENCODER),
    )
    for shaft, angle, lever, prior in shafts:
        for part, wave in (("cos", np.cos(angle)), ("sin", np.sin(angle))):
            names.append(f"{shaft}_encoder_eccentricity_{part}")
            columns.append(lever * wave)
            priors.append(prior)
    for number, curve in enumerate(curves):
        if curve.branch:
            continue
        names.append(f"output_angle_drift_{number}")
        # What creeps does so with time, over all turns, whose points lie between one another.
        turns = (curve.input_angle if curve.travel is None else curve.travel) / (2.0 * np.pi * ratio)
        columns.append(
            np.concatenate([np.zeros(sum(sizes[:number])), turns - turns.mean(), np.zeros(sum(sizes[number + 1 :]))])
        )
        priors.append(DRIFT)
    turning = [i for group in absolute for i in group if not curves[i].branch]
    if turning:
        names.append(HYSTERESIS)
        columns.append(np.repeat([float(c.direction) * (i in turning) for i, c in enumerate(curves)], sizes))
        priors.append(BENCH_HYSTERESIS if unknown_coefficients(pair) else NO_CREEP)
    largest = max(float(np.abs(torque).max()), 1e-9)
    nominal = solve(DriveValue.as_stated(pair), largest, np.linspace(0.0, 2.0 * np.pi, 40), with_play=False)
    names.append(CHAIN)
    columns.append(torque)
    priors.append(COMPLIANCE_SHARE / float(nominal.torsional_stiffness.mean()))
    return Observations(
        curves=tuple(curves),
        measured=np.concatenate([c.transmission_error for c in curves]),
        weight=np.concatenate(weight),
        bench_names=tuple(names),
        bench=np.array(columns).T,
        bench_prior=np.array(priors),
        fit_crank=not all(c.known_index for c in curves),
        friction_prior=friction_share * largest,
        with_loops=any(c.branch for c in curves),
        errors=(*errors_of(pair), *(profile or {})),
        profile=profile or {},
        bearing_names=unknown_bearings(pair, first_stage),
        bearing_prior=sizes_of(pair, first_stage),
        bearing_lowest=lowest_of(pair, first_stage),
        first_stage=first_stage,
        chain_prior=priors[-1],
        constraints=constraints,
        earlier=earlier,
    )


@dataclass(frozen=True)
class State:
    """State of a fit.

    Attributes
    ----------
    surface
        The error surface, including the scatter of pins and teeth.
    scatter
        That scatter alone, shape (2 pins + discs x teeth,), m.
    bench
        The bench's nuisances as in `Observations.bench_names`.
    crank_offset
        The crank's zero, rad.
    friction, loop_friction, loop_friction_per_load
        The friction torques of curves and of loops without load (N·m), and the growth of the latter with the load at
        the flanks: F = F_0 + mu |M|.
    bearings
        Deviations of stiffness and clearance of bearings, stiffness of bodies and friction coefficients from the pair
        file, in the order of `Observations.bearing_names`: logarithms of stiffness and coefficients, m, and rad of a
        first stage's play; none where nothing of them is unknown.
    """

    surface: ErrorSurface
    scatter: Array
    bench: Array
    crank_offset: float = 0.0
    friction: float = 0.0
    loop_friction: float = 0.0
    loop_friction_per_load: float = 0.0
    bearings: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Linear:
    """The model at one state: transmission error without the bench, shape (points,), and its derivatives.

    `structured` (points, errors as in `Observations.errors`), `scatter` (points, those of `scatter_names`), `bearings`
    (points, those of `Observations.bearing_names`), by crank angle, by friction torque, and by the growth of a loop's
    friction with load (points,). `coordinates` are those of the balance on bearings (points, coordinates), from which
    the model at a state nearby is solved in fewer steps.
    """

    model: Array
    structured: Array
    scatter: Array
    bearings: Array
    by_crank: Array
    by_friction: Array
    by_friction_per_load: Array
    coordinates: Array


def errors_of(pair: Pair) -> list[str]:
    """Return the structured errors considered in every fit of this pair."""
    return structured_names([k for k in ORDERS if 2 * k < pair.gear_teeth])


def scatter_parts(pair: Pair) -> dict[str, slice]:
    """Return the position of each pattern of single displacements in a scatter vector.

    Every pin's place, every tooth's pitch and every pin's radius; for further discs the offset of their teeth from
    those of the first one, `disc_phase`; with supports each hole, crank, roller and eccentric.
    """
    g = pair
    sizes = {
        "pin_radial": g.pins,
        "pin_tangential": g.pins,
        "tooth_cumulative_pitch": g.discs * g.gear_teeth,
        PIN_RADIUS: g.pins,
    }
    if g.discs > 1:
        sizes[DISC_PHASE] = g.discs - 1
    sizes |= {name: math.prod(kind.shape(g)) for name, kind in kinds_of(g).items() if kind.of_supports}
    ends = np.cumsum([*sizes.values()]).tolist()
    return {name: slice(end - size, end) for (name, size), end in zip(sizes.items(), ends, strict=True)}


def estimated_parts(pair: Pair) -> dict[str, slice]:
    """Return the patterns of `scatter_parts` whose common size the fit estimates: those with many elements."""
    return {name: part for name, part in scatter_parts(pair).items() if name not in KNOWN_SIZES}


def scatter_names(pair: Pair) -> list[str]:
    """Return the names of the single displacements in a scatter vector, as a surface's covariance has them."""
    return [f"{name}_at_{i}" for name, part in scatter_parts(pair).items() for i in range(part.stop - part.start)]


def spread_of(pair: Pair, deviations: Mapping[str, float]) -> Array:
    """Return the standard deviation of each displacement in a scatter vector from those of the patterns, m or rad.

    Patterns that are not named have the usual size (`KNOWN_SIZES`), or none.
    """
    sizes = {**KNOWN_SIZES, **deviations}
    return np.concatenate([np.full(p.stop - p.start, sizes.get(n, 0.0)) for n, p in scatter_parts(pair).items()])


def with_scatter(surface: ErrorSurface, scatter: Array) -> ErrorSurface:
    """Return a surface with every single displacement of a scatter vector added."""
    pair = surface.pair
    parts = scatter_parts(pair)
    values = {
        n: surface.errors[n] + scatter[p].reshape(surface.errors[n].shape) for n, p in parts.items() if n in KINDS
    }
    if DISC_PHASE in parts:
        pitch = np.array(values["tooth_cumulative_pitch"])
        pitch[1:] += scatter[parts[DISC_PHASE], None]
        values["tooth_cumulative_pitch"] = pitch
    return surface.replace(**values)


def scatter_between(surface: ErrorSurface, plain: ErrorSurface) -> Array:
    """Return the scatter vector between two surfaces; a disc's phase is the mean over its teeth."""
    pair = surface.pair
    parts, found = scatter_parts(pair), spread_of(pair, {})
    for name, part in parts.items():
        if name in KINDS:
            found[part] = (surface.errors[name] - plain.errors[name]).ravel()
    if DISC_PHASE in parts:
        pitch = found[parts["tooth_cumulative_pitch"]].reshape(pair.discs, -1)
        found[parts[DISC_PHASE]] = pitch[1:].mean(axis=1)
        pitch[1:] -= pitch[1:].mean(axis=1, keepdims=True)
    return found


def scatter_columns(pair: Pair, each: Array) -> Array:
    """Return derivatives by a scatter vector, last axis, from those by every error as in `contact.sensitivities`."""
    layout = displacement_layout(pair)
    by_tooth = each[..., layout["tooth_turn"]] / pair.pin_circle_radius
    columns = [
        each[..., layout["pin_radial"]],
        each[..., layout["pin_tangential"]],
        by_tooth,
        each[..., layout["pin_radius"]],
    ]
    if pair.discs > 1:
        by_disc = by_tooth.reshape(*each.shape[:-1], pair.discs, pair.gear_teeth).sum(axis=-1)
        columns.append(by_disc[..., 1:])
    for kind in kinds_of(pair).values():
        if kind.of_supports:
            columns += [each[..., layout[displaced]] for displaced in kind.displaces]
    return np.concatenate(columns, axis=-1)


def linearisation_point(pair: Pair, surface: ErrorSurface, observed: Observations) -> tuple[NearDrive, ...]:
    """Solve a drive at every point of every curve; return what takes drives near it to first order, one a curve."""

    def one(curve: Curve) -> NearDrive:
        return NearDrive(DriveValue(pair, surface), curve.torque, curve.input_angle)

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return tuple(pool.map(one, observed.curves))


def _torque_at_flanks(observed: Observations, number: int, state: State) -> tuple[Array, float, Array]:
    """Return torque at the flanks of a curve (N·m), sign of friction in it, and its derivative by the stated torque."""
    curve, least = observed.curves[number], _LEAST_TORQUE * observed.curves[number].torque
    # The torques of a lost motion are those at the flanks: they include friction.
    against = -float(curve.direction) * np.sign(curve.ratio) * (curve.branch != LOST_MOTION)
    torque = observed.torque_of(number)
    growth = min(state.loop_friction_per_load, _SELF_LOCKING) if curve.branch else 0.0
    # M = T ± (F_0 + mu |M|) at the flanks.
    by_torque_stated = 1.0 / (1.0 - against * np.sign(torque) * growth)
    torque = by_torque_stated * (torque + against * (state.loop_friction if curve.branch else state.friction))
    return np.where(np.abs(torque) < abs(least), least, torque), against, by_torque_stated


def _where_supports_gave_way(observed: Observations, number: int, state: State) -> tuple[ErrorSurface, Array]:
    """Return the errors of the drive during a curve, and the crank angles of its points."""
    surface, crank_angle = state.surface, observed.curves[number].input_angle + state.crank_offset
    if observed.give is None:
        return surface, crank_angle
    *shifts, advance = observed.give[number]
    values = {n: structured_value(surface, n) + shift for n, shift in zip(GIVES, shifts, strict=True)}
    return with_structured(surface, values), crank_angle + advance


def _at_the_cranks(
    pair: Pair, observed: Observations, number: int, state: State, torque: Array
) -> tuple[ErrorSurface, Array, Array]:
    """Return the errors of the drive during a curve, the angles of its cranks, and how far a first stage is behind."""
    surface, crank_angle = _where_supports_gave_way(observed, number, state)
    if observed.first_stage is None:
        return surface, crank_angle, np.zeros_like(torque)
    play = state.bearings[-1] if state.bearings.size else 0.0
    behind = turned(observed.first_stage, pair, torque, play)
    return surface, crank_angle + behind, behind


def linearised_curve(
    pair: Pair,
    observed: Observations,
    number: int,
    state: State,
    around: Sequence[NearDrive] | None = None,
    near: Array | None = None,
) -> Linear:
    """Evaluate the model and its analytic derivatives by every structured error at every point of one curve.

    The model is the exact one, or about a drive the linearised one, without the crank's zero and form. `near` are the
    `coordinates` of the model at a state nearby.
    """
    curve = observed.curves[number]
    torque, against, by_torque_stated = _torque_at_flanks(observed, number, state)
    surface, crank_angle, w = _at_the_cranks(pair, observed, number, state, torque)
    s = share_of(observed.first_stage, pair)
    by_bearing = coordinates = np.zeros((torque.size, 0))
    if around is None:
        drive = DriveValue(pair_with(pair, state.bearings), surface)
        solved, by_friction_of_drive = curve_sensitivity(
            drive, s * torque, crank_angle, curve, pair, observed.first_stage, near
        )
        model, each, coordinates = solved.transmission_error, solved.by_displacement, solved.coordinates
        by_crank, by_torque = solved.by_crank_angle, solved.by_torque
        if pair.supports is not None:
            laws = parameters_of(pair)
            by_law = solved.by_bearing[:, [laws.index(n) for n in observed.bearing_names if n in laws]]
            by_bearing = np.hstack([by_law, by_friction_of_drive])
    else:
        model, each, by_torque = around[number].sensitivities(displacement_vector(pair, surface), torque)
        by_crank = np.zeros_like(model)
    jacobian = each @ displacement_columns(pair, observed.errors)
    profiles = [i for i, name in enumerate(observed.errors) if profile_wave(name, 1) is not None]
    if profiles and observed.form is not None:
        jacobian[:, profiles] = np.split(observed.form, observed.ends)[number]
    elif profiles and around is None and pair.supports is None:
        of_form = [observed.errors[i] for i in profiles]
        jacobian[:, profiles] = form_sensitivity(DriveValue(pair, surface), model, crank_angle, of_form)
    scatter = scatter_columns(pair, each)
    by_friction = against * by_torque_stated * by_torque
    by_growth = by_friction * np.abs(torque) * bool(curve.branch)
    if observed.first_stage is None:
        return Linear(model, jacobian, scatter, by_bearing, by_crank, by_friction, by_growth, coordinates)
    play = 0.5 * np.sign(torque) * observed.first_stage.bearing_play - w / pair.gear_teeth
    by_play = -0.5 * np.sign(torque) * (by_crank - 1.0 / pair.gear_teeth)
    by_bearing = np.column_stack([by_bearing, by_play])
    # The cranks turn with the output's deviation, to first order.
    share = s / (1.0 - s * observed.first_stage.crank_share * by_crank)
    of = share[:, None]
    return Linear(
        share * (model + play),
        of * jacobian,
        of * scatter,
        of * by_bearing,
        share * by_crank,
        share * s * by_friction,
        share * s * by_growth,
        coordinates,
    )


def form_columns(pair: Pair, observed: Observations, state: State, linear: Linear, size: float) -> Array:
    """Return derivatives by the `PROFILE_ORDERS` of a form that all flanks share, shape (points, orders), rad/m.

    They are those of the model, at its displacements of the supports: near a corner of a curve those at other crank
    angles would not balance the effect of other errors, and a form could be told from an eccentricity that looks like
    it. On bearings, where contacts open and close with a form and the discs follow, they are finite differences over
    ± `size`, m. `linear` is the exact model at the state.
    """
    names = profile_names(PROFILE_ORDERS)
    share = np.full(linear.model.size, share_of(observed.first_stage, pair))
    if observed.first_stage is not None and pair.supports is None:
        share *= 1.0 + observed.first_stage.crank_share * linear.by_crank
    drive, coordinates = pair_with(pair, state.bearings), np.split(linear.coordinates, observed.ends)

    def by_form(number: int) -> Array:
        near = coordinates[number]
        if pair.supports is None:
            torque, _, _ = _torque_at_flanks(observed, number, state)
            surface, angle, _ = _at_the_cranks(pair, observed, number, state, torque)
            return form_sensitivity(DriveValue(pair, surface), near[:, 0], angle, names)
        torque, (surface, angle) = observed.torque_of(number), _where_supports_gave_way(observed, number, state)
        torque = np.where(torque == 0.0, _LEAST_TORQUE * observed.curves[number].torque, torque)
        torque = torque * share_of(observed.first_stage, pair)

        def moved(name: str, by: float) -> Array:
            formed = with_structured(surface, {name: structured_value(surface, name) + by})
            error: Array = sensitivity(DriveValue(drive, formed), torque, angle, near=near).transmission_error
            return error

        return np.column_stack([(moved(n, size) - moved(n, -size)) / (2.0 * size) for n in names])

    with ThreadPoolExecutor(os.cpu_count()) as pool:
        columns: Array = share[:, None] * np.concatenate(list(pool.map(by_form, range(len(observed.curves)))))
    return columns


def linearise(
    pair: Pair,
    observed: Observations,
    state: State,
    around: Sequence[NearDrive] | None = None,
    near: Linear | None = None,
) -> Linear:
    """Evaluate the model and its analytic derivatives at every point of every curve, as `linearised_curve` does.

    `near` is the model of the same points at a state nearby.
    """
    numbers = range(len(observed.curves))
    starts = [None for _ in numbers] if near is None else np.split(near.coordinates, observed.ends)
    # The kernel works without Python's lock.
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        return joined(list(pool.map(lambda i: linearised_curve(pair, observed, i, state, around, starts[i]), numbers)))


def joined(each: Sequence[Linear]) -> Linear:
    """Return the models of curves, one after another, as one."""
    return Linear(*(np.concatenate([getattr(f, n.name) for f in each]) for n in dataclasses.fields(Linear)))


def split(linear: Linear, ends: NDArray[np.int64]) -> list[Linear]:
    """Return the model of each curve from that of all, whose curves end at `ends`, the last one's apart."""
    parts = [np.split(getattr(linear, f.name), ends) for f in dataclasses.fields(Linear)]
    return [Linear(*each) for each in zip(*parts, strict=True)]


def left_of(observed: Observations, linear: Linear, state: State) -> Array:
    """Measured minus modelled transmission error, the bench's part included, shape (points,), rad."""
    return observed.measured - linear.model - observed.bench @ state.bench
