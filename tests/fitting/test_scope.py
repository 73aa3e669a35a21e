"""Text exports of TwinCAT Scope, in the forms that its exporter can write."""

import numpy as np
import pytest
from common import draws
from hypothesis import given, settings
from hypothesis import strategies as st

import fitting
from cycloid_fmu import edge
from fitting.readers.formats import open_bench_file
from fitting.readers.scope import ScopeFile

HEADER = (
    "SymbolComment",
    "Data-Type",
    "SampleTime[ms]",
    "VariableSize",
    "SymbolBased",
    "IndexGroup",
    "IndexOffset",
    "SymbolName",
    "NetID",
    "Port",
    "Offset",
    "ScaleFactor",
    "BitMask",
    "Unit",
    "Unit ScaleFactor",
    "Unit Offset",
)
PLAIN = {"Offset": "0", "ScaleFactor": "1", "Unit ScaleFactor": "1", "Unit Offset": "0", "Unit": "(None)"}


def export(groups, *, delimiter="\t", decimal=".", ends="\r\n", blank=True, eof=False, units=None, rows=HEADER, **said):
    """Write groups of (times in ms, {name: values}) as Scope does."""
    units = units or {}
    top = [
        delimiter.join(["Name", "run", ""] if delimiter != "\t" else ["Name", "run"]),
        delimiter.join(["File", "C:\\bench\\run.csv"]),
        delimiter.join(["Starttime of export", "132959733843760000", "Montag, 2. Mai 2022", "15:56:24.376"]),
        delimiter.join(["Endtime of export", "132959733853750000", "Montag, 2. Mai 2022", "15:56:25.375"]),
        "",
        "",
        delimiter.join(c for _, columns in groups for c in ("Name", *columns)),
    ]
    for row in rows:
        cells = []
        for times, columns in groups:
            cells.append(row)
            for name in columns:
                cell = PLAIN.get(row, "1")
                if row == "Unit" and name in units:
                    cell = units[name]
                if row == "SampleTime[ms]":  # in the machine's own language whatever the decimal mark
                    cell = f"{times[1] - times[0]:g}".replace(".", ",")
                cells.append(said.get(row.replace(" ", ""), cell))
        top.append(delimiter.join(cells))
    top.append("")
    longest = max(len(times) for times, _ in groups)
    body = []
    for i in range(longest):
        cells = []
        for times, columns in groups:
            inside = i < len(times)
            for column in (times, *columns.values()):
                cells.append(f"{column[i]!r}".replace(".", decimal) if inside else " ")
        while not blank and cells[-1] == " ":
            cells.pop()
        body.append(delimiter.join(cells))
    return ends.join([*top, *body, *(["EOF"] if eof else []), ""])


def read(path):
    opened = open_bench_file(path)
    assert isinstance(opened, ScopeFile)
    got = {c.name: ([], []) for c in opened.channels}
    for piece in opened.pieces(list(got)):
        for name, values in piece.values.items():
            got[name][0].append(piece.time)
            got[name][1].append(values)
    joined = {n: tuple(np.concatenate(part) if part else np.zeros(0) for part in parts) for n, parts in got.items()}
    return opened, joined


numbers = st.floats(-1e9, 1e9, allow_nan=False).map(float)


@draws(
    15,
    60,
    2,
    shapes=st.lists(st.tuples(st.integers(2, 40), st.integers(1, 3), st.integers(1, 20)), min_size=1, max_size=4),
    marks=st.sampled_from([("\t", "."), ("\t", ","), (";", ","), (";", "."), (":", "."), (",", ".")]),
    ends=st.sampled_from(["\n", "\r\n"]),
    encoding=st.sampled_from(["utf-8", "utf-8-sig", "cp1252", "utf-16"]),
    blank=st.booleans(),
    eof=st.booleans(),
    data=st.data(),
)
def test_what_scope_writes_is_read_back(tmp_path_factory, shapes, marks, ends, encoding, blank, eof, data):
    delimiter, decimal = marks
    groups = []
    for number, (rows, columns, step) in enumerate(shapes):
        times = [0.1 * step * i for i in range(rows)]
        values = {
            f"Kanal ü {number}.{k}": data.draw(st.lists(numbers, min_size=rows, max_size=rows)) for k in range(columns)
        }
        groups.append((times, values))
    rows = HEADER if delimiter != "," else tuple(r for r in HEADER if r != "SampleTime[ms]")
    text = export(groups, delimiter=delimiter, decimal=decimal, ends=ends, blank=blank, eof=eof, rows=rows)
    path = tmp_path_factory.mktemp("scope") / "run.csv"
    path.write_bytes(text.encode(encoding))
    opened, found = read(path)
    assert opened.problems == []
    for times, columns in groups:
        for name, values in columns.items():
            assert found[name][0].tolist() == pytest.approx([t * 1e-3 for t in times], rel=1e-15)
            assert found[name][1].tolist() == values


