"""One motion, written by other people's writers in every format, read back; then each file cut and damaged."""

import itertools
import subprocess
import sys
import threading
import tomllib
from importlib import metadata

import can
import cantools
import numpy as np
import pyarrow as pa
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from pyarrow import parquet

import fitting
from cycloid_fmu import edge
from drivers.recording_format import GAP
from fitting.readers import formats
from fitting.readers.first_samples import FirstSamples
from fitting.readers.formats import PIECE, BenchFile, RawChannel, open_bench_file, unit_text
from fitting.readers.inspection import Inspection, inspect, is_commanded, roles_of
from fitting.readers.mapping import read_mapping
from fitting.readers.recording import RecordingStream
from fitting.readers.tables import find_dialect
from fitting.transmission_error.survey import lag_of

SAMPLES = 4000
TIME = np.arange(SAMPLES) * 1e-3
INPUT = TIME * 100.0
OUTPUT = -INPUT / 39 + 1e-4 * np.cos(INPUT)
TORQUE = 20.0 + np.sin(TIME)


def same(found, *, angle=1e-9, torque=1e-9, time=1e-9):
    assert found.time.size == SAMPLES
    assert found.time - found.time[0] == pytest.approx(TIME, abs=time)
    assert found.input_angle - found.input_angle[0] == pytest.approx(INPUT, abs=angle)
    assert found.output_angle == pytest.approx(OUTPUT, abs=angle)
    assert found.torque == pytest.approx(TORQUE, abs=torque)


def mapping(tmp_path, text):
    path = tmp_path / "map.toml"
    path.write_text(f'format = "cycloid-mapping/1"\n{text}', encoding="utf-8")
    return read_mapping(path)


def rows_of(columns, delimiter, decimal):
    return [delimiter.join(f"{v:.12f}".replace(".", decimal) for v in row) for row in zip(*columns, strict=True)]


TABLES = list(
    itertools.product(
        ["utf-8", "utf-8-sig", "cp1252", "utf-16"],
        [(";", ","), ("\t", ","), (",", "."), ("|", ".")],
        ["brackets", "units row", "slash"],
    )
)


