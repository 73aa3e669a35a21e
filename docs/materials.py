"""Tables of materials and processes: `python docs/materials.py` writes them into `docs/new_drive.md`, between marks."""

import re
from pathlib import Path

from cycloid_fmu.geometry.materials import MATERIALS
from cycloid_fmu.geometry.processes import PROCESSES

PAGE = Path(__file__).parent / "new_drive.md"
END = "<!-- end of the table -->"


def _range(values, factor, digits=3):
    low, high = (f"{value * factor:.{digits}g}" for value in values)
    return low if low == high else f"{low} … {high}"


def materials():
    """Return the table of materials."""
    head = ("name", "E, GPa", "pressure, MPa", "yield, MPa", "fatigue, MPa", "expansion, µm/(m·K)", "density, kg/m³")
    head += ("up to, °C", "creeps", "source")
    rows = [f"| {' | '.join(head)} |", f"|{' --- |' * len(head)}"]
    for name, value in MATERIALS.items():
        cells = [
            f"`{name}`",
            _range(value.youngs_modulus, 1e-9),
            f"{value.largest_pressure * 1e-6:.0f}",
            _range(value.yield_strength, 1e-6, 4),
            "" if value.bending_fatigue is None else _range(value.bending_fatigue, 1e-6),
            _range(value.expansion, 1e6),
            _range(value.density, 1.0, 4),
            f"{value.service_temperature - 273.15:.0f}",
            "yes" if value.creeps else "",
            value.source,
        ]
        rows.append(f"| {' | '.join(cells)} |")
    return "\n".join(rows)


def processes():
    """Return the table of processes."""
    rows = [
        "| name | grade (ISO 286-1) | place on 60 mm, µm | least wall, mm | source |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, process in PROCESSES.items():
        place = f"± {process.position(0.06) * 1e6:.2g}"
        rows.append(f"| `{name}` | IT{process.grade} | {place} | {process.wall * 1e3:g} | {process.source} |")
    return "\n".join(rows)


def page():
    """Return the page with both tables."""
    text = PAGE.read_text(encoding="utf-8")
    for table in (materials, processes):
        begin = f"<!-- table: python docs/materials.py {table.__name__} -->"
        pattern = re.compile(f"{re.escape(begin)}.*?{re.escape(END)}", re.DOTALL)
        text = pattern.sub(lambda _, begin=begin, table=table: f"{begin}\n{table()}\n{END}", text)
    return text


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
