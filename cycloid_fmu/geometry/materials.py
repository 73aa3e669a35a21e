"""Materials to begin with: ranges with their sources, by the names that `name` of `[material.gear]` and others take."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

from cycloid_fmu.edge import packaged_rows

CONTACT_YIELD = 1.67
"""Largest pressure of a line contact at first yield below the surface, over the yield strength in tension (Tresca;
K. L. Johnson, Contact Mechanics, 1985, eq. 4.49: p_0 = 3.3 k, k = Y/2)."""


class MaterialValue(NamedTuple):
    """Typical values of a class of materials, each as (lowest, highest), and their source.

    Attributes
    ----------
    youngs_modulus
        Young's modulus at 23 °C, Pa; in the plane of the layers if printed.
    poissons_ratio
        Poisson's ratio.
    yield_strength
        Yield strength in tension, Pa; of polymers the stress at yield in a short test, of case-hardened steel that of
        the core, of bearing steel √3 times the strength in shear.
    contact_pressure
        Largest pressure of a Hertzian line contact that the source permits, Pa; None: `CONTACT_YIELD` times the yield
        strength.
    bending_fatigue
        Amplitude of a bending stress that is borne for 1e7 load cycles or more, Pa; None where no source states one.
    expansion
        Coefficient of thermal expansion, 1/K.
    density
        kg/m³.
    service_temperature
        Highest temperature of lasting use under load, K.
    creeps
        Whether it creeps at room temperature: the modulus falls with time under load, and so do strength and stiffness.
    source
        Where the values are from.
    """

    youngs_modulus: tuple[float, float]
    poissons_ratio: float
    yield_strength: tuple[float, float]
    contact_pressure: tuple[float, float] | None
    bending_fatigue: tuple[float, float] | None
    expansion: tuple[float, float]
    density: tuple[float, float]
    service_temperature: float
    creeps: bool
    source: str

    @property
    def modulus(self) -> float:
        """Young's modulus to compute with, Pa: the geometric mean, as no source weighs its range, to three digits."""
        return float(f"{math.sqrt(self.youngs_modulus[0] * self.youngs_modulus[1]):.3g}")

    @property
    def largest_pressure(self) -> float:
        """Largest permitted pressure of a line contact, Pa: at the low end of its range."""
        if self.contact_pressure is not None:
            return self.contact_pressure[0]
        return CONTACT_YIELD * self.yield_strength[0]

    @property
    def basis_of_pressure(self) -> str:
        """What `largest_pressure` is, as text."""
        return "first yield of a line contact" if self.contact_pressure is None else self.source.split(";")[0]


def _read() -> dict[str, MaterialValue]:
    """Return the values of `materials.csv`: in SI, a range as its two ends, an empty cell for None."""
    materials = {}
    for row in packaged_rows("cycloid_fmu.geometry", "materials.csv"):
        name, source, creeps = row.pop("name"), row.pop("source"), row.pop("creeps") == "yes"
        numbers = {key: tuple(map(float, cell.split())) for key, cell in row.items() if cell}
        values: dict[str, Any] = {**dict.fromkeys(row), **{k: n if len(n) == 2 else n[0] for k, n in numbers.items()}}
        materials[name] = MaterialValue(**values, creeps=creeps, source=source)
    return materials


MATERIALS = _read()
"""Typical of a class of materials, not of a part: what is made of them states the range."""
