"""Draws the pictures of README and site: `python docs/pictures.py`."""

import contextlib
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

from PIL import Image
from playwright.sync_api import sync_playwright

import cycloid_fmu as cy
from cycloid_fmu.desk.server import DeskServer
from cycloid_fmu.draw.bodies import plot_disc
from cycloid_fmu.geometry.bodies import DiscBody

ROOT = Path(__file__).parents[1]
OUT = ROOT / "docs" / "_static"
BLOCK = re.compile(r"^```(?:{code-block} )?(?P<of>\w+)\n(?::caption: (?P<file>\S+)\n)?(?P<body>.*?)^```$", re.M | re.S)
# In this order: controller continues in the folder of test_bench_engineer.
WALKS = (
    "ageing",
    *(f"tutorials/{n}" for n in ("system_modeller", "gear_designer", "test_bench_engineer", "controller")),
)


def walks() -> None:
    """Run these pages as written, and keep the pictures that they show."""
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
    with tempfile.TemporaryDirectory() as folder:
        for name in WALKS:
            text = (ROOT / "docs" / f"{name}.md").read_text(encoding="utf-8")
            for block in BLOCK.finditer(text):
                if block["file"]:
                    Path(folder, block["file"]).write_text(block["body"], encoding="utf-8")
                elif block["of"] == "sh" and "pip install" not in block["body"]:
                    script = ["bash", "-c", block["body"]]  # a limit that is not met has its own exit status
                    subprocess.run(script, cwd=folder, env={**os.environ, "PATH": path}, check=False)
            for shown in re.findall(r"_static/tutorials/([\w.]+)\)", text):
                with Image.open(Path(folder, shown)) as picture:
                    picture.thumbnail((900, 900))
                    picture.convert("RGB").quantize(48).save(OUT / "tutorials" / shown, optimize=True)


def examples() -> None:
    """Run the examples of which pages show a picture."""
    with tempfile.TemporaryDirectory() as folder:
        for example, shown in (
            ("bench_to_fmu", "comparison.png"),
            ("compensated_joint", "compensated_joint.png"),
            ("two_link_arm", "two_link_arm.png"),
        ):
            subprocess.run([sys.executable, ROOT / "examples" / f"{example}.py"], cwd=folder, check=True)
            with Image.open(Path(folder, f"{example}_out", shown)) as picture:
                picture.convert("RGB").quantize(96).save(OUT / shown, optimize=True)


def pages() -> None:
    """Draw the pictures of home page, README and how-tos."""
    made = cy.read_drive(ROOT / "examples" / "drive-39-40-as-made.toml")
    cy.plot(made.motion("181 N*m", "30 deg"), OUT / "drive.svg")

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


def disc() -> None:
    """Draw an elastic disc for the page of its theory."""
    pair = cy.Pair(
        gear_teeth=39,
        pin_circle_radius="52 mm",
        pin_radius="2 mm",
        eccentricity="0.9 mm",
        face_width="10 mm",
        supports={"kind": "cranks", "count": 3, "circle_radius": "28.5 mm"},
    )
    fan = {"inner_radius": "18 mm", "outer_radius": "40 mm", "half_angle": "24 deg", "corner_radius": "3 mm"}
    windows = [{"shape": "fan", "count": 3, "first_angle": "60 deg", **fan}]
    body = DiscBody(bore_radius="12.5 mm", centre_radius="12 mm", windows=windows)
    with tempfile.TemporaryDirectory() as folder:
        plot_disc(pair, body, pin=5).savefig(Path(folder, "disc.png"), dpi=75)
        Image.open(Path(folder, "disc.png")).convert("RGB").quantize(96).save(OUT / "disc.png", optimize=True)


if __name__ == "__main__":
    disc()
    pages()
    examples()
    walks()
