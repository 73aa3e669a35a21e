"""What motor controllers state of themselves: position, velocity and torque, of the motor or behind a gear."""

from __future__ import annotations

import math
from typing import Literal

import pydantic

from cycloid_fmu import edge
from drivers.encoder import ChannelConfig
from drivers.recording_format import FloatArray

Quantity = Literal["position", "velocity", "torque"]
UNITS = {"position": "rad", "velocity": "rad/s", "torque": "N*m"}
_ROLES = {"input_angle": ("motor", "position"), "output_angle": ("output", "position"), "torque": ("output", "torque")}


class MotorConfig(ChannelConfig):
    """Keys of every channel of a motor controller.

    Attributes
    ----------
    quantity
        "position", "velocity" or "torque".
    side
        Shaft of which the channel is: "motor", or "output" of the gear. The channel "input_angle" is the motor's
        position, "output_angle" the output's, "torque" that on the output.
    ratio
        Signed turns of this shaft for each turn that the controller states; a torque is divided by it. 1 where the
        controller states this shaft; -39 where it has been set up to state turns of the output and the channel is of
        the motor.
    torque_constant
        Torque of the motor for each ampere of its measured current, such as "0.05 N*m/A"; absent: the controller's own
        estimate of the torque.
    zero
        Angle shown at the zero of the shaft, rad; it is subtracted from a position.
    """

    quantity: Quantity
    side: Literal["motor", "output"]
    ratio: float = 1.0
    torque_constant: str | None = None
    zero: edge.Angle = 0.0

    @pydantic.field_validator("ratio")
    @classmethod
    def _ratio(cls, value: float) -> float:
        if not (math.isfinite(value) and value):
            raise ValueError("write the signed turns of this shaft for each turn that the controller states")
        return value

    @pydantic.field_validator("torque_constant")
    @classmethod
    def _torque_constant(cls, value: str | None) -> str | None:
        if value is not None and not edge.parse_quantity(value, "N*m/A") > 0.0:
            raise ValueError("the torque constant must be above zero")
        return value

    @property
    def identity(self) -> str:
        """What the channel is, for its identity."""
        constant = "" if self.torque_constant is None else f", current x {self.torque_constant}"
        return f"{self.quantity} of the {self.side}{constant}, ratio {self.ratio:g}"

    def of_side(self, stated: FloatArray) -> FloatArray:
        """Return the channel's values, SI units, shape (n,), from what the controller states, SI units or A."""
        if self.quantity != "torque":
            return self.direction * self.ratio * stated - (self.zero if self.quantity == "position" else 0.0)
        constant = 1.0 if self.torque_constant is None else edge.parse_quantity(self.torque_constant, "N*m/A")
        return self.direction * constant / self.ratio * stated


def check_role(name: str, config: MotorConfig) -> None:
    """Raise `edge.InputError` for a channel whose name promises another shaft or quantity."""
    side, quantity = _ROLES.get(name, (config.side, config.quantity))
    if (config.side, config.quantity) != (side, quantity):
        raise edge.InputError(
            f'side = "{config.side}", quantity = "{config.quantity}": the channel {name} is the {quantity} of the '
            f"{side}; name it otherwise, such as {config.side}_{config.quantity}."
        )
    if config.torque_constant is not None and config.quantity != "torque":
        raise edge.InputError(f'torque_constant belongs to quantity = "torque", not "{config.quantity}".')
