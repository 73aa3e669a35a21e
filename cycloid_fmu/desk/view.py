"""Results of the desk for the values in its fields: figures, curves, pictures and verdicts, or error messages."""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from cycloid_fmu.analysis import notes, series_compliance, solve, statistics
from cycloid_fmu.bodies.matrices import check_bodies
from cycloid_fmu.contact.transmission import Transmission
from cycloid_fmu.draw.drive_picture import CloseUp, caption_of, close_up
from cycloid_fmu.draw.drive_svg import drive_svg, tooth_svg
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge.quantities import EXAMPLES
from cycloid_fmu.geometry import ANGLES
from cycloid_fmu.geometry.pair import FORMAT, LARGEST_PRESSURE, Modification, Pair, PairTables, pair_of_tables
from cycloid_fmu.losses import figures as losses
from cycloid_fmu.losses.back_driving import back_driving
from cycloid_fmu.losses.solver import solve as rub
from cycloid_fmu.motion import Motion, mesh_angles, motion_of
from cycloid_fmu.studies.limits import (
    Requirements,
    Verdict,
    flank_curvature_radius,
    read_requirements,
    row_of,
    what_is_elastic,
    whole_stiffness,
)
from cycloid_fmu.studies.verdicts import Judged, check, judge_sweep, loads_of
from cycloid_fmu.surfaces.structured import dimensions
from cycloid_fmu.surfaces.surface import surface_of_pair

Array = NDArray[np.float64]
_EACH_PITCH = 24  # crank angles of the curves in a pin pitch
_WITHOUT_FIELD = ("contact_law",)  # for comparison with papers
_TABLES = (*PairTables.model_fields, "errors")
_PLACE = re.compile(r"(\[(?:pair|modification)\] )?(\w+)(?: = | is missing)")


class Field(NamedTuple):
    """One field of the desk.

    Attributes
    ----------
    key
        `pair.eccentricity`: table and name in the pair file; `torque` and `crank_angle` are in no file.
    label
        Its label.
    hint
        Placeholder: the meaning of an empty field, or the notation.
    choices
        Permitted words; empty for free text.
    """

    key: str
    label: str
    hint: str
    choices: tuple[str, ...] = ()


_EMPTY = {
    "gear_teeth": "a whole number",
    "discs": "1",
    "rated_torque": "not stated",
    "pressure_limit": f"{LARGEST_PRESSURE * 1e-9:g} GPa of bearing steel",
    "isometric": "0 mm",
    "offset": "0 mm",
}


def _fields() -> dict[str, Field]:
    found = {}
    for table, model in (("pair", Pair), ("modification", Modification)):
        for name, field in model.model_fields.items():
            if table == "pair" and name in ("pins", *_WITHOUT_FIELD, *_TABLES):
                continue
            key, unit = f"{table}.{name}", edge.unit_of_field(field)
            choices = get_args(field.annotation) if isinstance(field.default, str) else ()
            hint = _EMPTY.get(name) or (f"such as {EXAMPLES[unit]}" if unit else "")
            found[key] = Field(key, name.replace("_", " "), hint, choices)
    return found


FIELDS = _fields()
"""Fields of the pair file by their keys; the number of pins follows from the teeth."""
_WHOLE = ("pair.gear_teeth", "pair.discs")


@dataclasses.dataclass(frozen=True)
class Desk:
    """The fixed part of a desk.

    Attributes
    ----------
    source
        Name of the pair file, for messages.
    tables
        Its tables as they are in the file.
    requirements, limits_source
        The requirements, and their file's name; None without requirements.
    """

    source: str
    tables: Mapping[str, Any]
    requirements: Requirements | None = None
    limits_source: str = ""

    @property
    def values(self) -> dict[str, str]:
        """Text of every field as in the file, empty if it is not stated."""
        found = {}
        for key, field in FIELDS.items():
            table, name = key.split(".")
            found[key] = str(self.tables.get(table, {}).get(name, field.choices[0] if field.choices else ""))
        return {**found, "torque": "", "crank_angle": "0 deg"}

    @property
    def kept(self) -> list[str]:
        """What the file states without fields: names and [tables]. It remains part of the drive and the saved file."""
        names = [name for name in _WITHOUT_FIELD if name in self.tables["pair"]]
        return names + [f"[{name}]" for name in self.tables if name in _TABLES and name != "modification"]


