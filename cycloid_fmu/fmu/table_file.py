"""Data shared by the C code of a native FMU and this package: the file of tables, and the numbers of `constants.h`.

The file (`resource_file`): interface and variables; ratio, period, first stage, torques; and for each direction, crank
angle and load the transmission error, its derivative with respect to the load, the square of the largest pressure (each
in whole steps of 16 bits) and the contact count. The C code uses them in place, after summing the transmission error's
differences from angle to angle.
"""

from __future__ import annotations

import dataclasses
import inspect
import re
import struct
from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.fmu import constants
from cycloid_fmu.fmu.friction import FLANGES, Law
from cycloid_fmu.fmu.resource_file import (
    CAUSALITIES,
    COMPENSATOR,
    DRIVE,
    HEAD,
    KINDS,
    padding,
    sealed,
    variable_bytes,
)
from cycloid_fmu.fmu.variables import ATTRIBUTES, STRAINS, Interface, LossRipple, Variable
from cycloid_fmu.geometry.first_stage import FirstStage

if TYPE_CHECKING:
    from cycloid_fmu.fmu.tables import Tables

_INTERFACES = ("kinematic", "compliant", "inertia", "rotor")
_FIELDS = (
    "crank_angle",
    "crank_speed",
    "crank_torque",
    "output_angle",
    "output_speed",
    "torque",
    "transmission_error",
    "backlash",
    "torsional_stiffness",
    "max_contact_pressure",
    "contact_count",
    "series_compliance",
    "temperature",
    "temperature_start",
    "temperature_rate",
    "ambient_temperature",
    "heat_flow",
    "thermal_resistance",
    "heat_capacity",
    "lubricant_viscosity_40",
    "lubricant_viscosity_100",
    "lubricant_temperature",
    "power_loss",
    "backlash_on",
    "elastic_energy",
    "dissipated_energy",
    "mesh_damping",
    "largest_step",
    "output_inertia",
    "crank_inertia",
    "crank_angle_start",
    "crank_speed_start",
    "arm_angle",
    "arm_torque_rate",
    "motor_stiffness",
    "motor_damping",
    "outside_range",
    "support_angle",
    "support_speed",
    "support_torque",
    "time",
    "crank_acceleration",
    "output_acceleration",
    "transmission_error_rate",
    *(f"event_indicator_{i}" for i in range(1, constants.EVENT_INDICATORS + 1)),
    *(f"{name}_{i}" for name in STRAINS for i in range(1, constants.FRICTION_ELEMENTS + 1)),
    *(f"{name}_rate_{i}" for name in STRAINS for i in range(1, constants.FRICTION_ELEMENTS + 1)),
    *(f"{flange}_friction_{name}" for flange in FLANGES for name in Law._fields),
    "loss_table",
)

_SHARED = {
    "friction_torque": "output_friction.coulomb",
    "heat_port.T": "temperature",
    "arm_inertia": "output_inertia",
    "arm_torque": "torque",
}
"""Variables whose field in the C model is another variable's in other FMUs."""


def constants_header() -> bytes:
    """Return `constants.h`."""
    numbers = re.findall(r"^([A-Z]\w*) = (\S+)  # (.+)$", inspect.getsource(constants), re.MULTILINE)
    enums = {
        "kind": ("KIND_", KINDS),
        "causality": ("CAUSALITY_", CAUSALITIES),
        "interface_kind": ("INTERFACE_", _INTERFACES),
        "field": ("", _FIELDS),
    }
    lines = [
        "/* Made of cycloid_fmu/fmu/constants.py and cycloid_fmu/fmu/table_file.py. */",
        "#ifndef CYCLOID_CONSTANTS_H",
        "#define CYCLOID_CONSTANTS_H",
        "",
        *(f"#define {name} {value} /* {meaning} */" for name, value, meaning in numbers),
        *(
            line
            for resource in (DRIVE, COMPENSATOR)
            for line in (
                f'#define {resource.prefix}_FILE "{resource.file}"',
                '#define {}_MAGIC "{}"'.format(resource.prefix, resource.magic.replace("\n", "\\n")),
            )
        ),
        f"#define TABLE_HEAD {HEAD.size}",
        *(
            f"enum {name} {{ {', '.join(f'{start}{v.upper()}' for v in values)} }};"
            for name, (start, values) in enums.items()
        ),
        "",
        "#endif",
        "",
    ]
    return "\n".join(lines).encode()


