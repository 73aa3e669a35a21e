"""Hysteresis loops as data of the identification: their branches as curves over the torque, and the play in them.

With the input locked at a crank angle a loop is the drive's windup there at every torque, whereas a transmission error
curve is at one torque and every angle. Beyond friction and play each of its four branches is loaded contact, predicted
by the exact model at that angle. Friction is the distance between loading and unloading, play the distance between the
sides.
"""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.analysis import sensitivity, solve
from cycloid_fmu.drive import Drive
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.geometry.pair import LOST_MOTION_LOAD, Pair
from cycloid_fmu.supports.transmission import play_loads
from cycloid_fmu.surfaces.structured import displacement_columns
from fitting.model.first_stage import of_cranks
from fitting.readers.recording import Recording, RecordingStream
from fitting.readers.sources import Source, each_source, open_source
from fitting.samples.plausible import PlausibleBlocks
from fitting.transmission_error.curve import Curve, refuse_repeated, whole_turns
from fitting.transmission_error.folding import LOCKED, curves
from fitting.transmission_error.mid_curve import evaluated
from fitting.transmission_error.survey import Surveyed, survey

Array = NDArray[np.float64]

BINS = 24  # steps of the torque on a branch
_LEAST = 4  # samples in each step
_REVERSAL = 1.25  # excluded range at zero and at the peak, over that in which friction reverses: twice the friction
_REACH = 0.97  # largest torque of a branch over the peak
NO_TORQUE = 1e-2  # N·m: one flank touches at each end, with hardly any deflection


@dataclass(frozen=True)
class LoopFit:
    """A loop after the fit.

    Attributes
    ----------
    source, crank_angle
        The recording, and the angle of the locked input, rad.
    torque, measured, fitted
        Torque (N·m) and windup including the bench (rad) at the points of each branch, lists of arrays.
    play, standard_error
        Free rotation at this angle from the identified errors, rad, without friction.
    """

    source: str
    crank_angle: float
    torque: dict[str, Array]
    measured: dict[str, Array]
    fitted: dict[str, Array]
    play: float
    standard_error: float


def is_locked(stream: Recording | RecordingStream, ratio: float) -> bool:
    """Whether the input of a recording is at rest, except for the compliance of its fixture, as in a loop."""
    low, high = np.inf, -np.inf
    for block in PlausibleBlocks(stream, ratio):
        if block.input_angle.size:
            low, high = min(low, float(block.input_angle.min())), max(high, float(block.input_angle.max()))
        if high - low > LOCKED:
            return False
    return True


def _checked_drive(stream: Recording | RecordingStream, drive: Drive) -> Recording | RecordingStream:
    """Return a recording; one that states the fingerprint of another drive is refused."""
    nominal = drive.pair.nominal
    known = (drive.hash, nominal.hash, Drive(nominal).hash)
    if re.fullmatch("[0-9a-f]{16}", stream.pair) and stream.pair not in known:
        raise edge.InputError(
            f"{stream.source}: it was recorded of the drive {stream.pair}; this one is {drive.hash}, its nominal pair "
            f"{nominal.hash}."
        )
    return stream


def observed_curves(
    recordings: Source | Curve | Iterable[Source | Curve], drive: Drive, *, keep_turns: bool = False
) -> list[Curve]:
    """Return the curves of recordings, and after them the branches of those with the input at rest, which are loops.

    Raises
    ------
    edge.InputError
        If a recording can't be read, is of another drive, gives neither, or is given twice.
    """
    pair, ratio = drive.pair, drive.ratio
    given: list[Source | Curve] = each_source(recordings)
    found = [one for one in given if isinstance(one, Curve)]
    sources = [one for one in given if not isinstance(one, Curve)]
    locked = [is_locked(_checked_drive(open_source(source, ratio), drive), ratio) for source in sources]
    found += curves(
        [source for source, still in zip(sources, locked, strict=True) if not still], ratio, keep_turns=keep_turns
    )
    for one in itertools.compress(sources, locked):
        found += branches_of(survey(open_source(one, ratio), ratio, pair.rated_torque), ratio)
    if loadless := next((one for one in found if np.isnan(one.torque)), None):
        raise edge.InputError(
            f"{loadless.source}: the torque is unknown; a model needs the load. State a constant one as value of "
            "[torque] in the mapping."
        )
    refuse_repeated([curve for curve in found if not curve.branch])
    return [of_cranks(one, drive) for one in found]


