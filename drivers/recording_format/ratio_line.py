"""Two angles judged by the line of the ratio, input angle / ratio, from which a drive deviates only slightly."""

from __future__ import annotations

import dataclasses
import itertools
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from drivers.recording_format.limits import Finding, Limits, Mask
from drivers.recording_format.schema import ANGLES, FloatArray

_SPIKE = 3  # samples within which a jump back ends a spike
_FOLLOW = 0.25  # of the travel: a slower drift off the line is a wrong ratio or clock drift
_STAMPS = 0.01  # s: unstated delay of one angle against the other, such as a filter's
_SEEN = 8  # samples that make a line
_ESTABLISHED = 4.0  # travel, in largest deviations, after which a line is established
_LOCKED = 4.0  # largest deviations allowed at least while the input is at rest from the start on: a loop
_AT_REST = math.radians(1.0)  # of the input: noise of its encoder, and windup of what locks it
_SMALL = 0.02  # of the largest deviation: a smaller jump does not show as one off the line
_EQUAL = 3  # equal samples that make a stuck encoder


@dataclasses.dataclass
class _Away:
    """An angle off the line: deviations between which it is back, roles at fault, deviation before the fault, rad.

    `value` is the constant value of a stuck encoder, rad.
    """

    low: float
    high: float
    roles: tuple[str, ...]
    middle: float
    value: float | None = None


@dataclasses.dataclass
class _Last:
    """The previous sample: time, s, angles and deviation, rad, deviation of the one before, rates, rad/s of the output.

    The rates are those of a step that lasts `duration`, s. `judged`: roles whose jump here is judged already, as one
    off the line or back on it.
    """

    time: float
    turning: float
    driven: float
    off: float
    earlier: float
    turning_rate: float
    driven_rate: float
    duration: float
    judged: tuple[str, ...] = ()


@dataclasses.dataclass
class _Stretch:
    """Gapless samples of both angles: arrays of equal length."""

    time: FloatArray
    turning: FloatArray
    driven: FloatArray
    turning_jumps: Mask
    driven_jumps: Mask


