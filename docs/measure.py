"""Repeat all measurements of docs/measured.md: `python docs/measure.py` (hours; --quick: a tenth of each study).

Speed comes from the benchmarks; accuracy, coverage of intervals and the fault table from records of the tests; the
share of the code that the tests run from coverage.py. Finished parts are kept in `docs/generated`. After an
interruption, which writes the page of these parts, the same command continues; a change of code, tests or benchmarks
starts again. `python docs/measure.py test_contact_speed …` repeats only these benchmarks and replaces their sections.
All figures are in `docs/development/benchmarks.md`; `questions.py` in this folder states which of them answer a
reader's question in `docs/measured.md`.
"""

import argparse
import ast
import datetime
import hashlib
import json
import os
import platform
import re
import resource
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import questions

ROOT = Path(__file__).parent.parent
RECORD = questions.RECORD
PACKAGES = ("cycloid_fmu", "fitting", "drivers")
QUICK = {
    "CYCLOID_SEEDS": "10",
    "CYCLOID_KILLS": "30",
    "CYCLOID_STOPS": "10",
    "CYCLOID_MUTATIONS": "1e5",
    "CYCLOID_STEPS": "1e4",
}
BENCHMARKS = sorted(p.stem for p in (ROOT / "benchmarks").glob("test_*.py"))
STUDIES = {name: [f"tests/{name}"] for name in ("cycloid_fmu", "fitting", "drivers", "native")}
STUDIES["together"] = sorted(f"tests/{p.name}" for p in (ROOT / "tests").glob("test_*.py"))
# The kernels' lines are seen where they are interpreted.
INTERPRETED = ["tests/cycloid_fmu/test_contact.py", "tests/cycloid_fmu/test_reference_cases.py::test_reference_case"]


def parts(folder: Path) -> Iterator[tuple[str, Path, list[list[str]], dict[str, str]]]:
    """(name, its report, calls of pytest that make it, environment) of each part."""
    for name in BENCHMARKS:
        report = folder / f"{name}.json"
        # Beside the plain way a drive takes more than a minute.
        yield name, report, [[f"benchmarks/{name}.py", f"--benchmark-json={report}.part"]], {"CYCLOID_SEEDS": "3"}
    parallel = ["-n", "auto", "-o", "junit_family=xunit1"]
    report = folder / "default.xml"
    yield "the default tests", report, [[*parallel, f"--junitxml={report}.part"]], {}
    for name, paths in STUDIES.items():
        report = folder / f"slow-{name}.xml"
        yield (
            f"slow and system tests, {name}",
            report,
            [[*paths, "-m", "slow or system", *parallel, f"--junitxml={report}.part"]],
            {},
        )
    report, lines = folder / "coverage.json", ["--cov", "--cov-report="]
    calls = [["-n", "auto", *lines], [*INTERPRETED, *lines, "--cov-append", f"--cov-report=json:{report}.part"]]
    yield "coverage", report, calls, {"COVERAGE_FILE": str(folder / "coverage.data")}


def measured(name: str, report: Path, calls: list[list[str]], environment: dict[str, str]) -> None:
    """Make one part's report unless it is there, with what it took; what fails is not in the page."""
    if report.exists():
        return
    print(f"== {name}", flush=True)
    before, begin, load = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter(), os.getloadavg()[0]
    for words in calls:
        interpreted = {"NUMBA_DISABLE_JIT": "1"} if "--cov-append" in words else {}
        done = subprocess.run(
            [sys.executable, "-m", "pytest", "-q", *words], cwd=ROOT, env={**environment, **interpreted}, check=False
        )
        if done.returncode not in (0, 1, 5):  # all passed, some failed, none there
            raise SystemExit(f"{name}: pytest ended with status {done.returncode}; the parts before are kept.")
    if not Path(f"{report}.part").exists():
        raise SystemExit(f"{name}: pytest ran nothing that makes a report; the parts before are kept.")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    processor = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    took = {
        "seconds": time.perf_counter() - begin,
        "processor": processor,
        "load": [load, os.getloadavg()[0]],
        "date": datetime.date.today().isoformat(),
    }
    report.with_suffix(".took").write_text(json.dumps(took), encoding="utf-8")
    os.replace(f"{report}.part", report)


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |" for line in lines)


def took(report: Path) -> str:
    """Time and load of a part, in words."""
    one = json.loads(report.with_suffix(".took").read_text(encoding="utf-8"))
    low, high = sorted(one["load"])
    load = f"load {low:.1f} to {high:.1f}"
    return f"{one['date']}: {one['seconds']:.0f} s, {one['processor']:.0f} s of processors, {load}"


def speed(report: Path) -> Iterator[str]:
    """One benchmark file: its description and figures."""
    text = (ROOT / "benchmarks" / f"{report.stem}.py").read_text(encoding="utf-8")
    yield f"### {report.stem}"
    yield (ast.get_docstring(ast.parse(text)) or "") + f" ({took(report)})"
    rows = []
    for one in json.loads(report.read_text(encoding="utf-8"))["benchmarks"]:
        median = one["stats"]["median"]
        unit, scale = next((u, s) for u, s in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6), ("ns", 0.0)) if median >= s)
        further = "; ".join(f"{name}: {value}" for name, value in one["extra_info"].items())
        rows.append([one["name"], f"{median / (scale or 1e-9):.3g} {unit}", further])
    yield table(["benchmark", "median", "other figures"], rows)


def replaced(record: str, sections: dict[str, str]) -> str:
    """The record with the sections of these benchmarks replaced, or added in the order of the alphabet."""
    head, begin, rest = record.partition("## Speed\n\n")
    parts, begin_after, after = rest.partition("\n\n## Accuracy and coverage\n")
    old = {one.partition("\n")[0]: one for one in re.split(r"(?:^|\n\n)### ", parts) if one}
    new = old | {name: section.removeprefix("### ") for name, section in sections.items()}
    return head + begin + "\n\n".join(f"### {new[name]}" for name in sorted(new)) + begin_after + after


