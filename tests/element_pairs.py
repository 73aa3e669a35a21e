"""Slow reference for error tooth surfaces: the error-surface paper's brute force over element pairs, plain NumPy.

Written from the paper (sections 2 and 3) and the signs and formulas of docs/theory alone; it shares nothing with the
compiled kernels: no conjugate point, no Newton step, no warm start. SI units throughout: m, rad, N, N*m, Pa.

Flanks and pins are cut across the width into independent slices, each taken at its middle, and each slice of a tooth
or pin into elements. An element is a patch of a cylinder: control point at its middle, nominal normal, nominal
curvature, and a finite range of half an element to either side. Where the paper is open:

- Facing. A pair (gear element, pin element) is a contact candidate only where the closest points of its two cylinders,
  which lie on the line through both centres of curvature, lie within both patches' ranges; without that, cylinders
  continued beyond their elements give depths that do not exist. Neighbouring patches do not quite meet, their
  curvatures and deviations being different: where the closest points fall between patches, so that no pair within two
  elements faces, the pair that comes nearest to it counts, its ranges continued by up to half an element. Edges of
  elements above their neighbours therefore do not touch (`contact="facing"`).
- `contact="deepest"` is the other answer: the deviated flank, with its steps, kinks and slopes, is sampled densely
  and the deepest point counts, anywhere in its element. It is the geometry's behaviour; the paper's search does
  it only in so far as a proud element's cylinder is taken beyond its range.
- Deviation. It moves the control point along the nominal normal; normal and curvature stay nominal. `"constant"`:
  one value for all of the patch. `"linear"`: interpolated between the elements' middles, along the profile by its
  parameter (by arc length instead moves a flank of 0.5 µm roughness by 2 nm), around the pin by the angle, and held
  constant in the outer half of a tooth's or pin's first and last element; constant within a slice. So is the
  curvature that enters Hertz's law: the element's own, as in the paper, or interpolated.
- One contact for a slice of a pin, the deepest, as in the paper; `each_tooth=True` counts one with every tooth.
- The arm is that of the line through the pin's centre of curvature and the closest points (the paper takes the
  control point and its normal instead, which lie up to half an element aside).
"""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

TOUCHING = 0.2e-9  # m: a best gap this small is contact without play, not interference
SLACK = 1e-6  # of half an element, by which ranges overlap against rounding
BORDER = 0.01  # elements: within this of a pin element's border its neighbour is tried too
BETWEEN = 2.0  # half elements: how far from its middle a pair may be continued where no pair faces
LARGEST_BLOCK = 40_000  # element pairs in memory at a time
READINGS = ("linear", "constant")
CONTACTS = ("facing", "deepest")
PAIRS = ("all", "directed")


class Contacts(NamedTuple):
    """The contact of every slice of every pin; all arrays have shape (discs, slices, arcs, pins, teeth).

    The last axis is 1 long unless a contact is wanted with each tooth near the pin. `depth` > 0 is penetration (m; -inf
    where nothing faces), `arm` that of the contact's normal about the gear's centre (m), `curvature` the flank's (1/m);
    `tooth`, `profile` and `angle` are indices of the elements.
    """

    depth: np.ndarray
    arm: np.ndarray
    curvature: np.ndarray
    tooth: np.ndarray
    profile: np.ndarray
    angle: np.ndarray


class Loads(NamedTuple):
    """Force (N) and largest pressure (Pa) of every contact, arcs put together, shape (discs, slices, pins, teeth)."""

    force: np.ndarray
    pressure: np.ndarray
    arm: np.ndarray


