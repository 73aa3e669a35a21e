"""The kinds of joints of a drive, from its file to the list that the kernels take, and back."""

from __future__ import annotations

import functools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu.bodies.matrices import BodyMatrices, matrices_of
from cycloid_fmu.errors.kinds import EACH_SUPPORT
from cycloid_fmu.geometry import supports as stated
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.supports.bearing import LAW, RIGID, Law, linear, rollers
from cycloid_fmu.supports.influence import influence_of
from cycloid_fmu.supports.joints import (
    BODY,
    CARRIER,
    FIRST_DISC,
    FIRST_DISC_BODY,
    HOUSING,
    JOINT,
    Assembly,
)
from cycloid_fmu.supports.ports import ALONG_X, PIN, PORT, ROLLER, SECTOR, Elastic
from cycloid_fmu.supports.sensitivity import CLEARANCE, PARAMETERS, STIFFNESS
from cycloid_fmu.surfaces.structured import displacement_layout

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Kind:
    """A kind of joint: joints of one law, one at each place of a grid.

    Attributes
    ----------
    name, law
        Its table in a file's `[supports]`, and its law.
    grid
        Number of joints along each axis, such as {"disc": 2, "crank": 3}.
    outer, inner
        Numbers of the two bodies, as those of `BODY`'s records.
    values
        Fields of `JOINT`'s records that are not zero as drawn.
    errors
        Displacements (`surfaces.structured.displacement_layout`) that add to each field.
    """

    name: str
    law: Law
    grid: Mapping[str, int]
    outer: NDArray[np.int64] | int
    inner: NDArray[np.int64] | int
    values: Mapping[str, ArrayLike] = field(default_factory=dict)
    errors: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of results and errors."""
        return tuple(self.grid.values())

    @property
    def size(self) -> int:
        """Number of joints."""
        return math.prod(self.shape)


def _law(supports: stated.Supports, name: str) -> Law:
    part = getattr(supports, name) or stated.OutputRoller()
    if isinstance(part, stated.Bearing) and part.rollers is not None and part.roller_length is not None:
        return rollers(part.rollers, part.roller_length, part.clearance)
    return linear(RIGID if part.stiffness is None else part.stiffness, part.clearance)


@functools.lru_cache(maxsize=16)
def kinds_of(pair: Pair) -> tuple[Kind, ...]:
    """Return the kinds of joints of a pair with supports, as drawn."""
    supports = pair.supports
    assert supports is not None
    discs, cranks, count = pair.discs, supports.cranks, supports.count
    has_cranks = supports.kind == "cranks"
    disc, crank = FIRST_DISC_BODY + np.arange(discs)[:, None], FIRST_DISC_BODY + discs + np.arange(cranks)
    angle = supports.first_angle + 2.0 * np.pi * np.arange(count) / count
    positions = {
        "place_x": supports.circle_radius * np.cos(angle),
        "place_y": supports.circle_radius * np.sin(angle),
    }
    of_places = {
        "outer_x": ("hole_x",),
        "outer_y": ("hole_y",),
        "inner_x": ("carrier_x",),
        "inner_y": ("carrier_y",),
    }
    of_eccentrics = {"throw": ("eccentric_throw", "crank_throw"), "phase": ("eccentric_phase",)}
    seats = {"outer_x": ("centre_x",), "outer_y": ("centre_y",)}
    return (
        Kind(
            "turning_arm",
            _law(supports, "turning_arm"),
            {"disc": discs, "crank": cranks},
            disc,
            crank,
            {**(positions if has_cranks else {}), "eccentricity": pair.eccentricity},
            {**(of_places if has_cranks else {}), **of_eccentrics},
        ),
        Kind(
            "crank_shaft",
            _law(supports, "crank_shaft"),
            {"crank": cranks},
            CARRIER if has_cranks else HOUSING,
            crank,
            errors={} if has_cranks else seats,
        ),
        Kind("main", _law(supports, "main"), {}, HOUSING, CARRIER, errors=seats),
        Kind(
            "output_roller",
            _law(supports, "output_roller"),
            {"disc": discs, "roller": 0 if has_cranks else count},
            disc,
            CARRIER,
            {} if has_cranks else {**positions, "reach": pair.eccentricity},
            {} if has_cranks else {**of_places, "play": ("hole_play",)},
        ),
    )


def bodies_of(pair: Pair) -> NDArray[np.void]:
    """Return housing, carrier, discs and cranks of a pair with supports, as `BODY`'s records."""
    assert pair.supports is not None
    rate, first_crank = -1.0 / pair.gear_teeth, FIRST_DISC + 3 * pair.discs
    carried = CARRIER if pair.supports.kind == "cranks" else HOUSING
    bodies = [(-1, -1, -1, 0.0, 0.0), (1, 0, -1, rate, 0.0)]
    for disc in range(pair.discs):
        first = FIRST_DISC + 3 * disc
        bodies.append((first, first + 2, -1, rate, 2.0 * np.pi * disc / pair.discs))
    bodies += [(first_crank + 2 * crank, -1, carried, 1.0, 0.0) for crank in range(pair.supports.cranks)]
    return np.array(bodies, BODY)


