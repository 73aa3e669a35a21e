"""The run-time of a cycloid joint: against its twin in Python, its references in MuJoCo and Drake, and bad input."""

import copy
import math
import shutil
import subprocess
import sys

import joint_cases
import numpy as np
import pytest
import scipy.linalg
from joint_cases import document, stated, unknown
from joint_twin import Twin

from cycloid_fmu.joint import joint_drive, runtime
from cycloid_fmu.joint.document import Joint
from cycloid_fmu.joint.joint_drive import DrakeJoints, JointDrive, JointError, MujocoJoints

STEPS = (1e-3, 2e-3)
PRINTED, STEEL = (joint_cases.read(f"{name}-move")["drive"] for name in ("printed", "steel"))
HELD = (0.1, 0.5, 0.02, 3.0, 0.0)


@pytest.fixture(scope="module")
def mujoco():
    return pytest.importorskip("mujoco")


@pytest.fixture(scope="module")
def drake():
    return pytest.importorskip("pydrake.all")


def hanging(mujoco, xml, h, **angles):
    model = mujoco.MjModel.from_xml_string(xml)
    model.opt.timestep = h
    data = mujoco.MjData(model)
    for name, angle in angles.items():
        data.joint(name).qpos = angle
    return model, data


def error(run, case):
    """Difference of the arm's angle from the reference, rad."""
    return run.arm - np.array(case["reference"]["arm"])


def crossings(case, arm, motor):
    """Number of changes of the loaded flank, and the sample of the first."""
    drive = case["drive"]
    ideal = motor / drive["ratio"]
    deviation = arm - ideal - sum(size * np.sin(order * ideal + phase) for order, size, phase in drive["te"])
    side = np.sign(deviation)[np.abs(deviation) > drive["gap"]]
    place = np.flatnonzero(np.abs(deviation) > drive["gap"])[1:][np.diff(side) != 0.0]
    return place.size, place[:1]


def sliding(case, arm, motor):
    """Friction at the arm in slow motion: half the difference of the motor's torque up and down, N·m."""
    command, dt = np.array(case["commands"]), case["control_period"]
    middle = np.arange(1, motor.size - 1)
    of = command[middle - 1].T
    speed = (motor[2:] - motor[:-2]) / (2.0 * dt)
    torque = of[0] + of[1] * (of[3] - motor[middle]) + of[2] * (of[4] - speed)
    way = np.where(np.abs(arm[middle]) < 0.4, np.diff(arm)[middle - 1], 0.0)
    return 0.5 * case["drive"]["ratio"] * (torque[way > 1e-5].mean() - torque[way < -1e-5].mean())


LARGEST = {"move": 0.1e-3, "slow": 0.1e-3, "rattle": 0.25e-3, "free": 0.45e-3, "hold": 1e-6}


