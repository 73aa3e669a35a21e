"""Strength of pins, output pins and discs: nominal stresses under the solved loads against yield and fatigue.

Nominal: those of beams, projected areas and sections through the webs, without notch factors and residual stresses.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.bodies import beams, outline
from cycloid_fmu.bodies.disc import DiscForces, elastic_disc, nodal_forces
from cycloid_fmu.contact.transmission import Transmission
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.bodies import Bodies, DiscBody
from cycloid_fmu.geometry.materials import MaterialValue
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.supports.transmission import OnBearings

Array = NDArray[np.float64]
Points = NDArray[np.complex128]
_PLACES = 121  # along a pin
_FIBRES = 12  # directions of half a turn about a pin's axis
_WEB_ANGLES = 24  # crank angles at which finite elements give the discs' stresses
_SECTION, _SECTION_WEIGHT = np.polynomial.legendre.leggauss(9)
SHEAR_YIELD = 1.0 / math.sqrt(3.0)
"""Yield strength in shear over that in tension (von Mises)."""


class Stress(NamedTuple):
    """A nominal stress at its worst place, and what the material permits.

    Attributes
    ----------
    part, kind
        "pin", "output pin" or "disc", and "bending", "shear", "pressure", "web" or "fatigue".
    value, permitted
        Pa; NaN where unknown.
    where
        Place of the largest: `torque` (N·m), `crank_angle` (rad), `disc`, `pin`.
    basis
        What the stress is, and of which material the permitted one.
    reason
        Why it is not judged; empty if it is.
    """

    part: str
    kind: str
    value: float
    permitted: float
    where: Mapping[str, Any]
    basis: str
    reason: str = ""

    @property
    def safety(self) -> float:
        """Permitted over nominal stress; infinite without load, NaN if it is not judged."""
        if self.reason:
            return math.nan
        return self.permitted / self.value if self.value > 0.0 else math.inf

    def numbers(self) -> dict[str, Any]:
        """Return it for scripts, SI."""
        return {**self._asdict(), "where": dict(self.where), "safety": self.safety}

    def row(self) -> list[str]:
        """Return it as a table row, columns `HEAD`."""
        known = [f"{value * 1e-6:.3g}" if math.isfinite(value) else "" for value in (self.value, self.permitted)]
        safety = f"{self.safety:.3g}" if not self.reason else "not judged"
        return [self.part, self.kind, *known, safety, f"{self.reason or self.basis}"]


HEAD = ("part", "of", "stress, MPa", "permitted, MPa", "safety", "basis")
"""Columns of `Stress.row`."""


def strength(drive: DriveValue, swept: Transmission, bodies: Bodies | None = None) -> list[Stress]:
    """Return the nominal stresses of pins, output pins and discs at the loads of a sweep over a crank turn.

    Bending and shear are those of beams (`bodies.beams`) under the vector sum of the discs' forces on each pin, with
    W = πd³/32 and the mean over A = πd²/4. Pressures are over projected areas, F/(d b). Webs of discs are sections
    through the finite elements with their stress linearised (`web_stresses`), or without `[bodies.disc]` the formula of
    an eye, √3F/(2cb). Permitted are the yield strength R_e, R_e/√3 for shear, and against fatigue the line σ_a/σ_W +
    |σ_m|/R_e = 1 (Soderberg), each at the low end of the named material's range.

    Parameters
    ----------
    drive
        The drive.
    swept
        Its sweep over one crank turn or more, of `analysis.solve`.
    bodies
        Dimensions of pins and discs; None for those of the pair.
    """
    pair = drive.pair
    bodies = bodies or pair.bodies or Bodies()
    return [*_of_pins(pair, swept, bodies), *_of_output_pins(pair, swept, bodies), *_of_discs(pair, swept, bodies)]


class _Limit(NamedTuple):
    """A material's entry in the table, or why there is none."""

    value: MaterialValue | None
    name: str
    reason: str


def _material(pair: Pair, part: str) -> _Limit:
    stated = getattr(pair.material, part)
    if stated is None or stated.value is None:
        return _Limit(
            None, "", f"state [material.{part}] name: the strength of the {part.replace('_', ' ')} is not known"
        )
    return _Limit(stated.value, stated.name, "")


def _weaker(first: _Limit, second: _Limit) -> _Limit:
    """Return the material that yields first, or the one that is not known."""
    if first.value is None or second.value is None:
        return first if first.value is None else second
    return min(first, second, key=lambda limit: limit.value.yield_strength[0] if limit.value else 0.0)


