"""Limits of files from others: each row of the table in SECURITY.md is tried here, with real files."""

import contextlib
import gzip
import json
import os
import pickle
import re
import signal
import socket
import stat
import subprocess
import sys
import time
import zipfile
from base64 import b64encode
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pytest
from common import PAIR, study_size
from hypothesis import example, given, settings
from hypothesis import strategies as st
from pyarrow import parquet

import drivers
from cycloid_fmu import edge
from cycloid_fmu.draw.figure import new_figure
from cycloid_fmu.edge.commands import print_table
from cycloid_fmu.fmu.run import described, read_motion, units_of
from cycloid_fmu.geometry.pair import parse_pair, read_pair
from cycloid_fmu.studies.checkpoint import Checkpoint
from drivers.can.bus import open_bus
from drivers.encoder import EncoderSetupError
from drivers.lines import BusConfig, PortConfig
from drivers.recorder.bench import read_bench
from drivers.recorder.sequence import read_sequence
from drivers.recording_format import Channel, Header, RecordingWriter
from drivers.recording_format.repair import repair
from drivers.serial.port import PortHub
from fitting.estimation.result import FORMAT as RESULT
from fitting.estimation.result import read_lmfit_parameters
from fitting.readers.formats import open_bench_file
from fitting.readers.formulas import Formula
from fitting.readers.inspection import inspect
from fitting.readers.loggers import MdfFile
from fitting.readers.mapping import read_mapping
from fitting.readers.recording import RecordingStream
from fitting.reports.page import html_page
from fitting.reports.panels import Panel, Trace

posix = pytest.mark.skipif(os.name == "nt", reason="needs pipes and terminals")
TABLE = "time [s],input_angle [rad],output_angle [rad],torque [N*m]\n0,0,0,5\n1,39,-1,5\n"
TRIED = {}
KILLS = study_size("CYCLOID_KILLS", 10, 300)


def tries(row):
    """Note that a test tries a row of the table."""

    def noted(function):
        TRIED.setdefault(row, []).append(function.__name__)
        return function

    return noted


def test_each_row_is_tried():
    text = (Path(__file__).parent.parent / "SECURITY.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([^|]+) \|", text, re.MULTILINE)[1:]
    assert set(rows) == set(TRIED)


class Touch:
    """An object that makes a file where it is unpickled."""

    def __init__(self, path):
        self.path = path

    def __reduce__(self):
        return Path.touch, (self.path,)


FMU = "FMU"

# --- quantities ---------------------------------------------------------------------------------------------------

UNITS = "Quantities and units, in any file"
HOSTILE = [
    "m**9**9**9",
    "9**9**9**9*deg",
    "m*10**10**8",
    "mm**9**9**9",
    "(((m**9)**9)**9)**9",
    "m" * 10**5,
    "(" * 10**5,
    "m*" * 10**5,
    "1e999999999*m",
    "__import__('os').system('true')",
    "m²³",
    "m**-9**9",
]


@tries(UNITS)
@pytest.mark.parametrize("unit", HOSTILE, ids=range(len(HOSTILE)))
def test_a_unit_that_computes_is_refused_at_once(unit, tmp_path):
    edge.units()
    begun = time.perf_counter()
    with pytest.raises(ValueError, match="is not a known unit"):
        edge.unit_scale(unit, "m")
    with pytest.raises(ValueError, match="is not a known unit"):
        edge.parse_quantity(f"64 {unit}", "m")
    with pytest.raises(edge.InputError, match=r"pin_radius = "):
        parse_pair(PAIR.replace("3 mm", f"3 {unit}"), "pair.toml")
    (tmp_path / "a.csv").write_text(
        f"time [s],input_angle [{unit}],output_angle [rad],torque [N*m]\n0,0,0,0\n1,1,1,1\n"
    )
    with pytest.raises(edge.InputError):
        RecordingStream(tmp_path / "a.csv").read()
    assert time.perf_counter() - begun < 5.0


@tries(UNITS)
@settings(max_examples=150)
@given(
    st.text(st.sampled_from("mkNsradegPμ°²⁻0123456789.*/^() ·e-+%"), max_size=80) | st.text(max_size=80),
    st.sampled_from(["m", "rad", "N*m", "K", "1/Pa"]),
)
@example("1e999999999", "m")
@example("9" * 4400, "m")
def test_any_text_is_a_quantity_or_gets_its_sentence_at_once(text, si):
    edge.units()
    begun = time.perf_counter()
    for asked in (text, f"1 {text}", f"{text} mm"):
        try:
            assert np.isfinite(edge.parse_quantity(asked, si))
        except ValueError as problem:
            said = str(problem)
            assert "\n" not in said
            assert len(said) < 300
    assert time.perf_counter() - begun < 5.0


@pytest.mark.parametrize(
    ("text", "base", "scale"),
    [
        ("kN*m/mrad", "N*m/rad", 1e6),
        ("kg·m²", "kg*m^2", 1.0),
        ("1/(MPa*s)", "1/(Pa*s)", 1e-6),
        ("mm s⁻²", "m/s^2", 1e-3),
        ("Nm/deg", "N*m/rad", 180 / np.pi),
        ("(km/h)^2", "m^2/s^2", (1 / 3.6) ** 2),
        ("rpm/min", "rad/s^2", np.pi / 1800),
    ],
)
def test_units_are_multiplied_divided_and_raised(text, base, scale):
    assert edge.unit_scale(text, base) == pytest.approx(scale, rel=1e-12)


# --- TOML ---------------------------------------------------------------------------------------------------------

TOML = "Pair, reducer, tolerance, mapping, faults and other TOML"


