"""Position, velocity and torque of an ODrive, from the cyclic messages that it sends on CAN (CANSimple).

`odrive.dbc` beside this file has the messages as the public documentation states them: identifier 32 times the node
plus the command, float32 in turns, turns/s, ampere and N*m. It has not been tried on a controller.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pydantic

from cycloid_fmu import edge
from drivers.can.bus import time_source
from drivers.can.encoder import CanEncoder
from drivers.can.frames import FrameReader
from drivers.can.hub import CanHub
from drivers.encoder import channel_of
from drivers.lines import BusConfig
from drivers.motor import UNITS, MotorConfig, check_role
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


class OdriveConfig(MotorConfig):
    """A `[channel.X]` with protocol = "odrive".

    Attributes
    ----------
    bus, node
        Name of the bus's table, and number of the axis (`can.node_id`).
    """

    bus: str
    node: Annotated[int, pydantic.Field(ge=0, le=62)]


class OdriveAxis(CanEncoder):
    """One quantity of one axis, which must be set up to send its cyclic message.

    A float32 of turns resolves 0.02 deg after 1,000 turns: let the axis begin near zero.
    """

    configuration = OdriveConfig

    def __init__(self, name: str, config: OdriveConfig, bus: BusConfig) -> None:
        super().__init__(name, config, bus)
        check_role(name, config)
        database = cantools.database.load_string(_DBC.read_text(encoding="utf-8"), "dbc")
        message, signal = _SIGNALS["current" if config.torque_constant is not None else config.quantity]
        self._message = database.get_message_by_name(message)
        self._column = self._message.get_signal_by_name(signal).start // 32

    def set_up(self, hub: CanHub) -> None:
        """See `HubEncoder.set_up`."""
        self.reader = FrameReader(
            hub, self.config.node << 5 | self._message.frame_id, self._message.length, None, self.name
        )
        self.channel = channel_of(
            self.name,
            self.config,
            identity=f"ODrive node {self.config.node}: {self.config.identity}",
            time_source=time_source(self.bus, "frame"),
            unit=UNITS[self.config.quantity],
        )

    def read(self, timeout: float) -> Samples | None:
        """Return the new values; see `Encoder.read`."""
        block = self.reader.read(timeout)
        if block is None:
            return None
        stated: Any = np.ascontiguousarray(block.payloads).view("<f4")[:, self._column].astype(np.float64)
        if self.config.quantity != "torque":
            stated = 2.0 * math.pi * stated
        value = self.config.of_side(stated)
        return Samples.checked(self.name, block.time_host, value, time_device=block.time_device, status=block.status)
