"""Plausibility of the two angles of a drive: stuck encoders, jumps, deviations from the line of the ratio.

Effects of the drive must pass: with transmission error, backlash, lost motion, windup, load steps and reversals the
output angle stays close to the line input angle / ratio. With a failed encoder it does not. A wrong ratio, swapped
angles or a wrong unit are not faults of single samples and are not marked here: no section of such a recording follows
the line.
"""

from __future__ import annotations

import collections
import dataclasses
import itertools
import math
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from drivers.recording_format.limits import Finding, Limits, Mask
from drivers.recording_format.ratio_line import Line
from drivers.recording_format.schema import ANGLES, DUPLICATE, GAP, OUT_OF_ORDER, RESET, FloatArray, Samples

_JUMP = 0.5 * math.pi  # rad: deviation from the motion before and after, if no largest speed is stated
_SPIKE = 3  # samples within which a jump back ends a spike
_LATE = 1.5  # usual time steps, the least assumed: samples that arrive together after a delay show no speed
_WAITING = 1 << 16  # most samples of one angle that wait for the other
_REMEMBERED = 64  # faults, by time and role, that are not reported again
STAMP_SECONDS = 0.1  # s: lateness, on a busy host, of the stamps of angles that share no times


@dataclasses.dataclass
class _Judged:
    """Samples of one angle after `Steps`, arrays of equal length; `jumps` masks the samples marked there."""

    time: FloatArray
    value: FloatArray
    broken: Mask
    jumps: Mask

    @staticmethod
    def joined(parts: list[_Judged]) -> _Judged:
        if len(parts) == 1:
            return parts[0]
        return _Judged(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(_Judged)))

    def after(self, index: int) -> _Judged:
        return _Judged(*(getattr(self, f.name)[index:] for f in dataclasses.fields(self)))


class Steps:
    """Judges one angle by its steps from sample to sample, block by block.

    Parameters
    ----------
    role
        Role of the angle, for the findings.
    largest_speed, resolution
        Largest speed, rad/s, or None, and angle of one count, rad; see `Limits`.
    """

    def __init__(self, role: str, largest_speed: float | None, resolution: float) -> None:
        self.role, self._speed, self._resolution = role, largest_speed, resolution
        self._time, self._value, self._broken = np.zeros(0), np.zeros(0), np.zeros(0, np.bool_)
        self._usual: collections.deque[float] = collections.deque(maxlen=64)
        self._jumped: tuple[int, float] | None = None
        self._judged = False  # whether the last step, which had none after it, is judged
        self._reported = False

    def add(self, time: FloatArray, value: FloatArray, broken: Mask) -> tuple[Mask, list[Finding]]:
        """Return the mask of those of the next samples that follow a jump or form a spike, shape (n,), and findings.

        Parameters
        ----------
        time, value
            Times, s, and angles, rad, shape (n,).
        broken
            Mask of the samples whose step from the previous one is not judged: after a gap or reset, shape (n,).
        """
        held = self._time.size
        t = np.concatenate([self._time, time])
        v = np.concatenate([self._value, value])
        cut = np.concatenate([self._broken, broken])
        marks = np.zeros(v.size, np.bool_)
        findings: list[Finding] = []
        if v.size > 1:
            wide, off = self._off(t, v, cut)
            first = held - 1 if held and not self._judged else held
            places = np.flatnonzero(wide)
            places = places[places >= first]
            for index in places.tolist():
                self._mark(marks, index - held, float(off[index]), held)
            if places.size and not self._reported:
                index = int(places[0])
                more = f", and {places.size - 1} more jumps" if places.size > 1 else ""
                text = f"{self.role} jumps by {math.degrees(v[index] - v[index - 1]):.4g} deg{more}"
                findings.append(Finding(float(t[index]), (self.role,), text))
            self._reported = bool(places.size)
            self._judged = bool(wide[-1] or cut[-1]) or abs(v[-1] - v[-2]) <= 0.5 * _JUMP
        self._time, self._value, self._broken = t[-3:], v[-3:], cut[-3:]
        if self._jumped is not None:
            self._jumped = self._jumped[0] - time.size, self._jumped[1]
        return marks[held:], findings

    def _off(self, t: FloatArray, v: FloatArray, cut: Mask) -> tuple[Mask, FloatArray]:
        """Return the mask of samples whose step deviates from the motion or exceeds the speed, and by how much, rad."""
        step, lasts = np.diff(v, prepend=v[0]), np.diff(t, prepend=t[0])
        judged = ~cut
        judged[0] = False
        if self._speed is None and max(step.max(), -step.min()) <= 0.5 * _JUMP:  # no two steps are a jump apart
            return np.zeros(v.size, np.bool_), step
        self._usual.extend(lasts[judged & (lasts > 0.0)][-64:].tolist())
        usual = float(np.median(self._usual)) if self._usual else 0.0
        away = np.full((2, v.size), np.inf)
        known = np.zeros((2, v.size), np.bool_)
        for row, there in enumerate((slice(None, -1), slice(1, None))):
            here = slice(1, None) if row == 0 else slice(None, -1)
            with np.errstate(invalid="ignore", divide="ignore"):
                scaled = np.where(lasts[there] > 0.0, step[there] / lasts[there] * lasts[here], step[there])
            low, high = np.minimum(step[there], scaled), np.maximum(step[there], scaled)
            # With a neighbour on one side only, the drive may have reversed there.
            turns = ~judged[slice(2, None) if row == 0 else slice(None, -2)]
            turns = np.append(turns, True) if row == 0 else np.append(True, turns)
            largest = np.maximum(np.abs(low), np.abs(high))
            away[row, here] = step[here] - np.clip(
                step[here], np.where(turns, -largest, low), np.where(turns, largest, high)
            )
            known[row, here] = judged[there]
        nearest = np.where(np.abs(away[0]) <= np.abs(away[1]), away[0], away[1])
        off = np.where(known[0], np.where(known[1], nearest, away[0]), np.where(known[1], away[1], 0.0))
        # A step without one after it is not judged yet: a drive may start within one step.
        decided = known[1] | (np.append(cut[1:], False) & known[0])
        wide = judged & decided & (np.abs(off) > _JUMP)
        if self._speed is not None:
            allowed = self._speed * np.maximum(lasts, _LATE * usual) + 2.0 * self._resolution
            fast = judged & (np.abs(step) > allowed)
            off = np.where(fast & ~wide, np.sign(step) * (np.abs(step) - allowed), off)
            wide = fast | (wide & (np.abs(step) > allowed))
        return wide, off

    def _mark(self, marks: Mask, index: int, off: float, held: int) -> None:
        """Mark the sample after a jump; a jump back ends a spike, whose samples are marked instead."""
        if self._jumped is not None:
            begun, by = self._jumped
            if index - begun <= _SPIKE and off * by < 0.0 and abs(off + by) <= max(_JUMP, 0.5 * abs(by)):
                marks[max(0, begun + held) : index + held] = True
                marks[index + held] = False
                self._jumped = None
                return
        marks[max(index, 0) + held] = True
        self._jumped = index, off


