"""Every pin and every tooth of this ring: the sum of structured errors and scatter.

A structured order's standard error is that of an average over random rings, σ√(2/n): the scatter has a part in each
order. The curves determine the actual ring, the sum of both, far better. The part that moves no curve is removed.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg
from scipy.special import stdtrit

from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.posterior import DISC_PHASE
from cycloid_fmu.surfaces.structured import displacement_columns, displacement_layout, displacement_vector
from cycloid_fmu.surfaces.surface import ErrorSurface
from fitting.estimation.parameter import CONFIDENCE, NORMAL, Parameter, parameter, withheld
from fitting.model.observations import PIN_RADIUS, estimated_parts, scatter_names, scatter_parts
from fitting.model.prior import tolerances_of
from fitting.model.unknowns import NO_SCATTER

Array = NDArray[np.float64]

ORDERS_STATED = 5  # of pins and teeth, from 0 up
GAUGE = (
    "An equal turn of all pins, or of all teeth, is the zero of the output angle: both means are zero here.",
    "An equal radial shift of all pins is pin_circle_radius, an equal thickness pin_radius: both means are zero here.",
    "A ring shifted as a whole is centre_distance: only the part of order 1 that is not a shift is stated here.",
    "A thicker pin and a pin further inwards have nearly the same effect on the curves: pin_radial is that of a pin of "
    "the mean radius with the same effect. The pin's own place is that plus radius_lever times its "
    "pin_radius_deviation.",
)
_MEASURED = 3.0  # times the scatter, or _SMALL: the data must determine a pin or tooth more exactly than this
_SMALL = 1e-6  # m


@dataclass(frozen=True)
class Realised:
    """Deviations of this ring's pins and teeth without their gauge: `GAUGE` in words, `gauge` as directions.

    Attributes
    ----------
    elements
        Radial and tangential place of every pin, cumulative pitch of every tooth of each disc, radius of every pin:
        `pin_radial_at_0`, … (m). The radial place is that of a pin of the mean radius with the same effect. A pin or
        tooth that was only bounded by its neighbours, not measured, is held.
    orders
        Amplitude (m) and phase (rad: angle of the largest value, times the order) of this ring's orders 0 to 5, except
        those removed by the gauge: `pin_radial_2_amplitude`, `pin_radial_2_phase`, …, with several discs
        `tooth_cumulative_pitch_of_disc_1_2_amplitude`.
    covariance
        Of the elements in their order, m².
    circles
        {name: places of its elements}: `pin_radial`, `pin_tangential`, `tooth_cumulative_pitch` or, with several
        discs, `tooth_cumulative_pitch_of_disc_1`, …, and `pin_radius_deviation`.
    radius_lever
        Inward shift of a pin with the same effect as a radius larger by 1: a pin's own radial place is the stated one
        plus this times its radius deviation.

    Examples
    --------
    An example is that of `realised`.
    """

    elements: tuple[Parameter, ...]
    orders: tuple[Parameter, ...]
    covariance: Array
    circles: dict[str, slice]
    radius_lever: float

    def withheld(self) -> Realised:
        """The same without intervals, for curves that are not explained."""
        return dataclasses.replace(
            self,
            elements=tuple(withheld(element) for element in self.elements),
            orders=tuple(withheld(order) for order in self.orders),
        )


def gauge(pair: Pair) -> Array:
    """Return displacements of pins and teeth that structured errors and the bench cause too, as unit directions.

    They are the pins' radial and tangential mean, the mean of all teeth, that of the pins' radii, and a shift of the
    ring along x and y.

    Returns
    -------
    directions
        Shape (3 pins + discs x teeth, 6), orthonormal.

    Examples
    --------
    >>> import cycloid_fmu as cy, numpy as np
    >>> from fitting.estimation.realised import gauge
    >>> pair = cy.Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
    >>> directions = gauge(pair)
    >>> directions.shape, bool(np.allclose(directions.T @ directions, np.eye(6)))
    ((39, 6), True)
    """
    parts = estimated_parts(pair)
    radial, tangential = parts["pin_radial"], parts["pin_tangential"]
    at = 2.0 * np.pi * np.arange(pair.pins) / pair.pins
    directions = np.zeros((_size(pair), 6))
    for column, part in enumerate(parts.values()):
        directions[part, column] = 1.0
    directions[radial, 4], directions[tangential, 4] = np.cos(at), -np.sin(at)
    directions[radial, 5], directions[tangential, 5] = np.sin(at), np.cos(at)
    found: Array = directions / np.linalg.norm(directions, axis=0)
    return found


def displaced(pair: Pair, surface: ErrorSurface, radius_lever: float = 0.0) -> Array:
    """Return the displacements of each pin and tooth by a surface's errors, without the gauge.

    Parameters
    ----------
    drive
        The drive.
    radius_lever
        Radial places are those of pins of the mean radius: minus this times each pin's radius deviation.

    Returns
    -------
    displacements
        Shape (3 pins + discs x teeth,), m: radial, tangential, cumulative pitch, radius.
    """
    every = _as_thick_as_the_mean(pair, radius_lever) @ _of_pins_and_teeth(pair, displacement_vector(pair, surface))
    directions = gauge(pair)
    residual: Array = every - directions @ (directions.T @ every)
    return residual


def displaced_covariance(pair: Pair, chosen: Sequence[str], covariance: Array, radius_lever: float = 0.0) -> Array:
    """Return the covariance of `displaced` from that of structured errors and scatter together.

    Parameters
    ----------
    pair
        The nominal pair.
    chosen
        The structured errors.
    covariance
        Shape (chosen + scatter, chosen + scatter): as `ErrorSurface.covariance` of a fit, or as
        `fitting.model.identifiability.posterior_covariance` predicts it.
    radius_lever
        As in `displaced`.
    """
    waves, parts = _of_pins_and_teeth(pair, displacement_columns(pair, chosen)), scatter_parts(pair)
    single = np.eye(len(waves), max(part.stop for part in parts.values()))
    for disc in range(1, pair.discs):
        first = parts["tooth_cumulative_pitch"].start + disc * pair.gear_teeth
        single[first : first + pair.gear_teeth, parts[DISC_PHASE].start + disc - 1] = 1.0
    every = _as_thick_as_the_mean(pair, radius_lever) @ np.hstack([waves, single])
    directions = gauge(pair)
    every = every - directions @ (directions.T @ every)
    found: Array = every @ covariance @ every.T
    return 0.5 * (found + found.T)


def _of_pins_and_teeth(pair: Pair, displacements: Array) -> Array:
    """Select pins' places, teeth's pitch and pins' radii, m, along axis 0 of `displacement_layout`."""
    layout = displacement_layout(pair)
    pins = [displacements[layout[name]] for name in ("pin_radial", "pin_tangential")]
    teeth = displacements[layout["tooth_turn"]] * pair.pin_circle_radius
    return np.concatenate([*pins, teeth, displacements[layout["pin_radius"]]])


