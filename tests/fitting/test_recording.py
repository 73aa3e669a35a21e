import numpy as np
import pytest
from common import draws
from hypothesis import example, given
from hypothesis import strategies as st

import fitting
from cycloid_fmu import edge
from drivers.recorder.clock import ClockEstimate
from drivers.recording_format import (
    GAP,
    Channel,
    Header,
    RecordingWriter,
    Samples,
    clock_event,
    read_clocks,
    read_recording,
)
from fitting.figures.metrics import figures_of
from fitting.readers.formats import Piece
from fitting.readers.recording import RecordingStream
from fitting.samples.one_clock import OneClock
from fitting.transmission_error.survey import survey

ARCSEC = np.pi / 648000
HEADER = "time [s],input_angle [rad],output_angle [rad],torque [N*m]"


def csv(tmp_path, *rows, header=HEADER):
    path = tmp_path / "run.csv"
    path.write_text("\n".join([header, *rows]) + "\n")
    return path


def test_units_of_the_header_become_si(tmp_path):
    path = csv(
        tmp_path, "0,0,0,1", "5,180,60,2", header="time [ms],input_angle [deg],output_angle [arcmin],torque [kN*m],note"
    )
    path.write_text(path.read_text().replace("0,0,0,1", "0,0,0,1,a").replace("60,2", "60,2,b"))
    found = RecordingStream(path).read()
    assert found.time == pytest.approx([0, 5e-3])
    assert found.input_angle == pytest.approx([0, np.pi])
    assert found.output_angle == pytest.approx([0, np.pi / 180])
    assert found.torque == pytest.approx([1e3, 2e3])


@draws(20, 100, 1, turns=st.integers(1, 5), forwards=st.booleans(), start=st.floats(0, 6.28))
def test_an_angle_recorded_within_one_turn_is_continuous(tmp_path_factory, turns, forwards, start):
    angle = start + (1 if forwards else -1) * np.linspace(0, 2 * np.pi * turns, 40 * turns)
    rows = [f"{i},{a % (2 * np.pi):.12f},0,1" for i, a in enumerate(angle)]
    found = RecordingStream(csv(tmp_path_factory.mktemp("csv"), *rows)).read()
    assert np.diff(found.input_angle) == pytest.approx(np.diff(angle), abs=1e-9)


@pytest.mark.parametrize(
    ("rows", "header", "said"),
    [
        ([], HEADER, "no samples"),
        (["0,0,0,1"], HEADER, "1 samples"),
        (["0,0,0,1", "1,nan,0,1"], HEADER, "input_angle is not a finite number in sample 1"),
        (["0,0,0,1", "1,1,0,x"], HEADER, 'line 3: torque is "x"'),
        (["0,0,0,1", "1,1,0"], HEADER, "line 3: it has 3 cells, the table 4"),
        (['0,0,0,"1,234"', '1,1,0,"1,234"'], HEADER, 'line 2: torque is "1,234"'),
        (["0,0,0", "1,1,1"], "time [s],input_angle [rad],output_angle [rad]", 'no column "torque [N*m]"'),
        (["0,0,0,1"], "time [s],input_angle,output_angle [rad],torque [N*m]", '"input_angle" has no unit'),
        (["0,0,0,1"], "time [s],input_angle [mm],output_angle [rad],torque [N*m]", "input_angle: the unit"),
        (["0,0,0,1"], "time [s],input_angle [parsec2],output_angle [rad],torque [N*m]", "input_angle: the unit"),
    ],
)
def test_a_bad_table_is_one_sentence(tmp_path, rows, header, said):
    with pytest.raises(edge.InputError) as refused:
        RecordingStream(csv(tmp_path, *rows, header=header)).read()
    assert said in str(refused.value)
    assert "run.csv" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_an_empty_file_and_another_kind_of_file(tmp_path):
    (tmp_path / "a.csv").write_text("")
    with pytest.raises(edge.InputError, match="empty"):
        RecordingStream(tmp_path / "a.csv").read()
    (tmp_path / "a.xlsx").write_text("x")
    with pytest.raises(edge.InputError, match="ending must be"):
        RecordingStream(tmp_path / "a.xlsx").read()
    (tmp_path / "a.arrows").write_text("not arrow")
    with pytest.raises(edge.InputError, match="not a recording"):
        RecordingStream(tmp_path / "a.arrows").read()


