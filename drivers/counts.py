"""Arithmetic of counts: bit fields of frames, rollovers, sequence numbers."""

from __future__ import annotations

import collections
import math

import numpy as np
import numpy.typing as npt

from drivers import recording_format as rf

_PACE_READINGS, _PACE_LEAST = 512, 8
_SPEED_SECONDS, _LEAST_SECONDS = 1.0, 0.02  # gapless time over which the speed is averaged, and the least for one
_LOOK_AHEAD, _LATEST = 16, 0.1  # readings and seconds, the longer of which late readings have to catch up


def unwrap(
    raw: npt.NDArray[np.int64], modulus: int, previous: int | None = None, *, signed: bool = False
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Unwrap counts that roll over, taking each step the short way round.

    Parameters
    ----------
    raw
        Counts as sent, shape (n,), any representative modulo `modulus`.
    modulus
        Number of counts after which the device starts again from 0.
    previous
        Continuous count of the previous sample, None at the beginning.
    signed
        Whether to map the first count into [-modulus/2, modulus/2) instead of [0, modulus), so that an encoder just
        below zero starts at -1 and not at modulus - 1.

    Returns
    -------
    counts, rolled
        Continuous counts, and the mask of samples directly after a rollover of the raw counts, both of shape (n,).
    """
    residue = raw % modulus
    if previous is None:
        first = int(residue[0]) if len(residue) else 0
        previous = first - modulus if signed and first >= modulus - modulus // 2 else first
    before = np.concatenate([[previous % modulus], residue[:-1]]) if len(residue) else residue
    step = residue - before
    half = modulus // 2
    short = (step + half) % modulus - half
    return previous + np.cumsum(short), short != step


def counted(number: int, noun: str) -> str:
    """Return a number with its noun, such as "1 line", "2 lines" or "2 queries"."""
    plural = f"{noun[:-1]}ies" if noun.endswith("ry") else f"{noun}s"
    return f"{number} {noun if number == 1 else plural}"


def carried(
    valid: npt.NDArray[np.intp], bits: npt.NDArray[np.int64], pending: int
) -> tuple[npt.NDArray[np.int64], int]:
    """Return the status bits of the valid readings, shape (k,), and those left for the next one.

    Parameters
    ----------
    valid
        Indices of the valid readings, shape (k,).
    bits
        Bits noted at each reading, shape (n,); those at a reading that is left out go to the next valid one.
    pending
        Bits left from the readings before.
    """
    status = np.zeros(len(valid) + 1, np.int64)
    noted = np.flatnonzero(bits)
    np.bitwise_or.at(status, np.searchsorted(valid, noted), bits[noted])  # several losses may precede one reading
    status[0] |= pending
    return status[:-1], int(status[-1])


class UnseenTurns:
    """Corrects counts for rollovers missed in a gap, using the speed before the gap.

    Parameters
    ----------
    modulus
        Number of counts after which the position starts again from 0.
    """

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._last: tuple[float, int] | None = None
        self._stretches: collections.deque[tuple[float, float]] = (
            collections.deque()
        )  # (s, counts) of gapless stretches

    def __call__(
        self, times: npt.NDArray[np.float64], counts: npt.NDArray[np.int64], gaps: npt.NDArray[np.bool_]
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
        """Return the corrected counts, and the mask of those before which rollovers may have been missed, shape (n,).

        Parameters
        ----------
        times, counts
            Times of the readings, s, and their counts, each step taken the short way round, shape (n,).
        gaps
            Mask of the readings before which others are missing, shape (n,).
        """
        counts, unseen = counts.copy(), np.zeros(len(counts), np.bool_)
        for part in np.split(np.arange(len(counts)), np.flatnonzero(gaps)):
            if not len(part):
                continue
            i = int(part[0])
            if gaps[i] and self._last is not None and (speed := self._speed()) is not None:
                turned = speed * (times[i] - self._last[0])
                unseen[i] = abs(turned) >= self._modulus / 2
                if unseen[i]:
                    rounds = round((turned - float(counts[i] - self._last[1])) / self._modulus)
                    counts[i:] += rounds * self._modulus
            from_time, from_count = self._last if self._last is not None and not gaps[i] else (times[i], counts[i])
            self._last = float(times[part[-1]]), int(counts[part[-1]])
            self._stretches.append((self._last[0] - float(from_time), float(self._last[1] - from_count)))
            while sum(lasts for lasts, _ in self._stretches) - self._stretches[0][0] > _SPEED_SECONDS:
                self._stretches.popleft()
        return counts, unseen

    def _speed(self) -> float | None:
        """Return the mean speed over the last gapless second, counts/s; None if too little time is known.

        It is a mean because a single time stamp may be 25 ms off.
        """
        lasts = sum(lasts for lasts, _ in self._stretches)
        return sum(travel for _, travel in self._stretches) / lasts if lasts > _LEAST_SECONDS else None


def counts_to_value(
    counts: npt.NDArray[np.int64], counts_per_turn: int, direction: int, zero: float
) -> npt.NDArray[np.float64]:
    """Return the angle in rad, counter-clockwise positive: direction * 2 pi counts / counts per turn - zero.

    Parameters
    ----------
    counts
        Continuous counts, shape (n,).
    counts_per_turn
        Counts in one turn of the shaft.
    direction
        +1 if the counts increase counter-clockwise, -1 if they decrease.
    zero
        Angle that the encoder shows at the zero of the shaft, rad.
    """
    return np.asarray(direction * (2 * math.pi / counts_per_turn) * counts - zero, np.float64)


def extract_bits(
    payloads: npt.NDArray[np.uint8], start: int, length: int, *, signed: bool, little_endian: bool = True
) -> npt.NDArray[np.int64]:
    """Return an integer bit field of frames, shape (n,).

    Parameters
    ----------
    payloads
        Frames, shape (n, bytes).
    start
        Little-endian (CiA 301 mappings, DBC "@1"): lowest bit of the field, counted from byte 0's lowest. Big-endian:
        highest bit of the field, counted from byte 0's highest.
    length
        Number of bits, 1 to 64 (a 64-bit unsigned field wraps at 2^63).
    signed
        Whether the field is in two's complement.
    little_endian
        Whether the byte order is little-endian, otherwise big-endian.
    """
    first, shift = divmod(start, 8)
    field = np.zeros((len(payloads), 16), np.uint8)  # the field begins in byte 0 and ends, at the latest, in byte 8
    held = payloads[:, first : first + 9]
    field[:, : held.shape[1]] = held
    low, high = (field.view("<u8" if little_endian else ">u8").astype(np.uint64)[:, i] for i in (0, 1))
    # Shifted so that the field's highest bit is the word's highest; shifting back then extends the sign, or not.
    if little_endian:
        words = low >> np.uint64(shift)
        if shift:
            words |= high << np.uint64(64 - shift)
        words = words << np.uint64(64 - length)
    else:
        words = low << np.uint64(shift)
        if shift:
            words |= high >> np.uint64(64 - shift)
    if signed:
        return words.view(np.int64) >> np.int64(64 - length)
    return (words >> np.uint64(64 - length)).view(np.int64)


def wraps(step: npt.NDArray[np.int64], modulus: int, expected: npt.NDArray[np.float64]) -> npt.NDArray[np.int64]:
    """Return how many rollovers of a sequence number were missed in each step, from the elapsed time, shape (n,).

    Parameters
    ----------
    step
        Steps of the sequence number, each known only modulo `modulus`, shape (n,).
    modulus
        Count after which the sequence number starts again from 0.
    expected
        Steps expected from the elapsed time, shape (n,); NaN where unknown.
    """
    rounds = np.rint((np.nan_to_num(expected) - step) / modulus)
    return np.maximum(rounds, 0).astype(np.int64)


def missing_by_pace(
    times: npt.NDArray[np.float64], steps: npt.NDArray[np.float64], gaps: npt.NDArray[np.bool_], period: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Return how many readings are missing before each one, from the elapsed time, and the mask of delayed readings.

    Delayed readings arrive in quick succession after the delay; lost ones never do. Both results have shape (n,).

    Parameters
    ----------
    times, steps
        Times of the readings and intervals from the previous reading, s, shape (n,).
    gaps
        Mask of the readings before which others may be missing, shape (n,).
    period
        Usual interval between readings, s.
    """
    missing, waited = np.zeros(len(times), np.int64), np.zeros(len(times), np.bool_)
    for i in np.flatnonzero(gaps):
        end = i + max(_LOOK_AHEAD, math.ceil(_LATEST / period))
        passed = np.rint((times[i:end] - (times[i] - steps[i])) / period)
        more = passed - np.arange(1, len(passed) + 1)
        in_time = int(np.argmin(more))
        missing[i] = max(int(more[in_time]), 0)
        waited[i + 1 : i + 1 + in_time] = True
    return missing, waited


class Pace:
    """The usual interval between readings, from the last `_PACE_KEPT` intervals without a loss.

    `cyclic`: the device sends at one interval, however unevenly a busy machine stamps what arrives.
    """

    def __init__(self, *, cyclic: bool = False) -> None:
        self._cyclic = cyclic
        self._steps: collections.deque[float] = collections.deque(maxlen=_PACE_READINGS)
        self._new = 0
        self._estimate: tuple[float | None, float] = None, math.inf

    def add(self, *steps: float) -> None:
        """Add intervals between readings, s."""
        self._steps.extend(steps)
        self._new += len(steps)

    def _look(self) -> tuple[float | None, float]:
        if (
            self._new
            and len(self._steps) >= _PACE_LEAST
            and (self._new >= _PACE_READINGS // 8 or self._estimate[0] is None)
        ):
            steps = np.array(self._steps)
            middle, late = (float(x) for x in np.quantile(steps, (0.5, 0.98)))
            # The mean, because late readings are followed by early ones or arrive together; pauses are left out.
            total = float(np.sum(steps))
            period = float(np.mean(steps[steps <= max(0.1, _PACE_LEAST / len(steps)) * total]))
            even = self._cyclic or np.mean(np.abs(steps - middle) <= 0.5 * middle) >= 0.8
            longest = max(late, period) + 0.5 * period if even else math.inf
            self._estimate, self._new = (period if period > 0 else None, longest), 0
        return self._estimate

    @property
    def period(self) -> float | None:
        """Mean interval between readings, s; None with too few readings."""
        return self._look()[0]

    @property
    def longest(self) -> float:
        """Longest interval between readings that is not a gap, s; infinite for an irregular rate."""
        return self._look()[1]


def judge_sequence(
    numbers: npt.NDArray[np.int64], modulus: int, newest: int | None, expected: npt.NDArray[np.float64] | None = None
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int64], int]:
    """Find missing, duplicate or out-of-order samples by their sequence numbers.

    Parameters
    ----------
    numbers
        Sequence numbers as sent, shape (n,), n > 0.
    modulus
        Count after which the sequence number starts again from 0.
    newest
        Highest continuous number so far, None at the beginning.
    expected
        Steps of the number expected from the time since the previous reading, shape (n,), NaN where unknown; missed
        rollovers are counted by them. None: no rollover was missed.

    Returns
    -------
    status
        Bits "gap before", "duplicate" (repeats the newest number) and "out of order" (an older number), shape (n,).
    missing
        How many numbers are missing before each sample, shape (n,).
    newest
        Highest continuous number including these samples.
    """
    continuous, _ = unwrap(numbers, modulus, newest)
    if expected is not None:
        step = np.diff(continuous, prepend=continuous[0] - 1 if newest is None else newest)
        continuous = continuous + modulus * np.cumsum(wraps(step, modulus, expected))
    before = np.concatenate([[continuous[0] - 1 if newest is None else newest], continuous[:-1]])
    before = np.maximum.accumulate(before)
    missing = np.maximum(continuous - before - 1, 0)
    status = (missing > 0) * rf.GAP + (continuous == before) * rf.DUPLICATE + (continuous < before) * rf.OUT_OF_ORDER
    return status.astype(np.uint8), missing, int(max(before[-1], continuous[-1]))
