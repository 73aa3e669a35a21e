"""Time until the first result from an empty environment, and until a package or command is ready.

All in fresh processes. Installing is compared with installing only numba, SciPy and matplotlib, with the same cache of
downloads; importing and starting a command with importing NumPy, in turn, by the median. `extra_info` has seconds: wall
clock, and processor (user and system), because the machine may have other work.
"""

import resource
import statistics
import subprocess
import sys
import time

import pytest
from common import EXAMPLES

BARE = ("numba", "scipy", "matplotlib")
COMMANDS = ("cycloid-fmu", "cycloid-fit", "cycloid-bench")
IMPORTED = (
    "cycloid_fmu",
    "fitting",
    "drivers",
    "cycloid_fmu.geometry.pair",
    "cycloid_fmu.contact.transmission",
    "fitting.readers.recording",
    "fitting.estimation.identify",
    "drivers.recorder.session",
)


def spent(work, *words):
    """Wall clock and processor seconds of the processes that `work` starts."""
    before, begin = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    work(*words)
    seconds, after = time.perf_counter() - begin, resource.getrusage(resource.RUSAGE_CHILDREN)
    return seconds, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def run(*words):
    subprocess.run([str(word) for word in words], check=True, capture_output=True)


def fresh_environment(folder, *what):
    """Install packages and all that they ask for in an empty environment."""
    run(sys.executable, "-m", "venv", folder)
    run(folder / "bin" / "python", "-m", "pip", "install", "-q", *what)


def shown(seconds, processor):
    return f"{seconds:.2f} ({processor:.2f})"


def test_from_nothing_to_the_first_result(benchmark, tmp_path):
    run(sys.executable, "-m", "build", "--no-isolation", "--wheel", "--outdir", tmp_path, EXAMPLES.parent)
    (wheel,) = tmp_path.glob("*.whl")
    analyze = ("analyze", EXAMPLES / "drive-39-40.toml", "--torque", "181 N*m")
    command = tmp_path / "ours" / "bin" / "cycloid-fmu"
    found = {}

    def road():
        found["installed"] = spent(fresh_environment, tmp_path / "ours", wheel)
        found["first result"] = spent(run, command, *analyze)

    benchmark.pedantic(road, rounds=1)
    found["result once the kernels are compiled"] = spent(run, command, *analyze)
    found[" and ".join(BARE) + " alone installed"] = bare = spent(fresh_environment, tmp_path / "bare", *BARE)
    benchmark.extra_info.update({name: shown(*used) for name, used in found.items()})
    files = (file.lstat().st_size for file in (tmp_path / "ours").rglob("*"))
    benchmark.extra_info["MB installed, with bytecode"] = round(sum(files) / 1e6)
    benchmark.extra_info["installed, times those alone"] = round(found["installed"][1] / bare[1], 2)


@pytest.mark.parametrize(
    "words",
    [*((sys.executable, "-c", f"import {name}") for name in IMPORTED), *((name, "--help") for name in COMMANDS)],
    ids=[*IMPORTED, *COMMANDS],
)
def test_until_it_is_there(benchmark, words):
    empty, numpy = (sys.executable, "-c", ""), (sys.executable, "-c", "import numpy")
    rows = []
    benchmark.pedantic(
        lambda: rows[-1].append(spent(run, *words)),
        setup=lambda: rows.append([spent(run, *empty), spent(run, *numpy)]),
        rounds=9,
    )
    alone, beyond = ([statistics.median(row[k][n] - row[0][n] for row in rows) for n in (0, 1)] for k in (1, 2))
    benchmark.extra_info["seconds beyond Python's own start (processor)"] = shown(*beyond)
    benchmark.extra_info["NumPy (processor)"] = shown(*alone)
    benchmark.extra_info["times NumPy"] = round(beyond[1] / alone[1], 2)


def test_kernels_of_an_analysis(benchmark, tmp_path, monkeypatch):
    """The README's analysis from an empty cache of kernels and from a full one; 8 and 1 s of processor are asked."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    analyze = ("cycloid-fmu", "analyze", EXAMPLES / "drive-39-40.toml", "--torque", "181 N*m")
    found = {}
    benchmark.pedantic(lambda: found.update(compiled=spent(run, *analyze)), rounds=1)
    bare = (sys.executable, "-c", "import numba, pydantic, typer")
    rows = [(spent(run, *analyze), spent(run, *bare)) for _ in range(5)]
    found["cached"], found["import numba, pydantic, typer"] = (
        min(each, key=lambda one: one[1]) for each in zip(*rows, strict=True)
    )
    benchmark.extra_info.update({name: shown(*used) for name, used in found.items()})
    ratio = statistics.median(one[1] / other[1] for one, other in rows)
    benchmark.extra_info["cached, times these imports (processor)"] = round(ratio, 2)
