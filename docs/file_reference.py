"""The reference of the TOML files, from the classes that read them: `python docs/file_reference.py` writes the page."""

import inspect
import json
import re
from pathlib import Path
from typing import ClassVar

import pydantic
from numpydoc.docscrape import NumpyDocString
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core.core_schema import CoreSchema, ModelSchema

from cycloid_fmu import edge
from cycloid_fmu.errors.kinds import KINDS, ErrorKind
from cycloid_fmu.fmu import friction_file
from cycloid_fmu.geometry import pair
from cycloid_fmu.reducer import description as reducer
from cycloid_fmu.studies import design, limits
from cycloid_fmu.surfaces import sampling
from cycloid_fmu.wear import law as wear_law
from drivers.encoder import protocols
from drivers.recorder import bench, sequence
from drivers.simulated import buses
from fitting.ageing import history
from fitting.figures import conformity, instruments
from fitting.readers import mapping
from fitting.readers import read_head as coaxiality

# title, format, class that reads it, example
FILES = (
    ("Gear pair", pair.FORMAT, pair._File, "drive-39-40-as-made.toml"),
    ("RV reducer", reducer.FORMAT, reducer.Reducer, "rv-20e.toml"),
    ("Tolerances", sampling.FORMAT, sampling.file_model(), "tolerances.toml"),
    ("Requirements of an application", limits.FORMAT, limits.Requirements, "requirements.toml"),
    ("Search for a drive", design.FORMAT, design.DesignTask, "design.toml"),
    ("Friction", friction_file.FORMAT, friction_file._FrictionFile, "friction.toml"),
    ("Wear law", wear_law.FORMAT, wear_law._WearFile, "wear.toml"),
    ("History of a drive", history.FORMAT, history.History, None),
    ("Bench wiring", bench.BENCH_FORMAT, bench.bench_file(), None),
    ("Guided sequence", sequence.FORMAT, sequence.SequenceFile, None),
    ("Simulated bench", buses.FORMAT, buses.SimulationFile, None),
    ("Mapping of a bench file", mapping.FORMAT, mapping.FileMapping, None),
    ("Instruments of a bench", instruments.FORMAT, instruments.InstrumentsFile, "instruments.toml"),
    ("Certificate of a drive", conformity.FORMAT, conformity.Certificate, "certificate.toml"),
    ("Read head", coaxiality.FORMAT, coaxiality._File, "rv-20e-read-head.toml"),
)
# Tables whose meaning another class states: a pair is one value in Python and three tables in its file.
STATED_BY = {pair._Geometry: pair.Pair, pair._File: pair.Pair, sampling.file_model(): sampling.Tolerances}
QUANTITIES = {
    "m": "length",
    "rad": "angle",
    "N*m": "torque",
    "Pa": "pressure",
    "s": "time",
    "rad/s": "speed",
    "K": "temperature",
    "N": "force",
    "N/m": "stiffness",
    "N*m/rad": "torsional stiffness",
    "1/K": "per kelvin",
    "N*m*s/rad": "rotational damping",
    "1/Pa": "pressure viscosity",
    "m^2/N": "wear coefficient",
    "m^2/s": "kinematic viscosity",
    "m/s": "velocity",
    "W/m^2": "power over area",
    "W/(m^2*K)": "heat transfer coefficient",
    "K/W": "thermal resistance",
    "J/K": "heat capacity",
    "m^2": "area",
}
# Words of Python and of the code in the docstrings, and what the page has in their place.
WORDS = (
    (r"\bNone(?= (?:for|if|to)\b|:)", "left out"),
    (r"(?<=\. )left out", "Left out"),
    (r"\(docs/(?:theory/)?(\w+)\.md\)", r"([](../theory/\1.md))"),
    (r"an entry of `MATERIALS`", "a [material](../new_drive.md#materials)"),
    (r"an entry of `VALUES`", "a [pair of materials](../losses.md#values-to-begin-with)"),
    (r"\b(rad|rad/s|N·m|s) or text such as", r"\1, such as"),
    (r"\b(rad|N·m|s) or text\b", r"\1"),
)
ELSEWHERE = ("stage",)  # a reducer's [pair], [modification], [material] and [supports] are those of a pair file
INTRODUCTION = """# Files

Signs of errors, angles and torques are those of [one drawing](theory-frames). Quantities are text with a unit
(`"64 mm"`), angles too; a key that is not listed is refused. The first line of every file is its format. What the
commands write is described by the units and names inside: netCDF for analyses, surfaces, curves, studies and wear,
Arrow for recordings, JSON for identifications and figures.

"""