@pytest.mark.parametrize(
    ("encoding", "marks", "head"),
    # In the default set each encoding meets each pair of marks once, and each of them two heads or more.
    [
        pytest.param(*t, marks=[] if (k // 12 + k // 3) % 3 == k % 3 else pytest.mark.slow(0))
        for k, t in enumerate(TABLES)
    ],
)
def test_tables_as_benches_write_them(tmp_path, encoding, marks, head):
    delimiter, decimal = marks
    names, units = ["Zeit", "Motor", "Abtrieb", "Drehmoment ü"], ["ms", "°", "rad", "kNm"]
    columns = [TIME * 1e3, np.degrees(INPUT), OUTPUT, TORQUE / 1e3]
    if head == "brackets":
        top = [delimiter.join(f"{n} [{u}]" for n, u in zip(names, units, strict=True))]
    elif head == "slash":
        top = [delimiter.join(f"{n} / {u}" for n, u in zip(names, units, strict=True))]
    else:
        top = ["Prüfstand 3", "Bediener: Müller", "", delimiter.join(names), delimiter.join(units)]
    path = tmp_path / "lauf 3.csv"
    path.write_text("\r\n".join([*top, *rows_of(columns, delimiter, decimal)]) + "\r\n", encoding=encoding)
    mapped = mapping(
        tmp_path,
        'ratio = -39\n[time]\ncolumn = "Zeit"\n[input_angle]\ncolumn = "Motor"\n[output_angle]\ncolumn = "Abtrieb"\n'
        '[torque]\ncolumn = "Drehmoment ü"\n',
    )
    found = RecordingStream(path, mapped).read()
    same(found)
    assert found.ratio == -39.0


@given(
    delimiter=st.sampled_from([";", "\t", "|", ","]),
    comma=st.booleans(),
    width=st.integers(2, 6),
    rows=st.integers(1, 8),
    preamble=st.integers(0, 3),
    seed=st.integers(0, 10**6),
)
def test_the_dialect_of_any_table_is_found(delimiter, comma, width, rows, preamble, seed):
    decimal = "," if comma and delimiter != "," else "."
    rng = np.random.default_rng(seed)
    table = rng.normal(0.0, 10.0 ** rng.integers(-5, 6), (rows, width))
    lines = ["some words"] * preamble + [delimiter.join(f"c{i} [mm]" for i in range(width))]
    lines += [delimiter.join(f"{v:.6e}".replace(".", decimal) for v in row) for row in table]
    found = find_dialect(("\n".join(lines) + "\n").encode(), "t.csv")
    assert (found.delimiter, found.decimal, found.skip) == (delimiter, decimal, preamble + 1)
    assert found.header == tuple(f"c{i}" for i in range(width))
    assert set(found.units) == {"mm"}


@pytest.mark.parametrize(
    ("written", "read"), [("Nm", "N*m"), ("N·m", "N*m"), ("kNm", "kN*m"), ("°", "deg"), ("nm", "nm"), ("mrad", "mrad")]
)
def test_units_as_benches_write_them(written, read):
    assert unit_text(written) == read


def test_a_table_without_header_or_time_needs_a_mapping_that_says_so(tmp_path):
    path = tmp_path / "a.csv"
    path.write_text("\n".join(rows_of([INPUT, OUTPUT, TORQUE], ",", ".")) + "\n")
    with pytest.raises(edge.InputError, match="inspect"):
        RecordingStream(path).read()
    columns = "".join(
        f'[{role}]\ncolumn = "column {i}"\nunit = "{unit}"\n'
        for i, (role, unit) in enumerate((("input_angle", "rad"), ("output_angle", "rad"), ("torque", "N*m")), start=1)
    )
    same(RecordingStream(path, mapping(tmp_path, "[time]\nrate = 1000.0\n" + columns)).read())
    untimed = RecordingStream(path, mapping(tmp_path, columns)).read()
    assert not untimed.timed
    assert untimed.time.tolist() == list(range(SAMPLES))
    assert untimed.notes == (f"{path}: no time is mapped; times count samples, and speeds are unknown.",)


def test_counts_direction_rollover_and_temperature(tmp_path):
    """A 12 bit counter that runs backwards, an output that rolls over at 180°, a temperature in °C."""
    counts = np.round(-INPUT / (2 * np.pi) * 4096).astype(int) % 4096
    columns = [TIME, counts, np.degrees(OUTPUT) % 180, TORQUE, np.full(SAMPLES, 25.0)]
    path = tmp_path / "a.csv"
    header = "t [s];n;phi [deg];M [Nm];T [°C]\n"
    path.write_text(header + "\n".join(rows_of(columns, ";", ",")) + "\n", encoding="utf-8")
    mapped = mapping(
        tmp_path,
        '[time]\ncolumn = "t"\n[input_angle]\ncolumn = "n"\ncounts_per_turn = 4096\ndirection = -1\n'
        '[output_angle]\ncolumn = "phi"\nrollover = "180 deg"\n[torque]\ncolumn = "M"\n[temperature]\ncolumn = "T"\n',
    )
    found = RecordingStream(path, mapped).read()
    assert found.input_angle - found.input_angle[0] == pytest.approx(INPUT, abs=2 * np.pi / 4096)
    assert found.output_angle - found.output_angle[0] == pytest.approx(OUTPUT - OUTPUT[0], abs=1e-9)
    assert found.temperature == pytest.approx(298.15)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ('[torque]\ncolumn = "M"\n', "output_angle is missing"),
        ('[output_angle]\ncolumn = "a"\n[torque]\ncolumn = "M"\ncounts_per_turn = 5\n', "this is for angles"),
        ('[output_angle]\ncolumn = "a"\nunit = "deg"\ncounts_per_turn = 5\n[torque]\ncolumn = "M"\n', "no unit"),
        ('[time]\n[output_angle]\ncolumn = "a"\n[torque]\ncolumn = "M"\n', "needs a column, or a rate"),
        ('[time]\nrate = -1\n[output_angle]\ncolumn = "a"\n[torque]\ncolumn = "M"\n', "above zero"),
        ('[output_angle]\ncolumn = "a"\ndirection = 2\n[torque]\ncolumn = "M"\n', "direction"),
    ],
)
def test_a_bad_mapping_is_one_sentence(tmp_path, text, said):
    with pytest.raises(edge.InputError, match=said) as refused:
        mapping(tmp_path, text)
    assert "map.toml" in str(refused.value)


