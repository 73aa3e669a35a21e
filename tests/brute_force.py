"""Slow reference solver for the loaded contact of a cycloid-pin gear pair, by brute force in plain NumPy.

Written from the formulas of docs/theory alone as a yardstick for the compiled kernels, so it shares
nothing with them: no conjugate point, no Newton step, no warm start, no linearised gap. At every rotation each pin is
scanned against every profile point of the teeth it may touch. SI units throughout: m, rad, N, N*m, Pa.
"""

from __future__ import annotations

import re
import tomllib
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

UNITS = {"um": 1e-6, "mm": 1e-3, "mrad": 1e-3, "GPa": 1e9, "deg": np.pi / 180, "N*m": 1.0}
TOUCHING = 0.2e-9  # m; section 3: a best gap this small is contact without play, not interference


class Contacts(NamedTuple):
    """Every tangent contact candidate at one rotation; all arrays have shape (contacts,).

    `body` is disc * slices + slice, `gap` > 0 clearance (m), `arm` -d gap/d psi (m), `curvature` the flank's (1/m).
    """

    body: np.ndarray
    pin: np.ndarray
    gap: np.ndarray
    arm: np.ndarray
    curvature: np.ndarray


def load_pair(path: str | Path) -> dict:
    """Read a `cycloid-pair/1` file into nested plain dicts with every quantity in SI (section 5, Pair)."""

    def to_si(item):
        if isinstance(item, dict):
            return {key: to_si(value) for key, value in item.items()}
        if isinstance(item, list):
            return [to_si(value) for value in item]
        match = re.fullmatch(r"\s*([-+0-9.eE]+)\s+(\S+)\s*", item) if isinstance(item, str) else None
        return float(match[1]) * UNITS[match[2]] if match else item

    return to_si(tomllib.loads(Path(path).read_text(encoding="utf-8")))


def series(value: float | list | dict, count: int) -> np.ndarray:
    """Spread an error over `count` pins or teeth: a number, a list, or Fourier orders A cos(2 pi k i/count - phase)."""
    if not isinstance(value, dict):
        return np.broadcast_to(np.asarray(value, float), count)
    turn = 2 * np.pi * np.arange(count) / count
    return sum(
        amplitude * np.cos(int(name.removeprefix("order_")) * turn - phase)
        for name, (amplitude, phase) in value.items()
    )


