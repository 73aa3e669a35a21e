"""Pair files with `[bodies]`, as long as only influence matrices are computed from it."""

from __future__ import annotations

import os
from pathlib import Path

from cycloid_fmu import edge
from cycloid_fmu.bodies.matrices import check_bodies
from cycloid_fmu.edge import Config
from cycloid_fmu.geometry.bodies import Bodies
from cycloid_fmu.geometry.pair import FORMAT, Pair, pair_of_tables


class _File(Config):
    """The part of a pair file that states elastic bodies."""

    bodies: Bodies


def read_bodies(path: str | os.PathLike[str]) -> tuple[Pair, Bodies]:
    """Return the pair of a pair file with `[bodies]`, which has no place for them yet, and the bodies.

    Files that the bodies name are relative to the pair file.

    Raises
    ------
    edge.InputError
        If the file is invalid, has no `[bodies]` or no `[supports]`, or the bodies contradict the pair or each other;
        one sentence for each problem.
    """
    source = str(path)
    tables = dict(edge.toml_table(edge.read_text(path, FORMAT), FORMAT, source))
    stated = tables.pop("bodies", None)
    if stated is None:
        raise edge.InputError(f"{source}: [bodies] is missing; it states the elastic bodies.")
    pair = pair_of_tables(tables, source)
    bodies = edge.validated(_File, {"bodies": stated}, source).bodies.in_folder(Path(path).parent)
    check_bodies(pair, bodies, source)
    return pair, bodies
