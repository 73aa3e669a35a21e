"""Inspect, simulate and compare FMUs of drives with fmpy; FMI 2.0 and 3.0."""

from __future__ import annotations

import math
import os
import re
import shutil
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from fmpy.fmi1 import FMICallException
from numpy.typing import ArrayLike, NDArray

from cycloid_fmu import edge

Array = NDArray[np.float64]
OUTPUTS = (
    "flange_b.phi",
    "flange_b.w",
    "flange_a.tau",
    "transmission_error",
    "backlash",
    "torsional_stiffness",
    "max_contact_pressure",
)
_MOST_SAMPLES, _LEAST_TURNS = 1e7, 1e-6  # of a simulation at constant speed
# Names of the flanges' variables in bench recordings.
RECORDED = {"input_angle": "flange_a.phi", "output_angle": "flange_b.phi", "torque": "flange_b.tau"}


def described(path: str | os.PathLike[str]) -> tuple[list[dict[str, Any]], list[str]]:
    """Return the variables of an FMU and the problems that fmpy's validation finds.

    Raises
    ------
    edge.InputError
        If the file is not an FMU.
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
    with edge.parsed_by_others(path, "this is not an FMU"):
        return variables, edge.call_limited(path, validate_fmu, str(path))


def description_of(path: str | os.PathLike[str]) -> str:
    """Return the description in the FMU's model description, which states its stiffness.

    Raises
    ------
    edge.InputError
        If the file is not an FMU.
    """
    return str(_description(path).description or "")


def stated_drive(path: str | os.PathLike[str]) -> str:
    """Return the fingerprint of the drive that an FMU was built from, or "".

    Raises
    ------
    edge.InputError
        If the file is not an FMU.
    """
    from cycloid_fmu.fmu.parts import DRIVE

    archive_path = edge.zip_archive(path, "FMU")
    with edge.parsed_by_others(path, "this FMU is damaged"), zipfile.ZipFile(archive_path) as archive:
        if DRIVE not in archive.namelist():
            return ""
        return archive.read(DRIVE).decode().split("\n", 1)[0].removeprefix("# drive ")


def rated_load(path: str | os.PathLike[str]) -> float:
    """Return the rated torque that an FMU states, N·m: the load where none is given.

    Raises
    ------
    edge.InputError
        If it states none, or the file is not an FMU.
    """
    for variable in _description(path).modelVariables:
        if variable.name == "rated_torque":
            return float(variable.start)
    raise edge.ArgumentError("torque", f"is missing; give it: {path} states no rated_torque")


def _description(path: str | os.PathLike[str]) -> Any:
    import fmpy

    edge.zip_archive(path, "FMU", "modelDescription.xml")
    with edge.parsed_by_others(path, "this is not an FMU"):
        return fmpy.read_model_description(str(path), validate=False)


class Fmu:
    """One instance of a Co-Simulation FMU, with access to its variables by name; made by `open_fmu`.

    Attributes
    ----------
    path
        The file.
    variables
        fmpy's descriptions of the variables by name.
    """

    def __init__(self, path: str | os.PathLike[str], description: Any, slave: Any, messages: list[str]) -> None:
        self.path, self.slave, self._messages = path, slave, messages
        self.variables = {v.name: v for v in description.modelVariables}
        self._new = description.fmiVersion.startswith("3")

    def names(self, causality: str) -> list[str]:
        """Names of the scalar real variables of a causality."""
        kind = "Float64" if self._new else "Real"
        return [n for n, v in self.variables.items() if (v.causality, v.type) == (causality, kind) and not v.dimensions]

    def set(self, values: Mapping[str, float]) -> None:
        """Set scalars by name."""
        types = {"Real": float, "Float64": float, "Boolean": bool, "Integer": int, "Int32": int}
        for name, value in values.items():
            variable = self.variables[name]
            given = types[variable.type](value)
            getattr(self.slave, f"set{variable.type}")([variable.valueReference], [given])

    def reader(self, names: Sequence[str]) -> Callable[[], list[float]]:
        """Return a function that gives the present values of real variables."""
        references = [self.variables[n].valueReference for n in names]
        get = self.slave.getFloat64 if self._new else self.slave.getReal
        return lambda: get(references)

    def writer(self, names: Sequence[str]) -> Callable[[Sequence[float]], None]:
        """Return a function that sets real variables."""
        references = [self.variables[n].valueReference for n in names]
        put = self.slave.setFloat64 if self._new else self.slave.setReal
        return lambda values: put(references, values)

    def initialize(self, values: Mapping[str, float] | None = None) -> None:
        """Set start values, {name: SI value}, and complete the initialization."""
        if not self._new:
            self.slave.setupExperiment(startTime=0.0)
        try:
            self.slave.enterInitializationMode()
            self.set(values or {})
            self.slave.exitInitializationMode()
        except FMICallException as problem:
            self._raise("the start", problem)

    def step(self, time: float, step: float) -> None:
        """Make a step at a time, of a length, s; a refused one raises an `edge.InputError` with the FMU's message."""
        try:
            self.slave.doStep(time, step)
        except FMICallException as problem:
            self._raise(f"the step from {time:g} s", problem)

    def _raise(self, what: str, problem: Exception) -> NoReturn:
        raise edge.InputError(f"{self.path}: {what} was refused: {_reason(self._messages, problem)}.") from None


