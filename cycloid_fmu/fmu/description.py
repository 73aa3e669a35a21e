"""Parts of the model description generated from the table of variables, for FMI 2.0 and 3.0 and every kind of FMU."""

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


_SPACE = uuid.UUID("6a1f3b0e-51c4-4a52-9c1c-0c2b6a7d39e4")  # namespace of this package's FMUs


def token_of(content: str) -> str:
    """Return an FMU's `guid` or `instantiationToken`, which depends only on its content."""
    return f"{{{uuid.uuid5(_SPACE, content)}}}"


def _text(variable: Variable, value: float) -> str:
    if variable.kind == "boolean":
        return "true" if value else "false"
    return str(int(value)) if variable.kind == "integer" else repr(float(value))


def _numbers(table: Sequence[Variable], version: Version, references: Sequence[int] | None) -> dict[str, int]:
    """Return the number of each variable in a model description: its index in FMI 2.0, its reference in 3.0."""
    numbers = range(1, len(table) + 1) if version == "2.0" else references or range(len(table))
    return {v.name: number for v, number in zip(table, numbers, strict=True)}


def unit_definitions(table: Sequence[Variable]) -> Element:
    """Return `<UnitDefinitions>` of the variables' units, the same for both versions."""
    root = Element("UnitDefinitions")
    for unit in dict.fromkeys(v.unit for v in table if v.unit is not None):
        base, displays = UNITS[unit]
        node = SubElement(root, "Unit", name=unit)
        SubElement(node, "BaseUnit", {k: str(v) for k, v in base.items()})
        for display, factor in displays.items():
            SubElement(node, "DisplayUnit", name=display, factor=repr(float(factor)))
    return root


def model_variables(table: Sequence[Variable], version: Version, references: Sequence[int] | None = None) -> Element:
    """Return `<ModelVariables>`; by default the value reference is the index in the table."""
    root = Element("ModelVariables")
    numbers = _numbers(table, version, references)
    for reference, variable in zip(references or range(len(table)), table, strict=True):
        outer = {
            "name": variable.name,
            "valueReference": str(reference),
            "description": variable.description,
            "causality": variable.causality,
            "variability": variable.variability,
        }
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
            inner["derivative"] = str(numbers[variable.derivative_of])
        given = {k: v for k, v in inner.items() if v is not None}
        kind = _TYPES[version][variable.kind]
        if version == "2.0":
            SubElement(SubElement(root, "ScalarVariable", outer), kind, given)
        else:
            node = SubElement(root, kind, {**outer, **given})
            for length in variable.dimensions:
                SubElement(node, "Dimension", start=str(length))
    return root


def model_structure(
    table: Sequence[Variable],
    version: Version,
    references: Sequence[int] | None = None,
    states: Sequence[str] = (),
) -> Element:
    """Return `<ModelStructure>`: outputs and derivatives with their dependencies, which initially include parameters.

    Parameters
    ----------
    table, version, references
        As for `model_variables`.
    states
        Names of the continuous states of Model Exchange, in order.
    """
    root = Element("ModelStructure")
    numbers = _numbers(table, version, references)
    derivatives = [next(v for v in table if v.derivative_of == name) for name in states]
    outputs = [v for v in table if v.causality == "output"]
    exchanged = {v.name for v in derivatives} | set(states)
    unknown = [v for v in table if v.causality == "output" or v.name in exchanged]
    for section, item, variables in (
        ("Outputs", "Output", outputs),
        ("Derivatives", "ContinuousStateDerivative", derivatives),
        ("InitialUnknowns", "InitialUnknown", unknown),
        ("", "EventIndicator", [v for v in table if v.name.startswith("event_indicator")]),
    ):
        if not variables:
            continue
        node = SubElement(root, section) if version == "2.0" else root
        for variable in variables:
            initial = variable.initially if states else (*variable.depends, *variable.initially)
            names = initial if section == "InitialUnknowns" else variable.depends
            known = " ".join(str(numbers[n]) for n in sorted(set(names), key=numbers.__getitem__))
            number = str(numbers[variable.name])
            if not section:
                SubElement(node, item, valueReference=number)
            elif version == "2.0":
                SubElement(node, "Unknown", index=number, dependencies=known)
            else:
                SubElement(node, item, valueReference=number, dependencies=known)
    return root
