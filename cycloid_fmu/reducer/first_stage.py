"""What stands around the cycloid stage of an RV reducer: the involute first stage and the crank bearings."""

from __future__ import annotations

import dataclasses


@dataclasses.dataclass(frozen=True)
class FirstStage:
    """Kinematics of the involute stage that turns the cranks, and the plays around the cycloid stage.

    Attributes
    ----------
    sun_teeth, planet_teeth
        z_1, z_2.
    sun_play
        Free rotation of the sun with the planets held, two-sided, rad.
    bearing_play
        Free rotation of the carrier against the cycloid gears, two-sided, rad.
    """

    sun_teeth: int
    planet_teeth: int
    sun_play: float
    bearing_play: float

    @property
    def sun_share(self) -> float:
        """Crank turn for each turn of the sun with the output locked, backwards: z_1/z_2."""
        return self.sun_teeth / self.planet_teeth

    @property
    def crank_share(self) -> float:
        """Crank turn for each turn of the output with the sun locked, 1 + z_1/z_2."""
        return 1.0 + self.sun_share


def sun_ratio(stage: FirstStage, gear_teeth: int) -> float:
    """Return the sun's angle over the output's of the ideal reducer."""
    return gear_teeth / (stage.sun_share * sun_locked_share(stage.crank_share, gear_teeth))


def sun_locked_share(crank_share: float, gear_teeth: int) -> float:
    """Return the share of a play with the crank locked that is left with the sun locked: 1/(1 + (1 + z_1/z_2)/z_c).

    The planets roll on the locked sun and turn the cranks by 1 + z_1/z_2 of the output.
    """
    return 1.0 / (1.0 + crank_share / gear_teeth)
