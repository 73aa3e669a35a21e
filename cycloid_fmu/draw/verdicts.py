"""Verdicts below a picture: a line for each limit, in red where it is not met."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from cycloid_fmu.studies.limits import Verdict, line_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_LINE = 0.17  # inch


def show_verdicts(figure: Figure, verdicts: Sequence[Verdict]) -> Figure:
    """Add a line for each verdict below a figure, which grows by them, and return it."""
    if not verdicts:
        return figure
    width, height = figure.get_size_inches()
    below = _LINE * (len(verdicts) + 1)
    figure.set_size_inches(width, height + below)
    share = below / (height + below)
    if (layout := figure.get_layout_engine()) is not None:
        layout.set(rect=(0.0, share, 1.0, 1.0 - share))  # type: ignore[call-arg]
    for k, one in enumerate(verdicts):
        place = share * (len(verdicts) - k) / (len(verdicts) + 1)
        figure.text(0.02, place, line_of(one), fontsize=7.5, va="center", color="black" if one.met else "tab:red")
    return figure
