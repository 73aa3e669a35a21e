"""Starts from a standstill, and their starting torques: by the input without load, by the output."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from fitting.figures.figure import DEFINITIONS, UNITS, Figure
from fitting.recordings.recording import Recording

Array = NDArray[np.float64]

_START = math.radians(1.0)  # of the crank: it has started
_UNLOADED = 0.1  # of the torque on the input is what the output's may take of it in a start without load


@dataclass(frozen=True)
class Start:
    """One start: the samples from the standstill until the crank has turned a degree, and the largest torque in it."""

    part: slice
    peak: int
    torque: float


def starts_of(crank: Array, torque: Array, driven: Array) -> list[Start]:
    """Return the starts of a recording: from a standstill with almost no torque until the crank has turned a degree.

    Only starts in which the torque drives are counted: it has the direction of the following motion, and has risen at
    least tenfold since the standstill began.

    Parameters
    ----------
    crank, torque, driven
        Crank angle (rad), torque (N·m) and angle (rad) of its shaft, arrays of shape (samples,).
    """
    found = []
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
            onward, way = crank[later] - crank[begin], driven[later] - driven[begin]
            if at_rest < 0.1 * largest and abs(onward) > 5.0 * _START and torque[peak] * way > 0.0:
                found.append(Start(still, peak, largest))
        begin = start
        # Motion goes on until the crank stands within the degree again for longer than a few samples.
        while begin < crank.size:
            ahead = crank[begin : begin + 200]
            if np.ptp(ahead) <= 0.2 * _START and ahead.size > 10:
                break
            begin += max(1, ahead.size // 2)
    return found


def starting_torques(recording: Recording, ratio: float | None) -> tuple[list[Start], list[str]]:
    """Return the starts by a torque on the input with the output unloaded, and the reasons for excluding others.

    A start is without load if the torque on the output, divided by the ratio, is less than a tenth of that on the
    input.

    Parameters
    ----------
    recording
        The recording; without input torque there are no such starts.
    ratio
        Signed ratio.
    """
    if recording.input_torque is None:
        return [], []
    starts = starts_of(recording.input_angle, recording.input_torque, recording.input_angle)
    if not starts:
        return [], [f"{recording.source}: the torque on the input never starts the crank from a standstill."]
    if ratio is None:
        return [], [
            f"{recording.source}: no starting_torque: without a ratio it is unknown whether the output is loaded."
        ]
    free = [s for s in starts if float(np.abs(recording.torque[s.part]).max()) < _UNLOADED * abs(ratio) * s.torque]
    if len(free) == len(starts):
        return free, []
    return free, [f"{recording.source}: {len(starts) - len(free)} of {len(starts)} starts are under load; left out."]


def back_driving_torques(recording: Recording, ratio: float | None) -> tuple[list[Start], list[str]]:
    """Return the starts by a torque on the output; if the input torque is measured, those not caused by it.

    Parameters
    ----------
    recording, ratio
        As in `starting_torques`, with the reverse rule.
    """
    starts = starts_of(recording.input_angle, recording.torque, recording.output_angle)
    given = recording.input_torque
    if given is None or ratio is None:
        return starts, []
    free = [s for s in starts if float(np.abs(given[s.part]).max()) * abs(ratio) < _UNLOADED * s.torque]
    return free, []


def start_figure(name: str, torques: Sequence[float]) -> Figure:
    """Return the mean of starts' torques (N·m) as a figure; with one start its uncertainty is unknown."""
    half = math.nan
    if len(torques) > 1:
        quantile = float(stdtrit(len(torques) - 1, 0.975))
        half = quantile * float(np.std(torques, ddof=1)) / math.sqrt(len(torques))
    return Figure(
        float(np.mean(torques)),
        half,
        UNITS[name],
        DEFINITIONS[name],
        None,
        "",
        len(torques),
        "starts",
        degrees=max(len(torques) - 1.0, 1.0),
    )
