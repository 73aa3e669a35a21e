"""Scenarios of a cycloid joint with their references, and what runs them: MuJoCo or Drake beside `JointDrive`."""

import dataclasses
import json

import numpy as np
from common import DATA

CASES = DATA / "joint-cases"
NAMES = sorted(path.stem for path in CASES.glob("*-*.json") if path.stem.split("-")[0] in ("printed", "steel", "light"))


def read(name):
    """A case by its name."""
    case = json.loads((CASES / f"{name}.json").read_text(encoding="utf-8"))
    if isinstance(case.get("commands"), dict):
        case["commands"] = [[0.0] * 5] * case["commands"]["zero"]
    return case


def stated(value):
    """A number of a joint document."""
    return {"value": value, "interval": None, "origin": "stated"}


def unknown(reason="not part of this case"):
    """An unknown number of a joint document."""
    return {"value": None, "reason": reason}


def document(drive):
    """The joint document of a case's drive."""
    laws = {}
    for side, of in (("motor", "a"), ("output", "b")):
        law = drive[of]
        names = {"C": "coulomb", "S": "stribeck", "ws": "stribeck_speed", "v": "viscous", "z": "presliding_angle"}
        laws[side] = {name: stated(law[short]) for short, name in names.items()}
    a, b = drive["a"], drive["b"]
    laws["motor"] |= {
        "efficiency_driving": stated(1.0 / (1.0 + a["s1"])),
        "efficiency_back_driving": stated(1.0 - a["s2"]),
    }
    assert b["s1"] == b["s2"]
    laws["output"]["load_share"] = stated(b["s1"])
    knee, (soft, stiff), rated = drive["T"][0], drive["K"], drive["rated"]
    points = ((0.0, 0.0), (knee, knee / soft), (rated, knee / soft + (rated - knee) / stiff))
    return {
        "format": "cycloid-joint/1",
        "ratio": stated(drive["ratio"]),
        "rotor_inertia": stated(drive["J"]),
        "rated_torque": stated(rated),
        "peak_torque": unknown(),
        "motor_speed_limit": unknown(),
        "play": stated(2.0 * drive["gap"]),
        "play_orders": [],
        "te_orders": [
            {"order": stated(order), "amplitude": stated(size), "phase": stated(phase)}
            for order, size, phase in drive["te"]
        ],
        "stiffness": [{"torque": stated(torque), "windup": stated(windup)} for torque, windup in points],
        "mesh_damping": stated(drive["D"]),
        "friction": laws,
        "temperature": unknown(),
        "source": {},
        "draws": None,
        "not_represented": [],
    }


def body_of(drive):
    """Distance of the arm's mass from its hinge, the mass, and the inertia about its middle."""
    inertia, weight = drive["Jb"], drive["mgl"]
    length = min(0.2, 0.5 * inertia * 9.81 / weight)
    mass = weight / 9.81 / length
    return length, mass, inertia - mass * length**2


def pendulum(drive, joint=""):
    """MJCF of the arm of a case's drive: a hinge about a horizontal axis."""
    length, mass, rest = body_of(drive)
    return (
        '<mujoco><option integrator="implicitfast"/><compiler angle="radian"/><worldbody><body>'
        f'<joint name="arm" type="hinge" axis="0 1 0" {joint}/><inertial pos="0 0 {-length}" mass="{mass}" '
        f'diaginertia="{rest} {rest} {rest}"/></body></worldbody></mujoco>'
    )


@dataclasses.dataclass(frozen=True)
class Run:
    """Arm and motor of a run at the reference's times, rad, and the motor's work, J, after each."""

    arm: np.ndarray
    motor: np.ndarray
    work: np.ndarray


def run(case, h, advance, drive):
    """Follow a case's commands.

    `advance` moves the simulator with a command and returns the arm's angle; `drive` is its `JointDrive`.
    """
    each = round(case["control_period"] / h)
    arm, motor, work = [case["initial"]["arm_angle"]], [drive.motor_angle], [0.0]
    for command in case["commands"]:
        done = 0.0
        for _ in range(each):
            angle = advance(command)
            done += drive.motor_work
        arm.append(angle)
        motor.append(drive.motor_angle)
        work.append(work[-1] + done)
    return Run(np.array(arm), np.array(motor), np.array(work))