def _reason(messages: Sequence[str], problem: Exception) -> str:
    """Return what an FMU logged last, without the exception's class with which messages of a Python slave begin."""
    return re.sub(r"""^\w+\((['"])(.*)\1\)$""", r"\2", messages[-1] if messages else str(problem)).rstrip(".")


@contextmanager
def open_fmu(path: str | os.PathLike[str], inputs: Iterable[str] = (), outputs: Iterable[str] = ()) -> Iterator[Fmu]:
    """Instantiate an FMU, and terminate and free it afterwards.

    Parameters
    ----------
    inputs, outputs
        Required variables.

    Raises
    ------
    edge.InputError
        If the file is not a Co-Simulation FMU, lacks a variable or can't be instantiated.
    """
    import fmpy
    from fmpy.fmi2 import FMU2Slave, defaultCallbacks, fmi2CallbackFunctions, fmi2CallbackLoggerTYPE
    from fmpy.fmi3 import FMU3Slave

    description, messages = _description(path), list[str]()

    def listen(*words: Any) -> None:
        messages.append(words[-1].decode("utf-8", "replace").splitlines()[-1])

    if description.coSimulation is None:
        raise edge.InputError(f"{path}: this FMU is not for co-simulation.")
    causalities = {v.name: v.causality for v in description.modelVariables}
    for causality, names in (("input", inputs), ("output", outputs)):
        for name in names:
            if causalities.get(name) != causality:
                raise edge.InputError(f"{path}: this FMU has no {causality} {name}.")
    folder = fmpy.extract(str(path))
    new = description.fmiVersion.startswith("3")
    slave = (FMU3Slave if new else FMU2Slave)(
        guid=description.guid,
        unzipDirectory=folder,
        modelIdentifier=description.coSimulation.modelIdentifier,
        instanceName="drive",
    )
    callbacks = fmi2CallbackFunctions(*(getattr(defaultCallbacks, n) for n, _ in fmi2CallbackFunctions._fields_))
    callbacks.logger = fmi2CallbackLoggerTYPE(listen)
    logging = {"logMessage": listen} if new else {"callbacks": callbacks}
    try:
        try:
            slave.instantiate(loggingOn=True, **logging)
        except Exception as problem:  # fmpy has no specific class
            why = _reason(messages, problem)
            raise edge.InputError(f"{path}: this FMU can't be instantiated: {why}.") from None
        yield Fmu(path, description, slave, messages)
        slave.terminate()
    finally:
        if slave.component:
            slave.freeInstance()
        shutil.rmtree(folder, ignore_errors=True)


