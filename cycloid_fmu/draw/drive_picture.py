"""A picture of the drive: discs, pins, supports, contacts and forces, with exaggerated gaps and errors."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from cycloid_fmu.draw.figure import at_least, figure_of_names, show_legend
from cycloid_fmu.edge import ARCSEC
from cycloid_fmu.motion import Motion, Points, along, round_number, tooth_turns

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.colors import Colormap
    from matplotlib.figure import Figure

PRESSURES = ("#ffe9a8", "#fdb94d", "#ee6a33", "#bf1f2e", "#5c0d2b")
"""Colours of the contact pressure from low to high."""
FREE, STEEL, EDGE, BEHIND = "#ffffff", "#dfe5ec", "#46525f", "#7d8ea3"
_ARROW = "simple,tail_width=1.4,head_width=5,head_length=6"
LONGEST_ARROW = 0.3  # of the pin circle's radius
_FLAT = 1e-9  # m: deviations below are rounding
_CLOSE_UP = 0.4  # of the tooth's height: drawn size of the largest deviation of a close-up


class Circle(NamedTuple):
    """A circle of the disc supports: centre and radius, m, and whether it is a hole in the front disc."""

    centre: complex
    radius: float
    hole: bool


def holders(motion: Motion, load: int, angle: int) -> list[Circle]:
    """Return the supports of the front disc: cranks or output rollers in its holes, and the eccentric.

    Sizes that are not stated are chosen to fit.
    """
    pair, theta = motion.pair, motion.crank_angle[angle]
    supports, e = pair.supports, pair.eccentricity
    crank, centre = complex(np.exp(1j * theta)), complex(motion.centre[load, angle, 0])
    found = []
    middle = 0.22 * pair.pin_circle_radius
    if supports is not None:
        around = np.exp(1j * (supports.first_angle + 2.0 * np.pi * np.arange(supports.count) / supports.count))
        carrier = motion.transmission_error[load, angle] - theta / pair.gear_teeth
        places = supports.circle_radius * around * np.exp(1j * carrier)
        holes = centre + supports.circle_radius * around * np.exp(1j * motion.rotation[load, angle, 0])
        radius = hole_radius(motion)
        middle = min(middle, 0.8 * (supports.circle_radius - radius))
        if supports.kind == "output_rollers" and supports.turning_arm.raceway_diameter is not None:
            middle = 0.5 * supports.turning_arm.raceway_diameter
        for place, hole in zip(places, holes, strict=True):
            found.append(Circle(complex(hole), radius, True))
            if supports.kind == "cranks":
                found += [Circle(place + e * crank, 0.94 * radius, False), Circle(place, radius - 1.5 * e, False)]
            else:
                found.append(Circle(complex(place), radius - e, False))
    if supports is None or supports.kind == "output_rollers":
        found += [Circle(centre, middle, True), Circle(e * crank, 0.94 * middle, False)]
        found.append(Circle(0j, max(0.94 * middle - 2.0 * e, 0.3 * middle), False))
    return found


def hole_radius(motion: Motion) -> float:
    """Radius of the holes for cranks or output rollers, m: as stated, or chosen to fit."""
    pair, supports = motion.pair, motion.pair.supports
    assert supports is not None
    roller, raceway = supports.output_roller, supports.turning_arm.raceway_diameter
    if supports.kind == "cranks" and raceway is not None:
        return 0.5 * raceway
    if roller is not None and roller.radius is not None:
        return roller.radius + pair.eccentricity
    root = pair.pin_circle_radius - pair.eccentricity - pair.pin_radius
    beside = math.pi * supports.circle_radius / supports.count
    return min(0.7 * (root - supports.circle_radius), 0.7 * beside, 0.35 * supports.circle_radius)


def sizes_are_stated(motion: Motion) -> bool:
    """Whether the pair states the sizes of the circles that `holders` returns."""
    supports = motion.pair.supports
    return supports is not None and supports.kind == "cranks" and supports.turning_arm.raceway_diameter is not None


def drive_name(motion: Motion) -> str:
    """Return the name of the drive for titles."""
    pair = motion.pair
    many = f", {pair.discs} discs" if pair.discs > 1 else ""
    return f"Cycloid drive {pair.gear_teeth}/{pair.pins}{many}" + (", ring output" if pair.output == "ring" else "")


def caption_of(motion: Motion) -> str:
    """Return the caption: exaggeration, arrows and colours."""
    said = f"Gaps between disc and pins × {motion.exaggeration:g}"
    if motion.exaggeration * motion.nearest.max() > motion.room:
        said += f", up to {motion.room * 1e3:.2g} mm as drawn"
    said += "; pins, discs and angles are to scale. Arrows: forces of the pins on the disc. Dash-dotted: the crank."
    if motion.pair.discs > 1:
        said += " Front disc filled; discs behind dashed, with hollow arrows."
    if motion.behind_first_stage:
        said += " Only the cycloid stage: the torque is on its output."
    if not sizes_are_stated(motion):
        said += " Shafts and bearings are not to scale."
    return said


def pressure_colours() -> Colormap:
    """Colours from zero to the largest pressure."""
    from matplotlib.colors import LinearSegmentedColormap

    return LinearSegmentedColormap.from_list("pressure", PRESSURES)


def _closed(outline: np.ndarray) -> np.ndarray:
    ring = np.append(outline, outline[:1]) * 1e3
    return np.stack([ring.real, ring.imag], axis=1)


def draw_drive(axis: Axes, motion: Motion, load: int = 0, angle: int = 0) -> None:
    """Draw the drive at one load and crank angle."""
    rim = (motion.pair.pin_circle_radius + 2.2 * motion.pair.pin_radius) * 1e3
    _draw_bodies(axis, motion, load, angle, rim)
    _draw_pins(axis, motion, load, angle)
    _draw_forces(axis, motion, load, angle)
    if motion.force[load, angle].any():
        _draw_scales(axis, motion, load, angle, rim)
    axis.set(xlim=(-1.04 * rim, 1.04 * rim), ylim=(-1.09 * rim, 1.04 * rim), aspect="equal")
    axis.set_axis_off()


def _draw_bodies(axis: Axes, motion: Motion, load: int, angle: int, rim: float) -> None:
    """Draw the housing of radius `rim`, mm, discs, supports and crank."""
    from matplotlib.patches import Circle as Round
    from matplotlib.patches import Polygon

    pair = motion.pair
    axis.add_patch(Round((0.0, 0.0), rim, fc="#f4f6f8", ec=EDGE, lw=0.8))
    axis.add_patch(Round((0.0, 0.0), pair.pin_circle_radius * 1e3, fc="white", ec="#c3ccd6", lw=0.5))
    for disc in range(pair.discs - 1, -1, -1):
        fill: dict[str, Any] = (
            {"fc": STEEL, "ec": EDGE, "lw": 0.9} if disc == 0 else {"fill": False, "ec": BEHIND, "lw": 0.7, "ls": "--"}
        )
        order = 2.0 if disc == 0 else 2.5
        axis.add_patch(Polygon(_closed(motion.outline(load, angle, disc)), zorder=order, joinstyle="round", **fill))
    for circle in holders(motion, load, angle):
        face = "white" if circle.hole else "#c3ccd6"
        at = (circle.centre.real * 1e3, circle.centre.imag * 1e3)
        axis.add_patch(Round(at, circle.radius * 1e3, fc=face, ec=EDGE, lw=0.6, zorder=3))
    crank = pair.eccentricity * np.exp(1j * motion.crank_angle[angle]) * 1e3
    reach = 0.35 * pair.pin_circle_radius * 1e3 * crank / abs(crank)
    axis.plot([0.0, reach.real], [0.0, reach.imag], "-.", color="#111111", lw=0.7, zorder=4)
    axis.plot([0.0], [0.0], "+", color="#111111", ms=7, mew=0.9, zorder=4)
    axis.plot([crank.real], [crank.imag], "o", color="#111111", ms=3, zorder=4)


def _highest_pressure(motion: Motion, load: int, angle: int) -> float:
    """The pressure of the darkest colour, Pa."""
    return max(float(motion.pressure[load, angle].max()), 1.0)


def _arrow_scale(motion: Motion, load: int, angle: int) -> tuple[float, float]:
    """The length of the longest arrow, mm, and its force, N."""
    return LONGEST_ARROW * motion.pair.pin_circle_radius * 1e3, max(float(motion.force[load, angle].max()), 1e-12)


def _draw_pins(axis: Axes, motion: Motion, load: int, angle: int) -> None:
    """Draw the pins, coloured by their largest pressure."""
    from matplotlib.patches import Circle as Round

    colours, highest = pressure_colours(), _highest_pressure(motion, load, angle)
    pressures = motion.pressure[load, angle].max(axis=0)
    for place, radius, pressure in zip(
        motion.pin_axis[load, angle] * 1e3, motion.pin_radius * 1e3, map(float, pressures), strict=True
    ):
        filled = colours(pressure / highest) if pressure > 0.0 else FREE
        axis.add_patch(Round((place.real, place.imag), radius, fc=filled, ec=EDGE, lw=0.6, zorder=5))


def _draw_arrow(axis: Axes, begin: complex, end: complex, **colours: Any) -> None:
    from matplotlib.patches import FancyArrowPatch

    ends = (begin.real, begin.imag), (end.real, end.imag)
    axis.add_patch(FancyArrowPatch(*ends, arrowstyle=_ARROW, lw=0.4, shrinkA=0, shrinkB=0, zorder=6, **colours))


def _draw_forces(axis: Axes, motion: Motion, load: int, angle: int) -> None:
    """Draw the forces of the pins on the discs, those behind as hollow arrows."""
    colours, highest = pressure_colours(), _highest_pressure(motion, load, angle)
    longest, largest = _arrow_scale(motion, load, angle)
    forces = motion.force[load, angle]
    for disc, pin, side in np.argwhere(forces > 0.01 * largest):
        towards = motion.direction[load, angle, disc, pin, side]
        begin = (motion.pin_axis[load, angle][pin] + motion.pin_radius[pin] * towards) * 1e3
        end = begin + longest * forces[disc, pin, side] / largest * towards
        colour = colours(motion.pressure[load, angle][disc, pin] / highest)
        _draw_arrow(axis, begin, end, fc=colour if disc == 0 else "white", ec=EDGE if disc == 0 else BEHIND)
        axis.plot([begin.real], [begin.imag], ".", color="#111111", ms=2.5, zorder=7)


def _draw_scales(axis: Axes, motion: Motion, load: int, angle: int, rim: float) -> None:
    """Draw an arrow of a round force below the housing of radius `rim`, mm, and the colours of the pressure."""
    from matplotlib.cm import ScalarMappable

    longest, largest = _arrow_scale(motion, load, angle)
    force = round_number(largest)
    x, y = -rim, -rim - 2.0
    tip = x + longest * force / largest
    _draw_arrow(axis, complex(x, y), complex(tip, y), fc="#8a97a6", ec=EDGE)
    axis.text(tip + 1.5, y, f"{force:g} N", va="center", fontsize=8)
    shown = ScalarMappable(cmap=pressure_colours())
    shown.set_clim(0.0, _highest_pressure(motion, load, angle) * 1e-6)
    axis.figure.colorbar(
        shown, ax=axis, label="contact pressure [MPa]", orientation="horizontal", shrink=0.6, pad=0.01, aspect=30
    )


def draw_error(axis: Axes, motion: Motion, load: int = 0, angle: int = 0) -> None:
    """Draw the transmission error about its mean over a crank turn, and the crank's position."""
    curve, turn = motion.curve[load] * ARCSEC, np.degrees(motion.curve_angle)
    swept = motion.swept[load] * ARCSEC
    mean = swept.mean()
    axis.plot(turn, curve - mean, lw=0.9)
    now = math.degrees(motion.crank_angle[angle] % (2.0 * np.pi))
    axis.plot([now], [motion.transmission_error[load, angle] * ARCSEC - mean], "o", color="#bf1f2e", ms=5)
    at_least(axis, 0.01)
    axis.set(xlabel="crank angle [°]", ylabel="TE - mean [arcsec]", xlim=(0.0, 360.0))
    axis.set_xticks(np.arange(0, 361, 90))
    axis.set_title(f"transmission error: mean {mean:.2f}″, peak to peak {np.ptp(swept):.2f}″", fontsize=9)


