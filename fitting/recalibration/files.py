"""Files of recalibrations: the figures at all dates, and the distribution of the errors for the next date."""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import numpy as np
import pydantic

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from fitting.model.prior import posterior_about
from fitting.recalibration.drift import fitted_drive
from fitting.recalibration.recalibrate import Dated, Recalibration

FORMAT = "cycloid-recalibration/1"


def as_json(result: Recalibration) -> dict[str, Any]:
    """Return a recalibration as the content of a `cycloid-recalibration/1` file (SI)."""
    posterior = result.posterior
    count = len(posterior.errors)
    same = ("alarm", "told", "better_known", "remaining", "drift_chance", "left_chance", "notes")
    return {
        "format": FORMAT,
        "drive": result.drive.hash,
        "history": [dataclasses.asdict(dated) for dated in result.history],
        "moved": {n: {"by": by, "times": times} for n, (by, times) in result.moved.items()},
        "bench": {
            "names": list(posterior.bench),
            "mean": posterior.bench_mean,
            "covariance": posterior.covariance[count : count + len(posterior.bench)],
        },
        **{name: getattr(result, name) for name in same},
    }


def write_recalibration(result: Recalibration, path: str | os.PathLike[str]) -> None:
    """Write a recalibration, `cycloid-recalibration/1`, whole or not at all.

    The drive is written separately, with `result.drive.write("now.nc")`.
    """
    with edge.written_whole(path) as temporary:
        temporary.write_text(edge.json_text(as_json(result)), encoding="utf-8")


def read_recalibration(path: str | os.PathLike[str], drive: Drive) -> Recalibration:
    """Read a recalibration, from which the next one continues.

    Parameters
    ----------
    path
        The file.
    drive
        The drive that was written together with it.

    Raises
    ------
    edge.InputError
        If it cannot be read, has another format, belongs to another drive, or is not consistent.
    """
    data = edge.json_table(path, FORMAT, "recalibration")
    if data.get("drive") != drive.hash:
        raise edge.InputError(
            f"{path}: it belongs to the drive {edge.shown(data.get('drive'))}, this one is {drive.hash}; give the pair "
            "and the surface that were written with it."
        )
    own = fitted_drive(drive)
    with edge.parsed_by_others(path, "it is not as recalibrate writes it"):
        bench = data["bench"]
        names = tuple(str(n) for n in bench["names"])
        of_surface = own.of_surface
        count, size = len(own.errors), len(of_surface) + len(names)
        rows = np.array(bench["covariance"], dtype=float).reshape(len(names), size)
        covariance = np.zeros((size, size))
        at = np.r_[:count, count + len(names) : size]
        covariance[np.ix_(at, at)] = of_surface
        covariance[count : count + len(names)] = rows
        covariance[:, count : count + len(names)] = rows.T
        mean = np.array(bench["mean"], dtype=float).reshape(len(names))
        if not (np.isfinite(covariance).all() and np.isfinite(mean).all()):
            raise ValueError("not finite")
        recalibration = Recalibration(
            drive=drive,
            alarm=str(data["alarm"]),
            history=pydantic.TypeAdapter(tuple[Dated, ...]).validate_python(data["history"]),
            moved={str(n): (float(m["by"]), float(m["times"])) for n, m in data["moved"].items()},
            told=np.array(data["told"], dtype=float),
            better_known=tuple(map(str, data["better_known"])),
            remaining=int(data["remaining"]),
            drift_chance=float(data["drift_chance"]),
            left_chance=float(data["left_chance"]),
            posterior=posterior_about(drive, own.errors, names, mean, covariance),
            notes=tuple(map(str, data["notes"])),
        )
        if not recalibration.history:
            raise ValueError("no date")
    return recalibration
