"""The table of all FMU variables, the source of slaves and model descriptions, Python or native, FMI 2.0 or 3.0.

Names follow Modelica.Mechanics.Rotational; torques are positive into the drive at their flange. A variable's index in
the table is its value reference. Variables that only FMI 3.0 has, `time` and the arrays, are last, so that a scalar has
the same reference in both versions.
"""

from __future__ import annotations

import dataclasses
import functools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.edge import Config, packaged_rows
from cycloid_fmu.errors.kinds import KINDS, ErrorKind, kind_of, names_of, wave_of
from cycloid_fmu.fmu.constants import COLDEST, FRICTION_ELEMENTS, HOTTEST, REFERENCE_TEMPERATURE, SUGGESTED_STEP
from cycloid_fmu.fmu.friction import FLANGES, Law
from cycloid_fmu.fmu.friction_file import LIMITS, Friction
from cycloid_fmu.geometry.losses import Lubricant
from cycloid_fmu.geometry.pair import Pair
from cycloid_fmu.geometry.thermal import Thermal
from cycloid_fmu.surfaces.structured import structured_value

InterfaceKind = Literal["kinematic", "compliant"]
Kind = Literal["real", "integer", "boolean"]
INTERFACES: tuple[InterfaceKind, ...] = ("kinematic", "compliant")
LossRow = tuple[float, float, float, float, float]  # of Modelica's `LossyGear.lossTable`
LOSSLESS: tuple[LossRow, ...] = ((0.0, 1.0, 1.0, 0.0, 0.0),)
FRICTIONLESS = Friction()


class LossRipple(Config):
    """What losses take more than their mean at a crank angle: a torque at `flange_a`, N·m.

    Attributes
    ----------
    orders
        Of the crank's turn relative to the ring. They need not be whole: those of the crank's bearings are so relative
        to the output carrier.
    speeds
        |w| of `flange_a`, rad/s, at which it is stated, ascending from 0; times ν(T)/ν_ref where there is a lubricant.
        It is linear between them, and as at the last one above it.
    loads
        Torques of the teeth at `flange_a` at which it is stated, N·m, ascending from 0; it is linear between them.
    parts
        Cosine and sine part, N·m, shape (speeds, 2, 2, loads, orders, 2): by the sign of that torque, positive first,
        and by which flange drives, `flange_a` first.
    """

    orders: tuple[float, ...]
    speeds: tuple[float, ...]
    loads: tuple[float, ...]
    parts: tuple[tuple[tuple[tuple[tuple[tuple[float, float], ...], ...], ...], ...], ...]

    def torque(self, crank_angle: NDArray[np.float64], load: float, drives: bool, speed: float) -> NDArray[np.float64]:
        """Return the torque at crank angles (rad), N·m, as `fmu/clockwork/losses.c` has it.

        `load` is the torque of the teeth at `flange_a`, N·m, `drives` whether this flange does, `speed` as `speeds`.
        """
        of_speed = np.array(self.parts)[:, int(load < 0.0), int(not drives)]
        weights = [np.interp(speed, self.speeds, of_node) for of_node in np.eye(len(self.speeds))]
        parts = np.tensordot(weights, of_speed, 1)
        cosine, sine = (
            [np.interp(abs(load), self.loads, of_order) for of_order in part.T] for part in np.moveaxis(parts, 2, 0)
        )
        turn = np.multiply.outer(crank_angle, self.orders)
        torque: NDArray[np.float64] = np.cos(turn) @ cosine + np.sin(turn) @ sine
        return torque


ADDED: dict[str, type[Config]] = {"lubricant": Lubricant, "thermal": Thermal, "loss_ripple": LossRipple}
"""Values of an `Interface` that the resources of an FMU contain only if they are stated."""
# Attributes of the models for variables with a different name.
ATTRIBUTES = {
    "flange_a.phi": "crank_angle",
    "flange_a.w": "crank_speed",
    "flange_a.tau": "crank_torque",
    "flange_b.phi": "output_angle",
    "flange_b.w": "output_speed",
    "flange_b.tau": "torque",
    "flange_a.a": "crank_acceleration",
    "flange_b.a": "output_acceleration",
    "support.phi": "support_angle",
    "support.w": "support_speed",
    "support.tau": "support_torque",
    "heat_port.T_rate": "temperature_rate",
    "heat_port.Q_flow": "heat_flow",
}

