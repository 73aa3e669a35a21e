"""The frames of one identifier: invalid ones are left out, doubtful ones marked."""

from __future__ import annotations

import collections
import contextlib
import dataclasses
import functools
import math
import operator
import time

import numpy as np
import numpy.typing as npt

from drivers.can.bus import frame_name
from drivers.can.hub import BEHIND_GAP, NO_SYNC, CanHub, Frames, joined_frames
from drivers.counts import Pace, carried, counted, judge_sequence, missing_by_pace
from drivers.encoder import EncoderConnectionError
from drivers.hubs import drained
from drivers.recording_format import DUPLICATE, GAP, OUT_OF_ORDER, ClockJumps, Event, FloatArray, IntArray


def payload_array(data: list[bytearray], length: int) -> npt.NDArray[np.uint8]:
    """Return frames of one length as an array of shape (n, length)."""
    return np.frombuffer(b"".join(data), np.uint8).reshape(-1, length)


@dataclasses.dataclass(frozen=True)
class Judged:
    """Valid frames: payloads, shape (n, length); host and device times, s, and status bits, shape (n,).

    `jumped`: mask of the frames at which the clock of the stamps jumped, shape (n,).
    """

    payloads: npt.NDArray[np.uint8]
    time_host: FloatArray
    time_device: FloatArray | None
    status: IntArray
    jumped: npt.NDArray[np.bool_]

    def at(self, which: npt.NDArray[np.bool_]) -> Judged:
        """Return the frames of a mask, shape (n,)."""
        device = None if self.time_device is None else self.time_device[which]
        return Judged(self.payloads[which], self.time_host[which], device, self.status[which], self.jumped[which])


