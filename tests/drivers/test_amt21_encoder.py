"""AMT21 over a real pair of pseudo-terminals, and the datasheet's check bits."""

import math
import os

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from drivers import recording_format as rf
from drivers.encoder import EncoderSetupError, EncoderTimeout
from drivers.encoders.amt21 import check_bits, checked_position
from drivers.recorder.bench import open_encoders
from drivers.recorder.session import record
from drivers.recording_format import read_recording
from drivers.serial import port as serial_port
from drivers.simulated.buses import SimulatedAmt21
from drivers.simulated.faults import Fault
from drivers.simulated.motion import SimulatedRun, simulate_motion
from drivers.simulated.serial_bench import SimulatedAmt21Bench


@pytest.fixture(autouse=True)
def _patient(request, monkeypatch):
    """A busy machine may delay the simulated encoder by a tenth of a second."""
    if "silent" not in request.node.name:
        monkeypatch.setattr(serial_port, "ANSWER_SECONDS", 2.0)


pytestmark = pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs pseudo-terminals")


@pytest.mark.parametrize(("word", "position"), [(0x61AB, 0x21AB), (0xF9E4, 0x39E4)])
def test_the_examples_of_the_datasheet(word, position):
    found, good = checked_position(np.array([word], np.uint16))
    assert good.tolist() == [True]
    assert found.tolist() == [position]
    assert check_bits(np.array([position], np.uint16)).tolist() == [word]


@given(st.integers(0, 0x3FFF), st.integers(0, 15))
def test_check_bits_confirm_every_position_and_catch_every_single_flipped_bit(position, bit):
    word = check_bits(np.array([position], np.uint16))
    found, good = checked_position(word)
    assert good.all()
    assert found[0] == position
    assert not checked_position(word ^ np.uint16(1 << bit))[1].any()


@pytest.mark.parametrize("bits", [pytest.param(12, marks=pytest.mark.slow(4)), 14])
def test_the_recording_is_the_commanded_motion(tmp_path, bits):
    run = SimulatedRun(torque=5.0, turns=2, samples_per_turn=200, speed=math.pi)
    motion = simulate_motion(lambda angle, torque: -angle / 39, run)
    path = tmp_path / "run.arrows"
    with SimulatedAmt21Bench(motion, SimulatedAmt21(bits=bits)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml", ratio=-39)
        record(toml, path, stop=lambda: bench.wait(0.0))
    recording = read_recording(path)
    assert recording.problems == recording.events == ()
    half_a_count = math.pi / (1 << bits)
    for name, address in zip(("input_angle", "output_angle"), bench.addresses, strict=True):
        samples = recording.samples[name]
        answered = np.array(bench.answered[address])[1:]  # the first answer was to the query at opening
        commanded = getattr(motion, name)[answered[: len(samples)]]
        assert len(samples) > 30
        assert np.max(np.abs(samples.value - commanded)) <= half_a_count * (1 + 1e-6)
        assert np.all(np.diff(samples.time_host) > 0)
        assert not np.any(samples.status & ~np.uint8(rf.ROLLOVER))


def test_a_word_with_wrong_check_bits_is_never_used_as_an_angle(tmp_path):
    run = SimulatedRun(torque=5.0, turns=1, samples_per_turn=100, speed=2 * math.pi)
    motion = simulate_motion(lambda angle, torque: angle / 40, run)
    path = tmp_path / "run.arrows"
    faults = [Fault("corrupt", question) for question in (22, 24, 31)]
    with SimulatedAmt21Bench(motion, SimulatedAmt21(faults=faults)) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml")
        record(toml, path, stop=lambda: bench.wait(0.0))
    recording = read_recording(path)
    marked = {n: np.flatnonzero(s.status & rf.CHECKSUM) for n, s in recording.samples.items()}
    # Requests 0 and 1 find the encoders; then input and output are polled in turn: 22 and 24 are the input's.
    assert marked["input_angle"].tolist() == [10]
    assert marked["output_angle"].tolist() == [14]
    for name, address in zip(("input_angle", "output_angle"), bench.addresses, strict=True):
        samples = recording.samples[name]
        np.testing.assert_array_equal(samples.status & rf.GAP > 0, samples.status & rf.CHECKSUM > 0)
        # The drive is still at rest; the flipped bit is 5.6°.
        commanded = getattr(motion, name)[np.array(bench.answered[address])[1 : len(samples) + 1]]
        assert np.max(np.abs(samples.value - commanded)) <= math.pi / (1 << 14) * (1 + 1e-6)
    lost = [e for e in recording.events if "wrong check bits" in e.text]
    assert sum(int(e.text.split()[0]) for e in lost) == 3


@pytest.mark.system
def test_an_address_without_an_encoder_is_named(tmp_path):
    motion = simulate_motion(lambda angle, torque: angle / 40, SimulatedRun(torque=5.0, turns=1))
    with SimulatedAmt21Bench(motion, SimulatedAmt21()) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml")
        toml.write_text(toml.read_text().replace("address = 88", "address = 92"))
        with pytest.raises(EncoderTimeout, match="output_angle: AMT21 at address 0x5C"), open_encoders(toml):
            pass


def test_a_missing_port_is_named(tmp_path):
    motion = simulate_motion(lambda angle, torque: angle / 40, SimulatedRun(torque=5.0, turns=1))
    with SimulatedAmt21Bench(motion, SimulatedAmt21()) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml")
    toml.write_text(toml.read_text().replace(bench.url, "/dev/pts/987654"))
    with pytest.raises(EncoderSetupError, match="/dev/pts/987654"), open_encoders(toml):
        pass


@pytest.mark.system
def test_an_encoder_that_falls_silent_is_an_event(tmp_path):
    motion = simulate_motion(lambda angle, torque: angle / 40, SimulatedRun(torque=5.0, turns=1, speed=2 * math.pi))
    path = tmp_path / "run.arrows"
    with SimulatedAmt21Bench(motion, SimulatedAmt21(faults=[Fault("mute", 50, 10**9, target=0x58)])) as bench:
        toml = bench.write_wiring(tmp_path / "BENCH.toml")
        record(toml, path, duration=0.6)
    recording = read_recording(path)
    assert any(e.channel == "output_angle" and "no answer" in e.text for e in recording.events)
    assert len(recording.samples["input_angle"]) > len(recording.samples["output_angle"])
