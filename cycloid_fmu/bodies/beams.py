"""Pins, cranks and output pins as Timoshenko beams of round sections, and the carrier's columns.

A beam's compliance between two loads is the virtual work of the bending moment and the shear force of one on the
strains of the other (Mohr's integral). Loads are uniform over the face width, displacements are means over it, and
clamped beams have the reactions of their second end as further loads that displace nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.bodies.mesh import Array
from cycloid_fmu.geometry.bodies import CarrierBody, CrankBody, ElasticBody, OutputPinBody, PinBody, Section
from cycloid_fmu.geometry.pair import Material, Pair

_GAUSS, _WEIGHT = np.polynomial.legendre.leggauss(3)  # exact: products of parabolas
_RECTANGLE = 5.0 / 6.0  # shear factor of a rectangular section


@dataclass(frozen=True)
class Beam:
    """A straight stepped beam along z.

    Attributes
    ----------
    sections
        Its pieces with their diameters, m.
    material
        Young's modulus and Poisson's ratio.
    """

    sections: tuple[Section, ...]
    material: Material

    @property
    def _points(self) -> list[float]:
        return [self.sections[0].start, *(section.end for section in self.sections)]

    def _flexibility(self, z: Array) -> tuple[Array, Array]:
        """1/EI and 1/κGA at places z, with the shear factor κ = 6(1 + ν)/(7 + 6ν) of a circle."""
        young, poisson = self.material.youngs_modulus, self.material.poissons_ratio
        ends = np.array(self._points[1:-1])
        diameter = np.array([section.diameter for section in self.sections])[np.searchsorted(ends, z, "right")]
        area, shear = 0.25 * math.pi * diameter**2, 0.5 * young / (1.0 + poisson)
        factor = 6.0 * (1.0 + poisson) / (7.0 + 6.0 * poisson)
        return 64.0 / (math.pi * diameter**4 * young), 1.0 / (factor * shear * area)

    def compliance(self, ends: str, supports: tuple[float, float], loads: Sequence[tuple[float, float]]) -> Array:
        """Mean displacement of each load's width under each unit load, symmetric, shape (loads, loads), m/N.

        Parameters
        ----------
        ends
            "supported" or "clamped" at both supports, or "cantilever": clamped at the first.
        supports
            Places of the supports, m.
        loads
            Start and end of each load's width, m.

        References ---------- S. P. Timoshenko, On the correction for shear, Phil. Mag. 41 (1921) 744; the shear factor:
        G. R. Cowper, J. Appl. Mech. 33 (1966) 335.
        """
        at, weight = self._gauss([*supports, *(place for load in loads for place in load)])
        moments, shears = self.internal_forces(ends, supports, loads, at)
        bending, shearing = self._flexibility(at)
        return _work(moments, shears, weight * bending, weight * shearing)

    def _gauss(self, cuts: Sequence[float]) -> tuple[Array, Array]:
        """Places and weights of integration between cuts, exact where the section does not change between them."""
        inner = [point for point in self._points if min(cuts) < point < max(cuts)]
        z = np.array(sorted({*cuts, *inner}))
        half = 0.5 * np.diff(z)
        at = (0.5 * (z[1:] + z[:-1])[:, None] + half[:, None] * _GAUSS).ravel()
        return at, (half[:, None] * _WEIGHT).ravel()

    def internal_forces(
        self, ends: str, supports: tuple[float, float], loads: Sequence[tuple[float, float]], at: Array
    ) -> tuple[Array, Array]:
        """Bending moment (m) and shear force (1) at places under each unit load, both of shape (loads, places).

        Parameters are those of `compliance`; `at` are places between the supports, m. Signs are common to all loads.
        """
        first, second = supports
        if ends == "supported":
            cases = []
            for load in loads:
                moment, shear = _uniform(at, *load)
                share = (0.5 * (load[0] + load[1]) - first) / (second - first)
                for reaction, place in ((1.0 - share, first), (share, second)):
                    moment = moment - reaction * np.maximum(at - place, 0.0)
                    shear = shear - reaction * (at > place)
                cases.append((moment, shear))
            return _stacked(cases)
        # A cantilever: what is between a section and the free end, so seen from the clamped first support.
        outwards = 1.0 if second > first else -1.0
        moments, shears = _stacked([_from_free_end(at, load, outwards) for load in loads])
        if ends == "cantilever":
            return moments, shears
        places, weight = self._gauss([*supports, *(place for load in loads for place in load)])
        bending, shearing = (weight * each for each in self._flexibility(places))
        cases = [*(_from_free_end(places, load, outwards) for load in loads), *_reactions(places, second, outwards)]
        whole = _work(*_stacked(cases), bending, shearing)
        n = len(loads)
        # Force and moment of the second end, at which nothing moves.
        end = -np.linalg.solve(whole[n:, n:], whole[n:, :n]).T
        more = _stacked(_reactions(at, second, outwards))
        return moments + end @ more[0], shears + end @ more[1]


def _reactions(at: Array, end: float, outwards: float) -> list[tuple[Array, Array]]:
    """Moment and shear force at places of a unit force and of a unit moment on a beam's second end."""
    before = (outwards * (end - at) > 0.0).astype(float)
    return [(before * outwards * (end - at), before), (before, np.zeros_like(at))]


def _stacked(cases: Sequence[tuple[Array, Array]]) -> tuple[Array, Array]:
    moments, shears = (np.array(part) for part in zip(*cases, strict=True))
    return moments, shears


def _uniform(z: Array, start: float, end: float) -> tuple[Array, Array]:
    """Moment and shear force, at z, of the part of a uniform unit load below z."""
    width = end - start
    below = np.clip(z - start, 0.0, width)
    return below / width * (z - start - 0.5 * below), below / width


