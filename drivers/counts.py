"""The arithmetic of counts: fields of frames, rollovers, running numbers."""

from __future__ import annotations

import collections
import math

import numpy as np
import numpy.typing as npt

from drivers import recording_format as rf

_PACE_KEPT, _PACE_LEAST = 512, 8
_SPEED_SECONDS, _LEAST_SECONDS = 1.0, 0.02  # of readings without a gap, from which a speed is known
_LOOK_AHEAD, _LATEST = 16, 0.1  # readings, and seconds, within which late ones catch up


def unwrap(
    raw: npt.NDArray[np.int64], modulus: int, previous: int | None = None, *, signed: bool = False
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Make counts that roll over continuous, each step taken the short way round.

    Parameters
    ----------
    raw
        Counts as sent, shape (n,), any representative modulo `modulus`.
    modulus
        Counts at which the device starts again from 0.
    previous
        Continuous count of the sample before, None at the beginning.
    signed
        Whether the first count is taken in [-modulus/2, modulus/2) instead of [0, modulus): an encoder a little below
        zero then begins at -1 and not a whole range above it.

    Returns
    -------
    counts, rolled
        Continuous counts, and the mask of samples after a rollover of the raw counts, both of shape (n,).
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


class UnseenTurns:
    """Continues counts over gaps with unseen rollovers, by the speed before the gap.

    Parameters
    ----------
    modulus
        Counts at which the position starts again from 0.
    """

    def __init__(self, modulus: int) -> None:
        self._modulus = modulus
        self._last: tuple[float, int] | None = None
        self._ways: collections.deque[tuple[float, float]] = collections.deque()  # s and counts, without a gap

    def __call__(
        self, times: npt.NDArray[np.float64], counts: npt.NDArray[np.int64], gaps: npt.NDArray[np.bool_]
    ) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
        """Return the counts and at which of them rollovers may have been unseen, both of shape (n,).

        Parameters
        ----------
        times, counts
            Of the readings, s and each step the short way round, shape (n,).
        gaps
            Before which readings others are missing, shape (n,).
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
            self._ways.append((self._last[0] - float(from_time), float(self._last[1] - from_count)))
            while sum(lasts for lasts, _ in self._ways) - self._ways[0][0] > _SPEED_SECONDS:
                self._ways.popleft()
        return counts, unseen

    def _speed(self) -> float | None:
        """Return the mean speed, counts/s, of the last second without a gap, as one instant may be 25 ms off."""
        lasts = sum(lasts for lasts, _ in self._ways)
        return sum(way for _, way in self._ways) / lasts if lasts > _LEAST_SECONDS else None


def counts_to_value(
    counts: npt.NDArray[np.int64], counts_per_turn: int, direction: int, zero: float
) -> npt.NDArray[np.float64]:
    """Return the angle in rad, counter-clockwise positive: direction * 2 pi counts / counts per turn - zero."""
    return np.asarray(direction * (2 * math.pi / counts_per_turn) * counts - zero, np.float64)


def extract_bits(
    payloads: npt.NDArray[np.uint8], start: int, length: int, *, signed: bool, little_endian: bool = True
) -> npt.NDArray[np.int64]:
    """Return an integer field of frames.

    Parameters
    ----------
    payloads
        Frames, shape (n, bytes).
    start
        Little-endian (CiA 301 mappings, DBC "@1"): lowest bit of the field, counted from byte 0's lowest. Big-endian:
        highest bit of the field, counted from byte 0's highest.
    length
        Bits, 1 to 64 (a 64-bit unsigned field wraps at 2^63).
    signed
        Whether the field is in two's complement.
    little_endian
        Order of the bytes.
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
    """Return the number of unseen rollovers of running numbers, by the elapsed time.

    Parameters
    ----------
    step
        Steps of the numbers, each known modulo `modulus` only, shape (n,).
    modulus
        Numbers after which they start again.
    expected
        Expected numbers by the elapsed time, shape (n,); NaN if not known.
    """
    rounds = np.rint((np.nan_to_num(expected) - step) / modulus)
    return np.maximum(rounds, 0).astype(np.int64)


def missing_by_pace(
    times: npt.NDArray[np.float64], steps: npt.NDArray[np.float64], gaps: npt.NDArray[np.bool_], period: float
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.bool_]]:
    """Return the readings missing before each by the elapsed time, and which were only delayed, shape (n,) each.

    Delayed readings are followed by others that were delayed with them; lost ones stay missing.

    Parameters
    ----------
    times, steps
        Times of the readings, s, and each one's step from the one before, shape (n,).
    gaps
        Where readings may be missing, shape (n,).
    period
        Usual time between readings, s.
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
    """The usual time between readings, from the last `_PACE_KEPT` steps in which none was lost."""

    def __init__(self) -> None:
        self._steps: collections.deque[float] = collections.deque(maxlen=_PACE_KEPT)
        self._new = 0
        self._found: tuple[float | None, float] = None, math.inf

    def add(self, *steps: float) -> None:
        """Take in steps, s."""
        self._steps.extend(steps)
        self._new += len(steps)

    def _look(self) -> tuple[float | None, float]:
        if self._new and len(self._steps) >= _PACE_LEAST and (self._new >= _PACE_KEPT // 8 or self._found[0] is None):
            steps = np.array(self._steps)
            middle, late = (float(x) for x in np.quantile(steps, (0.5, 0.98)))
            # The mean without pauses: late readings are followed by others early, or several come together.
            total = float(np.sum(steps))
            period = float(np.mean(steps[steps <= max(0.1, _PACE_LEAST / len(steps)) * total]))
            even = np.mean(np.abs(steps - middle) <= 0.5 * middle) >= 0.8
            longest = max(late, period) + 0.5 * period if even else math.inf
            self._found, self._new = (period if period > 0 else None, longest), 0
        return self._found

    @property
    def period(self) -> float | None:
        """Seconds between readings; None with too few."""
        return self._look()[0]

    @property
    def longest(self) -> float:
        """Largest interval between readings without a gap; infinite for an irregular rate."""
        return self._look()[1]


def judge_sequence(
    numbers: npt.NDArray[np.int64],
    modulus: int,
    newest: int | None,
    expected: npt.NDArray[np.float64] | None = None,
) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.int64], int]:
    """Find missing, duplicate or out-of-order samples by their running numbers.

    Parameters
    ----------
    numbers
        Running numbers as sent, shape (n,), n > 0.
    modulus
        Numbers after which they start again from 0.
    newest
        Highest continuous number so far, None at the beginning.
    expected
        Expected numbers by the time since the previous reading, shape (n,), NaN if not known: unseen rollovers are
        counted by it.

    Returns
    -------
    status, missing, newest
        Bits "gap before", "duplicate" (the number is the newest before) and "out of order" (it is an older one); the
        count of numbers left out before each, shape (n,) both; and the highest continuous number now.
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
