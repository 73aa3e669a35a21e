"""A live page in the browser: transmission error, its spectrum and the bench's health, from the growing recording.

It reads the file that the recorder writes, in a process of its own: nothing it does can cost the recorder a sample.
"""

from __future__ import annotations

import base64
import collections
import contextlib
import dataclasses
import functools
import hashlib
import hmac
import http.server
import importlib.resources
import ipaddress
import math
import os
import re
import secrets
import socket
import threading
import time
import urllib.parse
from typing import Any

import numpy as np

from cycloid_fmu import edge
from drivers.recording_format import MARKS, FloatArray, RecordingReader, Samples

REFRESH_SECONDS = 0.2
WINDOW = 1 << 17  # samples of each channel that are looked at
_POINTS = 1000  # that are drawn
_TURNS = 16  # crank turns of the spectrum at most
_ORDERS = 100
_LOCAL = ("localhost", "127.0.0.1", "[::1]")
_CONNECTIONS = 16  # at a time: each is a thread
_REQUEST_SECONDS = 10.0  # for a whole request and its answer
_STREAM_SECONDS = 600.0  # of a stream of data; a browser asks for the next one by itself


def order_spectrum(input_angle: FloatArray, error: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return orders of the crank and the TE's amplitudes over the last whole crank turns.

    Parameters
    ----------
    input_angle
        Crank angle, rad, rising or falling, shape (n,).
    error
        TE, any unit, shape (n,).

    Returns
    -------
    orders, amplitudes
        Cycles a crank turn and the amplitude of each, unit of `error`; empty for less than one turn.
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
    """What the page shows, taken from a recording that may still be growing.

    Raises
    ------
    edge.InputError
        If it is none.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.reader = RecordingReader(path)
        self._held: dict[str, Samples | None] = {c.name: None for c in self.reader.header.channels}
        self._counts = dict.fromkeys(self._held, 0)
        self._marks = {name: dict.fromkeys(MARKS, 0) for name in self._held}
        self._events: collections.deque[dict[str, Any]] = collections.deque(maxlen=20)
        self._rates: collections.deque[tuple[float, dict[str, int]]] = collections.deque(maxlen=10)

    def refresh(self) -> dict[str, Any]:
        """Read what is new and return the page's data: SI turned into what people read (arcsec, turns)."""
        fresh: dict[str, list[Samples]] = {name: [] for name in self._held}
        for samples, events in self.reader.batches(growing=True):
            self._events += [dataclasses.asdict(e) for e in events if not e.text.startswith("clock: ")]
            if len(samples):
                fresh[samples.channel].append(samples)
                for mark, bit in MARKS.items():
                    self._marks[samples.channel][mark] += int(np.count_nonzero(samples.status & bit))
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
                "name": c.name, "unit": c.unit, "samples": self._counts[c.name], "rate": rate[c.name],
                "value": math.nan if (held := self._held[c.name]) is None else float(held.value[-1]),
                "marks": {m: n for m, n in self._marks[c.name].items() if n},
            }
            for c in self.reader.header.channels
        ]  # fmt: skip
        header = self.reader.header
        return {
            "source": self.reader.source, "pair": header.pair, "ratio": header.ratio, "start": header.start,
            "channels": channels, "events": list(self._events), **self._errors(),
        }  # fmt: skip

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
    """Return the last `WINDOW` samples of blocks of one channel; only what the page uses of them."""
    time_host = np.concatenate([b.time_host for b in blocks])[-WINDOW:]
    value = np.concatenate([b.value for b in blocks])[-WINDOW:]
    return Samples.checked(blocks[0].channel, time_host, value)


class _Newest:
    """The newest data, for any number of clients: one that is slow skips what it missed."""

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._number, self._text = 0, "{}"

    def put(self, text: str) -> None:
        """Replace the data."""
        with self._changed:
            self._number, self._text = self._number + 1, text
            self._changed.notify_all()

    def after(self, number: int, timeout: float) -> tuple[int, str]:
        """Return data newer than this number, waiting for it, and its number."""
        with self._changed:
            self._changed.wait_for(lambda: self._number > number, timeout)
            return self._number, self._text


class WatchServer(http.server.ThreadingHTTPServer):
    """The page and its data over HTTP; it serves from the beginning, and is a context manager that ends it.

    Port 0 takes a free one. A client must show the `token`; None: only clients that call this machine by a local name
    are answered. There are 16 connections at a time; one whose request is not answered after ten seconds is closed.
    """

    daemon_threads = True
    request_queue_size = 2 * _CONNECTIONS  # a client beyond them is refused at once

    def __init__(self, watcher: Watcher, host: str, port: int, token: str | None) -> None:
        self._ends: dict[socket.socket, float] = {}
        self._counting = threading.Lock()
        super().__init__((host, port), _Handler)
        self.token, self.newest = token, _Newest()
        self._watcher = watcher
        self._stopping = threading.Event()
        for work in (self._read, functools.partial(self.serve_forever, 0.05)):
            threading.Thread(target=work, name="watch", daemon=True).start()

    @property
    def url(self) -> str:
        """What to open in the browser."""
        host, port = self.server_address[:2]
        query = "" if self.token is None else f"?token={self.token}"
        return f"http://{host if isinstance(host, str) else host.decode()}:{port}/{query}"

    def _read(self) -> None:
        while not self._stopping.is_set():
            try:
                data = self._watcher.refresh()
            except Exception as problem:  # the page must say why it stands still
                data = {"problem": f"{type(problem).__name__}: {problem}"}
            self.newest.put(edge.json_text(data).replace("\n", ""))
            self._stopping.wait(REFRESH_SECONDS)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Answer in a thread of its own, or close the connection where there are too many."""
        with self._counting:
            welcome = len(self._ends) < _CONNECTIONS
            if welcome:
                self._ends[request] = time.monotonic() + _REQUEST_SECONDS
        if welcome:
            super().process_request(request, client_address)
        else:
            self.shutdown_request(request)

    def keep(self, request: socket.socket, seconds: float) -> None:
        """Let a connection last so long from now on."""
        with self._counting:
            self._ends[request] = time.monotonic() + seconds

    def service_actions(self) -> None:
        """End the connections whose time is over: what their threads wait for then fails."""
        with self._counting:
            for request, end in self._ends.items():
                if time.monotonic() > end:
                    with contextlib.suppress(OSError):
                        request.shutdown(socket.SHUT_RDWR)

    def shutdown_request(self, request: Any) -> None:
        """Close a connection, whose place is free then."""
        with self._counting:
            self._ends.pop(request, None)
        super().shutdown_request(request)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Say nothing of a client that went: the terminal belongs to the recording."""

    def wait(self) -> None:
        """Wait until the server is closed."""
        self._stopping.wait()

    def server_close(self) -> None:
        """Stop reading and listening."""
        self._stopping.set()
        self.shutdown()
        super().server_close()


