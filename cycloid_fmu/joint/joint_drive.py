"""A cycloid drive and its rotor beside a robot simulator: the run-time of a `cycloid-joint/1` document.

The simulator has the arm, without armature, friction or an actuator at this joint. At each step `JointDrive` takes the
motor's command and what the simulator knows of the arm, and gives the torque on it and its angle after the step.
`MujocoJoints` and `DrakeJoints` do this for MuJoCo and Drake. Only this file, the library for the machine in
`libraries` and the document are needed. SI units, angles in rad; the motor's angle and torque have the sign of the
motor, those of the arm the sign of the joint.
"""

from __future__ import annotations

import csv
import ctypes
import functools
import hashlib
import json
import math
import platform
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any

FORMAT = "cycloid-joint/1"
LONGEST_STEP = 5e-3
"""Longest step of a simulator, s."""
HELD_STEP = 2.0
"""Largest step times the angular frequency at which the drive holds the arm, if the simulator moves it, rad."""
ORIGINS = ("drawn", "predicted", "identified", "measured", "stated")
SIDES = ("motor", "output")
LAW = ("coulomb", "stribeck", "stribeck_speed", "viscous", "presliding_angle")
EFFICIENCIES = ("efficiency_driving", "efficiency_back_driving")
SCALARS = (
    "ratio",
    "rotor_inertia",
    "rated_torque",
    "peak_torque",
    "motor_speed_limit",
    "play",
    "mesh_damping",
    "temperature",
    *(f"friction.{side}.{name}" for side in SIDES for name in LAW),
    *(f"friction.motor.{name}" for name in EFFICIENCIES),
    "friction.output.load_share",
)
LISTS = {
    "stiffness": ("torque", "windup"),
    "te_orders": ("order", "amplitude", "phase"),
    "play_orders": ("order", "amplitude", "phase"),
}
REQUIRED = ("ratio", "rotor_inertia", "rated_torque", "play")
MOST = 32  # points, and orders, that the library takes
NEUTRAL = {"stribeck_speed": 1.0, "presliding_angle": 1e-3, **dict.fromkeys(EFFICIENCIES, 1.0)}
STRAINS = 10
MISSING = {"value": None, "reason": "not in the document"}
_REFUSALS = {1: "a number is not finite", 2: "the arm's inertia is so small that a step would have 10000 parts"}


class JointError(ValueError):
    """What is wrong with a joint document or a call, in one sentence."""


def flat(document: Mapping[str, Any], source: str = "document") -> dict[str, dict[str, Any]]:
    """Return each number of a document by its dotted name, `friction.motor.coulomb` or `te_orders.0.phase`.

    A number is `{"value", "interval", "origin"}`, or `{"value": None, "reason"}` if it is unknown. A list that is
    unknown as a whole is such a number under the list's name.

    Raises
    ------
    JointError
        If it is no such document, or a number is not of this form. What is missing is unknown.
    """
    if document.get("format") != FORMAT:
        raise JointError(f"{source}: format is {document.get('format')!r}, this version reads {FORMAT!r}.")
    numbers = {}
    for name in SCALARS:
        at: Any = document
        for part in name.split("."):
            at = at.get(part) if isinstance(at, Mapping) else None
        numbers[name] = _number(name, MISSING if at is None else at, source)
    for name, members in LISTS.items():
        rows = document.get(name, MISSING)
        if isinstance(rows, Mapping):
            numbers[name] = _number(name, rows, source)
            if numbers[name]["value"] is not None:
                raise JointError(f"{source}: {name} must be a list, or unknown with a reason.")
            continue
        if not isinstance(rows, Sequence) or isinstance(rows, str) or len(rows) > MOST:
            raise JointError(f"{source}: {name} must be a list of at most {MOST}, or unknown with a reason.")
        for k, row in enumerate(rows):
            for member in members:
                at = row.get(member) if isinstance(row, Mapping) else None
                numbers[f"{name}.{k}.{member}"] = _number(f"{name}.{k}.{member}", at, source)
    return numbers


