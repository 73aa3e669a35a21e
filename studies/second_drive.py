"""A second drive: loaded transmission error by a solver that shares nothing with the product's kernels.

A pin's gap is the signed distance of its centre from the closed trochoid c(s) = (R - e exp(is)) exp(is/z_c), tooth by
tooth; the Hertz approach is inverted by Lambert's function; all crank angles at once in plain NumPy. Unknowns are the
rotation of the output and, if the discs float on springs, the position of each disc: Newton's method on their
equilibrium, with gaps and contact stiffness computed again at every step. SI units, and the signs of the product.
"""

import dataclasses
import re

import numpy as np
from scipy.special import lambertw

YOUNG, POISSON = 206e9, 0.3  # steel on steel
GIVE = 2.0 * (1.0 - POISSON**2) / YOUNG  # m²/N
_FAR, _STEP, _SHIFT = (
    40e-6,
    10e-6,
    5e-6,
)  # m at the flank: start; largest rotation and shift of a step
_LEFT, _STEPS, _HALVED = 1e-7, 200, 1e-3  # allowed residual over the torque; most steps; smallest share of a step


@dataclasses.dataclass(frozen=True)
class Body:
    """Flanks as cut, pins and cranks at their positions, discs with their bearings.

    Attributes
    ----------
    teeth, width
        Of a disc: number of teeth, face width (m).
    cut
        Generating circle, generating pin's radius and eccentricity, m.
    longest
        Largest radius of curvature of a flank in the logarithm of Hertz's approach, m.
    pins, pin_radius
        Shape (pins,): centres of the pins in the plane, complex, and their radii, m.
    throw, axis
        Throw of the crank, and the position of its axis (complex), m.
    turned
        Shape (discs, teeth): rotation of each tooth about its disc's centre, rad.
    form
        Amplitudes of cos(kπu), k = 1, 2, …, u = 0 … 1 along a flank's arc from root to root, on all flanks alike:
        material added, m, to second order in its slope; shifts of a disc neglect the slope.
    bearing, windup
        Stiffness of the springs at a disc's centre, N/m in every direction, None if rigid; and further compliance of
        the output, rad/(N·m).
    """

    teeth: int
    width: float
    cut: tuple[float, float, float]
    longest: float
    pins: np.ndarray
    pin_radius: np.ndarray
    throw: float
    axis: complex
    turned: np.ndarray
    form: tuple[float, ...] = ()
    bearing: float | None = None
    windup: float = 0.0

    def moved(self, **by):
        """The body with these errors added."""
        return dataclasses.replace(self, **{name: getattr(self, name) + value for name, value in by.items()})


def waves(values, pattern, count):
    """Sum of the orders `pattern_k_cos` and `pattern_k_sin` of structured errors, shape (count,), m."""
    turn, found = 2.0 * np.pi * np.arange(count) / count, np.zeros(count)
    for name, value in values.items():
        if match := re.fullmatch(rf"{pattern}_(\d+)_(cos|sin)", name):
            found += value * getattr(np, match[2])(int(match[1]) * turn)
    return found


def body(sizes, values=None, scatter=None, *, isometric=0.0, offset=0.0, discs=1, form=(), bearing=None, windup=0.0):
    """A body of sizes (gear_teeth, pin_circle_radius, pin_radius, eccentricity, face_width) with errors.

    Parameters
    ----------
    values
        Structured errors by their names in an identification, m. Orders of teeth hold for all discs.
    scatter
        Additional errors of single pins and teeth: {pin_radial, pin_tangential, pin_radius, tooth_cumulative_pitch:
        shape (pins,) or (discs, teeth)}, m.
    """
    values, scatter = values or {}, scatter or {}
    teeth, big = sizes["gear_teeth"], sizes["pin_circle_radius"]
    place = 2.0 * np.pi * np.arange(teeth + 1) / (teeth + 1)

    def of(pattern, count=teeth + 1):
        return waves(values, pattern, count) + scatter.get(pattern, 0.0)

    radial, tangential = of("pin_radial"), of("pin_tangential")
    return Body(
        teeth=teeth,
        width=sizes["face_width"],
        cut=(
            big + offset + values.get("offset", 0.0),
            sizes["pin_radius"] + isometric + values.get("isometric", 0.0),
            sizes["eccentricity"],
        ),
        longest=big,
        pins=(big + values.get("pin_circle_radius", 0.0) + radial) * np.exp(1j * (place + tangential / big)),
        pin_radius=sizes["pin_radius"] + values.get("pin_radius", 0.0) + scatter.get("pin_radius", np.zeros(teeth + 1)),
        throw=sizes["eccentricity"] + values.get("eccentricity", 0.0),
        axis=complex(values.get("centre_distance_x", 0.0), values.get("centre_distance_y", 0.0)),
        turned=np.broadcast_to(of("tooth_cumulative_pitch", teeth) / big, (discs, teeth)),
        form=tuple(form),
        bearing=bearing,
        windup=windup,
    )