# With a support flange the flanges' angles and speeds are absolute.
ABSOLUTE = {
    "flange_a.phi": "absolute_crank_angle",
    "flange_a.w": "absolute_crank_speed",
    "flange_b.phi": "absolute_output_angle",
    "flange_b.w": "absolute_output_speed",
}

HEAT_STATE = "heat_port.T"
STRAINS = tuple(f"{flange}_friction_strain" for flange in FLANGES)  # strains of friction elements, in Model Exchange

# unit: exponents of SI base units, then display units with their factor
UNITS: dict[str, tuple[dict[str, int], dict[str, float]]] = {
    "rad": ({"rad": 1}, {"deg": 180 / np.pi, "arcmin": 10800 / np.pi, "arcsec": 648000 / np.pi}),
    "rad/s": ({"rad": 1, "s": -1}, {"rev/min": 30 / np.pi, "deg/s": 180 / np.pi}),
    "rad/s2": ({"rad": 1, "s": -2}, {}),
    "N.m": ({"kg": 1, "m": 2, "s": -2}, {}),
    "N.m/rad": ({"kg": 1, "m": 2, "s": -2, "rad": -1}, {"N.m/arcmin": np.pi / 10800}),
    "N.m/s": ({"kg": 1, "m": 2, "s": -3}, {}),
    "N.m.s/rad": ({"kg": 1, "m": 2, "s": -1, "rad": -1}, {}),
    "rad/(N.m)": ({"kg": -1, "m": -2, "s": 2, "rad": 1}, {"arcsec/(N.m)": 648000 / np.pi}),
    "kg.m2": ({"kg": 1, "m": 2}, {}),
    "N": ({"kg": 1, "m": 1, "s": -2}, {}),
    "Pa": ({"kg": 1, "m": -1, "s": -2}, {"MPa": 1e-6}),
    "W": ({"kg": 1, "m": 2, "s": -3}, {}),
    "J": ({"kg": 1, "m": 2, "s": -2}, {}),
    "m": ({"m": 1}, {"um": 1e6, "mm": 1e3}),
    "m2/s": ({"m": 2, "s": -1}, {"mm2/s": 1e6}),
    "K": ({"K": 1}, {}),
    "K/s": ({"K": 1, "s": -1}, {}),
    "K/W": ({"K": 1, "kg": -1, "m": -2, "s": 3}, {}),
    "J/K": ({"kg": 1, "m": 2, "s": -2, "K": -1}, {"kJ/K": 1e-3}),
    "1/K": ({"K": -1}, {"%/K": 100.0}),
    "s": ({"s": 1}, {"ms": 1e3, "h": 1.0 / 3600.0}),
    "1": ({}, {"%": 100.0}),
}