def _number(name: str, given: Any, source: str) -> dict[str, Any]:
    if not isinstance(given, Mapping) or "value" not in given:
        more = "an interval without its value" if isinstance(given, Mapping) and "interval" in given else f"{given!r}"
        raise JointError(f'{source}: {name} is {more}; a number is {{"value", "interval", "origin"}}.')
    value, interval = given["value"], given.get("interval")
    if value is None:
        if interval is not None:
            raise JointError(f"{source}: {name} has an interval without its value.")
        if not given.get("reason"):
            raise JointError(f"{source}: {name} is unknown without a reason.")
        return dict(given)
    for part in (value, *(interval or ())):
        if isinstance(part, bool) or not isinstance(part, int | float) or not math.isfinite(part):
            raise JointError(f"{source}: {name} = {part!r} is no finite number.")
    if interval is not None and not (len(interval) == 2 and interval[0] <= interval[1]):
        raise JointError(f"{source}: {name} has the interval {list(interval)}; it is [lowest, highest].")
    if given.get("origin") not in ORIGINS:
        raise JointError(f"{source}: {name} has the origin {given.get('origin')!r}; it is one of {', '.join(ORIGINS)}.")
    return dict(given)


def rows_of(path: Any, names: Collection[str]) -> list[dict[str, float]]:
    """Return the rows of a `draws.csv`: values by dotted name, of `names`; row 0 is the most likely.

    Raises
    ------
    JointError
        If it can't be read, or has another number or none.
    """
    try:
        with open(path, newline="", encoding="utf-8") as file:
            lines = list(csv.reader(file))
    except (OSError, ValueError) as problem:
        raise JointError(f"{path}: it can't be read: {problem}.") from None
    rows: list[dict[str, float]] = []
    header = lines[0] if lines else []
    for name in header:
        if name not in names:
            raise JointError(f"{path}: the joint has no number {name!r}.")
    for line, cells in enumerate(lines[1:], 2):
        try:
            row = {name: float(cell) for name, cell in zip(header, cells, strict=True)}
        except ValueError:
            row = {}
        if not row or not all(map(math.isfinite, row.values())):
            raise JointError(f"{path}: line {line} must have {len(header)} finite numbers.")
        rows.append(row)
    return rows


def read(document: Any, row: int | None = None) -> dict[str, float | None]:
    """Return the values of a document by dotted name, checked; those of a row of its draws if one is given.

    Parameters
    ----------
    document
        The document, or its file.
    row
        Row of the file of draws that the document names, in its folder; None for the document's own values.

    Raises
    ------
    JointError
        If a number is missing or out of range, or there is no such row.
    """
    source, folder = "document", Path()
    if not isinstance(document, Mapping):
        source, folder = str(document), Path(document).parent
        try:
            document = json.loads(Path(document).read_text(encoding="utf-8"))
        except (OSError, ValueError) as problem:
            raise JointError(f"{source}: it can't be read: {problem}.") from None
        if not isinstance(document, Mapping):
            raise JointError(f"{source}: it is no joint document.")
    values = {name: number["value"] for name, number in flat(document, source).items()}
    if row is not None:
        if not document.get("draws"):
            raise JointError(f"{source}: it names no draws, so there is no row {row}.")
        rows = rows_of(folder / document["draws"], values)
        if not 0 <= row < len(rows):
            raise JointError(f"{folder / document['draws']}: row {row}: it has the rows 0 to {len(rows) - 1}.")
        values.update(rows[row])
    check(values, source)
    return values


def check(values: Mapping[str, float | None], source: str = "document") -> None:
    """Raise a `JointError` if a value is out of its range; unknown ones are not."""

    def refuse(name: str, allowed: str) -> None:
        raise JointError(f"{source}: {name} = {values[name]!r}: {allowed}.")

    def known(name: str) -> float:
        value = values.get(name)
        return math.nan if value is None else value

    if abs(known("ratio")) < 1.0:
        refuse("ratio", "a reducer has at least 1 motor turn per output turn, signed")
    for name in ("rotor_inertia", "rated_torque", "peak_torque", "motor_speed_limit", "temperature"):
        if known(name) <= 0.0:
            refuse(name, "it must be above 0")
    for name in ("play", "mesh_damping", *(f"friction.{side}.{part}" for side in SIDES for part in LAW)):
        if known(name) < 0.0 or (name.endswith(("_speed", "_angle")) and known(name) == 0.0):
            refuse(name, "it must not be below 0" if known(name) < 0.0 else "it must be above 0")
    if known("friction.motor.efficiency_back_driving") <= 0.0:
        refuse(
            "friction.motor.efficiency_back_driving", "such a drive is self-locking, which this model can't represent"
        )
    for name in EFFICIENCIES:
        if not (math.isnan(known(f"friction.motor.{name}")) or 0.0 < known(f"friction.motor.{name}") <= 1.0):
            refuse(f"friction.motor.{name}", "an efficiency lies above 0 and not above 1")
    if not (math.isnan(known("friction.output.load_share")) or 0.0 <= known("friction.output.load_share") < 1.0):
        refuse("friction.output.load_share", "it lies from 0 to below 1")
    points = members(values, "stiffness")
    for k, point in enumerate(points):
        for name, value in zip(LISTS["stiffness"], point, strict=True):
            if value != 0.0 if k == 0 else not value > points[k - 1][LISTS["stiffness"].index(name)]:
                refuse(f"stiffness.{k}.{name}", "torque and windup increase strictly from 0, 0")
    if len(points) == 1:
        raise JointError(f"{source}: stiffness has one point; it needs 0, 0 and at least one more.")


