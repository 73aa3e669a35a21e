"""Common part of the slaves of FMI 2.0 and 3.0: the drive in time, its phases, refused values and its state.

An invalid value is refused without an exception, which the slaves' library would turn into a fatal status: the value is
not set, a message reports it, and steps are refused until a valid value is set.
"""

from __future__ import annotations

import base64
import hashlib
import io
import json
import math
import struct
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cycloid_fmu import __version__
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.clockwork import Clockwork, Group
from cycloid_fmu.fmu.description import Version
from cycloid_fmu.fmu.friction_file import Friction
from cycloid_fmu.fmu.variables import ADDED, Interface, Variable, stiffness_text
from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.geometry.pair import parse_pair
from cycloid_fmu.surfaces.surface import ErrorSurface

NUMBERS, SURFACE, SUMS = "pair.json", "surface.npz", "SHA256SUMS"
FORMAT = 4  # of the resource files
MAGIC, STATE_VERSION = b"cycloid state\0\0\0", 9
# Phases of an instance as named in messages; the native FMU has the same (fmu/clockwork/instance.c).
INSTANTIATED, INITIALIZING, STEPPING, TERMINATED = (
    "before initialization",
    "during initialization",
    "while stepping",
    "after termination",
)
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
    contents = {}
    for name in dict.fromkeys((NUMBERS, SURFACE, *(name for _, _, name in rows))):
        contents[name] = read(name)
        if (hashlib.sha256(contents[name]).hexdigest(), "  ", name) not in rows:
            raise RuntimeError(f"{resources / name}: it is damaged: {SUMS} beside it has another checksum")
    return contents


def variables_hash(table: Sequence[Variable]) -> str:
    """Return the fingerprint of the variables in a model description, their order and references included."""
    fields = [(v.name, v.kind, v.causality, v.variability, v.dimensions) for v in table]
    return hashlib.sha256(repr(fields).encode()).hexdigest()[:16]


def interface_from(numbers: dict[str, Any]) -> Interface:
    """Return the interface that a builder wrote into the resources."""
    models: dict[str, Any] = {name: Friction(**numbers[name]) for name in ("input_friction", "output_friction")}
    models |= {name: kind(**numbers[name]) for name, kind in ADDED.items() if name in numbers}
    return Interface(**{**numbers, **models, "losses": tuple(tuple(row) for row in numbers["losses"])})