@dataclass(frozen=True)
class Interface:
    """The interface of an FMU.

    Attributes
    ----------
    kind
        "kinematic": crank angle and speed, output torque in; output angle and speed, crank torque out.
        "compliant": angles and speeds of both flanges in, torques of both out.
    output_inertia
        Internal moment of inertia on the output of a compliant FMU, kg·m²; if it is above 0, the output flange takes a
        torque and gives angle and speed, as in the kinematic interface.
    crank_inertia
        Internal moment of inertia on the crank of a compliant FMU, kg·m²; if it is above 0, that flange takes a torque
        and gives angle and speed. With `output_inertia` the importing tool has no stiff contact to solve. Without, the
        arm stays in the tool, and the FMU takes its motion, its `arm_inertia` and the other torques on it.
    mesh_damping
        Start value of the contacts' damping in a compliant FMU, N·m·s/rad at the output; None for 0.1 ms times the
        stiffness at the rated torque, which is an assumption: vibration at resonance is inversely proportional to it.
    losses
        Rows of Modelica's `LossyGear.lossTable`: |w| of flange_a (rad/s, ascending from 0), efficiency while power
        flows from a to b and from b to a (dimensionless), friction torque at flange_a in the same two cases (N·m).
        Where neither these nor friction are stated, a build takes both from the `[losses]` of a pair with `[supports]`.
    driven
        Shaft at `flange_a`: "crank", or "sun" of an RV reducer.
    stiffness
        Stiffness of the whole drive from a catalogue or a measured loop, N·m/rad; `series_compliance` is computed from
        it. None for the pair's `catalogue_stiffness`, if it has one.
    support_flange
        Whether the housing can turn and has a flange; the other flanges' angles and speeds are then absolute.
    series_compliance
        Start value of the parameter of this name, rad/(N·m).
    own_stiffness
        Stiffness of the modelled drive, N·m/rad, computed during the build (`fmu.chain.own_stiffness`).
    input_friction, output_friction
        Friction at `flange_a`, where it adds to the losses, and at `flange_b` (`friction_file.Friction`).
    lubricant
        With it the losses are those of the table at |w| times its viscosity over that at its own temperature.
    loss_ripple
        What they take more or less at a crank angle, made from `[losses]` with them.
    thermal
        With its capacity, which must be stated, the temperature of the oil is a state of the FMU, which has a heat
        port. None for that of a pair with `[losses]`, if it states a capacity.

    Examples
    --------
    >>> import cycloid_fmu as cy
    >>> pair = cy.Pair(
    ...     gear_teeth=39, pin_circle_radius="64 mm", pin_radius="3 mm", eccentricity="1.3 mm", face_width="10 mm"
    ... )
    >>> cy.Drive(pair).build_fmu("arm.fmu", interface=cy.Interface("compliant", output_inertia=2.0))
    """

    kind: InterfaceKind = "kinematic"
    output_inertia: float = 0.0
    losses: tuple[LossRow, ...] = LOSSLESS
    driven: Literal["crank", "sun"] = "crank"
    crank_inertia: float = 0.0
    mesh_damping: float | None = None
    stiffness: float | None = None
    series_compliance: float = 0.0
    own_stiffness: float | None = None
    support_flange: bool = False
    input_friction: Friction = FRICTIONLESS
    output_friction: Friction = FRICTIONLESS
    lubricant: Lubricant | None = None
    thermal: Thermal | None = None
    loss_ripple: LossRipple | None = None

    @property
    def rotor_alone(self) -> bool:
        """Whether the crank's inertia is inside and the output's is not."""
        return self.crank_inertia > 0.0 and self.output_inertia == 0.0

    @property
    def laws(self) -> tuple[Law, Law]:
        """Friction at both flanges."""
        return self.input_friction.law(0), self.output_friction.law(1)

    @property
    def warms(self) -> bool:
        """Whether friction depends on temperature, which is then an input of the FMU."""
        return self.lubricant is not None or self.scaled

    @property
    def scaled(self) -> bool:
        """Whether a temperature coefficient is stated."""
        return any(law.temperature_coefficient != 0.0 for law in self.laws)

    @property
    def step(self) -> float:
        """Suggested communication step, s; shorter if stiff contacts connect external inertias."""
        both_outside = self.output_inertia == 0.0 and self.crank_inertia == 0.0
        return SUGGESTED_STEP if self.kind == "compliant" and both_outside else 1e-3


@dataclass(frozen=True)
class Variable:
    """One variable of the FMU.

    Attributes
    ----------
    name, description
        As in the model description.
    causality, variability
        As defined by FMI; both versions use the same words.
    unit, display
        SI unit and display unit, keys of `UNITS`; None if there is none.
    least, most, nominal
        Limits and nominal value, SI; None without a physical limit.
    start
        Start value of inputs and parameters, SI; row by row for an array.
    depends
        Names of the inputs that an output depends on after initialisation.
    initially
        Names of the parameters that it depends on as well during initialisation.
    kind
        "real", "integer" or "boolean".
    dimensions
        Dimensions of an array, which only FMI 3.0 has; () for a scalar.
    baked
        Whether it is fixed in a native FMU's tables, where it can be read but not set.
    derivative_of
        Name of the variable of which it is the time derivative.
    """

    name: str
    description: str
    causality: Literal["input", "output", "parameter", "independent", "local"]
    variability: Literal["continuous", "discrete", "tunable", "fixed", "constant"] = "continuous"
    unit: str | None = None
    display: str | None = None
    least: float | None = None
    most: float | None = None
    nominal: float | None = None
    start: float | tuple[float, ...] | None = None
    depends: tuple[str, ...] = ()
    initially: tuple[str, ...] = ()
    kind: Kind = "real"
    dimensions: tuple[int, ...] = ()
    baked: bool = False
    derivative_of: str | None = None


