"""The involute first stage of an RV reducer, which turns the cranks of its cycloid stage."""

from __future__ import annotations

import dataclasses
import json
import math


@dataclasses.dataclass(frozen=True)
class FirstStage:
    """The involute stage that turns the cranks, and the plays around the cycloid stage.

    Attributes
    ----------
    sun_teeth, planet_teeth
        Numbers of teeth z_1 and z_2.
    sun_play
        Free rotation of the sun with the planets held, two-sided, rad.
    bearing_play
        Free rotation of the carrier relative to the cycloid discs, two-sided, rad; 0 if bearings are modelled.
    crank_stiffness
        Total torque on the cranks per radian of their rotation relative to sun and carrier, N·m/rad.
    """

    sun_teeth: int
    planet_teeth: int
    sun_play: float
    bearing_play: float
    crank_stiffness: float = math.inf

    @property
    def sun_share(self) -> float:
        """Crank turns per turn of the sun with the output locked, z_1/z_2, in the opposite direction."""
        return self.sun_teeth / self.planet_teeth

    @property
    def crank_play(self) -> float:
        """Free rotation of the cranks with sun and carrier held, two-sided, rad."""
        return self.sun_share * self.sun_play

    @property
    def crank_share(self) -> float:
        """Crank turns per turn of the output with the sun locked, 1 + z_1/z_2."""
        return 1.0 + self.sun_share

    def ratio(self, gear_teeth: int) -> float:
        """Return the whole reducer's ratio, 1 + z_2 z_p/z_1, > 0: sun and output turn in the same direction."""
        return 1.0 + (gear_teeth + 1) / self.sun_share

    @property
    def text(self) -> str:
        """The values as JSON, SI, without rigid parts."""
        return json.dumps({name: value for name, value in vars(self).items() if math.isfinite(value)})


def sun_locked_share(crank_share: float, gear_teeth: int) -> float:
    """Return the ratio of a play with the sun locked to that with the crank locked: 1/(1 + (1 + z_1/z_2)/z_c).

    The planets roll on the locked sun and turn the cranks by 1 + z_1/z_2 of the output's angle.
    """
    return 1.0 / (1.0 + crank_share / gear_teeth)
