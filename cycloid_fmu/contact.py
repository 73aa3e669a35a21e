"""Contact of gear and pins: gaps, Hertz force, equilibrium, play and sensitivities, compiled, on plain arrays.

The flank is the curve parallel, at the generating pin's radius r, to the path of the generating pin's centre in the
gear, T(α) = R e^{iα} - e e^{i z_p α}: so the gap of a pin is the signed distance of its axis from T, plus r, less the
pin's radius, and its foot on T and on the flank are the same α (docs/theory/contact.md; turned by -90° so that
tooth 0 begins at +x). A point is a complex number in the comments and a pair (x, y) in the code.

The unknown is x, the output's deviation from the ideal drive: gear angle -θ/z_c + x with the pin ring fixed, or ring
angle θ/z_p + x with the gear held. Torque is what the environment puts on the output; force times arm balances it.

Contacts are rows of an array, two for each disc, slice and pin: the conjugate tooth, and the tooth across the nearest
root, which a pin may touch as well. The columns are named below.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar, cast

import numpy as np
from numba import njit
from numpy.typing import NDArray

Array = NDArray[np.float64]
_Tangency = tuple[float, float, float, float, float, float, float, float, float, float]
_Directions = tuple[float, float, float, float]
_Flank = tuple[float, float, float, int, bool]  # R, e, r, teeth, ring

(
    FOOT, FOOT_RATE, GAP, ARM, ARM_RATE, CURVATURE, CURVATURE_RATE, FORCE, STIFFNESS, FORCE_BY_CURVATURE, AT, PLACE,
    ANGLE, ANGLE_RATE, FOOT_ANGLE_RATE, COLUMNS,
) = range(16)  # fmt: skip

# The displacements of one number, in the order of `errors.kinds.BODIES`; then those of pins and teeth.
CENTRE_X, CENTRE_Y, TILT_X, TILT_Y, CRANK_THROW, PIN_GENERATING, CIRCLE_GENERATING, BODY_COUNT = range(8)

TOUCHING = 2e-10  # m: an interference below this counts as touching
_FOOT_STEP = 1e-11  # m: Newton's last step along the flank; near a root the moment arm errs by a thousand times that
_ROTATION_STEP = 1e-12  # rad: last step of the play's ends
_LINEAR_STEP = 1e-9  # rad: below this Newton's last step of an equilibrium is made with the stiffnesses at hand
_BOUNDED = 2e-6  # m: in an equilibrium a gap above this need not be known exactly
_INTERPOLATED = 1e-9  # m: what interpolation across slices may err on a clear pin's gap
_CLEAR = 5e-7  # m: a pin predicted to be this clear is not solved again within one equilibrium
# Deviations can't make a contact more conformal than this share of its nominal 1/ρ*: where wear leaves no curvature
# between flank and pin Hertz's half width has no end, while the scar's own width is one. From 0.03 to 0.3 the wear
# paper's pair wears equally within 1 % (docs/wear.md).
_CONFORMAL = 0.1
_FORETOLD = 2e-4  # rad: so far a gap's derivatives by the rotation may foretell it, where the second adds little
_COUNTED = 0.01  # a pin counts as in contact above this share of the most loaded pin's force


_Function = TypeVar("_Function", bound=Callable[..., Any])


def compiled(function: _Function) -> _Function:
    """Compile a kernel, its type kept."""
    return cast(_Function, njit(cache=True, error_model="numpy", nogil=True)(function))


def _inlined(function: _Function) -> _Function:
    return cast(_Function, njit(cache=True, error_model="numpy", inline="always")(function))


class Drive(NamedTuple):
    """The contact problem as numbers and arrays, SI.

    Attributes
    ----------
    circle_radius, generating_radius, generating_eccentricity
        R, r and e of the flank that was made, m.
    eccentricity
        The crank's own eccentricity, m.
    teeth
        z_c; there is one pin more.
    ring
        Whether the pin ring is the output (the gear held) instead of the gear (the ring fixed).
    pin_x, pin_y, pin_radius
        Axis and radius of each pin in the ring's frame, shape (pins,), m.
    tooth_turn
        Rotation of each tooth about the gear's centre, shape (discs, teeth), rad.
    crank_phase
        Angle of each disc's crank ahead of disc 0's, shape (discs,), rad.
    centre_x, centre_y
        Offset of the gear's centre in each slice, shape (slices,), m.
    slice_z
        Distance of each slice's middle from mid-width, shape (slices,), m.
    slice_width
        m.
    compliance_gear, compliance_pin
        (1 - ν²)/E, 1/Pa.
    largest_log_radius
        Limit of the flank's curvature radius in Hertz's logarithm, m; infinite for the law as printed.
    root_phase
        Phase from a root within which both its teeth are tried, rad.
    root_margin
        How far neighbouring teeth may stand apart at their root, m.
    flank_alpha, flank_x, flank_y, flank_normal_x, flank_normal_y
        Profile parameter (rad), points (m) and normals of tooth 0 at its ends and its elements' middles, shape
        (elements + 2,).
    gear_deviation
        Normal deviation at those points, shape (discs, slices, teeth, elements + 2), m; size 0 where flanks and pins
        are nominal. Between the points it is linear in the parameter.
    pin_deviation
        Normal deviation at the middles of each pin's elements of equal angle, shape (slices, pins, elements), m.
    largest_deviation
        Sum of the largest deviations of gear and pins, m.
    gear_curvature, pin_curvature
        Curvature that the deviations add at the same places, > 0 convex, shapes as the deviations', 1/m; size 0 where
        none is counted.
    """

    circle_radius: float
    generating_radius: float
    generating_eccentricity: float
    eccentricity: float
    teeth: int
    ring: bool
    pin_x: Array
    pin_y: Array
    pin_radius: Array
    tooth_turn: Array
    crank_phase: Array
    centre_x: Array
    centre_y: Array
    slice_z: Array
    slice_width: float
    compliance_gear: float
    compliance_pin: float
    largest_log_radius: float
    stray: float
    root_phase: float
    root_margin: float
    flank_alpha: Array
    flank_x: Array
    flank_y: Array
    flank_normal_x: Array
    flank_normal_y: Array
    gear_deviation: Array
    pin_deviation: Array
    largest_deviation: float
    gear_curvature: Array
    pin_curvature: Array


@compiled
def contact_rows(drive: Drive) -> Array:
    """Return the empty contact array of a drive, shape (discs x slices x pins x 2, columns)."""
    contacts = np.zeros((drive.crank_phase.size * drive.centre_x.size * drive.pin_x.size * 2, COLUMNS))
    contacts[:, GAP] = np.inf
    contacts[:, FOOT] = np.nan
    return contacts


@_inlined
def _poses(drive: Drive, theta: float, x: float, disc: int) -> tuple[float, float, float]:
    """Crank angle of a disc and the rotations of ring and gear, at disc 0's crank angle θ and deviation x."""
    phase = drive.crank_phase[disc]
    if drive.ring:
        return theta + phase, theta / (drive.teeth + 1) + x, -phase / drive.teeth
    return theta + phase, 0.0, x - (theta + phase) / drive.teeth


@compiled
def _tangency(px: float, py: float, alpha: float, R: float, e: float, teeth: int) -> _Tangency:
    """Tangency f(α) = (P - T)·T', its derivative, P, B = T'/(i e^{iα}) and P - T turned by -α, and e^{iα}."""
    return _tangency_at(px, py, _directions(alpha, teeth), R, e, teeth)


@_inlined
def _directions(alpha: float, teeth: int) -> _Directions:
    """Cosine and sine of α and of z_c α."""
    return math.cos(alpha), math.sin(alpha), math.cos(teeth * alpha), math.sin(teeth * alpha)


@_inlined
def _turned(at: _Directions, step: float, teeth: int) -> _Directions:
    """`_directions` a small step of α on, z_c |step| < 1e-3: cheaper than anew, and exact to the last bits."""
    ca, sa, c, s = at
    along, aside = 1.0 - 0.5 * step * step, step * (1.0 - step * step / 6.0)
    turn = teeth * step
    square = turn * turn
    ahead, across = 1.0 - square * (0.5 - square / 24.0), turn * (1.0 - square / 6.0)
    return ca * along - sa * aside, sa * along + ca * aside, c * ahead - s * across, s * ahead + c * across


@_inlined
def _tangency_at(px: float, py: float, at: _Directions, R: float, e: float, teeth: int) -> _Tangency:
    pins = teeth + 1
    ca, sa, c, s = at
    qx, qy = px * ca + py * sa, py * ca - px * sa
    bx, by = R - e * pins * c, -e * pins * s
    dx, dy = qx - (R - e * c), qy + e * s
    cx, cy = R - e * pins * pins * c, -e * pins * pins * s
    return dy * bx - dx * by, -(dx * cx + dy * cy) - (bx * bx + by * by), qx, qy, bx, by, dx, dy, ca, sa