DAMPING_RATIOS = (0.03, 0.17)
"""Damping ratios of gear meshes (R. Kasuba and J. W. Evans, J. Mech. Des. 103 (1981) 398)."""


def stiffness_text(pair: Pair, interface: Interface) -> str:
    """Return the text on an FMU's stiffness for its description."""
    text = "mesh alone, rigid bodies" if pair.supports is None else "contacts and bearings alone"
    if interface.own_stiffness is not None:
        own, series, arcmin = interface.own_stiffness, interface.series_compliance, UNITS["N.m/rad"][1]["N.m/arcmin"]
        text += f": {own * arcmin:.4g} N.m/arcmin"
        if series > 0.0:
            text += f", {arcmin / (1.0 / own + series):.4g} with the start value of series_compliance"
    return text


def listed_variables(package: str) -> dict[str, Variable]:
    """Return the variables of a package's `variables.csv` by name; an empty cell is the default of `Variable`."""
    numbers, listed = ("least", "most", "nominal", "start"), dict[str, Variable]()
    for row in packaged_rows(package, "variables.csv"):
        stated: dict[str, Any] = {key: float(cell) if key in numbers else cell for key, cell in row.items() if cell}
        listed[row["name"]] = Variable(**{"description": "", "causality": "local", **stated})
    return listed


@functools.cache
def _listed() -> dict[str, Variable]:
    return listed_variables("cycloid_fmu.fmu")


def _variable(name: str, of: str = "", **changes: Any) -> Variable:
    """Return a variable of the list, with `of` in its description, and changed as drive and interface have it."""
    listed = _listed()[name]
    return dataclasses.replace(listed, **{"description": listed.description.format(of=of), **changes})


def _flanges(pair: Pair, interface: Interface) -> list[Variable]:
    driven, dynamic = interface.driven, interface.kind == "compliant"
    inside, both = not dynamic or interface.output_inertia > 0.0, interface.crank_inertia > 0.0
    moved = dynamic and inside  # by internal inertias: all outputs depend on their state, not on inputs

    def motion(end: str, what: str, causality: Literal["input", "output"]) -> list[Variable]:
        changes: dict[str, Any] = {"causality": causality, "start": 0.0 if causality == "input" else None}
        angle, speed = (_variable(f"flange_{end}.{name}", what, **changes) for name in ("phi", "w"))
        if end == "b" and not dynamic:  # the speed is not the derivative of an angle that also depends on the torque
            text = f"{speed.description} at the present torque"
            speed = dataclasses.replace(speed, derivative_of=None, description=text)
        return [angle, speed]

    def torque(end: str, text: str, causality: Literal["input", "output"], depends: tuple[str, ...] = ()) -> Variable:
        start = 0.0 if causality == "input" else None
        return _variable(f"flange_{end}.tau", description=text, causality=causality, start=start, depends=depends)

    hosted = both and not inside  # the arm is in the host: torque and motion of the drive belong to the last step
    tau_b = "torque of the environment on the output, counter-clockwise" + (
        ", mean over the last step" if hosted else ""
    )
    tau_a = f"torque required at the {driven}" + (", mean over the last step" if moved and not both else "")
    taken = [torque("a", f"torque on the {driven}", "input")] if both else motion("a", driven, "input")
    taken += [torque("b", tau_b, "input")] if inside else motion("b", "output", "input")
    every = () if moved else tuple(v.name for v in taken if v.name != "flange_a.tau")
    if hosted:  # what a step takes of the arm in the host and of the motor's controller
        names = ("arm_inertia", "arm_torque", "arm_torque_rate", "motor_stiffness", "motor_damping")
        taken += [_variable(name, driven) for name in names]
    placed = tuple(n for n in every if not n.endswith(".w"))
    given = motion("a", driven, "output") if both else []
    if inside:
        angle, speed = motion("b", "output", "output")
        given += [dataclasses.replace(angle, depends=placed), dataclasses.replace(speed, depends=every)]
    given += [] if both else [torque("a", tau_a, "output", depends=every)]
    given += [] if inside else [torque("b", tau_b, "output", depends=() if hosted else every)]
    given += [_variable("arm_angle")] if hosted else []
    crank = () if both or moved else ("flange_a.phi",)
    return [
        *taken,
        *given,
        _variable("transmission_error", driven, depends=placed),
        _variable("backlash", driven, depends=crank),
        _variable("torsional_stiffness", stiffness_text(pair, interface), depends=placed),
        _variable("max_contact_pressure", depends=placed),
    ]


