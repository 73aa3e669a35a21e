"""The examples in docstrings run as written; every public name of the three front doors has one."""

import doctest
import importlib
import importlib.util
import inspect
import pkgutil
from pathlib import Path

import pytest

import cycloid_fmu
import drivers
import fitting

FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE
DOORS = (cycloid_fmu, fitting, drivers)


def modules():
    """Names of all modules of the packages that hold an example."""
    for package in DOORS:
        found = [package.__name__, *(m.name for m in pkgutil.walk_packages(package.__path__, f"{package.__name__}."))]
        for name in found:
            file = Path(importlib.util.find_spec(name).origin)
            if file.suffix == ".py" and ">>>" in file.read_text(encoding="utf-8"):
                yield name


@pytest.mark.parametrize("name", sorted(modules()))
def test_examples_run_as_they_stand(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    failed, tried = doctest.testmod(importlib.import_module(name), optionflags=FLAGS)
    assert tried > 0
    assert failed == 0


def public():
    return [(door, name) for door in DOORS for name in door.__all__ if name not in ("__version__", "ARCSEC", "ARCMIN")]


@pytest.mark.parametrize(("door", "name"), public(), ids=lambda x: getattr(x, "__name__", x))
def test_every_public_name_has_a_runnable_example(door, name):
    thing = getattr(door, name)
    texts = [inspect.getdoc(thing) or ""]
    if inspect.isclass(thing):
        texts += [inspect.getdoc(method) or "" for method in vars(thing).values() if inspect.isfunction(method)]
    examples = [text for text in texts if ">>>" in text or "An example is that of" in text]
    assert examples or (inspect.isclass(thing) and issubclass(thing, Exception)), (
        f"{door.__name__}.{name} has no example"
    )


@pytest.mark.parametrize("door", DOORS, ids=lambda door: door.__name__)
def test_a_front_door_has_chosen_names_that_are_there(door):
    assert 10 <= len(door.__all__) <= 23
    assert sorted(door.__all__) == sorted(set(door.__all__))
    assert set(door.__all__) <= set(dir(door))
    for name in door.__all__:
        getattr(door, name)
    with pytest.raises(AttributeError, match="nothing_of_the_kind"):
        door.nothing_of_the_kind  # noqa: B018
