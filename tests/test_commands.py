"""Common behaviour of the three command lines."""

import contextlib
import ctypes
import importlib
import io
import re
import signal
import subprocess
import sys
import threading
from typing import Annotated

import pytest
import typer
from common import PAIR

from cycloid_fmu import edge
from cycloid_fmu.cli.shared import PlatformNames
from cycloid_fmu.edge import commands
from cycloid_fmu.fmu.library import PLATFORMS

COMMANDS = ("cycloid-fmu", "cycloid-fit", "cycloid-bench")


@pytest.fixture
def ran(capsys, monkeypatch):
    """Run a command line made for the test; return exit status and output."""

    def run(app, *words):
        monkeypatch.setattr(sys, "argv", ["some-command", *words])
        with pytest.raises(SystemExit) as stop:
            commands.run(app)
        printed = capsys.readouterr()
        assert "Traceback" not in printed.err
        return stop.value.code, printed.out, printed.err

    return run


@pytest.mark.parametrize(
    ("problem", "status"),
    [
        (edge.InputError("a.toml: bad."), 2),
        (KeyboardInterrupt(), 130),
        (EOFError(), 1),
        (RuntimeError("broke"), 1),
        (typer.Exit(1), 1),
        (None, 0),
    ],
)
def test_exit_status(problem, status, ran):
    app = commands.command_line("some-command", "Fails.")

    @app.command()
    def fail() -> None:
        if problem is not None:
            raise problem

    assert threading.current_thread() is threading.main_thread()
    code, _, error = ran(app, "fail")
    assert code == status
    assert ("Interrupted" in error) == (status == 130)


def test_an_interrupt_in_a_library_s_callback_ends_the_command(ran):
    """There Python can't raise it; the compiler then failed with an error of its own."""
    app = commands.command_line("some-command", "Is interrupted.")
    interrupted = ctypes.CFUNCTYPE(None)(lambda: signal.raise_signal(signal.SIGINT))

    @app.command()
    def fail() -> None:
        interrupted()
        raise RuntimeError("no compiled object yet")

    code, _, error = ran(app, "fail")
    assert code == 130
    assert error.strip() == "Interrupted; finished results are kept."


@pytest.mark.system
@pytest.mark.parametrize("name", COMMANDS)
def test_the_commands_are_installed_and_say_what_is_wrong(installed_command, name):
    """The other tests of the command line call its entry points in their own process."""
    helped, refused = installed_command(name, "--help"), installed_command(name, "no-such-verb")
    assert helped.returncode == 0
    assert "Usage" in helped.stdout
    assert refused.returncode == 2
    assert "no-such-verb" in refused.stderr
    assert "Traceback" not in refused.stderr


@pytest.mark.parametrize("name", COMMANDS)
def test_the_version_is_shown(command, name):
    assert re.fullmatch(rf"{name} \d+\.\d+\.\d+\n", command(name, "--version").stdout)


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["cycloid-fmu", "analyse"], "analyse is not a command; did you mean analyze?"),
        (["cycloid-fmu", "surface", "nominl"], "nominl is not a command; did you mean nominal?"),
        (["cycloid-fit", "metric"], "metric is not a command; did you mean metrics?"),
        (["cycloid-bench", "recrod"], "recrod is not a command; did you mean record?"),
        (
            ["cycloid-fit", "compensate", "p.toml", "-o", "a.c"],
            "compensate is now the command cycloid-fmu compensate, with the same options.",
        ),
        (["cycloid-fmu", "xyz"], "xyz is not a command; see cycloid-fmu --help."),
        (
            ["cycloid-fmu", "compensate", "p.toml", "--pair", "p.toml"],
            "--pair is not an option of cycloid-fmu compensate; write PAIR.toml without an option.",
        ),
        (
            ["cycloid-fmu", "analyze", "p.toml", "--angles", "3", "--angles=4"],
            '--angles takes one value; it is given 2 times: "3", "4".',
        ),
        (
            ["cycloid-fmu", "surface", "nominal", "p.toml", "-o", "a.nc", "-ob.nc"],
            '--output takes one value; it is given 2 times: "a.nc", "b.nc".',
        ),
        (
            ["cycloid-bench", "record", "b.toml", "--idle", "2 s", "--idle", "3 s"],
            '--idle takes one value; it is given 2 times: "2 s", "3 s".',
        ),
        (
            ["cycloid-fit", "metrics", "a.csv", "--ratio", "-39", "--ratio", "-40"],
            '--ratio takes one value; it is given 2 times: "-39", "-40".',
        ),
        (
            ["cycloid-fmu", "analyze", "p.toml", "--slices", "0"],
            '--slices = "0": it must be greater than or equal to 1.',
        ),
        (["cycloid-fmu", "budget", "r.toml", "--samples=3.5"], '--samples = "3.5": it must be a whole number.'),
        (["cycloid-fit", "curve", "a.csv", "--ratio", "abc"], '--ratio = "abc": it must be a number.'),
        (
            ["cycloid-fmu", "analyze", "p.toml", "--tourque", "3 Nm"],
            "--tourque is not an option of cycloid-fmu analyze; did you mean --torque?",
        ),
        (
            ["cycloid-fit", "plan", "p.toml", "--tork", "3 Nm"],
            "--tork is not an option of cycloid-fit plan; did you mean --torque?",
        ),
        (
            ["cycloid-bench", "record", "b.toml", "--ouput", "r"],
            "--ouput is not an option of cycloid-bench record; did you mean --output?",
        ),
    ],
)
def test_unknown_words_are_answered_in_a_sentence(command, words, sentence):
    run = command(*words)
    assert run.returncode == 2
    assert run.stderr == sentence + "\n"


