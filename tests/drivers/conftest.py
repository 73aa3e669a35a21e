import itertools
import os

import pytest

from drivers.encoder import protocols

_numbers = itertools.count()


@pytest.fixture
def bus_name():
    """Name of a virtual bus used only by this test."""
    return f"test-{os.getpid()}-{next(_numbers)}"


@pytest.fixture(autouse=True, scope="session")
def _protocols_are_registered():
    assert {"canopen", "amt21", "dbc"} <= protocols().keys(), "reinstall: pip install -e . writes the entry points"