def joint_list(
    pair: Pair, kinds: Sequence[Kind], displacements: Mapping[str, Any], elastic: Elastic | None = None
) -> Assembly:
    """Return the joints of a pair for the kernels.

    Parameters
    ----------
    pair
        The pair at its temperatures, with supports.
    kinds
        The kinds of joints, such as `kinds_of` this pair.
    displacements
        Displacements by errors and temperatures, as of `surfaces.structured.displacements`.
    elastic
        Elastic bodies, of `elastic_of`.

    Raises
    ------
    ValueError
        If a joint off the centre connects bodies that do not rotate alike.
    """
    bodies, joints = bodies_of(pair), np.zeros(sum(kind.size for kind in kinds), JOINT)
    for law, (kind, each) in enumerate(by_kind(kinds, joints)):
        each["law"], each["outer"], each["inner"] = law, kind.outer, kind.inner
        for name, value in kind.values.items():
            each[name] = value
        for name, errors in kind.errors.items():
            for error in errors:
                each[name] += displacements[error]
    laws = np.array([tuple(kind.law) for kind in kinds], LAW)
    on = bodies["on"][joints["inner"]]
    joints["seat"] = np.where(on >= 0, on, joints["inner"])
    apart = bodies["rate"][joints["outer"]] != bodies["rate"][joints["seat"]]
    if (joints["place_x"][apart] != 0.0).any() or (joints["place_y"][apart] != 0.0).any():
        raise ValueError("place_x and place_y must be 0 for a joint of bodies that do not rotate alike")
    throw, phase = joints["throw"], joints["phase"]
    # From small terms: (e + de) cos ψ - e.
    joints["throw_along"] = throw * np.cos(phase) - 2.0 * joints["eccentricity"] * np.sin(0.5 * phase) ** 2
    joints["throw_across"] = (joints["eccentricity"] + throw) * np.sin(phase)
    rigid = RIGID in laws["stiffness"][joints["law"]]
    mesh = pair.face_width / (pair.material.gear.compliance + pair.material.pin.compliance)
    # Rounding of a rotation moves a crank by 1e-19 m, rounding of a gap is 1e-17 m.
    balanced = max(1e-3 if rigid else 1e-7, 1e-17 * mesh)
    if elastic is not None:
        # Ports are balanced to 2e-14 m.
        balanced = max(balanced, 2e-5)
    return Assembly(bodies, joints, laws, pair.pin_circle_radius, balanced, elastic)


def is_elastic(pair: Pair) -> bool:
    """Whether a pair has elastic bodies, or half-shell seats, which are solved with them."""
    supports = pair.supports
    return supports is not None and (pair.bodies is not None or supports.pin_seat.kind is not None)


@functools.lru_cache(maxsize=64)
def as_drawn(pair: Pair) -> Pair:
    """Return what the elastic bodies of a pair depend on: it, without errors, temperatures, losses and modification."""
    return pair.nominal.replace(temperature=None, losses=None, thermal=None, isometric=0.0, offset=0.0)


