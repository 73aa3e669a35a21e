"""How warm a drive gets: heat of its losses against what it gives off, with the viscosity and clearances that follow.

One state, the temperature of the oil: C dT/dt = P(T) - (T - T_0)/R. The losses P are those of the drive at this
temperature, solved with friction in the balance (docs/theory/losses.md).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.temperature import HOTTEST, Temperatures
from cycloid_fmu.geometry.thermal import Thermal
from cycloid_fmu.losses.figures import LoadCase, at_ends, load_cases
from cycloid_fmu.losses.solver import losses_of, solve

Array = NDArray[np.float64]
SHARES = (1.0 - math.exp(-1.0), 0.95)
"""Of the rise to the steady temperature, after which a drive counts as warm: of one time constant, and 95 %."""
SCANNED = 13
"""Temperatures from the surroundings' to the highest at which the balance of heat is looked at."""
_INSIDE = 6  # more of them below the steady temperature, for the warm-up
_STEPS, _TIME_CONSTANTS = 400, 5.0  # of the warm-up
_CLOSE, _TRIFLE = 1e-3, 0.1  # K
_HALVINGS = 8  # towards the temperature from which the drive can't run


class Running(NamedTuple):
    """A load that a drive runs at."""

    torque: float  # of the environment on the output, N·m; the drive turns against it
    crank_speed: float  # rad/s, not below 0
    share: float = 1.0  # of the time


@dataclass(frozen=True)
class Heat:
    """Temperatures of a drive that runs at one load, or over a duty that is short against its warm-up, SI.

    Attributes
    ----------
    running
        The loads.
    thermal
        How the drive gives off heat.
    oil, housing
        Steady temperatures reached from the surroundings', K; NaN if there are none.
    power
        Heat at the steady temperature, mean over the loads by their time, W.
    efficiency
        Of each load that is driven, at the steady temperature; NaN otherwise.
    others
        Further temperatures of the oil at which heat is balanced, K: above the first of them the drive gets warmer
        still, though it does not get there from the surroundings' temperature.
    reason
        Why there is no steady temperature; empty if there is.
    scanned, scanned_power
        Temperatures of the oil (K) at which the heat was solved, and the heat, W.
    time, warming
        Course of the oil's temperature from that of the surroundings, s and K; empty without a heat capacity.
    ends
        The same with all friction from `friction_values.VALUES` at the low and at the high end of its range.
    """

    running: tuple[Running, ...]
    thermal: Thermal
    oil: float
    housing: float
    power: float
    efficiency: tuple[float, ...]
    others: tuple[float, ...]
    reason: str
    scanned: Array = field(repr=False)
    scanned_power: Array = field(repr=False)
    time: Array = field(repr=False)
    warming: Array = field(repr=False)
    ends: tuple[Heat, ...] = ()

    @property
    def too_warm(self) -> bool:
        """Whether the oil gets warmer than `largest` of [thermal], or has no steady temperature."""
        return self.thermal.largest is not None and not self.oil <= self.thermal.largest

    def time_to(self, share: float) -> float:
        """Return the time to a share of the rise to the steady temperature, s; NaN without it or without a capacity."""
        if self.thermal.capacity is None or math.isnan(self.oil):
            return math.nan
        reached = self.thermal.ambient + share * (self.oil - self.thermal.ambient)
        return float(np.interp(reached, self.warming, self.time))

    def numbers(self) -> dict[str, Any]:
        """Return it for scripts, SI."""
        names = ("oil", "housing", "power", "efficiency", "others", "reason", "too_warm")
        return {
            "running": [load._asdict() for load in self.running],
            **{name: getattr(self, name) for name in names},
            "warm_up": {"63 %": self.time_to(SHARES[0]), "95 %": self.time_to(SHARES[1])},
            **({"oil_range": [end.oil for end in self.ends]} if self.ends else {}),
        }


def thermal_of(drive: DriveValue, source: str = "the pair") -> Thermal:
    """Return how a drive gives off heat; raise an `edge.InputError` if that is not stated in the file `source`."""
    if drive.pair.thermal is None:
        raise edge.InputError(
            f"{source}: [thermal] is missing; state its resistance, or area and convection, and ambient."
        )
    return drive.pair.thermal


