"""The motion of the simulated bench, from a function or an FMU."""

from __future__ import annotations

import dataclasses
import math
import os
import re
import shutil
from collections.abc import Callable
from typing import Any, Literal, TypeAlias

import numpy as np

from cycloid_fmu import edge
from drivers.recording_format import FloatArray, IntArray

OutputAngle: TypeAlias = Callable[[FloatArray, FloatArray], FloatArray]


@dataclasses.dataclass(frozen=True)
class SimulatedRun:
    """A run of the bench at a constant torque; SI values of `simulate.SimulatedMotion`.

    Samples begin at crank angle 0, with the end of the last turn excluded; "backward" uses the same angles from the
    last to the first. `lead_in` is the number of additional samples before the first, at the same spacing, in which the
    drive settles on its flank.
    """

    torque: float
    turns: int = 39
    samples_per_turn: int = 96
    direction: Literal["forward", "backward"] = "forward"
    speed: float = 2 * math.pi
    noise: float = 0.0
    torque_noise: float = 0.0
    seed: int = 0
    lead_in: int = 0

    @property
    def samples(self) -> int:
        """Number of samples, lead-in included."""
        return self.turns * self.samples_per_turn + self.lead_in


@dataclasses.dataclass(frozen=True)
class Motion:
    """A run and its measured values, noise included: time, s, angles, rad, torque, N*m, arrays of shape (n,)."""

    run: SimulatedRun
    time: FloatArray
    input_angle: FloatArray
    output_angle: FloatArray
    torque: FloatArray


def simulate_motion(output_angle: OutputAngle, run: SimulatedRun) -> Motion:
    """Return the measured motion of a drive in a run.

    Parameters
    ----------
    output_angle
        Function of crank angles, rad, and torques, N*m, that returns output angles, rad, all of shape (n,) in the order
        of time; `fmu_output_angle` returns that of an FMU.
    run
        Angles, torque and noise.
    """
    step = 2 * math.pi / run.samples_per_turn
    angle = step * np.arange(-run.lead_in, run.samples - run.lead_in, dtype=np.float64)
    if run.direction == "backward":
        angle = step * (run.turns * run.samples_per_turn - 1) - angle
    return _measured(output_angle, run, angle, np.full(run.samples, float(run.torque)))


def simulate_hysteresis(output_angle: OutputAngle, run: SimulatedRun) -> Motion:
    """Lock a drive's input at crank angle 0 and cycle the torque: 0, +T, 0, -T, 0.

    Parameters
    ----------
    output_angle
        As for `simulate_motion`.
    run
        `torque` is T, `turns` the number of loops, `samples_per_turn` the samples of each; a loop takes 2 pi / `speed`.
    """
    phase = 4.0 * np.arange(run.samples) / run.samples_per_turn % 4.0
    phase[-1] = 0.0  # back at zero torque
    torque = run.torque * np.interp(phase, [0.0, 1.0, 2.0, 3.0, 4.0], [0.0, 1.0, 0.0, -1.0, 0.0])
    return _measured(output_angle, run, np.zeros(run.samples), torque)


def _measured(output_angle: OutputAngle, run: SimulatedRun, angle: FloatArray, torque: FloatArray) -> Motion:
    """Return the measured values for crank angles, rad, and torques, N*m, both of shape (n,)."""
    output = np.asarray(output_angle(angle, torque), np.float64)
    if output.shape != angle.shape:
        raise ValueError(f"output_angle returned the shape {output.shape} for angles of shape {angle.shape}")
    random = np.random.default_rng(run.seed)
    return Motion(
        run,
        np.arange(run.samples, dtype=np.float64) * (2 * math.pi / run.samples_per_turn / run.speed),
        angle + run.noise * random.standard_normal(run.samples),
        output + run.noise * random.standard_normal(run.samples),
        torque + run.torque_noise * random.standard_normal(run.samples),
    )


