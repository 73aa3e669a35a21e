"""Structure of the packages: who imports whom, what loads when, and the form of the changelog."""

import ast
import cmath
import importlib
import re
import shutil
import subprocess
import sys
import tomllib
from importlib import metadata
from pathlib import Path

import pytest
from importlinter.cli import lint_imports
from typer.main import get_command
from typer.testing import CliRunner

ROOT = Path(__file__).parents[2]
SETTINGS = tomllib.loads((ROOT / "pyproject.toml").read_text())
PACKAGES = ("cycloid_fmu", "fitting", "drivers")
HEAVY = {
    "numpy",
    "numba",
    "scipy",
    "xarray",
    "lmfit",
    "matplotlib",
    "pint",
    "pyarrow",
    "pandas",
    "can",
    "canopen",
    "fmpy",
}


def test_nobody_imports_what_they_must_not(monkeypatch):
    monkeypatch.chdir(ROOT)
    assert lint_imports(config_filename="pyproject.toml", no_cache=True, no_logo=True) == 0


def test_each_import_rule_can_be_broken(tmp_path):
    for name in PACKAGES:
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("__pycache__"))
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    for file, line in (
        ("cycloid_fmu/edge/files.py", "import fitting"),
        ("drivers/recorder/clock.py", "import cycloid_fmu.geometry.pair"),
        ("fitting/transmission_error/curve.py", "import drivers.recorder.clock"),
        ("cycloid_fmu/errors/kinds.py", "import cycloid_fmu.geometry.pair"),
        ("fitting/readers/recording.py", "import fitting.transmission_error.curve"),
        ("fitting/figures/metrics.py", "import cycloid_fmu.draw.plots"),
    ):
        with (tmp_path / file).open("a") as module:
            module.write(f"\n{line}\n")
    code = "import sys; sys.path.insert(0, ''); from importlinter.cli import lint_imports; lint_imports(no_cache=True)"
    run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=120)
    verdicts = re.findall(r"(KEPT|BROKEN)", run.stdout)
    assert verdicts == ["BROKEN"] * len(SETTINGS["tool"]["importlinter"]["contracts"]), run.stdout + run.stderr


