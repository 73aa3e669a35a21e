import os
import subprocess
import sys
from pathlib import Path

import pytest
from hypothesis import settings

# The first call of a kernel compiles it; a time limit for each example would measure that.
settings.register_profile("default", deadline=None)
settings.load_profile("default")

sys.path.insert(0, str(Path(__file__).parent))  # common.py and brute_force.py


@pytest.fixture
def command(tmp_path):
    """Run an installed command in an empty folder, as a user does."""

    def run(*words, folder=tmp_path, **options):
        name = str(Path(sys.executable).with_name(words[0]))
        return subprocess.run(
            [name, *map(str, words[1:])], cwd=folder, capture_output=True, text=True, timeout=300,
            env={**os.environ, "COLUMNS": "200"}, **options,
        )  # fmt: skip

    return run


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Where everything that tests need is installed, a test that skips is one that fails."""
    report = yield
    if report.skipped and not hasattr(report, "wasxfail") and os.environ.get("CYCLOID_NO_SKIPS"):
        report.outcome = "failed"
        report.longrepr = f"{item.nodeid} was skipped: {report.longrepr}"
    return report