def branches_of(surveyed: Surveyed, ratio: float) -> list[Curve]:
    """Return the branches of a recorded loop as curves over the torque: loading and unloading on either side.

    Each begins at 3 % of the rated torque, or beyond play and friction, and is averaged in `BINS` equal
    steps of the torque over all the recording's loops.

    Parameters
    ----------
    surveyed
        A recording with the input locked.
    ratio
        Signed ratio.

    Raises
    ------
    edge.InputError
        If there is no loop in it, its crank angle is unknown, one side was not loaded, or a branch has too few samples.
    """
    loop, recording = surveyed.loops, surveyed.overview
    if loop is None:
        raise edge.InputError("\n".join(surveyed.notes) or f"{surveyed.source}: there is no loop.")
    if not loop.loops:
        raise edge.InputError(f"{surveyed.source}: the loop loads one side only; the play is between both.")
    if not recording.has_input_angle:
        raise edge.InputError(
            f"{surveyed.source}: no input angle is mapped; a fit needs the crank angle at which the loop was recorded."
        )
    crank = recording.input_angle
    error = recording.output_angle - crank / ratio
    evaluation = evaluated(loop)
    friction, growth = np.inf, 0.0
    if evaluation is not None:
        friction, growth = (max(evaluation.values[n], 0.0) for n in ("friction_torque", "friction_per_load"))
    found = []
    for side in (1, -1):
        for loading in (True, False):
            parts = [lobe.loading if loading else lobe.unloading for lobe in loop.lobes if lobe.sign == side]
            at = np.concatenate([np.arange(part.start, part.stop) for part in parts])
            name = f"{'positive' if side > 0 else 'negative'} {'loading' if loading else 'unloading'}"
            found.append(
                _branch(
                    surveyed, loop.torque[at], error[at], crank[at], (name, side, loading), (friction, growth), ratio
                )
            )
    return found


def _branch(
    surveyed: Surveyed,
    torque: Array,
    error: Array,
    crank: Array,
    which: tuple[str, int, bool],
    friction: tuple[float, float],
    ratio: float,
) -> Curve:
    name, side, loading = which
    assert surveyed.loops is not None
    size = side * torque
    peak = float(size.max())
    without_load, growth = friction
    low = max(LOST_MOTION_LOAD * surveyed.loops.rated_torque, 2.0 * _REVERSAL * without_load)
    high = _REACH * peak
    if not loading:
        reversing = 2.0 * (without_load + growth * peak) / (1.0 + growth)
        high = min(high, peak - _REVERSAL * reversing)
    if not high > low:
        raise edge.InputError(
            f"{surveyed.source}: friction hides the {name} branch of the loop, which reaches {peak:.4g} N·m: the play "
            "is within the friction. Load the drive further, or take play and stiffness from friction_free of "
            "cycloid-fit metrics."
        )
    index = np.floor((size - low) / (high - low) * BINS).astype(int)
    inside = (index >= 0) & (index < BINS)
    count = np.bincount(index[inside], minlength=BINS)
    if count.min() < _LEAST:
        raise edge.InputError(
            f"{surveyed.source}: the {name} branch of the loop has {np.count_nonzero(inside)} samples from {low:.4g} "
            f"to {high:.4g} N·m; at least {BINS * _LEAST}, evenly over the torque, are needed."
        )

    def mean(values: Array) -> Array:
        return np.asarray(np.bincount(index[inside], values[inside], BINS) / count)

    at, windup = mean(torque), mean(error)
    # Within a step the windup is linear, with the slope between the means of the steps.
    residual = error - windup[np.clip(index, 0, BINS - 1)]
    residual -= np.gradient(windup, at)[np.clip(index, 0, BINS - 1)] * (torque - at[np.clip(index, 0, BINS - 1)])
    scatter = np.sqrt(np.bincount(index[inside], residual[inside] ** 2, BINS) / (count - 1.0))
    motion = side if loading else -side
    recording = surveyed.overview
    return Curve(
        input_angle=mean(crank),
        transmission_error=windup,
        standard_error=scatter / np.sqrt(count),
        sample_count=count.astype(np.int64),
        torque=float(at.mean()),
        torque_deviation=float(at.std()),
        direction=motion * (1 if ratio > 0.0 else -1),
        ratio=ratio,
        common_zero=recording.common_zero,
        known_index=recording.known_index,
        source=surveyed.source,
        checksum=surveyed.checksum,
        torque_each=at,
        branch=name,
        implausible=surveyed.implausible,
        notes=surveyed.notes,
    )