OWN = {"time": ("s", TIME), "input_angle": ("rad", INPUT), "output_angle": ("rad", OUTPUT), "torque": ("N*m", TORQUE)}


def write_parquet(path):
    fields = [pa.field(n, pa.float64(), metadata={"unit": u}) for n, (u, _) in OWN.items()]
    parquet.write_table(pa.table([v for _, v in OWN.values()], pa.schema(fields)), path, row_group_size=700)


def test_parquet(tmp_path):
    write_parquet(tmp_path / "a.parquet")
    same(RecordingStream(tmp_path / "a.parquet").read())
    (tmp_path / "b.parquet").write_bytes((tmp_path / "a.parquet").read_bytes()[:-100])
    with pytest.raises(edge.InputError, match=r"b\.parquet: this is not a .parquet file, or it is truncated"):
        RecordingStream(tmp_path / "b.parquet").read()


def write_mf4(path, torque_step=1):
    asammdf = pytest.importorskip("asammdf")
    with asammdf.MDF(version="4.10") as mdf:
        angles = [asammdf.Signal(OWN[n][1], TIME, unit="rad", name=n) for n in ("input_angle", "output_angle")]
        mdf.append(angles)
        part = slice(None, None, torque_step)
        mdf.append([asammdf.Signal(TORQUE[part], TIME[part], unit="Nm", name="torque")])
        mdf.save(path)


@pytest.mark.parametrize("torque_step", [1, 7])
def test_mdf4(tmp_path, torque_step):
    """Two groups, the torque's at a rate of its own: it is interpolated, and nothing beyond its end is made up."""
    write_mf4(tmp_path / "a.mf4", torque_step)
    found = RecordingStream(tmp_path / "a.mf4").read()
    kept = (SAMPLES - 1) // torque_step * torque_step + 1
    assert found.time.size == kept
    assert found.input_angle == pytest.approx(INPUT[:kept])
    assert found.torque == pytest.approx(TORQUE[:kept], abs=1e-4)
    assert bool(found.notes) == (kept < SAMPLES)


def write_tdms(path, waveform):
    nptdms = pytest.importorskip("nptdms")
    step = {"wf_increment": 1e-3, "wf_start_offset": 0.0} if waveform else {}
    names = [n for n in OWN if not (waveform and n == "time")]
    with nptdms.TdmsWriter(str(path)) as writer:
        for begin in range(0, SAMPLES, 900):
            writer.write_segment(
                [
                    nptdms.ChannelObject("run", n, OWN[n][1][begin : begin + 900], {"unit_string": OWN[n][0], **step})
                    for n in names
                ]
            )


@pytest.mark.parametrize("waveform", [False, True])
def test_tdms(tmp_path, waveform):
    write_tdms(tmp_path / "a.tdms", waveform)
    same(RecordingStream(tmp_path / "a.tdms").read())


DBC = """VERSION ""
BU_: bench
BO_ 291 Angles: 8 bench
 SG_ Motor : 0|32@1- (0.0001,0) [0|0] "rad" bench
 SG_ Abtrieb : 32|32@1- (0.000001,0) [0|0] "rad" bench
BO_ 292 Sensor: 4 bench
 SG_ Moment : 0|32@1- (0.001,0) [0|0] "Nm" bench
"""
CAN_MAP = """dbc = "bench.dbc"
[input_angle]
column = "Angles.Motor"
[output_angle]
column = "Angles.Abtrieb"
[torque]
column = "Sensor.Moment"
"""


