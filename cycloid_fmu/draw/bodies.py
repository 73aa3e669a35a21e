"""Pictures of an elastic disc: its mesh, and its displacement under the force of a pin, enlarged and as colours."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from cycloid_fmu.draw.figure import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from cycloid_fmu.geometry.bodies import DiscBody
    from cycloid_fmu.geometry.pair import Pair

_LARGEST = 0.04  # drawn displacement over the pin circle's radius


def plot_disc(pair: Pair, body: DiscBody, *, disc: int = 0, pin: int = 0, crank_angle: float = 0.0) -> Figure:
    """Draw a disc's mesh, and its displacement under 1 N of a pin at its ideal place.

    Parameters
    ----------
    pair, body, disc
        The pair with its supports, the disc's description and its number.
    pin
        Number of the pin that presses.
    crank_angle
        Crank angle, rad.

    Returns
    -------
    matplotlib.figure.Figure
        The mesh, and the displacement with the disc's mean motion at rest (docs/theory/bodies.md): its size as colours,
        its shape enlarged.

    Raises
    ------
    edge.InputError
        If the disc can't be meshed, or scikit-fem is not installed.
    """
    from cycloid_fmu.bodies.disc import PATCH, elastic_disc
    from cycloid_fmu.bodies.outline import flank_at
    from cycloid_fmu.bodies.ports import patch

    elastic = elastic_disc(pair, body, disc)
    crank = crank_angle + 2.0 * math.pi * disc / pair.discs
    alpha = np.array([(2.0 * math.pi * pin / pair.pins + crank / pair.gear_teeth) % (2.0 * math.pi)])
    place, normal = flank_at(pair, disc, alpha)
    loads = elastic.both_components(patch(elastic, 0, place, 1j * normal, PATCH * pair.pin_radius))
    moved = elastic.displacement(loads @ -np.array([[normal[0].real], [normal[0].imag]]))
    displacement = elastic.at_nodes(moved[:, 0])[elastic.corners]
    mesh, size = elastic.mesh, np.abs(displacement)
    factor = _LARGEST * pair.pin_circle_radius / size.max()
    figure, axes = new_figure(1, 2)
    figure.set_size_inches(12.0, 5.6)
    axes[0].triplot(mesh.nodes.real * 1e3, mesh.nodes.imag * 1e3, mesh.triangles, linewidth=0.3, color="#345")
    axes[0].set_title(f"{len(mesh.triangles)} triangles, {elastic.unknowns} unknowns")
    shape = (mesh.nodes + factor * displacement) * 1e3
    colours = axes[1].tripcolor(shape.real, shape.imag, mesh.triangles, size * 1e9, shading="gouraud", cmap="viridis")
    for chain in mesh.chains:
        outline = mesh.nodes[np.append(chain, chain[0])] * 1e3
        axes[1].plot(outline.real, outline.imag, color="#345", linewidth=0.4)
    along = 0.25 * pair.pin_circle_radius * 1e3 * normal[0]
    start = place[0] * 1e3 + along
    axes[1].annotate(
        "",
        (start.real - along.real, start.imag - along.imag),
        (start.real, start.imag),
        arrowprops={"arrowstyle": "->", "color": "C3"},
    )
    axes[1].set_title(f"displacement under 1 N, {factor:.2g} times enlarged")
    figure.colorbar(colours, ax=axes[1], label="nm")
    for axis in axes:
        axis.set_aspect("equal")
        axis.grid(visible=False)
        axis.set_xlabel("mm")
    return figure