@posix
@tries(TOML)
def test_what_a_file_names_is_not_opened_where_it_is_no_file(tmp_path, command):
    os.mkfifo(tmp_path / "pipe.toml")
    with socket.socket(socket.AF_UNIX) as bound:
        bound.bind(str(tmp_path / "socket.dbc"))
        (tmp_path / "zero.dbc").symlink_to("/dev/zero")
        for name, kind in (("pipe.toml", "a pipe"), ("socket.dbc", "a socket"), ("zero.dbc", "a device")):
            with pytest.raises(edge.InputError, match=f"{name}: this is {kind}; only regular files are read"):
                edge.read_text(tmp_path / name)
    with pytest.raises(edge.InputError, match="only regular files are read"):
        edge.existing("/proc/self/status")
    with pytest.raises(edge.InputError, match="a pipe"):
        read_pair(tmp_path / "pipe.toml")
    (tmp_path / "map.toml").write_text(
        'format = "cycloid-mapping/1"\ndbc = "zero.dbc"\n[output_angle]\ncolumn = "a"\n[torque]\ncolumn = "b"\n'
    )
    (tmp_path / "log.asc").write_text("")
    with pytest.raises(edge.InputError, match=r"zero.dbc: this is a device"):
        RecordingStream(tmp_path / "log.asc", read_mapping(tmp_path / "map.toml"))


@tries(TOML)
@pytest.mark.parametrize("value", ["[" * 10**5, "9" * 10**4, "{a=" * 10**4])
def test_toml_that_nests_without_end_is_refused(value):
    with pytest.raises(edge.InputError, match=r"^pair.toml: "):
        parse_pair(f"{PAIR}\na = {value}", "pair.toml")


@tries(TOML)
def test_toml_keys_of_many_parts_are_refused():
    """Its parser keeps every beginning of a key: 20,000 parts in 40 kB took 1.7 GB."""
    for part in ("a", '"a"', "'b c'", "a-1"):
        for line in (".".join([part] * 20_000) + " = 1", f"[{' . '.join([part] * 20_000)}]"):
            with pytest.raises(edge.InputError, match=r"^pair.toml: .*a key of more than 50 parts"):
                parse_pair(f"{PAIR}\n{line}", "pair.toml")
    begun = time.process_time()
    for text in ("a" * 10**6, "a " * 10**6, "'" * 10**6, "\"'" * 10**6, ".".join(["a"] * 40) + "\n", "'a" * 10**6):
        with pytest.raises(edge.InputError, match=r"^pair.toml: "):
            parse_pair(f"{PAIR}\n{text}", "pair.toml")
    assert time.process_time() - begun < 5.0


# --- bench and sequence -------------------------------------------------------------------------------------------

BENCH = "Bench (`BENCH.toml`)"
ASCII = '[channel.torque]\nprotocol = "ascii"\nport = "p"\nline = "{value}"\nrequest = "#!/bin/sh\\n"\n'
NODE = '[channel.input_angle]\nprotocol = "canopen"\nbus = "b"\nnode = 1\n'


def bench_with(folder, table, channel):
    path = folder / "BENCH.toml"
    path.write_text(f'format = "cycloid-bench/1"\n{table}\n{channel}')
    return path


@tries(BENCH)
@pytest.mark.parametrize(
    "url",
    [
        "spy:///dev/ptmx?file=VICTIM",
        "SPY:///dev/ptmx?file=VICTIM&raw",
        "alt:///dev/ttyS0?class=VTIMESerial",
        "hwgrep://.*",
        "loop://",
        "rfc2217://localhost:4000",
        "socket://localhost:4000?logging=debug",
        "socket://",
        "cp2110://a",
        "VICTIM",
        "../VICTIM",
        "file:///etc/passwd",
        "/dev/tty\x1b[2J",
    ],
)
def test_a_bench_file_opens_no_url_by_itself_and_writes_no_file(tmp_path, url, monkeypatch):
    monkeypatch.chdir(tmp_path)
    victim = tmp_path / "VICTIM"
    victim.write_text("kept")
    wiring = bench_with(tmp_path, f"[port.p]\nurl = {edge.json_text(url)}", ASCII)
    with pytest.raises(edge.InputError, match=r"\[port.p\] url = .*: a bench file may name a serial device") as problem:
        drivers.record(wiring, "run.arrows", duration=0.1)
    assert "\n" not in str(problem.value)
    assert victim.read_text() == "kept"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["BENCH.toml", "VICTIM"]


@tries(BENCH)
@pytest.mark.parametrize(
    ("interface", "channel"),
    [
        ("slcan", "spy:///dev/ptmx?file=VICTIM"),
        ("slcan", "loop://"),
        ("serial", "hwgrep://."),
        ("robotell", "VICTIM"),
        ("seeedstudio", "socket://localhost:1"),
        ("socketcand", "can0"),
        ("carrier-pigeon", "x"),
        ("os.system", "x"),
    ],
)
def test_a_bench_file_opens_buses_alone(tmp_path, interface, channel):
    wiring = bench_with(tmp_path, f'[bus.b]\ninterface = "{interface}"\nchannel = "{channel}"', NODE)
    with pytest.raises(edge.InputError, match=r"\[bus.b\] (interface|channel) = "):
        drivers.record(wiring, tmp_path / "run.arrows", duration=0.1)
    assert list(tmp_path.iterdir()) == [wiring]


