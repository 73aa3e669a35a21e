"""What the slaves share, without the C library around it: nonsense in, and states taken and restored at random."""

import json
import math
import os
import shutil
import zipfile

import numpy as np
import pytest
from common import CASES

from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.fmu.core import Core, state_from_bytes, state_to_bytes
from cycloid_fmu.fmu.friction_file import Friction
from cycloid_fmu.fmu.variables import Interface
from cycloid_fmu.geometry.pair import read_pair

ERRORS = read_pair(CASES / "errors-39-40.toml")
RUBS = {
    "input_friction": Friction(coulomb=0.02, stribeck=0.01, viscous=1e-4, temperature_coefficient=0.01),
    "output_friction": Friction(coulomb=1.0, load_share=0.02),
}
KINDS = {
    "kinematic": Interface(losses=((0.0, 0.9, 0.85, 0.1, 0.1),), **RUBS),
    "compliant": Interface("compliant"),
    "inertia": Interface("compliant", 0.05),
    "joint": Interface("compliant", 0.05, crank_inertia=1e-2, **RUBS),
}
STEPS = int(float(os.environ.get("CYCLOID_STEPS", "1e6")))


@pytest.fixture(scope="module")
def resources(tmp_path_factory):
    made = {}

    def unpacked(kind):
        if kind not in made:
            folder = tmp_path_factory.mktemp(kind)
            build_fmu(ERRORS, folder / "d.fmu", interface=KINDS[kind])
            with zipfile.ZipFile(folder / "d.fmu") as archive:
                archive.extractall(folder)
            made[kind] = folder / "resources"
        return made[kind]

    return unpacked


def started(folder):
    core = Core(folder, "3.0")
    core.start()
    return core, {v.name: i for i, v in core.table.items()}


def nonsense(core, v, steps, seed):
    """Random values and steps, sense and nonsense; how many steps were made and refused."""
    random = np.random.default_rng(seed)
    inputs = [n for n in v if core.table[v[n]].causality == "input"]
    outputs = [i for i, o in core.table.items() if o.causality == "output"]
    parameters = [
        "friction_torque",
        "input_friction.coulomb",
        "output_friction.load_share",
        "series_compliance",
        "centre_distance_x",
        "mesh_damping",
        "backlash_on",
    ]
    special = [math.nan, math.inf, -math.inf, 1e9, -1e9, 0.0, 1e300, -1e-300]
    made = refused = 0
    free = "output_inertia" not in v
    crank = 0.0
    for number in range(steps):
        # An inertia follows no jumps.
        crank = random.uniform(-1e3, 1e3) if free else crank + random.normal(0.0, 0.005)
        for name in inputs:
            if random.random() < 0.02:
                value = random.choice(special)
            elif name == "flange_a.phi":
                value = crank
            elif name == "flange_b.phi":
                value = crank / ERRORS.ratio + random.normal(0.0, 3e-4)
            elif name == "flange_a.tau":
                value = random.normal(0.0, 1.0)
            else:
                value = random.normal(0.0, 20.0 if name.endswith(".w") else 100.0)
            core.put(v[name], value)
        if random.random() < 0.02:
            name = random.choice([n for n in parameters if n in v])
            core.put(v[name], random.choice([0.0, 1e-6, -1.0, math.nan, 1.0]))
        step = random.choice([-1e-3, math.nan, 0.0, 5e-3]) if random.random() < 0.02 else 1e-3
        before = json.dumps(core.model.state()) if number % 10 == 0 else None
        said = core.step(number * 1e-3, step)
        if said:
            refused += 1
            assert before in (None, json.dumps(core.model.state()))
            for reference in [r for r in core.faults if core.table[r].causality == "parameter"]:
                core.put(reference, 0.0)
        else:
            made += 1
            values = [x for i in outputs for x in np.ravel(core.getters[i]())]
            assert np.all(np.isfinite(values)), core.model.state()
    return made, refused


@pytest.mark.parametrize("kind", KINDS)
def test_no_nonsense_gives_anything_but_numbers_or_a_refusal(resources, kind):
    core, v = started(resources(kind))
    made, refused = nonsense(core, v, 60 if "output_inertia" in v else 150, 3)
    assert min(made, refused) > 2


@pytest.mark.slow(20)
@pytest.mark.parametrize("kind", KINDS)
def test_a_million_steps_of_nonsense(resources, kind, record_property):
    core, v = started(resources(kind))
    steps = STEPS // {"kinematic": 2, "compliant": 6, "inertia": 30, "joint": 90}[kind]
    made, refused = nonsense(core, v, steps, 4)
    record_property(f"{kind}: random steps made and refused, none with a number that is none", f"{made} and {refused}")
    assert min(made, refused) > 0.01 * steps


@pytest.mark.parametrize("kind", KINDS)
def test_states_taken_and_restored_at_random_reproduce_bit_by_bit(resources, kind):
    """Every walk from a state is the same walk, in this instance and in a fresh one, whatever came between."""
    random = np.random.default_rng(11)
    one, v = started(resources(kind))
    other, _ = started(resources(kind))
    outputs = [i for i, o in one.table.items() if o.causality == "output"]
    place = 0.0

    def walk(core, moves):
        found = []
        for crank, speed, load in moves:
            if core.table[v["flange_a.phi"]].causality == "input":
                core.put(v["flange_a.phi"], crank)
                core.put(v["flange_a.w"], speed)
            else:
                core.put(v["flange_a.tau"], 0.2 * speed)
            if "flange_b.tau" in v and core.table[v["flange_b.tau"]].causality == "input":
                core.put(v["flange_b.tau"], load)
            else:
                core.put(v["flange_b.phi"], crank / ERRORS.ratio + load * 3e-6)
            assert core.step(0.0, 1e-3) == ""
            read = outputs if random.random() < 0.5 else outputs[::2]
            found.append([x for i in read for x in np.ravel(core.getters[i]()).tolist()])
        return found

    for _ in range(6):
        moves = []
        for _ in range(random.integers(1, 6)):
            place += random.normal(0.0, 0.05)
            moves.append((place, random.normal(0.0, 5.0), random.normal(0.0, 60.0)))
        one.put(v["friction_torque"], float(random.choice([0.0, 2.0])))
        blob = state_to_bytes(one.state())
        choices = random.bit_generator.state
        first = walk(one, moves)
        later = state_to_bytes(one.state())
        for core in (one, other):
            core.restore(state_from_bytes(blob))
            random.bit_generator.state = choices
            assert walk(core, moves) == first
            assert state_to_bytes(core.state()) == later


def test_an_fmu_of_an_earlier_format_is_refused_with_a_sentence(resources, tmp_path):
    """Its version may be the installed one's all the same."""
    shutil.copytree(resources("kinematic"), tmp_path / "resources")
    numbers = json.loads((tmp_path / "resources" / "pair.json").read_text())
    (tmp_path / "resources" / "pair.json").write_text(json.dumps({**numbers, "format": 1, "pair": {"pair": {}}}))
    with pytest.raises(RuntimeError, match="build it again"):
        Core(tmp_path / "resources", "2.0")
