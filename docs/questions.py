"""Answers a reader's questions by the figures that were measured: `python docs/questions.py` writes `docs/measured.md`.

The figures are those of `docs/development/benchmarks.md`, which `docs/measure.py` writes; none is stated here.
"""

import re
from dataclasses import dataclass
from functools import cache
from pathlib import Path

HERE = Path(__file__).parent
RECORD = HERE / "development" / "benchmarks.md"
PAGE = HERE / "measured.md"
MEDIAN = "median"


@dataclass(frozen=True)
class Figure:
    """A line of the page.

    Attributes
    ----------
    asked : str
        The quantity, in a reader's words.
    shown : str
        The answer, with {} for each figure.
    file, test : str
        The benchmark or test that measures it; a test's name may be without its parameters: then it is all of them.
    what : tuple of str
        The names of the figures in the record, a pattern for the end of a name.
    """

    asked: str
    shown: str
    file: str
    test: str
    what: tuple[str, ...] = (MEDIAN,)


CONTACT, FMU, NATIVE, START = "test_contact_speed", "test_fmu_speed", "test_native_speed", "test_start_speed"
TOLERANCE, SOLVER, CASES = "test_tolerance_speed", "from the independent solver", "test_reference_case"
QUESTIONS: dict[str, tuple[Figure, ...]] = {
    "How exact is the contact model?": (
        Figure(
            "transmission error, against an independent slow solver, largest difference of six drives",
            "{}″",
            "test_reference_cases",
            CASES,
            (f"transmission error {SOLVER}",),
        ),
        Figure("backlash, the same", "{}″", "test_reference_cases", CASES, (f"backlash {SOLVER}",)),
        Figure("largest contact pressure, the same", "{} %", "test_reference_cases", CASES, (f"pressure {SOLVER}",)),
    ),
    "How exact is an FMU?": (
        Figure(
            "transmission error of a native FMU against the exact model, largest",
            "{}″",
            "test_native",
            "test_tables_keep_their_accuracy_at_crank_angles_and_torques_they_were_not_made_at",
            ("native TE, largest error",),
        ),
        Figure(
            "the same with errors of all pins and teeth",
            "{}″",
            "test_native",
            "test_tables_of_a_drive_with_all_errors_keep_their_accuracy_over_the_whole_period",
            ("native TE with all errors, largest error",),
        ),
    ),
    "How far can an identification be trusted?": (
        *(
            Figure(
                f"share of 95 % intervals of identified errors that contain the truth, {z}/{z + 1}",
                "{}",
                "test_identify",
                f"test_coverage_of_the_intervals[{z}]",
                ("that hold the truth",),
            )
            for z in (39, 31, 19)
        ),
        Figure(
            "residual of a load left out of the fit, over its noise, 39/40",
            "{}",
            "test_identify",
            "test_coverage_of_the_intervals[39]",
            ("residual of a load kept back, times its noise",),
        ),
        Figure(
            "identification by this package",
            "{}",
            "test_identify_speed",
            "test_identification_against_the_plain_way",
            ("identify",),
        ),
        Figure(
            "identification of the same recordings by least squares with all errors free",
            "{}",
            "test_identify_speed",
            "test_identification_against_the_plain_way",
            ("plain",),
        ),
        Figure(
            "orders of the transmission error inside their 95 % intervals",
            "{}",
            "test_metrics",
            "test_known_orders_come_back_within_their_uncertainty[10-1.0-8192-1560]",
            ("of 10 seeds",),
        ),
    ),
    "How safe is a recording?": (
        Figure(
            "recorders killed at a random moment; none lost a counted sample",
            "{}",
            "test_faults",
            "test_kill_9_at_any_moment_loses_nothing_acknowledged[30]",
            ("kills",),
        ),
        Figure(
            "damaged files, each read without a wrong sample or refused",
            "{}",
            "test_mutations",
            "test_recordings[100000]",
            ("damaged recordings",),
        ),
        Figure(
            "samples in one run; lost; memory after a tenth and at the end",
            "{}; {}; {} MB and {} MB",
            "test_acquisition_speed",
            "test_soak",
            ("samples", "lost", "after a tenth", "at the end"),
        ),
        Figure(
            "frames a second, as a share of those of a bare python-can loop (UDP)",
            "{} %",
            "test_acquisition_speed",
            "test_frames_a_second_against_a_bare_receive_loop[udp_multicast]",
            ("per cent of the bare loop",),
        ),
    ),
    "How long does an analysis take?": (
        Figure(
            "a crank angle of a 40-pin pair under load, without and with errors",
            "{} µs, {} µs",
            CONTACT,
            "test_sweep[loaded-",
            ("µs a crank angle",) * 2,
        ),
        Figure(
            "the same with all derivatives",
            "{} µs, {} µs",
            CONTACT,
            "test_sweep_with_all_derivatives",
            ("µs a crank angle",) * 2,
        ),
        Figure(
            "under load and with its backlash",
            "{} µs, {} µs",
            CONTACT,
            "test_sweep[loaded and play-",
            ("µs a crank angle",) * 2,
        ),
        Figure(
            "a misaligned pair in a hundred slices",
            "{} ms",
            CONTACT,
            "test_a_hundred_slices_misaligned",
            ("ms a crank angle",),
        ),
        Figure(
            "a change of a value on the desk, processor time",
            "{} ms",
            "test_desk_speed",
            "test_a_change_on_the_desk[rigid bearings]",
            ("processor ms",),
        ),
        Figure(
            "the same on bearings",
            "{} ms",
            "test_desk_speed",
            "test_a_change_on_the_desk[on bearings]",
            ("processor ms",),
        ),
        Figure(
            "time of a brute-force scan of the same accuracy, over that of the kernel",
            "{}",
            CONTACT,
            "test_against_brute_force",
            ("times faster",),
        ),
    ),
    "How long does a step of an FMU take?": (
        Figure("kinematic, in Python, through fmpy", "{} µs", FMU, "test_set_step_get[kinematic]", ("µs",)),
        Figure("compliant, in Python, through fmpy", "{} µs", FMU, "test_set_step_get[compliant]", ("µs",)),
        Figure("a native FMU in a C program", "{} ns", NATIVE, "test_step_in_the_c_host", ("ns a step",)),
        Figure(
            "tables of a native FMU on one processor: a drive as made; 2 µm on every pin; on every pin and tooth",
            "{} s, {} s, {} s",
            NATIVE,
            "test_tables",
            ("processor seconds",) * 3,
        ),
        Figure(
            "from instantiation to the first step in a fresh process, processor time",
            "{} s",
            FMU,
            "test_ready_in_a_fresh_process",
            ("processor s from instantiate to initialised",),
        ),
    ),
    "How long do studies and fits take?": (
        Figure(
            "a drive of a tolerance study, exact: wall clock and processor",
            "{} ms",
            TOLERANCE,
            "test_exact_against_a_python_loop",
            ("^exact: ms a drive, wall and processor",),
        ),
        Figure(
            "time with one worker over time with two, three rounds",
            "{}",
            TOLERANCE,
            "test_two_workers_over_one",
            ("each round",),
        ),
        Figure(
            "overhead of a task on a cluster, with a hundred tasks",
            "{} ms",
            TOLERANCE,
            "test_overhead_of_a_task_on_a_cluster[100]",
            ("ms a task",),
        ),
        Figure(
            "wear over three million turns, all teeth alike, processor time",
            "{} s",
            "test_wear_speed",
            "test_three_million_turns[alike]",
            ("user time",),
        ),
        Figure(
            "the same where all teeth and pins differ",
            "{} s",
            "test_wear_speed",
            "test_three_million_turns[all teeth and pins differ]",
            ("user time",),
        ),
        Figure(
            "identification from the command line, processor seconds, least and median",
            "{}",
            "test_identify_speed",
            "test_from_the_command_line",
            ("processor seconds, least and median",),
        ),
        Figure(
            "two hours of four channels at 4 kHz to the standard figures; memory",
            "{} s; {} MB",
            "test_figures_speed",
            "test_two_hours_to_figures",
            ("^seconds", "^megabytes"),
        ),
    ),
    "How long until the first result?": (
        Figure(
            "installation; the first result; the same once kernels are compiled, in s (of processor)",
            "{}; {}; {}",
            START,
            "test_from_nothing_to_the_first_result",
            ("^installed", "first result", "once the kernels are compiled"),
        ),
        Figure(
            "`cycloid-fmu` from its start to the first action, in s (of processor)",
            "{}",
            START,
            "test_until_it_is_there[cycloid-fmu]",
            ("seconds beyond Python's own start (processor)",),
        ),
    ),
}