@pytest.mark.parametrize(
    "words",
    [
        ["cycloid-fmu", "analyze", "no.toml", "--torque", "3 Nm", "--plot", "x.csv"],
        ["cycloid-fit", "curve", "no.csv", "--pair", "no.toml", "--plot", "x.csv"],
        ["cycloid-bench", "export", "no.arrows", "-o", "x.doc"],
    ],
)
def test_an_ending_that_does_not_fit_is_refused_before_anything_is_read(command, words):
    run = command(*words)
    assert run.returncode == 2
    assert re.fullmatch(r"--(plot|output) = x\.(csv|doc): the name must end in \..*\.\n", run.stderr)


def every_command():
    """Each command of the three programs, with its name."""
    for name, door in (("cycloid-fmu", "cycloid_fmu"), ("cycloid-fit", "fitting"), ("cycloid-bench", "drivers")):
        group = typer.main.get_command(importlib.import_module(f"{door}.cli").app)
        context = group.context_class(group)
        for verb in group.commands:
            command = group.get_command(context, verb)
            for below in getattr(command, "commands", {"": command}).values():
                yield f"{name} {verb} {below.name}", below


def test_help_shows_few_options_first_and_the_others_under_more():
    for name, one in every_command():
        options = [p for p in one.params if p.param_type_name == "option" and p.name != "help"]
        main = [p for p in options if p.rich_help_panel is None]
        assert len(main) == (6 if len(options) > 8 else len(options)), name
        assert all(p in main for p in options if p.required), name
        assert len(options) <= 18, name


def test_the_help_names_every_platform():
    assert all(name in PlatformNames.__metadata__[0].help for name in PLATFORMS)


def test_more_options_are_in_the_help(command):
    shown = command("cycloid-fmu", "tolerance", "--help").stdout
    main, more = shown.split("More options")
    assert "--samples" in main
    assert "--scheduler" in more
    assert "More options" not in command("cycloid-fmu", "draw", "--help").stdout


def test_keys_of_files_lead_to_the_right_one(command, tmp_path):
    """A part of a limit's name misspelt, and a key of one material at the table of all."""
    (tmp_path / "p.toml").write_text(PAIR + '[material]\nyoungs_modulus = "70 GPa"\n')
    (tmp_path / "pair.toml").write_text(PAIR)
    limits = 'format = "cycloid-requirements/1"\n[limits]\nstifness = "100 N*m/arcmin"\n'
    (tmp_path / "limits.toml").write_text(limits)
    for words, said in (
        (
            ["p.toml"],
            "p.toml: [material] youngs_modulus is not a known key; it belongs to [material.gear], [material.pin], "
            "[material.output_pin] or [material.ring].\n",
        ),
        (
            ["pair.toml", "--limits", "limits.toml"],
            "limits.toml: [limits] stifness is not a known key; did you mean torsional_stiffness?\n",
        ),
    ):
        run = command("cycloid-fmu", "analyze", *words)
        assert (run.returncode, run.stderr) == (2, said)


