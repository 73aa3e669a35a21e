"""Effects of the drive are never marked; a stuck encoder, a jump and a deviation from the ratio always are."""

import dataclasses
import itertools
import math

import numpy as np
import pytest
from common import study_size
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import drivers
from drivers import recording_format as rf
from drivers.live_page.server import Watcher
from drivers.recording_format import ANGLES, GAP, IMPLAUSIBLE, Limits, Plausibility, Samples, read_recording
from drivers.simulated.buses import SimulatedCan
from drivers.simulated.motion import SimulatedRun, simulate_hysteresis, simulate_motion

ARCMIN = math.pi / 10800
EXAMPLES = study_size("CYCLOID_MUTATIONS", 1e5, 1e6) // 1000  # per check in the slow set


@dataclasses.dataclass
class Run:
    """Angles of a bench on one clock, resolutions of the encoders, and largest speed of the output, rad/s."""

    ratio: float
    time: np.ndarray = dataclasses.field(repr=False)
    input_angle: np.ndarray = dataclasses.field(repr=False)
    output_angle: np.ndarray = dataclasses.field(repr=False)
    status: np.ndarray = dataclasses.field(repr=False)
    limits: Limits
    speed: float

    def judged(self, cuts=()):
        """Return the masks of implausible samples and the findings, for any division into blocks."""
        judge = Plausibility(self.ratio, self.limits)
        borders = np.unique([0, *(int(c * self.time.size) for c in cuts), self.time.size])
        marks, found = [], []
        for a, b in itertools.pairwise(borders):
            block = {r: Samples(r, self.time[a:b], None, None, getattr(self, r)[a:b], self.status[a:b]) for r in ANGLES}
            by_role, said = judge.add(block)
            marks.append(by_role["input_angle"] | by_role["output_angle"])
            found += said
        return np.concatenate(marks), found