def judge(run, case):
    """Assert what a run has to keep to."""
    scene = case["name"].split("-")[1]
    assert math.sqrt(np.mean(error(run, case) ** 2)) < LARGEST[scene]
    exact = [np.array(case["reference"][name]) for name in ("arm", "motor")]
    (count, first), (true_count, true_first) = crossings(case, run.arm, run.motor), crossings(case, *exact)
    assert count == true_count
    assert np.abs(first - true_first).max(initial=0) <= 1
    if scene == "slow":
        assert sliding(case, run.arm, run.motor) == pytest.approx(sliding(case, *exact), rel=5e-3)
    if scene == "hold":
        rest = run.arm[run.arm.size // 2 :]
        assert abs(rest[-1] - rest[0]) < 1e-5 * case["control_period"] * rest.size
    if "work" in case["reference"]["figures"]:
        assert run.work[-1] == pytest.approx(case["reference"]["figures"]["work"], rel=0.01)


@pytest.mark.parametrize("h", STEPS)
@pytest.mark.parametrize("name", joint_cases.NAMES)
def test_beside_mujoco_a_drive_moves_as_its_reference_at_a_microsecond(mujoco, name, h):
    case = joint_cases.read(name)
    model, data = hanging(mujoco, joint_cases.pendulum(case["drive"]), h, arm=case["initial"]["arm_angle"])
    drive = JointDrive(document(case["drive"]), h, case["initial"]["motor_angle"])
    joints = MujocoJoints(model, data, {"arm": drive})

    def advance(command):
        joints.step([command])
        return data.qpos[0]

    judge(joint_cases.run(case, h, advance, drive), case)


@pytest.mark.drake
@pytest.mark.parametrize("h", STEPS)
@pytest.mark.parametrize("name", ["printed-move", "steel-free", "light-rattle"])
def test_beside_drake_too(drake, name, h):
    case = joint_cases.read(name)
    length, mass, rest = joint_cases.body_of(case["drive"])
    builder = drake.DiagramBuilder()
    plant = builder.AddSystem(drake.MultibodyPlant(h))
    unit = drake.UnitInertia(rest / mass + length**2, rest / mass + length**2, rest / mass)
    body = plant.AddRigidBody("arm", drake.SpatialInertia(mass, [0.0, 0.0, -length], unit))
    plant.AddJoint(drake.RevoluteJoint("arm", plant.world_frame(), body.body_frame(), [0.0, 1.0, 0.0]))
    plant.Finalize()
    simulator = drake.Simulator(builder.Build())
    context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
    plant.SetPositions(context, [case["initial"]["arm_angle"]])
    motion = JointDrive(document(case["drive"]), h, case["initial"]["motor_angle"])
    joints = DrakeJoints(plant, simulator, {"arm": motion})

    def advance(command):
        joints.step([command])
        return plant.GetPositions(context)[0]

    judge(joint_cases.run(case, h, advance, motion), case)


@pytest.mark.parametrize("h", STEPS)
def test_two_drives_in_one_arm(mujoco, h):
    case = joint_cases.read("two-link-steel-printed")
    model, data = hanging(mujoco, case["mjcf"], h, s=case["start"][0], e=case["start"][1])
    mujoco.mj_forward(model, data)
    start, drives, motors = np.array(case["start"]), case["drives"], []
    for k, drive in enumerate(drives):
        bias, ratio = data.qfrc_bias[k], drive["ratio"]
        bent = np.sign(bias) * (drive["gap"] + abs(bias) / drive["K"][1])
        inertia = (0.9, 0.06)[k] + drive["J"] * ratio**2
        gains = inertia * (20.0, 25.0)[k] ** 2 / ratio**2, 1.8 * (20.0, 25.0)[k] * inertia / ratio**2
        motors.append((ratio * (start[k] + bent), *gains, ratio))
    run = [JointDrive(document(drive), h, motor[0]) for drive, motor in zip(drives, motors, strict=True)]
    joints = MujocoJoints(model, data, dict(zip("se", run, strict=True)))
    found = [data.qpos.copy()]
    for time in np.arange(500) * 2e-3:
        way, speed = 0.6 * (1.0 - math.cos(2.0 * math.pi * time)), 1.2 * math.pi * math.sin(2.0 * math.pi * time)
        commands = [(0.0, kp, kd, ratio * way + zero, ratio * speed) for zero, kp, kd, ratio in motors]
        for _ in range(round(2e-3 / h)):
            joints.step(commands)
        found.append(data.qpos.copy())
    off = np.array(found) - np.array(case["reference"]["joints"])
    assert np.sqrt(np.mean(off**2, axis=0)).max() < 0.1e-3


@pytest.mark.parametrize("h", STEPS)
def test_an_arm_that_meets_its_stop(mujoco, h):
    case = joint_cases.read("stop-steel")
    stop = 'limited="true" range="-1 0.3" solreflimit="0.02 1"'
    model, data = hanging(mujoco, joint_cases.pendulum(case["drive"], joint=stop), h)
    joints = MujocoJoints(model, data, {"arm": JointDrive(document(case["drive"]), h, 0.0)})
    found, torque = [0.0], 1.8 * case["drive"]["mgl"] / case["drive"]["ratio"]
    while len(found) < len(case["reference"]["arm"]):
        for _ in range(round(2e-3 / h)):
            joints.step([(torque, 0.0, 0.0, 0.0, 0.0)])
        found.append(data.qpos[0])
    assert np.abs(np.array(found) - case["reference"]["arm"]).max() < 4e-3
    assert max(found) > 0.33  # it goes into the stop


def test_a_force_on_the_arm_s_body_and_a_contact_are_carried_by_the_drive(mujoco):
    """At rest the teeth bear the arm's weight, a force at its end and the reaction of a contact."""
    xml = joint_cases.pendulum(STEEL).replace("</body>", '<geom type="sphere" size="0.05" pos="0 0 -0.5"/></body>')
    model, data = hanging(mujoco, xml, 1e-3)
    joints = MujocoJoints(model, data, {"arm": JointDrive(document(STEEL), 1e-3, 0.0)})
    data.xfrc_applied[1, 4] = 40.0  # N·m about the hinge
    for _ in range(2000):
        joints.step([(0.0, 50.0, 2.0, 0.0, 0.0)])
    # The output's friction, 2 N·m and 2 %, may bear a part of it.
    weight = data.qfrc_bias[0]
    assert data.qfrc_applied[0] == pytest.approx(weight - 40.0, abs=0.01)
    assert abs(data.qvel[0]) < 1e-6


def values_of(drive, **others):
    made = document(drive)
    made["play_orders"] = [{"order": stated(2.0), "amplitude": stated(drive["gap"] / 3.0), "phase": stated(0.7)}]
    return made | others, joint_drive.read(made | others)


@pytest.mark.parametrize(
    "drive", [PRINTED, STEEL, joint_cases.read("light-move")["drive"]], ids=lambda one: one["name"]
)
def test_library_and_twin_are_the_same_to_rounding(drive):
    """Over reversals, the play and sliding; both written from the theory's page."""
    made, values = values_of(drive)
    native, twin = JointDrive(made, 1e-3, 0.2), Twin(values, 1e-3, 0.2)
    arm, speed, inertia = 0.01, 0.0, drive["Jb"]
    largest = drive["rated"] / drive["ratio"]
    for k in range(300):
        command = (0.3 * largest * math.sin(0.05 * k), 0.1, 1e-3, 0.0, 0.0)
        of = inertia, drive["mgl"] * math.cos(0.02 * k), -drive["mgl"] * math.sin(0.02 * k)
        (torque, native_arm), (same, following) = (
            native.step(command, arm, speed, *of),
            twin.step(command, arm, speed, *of),
        )
        assert torque == pytest.approx(same, rel=1e-12, abs=1e-12 * drive["rated"])
        assert native_arm == pytest.approx(following, rel=1e-12, abs=1e-12)
        speed, arm = (following - arm) / 1e-3, following
    assert native.motor_angle == pytest.approx(twin.angle, rel=1e-12)
    assert native.motor_speed == pytest.approx(twin.speed, rel=1e-10)


def test_a_state_that_is_loaded_goes_on_as_the_first():
    made, _ = values_of(STEEL)
    one, other = (JointDrive(made, 1e-3, 0.0) for _ in range(2))
    for _ in range(20):
        one.step(HELD, 0.0, 0.1, 2.0, 30.0, 5.0)
    other.load(one.save())
    assert one.step(HELD, 0.0, 0.1, 2.0, 30.0) == other.step(HELD, 0.0, 0.1, 2.0, 30.0)
    assert len(one.save()) == 12


def test_without_play_and_friction_it_is_two_masses_on_a_spring():
    """Against the exponential of the system: the error falls with the square of the step."""
    made = document({**STEEL, "te": [], "gap": 0.0})
    for name in ("coulomb", "stribeck", "viscous"):
        made["friction"]["motor"][name] = made["friction"]["output"][name] = stated(0.0)
    made["friction"]["motor"] |= {"efficiency_driving": stated(1.0), "efficiency_back_driving": stated(1.0)}
    made["friction"]["output"]["load_share"] = made["mesh_damping"] = stated(0.0)
    stiff, ratio, rotor, arm = 5e4, STEEL["ratio"], STEEL["J"], STEEL["Jb"]
    points = ((0.0, 0.0), (100.0, 100.0 / stiff))
    made["stiffness"] = [{"torque": stated(torque), "windup": stated(windup)} for torque, windup in points]
    system = np.zeros((4, 4))
    system[0, 1] = system[2, 3] = 1.0
    system[1, [0, 2]] = -stiff / ratio**2 / rotor, stiff / ratio / rotor
    system[3, [0, 2]] = stiff / ratio / arm, -stiff / arm
    motor, _, angle, _ = scipy.linalg.expm(0.01 * system) @ np.array([0.0, 0.0, 1e-4, 0.0])
    off = []
    for steps in (50, 100, 200):
        h = 0.01 / steps
        drive, phi, w = JointDrive(made, h, 0.0), 1e-4, 0.0
        for _ in range(steps):
            torque, phi = drive.step((0.0,) * 5, phi, w, arm, 0.0)
            w += h * torque / arm
        off.append((drive.motor_angle / motor - 1.0, phi / angle - 1.0))
    assert np.abs(off[-1]).max() < 2e-3
    assert np.array(off[0]) / off[1] == pytest.approx(4.0, rel=0.1)
    assert np.array(off[1]) / off[2] == pytest.approx(4.0, rel=0.1)


@pytest.mark.parametrize("torque_at", ["motor", "output"])
def test_the_stated_torques_start_the_drive_and_turn_it_back(torque_at):
    """Starting and back-driving torque of the files' comments: just below it holds, just above it turns."""
    from cycloid_fmu.joint.files import attributes

    made = document({**PRINTED, "te": [], "gap": 0.0})  # in the play the motor would gather speed
    of, turned = attributes(joint_drive.read(made)), []
    for share in (0.97, 1.03):
        drive, phi, w, inertia = JointDrive(made, 1e-3, 0.0), 0.0, 0.0, PRINTED["Jb"]
        own = share * of.starting_torque if torque_at == "motor" else 0.0
        load = share * of.back_driving_torque if torque_at == "output" else 0.0
        for _ in range(4000):
            torque, following = drive.step((own, 0.0, 0.0, 0.0, 0.0), phi, w, inertia, load)
            w, phi = w + 1e-3 * (torque + load) / inertia, following
        turned.append(abs(phi if torque_at == "motor" else drive.motor_angle / PRINTED["ratio"]))
    assert turned[0] < 0.02 < 0.1 < turned[1]


WRONG = {
    "ratio": (("ratio",), 0.5, "ratio = 0.5: a reducer has at least 1 motor turn per output turn, signed."),
    "inertia": (("rotor_inertia",), -1e-4, "rotor_inertia = -0.0001: it must be above 0."),
    "not finite": (("rotor_inertia",), math.inf, "rotor_inertia = inf is no finite number."),
    "play": (("play",), -1e-3, "play = -0.001: it must not be below 0."),
    "windup": (
        ("stiffness", 2, "windup"),
        1e-9,
        "stiffness.2.windup = 1e-09: torque and windup increase strictly from 0, 0.",
    ),
    "efficiency": (
        ("friction", "motor", "efficiency_driving"),
        1.1,
        "friction.motor.efficiency_driving = 1.1: an efficiency lies above 0 and not above 1.",
    ),
    "self-locking": (
        ("friction", "motor", "efficiency_back_driving"),
        -0.1,
        "friction.motor.efficiency_back_driving = -0.1: such a drive is self-locking, which this model can't "
        "represent.",
    ),
}


@pytest.mark.parametrize("wrong", WRONG)
def test_a_number_out_of_range_is_named(wrong):
    place, value, message = WRONG[wrong]
    made = copy.deepcopy(document(STEEL))
    at = made
    for part in place:
        at = at[part]
    at["value"] = value
    with pytest.raises(JointError) as refused:
        JointDrive(made, 1e-3, 0.0)
    assert str(refused.value) == f"document: {message}"


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"play": {"interval": [0.0, 1.0]}}, "play is an interval without its value"),
        ({"play": {"value": None, "interval": [0.0, 1.0]}}, "play has an interval without its value."),
        ({"play": {"value": None}}, "play is unknown without a reason."),
        ({"play": 0.1}, "play is 0.1; a number is"),
        ({"play": {**stated(1e-3), "origin": "guessed"}}, "play has the origin 'guessed'"),
        ({"rotor_inertia": unknown()}, "rotor_inertia is unknown; the run-time needs it."),
        ({"stiffness": unknown()}, "stiffness is unknown; the run-time needs it."),
        ({"format": "cycloid-joint/9"}, "format is 'cycloid-joint/9', this version reads 'cycloid-joint/1'."),
    ],
)
def test_a_number_of_another_form_is_named(other, message):
    with pytest.raises(JointError) as refused:
        JointDrive(document(STEEL) | other, 1e-3, 0.0)
    assert message in str(refused.value)


