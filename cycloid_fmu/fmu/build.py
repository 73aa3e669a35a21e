"""Build an FMU file from a pair and its error surface."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import tempfile
import zipfile
from pathlib import Path
from typing import Protocol

import numpy as np

from cycloid_fmu import __version__, edge
from cycloid_fmu.contact.transmission import slices_needed
from cycloid_fmu.edge import ArgumentError
from cycloid_fmu.fmu.chain import with_chain
from cycloid_fmu.fmu.constants import DAMPING_TIME
from cycloid_fmu.fmu.core import FORMAT, NUMBERS, SUMS, SURFACE, sums_of, variables_hash
from cycloid_fmu.fmu.description import Version
from cycloid_fmu.fmu.friction_file import Friction
from cycloid_fmu.fmu.losses import check_losses
from cycloid_fmu.fmu.parts import parts, write_archive
from cycloid_fmu.fmu.pythonfmu_builder import build_archive
from cycloid_fmu.fmu.variables import INTERFACES, Interface, InterfaceKind, LossRow, variables
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.reducer.description import Reducer
from cycloid_fmu.reducer.first_stage import FirstStage
from cycloid_fmu.reducer.lost_motion import parts_of
from cycloid_fmu.supports.transmission import play_loads, solve
from cycloid_fmu.surfaces.files import write_surface
from cycloid_fmu.surfaces.surface import DEVIATIONS, ErrorSurface, at_own_age, surface_of_pair

_LIBRARIES = {"2.0": "pythonfmu", "3.0": "pythonfmu3"}
_SCRIPTS = {"2.0": "cycloid_drive.py", "3.0": "cycloid_drive3.py"}
# The FMI 2.0 library wraps pythonfmu's, which does not decode the URI of the resources (front/front.c).
_FRONT = Path(__file__).with_name("front")
_FRONTS = {
    "binaries/linux64/CycloidDrive.so": "binaries/linux64/pythonfmu-export.so",
    "binaries/win64/CycloidDrive.dll": "binaries/win64/pythonfmu-export.dll",
}


class DriveWithErrors(Protocol):
    """A gear pair together with its errors."""

    @property
    def pair(self) -> Pair:
        """The nominal pair."""

    @property
    def surface(self) -> ErrorSurface:
        """Its errors."""

    @property
    def first_stage(self) -> FirstStage | None:
        """The first stage of an RV reducer."""


AnyDrive = Pair | Reducer | DriveWithErrors


def whole_drive(drive: AnyDrive, surface: ErrorSurface | None) -> tuple[Pair, ErrorSurface, FirstStage | None]:
    """Return the pair, its errors (the given ones, otherwise the drive's own), and the first stage of a reducer.

    Of a drive with a life they are those at the age of its surface.
    """
    first_stage: FirstStage | None = None
    if isinstance(drive, Reducer):
        pair, made, first_stage = parts_of(drive)
    elif isinstance(drive, Pair):
        pair, made = drive, surface or surface_of_pair(drive)
    else:
        pair, made, first_stage = drive.pair, drive.surface, drive.first_stage
    return *at_own_age(pair, surface or made), first_stage


def ratio_of(pair: Pair, first_stage: FirstStage | None) -> float:
    """Return the ratio of the driven shaft's angle (crank or sun) to the output's, signed."""
    return pair.ratio if first_stage is None else first_stage.ratio(pair.gear_teeth)


def build_fmu(
    drive: AnyDrive,
    path: str | os.PathLike[str],
    surface: ErrorSurface | None = None,
    *,
    interface: InterfaceKind | Interface = "kinematic",
    fmi_version: Version = "2.0",
) -> None:
    """Write a Co-Simulation FMU of the drive that runs in a Python host; never a partial file.

    Parameters
    ----------
    drive
        A gear pair, or an RV reducer, whose FMU has the sun as its input instead of the crank.
    path
        The FMU file.
    surface
        Errors of the pair, or of a reducer's cycloid stage; by default those of the drive.
    interface
        The interface: "kinematic", "compliant", or an `Interface`.
    fmi_version
        "2.0" or "3.0".

    Raises
    ------
    edge.InputError
        If the folder does not exist, the loss table is invalid, or the interface is not available for this drive.
    """
    pair, surface, first_stage = whole_drive(drive, surface)
    interface = completed(interface, pair, surface, first_stage)
    if fmi_version not in _LIBRARIES:
        raise ArgumentError("fmi_version", "it must be 2.0 or 3.0", fmi_version)
    library = _LIBRARIES[fmi_version]
    table = variables(pair, surface, interface, fmi_version, ratio_of(pair, first_stage))
    with tempfile.TemporaryDirectory(prefix="cycloid-fmu-") as folder, edge.written_whole(path) as temporary:
        place = Path(folder)
        numbers: dict[str, object] = {
            "format": FORMAT,
            "package_version": __version__,
            "pair": pair.nominal.text,
            "interface": {
                name: value.model_dump() if isinstance(value, Friction) else value
                for name, value in vars(interface).items()
            },
            "variables": variables_hash(table),
        }
        if first_stage is not None:
            numbers["first_stage"] = json.loads(first_stage.text)
        (place / NUMBERS).write_text(json.dumps(numbers, indent=1), encoding="utf-8")
        with (place / SURFACE).open("wb") as file:
            arrays = {**surface.errors, **{name: getattr(surface, name) for name in DEVIATIONS}}
            np.savez(file, allow_pickle=False, **{n: a for n, a in arrays.items() if a is not None})
        write_surface(surface, place / "surface.nc")
        script = Path(__file__).with_name(_SCRIPTS[fmi_version])
        files = [place / name for name in (NUMBERS, SURFACE, "surface.nc")]
        (place / SUMS).write_bytes(sums_of({path.name: path.read_bytes() for path in (*files, script)}))
        archive = build_archive(library, script, [*files, place / SUMS], place)
        fronts = _FRONTS if fmi_version == "2.0" else {}
        with zipfile.ZipFile(archive) as made:
            contents = {fronts.get(name, name): made.read(name) for name in made.namelist()}
        for name, behind in fronts.items():
            if behind in contents:
                contents[name] = (_FRONT / name.removeprefix("binaries/")).read_bytes()
        contents |= parts(pair, surface, interface, table, fmi_version, [library])
        # Sorted, because the library's order depends on the file system.
        write_archive(temporary, dict(sorted(contents.items())))


def checked_interface(interface: InterfaceKind | Interface, first_stage: FirstStage | None) -> Interface:
    """Return the interface for an FMU of this drive; raise an `InputError` that names contradictions."""
    interface = Interface(interface) if isinstance(interface, str) else interface
    if interface.kind not in INTERFACES:
        raise ArgumentError("interface", f"it must be one of {', '.join(INTERFACES)}", interface.kind)
    if interface.output_inertia != 0.0 and interface.kind == "kinematic":
        raise ArgumentError("output_inertia", "is only for the compliant interface")
    for name, unit in (("output_inertia", "kg*m^2"), ("crank_inertia", "kg*m^2"), ("mesh_damping", "N*m*s/rad")):
        if not 0.0 <= (getattr(interface, name) or 0.0) < math.inf:
            raise ArgumentError(name, f"it must be finite and not below zero ({unit})", getattr(interface, name))
    if interface.crank_inertia > 0.0 and interface.output_inertia == 0.0:
        raise ArgumentError("crank_inertia", "needs an output_inertia as well")
    try:
        check_losses(interface.losses)
    except ValueError as problem:
        raise edge.InputError(f"{problem}.") from None
    return interface if first_stage is None else dataclasses.replace(interface, driven="sun")


def completed(
    interface: InterfaceKind | Interface, pair: Pair, surface: ErrorSurface, first_stage: FirstStage | None
) -> Interface:
    """Return the interface of an FMU of this drive with all values determined during the build.

    Raises
    ------
    edge.InputError
        As `checked_interface` and `chain.with_chain` do.
    """
    checked = checked_interface(interface, first_stage)
    if pair.supports is not None:
        play_loads(pair)  # raises without a rated torque
    return with_damping(with_chain(checked, pair, surface, first_stage), pair, surface)


def with_damping(interface: Interface, pair: Pair, surface: ErrorSurface) -> Interface:
    """Return a compliant interface with the default mesh damping if none is stated."""
    if interface.kind == "kinematic" or interface.mesh_damping is not None:
        return interface
    stiffness = solve(pair, surface, [pair.rated_torque or 100.0], [0.0], slices_needed(surface)).torsional_stiffness
    whole = 1.0 / (1.0 / float(stiffness[0, 0]) + interface.series_compliance)
    return dataclasses.replace(interface, mesh_damping=DAMPING_TIME * whole)


def read_losses(path: str | os.PathLike[str]) -> tuple[LossRow, ...]:
    """Return the rows of a loss table: a CSV file, `speed [rpm],eta_mf1 [1],eta_mf2 [1],tau_bf1 [N*m],tau_bf2 [N*m]`.

    Raises
    ------
    edge.InputError
        If the file can't be read, a column or its unit is missing, or a row is invalid.
    """
    wanted = {"speed": "rad/s", "eta_mf1": "1", "eta_mf2": "1", "tau_bf1": "N*m", "tau_bf2": "N*m"}
    rows = [
        (row["speed"], row["eta_mf1"], row["eta_mf2"], row["tau_bf1"], row["tau_bf2"])
        for _, row in edge.number_rows(path, wanted)
    ]
    if not rows:
        raise edge.InputError(f"{path}: a loss table has a header and at least one row.")
    try:
        check_losses(rows)
    except ValueError as problem:
        raise edge.InputError(f"{path}: {problem}.") from None
    return tuple(rows)