def _trochoid(s, made):
    """Path of a generating pin's centre in the frame of the disc, and its first two derivatives."""
    big, _, throw = made.cut
    first, second = 1j / made.teeth, 1j * (made.teeth + 1) / made.teeth
    a, b = big * np.exp(first * s), -throw * np.exp(second * s)
    return a + b, first * a + second * b, first**2 * a + second**2 * b


def _along(s, made):
    """Share of a flank's arc at contacts with parameters 0 ≤ s < 2π, and the length of the arc, m."""
    grid = np.linspace(0.0, 2.0 * np.pi, 2001)
    _, first, second = _trochoid(grid, made)
    speed = np.abs(first) - made.cut[1] * np.imag(np.conj(first) * second) / np.abs(first) ** 2
    arc = np.concatenate([[0.0], np.cumsum(0.5 * (speed[1:] + speed[:-1]))])
    return np.interp(s, grid, arc / arc[-1]), arc[-1] * (grid[1] - grid[0])


def _form(s, made):
    """Thickness of the form, its slope and its second derivative along the arc: m, 1, 1/m."""
    share, length = _along(s, made)
    waves = np.pi * np.arange(1, len(made.form) + 1)
    phase, each = share[:, None] * waves, np.array(made.form)
    return (
        np.cos(phase) @ each,
        -np.sin(phase) @ (each * waves) / length,
        -np.cos(phase) @ (each * waves**2) / length**2,
    )


def _hertz(depth, curvature, radius, made):
    """Force (N) and stiffness (N/m) of line contacts by `depth` (m); curvature of the flank (1/m), convex positive.

    The approach is f F (C - ln F), so that C - ln F = -W(-depth exp(-C)/f) on the lower branch.
    """
    factor = GIVE / (np.pi * made.width)
    flank = np.minimum(1.0 / np.maximum(np.abs(curvature), 1e-12), made.longest)
    logs = np.log(4.0 * np.pi * made.width * flank * radius * np.abs(1.0 / radius + curvature) / GIVE) - 1.0
    far = -lambertw(-depth * np.exp(-logs) / factor, -1).real
    return depth / (factor * far), 1.0 / (factor * (far - 1.0))


def _pushed(made, theta, state, shift, told=None):
    """Moments and reaction forces of the pins on the discs, shape (points, 1 + 2 discs), and their derivative.

    `state` has the rotation beyond the ideal one, and two shifts of every disc. A list `told` gets a tuple for each
    disc and side: (point, pin, tooth, parameter on it, force, curvature of the flank, place against the disc's centre).
    """
    points, discs, pins = theta.size, len(made.turned), made.pins.size
    size = state.shape[1]
    total, slope = np.zeros((points, size)), np.zeros((points, size, size))
    beta = 2.0 * np.pi * np.arange(pins) / pins
    for disc in range(discs):
        at = theta + 2.0 * np.pi * disc / discs
        held = slice(1 + 2 * disc, 3 + 2 * disc)
        centre = made.throw * np.exp(1j * at) + made.axis + shift * np.exp(1j * at)
        if size > 1:
            centre = centre + state[:, held] @ [1.0, 1j]
        turn = np.exp(1j * (-at / made.teeth + state[:, 0]))
        seen = (made.pins - centre[:, None]) / turn[:, None]
        ideal = at[:, None] - beta + 2.0 * np.pi * np.arange(pins)
        near = np.floor(ideal / (2.0 * np.pi)).astype(int)
        beside = np.where(ideal / (2.0 * np.pi) - near < 0.5, near - 1, near + 1)
        for tooth in (near, beside):
            # The neighbouring tooth can only be in contact near the root.
            there = (
                np.ones(tooth.shape, bool)
                if tooth is near
                else np.abs(ideal - 2.0 * np.pi * np.round(ideal / (2.0 * np.pi))) < 0.3
            )
            row, pin = np.nonzero(there)
            of = tooth[row, pin]
            place = seen[row, pin] * np.exp(-1j * made.turned[disc, of % made.teeth])
            s = ideal[row, pin]
            for _ in range(5):
                curve, first, second = _trochoid(s, made)
                off = curve - place
                s = s - np.real(off * np.conj(first)) / (np.abs(first) ** 2 + np.real(off * np.conj(second)))
            curve, first, second = _trochoid(s, made)
            outward = -1j * first / np.abs(first)
            within = s - 2.0 * np.pi * of
            radius = made.pin_radius[pin]
            gap = np.real((place - curve) * np.conj(outward)) + made.cut[1] - radius
            path = np.imag(np.conj(first) * second) / np.abs(first) ** 3
            bend, lever = path / (1.0 - path * made.cut[1]), np.imag(np.conj(curve) * outward)
            if made.form:
                thick, slope_of, bent = _form(within, made)
                # A slope of the flank displaces the contact, in proportion to the curvatures of both bodies.
                gap = gap - thick - 0.5 * slope_of**2 / (1.0 / radius + bend)
                aside = np.real(-1j * place * np.conj(first)) / np.abs(first) * (1.0 - path * made.cut[1])
                bend, lever = bend - bent, lever + slope_of * aside
            touch = (gap < 0.0) & (within >= 0.0) & (within < 2.0 * np.pi)
            row, outward = row[touch], outward[touch]
            force, stiffness = _hertz(-gap[touch], bend[touch], radius[touch], made)
            if told is not None:
                reached = (curve[touch] - made.cut[1] * (-1j * first[touch] / np.abs(first[touch]))) * np.exp(
                    1j * made.turned[disc, of[touch] % made.teeth]
                )
                told.append((row, pin[touch], of[touch], within[touch], force, bend[touch], reached * turn[row]))
            # The tooth's own frame turns back into the plane.
            back = turn[row] * np.exp(1j * made.turned[disc, of[touch] % made.teeth])
            normal = outward * back
            arms = np.zeros((row.size, size))
            arms[:, 0] = lever[touch]
            if size > 1:
                arms[:, held] = np.stack([normal.real, normal.imag], axis=1)
            np.add.at(total, row, force[:, None] * arms)
            np.add.at(slope, row, stiffness[:, None, None] * arms[:, :, None] * arms[:, None, :])
    return total, slope


