"""Files of robot simulators from a joint: MJCF, URDF with ros2_control, Isaac Lab, Drake and BAM.

Each begins with a comment on what it lacks. The arm in them is a placeholder, `arm`: a link of a stated inertia about a
hinge of the same name.
"""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from xml.sax.saxutils import quoteattr

from cycloid_fmu import edge
from cycloid_fmu.joint import joint_drive
from cycloid_fmu.joint.document import Joint

ARM_INERTIA = 1.0
"""Inertia of the arm in the files unless another is stated, kg·m²."""
TIMESTEP = 1e-3
_ATTRIBUTES = "transmission error, stiffness over the load, efficiency, Stribeck friction, presliding and temperature"
_AS_ATTRIBUTES = f"play, stiffness, {_ATTRIBUTES}"


@dataclasses.dataclass(frozen=True)
class Attributes:
    """The joint as simulators have it, referred to the arm, SI; None where unknown.

    Attributes
    ----------
    ratio
        |ratio|.
    armature
        Inertia of the rotor at the arm, kg·m².
    motor_friction, output_friction, friction
        Sliding friction without a load, of the motor at the arm, of the output, and of both, N·m.
    breakaway
        The same at rest, N·m.
    viscous
        N·m·s/rad.
    stiffness
        Between half and full rated torque, N·m/rad.
    starting_torque, back_driving_torque
        Torque of the motor that starts the drive without a load, and of the output that turns it back, N·m.
    """

    ratio: float
    armature: float | None
    motor_friction: float
    output_friction: float
    friction: float
    breakaway: float
    viscous: float
    stiffness: float | None
    starting_torque: float
    back_driving_torque: float


def attributes(values: Mapping[str, float | None]) -> Attributes:
    """Return the attributes of a joint's values; friction that is unknown counts as none, and the files say so.

    Raises
    ------
    edge.InputError
        If the ratio is unknown.
    """
    ratio = abs(_known(values, "ratio"))

    def of(name: str) -> float:
        return values.get(f"friction.{name}") or 0.0

    (driving, back, share), rotor = _shares(values), values.get("rotor_inertia")
    sliding = ratio * of("motor.coulomb"), of("output.coulomb")
    rest = sliding[0] + ratio * of("motor.stribeck"), sliding[1] + of("output.stribeck")
    return Attributes(
        ratio,
        None if rotor is None else rotor * ratio**2,
        *sliding,
        sum(sliding),
        sum(rest),
        of("output.viscous") + ratio**2 * of("motor.viscous"),
        stiffness(values),
        (rest[0] + rest[1] / (driving * (1.0 - share))) / ratio,
        rest[0] / back * (1.0 + share) + rest[1],
    )


def stiffness(values: Mapping[str, float | None]) -> float | None:
    """Return the stiffness between half and full rated torque, N·m/rad; None if it is unknown."""
    points, rated = joint_drive.members(values, "stiffness"), values.get("rated_torque")
    if not points or rated is None:
        return None
    torque, windup = zip(*points, strict=True)

    def at(load: float) -> float:
        k = next((k for k in range(1, len(torque) - 1) if load <= torque[k]), len(torque) - 1)
        return float(windup[k - 1] + (load - torque[k - 1]) * (windup[k] - windup[k - 1]) / (torque[k] - torque[k - 1]))

    return 0.5 * rated / (at(rated) - at(0.5 * rated))


def longest_step(values: Mapping[str, float | None], arm_inertia: float) -> float:
    """Return the longest stable step of a simulator that has the rotor and the arm on the stiffness, s."""
    of = attributes(values)
    if of.armature is None or of.stiffness is None:
        return math.nan
    return 2.0 / math.sqrt(of.stiffness * (1.0 / of.armature + 1.0 / arm_inertia))


def _known(values: Mapping[str, float | None], name: str) -> float:
    value = values.get(name)
    if value is None:
        option = "--rotor-inertia or " if name == "rotor_inertia" else ""
        raise edge.InputError(f"{name} is unknown; this file needs it: state it by {option}a file of --figures.")
    return value


