"""A signal of a CAN frame described by a DBC file, such as a torque transducer's."""

from __future__ import annotations

import math
import re
import time
from typing import Any

import numpy as np
import numpy.typing as npt

from cycloid_fmu import edge
from drivers.can.bus import SYNC_ID, frame_key, time_source
from drivers.can.encoder import CanEncoder
from drivers.can.frames import FrameReader, Judged
from drivers.can.hub import CanHub
from drivers.counts import Pace, counted, extract_bits, judge_sequence
from drivers.encoder import ChannelConfig, channel_of
from drivers.lines import BusConfig
from drivers.plug_in import Wiring
from drivers.recording_format import DUPLICATE, GAP, OUT_OF_ORDER, FloatArray, IntArray, Samples

with edge.needs_extra("bench"):
    import cantools

_NEWTON_METRE = re.compile(r"([kmu]?)Nm")
_SI = {"torque": "N*m", "input_angle": "rad", "output_angle": "rad"}


class DbcConfig(ChannelConfig):
    """A `[channel.X]` with protocol = "dbc".

    Attributes
    ----------
    bus, file
        Name of the bus's table, and the DBC file.
    message, signal
        Names in the file.
    unit
        Unit of the signal; absent: that of the file.
    sync
        Whether the frame answers every SYNC and gets its time stamp.
    counter
        Signal that counts the frames, by which missing, duplicate and out-of-order frames are detected.
    """

    bus: str
    file: str
    message: str
    signal: str
    unit: str | None = None
    sync: bool = False
    counter: str | None = None


