"""Files of robot simulators: loaded by MuJoCo and Drake, elsewhere checked against the names that the others take."""

import ast
import csv
import json
import xml.etree.ElementTree as ElementTree

import joint_cases
import numpy as np
import pytest
from joint_cases import document, stated

from cycloid_fmu import edge
from cycloid_fmu.joint import files, joint_drive
from cycloid_fmu.joint.document import Joint

PRINTED = joint_cases.read("printed-move")["drive"]
REFLECTED = PRINTED["J"] * PRINTED["ratio"] ** 2


def joint_of(**others):
    made = document(PRINTED) | {"peak_torque": stated(40.0), "motor_speed_limit": stated(300.0)} | others
    rows = tuple({"play": share * 2.0 * PRINTED["gap"], "rotor_inertia": share * PRINTED["J"]} for share in (1.0, 1.1))
    return Joint(joint_drive.flat(made), rows)


@pytest.mark.parametrize("target", files.WRITERS)
def test_each_file_begins_with_what_it_lacks(target):
    text = files.text(joint_of(), target, 0.24)
    assert "Lacks play, stiffness" in text[:200]


@pytest.mark.parametrize("target", ["mjcf", "drake", "isaac", "bam"])
def test_a_file_that_needs_an_unknown_number_says_which(target):
    made = joint_of(rotor_inertia={"value": None, "reason": "not stated"})
    with pytest.raises(edge.InputError, match="rotor_inertia is unknown; this file needs it"):
        files.text(made, target)


def test_stiffness_is_that_from_half_to_full_rated_torque():
    """The document's wind-up is 330 N·m/rad from 4 N·m on, and half the rated torque is 10."""
    assert files.stiffness(joint_of().values) == pytest.approx(PRINTED["K"][1])


@pytest.fixture(scope="module")
def mujoco():
    return pytest.importorskip("mujoco")


def test_mujoco_has_the_rotor_s_inertia_at_the_arm_and_friction_of_both_sides(mujoco, tmp_path):
    joint = joint_of()
    files.write_file(joint, "mjcf", tmp_path / "arm.xml", 0.24)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    inertia = np.zeros((1, 1))
    mujoco.mj_solveM(model, data, inertia, np.eye(1))
    assert 1.0 / inertia[0, 0] == pytest.approx(0.24 + REFLECTED)
    assert model.dof_frictionloss[0] == pytest.approx(15.0 * 0.01 + 0.2)
    data.ctrl[0] = 100.0
    mujoco.mj_forward(model, data)
    assert data.qfrc_actuator[0] == pytest.approx(40.0)


def test_in_mujoco_dry_friction_holds_without_creep(mujoco, tmp_path):
    """Half of it for two seconds; with MuJoCo's own compliance the hinge creeps by a mrad/s."""
    files.write_file(joint_of(), "mjcf", tmp_path / "arm.xml", 0.24)
    text = (tmp_path / "arm.xml").read_text()
    rates = []
    for xml in (text, text.replace('solreffriction="0.002 1" solimpfriction="0.9999 0.9999 0.001"', "")):
        model = mujoco.MjModel.from_xml_string(xml)
        data = mujoco.MjData(model)
        data.ctrl[0] = 0.5 * 0.35 / 15.0
        mujoco.mj_step(model, data, 1000)
        before = data.qpos[0]
        mujoco.mj_step(model, data, 1000)
        rates.append(data.qpos[0] - before)
    assert abs(rates[0]) < 1e-6 < 3e-4 < rates[1]


def test_in_mujoco_the_tendon_has_play_and_stiffness(mujoco, tmp_path):
    """The arm at rest under a load is half the play and the wind-up from the motor's angle, on either side."""
    files.write_file(joint_of(), "mjcf", tmp_path / "arm.xml", 0.24)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm-play.xml"))
    assert model.opt.timestep < files.longest_step(joint_of().values, 0.24)
    for load in (3.0, -3.0):
        data = mujoco.MjData(model)
        data.qfrc_applied[:] = load, load  # on the arm: on both of its hinges
        data.ctrl[0] = -load / 15.0  # the motor holds against it
        mujoco.mj_step(model, data, 5000)
        assert data.joint("play").qpos[0] == pytest.approx(
            np.sign(load) * (PRINTED["gap"] + 3.0 / 330.0), abs=0.2 / 330.0
        )


def test_a_row_of_the_draws_is_put_into_the_model(mujoco, tmp_path, monkeypatch):
    joint = joint_of()
    joint.write(tmp_path / "joint.json")
    files.write_file(joint, "mjcf", tmp_path / "arm.xml", 0.24)
    monkeypatch.chdir(tmp_path)
    scope = {"__name__": "arm_rows"}
    exec(compile((tmp_path / "arm_rows.py").read_text(encoding="utf-8"), "arm_rows.py", "exec"), scope)
    model = mujoco.MjModel.from_xml_path("arm-play.xml")
    data = mujoco.MjData(model)
    scope["set_row"](model, data, scope["rows"]()[1])
    assert model.tendon_lengthspring[model.tendon("spring").id] == pytest.approx(
        [-1.1 * PRINTED["gap"], 1.1 * PRINTED["gap"]]
    )
    mujoco.mj_forward(model, data)
    solved = np.zeros((1, 2))
    mujoco.mj_solveM(model, data, solved, np.array([[1.0, 1.0]]))
    # Pushed at the arm, both hinges move as the free rotor and arm do: M = ((a + r, a), (a, a)).
    arm, rotor = 0.24, 1.1 * REFLECTED
    assert solved[0] == pytest.approx(np.linalg.solve([[arm + rotor, arm], [arm, arm]], [1.0, 1.0]))


