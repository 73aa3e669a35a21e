"""Energy that elastic bodies store, with the laws of what presses them, and how both change with the crank angle.

At the balance e + C f = a the energy is the sum of all laws' ∫ f de and ½ fᵀC f. Its derivatives at fixed unknowns are
fᵀ ∂a/∂θ - ½ fᵀ dC/dθ f, and for each contact what the flank's curvature changes of its law (docs/theory/bodies.md).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cycloid_fmu import contact
from cycloid_fmu.contact import Array, Problem, Rows, compiled
from cycloid_fmu.contact.local_frame import crank_motion, gap_gradient, projection, turning_stiffness
from cycloid_fmu.contact.rows import disc_slice_pin
from cycloid_fmu.supports.bearing import stored
from cycloid_fmu.supports.elastic import pin_law, port_direction, solve_ports, write_rates
from cycloid_fmu.supports.influence import rate_of_energy
from cycloid_fmu.supports.joints import (
    FIRST_DISC,
    Assembly,
    Work,
    derivatives,
    displacement,
    turn_levers,
    turning_motion,
)
from cycloid_fmu.supports.ports import ALONG_X, ALONG_Y, PIN, Elastic, Ports


@compiled
def energy_of_ports(problem: Problem, assembly: Assembly, elastic: Elastic | None, contacts: Rows, ports: Any) -> float:
    """Energy of elastic bodies and of the laws at their ports, at a solved place, J; 0 if all bodies are rigid."""
    if elastic is None:
        return 0.0
    energy = 0.0
    for k in range(ports.counts[0]):
        number = ports.active[k]
        port = ports.ports[number]
        energy += 0.5 * port.force * (port.approach - port.deflection)
        if port.kind == PIN:
            pin = disc_slice_pin(problem, port.joint)[2]
            energy += pin_law(problem, elastic, contacts[port.joint], pin, port.force).energy
        elif port.kind == ALONG_X:
            length = math.hypot(port.deflection, ports.ports[number + 1].deflection)
            energy += stored(assembly.laws[port.law], length)
        elif port.kind != ALONG_Y:
            energy += port.force * port.deflection / (port.exponent + 1.0)
    return energy


@compiled
def pin_energy(
    problem: Problem, elastic: Elastic | None, contact_: np.record, pin: int, kappa: float
) -> tuple[float, float]:
    """Energy of a contact under load between rigid bodies, J, and its derivative by the flank's curvature, N·m².

    Between elastic bodies the energy is part of `energy_of_ports`, and 0 here. `kappa` is (V_c + V_p)/(πb), m/N.
    """
    force = contact_.force
    if elastic is None:
        energy = -0.5 * force * (contact_.gap + problem.seat_gap) - 0.25 * kappa * force * force
        return energy, 0.5 * force * contact_.force_by_curvature / contact_.stiffness
    return 0.0, pin_law(problem, elastic, contact_, pin, force).bent_energy


@compiled
def turn_ports(
    problem: Problem,
    assembly: Assembly,
    elastic: Elastic | None,
    crank_angle: float,
    centring: float,
    contacts: Rows,
    work: Work,
    by_angle: Array,
) -> float:
    """Add the derivatives by θ of the balance of all ports at fixed unknowns; return those of their energy, N·m.

    Of the bearings with ports it also has the centring springs; of pins the energy's derivative is not included, as it
    is that between rigid bodies.
    """
    if elastic is None:
        return 0.0
    ports: Any = work.ports
    write_rates(elastic, ports)
    turning, n = -rate_of_energy(elastic.influence, ports.moving, ports.of_slots), ports.counts[0]
    right = ports.right
    for k in range(n):
        port = ports.ports[ports.active[k]]
        right[k] = -ports.rates[port.slot]
        if port.kind == PIN:
            right[k] += _turn_pin(problem, crank_angle, contacts, port.joint, work, by_angle)
    for number in range(elastic.first.size):
        if elastic.ports_of_joint[number] > 0:
            turning += _turn_joint(assembly, number, centring, work, ports, by_angle)
    for k in range(n):
        port = ports.ports[ports.active[k]]
        if port.kind != PIN:
            right[k] += _approaching(assembly, port, crank_angle, work)
    solve_ports(ports, right)
    for k in range(n):
        for i in range(by_angle.size):
            by_angle[i] += right[k] * ports.by_coordinate[k, i]
    return turning


@compiled
def _turn_pin(problem: Problem, crank_angle: float, contacts: Rows, row: int, work: Work, by_angle: Array) -> float:
    """Derivative by θ of a pin's approach less that of its law; adds what turns its force."""
    contact_ = contacts[row]
    local = contact.local_frame(problem, crank_angle, work.coordinates[0], contacts, row)
    along, motion = gap_gradient(local), (*crank_motion(problem, local), -1.0 / problem.teeth)
    turned, first = turning_stiffness(contact_.force, local, along), FIRST_DISC + 3 * local.disc
    for i in range(3):
        by_angle[first + i] += projection(motion, turned[i])
    bent = contact_.force_by_curvature / contact_.stiffness * contact_.curvature_rate * local.foot
    return float(bent * projection(motion, along.slide) - projection(motion, along.gap))


@compiled
def _approaching(assembly: Assembly, port: np.record, crank_angle: float, work: Work) -> float:
    """Derivative by θ of the approach at a joint's port, m."""
    joint = assembly.joints[port.joint]
    rate = assembly.bodies[int(joint.outer)].rate
    d = displacement(assembly, joint, work)
    ax, ay = port_direction(joint, port, d, math.cos(rate * crank_angle), math.sin(rate * crank_angle))
    vx, vy = turning_motion(assembly, joint, d, work)
    approaching = ax * vx + ay * vy
    if joint.reach == 0.0:
        # The axes turn in which bearings press.
        approaching += rate * d.length * (ax * d.normal_y - ay * d.normal_x)
    return float(approaching)


@compiled
def _turn_joint(assembly: Assembly, number: int, centring: float, work: Work, ports: Ports, by_angle: Array) -> float:
    """Add what turns a joint's force, and its centring spring; return the energy's derivative but for the bodies."""
    joint = assembly.joints[number]
    rate = assembly.bodies[int(joint.outer)].rate
    d = displacement(assembly, joint, work)
    unknowns, index, by = derivatives(assembly, joint, d, work), work.indices, work.by
    vx, vy = turning_motion(assembly, joint, d, work)
    fx, fy = ports.of_joints[number, 0], ports.of_joints[number, 1]
    turning = fx * vx + fy * vy
    if joint.reach > 0.0:
        across = (fx * d.normal_x + fy * d.normal_y) / d.length
        normal = d.normal_x * vx + d.normal_y * vy
        gx, gy = across * (vx - normal * d.normal_x), across * (vy - normal * d.normal_y)
    else:
        turning += rate * d.length * (d.normal_y * fx - d.normal_x * fy)
        px, py = centring * d.length * d.normal_x, centring * d.length * d.normal_y
        turning += px * vx + py * vy
        gx, gy = centring * vx - rate * fy, centring * vy + rate * fx
        fx, fy = fx + px, fy + py
    for i in range(unknowns):
        by_angle[index[i]] += by[0, i] * gx + by[1, i] * gy
    turn_levers(assembly, joint, d, fx, fy, by_angle)
    return float(turning)
