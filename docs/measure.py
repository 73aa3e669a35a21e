"""Measure anew what docs/measured.md states: `python docs/measure.py` (an hour on two cores; --quick: some minutes).

Speed comes from the benchmarks, accuracy, coverage and the fault table from what the tests themselves record. The page
says on which machine; nothing in it is typed in.
"""

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

ROOT = Path(__file__).parent.parent
PAGE = Path(__file__).parent / "measured.md"
QUICK = {"CYCLOID_SEEDS": "10", "CYCLOID_KILLS": "30", "CYCLOID_MUTATIONS": "1e5"}


def run(words: list[str], environment: dict[str, str]) -> None:
    """Run pytest; what fails is said by it and left out of the page."""
    subprocess.run([sys.executable, "-m", "pytest", "-q", *words], cwd=ROOT, env=environment, check=False)


def rows_of_benchmarks(report: Path) -> Iterator[list[str]]:
    """(file, benchmark, median, further figures) of each benchmark."""
    for one in json.loads(report.read_text(encoding="utf-8"))["benchmarks"]:
        median = one["stats"]["median"]
        unit, scale = next((u, s) for u, s in (("s", 1.0), ("ms", 1e-3), ("µs", 1e-6), ("ns", 1e-9)) if median >= s)
        further = "; ".join(f"{name}: {value}" for name, value in one["extra_info"].items())
        yield [Path(one["fullname"].split("::")[0]).stem, one["name"], f"{median / scale:.3g} {unit}", further]


def rows_of_tests(report: Path) -> Iterator[list[str]]:
    """(file, test, what, figure) that a passed test recorded; and each row of the fault table."""
    for case in ElementTree.parse(report).iter("testcase"):
        if any(case.find(bad) is not None for bad in ("failure", "error", "skipped")):
            continue
        module, name = case.get("classname", "").rsplit(".", 1)[-1], case.get("name", "")
        found = [(p.get("name", ""), p.get("value", "")) for p in case.iter("property")]
        if module == "test_faults":
            found.append(("fault", "held"))
        yield from ([module, name, what, figure] for what, figure in found)


def table(head: list[str], rows: list[list[str]]) -> str:
    """A Markdown table."""
    lines = [head, ["---"] * len(head), *rows]
    return "\n".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |" for line in lines)


def main() -> None:
    """Run benchmarks and tests, then write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a tenth of the studies")
    quick = parser.parse_args().quick
    environment = {**os.environ, **(QUICK if quick else {})}
    with tempfile.TemporaryDirectory() as folder:
        speed, facts = Path(folder, "speed.json"), Path(folder, "facts.xml")
        run(["benchmarks", f"--benchmark-json={speed}"], environment)
        run(["tests", "-m", "slow or not slow", f"--junitxml={facts}", "-o", "junit_family=xunit1"], environment)
        machine = json.loads(speed.read_text(encoding="utf-8"))["machine_info"]
        recorded = list(rows_of_tests(facts))
        faults = [[name] for _, name, what, _ in recorded if what == "fault"]
        figures = [row for row in recorded if row[2] != "fault"]
        cpu = machine["cpu"]
        text = "\n\n".join(
            [
                "# Measured figures",
                f"By `python docs/measure.py{' --quick' if quick else ''}` on "
                f"{cpu.get('brand_raw', machine['machine'])}, {os.cpu_count()} cores, {platform.system()}, Python "
                f"{machine['python_version']}. Ratios are of one run, each against the baseline that its benchmark "
                "names; times are medians.",
                "## Speed",
                table(["file", "benchmark", "median", "beside it"], list(rows_of_benchmarks(speed))),
                "## Accuracy and coverage",
                table(["file", "test", "what", "figure"], figures),
                "## Faults that a recording survives",
                table(["test that passed"], faults),
            ]
        )
    PAGE.write_text(text + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
