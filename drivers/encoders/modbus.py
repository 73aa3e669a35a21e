"""Encoders on Modbus RTU (Modbus over serial line, V1.02): polled registers; frames and CRC-16 by pymodbus."""

from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

import numpy as np
import numpy.typing as npt
import pydantic

from cycloid_fmu import edge
from drivers.counts import UnseenTurns, counts_to_value, extract_bits, unwrap
from drivers.encoder import AngleConfig, EncoderProtocolError, EncoderSetupError, channel_of
from drivers.lines import PortConfig
from drivers.recording_format import ROLLOVER, FloatArray, IntArray, Samples
from drivers.serial.polled import PolledEncoder
from drivers.serial.port import MIDDLE, PortHub, ask

with edge.needs_extra("bench"):
    from pymodbus.framer import FramerRTU
    from pymodbus.pdu import DecodePDU
    from pymodbus.pdu.register_message import ReadHoldingRegistersRequest, ReadInputRegistersRequest

_REQUESTS = {"holding": ReadHoldingRegistersRequest, "input": ReadInputRegistersRequest}


class ModbusConfig(AngleConfig):
    """A `[channel.X]` with protocol = "modbus".

    Attributes
    ----------
    port, device
        Name of the port's table, and address of the device.
    register, registers, table
        First register of the position, as sent (from 0), number of registers, and their table.
    low_word_first
        Whether the first register holds the low bits; usually it holds the high ones.
    bits
        Number of low bits of the registers that are the position; absent: all. It rolls over at 2^bits.
    signed
        Whether a first position in the upper half of the range is negative.
    """

    port: str
    device: Annotated[int, pydantic.Field(ge=1, le=247)] = 1
    register_: Annotated[int, pydantic.Field(ge=0, le=0xFFFF, alias="register")]
    registers: Annotated[int, pydantic.Field(ge=1, le=4)] = 2
    table: Literal["holding", "input"] = "holding"
    low_word_first: bool = False
    bits: Annotated[int, pydantic.Field(ge=2, le=62)] | None = None
    signed: bool = False


class ModbusEncoder(PolledEncoder):
    """A position in registers of a Modbus device."""

    configuration = ModbusConfig
    checksum_name: ClassVar[str] = "CRC-16 is"

    def __init__(self, name: str, config: ModbusConfig, port: PortConfig) -> None:
        super().__init__(name, config, port)
        self.where = f'{name}: Modbus device {config.device} on "{port.url}"'
        self.answer_bytes = 5 + 2 * config.registers
        self._bits = min(config.bits or 16 * config.registers, 62)
        self._unseen = UnseenTurns(1 << self._bits)
        request = _REQUESTS[config.table](address=config.register_, count=config.registers, dev_id=config.device)
        self._request = FramerRTU(DecodePDU(False)).buildFrame(request)
        self._head = self._request[:2] + bytes([2 * config.registers])
        self._previous: int | None = None

    def question(self, port: Any) -> bytes:
        """Request the registers; see `SerialEncoder.question`."""
        head = ask(port, self._request, 5)  # an exception response has five bytes
        if len(head) < 5 or head[1] & 0x80:
            return head
        return head + bytes(port.read(self.answer_bytes - 5))

    def set_up(self, hub: PortHub) -> None:
        """See `HubEncoder.set_up`."""
        config = self.config
        if config.counts_per_turn is None:
            raise EncoderSetupError(f"{self.where}: counts_per_turn is missing: Modbus devices do not report it.")
        answer = hub.exchange(self.question, self.asked).answer
        if len(answer) == 5 and answer[1] & 0x80 and _right(answer):
            raise EncoderProtocolError(
                f"{self.where} refuses register {config.register_} of the {config.table} table: exception {answer[2]}."
            )
        self.asked_once(hub)
        self.channel = channel_of(
            self.name,
            config,
            identity=f"Modbus device {config.device}, {config.table} register {config.register_} ({config.registers})",
            time_source=MIDDLE,
            counts_per_turn=config.counts_per_turn,
        )

    def checked(self, answers: list[bytes]) -> npt.NDArray[np.bool_]:
        """See `PolledEncoder.checked`."""
        return np.array([a[:3] == self._head and _right(a) for a in answers], bool)

    def samples(self, times: FloatArray, answers: list[bytes], status: IntArray) -> Samples:
        """See `PolledEncoder.samples`."""
        words = np.frombuffer(b"".join(a[3:-2] for a in answers), ">u2").reshape(len(answers), -1)
        if self.config.low_word_first:
            words = words[:, ::-1]
        data = np.ascontiguousarray(words).astype(">u2").view(np.uint8)
        width = 16 * self.config.registers
        raw = extract_bits(data, width - self._bits, self._bits, signed=False, little_endian=False)
        counts, rolled = unwrap(raw, 1 << self._bits, self._previous, signed=self.config.signed)
        status = status | rolled * ROLLOVER
        counts = self.over_gaps(self._unseen, times, counts, status)
        self._previous = int(counts[-1])
        value = counts_to_value(counts, self.config.counts_per_turn, self.config.direction, self.config.zero)
        return Samples.checked(self.name, times, value, counts=counts, status=status)


def _right(frame: bytes) -> bool:
    return bool(FramerRTU.check_CRC(frame[:-2], int.from_bytes(frame[-2:], "big")))
