import json
import math
import sys

import numpy as np
import pydantic
import pytest
from common import PAIR, draws
from hypothesis import given
from hypothesis import strategies as st

from cycloid_fmu import edge
from cycloid_fmu.edge import quantities


@given(
    st.floats(allow_nan=False, allow_infinity=False, min_value=-1e9, max_value=1e9),
    st.sampled_from([(si, unit) for si, usual in quantities.USUAL.items() for unit in usual]),
)
def test_a_written_quantity_reads_back(value, kind):
    si, unit = kind
    text = edge.format_quantity(value, si, unit)
    assert edge.parse_quantity(text, si) == pytest.approx(value, rel=1e-14, abs=1e-300)


def test_the_usual_units_are_what_pint_makes_of_them():
    for si, usual in quantities.USUAL.items():
        for unit, scale in usual.items():
            asked = {"Nm": "N*m", "mNm": "mN*m", "kNm": "kN*m", "Nmm": "N*mm"}.get(unit, unit)
            assert scale == edge.units().Quantity(1.0, asked).to(si).magnitude, (unit, si)


@pytest.mark.parametrize(
    "text",
    [
        "1,5 mm",
        "0.3",
        "nan mm",
        "inf mm",
        "2*3 mm",
        "3 mm 4",
        "mm",
        "",
        "1e400 mm",
        " 3 mm",
        "3 kg",
        "3 2*mm",
        "0x3 mm",
        "1_0 mm",
        "3 Nm",
        "3 Nmm",
        3,
        3.0,
        None,
        True,
        ["3 mm"],
    ],
)
def test_anything_but_one_number_and_a_unit_is_refused_with_an_example(text):
    with pytest.raises(ValueError, match="such as"):
        edge.parse_quantity(text, "m")


@pytest.mark.parametrize(
    ("text", "si", "value"),
    [
        ("64 mm", "m", 0.064),
        ("2kg*m^2", "kg*m^2", 2.0),
        ("-181 N*m", "N*m", -181.0),
        ("181 Nm", "N*m", 181.0),
        ("50 mNm", "N*m", 0.05),
        ("1.2 kNm", "N*m", 1200.0),
        ("30 Ncm", "N*m", 0.3),
        ("181 N m", "N*m", 181.0),
        ("64 nm", "m", 64e-9),
        ("49 Nm/arcmin", "N*m/rad", 49 * 10800 / math.pi),
        ("2 arcsec/Nm", "rad/(N*m)", 2 * math.pi / 648000),
        ("206 GPa", "Pa", 206e9),
        ("0.5 arcmin", "rad", math.pi / 21600),
        ("600 rpm", "rad/s", 20 * math.pi),
        ("1e-3 mm", "m", 1e-6),
        ("49 N*m/arcmin", "N*m/rad", 49 * 10800 / math.pi),
    ],
)
def test_field_units(text, si, value):
    assert edge.parse_quantity(text, si) == pytest.approx(value, rel=1e-14)


def test_a_file_appears_whole_or_not_at_all(tmp_path):
    target = tmp_path / "result.txt"
    target.write_text("before")
    with pytest.raises(RuntimeError), edge.written_whole(target) as temporary:  # noqa: PT012
        temporary.write_text("half")
        raise RuntimeError
    assert target.read_text() == "before"
    with edge.written_whole(target) as temporary:
        temporary.write_text("after")
    assert target.read_text() == "after"
    assert list(tmp_path.iterdir()) == [target]


def test_a_missing_folder_is_named(tmp_path):
    with pytest.raises(edge.InputError, match="nowhere"), edge.written_whole(tmp_path / "nowhere" / "a.nc"):
        pass


def test_json_has_no_nan():
    assert edge.json_text({"a": [1.0, math.nan], "b": [{"c": ()}]}) == (
        '{\n "a": [1.0, null],\n "b": [\n  {\n   "c": []\n  }\n ]\n}'
    )


@draws(
    25,
    100,
    1,
    data=st.recursive(
        st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
        lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    ),
)
def test_json_reads_back(data):
    assert json.loads(edge.json_text(data)) == data


class Part(edge.Config):
    length: edge.Length = 0.0
    torque: edge.Torque | None = None


class Whole(edge.Config):
    part: Part = Part()
    parts: tuple[Part, ...] = ()
    named: dict[str, Part] = pydantic.Field(default={})
    strongest_torque_each: float = 0.0
    pins: int = 3


