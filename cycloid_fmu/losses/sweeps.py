"""Sweeps of a drive with friction over crank angles, and the derivatives of the crank's torque by its coefficients."""

from __future__ import annotations

import math

import numpy as np

from cycloid_fmu import contact
from cycloid_fmu.contact import Array, Problem, Rows, compiled
from cycloid_fmu.contact.local_frame import gap_gradient, projection
from cycloid_fmu.losses.rubbing import (
    ARM,
    CONSTANT,
    FLANK_LAW,
    JOINT_KINETIC,
    JOINT_STATIC,
    KINETIC,
    STATIC,
    Acting,
    Rubbing,
    Slope,
    assemble_at,
    assemble_rubbing,
    flank_friction,
    joint_friction,
    joint_speed,
    settle_rubbing,
    through_first_stage,
    write_sliding,
)
from cycloid_fmu.supports.balance import Load, solve_transposed
from cycloid_fmu.supports.bearing import CENTRING
from cycloid_fmu.supports.elastic import pressing
from cycloid_fmu.supports.joints import FIRST_DISC, Assembly, Work, derivatives, displacement
from cycloid_fmu.supports.sweeps import Solutions, follow_neighbours, write_solution


def slope_of(unknowns: int) -> Slope:
    """Return uninitialized work arrays."""
    return Slope(*np.zeros((3, unknowns)))


@compiled
def sweep_rubbing(
    problem: Problem,
    assembly: Assembly,
    crank_angles: Array,
    torques: Array,
    rubbing: Rubbing,
    results: Solutions,
    loss: Array,
    work: Work,
    slope: Slope,
    near: bool,
) -> None:
    """Solve crank angles with friction, each at its torque and starting from its neighbour.

    Parameters
    ----------
    crank_angles, torques
        Crank angles, rad, and the torque at each, N·m, shape (angles,).
    results, loss
        Overwritten; without a balance `steps` are 0. `loss` has shape (angles, parts), J for each radian of the crank.
    near
        Whether `results.coordinates` holds solutions at nearly the same torques, which are the start instead.
    """
    contacts = contact.contact_rows(problem)
    q = work.coordinates
    for i in range(crank_angles.size):
        crank_angle = crank_angles[i]
        follows = False
        if near:
            for k in range(q.size):
                q[k] = results.coordinates[i, k]
            work.moved[0] = math.inf
        elif i > 0 and results.steps[i - 1] > 0:
            follows = follow_neighbours(crank_angles, results.coordinates, i, q)
        cold = not (near or follows)
        pull = Load(torques[i], 0.0, 0.0, CENTRING)
        results.steps[i] = settle_rubbing(
            problem, assembly, crank_angle, pull, contacts, work, (rubbing, slope, loss[i]), cold
        )
        if results.steps[i] == 0:
            work.moved[0] = math.inf
            continue
        # With all forces at the solved place again, of which the crank's torque with friction is one.
        crank_torque = assemble_rubbing(problem, assembly, crank_angle, pull, contacts, work, (rubbing, slope, loss[i]))
        write_solution(problem, assembly, contacts, work, results, i)
        results.crank_torque[i] = crank_torque


@compiled
def _by_coefficients(
    law: np.record, f: Acting, force: float, rolls: bool, along: float, radius: float, out: Array
) -> None:
    """Add `along` times the derivatives of an amplitude G by the coefficients of its law."""
    sign = along * f.sign
    if rolls:
        out[CONSTANT] += sign
        out[ARM] += sign * force
    elif f.turns:
        lever = law.joint_radius / radius
        rest = math.exp(-law.joint_decay * (f.speed * lever) ** 2)
        out[JOINT_KINETIC] += sign * force * lever * (1.0 - rest)
        out[JOINT_STATIC] += sign * force * lever * rest
    else:
        rest = math.exp(-law.decay * f.speed * f.speed)
        out[KINETIC] += sign * force * (1.0 - rest)
        out[STATIC] += sign * force * rest


