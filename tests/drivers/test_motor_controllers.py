"""ODrive, moteus and SimpleFOC against simulators that send the bytes of their public documentation."""

import contextlib
import math
import os
import pty
import struct
import threading
import time
import tty

import can
import numpy as np
import pytest

import drivers
from cycloid_fmu import edge
from drivers.recorder.bench import read_bench
from drivers.recording_format import GAP

NODE, TURNS, SPEED, CURRENT = 3, 40.0, 7.5, -2.25


def wiring(path, lines, **channels):
    tables = "".join(f"[channel.{name}]\n{keys}\n" for name, keys in channels.items())
    path.write_text(f'format = "cycloid-bench/1"\nratio = -39.0\n{lines}\n{tables}')
    return path


@contextlib.contextmanager
def sending(step, period=0.002, *, late=False):
    """Call a function with its number at an interval, s; `late`: not the next ones sooner after a late one."""
    done = threading.Event()

    def run():
        begun, number = time.monotonic(), 0
        while not done.wait(period if late else max(0.0, begun + number * period - time.monotonic())):
            step(number)
            number += 1

    thread = threading.Thread(target=run)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()


@pytest.fixture
def odrive(tmp_path, bus_name):
    """A bench with an ODrive: Get_Encoder_Estimates 0x009, Get_Iq 0x014, Get_Torques 0x01C, float32 little-endian."""
    with can.Bus(interface="virtual", channel=bus_name, preserve_timestamps=True) as bus:

        def step(number):
            stamp = 1e6 + 0.002 * number  # as a controller sends, however busy this machine is
            for command, first, second in (
                (0x009, TURNS + number / 1024, SPEED),
                (0x014, 99.0, CURRENT),
                (0x01C, 99.0, 0.125 * CURRENT),
            ):
                for node in (NODE, NODE + 1):  # whose frames are not to be mixed up
                    data = struct.pack("<ff", first if node == NODE else 1e6, second if node == NODE else 1e6)
                    bus.send(can.Message(stamp, node << 5 | command, is_extended_id=False, data=data))

        with sending(step):
            yield tmp_path / "BENCH.toml", f'[bus.can0]\ninterface = "virtual"\nchannel = "{bus_name}"\n'


def odrive_keys(**keys):
    keys = {"protocol": "odrive", "bus": "can0", "node": NODE, **keys}
    return "\n".join(f"{k} = {edge.json_text(v)}" for k, v in keys.items())


def test_an_odrive_s_position_speed_and_torques_are_those_it_sends(tmp_path, odrive):
    path = wiring(
        *odrive,
        input_angle=odrive_keys(quantity="position", side="motor", zero="90 deg"),
        output_angle=odrive_keys(quantity="position", side="output", ratio=-1 / 39, direction=-1),
        motor_speed=odrive_keys(quantity="velocity", side="motor"),
        motor_torque=odrive_keys(quantity="torque", side="motor"),
        torque=odrive_keys(quantity="torque", side="output", ratio=-1 / 39, torque_constant="80 mN*m/A"),
    )
    done = drivers.record(path, tmp_path / "run.arrows", samples=100, duration=20.0)
    assert done.ended == "samples"
    recording = drivers.read_recording(done.path)
    samples = recording.samples
    turns = (samples["input_angle"].value + math.pi / 2) / (2 * math.pi)
    np.testing.assert_allclose(np.diff(turns), 1 / 1024, rtol=1e-6)  # exact in a float32
    assert turns[0] >= TURNS
    frames = samples["output_angle"].value * 39 / (2 * math.pi)
    assert np.isin(np.rint(frames * 1024), np.rint(turns * 1024)).mean() > 0.9
    assert samples["motor_speed"].value == pytest.approx(2 * math.pi * SPEED)
    assert samples["motor_torque"].value == pytest.approx(0.125 * CURRENT)
    # P = M w on both sides of an ideal drive: the torque grows as the speed falls, with the ratio's sign.
    assert samples["torque"].value == pytest.approx(-39 * 0.08 * CURRENT)
    assert {c.name: c.unit for c in recording.header.channels}["motor_speed"] == "rad/s"
    assert "node 3: torque of the output, current x 80 mN*m/A" in recording.header.channels[4].identity
    assert not any(s.status.any() for s in samples.values())