@pytest.mark.parametrize("h", [0.0, -1e-3, 6e-3, math.nan])
def test_a_step_out_of_range_is_refused(h):
    with pytest.raises(JointError, match="h = "):
        JointDrive(document(STEEL), h, 0.0)


@pytest.mark.parametrize("place", range(5))
def test_a_step_with_what_is_no_number_changes_nothing(place):
    drive = JointDrive(document(STEEL), 1e-3, 0.0)
    drive.step(HELD, 0.0, 0.1, 2.0, 30.0)
    before = drive.save()
    command = [math.nan if k == place else value for k, value in enumerate(HELD)]
    with pytest.raises(JointError, match="a number is not finite"):
        drive.step(command, 0.0, 0.1, 2.0, 30.0)
    with pytest.raises(JointError, match="a number is not finite"):
        drive.step(HELD, math.nan, 0.1, 2.0, 30.0)
    assert drive.save() == before


def test_where_the_angle_is_not_written_a_step_too_long_for_the_stiffness_is_refused():
    drive = JointDrive(document(STEEL), 5e-3, 0.0, position_written=False)
    with pytest.raises(JointError, match="take a shorter step, or write the arm's angle after it"):
        drive.step(HELD, 0.0, 0.0, 0.5, 0.0)
    assert JointDrive(document(STEEL), 5e-3, 0.0).step(HELD, 0.0, 0.0, 0.5, 0.0)