@compiled
def _foot(
    px: float, py: float, start: float, lower: float, upper: float, R: float, e: float, teeth: int
) -> tuple[bool, float, _Tangency]:
    """Tangent point to P on the tooth between two roots, downhill from `start`: is there one, α and `_tangency`."""
    low, high = lower, upper
    low_known = high_known = False
    alpha = min(max(start, lower), upper)
    at = _directions(alpha, teeth)
    state = _tangency_at(px, py, at, R, e, teeth)
    for _ in range(80):
        f, slope, bx, by = state[0], state[1], state[4], state[5]
        if slope < 0.0:
            step = -f / slope
            if abs(step) * math.sqrt(bx * bx + by * by) < _FOOT_STEP:
                return True, alpha, state
        else:
            step = math.copysign(0.15 * (upper - lower), f)
        if f > 0.0:
            low, low_known = alpha, True
        else:
            high, high_known = alpha, True
        if low >= high:
            return False, alpha, state
        last = alpha
        alpha += step
        if alpha <= low:
            alpha = 0.5 * (low + high) if low_known else lower
        elif alpha >= high:
            alpha = 0.5 * (low + high) if high_known else upper
        at = _turned(at, alpha - last, teeth) if teeth * abs(alpha - last) < 1e-3 else _directions(alpha, teeth)
        state = _tangency_at(px, py, at, R, e, teeth)
    return True, alpha, state


@_inlined
def _on_tooth(px: float, py: float, turn: float) -> tuple[float, float]:
    """P in the frame of a tooth turned by a small angle."""
    c = 1.0 - 0.5 * turn * turn
    s = turn * (1.0 - turn * turn / 6.0)
    return px * c + py * s, py * c - px * s


@_inlined
def _write_contact(
    flank: _Flank,
    contacts: Array,
    row: int,
    foot: float,
    alpha: float,
    state: _Tangency,
    ox: float,
    oy: float,
    crank_x: float,
    crank_y: float,
    pin_radius: float,
    theta: float,
    x: float,
) -> None:
    """Write gap, moment arm and their rates where the pin is nearest the flank's point α.

    The foot is that of the pin on the nominal flank, as an offset from the conjugate point; α is the same place unless
    deviations move the contact along the flank. (ox, oy) is the gear's centre and (crank_x, crank_y) the crank's
    eccentricity, in the gear's frame.
    """
    circle_radius, eccentricity, radius, teeth, ring = flank
    _, slope, qx, qy, bx, by, dx, dy, ca, sa = state
    speed2 = bx * bx + by * by
    speed = math.sqrt(speed2)
    # The common normal runs from the flank's point, r inside T, to the pin's axis.
    wx, wy = dx + radius * bx / speed, dy + radius * by / speed
    distance = math.sqrt(wx * wx + wy * wy)
    nx, ny = wx / distance, wy / distance
    sign, turning = -1.0, 1.0 / teeth
    if ring:
        qx, qy = qx + ox * ca + oy * sa, qy + oy * ca - ox * sa
        sign, turning = 1.0, -1.0 / (teeth + 1)
    # With Q the lever of the rotation in the foot's frame, the gap falls by the arm for each radian.
    lever = qx * nx + qy * ny
    # 1 + κ s, because (P - T)·T'' = -κ s |T'|²
    stretch = -slope / speed2
    kappa = _path_curvature(circle_radius, eccentricity, teeth, bx, speed)
    contacts[row, FOOT] = foot
    contacts[row, PLACE] = alpha
    contacts[row, FOOT_RATE] = sign * lever / (speed * stretch)
    contacts[row, GAP] = distance - pin_radius
    arm = sign * (qy * nx - qx * ny)
    contacts[row, ARM] = arm
    # The gear's centre moves by i times the eccentricity, so the pin's axis by the opposite of it.
    vx, vy = crank_y * ca - crank_x * sa, -crank_x * ca - crank_y * sa
    contacts[row, ANGLE] = theta
    contacts[row, ANGLE_RATE] = vx * nx + vy * ny + turning * arm
    along = (vy * bx - vx * by) / (speed2 * stretch)
    contacts[row, FOOT_ANGLE_RATE] = along - turning * contacts[row, FOOT_RATE] - abs(turning)
    contacts[row, ARM_RATE] = lever - lever * lever * kappa / stretch
    inside = 1.0 / (1.0 - radius * kappa)
    contacts[row, CURVATURE] = kappa * inside
    contacts[row, CURVATURE_RATE] = (
        -circle_radius * teeth * by * ((teeth + 2) / speed - 3.0 * kappa) / speed2 * inside * inside
    )
    contacts[row, AT] = x


@_inlined
def _path_curvature(R: float, e: float, teeth: int, bx: float, speed: float) -> float:
    """Curvature of T, > 0 convex: R²(1 + z_p K² - K (z_p + 1) cos z_c α)/|T'|³, with cos from B."""
    pins = teeth + 1
    ez = e * pins
    return (R * R + ez * ez * pins - (pins + 1) * R * (R - bx)) / (speed * speed * speed)


@compiled
def place(drive: Drive, theta: float, x: float, contacts: Array, cold: bool, clear: float, bounded: float) -> None:
    """Solve the contact of every pin at crank angle θ and deviation x, into `contacts`.

    Parameters
    ----------
    cold
        Whether to start from the conjugate points instead of from what `contacts` holds of a neighbouring state.
    clear
        Rows whose gap, predicted from the last solution, is above this are left as they are (m; infinite: none is).
        From another crank angle what is predicted is a bound below the gap (docs/theory/contact.md).
    bounded
        With deviations, rows whose gap is certainly above this get a bound below it instead of the gap itself (m;
        infinite: none does).

    Notes
    -----
    Across many slices of nominal flanks the gap of a pin is smooth: five slices are solved, and where they show that
    the pin is clear everywhere the others are interpolated.
    """
    teeth = drive.teeth
    pins, slices = teeth + 1, drive.centre_x.size
    stride = 2 * pins
    # Arrays are taken out of the tuple once: each use of it inside a loop would count their references.
    pin_x, pin_y, pin_radius, tooth_turn = drive.pin_x, drive.pin_y, drive.pin_radius, drive.tooth_turn
    centre_x, centre_y, root_phase, stray = drive.centre_x, drive.centre_y, drive.root_phase, drive.stray
    R, e = drive.circle_radius, drive.generating_eccentricity
    flank = (R, e, drive.generating_radius, teeth, drive.ring)
    pitch = 2.0 * math.pi / teeth
    k = e * pins / R
    root_radius = R * (1.0 - k) ** 2 / max(pins * k - 1.0, 1e-9) - drive.root_margin
    root_margin = drive.root_margin / (R * (1.0 - k))
    rough = drive.gear_deviation.size > 0
    keeps = not cold and clear < math.inf
    for disc in range(drive.crank_phase.size):
        crank, ring, gear = _poses(drive, theta, x, disc)
        ct, st = math.cos(ring - gear), math.sin(ring - gear)
        cg, sg = math.cos(gear), math.sin(gear)
        ox, oy = drive.eccentricity * math.cos(crank), drive.eccentricity * math.sin(crank)
        crank_x, crank_y = ox * cg + oy * sg, oy * cg - ox * sg
        shift = (crank - ring) / teeth
        for pin in range(pins):
            first = disc * slices * stride + 2 * pin
            end = first + slices * stride
            conjugate = pin * 2.0 * math.pi / pins + shift
            if keeps:
                row = first
                while row < end and _stays_clear(flank, stray, root_phase, contacts, row, theta, x, conjugate, clear):
                    row += stride
                if row >= end:
                    continue
            tooth = math.floor(conjugate / pitch)
            along = conjugate / pitch - tooth
            near = 2.0 * math.pi * min(along, 1.0 - along) < root_phase
            few = slices < 8 or rough or (keeps and contacts[first, ANGLE] == theta)
            px = pin_x[pin] * ct - pin_y[pin] * st
            py = pin_x[pin] * st + pin_y[pin] * ct
            turn = tooth_turn[disc, int(tooth) % teeth]
            lower, upper = tooth * pitch, (tooth + 1.0) * pitch
            root, inwards = (lower, 1.0) if along < 0.5 else (upper, -1.0)
            for step in range(slices if few else slices + 5):
                slice_ = step if few else step * (slices - 1) // 4
                if not few and step >= 5:
                    if step == 5 and _interpolated(contacts, first, stride, slices, theta, x):
                        break
                    slice_ = step - 5
                row = first + slice_ * stride
                if (
                    (keeps and slices > 1 and (few or step >= 5))
                    and _stays_clear(flank, stray, root_phase, contacts, row, theta, x, conjugate, clear)
                ):  # fmt: skip
                    continue
                ux, uy = ox + centre_x[slice_], oy + centre_y[slice_]
                cx, cy = ux * cg + uy * sg, uy * cg - ux * sg
                wx, wy = px - cx, py - cy
                qx, qy = _on_tooth(wx, wy, turn)
                start = conjugate + contacts[row, FOOT] + contacts[row, FOOT_RATE] * (x - contacts[row, AT])
                start += contacts[row, FOOT_ANGLE_RATE] * (theta - contacts[row, ANGLE])
                if cold or not lower <= start <= upper:
                    # Near a root the way downhill from the conjugate point may miss the contact farther in.
                    start = root + inwards * root_phase / teeth if near else conjugate
                found, alpha, state = _foot(qx, qy, start, lower, upper, R, e, teeth)
                distance = math.inf
                contacts[row, AT] = x
                contacts[row, ANGLE] = theta
                if found:
                    _, _, _, _, bx, by, dx, dy, _, _ = state
                    distance = (dx * bx + dy * by) / math.sqrt(bx * bx + by * by)
                    _write_contact(
                        flank, contacts, row, alpha - conjugate, alpha, state, cx, cy, crank_x, crank_y,
                        pin_radius[pin], theta, x,
                    )  # fmt: skip
                else:
                    contacts[row, GAP] = math.inf
                    contacts[row, FOOT] = math.nan
                row += 1
                contacts[row, AT] = x
                contacts[row, ANGLE] = theta
                contacts[row, GAP] = math.inf
                # Within the root's curvature radius a point has one foot only, so none on the other tooth, unless the
                # foot is so close to the root that the step between the two teeth decides.
                if not near or (distance < root_radius and abs(alpha - root) > root_margin):
                    contacts[row, FOOT] = math.nan
                    continue
                beyond = tooth - inwards
                left, right = beyond * pitch, (beyond + 1.0) * pitch
                start = conjugate + contacts[row, FOOT]
                if cold or not left < start < right:
                    start = root - inwards * root_phase / teeth
                qx, qy = _on_tooth(wx, wy, tooth_turn[disc, int(beyond) % teeth])
                found, alpha, state = _foot(qx, qy, start, left, right, R, e, teeth)
                if found and left < alpha < right:
                    _write_contact(
                        flank, contacts, row, alpha - conjugate, alpha, state, cx, cy, crank_x, crank_y,
                        pin_radius[pin], theta, x,
                    )  # fmt: skip
                else:
                    contacts[row, FOOT] = math.nan
    if drive.gear_deviation.size > 0:
        _raise(drive, theta, x, contacts, bounded)


