"""The outline of one disc as made: the curve to which the arcs of CAD files are fitted.

Points are complex numbers, x + iy, in m. The origin is the disc's axis, the axes are those of the frame at crank angle
0: tooth 0 of the first disc has its root on +x.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.profile import equal_arc_parameters, flank_curvature, flank_normals, flank_points, flank_speed
from cycloid_fmu.surfaces.structured import dimensions

Array = NDArray[np.float64]
Points = NDArray[np.complex128]


@dataclass(frozen=True, eq=False)
class Tooth:
    """The flank of one tooth as made, from its first root to its second.

    Attributes
    ----------
    pair
        The pair with the actual modification, at 20 °C.
    turned
        The tooth's rotation from tooth 0 of an ideal gear, as a complex number of magnitude 1.
    low, high
        Profile parameters, relative to tooth 0, where it meets its neighbours, rad.
    knots, heights
        Profile parameters between which the form deviation is linear, rad, and its values there, m, > 0 material added;
        empty if the form is nominal.
    """

    pair: Pair
    turned: complex
    low: float
    high: float
    knots: Array
    heights: Array

    def points(self, alpha: ArrayLike) -> Points:
        """Points of the flank at profile parameters of tooth 0, rad."""
        x, y = flank_points(self.pair, alpha)
        return np.asarray(self.turned * (x + 1j * y + self._height(alpha) * self._normals(alpha)))

    def tangents(self, alpha: ArrayLike) -> Points:
        """Unit tangents, counter-clockwise; at a knot that of the side after it."""
        along = self._along(alpha)
        return np.asarray(along / np.abs(along))

    def speed(self, alpha: ArrayLike) -> Array:
        """Arc length per radian of the profile parameter, m."""
        return np.abs(self._along(alpha))

    def _along(self, alpha: ArrayLike) -> Points:
        rise = np.zeros(np.shape(alpha))
        if self.knots.size:
            slopes = np.diff(self.heights) / np.diff(self.knots)
            rise = slopes[np.clip(np.searchsorted(self.knots, alpha, side="right") - 1, 0, slopes.size - 1)]
        longer = flank_speed(self.pair, alpha) * (1.0 + self._height(alpha) * flank_curvature(self.pair, alpha))
        return np.asarray(self.turned * (1j * longer + rise) * self._normals(alpha))

    def curvature(self, alpha: ArrayLike) -> Array:
        """Curvature of the flank with its modification, without deviations of its form, > 0 convex, 1/m."""
        return flank_curvature(self.pair, alpha)

    def _normals(self, alpha: ArrayLike) -> Points:
        x, y = flank_normals(self.pair, alpha)
        return np.asarray(x + 1j * y)

    def _height(self, alpha: ArrayLike) -> Array:
        if not self.knots.size:
            return np.zeros(np.shape(alpha))
        return np.asarray(np.interp(np.asarray(alpha), self.knots, self.heights))


def teeth_of(drive: DriveValue, disc: int) -> list[Tooth]:
    """Return the teeth of a disc as made, counter-clockwise, each ending where the next one begins.

    A tooth with a pitch error is rotated as a whole about the disc's axis; it meets its neighbour on the ray between
    their roots, where both flanks have the same distance from the axis. Form deviations are those at mid-width, linear
    in the profile parameter from the middle of one element to the next, also across the roots.

    Raises
    ------
    edge.InputError
        If a drive with these errors is impossible.
    """
    pair, surface = drive.pair, drive.surface
    cold = pair.replace(temperature=None)
    made = dimensions(cold, surface)
    count = pair.gear_teeth
    pitch = 2.0 * math.pi / count
    flank = cold.nominal.replace(
        isometric=made["generating_pin_radius"] - cold.pin_radius,
        offset=made["generating_circle_radius"] - cold.pin_circle_radius,
    )
    knots, heights = _form(drive, disc)
    turn = made["tooth_turn"][disc]
    clocked = -2.0 * math.pi * disc / pair.discs / count
    ahead = 0.5 * (np.roll(turn, -1) - turn)  # from a tooth's second root to its end at the next tooth
    # Change of the polar angle per radian of the profile parameter at a root.
    rate = float(flank_speed(flank, 0.0)) / abs(complex(*map(float, flank_points(flank, 0.0))))
    return [
        Tooth(
            flank,
            cmath.exp(1j * (j * pitch + float(turn[j]) + clocked)),
            -float(ahead[j - 1]) / rate,
            pitch + float(ahead[j]) / rate,
            knots,
            heights[j],
        )
        for j in range(count)
    ]


def _form(drive: DriveValue, disc: int) -> tuple[Array, Array]:
    """Profile parameters (rad) of a tooth's elements and one on either side, and heights (m) of every tooth."""
    pair, surface = drive.pair, drive.surface
    flanks = surface.gear_deviation
    if flanks is None:
        return np.empty(0), np.empty((pair.gear_teeth, 0))
    elements, slices = flanks.shape[2:]
    middle = flanks[disc, :, :, (slices - 1) // 2 : slices // 2 + 1].mean(axis=2)
    inner = equal_arc_parameters(pair, elements)
    pitch = 2.0 * math.pi / pair.gear_teeth
    knots = np.concatenate([[inner[-1] - pitch], inner, [inner[0] + pitch]])
    before, after = np.roll(middle, 1, axis=0)[:, -1:], np.roll(middle, -1, axis=0)[:, :1]
    return knots, np.concatenate([before, middle, after], axis=1)