def _error(kind: ErrorKind, name: str, start: float | tuple[float, ...], text: str = "") -> Variable:
    """Return the parameter of an error, of which a description may say more."""
    display, nominal = ("arcsec", 1e-4) if kind.unit == "rad" else ("um", 1e-6)
    variable = Variable(name, kind.description + text, "parameter", "tunable", kind.unit, display, baked=True)
    return dataclasses.replace(variable, least=-kind.limit, most=kind.limit, nominal=nominal, start=start)


def _parameters(drive: DriveValue, interface: Interface) -> list[Variable]:
    table = []
    for name in names_of(drive.pair):
        kind, wave = kind_of(name), wave_of(name)
        assert kind is not None
        text = "" if wave is None else f": {'cosine' if wave[2] == 'cos' else 'sine'} part of order {wave[1]}"
        table.append(_error(kind, name, structured_value(drive.surface, name), text))
    return [
        *table,
        _variable("friction_torque", start=interface.laws[1].coulomb),
        _variable("series_compliance", start=interface.series_compliance),
    ]


_LOSS_COLUMNS: tuple[tuple[str, str, str | None, float, float | None], ...] = (
    ("speed of flange_a, ascending from 0", "rad/s", "rev/min", 0.0, None),
    ("efficiency while power flows from flange_a to flange_b", "1", "%", 1e-3, 1.0),
    ("efficiency while power flows from flange_b to flange_a", "1", "%", 0.0, 1.0),
    ("friction torque at flange_a while power flows from a to b", "N.m", None, 0.0, None),
    ("friction torque at flange_a while power flows from b to a", "N.m", None, 0.0, None),
)


def _further(interface: Interface) -> list[Variable]:
    """Variables added after the first version, last so that earlier references do not change."""
    moving: tuple[str, ...] = ()
    if interface.output_inertia == 0.0 and not interface.rotor_alone:
        of_output = ("flange_b.tau",) if interface.kind == "kinematic" else ("flange_b.phi", "flange_b.w")
        moving = ("flange_a.phi", "flange_a.w", *of_output)
    table = [_variable("power_loss", depends=moving), _variable("backlash_on")]
    for i, row in enumerate(interface.losses, start=1):
        for j, (value, (text, unit, display, least, most)) in enumerate(zip(row, _LOSS_COLUMNS, strict=True), start=1):
            name, text = f"loss_table[{i},{j}]", f"losses, row {i}: {text}"
            table.append(Variable(name, text, "parameter", "fixed", unit, display, least, most, 1.0, value))
    if interface.kind == "kinematic":
        return table
    taken = ("flange_b.phi",) if interface.rotor_alone else ("flange_a.phi", "flange_b.phi")
    still = () if interface.output_inertia > 0.0 else taken
    low, high = DAMPING_RATIOS
    table += [
        _variable("elastic_energy", depends=still),
        _variable("dissipated_energy"),
        _variable("mesh_damping", f"{low:g} to {high:g}", start=interface.mesh_damping or 0.0),
        _variable("largest_step"),
    ]
    for name in ("output_inertia", "crank_inertia"):
        if (inertia := getattr(interface, name)) > 0.0:
            table.append(_variable(name, interface.driven, nominal=inertia, start=inertia))
    if interface.crank_inertia > 0.0:
        table += [_variable(name, interface.driven) for name in ("crank_angle_start", "crank_speed_start")]
    return table


def _information(pair: Pair, placed: tuple[str, ...], ratio: float) -> list[Variable]:
    """Information for the surrounding model."""
    table = [_variable("outside_range", depends=placed), _variable("ratio", start=ratio, baked=True)]
    if pair.rated_torque is not None:
        table.append(_variable("rated_torque", start=pair.rated_torque, baked=True))
    return table


