"""What the slaves of FMI 2.0 and 3.0 share: the model from the FMU's resources, its variables by reference, its state.

A value that is no value is refused without an exception, which the slaves' library would make fatal: it is not set, a
message says so, and steps are refused until it is set right.
"""

from __future__ import annotations

import functools
import hashlib
import json
import math
import re
import struct
import sys
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cycloid_fmu import __version__
from cycloid_fmu.errors.kinds import KINDS
from cycloid_fmu.fmu.compliant_model import CompliantModel
from cycloid_fmu.fmu.description import Version
from cycloid_fmu.fmu.friction import FLANGES, Law
from cycloid_fmu.fmu.friction_file import Friction
from cycloid_fmu.fmu.mesh import StepError
from cycloid_fmu.fmu.model import DriveModel
from cycloid_fmu.fmu.reducer_model import ReducerModel
from cycloid_fmu.fmu.variables import ATTRIBUTES, Interface, Variable, variables
from cycloid_fmu.geometry.pair import Pair, parse_pair
from cycloid_fmu.reducer.first_stage import FirstStage
from cycloid_fmu.surfaces.surface import ErrorSurface, Life

NUMBERS, SURFACE = "pair.json", "surface.npz"
FORMAT = 3  # of these files
MAGIC, STATE_VERSION = b"cycloid state\0\0\0", 5
_LARGEST = sys.float_info.max
_HEAD = struct.Struct("<16sII32sQ")  # magic, version, checksum, hash of the resources, length


def interface_from(numbers: dict[str, Any]) -> Interface:
    """Return the interface that a builder wrote into the resources."""
    made = {name: Friction(**numbers[name]) for name in ("input_friction", "output_friction")}
    return Interface(**{**numbers, **made, "losses": tuple(tuple(row) for row in numbers["losses"])})