def open_desk(path: str | os.PathLike[str], limits: str | os.PathLike[str] | None = None) -> Desk:
    """Return the desk of a pair file, with the limits of a requirements file.

    Raises
    ------
    edge.InputError
        If a file can't be read, has no valid pair, or the pair lacks a value that a limit needs.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> from cycloid_fmu.desk.view import look, open_desk
    >>> pair = cy.Pair(
    ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
    ... )
    >>> cy.Drive(pair).write("pair.toml")
    >>> desk = open_desk("pair.toml")
    >>> desk.values["pair.eccentricity"]
    '1.3 mm'
    >>> view = look(desk, {**desk.values, "pair.eccentricity": "1.7 mm", "torque": "181 N*m"})
    >>> list(view.problems), view.problems["pair.eccentricity"][-32:]
    (['pair.eccentricity'], 'the eccentricity below "1.6 mm".')
    """
    tables = edge.toml_table(edge.read_text(path, FORMAT), FORMAT, str(path))
    pair = _checked(tables, str(path))
    if limits is None:
        return Desk(str(path), tables)
    asked = read_requirements(limits)
    check(asked, pair, str(limits), str(path))
    return Desk(str(path), tables, asked, str(limits))


@dataclasses.dataclass(frozen=True)
class View:
    """Results of the desk; if there are problems, nothing else is set.

    Attributes
    ----------
    problems
        A sentence for each field with an invalid value, by its key; "" for other problems.
    pair
        The pair; None if there are problems.
    torque
        Torque of the curves and pictures, N·m.
    crank_angle, transmission_error, backlash, pressure
        Curves over a crank turn, shape (angles,): rad, rad, rad (NaN without a free position) and the largest contact
        pressure of any pin, Pa.
    figures
        Names and values in field units.
    verdicts, not_judged
        Verdicts, one for each judged limit, and the names of the other limits.
    notes
        Notes on results outside the range of the model.
    drive, tooth
        SVG pictures.
    caption, close_up
        Caption of the drive, and the tooth's title and curves.
    """

    problems: Mapping[str, str]
    pair: Pair | None = None
    torque: float = math.nan
    crank_angle: Array = dataclasses.field(default_factory=lambda: np.zeros(0))
    transmission_error: Array = dataclasses.field(default_factory=lambda: np.zeros(0))
    backlash: Array = dataclasses.field(default_factory=lambda: np.zeros(0))
    pressure: Array = dataclasses.field(default_factory=lambda: np.zeros(0))
    figures: Mapping[str, str] = dataclasses.field(default_factory=dict)
    verdicts: tuple[Verdict, ...] = ()
    not_judged: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    drive: str = ""
    tooth: str = ""
    caption: str = ""
    close_up: CloseUp | None = None

    def numbers(self) -> dict[str, Any]:
        """Return the data of the page: angles in degrees, errors and play in arcsec, pressure in MPa."""
        curves = {
            "transmission_error": self.transmission_error * edge.ARCSEC,
            "backlash": self.backlash * edge.ARCSEC,
            "pressure": self.pressure * 1e-6,
        }
        return {
            "problems": dict(self.problems),
            "torque": f"{self.torque:g} N·m",
            "figures": list(self.figures.items()),
            "crank_angle": np.degrees(self.crank_angle).round(3),
            "curves": {name: values.round(5) for name, values in curves.items()},
            "verdicts": [{"met": one.met, "cells": row_of(one)} for one in self.verdicts],
            "not_judged": [name.replace("_", " ") for name in self.not_judged],
            "notes": list(self.notes),
            "drive": self.drive,
            "tooth": self.tooth,
            "caption": self.caption,
            "tooth_title": "" if self.close_up is None else self.close_up.title,
            "tooth_curves": []
            if self.close_up is None
            else [{"label": one.label, "colour": one.colour, "dashed": one.dashed} for one in self.close_up.curves],
        }


