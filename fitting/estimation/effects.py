"""Effect of each identified error on the transmission error: what to correct first."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.errors.kinds import KINDS, kind_of, wave_of
from cycloid_fmu.geometry.pair import Pair
from fitting.estimation.parameter import Parameter, parameter_as_json
from fitting.estimation.realised import ORDERS_STATED, Realised
from fitting.model.observations import PIN_RADIUS, Linear, Observations, State, scatter_parts

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Effect:
    """An error of this drive and its effect on the transmission error.

    Attributes
    ----------
    kind
        Name of the error's kind, such as `eccentricity` or `pin_radial`.
    order
        Order round the ring or gear; None for an error of the drive, and for what no stated order explains.
    disc
        Number of the disc from 1 of errors of teeth; 0 with a single disc, and for other errors.
    error
        The error, or the amplitude of the order, m or rad; of what no order explains the root mean square, without an
        interval.
    phase
        Angle from pin or tooth 0 to the largest value, times the order, rad; None without an order.
    peak_to_peak
        Largest minus smallest contribution to the transmission error over the recorded angles, rad, by the derivatives
        at the identified drive, at the recorded torque at which it is largest.
    torque
        That torque, N·m.
    """

    kind: str
    order: int | None
    disc: int
    error: Parameter
    phase: Parameter | None
    peak_to_peak: float
    torque: float


def effects_of(
    pair: Pair, observed: Observations, linear: Linear, state: State, parameters: Sequence[Parameter], ring: Realised
) -> tuple[Effect, ...]:
    """Return the errors of an identified drive, the one with the largest effect first.

    Errors of the drive are those that were fitted. Errors of pins and teeth are those of this ring, structured errors
    and scatter together, by their orders and by what these leave.

    Parameters
    ----------
    pair, observed
        The nominal pair and the observations.
    linear, state
        The model at the end of the fit, and that end.
    parameters, ring
        The fitted errors, and every pin and tooth.
    """
    found = []
    for kind, order, disc, error, phase, contribution in (
        *_of_the_drive(observed, linear, parameters),
        *_of_the_ring(linear, ring),
        *_of_supports(pair, linear, state),
    ):
        parts = np.split(np.nan_to_num(contribution), observed.ends)
        ranges = [float(np.ptp(parts[i])) for i in observed.running]
        largest = int(np.argmax(ranges))
        torque = observed.curves[observed.running[largest]].torque
        found.append(Effect(kind, order, disc, error, phase, ranges[largest], torque))
    return tuple(sorted(found, key=lambda one: -one.peak_to_peak))


_Contribution = tuple[str, int | None, int, Parameter, Parameter | None, Array]


def _of_the_drive(observed: Observations, linear: Linear, parameters: Sequence[Parameter]) -> Iterator[_Contribution]:
    for parameter in parameters:
        if parameter.held is None and wave_of(parameter.name) is None:
            yield (
                parameter.name,
                None,
                0,
                parameter,
                None,
                linear.structured[:, observed.errors.index(parameter.name)] * parameter.value,
            )


def _of_the_ring(linear: Linear, ring: Realised) -> Iterator[_Contribution]:
    radial = linear.scatter[:, ring.circles["pin_radial"]]
    orders = {one.name: one for one in ring.orders}
    for circle, part in ring.circles.items():
        kind, _, disc = circle.partition("_of_disc_")
        columns = linear.scatter[:, part]
        if kind == PIN_RADIUS:
            columns = columns + ring.radius_lever * radial  # radial places are stated for pins of the mean radius
        left = np.array([element.value for element in ring.elements[part]])
        at = 2.0 * np.pi * np.arange(left.size) / left.size
        for order in range(ORDERS_STATED + 1):
            names = [f"{circle}_{order}{end}" for end in ("" if order == 0 else "_amplitude", "_phase")]
            error, phase = (orders.get(name) for name in names)
            if error is None:
                continue
            wave = error.value * np.cos(order * at - (0.0 if phase is None else phase.value))
            left = left - wave
            yield kind, order, int(disc or 0), error, phase, columns @ wave
        yield kind, None, int(disc or 0), _rest(circle, "m", left), None, columns @ left


def _of_supports(pair: Pair, linear: Linear, state: State) -> Iterator[_Contribution]:
    for name, part in scatter_parts(pair).items():
        if name in KINDS and KINDS[name].of_supports:
            values = state.scatter[part]
            yield name, None, 0, _rest(name, KINDS[name].unit, values), None, linear.scatter[:, part] @ values


def _rest(name: str, unit: str, values: Array) -> Parameter:
    size = float(np.sqrt(np.mean(values**2)))
    return Parameter(name, unit, size, math.nan, (math.nan, math.nan), 0.0)


def as_json(effect: Effect) -> dict[str, Any]:
    """Return an effect as in a `cycloid-identification/1` file."""
    parts = {
        name: None if part is None else parameter_as_json(part)
        for name, part in (("error", effect.error), ("phase", effect.phase))
    }
    return {**dataclasses.asdict(effect), **parts}


def words_of(effect: Effect) -> str:
    """Return what an error is, in words.

    Examples
    --------
    >>> from fitting.estimation.effects import Effect, words_of
    >>> from fitting.estimation.parameter import parameter
    >>> amplitude = parameter("pin_radial_2_amplitude", "m", 2e-6, 1e-7, 5e-6)
    >>> words_of(Effect("pin_radial", 2, 0, amplitude, None, 1e-5, 20.0))
    'radial position error of each pin, order 2'
    """
    kind = kind_of(effect.kind)
    if kind is None:
        return effect.kind.replace("profile_deviation_", "form of all flanks, half waves: ")
    if kind.of == "drive":
        return kind.description
    parts = [kind.text, f"disc {effect.disc}" if effect.disc else ""]
    if effect.order is None:
        parts.append("root mean square" if kind.of_supports else f"beyond order {ORDERS_STATED}, root mean square")
    else:
        parts.append(f"order {effect.order}" if effect.order else "mean")
    return ", ".join(part for part in parts if part)
