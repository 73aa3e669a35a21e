"""Run-out of the bench's shafts and encoders: the amplitude of each order, with its standard error."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.edge import ARCSEC
from fitting.estimation.confirmation import Confirmed
from fitting.estimation.parameter import NORMAL
from fitting.model.discrepancy import RUN_OUT_CAUSE
from fitting.model.observations import MISFIT, Observations
from fitting.transmission_error.spectrum import RIG_ORDERS

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RunOut:
    """A wave in the transmission error that repeats with a shaft of the bench, SI.

    Attributes
    ----------
    shaft, order
        "output" or "input" of the drive, or "crank" behind a first stage, and periods in a turn of it.
    amplitude, standard_error
        Of its contribution to the transmission error, rad; the standard error is NaN where no interval is stated.
    """

    shaft: str
    order: int
    amplitude: float
    standard_error: float

    @property
    def is_seen(self) -> bool:
        """Whether the amplitude exceeds half its 95 % interval, or has none."""
        return not self.amplitude <= NORMAL * self.standard_error

    @property
    def text(self) -> str:
        """Order, shaft, and amplitude with half its 95 % interval, arcsec."""
        half = NORMAL * self.standard_error * ARCSEC
        digits = 2 if math.isnan(half) else min(max(1 - math.floor(math.log10(max(half, 1e-6))), 0), 4)
        known = "" if math.isnan(half) else f" ± {half:.{digits}f}"
        return f"order {self.order} of the {self.shaft} {self.amplitude * ARCSEC:.{digits}f}{known}″"

    def withheld(self) -> RunOut:
        """The same without a standard error, for curves that are not explained."""
        return dataclasses.replace(self, standard_error=math.nan)


def run_outs_of(observed: Observations, confirmed: Mapping[str, Confirmed]) -> tuple[RunOut, ...]:
    """Return the run-out of each shaft by its orders: eccentric encoders and the cause of misfit together.

    Parameters
    ----------
    observed
        The observations of the fit.
    confirmed
        Its unknowns, with the standard errors and correlations of the bench's.
    """
    crank_shaft = "input" if observed.first_stage is None else "crank"
    waves: dict[str, tuple[str, int, int]] = {}  # shaft, order, and 0 for cosine or 1 for sine
    for part, end in enumerate(("cos", "sin")):
        waves |= {f"{shaft}_encoder_eccentricity_{end}": (shaft, 1, part) for shaft in ("output", "input")}
        for number, order in enumerate(RIG_ORDERS):
            for index, shaft in enumerate(("output", crank_shaft)):
                waves[f"{MISFIT}_{RUN_OUT_CAUSE}_{4 * number + 2 * index + part}"] = shaft, order, part
    groups: dict[tuple[str, int], list[tuple[str, int]]] = {}
    for name in observed.bench_names:
        if name in waves:
            shaft, order, part = waves[name]
            groups.setdefault((shaft, order), []).append((name, part))
    of = dict(zip(observed.bench_names, observed.bench.T, strict=True))
    return tuple(
        _run_out(shaft, order, [(name, part, _amplitude(of[name])) for name, part in names], confirmed)
        for (shaft, order), names in groups.items()
    )


def _amplitude(column: Array) -> float:
    return float(np.abs(column).max())


def _run_out(shaft: str, order: int, names: list[tuple[str, int, float]], confirmed: Mapping[str, Confirmed]) -> RunOut:
    size = np.zeros((2, len(names)))
    for at, (_, part, amplitude) in enumerate(names):
        size[part, at] = amplitude
    known = [confirmed[name] for name, _, _ in names]
    errors = np.array([one.stderr or 0.0 for one in known])
    correlation = np.array(
        [
            [1.0 if i == j else (one.correl or {}).get(other, 0.0) for j, (other, _, _) in enumerate(names)]
            for i, one in enumerate(known)
        ]
    )
    wave = size @ [one.value for one in known]
    amplitude = float(np.hypot(*wave))
    along = wave / amplitude if amplitude > 0.0 else np.array([1.0, 0.0])
    slope = along @ size * errors
    return RunOut(shaft, order, amplitude, float(np.sqrt(max(slope @ correlation @ slope, 0.0))))
