"""Pictures of a disc's profile."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from cycloid_fmu.draw.figure import new_figure, show_legend

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from cycloid_fmu.cad.profile import Profile


def plot_profile(profile: Profile) -> Figure:
    """The disc with holes, pins and pin circle; tooth 0 with the ends of its arcs; curvature of tooth and arcs."""
    figure, axes = new_figure(2, 2)
    for axis in axes:
        figure.delaxes(axis)
    grid = figure.add_gridspec(2, 2)
    whole, tooth, bent = (figure.add_subplot(grid[place]) for place in (np.s_[:, 0], np.s_[0, 1], np.s_[1, 1]))
    table, turn = profile.table, np.exp(2j * np.pi * np.linspace(0.0, 1.0, 181))
    x, y = (np.append(table[name], table[name][0]) * 1e3 for name in ("x", "y"))
    whole.plot(x, y, "k", lw=0.9, label=f"disc {profile.disc}")

    def circle(place: complex, radius: float, colour: str, **options: Any) -> None:
        ring = 1e3 * (place + radius * turn)
        whole.plot(ring.real, ring.imag, color=colour, lw=0.7, **options)

    circle(profile.ring_place, profile.ring_radius, "0.6", ls="--", label="pin circle")
    for number, (place, radius) in enumerate(zip(profile.pin_place, profile.pin_radius, strict=True)):
        circle(place, radius, "C0", label="pins" if number == 0 else None)
    for number, (place, radius) in enumerate(zip(profile.hole_place, profile.hole_radius, strict=True)):
        name = "holes" if number == 0 else None
        if np.isnan(radius):
            whole.plot(1e3 * place.real, 1e3 * place.imag, "+", color="C3", label=name)
        else:
            circle(place, radius, "C3", label=name)
    for start, bulge in profile.windows:
        half, along = 2.0 * np.arctan(bulge), np.linspace(0.0, 1.0, 25)[:, None]
        flat = np.abs(half) < 1e-9
        safe = np.where(flat, 1.0, half)
        share = np.where(flat, along, np.sin(along * safe) / np.sin(safe))
        curve = (start + (np.roll(start, -1) - start) * share * np.exp(1j * (along - 1.0) * half)).T.ravel() * 1e3
        whole.plot(np.append(curve, curve[0]).real, np.append(curve, curve[0]).imag, color="C3", lw=0.7)
    whole.set(xlabel="x [mm]", ylabel="y [mm]", title="at crank angle 0", aspect="equal")
    show_legend(whole, loc="center")
    first = table["tooth"] == 0.0
    second = profile.teeth[1]
    arcs = profile.start[: int(np.abs(profile.start - second.points(second.low)).argmin()) + 1]
    tooth.plot(table["x"][first] * 1e3, table["y"][first] * 1e3, "k", lw=0.9, label="flank")
    tooth.plot(arcs.real * 1e3, arcs.imag * 1e3, ".", color="C1", ms=4, label="ends of the arcs")
    tooth.set(xlabel="x [mm]", ylabel="y [mm]", title=f"tooth 0, {arcs.size - 1} arcs")
    tooth.set_aspect("equal", "datalim")
    show_legend(tooth, loc="center left")
    chord, bulge = np.abs(np.diff(arcs)), profile.bulge[: arcs.size - 1]
    steps = np.concatenate([[0.0], np.cumsum(chord * 2.0 * np.arctan(bulge) / np.sin(2.0 * np.arctan(bulge)))])
    bent.stairs(4e-3 * bulge / (1.0 + bulge**2) / chord, steps * 1e3, baseline=None, color="C1", label="arcs")
    bent.plot(
        table["arc_length"][first] * 1e3,
        table["curvature"][first] * 1e-3,
        "k",
        lw=0.9,
        label="flank without form deviation",
    )
    bent.set(xlabel="arc length [mm]", ylabel="curvature [1/mm]")
    bent.set_title(f"flank to arcs: at most {profile.largest_error * 1e6:.3g} µm", fontsize=9)
    show_legend(bent)
    figure.set_size_inches(12.0, 6.4)
    return figure
