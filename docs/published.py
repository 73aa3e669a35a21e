"""Losses and a stiffness that were measured and published, against predictions: `python docs/published.py` writes both.

What is published is in `MEASURED`, each with its source. Predictions take both ends of every range in
`cycloid_fmu.geometry.friction_values.VALUES` and of the bearing factors below, and of sizes that are not published;
nothing is fitted. The tables stand in `docs/losses_published.md` and in
`docs/theory/bodies.md`, between two marks.
"""

import itertools
import math
import re
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import cycloid_fmu as cy
from cycloid_fmu.geometry.friction_values import VALUES
from cycloid_fmu.losses.figures import breakaway
from cycloid_fmu.losses.solver import solve
from cycloid_fmu.supports.transmission import PARTS

PAGE = Path(__file__).parent / "losses_published.md"
ROOT = PAGE.parents[1]
BODIES = ROOT / "docs" / "theory" / "bodies.md"
BEGIN, END = "<!-- table: python docs/published.py -->", "<!-- end of the table -->"
STIFFNESS = "<!-- table of stiffness: python docs/published.py -->"
ROLLING = {"low": 0.0003, "high": 0.002}
"""Load factors f_1 of rolling bearings: cylindrical with cage to needles (docs/theory/losses.md)."""
NEEDLES = {"low": 0.003, "high": 0.005}
"""Friction coefficients of needles at their pitch radius (docs/theory/losses.md)."""
ENDS = ("low", "high")


@dataclass(frozen=True)
class Row:
    """A measured figure and its prediction.

    Attributes
    ----------
    drive, figure : str
        The drive and the figure, in words.
    measured : tuple of float
        Lowest and highest published value.
    assumed : str
        What is assumed beyond what is published.
    predicted : tuple of float
        Lowest and highest predicted value.
    unit : str
        "%", "N·m" or "".
    """

    drive: str
    figure: str
    measured: tuple[float, float]
    assumed: str
    predicted: tuple[float, float]
    unit: str

    @property
    def agrees(self) -> bool:
        """Whether the two ranges overlap."""
        return self.predicted[0] <= self.measured[1] and self.measured[0] <= self.predicted[1]


def friction(name: str, end: str) -> dict[str, float]:
    """One end of a range of the table of friction coefficients, as a table of [losses] has it."""
    value, high = VALUES[name], end == "high"
    kinetic, static = (value.high, value.static_high) if high else (value.low, value.static_low)
    return {"friction_coefficient": kinetic, "static_friction_coefficient": static}


def _range(values: Iterator[float]) -> tuple[float, float]:
    every = np.array(list(values))
    return float(every.min()), float(every.max())


PRINTED = {
    "gear_teeth": 13,
    "pin_circle_radius": "34 mm",
    "pin_radius": "3.5 mm",
    "eccentricity": "1.5 mm",
    "face_width": "25 mm",
    "modification": {"isometric": "80 um", "offset": "-40 um"},
}
"""Sizes of the printed drive 13/14."""


def printed(end: str, turning: bool) -> cy.Drive:
    """The printed drive 13/14 of the measured runs; sizes of its output and all stiffnesses are assumed."""
    contact = friction("plastic, dry", end)
    losses: dict[str, Any] = {
        "flank": contact,
        "output_contact": contact,
        "output_roller": {"outer_radius": "3 mm"},
        "turning_arm": {"mean_diameter": "25 mm", "load_factor": ROLLING[end]},
        "main": {"mean_diameter": "50 mm", "load_factor": ROLLING[end]},
    }
    if turning:
        seat = friction("iglidur J, dry", end)
        losses["pin"] = {"radius": "2 mm", **seat}
        losses["output_roller"] |= {"radius": "2 mm", **seat}
    spring = {"stiffness": "20 N/um"}
    supports = {
        "kind": "output_rollers",
        "count": 6,
        "circle_radius": "18 mm",
        "turning_arm": spring,
        "crank_shaft": spring,
    }
    supports |= {"main": spring, "output_roller": {"stiffness": "8 N/um", "clearance": "50 um"}}
    material = {"youngs_modulus": "2.2 GPa", "poissons_ratio": 0.35}
    return cy.Drive(
        cy.Pair(
            **PRINTED,
            material={"gear": material, "pin": material},
            supports=supports,
            losses=losses,
        )
    )


UNKNOWN = {
    "output pins": ("printed, 6 mm, cantilevers", "steel, 6 mm, clamped in two plates"),
    "shaft": ("12 mm", "17 mm"),
    "plastic": ("1.5 GPa", "3.5 GPa"),
    "bearings": ("10 N/µm", "50 N/µm"),
    "output rollers": ("8 N/µm", "40 N/µm"),
    "ring's pins": ("printed", "steel"),
}
"""What is not published of the printed drive and decides its stiffness: its soft end, and its stiff end."""


