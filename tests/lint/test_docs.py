"""Every code block of README and docs, run or read according to its kind, page by page from top to bottom."""

import importlib
import itertools
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
import typer
from common import EXAMPLES, resolved

from cycloid_fmu import edge
from cycloid_fmu.drive import read_drive
from cycloid_fmu.errors.kinds import KINDS
from cycloid_fmu.fmu.description import model_variables
from cycloid_fmu.fmu.variables import from_tables
from cycloid_fmu.geometry.pair import Pair

ROOT = EXAMPLES.parent
FOLDERS = tuple(ROOT / "docs" / name for name in ("", "tutorials", "theory", "development"))
API = ROOT / "docs" / "reference" / "api.md"
PAGES = sorted([ROOT / "README.md", API, *(page for folder in FOLDERS for page in folder.glob("*.md"))])
BLOCK = re.compile(r"^```(?P<info>[^\n`]*)\n(?P<body>.*?)^```$", re.MULTILINE | re.DOTALL)
# A study as long as a page has it is for users: here it is so short that it still goes through all that it does.
SHORTER = (
    (r"( tolerance .*--samples )\d{3,}( --angles \d+)?(?=.* saltelli)", r"\g<1>240 --angles 20"),
    (r"( tolerance .*--samples )\d{3,}( --angles \d+)?(?!.* saltelli)", r"\g<1>32 --angles 20"),
    (r"( analyze .*--limits \S+)", r"\g<1> --angles 30"),
    (r"( budget .*)", r"\g<1> --samples 100"),
    (r"( wear .*--crank-turns) \S+", r"\g<1> 2e4"),
)
SIMULATE = "cycloid-bench simulate --fmu as-made.fmu --noise '0.5 arcsec'"
BUS = r"printf 'format = \"cycloid-simulation/1\"\n[can]\nchannel = \"GROUP\"\n' > bus.toml"
RUNS = f"""
cp examples/drive-39-40.toml drive.toml
cycloid-fmu build examples/drive-39-40-as-made.toml -o as-made.fmu
{SIMULATE} --torque '20 N*m' --direction backward -o 20Nm-backward.arrows
{SIMULATE} --torque '-200 N*m' -o 200Nm-forward.arrows
{SIMULATE} --torque '200 N*m' --direction backward -o 200Nm-backward.arrows
"""
LOOP = f"""
{SIMULATE} --hysteresis --torque '181 N*m' --turns 3 --samples-per-turn 400 -o loop.arrows
cycloid-bench export loop.arrows -o loop.csv
rm loop.arrows
"""
CMM = """
from pathlib import Path; from cmm import measure, write_csv; from cycloid_fmu.geometry.pair import read_pair;
from cycloid_fmu.surfaces.surface import surface_of_pair; pair = read_pair('made.toml');
write_csv(Path('cmm.csv'), measure(pair, surface_of_pair(pair), 2e-7, 1))
""".strip().replace("\n", " ")
RAMP = """
import numpy as np; t = np.arange(0.0, 100.0, 0.01); w = 8.0 * np.sin(0.02 * np.pi * t);
m = 3.5 * np.sign(w) + 0.15 * w + np.random.default_rng(1).normal(0.0, 0.5, t.size);
np.savetxt('ramp.csv', np.column_stack([t, np.cumsum(w) * 0.01 / (2.0 * np.pi), m]), delimiter=',',
header='TIME [s],POSITION [rev],TORQUE [Nm]', comments='')
""".strip().replace("\n", " ")
# Pages that go on in the folder of another.
CONTINUES = dict.fromkeys(
    ("controller", "compensation", "fmu", "fmu_losses", "fmu_tools", "identify", "identify_unknowns", "recalibrate"),
    "test_bench_engineer",
)
# Given to a page: your files, and your bench.
GIVEN = {
    "bench": f"""
        cycloid-fmu example drive-39-40-as-made.toml -o made.toml
        cycloid-fmu build made.toml -o as-made.fmu
        {BUS.replace("GROUP", "239.74.163.79")}
        {SIMULATE} --torque '-20 N*m' --bus bus.toml --write-bench BENCH.toml &
    """,
    "own_motor": f"""
        python -c "{RAMP}"
    """,
    "README": f"""{RUNS}{LOOP}
        {BUS.replace("GROUP", "239.74.163.78")}
        {SIMULATE} --torque '-20 N*m' --bus bus.toml --write-bench bench.toml &
    """,
    "tolerances": f"""
        cycloid-fmu example drive-39-40-as-made.toml -o made.toml
        PYTHONPATH={ROOT}/tests/cycloid_fmu:{ROOT} python -c "{CMM}"
        rm made.toml
    """,
}


