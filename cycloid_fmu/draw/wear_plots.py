"""Plots of wear over a life."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.draw.figure import at_least, new_figure, show_legend
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import ARCSEC

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from cycloid_fmu.wear.progress import WearModel, WearRate, WearState


def plot_wear(model: WearModel, states: list[WearState], new: WearRate, figures: Mapping[str, Any]) -> Figure:
    """Contact of one pin when new, wear depth over both bodies, and depth and accuracy over life."""
    figure, axes = new_figure(4, 3)
    if model.heaviest_torque != 0.0:
        _draw_mesh(axes[:6], model)
    tooth = np.linspace(0.0, 1.0, model.unworn.gear.shape[2])
    pin = np.linspace(-90.0, 90.0, model.unworn.pin.shape[1])
    _draw_profile(axes[6], "gear", tooth, states, new)
    _draw_profile(axes[7], "pin", pin, states, new)
    axes[6].set_xlabel("arc of the tooth, root to root")
    axes[7].set_xlabel("pin: angle from the circle's centre [°]")
    _draw_life(axes[8:], figures["life"])
    pair, turns = model.pair, states[-1].crank_turns
    figure.suptitle(f"Wear of the cycloid drive {pair.gear_teeth}/{pair.pins}, {turns:.3g} crank turns", fontsize=11)
    return figure


def _draw_mesh(axes: NDArray[np.object_], model: WearModel) -> None:
    """Draw force, pressure, velocities, slip and wear coefficient of the new drive's contacts over the pin's angle."""
    from cycloid_fmu.supports.loaded_contacts import loaded_contacts, mounted
    from cycloid_fmu.wear.progress import contact_coefficients
    from cycloid_fmu.wear.sliding import velocities

    held, torque = mounted(DriveValue(model.pair, model.surface), model.unworn.gear.shape[3]), model.heaviest_torque
    drive, contacts = held.problem, loaded_contacts(held, model.sweep.crank_angle, torque)
    order = np.argsort(contacts.phase)
    speed = velocities(drive, contacts)
    coefficient = contact_coefficients(model.law, drive, contacts)
    panels: list[tuple[str, list[tuple[str, NDArray[np.float64]]]]] = [
        ("force [N]", [("", contacts.force)]),
        ("pressure [MPa]", [("", contacts.pressure * 1e-6)]),
        ("half width [µm]", [("", contacts.half_width * 1e6)]),
        (
            "velocity [mm per rad of the ring]",
            [("along pin", speed.pin * 1e3), ("along gear", speed.gear * 1e3), ("sliding", speed.sliding * 1e3)],
        ),
        ("slip coefficient", [("gear", speed.gear_slip), ("pin", speed.pin_slip)]),
        ("k_0 [m²/N]", [("", coefficient)]),
    ]
    for axis, (label, curves) in zip(axes, panels, strict=True):
        for name, values in curves:
            axis.plot(contacts.phase[order], values[order], ".", ms=2, label=name)
        axis.set(xlabel="angle of the pin from the crank [rad]", ylabel=label)
        if curves[0][0]:
            show_legend(axis, markerscale=4)
    axes[0].set_title(f"new, {torque:g} N·m", fontsize=9)
    axes[4].set_ylim(-12.0, 12.0)
    axes[4].set_title("slip of the pin: pole where the contact reverses", fontsize=9)


def _draw_profile(axis: Axes, body: str, place: NDArray[np.float64], states: list[WearState], new: WearRate) -> None:
    """Draw the wear depth over the profile of a body, the deepest of all its teeth or pins, after each step."""

    def deepest(depth: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(depth.reshape(-1, place.size, depth.shape[-1]).max(axis=(0, 2)))

    for state in states[1:]:
        axis.plot(place, deepest(getattr(state.depth, body)) * 1e6, lw=0.8, color="C0")
    final = getattr(states[-1].depth, body)
    linear = deepest(getattr(new.depth, body) * states[-1].crank_turns) * 1e6
    axis.set_ylim(0.0, max(1.3 * final.max() * 1e6, 1e-3))
    axis.plot(place, linear, "k--", lw=1.0, label=f"without update: {linear.max():.3g} µm")
    worn = np.flatnonzero(deepest(final) + linear > 0.0)
    if worn.size:
        margin = 0.1 * (place[worn[-1]] - place[worn[0]])
        axis.set_xlim(place[worn[0]] - margin, place[worn[-1]] + margin)
    axis.set_ylabel("depth [µm]")
    axis.set_title(f"{body}: each step, largest of all", fontsize=9)
    show_legend(axis)


def _draw_life(axes: NDArray[np.object_], life: Mapping[str, Any]) -> None:
    """Draw depth, mean and peak-to-peak accuracy over crank turns."""
    turns = np.array(life["crank_turns"]) * 1e-6
    for body in ("gear", "pin"):
        axes[0].plot(turns, np.array(life[f"{body}_depth_max"]) * 1e6, ".-", ms=4, lw=1, label=body)
    axes[0].set(ylabel="largest depth [µm]")
    for axis, name, label in (
        (axes[1], "transmission_error", "mean TE [arcsec]"),
        (axes[2], "backlash", "mean [arcsec]"),
        (axes[2], "lost_motion", "mean [arcsec]"),
    ):
        axis.plot(turns, np.asarray(life[name]) * ARCSEC, ".-", ms=4, lw=1, label=name.replace("_", " "))
        axis.set(ylabel=label)
    for name, label in (("transmission_error", "TE"), ("backlash", "backlash"), ("lost_motion", "lost motion")):
        axes[3].plot(turns, np.asarray(life[f"{name}_range"]) * ARCSEC, ".-", ms=4, lw=1, label=label)
    axes[3].set(ylabel="peak to peak [arcsec]")
    for axis in axes:
        axis.set_xlabel("million crank turns")
    for axis in (axes[0], axes[2], axes[3]):
        show_legend(axis)
    for axis in axes[1:]:
        at_least(axis, 0.01)
