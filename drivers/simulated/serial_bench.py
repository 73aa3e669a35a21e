"""The simulated bench on a serial line: a pseudo-terminal, limited to the line's baud rate, in place of a port."""

from __future__ import annotations

import abc
import contextlib
import functools
import operator
import os
import select
import struct
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from cycloid_fmu import edge
from drivers.encoders.amt21 import check_bits
from drivers.simulated.bench import SimulatedBench
from drivers.simulated.faults import SERIAL_FAULTS, Fault, at_wrong_baud
from drivers.simulated.motion import Motion, quantised

_BITS_PER_BYTE = 10  # with start and stop bit


class _PtyBench(SimulatedBench):
    """A thread behind a pseudo-terminal, limited to its baud rate; its name does not change when the cable is pulled.

    `url` is the port to record; `speed_factor` the speed relative to real time; `faults` see `faults.Fault`.

    Attributes
    ----------
    receive_buffer
        Size of the port's receive buffer, bytes, 4095 at most; further bytes are lost, as on a real line without flow
        control. None: that of a pseudo-terminal, about 70,000.
    """

    _protocol: ClassVar[str]
    receive_buffer: int | None = None

    def __init__(
        self, motion: Motion, *, speed_factor: float = 1.0, baud_rate: int, faults: Sequence[Fault] = ()
    ) -> None:
        super().__init__(motion)
        self.baud_rate = baud_rate
        self._factor = speed_factor
        self._faults = [f for f in faults if f.kind in SERIAL_FAULTS]
        self._begun: float | None = None

    def _open(self) -> None:
        self._folder = tempfile.TemporaryDirectory(prefix="cycloid-bench-")
        self.url = str(Path(self._folder.name) / "tty")
        self._plug()

    def _close(self) -> None:
        self._unplug()
        self._folder.cleanup()

    def _plug(self) -> None:
        import termios
        import tty

        self._bench, self._line = os.openpty()
        os.set_blocking(self._bench, False)  # a line does not wait for its reader
        tty.setraw(self._line)
        settings = termios.tcgetattr(self._line)
        settings[4] = settings[5] = termios.B50  # no recorder uses it: a change shows that the port was opened
        termios.tcsetattr(self._line, termios.TCSANOW, settings)
        os.symlink(os.ttyname(self._line), self.url)

    def _unplug(self) -> None:
        with contextlib.suppress(FileNotFoundError):
            os.unlink(self.url)
            os.close(self._bench)
            os.close(self._line)

    def _opened(self) -> bool:
        """Return whether a recorder has opened the port and set its baud rate."""
        import termios

        return bool(termios.tcgetattr(self._line)[5] != termios.B50)

    def _sample(self) -> int:
        """Return the index of the present sample; the first call starts the motion."""
        now = time.monotonic()
        self._begun = now if self._begun is None else self._begun
        i = int(np.searchsorted(self.motion.time, (now - self._begun) * self._factor, side="right")) - 1
        if i >= len(self.motion.time) - 1:
            self._done.set()
        return i

    def _fault(self, number: int, target: int) -> Fault | None:
        """Return the fault of this request or line of this device, or None."""
        for fault in self._faults:
            if fault.sample <= number < fault.sample + fault.count and fault.target in (0, target):
                return fault
        return None

    def _put(self, data: bytes, fault: Fault | None, after: int = 0) -> bool:
        """Send bytes, with a fault applied, no faster than the line; return whether they were sent unchanged."""
        kind = None if fault is None else fault.kind
        if kind == "mute":
            return False
        if kind == "pull" and fault is not None:
            self._unplug()
            self._stopping.wait(fault.by)
            self._plug()
            self._faults.remove(fault)
            return False
        sent = {
            "half": data[: len(data) // 2],
            "corrupt": data[:1] + bytes([data[1] ^ 1]) + data[2:],
            "garbage": bytes((b * 151 + 7) % 256 for b in data[::-1]) * 2,
            "wrong_baud": at_wrong_baud(data),
        }.get(kind or "", data)
        end = time.perf_counter() + (len(sent) + after) * _BITS_PER_BYTE / self.baud_rate
        while (left := end - time.perf_counter()) > 0:
            if left > 1e-3:
                time.sleep(left - 5e-4)
        taken = 0
        with contextlib.suppress(OSError):
            taken = os.write(self._bench, sent[: self._room()])
        return sent == data and taken == len(data)

    def _room(self) -> int | None:
        """Return the free space of the receive buffer, bytes; None without a limit."""
        if self.receive_buffer is None:
            return None
        import fcntl
        import termios

        (waiting,) = struct.unpack("=i", fcntl.ioctl(self._line, termios.FIONREAD, bytes(4)))
        return max(0, self.receive_buffer - int(waiting))

    def _connections(self, folder: Path) -> str:
        port = f"[port.tty]\nurl = {edge.json_text(self.url)}\nbaud_rate = {self.baud_rate}\n"
        return port + "".join(
            f'\n[channel.{name}]\nprotocol = "{self._protocol}"\nport = "tty"\n{keys}'
            for name, keys in self._channels().items()
        )

    @abc.abstractmethod
    def _channels(self) -> dict[str, str]:
        """Return the protocol's keys in the table of each channel."""

    def _end(self) -> dict[str, Any]:
        return {"stop": lambda: self.wait(0.0)}  # the recorder's polling determines the number of samples


class SimulatedAmt21Bench(_PtyBench):
    """A bench of two AMT21 encoders on one RS-485 line, simulated by a pseudo-terminal: record `url`.

    The motion begins with the first request and runs at its own speed times `speed_factor`; each answer is the present
    position. The torque is not on this line.

    Parameters
    ----------
    motion, speed_factor, baud_rate, faults
        See `_PtyBench`; a fault's `sample` is the number of the request, its `target` the address.
    addresses, bits, multi_turn
        Addresses of the input and output encoder; resolution, 12 or 14 bits; whether they count turns.

    Attributes
    ----------
    answered, answered_at
        Samples with which each address answered, without faulty answers, and the times of these answers, s since 1970.
    """

    _protocol = "amt21"

    def __init__(
        self,
        motion: Motion,
        *,
        addresses: tuple[int, int] = (0x54, 0x58),
        bits: Literal[12, 14] = 14,
        multi_turn: bool = False,
        speed_factor: float = 1.0,
        baud_rate: int = 2_000_000,
        faults: Sequence[Fault] = (),
    ) -> None:
        super().__init__(motion, speed_factor=speed_factor, baud_rate=baud_rate, faults=faults)
        self.addresses, self.bits, self.multi_turn = addresses, bits, multi_turn
        self.answered: dict[int, list[int]] = {a: [] for a in addresses}
        self.answered_at: dict[int, list[float]] = {a: [] for a in addresses}

    def _channels(self) -> dict[str, str]:
        turns = "multi_turn = true\n" if self.multi_turn else ""
        keys = [f"address = {address}\nbits = {self.bits}\n{turns}" for address in self.addresses]
        return dict(zip(("input_angle", "output_angle"), keys, strict=True))

    def _run(self) -> None:
        counts = 1 << self.bits
        words: dict[int, list[int]] = {}
        for address, angle in zip(self.addresses, (self.motion.input_angle, self.motion.output_angle), strict=True):
            position = quantised(angle, counts)
            words[address] = check_bits((position % counts << (14 - self.bits)).astype(np.uint16)).tolist()
            if self.multi_turn:
                words[address + 1] = check_bits((position // counts % (1 << 14)).astype(np.uint16)).tolist()
        asked = 0
        while not self._stopping.is_set():
            if not select.select([self._bench], [], [], 0.05)[0]:
                continue
            with contextlib.suppress(OSError):
                for question in os.read(self._bench, 64):
                    if question not in words:
                        continue
                    i = self._sample()
                    address = question & ~1
                    whole = self._put(struct.pack("<H", words[question][i]), self._fault(asked, address), after=1)
                    if whole and question == address:
                        self.answered[address].append(i)
                        self.answered_at[address].append(time.time())
                    asked += 1


class SimulatedModbusBench(_PtyBench):
    """A bench of two Modbus RTU encoders on one line, simulated by a pseudo-terminal: record `url`.

    Each of the `devices` (addresses of input and output) holds its position, 32 bits that count turns too, in the
    holding registers 0 and 1, high word first; any other request gets the exception "illegal data address". Motion,
    faults, `answered` and `answered_at` are those of `SimulatedAmt21Bench`.
    """

    _protocol = "modbus"

    def __init__(
        self,
        motion: Motion,
        *,
        devices: tuple[int, int] = (1, 2),
        counts_per_turn: int = 1 << 18,
        speed_factor: float = 1.0,
        baud_rate: int = 115_200,
        faults: Sequence[Fault] = (),
    ) -> None:
        with edge.needs_extra("bench"):
            import pymodbus  # noqa: F401  # in the thread of `_run` the error would be lost
        super().__init__(motion, speed_factor=speed_factor, baud_rate=baud_rate, faults=faults)
        self.devices, self.counts_per_turn = devices, counts_per_turn
        self.answered: dict[int, list[int]] = {d: [] for d in devices}
        self.answered_at: dict[int, list[float]] = {d: [] for d in devices}

    def _channels(self) -> dict[str, str]:
        keys = f"register = 0\ncounts_per_turn = {self.counts_per_turn}\nsigned = true\n"
        angles = zip(("input_angle", "output_angle"), self.devices, strict=True)
        return {name: f"device = {device}\n{keys}" for name, device in angles}

    def _run(self) -> None:
        from pymodbus.framer import FramerRTU
        from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
        from pymodbus.pdu.register_message import ReadHoldingRegistersRequest, ReadHoldingRegistersResponse

        angles = (self.motion.input_angle, self.motion.output_angle)
        words = {d: quantised(a, self.counts_per_turn) % (1 << 32) for d, a in zip(self.devices, angles, strict=True)}
        framer = FramerRTU(DecodePDU(True))
        asked, waiting = 0, b""
        while not self._stopping.is_set():
            if not select.select([self._bench], [], [], 0.05)[0]:
                waiting = b""  # a pause ends a frame
                continue
            with contextlib.suppress(OSError):
                waiting += os.read(self._bench, 256)
            used, request = framer.handleFrame(waiting, 0, 0)
            waiting = waiting[used:]
            if request is None or request.dev_id not in words:
                continue
            answer: ModbusPDU = ExceptionResponse(request.function_code, 2, device_id=request.dev_id)
            sample = self._sample()
            read = isinstance(request, ReadHoldingRegistersRequest) and (request.address, request.count) == (0, 2)
            if read:
                high, low = divmod(int(words[request.dev_id][sample]), 1 << 16)
                answer = ReadHoldingRegistersResponse(registers=[high, low], dev_id=request.dev_id)
            if self._put(framer.buildFrame(answer), self._fault(asked, request.dev_id), after=8) and read:
                self.answered[request.dev_id].append(sample)
                self.answered_at[request.dev_id].append(time.time())
            asked += 1


class SimulatedAsciiBench(_PtyBench):
    """A counter that sends a line "$sequence,time,counts*checksum" for each sample, without request: record `url`.

    The motion begins when the port is opened. The time is the counter's own clock in microseconds, 32 bits, with the
    relative drift `clock_drift` against the host's, > 0: fast; the checksum is NMEA 0183's; the counts are of the
    output angle. A fault's `sample` is the number of the line; "reset": clock, numbers and counts restart at 0.

    Attributes
    ----------
    sent
        Time of latching, s since 1970, and counts of each line, including lines that the port lost.
    """

    _protocol = "ascii"

    def __init__(
        self,
        motion: Motion,
        *,
        counts_per_turn: int = 360_000,
        clock_drift: float = 0.0,
        speed_factor: float = 1.0,
        baud_rate: int = 921_600,
        faults: Sequence[Fault] = (),
    ) -> None:
        super().__init__(motion, speed_factor=speed_factor, baud_rate=baud_rate, faults=faults)
        self._restarts = {f.sample: f for f in faults if f.kind == "reset"}
        self._odd = {f.sample: f.kind for f in faults if f.kind in ("duplicate", "swap", "drop")}
        self.counts_per_turn, self.clock_drift = counts_per_turn, clock_drift
        self.sent: list[tuple[float, int]] = []

    def _channels(self) -> dict[str, str]:
        line = 'line = "${sequence},{time},{counts}*{checksum}"\nchecksum = "xor"\ntime_unit = "1 us"\n'
        counts = f'time_modulus = {1 << 32}\ncounts_per_turn = {self.counts_per_turn}\nzero_reference = "incremental"\n'
        return {"output_angle": line + counts}

    def _run(self) -> None:
        times = self.motion.time / self._factor
        while not self._opened():
            if self._stopping.wait(0.01):
                return
        begun = time.monotonic()
        # The least of several, as this thread may be delayed between the two readings.
        since = begun + min(-time.monotonic() + time.time() for _ in range(5))
        zero = number = 0
        start = 0.0
        held: bytes | None = None
        for i, due in enumerate(times.tolist()):
            if self._stopping.wait(max(0.0, begun + due - time.monotonic())):
                return
            now = time.monotonic() - begun  # this thread may wake late: latch the present angle
            angle = np.interp(now, times, self.motion.output_angle)
            count = int(quantised(np.array([angle]), self.counts_per_turn)[0])
            if i in self._restarts:
                zero, number, start = count, 0, now
            ticks = round((now - start) * (1 + self.clock_drift) * 1e6) % (1 << 32)
            text = f"{number},{ticks},{count - zero}".encode()
            line = b"$%b*%02X\r\n" % (text, functools.reduce(operator.xor, text, 0))
            number += 1
            self.sent.append((since + now, count - zero))
            odd = self._odd.get(i)
            if odd == "drop":
                continue
            if odd == "swap":
                held = line
                continue
            for one in [line] * (1 + (odd == "duplicate")) + [held] * (held is not None):
                self._put(one or b"", self._fault(i, 0))
            held = None


SERIAL_BENCHES: Mapping[str, type[SimulatedAmt21Bench] | type[SimulatedModbusBench] | type[SimulatedAsciiBench]] = {
    "amt21": SimulatedAmt21Bench,
    "modbus": SimulatedModbusBench,
    "ascii": SimulatedAsciiBench,
}
