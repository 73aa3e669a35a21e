"""From a pair and its error surface to an FMU file."""

from __future__ import annotations

import dataclasses
import json
import os
import shutil
import sys
import tempfile
from importlib import metadata
from pathlib import Path

import numpy as np

from cycloid_fmu import __version__, edge
from cycloid_fmu.fmu.reducer_model import FirstStage
from cycloid_fmu.pair import Pair
from cycloid_fmu.surface import DESCRIPTIONS, DEVIATIONS, ErrorSurface, write_surface

_SCRIPT = Path(__file__).with_name("cycloid_drive.py")


def build_fmu(
    pair: Pair, surface: ErrorSurface, path: str | os.PathLike[str], first_stage: FirstStage | None = None
) -> None:
    """Write an FMI 2.0 Co-Simulation FMU of the drive, whole or not at all.

    Parameters
    ----------
    pair, surface
        The nominal pair and its errors; the surface file lies in the FMU's `resources/`.
    path
        The FMU file.
    first_stage
        What makes the drive an RV reducer, whose input is the sun; without it the input is the crank.

    Raises
    ------
    edge.InputError
        If the folder does not exist.
    """
    from pythonfmu import FmuBuilder, builder

    from cycloid_fmu.fmu.slave import ARRAYS, NUMBERS

    # An FMU that ran in this process has brought its own copy of pythonfmu, which has no libraries to put into another.
    builder.HERE = Path(str(metadata.distribution("pythonfmu").locate_file("pythonfmu")))
    target = Path(path)
    with tempfile.TemporaryDirectory(prefix="cycloid-fmu-") as folder, edge.written_whole(target) as temporary:
        place = Path(folder)
        numbers: dict[str, object] = {"package_version": __version__, "pair": pair.numbers()}
        if first_stage is not None:
            numbers["first_stage"] = dataclasses.asdict(first_stage)
        (place / NUMBERS).write_text(json.dumps(numbers, indent=1), encoding="utf-8")
        with (place / ARRAYS).open("wb") as file:
            arrays = {name: getattr(surface, name) for name in (*DESCRIPTIONS, *DEVIATIONS)}
            if surface.life is not None:
                arrays.update({f"life_{n}": a for n, a in vars(surface.life).items()})
            np.savez(file, allow_pickle=False, **{n: a for n, a in arrays.items() if a is not None})
        write_surface(surface, place / "surface.nc")
        script = Path(shutil.copy(_SCRIPT, place))
        built = place / "built.fmu"
        try:
            FmuBuilder.build_FMU(
                script,
                dest=built,
                project_files=[place / NUMBERS, place / ARRAYS, place / "surface.nc"],
                canGetAndSetFMUstate=True,
                canSerializeFMUstate=True,
            )
        finally:
            # The builder leaves the script's folder and module behind, and the next build would find the old one.
            sys.path[:] = [p for p in sys.path if p != str(place)]
            sys.modules.pop(script.stem, None)
        shutil.copyfile(built, temporary)
