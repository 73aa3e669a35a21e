"""Loops of several sizes, or at several positions, in one recording, as data."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence

import numpy as np
import scipy  # a part of it is loaded where it is first used
from numpy.typing import NDArray

from fitting.readers.recording import Recording
from fitting.transmission_error.loops import Lobe, LoopData, find_lobes, find_loops, sample_noise, windup_of

Array = NDArray[np.float64]

_SMALLEST = 0.03  # of the recording's largest torque: a smaller group is noise
ALIKE = 0.75  # of a group's largest torque: a loop that reaches less belongs to another group
_SHIFTED = 0.5  # of a group's width in windup: a loop whose peak is further away is at another position
_FEWEST = 8  # samples of a branch
_QUIET = 0.02  # of the largest torque: noise that breaks no half loop in two


def _stretches(torque: Array, windup: Array, start: int, stop: int, least: float) -> list[list[Lobe]]:
    """Return the half loops of a part of a recording by groups, in the order of time."""
    part = _smoothed(torque[start:stop])
    largest = float(np.abs(part).max(initial=0.0))
    if not largest > least:
        return []
    lobes = [_moved(lobe, start) for lobe in find_lobes(part, largest)]
    lobes = [lobe for lobe in lobes if min(_length(lobe.loading), _length(lobe.unloading)) >= _FEWEST]
    if not lobes:
        return []
    groups: list[list[Lobe]] = []
    for lobe in lobes:
        if groups and _alike(torque, windup, groups[-1], lobe):
            groups[-1].append(lobe)
        else:
            groups.append([lobe])
    groups = [_at_one_position(windup, group) for group in groups]
    before = _stretches(torque, windup, start, lobes[0].loading.start, least)
    return before + groups + _stretches(torque, windup, lobes[-1].unloading.stop, stop, least)


def _smoothed(torque: Array) -> Array:
    """Return a torque whose noise breaks no half loop in two: a mean over so many samples that it is small."""
    if torque.size < _FEWEST:
        return torque
    size = (sample_noise(torque) / (_QUIET * float(np.abs(torque).max()) + 1e-300)) ** 2
    return np.asarray(scipy.ndimage.uniform_filter1d(torque, int(min(max(math.ceil(size), 1), torque.size // _FEWEST))))


def _moved(lobe: Lobe, by: int) -> Lobe:
    return Lobe(lobe.sign, *(slice(part.start + by, part.stop + by) for part in (lobe.loading, lobe.unloading)))


def _length(part: slice) -> int:
    return int(part.stop - part.start)


def _alike(torque: Array, windup: Array, group: list[Lobe], lobe: Lobe) -> bool:
    """Whether a half loop is as large as those of a group, and goes as far as the last one on its side."""
    reached = [float(np.abs(torque[each.loading.start : each.unloading.stop]).max()) for each in (*group, lobe)]
    if min(reached) < ALIKE * max(reached):
        return False
    peaks = {each.sign: float(windup[each.loading.stop]) for each in group}
    width = abs(peaks[1] - peaks[-1]) if len(peaks) > 1 else math.inf
    return abs(float(windup[lobe.loading.stop]) - peaks.get(lobe.sign, math.nan)) < _SHIFTED * width or (
        lobe.sign not in peaks
    )


def _at_one_position(windup: Array, group: list[Lobe]) -> list[Lobe]:
    """Return half loops without the way from the position before them and to the one after them."""
    first, last = group[0].loading.stop, group[-1].unloading.start
    here = windup[first : last + 1]
    beyond = _SHIFTED * float(np.ptp(here)) if len(group) > 1 else math.inf
    away = (windup < here.min() - beyond) | (windup > here.max() + beyond)
    before, after = np.flatnonzero(away[:first]), np.flatnonzero(away[last:])
    start = max(group[0].loading.start, int(before[-1]) + 1 if before.size else 0)
    stop = min(group[-1].unloading.stop, last + int(after[0]) if after.size else windup.size)
    trimmed = [Lobe(group[0].sign, slice(start, first), group[0].unloading), *group[1:]]
    trimmed[-1] = Lobe(group[-1].sign, trimmed[-1].loading, slice(last, stop))
    return trimmed


def _stated(recording: Recording) -> list[tuple[int, int, float | None]]:
    """Return begin, end and number of each part of a recording with one number of a group; one part without any."""
    number = recording.group
    if number is None:
        return [(0, recording.torque.size, None)]
    ends = [0, *(np.flatnonzero(np.diff(number) != 0.0) + 1), number.size]
    return [(int(a), int(b), float(number[a])) for a, b in itertools.pairwise(ends)]


def loop_groups(recording: Recording, ratio: float | None) -> list[LoopData]:
    """Return the loops of a recording by size and position, each group as a recording of its own, the largest first.

    Loops are of one group where they are alike and follow one another, and the recording states no other number of a
    group for them. A group's rated torque is the largest that it reaches.

    Parameters
    ----------
    recording, ratio
        As in `hysteresis.loops_of`.
    """
    torque, windup = recording.torque, windup_of(recording, ratio)
    largest = float(np.abs(torque).max(initial=0.0))
    groups = []
    parts = [
        (lobes, number)
        for begin, end, number in _stated(recording)
        for lobes in _stretches(torque, windup, begin, end, _SMALLEST * largest)
    ]
    for lobes, number in parts:
        start, stop = lobes[0].loading.start, lobes[-1].unloading.stop
        here = slice(start, stop)
        own = [_moved(lobe, -start) for lobe in lobes]
        loops, quiet = tuple(find_loops(own)), _smoothed(torque[here])
        if loops:
            groups.append(
                LoopData(
                    recording.time[here],
                    quiet,
                    windup[here] - windup[here].mean(),
                    loops,
                    tuple(own),
                    float(np.abs(quiet).max()),
                    recording.source,
                    group=number,
                )
            )
    return sorted(groups, key=lambda group: -group.rated_torque)


def positions_of(groups: Sequence[LoopData]) -> tuple[list[LoopData], list[LoopData]]:
    """Return the loops of the largest size at each position, in the order of time, and the smaller groups."""
    largest = max((group.rated_torque for group in groups), default=0.0)
    large = [group for group in groups if group.rated_torque > ALIKE * largest]
    smaller = [group for group in groups if group.rated_torque <= ALIKE * largest]
    return sorted(large, key=lambda data: float(data.time[0])), smaller