class _Schema(GenerateJsonSchema):
    """What a TOML file can hold; the keys' meanings are those of `STATED_BY`, and what it can't hold has no schema."""

    ignored_warning_kinds: ClassVar = {"skipped-choice", "non-serializable-default"}

    def handle_invalid_for_json_schema(self, schema: CoreSchema, error_info: str) -> dict:
        return {}

    def model_schema(self, schema: ModelSchema) -> dict:
        found, stated = super().model_schema(schema), STATED_BY.get(schema["cls"])
        # A table has the keys of the class that it extends too.
        inherited = [_meanings(base.__doc__) for base in reversed(schema["cls"].__mro__[1:])]
        found["inherited"] = {name: text for meanings in inherited for name, text in meanings.items()}
        if stated is not None:
            own, (summary, *rest) = schema["cls"].__doc__, inspect.cleandoc(stated.__doc__ or "").split("\n\n")
            found["description"] = "\n\n".join([own or summary, *rest])
        stated_above = {}  # by classes that this one extends
        for base in reversed(schema["cls"].__mro__[1:]):
            stated_above |= _meanings(base.__doc__) if issubclass(base, edge.Config) else {}
        own_meanings = stated_above | _meanings(schema["cls"].__doc__)
        for name, field in schema["cls"].model_fields.items():
            if name in stated_above or field.alias:
                found["properties"][field.alias or name]["meaning"] = own_meanings.get(name, "")
        return found


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
        limits = f", {schema['limits']}" if "limits" in schema else ""
        return f'{QUANTITIES[schema["si"]]}, `"{schema["quantity"]}"`{limits}'
    if "anyOf" in schema:
        kinds = dict.fromkeys(_kind(s, definitions) for s in schema["anyOf"] if s.get("type") != "null")
        return " or ".join(kinds)
    if "const" in schema or "enum" in schema:
        return ", ".join(f"`{json.dumps(v)}`" for v in schema.get("enum", [schema.get("const")]))
    if schema.get("type") == "array":
        return f"list of {_kind(schema.get('items', {}), definitions) or 'values'}"
    limits = [
        f"{sign} {schema[key]:g}"
        for key, sign in (
            ("minimum", "≥"),
            ("exclusiveMinimum", ">"),
            ("maximum", "≤"),
            ("exclusiveMaximum", "<"),
        )
        if key in schema
    ]
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
        unit = "um" if inner["si"] == "m" and abs(default) < 1e-4 else "deg" if inner["si"] == "rad" else unit
        unit = "rad/s" if inner["si"] == "rad/s" else unit
        if inner["si"] == "s":
            unit = next(u for u, least in (("h", 3600.0), ("s", 1.0), ("ms", 0.0)) if default >= least)
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


def _worded(text: str) -> str:
    """A docstring in the words of a file."""
    for pattern, words in WORDS:
        text = re.sub(pattern, words, text)
    return text


