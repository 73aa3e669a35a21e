"""One recording or run at a time uses a bus or port, until its process has ended."""

import os
import subprocess
import sys
import threading
import time
from concurrent import futures
from pathlib import Path

import pytest

import drivers
from cycloid_fmu import edge
from drivers.encoder import EncoderSetupError
from drivers.recorder import in_use
from drivers.recorder.bench import read_bench
from drivers.recorder.in_use import Claims
from drivers.simulated.buses import SimulatedCan
from drivers.simulated.can_bench import SimulatedCanBench
from drivers.simulated.motion import SimulatedRun, simulate_motion
from tests.drivers.test_bench_cli import ENVIRONMENT, needs_multicast

pytestmark = pytest.mark.system


ROOT = str(Path(__file__).parents[2])


def until(condition, seconds=20.0):
    """Wait until a result is true, and return it."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "it never came"
        time.sleep(0.02)
    return found


@pytest.fixture
def bench(tmp_path, bus_name):
    """A bench on a virtual bus with nodes not started; its wiring is in the folder."""
    motion = simulate_motion(lambda angle, torque: angle / -39, SimulatedRun(torque=20.0, turns=200))
    made = SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name, speed_factor=1.0))
    made.write_wiring(tmp_path / "BENCH.toml", ratio=-39)
    with made:
        yield made


@pytest.mark.skipif(os.name != "posix", reason="kills by number")
def test_a_bus_is_claimed_by_one_run_until_its_process_has_ended(tmp_path, bench, monkeypatch):
    monkeypatch.setattr(in_use, "WAIT_SECONDS", 0.2)
    text = (tmp_path / "BENCH.toml").read_text().replace('"virtual"', '"socketcan"')
    (tmp_path / "BENCH.toml").write_text(text)
    wiring = read_bench(tmp_path / "BENCH.toml").wiring
    text = f"""
import sys, time
from drivers.recorder.bench import read_bench
from drivers.recorder.in_use import Claims
with Claims() as claims:
    claims.claim(read_bench({str(tmp_path / "BENCH.toml")!r}).wiring)
    print("claimed", flush=True)
    time.sleep(600)
"""
    other = subprocess.Popen([sys.executable, "-c", text], stdout=subprocess.PIPE, cwd=ROOT, env=ENVIRONMENT)
    assert other.stdout.readline() == b"claimed\n"
    with Claims() as claims, pytest.raises(EncoderSetupError, match=f"recording or run, process {other.pid}; "):
        claims.claim(wiring)
    other.kill()
    other.wait()
    other.stdout.close()
    with Claims() as claims:
        claims.claim(wiring)
        claims.claim(wiring)


@needs_multicast
def test_a_second_recording_of_a_bus_is_refused_and_the_first_one_stays_whole(tmp_path, monkeypatch):
    monkeypatch.setattr(in_use, "WAIT_SECONDS", 0.2)
    made = drivers.simulate_bench(ratio=-39, torque=20.0, turns=20, bus=SimulatedCan(speed_factor=1.0))
    with made, futures.ThreadPoolExecutor(1) as threads:
        wiring, path = made.write_wiring(tmp_path / "BENCH.toml"), tmp_path / "first.arrows"
        refused = threading.Event()
        first = threads.submit(drivers.record, wiring, path, stop=refused.is_set)
        until(lambda: path.exists() or first.done())
        with pytest.raises(EncoderSetupError, match=r"loopback .* is in use by another recording or run, process"):
            drivers.record(wiring, tmp_path / "second.arrows", duration=0.5)
        time.sleep(0.3)
        refused.set()
        done = first.result()
    assert min(done.samples.values()) > 20
    assert (done.events, done.failures) == (0, ())
    assert not (tmp_path / "second.arrows").exists()


def test_without_a_folder_for_locks_a_recording_says_that_nothing_is_reserved(tmp_path, monkeypatch, bench):
    text = (tmp_path / "BENCH.toml").read_text().replace('"virtual"', '"socketcan"')
    (tmp_path / "BENCH.toml").write_text(text)
    (tmp_path / "file").write_text("")
    monkeypatch.setattr("platformdirs.user_cache_dir", lambda *_, **__: str(tmp_path / "file"))
    with Claims() as claims, pytest.warns(edge.InputWarning, match="another recording of the same CAN bus .* is not"):
        claims.claim(read_bench(tmp_path / "BENCH.toml").wiring)
