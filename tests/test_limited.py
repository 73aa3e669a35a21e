"""Parsers in a process with limits: what they compute, and what ends them."""

import itertools
import math
import os
import re
import signal
import subprocess
import sys
import time

import hostile
import psutil
import pytest

from cycloid_fmu import edge
from cycloid_fmu.edge import limited
from fitting.readers.inspection import inspect
from tests.fitting.test_readers import DBC
from tests.test_damaged_files import SMALL, can_log, mdf, sensor, surface

pytestmark = pytest.mark.system


HERE = __file__


@pytest.fixture
def short(monkeypatch):
    monkeypatch.setattr(limited, "_SECONDS", 2.0)


def test_a_function_computes_as_in_this_process(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert edge.call_limited(HERE, math.lgamma, 7.5) == math.lgamma(7.5)
    assert edge.call_limited(HERE, os.getcwd) == str(tmp_path)
    with pytest.raises(RuntimeError, match=r"^invalid literal for int\(\) with base 10: 'x'"):
        edge.call_limited(HERE, int, "x")
    with pytest.raises(edge.InputError, match=r"^none.toml: No such file or directory\.$"):
        edge.call_limited(HERE, edge.read_text, "none.toml")


def test_a_generator_s_results_come_in_order_and_as_far_as_wanted(tmp_path):
    for name in "abc":
        (tmp_path / "a" / name).mkdir(parents=True)
    assert list(edge.each_limited(HERE, os.walk, str(tmp_path))) == list(os.walk(tmp_path))
    before = edge.call_limited(HERE, os.getpid)
    for wanted in range(1, 6):
        walked = edge.each_limited(HERE, os.walk, str(tmp_path))
        assert len(list(itertools.islice(walked, wanted))) == wanted
        walked.close()
        assert edge.call_limited(HERE, os.getpid) == before, "the process is kept for the next file"
    assert before != os.getpid()


ENDLESS = {
    "time": (sum, itertools.repeat(1), "takes more than 1 s of processor time"),
    "memory": (list, itertools.repeat(1), "takes more than 0.6 GB of memory"),
}


@pytest.mark.parametrize("limit", ENDLESS)
def test_what_has_no_end_is_ended(monkeypatch, limit):
    monkeypatch.setattr(limited, "_SECONDS", 1.0 if limit == "time" else 60.0)
    monkeypatch.setattr(limited, "_BYTES", 600 << 20 if limit == "memory" else 4 << 30)
    function, argument, said = ENDLESS[limit]
    before = edge.call_limited(HERE, os.getpid)
    with pytest.raises(edge.InputError) as refused:
        edge.call_limited(HERE, function, argument)
    assert str(refused.value) == f"{HERE}: this file is damaged or too complex: reading it {said}."
    assert not psutil.pid_exists(before)
    assert edge.call_limited(HERE, os.getpid) != before


def test_a_crash_is_one_sentence():
    with pytest.raises(edge.InputError, match=r"test_limited.py: .* reading it ends the process that reads it \(") as e:
        edge.call_limited(HERE, os.abort)
    assert "\n" not in str(e.value)
    worker = edge.call_limited(HERE, os.getpid)
    os.kill(worker, signal.SIGKILL)  # while it is idle: the next file is read by another one
    psutil.wait_procs([psutil.Process(worker)], timeout=10)
    assert edge.call_limited(HERE, os.getpid) != worker


def test_a_small_file_has_three_seconds_and_large_ones_more_time_and_memory(tmp_path):
    """A busy machine takes several times the processor time, and a user waits for no more than 20 s."""
    assert limited.limits_of(HERE).seconds < 3.5
    with (tmp_path / "vehicle.dbc").open("wb") as file:
        file.truncate(10**6)
    assert limited.limits_of(tmp_path / "vehicle.dbc").seconds > 10.0
    assert limited.limits_of(HERE).memory < 1.1e9
    with (tmp_path / "large").open("wb") as file:
        file.truncate(10**9)
    seconds, memory = limited.limits_of(tmp_path / "large")
    assert seconds > 120.0
    assert memory > 4e9


@pytest.mark.skipif(not hasattr(os, "fork"), reason="needs fork")
def test_a_forked_process_has_a_reader_of_its_own():
    worker = edge.call_limited(HERE, os.getpid)
    code = (
        "import os; from cycloid_fmu import edge\n"
        f"own = edge.call_limited({HERE!r}, os.getpid); child = os.fork()\n"
        f"other = edge.call_limited({HERE!r}, os.getpid)\n"
        "if child: os.waitpid(child, 0)\n"
        "print(bool(child), own == other, flush=True)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert sorted(done.stdout.split("\n")) == ["", "False False", "True True"], done.stderr
    assert edge.call_limited(HERE, os.getpid) == worker


@pytest.mark.skipif(os.name == "nt", reason="needs signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_reader_ends_with_the_process_that_it_reads_for(number):
    """Ctrl-C reaches both processes; after SIGKILL nobody is left to watch the reader, which ends itself."""
    code = (
        "import itertools, os; from cycloid_fmu import edge; from cycloid_fmu.edge import limited\n"
        "limited._SECONDS = 0.5\n"
        f"print(edge.call_limited({HERE!r}, os.getpid), flush=True)\n"
        f"edge.call_limited({HERE!r}, sum, itertools.repeat(1))"
    )
    asking = subprocess.Popen(
        [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True
    )
    reader = psutil.Process(int(asking.stdout.readline()))
    time.sleep(0.3)
    os.killpg(asking.pid, number) if number == signal.SIGINT else asking.kill()
    asking.communicate(timeout=30)
    psutil.wait_procs([reader], timeout=30)
    assert not reader.is_running() or reader.status() == psutil.STATUS_ZOMBIE


# --- files --------------------------------------------------------------------------------------------------------


def hostile_file(make, change, folder):
    path = make(folder)
    path.write_bytes(change(path.read_bytes()))
    return path


@pytest.mark.usefixtures("short")
def test_a_log_s_dbc_with_an_endless_signal_is_named(tmp_path):
    log = can_log(".asc")(tmp_path)
    (tmp_path / "bench.dbc").write_bytes(hostile.endless_signal(DBC.encode()))
    with pytest.raises(edge.InputError, match=r"bench\.dbc: this file is damaged or too complex"):
        inspect(log, tmp_path / "bench.dbc")


@pytest.mark.usefixtures("short")
def test_commands_refuse_files_that_would_stop_them(tmp_path, command):
    (tmp_path / "pair.toml").write_text(SMALL.text)
    hostile_file(surface, hostile.far_member, tmp_path)
    hostile_file(mdf("4.10", 0), hostile.self_linked_group, tmp_path)
    wiring = sensor(tmp_path)
    dbc = wiring.with_name("bench.dbc")
    dbc.write_bytes(hostile.endless_signal(dbc.read_bytes()))
    for name, words in {
        "made.nc": ("cycloid-fmu", "analyze", "pair.toml", "--surface", "made.nc", "--torque", "20 N*m"),
        "run.mf4": ("cycloid-fit", "inspect", "run.mf4"),
        "bench.dbc": ("cycloid-bench", "record", "BENCH.toml", "-o", "run.arrows"),
    }.items():
        done = command(*words)
        assert (done.returncode, done.stdout) == (2, ""), name
        assert done.stderr.count("\n") == 1
        assert re.search(f"{name}: this .* damaged", done.stderr)


@pytest.mark.slow(25)
@pytest.mark.usefixtures("short")
@pytest.mark.parametrize("compression", [0, 2])
def test_mdf_files_whose_blocks_lead_to_themselves(tmp_path, compression):
    path = mdf("4.10", compression)(tmp_path)
    said = []
    for data in hostile.self_links(path.read_bytes()):
        path.write_bytes(data)
        try:
            inspect(path)
        except edge.InputError as refused:
            said.append(str(refused))
    assert all(path.name in one and "\n" not in one for one in said)
    assert sum("takes more than" in one for one in said) >= 5
