"""The drive as one self-contained HTML page: a crank turn with sliders for angle and load."""

from __future__ import annotations

import io
import json
import os
import re
from typing import Any

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.draw import drive_picture
from cycloid_fmu.draw.figure import save
from cycloid_fmu.edge import ARCSEC
from cycloid_fmu.motion import Motion, round_number, tooth_turns

ENDINGS = (".html", ".svg", *edge.PICTURES)
"""Endings of files with a picture of a drive."""


def _pairs(points: np.ndarray, digits: int) -> Any:
    return np.stack([points.real, points.imag], axis=-1).round(digits).tolist()


def _contacts(motion: Motion, load: int, angle: int) -> list[list[float]]:
    """Disc, pin, force (N), pressure (MPa) and direction (mrad) of every contact that carries load."""
    force, pressure = motion.force[load, angle], motion.pressure[load, angle] * 1e-6
    towards = np.angle(motion.direction[load, angle]) * 1e3
    return [
        [
            int(disc),
            int(pin),
            round(float(force[disc, pin, side]), 1),
            round(float(pressure[disc, pin]), 1),
            round(float(towards[disc, pin, side])),
        ]
        for disc, pin, side in np.argwhere(force > 0.0)
    ]


def page_data(motion: Motion, load: int = 0, angle: int = 0) -> dict[str, Any]:
    """Return the data of the page in mm, rad, N, MPa and arcsec, gaps in µm; `load` and `angle` are shown first."""
    pair = motion.pair
    nearest = motion.gap.min(axis=4) * 1e6
    curve, swept = motion.curve * ARCSEC, motion.swept * ARCSEC
    mean = swept.mean(axis=1)
    largest = float(motion.force.max())
    normal = (tooth_turns(pair)[:, None] * motion.normal).ravel()
    fixed = pair.output == "gear"  # the pins
    at = [(k, i) for k in range(motion.torque.size) for i in range(motion.crank_angle.size)]

    def table(values: list[Any]) -> list[Any]:
        count = motion.crank_angle.size
        return [values[k * count : (k + 1) * count] for k in range(motion.torque.size)]

    return {
        "title": drive_picture.drive_name(motion),
        "caption": drive_picture.caption_of(motion),
        "factor": motion.exaggeration,
        "loads": [f"{torque:g} N·m" for torque in motion.torque],
        "first_load": load,
        "first_angle": angle,
        "pin_circle_radius": pair.pin_circle_radius * 1e3,
        "pin_radius": pair.pin_radius * 1e3,
        "eccentricity": pair.eccentricity * 1e3,
        "room": motion.room * 1e3,
        "colours": drive_picture.PRESSURES,
        "crank_angle": motion.crank_angle.round(6).tolist(),
        "crank_phase": (2.0 * np.pi * np.arange(pair.discs) / pair.discs).tolist(),
        "normal": _pairs(normal, 5),
        "unmodified": _pairs((tooth_turns(pair)[:, None] * motion.unmodified).ravel() * 1e3, 5),
        "ideal_rotation": motion.ideal_rotation.round(8).tolist(),
        "ring": not fixed,
        "made": [_pairs(made.ravel() * 1e3, 5) for made in motion.made],
        "centre": _pairs(motion.centre * 1e3, 5),
        "rotation": motion.rotation.round(8).tolist(),
        "pins": [[_pairs(row * 1e3, 5) for row in (rows[:1] if fixed else rows)] for rows in motion.pin_axis],
        "radii": (motion.pin_radius * 1e3).round(5).tolist(),
        "error": (motion.transmission_error * ARCSEC).round(4).tolist(),
        "arcsec": ARCSEC,
        "gap": table(
            [[[None if not np.isfinite(v) else round(float(v), 2) for v in row] for row in nearest[a]] for a in at]
        ),
        "contacts": table([_contacts(motion, *a) for a in at]),
        "holders": table([_circles(motion, *a) for a in at]),
        "curve": (curve - mean[:, None]).round(4).tolist(),
        "mean": mean.round(4).tolist(),
        "peak_to_peak": np.ptp(swept, axis=1).round(4).tolist(),
        "longest": drive_picture.LONGEST_ARROW * pair.pin_circle_radius * 1e3,
        "largest_force": largest,
        "scale_force": round_number(largest) if largest > 0.0 else 0.0,
        "largest_pressure": max(float(motion.pressure.max()) * 1e-6, 1.0),
        "tooth": _tooth(motion),
    }


def _circles(motion: Motion, load: int, angle: int) -> list[tuple[float, float, float, int]]:
    """The circles from `drive_picture.holders`: centre and radius, mm, and 1 for a hole."""
    return [
        (round(c.centre.real * 1e3, 3), round(c.centre.imag * 1e3, 3), round(c.radius * 1e3, 3), int(c.hole))
        for c in drive_picture.holders(motion, load, angle)
    ]


def _tooth(motion: Motion) -> dict[str, Any]:
    """The close-up from `drive_picture.close_up`, in mm."""
    found = drive_picture.close_up(motion)
    curves = [
        {"label": one.label, "colour": one.colour, "dashed": one.dashed, "points": _pairs(one.points * 1e3, 4)}
        for one in found.curves
    ]
    return {"title": found.title, "curves": curves}


def motion_page(motion: Motion, load: int = 0, angle: int = 0) -> str:
    """Return the page; `load` and `angle` are the numbers of those shown first."""
    page = edge.packaged_text("cycloid_fmu.draw", "drive.html")
    data = json.dumps(page_data(motion, load, angle), separators=(",", ":"), allow_nan=False, ensure_ascii=False)
    return page.replace("/*DATA*/", data.replace("<", "\\u003c"))


def write_motion(motion: Motion, path: str | os.PathLike[str], load: int = 0, angle: int = 0) -> None:
    """Write a picture of the drive at a load and crank angle, or an animated page; never a partial file.

    Raises
    ------
    edge.InputError
        If the name does not end in one of `ENDINGS`.
    """
    import matplotlib

    target = edge.output_path(path, "path", ENDINGS)
    if target.suffix.lower() == ".html":
        page = motion_page(motion, load, angle)
    elif target.suffix.lower() == ".svg":
        written = io.StringIO()
        # Without a date, so that the same drive gives the same file.
        with matplotlib.rc_context({"svg.hashsalt": "cycloid"}):
            drive_picture.plot_motion(motion, load, angle).savefig(written, format="svg", metadata={"Date": None})
        # Hundredths of a point are precise enough, except in scale factors; indentation is most of the remaining size.
        page = re.sub(r"\s+", " ", re.sub(r"(?<![\d.])(?<!scale\()(\d+\.\d\d)\d+", r"\1", written.getvalue()))
    else:
        save(drive_picture.plot_motion(motion, load, angle), target)
        return
    with edge.written_whole(target) as temporary:
        temporary.write_text(page, encoding="utf-8")