class ToothCurve(NamedTuple):
    """A curve of a close-up: its name with the range of its deviations, colour, dashes, points (m, tip upwards)."""

    label: str
    colour: str
    dashed: bool
    points: Points


class CloseUp(NamedTuple):
    """One tooth: its title, which states the exaggeration, and its curves, the unmodified one first."""

    title: str
    curves: list[ToothCurve]


def close_up(motion: Motion) -> CloseUp:
    """Return the tooth with the largest deviation: without modification, as drawn, and as made or worn."""
    pair, raised = motion.pair, motion.raised
    disc, tooth, _ = np.unravel_index(np.abs(raised).round(10).argmax(), raised.shape)
    drawn = along(motion.drawn - motion.unmodified, motion.normal)
    made = raised[disc, tooth]
    largest = float(np.abs([drawn, made]).max())
    factor = round_number(_CLOSE_UP * 2.0 * pair.eccentricity / largest) if largest > _FLAT else 1.0
    curves = [("unmodified", "#111111", motion.unmodified, 0.0 * drawn)]
    if np.abs(drawn).max() > _FLAT:
        curves.append(("as drawn", "#1f77b4", motion.drawn, drawn))
    if np.abs(made - drawn).max() > _FLAT:
        curves.append(("as made", "#bf1f2e", motion.made[disc, tooth] / tooth_turns(pair)[tooth], made))
    upright = 1j * np.exp(-1j * np.pi / pair.gear_teeth)
    found = []
    for name, colour, points, height in curves:
        span = f": {height.min() * 1e6:+.1f} to {height.max() * 1e6:+.1f} µm" if height.any() else ""
        place = (points + (factor - 1.0) * height * motion.normal) * upright
        found.append(ToothCurve(name + span, colour, name == "unmodified", place))
    of_disc = f" of disc {disc}" if pair.discs > 1 else ""
    said = f"modification and deviations × {factor:g}" if largest > _FLAT else "without modification and deviations"
    return CloseUp(f"tooth {tooth}{of_disc}, {said}", found)


