"""Device clocks in a recording: their lines against the host's clock, and samples aligned with it."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable, Mapping

import numpy as np
import numpy.typing as npt

from drivers.recording_format.schema import RESET, Event, FloatArray, Samples

CLOCK_JUMP = 1.0  # s: difference of the steps of stamps and arrivals that no bus or scheduler explains
_CLOCK = "clock: "


@dataclasses.dataclass(frozen=True)
class Clock:
    """A device's clock against the host's: host = origin_host + (1 + drift) (device - origin_device).

    Attributes
    ----------
    origin_device, origin_host
        Device and host time of a point on the line, in the middle of the samples, s.
    drift
        Rate of the host's clock relative to the device's, minus one.
    uncertainty
        Half width of the 95 % band around the line at the ends of the samples, s.
    """

    origin_device: float
    origin_host: float
    drift: float
    uncertainty: float

    def host(self, device: npt.ArrayLike) -> FloatArray:
        """Return the host times of device times, s: earliest arrivals, which include the constant part of the delay."""
        away = np.asarray(device, np.float64) - self.origin_device
        return np.asarray(self.origin_host + away + self.drift * away, np.float64)


def clock_event(time: float, channel: str, clock: Clock, restarts: int) -> Event:
    """Return the event that stores the estimate of a channel's clock after this number of restarts; see `read_clocks`.

    `time` is in s since the start of the recording.
    """
    return Event(time, channel, _CLOCK + json.dumps({**dataclasses.asdict(clock), "restarts": restarts}))


def clocks_of(events: Iterable[Event]) -> dict[str, dict[int, Clock]]:
    """Return the last estimate of each channel's clock after each of its restarts."""
    clocks: dict[str, dict[int, Clock]] = {}
    for event in events:
        if event.text.startswith(_CLOCK):
            values = json.loads(event.text.removeprefix(_CLOCK))
            restarts = values.pop("restarts", 0)
            clocks.setdefault(event.channel, {})[restarts] = Clock(**values)
    return clocks


class ClockJumps:
    """Detects, block by block, the readings at which a clock restarts or jumps by `CLOCK_JUMP` or more.

    A clock jumps where it goes back, or where a reading would have arrived before it was taken: its delay falls below
    the smallest one so far. Readings that arrive together after a delay are no jump, even with gaps among them.
    """

    def __init__(self) -> None:
        self._last: float | None = None
        self._least = np.inf

    def __call__(
        self, taken: FloatArray, arrived: FloatArray, reset: npt.NDArray[np.bool_] | None = None
    ) -> npt.NDArray[np.bool_]:
        """Return the mask of the readings at which the clock restarts or jumps, shape (n,).

        Parameters
        ----------
        taken, arrived
            Times of the readings on this clock, and of their arrivals on a steady clock, s, shape (n,), n > 0.
        reset
            Mask of known restarts, shape (n,).
        """
        back = np.diff(taken, prepend=taken[0] if self._last is None else self._last) < -CLOCK_JUMP
        if reset is not None:
            back |= reset
        delay, jumps = arrived - taken, back.copy()
        for part in np.split(np.arange(len(taken)), np.flatnonzero(back)):
            if len(part):
                before = np.inf if back[part[0]] else self._least
                least = np.minimum.accumulate(np.concatenate([[before], delay[part]]))
                jumps[part] |= np.isfinite(least[:-1]) & (delay[part] < least[:-1] - CLOCK_JUMP)
                self._least = float(least[-1])
        self._last = float(taken[-1])
        return jumps


class Alignment:
    """Converts one channel's device times to the host's clock, block by block in order.

    Parameters
    ----------
    clocks
        The device's clock by the number of its restarts, from `read_clocks`.
    """

    def __init__(self, clocks: Mapping[int, Clock]) -> None:
        self._clocks = clocks
        self._restarts = 0
        self._jumps = ClockJumps()

    def time(self, samples: Samples) -> FloatArray:
        """Return when the samples were taken, s since the start; `time_host` where the device's clock is unknown."""
        if samples.time_device is None or not len(samples):
            return samples.time_host
        marked = samples.status & RESET != 0
        number = self._restarts + np.cumsum(self._jumps(samples.time_device, samples.time_host, marked))
        self._restarts = int(number[-1])
        time = samples.time_host.copy()
        for restarts in np.unique(number).tolist():
            if (clock := self._clocks.get(restarts)) is not None:
                time[number == restarts] = clock.host(samples.time_device[number == restarts])
        return time
