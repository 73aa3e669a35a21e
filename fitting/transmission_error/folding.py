"""Folding of recordings to transmission error curves over one output turn, averaged over turns, one per direction.

Samples are read and folded block by block, so that hours at kilohertz rates need no more memory than one output turn.
Turns share a point only if their angles are practically equal: if sampling is not synchronous with the crank, their
samples are up to a sample's spacing apart, and pins come into and out of contact in between.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from drivers.recording_format import GAP
from fitting.arguments import check_ratio
from fitting.readers.recording import Recording, RecordingStream
from fitting.readers.sources import Source, each_source, open_source
from fitting.samples.block import Block
from fitting.samples.plausible import PlausibleBlocks
from fitting.transmission_error.curve import Curve, whole_turns
from fitting.transmission_error.unaveraged import Steps

Array = NDArray[np.float64]
POINTS = 1 << 15  # most even points of a turn, which resolve orders up to a quarter of them
_PITCH = 20  # points per crank rotation from one pin to the next, if turns are not sampled at the same angles
_FINEST = 1 << 18  # most points of a turn in that case
_EQUAL = 1e-9  # rad: samples of two turns are at one angle
_SHARED = 1.1  # most distinct points, relative to those of one turn, of turns sampled at the same angles
_FIRST = 1 << 20  # samples that determine the number of points
_RAMP = np.pi / 648000.0  # rad: smaller drifts over a whole recording get no note
_RAMP_TURNS = 1.5  # output turns: fewer hardly tell a drift from a wave
_ROOM = 1 << 20  # most points if turns are kept separate
_FAR = 1e12  # most turns between two samples
LOCKED = float(np.radians(1.0))  # of the crank: largest motion of a locked input, from the windup of its fixture
_REVERSAL = np.radians(2.0)  # of the crank: smaller reversals are vibration; larger than the lost motion of any drive

_Columns = tuple[Array, ...]  # crank angle, transmission error, torque, crank speed, of equal length


class _Fold:
    """Folds the motion in one direction to one output turn.

    A point is the mean over turns of the mean within each turn, so that slow sections have no more weight.
    """

    def __init__(self, ratio: float, direction: int, *, keep_turns: bool, evenly: bool) -> None:
        self._turn = 2.0 * np.pi * abs(ratio)
        self._kept: list[tuple[NDArray[np.int64], Array]] | None = [] if keep_turns else None
        self.ratio, self.direction, self._evenly = ratio, direction, evenly
        self.samples = 0
        self.points = 0
        self._first: list[tuple[Array, Array, Array, Array, bool]] = []
        self._travelled = self._furthest = 0.0
        self._turns = 0  # before the last reversal
        self._held = 0
        self._torque = np.zeros(2)
        self._line = np.zeros(5)
        self.rotation = 0.0

    def add(self, angle: Array, error: Array, torque: Array, speed: Array, *, rotation: float, restarted: bool) -> None:
        """Add samples of this direction.

        Parameters
        ----------
        angle, error
            Crank angles and transmission errors, rad, shape (n,).
        torque, speed
            Torques, N·m, and crank speeds, rad/s, shape (n,).
        rotation
            Crank rotation in this direction, rad, >= 0.
        restarted
            Whether these are the first samples after a reversal.
        """
        if not angle.size:
            return
        self.rotation += rotation
        if self.points:
            self._take(angle, error, torque, speed, restarted)
            return
        self._first.append((angle.copy(), error.copy(), torque.copy(), speed.copy(), restarted))
        self._held += angle.size
        if self._held >= _FIRST:
            self._begin()

    def _begin(self) -> None:
        if not self._first:
            return
        angle = self._first[0][0]
        whole = round((self._held - 1) * min(1.0, self._turn / self.rotation)) if self.rotation else 1
        self.points = min(max(1, whole), POINTS)
        spacing = max(min(self._turn, self.rotation or self._turn) / self.points, self._turn / POINTS)
        # Points are bounded midway between the samples of the first turn.
        self._origin = self._begins = float(angle[0])
        even = self.points if self.rotation >= self._turn else max(1, round(self._turn / spacing))
        self.grid = (even, float(np.mod(angle[0], self._turn) - 0.5 * spacing))
        parts = 1 if self._evenly else max(1, round(min(_PITCH * self.ratio**2, _FINEST) / even))
        self._whole, self._spacing = even * parts, spacing / parts
        self.shift = float(np.mod(angle[0], self._turn) - 0.5 * self._spacing)
        self._apart = 1
        apart = int(self.rotation / self._turn) + 2 + sum(restarted for *_, restarted in self._first)
        few = self._held <= POINTS and apart * self._whole <= _ROOM
        if not self._evenly and few and not self._in_step():
            self._apart = apart
        self.whole = self._whole * self._apart
        self._steps = Steps(self._turn, self._whole) if self._evenly else None
        self._reference = float(self._first[0][1][0])
        self._torque_reference = float(self._first[0][2][0])
        self.count = np.zeros(self.whole, np.int64)
        self.repeats = np.zeros(self.whole, np.int64)
        # Sums over turns: mean error, its square, mean angle, mean squared angle, mean torque, speed, travel. For the
        # present turn, at its points: samples, error, angle, squared angle, torque, speed, travel.
        self._sums = np.zeros((7, self.whole))
        self._open: list[tuple[NDArray[np.int64], list[NDArray[Any]]]] = [(np.zeros(0, np.int64), 7 * [np.zeros(0)])]
        self._open_points = self._open_turn = 0
        waiting, self._first = self._first, []
        for part in waiting:
            self._take(*part)

    def _in_step(self) -> bool:
        """Return whether all turns are sampled at the same angles."""
        angle = np.concatenate([part[0] for part in self._first])
        point = (np.mod(angle - self.shift, self._turn) / self._spacing + 1e-9).astype(np.int64)
        return np.unique(point).size * self.rotation < _SHARED * self._held * self._turn

    def _take(self, angle: Array, error: Array, torque: Array, speed: Array, restarted: bool) -> None:
        if restarted:
            self.finish()
            self._travelled = self._furthest
            self._turns = (self._turns + 1) % self._apart
            self._begins = float(angle[0])
        self.samples += angle.size
        error = error - self._reference
        torque = torque - self._torque_reference
        # Not `np.mod`, which takes a fifth of the folding.
        position = angle - self.shift
        position -= np.floor(position / self._turn) * self._turn
        position = position / self._spacing + 1e-9
        point = np.minimum(position.astype(np.int64), self._whole - 1)
        inside = (position - (point + 0.5)) * self._spacing
        last = int(self._turn_of(angle.max() if self.direction > 0 else angle.min())) - self._open_turn
        turn = self._turn_of(angle) if last else self._open_turn
        if self._apart > 1:
            point += self._whole * ((turn + self._turns) % self._apart)
        if last:
            point += (turn - self._open_turn) * self.whole
        # Add up neighbours at one point first, so that fewer are sorted: twice as fast with five samples per point.
        begins = np.flatnonzero(np.concatenate([[True], point[1:] != point[:-1]]))
        count = np.diff(begins, append=point.size)
        run = np.repeat(np.arange(begins.size), count)
        columns = (error, inside, inside * inside, torque, speed)
        errors, places, squares, torques, speeds = (np.bincount(run, column) for column in columns)
        # Crank angles of a run are that of the middle of its point and their places inside.
        middle = angle[begins] - inside[begins]
        travels = count * (self._travel(middle) + self._travelled) + self.direction * places
        self._furthest = float(self._travel(angle[-1])) + self._travelled
        if self._steps is not None:
            self._steps.add(middle, count, *(np.asarray(sums, dtype=float) for sums in (places, squares, errors)))
        # Not `torque @ torque`, which starts all processors for little work: folding takes a third of the time without.
        self._torque += torques.sum(), (torque * torque).sum()
        x = middle - self._origin
        xx, xy = (count * x + 2.0 * places) * x + squares, x * errors
        self._line += (
            angle.size,
            (count * x + places).sum(),
            errors.sum(),
            xx.sum(),
            xy.sum() + (inside * error).sum(),
        )
        self._open.append((point[begins], [count, errors, places, squares, torques, speeds, travels]))
        self._open_points += begins.size
        if last or self._open_points > _FIRST:
            self._settle(last)

    def _travel(self, angle: Array) -> Array:
        """Return the rotation from the start of the turns to crank angles, rad, > 0 in the fold's direction."""
        return self.direction * (angle - self._begins) + 0.5 * self._spacing

    def _turn_of(self, angle: Array) -> NDArray[np.int64]:
        """Return the number of the turn of crank angles, which never falls below that of the present turn."""
        turn = np.minimum(self._travel(angle) / self._turn + 1e-9, _FAR).astype(np.int64)
        return np.maximum(turn, self._open_turn)

    def _settle(self, turns: int) -> None:
        """Add up the points of the present turn and the next ones, and close this number of turns.

        To do this once a turn is 1.4 times as fast as once for each block of 27,000 samples.
        """
        points, sums = zip(*self._open, strict=True)
        key = np.concatenate(points)
        columns = [np.concatenate(each) for each in zip(*sums, strict=True)]
        if (key[1:] < key[:-1]).any():
            order = np.argsort(key, kind="stable")
            key, columns = key[order], [each[order] for each in columns]
        new = np.concatenate([np.ones(min(1, key.size), bool), key[1:] != key[:-1]])
        if not new.all():
            at = np.cumsum(new) - 1
            key, columns = key[new], [np.bincount(at, each) for each in columns]
        closed = int(np.searchsorted(key, turns * self.whole))
        self._close(key[:closed], [each[:closed] for each in columns])
        self._open = [(key[closed:] - turns * self.whole, [each[closed:] for each in columns])]
        self._open_turn += turns
        self._open_points = key.size - closed

    def _close(self, key: NDArray[np.int64], sums: list[NDArray[Any]]) -> None:
        """Add completed turns to the sums.

        `key`: turn times number of points, plus point, ascending; `sums`: over the samples there, shape (7, n).
        """
        turn, point = np.divmod(key, self.whole)
        samples = sums[0]
        mean = [each / samples for each in sums[1:]]
        np.add.at(self.count, point, samples.astype(np.int64))
        np.add.at(self.repeats, point, 1)
        for total, column in zip(self._sums, (mean[0], mean[0] ** 2, *mean[1:]), strict=True):
            np.add.at(total, point, column)
        if self._kept is not None and key.size:
            borders = np.flatnonzero(np.diff(turn)) + 1
            self._kept += zip(np.split(point, borders), np.split(mean[0], borders), strict=True)

    def drift(self) -> float:
        """Return the slope of the transmission error over the crank angle, rad/rad."""
        n, x, y, xx, xy = self._line
        spread = n * xx - x * x
        return float((n * xy - x * y) / spread) if n > 2 and spread > 0.0 else 0.0

    def amplitude(self) -> float:
        """Return half the range of the transmission error averaged over turns, rad."""
        filled = self.repeats > 0
        mean = self._sums[0][filled] / self.repeats[filled]
        return 0.5 * float(np.ptp(mean))

    def finish(self) -> None:
        """Close the current turn and start a new one."""
        if not self.points:
            self._begin()
        if self.points:
            self._turns = (self._turns + self._open_turn) % self._apart
            self._settle(1)
            self._open_turn = 0

    def curve(self, stream: Recording | RecordingStream, **about: Any) -> Curve:
        """Return the folded curve of a recording, with further attributes of the curve."""
        filled = np.flatnonzero(self.repeats)
        n, sums = self.repeats[filled], self._sums[:, filled]
        inside = sums[2] / n
        angle = np.mod(self.shift + (filled + 0.5) * self._spacing + inside, self._turn)
        # Turns that are not all in step may still meet, as every second one: samples at one angle are one point.
        sequence = np.argsort(angle)
        is_new = np.diff(angle[sequence], prepend=-1.0) > _EQUAL
        index = np.empty(sequence.size, np.int64)
        index[sequence] = np.cumsum(is_new) - 1
        count, turns, variance, *merged = (
            np.bincount(index, column) for column in (self.count[filled], n, n * (sums[3] / n - inside**2), *sums)
        )
        error, squares, _, _, each, speed, travel = (column / turns for column in merged)
        with np.errstate(invalid="ignore", divide="ignore"):
            standard_error = np.sqrt(np.maximum(squares - error**2, 0.0) / (turns - 1.0))
        torque, torque2 = self._torque / self.samples
        each_turn = None
        if self._kept is not None:
            each_turn = np.full((len(self._kept), turns.size), np.nan)
            column = np.zeros(self.whole, np.int64)
            column[filled] = index
            for row, (points, values) in zip(each_turn, self._kept, strict=True):
                row[column[points]] = values + self._reference
        crank_speed = float(np.abs(np.mean(speed))) if stream.timed else None
        running_speed = stream.speed
        if running_speed is None and crank_speed is not None:
            running_speed = crank_speed / abs(self.ratio)
        return Curve(
            input_angle=angle[sequence][is_new],
            transmission_error=error + self._reference,
            standard_error=np.where(turns > 1, standard_error, np.nan),
            sample_count=count.astype(np.int64),
            torque=float(torque + self._torque_reference),
            torque_deviation=float(np.sqrt(max(torque2 - torque**2, 0.0))),
            direction=self.direction,
            ratio=self.ratio,
            common_zero=stream.common_zero,
            known_index=stream.known_index,
            checksum=stream.checksum,
            running_speed=running_speed,
            crank_speed=crank_speed,
            turns=self.rotation / self._turn,
            grid=self.grid,
            angle_variance=np.maximum(variance / turns, 0.0),
            torque_each=each + self._torque_reference,
            speed=speed,
            travel=travel,
            each_turn=each_turn,
            unaveraged=None if self._steps is None else self._steps.unaveraged(self._reference),
            **about,
        )