@_inlined
def _stays_clear(
    flank: _Flank,
    stray: float,
    root_phase: float,
    contacts: Array,
    row: int,
    theta: float,
    x: float,
    conjugate: float,
    clear: float,
) -> bool:
    """Whether a pin that was solved elsewhere is certainly farther than `clear` from both teeth.

    At the same crank angle its gap is foretold by its rates. From another one what errors and rotation can bend it by
    is taken off, and nothing is said of a pin that stands near a root, or did.
    """
    dx, since = x - contacts[row, AT], theta - contacts[row, ANGLE]
    bow = 0.5 * dx * dx * contacts[row, ARM_RATE]
    ahead = contacts[row, GAP] - dx * contacts[row, ARM] - bow
    if not clear < ahead < math.inf or abs(dx) > _FORETOLD or abs(bow) > 0.5 * clear:
        return False
    if since == 0.0:
        bow = 0.5 * dx * dx * contacts[row + 1, ARM_RATE]
        ahead = contacts[row + 1, GAP] - dx * contacts[row + 1, ARM] - bow
        return contacts[row + 1, GAP] == math.inf or (ahead > clear and abs(bow) <= 0.5 * clear)
    if contacts[row + 1, GAP] < math.inf or not contacts[row, GAP] > 0.0:
        return False
    circle_radius, eccentricity, _, teeth, _ = flank
    turns = teeth * conjugate / (2.0 * math.pi)
    phase = 2.0 * math.pi * abs(turns - math.floor(turns + 0.5))
    passed = abs(since) + abs(dx)
    if phase < root_phase or phase < passed:
        return False
    phase -= passed
    k = eccentricity * (teeth + 1) / circle_radius
    # 1 + k² - 2k cos φ from below, and with it how fast the normal turns at most, seen from what displaces the pin.
    least = (1.0 - k) ** 2 + 4.0 * k * (phase / math.pi) ** 2
    turning = 0.5 + 1.0 / teeth + 0.5 * (1.0 - k * k) / least
    reach = stray + abs(x) * circle_radius
    bend = reach * (turning * turning + k * (1.0 - k * k) / (least * least))
    ahead += since * contacts[row, ANGLE_RATE] - since * since * bend
    return ahead - abs(since * dx) * circle_radius * turning > clear