def at_oil_temperature(drive: DriveValue, oil: float) -> DriveValue:
    """Return a drive whose oil, discs, carrier and crank have a temperature, K, and its housing that which follows.

    Raises
    ------
    edge.InputError
        If a clearance vanishes at this temperature.
    """
    pair, inside = drive.pair, dict.fromkeys(("discs", "carrier", "crank"), oil)
    losses, lubricant = losses_of(drive), losses_of(drive).lubricant
    if lubricant is not None:
        losses = losses.replace(lubricant=lubricant.replace(temperature=oil))
    temperature = Temperatures(ring=thermal_of(drive).housing(oil), **inside)
    return DriveValue(pair.replace(losses=losses, temperature=temperature), drive.surface, drive.first_stage)


class _Losing:
    """The heat of a drive over its loads as a function of the oil's temperature, K; each is solved once."""

    def __init__(self, drive: DriveValue, running: Sequence[Running], crank_angle: Array, workers: int) -> None:
        self.drive, self.running, self.crank_angle, self.workers = drive, running, crank_angle, workers
        self.starts: dict[Running, Array] = {}
        self.power: dict[float, float] = {}
        self.efficiency: dict[float, tuple[float, ...]] = {}

    def __call__(self, oil: float) -> float:
        """Return the heat, W; NaN where the drive jams."""
        if oil not in self.power:
            warm = at_oil_temperature(self.drive, oil)
            cases = [self._case(warm, load) for load in self.running]
            self.power[oil] = math.fsum(load.share * case.heat for load, case in zip(self.running, cases, strict=True))
            self.efficiency[oil] = tuple(case.efficiency for case in cases)
        return self.power[oil]

    def _case(self, warm: DriveValue, load: Running) -> LoadCase:
        torque, direction = np.array([load.torque]), 1 if load.torque >= 0.0 else -1
        near = self.starts.get(load)
        rubbed = solve(warm, torque, self.crank_angle, direction, load.crank_speed, near=near, workers=self.workers)
        if np.isfinite(rubbed.coordinates).all():
            self.starts[load] = rubbed.coordinates
        (case,) = load_cases(warm, rubbed)
        return case

    def problem(self, oil: float) -> str:
        """Return why the drive can't run at a temperature of the oil; empty if it can."""
        try:
            return "the drive jams" if math.isnan(self(oil)) else ""
        except edge.InputError as refused:
            return str(refused).rstrip(".")

    def surplus(self, oil: float, thermal: Thermal) -> float:
        """Return the heat that is not given off, W."""
        return self(oil) - (oil - thermal.ambient) / thermal.whole


def heat(
    drive: DriveValue,
    running: Sequence[Running],
    crank_angle: Array,
    *,
    workers: int = 1,
    progress: Callable[[int], None] = lambda temperatures: None,
) -> Heat:
    """Return how warm a drive gets that runs at loads, with viscosity and clearances at that temperature.

    Parameters
    ----------
    drive
        A drive with [supports], [losses] and [thermal].
    running
        The loads, at least one, with speeds above zero; their heat counts by their shares of the time, whose rest is a
        standstill.
    crank_angle
        rad; at least one mesh pitch of them for means.
    workers, progress
        Threads; function called with 1 for each of `SCANNED` temperatures that was just solved.

    Raises
    ------
    edge.InputError
        As `solver.solve`, or if [thermal] is missing. A drive that gets too warm for any balance, or jams, is a result
        with a `reason`.
    """
    thermal, losing = thermal_of(drive), _Losing(drive, running, crank_angle, workers)
    scanned, reason = _scan(losing, thermal, progress)
    balanced = _balanced(losing, thermal, scanned)
    oil = math.nan
    if balanced:
        oil, reason = balanced[0], ""
        inside = np.linspace(thermal.ambient, oil, _INSIDE + 2)[1:-1].tolist()
        scanned = sorted({*scanned, *balanced, *inside})
    temperatures, power = np.array(scanned), np.array([losing(each) for each in scanned])
    time, warming = _warm_up(thermal, temperatures, power, oil)
    return Heat(
        tuple(running),
        thermal,
        oil,
        thermal.housing(oil),
        losing.power.get(oil, math.nan),
        losing.efficiency.get(oil, (math.nan,) * len(running)),
        tuple(balanced[1:]),
        reason,
        temperatures,
        power,
        time,
        warming,
        tuple(heat(end, running, crank_angle, workers=workers) for end in at_ends(drive)),
    )


