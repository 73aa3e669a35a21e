"""Ageing twin: an error surface with a life over ages, of which `Drive.at_age` makes the drive of an age."""

from __future__ import annotations

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.surfaces.surface import DEVIATIONS, Ageing, ErrorSurface, Life, surface_after
from cycloid_fmu.wear.life import LARGEST_LIFE
from fitting.ageing.life import largest_growth
from fitting.ageing.posterior import Posterior

_INTERVAL = (0.025, 0.975)


def aged_surface(
    after: Posterior, surface: ErrorSurface, crank_turns_per_second: float, now: float, end: float, bearing: str
) -> ErrorSurface:
    """Return the surface at an age with its whole life, at the median wear coefficient.

    Parameters
    ----------
    after
        Posterior of the wear; its life has the worn surfaces.
    surface
        The new drive.
    crank_turns_per_second, now, end
        Crank turns per second of running; age of the surface's own deviations, and end of the life, s. The life ends
        earlier if the wear was not computed so far.
    bearing
        Name of the bearing that wears; empty for none.

    Raises
    ------
    edge.InputError
        If the wear was not computed up to `now`.
    """
    life, prior = after.life, after.prior
    median = float(after.factor(0.5))
    low, high = (float(v) / median for v in after.factor(_INTERVAL))
    low, high = min(low, 1.0), max(high, 1.0)
    turns = life.dose / (prior.coefficient * median)
    largest = min(end, float(turns[-1]) / (crank_turns_per_second * high))
    growth = 0.0
    if bearing:
        growth = prior.growth * float(after.factor(0.5, 1)) * crank_turns_per_second
        largest = min(largest, largest_growth(surface.pair, bearing) / growth)
    if largest < now:
        raise edge.InputError(
            f"The drive is worn deeper at {now / 3600.0:g} h than computed: there is no twin of it; state larger "
            "limits of the figures, or of the wear file's depth."
        )
    # States beyond the largest age are not needed; a worn surface has a limited number of them.
    needed = int(np.searchsorted(turns, largest * crank_turns_per_second * high * (1.0 - 1e-9))) + 1
    chosen = np.unique(np.linspace(0, min(needed, turns.size) - 1, LARGEST_LIFE).round().astype(int))
    states = {n: np.stack([getattr(life.surfaces[k], n) for k in chosen]) for n in DEVIATIONS}
    ageing = Ageing(crank_turns_per_second, now, largest, low, high, growth, bearing)
    whole = surface.replace(
        **{name: values[-1] for name, values in states.items()},
        origin="worn",
        covariance=None,
        covariance_of=(),
        life=Life(turns[chosen], *states.values(), ageing=ageing),
    )
    return surface_after(whole, now * crank_turns_per_second)
