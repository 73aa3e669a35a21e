"""Compliance in series with the drive of an FMU: stated, or from a catalogue's stiffness or a measured loop."""

from __future__ import annotations

import dataclasses
import math
import os

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.analysis import series_compliance, solve
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import ArgumentError
from cycloid_fmu.fmu.variables import Interface
from cycloid_fmu.geometry.first_stage import sun_locked_share
from cycloid_fmu.supports.figures import LOADS

FIGURES, IDENTIFICATION = "cycloid-figures/1", "cycloid-identification/1"
_ANGLES = 90
_SAME = 1e-6  # share by which the drive may be softer than stated, for rounding


def own_stiffness(drive: DriveValue) -> float:
    """Return the stiffness between half and full rated torque, averaged over the crank angle, N·m/rad.

    Catalogues define it in this way; with a first stage the sun is locked. NaN without a rated torque.
    """
    pair = drive.pair
    if pair.rated_torque is None:
        return math.nan
    loads = [share * pair.rated_torque for share in LOADS]
    angles = np.linspace(0.0, 2.0 * np.pi, _ANGLES, endpoint=False)
    swept = solve(drive, loads, angles, with_play=False, with_stiffness=False)
    low, high = swept.transmission_error.mean(axis=1)
    return float((loads[1] - loads[0]) / (high - low))


def with_chain(interface: Interface, drive: DriveValue) -> Interface:
    """Return an interface with the drive's own stiffness and the compliance in series with it.

    Where neither is stated, the compliance is that up to the pair's `catalogue_stiffness`. A compliant first stage is
    included at the output: s²/(z_c² κ) with its stiffness κ at the cranks. The crank keeps
    the position that a rigid stage would give it, some hundredths of a mesh pitch from the actual one.

    Raises
    ------
    edge.InputError
        If a stated stiffness exceeds that of the drive, or can't be compared with it.
    """
    series = interface.series_compliance
    if not 0.0 <= series < math.inf:
        raise ArgumentError("series_compliance", "it must be finite and not below zero (rad/(N*m))", series)
    if series == 0.0 and interface.stiffness is None:
        series = series_compliance(drive)
    first_stage, teeth = drive.first_stage, drive.pair.gear_teeth
    if first_stage is not None and math.isfinite(first_stage.crank_stiffness):
        share = sun_locked_share(first_stage.crank_share, teeth) / teeth
        series += share**2 / first_stage.crank_stiffness
        rigid = dataclasses.replace(first_stage, crank_stiffness=math.inf)
        drive = DriveValue(drive.pair, drive.surface, rigid)
    own = own_stiffness(drive)
    if interface.stiffness is not None:
        if interface.series_compliance > 0.0:
            raise ArgumentError("stiffness", "give either this or series_compliance: one follows from the other")
        if not 0.0 < interface.stiffness < math.inf:
            raise ArgumentError("stiffness", "it must be finite and above zero (N*m/rad)", interface.stiffness)
        if math.isnan(own):
            raise edge.InputError(
                "rated_torque is missing; the drive's own stiffness is that between half and full rated torque."
            )
        series = 1.0 / interface.stiffness - 1.0 / own
        if series < -_SAME / own:
            raise ArgumentError(
                "stiffness",
                f"it must not be above the drive's own of {own / edge.ARCMIN:.4g} N*m/arcmin, to which the rest of "
                "the drive adds compliance",
                f"{interface.stiffness / edge.ARCMIN:.4g} N*m/arcmin",
            )
    return dataclasses.replace(
        interface, series_compliance=max(series, 0.0), own_stiffness=None if math.isnan(own) else own
    )


def read_loop(path: str | os.PathLike[str]) -> tuple[float, float]:
    """Return stiffness (N·m/rad) and dry friction (N·m) of a measured loop, from the file of `cycloid-fit metrics`.

    The loading and unloading branches are 2 T_f/K apart, which is the loop's hysteresis loss minus its backlash
    (docs/theory/measurement.md). Where friction grows with load, the figures without friction are taken.

    Raises
    ------
    edge.InputError
        If the file can't be read or has no figures of a loop.
    """
    given = edge.json_table(path, FIGURES, "figures of cycloid-fit metrics")
    names: tuple[str, ...] = ("torsional_stiffness", "hysteresis_loss", "backlash")
    values, free = dict[str, float](), given.get("friction_free")
    standard = given.get("torsional_stiffness")
    grows = isinstance(free, dict) and isinstance(standard, dict) and "remark" in standard
    if isinstance(free, dict) and grows:
        given, names = free, ("torsional_stiffness", "friction_torque")
    for name in names:
        entry = given.get(name)
        value = entry.get("value") if isinstance(entry, dict) else None
        if not isinstance(value, int | float) or not math.isfinite(value):
            raise edge.InputError(f"{path}: {name} is missing; figures of a measured torque-windup loop have it.")
        values[name] = float(value)
    stiffness = values["torsional_stiffness"]
    if stiffness <= 0.0:
        raise edge.InputError(f"{path}: torsional_stiffness = {stiffness:g} N*m/rad: it must be above zero.")
    if grows:
        return stiffness, values["friction_torque"]
    return stiffness, max(0.5 * stiffness * (values["hysteresis_loss"] - values["backlash"]), 0.0)


def read_chain(path: str | os.PathLike[str]) -> tuple[float, float]:
    """Return series compliance (rad/(N·m)) and dry friction (N·m) from the file of `cycloid-fit identify`.

    Neither is below zero.

    Raises
    ------
    edge.InputError
        If the file is not an identification or has neither of the two.
    """
    bench = edge.json_table(path, IDENTIFICATION, "identification").get("bench")
    values = []
    for name in ("chain_compliance", "friction_torque"):
        value = bench.get(name) if isinstance(bench, dict) else None
        if not isinstance(value, int | float) or not math.isfinite(value):
            raise edge.InputError(f"{path}: bench has no {name}; identify again.")
        values.append(max(float(value), 0.0))
    return values[0], values[1]
