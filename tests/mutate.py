"""How much of three modules the tests hold: `python tests/mutate.py metrics|recorder|contact [--sample 200]`.

Cosmic Ray changes one operator, number or condition at a time in a copy of the repository and runs the module's own
tests; a change that no test notices survives. The sample is drawn by a fixed seed. What was done is kept in
`.mutation/`: the same command goes on after an interruption, and a changed module begins anew.
"""

import argparse
import ast
import hashlib
import json
import os
import random
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

ROOT = Path(__file__).parent.parent
KEPT = ROOT / ".mutation"
SEED = 20


@dataclass(frozen=True)
class Target:
    """A module, the tests that hold it, and what they need; `seconds` is when a mutant counts as one that hangs."""

    module: str
    tests: str
    seconds: float
    environment: dict[str, str] = field(default_factory=dict)


TARGETS = {
    "metrics": Target("fitting/metrics.py", "tests/fitting/test_metrics.py", 300.0),
    "recorder": Target(
        "drivers/recorder.py",
        "tests/drivers/test_recording_format.py tests/drivers/test_faults.py tests/drivers/test_bench_cli.py",
        400.0,
    ),
    # Interpreted, for compiling takes longer than the tests.
    "contact": Target(
        "cycloid_fmu/contact.py",
        "tests/cycloid_fmu/test_contact.py tests/cycloid_fmu/test_reference_cases.py::test_reference_case",
        600.0,
        {"NUMBA_DISABLE_JIT": "1"},
    ),
}


def annotations(text: str) -> set[tuple[int, int]]:
    """Places (line, column) inside annotations, which mean nothing when the code runs."""
    found: set[tuple[int, int]] = set()
    for node in ast.walk(ast.parse(text)):
        for part in (getattr(node, "annotation", None), getattr(node, "returns", None)):
            if part is not None:
                found |= {(n.lineno, n.col_offset) for n in ast.walk(part) if hasattr(n, "lineno")}
                found |= {(n.end_lineno, n.end_col_offset) for n in ast.walk(part) if hasattr(n, "lineno")}
    return found


def begun(target: Target, folder: Path, sample: int) -> None:
    """Copy the repository and write the session with a sample of all changes."""
    from cosmic_ray.work_db import WorkDB, use_db

    shutil.rmtree(folder, ignore_errors=True)
    listed = subprocess.run(
        ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
        cwd=ROOT,
        capture_output=True,
        check=True,
    )
    for name in filter(None, listed.stdout.decode().split("\0")):
        if (ROOT / name).is_file():
            (folder / "tree" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy2(ROOT / name, folder / "tree" / name)
    (folder / "tree" / "mutation.toml").write_text(
        f"""[cosmic-ray]
module-path = "{target.module}"
timeout = {target.seconds}
excluded-modules = []
test-command = "{sys.executable} -m pytest -x -q -p no:cacheprovider {target.tests}"
[cosmic-ray.distributor]
name = "local"
""",
        encoding="utf-8",
    )
    ray(target, folder, "init", "mutation.toml", "session.sqlite")
    untold = annotations((ROOT / target.module).read_text(encoding="utf-8"))
    with use_db(str(folder / "tree" / "session.sqlite"), WorkDB.Mode.open) as session:
        items = [i for i in session.work_items if untold.isdisjoint((m.start_pos, m.end_pos)[k] for m in i.mutations
                                                                     for k in (0, 1))]  # fmt: skip
        items.sort(key=lambda i: repr(i.mutations))
        drawn = random.Random(SEED).sample(items, min(sample, len(items)))
        session.clear()
        session.add_work_items(drawn)
    (folder / "drawn.json").write_text(json.dumps({"of": len(items), "sample": len(drawn)}))


def ray(target: Target, folder: Path, *words: str) -> None:
    """Run Cosmic Ray in the copy; no byte code is kept, which a change within one second would not make stale."""
    settings = {"PYTHONPATH": str(folder / "tree"), "PYTHONDONTWRITEBYTECODE": "1", **target.environment}
    subprocess.run(
        [sys.executable, "-m", "cosmic_ray.cli", *words],
        cwd=folder / "tree",
        env={**os.environ, **settings},
        check=True,
    )


def report(name: str, folder: Path) -> dict[str, object]:
    """Count what was killed, and list what survived as differences."""
    from cosmic_ray.work_db import WorkDB, use_db

    with use_db(str(folder / "tree" / "session.sqlite"), WorkDB.Mode.open) as session:
        done = dict(session.results)
        survivors = [result.diff for result in done.values() if not result.is_killed]
    drawn = json.loads((folder / "drawn.json").read_text())
    found = {
        "module": TARGETS[name].module, **drawn, "done": len(done), "killed": len(done) - len(survivors),
        "survivors": survivors,
    }  # fmt: skip
    (KEPT / f"{name}.json").write_text(json.dumps(found, indent=1, ensure_ascii=False), encoding="utf-8")
    return found


def main() -> None:
    """Draw the sample unless that was done, go on with it, and say what survived."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--sample", type=int, default=200, help="how many changes are tried (default 200)")
    given = parser.parse_args()
    target = TARGETS[given.target]
    digest = hashlib.sha256(f"{given.sample}{(ROOT / target.module).read_text(encoding='utf-8')}".encode()).hexdigest()
    folder = KEPT / f"{given.target}-{digest[:12]}"
    if not (folder / "drawn.json").exists():
        begun(target, folder, given.sample)
    try:
        ray(target, folder, "exec", "mutation.toml", "session.sqlite")
    finally:
        found = report(given.target, folder)
        print(*found["survivors"], sep="\n")
        print(f"{found['module']}: {found['killed']} of {found['done']} killed ({found['of']} possible)")


if __name__ == "__main__":
    main()