def _lacks(joint: Joint, what: str, values: Mapping[str, float | None]) -> list[str]:
    """Return the lines of the first comment."""
    of = attributes(values)
    missing = [
        name
        for name, value in values.items()
        if value is None and name.startswith(("friction.", "peak", "motor_speed"))
    ]
    lines = [f"Lacks {what}."]
    if missing:
        lines.append(f"Unknown, and left out: {', '.join(missing)}.")
    lines.append(
        f"Without a load {of.starting_torque:.4g} N·m start the motor and {of.back_driving_torque:.4g} N·m turn the "
        "output back, by the friction that is known."
    )
    return [*lines, *joint.not_represented]


def _comment(lines: list[str]) -> str:
    text = "\n     ".join(line.replace("--", "- -") for line in lines)
    return f"<!-- {text} -->\n"


def _attribute(**of: object) -> str:
    """Return XML attributes, without those that are None."""
    given = {
        name: f"{value:.10g}" if isinstance(value, float) else str(value)
        for name, value in of.items()
        if value is not None
    }
    return "".join(f" {name}={quoteattr(text)}" for name, text in given.items())


def _both(value: float | None) -> str | None:
    return None if value is None else f"{-value:.10g} {value:.10g}"


# Dry friction in MuJoCo creeps at its default compliance; this holds.
_HOLDS = {"solreffriction": f"{2.0 * TIMESTEP:g} 1", "solimpfriction": "0.9999 0.9999 0.001"}
_TENDON_HOLDS = _HOLDS


def _mujoco(comment: str, joints: str, rest: str, arm_inertia: float) -> str:
    return (
        f'{comment}<mujoco model="cycloid joint">\n'
        f'  <option timestep="{TIMESTEP:g}" integrator="implicitfast"/>\n'
        '  <compiler angle="radian"/>\n'
        "  <worldbody>\n"
        '    <body name="arm">\n'
        f"{joints}"
        f'      <inertial pos="0 0 0" mass="1"{_attribute(diaginertia=" ".join([f"{arm_inertia:.10g}"] * 3))}/>\n'
        "    </body>\n"
        "  </worldbody>\n"
        f"{rest}"
        "</mujoco>\n"
    )


def _motor(values: Mapping[str, float | None], joint: str) -> str:
    """Return the motor: its control is the torque of the motor itself."""
    peak, ratio = values.get("peak_torque"), _known(values, "ratio")
    motor = _attribute(
        name="motor",
        joint=joint,
        gear=ratio,
        armature=_known(values, "rotor_inertia"),
        damping=values.get("friction.motor.viscous"),
        forcerange=_both(None if peak is None else peak / abs(ratio)),
    )
    return f"  <actuator>\n    <general{motor}/>\n  </actuator>\n"


def mjcf(joint: Joint, values: Mapping[str, float | None], arm_inertia: float) -> str:
    """Return a MuJoCo model with the drive as attributes of a hinge."""
    of = attributes(values)
    lines = [
        *_lacks(joint, f"{_AS_ATTRIBUTES}; for play and stiffness see the file with -play", values),
        "The motor's gear multiplies armature and damping by its square, in MuJoCo 4.0 and later.",
        f"solreffriction keeps dry friction from creeping: 2 steps of {TIMESTEP:g} s; change it with the step.",
    ]
    hinge = _attribute(
        name="arm",
        axis="0 1 0",
        damping=values.get("friction.output.viscous"),
        frictionloss=of.friction,
        actuatorfrcrange=_both(values.get("peak_torque")),
        **_HOLDS,
    )
    return _mujoco(_comment(lines), f"      <joint{hinge}/>\n", _motor(values, "arm"), arm_inertia)


