"""Position, velocity and torque of a motor that SimpleFOC drives, from the lines of its serial monitor.

`motor.monitor()` of the Arduino library prints the chosen variables in a fixed order, separated by tabs, with currents
in mA, velocity in rad/s and angle in rad (public documentation). It has not been tried on a controller.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Literal

import pydantic

from cycloid_fmu import edge
from drivers.encoder import ChannelConfig
from drivers.encoders.ascii import AsciiConfig, AsciiCounter
from drivers.lines import PortConfig
from drivers.motor import UNITS, MotorConfig, check_role
from drivers.recording_format import Samples
from drivers.serial.port import PortHub

_ORDER = ("target", "voltage_q", "voltage_d", "current_q", "current_d", "velocity", "angle")
_SHOWN = {"position": "angle", "velocity": "velocity", "torque": "current_q"}


class SimplefocConfig(MotorConfig):
    """A `[channel.X]` with protocol = "simplefoc".

    Attributes
    ----------
    port
        Name of the port's table, which several channels may name.
    variables
        What `motor.monitor_variables` chooses: any of "target", "voltage_q", "voltage_d", "current_q", "current_d",
        "velocity" and "angle", in the library's order.
    """

    port: str
    variables: list[Literal["target", "voltage_q", "voltage_d", "current_q", "current_d", "velocity", "angle"]]

    @pydantic.field_validator("variables")
    @classmethod
    def _in_order(cls, value: list[str]) -> list[str]:
        if value != [name for name in _ORDER if name in value]:
            raise ValueError(f"write each once, in the order that the library prints: {', '.join(_ORDER)}")
        return value


class SimplefocMotor(AsciiCounter):
    """One quantity of a motor. Lines have no time and no number: their arrival is the time, losses are estimated.

    A torque needs `torque_constant`: it is the measured current of the q axis times this.
    """

    configuration, cyclic = SimplefocConfig, True

    def __init__(self, name: str, config: SimplefocConfig, port: PortConfig) -> None:
        check_role(name, config)
        wanted = _SHOWN[config.quantity]
        if wanted not in config.variables:
            raise edge.InputError(f'variables lacks "{wanted}", which quantity = "{config.quantity}" needs.')
        if config.quantity == "torque" and config.torque_constant is None:
            raise edge.InputError("torque_constant is missing: the monitor states a current.")
        unit = UNITS[config.quantity]
        line = "\t".join("{value}" if variable == wanted else variable for variable in config.variables)
        plain = {key: getattr(config, key) for key in ChannelConfig.model_fields}
        super().__init__(name, AsciiConfig(**plain, port=config.port, line=line, unit=unit), port)
        self.motor = config
        self.where = f'{name}: SimpleFOC on "{port.url}"'
        columns = [rb"([+-]?\d+\.?\d*)" if name == wanted else rb"[^\t\r\n]+" for name in config.variables]
        self._pattern, self._unit = re.compile(rb"\t".join(columns)), unit

    def set_up(self, hub: PortHub) -> None:
        """See `HubEncoder.set_up`."""
        super().set_up(hub)
        self.channel = dataclasses.replace(self.channel, identity=f"SimpleFOC: {self.motor.identity}")

    def read(self, timeout: float) -> Samples | None:
        """Return the samples of the new lines; see `Encoder.read`."""
        samples = super().read(timeout)
        if samples is None:
            return None
        stated = self.config.direction * samples.value  # as printed: the motor's table has direction, ratio and zero
        value = self.motor.of_side(stated * 1e-3 if self.motor.quantity == "torque" else stated)
        return dataclasses.replace(samples, value=value)