class Plausibility:
    """Judges the two angles of a drive, block by block: by their steps and, given a ratio, by the line of the ratio.

    Parameters
    ----------
    ratio
        Signed ratio input/output of the drive between the encoders, or None.
    limits
        Limits of the encoders; None: the default limits.

    Examples
    --------
    An input encoder that is stuck from the thousandth sample on:

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
        self._known: collections.deque[tuple[float, str]] = collections.deque(maxlen=_REMEMBERED)

    def add(self, blocks: Mapping[str, Samples]) -> tuple[dict[str, Mask], list[Finding]]:
        """Return the mask of implausible samples among the next ones, and the findings.

        Parameters
        ----------
        blocks
            Samples of the roles "input_angle" and "output_angle", or one of them. Duplicates and samples out of order
            are not judged. Angles without common times are compared by interpolation.

        Returns
        -------
        implausible, findings
            Masks of shape (n,) by role, and one finding for each new fault; it may have begun before the block.
        """
        marks: dict[str, Mask] = {}
        findings: list[Finding] = []
        in_order: dict[str, Mask] = {}
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
            in_order[role] = onward
            broken = np.asarray(samples.status & (GAP | RESET) != 0)
            part = slice(None) if whole else onward
            jumps, new_findings = self._steps[role].add(time[part], samples.value[part], broken[part])
            mine[part] = jumps
            findings += new_findings
            self._waiting[role].append(
                _Judged(time if whole else time[onward], samples.value[part], broken[part], jumps)
            )
        if self._ratio is None:
            return marks, self._news(findings)
        paired = self._paired() if all(self._waiting.values()) else None
        if paired is None:
            if self._line is not None:
                for role, mine in in_order.items():
                    marks[role] |= mine & self._line.still_away(role, blocks[role].value)
            return marks, self._news(findings)
        time, angles, broken, jumped = paired
        if self._line is None:
            self._line = Line(self._ratio, self._limits, 0.0 if self._shared else STAMP_SECONDS)
        by_role, returned, new_findings = self._line.add(time, angles, broken, jumped)
        for role, mine in marks.items():
            if not len(mine):
                continue
            own = blocks[role].time_host
            index: slice | npt.NDArray[np.int64] = slice(None)
            inside = in_order[role]
            if own is not time:  # most files have one time for both angles: 1.6 times as fast without a search
                index = np.searchsorted(time, own)
                inside = (index < time.size) & in_order[role]
                index = np.minimum(index, time.size - 1)
            mine[inside & returned[index]] = False
            mine |= inside & by_role[role][index]
            mine |= ~inside & in_order[role] & self._line.still_away(role, blocks[role].value)
        self._known += itertools.product(time[returned].tolist(), ANGLES)
        return marks, self._news(findings + new_findings)

    def _news(self, findings: list[Finding]) -> list[Finding]:
        """Return the findings not known yet: a jump shows in the angle itself and as one off the line of the ratio."""
        news = []
        for finding in findings:
            faults = [(finding.time, role) for role in finding.roles]
            if not any(fault in self._known for fault in faults):
                news.append(finding)
            self._known += faults
        return news

    def _paired(self) -> tuple[FloatArray, dict[str, FloatArray], Mask, dict[str, Mask]] | None:
        """Return times at which both angles are known, the angles, gaps and jumps; later samples wait."""
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
        for role, angle_samples in (("input_angle", turning), ("output_angle", driven)):
            upto = np.concatenate([[0], passed[role]])
            counted = np.concatenate([[0], np.cumsum(angle_samples.broken)])
            broken |= np.diff(counted[np.minimum(upto, angle_samples.time.size)]) > 0
            leaps = np.concatenate([[0], np.cumsum(angle_samples.jumps)])
            jumps[role] = np.diff(leaps[np.minimum(upto, angle_samples.time.size)]) > 0
            keep = max(
                int(passed[role][-1]) - (role == "input_angle" and not self._shared), angle_samples.time.size - _WAITING
            )
            self._waiting[role] = [angle_samples.after(keep)] if keep < angle_samples.time.size else []
        return time, angles, broken, jumps
