"""The only module that uses internals of pythonfmu and pythonfmu3, which have no public interface for this."""

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
        The script, which defines the class `CycloidDrive`.
    files
        Further files in the FMU's `resources/`.
    folder
        Folder of the FMU, whose path is returned.
    """
    builder: Any = importlib.import_module(f"{library}.builder")
    # An FMU that ran in this process loaded its own copy of the library, which lacks the binaries for another FMU.
    builder.HERE = Path(str(metadata.distribution(library).locate_file(library)))
    script = Path(shutil.copy(script, folder))
    try:
        builder.FmuBuilder.build_FMU(
            script,
            dest=folder,
            project_files=list(files),
            canGetAndSetFMUstate=True,
            canSerializeFMUstate=True,
            canGetAndSetFMUState=True,
            canSerializeFMUState=True,
        )
    finally:
        # The builder leaves the script's folder in the path and its module loaded; the next build would find the old
        # one.
        sys.path[:] = [p for p in sys.path if p != str(folder)]
        sys.modules.pop(script.stem, None)
    return folder / "CycloidDrive.fmu"