def mjcf_play(joint: Joint, values: Mapping[str, float | None], arm_inertia: float) -> str:
    """Return a MuJoCo model with play and stiffness: the arm's angle is that of `drive` and `play` together."""
    of, play = attributes(values), _known(values, "play")
    if of.stiffness is None:
        raise edge.InputError("stiffness is unknown; this file needs it: state it by a file of --figures.")
    step = longest_step(values, arm_inertia)
    lines = [
        *_lacks(joint, _ATTRIBUTES, values),
        f"The longest stable step is {step:.3g} s with this arm of {arm_inertia:g} kg·m².",
        f"The stiffness is that from half to full rated torque, the play {play:.4g} rad in all.",
        "The arm's angle is that of both hinges together; friction of the output is in the tendon over both.",
    ]
    drive = _attribute(name="drive", axis="0 1 0", frictionloss=of.motor_friction, **_HOLDS)
    loose = _attribute(name="play", axis="0 1 0")
    spring = _attribute(
        name="spring",
        springlength=_both(0.5 * play),
        stiffness=of.stiffness,
        damping=values.get("mesh_damping"),
    )
    output = _attribute(
        name="output",
        frictionloss=of.output_friction or None,
        damping=values.get("friction.output.viscous"),
        **(_TENDON_HOLDS if of.output_friction else {}),
    )
    tendons = (
        f'  <tendon>\n    <fixed{spring}><joint joint="play" coef="1"/></fixed>\n'
        f'    <fixed{output}><joint joint="drive" coef="1"/><joint joint="play" coef="1"/></fixed>\n  </tendon>\n'
    )
    hinges = f"      <joint{drive}/>\n      <joint{loose}/>\n"
    return _mujoco(_comment(lines), hinges, tendons + _motor(values, "drive"), arm_inertia)


MUJOCO_ROWS = edge.packaged_text("cycloid_fmu.joint", "mujoco_rows.txt")
"""Script that puts rows of the draws into a MuJoCo model, a format string."""


def _link(arm_inertia: float) -> str:
    inertia = _attribute(**{name: arm_inertia for name in ("ixx", "iyy", "izz")}, ixy=0.0, ixz=0.0, iyz=0.0)
    return (
        '  <link name="base"/>\n'
        '  <link name="arm_link">\n    <inertial><origin xyz="0 0 0"/><mass value="1"/>'
        f"<inertia{inertia}/></inertial>\n  </link>\n"
    )


def _joint(values: Mapping[str, float | None]) -> str:
    of = attributes(values)
    peak, speed = values.get("peak_torque"), values.get("motor_speed_limit")
    limit = _attribute(effort=peak, velocity=None if speed is None else speed / of.ratio)
    known = f"    <limit{limit}/>\n" if peak is not None and speed is not None else ""
    dynamics = _attribute(damping=of.viscous, friction=of.friction)
    return (
        '  <joint name="arm" type="continuous">\n    <parent link="base"/>\n    <child link="arm_link"/>\n'
        f'    <axis xyz="0 1 0"/>\n    <dynamics{dynamics}/>\n{known}  </joint>\n'
    )


def urdf(joint: Joint, values: Mapping[str, float | None], arm_inertia: float) -> str:
    """Return a URDF with the transmission of ros2_control."""
    lines = _lacks(joint, f"{_AS_ATTRIBUTES}, and the rotor's inertia, for which URDF has no name", values)
    ratio = f"{_known(values, 'ratio'):.10g}"
    return (
        f'<?xml version="1.0"?>\n{_comment(lines)}<robot name="cycloid_joint">\n{_link(arm_inertia)}{_joint(values)}'
        '  <ros2_control name="cycloid_joint" type="actuator">\n'
        "    <hardware><plugin>mock_components/GenericSystem</plugin></hardware>\n"
        '    <joint name="arm">\n      <command_interface name="effort"/>\n      <state_interface name="position"/>\n'
        '      <state_interface name="velocity"/>\n    </joint>\n'
        '    <transmission name="cycloid_drive">\n      <plugin>transmission_interface/SimpleTransmission</plugin>\n'
        '      <actuator name="motor" role="actuator1"/>\n      <joint name="arm" role="joint1">\n'
        f"        <mechanical_reduction>{ratio}</mechanical_reduction>\n      </joint>\n    </transmission>\n"
        "  </ros2_control>\n</robot>\n"
    )


