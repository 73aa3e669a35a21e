"""How much of three parts the tests hold: `python studies/mutate.py metrics|recorder|contact [--sample 100]`.

Cosmic Ray changes one operator, number or condition at a time; the part's own tests run against each
change in a forked process, and a change that none of them detects survives. The sample is drawn with a fixed seed.
Results are kept in `.mutation/`: the same command continues after an interruption; a changed module or test starts
again.
At the end docs/mutants.md is written from the results of all parts; `survivors.toml` gives the reason why a survivor
may survive.
"""

import argparse
import ast
import contextlib
import difflib
import functools
import hashlib
import importlib.abc
import importlib.machinery
import json
import os
import random
import signal
import sys
import tempfile
import time
import tomllib
import types
from dataclasses import dataclass
from pathlib import Path

import grimp
import pytest
from numba.core import config

from cycloid_fmu import edge

ROOT = Path(__file__).parent.parent
KEPT = ROOT / ".mutation"
REASONS = Path(__file__).with_name("survivors.toml")
PAGE = ROOT / "docs" / "mutants.md"
SEED = 20
OURS = ("cycloid_fmu", "fitting", "drivers")


@dataclass(frozen=True)
class Target:
    """The modules of a part and its tests; `quick` are words for pytest that choose those to run first, interpreted,
    where compiling takes longer than they do: mutants that survive them get all tests, compiled."""

    modules: tuple[str, ...]
    tests: tuple[str, ...]
    quick: tuple[str, ...] = ()


TARGETS = {
    "metrics": Target(
        (
            "fitting/figures/figure.py",
            "fitting/figures/hysteresis.py",
            "fitting/figures/metrics.py",
            "fitting/transmission_error/spectrum.py",
            "fitting/figures/starts.py",
            "fitting/transmission_error/survey.py",
        ),
        ("tests/fitting/test_metrics.py", "tests/fitting/test_loop_drift.py", "tests/fitting/test_comparison.py"),
    ),
    "recorder": Target(
        ("drivers/recorder/session.py",),
        ("tests/drivers/test_recorder.py",),
    ),
    "contact": Target(
        tuple(
            f"cycloid_fmu/contact/{name}.py"
            for name in (
                "deviations",
                "energy",
                "equilibrium",
                "foot",
                "gap",
                "hertz",
                "load_sharing",
                "local_frame",
                "placement",
                "play",
                "problem",
                "rows",
                "sensitivity",
                "sweeps",
            )
        ),
        (
            "tests/cycloid_fmu/test_contact.py",
            "tests/cycloid_fmu/test_reference_cases.py",
            "tests/cycloid_fmu/test_element_pairs.py",
            "tests/cycloid_fmu/test_tooth_contact.py",
            "tests/cycloid_fmu/test_wear.py",
            "tests/cycloid_fmu/test_elements.py",
        ),
        (
            "-k",
            "five_are or larger_flank or two_elements "
            "or inverse or without_end or moment_arm or linear_check or equivalent_errors or two_discs_cancel "
            "or (sensitivities and not misaligned) or flanges or crank_does or the_play_ends or told_by or adds_up "
            "or form_of_all or brute_force_of_a_random or turns_the_other_way or loaded_contacts_are "
            "or (pairs_agree and rough) "
            "or (test_reference_case and not (wear_pair or ten_micro or ripple or of_the_paper or dataset))",
        ),
    ),
}
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


def dotted(module: str) -> str:
    """The name by which a file of ours is imported."""
    return module.removesuffix(".py").replace("/", ".")


class Served(importlib.abc.MetaPathFinder, importlib.abc.Loader):
    """Gives the changed text when the module is imported; the file is unchanged."""

    def __init__(self, module: str, text: str) -> None:
        self.name, self.path, self.text = dotted(module), ROOT / module, text

    def find_spec(self, name: str, path: object, target: object = None) -> importlib.machinery.ModuleSpec | None:
        if name != self.name:
            return None
        return importlib.machinery.ModuleSpec(name, self, origin=str(self.path))

    def exec_module(self, module: types.ModuleType) -> None:
        module.__file__ = str(self.path)
        exec(compile(self.text, str(self.path), "exec"), module.__dict__)


class Quickest:
    """Runs the quickest tests first, and reports the time of each."""

    def __init__(self) -> None:
        self.seconds = dict[str, float]()

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items.sort(key=lambda item: self.seconds.get(item.nodeid, 0.0))

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration


def tests_pass(words: tuple[str, ...], quickest: Quickest) -> bool:
    """Whether the tests that the words choose pass in this process."""
    return pytest.main(["-x", "-q", "-p", "no:cacheprovider", *words], plugins=[quickest]) == 0


@functools.cache  # its threads are not in a forked process, which must not wait for them
def stale(module: str) -> frozenset[str]:
    """Name the module and all of ours that import it."""
    return frozenset({module, *grimp.build_graph(*OURS, cache_dir=None).find_downstream_modules(module)})


def forget(module: str) -> None:
    """Take a module out of this process, with all of ours that import it and the tests; the rest stays loaded."""
    for name, loaded in list(sys.modules.items()):
        file = getattr(loaded, "__file__", None) or ""
        tests = file.startswith((str(ROOT / "tests"), str(ROOT / "studies"))) and name != "__main__"
        if tests or name in stale(module):
            del sys.modules[name]
            package, _, last = name.rpartition(".")
            if package in sys.modules and hasattr(sys.modules[package], last):
                delattr(sys.modules[package], last)


@dataclass
class Stage:
    """One choice of a target's tests; `longest` is the time that they may take with a change, s."""

    words: tuple[str, ...]
    interpreted: bool
    quickest: Quickest
    longest: int = 0