def simulate(
    path: str | os.PathLike[str],
    inputs: Mapping[str, Array],
    outputs: Sequence[str],
    time: Array,
    *,
    parameters: Mapping[str, float] | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> dict[str, Array]:
    """Run an FMU through given values of its inputs and return outputs at each.

    If angle and speed of a flange are given, both are set to their values at the start of each step, from which the FMU
    extrapolates; other inputs are set to their values at its end.

    Parameters
    ----------
    inputs
        {name: shape (samples,)}, SI; the first sample is the initial state.
    outputs, time
        Names of real outputs; time, s, shape (samples,), ascending.
    parameters
        Values set before initialisation.
    progress
        Called with the number of samples done since the last call.

    Returns
    -------
    results
        {name: shape (samples,)}, SI.
    """
    results = np.empty((time.size, len(outputs)))
    with open_fmu(path, inputs, outputs) as fmu:
        moving = "largest_step" in fmu.variables
        fmu.initialize({**(parameters or {}), **{n: float(v[0]) for n, v in inputs.items()}})
        put, get = fmu.writer(list(inputs)), fmu.reader(outputs)
        rows = np.column_stack(list(inputs.values())).tolist() if inputs else [[]] * time.size
        results[0] = get()
        for i in range(1, time.size):
            put(rows[i - 1 if moving else i])
            fmu.step(float(time[i - 1]), float(time[i] - time[i - 1]))
            results[i] = get()
            progress(1)
    return dict(zip(outputs, results.T, strict=True))


def simulate_fmu(
    path: str | os.PathLike[str],
    crank_angle: ArrayLike,
    torque: ArrayLike,
    outputs: tuple[str, ...] = OUTPUTS,
    *,
    crank_speed: float = 0.0,
    step: float = 1e-3,
) -> dict[str, Array]:
    """Run an FMU through given crank angles and torques and return its outputs at each.

    An example is that of `Drive.build_fmu`.

    Parameters
    ----------
    path
        The FMU file.
    crank_angle, torque
        Crank angle (rad) and torque of the environment on the output (N·m, counter-clockwise positive), shape
        (samples,) or scalar; the first sample is the initial state.
    outputs
        Names of real outputs.
    crank_speed
        Value of `flange_a.w`, rad/s.
    step
        Communication step, s.

    Returns
    -------
    results
        {name: shape (samples,)}, SI.
    """
    angles, torques = (np.asarray(v, dtype=float) for v in np.broadcast_arrays(crank_angle, torque))
    given = {"flange_a.phi": angles, "flange_a.w": np.full(angles.size, crank_speed), "flange_b.tau": torques}
    return simulate(path, given, outputs, step * np.arange(angles.size, dtype=np.float64))


def turn_crank(
    path: str | os.PathLike[str], torque: float, turns: float, crank_speed: float, samples: int
) -> dict[str, Array]:
    """Turn the crank of an FMU at constant speed and torque.

    Parameters
    ----------
    torque, turns, crank_speed
        Torque on the output, N·m; crank turns, below zero for backwards; speed, rad/s, above zero.
    samples
        Samples per crank turn.

    Returns
    -------
    results
        {name: shape (samples,)}, SI: "time", the inputs and the outputs.

    Raises
    ------
    edge.ArgumentError
        If turns or speed are out of range.
    """
    if not 0.0 < crank_speed < math.inf:
        raise edge.ArgumentError(
            "crank_speed", "it must be above zero; turn backwards with turns below zero", crank_speed
        )
    most = _MOST_SAMPLES / samples
    if not _LEAST_TURNS <= abs(turns) <= most:
        said = f"it must be from {_LEAST_TURNS:g} to {most:.6g}, or as far below zero, with {samples} samples a turn"
        raise edge.ArgumentError("turns", said, turns)
    count = max(2, round(abs(turns) * samples) + 1)
    angle = np.linspace(0.0, 2.0 * math.pi * turns, count)
    time = np.abs(angle) / crank_speed
    speed = math.copysign(crank_speed, turns)
    results = simulate_fmu(path, angle, torque, crank_speed=speed, step=float(time[1]))
    given = {"flange_a.phi": angle, "flange_a.w": np.full(count, speed), "flange_b.tau": np.full(count, torque)}
    return {"time": time, **given, **results}


def si_unit(unit: str) -> str:
    """Return an FMU's unit in the notation of quantities: N*m for N.m."""
    return unit.replace(".", "*").replace("m2", "m^2")


def read_motion(path: str | os.PathLike[str], units: Mapping[str, str]) -> tuple[Array, dict[str, Array]]:
    """Read a table of variables over time: a CSV file with units in its header, such as a recording or a simulation.

    Parameters
    ----------
    path
        The file: `time [s]` and columns named as the variables, or `input_angle`, `output_angle`, `torque` of a bench.
    units
        SI unit of each wanted variable; other columns are ignored.

    Returns
    -------
    time, values
        Time, s, shape (samples,); {variable: shape (samples,)}, SI.

    Raises
    ------
    edge.InputError
        If the file can't be read, has no time, or a cell is not a number.
    """
    columns = {name: RECORDED.get(name, name) for name in (*units, *RECORDED) if RECORDED.get(name, name) in units}
    rows = [row for _, row in edge.number_rows(path, {"time": "s"}, {n: units[v] for n, v in columns.items()})]
    series = {name: np.array([row[name] for row in rows]) for name in (rows[0] if rows else ("time",))}
    time = series.pop("time")
    if time.size < 2 or np.any(np.diff(time) <= 0.0):
        raise edge.InputError(f"{path}: time [s] must ascend over at least two lines.")
    return time, {columns[n]: v for n, v in series.items()}


def write_motion(path: str | os.PathLike[str], results: Mapping[str, Array], fmu: str | os.PathLike[str]) -> None:
    """Write `time` and an FMU's variables over it as the CSV table that `read_motion` reads; never a partial file."""
    units = {"time": "s", **units_of(fmu, "input"), **units_of(fmu, "output")}
    header = ",".join(f"{name} [{units[name]}]" for name in results)
    with edge.written_whole(path) as temporary, temporary.open("w", encoding="utf-8") as file:
        np.savetxt(
            file, np.column_stack(list(results.values())), delimiter=",", header=header, comments="", fmt="%.12g"
        )


def units_of(path: str | os.PathLike[str], causality: str) -> dict[str, str]:
    """Return the SI units of an FMU's scalar real variables of one causality, by name.

    Raises
    ------
    edge.InputError
        If the file is not an FMU.
    """
    return {
        v.name: si_unit(v.unit or "1")
        for v in _description(path).modelVariables
        if v.causality == causality and v.type in ("Real", "Float64") and not v.dimensions
    }


def read_inputs(path: str | os.PathLike[str], fmu: str | os.PathLike[str]) -> tuple[Array, dict[str, Array]]:
    """Read the inputs of an FMU over time; missing speeds are computed as the angles' derivatives.

    Raises
    ------
    edge.InputError
        As `read_motion`, and if an input is missing.
    """
    units = units_of(fmu, "input")
    time, values = read_motion(path, units)
    for name in units:
        angle = name.removesuffix(".w") + ".phi"
        if name not in values and name.endswith(".w") and angle in values:
            values[name] = np.gradient(values[angle], time)
        if name not in values:
            raise edge.InputError(f'{path}: there is no column "{name} [{units[name]}]", an input of {Path(fmu).name}.')
    return time, {name: values[name] for name in units}


def compare(
    path: str | os.PathLike[str],
    other: str | os.PathLike[str],
    motion: str | os.PathLike[str],
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[Array, dict[str, tuple[Array, Array]]]:
    """Run two FMUs, or an FMU and a recorded drive, through the same motion.

    Parameters
    ----------
    path
        An FMU.
    other
        Another FMU; or a recorded or simulated table (CSV), which is `motion` itself.
    motion
        The table of the inputs.

    Returns
    -------
    time, pairs
        Time, s; {common output: (values of `one`, values of `other`)}, SI.

    Raises
    ------
    edge.InputError
        If the two have different inputs or no output in common.
    """
    inputs, outputs = units_of(path, "input"), units_of(path, "output")
    if Path(other).suffix != ".fmu":
        time, given = read_inputs(motion, path)
        _, recorded = read_motion(other, outputs)
        shared = [n for n in outputs if n in recorded]
        if not shared:
            raise edge.InputError(f"{other}: it has no column of an output of {Path(path).name}, such as output_angle.")
        simulated = simulate(path, given, shared, time, progress=progress)
        return time, {n: (simulated[n], recorded[n]) for n in shared}
    others = units_of(other, "input")
    for name in (*inputs, *others):
        if name not in inputs or name not in others:
            has, lacks = (path, other) if name in inputs else (other, path)
            raise edge.InputError(f"{lacks}: it has no input {name}, which {has} has; interfaces must be equal.")
    theirs = units_of(other, "output")
    shared = [n for n in outputs if n in theirs]
    time, given = read_inputs(motion, path)
    simulated, second = (simulate(file, given, shared, time, progress=progress) for file in (path, other))
    return time, {n: (simulated[n], second[n]) for n in shared}