def test_the_hinge_of_a_drive_is_its_own(mujoco):
    def refused(xml, message, drive=None, joint="arm"):
        model, data = hanging(mujoco, xml, 1e-3)
        with pytest.raises(JointError, match=message):
            MujocoJoints(model, data, {joint: drive or JointDrive(document(STEEL), 1e-3, 0.0)})

    plain = joint_cases.pendulum(STEEL)
    end = "</mujoco>"
    refused(plain, "'elbow' is not a hinge", joint="elbow")
    refused(plain.replace('type="hinge"', 'type="slide"'), "'arm' is not a hinge of the model")
    refused(plain, "has h = 0.002 s, the model 0.001 s", drive=JointDrive(document(STEEL), 2e-3, 0.0))
    refused(plain.replace("implicitfast", "RK4"), "must be Euler or implicitfast")
    refused(plain.replace('name="arm"', 'name="arm" armature="0.1"'), "has an armature")
    refused(plain.replace(end, f'<actuator><motor joint="arm"/></actuator>{end}'), "has an actuator")
    tendon = '<tendon><fixed name="t"><joint joint="arm" coef="1"/></fixed></tendon>'
    driven = f'{tendon}<actuator><motor tendon="t"/></actuator>'
    refused(plain.replace(end, driven + end), "has a tendon transmission")


