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
    from matplotlib.figure import Figure

    from cycloid_fmu.wear.progress import WearModel, WearRate, WearState


def plot_wear(model: WearModel, states: list[WearState], new: WearRate, figures: Mapping[str, Any]) -> Figure:
    """Contact of one pin when new, wear depth over both bodies, and depth and accuracy over life."""
    from cycloid_fmu.contact.loaded_contacts import loaded_contacts
    from cycloid_fmu.contact.transmission import rigid_problem
    from cycloid_fmu.wear.progress import contact_coefficients
    from cycloid_fmu.wear.sliding import velocities

    figure, axes = new_figure(4, 3)
    drive = rigid_problem(DriveValue(model.pair, model.surface), model.unworn.gear.shape[3])
    torque = model.heaviest_torque
    if torque != 0.0:
        contacts = loaded_contacts(drive, model.sweep.crank_angle, torque)
        order = np.argsort(contacts.phase)
        speed = velocities(drive, contacts)
        phase = contacts.phase[order]
        coefficient = contact_coefficients(model.law, drive, contacts)
        mesh: list[tuple[str, list[tuple[str, NDArray[np.float64]]]]] = [
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
        for axis, (label, curves) in zip(axes, mesh, strict=False):
            for name, values in curves:
                axis.plot(phase, values[order], ".", ms=2, label=name)
            axis.set(xlabel="angle of the pin from the crank [rad]", ylabel=label)
            if curves[0][0]:
                show_legend(axis, markerscale=4)
        axes[0].set_title(f"new, {torque:g} N·m", fontsize=9)
        axes[4].set_ylim(-12.0, 12.0)
        axes[4].set_title("slip of the pin: pole where the contact reverses", fontsize=9)
    turns = states[-1].crank_turns
    for axis, body, along, label in (
        (axes[6], "gear", np.linspace(0.0, 1.0, model.unworn.gear.shape[2]), "arc of the tooth, root to root"),
        (
            axes[7],
            "pin",
            np.linspace(-90.0, 90.0, model.unworn.pin.shape[1]),
            "pin: angle from the circle's centre [°]",
        ),
    ):
        for state in states[1:]:
            depth = getattr(state.depth, body)
            axis.plot(along, depth.reshape(-1, along.size, depth.shape[-1]).max(axis=(0, 2)) * 1e6, lw=0.8, color="C0")
        linear = getattr(new.depth, body) * turns
        shown = linear.reshape(-1, along.size, linear.shape[-1]).max(axis=(0, 2)) * 1e6
        axis.set_ylim(0.0, max(1.3 * getattr(states[-1].depth, body).max() * 1e6, 1e-3))
        axis.plot(along, shown, "k--", lw=1.0, label=f"without update: {shown.max():.3g} µm")
        last = getattr(states[-1].depth, body).reshape(-1, along.size, linear.shape[-1]).max(axis=(0, 2))
        worn = np.flatnonzero(last + shown > 0.0)
        if worn.size:
            margin = 0.1 * (along[worn[-1]] - along[worn[0]])
            axis.set_xlim(along[worn[0]] - margin, along[worn[-1]] + margin)
        axis.set(xlabel=label, ylabel="depth [µm]")
        axis.set_title(f"{body}: each step, largest of all", fontsize=9)
        show_legend(axis)
    life = figures["life"]
    at = np.array(life["crank_turns"]) * 1e-6
    for body in ("gear", "pin"):
        axes[8].plot(at, np.array(life[f"{body}_depth_max"]) * 1e6, ".-", ms=4, lw=1, label=body)
    axes[8].set(xlabel="million crank turns", ylabel="largest depth [µm]")
    show_legend(axes[8])
    for axis, name, label in (
        (axes[9], "transmission_error", "mean TE [arcsec]"),
        (axes[10], "backlash", "mean [arcsec]"),
        (axes[10], "lost_motion", "mean [arcsec]"),
    ):
        axis.plot(at, np.asarray(life[name]) * ARCSEC, ".-", ms=4, lw=1, label=name.replace("_", " "))
        axis.set(xlabel="million crank turns", ylabel=label)
    show_legend(axes[10])
    for name, label in (("transmission_error", "TE"), ("backlash", "backlash"), ("lost_motion", "lost motion")):
        name = f"{name}_range"
        axes[11].plot(at, np.asarray(life[name]) * ARCSEC, ".-", ms=4, lw=1, label=label)
    axes[11].set(xlabel="million crank turns", ylabel="peak to peak [arcsec]")
    show_legend(axes[11])
    for axis in axes[9:12]:
        at_least(axis, 0.01)
    pair = model.pair
    figure.suptitle(f"Wear of the cycloid drive {pair.gear_teeth}/{pair.pins}, {turns:.3g} crank turns", fontsize=11)
    return figure
