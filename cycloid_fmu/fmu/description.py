"""The model description's parts that come from the table of variables, of FMI 2.0 and 3.0, for any kind of FMU."""

from __future__ import annotations

import uuid
from collections.abc import Sequence
from typing import Literal
from xml.etree.ElementTree import Element, SubElement

from cycloid_fmu.fmu.variables import UNITS, Variable

Version = Literal["2.0", "3.0"]
_TYPES = {
    "2.0": {"real": "Real", "integer": "Integer", "boolean": "Boolean"},
    "3.0": {"real": "Float64", "integer": "Int32", "boolean": "Boolean"},
}


_SPACE = uuid.UUID("6a1f3b0e-51c4-4a52-9c1c-0c2b6a7d39e4")  # the names of this package's FMUs


def token_of(content: str) -> str:
    """Return an FMU's `guid` or `instantiationToken`, which says what it holds and nothing of where it was built."""
    return f"{{{uuid.uuid5(_SPACE, content)}}}"


def _text(variable: Variable, value: float) -> str:
    if variable.kind == "boolean":
        return "true" if value else "false"
    return str(int(value)) if variable.kind == "integer" else repr(float(value))


def _places(table: Sequence[Variable], version: Version, references: Sequence[int] | None) -> dict[str, int]:
    """Return by what number a model description names each variable: its place in FMI 2.0, its reference in 3.0."""
    numbers = range(1, len(table) + 1) if version == "2.0" else references or range(len(table))
    return {v.name: number for v, number in zip(table, numbers, strict=True)}


def unit_definitions(table: Sequence[Variable]) -> Element:
    """Return `<UnitDefinitions>` of the units that the variables have; both versions write them alike."""
    root = Element("UnitDefinitions")
    for unit in dict.fromkeys(v.unit for v in table if v.unit is not None):
        base, displays = UNITS[unit]
        node = SubElement(root, "Unit", name=unit)
        SubElement(node, "BaseUnit", {k: str(v) for k, v in base.items()})
        for display, factor in displays.items():
            SubElement(node, "DisplayUnit", name=display, factor=repr(float(factor)))
    return root


def model_variables(table: Sequence[Variable], version: Version, references: Sequence[int] | None = None) -> Element:
    """Return `<ModelVariables>`; the place in the table is the value reference where none are given."""
    root = Element("ModelVariables")
    places = _places(table, version, references)
    for reference, variable in zip(references or range(len(table)), table, strict=True):
        outer = {
            "name": variable.name, "valueReference": str(reference), "description": variable.description,
            "causality": variable.causality, "variability": variable.variability,
        }  # fmt: skip
        if variable.causality == "parameter":
            outer["initial"] = "exact"
        start = variable.start
        inner = {"unit": variable.unit, "displayUnit": variable.display}
        if variable.kind != "boolean":
            limits = {"min": variable.least, "max": variable.most, "nominal": variable.nominal}
            inner.update({k: None if v is None else _text(variable, v) for k, v in limits.items()})
        if start is not None:
            values = start if isinstance(start, tuple) else (start,)
            inner["start"] = " ".join(_text(variable, v) for v in values)
        if variable.derivative_of is not None:
            inner["derivative"] = str(places[variable.derivative_of])
        given = {k: v for k, v in inner.items() if v is not None}
        kind = _TYPES[version][variable.kind]
        if version == "2.0":
            SubElement(SubElement(root, "ScalarVariable", outer), kind, given)
        else:
            node = SubElement(root, kind, {**outer, **given})
            for length in variable.dimensions:
                SubElement(node, "Dimension", start=str(length))
    return root


def model_structure(table: Sequence[Variable], version: Version, references: Sequence[int] | None = None) -> Element:
    """Return `<ModelStructure>`: outputs with the inputs that they depend on, and with the parameters initially."""
    root = Element("ModelStructure")
    places = _places(table, version, references)
    for section, item in (("Outputs", "Output"), ("InitialUnknowns", "InitialUnknown")):
        node = SubElement(root, section) if version == "2.0" else root
        for variable in table:
            if variable.causality != "output":
                continue
            names = variable.depends if section == "Outputs" else (*variable.depends, *variable.initially)
            known = " ".join(str(places[n]) for n in sorted(names, key=places.__getitem__))
            if version == "2.0":
                SubElement(node, "Unknown", index=str(places[variable.name]), dependencies=known)
            else:
                SubElement(node, item, valueReference=str(places[variable.name]), dependencies=known)
    return root
