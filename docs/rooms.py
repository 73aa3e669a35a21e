"""Draws the rooms and three ways through them, `docs/_static/rooms.svg`: `python docs/rooms.py`.

Names and order of `cycloid_fmu` and `fitting` are those of `[tool.importlinter]` in `pyproject.toml`; in `drivers` a
room is above those that it imports. A test compares the drawing with the folders.
"""

import re
import tomllib
from pathlib import Path

import grimp

ROOT = Path(__file__).parents[1]
OUT = ROOT / "docs" / "_static" / "rooms.svg"
FRAME, RADIUS, TORQUE = "#1258a8", "#1d7a3c", "#b3261e"
WAYS = {
    FRAME: (
        "drivers.can",
        "drivers.encoders",
        "drivers.recorder",
        "drivers.recording_format",
        "fitting.readers",
        "fitting.transmission_error",
        "fitting.model",
        "fitting.estimation",
        "cycloid_fmu.surfaces",
    ),
    RADIUS: (
        "cycloid_fmu.geometry",
        "cycloid_fmu.errors",
        "cycloid_fmu.surfaces",
        "cycloid_fmu.drive_value",
        "cycloid_fmu.contact",
        "cycloid_fmu.analysis",
        "cycloid_fmu.fmu",
    ),
    TORQUE: (
        "cycloid_fmu.edge",
        "cycloid_fmu.drive",
        "cycloid_fmu.analysis",
        "cycloid_fmu.contact",
        "cycloid_fmu.supports",
        "cycloid_fmu.fmu",
    ),
}
ROW, TOP, WIDE = 46, 108, 250
LEFT = {"drivers": 10, "fitting": 280, "cycloid_fmu": 550}
KNOWS = {"drivers": "encoders and buses", "fitting": "measurements", "cycloid_fmu": "the drive"}


def layers_stated(package: str) -> list[list[str]]:
    """Return the layers of a package as `pyproject.toml` has them, from the top."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    contracts = settings["tool"]["importlinter"]["contracts"]
    (contract,) = (c for c in contracts if c["type"] == "layers" and c["containers"] == [package])
    return [re.split(r"\s*[|:]\s*", layer) for layer in contract["layers"]]


def layers_found(package: str) -> list[list[str]]:
    """Return the rooms of a package (its folders) in layers: each above all that it imports."""
    graph = grimp.build_graph(package, cache_dir=None)
    rooms = {path.parent.name for path in (ROOT / package).glob("*/__init__.py")}
    imports = {
        room: {
            other
            for other in rooms - {room}
            if graph.direct_import_exists(importer=f"{package}.{room}", imported=f"{package}.{other}", as_packages=True)
        }
        for room in rooms
    }
    levels: list[list[str]] = []
    while rooms:
        lowest = sorted(room for room in rooms if not imports[room] & rooms)
        levels.insert(0, lowest)
        rooms -= set(lowest)
    return levels


def drawing() -> str:
    """Return the drawing as SVG."""
    columns = {"drivers": layers_found("drivers")} | {name: layers_stated(name) for name in ("fitting", "cycloid_fmu")}
    deep = max(sum((len(rooms) + 1) // 2 for rooms in layers) for layers in columns.values())
    height = TOP + deep * ROW + 100
    drawn = []

    def words(x: float, y: float, text: str, style: str = "") -> None:
        drawn.append(f'<text x="{x:g}" y="{y:g}" dominant-baseline="central" {style}>{text}</text>')

    for package, layers in columns.items():
        left = LEFT[package]
        drawn.append(
            f'<rect x="{left}" y="10" width="{WIDE}" height="{TOP + deep * ROW - 14}" rx="8" fill="#f3f5f8" '
            'stroke="#9aa7b5"/>'
        )
        words(left + WIDE / 2, 36, package, 'text-anchor="middle" font-size="23" font-weight="bold"')
        words(left + WIDE / 2, 64, f"knows {KNOWS[package]}", 'text-anchor="middle" fill="#555"')
        rows = [(rooms[n : n + 2], len(rooms) - n) for rooms in layers for n in range(0, len(rooms), 2)]
        for row, (rooms, left_of_layer) in enumerate(rows, start=deep - len(rows)):  # what all import is at the bottom
            wide = (WIDE - 16 - 6 * (len(rooms) - 1)) / len(rooms)
            y = TOP - 14 + row * ROW
            if left_of_layer > 2:
                band = f'x="{left + 4}" y="{y - 4}" width="{WIDE - 8}" height="{2 * ROW + 2}"'
                drawn.append(f'<rect {band} rx="7" fill="#d5dde8"/>')
            for place, room in enumerate(rooms):
                x = left + 8 + place * (wide + 6)
                name = f"{package}.{room}"
                on_ways = [(colour, way.index(name) + 1) for colour, way in WAYS.items() if name in way]
                size = min(18.0, 1.75 * (wide - 6 - 27 * len(on_ways)) / len(room))
                drawn.append(
                    f'<rect id="{name}" x="{x:g}" y="{y}" width="{wide:g}" height="{ROW - 6}" rx="5" fill="#fff" '
                    'stroke="#345"/>'
                )
                words(x + 6, y + ROW / 2 - 3, room, f'font-size="{size:.3g}"')
                for number, (colour, step) in enumerate(on_ways):
                    right = x + wide - 15 - 27 * number
                    drawn.append(f'<circle cx="{right:g}" cy="{y + ROW / 2 - 3:g}" r="12" fill="{colour}"/>')
                    style = 'text-anchor="middle" fill="#fff" font-size="16"'
                    words(right, y + ROW / 2 - 3, str(step), style)
    below = TOP + deep * ROW + 20
    for place, (colour, text) in enumerate(
        ((FRAME, "a frame from a bus"), (RADIUS, "a pin radius"), (TORQUE, "a torque"))
    ):
        x = 24 + 270 * place
        drawn.append(f'<circle cx="{x}" cy="{below}" r="12" fill="{colour}"/>')
        words(x + 20, below, text)
    note = 'fill="#555" font-size="17"'
    words(
        12, below + 40, "Imports go down a column, never within a row or a dark band. Between columns there are", note
    )
    words(
        12, below + 64, "fitting → cycloid_fmu, fitting → drivers.recording_format, drivers → cycloid_fmu.edge.", note
    )
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 810 {height + 10}" role="img" font-family="sans-serif" '
        'font-size="18">\n<title>The rooms of the three packages, and the ways of a frame, a pin radius and a torque '
        f'through them</title>\n<rect width="810" height="{height + 10}" fill="#fff"/>\n'
        + "\n".join(drawn)
        + "\n</svg>\n"
    )


if __name__ == "__main__":
    OUT.write_text(drawing(), encoding="utf-8")