def blocks(page):
    """(language, caption, text) of each code block of a page; text directly below commands is their output."""
    text = page.read_text(encoding="utf-8")
    ends, before = 0, ""
    for found in BLOCK.finditer(text):
        info, body = found["info"].strip(), found["body"]
        if info == "text" and before == "sh" and not text[ends : found.start()].strip():
            info = "output"
        ends, before = found.end(), info
        caption = re.match(r":caption: (.*)\n", body)
        if caption:
            body = body[caption.end() :]
        yield info.removeprefix("{code-block}").strip(), caption and caption[1], body


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_every_block_is_of_a_kind_that_is_checked(page):
    for language, _, body in blocks(page):
        assert language in ("sh", "toml", "python", "json", "text", "output", "diff", "{toctree}", "{eval-rst}"), (
            page.name,
            language,
        )
        if language == "toml":
            tomllib.loads(body)
        elif language == "json":
            json.loads(body)
        elif language == "python":
            compile(body, page.name, "exec")


def lines_of(body):
    """The command lines of a block, continued ones joined."""
    return [line.strip() for line in body.replace("\\\n", " ").splitlines() if line.strip(" #")]


INLINE = re.compile(r"`(cycloid-(?:fmu|fit|bench) [^`]+)`")
GROUPS = {
    name: typer.main.get_command(importlib.import_module(f"{door}.cli").app)
    for name, door in (("cycloid-fmu", "cycloid_fmu"), ("cycloid-fit", "fitting"), ("cycloid-bench", "drivers"))
}


def incomplete(line):
    """What a command line lacks: its first unknown or missing option or argument, or ""."""
    name, *words = shlex.split(line.removesuffix("&"), comments=True)
    command = GROUPS[name]
    context = command.context_class(command)
    while hasattr(command, "commands"):
        command, words = command.commands[words[0]], words[1:]
        context = command.context_class(command, context)
    try:
        given, _, _ = command.make_parser(context).parse_args(args=list(words))
    except Exception as problem:
        return str(problem)
    lacks = [p for p in command.params if p.required and given.get(p.name) in (None, ())]
    return f"{lacks[0].opts[0]} is missing" if lacks else ""


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_commands_are_complete_as_written(page):
    """Those in blocks, and those in the sentences of README; other pages' sentences only name commands and options."""
    for line in (line for language, _, body in blocks(page) if language == "sh" for line in lines_of(body)):
        assert not line.startswith("cycloid-") or incomplete(line) == "", line
    for found in INLINE.findall(BLOCK.sub("", page.read_text(encoding="utf-8"))):
        line = " ".join(found.split())
        if " -" in line:
            assert incomplete(line) == "" or (page.stem != "README" and "No such option" not in incomplete(line)), line


OUR_FILES = re.compile(
    r"[`\"]((?:cycloid_fmu|fitting|drivers|tests|studies|benchmarks|examples|docs)/[\w./-]+\.\w+)[`\":]"
)


