"""Materials to begin with: ranges with their sources, by the names that `name` of `[material.gear]` and others take."""

from __future__ import annotations

import math
from typing import NamedTuple

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


MATERIALS = {
    "bearing steel": MaterialValue(
        (205e9, 212e9),
        0.3,
        (1.55e9, 1.55e9),
        (4.0e9, 4.0e9),
        (610e6, 710e6),
        (10.5e-6, 12.5e-6),
        (7780.0, 7850.0),
        393.15,
        False,
        "static load limit of ISO 76; yield: 896 MPa in shear of hardened dowel pins (ASME B18.8.2); fatigue: "
        "Murakami's formula, 700 HV, inclusions of 20 to 50 µm at the surface; expansion of ISO 3650; 120 °C: rings of "
        "catalogue bearings",
    ),
    "case-hardened steel": MaterialValue(
        (205e9, 212e9),
        0.3,
        (590e6, 635e6),
        (1.30e9, 1.65e9),
        (155e6, 260e6),
        (10.5e-6, 12.5e-6),
        (7780.0, 7850.0),
        423.15,
        False,
        "endurance limits ML to ME of ISO 6336-5; bending halved from pulsating to an amplitude; yield: core of "
        "16MnCr5, DIN 17210, 11 to 30 mm",
    ),
    "quenched steel": MaterialValue(
        (205e9, 212e9),
        0.3,
        (650e6, 900e6),
        None,
        (450e6, 550e6),
        (10.5e-6, 12.5e-6),
        (7780.0, 7850.0),
        423.15,
        False,
        "42CrMo4+QT, EN ISO 683-2, up to 100 mm; fatigue: half of the tensile strength (DIN 743-3)",
    ),
    "7075-T6": MaterialValue(
        (71e9, 72e9),
        0.33,
        (435e6, 503e6),
        None,
        (150e6, 159e6),
        (23.4e-6, 23.6e-6),
        (2800.0, 2810.0),
        373.15,
        False,
        "typical values of the Aluminum Association, T73 to T6; fatigue at 5e8 cycles",
    ),
    "bronze": MaterialValue(
        (90e9, 110e9),
        0.34,
        (140e6, 150e6),
        None,
        None,
        (18e-6, 19e-6),
        (8600.0, 8800.0),
        473.15,
        False,
        "CuSn12-C, EN 1982",
    ),
    "POM": MaterialValue(
        (2.7e9, 2.9e9),
        0.37,
        (55e6, 67e6),
        None,
        (22e6, 34e6),
        (1.1e-4, 1.2e-4),
        (1390.0, 1420.0),
        373.15,
        True,
        "data sheets of POM-C, ISO 527 and ISO 11359; fatigue at 1e7 cycles, CES EduPack",
    ),
    "sintered PA12": MaterialValue(
        (1.5e9, 1.7e9),
        0.4,
        (42e6, 48e6),
        None,
        None,
        (1.0e-4, 1.2e-4),
        (930.0, 1000.0),
        353.15,
        True,
        "data sheets of laser-sintered PA12, ISO 527",
    ),
    "printed PLA": MaterialValue(
        (2.5e9, 4.0e9),
        0.36,
        (45e6, 65e6),
        None,
        None,
        (6.8e-5, 1.02e-4),
        (1220.0, 1270.0),
        323.15,
        True,
        "data sheets of printed specimens, ASTM D638 and ISO 527; 50 °C: deflection at 0.45 MPa",
    ),
    "printed PETG": MaterialValue(
        (1.5e9, 3.0e9),
        0.4,
        (38e6, 50e6),
        None,
        None,
        (5.9e-5, 8.0e-5),
        (1250.0, 1290.0),
        338.15,
        True,
        "data sheets of printed specimens, ISO 527; 65 °C: deflection at 0.45 MPa",
    ),
    "printed Onyx": MaterialValue(
        (1.4e9, 2.4e9),
        0.4,
        (29e6, 40e6),
        None,
        None,
        (2.2e-5, 2.48e-4),
        (1180.0, 1220.0),
        373.15,
        True,
        "data sheets of its maker, ASTM D638; expansion in and across the layers, Polymers 13 (2021) 3637",
    ),
    "printed tough resin": MaterialValue(
        (1.6e9, 2.3e9),
        0.4,
        (40e6, 46e6),
        None,
        None,
        (9e-5, 1.2e-4),
        (1100.0, 1200.0),
        323.15,
        True,
        "data sheets of tough resins for stereolithography, ASTM D638, cured",
    ),
}
"""Typical of a class of materials, not of a part: what is made of them states the range."""