def motion(rows=3000, **said):
    times = [0.5 * i for i in range(rows)]
    angle = [0.2 * i for i in range(rows)]
    slow = times[::4][: rows // 4]
    return export(
        [
            (times, {"input_angle": angle, "output_angle": [-a / 39 for a in angle]}),
            (slow, {"torque": [20.0] * len(slow)}),
        ],
        units={"input_angle": "° (Angle)", "output_angle": "° (Angle)", "torque": "Nm (Torque)"},
        **said,
    )


def test_a_run_with_two_sample_times(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text(motion(decimal=","), encoding="utf-8", newline="")
    (source,) = fitting.read_recordings(path)
    run = source.open().read()
    assert 2900 < run.time.size <= 3000
    assert np.diff(run.time) == pytest.approx(5e-4)
    assert run.input_angle[-1] - run.input_angle[0] == pytest.approx(np.radians(0.2) * (run.time.size - 1))
    assert run.output_angle == pytest.approx(-run.input_angle / 39, abs=1e-12)
    assert run.torque == pytest.approx(20.0)


def test_a_scale_that_may_not_be_applied_is_said(tmp_path):
    path = tmp_path / "run.csv"
    path.write_text(motion(ScaleFactor="0,001"), encoding="utf-8", newline="")
    opened, _ = read(path)
    assert len(opened.problems) == 3
    assert (
        'torque has a scale in TwinCAT Scope; the file does not state whether it was exported with "Scale'
        in opened.problems[2]
    )


def test_a_cut_export_gives_what_it_holds(tmp_path):
    text = motion()
    path = tmp_path / "run.csv"
    path.write_text(text[:-9], encoding="utf-8", newline="")
    opened, found = read(path)
    assert len(found["input_angle"][0]) == 2999
    assert opened.problems == [f"{path}: its last line is incomplete; it was left out."]


def without_times(text):
    head, body = text.split("\r\n\r\n0.0\t")
    return head + "\r\n\r\n" + "\r\n".join("\t".join(line.split("\t")[1:3]) for line in ("0.0\t" + body).split("\r\n"))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda t: t.replace("100.0\t40.0\t", "100.0\t40,0\t"), 'line 225: input_angle is "40,0"; it must be a number'),
        (lambda t: t.replace("100.0\t40.0\t", "100.0\t40.0\t1\t"), "line 225: it has 6 cells, the header 5"),
        (lambda t: t.replace("\r\n\r\n0.0\t", "\r\n\r\n132959733843760000\t"), "full time stamps; export it without"),
        (without_times, "fewer cells than its header; export it with time columns"),
        (lambda t: t.replace("\t", ",").replace("0.5,0.2", "0,5,0,2"), "more cells than its header"),
        (lambda t: t.split("\r\n\r\n")[0], 'has no row "Name" in its header'),
        (lambda t: t.replace("\r\n\r\n0.0\t", "\r\n\r\n0.0\0\t"), "zero bytes"),
    ],
)
def test_a_bad_export_is_one_sentence(tmp_path, change, said):
    path = tmp_path / "run.csv"
    path.write_text(change(motion()), encoding="utf-8", newline="")
    with pytest.raises(edge.InputError, match=said) as problem:
        read(path)
    assert "\n" not in str(problem.value)


@pytest.mark.slow(1)
@settings(max_examples=150, deadline=None)
@given(st.data())
def test_any_damage_is_read_or_a_sentence(tmp_path_factory, data):
    raw = bytearray(motion(60).encode())
    for _ in range(data.draw(st.integers(1, 6))):
        place = data.draw(st.integers(0, len(raw) - 1))
        kind = data.draw(st.sampled_from("scd"))
        if kind == "s":
            raw[place] = data.draw(st.integers(0, 255))
        elif kind == "c":
            del raw[place : place + data.draw(st.integers(1, 200))]
        else:
            raw[place:place] = raw[place : place + data.draw(st.integers(1, 200))]
        if len(raw) < 2:
            return
    path = tmp_path_factory.mktemp("scope") / "run.csv"
    path.write_bytes(raw)
    try:
        opened = open_bench_file(path)
        for _ in opened.pieces([c.name for c in opened.channels]):
            pass
    except edge.InputError as problem:
        assert len(str(problem).splitlines()) == 1  # noqa: PT017
