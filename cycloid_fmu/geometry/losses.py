"""Friction, rolling resistance and drag of a drive, as in a pair file's `[losses]`; what is not stated has none."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Literal, Self

import numpy as np
import pydantic

from cycloid_fmu import edge
from cycloid_fmu.edge import Config
from cycloid_fmu.geometry.friction_values import VALUES
from cycloid_fmu.geometry.sizes import ABOVE_ZERO, PositiveLength

PARTS = (
    "flank",
    "pin_joint",
    "output_contact",
    "output_joint",
    "turning_arm",
    "crank_shaft",
    "main",
    "first_stage",
    "drag_input",
    "drag_output",
)
"""The parts that lose, in the order of all results."""
BEARINGS = ("turning_arm", "crank_shaft", "main")
_COEFFICIENTS = ("friction_coefficient", "static_friction_coefficient")
_OF_PLAIN = ("friction", *_COEFFICIENTS, "stribeck_speed")
_OF_ROLLING = ("load_factor", "speed_factor", "preload")


def _not_negative(value: float) -> float:
    if not value >= 0.0:
        raise ValueError("it must not be below zero")
    return value


LARGEST_COEFFICIENT = 2.0
Coefficient = Annotated[float, pydantic.Field(ge=0.0, le=LARGEST_COEFFICIENT)]
Factor = Annotated[float, pydantic.Field(ge=0.0, allow_inf_nan=False)]
PositiveSpeed = Annotated[edge.Velocity, ABOVE_ZERO]
Viscosity = Annotated[edge.KinematicViscosity, ABOVE_ZERO]
Kelvin = Annotated[edge.Temperature, ABOVE_ZERO]


class Friction(Config):
    """Friction of a sliding contact, μ(v) = μ + (μ_s - μ) exp(-(h/v_s)²), h = v ν/ν_40 (v without a lubricant).

    Attributes
    ----------
    friction
        Name of an entry of `VALUES`, such as "steel, grease", instead of both coefficients.
    friction_coefficient
        μ at speed.
    static_friction_coefficient
        μ_s at rest; default: μ.
    stribeck_speed
        v_s, m/s; without it the coefficient is μ at any speed above zero.
    """

    friction: str | None = None
    friction_coefficient: Coefficient = 0.0
    static_friction_coefficient: Coefficient | None = None
    stribeck_speed: PositiveSpeed | None = None

    @pydantic.model_validator(mode="before")
    @classmethod
    def _from_table(cls, given: Any) -> Any:
        if not isinstance(given, Mapping) or given.get("friction") is None:
            return given
        name = given["friction"]
        edge.check_named(name, VALUES, "friction")
        coefficients = dict(zip(_COEFFICIENTS, VALUES[name].middle, strict=True))
        for key, value in coefficients.items():
            if given.get(key) not in (None, value):
                raise ValueError(f"it is stated by friction and {key}; state one of them")
        return {**given, **coefficients}

    def at_end(self, high: bool) -> Self:
        """Return the friction at an end of its table's range; as it is where numbers are stated."""
        if self.friction is None:
            return self
        low_, high_, static_low, static_high, _ = VALUES[self.friction]
        ends = (high_, static_high) if high else (low_, static_low)
        return self.replace(friction=None, **dict(zip(_COEFFICIENTS, ends, strict=True)))

    @property
    def linear_in(self) -> tuple[str, ...]:
        """The coefficients that the friction is linear in."""
        return _COEFFICIENTS

    @property
    def static(self) -> float:
        """μ_s, the friction coefficient at rest."""
        stated = self.static_friction_coefficient
        return self.friction_coefficient if stated is None else stated


class Seat(Friction):
    """What a pin or sleeve turns in.

    Attributes
    ----------
    radius
        r_J, m: of a seat the pin's radius, of a sleeve its bore, of needles their pitch radius.
    pressure
        Distribution of the pressure around it, which gives the moment κ μ F r_J: a "line" (κ = 1) or over the half
        shell as the "cosine" (κ = 4/π).
    """

    radius: PositiveLength
    pressure: Literal["line", "cosine"] = "line"

    @property
    def pressure_factor(self) -> float:
        """κ, the moment of friction over μ F r_J."""
        return 4.0 / math.pi if self.pressure == "cosine" else 1.0