@tries(BENCH)
def test_what_real_benches_have_may_be_opened(tmp_path):
    for url in (
        "COM3",
        "\\\\.\\COM12",
        "/dev/ttyUSB0",
        "/dev/serial/by-id/usb-FTDI_x-if00-port0",
        "/dev/cu.usbserial-1",
        "socket://10.0.0.7:4001",
        "socket://[::1]:4001",
    ):
        read_bench(bench_with(tmp_path, f"[port.p]\nurl = {edge.json_text(url)}", ASCII))
    for interface, channel in (
        ("socketcan", "can0"),
        ("pcan", "PCAN_USBBUS1"),
        ("kvaser", "0"),
        ("vector", "0"),
        ("ixxat", "0"),
        ("virtual", "a"),
        ("udp_multicast", "239.0.0.1"),
        ("gs_usb", "0"),
        ("slcan", "/dev/ttyACM0"),
        ("slcan", "COM4@115200"),
    ):
        read_bench(bench_with(tmp_path, f'[bus.b]\ninterface = "{interface}"\nchannel = "{channel}"', NODE))
    more = bench_with(tmp_path, '[port.p]\nurl = "rfc2217://localhost:1"', ASCII)
    read_bench(more, allow=["rfc2217"])
    with pytest.raises(edge.InputError, match='trust the file, allow "rfc2217" when recording'):
        read_bench(more, allow=["spy"])
    read_bench(bench_with(tmp_path, '[bus.b]\ninterface = "socketcand"\nchannel = "a"', NODE), allow=["socketcand"])


@posix
@tries(BENCH)
def test_no_device_but_a_terminal_is_opened(tmp_path, command):
    (tmp_path / "file").write_text("kept")
    for name, target in (("port", "/dev/null"), ("other", tmp_path / "file")):
        (tmp_path / name).symlink_to(target)
        with pytest.raises(EncoderSetupError, match="is not a serial port"):
            PortHub(PortConfig(url=str(tmp_path / name)))
        with pytest.raises(EncoderSetupError, match="is not a serial port"):
            open_bus(BusConfig(interface="slcan", channel=f"{tmp_path / name}@115200"))
    wiring = bench_with(tmp_path, '[port.p]\nurl = "/dev/null"', ASCII)
    done = command("cycloid-bench", "record", wiring, "-o", "run.arrows")
    assert done.returncode == 2
    assert done.stderr == 'The serial port "/dev/null" does not open: /dev/null is not a serial port.\n'
    ours, theirs = os.openpty()
    (tmp_path / "tty").symlink_to(os.ttyname(theirs))
    PortHub(PortConfig(url=str(tmp_path / "tty"), baud_rate=9600)).close()
    os.close(ours)
    os.close(theirs)


@tries(BENCH)
def test_the_command_line_allows_what_its_user_names(tmp_path, command):
    wiring = bench_with(tmp_path, '[port.p]\nurl = "rfc2217://127.0.0.1:9"', ASCII)
    refused = command("cycloid-bench", "record", wiring, "-o", "run.arrows")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert 'allow "rfc2217"' in refused.stderr
    tried = command("cycloid-bench", "record", wiring, "-o", "run.arrows", "--allow", "rfc2217")
    assert 'The serial port "rfc2217://127.0.0.1:9" does not open' in tried.stderr


@tries("Test sequence (`SEQUENCE.toml`)")
def test_a_sequence_starts_no_program(tmp_path):
    bench_with(tmp_path, '[bus.b]\ninterface = "virtual"\nchannel = "a"', NODE)
    wiring = next(tmp_path.iterdir())
    text = f'format = "cycloid-sequence/1"\nbench = "{wiring.name}"\nloads = ["20 N*m"]\nspeeds = ["60 rpm"]\n'
    (tmp_path / "s.toml").write_text(f'{text}[drive]\nrun = "touch acted"\n')
    with pytest.raises(edge.InputError, match="drive is not a known key"):
        read_sequence(tmp_path / "s.toml")
    wiring.write_text(wiring.read_text() + '[actuator]\nprotocol = "subprocess:run"\n')
    (tmp_path / "s.toml").write_text(text)
    with pytest.raises(edge.InputError, match=r"\[actuator\] protocol = .*: no such protocol is installed"):
        read_sequence(tmp_path / "s.toml")
    source = "".join(p.read_text(encoding="utf-8") for p in Path(drivers.__file__).parent.rglob("*.py"))
    assert not re.search(r"subprocess|os\.(system|exec|spawn)|Popen|shlex", source)


# --- measurement files --------------------------------------------------------------------------------------------


@tries("CSV and text tables")
def test_a_table_s_names_reach_no_terminal_and_take_no_time(tmp_path, command):
    hostile = "\x1b]0;acted\x07", "=cmd|' /C calc'!A1", "a" + " " * 30000 + "b", "enc" * 10000, "$\\frac$"
    head, row = ",".join(["time [s]", *hostile]), ",".join("1" * (1 + len(hostile)))
    (tmp_path / "a.csv").write_text(f"{head}\n{row}\n{row.replace('1', '2')}\n")
    begun = time.process_time()
    done = command("cycloid-fit", "inspect", "a.csv", "--plot", "a.png")
    assert time.process_time() - begun < 10.0
    assert done.returncode == 0, done.stderr
    assert "\x1b" not in done.stdout + done.stderr
    missing = command("cycloid-fit", "curve", "\x1b]0;acted\x07.csv", "--ratio", "-39")
    assert missing.returncode == 2
    assert "\x1b" not in missing.stderr


@tries("Parquet and recordings (`.arrows`)")
def test_a_recording_s_names_are_printable(tmp_path):
    channel = Channel("\x1b[2J", "other", "ascii", "rad", None, 1, 0.0, "incremental", "", "host clock")
    with RecordingWriter(tmp_path / "a.arrows", Header((channel,), {}, None, "", "")):
        pass
    with pytest.raises(edge.InputError, match=r"a.arrows: .*a channel's name must be printable"):
        drivers.repair(tmp_path / "a.arrows")
    (tmp_path / "BENCH.toml").write_text('format = "cycloid-bench/1"\n[channel."\\u001b[2J"]\nprotocol = "ascii"\n')
    with pytest.raises(edge.InputError, match="a channel's name must be printable"):
        read_bench(tmp_path / "BENCH.toml")