@pytest.mark.parametrize("page", [*PAGES, ROOT / "studies" / "mutate.py"], ids=lambda p: p.stem)
def test_files_of_the_repository_that_a_page_names_exist(page):
    named = OUR_FILES.findall(page.read_text(encoding="utf-8"))
    assert [name for name in named if not (ROOT / name).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_objects_that_a_page_names_exist(page):
    for name in set(re.findall(r"{py:obj}`~?([\w.]+)`", page.read_text(encoding="utf-8"))):
        resolved(name)


def test_a_command_that_lacks_an_option_is_found():
    assert incomplete("cycloid-fmu tolerance p.toml") == "--tolerances is missing"
    assert "--nonsense" in incomplete("cycloid-fmu analyze p.toml --nonsense 3")
    assert incomplete("cycloid-fmu draw p.toml") == "--output is missing"
    assert incomplete("cycloid-fmu draw p.toml -o p.svg") == ""


NUMBER = re.compile(r"[+-]?\d+(?:\.\d+)?(?:e[+-]?\d+)?")


def same_line(page, found):
    """Whether a line of a page is that of an output: words alike, numbers within 2 % or two units of the last digit.

    Bits differ between processors, and so do the last digits of fits and of studies.
    """
    page, found = " ".join(page.split()), " ".join(found.split())
    if page.endswith(" …"):
        words = page[:-2].split()
        page, found = " ".join(words), " ".join(found.split()[: len(words)])
    if NUMBER.sub("0", page) != NUMBER.sub("0", found):
        return False
    for stated, now in zip(NUMBER.findall(page), NUMBER.findall(found), strict=True):
        last = 10.0 ** -len(stated.partition("e")[0].partition(".")[2])
        if abs(float(now) - float(stated)) > max(0.02 * abs(float(stated)), 2.0 * last * ("." in stated)):
            return False
    return True


def missing_in(shown, output):
    """The first line of a page that is not in the output in this order, or ""; a line "…" matches any lines."""
    lines = iter(line for line in output.splitlines() if line.strip())
    return next(
        (
            line
            for line in shown.splitlines()
            if line.strip() not in ("", "…") and not any(same_line(line, found) for found in lines)
        ),
        "",
    )


def test_an_output_on_a_page_is_compared():
    """Other digits at the end pass; another number, another word, another order and a missing line do not."""
    output = "head\nTE mean   43.2813″ left out\npins 4–5\n"
    assert not missing_in("head\n…\npins 4–5\n", output)
    assert not missing_in("TE mean 43.2811″ …\n", output)
    assert missing_in("TE mean 45.3″ …\n", output)
    assert missing_in("TE peak 43.2813″ …\n", output)
    assert missing_in("pins 4–5\nhead\n", output)
    assert missing_in("pins 3–5\n", output)


@pytest.mark.parametrize("page", sorted((ROOT / "docs" / "tutorials").glob("*.md")), ids=lambda p: p.stem)
def test_pictures_of_a_tutorial_are_made_by_its_commands(page):
    text = page.read_text(encoding="utf-8")
    for name in re.findall(r"\(\.\./_static/tutorials/([\w.]+)\)", text):
        assert f"--plot {name}" in text
        assert (ROOT / "docs" / "_static" / "tutorials" / name).exists(), "draw it: python docs/pictures.py"


@pytest.fixture
def shell(command, tmp_path):
    """Run a line of a block in the page's folder: our own commands in this process, the others by bash."""
    environment = {**os.environ, "PATH": str(Path(sys.executable).parent) + os.pathsep + os.environ["PATH"]}
    waiting = []

    def run(line):
        words = shlex.split(line, comments=True)
        if words[-1] == "&":
            started = subprocess.Popen(
                words[:-1], cwd=tmp_path, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True
            )
            waiting.append(started)
            assert started.stderr.readline(), "it says when it waits"
        elif words[0].startswith("cycloid-"):
            found = [sorted(p.name for p in tmp_path.glob(word) if "*" in word) or [word] for word in words]
            done = command(*itertools.chain(*found), folder=tmp_path)
            allowed = {edge.NO_DATA} if "--idle" in words else {0, edge.NOT_MET} if "--limits" in words else {0}
            assert done.returncode in allowed, (line, done.stderr)
            return done.stdout
        else:
            done = subprocess.run(
                ["bash", "-euc", line], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600
            )
            assert done.returncode == 0, (line, done.stderr)
            return done.stdout
        return ""

    yield run
    for started in waiting:
        _, said = started.communicate(timeout=60)
        assert started.returncode == 0, said


def install(folder):
    """Do the part of `pip install -e .` that makes the entry points of a `pyproject.toml` found in its folder."""
    project = tomllib.loads((folder / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    name, version = project["name"], project["version"]
    metadata = folder / f"{name.replace('-', '_')}-{version}.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n", encoding="utf-8")
    groups = project["entry-points"].items()
    lines = [f"[{group}]\n" + "".join(f"{k} = {v}\n" for k, v in points.items()) for group, points in groups]
    (metadata / "entry_points.txt").write_text("\n".join(lines), encoding="utf-8")


@pytest.mark.slow(60)
@pytest.mark.parametrize(
    "page",
    [p for p in PAGES if re.search("^```(sh|python)", p.read_text(encoding="utf-8"), re.M)],
    ids=lambda p: p.stem,
)
def test_a_page_s_commands_do_what_it_says(page, tmp_path, tmp_path_factory, shell, monkeypatch):
    """From an empty folder, or from that of the page it continues: the commands in order."""
    if page.stem == "README":  # whose folder is the repository
        shutil.copytree(EXAMPLES, tmp_path / "examples", ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    for line in lines_of(GIVEN.get(page.stem, "")):
        shell(line)
    if before := CONTINUES.get(page.stem):
        finished = tmp_path_factory.getbasetemp() / before
        if not finished.exists():
            run_page(ROOT / "docs" / "tutorials" / f"{before}.md", tmp_path, shell, monkeypatch)
            shutil.copytree(tmp_path, finished)
        shutil.copytree(finished, tmp_path, dirs_exist_ok=True)
    run_page(page, tmp_path, shell, monkeypatch)


def run_page(page, folder, shell, monkeypatch):
    """Write the files of a page, run its blocks, and compare the outputs that it shows."""
    # `.ci/run` runs the installation commands.
    elsewhere = re.compile(r"pip (install|wheel)|<!-- (main-job|tests) -->")
    said = None  # by the commands just before, where all were run as written
    for language, caption, body in blocks(page):
        if language == "output" and said is not None:
            assert not missing_in(body, said), (page.name, said)
        if caption:
            (folder / caption).write_text(body, encoding="utf-8")
            if caption == "pyproject.toml":
                install(folder)
                monkeypatch.syspath_prepend(folder)
        elif language == "python":
            subprocess.run([sys.executable, "-c", body], cwd=folder, check=True, timeout=600)
        elif language == "sh" and not elsewhere.search(body):
            if "cd " in body:
                said = None
                shell(" && ".join(lines_of(body)))
                continue
            said = ""
            for line in lines_of(body):
                short = line
                for long, shorter in SHORTER if page.parent.name != "tutorials" else ():
                    short = re.sub(long, shorter, short)
                output = shell(short)
                said = said + output if said is not None and short == line else None


# A quantity that is measured: the number before its unit, or after a label that begins with it.
MEASURED_UNIT = r"(?:ns|µs|ms|s|kB|MB|GB|″|%)(?![\w·])"
CLAIM = re.compile(rf"(\d+(?:\.\d+)?)(?:\sto\s(\d+(?:\.\d+)?))?\s?({MEASURED_UNIT})")
LABELLED = re.compile(rf"(?<!\w)({MEASURED_UNIT})[^:;|]*: (\d+(?:\.\d+)?)")


def test_each_measured_number_of_the_readme_is_one_of_the_measured_figures():
    readme = BLOCK.sub("", (ROOT / "README.md").read_text(encoding="utf-8"))
    page = (ROOT / "docs" / "measured.md").read_text(encoding="utf-8")
    measured = [(number, unit) for low, high, unit in CLAIM.findall(page) for number in (low, high) if number]
    measured += [(number, unit) for unit, number in LABELLED.findall(page)]
    claims = CLAIM.findall(readme)
    assert claims
    for low, high, unit in claims:
        for number in filter(None, (low, high)):
            digits = len(number.partition(".")[2])
            assert any(round(float(n), digits) == float(number) for n, of in measured if of == unit), (number, unit)


def test_every_example_drive_is_listed_with_its_ratio():
    """Those that are there, and no other; one of them is a joint with output rollers."""
    page = (ROOT / "docs" / "example_drives.md").read_text(encoding="utf-8")
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in page.splitlines() if line[:3] == "| `"]
    listed = {name.strip("`"): (ratio, *words) for name, ratio, *words in rows}
    drives = {}
    for path in EXAMPLES.glob("*.toml"):
        if edge.format_of(path) in ("cycloid-pair/1", "cycloid-reducer/1"):
            drives[path.name] = read_drive(path)
    assert set(listed) == set(drives)
    for name, (ratio, *words) in listed.items():
        assert float(ratio.replace("−", "-")) == pytest.approx(drives[name].ratio)
        assert all(words), name
    supports = (drive.pair.supports for drive in drives.values())
    assert any(one is not None and one.kind == "output_rollers" for one in supports)


GLOSSARY = ROOT / "docs" / "reference" / "glossary.md"
# Pages that use the terms of drives and measurements; the other pages are about the package itself.
WITH_TERMS = sorted(
    page
    for folder in ("docs", "docs/tutorials", "docs/theory")
    for page in (ROOT / folder).glob("*.md")
    if page.stem not in ("index", "install", "howto", "encoder", "licences", "measured", "mutants")
)
TO_GLOSSARY = re.compile(r"\[([^][]+)\]\((?:\.\./)?(?:reference/)?glossary\.md(?:#([\w-]+))?\)")
NOT_PROSE = re.compile(r"^```.*?^```$|^#.*?$|^\(.*?\)=$|!\[[^]]*\]\([^)]*\)|`[^`\n]*`", re.MULTILINE | re.DOTALL)


def linked_late(page, glossary):
    """Links of a page to the glossary that are not at the term's first use, or whose section does not have the term."""
    sections = {part.split("\n")[0].lower().replace(" ", "-"): part.lower() for part in glossary.split("\n## ")}
    prose, late = NOT_PROSE.sub("", page), []
    for link in TO_GLOSSARY.finditer(prose):
        term, section = link[1].lower(), link[2]
        if term == "glossary":
            assert section is None or section in sections
        else:
            names = " ".join(re.findall(r"\*\*([^*]+)\*\*", sections[section]))
            known = all(word.rstrip("s") in names for word in term.split() if word != "and")
            if not known or re.search(rf"\b{re.escape(link[1])}\b", prose[: link.start()]):
                late.append(link[1])
    return late


@pytest.mark.parametrize("page", WITH_TERMS, ids=lambda p: p.stem)
def test_terms_are_linked_to_the_glossary_at_their_first_use(page):
    text = page.read_text(encoding="utf-8")
    assert TO_GLOSSARY.search(NOT_PROSE.sub("", text))
    assert linked_late(text, GLOSSARY.read_text(encoding="utf-8")) == []


def test_a_late_link_to_the_glossary_is_found():
    glossary = "# Glossary\n## Figures\n- **Backlash**: the free rotation.\n"
    link = "[{}](reference/glossary.md#figures)"
    assert linked_late("`backlash` " + link.format("backlash"), glossary) == []
    assert linked_late("The backlash. " + link.format("backlash"), glossary) == ["backlash"]
    assert linked_late(link.format("play"), glossary) == ["play"]


def test_the_readme_is_short():
    assert len((ROOT / "README.md").read_text(encoding="utf-8").split()) <= 900


def test_no_page_that_must_be_read_to_act_is_long():
    """How-to pages and tutorials; the coverage of an identification is looked up."""
    acted_on = {*(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "tutorials").glob("*.md")}
    words = {page.name: len(page.read_text(encoding="utf-8").split()) for page in acted_on}
    assert {name for name, count in words.items() if count > 2000} == {"identify_coverage.md"}


def test_the_measured_figures_by_question_are_those_of_the_record(monkeypatch):
    """The page has no number of its own, and each command on it names a test that is there."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    import questions

    record = questions.RECORD.read_text(encoding="utf-8")
    page = questions.PAGE.read_text(encoding="utf-8")
    assert page == questions.page(record), "write it again: python docs/questions.py"
    for figure in itertools.chain(*questions.QUESTIONS.values()):
        assert questions.reproduced_by(figure)
        assert all(value in record for value in questions.values(figure, record))
    fewer = re.sub(r"^.*test_step_in_the_c_host.*\n", "", record, flags=re.MULTILINE)
    assert "in a C program" in page
    assert "in a C program" not in questions.page(fewer), "what was not measured is left out"


def test_the_api_reference_has_every_public_name_and_every_room():
    page = (ROOT / "docs" / "reference" / "api.md").read_text(encoding="utf-8")
    listed = set(re.findall(r"^   ([a-z]\w+\.[\w.]+)$", page, re.MULTILINE))
    for door in ("cycloid_fmu", "fitting", "drivers"):
        names = {f"{door}.{name}" for name in importlib.import_module(door).__all__ if name != "__version__"}
        assert {name for name in names - listed if f"`{name}`" not in page} == set()
        for room in (p.parent for p in (ROOT / door).glob("*/__init__.py") if p.parent.name != "cli"):
            assert f"**`{door}.{room.name}`**" in page
            if f"{door}.{room.name}" not in listed:  # it does not list its names itself
                modules = {f"{door}.{room.name}.{p.stem}" for p in room.glob("*.py") if p.stem != "__init__"}
                # Code that runs inside an FMU is not a module to import.
                assert {m for m in modules - listed if "cycloid_drive" not in m} == set()
    for name in listed:
        resolved(name)


def test_every_key_of_a_pair_file_has_its_own_meaning(tmp_path, monkeypatch):
    """Signs that are easily taken the wrong way round are there, and each kind of error with its limit."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    import file_reference

    file_reference.write(tmp_path / "files.md")
    assert file_reference.PAGE.read_text(encoding="utf-8") == (tmp_path / "files.md").read_text(encoding="utf-8"), (
        "write it: python docs/file_reference.py"
    )
    page = (tmp_path / "files.md").read_text(encoding="utf-8")
    assert [line for line in page.splitlines() if line.startswith("| `") and line.endswith("|  |")] == []
    assert not re.search(r"\bNone\b|or text\b.*\|$", page), "words of Python"
    section = page.split("\n## ")[1]
    rows = [[cell.strip() for cell in line.strip("|").split("|")] for line in section.splitlines() if line[:3] == "| `"]
    meanings = {cells[0]: cells[-1] for cells in rows if len(cells) == 4}
    assert {f"`{name}`" for name in (*Pair.model_fields, "isometric", "offset")} - set(meanings) == {
        "`modification`",
        "`material`",
        "`bodies`",
        "`errors`",
        "`supports`",
        "`losses`",
        "`thermal`",
        "`expansion`",
    }
    assert all(meanings.values())
    assert len(set(meanings.values())) == len(meanings)
    assert "> 0 removes" in meanings["`isometric`"]
    assert "< 0 removes" in meanings["`offset`"]
    errors = {cells[0].strip("`"): cells[-2:] for cells in rows if len(cells) == 5}
    assert list(errors) == [kind.file_key for kind in KINDS.values()]
    assert errors["misalignment_xz"][0] == "± 20 mrad"
    assert all(kind.sign in errors[kind.file_key][1] for kind in KINDS.values())


def test_the_reference_has_every_variable_of_every_fmu(tmp_path, monkeypatch):
    """The model description of each variable agrees with its row, under its interface."""
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    import variable_reference

    variable_reference.write(tmp_path / "variables.md")
    page, rows, head = (tmp_path / "variables.md").read_text(encoding="utf-8"), {}, []
    for line in filter(re.compile(r"\| (variable|`)").match, page.splitlines()):
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if cells[0] == "variable":
            head = cells
        else:
            assert cells[0] not in rows, "told once"
            rows[cells[0].strip("`")] = dict(zip(head, cells, strict=True))
    told = set()
    for interface, table in variable_reference.tables():
        for version in ("2.0", "3.0"):
            scalars = tuple(v for v in table if version == "3.0" or (not v.dimensions and v.causality != "independent"))
            native = from_tables(scalars)
            for tables, reached in ((dict(enumerate(scalars)), ""), (native, "native")):
                described = model_variables(tuple(tables.values()), version, tuple(tables))
                for node in described:
                    row, given = rows[node.get("name")], {k: v for part in node.iter() for k, v in part.attrib.items()}
                    told.add((node.get("name"), interface, reached))
                    if row["native"] == "constant" and reached:
                        assert given["variability"] == "constant"
                    else:
                        assert row[interface] == given["causality"]
                        assert row["variability"] == given["variability"]
                    assert row["unit"].split(" ")[0] in (given.get("unit", ""), "integer", "boolean")
                    assert given.get("displayUnit", "") in row["unit"]
                    for limit in ("min", "max"):
                        assert limit not in given or f"{float(given[limit]):g}" in row["range"].split()
                    assert given["description"] in row["meaning"]
    written = {(n, i, "") for n, row in rows.items() for i in variable_reference.INTERFACES if row[i] != "–"}
    written |= {(n, i, "native") for n, i, _ in written if rows[n]["native"] != "–"}
    assert told == written
