"""`cycloid-fmu example`: files to begin with, from the repository and from an installed package."""

import tomllib

import pytest
from common import EXAMPLES

from cycloid_fmu import edge

FILES = sorted(path.name for path in EXAMPLES.iterdir() if path.suffix in (".toml", ".csv"))


def test_an_installed_package_has_every_example():
    settings = tomllib.loads((EXAMPLES.parent / "pyproject.toml").read_text(encoding="utf-8"))
    held = settings["tool"]["hatch"]["build"]["targets"]["wheel"]["force-include"]
    assert held == {f"examples/{name}": f"cycloid_fmu/examples/{name}" for name in FILES}


def test_every_example_is_listed_and_written_as_it_is(command, tmp_path):
    listed = command("cycloid-fmu", "example").stdout
    for name in FILES:
        assert name in listed
        assert command("cycloid-fmu", "example", name).returncode == 0
        assert (tmp_path / name).read_bytes() == (EXAMPLES / name).read_bytes()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["drive-39.toml"], "did you mean drive-39-40.toml?"),
        (["wear.toml", "-o", "own.toml"], "own.toml: this file exists and is not overwritten"),
        (["wear.toml", "-o", "wear.nc"], "must end in .toml or .csv"),
    ],
)
def test_what_is_there_already_is_kept_and_an_unknown_name_is_answered(command, tmp_path, words, said):
    (tmp_path / "own.toml").write_text("mine")
    done = command("cycloid-fmu", "example", *words)
    assert done.returncode == edge.BAD_INPUT
    assert said in " ".join(done.stderr.split())
    assert (tmp_path / "own.toml").read_text() == "mine"