def members(values: Mapping[str, float | None], name: str) -> list[tuple[float, ...]]:
    """Return the rows of one of `LISTS`, up to the first that is unknown."""
    rows: list[tuple[float, ...]] = []
    while f"{name}.{len(rows)}.{LISTS[name][0]}" in values:
        given = [values[f"{name}.{len(rows)}.{member}"] for member in LISTS[name]]
        row = tuple(value for value in given if value is not None)
        if len(row) < len(given):
            break
        rows.append(row)
    return rows


def library() -> ctypes.CDLL:
    """Return the library for this machine.

    Raises
    ------
    JointError
        If there is none, or it is made of another source than that beside it.
    """
    machine = {"amd64": "x86_64", "arm64": "aarch64"}.get(platform.machine().lower(), platform.machine().lower())
    system = platform.system().lower()
    suffix = {"windows": ".dll", "darwin": ".dylib"}.get(system, ".so")
    path = Path(__file__).parent / "libraries" / f"{machine}-{system}{suffix}"
    if not path.exists():
        raise JointError(
            f"{path} is missing. Make it of joint_drive.c, which `cycloid-fmu joint --runtime` writes: cc -std=c99 -O2 "
            f"-ffp-contract=off -fPIC -shared -o {path.name} joint_drive.c -lm"
        )
    loaded = ctypes.CDLL(str(path))
    loaded.joint_drive_source.restype = ctypes.c_char_p
    loaded.joint_drive_size.restype = ctypes.c_size_t
    loaded.joint_drive_stiffness.restype = ctypes.c_double
    source, stated = Path(__file__).with_name("joint_drive.c"), loaded.joint_drive_source().decode()
    if stated and source.exists() and stated != hashlib.sha256(source.read_bytes()).hexdigest():
        raise JointError(f"{path} is not made of the {source.name} beside it; compile it again.")
    return loaded


