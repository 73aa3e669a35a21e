"""Further files of every FMU: documentation, icon, licences and terminals."""

from __future__ import annotations

import io
import os
import zipfile
from collections.abc import Mapping, Sequence
from importlib import metadata
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from cycloid_fmu import __version__
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import packaged_text
from cycloid_fmu.fmu.description import Version
from cycloid_fmu.fmu.variables import Interface, Variable
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.profile import flank_points

_FLANGE = "Modelica.Mechanics.Rotational.Interfaces.Flange_"
_SUPPORT = "Modelica.Mechanics.Rotational.Interfaces.Support"
_HEAT_PORT = "Modelica.Thermal.HeatTransfer.Interfaces.HeatPort_a"
DRIVE = "documentation/drive.toml"  # pair file of the FMU's drive


def documentation(pair: Pair, interface: Interface, table: Sequence[Variable]) -> str:
    """Return the documentation page (HTML)."""
    import jinja2

    text = packaged_text("cycloid_fmu.fmu", "documentation.html")
    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(text)
    return page.render(g=pair, ratio=pair.ratio, interface=interface, table=table, version=__version__)


def terminals(interface: Interface) -> bytes:
    """Return `terminalsAndIcons.xml` of FMI 3.0: both flanges as in Modelica, with the torque as inflow."""
    root = Element("fmiTerminalsAndIcons", fmiVersion="3.0")
    graphical = SubElement(root, "GraphicalRepresentation")
    corners = {"x1": "-100", "y1": "-100", "x2": "100", "y2": "100"}
    SubElement(graphical, "CoordinateSystem", {**corners, "suggestedScalingFactorTo_mm": "0.1"})
    SubElement(graphical, "Icon", corners)
    node = SubElement(root, "Terminals")
    rotational = {"phi": "signal", "w": "signal", "tau": "inflow"}
    ends = [
        ("flange_a", _FLANGE + "a", f"{interface.driven} side", rotational),
        ("flange_b", _FLANGE + "b", "output side", rotational),
    ]
    if interface.support_flange:
        ends.append(("support", _SUPPORT, "housing", rotational))
    if interface.thermal is not None:
        ends.append(("heat_port", _HEAT_PORT, "oil", {"T": "signal", "Q_flow": "inflow"}))
    for end, kind_of_end, text, members in ends:
        port = SubElement(node, "Terminal", name=end, matchingRule="plug", terminalKind=kind_of_end, description=text)
        for member, kind in members.items():
            names = {"variableName": f"{end}.{member}", "memberName": member, "variableKind": kind}
            SubElement(port, "TerminalMemberVariable", names)
    indent(root)
    return bytes(tostring(root, encoding="utf-8", xml_declaration=True))


def icon(pair: Pair) -> bytes:
    """Return a picture of the gear in its pins (PNG, 256 x 256)."""
    from matplotlib.figure import Figure
    from matplotlib.patches import Circle, Polygon

    g = pair
    figure = Figure(figsize=(2.56, 2.56))
    axes = figure.add_axes((0.0, 0.0, 1.0, 1.0))
    axes.set_axis_off()
    axes.set_aspect("equal")
    x, y = flank_points(pair, np.linspace(0.0, 2.0 * np.pi, 60 * g.gear_teeth))
    # As artists, not patches: the limits are given, so none of them needs to be looked for.
    axes.add_artist(Polygon(np.stack([x + g.eccentricity, y], axis=-1), color="#9fb4c7", ec="#33475b", lw=0.8))
    around = 2.0 * np.pi * np.arange(g.pins) / g.pins
    for angle in around:
        centre = g.pin_circle_radius * np.cos(angle), g.pin_circle_radius * np.sin(angle)
        axes.add_artist(Circle(centre, g.pin_radius, color="#33475b"))
    outer = 1.04 * (g.pin_circle_radius + g.pin_radius)
    axes.add_artist(Circle((0.0, 0.0), outer, fill=False, ec="#33475b", lw=2.0))
    axes.add_artist(Circle((g.eccentricity, 0.0), 0.3 * g.pin_circle_radius, color="#33475b"))
    axes.set(xlim=(-1.03 * outer, 1.03 * outer), ylim=(-1.03 * outer, 1.03 * outer))
    with io.BytesIO() as file:
        figure.savefig(file, dpi=100, format="png", transparent=True)
        return file.getvalue()


def licences(packages: Sequence[str]) -> str:
    """Return the licence texts of this package and of other packages with files in the FMU."""
    sections = []
    for package in ("cycloid-fmu", *packages):
        texts = [f.read_text() for f in metadata.files(package) or [] if f.name.upper().startswith("LICENSE")]
        sections.append(f"{package}\n{'=' * len(package)}\n\n" + "\n".join(texts))
    return "\n\n".join(sections)


def parts(
    drive: DriveValue,
    interface: Interface,
    table: Sequence[Variable],
    version: Version,
    packages: Sequence[str] = (),
) -> dict[str, bytes]:
    """Return the files to add to an FMU's archive: {path in the archive: content}.

    Parameters
    ----------
    drive, interface, table, version
        Content of the FMU.
    packages
        Installed packages with files in the FMU, for their licences.
    """
    pair = drive.pair
    files = {
        "documentation/index.html": documentation(pair, interface, table).encode(),
        DRIVE: f"# drive {drive.hash}\n{drive.text}".encode(),
        "documentation/licenses/license.txt": licences(packages).encode(),
    }
    if version == "2.0":
        return {**files, "model.png": icon(pair)}
    return {
        **files,
        "terminalsAndIcons/terminalsAndIcons.xml": terminals(interface),
        "terminalsAndIcons/icon.png": icon(pair),
    }


def write_archive(path: str | os.PathLike[str], contents: Mapping[str, bytes]) -> None:
    """Write an FMU of these files, {path in the archive: content}; the same contents give the same bytes."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            entry = zipfile.ZipInfo(name)  # without a time stamp
            entry.compress_type, entry.external_attr = zipfile.ZIP_DEFLATED, 0o644 << 16
            archive.writestr(entry, content)
