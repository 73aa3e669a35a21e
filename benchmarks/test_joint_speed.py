"""A step of MuJoCo with a drive in one hinge, beside one with attributes alone; processor time."""

import time

import joint_cases
import pytest

from cycloid_fmu.joint.joint_drive import JointDrive, MujocoJoints

pytestmark = pytest.mark.benchmark(timer=time.process_time)
CASE, STEP = joint_cases.read("printed-move"), 1e-3


@pytest.fixture(params=["attributes", "run-time"])
def swing(request):
    mujoco = pytest.importorskip("mujoco")
    alone = 'frictionloss="0.35" armature="0.01125" damping="0.0045"' if request.param == "attributes" else ""
    model = mujoco.MjModel.from_xml_string(joint_cases.pendulum(CASE["drive"], alone))
    model.opt.timestep = STEP
    data, ratio = mujoco.MjData(model), CASE["drive"]["ratio"]
    if request.param == "run-time":
        drive = JointDrive(joint_cases.document(CASE["drive"]), STEP, CASE["initial"]["motor_angle"])
        joints = MujocoJoints(model, data, {"arm": drive})

    def run():
        mujoco.mj_resetData(model, data)
        data.qpos[0] = CASE["initial"]["arm_angle"]
        if request.param == "run-time":
            drive.load([CASE["initial"]["motor_angle"], *[0.0] * 11])
        for command in CASE["commands"]:
            if request.param == "run-time":
                joints.step([command])
            else:
                torque, kp, kd, angle, speed = command
                motor = torque + kp * (angle - ratio * data.qpos[0]) + kd * (speed - ratio * data.qvel[0])
                data.qfrc_applied[0] = ratio * motor
                mujoco.mj_step(model, data)

    return run


def test_750_steps(benchmark, swing):
    benchmark(swing)