def _size(pair: Pair) -> int:
    size: int = max(part.stop for part in estimated_parts(pair).values())
    return size


def _as_thick_as_the_mean(pair: Pair, lever: float) -> Array:
    """Subtract each pin's radius times a lever from its radial place; the rest is unchanged."""
    parts, found = estimated_parts(pair), np.eye(_size(pair))
    found[parts["pin_radial"], parts[PIN_RADIUS]] = -lever * np.eye(pair.pins)
    return found


def radius_lever_of(pair: Pair, chosen: Sequence[str], covariance: Array) -> float:
    """Return the lever for which `displaced_covariance` is smallest, from the same.

    Unknown radii move the radial places by this factor: it is the regression slope.
    """
    every = displaced_covariance(pair, chosen, covariance)
    parts = estimated_parts(pair)
    of_radius = float(np.trace(every[parts[PIN_RADIUS], parts[PIN_RADIUS]]))
    return float(np.trace(every[parts["pin_radial"], parts[PIN_RADIUS]])) / of_radius if of_radius > 0.0 else 0.0


def errors_by_pattern(pair: Pair, covariance: Array) -> dict[str, float]:
    """Return the standard error of each pattern's elements, rms over the elements, m: {`pin_radial`: …}."""
    variance = np.diag(covariance)
    return {name: float(np.sqrt(variance[part].mean())) for name, part in estimated_parts(pair).items()}