class JointDrive:
    """A drive and its rotor. `step` is one step of the simulator.

    Parameters
    ----------
    document
        A `cycloid-joint/1` document, or its file.
    h
        Step of the simulator, s; at most 5 ms.
    motor_angle
        Angle of the motor at the start, rad, from the zero of the pair file; the rotor starts at rest.
    row
        Row of the document's draws; None for its own values.
    position_written
        Whether the simulator takes the arm's angle at the end of each step; without this a step is refused if it is too
        long for the stiffness.

    Attributes
    ----------
    absent
        Names of unknown numbers, which this drive is without.
    memory
        Where the library has the state, the command and the results of the last step.

    Raises
    ------
    JointError
        If a number is missing or out of range.
    """

    def __init__(
        self, document: Any, h: float, motor_angle: float, row: int | None = None, position_written: bool = True
    ) -> None:
        source = "document" if isinstance(document, Mapping) else str(document)
        values = read(document, row)
        for name, number in (("h", h), ("motor_angle", motor_angle)):
            if not math.isfinite(number):
                raise JointError(f"{name} = {number!r}: it must be finite.")
        if not 0.0 < h <= LONGEST_STEP:
            raise JointError(f"h = {h!r} s: it lies above 0 and not above {LONGEST_STEP:g} s.")
        for name in REQUIRED:
            if values[name] is None:
                raise JointError(f"{source}: {name} is unknown; the run-time needs it.")
        points = members(values, "stiffness")
        if not points:
            raise JointError(f"{source}: stiffness is unknown; the run-time needs it.")
        self.ratio, self.h, self.position_written = values["ratio"], h, position_written
        self.absent = [name for name, value in values.items() if value is None]
        laws = [f"friction.{side}.{name}" for side in SIDES for name in LAW]
        laws[5:5] = [f"friction.motor.{name}" for name in EFFICIENCIES]
        names = (*REQUIRED[:2], "play", "mesh_damping", "rated_torque")
        numbers = [values[name] or 0.0 for name in names] + [h]
        for name in (*laws, "friction.output.load_share"):
            value = values[name]
            numbers.append(NEUTRAL.get(name.rpartition(".")[2], 0.0) if value is None else value)
        waves = [members(values, "te_orders"), members(values, "play_orders")]
        numbers += [len(points), *map(len, waves)]
        numbers += [number for rows in (points, *waves) for row in rows for number in row]
        self._library = library()
        self._joint = ctypes.create_string_buffer(self._library.joint_drive_size())
        kind = ctypes.c_double * len(numbers)
        if self._library.joint_drive_open(self._joint, kind(*numbers), ctypes.c_size_t(len(numbers))) != 0:
            raise JointError(f"{source}: its library takes at most {MOST} points and orders.")
        self._command, self._outside, self._result = (
            *((ctypes.c_double * 5)() for _ in range(2)),
            (ctypes.c_double * 4)(),
        )
        self.memory = self._joint, self._command, self._result
        self.load([motor_angle, 0.0, *[0.0] * STRAINS])

    def step(
        self, command: Sequence[float], phi: float, w: float, inertia: float, force: float, slope: float = 0.0
    ) -> tuple[float, float]:
        """Move by one step; return the mean torque on the arm, N·m, and its angle at the end, rad.

        Parameters
        ----------
        command
            Torque τ (N·m), kp (N·m/rad), kd (N·m·s/rad), angle θ and speed ω of the motor; its torque is τ + kp (θ -
            angle) + kd (ω - speed), at each sub-step.
        phi, w
            Angle and speed of the arm, rad and rad/s.
        inertia
            Of the arm at this joint with all others free, kg·m²: 1/(M⁻¹)_jj.
        force, slope
            Torque of everything but the drive on this inertia, N·m, and its rate, N·m/s.

        Raises
        ------
        JointError
            If a number is not finite or the step is too long; then nothing has changed.
        """
        if not inertia > 0.0:
            raise JointError(f"inertia = {inertia!r} kg*m2: it must be above 0.")
        if not self.position_written:
            held = self.h * math.sqrt(self._library.joint_drive_stiffness(self._joint) / inertia)
            if held > HELD_STEP:
                raise JointError(
                    f"h = {self.h:g} s is {held:.3g} rad of the drive on an inertia of {inertia:g} kg*m2, more than "
                    f"{HELD_STEP:g}: take a shorter step, or write the arm's angle after it."
                )
        self._command[:] = list(command)
        self._outside[:] = [phi, w, inertia, force, slope]
        refuse(self._library.joint_drive_step(self._joint, self._command, self._outside, self._result))
        return self._result[0], self._result[1]

    def save(self) -> list[float]:
        """Return the state: angle and speed of the motor, and ten strains of its friction, rad and rad/s."""
        state = (ctypes.c_double * (2 + STRAINS))()
        self._library.joint_drive_save(self._joint, state)
        return list(state)

    def load(self, state: Sequence[float]) -> None:
        """Continue from a state that `save` returned, of this drive."""
        self._library.joint_drive_load(self._joint, (ctypes.c_double * (2 + STRAINS))(*state))

    @property
    def motor_work(self) -> float:
        """Work of the motor in the last step, J."""
        return self._result[2]

    @property
    def parts(self) -> int:
        """Number of sub-steps in the last step."""
        return int(self._result[3])

    @property
    def motor_angle(self) -> float:
        """Angle of the motor, rad."""
        return self.save()[0]

    @property
    def motor_speed(self) -> float:
        """Speed of the motor, rad/s."""
        return self.save()[1]


def refuse(refused: int) -> None:
    """Raise a `JointError` if the library has refused a step."""
    if refused:
        raise JointError(f"The step of the drive is refused: {_REFUSALS[refused]}.")