def study(torque: float, seed: int) -> None:
    """A function of the library."""
    if seed < 0:
        raise edge.ArgumentError("seed", "it must not be negative", seed)
    if torque == 0.0:
        raise edge.ArgumentError("output_torque", "it must not be zero", torque)


def test_errors_name_the_argument_in_python_and_the_option_in_a_command(ran):
    app = commands.command_line("some-command", "Studies.")

    @app.command("study")
    def study_(
        torque: Annotated[float, commands.quantity_option("N*m", "Torque.", "--output-torque")],
        seed: Annotated[int, typer.Option()] = 1,
        kind: Annotated[str, commands.choice_option(("sobol", "saltelli"), "Design.")] = "sobol",
    ) -> None:
        study(torque, seed)

    with pytest.raises(edge.ArgumentError, match=r"^seed = -1: it must not be negative\.$"):
        study(1.0, -1)
    for words, sentence in (
        (["--output-torque", "3 Nm", "--seed", "-1"], "--seed = -1: it must not be negative."),
        (["--output-torque", "0 Nm"], '--output-torque = "0 Nm": it must not be zero.'),
        (
            ["--output-torque", "3 kg"],
            '--output-torque = "3 kg": the unit "kg" measures something else; use one such as N*m.',
        ),
        (
            ["--output-torque", "3 Nm", "--kind", "sobl"],
            '--kind = "sobl": it must be one of sobol, saltelli; did you mean sobol?',
        ),
    ):
        assert ran(app, "study", *words) == (2, "", sentence + "\n")
    assert ran(app, "study", "--output-torque", "3 Nm") == (0, "", "")


class Terminal(io.StringIO):
    """A narrow terminal."""

    def isatty(self):
        return True


MEANING = "What it means, said at such a length that no narrow terminal holds it."
ROWS = [["a_very_long_name_of_a_variable_of_an_fmu", "-3.72562147893e-22", MEANING], ["[x]", "12 … 13 µm", ""]]


@pytest.mark.parametrize("output", [io.StringIO, Terminal])
def test_nothing_in_a_table_is_cut_however_narrow_the_terminal(output, monkeypatch):
    monkeypatch.setenv("COLUMNS", "40")
    with contextlib.redirect_stdout(output()) as printed:
        commands.print_table("Variables [1]", ["variable", "start", "meaning"], ROWS)
    lines = printed.getvalue().splitlines()
    for word in ("Variables [1]", ROWS[0][0], ROWS[0][1], "[x]", "12 … 13 µm"):
        assert any(word in line for line in lines), word
    assert MEANING in " ".join(re.sub(r"\S*_\S*|-3\S*", "", " ".join(lines)).split())
    assert "…" not in printed.getvalue().replace("12 … 13 µm", "")
    assert len(lines) == (5 if output is io.StringIO else 6)


def test_numbers_are_set_to_the_right(capsys):
    commands.print_table("", ["error", "value"], [["offset", "-1.5 µm"], ["isometric", "12.5 µm"]])
    assert capsys.readouterr().out.splitlines()[3:] == ["offset     -1.5 µm", "isometric  12.5 µm"]


