"""The file of a drive: a gear pair or a whole RV reducer."""

from __future__ import annotations

import os
import warnings

from cycloid_fmu import edge
from cycloid_fmu.bodies.matrices import check_bodies
from cycloid_fmu.geometry.first_stage import FirstStage
from cycloid_fmu.geometry.pair import Pair, read_pair
from cycloid_fmu.reducer.description import FORMAT, contradictions, read_reducer
from cycloid_fmu.reducer.lost_motion import parts_of
from cycloid_fmu.surfaces.structured import dimensions
from cycloid_fmu.surfaces.surface import ErrorSurface, surface_of_pair


def parts_of_file(path: str | os.PathLike[str]) -> tuple[Pair, ErrorSurface, FirstStage | None]:
    """Return the pair of a pair file or a reducer file, its stated errors, and a reducer's first stage.

    If a reducer file contradicts itself, an `edge.InputWarning` states the values used.

    Raises
    ------
    edge.InputError
        If the file can't be read, or a drive with these errors is impossible.
    """
    if edge.format_of(path) == FORMAT:
        reducer = read_reducer(path)
        for contradiction in contradictions(reducer, str(path)):
            warnings.warn(contradiction, edge.InputWarning, stacklevel=3)
        pair, surface, first_stage = parts_of(reducer)
    else:
        pair, first_stage = read_pair(path), None
        surface = surface_of_pair(pair)
    if pair.bodies is not None:
        check_bodies(pair, pair.bodies, str(path))
    dimensions(pair, surface, f"{path}: errors")
    return pair, surface, first_stage