class _Hinge(ctypes.Structure):
    _fields_ = (
        ("joint", ctypes.c_void_p),
        ("speed", ctypes.c_size_t),
        ("angle", ctypes.c_size_t),
        ("command", ctypes.c_void_p),
        ("result", ctypes.c_void_p),
    )


class _Scene(ctypes.Structure):
    _fields_ = (
        *((name, ctypes.c_size_t) for name in ("drives", "speeds", "pushes")),
        *((f"address_{k}", ctypes.c_void_p) for k in range(13)),
    )


class MujocoJoints:
    """Cycloid drives at hinges of a MuJoCo model. `step` replaces `mujoco.mj_step`.

    Parameters
    ----------
    model, data
        The model, of which each such hinge is without armature, actuator and tendon, and its data. The drives' torques
        are in `data.qfrc_applied` of their hinges.
    drives
        {name of the hinge: its drive}.

    Raises
    ------
    JointError
        If there is no such hinge, the integrator or the step is another, or something else drives the hinge.
    """

    def __init__(self, model: Any, data: Any, drives: Mapping[str, JointDrive]) -> None:
        import mujoco
        import numpy as np

        if model.opt.integrator not in (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_IMPLICITFAST):
            raise JointError("The integrator of the model must be Euler or implicitfast.")
        joints = [_mujoco_hinge(mujoco, model, name, drive) for name, drive in drives.items()]
        self._mujoco, self.model, self.data, self._time = mujoco, model, data, math.nan
        self._drives, count = list(drives.values()), len(joints)
        self._forces, self._solved = np.zeros((2, count + 2, model.nv))
        before, per_step = np.zeros((2, model.nv))
        hinges = (_Hinge * count)()
        for k, (drive, joint) in enumerate(zip(self._drives, joints, strict=True)):
            dof, place = int(model.jnt_dofadr[joint]), int(model.jnt_qposadr[joint])
            hinges[k] = _Hinge(ctypes.addressof(drive.memory[0]), dof, place, *map(ctypes.addressof, drive.memory[1:]))
            self._forces[k + 2, dof], per_step[dof] = 1.0, 1.0 / model.opt.timestep
        forces = data.qfrc_passive, data.qfrc_bias, data.qfrc_actuator, data.qfrc_constraint, data.xfrc_applied
        rest = data.qfrc_applied, data.qpos, data.qvel, before, per_step, self._forces, self._solved
        self._arrays = (*forces, *rest)
        sizes = count, model.nv, data.xfrc_applied.size, ctypes.addressof(hinges)
        self._scene = _Scene(*sizes, *(array.ctypes.data for array in self._arrays))
        self._hinges, address, joint_library = hinges, ctypes.byref(self._scene), library()
        self._read, self._move, self._place = (
            functools.partial(getattr(joint_library, f"joint_drive_{name}"), address)
            for name in ("read", "move", "place")
        )

    def step(self, commands: Sequence[Sequence[float]]) -> None:
        """Move the model by one step, with one command of `JointDrive.step` for each drive, in their order."""
        mujoco, model, data = self._mujoco, self.model, self.data
        for drive, command in zip(self._drives, commands, strict=True):
            drive.memory[1][:] = command if isinstance(command, list) else list(command)
        mujoco.mj_step1(model, data)
        pushed = self._read()
        if data.time != self._time:
            self._forces[1] = 0.0
        if pushed:
            for body, push in enumerate(data.xfrc_applied):
                mujoco.mj_applyFT(model, data, push[:3], push[3:], data.xipos[body], body, self._forces[0])
        mujoco.mj_solveM(model, data, self._solved, self._forces)
        refuse(self._move())
        mujoco.mj_step2(model, data)
        self._place()
        self._time = data.time


