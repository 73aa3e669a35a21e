"""What a fit may change of the bearings that a pair file states: the stiffness and clearance of each."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.supports import LARGEST_CLEARANCE, Bearing, OutputRoller

Array = NDArray[np.float64]

STIFFNESS, CLEARANCE = 0.5, 5e-6
"""Standard deviations before anything is measured: of a stiffness' logarithm, which a bearing's seat and housing make
this uncertain, and of a clearance, m."""
_BEARINGS = ("turning_arm", "crank_shaft", "main", "output_roller")
_OF_LENGTH = 9.0 / 8.0  # rollers' stiffness grows with their length to the 8/9 (Palmgren)


def unknown_bearings(pair: Pair) -> tuple[str, ...]:
    """Return what is unknown of the bearings: stiffness and clearance of each that gives way, as `LAWS` names them."""
    found: list[str] = []
    for name in _BEARINGS:
        one = getattr(pair.supports, name, None)
        if one is None or (isinstance(one, Bearing) and one.is_rigid) or getattr(one, "rigid", False):
            continue
        if isinstance(one, OutputRoller) and one.stiffness is None:
            continue
        found += [f"{name}_stiffness", f"{name}_clearance"]
    return tuple(found)


def sizes_of(names: tuple[str, ...]) -> Array:
    """Return the standard deviation of each before anything is measured."""
    return np.array([STIFFNESS if name.endswith("_stiffness") else CLEARANCE for name in names])


def unit_of_bearing(name: str) -> str:
    """SI unit of what is stated of a bearing: "1" of a stiffness' share of the stated one, "m" of a clearance."""
    return "1" if name.endswith("_stiffness") else "m"


def as_stated(pair: Pair, changes: Array) -> Array:
    """Return the values of `unknown_bearings` after changes: shares of the stated stiffnesses, and clearances, m."""
    found = np.zeros(0)
    if changes.size:
        made = pair_with(pair, changes)
        found = np.array([
            getattr(made.supports, name.rpartition("_")[0]).clearance if name.endswith("_clearance")
            else math.exp(change)
            for name, change in zip(unknown_bearings(pair), changes.tolist(), strict=True)
        ])  # fmt: skip
    return found


def lowest_of(pair: Pair) -> Array:
    """Return how far each of `unknown_bearings` can change downwards: no clearance is below zero."""
    clearances = as_stated(pair, np.zeros(len(unknown_bearings(pair))))
    return np.array([-value if name.endswith("_clearance") else -np.inf
                     for name, value in zip(unknown_bearings(pair), clearances, strict=True)])  # fmt: skip


def pair_with(pair: Pair, changes: Array) -> Pair:
    """Return a pair whose bearings are other than stated.

    Parameters
    ----------
    pair
        The pair.
    changes
        In the order of `unknown_bearings`: logarithm of a stiffness' share of the stated one, and what a clearance is
        larger, m; none at all leaves the pair. A clearance stays within what a pair file may state.
    """
    if pair.supports is None or changes.size == 0:
        return pair
    given: dict[str, dict[str, Any]] = {}
    for name, change in zip(unknown_bearings(pair), changes.tolist(), strict=True):
        bearing, _, what = name.rpartition("_")
        one = getattr(pair.supports, bearing)
        if what == "clearance":
            value = {"clearance": min(max(one.clearance + change, 0.0), LARGEST_CLEARANCE)}
        elif one.stiffness is not None:
            value = {"stiffness": one.stiffness * math.exp(change)}
        else:
            value = {"roller_length": one.roller_length * math.exp(_OF_LENGTH * change)}
        given.setdefault(bearing, {}).update(value)
    changed = {name: getattr(pair.supports, name).model_copy(update=values) for name, values in given.items()}
    return pair.replace(supports=pair.supports.model_copy(update=changed))
