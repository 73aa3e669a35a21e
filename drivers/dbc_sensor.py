"""A signal of a CAN frame that a DBC file describes, such as a torque transducer's."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any, Self

import cantools
import numpy as np

from cycloid_fmu import edge
from drivers.can_hub import SYNC_ID, CanHub, FrameReader, acquire_hub, release_hub
from drivers.encoder import BusConfig, ChannelConfig, Encoder, EncoderProtocolError, Wiring, extract_bits, role_of
from drivers.recording_format import Channel, Event, FloatArray, Samples

_NEWTON_METRE = re.compile(r"([kmu]?)Nm")
_SI = {"torque": "N*m", "input_angle": "rad", "output_angle": "rad"}


class DbcConfig(ChannelConfig):
    """A `[channel.X]` with protocol = "dbc"; `unit` overrules the file's, `sync`: the frame answers every SYNC."""

    bus: str
    file: str
    message: str
    signal: str
    unit: str | None = None
    sync: bool = False


class DbcSensor(Encoder):
    """One signal of one frame.

    Parameters
    ----------
    name
        Name of the channel; it says the SI unit that the signal must have: "torque" N*m, the angles rad, others any.
    config
        File, message, signal.
    bus
        The bus.
    folder
        What `config.file` is relative to.
    source
        The `BENCH.toml`, for errors.

    Raises
    ------
    edge.InputError
        If file, message, signal or unit are not there or can't be used.
    """

    configuration = DbcConfig

    def __init__(self, name: str, config: DbcConfig, bus: BusConfig, folder: Path, source: str) -> None:
        self.name, self.config, self.bus = name, config, bus
        self._hub: CanHub | None = None
        self._reader: FrameReader | None = None
        where = f"{source}: [channel.{name}]"
        path = folder / config.file
        text = edge.read_text(path)
        try:
            database = cantools.database.load_string(text, "dbc")
        except Exception as problem:  # cantools raises its parser's and its own
            said = str(problem).splitlines()[0] if str(problem) else type(problem).__name__
            raise edge.InputError(f"{path}: this is not a DBC file: {said}.") from None
        messages = {m.name: m for m in database.messages}
        if config.message not in messages:
            raise edge.InputError(
                f'{where} message = "{config.message}": {path} has no such message; it has {", ".join(messages)}.'
            )
        self._message = messages[config.message]
        signals = {s.name: s for s in self._message.signals}
        if config.signal not in signals:
            raise edge.InputError(
                f'{where} signal = "{config.signal}": the message {config.message} of {path} has no such signal; '
                f"it has {', '.join(signals)}."
            )
        if self._message.length > 8:
            raise edge.InputError(
                f"{where} message: frames of {self._message.length} bytes can't be read, only up to 8."
            )
        self._signal = signals[config.signal]
        unit = config.unit or _NEWTON_METRE.sub(r"\1N*m", self._signal.unit or "")
        self._unit = _SI.get(name, unit)
        try:
            self._si = 1.0 if self._unit == unit else edge.unit_scale(unit, self._unit)
        except ValueError as problem:
            raise edge.InputError(f'{where} unit = "{unit}": {problem}.') from None

    @classmethod
    def from_config(cls, name: str, config: Any, wiring: Wiring) -> DbcSensor:
        """Return the sensor of a `[channel.name]`; see `Encoder.from_config`."""
        return cls(name, config, wiring.bus(config.bus, name), wiring.folder, wiring.source)

    def __enter__(self) -> Self:
        """Open the bus; see `Encoder.__enter__`."""
        self._hub = acquire_hub(self.bus)
        step = 1 if self.config.sync else None
        self._reader = FrameReader(self._hub, self._message.frame_id, self._message.length, step, self.name)
        stamp = f"SYNC 0x{SYNC_ID:03X}" if step else "frame"
        self.channel = Channel(
            name=self.name,
            role=role_of(self.name),
            protocol="dbc",
            unit=self._unit,
            counts_per_turn=None,
            direction=self.config.direction,
            zero=0.0,
            zero_reference=self.config.zero_reference,
            identity=f"{self.config.file}: {self.config.signal} of {self.config.message}, 0x{self._message.frame_id:X}",
            time_source=f"host clock: the CAN interface's stamp of the {stamp} ({self.bus.interface})",
        )
        return self

    def close(self) -> None:
        """Release the bus."""
        hub, self._hub = self._hub, None
        if hub is not None and self._reader is not None:
            self._reader.close()
            release_hub(hub)

    def read(self, timeout: float) -> Samples | None:
        """Return the values that came; see `Encoder.read`."""
        assert self._reader is not None, "read() is for a sensor that is open"
        block = self._reader.read(timeout)
        if block is None:
            return None
        payloads, stamps, status = block
        value = self.config.direction * self._si * self._decoded(payloads)
        return Samples.checked(self.name, stamps, value, status=status)

    def _decoded(self, payloads: np.ndarray[Any, np.dtype[np.uint8]]) -> FloatArray:
        """Return the signal in the file's unit, shape (n,)."""
        signal = self._signal
        if signal.is_float or signal.is_multiplexer or signal.multiplexer_ids:
            length = self._message.length
            try:
                decoded = [self._message.decode(bytes(p[:length]), decode_choices=False) for p in payloads]
                return np.array([d[signal.name] for d in decoded], np.float64)
            except Exception as problem:
                raise EncoderProtocolError(
                    f"{self.name}: {self.config.message} can't be decoded: {problem}."
                ) from problem
        little = signal.byte_order == "little_endian"
        # DBC counts a big-endian start bit from the byte's lowest bit, the field from the byte's highest.
        start = signal.start if little else signal.start // 8 * 8 + 7 - signal.start % 8
        raw = extract_bits(payloads, start, signal.length, signed=signal.is_signed, little_endian=little)
        return np.asarray(raw * float(signal.scale) + float(signal.offset), np.float64)

    def events(self) -> list[Event]:
        """Return gaps and skipped frames; see `Encoder.events`."""
        return self._reader.events() if self._reader is not None else []
