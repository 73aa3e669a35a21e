"""Draws the pictures of README and site: `python docs/pictures.py`."""

from pathlib import Path

import numpy as np

import cycloid_fmu as cy

ROOT = Path(__file__).parents[1]
OUT = ROOT / "docs" / "_static"

made = cy.read_drive(ROOT / "examples" / "drive-39-40-as-made.toml")
cy.plot(made.motion("181 N*m", "30 deg"), OUT / "drive.svg")

drawn = cy.read_drive(ROOT / "examples" / "drive-39-40.toml")
cy.plot(drawn.analyze(np.array([-181.0, 181.0]))).savefig(OUT / "analyze.png", dpi=75)