@pytest.mark.drake
def test_drake_has_the_rotor_s_inertia(tmp_path):
    drake = pytest.importorskip("pydrake.all")
    files.write_file(joint_of(), "drake", tmp_path / "arm.urdf", 0.24)
    plant = drake.MultibodyPlant(1e-3)
    drake.Parser(plant).AddModels(str(tmp_path / "arm.urdf"))
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName("base"))
    plant.Finalize()
    assert plant.CalcMassMatrix(plant.CreateDefaultContext())[0, 0] == pytest.approx(0.24 + REFLECTED)
    assert plant.GetJointByName("arm").default_damping() == pytest.approx(15.0**2 * 2e-5)
    assert plant.get_joint_actuator(drake.JointActuatorIndex(0)).default_gear_ratio() == 15.0


def test_the_urdf_has_a_signed_transmission_of_ros2_control():
    joint = joint_of(ratio=stated(-15.0))
    root = ElementTree.fromstring(files.text(joint, "urdf", 0.24).partition("?>")[2])
    transmission = root.find("ros2_control/transmission")
    assert transmission.findtext("plugin") == "transmission_interface/SimpleTransmission"
    assert transmission.find("joint").attrib == {"name": "arm", "role": "joint1"}
    assert float(transmission.findtext("joint/mechanical_reduction")) == -15.0
    assert root.find("joint/limit").attrib == {"effort": "40", "velocity": "20"}
    assert float(root.find("joint/dynamics").get("friction")) == pytest.approx(0.35)


# Of `isaaclab/actuators/actuator_base_cfg.py` and of `Articulation` in Isaac Lab 3.
ISAAC = {
    "joint_names_expr",
    "stiffness",
    "damping",
    "armature",
    "friction",
    "dynamic_friction",
    "viscous_friction",
    "actuator_effort_limit",
    "actuator_velocity_limit",
}
WRITTEN = {
    "write_joint_armature_to_sim_index": {"armature"},
    "write_joint_friction_coefficient_to_sim_index": {
        "joint_friction_coeff",
        "joint_dynamic_friction_coeff",
        "joint_viscous_friction_coeff",
    },
}


def test_the_file_of_isaac_lab_has_its_names():
    tree = ast.parse(files.text(joint_of(), "isaac", 0.24))
    values = next(
        node.value for node in tree.body if isinstance(node, ast.Assign) and node.targets[0].id == "PROPERTIES"
    )
    properties = {word.arg: ast.literal_eval(word.value) for word in values.keywords}
    assert set(properties) <= ISAAC
    assert properties["armature"] == pytest.approx(REFLECTED)
    assert properties["friction"] == pytest.approx(15.0 * (0.01 + 0.005) + 0.2)
    assert properties["dynamic_friction"] == pytest.approx(15.0 * 0.01 + 0.2)
    assert properties["actuator_velocity_limit"] == pytest.approx(300.0 / 15.0)
    calls = {
        node.func.attr: {word.arg for word in node.keywords if word.arg}
        for node in ast.walk(tree)
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute) and node.func.attr in WRITTEN
    }
    assert calls == WRITTEN
    rows = next(
        ast.literal_eval(node.value)
        for node in tree.body
        if isinstance(node, ast.Assign) and node.targets[0].id == "ROWS"
    )
    assert [row[0] for row in rows] == pytest.approx([REFLECTED, 1.1 * REFLECTED])


# Of BAM's bundled files of model m5; kt and R are the motor's.
BAM = {
    "armature",
    "friction_base",
    "friction_stribeck",
    "load_friction_motor",
    "load_friction_external",
    "load_friction_motor_stribeck",
    "load_friction_external_stribeck",
    "dtheta_stribeck",
    "alpha",
    "friction_viscous",
    "model",
    "actuator",
}


@pytest.mark.parametrize(("driving", "back"), [(0.8, 0.72), (0.75, 0.8)])
def test_bam_s_friction_is_that_of_the_drive_under_load(driving, back):
    """Its law, |ke external - km motor| added to the base, driving and back-driven far above Coulomb friction."""
    made = document(PRINTED)
    made["friction"]["motor"] |= {"efficiency_driving": stated(driving), "efficiency_back_driving": stated(back)}
    content = json.loads(files.text(Joint(joint_drive.flat(made)), "bam", 0.24))
    assert set(content) - {"comment"} == BAM
    load, share = 1e4, 0.02
    lifting = load / ((1.0 - share) * driving)
    holding = load / (1.0 + share) * back
    for torque, lost in ((lifting, lifting - load), (holding, load - holding)):
        external, motor = content["load_friction_external"] * load, content["load_friction_motor"] * torque
        budget = abs(-external - motor)
        assert budget == pytest.approx(lost, rel=0.06 if content["load_friction_motor"] == 0.0 else 0.01)
    assert content["friction_base"] == pytest.approx(0.35)
    assert content["dtheta_stribeck"] == pytest.approx(2.0 / 15.0)


def test_bam_s_model_refuses_losses_that_it_can_t_have():
    made = document(PRINTED)
    made["friction"]["motor"] |= {"efficiency_driving": stated(0.4), "efficiency_back_driving": stated(0.9)}
    with pytest.raises(edge.InputError, match="its share of the external torque would be below 0"):
        files.text(Joint(joint_drive.flat(made)), "bam")


def test_a_row_that_is_not_there_is_refused():
    with pytest.raises(edge.InputError, match="row = 2: the joint has 2 draws"):
        files.text(joint_of(), "mjcf", 0.24, row=2)


def test_draws_are_read_by_any_reader_of_csv(tmp_path):
    joint_of().write(tmp_path / "joint.json")
    with open(tmp_path / "draws.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert [float(row["play"]) for row in rows] == pytest.approx([2.0 * PRINTED["gap"], 2.2 * PRINTED["gap"]])
