"""CiA 406 encoders on CANopen (CiA 301): set up by SDO, started by NMT, read from their TPDO."""

from __future__ import annotations

import contextlib
import struct
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
import pydantic

from cycloid_fmu import edge
from drivers.can.bus import SYNC_ID, frame_key, time_source
from drivers.can.encoder import CanEncoder
from drivers.can.frames import FrameReader
from drivers.can.hub import CanHub
from drivers.counts import counts_to_value, extract_bits, unwrap
from drivers.encoder import AngleConfig, EncoderProtocolError, EncoderTimeout, ListeningTime, channel_of, device_counts
from drivers.lines import BusConfig
from drivers.plug_in import Wiring
from drivers.recording_format import GAP, RESET, ROLLOVER, Samples

with edge.needs_extra("bench"):
    import canopen

POSITION, SPEED, COUNTS_PER_TURN, TURNS = 0x6004, 0x6030, 0x6501, 0x6502
HEARTBEAT_TIME = 0x1017
_HEARTBEAT_ID = 0x700
_NMT_ID = 0
_SILENCING = {0x02: "stopped", 0x80: "pre-operational"}  # NMT commands
TPDOS = 4  # predefined by CiA 301
_MISSED_HEARTBEATS = 3
_NO_SUCH_OBJECT = (0x06020000, 0x06090011, 0x060A0023)
# CiA 406: data of the encoder besides counts and turns: index, subindex, whether signed.
_IDENTITY = {
    (0x6504, 0, False): "supported alarms 0x{:04X}",
    (0x6506, 0, False): "supported warnings 0x{:04X}",
    (0x6507, 0, False): "profile and software 0x{:08X}",
    (0x6509, 0, True): "offset {}",
    (0x650A, 1, True): "manufacturer offset {}",
    (0x650A, 2, True): "smallest position {}",
    (0x650A, 3, True): "largest position {}",
    (0x650B, 0, False): "encoder serial {}",
}
_STATE = {
    (0x6500, 0, False): "operating status 0x{:04X}",
    (0x6503, 0, False): "alarms 0x{:04X}",
    (0x6505, 0, False): "warnings 0x{:04X}",
    (0x6508, 0, False): "operating time {}",
}


class CanopenConfig(AngleConfig):
    """A `[channel.X]` with protocol = "canopen".

    Attributes
    ----------
    bus, node
        Name of the bus's table, and CANopen node number.
    quantity, speed_unit
        "position" is object 0x6004; "speed" is 0x6030, for which `speed_unit` is the speed of one count, rad/s or text
        such as "1 rpm".
    signed
        Whether a first position in the upper half of the range is negative.
    eds
        EDS file from which to take the mapping of the TPDO, instead of from the node.
    heartbeat
        Heartbeat interval to set in the node, s; absent: that of the node, which is not supervised if it is 0.
    """

    bus: str
    node: Annotated[int, pydantic.Field(ge=1, le=127)]
    quantity: Literal["position", "speed"] = "position"
    speed_unit: edge.Speed | None = None
    signed: bool = False
    eds: str | None = None
    heartbeat: Annotated[edge.Seconds, pydantic.Field(ge=0.001, le=65.535)] | None = None


