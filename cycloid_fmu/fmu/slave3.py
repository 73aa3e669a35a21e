"""The FMI 3.0 Co-Simulation slave, on pythonfmu3."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any
from xml.etree.ElementTree import Element

from pythonfmu3 import DefaultExperiment, Fmi3Slave, Fmi3StepResult
from pythonfmu3.enums import Fmi3Status

from cycloid_fmu.fmu.slave import DriveSlave, kept_alive


class DriveSlave3(DriveSlave, Fmi3Slave):  # type: ignore[misc]
    """Cycloid-pin gear drive with its manufacturing and assembly errors, FMI 3.0."""

    fmi_version = "3.0"

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._open(self.resources, "x86_64-linux/CycloidDrive.so", DefaultExperiment)

    def _refuse(self, message: str) -> None:
        self.log(message, Fmi3Status.error)

    @kept_alive
    def do_step(self, current_time: float, step_size: float) -> Fmi3StepResult:
        """Make a step; a refused one logs a message and returns an error."""
        refused = self.core.step(current_time, step_size)
        if refused:
            self._refuse(refused)
        return Fmi3StepResult(Fmi3Status.error if refused else Fmi3Status.ok)

    @kept_alive
    def get_float64(self, vrs: Sequence[int]) -> list[float]:
        """Return values by reference, those of arrays row by row."""
        return self._flat(vrs, "real")

    @kept_alive
    def get_int32(self, vrs: Sequence[int]) -> list[int]:
        """Return values by reference."""
        return self._flat(vrs, "integer")

    @kept_alive
    def get_boolean(self, vrs: Sequence[int]) -> list[bool]:
        """Return values by reference."""
        return self._flat(vrs, "boolean")

    def _flat(self, vrs: Sequence[int], kind: str) -> list[Any]:
        flat: list[Any] = []
        for value in self.core.values(vrs, kind):
            flat += value if isinstance(value, list) else (value,)
        return flat

    @kept_alive
    def set_float64(self, vrs: Sequence[int], values: Sequence[Any]) -> None:
        """Set values by reference, those of arrays row by row."""
        given: list[Any] = []
        first = 0
        for v in vrs:
            last = first + math.prod(self.core.of_kind(v, "real").dimensions)
            given.append(values[first:last] if self.core.table[v].dimensions else values[first])
            first = last
        self._put(vrs, given, "real")

    @kept_alive
    def set_int32(self, vrs: Sequence[int], values: Sequence[int]) -> None:
        """Set values by reference."""
        self._put(vrs, values, "integer")

    @kept_alive
    def set_boolean(self, vrs: Sequence[int], values: Sequence[bool]) -> None:
        """Set values by reference."""
        self._put(vrs, values, "boolean")

    @kept_alive
    def _get_none(self, vrs: Sequence[int]) -> list[Any]:
        return self.core.values(vrs, "such")

    @kept_alive
    def _set_none(self, vrs: Sequence[int], values: Sequence[Any]) -> None:
        self._put(vrs, values, "such")

    # There are no variables of these types.
    get_int64 = get_uint64 = get_string = _get_none
    set_int64 = set_uint64 = set_string = _set_none

    def to_xml(self, model_options: dict[str, str] | None = None) -> Element:
        """Return the model description."""
        root = self._described(super().to_xml(model_options or {}))
        simulation = root.find("CoSimulation")
        assert simulation is not None
        simulation.set("canHandleVariableCommunicationStepSize", "true")
        return root