@st.composite
def runs(draw, reversals=True):
    """Runs of a bench with backlash, windup, load steps, reversals, standstills, noise, gaps and encoder steps."""
    ratio = draw(st.floats(5.0, 200.0)) * draw(st.sampled_from([1, -1]))
    crank = draw(st.floats(0.5, 300.0))  # rad/s
    each = draw(st.floats(0.01, 0.15 if reversals else min(0.15, 0.003 * abs(ratio))))  # crank rotation per sample, rad
    rate = crank / each
    random = np.random.default_rng(draw(st.integers(0, 1 << 32)))
    turns = draw(st.floats(3.0, 8.0)) * max(1.0, abs(ratio) / 30.0)
    size = min(int(turns * 2 * math.pi / crank * rate), 20_000)
    time = np.arange(size) / rate + draw(st.floats(0.0, 1e6))
    way = np.ones(size)
    if reversals:
        for at in draw(st.lists(st.floats(0.2, 0.9), max_size=3)):
            way[int(at * size) :] *= -1.0
        for at in draw(st.lists(st.floats(0.2, 0.9), max_size=1)):
            way[int(at * size) : int(at * size) + size // 10] = 0.0
    ramp = np.clip(np.arange(size) / (0.05 * size), 0.0, 1.0)
    angle = draw(st.floats(-1e3, 1e3)) + np.cumsum(way * ramp * crank / rate)
    play, windup = draw(st.floats(0.0, 8.0)) * ARCMIN, draw(st.floats(0.0, 8.0)) * ARCMIN
    load = np.sign(np.sin(2 * math.pi * np.arange(size) / size * draw(st.integers(0, 6)) + 0.1))
    deviation = 0.5 * play * np.sign(way) + windup * load + draw(st.floats(0.0, 1.0)) * ARCMIN * np.sin(angle)
    output = draw(st.floats(-10.0, 10.0)) + angle / ratio + deviation + random.normal(0.0, 1e-6, size)
    counts = [1 << draw(st.integers(low, 25)) for low in (10, 14)]
    angles = [
        np.round((v + random.normal(0.0, 1e-6, size)) * n / (2 * math.pi)) * 2 * math.pi / n
        for v, n in zip((angle, output), counts, strict=True)
    ]
    status = np.zeros(size, np.uint8)
    keep = np.ones(size, bool)
    for at in draw(st.lists(st.floats(0.1, 0.9), max_size=2)) if reversals else ():
        begin, lost = int(at * size), int(draw(st.integers(1, 100)))
        keep[begin : begin + lost] = False
        status[min(begin + lost, size - 1)] |= GAP
    stated = draw(st.booleans())
    limits = Limits(
        input_speed=1.2 * crank + 0.01 * rate if stated else None,
        input_resolution=2 * math.pi / counts[0],
        output_resolution=2 * math.pi / counts[1],
    )
    return Run(ratio, time[keep], angles[0][keep], angles[1][keep], status[keep], limits, crank / abs(ratio))


CUTS = st.lists(st.floats(0.0, 1.0), max_size=8)


def what_a_drive_does_of_itself_is_never_marked(run, cuts):
    marks, found = run.judged(cuts)
    assert found == []
    assert not marks.any()


def a_jump_of_half_a_turn_is_marked_until_the_angle_is_back(run, cuts, at, role, back):
    begin, end = int(at * run.time.size), int(0.8 * run.time.size) if back else run.time.size
    value = getattr(run, role)
    value[begin:end] += math.pi
    marks, found = run.judged(cuts)
    assert not marks[:begin].any()
    # A jump of the newest sample of a block shows only with the next sample.
    assert marks[begin + 1 : end].all()
    assert not marks[end + 2 :].any()
    assert [finding.roles for finding in found] == [(role,)]
    assert found[0].time == run.time[begin]
    assert "jumps by" in found[0].text


def a_stuck_encoder_is_marked_from_where_it_stands_still(run, cuts, at, role, lost):
    """`lost`: an incremental encoder continues from where it was stuck, an absolute one from the shaft's angle."""
    begin, end = int(at * run.time.size), int(0.8 * run.time.size)
    allowed = 2.0 * (math.radians(1.0) + 2.0 * run.limits.output_resolution + 0.02 * run.speed)
    line = run.input_angle / run.ratio
    if abs(line[end] - line[begin]) < 2.0 * allowed:
        return  # it turns less than the allowed deviation of a drive
    value = getattr(run, role)
    missed = value[end] - value[begin]
    value[begin:end] = value[begin]
    if lost:
        value[end:] -= missed
    marks, found = run.judged(cuts)
    while value[begin - 1] == value[begin]:  # a coarse encoder had this value before
        begin -= 1
    shown = begin + int(np.argmax(np.abs(line[begin:] - line[begin]) > allowed))
    assert not marks[: begin + 1].any()
    assert marks[shown:end].all()
    assert marks[end + 1 :].all() == lost
    assert len(found) >= 1
    assert found[0].roles == (role,)
    assert run.time[begin] <= found[0].time <= run.time[begin + 2]
    assert "is constant" in found[0].text
    if not cuts:
        assert marks[begin + 3 : shown].all(), "a whole recording is marked from the beginning of it"


def one_wrong_value_is_marked_alone(run, cuts, at, role):
    place = int(at * run.time.size)
    getattr(run, role)[place] += 2.0
    if any(abs(int(c * run.time.size) - place) < 3 for c in cuts):
        return
    marks, found = run.judged(cuts)
    assert np.flatnonzero(marks).tolist() == [place]
    assert len(found) == 1


CHECKS = {
    what_a_drive_does_of_itself_is_never_marked: {"run": runs(), "cuts": CUTS},
    a_jump_of_half_a_turn_is_marked_until_the_angle_is_back: {
        "run": runs(reversals=False),
        "cuts": CUTS,
        "at": st.floats(0.3, 0.5),
        "role": st.sampled_from(ANGLES),
        "back": st.booleans(),
    },
    a_stuck_encoder_is_marked_from_where_it_stands_still: {
        "run": runs(reversals=False),
        "cuts": CUTS,
        "at": st.floats(0.2, 0.3),
        "role": st.sampled_from(ANGLES),
        "lost": st.booleans(),
    },
    one_wrong_value_is_marked_alone: {
        "run": runs(reversals=False),
        "cuts": CUTS,
        "at": st.floats(0.4, 0.6),
        "role": st.sampled_from(ANGLES),
    },
}


@pytest.mark.parametrize("check", CHECKS, ids=lambda check: check.__name__)
@pytest.mark.parametrize("examples", [12, pytest.param(EXAMPLES, marks=pytest.mark.slow(1))])
def test_any_run_of_a_bench_is_judged_correctly(check, examples):
    wide = settings(max_examples=examples, deadline=None, suppress_health_check=[HealthCheck.too_slow])
    wide(given(**CHECKS[check])(check))()


@pytest.mark.parametrize("ratio", [-40.0, -36.0, -29.0, 39.0, -1 / 39.0, -39.0 * 57.3, -39.0 / 57.3])
def test_a_wrong_ratio_marks_no_sample(ratio):
    """The evaluation reports swapped angles, a wrong sign or unit and another drive, for the whole recording."""
    time = np.arange(20_000) / 1000
    angle = 20.0 * time
    run = Run(ratio, time, angle, -angle / 39, np.zeros(time.size, np.uint8), Limits(), 20.0 / 39)
    assert not run.judged(np.linspace(0, 1, 100))[0].any()


def test_a_locked_input_is_not_a_stuck_encoder():
    torque = 100.0 * np.sin(np.linspace(0.0, 4.0 * np.pi, 4000))
    windup = math.radians(1.5) * torque / 100.0
    run = Run(-39.0, np.arange(4000) / 100, np.zeros(4000), windup, np.zeros(4000, np.uint8), Limits(), 0.01)
    assert not run.judged()[0].any()


def test_an_angle_faster_than_its_largest_speed_is_a_jump_however_small():
    time = np.arange(2000) / 1000
    angle = 10.0 * time
    shown = angle + 0.2 * (time >= 1.0)
    limits = Limits(input_speed=12.0)
    run = Run(-39.0, time, shown, -angle / 39, np.zeros(2000, np.uint8), limits, 0.3)
    marks, found = run.judged()
    assert np.flatnonzero(marks).tolist() == list(range(1000, 2000))
    assert found[0].text == "input_angle jumps by 12.03 deg"


@pytest.mark.parametrize("jump", [5, 1000], ids=["before a line is known", "on the line"])
@pytest.mark.parametrize("role", ANGLES)
@pytest.mark.parametrize("cut", [-2, -1, 0, 1, 2])
def test_a_jump_and_its_return_are_the_same_however_the_samples_are_divided(role, jump, cut):
    """One finding for the jump and, on the line, none for the return."""
    time = np.arange(2000) / 1000
    angles = {"input_angle": 10.0 * time, "output_angle": -10.0 * time / 39}
    end = 1500 if jump > 5 else 2000  # without a line a return is another jump
    angles[role] = angles[role] + math.pi * ((time >= jump / 1000) & (time < end / 1000))
    run = Run(-39.0, time, **angles, status=np.zeros(2000, np.uint8), limits=Limits(), speed=0.3)
    whole, (finding,) = run.judged()
    divided, findings = run.judged([(jump + cut + 0.5) / 2000, (end + cut + 0.5) / 2000])
    assert np.flatnonzero(whole).tolist() == list(range(jump, 1500 if jump > 5 else 6))
    assert np.array_equal(divided, whole)
    assert [(f.time, f.roles) for f in findings] == [(finding.time, finding.roles)] == [(time[jump], (role,))]


def test_turns_missed_in_a_gap_are_not_a_jump():
    time = np.arange(4000) / 1000
    angle = 200.0 * time
    status = np.zeros(4000, np.uint8)
    seen = np.r_[0:1500, 2500:4000]
    status[2500] = GAP
    short = angle.copy()
    short[2500:] -= 2 * math.pi * np.round((angle[2500] - angle[1499]) / (2 * math.pi))
    run = Run(-39.0, time[seen], short[seen], -angle[seen] / 39, status[seen], Limits(), 5.0)
    assert not run.judged()[0].any()


class Stuck:
    """A drive whose output encoder is stuck for a while."""

    def __call__(self, angle, torque):
        output = angle / -39.0 + 2e-4 * np.sin(angle)
        output[700:1700] = output[700]
        return output


@pytest.mark.parametrize("trigger", ["controller", "timer"])
def test_a_stuck_encoder_is_recorded_as_it_came_and_judged_by_evaluation_and_page(tmp_path, bus_name, trigger):
    with drivers.simulate_bench(
        Stuck(),
        torque=20.0,
        ratio=-39.0,
        turns=30,
        bus=SimulatedCan(interface="virtual", channel=bus_name, trigger=trigger),
    ) as bench:
        done = bench.record(tmp_path / "run.arrows")
    recording = read_recording(done.path)
    assert not any((samples.status & IMPLAUSIBLE).any() for samples in recording.samples.values())
    assert not any("implausible" in event.text for event in recording.events)
    page = Watcher(done.path).refresh()
    marked = page["channels"][1]["marks"]["implausible"]
    assert 0.9 * 960 < marked < 1010 if trigger == "controller" else marked > 0
    said = [e for e in page["events"] if e["text"].startswith("implausible: output_angle is constant at ")]
    assert len(said) == 1
    sample = recording.samples["output_angle"].time_host
    assert sample[699] <= said[0]["time"] <= sample[705]


@pytest.mark.parametrize("hysteresis", [False, True])
@pytest.mark.parametrize("trigger", ["controller", "timer"])
def test_a_clean_simulated_run_has_no_mark(tmp_path, bus_name, trigger, hysteresis):
    with drivers.simulate_bench(
        lambda angle, torque: angle / -39.0 + 2e-4 * np.sin(angle) + 3e-5 * torque,
        torque=100.0,
        ratio=-39.0,
        turns=2,
        motion=drivers.SimulatedMotion(200, speed=4 * math.pi, noise=1e-6, hysteresis=hysteresis),
        bus=SimulatedCan(interface="virtual", channel=bus_name, trigger=trigger),
    ) as bench:
        done = bench.record(tmp_path / "run.arrows")
    assert all("implausible" not in channel["marks"] for channel in Watcher(done.path).refresh()["channels"])


def test_the_limits_are_stated_in_the_bench_file_and_in_the_recording(tmp_path, bus_name):
    with drivers.simulate_bench(
        torque=1.0, ratio=-39.0, turns=1, bus=SimulatedCan(interface="virtual", channel=bus_name)
    ) as bench:
        wiring = bench.write_wiring(tmp_path / "BENCH.toml")
        text = wiring.read_text().replace("[conditions]", 'largest_deviation = "20 arcmin"\n\n[conditions]')
        wiring.write_text(text.replace("node = 1\n", 'node = 1\nlargest_speed = "3000 rpm"\n'))
        drivers.record(wiring, tmp_path / "run.arrows", samples=96, idle="5 s")
    with rf.RecordingReader(tmp_path / "run.arrows") as reader:
        limits = rf.limits_of(reader.header)
    assert limits.deviation == pytest.approx(20 * ARCMIN)
    assert limits.input_speed == pytest.approx(100 * math.pi)
    assert limits.output_speed is None
    assert limits.input_resolution == pytest.approx(2 * math.pi / (1 << 22))


def test_simulated_motions_are_plausible_with_the_lost_motion_of_a_reversal():
    for made in (simulate_motion, simulate_hysteresis):
        motion = made(lambda a, t: a / -39 + 1e-5 * t, SimulatedRun(torque=100.0, turns=3, noise=1e-6))
        status = np.zeros(motion.time.size, np.uint8)
        run = Run(-39.0, motion.time, motion.input_angle, motion.output_angle, status, Limits(), 0.2)
        assert not run.judged()[0].any()
