"""CANopen encoders and a DBC torque transducer on a virtual bus, against the commanded motion."""

import math
import threading
import time

import can
import canopen
import numpy as np
import pytest

from drivers import recording_format as rf
from drivers.can.bus import open_bus
from drivers.encoder import EncoderConnectionError, EncoderProtocolError, EncoderSetupError, EncoderTimeout
from drivers.lines import BusConfig
from drivers.recorder.bench import open_encoders, read_bench
from drivers.recorder.session import record, record_encoders
from drivers.recording_format import read_recording
from drivers.simulated.buses import SimulatedCan
from drivers.simulated.can_bench import SimulatedCanBench
from drivers.simulated.faults import Fault
from drivers.simulated.motion import Motion, SimulatedRun, quantised, simulate_motion

SYNC, INPUT, OUTPUT, TORQUE = 0x80, 0x181, 0x182, 0x2A0


def ideal(angle, torque):
    return -angle / 39 + 1e-6 * torque


def recorded(tmp_path, bus_name, motion, lossy=False, **options):
    """Record a motion over a virtual bus, up to its last sample or, if some are lost, until no more arrive."""
    path = tmp_path / "run.arrows"
    with SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name, **options)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml", ratio=-39, pair="reference")
        record(toml, path, samples=None if lossy else motion.run.samples, idle=1.0 if lossy else 10.0)
        assert bench.wait(10)
    recording = read_recording(path)
    assert recording.problems == ()
    return recording


@pytest.mark.parametrize("direction", ["forward", "backward"])
def test_the_recording_is_the_commanded_motion(tmp_path, bus_name, direction):
    run = SimulatedRun(torque=-20.0, turns=3, direction=direction, noise=1e-6, torque_noise=0.05, seed=4)
    motion = simulate_motion(ideal, run)
    recording = recorded(tmp_path, bus_name, motion)
    samples = recording.samples
    for name, counts_per_turn in (("input_angle", 1 << 22), ("output_angle", 1 << 25)):
        half_a_count = math.pi / counts_per_turn
        assert np.max(np.abs(samples[name].value - getattr(motion, name))) <= half_a_count * (1 + 1e-6)
        assert len(samples[name]) == run.samples
        np.testing.assert_allclose(samples[name].time_host - samples[name].time_host[0], motion.time, atol=1e-6)
    assert np.max(np.abs(samples["torque"].value - motion.torque)) <= 0.5e-4 * (1 + 1e-6)
    for name in ("output_angle", "torque"):
        np.testing.assert_array_equal(samples["input_angle"].time_host, samples[name].time_host)
    assert recording.events == ()


def test_the_header_describes_the_recording(tmp_path, bus_name):
    recording = recorded(tmp_path, bus_name, simulate_motion(ideal, SimulatedRun(torque=-20.0, turns=1, speed=5.0)))
    header = recording.header
    assert header.ratio == -39
    assert header.pair == "reference"
    assert header.conditions == {"load": -20.0, "speed": 5.0, "direction": "forward"}
    channels = {c.name: c for c in header.channels}
    assert channels["output_angle"].counts_per_turn == 1 << 25
    assert "node 2" in channels["output_angle"].identity
    assert "SYNC" in channels["torque"].time_source
    assert (channels["torque"].unit, channels["input_angle"].unit) == ("N*m", "rad")


def test_a_32_bit_position_that_rolls_over_stays_continuous(tmp_path, bus_name):
    # 2^31 counts per turn: the 32-bit position rolls over every second turn.
    run = SimulatedRun(torque=0.0, turns=7, samples_per_turn=24)
    motion = simulate_motion(ideal, run)
    recording = recorded(tmp_path, bus_name, motion, input_counts_per_turn=1 << 31)
    samples = recording.samples["input_angle"]
    np.testing.assert_array_equal(samples.counts, quantised(motion.input_angle, 1 << 31))
    assert np.flatnonzero(samples.status & rf.ROLLOVER).tolist() == [48, 96, 144]


def test_a_coarse_encoder_rolls_over_after_the_turns_it_reports(tmp_path, bus_name):
    # 64 counts per turn: 0x6502 can state 32,768 of the 2^26 turns of 32 bits; just below zero it shows 2^21 - 1.
    motion = simulate_motion(lambda angle, torque: -angle, SimulatedRun(torque=0.0, turns=1, samples_per_turn=24))
    recording = recorded(tmp_path, bus_name, motion, output_counts_per_turn=64)
    np.testing.assert_array_equal(recording.samples["output_angle"].counts, quantised(motion.output_angle, 64))


