"""Starts from standstill and their starting torques: driven by the input without load, or by the output."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from fitting.figures.figure import DEFINITIONS, Figure, half_interval_of_mean
from fitting.readers.recording import Recording

Array = NDArray[np.float64]

_START = math.radians(1.0)  # of the crank: counts as started
_REST = 0.2 * _START  # of the crank: most motion of one at rest
_HALF = 100  # samples; twice as many show whether the crank is at rest
_UNLOADED = 0.1  # most torque at the other shaft, reduced to the driving one, relative to the driving torque


@dataclass(frozen=True)
class Start:
    """One start: samples from standstill until the crank has turned 1°, index and value, N·m, of the largest torque."""

    part: slice
    peak: int
    torque: float


def starts_of(crank: Array, torque: Array, driven: Array) -> list[Start]:
    """Return the starts of a recording: from standstill with almost no torque until the crank has turned 1°.

    Only starts driven by the torque count: it has the direction of the following motion and has risen at least tenfold
    since the standstill began.

    Parameters
    ----------
    crank, torque, driven
        Crank angle, rad, torque, N·m, and angle of the torque's shaft, rad, all of shape (samples,).
    """
    starts = []
    begin = 0
    while begin < crank.size:
        away = np.abs(crank[begin:] - crank[begin]) > _START
        moved = int(np.argmax(away)) if away.any() else 0
        if not moved:
            break
        start = begin + moved
        still = slice(begin, start)
        largest = float(np.abs(torque[still]).max()) if moved > 10 else 0.0
        if largest > 0.0:
            at_rest = abs(float(np.median(torque[begin : begin + max(3, moved // 20)])))
            peak = begin + int(np.argmax(np.abs(torque[still])))
            later = min(start + 10 * moved, crank.size - 1)
            onward, driven_onward = crank[later] - crank[begin], driven[later] - driven[begin]
            if at_rest < 0.1 * largest and abs(onward) > 5.0 * _START and torque[peak] * driven_onward > 0.0:
                starts.append(Start(still, peak, largest))
        begin = start
        # The motion ends when the crank is at rest for more than a few samples.
        halves = crank[begin : crank.size - (crank.size - begin) % _HALF].reshape(-1, _HALF)
        high, low = halves.max(axis=1), halves.min(axis=1)
        turned = np.maximum(high[1:], high[:-1]) - np.minimum(low[1:], low[:-1])
        begin += _HALF * int(np.argmax(np.append(turned, 0.0) <= _REST))
        while begin < crank.size:
            ahead = crank[begin : begin + 2 * _HALF]
            if np.ptp(ahead) <= _REST and ahead.size > 10:
                break
            begin += max(1, ahead.size // 2)
    return starts


def starting_torques(recording: Recording, ratio: float | None) -> tuple[list[Start], list[str]]:
    """Return the starts driven by the input with the output unloaded, and notes on excluded ones.

    A start is unloaded if the torque on the output, divided by the ratio, is less than a tenth of that on the input.

    Parameters
    ----------
    recording
        The recording; without input torque there are no such starts.
    ratio
        Signed ratio input/output, or None.
    """
    if recording.input_torque is None:
        return [], []
    starts = starts_of(recording.input_angle, recording.input_torque, recording.input_angle)
    if not starts:
        return [], [f"{recording.source}: the torque on the input never starts the crank from standstill."]
    if ratio is None:
        return [], [
            f"{recording.source}: no starting_torque: without a ratio it is unknown whether the output is loaded."
        ]
    if np.isnan(recording.torque).all():
        return [], [f"{recording.source}: no starting_torque: the torque on the output is unknown."]
    free = [s for s in starts if float(np.abs(recording.torque[s.part]).max()) < _UNLOADED * abs(ratio) * s.torque]
    if len(free) == len(starts):
        return free, []
    return free, [f"{recording.source}: {len(starts) - len(free)} of {len(starts)} starts are under load; left out."]


def back_driving_torques(recording: Recording, ratio: float | None) -> tuple[list[Start], list[str]]:
    """Return the starts driven by the output, and notes; if the input torque is measured, it must be negligible.

    Parameters
    ----------
    recording, ratio
        As in `starting_torques`; the input torque, times the ratio, must be less than a tenth of that on the output.
    """
    starts = starts_of(recording.input_angle, recording.torque, recording.output_angle)
    given = recording.input_torque
    if given is None or ratio is None:
        return starts, []
    free = [s for s in starts if float(np.abs(given[s.part]).max()) * abs(ratio) < _UNLOADED * s.torque]
    return free, []


STARTS = {"starting_torque": starting_torques, "back_driving_torque": back_driving_torques}
"""{figure: the function that finds its starts}."""


def start_figures(started: Mapping[str, Sequence[Start]]) -> dict[str, Figure]:
    """Return the figures of `STARTS` that have starts, by name."""
    return {name: start_figure(name, [start.torque for start in starts]) for name, starts in started.items() if starts}


def start_figure(name: str, torques: Sequence[float]) -> Figure:
    """Return the mean of the starts' torques, N·m, as a figure; with a single start its uncertainty is unknown."""
    half = half_interval_of_mean(torques) if len(torques) > 1 else math.nan
    degrees = max(len(torques) - 1.0, 1.0)
    return Figure(float(np.mean(torques)), half, *DEFINITIONS[name], None, "", len(torques), "starts", degrees=degrees)
