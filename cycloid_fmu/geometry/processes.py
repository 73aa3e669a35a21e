"""Manufacturing processes to begin with: the tolerances that they hold, by their names."""

from __future__ import annotations

import math
from typing import NamedTuple

_IT = {5: 7.0, 6: 10.0, 7: 16.0, 8: 25.0, 9: 40.0, 10: 64.0, 11: 100.0, 12: 160.0, 13: 250.0}
"""Standard tolerance over the tolerance factor i, by grade (ISO 286-1)."""


def standard_tolerance(grade: int, size: float) -> float:
    """Return the standard tolerance of a size (m), the width of its zone, m: ISO 286-1, 5 to 13.

    i = 0.45 D^(1/3) + 0.001 D in µm with D in mm; taken at the size itself and not at the mean of a range of sizes.

    Examples
    --------
    >>> round(standard_tolerance(7, 0.065) * 1e6)  # 30 µm for 50 to 80 mm
    30
    """
    size *= 1e3
    return 1e-6 * _IT[grade] * (0.45 * math.cbrt(size) + 0.001 * size)


class Process(NamedTuple):
    """A manufacturing process.

    Attributes
    ----------
    grade
        Standard tolerance grade (ISO 286-1) that it holds on sizes and positions of one clamping or one print.
    wall
        Least wall and web, m.
    source
        Where the values are from.
    """

    grade: int
    wall: float
    source: str

    def position(self, size: float) -> float:
        """Return the tolerance ± of a place on a part of this size, m."""
        return 0.5 * standard_tolerance(self.grade, size)


PROCESSES = {
    "grinding": Process(5, 2e-3, "IT5 to IT7 in handbooks"),
    "wire EDM": Process(6, 1.5e-3, "± 5 µm of handbooks is IT5 to IT6 of 50 mm"),
    "CNC": Process(7, 1.5e-3, "IT7 to IT8: precision milling"),
    "SLA": Process(10, 1.5e-3, "± 0.05 to 0.1 mm of service bureaus is IT10 to IT11 of 60 mm"),
    "SLS": Process(11, 1.5e-3, "± 0.2 mm of service bureaus is IT12 to IT13 of 60 mm; scale and holes calibrated"),
    "FDM": Process(11, 2e-3, "± 0.2 mm of service bureaus is IT12 to IT13 of 60 mm; scale and holes calibrated"),
}
"""Typical of a process, not of a machine. Printers are taken as calibrated for scale and holes: a grade or two better
than what service bureaus promise of any part."""