def pair_of(desk: Desk, values: Mapping[str, str]) -> Pair:
    """Return the pair of a desk with the values of its fields, as in its file.

    Parameters
    ----------
    desk
        The desk, for everything without a field.
    values
        Text of fields by their keys, with units; an empty one is left out of the file.

    Raises
    ------
    edge.InputError
        As reading such a file does, each sentence with the table and the name.
    """
    tables = {
        **desk.tables,
        "pair": dict(desk.tables["pair"]),
        "modification": dict(desk.tables.get("modification", {})),
    }
    tables["pair"].pop("pins", None)  # one more than teeth
    for key in FIELDS:
        table, name = key.split(".")
        text = values.get(key, "").strip()
        tables[table].pop(name, None)
        if text:
            tables[table][name] = int(text) if key in _WHOLE and re.fullmatch(r"\d{1,9}", text, re.ASCII) else text
    return _checked(tables, desk.source)


def _checked(tables: Mapping[str, Any], source: str) -> Pair:
    """Return the pair of the file `source` with these tables; raise an `edge.InputError` that names what is wrong."""
    pair = pair_of_tables(tables, source, Path(source).parent)
    if pair.bodies is not None:
        check_bodies(pair, pair.bodies, source)
    dimensions(pair, surface_of_pair(pair), f"{source}: errors")
    return pair


def placed(desk: Desk, problem: edge.InputError) -> dict[str, str]:
    """Return the sentences of a problem by the fields that they name; those that name no field have the key ""."""
    keys = {key.split(".")[-1]: key for key in (*FIELDS, "torque", "crank_angle")}
    found = dict[str, str]()
    for line in str(problem).split("\n"):
        said = line.removeprefix(f"{desk.source}: ")
        place = _PLACE.match(said)
        key = keys.get(place[2], "") if place is not None else ""
        if place is not None and key:
            said = said[len(place[1] or "") :]
        found[key] = f"{found[key]}\n{said}" if key in found else said
    return found


def _quantity(values: Mapping[str, str], key: str, si: str) -> float:
    try:
        return edge.parse_quantity(values[key].strip(), si)
    except ValueError as problem:
        raise edge.ArgumentError(key, str(problem), values[key]) from None


def look(desk: Desk, values: Mapping[str, str]) -> View:
    """Return the results for the values in the desk's fields.

    Parameters
    ----------
    desk
        The desk.
    values
        Text of fields by their keys, with units: those of `FIELDS`, `torque` of the environment on the output (empty
        for the rated torque, or otherwise the first of the duty) and `crank_angle` of the drawing. Figures are those of
        `Drive.analyze` of the pair file with these values; curves have the same crank angles in each pin pitch.
    """
    problems, given, pair = dict[str, str](), dict[str, float](), None
    for key, unit in (("crank_angle", "rad"), ("torque", "N*m")):
        try:
            given |= {key: _quantity(values, key, unit)} if values.get(key, "").strip() else {}
        except edge.InputError as problem:
            problems |= placed(desk, problem)
    try:
        pair = pair_of(desk, values)
        if desk.requirements is not None:
            check(desk.requirements, pair, desk.limits_source, desk.source)
    except edge.InputError as problem:
        problems |= placed(desk, problem)
    if problems or pair is None:
        return View(problems)
    try:
        return _solved(desk, pair, [given["torque"]] if "torque" in given else [], given.get("crank_angle", 0.0))
    except edge.InputError as problem:
        return View(placed(desk, problem))


def _solved(desk: Desk, pair: Pair, torque: list[float], angle: float) -> View:
    asked = Requirements() if desk.requirements is None else desk.requirements
    loads = tuple(loads_of(asked, torque, pair))
    # That of the file: what is stated of its bodies holds for variants too.
    series = series_compliance(DriveValue.as_stated(_checked(desk.tables, desk.source)))
    found, curves, judged = _swept(pair, asked, loads, series)
    surface = surface_of_pair(pair)
    motion = motion_of(DriveValue(pair, surface), loads[:1], angle, with_curve=False)
    return View(
        {},
        pair,
        loads[0],
        curves.crank_angle,
        curves.transmission_error[0],
        curves.backlash,
        curves.pin_pressure[0].max(axis=(1, 2)),
        _figures(pair, found, series) | _figures_of_friction(pair, loads[0]),
        judged.verdicts,
        judged.not_judged,
        tuple(notes(DriveValue(pair, surface), found)),
        drive_svg(motion),
        tooth_svg(motion),
        _caption(motion),
        close_up(motion),
    )