class Folding:
    """Folds the blocks of a recording, each direction of the crank separately.

    Sections with the crank at rest are left out, and so are the first two degrees of the crank after a reversal, in
    which the lost motion is passed. After a gap, the crank turns missed in it are counted from the output angle.

    Parameters
    ----------
    ratio
        Signed ratio φ_a/φ_b of the ideal drive.
    source
        Name of the recording, for messages.
    keep_turns
        Whether to keep every single turn in the curves too.
    evenly
        Whether a turn has as many even points as samples, and the curve the transmission error of all turns too, as
        orders require; otherwise samples of different turns share
        a point only if their angles are practically equal.
    """

    def __init__(self, ratio: float, source: str, *, keep_turns: bool = False, evenly: bool = False) -> None:
        self.ratio, self.source = ratio, source
        self._folds = {
            direction: _Fold(ratio, direction, keep_turns=keep_turns, evenly=evenly) for direction in (1, -1)
        }
        self._direction = 0
        self._furthest = np.nan
        self._start = np.nan
        self._stood = 0
        self._reversing = 0
        self._usual_run = np.inf
        self._correction = 0.0
        self._last: tuple[float, float] | None = None
        self._recounted = 0
        self._restarted = False
        self._warmth = np.zeros(2)  # sum and number of temperatures
        self._waiting: list[_Columns] = []

    def add(self, block: Block) -> None:
        """Add the next block."""
        angle, output = block.input_angle, block.output_angle
        if not angle.size:
            return
        if self._last is not None or (block.status & GAP).any():
            angle = self._recount(angle, output, np.flatnonzero(block.status & GAP))
        self._last = (float(angle[-1]), float(output[-1]))
        if np.isnan(self._furthest):
            self._furthest = self._start = float(angle[0])
        if block.temperature is not None:
            self._warmth += np.nansum(block.temperature), np.count_nonzero(np.isfinite(block.temperature))
        self._waiting.append((angle, output - angle / self.ratio, block.torque, _speed(block.time, angle)))
        # The direction of the crank is known once it is away from its start.
        if self._direction or sum(part[0].size for part in self._waiting) > _FIRST or self._is_away(angle):
            self._fold()

    def _is_away(self, angle: Array) -> bool:
        return bool((np.abs(angle - self._start) > _REVERSAL).any())

    def _fold(self) -> None:
        columns = self._waiting[0]
        if len(self._waiting) > 1:
            columns = tuple(np.concatenate(parts) for parts in zip(*self._waiting, strict=True))
        self._waiting.clear()
        begin = 0
        while begin < columns[0].size:
            begin += self._stretch(tuple(column[begin:] for column in columns))

    def _recount(self, angle: Array, output: Array, gaps: NDArray[np.int64]) -> Array:
        """Add the crank turns missed in gaps, counted from the output angle; `gaps`: indices of samples after a gap."""
        if not gaps.size:
            return angle if self._correction == 0.0 else angle + self._correction
        angle = angle + self._correction
        for at in gaps:
            if at == 0 and self._last is None:
                continue
            before, driven = self._last if at == 0 and self._last is not None else (angle[at - 1], output[at - 1])
            wanted = before + (output[at] - driven) * self.ratio
            turns = float(np.round((wanted - angle[at]) / (2.0 * np.pi)))
            if turns:
                angle[at:] += 2.0 * np.pi * turns
                self._correction += 2.0 * np.pi * turns
                self._recounted += 1
        return angle

    def _stretch(self, columns: _Columns) -> int:
        """Fold up to the next reversal and return the index of the sample after it."""
        part = columns[0]
        if self._direction == 0:
            away = np.flatnonzero(np.abs(part - self._start) > _REVERSAL)
            if not away.size and part.size > _FIRST:
                self._stood += part.size
                return part.size
            last = part[away[0]] if away.size else part[-1]
            self._direction = 1 if last >= self._start else -1
            self._furthest = self._start
        d = self._direction
        ahead = d * part
        if ahead[0] > d * self._furthest and (ahead[1:] > ahead[:-1]).all():
            self._take(columns, ahead)  # a steady motion: its own furthest angles
            return part.size
        reached = np.maximum.accumulate(np.maximum(ahead, d * self._furthest))
        if (reached[-1] - ahead).max() > _REVERSAL or ahead.min() < d * self._furthest - _REVERSAL:
            back = np.flatnonzero(reached - ahead > _REVERSAL)
            if back.size:
                # The reversal is at the furthest point; the samples after it pass back through the lost motion.
                before = ahead[: back[0] + 1]
                end = int(np.argmax(before)) + 1 if before.max() >= d * self._furthest else 0
                self._take(tuple(column[:end] for column in columns), reached[:end])
                self._reversing += int(back[0]) - end
                self._direction = -d
                self._furthest = float(part[back[0]])
                self._restarted = True
                return int(back[0])
        self._take(columns, reached)
        return part.size

    def _take(self, columns: _Columns, reached: Array) -> None:
        """Fold samples in one direction; `reached`: furthest angles so far, in this direction, rad, shape (n,)."""
        if not reached.size:
            return
        before = self._direction * self._furthest
        grows = reached > np.concatenate([[before], reached[:-1]])
        grows[0] |= self._folds[self._direction].samples + self._folds[self._direction]._held == 0
        rotation = float(reached[-1]) - before
        self._furthest = float(reached[-1]) * self._direction
        if not grows.all():
            # At rest: no progress for much longer than usual, which encoder steps and noise cause too.
            starts = np.flatnonzero(np.concatenate([[True], grows[1:]]))
            runs = np.diff(np.append(starts, grows.size))
            self._usual_run = min(self._usual_run, float(np.median(runs)))
            standing = np.repeat(runs > max(8.0, 4.0 * self._usual_run), runs)
            standing[starts[grows[starts]]] = False
            self._stood += int(np.count_nonzero(standing))
            moving = ~standing
            columns = tuple(column[moving] for column in columns)
        self._folds[self._direction].add(*columns, rotation=rotation, restarted=self._restarted)
        self._restarted &= not columns[0].size

    def curves(self, stream: Recording | RecordingStream, blocks: PlausibleBlocks) -> list[Curve]:
        """Return the curve of each direction in which the crank turned, the longer one first.

        A direction with less than a hundredth of the rotation is left out, with a note.

        Parameters
        ----------
        stream, blocks
            The recording and its blocks.

        Raises
        ------
        edge.InputError
            If the input angle is unknown or turns by no more than `LOCKED`, or the two angles do not match the ratio.
        """
        if not stream.has_input_angle:
            raise edge.NoDataError(f"{self.source}: no input angle is mapped; a transmission error needs both angles.")
        if self._waiting:
            self._fold()
        folds = sorted(self._folds.values(), key=lambda f: -f.rotation)
        for fold in folds:
            fold.finish()
        notes = [*stream.notes, *blocks.notes()]
        used = [f for f in folds if f.rotation > 0.01 * folds[0].rotation and f.samples > 1]
        if folds[0].rotation <= LOCKED or not used:
            raise edge.InputError(
                f"{self.source}: the input turns by only {np.degrees(folds[0].rotation):.3g}°; a "
                f"curve needs a run in which it turns by more than {np.degrees(LOCKED):g}°."
            )
        few = sum(f.samples for f in folds if f not in used)
        if self._stood + few:
            notes.append(
                f"{self.source}: {self._stood + few} samples with the crank at rest or moving back were left out."
            )
        if self._reversing:
            notes.append(
                f"{self.source}: {self._reversing} samples after a reversal, within the lost motion, were left out."
            )
        if self._recounted:
            notes.append(
                f"{self.source}: crank turns were missed in {self._recounted} gaps; they were counted from the output "
                "angle."
            )
        for fold in used:
            _check_ratio(fold, self.source)
            notes += _ramp_note(fold, self.source)
        total, count = self._warmth
        temperature = float(total / count) if count else None
        about = {"source": self.source, "notes": tuple(notes), "implausible": blocks.count, "temperature": temperature}
        folded = [fold.curve(stream, **about) for fold in used]
        # Where an encoder's angle begins, just below or above its zero, is chance: the mean is known within one turn.
        passed = float(whole_turns(folded[0].transmission_error.mean(), 2.0 * np.pi / abs(stream.pulley)))
        return [curve.moved(-passed) for curve in folded]