def printed_bodies(stiff: Collection[str]) -> cy.Drive:
    """The printed drive 13/14 with elastic bodies; of `UNKNOWN`, `stiff` are at their stiff ends."""
    modulus = UNKNOWN["plastic"]["plastic" in stiff]
    plastic = {"youngs_modulus": modulus, "poissons_ratio": 0.35}
    steel = {"youngs_modulus": "206 GPa", "poissons_ratio": 0.3}
    spring = {"stiffness": UNKNOWN["bearings"]["bearings" in stiff]}
    shaft = {"from": "-18 mm", "to": "18 mm", "diameter": UNKNOWN["shaft"]["shaft" in stiff]}
    pins = ("clamped", steel) if "output pins" in stiff else ("cantilever", plastic)
    roller = {"stiffness": UNKNOWN["output rollers"]["output rollers" in stiff], "clearance": "50 um"}
    supports = {"kind": "output_rollers", "count": 6, "circle_radius": "18 mm", "output_roller": roller}
    return cy.Drive(
        cy.Pair(
            **PRINTED,
            rated_torque="15 N*m",
            material={"gear": plastic, "pin": steel if "ring's pins" in stiff else plastic},
            supports={**supports, "turning_arm": spring, "crank_shaft": spring, "main": spring},
            bodies={
                "disc": {"bore_radius": "10 mm", "roller_hole_radius": "4.5 mm"},
                "crank": {"bearings": ["-18 mm", "18 mm"], "sections": [shaft], **plastic},
                "output_pin": {"ends": pins[0], "from": "-14 mm", "to": "14 mm", "diameter": "6 mm", **pins[1]},
                "ring": {"outer_radius": "42 mm", "width": "25 mm", **plastic},
            },
        )
    )


def stiffness_of(drive: cy.Drive) -> tuple[float, dict[str, float]]:
    """Stiffness between 7.5 and 15 N·m over a crank turn, N·m/rad, and each part's share of the compliance there."""
    swept = drive.analyze(["7.5 N*m", "15 N*m"], angles=26)
    low, high = swept.transmission_error.values.mean(axis=1)
    shares = swept.compliance.values.mean(axis=(0, 1))
    return 7.5 / (high - low), dict(zip(PARTS, shares / shares.sum(), strict=True))


def _three(value: float) -> str:
    """Three digits."""
    return f"{float(f'{value:.3g}'):g}"


def stiffness_table() -> str:
    """The printed drive at its soft end, at its stiff end, and with one unknown at the other end."""
    lines = ["| what is not published | from | to | soft drive with it, N·m/rad | stiff drive without it, N·m/rad |"]
    lines.append("| --- | --- | --- | --- | --- |")
    for name, ends in UNKNOWN.items():
        alone = stiffness_of(printed_bodies({name}))[0]
        without = stiffness_of(printed_bodies(set(UNKNOWN) - {name}))[0]
        lines.append(f"| {name} | {ends[0]} | {ends[1]} | {_three(alone)} | {_three(without)} |")
    soft, stiff = (stiffness_of(printed_bodies(every))[0] for every in ((), UNKNOWN))
    return "\n".join([*lines, f"| none; all | – | – | {_three(soft)} | {_three(stiff)} |"])


def rv(end: str, mean_diameter: str = "22 mm") -> cy.Drive:
    """RV-20E-like: the example's sizes, which are published, with bearings that are assumed."""
    drive = cy.read_drive(ROOT / "examples" / "rv-20e-bearings.toml")
    steel = friction("steel, grease", end)
    arms = {"mean_diameter": mean_diameter, "load_factor": ROLLING[end]}
    losses = {
        "flank": steel,
        "pin": {"radius": "2 mm", "pressure": "cosine", **steel},
        "turning_arm": arms,
        "crank_shaft": {**arms, "mean_diameter": "20 mm"},
        "main": {"mean_diameter": "100 mm", "load_factor": ROLLING[end]},
        "first_stage": {"friction_coefficient": steel["friction_coefficient"]},
    }
    return drive.replace(losses=losses)


