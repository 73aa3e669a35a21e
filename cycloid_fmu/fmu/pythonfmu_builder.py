"""The only module that uses internals of pythonfmu and pythonfmu3, which have no public way for this."""

from __future__ import annotations

import importlib
import shutil
import sys
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any


def build_archive(library: str, script: Path, files: Sequence[Path], folder: Path) -> Path:
    """Build an FMU whose slave is a script.

    Parameters
    ----------
    library
        "pythonfmu" or "pythonfmu3".
    script
        Defines the class `CycloidDrive`.
    files
        Further files in the FMU's `resources/`.
    folder
        Where to build; the FMU's name there is returned.
    """
    builder: Any = importlib.import_module(f"{library}.builder")
    # An FMU that ran in this process has brought its own copy of the library, which has no binaries for another.
    builder.HERE = Path(str(metadata.distribution(library).locate_file(library)))
    script = Path(shutil.copy(script, folder))
    try:
        builder.FmuBuilder.build_FMU(
            script, dest=folder, project_files=list(files), canGetAndSetFMUstate=True, canSerializeFMUstate=True,
            canGetAndSetFMUState=True, canSerializeFMUState=True,
        )  # fmt: skip
    finally:
        # The builder leaves the script's folder and module behind, and the next build would find the old one.
        sys.path[:] = [p for p in sys.path if p != str(folder)]
        sys.modules.pop(script.stem, None)
    return folder / "CycloidDrive.fmu"
