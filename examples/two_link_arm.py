"""A two-link arm with its drives in MuJoCo
===========================================

A shoulder with an identified drive and an elbow with one that is only drawn, each beside MuJoCo by the joint's
run-time. A controller moves both along a path. What play, friction and transmission error do to the tip is seen without
each of them; a last run has the drives as MuJoCo's own attributes, armature and dry friction.

It needs MuJoCo: `pip install mujoco`.
"""

import copy
import math
from pathlib import Path

import mujoco
import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import cycloid_fmu as cy
from cycloid_fmu.joint.document import Joint
from cycloid_fmu.joint.files import attributes
from cycloid_fmu.joint.joint_drive import JointDrive, MujocoJoints

HERE, OUT = Path(__file__).parent, Path("two_link_arm_out")
Array = NDArray[np.float64]
STEP, END = 1e-3, 1.2  # s
LINKS, BAND = (0.4, 0.35), (12.0, 15.0)  # m; Hz of the motors' controllers
ARM = """<mujoco><option timestep="0.001" integrator="implicitfast"/><compiler angle="radian"/><worldbody><body>
<joint name="shoulder" type="hinge" axis="0 1 0"/><inertial pos="0 0 -0.2" mass="6" diaginertia="0.08 0.08 0.01"/>
<body pos="0 0 -0.4"><joint name="elbow" type="hinge" axis="0 1 0"/>
<inertial pos="0 0 -0.2" mass="3" diaginertia="0.04 0.04 0.004"/></body></body></worldbody></mujoco>"""
FRICTION = {
    "friction.motor": {"coulomb": "0.02 N*m", "stribeck": "0.01 N*m", "stribeck_speed": "2 rad/s"},
    "friction.output": {"coulomb": "1.5 N*m", "load_share": 0.02, "presliding_angle": "20 urad"},
}
MOTOR = {"presliding_angle": "2 mrad", "efficiency_driving": 0.9, "efficiency_back_driving": 0.88}


def drives() -> dict[str, Joint]:
    """The joints of both drives: friction and rotors as stated, what the teeth do as identified and as drawn."""
    stated = {"friction": {"motor": FRICTION["friction.motor"] | MOTOR, "output": FRICTION["friction.output"]}}
    made = cy.read_drive(HERE / "drive-39-40-as-made.toml")
    # As `cycloid-fit identify` writes it: the drive that was found, and how sure its errors are.
    known = made.surface.replace(
        covariance=np.diag([0.3e-6, 0.5e-6]) ** 2, covariance_of=("pin_radius", "eccentricity")
    )
    shoulder = cy.Drive(made.pair, known).joint(stated=stated | {"rotor_inertia": "1e-4 kg*m^2"}, draws=20)
    pair = cy.Pair(
        gear_teeth=29,
        pin_circle_radius="45 mm",
        pin_radius="2.5 mm",
        eccentricity="1.1 mm",
        face_width="8 mm",
        rated_torque="60 N*m",
        modification={"offset": "-30 um"},
        errors={"pin_radial": {1: ("10 um", "20 deg")}},
    )
    elbow = cy.Drive(pair).joint(stated=stated | {"rotor_inertia": "3e-5 kg*m^2"})
    return {"shoulder": shoulder, "elbow": elbow}


def without(joint: Joint, what: str) -> dict:
    """The document of a joint without play, friction or transmission error."""
    document = copy.deepcopy(joint.document)
    if what == "play":
        document["play"]["value"], document["play_orders"] = 0.0, []
        document["play"]["interval"] = None
    elif what == "transmission error":
        document["te_orders"] = []
    elif what == "friction":
        for side in ("motor", "output"):
            for name, number in document["friction"][side].items():
                if number["value"] is not None and not name.endswith(("_speed", "_angle")):
                    number["value"] = 1.0 if name.startswith("efficiency") else 0.0
    return document


def path(at: float) -> tuple[Array, Array]:
    """Desired angles and speeds of both joints: out, and back with a pause."""
    way = np.array([0.9, 1.3])
    turn = 2.0 * math.pi / END
    return way * 0.5 * (1.0 - math.cos(turn * at)), way * 0.5 * turn * math.sin(turn * at)


def tip(angles: Array) -> Array:
    """Position of the tip, m, of angles of shape (samples, 2)."""
    first, both = angles[:, 0], angles.sum(axis=1)
    return np.stack(
        [-LINKS[0] * np.sin(first) - LINKS[1] * np.sin(both), -LINKS[0] * np.cos(first) - LINKS[1] * np.cos(both)]
    )