def _speed(time: Array, angle: Array) -> Array:
    """Return the speed at each sample, rad/s, from its neighbours, shape (n,); 0 where the time does not increase."""
    speed = np.zeros(angle.size)
    if angle.size > 1:
        passed = np.gradient(time)
        np.divide(np.gradient(angle), passed, out=speed, where=passed > 0.0)
    return speed


def _check_ratio(fold: _Fold, source: str) -> None:
    """Refuse angles that do not match the ratio, with a probable cause."""
    ratio, drift, rotation = fold.ratio, fold.drift(), fold.rotation
    # Below a thousandth it is not another ratio but clock drift, on which `_ramp_note` makes a note.
    if abs(drift * ratio) <= 1e-3 or (abs(drift * ratio) <= 0.02 and abs(drift * rotation) <= np.radians(1.0)):
        return
    slope = 1.0 / ratio + drift
    sentence = f"{source}: the output turns {slope:.6g} of the input, but the ratio {ratio:g} gives {1.0 / ratio:.6g}; "
    degrees = 180.0 / np.pi
    causes = {
        -1.0: "the ratio's sign or one angle's direction is wrong",
        ratio * ratio: "input and output angle seem to be swapped",
        -ratio * ratio: "input and output angle seem to be swapped, and the direction of one is wrong",
        degrees: "the output angle seems to be in deg, not rad",
        1.0 / degrees: "the input angle seems to be in deg, not rad",
    }
    for factor, cause in causes.items():
        if abs(slope * ratio / factor - 1.0) < 0.02:
            raise edge.InputError(f"{sentence}{cause}; check the pair, the directions and the units.")
    raise edge.InputError(f"{sentence}check the pair, the directions and the counts per turn.")


