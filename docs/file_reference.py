"""The reference of the TOML files, from the classes that read them."""

import inspect
import json
from pathlib import Path

import pydantic
from numpydoc.docscrape import NumpyDocString

from cycloid_fmu import edge, reducer
from cycloid_fmu.geometry import pair
from cycloid_fmu.surfaces import sampling
from cycloid_fmu.wear import law as wear_law
from drivers import faults, recorder, sequence
from drivers.encoder import protocols
from fitting.recordings import mapping
from fitting.recordings import read_head as coaxiality

# title, format, class that reads it, top table (""), example
FILES = (
    ("Gear pair", pair.FORMAT, pair.Pair, "drive-39-40-as-made.toml"),
    ("RV reducer", reducer.FORMAT, reducer.Reducer, "rv-20e.toml"),
    ("Tolerances", sampling.FORMAT, sampling.Tolerances, "tolerances.toml"),
    ("Wear law", wear_law.FORMAT, wear_law._WearFile, "wear.toml"),
    ("Bench wiring", recorder.BENCH_FORMAT, recorder._BenchFile, None),
    ("Guided sequence", sequence.FORMAT, sequence.SequenceFile, None),
    ("Scripted faults", faults.FORMAT, faults._FaultFile, None),
    ("Mapping of a bench file", mapping.FORMAT, mapping.FileMapping, None),
    ("Read head", coaxiality.FORMAT, coaxiality._File, "rv-20e-read-head.toml"),
)
ELSEWHERE = ("stage",)  # a reducer's [pair], [modification] and [material] are those of a pair file
INTRODUCTION = """# Files

Quantities are text with a unit (`"64 mm"`), angles too; a key that is not listed is refused. The first line of every
file is its format. What the commands write is described by the units and names inside: netCDF for analyses, surfaces,
curves, studies and wear, Arrow for recordings, JSON for identifications and figures.

"""


def _first_paragraph(text: str) -> str:
    return " ".join(inspect.cleandoc(text).split("\n\n")[0].split()) if text else ""


def _meanings(text: str) -> dict[str, str]:
    """What a class's docstring says of its attributes; one entry may name several."""
    found = {}
    for attribute in NumpyDocString(inspect.cleandoc(text or ""))["Attributes"]:
        for name in (attribute.name or attribute.type).split(","):
            found[name.strip()] = " ".join(" ".join(attribute.desc).split())
    return found


def _kind(schema: dict, definitions: dict) -> str:
    """How a value is written."""
    if "quantity" in schema:
        return f'`"{schema["quantity"]}"`'
    if "anyOf" in schema:
        kinds = dict.fromkeys(_kind(s, definitions) for s in schema["anyOf"] if s.get("type") != "null")
        return " or ".join(kinds)
    if "const" in schema or "enum" in schema:
        return ", ".join(f"`{json.dumps(v)}`" for v in schema.get("enum", [schema.get("const")]))
    if schema.get("type") == "array":
        return f"list of {_kind(schema.get('items', {}), definitions) or 'values'}"
    limits = [f"{sign} {schema[key]:g}" for key, sign in (
        ("minimum", "≥"), ("exclusiveMinimum", ">"), ("maximum", "≤"), ("exclusiveMaximum", "<"),
    ) if key in schema]  # fmt: skip
    kind = {"integer": "whole number", "number": "number", "string": "text", "boolean": "`true` or `false`"}
    return " ".join([kind.get(schema.get("type", ""), ""), ", ".join(limits)]).strip()


def _reference(schema: dict) -> str | None:
    """The name of the table that a key stands for."""
    for one in (schema, *schema.get("anyOf", ()), *schema.get("allOf", ()), schema.get("items", {})):
        if "$ref" in one:
            return one["$ref"].rsplit("/", 1)[1]
    return None


def _default(schema: dict) -> str:
    """What holds where the key is left out."""
    default = schema.get("default")
    if default is None or default == [] or default == "":
        return ""
    inner = next((s for s in (schema, *schema.get("anyOf", ())) if "quantity" in s), None)
    if inner is not None:
        unit = inner["quantity"].split(" ", 1)[1]
        return "0" if default == 0.0 else f'`"{edge.format_quantity(default, inner["si"], unit)}"`'
    return f"`{json.dumps(default)}`"


def _tables(schema: dict, definitions: dict) -> dict[str, tuple[list[str], dict]]:
    """{class: (names of its tables in the file, schema)} of a file and of the tables in it; a class is told once."""
    found = {"": ([""], schema)}
    waiting = [("", schema)]
    while waiting:
        name, one = waiting.pop(0)
        for key, value in one.get("properties", {}).items():
            each = value.get("additionalProperties")
            table, where = _reference(value), f"{name}.{key}" if name else key
            if isinstance(each, dict) and "$ref" in each:
                table, where = _reference(each), f"{where}.NAME"
            if table is None or "properties" not in definitions[table] or key in ELSEWHERE:
                continue
            names = found.setdefault(table, ([], definitions[table]))[0]
            names.append(f"[{where}]" if value.get("type") == "array" else where)
            waiting.append((where, definitions[table]))
    return found


def _rows(schema: dict, definitions: dict) -> list[str]:
    """The keys of one table that are no tables themselves."""
    meanings, needed, rows = _meanings(schema.get("description", "")), schema.get("required", ()), []
    for key, one in schema.get("properties", {}).items():
        each = one.get("additionalProperties")
        table = _reference(one) or (_reference(each) if isinstance(each, dict) else None)
        if key == "text" or (table is not None and "properties" in definitions[table]):
            continue
        default = "needed" if key in needed else _default(one)
        rows.append(f"| `{key}` | {_kind(one, definitions)} | {default} | {meanings.get(key, '')} |")
    return ["| key | value | if left out | meaning |", "| --- | --- | --- | --- |", *rows, ""] if rows else []


def _told(schema: dict) -> list[str]:
    """All tables of a file."""
    definitions, lines = schema.get("$defs", {}), []
    for names, one in _tables(schema, definitions).values():
        rows, said = _rows(one, definitions), _first_paragraph(one.get("description", ""))
        if names == [""]:
            lines += [said, "", *rows]
        elif rows:
            lines += [", ".join(f"**`[{n}]`**" for n in names) + f" {said}", "", *rows]
    return lines


def _section(title: str, written: str, model: type[pydantic.BaseModel], example: str | None) -> list[str]:
    lines = [f"## {title}: `{written}`", "", *_told(model.model_json_schema())]
    if example is not None:
        lines += [f"```{{literalinclude}} ../../examples/{example}", ":language: toml", "```", ""]
    return lines


def write(path: Path) -> None:
    """Write the page."""
    lines = [INTRODUCTION]
    for title, written, model, example in FILES:
        lines += _section(title, written, model, example)
        if model is recorder._BenchFile:
            for name, entry in protocols().items():
                protocol = entry.load()
                said = _told(protocol.configuration.model_json_schema())
                lines += [f'**`[channel.NAME]` with `protocol = "{name}"`** {said[0]}', *said[1:]]
    path.write_text("\n".join(lines), encoding="utf-8")