def _mujoco_hinge(mujoco: Any, model: Any, name: str, drive: JointDrive) -> int:
    """Return the number of a hinge; raise a `JointError` if there is none, or a drive can't have it."""
    joint = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, name)
    if joint < 0 or model.jnt_type[joint] != mujoco.mjtJoint.mjJNT_HINGE:
        raise JointError(f"{name!r} is not a hinge of the model.")
    if drive.h != model.opt.timestep:
        raise JointError(f"The drive of {name!r} has h = {drive.h:g} s, the model {model.opt.timestep:g} s.")
    wraps = zip(model.wrap_type, model.wrap_objid, strict=True)
    if any(kind == int(mujoco.mjtWrap.mjWRAP_JOINT) and number == joint for kind, number in wraps):
        raise JointError(
            f"The hinge {name!r} has a tendon transmission; its transmission is the drive: delete the tendon."
        )
    direct = (int(mujoco.mjtTrn.mjTRN_JOINT), int(mujoco.mjtTrn.mjTRN_JOINTINPARENT))
    actuators = zip(model.actuator_trntype, model.actuator_trnid, strict=True)
    if any(kind in direct and numbers[0] == joint for kind, numbers in actuators):
        raise JointError(f"The hinge {name!r} has an actuator; its motor is that of the drive: delete the actuator.")
    if model.dof_armature[model.jnt_dofadr[joint]] != 0.0:
        raise JointError(f"The hinge {name!r} has an armature; the rotor is that of the drive: delete the armature.")
    return int(joint)


class DrakeJoints:
    """Cycloid drives at revolute joints of a discrete Drake plant, beside its simulator.

    Parameters
    ----------
    plant, simulator
        The finalized `MultibodyPlant`, of which each such joint is without rotor inertia and actuator, and the
        `Simulator` of its diagram. The plant's `applied_generalized_force` port is set here, so that nothing may be
        connected to it.
    drives
        {name of the joint: its drive}.

    Raises
    ------
    JointError
        If a joint is not revolute, the plant is continuous or has another step, or an actuator is at the joint.
    """

    def __init__(self, plant: Any, simulator: Any, drives: Mapping[str, JointDrive]) -> None:
        import numpy as np

        self._numpy, self.plant, self.simulator, self.h = np, plant, simulator, plant.time_step()
        self._context = plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
        self._drives, self._before = [], None
        actuated = {plant.get_joint_actuator(k).joint().name() for k in plant.GetJointActuatorIndices()}
        for name, drive in drives.items():
            joint = plant.GetJointByName(name)
            if joint.type_name() != "revolute":
                raise JointError(f"{name!r} is not a hinge of the plant: it is {joint.type_name()}.")
            if drive.h != self.h:
                raise JointError(f"The drive of {name!r} has h = {drive.h:g} s, the plant {self.h:g} s.")
            if name in actuated:
                raise JointError(f"The joint {name!r} has an actuator; its motor is that of the drive: delete it.")
            self._drives.append((drive, joint.velocity_start(), joint.position_start()))
        self._applied, self._damping, self._per_step = np.zeros((3, plant.num_velocities()))
        self._per_step[[dof for _, dof, _ in self._drives]] = 1.0 / self.h
        for k in plant.GetJointIndices():
            joint = plant.get_joint(k)
            self._damping[joint.velocity_start() :][: joint.num_velocities()] = joint.default_damping_vector()

    def step(self, commands: Sequence[Sequence[float]]) -> None:
        """Move the plant by one step, with one command of `JointDrive.step` for each drive, in their order."""
        np, plant, context, applied = self._numpy, self.plant, self._context, self._applied
        angles, speeds = plant.GetPositions(context), plant.GetVelocities(context)
        inverse = np.linalg.inv(plant.CalcMassMatrix(context))
        smooth = plant.CalcGravityGeneralizedForces(context) - plant.CalcBiasTerm(context) - self._damping * speeds
        rates = np.zeros_like(smooth) if self._before is None else self._per_step * (smooth - self._before)
        self._before = smooth
        accelerations, changes, moved = inverse @ (smooth + applied), inverse @ rates, []
        for command, (drive, dof, place) in zip(commands, self._drives, strict=True):
            inertia = 1.0 / float(inverse[dof, dof])
            force, slope = inertia * float(accelerations[dof]) - float(applied[dof]), inertia * float(changes[dof])
            torque, angle = drive.step(command, float(angles[place]), float(speeds[dof]), inertia, force, slope)
            moved.append((dof, place, torque, angle))
        for dof, _, torque, _ in moved:
            applied[dof] = torque
        plant.get_applied_generalized_force_input_port().FixValue(context, applied + 0.5 * self.h * rates)
        steps = round(self.simulator.get_context().get_time() / self.h)
        self.simulator.AdvanceTo((steps + 1) * self.h)  # exactly to its next update
        angles = plant.GetPositions(context)
        for _, place, _, angle in moved:
            angles[place] = angle
        plant.SetPositions(context, angles)
