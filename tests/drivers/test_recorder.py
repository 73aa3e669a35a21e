"""The recorder with scripted encoders: counts, reports, written samples, and ends of a recording."""

import collections
import errno
import json
import math
import os
import signal
import threading
import time

import numpy as np
import pytest

from cycloid_fmu import edge
from drivers import recording_format as rf
from drivers.encoder import AngleConfig, Encoder, EncoderTimeout, channel_of, steady_time
from drivers.recorder import session
from drivers.recorder.bench import read_bench
from drivers.recorder.session import record_encoders
from drivers.recording_format import Event, Samples, read_recording


class Scripted(Encoder):
    """Returns one block per reading, then none; an error in the script is raised, a text is an event."""

    configuration = AngleConfig

    def __init__(self, name, script, unit="rad"):
        config = AngleConfig(protocol="scripted")
        self.channel = channel_of(name, config, identity="script", time_source="script", unit=unit)
        self.script, self.said, self.closed, self.waits = collections.deque(script), [], 0, []
        self.start_time = steady_time()

    @classmethod
    def from_config(cls, name, config, wiring):
        raise NotImplementedError

    def __enter__(self):
        return self

    def close(self):
        self.closed += 1

    @property
    def waiting(self):
        return len(self.script)

    def read(self, timeout):
        self.waits.append(timeout)
        step = self.script.popleft() if self.script else None
        if isinstance(step, Exception):
            raise step
        if isinstance(step, str):
            self.said.append(Event(self.start_time, self.channel.name, step))
            return None
        if step is None:
            time.sleep(min(timeout, 1e-3))
            return None
        times, value, *more = step
        return Samples.checked(self.channel.name, self.start_time + np.array(times), value, **dict(*more))

    def events(self):
        said, self.said = self.said, []
        return said


def exhausted(*encoders):
    return lambda: not any(e.script for e in encoders)


def test_samples_are_written_and_counted(tmp_path):
    marked = [rf.GAP, rf.GAP | rf.CHECKSUM, 0, rf.ROLLOVER]
    one = Scripted(
        "input_angle",
        [([0.1, 0.2], [5.0, 4.0]), "paused", ([0.3, 0.4, 0.5, 0.6], [3.0, 3.5, 2.5, 3.2], {"status": marked})],
    )
    other = Scripted("torque", [([0.1], [30.0])], unit="N*m")
    seen = []

    def progress(live):
        seen.append({n: (s.samples, s.waiting, s.value, s.lowest, s.highest) for n, s in live.channels.items()})

    held = []
    found = record_encoders(
        [one, other],
        tmp_path / "run.arrows",
        ratio=-39.0,
        pair="p",
        conditions={"load": 5.0},
        stop=exhausted(one, other),
        progress=lambda live: (held.append(live), progress(live)),
    )
    assert found.samples == {"input_angle": 6, "torque": 1}
    assert found.marks == {"input_angle": {"gaps": 2, "checksum": 1, "rollovers": 1}, "torque": {}}
    assert (found.events, found.failures, found.path) == (1, (), tmp_path / "run.arrows")
    assert seen == [
        {"input_angle": (2, 2, 4.0, 4.0, 5.0), "torque": (1, 0, 30.0, 30.0, 30.0)},
        {"input_angle": (2, 1, 4.0, 4.0, 5.0), "torque": (1, 0, 30.0, 30.0, 30.0)},
        {"input_angle": (6, 0, 3.2, 2.5, 3.5), "torque": (1, 0, 30.0, 30.0, 30.0)},
    ]
    state = held[0].channels["input_angle"]
    assert (state.first, state.failure) == (5.0, None)
    assert state.time == pytest.approx(0.6, abs=0.05)
    assert held[0].disk_free == pytest.approx(os.statvfs(tmp_path).f_bavail * os.statvfs(tmp_path).f_frsize, rel=0.1)
    assert held[0].transmission_error is None, "there is no output angle"
    assert set(one.waits[:3]) == {0.05}, "it waits for the first channel"
    assert set(other.waits) == {0.0}, "and the others have arrived meanwhile"
    kept = read_recording(tmp_path / "run.arrows")
    assert kept.samples["input_angle"].value.tolist() == [5.0, 4.0, 3.0, 3.5, 2.5, 3.2]
    assert kept.samples["input_angle"].time_host == pytest.approx([0.1, 0.2, 0.3, 0.4, 0.5, 0.6], abs=0.05)
    assert [e.text for e in kept.events] == ["paused"]
    assert kept.events[0].time == pytest.approx(0.0, abs=0.05)
    assert (kept.header.ratio, kept.header.pair, kept.header.conditions) == (-39.0, "p", {"load": 5.0})