def arrows(path, *, names=("input_angle", "output_angle", "torque"), shift=0.0, samples=50, nan=False):
    units = {"torque": "N*m"}
    channels = tuple(
        Channel(n, n, "test", units.get(n, "rad"), None, 1, 0.0, "absolute", "", "host clock") for n in names
    )
    header = Header(channels, {}, -39.0, "pair", "2026-01-01T00:00:00+00:00")
    time = np.arange(samples) * 1e-3
    with RecordingWriter(path, header) as writer:
        for n in names:
            value = {"input_angle": time, "output_angle": -time / 39, "torque": np.full(samples, 50.0)}[n].copy()
            if nan and n == "output_angle":
                value[7] = np.nan
            if samples:
                writer.write(Samples.checked(n, time + (shift if n == "output_angle" else 0.0), value))
    return path


def test_a_recording_of_ours(tmp_path):
    found = RecordingStream(arrows(tmp_path / "a.arrows")).read()
    assert found.ratio == -39.0
    assert found.output_angle == pytest.approx(-found.input_angle / 39)
    assert found.common_zero
    assert found.notes == ()


def test_angles_of_different_instants_are_interpolated_and_it_says_so(tmp_path):
    found = RecordingStream(arrows(tmp_path / "a.arrows", shift=4e-4)).read()
    assert found.output_angle == pytest.approx(-(found.time - 4e-4) / 39, abs=1e-12)
    assert any("interpolated" in note for note in found.notes)


def test_what_a_recording_lacks_is_named(tmp_path):
    with pytest.raises(edge.InputError, match="no torque channel"):
        RecordingStream(arrows(tmp_path / "a.arrows", names=("input_angle", "output_angle"))).read()
    with pytest.raises(edge.InputError, match="no samples"):
        RecordingStream(arrows(tmp_path / "b.arrows", samples=0)).read()


@pytest.mark.parametrize("torque_step", [1, 10])
def test_channels_in_small_batches_of_their_own_come_together(tmp_path, torque_step):
    """As a recorder writes them: batches of odd sizes in turn, many of them, the torque slower."""
    n = 30000
    time = np.arange(n) * 1e-3
    values = {"input_angle": 5 * time, "output_angle": -5 * time / 39, "torque": 50 + time}
    channels = tuple(
        Channel(c, c, "test", "N*m" if c == "torque" else "rad", None, 1, 0.0, "absolute", "", "host") for c in values
    )
    with RecordingWriter(tmp_path / "a.arrows", Header(channels, {}, -39.0, "", "2026-01-01T00:00:00+00:00")) as writer:
        for begin in range(0, n, 230):
            for number, (c, value) in enumerate(values.items()):
                step = torque_step if c == "torque" else 1
                part = slice(begin + 70 * number if begin else 0, min(n, begin + 230 + 70 * number))
                at = np.arange(n)[part]
                at = at[at % step == 0]
                if at.size:
                    writer.write(Samples.checked(c, time[at], value[at]))
    found = RecordingStream(tmp_path / "a.arrows").read()
    last = (n - 1) // torque_step * torque_step
    assert found.time == pytest.approx(time[: last + 1])
    assert found.output_angle == pytest.approx(-found.input_angle / 39)
    assert found.torque == pytest.approx(50 + found.time)
    assert not found.status.any()


def test_a_sample_that_is_no_number_is_left_out_marked_and_named(tmp_path):
    found = RecordingStream(arrows(tmp_path / "c.arrows", nan=True)).read()
    assert found.time.size == 49
    assert np.flatnonzero(found.status & GAP).tolist() == [7]
    assert "output_angle is not a finite number in sample 7" in found.notes[0]


SPEED = 100 * 2 * np.pi / 60  # of the crank, rad/s: 100 rpm
DRIFT = 100e-6


def error(angle):
    return 20 * ARCSEC * np.cos(angle)


