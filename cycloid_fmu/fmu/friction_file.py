"""Input of friction for both flanges: the friction file `cycloid-friction/1`."""

from __future__ import annotations

import os
from typing import Annotated

import pydantic

from cycloid_fmu import edge
from cycloid_fmu.edge import Config
from cycloid_fmu.fmu.constants import COLDEST, HOTTEST, MOST_LOAD_SHARE, REFERENCE_TEMPERATURE
from cycloid_fmu.fmu.friction import NO_FRICTION, Law

FORMAT = "cycloid-friction/1"
# {number: (unit, smallest value, largest value, typical size)}
LIMITS: dict[str, tuple[str, float, float | None, float]] = {
    "coulomb": ("N.m", 0.0, None, 1.0),
    "load_share": ("1", 0.0, MOST_LOAD_SHARE, 0.1),
    "stribeck": ("N.m", 0.0, None, 1.0),
    "stribeck_speed": ("rad/s", 1e-6, None, 1.0),
    "viscous": ("N.m.s/rad", 0.0, None, 1e-3),
    "temperature_coefficient": ("1/K", -0.1, 0.1, 0.01),
    "reference_temperature": ("K", COLDEST, HOTTEST, 300.0),
    "presliding_angle": ("rad", 1e-9, 1.0, 1e-3),
}


def _limits(name: str) -> object:
    _, least, most, _ = LIMITS[name]
    return pydantic.Field(ge=least, le=most, allow_inf_nan=False)


class Friction(Config):
    """Friction at one flange.

    Attributes
    ----------
    coulomb
        Sliding friction torque without load, N·m.
    load_share
        Additional friction torque per N·m of the teeth's torque at that flange, dimensionless.
    stribeck
        Additional friction torque at rest, N·m; proportional to exp(-(w/`stribeck_speed`)²).
    stribeck_speed
        Speed of that flange, rad/s; None for 2 rad/s at flange_a, 0.05 rad/s at flange_b.
    viscous
        Viscous torque over speed, N·m·s/rad.
    temperature_coefficient, reference_temperature
        β (1/K) and T_ref (K): all friction torques, at flange_a the losses too, are multiplied by exp(-β(T - T_ref)).
        If β is not 0, an FMU has the input `temperature`.
    presliding_angle
        Angle of that flange over which friction builds up from rest, under the rated torque, rad; None for 2 mrad at
        flange_a, 20 µrad at flange_b.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> cy.Interface(output_friction=cy.Friction(coulomb="2 N*m", load_share=0.02)).output_friction.coulomb
    2.0
    """

    coulomb: Annotated[edge.Torque, _limits("coulomb")] = 0.0
    load_share: Annotated[float, _limits("load_share")] = 0.0
    stribeck: Annotated[edge.Torque, _limits("stribeck")] = 0.0
    stribeck_speed: Annotated[edge.Speed, _limits("stribeck_speed")] | None = None
    viscous: Annotated[edge.RotationalDamping, _limits("viscous")] = 0.0
    temperature_coefficient: Annotated[edge.TemperatureCoefficient, _limits("temperature_coefficient")] = 0.0
    reference_temperature: Annotated[edge.Temperature, _limits("reference_temperature")] = REFERENCE_TEMPERATURE
    presliding_angle: Annotated[edge.Angle, _limits("presliding_angle")] | None = None

    def law(self, flange: int) -> Law:
        """Return the law at `flange_a`, 0, or `flange_b`, 1."""
        given = (getattr(self, name) for name in Law._fields)
        return Law(*(b if a is None else a for a, b in zip(given, NO_FRICTION[flange], strict=True)))


class FrictionTables(Config):
    """The `[friction]` table: friction at both flanges.

    Attributes
    ----------
    input, output
        Friction at `flange_a`, the crank or a reducer's sun, and at `flange_b`, the output.
    """

    input: Friction = Friction()
    output: Friction = Friction()


class _FrictionFile(Config):
    """Friction at both flanges."""

    friction: FrictionTables


def read_friction(path: str | os.PathLike[str]) -> FrictionTables:
    r"""Return the friction at both flanges in a friction file; raise an `edge.InputError` that names invalid entries.

    Examples
    --------
    >>> from pathlib import Path
    >>> from cycloid_fmu.fmu.friction_file import read_friction
    >>> text = 'format = "cycloid-friction/1"\n[friction.output]\ncoulomb = "2 N*m"\n'
    >>> _ = Path("friction.toml").write_text(text)
    >>> read_friction("friction.toml").output.coulomb
    2.0
    """
    source = str(path)
    return edge.validated(_FrictionFile, edge.toml_table(edge.read_text(path, FORMAT), FORMAT, source), source).friction
