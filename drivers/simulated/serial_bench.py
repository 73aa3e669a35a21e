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
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from cycloid_fmu import edge
from drivers.encoders.amt21 import check_bits
from drivers.recording_format import IntArray
from drivers.simulated.bench import SimulatedBench
from drivers.simulated.buses import SimulatedAmt21, SimulatedAscii, SimulatedBus, SimulatedModbus
from drivers.simulated.faults import SERIAL_FAULTS, Fault, at_wrong_baud
from drivers.simulated.motion import Motion, quantised

_BITS_PER_BYTE = 10  # with start and stop bit


class _PtyBench(SimulatedBench):
    """A thread behind a pseudo-terminal, limited to its baud rate; its name does not change when the cable is pulled.

    `url` is the port to record. The motion runs at its own speed times `speed_factor`; a fault's `sample` is the number
    of the request or line, its `target` the address.

    Attributes
    ----------
    receive_buffer
        Size of the port's receive buffer, bytes, 4095 at most; further bytes are lost, as on a real line without flow
        control. None: that of a pseudo-terminal, about 70,000.
    """

    _protocol: ClassVar[str]
    receive_buffer: int | None = None

    def __init__(self, motion: Motion, description: Any) -> None:
        super().__init__(motion, description)
        self._factor = description.speed_factor or 1.0
        self._faults: list[Fault] = [f for f in description.faults if f.kind in SERIAL_FAULTS]
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
        end = time.perf_counter() + (len(sent) + after) * _BITS_PER_BYTE / self.description.baud_rate
        while (remaining := end - time.perf_counter()) > 0:
            if remaining > 1e-3:
                time.sleep(remaining - 5e-4)
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
        port = f"[port.tty]\nurl = {edge.json_text(self.url)}\nbaud_rate = {self.description.baud_rate}\n"
        return port + "".join(
            f'\n[channel.{name}]\nprotocol = "{self._protocol}"\nport = "tty"\n{keys}'
            for name, keys in self._channels().items()
        )

    @abc.abstractmethod
    def _channels(self) -> dict[str, str]:
        """Return the protocol's keys in the table of each channel."""

    def _end(self) -> dict[str, Any]:
        return {"stop": lambda: self.wait(0.0)}  # the recorder's polling determines the number of samples


class _AskedBench(_PtyBench):
    """A bench of two encoders that answer requests with the present position; the motion begins with the first request.

    Attributes
    ----------
    answered, answered_at
        Samples with which each address answered, without faulty answers, and the times of these answers, s since 1970.
    """

    def __init__(self, motion: Motion, description: Any) -> None:
        super().__init__(motion, description)
        self.addresses: tuple[int, int] = description.addresses
        self.answered: dict[int, list[int]] = {a: [] for a in self.addresses}
        self.answered_at: dict[int, list[float]] = {a: [] for a in self.addresses}
        self._asked = 0

    def _channels(self) -> dict[str, str]:
        return dict(zip(("input_angle", "output_angle"), map(self._keys, self.addresses), strict=True))

    @abc.abstractmethod
    def _keys(self, address: int) -> str:
        """Return the protocol's keys in the table of the channel at this address."""

    def _counts(self, counts_per_turn: int) -> dict[int, IntArray]:
        """Return the counts of each address, without rollover, shape (n,)."""
        angles = self.motion.input_angle, self.motion.output_angle
        return {a: quantised(angle, counts_per_turn) for a, angle in zip(self.addresses, angles, strict=True)}

    def _requests(self, longest: int) -> Iterator[bytes]:
        """Yield what the recorder sends, up to `longest` bytes at a time; b"" in a pause."""
        while not self._stopping.is_set():
            if not select.select([self._bench], [], [], 0.05)[0]:
                yield b""
            else:
                with contextlib.suppress(OSError):
                    yield os.read(self._bench, longest)

    def _answer(self, address: int, sample: int, data: bytes, *, after: int, position: bool = True) -> None:
        """Send an answer, with its fault if there is one; `position`: it is the position of this sample."""
        if self._put(data, self._fault(self._asked, address), after=after) and position:
            self.answered[address].append(sample)
            self.answered_at[address].append(time.time())
        self._asked += 1


class SimulatedAmt21Bench(_AskedBench):
    """A bench of two AMT21 encoders on one RS-485 line, see `buses.SimulatedAmt21`. The torque is not on this line."""

    _protocol = "amt21"

    def _keys(self, address: int) -> str:
        turns = "multi_turn = true\n" if self.description.multi_turn else ""
        return f"address = {address}\nbits = {self.description.bits}\n{turns}"

    def _run(self) -> None:
        counts_per_turn = 1 << self.description.bits
        words: dict[int, list[int]] = {}
        for address, counts in self._counts(counts_per_turn).items():
            position = counts % counts_per_turn << (14 - self.description.bits)
            words[address] = check_bits(position.astype(np.uint16)).tolist()
            if self.description.multi_turn:
                turns = counts // counts_per_turn % (1 << 14)
                words[address + 1] = check_bits(turns.astype(np.uint16)).tolist()
        for request in self._requests(64):
            for question in request:
                if question in words:
                    i, address = self._sample(), question & ~1
                    word = struct.pack("<H", words[question][i])
                    self._answer(address, i, word, after=1, position=question == address)


