"""Build an FMU file from a pair and its error surface."""

from __future__ import annotations

import dataclasses
import json
import math
import os
import tempfile
import zipfile
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from cycloid_fmu import __version__, edge
from cycloid_fmu.analysis import solve
from cycloid_fmu.bodies.given import write_influence
from cycloid_fmu.bodies.matrices import matrices_of, port_matrices
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import ArgumentError, Config
from cycloid_fmu.fmu.chain import with_chain
from cycloid_fmu.fmu.constants import DAMPING_TIME
from cycloid_fmu.fmu.core import FORMAT, NUMBERS, SUMS, SURFACE, sums_of, variables_hash
from cycloid_fmu.fmu.description import Version
from cycloid_fmu.fmu.model_losses import with_model_losses
from cycloid_fmu.fmu.parts import parts, write_archive
from cycloid_fmu.fmu.pythonfmu_builder import build_archive
from cycloid_fmu.fmu.variables import ADDED, INTERFACES, Interface, InterfaceKind, LossRow, variables
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.supports.assembly import as_drawn
from cycloid_fmu.supports.transmission import play_loads
from cycloid_fmu.surfaces.files import write_surface
from cycloid_fmu.surfaces.surface import DEVIATIONS

_LIBRARIES = {"2.0": "pythonfmu", "3.0": "pythonfmu3"}
_SCRIPTS = {"2.0": "cycloid_drive.py", "3.0": "cycloid_drive3.py"}
# The FMI 2.0 library wraps pythonfmu's, which does not decode the URI of the resources (front/front.c).
_FRONT = Path(__file__).with_name("front")
_FRONTS = {
    "binaries/linux64/CycloidDrive.so": "binaries/linux64/pythonfmu-export.so",
    "binaries/win64/CycloidDrive.dll": "binaries/win64/pythonfmu-export.dll",
}


def build_fmu(
    drive: DriveValue,
    path: str | os.PathLike[str],
    *,
    interface: InterfaceKind | Interface = "kinematic",
    fmi_version: Version = "2.0",
) -> None:
    """Write a Co-Simulation FMU of the drive that runs in a Python host; never a partial file.

    Parameters
    ----------
    drive
        The drive; one with a life is that at the age of its surface. Behind a first stage the FMU's input is the sun
        instead of the crank.
    path
        The FMU file.
    interface
        The interface: "kinematic", "compliant", or an `Interface`.
    fmi_version
        "2.0" or "3.0".

    Raises
    ------
    edge.InputError
        If the folder does not exist, the loss table is invalid, or the interface is not available for this drive.
    """
    drive = drive.at_own_age
    pair, surface, first_stage = drive.pair, drive.surface, drive.first_stage
    interface = completed(interface, drive)
    if fmi_version not in _LIBRARIES:
        raise ArgumentError("fmi_version", "it must be 2.0 or 3.0", fmi_version)
    library = _LIBRARIES[fmi_version]
    table = variables(drive, interface, fmi_version)
    with tempfile.TemporaryDirectory(prefix="cycloid-fmu-") as folder, edge.written_whole(path) as temporary:
        resources = Path(folder)
        numbers: dict[str, object] = {
            "format": FORMAT,
            "package_version": __version__,
            "pair": pair.nominal.text,
            "interface": {
                name: value.model_dump() if isinstance(value, Config) else value
                for name, value in vars(interface).items()
                if name not in ADDED or value is not None
            },
            "variables": variables_hash(table),
        }
        if first_stage is not None:
            numbers["first_stage"] = json.loads(first_stage.text)
        influence = _write_influence(pair, resources)
        if influence:
            numbers["influence"] = influence
        (resources / NUMBERS).write_text(json.dumps(numbers, indent=1), encoding="utf-8")
        with (resources / SURFACE).open("wb") as file:
            arrays = {**surface.errors, **{name: getattr(surface, name) for name in DEVIATIONS}}
            np.savez(file, allow_pickle=False, **{n: a for n, a in arrays.items() if a is not None})
        write_surface(surface, resources / "surface.nc")
        script = Path(__file__).with_name(_SCRIPTS[fmi_version])
        of_bodies = [name for each in influence.values() for name in each]
        files = [resources / name for name in (NUMBERS, SURFACE, "surface.nc", *of_bodies)]
        (resources / SUMS).write_bytes(sums_of({path.name: path.read_bytes() for path in (*files, script)}))
        archive = build_archive(library, script, [*files, resources / SUMS], resources)
        fronts = _FRONTS if fmi_version == "2.0" else {}
        with zipfile.ZipFile(archive) as built:
            contents = {fronts.get(name, name): built.read(name) for name in built.namelist()}
        for name, behind in fronts.items():
            if behind in contents:
                contents[name] = (_FRONT / name.removeprefix("binaries/")).read_bytes()
        contents |= parts(drive, interface, table, fmi_version, [library])
        # Sorted, because the library's order depends on the file system.
        write_archive(temporary, dict(sorted(contents.items())))


