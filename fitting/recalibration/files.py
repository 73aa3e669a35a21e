"""Files of recalibrations: the figures at all dates, and the distribution of the errors for the next date."""

from __future__ import annotations

import dataclasses
import os
from typing import Any

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.drive import Drive
from fitting.model.prior import posterior_about
from fitting.recalibration.drift import fitted_drive
from fitting.recalibration.figures import FigureOfDrive
from fitting.recalibration.recalibrate import Dated, Recalibration

FORMAT = "cycloid-recalibration/1"


def as_json(result: Recalibration) -> dict[str, Any]:
    """Return a recalibration as the content of a `cycloid-recalibration/1` file (SI)."""
    posterior = result.posterior
    count = len(posterior.errors)
    return {
        "format": FORMAT,
        "alarm": result.alarm,
        "drive": result.drive.hash,
        "history": [
            {
                "crank_turns": one.crank_turns,
                "alarm": one.alarm,
                "figures": {n: dataclasses.asdict(f) for n, f in one.figures.items()},
            }
            for one in result.history
        ],
        "moved": {n: {"by": by, "times": times} for n, (by, times) in result.moved.items()},
        "told": result.told,
        "better_known": list(result.better_known),
        "remaining": result.remaining,
        "drift_chance": result.drift_chance,
        "left_chance": result.left_chance,
        "bench": {
            "names": list(posterior.bench),
            "mean": posterior.bench_mean,
            "covariance": posterior.covariance[count : count + len(posterior.bench)],
        },
        "notes": list(result.notes),
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
        history = tuple(
            Dated(
                float(one["crank_turns"]),
                {
                    str(n): FigureOfDrive(
                        float(f["value"]),
                        (float(f["interval"][0]), float(f["interval"][1])),
                        float(f["standard_error"]),
                    )
                    for n, f in one["figures"].items()
                },
                str(one["alarm"]),
            )
            for one in data["history"]
        )
        recalibration = Recalibration(
            drive=drive,
            alarm=str(data["alarm"]),
            history=history,
            moved={str(n): (float(m["by"]), float(m["times"])) for n, m in data["moved"].items()},
            told=np.array(data["told"], dtype=float),
            better_known=tuple(str(one) for one in data["better_known"]),
            remaining=int(data["remaining"]),
            drift_chance=float(data["drift_chance"]),
            left_chance=float(data["left_chance"]),
            posterior=posterior_about(drive, own.errors, names, mean, covariance),
            notes=tuple(str(one) for one in data["notes"]),
        )
        if not recalibration.history:
            raise ValueError("no date")
    return recalibration
