"""A drive on its bearings at one crank angle: stored energy, the torques as its derivatives, and the motion.

With the unknowns q at their balance under a torque or behind a spring, r(q, θ) = 0, the stored energy U(q, θ) changes
with the crank angle by ∂U/∂θ + b·dq/dθ. Here b = ∂U/∂q minus the balanced forces: the part of Hertz's energy due to the
change of the flank's curvature, which the balance neglects (`contact.elastic_energy`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cycloid_fmu import contact
from cycloid_fmu.contact import Array, Problem, Rows, compiled
from cycloid_fmu.contact.local_frame import contact_stiffness, crank_motion, gap_gradient, projection
from cycloid_fmu.supports.balance import HELD, Load, settle, solve_transposed
from cycloid_fmu.supports.elastic_energy import energy_of_ports, pin_energy, turn_ports
from cycloid_fmu.supports.joints import (
    FIRST_DISC,
    Assembly,
    Work,
    add_turning,
    derivatives,
    displacement,
    reaction,
    stored_energy,
)
from cycloid_fmu.supports.ports import begin_anew, has_ports, is_rigid

# Indices of the results of `stand`, and their number.
X, STIFFNESS, ENERGY, BY_FLANGE, BY_ANGLE, CRANK_TORQUE, RATE, TORQUE = range(8)
FOUND = 8


class Held(NamedTuple):
    """A drive on its bearings.

    Attributes
    ----------
    drive, assembly, work
        The mesh, its supports, and work arrays.
    by_energy, by_angle
        Derivatives of the energy by the unknowns minus the balanced forces, and of the balance by θ, shape (unknowns,).
    """

    drive: Problem
    assembly: Assembly
    work: Work
    by_energy: Array
    by_angle: Array


def held(drive: Problem, assembly: Assembly, work: Work) -> Held:
    """Return a drive on its bearings; kernels overwrite the arrays."""
    return Held(drive, assembly, work, np.zeros(work.coordinates.size), np.zeros(work.coordinates.size))


@compiled
def _mesh(
    drive: Problem, assembly: Assembly, crank_angle: float, x: float, rows: Rows, by_energy: Array, by_angle: Array
) -> tuple[float, float, float]:
    """Add the mesh; returns its energy, its derivative by θ at fixed unknowns, and the contribution of curvature.

    Through elastic bodies the energy, and what the balance's equations change by θ, is that of ports.
    """
    energy = turning = bent_by = 0.0
    kappa = (drive.compliance_gear + drive.compliance_pin) / (math.pi * drive.slice_width)
    for row in range(rows.shape[0]):
        contact_ = rows[row]
        force = contact_.force
        if force <= 0.0:
            continue
        local = contact.local_frame(drive, crank_angle, x, rows, row)
        along = gap_gradient(local)
        # Motion of the disc with the crank at fixed unknowns.
        motion = (*crank_motion(drive, local), -1.0 / drive.teeth)
        stored, by_curvature = pin_energy(drive, assembly.elastic, contact_, local.pin, kappa)
        energy += stored
        turning -= force * projection(motion, along.gap)
        bending = by_curvature * contact_.curvature_rate * local.foot
        bent_by += bending * projection(motion, along.slide)
        first, rigid = FIRST_DISC + 3 * local.disc, is_rigid(assembly.elastic)
        stiffness = contact_stiffness(contact_, local, along)
        for i in range(3):
            by_energy[first + i] += bending * along.slide[i]
            if rigid:
                by_angle[first + i] += projection(motion, stiffness[i])
    return energy, turning, bent_by


@compiled
def _joints(assembly: Assembly, centring: float, work: Work, by_angle: Array) -> tuple[float, float]:
    """Add the joints at the solved place; returns their energy and its derivative by θ at fixed unknowns.

    Of those through elastic bodies there is the centring springs' energy alone.
    """
    stored = turning = 0.0
    for number in range(assembly.joints.size):
        joint = assembly.joints[number]
        d = displacement(assembly, joint, work)
        if has_ports(assembly.elastic, number):
            stored += 0.5 * centring * d.length * d.length if joint.reach == 0.0 else 0.0
            continue
        acting = reaction(assembly, joint, d, centring)
        if acting.stiffness == 0.0:
            continue
        unknowns = derivatives(assembly, joint, d, work)
        stored += stored_energy(assembly, joint, d, centring)
        turning += add_turning(assembly, joint, d, acting, work, unknowns, by_angle)
    return stored, turning


@compiled
def stand(box: Held, crank_angle: float, pull: Load, rows: Rows, cold: bool, out: Array) -> int:
    """Solve the balance at a crank angle from the last solution; return the number of steps, 0 if not found.

    Parameters
    ----------
    box
        The drive; its unknowns are in `work.coordinates`.
    crank_angle, pull
        Crank angle, rad, and the load.
    rows, cold
        Contact rows, and whether to start without a neighbouring solution.
    out
        Overwritten, shape (`FOUND`,): the carrier's rotation x relative to its ideal one (rad); its stiffness
        (N·m/rad); the stored energy with that of the spring (J), and its derivatives by the flange angle and by the
        crank angle at a fixed flange (N·m); the crank's torque (N·m) and dφ_b/dθ at constant torque (dimensionless);
        and the torque on the carrier (N·m).
    """
    drive, assembly, work, by_energy, by_angle = box.drive, box.assembly, box.work, box.by_energy, box.by_angle
    q, teeth, n = work.coordinates, drive.teeth, work.step.size
    spring, flange = pull.spring, pull.flange
    if spring > 0.0:
        # Discs start with the carrier's rotation, or they would be pressed immediately.
        for i in range(FIRST_DISC + 2, FIRST_DISC + 3 * drive.shift_x.size, 3):
            q[i] += flange - q[0]
        q[0] = flange
    begin_anew(work.ports)
    steps = settle(drive, assembly, crank_angle, pull, rows, work, None, cold)
    if steps == 0:
        return 0
    for i in range(n):
        by_energy[i] = by_angle[i] = 0.0
    elastic = assembly.elastic
    of_mesh, mesh_turning, bending = _mesh(drive, assembly, crank_angle, q[0], rows, by_energy, by_angle)
    of_joints, joints_turning = _joints(assembly, pull.centring, work, by_angle)
    by_crank = mesh_turning + joints_turning
    by_crank += turn_ports(drive, assembly, elastic, crank_angle, pull.centring, rows, work, by_angle)
    stored = of_mesh + of_joints + energy_of_ports(drive, assembly, elastic, rows, work.ports)
    # Rows of the inverse for the carrier's rotation and for b, without the flange's spring.
    work.jacobian[0, 0] -= spring
    for i in range(n):
        work.before[i] = by_energy[i]
        work.residual[i] = 1.0 if i == 0 else 0.0
    row, bent = work.residual, work.before
    if not (solve_transposed(drive, assembly, work, row, HELD) and solve_transposed(drive, assembly, work, bent, HELD)):
        return 0
    share = spring / (1.0 + spring * row[0])
    rate, energy_rate = 0.0, by_crank + bending
    for i in range(n):
        rate -= row[i] * by_angle[i]
        energy_rate -= (bent[i] - row[i] * share * bent[0]) * by_angle[i]
    carried = spring * (flange - q[0]) + pull.torque
    by_flange = carried + bent[0] * share if spring > 0.0 else carried
    out[X], out[STIFFNESS] = q[0], 1.0 / row[0]
    out[ENERGY] = stored + (0.5 * (flange - q[0]) ** 2 * spring if spring > 0.0 else 0.0)
    out[BY_FLANGE], out[BY_ANGLE] = by_flange, energy_rate + by_flange / teeth
    out[CRANK_TORQUE], out[RATE], out[TORQUE] = by_crank + carried / teeth, rate - 1.0 / teeth, carried
    return steps
