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
