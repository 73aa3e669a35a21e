"""The drive in time with its exact contacts: the model of the native FMU, in C, on the contact problem itself.

The C sources in this folder hold the model; here are its variables by name and by reference, its errors, which
make another contact problem when they change, and its state.
"""

from __future__ import annotations

import ctypes
import dataclasses
import functools
import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.errors.kinds import KINDS, names_of
from cycloid_fmu.fmu.description import Version
from cycloid_fmu.fmu.exact_contacts import ExactContacts, exact_contacts
from cycloid_fmu.fmu.library import library_path, this_platform
from cycloid_fmu.fmu.table_file import described
from cycloid_fmu.fmu.variables import Interface, Variable, variables
from cycloid_fmu.surfaces.structured import structured_value

_MOST_BLOCKS = 16  # of `exact_contacts.h`
_OF_PINS = ("pin_force", "pin_pressure")


class StepError(ValueError):
    """A step that can't be made; the text is one sentence."""


class _Problem(ctypes.Structure):
    """`struct exact_problem`."""

    _fields_ = (
        ("solve", ctypes.c_void_p),
        ("box", ctypes.c_ssize_t),
        ("counts", ctypes.c_uint64 * 2),
        ("blocks", ctypes.c_void_p * _MOST_BLOCKS * 2),
        ("sizes", ctypes.c_uint64 * _MOST_BLOCKS * 2),
        *((name, ctypes.c_double) for name in ("ratio", "period", "tangent", "stiffness", "free_energy")),
    )


def _described_problem(contacts: ExactContacts, ratio: float, period: float) -> _Problem:
    problem = _Problem(contacts.callback.address, contacts.address)
    for group, arrays in enumerate((contacts.loaded, contacts.play)):
        problem.counts[group] = len(arrays)
        for i, array in enumerate(arrays):
            problem.blocks[group][i], problem.sizes[group][i] = array.ctypes.data, array.nbytes
    problem.ratio, problem.period, problem.tangent = ratio, period, contacts.tangent
    problem.stiffness, problem.free_energy = contacts.stiffness, contacts.free_energy
    return problem


@functools.cache
def _library() -> ctypes.CDLL:
    """Return the C library of this platform."""
    library = ctypes.CDLL(str(library_path(this_platform())))
    pointer, size = ctypes.c_void_p, ctypes.c_size_t
    for function, result, arguments in (
        ("open", pointer, (pointer, size, pointer)),
        ("close", None, (pointer,)),
        ("message_size", size, ()),
        ("solve", ctypes.c_int, (pointer, pointer)),
        ("set_time", None, (pointer, ctypes.c_double)),
        ("time", ctypes.c_double, (pointer,)),
        ("start", ctypes.c_int, (pointer,)),
        ("step", ctypes.c_int, (pointer, ctypes.c_double, ctypes.c_double)),
        ("get", ctypes.c_int, (pointer, pointer)),
        ("set", ctypes.c_int, (pointer, pointer)),
        ("state_size", size, (pointer,)),
        ("state", None, (pointer, pointer)),
        ("restore", ctypes.c_int, (pointer, pointer, size)),
    ):
        entry = getattr(library, f"clockwork_{function}")
        entry.restype, entry.argtypes = result, arguments
    return library


class Group(ctypes.Structure):
    """Memory for values of some variables: `struct exchanged` of `clockwork.c`."""

    _fields_ = (("_references", ctypes.c_void_p), ("_values", ctypes.c_void_p), ("_count", ctypes.c_size_t))

    def __init__(self, references: Sequence[int]) -> None:
        count = len(references)
        self.values, self._memory = (ctypes.c_double * count)(), (ctypes.c_uint32 * count)(*references)
        super().__init__(ctypes.addressof(self._memory), ctypes.addressof(self.values), count)
        self.address = ctypes.addressof(self)