def lossy(send, lost):
    """Send numbered messages every 5 ms, except those lost."""

    def step(number):
        if number not in lost:
            send(number)

    return sending(step, 0.005)


LOST = {100, 101, 102, 160, 220, 221}


@pytest.mark.parametrize("period", [None, "5 ms"])
def test_lost_messages_of_an_odrive_are_counted_and_marked(tmp_path, bus_name, period):
    keys = {} if period is None else {"period": period}
    path = wiring(
        tmp_path / "BENCH.toml",
        f'[bus.can0]\ninterface = "virtual"\nchannel = "{bus_name}"\n',
        input_angle=odrive_keys(quantity="position", side="motor", **keys),
    )
    with can.Bus(interface="virtual", channel=bus_name, preserve_timestamps=True) as bus:

        def send(number):
            data = struct.pack("<ff", number / 1024, SPEED)
            stamp = 1e6 + 0.005 * number
            bus.send(can.Message(stamp, NODE << 5 | 9, is_extended_id=False, data=data))

        with lossy(send, LOST):
            done = drivers.record(path, tmp_path / "run.arrows", samples=280, duration=30.0)
    samples = drivers.read_recording(done.path).samples["input_angle"]
    numbers = np.rint(samples.value / (2 * math.pi) * 1024).astype(int)
    missing = np.diff(numbers) - 1
    assert missing.sum() == len([n for n in LOST if n > numbers[0]]) == done.lost["input_angle"]
    assert (samples.status[1:] & GAP > 0).tolist() == (missing > 0).tolist()


@pytest.mark.system
def test_an_odrive_that_is_not_set_up_to_send_is_one_sentence(tmp_path, bus_name):
    bus = f'[bus.can0]\ninterface = "virtual"\nchannel = "{bus_name}"\n'
    keys = odrive_keys(quantity="torque", side="motor")
    with pytest.raises(drivers.EncoderError, match=r"ODrive node 3 on the CAN bus virtual .* sends no Get_Torques"):
        drivers.record(wiring(tmp_path / "BENCH.toml", bus, motor_torque=keys), tmp_path / "a.arrows")


@contextlib.contextmanager
def moteus(bus_name, node, odd=(), *, interface="virtual"):
    """A controller that replies to reads of float32 registers from 0x001 on, as the multiplex protocol states it."""
    registers = {1: TURNS, 2: SPEED, 3: 0.125 * CURRENT, 4: CURRENT}
    queries, done = [], threading.Event()

    def run():
        while not done.is_set():
            asked = bus.recv(0.05)
            if asked is None or asked.arbitration_id != 0x8000 | node or not asked.is_fd:
                continue
            command, count, first = asked.data  # 0x1c: read float32, the count follows
            assert command == 0x1C
            queries.append(time.monotonic())
            values = [registers[first + i] + (len(queries) / 1024 if first + i == 1 else 0.0) for i in range(count)]
            data = bytes([0x2C, count, first]) + struct.pack(f"<{count}f", *values) + b"\x50"
            if 100 <= len(queries) < 150:
                continue  # its cable is loose
            if len(queries) in odd:
                data = b"\x31" + data[1:]  # an error of a read
            bus.send(can.Message(arbitration_id=node << 8, is_extended_id=node > 7, is_fd=True, data=data))

    with can.Bus(interface=interface, channel=bus_name, fd=True) as bus:
        thread = threading.Thread(target=run)
        thread.start()
        try:
            yield queries
        finally:
            done.set()
            thread.join()