def write_can(tmp_path, suffix):
    (tmp_path / "bench.dbc").write_text(DBC)
    database = cantools.database.load_string(DBC, "dbc")
    with can.Logger(tmp_path / f"a{suffix}") as log:
        for i in range(SAMPLES):
            at = 1000.0 + TIME[i]
            angles = database.encode_message("Angles", {"Motor": INPUT[i], "Abtrieb": OUTPUT[i]})
            log.on_message_received(can.Message(timestamp=at, arbitration_id=291, data=angles, is_extended_id=False))
            sensor = database.encode_message("Sensor", {"Moment": TORQUE[i]})
            log.on_message_received(can.Message(timestamp=at, arbitration_id=292, data=sensor, is_extended_id=False))
            if i % 500 == 0:
                other = can.Message(timestamp=at, arbitration_id=0x7FF, data=b"?", is_extended_id=False)
                log.on_message_received(other)
    return tmp_path / f"a{suffix}"


@pytest.mark.parametrize("suffix", [".blf", ".asc", ".trc"])
def test_can_logs(tmp_path, suffix):
    path = write_can(tmp_path, suffix)
    same(RecordingStream(path, mapping(tmp_path, CAN_MAP)).read(), angle=6e-5, torque=6e-4, time=2e-4)
    with pytest.raises(edge.InputError, match="needs the DBC"):
        open_bench_file(path)


CUTS = {
    "a.mf4": (lambda folder: write_mf4(folder / "a.mf4"), None),
    "a.tdms": (lambda folder: write_tdms(folder / "a.tdms", True), None),
    "a.blf": (lambda folder: write_can(folder, ".blf"), CAN_MAP),
    "a.asc": (lambda folder: write_can(folder, ".asc"), CAN_MAP),
    "a.trc": (lambda folder: write_can(folder, ".trc"), CAN_MAP),
}


@pytest.mark.parametrize("name", CUTS)
def test_cut_files_give_what_they_hold_or_one_sentence(tmp_path, name):
    """Cut anywhere: the reader returns a beginning of the motion, or one sentence with the file's name."""
    write, text = CUTS[name]
    write(tmp_path)
    whole = (tmp_path / name).read_bytes()
    mapped = None if text is None else mapping(tmp_path, text)
    longest, said = 0, []
    for share in (0.0, 0.001, 0.02, 0.3, 0.55, 0.8, 0.95, 0.999):
        cut = tmp_path / f"cut{share}{name[1:]}"
        cut.write_bytes(whole[: int(share * len(whole))])
        try:
            found = RecordingStream(cut, mapped).read()
        except edge.InputError as refused:
            said.append(str(refused))
            continue
        longest = max(longest, found.time.size)
        assert found.time.size <= SAMPLES
        assert found.input_angle - found.input_angle[0] == pytest.approx(INPUT[: found.time.size], abs=6e-5)
    assert all("cut" in one and "\n" not in one for one in said), said
    if name != "a.mf4":  # its index is at the end
        assert longest > 0.5 * SAMPLES


@settings(max_examples=60)
@given(data=st.binary(max_size=300), suffix=st.sampled_from([".csv", ".parquet", ".mf4", ".tdms", ".arrows"]))
def test_any_bytes_are_refused_with_one_sentence(tmp_path_factory, data, suffix):
    path = tmp_path_factory.mktemp("any") / f"a{suffix}"
    path.write_bytes(data)
    with pytest.raises(edge.InputError) as refused:
        RecordingStream(path).read()
    assert str(path) in str(refused.value)
    assert "\n" not in str(refused.value)


def test_the_last_line_of_a_cut_table_is_left_out(tmp_path):
    header = "time [s],input_angle [rad],output_angle [rad],torque [N*m]\n"
    lines = rows_of([TIME, INPUT, OUTPUT, TORQUE], ",", ".")
    (tmp_path / "a.csv").write_text(header + "\n".join(lines)[:-40])
    found = RecordingStream(tmp_path / "a.csv").read()
    assert found.time.size == SAMPLES - 1
    assert any("its last line is incomplete" in note for note in found.notes)