def on_the_curves_zero(branches: Sequence[Curve], curves: Sequence[Curve]) -> list[Curve]:
    """Return branches with the crank's turns counted as in the curves, if the output's zero is common.

    An input encoder with an angle within one turn does not give the tooth of the output; an absolute output encoder
    does.
    """
    absolute = [float(np.mean(c.transmission_error)) for c in curves if c.common_zero]
    found = []
    for branch in branches:
        turn = 2.0 * np.pi / branch.ratio
        passed, output = 0.0, 0.0
        if branch.common_zero and absolute:
            away = float(np.mean(branch.transmission_error) - np.mean(absolute))
            output = float(whole_turns(away))
            passed = round((away - output) / turn)
        crank = branch.input_angle + 2.0 * np.pi * passed
        found.append(
            dataclasses.replace(
                branch,
                input_angle=np.mod(crank, 2.0 * np.pi * abs(branch.ratio)),
                transmission_error=branch.transmission_error - output - passed * turn,
            )
        )
    return found


def play_of(drive: DriveValue, crank_angle: float, names: Sequence[str]) -> tuple[float, Array, Array]:
    """Return the play at a crank angle and its derivatives, from the two flanks in contact at its ends.

    Parameters
    ----------
    drive
        The drive.
    crank_angle
        Angle of the locked input, rad.
    names
        Structured errors.

    Returns
    -------
    play, by_error, each
        rad, 0 where there is interference; its derivatives by the errors, shape (names,), and by every single
        one, columns as in `contact.sensitivities`.
    """
    pair = drive.pair
    ends = sorted(play_loads(pair)) if pair.supports is not None else [-NO_TORQUE, NO_TORQUE]
    each = sensitivity(drive, ends, [crank_angle] * 2).by_displacement
    jacobian = each @ displacement_columns(pair, names)
    play = float(np.nan_to_num(solve(drive, ends[1], crank_angle).backlash[0]))
    return play, jacobian[1] - jacobian[0], each[1] - each[0]


def planned_branches(pair: Pair, torque: float, crank_angle: float, number: int) -> list[Curve]:
    """Return the branches of a loop to a torque (N·m) with the input locked at a crank angle (rad), all errors zero."""
    size = torque * np.linspace(LOST_MOTION_LOAD, _REACH, BINS)
    motions = {
        "positive loading": (1, 1),
        "positive unloading": (1, -1),
        "negative loading": (-1, -1),
        "negative unloading": (-1, 1),
    }
    return [
        Curve(
            input_angle=np.full(BINS, crank_angle),
            transmission_error=np.zeros(BINS),
            standard_error=np.full(BINS, np.nan),
            sample_count=np.ones(BINS, dtype=np.int64),
            torque=float(side * size.mean()),
            torque_deviation=0.0,
            direction=motion * (1 if pair.ratio > 0.0 else -1),
            ratio=pair.ratio,
            common_zero=False,
            known_index=True,
            source=f"planned loop {number}",
            checksum="",
            torque_each=side * size,
            branch=name,
        )
        for name, (side, motion) in motions.items()
    ]