def drake(joint: Joint, values: Mapping[str, float | None], arm_inertia: float) -> str:
    """Return a URDF with Drake's rotor inertia and gear ratio."""
    lines = _lacks(joint, f"{_AS_ATTRIBUTES}, and dry friction: Drake ignores it, with a warning", values)
    rotor, ratio = _attribute(value=_known(values, "rotor_inertia")), _attribute(value=_known(values, "ratio"))
    return (
        f'<?xml version="1.0"?>\n{_comment(lines)}'
        f'<robot name="cycloid_joint" xmlns:drake="https://drake.mit.edu/">\n{_link(arm_inertia)}{_joint(values)}'
        '  <transmission name="cycloid_drive">\n    <type>transmission_interface/SimpleTransmission</type>\n'
        '    <joint name="arm"/>\n    <actuator name="motor">\n'
        f"      <drake:rotor_inertia{rotor}/>\n      <drake:gear_ratio{ratio}/>\n    </actuator>\n  </transmission>\n"
        "</robot>\n"
    )


ISAAC = edge.packaged_text("cycloid_fmu.joint", "isaac.txt")
"""Module of an actuator of Isaac Lab, a format string."""


def isaac(joint: Joint, values: Mapping[str, float | None], arm_inertia: float) -> str:
    """Return the actuator of Isaac Lab, and an event that picks a row of the draws."""
    _known(values, "rotor_inertia")
    of, peak, speed = attributes(values), values.get("peak_torque"), values.get("motor_speed_limit")
    properties = {
        "armature": of.armature,
        "friction": of.breakaway,
        "dynamic_friction": of.friction,
        "viscous_friction": of.viscous,
        "actuator_effort_limit": peak,
        "actuator_velocity_limit": None if speed is None else speed / of.ratio,
    }
    rows = [attributes({**values, **row}) for row in joint.rows or ({},)]
    each = [(row.armature, row.breakaway, row.friction, row.viscous) for row in rows]
    ranges = {
        f"{name}_distribution_params": (min(row[k] or 0.0 for row in each), max(row[k] or 0.0 for row in each))
        for k, name in enumerate(("armature", "friction"))
    }
    lacks = [*_lacks(joint, _AS_ATTRIBUTES, values), "Not run in Isaac Lab; names are those of its source."]
    return ISAAC.format(
        lacks="\n".join(lacks),
        properties="\n".join(f"    {name}={value:.10g}," for name, value in properties.items() if value is not None),
        ranges=repr({"operation": "abs", **ranges}),
        rows="[\n" + "".join(f"    {tuple(float(f'{v:.10g}') for v in row if v is not None)},\n" for row in each) + "]",
    )


def bam(joint: Joint, values: Mapping[str, float | None], arm_inertia: float) -> str:
    """Return the friction of BAM's model m5 at the arm; motor constants are to be stated there.

    Raises
    ------
    edge.InputError
        If the losses that grow with the load can't be those of its two shares, or the rotor's inertia is unknown.
    """
    _known(values, "rotor_inertia")
    of, (motor, external) = attributes(values), load_shares(values)
    loaded, unloaded = (100.0 * residual(values, load) for load in (_known(values, "rated_torque"), 0.0))
    speed = [values.get(f"friction.{side}.stribeck_speed") for side in joint_drive.SIDES]
    at_arm = next((value for value in (speed[0] and speed[0] / of.ratio, speed[1]) if value), 1.0)
    lacks = [
        *_lacks(joint, "play, stiffness, transmission error, presliding and temperature", values),
        f"Sliding friction differs from this by {loaded:.2g} % at the rated torque and {unloaded:.2g} % without a "
        "load; one Stribeck speed is for both sides. kt and R are those of your motor.",
    ]
    content = {
        "comment": " ".join(lacks),
        "armature": of.armature,
        "friction_base": of.friction,
        "friction_stribeck": of.breakaway - of.friction,
        "load_friction_motor": motor,
        "load_friction_external": external,
        "load_friction_motor_stribeck": 0.0,
        "load_friction_external_stribeck": 0.0,
        "dtheta_stribeck": at_arm,
        "alpha": 2.0,
        "friction_viscous": of.viscous,
        "model": "m5",
        "actuator": "state yours",
    }
    return json.dumps(content, indent=2, ensure_ascii=False) + "\n"