def test_a_missing_package_names_its_extra(tmp_path):
    (tmp_path / "a.tdms").write_bytes(b"x")
    hide = "import sys; sys.modules['nptdms'] = None; from fitting.readers.loggers import TdmsFile; "
    hide += "TdmsFile('a.tdms')"
    run = subprocess.run([sys.executable, "-c", hide], cwd=tmp_path, capture_output=True, text=True)
    assert "pip install 'cycloid-fmu[bench-files]'" in run.stderr


def write_table(path, time, input_angle, output_angle, torque=None, units=("s", "rad", "rad", "N*m")):
    torque = np.full(time.size, 50.0) if torque is None else torque
    header = ",".join(f"{n} [{u}]" for n, u in zip(OWN, units, strict=True))
    rows = rows_of([time, input_angle, output_angle, torque], ",", ".")
    path.write_text(header + "\n" + "\n".join(rows) + "\n")
    return path


def test_gaps_and_duplicates_are_marked_and_never_filled(tmp_path):
    kept = np.delete(np.arange(SAMPLES), np.r_[100:160, 2000:2100])
    kept = np.insert(kept, [500, 600], [kept[499], kept[300]])  # one twice, one from long before
    path = write_table(tmp_path / "a.csv", TIME[kept], INPUT[kept], OUTPUT[kept])
    found = RecordingStream(path).read()
    assert found.time.size == SAMPLES - 160
    assert found.time[found.status & GAP > 0] == pytest.approx([TIME[160], TIME[2100]])
    said = " ".join(found.notes)
    assert "2 gaps, the longest 0.101 s at 1.999 s" in said
    assert "2 samples share their time stamp with others (the clock's usual step is 0.001 s)" in said
    assert "1 samples older than a previous one" in said


def test_a_late_output_angle_is_found_by_changes_of_speed_and_a_delay_takes_it_away(tmp_path):
    time = np.arange(40000) / 4000.0
    lag = 1.3e-3

    def crank(t):
        return 60.0 * t + 15.0 * (1 - np.cos(2 * np.pi * t / 5.0))

    def output(t):
        return -crank(t) / 39 + 1e-4 * np.cos(crank(t))

    noise = np.random.default_rng(0).normal(0, 5e-6, time.size)
    path = write_table(tmp_path / "a.csv", time, crank(time), output(time - lag) + noise)
    found, uncertainty = lag_of(RecordingStream(path).read(), -39.0)
    assert abs(found - lag) < 1.5 * uncertainty < 0.05 * lag
    text = '[time]\ncolumn = "time"\n[input_angle]\ncolumn = "input_angle"\n[torque]\ncolumn = "torque"\n'
    mapped = mapping(tmp_path, text + '[output_angle]\ncolumn = "output_angle"\ndelay = "1.3 ms"\n')
    corrected = RecordingStream(path, mapped).read()
    assert corrected.output_angle == pytest.approx(output(corrected.time), abs=4e-5)
    found, uncertainty = lag_of(corrected, -39.0)
    assert abs(found) < 2 * uncertainty
    steady = write_table(tmp_path / "b.csv", time, 60.0 * time, -60.0 * time / 39 + noise)
    assert lag_of(RecordingStream(steady).read(), -39.0) is None


def test_a_drift_in_the_mapping_takes_two_clocks_apart_together(tmp_path):
    """Two groups of one MDF file, one with a clock 100 ppm fast: the TE drifts until the mapping states the clock."""
    asammdf = pytest.importorskip("asammdf")
    time = 5.0 + np.arange(20000) / 100.0
    crank = 60.0 * time
    with asammdf.MDF(version="4.10") as mdf:
        mdf.append([asammdf.Signal(crank, time, unit="rad", name="input_angle")])
        mdf.append([asammdf.Signal(np.full(time.size, 50.0), time, unit="Nm", name="torque")])
        late = time[0] + (time - time[0]) * (1 + 100e-6)
        mdf.append([asammdf.Signal(-crank / 39 + 1e-4 * np.cos(crank), late, unit="rad", name="output_angle")])
        mdf.save(tmp_path / "a.mf4")
    runs_away = fitting.curves(RecordingStream(tmp_path / "a.mf4").read(), -39.0)[0]
    (note,) = (n for n in runs_away.notes if "drifts by" in n)
    assert "clock ran +100 ppm fast" in note
    assert f"by {100e-6 * 2 * np.pi * 206264.8:.3g}″ per output turn" in note
    columns = "".join(f'[{n}]\ncolumn = "{n}"\n' for n in ("input_angle", "torque", "output_angle"))
    found = RecordingStream(tmp_path / "a.mf4", mapping(tmp_path, f"{columns}drift = 100e-6\n")).read()
    # The remainder is the error of interpolating a wave over steps of 0.6 rad.
    assert found.output_angle + found.input_angle / 39 == pytest.approx(1e-4 * np.cos(found.input_angle), abs=6e-6)
    assert not any("drifts by" in n for n in fitting.curves(found, -39.0)[0].notes)
    with pytest.raises(edge.InputError, match=r"\[output_angle\] drift = 0.5: it should be less than 0.01"):
        mapping(tmp_path, f"{columns}drift = 0.5\n")


