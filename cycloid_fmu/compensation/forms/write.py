"""Writes a compensator in the form given by the ending of a file name."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

from cycloid_fmu import edge
from cycloid_fmu.compensation.compensator import Compensator
from cycloid_fmu.compensation.forms.c_source import c_source
from cycloid_fmu.compensation.forms.fmu import build_compensator_fmu
from cycloid_fmu.compensation.forms.look_up import csv_text, look_up
from cycloid_fmu.compensation.forms.numbers import name_of
from cycloid_fmu.fmu.description import Version

ENDINGS = (".c", ".h", ".csv", ".fmu")


def write_compensator(
    compensator: Compensator,
    path: str | os.PathLike[str],
    *,
    temperature: float | None = None,
    fmi_version: Version = "2.0",
    platforms: Sequence[str] = (),
) -> tuple[Path, ...]:
    """Write a compensator, never partial files, and return the files.

    Parameters
    ----------
    compensator
        The compensator.
    path
        Its ending selects the form: `.c` or `.h` both C99 files, `.csv` a look-up table, `.fmu` an FMU. The name of
        C files is also that of their content.
    temperature
        Temperature of the look-up table, K; None for the middle of the compensator's range.
    fmi_version, platforms
        For an FMU, as in `cycloid_fmu.fmu.native.build_native`.

    Raises
    ------
    edge.InputError
        If the folder does not exist, the ending or the name is not allowed, the table is too large, or an
        FMU's platform can't be built for.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> from cycloid_fmu.compensation.forms.write import write_compensator
    >>> pair = cy.Pair(
    ...     gear_teeth=11, pin_circle_radius="30 mm", pin_radius="2.5 mm", eccentricity="1 mm", face_width="8 mm",
    ...     rated_torque="40 N*m",
    ... )
    >>> compensator = cy.Drive(pair).compensator(residual="2 arcsec")
    >>> [path.name for path in write_compensator(compensator, "joint.c")]
    ['joint.c', 'joint.h']
    """
    path = edge.output_path(Path(path), "path", ENDINGS)
    if path.suffix == ".fmu":
        build_compensator_fmu(compensator, path, fmi_version=fmi_version, platforms=platforms)
        return (path,)
    if path.suffix == ".csv":
        texts = {path: csv_text(compensator, look_up(compensator, temperature))}
    else:
        source, header = c_source(compensator, name_of(path))
        texts = {path.with_suffix(".c"): source, path.with_suffix(".h"): header}
    for file, text in texts.items():
        with edge.written_whole(file) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="\n")
    return tuple(texts)