@tries(FMU)
def test_the_units_of_an_fmu_are_read_by_the_same_grammar(tmp_path):
    variable = (
        '<ScalarVariable name="x" valueReference="0" causality="input"><Real unit="m**9**9**9"/></ScalarVariable>'
    )
    with zipfile.ZipFile(tmp_path / "a.fmu", "w") as archive:
        archive.writestr(
            "modelDescription.xml",
            '<fmiModelDescription fmiVersion="2.0" modelName="a" guid="a"><CoSimulation modelIdentifier="a"/>'
            f"<ModelVariables>{variable}</ModelVariables><ModelStructure/></fmiModelDescription>",
        )
    units = units_of(tmp_path / "a.fmu", "input")
    assert units == {"x": "m**9**9**9"}
    (tmp_path / "m.csv").write_text("time [s],x [m]\n0,0\n1,1\n")
    with pytest.raises(edge.InputError, match="is not a known unit"):
        read_motion(tmp_path / "m.csv", units)


def test_a_table_on_the_terminal_holds_no_controls(capsys):
    print_table("t", ["name"], [["a\x1b[2Jb\x9bc\u202ed"]])
    assert not set(capsys.readouterr().out) & set("\x1b\x9b\u202e")


@pytest.fixture
def asammdf():
    return pytest.importorskip("asammdf")


FORMULAS = {
    "linear": ("2 * X + 1", lambda x: 2 * x + 1),
    "curved": ("sqrt(abs(X)) / 2 - pow(X, 2)**0.5", lambda x: np.sqrt(x) / 2 - x),
    "code": ("__import__('os').system('touch acted')", None),
    "frames": ("X.__class__", None),
    "power": ("9**9**9**9*X", lambda x: np.where(x == 0, np.nan, np.inf)),
    "nested": ("-" * 200 + "X", None),
    "unknown": ("X ^ 2", None),
    "long": ("X" + "+X" * 200, None),
}
RAW = np.arange(300, dtype=np.int32)


@tries("ASAM MDF")
@pytest.mark.parametrize(("version", "ending"), [("4.10", "mf4"), ("3.30", "mdf")])
def test_no_formula_of_an_mdf_file_is_evaluated(tmp_path, asammdf, monkeypatch, version, ending):
    """With sympy and numexpr, which asammdf hands formulas to, and whatever they may be."""
    from asammdf.blocks import v2_v3_blocks, v4_blocks

    monkeypatch.chdir(tmp_path)
    signals = [
        asammdf.Signal(RAW, RAW * 1e-3, unit="deg", name=name, conversion={"formula": text})
        for name, (text, _) in FORMULAS.items()
    ]
    with asammdf.MDF(version=version) as made:
        made.append(signals)
        made.save(f"a.{ending}", overwrite=True)

    def evaluated(*_, **__):
        raise AssertionError("a formula was evaluated")

    for module in (v4_blocks, v2_v3_blocks):
        monkeypatch.setattr(module, "evaluate", evaluated)
        monkeypatch.setattr(module, "lambdify", evaluated)
        monkeypatch.setattr(module, "symbols", evaluated)
    file = MdfFile(f"a.{ending}")  # in this process, whose asammdf is patched
    found = {
        name: np.concatenate([p.values[name] for p in file.pieces([name])]) for name in [c.name for c in file.channels]
    }
    assert set(found) == {name for name, (_, expected) in FORMULAS.items() if expected is not None}
    for name, values in found.items():
        np.testing.assert_allclose(values, FORMULAS[name][1](RAW.astype(float)))
    left_out = [name for name, (_, expected) in FORMULAS.items() if expected is None]
    assert [re.search('"(.*?)" is left out: its conversion, the formula', p)[1] for p in file.problems] == left_out
    assert not Path("acted").exists()


@tries("ASAM MDF")
@settings(max_examples=150)
@given(st.text(st.sampled_from("X1 +-*/()^,.eE9sincoqrtpow_'[]"), max_size=60) | st.text(max_size=400))
@example("X" + "**9" * 99)
@example("(" * 300)
@example("abs(" * 70)
def test_any_text_is_a_formula_or_is_refused_at_once(text):
    begun = time.perf_counter()
    with contextlib.suppress(ValueError):
        assert Formula(text)(np.linspace(-1.0, 1.0, 1000)).shape == (1000,)
    assert time.perf_counter() - begun < 5.0


@tries("ASAM MDF")
def test_raw_numbers_never_stand_under_a_unit(tmp_path, asammdf):
    """Texts in place of numbers are no numbers; a formula in a table leaves the channel out."""
    ranges = {
        "lower_0": 0,
        "upper_0": 99,
        "text_0": {"a": 0.5, "b": 0.0},
        "lower_1": 100,
        "upper_1": 999,
        "text_1": b"sensor fault",
        "default": b"?",
    }
    signals = [
        asammdf.Signal(RAW, RAW * 1e-3, unit="deg", name="angle", conversion=ranges),
        asammdf.Signal(
            RAW, RAW * 1e-3, unit="deg", name="formula", conversion={**ranges, "text_0": {"formula": "1/0"}}
        ),
    ]
    with asammdf.MDF(version="4.10") as made:
        made.append(signals)
        made.save(tmp_path / "a.mf4", overwrite=True)
    file = open_bench_file(tmp_path / "a.mf4")
    (piece,) = file.pieces(["angle"])
    np.testing.assert_array_equal(piece.values["angle"], np.where(RAW < 100, RAW / 2, np.nan))
    assert [c.name for c in file.channels] == ["angle"]
    (tmp_path / "map.toml").write_text(
        'format = "cycloid-mapping/1"\n[output_angle]\ncolumn = "formula"\n[torque]\ncolumn = "angle"\nunit = "N*m"\n'
    )
    with pytest.raises(edge.InputError, match='the channel "formula" is left out: its conversion has a formula'):
        RecordingStream(tmp_path / "a.mf4", read_mapping(tmp_path / "map.toml"))


