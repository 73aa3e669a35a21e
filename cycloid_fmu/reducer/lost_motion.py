"""Lost motion budget of an RV reducer: involute first stage, cycloid stage and crank bearings.

Source: Liu et al., "Analysis of the coaxiality-geometric hysteresis model of a rotate vector reducer" (2022), called
the RV paper below; docs/theory/reducer.md states which of its equations hold. Plays are two-sided, in radians at the
output, > 0 for clearance.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import contact
from cycloid_fmu.contact.transmission import Options, mesh_of
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import ARCMIN
from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.supports import Bearing
from cycloid_fmu.reducer.description import Reducer, Stated, surface_of_reducer, values_of
from cycloid_fmu.supports.transmission import solve
from cycloid_fmu.surfaces.surface import ErrorSurface

Array = NDArray[np.float64]
Variant = Literal["standard", "as_printed", "geometric", "geometric_sun_locked"]
VARIANTS: tuple[Variant, ...] = ("standard", "as_printed", "geometric", "geometric_sun_locked")
STAGES = ("involute", "cycloid", "bearings")
# A term of the closed form counts as contradicted if the contact model differs by more than this share of it.
_AGREES = 0.05
_STIFF = 1e9  # N/m: stiffness of a rigid turning arm; the play does not depend on it
_STAGE_OF = {"base_tangent_length": "involute", "crank_bearing_clearance": "bearings"}
TERMS = {
    "base_tangent_length": "thinner sun teeth: base tangent length below that without play",
    "isometric_modification": "isometric modification",
    "offset_modification": "offset modification",
    "pin_circle_radius": "larger pin circle",
    "pin_radius": "thicker pins",
    "pin_hole_clearance": "diametral clearance of the pins in their holes",
    "gear_runout": "radial runout of the cycloid gear's teeth",
    "pin_tangential": "circumferential position error of the pins",
    "tooth_cumulative_pitch": "cumulative pitch error of the cycloid gear",
    "isometric": "error of the isometric modification",
    "offset": "error of the offset modification",
    "eccentricity": "longer crank",
    "crank_bearing_clearance": "diametral clearance of the crank bearings",
}


def shaft_tilt(displacement: ArrayLike, length: float) -> Array:
    """Return the tilt of a shaft with a radially displaced end, rad: β = arcsin(Y/L) (RV paper, equation 1).

    Parameters
    ----------
    displacement
        Displacement Y, any shape, m.
    length
        Length L of the shaft, m.
    """
    return np.asarray(np.arcsin(np.asarray(displacement, dtype=float) / length))


def _shortening(reducer: Reducer) -> float:
    g = reducer.stage
    return reducer.stated.shortening or g.eccentricity * g.pins / g.pin_circle_radius


def outer_stages(reducer: Reducer, values: Mapping[str, ArrayLike], sun_radius: float) -> dict[str, Array]:
    """Play of the first stage (deviation E_w) and of the crank bearings, rad (RV paper, equations 5 and 20)."""
    involute = reducer.involute
    lever = involute.crank_circle_radius + involute.shaft_displacement
    return {
        "base_tangent_length": -np.asarray(values["base_tangent_length"]) / (sun_radius * reducer.ratio),
        "crank_bearing_clearance": np.asarray(values["crank_bearing_clearance"])
        * math.cos(involute.shaft_tilt)
        / lever,
    }


def _stated_base_radius(reducer: Reducer) -> float:
    involute = reducer.involute
    pitch = reducer.stated.sun_pitch_radius or 0.5 * involute.module * involute.sun_teeth
    return pitch * math.cos(involute.pressure_angle)


def standard(reducer: Reducer, values: Mapping[str, ArrayLike]) -> dict[str, Array]:
    """Return the play due to each amount by the RV paper's closed forms with corrected typesetting, rad.

    With d = e z_c and s = sqrt(1 - K²) the cycloid stage is [2 ΔR_rp - 2 ΔR_p s + 2 δr_p s - 2 δr_rp + δJ + ΔF_r/2 +
    2 K δt - K ΔF_p + 2 δΔR_rp - 2 δΔR_p s]/d - 2 K_n δe with K_n = ΔR_rp/(e² z_c) - [z_p²/(z_c R_p² s) +
    s/(e² z_c)] ΔR_p (RV paper, equations 5, 16, 17 and 20; the printed K_n has wrong dimensions: docs/theory).

    Parameters
    ----------
    reducer
        The nominal reducer; stated numbers are used as stated.
    values
        Amount of each of `TERMS`, m, scalars or arrays of one shape.

    Returns
    -------
    terms
        {name: play, rad, in the shape of the values}.
    """
    g, k = reducer.stage, _shortening(reducer)
    s, d = math.sqrt(1.0 - k * k), g.eccentricity * g.gear_teeth
    v = {name: np.asarray(value, dtype=float) for name, value in values.items()}
    moving = v["isometric_modification"] / (g.eccentricity * d)
    moving = (
        moving
        - (g.pins**2 / (g.gear_teeth * g.pin_circle_radius**2 * s) + s / (g.eccentricity * d))
        * (v["offset_modification"])
    )
    return {
        **outer_stages(reducer, values, _stated_base_radius(reducer)),
        **{name: factor * v[name] / d for name, factor in _factors(k, s).items()},
        "eccentricity": -2.0 * moving * v["eccentricity"],
    }


def _factors(k: float, s: float) -> dict[str, float]:
    return {
        "isometric_modification": 2.0,
        "offset_modification": -2.0 * s,
        "pin_circle_radius": 2.0 * s,
        "pin_radius": -2.0,
        "pin_hole_clearance": 1.0,
        "gear_runout": 0.5,
        "pin_tangential": 2.0 * k,
        "tooth_cumulative_pitch": -k,
        "isometric": 2.0,
        "offset": -2.0 * s,
    }


def as_printed(reducer: Reducer, values: Mapping[str, ArrayLike]) -> dict[str, Array]:
    """Return the RV paper's equation 21 exactly as typeset, in millimetres, read as arcminutes; rad.

    The factor 10800/π and the root apply to the two modification terms only, all other terms of the cycloid stage are
    added in radians to arcminutes, and K_n is as printed. The pressure angle is nominal, because the forces from which
    the paper derives it are not published, and the bearings' term, which is printed twice, counts once.
    """
    g, k = reducer.stage, _shortening(reducer)
    s = math.sqrt(1.0 - k * k)
    mm = {name: 1e3 * np.asarray(value, dtype=float) for name, value in values.items()}
    e, circle = 1e3 * g.eccentricity, 1e3 * g.pin_circle_radius
    d = e * g.gear_teeth
    rooted = {"isometric_modification": 2.0 * s / d * ARCMIN, "offset_modification": -2.0 * s / d * ARCMIN}
    bare = {name: factor / d for name, factor in _factors(k, s).items() if name not in rooted}
    moving = mm["isometric_modification"] / (e * d)
    moving = moving - (g.gear_teeth / (e * circle**2 * s) + s / d) * mm["offset_modification"]
    return {
        **outer_stages(reducer, values, _stated_base_radius(reducer)),
        **{name: factor * mm[name] / ARCMIN for name, factor in {**rooted, **bare}.items()},
        "eccentricity": -2.0 * moving * mm["eccentricity"] / ARCMIN,
    }


@dataclasses.dataclass(frozen=True)
class Play:
    """The cycloid stage's play with the crank locked, over one output turn; arrays of shape (angles,).

    Attributes
    ----------
    backlash, interference
        Free rotation of the output, rad, 0 without a free position; interference, m, 0 with one.
    transmission_error
        Middle of the play, rad; NaN without a free position.
    """

    backlash: Array
    interference: Array
    transmission_error: Array


def contact_play(reducer: Reducer, surface: ErrorSurface, angles: int) -> Play:
    """Return the play of the contact model at a number of crank angles, evenly over one output turn.

    It is the play of the mesh between rigid bodies, whatever the supports. If the number of angles has no factor in
    common with the teeth, every tooth is at a different phase of the mesh.
    """
    teeth = reducer.stage.gear_teeth
    low, high, gap = np.empty(angles), np.empty(angles), np.empty(angles)
    crank = 2.0 * np.pi * teeth * np.arange(angles) / angles
    contact.sweep_play(mesh_of(DriveValue(reducer.stage, surface)), crank, 0, angles, low, high, gap)
    free = np.where(np.isnan(high), 0.0, high - low)
    return Play(free, gap, 0.5 * (low + high))


def geometric(reducer: Reducer) -> dict[str, float]:
    """Return the play by the contact model with the crank locked, and the effect of each amount.

    A term is the mean play minus the mean play without that amount. With interference there is no play to compare, so
    for the terms, not for the play, pins are thinned until the gear runs free; the play minus the sum of the terms is
    `interaction`. With the crank locked the first stage has no effect. The bearings' term is from the model with the
    stage's supports (`bearing_share`), without supports from the closed form.

    Returns
    -------
    budget
        {term: rad, "interaction", "involute", "cycloid", "bearings", "total": rad; "cycloid_smallest",
        "cycloid_largest": over the crank, rad; "transmission_error": peak to peak of the middle of the play, rad;
        "interference": m, the largest; "interfering": share of crank angles}.
    """
    values = values_of(reducer)
    angles = 10 * reducer.stage.gear_teeth + 1
    whole = contact_play(reducer, surface_of_reducer(reducer, values), angles)
    names = [n for n in TERMS if n not in _STAGE_OF]
    without = {n: surface_of_reducer(reducer, {**values, n: 0.0}) for n in names if values[n] != 0.0}
    surfaces = [surface_of_reducer(reducer, values), *without.values()]
    thinner = 0.0
    while True:
        thinned = [s.replace(pin_radius=s.pin_radius - thinner) for s in surfaces]
        plays = [contact_play(reducer, s, angles) for s in thinned]
        if all(p.interference.max() == 0.0 for p in plays):
            break
        thinner = max(2.0 * thinner, 5e-6)
    mean = [float(p.backlash.mean()) for p in plays]
    terms = dict.fromkeys(names, 0.0) | {n: mean[0] - m for n, m in zip(without, mean[1:], strict=True)}
    cycloid = float(whole.backlash.mean())
    bearings = float(outer_stages(reducer, values, reducer.involute.sun_base_radius)["crank_bearing_clearance"])
    bearings *= bearing_share(reducer, thinned[0]) if bearings != 0.0 else 1.0
    middle = whole.transmission_error[~np.isnan(whole.transmission_error)]
    return {
        "base_tangent_length": 0.0,
        **terms,
        "crank_bearing_clearance": bearings,
        "interaction": cycloid - sum(terms.values()),
        "involute": 0.0,
        "cycloid": cycloid,
        "bearings": bearings,
        "total": cycloid + bearings,
        "cycloid_smallest": float(whole.backlash.min()),
        "cycloid_largest": float(whole.backlash.max()),
        "transmission_error": float(np.ptp(middle)) if middle.size else math.nan,
        "interference": float(whole.interference.max()),
        "interfering": float(np.mean(whole.interference > 0.0)),
    }


def bearing_share(reducer: Reducer, surface: ErrorSurface) -> float:
    """Return the ratio of the play due to the crank bearings' clearance on the stage's supports to the closed form.

    The model's value is the mean play with this clearance in the turning arms minus that without it, with the crank
    locked and the other supports as stated; rigid turning arms are replaced by springs. 1 without supports.

    Raises
    ------
    edge.InputError
        If there are supports and no rated torque.
    """
    pair, supports, values = reducer.stage, reducer.stage.supports, values_of(reducer)
    if supports is None:
        return 1.0
    if values["crank_bearing_clearance"] <= 0.0:
        values["crank_bearing_clearance"] = 1e-6  # the play is proportional to the clearance
    arm = Bearing(stiffness=_STIFF) if supports.turning_arm.is_rigid else supports.turning_arm
    angles = 2 * pair.gear_teeth + 1
    crank = 2.0 * np.pi * pair.gear_teeth * np.arange(angles) / angles
    plays = []
    for clearance in (values["crank_bearing_clearance"], 0.0):
        held = pair.replace(supports=supports.replace(turning_arm=arm.replace(clearance=clearance)))
        plays.append(
            float(solve(DriveValue(held, surface.replace(pair=held)), np.zeros(0), crank, Options()).backlash.mean())
        )
    closed = outer_stages(reducer, values, reducer.involute.sun_base_radius)["crank_bearing_clearance"]
    return (plays[0] - plays[1]) / float(closed)


def with_sun_locked(reducer: Reducer, crank_locked: Mapping[str, float]) -> dict[str, float]:
    """Return the budget of `geometric` as a bench measures it, with the sun locked instead of the crank.

    The cranks then turn with the output, which reduces each play after them by the factor `Reducer.sun_locked`; the
    first stage's play is added, from the base tangent length at the sun's base circle.
    """
    kept = ("transmission_error", "interference", "interfering")
    found = {n: v if n in kept else reducer.sun_locked * v for n, v in crank_locked.items()}
    play = float(outer_stages(reducer, values_of(reducer), reducer.involute.sun_base_radius)["base_tangent_length"])
    found.update(base_tangent_length=play, involute=play, total=found["total"] + play)
    return found


def parts_of(reducer: Reducer) -> tuple[Pair, ErrorSurface, FirstStage]:
    """Return the parts of a reducer: its cycloid stage, the stage's errors and the first stage, as made.

    If the stage has compliant bearings, the clearance of the crank bearings is part of the turning arms; otherwise it
    is a play in series with the stage.
    """
    outer = outer_stages(reducer, values_of(reducer), reducer.involute.sun_base_radius)
    stage, involute, beside = reducer.stage, reducer.involute, float(outer["crank_bearing_clearance"])
    supports = stage.supports
    if supports is not None and not supports.turning_arm.is_rigid:
        arm = supports.turning_arm.replace(clearance=reducer.turning_arm_clearance)
        stage, beside = stage.replace(supports=supports.replace(turning_arm=arm)), 0.0
    return (
        stage,
        surface_of_reducer(reducer.replace(stage=stage)),
        FirstStage(
            sun_teeth=involute.sun_teeth,
            planet_teeth=involute.planet_teeth,
            sun_play=max(0.0, float(outer["base_tangent_length"]) * reducer.ratio),
            bearing_play=max(0.0, beside),
            crank_stiffness=(reducer.planets or 1) * involute.one_mesh * involute.planet_base_radius**2,
        ),
    )


def summed(terms: Mapping[str, Array]) -> dict[str, Array]:
    """Return the sums of the terms: the plays of the three stages and their total, rad."""
    stages = {
        stage: np.asarray(sum(v for n, v in terms.items() if _STAGE_OF.get(n, "cycloid") == stage)) for stage in STAGES
    }
    return {**stages, "total": np.asarray(sum(stages.values()))}


def budget(reducer: Reducer) -> dict[str, dict[str, float]]:
    """Return the lost motion budget in all `VARIANTS`: {variant: {term: rad, "involute", …, "total"}}.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> stage = cy.Pair(
    ...     gear_teeth=39, pin_circle_radius="52 mm", pin_radius="2 mm", eccentricity="0.9 mm", face_width="14 mm"
    ... )
    >>> reducer = cy.Reducer(
    ...     stage=stage, involute={"sun_teeth": 12, "planet_teeth": 42, "module": "1.5 mm"},
    ...     deviations={"pin_radius": "-4 um"},
    ... )
    >>> round(cy.budget(reducer)["standard"]["total"] * cy.ARCMIN, 3)
    0.784
    """
    values = values_of(reducer)
    found = {}
    for variant, closed in (("standard", standard), ("as_printed", as_printed)):
        terms = closed(reducer, values)
        found[variant] = {n: float(terms[n]) for n in TERMS} | {n: float(v) for n, v in summed(terms).items()}
    found["geometric"] = geometric(reducer)
    found["geometric_sun_locked"] = with_sun_locked(reducer, found["geometric"])
    return found


def remarks(reducer: Reducer, found: Mapping[str, Mapping[str, float]]) -> dict[str, str]:
    """Return a sentence for each term of the closed form that the contact model contradicts, {term: sentence}."""
    closed, exact = found["standard"], found["geometric"]
    values = values_of(reducer)
    unstated = standard(reducer.replace(stated=Stated()), values)
    said = {}
    modelled = {"crank_bearing_clearance"} if reducer.stage.supports is not None else set[str]()
    for name in (n for n in TERMS if n not in _STAGE_OF or n in modelled):
        a, b = closed[name], exact[name]
        if abs(a - b) <= _AGREES * abs(a) + 1e-9:
            continue
        text = f"the contact model gives {b * ARCMIN:+.4f}′"
        if name in modelled:
            text += " on the stage's bearings: with their clearance the discs can shift as well as turn"
        elif name == "gear_runout":
            swing = runout_error(reducer, values[name]) * ARCMIN
            text += f": as an eccentricity it causes transmission error, {swing:.3f}′ peak to peak, not play"
        elif name == "tooth_cumulative_pitch":
            text += ": the closed form is only an upper bound"
        elif name == "eccentricity":
            text += ": a second-order effect that reduces the play for either sign"
        elif a * b < 0.0:
            text += ": opposite sign"
        else:
            alone = play_alone(reducer, name, values[name])
            text += f", and {alone * ARCMIN:+.4f}′ as the only deviation"
            if abs(a - unstated[name]) > 0.5 * abs(a - alone):
                text += f" (closed form with the shortening of the pin circle radius: {unstated[name] * ARCMIN:+.4f}′)"
        said[name] = text
    return said


def play_alone(reducer: Reducer, name: str, amount: float) -> float:
    """Return the effect of an amount (m) of one of `TERMS` on the mean play of a nominal, unmodified stage, rad.

    Pins are 20 µm, or twice the amount, thinner, so that the gear runs free.
    """
    room = max(20e-6, 2.0 * abs(amount))
    angles = 10 * reducer.stage.gear_teeth + 1
    plays = []
    for value in (amount, 0.0):
        amounts = dict.fromkeys(TERMS, 0.0) | {name: value}
        surface = surface_of_reducer(reducer, amounts)
        surface = surface.replace(pin_radius=surface.pin_radius - room)
        plays.append(float(contact_play(reducer, surface, angles).backlash.mean()))
    return plays[0] - plays[1]


def runout_error(reducer: Reducer, runout: float) -> float:
    """Return the transmission error, peak to peak (rad), of one disc that is eccentric by half the runout (m).

    There are no other errors; the pins are 20 µm thinner, so that the gear runs free.
    """
    one = reducer.stage.replace(discs=1)
    alone = reducer.replace(stage=one)
    amounts = dict.fromkeys(TERMS, 0.0) | {"gear_runout": runout, "pin_radius": -20e-6}
    play = contact_play(alone, surface_of_reducer(alone, amounts), 10 * one.gear_teeth + 1)
    return float(np.ptp(play.transmission_error))