def recorded(report: Path) -> Iterator[list[str]]:
    """(file, test, what, figure) that a passed test recorded; and each row of the fault table."""
    for case in ElementTree.parse(report).iter("testcase"):
        if any(case.find(bad) is not None for bad in ("failure", "error", "skipped")):
            continue
        module, name = case.get("classname", "").rsplit(".", 1)[-1], case.get("name", "")
        yield from ([module, name, p.get("name", ""), p.get("value", "")] for p in case.iter("property"))
        if module == "test_faults":
            yield [module, name, "fault", ""]


def run_through(report: Path) -> str:
    """Share of lines and branches that the default tests run through, by package."""
    files = json.loads(report.read_text(encoding="utf-8"))["files"]
    rows = []
    for package in (*PACKAGES, "all"):
        found = [f["summary"] for name, f in files.items() if package in (Path(name).parts[0], "all")]
        cells = [package]
        for covered, every in (("covered_lines", "num_statements"), ("covered_branches", "num_branches")):
            some, whole = (sum(f[key] for f in found) for key in (covered, every))
            cells.append(f"{100.0 * some / whole:.1f} % of {whole}" if whole else "")
        rows.append(cells)
    return table(["package", "lines", "branches"], rows)


def counted(report: Path) -> str:
    """Numbers of a report's tests by result."""
    (suite,) = ElementTree.parse(report).iter("testsuite")
    return ", ".join(
        f"{suite.get(kind)} {said}"
        for kind, said in (
            ("tests", "tests"),
            ("failures", "failed"),
            ("errors", "errors"),
            ("skipped", "skipped"),
        )
        if kind == "tests" or suite.get(kind) != "0"
    )


def page(folder: Path, quick: bool) -> str:
    """The page, from the parts' reports that are there."""
    speeds = [report for name in BENCHMARKS if (report := folder / f"{name}.json").exists()]
    if not speeds:
        raise SystemExit("No part is finished yet: there is nothing to write.")
    machine = json.loads(speeds[0].read_text(encoding="utf-8"))["machine_info"]
    tests = [folder / "default.xml", *(folder / f"slow-{name}.xml" for name in STUDIES)]
    tests = [report for report in tests if report.exists()]
    lines = folder / "coverage.json"
    missing = [name for name, report, *_ in parts(folder) if not report.exists()]
    rows = [row for report in tests for row in recorded(report)]
    return "\n\n".join(
        [
            "# Benchmarks",
            *([f"Not measured yet: {', '.join(missing)}; the same command continues."] if missing else []),
            f"By `python docs/measure.py{' --quick' if quick else ''}` on "
            f"{machine['cpu'].get('brand_raw', machine['machine'])}, {os.cpu_count()} cores, {platform.system()}, "
            f"Python {machine['python_version']}. Ratios are of one run, each against the baseline that its benchmark "
            "names; times are medians. The load is the machine's, before and after. Above the number of cores other "
            "work ran beside: then times on the clock are too long; only ratios and processor times can be compared.",
            "## Speed",
            *(line for report in speeds for line in speed(report)),
            "## Accuracy and coverage",
            table(["file", "test", "what", "figure"], [row for row in rows if row[2] != "fault"]),
            "## Faults that a recording survives",
            table(["test that passed"], [[name] for _, name, what, _ in rows if what == "fault"]),
            "## Tests",
            table(["part", "tests", "took"], [[r.stem, counted(r), took(r)] for r in tests]),
            *(
                ["What the default tests run through, the contact kernels interpreted:", run_through(lines)]
                if lines.exists()
                else []
            ),
        ]
    )


def main() -> None:
    """Measure the parts that are not there yet, then write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tenth of the studies")
    parser.add_argument("benchmark", nargs="*", help="only these, as test_contact_speed; the rest of the page is kept")
    given = parser.parse_args()
    quick, wanted = given.quick, given.benchmark
    if unknown := sorted(set(wanted) - set(BENCHMARKS)):
        parser.error(f"{', '.join(unknown)}: there are {', '.join(BENCHMARKS)}")
    digest = hashlib.sha256(repr(quick).encode())
    for top in (*PACKAGES, "tests", "studies", "benchmarks"):
        for path in sorted(p for ending in ("py", "c", "h") for p in (ROOT / top).rglob(f"*.{ending}")):
            digest.update(path.read_bytes())
    folder = ROOT / "docs" / "generated" / f"measured-{digest.hexdigest()[:12]}"
    folder.mkdir(parents=True, exist_ok=True)
    environment = {**os.environ, **(QUICK if quick else {"CYCLOID_FULL": "1"})}
    interrupted = False
    try:
        for name, report, calls, further in parts(folder):
            if not wanted or name in wanted:
                measured(name, report, calls, {**environment, **further})
    except KeyboardInterrupt:
        print("Interrupted: the parts that ended are kept; the same command continues.", file=sys.stderr)
        interrupted = True
    if wanted:
        reports = {name: report for name in wanted if (report := folder / f"{name}.json").exists()}
        sections = {name: "\n\n".join(speed(report)) for name, report in reports.items()}
        text = replaced(RECORD.read_text(encoding="utf-8"), sections)
    else:
        text = page(folder, quick) + "\n"
    RECORD.write_text(text, encoding="utf-8")
    questions.PAGE.write_text(questions.page(RECORD.read_text(encoding="utf-8")), encoding="utf-8")
    raise SystemExit(130 if interrupted else 0)


if __name__ == "__main__":
    main()
