"""Position, velocity and torque of an ODrive, from the cyclic messages that it sends on CAN (CANSimple).

`odrive.dbc` beside this file has the messages as the public documentation states them: identifier 32 times the node
plus the command, float32 in turns, turns/s, ampere and N*m. It has not been tried on a controller.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import numpy as np
import pydantic

from cycloid_fmu import edge
from drivers.can.frames import FrameReader
from drivers.can.hub import CanHub
from drivers.can.motor import CanMotor
from drivers.encoder import ListeningTime
from drivers.lines import BusConfig
from drivers.motor import MotorConfig
from drivers.recording_format import Samples

with edge.needs_extra("bench"):
    import cantools

_DBC = Path(__file__).with_name("odrive.dbc")
_SIGNALS = {
    "position": ("Get_Encoder_Estimates", "Pos_Estimate"),
    "velocity": ("Get_Encoder_Estimates", "Vel_Estimate"),
    "torque": ("Get_Torques", "Torque_Estimate"),
    "current": ("Get_Iq", "Iq_Measured"),
}


_SILENCE = 1.0  # s without a message that are reported while they last


class OdriveConfig(MotorConfig):
    """A `[channel.X]` with protocol = "odrive".

    Attributes
    ----------
    bus, node
        Name of the bus's table, and number of the axis (`can.node_id`).
    period
        Interval of the cyclic message, s, as set up in the axis (`encoder_msg_rate_ms` and others); absent: the usual
        interval of its messages.
    """

    bus: str
    node: Annotated[int, pydantic.Field(ge=0, le=62)]
    period: Annotated[edge.Seconds, pydantic.Field(ge=1e-3)] | None = None


class OdriveAxis(CanMotor):
    """One quantity of one axis, which must be set up to send its cyclic message.

    Messages have no number: those lost are counted by their interval. A float32 of turns resolves 0.02 deg after 1,000
    turns: let the axis begin near zero.
    """

    configuration = OdriveConfig

    def __init__(self, name: str, config: OdriveConfig, bus: BusConfig) -> None:
        super().__init__(name, config, bus)
        database = cantools.database.load_string(_DBC.read_text(encoding="utf-8"), "dbc")
        message, signal = _SIGNALS[self.stated]
        self._message = database.get_message_by_name(message)
        self._column = self._message.get_signal_by_name(signal).start // 32

    def set_up(self, hub: CanHub) -> None:
        """Wait for the cyclic message; see `HubEncoder.set_up`."""
        key = self.config.node << 5 | self._message.frame_id
        period, length = self.config.period, self._message.length
        reader = FrameReader(hub, key, length, None, self.name, period, cyclic=True)
        self.listen(reader, f"ODrive node {self.config.node}", self._message.name)
        self._listened, self._heard = ListeningTime(), 0.0

    def read(self, timeout: float) -> Samples | None:
        """Return the new values; see `Encoder.read`."""
        block, now = self.reader.read(timeout), self._listened()
        if block is None:
            if now - self._heard > _SILENCE:
                self.reader.say(time.time(), f"no {self._message.name} for {now - self._heard:.1f} s")
                self._heard = float("inf")  # reported once
            return None
        self._heard = now
        stated = np.ascontiguousarray(block.payloads).view("<f4")[:, self._column].astype(np.float64)
        return self.samples(block, stated, block.status)
