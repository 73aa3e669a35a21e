"""Figures of a drive on bearings: shares of compliance and lost motion, and bearing lives."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import edge
from cycloid_fmu.contact.transmission import Options, Transmission
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.bodies import Bodies
from cycloid_fmu.geometry.pair import LOST_MOTION_LOAD, Pair
from cycloid_fmu.geometry.supports import Bearing, OutputRoller, PinSeat, Supports
from cycloid_fmu.supports.assembly import bodies_of, kinds_of
from cycloid_fmu.supports.transmission import OnBearings, solve
from cycloid_fmu.surfaces.surface import nominal_surface

Array = NDArray[np.float64]
LOADS = (0.5, 1.0)  # of the rated torque, between which catalogues define the stiffness
_ANGLES = 90


@dataclass(frozen=True)
class Share:
    """Share of one part in the drive's compliance and lost motion.

    Attributes
    ----------
    part
        "mesh", "turning arms" and so on; "clearances" come last.
    compliance
        Contribution to the compliance between half and full rated torque, rad/(N·m), mean over the crank angles.
    lost_motion
        Contribution to the lost motion (GB/T 40731), rad, mean over the crank angles.
    """

    part: str
    compliance: float
    lost_motion: float


def remaining(supports: Supports, shares: Sequence[Share]) -> float:
    """Return the catalogue's compliance minus the model's, left for parts that are assumed rigid, rad/(N·m).

    It is below zero if the model is more compliant than the catalogue, and NaN without a catalogue's stiffness.
    """
    if supports.catalogue_stiffness is None:
        return math.nan
    return 1.0 / supports.catalogue_stiffness - sum(share.compliance for share in shares)


_BODIES = {
    "disc": "discs",
    "pin": "pins",
    "ring": "ring",
    "crank": "cranks",
    "carrier": "carrier",
    "output_pin": "output pins",
}


def _stages(supports: Supports, bodies: Bodies | None) -> list[tuple[str, Supports, Bodies | None]]:
    """Return supports and bodies with one part after the other made compliant, without clearances until the last."""
    tight = {
        name: value.replace(clearance=0.0)
        for name, value in ((n, getattr(supports, n)) for n in Supports.model_fields)
        if isinstance(value, Bearing | OutputRoller | PinSeat)
    }
    rigid = {"turning_arm": Bearing(), "crank_shaft": Bearing(), "main": Bearing(), "pin_seat": PinSeat()}
    if supports.output_roller is not None:
        rigid["output_roller"] = OutputRoller()
    names = {
        "turning_arm": "turning arms" if supports.kind == "cranks" else "eccentric bearing",
        "crank_shaft": "crank bearings",
        "main": "main bearing",
        "output_roller": "output rollers",
        "pin_seat": "pin seats",
    }
    stages, now = list[tuple[str, Supports, Bodies | None]](), supports.replace(**rigid)
    for part, name in names.items():
        if part in rigid:
            if tight[part] == rigid[part]:
                continue
            now = now.replace(**{part: tight[part]})
            stages.append((name, now, None))
    soft = None
    for part, name in _BODIES.items():
        if bodies is not None and (body := getattr(bodies, part)) is not None:
            soft = (soft or Bodies(disc_spacing=bodies.disc_spacing)).replace(**{part: body})
            stages.append((name, now, soft))
    if now != supports:
        stages.append(("clearances", supports, bodies))
    return stages


def compliance(pair: Pair, *, progress: Callable[[int], None] = lambda stages: None) -> list[Share]:
    """Return the shares of compliance and lost motion of a drive as drawn.

    The parts get their stiffness one after the other, starting with the mesh between rigid bodies; clearances come
    last.

    Parameters
    ----------
    pair
        A pair with supports and rated torque; stated errors and temperatures are ignored.
    progress
        Called after each part.

    Returns
    -------
    list of Share
        Their sums are the compliance and lost motion of the drive.

    Raises
    ------
    edge.InputError
        If the pair has no supports or no rated torque, or it can't be carried.
    """
    pair = pair.nominal.replace(temperature=None)
    if pair.supports is None:
        raise edge.InputError("the pair has no [supports]: its compliance is that of the mesh only.")
    if pair.rated_torque is None:
        raise edge.InputError("rated_torque is missing; the compliance is that between half and full rated torque.")
    angles = np.linspace(0.0, 2.0 * np.pi, _ANGLES, endpoint=False)
    loads = pair.rated_torque * np.array([*LOADS, LOST_MOTION_LOAD, -LOST_MOTION_LOAD])
    shares, soft, lost = [], 0.0, 0.0
    for name, supports, bodies in [("mesh", None, None), *_stages(pair.supports, pair.bodies)]:
        stated = pair.replace(supports=supports, bodies=bodies)
        swept = solve(DriveValue(stated, nominal_surface(stated)), loads, angles, Options(with_play=False))
        rotation = swept.transmission_error.mean(axis=1)
        now_soft, now_lost = (
            float((rotation[1] - rotation[0]) / (loads[1] - loads[0])),
            float(rotation[2] - rotation[3]),
        )
        shares.append(Share(name, now_soft - soft, now_lost - lost))
        soft, lost = now_soft, now_lost
        progress(1)
    return shares


@dataclass(frozen=True)
class BearingLoad:
    """Load of one bearing over a crank sweep.

    Attributes
    ----------
    bearing
        "turning arm, disc 0, crank 1" and so on.
    largest, equivalent
        Largest force, and the constant force with the same life, N.
    life
        Basic rating life L10 in crank turns (ISO 281); infinite without load, NaN without a load rating.
    exponent
        Of the load in its life: 3 for balls, 10/3 for rollers.
    """

    bearing: str
    largest: float
    equivalent: float
    life: float
    exponent: float = 10.0 / 3.0


def equivalent_load(force: ArrayLike, exponent: float = 10.0 / 3.0) -> Array:
    """Return the constant load with the same life as forces over equal steps of the crank (first axis), N.

    It is the mean of F^p to the power 1/p, with p = 10/3 for roller and 3 for ball bearings (ISO 281, constant speed).
    """
    return np.asarray(np.mean(np.asarray(force) ** exponent, axis=0) ** (1.0 / exponent))


def bearing_loads(pair: Pair, swept: Transmission, load: int = 0) -> list[BearingLoad]:
    """Return loads and lives of every bearing at one torque of a sweep over whole crank turns.

    Parameters
    ----------
    pair
        A pair with supports; each bearing's `dynamic_capacity` gives its life.
    swept
        Result of `solve`.
    load
        Index of the torque.
    """
    supports = pair.supports
    if supports is None:
        raise edge.InputError("the pair has no [supports]: it has no bearings to compute loads for.")
    assert isinstance(swept, OnBearings)
    arm = "turning arm" if supports.kind == "cranks" else "eccentric bearing"
    names = {"turning_arm": arm, "crank_shaft": "crank bearing", "main": "main bearing"}
    forces = {
        "turning_arm": swept.turning_arm_force,
        "crank_shaft": swept.crank_bearing_force,
        "main": swept.main_bearing_force,
    }
    numbered = ("disc", "crank") if supports.kind == "cranks" else ("disc",)
    rate, rows = bodies_of(pair)["rate"], []
    for kind in kinds_of(pair):
        if kind.name not in names:
            continue
        # Turns of the inner ring relative to the outer ring per crank turn.
        turns = np.broadcast_to(np.abs(rate[kind.outer] - rate[kind.inner]), kind.shape)
        bearing = getattr(supports, kind.name)
        capacity, exponent = bearing.dynamic_capacity, bearing.life_exponent
        for member in np.ndindex(kind.shape):
            force = forces[kind.name][(load, slice(None), *member)]
            equivalent, life = float(equivalent_load(force, exponent)), math.nan
            if capacity is not None:
                share = capacity / equivalent if equivalent > 0.0 else math.inf
                life = 1e6 * share**exponent / float(turns[member])
            numbers = [f"{axis} {i}" for axis, i in zip(kind.grid, member, strict=True) if axis in numbered]
            name = ", ".join([names[kind.name], *numbers])
            rows.append(BearingLoad(name, float(force.max()), equivalent, life, exponent))
    return rows


@dataclass(frozen=True)
class DutyLife:
    """Load and life of one bearing over a duty of several loads and speeds.

    Attributes
    ----------
    bearing
        As in `BearingLoad`.
    equivalent
        Constant load with the same life at the duty's mean speed, N; 0 at standstill.
    life
        Basic rating life L10h, s; infinite without load or at standstill, NaN without a load rating.
    """

    bearing: str
    equivalent: float
    life: float


def lives_over_duty(
    loads: Sequence[Sequence[BearingLoad]], crank_speed: Sequence[float], share: Sequence[float]
) -> list[DutyLife]:
    """Return every bearing's load and basic rating life over a duty.

    Damage accumulates linearly (Palmgren-Miner), which gives ISO 281's mean load for varying load and speed: P = (sum(q
    n P_i^p)/sum(q n))^(1/p), with each bearing's p, over shares q of time at speeds n. Modified lives (a_ISO) need the
    lubricant's viscosity and cleanliness, which no file states.

    Parameters
    ----------
    loads
        Result of `bearing_loads` for each row of the duty.
    crank_speed
        Crank speed of each row, rad/s, not below 0.
    share
        Share of the time of each row.
    """
    turning = np.asarray(crank_speed) * np.asarray(share) / (2.0 * math.pi)
    lives = []
    for rows in zip(*loads, strict=True):
        used = math.fsum(turns / row.life for turns, row in zip(turning, rows, strict=True) if turns > 0.0)
        equivalent = 0.0
        if turning.any():
            exponent = rows[0].exponent
            parts = turning @ np.array([row.equivalent**exponent for row in rows])
            equivalent = float((parts / turning.sum()) ** (1.0 / exponent))
        life = math.nan if math.isnan(rows[0].life) else math.inf if used == 0.0 else 1.0 / used
        lives.append(DutyLife(rows[0].bearing, equivalent, life))
    return lives
