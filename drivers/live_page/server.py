"""A live page in the browser: transmission error, its spectrum and the bench's health, from a growing recording.

It reads the recorder's file in a separate process, so it can't cause the recorder to lose samples.
"""

from __future__ import annotations

import collections
import dataclasses
import math
import os
import secrets
import threading
import time
from typing import Any

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.edge.page_server import PageHandler, PageServer, is_loopback
from drivers.recording_format import (
    ANGLES,
    IMPLAUSIBLE,
    MARKS,
    Event,
    FloatArray,
    Plausibility,
    RecordingReader,
    Samples,
    joined,
    limits_of,
)

REFRESH_SECONDS = 0.2
WINDOW = 1 << 17  # newest samples of each channel that are evaluated
_POINTS = 1000  # points drawn
_TURNS = 16  # most crank turns of the spectrum
_ORDERS = 100
_PATIENCE = 1 << 16  # samples of one angle that wait for the other to be judged with it
_STREAM_SECONDS = 600.0  # length of a stream of data; a browser then reconnects by itself


def order_spectrum(input_angle: FloatArray, error: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return orders of the crank and amplitudes of the TE over the last whole crank turns.

    Parameters
    ----------
    input_angle
        Crank angle, rad, increasing or decreasing, shape (n,).
    error
        TE, any unit, shape (n,).

    Returns
    -------
    orders, amplitudes
        Orders, cycles per crank turn, and the amplitude of each, unit of `error`; empty below one full turn.
    """
    rising = input_angle if input_angle[-1] >= input_angle[0] else -input_angle
    ordered = np.maximum.accumulate(rising)
    keep = np.concatenate([[True], np.diff(ordered) > 0])
    angle, error = rising[keep], error[keep]
    turns = min(int((angle[-1] - angle[0]) / (2 * math.pi) + 1e-6), _TURNS)
    if turns < 1 or len(angle) < 16:
        return np.zeros(0), np.zeros(0)
    start = angle[-1] - 2 * math.pi * turns
    count = int(np.count_nonzero(angle >= start))
    grid = start + 2 * math.pi * turns * np.arange(count) / count
    amplitudes = 2 * np.abs(np.fft.rfft(np.interp(grid, angle, error))) / count
    orders = np.arange(len(amplitudes)) / turns
    shown = (orders > 0) & (orders <= _ORDERS)
    return orders[shown], amplitudes[shown]


class Watcher:
    """Data of the page, from a recording that may still be growing.

    Raises
    ------
    edge.InputError
        If the file is not a recording.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.reader = RecordingReader(path)
        self._held: dict[str, Samples | None] = {c.name: None for c in self.reader.header.channels}
        self._counts = dict.fromkeys(self._held, 0)
        self._marks = {name: dict.fromkeys(MARKS, 0) for name in self._held}
        self._events: collections.deque[dict[str, Any]] = collections.deque(maxlen=20)
        header = self.reader.header
        self._roles = {c.name: c.role for c in header.channels if c.role in ANGLES and c.unit == "rad"}
        self._judge = Plausibility(header.ratio, limits_of(header))
        self._unjudged: dict[str, list[Samples]] = {name: [] for name in self._roles}
        self._rates: collections.deque[tuple[float, dict[str, int]]] = collections.deque(maxlen=10)

    def refresh(self) -> dict[str, Any]:
        """Read new data and return the page's data in field units (arcsec, turns)."""
        fresh: dict[str, list[Samples]] = {name: [] for name in self._held}
        for samples, events in self.reader.batches(growing=True):
            self._events += [dataclasses.asdict(e) for e in events if not e.text.startswith("clock: ")]
            if len(samples):
                fresh[samples.channel].append(samples)
                for mark, bit in MARKS.items():
                    if bit != IMPLAUSIBLE or samples.channel not in self._roles:
                        self._marks[samples.channel][mark] += int(np.count_nonzero(samples.status & bit))
                if samples.channel in self._roles:
                    self._unjudged[samples.channel].append(samples)
                    if all(self._unjudged.values()) or sum(map(len, self._unjudged[samples.channel])) > _PATIENCE:
                        self._find_implausible()
        self._find_implausible()
        for name, blocks in fresh.items():
            if blocks:
                before = self._held[name]
                self._held[name] = _tail(([before] if before is not None else []) + blocks)
                self._counts[name] += sum(map(len, blocks))
        self._rates.append((time.monotonic(), dict(self._counts)))
        (then, counted), (now, _) = self._rates[0], self._rates[-1]
        rate = {n: (c - counted[n]) / max(now - then, 1e-3) for n, c in self._counts.items()}
        channels = [
            {
                "name": c.name,
                "unit": c.unit,
                "samples": self._counts[c.name],
                "rate": rate[c.name],
                "value": math.nan if (held := self._held[c.name]) is None else float(held.value[-1]),
                "marks": {m: n for m, n in self._marks[c.name].items() if n},
            }
            for c in self.reader.header.channels
        ]
        header = self.reader.header
        return {
            "source": self.reader.source,
            "pair": header.pair,
            "ratio": header.ratio,
            "start": header.start,
            "channels": channels,
            "events": list(self._events),
            **self._errors(),
        }

    def _find_implausible(self) -> None:
        """Judge the waiting samples as the evaluation does; early recordings have marks of their own."""
        blocks = {self._roles[name]: joined(name, waiting) for name, waiting in self._unjudged.items() if waiting}
        if not blocks:
            return
        marks, findings = self._judge.add(blocks)
        names = {role: name for name, role in self._roles.items()}
        for role, samples in blocks.items():
            marked = marks[role] | (samples.status & IMPLAUSIBLE != 0)
            self._marks[names[role]]["implausible"] += int(np.count_nonzero(marked))
        events = [Event(f.time, names[f.roles[0]], f"implausible: {f.text}") for f in findings]
        self._events += [dataclasses.asdict(event) for event in events]
        self._unjudged = {name: [] for name in self._roles}

    def _errors(self) -> dict[str, Any]:
        """Return the TE over the crank angle and its spectrum."""
        roles = {c.role: self._held[c.name] for c in self.reader.header.channels}
        turning, driven, ratio = roles.get("input_angle"), roles.get("output_angle"), self.reader.header.ratio
        if turning is None or driven is None or not ratio:
            return {"te": None, "spectrum": None}
        common, i, j = np.intersect1d(turning.time_host, driven.time_host, return_indices=True)
        if 2 * len(common) >= min(len(turning), len(driven)):
            angle, output = turning.value[i], driven.value[j]
        else:
            inside = (driven.time_host >= turning.time_host[0]) & (driven.time_host <= turning.time_host[-1])
            angle = np.interp(driven.time_host[inside], turning.time_host, turning.value)
            output = driven.value[inside]
        finite = np.isfinite(angle) & np.isfinite(output)
        angle, output = angle[finite], output[finite]
        if len(angle) < 2:
            return {"te": None, "spectrum": None}
        error = (output - angle / ratio) * edge.ARCSEC
        error = error - error.mean()
        orders, amplitudes = order_spectrum(angle, error)
        step = max(1, len(angle) // _POINTS)
        return {
            "te": {"turns": (angle[::step] / (2 * math.pi)).tolist(), "arcsec": error[::step].tolist()},
            "spectrum": {"orders": orders.tolist(), "arcsec": amplitudes.tolist()},
        }


def _tail(blocks: list[Samples]) -> Samples:
    """Return times and values of the last `WINDOW` samples in blocks of one channel."""
    time_host = np.concatenate([b.time_host for b in blocks])[-WINDOW:]
    value = np.concatenate([b.value for b in blocks])[-WINDOW:]
    return Samples.checked(blocks[0].channel, time_host, value)


class _Newest:
    """The newest data, for any number of clients; slow ones skip data."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._number, self._text = 0, "{}"

    def put(self, text: str) -> None:
        """Replace the data."""
        with self._changed:
            self._number, self._text = self._number + 1, text
            self._changed.notify_all()

    def after(self, number: int, timeout: float) -> tuple[int, str]:
        """Return number and text of data newer than this number, waiting up to `timeout` s."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > number, timeout)
            return self._number, self._text


class WatchServer(PageServer):
    """Serves the page and its data over HTTP from its creation; a context manager that ends it.

    Port 0: any free port. A client must send the `token`; None: only clients that use a local host name are answered.
    """

    def __init__(self, watcher: Watcher, host: str, port: int, token: str | None) -> None:
        self.newest, self._watcher = _Newest(), watcher
        super().__init__(_Handler, host, port, token)
        threading.Thread(target=self._read, name="watch", daemon=True).start()

    def _read(self) -> None:
        while not self._stopping.is_set():
            try:
                data = self._watcher.refresh()
            except Exception as problem:  # the page must show why it stops updating
                data = {"problem": f"{type(problem).__name__}: {problem}"}
            self.newest.put(edge.json_text(data).replace("\n", ""))
            self._stopping.wait(REFRESH_SECONDS)


def watch(recording: str | os.PathLike[str], *, host: str = "127.0.0.1", port: int = 0) -> WatchServer:
    """Serve a page that shows a growing recording: transmission error, spectrum, state of the channels.

    Parameters
    ----------
    recording
        The `.arrows` file, finished or growing.
    host
        Address to listen on; a non-local one requires a token, which is in the `url`.
    port
        Port to listen on; 0: any free port.

    Returns
    -------
    WatchServer
        The running server; a context manager that ends it.

    Raises
    ------
    edge.InputError
        If the file is not a recording or the address can't be listened on.

    Examples
    --------
    >>> import drivers
    >>> with drivers.simulate_bench(ratio=-39, torque=20.0, turns=1, bus="virtual") as bench:
    ...     done = bench.record("seen.arrows")
    >>> with drivers.watch("seen.arrows") as server:
    ...     server.url.startswith("http://127.0.0.1:")
    True
    """
    try:
        local = is_loopback(host)
    except ValueError:
        raise edge.ArgumentError("host", "write an address, such as 127.0.0.1 or 0.0.0.0", host) from None
    try:
        return WatchServer(Watcher(recording), host, port, None if local else secrets.token_urlsafe(16))
    except OSError as problem:
        raise edge.ArgumentError("port", f"{host} can't be listened on: {problem.strerror}", port) from None


class _Handler(PageHandler):
    server: WatchServer
    package = "drivers.live_page"
    name = "cycloid-bench"

    def answer(self, path: str) -> bool:
        """Send the page's data as a stream of events."""
        if path != "/data":
            return False
        self.send_response(200)
        self.send_header("Content-Type", "text/event-stream")
        self.end_headers()
        self.server.keep(self.connection, _STREAM_SECONDS)
        number = 0
        try:
            while True:
                number, text = self.server.newest.after(number, 5.0)
                self.wfile.write(f"data: {text}\n\n".encode())
        except OSError:  # the client disconnected, or read nothing for `timeout`
            self.close_connection = True
        return True