class DbcSensor(CanEncoder):
    """One signal of one frame.

    The channel's name determines the SI unit of the values: "torque" N*m, the two angles rad, others any.

    Raises
    ------
    edge.InputError
        If file, message, signal or unit is missing or unusable.
    """

    configuration = DbcConfig

    def __init__(self, name: str, config: DbcConfig, bus: BusConfig, wiring: Wiring) -> None:
        super().__init__(name, config, bus)
        where = f"{wiring.source}: {wiring.table}"
        path = wiring.folder / config.file
        text = edge.read_text(path)
        with edge.parsed_by_others(path, "this is not a DBC file"):
            database = edge.call_limited(path, cantools.database.load_string, text, "dbc")
        messages = {m.name: m for m in database.messages}
        if config.message not in messages:
            raise edge.InputError(
                f'{where} message = "{config.message}": {path} has no such message; it has {edge.listed(messages)}.'
            )
        self._message = messages[config.message]
        signals = {s.name: s for s in self._message.signals}
        for key in ("signal", "counter"):
            wanted = getattr(config, key)
            if wanted is not None and wanted not in signals:
                raise edge.InputError(
                    f'{where} {key} = "{wanted}": the message {config.message} of {path} has no such signal; '
                    f"it has {edge.listed(signals)}."
                )
        self._counter = signals[config.counter] if config.counter is not None else None
        self._newest: int | None = None
        self._pace, self._last_time, self._missed = Pace(), 0.0, 0
        self._signal = signals[config.signal]
        unit = config.unit or _NEWTON_METRE.sub(r"\1N*m", self._signal.unit or "")
        self._unit = _SI.get(name, unit)
        try:
            self._si = 1.0 if self._unit == unit else edge.unit_scale(unit, self._unit)
        except ValueError as problem:
            sentence = f"{where} unit" if config.unit else f"{path}: the unit of {config.signal}"
            raise edge.InputError(f"{sentence} = {edge.shown(unit)}: {problem}.") from None

    @classmethod
    def from_config(cls, name: str, config: Any, wiring: Wiring) -> DbcSensor:
        """Return the sensor of a `[channel.name]`; see `PlugIn.from_config`."""
        return cls(name, config, wiring.line(BusConfig, config.bus), wiring)

    def set_up(self, hub: CanHub) -> None:
        """See `HubEncoder.set_up`."""
        step = 1 if self.config.sync else None
        fd = bool(self._message.is_fd) or self._message.length > 8
        key = frame_key(self._message.frame_id, extended=self._message.is_extended_frame, fd=fd)
        self.reader = FrameReader(hub, key, self._message.length, step, self.name)
        self.channel = channel_of(
            self.name,
            self.config,
            identity=f"{self.config.file}: {self.config.signal} of {self.config.message}, 0x{self._message.frame_id:X}",
            time_source=time_source(self.bus, f"SYNC 0x{SYNC_ID:03X}" if step else "frame"),
            unit=self._unit,
        )

    @property
    def measuring_range(self) -> tuple[float, float] | None:
        """Smallest and largest value of the signal stated in the file, SI units; None if not stated."""
        if self._signal.minimum is None or self._signal.maximum is None:
            return None
        low, high = sorted(
            self.config.direction * self._si * float(v) for v in (self._signal.minimum, self._signal.maximum)
        )
        return (low, high) if low < high else None

    def read(self, timeout: float) -> Samples | None:
        """Return the new values; see `Encoder.read`."""
        block = self.reader.read(timeout)
        if block is None:
            return None
        decoded, there = self._decoded(block.payloads)
        status = block.status
        if self._counter is not None:
            status = status | self._counted(self._counter, block)
        if not there.any():
            return None
        value = self.config.direction * self._si * decoded[there]
        device = block.time_device
        return Samples.checked(
            self.name,
            block.time_host[there],
            value,
            status=status[there],
            time_device=None if device is None else device[there],
        )

    @property
    def lost(self) -> int:
        """Number of frames known to be lost, from the counter if there is one."""
        return super().lost if self._counter is None else self._missed

    def _counted(self, counter: Any, block: Judged) -> npt.NDArray[np.uint8]:
        """Return the status bits of the frames from their counter, shape (n,)."""
        numbers = _raw(counter, block.payloads)
        times = block.time_host if block.time_device is None else block.time_device
        step = np.diff(times, prepend=self._last_time if self._newest is not None else times[0])
        # Where frames were lost or may have been, the counter may have rolled over.
        assert self.hub is not None, "only an open sensor receives frames"
        unsure = ((block.status & GAP > 0) | (not self.hub.tells_drops)) & ~block.jumped
        period = self._pace.period or math.nan
        expected = np.where(unsure, step / period, np.nan)
        first = self._newest is None
        judged, missing, self._newest = judge_sequence(numbers, 1 << counter.length, self._newest, expected)
        plain = judged == 0
        plain[0] &= not first
        self._pace.add(*step[plain].tolist())
        self._last_time = float(times[-1])
        for which, what in ((missing, "missing"), ((judged & DUPLICATE > 0).astype(np.int64), "duplicated")):
            if which.any():
                sentence = f"{counted(int(which.sum()), 'frame')} {what} by the counter {counter.name}"
                self.reader.say(float(block.time_host[np.flatnonzero(which)[0]]), sentence)
        # A frame out of order was counted as missing before.
        self._missed += int(missing.sum()) - int(np.count_nonzero(judged & OUT_OF_ORDER))
        return judged

    def _decoded(self, payloads: npt.NDArray[np.uint8]) -> tuple[FloatArray, npt.NDArray[np.bool_]]:
        """Return the signal in the file's unit and the mask of frames that contain it (multiplexing), both (n,)."""
        signal = self._signal
        if not (signal.is_multiplexer or signal.multiplexer_ids):
            raw = _raw(signal, payloads)
            number: npt.NDArray[Any] = raw
            if signal.is_float:
                number = raw.astype(f"<i{signal.length // 8}").view(f"<f{signal.length // 8}")
            return number * float(signal.scale) + float(signal.offset), np.ones(len(raw), bool)
        decoded, wrong = np.full(len(payloads), np.nan), 0
        for i, payload in enumerate(payloads):
            try:
                decoded[i] = self._message.decode(payload.tobytes(), decode_choices=False).get(signal.name, np.nan)
            except Exception:  # cantools raises several kinds; only this frame is lost
                wrong += 1
        if wrong:
            self.reader.say(time.time(), f"{wrong} {self.config.message} skipped: it can't be decoded", GAP)
        return decoded, ~np.isnan(decoded)


def _raw(signal: Any, payloads: npt.NDArray[np.uint8]) -> IntArray:
    """Return the raw integers of a signal, shape (n,)."""
    little = signal.byte_order == "little_endian"
    # DBC counts a big-endian start bit from the byte's lowest bit, the field from the byte's highest.
    start = signal.start if little else signal.start // 8 * 8 + 7 - signal.start % 8
    return extract_bits(payloads, start, signal.length, signed=signal.is_signed, little_endian=little)