@cache
def recorded(text: str) -> list[tuple[str, str, str, str]]:
    """Return (file, test, name, figure) of each figure of the record."""
    found, file = [], ""
    for line in text.splitlines():
        if line.startswith("### "):
            file = line[4:]
        elif line.startswith("## "):
            file = ""
        cells = [cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]]
        if len(cells) == 4:
            found.append((cells[0], cells[1], cells[2], cells[3]))
        elif file and len(cells) == 3:
            found.append((file, cells[0], MEDIAN, cells[1]))
            for one in cells[2].split("; "):
                name, _, value = one.rpartition(": ") if one.count(": ") > 1 and "[" in one else one.partition(": ")
                found.append((file, cells[0], name, value))
    return found


def values(figure: Figure, text: str) -> list[str]:
    """Return what the record has of a figure, as it is written there: of several drives the largest.

    A figure whose names are alike has its tests in the record's order.
    """
    rows = [row for row in recorded(text) if row[0] == figure.file and row[1].startswith(figure.test)]
    found = []
    for place, name in enumerate(figure.what):
        fits = [row[3] for row in rows if (row[2].startswith(name[1:]) if name[:1] == "^" else name in row[2])]
        alike = len(set(figure.what)) < len(figure.what)
        if len(fits) <= (place if alike else 0):
            return []
        found.append(fits[place] if alike else max(fits, key=_size) if len(fits) > 1 else fits[0])
    return found