@pytest.mark.parametrize("node", [1, 11])
def test_a_moteus_is_queried_once_for_all_its_channels(tmp_path, bus_name, node):
    def keys(**more):
        return odrive_keys(protocol="moteus", node=node, **more)

    path = wiring(
        tmp_path / "BENCH.toml",
        f'[bus.can0]\ninterface = "virtual"\nchannel = "{bus_name}"\nfd = true\n',
        input_angle=keys(quantity="position", side="motor", ratio=-39),  # set up to state the output
        output_angle=keys(quantity="position", side="output"),
        motor_torque=keys(quantity="torque", side="motor", ratio=-39),
        torque=keys(quantity="torque", side="output", torque_constant="0.2 N*m/A"),
    )
    with moteus(bus_name, node, odd={60}) as queries:
        begun = time.monotonic()
        done = drivers.record(path, tmp_path / "run.arrows", samples=200, duration=30.0)
        rate = len(queries) / (time.monotonic() - begun)
    assert done.ended == "samples"
    assert rate < 250, "one query every 5 ms, whatever the number of channels"
    recording = drivers.read_recording(done.path)
    turning, driven = recording.samples["input_angle"], recording.samples["output_angle"]
    common, i, j = np.intersect1d(turning.time_host, driven.time_host, return_indices=True)
    assert len(common) > 180
    np.testing.assert_allclose(turning.value[i], -39 * driven.value[j], rtol=1e-12)
    steps = np.rint(np.diff(driven.value) / (2 * math.pi) * 1024)
    assert sorted(set(steps)) == [1, 2, 51], "the reply with an error is left out"
    for name, samples in recording.samples.items():
        steps = np.rint(np.diff(samples.value) / np.median(np.diff(samples.value))) if "angle" in name else steps
        marked = np.flatnonzero(samples.status & GAP)
        # A reply that this busy machine's simulator sends after the next query shifts a mark by a sample.
        assert all(np.abs(marked - hole - 1).min() <= 1 for hole in np.flatnonzero(steps > 1)), "a hole without a mark"
        assert done.lost[name] >= 50, "and those that a busy machine could not send"
    assert any("queries without a reply" in event.text for event in recording.events)
    assert recording.samples["motor_torque"].value == pytest.approx(0.125 * CURRENT / -39)
    assert recording.samples["torque"].value == pytest.approx(0.2 * CURRENT)
    assert any("1 replies left out" in event.text for event in recording.events)


@pytest.mark.system
def test_a_moteus_that_is_silent_or_on_a_classical_bus_is_one_sentence(tmp_path, bus_name):
    bus = f'[bus.can0]\ninterface = "virtual"\nchannel = "{bus_name}"\n'
    keys = odrive_keys(protocol="moteus", quantity="position", side="motor")
    with pytest.raises(edge.InputError, match="a moteus speaks CAN FD; write fd = true"):
        read_bench(wiring(tmp_path / "BENCH.toml", bus, input_angle=keys))
    with pytest.raises(drivers.EncoderError, match=r"moteus 3 on the CAN bus virtual .* sends no reply"):
        drivers.record(wiring(tmp_path / "BENCH.toml", bus + "fd = true\n", input_angle=keys), tmp_path / "a.arrows")


@pytest.mark.parametrize(
    ("name", "keys", "said"),
    [
        ("input_angle", {"quantity": "position", "side": "output"}, "input_angle is the position of the motor"),
        ("torque", {"quantity": "torque", "side": "motor"}, "torque is the torque of the output; .* motor_torque"),
        (
            "x",
            {"quantity": "velocity", "side": "motor", "torque_constant": "1 N*m/A"},
            'belongs to quantity = "torque"',
        ),
        ("x", {"quantity": "torque", "side": "motor", "torque_constant": "1 N*m"}, "torque_constant = .*1 N"),
        ("x", {"quantity": "torque", "side": "motor", "ratio": 0.0}, "ratio = 0.0: write the signed turns"),
        ("x", {"quantity": "torque", "side": "wheel"}, "side"),
    ],
)
def test_a_channel_of_another_shaft_or_unit_is_refused(tmp_path, name, keys, said):
    bus = '[bus.can0]\ninterface = "virtual"\nchannel = "x"\n'
    with pytest.raises(edge.InputError, match=said) as problem:
        read_bench(wiring(tmp_path / "BENCH.toml", bus, **{name: odrive_keys(**keys)}))
    assert f"[channel.{name}]" in str(problem.value)


SHOWN = ["target", "current_q", "velocity", "angle"]


@pytest.fixture
def simplefoc(tmp_path):
    """A bench with SimpleFOC's monitor: four decimals, tabs, currents in mA, a carriage return and a line feed."""
    controller, line = pty.openpty()
    tty.setraw(line)

    def step(number):
        os.write(controller, f"1.0000\t{1e3 * CURRENT:.4f}\t{-SPEED:.4f}\t{number / 16:.4f}\r\n".encode())
        if number == 60:
            os.write(controller, b"MOT: Monitor enabled!\r\n")  # the library's own messages are on the same line

    with sending(step, late=True):
        yield tmp_path / "BENCH.toml", f'[port.foc]\nurl = "{os.ttyname(line)}"\nbaud_rate = 115200\n'
    os.close(controller)
    os.close(line)


