"""Forces on an elastic disc at a solved place."""

from __future__ import annotations

import numpy as np

from cycloid_fmu import edge
from cycloid_fmu.bodies.disc import DiscForces
from cycloid_fmu.contact.transmission import no_lines
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.supports.joints import work_of
from cycloid_fmu.supports.sweeps import sweep_supported
from cycloid_fmu.supports.transmission import assembly_of, empty, of_part, problem_of, unbalanced, with_own_discs


def disc_forces(drive: DriveValue, torque: float, crank_angle: float, disc: int = 0) -> DiscForces:
    """Return the forces of pins, turning arms and output rollers on a disc at a torque (N·m) and crank angle (rad).

    Raises
    ------
    edge.InputError
        If the drive's discs are rigid, or it can't carry the torque.
    """
    pair, angles, torques = drive.pair, np.array([crank_angle]), np.array([torque])
    if pair.bodies is None or pair.bodies.disc is None:
        raise edge.InputError("the pair has no [bodies.disc]: forces on a rigid disc displace nothing.")
    assembly, solution = assembly_of(drive), of_part(empty(pair, 1, 1), 0)
    work = work_of(assembly)
    sweep_supported(with_own_discs(problem_of(drive)), assembly, angles, torques, solution, work, no_lines(1), False)
    if not solution.steps.all():
        raise unbalanced(torque, crank_angle)
    elastic = assembly.elastic
    assert elastic is not None
    assert work.ports is not None
    influence, forces = elastic.influence, np.zeros(len(elastic.influence.fixed))
    np.add.at(forces, work.ports.ports["slot"], work.ports.ports["force"])
    pins, arms, rollers = np.split(
        forces[: len(forces) - 2 * influence.arms], [influence.arms_slot, influence.rollers_slot]
    )
    return DiscForces(
        pins.reshape(pair.discs, -1)[disc],
        arms.reshape(pair.discs, influence.arms, influence.sectors)[disc],
        rollers.reshape(pair.discs, influence.rollers)[disc],
    )