def model_of(
    pair: Pair, surface: ErrorSurface, interface: Interface, first_stage: FirstStage | None = None
) -> DriveModel | CompliantModel:
    """Return the model behind an interface."""
    model: DriveModel | CompliantModel
    if interface.kind == "compliant":
        inertias = interface.output_inertia, interface.crank_inertia
        model = CompliantModel(pair, surface, interface.losses, *inertias)
        model.mesh_damping = interface.mesh_damping or 0.0
    elif first_stage is not None:
        model = ReducerModel(pair, surface, first_stage, interface.losses)
    else:
        model = DriveModel(pair, surface, interface.losses)
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
        Of FMI.

    Attributes
    ----------
    model
        The drive.
    interface
        What the FMU offers.
    table
        Its variables by reference.
    faults
        What was refused and not set right since: a sentence for each variable's reference.
    """

    def __init__(self, resources: Path, version: Version) -> None:
        text, stored = (resources / NUMBERS).read_bytes(), (resources / SURFACE).read_bytes()
        numbers = json.loads(text)
        if numbers["package_version"] != __version__:
            raise RuntimeError(
                f"this FMU was built with cycloid-fmu {numbers['package_version']}, installed is {__version__}; build "
                "the FMU again or install that version"
            )
        if numbers.get("format") != FORMAT:
            raise RuntimeError("this FMU was built with an earlier cycloid-fmu of the same version; build it again")
        with np.load(resources / SURFACE) as arrays:
            values: dict[str, Any] = {n: arrays[n] if arrays[n].shape else float(arrays[n]) for n in arrays.files}
            states = {n.removeprefix("life_"): values.pop(n) for n in arrays.files if n.startswith("life_")}
        pair, stage = parse_pair(numbers["pair"], "the FMU's drive"), numbers.get("first_stage")
        surface = ErrorSurface(pair, **values, life=Life(**states) if states else None)
        self.interface = interface = interface_from(numbers["interface"])
        self.model = model_of(pair, surface, interface, None if stage is None else FirstStage(**stage))
        self.table = dict(enumerate(variables(pair, surface, interface, version, self.model.ratio)))
        self.faults: dict[int, str] = {}
        self.time = 0.0
        self._hash = hashlib.sha256(text + stored).digest()
        accesses = {reference: self._access(variable) for reference, variable in self.table.items()}
        self.getters = {reference: getter for reference, (getter, _) in accesses.items()}
        self._setters = {reference: setter for reference, (_, setter) in accesses.items()}
        # What is set at each step: setters of scalars with their limits, which are finite.
        self._quick = {
            reference: (setter, -_LARGEST if v.least is None else v.least, _LARGEST if v.most is None else v.most)
            for reference, v in self.table.items()
            if (setter := self._setters[reference]) is not None and not v.dimensions
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
        attribute = ATTRIBUTES.get(name, name)
        setter = None if variable.causality in ("output", "local") else functools.partial(setattr, model, attribute)
        return functools.partial(getattr, model, attribute), setter

    def put(self, reference: int, value: Any) -> str:
        """Set a variable; what is no value for it is refused with a sentence, else the answer is empty.

        Raises
        ------
        ValueError
            If there is no such variable or it can't be set.
        """
        if reference not in self.table:
            raise ValueError(f"there is no variable with the value reference {reference}")
        variable, setter = self.table[reference], self._setters[reference]
        if setter is None:
            raise ValueError(f"{variable.name} can't be set: its causality is {variable.causality}")
        refused = self._refused(variable, value)
        if refused:
            self.faults[reference] = refused
            return refused
        setter(value)
        self.faults.pop(reference, None)
        return ""

    def put_all(self, references: Sequence[int], values: Sequence[Any]) -> list[str]:
        """Set variables as `put` does; the sentences of what is refused."""
        refused, quickly, faults = [], self._quick, self.faults
        for reference, value in zip(references, values, strict=True):
            quick = quickly.get(reference)
            if quick is not None and quick[1] <= value <= quick[2] and not faults:
                quick[0](value)
            elif text := self.put(reference, value):
                refused.append(text)
        return refused

    def _refused(self, variable: Variable, value: Any) -> str:
        """Why a value is none for a variable; else an empty answer."""
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

    def start(self) -> None:
        """Settle at the initial inputs, without history; a `ValueError` says what forbids it."""
        if self.faults:
            raise ValueError("; ".join(self.faults.values()))
        self.model.check()
        self.model.forget_history()
        self.model.advance()

    def step(self, time: float, step: float) -> str:
        """Make a step; why it is refused, else an empty answer. A refused step leaves all as it was."""
        if self.faults:
            return "no step before this is set right: " + "; ".join(self.faults.values())
        try:
            self.model.advance(step)
        except StepError as problem:
            return str(problem)
        self.time = time + step
        return ""

    def state(self) -> dict[str, Any]:
        """Return the state, of plain values."""
        return {"drive": self._hash.hex(), "time": self.time, "model": self.model.state()}

    def restore(self, state: dict[str, Any]) -> None:
        """Return to a state; a `ValueError` refuses one of another FMU."""
        if state["drive"] != self._hash.hex():
            raise ValueError("this state belongs to another drive: it was taken from an FMU with other resources")
        self.model.restore(state["model"])
        self.time = state["time"]
        self.faults.clear()


def state_to_bytes(state: dict[str, Any]) -> bytes:
    """Return a state as bytes that any process on any machine reads: magic, version, checksum, drive, length, JSON."""
    body = json.dumps(state, separators=(",", ":")).encode()
    return _HEAD.pack(MAGIC, STATE_VERSION, zlib.crc32(body), bytes.fromhex(state["drive"]), len(body)) + body


def state_from_bytes(data: bytes) -> dict[str, Any]:
    """Return the state in the bytes of `state_to_bytes`.

    Raises
    ------
    ValueError
        If the bytes are something else, damaged, or of another version; the text is one sentence.
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