def realised(drive: DriveValue, chosen: Sequence[str], covariance: Array, spread: Array) -> Realised:
    """Return every pin and tooth of an identified surface.

    Parameters
    ----------
    pair, surface
        The nominal pair and the identified errors, the scatter among them.
    chosen, covariance
        The structured errors that were fitted, and the covariance of these and of the scatter together, SI.
    spread
        Prior standard deviation of each scattered displacement, m.

    Examples
    --------
    An order of pins that is known to 0.1 µm, and no scatter:

    >>> import cycloid_fmu as cy, numpy as np
    >>> from cycloid_fmu.drive_value import DriveValue
    >>> from fitting.estimation.realised import realised
    >>> pair = cy.Pair(gear_teeth=9, pin_circle_radius=0.04, pin_radius=0.004, eccentricity=0.002, face_width=0.01)
    >>> made = DriveValue.as_stated(pair).with_structured({"pin_radial_2_cos": 3e-6})
    >>> known = np.zeros((40, 40))
    >>> known[0, 0] = 1e-14
    >>> found = realised(made, ["pin_radial_2_cos"], known, np.zeros(39))
    >>> [f"{p.name} {p.value:.1e} ± {p.standard_error:.1e}" for p in found.orders if p.name == "pin_radial_2_amplitude"]
    ['pin_radial_2_amplitude 3.0e-06 ± 1.0e-07']
    """
    pair, surface = drive.pair, drive.surface
    lever = radius_lever_of(pair, chosen, covariance)
    values, variance = displaced(pair, surface, lever), displaced_covariance(pair, chosen, covariance, lever)
    unmeasured = np.diag(np.concatenate([tolerances_of(chosen), np.maximum(spread, NO_SCATTER)]) ** 2)
    before = displaced_covariance(pair, chosen, unmeasured, lever)
    deviation, prior = np.sqrt(np.maximum(np.diag(variance), 0.0)), np.sqrt(np.diag(before))
    own = _own_information(covariance, spread)
    # A radius is known no better than the size of its scatter, which is known from the radii that the curves resolve.
    size = estimated_parts(pair)[PIN_RADIUS]
    told = (
        pair.pins
        - float(np.trace(covariance[-spread.size :, -spread.size :][size, size]))
        / max(float(spread[size.start]), NO_SCATTER) ** 2
    )
    of_radius = float(stdtrit(max(told, 2.0), 0.5 + 0.5 * CONFIDENCE))
    elements = []
    for at, name in enumerate(scatter_names(pair)[: values.size]):
        bounded = own[at] * (_MEASURED * max(spread[at], _SMALL)) ** 2 < 1.0
        why = "it carries almost no load in these curves: bounded by its neighbours, not measured" if bounded else None
        quantile = of_radius if name.startswith(PIN_RADIUS) else NORMAL
        one = parameter(name, "m", float(values[at]), float(deviation[at]), float(prior[at]), why, quantile)
        elements.append(one)
    circles = _circles(pair)
    orders = [
        order
        for n, part in circles.items()
        for order in _orders(n, values[part], variance[part, part], before[part, part], pair.discs)
    ]
    return Realised(tuple(elements), tuple(orders), variance, circles, lever)


def _own_information(covariance: Array, spread: Array) -> Array:
    """Information of the data alone on each scattered displacement, all else known, 1/m²; infinite without scatter."""
    size = np.sqrt(np.diag(covariance))
    own = np.full(spread.size, np.inf)
    if (spread > NO_SCATTER).any():
        there = size > 0.0
        inverse = linalg.pinvh((covariance / np.outer(size, size))[np.ix_(there, there)])
        precision = np.zeros(size.size)
        precision[there] = np.diag(inverse) / size[there] ** 2
        scattered = spread > NO_SCATTER
        own[scattered] = precision[-spread.size :][scattered] - 1.0 / spread[scattered] ** 2
    return own


def _circles(pair: Pair) -> dict[str, slice]:
    circles = {}
    for name, part in estimated_parts(pair).items():
        if name != "tooth_cumulative_pitch" or pair.discs == 1:
            circles[name] = part
            continue
        for disc in range(pair.discs):
            first = part.start + disc * pair.gear_teeth
            circles[f"{name}_of_disc_{disc + 1}"] = slice(first, first + pair.gear_teeth)
    return circles


def _orders(name: str, values: Array, covariance: Array, before: Array, discs: int) -> list[Parameter]:
    """Amplitude and phase of the orders outside the gauge, each with its standard error to first order."""
    parameters, count = [], values.size
    at = 2.0 * np.pi * np.arange(count) / count
    for order in range(ORDERS_STATED + 1):
        # Of means the gauge leaves the differences between the discs.
        if 2 * order >= count or (order == 0 and (name.startswith("pin_") or discs == 1)):
            continue
        share = (2.0 if order else 1.0) / count
        waves = share * np.array([np.cos(order * at), np.sin(order * at)])
        cos, sin = waves @ values
        amplitude, phase = float(np.hypot(cos, sin)), float(np.arctan2(sin, cos))
        along = np.cos(phase) * waves[0] + np.sin(phase) * waves[1]
        across = np.cos(phase) * waves[1] - np.sin(phase) * waves[0]
        error, turn, unmeasured = (
            float(np.sqrt(max(w @ c @ w, 0.0))) for w, c in ((along, covariance), (across, covariance), (along, before))
        )
        if order == 0:
            parameters.append(parameter(f"{name}_0", "m", float(cos), error, unmeasured))
            continue
        one = parameter(f"{name}_{order}_amplitude", "m", amplitude, error, unmeasured)
        parameters.append(dataclasses.replace(one, interval=(max(one.interval[0], 0.0), one.interval[1])))
        error = min(turn / max(amplitude, 1e-15), np.pi / NORMAL)
        parameters.append(parameter(f"{name}_{order}_phase", "rad", phase, error, float(np.pi / np.sqrt(3.0))))
    return parameters
