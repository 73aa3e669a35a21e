"""The simulated bench behind ADS: a simulated Beckhoff PLC that writes a ring buffer of samples."""

from __future__ import annotations

import contextlib
import socket
import socketserver
import struct
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cycloid_fmu import edge
from drivers.ads.plc import ADS_TCP_PORT, SYMBOL_INFORMATION, SYMBOL_NOT_FOUND
from drivers.ads.ring import Head, sample_type
from drivers.encoder import EncoderSetupError
from drivers.recording_format.schema import ByteArray
from drivers.simulated.bench import SimulatedBench
from drivers.simulated.faults import ADS_FAULTS, Fault
from drivers.simulated.motion import Motion, quantised

RING = "Recorder.Ring"
_GROUP, _OFFSET = 0x4040, 0x5DC00  # index group of a PLC's variables in TwinCAT, and an offset in it
_COLUMNS = 3
_TORQUE = 1e-4  # N*m per count
_READ_DEVICE_INFO, _READ, _READ_STATE, _READ_WRITE = 1, 2, 4, 9
_SERVICE_NOT_SUPPORTED, _BAD_SIZE = 0x701, 0x705
_AMS = struct.Struct("<8s8sHHIII")  # target, source, command, state flags, data length, error, request number
_END_SECONDS = 5.0  # without a client after the end of the motion
_RESPONSE = 1  # bit of the state flags


class SimulatedAdsBench(SimulatedBench):
    """A PLC with a ring of samples: both angles and the torque, in columns 1 to 3.

    It serves ADS over TCP on port 48898. The motion begins when the ring is first read; the PLC continues without
    readers and overwrites samples that were not read in time. It ends when the last samples have been read, or with the
    motion if there is no client.

    Parameters
    ----------
    motion
        The motion that the sensors measure.
    host
        Address of this machine to listen on; the net id is this address followed by ".1.1".
    length
        Capacity of the ring in samples.
    input_counts_per_turn, output_counts_per_turn
        Resolution of the encoders.
    speed_factor, clock_drift
        Speed relative to real time; relative drift of the PLC's clock against the host's, > 0: fast.
    faults
        See `faults.Fault`: "pull", "reset" and "corrupt", `sample` counted from 0.
    """

    def __init__(
        self,
        motion: Motion,
        *,
        host: str = "127.0.0.1",
        length: int = 4096,
        input_counts_per_turn: int = 1 << 22,
        output_counts_per_turn: int = 1 << 25,
        speed_factor: float = 1.0,
        clock_drift: float = 0.0,
        faults: Sequence[Fault] = (),
    ) -> None:
        super().__init__(motion)
        self.host, self.net_id = host, f"{host}.1.1"
        self.counts_per_turn = (input_counts_per_turn, output_counts_per_turn)
        self._times = motion.time / speed_factor
        self._drift = clock_drift
        self._faults = [f for f in faults if f.kind in ADS_FAULTS]
        self._lock = threading.Lock()
        self._begun: float | None = None
        self._written = self._restarted_at = 0
        self._last_head: Head | None = None
        self._head = Head(_COLUMNS, length, 800_000_000_000_000_000, 0)
        self._samples = np.zeros(length, sample_type(_COLUMNS))
        angles = (motion.input_angle, motion.output_angle)
        counts = [quantised(a, n) for a, n in zip(angles, self.counts_per_turn, strict=True)]
        self._values = np.column_stack([*counts, np.rint(motion.torque / _TORQUE).astype(np.int64)])

    @property
    def written(self) -> int:
        """Number of samples of the motion that the PLC has written so far."""
        return self._written

    def _open(self) -> None:
        self._plug()

    def _close(self) -> None:
        self._unplug()

    def _plug(self) -> None:
        try:
            self._server = _AdsServer((self.host, ADS_TCP_PORT), self._answer)
        except OSError as problem:
            raise EncoderSetupError(
                f"The simulated PLC can't listen on {self.host}, port {ADS_TCP_PORT}: {problem.strerror}."
            ) from problem
        threading.Thread(target=self._server.serve_forever, args=(0.05,), name="ADS", daemon=True).start()

    def _unplug(self) -> None:
        self._server.shutdown()
        self._server.server_close()
        self._server.disconnect()

    def _connections(self, folder: Path) -> str:
        keys = (
            ("input_angle", f"counts_per_turn = {self.counts_per_turn[0]}"),
            ("output_angle", f"counts_per_turn = {self.counts_per_turn[1]}"),
            ("torque", f'torque_per_count = "{edge.format_quantity(_TORQUE, "N*m", "N*m")}"'),
        )
        return f'[plc.plc1]\nnet_id = "{self.net_id}"\nhost = "{self.host}"\nring = "{RING}"\n' + "".join(
            f'\n[channel.{name}]\nprotocol = "ads"\nplc = "plc1"\ncolumn = {column}\n{key}\n'
            for column, (name, key) in enumerate(keys, 1)
        )

    def _end(self) -> dict[str, Any]:
        return {"samples": self.motion.run.samples, "idle": 5.0}

    def _run(self) -> None:
        pulls = sorted((f for f in self._faults if f.kind == "pull"), key=lambda f: f.sample)
        alone = 0.0
        while not self._stopping.wait(0.005) and not self._done.is_set():
            if pulls and self._written > pulls[0].sample:
                self._unplug()
                self._stopping.wait(pulls.pop(0).by)
                self._plug()
            with self._lock:
                self._write()
            alone = 0.0 if self._server.connections else alone + 0.005
            if alone > _END_SECONDS and self._written >= len(self._times):
                return

    def _write(self) -> None:
        """Write the samples due since the last call, as a PLC does in each cycle."""
        if self._begun is None:
            return
        due = int(np.searchsorted(self._times, time.monotonic() - self._begun, side="right"))
        for fault in self._faults:
            if fault.kind == "reset" and self._written <= fault.sample < due:
                self._restarted_at = fault.sample
                self._samples[:] = np.zeros_like(self._samples)
                self._written = fault.sample
        first = max(self._written, due - self._head.length)
        taken = np.arange(first, due)
        numbers = (taken - self._restarted_at + 1).astype(np.uint64)
        places = ((numbers - np.uint64(1)) % np.uint64(self._head.length)).astype(np.intp)
        ns = np.rint(self._times[taken] * (1 + self._drift) * 1e9).astype(np.uint64)
        zero = self._values[self._restarted_at] * np.array([1, 1, 0]) if self._restarted_at else np.int64(0)
        self._samples["number"][places] = self._samples["check"][places] = numbers
        self._samples["time"][places] = ns + np.uint64(800_000_000_000_000_000)
        self._samples["values"][places] = self._values[taken] - zero
        for fault in self._faults:
            if fault.kind == "corrupt":
                broken = (taken >= fault.sample) & (taken < fault.sample + fault.count)
                self._samples["check"][places[broken]] = 0
        self._written = due
        started = 800_000_000_000_000_000 + round(self._times[self._restarted_at] * (1 + self._drift) * 1e9)
        self._head = Head(_COLUMNS, self._head.length, started, due - self._restarted_at)

    def _memory(self, offset: int, count: int) -> ByteArray | None:
        """Return the current bytes of the ring; None outside it."""
        if not _OFFSET <= offset <= offset + count <= _OFFSET + self._head.ring_bytes:
            return None
        with self._lock:
            if self._begun is None:
                self._begun = time.monotonic()
                head = self._head
            else:
                self._write()
                if offset == _OFFSET:
                    # A client that requests the last head a second time has read its samples.
                    if self._written >= len(self._times) and self._last_head == self._head:
                        self._done.set()
                    self._last_head = self._head
                head = self._head
            memory = np.concatenate([np.frombuffer(head.pack(), np.uint8), self._samples.view(np.uint8)])
        return memory[offset - _OFFSET :][:count]

    def _answer(self, command: int, request: bytes) -> tuple[int, bytes]:
        """Return error code and data of a PLC's answer to a request."""
        if command == _READ_DEVICE_INFO:
            return 0, struct.pack("<BBH16s", 3, 1, 4024, b"simulated bench")
        if command == _READ_STATE:
            return 0, struct.pack("<HH", 5, 0)
        with contextlib.suppress(struct.error):
            group, offset, count = struct.unpack_from("<III", request)
            if command == _READ and group == _GROUP:
                memory = self._memory(offset, count)
                return (_BAD_SIZE, b"") if memory is None else (0, struct.pack("<I", count) + memory.tobytes())
            if command == _READ_WRITE and group == SYMBOL_INFORMATION:
                (written,) = struct.unpack_from("<I", request, 12)
                name = request[16 : 16 + written].rstrip(b"\0").decode("ascii", "replace")
                if name.lower() != RING.lower():
                    return SYMBOL_NOT_FOUND, bytes(4)
                texts = [RING.encode(), b"ST_Ring", b""]
                body = b"".join(text + b"\0" for text in texts)
                length = 30 + len(body)
                entry = struct.pack(
                    "<6I3H", length, _GROUP, _OFFSET, self._head.ring_bytes, 65, 0, *(len(text) for text in texts)
                )
                return 0, struct.pack("<I", length) + entry + body
        return _SERVICE_NOT_SUPPORTED, b""


