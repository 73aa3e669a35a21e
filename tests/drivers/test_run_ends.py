"""A killed run leaves no device moving and no process; the next run detects a bench that is in use."""

import itertools
import os
import pty
import signal
import subprocess
import sys
import threading
import time
from concurrent import futures
from pathlib import Path

import can
import pytest

import drivers
from cycloid_fmu import edge
from drivers.encoder import EncoderSetupError
from drivers.recorder import in_use
from drivers.recorder.bench import read_bench
from drivers.recorder.in_use import Claims, check_at_rest
from drivers.recorder.sequence import run_sequence
from drivers.recorder.watchdog import watched
from drivers.simulated.can_bench import SimulatedCanBench
from drivers.simulated.motion import SimulatedRun, simulate_motion
from tests.drivers.test_bench_cli import ENVIRONMENT, needs_multicast
from tests.drivers.test_sequence import SEQUENCE, drive

ROOT = str(Path(__file__).parents[2])
numbers = itertools.count(150)
needs_processes = pytest.mark.skipif(not Path("/proc/self/cmdline").exists(), reason="processes are listed by Linux")

DRIVE = """
import pathlib, signal, subprocess, sys, time
subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)", "MARK"])
signal.signal(signal.SIGTERM, signal.SIG_IGN)
pathlib.Path("started").touch()
time.sleep(600)
"""
STOP = "import pathlib; pathlib.Path('stopped').touch()"


def until(condition, seconds=20.0):
    """Wait until a result is true, and return it."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "it never came"
        time.sleep(0.02)
    return found


def processes(mark):
    """Return the ids of the processes with a text in their command."""
    found = []
    for path in Path("/proc").glob("[0-9]*/cmdline"):
        try:
            if mark.encode() in path.read_bytes() and int(path.parent.name) != os.getpid():
                found.append(int(path.parent.name))
        except OSError:
            pass
    return found


def starter(folder, mark):
    """Return a process that runs a drive command which ignores SIGTERM and has a child process, and waits."""
    (folder / "drive.py").write_text(DRIVE.replace("MARK", mark))
    text = f"""
import pathlib, sys, time
from drivers.recorder.watchdog import watched
stop = [sys.executable, "-c", {STOP!r}]
with watched([sys.executable, "drive.py", {mark!r}], folder=pathlib.Path({str(folder)!r}), stop=stop):
    time.sleep(600)