class SimulatedModbusBench(_AskedBench):
    """A bench of two Modbus RTU encoders on one line, see `buses.SimulatedModbus`.

    Each holds its position, 32 bits that count turns too, in the holding registers 0 and 1, high word first; any other
    request gets the exception "illegal data address".
    """

    _protocol = "modbus"

    def __init__(self, motion: Motion, description: Any) -> None:
        with edge.needs_extra("bench"):
            import pymodbus  # noqa: F401  # in the thread of `_run` the error would be lost
        super().__init__(motion, description)

    def _keys(self, address: int) -> str:
        counts = f"counts_per_turn = {self.description.counts_per_turn}\nsigned = true\n"
        return f"device = {address}\nregister = 0\n{counts}"

    def _run(self) -> None:
        from pymodbus.framer import FramerRTU
        from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU
        from pymodbus.pdu.register_message import ReadHoldingRegistersRequest, ReadHoldingRegistersResponse

        counts = self._counts(self.description.counts_per_turn)
        framer, waiting = FramerRTU(DecodePDU(True)), b""
        for data in self._requests(256):
            waiting = waiting + data if data else b""  # a pause ends a frame
            used, request = framer.handleFrame(waiting, 0, 0)
            waiting = waiting[used:]
            if request is None or request.dev_id not in counts:
                continue
            answer: ModbusPDU = ExceptionResponse(request.function_code, 2, device_id=request.dev_id)
            sample = self._sample()
            read = isinstance(request, ReadHoldingRegistersRequest) and (request.address, request.count) == (0, 2)
            if read:
                words = list(divmod(int(counts[request.dev_id][sample] % (1 << 32)), 1 << 16))
                answer = ReadHoldingRegistersResponse(registers=words, dev_id=request.dev_id)
            self._answer(request.dev_id, sample, framer.buildFrame(answer), after=8, position=read)


class SimulatedAsciiBench(_PtyBench):
    """A counter that sends a line "$sequence,time,counts*checksum" for each sample, see `buses.SimulatedAscii`.

    The motion begins when the port is opened. The time is the counter's own clock in microseconds, 32 bits; the
    checksum is NMEA 0183's; the counts are of the output angle. The fault "reset": clock, numbers and counts restart at
    0.

    Attributes
    ----------
    sent
        Time of latching, s since 1970, and counts of each line, including lines that the port lost.
    """

    _protocol = "ascii"

    def __init__(self, motion: Motion, description: Any) -> None:
        super().__init__(motion, description)
        self._line_faults = {
            f.sample: f.kind for f in description.faults if f.kind in ("reset", "duplicate", "swap", "drop")
        }
        self.sent: list[tuple[float, int]] = []

    def _channels(self) -> dict[str, str]:
        line = 'line = "${sequence},{time},{counts}*{checksum}"\nchecksum = "xor"\ntime_unit = "1 us"\n'
        counts = f"time_modulus = {1 << 32}\ncounts_per_turn = {self.description.counts_per_turn}\n"
        return {"output_angle": f'{line}{counts}zero_reference = "incremental"\n'}

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
        swapped: list[bytes] = []
        for i, due in enumerate(times.tolist()):
            if self._stopping.wait(max(0.0, begun + due - time.monotonic())):
                return
            now = time.monotonic() - begun  # this thread may wake late: latch the present angle
            angle = np.interp(now, times, self.motion.output_angle)
            count = int(quantised(np.array([angle]), self.description.counts_per_turn)[0])
            fault = self._line_faults.get(i)
            if fault == "reset":
                zero, number, start = count, 0, now
            ticks = round((now - start) * (1 + self.description.clock_drift) * 1e6) % (1 << 32)
            text = f"{number},{ticks},{count - zero}".encode()
            line = b"$%b*%02X\r\n" % (text, functools.reduce(operator.xor, text, 0))
            number += 1
            self.sent.append((since + now, count - zero))
            if fault == "swap":
                swapped = [line]
            elif fault != "drop":
                for data in [line] * (1 + (fault == "duplicate")) + swapped:
                    self._put(data, self._fault(i, 0))
                swapped = []


SERIAL_BENCHES: Mapping[type[SimulatedBus], type[SimulatedAmt21Bench | SimulatedModbusBench | SimulatedAsciiBench]] = {
    SimulatedAmt21: SimulatedAmt21Bench,
    SimulatedModbus: SimulatedModbusBench,
    SimulatedAscii: SimulatedAsciiBench,
}
