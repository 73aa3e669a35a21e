"""The drive and one tooth as small SVG pictures for a page that shows every change at once.

`drive_picture` draws the same for papers and reports; matplotlib takes half a second for it.
"""

from __future__ import annotations

import html

import numpy as np

from cycloid_fmu.draw.drive_picture import EDGE, FREE, LONGEST_ARROW, PRESSURES, STEEL, close_up, drive_name, holders
from cycloid_fmu.motion import Motion, Points

_THIN = f'stroke="{EDGE}" stroke-width=".8" vector-effect="non-scaling-stroke"'
_LINE = 'fill="none" vector-effect="non-scaling-stroke"'


def pressure_colour(part: float) -> str:
    """Return the colour of a pressure, given as a fraction of the largest, 0 to 1."""
    channels = np.array([[int(colour[i : i + 2], 16) for i in (1, 3, 5)] for colour in PRESSURES])
    places = np.linspace(0.0, 1.0, len(PRESSURES))
    return "#" + "".join(f"{round(float(np.interp(part, places, channel))):02x}" for channel in channels.T)


def _path(points: Points, closed: bool = False) -> str:
    """Points, m, as an SVG path in mm."""
    places = (points * 1e3).ravel()
    # One format string for all points takes half as long as one per point.
    return "M" + "L".join(["%.3f %.3f"] * places.size) % tuple(places.view(float).tolist()) + "Z" * closed


def _circle(centre: complex, radius: float, fill: str, more: str = "", inside: str = "") -> str:
    return (
        f'<circle cx="{centre.real * 1e3:.4f}" cy="{centre.imag * 1e3:.4f}" r="{radius * 1e3:.4f}" fill="{fill}" '
        f"{_THIN} {more}>{inside}</circle>"
    )


def _arrow(begin: complex, step: complex, rim: float) -> str:
    """Return an arrow with a start, a vector and a head of at most a twentieth of the rim's radius."""
    length = abs(step)
    head = min(0.35 * length, 0.05 * rim)
    neck, wide, thin = length - head, 0.5 * head, 0.22 * head
    shape = np.array(
        [thin * 1j, neck + thin * 1j, neck + wide * 1j, length, neck - wide * 1j, neck - thin * 1j, -thin * 1j]
    )
    return _path(begin + step / length * shape, closed=True)


def _svg(name: str, box: tuple[float, float, float, float], title: str, drawn: list[str]) -> str:
    """Frame drawn elements, in mm with y upwards; `box` is left, lower, width and height, mm."""
    left, low, width, height = box
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" id="{name}" role="img" aria-label="{html.escape(title)}" '
        f'viewBox="{left:.3f} {-low - height:.3f} {width:.3f} {height:.3f}"><g transform="scale(1 -1)">'
        + "".join(drawn)
        + "</g></svg>"
    )


def drive_svg(motion: Motion, load: int = 0, angle: int = 0) -> str:
    """Return the drive at one load and crank angle: discs, pins, supports and forces, with exaggerated gaps.

    Pins are coloured by pressure (`PRESSURES`) and have a tooltip with force and pressure, or gap.
    """
    pair = motion.pair
    pressure, forces, gaps = motion.pressure[load, angle], motion.force[load, angle], motion.nearest[load, angle]
    highest, largest = max(float(pressure.max()), 1.0), max(float(forces.max()), 1e-12)
    rim = pair.pin_circle_radius + 2.2 * pair.pin_radius
    drawn = [_circle(0j, rim, "#f4f6f8"), _circle(0j, pair.pin_circle_radius, "#ffffff")]
    for disc in range(pair.discs - 1, -1, -1):
        behind = 'fill="none" stroke-dasharray="4 3"' if disc else f'fill="{STEEL}"'
        outline = _path(motion.outline(load, angle, disc), closed=True)
        drawn.append(f'<path id="disc-{disc}" d="{outline}" {behind} {_THIN}/>')
    for one in holders(motion, load, angle):
        drawn.append(_circle(one.centre, one.radius, "#ffffff" if one.hole else "#c3ccd6"))
    towards = np.exp(1j * motion.crank_angle[angle])
    reach = np.array([0.0, 0.35 * pair.pin_circle_radius * towards])
    drawn.append(f'<path d="{_path(reach)}" {_LINE} stroke="#111111" stroke-dasharray="8 3 2 3"/>')
    drawn.append(_circle(complex(pair.eccentricity * towards), 0.01 * rim, "#111111"))
    for pin, (axis, radius) in enumerate(zip(motion.pin_axis[load, angle], motion.pin_radius, strict=True)):
        carried = float(pressure[:, pin].max())
        said = f"gap {gaps[:, pin].min() * 1e6:.1f} µm"
        if carried > 0.0:
            said = f"{forces[:, pin].sum():.0f} N, {carried * 1e-6:.0f} MPa"
        fill = pressure_colour(carried / highest) if carried > 0.0 else FREE
        drawn.append(_circle(axis, float(radius), fill, 'class="pin"', f"<title>pin {pin}: {said}</title>"))
    for disc, pin, side in np.argwhere(forces > 0.01 * largest):
        direction = complex(motion.direction[load, angle, disc, pin, side])
        begin = motion.pin_axis[load, angle, pin] + motion.pin_radius[pin] * direction
        step = direction * LONGEST_ARROW * pair.pin_circle_radius * forces[disc, pin, side] / largest
        fill = "#ffffff" if disc else pressure_colour(float(pressure[disc, pin]) / highest)
        drawn.append(f'<path class="force" d="{_arrow(begin, step, rim)}" fill="{fill}" {_THIN}/>')
    edge = (rim * 1.01) * 1e3
    return _svg("drive", (-edge, -edge, 2.0 * edge, 2.0 * edge), drive_name(motion), drawn)


def tooth_svg(motion: Motion) -> str:
    """Return the tooth with the largest deviation: without modification, as drawn and as made, exaggerated."""
    found = close_up(motion)
    drawn = []
    for one in found.curves:
        dashes = 'stroke-dasharray="5 4"' if one.dashed else ""
        drawn.append(f'<path d="{_path(one.points)}" {_LINE} stroke="{one.colour}" stroke-width="1.6" {dashes}/>')
    every = np.concatenate([one.points for one in found.curves]) * 1e3
    box = (every.real.min() - 0.1, every.imag.min() - 0.1, np.ptp(every.real) + 0.2, np.ptp(every.imag) + 0.2)
    return _svg("tooth", box, found.title, drawn)