class Line:
    """Judges two angles, sampled at the same times, by the line of the ratio, block by block.

    Parameters
    ----------
    ratio
        Signed ratio input/output.
    limits
        Limits of the encoders.
    apart
        Largest error of the two angles' times against each other, s, such as from stamps of a busy host.
    """

    def __init__(self, ratio: float, limits: Limits, apart: float = 0.0) -> None:
        self._ratio = ratio
        self._wide = limits.deviation + 2.0 * (limits.output_resolution + limits.input_resolution / abs(ratio))
        self._apart = apart
        self._stamps = _STAMPS + apart
        self._turns = 0.0  # input turns lost in gaps, as a deviation, rad
        self._runs = [0, 0]  # number of equal samples before the last one
        self._stood = [(0.0, 0.0)] * 2  # start of these runs, s, and the deviation then, rad
        self._moved, self._begins = False, math.nan
        # A drive with a locked input does not move its output as far as a turn of the input would.
        self._locked = max(_LOCKED * self._wide, 2.0 * math.pi / abs(ratio))
        self._last: _Last | None = None
        self._travel = 0.0
        self._low, self._high, self._span = math.inf, -math.inf, (math.inf, -math.inf)
        self._seen, self._held, self._ranges = 0, False, [(math.inf, -math.inf)] * 2
        self._away: _Away | None = None

    def add(
        self, time: FloatArray, angles: Mapping[str, FloatArray], broken: Mask, jumps: Mapping[str, Mask]
    ) -> tuple[dict[str, Mask], Mask, list[Finding]]:
        """Return masks of implausible samples by role, the mask of those whose jumps are no new ones, and findings.

        A jump is no new one where it leads back to the line, or where it is that of the sample before, judged already;
        the masks have the shape (n,).

        Parameters
        ----------
        time, angles
            Times, s, and angles by role, rad, shape (n,).
        broken
            Mask of the samples after a gap, in which the crank may have turned unseen, shape (n,).
        jumps
            Masks of the jumps that `Steps` found, by role, shape (n,).
        """
        marks = {role: np.zeros(time.size, np.bool_) for role in ANGLES}
        returned = np.zeros(time.size, np.bool_)
        findings: list[Finding] = []
        for begin, end in itertools.pairwise([0, *(i for i in np.flatnonzero(broken).tolist() if i), time.size]):
            if end == begin:
                continue
            part = slice(begin, end)
            turning, driven = (angles[role][part] for role in ANGLES)
            turning_jumps, driven_jumps = (jumps[role][part] for role in ANGLES)
            here = _Stretch(time[part], turning, driven, turning_jumps, driven_jumps)
            parts = {role: mask[part] for role, mask in marks.items()}
            for finding in self._stretch(here, bool(broken[begin]), parts, returned[part]):
                for role in finding.roles:
                    marks[role][:begin] |= time[:begin] >= finding.time
                findings.append(finding)
        return marks, returned, findings

    def still_away(self, role: str, values: FloatArray) -> Mask:
        """Return the mask of later values, not judged yet, that continue the present fault, shape (n,)."""
        if self._away is None or role not in self._away.roles:
            return np.zeros(values.size, np.bool_)
        return np.ones(values.size, np.bool_) if self._away.value is None else values == self._away.value

    def _stretch(self, given: _Stretch, gap: bool, marks: dict[str, Mask], returned: Mask) -> Iterator[Finding]:
        """Judge gapless samples; `gap`: there is a gap before the first."""
        time, size = given.time, given.time.size
        line = given.turning / self._ratio
        if gap and self._last is not None:
            self._recount(float(given.driven[0] - line[0]))
        off = given.driven - line + self._turns
        before = None if gap else self._last
        turned = np.diff(given.turning, prepend=given.turning[0] if before is None else before.turning) / self._ratio
        driven = np.diff(given.driven, prepend=given.driven[0] if before is None else before.driven)
        lasts = np.maximum(np.diff(time, prepend=time[0] if before is None else before.time), 1e-9)
        runs = [self._equal(index, step, fresh=before is None) for index, step in enumerate((turned, driven))]
        if math.isnan(self._begins):
            self._begins = float(given.turning[0])
        moved = np.logical_or.accumulate(np.abs(given.turning - self._begins) > _AT_REST) | self._moved
        wide = np.where(moved, self._wide, self._locked)
        speed = np.maximum(np.abs(turned), np.abs(driven)) / lasts
        usual = np.minimum(speed, 4.0 * np.median(speed)) if size > 2 else speed
        for role, jumps in zip(ANGLES, (given.turning_jumps, given.driven_jumps), strict=True):
            if before is not None and role in before.judged and jumps[0]:
                jumps[0], returned[0] = False, True
        sudden, whose, rates = self._sudden(turned, driven, lasts, usual, given, before)
        was = np.concatenate([[off[0] if before is None else before.off], off[:-1]])
        at, judged = 0, dict[int, tuple[str, ...]]()
        while at < size:
            if self._away is not None:
                roles = self._away.roles
                at = self._return(at, off, marks, returned, sudden)
                judged[at] = roles
                continue
            at = self._follow(at, line, off, turned, usual, wide, sudden)
            if at == size:
                break
            if sudden[at]:
                yield self._leap(at, given, off, was, int(whose[at]), marks)
                judged[at] = (ANGLES[whose[at]],)
                at += 1
            elif (departure := self._departure(at, given, off, runs, marks)) is not None:
                yield departure
            else:  # no line is established yet
                self._begin(keep=False)
                self._low = self._high = float(off[at])
        self._moved = bool(moved[-1])
        for index, run in enumerate(runs):
            if run[-1] < size:
                begun = size - 1 - int(run[-1])
                self._stood[index] = float(time[begun]), float(off[begun])
        angles = float(given.turning[-1]), float(given.driven[-1])
        self._last = _Last(float(time[-1]), *angles, float(off[-1]), float(was[-1]), *rates, judged.get(size - 1, ()))

    def _return(self, at: int, off: FloatArray, marks: dict[str, Mask], returned: Mask, sudden: Mask) -> int:
        """Mark samples off the line from `at` on; return the place of the first one back on it, or the end."""
        assert self._away is not None
        back = np.flatnonzero((off[at:] >= self._away.low) & (off[at:] <= self._away.high))
        end = at + int(back[0]) if back.size else off.size
        for role in self._away.roles:
            marks[role][at:end] = True
        if back.size:
            self._away = None
            self._begin(keep=True)
            returned[end] = True
            sudden[end] = False
        return end

    def _follow(
        self,
        at: int,
        line: FloatArray,
        off: FloatArray,
        turned: FloatArray,
        usual: FloatArray,
        wide: FloatArray,
        sudden: Mask,
    ) -> int:
        """Add samples to the line from `at` on; return the place of the first one that leaves it, or the end."""
        travel = self._travel + np.cumsum(np.abs(turned[at:]))
        here, slack = off[at:], self._stamps * usual[at:]
        low = np.minimum.accumulate(np.minimum(here - _FOLLOW * travel + slack, self._low))
        high = np.maximum.accumulate(np.maximum(here + _FOLLOW * travel - slack, self._high))
        departs = np.maximum(here - _FOLLOW * travel - slack - low, high - (here + _FOLLOW * travel + slack))
        beyond = (departs > wide[at:]) | sudden[at:]
        count = int(np.argmax(beyond)) if beyond.any() else beyond.size
        part = slice(at, at + count)
        self._take(line[part], off[part], usual[part], low[:count], high[:count], travel[:count])
        return at + count

    def _recount(self, off: float) -> None:
        """Correct the deviation for whole input turns missed in a gap."""
        assert self._last is not None
        turn = 2.0 * math.pi / abs(self._ratio)
        was = self._last.off if self._away is None else self._away.middle
        if abs(off + self._turns - was) > self._wide:
            self._turns -= round((off + self._turns - was) / turn) * turn

    def _equal(self, index: int, step: FloatArray, *, fresh: bool) -> npt.NDArray[np.int64]:
        """Return the number of equal samples directly before each sample, shape (n,)."""
        number = np.arange(step.size)
        changed = step != 0.0
        if fresh:
            changed[0] = True
        last = np.maximum.accumulate(np.where(changed, number, -1))
        run = np.where(last < 0, number + 1 + self._runs[index], number - last)
        self._runs[index] = int(run[-1])
        return run

    def _sudden(
        self,
        turned: FloatArray,
        driven: FloatArray,
        lasts: FloatArray,
        speed: FloatArray,
        given: _Stretch,
        before: _Last | None,
    ) -> tuple[Mask, npt.NDArray[np.int64], tuple[float, float, float]]:
        """Return the mask of jumps of the deviation that the motion before does not explain, and whose each jump is.

        0 is the input, 1 the output. The third result is the rates of both before the next sample, rad/s of the output,
        and the duration of their step, s.
        """
        steps = np.array([turned, driven])
        first = np.zeros(2) if before is None else np.array([before.turning_rate, before.driven_rate])
        durations = np.append(0.0 if before is None else before.duration, lasts)
        rates = np.concatenate([first[:, None], steps / lasts], axis=1)
        allowed = self._wide + self._apart * np.concatenate([speed[:1], speed[:-1]])

        def beyond(at: Any, reference: Any) -> FloatArray:
            expected = rates[:, reference] * lasts[at]
            same = rates[:, reference] * durations[reference]
            return np.asarray(
                steps[:, at] - np.clip(steps[:, at], np.minimum(expected, same), np.maximum(expected, same))
            )

        number = np.arange(turned.size)
        change = driven - turned
        leaps = beyond(number, number) if max(change.max(), -change.min()) > 0.5 * self._wide else np.zeros_like(steps)
        sudden = np.abs(leaps[1] - leaps[0]) > allowed
        if before is None:
            sudden[:2] = False  # the first has no step, the second no step before its own
        for at in np.flatnonzero(sudden).tolist():  # compare with the motion before the jump
            begun = at
            while begun > 0 and sudden[begun - 1] and at - begun < _SPIKE:
                begun -= 1
            if begun != at:
                leaps[:, at] = beyond(at, begun)
                sudden[at] = abs(leaps[1, at] - leaps[0, at]) > allowed[at]
        whose = (np.abs(leaps[1]) > np.abs(leaps[0])).astype(np.int64)
        for index, jumps in enumerate((given.turning_jumps, given.driven_jumps)):
            if jumps.any():
                sudden |= jumps
                whose[jumps] = index
        calm = np.flatnonzero(~sudden)
        last = int(calm[-1]) + 1 if calm.size else 0
        return sudden, whose, (float(rates[0, last]), float(rates[1, last]), float(durations[last]))

    def _leap(
        self, at: int, given: _Stretch, off: FloatArray, was: FloatArray, whose: int, marks: dict[str, Mask]
    ) -> Finding:
        """Mark a jump; with a line, the angle counts as off it from there on."""
        role, before, time = ANGLES[whose], float(was[at]), float(given.time[at])
        if at == 0 and self._last is not None and abs(off[at] - before) < abs(before - self._last.earlier):
            before, time = self._last.earlier, self._last.time  # a jump of the newest sample shows with the next one
        by = float(off[at]) - before
        if self._seen >= _SEEN and abs(by) > _SMALL * self._wide:
            half = min(0.5 * abs(by), 2.0 * self._wide)
            self._away = _Away(before - half, before + half, (role,), before)
        elif self._seen < _SEEN:
            self._begin(keep=False)
        marks[role][at] = True
        value = math.degrees(by * (-self._ratio if whose == 0 else 1.0))
        return Finding(time, (role,), f"{role} jumps by {value:.4g} deg")

    def _departure(
        self, at: int, given: _Stretch, off: FloatArray, runs: list[npt.NDArray[np.int64]], marks: dict[str, Mask]
    ) -> Finding | None:
        """Return the cause of a departure from the line; None if no line is established yet."""
        if self._seen < _SEEN:
            return None
        stuck = [index for index in (0, 1) if runs[index][at] >= _EQUAL]
        if len(stuck) == 1:
            index = stuck[0]
            role, other, run = ANGLES[index], ANGLES[1 - index], int(runs[index][at])
            begun = max(at - run, 0)
            moved = abs(float((given.driven, given.turning)[index][at] - (given.driven, given.turning)[index][begun]))
            value = float((given.turning, given.driven)[index][at])
            before = float(off[at - run]) if at >= run else self._stood[index][1]
            self._away = _Away(before - self._wide, before + self._wide, (role,), before, value)
            marks[role][max(0, at - run + 1) : at + 1] = True
            since = given.time[at - run + 1] if at >= run else np.nextafter(self._stood[index][0], np.inf)
            text = f"{role} is constant at {math.degrees(value):.6g} deg for {run + 1} samples while {other} moves"
            if at >= run:
                text += f" by {math.degrees(moved):.3g} deg"
            return Finding(float(since), (role,), text)
        if not self._held:
            return None
        low, high = self._span
        middle = 0.5 * (self._low + self._high)
        if high - low > 2.0 * self._wide:  # the line has drifted: use its present place
            low = high = middle
        by = math.degrees(float(off[at]) - middle)
        self._away = _Away(min(low, high - self._wide), max(high, low + self._wide), ANGLES, middle)
        text = f"the angles deviate from the line of the ratio {self._ratio:g} by {by:.3g} deg of the output"
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
        """Add these samples to the line."""
        if not line.size:
            return
        self._low, self._high, self._travel = float(low[-1]), float(high[-1]), float(travel[-1])
        self._span = min(self._span[0], float(off.min())), max(self._span[1], float(off.max()))
        self._seen += line.size
        if self._held:
            return
        ends = [
            (np.minimum.accumulate(np.minimum(v, lo)), np.maximum.accumulate(np.maximum(v, hi)))
            for v, (lo, hi) in zip((line, off), self._ranges, strict=True)
        ]
        slack = self._stamps * np.maximum.accumulate(speed)
        far = np.flatnonzero(ends[0][1] - ends[0][0] >= _ESTABLISHED * (self._wide + 2.0 * slack))
        self._ranges = [(float(lo[-1]), float(hi[-1])) for lo, hi in ends]
        if far.size:
            first = int(far[0])
            self._held = bool(ends[1][1][first] - ends[1][0][first] <= self._wide + 2.0 * slack[first])
            self._ranges = [(math.inf, -math.inf)] * 2

    def _begin(self, *, keep: bool) -> None:
        """Begin a new line; `keep`: it counts as established if the previous one was."""
        self._low, self._high, self._travel, self._span = math.inf, -math.inf, 0.0, (math.inf, -math.inf)
        if not keep:
            self._seen, self._held, self._ranges = 0, False, [(math.inf, -math.inf)] * 2