@tries("LabVIEW TDMS")
def test_a_scale_that_nobody_knows_leaves_its_channel_out(tmp_path):
    nptdms = pytest.importorskip("nptdms")
    scale = {
        "NI_Number_Of_Scales": 1,
        "NI_Scale[0]_Linear_Slope": 2.0,
        "NI_Scale[0]_Linear_Y_Intercept": 1.0,
        "NI_Scale[0]_Linear_Input_Source": 0xFFFFFFFF,
        "NI_Scaling_Status": "unscaled",
    }
    channels = [
        nptdms.ChannelObject("g", name, np.arange(5.0), {**scale, **more})
        for name, more in (
            ("known", {"NI_Scale[0]_Scale_Type": "Linear"}),
            ("unknown", {"NI_Scale[0]_Scale_Type": "Formula"}),
            ("many", {"NI_Number_Of_Scales": 2**31 - 1}),
        )
    ]
    with nptdms.TdmsWriter(tmp_path / "a.tdms") as writer:
        writer.write_segment(channels)
    file = open_bench_file(tmp_path / "a.tdms")
    assert [c.name for c in file.channels] == ["known"]
    (piece,) = file.pieces(["known"])
    assert piece.values["known"].tolist() == [1.0, 3.0, 5.0, 7.0, 9.0]
    assert [re.search('the channel "(.*?)" is left out', p)[1] for p in file.problems] == ["unknown", "many"]


@tries("Parquet and recordings (`.arrows`)")
def test_nothing_is_unpickled(tmp_path):
    acted = tmp_path / "acted"
    payload = pickle.dumps(Touch(acted))
    extension = {"ARROW:extension:name": "arrow.py_extension_type", "ARROW:extension:metadata": payload}
    schema = pa.schema(
        [
            pa.field("time [s]", pa.float64()),
            pa.field("payload [rad]", pa.binary()),
            pa.field("angle [rad]", pa.float64(), metadata=extension),
        ],
    )
    table = pa.table([[0.0, 1.0], [payload, payload], [0.0, 1.0]], schema=schema)
    parquet.write_table(table, tmp_path / "a.parquet")
    file = open_bench_file(tmp_path / "a.parquet")
    assert [c.name for c in file.channels] == ["time", "angle"]
    assert [p.values["angle"].tolist() for p in file.pieces(["angle"])] == [[0.0, 1.0]]
    with pa.ipc.new_stream(tmp_path / "a.arrows", schema) as writer:
        writer.write_table(table)
    with pytest.raises(edge.InputError):
        open_bench_file(tmp_path / "a.arrows")
    assert not acted.exists()


DBC = 'VERSION ""\nBU_: A\nBO_ 257 torque: 4 A\n SG_ Md : 0|32@1- (0.001,0) [0|0] "N*m**9**9**9" A\n'


@tries("CAN logs, DBC and EDS")
def test_what_describes_frames_only_describes_them(tmp_path):
    (tmp_path / "a.dbc").write_text(DBC)
    (tmp_path / "a.asc").write_text(
        "date Mon Jan 1 00:00:00.000 am 2024\nbase hex timestamps absolute\nno internal events logged\n"
        "0.1 1 101 Rx d 4 10 27 00 00\n0.2 1 101 Rx d 4 20 4E 00 00\n"
    )
    found = inspect(tmp_path / "a.asc", tmp_path / "a.dbc")
    assert [one.values.tolist() for one in found.looks] == [[10.0, 20.0]]
    channel = f'{NODE}eds = "node.epf"\n'
    (tmp_path / "node.epf").write_text('<!DOCTYPE a [<!ENTITY b SYSTEM "/etc/passwd">]><a>&b;</a>')
    wiring = bench_with(tmp_path, '[bus.b]\ninterface = "virtual"\nchannel = "security"', channel)
    with pytest.raises(edge.InputError, match=r"node.epf: the ending must be .eds or .dcf"):
        read_bench(wiring)


# --- netCDF, JSON, FMU --------------------------------------------------------------------------------------------

NETCDF = "netCDF: error surfaces, tolerance studies"


@tries(NETCDF)
def test_a_netcdf_file_holds_its_data_itself(tmp_path):
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["x"] = np.arange(10.0)
    (tmp_path / "raw.bin").write_bytes(np.arange(10.0).tobytes())
    layout = h5py.VirtualLayout((10,), "f8")
    layout[:] = h5py.VirtualSource(tmp_path / "other.h5", "x", shape=(10,))
    makers = {
        "link": lambda file: file.__setitem__("x", h5py.ExternalLink("other.h5", "/x")),
        "nested link": lambda file: file.create_group("g").__setitem__("x", h5py.ExternalLink("other.h5", "/x")),
        "raw": lambda file: file.create_dataset("x", (10,), "f8", external=[(str(tmp_path / "raw.bin"), 0, 80)]),
        "virtual": lambda file: file.create_virtual_dataset("x", layout),
        "large": lambda file: file.create_dataset("x", (1 << 40,), "f8", chunks=(1 << 16,)),
        "whole": lambda file: file.create_dataset("x", data=np.arange(10.0)),
    }
    for name, make in makers.items():
        with h5py.File(tmp_path / f"{name}.nc", "w") as file:
            file.attrs["format"] = "f"
            make(file)
            if "link" not in name:
                file["x"].make_scale("x")
        refused = contextlib.nullcontext() if name == "whole" else pytest.raises(edge.InputError, match=f"{name}.nc: ")
        with refused:
            assert edge.netcdf(tmp_path / f"{name}.nc", "f").variables["x"].values.tolist() == list(range(10))