def _size(text: str) -> float:
    number = re.match(r"-?[\d.]+(e-?\d+)?", text)
    return float(number[0]) if number else 0.0


def reproduced_by(figure: Figure) -> str:
    """Return the command that measures a figure again."""
    for folder in ("benchmarks", "tests"):
        for path in sorted((HERE.parent / folder).rglob(f"{figure.file}.py")):
            test = figure.test.partition("[")[0]
            if f"def {test}(" in path.read_text(encoding="utf-8"):
                all_of_it = '-m "" ' if folder == "tests" else ""
                return f"pytest {all_of_it}{path.relative_to(HERE.parent).as_posix()}::{test}"
    raise LookupError(f"{figure.file}: no test is named {figure.test}")


def page(text: str) -> str:
    """Return the page by question, from the text of the record; figures that were not measured are left out."""
    parts = [
        "# Accuracy and speed",
        "Measured figures, by a reader's question. "
        + next(line for line in text.splitlines() if line.startswith("By `python docs/measure.py"))
        + " All figures, with the way each was measured: [benchmarks](development/benchmarks.md). The commands below a "
        "table measure it again, in the order of its lines, in a copy of the source with `pip install -e '.[test]'`. "
        "To write the figures add `--benchmark-json=figures.json` to `benchmarks`, "
        "`--junitxml=figures.xml` to `tests`.",
    ]
    for question, figures in QUESTIONS.items():
        answered = {figure: found for figure in figures if (found := values(figure, text))}
        if answered:
            rows = [f"| {figure.asked} | {_joined(figure.shown, found)} |" for figure, found in answered.items()]
            commands = dict.fromkeys(reproduced_by(figure) for figure in answered)
            parts.append(f"## {question}")
            parts.append("\n".join(["| quantity | measured |", "| --- | --- |", *rows]))
            parts.append("\n".join(["```text", *commands, "```"]))
    return "\n\n".join(parts) + "\n"


def _joined(shown: str, found: list[str]) -> str:
    """Return the answer; units that the record states with a figure are not repeated."""
    bare = [value.rstrip(" ″%") if shown[-1] in "″%" else value for value in found]
    return shown.format(*bare)


if __name__ == "__main__":
    PAGE.write_text(page(RECORD.read_text(encoding="utf-8")), encoding="utf-8")
