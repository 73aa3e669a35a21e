import math
import sys
import threading

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cycloid_fmu import edge


@given(
    st.floats(allow_nan=False, allow_infinity=False, min_value=-1e9, max_value=1e9), st.sampled_from(["mm", "um", "m"])
)
def test_a_written_length_reads_back(value, unit):
    text = edge.format_quantity(value, "m", unit)
    assert edge.parse_quantity(text, "m") == pytest.approx(value, rel=1e-14, abs=1e-300)


@pytest.mark.parametrize(
    "text",
    ["1,5 mm", "0.3", "nan mm", "inf mm", "2*3 mm", "3 mm 4", "mm", "", "1e400 mm", "3mm", " 3 mm", "3 kg", "3 2*mm",
     "0x3 mm", "1_0 mm", 3, 3.0, None, True, ["3 mm"]],
)  # fmt: skip
def test_anything_but_one_number_and_a_unit_is_refused_with_an_example(text):
    with pytest.raises(ValueError, match="such as"):
        edge.parse_quantity(text, "m")


@pytest.mark.parametrize(
    ("text", "si", "value"),
    [
        ("64 mm", "m", 0.064),
        ("-181 N*m", "N*m", -181.0),
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
    assert edge.json_text({"a": [1.0, math.nan]}).split() == ["{", '"a":', "[", "1.0,", "null", "]", "}"]


@pytest.mark.parametrize(
    ("problem", "status"),
    [(edge.InputError("a.toml: bad."), 2), (KeyboardInterrupt(), 130), (RuntimeError("broke"), 1), (None, 0)],
)
def test_exit_status(problem, status, capsys):
    def app():
        if problem is not None:
            raise problem

    assert threading.current_thread() is threading.main_thread()
    with pytest.raises(SystemExit) as stop:
        edge.run(lambda: app)
    assert stop.value.code == status
    assert "Traceback" not in capsys.readouterr().err


def test_nothing_slow_is_imported_with_the_edge():
    import subprocess

    code = "import sys, cycloid_fmu.edge; print([m for m in ('pint', 'numba', 'xarray') if m in sys.modules])"
    assert (
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout.strip() == "[]"
    )


@pytest.mark.parametrize("name", ["cycloid-fmu", "cycloid-fit", "cycloid-bench"])
def test_the_commands_are_installed_and_say_what_is_wrong(installed_command, name):
    """The other tests of the command line call its entry points in their own process."""
    helped, refused = installed_command(name, "--help"), installed_command(name, "no-such-verb")
    assert helped.returncode == 0
    assert "Usage" in helped.stdout
    assert refused.returncode == 2
    assert "no-such-verb" in refused.stderr
    assert "Traceback" not in refused.stderr
