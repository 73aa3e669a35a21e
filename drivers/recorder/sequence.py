"""A guided test sequence: the runs of a bench, each checked and recorded in a file."""

from __future__ import annotations

import contextlib
import dataclasses
import itertools
import math
import os
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import numpy as np
import pydantic

from cycloid_fmu import edge
from drivers import recording_format as rf
from drivers.recorder.actuator import Actuator
from drivers.recorder.bench import Bench, open_encoders, read_bench
from drivers.recorder.in_use import Claims
from drivers.recorder.session import ChannelState, Live, interrupts, record_encoders
from drivers.recording_format import Samples, read_recording

FORMAT = "cycloid-sequence/1"
_STANDS = math.radians(0.5)  # largest motion of a locked input
_NEAR_ZERO = 0.02  # of the loop's torque: counts as zero
_AT_PEAK = 0.98  # of the loop's torque: counts as its peak
_WAIT_STEP = 0.05  # s: after which a signal is noticed
_IDLE_SECONDS = 3.0  # of silence that end a step which nobody watches

Direction: TypeAlias = Literal["forward", "backward"]


class _Hysteresis(edge.Config):
    """A step with the input locked, in which the torque goes to both sides and back.

    Attributes
    ----------
    torque
        Largest torque of the loop in both directions, N*m.
    loops
        Number of loops.
    """

    torque: edge.Torque
    loops: Annotated[int, pydantic.Field(ge=1)] = 1


class SequenceFile(edge.Config):
    """Content of a `SEQUENCE.toml`.

    Attributes
    ----------
    bench
        The `BENCH.toml`, relative to the sequence's folder.
    loads, speeds, directions
        Brake torques, N*m, >= 0, which oppose the motion; crank speeds, rad/s, > 0; directions of the crank. Each
        combination is a step.
    turns
        Crank turns of a step.
    load_tolerance, speed_tolerance
        Largest deviations of the mean torque, N*m, and of the mean speed, rad/s, from those of the step.
    hysteresis
        Loops with the input locked: peak torque, N*m, and number of loops.
    wait
        Time to wait before the recording of each step, s: instead of a prompt where the bench runs by itself, and after
        its `[actuator]` has set torque and speed.
    """

    bench: str
    loads: list[Annotated[edge.Torque, pydantic.Field(ge=0)]] = pydantic.Field(default_factory=list)
    speeds: list[Annotated[edge.Speed, pydantic.Field(gt=0)]] = pydantic.Field(default_factory=list)
    directions: tuple[Direction, ...] = ("forward", "backward")
    turns: Annotated[float, pydantic.Field(gt=0)] = 1.0
    load_tolerance: Annotated[edge.Torque, pydantic.Field(gt=0)] = 1.0
    speed_tolerance: Annotated[edge.Speed, pydantic.Field(gt=0)] = 1.0
    hysteresis: _Hysteresis | None = None
    wait: Annotated[edge.Seconds, pydantic.Field(ge=0)] | None = None


@dataclasses.dataclass(frozen=True)
class Step:
    """One recording to make.

    Attributes
    ----------
    name
        Name of its file, without the ending.
    torque
        Signed mean torque on the output, N*m, or the peak torque of a hysteresis loop.
    speed
        Crank speed, rad/s; 0: the input is locked.
    direction
        Direction of the crank.
    turns
        Crank turns, or number of loops.
    """

    name: str
    torque: float
    speed: float
    direction: Direction
    turns: float

    @property
    def is_hysteresis(self) -> bool:
        """Whether the step is a hysteresis loop: the input is locked and the torque cycles."""
        return self.speed == 0

    @property
    def conditions(self) -> dict[str, float | str]:
        """Conditions in the header of its recording."""
        return {"load": self.torque, "speed": self.speed, "direction": self.direction}

    def instruction(self) -> str:
        """Return the instruction for the operator."""
        if self.is_hysteresis:
            peak = f"{self.torque:g}"
            return f"Lock the input. Torque 0 → +{peak} → 0 → −{peak} → 0 N*m, {self.turns:g} times."
        rpm = self.speed * 30 / math.pi
        return f"{rpm:g} rpm {self.direction}, {self.torque:+g} N*m on the output, {self.turns:g} crank turns."


