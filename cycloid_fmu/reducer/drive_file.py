"""The file of a drive, whichever it is: a gear pair or a whole RV reducer."""

from __future__ import annotations

import os

from cycloid_fmu import edge
from cycloid_fmu.geometry.pair import Pair, read_pair
from cycloid_fmu.reducer.lost_motion import FORMAT, Reducer, contradictions, read_reducer
from cycloid_fmu.surfaces.files import read_surface
from cycloid_fmu.surfaces.structured import dimensions
from cycloid_fmu.surfaces.surface import ErrorSurface, check_surface, surface_of_pair


def drive_of_file(
    path: str | os.PathLike[str], surface_file: str | os.PathLike[str] | None = None
) -> tuple[Pair | Reducer, ErrorSurface | None, list[str]]:
    """Return what an FMU is built from, of a pair file or a reducer file.

    Parameters
    ----------
    path
        A file of the format cycloid-pair/1 or cycloid-reducer/1.
    surface_file
        The errors; without it those that the file states.

    Returns
    -------
    drive, surface, warnings
        The surface of `surface_file`, None without one; sentences where a reducer file contradicts itself.

    Raises
    ------
    edge.InputError
        If a file can't be read, the surface belongs to another pair, or a drive with these errors can't have been made.
    """
    warnings = list[str]()
    drive: Pair | Reducer
    if edge.format_of(path) == FORMAT:
        drive = read_reducer(path)
        warnings = contradictions(drive, str(path))
    else:
        drive = read_pair(path)
    pair = drive if isinstance(drive, Pair) else drive.stage
    if surface_file is None:
        dimensions(pair, surface_of_pair(pair), f"{path}: errors")
        return drive, None, warnings
    surface = read_surface(surface_file)
    check_surface(pair, surface, str(path), str(surface_file))
    dimensions(pair, surface, f"{surface_file}: errors")
    return drive, surface, warnings
