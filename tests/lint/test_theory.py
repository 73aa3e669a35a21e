"""The theory pages: named objects exist, functions with a source are named, and the first-order tables are right."""

import ast
import functools
import importlib
import inspect
import pkgutil
import re
import types
from pathlib import Path

import numpy as np
import pytest
from common import PAIR, make_pair, resolved

from cycloid_fmu import contact
from cycloid_fmu.analysis import solve
from cycloid_fmu.contact.transmission import rigid_problem
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.errors.kinds import KINDS, remove_error_kind
from cycloid_fmu.surfaces.structured import with_structured
from cycloid_fmu.surfaces.surface import nominal_surface, surface_of_pair
from fitting.figures.figure import DEFINITIONS

ROOT = Path(__file__).parent.parent
PAGES = {page.stem: page.read_text(encoding="utf-8") for page in sorted((ROOT / "docs" / "theory").glob("*.md"))}
MODIFIED = PAIR + '[modification]\noffset = "-70 um"\nisometric = "-25 um"\n'
SOURCED = ("contact", "wear", "reducer", "supports")
A_SOURCE = re.compile(r"paper|equations? \d|loaded-contact-wear|GB/T|Nabtesco|ISO \d|Modelica|\b(?:19|20)\d\d\b")


def names_in(text):
    """Whatever of the packages a page names in backticks, with its module."""
    return set(re.findall(r"`~?((?:cycloid_fmu|fitting|drivers)(?:\.\w+)+)`", text))


@pytest.mark.parametrize("page", PAGES)
def test_what_a_page_names_exists(page):
    names = names_in(PAGES[page])
    assert names or page == "papers"
    for name in names:
        resolved(name)


@functools.cache
def declared_in(path):
    """Names of the tests of a file, without importing it."""
    tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
    return {node.name for node in tree.body if isinstance(node, ast.FunctionDef) and node.name.startswith("test_")}


def test_tests_and_examples_that_pages_name_exist():
    text = "\n".join(PAGES.values())
    for path, name in re.findall(r"`(tests/[\w/]+\.py)(?:::(test_\w+))?`", text):
        assert not name or name in declared_in(path), name
    everywhere = set().union(*(declared_in(p.relative_to(ROOT)) for p in (ROOT / "tests").rglob("test_*.py")))
    assert set(re.findall(r"`(test_\w+)`", text)) <= everywhere
    for path in re.findall(r"`(examples/[\w.-]+)`", text):
        assert (ROOT / path).exists()


def public_functions(room):
    """Functions that the modules of a room define."""
    package = importlib.import_module(f"cycloid_fmu.{room}")
    for found in pkgutil.iter_modules(package.__path__, f"{package.__name__}."):
        module = importlib.import_module(found.name)
        for name, value in vars(module).items():
            if isinstance(value, types.FunctionType) and value.__module__ == found.name and name[0] != "_":
                yield value


@pytest.mark.parametrize("room", SOURCED)
def test_every_function_with_a_source_is_on_a_page(room):
    named = {id(resolved(name)) for name in set().union(*(names_in(text) for text in PAGES.values()))}
    sourced = [f for f in public_functions(room) if A_SOURCE.search(inspect.getdoc(f) or "")]
    assert sourced
    assert not [f"{f.__module__}.{f.__name__}" for f in sourced if id(f) not in named]


def test_the_table_of_error_kinds_is_that_of_their_definitions():
    table = PAGES["errors"].split("(theory-kinds)=")[1].split("(theory-first-order)=")[0]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in table.splitlines() if line[:3] == "| `"]
    assert rows == [
        [
            f"`{k.name}`",
            k.of,
            ", ".join(f"`{d}`" for d in k.displaces),
            k.breaks or "–",
            f"`{k.tolerance.key}`" if k.tolerance else "–",
        ]
        for k in KINDS.values()
    ]


def test_a_kind_is_added_as_the_page_does():
    code = PAGES["errors"].split("```python\n")[1].split("```")[0]
    try:
        exec(code, {})
        surface = surface_of_pair(make_pair().replace(errors={"three_lobes": "2 um"}))
        assert surface.three_lobes == 2e-6
        assert gaps(surface) != pytest.approx(gaps(nominal_surface(make_pair())), abs=1e-7)
    finally:
        remove_error_kind("three_lobes")


def test_every_figure_of_the_bench_is_defined():
    assert {name for name in DEFINITIONS if f"`{name}`" not in PAGES["measurement"]} == set()


def test_pages_that_the_code_names_exist():
    for source in (p for package in ("cycloid_fmu", "fitting", "drivers") for p in (ROOT / package).rglob("*.py")):
        for page in re.findall(r"docs/theory/(\w+)\.md", source.read_text(encoding="utf-8")):
            assert page in PAGES, source