def _scan(losing: _Losing, thermal: Thermal, progress: Callable[[int], None]) -> tuple[list[float], str]:
    """Return temperatures of the oil, K, up to those that the drive can't have, and what is wrong if none is steady."""
    losing(thermal.ambient)
    at_oil_temperature(losing.drive, thermal.ambient + _TRIFLE)  # what can't expand at all is not too warm
    scanned = list[float]()
    for oil in np.linspace(thermal.ambient, HOTTEST, SCANNED).tolist():
        if problem := losing.problem(oil):
            if not scanned:
                return [], f"at {_celsius(oil)}, the temperature of its surroundings, {problem}"
            low, high = scanned[-1], oil
            for _ in range(_HALVINGS):
                middle = 0.5 * (low + high)
                worse = losing.problem(middle)
                low, high, problem = (low, middle, worse) if worse else (middle, high, problem)
                scanned += [] if worse else [middle]
            return (
                scanned,
                f"up to {_celsius(low)} it makes more heat than it gives off, and at {_celsius(high)} {problem}",
            )
        scanned.append(oil)
        progress(1)
    given = (HOTTEST - thermal.ambient) / thermal.whole
    return scanned, f"at {_celsius(HOTTEST)} it still makes {losing(HOTTEST):.4g} W and gives off {given:.4g} W"


def _balanced(losing: _Losing, thermal: Thermal, scanned: Sequence[float]) -> list[float]:
    """Return the temperatures of the oil between scanned ones at which all heat is given off, K."""
    from scipy.optimize import brentq

    surplus = [losing.surplus(oil, thermal) for oil in scanned]
    balanced = [scanned[0]] if surplus and surplus[0] <= 0.0 else []
    for k in range(len(scanned) - 1):
        if (surplus[k] > 0.0) != (surplus[k + 1] > 0.0):
            balanced.append(brentq(losing.surplus, scanned[k], scanned[k + 1], args=(thermal,), xtol=_CLOSE))
    for oil in balanced:
        losing(oil)
    return balanced


def _warm_up(thermal: Thermal, temperatures: Array, power: Array, oil: float) -> tuple[Array, Array]:
    """Return times, s, and the oil's temperatures, K, from the surroundings' up to the steady one, or as far as solved.

    t = ∫ C dT/(P(T) - (T - T_0)/R), in steps that are even in the logarithm of what is left of the rise; empty without
    a heat capacity.
    """
    from scipy.interpolate import PchipInterpolator

    if thermal.capacity is None or temperatures.size < 2:
        return np.empty(0), np.empty(0)
    steady = not math.isnan(oil)
    rise = (oil if steady else temperatures[-1]) - thermal.ambient
    part = 1.0 - np.exp(-np.linspace(0.0, _TIME_CONSTANTS, _STEPS)) if steady else np.linspace(0.0, 1.0, _STEPS)
    warming: Array = thermal.ambient + rise * part
    given = np.where(temperatures == oil, (temperatures - thermal.ambient) / thermal.whole, power)
    surplus = PchipInterpolator(temperatures, given)(warming) - (warming - thermal.ambient) / thermal.whole
    if rise == 0.0:
        return np.zeros(_STEPS), warming
    by_part = thermal.capacity * rise * ((1.0 - part) if steady else 1.0) / surplus
    along = -np.log1p(-part) if steady else part
    steps = 0.5 * (by_part[1:] + by_part[:-1]) * np.diff(along)
    return np.concatenate([[0.0], np.cumsum(steps)]), warming


def _celsius(kelvin: float) -> str:
    return f"{kelvin - 273.15:.4g} °C"
