"""The reference of the FMU's variables, from the table that every FMU is made of."""

import dataclasses
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.build import with_damping
from cycloid_fmu.fmu.friction_file import Friction
from cycloid_fmu.fmu.variables import UNITS, Interface, Variable, from_tables, variables
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.surfaces.surface import nominal_surface

EXAMPLE = "drive-39-40.toml"
BEARINGS = "drive-39-40-bearings.toml"  # with [losses] and [thermal]
WARM = Friction(temperature_coefficient=0.01)
INTERFACES = {
    "kinematic": Interface(support_flange=True, input_friction=WARM),
    "compliant": Interface("compliant", support_flange=True, input_friction=WARM),
    "inertia inside": Interface("compliant", output_inertia=1.0, support_flange=True, input_friction=WARM),
    "both inside": Interface(
        "compliant", output_inertia=1.0, crank_inertia=1e-3, support_flange=True, input_friction=WARM
    ),
    "rotor inside": Interface("compliant", crank_inertia=1e-3, support_flange=True, input_friction=WARM),
}
SECTIONS: tuple[tuple[str, str, Callable[[Variable], bool]], ...] = (
    (
        "Inputs and outputs",
        "Angles and speeds are counter-clockwise, torques positive into the drive at their flange. `temperature` is an "
        "input where friction depends on it; with a `capacity` in `[thermal]` it is a state instead, `heat_port.T`, "
        "and `heat_port.Q_flow` and `ambient_temperature` are inputs.",
        lambda v: v.causality in ("input", "output") and not v.dimensions,
    ),
    (
        "Errors of the drive",
        "They start from the FMU's error surface; setting one replaces the value of the surface.",
        lambda v: v.causality == "parameter" and v.baked and not v.dimensions,
    ),
    (
        "Other parameters",
        "`loss_table[i,j]` has a row for each of `--losses` or of those made from `[losses]`, the first of which is "
        "listed here. Coefficients and reference temperatures are there where `--friction` or `--losses` states one, "
        "here 0.01/K. The `lubricant` is that of `[losses.lubricant]`; `temperature_start`, `thermal_resistance` and "
        f"`heat_capacity` come with the heat port. Their starts here are those of `examples/{BEARINGS}`.",
        lambda v: v.causality == "parameter" and not v.baked and not v.dimensions,
    ),
    (
        "To read",
        "Constants of the drive.",
        lambda v: v.causality == "local",
    ),
    (
        "In FMI 3.0 alone",
        "The arrays have an element for each pin, in the order of the pins; each disc's follow the one before.",
        lambda v: bool(v.dimensions) or v.causality == "independent",
    ),
)
INTRODUCTION = f"""# FMU variables

The variables of an FMU of `cycloid-fmu build` and their causality in each [interface](../fmu.md), – where the
interface lacks one. *Inertia inside* is the compliant interface with `--output-inertia`, *both inside* with
`--crank-inertia` as well, *rotor inside* with `--crank-inertia` alone. `support` is there only with
`--support-flange`. FMI 2.0 and 3.0 have the same names and value references. In the FMU of an RV reducer `flange_a` is
the sun. Parameters that a [native FMU](../native.md) has in its tables are *constants* there: they can be read but not
set.

Values are in the first unit, those in brackets are display units. Ranges and starts are those of `examples/{EXAMPLE}`;
the model description in every FMU has its own. Signs of angles, torques and
errors are those of [one drawing](theory-frames).

"""


def tables() -> Iterator[tuple[str, tuple[Variable, ...]]]:
    """(interface, its FMI 3.0 variables) of the example, with the temperature as an input and then with a heat port."""
    examples = Path(__file__).parent.parent / "examples"
    pair, warm = read_pair(examples / EXAMPLE), read_pair(examples / BEARINGS)
    drive = DriveValue(pair, nominal_surface(pair))
    assert warm.losses is not None
    heat = {"lubricant": warm.losses.lubricant, "thermal": warm.thermal}
    for name, interface in INTERFACES.items():
        damped = with_damping(interface, drive)
        yield name, variables(drive, damped, "3.0")
        yield name, variables(drive, dataclasses.replace(damped, **heat), "3.0")


def in_native(variable: Variable) -> str:
    """Return the kind of a variable in a native FMU."""
    for kept in from_tables([variable]).values():
        return "the same" if kept == variable else kept.variability
    return "–"


def span(variable: Variable) -> str:
    """The range that a value must lie in."""
    least, most = ("" if v is None else f"{v:g}" for v in (variable.least, variable.most))
    return f"{least} … {most}" if least and most else f"≥ {least}" if least else f"≤ {most}" if most else ""


def start(variable: Variable) -> str:
    """The value before one is set."""
    if variable.start is None or variable.dimensions or variable.causality not in ("parameter", "local"):
        return ""
    return ("true" if variable.start else "false") if variable.kind == "boolean" else f"{variable.start:g}"


def unit(variable: Variable) -> str:
    """Unit with its display units, or the type of what is no real number."""
    if variable.kind != "real":
        return variable.kind
    others = ", ".join(UNITS[variable.unit][1]) if variable.unit else ""
    return f"{variable.unit or ''}{f' ({others})' if others else ''}"


def row(name: str, found: dict[str, Variable]) -> list[str]:
    """The cells of a variable, whose units, ranges and values all interfaces share."""
    one = next(iter(found.values()))
    shared = [one.variability, unit(one), span(one), start(one), in_native(one)]
    assert all([v.variability, unit(v), span(v), start(v), in_native(v)] == shared for v in found.values()), name
    meaning = "; or ".join(dict.fromkeys(v.description for v in found.values()))
    causalities = [found[i].causality if i in found else "–" for i in INTERFACES]
    return [f"`{name}`", meaning, *causalities, *shared]


def lines(rows: Iterable[list[str]]) -> list[str]:
    """A Markdown table without the columns that are empty in all rows."""
    head = ["variable", "meaning", *INTERFACES, "variability", "unit", "range", "start", "native"]
    columns = [c for c in zip(head, ["---"] * len(head), *rows, strict=True) if any(c[2:])]
    return ["| " + " | ".join(cells) + " |" for cells in zip(*columns, strict=True)]


def write(path: Path) -> None:
    """Write the page."""
    found: dict[str, dict[str, Variable]] = {}
    for interface, table in tables():
        for variable in table:
            found.setdefault(variable.name, {})[interface] = variable
    text = [INTRODUCTION]
    for title, said, holds in SECTIONS:
        rows = [row(name, each) for name, each in found.items() if holds(next(iter(each.values())))]
        text += [f"## {title}", "", said, "", *lines(rows), ""]
    path.parent.mkdir(exist_ok=True)
    path.write_text("\n".join(text), encoding="utf-8")
