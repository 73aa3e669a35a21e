"""Draws the pictures of README and site: `python docs/pictures.py`."""

import contextlib
import shutil
import tempfile
from pathlib import Path

import numpy as np
from PIL import Image
from playwright.sync_api import sync_playwright

import cycloid_fmu as cy
from cycloid_fmu.desk.server import DeskServer

ROOT = Path(__file__).parents[1]
OUT = ROOT / "docs" / "_static"

made = cy.read_drive(ROOT / "examples" / "drive-39-40-as-made.toml")
cy.plot(made.motion("181 N*m", "30 deg"), OUT / "drive.svg")

drawn = cy.read_drive(ROOT / "examples" / "drive-39-40.toml")
cy.plot(drawn.analyze(np.array([-181.0, 181.0]))).savefig(OUT / "analyze.png", dpi=75)

with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder), sync_playwright() as playwright:
    for example, name in (("drive-39-40-bearings.toml", "drive.toml"), ("requirements.toml", "requirements.toml")):
        shutil.copy(ROOT / "examples" / example, name)
    browser = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
    with DeskServer("drive.toml", "requirements.toml") as server:
        page = browser.new_page(viewport={"width": 1340, "height": 1000})
        page.goto(server.url)
        page.wait_for_selector("#disc-0")
        page.locator("#crank_angle").fill("30 deg")
        page.wait_for_selector("#time:not(:empty)")
        page.screenshot(path="desk.png", full_page=True)
    Image.open("desk.png").quantize(96).save(OUT / "desk.png", optimize=True)
    browser.close()