def _judged(
    part: str, kind: str, value: float, limit: _Limit, where: Mapping[str, Any], basis: str, share: float = 1.0
) -> Stress:
    """Return a stress against a share of the yield strength."""
    if limit.value is None:
        return Stress(part, kind, value, math.nan, where, basis, limit.reason)
    return Stress(part, kind, value, share * limit.value.yield_strength[0], where, f"{basis}; {limit.name}")


def _unknown(part: str, kinds: Sequence[str], reason: str) -> list[Stress]:
    return [Stress(part, kind, math.nan, math.nan, {}, "", reason) for kind in kinds]


def fatigue_stress(stress: Array, limit: MaterialValue) -> Array:
    """Return the alternating stress that is as bad as a stress over a crank turn (first axis), Pa.

    σ_a + |σ_m| σ_W/R_e with half the range σ_a and the middle σ_m (Soderberg's line): at the fatigue strength σ_W
    it is at the limit, and at rest at the yield strength R_e.

    Raises
    ------
    ValueError
        If the material has no bending fatigue strength.
    """
    if limit.bending_fatigue is None:
        raise ValueError("bending_fatigue is missing; the material must have one")
    highest, lowest = stress.max(axis=0), stress.min(axis=0)
    ratio = limit.bending_fatigue[0] / limit.yield_strength[0]
    return np.asarray(0.5 * (highest - lowest) + 0.5 * np.abs(highest + lowest) * ratio)


def _fatigue(part: str, value: float, limit: _Limit, where: Mapping[str, Any], basis: str) -> Stress:
    if limit.value is None or limit.value.bending_fatigue is None:
        reason = limit.reason or f"no source states a fatigue strength of {limit.name}"
        return Stress(part, "fatigue", math.nan, math.nan, where, basis, reason)
    return Stress(part, "fatigue", value, limit.value.bending_fatigue[0], where, f"{basis}; {limit.name}")


def pin_directions(pair: Pair, crank_angle: Array) -> Points:
    """Return the direction of each disc's force on each pin in the ring's frame, shape (angles, discs, pins).

    Each contact's normal goes through the pitch point, e z_p from the ring's axis in the direction of the eccentric.
    """
    phase = 2.0 * np.pi * np.arange(pair.discs) / pair.discs
    turned = crank_angle * (1.0 - (1.0 / pair.pins if pair.output == "ring" else 0.0))
    pitch_point = pair.eccentricity * pair.pins * np.exp(1j * (turned[:, None] + phase))
    pin = pair.pin_circle_radius * np.exp(2j * np.pi * np.arange(pair.pins) / pair.pins)
    away = pin - pitch_point[..., None]
    return np.asarray(away / np.abs(away))


def output_directions(pair: Pair, crank_angle: Array) -> Points:
    """Return the direction of each disc's force on the output pins in the carrier's frame, shape (angles, discs)."""
    phase = 2.0 * np.pi * np.arange(pair.discs) / pair.discs
    turned = crank_angle * (1.0 + 1.0 / pair.gear_teeth)
    return np.asarray(np.exp(1j * (turned[:, None] + phase)))


def _largest(values: Array, swept: Transmission, names: Sequence[str]) -> tuple[float, dict[str, Any]]:
    """Return the largest of values over torque, crank angle and more axes, and its place."""
    index = np.unravel_index(int(values.argmax()), values.shape)
    torque = swept.torque if swept.torque.ndim == 1 else swept.torque[:, 0]
    where = {"torque": float(torque[index[0]]), "crank_angle": float(swept.crank_angle[index[1]])}
    return float(values[index]), where | {name: int(k) for name, k in zip(names, index[2:], strict=True)}