"""
    return subprocess.Popen([sys.executable, "-c", text], cwd=ROOT)


@needs_processes
@pytest.mark.parametrize(
    ("number", "whom"),
    [
        (signal.SIGKILL, "starter"),
        pytest.param(signal.SIGTERM, "starter", marks=pytest.mark.slow(4)),
        pytest.param(signal.SIGHUP, "starter", marks=pytest.mark.slow(4)),
        pytest.param(signal.SIGKILL, "command", marks=pytest.mark.slow(4)),
    ],
)
def test_a_command_does_not_outlive_its_starter(tmp_path, number, whom, monkeypatch):
    mark = f"mark-{os.getpid()}-{next(numbers)}"
    process = starter(tmp_path, mark)
    until((tmp_path / "started").exists)
    if whom == "starter":
        process.send_signal(number)
    else:
        commands = [n for n in processes(mark) if b"drive.py" in Path(f"/proc/{n}/cmdline").read_bytes()]
        for command in commands:
            if b"-c" not in Path(f"/proc/{command}/cmdline").read_bytes().split(b"\0"):
                os.kill(command, number)
    until((tmp_path / "stopped").exists)
    if whom == "command":
        process.kill()
    process.wait()
    until(lambda: not processes(mark))


@needs_processes
def test_a_killed_watchdog_ends_the_command(tmp_path):
    mark = f"mark-{os.getpid()}-{next(numbers)}"
    (tmp_path / "drive.py").write_text(DRIVE.replace("MARK", mark))
    with watched([sys.executable, "drive.py", mark], folder=tmp_path) as process:
        until((tmp_path / "started").exists)
        process.kill()
        process.wait()
    until(lambda: not processes(mark))


def test_a_command_that_ends_normally_has_its_status_and_needs_no_stop(tmp_path):
    stop = [sys.executable, "-c", STOP]
    for status in (0, 3):
        with watched([sys.executable, "-c", f"raise SystemExit({status})"], folder=tmp_path, stop=stop) as process:
            assert process.wait() == status
        assert (tmp_path / "stopped").exists() == (status != 0)
    for name, problem in (("no-such-program", FileNotFoundError), ("./", PermissionError)):
        with pytest.raises(problem), watched([name], folder=tmp_path):
            pass


@pytest.fixture
def bench(tmp_path, bus_name):
    """A bench on a virtual bus with nodes not started; its wiring is in the folder."""
    motion = simulate_motion(lambda angle, torque: angle / -39, SimulatedRun(torque=20.0, turns=200))
    made = SimulatedCanBench(motion, channel=bus_name, speed_factor=1.0)
    made.write_wiring(tmp_path / "BENCH.toml", ratio=-39)
    with made:
        yield made


def told(bus_name, command):
    """Send an NMT command to all nodes of a virtual bus."""
    with can.Bus(interface="virtual", channel=bus_name) as bus:
        bus.send(can.Message(arbitration_id=0, data=[command, 0], is_extended_id=False))


def test_a_bench_that_moves_before_its_command_is_started_is_in_use(tmp_path, bus_name, bench):
    wiring = read_bench(tmp_path / "BENCH.toml").wiring
    nodes = {"can0": {1, 2}}
    check_at_rest(wiring, nodes)
    told(bus_name, 1)
    until(lambda: bench.sent > 5)
    with pytest.raises(
        EncoderSetupError, match=r"is in use: node 1 moves before the command of this step was started;"
    ):
        check_at_rest(wiring, nodes)
    (tmp_path / "sequence.toml").write_text(
        SEQUENCE + f"[drive]\nrun = \"'{sys.executable}' -c 'import pathlib; pathlib.Path(chr(120)).touch()'\"\n"
    )
    with pytest.raises(EncoderSetupError, match="is in use"):
        run_sequence(tmp_path / "sequence.toml")
    assert not (tmp_path / "x").exists(), "its own command is not started"
    assert not list(tmp_path.glob("*.arrows"))
    for _, encoder in enumerate(read_bench(tmp_path / "BENCH.toml").encoders()):
        encoder.rest()
    until(lambda: not any(bench._operational()))
    check_at_rest(wiring, nodes)


def test_sync_from_another_device_is_another_master(tmp_path, bus_name, bench):
    text = (tmp_path / "BENCH.toml").read_text().replace("[bus.can0]\n", '[bus.can0]\nsync_period = "10 ms"\n')
    (tmp_path / "BENCH.toml").write_text(text)
    told(bus_name, 1)
    until(lambda: bench.sent > 5)
    with pytest.raises(EncoderSetupError, match="another device sends SYNC, which the recorder is to send"):
        check_at_rest(read_bench(tmp_path / "BENCH.toml").wiring, {})


@pytest.mark.skipif(os.name != "posix", reason="kills by number")
def test_a_bus_is_claimed_by_one_run_until_its_last_process_has_ended(tmp_path, bench, monkeypatch):
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
        assert len(claims.descriptors) == 1


@needs_multicast
def test_a_second_recording_of_a_bus_is_refused_and_the_first_one_stays_whole(tmp_path, monkeypatch):
    monkeypatch.setattr(in_use, "WAIT_SECONDS", 0.2)
    made = drivers.simulate_bench(
        ratio=-39, torque=20.0, turns=20, connection=drivers.SimulatedConnection(speed_factor=1.0)
    )
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


@needs_multicast
@needs_processes
@pytest.mark.slow(40)
@pytest.mark.parametrize("end", ["SIGKILL", "SIGTERM", "SIGHUP", "terminal", "watchdog", "command"])
def test_a_killed_run_leaves_nothing_moving_and_the_next_one_records(tmp_path, monkeypatch, end):
    monkeypatch.setenv("PYTHONPATH", ENVIRONMENT["PYTHONPATH"])
    group = f"239.75.{os.getpid() % 250}.{next(numbers)}"
    (tmp_path / "sequence.toml").write_text(
        SEQUENCE.replace("turns = 3", "turns = 8") + drive(group).replace("--turns 4", "--turns 40")
    )
    command = [sys.executable, "-m", "drivers.cli", "run", "sequence.toml"]
    main, terminal = pty.openpty()
    process = subprocess.Popen(
        command,
        cwd=tmp_path,
        stdin=terminal,
        stdout=terminal,
        stderr=terminal,
        start_new_session=True,
        preexec_fn=lambda: __import__("fcntl").ioctl(0, __import__("termios").TIOCSCTTY, 0),
    )
    os.close(terminal)
    until(lambda: any(path.stat().st_size > 20_000 for path in tmp_path.glob("*.arrows")))
    drives = processes(group)
    assert drives
    if end == "terminal":
        os.close(main)
    elif end == "watchdog":
        for number in processes("drivers.recorder.watchdog"):
            if os.getpgid(number) in map(os.getpgid, drives):
                os.kill(number, signal.SIGKILL)
                process.kill()
    elif end == "command":
        for number in drives:
            os.kill(number, signal.SIGKILL)
        process.kill()
    else:
        os.kill(process.pid, getattr(signal, end))
    process.wait(30)
    if end != "terminal":
        os.close(main)
    if end != "watchdog":  # if both are killed at once, the drive command remains
        until(lambda: not processes(group))
    kept = sorted(tmp_path.glob("*.trial-1.arrows"))
    assert kept
    sequence = tmp_path / "sequence.toml"
    sequence.write_text(sequence.read_text().replace("turns = 8", "turns = 2"))
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, timeout=120, check=False)
    if end == "watchdog":
        assert done.returncode == 2
        assert "is in use: node " in done.stderr
        for number in processes(group):
            os.kill(number, signal.SIGKILL)
        return
    assert done.returncode == 0, done.stderr
    assert done.stdout.count("recorded") == 3