def stated_in_fmu(path: str | os.PathLike[str]) -> dict[str, float]:
    """Return the ratio and the rated torque, N*m, that a drive's FMU states, by these names; what it lacks is left out.

    Raises
    ------
    edge.InputError
        If the file is not an FMU.
    """
    constants = {v.name: v.start for v in _description(path).modelVariables if v.variability == "constant"}
    return {name: float(constants[name]) for name in ("ratio", "rated_torque") if name in constants}


def _description(path: str | os.PathLike[str]) -> Any:
    from fmpy import read_model_description

    edge.zip_archive(path, "FMU", "modelDescription.xml")
    with edge.parsed_by_others(path, "this is not an FMU"):
        return read_model_description(str(path))


def fmu_output_angle(path: str | os.PathLike[str], step: float = 1e-3) -> OutputAngle:
    """Return the function for the output angle of a drive's FMU, with one step of `step` seconds per sample.

    Raises
    ------
    edge.InputError
        If it is no FMI 2.0 co-simulation FMU with the inputs `flange_a.phi`, `flange_b.tau` and the output
        `flange_b.phi`. The function raises it with the FMU's message where the FMU refuses a torque or an angle.
    """
    from fmpy import extract
    from fmpy.fmi1 import FMICallException
    from fmpy.fmi2 import FMU2Slave, defaultCallbacks, fmi2CallbackFunctions, fmi2CallbackLoggerTYPE

    description = _description(path)
    references = {v.name: v.valueReference for v in description.modelVariables}
    causalities = {v.name: v.causality for v in description.modelVariables}
    needed = {"flange_a.phi": "input", "flange_b.tau": "input", "flange_b.phi": "output"}
    missing = [f"{kind} {name}" for name, kind in needed.items() if causalities.get(name) != kind]
    if description.fmiVersion != "2.0" or description.coSimulation is None or missing:
        what = f"it has no {missing[0]}" if missing else f"FMI {description.fmiVersion}"
        raise edge.InputError(f"{path}: the bench needs a kinematic FMI 2.0 co-simulation FMU of a drive; {what}.")

    def output_angle(angle: FloatArray, torque: FloatArray) -> FloatArray:
        folder = extract(str(path))
        fmu = FMU2Slave(
            guid=description.guid,
            unzipDirectory=folder,
            modelIdentifier=description.coSimulation.modelIdentifier,
            instanceName="bench",
        )
        inputs = [references["flange_a.phi"], references["flange_b.tau"]]
        outputs = [references["flange_b.phi"]]
        output, messages = np.empty(len(angle)), list[str]()
        callbacks = fmi2CallbackFunctions(*(getattr(defaultCallbacks, n) for n, _ in fmi2CallbackFunctions._fields_))
        callbacks.logger = fmi2CallbackLoggerTYPE(
            lambda *words: messages.append(words[-1].decode("utf-8", "replace").splitlines()[-1])
        )
        try:
            fmu.instantiate(callbacks=callbacks, loggingOn=True)
            try:
                fmu.setupExperiment(startTime=0.0)
                fmu.enterInitializationMode()
                if len(angle):
                    fmu.setReal(inputs, [float(angle[0]), float(torque[0])])
                fmu.exitInitializationMode()
                for i, given in enumerate(zip(angle.tolist(), torque.tolist(), strict=True)):
                    fmu.setReal(inputs, given)
                    fmu.doStep(i * step, step)
                    output[i] = fmu.getReal(outputs)[0]
                fmu.terminate()
            except FMICallException as problem:
                # Messages of a Python slave begin with the exception's class.
                why = re.sub(r"""^\w+\((['"])(.*)\1\)$""", r"\2", messages[-1] if messages else str(problem))
                raise edge.InputError(f"{path}: the run was refused: {why.rstrip('.')}.") from None
            finally:
                fmu.freeInstance()
        finally:
            shutil.rmtree(folder, ignore_errors=True)
        return output

    return output_angle


def quantised(angle: FloatArray, counts_per_turn: int) -> IntArray:
    """Return the nearest counts of angles, rad, without rollover, shape (n,)."""
    return np.rint(angle * (counts_per_turn / (2 * math.pi))).astype(np.int64)
