"""Common parts of the slaves, without the C library around: invalid input, and states saved and restored at random."""

import json
import math
import re
import shutil
import zipfile

import numpy as np
import pytest
from common import CASES, study_size

from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.fmu.build import build_fmu
from cycloid_fmu.fmu.core import NUMBERS, SUMS, Core, state_from_bytes, state_to_bytes, sums_of
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
    "rotor": Interface("compliant", crank_inertia=1e-2, **RUBS),
    "joint": Interface("compliant", 0.05, crank_inertia=1e-2, **RUBS),
}
STEPS = study_size("CYCLOID_STEPS", 1e4, 1e6)


@pytest.fixture(scope="module")
def resources(tmp_path_factory):
    made = {}

    def unpacked(kind):
        if kind not in made:
            folder = tmp_path_factory.mktemp(kind)
            build_fmu(DriveValue.as_stated(ERRORS), folder / "d.fmu", interface=KINDS[kind], fmi_version="3.0")
            with zipfile.ZipFile(folder / "d.fmu") as archive:
                archive.extractall(folder)
            made[kind] = folder / "resources"
        return made[kind]

    return unpacked


def started(folder):
    core = Core(folder, "3.0")
    core.begin()
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
    free = "output_inertia" not in v and "crank_inertia" not in v
    crank = 0.0
    for number in range(steps):
        # An inertia follows no jumps.
        if "arm_inertia" not in v:
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
            elif name == "arm_inertia" or name.startswith("motor_"):
                value = random.exponential(1.0)
            else:
                value = random.normal(0.0, 20.0 if name.endswith(".w") else 100.0)
            core.put(v[name], value)
        if random.random() < 0.02:
            name = random.choice([n for n in parameters if n in v])
            core.put(v[name], random.choice([0.0, 1e-6, -1.0, math.nan, 1.0]))
        step = random.choice([-1e-3, math.nan, 0.0, 5e-3]) if random.random() < 0.02 else 1e-3
        before = core.clockwork.state() if number % 10 == 0 else None
        said = core.step(number * 1e-3, step)
        if said:
            refused += 1
            assert before in (None, core.clockwork.state())
            for reference in [r for r in core.faults if core.table[r].causality == "parameter"]:
                core.put(reference, 0.0)
        else:
            made += 1
            values = [x for i in outputs for x in np.ravel(core.clockwork.value(i))]
            assert np.all(np.isfinite(values)), core.clockwork.state()
            if "arm_inertia" in v:
                crank = core.clockwork.value(v["flange_a.phi"])
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
    steps = STEPS // {"kinematic": 2, "compliant": 6, "inertia": 30, "rotor": 90, "joint": 90}[kind]
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
            elif "arm_inertia" in v:
                core.put(v["flange_b.phi"], core.clockwork.value(v["flange_a.phi"]) / ERRORS.ratio + load * 3e-6)
                core.put(v["arm_inertia"], 0.5)
            else:
                core.put(v["flange_b.phi"], crank / ERRORS.ratio + load * 3e-6)
            assert core.step(0.0, 1e-3) == ""
            read = outputs if random.random() < 0.5 else outputs[::2]
            found.append([x for i in read for x in np.ravel(core.clockwork.value(i)).tolist()])
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


def copied(folder, tmp_path, **changes):
    """Resources with another pair.json and matching checksums."""
    target = shutil.copytree(folder, tmp_path / "resources")
    numbers = {**json.loads((target / NUMBERS).read_text()), **changes}
    (target / NUMBERS).write_text(json.dumps(numbers))
    names = [line.split("  ")[1] for line in (target / SUMS).read_text().splitlines()]
    (target / SUMS).write_bytes(sums_of({name: (target / name).read_bytes() for name in names}))
    return target


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"format": 1}, "built with cycloid-fmu 0.0.1 in format 1, this reads format"),
        ({"variables": "0123"}, "built with cycloid-fmu 0.0.1, whose variables are others: installed is"),
    ],
)
def test_an_fmu_of_another_format_is_refused_with_a_sentence(resources, tmp_path, changes, said):
    with pytest.raises(RuntimeError, match=said):
        Core(copied(resources("kinematic"), tmp_path, package_version="0.0.1", **changes), "3.0")


def test_an_fmu_runs_with_any_package_of_its_format(resources, tmp_path):
    core, v = started(copied(resources("kinematic"), tmp_path, package_version="9.9.9"))
    core.put(v["flange_b.tau"], 50.0)
    assert core.step(0.0, 1e-3) == ""


@pytest.mark.parametrize("name", ["pair.json", "surface.npz", "surface.nc", "cycloid_drive3.py", "SHA256SUMS"])
def test_one_flipped_bit_in_the_resources_is_refused_with_the_file_s_name(resources, tmp_path, name):
    folder = shutil.copytree(resources("kinematic"), tmp_path / "resources")
    whole = (folder / name).read_bytes()
    for place in np.random.default_rng(3).integers(len(whole), size=8):
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(place % 8)
        (folder / name).write_bytes(damaged)
        with pytest.raises(RuntimeError, match=re.escape(str(folder))):
            Core(folder, "3.0")
    (folder / name).write_bytes(whole)
    Core(folder, "3.0")


def test_each_call_has_its_phase(resources):
    """Calls that FMI's state machine does not allow are refused with a sentence, and nothing changes."""
    core = Core(resources("inertia"), "3.0")
    v = {variable.name: i for i, variable in core.table.items()}
    assert core.step(0.0, 1e-3) == "a step is allowed while stepping only, not before initialization"
    for wrong, said in ((core.start, "to end initialization"), (core.end, "to terminate")):
        with pytest.raises(ValueError, match=f"{said} is allowed .* only, not before initialization"):
            wrong()
    with pytest.raises(ValueError, match="the start time is nan s: it must be finite"):
        core.begin(math.nan)
    core.put(v["output_inertia"], 0.07)
    core.begin(2.0)
    with pytest.raises(ValueError, match="to begin initialization is allowed before initialization only, not during"):
        core.begin()
    core.start()
    state = core.state()
    assert core.clockwork.time == 2.0
    with pytest.raises(ValueError, match="not while stepping"):
        core.start()
    for put in (core.put, lambda i, x: core.put_all([i], [x])):
        with pytest.raises(ValueError, match="output_inertia can't be set after initialization"):
            put(v["output_inertia"], 0.1)
    assert core.clockwork.value(v["output_inertia"]) == 0.07
    assert core.step(math.nan, 1e-3) == "a step from the time nan s over 0.001 s: both must be finite"
    assert core.state() == state
    core.end()
    assert core.step(2.0, 1e-3) == "a step is allowed while stepping only, not after termination"
    with pytest.raises(ValueError, match="to set a variable is allowed while stepping only, not after termination"):
        core.put_all([v["flange_b.tau"]], [1.0])
    core.restore(state)
    assert core.step(2.0, 1e-3) == ""
