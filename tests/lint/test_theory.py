"""The theory pages: named objects exist, functions with a source are named, tables are those of the code."""

import ast
import functools
import importlib
import inspect
import pkgutil
import re
import types
from pathlib import Path

import pytest
from common import make_pair, resolved

from cycloid_fmu.errors.kinds import KINDS, remove_error_kind
from cycloid_fmu.surfaces.surface import nominal_surface, surface_of_pair
from fitting.figures.figure import DEFINITIONS
from tests.cycloid_fmu.test_first_order import gaps

ROOT = Path(__file__).parents[2]
PAGES = {page.stem: page.read_text(encoding="utf-8") for page in sorted((ROOT / "docs" / "theory").glob("*.md"))}
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
    for path, name in re.findall(r"`((?:tests|studies)/[\w/]+\.py)(?:::(test_\w+))?`", text):
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