@compiled
def add_flank_coefficients(
    problem: Problem, crank_angle: float, contacts: Rows, work: Work, rubbing: Rubbing, out: Array
) -> None:
    """Subtract λ·∂r/∂p of the flanks, λ in `work.step`."""
    law, row_ = rubbing.laws[FLANK_LAW], work.step
    for row in range(contacts.shape[0]):
        force = contacts[row].force
        if force <= 0.0:
            continue
        local = contact.local_frame(problem, crank_angle, work.coordinates[0], contacts, row)
        radius = problem.pin_radius[local.pin]
        f = flank_friction(problem, rubbing, local, contacts[row])
        first = FIRST_DISC + 3 * local.disc
        weights = (row_[first], row_[first + 1], row_[first + 2])
        sliding = projection(weights, gap_gradient(local).slide) + (contacts[row].gap + radius) * row_[first + 2]
        _by_coefficients(law, f, force, False, sliding, radius, out[FLANK_LAW])


@compiled
def add_joint_coefficients(
    problem: Problem,
    assembly: Assembly,
    work: Work,
    rubbing: Rubbing,
    direct: float,
    sliding: Array,
    out: Array,
) -> None:
    """Subtract λ·∂r/∂p of the joints, λ in `work.step`, and add what bearings take from the crank directly.

    `direct` is what the crank's torque becomes for each N·m on the crank itself: 1 without a first stage; 0 where λ is
    not that of the crank's torque.
    """
    row, index = work.step, work.indices
    for number in range(assembly.joints.size):
        joint = assembly.joints[number]
        d, acting = pressing(assembly, number, displacement(assembly, joint, work), work, work.ports)
        force, law = acting.force, rubbing.laws[int(joint.law)]
        f = joint_friction(rubbing, joint, joint_speed(problem, assembly, joint, d, work), force)
        along, roller = 0.0, joint.reach > 0.0
        if roller:
            unknowns = derivatives(assembly, joint, d, work)
            write_sliding(assembly, joint, law.outer_radius, d, work, unknowns, sliding)
            for i in range(unknowns):
                along -= row[index[i]] * sliding[i]
        else:
            outer, inner = assembly.bodies[int(joint.outer)].rotation, assembly.bodies[int(joint.inner)].rotation
            along = (row[inner] if inner >= 0 else -direct) - (row[outer] if outer >= 0 else 0.0)
        _by_coefficients(law, f, force, not roller, along, law.outer_radius, out[int(joint.law)])


@compiled
def sweep_rubbing_sensitivities(
    problem: Problem,
    assembly: Assembly,
    crank_angles: Array,
    torques: Array,
    coordinates: Array,
    rubbing: Rubbing,
    by_coefficient: Array,
    by_carrier: Array,
    work: Work,
    slope: Slope,
    loss: Array,
) -> bool:
    """Write the derivatives of the crank's torque at given solutions; return False if one is singular.

    Parameters
    ----------
    crank_angles, torques, places
        Crank angles (rad) and the torque at each (N·m), shape (angles,); the solutions, shape (angles, unknowns).
    by_coefficient
        Zeros; overwritten with the derivatives by the `COEFFICIENTS` of each law, shape (angles, laws, coefficients).
    by_carrier
        Overwritten with those by the carrier's drag (1) and by the first stage's loss ζ (N·m), shape (angles, 2).
    """
    contacts = contact.contact_rows(problem)
    n = work.coordinates.size
    for i in range(crank_angles.size):
        pull, more = Load(torques[i], 0.0, 0.0, CENTRING), (rubbing, slope, loss)
        torque = assemble_at(problem, assembly, crank_angles[i], pull, contacts, work, more, coordinates[i])
        # λ (∂r/∂q) = ∂τ/∂q.
        for k in range(n):
            work.step[k] = slope.crank_torque[k]
        if not solve_transposed(problem, assembly, work, work.step, 0.0):
            return False
        add_flank_coefficients(problem, crank_angles[i], contacts, work, rubbing, by_coefficient[i])
        factor = through_first_stage(rubbing, torque)
        direct = 1.0 - work.step[0] * (1.0 + rubbing.sun_share * factor if rubbing.sun_share > 0.0 else 0.0)
        add_joint_coefficients(problem, assembly, work, rubbing, direct, slope.sliding, by_coefficient[i])
        by_carrier[i, 0] = rubbing.direction * work.step[0]
        by_loss = factor * factor if rubbing.direction * torque > 0.0 else -1.0
        by_carrier[i, 1] = -work.step[0] * rubbing.sun_share * torque * by_loss
    return True
