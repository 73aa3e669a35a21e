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

_GUIDE_BYTES = 1 << 24
_CACHE_BYTES = 1 << 27  # of all guides in memory: of 40 contacts at 19,000 crank angles


class NearDrives:
    """Drives near one that is solved at some loads and crank angles.

    Parameters
    ----------
    drive
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
        self._transmission_error = [
            solve(drive, np.array([torque]), angles, Options(slices, with_play=False)).transmission_error[0]
            for torque, angles in loads
        ]
        self._guides: dict[tuple[int, int], Guide] = {}

    def _along(self, sweep_number: int) -> Iterator[Guide]:
        """Yield the guides along a sweep; those that memory has room for are solved once."""
        angles, size = self.loads[sweep_number][1], self._contacts * GUIDE.itemsize
        length = max(_GUIDE_BYTES // size, 1)
        for first in range(0, angles.size, length):
            guide = self._guides.get((sweep_number, first))
            if guide is None:
                part = slice(first, first + length)
                rows = np.empty((angles[part].size, self._contacts), GUIDE)
                guide = Guide(first, rows, self._transmission_error[sweep_number][part].copy())
                guide_rows(self._problem, angles[part], guide.transmission_error, rows)
                if sum(each.rows.nbytes for each in self._guides.values()) < _CACHE_BYTES:
                    self._guides[sweep_number, first] = guide
            yield guide

    def displaced(self, errors: Array) -> DisplacedDrives:
        """Return the drives of errors, rows of `displacement_vector` of drives without deviations of form.

        Raises
        ------
        edge.InputError
            If a drive is impossible.
        """
        return DisplacedDrives(meshes_of(self.pair, errors, self.slices), errors - self._solved)

    def loaded(self, sweep_number: int, drives: DisplacedDrives) -> tuple[Array, Array]:
        """Return transmission error (rad) and largest pressure (Pa), each of shape (drives, angles).

        Parameters
        ----------
        sweep_number
            Of the loads; its torque is not 0.
        drives
            As `displaced` returns them.

        Raises
        ------
        edge.InputError
            If a drive can't balance the torque.
        """
        torque, angles = self.loads[sweep_number]
        transmission_error, stiffness, pressure = (np.empty((len(drives.errors), angles.size)) for _ in range(3))
        for batch, part, work in drives.parts(self._contacts):
            for guide in self._along(sweep_number):
                sweep_drives(
                    self._problem,
                    part,
                    work,
                    guide,
                    angles,
                    torque,
                    transmission_error[batch],
                    stiffness[batch],
                    pressure[batch],
                )
        unsolved = np.isnan(transmission_error)
        for j in np.flatnonzero(unsolved.any(axis=1)):
            crank_angles = angles[unsolved[j]]
            alone, _, _, _ = solve_problem(
                self._alone(drives, int(j)), np.full((1, crank_angles.size), torque), crank_angles, with_play=False
            )
            transmission_error[j, unsolved[j]] = alone.transmission_error[0]
            stiffness[j, unsolved[j]] = alone.stiffness[0]
            pressure[j, unsolved[j]] = alone.max_contact_pressure[0]
        for j in np.flatnonzero((stiffness <= 0.0).any(axis=1)):
            check_falling(self._alone(drives, int(j)), angles, np.full(angles.size, torque), stiffness[j] <= 0.0)
        return transmission_error, pressure

    def play(self, sweep_number: int, drives: DisplacedDrives) -> tuple[Array, Array]:
        """Return backlash (rad, NaN without a free position) and interference (m), each (drives, angles).

        Parameters are those of `loaded`; the sweep's torque is 0.
        """
        _, angles = self.loads[sweep_number]
        low, high = (np.empty((len(drives.errors), angles.size)) for _ in range(2))
        for batch, part, work in drives.parts(self._contacts):
            for guide in self._along(sweep_number):
                sweep_play_of_drives(self._problem, part, work, guide, angles, low[batch], high[batch])
        interference = np.zeros(low.shape)
        unsolved = np.isnan(low)
        for j in np.flatnonzero(unsolved.any(axis=1)):
            crank_angles = angles[unsolved[j]]
            _, *alone = solve_problem(
                self._alone(drives, int(j)), np.empty((0, crank_angles.size)), crank_angles, with_play=True
            )
            low[j, unsolved[j]], high[j, unsolved[j]], interference[j, unsolved[j]] = alone
        return high - low, interference

    def _alone(self, drives: DisplacedDrives, j: int) -> Problem:
        return self._problem._replace(**{name: values[j] for name, values in drives.drives._asdict().items()})


class DisplacedDrives(NamedTuple):
    """Drives with errors, and their displacements from the one that is solved, shape (drives, displacements), m."""

    drives: Drives
    errors: Array

    def parts(self, contacts: int) -> Iterator[tuple[slice, Drives, Memory]]:
        """Yield the drives in parts that go side by side, with memory for as many contacts."""
        for first in range(0, len(self.errors), LANES):
            batch = slice(first, first + LANES)
            yield batch, Drives(*(values[batch] for values in self.drives)), memory(contacts, self.errors[batch])