def test_what_is_written_needs_nothing_of_the_package(tmp_path):
    """In another process, with the files alone; the library tells the source that it is made of."""
    numbers = joint_drive.flat(document(STEEL))
    runtime.write_runtime(Joint(numbers, ({"play": 3e-4}, {"play": 4e-4})), tmp_path / "arm")
    code = (
        "import sys; from joint_drive import JointDrive; drive = JointDrive('joint.json', 1e-3, 0.0, row=1)\n"
        "print(*drive.step((0.1, 0.5, 0.02, 3.0, 0.0), 0.0, 0.1, 2.0, 30.0))\n"
        "print(sorted({name.partition('.')[0] for name in sys.modules} & {'numpy', 'cycloid_fmu'}))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path / "arm", capture_output=True, text=True, env={"PYTHONPATH": ""}
    )
    assert done.returncode == 0, done.stderr
    made = document(STEEL) | {"play": stated(4e-4)}
    assert tuple(map(float, done.stdout.split("\n")[0].split())) == JointDrive(made, 1e-3, 0.0).step(
        HELD, 0.0, 0.1, 2.0, 30.0
    )
    assert done.stdout.split("\n")[1] == "[]"
    (tmp_path / "arm" / "joint_drive.c").write_text("/* another */")
    done = subprocess.run([sys.executable, "-c", code], cwd=tmp_path / "arm", capture_output=True, text=True)
    assert "is not made of the joint_drive.c beside it" in done.stderr


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_the_written_source_compiles_by_itself(tmp_path):
    (tmp_path / "joint_drive.c").write_bytes(runtime.source())
    words = runtime.source().decode().split("\n")[0].partition("Compile it: ")[2].removesuffix(" */").split()
    done = subprocess.run([*words, "-Wall", "-Wextra", "-Werror"], cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_rows_out_of_range_are_refused(tmp_path):
    numbers = joint_drive.flat(document(STEEL))
    Joint(numbers, ({"play": 3e-4}, {"play": 4e-4})).write(tmp_path / "joint.json")
    with pytest.raises(JointError, match=r"draws.csv: row 2: it has the rows 0 to 1\."):
        JointDrive(tmp_path / "joint.json", 1e-3, 0.0, row=2)
    with pytest.raises(JointError, match="it names no draws, so there is no row 0"):
        JointDrive(document(STEEL), 1e-3, 0.0, row=0)