@pytest.mark.parametrize("number", [0.064, np.float64(0.064), np.float32(0.5), 3, np.int64(2), "64 mm"])
def test_python_gives_si_numbers_or_text_with_a_unit(number):
    expected = 0.064 if isinstance(number, str) else float(number)
    assert Part(length=number).length == expected
    assert Whole(part={"length": number}).part.length == expected


@pytest.mark.parametrize("value", [math.nan, math.inf, True, np.bool_(True), [0.064], "0.064", None])
def test_what_is_no_quantity_is_refused_in_python_in_a_sentence(value):
    with pytest.raises(edge.InputError, match=r"^Part: length = .*such as \"64 mm\"\.$"):
        Part(length=value)


@pytest.mark.parametrize("value", [0.064, 3, True, math.nan])
def test_a_file_states_the_unit(value):
    with pytest.raises(edge.InputError, match=r"^a.toml: \[part\] length = .*a space and a unit, such as"):
        edge.validated(Whole, {"part": {"length": value}}, "a.toml")
    assert edge.validated(Whole, {"part": {"length": "3 mm"}}, "a.toml").part.length == 0.003


@pytest.mark.parametrize(
    ("data", "sentence"),
    [
        ({"pin": 3}, "a.toml: pin is not a known key; did you mean pins?"),
        ({"part": {"lenght": "3 mm"}}, "a.toml: [part] lenght is not a known key; did you mean length?"),
        (
            {"parts": [{"torqe": "3 Nm"}]},
            "a.toml: parts[0].torqe is not a known key; did you mean torque?",
        ),
        ({"colour": 1}, "a.toml: colour is not a known key; check its spelling or remove it."),
        ({"length": "3 mm"}, "a.toml: length is not a known key; it belongs to [part], [[parts]] or [named.NAME]."),
        ({"part": {"pins": 3}}, "a.toml: [part] pins is not a known key; check its spelling or remove it."),
        ({"strongest_torq": 1}, "a.toml: strongest_torq is not a known key; did you mean strongest_torque_each?"),
    ],
)
def test_an_unknown_key_is_named_with_the_nearest_known_one(data, sentence):
    with pytest.raises(edge.InputError) as refused:
        edge.validated(Whole, data, "a.toml")
    assert str(refused.value) == sentence


def test_an_error_names_the_argument_in_python():
    assert str(edge.ArgumentError("seed", "it must not be negative", -1)) == "seed = -1: it must not be negative."
    with pytest.raises(edge.ArgumentError, match=r"^path = x\.csv: the name must end in \.nc\.$"):
        edge.output_path("x.csv", "path", (".nc",))


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "cp1252", "latin-1", "utf-16"])
def test_a_table_is_read_in_any_usual_encoding(tmp_path, encoding):
    (tmp_path / "a.csv").write_text("torque [N·m],note\n5,Prüfstand\n", encoding=encoding)
    assert [row for _, row in edge.number_rows(tmp_path / "a.csv", {"torque": "N*m"})] == [{"torque": 5.0}]


def test_a_file_of_ours_may_begin_with_a_byte_order_mark(tmp_path):
    (tmp_path / "a.toml").write_text('format = "x/1"\n', encoding="utf-8-sig")
    assert edge.format_of(tmp_path / "a.toml") == "x/1"


def test_a_turn_is_a_rev_as_controllers_write_it():
    assert edge.parse_quantity("0.25 rev", "rad") == edge.parse_quantity("90 deg", "rad")
    assert edge.parse_quantity("2 rev/s", "rad/s") == pytest.approx(4 * math.pi)


def test_what_is_no_archive_is_no_fmu(tmp_path):
    (tmp_path / "d.toml").write_text("")
    with pytest.raises(edge.InputError, match=r"d\.toml: this is not an FMU"):
        edge.zip_archive(tmp_path / "d.toml", "FMU")


def test_nothing_slow_is_imported_with_the_edge():
    import subprocess

    slow = ("pint", "numba", "xarray", "typer", "rich")
    code = f"import sys, cycloid_fmu.edge; print([m for m in {slow} if m in sys.modules])"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
    )


def test_a_value_that_rounds_to_zero_has_no_sign(command, tmp_path):
    """Flanks as drawn have no play: a thousandth of a newton metre turns the output backwards by next to nothing."""
    (tmp_path / "drive.toml").write_text(PAIR)
    done = command("cycloid-fmu", "analyze", "drive.toml", "--torque", "-0.001 N*m")
    assert done.returncode == 0
    assert "0.0000″" in done.stdout
    assert "-0.0000" not in done.stdout