def imported(tree):
    """Yield each module and name that a file imports, as one dotted name."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (name.name for name in node.names)
        elif isinstance(node, ast.ImportFrom) and not node.level:
            yield from (f"{node.module}.{name.name}" for name in node.names)


def test_private_names_of_numba_are_in_one_file():
    """numba.core, where numba keeps its own, and names with an underscore."""
    private = re.compile(r"numba\.(core|np|cpython|misc)\b|numba\.(.*\.)?_")
    paths = [path for package in PACKAGES for path in (ROOT / package).rglob("*.py")]
    users = {path for path in paths if any(map(private.match, imported(ast.parse(path.read_text("utf-8")))))}
    assert users == {ROOT / "cycloid_fmu" / "contact" / "internals.py"}


@pytest.mark.parametrize(
    ("modules", "allowed"),
    [
        ("cycloid_fmu, fitting, drivers, cycloid_fmu.cli, fitting.cli, drivers.cli", set()),
        ("cycloid_fmu.geometry.pair, cycloid_fmu.geometry.profile, fitting.readers.recording", {"numpy", "pyarrow"}),
        ("cycloid_fmu.contact.transmission", {"numpy", "numba", "scipy"}),  # numba looks whether SciPy is there
        ("drivers.recorder.session, drivers.recording_format.export, drivers.live_page.server", {"numpy", "pyarrow"}),
    ],
)
def test_what_is_slow_to_import_waits_until_it_is_needed(modules, allowed):
    code = f"import sys, {modules}; print(*{{name.partition('.')[0] for name in sys.modules}})"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=120)
    loaded = set(run.stdout.split())
    assert {name.strip().partition(".")[0] for name in modules.split(",")} <= loaded
    assert loaded & HEAVY <= allowed


def verbs(command, path):
    """Each command of an app that does something, with its words."""
    below = getattr(command, "commands", {})
    for name, one in below.items():
        yield from verbs(one, [*path, name])
    if not below:
        yield path, command


@pytest.mark.parametrize("name", ["cycloid-fmu", "cycloid-bench", "cycloid-fit"])
def test_each_help_page_has_an_example_and_shows_all_of_its_text(name):
    """Brackets are markup to rich: units in them vanish unless they are escaped."""
    (entry,) = metadata.entry_points(group="console_scripts", name=name)
    app = importlib.import_module(entry.module).app
    for path, command in verbs(get_command(app), []):
        shown = CliRunner().invoke(app, [*path, "--help"], prog_name=name, env={"COLUMNS": "300", "TERM": "dumb"})
        said = " ".join(re.sub("[│╭╰─╮╯]", "", shown.output).split())
        assert "Example: " in said, path
        assert " ".join([name, *path]) in said.partition("Example: ")[2], path
        for text in (command.help, *(getattr(option, "help", None) for option in command.params)):
            written = re.sub(r"\[(cyan|/)\]", "", " ".join((text or "").split()))
            assert written.replace(r"\[", "[") in said, path


def test_the_version_stands_in_one_place():
    version = SETTINGS["project"]["version"]
    assert metadata.version("cycloid-fmu") == version
    said = subprocess.run(["git", "grep", "-lF", f'"{version}"'], cwd=ROOT, capture_output=True, text=True)
    if said.returncode == 0:
        assert said.stdout.split() == ["pyproject.toml"]


def test_the_changelog_keeps_its_form():
    """Keep a changelog 1.1.0: known groups in order, each once; in them the users in order, no entry twice."""
    text = (ROOT / "CHANGELOG.md").read_text()
    versions = [block.splitlines() for block in re.split(r"^## ", text, flags=re.M)[1:]]
    assert versions[0][0] == "[Unreleased]"
    assert all(re.fullmatch(r"\[\d+\.\d+\.\d+\] - \d{4}-\d\d-\d\d", lines[0]) for lines in versions[1:])
    users = ["End to end", "From Python", "The system modeller", "The test-bench engineer", "The gear designer"]
    for lines in versions:
        found, entries = {}, []
        for line in lines[1:]:
            if line.startswith("### "):
                found[line[4:]] = []
            elif line.startswith("#### "):
                found[[*found][-1]].append(line[5:])
            elif line.startswith("- "):
                assert [*found.values()][-1], f"{line}: under no user"
                entries.append(line[2:])
            elif line:
                assert line.startswith("  "), line
                entries[-1] += line[1:]
        groups = ["Added", "Changed", "Deprecated", "Removed", "Fixed", "Security"]
        assert [*found] == [name for name in groups if name in found]
        assert all(each == [name for name in users if name in each] for each in found.values())
        assert len(set(entries)) == len(entries)


@pytest.mark.slow(10)
def test_benchmarks_can_be_collected():
    found = subprocess.run(
        [sys.executable, "-m", "pytest", "--collect-only", "-q", "benchmarks"], cwd=ROOT, capture_output=True, text=True
    )
    assert found.returncode == 0, found.stdout


def test_the_drawing_of_the_rooms_has_every_folder_and_the_stated_layers(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    import rooms

    drawn = (ROOT / "docs" / "_static" / "rooms.svg").read_text(encoding="utf-8")
    assert drawn == rooms.drawing(), "draw it again: python docs/rooms.py"
    names = set(re.findall(r'<rect id="([\w.]+)"', drawn))
    folders = {
        f"{p.parent.parent.name}.{p.parent.name}" for name in PACKAGES for p in (ROOT / name).glob("*/__init__.py")
    }
    modules = {f"cycloid_fmu.{p.stem}" for p in (ROOT / "cycloid_fmu").glob("*.py") if p.stem != "__init__"}
    assert names == folders | modules
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    ways = page.split("\n## ")[1:4]
    for steps, way in zip(rooms.WAYS.values(), ways, strict=True):
        assert tuple(re.findall(r"^\d\. `([\w.]+)`", way, re.MULTILINE)) == steps
        assert set(steps) <= names


def test_the_drawing_of_signs_shows_where_pins_and_teeth_are(monkeypatch):
    """Pin i at 2 pi i / z_p from +x, the middle of tooth j at (2 pi (j + 1/2) - theta) / z_c about the gear."""
    monkeypatch.syspath_prepend(ROOT / "docs")
    import signs

    drawn = (ROOT / "docs" / "_static" / "signs.svg").read_text(encoding="utf-8")
    assert drawn == signs.signs(), "draw it again: python docs/signs.py"
    numbers = re.findall(r'<text x="([\d.]+)" y="([\d.]+)" fill="(#\w+)"[^>]*>(\d+)</text>', drawn)
    pins, teeth = signs.PAIR.pins, signs.PAIR.gear_teeth
    centre = signs.at(signs.PAIR.eccentricity * cmath.exp(1j * signs.THETA))
    for colour, middle, count, first in (
        ("#111", signs.MIDDLE, pins, 0.0),
        (signs.BLUE, centre, teeth, (cmath.pi - signs.THETA) / teeth),
    ):
        places = {int(n): complex(float(x), float(y)) - middle for x, y, fill, n in numbers if fill == colour}
        assert sorted(places) == list(range(count))
        for number, place in places.items():
            turned = place.conjugate() * cmath.exp(-1j * (first + 2.0 * cmath.pi * number / count))
            assert abs(cmath.phase(turned)) < 0.01


def test_the_forge_s_workflows_run_what_every_machine_runs_with_pinned_actions():
    workflows = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
    text = "".join(path.read_text(encoding="utf-8") for path in workflows)
    assert ".ci/run" in text
    used = re.findall(r"uses: (\S+)(.*)", text)
    assert used
    assert all(re.fullmatch(r"[\w-]+/[\w-]+@[0-9a-f]{40}", name) and " # v" in note for name, note in used)
    assert "permissions:\n  contents: read" in text


def test_the_formatter_formats_all_of_it():
    said = subprocess.run(
        ["git", "grep", "-nE", "# fmt: ?(skip|off)", "--", "*.py"], cwd=ROOT, capture_output=True, text=True
    )
    assert said.stdout == ""


MOST_LINES, MOST_PARAMETERS, MOST_FLOATS = 60, 8, 3
MOST_OF_A_COMMAND = 45
"""Lines of a command below its options, which are its parameters: one call of the library, and printing."""
_KERNEL = "a kernel: numbers and arrays that numba passes in registers, and one loop that it compiles"
_TABLE = "a table of variables"
_OPTIONS = "options of one public call, by keyword, each documented"
_ESTIMATION = "estimation, which is to be divided anew"
LONG = {
    "cycloid_fmu.cli.analyze.analyze": "its studies of losses and limits are to be one call",
    "cycloid_fmu.contact.deviations.move_to_deviations": _KERNEL,
    "cycloid_fmu.contact.placement._solve_alone": _KERNEL,
    "cycloid_fmu.fmu.variables.exchanged": _TABLE,
    "cycloid_fmu.supports.balance.settling": "the two kernels of a balance, which it makes for given forces",
    "fitting.estimation.result.result_of": _ESTIMATION,
    "fitting.model.observations.observations": _ESTIMATION,
}
WIDE = {
    "cycloid_fmu.analysis.solver.solve": _OPTIONS,
    "cycloid_fmu.compensation.build.drive_compensator": "the options of `Drive.compensator`",
    "cycloid_fmu.contact.equilibrium._balance": _KERNEL,
    "cycloid_fmu.contact.hertz.hertz": _KERNEL,
    "cycloid_fmu.contact.placement._place_pin": _KERNEL,
    "cycloid_fmu.contact.side_by_side.sweep_drives": _KERNEL,
    "cycloid_fmu.contact.sweeps._solve_play": _KERNEL,
    "cycloid_fmu.contact.sweeps.sweep": _KERNEL,
    "cycloid_fmu.drive.compensator": _OPTIONS,
    "cycloid_fmu.drive.design": _OPTIONS,
    "cycloid_fmu.drive.joint": _OPTIONS,
    "cycloid_fmu.losses.displacements.sweep_motion_sensitivities": _KERNEL,
    "cycloid_fmu.losses.solver.solve": _OPTIONS,
    "cycloid_fmu.losses.sweeps.sweep_rubbing": _KERNEL,
    "cycloid_fmu.losses.sweeps.sweep_rubbing_sensitivities": _KERNEL,
    "cycloid_fmu.motion._contacts": "the arrays of the placed bodies, of which a motion consists",
    "cycloid_fmu.fmu.native.build_native": _OPTIONS,
    "cycloid_fmu.fmu.table_nodes.solved_at": "places of a grid, and how the model is solved at them",
    "cycloid_fmu.surfaces.surface.__init__": _OPTIONS,
    "fitting.ageing.forecast.forecast": _OPTIONS,
    "fitting.ageing.life.life_figures": _OPTIONS,
    "fitting.estimation.fit.fit": "the unknowns, where they start, and what is known of them",
    "fitting.estimation.identify.identify": _OPTIONS,
    "fitting.estimation.result.result_of": _ESTIMATION,
    "fitting.model.near_drive._sweep": _ESTIMATION,
}
NAMELESS = {
    "cycloid_fmu.contact.deviations._closest_on_piece": _KERNEL,
    "cycloid_fmu.contact.energy.press": _KERNEL,
    "cycloid_fmu.draw.drive_svg._svg": "the four numbers of an SVG's viewBox",
    "cycloid_fmu.fmu.tables.halved": "entries of a heap, in the order by which it compares",
}


def code_lines(text, begin, end):
    """Number of lines that are neither blank nor a comment."""
    return sum(bool(line.strip()) and not line.strip().startswith("#") for line in text[begin - 1 : end])


def functions():
    """Yield the name of each function with its packages, its node, and the lines of its file."""
    for path in (path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))):
        text = path.read_text(encoding="utf-8")
        module = ".".join(path.relative_to(ROOT).with_suffix("").parts)
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                yield f"{module}.{node.name}", node, text.splitlines()


def test_functions_are_short_and_narrow():
    """So are tuples of numbers, which have no names; what exceeds this has its reason above."""
    long, wide, nameless = set(), set(), set()
    for name, node, text in functions():
        body = (node.body[1:] if ast.get_docstring(node) else node.body) or node.body
        lines, given = code_lines(text, body[0].lineno, body[-1].end_lineno), node.args
        parameters = [p for p in (*given.posonlyargs, *given.args, *given.kwonlyargs) if p.arg not in ("self", "cls")]
        if ".cli." in name and not node.name.startswith("_"):
            long |= {name} if lines > MOST_OF_A_COMMAND else set()
        else:
            lines += code_lines(text, node.lineno, node.body[0].lineno - 1)
            long |= {name} if lines > MOST_LINES else set()
            wide |= {name} if len(parameters) > MOST_PARAMETERS else set()
        types = " ".join(ast.unparse(part) for part in (*parameters, node.returns) if part is not None)
        nameless |= {name} if "tuple[" + MOST_FLOATS * "float, " + "float" in types else set()
    assert long == set(LONG)
    assert wide == set(WIDE)
    assert nameless == set(NAMELESS)


VAGUE = {"beside", "found", "kept", "left", "made", "one", "place", "said", "told", "way"}


def stored_names(tree):
    """Yield each name that a file gives to a value, a parameter, a function or a class, as often as it does."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id
        elif isinstance(node, ast.arg):
            yield node.arg
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name


def test_names_that_mean_nothing_become_fewer():
    """They are counted, and none may be added; `vague_names.toml` takes the new number where there are fewer."""
    limits = tomllib.loads((Path(__file__).parent / "vague_names.toml").read_text(encoding="utf-8"))
    numbers = dict.fromkeys(PACKAGES, 0)
    for package in PACKAGES:
        for path in (ROOT / package).rglob("*.py"):
            names = stored_names(ast.parse(path.read_text(encoding="utf-8")))
            numbers[package] += sum(name in VAGUE for name in names)
    assert {name: number for name, number in numbers.items() if number > limits[name]} == {}, numbers


def test_a_stored_name_is_counted_wherever_it_is_given():
    tree = ast.parse(
        "one = 1\nfor left, right in []: pass\n[found for found in []]\ndef told(said, *, way=0): use(place)"
    )
    assert sorted(stored_names(tree)) == ["found", "left", "one", "right", "said", "told", "way"]