class FrameReader:
    """Reads the frames of one identifier as payloads, stamps and status: common to CANopen and DBC channels.

    Parameters
    ----------
    hub
        The bus.
    identifier
        The `frame_key` of its frames: of classical 11-bit frames the identifier itself.
    length
        Payload length, bytes; frames of other lengths are skipped with an event.
    sync_step
        The frame answers every `sync_step`-th SYNC and gets the SYNC's time stamp; None: it has its own stamp.
    channel
        The channel's name, for events.
    period
        Interval of frames sent by a timer, s, None if unknown; a longer silence is a gap.
    cyclic
        Whether frames are sent at one interval; a silence longer than usual is then a gap even if the bus dropped none.

    Attributes
    ----------
    lost
        Number of lost frames.
    """

    def __init__(
        self,
        hub: CanHub,
        identifier: int,
        length: int,
        sync_step: int | None,
        channel: str,
        period: float | None = None,
        *,
        cyclic: bool = False,
    ) -> None:
        self.hub, self.identifier, self.length, self.sync_step = hub, identifier, length, sync_step
        self.channel, self.period, self._by_pace = channel, period, cyclic or not hub.tells_drops
        self._blocks = hub.subscribe(identifier)
        self._events: collections.deque[Event] = collections.deque()
        self._last_seen = -1
        self._first: int | None = None  # SYNC of the first frame that had one
        self._newest: int | None = None
        self._last: tuple[float, bytearray, float] | None = None
        self._jumps = ClockJumps()
        self._pace, self._name = Pace(cyclic=cyclic), frame_name(identifier)
        self._gap = hub.gaps
        self._marks: collections.deque[int] = collections.deque()
        self.lost = 0

    def close(self) -> None:
        """Stop reading frames."""
        self.hub.unsubscribe(self.identifier, self._blocks)

    @property
    def waiting(self) -> int:
        """Number of frames received but not yet read."""
        return self._blocks.waiting

    def say(self, time_host: float, text: str, status: int = 0) -> None:
        """Add an event, and status bits for the next sample."""
        self._events.append(Event(time_host, self.channel, text))
        if status:
            self._marks.append(status)

    def events(self) -> list[Event]:
        """Return the events of channel and bus since the last call."""
        return self.hub.events() + drained(self._events)

    def finish(self) -> None:
        """Report the samples missing after the last one, at the end of reading."""
        self.hub.finish()
        if self.sync_step is not None and self._newest is not None:
            sync, unread = self.hub.handed_on, []
            with contextlib.suppress(EncoderConnectionError):  # reported when the bus failed
                # SYNCs answered after the end of the recording are not missing.
                unread = [int(block.sync[-1]) // self.sync_step for _, block in self._blocks.take(0.0)]
            missing = sync // self.sync_step - max([self._newest, *unread]) - 1  # the newest may still be answered
            if missing > 0:
                self.lost += missing
                self.say(time.time(), f"{missing} SYNC without a sample after the last one")
        elif self.hub.gaps > self._gap:
            self.say(time.time(), f"{self._name} may be lost after the last one")

    def read(self, timeout: float) -> Judged | None:
        """Return the received frames, waiting up to `timeout` s; None if there is none.

        Raises
        ------
        EncoderConnectionError
            If the bus failed, once all earlier frames are read.
        """
        losses: list[tuple[int, int]] = []
        blocks: list[Frames] = []
        index = 0
        for lost, block in self._blocks.take(timeout):
            if lost:
                losses.append((index, lost))
            blocks.append(block)
            index += len(block.data)
        return self._judged(joined_frames(blocks), losses) if blocks else None

    def _judged(self, frames: Frames, losses: list[tuple[int, int]]) -> Judged | None:
        """Leave out invalid frames and mark the next valid ones."""
        n = len(frames.data)
        stamps = frames.time if self.sync_step is None else frames.sync_time
        before = np.zeros(n, np.int64)  # status bits for the frame at each place, or else the next one kept
        unread = np.zeros(n, np.int64)
        for index, lost in losses:
            unread[index] = lost
            self.say(frames.time[index], f"{lost} × {self._name} lost: the recorder was too slow")
        behind = (np.diff(frames.gap, prepend=self._gap) > 0) | (unread > 0)
        self._gap = int(frames.gap[-1])
        before[behind] |= GAP
        good = np.fromiter(map(len, frames.data), np.int64, n) == self.length
        if not good.all():
            wrong = frames.data[int(np.flatnonzero(~good)[0])]
            self._say_count(~good, frames, f"skipped: {len(wrong)} bytes long (0x{wrong.hex()}), not {self.length}")
            before[~good] |= GAP
        jumped = np.zeros(n, np.bool_)
        if self.sync_step is None:
            self.lost += int(np.count_nonzero(~good))
            jumped = self._clocked(frames, before, behind, unread)
        else:
            good &= self._synced(frames, before)
        valid = np.flatnonzero(good)
        pending = functools.reduce(operator.or_, drained(self._marks), 0)
        status, pending = carried(valid, before, pending)
        if pending:
            self._marks.append(pending)
        if len(valid) == 0:
            return None
        if self.sync_step is not None:
            numbers = frames.sync[valid] // self.sync_step
            judged, missing, self._newest = judge_sequence(numbers, 1 << 62, self._newest)
            status |= judged
            if missing.any():
                self.lost += int(missing.sum())
                gaps = np.flatnonzero(missing)
                self.say(
                    stamps[valid[gaps[0]]],
                    f"{int(missing.sum())} SYNC without a sample, in {counted(len(gaps), 'gap')} from here on",
                )
        own = frames.device if self.sync_step is None else frames.sync_device
        device = None if own is None else own[valid]
        data = frames.data if len(valid) == n else [frames.data[i] for i in valid]
        return Judged(payload_array(data, self.length), stamps[valid], device, status, jumped[valid])

    def _synced(self, frames: Frames, before: IntArray) -> npt.NDArray[np.bool_]:
        """Return the mask of frames with their own SYNC, and set the bits of the others in `before`."""
        sync = frames.sync
        previous = np.concatenate([[self._last_seen], sync[:-1]])
        self._last_seen = int(sync[-1])
        self._say_count(sync == NO_SYNC, frames, "skipped: before the first SYNC")
        self._say_count(sync == BEHIND_GAP, frames, "skipped: after a gap in which its SYNC may be lost")
        before[sync == BEHIND_GAP] |= GAP
        second = (sync >= 0) & (sync == previous)
        last = None if self._last is None else self._last[1]
        same = np.zeros(len(sync), bool)
        for i in np.flatnonzero(second):  # few: payloads are compared only where it matters
            same[i] = frames.data[i] == (frames.data[i - 1] if i else last)
        self._last = (0.0, frames.data[-1], 0.0)
        self._say_count(second & same, frames, "skipped: a duplicate of the previous frame, or without its own SYNC")
        self._say_count(second & ~same, frames, "skipped: without its own SYNC, so its time is unknown")
        before[second] |= np.where(same, DUPLICATE, GAP)[second]
        if self._first is None and len(answered := sync[sync >= 0]):
            self._first = int(answered[0])
        # A frame that answers an earlier SYNC counts as lost with that SYNC, except before the first sample.
        self.lost += int(np.count_nonzero(second & ~same & (sync == self._first)))
        return np.asarray((sync >= 0) & ~second)

    def _clocked(
        self, frames: Frames, before: IntArray, behind: npt.NDArray[np.bool_], unread: npt.NDArray[np.int64]
    ) -> npt.NDArray[np.bool_]:
        """Set the bits in `before` that follow from the stamps; return the mask of jumps of their clock.

        `behind`: mask of frames after a known gap; `unread`: number of frames lost there to a slow recorder.
        """
        times = frames.time if frames.device is None else frames.device
        first = self._last is None
        last_time, last_data, arrived = self._last or (times[0], bytearray(), frames.arrived[0])
        step = np.diff(times, prepend=last_time)
        copies = np.zeros(len(times), bool)
        for i in np.flatnonzero(step == 0):
            copies[i] = frames.data[i] == (frames.data[i - 1] if i else last_data)
        copies[0] &= not first
        jumps = self._jumps(times, frames.arrived)
        waited = np.diff(frames.arrived, prepend=arrived)
        for i in np.flatnonzero(jumps):
            self.say(frames.time[i], f"the clock of {self._name} jumped by {step[i] - waited[i]:+.3f} s")
        before[jumps] |= GAP
        early = (step < 0) & ~jumps
        before[early] |= OUT_OF_ORDER
        self._say_count(early, frames, "older than the previous one")
        self._say_count(copies, frames, "a duplicate of the previous frame")
        before[copies] |= DUPLICATE
        missing = self._missing(times, step, jumps, behind)
        if missing.any():
            by = "by the event timer" if self.period is not None else "by their usual interval"
            gaps = np.flatnonzero(missing)
            self.say(
                frames.time[gaps[0]],
                f"{int(missing.sum())} × {self._name} missing {by}, in {counted(len(gaps), 'gap')} from here on",
            )
            before[gaps] |= GAP
        self.lost += int(np.maximum(missing, unread).sum())
        plain = (step > 0) & ~jumps & ~behind & (missing == 0)
        plain[0] &= not first
        self._pace.add(*step[plain].tolist())
        self._last = (float(times[-1]), frames.data[-1], float(frames.arrived[-1]))
        return jumps

    def _missing(
        self, times: FloatArray, step: FloatArray, jumps: npt.NDArray[np.bool_], behind: npt.NDArray[np.bool_]
    ) -> IntArray:
        """Return how many frames are missing before each one, from their timer or usual interval, shape (n,)."""
        period = self.period or self._pace.period
        if period is None:
            return np.zeros(len(step), np.int64)
        longest = self._pace.longest if self._by_pace else math.inf
        gaps = behind | (step > (1.5 * self.period if self.period is not None else longest))
        return missing_by_pace(times, step, gaps & ~jumps, period)[0]

    def _say_count(self, which: npt.NDArray[np.bool_], frames: Frames, what: str) -> None:
        if which.any():
            first = int(np.flatnonzero(which)[0])
            self.say(frames.time[first], f"{int(which.sum())} × {self._name} {what}")
