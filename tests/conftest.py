import contextlib
import functools
import io
import logging
import os
import signal
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest
from hypothesis import settings

# The first call of a kernel compiles it; a time limit for each example would measure that.
settings.register_profile("default", deadline=None)
settings.load_profile("default")

# A worker has one core or less: where linear algebra takes one thread for each core, they wait for each other.
os.environ.setdefault("OMP_NUM_THREADS", "1")
# For the same reason studies that take all cores start no processes, each of which would load packages and kernels.
if "PYTEST_XDIST_WORKER" in os.environ:
    os.cpu_count = lambda: 1
# Container images set this. Each process of the tests would compile every module that it imports.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False
# Who begins the tests in the background has them ignore Ctrl-C, and all that they start.
signal.signal(signal.SIGINT, signal.default_int_handler)

sys.path[:0] = [str(Path(__file__).parent), str(Path(__file__).parents[1] / "studies")]  # common.py, second_drive.py


@functools.cache
def _entry(name):
    (entry,) = metadata.entry_points(group="console_scripts", name=name)
    return entry


@pytest.fixture
def command(tmp_path, monkeypatch):
    """Run a command in an empty folder, as a user does but in this process: a fresh one takes seconds to start."""
    import matplotlib.pyplot

    def run(*words, folder=tmp_path, input=None):
        entry = _entry(words[0])
        out, error, code = io.StringIO(), io.StringIO(), 0
        termination = signal.getsignal(signal.SIGTERM)
        with monkeypatch.context() as patch, contextlib.redirect_stdout(out), contextlib.redirect_stderr(error):
            patch.chdir(folder)
            patch.setenv("COLUMNS", "200")
            patch.setattr(sys, "argv", [str(word) for word in words])
            patch.setattr(sys, "unraisablehook", sys.unraisablehook)  # a command replaces it, and the log's level
            patch.setattr(sys, "stdin", io.StringIO(input or "") if not hasattr(input, "readline") else input)
            try:
                entry.load()()
            except SystemExit as leaving:
                code = leaving.code or 0
            finally:
                signal.signal(signal.SIGTERM, termination)
                logging.disable(logging.NOTSET)
                matplotlib.pyplot.close("all")
        return subprocess.CompletedProcess(words, code, out.getvalue(), error.getvalue())

    return run


@pytest.fixture
def installed_command(tmp_path):
    """Run an installed command in an empty folder, in a process of its own."""

    def run(*words, folder=tmp_path):
        name = str(Path(sys.executable).with_name(words[0]))
        return subprocess.run(
            [name, *map(str, words[1:])],
            cwd=folder,
            capture_output=True,
            text=True,
            timeout=300,
            env={**os.environ, "COLUMNS": "200"},
        )

    return run


@pytest.hookimpl(wrapper=True, optionalhook=True)
def pytest_xdist_auto_num_workers(config):
    """One more than cores where tests wait for a bench that moves in real time, or for a process."""
    waiting = "not system" not in config.option.markexpr and "PYTEST_XDIST_AUTO_NUM_WORKERS" not in os.environ
    return (yield) + waiting


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config, log):
    """Each worker takes a stretch of the tests, so that modules' fixtures are made once, and then half of another's."""
    from xdist.scheduler import WorkStealingScheduling

    return WorkStealingScheduling(config, log) if config.option.dist == "load" else None


def pytest_collection_modifyitems(items):
    """Each worker begins with the longest of its slow tests: begun last, they would run after all others."""
    slow = {item: mark.args[0] if mark.args else 0 for item in items if (mark := item.get_closest_marker("slow"))}
    longest, others = sorted(slow, key=lambda item: -slow[item]), [item for item in items if item not in slow]
    workers = int(os.environ.get("PYTEST_XDIST_WORKER_COUNT", "1"))
    ends = [len(others) * worker // workers for worker in range(workers + 1)]
    items[:] = [i for w in range(workers) for i in (*longest[w::workers], *others[ends[w] : ends[w + 1]])]


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item, call):
    """Where all that Debian and PyPI have for the tests is installed, a test that skips is one that fails."""
    report = yield
    missing = any(map(item.get_closest_marker, ("own_build", "measured_drives", "drake")))
    installed = os.environ.get("CYCLOID_NO_SKIPS") and not missing
    if report.skipped and not hasattr(report, "wasxfail") and installed:
        report.outcome = "failed"
        report.longrepr = f"{item.nodeid} was skipped: {report.longrepr}"
    return report