def _ramp_note(fold: _Fold, source: str) -> list[str]:
    """Return a note if the transmission error drifts from turn to turn, which no gear causes.

    The least squares slope of a wave of amplitude A, one period per turn, over N turns is at most 12A/(2πN) over all of
    them; only more than three times that gets a note.
    """
    ratio, turns = abs(fold.ratio), fold.rotation / (2.0 * np.pi * abs(fold.ratio))
    ramp = fold.drift() * 2.0 * np.pi * ratio
    wave = 12.0 * fold.amplitude() / (2.0 * np.pi * turns**2)
    if turns < _RAMP_TURNS or abs(ramp) < 3.0 * wave or abs(ramp) * turns < _RAMP:
        return []
    return [
        f"{source}: the transmission error drifts by {abs(ramp) * edge.ARCSEC:.3g}″ per output turn, as if the output "
        f"angle's clock ran {-fold.drift() * fold.ratio * 1e6:+.3g} ppm fast, its counts per turn were wrong or the "
        "rig warmed up; the curve contains the drift. State the drift of a clock in the mapping."
    ]


def curves(
    recordings: Source | Iterable[Source], drive: Drive | float | None = None, *, keep_turns: bool = False
) -> list[Curve]:
    """Return the transmission error curves of recordings, one per direction, the longer one first.

    The crank angle is folded to one output turn. If all turns were sampled at the same angles, they are averaged there;
    otherwise every sample is a separate point. With more than `POINTS` samples, those within a twentieth of the crank's
    rotation from one pin to the next, or 1/`POINTS` of the turn if that is more, are averaged, within each turn and
    then over turns, both angles and errors.

    Parameters
    ----------
    recordings
        Recordings from `fitting.read_recordings`, or `fitting.Run`, or one of them.
    drive
        The drive, or its signed ratio input/output; None: the ratio that each recording states.
    keep_turns
        Whether to keep every single turn in the curves too.

    Raises
    ------
    edge.InputError
        If a recording can't be read, its crank hardly turns, or its angles do not match the ratio; or if no ratio is
        known.

    Examples
    --------
    >>> import numpy as np, fitting
    >>> angle = np.linspace(0.0, 2.0 * np.pi * 39, 2000)
    >>> run = fitting.Run(input_angle=angle, output_angle=-angle / 39 + 1e-5 * np.cos(angle), torque=20.0)
    >>> (curve,) = fitting.curves(run, -39.0)
    >>> round(float(np.ptp(curve.transmission_error)) * 1e6)
    20
    """
    stated = drive.ratio if isinstance(drive, Drive) else drive
    check_ratio(stated)
    folded: list[Curve] = []
    given: list[Source] = each_source(recordings)
    for source in given:
        recording = open_source(source, stated)
        ratio = recording.ratio if stated is None else stated
        if ratio is None:
            raise edge.InputError(
                f"{recording.source}: the ratio is unknown; give the drive or its ratio input/output: {edge.RATIO}."
            )
        folding = Folding(ratio, recording.source, keep_turns=keep_turns)
        blocks = PlausibleBlocks(recording, ratio)
        for block in blocks:
            folding.add(block)
        folded += folding.curves(recording, blocks)
    common = [float(curve.transmission_error.mean()) for curve in folded if curve.common_zero]
    return [
        curve.moved(-float(whole_turns(curve.transmission_error.mean() - common[0]))) if curve.common_zero else curve
        for curve in folded
    ]