@dataclasses.dataclass(frozen=True)
class BenchSequence:
    """A sequence to run: file content, bench, steps and folder."""

    file: SequenceFile
    bench: Bench
    steps: tuple[Step, ...]
    folder: Path

    @property
    def is_prompted(self) -> bool:
        """Whether the operator starts each step."""
        return self.bench.actuator is None and self.file.wait is None


def read_sequence(path: str | os.PathLike[str], *, allow: Collection[str] = ()) -> BenchSequence:
    """Read a `SEQUENCE.toml` and its `BENCH.toml` and check them as far as possible without a device.

    Parameters
    ----------
    path
        The file.
    allow
        See `read_bench`.

    Raises
    ------
    edge.InputError
        If a file is invalid, or the torque sensor can't measure a load; names file and key.
    """
    source = str(path)
    folder = Path(path).parent
    file = edge.validated(SequenceFile, edge.toml_table(edge.read_text(path, FORMAT), FORMAT, source), source)
    bench = read_bench(folder / file.bench, allow=allow)
    if bool(file.loads) != bool(file.speeds):
        raise edge.InputError(f"{source}: loads and speeds belong together; write both or neither.")
    if not file.loads and file.hysteresis is None:
        raise edge.InputError(f"{source}: there is no step; write loads and speeds, or [hysteresis].")
    if file.loads and bench.ratio is None:
        raise edge.InputError(
            f"{folder / file.bench}: ratio is missing: its sign gives the sign of the brake's torque."
        )
    steps = _steps(file, bench.ratio or -1.0)
    _check_range(bench, file, source)
    return BenchSequence(file, bench, steps, folder)


def _steps(file: SequenceFile, ratio: float) -> tuple[Step, ...]:
    steps = []
    for speed, load, direction in itertools.product(file.speeds, file.loads, file.directions):
        turning = (1.0 if direction == "forward" else -1.0) * math.copysign(1.0, ratio)
        rpm = speed * 30 / math.pi
        name = f"{rpm:g}rpm-{load:g}Nm-{direction}"
        steps.append(Step(name, -turning * load, speed, direction, file.turns))
    if file.hysteresis is not None:
        loop = file.hysteresis
        steps.append(Step(f"hysteresis-{loop.torque:g}Nm", loop.torque, 0.0, "forward", float(loop.loops)))
    return tuple(steps)


def _check_range(bench: Bench, file: SequenceFile, source: str) -> None:
    """Refuse loads that the torque sensor can't measure."""
    wanted = [("loads", sign * load) for load in file.loads for sign in (1, -1)]
    if file.hysteresis is not None:
        wanted += [("[hysteresis] torque", sign * file.hysteresis.torque) for sign in (1, -1)]
    for encoder in bench.encoders():
        if getattr(encoder, "name", None) != "torque" or encoder.measuring_range is None:
            continue
        low, high = encoder.measuring_range
        for key, torque in wanted:
            if not low <= torque <= high:
                raise edge.InputError(
                    f"{source}: {key}: {torque:g} N*m is outside the range of the torque sensor, "
                    f"{low:g} to {high:g} N*m."
                )