def test_a_missing_pdo_is_a_gap_only_in_its_channel(tmp_path, bus_name):
    motion = simulate_motion(ideal, SimulatedRun(torque=5.0, turns=2))
    recording = recorded(
        tmp_path, bus_name, motion, lossy=True, faults=[Fault("drop", 50, 2, OUTPUT), Fault("drop", 100, 1, OUTPUT)]
    )
    output, angle = recording.samples["output_angle"], recording.samples["input_angle"]
    assert len(angle) == 192
    assert not np.any(angle.status & rf.GAP)
    assert len(output) == 189
    assert np.flatnonzero(output.status & rf.GAP).tolist() == [50, 98]
    kept = np.setdiff1d(np.arange(192), [50, 51, 100])
    np.testing.assert_array_equal(output.time_host, angle.time_host[kept])
    said = [e for e in recording.events if e.channel == "output_angle"]
    assert sum(int(e.text.split()[0]) for e in said if "SYNC without a sample" in e.text) == 3


def test_a_missing_sync_loses_its_samples_and_marks_the_next(tmp_path, bus_name):
    motion = simulate_motion(ideal, SimulatedRun(torque=5.0, turns=2))
    recording = recorded(tmp_path, bus_name, motion, lossy=True, faults=[Fault("drop", 30, 1, SYNC)])
    kept = np.setdiff1d(np.arange(192), [30])
    for name in ("input_angle", "output_angle", "torque"):
        samples = recording.samples[name]
        assert np.flatnonzero(samples.status & rf.GAP).tolist() == [30]
        assert np.max(np.abs(samples.value - getattr(motion, name)[kept])) <= 1e-4
    assert any("1 SYNC missing" in e.text for e in recording.events)
    assert any("without its own SYNC" in e.text for e in recording.events)


def foreign(bus_name):
    """Another participant of the bus."""
    return open_bus(BusConfig(interface="virtual", channel=bus_name))


@pytest.mark.parametrize(("command", "said"), [(0x02, "stopped"), (0x80, "pre-operational")])
@pytest.mark.system
def test_nodes_that_another_program_silences_are_reported_and_the_next_sample_is_marked(
    tmp_path, bus_name, command, said
):
    motion = simulate_motion(ideal, SimulatedRun(torque=5.0, turns=20))
    with (
        SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name, speed_factor=1.0)) as bench,
        foreign(bus_name) as other,
    ):
        bench.write_wiring(tmp_path / "BENCH.toml", ratio=-39)

        def silence():
            while bench.sent < 100:
                time.sleep(0.01)
            other.send(can.Message(arbitration_id=0, data=[command, 1], is_extended_id=False))
            time.sleep(0.3)
            other.send(can.Message(arbitration_id=0, data=[1, 1], is_extended_id=False))

        thread = threading.Thread(target=silence)
        thread.start()
        record(tmp_path / "BENCH.toml", tmp_path / "run.arrows", duration=3.0)
        thread.join()
    recording = read_recording(tmp_path / "run.arrows")
    told = [e for e in recording.events if "another program" in e.text]
    assert [(e.channel, e.text) for e in told] == [
        ("input_angle", f"another program set the node {said}; it sends no more")
    ]
    samples = recording.samples["input_angle"]
    (silent,) = np.flatnonzero(np.diff(samples.time_host) > 0.2)
    assert samples.status[silent + 1] & rf.GAP
    assert samples.time_host[silent] - 0.1 < told[0].time < samples.time_host[silent + 1]


def test_wrong_frames_and_emergencies_are_events(tmp_path, bus_name):
    motion = simulate_motion(ideal, SimulatedRun(torque=5.0, turns=1))
    path = tmp_path / "run.arrows"
    done = threading.Event()

    def disturb():
        with foreign(bus_name) as bus:
            short = can.Message(arbitration_id=OUTPUT, is_extended_id=False, data=b"\1\2", timestamp=time.time())
            bus.send(short)
            bus.send(can.Message(arbitration_id=0x82, is_extended_id=False, data=bytes.fromhex("1081010000000000")))
            bus.send(can.Message(arbitration_id=0x702, is_extended_id=False, data=b"\0"))
        done.set()

    with SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name, speed_factor=1.0)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml")
        with open_encoders(toml) as encoders:
            seen = {}

            def progress(counts):
                if not seen and counts.samples["output_angle"] > 5:
                    seen["at"] = counts.samples
                    disturb()

            record_encoders(encoders, path, samples=motion.run.samples - 1, idle=2.0, progress=progress)
    recording = read_recording(path)
    assert done.is_set()
    texts = [e.text for e in recording.events if e.channel == "output_angle"]
    assert any("frame 0x182 skipped: 2 bytes long (0x0102), not 4" in t for t in texts)
    assert any(t.startswith("EMCY 0x8110, register 0x01") for t in texts)
    assert any("the node restarted" in t for t in texts)
    output = recording.samples["output_angle"]
    assert np.any(output.status & rf.GAP)
    assert np.any(output.status & rf.RESET)