def draw_tooth(axis: Axes, motion: Motion) -> None:
    """Draw the close-up of one tooth."""
    found = close_up(motion)
    for one in found.curves:
        place = one.points * 1e3
        axis.plot(place.real, place.imag, "--" if one.dashed else "-", color=one.colour, lw=1.4, label=one.label)
    flat = found.curves[0].points * 1e3
    bottom = flat.imag.min() - 1.3 * np.ptp(flat.imag)
    axis.fill_between(flat.real, bottom, flat.imag, color=STEEL, lw=0)
    axis.set(xlabel="[mm]", ylabel="[mm]", ylim=(bottom, flat.imag.max() + 0.3), aspect="equal")
    axis.set_title(found.title, fontsize=9)
    show_legend(axis, loc="lower center", fontsize=8, framealpha=0.0)


def plot_motion(motion: Motion, load: int = 0, angle: int = 0) -> Figure:
    """Drive at a load and crank angle, its transmission error over a crank turn, and one tooth close up."""
    figure = figure_of_names()(figsize=(10.4, 6.6), layout="constrained")
    left, right = np.asarray(figure.subfigures(1, 2, width_ratios=(1.45, 1.0)))
    drive = left.subplots()
    draw_drive(drive, motion, load, angle)
    upper, lower = right.subplots(2, 1)
    for axis in (upper, lower):
        axis.grid(alpha=0.3)
        axis.spines[["top", "right"]].set_visible(False)
    draw_error(upper, motion, load, angle)
    draw_tooth(lower, motion)
    title = f"{drive_name(motion)}, {motion.torque[load]:g} N·m on the output"
    title += f", crank at {math.degrees(motion.crank_angle[angle]):.4g}°"
    figure.suptitle(title, fontsize=11)
    figure.supxlabel(textwrap.fill(caption_of(motion), 150), fontsize=8, color="0.3")
    return figure
