"""Modbus RTU against pymodbus's server, lines of text against their description, AMT21 turns, URLs."""

import asyncio
import contextlib
import functools
import math
import operator
import os
import select
import socket
import threading
import tty

import numpy as np
import pytest
import serial
from hypothesis import given, settings
from hypothesis import strategies as st
from pymodbus.client import ModbusSerialClient
from pymodbus.server import ModbusSerialServer
from pymodbus.simulator import DataType, SimData, SimDevice
from serial.rfc2217 import PortManager

from cycloid_fmu import edge
from drivers import recording_format as rf
from drivers.encoder import EncoderProtocolError, EncoderSetupError, EncoderTimeout
from drivers.encoders.amt21 import Amt21Config, Amt21Encoder
from drivers.encoders.ascii import AsciiConfig, AsciiCounter, line_pattern
from drivers.encoders.modbus import ModbusConfig, ModbusEncoder
from drivers.lines import PortConfig
from drivers.recorder.bench import open_encoders, read_bench
from drivers.recorder.session import record
from drivers.recording_format import read_recording
from drivers.serial import port as serial_port
from drivers.serial.port import Exchange
from drivers.simulated.buses import SimulatedAmt21, SimulatedAscii, SimulatedModbus
from drivers.simulated.faults import Fault
from drivers.simulated.motion import SimulatedRun, simulate_motion
from drivers.simulated.serial_bench import SimulatedAmt21Bench, SimulatedAsciiBench, SimulatedModbusBench

pytestmark = pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals")


@pytest.fixture
def modbus_line(tmp_path):
    """Yield the name of one end of a serial line, with pymodbus's server on the other end."""
    ends = [os.openpty(), os.openpty()]
    for _, line in ends:
        tty.setraw(line)
    stopping = threading.Event()

    def carry(source, sink):
        while not stopping.is_set():
            try:
                os.write(sink, os.read(source, 256))
            except OSError:
                return

    for a, b in ((0, 1), (1, 0)):
        threading.Thread(target=carry, args=(ends[a][0], ends[b][0]), daemon=True).start()
    loop, ready = asyncio.new_event_loop(), threading.Event()
    servers = []

    async def serve():
        # 0x0001_E240 is 123456, high word first; register 8 holds a 12-bit position with flags above it
        data = [
            SimData(0, count=1, values=[0x0001, 0xE240], datatype=DataType.REGISTERS),
            SimData(8, count=1, values=[0xF123], datatype=DataType.REGISTERS),
        ]
        server = ModbusSerialServer(SimDevice(7, simdata=data), port=os.ttyname(ends[1][1]), baudrate=115200)
        servers.append(server)
        await server.serve_forever(background=True)
        ready.set()

    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    asyncio.run_coroutine_threadsafe(serve(), loop)
    assert ready.wait(10)
    yield os.ttyname(ends[0][1])
    asyncio.run_coroutine_threadsafe(servers[0].shutdown(), loop).result(5)
    loop.call_soon_threadsafe(loop.stop)
    thread.join(5)
    stopping.set()
    for end in ends:
        for descriptor in end:
            os.close(descriptor)


def modbus(port, **keys):
    config = ModbusConfig(**{"protocol": "modbus", "port": "p", "device": 7, "register": 0, **keys})
    return ModbusEncoder("input_angle", config, PortConfig(url=port, baud_rate=115200))


def some(encoder, count=3):
    found = []
    while sum(map(len, found)) < count:
        block = encoder.read(2.0)
        assert block is not None
        found.append(block)
    return found[0]


@pytest.mark.system
def test_modbus_registers_are_the_position(modbus_line):
    with modbus(modbus_line, counts_per_turn=1 << 18) as encoder:
        encoder.start()
        samples = some(encoder)
    assert set(samples.counts.tolist()) == {123456}
    np.testing.assert_allclose(samples.value, 2 * math.pi * 123456 / (1 << 18))
    assert not samples.status.any()
    with modbus(modbus_line, register=8, registers=1, bits=12, counts_per_turn=4096) as encoder:
        encoder.start()
        assert set(some(encoder).counts.tolist()) == {0x123}
    with modbus(modbus_line, low_word_first=True, counts_per_turn=1 << 18) as encoder:
        encoder.start()
        assert set(some(encoder).counts.tolist()) == {0xE2400001}


def test_modbus_errors_are_reported_at_the_start(modbus_line):
    with pytest.raises(EncoderProtocolError, match=r"refuses register 1000 of the holding table: exception 2"):
        modbus(modbus_line, register=1000, counts_per_turn=4096).__enter__()
    with pytest.raises(EncoderSetupError, match="counts_per_turn is missing"):
        modbus(modbus_line).__enter__()