def simplefoc_keys(**keys):
    keys = {"protocol": "simplefoc", "port": "foc", "variables": SHOWN, **keys}
    return "\n".join(f"{k} = {edge.json_text(v)}" for k, v in keys.items())


def test_all_channels_of_a_simplefoc_monitor_share_its_lines(tmp_path, simplefoc):
    path = wiring(
        *simplefoc,
        input_angle=simplefoc_keys(quantity="position", side="motor", direction=-1),
        motor_speed=simplefoc_keys(quantity="velocity", side="motor"),
        torque=simplefoc_keys(quantity="torque", side="output", ratio=-1 / 39, torque_constant="0.08 N*m/A"),
    )
    done = drivers.record(path, tmp_path / "run.arrows", samples=200, duration=20.0)
    assert done.ended == "samples"
    recording = drivers.read_recording(done.path)
    samples = recording.samples
    angle = samples["input_angle"]
    numbers = -16 * angle.value
    assert numbers == pytest.approx(np.rint(numbers), abs=2e-3)  # four decimals
    assert (np.diff(np.rint(numbers)) >= 1).all()
    assert samples["motor_speed"].value == pytest.approx(-SPEED)
    assert samples["torque"].value == pytest.approx(-39 * 0.08 * CURRENT)
    shared = np.intersect1d(angle.time_host, samples["torque"].time_host)
    assert len(shared) > 150, "one line has one time in all channels"
    said = [e for e in recording.events if "MOT: Monitor" in e.text]
    assert len(said) in (0, 3), "in each channel, if it came after the start"


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"variables": ["angle", "velocity"]}, "in the order that the library prints"),
        ({"variables": ["target", "velocity"]}, 'variables lacks "angle"'),
        ({"quantity": "torque"}, "torque_constant is missing"),
    ],
)
def test_a_monitor_that_lacks_the_quantity_is_refused(tmp_path, keys, said):
    port = '[port.foc]\nurl = "/dev/ttyACM0"\n'
    keys = {"quantity": "position", "side": "motor", **keys}
    with pytest.raises(edge.InputError, match=said):
        read_bench(wiring(tmp_path / "BENCH.toml", port, x=simplefoc_keys(**keys)))


@pytest.mark.system
def test_more_columns_than_stated_are_no_reading(tmp_path, simplefoc):
    keys = simplefoc_keys(quantity="position", side="motor", variables=["velocity", "angle"])
    begun = time.monotonic()
    with pytest.raises(drivers.EncoderError, match="sends no line like"):
        drivers.record(wiring(*simplefoc, input_angle=keys), tmp_path / "run.arrows", samples=1)
    assert time.monotonic() - begun < 5.0


@pytest.mark.system
def test_lost_lines_of_a_monitor_are_counted_and_marked(tmp_path):
    """Without a number or a clock, by the usual interval: as exactly as a busy machine stamps the lines."""
    controller, line = pty.openpty()
    tty.setraw(line)
    keys = simplefoc_keys(quantity="position", side="motor", variables=["angle"])
    path = wiring(tmp_path / "BENCH.toml", f'[port.foc]\nurl = "{os.ttyname(line)}"\n', input_angle=keys)
    lost = {*range(150, 190), *range(240, 260)}
    with lossy(lambda number: os.write(controller, f"{number}.0000\r\n".encode()), lost):
        done = drivers.record(path, tmp_path / "run.arrows", samples=250, duration=30.0)
    samples = drivers.read_recording(done.path).samples["input_angle"]
    missing = np.diff(np.rint(samples.value)).astype(int) - 1
    assert (samples.status[1:][missing > 0] & GAP > 0).all(), "a hole without a mark"
    assert (missing >= 19).sum() >= 2
    assert done.lost["input_angle"] >= 45, "those lost, and those that a busy machine stamped too late"
    os.close(controller)
    os.close(line)
