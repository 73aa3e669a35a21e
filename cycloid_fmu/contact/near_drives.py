"""Many drives near one that is solved, side by side: what a tolerance study solves."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from cycloid_fmu.contact.compiling import Array
from cycloid_fmu.contact.lanes import LANES
from cycloid_fmu.contact.problem import Drives, Problem
from cycloid_fmu.contact.side_by_side import (
    GUIDE,
    Guide,
    Memory,
    guide_rows,
    memory,
    sweep_drives,
    sweep_play_of_drives,
)
from cycloid_fmu.contact.transmission import Options, check_falling, meshes_of, rigid_problem, solve, solve_problem
from cycloid_fmu.drive_value import DriveValue
from cycloid_fmu.surfaces.structured import displacement_vector

_GUIDE = 1 << 24  # bytes of a guide
_KEPT = 1 << 27  # bytes of guides that are kept: of 40 contacts at 19,000 crank angles


class NearDrives:
    """Drives near one that is solved at some loads and crank angles.

    Parameters
    ----------
    pair, surface
        The drive that is solved; a study's is error-free.
    loads
        (torque N·m, crank angles rad), one a sweep; torque 0 is the play.
    slices
        Across the face width.
    """

    def __init__(
        self,
        drive: DriveValue,
        loads: Sequence[tuple[float, Array]],
        slices: int,
    ) -> None:
        pair, surface = drive.pair, drive.surface
        self.pair, self.loads, self.slices = pair, loads, slices
        self._problem = rigid_problem(drive, slices)
        self._solved = displacement_vector(pair, surface)
        self._contacts = pair.discs * slices * pair.pins
        self._deviation = [
            solve(drive, np.array([torque]), angles, Options(slices, with_play=False)).transmission_error[0]
            for torque, angles in loads
        ]
        self._guides: dict[tuple[int, int], Guide] = {}

    def _along(self, sweep_number: int) -> Iterator[Guide]:
        """Yield the guides along a sweep; those that memory has room for are made once."""
        angles, size = self.loads[sweep_number][1], self._contacts * GUIDE.itemsize
        few = max(_GUIDE // size, 1)
        for first in range(0, angles.size, few):
            guide = self._guides.get((sweep_number, first))
            if guide is None:
                at, deviation = angles[first : first + few], self._deviation[sweep_number][first : first + few].copy()
                guide = Guide(first, np.empty((at.size, self._contacts), GUIDE), deviation)
                guide_rows(self._problem, at, deviation, guide.rows)
                if sum(kept.rows.nbytes for kept in self._guides.values()) < _KEPT:
                    self._guides[sweep_number, first] = guide
            yield guide

    def made(self, errors: Array) -> Made:
        """Return the drives of errors, rows of `displacement_vector` of drives without deviations of form.

        Raises
        ------
        edge.InputError
            If a drive is impossible.
        """
        return Made(meshes_of(self.pair, errors, self.slices), errors - self._solved)

    def loaded(self, sweep_number: int, drives: Made) -> tuple[Array, Array]:
        """Return transmission error (rad) and largest pressure (Pa), each of shape (drives, angles).

        Parameters
        ----------
        sweep_number
            Of the loads; its torque is not 0.
        drives
            As `made` returns them.

        Raises
        ------
        edge.InputError
            If a drive can't balance the torque.
        """
        torque, angles = self.loads[sweep_number]
        deviation, stiffness, pressure = (np.empty((len(drives.errors), angles.size)) for _ in range(3))
        for at, some, work in drives.parts(self._contacts):
            for guide in self._along(sweep_number):
                sweep_drives(
                    self._problem,
                    some,
                    work,
                    guide,
                    angles,
                    torque,
                    deviation[at],
                    stiffness[at],
                    pressure[at],
                )
        left = np.isnan(deviation)
        for j in np.flatnonzero(left.any(axis=1)):
            few = angles[left[j]]
            alone, _, _, _ = solve_problem(
                self._alone(drives, int(j)), np.full((1, few.size), torque), few, with_play=False
            )
            deviation[j, left[j]], stiffness[j, left[j]] = alone.deviation[0], alone.stiffness[0]
            pressure[j, left[j]] = alone.max_contact_pressure[0]
        for j in np.flatnonzero((stiffness <= 0.0).any(axis=1)):
            check_falling(self._alone(drives, int(j)), angles, np.full(angles.size, torque), stiffness[j] <= 0.0)
        return deviation, pressure

    def play(self, sweep_number: int, drives: Made) -> tuple[Array, Array]:
        """Return backlash (rad, NaN without a free position) and interference (m), each (drives, angles).

        Parameters are those of `loaded`; the sweep's torque is 0.
        """
        _, angles = self.loads[sweep_number]
        low, high = (np.empty((len(drives.errors), angles.size)) for _ in range(2))
        for at, some, work in drives.parts(self._contacts):
            for guide in self._along(sweep_number):
                sweep_play_of_drives(self._problem, some, work, guide, angles, low[at], high[at])
        interference = np.zeros(low.shape)
        left = np.isnan(low)
        for j in np.flatnonzero(left.any(axis=1)):
            few = angles[left[j]]
            _, *alone = solve_problem(self._alone(drives, int(j)), np.empty((0, few.size)), few, with_play=True)
            low[j, left[j]], high[j, left[j]], interference[j, left[j]] = alone
        return high - low, interference

    def _alone(self, drives: Made, j: int) -> Problem:
        return self._problem._replace(**{name: values[j] for name, values in drives.drives._asdict().items()})


class Made(NamedTuple):
    """Drives as they are made, and displacements from the one that is solved, shape (drives, displacements), m."""

    drives: Drives
    errors: Array

    def parts(self, contacts: int) -> Iterator[tuple[slice, Drives, Memory]]:
        """Yield the drives in parts that go side by side, with memory for as many contacts."""
        for first in range(0, len(self.errors), LANES):
            at = slice(first, first + LANES)
            yield at, Drives(*(values[at] for values in self.drives)), memory(contacts, self.errors[at])