def _beam_stresses(
    part: str, held: beams.HeldBeam, force: Points, limit: _Limit, swept: Transmission
) -> Iterator[Stress]:
    """Bending, shear and fatigue of pins that are beams; forces (torques, angles, discs, pins) as vectors, N."""
    low, high = sorted(held.supports)
    at = np.linspace(low, high, _PLACES)
    at[[0, -1]] += 1e-9 * (high - low) * np.array([1.0, -1.0])  # on this side of the reactions
    unit_moment, unit_shear = held.beam.internal_forces(held.ends, held.supports, held.loads, at)
    section, area = math.pi * held.diameter**3 / 32.0, math.pi * held.diameter**2 / 4.0
    bent = np.empty((*force.shape[:2], force.shape[-1]))
    cut, worn = np.empty_like(bent), np.zeros((force.shape[0], force.shape[-1]))
    fibres = np.exp(-1j * np.pi * np.arange(_FIBRES) / _FIBRES)
    tiring = limit.value is not None and limit.value.bending_fatigue is not None
    for load in range(force.shape[0]):
        moment = np.einsum("adp,dz->apz", force[load], unit_moment) / section
        bent[load] = np.abs(moment).max(axis=-1)
        cut[load] = np.abs(np.einsum("adp,dz->apz", force[load], unit_shear)).max(axis=-1) / area
        for fibre in fibres if tiring else ():
            assert limit.value is not None
            stress = fatigue_stress((moment * fibre).real, limit.value).max(axis=-1)
            worn[load] = np.maximum(worn[load], stress)
    how = f"d = {held.diameter * 1e3:.4g} mm, {held.ends} over {(high - low) * 1e3:.4g} mm"
    value, where = _largest(bent, swept, ["pin"])
    yield _judged(part, "bending", value, limit, where, how)
    value, where = _largest(cut, swept, ["pin"])
    yield _judged(part, "shear", value, limit, where, f"mean of the section; {how}", SHEAR_YIELD)
    value, where = _largest(worn[:, None], swept, ["pin"])
    where.pop("crank_angle")
    yield _fatigue(
        part, value, limit, where, "amplitude of bending with its mean (Soderberg), a pin that does not turn"
    )


def _of_pins(pair: Pair, swept: Transmission, bodies: Bodies) -> Iterator[Stress]:
    limit, body = _material(pair, "pin"), bodies.pin
    if body is None:
        seat = "ring" if pair.material.ring is not None else "gear"
        value, where = _largest(swept.pin_force, swept, ["disc", "pin"])
        value /= 2.0 * pair.pin_radius * pair.face_width
        of = "" if seat == "ring" else ", a ring of the discs' material"
        basis = f"F/(d b) in its seat{of}; a pin that lies in it over its width does not bend, else state [bodies.pin]"
        yield _judged("pin", "pressure", value, _weaker(limit, _material(pair, seat)), where, basis)
        return
    if body.matrix is not None:
        yield from _unknown("pin", ("bending", "shear", "fatigue"), "[bodies.pin] is a matrix without dimensions")
        return
    held = beams.pin_beam(pair, body, bodies.disc_spacing)
    force = swept.pin_force * pin_directions(pair, swept.crank_angle)
    yield from _beam_stresses("pin", held, force, limit, swept)


def _of_output_pins(pair: Pair, swept: Transmission, bodies: Bodies) -> Iterator[Stress]:
    supports, body, kinds = pair.supports, bodies.output_pin, ("bending", "shear", "fatigue")
    if supports is not None and supports.kind == "cranks":
        return
    if supports is None or not isinstance(swept, OnBearings):
        yield from _unknown("output pin", kinds, "without [supports] the load of output pins is not known")
        return
    if body is None or body.matrix is not None:
        yield from _unknown("output pin", kinds, "state [bodies.output_pin] with its dimensions")
        return
    held = beams.output_pin_beam(pair, body, bodies.disc_spacing)
    force = swept.output_roller_force * output_directions(pair, swept.crank_angle)[..., None]
    yield from _beam_stresses("output pin", held, force, _material(pair, "output_pin"), swept)


def _of_discs(pair: Pair, swept: Transmission, bodies: Bodies) -> Iterator[Stress]:
    supports, limit = pair.supports, _material(pair, "gear")
    if supports is None or not isinstance(swept, OnBearings):
        yield from _unknown("disc", ("web",), "without [supports] the holes of the discs are not known")
        return
    rollers = supports.kind == "output_rollers"
    if rollers:
        roller = supports.output_roller
        if roller is None or roller.radius is None:
            yield from _unknown("disc", ("pressure",), "state [supports.output_roller] radius")
        else:
            value, where = _largest(swept.output_roller_force, swept, ["disc", "roller"])
            value /= 2.0 * roller.radius * pair.face_width
            yield _judged("disc", "pressure", value, limit, where, "F/(d b) of an output pin in its hole")
    body = bodies.disc
    if body is not None and body.matrix is None and body == (pair.bodies and pair.bodies.disc):
        yield from _of_webs(pair, swept, body, limit)
    else:
        yield from _of_eyes(pair, swept, body, limit)