JSON = "JSON: figures, results, checkpoints of studies"


@tries(JSON)
def test_a_result_brings_no_object_and_no_expression(tmp_path):
    acted = tmp_path / "acted"
    pickled = b64encode(pickle.dumps(Touch(acted))).decode()
    called = {"__class__": "Callable", "__name__": "f", "pyversion": "3.11", "value": pickled, "importer": "os"}
    plain = ["a", 1.0, True, None, -np.inf, np.inf, None, None, None, 1.0, None, None]
    expression = [*plain[:3], f"open('{acted}', 'w')", *plain[4:]]
    for symbols, states in (({"f": called}, [plain]), ({}, [expression]), ({}, [[called, *plain[1:]]])):
        parameters = {"unique_symbols": symbols, "params": states}
        (tmp_path / "r.json").write_text(json.dumps({"format": RESULT, "lmfit_parameters": parameters}))
        with contextlib.suppress(edge.InputError):
            read_lmfit_parameters(tmp_path / "r.json")
    assert not acted.exists()


@tries(JSON)
def test_json_that_nests_without_end_is_refused(tmp_path):
    (tmp_path / "a.json").write_text("[" * 10**5)
    with pytest.raises(edge.InputError, match=r"a.json: "):
        edge.json_table(tmp_path / "a.json", "f", "figures")


LAUGHS = (
    '<!DOCTYPE a [<!ENTITY b0 "ha">'
    + "".join(f'<!ENTITY b{i} "{f"&b{i - 1};" * 10}">' for i in range(1, 20))
    + "]><a>&b19;</a>"
)


@tries(FMU)
@pytest.mark.parametrize(
    "text", [LAUGHS, '<!DOCTYPE a [<!ENTITY b SYSTEM "/etc/passwd">]><fmiModelDescription fmiVersion="2.0">&b;</a>']
)
@pytest.mark.parametrize("encoding", ["utf-8", "utf-16", "utf-16-be", "utf-32", "utf-32-be", "cp037", "utf-7"])
def test_an_fmu_s_description_defines_nothing(tmp_path, text, encoding):
    with zipfile.ZipFile(tmp_path / "a.fmu", "w") as archive:
        declared = b'<?xml version="1.0" encoding="UTF-7"?>' if encoding == "utf-7" else b""
        archive.writestr("modelDescription.xml", declared + text.encode(encoding))
    said = r"modelDescription.xml(: this is not XML in UTF-8| has a document type)"
    with pytest.raises(edge.InputError, match=said):
        units_of(tmp_path / "a.fmu", "input")
    with pytest.raises(edge.InputError, match=said):
        drivers.simulate_bench(tmp_path / "a.fmu", torque=1.0, ratio=-39, turns=1)


def fmu_with(folder, variables, structure=""):
    text = (
        '<fmiModelDescription fmiVersion="2.0" modelName="a" guid="a" variableNamingConvention="structured">'
        '<CoSimulation modelIdentifier="a"/>'
        f"<ModelVariables>{variables}</ModelVariables><ModelStructure>{structure}</ModelStructure>"
        "</fmiModelDescription>"
    )
    with zipfile.ZipFile(folder / "a.fmu", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", text)
    return folder / "a.fmu"


@tries(FMU)
@pytest.mark.system
def test_a_description_of_too_many_variables_is_refused(tmp_path, monkeypatch):
    """Six hundred thousand took 38 s and 2 GB; validation takes the square of the number of outputs."""
    one = '<ScalarVariable name="v{0}" valueReference="{0}" causality="output"><Real/></ScalarVariable>'
    many = fmu_with(tmp_path, "".join(one.format(i) for i in range(200_000)))
    with pytest.raises(edge.InputError, match=r"a.fmu: its modelDescription.xml is longer than 16 MiB\."):
        described(many)
    unknown = "".join(f'<Unknown index="{i + 1}" dependencies="1"/>' for i in range(8000))
    square = f"<Outputs>{unknown}</Outputs><InitialUnknowns>{unknown}</InitialUnknowns>"
    monkeypatch.setattr("cycloid_fmu.edge.limited._SECONDS", 2.0)
    with pytest.raises(edge.InputError, match=r"a.fmu: this file is damaged or too complex"):
        described(fmu_with(tmp_path, "".join(one.format(i) for i in range(8000)), square))


@tries(FMU)
def test_an_fmu_that_unpacks_to_too_much_is_refused(tmp_path, monkeypatch):
    with zipfile.ZipFile(tmp_path / "a.fmu", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", "<a/>")
        archive.writestr("resources/zeros", bytes(1 << 20))
    monkeypatch.setattr("cycloid_fmu.edge.files._MOST_BYTES", 1 << 19)
    with pytest.raises(edge.InputError, match="it unpacks to more than"):
        edge.zip_archive(tmp_path / "a.fmu", "FMU")


@tries("Compressed files (`.gz`)")
def test_a_compressed_file_that_unpacks_to_too_much_is_refused(tmp_path, monkeypatch, command):
    """The bound of every unpacked file; nothing stays in the temporary folder."""
    (tmp_path / "a.csv.gz").write_bytes(gzip.compress(TABLE.encode() + b"0,0,0,5\n" * 200_000))
    (tmp_path / "t").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "t"))
    monkeypatch.setattr("cycloid_fmu.edge.files._MOST_BYTES", 1 << 19)
    done = command("cycloid-fit", "inspect", "a.csv.gz")
    assert done.returncode == edge.BAD_INPUT
    assert "a.csv.gz: it unpacks to more than" in done.stderr
    assert not list((tmp_path / "t").iterdir())