def test_the_others_continue_when_a_channel_fails(tmp_path, bus_name):
    motion = simulate_motion(ideal, SimulatedRun(torque=5.0, turns=1))
    path = tmp_path / "run.arrows"
    with SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml")
        with open_encoders(toml) as encoders:
            broken = encoders[1]

            def fail(timeout):
                raise EncoderConnectionError("output_angle: the cable is out.")

            broken.read = fail
            done = record_encoders(encoders, path, idle=0.5)
    assert [str(f) for f in done.failures] == ["output_angle: the cable is out."]
    recording = read_recording(path)
    assert recording.problems == ()
    assert len(recording.samples["input_angle"]) == len(recording.samples["torque"]) == 96
    assert [e.channel for e in recording.events if "the cable is out" in e.text] == ["output_angle"]


def test_a_silent_node_is_named(tmp_path, bus_name):
    motion = simulate_motion(ideal, SimulatedRun(torque=5.0, turns=1))
    with SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml")
        toml.write_text(toml.read_text().replace("node = 2", "node = 9"))
        with pytest.raises(EncoderTimeout, match="output_angle: node 9 on the CAN bus virtual"), open_encoders(toml):
            pass


def test_two_channels_cannot_share_a_node(tmp_path, bus_name):
    motion = simulate_motion(ideal, SimulatedRun(torque=5.0, turns=1))
    with SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml")
        toml.write_text(toml.read_text().replace("node = 2", "node = 1"))
        with pytest.raises(EncoderSetupError, match="in use by another channel"), open_encoders(toml):
            pass


def test_a_node_that_does_not_map_its_position_is_refused(tmp_path, bus_name):
    motion = simulate_motion(ideal, SimulatedRun(torque=5.0, turns=1))
    with SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml")
        bench._nodes[2].object_dictionary[0x1A00][1].default = 0x60000010
        with pytest.raises(EncoderProtocolError, match="does not map the position") as problem, open_encoders(toml):
            pass
    assert str(problem.value).startswith("output_angle: node 2 on the CAN bus")


def test_the_nodes_answer_sdo_and_nmt_according_to_cia_406(bus_name):
    motion = simulate_motion(ideal, SimulatedRun(torque=5.0, turns=1))
    with (
        SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name)) as bench,
        canopen.Network() as network,
    ):
        network.NOTIFIER_CYCLE = 0.02
        network.connect(interface="virtual", channel=bus_name)
        node = network.add_node(1, canopen.ObjectDictionary())
        assert int.from_bytes(node.sdo.upload(0x1000, 0), "little") & 0xFFFF == 406
        assert int.from_bytes(node.sdo.upload(0x6501, 0), "little") == 1 << 22
        assert int.from_bytes(node.sdo.upload(0x6502, 0), "little") == 1 << 10
        assert node.sdo.upload(0x1A00, 1) == (0x60040020).to_bytes(4, "little")
        assert bench.sent == 0, "a bench is silent until its nodes operate"


@pytest.mark.system
def test_a_bench_ends_when_a_node_is_stopped(tmp_path, bus_name):
    motion = simulate_motion(ideal, SimulatedRun(torque=5.0, turns=1000))
    with SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml")
        done = record(toml, tmp_path / "run.arrows", samples=1000)
        assert bench.wait(10), "closing the encoders sets the nodes pre-operational"
        assert bench.sent < motion.run.samples
    assert min(done.samples.values()) >= 1000


def test_bench_counts_are_read_by_unsigned_configuration_too(tmp_path, bus_name):
    run = SimulatedRun(torque=5.0, turns=1)
    motion = simulate_motion(ideal, run)
    path = tmp_path / "run.arrows"
    with SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml")
        toml.write_text(toml.read_text().replace("signed = true", 'signed = false\ndirection = -1\nzero = "90 deg"'))
        record(toml, path, samples=run.samples, idle=10.0)
    value = read_recording(path).samples["input_angle"].value
    np.testing.assert_allclose(value, -motion.input_angle - math.pi / 2, atol=math.pi / (1 << 22))


def test_wiring_of_a_bench_is_read_back(tmp_path, bus_name):
    motion = simulate_motion(ideal, SimulatedRun(torque=5.0))
    bench = read_bench(
        SimulatedCanBench(motion, SimulatedCan(interface="virtual", channel=bus_name)).write_wiring(
            tmp_path / "BENCH.toml", ratio=-39
        )
    )
    assert list(bench.channels) == ["input_angle", "output_angle", "torque"]
    assert bench.ratio == -39


def test_lead_in_precedes_the_same_angles():
    plain = simulate_motion(ideal, SimulatedRun(torque=1.0, turns=1, direction="backward"))
    led = simulate_motion(ideal, SimulatedRun(torque=1.0, turns=1, direction="backward", lead_in=5))
    np.testing.assert_allclose(led.input_angle[5:], plain.input_angle)
    assert np.all(np.diff(led.input_angle) < 0)
    assert isinstance(led, Motion)
