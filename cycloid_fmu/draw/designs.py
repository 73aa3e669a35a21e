"""Results of a design search: the Pareto front of two goals, or the margin to each limit."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from cycloid_fmu.draw.figure import at_least, new_figure
from cycloid_fmu.studies.design import Design, DesignTask, on_front, shown

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from numpy.typing import NDArray


_LABEL = (0.05, 0.1)  # of the axes: width and height of a design's number
_SHARE = 0.01  # of a goal: less is not worth a design, and does not fill an axis


def plot_designs(found: Sequence[Design], task: DesignTask, title: str) -> Figure:
    """Draw the designs of a search.

    Parameters
    ----------
    found, task
        Result of `cycloid_fmu.studies.design.search`, and its task.
    title
        Title of the picture.
    """
    figure, axes = new_figure(1, 2)
    left, right = axes
    if len(task.goals) == 2:
        _front(left, found, task)
    else:
        _margins(left, found[0])
    _ranges(right, found, task)
    figure.suptitle(title)
    return figure


def _label(name: str) -> str:
    return f"{name.replace('_', ' ')} [{shown(name, 0.0)[1]}]"


def _front(axes: Axes, found: Sequence[Design], task: DesignTask) -> None:
    first, second = task.goals
    x, y = (np.array([float(shown(name, one.goals[name])[0]) for one in found]) for name in (first, second))
    from matplotlib.ticker import MaxNLocator

    best = on_front(found)
    axes.plot(x[best], y[best], color="0.7", lw=1.0, zorder=1)
    for number, (one, a, b) in enumerate(zip(found, x, y, strict=True), 1):
        of_front = best[number - 1]
        axes.plot(
            a,
            b,
            "o" if one.met else "x",
            color="C0" if one.met else "tab:red",
            mfc="C0" if of_front else "white",
            zorder=2,
        )
    said = "Pareto front"
    if any(one.met and not front for one, front in zip(found, best, strict=True)):
        said += "; hollow: another design is better"
    if not all(one.met for one in found):
        said += "; red: a limit is not met"
    at_least(axes, _SHARE * float(np.abs(x).max()), along_x=True)
    at_least(axes, _SHARE * float(np.abs(y).max()))
    _number_designs(axes, x, y)
    axes.ticklabel_format(useOffset=False)
    axes.xaxis.set_major_locator(MaxNLocator(5))
    axes.set(xlabel=_label(first), ylabel=_label(second))
    axes.set_title(said, fontsize=9)


def _number_designs(axes: Axes, x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
    """Write the numbers of the designs at their points; those of points beside each other share one label."""
    points = axes.transAxes.inverted().transform(axes.transData.transform(np.column_stack([x, y])))
    groups: list[list[int]] = []
    for i in np.lexsort((y, x)).tolist():
        if groups and (np.abs(points[i] - points[groups[-1][-1]]) < _LABEL).all():
            groups[-1].append(i)
        else:
            groups.append([i])
    for group in groups:
        numbers = ", ".join(str(i + 1) for i in sorted(group))
        at_end = points[group[-1], 0] > 0.8
        axes.annotate(
            numbers,
            (x[group[-1]], y[group[-1]]),
            xytext=(-4 if at_end else 4, 4 if at_end else -4),
            textcoords="offset points",
            ha="right" if at_end else "left",
            va="bottom" if at_end else "top",
            fontsize=8,
        )


def _margins(axes: Axes, one: Design) -> None:
    names = [v.figure.replace("_", " ") for v in one.verdicts][::-1]
    shares = [100.0 * min(v.share, 1.0) for v in one.verdicts][::-1]
    axes.barh(names, shares, color=["C0" if share >= 0.0 else "tab:red" for share in shares])
    axes.axvline(0.0, color="0.3", lw=0.8)
    goal = ", ".join(f"{name.replace('_', ' ')} {' '.join(shown(name, value))}" for name, value in one.goals.items())
    # All of the scale, so that a margin of nearly nothing looks like it.
    axes.set(xlabel="margin to the limit [% of the limit, at most 100]", xlim=(min(-5.0, 1.05 * min(shares)), 105.0))
    axes.set_title(goal, fontsize=9)


def _ranges(axes: Axes, found: Sequence[Design], task: DesignTask) -> None:
    names = list(task.vary)
    at = np.arange(len(names))
    for number, one in enumerate(found, 1):
        share = [100.0 * (one.values[n] - task.vary[n][0]) / (task.vary[n][1] - task.vary[n][0]) for n in names]
        shade = f"C{(number - 1) % 10}"
        alone = len(found) == 1  # its values are written at its points, where a line would cross them
        axes.plot(share, at, "o" if alone else "o-", color=shade, lw=1.0, ms=4, label="" if alone else f"{number}")
        if alone:
            for k, name in enumerate(names):
                axes.annotate(
                    " ".join(shown(name, one.values[name])),
                    (share[k], k),
                    xytext=(0, 6),
                    textcoords="offset points",
                    ha="center",
                    fontsize=8,
                )
    labels = [
        f"{n.replace('_', ' ')}\n{shown(n, task.vary[n][0])[0]} … {' '.join(shown(n, task.vary[n][1]))}" for n in names
    ]
    axes.set_yticks(at, labels, fontsize=8)
    axes.set(
        xlabel="position in the range [%]", xlim=(-5.0, 105.0), ylim=(len(names) - 0.5, -0.7), title="searched values"
    )
    if len(found) > 1:
        axes.legend(title="design", fontsize=7, loc="center left", bbox_to_anchor=(1.0, 0.5))
