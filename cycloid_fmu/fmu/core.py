"""Common part of the slaves of FMI 2.0 and 3.0: model, variables by reference, state.

An invalid value is refused without an exception, which the slaves' library would turn into a fatal status: the value is
not set, a message reports it, and steps are refused until a valid value is set.
"""

from __future__ import annotations

import functools
import hashlib
import io
import json
import math
import re
import struct
import sys
import zlib
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cycloid_fmu import __version__
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.errors.kinds import KINDS
from cycloid_fmu.fmu.compliant_model import CompliantModel
from cycloid_fmu.fmu.description import Version
from cycloid_fmu.fmu.friction import FLANGES, Law
from cycloid_fmu.fmu.friction_file import Friction
from cycloid_fmu.fmu.mesh import StepError
from cycloid_fmu.fmu.model import DriveModel
from cycloid_fmu.fmu.reducer_model import CompliantReducer, ReducerModel
from cycloid_fmu.fmu.variables import ABSOLUTE, ATTRIBUTES, Interface, Variable, stiffness_text, variables
from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.geometry.pair import parse_pair
from cycloid_fmu.surfaces.surface import ErrorSurface

NUMBERS, SURFACE, SUMS = "pair.json", "surface.npz", "SHA256SUMS"
FORMAT = 4  # of the resource files
MAGIC, STATE_VERSION = b"cycloid state\0\0\0", 8
# Phases of an instance as named in messages; the native FMU has the same (native/sources/instance.c).
INSTANTIATED, INITIALIZING, STEPPING, TERMINATED = (
    "before initialization",
    "during initialization",
    "while stepping",
    "after termination",
)
_LARGEST = sys.float_info.max
_HEAD = struct.Struct("<16sII32sQ")  # magic, version, checksum, hash of the resources, length


def sums_of(files: Mapping[str, bytes]) -> bytes:
    """Return the checksums of files, {name: content}, in the format of `sha256sum`."""
    return "".join(f"{hashlib.sha256(data).hexdigest()}  {name}\n" for name, data in files.items()).encode()


def checked_resources(resources: Path) -> dict[str, bytes]:
    """Return the files of an FMU's resources that have a checksum, {name: content}.

    Raises
    ------
    RuntimeError
        If one is missing, can't be read or is damaged; it names the file.
    """

    def read(name: str) -> bytes:
        try:
            return (resources / name).read_bytes()
        except OSError as problem:
            raise RuntimeError(f"{resources / name}: it can't be read: {problem.strerror}") from None

    rows = [line.partition("  ") for line in read(SUMS).decode("ascii", "replace").splitlines()]
    found = {}
    for name in dict.fromkeys((NUMBERS, SURFACE, *(name for _, _, name in rows))):
        found[name] = read(name)
        if (hashlib.sha256(found[name]).hexdigest(), "  ", name) not in rows:
            raise RuntimeError(f"{resources / name}: it is damaged: {SUMS} beside it has another checksum")
    return found


def variables_hash(table: Sequence[Variable]) -> str:
    """Return the fingerprint of the variables in a model description, their order and references included."""
    told = [(v.name, v.kind, v.causality, v.variability, v.dimensions) for v in table]
    return hashlib.sha256(repr(told).encode()).hexdigest()[:16]


def interface_from(numbers: dict[str, Any]) -> Interface:
    """Return the interface that a builder wrote into the resources."""
    made = {name: Friction(**numbers[name]) for name in ("input_friction", "output_friction")}
    return Interface(**{**numbers, **made, "losses": tuple(tuple(row) for row in numbers["losses"])})


def model_of(drive: DriveValue, interface: Interface) -> DriveModel | CompliantModel:
    """Return the model behind an interface."""
    first_stage = drive.first_stage
    model: DriveModel | CompliantModel
    if interface.kind == "compliant":
        inertias = interface.output_inertia, interface.crank_inertia
        if first_stage is None:
            model = CompliantModel(drive, interface.losses, *inertias)
        else:
            model = CompliantReducer(drive, interface.losses, *inertias)
        model.mesh_damping = interface.mesh_damping or 0.0
    elif first_stage is not None:
        model = ReducerModel(drive, interface.losses)
    else:
        model = DriveModel(drive, interface.losses)
    model.series_compliance = interface.series_compliance
    for flange, law in enumerate(interface.laws):
        model.set_friction(flange, **law._asdict())
    return model