def assumed(teeth: int, eccentricity: float, pin_share: float, end: str, turning: bool) -> cy.Drive:
    """A steel drive of unknown sizes: K, the share of the ring that pins fill, and what they turn on, are assumed."""
    radius = 50e-3
    pin = pin_share * math.pi * radius / (teeth + 1)
    losses: dict[str, Any] = {
        "flank": friction("steel, grease", end),
        "output_contact": friction("steel, grease", end),
        "output_roller": {"outer_radius": 0.1 * radius},
        "turning_arm": {"mean_diameter": radius, "load_factor": ROLLING[end]},
    }
    if turning:
        needles = {"friction_coefficient": NEEDLES[end]}
        losses["pin"] = {"radius": 0.6 * pin, **needles}
        losses["output_roller"] |= {"radius": 0.06 * radius, **needles}
    spring = {"stiffness": "400 N/um"}
    supports = {"kind": "output_rollers", "count": 8, "circle_radius": 0.55 * radius, "turning_arm": spring}
    supports |= {"crank_shaft": spring, "main": spring, "output_roller": {"stiffness": "400 N/um"}}
    return cy.Drive(
        cy.Pair(
            gear_teeth=teeth,
            pin_circle_radius=radius,
            pin_radius=pin,
            eccentricity=eccentricity * radius / (teeth + 1),
            face_width="10 mm",
            modification={"isometric": "-15 um", "offset": "-40 um"},
            supports=supports,
            losses=losses,
        )
    )


def efficiency(drive: cy.Drive, torque: float, crank_speed: float, angles: int = 40) -> float:
    """Efficiency of the driving drive, %; 0 where it jams."""
    angle = np.linspace(0.0, 2.0 * np.pi, angles, endpoint=False)
    rubbed = solve(drive, np.array([torque]), angle, 1, crank_speed)
    given = float(rubbed.input_work[0])
    return 0.0 if math.isnan(given) or given <= 0.0 else 100.0 * torque / drive.pair.gear_teeth / given


def _assumed_range(teeth: int, turning: bool) -> tuple[float, float]:
    every = itertools.product((0.5, 0.8), (0.25, 0.45), ENDS)
    return _range(efficiency(assumed(teeth, k, share, end, turning), 50.0, 60.0) for k, share, end in every)


def rows() -> list[Row]:
    """All figures that can be predicted; it takes a minute."""
    predictions, pins = [], {False: "pins and output pins fixed", True: "on bushings (iglidur J, r 2 mm)"}
    for turning, said in pins.items():
        angle = np.linspace(0.0, 2.0 * np.pi, 60, endpoint=False)
        loops = [breakaway(printed(end, turning), 15.0, angle) for end in ENDS]
        name, sizes = "printed 13/14", f"{said}; eccentric on a ball bearing"
        predictions.append(
            Row(name, "friction per load, from rest", (0.3, 0.7), sizes, _range(b for _, b in loops), "")
        )
        if not turning:
            drags = "no drag, no interference"
            predictions.append(
                Row(name, "friction without load", (2.5, 2.5), drags, _range(a for a, _ in loops), "N·m")
            )
    speed = 39 * 15.0 * math.pi / 30.0
    predictions.append(
        Row(
            "RV-20E",
            "efficiency at 167 N·m, 15 rpm",
            (85.0, 85.0),
            "bearings; no seals",
            _range(efficiency(rv(end), 167.0, speed) for end in ENDS),
            "%",
        )
    )
    needles = {False: "all sizes; pins fixed", True: "all sizes; pins on needles"}
    for turning, said in needles.items():
        predictions.append(Row("C-QDD, 10:1", "efficiency", (82.3, 82.3), said, _assumed_range(10, turning), "%"))
    for turning, said in needles.items():
        predictions.append(
            Row("NASA rover, 59:1", "efficiency, at most", (81.0, 81.0), said, _assumed_range(59, turning), "%")
        )
    return predictions


def _shown(values: tuple[float, float], unit: str) -> str:
    texts = ["jams" if math.isinf(value) else f"{value:.3g}" for value in values]
    return f"{' to '.join(dict.fromkeys(texts))}{f' {unit}' if unit else ''}"


def table(predictions: list[Row]) -> str:
    """The table of the page."""
    lines = ["| drive | figure | measured | predicted | assumed | ranges |", "| --- | --- | --- | --- | --- | --- |"]
    for row in predictions:
        verdict = "overlap" if row.agrees else "**apart**"
        cells = (
            row.drive,
            row.figure,
            _shown(row.measured, row.unit),
            _shown(row.predicted, row.unit),
            row.assumed,
            verdict,
        )
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def written(text: str, predictions: list[Row]) -> str:
    """The page with its table."""
    return re.sub(f"{BEGIN}.*?{END}", lambda _: f"{BEGIN}\n{table(predictions)}\n{END}", text, flags=re.S)


def with_stiffness(text: str) -> str:
    """The theory page of elastic bodies with its table."""
    return re.sub(f"{STIFFNESS}.*?{END}", lambda _: f"{STIFFNESS}\n{stiffness_table()}\n{END}", text, flags=re.S)


if __name__ == "__main__":
    PAGE.write_text(written(PAGE.read_text(encoding="utf-8"), rows()), encoding="utf-8")
    BODIES.write_text(with_stiffness(BODIES.read_text(encoding="utf-8")), encoding="utf-8")
