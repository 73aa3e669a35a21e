"""Every code block of README and docs, run or read as what it is, page by page from top to bottom."""

import json
import os
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest
from common import EXAMPLES

from cycloid_fmu.fmu.description import model_variables
from cycloid_fmu.fmu.native_build import native_variables

ROOT = EXAMPLES.parent
PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "tutorials").glob("*.md")])
BLOCK = re.compile(r"^```(?P<info>[^\n`]*)\n(?P<body>.*?)^```$", re.MULTILINE | re.DOTALL)
INSTALL = ("pip install", "python3.11 -m venv")


def blocks(page):
    """(language, caption, text) of each code block of a page."""
    for found in BLOCK.finditer(page.read_text(encoding="utf-8")):
        info, body = found["info"].strip(), found["body"]
        caption = re.match(r":caption: (.*)\n", body)
        if caption:
            body = body[caption.end() :]
        yield info.removeprefix("{code-block}").strip(), caption and caption[1], body


@pytest.mark.parametrize("page", PAGES, ids=lambda p: p.stem)
def test_every_block_is_of_a_kind_that_is_checked(page):
    for language, _, body in blocks(page):
        assert language in ("", "sh", "toml", "python", "json", "{toctree}", "{eval-rst}"), (page.name, language)
        if language == "toml":
            tomllib.loads(body)
        elif language == "json":
            json.loads(body)
        elif language == "python":
            compile(body, page.name, "exec")


@pytest.mark.slow
@pytest.mark.parametrize("page", [p for p in PAGES if "```sh" in p.read_text(encoding="utf-8")], ids=lambda p: p.stem)
def test_a_tutorial_s_commands_do_what_it_says(page, tmp_path):
    """From nothing: the page's own files, its commands in order, in one empty folder."""
    shutil.copytree(EXAMPLES, tmp_path / "examples", ignore=shutil.ignore_patterns("*.py", "__pycache__"))
    folder = str(Path(sys.executable).parent)
    environment = {**os.environ, "PATH": folder + os.pathsep + os.environ["PATH"]}
    for language, caption, body in blocks(page):
        if caption:
            (tmp_path / caption).write_text(body, encoding="utf-8")
        if language != "sh" or any(words in body for words in INSTALL):
            continue
        run = subprocess.run(
            ["bash", "-euc", body], cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600
        )
        assert run.returncode == 0, (body, run.stderr)


def test_the_reference_has_every_variable_of_every_fmu(tmp_path, monkeypatch):
    """What the model descriptions say of each variable stands in its row, under its interface."""
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
            native = native_variables(scalars)
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
