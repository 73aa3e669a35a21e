"""A wear run as files and figures: the history that survives a kill, the worn surface, the numbers people ask for."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.contact.tooth_contact import contact_ratio
from cycloid_fmu.surfaces.surface import DEVIATIONS, ErrorSurface, Life
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
    wear_states,
    worn_surface,
)
from cycloid_fmu.wear.sliding import slip_pole

Array = NDArray[np.float64]
FORMAT = "cycloid-wear-run/2"
LARGEST_LIFE = 24  # states that a worn surface keeps of its life


def unfinished_path(output: str | os.PathLike[str]) -> Path:
    """Where the run that ends in `output` keeps its history while it goes on."""
    path = Path(output)
    return path.with_name(f"{path.stem}.unfinished{path.suffix}")


def _identity(model: WearModel, crank_turns: float) -> dict[str, str]:
    """What a history belongs to, in the words that its refusal uses, each as a checksum."""
    surface = hashlib.sha256()
    for name, value in sorted(vars(model.surface).items()):
        if isinstance(value, float | np.ndarray):
            surface.update(name.encode() + np.asarray(value, dtype=float).tobytes())
    pair = model.pair.model_dump(include={"pair", "modification", "material"})
    plain = {
        "pair": json.dumps(pair, sort_keys=True),
        "surface": surface.hexdigest(),
        "wear file": model.law.model_dump_json(exclude={"duty"}),
        "load": json.dumps([[load.torque, load.crank_turns] for load in model.loads] + [model.cycle, crank_turns]),
    }
    return {name: hashlib.sha256(text.encode()).hexdigest()[:16] for name, text in plain.items()}


def _write_history(path: Path, identity: dict[str, str], states: list[WearState]) -> None:
    import xarray as xr

    depths = {f"{way}{body}_depth": (way, body) for way in ("", "whole_") for body in ("gear", "pin")}
    data = xr.Dataset(
        {
            "crank_turns": ("state", [s.crank_turns for s in states]),
            "reach": ("state", [s.reach for s in states]),
            **{
                name: (
                    ("state", *DEVIATIONS[f"{body}_deviation"]),
                    np.stack([getattr(s.whole if way else s.depth, body) for s in states]),
                )
                for name, (way, body) in depths.items()
            },
        },
        attrs={"format": FORMAT, **{f"checksum of the {name}": value for name, value in identity.items()}},
    )
    for name in ("reach", *depths):
        data[name].attrs["units"] = "m"
    with edge.written_whole(path) as temporary:
        data.to_netcdf(temporary, engine="h5netcdf", encoding={name: {"zlib": True} for name in depths})


def _read_history(path: Path, identity: dict[str, str]) -> list[WearState]:
    data = edge.netcdf(path, FORMAT)
    for name, value in identity.items():
        if data.attrs.get(f"checksum of the {name}") != value:
            raise edge.InputError(
                f"{path}: this unfinished run is of another {name}; remove it to begin anew, or give another --output."
            )
    names = ("crank_turns", "gear_depth", "pin_depth", "whole_gear_depth", "whole_pin_depth", "reach")
    return [
        WearState(float(turns), Depth(gear, pin), Depth(whole_gear, whole_pin), float(reach))
        for turns, gear, pin, whole_gear, whole_pin, reach in zip(*(data[n].values for n in names), strict=True)
    ]


class Interrupted(KeyboardInterrupt):
    """A run was interrupted; its text says where its history is."""


def run_wear(
    model: WearModel,
    crank_turns: float,
    output: str | os.PathLike[str] | None,
    workers: int = 1,
    progress: Callable[[float], None] = lambda turns: None,
) -> list[WearState]:
    """Wear a drive and keep its history beside `output` after each step; the caller removes that file at the end.

    A history of the same run that lies there is gone on from; the result is the same bits.

    Parameters
    ----------
    progress
        Told the crank turns that are done.

    Raises
    ------
    edge.InputError
        If a history of another run lies there.
    Interrupted
        At a KeyboardInterrupt.
    """
    place = None if output is None else unfinished_path(output)
    identity = _identity(model, crank_turns)
    states = _read_history(place, identity) if place is not None and place.exists() else []
    steps = wear_states(model, crank_turns, states[-1] if states else None, workers)
    try:
        for number, state in enumerate(steps):
            if number > 0 or not states:
                states.append(state)
                if place is not None:
                    _write_history(place, identity, states)
            progress(state.crank_turns)
    except KeyboardInterrupt:
        kept = "nothing is kept without --output" if place is None else f"{place} holds them, run again to go on"
        turns = states[-1].crank_turns if states else 0.0
        raise Interrupted(f"Interrupted: {turns:.4g} of {crank_turns:.4g} crank turns are done; {kept}.") from None
    return states


def surface_of_run(model: WearModel, states: list[WearState], half_width: float) -> ErrorSurface:
    """Return the worn surface at the end of a run, with at most `LARGEST_LIFE` states of its life."""
    chosen = np.unique(np.linspace(0, len(states) - 1, LARGEST_LIFE).round().astype(int))
    surfaces = [worn_surface(model, states[k].depth, half_width) for k in chosen]
    turns = np.array([states[k].crank_turns for k in chosen])
    life = Life(turns, **{name: np.stack([getattr(s, name) for s in surfaces]) for name in DEVIATIONS})
    loads = ", ".join(f"{load.torque:g} N*m x {load.crank_turns:g}" for load in model.loads)
    notes = {"crank_turns": float(turns[-1]), "pins": model.law.pins, "loads": loads}
    return surfaces[-1].replace(life=life, attributes={**model.surface.attributes, **notes})


def _figures_of(model: WearModel, depth: Depth) -> dict[str, float]:
    """Largest and mean depth (over what is worn at all, m) and the worn volume (m³) of gear and pins."""
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
    """Return the figures of a run, SI, as `--json` prints them.

    `linear` is without profile update, `updated` the end of the history, `as_printed` by the paper's slip distance at
    the contacts (the pin's mean leaves out 0.05 rad on both sides of the pole); `step` says how fine the history is and
    what halving all its steps changes: largest difference anywhere, and the depths in whole steps; `life` follows it.
    """
    turns = states[-1].crank_turns
    curve = accuracy(model, [s.depth for s in states], new.half_width, workers)
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
    if (friction := model.law.friction_coefficient) is not None:
        # Each crank turn the output turns by 2π/|ratio|.
        torque = sum(abs(load.torque) * load.crank_turns for load in model.loads)
        work = friction * new.sliding_work
        found["friction_work"] = work
        found["sliding_loss"] = work / (torque * 2.0 * np.pi / abs(model.pair.ratio)) if torque > 0.0 else 0.0
    return found


def coefficient_warning(coefficient: float, model: WearModel, source: str) -> str | None:
    """Return a sentence where the largest wear coefficient can't be right, naming what it comes from; else None."""
    low, high = SENSIBLE_COEFFICIENTS
    if coefficient == 0.0 or low <= coefficient <= high:
        return None
    law = model.law
    if law.regression is None:
        field = f"[wear] coefficient = {law.coefficient:g} m²/N"
    else:
        given = ", ".join(f"{n} = {v:g}" for n, v in law.regression.model_dump().items())
        field = f"[wear.regression] {given} (SI) gives k_0 up to {coefficient:.3g} m²/N; it"
    return f"{source}: {field} lies outside {low:g} … {high:g} m²/N, where wear coefficients are; check its units."
