"""Encoders of CiA 406 on CANopen (CiA 301): set up by SDO, started by NMT, read from TPDO1 on SYNC."""

from __future__ import annotations

import contextlib
import struct
import time
from typing import Annotated, Any, Self

import canopen
import pydantic

from drivers.can_hub import SYNC_ID, CanHub, FrameReader, acquire_hub, release_hub
from drivers.encoder import (
    AngleConfig,
    BusConfig,
    Encoder,
    EncoderConnectionError,
    EncoderProtocolError,
    EncoderTimeout,
    Wiring,
    counts_to_value,
    extract_bits,
    role_of,
    unwrap,
)
from drivers.recording_format import RESET, ROLLOVER, Channel, Event, Samples

POSITION, COUNTS_PER_TURN, TURNS = 0x6004, 0x6501, 0x6502
_NO_SUCH_OBJECT = (0x06020000, 0x06090011, 0x060A0023)


class CanopenConfig(AngleConfig):
    """A `[channel.X]` with protocol = "canopen"."""

    bus: str
    node: Annotated[int, pydantic.Field(ge=1, le=127)]
    signed: bool = False


class CanopenEncoder(Encoder):
    """One node of CiA 406 whose TPDO1 maps the position 0x6004.

    The node says the identifier and mapping of its TPDO1 (0x1800, 0x1A00), when it sends (transmission type 1 to 240:
    on every n-th SYNC, which then stamps the sample; 254, 255: at its own pace, stamped frame by frame), its counts
    per turn (0x6501) and turns (0x6502), at whose product the position rolls over.

    Parameters
    ----------
    name
        Name of the channel.
    config
        Node, direction, zero; `signed`: a first position in the upper half of the range is one below zero.
    bus
        The bus.
    """

    configuration = CanopenConfig

    def __init__(self, name: str, config: CanopenConfig, bus: BusConfig) -> None:
        self.name, self.config, self.bus = name, config, bus
        self._hub: CanHub | None = None
        self._node: Any = None
        self._reader: FrameReader | None = None
        self._previous: int | None = None
        self._started = False

    @classmethod
    def from_config(cls, name: str, config: Any, wiring: Wiring) -> CanopenEncoder:
        """Return the encoder of a `[channel.name]`; see `Encoder.from_config`."""
        return cls(name, config, wiring.bus(config.bus, name))

    @property
    def _where(self) -> str:
        return f'{self.name}: node {self.config.node} on the CAN bus {self.bus.interface} "{self.bus.channel}"'

    def __enter__(self) -> Self:
        """Open the bus and ask the node what it is; see `Encoder.__enter__`."""
        self._hub = acquire_hub(self.bus)
        try:
            self._set_up(self._hub)
        except BaseException:
            self.close()
            raise
        return self

    def _set_up(self, hub: CanHub) -> None:
        if self.config.node in hub.network:
            raise EncoderConnectionError(f"{self._where} is taken by another channel.")
        self._node = hub.network.add_node(self.config.node, canopen.ObjectDictionary())
        vendor, product = self._object(0x1018, 1, 0), self._object(0x1018, 2, 0)
        serial = self._object(0x1018, 4, 0)
        identifier = self._object(0x1800, 1)
        kind = self._object(0x1800, 2, 255)
        if identifier & 0x80000000:
            raise EncoderProtocolError(f"{self._where} has its TPDO1 switched off (0x1800:01 = 0x{identifier:08X}).")
        step = kind if 1 <= kind <= 240 else None
        length = self._mapping()
        self._counts_per_turn = self.config.counts_per_turn or self._object(COUNTS_PER_TURN, 0)
        if self._counts_per_turn == 0:
            raise EncoderProtocolError(f"{self._where} says 0 counts per turn (0x6501); write counts_per_turn.")
        # The position has 0x6501 * 0x6502 values, or all 2^bits where the node does not say its turns.
        turns = self._object(TURNS, 0, 0)
        self._modulus = min(self._counts_per_turn * turns, 1 << self._bits) if turns else 1 << self._bits
        source = f"host clock: the CAN interface's stamp of the {f'SYNC 0x{SYNC_ID:03X}' if step else 'frame'}"
        self.channel = Channel(
            name=self.name,
            role=role_of(self.name),
            protocol="canopen",
            unit="rad",
            counts_per_turn=self._counts_per_turn,
            direction=self.config.direction,
            zero=self.config.zero,
            zero_reference=self.config.zero_reference,
            identity=f"node {self.config.node}, vendor 0x{vendor:08X}, product 0x{product:08X}, serial {serial}",
            time_source=f"{source} ({self.bus.interface})",
        )
        self._reader = FrameReader(hub, identifier & 0x1FFFFFFF, length, step, self.name)
        reader = self._reader
        self._node.emcy.add_callback(
            lambda e: reader.say(e.timestamp, f"EMCY 0x{e.code:04X}, register 0x{e.register:02X}: {e.get_desc()}")
        )
        self._node.nmt.add_heartbeat_callback(
            lambda state: reader.say(time.time(), "the node started again", RESET) if state == 0 else None
        )

    def _object(self, index: int, subindex: int, default: int | None = None) -> int:
        """Return an unsigned object by SDO; `default` where the node has no such object."""
        try:
            data = self._node.sdo.upload(index, subindex)
        except canopen.SdoAbortedError as problem:
            if default is not None and problem.code in _NO_SUCH_OBJECT:
                return default
            raise EncoderProtocolError(f"{self._where} refuses 0x{index:04X}:{subindex:02X}: {problem}.") from problem
        except canopen.SdoCommunicationError as problem:
            raise EncoderTimeout(
                f"{self._where} does not answer; is it powered, and are node and bit rate right?"
            ) from problem
        return int.from_bytes(data, "little")

    def _mapping(self) -> int:
        """Find the position in TPDO1, keep its place, and return the frame's length in bytes."""
        offset, found = 0, False
        for entry in range(1, self._object(0x1A00, 0) + 1):
            index, _, bits = struct.unpack(">HBB", struct.pack(">I", self._object(0x1A00, entry)))
            if index == POSITION and 0 < bits <= 32:
                self._start, self._bits, found = offset, bits, True
            offset += bits
        if not found or offset > 64 or offset % 8:
            raise EncoderProtocolError(f"{self._where} does not map the position 0x6004 into its TPDO1 (0x1A00).")
        return offset // 8

    def start(self) -> None:
        """Set the node operational: it sends from now on."""
        self._node.nmt.state = "OPERATIONAL"
        self._started = True

    def close(self) -> None:
        """Set the node back to pre-operational, where `start` was called, and release the bus."""
        hub, self._hub = self._hub, None
        if hub is None:
            return
        with contextlib.suppress(Exception):  # a broken bus can't be told
            if self._started:
                self._node.nmt.state = "PRE-OPERATIONAL"
        if self._reader is not None:
            self._reader.close()
        if self._node is not None:
            del hub.network[self.config.node]
        release_hub(hub)

    def read(self, timeout: float) -> Samples | None:
        """Return the positions that came; see `Encoder.read`."""
        assert self._reader is not None, "read() is for an encoder that is open"
        block = self._reader.read(timeout)
        if block is None:
            return None
        payloads, stamps, status = block
        raw = extract_bits(payloads, self._start, self._bits, signed=False)
        counts, rolled = unwrap(raw, self._modulus, self._previous, signed=self.config.signed)
        self._previous = int(counts[-1])
        value = counts_to_value(counts, self._counts_per_turn, self.config.direction, self.config.zero)
        return Samples.checked(self.name, stamps, value, counts=counts, status=status | rolled * ROLLOVER)

    def events(self) -> list[Event]:
        """Return EMCY, restarts, gaps and skipped frames; see `Encoder.events`."""
        return self._reader.events() if self._reader is not None else []