class Controllers:
    """Position controllers of the motors, for the arm's inertia; they know the motors' angles alone, and the weight."""

    def __init__(self, joints: dict[str, Joint]) -> None:
        self.ratios = [joint.values["ratio"] for joint in joints.values()]
        inertias = [
            arm + joint.values["rotor_inertia"] * joint.values["ratio"] ** 2
            for arm, joint in zip((1.2, 0.16), joints.values(), strict=True)
        ]
        self.gains = [
            (inertia * (2.0 * math.pi * band / ratio) ** 2, 2.0 * inertia * 2.0 * math.pi * band / ratio**2)
            for inertia, band, ratio in zip(inertias, BAND, self.ratios, strict=True)
        ]

    def commands(self, at: float, weight: Array) -> list[tuple[float, ...]]:
        """Commands of the motors; `weight` is what the arm needs at the desired angles, N·m."""
        angles, speeds = path(at)
        each = zip(self.ratios, self.gains, angles, speeds, weight, strict=True)
        return [(load / ratio, *gains, ratio * angle, ratio * speed) for ratio, gains, angle, speed, load in each]


def weights(times: Array) -> Array:
    """Torque that the arm's weight and motion need along the path, N·m, shape (times, 2)."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    found = []
    for at in times:
        data.qpos[:], data.qvel[:] = path(at)
        data.qacc[:] = (path(at + STEP)[1] - path(at - STEP)[1]) / (2.0 * STEP)
        mujoco.mj_inverse(model, data)
        found.append(data.qfrc_inverse.copy())
    return np.array(found)


def moved(joints: dict[str, Joint], documents: list[dict] | None) -> Array:
    """Angles along the path, of shape (samples, 2); without documents the drives are attributes of the hinges."""
    model = mujoco.MjModel.from_xml_string(ARM)
    data = mujoco.MjData(model)
    times = np.arange(0.0, END, STEP)
    needed, controllers, found = weights(times), Controllers(joints), []
    if documents is not None:
        start = [JointDrive(document, STEP, 0.0) for document in documents]
        beside = MujocoJoints(model, data, dict(zip(joints, start, strict=True)))
    else:
        for k, joint in enumerate(joints.values()):
            of = attributes(joint.values)
            model.dof_armature[k], model.dof_frictionloss[k], model.dof_damping[k] = (
                of.armature,
                of.friction,
                of.viscous,
            )
    for at, weight in zip(times, needed, strict=True):
        commands = controllers.commands(at, weight)
        if documents is not None:
            beside.step(commands)
        else:
            for k, (torque, kp, kd, angle, speed) in enumerate(commands):
                ratio = controllers.ratios[k]
                motor = torque + kp * (angle - ratio * data.qpos[k]) + kd * (speed - ratio * data.qvel[k])
                data.qfrc_applied[k] = ratio * motor
            mujoco.mj_step(model, data)
        found.append(data.qpos.copy())
    return np.array(found)


def main() -> None:
    """Run all variants, print the tip's error and draw it."""
    joints = drives()
    for name, joint in joints.items():
        play, origin = joint.numbers["play"], joint.numbers["play"]["origin"]
        between = (
            "" if play["interval"] is None else " ({:.1f} to {:.1f})".format(*np.array(play["interval"]) * cy.ARCSEC)
        )
        print(f"{name}: {joint.values['ratio']:g}, play {play['value'] * cy.ARCSEC:.1f}″{between}, {origin}")
    times = np.arange(0.0, END, STEP) + STEP
    wanted = tip(np.array([path(at)[0] for at in times]))
    runs = {"as it is": moved(joints, [joint.document for joint in joints.values()])}
    for what in ("play", "friction", "transmission error"):
        runs[f"without {what}"] = moved(joints, [without(joint, what) for joint in joints.values()])
    runs["MuJoCo's attributes alone"] = moved(joints, None)
    figure = Figure(figsize=(8.0, 4.0), layout="constrained")
    axes = figure.add_subplot(
        xlabel="time, s", ylabel="tip from its path, mm", title="Two-link arm with cycloid drives"
    )
    for name, angles in runs.items():
        off = 1e3 * np.linalg.norm(tip(angles) - wanted, axis=0)
        apart = 1e3 * np.linalg.norm(tip(angles) - tip(runs["as it is"]), axis=0)
        print(
            f"{name}: {np.sqrt(np.mean(off**2)):.3f} mm rms from the path, {apart.max():.3f} mm from the arm as it is"
        )
        axes.plot(times, off, label=name, linewidth=1.0)
    axes.legend(fontsize="small")
    OUT.mkdir(exist_ok=True)
    figure.savefig(OUT / "two_link_arm.png", dpi=150)


if __name__ == "__main__":
    main()