class Elements:
    """All elements of a pair at one crank angle, ready to be searched; parameters as in `solve_elements`."""

    def __init__(
        self,
        pair: Any,
        surface: Any,
        crank_angle: float,
        sizes: tuple[int, int, int],
        reading: str,
        contact: str,
        pairs: str,
        arcs: int,
        each_tooth: bool,
        sampling: float,
    ) -> None:
        main = pair
        if main.output != "gear":
            raise ValueError('only output = "gear" is solved here: the pin ring stands still')
        for value, known in ((reading, READINGS), (contact, CONTACTS), (pairs, PAIRS)):
            if value not in known:
                raise ValueError(f'"{value}" must be one of {known}')
        self.linear, self.deepest, self.all_pairs = reading == "linear", contact == "deepest", pairs == "all"
        self.each_tooth, self.arcs, self.slices = each_tooth, arcs, sizes[0]
        self.teeth, self.pins, self.discs = main.gear_teeth, main.pins, main.discs
        self.width, self.radius = main.face_width / self.slices, main.pin_circle_radius
        self.longest = self.radius if main.contact_law == "capped" else np.inf
        materials = (pair.material.gear, pair.material.pin)
        self.compliance = [(1 - one.poissons_ratio**2) / one.youngs_modulus for one in materials]

        # Elements are of equal arc length on the flank as drawn; the flank as made has its errors of generation too.
        drawn = (self.radius + pair.modification.offset, main.pin_radius + pair.modification.isometric)
        made = (drawn[0] + surface.offset, drawn[1] + surface.isometric)
        self.eccentricity = main.eccentricity
        fine = np.linspace(0.0, 2 * np.pi / self.teeth, 400 * max(sizes[1], 25) + 1)
        steps = np.hypot(*np.diff(self._flank(drawn, fine)[0], axis=0).T)
        arc = np.concatenate([[0.0], np.cumsum(steps)])
        middles = np.interp((np.arange(sizes[1]) + 0.5) / sizes[1] * arc[-1], arc, fine)
        # Places in elements by arc length, and with the profile parameter running evenly between their middles.
        self.by_arc = arc / arc[-1] * sizes[1] - 0.5
        self.by_parameter = np.interp(fine, middles, np.arange(sizes[1]))
        self.point, self.normal, self.curvature = self._flank(made, middles)
        self.tangent = np.stack([-self.normal[:, 1], self.normal[:, 0]], axis=-1)  # towards larger parameters
        self.half_arc, self.half_angle = 0.5 * arc[-1] / sizes[1], 0.5 * np.pi / sizes[2]
        self.angle = -0.5 * np.pi + (2 * np.arange(sizes[2]) + 1) * self.half_angle
        self.samples = max(1, int(np.ceil(2 * self.half_arc / sampling)))

        ring = self.radius + surface.pin_circle_radius + surface.pin_radial
        self.pin_turn = 2 * np.pi * np.arange(self.pins) / self.pins + surface.pin_tangential / self.radius
        self.pin_axis = ring[:, None] * np.stack([np.cos(self.pin_turn), np.sin(self.pin_turn)], axis=-1)
        self.pin_radius = main.pin_radius + surface.pin_radius + surface.pin_radius_deviation

        crank = crank_angle + 2 * np.pi * np.arange(self.discs) / self.discs
        heights = main.face_width * ((np.arange(self.slices * arcs) + 0.5) / (self.slices * arcs) - 0.5)
        tilt = [surface.misalignment_xz, surface.misalignment_yz]
        offset = [surface.centre_distance_x, surface.centre_distance_y]
        centre = (main.eccentricity + surface.eccentricity) * np.array([np.cos(crank), np.sin(crank)]).T + offset
        self.centre = centre[:, None] + np.multiply.outer(heights, tilt)  # (discs, slices * arcs, 2)
        self.ideal = -crank / self.teeth
        self.tooth_turn = surface.tooth_cumulative_pitch / self.radius
        self.gear_deviation = self._at_slices(surface.gear_deviation, (self.discs, self.teeth, sizes[1]))
        self.pin_deviation = self._at_slices(surface.pin_deviation, (self.pins, sizes[2]))
        # Generous beside any real error or deflection, yet far from the next tooth.
        self.reach = 0.05 * 2 * np.pi / self.teeth

    def _at_slices(self, deviation: np.ndarray | None, shape: tuple[int, ...]) -> np.ndarray:
        """Deviation at each slice: that of the element across the width in which the slice's middle is."""
        if deviation is None:
            return np.zeros((*shape, self.slices))
        if deviation.shape[:-1] != shape:
            raise ValueError(f"deviation of shape {deviation.shape}, expected {shape} and the width")
        middle = (np.arange(self.slices) + 0.5) / self.slices
        return deviation[..., np.floor(middle * deviation.shape[-1]).astype(int)]

    def _flank(self, generating: tuple[float, float], alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Points, outward unit normals (n, 2) and curvature (n,), > 0 convex, of tooth 0 in the gear frame.

        The flank is the path of the generating pin's centre, offset inwards by that pin's radius.
        """
        big, small = generating
        z, e = self.teeth + 1, self.eccentricity
        speed = np.stack(
            [-big * np.sin(alpha) + e * z * np.sin(z * alpha), big * np.cos(alpha) - e * z * np.cos(z * alpha)]
        )
        bend = np.stack(
            [-big * np.cos(alpha) + e * z * z * np.cos(z * alpha), -big * np.sin(alpha) + e * z * z * np.sin(z * alpha)]
        )
        length = np.hypot(*speed)
        normal = np.stack([speed[1], -speed[0]]) / length
        curvature = (speed[0] * bend[1] - speed[1] * bend[0]) / length**3
        path = np.stack([big * np.cos(alpha) - e * np.cos(z * alpha), big * np.sin(alpha) - e * np.sin(z * alpha)])
        return (path - small * normal).T, normal.T, curvature / (1 - small * curvature)

    def contacts(self, psi: float) -> Contacts:
        """Search the contact of every slice of every pin with the gear turned by `psi` rad from its ideal rotation."""
        search = self._search_points if self.deepest else self._search_pairs
        near = np.arange(-1, 2)  # a pin in the mouth of a gap reaches the tooth on either side of it
        found = []
        for disc in range(self.discs):
            turn = self.ideal[disc] + psi
            for layer in range(self.slices * self.arcs):
                slice_ = layer // self.arcs
                from_centre = self.pin_axis - self.centre[disc, layer]
                polar = np.arctan2(from_centre[:, 1], from_centre[:, 0]) - turn
                tooth = np.floor(polar * self.teeth / (2 * np.pi)).astype(int)[:, None] + near
                back = -(turn + 2 * np.pi * tooth / self.teeth + self.tooth_turn[disc, tooth % self.teeth]).ravel()
                tooth = (tooth % self.teeth).ravel()
                pin = np.repeat(np.arange(self.pins), near.size)
                x, y = from_centre[pin].T
                axis = np.stack([x * np.cos(back) - y * np.sin(back), x * np.sin(back) + y * np.cos(back)], axis=-1)
                inwards = self.pin_turn[pin] + np.pi + back
                gear, pins = self.gear_deviation[disc, tooth, :, slice_], self.pin_deviation[pin, :, slice_]
                values = (*search(axis, inwards, self.pin_radius[pin], gear, pins), tooth)
                values = [value.reshape(self.pins, near.size) for value in values]
                if not self.each_tooth:
                    best = np.argmax(values[0], axis=1)[:, None]
                    values = [np.take_along_axis(value, best, axis=1) for value in values]
                found.append(values)
        shape = (self.discs, self.slices, self.arcs, self.pins, -1)
        depth, arm, curvature, profile, angle, tooth = (np.array(v).reshape(shape) for v in zip(*found, strict=True))
        return Contacts(depth, arm, curvature, tooth, profile, angle)

    def _search_pairs(
        self, axis: np.ndarray, inwards: np.ndarray, radius: np.ndarray, gear: np.ndarray, pins: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Deepest pair of facing elements for each pin axis in a tooth's frame; all arguments have `rows` rows.

        Every gear element is tried with every pin element; `pairs="directed"` tries it only with the two pin elements
        (one, off their borders) that lie in the direction of the contact, which gives the same result.
        """
        rows, count, angles = len(axis), len(self.point), self.angle.size
        block = max(1, LARGEST_BLOCK // (count * (angles if self.all_pairs else 2)))
        parts = [
            self._pairs_of_rows(*(v[i : i + block] for v in (axis, inwards, radius, gear, pins)))
            for i in range(0, rows, block)
        ]
        return tuple(np.concatenate(part) for part in zip(*parts, strict=True))

    def _pairs_of_rows(
        self, axis: np.ndarray, inwards: np.ndarray, radius: np.ndarray, gear: np.ndarray, pins: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        from_point = axis[:, None] - self.point
        x = np.sum(from_point * self.tangent, axis=-1)[..., None]  # (rows, profile, 1)
        y = np.sum(from_point * self.normal, axis=-1)[..., None] - gear[..., None]
        bend = self.curvature[:, None]
        if self.all_pairs:
            index = np.broadcast_to(np.arange(self.angle.size), (len(axis), 1, self.angle.size))
        else:
            lean = np.arctan2(bend * x, 1 + bend * y) + np.arctan2(self.normal[:, 1], self.normal[:, 0])[:, None]
            seen = (lean + np.pi - inwards[:, None, None] + np.pi) % (2 * np.pi) - np.pi
            place = (seen + 0.5 * np.pi) / (2 * self.half_angle)
            index = np.floor(place + np.array([-BORDER, BORDER])).astype(int)
            index = np.clip(index, 0, self.angle.size - 1)
        row = np.arange(len(axis))[:, None, None]
        lifted = pins[row, index]
        direction = inwards[:, None, None] + self.angle[index]
        ux, uy = np.cos(direction), np.sin(direction)
        ut = ux * self.tangent[:, 0, None] + uy * self.tangent[:, 1, None]
        un = ux * self.normal[:, 0, None] + uy * self.normal[:, 1, None]

        # The gear patch's centre of curvature is at (0, -1/bend) in the frame of its control point; the pin patch's at
        # (x, y). Written so that neither sign of the curvature nor its absence is a special case.
        x, y = x + lifted * ut, y + lifted * un
        rise = 1 + bend * y
        stretch = np.sqrt((bend * x) ** 2 + rise**2)
        gap = (bend * (x * x + y * y) + 2 * y) / (1 + stretch) - radius[:, None, None]
        nt, nn = bend * x / stretch, rise / stretch  # the common normal, out of the gear
        along = x / np.where(rise > 0, rise, np.inf)  # tangent of the angle from the control point, times the radius
        across = ut * nn - un * nt  # sine of the angle on the pin from the common normal to its control point
        beyond = np.maximum(np.abs(along) / self.half_arc, np.abs(across) / np.sin(self.half_angle))
        beyond[~((rise > 0) & (ut * nt + un * nn < 0))] = np.inf
        facing = beyond <= 1 + SLACK
        nearest = np.min(beyond, axis=2)
        taken = nearest <= 1 + SLACK
        beside = np.pad(taken, ((0, 0), (2, 2)))
        free = ~np.any([beside[:, k : k + taken.shape[1]] for k in range(5)], axis=0)
        padded = np.pad(nearest, ((0, 0), (1, 1)), constant_values=np.inf)
        free &= (nearest <= BETWEEN) & (nearest <= padded[:, :-2]) & (nearest <= padded[:, 2:])
        if self.each_tooth:  # past a tooth's end the next tooth has the contact
            free[:, [0, -1]] = False
        facing |= free[..., None] & (beyond == nearest[..., None])
        depth = np.where(facing, -gap, -np.inf)
        if self.linear:
            # Of the patches' own places only few face each other: interpolate there.
            r, p, q = np.nonzero(facing)
            place = along[r, p, q] * (1 - (self.curvature[p] * along[r, p, q]) ** 2 / 3) / (2 * self.half_arc)
            element = index[r, 0 if index.shape[1] == 1 else p, q]
            turn = np.arcsin(across[r, p, q]) / (2 * self.half_angle)
            more = self._interpolated(gear, r, np.interp(p + place, self.by_arc, self.by_parameter)) - gear[r, p]
            more += self._interpolated(pins, r, element + turn) - pins[r, element]
            depth[r, p, q] += more
        best = np.argmax(depth.reshape(len(axis), -1), axis=1)
        p, q = np.divmod(best, depth.shape[2])
        r = np.arange(len(axis))
        element = index[r, 0 if index.shape[1] == 1 else p, q]
        centre = axis + lifted[r, 0 if lifted.shape[1] == 1 else p, q, None] * np.stack(
            [np.cos(inwards + self.angle[element]), np.sin(inwards + self.angle[element])], axis=-1
        )
        normal = nt[r, p, q, None] * self.tangent[p] + nn[r, p, q, None] * self.normal[p]
        arm = centre[:, 0] * normal[:, 1] - centre[:, 1] * normal[:, 0]
        bend = self._curvature_at(p + 0.5 + along[r, p, 0 if along.shape[2] == 1 else q] / (2 * self.half_arc))
        return depth[r, p, q], arm, bend, p, element

    def _curvature_at(self, place: np.ndarray) -> np.ndarray:
        """Flank's curvature for Hertz's law at places counted in elements from the tooth's root, shape (rows,)."""
        place = np.clip(np.nan_to_num(place), 0, len(self.point) - 1e-9)
        if not self.linear:
            return self.curvature[place.astype(int)]
        return np.interp(place - 0.5, np.arange(len(self.point)), self.curvature)

    @staticmethod
    def _interpolated(values: np.ndarray, row: np.ndarray, place: np.ndarray) -> np.ndarray:
        """Values (rows, n) at places counted in elements from the first one's middle, held beyond the outer middles."""
        place = np.clip(place, 0, values.shape[1] - 1)
        low = np.minimum(place.astype(int), max(values.shape[1] - 2, 0))
        high = np.minimum(low + 1, values.shape[1] - 1)
        return values[row, low] + (place - low) * (values[row, high] - values[row, low])

    def _search_points(
        self, axis: np.ndarray, inwards: np.ndarray, radius: np.ndarray, gear: np.ndarray, pins: np.ndarray
    ) -> tuple[np.ndarray, ...]:
        """Deepest point of the deviated flank for each pin axis in a tooth's frame, by two scans, coarse and fine."""
        row = np.arange(len(axis))[:, None]
        coarse = (np.arange(len(self.point) * self.samples) + 0.5) / self.samples  # in elements from the tooth's root
        place = np.broadcast_to(coarse, (len(axis), coarse.size))
        depth = self._depth_of_points(row, place, axis, inwards, radius, gear, pins)[0]
        middle = coarse[np.argmax(depth, axis=1)]
        place = np.clip(middle[:, None] + np.linspace(-1, 1, 41) / self.samples, 0, len(self.point) - 1e-9)
        every = self._depth_of_points(row, place, axis, inwards, radius, gear, pins)
        best = np.argmax(every[0], axis=1)[:, None]
        depth, angle, nx, ny = (np.take_along_axis(value, best, axis=1)[:, 0] for value in every)
        at = np.take_along_axis(place, best, axis=1)[:, 0]
        arm = axis[:, 0] * ny - axis[:, 1] * nx
        return depth, arm, self._curvature_at(at), at.astype(int), angle.astype(int)

    def _depth_of_points(
        self,
        row: np.ndarray,
        place: np.ndarray,
        axis: np.ndarray,
        inwards: np.ndarray,
        radius: np.ndarray,
        gear: np.ndarray,
        pins: np.ndarray,
    ) -> tuple[np.ndarray, ...]:
        element = place.astype(int)
        along = np.interp(place - 0.5, self.by_arc, self.by_parameter)
        lift = self._interpolated(gear, row, along) if self.linear else gear[row, element]
        s, bend = (place - element - 0.5) * 2 * self.half_arc, self.curvature[element]
        lean = bend * s
        sine, drop = s * np.sinc(lean / np.pi), 0.5 * bend * (s * np.sinc(0.5 * lean / np.pi)) ** 2
        t, n = sine + lift * np.sin(lean), lift * np.cos(lean) - drop
        tangent, normal = self.tangent[element], self.normal[element]
        dx = axis[:, 0, None] - self.point[element, 0] - t * tangent[..., 0] - n * normal[..., 0]
        dy = axis[:, 1, None] - self.point[element, 1] - t * tangent[..., 1] - n * normal[..., 1]
        distance = np.hypot(dx, dy)
        seen = (np.arctan2(-dy, -dx) - inwards[:, None] + np.pi) % (2 * np.pi) - np.pi
        angle = (seen + 0.5 * np.pi) / (2 * self.half_angle)
        faces = (angle >= 0) & (angle <= self.angle.size)
        angle = np.clip(angle, 0, self.angle.size - 1e-9)
        raised = self._interpolated(pins, row, angle - 0.5) if self.linear else pins[row, angle.astype(int)]
        depth = np.where(faces, radius[:, None] + raised - distance, -np.inf)
        return depth, angle, dx / distance, dy / distance

    def loads(self, every: Contacts) -> Loads:
        """Hertz line contact of every slice of every pin, by bisection on the approach.

        As in the paper, the arcs of a slice that touch give the width and the mean depth of one contact.
        """
        touching = every.depth > 0
        number = np.sum(touching, axis=2)
        share = np.maximum(number, 1)
        depth, arm, curvature = (
            np.sum(np.where(touching, value, 0.0), axis=2) / share
            for value in (every.depth, every.arm, every.curvature)
        )
        width = self.width * share / self.arcs
        gear, pin = self.compliance
        radius = np.broadcast_to(self.pin_radius[:, None], depth.shape)
        star = 1 / np.abs(1 / radius + curvature)
        rho = np.minimum(1 / np.maximum(np.abs(curvature), 1e-12), self.longest)
        per_area = np.pi * width / (4 * star * (gear + pin))  # force over the half width's square
        # Beyond this half width the printed approach falls with the force, so there the bisection has to end.
        widest = np.exp((gear * np.log(4 * rho) + pin * np.log(4 * radius)) / (gear + pin) - 1)
        low, high = np.zeros_like(depth), widest**2 * per_area
        for _ in range(60):
            force = 0.5 * (low + high)
            a = np.sqrt(force / per_area)
            both = gear * (np.log(4 * rho / a) - 0.5) + pin * (np.log(4 * radius / a) - 0.5)
            soft = 2 * force / (np.pi * width) * both < depth
            low, high = np.where(soft, force, low), np.where(soft, high, force)
        force = np.where(number > 0, 0.5 * (low + high), 0.0)
        return Loads(force, 2 / (np.pi * width) * np.sqrt(force * per_area), arm)

    def resisting_torque(self, psi: float) -> float:
        """Sum of force times arm over all discs, slices and pins at rotation `psi`, N*m."""
        loads = self.loads(self.contacts(psi))
        return float(np.sum(loads.force * loads.arm))

    def play(self) -> tuple[float, float, float]:
        """Lower and upper end of the free rotation, and the best smallest gap: rad, rad, m (both ends NaN if none)."""

        def smallest(psi: float) -> tuple[float, float]:
            every = self.contacts(psi)
            at = np.argmax(every.depth)
            return -float(every.depth.flat[at]), float(every.arm.flat[at])

        # The smallest gap grows with psi while the pin that has it pushes backwards, so its peak is where that turns.
        best = bisect(lambda psi: smallest(psi)[1] < 0, -self.reach, self.reach)
        room = smallest(best)[0]
        if abs(room) < TOUCHING:
            return best, best, 0.0
        if room < 0:
            return np.nan, np.nan, room
        ends = [bisect(lambda psi: smallest(psi)[0] > 0, best, best + side * self.reach) for side in (-1, 1)]
        return ends[0], ends[1], room


def bisect(still: Callable[[float], bool], start: float, end: float) -> float:
    """Argument between `start`, where `still` holds, and `end`, where not, at which it ceases to hold, to 1e-9."""
    while abs(end - start) > 1e-9 * max(abs(start), abs(end), 1e-6):
        middle = 0.5 * (start + end)
        start, end = (middle, end) if still(middle) else (start, middle)
    return 0.5 * (start + end)


def solve_elements(
    pair: Any,
    surface: Any,
    crank_angle: float,
    torque: float,
    width_elements: int | None = None,
    profile_elements: int = 200,
    angle_elements: int = 100,
    reading: str = "linear",
    *,
    contact: str = "facing",
    pairs: str = "all",
    arcs: int = 1,
    each_tooth: bool = False,
    with_play: bool = True,
    sampling: float = 4e-6,
) -> dict[str, Any]:
    """Solve one loaded crank angle of a pair with an error surface, by brute force over its elements.

    Parameters
    ----------
    pair
        As `cycloid_fmu.geometry.pair.read_pair` returns it (its nominal tables only: `[errors]` come with the surface).
    surface
        As `cycloid_fmu.surfaces.surface.ErrorSurface`.
    crank_angle, torque
        Crank angle, rad; torque of the environment on the output, N*m.
    width_elements, profile_elements, angle_elements
        Elements across the width (slices), along the profile of a tooth and around the facing half of a pin. Where the
        surface has deviations, its arrays give their number; slices may still be given, each takes the deviation of
        the element in which its middle is. Without either: one slice.
    reading
        "linear": deviations interpolated between the elements' middles; "constant": each element's own.
    contact
        "facing": pairs whose closest points lie within both elements; "deepest": the deepest point of the deviated
        flank, edges, kinks and slopes included (it ignores `pairs`).
    pairs
        "all": every gear element with every pin element, as in the paper; "directed": with the one or two pin elements
        in the contact's direction, for the same result sooner.
    arcs
        The paper's n_e for misaligned axes: each slice is searched at so many heights, those that touch give the
        contact's width and mean depth; 1 is the slice's middle.
    each_tooth
        Whether a slice of a pin has a contact with each tooth that it touches instead of one, the deepest.
    with_play
        Whether to look for backlash and interference too (otherwise NaN): most of the time goes there.
    sampling
        Distance of points in the coarse scan of "deepest", m; the fine scan divides it by 20.

    Returns
    -------
    dict
        `transmission_error` and `backlash` (rad), `interference` (m), `max_contact_pressure` (Pa), `contact_count`,
        `pin_force` (N, shape (discs, pins), summed over slices), `gear_pressure` (Pa, shape (discs, teeth, profile,
        width)) and `pin_pressure` (discs, pins, angle, width) of the elements in contact, zero elsewhere;
        `torque_residual` (N*m; a step of the "constant" reading may leave one), `evaluations` of all contacts, and
        `seconds` taken.
    """
    begun = time.process_time()
    gear, pin = surface.gear_deviation, surface.pin_deviation
    given = [deviation.shape[-1] for deviation in (gear, pin) if deviation is not None]
    sizes = (
        width_elements or max(given, default=1),
        profile_elements if gear is None else gear.shape[2],
        angle_elements if pin is None else pin.shape[1],
    )
    body = Elements(pair, surface, crank_angle, sizes, reading, contact, pairs, arcs, each_tooth, sampling)
    count = 0
    search = body.contacts

    def counted(psi: float) -> Contacts:
        nonlocal count
        count += 1
        return search(psi)

    body.contacts = counted  # type: ignore[method-assign]
    lower, upper, room = body.play() if with_play or torque == 0 else (np.nan, np.nan, np.nan)
    if torque == 0 and room >= 0:
        psi = 0.5 * (lower + upper)
    else:
        if not body.resisting_torque(-body.reach) < torque < body.resisting_torque(body.reach):
            raise ValueError(f"no equilibrium within {body.reach} rad of the ideal rotation at {torque} N*m")
        psi = bisect(lambda angle: body.resisting_torque(angle) < torque, -body.reach, body.reach)
    every = body.contacts(psi)
    loads = body.loads(every)
    pin_force = np.sum(loads.force, axis=(1, 3))
    gear_pressure = np.zeros((body.discs, body.teeth, sizes[1], sizes[0]))
    pin_pressure = np.zeros((body.discs, body.pins, sizes[2], sizes[0]))
    disc, slice_, arc, pin_index, near = np.nonzero(every.depth > 0)
    at = (disc, slice_, arc, pin_index, near)
    pressure = loads.pressure[disc, slice_, pin_index, near]
    np.maximum.at(gear_pressure, (disc, every.tooth[at], every.profile[at], slice_), pressure)
    np.maximum.at(pin_pressure, (disc, pin_index, every.angle[at], slice_), pressure)
    return {
        "transmission_error": psi,
        "backlash": upper - lower,
        "interference": max(0.0, -room),
        "max_contact_pressure": float(np.max(loads.pressure, initial=0.0)),
        "contact_count": int(np.sum(pin_force > 0.01 * np.max(pin_force))),
        "pin_force": pin_force,
        "gear_pressure": gear_pressure,
        "pin_pressure": pin_pressure,
        "torque_residual": float(np.sum(loads.force * loads.arm)) - torque,
        "evaluations": count,
        "seconds": time.process_time() - begun,
    }
