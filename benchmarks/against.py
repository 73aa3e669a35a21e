"""Compare with another commit: `python benchmarks/against.py COMMIT FILE…`, such as `main test_contact_speed.py`.

Both trees run the same benchmarks of this one in turn, on this machine; of each benchmark the least time of all rounds
counts, so that other work on the machine matters little.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parent.parent


def least(tree: Path, files: list[str], report: Path) -> dict[str, float]:
    """Return the least time of each benchmark, s, run with the packages of a tree."""
    # -P: without it Python looks in the current folder first.
    words = [sys.executable, "-P", "-m", "pytest", "-q", "-p", "no:cacheprovider", f"--benchmark-json={report}", *files]
    subprocess.run(words, cwd=ROOT, env={**os.environ, "PYTHONPATH": str(tree)}, stdout=sys.stderr, check=False)
    found = json.loads(report.read_text(encoding="utf-8"))["benchmarks"] if report.exists() else []
    report.unlink(missing_ok=True)
    return {one["name"]: one["stats"]["min"] for one in found}


def compared(commit: str, files: list[str], rounds: int) -> dict[str, tuple[float, float]]:
    """Return the least times with the other commit and with this tree, s, of each benchmark that both can run."""
    with tempfile.TemporaryDirectory() as folder:
        other, report = Path(folder, "tree"), Path(folder, "report.json")
        git = ["git", "-C", str(ROOT), "worktree"]
        subprocess.run([*git, "add", "--detach", "-q", str(other), commit], check=True)
        try:
            found: dict[Path, dict[str, float]] = {other: {}, ROOT: {}}
            for _ in range(rounds):
                for tree, times in found.items():
                    for name, time in least(tree, files, report).items():
                        times[name] = min(time, times.get(name, time))
        finally:
            subprocess.run([*git, "remove", "--force", str(other)], check=True)
    return {name: (found[other][name], found[ROOT][name]) for name in found[ROOT] if name in found[other]}


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("commit", help="the commit, branch or tag to compare with")
    parser.add_argument("files", nargs="+", help="benchmarks, as pytest takes them in the folder benchmarks")
    parser.add_argument("--rounds", type=int, default=3, help="how often each tree runs (3)")
    asked = parser.parse_args()
    rows = compared(asked.commit, [f"benchmarks/{name}" for name in asked.files], asked.rounds)
    print(f"{'benchmark':60} {asked.commit[:12]:>12} {'this tree':>12} {'ratio':>7}")
    for name, (before, now) in rows.items():
        print(f"{name:60} {before:10.3g} s {now:10.3g} s {now / before:7.2f}")