def _of_eyes(pair: Pair, swept: OnBearings, body: DiscBody | None, limit: _Limit) -> Iterator[Stress]:
    """Webs as those of an eye: tension beside the hole and shear before it, F/(2cb) each; by von Mises √3F/(2cb)."""
    supports = pair.supports
    assert supports is not None
    rollers = supports.kind == "output_rollers"
    force = swept.output_roller_force if rollers else swept.turning_arm_force
    if rollers:
        roller = supports.output_roller
        stated = None if body is None else body.roller_hole_radius
        if stated is None and roller is not None and roller.radius is not None:
            stated = roller.radius + pair.eccentricity + 0.5 * roller.clearance
    else:
        stated = None if body is None else body.bore_radius
    if stated is None:
        key = "roller_hole_radius" if rollers else "bore_radius"
        yield from _unknown("disc", ("web", "fatigue"), f"state [bodies.disc] {key}")
        return
    least = least_web(pair, stated, body.bore_radius if body is not None and rollers else None)
    if not least > 0.0:
        yield from _unknown("disc", ("web", "fatigue"), f"holes of {stated * 1e3:.4g} mm in radius leave no web")
        return
    value, where = _largest(force, swept, ["disc", "roller" if rollers else "crank"])
    value *= math.sqrt(3.0) / (2.0 * least * pair.face_width)
    how = f"least web of {least * 1e3:.3g} mm as that of an eye, √3F/(2cb)"
    yield _judged("disc", "web", value, limit, where, f"{how}; [bodies.disc] would give it by finite elements")
    tired = 0.0
    if limit.value is not None and limit.value.bending_fatigue is not None:
        tired = float(fatigue_stress(np.array([0.0, value]), limit.value))
    yield _fatigue("disc", tired, limit, where, f"from 0 to the largest (Soderberg); {how}")


def least_web(pair: Pair, hole: float, bore: float | None = None) -> float:
    """Return the least width between a hole of a disc and flank, neighbouring hole, or bore in the middle, m.

    Parameters
    ----------
    pair
        A pair with supports, at whose `circle_radius` the holes are.
    hole, bore
        Radii, m; None for a bore that is not known.
    """
    supports = pair.supports
    assert supports is not None
    middles = outline.places(pair)
    alpha = np.linspace(0.0, 2.0 * np.pi, 400 * pair.gear_teeth, endpoint=False)
    flank = outline.flank_at(pair, 0, alpha)[0]
    webs = [float(np.abs(flank[:, None] - middles).min()) - hole]
    webs.append(2.0 * supports.circle_radius * math.sin(math.pi / supports.count) - 2.0 * hole)
    if bore is not None:
        webs.append(supports.circle_radius - hole - bore)
    return min(webs)


