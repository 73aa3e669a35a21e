"""An FMU's interface with values from files: losses, friction, and a measured torque-windup loop."""

from __future__ import annotations

import dataclasses
import os

from cycloid_fmu import edge
from cycloid_fmu.fmu.bench_losses import BenchLosses, is_of_bench, read_bench_losses
from cycloid_fmu.fmu.build import read_losses
from cycloid_fmu.fmu.chain import read_loop
from cycloid_fmu.fmu.friction_file import Friction, FrictionTables, read_friction
from cycloid_fmu.fmu.variables import Interface

_File = str | os.PathLike[str] | None


def read_interface(
    interface: Interface, ratio: float, *, losses: _File = None, friction: _File = None, loop: _File = None
) -> tuple[Interface, BenchLosses | None]:
    """Return an interface with the losses, friction and stiffness of files.

    Parameters
    ----------
    interface
        All other values.
    ratio
        Ratio of the drive, signed.
    losses
        A loss table as in Modelica's LossyGear, or losses measured on a bench, to which one is fitted (CSV).
    friction
        Friction of both flanges (`cycloid-friction/1`).
    loop
        Figures of a measured loop, from `cycloid-fit metrics -o`, for stiffness and dry friction.

    Returns
    -------
    interface, measured
        The interface; and the fit to measured losses, if they are.

    Raises
    ------
    edge.InputError
        If a file can't be read, or two of them state one value.
    """
    tables = FrictionTables() if friction is None else read_friction(friction)
    measured = None
    if losses is not None and is_of_bench(losses):
        measured = read_bench_losses(losses, ratio)
        interface = dataclasses.replace(interface, losses=measured.rows)
        tables = tables.replace(input=_warming(tables.input, measured, str(losses)))
    elif losses is not None:
        interface = dataclasses.replace(interface, losses=read_losses(losses))
    if loop is not None:
        stiffness, coulomb = read_loop(loop)
        interface = dataclasses.replace(interface, stiffness=stiffness)
        tables = tables.replace(output=with_measured(tables.output, coulomb, str(loop)))
    return dataclasses.replace(interface, input_friction=tables.input, output_friction=tables.output), measured


def with_measured(friction: Friction, coulomb: float, source: str) -> Friction:
    """Return the output's friction with the measured dry friction (N·m) of a source; refuse a second value."""
    if friction.coulomb > 0.0:
        raise edge.InputError(f"{source}: it states the dry friction; remove coulomb from [friction.output].")
    return friction.replace(coulomb=coulomb)


def _warming(friction: Friction, measured: BenchLosses, source: str) -> Friction:
    """Return the input's friction with the temperature coefficient of measured losses."""
    if measured.temperature_coefficient == 0.0:
        return friction
    if friction.temperature_coefficient != 0.0:
        raise edge.InputError(
            f"[friction.input] temperature_coefficient = {friction.temperature_coefficient:g} 1/K: {source} has one as "
            "well; remove one of them."
        )
    return friction.replace(
        temperature_coefficient=measured.temperature_coefficient, reference_temperature=measured.reference_temperature
    )