@tries("Compressed files (`.gz`)")
@tries(FMU)
@pytest.mark.parametrize("name", ["a.csv.gz", "a.fmu"])
@pytest.mark.slow(1)
def test_what_unpacks_to_a_hundred_times_its_size_fills_no_disk(tmp_path, monkeypatch, name):
    """Zeros, which are packed to a thousandth: refused at 64 MiB and a hundred times the file, not at 4 GiB."""
    rows = TABLE.encode() + b"0,0,0,5\n" * (9 << 20)
    if name.endswith(".fmu"):
        with zipfile.ZipFile(tmp_path / name, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("modelDescription.xml", "<a/>")
            archive.writestr("resources/zeros", rows * 2)
        with pytest.raises(edge.InputError, match="it unpacks to more than"):
            edge.zip_archive(tmp_path / name, "FMU")
        return
    (tmp_path / name).write_bytes(gzip.compress(rows * 2))
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(edge.InputError, match=f"{name}: it unpacks to more than"):
        open_bench_file(tmp_path / name)
    assert [file.name for file in tmp_path.iterdir()] == [name]


@tries("Parquet and recordings (`.arrows`)")
@pytest.mark.slow(2)
def test_a_parquet_file_of_nothing_but_zeros_is_refused_and_a_long_run_is_not(tmp_path):
    """40 million zeros in four columns are packed to a thousandth; a noisy angle takes most of its bytes."""
    names, noise = ("time [s]", "input_angle [rad]", "output_angle [rad]"), np.random.default_rng(1)
    zeros = pa.table({name: np.zeros(4_000_000) for name in names})
    with parquet.ParquetWriter(tmp_path / "zeros.parquet", zeros.schema, compression="zstd") as writer:
        for _ in range(10):
            writer.write_table(zeros)
    with pytest.raises(edge.InputError, match=r"zeros\.parquet: it unpacks to 960 MB; at most are read"):
        open_bench_file(tmp_path / "zeros.parquet")
    angle = noise.normal(np.arange(4_000_000) * 1e-3, 1e-6)
    run = pa.table({name: angle for name in names[1:]} | {names[0]: np.arange(4_000_000) * 1e-4})
    parquet.write_table(run, tmp_path / "run.parquet", compression="zstd")
    assert [c.name for c in open_bench_file(tmp_path / "run.parquet").channels] == [
        "input_angle",
        "output_angle",
        "time",
    ]


def test_a_report_shows_names_as_names():
    hostile = "</script><script>alert(1)</script><!--<script>"
    trace = Trace(hostile, np.zeros(2), np.zeros(2))
    page = html_page(hostile, hostile, [Panel(hostile, "x", "y", (trace,), caption=hostile)])
    plotly = page.index("const panels")
    assert hostile not in page
    assert "<script" not in page[plotly : page.index("</script>", plotly)]


@posix
@pytest.mark.slow(3)
def test_names_are_no_formulas_in_pictures(tmp_path, command):
    """A file's name and a channel's, in every picture of a recording."""
    time, name = np.arange(4000) / 200.0, r"a$\frac{$"
    rows = np.column_stack([time, 40.0 * time, -40.0 / 39.0 * time + 1e-5 * np.sin(40.0 * time), 20.0 + 0.0 * time])
    header = "time [s],input_angle [rad],output_angle [rad],torque [N*m]"
    np.savetxt(tmp_path / f"{name}.csv", rows, "%.12g", ",", header=header, comments="")
    np.savetxt(tmp_path / "other.csv", rows, "%.12g", ",", header=header.replace("torque", name), comments="")
    for words in (
        ("report", f"{name}.csv", "--ratio", "-39", "-o", "y.pdf"),
        ("metrics", f"{name}.csv", "--ratio", "-39", "--plot", "y.png"),
        ("inspect", "other.csv", "--plot", "z.png"),
    ):
        done = command("cycloid-fit", *words)
        assert (done.returncode, done.stderr) == (0, ""), words
    figure, (axis,) = new_figure()
    axis.loglog([1e-3, 1.0], [1e-3, 1.0], label=name)
    axis.set_title(name)
    axis.legend(title=name)
    axis.set_xticks([1e-3, 1.0], [name, "b"])
    figure.savefig(tmp_path / "d.png")
    assert axis.get_yticklabels()[0].get_parse_math(), "powers of ten stay powers"
    assert not axis.get_xticklabels()[0].get_parse_math()


# --- written files ------------------------------------------------------------------------------------------------


@pytest.fixture
def occupied(tmp_path):
    """Names under which something else than a plain file is; what they are is checked afterwards."""
    (tmp_path / "kept").write_text("kept")
    found = {}

    def name(kind, ending):
        path = tmp_path / f"{kind}{ending}"
        {
            "pipe": lambda: os.mkfifo(path),
            "link": lambda: path.symlink_to(tmp_path / "kept"),
            "dangling": lambda: path.symlink_to(tmp_path / "nothing"),
            "device": lambda: path.symlink_to("/dev/null"),
            "folder": path.mkdir,
            "socket": lambda: sockets.enter_context(socket.socket(socket.AF_UNIX)).bind(str(path)),
        }[kind]()
        found[path] = path.lstat().st_mode, path.lstat().st_ino
        return path

    with contextlib.ExitStack() as sockets:
        yield name
        for path, before in found.items():
            assert (path.lstat().st_mode, path.lstat().st_ino) == before
        assert (tmp_path / "kept").read_text() == "kept"
        assert not (tmp_path / "nothing").exists()


@posix
@pytest.mark.parametrize("kind", ["pipe", "link", "dangling", "device", "folder", "socket"])
def test_nothing_is_written_over_or_through_what_is_no_file(tmp_path, occupied, kind):
    said = "only regular files are written"
    recording = tmp_path / "run.arrows"
    with drivers.simulate_bench(
        ratio=-39, torque=20.0, turns=1, motion=drivers.SimulatedMotion(8), bus="virtual"
    ) as bench:
        bench.record(recording)
        with pytest.raises(edge.InputError, match=f"^path = .*{said}"):
            bench.write_wiring(occupied(kind, ".toml"))
        with pytest.raises(edge.InputError, match=said):
            bench.record(occupied(kind, ".arrows"))
    for ending in (".csv", ".nc", ".parquet", ".mf4"):
        with pytest.raises(edge.InputError, match=f"^output = .*{said}"):
            drivers.export(recording, occupied(kind, ending))
    with pytest.raises(edge.InputError, match=said):
        repair(recording, tmp_path / f"{kind}.arrows")
    with pytest.raises(edge.InputError, match=said), edge.written_whole(occupied(kind, ".txt")):
        raise AssertionError
    with pytest.raises(edge.InputError, match=said):
        Checkpoint(occupied(kind, ".checkpoint"), type("Study", (), {"identity": dict})())
    assert not list(tmp_path.glob(".*"))


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="needs the right to make a device")
def test_a_device_is_not_replaced(tmp_path):
    with contextlib.suppress(PermissionError):
        os.mknod(tmp_path / "null.nc", stat.S_IFCHR | 0o600, os.makedev(1, 3))
        with pytest.raises(edge.InputError, match="a device has this name"), edge.written_whole(tmp_path / "null.nc"):
            raise AssertionError
        assert stat.S_ISCHR((tmp_path / "null.nc").lstat().st_mode)