class CanopenEncoder(CanEncoder):
    """A CiA 406 node with a TPDO that maps the position 0x6004 or the speed 0x6030.

    Read from the node or an EDS: identifier and mapping of the TPDO (0x1800 ff., 0x1A00 ff.) and its
    transmission type. Types 1 to 240 send on every n-th SYNC, whose time stamp the sample gets; types 254 and 255 send
    by event, each frame has its own stamp, and a pause longer than the event timer is a gap. Read from the node: counts
    per turn (0x6501) and number of turns (0x6502), at whose product the position rolls over. A node that restarts is
    set operational again; one that sends neither heartbeat nor frames has failed.
    """

    configuration = CanopenConfig

    def __init__(self, name: str, config: CanopenConfig, bus: BusConfig) -> None:
        super().__init__(name, config, bus)
        if config.quantity == "speed" and config.speed_unit is None:
            raise edge.InputError('speed_unit is missing: state one count of 0x6030, such as "1 rpm".')
        self._dictionary: Any = None
        self._node: Any = None
        self._previous: int | None = None
        self._started = self._restarted = self._listening = False

    @classmethod
    def from_config(cls, name: str, config: Any, wiring: Wiring) -> Self:
        """Return the encoder with the EDS that its table names, if any; see `PlugIn.from_config`."""
        encoder = super().from_config(name, config, wiring)
        if config.eds is not None:
            encoder._dictionary = _read_eds(wiring.folder / config.eds, config.node)
        return encoder

    @property
    def _where(self) -> str:
        return f"{self.name}: node {self.config.node} on the CAN bus {self.bus.address}"

    def set_up(self, hub: CanHub) -> None:
        """Query the node; see `HubEncoder.set_up`."""
        self._node = hub.node(self.config.node, self.config.quantity)
        vendor, product = self._object(0x1018, 1, 0), self._object(0x1018, 2, 0)
        serial = self._object(0x1018, 4, 0)
        identifier, kind, timer, length = self._tpdo()
        step = kind if 1 <= kind <= 240 else None
        about = [f"node {self.config.node}, vendor 0x{vendor:08X}, product 0x{product:08X}, serial {serial}"]
        about += self._texts(_IDENTITY)
        state = self._texts(_STATE)
        if self.config.quantity == "position":
            stated = self._object(COUNTS_PER_TURN, 0, self.config.counts_per_turn)
            self._counts_per_turn = device_counts(self.config, stated, self._where) if stated else 0
            if self._counts_per_turn == 0:
                raise EncoderProtocolError(f"{self._where} reports 0 counts per turn (0x6501).")
            # The position has 0x6501 * 0x6502 values, or all 2^bits if the node does not report its turns.
            turns = self._object(TURNS, 0, 0)
            self._modulus = min(self._counts_per_turn * turns, 1 << self._bits) if turns else 1 << self._bits
        self._supervise()
        self.channel = channel_of(
            self.name,
            self.config,
            identity="; ".join(", ".join(part) for part in (about, state) if part),
            time_source=time_source(self.bus, f"SYNC 0x{SYNC_ID:03X}" if step else "frame"),
            unit="rad" if self.config.quantity == "position" else "rad/s",
            counts_per_turn=self._counts_per_turn if self.config.quantity == "position" else None,
        )
        self.reader = FrameReader(hub, identifier, length, step, self.name, timer / 1000 or None)
        self._node.emcy.add_callback(self._on_emergency)
        hub.network.subscribe(_HEARTBEAT_ID + self.config.node, self._on_heartbeat)
        hub.network.subscribe(_NMT_ID, self._on_command)
        self._listening = True

    def _uploaded(self, index: int, subindex: int, *, optional: bool) -> bytes | None:
        """Read an object by SDO; None if it is `optional` and the node does not have it."""
        try:
            return bytes(self._node.sdo.upload(index, subindex))
        except canopen.SdoAbortedError as problem:
            if optional and problem.code in _NO_SUCH_OBJECT:
                return None
            raise EncoderProtocolError(f"{self._where} refuses 0x{index:04X}:{subindex:02X}: {problem}.") from problem
        except canopen.SdoCommunicationError as problem:
            raise EncoderTimeout(
                f"{self._where} does not answer; is it powered, and are node and bit rate right?"
            ) from problem

    def _object(self, index: int, subindex: int, default: int | None = None) -> int:
        """Read an unsigned object by SDO; return `default` if the node does not have it."""
        data = self._uploaded(index, subindex, optional=default is not None)
        return int.from_bytes(data, "little") if data is not None else default or 0

    def _texts(self, objects: Mapping[tuple[int, int, bool], str]) -> list[str]:
        """Return the texts of those of these objects that the node has."""
        stated = []
        for (index, subindex, signed), text in objects.items():
            data = self._uploaded(index, subindex, optional=True)
            if data is not None:
                stated.append(text.format(int.from_bytes(data, "little", signed=signed)))
        return stated

    def _communication(self, index: int, subindex: int, default: int | None = None) -> int:
        """Return an object of the TPDO from the EDS, if the wiring names one, else from the node."""
        if self._dictionary is None:
            return self._object(index, subindex, default)
        try:
            entry = self._dictionary[index][subindex]
            value = entry.default if entry.value is None else entry.value
        except KeyError:
            value = None
        if value is None and default is None:
            raise EncoderProtocolError(
                f"{self._where}: {self.config.eds} has no value for 0x{index:04X}:{subindex:02X}."
            )
        return int(default if value is None else value)  # type: ignore[arg-type]

    def _tpdo(self) -> tuple[int, int, int, int]:
        """Return frame key, transmission type, event timer, ms, and length, bytes, of the TPDO with the quantity.

        Stores the position and length of the quantity in it.
        """
        wanted = POSITION if self.config.quantity == "position" else SPEED
        off = None
        for number in range(TPDOS):
            entries = self._communication(0x1A00 + number, 0, 0)
            offset, is_mapped = 0, False
            for entry in range(1, min(entries, 64) + 1):
                mapped = self._communication(0x1A00 + number, entry)
                index, _, bits = struct.unpack(">HBB", struct.pack(">I", mapped & 0xFFFFFFFF))
                if index == wanted and 0 < bits <= 32 and not is_mapped:
                    self._start, self._bits, is_mapped = offset, bits, True
                offset += bits
            if not is_mapped or offset > 512 or offset % 8:
                continue
            identifier = self._communication(0x1800 + number, 1)
            if identifier & 0x80000000:
                off = f"0x{0x1800 + number:04X}:01 = 0x{identifier:08X}"
                continue
            kind = self._communication(0x1800 + number, 2, 255)
            timer = self._communication(0x1800 + number, 5, 0) if kind >= 254 else 0
            key = frame_key(identifier & 0x1FFFFFFF, extended=bool(identifier & 0x20000000))
            return key, kind, timer, offset // 8
        if off is not None:
            raise EncoderProtocolError(f"{self._where} has its TPDO switched off ({off}).")
        what = f"the {self.config.quantity} 0x{wanted:04X}"
        raise EncoderProtocolError(f"{self._where} does not map {what} into its TPDO (0x1A00 ff.).")

    def _supervise(self) -> None:
        """Set or read the node's heartbeat time."""
        if self.config.heartbeat is not None:
            wanted = struct.pack("<H", round(self.config.heartbeat * 1000))
            try:
                self._node.sdo.download(HEARTBEAT_TIME, 0, wanted)
            except (canopen.SdoAbortedError, canopen.SdoCommunicationError) as problem:
                raise EncoderProtocolError(f"{self._where} accepts no heartbeat time (0x1017): {problem}.") from problem
        self._heartbeat = self.config.heartbeat or self._object(HEARTBEAT_TIME, 0, 0) / 1000
        self._listened = ListeningTime()
        self._alive = self._framed = 0.0
        self._dead = False

    def _on_emergency(self, problem: Any) -> None:
        """Handle an EMCY; runs in the reader's thread."""
        stated = f"EMCY 0x{problem.code:04X}, register 0x{problem.register:02X}: {problem.get_desc()}"
        self.reader.say(problem.timestamp, stated)

    def _on_heartbeat(self, identifier: int, data: bytearray, stamp: float) -> None:
        """Handle a heartbeat; runs in the reader's thread."""
        self._alive = self._listened.seconds
        if len(data) == 1 and data[0] == 0:
            self.reader.say(time.time(), "the node restarted", RESET)
            self._restarted = True

    def _on_command(self, identifier: int, data: bytearray, stamp: float) -> None:
        """Handle an NMT command of another master; runs in the reader's thread."""
        if len(data) == 2 and data[1] in (0, self.config.node) and data[0] in _SILENCING:
            self.reader.say(stamp, f"another program set the node {_SILENCING[data[0]]}; it sends no more", GAP)

    def start(self) -> None:
        """Set the node operational, so that it sends."""
        self._node.nmt.state = "OPERATIONAL"
        self._started = True
        self._alive = self._framed = self._listened()
        super().start()

    def leave(self, hub: CanHub) -> None:
        """Set the node back to pre-operational, if it was started, and release it."""
        if self._listening:
            hub.network.unsubscribe(_NMT_ID, self._on_command)
        if self._started:
            with contextlib.suppress(Exception):  # the bus may have failed
                self._node.nmt.state = "PRE-OPERATIONAL"
        if self._listening:
            self._node.emcy.callbacks.remove(self._on_emergency)
            hub.network.unsubscribe(_HEARTBEAT_ID + self.config.node, self._on_heartbeat)
        if self._node is not None:
            hub.leave_node(self.config.node, self.config.quantity)
        self._node, self._started, self._listening = None, False, False
        super().leave(hub)

    def read(self, timeout: float) -> Samples | None:
        """Return the new positions or speeds; see `Encoder.read`."""
        block = self.reader.read(timeout)
        now = self._listened()
        if self._restarted:
            self._restarted = False
            self._node.nmt.state = "OPERATIONAL"
        if block is None:
            self._check_alive(now)
            return None
        self._framed = now
        self._check_alive(now)
        speed = self.config.quantity == "speed"
        raw = extract_bits(block.payloads, self._start, self._bits, signed=speed)
        if speed:
            value = raw * (self.config.direction * (self.config.speed_unit or 0.0))
            return Samples.checked(
                self.name, block.time_host, value, time_device=block.time_device, counts=raw, status=block.status
            )
        counts, rolled = unwrap(raw, self._modulus, self._previous, signed=self.config.signed)
        self._previous = int(counts[-1])
        value = counts_to_value(counts, self._counts_per_turn, self.config.direction, self.config.zero)
        return Samples.checked(
            self.name,
            block.time_host,
            value,
            time_device=block.time_device,
            counts=counts,
            status=np.bitwise_or(block.status, rolled * ROLLOVER),
        )

    def _check_alive(self, now: float) -> None:
        """Report a missing heartbeat; raise `EncoderTimeout` if frames are missing too."""
        if not self._heartbeat or not self._started:
            return
        silent = now - self._alive
        late = silent > max(_MISSED_HEARTBEATS * self._heartbeat, 0.2)
        if late and now - self._framed > max(_MISSED_HEARTBEATS * self._heartbeat, 0.2):
            raise EncoderTimeout(f"{self._where}: no heartbeat and no frame for {silent:.2f} s.")
        if late and not self._dead:
            self.reader.say(time.time(), f"no heartbeat for {silent:.2f} s, though frames arrive")
        elif self._dead and not late:
            self.reader.say(time.time(), "the heartbeat is back")
        self._dead = late


def _read_eds(path: Path, node: int) -> Any:
    edge.existing(path)
    if path.suffix.lower() not in (".eds", ".dcf"):
        raise edge.InputError(f"{path}: the ending must be .eds or .dcf.")
    with edge.parsed_by_others(path, "this is not an EDS file"):
        dictionary = canopen.import_od(str(path), node)
    if 0x1A00 not in dictionary:
        raise edge.InputError(f"{path}: this EDS describes no TPDO (0x1A00).")
    return dictionary
