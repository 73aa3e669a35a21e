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
from cycloid_fmu.fmu.description import Version
from cycloid_fmu.fmu.variables import Interface, Variable
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.profile import flank_points

_FLANGE = "Modelica.Mechanics.Rotational.Interfaces.Flange_"
_SUPPORT = "Modelica.Mechanics.Rotational.Interfaces.Support"
_HEAT_PORT = "Modelica.Thermal.HeatTransfer.Interfaces.HeatPort_a"
DRIVE = "documentation/drive.toml"  # pair file of the FMU's drive
_PAGE = """<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>Cycloid drive</title>
<style>body{font-family:sans-serif;max-width:60em;margin:2em auto;padding:0 1em}
td,th{text-align:left;padding:.15em .8em .15em 0;border-bottom:1px solid #ccc;vertical-align:top}</style></head><body>
<h1>Cycloid drive {{ g.gear_teeth }}/{{ g.pins }}, {{ interface.kind }} interface</h1>
<p>Pin circle radius {{ '%g' % (g.pin_circle_radius * 1e3) }} mm, pin radius {{ '%g' % (g.pin_radius * 1e3) }} mm,
eccentricity {{ '%g' % (g.eccentricity * 1e3) }} mm, ratio {{ '%g' % ratio }}{% if g.discs > 1 %}, {{ g.discs }}
discs{% endif %}. Made by cycloid-fmu {{ version }}.</p>
<p>Angles are counter-clockwise; torques are positive into the drive at their flange, as in Modelica.</p>
{% if interface.kind == "kinematic" %}<p>The drive is quasi-static: a step moves it to the inputs set before it,
whatever its length. At zero torque the output floats within the backlash until a flank drives it; with friction it
rests until torque or crank move it.</p>
{% else %}<p>Both torques are derivatives of one energy stored in the contacts. Between communication points the flanges
continue at their speeds, so set speeds consistent with the angles. A step longer than <code>largest_step</code> is
divided internally. {% if interface.output_inertia %}The output's inertia is internal and solved in sub-steps that
conserve the energy balance; <code>flange_a.tau</code> is the mean over the last step{% elif interface.rotor_alone %}
The {{ interface.driven }}'s inertia is internal, and the arm is in the host. Before each step set the arm's angle and
speed, <code>arm_inertia</code> and <code>arm_torque</code>, all at its beginning; after it apply
&minus;<code>flange_b.tau</code> to the arm over the step, and then give the arm <code>arm_angle</code>{% else
%}The contacts are stiff:
with a body of inertia J on the output, the step h must keep h &radic;(k/J) well below 1, with k =
<code>torsional_stiffness</code>{% endif %}.</p>{% endif %}
<p>A step that can't be made returns an error with a message and leaves the state unchanged.</p>
<h2>Variables</h2>
<table><tr><th>name<th>causality<th>unit<th>meaning</tr>
{% for v in table %}<tr><td><code>{{ v.name }}</code><td>{{ v.causality }}<td>{{ v.unit or "" }}<td>{{ v.description }}
</tr>{% endfor %}</table>
<h2>Friction and losses</h2>
<p>At each flange the sliding friction torque is (coulomb + load_share |load| + stribeck
exp(-(w/stribeck_speed)&sup2;) + viscous |w|) exp(-temperature_coefficient (temperature - reference_temperature));
<code>friction_torque</code> is the output's Coulomb friction. Friction builds up over the presliding angle in springs
that slip one after the other: it holds a load without creep, and its loops close at their reversals.</p>
<p><code>loss_table</code> is <code>lossTable</code> of Modelica's LossyGear: speed of flange_a, efficiency from a to b
and from b to a, friction torque at flange_a in the same two cases; linear between the rows, constant beyond the
last.{% if interface.lubricant %} The speed is multiplied by the lubricant's viscosity at the present temperature
over that at <code>lubricant.temperature</code> (ASTM D341).{% endif %}</p>{% if interface.thermal %}
<p>The temperature of the oil is a state: heat_capacity dT/dt = power_loss + heat_port.Q_flow - (T -
ambient_temperature)/thermal_resistance.</p>{% endif %}
</body></html>
"""


def documentation(pair: Pair, interface: Interface, table: Sequence[Variable]) -> str:
    """Return the documentation page (HTML)."""
    import jinja2

    page = jinja2.Environment(autoescape=True, undefined=jinja2.StrictUndefined).from_string(_PAGE)
    return page.render(g=pair, ratio=pair.ratio, interface=interface, table=table, version=__version__)


def terminals(interface: Interface) -> bytes:
    """Return `terminalsAndIcons.xml` of FMI 3.0: both flanges as in Modelica, with the torque as inflow."""
    root = Element("fmiTerminalsAndIcons", fmiVersion="3.0")
    graphical = SubElement(root, "GraphicalRepresentation")
    corners = {"x1": "-100", "y1": "-100", "x2": "100", "y2": "100"}
    SubElement(graphical, "CoordinateSystem", {**corners, "suggestedScalingFactorTo_mm": "0.1"})
    SubElement(graphical, "Icon", corners)
    node = SubElement(root, "Terminals")
    ends = [("flange_a", _FLANGE + "a", f"{interface.driven} side"), ("flange_b", _FLANGE + "b", "output side")]
    if interface.support_flange:
        ends.append(("support", _SUPPORT, "housing"))
    for end, kind_of_end, text in ends:
        flange = SubElement(node, "Terminal", name=end, matchingRule="plug", terminalKind=kind_of_end, description=text)
        for member, kind in (("phi", "signal"), ("w", "signal"), ("tau", "inflow")):
            SubElement(
                flange,
                "TerminalMemberVariable",
                variableName=f"{end}.{member}",
                memberName=member,
                variableKind=kind,
            )
    if interface.thermal is not None:
        port = SubElement(
            node, "Terminal", name="heat_port", matchingRule="plug", terminalKind=_HEAT_PORT, description="oil"
        )
        for member, kind in (("T", "signal"), ("Q_flow", "inflow")):
            SubElement(
                port,
                "TerminalMemberVariable",
                variableName=f"heat_port.{member}",
                memberName=member,
                variableKind=kind,
            )
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
