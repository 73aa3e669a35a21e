"""The supply chain of the package: the tested versions, their licences, and the bill of materials."""

import json
import os
import re
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
CONSTRAINTS = (ROOT / "constraints.txt").read_text(encoding="utf-8").splitlines()


@pytest.fixture
def licences(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs")
    import licences

    return licences


def test_the_constraints_are_names_and_versions_alone():
    assert [line for line in CONSTRAINTS if not re.fullmatch(r"[A-Za-z0-9._-]+==[A-Za-z0-9.+!]+", line)] == []


def test_the_constraints_hold_all_that_is_asked_for(licences):
    held = {re.sub(r"[-_.]+", "-", line.partition("==")[0]).lower() for line in CONSTRAINTS}
    assert set(licences.needed()) - held == set()


@pytest.mark.skipif(sys.version_info[:2] != (3, 11), reason="they are those of Python 3.11")
@pytest.mark.skipif("CYCLOID_NO_SKIPS" not in os.environ, reason="other versions may be installed here")
def test_what_is_installed_is_what_the_constraints_say():
    stated = dict(line.split("==") for line in CONSTRAINTS)
    installed = {d.name: d.version for d in metadata.distributions() if d.name in stated}
    assert installed == {name: stated[name] for name in installed}
    assert len(installed) > 100


@pytest.mark.slow(3)
def test_every_licence_is_allowed_and_listed(licences):
    said = {name: licences.licence(name) for name in licences.needed()}
    assert {n: text for n, text in said.items() if not text or licences.parts(text) - licences.ALLOWED} == {}
    assert (ROOT / "docs" / "licences.md").read_text(encoding="utf-8") == licences.page()


@pytest.mark.slow(5)
def test_one_command_makes_the_bill_of_materials(licences, tmp_path):
    (words,) = re.findall(r"`python (-m cyclonedx_py .*?) -o sbom.json`", licences.HEAD)
    words = [*words.split(), "--no-validate", "-o", str(tmp_path / "sbom.json")]  # a schema is checked in 14 s
    done = subprocess.run([sys.executable, *words], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    bill = json.loads((tmp_path / "sbom.json").read_text(encoding="utf-8"))
    assert bill["bomFormat"] == "CycloneDX"
    assert bill["metadata"]["component"]["name"] == "cycloid-fmu"
    held = {re.sub(r"[-_.]+", "-", one["name"]).lower() for one in bill["components"]}
    assert set(licences.needed()) - held == set()
