"""Profiles in files: DXF, SVG, CSV and STEP, in mm."""

from __future__ import annotations

import csv
import importlib
import math
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.cad.layers import LAYERS, MM, about, circles, corners, crosses, outlines

if TYPE_CHECKING:
    from cycloid_fmu.cad.outline import Array, Points
    from cycloid_fmu.cad.profile import Profile

_COLOURS = {"DISC": "#000000", "PINS": "#0060c0", "RING": "#808080", "HOLES": "#c00000"}
_INDICES = {"DISC": 7, "PINS": 5, "RING": 8, "HOLES": 1}  # AutoCAD colour indices
# Columns of the table: unit in the file, None for a number without unit, and its factor from SI.
_COLUMNS = {
    "tooth": (None, 1.0),
    "arc_length": ("mm", MM),
    "angle": ("deg", 180.0 / math.pi),
    "x": ("mm", MM),
    "y": ("mm", MM),
    "normal_x": (None, 1.0),
    "normal_y": (None, 1.0),
    "curvature": ("1/mm", 1.0 / MM),
}
_FLAT = 1e-9  # bulge below which an arc is written as a line: its sagitta is below 1e-9 of the chord


def write(profile: Profile, path: str | os.PathLike[str]) -> None:
    """Write a profile in the format given by the ending of the name, as `Profile.write` does."""
    target = edge.output_path(path, "path", WRITERS)
    needs, writer = WRITERS[target.suffix.lower()]
    if needs is not None:
        check_library(*needs, target)
    with edge.written_whole(target) as temporary:
        writer(profile, temporary)


def check_library(module: str, extra: str, target: Path) -> None:
    """Raise an `edge.ArgumentError` that names the extra if the library of a format is missing."""
    other = "; .svg and .csv need no extra" if extra == "cad" else "; .dxf and .svg do not need it"
    with edge.needs_extra(extra, lambda said: edge.ArgumentError("path", said + other, target)):
        importlib.import_module(module)


def _write_csv(profile: Profile, path: Path) -> None:
    columns = []
    for name, values in profile.table.items():
        digits = ".0f" if name == "tooth" else ".15g"
        columns.append([format(value * _COLUMNS[name][1], digits) for value in values.tolist()])
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(name if unit is None else f"{name} [{unit}]" for name, (unit, _) in _COLUMNS.items())
        writer.writerows(zip(*columns, strict=True))


def _write_dxf(profile: Profile, path: Path) -> None:
    import ezdxf
    from ezdxf import units

    document = ezdxf.new("R2010", units=units.MM)  # type: ignore[attr-defined]
    for name, value in about(profile).items():
        document.header.custom_vars.append(name, value)
    for name in LAYERS:
        document.layers.add(name, color=_INDICES[name])
    space = document.modelspace()
    for layer, start, bulge in outlines(profile):
        outline = zip(start.real.tolist(), start.imag.tolist(), bulge.tolist(), strict=True)
        space.add_lwpolyline(outline, format="xyb", close=True, dxfattribs={"layer": layer})
    for layer, place, radius in circles(profile):
        space.add_circle((place.real, place.imag), radius, dxfattribs={"layer": layer})
    for one, other in crosses(profile):
        space.add_line((one.real, one.imag), (other.real, other.imag), dxfattribs={"layer": "HOLES"})
    low, high = (MM * corner for corner in corners(profile))
    space.reset_extents((low.real, low.imag, 0.0), (high.real, high.imag, 0.0))
    middle = 0.5 * (low + high)
    document.set_modelspace_vport(1.05 * abs(high - low), (middle.real, middle.imag))  # the view at opening
    document.saveas(path)


def svg_path(start: Points, bulges: Array) -> str:
    """Return an outline by starts (mm) and bulges of its arcs as the data of an SVG path, in mm, y up."""
    end = np.roll(start, -1)
    written = [f"M{_pair(start[0])}"]
    for one, other, bulge in zip(start.tolist(), end.tolist(), bulges.tolist(), strict=True):
        if abs(bulge) < _FLAT:
            written.append(f"L{_pair(other)}")
            continue
        radius = abs(other - one) * (1.0 + bulge * bulge) / (4.0 * abs(bulge))
        written.append(f"A{radius:.15g} {radius:.15g} 0 {int(abs(bulge) > 1.0)} {int(bulge > 0.0)} {_pair(other)}")
    return " ".join([*written, "Z"])


def _pair(point: complex) -> str:
    return f"{point.real:.15g} {point.imag:.15g}"


def _write_svg(profile: Profile, path: Path) -> None:
    low, high = (MM * corner for corner in corners(profile))
    side = 2.0 * math.ceil(1.02 * max(-low.real, -low.imag, high.real, high.imag))
    root = ElementTree.Element(
        "svg",
        {
            "xmlns": "http://www.w3.org/2000/svg",
            "width": f"{side:g}mm",
            "height": f"{side:g}mm",
            "viewBox": f"{-side / 2:g} {-side / 2:g} {side:g} {side:g}",
        },
    )
    ElementTree.SubElement(root, "desc").text = ", ".join(f"{name}: {value}" for name, value in about(profile).items())
    up = ElementTree.SubElement(
        root, "g", {"transform": "scale(1 -1)", "fill": "none", "stroke-width": f"{side / 600:g}"}
    )
    layers = {name: ElementTree.SubElement(up, "g", {"id": name, "stroke": _COLOURS[name]}) for name in LAYERS}
    for layer, start, bulge in outlines(profile):
        ElementTree.SubElement(layers[layer], "path", {"d": svg_path(start, bulge)})
    for layer, place, radius in circles(profile):
        round_ = {"cx": place.real, "cy": place.imag, "r": radius}
        ElementTree.SubElement(layers[layer], "circle", {name: f"{value:.15g}" for name, value in round_.items()})
    for one, other in crosses(profile):
        ElementTree.SubElement(layers["HOLES"], "path", {"d": f"M{_pair(one)} L{_pair(other)}"})
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(path, encoding="utf-8", xml_declaration=True)


def _write_step(profile: Profile, path: Path) -> None:
    from cycloid_fmu.cad.step import write_step

    write_step(profile, path)


_DXF: tuple[str, str] = ("ezdxf", "cad")
_STEP: tuple[str, str] = ("OCP", "step")
WRITERS: dict[str, tuple[tuple[str, str] | None, Callable[[Any, Path], None]]] = {
    ".dxf": (_DXF, _write_dxf),
    ".svg": (None, _write_svg),
    ".csv": (None, _write_csv),
    ".step": (_STEP, _write_step),
    ".stp": (_STEP, _write_step),
}
