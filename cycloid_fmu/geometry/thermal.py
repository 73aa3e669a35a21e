"""How a drive gives off the heat of its losses, as in a pair file's `[thermal]`."""

from __future__ import annotations

from typing import Annotated

import pydantic

from cycloid_fmu import edge
from cycloid_fmu.edge import Config
from cycloid_fmu.geometry.temperature import BodyTemperature

_ABOVE_ZERO = pydantic.Field(gt=0.0, allow_inf_nan=False)
_NOT_BELOW_ZERO = pydantic.Field(ge=0.0, allow_inf_nan=False)


class Thermal(Config):
    """How a drive gives off the heat of its losses, and what it stores.

    Attributes
    ----------
    resistance
        Thermal resistance from the housing to the surroundings, K/W.
    area
        Surface of the housing, m², with `convection` instead of the resistance.
    convection
        Heat transfer coefficient at this surface, with radiation, W/(m²·K).
    oil_resistance
        Thermal resistance from the oil, and the discs, carrier and crank in it, to the housing, K/W; 0: as warm as it.
    capacity
        Heat capacity of the drive with its oil, J/K; without it no time to warm up is known.
    ambient
        Temperature of the surroundings, and of the drive before it runs, K.
    largest
        Largest permissible temperature of the oil, K.

    Examples
    --------
    >>> from cycloid_fmu.geometry.thermal import Thermal
    >>> Thermal(area="0.1 m^2", convection="20 W/(m^2*K)", ambient="20 degC").to_ambient
    0.5
    """

    resistance: Annotated[edge.ThermalResistance, _ABOVE_ZERO] | None = None
    area: Annotated[edge.Area, _ABOVE_ZERO] | None = None
    convection: Annotated[edge.HeatTransfer, _ABOVE_ZERO] | None = None
    oil_resistance: Annotated[edge.ThermalResistance, _NOT_BELOW_ZERO] = 0.0
    capacity: Annotated[edge.HeatCapacity, _ABOVE_ZERO] | None = None
    ambient: BodyTemperature
    largest: BodyTemperature | None = None

    @pydantic.model_validator(mode="after")
    def _whole(self) -> Thermal:
        surface = (self.area, self.convection)
        if (self.resistance is None) == (surface == (None, None)) or (self.resistance is None and None in surface):
            raise ValueError("state resistance, or area and convection")
        if self.largest is not None and self.largest <= self.ambient:
            raise ValueError("largest must be above ambient: a drive that runs is warmer than its surroundings")
        return self

    @property
    def to_ambient(self) -> float:
        """Thermal resistance from the housing to the surroundings, K/W."""
        if self.resistance is not None:
            return self.resistance
        assert self.area is not None
        assert self.convection is not None
        return 1.0 / (self.area * self.convection)

    @property
    def whole(self) -> float:
        """Thermal resistance from the oil to the surroundings, K/W."""
        return self.to_ambient + self.oil_resistance

    def housing(self, oil: float) -> float:
        """Return the temperature of the housing, K, through which the heat flows, by that of the oil, K."""
        return self.ambient + (oil - self.ambient) * self.to_ambient / self.whole