@compiled
def _interpolated(contacts: Array, first: int, stride: int, slices: int, theta: float, x: float) -> bool:
    """Fill a pin's rows from five solved ones, by the parabola through three; False where the pin needs all solved."""
    last = slices - 1
    middle = 2 * last // 4
    for fifth in range(5):
        row = first + (fifth * last // 4) * stride
        if not contacts[row, GAP] > _CLEAR or contacts[row, GAP] == math.inf or contacts[row + 1, GAP] < math.inf:
            return False
    a, b, c = first, first + middle * stride, first + last * stride
    for fifth in (1, 3):
        slice_ = fifth * last // 4
        wa, wb, wc = _parabola(slice_, middle, last)
        row = first + slice_ * stride
        guess = wa * contacts[a, GAP] + wb * contacts[b, GAP] + wc * contacts[c, GAP]
        if abs(guess - contacts[row, GAP]) > _INTERPOLATED:
            return False
    smallest = math.inf
    for slice_ in range(slices):
        if slice_ * 4 % last == 0:
            continue
        wa, wb, wc = _parabola(slice_, middle, last)
        row = first + slice_ * stride
        for column in (FOOT, FOOT_RATE, GAP, ARM, ARM_RATE, CURVATURE, CURVATURE_RATE, ANGLE_RATE, FOOT_ANGLE_RATE):
            contacts[row, column] = wa * contacts[a, column] + wb * contacts[b, column] + wc * contacts[c, column]
        contacts[row : row + 2, AT] = x
        contacts[row : row + 2, ANGLE] = theta
        contacts[row + 1, GAP] = math.inf
        contacts[row + 1, FOOT] = math.nan
        smallest = min(smallest, contacts[row, GAP])
    return smallest > _CLEAR


@_inlined
def _parabola(slice_: int, middle: int, last: int) -> tuple[float, float, float]:
    """Weights of the first, middle and last slice in the parabola through them."""
    return (
        (slice_ - middle) * (slice_ - last) / (middle * last),
        slice_ * (slice_ - last) / (middle * (middle - last)),
        slice_ * (slice_ - middle) / (last * (last - middle)),
    )


@compiled
def _raise(drive: Drive, theta: float, x: float, contacts: Array, bounded: float) -> None:
    """Move the contacts just solved on nominal surfaces to where the surfaces with deviations come closest.

    The pieces between neighbouring elements, on which deviations are linear, are searched outwards from the nominal
    foot until the nominal surfaces stand farther apart than any deviation can make up for.
    """
    teeth = drive.teeth
    pins, slices = teeth + 1, drive.centre_x.size
    pitch = 2.0 * math.pi / teeth
    for row in range(contacts.shape[0]):
        if contacts[row, AT] != x or contacts[row, ANGLE] != theta or not contacts[row, GAP] < math.inf:
            continue
        if contacts[row, GAP] - drive.largest_deviation > bounded:
            contacts[row, GAP] -= drive.largest_deviation
            continue
        disc, slice_, pin = row // (2 * pins * slices), row // (2 * pins) % slices, row // 2 % pins
        crank, ring, gear = _poses(drive, theta, x, disc)
        conjugate = pin * 2.0 * math.pi / pins + (crank - ring) / teeth
        alpha = conjugate + contacts[row, FOOT]
        tooth = math.floor(alpha / pitch)
        if row % 2 == 0:
            # The conjugate tooth's own end belongs to it.
            tooth = math.floor(conjugate / pitch)
        number = int(tooth) % teeth
        base = tooth * pitch
        # The pin's axis, and the direction from it to the pin circle's centre, on tooth 0.
        ux = drive.eccentricity * math.cos(crank) + drive.centre_x[slice_]
        uy = drive.eccentricity * math.sin(crank) + drive.centre_y[slice_]
        cg, sg = math.cos(gear), math.sin(gear)
        ox, oy = ux * cg + uy * sg, uy * cg - ux * sg
        turned = ring - gear
        ct, st = math.cos(turned), math.sin(turned)
        px = drive.pin_x[pin] * ct - drive.pin_y[pin] * st - ox
        py = drive.pin_x[pin] * st + drive.pin_y[pin] * ct - oy
        px, py = _on_tooth(px, py, drive.tooth_turn[disc, number])
        cb, sb = math.cos(base), math.sin(base)
        gx, gy = px * cb + py * sb, py * cb - px * sb
        facing = pin * 2.0 * math.pi / pins + turned - drive.tooth_turn[disc, number] - base
        fx, fy = -math.cos(facing), -math.sin(facing)
        pin_radius = drive.pin_radius[pin]
        points = drive.flank_alpha.size
        middle = np.searchsorted(drive.flank_alpha, alpha - base)
        middle = min(max(middle, 1), points - 2)
        arc = math.hypot(
            drive.flank_x[middle + 1] - drive.flank_x[middle], drive.flank_y[middle + 1] - drive.flank_y[middle]
        )
        # Twice what a piece's middle may come closer than its ends.
        sag = 0.25 * arc * arc * abs(1.0 / pin_radius + contacts[row, CURVATURE])
        best = (math.inf, 0.0, 0.0, 0.0)
        for direction in (-1, 1):
            point = middle
            nominal, raised, seen = _raised(drive, disc, slice_, number, pin, point, gx, gy, fx, fy)
            while 0 <= point + direction < points:
                if point != middle and nominal - drive.largest_deviation > best[0]:
                    break
                last_raised, last_seen = raised, seen
                point += direction
                nominal, raised, seen = _raised(drive, disc, slice_, number, pin, point, gx, gy, fx, fy)
                if min(raised, last_raised) - sag < best[0]:
                    seen_ends = (last_seen, seen) if direction > 0 else (seen, last_seen)
                    piece = min(point, point - direction)
                    closest = _closest_on_piece(drive, disc, slice_, number, pin, piece, seen_ends, gx, gy, fx, fy)
                    if closest[0] < best[0]:
                        best = closest
        _, at, gear_height, pin_height = best
        place_ = base + at
        state = _tangency(px, py, place_, drive.circle_radius, drive.generating_eccentricity, teeth)
        _write_contact(
            (
                drive.circle_radius, drive.generating_eccentricity, drive.generating_radius - gear_height, teeth,
                drive.ring,
            ),
            contacts, row, contacts[row, FOOT], place_, state, ox, oy, 0.0, 0.0, pin_radius + pin_height, theta, x,
        )  # fmt: skip
        # What a raised flank foretells reaches no farther than its next element.
        contacts[row, ANGLE_RATE] = math.nan
        if drive.gear_curvature.size > 0:
            seen = _facing_place(drive, at, state, gear_height, fx, fy)
            added = _added_curvature(drive, disc, slice_, number, pin, at, seen)
            hertz_curvature = 1.0 / pin_radius + contacts[row, CURVATURE]
            contacts[row, CURVATURE] += max(added, (_CONFORMAL - 1.0) * hertz_curvature)


@_inlined
def _facing_place(drive: Drive, alpha: float, state: _Tangency, height: float, fx: float, fy: float) -> float:
    """Place on the pin that faces a raised point of the flank, at tooth 0's α; f as in `_raised`."""
    _, _, _, _, bx, by, dx, dy, _, _ = state
    speed = math.sqrt(bx * bx + by * by)
    radius = drive.generating_radius - height
    # From the pin's axis to the flank, in the foot's frame and on tooth 0.
    wx, wy = -dx - radius * bx / speed, -dy - radius * by / speed
    ca, sa = math.cos(alpha), math.sin(alpha)
    vx, vy = wx * ca - wy * sa, wx * sa + wy * ca
    return _pin_place(drive, fx * vy - fy * vx, fx * vx + fy * vy)


@_inlined
def _added_curvature(drive: Drive, disc: int, slice_: int, tooth: int, pin: int, alpha: float, seen: float) -> float:
    """Curvature that the deviations of flank and pin add where they touch, at tooth 0's α and a place on the pin."""
    points = drive.flank_alpha
    after = min(max(int(np.searchsorted(points, alpha)), 1), points.size - 1)
    share = (alpha - points[after - 1]) / (points[after] - points[after - 1])
    flank = (1.0 - share) * drive.gear_curvature[disc, slice_, tooth, after - 1]
    flank += share * drive.gear_curvature[disc, slice_, tooth, after]
    return flank + _on_pin(drive.pin_curvature, slice_, pin, seen)


@_inlined
def _raised(
    drive: Drive, disc: int, slice_: int, tooth: int, pin: int, point: int, gx: float, gy: float, fx: float, fy: float
) -> tuple[float, float, float]:
    """Gap at one of the flank's points, nominal and with the deviations, and the place on the pin that faces it.

    (gx, gy) is the pin's axis on tooth 0, (fx, fy) the direction from it to the pin circle's centre.
    """
    vx, vy = drive.flank_x[point] - gx, drive.flank_y[point] - gy
    nominal = math.sqrt(vx * vx + vy * vy) - drive.pin_radius[pin]
    height = drive.gear_deviation[disc, slice_, tooth, point]
    vx, vy = vx + height * drive.flank_normal_x[point], vy + height * drive.flank_normal_y[point]
    seen = _pin_place(drive, fx * vy - fy * vx, fx * vx + fy * vy)
    raised = math.sqrt(vx * vx + vy * vy) - drive.pin_radius[pin] - _on_pin(drive.pin_deviation, slice_, pin, seen)
    return nominal, raised, seen


@compiled
def _closest_on_piece(
    drive: Drive,
    disc: int,
    slice_: int,
    tooth: int,
    pin: int,
    piece: int,
    seen: tuple[float, float],
    gx: float,
    gy: float,
    fx: float,
    fy: float,
) -> tuple[float, float, float, float]:
    """Smallest gap between two neighbouring points of the flank, its α, and the deviations of gear and pin there.

    `seen` are the places on the pin that face the two points; between them the pin's deviation bends at the middle of
    each of its elements, so the piece is divided there; the place is nearly, not quite, linear in α.
    """
    R, e, teeth = drive.circle_radius, drive.generating_eccentricity, drive.teeth
    a, b = drive.flank_alpha[piece], drive.flank_alpha[piece + 1]
    start, end = drive.gear_deviation[disc, slice_, tooth, piece], drive.gear_deviation[disc, slice_, tooth, piece + 1]
    rise = (end - start) / (b - a)
    best = (math.inf, a, start, 0.0)
    high, right = a, seen[0]
    while high < b:
        low, left = high, right
        right = math.floor(left) + 1.0 if seen[1] > left else math.ceil(left) - 1.0
        if (right - seen[1]) * (seen[1] - seen[0]) >= 0.0:
            high, right = b, seen[1]
        else:
            each = (b - a) / (seen[1] - seen[0])
            high = a + (right - seen[0]) * each
            state = _tangency(gx, gy, high, R, e, teeth)
            high += (right - _facing_place(drive, high, state, start + rise * (high - a), fx, fy)) * each
            high = min(max(high, low), b)
        pin_start, pin_end = (
            _on_pin(drive.pin_deviation, slice_, pin, left),
            _on_pin(drive.pin_deviation, slice_, pin, right),
        )
        pin_rise = (pin_end - pin_start) / max(high - low, 1e-3 * (b - a))
        at = 0.5 * (low + high)
        for _ in range(8):
            state, height = _tangency(gx, gy, at, R, e, teeth), start + rise * (at - a)
            pin_height = _on_pin(drive.pin_deviation, slice_, pin, _facing_place(drive, at, state, height, fx, fy))
            distance, fall, bend = _flank_distance(drive, state, height, rise)
            gap = distance - drive.pin_radius[pin] - pin_height
            if gap < best[0]:
                best = (gap, at, height, pin_height)
            step = -(fall - pin_rise) / bend if bend > 0.0 else math.copysign(b - a, pin_rise - fall)
            following = min(max(at + step, low), high)
            if abs(following - at) < 1e-9 * (b - a):
                break
            at = following
    return best


@_inlined
def _flank_distance(drive: Drive, state: _Tangency, height: float, rise: float) -> tuple[float, float, float]:
    """Distance of a pin's axis from a raised point of the flank, and its first and second derivative by α.

    The point lies `height` out along the nominal normal; `rise` is the height's derivative by α. The second derivative
    is that near the foot.
    """
    f, slope, _, _, bx, by, dx, dy, _, _ = state
    speed = math.sqrt(bx * bx + by * by)
    radius = drive.generating_radius - height
    wx, wy = dx + radius * bx / speed, dy + radius * by / speed
    distance = math.sqrt(wx * wx + wy * wy)
    kappa = _path_curvature(drive.circle_radius, drive.generating_eccentricity, drive.teeth, bx, speed)
    shrink = (1.0 - radius * kappa) / distance
    return distance, -f * shrink - rise * (wx * bx + wy * by) / (speed * distance), -slope * shrink


@_inlined
def _pin_place(drive: Drive, across: float, ahead: float) -> float:
    """Place on the pins' surface of a direction, in elements from the first one's middle.

    The direction is given by its parts across and along that to the pin circle's centre.
    """
    return (math.atan2(across, ahead) / math.pi + 0.5) * drive.pin_deviation.shape[2] - 0.5


@_inlined
def _on_pin(values: Array, slice_: int, pin: int, place_: float) -> float:
    """Value between the middles of a pin's elements, at a place of `_pin_place`."""
    low = min(max(math.floor(place_), 0), values.shape[2] - 2)
    share = min(max(place_ - low, 0.0), 1.0)
    return (1.0 - share) * values[slice_, pin, low] + share * values[slice_, pin, low + 1]


@_inlined
def half_width(
    force: float, curvature: float, pin_radius: float, width: float, compliance_gear: float, compliance_pin: float
) -> float:
    """Half width of Hertz's line contact, a = sqrt(4 F ρ* (V_c + V_p)/(πb)), m; units as in `hertz`."""
    equivalent = 1.0 / max(abs(1.0 / pin_radius + curvature), 1e-9)
    return math.sqrt(4.0 * force * equivalent * (compliance_gear + compliance_pin) / (math.pi * width))


@compiled
def hertz(
    approach: float,
    curvature: float,
    pin_radius: float,
    width: float,
    compliance_gear: float,
    compliance_pin: float,
    largest_log_radius: float,
    guess: float = 0.0,
) -> tuple[float, float, float]:
    """Force and stiffness of Hertz's line contact at a given approach.

    δ = (2F/πb)[V_c(ln(4|ρ_c|/a) - ½) + V_p(ln(4 R_rp/a) - ½)], a = sqrt(4 F ρ* (V_c + V_p)/(πb)) and
    ρ* = 1/|1/R_rp + 1/ρ_c|, solved for F (loaded-contact-wear and error-surface papers; docs/theory/contact.md).

    Parameters
    ----------
    approach
        δ > 0, m.
    curvature
        1/ρ_c of the flank, > 0 convex, 1/m.
    pin_radius, width
        m.
    compliance_gear, compliance_pin
        (1 - ν²)/E, 1/Pa.
    largest_log_radius
        |ρ_c| in the logarithm is at most this, m.
    guess
        A force to start from, N; 0 where there is none.

    Returns
    -------
    force, stiffness, by_curvature
        N, N/m, and the force's derivative by the flank's curvature, N·m.
    """
    both = compliance_gear + compliance_pin
    equivalent = 1.0 / max(abs(1.0 / pin_radius + curvature), 1e-9)
    log_radius = min(1.0 / max(abs(curvature), 1e-12), largest_log_radius)
    # With κ = (V_c + V_p)/(πb) the law reads δ = κ F (H - ln F).
    kappa = both / (math.pi * width)
    share = compliance_gear / both
    h = (
        2.0 * (share * math.log(4.0 * log_radius) + (1.0 - share) * math.log(4.0 * pin_radius))
        - 1.0
        - math.log(4.0 * equivalent * kappa)
    )
    target = approach / kappa
    force = target / max(h - math.log(target) + 2.0, 2.0) if guess <= 0.0 else guess
    q = change = start = 0.0
    for _ in range(30):
        q = max(h - math.log(force), 1.5)
        following = (target - force) / (q - 1.0)
        if following <= 0.0:
            following = 0.5 * force
        start, force = force, following
        change = abs(force - start)
        # The next step would be a thirtieth of the square of this one, or less.
        if change <= 1e-6 * force:
            break
    # ln F of the last step, whose square is nothing.
    q -= (force - start) / force
    # Beyond H - ln F = 2 (half width near the radii) the law bends over; it is continued along its tangent there.
    limit = math.exp(h - 2.0) if q < 3.0 or change > 1e-5 * force else math.inf
    if target >= 2.0 * limit:
        force = target - limit
        return force, 1.0 / kappa, 0.0
    bending = 1.0 / (1.0 / pin_radius + curvature)
    if log_radius < largest_log_radius:
        bending -= 2.0 * share / curvature
    return force, 1.0 / (kappa * (q - 1.0)), -force * bending / (q - 1.0)


@_inlined
def _rotational_stiffness(contacts: Array, row: int) -> float:
    """Change of one contact's torque F L for each radian: of its approach, its arm and its flank's curvature."""
    arm = contacts[row, ARM]
    curved = contacts[row, FORCE_BY_CURVATURE] * contacts[row, CURVATURE_RATE] * contacts[row, FOOT_RATE]
    return contacts[row, STIFFNESS] * arm * arm + contacts[row, FORCE] * contacts[row, ARM_RATE] + curved * arm


@compiled
def _load(drive: Drive, theta: float, x: float, contacts: Array) -> tuple[float, float]:
    """Forces of all rows at deviation x; returns the torque that balances them and its derivative by x."""
    torque = stiffness = 0.0
    pins = drive.teeth + 1
    for row in range(contacts.shape[0]):
        gap, last = contacts[row, GAP], contacts[row, FORCE]
        contacts[row, FORCE] = 0.0
        contacts[row, STIFFNESS] = 0.0
        if gap >= 0.0 or contacts[row, AT] != x or contacts[row, ANGLE] != theta:
            continue
        force, k, by_curvature = hertz(
            -gap, contacts[row, CURVATURE], drive.pin_radius[row // 2 % pins], drive.slice_width,
            drive.compliance_gear, drive.compliance_pin, drive.largest_log_radius, last,
        )  # fmt: skip
        arm = contacts[row, ARM]
        contacts[row, FORCE] = force
        contacts[row, STIFFNESS] = k
        contacts[row, FORCE_BY_CURVATURE] = by_curvature
        torque += force * arm
        stiffness += _rotational_stiffness(contacts, row)
    return torque, stiffness


@compiled
def _to_touch(contacts: Array, theta: float, x: float, direction: float) -> float:
    """Rotation from x, in `direction` (±1), at which the first flank touches, to second order.

    Rows solved elsewhere than at x count with what they foretell of it.
    """
    best = math.inf
    for row in range(contacts.shape[0]):
        gap, arm, rate = contacts[row, GAP], contacts[row, ARM], contacts[row, ARM_RATE]
        if not gap < math.inf:
            continue
        since = x - contacts[row, AT]
        gap -= since * (arm + 0.5 * since * rate)
        if contacts[row, ANGLE] != theta:
            gap += (theta - contacts[row, ANGLE]) * contacts[row, ANGLE_RATE]
        arm = direction * (arm + since * rate)
        if arm <= 0.0 and not (gap > 1e-9 and rate > 0.0):
            continue
        inside = arm * arm + 2.0 * rate * gap
        if inside < 0.0:
            if gap > 0.0:
                continue
            inside = 0.0
        best = min(best, 2.0 * gap / (arm + math.sqrt(inside)))
    return best


@compiled
def equilibrium(
    drive: Drive, theta: float, torque: float, x: float, contacts: Array, cold: bool
) -> tuple[float, float]:
    """Deviation at which the contacts balance a torque (other than zero, where there is play).

    Parameters
    ----------
    drive
        The contact problem.
    theta
        Crank angle, rad.
    torque
        Torque of the environment on the output, N·m.
    x
        Starting deviation, rad.
    contacts
        Contact rows, overwritten with the solution.
    cold
        Whether `contacts` holds nothing of a neighbouring state.

    Returns
    -------
    x, stiffness
        Deviation (rad) and its torsional stiffness (N·m/rad).
    """
    return _balance(drive, theta, torque, 1.0, 0.0, 0.0, x, contacts, cold)


@compiled
def behind_compliance(
    drive: Drive, theta: float, flange: float, compliance: float, x: float, contacts: Array, cold: bool
) -> tuple[float, float]:
    """Deviation ξ of the contacts when the flange stands at ξ + c M(ξ); returns ξ and the contacts' stiffness."""
    return _balance(drive, theta, 0.0, compliance, flange, 1.0, x, contacts, cold)


@compiled
def _balance(
    drive: Drive,
    theta: float,
    torque: float,
    load: float,
    flange: float,
    hold: float,
    x: float,
    contacts: Array,
    cold: bool,
) -> tuple[float, float]:
    """Solve load (torque - M(x)) + hold (flange - x) = 0 by Newton's method inside a bracket."""
    low, high = -math.inf, math.inf
    stiffness = 0.0
    for _ in range(100):
        place(drive, theta, x, contacts, cold, _CLEAR, _BOUNDED)
        # Not a literal False in a second call, for which everything would be compiled again; so everywhere here.
        cold = False
        balance, stiffness = _load(drive, theta, x, contacts)
        short = load * (torque - balance) + hold * (flange - x)
        slope = load * stiffness + hold
        if short > 0.0:
            low = x
        else:
            high = x
        if slope > 0.0:
            step = short / slope
        else:
            direction = math.copysign(1.0, short)
            step = direction * (max(_to_touch(contacts, theta, x, direction), 0.0) + 1e-6)
        step = min(max(step, -1e-3), 1e-3)
        if abs(step) < _LINEAR_STEP:
            x += step
            for row in range(contacts.shape[0]):
                if contacts[row, FORCE] > 0.0:
                    contacts[row, FORCE] += contacts[row, STIFFNESS] * contacts[row, ARM] * step
                    contacts[row, GAP] -= contacts[row, ARM] * step
            break
        if not low < x + step < high:
            step = 0.5 * (low + high) - x
        x += step
    return x, stiffness


@compiled
def _smallest_gap(contacts: Array, step: float) -> tuple[float, int]:
    """Smallest gap after a small rotation, to first order, and its row."""
    best, active = math.inf, 0
    for row in range(contacts.shape[0]):
        gap = contacts[row, GAP] - contacts[row, ARM] * step
        if gap < best:
            best, active = gap, row
    return best, active


@compiled
def play(drive: Drive, theta: float, x: float, contacts: Array, cold: bool) -> tuple[float, float, float]:
    """Ends of the free rotation with the crank locked, and by how much there is none.

    From any free rotation each end is where the first flank touches. Where x is not free, the search begins from the
    rotation with the largest smallest gap (gaps are linearised and solved again until that changes no more).

    Parameters
    ----------
    drive, theta, contacts, cold
        As in `equilibrium`.
    x
        Starting deviation, rad.

    Returns
    -------
    low, high, interference
        Deviations (rad) between which the output is free, and the interference (m, ≥ 0). Below `TOUCHING` of
        interference both ends are the same; where there is no free position they are NaN.
    """
    lowest, highest = -math.inf, math.inf
    gap = 0.0
    for _ in range(100):
        place(drive, theta, x, contacts, cold, math.inf, math.inf)
        cold = False
        gap, active = _smallest_gap(contacts, 0.0)
        if gap > TOUCHING:
            break
        if contacts[active, ARM] > 0.0:
            highest = x
        else:
            lowest = x
        # The linearised gaps' largest minimum lies where a falling and a rising gap cross.
        step, falling, rising = 0.0, -1, -1
        for _ in range(200):
            _, active = _smallest_gap(contacts, step)
            if active in (falling, rising):
                break
            if contacts[active, ARM] > 0.0:
                falling = active
            else:
                rising = active
            if falling < 0:
                step += 1e-4
            elif rising < 0:
                step -= 1e-4
            else:
                step = (contacts[falling, GAP] - contacts[rising, GAP]) / (
                    contacts[falling, ARM] - contacts[rising, ARM]
                )
        better, _ = _smallest_gap(contacts, step)
        if better - gap < 1e-15:
            break
        if abs(step) > 1e-3:
            step = math.copysign(1e-3, step)
        if not lowest < x + step < highest:
            step = 0.5 * (lowest + highest) - x
        x += step
    if gap < -TOUCHING:
        return math.nan, math.nan, -gap
    if gap <= 0.0:
        return x, x, 0.0
    low = _first_touch(drive, theta, x, contacts, cold, -1.0)
    return low, _first_touch(drive, theta, x, contacts, cold, 1.0), 0.0


@compiled
def _first_touch(drive: Drive, theta: float, x: float, contacts: Array, cold: bool, direction: float) -> float:
    # What a flank with deviations foretells reaches no farther than its next element.
    clear = _CLEAR if drive.gear_deviation.size == 0 else math.inf
    for _ in range(50):
        step = min(_to_touch(contacts, theta, x, direction), 1e-3)
        x += direction * step
        if abs(step) < _ROTATION_STEP:
            break
        place(drive, theta, x, contacts, cold, clear, math.inf)
    return x


@compiled
def load_sharing(drive: Drive, contacts: Array, pin_force: Array, pin_pressure: Array) -> tuple[int, float]:
    """Force and largest pressure of each pin, from solved contact rows.

    Parameters
    ----------
    drive, contacts
        The contact problem and its solution.
    pin_force, pin_pressure
        Overwritten, shape (discs, pins): force summed over slices (N), largest p = 2F/(πab) (Pa).

    Returns
    -------
    contact_count, max_contact_pressure
        Pins that carry more than 1 % of the most loaded pin's force; Pa.
    """
    pins, slices = drive.teeth + 1, drive.centre_x.size
    compliance_gear, compliance_pin = drive.compliance_gear, drive.compliance_pin
    pin_force[:] = 0.0
    pin_pressure[:] = 0.0
    for row in range(contacts.shape[0]):
        force = contacts[row, FORCE]
        if force <= 0.0:
            continue
        disc, pin = row // (2 * pins * slices), row // 2 % pins
        half = half_width(
            force, contacts[row, CURVATURE], drive.pin_radius[pin], drive.slice_width, compliance_gear, compliance_pin
        )
        pressure = 2.0 * force / (math.pi * half * drive.slice_width)
        pin_force[disc, pin] += force
        pin_pressure[disc, pin] = max(pin_pressure[disc, pin], pressure)
    threshold = _COUNTED * pin_force.max()
    count = 0
    for force in pin_force.flat:
        if force > threshold:
            count += 1
    return count, pin_pressure.max()


class _Local(NamedTuple):
    """One contact seen from the housing: what turns a displacement of the pin's axis into changes of gap and arm."""

    normal_x: float
    normal_y: float
    lever_x: float  # the pin's axis seen from the centre that the output turns about
    lever_y: float
    gear_x: float  # the pin's axis seen from the gear's centre
    gear_y: float
    slide: float  # tangential speed of the axis over the flank for each radian of the output
    bend: float  # curvature of the gap along the tangent
    speed: float  # |T'| at the foot
    foot: float  # rotation of the foot for each metre of slide
    facing: float  # cosine and sine of the normal's angle from the foot's radius
    leaning: float
    turning: float  # rotation of the normal against the foot's radius for each metre of slide


@compiled
def _local(drive: Drive, theta: float, x: float, contacts: Array, row: int) -> _Local:
    pins, slices = drive.teeth + 1, drive.centre_x.size
    disc, slice_, pin = row // (2 * pins * slices), row // (2 * pins) % slices, row // 2 % pins
    crank, ring, gear = _poses(drive, theta, x, disc)
    alpha = pin * 2.0 * math.pi / pins + (crank - ring) / drive.teeth + contacts[row, FOOT]
    tooth = math.floor(alpha * drive.teeth / (2.0 * math.pi)) % drive.teeth
    c, s = math.cos(drive.teeth * alpha), math.sin(drive.teeth * alpha)
    ez = drive.generating_eccentricity * pins
    bx, by = drive.circle_radius - ez * c, -ez * s
    speed = math.sqrt(bx * bx + by * by)
    facing, leaning = bx / speed, by / speed
    angle = alpha + gear + drive.tooth_turn[disc, tooth]
    ca, sa = math.cos(angle), math.sin(angle)
    nx, ny = ca * facing - sa * leaning, sa * facing + ca * leaning
    cr, sr = math.cos(ring), math.sin(ring)
    lx = drive.pin_x[pin] * cr - drive.pin_y[pin] * sr
    ly = drive.pin_x[pin] * sr + drive.pin_y[pin] * cr
    gx = lx - drive.eccentricity * math.cos(crank) - drive.centre_x[slice_]
    gy = ly - drive.eccentricity * math.sin(crank) - drive.centre_y[slice_]
    sign = 1.0
    if not drive.ring:
        lx, ly, sign = gx, gy, -1.0
    kappa = _path_curvature(drive.circle_radius, drive.generating_eccentricity, drive.teeth, bx, speed)
    stretch = 1.0 + kappa * (contacts[row, GAP] + drive.pin_radius[pin] - drive.generating_radius)
    slide = sign * (lx * nx + ly * ny)
    return _Local(
        nx, ny, lx, ly, gx, gy, slide, kappa / stretch, speed, 1.0 / (speed * stretch), facing, leaning,
        (kappa - 1.0 / speed) / stretch,
    )  # fmt: skip


@_inlined
def _displaced(contacts: Array, row: int, local: _Local, vx: float, vy: float, wx: float, wy: float) -> float:
    """Change of the contact's torque when its pin's axis moves by v relative to the gear.

    w is v's own change with the output's rotation. The torque is F L, so its change is dF L + F dL, with
    dL = -(n·w + (t·P_x)(t·v) κ/(1 + κ s)).
    """
    normal = vx * local.normal_x + vy * local.normal_y
    tangent = vy * local.normal_x - vx * local.normal_y
    turned = wx * local.normal_x + wy * local.normal_y
    mixed = turned + local.slide * tangent * local.bend
    curved = contacts[row, FORCE_BY_CURVATURE] * contacts[row, CURVATURE_RATE] * tangent * local.foot
    return (curved - contacts[row, STIFFNESS] * normal) * contacts[row, ARM] - contacts[row, FORCE] * mixed


@compiled
def touch_rate(drive: Drive, theta: float, x: float, contacts: Array, direction: float) -> float:
    """How fast the crank moves an unloaded output that it pushes, dφ_b/dθ (1), NaN without a flank in `direction`.

    The flank with the smallest gap among those that stop a rotation in `direction` (±1) stays in contact.
    """
    pins, slices = drive.teeth + 1, drive.centre_x.size
    best, touching = math.inf, -1
    for row in range(contacts.shape[0]):
        if contacts[row, ARM] * direction > 0.0 and contacts[row, GAP] < best:
            best, touching = contacts[row, GAP], row
    if touching < 0:
        return math.nan
    local = _local(drive, theta, x, contacts, touching)
    crank = theta + drive.crank_phase[touching // (2 * pins * slices)]
    rate = drive.eccentricity * (math.sin(crank) * local.normal_x - math.cos(crank) * local.normal_y)
    return rate / contacts[touching, ARM]


@compiled
def crank_side(drive: Drive, theta: float, x: float, contacts: Array) -> tuple[float, float]:
    """What the crank feels: its torque, and how its rotation moves the output at constant torque.

    With the elastic energy U(θ, φ_b) the environment's torque is ∂U/∂φ_b and the crank's is ∂U/∂θ at fixed φ_b.

    Returns
    -------
    crank_torque, output_rate
        ∂U/∂θ (N·m) and dφ_b/dθ at constant torque (1; NaN without contact).
    """
    pins, slices = drive.teeth + 1, drive.centre_x.size
    crank_torque = coupling = stiffness = 0.0
    for row in range(contacts.shape[0]):
        force = contacts[row, FORCE]
        if force <= 0.0:
            continue
        local = _local(drive, theta, x, contacts, row)
        crank = theta + drive.crank_phase[row // (2 * pins * slices)]
        # The gear's centre moves by e i e^{iθ}, so the pin's axis by the opposite of it.
        vx, vy = drive.eccentricity * math.sin(crank), -drive.eccentricity * math.cos(crank)
        wx, wy = (0.0, 0.0) if drive.ring else (vy, -vx)
        crank_torque -= force * (vx * local.normal_x + vy * local.normal_y)
        coupling += _displaced(contacts, row, local, vx, vy, wx, wy)
        stiffness += _rotational_stiffness(contacts, row)
    return crank_torque, -coupling / stiffness if stiffness > 0.0 else math.nan


@compiled
def elastic_energy(drive: Drive, theta: float, x: float, contacts: Array) -> tuple[float, float, float]:
    """Energy stored in the contacts, with its derivatives, from rows solved at deviation x.

    A contact stores U = ½Fδ - ¼κF² for Hertz's law δ = κF(H - ln F) (κ as in `hertz`), and ∂U/∂κ_c = ½F/k ∂F/∂κ_c by
    the flank's curvature κ_c, which moves with the foot. The torques F L of `equilibrium` and `crank_side` leave the
    second part out: of drives with errors 0.2 % of them in the root mean square and up to 2 % at single crank angles,
    but what makes them the gradient of one energy.

    Returns
    -------
    energy, by_angle, by_rotation
        U (J), ∂U/∂θ at a fixed output angle and ∂U/∂φ_b (N·m).
    """
    pins, slices = drive.teeth + 1, drive.centre_x.size
    energy = by_angle = by_rotation = 0.0
    kappa = (drive.compliance_gear + drive.compliance_pin) / (math.pi * drive.slice_width)
    for row in range(contacts.shape[0]):
        force = contacts[row, FORCE]
        if force <= 0.0:
            continue
        local = _local(drive, theta, x, contacts, row)
        crank = theta + drive.crank_phase[row // (2 * pins * slices)]
        vx, vy = drive.eccentricity * math.sin(crank), -drive.eccentricity * math.cos(crank)
        normal = vx * local.normal_x + vy * local.normal_y
        tangent = vy * local.normal_x - vx * local.normal_y
        bending = 0.5 * force * contacts[row, FORCE_BY_CURVATURE] * contacts[row, CURVATURE_RATE]
        bending /= contacts[row, STIFFNESS]
        energy -= 0.5 * force * contacts[row, GAP] + 0.25 * kappa * force * force
        by_angle += bending * tangent * local.foot - force * normal
        by_rotation += bending * contacts[row, FOOT_RATE] + force * contacts[row, ARM]
    return energy, by_angle, by_rotation


@compiled
def press(
    drive: Drive, theta: float, flange: float, compliance: float, x: float, contacts: Array, cold: bool
) -> tuple[float, float, float, float, float]:
    """Solve the contacts with the flange held at a deviation, behind a compliance in series.

    Parameters
    ----------
    drive, theta, x, contacts, cold
        As in `equilibrium`.
    flange, compliance
        Deviation of the flange (rad), compliance between it and the contacts (rad/(N·m), 0 where there is none).

    Returns
    -------
    x, stiffness, energy, by_angle, by_rotation
        Deviation (rad) and stiffness (N·m/rad) of the contacts; stored energy (J), the series compliance's included,
        and its derivatives by crank and flange (N·m).
    """
    if compliance == 0.0:
        place(drive, theta, flange, contacts, cold, _CLEAR, _BOUNDED)
        _, stiffness = _load(drive, theta, flange, contacts)
        energy, by_angle, by_rotation = elastic_energy(drive, theta, flange, contacts)
        return flange, stiffness, energy, by_angle, by_rotation
    x, stiffness = behind_compliance(drive, theta, flange, compliance, x, contacts, cold)
    energy = by_angle = by_rotation = 0.0
    for _ in range(10):
        place(drive, theta, x, contacts, cold, _CLEAR, _BOUNDED)
        cold = False
        _, stiffness = _load(drive, theta, x, contacts)
        energy, by_angle, by_rotation = elastic_energy(drive, theta, x, contacts)
        step = (flange - x - compliance * by_rotation) / (1.0 + compliance * stiffness)
        if abs(step) < _ROTATION_STEP:
            break
        x += step
    twist = flange - x
    return x, stiffness, energy + 0.5 * twist * twist / compliance, by_angle, twist / compliance


@_inlined
def _larger_circle(drive: Drive, contacts: Array, row: int, pin: int, local: _Local) -> float:
    """Change of the contact's torque with R: the flank moves along the foot's radius, its foot and curvature change."""
    R, teeth, speed = drive.circle_radius, drive.teeth, local.speed
    ez = drive.generating_eccentricity * (teeth + 1)
    along = R - speed * local.facing  # e z_p cos(z_c α)
    distance = contacts[row, GAP] + drive.pin_radius[pin] - drive.generating_radius
    foot = local.leaning * (1.0 + distance / speed) * local.foot
    bend = R * R + ez * ez * (teeth + 1) - (teeth + 2) * R * along
    path = (2.0 * R - (teeth + 2) * along) / speed**3 - 3.0 * bend * (R - along) / speed**5
    flank = 1.0 / (1.0 - drive.generating_radius * bend / speed**3)
    curvature = path * flank * flank + contacts[row, CURVATURE_RATE] * foot
    force = contacts[row, STIFFNESS] * local.facing + contacts[row, FORCE_BY_CURVATURE] * curvature
    return force * contacts[row, ARM] - contacts[row, FORCE] * local.leaning * local.turning * local.slide


@compiled
def sensitivities(drive: Drive, theta: float, x: float, contacts: Array, out: Array) -> float:
    """Derivatives of the deviation at constant torque by every error, by the implicit function of the equilibrium.

    dx/dp = -(∂M/∂p)/(∂M/∂x) (docs/theory/errors.md), with the arms' own change included.

    Parameters
    ----------
    drive, theta, x, contacts
        A solved equilibrium.
    out
        Overwritten, shape (7 + 3 pins + discs x teeth,), by what is displaced: the bodies (`errors.kinds.BODIES`);
        place outwards, along the circle and radius of each pin; turn of each tooth, disc by disc. rad/m, and rad/rad
        for tilts and turns.

    Returns
    -------
    stiffness
        ∂M/∂x, N·m/rad.
    """
    pins, slices = drive.teeth + 1, drive.centre_x.size
    radial, tangential, radius = BODY_COUNT, BODY_COUNT + pins, BODY_COUNT + 2 * pins
    pitch = BODY_COUNT + 3 * pins
    out[:] = 0.0
    stiffness = 0.0
    for row in range(contacts.shape[0]):
        force = contacts[row, FORCE]
        if force <= 0.0:
            continue
        disc, slice_, pin = row // (2 * pins * slices), row // (2 * pins) % slices, row // 2 % pins
        local = _local(drive, theta, x, contacts, row)
        stiffness += _rotational_stiffness(contacts, row)
        z = drive.slice_z[slice_]
        crank, ring, _ = _poses(drive, theta, x, disc)
        # The gear's centre moves, so the pin's axis by the opposite; in the housing's frame unless the gear turns.
        turn = 0.0 if drive.ring else 1.0
        along_x = _displaced(contacts, row, local, -1.0, 0.0, 0.0, turn)
        along_y = _displaced(contacts, row, local, 0.0, -1.0, -turn, 0.0)
        out[CENTRE_X] += along_x
        out[CENTRE_Y] += along_y
        out[TILT_X] += along_x * z
        out[TILT_Y] += along_y * z
        out[CRANK_THROW] += along_x * math.cos(crank) + along_y * math.sin(crank)
        # The pin moves with the ring.
        direction = pin * 2.0 * math.pi / pins + ring
        c, s = math.cos(direction), math.sin(direction)
        sign = 1.0 if drive.ring else -1.0
        out[radial + pin] += _displaced(contacts, row, local, c, s, -sign * s, sign * c)
        out[tangential + pin] += _displaced(contacts, row, local, -s, c, -sign * c, -sign * s)
        thicker = contacts[row, STIFFNESS] * contacts[row, ARM]
        out[radius + pin] += thicker
        out[PIN_GENERATING] -= thicker
        out[CIRCLE_GENERATING] += _larger_circle(drive, contacts, row, pin, local)
        foot = pin * 2.0 * math.pi / pins + (crank - ring) / drive.teeth + contacts[row, FOOT]
        tooth = math.floor(foot * drive.teeth / (2.0 * math.pi)) % drive.teeth
        wx, wy = (local.lever_x, local.lever_y) if drive.ring else (-local.gear_x, -local.gear_y)
        out[pitch + disc * drive.teeth + tooth] += _displaced(contacts, row, local, local.gear_y, -local.gear_x, wx, wy)
    for column in range(out.size):
        out[column] = -out[column] / stiffness
    return stiffness


@compiled
def sweep_play(drive: Drive, thetas: Array, first: int, last: int, low: Array, high: Array, gap: Array) -> None:
    """Solve the play at crank angles `first` to `last`; each angle starts from its neighbour's solution.

    Parameters
    ----------
    thetas
        Crank angles, shape (angles,), rad.
    low, high, gap
        Overwritten from `first` to `last`, shape (angles,): ends of the play (rad) and interference (m), as `play`.
    """
    contacts = contact_rows(drive)
    cold, x = True, 0.0
    for i in range(first, last):
        low[i], high[i], gap[i] = play(drive, thetas[i], x, contacts, cold)
        cold = math.isnan(low[i])
        x = 0.0 if cold else 0.5 * (low[i] + high[i])


@compiled
def sweep_load(
    drive: Drive,
    thetas: Array,
    torque: float,
    first: int,
    last: int,
    deviation: Array,
    stiffness: Array,
    count: NDArray[np.int64],
    pressure: Array,
    force: Array,
    pin_pressure: Array,
    slice_force: NDArray[np.float32],
    slice_direction: NDArray[np.float32],
    gear_map: Array,
    pin_map: Array,
) -> None:
    """Solve crank angles `first` to `last` at one torque; each angle starts from its neighbours' solutions.

    Parameters
    ----------
    thetas, torque
        Crank angles (rad), shape (angles,); torque (N·m), at 0 the deviation is the middle of the play.
    deviation, stiffness, count, pressure
        Overwritten from `first` to `last`, shape (angles,): x (rad), N·m/rad, pins in contact, Pa.
    force, pin_pressure
        Overwritten likewise, shape (angles, discs, pins): N, Pa.
    slice_force, slice_direction
        Overwritten likewise, shape (angles, discs, pins, slices) or size 0: the contact lines, as force in each slice
        (N) and direction of the contact about the pin's axis from that to the pin circle's centre (rad).
    gear_map, pin_map
        Raised to the largest pressure that each element has seen, shapes (discs, teeth, profile, slices) and (pins,
        angle, slices), or size 0, Pa.
    """
    contacts = contact_rows(drive)
    cold, x = True, 0.0
    for i in range(first, last):
        if torque == 0.0:
            start, end, _ = play(drive, thetas[i], x, contacts, cold)
            cold = False
            if not math.isnan(start):
                x = 0.5 * (start + end)
                deviation[i], stiffness[i], count[i], pressure[i] = x, 0.0, 0, 0.0
                force[i] = 0.0
                pin_pressure[i] = 0.0
                slice_force[i : i + 1] = 0.0
                slice_direction[i : i + 1] = 0.0
                continue
        elif i > first + 1 and abs(thetas[i] - thetas[i - 1]) < 1.5 * abs(thetas[i - 1] - thetas[i - 2]):
            x += (x - deviation[i - 2]) * (thetas[i] - thetas[i - 1]) / (thetas[i - 1] - thetas[i - 2])
        x, stiffness[i] = equilibrium(drive, thetas[i], torque, x, contacts, cold)
        cold = False
        deviation[i] = x
        count[i], pressure[i] = load_sharing(drive, contacts, force[i], pin_pressure[i])
        if slice_force.size > 0:
            _lines(drive, thetas[i], x, contacts, slice_force[i], slice_direction[i], gear_map, pin_map)


@compiled
def sweep_contacts(drive: Drive, thetas: Array, torque: float, deviation: Array, table: Array) -> None:
    """Solve crank angles at one torque and keep every contact row.

    Parameters
    ----------
    thetas, torque
        Crank angles (rad), shape (angles,); torque (N·m), not 0.
    deviation, table
        Overwritten: x (rad), shape (angles,); `contact_rows` of each angle, shape (angles, rows, columns).
    """
    contacts = contact_rows(drive)
    x = 0.0
    for i in range(thetas.size):
        x, _ = equilibrium(drive, thetas[i], torque, x, contacts, i == 0)
        deviation[i] = x
        table[i] = contacts


@compiled
def _lines(
    drive: Drive,
    theta: float,
    x: float,
    contacts: Array,
    slice_force: NDArray[np.float32],
    slice_direction: NDArray[np.float32],
    gear_map: Array,
    pin_map: Array,
) -> None:
    """Write the contact lines of one solved position and raise the elements' largest pressures."""
    teeth = drive.teeth
    pins, slices = teeth + 1, drive.centre_x.size
    pitch = 2.0 * math.pi / teeth
    elements, angles = gear_map.shape[2], pin_map.shape[1]
    slice_force[:] = 0.0
    slice_direction[:] = 0.0
    arc = (drive.flank_alpha.size - 2) and math.hypot(
        drive.flank_x[2] - drive.flank_x[1], drive.flank_y[2] - drive.flank_y[1]
    )
    for row in range(contacts.shape[0]):
        force = contacts[row, FORCE]
        if force <= 0.0:
            continue
        disc, slice_, pin = row // (2 * pins * slices), row // (2 * pins) % slices, row // 2 % pins
        local = _local(drive, theta, x, contacts, row)
        crank, ring, _ = _poses(drive, theta, x, disc)
        inwards = pin * 2.0 * math.pi / pins + ring + math.pi
        c, s = math.cos(inwards), math.sin(inwards)
        # The contact lies from the pin's axis against the flank's normal.
        direction = math.atan2(s * local.normal_x - c * local.normal_y, -c * local.normal_x - s * local.normal_y)
        slice_force[disc, pin, slice_] += force
        slice_direction[disc, pin, slice_] = direction
        radius = drive.pin_radius[pin]
        half = half_width(
            force, contacts[row, CURVATURE], radius, drive.slice_width, drive.compliance_gear, drive.compliance_pin
        )
        pressure = 2.0 * force / (math.pi * half * drive.slice_width)
        alpha = pin * 2.0 * math.pi / pins + (crank - ring) / teeth + contacts[row, FOOT]
        tooth = math.floor(alpha / pitch)
        point = np.searchsorted(drive.flank_alpha, alpha - tooth * pitch)
        point = min(max(point, 1), drive.flank_alpha.size - 1)
        share = (alpha - tooth * pitch - drive.flank_alpha[point - 1]) / (
            drive.flank_alpha[point] - drive.flank_alpha[point - 1]
        )
        middle = point - 2.0 + share
        reach = half / arc
        for element in range(max(0, math.ceil(middle - reach)), min(elements, math.floor(middle + reach) + 1)):
            seen = pressure * math.sqrt(max(1.0 - ((element - middle) / reach) ** 2, 0.0))
            number = int(tooth) % teeth
            gear_map[disc, number, element, slice_] = max(gear_map[disc, number, element, slice_], seen)
        middle = (direction / math.pi + 0.5) * angles - 0.5
        reach = half / radius / math.pi * angles
        for element in range(max(0, math.ceil(middle - reach)), min(angles, math.floor(middle + reach) + 1)):
            seen = pressure * math.sqrt(max(1.0 - ((element - middle) / reach) ** 2, 0.0))
            pin_map[pin, element, slice_] = max(pin_map[pin, element, slice_], seen)


@compiled
def sweep_sensitivities(
    drive: Drive, thetas: Array, torque: Array, deviation: Array, errors: Array, by_angle: Array, by_torque: Array
) -> None:
    """Solve every crank angle at its torque, with the derivatives of the deviation.

    Parameters
    ----------
    thetas, torque
        Crank angles (rad) and the torque at each (N·m, not 0), shape (angles,).
    deviation, errors, by_angle, by_torque
        Overwritten: x (rad), shape (angles,); rows of `sensitivities`, shape (angles, columns); the output angle's
        derivatives by crank angle (1) and torque (rad/(N·m)), shape (angles,).
    """
    contacts = contact_rows(drive)
    x = 0.0
    for i in range(thetas.size):
        x, _ = equilibrium(drive, thetas[i], torque[i], x, contacts, i == 0)
        deviation[i] = x
        by_torque[i] = 1.0 / sensitivities(drive, thetas[i], x, contacts, errors[i])
        _, by_angle[i] = crank_side(drive, thetas[i], x, contacts)


@compiled
def sweep_flank_sensitivities(
    drive: Drive, thetas: Array, deviation: Array, places: Array, waves: Array, out: Array
) -> None:
    """Derivatives of solved deviations at constant torque by normal deviations that all teeth share.

    A flank that is higher by f at the contact takes f from the gap. Where f rises along the flank the arm grows by f'
    times the foot's rate, and the contact lies up the rise, where the curvature is another
    (docs/theory/identification.md).

    Parameters
    ----------
    thetas, deviation
        Crank angles and the solved deviations there, shape (angles,), rad.
    places, waves
        Profile parameters from one root to the next, shape (points,), rad, and deviations there, > 0 material added,
        linear between them, shape (waves, points), m for each unit.
    out
        Overwritten, shape (angles, waves): rad for each unit.
    """
    contacts = contact_rows(drive)
    pitch = 2.0 * math.pi / drive.teeth
    out[:] = 0.0
    for i in range(thetas.size):
        place(drive, thetas[i], deviation[i], contacts, i == 0, math.inf, _BOUNDED)
        _load(drive, thetas[i], deviation[i], contacts)
        stiffness = 0.0
        for row in range(contacts.shape[0]):
            force = contacts[row, FORCE]
            if force <= 0.0:
                continue
            stiffness += _rotational_stiffness(contacts, row)
            along = contacts[row, PLACE] - math.floor(contacts[row, PLACE] / pitch) * pitch
            after = min(max(np.searchsorted(places, along), 1), places.size - 1)
            width = places[after] - places[after - 1]
            share = (along - places[after - 1]) / width
            local = _local(drive, thetas[i], deviation[i], contacts, row)
            stretch = 1.0 / (local.speed * local.foot)
            # Second derivative of the axis' distance from the flank along it.
            bend = local.speed / local.foot * (1.0 - drive.generating_radius * local.bend * stretch)
            upwards = drive.pin_radius[row // 2 % (drive.teeth + 1)] / bend
            by_rise = contacts[row, FORCE_BY_CURVATURE] * contacts[row, CURVATURE_RATE] * contacts[row, ARM] * upwards
            by_rise += force * contacts[row, FOOT_RATE]
            for wave in range(waves.shape[0]):
                low, high = waves[wave, after - 1], waves[wave, after]
                height, rise = (1.0 - share) * low + share * high, (high - low) / width
                out[i, wave] -= contacts[row, STIFFNESS] * contacts[row, ARM] * height + by_rise * rise
        for wave in range(waves.shape[0]):
            out[i, wave] /= stiffness