def test_the_simulated_modbus_bench_is_read_by_the_client_of_pymodbus():
    motion = simulate_motion(lambda a, t: -a / 39 + 0.5, SimulatedRun(torque=0.0, turns=1, speed=1e-6))
    with (
        SimulatedModbusBench(motion, SimulatedModbus()) as bench,
        ModbusSerialClient(bench.url, baudrate=115200, timeout=1) as client,
    ):
        found = [client.read_holding_registers(0, count=2, device_id=d).registers for d in (1, 2)]
        refused = client.read_holding_registers(7, count=2, device_id=2)
    position = round(0.5 / (2 * math.pi) * (1 << 18))
    assert found == [[0, 0], list(divmod(position, 1 << 16))]
    assert (refused.isError(), refused.exception_code) == (True, 2)


@pytest.mark.parametrize("kind", [None, "mute", "half", "corrupt", "garbage", "wrong_baud"])
def test_a_modbus_line_is_recorded_without_a_wrong_angle(tmp_path, kind, monkeypatch):
    monkeypatch.setattr(serial_port, "ANSWER_SECONDS", 0.3)  # a busy machine delays the simulated encoder
    motion = simulate_motion(lambda a, t: -a / 39, SimulatedRun(torque=0.0, turns=1, samples_per_turn=200))
    path = tmp_path / "run.arrows"
    faults = [] if kind is None else [Fault(kind, 20, 2, target=2)]
    with SimulatedModbusBench(motion, SimulatedModbus(faults=faults)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml", ratio=-39)
        done = record(toml, path, stop=lambda: bench.wait(0.0))
    recording = read_recording(path)
    for name, angle in (("input_angle", motion.input_angle), ("output_angle", motion.output_angle)):
        samples = recording.samples[name]
        assert len(samples) > 10
        # Every value occurs in the motion, to half a count.
        nearest = np.abs(samples.value[:, None] - angle).min(axis=1)
        assert nearest.max() <= 1.001 * math.pi / (1 << 18)
        assert np.all(np.diff(samples.value) * np.sign(angle[-1]) >= 0)
    assert (done.marks["output_angle"].get("gaps", 0) > 0) == (kind is not None)
    assert "gaps" not in done.marks["input_angle"]


def test_the_crc_example_of_the_specification():
    # Modbus over serial line V1.02, 6.2.2: the CRC of 02 07 is 1241 hexadecimal, sent low byte (41) first.
    from pymodbus.framer import FramerRTU

    assert FramerRTU.compute_CRC(b"\x02\x07") == 0x4112


@settings(max_examples=200)
@given(st.binary(min_size=9, max_size=9))
def test_an_answer_with_a_wrong_crc_is_never_a_position(answer):
    encoder = modbus("loop://", counts_per_turn=4096)
    from pymodbus.framer import FramerRTU

    right = FramerRTU.compute_CRC(answer[:-2]) == int.from_bytes(answer[-2:], "big") and answer[:3] == b"\x07\x03\x04"
    assert encoder.checked([answer]).tolist() == [right]


def test_lines_are_the_commanded_motion_and_their_clock_is_known(tmp_path):
    motion = simulate_motion(lambda a, t: -a / 39, SimulatedRun(torque=0.0, turns=2, samples_per_turn=200))
    path = tmp_path / "run.arrows"
    drift = 0.01  # a counter without a crystal; the delay of all lines by a busy machine is far smaller
    with SimulatedAsciiBench(motion, SimulatedAscii(clock_drift=drift)) as bench:
        record(bench.write_wiring(tmp_path / "BENCH.toml"), path, stop=lambda: bench.wait(0.0))
    recording = read_recording(path)
    samples = recording.samples["output_angle"]
    assert len(samples) > 300
    assert not samples.status.any()
    expected = np.interp(samples.time_device / (1.0 + drift), motion.time, motion.output_angle)
    assert np.max(np.abs(samples.value - expected)) < 3e-5
    clock = recording.clock("output_angle")
    assert clock.drift == pytest.approx(1.0 / (1.0 + drift) - 1.0, rel=0.1)
    assert np.all(samples.time_host - recording.aligned_time("output_angle") > -clock.uncertainty)


def ascii_samples(config, data):
    """Return the samples that a counter decodes from received bytes, without a port."""
    counter = AsciiCounter("output_angle", config, PortConfig(url="loop://"))
    counter._skipping = False
    counter._answers.put([Exchange(float(i), data[i : i + 7]) for i in range(0, len(data), 7)], 1)
    return counter, counter.read(0.0)


CONFIG = AsciiConfig(
    protocol="ascii", port="p", line="${sequence},{counts}*{checksum}", checksum="xor", counts_per_turn=1000
)


def nmea(number, counts):
    text = f"{number},{counts}".encode()
    return b"$%b*%02X\r\n" % (text, functools.reduce(operator.xor, text, 0))


def test_the_checksum_is_that_of_nmea_0183():
    config = AsciiConfig(protocol="ascii", port="p", line="$GPGLL,{skip},A*{checksum}x{counts}", checksum="xor")
    assert line_pattern(config.line)[1] == ["checksum", "counts"]
    line = b"$GPGLL,5300.97914,N,00259.98174,E,125926,A*28"  # a published sentence and its checksum
    assert functools.reduce(operator.xor, line[1:-3], 0) == 0x28
    counter, _ = ascii_samples(CONFIG, nmea(1, 500))
    assert counter._sum_right(nmea(1, 500).rstrip(), counter._fields(nmea(1, 500).rstrip()))


@settings(max_examples=150)
@given(st.lists(st.tuples(st.integers(0, 10**6), st.binary(max_size=12)), max_size=12))
def test_no_wrong_count_is_accepted_from_bytes_between_valid_lines(given_lines):
    data, sent = b"", []
    for number, (count, junk) in enumerate(given_lines):
        data += junk.replace(b"\n", b"") + b"\n" + nmea(number, count)
        sent.append(count)
    _, samples = ascii_samples(CONFIG, data)
    got = [] if samples is None else samples.counts.tolist()
    junk_lines = {junk for _, junk in given_lines}
    assert got == sent or any(b"$" in junk for junk in junk_lines)


@pytest.mark.parametrize(
    ("keys", "said"),
    [
        ({"line": "{time}"}, r"line = .*write exactly one of the fields \{counts\} and \{value\}"),
        ({"line": "{counts}{value}"}, "write exactly one of the fields"),
        ({"line": "{count}"}, r"there is no field \{count\}; the fields are counts, value"),
        ({"line": "{counts},{counts}"}, r"the field \{counts\} occurs twice"),
    ],
)
def test_a_bad_description_is_refused(keys, said):
    with pytest.raises(edge.InputError, match=said):
        edge.validated(AsciiConfig, {"protocol": "ascii", "port": "p", **keys}, "BENCH.toml")


def test_a_multi_turn_encoder_counts_turns_that_readings_missed(tmp_path):
    # 20 crank turns per second, read a few hundred times per second, with a pause of a tenth of a second.
    motion = simulate_motion(
        lambda a, t: -a / 39, SimulatedRun(torque=0.0, turns=40, samples_per_turn=500, speed=40 * math.pi)
    )
    path = tmp_path / "run.arrows"
    with SimulatedAmt21Bench(motion, SimulatedAmt21(multi_turn=True, faults=[Fault("mute", 400, 1, 0x54)])) as bench:
        done = record(bench.write_wiring(tmp_path / "BENCH.toml"), path, stop=lambda: bench.wait(0.0))
    samples = read_recording(path).samples["input_angle"]
    assert done.marks["input_angle"]["resets"] >= 1, "it turned by more than half a turn unseen"
    # A busy machine records the encoder at rest too, after the motion, and stamps single answers late, which medians
    # leave out.
    moving = samples.value != samples.value[-1]
    ahead = samples.value[moving] / (2 * math.pi) - 20 * samples.time_host[moving]
    assert np.median(ahead[-50:]) == pytest.approx(np.median(ahead[:200]), abs=0.5)


@given(st.lists(st.integers(-3000, 3000), min_size=2, max_size=60), st.integers(-(10**5), 10**5))
def test_turns_and_position_from_two_requests_make_one_angle(steps, start):
    config = Amt21Config(protocol="amt21", port="p", multi_turn=True, bits=12)
    encoder = Amt21Encoder("input_angle", config, PortConfig(url="loop://"))
    true = start + np.cumsum(steps)
    late = true + np.array([s // 40 for s in steps])  # the turns are requested slightly later
    counts, _missed = encoder._with_turns(_counted(true % 4096), true % 4096, (late // 4096) % (1 << 14))
    off = (counts - true) // 4096
    sure = (true % 4096 >= 1024) & (true % 4096 < 3072)
    assert np.all((counts - true) % 4096 == 0)
    if sure.any():
        assert np.all(off[np.flatnonzero(sure)] == 0)


def _counted(raw):
    from drivers.counts import unwrap

    return unwrap(raw, 4096, None, signed=True)[0]


@pytest.mark.system
def test_a_port_may_be_a_socket(tmp_path):
    """`socket://`, as of a serial device server; here it sends lines."""
    server = socket.create_server(("127.0.0.1", 0))
    stop = threading.Event()

    def serve():
        connection, _ = server.accept()
        with connection:
            for number in range(10**6):
                if stop.wait(0.002):
                    return
                with contextlib.suppress(OSError):  # the recorder has disconnected
                    connection.sendall(nmea(number, number))

    thread = threading.Thread(target=serve, daemon=True)
    thread.start()
    bench = tmp_path / "BENCH.toml"
    bench.write_text(
        'format = "cycloid-bench/1"\n[port.a]\n'
        f'url = "socket://127.0.0.1:{server.getsockname()[1]}"\n'
        '[channel.output_angle]\nprotocol = "ascii"\nport = "a"\n'
        'line = "${sequence},{counts}*{checksum}"\nchecksum = "xor"\ncounts_per_turn = 1000\n'
    )
    record(bench, tmp_path / "run.arrows", samples=50)
    stop.set()
    thread.join()
    server.close()
    samples = read_recording(tmp_path / "run.arrows").samples["output_angle"]
    assert np.all(np.diff(samples.counts) == 1)
    assert not np.any(samples.status & rf.GAP)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ('line = "{counts}"', "counts_per_turn is missing"),
        ('line = "{value}*{checksum}"', 'checksum is missing: write "xor" or "sum"'),
        ('line = "{value}"\nunit = "mm"', 'unit = "mm": the unit "mm" '),
    ],
)
def test_a_key_missing_in_the_table_of_a_line_is_reported_with_file_and_channel(tmp_path, changed, said):
    bench = tmp_path / "BENCH.toml"
    channel = '[channel.output_angle]\nprotocol = "ascii"\nport = "a"\n'
    bench.write_text(f'format = "cycloid-bench/1"\n[port.a]\nurl = "/dev/ttyUSB0"\n{channel}{changed}\n')
    with pytest.raises(edge.InputError) as raised:
        read_bench(bench)
    assert str(raised.value).startswith(f"{bench}: [channel.output_angle] {said}")


class _Line(serial.Serial):
    """A pseudo-terminal as a port without modem lines."""

    cts = dsr = ri = cd = rts = dtr = False

    def _update_rts_state(self):
        pass

    _update_dtr_state = _update_rts_state


@pytest.mark.system
def test_a_port_may_be_a_serial_device_server_by_rfc_2217(tmp_path, monkeypatch):
    """pyserial's server between a TCP connection and the simulated line passes on baud rate and bytes."""
    monkeypatch.setattr(serial_port, "ANSWER_SECONDS", 1.0)  # a busy machine delays the simulated encoder
    motion = simulate_motion(lambda a, t: -a / 39, SimulatedRun(torque=0.0, turns=1, samples_per_turn=100))
    path, stopping, rates = tmp_path / "run.arrows", threading.Event(), []
    server = socket.create_server(("127.0.0.1", 0))

    def serve(url):
        connection, _ = server.accept()
        line = _Line(url, 9600, timeout=0)

        class Network:
            write = staticmethod(connection.sendall)

        with connection, line:
            manager = PortManager(line, Network)
            while not stopping.is_set():
                ready, _, _ = select.select([connection, line], [], [], 0.05)
                if connection in ready:
                    data = connection.recv(1024)
                    if not data:
                        break
                    line.write(b"".join(manager.filter(data)))
                if line in ready:
                    connection.sendall(b"".join(manager.escape(line.read(1024))))
                rates.append(line.baudrate)

    with SimulatedAmt21Bench(motion, SimulatedAmt21(bits=14)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml", ratio=-39)
        toml.write_text(toml.read_text().replace(bench.url, f"rfc2217://127.0.0.1:{server.getsockname()[1]}"))
        thread = threading.Thread(target=serve, args=(bench.url,), daemon=True)
        thread.start()
        done = record(toml, path, samples=40, allow=["rfc2217"])
        stopping.set()
        thread.join()
        server.close()
    assert rates[-1] == 2_000_000
    assert all(marks.keys() <= {"rollovers"} for marks in done.marks.values()), "nothing is lost or garbled"
    samples = read_recording(path).samples["input_angle"]
    nearest = np.abs(samples.value[:, None] - motion.input_angle).min(axis=1)
    assert nearest.max() <= 1.001 * math.pi / (1 << 14)


def test_no_answer_and_invalid_answers_are_distinguished(tmp_path, monkeypatch):
    from drivers.encoders import ascii as ascii_counter

    monkeypatch.setattr(ascii_counter, "FIRST_LINE_SECONDS", 0.3)
    motion = simulate_motion(lambda a, t: -a / 39, SimulatedRun(torque=0.0, turns=2))
    for kind, kind_of_error in (("mute", EncoderTimeout), ("wrong_baud", EncoderProtocolError)):
        folder = tmp_path / kind
        folder.mkdir()
        with SimulatedAsciiBench(motion, SimulatedAscii(faults=[Fault(kind, 0, 10**9)])) as bench:
            toml = bench.write_wiring(folder / "BENCH.toml")
            with pytest.raises(kind_of_error, match="is the baud rate right"), open_encoders(toml):
                pass
