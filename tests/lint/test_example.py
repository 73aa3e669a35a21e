"""The main job, as the README's first command runs it."""

import ast
import importlib
import json
import re
import runpy
import shutil

import pytest
from common import EXAMPLES

NUMBER = re.compile(r"\d+(?:\.\d+)?(?:e-?\d+)?")


def assert_page_agrees(section, rows, said):
    """Each figure of ours in the third column of these rows of the papers' page is one that the example printed."""
    text = (EXAMPLES.parent / "docs" / "theory" / "papers.md").read_text(encoding="utf-8")
    table = [line.split("|") for line in text.split(f"({section})=")[1].split("\n(theory-")[0].splitlines()]
    figures = [n for cells in table if len(cells) > 3 and rows in "|".join(cells) for n in NUMBER.findall(cells[3])]
    assert figures
    printed = [float(n) for n in NUMBER.findall(said)]
    for figure in figures:
        digits = len(figure.partition(".")[2])
        assert any(round(n, digits) == float(figure) for n in printed), figure


def cells_of(printed):
    """The cells of all tables in the output of an example, row by row."""
    return [[c.strip() for c in line.split("│")] for line in printed.splitlines() if "│" in line]


@pytest.fixture
def example(tmp_path, monkeypatch, capsys):
    """Run an example in an empty folder and in this process; return its output."""
    import matplotlib.pyplot

    def run(name):
        monkeypatch.chdir(tmp_path)
        monkeypatch.setenv("COLUMNS", "200")
        runpy.run_path(str(EXAMPLES / name), run_name="__main__")
        matplotlib.pyplot.close("all")
        return capsys.readouterr().out

    return run


def test_from_the_bench_to_the_fmu_and_back(tmp_path, example):
    said = example("bench_to_fmu.py")
    out = tmp_path / "bench_to_fmu_out"
    fit = json.loads((out / "identification.json").read_text())
    truth = {"centre_distance_x": 4e-6, "centre_distance_y": -3e-6, "eccentricity": 2e-6, "pin_radius": -1e-6}
    for name, value in truth.items():
        found = fit["parameters"][name]
        low, high = found["interval"]
        assert low <= value <= high or abs(found["value"] - value) < 0.3e-6, name
    assert {n for n, p in fit["parameters"].items() if p["held"]} >= {"isometric", "offset", "misalignment_xz"}
    left = re.search(r"differ by ([\d.]+)″ rms", said)
    assert left is not None
    assert float(left[1]) < 0.6  # the encoder's noise is 0.5″
    assert (out / "comparison.png").stat().st_size > 50000
    assert len(list(out.glob("*.arrows"))) == 4
    shutil.rmtree(out)


DOORS = ("cycloid_fmu", "fitting", "drivers")
EVERY = sorted(file.stem for file in EXAMPLES.glob("*.py"))
BY_THE_DOOR = {
    "arrays_to_errors",
    "bench_to_fmu",
    "error_study",
    "joint_package",
    "record_can",
    "record_serial",
    "robot_joint",
    "use_from_python",
}


def taken(name):
    """The names of the product that an example uses, dotted: imports, and attributes of a front door."""
    tree = ast.parse((EXAMPLES / f"{name}.py").read_text(encoding="utf-8"))
    found, doors = set(), {}
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            doors |= {one.asname or one.name: one.name for one in node.names if one.name in DOORS}
            found |= {one.name for one in node.names if one.name not in DOORS}
        elif isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{one.name}" for one in node.names}
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id in doors:
            found.add(f"{doors[node.value.id]}.{node.attr}")
    return {one for one in found if one.split(".")[0] in DOORS}


@pytest.mark.parametrize("name", EVERY)
def test_an_example_takes_nothing_private_and_no_command_line(name):
    for one in taken(name):
        assert not {"cli", "commands"} & set(one.split(".")), one
        assert not any(part.startswith("_") for part in one.split(".")), one


@pytest.mark.parametrize("name", sorted(BY_THE_DOOR))
def test_an_example_of_everyday_work_goes_through_the_front_doors(name):
    shown = {f"{door}.{one}" for door in DOORS for one in importlib.import_module(door).__all__}
    assert taken(name)
    assert taken(name) <= shown


@pytest.mark.slow(10)
def test_use_from_python(tmp_path, example):
    """The notebook finds the errors of the drive that it made."""
    said = example("use_from_python.py")
    assert "the eccentricity below" in said, "an impossible pair is refused"
    assert float(re.search(r"analysis differ by (\S+) arcsec", said)[1]) < 1e-5
    for name, made in {
        "eccentricity": 3.0,
        "pin_radius": -1.0,
        "pin_radial_2_cos": 1.915,
        "pin_radial_2_sin": 1.607,
    }.items():
        low, high = (float(n) for n in re.search(rf"^{name} +(\S+) … (\S+) um", said, re.MULTILINE).groups())
        assert low - 0.05 <= made <= high + 0.05, name
    out = tmp_path / "use_from_python_out"
    assert {p.name for p in out.glob("*.png")} == {"sweep.png", "as-made.png", "study.png", "identified.png"}
    assert (out / "identified.fmu").exists()