def outcome(module: str, text: str, stage: Stage) -> str:
    """Run the tests with this text of the module: "killed", "time" where they take longer than allowed, or ""."""
    with tempfile.TemporaryDirectory(prefix="cycloid-mutant-") as folder:
        child = os.fork()
        if child == 0:
            signal.signal(signal.SIGALRM, signal.SIG_DFL)
            signal.alarm(stage.longest)
            # Compiled code is cached by its module's file, which does not change.
            config.CACHE_DIR, config.DISABLE_JIT = folder, int(stage.interpreted)
            for stream in (1, 2):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream)
            code = 1
            with contextlib.suppress(BaseException):
                served = Served(module, text)
                forget(served.name)
                sys.meta_path.insert(0, served)
                code = int(not tests_pass(stage.words, stage.quickest))
            os._exit(code)
        status = os.waitpid(child, 0)[1]
    if os.WIFSIGNALED(status):
        return "time" if os.WTERMSIG(status) == signal.SIGALRM else "killed"
    return "killed" if os.WEXITSTATUS(status) else ""


def difference(text: str, changed: str) -> str:
    """The change, line by line; which line it is does not matter."""
    lines = difflib.unified_diff(text.splitlines(), changed.splitlines(), n=0, lineterm="")
    return "\n".join(line for line in lines if not line.startswith(("---", "+++", "@@")))


def run(name: str, sample: int) -> None:
    """Go on with a module's sample where it was."""
    from cosmic_ray.mutating import mutate_code
    from cosmic_ray.plugins import get_operator

    target = TARGETS[name]
    texts = {module: (ROOT / module).read_text(encoding="utf-8") for module in target.modules}
    files = [ROOT / words.partition("::")[0] for words in target.tests if words.startswith("tests/")]
    read = [*texts.values(), *target.tests, *(f.read_text(encoding="utf-8") for f in files)]
    digest = hashlib.sha256("".join(read).encode()).hexdigest()
    kept = KEPT / f"{name}.json"
    state = json.loads(kept.read_text(encoding="utf-8")) if kept.exists() else {}
    if state.get("digest") != digest:
        every = [[module, *one] for module, text in texts.items() for one in possible(text)]
        state = {"digest": digest, "possible": every, "outcome": {}, "survived": {}}

    stages = [Stage((*target.tests, *target.quick), bool(target.quick), Quickest())]
    if target.quick:
        stages.append(Stage(target.tests, False, Quickest()))
    for stage in stages:
        config.DISABLE_JIT, begin = int(stage.interpreted), time.perf_counter()
        passed = tests_pass(stage.words, stage.quickest)
        stage.longest = 20 + int(5.0 * (time.perf_counter() - begin))
        for module in texts:
            forget(dotted(module))
        if not passed or outcome(*next(iter(texts.items())), stage):
            raise SystemExit(f"{name}: its tests fail without any change.")
    # All are drawn, so that a larger sample continues a smaller one.
    for module, operator, occurrence in random.Random(SEED).sample(state["possible"], len(state["possible"]))[:sample]:
        key = f"{module} {operator} {occurrence}"
        if key not in state["outcome"]:
            changed = mutate_code(texts[module], get_operator(operator)(), occurrence)
            found = (outcome(module, changed, stage) for stage in stages)
            state["outcome"][key] = next(filter(None, found), "")
            if not state["outcome"][key]:
                state["survived"][key] = difference(texts[module], changed)
                print(state["survived"][key], flush=True)
            with edge.written_whole(kept) as temporary:
                temporary.write_text(json.dumps(state, indent=1, ensure_ascii=False), encoding="utf-8")


def page() -> str:
    """Return the page of the results of all parts."""
    reasons = tomllib.loads(REASONS.read_text(encoding="utf-8"))
    rows, survivors = ["| modules | possible changes | tried | detected | by timeout |", "| --- " * 5 + "|"], []
    for name, target in TARGETS.items():
        if not (KEPT / f"{name}.json").exists():
            continue
        state = json.loads((KEPT / f"{name}.json").read_text(encoding="utf-8"))
        tried, dead = len(state["outcome"]), len(state["outcome"]) - len(state["survived"])
        slow = list(state["outcome"].values()).count("time")
        share = f"{dead} ({100.0 * dead / tried:.0f} %)"
        modules = ", ".join(f"`{module}`" for module in target.modules)
        rows.append(f"| {modules} | {len(state['possible'])} | {tried} | {share} | {slow} |")
        known = {one["change"].strip("\n"): one["reason"] for one in reasons.get(name, [])}
        survivors.append(f"## {modules}")
        for change in state["survived"].values():
            survivors.append(f"```diff\n{change}\n```\n\n{known.get(change, 'No test detects it.')}")
    return "\n\n".join(
        [
            "# Mutation tests",
            "`python studies/mutate.py` changes one operator, number or condition of the code at a time and runs the "
            f"tests of that code. The sample of all possible changes is drawn with the seed {SEED}.",
            "\n".join(rows),
            "Undetected changes, each with the reason why it needs no test:",
            *survivors,
        ]
    )


def main() -> None:
    """Continue with the samples, then write the page."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("target", choices=TARGETS)
    parser.add_argument("--sample", type=int, default=100, help="how many changes are tried (default 100)")
    given = parser.parse_args()
    os.chdir(ROOT)
    os.environ["HYPOTHESIS_STORAGE_DIRECTORY"] = tempfile.mkdtemp(prefix="cycloid-mutants-")
    KEPT.mkdir(exist_ok=True)
    try:
        run(given.target, given.sample)
    except KeyboardInterrupt:
        print("Interrupted: what was tried is kept; the same command goes on.", file=sys.stderr)
        raise SystemExit(130) from None
    PAGE.write_text(page() + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