def watch(recording: str | os.PathLike[str], *, host: str = "127.0.0.1", port: int = 0) -> WatchServer:
    """Serve a page that follows a recording while it grows: transmission error, spectrum, health.

    Parameters
    ----------
    recording
        The `.arrows` file, finished or growing.
    host
        Address to listen on; where it is not this machine's own, a token is asked for, which is in the `url`.
    port
        0: any that is free.

    Returns
    -------
    WatchServer
        It serves already; a context manager that ends it.

    Raises
    ------
    edge.InputError
        If the file is no recording or the address can't be listened on.

    Examples
    --------
    >>> import drivers
    >>> with drivers.simulate_bench(ratio=-39, torque=20.0, turns=1, interface="virtual") as bench:
    ...     done = bench.record("seen.arrows")
    >>> with drivers.watch("seen.arrows") as server:
    ...     server.url.startswith("http://127.0.0.1:")
    True
    """
    try:
        local = ipaddress.ip_address(host).is_loopback
    except ValueError:
        raise edge.ArgumentError("host", "write an address, such as 127.0.0.1 or 0.0.0.0", host) from None
    try:
        return WatchServer(Watcher(recording), host, port, None if local else secrets.token_urlsafe(16))
    except OSError as problem:
        raise edge.ArgumentError("port", f"{host} can't be listened on: {problem.strerror}", port) from None


@functools.cache
def _page() -> tuple[str, str]:
    """Return the page and the policy that lets its own script and style act, and nothing else."""
    page = importlib.resources.files("drivers.live_page").joinpath("page.html").read_text(encoding="utf-8")
    own = {}
    for tag in ("script", "style"):
        (text,) = re.findall(f"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        own[tag] = base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()
    allowed = [f"{tag}-src 'sha256-{digest}'" for tag, digest in own.items()]
    none = [f"{what} 'none'" for what in ("default-src", "frame-ancestors", "base-uri", "form-action")]
    return page, "; ".join([*none, *allowed, "connect-src 'self'"])


class _Handler(http.server.BaseHTTPRequestHandler):
    server: WatchServer
    timeout = _REQUEST_SECONDS  # of a client that takes nothing

    def do_GET(self) -> None:
        """Answer the page or the stream of its data."""
        try:
            parts = urllib.parse.urlsplit(self.path)
            query = urllib.parse.parse_qs(parts.query, max_num_fields=8)
        except ValueError:
            self.send_error(400)
            return
        if not self._allowed(query):
            self.send_error(403)
        elif parts.path == "/":
            page = _page()[0].encode()
            self.send_response(200)
            self.send_header("Content-Type", "text/html; charset=utf-8")
            self.send_header("Content-Length", str(len(page)))
            self.end_headers()
            self.wfile.write(page)
        elif parts.path == "/data":
            self._stream()
        else:
            self.send_error(404)

    def _allowed(self, query: dict[str, list[str]]) -> bool:
        if self.server.token is not None:
            return hmac.compare_digest(query.get("token", [""])[0].encode(), self.server.token.encode())
        # A foreign page may have its own name resolved to this machine; the name it calls gives it away.
        name = (self.headers.get("Host") or "").rsplit(":", 1)[0]
        return name in _LOCAL

    def end_headers(self) -> None:
        """Say with every answer that nobody may frame, keep, guess at or refer to it."""
        self.send_header("Content-Security-Policy", _page()[1])
        self.send_header("X-Content-Type-Options", "nosniff")
        self.send_header("X-Frame-Options", "DENY")
        self.send_header("Referrer-Policy", "no-referrer")
        self.send_header("Cache-Control", "no-store")
        super().end_headers()

    def version_string(self) -> str:
        """Return the server's name without Python's version."""
        return "cycloid-bench"

    def _stream(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/event-stream")
        self.end_headers()
        self.server.keep(self.connection, _STREAM_SECONDS)
        number = 0
        try:
            while True:
                number, text = self.server.newest.after(number, 5.0)
                self.wfile.write(f"data: {text}\n\n".encode())
        except OSError:  # the client went, or took nothing for `timeout`
            self.close_connection = True

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: the terminal belongs to the recording."""
