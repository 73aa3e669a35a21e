"""Common base of motor controllers on a CAN bus."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from drivers.can.bus import time_source
from drivers.can.encoder import CanEncoder
from drivers.can.frames import FrameReader, Judged
from drivers.encoder import EncoderTimeout, channel_of
from drivers.lines import BusConfig
from drivers.motor import UNITS, MotorConfig, check_role
from drivers.recording_format import FloatArray, Samples

_ANSWER_SECONDS = 1.0


class CanMotor(CanEncoder):
    """One quantity of a motor controller, which states turns, turns/s, N*m and A."""

    def __init__(self, name: str, config: MotorConfig, bus: BusConfig) -> None:
        super().__init__(name, config, bus)
        check_role(name, config)
        self.stated = "current" if config.torque_constant is not None else config.quantity

    def listen(self, reader: FrameReader, device: str, what: str, ask: Callable[[], None] = lambda: None) -> None:
        """Wait for the first frame, and describe the channel.

        Parameters
        ----------
        reader
            Reader of its frames.
        device, what
            The controller, such as "moteus 3", and its frames, for messages.
        ask
            Requests a frame.

        Raises
        ------
        EncoderTimeout
            If no frame comes.
        """
        self.reader = reader
        deadline = time.monotonic() + _ANSWER_SECONDS
        while True:
            ask()
            block = reader.read(0.1)
            if block is not None and self.valid(block).any():
                break
            if time.monotonic() > deadline:
                raise EncoderTimeout(
                    f"{self.name}: {device} on the CAN bus {self.bus.address} sends no {what}; is it powered, and are "
                    "its number, its set-up and the bit rate right?"
                )
        self.channel = channel_of(
            self.name,
            self.config,
            identity=f"{device}: {self.config.identity}",
            time_source=time_source(self.bus, what),
            unit=UNITS[self.config.quantity],
        )

    def valid(self, block: Judged) -> Any:
        """Return the mask of the frames that have the quantity, shape (n,)."""
        return np.ones(len(block.status), np.bool_)

    def samples(self, block: Judged, stated: FloatArray, status: Any) -> Samples:
        """Return the samples of frames with these values and status bits, shape (n,)."""
        scale = 1.0 if self.config.quantity == "torque" else 2.0 * math.pi
        value = self.config.of_side(scale * stated)
        return Samples.checked(self.name, block.time_host, value, time_device=block.time_device, status=status)
