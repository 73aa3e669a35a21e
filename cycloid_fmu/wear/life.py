"""A wear run: the states of a life, the worn surface and the figures."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.contact.loaded_contacts import contact_ratio
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.losses.flanks import coefficient_at_speed, flanks_rub
from cycloid_fmu.surfaces.surface import DEVIATIONS, ErrorSurface, Life
from cycloid_fmu.wear.law import Load, WearLaw
from cycloid_fmu.wear.progress import (
    SENSIBLE_COEFFICIENTS,
    Depth,
    WearModel,
    WearRate,
    WearState,
    accuracy,
    depth_as_printed,
    tooth_thickness,
    wear_limit,
    wear_model,
    wear_rate,
    wear_states,
    worn_surface,
)
from cycloid_fmu.wear.sliding import slip_pole

Array = NDArray[np.float64]
LARGEST_LIFE = 24  # states that a worn surface keeps of its life
_LIGHT = 1e-6  # m: below it wear hardly changes the contacts
_LESS = 0.9  # of the exact depth


@dataclasses.dataclass(frozen=True)
class WearRun:
    """A worn drive.

    Attributes
    ----------
    model, new
        The wear problem and its rate with the profile as new.
    states
        The drive when new and after each step.
    figures
        As `wear_figures` returns them.
    notes
        Sentences on doubtful inputs, and on a wear limit that ended the run.
    """

    model: WearModel
    new: WearRate
    states: list[WearState]
    figures: dict[str, Any]
    notes: list[str]

    @property
    def surface(self) -> ErrorSurface:
        """The worn drive with its life."""
        return surface_of_run(self.model, self.states)


def run_wear(
    drive: DriveValue,
    law: WearLaw,
    loads: tuple[Load, ...],
    crank_turns: float,
    source: str,
    *,
    workers: int = 1,
    progress: Callable[[float], None] = lambda turns: None,
) -> WearRun:
    """Wear a drive for a number of crank turns, or until its wear limit is reached.

    Parameters
    ----------
    pair, surface
        The nominal pair and the errors of the drive when new.
    law, loads, crank_turns
        As `law.duty_cycle` returns them.
    source
        The wear law's file, for messages.
    workers
        Threads.
    progress
        Called with the crank turns done.

    Raises
    ------
    edge.InputError
        If the teeth would wear through.
    KeyboardInterrupt
        Its text states the progress of the run.
    """
    pair = drive.pair
    friction_of(drive.pair, law)
    model = wear_model(drive, law, loads)
    new = wear_rate(model, model.surface, workers)
    thickness = tooth_thickness(pair)
    if new.depth.largest * crank_turns > thickness:
        raise edge.InputError(
            f"{source}: {crank_turns:g} crank turns would wear {new.depth.largest * crank_turns * 1e3:.4g} mm deep, "
            f"and the tooth is {thickness * 1e3:.4g} mm thick; check the wear coefficient's units and the turns."
        )
    states = []
    try:
        for state in wear_states(model, crank_turns, workers):
            states.append(state)
            progress(state.crank_turns)
    except KeyboardInterrupt:
        done = states[-1].crank_turns if states else 0.0
        raise KeyboardInterrupt(f"Interrupted: {done:.4g} of {crank_turns:.4g} crank turns are done.") from None
    figures = wear_figures(model, states, new, workers)
    notes = [doubt for doubt in [coefficient_warning(new.coefficient, model, source)] if doubt is not None]
    if figures["crank_turns"] < crank_turns:
        notes.append(
            f"The wear limit of {figures['wear_limit'] * 1e6:.1f} µm is reached after {figures['crank_turns']:.4g} of "
            f"{crank_turns:.4g} crank turns; the run ends there."
        )
    return WearRun(model, new, states, figures, [*notes, *_blunted(figures)])


def _blunted(figures: dict[str, Any]) -> list[str]:
    """Return a note where the average over a contact's width takes much from the deepest point of light wear.

    As long as wear is light the contacts are those of the new drive, and the depth without update is the exact one.
    """
    share = {}
    for body in ("gear", "pin"):
        exact, averaged = (figures[kind][f"{body}_depth_max"] for kind in ("linear", "updated"))
        if 0.0 < averaged < _LESS * exact and exact < _LIGHT:
            share[body] = 1.0 - averaged / exact
    if not share:
        return []
    shares = " and ".join(f"{part:.0%} on the {body}" for body, part in share.items())
    return [
        f"The profile is averaged over a contact's width, which takes {shares} from the deepest point; "
        "at such light wear the depth without update is the exact one."
    ]


def surface_of_run(model: WearModel, states: list[WearState]) -> ErrorSurface:
    """Return the worn surface at the end of a run, with at most `LARGEST_LIFE` states of its life."""
    chosen = np.unique(np.linspace(0, len(states) - 1, LARGEST_LIFE).round().astype(int))
    surfaces = [worn_surface(model, states[k].depth) for k in chosen]
    turns = np.array([states[k].crank_turns for k in chosen])
    life = Life(turns, *(np.stack([getattr(s, name) for s in surfaces]) for name in DEVIATIONS))
    loads = ", ".join(f"{load.torque:g} N*m x {load.crank_turns:g}" for load in model.loads)
    notes = {"crank_turns": float(turns[-1]), "pins": model.law.pins, "loads": loads}
    return surfaces[-1].replace(life=life, attributes={**model.surface.attributes, **notes})


def _figures_of(model: WearModel, depth: Depth) -> dict[str, float]:
    """Largest and mean depth (over the worn area, m) and the worn volume (m³) of gear and pins."""
    width = model.pair.face_width
    found = {}
    for body, values, element in (("gear", depth.gear, model.gear_element), ("pin", depth.pin, model.pin_element)):
        worn = values[values > 1e-3 * values.max()] if values.any() else np.zeros(1)
        found[f"{body}_depth_max"] = float(values.max())
        found[f"{body}_depth_mean"] = float(worn.mean())
        found[f"{body}_volume"] = float(values.sum() * element * width / values.shape[-1])
    if model.law.pins == "free":
        found["pin_volume"] *= 2.0  # the other half of the circumference
    return found


def wear_figures(model: WearModel, states: list[WearState], new: WearRate, workers: int = 1) -> dict[str, Any]:
    """Return the figures of a run, SI.

    `linear` is without profile update, `updated` the written surface at the end of the history, `as_printed` by the
    paper's slip distance at the contacts (the pin's mean leaves out 0.05 rad on both sides of the pole); `step` has the
    number of steps and the effect of halving all of them: largest difference anywhere, and the depths in whole steps;
    `life` has the history.
    """
    turns = states[-1].crank_turns
    curve = accuracy(model, [s.depth for s in states], workers)
    found: dict[str, Any] = {
        "crank_turns": turns,
        "linear": _figures_of(model, new.depth * turns),
        "updated": _figures_of(model, states[-1].depth),
        "wear_coefficient_max": new.coefficient,
        "max_contact_pressure": new.pressure,
        "half_width": new.half_width,
        "sliding_work": new.sliding_work,
        "wear_limit": wear_limit(model),
        "tooth_thickness": tooth_thickness(model.pair),
        "step": {
            "count": len(states) - 1,
            "halving_difference": states[-1].difference,
            "whole_steps": _figures_of(model, states[-1].whole),
        },
        "life": {
            "crank_turns": [s.crank_turns for s in states],
            "gear_depth_max": [float(s.depth.gear.max()) for s in states],
            "pin_depth_max": [float(s.depth.pin.max()) for s in states],
            **vars(curve),
        },
    }
    if model.heaviest_torque != 0.0:
        contacts, gear, pin = depth_as_printed(model, turns)
        off_pole = np.abs(np.abs(contacts.phase) - slip_pole(model.pair)) > 0.05
        found["contact_ratio"] = contact_ratio(contacts)
        found["as_printed"] = {
            "gear_depth_max": float(gear.max()),
            "gear_depth_mean": float(gear.mean()),
            "pin_depth_mean_off_pole": float(np.mean(pin[off_pole])) if off_pole.any() else 0.0,
        }
    if (friction := friction_of(model.pair, model.law)) is not None:
        # Each crank turn the output turns by 2π/|ratio|.
        torque = sum(abs(load.torque) * load.crank_turns for load in model.loads)
        work = friction * new.sliding_work
        found["friction_work"] = work
        found["sliding_loss"] = work / (torque * 2.0 * np.pi / abs(model.pair.ratio)) if torque > 0.0 else 0.0
    return found


def friction_of(pair: Pair, law: WearLaw) -> float | None:
    """Return the friction coefficient at speed of flanks on pins: the pair's [losses], or that of the wear law.

    Raises
    ------
    edge.InputError
        If both state one.
    """
    if pair.losses is None or not flanks_rub(pair):
        return law.friction_coefficient
    if law.friction_coefficient is not None:
        raise edge.InputError(
            f"[wear] friction_coefficient = {law.friction_coefficient:g} is stated by [losses.flank] of the pair too; "
            "remove it from the wear law."
        )
    return coefficient_at_speed(pair, pair.losses)


def coefficient_warning(coefficient: float, model: WearModel, source: str) -> str | None:
    """Return a sentence if the largest wear coefficient is implausible, with its source; otherwise None."""
    low, high = SENSIBLE_COEFFICIENTS
    if coefficient == 0.0 or low <= coefficient <= high:
        return None
    law = model.law
    if law.regression is None:
        field = f"[wear] coefficient = {law.coefficient:g} m²/N"
    else:
        given = ", ".join(f"{n} = {v:g}" for n, v in law.regression.model_dump().items())
        field = f"[wear.regression] {given} (SI) gives k_0 up to {coefficient:.3g} m²/N; it"
    return f"{source}: {field} is outside {low:g} … {high:g} m²/N, the range of wear coefficients; check its units."