class _AdsServer(socketserver.ThreadingTCPServer):
    """ADS over TCP: frames of a 6-byte AMS/TCP header, a 32-byte AMS header and data (Beckhoff, TE1000 ADS)."""

    allow_reuse_address = True
    daemon_threads = True

    def __init__(self, address: tuple[str, int], answer: Callable[[int, bytes], tuple[int, bytes]]) -> None:
        self.answer = answer
        self.connections: list[socket.socket] = []
        super().__init__(address, _AdsConnection)

    def process_request(self, request: Any, client_address: Any) -> None:
        """Register the connection and serve it in its own thread."""
        self.connections.append(request)
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        """Remove a connection that ended, and close it."""
        self.connections.remove(request)
        super().shutdown_request(request)

    def disconnect(self) -> None:
        """Cut all connections."""
        for connection in list(self.connections):
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)


class _AdsConnection(socketserver.StreamRequestHandler):
    server: _AdsServer

    def handle(self) -> None:
        """Answer requests until the client disconnects."""
        with contextlib.suppress(OSError):
            while len(start := self.rfile.read(6)) == 6:
                frame = self.rfile.read(struct.unpack("<2xI", start)[0])
                if len(frame) < _AMS.size:
                    return
                target, source, command, flags, _, _, invoked = _AMS.unpack_from(frame)
                code, data = self.server.answer(command, frame[_AMS.size :])
                data = struct.pack("<I", code) + data
                head = _AMS.pack(source, target, command, flags | _RESPONSE, len(data), 0, invoked)
                self.wfile.write(struct.pack("<2xI", len(head) + len(data)) + head + data)
