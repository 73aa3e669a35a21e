"""A device's clock against the host's: offset and drift from the lower convex hull of arrival times.

A sample arrives after a delay that is never negative and mostly small, sometimes large (schedulers, buffers). So the
device's clock, on the host's, is the line below all points (device time, arrival time) that comes closest to them: an
edge of their lower convex hull. Least squares would follow the delays instead (A. Moon,
P. Skelly and D. Towsley, Estimation and removal of clock skew from network delay measurements, INFOCOM 1999, which
chooses this edge as the solution of a linear programme).
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from drivers.recording_format import Clock, FloatArray

_FEW = 32  # points up to which a loop is as fast as array operations
_COVERAGE = 5.0  # from simulations: the band then contains the true line at both ends in 95 % of them


def lower_hull(x: FloatArray, y: FloatArray) -> npt.NDArray[np.intp]:
    """Return the indices of the points on the lower convex hull, in the order of x (Andrew's monotone chain).

    Parameters
    ----------
    x, y
        Coordinates of the points, shape (n,), in any order.
    """
    order = np.lexsort((y, x))
    order = order[np.diff(x[order], prepend=-np.inf) > 0]
    # A point on or above the chord of its neighbours is not on the hull: this removes most points, many at a time.
    while len(order) > _FEW:
        before, at, after = order[:-2], order[1:-1], order[2:]
        below = (x[at] - x[before]) * (y[after] - y[before]) > (y[at] - y[before]) * (x[after] - x[before])
        if np.count_nonzero(below) > 0.9 * len(below):
            break
        order = np.concatenate([order[:1], at[below], order[-1:]])
    hull: list[int] = []
    for i in order.tolist():
        while len(hull) > 1:
            a, b = hull[-2], hull[-1]
            if (x[b] - x[a]) * (y[i] - y[a]) > (y[b] - y[a]) * (x[i] - x[a]):
                break
            hull.pop()
        hull.append(i)
    return np.array(hull, np.intp)


class ClockEstimate:
    """Offset and drift of a device's clock from all arrivals so far, in constant memory.

    Only the two outermost hulls are kept, the second from all points that are not on the first: a point above both can
    never be on one of them again.
    """

    def __init__(self) -> None:
        self._points = (np.zeros(0), np.zeros(0))
        self._layers: list[npt.NDArray[np.intp]] = []
        self._start = (0.0, 0.0)
        self._ends = (0.0, 0.0)
        self._sum = 0.0
        self.samples = 0

    def add(self, device: FloatArray, host: FloatArray) -> None:
        """Add the arrivals of a block: device and host times, s, shape (n,) both."""
        if len(device) == 0:
            return
        if self.samples == 0:
            self._start = (float(device[0]), float(host[0]))
        # Relative to the start, because seconds since 1970 would lose digits.
        away = device - self._start[0]
        x = np.concatenate([self._points[0], away])
        y = np.concatenate([self._points[1], (host - self._start[1]) - away])
        outer = lower_hull(x, y)
        rest = np.delete(np.arange(len(x)), outer)
        inner = rest[lower_hull(x[rest], y[rest])]
        hull = np.concatenate([outer, inner])
        self._points = x[hull], y[hull]
        self._layers = [np.arange(len(outer)), np.arange(len(outer), len(hull))]
        self._ends = min(self._ends[0], float(away.min())), max(self._ends[1], float(away.max()))
        self._sum += float(np.sum(away))
        self.samples += len(device)

    def fit(self) -> Clock | None:
        """Return the line, or None with too few arrivals to estimate its uncertainty.

        The uncertainty contains the true line 19 times in 20. It is derived from the shift of the line when the points
        that define it are removed; it does not include the smallest delay, which all arrivals share.
        """
        if not self._layers or min(map(len, self._layers)) < 2:
            return None
        middle = self._sum / self.samples
        lines = [_edge_at(self._points[0][layer], self._points[1][layer], middle) for layer in self._layers]
        (at, drift), (other_at, other_drift) = lines
        # The shift of the line without the points that define it measures how well they define it.
        moved = [abs(other_at - at + (other_drift - drift) * (end - middle)) for end in (*self._ends, middle)]
        return Clock(middle + self._start[0], middle + at + self._start[1], drift, _COVERAGE * max(moved))


def _edge_at(x: FloatArray, y: FloatArray, middle: float) -> tuple[float, float]:
    """Return height at `middle` and slope of the hull's edge there: of all lines below, the closest on average."""
    edge = min(max(int(np.searchsorted(x, middle, side="right")) - 1, 0), len(x) - 2)
    slope = float((y[edge + 1] - y[edge]) / (x[edge + 1] - x[edge]))
    return float(y[edge]) + slope * (middle - float(x[edge])), slope
