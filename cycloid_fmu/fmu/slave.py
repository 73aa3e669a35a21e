"""The Co-Simulation slaves, of FMI 2.0 on pythonfmu and of FMI 3.0 on pythonfmu3, around the same `Core`.

Both libraries turn an exception into a fatal status with its message, which the library in front of pythonfmu's makes
an error. So exceptions are raised only for what the surrounding program does wrong: a wrong reference, a state of
another FMU, contradictory parameters. A refused step returns an error.
"""

from __future__ import annotations

import atexit
import contextlib
import ctypes
import functools
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar, cast
from xml.etree.ElementTree import Element

from pythonfmu import DefaultExperiment, Fmi2Slave
from pythonfmu.enums import Fmi2Status

from cycloid_fmu import __version__
from cycloid_fmu.fmu.core import Core, state_from_bytes, state_to_bytes
from cycloid_fmu.fmu.description import Version, model_structure, model_variables, token_of, unit_definitions

_Method = TypeVar("_Method", bound=Callable[..., Any])
DESCRIPTION = "Cycloid-pin gear drive: transmission error, backlash and load sharing from its error surface"


def keep_alive(slave: DriveSlave) -> None:
    """Keep the slave alive after an exception, because both libraries then release its references twice."""
    for referent in (slave, type(slave), slave.log_queue):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(referent))


def kept_alive(method: _Method) -> _Method:
    """Decorate a rarely called method so that the slave stays alive after an exception."""

    @functools.wraps(method)
    def guarded(self: DriveSlave, *arguments: Any) -> Any:
        try:
            return method(self, *arguments)
        except Exception:
            keep_alive(self)
            raise

    return cast(_Method, guarded)


@functools.cache
def _release_at_exit(library: Path) -> None:
    """Release a static object early, which both libraries release twice when a Python host on Linux exits."""
    if sys.platform == "linux":
        with contextlib.suppress(OSError, AttributeError):
            atexit.register(ctypes.CDLL(str(library)).finalizePythonInterpreter)


class DriveSlave:
    """Common part of both slaves, a mixin before the libraries' own classes."""

    fmi_version: Version
    log_queue: list[Any]
    core: Core

    def _open(self, resources: str, library: str, experiment: type[Any]) -> None:
        _release_at_exit(Path(resources).parent / "binaries" / library)
        self.core = Core(Path(resources), self.fmi_version)
        self._reals, self._put_all = self.core.reals, self.core.put_all
        self.author, self.license, self.version = "cycloid-fmu", "MIT", __version__
        self.description = f"{DESCRIPTION}; {self.core.summary}"
        step = self.core.interface.step
        self.default_experiment = experiment(start_time=0.0, stop_time=1.0, step_size=step)

    def _put(self, vrs: Sequence[int], values: Sequence[Any], kind: str) -> None:
        for refused in self._put_all(vrs, values, kind):
            self._refuse(refused)

    def _refuse(self, message: str) -> None:
        """Log a refusal."""
        raise NotImplementedError

    @kept_alive
    def setup_experiment(self, start_time: float, *_: float | None) -> None:
        """Store the time at which initialization begins."""
        self.core.clockwork.time = start_time

    @kept_alive
    def enter_initialization_mode(self) -> None:
        """Begin initialization."""
        self.core.begin()

    @kept_alive
    def terminate(self) -> None:
        """Terminate."""
        self.core.end()

    @kept_alive
    def exit_initialization_mode(self) -> None:
        """Settle at the initial inputs, without history."""
        self.core.start()

    @kept_alive
    def _get_fmu_state(self) -> dict[str, Any]:
        return self.core.state()

    @kept_alive
    def _set_fmu_state(self, state: dict[str, Any] | ValueError) -> None:
        if isinstance(state, ValueError):
            raise state
        self.core.restore(state)

    _fmu_state_to_bytes = staticmethod(state_to_bytes)

    @staticmethod
    def _fmu_state_from_bytes(data: bytes) -> dict[str, Any] | ValueError:
        """Return the state or the error: the libraries do not keep alive a slave that raises here."""
        try:
            return state_from_bytes(data)
        except ValueError as problem:
            return problem

    def _described(self, root: Element) -> Element:
        """Replace the parts of a library's model description that come from the table of variables."""
        table = self.core.table
        for tag, element_of in (("ModelVariables", model_variables), ("ModelStructure", model_structure)):
            old = root.find(tag)
            assert old is not None
            root[list(root).index(old)] = element_of(tuple(table.values()), self.fmi_version, tuple(table))
        root.set("generationTool", f"cycloid-fmu {__version__}")
        # The library's token depends on the machine's address and the time; the same drive must give the same bytes.
        del root.attrib["generationDateAndTime"]
        token = token_of(f"{__version__} FMI {self.fmi_version} {self.core.state()['drive']}")
        root.set("guid" if self.fmi_version == "2.0" else "instantiationToken", token)
        position = next(i for i, node in enumerate(root) if node.tag == "CoSimulation")
        root.insert(position + 1, unit_definitions(tuple(table.values())))
        return root


class DriveSlave2(DriveSlave, Fmi2Slave):  # type: ignore[misc]
    """Cycloid-pin gear drive with its manufacturing and assembly errors, FMI 2.0."""

    fmi_version = "2.0"

    def __init__(self, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self._open(self.resources, "linux64/pythonfmu-export.so", DefaultExperiment)

    def _refuse(self, message: str) -> None:
        self.log(message, Fmi2Status.error)

    # A simulation step calls these three; a wrapper around each would take a tenth of its time.
    def do_step(self, current_time: float, step_size: float) -> bool:
        """Make a step; a refused one logs a message and returns False, which the wrapping library makes an error."""
        try:
            refused = self.core.step(current_time, step_size)
        except Exception:
            keep_alive(self)
            raise
        if refused:
            self._refuse(refused)
        return not refused

    def get_real(self, vrs: Sequence[int]) -> list[float]:
        """Return values by reference."""
        try:
            return self._reals(vrs)
        except Exception:
            keep_alive(self)
            raise

    def set_real(self, vrs: Sequence[int], values: Sequence[float]) -> None:
        """Set values by reference."""
        try:
            for refused in self._put_all(vrs, values):
                self._refuse(refused)
        except Exception:
            keep_alive(self)
            raise

    @kept_alive
    def get_integer(self, vrs: Sequence[int]) -> list[int]:
        """Return values by reference."""
        return self.core.values(vrs, "integer")

    @kept_alive
    def get_boolean(self, vrs: Sequence[int]) -> list[bool]:
        """Return values by reference."""
        return self.core.values(vrs, "boolean")

    @kept_alive
    def set_integer(self, vrs: Sequence[int], values: Sequence[int]) -> None:
        """Set values by reference."""
        self._put(vrs, values, "integer")

    @kept_alive
    def set_boolean(self, vrs: Sequence[int], values: Sequence[bool]) -> None:
        """Set values by reference."""
        self._put(vrs, values, "boolean")

    @kept_alive
    def get_string(self, vrs: Sequence[int]) -> list[str]:
        """Refuse; there are no texts."""
        return self.core.values(vrs, "string")

    @kept_alive
    def set_string(self, vrs: Sequence[int], values: Sequence[str]) -> None:
        """Refuse; there are no texts."""
        self._put_all(vrs, values, "string")

    def to_xml(self, model_options: dict[str, str] | None = None) -> Element:
        """Return the model description."""
        return self._described(super().to_xml(model_options or {}))