class Core:
    """The model and its variables, from an FMU's resources.

    Parameters
    ----------
    resources
        The FMU's folder.
    version
        Version of FMI.

    Attributes
    ----------
    model
        The drive.
    interface
        The interface of the FMU.
    table
        Its variables by reference.
    told
        Its stiffness as text, for the model description.
    faults
        Refused values not yet corrected: {reference of the variable: sentence}.
    phase
        `INSTANTIATED`, `INITIALIZING`, `STEPPING` or `TERMINATED`.

    Raises
    ------
    RuntimeError
        If the resources are damaged, or made for another version of the package.
    """

    def __init__(self, resources: Path, version: Version) -> None:
        files = checked_resources(resources)
        numbers = json.loads(files[NUMBERS])
        built = f"this FMU was built with cycloid-fmu {numbers['package_version']}"
        again = f"installed is {__version__}; build the FMU again or install the other version"
        if numbers.get("format") != FORMAT:
            raise RuntimeError(f"{built} in format {numbers.get('format')}, this reads format {FORMAT}: {again}")
        with np.load(io.BytesIO(files[SURFACE])) as arrays:
            values: dict[str, Any] = {n: arrays[n] if arrays[n].shape else float(arrays[n]) for n in arrays.files}
        pair, stage = parse_pair(numbers["pair"], "the FMU's drive"), numbers.get("first_stage")
        drive = DriveValue(pair, ErrorSurface(pair, **values), None if stage is None else FirstStage(**stage))
        self.interface = interface = interface_from(numbers["interface"])
        self.model = model_of(drive, interface)
        table = variables(drive, interface, version)
        if variables_hash(table) != numbers["variables"]:
            raise RuntimeError(f"{built}, whose variables are others: {again}")
        self.table = dict(enumerate(table))
        self.told = stiffness_text(pair, interface)
        self.phase = INSTANTIATED
        self.faults: dict[int, str] = {}
        self.time = 0.0
        self._hash = hashlib.sha256(files[NUMBERS] + files[SURFACE]).digest()
        accesses = {reference: self._access(variable) for reference, variable in self.table.items()}
        self.getters = {reference: getter for reference, (getter, _) in accesses.items()}
        self._setters = {reference: setter for reference, (_, setter) in accesses.items()}
        # Variables set at each step: setters of scalars with their finite limits.
        self._quick = {
            reference: (setter, -_LARGEST if v.least is None else v.least, _LARGEST if v.most is None else v.most)
            for reference, v in self.table.items()
            if (setter := self._setters[reference]) is not None
            and (v.kind, v.dimensions) == ("real", ())
            and v.variability != "fixed"
        }

    def _access(self, variable: Variable) -> tuple[Callable[[], Any], Callable[[Any], None] | None]:
        model, name = self.model, variable.name
        setter: Callable[[Any], None] | None
        cell = re.fullmatch(r"loss_table\[(\d+),(\d+)\]", name)
        if name == "time":
            return (lambda: self.time), None
        if variable.causality == "local":
            return (lambda: variable.start), None
        if name in model.errors:
            return (lambda: model.errors[name]), functools.partial(model.set_error, name)
        if name in KINDS and KINDS[name].of == "pin":
            return (lambda: model.pin_errors(name)), functools.partial(model.set_pin_errors, name)
        friction = re.fullmatch(r"(input|output)_friction\.(\w+)", name)
        if friction:
            flange, number = FLANGES.index(friction[1]), Law._fields.index(friction[2])
            return (
                (lambda: model.friction[flange][number]),
                (lambda value: model.set_friction(flange, **{friction[2]: value})),
            )
        if cell:
            i, j = int(cell[1]) - 1, int(cell[2]) - 1
            return (lambda: model.loss_table[i][j]), functools.partial(model.set_loss, i, j)
        attribute = (ABSOLUTE if self.interface.support_flange else {}).get(name) or ATTRIBUTES.get(name, name)
        setter = None if variable.causality in ("output", "local") else functools.partial(setattr, model, attribute)
        return functools.partial(getattr, model, attribute), setter

    def of_kind(self, reference: int, kind: str) -> Variable:
        """Return a variable; a `ValueError` if there is none of that kind."""
        variable = self.table.get(reference)
        if variable is None or variable.kind != kind:
            raise ValueError(f"there is no {kind} variable with the value reference {reference}")
        return variable

    def values(self, references: Sequence[int], kind: str) -> list[Any]:
        """Return values of variables of a kind; a `ValueError` if there is none."""
        for reference in references:
            self.of_kind(reference, kind)
        return [self.getters[reference]() for reference in references]

    def put(self, reference: int, value: Any, kind: str | None = None) -> str:
        """Set a variable; return the reason if the value is refused, or "".

        Raises
        ------
        ValueError
            If there is no such variable (of the kind), or it can't be set, or not in this phase.
        """
        if reference not in self.table or kind is not None:
            self.of_kind(reference, kind or "real")
        variable, setter = self.table[reference], self._setters[reference]
        self._check_phase("to set a variable", INSTANTIATED, INITIALIZING, STEPPING)
        if setter is None:
            raise ValueError(f"{variable.name} can't be set: its causality is {variable.causality}")
        if variable.variability == "fixed" and self.phase == STEPPING:
            raise ValueError(f"{variable.name} can't be set after initialization")
        refused = self._refused(variable, value)
        if refused:
            self.faults[reference] = refused
            return refused
        setter(value)
        self.faults.pop(reference, None)
        return ""

    def put_all(self, references: Sequence[int], values: Sequence[Any], kind: str = "real") -> list[str]:
        """Set variables of a kind as `put` does; return the sentences of refused values."""
        refused, quickly, faults = [], self._quick, self.faults
        plain = kind == "real" and not faults and self.phase != TERMINATED
        for reference, value in zip(references, values, strict=True):
            quick = quickly.get(reference) if plain else None
            if quick is not None and quick[1] <= value <= quick[2]:
                quick[0](value)
            elif text := self.put(reference, value, kind):
                refused.append(text)
                plain = False
        return refused

    def _refused(self, variable: Variable, value: Any) -> str:
        """Return the reason why a value is invalid for a variable, or ""."""
        given = tuple(value) if variable.dimensions else (value,)
        least = -math.inf if variable.least is None else variable.least
        most = math.inf if variable.most is None else variable.most
        for one in given:
            if not (least <= one <= most and -math.inf < one < math.inf):
                limits = "it must be finite"
                if variable.least is not None or variable.most is not None:
                    limits += f" and lie between {least:g} and {most:g}"
                return f"{variable.name} = {one:g}: {limits}"
        return ""

    def _check_phase(self, what: str, *allowed: str) -> None:
        if self.phase not in allowed:
            raise ValueError(f"{what} is allowed {allowed[-1]} only, not {self.phase}")

    def begin(self, start: float | None = None) -> None:
        """Begin initialization at a time (s), by default at the present one; a `ValueError` if this is not allowed."""
        self._check_phase("to begin initialization", INSTANTIATED)
        start = self.time if start is None else start
        if not math.isfinite(start):
            raise ValueError(f"the start time is {start:g} s: it must be finite")
        self.time, self.phase = start, INITIALIZING

    def start(self) -> None:
        """Settle at the initial inputs, without history; a `ValueError` if this is not allowed."""
        self._check_phase("to end initialization", INITIALIZING)
        if self.faults:
            raise ValueError("; ".join(self.faults.values()))
        self.model.check()
        self.model.forget_history()
        self.model.advance()
        self.phase = STEPPING

    def step(self, time: float, step: float) -> str:
        """Make a step; return the reason if it is refused, or "". A refused step changes nothing."""
        if self.phase != STEPPING:
            return f"a step is allowed {STEPPING} only, not {self.phase}"
        if self.faults:
            return "no step before this is corrected: " + "; ".join(self.faults.values())
        if not math.isfinite(time):
            return f"a step from the time {time:g} s over {step:g} s: both must be finite"
        try:
            self.model.advance(step)
        except StepError as problem:
            return str(problem)
        self.time = time + step
        return ""

    def end(self) -> None:
        """Terminate; a `ValueError` if this is not allowed."""
        self._check_phase("to terminate", STEPPING)
        self.phase = TERMINATED

    def state(self) -> dict[str, Any]:
        """Return the state as plain values."""
        phase = STEPPING if self.phase == TERMINATED else self.phase
        return {"drive": self._hash.hex(), "time": self.time, "phase": phase, "model": self.model.state()}

    def restore(self, state: dict[str, Any]) -> None:
        """Return to a state; a `ValueError` refuses one of another FMU."""
        if state["drive"] != self._hash.hex():
            raise ValueError("this state belongs to another drive: it was taken from an FMU with other resources")
        self.model.restore(state["model"])
        self.time, self.phase = state["time"], state["phase"]
        self.faults.clear()


