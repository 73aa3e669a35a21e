"""The command line end to end, across processes, and its messages on bad input."""

import contextlib
import os
import re
import select
import signal
import subprocess
import sys
import time
from pathlib import Path

import can
import numpy as np
import pytest

from cycloid_fmu import edge
from drivers.can.bus import open_bus
from drivers.lines import BusConfig
from drivers.recorder.bench import read_bench
from drivers.recording_format import read_recording
from drivers.simulated.buses import SimulatedCan
from drivers.simulated.can_bench import SimulatedCanBench
from drivers.simulated.motion import SimulatedRun, fmu_output_angle, simulate_motion

ROOT = Path(__file__).parents[2]
QUICK = Path(__file__).parent / "quick"
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join([str(ROOT), str(QUICK), os.environ.get("PYTHONPATH", "")])}
# One per process: benches of two workers must not receive each other's frames.
GROUP = f"239.74.{os.getpid() // 256 % 256}.{os.getpid() % 256}"


def start(folder, *arguments):
    return subprocess.Popen(
        [sys.executable, "-m", "drivers.cli", *map(str, arguments)],
        cwd=folder,
        env=ENVIRONMENT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def run(folder, *arguments):
    process = start(folder, *arguments)
    out, err = process.communicate(timeout=120)
    return process.returncode, out, err


def line_of(stream, seconds):
    """Return the next line that a process prints."""
    ready, _, _ = select.select([stream], [], [], seconds)
    assert ready, f"nothing said for {seconds} s"
    return stream.readline()


def filled(path, samples, seconds):
    """Wait until a recording that still grows has more than so many samples of each channel."""
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        if path.exists():
            # A header that is half written is refused until it is whole.
            with contextlib.suppress(ValueError):
                channels = read_recording(path).samples
                if channels and min(map(len, channels.values())) > samples:
                    return
        time.sleep(0.01)
    pytest.fail(f"{path.name} did not have more than {samples} samples of each channel in {seconds} s")


def multicast_works():
    try:
        config = BusConfig(interface="loopback", channel=GROUP)
        with open_bus(config) as one, open_bus(config) as other:
            one.send(can.Message(arbitration_id=1, is_extended_id=False))
            return other.recv(1.0) is not None
    except Exception:
        return False


needs_multicast = pytest.mark.skipif(not multicast_works(), reason="this machine's network carries no UDP multicast")


@pytest.mark.system
def test_simulate_record_export(tmp_path, command):
    simulated = command(
        "cycloid-bench",
        "simulate",
        "--ratio",
        "-39",
        "--torque",
        "-20 N*m",
        "--turns",
        2,
        "--direction",
        "backward",
        "--noise",
        "0.3 arcsec",
        "-o",
        "run.arrows",
    )
    assert simulated.returncode == 0, simulated.stderr
    assert "192 input_angle, 192 output_angle, 192 torque; 0 events" in simulated.stdout
    exported = command("cycloid-bench", "export", "run.arrows", "-o", "run.csv")
    assert (exported.returncode, exported.stdout) == (0, "run.csv: 192 rows\n"), exported.stderr
    lines = (tmp_path / "run.csv").read_text().splitlines()
    assert lines[0] == "time [s],input_angle [rad],output_angle [rad],torque [N*m]"
    time_s, angle, output, torque = np.loadtxt(lines[1:], delimiter=",").T
    assert time_s[0] == 0
    assert np.all(np.diff(angle) < 0)
    np.testing.assert_allclose(output, -angle / 39, atol=1e-5)
    np.testing.assert_allclose(torque, -20, atol=1e-3)


@pytest.mark.system
@needs_multicast
def test_a_bench_in_another_process_is_recorded_without_loss(tmp_path):
    (tmp_path / "bus.toml").write_text(f'format = "cycloid-simulation/1"\n[can]\nchannel = "{GROUP}"\n')
    words = ("--ratio", "-39", "--torque", "20 N*m", "--turns", 20, "--bus", "bus.toml")
    simulation = start(tmp_path, "simulate", *words)
    assert "BENCH.toml" in line_of(simulation.stderr, 60)
    code, out, err = run(tmp_path, "record", "BENCH.toml", "-o", "run.arrows", "--idle", "3 s")
    simulation.communicate(timeout=60)
    assert code == edge.NO_DATA, err
    assert "It ended because no more samples arrived." in err
    assert simulation.returncode == 0
    assert "1920 input_angle, 1920 output_angle, 1920 torque; 0 events" in out
    samples = read_recording(tmp_path / "run.arrows").samples
    np.testing.assert_array_equal(samples["input_angle"].time_host, samples["output_angle"].time_host)
    np.testing.assert_allclose(np.diff(samples["input_angle"].value), 2 * np.pi / 96, atol=4e-6)


@pytest.mark.system
@needs_multicast
@pytest.mark.parametrize(
    ("number", "code"),
    [
        (signal.SIGINT, 130),
        pytest.param(signal.SIGTERM, 143, marks=pytest.mark.slow(3)),
        pytest.param(signal.SIGHUP, 129, marks=pytest.mark.slow(3)),
        (signal.SIGKILL, -9),
    ],
)
def test_an_interrupted_recorder_keeps_its_samples(tmp_path, number, code):
    motion = simulate_motion(lambda angle, torque: -angle / 39, SimulatedRun(torque=20.0, turns=2000))
    path = tmp_path / "run.arrows"
    with SimulatedCanBench(motion, SimulatedCan(interface="loopback", channel=GROUP, speed_factor=5)) as bench:
        bench.write_wiring(tmp_path / "BENCH.toml", ratio=-39)
        recorder = start(tmp_path, "record", "BENCH.toml", "-o", path)
        filled(path, 20, 60)
        recorder.send_signal(number)
        out, err = recorder.communicate(timeout=60)
    assert recorder.returncode == code, err
    if code > 0:
        assert f"Interrupted by {number.name}; {path} has all data up to then." in err
        told = {name: int(n) for n, name in re.findall(r"(\d+) (\w+)[,;]", out.splitlines()[0])}
        assert told == {name: len(s) for name, s in read_recording(path).samples.items()}
    recording = read_recording(path)
    assert "Traceback" not in err
    assert len(recording.problems) == (number == signal.SIGKILL)
    for samples in recording.samples.values():
        assert len(samples) > 20
    np.testing.assert_allclose(np.diff(recording.samples["input_angle"].value), 2 * np.pi / 96, atol=4e-6)


@pytest.mark.system
def test_an_fmu_drives_the_bench(tmp_path):
    (tmp_path / "gear.py").write_text(GEAR)
    subprocess.run([sys.executable, "-m", "pythonfmu", "build", "-f", "gear.py"], cwd=tmp_path, check=True)
    run_of = SimulatedRun(torque=20.0, turns=1, samples_per_turn=24)
    motion = simulate_motion(fmu_output_angle(tmp_path / "Gear.fmu"), run_of)
    np.testing.assert_allclose(motion.output_angle, -motion.input_angle / 39 + 20e-6, atol=1e-15)


GEAR = """
from pythonfmu import Fmi2Causality, Fmi2Slave, Real


class Gear(Fmi2Slave):
    def __init__(self, **options):
        super().__init__(**options)
        self.angle = self.torque = self.output = 0.0
        for name, attribute, causality in (
            ("flange_a.phi", "angle", Fmi2Causality.input),
            ("flange_b.tau", "torque", Fmi2Causality.input),
            ("flange_b.phi", "output", Fmi2Causality.output),
        ):
            self.register_variable(Real(
                name, causality=causality,
                getter=lambda a=attribute: getattr(self, a), setter=lambda v, a=attribute: setattr(self, a, v),
            ))

    def do_step(self, current_time, step_size):
        self.output = -self.angle / 39 + 1e-6 * self.torque
        return True
"""


@pytest.fixture
def wiring(tmp_path, bus_name):
    motion = simulate_motion(lambda angle, torque: -angle / 39, SimulatedRun(torque=20.0, turns=1))
    return SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name)).write_wiring(
        tmp_path / "BENCH.toml", ratio=-39
    )


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"cycloid-bench/1"', '"cycloid-bench/2"', r'format = "cycloid-bench/2": this version reads "cycloid-bench/1"'),
        ('format = "cycloid-bench/1"\n', "", "format is missing"),
        ("ratio = -39.0", "ratio = 0", "ratio = 0: write the signed ratio"),
        ("ratio = -39.0", "ration = -39.0", "ration is not a known key"),
        ('load = "20 N*m"', 'load = "20 parsec"', r'\[conditions\] load = "20 parsec": the unit "parsec" measures'),
        ('load = "20 N*m"', "load = 20", r"\[conditions\] load = 20: write one number"),
        ('protocol = "canopen"', 'protocol = "carrier pigeon"', r'protocol = "carrier pigeon": no such protocol is'),
        ('protocol = "dbc"\n', "", r"\[channel.torque\] protocol is missing"),
        ('bus = "can0"\nnode = 1', 'bus = "can7"\nnode = 1', r'\[channel.input_angle\] bus = "can7": there is no'),
        ("node = 1", "node = 128", r"\[channel.input_angle\]: node = 128: it should be less than or equal to 127"),
        ("node = 1", "nodes = 1", r"\[channel.input_angle\]: node is missing"),
        ("node = 1", "node = 1\ncolour = 3", r"\[channel.input_angle\]: colour is not a known key"),
        ("node = 1", 'node = 1\nzero = "3 mm"', r'\[channel.input_angle\]: zero = "3 mm": the unit "mm" measures'),
        ("node = 1", "node = 1\ndirection = 0", r"\[channel.input_angle\]: direction = 0: it should be 1 or -1"),
        ('signal = "torque"', 'signal = "force"', r'\[channel.torque\] signal = "force": .* it has torque'),
        ('message = "torque"', 'message = "force"', r'\[channel.torque\] message = "force": .* has no such message'),
        ('file = "torque.dbc"', 'file = "none.dbc"', r"none.dbc: No such file"),
        ('signal = "torque"', 'signal = "torque"\nunit = "mm"', r'unit = "mm": the unit "mm" measures'),
        ("[bus.can0]", "[bus.can0]\nbitrate = -1", r"\[bus.can0\] bitrate = -1: it should be greater than 0"),
        ("[bus.can0]", "[bus.can0", "this is not TOML"),
    ],
)
def test_bad_wiring_is_refused_in_a_sentence_that_names_file_and_field(wiring, old, new, said):
    text = wiring.read_text()
    assert old in text
    wiring.write_text(text.replace(old, new, 1))
    with pytest.raises(edge.InputError) as problem:
        read_bench(wiring)
    first = str(problem.value).splitlines()[0]
    assert re.search(said, first), first
    assert str(wiring.parent) in first
    assert first.endswith((".", "?"))


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["record", "none.toml", "-o", "run.arrows"], "none.toml: No such file or directory."),
        (["record", "BENCH.toml", "-o", "run.arrows", "--idle", "2"], '--idle = "2": write one number'),
        (["record", "BENCH.toml", "-o", "BENCH.toml"], "--output = BENCH.toml: the name must end in .arrows."),
        (["simulate", "--torque", "20 N*m"], "--ratio is missing"),
        (["simulate", "--ratio", "-39"], "--torque is missing; give it: only a drive's FMU states a rated_torque."),
        (["simulate", "--torque", "20 mm", "--ratio", "-39"], '--torque = "20 mm": the unit "mm" measures'),
        (
            ["simulate", "--torque", "20 N*m", "--ratio", "-39", "--bus", "virtual.toml"],
            'virtual.toml: [can] interface = "virtual": other processes cannot reach it',
        ),
        (["simulate", "--torque", "20 N*m", "--fmu", "BENCH.toml"], "cycloid-bench record; an FMU is needed here."),
        (["export", "BENCH.toml", "-o", "run.csv"], "cycloid-bench record; a recording is needed here."),
        (["export", "run.arrows", "-o", "run.xls"], "--output = run.xls: the name must end in .csv"),
    ],
)
def test_bad_input_exits_2_with_one_sentence(command, wiring, arguments, said):
    before = wiring.read_text()
    wiring.with_name("virtual.toml").write_text('format = "cycloid-simulation/1"\n[can]\ninterface = "virtual"\n')
    done = command("cycloid-bench", *arguments)
    assert done.returncode == 2
    assert said in done.stderr
    assert done.stdout == ""
    assert "Traceback" not in done.stderr
    assert wiring.read_text() == before


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('"virtual"', '"socketcan"', 'The CAN bus socketcan "'),
        ("node = 2", "node = 1", "The position of node 1 on the CAN bus"),
        ("node = 1", "node = 1\ncounts_per_turn = 1000", "counts_per_turn = 1000 contradicts the device"),
        (
            "[bus.can0]",
            '[port.p]\nurl = "/dev/none"\n[bus.can0]',
            'The serial port "/dev/none" does not open: there is no',
        ),
    ],
)
def test_an_impossible_bench_is_refused_and_records_nothing(tmp_path, wiring, bus_name, old, new, said):
    text = wiring.read_text().replace(old, new, 1)
    if "/dev/none" in new:
        text = text.replace(
            'protocol = "canopen"\nbus = "can0"\nnode = 1\nsigned = true', 'protocol = "amt21"\nport = "p"'
        )
    wiring.write_text(text)
    from drivers.recorder.session import record

    motion = simulate_motion(lambda angle, torque: -angle / 39, SimulatedRun(torque=20.0, turns=1))
    with (
        SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name)),
        pytest.raises(edge.InputError) as problem,
    ):
        record(wiring, tmp_path / "run.arrows")
    assert said in str(problem.value)
    assert "\n" not in str(problem.value)
    assert not (tmp_path / "run.arrows").exists()


def test_permission_denied_is_reported_in_one_sentence(monkeypatch):
    from drivers.encoder import EncoderSetupError
    from drivers.lines import PortConfig
    from drivers.serial import port as serial_port

    def refuse(*_, **__):
        raise PermissionError(13, "could not open port: [Errno 13] Permission denied: '/dev/ttyUSB0'")

    monkeypatch.setattr(serial_port.serial, "serial_for_url", refuse)
    with pytest.raises(EncoderSetupError, match=r'The serial port "/dev/ttyUSB0" does not open: permission denied\.'):
        serial_port.ports.acquire(PortConfig(url="/dev/ttyUSB0"))


def test_list_names_the_protocols(command):
    done = command("cycloid-bench", "list")
    assert done.returncode == 0, done.stderr
    assert "protocols: amt21, ascii, canopen, dbc, modbus, moteus, odrive, simplefoc" in done.stdout