def table_body(
    tables: Tables, interface: Interface, variables: Mapping[int, Variable], first_stage: FirstStage | None = None
) -> bytes:
    """Return the body of the file of tables, for `resource_file.sealed`.

    Parameters
    ----------
    interface
        The FMU's interface.
    variables
        The FMU's variables by value reference, which are 0, 1, 2, ….
    first_stage
        The first stage of an RV reducer.

    Raises
    ------
    ValueError
        If the range of values exceeds 16 bits.
    """
    sides = (tables.positive, tables.negative)
    rest = tables.rest_torque if tables.rest_torque.any() else np.empty(0)
    counts = [count for s in sides for count in (s.load.size + 1, s.pressure_load.size)]
    body = _head(interface, variables, (tables.ratio, tables.period, tables.allowed), first_stage)
    body += struct.pack("<7I", tables.rest_torque.size, tables.positive.pressure.shape[1], rest.size, *counts)
    body += padding(body)
    for side in sides:
        far, far_transmission_error, far_compliance = side.far
        steps = [np.append(s, s[-1]) for s in side.steps[:2]]
        transmission_error = np.vstack([side.transmission_error, far_transmission_error])
        base = np.round(0.5 * (transmission_error.min(axis=1) + transmission_error.max(axis=1)) / steps[0]) * steps[0]
        for numbers in (np.append(side.load, far), side.pressure_load, base, *steps, side.steps[2]):
            body += numbers.astype("<f8").tobytes()
        whole = np.round((transmission_error - base[:, None]) / steps[0][:, None])
        if not np.abs(whole).max() < 32768.0:
            raise ValueError("the accuracy is finer than a file of tables can store")
        # Differences from angle to angle compress to half the size of the numbers themselves.
        body += _words(np.diff(whole, axis=1, prepend=0.0) % 65536.0)
        body += _words(np.round(np.vstack([side.compliance, far_compliance]) / steps[1][:, None]))
        body += _words(np.round(side.pressure / side.steps[2][:, None]))
        body += side.contact_count.T.astype("u1").tobytes()
        body += padding(body)
    return bytes(body + rest.astype("<f8").tobytes())


def described(
    interface: Interface,
    variables: Mapping[int, Variable],
    ratio: float,
    period: float,
    first_stage: FirstStage | None = None,
) -> bytes:
    """Return a file without tables, for a drive with exact contacts.

    Parameters
    ----------
    interface, variables, first_stage
        As for `table_body`.
    ratio, period
        Ratio of the cycloid stage, signed, and the crank angle after which it repeats, rad.
    """
    head = _head(interface, variables, (ratio, period, 0.0), first_stage)
    return sealed(bytes(head + struct.pack("<7I", *(0,) * 7)), "", DRIVE)


def _head(
    interface: Interface,
    variables: Mapping[int, Variable],
    numbers: tuple[float, float, float],
    first_stage: FirstStage | None,
) -> bytearray:
    """Return the interface and its variables; and ratio, period and allowed error with the numbers of a first stage."""
    inertias = "inertia" if interface.output_inertia > 0.0 else "rotor" if interface.rotor_alone else "compliant"
    offered = "kinematic" if interface.kind == "kinematic" else inertias
    body = bytearray(struct.pack("<I", _INTERFACES.index(offered)) + variable_bytes(variables.values(), _field))
    stage = (0.0, 0.0, 0.0, 0.0) if first_stage is None else dataclasses.astuple(first_stage)[:4]
    return body + struct.pack("<7d", *numbers, *stage) + _ripple(interface.loss_ripple)


def _ripple(ripple: LossRipple | None) -> bytes:
    if ripple is None:
        return struct.pack("<3I", 0, 0, 0)
    numbers = np.concatenate([ripple.orders, ripple.speeds, ripple.loads, np.ravel(ripple.parts)])
    return (
        struct.pack("<3I", len(ripple.orders), len(ripple.speeds), len(ripple.loads)) + numbers.astype("<f8").tobytes()
    )


def _field(variable: Variable) -> int:
    """Field of a variable in the C model; -1 if it is fixed in the tables."""
    cell = re.fullmatch(r"loss_table\[(\d+),(\d+)\]", variable.name)
    if cell:
        return _FIELDS.index("loss_table") + (int(cell[1]) - 1) * constants.LOSS_COLUMNS + int(cell[2]) - 1
    name = _SHARED.get(variable.name, variable.name)
    name = re.sub(r"\[(\d+)\]", r"_\1", ATTRIBUTES.get(name, name)).replace(".", "_")
    return -1 if variable.baked else _FIELDS.index(name)


def _words(whole: NDArray[np.float64]) -> bytes:
    """Return whole numbers, shape (loads, angles), as unsigned 16 bits, the loads of an angle side by side."""
    if whole.min() < 0.0 or whole.max() >= 65536.0:
        raise ValueError("the accuracy is finer than a file of tables can store")
    return np.ascontiguousarray(whole.T).astype("<u2").tobytes()