@pytest.mark.parametrize("gap", [0.2, 0.8])
def test_a_rollover_within_a_gap_is_counted_by_the_output_angle(tmp_path, gap):
    """Both angles roll over at a turn; in the gap the crank turns several times unseen."""
    time = np.arange(8000) * 1e-3
    angle = time * 60.0
    missing = (time > 3.0) & (time < 3.0 + gap)
    error = 1e-4 * np.cos(angle)
    shown = (angle % (2 * np.pi))[~missing], ((-angle / 39 + error) % (2 * np.pi))[~missing]
    path = write_table(tmp_path / "a.csv", time[~missing], *shown)
    curve = fitting.curves(RecordingStream(path).read(), -39.0)[0]
    expected = 1e-4 * np.cos(curve.input_angle)
    offset = np.mean(curve.transmission_error - expected)
    assert curve.transmission_error - offset == pytest.approx(expected, abs=2e-6)
    assert any("crank turns were missed in 1 gaps" in note for note in curve.notes)


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        ((OUTPUT, INPUT), "input and output angle seem to be swapped"),
        ((INPUT, -OUTPUT), "the ratio's sign or one angle's direction is wrong"),
        ((INPUT, np.degrees(OUTPUT)), "the output angle seems to be in deg"),
        ((np.degrees(INPUT), OUTPUT), "the input angle seems to be in deg"),
        ((np.degrees(INPUT) % 360, OUTPUT), "its unit is deg, not rad"),
    ],
)
def test_what_is_wrong_with_the_angles_is_said(tmp_path, columns, said):
    with pytest.raises(edge.InputError, match=said):
        fitting.curves(RecordingStream(write_table(tmp_path / "a.csv", TIME, *columns)).read(), -39.0)[0]


@pytest.mark.slow(3)
def test_blocks_join_to_the_same_recording(tmp_path):
    """Longer than a piece: angles stay continuous over the seams, whichever of them rolls over."""
    n = 2 * PIECE + 12345
    time = np.arange(n) / 4000.0
    angle = time * 30.0
    table = pa.table(
        {
            "time [s]": time,
            "input_angle [rad]": angle % (2 * np.pi),
            "output_angle [rad]": -angle / 39,
            "torque [N*m]": np.ones(n),
        }
    )
    parquet.write_table(table, tmp_path / "a.parquet")
    blocks = list(RecordingStream(tmp_path / "a.parquet").blocks())
    assert len(blocks) == 3
    assert np.concatenate([b.input_angle for b in blocks]) == pytest.approx(angle, abs=1e-9)


@pytest.mark.parametrize("name", ["a.csv", "a.parquet", "a.mf4", "a.tdms", "a.blf"])
def test_what_inspect_proposes_reads_the_file(tmp_path, name):
    """Strange names and orders: the proposal finds the roles by unit, name and travel, and is a mapping that works."""
    dbc = None
    if name == "a.csv":
        write_strange_table(tmp_path / name)
    elif name == "a.parquet":
        write_parquet(tmp_path / name)
    elif name == "a.mf4":
        write_mf4(tmp_path / name)
    elif name == "a.tdms":
        write_tdms(tmp_path / name, True)
    else:
        write_can(tmp_path, ".blf")
        dbc = tmp_path / "bench.dbc"
    inspect(tmp_path / name, dbc).write(tmp_path / "map.toml")
    found = RecordingStream(tmp_path / name, read_mapping(tmp_path / "map.toml")).read()
    assert found.input_angle - found.input_angle[0] == pytest.approx(INPUT, abs=1e-3)
    assert found.torque == pytest.approx(TORQUE, abs=1e-3)