def test_the_newest_transmission_error_is_at_the_newest_common_time(tmp_path):
    """φ_out - φ_in/i minus its first value: a drift of 1 mrad/s shows at output samples within the input's times."""
    crank = [0.0, 1.0, 2.0], [0.0, 39.0, 78.0]
    given = [([-1.0], [0.0]), ([0.5, 9.0], [-0.5 + 0.5e-3, 0.0]), ([0.0, 2.0, 2.5], [0.0, -2.0 + 2e-3, 5.0])]
    one, other = Scripted("input_angle", [crank, None, None]), Scripted("output_angle", given)
    other.start_time = one.start_time
    seen = []
    record_encoders(
        [one, other],
        tmp_path / "a.arrows",
        ratio=-39.0,
        stop=exhausted(one, other),
        progress=lambda live: seen.append(live.transmission_error),
    )
    assert seen == [None, 0.0, pytest.approx(1.5e-3, abs=1e-9)]
    one, other = Scripted("input_angle", [crank]), Scripted("output_angle", given[:2])
    record_encoders(
        [one, other],
        tmp_path / "b.arrows",
        stop=exhausted(one, other),
        progress=lambda live: seen.append(live.transmission_error),
    )
    assert seen[-1] is None, "without a ratio there is none"


def test_each_end_condition_ends_the_recording(tmp_path):
    blocks = [([0.01 * i], [0.0]) for i in range(40)]
    one, other = Scripted("input_angle", blocks), Scripted("torque", blocks[:20], unit="N*m")
    found = record_encoders([one, other], tmp_path / "a.arrows", samples=20)
    assert found.samples == {"input_angle": 21, "torque": 20}, "every channel has them, and what has come is taken"
    for number, stop in enumerate(({"duration": 0.15}, {"idle": 0.15})):
        one = Scripted("input_angle", blocks[:5])
        begun = time.monotonic()
        assert record_encoders([one], tmp_path / f"{number}.arrows", **stop).samples == {"input_angle": 5}
        assert time.monotonic() - begun >= 0.15
        assert one.closed == 0, "whoever opened it closes it"
    with pytest.raises(edge.InputError, match="not overwritten"):
        record_encoders([one], tmp_path / "a.arrows", samples=1)


def test_rates_are_over_about_the_last_second(tmp_path, monkeypatch):
    """With a clock that advances by 0.3 s at each reading, so that a second is a few readings."""
    shown, seen = [0.0], []

    def clock():
        shown.append(shown[-1] + 0.3)
        return shown[-1]

    one = Scripted("input_angle", [(np.linspace(0.0, 1.0, i + 1), np.zeros(i + 1)) for i in range(40)])
    monkeypatch.setattr(time, "monotonic", clock)

    def progress(live):
        state = live.channels["input_angle"]
        seen.append((shown[-1], state.samples, state.rate))

    record_encoders([one], tmp_path / "a.arrows", stop=exhausted(one), progress=progress)
    refreshed = seen[0]
    for now, samples, rate in seen[1:]:
        if rate == refreshed[2]:
            assert now - refreshed[0] < 1.0
            continue
        assert 1.0 <= now - refreshed[0] < 2.5
        assert rate == pytest.approx((samples - refreshed[1]) / (now - refreshed[0]))
        refreshed = now, samples, rate
    assert refreshed[0] > 10.0


def clocks(path, channel):
    said = [e for e in read_recording(path).events if "device clock" in e.text or "{" in e.text]
    return [json.loads(e.text[e.text.index("{") :]) for e in said if e.channel == channel]