def _shares(values: Mapping[str, float | None]) -> tuple[float, float, float]:
    """Return the efficiencies of the motor, driving and back-driven, and the share of the output."""
    driving, back = (values.get(f"friction.motor.{name}") or 1.0 for name in joint_drive.EFFICIENCIES)
    return driving, back, values.get("friction.output.load_share") or 0.0


def load_shares(values: Mapping[str, float | None]) -> tuple[float, float]:
    """Return BAM's shares of the motor's and of the external torque in friction, dimensionless.

    Raises
    ------
    edge.InputError
        If the losses can't be those of two shares.
    """
    driving, back, share = _shares(values)
    forward, backward = (1.0 + share) / driving - 1.0, 1.0 - (1.0 - share) * back
    if forward <= backward:
        return 0.0, 0.5 * (forward + backward)
    motor = (forward - backward) / (forward + backward)
    external = 2.0 * forward * backward / (forward + backward) - motor
    if external < 0.0:
        raise edge.InputError(
            f"BAM's model m5 can't have losses of {forward:.3g} of the load driving and {backward:.3g} back-driving: "
            "its share of the external torque would be below 0."
        )
    return motor, external


def residual(values: Mapping[str, float | None], load: float) -> float:
    """Return by how much sliding friction differs from BAM's at a load (N·m), in either direction, relative."""
    of, (motor, external), (driving, back, share) = attributes(values), load_shares(values), _shares(values)
    lifting = (load + of.output_friction) / ((1.0 - share) * driving) + of.motor_friction
    holding = max(load - of.output_friction, 0.0) / (1.0 + share) * back - of.motor_friction
    off = []
    for torque in (lifting, *([holding] if holding > 0.0 else [])):
        modelled = of.friction + external * load + motor * torque
        if modelled > 0.0:
            off.append(abs(abs(torque - load) / modelled - 1.0))
    return max(off, default=0.0)


Writer = Callable[[Joint, Mapping[str, float | None], float], str]
WRITERS: dict[str, tuple[Writer, str]] = {
    "mjcf": (mjcf, ".xml"),
    "urdf": (urdf, ".urdf"),
    "isaac": (isaac, ".py"),
    "drake": (drake, ".urdf"),
    "bam": (bam, ".json"),
}
"""The writer of each target, and the ending of its file."""


def text(joint: Joint, target: str, arm_inertia: float = ARM_INERTIA, row: int | None = None) -> str:
    """Return the file of a target as text.

    Parameters
    ----------
    joint
        The joint.
    target
        One of `WRITERS`.
    arm_inertia
        Inertia of the arm in the file, kg·m².
    row
        Row of the draws; None for the joint's own values.

    Raises
    ------
    edge.InputError
        If the file needs an unknown number, or there is no such row.
    """
    if not 0.0 < arm_inertia < math.inf:
        raise edge.ArgumentError("arm_inertia", "it must be finite and above zero (kg*m^2)", arm_inertia)
    return WRITERS[target][0](joint, joint.values if row is None else joint.row(row), arm_inertia)


def write_file(joint: Joint, target: str, path: str | os.PathLike[str], arm_inertia: float = ARM_INERTIA) -> list[Path]:
    """Write the file of a target; with MJCF also the model with play, and a script that takes rows of the draws.

    Returns
    -------
    paths
        The files.

    Raises
    ------
    edge.InputError
        As `text`, or if the name has another ending.
    """
    main = edge.output_path(path, target, (WRITERS[target][1],))
    texts = {main: text(joint, target, arm_inertia)}
    if target == "mjcf" and joint.values["play"] is not None and stiffness(joint.values) is not None:
        with_play = main.with_stem(f"{main.stem}-play")
        texts[with_play] = mjcf_play(joint, joint.values, arm_inertia)
        if joint.rows:
            known = {name: value for name, value in joint.values.items() if value is not None}
            lacks = "Lacks what the models lack."
            texts[main.with_name(f"{main.stem}_rows.py")] = MUJOCO_ROWS.format(
                lacks=lacks, values=repr(known), model=with_play.name
            )
    for file, content in texts.items():
        with edge.written_whole(file) as temporary:
            temporary.write_text(content, encoding="utf-8")
    return list(texts)