class Core:
    """The drive in time and its variables, from an FMU's resources.

    Parameters
    ----------
    resources
        The FMU's folder.
    version
        Version of FMI.

    Attributes
    ----------
    clockwork
        The drive in time.
    interface
        The interface of the FMU.
    table
        Its variables by reference.
    summary
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
        influence = dict[str, list[str]](numbers.get("influence", {}))
        if pair.bodies is not None:
            paths = {body: [str(resources / name) for name in names] for body, names in influence.items()}
            pair = pair.replace(bodies=pair.bodies.of_files(paths))
        drive = DriveValue(pair, ErrorSurface(pair, **values), None if stage is None else FirstStage(**stage))
        self.interface = interface = interface_from(numbers["interface"])
        self.clockwork = Clockwork(drive, interface, version)
        self.table = self.clockwork.table
        if variables_hash(tuple(self.table.values())) != numbers["variables"]:
            raise RuntimeError(f"{built}, whose variables are others: {again}")
        self.summary = stiffness_text(pair, interface)
        self.phase = INSTANTIATED
        self.faults: dict[int, str] = {}
        of_drive = (NUMBERS, SURFACE, *(name for names in influence.values() for name in names))
        self._hash = hashlib.sha256(b"".join(files[name] for name in of_drive)).digest()
        self._groups: dict[tuple[int, ...], Group] = {}  # of reals that are exchanged together

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
        return [self.clockwork.value(reference) for reference in references]

    def reals(self, references: Sequence[int]) -> list[Any]:
        """Return values of real variables, as `values` does, all at once."""
        group = self._groups.get(tuple(references)) or self._grouped(references)
        return self.values(references, "real") if group is None else self.clockwork.read(group)

    def _grouped(self, references: Sequence[int]) -> Group | None:
        for reference in references:
            self.of_kind(reference, "real")
        group = self.clockwork.group(references)
        if group is not None:
            self._groups[tuple(references)] = group
        return group

    def put(self, reference: int, value: Any, kind: str | None = None) -> str:
        """Set a variable; return the reason if the value is refused, or "".

        Raises
        ------
        ValueError
            If there is no such variable (of the kind), or it can't be set, or not in this phase.
        """
        if reference not in self.table or kind is not None:
            self.of_kind(reference, kind or "real")
        variable = self.table[reference]
        self._check_phase("to set a variable", INSTANTIATED, INITIALIZING, STEPPING)
        if variable.causality not in ("input", "parameter"):
            raise ValueError(f"{variable.name} can't be set: its causality is {variable.causality}")
        if variable.variability == "fixed" and self.phase == STEPPING:
            raise ValueError(f"{variable.name} can't be set after initialization")
        refused = self.clockwork.put(reference, value)
        if refused:
            self.faults[reference] = refused
        else:
            self.faults.pop(reference, None)
        return refused

    def put_all(self, references: Sequence[int], values: Sequence[Any], kind: str = "real") -> list[str]:
        """Set variables of a kind as `put` does; return the sentences of refused values."""
        if kind == "real" and not self.faults and self.phase != TERMINATED:
            group = self._groups.get(tuple(references)) or self._grouped(references)
            if group is not None and self.clockwork.write(group, values):
                return []
        given = zip(references, values, strict=True)
        return [refused for reference, value in given if (refused := self.put(reference, value, kind))]

    def _check_phase(self, what: str, *allowed: str) -> None:
        if self.phase not in allowed:
            raise ValueError(f"{what} is allowed {allowed[-1]} only, not {self.phase}")

    def begin(self, start: float | None = None) -> None:
        """Begin initialization at a time (s), by default at the present one; a `ValueError` if this is not allowed."""
        self._check_phase("to begin initialization", INSTANTIATED)
        start = self.clockwork.time if start is None else start
        if not math.isfinite(start):
            raise ValueError(f"the start time is {start:g} s: it must be finite")
        self.clockwork.time, self.phase = start, INITIALIZING

    def start(self) -> None:
        """Settle at the initial inputs, without history; a `ValueError` if this is not allowed."""
        self._check_phase("to end initialization", INITIALIZING)
        if self.faults:
            raise ValueError("; ".join(self.faults.values()))
        self.clockwork.start()
        self.phase = STEPPING

    def step(self, time: float, step: float) -> str:
        """Make a step; return the reason if it is refused, or "". A refused step changes nothing."""
        if self.phase != STEPPING:
            return f"a step is allowed {STEPPING} only, not {self.phase}"
        if self.faults:
            return "no step before this is corrected: " + "; ".join(self.faults.values())
        return self.clockwork.advance(time, step)

    def end(self) -> None:
        """Terminate; a `ValueError` if this is not allowed."""
        self._check_phase("to terminate", STEPPING)
        self.phase = TERMINATED

    def state(self) -> dict[str, Any]:
        """Return the state as plain values."""
        phase = STEPPING if self.phase == TERMINATED else self.phase
        return {"drive": self._hash.hex(), "phase": phase, **self.clockwork.state()}

    def restore(self, state: dict[str, Any]) -> None:
        """Return to a state; a `ValueError` refuses one of another FMU."""
        if state["drive"] != self._hash.hex():
            raise ValueError("this state belongs to another drive: it was taken from an FMU with other resources")
        self.clockwork.restore(state)
        self.phase = state["phase"]
        self.faults.clear()


def state_to_bytes(state: dict[str, Any]) -> bytes:
    """Return a state as bytes, the same on every machine: magic, version, checksum, drive, length, JSON."""
    plain = {**state, "memory": base64.b64encode(state["memory"]).decode()}
    body = json.dumps(plain, separators=(",", ":")).encode()
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
    return {**state, "memory": base64.b64decode(state["memory"])}
