"""Influence matrices of all elastic bodies of a drive: computed once and stored by what they depend on, or read."""

from __future__ import annotations

import dataclasses
import functools
import io
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.bodies.beams import (
    carrier_compliance,
    crank_compliance,
    material_of,
    output_pin_beam,
    pin_beam,
)
from cycloid_fmu.bodies.given import read_influence
from cycloid_fmu.bodies.mesh import Array
from cycloid_fmu.bodies.outline import contradictions
from cycloid_fmu.bodies.ports import PortMatrix
from cycloid_fmu.geometry.bodies import Bodies, CarrierBody, DiscBody, ElasticBody, RingBody
from cycloid_fmu.geometry.pair import Pair

if TYPE_CHECKING:
    from cycloid_fmu.bodies.disc import DiscInfluence

_PACKAGE = Path(__file__).parents[1]
_MAKERS = ("bodies", "geometry/profile.py")
_MOST_BYTES = 400_000_000  # of all matrices in the cache
_LEAST_RING = 0.5  # radial thickness of a ring over the pin radius


@dataclass(frozen=True, eq=False)
class BodyMatrices:
    """Influence matrices of a drive's bodies; None for those that are rigid.

    Attributes
    ----------
    discs
        Each disc's, between fixed ports; empty if the discs are rigid.
    pin, crank, output_pin
        Displacement c_jl at disc j under a unit force of disc l, shape (discs, discs), m/N.
    carrier
        Displacements along x and y of the place of each crank, in turn, shape (2 cranks, 2 cranks), m/N.
    columns
        The carrier's `translation`, m/N, and `rotation`, 1/(N·m), if they are computed
        (`cycloid_fmu.bodies.beams.carrier_compliance`).
    ring
        Displacements along x and y of each pin's seat, in turn, shape (2 pins, 2 pins), m/N.
    """

    discs: tuple[DiscInfluence, ...] = ()
    pin: Array | None = None
    crank: Array | None = None
    output_pin: Array | None = None
    carrier: Array | None = None
    columns: Mapping[str, float] = field(default_factory=dict)
    ring: Array | None = None


def port_matrices(matrices: BodyMatrices) -> dict[str, tuple[PortMatrix, ...]]:
    """Return the matrices of a drive's bodies with their ports, as files have them, by the bodies' names."""

    def held(compliance: Array, kind: str, components: int) -> PortMatrix:
        count = len(compliance) // components
        index, direction = np.repeat(np.arange(count), components), np.tile([1.0, 1j][:components], count)
        return PortMatrix(np.repeat(kind, index.size), index, 0j * direction, direction, compliance, "held")

    kinds = {"pin": ("plane", 1), "crank": ("plane", 1), "output_pin": ("plane", 1)}
    kinds |= {"carrier": ("bore", 2), "ring": ("seat", 2)}
    stated = {"disc": tuple(disc.matrix for disc in matrices.discs)}
    stated |= {n: (held(c, *k),) for n, k in kinds.items() if (c := getattr(matrices, n)) is not None}
    return {name: each for name, each in stated.items() if each}


def check_bodies(pair: Pair, bodies: Bodies, source: str) -> None:
    """Raise an `edge.InputError` with a sentence for each reason why a pair can't have these bodies."""
    supports, reasons = pair.supports, list[str]()
    if supports is None:
        raise edge.InputError(f"{source}: [bodies] needs [supports]: what bears the discs also loads them.")
    cranks = supports.kind == "cranks"
    alien = ("output_pin" if cranks else "carrier") if getattr(bodies, "output_pin" if cranks else "carrier") else None
    if alien:
        reasons.append(f'[bodies.{alien}] belongs to kind = "{"output_rollers" if cranks else "cranks"}"')
    if (body := bodies.disc) is not None and body.matrix is None:
        alien = "roller_hole_radius" if cranks else "centre_radius"
        if getattr(body, alien) is not None:
            reasons.append(f'[bodies.disc] {alien} belongs to kind = "{"output_rollers" if cranks else "cranks"}"')
        elif not cranks and body.roller_hole_radius is None:
            reasons.append("[bodies.disc] roller_hole_radius is missing; the output rollers need it")
        else:
            reasons += [f"[bodies.disc] {sentence}" for sentence in contradictions(pair, body)]
    if body is not None and body.matrix is not None and len(body.matrices) != pair.discs:
        reasons.append(
            f"[bodies.disc] matrix has {len(body.matrices)} files; each of {pair.discs} discs has its own: its teeth "
            "stand differently on its holes"
        )
    if (ring := bodies.ring) is not None and ring.outer_radius is not None:
        least = pair.pin_circle_radius + _LEAST_RING * pair.pin_radius
        if ring.outer_radius < least:
            reasons.append(
                f"[bodies.ring] outer_radius is {ring.outer_radius * 1e3:.6g} mm; around the pins it must be "
                f"at least {least * 1e3:.6g} mm"
            )
    spacing = bodies.disc_spacing
    if spacing is not None and spacing < pair.face_width * (1.0 - 1e-9):
        reasons.append(
            f"[bodies] disc_spacing is {spacing * 1e3:.6g} mm; discs {pair.face_width * 1e3:.6g} mm wide need as much"
        )
    if reasons:
        raise edge.InputError("\n".join(f"{source}: {reason}." for reason in reasons))
    _ = [_beam(pair, bodies, name, source) for name in ("pin", "crank", "output_pin")]