def _kelvin(
    name: str, text: str, causality: Literal["input", "output", "parameter"], start: float | None = None
) -> Variable:
    fixed: Literal["fixed", "continuous"] = "fixed" if causality == "parameter" else "continuous"
    return Variable(name, text, causality, fixed, "K", None, COLDEST, HOTTEST, 300.0, start)


def _friction(interface: Interface) -> list[Variable]:
    """Friction parameters at both flanges, and the temperature if friction depends on it."""
    texts = {
        "coulomb": "Coulomb friction",
        "load_share": "additional friction per N.m of the teeth's torque at that flange",
        "stribeck": "additional friction at rest, proportional to exp(-(w/stribeck_speed)^2)",
        "stribeck_speed": "speed at which the additional friction at rest has decreased to 1/e",
        "viscous": "viscous friction",
        "presliding_angle": "angle over which friction builds up under the rated torque",
        "temperature_coefficient": "b: friction is proportional to exp(-b (temperature - reference_temperature))",
        "reference_temperature": "reference temperature of the friction",
    }
    displays = {"stribeck_speed": "rev/min", "load_share": "%", "presliding_angle": "arcsec"}
    table = []
    for flange, end, law in zip(FLANGES, "ab", interface.laws, strict=True):
        for name, text in texts.items():
            if (flange == "output" and name == "coulomb") or ("temperature" in name and not interface.scaled):
                continue
            unit, least, most, nominal = LIMITS[name]
            key, meaning, start = f"{flange}_friction.{name}", f"at flange_{end}: {text}", getattr(law, name)
            shown = displays.get(name)
            table.append(Variable(key, meaning, "parameter", "tunable", unit, shown, least, most, nominal, start))
    lubricant = interface.lubricant
    if lubricant is not None:
        table += _lubricant(lubricant)
    if interface.thermal is not None:
        table += _heat_port(interface.thermal)
    elif interface.warms:
        text = "temperature of the sliding parts" if lubricant is None else "temperature of the oil"
        start = REFERENCE_TEMPERATURE if lubricant is None else lubricant.temperature
        table.append(_kelvin("temperature", text, "input", start))
    return table


def _heat_port(thermal: Thermal) -> list[Variable]:
    """Variables of the heat capacity: a heat port as Modelica's, and what the surroundings take."""
    return [
        _kelvin("heat_port.T", "temperature of the oil", "output"),
        _variable("heat_port.Q_flow"),
        _kelvin("ambient_temperature", "temperature of the surroundings", "input", thermal.ambient),
        _kelvin("temperature_start", "temperature of the oil at the start", "parameter", thermal.ambient),
        _variable("thermal_resistance", start=thermal.whole),
        _variable("heat_capacity", start=thermal.capacity),
    ]


def _lubricant(lubricant: Lubricant) -> list[Variable]:
    """Parameters of the viscosity over the temperature, which multiplies the speed in the loss table."""
    text = "lubricant: temperature at which loss_table is stated"
    return [
        _variable("lubricant.viscosity_40", start=lubricant.viscosity_40),
        _variable("lubricant.viscosity_100", start=lubricant.viscosity_100),
        _kelvin("lubricant.temperature", text, "parameter", lubricant.temperature),
    ]


def _with_support(table: Sequence[Variable], inside: bool) -> list[Variable]:
    """Add the housing's flange; variables that depend on the driven shaft's motion also depend on the housing's."""
    follows = {"flange_a.phi": "support.phi", "flange_a.w": "support.w"}
    following = [
        dataclasses.replace(v, depends=(*v.depends, *(other for name, other in follows.items() if name in v.depends)))
        for v in table
    ]
    given = () if inside else (*(v.name for v in table if v.causality == "input"), *follows.values())
    torque = _variable("support.tau", depends=given)
    text = torque.description + (", mean over the last step" if inside else "")
    torque = dataclasses.replace(torque, description=text)
    return [*following, _variable("support.phi"), _variable("support.w"), torque]


def _arrays(drive: DriveValue, placed: tuple[str, ...]) -> list[Variable]:
    pair, surface = drive.pair, drive.surface
    table = [Variable("time", "time", "independent", unit="s")]
    for name in ("pin_force", "pin_pressure"):
        table.append(_variable(name, depends=placed, dimensions=(pair.discs, pair.pins)))
    for kind in KINDS.values():
        if kind.of == "pin":
            values = _error(kind, kind.name, tuple(map(float, surface.errors[kind.name])))
            table.append(dataclasses.replace(values, dimensions=(pair.pins,)))
    return table


