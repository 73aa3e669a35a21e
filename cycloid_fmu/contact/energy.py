"""What the crank feels, and the energy that the contacts store."""

from __future__ import annotations

import math

from cycloid_fmu.contact.compiling import compiled
from cycloid_fmu.contact.equilibrium import behind_compliance, load, rotational_stiffness
from cycloid_fmu.contact.local_frame import (
    crank_motion,
    gap_gradient,
    local_frame,
    output_motion,
    projected_stiffness,
    torque_by_shift,
)
from cycloid_fmu.contact.placement import BOUNDED, CLEAR, place_contacts
from cycloid_fmu.contact.problem import Problem
from cycloid_fmu.contact.rows import Rows

_ROTATION_STEP = 1e-12  # rad: last step of the contacts behind a compliance


@compiled
def crank_side(problem: Problem, crank_angle: float, x: float, contacts: Rows) -> tuple[float, float]:
    """What the crank feels: its torque, and how its rotation moves the output at constant torque.

    With the elastic energy U(θ, φ_b) the environment's torque is ∂U/∂φ_b and the crank's is ∂U/∂θ at fixed φ_b.

    Returns
    -------
    crank_torque, output_rate
        ∂U/∂θ (N·m) and dφ_b/dθ at constant torque (1; NaN without contact).
    """
    crank_torque = coupling = stiffness = 0.0
    for row in range(contacts.shape[0]):
        contact = contacts[row]
        force = contact.force
        if force <= 0.0:
            continue
        local = local_frame(problem, crank_angle, x, contacts, row)
        along, (u, v) = gap_gradient(local), crank_motion(problem, local)
        crank_torque -= force * (along.gap[0] * u + along.gap[1] * v)
        by_position = projected_stiffness(contact, local, along, output_motion(problem, local))
        by_u, by_v = torque_by_shift(problem, contact, local, by_position)
        coupling += by_u * u + by_v * v
        stiffness += rotational_stiffness(contact)
    return crank_torque, -coupling / stiffness if stiffness > 0.0 else math.nan


@compiled
def elastic_energy(problem: Problem, crank_angle: float, x: float, contacts: Rows) -> tuple[float, float, float]:
    """Energy stored in the contacts, with its derivatives, from rows solved at transmission error x.

    A contact stores U = ½Fδ - ¼κF² for Hertz's law δ = κF(H - ln F) (κ as in `hertz`), and ∂U/∂κ_c = ½F/k ∂F/∂κ_c by
    the flank's curvature κ_c, which moves with the foot. The torques F L of `equilibrium` and `crank_side` leave the
    second part out: of drives with errors 0.2 % of them in the root mean square and up to 2 % at single crank angles,
    but what makes them the gradient of one energy.

    Returns
    -------
    energy, by_angle, by_rotation
        U (J), ∂U/∂θ at a fixed output angle and ∂U/∂φ_b (N·m).
    """
    energy = by_angle = by_rotation = 0.0
    kappa = (problem.compliance_gear + problem.compliance_pin) / (math.pi * problem.slice_width)
    for row in range(contacts.shape[0]):
        contact = contacts[row]
        force = contact.force
        if force <= 0.0:
            continue
        local = local_frame(problem, crank_angle, x, contacts, row)
        along, (u, v) = gap_gradient(local), crank_motion(problem, local)
        bending = 0.5 * force * contact.force_by_curvature * contact.curvature_rate / contact.stiffness
        energy -= 0.5 * force * contact.gap + 0.25 * kappa * force * force
        by_angle += bending * local.foot * (along.slide[0] * u + along.slide[1] * v)
        by_angle -= force * (along.gap[0] * u + along.gap[1] * v)
        by_rotation += bending * contact.foot_rate + force * contact.arm
    return energy, by_angle, by_rotation


@compiled
def press(
    problem: Problem, crank_angle: float, flange: float, compliance: float, x: float, contacts: Rows, cold: bool
) -> tuple[float, float, float, float, float]:
    """Solve the contacts with the flange held at a transmission error, behind a compliance in series.

    Parameters
    ----------
    problem, crank_angle, x, contacts, cold
        As in `equilibrium`.
    flange, compliance
        Transmission error of the flange (rad), and the compliance between it and the contacts (rad/(N·m), 0 without).

    Returns
    -------
    x, stiffness, energy, by_angle, by_rotation
        Transmission error (rad) and stiffness (N·m/rad) of the contacts; stored energy (J), with that of the series
        compliance, and its derivatives by crank and flange (N·m).
    """
    if compliance == 0.0:
        place_contacts(problem, crank_angle, flange, contacts, cold, CLEAR, BOUNDED)
        _, stiffness = load(problem, contacts)
        energy, by_angle, by_rotation = elastic_energy(problem, crank_angle, flange, contacts)
        return flange, stiffness, energy, by_angle, by_rotation
    x, stiffness = behind_compliance(problem, crank_angle, flange, compliance, x, contacts, cold)
    energy = by_angle = by_rotation = 0.0
    for _ in range(10):
        place_contacts(problem, crank_angle, x, contacts, cold, CLEAR, BOUNDED)
        cold = False
        _, stiffness = load(problem, contacts)
        energy, by_angle, by_rotation = elastic_energy(problem, crank_angle, x, contacts)
        step = (flange - x - compliance * by_rotation) / (1.0 + compliance * stiffness)
        if abs(step) < _ROTATION_STEP:
            break
        x += step
    twist = flange - x
    return x, stiffness, energy + 0.5 * twist * twist / compliance, by_angle, twist / compliance