def _write_influence(pair: Pair, folder: Path) -> dict[str, list[str]]:
    """Write the matrices of a pair's elastic bodies, which an FMU then need not compute; return the files' names."""
    if pair.bodies is None:
        return {}
    names = dict[str, list[str]]()
    for body, matrices in port_matrices(matrices_of(as_drawn(pair), pair.bodies)).items():
        names[body] = [f"influence-{body}-{number}.nc" for number in range(len(matrices))]
        for name, matrix in zip(names[body], matrices, strict=True):
            write_influence(matrix, folder / name)
    return names


def checked_interface(interface: InterfaceKind | Interface, drive: DriveValue) -> Interface:
    """Return the interface for an FMU of this drive; raise an `InputError` that names contradictions."""
    interface = Interface(interface) if isinstance(interface, str) else interface
    if interface.kind not in INTERFACES:
        raise ArgumentError("interface", f"it must be one of {', '.join(INTERFACES)}", interface.kind)
    for name in ("output_inertia", "crank_inertia"):
        if getattr(interface, name) != 0.0 and interface.kind == "kinematic":
            raise ArgumentError(name, "is only for the compliant interface")
    for name, unit in (("output_inertia", "kg*m^2"), ("crank_inertia", "kg*m^2"), ("mesh_damping", "N*m*s/rad")):
        if not 0.0 <= (getattr(interface, name) or 0.0) < math.inf:
            raise ArgumentError(name, f"it must be finite and not below zero ({unit})", getattr(interface, name))
    if interface.thermal is not None and interface.thermal.capacity is None:
        raise ArgumentError("thermal", "needs a capacity")
    try:
        check_losses(interface.losses)
    except ValueError as problem:
        raise edge.InputError(f"{problem}.") from None
    return interface if drive.first_stage is None else dataclasses.replace(interface, driven="sun")


def completed(interface: InterfaceKind | Interface, drive: DriveValue) -> Interface:
    """Return the interface of an FMU of this drive with all values determined during the build.

    Raises
    ------
    edge.InputError
        As `checked_interface`, `chain.with_chain` and `model_losses.model_losses` do.
    """
    checked = checked_interface(interface, drive)
    if drive.pair.supports is not None:
        play_loads(drive.pair)  # raises without a rated torque
    lossy, _ = with_model_losses(checked, drive)
    return with_damping(with_chain(_with_heat(lossy, drive), drive), drive)


def _with_heat(interface: Interface, drive: DriveValue) -> Interface:
    """Return an interface with a heat port where the drive's losses and its heat capacity are stated."""
    thermal, stated = drive.pair.thermal, drive.pair.losses is not None and drive.pair.supports is not None
    if interface.thermal is not None or not stated or thermal is None or thermal.capacity is None:
        return interface
    return dataclasses.replace(interface, thermal=thermal)


def with_damping(interface: Interface, drive: DriveValue) -> Interface:
    """Return a compliant interface with the default mesh damping if none is stated."""
    if interface.kind == "kinematic" or interface.mesh_damping is not None:
        return interface
    stiffness = solve(drive.stage, [drive.pair.rated_torque or 100.0], [0.0]).torsional_stiffness
    whole = 1.0 / (1.0 / float(stiffness[0, 0]) + interface.series_compliance)
    return dataclasses.replace(interface, mesh_damping=DAMPING_TIME * whole)


def check_losses(rows: Sequence[LossRow]) -> None:
    """Check a loss table.

    Raises
    ------
    ValueError
        If speeds do not ascend from 0, an efficiency is not between 0 and 1 or a torque is below 0; the text is one
        sentence.
    """
    for i, (speed, forward, backward, *torques) in enumerate(rows, start=1):
        if not (speed == 0.0 if i == 1 else rows[i - 2][0] < speed < math.inf):
            raise ValueError(f"loss_table[{i},1] = {speed:g}: speeds must ascend from 0")
        if not 0.0 < forward <= 1.0:
            raise ValueError(f"loss_table[{i},2] = {forward:g}: an efficiency must be above 0 and not above 1")
        if not 0.0 <= backward <= 1.0:
            raise ValueError(f"loss_table[{i},3] = {backward:g}: an efficiency must be between 0 and 1")
        for j, torque in enumerate(torques, start=4):
            if not 0.0 <= torque < math.inf:
                raise ValueError(f"loss_table[{i},{j}] = {torque:g}: a friction torque must not be below 0")


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