def shortfalls(step: Step, samples: dict[str, Samples], file: SequenceFile) -> list[str]:
    """Return the deviations of a recording from its step, one sentence each.

    Parameters
    ----------
    step
        The step.
    samples
        Samples by role: "input_angle", "output_angle" and "torque".
    file
        The sequence, for its tolerances.
    """
    sentences = [
        f"there is no sample of {role}" for role in ("input_angle", "torque") if not len(samples.get(role, ()))
    ]
    if sentences:
        return sentences
    angle, torque = samples["input_angle"], samples["torque"].value
    rotation = angle.value[-1] - angle.value[0]
    if step.is_hysteresis:
        moved = float(np.ptp(angle.value))
        if moved > _STANDS:
            sentences.append(f"the input is not locked: it moved by {math.degrees(moved):.2f} deg")
        for name, reached in (("highest", float(torque.max())), ("lowest", -float(torque.min()))):
            if reached < _AT_PEAK * step.torque:
                sentences.append(f"the {name} torque reaches {reached:.4g} of {step.torque:.4g} N*m")
        if abs(torque[-1]) > 2 * _NEAR_ZERO * step.torque:
            sentences.append(f"the torque ends at {torque[-1]:.4g} N*m, not at zero")
        return sentences
    if rotation * (1 if step.direction == "forward" else -1) < 0:
        other = "backward" if step.direction == "forward" else "forward"
        sentences.append(f"the crank turns {other}, not {step.direction}")
    turned = abs(rotation) / (2 * math.pi)
    if turned < step.turns * (1 - 1e-3) - 0.05:
        sentences.append(f"the crank makes {turned:.3g} turns, not {step.turns:g}")
    mean, spread = float(torque.mean()), float(torque.std())
    if abs(mean - step.torque) > file.load_tolerance:
        sentences.append(f"the mean torque is {mean:.4g} N*m, not {step.torque:.4g} ± {file.load_tolerance:.3g}")
    if spread > 3 * file.load_tolerance:
        sentences.append(f"the torque varies by {spread:.3g} N*m rms")
    lasts = float(angle.time_host[-1] - angle.time_host[0])
    speed = abs(rotation) / lasts if lasts > 0 else math.inf
    if abs(speed - step.speed) > file.speed_tolerance:
        sentences.append(
            f"the mean speed is {speed * 30 / math.pi:.4g} rpm, not {step.speed * 30 / math.pi:.4g} ± "
            f"{file.speed_tolerance * 30 / math.pi:.3g}"
        )
    return sentences


class _End:
    """Detects from the recording so far that a step is complete."""

    def __init__(self, step: Step) -> None:
        self.step = step
        self._peaks = 0
        self.reached = False

    def __call__(self, live: Live) -> None:
        """Check the newest blocks."""
        angle, torque = (live.channels.get(n) for n in ("input_angle", "torque"))
        if self.step.is_hysteresis:
            if torque is not None and torque.value is not None:
                self._pass_peaks(torque)
                done = self._peaks == 2 * self.step.turns
                self.reached = done and abs(torque.value) <= _NEAR_ZERO * self.step.torque
        elif angle is not None and angle.value is not None and angle.first is not None:
            self.reached = abs(angle.value - angle.first) >= 2 * math.pi * self.step.turns

    def _pass_peaks(self, torque: ChannelState) -> None:
        """Count the peaks of the loops, alternately positive and negative."""
        peak = _AT_PEAK * self.step.torque
        for _ in range(2):  # a block may hold one of each
            furthest = torque.highest if self._peaks % 2 == 0 else -(torque.lowest or 0.0)
            if self._peaks < 2 * self.step.turns and furthest is not None and furthest >= peak:
                self._peaks += 1


def _run_step(
    sequence: BenchSequence, step: Step, path: Path, actuator: Actuator | None, progress: Callable[[Live], None]
) -> list[str]:
    """Make one step's recording and return its shortfalls.

    Raises
    ------
    edge.InputError, EncoderError, RecordingError
        As `recorder.record` does.
    """
    end, bench = _End(step), sequence.bench
    cycling = actuator is not None and step.is_hysteresis

    def look(live: Live) -> None:
        nonlocal cycling
        if cycling and actuator is not None:
            actuator.cycle(step)
            cycling = False
        end(live)
        progress(live)

    with interrupts() as interrupted, contextlib.ExitStack() as stack:
        if actuator is not None:
            stack.callback(actuator.stop)
            actuator.set(step)
        deadline = time.monotonic() + (sequence.file.wait or 0.0)
        while not interrupted and (rest := deadline - time.monotonic()) > 0.0:
            time.sleep(min(rest, _WAIT_STEP))
        if interrupted:
            raise KeyboardInterrupt
        record_encoders(
            stack.enter_context(open_encoders(bench)),
            path,
            ratio=bench.ratio,
            pair=bench.pair,
            conditions={**bench.conditions, **step.conditions},
            progress=look,
            stop=lambda: end.reached,
            idle=None if sequence.is_prompted else _IDLE_SECONDS,
        )
    recording = read_recording(path)
    samples = {c.role: recording.samples[c.name] for c in recording.header.channels}
    sentences = shortfalls(step, samples, sequence.file)
    gaps = sum(int(np.count_nonzero(s.status & rf.GAP)) for s in recording.samples.values())
    return sentences + ([f"{gaps} samples follow a gap"] if gaps else [])