@pytest.mark.slow(5)
def test_arrays_to_errors(tmp_path, example):
    """Intervals of 95 % around errors from arrays: at most two of some twenty miss the truth."""
    said = example("arrays_to_errors.py")
    inside, all_of = (int(n) for n in re.search(r"(\d+) of (\d+) intervals contain the true value", said).groups())
    assert all_of >= 15
    assert inside >= all_of - 2
    assert "isometric is held: its effect on the transmission errors is that of -1.00 pin_radius" in said


@pytest.mark.slow(5)
def test_what_each_error_does(tmp_path, example):
    """The study of the error-surface paper: its conclusions as docs/theory/papers.md reports them."""
    said = example("error_study.py")
    lines = {line.strip("│ ").split("  ")[0]: "does not hold" not in line for line in said.splitlines()}
    assert lines["pitch dominates PPTE"]
    assert lines["centre distance dominates PPTE"]
    assert not lines["misalignment dominates PPTE"]
    assert_page_agrees("theory-paper-error-surface", "hold", said)
    assert (tmp_path / "error_study.png").stat().st_size > 10000


@pytest.mark.slow(6)
def test_the_wear_paper_s_figures(tmp_path, example):
    said = example("wear_study.py")
    cells = cells_of(said)
    table = {row[0]: row[1:] for row in cells}
    assert table["unloaded mesh interval, rad"][:2] == ["0.1571", "0.1571"]
    assert float(table["gear, deepest, bounded, µm"][1]) == pytest.approx(50.47, rel=0.01)
    assert float(table["gear, deepest, updated, µm"][1]) < 8.0
    assert_page_agrees("theory-paper-wear", "`examples/wear_study.py`", said)
    assert (tmp_path / "wear_study.png").stat().st_size > 100000


def test_the_rv_paper_s_tables(tmp_path, example):
    """Table 10 can't be had from equation 21: its first row needs a cosine above 1, the others over 70 degrees."""
    said = example("lost_motion_study.py")
    cells = cells_of(said)
    head, *tilts = [row for row in cells if len(row) == 6]
    assert head[2:4] == ["paper", "equation 21 at 20°"]
    assert [row[2] for row in tilts] == ["0.5462′", "0.5976′", "0.5982′", "0.6018′", "0.6029′", "0.6032′", "0.6063′"]
    assert {row[3] for row in tilts} == {"0.5488′"}
    assert tilts[0][5] == "none: cos α = 1.043"
    assert all(float(row[5].removesuffix("°")) > 70.0 for row in tilts[1:])
    totals = {row[0]: row[4] for row in cells if len(row) == 5}
    assert totals["standard"] == "1.9689′"
    assert totals["as printed"] == "0.5488′"
    for rows in ("`examples/lost_motion_study.py`", "::test_the_rv_paper_s_tables`"):
        assert_page_agrees("theory-paper-rv", rows, said)
    assert (tmp_path / "lost_motion_study.png").stat().st_size > 30000


@pytest.mark.slow(15)
def test_an_fmu_beside_mujoco(example):
    """At the steps of a robot simulator the arm is where it is with all inertias in one model."""
    pytest.importorskip("mujoco")
    off = re.findall(r"^(\d) ms: ([\d.]+) mrad rms", example("fmu_beside_mujoco.py"), re.M)
    assert [step for step, _ in off] == ["1", "2"]
    assert max(float(rms) for _, rms in off) < 0.02


@pytest.mark.slow(15)
def test_two_link_arm(tmp_path, example):
    """Play, friction and transmission error each move the tip, and attributes alone leave out most of its deviation."""
    pytest.importorskip("mujoco")
    said = example("two_link_arm.py")
    assert re.search(r"shoulder: -39, play [\d.]+″ \([\d.]+ to [\d.]+\), identified", said)
    rows = re.findall(r"^(.+): ([\d.]+) mm rms from the path, ([\d.]+) mm from the arm as it is$", said, re.M)
    off, apart = ({name: float(row[k]) for name, *row in rows} for k in (0, 1))
    assert min(apart[f"without {what}"] for what in ("play", "friction", "transmission error")) > 0.1
    assert off["MuJoCo's attributes alone"] < 0.5 * off["as it is"]
    page = (EXAMPLES.parent / "docs" / "joint.md").read_text(encoding="utf-8")
    stated = re.search(r"tip is ([\d.]+) mm \(rms\) from the path; MuJoCo's attributes alone give ([\d.]+) mm", page)
    assert float(stated[1]) == pytest.approx(off["as it is"], abs=0.06)
    assert float(stated[2]) == pytest.approx(off["MuJoCo's attributes alone"], abs=0.06)
    assert (tmp_path / "two_link_arm_out" / "two_link_arm.png").stat().st_size > 20000