def test_a_long_computation_is_not_silent_in_a_log(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(commands.time, "monotonic", lambda: now[0])
    with commands.progress("drives", 1000) as progress:
        for _ in range(100):
            progress(10)
            now[0] += 2.0
    lines = capsys.readouterr().err.splitlines()
    assert lines[0] == "drives: 30 of 1000 (3%) after 4 s, about 3 min left", "announced at once"
    assert lines[-1] == "drives: 940 of 1000 (94%) after 186 s, about 12 s left"
    assert len(lines) == 10


def test_the_time_left_is_that_at_the_measured_speed(monkeypatch, capsys):
    """Drives that an interrupted run left do not count as speed, nor do items of an earlier stage."""
    now = [0.0]
    monkeypatch.setattr(commands.time, "monotonic", lambda: now[0])
    with commands.Bar("drives", 1000) as bar:
        now[0] = 7.0  # for the start of processes
        bar.advance(400)  # from a checkpoint
        now[0] = 57.0
        bar.advance(100)
        assert bar.left() == pytest.approx(500 / 2.0)
        bar.update(completed=0, total=2000, description="crank angles")
        assert bar.left() is None
        now[0] = 67.0
        bar.advance(1000)
        assert bar.left() == pytest.approx(10.0)


def test_a_stage_of_unknown_length_is_named_in_a_log(monkeypatch, capsys):
    now = [0.0]
    monkeypatch.setattr(commands.time, "monotonic", lambda: now[0])
    with commands.status() as stage:
        for number in range(4):
            stage(f"finding a start ({number + 1})")
            now[0] += 20.0
    assert capsys.readouterr().err == "finding a start (3) after 40 s\n"


def test_times_left_are_words():
    assert [commands._left(s) for s in (None, 8.2, 59.0, 100.0, 3599.0, 8000.0)] == [
        "",
        "about 9 s left",
        "about 59 s left",
        "about 2 min left",
        "about 1 h 0 min left",
        "about 2 h 13 min left",
    ]


def test_a_short_computation_says_nothing_in_a_log(capsys):
    with commands.progress("drives", 1000) as progress:
        progress(1000)
    assert capsys.readouterr().err == ""


def test_start_values_that_are_rounding_are_shown_as_0():
    """A transform of zeros is 0, and exponents are whole numbers."""
    from cycloid_fmu.cli.inspect import _shown

    assert [_shown(start) for start in ("-3.72562147893e-22", 1.5e-6, "", "true", 40)] == [
        "0",
        "1.5e-06",
        "",
        "true",
        "40",
    ]


def test_what_is_no_fmu_is_refused(command, tmp_path):
    (tmp_path / "d.toml").write_text(PAIR)
    for words in (["simulate", "d.toml", "--torque", "1 Nm"], ["inspect", "d.toml"], ["compare", "d.toml", "d.toml"]):
        run = command("cycloid-fmu", *words)
        what = "a gear pair (cycloid-pair/1), for cycloid-fmu analyze, draw, build and --pair"
        assert (run.returncode, run.stderr) == (2, f"d.toml: this is {what}; an FMU is needed here.\n")


@pytest.mark.system
def test_the_first_answer_waits_for_no_package_that_it_does_not_need(tmp_path):
    (tmp_path / "pair.toml").write_text(PAIR)
    code = """
import sys
sys.argv = ["cycloid-fmu", "analyze", "pair.toml", "--torque", "181 Nm", "--angles", "3"]
from cycloid_fmu.cli import main
try:
    main()
finally:
    print(*{name.partition(".")[0] for name in sys.modules})
"""
    run = subprocess.run([sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, check=True)
    assert "181 N·m" in run.stdout
    slow = {"xarray", "pandas", "dask", "pint", "matplotlib", "rich", "fmpy", "joblib", "h5netcdf", "lmfit"}
    assert not slow & set(run.stdout.splitlines()[-1].split())


def test_a_command_says_which_option_the_library_objects_to(command, tmp_path):
    (tmp_path / "pair.toml").write_text(PAIR)
    (tmp_path / "t.toml").write_text('format = "cycloid-tolerances/1"\n[offset]\ntolerance = "1 um"\n')
    words = ["cycloid-fmu", "tolerance", "pair.toml", "--tolerances", "t.toml", "--samples", "2", "--angles", "20"]
    for more, sentence in (
        ([], "--torque is missing; give it, or state [pair] rated_torque in pair.toml."),
        (["--torque", "0 Nm"], '--torque = "0 Nm": a study\'s loads must not be zero; the play has its own figures.'),
        (["--torque", "9 Nm", "--allocate", "2"], "--allocate = 2.0: the yield to reach must be between 0 and 1."),
        (
            ["--design", "sobl"],
            '--design = "sobl": it must be one of sobol, latin-hypercube, saltelli; did you mean sobol?',
        ),
    ):
        run = command(*words, *more)
        assert (run.returncode, run.stderr) == (2, sentence + "\n")


def test_newton_metres_are_written_as_on_data_sheets(command, tmp_path):
    (tmp_path / "pair.toml").write_text(PAIR)
    runs = [
        command("cycloid-fmu", "analyze", "pair.toml", "--angles", "3", "--torque", text)
        for text in ("181 Nm", "181 N*m", "0.181 kNm")
    ]
    assert {run.stdout for run in runs} == {runs[0].stdout}
    assert "181 N·m" in runs[0].stdout
