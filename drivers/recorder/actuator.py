"""The interface of plug-ins that set torque and speed of a bench for the steps of a sequence."""

from __future__ import annotations

import abc
from types import TracebackType
from typing import TYPE_CHECKING, ClassVar

from drivers.plug_in import PlugIn, PlugInConfig

if TYPE_CHECKING:
    from drivers.recorder.sequence import Step


class ActuatorConfig(PlugInConfig):
    """Keys of every `[actuator]` of a `BENCH.toml`; each protocol adds its own."""


class Actuator(PlugIn):
    """Motor, brake or both of a bench, described by its `[actuator]`: opened at rest, stopped and closed at the end.

    A killed process stops nothing: whatever turns must have its own time limit, in the controller of the drive. A
    controller that stops when its command is not repeated gets it from a thread of the plug-in.
    """

    group = "cycloid.actuators"
    configuration: ClassVar[type[ActuatorConfig]]

    @abc.abstractmethod
    def set(self, step: Step) -> None:
        """Return when speed and torque of a step are reached, or, for a loop, when the input is locked without torque.

        The motion continues until `stop`.

        Raises
        ------
        EncoderError
            If the device refuses or fails.
        """

    @abc.abstractmethod
    def cycle(self, step: Step) -> None:
        """Begin the torque loops of a step that is set and already recorded, and return at once.

        Raises
        ------
        EncoderError
            If the device refuses or fails.
        """

    @abc.abstractmethod
    def stop(self) -> None:
        """Bring the bench to rest; called after each step, also after an error, and allowed at any time."""

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.stop()
        finally:
            self.close()
