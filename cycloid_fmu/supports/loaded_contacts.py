"""Every contact that carries load in a sweep of a drive on rigid or stated bearings."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import contact
from cycloid_fmu.contact.loaded_contacts import LoadedContacts, contacts_of
from cycloid_fmu.contact.loaded_contacts import loaded_contacts as rigidly_held
from cycloid_fmu.contact.transmission import rigid_problem
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.supports.joints import FIRST_DISC, Assembly, work_of
from cycloid_fmu.supports.sweeps import sweep_supported_contacts
from cycloid_fmu.supports.transmission import assembly_of, problem_of, unbalanced, with_own_discs

Array = NDArray[np.float64]


class Mounted(NamedTuple):
    """A drive with what holds its discs: `assembly` is None on rigid bearings."""

    problem: contact.Problem
    assembly: Assembly | None


def mounted(drive: DriveValue, slices: int) -> Mounted:
    """Return a drive's contact problem and the joints of its bearings, with its elastic bodies."""
    if drive.pair.supports is None:
        return Mounted(rigid_problem(drive, slices), None)
    return Mounted(problem_of(drive, slices), assembly_of(drive))


def loaded_contacts(drive: Mounted, crank_angle: Array, torque: float) -> LoadedContacts:
    """Return the contacts that carry load, as `cycloid_fmu.contact.loaded_contacts.loaded_contacts` does."""
    problem, assembly = drive
    if assembly is None:
        return rigidly_held(problem, crank_angle, torque)
    if torque == 0.0:
        raise ValueError("torque = 0: without load no contact carries any; it must not be zero")
    problem, discs = with_own_discs(problem), problem.shift_x.size
    steps, coordinates = np.zeros(crank_angle.size, np.int64), np.zeros((crank_angle.size, assembly.unknowns))
    table = np.empty((crank_angle.size, contact.contact_rows(problem).size), contact.ROW)
    sweep_supported_contacts(problem, assembly, crank_angle, torque, steps, coordinates, work_of(assembly), table)
    if not steps.all():
        raise unbalanced(torque, crank_angle[np.argmin(steps)])
    x, of_discs = coordinates[:, 0], coordinates[:, FIRST_DISC : FIRST_DISC + 3 * discs]
    shift, turn = of_discs[:, ::3] + 1j * of_discs[:, 1::3], of_discs[:, 2::3] - x[:, None]
    return contacts_of(problem, crank_angle, x, shift, turn, table)