class Named(BenchFile):
    def pieces(self, names):
        yield from ()


@given(st.lists(st.text(st.characters(exclude_categories=["Cs"]), min_size=1), min_size=2, max_size=2, unique=True))
def test_a_proposed_mapping_names_whatever_columns_there_are(names):
    looks = [
        FirstSamples(RawChannel(name, "deg"), TIME, size * INPUT) for name, size in zip(names, (1.0, 0.1), strict=True)
    ]
    assume(not any(map(is_commanded, looks)))
    file = Named("a.csv", tuple(one.channel for one in looks), timed=True)
    mapping = tomllib.loads(Inspection(file, tuple(looks), roles_of(file, looks)).text)
    assert {mapping["input_angle"]["column"], mapping["output_angle"]["column"]} == set(names)


def write_strange_table(path):
    header = "Zeit [s];Drehmoment Motor [Nm];Drehmoment [Nm];Winkel 1 [°];Winkel 2 [°]\n"
    rows = rows_of([TIME, 0.01 * TORQUE, TORQUE, np.degrees(OUTPUT), np.degrees(INPUT)], ";", ",")
    path.write_text(header + "\n".join(rows) + "\n", encoding="utf-8")


def test_inspect_from_the_command_line(command, tmp_path):
    write_strange_table(tmp_path / "a.csv")
    run = command("cycloid-fit", "inspect", "a.csv", "-o", "map.toml", "--plot", "channels.png")
    assert run.returncode == 0, run.stderr
    assert "Winkel 2" in run.stdout
    assert read_mapping(tmp_path / "map.toml").input_angle.column == "Winkel 2"
    assert read_mapping(tmp_path / "map.toml").input_torque.column == "Drehmoment Motor"
    assert (tmp_path / "channels.png").stat().st_size > 10000
    (tmp_path / "cut.mf4").write_bytes(b"MDF     4.10    " + bytes(100))
    run = command("cycloid-fit", "inspect", "cut.mf4")
    assert run.returncode == 2
    assert "Traceback" not in run.stderr
    assert len(run.stderr.splitlines()) == 1


def test_another_package_adds_a_format_by_its_ending(tmp_path, monkeypatch):
    own = metadata.EntryPoint("rig", "fitting.readers.tables:CsvFile", formats.GROUP)
    known = metadata.EntryPoints([own])
    monkeypatch.setattr(formats.metadata, "entry_points", lambda **wanted: known.select(**wanted))
    write_strange_table(tmp_path / "a.rig")
    assert "Winkel 1" in {c.name for c in open_bench_file(tmp_path / "a.rig").channels}
    (tmp_path / "a.rug").write_bytes(b"")
    with pytest.raises(edge.InputError, match=r"must be one of \.arrows, .*\.rig, .*\.tdms"):
        open_bench_file(tmp_path / "a.rug")


def test_a_recording_left_in_the_middle_leaves_no_thread_behind(tmp_path):
    columns = {"time [s]": TIME, "input_angle [rad]": INPUT, "output_angle [rad]": OUTPUT, "torque [N*m]": TORQUE}
    long = {name: np.tile(values, 2 * PIECE // SAMPLES + 1) for name, values in columns.items()}
    long["time [s]"] = np.arange(long["time [s]"].size) * 1e-3
    parquet.write_table(pa.table(long), tmp_path / "long.parquet")
    stream = RecordingStream(tmp_path / "long.parquet")
    before = set(threading.enumerate())
    blocks = stream.blocks()
    assert next(blocks).time[0] == 0.0
    assert len(stream.checksum) == 64  # its thread has ended
    blocks.close()
    assert set(threading.enumerate()) <= before
