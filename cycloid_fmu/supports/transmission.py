"""Transmission error over crank angles of a drive on rigid bearings or on those that the pair states."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import edge
from cycloid_fmu.contact import transmission
from cycloid_fmu.contact.transmission import Interrupted, Transmission
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.structured import displacement_columns, profile_wave
from cycloid_fmu.surfaces.surface import ErrorSurface

if TYPE_CHECKING:
    import xarray as xr

Array = NDArray[np.float64]

_LABELS = {
    "disc_shift_x": (("disc",), "m", "shift of each disc's centre from its ideal place along x"),
    "disc_shift_y": (("disc",), "m", "shift of each disc's centre from its ideal place along y"),
    "turning_arm_force": (("disc", "crank"), "N", "force of each crank's, or the eccentric's, bearing in each disc"),
    "crank_bearing_force": (("crank",), "N", "force of each crank's bearings in carrier or housing"),
    "main_bearing_force": ((), "N", "force of the carrier's bearing in the ring"),
    "output_roller_force": (("disc", "roller"), "N", "force of each output roller in each disc's hole"),
    "crank_torque": ((), "N*m", "torque of the environment on the crank"),
}


def solve(
    pair: Pair,
    surface: ErrorSurface,
    torque: ArrayLike,
    crank_angle: ArrayLike,
    slices: int = 1,
    *,
    with_play: bool = True,
    with_elements: bool = False,
    workers: int = 1,
    progress: Callable[[int], None] = lambda angles: None,
) -> Transmission:
    """Solve a drive at every torque and crank angle, on rigid bearings or on those that the pair states.

    Parameters and errors are those of `contact.transmission.solve`.

    Returns
    -------
    Transmission
        A `solution.OnBearings` of a pair with supports.

    Raises
    ------
    edge.InputError
        If a torque can't be carried, or contact lines are asked for with supports.
    """
    if pair.supports is None:
        return transmission.solve(
            pair, surface, torque, crank_angle, slices, with_play=with_play, with_elements=with_elements,
            workers=workers, progress=progress,
        )  # fmt: skip
    if with_elements:
        raise edge.ArgumentError("slices", "contact lines and element pressures are not known with supports", slices)
    # Only here, as below: a drive on rigid bearings needs none of it.
    from cycloid_fmu.supports import solution

    return solution.solve(
        pair, surface, torque, crank_angle, slices, with_play=with_play, workers=workers, progress=progress
    )


def error_sensitivity(
    pair: Pair, surface: ErrorSurface, torque: float, crank_angle: ArrayLike, names: list[str], slices: int = 1
) -> tuple[Array, Array]:
    """Return the transmission error at one torque, and its derivatives by named errors or bearings (`solution.LAWS`).

    Returns
    -------
    transmission_error, jacobian
        Shapes (angles,) and (angles, names): rad; rad/m, rad/rad for angles, rad for logarithms of stiffness.

    Raises
    ------
    edge.InputError
        If a torque can't be carried, or a profile deviation is asked for with supports.
    """
    if pair.supports is None:
        return transmission.error_sensitivity(pair, surface, torque, crank_angle, names, slices)[:2]
    for name in names:
        if profile_wave(name, 1) is not None:
            raise edge.ArgumentError("errors", "the flanks' profile has no derivatives with supports yet", name)
    from cycloid_fmu.supports.solution import LAWS, sensitivity

    found = sensitivity(pair, surface, torque, crank_angle, slices)
    errors = [name for name in names if name not in LAWS]
    columns = dict(zip(errors, (found.by_displacement @ displacement_columns(pair, errors)).T, strict=True))
    columns |= {name: found.by_bearing[:, LAWS.index(name)] for name in names if name in LAWS}
    return found.transmission_error, np.array([columns[name] for name in names]).T


def labelled(pair: Pair, surface: ErrorSurface, found: Transmission, slices: int, *, complete: bool) -> xr.Dataset:
    """Return results as a dataset (format `cycloid-analysis/1`), with what those on bearings have besides."""
    data = transmission.labelled(pair, surface, found, slices, complete=complete)
    if pair.supports is not None:
        from cycloid_fmu.supports.solution import PLAY_LOAD

        for name, (dimensions, unit, text) in _LABELS.items():
            values = getattr(found, name)
            if values.shape[-1] > 0:
                each = ("torque", "crank_angle", *dimensions)
                # Output rollers have one crank.
                one = "crank" in dimensions and pair.supports.kind == "output_rollers"
                data[name] = (each[:-1], values[..., 0]) if one else (each, values)
                data[name].attrs.update(units=unit, long_name=text)
        data["backlash"].attrs["long_name"] = f"play: what {PLAY_LOAD:g} of the rated torque leaves at no torque"
    return data


def analyze(
    pair: Pair,
    surface: ErrorSurface,
    torque: ArrayLike,
    crank_angle: ArrayLike,
    slices: int = 1,
    *,
    with_elements: bool = False,
    workers: int = 1,
    progress: Callable[[int], None] = lambda angles: None,
) -> xr.Dataset:
    """Return the labelled dataset of `solve`.

    Interrupted, it returns the crank angles that were finished, and the attribute `complete` is 0.
    """
    complete = True
    try:
        found = solve(
            pair, surface, torque, crank_angle, slices, with_elements=with_elements, workers=workers, progress=progress
        )
    except Interrupted as interrupted:
        found, complete = interrupted.result, False
    return labelled(pair, surface, found, slices, complete=complete)