@functools.lru_cache(maxsize=4)
def elastic_of(pair: Pair) -> Elastic | None:
    """Return the elastic bodies of a pair as drawn, with those seats that only they compute; None if all are rigid."""
    supports = pair.supports
    assert supports is not None
    bodies = pair.bodies
    seat = supports.pin_seat
    if not is_elastic(pair):
        return None
    matrices = BodyMatrices() if bodies is None else matrices_of(pair, bodies)
    influence = influence_of(pair, matrices)
    kinds = kinds_of(pair)
    elastic = {
        "turning_arm": bool(matrices.discs) or matrices.crank is not None,
        "crank_shaft": matrices.carrier is not None,
        "output_roller": bool(matrices.discs) or matrices.output_pin is not None,
    }
    slots = {"turning_arm": influence.arms_slot, "output_roller": influence.rollers_slot}
    slots["crank_shaft"] = len(influence.fixed) - 2 * influence.arms
    groups = list[tuple[int, int, list[tuple[float, ...]]]]()  # disc, joint or -1, ports
    count, joints = list[int](), 0
    for number, kind in enumerate(kinds):
        each = 0 if not elastic.get(kind.name) else 1 if kind.name == "output_roller" else 2
        if each == 2 and kind.name == "turning_arm":
            each = influence.sectors
        for member in range(kind.size):
            disc = member // kind.shape[1] if "disc" in kind.grid else pair.discs
            block, slot = 0 if influence.coupled else disc, slots.get(kind.name, 0) + member * each
            ports = [_port(kind, number, joints, slot + n, n, each, block) for n in range(each)]
            groups.append((disc, joints, ports))
            count.append(each)
            joints += 1
    rows = 2 * pair.pins
    for row in range(rows * pair.discs):
        disc = row // rows
        values = {"kind": PIN, "joint": row, "slot": row // 2, "block": 0 if influence.coupled else disc}
        groups.append((disc, -1, [_record(values)]))
    groups.sort(key=lambda group: group[0])
    first, of_row = np.zeros(joints, np.int64), np.zeros(rows * pair.discs, np.int64)
    whole = list[tuple[float, ...]]()
    for _, joint, ports in groups:
        if joint >= 0:
            first[joint] = len(whole)
        else:
            of_row[int(ports[0][_FIELDS.index("joint")])] = len(whole)
        whole += ports
    return Elastic(
        influence,
        np.array(whole, PORT),
        of_row,
        first,
        np.array(count, np.int64),
        matrices.discs[0].matrix.patch_half_width if matrices.discs else 0.0,
        seat.clearance if seat.kind == "half_shell" else math.nan,
    )


_FIELDS = list(PORT.names or ())


def _record(values: Mapping[str, float]) -> tuple[float, ...]:
    return tuple(values.get(name, 0) for name in _FIELDS)


def _port(kind: Kind, law: int, joint: int, slot: int, number: int, count: int, block: int) -> tuple[float, ...]:
    """Return the record of one of a joint's ports."""
    values: dict[str, float] = {"slot": slot, "joint": joint, "law": law, "block": block}
    half = kind.law.half_clearance
    if count == 1:
        values |= {"kind": ROLLER, "clearance": half, "scale": kind.law.stiffness, "exponent": 1.0}
    elif count == 2:
        values |= {"kind": ALONG_X + number, "along_x": 1.0 - number, "along_y": float(number)}
    else:
        angle = 2.0 * math.pi * number / count
        values |= {"kind": SECTOR, "along_x": math.cos(angle), "along_y": math.sin(angle), "clearance": half}
        values |= {"scale": kind.law.stiffness * 2.0 * math.pi / count, "exponent": kind.law.exponent}
    return _record(values)


def by_kind(kinds: Sequence[Kind], values: NDArray[Any], axis: int = -1) -> Iterator[tuple[Kind, NDArray[Any]]]:
    """Yield each kind with a view of its part of an axis of joints, which becomes axes of its grid."""
    axis, start = axis % values.ndim, 0
    before, after, here = values.shape[:axis], values.shape[axis + 1 :], (slice(None),) * axis
    for kind in kinds:
        shape = kind.shape
        end = start + math.prod(shape)
        yield kind, values[(*here, slice(start, end))].reshape((*before, *shape, *after))
        start = end


@functools.lru_cache(maxsize=16)
def _displaced(pair: Pair) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return which of all joints' parameters are displaced, and the displacements that do so."""
    layout, kinds = displacement_layout(pair), kinds_of(pair)
    numbers = np.arange(sum(kind.size for kind in kinds) * len(PARAMETERS)).reshape(-1, len(PARAMETERS))
    parameters, columns = [], []
    for kind, each in by_kind(kinds, numbers, axis=0):
        for name, errors in kind.errors.items():
            for error in errors:
                shape = pair.places[EACH_SUPPORT[error]] if error in EACH_SUPPORT else ()
                column = np.arange(layout[error].start, layout[error].stop).reshape(shape)
                columns.append(np.broadcast_to(column, kind.shape).ravel())
                parameters.append(each[..., PARAMETERS.index(name)].ravel())
    return np.concatenate(parameters), np.concatenate(columns)


def add_by_displacements(pair: Pair, by_joint: Array, out: Array) -> Array:
    """Add the joints' derivatives to those by all displacements; return those by the laws.

    Parameters
    ----------
    by_joint
        Derivatives by the `sensitivity.PARAMETERS` of each joint of the pair, shape (angles, joints, parameters).
    out
        Derivatives by displacements, shape (angles, displacements).

    Returns
    -------
    Array
        Derivatives by the logarithm of each kind's stiffness (rad) and by its clearance (rad/m), shape (angles, 2 ·
        kinds).
    """
    parameters, columns = _displaced(pair)
    np.add.at(out.T, columns, by_joint.reshape(len(by_joint), -1)[:, parameters].T)
    laws = by_joint[..., [STIFFNESS, CLEARANCE]]
    each = [law.reshape(len(law), -1, 2).sum(axis=1) for _, law in by_kind(kinds_of(pair), laws, axis=1)]
    return np.concatenate(each, axis=1)