def matrices_of(
    pair: Pair,
    bodies: Bodies,
    source: str = "bodies",
    *,
    total: Callable[[int], None] = lambda loads: None,
    progress: Callable[[int], None] = lambda loads: None,
) -> BodyMatrices:
    """Return the influence matrices of a drive's bodies: from files, from the cache, or computed and then stored.

    Parameters
    ----------
    pair, bodies
        The pair with its supports, and the bodies.
    source
        Name of the file with the bodies, for messages.
    total, progress
        Called with the number of unit loads of all discs, and with the number that were just solved.

    Raises
    ------
    edge.InputError
        If the bodies contradict the pair or each other, a file's matrix is wrong, or scikit-fem is not installed, which
        discs without a matrix need.
    """
    check_bodies(pair, bodies, source)
    others: dict[str, Array | None] = {
        "carrier": None if bodies.carrier is None else _carrier(pair, bodies.carrier),
        "ring": None if bodies.ring is None else _ring(pair, bodies.ring),
        **{name: _beam(pair, bodies, name, source) for name in ("pin", "crank", "output_pin")},
    }
    return BodyMatrices(
        discs=_discs(pair, bodies.disc, source, total, progress) if bodies.disc is not None else (),
        columns=_columns(bodies.carrier),
        **{n: None if m is None else m * getattr(bodies, n).compliance_factor for n, m in others.items()},
    )


def influence(matrices: BodyMatrices, crank_angle: float = 0.0, disc: int = 0) -> dict[str, Any]:
    """Return the influence of a drive's bodies at a crank angle, m/N, as `Drive.influence` describes it."""
    result: dict[str, Any] = {}
    if matrices.discs:
        stated = matrices.discs[disc]
        whole, pins = stated.at(crank_angle), stated.pair.pins
        arms = stated.matrix.of("bore").size
        teeth = whole[:pins, :pins]
        result["disc"] = {"crank_angle": crank_angle, "teeth": teeth, **_norms(teeth), "self": teeth.diagonal()}
        result["disc"]["bores"] = whole[pins : pins + arms, pins : pins + arms]
        result["disc"]["rollers"] = whole[pins + arms :, pins + arms :]
        result["disc"]["compliance"] = whole
    for name in ("pin", "crank", "output_pin"):
        if (matrix := getattr(matrices, name)) is not None:
            result[name] = matrix
    if matrices.ring is not None:
        result["ring"] = {"compliance": matrices.ring, **_norms(matrices.ring)}
    if matrices.carrier is not None:
        result["carrier"] = {"compliance": matrices.carrier, **matrices.columns}
    return result


def _norms(matrix: Array) -> dict[str, float]:
    return {"frobenius": float(np.linalg.norm(matrix)), "spectral": float(np.linalg.norm(matrix, 2))}


def _half_width(pair: Pair) -> float:
    from cycloid_fmu.bodies.disc import PATCH

    return PATCH * pair.pin_radius


def _discs(
    pair: Pair, body: DiscBody, source: str, total: Callable[[int], None], progress: Callable[[int], None]
) -> tuple[DiscInfluence, ...]:
    from cycloid_fmu.bodies.disc import influence_of, loads_of

    if body.matrix is not None:
        given = [_scaled(body, read_influence(path, _half_width(pair))) for path in body.matrices]
        return tuple(influence_of(pair, j, m, p) for j, (m, p) in enumerate(zip(given, body.matrices, strict=True)))
    total(loads_of(pair) * pair.discs)
    influences = []
    for disc in range(pair.discs):
        try:
            matrix = edge.cached(
                "influence",
                f"disc {disc} {_disc_text(pair, body)} {_makers()}",
                functools.partial(_condense, pair, body, disc, progress),
                write=_written,
                read=_read,
                most_bytes=_MOST_BYTES,
            )
        except edge.InputError as problem:
            raise edge.InputError(f"{source}: [bodies.disc]: {problem}") from None
        influences.append(influence_of(pair, disc, _scaled(body, matrix), "the disc"))
    return tuple(influences)


def _scaled(body: DiscBody, matrix: PortMatrix) -> PortMatrix:
    return dataclasses.replace(matrix, compliance=matrix.compliance * body.compliance_factor)


