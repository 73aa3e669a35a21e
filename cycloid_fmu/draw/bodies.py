"""Pictures of an elastic disc: its mesh, and its displacement under a pin and under its whole load, enlarged."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from cycloid_fmu.draw.figure import new_figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from cycloid_fmu.bodies.disc import DiscForces
    from cycloid_fmu.bodies.elastic import PlaneBody
    from cycloid_fmu.geometry.bodies import DiscBody
    from cycloid_fmu.geometry.pair import Pair

_LARGEST = 0.04  # drawn displacement over the pin circle's radius
_LONGEST = 0.25  # of an arrow


def plot_disc(
    pair: Pair,
    body: DiscBody,
    *,
    disc: int = 0,
    pin: int = 0,
    crank_angle: float = 0.0,
    forces: DiscForces | None = None,
) -> Figure:
    """Draw a disc's mesh, its displacement under 1 N of a pin at its ideal place, and that under its whole load.

    Parameters
    ----------
    pair, body, disc
        The pair with its supports, the disc's description and its number.
    pin
        Number of the pin that presses.
    crank_angle
        Crank angle, rad.
    forces
        All forces on the disc (`cycloid_fmu.supports.disc_forces.disc_forces`); None without the last picture.

    Returns
    -------
    matplotlib.figure.Figure
        The mesh, and the displacements with the disc's mean motion at rest (docs/theory/bodies.md): their size as
        colours, the shape enlarged, forces as arrows.

    Raises
    ------
    edge.InputError
        If the disc can't be meshed, or scikit-fem is not installed.
    """
    from cycloid_fmu.bodies.disc import DiscForces, elastic_disc

    elastic = elastic_disc(pair, body, disc)
    mesh = elastic.mesh
    figure, axes = new_figure(1, 2 if forces is None else 3)
    figure.set_size_inches(6.0 * len(axes), 5.6)
    axes[0].triplot(mesh.nodes.real * 1e3, mesh.nodes.imag * 1e3, mesh.triangles, linewidth=0.3, color="#345")
    axes[0].set_title(f"{len(mesh.triangles)} triangles, {elastic.unknowns} unknowns")
    assert pair.supports is not None
    unit = DiscForces(1.0 * (np.arange(pair.pins) == pin), np.zeros((pair.supports.cranks, 2)), np.zeros(0))
    factor = _draw_displaced(axes[1], pair, body, elastic, disc, crank_angle, unit, 1e9)
    axes[1].set_title(f"displacement under 1 N, {factor:.2g} times enlarged")
    if forces is not None:
        factor = _draw_displaced(axes[2], pair, body, elastic, disc, crank_angle, forces, 1e6)
        axes[2].set_title(f"under all forces, pins up to {forces.pin.max():.3g} N, {factor:.2g} times enlarged")
    for axis in axes:
        axis.set_aspect("equal")
        axis.grid(visible=False)
        axis.set_xlabel("mm")
    return figure


def _draw_displaced(
    axis: Axes,
    pair: Pair,
    body: DiscBody,
    elastic: PlaneBody,
    disc: int,
    crank_angle: float,
    forces: DiscForces,
    scale: float,
) -> float:
    """Draw a disc displaced by forces; return the enlargement. `scale` of colours is 1e9 for nm, 1e6 for µm."""
    from matplotlib.tri import Triangulation

    from cycloid_fmu.bodies.disc import nodal_forces

    moved = elastic.displacement(nodal_forces(elastic, pair, body, disc, crank_angle, forces)[:, None])
    mesh, displacement = elastic.mesh, elastic.at_nodes(moved[:, 0])[elastic.corners]
    size = np.abs(displacement)
    factor = _LARGEST * pair.pin_circle_radius / size.max()
    shape = (mesh.nodes + factor * displacement) * 1e3
    colours = axis.tripcolor(
        Triangulation(shape.real, shape.imag, mesh.triangles), size * scale, shading="gouraud", cmap="viridis"
    )
    for chain in mesh.chains:
        outline = mesh.nodes[np.append(chain, chain[0])] * 1e3
        axis.plot(outline.real, outline.imag, color="#345", linewidth=0.4)
    _draw_forces(axis, pair, body, disc, crank_angle, forces)
    axis.figure.colorbar(colours, ax=axis, label="nm" if scale == 1e9 else "µm")
    return float(factor)


def _draw_forces(axis: Axes, pair: Pair, body: DiscBody, disc: int, crank_angle: float, forces: DiscForces) -> None:
    """Draw forces on a disc as arrows, the longest of pins and rollers, and of arms, alike."""
    from cycloid_fmu.bodies import outline
    from cycloid_fmu.bodies.outline import SECTORS

    crank = crank_angle + 2.0 * math.pi * disc / pair.discs
    alpha = (2.0 * math.pi * np.arange(pair.pins) / pair.pins + crank / pair.gear_teeth) % (2.0 * math.pi)
    flank, normal = outline.flank_at(pair, disc, alpha)
    arms = outline.bores(pair, body, 1)
    centres = np.array([bore.points.mean() for bore in arms])
    along = np.exp(2j * math.pi * np.arange(SECTORS) / SECTORS) if forces.arm.shape[1] == SECTORS else [1.0, 1j]
    inwards = -np.exp(1j * (crank + crank_angle / pair.gear_teeth))
    at_rollers = outline.places(pair)[: forces.roller.size] + (body.roller_hole_radius or 0.0) * inwards
    longest = 1e3 * _LONGEST * pair.pin_circle_radius
    for points, force, ends in (
        (flank, -normal * forces.pin, True),
        (at_rollers, inwards * forces.roller, False),
        (centres, forces.arm @ np.asarray(along), False),
    ):
        largest = np.abs(force).max(initial=0.0)
        for at, vector in zip(points * 1e3, force, strict=True):
            if abs(vector) > 0.02 * largest:
                arrow = longest * vector / largest
                tail, head = (at - arrow, at) if ends else (at, at + arrow)
                arrows = {"arrowstyle": "->", "color": "C3", "linewidth": 1.2}
                axis.annotate("", (head.real, head.imag), (tail.real, tail.imag), arrowprops=arrows)
                axis.update_datalim([(tail.real, tail.imag), (head.real, head.imag)])  # else arrows cover the title
    axis.autoscale_view()
