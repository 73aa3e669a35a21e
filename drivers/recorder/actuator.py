"""The interface of plug-ins that set torque and speed of a bench for the steps of a sequence."""

from __future__ import annotations

import abc
from types import TracebackType
from typing import TYPE_CHECKING, Any, ClassVar, Self

from cycloid_fmu import edge
from drivers.encoder import Wiring
from drivers.lines import LineConfig

if TYPE_CHECKING:
    from drivers.recorder.sequence import Step

ENTRY_POINTS = "cycloid.actuators"


class ActuatorConfig(edge.Config):
    """Keys of every `[actuator]` of a `BENCH.toml`: the name of its protocol; each protocol adds its own."""

    protocol: str


class Actuator(abc.ABC):
    """Motor, brake or both of a bench; a context manager that opens it, and stops and closes it at the end.

    A killed process stops nothing: whatever turns must have its own time limit, in the controller of the drive. A
    controller that stops when its command is not repeated gets it from a thread of the plug-in.

    Attributes
    ----------
    configuration
        The keys of `[actuator]`.
    line
        The table of a line that it needs, see `LineConfig`, which it may share with encoders; None: there is none.
    """

    configuration: ClassVar[type[ActuatorConfig]]
    line: ClassVar[type[LineConfig] | None] = None

    @classmethod
    @abc.abstractmethod
    def from_config(cls, config: Any, wiring: Wiring) -> Self:
        """Return the actuator that `[actuator]` describes, not yet opened.

        Raises
        ------
        edge.InputError
            If it names a line or file that does not exist.
        """

    @abc.abstractmethod
    def __enter__(self) -> Self:
        """Open the device, at rest.

        Raises
        ------
        EncoderError
            If it does not answer.
        """

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

    @abc.abstractmethod
    def close(self) -> None:
        """Release the device; closing twice is allowed."""

    def __exit__(
        self, kind: type[BaseException] | None, problem: BaseException | None, trace: TracebackType | None
    ) -> None:
        try:
            self.stop()
        finally:
            self.close()