def state_to_bytes(state: dict[str, Any]) -> bytes:
    """Return a state as bytes, the same on every machine: magic, version, checksum, drive, length, JSON."""
    body = json.dumps(state, separators=(",", ":")).encode()
    return _HEAD.pack(MAGIC, STATE_VERSION, zlib.crc32(body), bytes.fromhex(state["drive"]), len(body)) + body


def state_from_bytes(data: bytes) -> dict[str, Any]:
    """Return the state in the bytes of `state_to_bytes`.

    Raises
    ------
    ValueError
        If the bytes are not a state, damaged, or of another version; the text is one sentence.
    """
    if len(data) < _HEAD.size or data[: len(MAGIC)] != MAGIC:
        raise ValueError("these bytes are not the state of a cycloid drive")
    _, version, checksum, drive, length = _HEAD.unpack_from(data)
    if version != STATE_VERSION:
        raise ValueError(f"this state has version {version}, this FMU reads version {STATE_VERSION}")
    body = data[_HEAD.size :]
    if len(body) != length or zlib.crc32(body) != checksum:
        raise ValueError("this state is damaged: its checksum does not fit")
    state: dict[str, Any] = json.loads(body)
    if state["drive"] != drive.hex():
        raise ValueError("this state is damaged: it names two drives")
    return state