def drifting(path, *, seconds=100.0, rate=500.0, delay=1e-3, restart=False, both=False, source=""):
    """Output angles stamped by a clock that runs 100 ppm fast, reaching the host late; the crank's by the host's own.

    With `restart` the output's clock restarts half way, with `both` it stamps both angles at the same instants, with
    a `source` that names a device it stamps both, each at its own.
    """
    rng = np.random.default_rng(3)
    time = np.arange(int(seconds * rate)) / rate
    later = time if both else time + 0.3 / rate
    instants = {"input_angle": time, "output_angle": later}
    devices = {name: at * (1 + DRIFT) + 5000.0 for name, at in instants.items()}
    half = time.size // 2
    if restart:
        devices["output_angle"][half:] -= devices["output_angle"][half] - 0.1
    late = {name: rng.exponential(delay, time.size) for name in ("output_angle", "input_angle")}
    if both:
        late["input_angle"] = late["output_angle"]
    arrivals = {name: np.maximum.accumulate(at + late[name]) for name, at in instants.items()}
    angles = {"input_angle": SPEED * time, "output_angle": -SPEED * later / 39 + error(SPEED * later)}
    channels = tuple(Channel(n, n, "t", "rad", None, 1, 0.0, "absolute", "", source) for n in angles)
    channels += (Channel("torque", "torque", "t", "N*m", None, 1, 0.0, "absolute", "", ""),)
    owned = ("input_angle", "output_angle") if both or source else ("output_angle",)
    clocks, restarts = {n: ClockEstimate() for n in owned}, 0
    with RecordingWriter(path, Header(channels, {}, -39.0, "", "2026-01-01T00:00:00+00:00")) as writer:
        for begin in range(0, time.size, 250):
            s = slice(begin, begin + 250)
            if restart and begin == half:
                clocks, restarts = {n: ClockEstimate() for n in owned}, 1
            writer.write(Samples.checked("torque", time[s], np.full(250, 50.0)))
            for name, angle in angles.items():
                if name not in owned:
                    writer.write(Samples.checked(name, time[s], angle[s]))
                    continue
                device, arrived = devices[name], arrivals[name]
                clocks[name].add(device[s], arrived[s])
                said = []
                if (fit := clocks[name].fit()) is not None:
                    said = [clock_event(arrived[s][-1], name, fit, restarts)]
                writer.write(Samples.checked(name, arrived[s], angle[s], time_device=device[s]), said)
    return path


def left(time, output, at, crank):
    """The transmission error that is not the drive's, rad, where the output angle is taken to be of these times."""
    kept = slice(10, -10)
    return (np.interp(at, time, output) + crank / 39 - error(crank))[kept], at[kept]


@pytest.mark.parametrize("restart", [pytest.param(False, marks=pytest.mark.slow(5)), True])
def test_two_clocks_that_drift_apart_are_put_on_one(tmp_path, restart):
    """100 ppm at 100 rpm let the transmission error run away by 5.5″ a second; 1 ms of delay is 55″."""
    path = drifting(tmp_path / "a.arrows", restart=restart)
    raw = read_recording(path).samples
    output, crank = raw["output_angle"], raw["input_angle"]
    if not restart:
        bare = output.time_device - output.time_device[0] + 0.3 / 500
        runs, at = left(bare, output.value, crank.time_host, crank.value)
        assert np.polyfit(at, runs, 1)[0] == pytest.approx(DRIFT * SPEED / 39, rel=0.02)
    late, _ = left(output.time_host, output.value, crank.time_host, crank.value)
    assert np.std(late) > 30 * ARCSEC
    found = RecordingStream(path).read()
    rest, at = left(found.time, found.output_angle, found.time, found.input_angle)
    ramp = np.polyfit(at, rest, 1)[0] * 100.0
    reach = 2 * found.alignment * SPEED / 39
    assert 0.0 < reach < 1.0 * ARCSEC
    assert abs(ramp) < reach + 0.02 * ARCSEC
    assert np.std(rest) < 0.1 * ARCSEC
    clocks = read_clocks(path, ["output_angle"])["output_angle"]
    assert len(clocks) == 1 + restart
    assert found.alignment == max(c.uncertainty for c in clocks.values())
    (note,) = (n for n in found.notes if "has its own clock" in n)
    assert "output_angle has its own clock, which runs +100 ppm fast" in note


def test_what_is_left_of_the_drift_is_in_the_figure_s_uncertainty(tmp_path):
    """Few samples with long delays: the clock is known badly, so the transmission error is too."""
    path = drifting(tmp_path / "a.arrows", seconds=60.0, rate=100.0, delay=20e-3)
    surveyed = survey(RecordingStream(path), None, None)
    (curve,) = surveyed.curves
    figure = figures_of([surveyed], -39.0, None).figures["angular_transmission_error"]
    run_away = 2 * RecordingStream(path).read().alignment * SPEED / 39
    assert surveyed.runaway == pytest.approx(run_away, rel=0.02)
    assert figure.uncertainty >= surveyed.runaway / curve.turns > 1e-3 * ARCSEC
    assert abs(figure.value - 40 * ARCSEC) < figure.uncertainty + 0.1 * ARCSEC