def _condense(pair: Pair, body: DiscBody, disc: int, progress: Callable[[int], None]) -> PortMatrix:
    from cycloid_fmu.bodies.disc import condensed, loads_of

    with edge.making(f"unit loads of elastic disc {disc}", loads_of(pair)) as advance:

        def solved(loads: int) -> None:
            advance(loads)
            progress(loads)

        return condensed(pair, body, disc, solved)


def _disc_text(pair: Pair, body: DiscBody) -> str:
    """Everything that the matrix of a disc depends on."""
    from cycloid_fmu.bodies.outline import true_flank

    supports, true = pair.supports, true_flank(pair)
    assert supports is not None
    drawn = {
        "pair": [
            true.gear_teeth,
            true.pin_circle_radius,
            true.pin_radius,
            true.eccentricity,
            true.face_width,
            true.discs,
        ],
        "supports": [supports.kind, supports.count, supports.circle_radius, supports.first_angle],
        "material": material_of(body, pair.material.gear).model_dump(),
        "body": body.model_dump(exclude={*ElasticBody.model_fields}),
        "files": [Path(w.dxf).read_bytes().hex() for w in body.windows if w.dxf is not None],
    }
    return json.dumps(drawn, sort_keys=True)


@functools.cache
def _makers() -> str:
    """Hash of the code that makes matrices."""
    return edge.hash_of_code(_PACKAGE / name for name in _MAKERS)


def _written(matrix: PortMatrix) -> bytes:
    file = io.BytesIO()
    np.savez(file, allow_pickle=False, **vars(matrix))
    return file.getvalue()


def _read(data: bytes) -> PortMatrix:
    with np.load(io.BytesIO(data), allow_pickle=False) as file:
        values = {name: file[name] for name in file.files}
    gauge, width = str(values.pop("gauge")), float(values.pop("patch_half_width"))
    return PortMatrix(**values, gauge="free" if gauge == "free" else "held", patch_half_width=width)


_BEAMS: dict[str, Callable[..., Array]] = {
    "pin": lambda *given: pin_beam(*given).compliance(),
    "crank": crank_compliance,
    "output_pin": lambda *given: output_pin_beam(*given).compliance(),
}


def _beam(pair: Pair, bodies: Bodies, name: str, source: str) -> Array | None:
    body: ElasticBody | None = getattr(bodies, name)
    if body is None:
        return None
    if body.matrix is not None:
        return _given(body.matrix, "plane", pair.discs, 1, pair)
    try:
        return _BEAMS[name](pair, body, bodies.disc_spacing)
    except edge.InputError as problem:
        raise edge.InputError(f"{source}: {problem}") from None


def _given(path: str, kind: str, count: int, components: int, pair: Pair) -> Array:
    """Return the matrix of a file, its ports ordered by their index, and along x and y if there are two components."""
    matrix = read_influence(path, _half_width(pair))
    ports = matrix.of(kind)
    order = ports[np.lexsort((np.abs(matrix.direction[ports].imag), matrix.index[ports]))]
    if not np.array_equal(matrix.index[order], np.repeat(np.arange(count), components)):
        each = "one port" if components == 1 else "a port along x and one along y"
        raise edge.InputError(f'{path}: it needs {each} of kind "{kind}" for each index from 0 to {count - 1}.')
    if components == 2 and not np.allclose(matrix.direction[order], np.tile([1.0, 1j], count), atol=1e-6):
        raise edge.InputError(f'{path}: the ports of kind "{kind}" must have the directions (1, 0) and (0, 1).')
    return np.asarray(matrix.compliance[np.ix_(order, order)])


def _columns(body: CarrierBody | None) -> dict[str, float]:
    if body is None or body.matrix is not None:
        return {}
    compliance = (each * body.compliance_factor for each in carrier_compliance(body))
    return dict(zip(("translation", "rotation"), compliance, strict=True))


def _carrier(pair: Pair, body: CarrierBody) -> Array:
    assert pair.supports is not None
    count = pair.supports.count
    if body.matrix is not None:
        return _given(body.matrix, "bore", count, 2, pair)
    translation, rotation = carrier_compliance(body)
    angle = pair.supports.first_angle + 2.0 * math.pi * np.arange(count) / count
    turning = pair.supports.circle_radius * np.column_stack([-np.sin(angle), np.cos(angle)]).ravel()
    return np.asarray(translation * np.tile(np.eye(2), (count, count)) + rotation * np.outer(turning, turning))


def _ring(pair: Pair, body: RingBody) -> Array:
    if body.matrix is not None:
        return _given(body.matrix, "seat", pair.pins, 2, pair)
    from cycloid_fmu.bodies.ring import annulus_influence

    assert body.outer_radius is not None
    assert body.width is not None
    material = material_of(body, pair.material.of("ring"))
    return annulus_influence(
        pair.pin_circle_radius, body.outer_radius, body.width, material, pair.pin_radius, pair.pins
    )