def variables(
    drive: DriveValue,
    interface: Interface,
    fmi_version: Literal["2.0", "3.0"],
) -> tuple[Variable, ...]:
    """Return the FMU's variables; the index of each is its value reference.

    Parameters
    ----------
    drive
        The drive, whose errors are the start values of the parameters.
    interface
        The interface of the FMU.
    fmi_version
        With "3.0" `time` and the arrays follow the scalars of both versions.
    """
    pair = drive.pair
    flanges = _flanges(pair, interface)
    shape = next(v.depends for v in flanges if v.name == "transmission_error")
    count = _variable("contact_count", most=float(pair.pins * pair.discs), depends=shape)
    table = [*flanges, count, *_parameters(drive, interface), *_further(interface)]
    table += [*_information(pair, shape, drive.ratio), *_friction(interface)]
    if interface.support_flange:
        table = _with_support(table, interface.output_inertia > 0.0)
    if interface.warms and interface.thermal is None:
        # Friction determines the output's position, on which all of these depend.
        table = [
            dataclasses.replace(v, depends=(*v.depends, "temperature"))
            if v.depends and "temperature" not in v.depends
            else v
            for v in table
        ]
    shape = next(v.depends for v in table if v.name == "transmission_error")
    if fmi_version == "3.0":
        table += _arrays(drive, shape)
    errors = tuple(v.name for v in table if v.causality == "parameter" and v.baked)
    begins = () if interface.thermal is None else ("temperature_start",)
    shaping = (*errors, "series_compliance", "backlash_on", *begins)
    rubbing = tuple(
        v.name for v in table if v.name.startswith(("loss_table", "input_friction", "output_friction", "lubricant"))
    )
    lossy = (*shaping, *rubbing, "friction_torque")
    if interface.kind == "compliant":
        lossy = (*lossy, "mesh_damping")
    initially = {
        "backlash": (*errors, "backlash_on"),
        "power_loss": lossy,
        "flange_a.tau": lossy,
        "flange_b.tau": lossy,
        "support.tau": lossy,
        "dissipated_energy": (),
        "heat_port.T": begins,
    }
    return tuple(
        dataclasses.replace(v, initially=initially.get(v.name, shaping)) if v.causality == "output" else v
        for v in table
    )


def from_tables(table: Sequence[Variable]) -> dict[int, Variable]:
    """Return the variables of a native FMU, by value reference.

    Values that are fixed in its tables are constants, and there are no values of single pins.
    """
    constants = {v.name for v in table if v.baked}

    def native_variable(v: Variable) -> Variable:
        if v.name in constants:
            return dataclasses.replace(v, causality="local", variability="constant")
        return dataclasses.replace(v, initially=tuple(n for n in v.initially if n not in constants))

    return {reference: native_variable(v) for reference, v in enumerate(table) if not v.dimensions}


def states(interface: Interface) -> tuple[str, ...]:
    """Return the names of a native FMU's continuous states in Model Exchange, in order.

    With internal inertias the transmission error is a state in place of the output's angle, of which it is a millionth.
    A drive with a support flange has no states: it is for Co-Simulation only.
    """
    heat = () if interface.thermal is None else (HEAT_STATE,)
    if interface.support_flange:
        return ()
    if interface.kind == "kinematic":
        return heat
    crank = ("flange_a.phi", "flange_a.w") if interface.crank_inertia > 0.0 else ()
    moved = (*crank, "transmission_error", "flange_b.w") if interface.output_inertia > 0.0 else crank
    return (*moved, *_strains("input"), *_strains("output"), "dissipated_energy", *heat)


def _strains(flange: str, rate: str = "") -> tuple[str, ...]:
    return tuple(f"{flange}_friction_strain{rate}[{i}]" for i in range(1, FRICTION_ELEMENTS + 1))


_INDICATORS = {
    "kinematic": (
        "crosses zero when the torque reverses",
        "unused",
        "crosses zero when a torque leaves the tables",
        "crosses zero when the crank reverses",
        "unused",
    ),
    "compliant": (
        "crosses zero when the flank for positive torque makes contact",
        "crosses zero when the flank for negative torque makes contact",
        "crosses zero when a torque leaves the tables",
        "crosses zero when the crank reverses",
        "crosses zero when the output reverses",
    ),
}


