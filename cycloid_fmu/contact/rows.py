"""Contact rows: what is known of each contact, two rows for each disc, slice and pin.

The first row is the conjugate tooth, the second the tooth across the nearest root, which a pin may touch as well. Rows
are ordered by disc, slice and pin (`disc_slice_pin`). A kernel takes `contacts[i].gap`, Python `contacts["gap"]`.

================== ===== ==========================================================================================
Field              Unit  Meaning
================== ===== ==========================================================================================
foot               rad   foot of the pin's axis on the nominal flank, from the conjugate point; NaN without contact
foot_rate          1     its derivative by the transmission error x
gap                m     distance of pin and flank, < 0 where they are pressed together; infinite without contact
arm                m     -∂gap/∂x; force times arm is torque on the output
arm_rate           m/rad the arm's derivative by x
curvature          1/m   1/ρ_c of the flank, > 0 convex
curvature_rate     1/m   its derivative by the profile parameter, for each radian
force              N     Hertz's force; 0 where the row carries none
stiffness          N/m   its derivative by the approach
force_by_curvature N·m   its derivative by the flank's curvature
transmission_error rad   x at which the row was solved
profile_parameter  rad   profile parameter of the contact; other than the foot's where deviations move the contact
crank_angle        rad   θ at which the row was solved
gap_by_crank       m/rad the gap's derivative by θ; NaN with deviations, where it reaches no farther than an element
foot_by_crank      1     the foot's derivative by θ
fall               m/rad the nearer gap of the pin's two rows falls by no more than this for each radian of the crank
bounded_for        rad   crank angle either way up to which `fall` holds; both are in the pin's first row
nearest            m     smallest gap of a pin's slices if all were solved at once, 0 otherwise; in the pin's first row
touching           1     in row i the number of the ith row that may touch where all were placed last, -1 after the last
================== ===== ==========================================================================================
"""

from __future__ import annotations

import math

import numpy as np
from numba.extending import register_jitable
from numpy.typing import NDArray

from cycloid_fmu.contact.compiling import compiled
from cycloid_fmu.contact.gap import Contact
from cycloid_fmu.contact.lanes import record_of
from cycloid_fmu.contact.problem import Problem

SOLVED = Contact._fields
"""What a foot gives."""
PRESSED = ("force", "stiffness", "force_by_curvature")
"""What Hertz's law gives."""
ROW = record_of(
    *SOLVED,
    *PRESSED,
    *("transmission_error", "crank_angle", "fall", "bounded_for", "nearest", "touching"),
)
Rows = NDArray[np.void]


@register_jitable  # type: ignore[untyped-decorator]  # not `compiled`, because it makes an array
def contact_rows(problem: Problem) -> Rows:
    """Return the empty contact rows of a problem, shape (discs x slices x pins x 2,)."""
    contacts = np.zeros(problem.crank_phase.size * problem.centre_x.size * problem.pin_x.size * 2, ROW)
    for row in range(contacts.size):
        contacts[row].gap, contacts[row].foot, contacts[row].touching = math.inf, math.nan, -1.0
    return contacts


@compiled
def touching_count(contacts: Rows) -> int:
    """How many rows may touch: their numbers are in `touching` of the first rows."""
    count = 0
    while count < contacts.shape[0] and contacts[count].touching >= 0.0:
        count += 1
    return count


@compiled(inline=True)
def disc_slice_pin(problem: Problem, row: int) -> tuple[int, int, int]:
    """Disc, slice and pin of a row."""
    pins, slices = problem.pin_x.size, problem.centre_x.size
    ring = row // 2 // pins
    disc = ring // slices
    return disc, ring - disc * slices, row // 2 - ring * pins


@compiled(inline=True)
def is_solved_at(contact: np.record, crank_angle: float, x: float) -> bool:
    """Whether a row was solved at this very crank angle and transmission error, not left from elsewhere."""
    return bool(contact.transmission_error == x and contact.crank_angle == crank_angle)