@functools.lru_cache(maxsize=4)  # so that moving the crank needs no new solution
def _swept(
    pair: Pair, asked: Requirements, loads: tuple[float, ...], series: float
) -> tuple[Transmission, Transmission, Judged]:
    """Results for figures and verdicts, results for the curves, and the verdicts."""
    surface, workers = surface_of_pair(pair), os.cpu_count() or 1
    turn = np.linspace(0.0, 2.0 * np.pi, ANGLES, endpoint=False)
    found = solve(DriveValue(pair, surface), loads, turn, workers=workers)
    curves = solve(DriveValue(pair, surface), loads[:1], mesh_angles(pair.pins, _EACH_PITCH), workers=workers)
    return found, curves, judge_sweep(DriveValue(pair, surface), asked, found, workers, series)


def _caption(motion: Motion) -> str:
    highest = motion.pressure.max() * 1e-6
    colours = f" Colours: contact pressure, the darkest {highest:.0f} MPa." if highest > 0.0 else ""
    return caption_of(motion) + colours


def _figures(pair: Pair, found: Transmission, series: float) -> dict[str, str]:
    """The figures of a sweep at its first torque."""
    of = {name: values[0] for name, values in statistics({**vars(found), "backlash": found.backlash[None]}).items()}
    deepest, count = found.interference.max(), found.contact_count[0]
    play = {
        "backlash, mean": f"{of['MB'] * edge.ARCSEC:.3f}″",
        "backlash, peak to peak": f"{of['PPB'] * edge.ARCSEC:.3f}″",
    }
    if deepest > 0.0:
        # On bearings the output has play in clearances, whatever interferes.
        play = {} if np.isnan(of["MB"]) else play
        play["interference"] = f"{deepest * 1e6:.3f} µm"
    figures = {
        "ratio": f"{pair.ratio:g}",
        "pins": f"{pair.pins}",
        "shortening coefficient": f"{pair.shortening:.4f}",
        "smallest convex flank radius": f"{flank_curvature_radius(pair) * 1e3:.3f} mm",
        "TE, mean": f"{of['MTE'] * edge.ARCSEC:.3f}″",
        "TE, peak to peak": f"{of['PPTE'] * edge.ARCSEC:.4f}″",
        **play,
        "largest contact pressure": f"{of['MCS'] * 1e-6:.1f} MPa",
        "pins in contact": f"{count.min()} to {count.max()}",
    }
    if found.torque[0] != 0.0:
        stiffness = whole_stiffness(found.torsional_stiffness[0], series).mean() / edge.ARCMIN
        figures["torsional stiffness, mean"] = f"{stiffness:.1f} N·m/arcmin, {what_is_elastic(pair, series)}"
    return figures


@functools.lru_cache(maxsize=4)
def _figures_of_friction(pair: Pair, torque: float) -> dict[str, str]:
    """The figures of a drive with [losses] from rest, without any speed; none without friction."""
    if pair.losses is None or pair.supports is None:
        return {}
    drive, turn = DriveValue.as_stated(pair), np.linspace(0.0, 2.0 * np.pi, ANGLES, endpoint=False)
    found = {}
    for direction in (1, -1) if torque != 0.0 else ():
        (case,) = losses.load_cases(drive, rub(drive, np.array([torque]), turn, direction, 0.0))
        shown = "jams" if case.jams else f"{case.efficiency:.1%}{', self-locking' if case.self_locking else ''}"
        found[f"efficiency from rest, {case.mode}"] = shown
    starting, largest = losses.starting(drive, [0.0], turn)[0.0].max(), pair.rated_torque or abs(torque)
    found["starting torque"] = "jams" if np.isnan(starting) else f"{starting:.4g} N·m"
    if largest > 0.0:
        back = back_driving(drive, largest, turn).max()
        found["back-driving torque"] = f"none up to {largest:g} N·m" if np.isnan(back) else f"{back:.4g} N·m"
    return found