def ideal(phase):
    """K, S and L of the ideal pair, gear out."""
    k = 1.3 * 40 / 64
    stretch = np.sqrt(1.0 + k * k - 2.0 * k * np.cos(phase))
    return k, stretch, 1.3e-3 * 39 * np.sin(phase) / stretch


def gaps(surface):
    drive = rigid_problem(DriveValue(make_pair(), surface))
    rows = contact.contact_rows(drive)
    contact.place(drive, 0.3, 0.0, rows, True, np.inf, np.inf)
    return rows["gap"][::2]


def test_first_order_effects_on_the_gap():
    """The table of errors.md against differences of the exact gaps, at crank angle 0.3 rad, away from the roots."""
    direction = 2.0 * np.pi * np.arange(40) / 40
    phase = direction - 0.3
    k, s, arm = ideal(phase)
    tooth = np.floor(((direction + 0.3 / 39) % (2.0 * np.pi)) * 39 / (2.0 * np.pi))
    normal = np.exp(0.3j) * (np.cos(phase) - k + 1j * np.sin(phase)) / s
    wanted = {
        "pin_radial_1_cos": (1.0 - k * np.cos(phase)) / s * np.cos(direction),
        "pin_tangential_2_sin": k * np.sin(phase) / s * np.sin(2.0 * direction),
        "pin_radius": -np.ones(40),
        "pin_circle_radius": (1.0 - k * np.cos(phase)) / s,
        "isometric": np.ones(40),
        "offset": -(1.0 - k * np.cos(phase)) / s,
        "eccentricity": (k - np.cos(phase)) / s,
        "centre_distance_x": -normal.real,
        "centre_distance_y": -normal.imag,
        "tooth_cumulative_pitch_1_cos": -arm / 64e-3 * np.cos(2.0 * np.pi * tooth / 39),
    }
    assert -normal.real == pytest.approx(-(np.cos(phase + 0.3) - k * np.cos(0.3)) / s)
    blank, step = nominal_surface(make_pair()), 1e-9
    away = np.abs((phase + np.pi) % (2.0 * np.pi) - np.pi) > 0.3
    for name, effect in wanted.items():
        ends = [gaps(with_structured(blank, {name: v})) for v in (-step, step)]
        found = (ends[1] - ends[0]) / (2.0 * step)
        assert found[away] == pytest.approx(effect[away], abs=1e-4), name


@pytest.mark.parametrize(
    ("name", "order"), [("pin_radial_1_cos", 39), ("tooth_cumulative_pitch_1_cos", 40), ("centre_distance_x", 40)]
)
def test_orders_with_the_ring_as_output(name, order):
    """The gear held: pins at multiples of z_c of an output turn, teeth and fixed errors at multiples of z_p."""
    pair = make_pair(MODIFIED, output="ring")
    surface = with_structured(nominal_surface(pair), {name: 1e-6})
    angles = np.linspace(0.0, 2.0 * np.pi * 40, 40 * 80, endpoint=False)
    error = solve(DriveValue(pair, surface), 100.0, angles, with_play=False).transmission_error[0]
    assert int(np.argmax(np.abs(np.fft.rfft(error))[1:])) + 1 == order


@pytest.mark.parametrize(("law", "dip"), [("capped", 0.17), ("as_printed", 0.27)])
def test_load_dips_at_the_inflection(law, dip):
    """Error-surface paper, figure 7d: one pin near the largest load carries less than both its neighbours."""
    pair = make_pair(contact_law=law)
    angles = np.linspace(0.0, 2.0 * np.pi, 720, endpoint=False)
    force = solve(DriveValue(pair, nominal_surface(pair)), -181.0, angles, with_play=False).pin_force[0, :, 0]
    beside = np.minimum(np.roll(force, 1, axis=1), np.roll(force, -1, axis=1))
    share = np.where(beside > 0.5 * force.max(), 1.0 - force / np.maximum(beside, 1e-9), 0.0)
    assert share.max() == pytest.approx(dip, abs=0.01)
    # It is the pin whose contact is next to where the flank's curvature changes its sign.
    angle, pin = np.unravel_index(share.argmax(), share.shape)
    k = 1.3 * 40 / 64
    inflection = np.arccos((1.0 + 40 * k * k) / (k * 41))
    phase = (2.0 * np.pi * pin / 40 - angles[angle] + np.pi) % (2.0 * np.pi) - np.pi
    assert abs(phase) == pytest.approx(inflection, abs=0.05)