class OutputRoller(Seat):
    """Output rollers or pins, and what they turn in; without a radius they do not turn.

    Attributes
    ----------
    outer_radius
        r_w of a roller, or of a pin that does not turn, m.
    """

    outer_radius: PositiveLength | None = None
    radius: PositiveLength | None = None  # type: ignore[assignment]

    @pydantic.model_validator(mode="after")
    def _turns(self) -> OutputRoller:
        if self.outer_radius is None:
            raise ValueError("outer_radius is missing; the friction's lever arm depends on it")
        return self


class Bearing(Friction):
    """Friction of a bearing: rolling (with `mean_diameter`) or plain (with `radius`).

    Attributes
    ----------
    mean_diameter
        d_m of a rolling bearing, m.
    load_factor
        f_1 of M = f_1 (F + preload) d_m + 10⁻⁷ f_0 d_m³ max((ν n)^(2/3), 160) N·mm (Palmgren), 1.
    speed_factor
        f_0 of the same moment, 1.
    preload
        Load beside the radial force, N.
    radius
        r of a plain bearing, M = μ(v) F r, m.
    """

    mean_diameter: PositiveLength | None = None
    load_factor: Factor = 0.0
    speed_factor: Factor = 0.0
    preload: Annotated[edge.Force, pydantic.AfterValidator(_not_negative)] = 0.0
    radius: PositiveLength | None = None

    @pydantic.model_validator(mode="after")
    def _one_law(self) -> Bearing:
        stated = self.model_fields_set
        if (self.mean_diameter is None) == (self.radius is None):
            raise ValueError("state mean_diameter for a rolling bearing or radius for a plain one")
        strange = [n for n in (_OF_ROLLING if self.mean_diameter is None else _OF_PLAIN) if n in stated]
        if strange and any(getattr(self, n) for n in strange):
            kind = "plain (radius)" if self.mean_diameter is None else "rolling (mean_diameter)"
            raise ValueError(f"{strange[0]} does not belong to a {kind} bearing")
        return self

    @property
    def linear_in(self) -> tuple[str, ...]:
        """The coefficients that the friction is linear in."""
        return super().linear_in if self.mean_diameter is None else ("load_factor", "speed_factor")


class FirstStage(Config):
    """Friction in the mesh of the first stage.

    Attributes
    ----------
    friction_coefficient
        μ of the tooth flanks: the loss is μ H_v (Ohlendorf).
    loss
        ζ, lost share of the power, instead.
    """

    friction_coefficient: Coefficient = 0.0
    loss: float | None = pydantic.Field(default=None, ge=0.0, lt=1.0)

    @pydantic.model_validator(mode="after")
    def _one(self) -> FirstStage:
        if self.loss is not None and self.friction_coefficient > 0.0:
            raise ValueError("it is stated by loss and friction_coefficient; state one of them")
        return self

    def share(self, sun_teeth: int, planet_teeth: int) -> float:
        """Return ζ: stated, or μ H_v of unmodified gears with a pressure angle of 20 degrees.

        H_v = π (1/z_1 + 1/z_2)(1 - ε_1 - ε_2 + ε_1² + ε_2²), ε_i = z_i/2π (tan arccos(z_i cos α/(z_i + 2)) - tan α):
        Ohlendorf, Verlustleistung und Erwärmung von Stirnrädern (1958).
        """
        if self.loss is not None:
            return self.loss
        alpha = math.radians(20.0)
        z = np.array([sun_teeth, planet_teeth], dtype=float)
        e = z / (2.0 * np.pi) * (np.tan(np.arccos(z * math.cos(alpha) / (z + 2.0))) - math.tan(alpha))
        factor = math.pi * (1.0 / z).sum() * (1.0 - e.sum() + (e**2).sum())
        return float(self.friction_coefficient * factor)


class Drag(Config):
    """Drag of seals and bearings of a shaft that does not depend on the load.

    Attributes
    ----------
    coulomb
        Part that does not depend on the speed, N·m.
    viscous
        Part proportional to the speed, N·m·s/rad.
    churning
        Part proportional to the speed and to the lubricant's viscosity, at its viscosity at 40 °C, N·m·s/rad.
    """

    coulomb: Annotated[edge.Torque, pydantic.AfterValidator(_not_negative)] = 0.0
    viscous: Annotated[edge.RotationalDamping, pydantic.AfterValidator(_not_negative)] = 0.0
    churning: Annotated[edge.RotationalDamping, pydantic.AfterValidator(_not_negative)] = 0.0

    def torque(self, speed: float, thinning: float) -> float:
        """Return the drag at a speed (rad/s) and at ν/ν_40 of the lubricant, N·m."""
        return self.coulomb + (self.viscous + thinning * self.churning) * abs(speed)