def test_a_device_clock_is_reported_every_ten_seconds_and_at_each_restart(tmp_path):
    """The drift is found from the arrivals, before and after a restart."""
    host = np.linspace(0.0, 12.0, 200)
    early, late = (host[:150], (1 + 1e-3) * host[:150] + 7.0), (host[150:], (1 + 1e-3) * host[150:] + 7.0)
    again = 13.0 + host[:150], (1 - 2e-3) * host[:150] + 1.0
    script = [(t, np.zeros(len(t)), {"time_device": d}) for t, d in (early, late, again)]
    one = Scripted("input_angle", script)
    record_encoders([one], tmp_path / "a.arrows", stop=exhausted(one))
    found = clocks(tmp_path / "a.arrows", "input_angle")
    assert [f["restarts"] for f in found] == [0, 0, 1, 1], "after 10 s, at the restart, 10 s after it, at the end"
    for one, drift in zip(found, (-1e-3, -1e-3, 2e-3, 2e-3), strict=True):
        assert one["drift"] == pytest.approx(drift, abs=1e-5)
    short = Scripted("input_angle", script[:1])
    record_encoders([short], tmp_path / "b.arrows", stop=exhausted(short))
    assert [f["restarts"] for f in clocks(tmp_path / "b.arrows", "input_angle")] == [0], "only at the end"


def test_a_calendar_clock_that_is_set_is_an_event(tmp_path, monkeypatch):
    real, ahead = time.time, [0.0]
    monkeypatch.setattr(time, "time", lambda: real() + ahead[0])
    one = Scripted("input_angle", [([0.1], [0.0]), ([0.2], [0.0]), ([0.3], [0.0])])
    steps = iter((0.05, 3600.0, 3600.0))

    def progress(live):
        ahead[0] = next(steps, 3600.0)

    found = record_encoders([one], tmp_path / "a.arrows", progress=progress, stop=exhausted(one))
    (event,) = read_recording(tmp_path / "a.arrows").events
    assert "clock was set by +3599.9" in event.text
    assert found.samples == {"input_angle": 3}
    assert found.events == 1


def test_a_failed_channel_is_named_and_the_others_continue(tmp_path, monkeypatch):
    lost = EncoderTimeout("output_angle: it does not answer.")
    one, other = Scripted("input_angle", [([0.1], [1.0])]), Scripted("output_angle", [lost])
    found = record_encoders([one, other], tmp_path / "a.arrows", stop=exhausted(one, other))
    assert found.failures == (lost,)
    assert found.samples == {"input_angle": 1, "output_angle": 0}
    alone = Scripted("output_angle", [lost])
    with pytest.raises(EncoderTimeout, match="does not answer"):
        record_encoders([alone], tmp_path / "b.arrows", stop=exhausted(alone))
    assert not [t for t in threading.enumerate() if t.name.startswith("reopen")], "nothing is tried any more"
    assert any("failed and will be reopened" in e.text for e in read_recording(tmp_path / "b.arrows").events)


def test_a_full_disk_leaves_the_written_samples(tmp_path, monkeypatch):
    blocks = [([0.1 * i, 0.1 * i + 0.05], [0.0, 1.0]) for i in range(9)]
    one, real = Scripted("input_angle", blocks), session.RecordingWriter.write

    def full(self, samples, events=()):
        if len(samples) and samples.time_host[0] > 0.35:
            raise OSError(errno.ENOSPC, "No space left on device")
        real(self, samples, events)

    monkeypatch.setattr(session.RecordingWriter, "write", full)
    with pytest.raises(session.RecordingError, match=r"a\.arrows: the disk is full or failed \(No space"):
        record_encoders([one], tmp_path / "a.arrows", stop=exhausted(one))
    assert len(read_recording(tmp_path / "a.arrows").samples["input_angle"]) == 8


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_an_interrupted_recording_is_complete_and_a_second_signal_ends_at_once(tmp_path, number):
    before = signal.getsignal(number)
    one = Scripted("input_angle", [([0.1 * i], [float(i)]) for i in range(9)])
    with pytest.raises(session.RecordingInterrupted) as ending:
        record_encoders([one], tmp_path / "a.arrows", progress=lambda live: os.kill(os.getpid(), number))
    assert (ending.value.recorded.ended, ending.value.exit_status) == (number.name, 128 + number)
    assert ending.value.recorded.samples == {"input_angle": 2}
    kept = read_recording(tmp_path / "a.arrows")
    assert kept.problems == ()
    assert kept.samples["input_angle"].value.tolist() == [0.0, 1.0], "what was at hand is taken too"
    assert signal.getsignal(number) == before

    def twice(live):
        os.kill(os.getpid(), number)
        os.kill(os.getpid(), number)
        if number != signal.SIGHUP:  # a closed terminal sends several
            pytest.fail("the second is obeyed at once")

    with pytest.raises(KeyboardInterrupt) as ending:
        record_encoders([one], tmp_path / "b.arrows", progress=twice)
    assert isinstance(ending.value, session.RecordingInterrupted) == (number == signal.SIGHUP)


