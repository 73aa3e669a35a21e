"""Common parts of all plots: figure, legend and file."""

from __future__ import annotations

import functools
import os
from collections.abc import Collection
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def save(figure: Figure, path: str | os.PathLike[str], endings: Collection[str] = edge.PICTURES) -> None:
    """Write a figure in the format of the name's ending, one of `endings`; never a partial file."""
    with edge.written_whole(edge.output_path(path, "path", endings)) as temporary:
        figure.savefig(temporary, dpi=150)


@functools.cache
def figure_of_names() -> type[Figure]:
    """Return matplotlib's class of figures, but with dollar signs as such: a name from a file is no formula.

    The numbers on axes stay formulas, such as powers of ten.
    """
    from matplotlib.figure import Figure
    from matplotlib.text import Text
    from matplotlib.ticker import FixedFormatter, FuncFormatter

    class FigureOfNames(Figure):
        def draw(self, renderer: Any) -> None:
            axes = [axis for one in self.axes for axis in (one.xaxis, one.yaxis)]
            numbers = {
                text
                for axis in axes
                if not isinstance(axis.get_major_formatter(), FixedFormatter | FuncFormatter)
                for text in (*axis.get_majorticklabels(), *axis.get_minorticklabels())
            }
            for text in self.findobj(Text):
                if text not in numbers:
                    text.set_parse_math(False)
            super().draw(renderer)

    return FigureOfNames


def new_figure(rows: int = 1, columns: int = 1, *, sharex: bool = False) -> tuple[Figure, NDArray[np.object_]]:
    """Return a figure that needs no screen, and its axes as a flat array."""
    figure = figure_of_names()(
        figsize=(9.0 if columns == 1 else 4.8 * columns + 1.2, 2.4 * rows + 0.8), layout="constrained"
    )
    axes = np.atleast_1d(figure.subplots(rows, columns, sharex=sharex))
    for axis in axes.flat:
        axis.grid(alpha=0.3)
        for side in ("top", "right"):
            axis.spines[side].set_visible(False)
    return figure, axes.ravel()


def at_least(axis: Axes, span: float, *, along_x: bool = False) -> None:
    """Widen an axis about its middle to a span, so that neither rounding nor a trifle fills it."""
    low, high = axis.get_xlim() if along_x else axis.get_ylim()
    if high - low < span:
        widen = axis.set_xlim if along_x else axis.set_ylim
        widen(0.5 * (low + high - span), 0.5 * (low + high + span))


def show_legend(axis: Axes, **options: Any) -> None:
    """Show the legend on a background that keeps it readable over lines."""
    axis.legend(**{"fontsize": 8, "framealpha": 0.85, "edgecolor": "none", **options})
