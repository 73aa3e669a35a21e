"""Look into an FMU and turn its crank, with fmpy."""

from __future__ import annotations

import math
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import edge

OUTPUTS = (
    "flange_b.phi", "flange_b.w", "flange_a.tau", "transmission_error", "backlash", "torsional_stiffness",
    "max_contact_pressure",
)  # fmt: skip


def described(path: str | os.PathLike[str]) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the variables of an FMU and the problems that fmpy's validation finds.

    Raises
    ------
    edge.InputError
        If the file is no FMU.
    """
    from fmpy.validation import validate_fmu

    description = _description(path)
    variables = [
        {
            "name": v.name,
            "causality": v.causality,
            "variability": v.variability,
            "unit": v.unit or "",
            "start": "" if v.start is None else v.start,
            "min": v.min,
            "max": v.max,
            "description": v.description or "",
        }
        for v in description.modelVariables
    ]
    return variables, validate_fmu(str(path))


def _description(path: str | os.PathLike[str]) -> Any:
    import fmpy

    edge.existing(path)
    try:
        return fmpy.read_model_description(str(path), validate=False)
    except Exception as problem:
        raise edge.InputError(f"{path}: this is not an FMU ({type(problem).__name__}: {problem}).") from None


@contextmanager
def _instance(path: str | os.PathLike[str]) -> Iterator[tuple[Any, dict[str, int]]]:
    import fmpy
    from fmpy.fmi2 import FMU2Slave

    description = _description(path)
    references = {v.name: v.valueReference for v in description.modelVariables}
    missing = [n for n in ("flange_a.phi", "flange_b.tau", "flange_b.phi") if n not in references]
    if missing:
        raise edge.InputError(f"{path}: this FMU has no variable {missing[0]}; it is not one of a cycloid drive.")
    folder = fmpy.extract(str(path))
    slave = FMU2Slave(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="drive",
    )
    try:
        slave.instantiate()
        yield slave, references
        slave.terminate()
    finally:
        if slave.component:
            slave.freeInstance()
        shutil.rmtree(folder, ignore_errors=True)


def follow(
    path: str | os.PathLike[str],
    crank_angle: ArrayLike,
    torque: ArrayLike,
    outputs: tuple[str, ...] = OUTPUTS,
    *,
    crank_speed: float = 0.0,
    step: float = 1e-3,
) -> dict[str, NDArray[np.float64]]:
    """Lead an FMU through given crank angles and torques and return its outputs at each.

    Parameters
    ----------
    path
        The FMU file.
    crank_angle, torque
        Shape (samples,) or scalar: rad, N·m; the first sample is the initial state.
    outputs
        Names of real outputs.
    crank_speed
        Given to `flange_a.w`, rad/s.
    step
        Communication step, s.

    Returns
    -------
    results
        {name: shape (samples,)}, SI.
    """
    angles, torques = (np.asarray(v, dtype=float) for v in np.broadcast_arrays(crank_angle, torque))
    found = np.empty((angles.size, len(outputs)))
    with _instance(path) as (slave, references):
        inputs = [references[n] for n in ("flange_a.phi", "flange_a.w", "flange_b.tau")]
        wanted = [references[n] for n in outputs]
        slave.setupExperiment(startTime=0.0)
        slave.enterInitializationMode()
        slave.setReal(inputs, [float(angles[0]), crank_speed, float(torques[0])])
        slave.exitInitializationMode()
        found[0] = slave.getReal(wanted)
        for i in range(1, angles.size):
            slave.setReal(inputs, [float(angles[i]), crank_speed, float(torques[i])])
            slave.doStep((i - 1) * step, step)
            found[i] = slave.getReal(wanted)
    return dict(zip(outputs, found.T, strict=True))


def turn_crank(
    path: str | os.PathLike[str], torque: float, turns: float, crank_speed: float, samples: int
) -> dict[str, NDArray[np.float64]]:
    """Turn the crank of an FMU at constant speed and torque.

    Parameters
    ----------
    torque, turns, crank_speed
        N·m; crank turns, below zero backwards; rad/s, above zero.
    samples
        Samples for each crank turn.

    Returns
    -------
    results
        {"time" s, "flange_a.phi" rad and the outputs: shape (samples,)}.
    """
    count = max(2, round(abs(turns) * samples) + 1)
    angle = np.linspace(0.0, 2.0 * math.pi * turns, count)
    time = np.abs(angle) / crank_speed
    speed = math.copysign(crank_speed, turns)
    results = follow(path, angle, torque, crank_speed=speed, step=float(time[1]))
    return {"time": time, "flange_a.phi": angle, **results}