def test_a_link_put_there_meanwhile_is_not_replaced(tmp_path):
    target = tmp_path / "a.txt"
    with pytest.raises(edge.InputError, match="a link has this name"), edge.written_whole(target) as temporary:  # noqa: PT012
        temporary.write_text("new")
        target.symlink_to("/dev/null")
    assert target.is_symlink()
    assert list(tmp_path.iterdir()) == [target]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["record", "BENCH.toml", "-o", ".profile"], "--output = .profile: the name must end in .arrows."),
        (["repair", "run.arrows", "-o", "run.sh"], "--output = run.sh: the name must end in .arrows."),
        (
            ["simulate", "--ratio", "-39", "--torque", "1 N*m", "--write-bench", "a.sh"],
            "--write-bench = a.sh: the name must end in .toml.",
        ),
    ],
)
def test_a_result_has_its_format_s_ending(command, tmp_path, words, said):
    done = command("cycloid-bench", *words)
    assert (done.returncode, done.stderr.strip()) == (2, said)
    assert not list(tmp_path.iterdir())


WRITER = """
import sys
from cycloid_fmu import edge
from cycloid_fmu.draw.figure import new_figure
with edge.written_whole(sys.argv[1]) as temporary:
    temporary.write_text("half")
    print(temporary, flush=True)
    sys.stdin.readline()
    temporary.write_text("whole")
"""


def writer(target):
    process = subprocess.Popen(
        [sys.executable, "-c", WRITER, str(target)], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    return process, Path(process.stdout.readline().strip())


def test_what_a_killed_command_left_is_removed_and_what_is_being_written_is_not(tmp_path):
    target = tmp_path / "a.txt"
    (killed, left), (alive, kept) = writer(target), writer(target)
    killed.kill()
    killed.communicate()
    assert left.exists()
    with edge.written_whole(tmp_path / "b.txt") as temporary:
        assert not left.parent.exists()
        assert kept.exists()
        temporary.write_text("b")
    alive.communicate("go on\n")
    assert alive.returncode == 0
    assert target.read_text() == "whole"
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.txt", "b.txt"]


@pytest.mark.slow(5)
def test_writers_beside_each_other_and_killed_at_random_leave_whole_files(tmp_path):
    """Four at a time write the same two files again and again until they are killed."""
    code = (
        "import sys\nfrom cycloid_fmu import edge\nfor i in range(10**6):\n"
        " with edge.written_whole(sys.argv[1 + i % 2]) as t:\n  t.write_text(f'{i}\\n' * 5000)\n"
    )
    targets = [tmp_path / "a.txt", tmp_path / "b.txt"]
    random = np.random.default_rng(1)
    for _ in range(max(1, KILLS // 4)):
        running = [
            subprocess.Popen([sys.executable, "-c", code, *map(str, targets)], stderr=subprocess.PIPE) for _ in range(4)
        ]
        while not all(t.exists() for t in targets):
            assert all(p.poll() is None for p in running)
        for process in running:
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(random.uniform(0.0, 0.3))
            assert process.poll() is None, process.communicate()[1].decode()
            process.send_signal(signal.SIGKILL)
            process.communicate()
        for target in targets:
            lines = target.read_text().split()
            assert len(lines) == 5000
            assert len(set(lines)) == 1
            target.unlink()
    with edge.written_whole(targets[0]) as temporary:
        temporary.write_text("")
    assert list(tmp_path.iterdir()) == [targets[0]]
