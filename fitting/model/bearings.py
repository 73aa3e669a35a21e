"""Unknowns of the stated bearings in a fit, stiffness and clearance of each, of elastic bodies, and of friction."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.geometry.bodies import LARGEST_FACTOR, LEAST_FACTOR, Bodies
from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.supports import Bearing, OutputRoller
from fitting.model.losses import coefficient_of, is_coefficient, losses_with, size_of, unknown_coefficients

Array = NDArray[np.float64]

STIFFNESS, CLEARANCE = 0.5, 5e-6
"""Prior standard deviations: of the logarithm of a stiffness, uncertain because of seat and housing, and of a
clearance, m."""
CRANK_PLAY = 1e-3
"""Standard deviation of a first stage's play beside half the stated one, rad of the cranks."""
BEARINGS = ("turning_arm", "crank_shaft", "main", "output_roller")
_OF_LENGTH = 9.0 / 8.0  # the stiffness of rollers is proportional to their length to the power 8/9 (Palmgren)


PLAY = "first_stage_play"


def unknown_bearings(pair: Pair, first_stage: FirstStage | None = None) -> tuple[str, ...]:
    """Return the unknowns of the bearings: stiffness and clearance of each compliant one, by the names of `LAWS`.

    Where the file states the uncertainty of an elastic body's stiffness, this follows (`disc_stiffness`), then friction
    coefficients that are known within a range (`fitting.model.losses.unknown_coefficients`), and behind a first stage
    the free rotation of its cranks comes last.
    """
    names: list[str] = []
    for name in BEARINGS:
        one = getattr(pair.supports, name, None)
        if one is None or (isinstance(one, Bearing) and one.is_rigid) or getattr(one, "rigid", False):
            continue
        if isinstance(one, OutputRoller) and one.stiffness is None:
            continue
        names += [f"{name}_stiffness", f"{name}_clearance"]
    names += [f"{name}_stiffness" for name in _sizes_of_bodies(pair)]
    names += unknown_coefficients(pair)
    return (*names, PLAY) if first_stage is not None else tuple(names)


def _sizes_of_bodies(pair: Pair) -> dict[str, float]:
    """Return the prior standard deviation of the logarithm of each unknown stiffness of an elastic body, by its key."""
    stated = () if pair.bodies is None else pair.bodies.stated()
    return {name: size for name, body in stated if (size := body.stiffness_uncertainty) is not None}


def sizes_of(pair: Pair, first_stage: FirstStage | None = None) -> Array:
    """Return the prior standard deviation of each of `unknown_bearings`."""
    sizes = {"stiffness": STIFFNESS, "clearance": CLEARANCE, "play": CRANK_PLAY}
    if first_stage is not None:
        sizes["play"] += 0.5 * first_stage.crank_play
    names = unknown_bearings(pair, first_stage)
    of_bodies = {f"{body}_stiffness": size for body, size in _sizes_of_bodies(pair).items()}
    usual = {n: of_bodies.get(n, sizes.get(n.rpartition("_")[2])) for n in names}
    return np.array([size_of(pair, n) if is_coefficient(n) else usual[n] for n in names], float)


def unit_of_bearing(name: str) -> str:
    """Return the SI unit of an unknown: "1" of a stiffness or a coefficient, "m" of a clearance, "rad" of a play."""
    return {"stiffness": "1", "coefficient": "1", "clearance": "m", "play": "rad"}[name.rpartition("_")[2]]


def is_logarithmic(name: str) -> bool:
    """Return whether an unknown is the logarithm of what a file states."""
    return name.endswith("_stiffness") or is_coefficient(name)


def as_stated(pair: Pair, changes: Array, first_stage: FirstStage | None = None) -> Array:
    """Return `unknown_bearings` after changes: shares of stiffnesses, clearances (m), coefficients, the play (rad)."""
    found = []
    for name, change in zip(unknown_bearings(pair, first_stage), changes.tolist(), strict=True):
        bearing, _, what = name.rpartition("_")
        if name == PLAY and first_stage is not None:
            found.append(max(first_stage.crank_play + change, 0.0))
        elif what == "stiffness":
            found.append(math.exp(change))
        elif is_coefficient(name):
            found.append(coefficient_of(pair, name, change))
        else:
            found.append(max(getattr(pair.supports, bearing).clearance + change, 0.0))
    return np.array(found)