# Long as it is a table of variables, in the order of their references.
def exchanged(
    by_reference: dict[int, Variable], interface: Interface, version: Literal["2.0", "3.0"]
) -> dict[int, Variable]:
    """Return the variables of a native FMU, {value reference: variable}, with those of Model Exchange last.

    Parameters
    ----------
    by_reference
        Variables from `from_tables`.
    """
    if interface.support_flange:
        return by_reference
    inside, dynamic = interface.output_inertia > 0.0, interface.kind == "compliant"
    moved = inside or interface.rotor_alone
    crank, output = _strains("input"), _strains("output")
    heat = () if interface.thermal is None else (HEAT_STATE,)
    warm = heat or (("temperature",) if interface.warms else ())
    contact = ("flange_a.phi", "transmission_error" if inside else "flange_b.phi")
    moving = (*contact, "flange_a.w", "flange_b.w", *warm)
    inputs = tuple(v.name for v in by_reference.values() if v.causality == "input")
    parameters = tuple(v.name for v in by_reference.values() if v.causality == "parameter")
    of_start = (*inputs, *parameters) if moved else inputs
    more = []

    def add(variable: Variable, depends: tuple[str, ...] = ()) -> None:
        more.append(dataclasses.replace(variable, depends=depends, initially=of_start))

    if interface.crank_inertia > 0.0:
        add(_variable("flange_a.a", interface.driven), (*moving, *crank, "flange_a.tau"))
    if inside:
        add(_variable("transmission_error_rate", interface.driven), ("flange_a.w", "flange_b.w"))
        add(_variable("flange_b.a"), (*moving, *output, "flange_b.tau"))
    for flange, law, end in zip(FLANGES if dynamic else (), interface.laws, "ab", strict=False):
        for name in _strains(flange):
            text = f"strain of a friction element at flange_{end}"
            add(Variable(name, text, "local", unit="rad", nominal=law.presliding_angle))
        for name, strain in zip(_strains(flange, "_rate"), _strains(flange), strict=True):
            text = f"strain rate of a friction element at flange_{end}"
            rate = Variable(name, text, "local", unit="rad/s", nominal=0.1, derivative_of=strain)
            add(rate, (*moving, strain))
    if heat:
        flows = ("heat_port.Q_flow", "ambient_temperature")
        heating = (*moving, *crank, *output, *flows) if dynamic else (*inputs, *heat)
        add(_variable("heat_port.T_rate"), heating)
    depends = {
        "flange_a.tau": (*moving, *crank),
        "power_loss": (*moving, *crank, *output),
        "elastic_energy": (*contact, *crank, *output),
        "dissipated_energy": ("dissipated_energy",),
    }
    if moved:
        placed = ("torsional_stiffness", "max_contact_pressure", "contact_count", "outside_range", "flange_b.phi")
        depends |= {**dict.fromkeys(placed, contact), "backlash": ("flange_a.phi",)}
        depends |= {name: (name,) for name in ("flange_a.phi", "flange_a.w", "flange_b.w")}
        depends |= {
            "transmission_error": ("transmission_error",) if inside else contact,
            "arm_angle": ("flange_b.phi",),
        }
    if not inside:
        depends["flange_b.tau"] = (*moving, *output)
    if not dynamic:  # friction determines the output's position
        depends = {v.name: (*v.depends, *heat) for v in by_reference.values() if v.depends}
    depends |= dict.fromkeys(heat, heat)
    changed = {
        reference: dataclasses.replace(
            v,
            depends=depends.get(v.name, v.depends),
            initially=of_start if moved else tuple(dict.fromkeys((*v.depends, *v.initially))),
            derivative_of="dissipated_energy" if dynamic and v.name == "power_loss" else v.derivative_of,
        )
        if v.causality == "output"
        else v
        for reference, v in by_reference.items()
    }
    if version == "3.0":
        for i, text in enumerate(_INDICATORS[interface.kind], start=1):
            more.append(Variable(f"event_indicator[{i}]", text, "local"))
    return {**changed, **{len(by_reference) + i: v for i, v in enumerate(more)}}