@dataclasses.dataclass(frozen=True)
class SequenceResult:
    """Result of a sequence.

    Attributes
    ----------
    recordings
        One file for each completed step, in the sequence's order.
    shortfalls
        Shortfalls of the last trial of each incomplete step, by the step's name.
    """

    recordings: tuple[Path, ...]
    shortfalls: Mapping[str, Sequence[str]]


def run_sequence(
    sequence: BenchSequence | str | os.PathLike[str],
    *,
    note: Callable[[Step, Path | None], None] | None = None,
    ready: Callable[[Step], None] | None = None,
    again: Callable[[Step, Path, list[str]], bool] | None = None,
    progress: Callable[[Live], None] | None = None,
) -> SequenceResult:
    """Run a test sequence: make each step, check it, and write one recording for each step.

    Recordings are written next to the sequence file. Steps already recorded are skipped, so an interrupted sequence is
    resumed. A trial that falls short is kept as `STEP.trial-N.arrows`.

    Parameters
    ----------
    sequence
        The sequence, or its `SEQUENCE.toml`.
    note
        Called with each step and None at its start, and with its recording at its end.
    ready
        Called before each trial where the bench file has no `[actuator]` and the sequence no `wait`; must return when
        the bench is running.
    again
        Called with a step, the trial's recording and its shortfalls; returns whether to repeat the step. Default: no.
    progress
        See `drivers.record`.

    Raises
    ------
    edge.InputError, EncoderError, RecordingError, KeyboardInterrupt
        As `record` does; earlier recordings are kept.

    Examples
    --------
    >>> import drivers
    >>> drivers.run_sequence("sequence.toml")
    Traceback (most recent call last):
    cycloid_fmu.edge.problems.InputError: sequence.toml: No such file or directory.
    """
    plan = sequence if isinstance(sequence, BenchSequence) else read_sequence(sequence)
    with Claims() as claims, contextlib.ExitStack() as stack:
        claims.claim(plan.bench.wiring)
        actuator = plan.bench.new_actuator()
        if actuator is not None:
            stack.enter_context(actuator)
        return _run_steps(plan, actuator, note, ready, again, progress)


def _run_steps(
    plan: BenchSequence,
    actuator: Actuator | None,
    note: Callable[[Step, Path | None], None] | None,
    ready: Callable[[Step], None] | None,
    again: Callable[[Step, Path, list[str]], bool] | None,
    progress: Callable[[Live], None] | None,
) -> SequenceResult:
    """Make the steps of a sequence on a reserved bench; see `run_sequence`."""
    recordings, missed = [], {}
    for step in plan.steps:
        path = plan.folder / f"{step.name}.arrows"
        if note is not None:
            note(step, None)
        while not edge.writable(path).exists():
            if plan.is_prompted and ready is not None:
                ready(step)
            trials = (plan.folder / f"{step.name}.trial-{number}.arrows" for number in itertools.count(1))
            trial = next(t for t in trials if not edge.writable(t).exists())
            short = _run_step(plan, step, trial, actuator, progress or (lambda _: None))
            if not short:
                trial.rename(edge.writable(path))
            elif again is None or not again(step, trial, short):
                missed[step.name] = short
                break
        if path.exists():
            recordings.append(path)
            if note is not None:
                note(step, path)
    return SequenceResult(tuple(recordings), missed)