def _rows(schema: dict, definitions: dict) -> list[str]:
    """The keys of one table that are no tables themselves."""
    meanings = schema.get("inherited", {}) | _meanings(schema.get("description", ""))
    needed, rows = schema.get("required", ()), []
    for key, one in schema.get("properties", {}).items():
        each = one.get("additionalProperties")
        table = _reference(one) or (_reference(each) if isinstance(each, dict) else None)
        if key == "text" or (table is not None and "properties" in definitions[table]):
            continue
        default = "needed" if key in needed else _default(one)
        meaning = _worded(one.get("meaning") or meanings.get(key, ""))
        rows.append(f"| `{key}` | {_kind(one, definitions)} | {default} | {meaning} |")
    return ["| key | value | if left out | meaning |", "| --- | --- | --- | --- |", *rows, ""] if rows else []


def _told(schema: dict) -> list[str]:
    """All tables of a file."""
    definitions, lines = schema.get("$defs", {}), []
    for names, one in _tables(schema, definitions).values():
        rows, said = _rows(one, definitions), _worded(_first_paragraph(one.get("description", "")))
        if names == [""]:
            lines += [said, "", *rows]
        elif rows:
            lines += [", ".join(f"**`[{n}]`**" for n in names) + f" {said}", "", *rows]
    return lines


def _limit(kind: ErrorKind) -> str:
    return f"± {1e3 * kind.limit:g} {'mrad' if kind.unit == 'rad' else 'mm'}"


def error_table() -> list[str]:
    """The keys of `[errors]`, one for each kind."""
    rows = ["| key | of | unit | limit | meaning and sign |", "| --- | --- | --- | --- | --- |"]
    for kind in KINDS.values():
        each = "the drive" if kind.of == "drive" else f"each {kind.of.replace('_', ' ')}"
        rows.append(f"| `{kind.file_key}` | {each} | {kind.unit} | {_limit(kind)} | {kind.description} |")
    return rows


def _errors() -> list[str]:
    return [
        "**`[errors]`** What was really made, beyond the nominal; 0 where left out. An error of the drive is a "
        "quantity; one of each pin or tooth is a list with a value for each, or its waves round the circle, "
        '`{ order_2 = ["2.5 um", "40 deg"] }` for amplitude and phase. Errors of holes, cranks, rollers and eccentrics '
        "stand in **`[errors.supports]`**, as a list, of holes and eccentrics a list for each disc.",
        "",
        *error_table(),
        "",
    ]


def _toleranced() -> list[str]:
    """Which error each table of a tolerance file limits."""
    rows = ["| table | error that it limits |", "| --- | --- |"]
    for kind in KINDS.values():
        if kind.tolerance is not None:
            share = "" if kind.tolerance.share == 1.0 else f", ± {kind.tolerance.share:g} of the tolerance"
            rows.append(f"| `[{kind.tolerance.key}]` | {kind.text}{share} |")
    return [*rows, "| `[gear_profile]`, `[pin_profile]` | form of the flanks, of the pins |", ""]


def _section(title: str, written: str, model: type[pydantic.BaseModel], example: str | None) -> list[str]:
    lines = [f"## {title}: `{written}`", "", *_told(model.model_json_schema(schema_generator=_Schema))]
    lines += {pair.FORMAT: _errors, sampling.FORMAT: _toleranced}.get(written, list)()
    if example is not None:
        lines += [f"```{{literalinclude}} ../../examples/{example}", ":language: toml", "```", ""]
    return lines


def write(path: Path) -> None:
    """Write the page."""
    lines = [INTRODUCTION]
    for title, written, model, example in FILES:
        lines += _section(title, written, model, example)
        if written == bench.BENCH_FORMAT:
            for name, entry in protocols().items():
                protocol = entry.load()
                said = _told(protocol.configuration.model_json_schema(schema_generator=_Schema))
                lines += [f'**`[channel.NAME]` with `protocol = "{name}"`** {said[0]}', *said[1:]]
    path.write_text("\n".join(lines), encoding="utf-8")


PAGE = Path(__file__).parent / "reference" / "files.md"

if __name__ == "__main__":
    write(PAGE)
