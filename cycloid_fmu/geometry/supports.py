"""Supports of discs and carrier: bearings, cranks or output rollers, as in a pair file's `[supports]`."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import pydantic

from cycloid_fmu import edge
from cycloid_fmu.edge import Angle, Config, Length
from cycloid_fmu.geometry import sizes
from cycloid_fmu.geometry.sizes import ABOVE_ZERO


def _clearance(value: float) -> float:
    if value < 0.0:
        raise ValueError("a clearance must not be below zero")
    return value


_SMALL_CLEARANCE = 2e-4  # m, allowed in any size; bearings of drives in catalogues have a tenth of it
_CLEARANCE_SHARE = 5e-3  # share of the circle's radius, allowed in large drives
BEARINGS = ("turning_arm", "crank_shaft", "main", "output_roller")
Clearance = Annotated[Length, pydantic.AfterValidator(_clearance)]
PositiveForce = Annotated[edge.Force, ABOVE_ZERO]
TorsionalStiffness = Annotated[edge.TorsionalStiffness, ABOVE_ZERO]
Stiffness = Annotated[edge.Stiffness, ABOVE_ZERO]
StiffnessPerWidth = Annotated[edge.Pressure, ABOVE_ZERO]


class Bearing(Config):
    """A bearing: rigid, a linear spring, or steel rollers.

    Attributes
    ----------
    stiffness
        Radial stiffness of a spring, N/m.
    rollers
        Number of rollers.
    roller_length
        Their effective length, m.
    rigid
        Whether it is rigid, as a bearing without stated stiffness.
    clearance
        Diametral clearance, m: contact begins at a radial displacement of half of it.
    dynamic_capacity
        Basic dynamic radial load rating C of ISO 281, N, for its life; None if not needed.
    raceway_diameter
        Diameter of the outer raceway, m: if given, the clearance depends on the temperatures of the adjacent bodies.
    rolling_elements
        "rollers" or "balls", for its life: C/P to the power 10/3 or 3 (ISO 281).

    Examples
    --------
    >>> from cycloid_fmu.geometry.supports import Bearing
    >>> Bearing(rollers=15, roller_length="9 mm", clearance="8 um").clearance
    8e-06
    """

    stiffness: Stiffness | None = None
    rollers: int | None = pydantic.Field(default=None, ge=3, le=500, strict=True)
    roller_length: sizes.Width | None = None
    rigid: bool = pydantic.Field(default=False, strict=True)
    clearance: Clearance = 0.0
    dynamic_capacity: PositiveForce | None = None
    raceway_diameter: sizes.CircleRadius | None = None
    rolling_elements: Literal["rollers", "balls"] = "rollers"

    @property
    def life_exponent(self) -> float:
        """Exponent of C/P in the basic rating life (ISO 281): 3 for balls, 10/3 for rollers."""
        return 3.0 if self.rolling_elements == "balls" else 10.0 / 3.0

    @property
    def is_rigid(self) -> bool:
        """Whether it is rigid."""
        return self.stiffness is None and self.rollers is None

    @pydantic.model_validator(mode="after")
    def _one_law(self) -> Bearing:
        if (self.rollers is None) != (self.roller_length is None):
            raise ValueError("rollers and roller_length belong together")
        stated = [n for n in ("stiffness", "rollers") if getattr(self, n) is not None] + ["rigid"] * self.rigid
        if len(stated) > 1:
            raise ValueError(f"it is stated by {' and '.join(stated)}; state one of stiffness, rollers, rigid = true")
        if self.rollers is not None and self.rolling_elements == "balls":
            raise ValueError('rolling_elements = "balls" contradicts rollers; state a ball bearing by its stiffness')
        if self.is_rigid and self.clearance > 0.0:
            raise ValueError("a clearance needs a stiffness or rollers; a rigid bearing has none")
        return self


class OutputRoller(Config):
    """Output rollers in the discs' holes, each a linear contact.

    Attributes
    ----------
    stiffness
        Stiffness of one roller in one disc's hole, N/m.
    rigid
        Whether it is rigid, as a roller without stated stiffness.
    clearance
        Twice the difference of the hole's radius and the sum of roller radius and eccentricity, m.
    radius
        Radius of a roller, m: if given, the clearance depends on the temperatures of discs and carrier.
    """

    stiffness: Stiffness | None = None
    rigid: bool = pydantic.Field(default=False, strict=True)
    clearance: Clearance = 0.0
    radius: sizes.PinRadius | None = None

    @pydantic.model_validator(mode="after")
    def _one_law(self) -> OutputRoller:
        if self.stiffness is not None and self.rigid:
            raise ValueError("it is stated by stiffness and rigid; state one of them")
        if self.stiffness is None and self.clearance > 0.0:
            raise ValueError("a clearance needs a stiffness; a rigid roller has none")
        return self


class PinSeat(Config):
    """The seat of each pin in the ring.

    Attributes
    ----------
    kind
        "half_shell": the pin lies in a half-shell of steel, whose deflection depends on the clearance and grows less
        than the force (docs/theory/bodies.md); None for a linear or rigid seat.
    stiffness_per_width
        Stiffness of a pin in its seat, N/m per m of face width; None if it is rigid.
    clearance
        Diametral clearance of a pin in its seat, m.
    """

    kind: Literal["half_shell"] | None = None
    stiffness_per_width: StiffnessPerWidth | None = None
    clearance: Clearance = 0.0

    @pydantic.model_validator(mode="after")
    def _one_law(self) -> PinSeat:
        if self.kind is not None and self.stiffness_per_width is not None:
            raise ValueError('it is stated by kind = "half_shell" and stiffness_per_width; state one of them')
        return self


class Supports(Config):
    """Supports of discs and carrier (docs/theory/supports.md); parts that are not stated are rigid.

    Attributes
    ----------
    kind
        "cranks": cranks in the carrier hold the discs and turn the carrier (RV reducers); "output_rollers": one
        eccentric holds the discs, and rollers on the carrier, in the discs' holes, take the load.
    count
        Number of cranks or output rollers.
    circle_radius
        Radius a of their circle, m.
    first_angle
        Angle ψ_0 of the first one from +x at crank angle 0, rad, counter-clockwise positive.
    turning_arm
        Each crank's bearing in each disc; with output rollers the eccentric's in each disc.
    crank_shaft
        Each crank's bearings in the carrier; with output rollers the central crank's in the housing.
    main
        The main bearing: the carrier's in the ring.
    output_roller
        The output rollers in the discs' holes; only for "output_rollers".
    pin_seat
        The seats of the pins in the ring.
    catalogue_stiffness
        Torsional stiffness at the output from a catalogue or a bench, N·m/rad. The compliance that the model lacks for
        it, because shafts, bodies and housing are rigid, is in series in verdicts, FMUs and compensators. Not part of
        an analysis.

    Examples
    --------
    >>> from cycloid_fmu.geometry.supports import Supports
    >>> supports = Supports(kind="cranks", count=3, circle_radius="36 mm", main={"stiffness": "1200 N/um"})
    >>> supports.main.stiffness
    1200000000.0
    """

    kind: Literal["cranks", "output_rollers"]
    count: int = pydantic.Field(ge=2, le=40, strict=True)
    circle_radius: sizes.CircleRadius
    first_angle: Angle = 0.0
    turning_arm: Bearing = Bearing()
    crank_shaft: Bearing = Bearing()
    main: Bearing = Bearing()
    output_roller: OutputRoller | None = None
    pin_seat: PinSeat = PinSeat()
    catalogue_stiffness: TorsionalStiffness | None = None

    @pydantic.model_validator(mode="after")
    def _one_kind(self) -> Supports:
        if self.kind == "cranks" and self.output_roller is not None:
            raise ValueError('output_roller belongs to kind = "output_rollers"; cranks have none')
        if self.kind == "output_rollers" and self.count < 3:
            raise ValueError(f"count = {self.count}: there must be at least 3 output rollers")
        if not math.isfinite(self.first_angle):
            raise ValueError("first_angle must be finite")
        for name in ("turning_arm", "crank_shaft", "main", "output_roller", "pin_seat"):
            stated = getattr(self, name)
            if stated is not None and stated.clearance > self.largest_clearance:
                given, most = (f"{value * 1e3:.6g} mm" for value in (stated.clearance, self.largest_clearance))
                raise ValueError(
                    f"[supports.{name}] clearance is {given}; it must be between 0 and {most} for this circle radius"
                )
        return self

    @property
    def largest_clearance(self) -> float:
        """Largest permitted diametral clearance, m: 0.2 mm, or a share of the radius of large drives."""
        return max(_SMALL_CLEARANCE, _CLEARANCE_SHARE * self.circle_radius)

    @property
    def cranks(self) -> int:
        """Number of crank shafts; 1 with output rollers."""
        return self.count if self.kind == "cranks" else 1

    def grown(self, bearing: str, growth: float) -> Supports:
        """Return the supports with the diametral clearance of a bearing larger by `growth`, m.

        Raises
        ------
        edge.InputError
            If there is no such bearing, it is rigid, or its clearance becomes too large.
        """
        stated = getattr(self, bearing, None) if bearing in BEARINGS else None
        if stated is None or stated.is_rigid:
            raise edge.ArgumentError(
                "bearing",
                f"[supports] must state it, with a stiffness or rollers; it may be {', '.join(BEARINGS)}",
                bearing,
            )
        return self.replace(**{bearing: stated.replace(clearance=stated.clearance + growth)})
