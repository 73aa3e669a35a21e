"""Effects of real drives and benches outside the model of rigid supports and ideal encoders, by cause.

A discrepancy in the sense of Kennedy and O'Hagan (J. R. Stat. Soc. B 63 (2001) 425): a function of crank angle, output
angle and torque in addition to the model, here of low rank: a few columns of estimated size for each cause.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.geometry.pair import Pair
from fitting.model.observations import COMPLIANCE_SHARE, GIVES, Linear, Observations, State, form_columns
from fitting.transmission_error.curve import Curve
from fitting.transmission_error.spectrum import RIG_ORDERS

Array = NDArray[np.float64]

GIVE, PLAY, RIPPLE, LAG, FORM, RUN_OUT_CAUSE = (
    "support_give",
    "support_play",
    "torque_ripple",
    "clock_lag",
    "flank_form",
    "run_out",
)
_FORM_STEP = 1e-6  # m: step of the differences with respect to a form
_SLOW = 6  # degree of the drift of a zero over a recording
_CRANK = 100.0  # rad of the crank per rad of the transmission error
_STEADY = 1e-3  # relative change of the speed below which a lag has no effect
SHIFTS = (GIVE, PLAY)  # causes that shift the supports
BESIDE_THE_GEAR = ("compliance", RUN_OUT_CAUSE, "drift")  # causes that act outside the contacts
SENTENCES = {
    GIVE: "supports that are compliant under load",
    PLAY: "supports with play, which shift with the side of the load",
    "compliance": "further compliance between the encoders",
    "friction": "friction that grows with the load",
    RIPPLE: "torque that the sensor does not measure",
    RUN_OUT_CAUSE: "run-out of a shaft or its encoder",
    FORM: "a form that all flanks share",
    "drift": "a zero that drifts within a recording",
    LAG: "a delay of one angle's clock",
}


def causes(pair: Pair, observed: Observations, linear: Linear, formed: State | None = None) -> dict[str, Array]:
    """Return the possible contributions of each cause to the transmission error, near a state of the model.

    Parameters
    ----------
    pair, observed, linear
        The nominal pair, the observations, and the model at the state.
    formed
        The state, if an unknown form common to all flanks is one of the causes; its effect is to first order, which is
        sufficient to detect it.

    Returns
    -------
    columns
        {cause as in `SENTENCES`: shape (points, columns)}, of size near 1, so coefficients are in rad, of a form in m.
        Causes without effect on these recordings are left out.
    """
    curves = observed.curves
    sizes = [c.input_angle.size for c in curves]
    torque = observed.torque
    load, running = torque / max(float(np.abs(torque).max()), 1e-9), ~observed.of_loops
    against = np.repeat([-float(c.direction) * np.sign(c.ratio) for c in curves], sizes)
    stated = np.concatenate([c.torque_at_points for c in curves])
    by_ripple = linear.by_friction * against * stated * running
    by_load, by_side = _shifts(pair, observed, linear)
    found = {
        GIVE: by_load,
        PLAY: by_side,
        "friction": [_unit(linear.by_friction * np.abs(load))],
        RIPPLE: [by_ripple * wave * _ripple_unit(observed) for wave in _waves(observed).T],
    }
    late = by_lag(observed, linear)
    if late.any():
        found[LAG] = [_unit(late)]
    if formed is not None:
        found[FORM] = list(form_columns(pair, observed, formed, linear, _FORM_STEP).T)
    return _with_effect(found) | beside_the_gear(observed)


def beside_the_gear(observed: Observations) -> dict[str, Array]:
    """Return the possible contributions of `BESIDE_THE_GEAR`, which do not depend on the model, as `causes` does."""
    load = observed.torque
    load = load / max(float(np.abs(load).max()), 1e-9)
    crank = np.concatenate([c.input_angle for c in observed.curves])
    run_out = [
        wave * ~observed.of_loops
        for order in RIG_ORDERS
        for angle in (crank / abs(observed.curves[0].ratio), crank)
        for wave in (np.cos(order * angle), np.sin(order * angle))
    ]
    drift = _of_curves(observed, [_drifts(way(c)) for c in observed.curves])
    every = zip(BESIDE_THE_GEAR, ([load, load * np.abs(load)], run_out, drift), strict=True)
    return _with_effect({name: [_unit(column) for column in columns] for name, columns in every})


def _with_effect(found: Mapping[str, Sequence[Array]]) -> dict[str, Array]:
    """The causes that have an effect, their columns side by side."""
    every = {name: np.column_stack(columns) for name, columns in found.items() if columns}
    return {name: columns for name, columns in every.items() if columns.any()}


def by_lag(observed: Observations, linear: Linear) -> Array:
    """Return the effect of a delayed output angle per second of delay, shape (points,), rad/s.

    A delayed output angle belongs to an earlier crank angle. At constant speed this is an offset, like play, so the
    effect is set to zero there, and where the speed is unknown.
    """
    lags = [np.zeros(c.input_angle.size) if c.speed is None else _changing(c.speed) for c in observed.curves]
    found: Array = -np.concatenate(lags) * (1.0 / observed.curves[0].ratio + np.nan_to_num(linear.by_crank))
    return found


def _shifts(pair: Pair, observed: Observations, linear: Linear) -> tuple[list[Array], list[Array]]:
    """Effects of shifts of ring, disc and crank: proportional to the load and to its size; and to its sign."""
    shifts = [linear.structured[:, observed.errors.index(n)] for n in GIVES]
    # A disc on a compliant crank leads or lags it, as if the crank had another angle.
    *by_load, by_side = _growth(observed, np.concatenate([c.torque_at_points for c in observed.curves]))
    # At a corner a curve has no slope.
    each = [shift * unit for shift, unit in zip((*shifts, np.nan_to_num(linear.by_crank)), _units(pair), strict=True)]
    return [shift * of for shift in each for of in by_load], [shift * by_side for shift in each]


def _growth(observed: Observations, torque: Array) -> tuple[Array, Array, Array]:
    largest = max(float(np.abs(c.torque_at_points).max()) for c in observed.curves)
    return torque / largest, np.abs(torque) / largest, np.sign(torque)


def _units(pair: Pair) -> Array:
    """Shift (m, of the crank rad) for a coefficient of one: some rad of the transmission error."""
    return np.array([pair.gear_teeth * pair.eccentricity] * len(GIVES) + [_CRANK])


def given_way(pair: Pair, observed: Observations, give: Array | None, play: Array | None) -> Array:
    """Return the displacement of the supports in each curve.

    Parameters
    ----------
    pair, observed
        The nominal pair and the observations.
    give, play
        Coefficients of the columns of `GIVE` and `PLAY`, rad, where they are in the fit.

    Returns
    -------
    shifts
        Shape (curves, 4), as `Observations.give`; 0 for loops, whose torque varies.
    """
    *by_load, by_side = np.array(_growth(observed, np.array([c.torque for c in observed.curves])))
    shifts = np.zeros((len(observed.curves), len(GIVES) + 1))
    if give is not None:
        shifts += (give.reshape(-1, len(by_load)) @ np.array(by_load)).T * _units(pair)
    if play is not None:
        shifts += np.outer(by_side, play * _units(pair))
    shifts[[i for i, c in enumerate(observed.curves) if c.branch]] = 0.0
    return shifts


def ripple_of(observed: Observations, coefficients: Array) -> Array:
    """Return the part of the torque that the sensor did not measure, as a share of what it did.

    Parameters
    ----------
    observed
        The observations.
    coefficients
        Coefficients of the columns of `RIPPLE`, rad.

    Returns
    -------
    ripple
        Shape (points,), as `Observations.ripple`; 0 for loops.
    """
    found: Array = _waves(observed) @ coefficients * _ripple_unit(observed) * ~observed.of_loops
    return found


def _waves(observed: Observations) -> Array:
    """Waves of a torque once and twice a turn of the crank and once a turn of the output, shape (points, waves)."""
    crank = np.concatenate([c.input_angle for c in observed.curves])
    angles = (crank, 2.0 * crank, crank / abs(observed.curves[0].ratio))
    return np.column_stack([wave(angle) for angle in angles for wave in (np.cos, np.sin)])


def _ripple_unit(observed: Observations) -> float:
    """Ripple of the torque, as a share of it, for a coefficient of one: about one rad of the transmission error."""
    largest = max(abs(c.torque) for c in observed.curves)
    return COMPLIANCE_SHARE / (observed.chain_prior * largest)


def way(curve: Curve) -> Array:
    """Output turns from the start of a curve to each point, increasing with time if that is known."""
    turned = curve.input_angle if curve.travel is None else curve.travel
    found: Array = turned / (2.0 * np.pi * abs(curve.ratio))
    return found


def is_whole(order: float) -> bool:
    """Whether an order repeats with the output's turns."""
    return abs(order - round(order)) < 1e-6


