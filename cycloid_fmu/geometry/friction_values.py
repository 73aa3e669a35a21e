"""Friction coefficients to begin with: ranges with their sources, by the names that `friction` of `[losses]` takes."""

from __future__ import annotations

import math
from typing import NamedTuple


class FrictionValue(NamedTuple):
    """Range of a friction coefficient at speed and at rest (the same where the source has one only), and the source."""

    low: float
    high: float
    static_low: float
    static_high: float
    source: str

    @property
    def middle(self) -> tuple[float, float]:
        """Coefficients at speed and at rest to compute with: the geometric means, as no source weighs its range."""
        return math.sqrt(self.low * self.high), math.sqrt(self.static_low * self.static_high)


_GUIDE = "Lust, Engineering Guide CDA3000, table 7.21"
_GEARS = "Stagnoli, POM vs PA6 (dry on steel)"
VALUES = {
    "steel, grease": FrictionValue(0.04, 0.25, 0.12, 0.35, f"{_GUIDE}: steel on steel, greased"),
    "steel, dry": FrictionValue(0.08, 0.50, 0.12, 0.60, f"{_GUIDE}: steel on steel, dry"),
    "plastic, dry": FrictionValue(0.18, 0.35, 0.20, 0.45, f"{_GUIDE}: steel on plastic"),
    "PA6, dry": FrictionValue(0.30, 0.35, 0.38, 0.38, _GEARS),
    "POM, dry": FrictionValue(0.20, 0.22, 0.25, 0.25, _GEARS),
    "iglidur J, dry": FrictionValue(0.06, 0.18, 0.06, 0.18, "igus, material data of iglidur J against steel"),
    "PTFE-bronze bushing, dry": FrictionValue(0.02, 0.25, 0.02, 0.25, "GGB, data of DU bushings"),
    "PTFE-bronze bushing, oil": FrictionValue(0.02, 0.12, 0.02, 0.12, "GGB, data of DU bushings"),
}
"""Against steel. Typical of a class of materials, not of a part: the result states the range that follows."""
