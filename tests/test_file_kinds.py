"""A file in the place of another is named as what it is, with what takes it."""

import importlib
import re
import tomllib

import numpy as np
import pytest
import typer
from common import EXAMPLES

from cycloid_fmu import edge
from cycloid_fmu.edge.file_kinds import FORMATS, kind_of

ROOT = EXAMPLES.parent
DOORS = {"cycloid-fmu": "cycloid_fmu", "cycloid-fit": "fitting", "cycloid-bench": "drivers"}
GROUPS = {name: typer.main.get_command(importlib.import_module(f"{door}.cli").app) for name, door in DOORS.items()}
TAKEN = {
    "pair": "drive-39-40.toml",
    "reducer": "rv-20e.toml",
    "tolerances": "tolerances.toml",
    "wear": "wear.toml",
    "requirements": "requirements.toml",
    "design": "design.toml",
    "friction": "friction.toml",
    "instruments": "instruments.toml",
    "certificate": "certificate.toml",
    "read-head": "rv-20e-read-head.toml",
}


def test_every_format_that_is_read_or_written_is_known():
    """Those of the sources, and no others."""
    sources = [file for door in DOORS.values() for file in (ROOT / door).rglob("*.py") if file.name != "file_kinds.py"]
    stated = {n for file in sources for n in re.findall(r'FORMAT\w* = "(cycloid-[\w-]+)/\d+"', file.read_text())}
    assert stated == set(FORMATS)


def test_what_takes_a_file_is_there():
    options = {o for g in GROUPS.values() for c in g.commands.values() for p in c.params for o in p.opts}
    for kind in FORMATS.values():
        assert set(re.findall(r"--[\w-]+", kind)) <= options, kind
        parts = " / ".join(kind.split(", for ")) + " "
        for name, words in re.findall(r"(cycloid-\w+) ((?:\w+(?:, | and | ))+)", parts):
            assert set(filter(None, re.split(", | and | ", words))) - {"cycloid"} <= set(GROUPS[name].commands), kind


@pytest.mark.parametrize("kind", TAKEN)
def test_a_file_of_another_kind_is_named(kind, command):
    """Each example as a pair, a wear law, a surface, an FMU and a recording, but where it is one."""
    file = EXAMPLES / TAKEN[kind]
    said = f"{file}: this is {kind_of(file)}; "
    assert tomllib.loads(file.read_text(encoding="utf-8"))["format"] in said
    pair = EXAMPLES / TAKEN["pair"]
    places = {
        "pair": ["cycloid-fmu", "desk", file],
        "wear": ["cycloid-fmu", "wear", pair, "--wear", file, "--crank-turns", "1"],
        "surface": ["cycloid-fmu", "analyze", pair, "--surface", file],
        "fmu": ["cycloid-fmu", "inspect", file],
        "recording": ["cycloid-fit", "metrics", file, "--ratio", "-39"],
        "table": ["cycloid-fmu", "wear", pair, "--wear", EXAMPLES / TAKEN["wear"], "--duty", file],
    }
    for place, words in places.items():
        if place != kind:
            run = command(*words)
            assert (run.returncode, run.stdout) == (2, "")
            assert run.stderr.startswith(said)
            assert run.stderr.endswith(" is needed here.\n")
            assert run.stderr.count("\n") == 1


def test_files_that_are_not_text_are_named(command, tmp_path):
    pair = EXAMPLES / TAKEN["pair"]
    assert command("cycloid-fmu", "surface", "nominal", pair, "-o", "s.nc").returncode == 0
    assert command("cycloid-fmu", "build", pair, "-o", "d.fmu").returncode == 0
    bench = ["--ratio", "-39", "--torque", "1 Nm"]
    assert command("cycloid-bench", "simulate", *bench, "-o", "r.arrows").returncode == 0
    kinds = {
        "s.nc": "an error surface (cycloid-surface/1), for --surface",
        "d.fmu": "an FMU, for cycloid-fmu simulate, inspect and compare",
        "r.arrows": FORMATS["cycloid-recording"],
    }
    for name, kind in kinds.items():
        assert kind_of(tmp_path / name) == kind
        for words in (["analyze", name], ["analyze", pair, "--surface", name], ["inspect", name]):
            run = command("cycloid-fmu", *words)
            if (words[0], name) != ("inspect", "d.fmu") and words[-2:] != ["--surface", "s.nc"]:
                assert (run.returncode, run.stderr.count("\n")) == (2, 1)
                assert run.stderr.startswith(f"{name}: this is {kind}; ")
                assert words[-1] != name or words[0] != "analyze" or "(cycloid-" in run.stderr.partition("; ")[2]


def test_only_a_text_of_tables_has_a_first_line_for_its_format(tmp_path):
    (tmp_path / "a.json").write_text('{"crank_turns": 3}')
    (tmp_path / "a.toml").write_text("crank_turns = 3")
    with pytest.raises(edge.InputError, match=r"a\.json: it states no format; .*\(cycloid-figures/1\) is needed here"):
        edge.json_table(tmp_path / "a.json", "cycloid-figures/1", "figures")
    with pytest.raises(edge.InputError, match=r'a\.toml: format is missing; the first line must be format = "cycloid-'):
        edge.toml_table((tmp_path / "a.toml").read_text(), "cycloid-wear/1", "a.toml")


def test_bytes_that_are_no_text_are_no_table(tmp_path):
    """Whatever separators are among them."""
    (tmp_path / "r.arrows").write_bytes(b":)p[,;\t\x05\xfe\x00\n" * 9)
    assert kind_of(tmp_path / "r.arrows") == ""
    (tmp_path / "t.csv").write_bytes("Zeit [s];Drehmoment [Nm];Wärme [°C]\r\n".encode("latin-1"))
    assert kind_of(tmp_path / "t.csv") == "a table (CSV)"


def test_a_damaged_file_of_the_right_kind_is_called_damaged(tmp_path):
    """Its kind is the needed one, so that its own error is said."""
    file = tmp_path / "pair.toml"
    file.write_text('format = "cycloid-pair/1"\n[pair\n')
    with pytest.raises(edge.InputError, match="this is not TOML"):
        edge.toml_table(edge.read_text(file), "cycloid-pair/1", str(file))
    file.write_text('format = "cycloid-pair/2"\n')
    with pytest.raises(edge.InputError, match='this version reads "cycloid-pair/1"'):
        edge.toml_table(edge.read_text(file), "cycloid-pair/1", str(file))


def test_a_file_is_looked_at_quickly(tmp_path):
    """Content made to slow the search down: spaces, brackets and quotes without end."""
    import time

    random = np.random.default_rng(1)
    began = time.monotonic()
    for data in (
        b" " * 10**6,
        b"\n" * 10**6,
        b"[" * 10**6,
        b'{"format"' * 10**5,
        b"\x89HDF\r\n\x1a\n",
        b"PK\x03\x04",
        random.bytes(10**6),
    ):
        (tmp_path / "odd").write_bytes(data)
        assert kind_of(tmp_path / "odd") in ("", "a netCDF or HDF5 file")
    assert time.monotonic() - began < 2.0