def test_the_report_of_a_full_disk_agrees_with_the_file(tmp_path, monkeypatch):
    """A batch that cannot be written is not counted, not even while it is being written."""
    blocks = [([0.1 * i, 0.1 * i + 0.05], [0.0, 1.0]) for i in range(9)]
    one, real, counted = Scripted("input_angle", blocks), os.write, []

    def full(descriptor, data):
        if os.fstat(descriptor).st_size > 2500:
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(descriptor, data)

    monkeypatch.setattr(os, "write", full)
    with pytest.raises(session.RecordingError) as problem:
        record_encoders(
            [one],
            tmp_path / "a.arrows",
            stop=exhausted(one),
            progress=lambda live: counted.append(live.samples["input_angle"]),
        )
    held = len(read_recording(tmp_path / "a.arrows").samples["input_angle"])
    assert 0 < held < 18
    assert str(problem.value).endswith(f"all data written before are kept: {held} input_angle.")
    assert counted[-1] == held


@pytest.mark.system
def test_a_delay_of_the_recorder_is_not_silence_of_the_line(tmp_path):
    """The recorder is stopped for longer than the idle time; samples arrive meanwhile or afterwards."""

    class Waiting(Scripted):
        def drain(self):
            self.script.append(([0.3], [3.0])) if not self.drained else None
            self.drained = True

    one = Waiting("input_angle", [([0.1], [0.0]), None, ([0.2], [1.0])])
    one.drained = False
    stood = iter([0.4])
    begun = time.monotonic()
    found = record_encoders([one], tmp_path / "a.arrows", idle=0.3, progress=lambda live: time.sleep(next(stood, 0.0)))
    assert (found.samples, found.ended) == ({"input_angle": 3}, "idle")
    assert time.monotonic() - begun > 0.4 + 2 * 0.3 - 0.1


BENCH = 'format = "cycloid-bench/1"\n{}[port.a]\nurl = "COM1"\n[channel.input_angle]\nprotocol = "amt21"\nport = "a"\n'


def test_a_bench_file_states_drive_conditions_and_wiring(tmp_path):
    path = tmp_path / "bench.toml"
    stated = 'ratio = -39\npair = "p"\n[conditions]\nload = "2 kN*m"\nspeed = "60 rpm"\ntemperature = "298.15 K"\n'
    path.write_text(BENCH.format(stated + 'direction = "backward"\n'))
    bench = read_bench(path)
    assert (bench.ratio, bench.pair) == (-39.0, "p")
    assert bench.conditions == {
        "load": pytest.approx(2000.0),
        "speed": pytest.approx(2.0 * math.pi),
        "temperature": pytest.approx(298.15),
        "direction": "backward",
    }
    assert [e.name for e in bench.encoders()] == ["input_angle"]
    path.write_text(BENCH.format(""))
    assert (read_bench(path).ratio, read_bench(path).pair, dict(read_bench(path).conditions)) == (None, "", {})
    for ratio in ("0", "nan", "inf", "-inf"):
        path.write_text(BENCH.format(f"ratio = {ratio}\n"))
        with pytest.raises(edge.InputError, match="write the signed ratio"):
            read_bench(path)
    path.write_text('format = "cycloid-bench/1"\n[channel]\n')
    with pytest.raises(edge.InputError, match="at least one table"):
        read_bench(path)