class Clockwork:
    """A drive in time: inputs and parameters in, outputs with their history out; stepped by `advance`.

    Angles are rad, torques N·m, everything else SI as its variable states it.

    Parameters
    ----------
    drive
        The drive. Behind a first stage the driven shaft is the sun.
    interface
        The interface, with all its values (`fmu.build.completed`).
    version
        Version of FMI; with "3.0" there are variables of single pins.

    Attributes
    ----------
    table
        Its variables by reference.
    references
        References by name.
    """

    def __init__(self, drive: DriveValue, interface: Interface, version: Version = "3.0") -> None:
        self._stage = self._as_built = drive.stage
        self.table: dict[int, Variable] = dict(enumerate(variables(drive, interface, version)))
        self.references = {v.name: reference for reference, v in self.table.items()}
        pair = drive.pair
        self._period = 2.0 * math.pi * (pair.gear_teeth if pair.output == "gear" else pair.pins)
        self._stated = self._structured()
        self.errors = dict(self._stated)
        self.pin_arrays: dict[str, list[float]] = {}
        self._own = {reference: v.name for reference, v in self.table.items() if v.name in self.errors or v.dimensions}
        self._singles: dict[int, Group] = {}
        self._contacts: ExactContacts | None = None
        library = _library()
        self._get, self._set, self._step = library.clockwork_get, library.clockwork_set, library.clockwork_step
        self._close = library.clockwork_close  # at the end of the process this module may be gone before its drives
        self._message = ctypes.create_string_buffer(library.clockwork_message_size())
        own = {r: dataclasses.replace(v, start=0.0, baked=True) if r in self._own else v for r, v in self.table.items()}
        file = described(interface, own, pair.ratio, self._period, drive.first_stage)
        self._handle = library.clockwork_open(file, len(file), ctypes.addressof(self._message))
        if not self._handle:
            raise MemoryError("there is not enough memory for the drive")

    def __del__(self) -> None:
        if getattr(self, "_handle", None):
            self._close(self._handle)

    @property
    def _text(self) -> str:
        return self._message.value.decode().removesuffix(".")

    # ---- errors ----

    def _structured(self) -> dict[str, float]:
        return {name: structured_value(self._stage.surface, name) for name in names_of(self._stage.pair)}

    def _with_errors(self) -> DriveValue:
        changed = {n: v for n, v in self.errors.items() if v != self._stated[n]}
        return self._stage.with_structured(changed)

    def _set_error(self, name: str, value: float) -> None:
        if self.errors[name] != value:
            self.errors = {**self.errors, name: value}
            self._contacts = None

    def pin_errors(self, name: str) -> list[float]:
        """Return the errors of each pin for a kind of pin errors, m, with structured errors set since."""
        values: list[float] = getattr(self._with_errors().surface, name).tolist()
        return values

    def _set_pin_errors(self, name: str, values: Sequence[float]) -> None:
        """Set the errors of each pin (m); the structured errors are updated."""
        if list(values) != self.pin_errors(name):
            self._put_pin_errors({**self.pin_arrays, name: list(values)})
            self.errors = {**self.errors, **{n: v for n, v in self._stated.items() if n.startswith(f"{name}_")}}
            self._contacts = None

    def _put_pin_errors(self, arrays: Mapping[str, Sequence[float]]) -> None:
        self.pin_arrays = {name: list(values) for name, values in arrays.items()}
        given: dict[str, Any] = {name: np.array(values) for name, values in self.pin_arrays.items()}
        self._stage = self._as_built.with_surface(self._as_built.surface.replace(**given))
        self._stated = self._structured()

    def _solve(self) -> ExactContacts:
        """Return the contacts for the present errors."""
        if self._contacts is None:
            contacts = exact_contacts(self._with_errors())
            problem = _described_problem(contacts, self._stage.pair.ratio, self._period)
            if _library().clockwork_solve(self._handle, ctypes.addressof(problem)):
                raise MemoryError("there is not enough memory for the contacts")
            self._contacts = contacts
        return self._contacts

    # ---- variables ----

    def group(self, references: Sequence[int]) -> Group | None:
        """Return memory for variables by reference; None if one of them is an error or of single pins."""
        return None if any(reference in self._own for reference in references) else Group(references)

    def read(self, group: Group) -> list[float]:
        """Return the values of a group; a `StepError` if there is none at these inputs."""
        if self._contacts is None:
            self._solve()
        if self._get(self._handle, group.address):
            raise StepError(self._text)
        return group.values[:]

    def write(self, group: Group, values: Sequence[float]) -> bool:
        """Set the values of a group in turn, up to the first that is refused; return whether none is."""
        group.values[:] = values  # type: ignore[call-overload]
        return not self._set(self._handle, group.address)

    def value(self, reference: int) -> Any:
        """Return a variable by reference: its kind of number, or a list row by row; a `StepError` if there is none."""
        name, kind = self._own.get(reference), self.table[reference].kind
        if name is None:
            (value,) = self.read(self._single(reference))
            return value if kind == "real" else int(value) if kind == "integer" else bool(value)
        if name in self.errors:
            return self.errors[name]
        if name in KINDS:
            return self.pin_errors(name)
        pressed = self.get("contact_count") > 0  # its solution is that of the pins
        shared = self._solve().shared[_OF_PINS.index(name)]
        return shared.ravel().tolist() if pressed else [0.0] * shared.size

    def put(self, reference: int, value: Any) -> str:
        """Set a variable by reference, those of pins by a list; return the reason if the value is refused, or ""."""
        name = self._own.get(reference)
        if name is None:
            return "" if self.write(self._single(reference), (value,)) else self._text
        variable = self.table[reference]
        least, most = variable.least, variable.most
        if least is None or most is None:
            return f"{variable.name} can't be set: it is an output"
        for number in value if variable.dimensions else (value,):
            if not least <= number <= most:
                return f"{variable.name} = {number:g}: it must be finite and lie between {least:g} and {most:g}"
        if name in self.errors:
            self._set_error(name, value)
        else:
            self._set_pin_errors(name, value)
        return ""

    def _single(self, reference: int) -> Group:
        group = self._singles.get(reference)
        if group is None:
            group = self._singles[reference] = Group((reference,))
        return group

    def get(self, name: str) -> Any:
        """Return a variable by its name, as `value`."""
        return self.value(self.references[name])

    def set(self, name: str, value: Any) -> None:
        """Set a variable by its name; a `ValueError` with one sentence if the value is refused."""
        refused = self.put(self.references[name], value)
        if refused:
            raise ValueError(refused)

    # ---- time ----

    @property
    def time(self) -> float:
        """Present time, s: that at the end of the last step."""
        return float(_library().clockwork_time(self._handle))

    @time.setter
    def time(self, time: float) -> None:
        _library().clockwork_set_time(self._handle, time)

    def start(self) -> None:
        """Settle at the present inputs, without history; a `ValueError` if that is impossible."""
        self._solve()
        if _library().clockwork_start(self._handle):
            raise StepError(self._text)

    def advance(self, time: float, step: float) -> str:
        """Make a step (s) from a time (s); return the reason if it is refused, or "": then nothing is changed."""
        if self._contacts is None:
            self._solve()
        return self._text if self._step(self._handle, time, step) else ""

    # ---- state ----

    def state(self) -> dict[str, Any]:
        """Return the state: errors, and the rest as bytes."""
        self._solve()
        bytes_ = ctypes.create_string_buffer(_library().clockwork_state_size(self._handle))
        _library().clockwork_state(self._handle, ctypes.addressof(bytes_))
        return {"errors": dict(self.errors), "pin_arrays": dict(self.pin_arrays), "memory": bytes_.raw}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Return to a state; a `ValueError` with one sentence if it is of another drive."""
        if state["pin_arrays"] != self.pin_arrays:
            self._put_pin_errors(state["pin_arrays"])
            self._contacts = None
        if state["errors"] != self.errors:
            self.errors = dict(state["errors"])
            self._contacts = None
        self._solve()
        memory = state["memory"]
        if _library().clockwork_restore(self._handle, memory, len(memory)):
            raise ValueError(self._text)
