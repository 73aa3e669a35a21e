"""From a pair and its error surface to an FMU file."""

from __future__ import annotations

import dataclasses
import importlib
import json
import math
import os
import shutil
import sys
import tempfile
import zipfile
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from cycloid_fmu import __version__, edge
from cycloid_fmu.errors.kinds import KINDS
from cycloid_fmu.fmu.description import Version
from cycloid_fmu.fmu.losses import check_losses
from cycloid_fmu.fmu.parts import parts, write_archive
from cycloid_fmu.fmu.reducer_model import FirstStage
from cycloid_fmu.fmu.variables import Interface, LossRow, from_tables, variables
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.surfaces.files import write_surface
from cycloid_fmu.surfaces.surface import DEVIATIONS, ErrorSurface

if TYPE_CHECKING:
    from cycloid_fmu.fmu.tables import Tables

_LIBRARIES = {"2.0": "pythonfmu", "3.0": "pythonfmu3"}
_SCRIPTS = {"2.0": "cycloid_drive.py", "3.0": "cycloid_drive3.py"}
# FMI 2.0's library stands before pythonfmu's, which does not decode the resources' URI (front/front.c).
_FRONT = Path(__file__).with_name("front")
_FRONTS = {
    "binaries/linux64/CycloidDrive.so": "binaries/linux64/pythonfmu-export.so",
    "binaries/win64/CycloidDrive.dll": "binaries/win64/pythonfmu-export.dll",
}


def build_fmu(
    pair: Pair,
    surface: ErrorSurface,
    path: str | os.PathLike[str],
    first_stage: FirstStage | None = None,
    *,
    interface: Interface | None = None,
    fmi_version: Version = "2.0",
    tables: Tables | None = None,
) -> None:
    """Write a Co-Simulation FMU of the drive that runs in a Python host, whole or not at all.

    Parameters
    ----------
    pair, surface
        The nominal pair and its errors; the surface file lies in the FMU's `resources/`.
    path
        The FMU file.
    first_stage
        What makes the drive an RV reducer, whose input is the sun; without it the input is the crank.
    interface
        What the FMU offers; the kinematic interface by default.
    fmi_version
        "2.0" or "3.0".
    tables
        What the FMU interpolates instead of solving the contacts; of the pair, without its first stage.

    Raises
    ------
    edge.InputError
        If the folder does not exist, the loss table is none, or the interface and a first stage don't go together.
    """
    from cycloid_fmu.fmu.core import NUMBERS, SURFACE
    from cycloid_fmu.fmu.table_teeth import TABLE
    from cycloid_fmu.fmu.tables import write as written

    interface = checked_interface(interface or Interface(), first_stage)
    table = variables(pair, surface, interface, fmi_version)
    library = _LIBRARIES[fmi_version]
    builder: Any = importlib.import_module(f"{library}.builder")
    # An FMU that ran in this process has brought its own copy of the library, which has no binaries for another.
    builder.HERE = Path(str(metadata.distribution(library).locate_file(library)))
    target = Path(path)
    with tempfile.TemporaryDirectory(prefix="cycloid-fmu-") as folder, edge.written_whole(target) as temporary:
        place = Path(folder)
        numbers: dict[str, object] = {
            "package_version": __version__, "pair": pair.nominal.text, "interface": dataclasses.asdict(interface),
            "tables": "" if tables is None else tables.told,
        }  # fmt: skip
        if first_stage is not None:
            numbers["first_stage"] = dataclasses.asdict(first_stage)
        (place / NUMBERS).write_text(json.dumps(numbers, indent=1), encoding="utf-8")
        with (place / SURFACE).open("wb") as file:
            arrays = {name: getattr(surface, name) for name in (*KINDS, *DEVIATIONS)}
            if surface.life is not None:
                arrays.update({f"life_{n}": a for n, a in vars(surface.life).items()})
            np.savez(file, allow_pickle=False, **{n: a for n, a in arrays.items() if a is not None})
        write_surface(surface, place / "surface.nc")
        files = [NUMBERS, SURFACE, "surface.nc"]
        if tables is not None:
            (place / TABLE).write_bytes(written(tables, interface, table))
            files.append(TABLE)
        script = Path(shutil.copy(Path(__file__).with_name(_SCRIPTS[fmi_version]), place))
        try:
            builder.FmuBuilder.build_FMU(
                script,
                dest=place,
                project_files=[place / name for name in files],
                canGetAndSetFMUstate=True,
                canSerializeFMUstate=True,
                canGetAndSetFMUState=True,
                canSerializeFMUState=True,
            )
        finally:
            # The builder leaves the script's folder and module behind, and the next build would find the old one.
            sys.path[:] = [p for p in sys.path if p != str(place)]
            sys.modules.pop(script.stem, None)
        told = table if tables is None else tuple(from_tables(table).values())
        fronts = _FRONTS if fmi_version == "2.0" else {}
        with zipfile.ZipFile(place / "CycloidDrive.fmu") as made:
            contents = {fronts.get(name, name): made.read(name) for name in made.namelist()}
        for name, behind in fronts.items():
            if behind in contents:
                contents[name] = (_FRONT / name.removeprefix("binaries/")).read_bytes()
        write_archive(temporary, {**contents, **parts(pair, interface, told, fmi_version, [library])})


def checked_interface(interface: Interface, first_stage: FirstStage | None) -> Interface:
    """Return the interface as an FMU of this drive has it; an `InputError` says what does not go together."""
    if first_stage is not None and interface.kind == "compliant":
        raise edge.InputError("--interface = compliant: an RV reducer has the kinematic interface alone.")
    if interface.output_inertia != 0.0 and interface.kind == "kinematic":
        raise edge.InputError("--output-inertia: the kinematic interface has none; use --interface compliant.")
    if not 0.0 <= interface.output_inertia < math.inf:
        raise edge.InputError(f"--output-inertia = {interface.output_inertia:g} kg*m^2: it must not be below zero.")
    try:
        check_losses(interface.losses)
    except ValueError as problem:
        raise edge.InputError(f"{problem}.") from None
    return interface if first_stage is None else dataclasses.replace(interface, driven="sun")


def read_losses(path: str | os.PathLike[str]) -> tuple[LossRow, ...]:
    """Return the rows of a loss table: a CSV file, `speed [rpm],eta_mf1 [1],eta_mf2 [1],tau_bf1 [N*m],tau_bf2 [N*m]`.

    Raises
    ------
    edge.InputError
        If the file can't be read, a column or its unit is missing, or a row is none of a loss table.
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
