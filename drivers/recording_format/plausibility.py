"""Whether two angles are what the encoders of one drive can show: stuck encoders, jumps, values off the ratio's line.

What a drive does of itself must pass: transmission error, backlash, lost motion, windup, load steps and reversals all
keep the output angle within a small deviation of the line input angle / ratio. What an encoder does that fails does
not. A ratio that is wrong altogether, swapped angles or a wrong unit are no faults of single samples and are not
marked here: no stretch of such a recording follows the line.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.recording_format.schema import (
    ANGLES,
    DUPLICATE,
    GAP,
    OUT_OF_ORDER,
    RESET,
    Channel,
    FloatArray,
    Header,
    Samples,
)

LARGEST_DEVIATION = math.radians(1.0)  # far above TE, lost motion and windup of a gear drive, far below half a turn
LARGEST_DEVIATION_KEY = "largest_deviation"
_JUMP = 0.5 * math.pi  # off the motion before and after, where no largest speed is stated
_SPIKE = 3  # samples after which a jump back ends a spike
_LATE = 1.5  # usual steps of time: arrivals that were held up and come at once are no speed
_FOLLOW = 0.25  # of the way: a line that runs away slower than this is a wrong ratio or a clock that drifts
_STAMPS = 0.01  # s: one angle may be later than the other by so much (a filter, a delay that nobody stated)
_SEEN = 8  # samples that make a line
_ESTABLISHED = 4.0  # deviations of way over which a line has held
_LOCKED = 4.0  # deviations that an input which never moved may be away: a loop with the input locked
_SMALL = 0.02  # of the deviation: a jump that moves the angles less from the line does not show in it
_EQUAL = 3  # samples that stand still
_WAITING = 1 << 16  # samples of one angle that wait for the other
STAMP_SECONDS = 0.1  # by which the stamps of angles that share no instants may be late on a busy host

Mask = npt.NDArray[np.bool_]


@dataclasses.dataclass(frozen=True)
class Limits:
    """What two encoders on one drive can show.

    Attributes
    ----------
    deviation
        By how much output angle - input angle / ratio may change, rad: TE, lost motion and windup together.
    input_speed, output_speed
        Largest speeds, rad/s; None: not known. Then a step that is a quarter turn off the motion before and after it is
        a jump.
    input_resolution, output_resolution
        Step of the encoders, rad; 0: not known, or finer than all else.
    """

    deviation: float = LARGEST_DEVIATION
    input_speed: float | None = None
    output_speed: float | None = None
    input_resolution: float = 0.0
    output_resolution: float = 0.0


def limits_of(header: Header) -> Limits:
    """Return what the encoders of a recording can show, as it states it.

    The largest speeds and the counts per turn are its channels'; the deviation is its condition `largest_deviation`,
    rad, where it has one.
    """
    of = {c.role: c for c in header.channels if c.unit == "rad"}
    turning, driven = (of.get(role) for role in ANGLES)

    def resolution(channel: Channel | None) -> float:
        return 2.0 * math.pi / channel.counts_per_turn if channel is not None and channel.counts_per_turn else 0.0

    return Limits(
        float(header.conditions.get(LARGEST_DEVIATION_KEY, LARGEST_DEVIATION)),
        None if turning is None else turning.largest_speed,
        None if driven is None else driven.largest_speed,
        resolution(turning),
        resolution(driven),
    )


@dataclasses.dataclass(frozen=True)
class Finding:
    """Something implausible: since when, s, maybe before the block in which it shows, whom it concerns, and what."""

    time: float
    roles: tuple[str, ...]
    text: str


@dataclasses.dataclass
class _Judged:
    """Samples of one angle whose steps are judged, arrays of one length; `jumps` are marks too."""

    time: FloatArray
    value: FloatArray
    broken: Mask
    jumps: Mask

    @staticmethod
    def joined(parts: list[_Judged]) -> _Judged:
        if len(parts) == 1:
            return parts[0]
        return _Judged(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(_Judged)))

    def after(self, place: int) -> _Judged:
        return _Judged(*(getattr(self, f.name)[place:] for f in dataclasses.fields(self)))


class Steps:
    """Judges one angle by its steps from sample to sample, block by block.

    Parameters
    ----------
    role
        What it is called.
    largest_speed, resolution
        rad/s or None, and rad; see `Limits`.
    """

    def __init__(self, role: str, largest_speed: float | None, resolution: float) -> None:
        self.role, self._speed, self._resolution = role, largest_speed, resolution
        self._time, self._value, self._broken = np.zeros(0), np.zeros(0), np.zeros(0, np.bool_)
        self._usual: collections.deque[float] = collections.deque(maxlen=64)
        self._jumped: tuple[int, float] | None = None
        self._judged = False  # the last step, which had none after it
        self._said = False

    def add(self, time: FloatArray, value: FloatArray, broken: Mask) -> tuple[Mask, list[Finding]]:
        """Return which of the next samples are beyond a jump, or part of a spike, and what was found.

        Parameters
        ----------
        time, value
            s, rad, shape (n,).
        broken
            Where the step from the sample before is not judged, shape (n,); see `unjudged_steps`.
        """
        held = self._time.size
        if self._judged and self._speed is None and value.size > 3 and not broken.any():
            steps = np.diff(value)
            last = max(abs(float(value[0] - self._value[-1])), float(np.abs(np.diff(self._value)).max(initial=0.0)))
            if max(last, float(steps.max()), -float(steps.min())) <= 0.5 * _JUMP:  # no two are a jump apart
                self._time, self._value, self._broken = time[-3:], value[-3:], broken[-3:]
                self._jumped, self._said = None, False
                return np.zeros(value.size, np.bool_), []
        t = np.concatenate([self._time, time])
        v = np.concatenate([self._value, value])
        cut = np.concatenate([self._broken, broken])
        marks = np.zeros(v.size, np.bool_)
        found: list[Finding] = []
        if v.size > 1:
            wide, off = self._off(t, v, cut)
            first = held - 1 if held and not self._judged else held
            places = np.flatnonzero(wide)
            places = places[places >= first]
            for place in places.tolist():
                self._mark(marks, place - held, float(off[place]), held)
            if places.size and not self._said:
                place = int(places[0])
                more = f", and {places.size - 1} more jumps" if places.size > 1 else ""
                text = f"{self.role} jumps by {math.degrees(v[place] - v[place - 1]):.4g} deg{more}"
                found.append(Finding(float(t[place]), (self.role,), text))
            self._said = bool(places.size)
            self._judged = bool(wide[-1] or cut[-1]) or abs(v[-1] - v[-2]) <= 0.5 * _JUMP
        self._time, self._value, self._broken = t[-3:], v[-3:], cut[-3:]
        if self._jumped is not None:
            self._jumped = self._jumped[0] - time.size, self._jumped[1]
        return marks[held:], found

    def _off(self, t: FloatArray, v: FloatArray, cut: Mask) -> tuple[Mask, FloatArray]:
        """Return at which samples a step is none that the motion or the largest speed allows, and by how much."""
        way, lasts = np.diff(v, prepend=v[0]), np.diff(t, prepend=t[0])
        judged = ~cut
        judged[0] = False
        if self._speed is None and max(way.max(), -way.min()) <= 0.5 * _JUMP:  # no two steps are a jump apart
            return np.zeros(v.size, np.bool_), way
        self._usual.extend(lasts[judged & (lasts > 0.0)][-64:].tolist())
        usual = float(np.median(self._usual)) if self._usual else 0.0
        away = np.full((2, v.size), np.inf)
        known = np.zeros((2, v.size), np.bool_)
        for row, there in enumerate((slice(None, -1), slice(1, None))):
            here = slice(1, None) if row == 0 else slice(None, -1)
            with np.errstate(invalid="ignore", divide="ignore"):
                scaled = np.where(lasts[there] > 0.0, way[there] / lasts[there] * lasts[here], way[there])
            low, high = np.minimum(way[there], scaled), np.maximum(way[there], scaled)
            # With a neighbour on one side alone it may have turned back there.
            turns = ~judged[slice(2, None) if row == 0 else slice(None, -2)]
            turns = np.append(turns, True) if row == 0 else np.append(True, turns)
            largest = np.maximum(np.abs(low), np.abs(high))
            away[row, here] = way[here] - np.clip(
                way[here], np.where(turns, -largest, low), np.where(turns, largest, high)
            )
            known[row, here] = judged[there]
        nearest = np.where(np.abs(away[0]) <= np.abs(away[1]), away[0], away[1])
        off = np.where(known[0], np.where(known[1], nearest, away[0]), np.where(known[1], away[1], 0.0))
        # Without the step after it a step is not judged yet: a drive may start within one.
        decided = known[1] | (np.append(cut[1:], False) & known[0])
        wide = judged & decided & (np.abs(off) > _JUMP)
        if self._speed is not None:
            allowed = self._speed * np.maximum(lasts, _LATE * usual) + 2.0 * self._resolution
            fast = judged & (np.abs(way) > allowed)
            off = np.where(fast & ~wide, np.sign(way) * (np.abs(way) - allowed), off)
            wide = fast | (wide & (np.abs(way) > allowed))
        return wide, off

    def _mark(self, marks: Mask, place: int, off: float, held: int) -> None:
        """Mark the sample of a jump; one back ends a spike, whose samples are marked instead."""
        if self._jumped is not None:
            begun, by = self._jumped
            if place - begun <= _SPIKE and off * by < 0.0 and abs(off + by) <= max(_JUMP, 0.5 * abs(by)):
                marks[max(0, begun + held) : place + held] = True
                marks[place + held] = False
                self._jumped = None
                return
        marks[max(place, 0) + held] = True
        self._jumped = place, off


@dataclasses.dataclass
class _Away:
    """An angle that is off the line: between which deviations it is back, whose fault, and of which kind."""

    low: float
    high: float
    roles: tuple[str, ...]
    middle: float


@dataclasses.dataclass
class _Last:
    """The sample before: time, angles, deviation, that of the one before it, and the rates of both, rad/s, output's.

    `returned`: it was the first back on the line.
    """

    time: float
    turning: float
    driven: float
    off: float
    earlier: float
    turning_rate: float
    driven_rate: float
    returned: bool


@dataclasses.dataclass
class _Stretch:
    """Samples of both angles without a gap between: arrays of one length."""

    time: FloatArray
    turning: FloatArray
    driven: FloatArray
    turning_jumps: Mask
    driven_jumps: Mask


class Line:
    """Judges two angles, taken at the same instants, by the line of the ratio, block by block.

    Parameters
    ----------
    ratio
        Signed ratio input/output.
    limits
        What the encoders can show.
    apart
        s by which the two angles' times may be wrong against each other, such as stamps of a busy host.
    """

    def __init__(self, ratio: float, limits: Limits, apart: float = 0.0) -> None:
        self._ratio = ratio
        self._wide = limits.deviation + 2.0 * (limits.output_resolution + limits.input_resolution / abs(ratio))
        self._apart = apart
        self._stamps = _STAMPS + apart
        self._turns = 0.0  # of the input that were lost in gaps, as deviation
        self._runs = [0, 0]  # samples before this one that are equal to it
        self._stood = [(0.0, 0.0)] * 2  # when these runs began, s, and the deviation then, rad
        self._moved = False
        self._last: _Last | None = None
        self._travel = 0.0
        self._low, self._high, self._span = math.inf, -math.inf, (math.inf, -math.inf)
        self._seen, self._held, self._ranges = 0, False, [(math.inf, -math.inf)] * 2
        self._away: _Away | None = None

    def add(
        self, time: FloatArray, angles: Mapping[str, FloatArray], broken: Mask, jumps: Mapping[str, Mask]
    ) -> tuple[dict[str, Mask], Mask, list[Finding]]:
        """Return which of the next samples are implausible, by role, which are back on the line, and what was found.

        Parameters
        ----------
        time, angles
            s, and rad by role, shape (n,).
        broken
            Where a gap lies before a sample, in which the crank may have turned unseen, shape (n,).
        jumps
            Where `Steps` found a jump, by role, shape (n,).
        """
        marks = {role: np.zeros(time.size, np.bool_) for role in ANGLES}
        returned = np.zeros(time.size, np.bool_)
        found: list[Finding] = []
        for begin, end in itertools.pairwise([0, *(i for i in np.flatnonzero(broken).tolist() if i), time.size]):
            if end == begin:
                continue
            part = slice(begin, end)
            turning, driven = (angles[role][part] for role in ANGLES)
            turning_jumps, driven_jumps = (jumps[role][part] for role in ANGLES)
            here = _Stretch(time[part], turning, driven, turning_jumps, driven_jumps)
            parts = {role: mask[part] for role, mask in marks.items()}
            for one in self._stretch(here, bool(broken[begin]), parts, returned[part]):
                for role in one.roles:
                    marks[role][:begin] |= time[:begin] >= one.time
                found.append(one)
        return marks, returned, found

    @property
    def away(self) -> tuple[str, ...]:
        """Roles that are off the line at the end of what was judged."""
        return () if self._away is None else self._away.roles

    def _stretch(self, given: _Stretch, gap: bool, marks: dict[str, Mask], returned: Mask) -> Iterator[Finding]:
        """Judge samples without a gap but before the first."""
        time, size = given.time, given.time.size
        line = given.turning / self._ratio
        if gap and self._last is not None:
            self._recount(float(given.driven[0] - line[0]))
        off = given.driven - line + self._turns
        before = None if gap else self._last
        if before is not None and self._keeps(given, off, before):
            return
        turned = np.diff(given.turning, prepend=given.turning[0] if before is None else before.turning) / self._ratio
        driven = np.diff(given.driven, prepend=given.driven[0] if before is None else before.driven)
        lasts = np.maximum(np.diff(time, prepend=time[0] if before is None else before.time), 1e-9)
        runs = [self._equal(place, step, fresh=before is None) for place, step in enumerate((turned, driven))]
        moved = np.logical_or.accumulate(turned != 0.0) | self._moved
        wide = np.where(moved, self._wide, _LOCKED * self._wide)
        speed = np.maximum(np.abs(turned), np.abs(driven)) / lasts
        usual = np.minimum(speed, 4.0 * np.median(speed)) if size > 2 else speed
        if before is not None and before.returned and (given.turning_jumps[0] or given.driven_jumps[0]):
            given.turning_jumps[0] = given.driven_jumps[0] = False  # it was back to where it belongs
            returned[0] = True
        sudden, whose, rates = self._sudden(turned, driven, lasts, usual, given, before)
        was = np.concatenate([[off[0] if before is None else before.off], off[:-1]])
        at = 0
        while at < size:
            if self._away is not None:
                back = np.flatnonzero((off[at:] >= self._away.low) & (off[at:] <= self._away.high))
                end = at + int(back[0]) if back.size else size
                for role in self._away.roles:
                    marks[role][at:end] = True
                at = end
                if back.size:
                    self._away = None
                    self._begin(keep=True)
                    returned[at] = True
                    sudden[at] = False
                continue
            travel = self._travel + np.cumsum(np.abs(turned[at:]))
            here, slack = off[at:], self._stamps * usual[at:]
            low = np.minimum.accumulate(np.minimum(here - _FOLLOW * travel + slack, self._low))
            high = np.maximum.accumulate(np.maximum(here + _FOLLOW * travel - slack, self._high))
            departs = np.maximum(here - _FOLLOW * travel - slack - low, high - (here + _FOLLOW * travel + slack))
            beyond = (departs > wide[at:]) | sudden[at:]
            end = at + int(np.argmax(beyond)) if beyond.any() else size
            part = slice(at, end)
            self._take(line[part], off[part], usual[part], low[: end - at], high[: end - at], travel[: end - at])
            at = end
            if end == size:
                break
            if sudden[end]:
                yield self._leap(end, given, off, was, int(whose[end]), marks)
                at, sudden[end] = end + 1, False
            elif (found := self._departure(end, given, off, runs, marks)) is not None:
                yield found
            else:  # there is no line yet that it departs from
                self._begin(keep=False)
                self._low = self._high = float(off[end])
        self._moved = bool(moved[-1])
        for place, run in enumerate(runs):
            if run[-1] < size:
                begun = size - 1 - int(run[-1])
                self._stood[place] = float(time[begun]), float(off[begun])
        angles = float(given.turning[-1]), float(given.driven[-1])
        self._last = _Last(float(time[-1]), *angles, float(off[-1]), float(was[-1]), *rates, bool(returned[-1]))

    def _keeps(self, given: _Stretch, off: FloatArray, before: _Last) -> bool:
        """Take samples that are so near to the line that nothing can be wrong with them; False where they are not.

        That is what a sound bench gives for hours, at a fifth of the time.
        """
        if self._away is not None or before.returned or not (self._held and self._moved) or off.size < _SEEN:
            return False
        low, high = min(self._span[0], float(off.min())), max(self._span[1], float(off.max()))
        if high - low > 0.5 * self._wide or given.turning_jumps.any() or given.driven_jumps.any():
            return False
        time, turning, driven = given.time, given.turning, given.driven
        travel = (float(np.abs(np.diff(turning)).sum()) + abs(float(turning[0]) - before.turning)) / abs(self._ratio)
        self._travel += travel
        slack = self._stamps * travel / max(float(time[-1]) - before.time, 1e-9)
        self._low = min(self._low, low - _FOLLOW * self._travel + slack)
        self._high = max(self._high, high + _FOLLOW * self._travel - slack)
        self._seen, self._span = self._seen + off.size, (low, high)
        for place, (angle, last) in enumerate(((turning, before.turning), (driven, before.driven))):
            changed = (
                np.flatnonzero(angle[:-1] != angle[-1])[-1:] if angle[-1] == angle[-2] else np.array([off.size - 2])
            )
            if changed.size:
                begun = int(changed[0]) + 1
                self._runs[place], self._stood[place] = off.size - 1 - begun, (float(time[begun]), float(off[begun]))
            elif last == angle[-1]:
                self._runs[place] += off.size
            else:
                self._runs[place], self._stood[place] = off.size - 1, (float(time[0]), float(off[0]))
        lasts = max(float(time[-1] - time[-2]), 1e-9)
        rates = float(turning[-1] - turning[-2]) / self._ratio / lasts, float(driven[-1] - driven[-2]) / lasts
        angles = float(turning[-1]), float(driven[-1])
        self._last = _Last(float(time[-1]), *angles, float(off[-1]), float(off[-2]), *rates, False)
        return True

    def _recount(self, off: float) -> None:
        """Take whole turns of the input that passed unseen in a gap for what they are."""
        assert self._last is not None
        turn = 2.0 * math.pi / abs(self._ratio)
        was = self._last.off if self._away is None else self._away.middle
        if abs(off + self._turns - was) > self._wide:
            self._turns -= round((off + self._turns - was) / turn) * turn

    def _equal(self, place: int, step: FloatArray, *, fresh: bool) -> npt.NDArray[np.int64]:
        """Return of each sample how many before it are equal to it."""
        number = np.arange(step.size)
        changed = step != 0.0
        if fresh:
            changed[0] = True
        last = np.maximum.accumulate(np.where(changed, number, -1))
        run = np.where(last < 0, number + 1 + self._runs[place], number - last)
        self._runs[place] = int(run[-1])
        return run

    def _sudden(
        self, turned: FloatArray, driven: FloatArray, lasts: FloatArray, speed: FloatArray, given: _Stretch,
        before: _Last | None,
    ) -> tuple[Mask, npt.NDArray[np.int64], tuple[float, float]]:  # fmt: skip
        """Return where the deviation leaps beyond what the motion before explains, and whose leap it is.

        0 is the input's. Third the rates of both before the next sample, rad/s of the output.
        """
        steps = np.array([turned, driven])
        first = np.zeros(2) if before is None else np.array([before.turning_rate, before.driven_rate])
        rates = np.concatenate([first[:, None], steps / lasts], axis=1)
        allowed = self._wide + self._apart * np.concatenate([speed[:1], speed[:-1]])

        def beyond(at: Any, reference: Any) -> FloatArray:
            expected = rates[:, reference] * lasts[at]
            same = steps[:, np.maximum(reference - 1, 0)]
            return np.asarray(
                steps[:, at] - np.clip(steps[:, at], np.minimum(expected, same), np.maximum(expected, same))
            )

        number = np.arange(turned.size)
        change = driven - turned
        leaps = beyond(number, number) if max(change.max(), -change.min()) > 0.5 * self._wide else np.zeros_like(steps)
        sudden = np.abs(leaps[1] - leaps[0]) > allowed
        if before is None:
            sudden[:2] = False  # the first has no step, the second none before it
        for at in np.flatnonzero(sudden).tolist():  # behind a leap the motion is what it was before it
            begun = at
            while begun > 0 and sudden[begun - 1] and at - begun < _SPIKE:
                begun -= 1
            if begun != at:
                leaps[:, at] = beyond(at, begun)
                sudden[at] = abs(leaps[1, at] - leaps[0, at]) > allowed[at]
        whose = (np.abs(leaps[1]) > np.abs(leaps[0])).astype(np.int64)
        for place, jumps in enumerate((given.turning_jumps, given.driven_jumps)):
            if jumps.any():
                sudden |= jumps
                whose[jumps] = place
        calm = np.flatnonzero(~sudden)
        rate = rates[:, calm[-1] + 1] if calm.size else first
        return sudden, whose, (float(rate[0]), float(rate[1]))

    def _leap(
        self, at: int, given: _Stretch, off: FloatArray, was: FloatArray, whose: int, marks: dict[str, Mask]
    ) -> Finding:
        """Take the angles for off the line from a leap on, where there is a line."""
        role, before = ANGLES[whose], float(was[at])
        if at == 0 and self._last is not None and abs(off[at] - before) < abs(off[at] - self._last.earlier):
            before = self._last.earlier  # a jump of the newest sample shows with the next
        by = float(off[at]) - before
        if self._seen >= _SEEN and abs(by) > _SMALL * self._wide:
            half = min(0.5 * abs(by), 2.0 * self._wide)
            self._away = _Away(before - half, before + half, (role,), before)
        elif self._seen < _SEEN:
            self._begin(keep=False)
        marks[role][at] = True
        value = math.degrees(by * (-self._ratio if whose == 0 else 1.0))
        return Finding(float(given.time[at]), (role,), f"{role} jumps by {value:.4g} deg")

    def _departure(
        self, at: int, given: _Stretch, off: FloatArray, runs: list[npt.NDArray[np.int64]], marks: dict[str, Mask]
    ) -> Finding | None:
        """Tell what a departure from the line is; None where there is no line yet that it departs from."""
        if self._seen < _SEEN:
            return None
        stuck = [place for place in (0, 1) if runs[place][at] >= _EQUAL]
        if len(stuck) == 1:
            place = stuck[0]
            role, other, run = ANGLES[place], ANGLES[1 - place], int(runs[place][at])
            begun = max(at - run, 0)
            moved = abs(float((given.driven, given.turning)[place][at] - (given.driven, given.turning)[place][begun]))
            value = math.degrees(float((given.turning, given.driven)[place][at]))
            before = float(off[at - run]) if at >= run else self._stood[place][1]
            self._away = _Away(before - self._wide, before + self._wide, (role,), before)
            marks[role][max(0, at - run + 1) : at + 1] = True
            since = given.time[at - run + 1] if at >= run else np.nextafter(self._stood[place][0], np.inf)
            text = f"{role} stands still at {value:.6g} deg for {run + 1} samples while {other} moves"
            if at >= run:
                text += f" by {math.degrees(moved):.3g} deg"
            return Finding(float(since), (role,), text)
        if not self._held:
            return None
        low, high = self._span
        middle = 0.5 * (self._low + self._high)
        if high - low > 2.0 * self._wide:  # a line that has run away slowly is where it is now
            low = high = middle
        by = math.degrees(float(off[at]) - middle)
        self._away = _Away(min(low, high - self._wide), max(high, low + self._wide), ANGLES, middle)
        text = f"the angles are off the line of the ratio {self._ratio:g} by {by:.3g} deg of the output"
        return Finding(float(given.time[at]), ANGLES, text)

    def _take(
        self,
        line: FloatArray,
        off: FloatArray,
        speed: FloatArray,
        low: FloatArray,
        high: FloatArray,
        travel: FloatArray,
    ) -> None:
        """Let the line hold these samples too."""
        if not line.size:
            return
        self._low, self._high, self._travel = float(low[-1]), float(high[-1]), float(travel[-1])
        self._span = min(self._span[0], float(off.min())), max(self._span[1], float(off.max()))
        self._seen += line.size
        if self._held:
            return
        ends = [(np.minimum.accumulate(np.minimum(v, lo)), np.maximum.accumulate(np.maximum(v, hi)))
                for v, (lo, hi) in zip((line, off), self._ranges, strict=True)]  # fmt: skip
        slack = self._stamps * np.maximum.accumulate(speed)
        far = np.flatnonzero(ends[0][1] - ends[0][0] >= _ESTABLISHED * (self._wide + 2.0 * slack))
        self._ranges = [(float(lo[-1]), float(hi[-1])) for lo, hi in ends]
        if far.size:
            first = int(far[0])
            self._held = bool(ends[1][1][first] - ends[1][0][first] <= self._wide + 2.0 * slack[first])
            self._ranges = [(math.inf, -math.inf)] * 2

    def _begin(self, *, keep: bool) -> None:
        """Begin a line anew; `keep` what is known of how well the one before held."""
        self._low, self._high, self._travel, self._span = math.inf, -math.inf, 0.0, (math.inf, -math.inf)
        if not keep:
            self._seen, self._held, self._ranges = 0, False, [(math.inf, -math.inf)] * 2


class Plausibility:
    """Judges the two angles of a drive, block by block: by their steps, and with a ratio by its line.

    Parameters
    ----------
    ratio
        Signed ratio input/output of the drive between the encoders, or None.
    limits
        What the encoders can show.

    Examples
    --------
    An input encoder that stands still from the thousandth sample on:

    >>> import numpy as np
    >>> from drivers.recording_format import Plausibility, Samples
    >>> time = np.arange(2000) / 1000
    >>> crank = Samples.checked("input_angle", time, np.minimum(10.0 * time, 10.0))
    >>> output = Samples.checked("output_angle", time, -10.0 * time / 39)
    >>> implausible, found = Plausibility(-39.0).add({"input_angle": crank, "output_angle": output})
    >>> int(np.argmax(implausible["input_angle"])), found[0].roles
    (1001, ('input_angle',))
    """

    def __init__(self, ratio: float | None, limits: Limits | None = None) -> None:
        limits = limits or Limits()
        self._steps = {
            "input_angle": Steps("input_angle", limits.input_speed, limits.input_resolution),
            "output_angle": Steps("output_angle", limits.output_speed, limits.output_resolution),
        }
        self._ratio, self._limits = ratio, limits
        self._line: Line | None = None
        self._shared = True
        self._waiting: dict[str, list[_Judged]] = {role: [] for role in ANGLES}
        self._broken = False
        self._ends = dict.fromkeys(ANGLES, -math.inf)

    def add(self, blocks: Mapping[str, Samples]) -> tuple[dict[str, Mask], list[Finding]]:
        """Return which of the next samples are implausible, and what was found.

        Parameters
        ----------
        blocks
            Samples of the roles "input_angle" and "output_angle", or one of them. What is a duplicate or out of order
            is not judged. Angles that share no instants are compared by interpolation.

        Returns
        -------
        implausible, findings
            Of shape (n,) by role, and one finding for each fault that begins; one may have begun before the block.
        """
        marks: dict[str, Mask] = {}
        found: list[Finding] = []
        kept: dict[str, Mask] = {}
        for role, samples in blocks.items():
            mine = marks[role] = np.zeros(len(samples), np.bool_)
            if not len(samples):
                continue
            time = samples.time_host
            whole = time[0] > self._ends[role] and bool((np.diff(time) > 0.0).all())
            if whole and not (samples.status & (DUPLICATE | OUT_OF_ORDER)).any():
                onward, furthest = np.ones(time.size, np.bool_), time
            else:
                furthest = np.maximum.accumulate(np.concatenate([[self._ends[role]], time]))
                onward = (samples.status & (DUPLICATE | OUT_OF_ORDER) == 0) & (time > furthest[:-1])
                whole = bool(onward.all())
            self._ends[role] = float(furthest[-1])
            kept[role] = onward
            broken = np.asarray(samples.status & (GAP | RESET) != 0)
            part = slice(None) if whole else onward
            jumps, said = self._steps[role].add(time[part], samples.value[part], broken[part])
            mine[part] = jumps
            found += said
            self._waiting[role].append(
                _Judged(time if whole else time[onward], samples.value[part], broken[part], jumps)
            )
        if self._ratio is None or not all(self._waiting.values()):
            return marks, found
        paired = self._paired()
        if paired is None:
            return marks, found
        time, angles, broken, jumped = paired
        if self._line is None:
            self._line = Line(self._ratio, self._limits, 0.0 if self._shared else STAMP_SECONDS)
        by_role, returned, said = self._line.add(time, angles, broken, jumped)
        for role, mine in marks.items():
            if not len(mine):
                continue
            own = blocks[role].time_host
            place = np.arange(own.size) if own is time else np.searchsorted(time, own)
            inside = (place < time.size) & kept[role]
            place = np.minimum(place, time.size - 1)
            mine[inside & returned[place]] = False  # what is back on the line did jump, to where it belongs
            mine |= inside & by_role[role][place]
            if role in self._line.away:
                mine |= ~inside & kept[role]
        jumps_said = {(f.time, role) for f in found for role in f.roles}
        back = set(time[returned].tolist())
        found = [f for f in found if f.time not in back]
        return marks, found + [f for f in said if not any((f.time, role) in jumps_said for role in f.roles)]

    def _paired(self) -> tuple[FloatArray, dict[str, FloatArray], Mask, dict[str, Mask]] | None:
        """Return the instants at which both angles are known and what they are; what is beyond waits."""
        turning, driven = (_Judged.joined(self._waiting[role]) for role in ANGLES)
        if turning.time.size == driven.time.size and np.array_equal(turning.time, driven.time):
            self._waiting = {role: [] for role in ANGLES}
            jumps = {"input_angle": turning.jumps, "output_angle": driven.jumps}
            angles = {"input_angle": turning.value, "output_angle": driven.value}
            return (turning.time, angles, turning.broken | driven.broken, jumps) if turning.time.size else None
        if not (turning.time.size and driven.time.size):
            return None
        common = np.isin(driven.time, turning.time)
        if self._line is None:
            self._shared = bool(common.any())
        if self._shared:
            time = driven.time[common]
            if not time.size:
                return None
        else:
            time = driven.time[(driven.time >= turning.time[0]) & (driven.time <= turning.time[-1])]
            if not time.size:
                return None
        angles = {
            "input_angle": np.interp(time, turning.time, turning.value),
            "output_angle": driven.value[np.searchsorted(driven.time, time)],
        }
        passed = {
            "input_angle": np.searchsorted(turning.time, time, "left" if not self._shared else "right"),
            "output_angle": np.searchsorted(driven.time, time, "right"),
        }
        broken = np.zeros(time.size, np.bool_)
        jumps = {}
        for role, one in (("input_angle", turning), ("output_angle", driven)):
            upto = np.concatenate([[0], passed[role]])
            counted = np.concatenate([[0], np.cumsum(one.broken)])
            broken |= np.diff(counted[np.minimum(upto, one.time.size)]) > 0
            leaps = np.concatenate([[0], np.cumsum(one.jumps)])
            jumps[role] = np.diff(leaps[np.minimum(upto, one.time.size)]) > 0
            keep = max(int(passed[role][-1]) - (role == "input_angle" and not self._shared), one.time.size - _WAITING)
            self._waiting[role] = [one.after(keep)] if keep < one.time.size else []
        return time, angles, broken, jumps