def waves(observed: Observations, order: float) -> Array:
    """Return columns of an order of the output.

    Parameters
    ----------
    observed
        The observations.
    order
        Order of the output. If it repeats with the output turns, its size is constant or grows with the torque, equally
        in both directions or not. Otherwise its phase differs from curve to curve.

    Returns
    -------
    columns
        Shape (points, columns), each with a root mean square of 1.
    """
    if not is_whole(order):
        phases = [2.0 * np.pi * order * way(c) for c in observed.curves]
        every = _of_curves(observed, [[np.cos(phase), np.sin(phase)] for phase in phases])
        return np.column_stack([_unit(one) for one in every])
    torque = np.concatenate([c.torque_at_points for c in observed.curves])
    phase = order * np.concatenate([c.input_angle / abs(c.ratio) for c in observed.curves])
    running = (~observed.of_loops).astype(float)
    return np.column_stack(
        [
            _unit(wave * of * running)
            for wave in (np.cos(phase), np.sin(phase))
            for of in (np.ones_like(torque), np.sign(torque), torque)
        ]
    )


def _unit(column: Array) -> Array:
    size = float(np.sqrt(np.mean(column**2)))
    found: Array = column / size if size > 0.0 else column
    return found


def _drifts(turned: Array) -> list[Array]:
    """Legendre polynomials over a recording, beyond the straight line: any slow change."""
    share = 2.0 * (turned - turned.min()) / max(float(np.ptp(turned)), 1e-12) - 1.0
    return list(np.polynomial.legendre.legvander(share, _SLOW)[:, 2:].T)


def _of_curves(observed: Observations, each: Sequence[Sequence[Array]]) -> list[Array]:
    """Columns of single curves, zero outside their curve; none for loops."""
    of_curves = []
    ends = [0, *observed.ends.tolist(), observed.measured.size]
    for number in observed.running:
        for values in each[number]:
            column = np.zeros(observed.measured.size)
            column[ends[number] : ends[number + 1]] = values
            of_curves.append(column)
    return of_curves


def _changing(speed: Array) -> Array:
    """The speed, or zero where it is steady."""
    steady = float(speed.std()) < _STEADY * abs(float(speed.mean()))
    return np.zeros_like(speed) if steady else speed