class Pair:
    """Flank, pin axes and gear centres of a pair at one crank angle, ready to be scanned; parameters as in `solve`."""

    def __init__(self, pair: dict, crank_angle: float, points: int, slices: int = 1, halvings: int = 30) -> None:
        main = pair["pair"]
        errors, modification = (defaultdict(float, pair.get(key, {})) for key in ("errors", "modification"))
        if main.get("output", "gear") != "gear":
            raise ValueError('only output = "gear" is solved here: the pin ring stands still')
        steel = {"youngs_modulus": 206e9, "poissons_ratio": 0.3}
        materials = (steel | pair.get("material", {}).get(body, {}) for body in ("gear", "pin"))
        self.compliance = [(1 - one["poissons_ratio"] ** 2) / one["youngs_modulus"] for one in materials]
        self.teeth, self.pins, self.discs = main["gear_teeth"], main["pins"], main.get("discs", 1)
        self.radius, self.width, self.halvings = main["pin_circle_radius"], main["face_width"] / slices, halvings
        self.longest = {"capped": self.radius, "as_printed": np.inf}[main.get("contact_law", "capped")]

        # The flank is cut with the nominal eccentricity and pin circle: their errors are the crank's and the ring's.
        made = {key: modification[key] + errors[key] for key in ("offset", "isometric")}
        self.generating = (self.radius + made["offset"], main["pin_radius"] + made["isometric"], main["eccentricity"])
        self.profile = np.linspace(0.0, 2 * np.pi / self.teeth, points)
        self.flank_point, self.flank_tangent, _ = self.flank(self.profile)

        ring = self.radius + errors["pin_circle_radius"] + series(errors["pin_radial"], self.pins)
        turn = 2 * np.pi * np.arange(self.pins) / self.pins + series(errors["pin_tangential"], self.pins) / self.radius
        self.pin_axis = ring[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
        self.pin_radius = main["pin_radius"] + errors["pin_radius"] + series(errors["pin_radius_each"], self.pins)

        crank = crank_angle + 2 * np.pi * np.arange(self.discs) / self.discs
        middle = self.width * (np.arange(slices) - (slices - 1) / 2)
        tilt = [errors["misalignment_xz"], errors["misalignment_yz"]]
        offset = [errors["centre_distance_x"], errors["centre_distance_y"]]
        centre = (main["eccentricity"] + errors["eccentricity"]) * np.array([np.cos(crank), np.sin(crank)]).T + offset
        self.centre = (centre[:, None] + np.multiply.outer(middle, tilt)).reshape(-1, 2)
        self.ideal = np.repeat(-crank / self.teeth, slices)
        pitch = errors["tooth_cumulative_pitch"]
        each = pitch if isinstance(pitch, list) and isinstance(pitch[0], (list, dict)) else [pitch] * self.discs
        self.tooth_turn = np.repeat([series(p, self.teeth) / self.radius for p in each], slices, axis=0)
        # Generous beside any real error or deflection, yet far from the next tooth, where the same gaps come again.
        self.reach = 0.05 * 2 * np.pi / self.teeth

    def flank(self, alpha: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Flank of tooth 0 in the gear frame, crank at +x (section 4, turned from +y).

        It is the trochoid of the pin's centre, offset inwards by the generating pin's radius: so it has the trochoid's
        normals, and its curvature follows from the trochoid's.

        Parameters
        ----------
        alpha : ndarray, shape (n,)
            Profile parameter, rad: 0 at the tooth's first root, 2 pi/teeth at the next.

        Returns
        -------
        point, tangent, curvature : ndarray, shapes (n, 2), (n, 2), (n,)
            Flank point, m; its derivative by alpha, m/rad; curvature, 1/m, > 0 convex.
        """
        big, small, e = self.generating
        z = self.teeth + 1
        k = e * z / big
        c, s, cz, sz = np.cos(alpha), np.sin(alpha), np.cos(z * alpha), np.sin(z * alpha)
        speed = np.stack([-big * s + e * z * sz, big * c - e * z * cz], axis=-1)
        stretch = np.sqrt(1 + k**2 - 2 * k * np.cos(self.teeth * alpha))
        outward = np.stack([speed[..., 1], -speed[..., 0]], axis=-1) / (big * stretch[..., None])
        bend = (1 + z * k**2 - (1 + z) * k * np.cos(self.teeth * alpha)) / (big * stretch**3)
        shrink = 1 - small * bend
        point = np.stack([big * c - e * cz, big * s - e * sz], axis=-1) - small * outward
        return point, shrink[..., None] * speed, bend / shrink

    def contacts(self, psi: float) -> Contacts:
        """Find every tangent contact candidate with the gear turned by `psi` rad from its ideal rotation.

        The distance from pin axis to flank has a local minimum where its slope turns from falling to rising; looked for
        in the slope, one in a tooth's first or last cell is separated from the tooth's end, which is no contact.
        """
        from_centre = self.pin_axis - self.centre[:, None]
        x, y = from_centre[..., None, 0], from_centre[..., None, 1]
        turn = (self.ideal + psi)[:, None, None]
        polar = np.arctan2(y, x) - turn
        # A pin in the mouth of a gap reaches the tooth on either side of it.
        tooth = np.floor(polar * self.teeth / (2 * np.pi)).astype(int) + np.array([-1, 0, 1])
        pitch = self.tooth_turn[np.arange(len(self.centre))[:, None, None], tooth % self.teeth]
        back = -(turn + 2 * np.pi * tooth / self.teeth + pitch)
        axis = np.stack([x * np.cos(back) - y * np.sin(back), x * np.sin(back) + y * np.cos(back)], axis=-1)

        slope = np.sum(self.flank_point * self.flank_tangent, axis=-1) - axis @ self.flank_tangent.T
        body, pin, side, cell = np.nonzero((slope[..., :-1] < 0) & (slope[..., 1:] >= 0))
        axis = axis[body, pin, side]
        low, high = self.profile[cell], self.profile[cell + 1]
        for _ in range(self.halvings):
            middle = 0.5 * (low + high)
            point, tangent, _ = self.flank(middle)
            falling = np.sum((point - axis) * tangent, axis=-1) < 0
            low, high = np.where(falling, middle, low), np.where(falling, high, middle)
        point, _, curvature = self.flank(0.5 * (low + high))
        away = axis - point
        distance = np.hypot(*away.T)
        arm = (axis[:, 0] * away[:, 1] - axis[:, 1] * away[:, 0]) / distance
        return Contacts(body, pin, distance - self.pin_radius[pin], arm, curvature)

    def hertz(self, contacts: Contacts) -> tuple[np.ndarray, np.ndarray]:
        """Force (N) and largest pressure (Pa) of each contact, by bisection on the approach (section 4, Hertz)."""
        gear, pin = self.compliance
        radius = self.pin_radius[contacts.pin]
        star = 1 / np.abs(1 / radius + contacts.curvature)
        # The floor represents an inflection met exactly; it keeps the printed law's logarithm finite.
        rho = np.minimum(1 / np.maximum(np.abs(contacts.curvature), 1e-12), self.longest)
        per_area = np.pi * self.width / (4 * star * (gear + pin))

        def approach(force):
            a = np.sqrt(force / per_area)
            both = gear * (np.log(4 * rho / a) - 0.5) + pin * (np.log(4 * radius / a) - 0.5)
            return 2 * force / (np.pi * self.width) * both

        # Beyond this half width the printed approach falls with the force, so there the bisection has to end.
        widest = np.exp((gear * np.log(4 * rho) + pin * np.log(4 * radius)) / (gear + pin) - 1)
        low, high = np.zeros_like(star), widest**2 * per_area
        for _ in range(55):
            middle = 0.5 * (low + high)
            soft = approach(middle) < -contacts.gap
            low, high = np.where(soft, middle, low), np.where(soft, high, middle)
        force = np.where(contacts.gap < 0, 0.5 * (low + high), 0.0)
        return force, 2 / (np.pi * self.width) * np.sqrt(force * per_area)

    def resisting_torque(self, psi: float) -> float:
        """Sum of force times arm over all discs and both flanks at rotation `psi`, N*m."""
        every = self.contacts(psi)
        pressed = Contacts(*(field[every.gap < 0] for field in every))
        return float(np.sum(self.hertz(pressed)[0] * pressed.arm))

    def play(self) -> tuple[float, float, float]:
        """Lower and upper end of the free rotation, and the best smallest gap: rad, rad, m (both ends NaN if none)."""

        def smallest(psi):
            every = self.contacts(psi)
            return min(zip(every.gap, every.arm, strict=True), default=(np.inf, 0.0))

        # The smallest gap grows with psi while the pin that has it pushes backwards, so its peak is where that turns.
        best = bisect(lambda psi: smallest(psi)[1] < 0, -self.reach, self.reach)
        room = float(smallest(best)[0])
        if abs(room) < TOUCHING:
            return best, best, 0.0
        if room < 0:
            return np.nan, np.nan, room
        ends = [bisect(lambda psi: smallest(psi)[0] > 0, best, best + side * self.reach) for side in (-1, 1)]
        return ends[0], ends[1], room


def bisect(still: Callable[[float], bool], start: float, end: float) -> float:
    """Argument between `start`, where `still` holds, and `end`, where it does not, at which it ceases to hold."""
    for _ in range(42):
        middle = 0.5 * (start + end)
        start, end = (middle, end) if still(middle) else (start, middle)
    return 0.5 * (start + end)


def solve(
    pair: dict,
    crank_angle: float,
    torque: float,
    points: int = 200,
    slices: int = 1,
    halvings: int = 30,
    with_play: bool = True,
) -> dict:
    """Solve one loaded crank angle (section 4, Contact; section 3 for signs and definitions).

    Parameters
    ----------
    pair : dict
        As `load_pair` returns it: SI.
    crank_angle, torque : float
        Crank angle, rad; torque of the environment on the output, N*m.
    points, slices, halvings : int
        Profile points per tooth; slices across the face, each taken at its middle; bisections of the tangency
        condition between two points (0 is the bare scan).
    with_play : bool
        Whether to look for backlash and interference too (otherwise NaN and 0); most of the time goes there.

    Returns
    -------
    dict
        `transmission_error` and `backlash` (rad), `interference` (m), `max_contact_pressure` (Pa), `contact_count`,
        `pin_force` (N, shape (discs, pins), summed over slices).
    """
    gears = Pair(pair, crank_angle, points, slices, halvings)
    lower, upper, room = gears.play() if with_play or torque == 0 else (np.nan, np.nan, np.nan)
    if torque == 0 and room >= 0:
        psi = 0.5 * (lower + upper)
    else:
        if not gears.resisting_torque(-gears.reach) < torque < gears.resisting_torque(gears.reach):
            raise ValueError(f"no equilibrium within {gears.reach} rad of the ideal rotation at {torque} N*m")
        psi = bisect(lambda angle: gears.resisting_torque(angle) < torque, -gears.reach, gears.reach)
    contacts = gears.contacts(psi)
    force, pressure = gears.hertz(contacts)
    pin_force = np.zeros((gears.discs, gears.pins))
    np.add.at(pin_force, (contacts.body // slices, contacts.pin), force)
    return {
        "transmission_error": psi,
        "backlash": upper - lower,
        "interference": max(0.0, -room),
        "max_contact_pressure": float(np.max(pressure, initial=0.0)),
        "contact_count": int(np.sum(pin_force > 0.01 * np.max(pin_force))),
        "pin_force": pin_force,
    }
