"""How much of three modules the tests hold: `python tests/mutate.py metrics|recorder|contact [--sample 200]`.

Cosmic Ray's operators change one operator, number or condition at a time; the module's own tests run against each
change in a forked process, and a change that none of them notices survives. The sample is drawn by a fixed seed, and
results are kept in `.mutation/`: the same command goes on after an interruption, a changed module or test begins anew.
"""

import argparse
import ast
import contextlib
import difflib
import hashlib
import importlib
import importlib.abc
import importlib.machinery
import json
import os
import random
import signal
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
KEPT = ROOT / ".mutation"
SEED = 20
OURS = ("cycloid_fmu", "fitting", "drivers")


@dataclass(frozen=True)
class Target:
    """A module and the words for pytest that choose its tests; `interpreted` where compiling takes longer than them."""

    module: str
    tests: tuple[str, ...]
    interpreted: bool = False


TARGETS = {
    "metrics": Target("fitting/metrics.py", ("tests/fitting/test_metrics.py", "tests/fitting/test_comparison.py")),
    "recorder": Target(
        "drivers/recorder.py",
        ("tests/drivers/test_faults.py", "tests/drivers/test_canopen_encoder.py", "tests/drivers/test_can_more.py",
         "tests/drivers/test_docs_and_examples.py", "-k", "not kill_9 and not examples_run"),
    ),
    "contact": Target(
        "cycloid_fmu/contact.py",
        ("tests/cycloid_fmu/test_contact.py", "tests/cycloid_fmu/test_reference_cases.py", "-k",
         "test_reference_case or linear_check or equivalent or elastic or derivatives or hertz or play or discs"),
        interpreted=True,
    ),
}  # fmt: skip
Place = tuple[int, int]


def outside(text: str) -> list[tuple[Place, Place]]:
    """Ranges (from, to) of annotations and decorators, which mean nothing when the code runs or is interpreted."""
    found = []
    for node in ast.walk(ast.parse(text)):
        for part in (
            getattr(node, "annotation", None),
            getattr(node, "returns", None),
            *getattr(node, "decorator_list", ()),
        ):
            if part is not None:
                found.append(((part.lineno, part.col_offset), (part.end_lineno, part.end_col_offset)))
    return found


def possible(text: str) -> list[tuple[str, int]]:
    """(operator, occurrence) of every change that means something."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.plugins import get_operator, operator_names

    nodes, nothing, found = list(ast_nodes(get_ast(text))), outside(text), []
    for name in sorted(operator_names()):
        if not get_operator(name).arguments() and name != "core/RemoveDecorator":
            operator = get_operator(name)()
            places = (place for node in nodes for place in operator.mutation_positions(node))
            for occurrence, (start, _) in enumerate(places):
                if not any(first <= start < last for first, last in nothing):
                    found.append((name, occurrence))
    return found


class Served(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Gives the changed text when the module is imported; the file stays as it is."""

    def __init__(self, module: str, text: str) -> None:
        self.name, self.path, self.text = module.removesuffix(".py").replace("/", "."), ROOT / module, text

    def find_spec(self, name: str, path: object, target: object = None) -> importlib.machinery.ModuleSpec | None:
        if name != self.name:
            return None
        return importlib.machinery.ModuleSpec(name, self, origin=str(self.path))

    def exec_module(self, module: object) -> None:
        module.__file__ = str(self.path)
        exec(compile(self.text, str(self.path), "exec"), module.__dict__)


class Quickest:
    """Lets the quickest tests run first, and tells how long each took."""

    def __init__(self, seconds: dict[str, float]) -> None:
        self.known, self.seconds = seconds, dict[str, float]()

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items.sort(key=lambda item: self.known.get(item.nodeid, 0.0))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration


def passes(target: Target, text: str, seconds: dict[str, float], longest: int, took: Path | None = None) -> bool:
    """Whether the tests pass with this text of the module, and in less than `longest` seconds."""
    child = os.fork()
    if child == 0:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(longest)
        for stream in (1, 2):
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
        sys.meta_path.insert(0, Served(target.module, text))
        quickest = Quickest(seconds)
        code = 1
        with contextlib.suppress(BaseException):
            code = int(pytest.main(["-x", "-q", "-p", "no:cacheprovider", *target.tests], plugins=[quickest]))
        if took is not None:
            took.write_text(json.dumps(quickest.seconds))
        os._exit(code)
    return os.waitpid(child, 0)[1] == 0


def difference(text: str, changed: str) -> str:
    """What was changed, line by line."""
    lines = difflib.unified_diff(text.splitlines(), changed.splitlines(), n=0, lineterm="")
    return "\n".join(line for line in lines if not line.startswith(("---", "+++")))


def main() -> None:
    """Go on with the sample where it was, and say what survived."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--sample", type=int, default=200, help="how many changes are tried (default 200)")
    given = parser.parse_args()
    target = TARGETS[given.target]
    os.chdir(ROOT)
    os.environ["HYPOTHESIS_STORAGE_DIRECTORY"] = tempfile.mkdtemp(prefix="cycloid-mutants-")
    if target.interpreted:
        os.environ["NUMBA_DISABLE_JIT"] = "1"
    text = (ROOT / target.module).read_text(encoding="utf-8")
    files = [ROOT / words.partition("::")[0] for words in target.tests if words.startswith("tests/")]
    digest = hashlib.sha256("".join([text, *target.tests, *(f.read_text(encoding="utf-8") for f in files)]).encode())
    KEPT.mkdir(exist_ok=True)
    kept = KEPT / f"{given.target}-{digest.hexdigest()[:12]}.json"
    state = json.loads(kept.read_text()) if kept.exists() else {"seconds": {}, "possible": possible(text), "done": {}}

    # What others wrote is imported once; what is ours anew in each child, for one of it is changed.
    for module in ("numba", "scipy.signal", "scipy.optimize", "xarray", "hypothesis", "pyarrow", "can", "canopen"):
        importlib.import_module(module)
    if not state["seconds"]:
        with tempfile.TemporaryDirectory() as folder:
            begin = time.perf_counter()
            if not passes(target, text, {}, 3600, Path(folder, "took.json")):
                raise SystemExit(f"{target.module}: its tests fail without any change.")
            state["seconds"] = json.loads(Path(folder, "took.json").read_text())
            state["longest"] = 30 + int(5 * (time.perf_counter() - begin))
    drawn = random.Random(SEED).sample(state["possible"], min(given.sample, len(state["possible"])))
    try:
        for name, occurrence in drawn:
            key = f"{name} {occurrence}"
            if key not in state["done"]:
                changed = mutate_code(text, get_operator(name)(), occurrence)
                survived = passes(target, changed, state["seconds"], state["longest"])
                state["done"][key] = difference(text, changed) if survived else ""
                kept.write_text(json.dumps(state, indent=1, ensure_ascii=False), encoding="utf-8")
    except KeyboardInterrupt:
        pass
    done = [state["done"][f"{n} {o}"] for n, o in drawn if f"{n} {o}" in state["done"]]
    print(*filter(None, done), sep="\n")
    print(f"{target.module}: {done.count('')} of {len(done)} killed; {len(state['possible'])} changes are possible.")


if __name__ == "__main__":
    main()