def transmission_error(made, theta, torque, shift=0.0):
    """Deviation (rad) of the output from the ideal rotation.

    Parameters
    ----------
    made
        The `Body`.
    theta, torque
        Shape (points,), or one torque: crank angle, rad; torque on the output, N·m.
    shift
        Displacement of discs from their crank's throw, complex in the crank's frame: real along the throw,
        imaginary ahead of it, m.
    """
    return _balanced(made, theta, torque, shift)[:, 0] + made.windup * np.asarray(torque)


def _balanced(made, theta, torque, shift=0.0):
    """States of `_pushed` in balance, shape (points, 1 + 2 discs with bearings); NaN where there is none."""
    theta = np.asarray(theta, float)
    torque, shift = np.broadcast_to(torque, theta.shape), np.broadcast_to(shift, theta.shape)
    size = 1 if made.bearing is None else 1 + 2 * len(made.turned)
    state = np.zeros((theta.size, size))
    lever = made.teeth * made.cut[2]
    state[:, 0] = np.sign(torque) * _FAR / lever
    scale = np.array([1.0] + [lever] * (size - 1))
    outside = np.zeros(size)
    outside[0] = 1.0
    before, step, least = np.full(theta.size, np.inf), np.zeros_like(state), np.ones(theta.size)
    now = np.arange(theta.size)
    for _ in range(_STEPS):
        total, slope = _pushed(made, theta[now], state[now], shift[now])
        if size > 1:
            total[:, 1:] += made.bearing * state[now, 1:]
            slope[:, range(1, size), range(1, size)] += made.bearing
        rest = torque[now, None] * outside - total
        away = (np.abs(rest) * scale).max(axis=1) / np.abs(torque[now])
        # A step that increases the residual is halved, except without contact.
        worse = (away > before[now]) & (slope[:, 0, 0] > 0.0) & (least[now] > _HALVED)
        back, on = now[worse], ~worse
        least[back] *= 0.5
        state[back] -= step[back] * 0.5
        step[back] *= 0.5
        on &= away > _LEFT
        slope[:, 0, 0] += 1e-3 * lever * np.abs(rest[:, 0]) / _STEP * (slope[:, 0, 0] == 0.0)
        then = now[on]
        move = np.linalg.solve(slope[on], rest[on, :, None])[:, :, 0]
        most = np.array([_STEP / lever] + [_SHIFT] * (size - 1))
        before[then], least[then] = away[on], 1.0
        step[then] = np.clip(move, -most, most)
        state[then] += step[then]
        now = np.sort(np.concatenate([then, back]))
        if not now.size:
            return state
    state[now] = np.nan
    return state


def contacts(made, theta, torque):
    """Contacts of a body as arrays of one length: the results of `_pushed` for each (see there)."""
    theta = np.asarray(theta, float)
    told: list[tuple] = []
    _pushed(made, theta, _balanced(made, theta, torque), np.zeros(theta.shape), told)
    return tuple(np.concatenate(parts) for parts in zip(*told, strict=True))


def sizes_of(pair):
    """Sizes of a nominal pair, as `body` takes them."""
    names = ("gear_teeth", "pin_circle_radius", "pin_radius", "eccentricity", "face_width")
    return {name: getattr(pair, name) for name in names}