def _of_webs(pair: Pair, swept: OnBearings, body: DiscBody, limit: _Limit) -> Iterator[Stress]:
    torque = int(np.abs(swept.pin_force).sum(axis=(1, 2, 3)).argmax())
    step = max(1, swept.crank_angle.size // _WEB_ANGLES)
    angles = np.arange(0, swept.crank_angle.size, step)
    largest, tired, where, width = 0.0, 0.0, dict[str, Any](), 0.0
    for disc in range(pair.discs):
        fibres, shear, widths = web_stresses(pair, body, swept, disc, torque, angles)
        whole = np.sqrt(np.abs(fibres).max(axis=-1) ** 2 + 3.0 * shear**2)
        if whole.max() > largest:
            angle, web = np.unravel_index(int(whole.argmax()), whole.shape)
            largest, width = float(whole.max()), float(widths[web])
            where = {"torque": float(swept.torque[torque]), "crank_angle": float(swept.crank_angle[angles[angle]])}
            where["disc"] = disc
        if limit.value is not None and limit.value.bending_fatigue is not None:
            tired = max(tired, float(fatigue_stress(fibres, limit.value).max()))
    how = f"finite elements, linearised over a web of {width * 1e3:.3g} mm"
    yield _judged("disc", "web", largest, limit, where, how)
    yield _fatigue("disc", tired, limit, {}, "amplitude in webs with its mean (Soderberg), finite elements")


def web_stresses(
    pair: Pair, body: DiscBody, swept: OnBearings, disc: int, torque: int, angles: NDArray[np.int64]
) -> tuple[Array, Array, Array]:
    """Return the linearised stresses of a disc's webs by finite elements.

    Each web is the shortest section between two contours. Across it the stress is replaced by the one with the same
    force and moment, as in ASME VIII-2 part 5. Pins and output pins press as in `bodies.disc`, each at its ideal place
    with the solved force; arms are in balance with them, alike but for their common moment.

    Parameters
    ----------
    pair, body, swept, disc
        The pair with its supports, its disc, its sweep, and the number of the disc.
    torque, angles
        Indices of the torque and of crank angles of the sweep.

    Returns
    -------
    fibres
        Stress of both end fibres, shape (angles, webs, 2), Pa.
    shear
        Mean shear stress, shape (angles, webs), Pa.
    width
        Shape (webs,), m.
    """
    elastic = elastic_disc(pair, body, disc)
    start, end = _webs(pair, body, disc)
    along, width = (end - start) / np.abs(end - start), np.abs(end - start)
    points = 0.5 * (start + end)[:, None] + 0.5 * (end - start)[:, None] * _SECTION
    stress = elastic.stress(points.ravel())
    crank_angle = [float(swept.crank_angle[k]) for k in angles]
    each = [_disc_forces(pair, swept, disc, torque, int(k)) for k in angles]
    forces = [nodal_forces(elastic, pair, body, disc, *at) for at in zip(crank_angle, each, strict=True)]
    moved = elastic.displacement(np.array(forces).T)
    xx, yy, xy = ((matrix @ moved).reshape(*points.shape, angles.size) for matrix in stress)
    across = (1j * along)[:, None, None]
    normal = xx * across.real**2 + yy * across.imag**2 + 2.0 * xy * across.real * across.imag
    tangent = along[:, None, None]
    sheared = xx * across.real * tangent.real + yy * across.imag * tangent.imag
    sheared += xy * (across.real * tangent.imag + across.imag * tangent.real)
    mean, bending, shear = (
        np.einsum("wsa,s->aw", values, weight)
        for values, weight in (
            (normal, 0.5 * _SECTION_WEIGHT),
            (normal, 1.5 * _SECTION_WEIGHT * _SECTION),
            (sheared, 0.5 * _SECTION_WEIGHT),
        )
    )
    return np.stack([mean - bending, mean + bending], axis=-1), shear, width


def _webs(pair: Pair, body: DiscBody, disc: int) -> tuple[Points, Points]:
    """Return both ends of the shortest section between each two contours with nothing between them, m."""
    from scipy.spatial import KDTree

    step = 1e-3 * pair.pin_circle_radius
    holes = [*outline.bores(pair, body, 96), *outline.other_holes(pair, body, 96), *outline.windows(body)]
    curves = [outline.dense_points(each, step) for each in (outline.flank_contour(pair, disc, step), *holes)]
    starts, ends = [], []
    for k, first in enumerate(curves):
        tree = KDTree(np.column_stack([first.real, first.imag]))
        for other in curves[k + 1 :]:
            apart, nearest = tree.query(np.column_stack([other.real, other.imag]))
            start, end = first[nearest[apart.argmin()]], other[apart.argmin()]
            inner = start + (end - start) * np.linspace(0.02, 0.98, 25)
            if not any(outline.encloses(hole, point) for hole in curves[1:] for point in inner):
                starts.append(start)
                ends.append(end)
    return np.array(starts), np.array(ends)


def _disc_forces(pair: Pair, swept: OnBearings, disc: int, torque: int, angle: int) -> DiscForces:
    """Return the forces on a disc at one crank angle, in its axes, its arms in balance with the others."""
    supports, crank_angle = pair.supports, float(swept.crank_angle[angle])
    assert supports is not None
    crank = crank_angle + 2.0 * math.pi * disc / pair.discs
    pin, roller = swept.pin_force[torque, angle, disc], swept.output_roller_force[torque, angle, disc]
    alpha = (2.0 * np.pi * np.arange(pair.pins) / pair.pins + crank / pair.gear_teeth) % (2.0 * np.pi)
    place, normal = outline.flank_at(pair, disc, alpha)
    inwards = -np.exp(1j * (crank + crank_angle / pair.gear_teeth))
    total = -(normal * pin).sum() + inwards * roller.sum()
    reactions = np.array([-total])
    if supports.kind == "cranks":
        moment = float((np.conj(place) * -normal * pin).imag.sum())
        shared = supports.count * supports.circle_radius**2
        reactions = -total / supports.count - 1j * outline.places(pair) * moment / shared
    return DiscForces(pin, np.column_stack([reactions.real, reactions.imag]), roller)