def test_angles_that_one_clock_stamped_stay_pairs(tmp_path):
    """Latched by one SYNC and stamped by one interface: whatever its clock does, no instant is made two."""
    found = RecordingStream(drifting(tmp_path / "a.arrows", seconds=20.0, both=True)).read()
    assert found.alignment == 0.0
    assert found.time.size > 9000
    assert not any("interpolated" in note for note in found.notes)
    assert found.output_angle == pytest.approx(-found.input_angle / 39 + error(found.input_angle), abs=1e-12)
    assert fitting.curves(found, -39.0)[0].turns == pytest.approx(20 * SPEED / (2 * np.pi * 39), rel=1e-3)


def test_timers_of_their_own_on_one_interface_are_put_on_the_host_s_clock_once(tmp_path):
    """Both angles' frames are stamped by one CAN interface: the uncertainty of its clock moves both alike."""
    source = 'hardware clock: the CAN interface\'s stamp of the frame (pcan "PCAN_USBBUS{}")'
    runs = {}
    for name, said in (("one", source.format(1)), ("unknown", "host clock: arrival")):
        path = drifting(tmp_path / f"{name}.arrows", seconds=60.0, rate=100.0, delay=20e-3, source=said)
        found = RecordingStream(path).read()
        rest, _ = left(found.time, found.output_angle, found.time, found.input_angle)
        runs[name] = found.alignment, abs(float(np.mean(rest)))
    assert runs["one"][0] == 0.0 < runs["unknown"][0]
    assert runs["one"][1] < 0.2 * runs["unknown"][1]
    assert runs["unknown"][1] < runs["unknown"][0] * SPEED / 39


def test_without_a_clock_of_its_own_only_the_first_samples_are_read(tmp_path):
    path = arrows(tmp_path / "a.arrows", samples=5000)
    assert read_clocks(path, ["input_angle", "output_angle", "torque"]) == {}


@pytest.mark.slow(3)
@example(sizes=[(1, 20_002), (0, 20_001), (2, 20_001)], lacks=True)  # the gap is the last sample put on one clock
@given(sizes=st.lists(st.tuples(st.integers(0, 2), st.integers(1, 9000)), max_size=20), lacks=st.booleans())
def test_channels_taken_at_the_same_instants_come_through_as_they_are(sizes, lacks):
    roles = ("input_angle", "output_angle", "torque")
    whole = 40_000
    number = np.arange(whole)
    time = number / 4000.0
    values = {role: np.sin((place + 1) * time) for place, role in enumerate(roles)}
    status = {"input_angle": number % 2 * 2, "output_angle": number % 3 // 2 * 4, "torque": time > 5}
    merge = OneClock({role: (role, 1.0, 0.0) for role in roles}, None, dict.fromkeys(roles, (0.0, 0.0)))
    came, found = dict.fromkeys(roles, 0), []
    for which, size in [*sizes, *((place, whole) for place in range(3))]:
        role, part = roles[which], slice(came[roles[which]], min(came[roles[which]] + size, whole))
        keep = np.flatnonzero(~((np.arange(whole)[part] == 20_000) & lacks & (role == "output_angle"))) + part.start
        if part.stop > part.start:
            bits = (status[role][keep] * (128 if role == "torque" else 1)).astype(np.uint8)
            found += merge.add(Piece(time[keep], {role: values[role][keep]}, bits))
        came[role] = part.stop
    found += merge.finish()
    expected = np.flatnonzero(~((np.arange(whole) == 20_000) & lacks))
    np.testing.assert_array_equal(np.concatenate([table["time"] for table, _ in found]), time[expected])
    for role in roles:
        np.testing.assert_array_equal(np.concatenate([table[role] for table, _ in found]), values[role][expected])
    bits = np.concatenate([bits for _, bits in found])
    marks = status["input_angle"] | status["output_angle"] | (128 * status["torque"])
    gap = GAP * ((expected == 20_001) & lacks)
    np.testing.assert_array_equal(bits, marks[expected] | gap)
    assert len(merge.notes()) == lacks