def stiffness_shares(pair: Pair, stated: Pair) -> dict[str, float]:
    """Return each unknown stiffness of a pair over that of a stated pair with the same kinds of bearings and bodies."""
    shares, bodies = dict[str, float](), _sizes_of_bodies(pair)
    for name in unknown_bearings(pair):
        part, _, what = name.rpartition("_")
        if what != "stiffness":
            continue
        if part in bodies:
            shares[name] = getattr(stated.bodies, part).compliance_factor / getattr(pair.bodies, part).compliance_factor
            continue
        bearing, before = getattr(pair.supports, part), getattr(stated.supports, part)
        if bearing.stiffness is not None:
            shares[name] = bearing.stiffness / before.stiffness
        else:
            shares[name] = (bearing.roller_length / before.roller_length) ** (1.0 / _OF_LENGTH)
    return shares


def lowest_of(pair: Pair, first_stage: FirstStage | None = None) -> Array:
    """Return the largest decrease of each of `unknown_bearings`: no clearance or play is below zero."""
    names = unknown_bearings(pair, first_stage)
    values = as_stated(pair, np.zeros(len(names)), first_stage)
    return np.array([-np.inf if is_logarithmic(n) else -v for n, v in zip(names, values, strict=True)])


def pair_with(pair: Pair, changes: Array, *, rounded: bool = False) -> Pair:
    """Return a pair with changed bearings, elastic bodies and friction.

    Parameters
    ----------
    pair
        The pair.
    changes
        In the order of `unknown_bearings`: logarithm of a stiffness over the stated one, increase of a clearance (m),
        logarithm of a friction coefficient over the stated one; the play of a first stage may follow. If empty, the
        pair is unchanged. A clearance and a body's factor stay within the limits of a pair file.
    rounded
        Whether changed values are those that a file should state: lengths in whole nanometres, stiffnesses with six
        digits.
    """
    names = unknown_bearings(pair)
    if not names or changes.size == 0:
        return pair
    assert pair.supports is not None
    given: dict[str, dict[str, Any]] = {}
    friction, of_bodies, bodies = dict[str, float](), dict[str, float](), _sizes_of_bodies(pair)
    for name, change in zip(names, changes.tolist(), strict=False):
        if is_coefficient(name):
            friction[name] = change
            continue
        bearing, _, what = name.rpartition("_")
        if bearing in bodies:
            of_bodies[bearing] = change
            continue
        one = getattr(pair.supports, bearing)
        if what == "clearance":
            value = {"clearance": min(max(one.clearance + change, 0.0), pair.supports.largest_clearance)}
        elif one.stiffness is not None:
            value = {"stiffness": one.stiffness * math.exp(change)}
        else:
            value = {"roller_length": one.roller_length * math.exp(_OF_LENGTH * change)}
        if rounded and change != 0.0:
            value = {n: float(f"{v:.6g}") if n == "stiffness" else round(v, 9) for n, v in value.items()}
        given.setdefault(bearing, {}).update(value)
    changed = {name: getattr(pair.supports, name).model_copy(update=values) for name, values in given.items()}
    supports = pair.supports.model_copy(update=changed)
    replaced: dict[str, Any] = {"supports": supports}
    if pair.bodies is not None and of_bodies:
        replaced["bodies"] = _bodies_with(pair.bodies, of_bodies, rounded=rounded)
    if pair.losses is not None and friction:
        replaced["losses"] = losses_with(pair.losses, friction, rounded=rounded)
    return pair.replace(**replaced)


def _bodies_with(bodies: Bodies, changes: Mapping[str, float], *, rounded: bool) -> Bodies:
    """Return elastic bodies whose stiffness is changed, by the logarithm of each; `rounded` factors have six digits."""
    factors = dict[str, float | None]()
    for name, change in changes.items():
        factor = math.exp(change) / getattr(bodies, name).compliance_factor
        factor = min(max(factor, LEAST_FACTOR), LARGEST_FACTOR)
        factors[name] = float(f"{factor:.6g}") if rounded else factor
    return bodies.with_factors(factors)