def _from_free_end(z: Array, load: tuple[float, float], outwards: float) -> tuple[Array, Array]:
    ends = sorted((-outwards * load[0], -outwards * load[1]))
    return _uniform(-outwards * z, ends[0], ends[1])


def _work(moments: Array, shears: Array, bending: Array, shearing: Array) -> Array:
    return np.asarray((moments * bending) @ moments.T + (shears * shearing) @ shears.T)


def material_of(body: ElasticBody, default: Material) -> Material:
    """Return the material of a body, with the values of `default` where it states none."""
    changes = {"youngs_modulus": body.youngs_modulus, "poissons_ratio": body.poissons_ratio}
    return default.replace(**{name: value for name, value in changes.items() if value is not None})


def widths(pair: Pair, spacing: float | None) -> list[tuple[float, float]]:
    """Start and end of each disc's width along the axis, m, from the middle of all."""
    pitch, half = pair.face_width if spacing is None else spacing, 0.5 * pair.face_width
    middles = [(disc - 0.5 * (pair.discs - 1)) * pitch for disc in range(pair.discs)]
    return [(z - half, z + half) for z in middles]


class HeldBeam(NamedTuple):
    """A pin or output pin of one diameter, with the discs' widths on it.

    Attributes
    ----------
    beam
        The pin.
    ends, supports
        How and where it is held: see `Beam.compliance`.
    loads
        Start and end of each disc's width, m.
    diameter
        m.
    """

    beam: Beam
    ends: str
    supports: tuple[float, float]
    loads: list[tuple[float, float]]
    diameter: float

    def compliance(self) -> Array:
        """Displacement c_jl at disc j under a unit load of disc l, m/N."""
        return self.beam.compliance(self.ends, self.supports, self.loads)


def pin_beam(pair: Pair, body: PinBody, spacing: float | None) -> HeldBeam:
    """Return a pin of the ring, held at both ends, without its seats."""
    loads, span = widths(pair, spacing), body.span
    assert body.ends is not None
    assert span is not None
    _check_within(loads, -0.5 * span, 0.5 * span, "bodies.pin", f"span is {span * 1e3:.6g} mm")
    diameter = body.diameter or 2.0 * pair.pin_radius
    beam = Beam((Section(start=-0.5 * span, end=0.5 * span, diameter=diameter),), material_of(body, pair.material.pin))
    return HeldBeam(beam, body.ends, (-0.5 * span, 0.5 * span), loads, diameter)


def crank_compliance(pair: Pair, body: CrankBody, spacing: float | None) -> Array:
    """Displacement c_jl of a crank at disc j under a unit load of disc l, from the line through its bearings, m/N."""
    loads = widths(pair, spacing)
    assert body.bearings is not None
    assert body.sections is not None
    start, end = body.sections[0].start, body.sections[-1].end
    stated = f"sections reach from {start * 1e3:.6g} mm to {end * 1e3:.6g} mm"
    _check_within([*loads, body.bearings], start, end, "bodies.crank", stated)
    return Beam(body.sections, material_of(body, Material())).compliance("supported", body.bearings, loads)


def output_pin_beam(pair: Pair, body: OutputPinBody, spacing: float | None) -> HeldBeam:
    """Return an output pin, clamped in the carrier."""
    loads = widths(pair, spacing)
    start, end = body.start, body.end
    assert body.ends is not None
    assert start is not None
    assert end is not None
    assert body.diameter is not None
    low, high = sorted((start, end))
    stated = f"it reaches from {low * 1e3:.6g} mm to {high * 1e3:.6g} mm"
    _check_within(loads, low, high, "bodies.output_pin", stated)
    beam = Beam(
        (Section(start=low, end=high, diameter=body.diameter),), material_of(body, pair.material.of("output_pin"))
    )
    return HeldBeam(beam, body.ends, (start, end), loads, body.diameter)


def carrier_compliance(body: CarrierBody) -> tuple[float, float]:
    """Compliances of the carrier's columns for loads of the cranks: translation, m/N, and rotation, 1/(N·m).

    The displacement of the place p_k in the plate of the output under the forces f_l of cranks is the sum over l of
    (translation · I + rotation · (ẑ×p_k)(ẑ×p_l)ᵀ) f_l.
    """
    radius, length, across_radius, along_radius = (
        body.circle_radius,
        body.length,
        body.tangential_width,
        body.radial_width,
    )
    assert body.columns is not None
    assert body.share is not None
    assert radius is not None
    assert length is not None
    assert along_radius is not None
    assert across_radius is not None
    material = material_of(body, Material())
    young, shear = material.youngs_modulus, 0.5 * material.youngs_modulus / (1.0 + material.poissons_ratio)
    area = along_radius * across_radius

    def stiffness(along: float, across: float) -> float:
        inertia = across * along**3 / 12.0
        return 1.0 / (length**3 / (12.0 * young * inertia) + length / (_RECTANGLE * shear * area))

    radial = stiffness(along_radius, across_radius)
    tangential = stiffness(across_radius, along_radius)
    far = body.share**2 / body.columns
    return far / (0.5 * (radial + tangential)), far / (radius**2 * tangential)


def _check_within(loads: Sequence[tuple[float, float]], start: float, end: float, table: str, stated: str) -> None:
    low, high = min(load[0] for load in loads), max(load[1] for load in loads)
    if low < start - 1e-9 or high > end + 1e-9:
        need = f"discs and bearings need it from {low * 1e3:.6g} mm to {high * 1e3:.6g} mm"
        raise edge.InputError(f"[{table}] {stated}; {need}.")
