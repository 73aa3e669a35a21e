"""Fit a closed curve by circular arcs with continuous tangents, within a stated distance.

Each span of the curve becomes a biarc: two arcs with the curve's tangents at the span's ends and a common tangent where
they meet (Bolton, Biarc curves, Computer-Aided Design 7 (1975) 89-92; here with tangents of equal length). Machines
follow arcs and CAD stores them exactly; the offset of an arc by a tool radius is an arc again.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cycloid_fmu.cad.outline import Array, Points, Tooth

_SAMPLES = 17  # points checked in a span, besides the knots of its form deviation
_AIM = 0.8  # of the limit at the samples, so that the curve between them stays within it
_SHORTEST = 1e-7  # shortest span, as a share of a tooth


def bulges_of(start: Points, end: Points, tangent: Points) -> Array:
    """Return the bulges, as in DXF, of arcs between two points with a tangent at the first.

    A bulge is the tangent of a quarter of the arc's angle, > 0 counter-clockwise.
    """
    return np.asarray(np.tan(0.5 * np.angle((end - start) / tangent)))


def biarc(start: complex, along: complex, end: complex, at_end: complex) -> tuple[complex, complex]:
    """Return the point where the two arcs meet, and their common unit tangent there.

    Parameters
    ----------
    start, end
        Ends of the span.
    along, at_end
        Unit tangents at these ends.
    """
    way, both = end - start, along + at_end
    onto = (way * both.conjugate()).real
    bend = 2.0 * (1.0 - (along * at_end.conjugate()).real)
    length = abs(way) ** 2 / (onto + np.sqrt(onto * onto + bend * abs(way) ** 2))
    meet = 0.5 * (start + end + length * (along - at_end))
    return meet, (end - start - length * both) / abs(end - start - length * both)


def distances(points: Points, start: complex, end: complex, tangent: complex) -> Array:
    """Return the distances of points from the circle, or line, of an arc, > 0 on its left, m."""
    chord = end - start
    bend = 2.0 * (chord / tangent).imag / abs(chord) ** 2
    off = (points - start) / tangent
    return np.asarray(
        (2.0 * off.imag - bend * np.abs(off) ** 2)
        / (1.0 + np.sqrt(np.maximum(1.0 - 2.0 * bend * off.imag + bend * bend * np.abs(off) ** 2, 0.0)))
    )


def arcs_of(teeth: Sequence[Tooth], limit: float) -> tuple[Points, Array, float]:
    """Fit arcs to an outline.

    Parameters
    ----------
    teeth
        The outline, tooth after tooth.
    limit
        Largest distance of the outline from the arcs, m.

    Returns
    -------
    start, bulge
        Start of each arc, m, counter-clockwise, and its bulge as in `bulges_of`, shape (arcs,); the last arc ends at
        the first start.
    largest
        Largest distance of the outline from the arcs, m, in a search eight times as fine as in the fit.
    """
    aim, nodes = _AIM * limit, _joints(teeth)
    alike = all(_same(tooth, teeth[0]) for tooth in teeth)
    while True:
        fitted = [
            _fitted(tooth, nodes[j], nodes[(j + 1) % len(teeth)], aim)
            for j, tooth in enumerate(teeth[:1] if alike else teeth)
        ]
        largest = max(one[2] for one in fitted)
        if largest <= limit:
            break
        aim *= 0.7
    if alike:
        turned = [tooth.turned / teeth[0].turned for tooth in teeth]
        fitted = [(by * fitted[0][0], by * fitted[0][1], largest) for by in turned]
    start, tangent = (np.concatenate([one[k] for one in fitted]) for k in range(2))
    return start, bulges_of(start, np.roll(start, -1), tangent), largest


def _same(one: Tooth, other: Tooth) -> bool:
    return (one.low, one.high) == (other.low, other.high) and np.array_equal(one.heights, other.heights)


def _joints(teeth: Sequence[Tooth]) -> list[tuple[complex, complex]]:
    """Points where each tooth begins, and the mean of the tangents on both sides."""
    found = []
    for before, after in zip([teeth[-1], *teeth[:-1]], teeth, strict=True):
        point = 0.5 * complex(before.points(before.high) + after.points(after.low))
        tangent = complex(before.tangents(before.high) + after.tangents(after.low))
        found.append((point, tangent / abs(tangent)))
    return found


def _fitted(
    tooth: Tooth, first: tuple[complex, complex], last: tuple[complex, complex], aim: float
) -> tuple[Points, Points, float]:
    """Start points of one tooth's arcs, the tangents there, and the largest distance in a finer search."""
    places, tangents, largest = list[complex](), list[complex](), 0.0
    at, (point, tangent) = tooth.low, first
    step = 0.02 * (tooth.high - tooth.low)
    while at < tooth.high:
        while True:
            to = at + step
            if to >= tooth.high - 0.3 * step:
                to = tooth.high if to >= tooth.high else 0.5 * (at + tooth.high)
            end = last
            if to < tooth.high:
                end = complex(tooth.points(to)), complex(tooth.tangents(to))
            meet = biarc(point, tangent, *end)
            off = _largest(tooth, at, to, (point, tangent), meet, end[0], _SAMPLES)
            ideal = 0.9 * (to - at) * float(np.cbrt(aim / max(off, 1e-3 * aim)))
            if off <= aim or to - at < _SHORTEST * (tooth.high - tooth.low):
                break
            step = max(ideal, 0.1 * (to - at))
        largest = max(largest, _largest(tooth, at, to, (point, tangent), meet, end[0], 8 * _SAMPLES))
        places += [point, meet[0]]
        tangents += [tangent, meet[1]]
        at, (point, tangent), step = to, end, min(ideal, 2.0 * (to - at))
    return np.array(places), np.array(tangents), largest


def _largest(
    tooth: Tooth,
    low: float,
    high: float,
    start: tuple[complex, complex],
    meet: tuple[complex, complex],
    end: complex,
    samples: int,
) -> float:
    """Largest distance of a span of the curve from its two arcs."""
    alpha = np.linspace(low, high, samples)
    if tooth.knots.size:
        inside = tooth.knots[(tooth.knots > low) & (tooth.knots < high)]
        edges = np.concatenate([[low], inside, [high]])
        between = np.linspace(edges[:-1], edges[1:], max(3, samples // edges.size), axis=1).ravel()
        alpha = np.concatenate([alpha, between])
    points = tooth.points(alpha)
    beyond = ((points - meet[0]) * np.conj(meet[1])).real > 0.0
    off = np.where(beyond, distances(points, meet[0], end, meet[1]), distances(points, start[0], meet[0], start[1]))
    return float(np.abs(off).max())
