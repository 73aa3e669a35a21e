import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cycloid_fmu import edge
from drivers.recording_format import GAP, Channel, Header, RecordingWriter, Samples
from fitting.recording import read_bench_recording

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
    found = read_bench_recording(path)
    assert found.time == pytest.approx([0, 5e-3])
    assert found.input_angle == pytest.approx([0, np.pi])
    assert found.output_angle == pytest.approx([0, np.pi / 180])
    assert found.torque == pytest.approx([1e3, 2e3])


@given(turns=st.integers(1, 5), forwards=st.booleans(), start=st.floats(0, 6.28))
def test_an_angle_recorded_within_one_turn_is_continuous(tmp_path_factory, turns, forwards, start):
    angle = start + (1 if forwards else -1) * np.linspace(0, 2 * np.pi * turns, 40 * turns)
    rows = [f"{i},{a % (2 * np.pi):.12f},0,1" for i, a in enumerate(angle)]
    found = read_bench_recording(csv(tmp_path_factory.mktemp("csv"), *rows))
    assert np.diff(found.input_angle) == pytest.approx(np.diff(angle), abs=1e-9)


@pytest.mark.parametrize(
    ("rows", "header", "said"),
    [
        ([], HEADER, "no samples"),
        (["0,0,0,1"], HEADER, "1 samples"),
        (["0,0,0,1", "1,nan,0,1"], HEADER, "input_angle is not a finite number in sample 1"),
        (["0,0,0,1", "1,1,0,x"], HEADER, 'line 3: torque is "x"'),
        (["0,0,0,1", "1,1,0"], HEADER, 'line 3: torque is ""'),
        (['0,0,0,"1,5"', '1,1,0,"1,5"'], HEADER, 'line 2: torque is "1,5"'),
        (["0,0,0", "1,1,1"], "time [s],input_angle [rad],output_angle [rad]", 'no column "torque [N*m]"'),
        (["0,0,0,1"], "time [s],input_angle,output_angle [rad],torque [N*m]", '"input_angle" has no unit'),
        (["0,0,0,1"], "time [s],input_angle [mm],output_angle [rad],torque [N*m]", "input_angle: the unit"),
        (["0,0,0,1"], "time [s],input_angle [parsec2],output_angle [rad],torque [N*m]", "input_angle: the unit"),
    ],
)
def test_a_bad_table_is_one_sentence(tmp_path, rows, header, said):
    with pytest.raises(edge.InputError) as refused:
        read_bench_recording(csv(tmp_path, *rows, header=header))
    assert said in str(refused.value)
    assert "run.csv" in str(refused.value)
    assert "\n" not in str(refused.value)


def test_an_empty_file_and_another_kind_of_file(tmp_path):
    (tmp_path / "a.csv").write_text("")
    with pytest.raises(edge.InputError, match="empty"):
        read_bench_recording(tmp_path / "a.csv")
    (tmp_path / "a.xlsx").write_text("x")
    with pytest.raises(edge.InputError, match="ending must be"):
        read_bench_recording(tmp_path / "a.xlsx")
    (tmp_path / "a.arrows").write_text("not arrow")
    with pytest.raises(edge.InputError, match="not a recording"):
        read_bench_recording(tmp_path / "a.arrows")


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
    found = read_bench_recording(arrows(tmp_path / "a.arrows"))
    assert found.ratio == -39.0
    assert found.output_angle == pytest.approx(-found.input_angle / 39)
    assert found.common_zero
    assert found.notes == ()


def test_angles_of_different_instants_are_interpolated_and_it_says_so(tmp_path):
    found = read_bench_recording(arrows(tmp_path / "a.arrows", shift=4e-4))
    assert found.output_angle == pytest.approx(-(found.time - 4e-4) / 39, abs=1e-12)
    assert any("interpolated" in note for note in found.notes)


def test_what_a_recording_lacks_is_named(tmp_path):
    with pytest.raises(edge.InputError, match="no torque channel"):
        read_bench_recording(arrows(tmp_path / "a.arrows", names=("input_angle", "output_angle")))
    with pytest.raises(edge.InputError, match="no samples"):
        read_bench_recording(arrows(tmp_path / "b.arrows", samples=0))


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
    found = read_bench_recording(tmp_path / "a.arrows")
    last = (n - 1) // torque_step * torque_step
    assert found.time == pytest.approx(time[: last + 1])
    assert found.output_angle == pytest.approx(-found.input_angle / 39)
    assert found.torque == pytest.approx(50 + found.time)
    assert not found.status.any()


def test_a_sample_that_is_no_number_is_left_out_marked_and_named(tmp_path):
    found = read_bench_recording(arrows(tmp_path / "c.arrows", nan=True))
    assert found.time.size == 49
    assert np.flatnonzero(found.status & GAP).tolist() == [7]
    assert "output_angle is not a finite number in sample 7" in found.notes[0]