class Lubricant(Config):
    """Oil, or the base oil of a grease.

    Attributes
    ----------
    viscosity_40
        Kinematic viscosity at 40 °C, m²/s.
    viscosity_100
        Kinematic viscosity at 100 °C, m²/s.
    temperature
        Of the lubricant, K.
    """

    viscosity_40: Viscosity
    viscosity_100: Viscosity
    temperature: Kelvin

    @pydantic.model_validator(mode="after")
    def _thins(self) -> Lubricant:
        if self.viscosity_100 >= self.viscosity_40:
            raise ValueError("viscosity_100 must be below viscosity_40: oils thin as they warm up")
        return self

    @property
    def viscosity(self) -> float:
        """ν at the temperature, m²/s: lg lg(ν + 0.7) = a - b lg T through both values, in mm²/s (ASTM D341)."""
        of = [math.log10(math.log10(1e6 * v + 0.7)) for v in (self.viscosity_40, self.viscosity_100)]
        low, high, now = (math.log10(t) for t in (313.15, 373.15, self.temperature))
        at = of[0] + (of[1] - of[0]) * (now - low) / (high - low)
        return 1e-6 * float(10.0 ** (10.0**at) - 0.7)


class Losses(Config):
    """What takes power in a drive on its bearings (docs/theory/losses.md); parts that are not stated have no friction.

    Attributes
    ----------
    flank
        Flanks of the discs on the pins, or on what turns about them.
    pin
        What pins or their sleeves turn in; None if they are fixed.
    output_contact
        Output rollers in the discs' holes.
    output_roller
        What output rollers turn in.
    turning_arm
        Each turning arm, or the eccentric bearing of each disc.
    crank_shaft
        The bearings of each crank.
    main
        The main bearing.
    first_stage
        Mesh of sun and planets.
    input_drag
        Drag of the input shaft, crank or sun.
    output_drag
        Drag of the carrier.
    lubricant
        Its viscosity, for rolling bearings and `stribeck_speed`.

    Examples
    --------
    >>> from cycloid_fmu.geometry.losses import Losses
    >>> Losses(flank={"friction_coefficient": 0.06}).flank.static
    0.06
    """

    flank: Friction = Friction()
    pin: Seat | None = None
    output_contact: Friction = Friction()
    output_roller: OutputRoller | None = None
    turning_arm: Bearing | None = None
    crank_shaft: Bearing | None = None
    main: Bearing | None = None
    first_stage: FirstStage | None = None
    input_drag: Drag = Drag()
    output_drag: Drag = Drag()
    lubricant: Lubricant | None = None

    @pydantic.model_validator(mode="after")
    def _whole(self) -> Losses:
        if self.output_contact != Friction() and self.output_roller is None:
            raise ValueError("[losses.output_contact] needs [losses.output_roller] outer_radius, which is missing")
        if self.lubricant is None and (self.input_drag.churning > 0.0 or self.output_drag.churning > 0.0):
            raise ValueError("[losses.lubricant] is missing: churning needs its viscosity")
        return self

    def at_end(self, high: bool) -> Losses:
        """Return the losses with all friction from the table at the same end of its range."""
        stated = {name: getattr(self, name) for name in type(self).model_fields}
        return Losses(**{n: v.at_end(high) if isinstance(v, Friction) else v for n, v in stated.items()})

    @property
    def from_table(self) -> dict[str, str]:
        """Tables whose friction is taken from `friction_values.VALUES`: {table: name}."""
        stated = {name: getattr(self, name) for name in type(self).model_fields}
        return {n: v.friction for n, v in stated.items() if isinstance(v, Friction) and v.friction is not None}

    @property
    def thinning(self) -> float:
        """ν/ν_40 of the lubricant; 1 without one."""
        return 1.0 if self.lubricant is None else self.lubricant.viscosity / self.lubricant.viscosity_40

    @property
    def without_viscosity(self) -> list[str]:
        """The bearings whose speed factor needs a lubricant that is not stated."""
        if self.lubricant is not None:
            return []
        bearings = {name: getattr(self, name) for name in BEARINGS}
        return [name for name, one in bearings.items() if one is not None and one.speed_factor > 0.0]
