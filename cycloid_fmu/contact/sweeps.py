"""Sweeps over crank angles, each solved from its neighbour."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu.contact.compiling import Array, compiled
from cycloid_fmu.contact.energy import crank_side
from cycloid_fmu.contact.equilibrium import equilibrium, load, rotational_stiffness
from cycloid_fmu.contact.load_sharing import ContactLines, load_sharing, write_contact_lines
from cycloid_fmu.contact.local_frame import local_frame
from cycloid_fmu.contact.placement import BOUNDED, CLEAR, place_contacts
from cycloid_fmu.contact.play import ROTATION_STEP, end_from_neighbour, play
from cycloid_fmu.contact.problem import Problem
from cycloid_fmu.contact.rows import Rows, contact_rows
from cycloid_fmu.contact.sensitivity import derivatives

_FARTHEST = 1e-3  # rad: from the solution under another torque


class LoadedSweep(NamedTuple):
    """Results of a sweep under load.

    Attributes
    ----------
    transmission_error, stiffness, contact_count, max_contact_pressure
        Shape (torques, angles): x (rad), N·m/rad, pins in contact, Pa.
    pin_force, pin_pressure
        Shape (torques, angles, discs, pins): N, Pa.
    """

    transmission_error: Array
    stiffness: Array
    contact_count: NDArray[np.int64]
    max_contact_pressure: Array
    pin_force: Array
    pin_pressure: Array


@compiled
def sweep(
    problem: Problem,
    crank_angles: Array,
    torques: Array,
    first: int,
    last: int,
    with_play: bool,
    low: Array,
    high: Array,
    gap: Array,
    loaded: LoadedSweep,
    lines: ContactLines | None,
) -> None:
    """Solve crank angles `first` to `last`, each from its neighbours' solutions, which may be at the same angle.

    The steps have the headings of docs/theory/contact.md: the play; at each torque from one crank angle to the next the
    equilibrium, or the middle of the play without a torque; load sharing; and the pressure of elements.

    Parameters
    ----------
    crank_angles, torques
        Crank angles (rad), shape (angles,); torques (N·m), shape (torques, angles), at 0 the transmission error is the
        middle of the play.
    with_play, low, high, gap
        Whether to solve the play, and what it is written to, as in `sweep_play`.
    loaded, lines
        Zeros, overwritten from `first` to `last`; the elements' pressures are raised. Without lines the kernels
        know of none.
    """
    if with_play:
        _solve_play(problem, crank_angles, first, last, low, high, gap, contact_rows(problem), contact_rows(problem))
    for k in range(torques.shape[0]):
        contacts, x = contact_rows(problem), 0.0
        transmission_error, stiffness = loaded.transmission_error[k], loaded.stiffness[k]
        for i in range(first, last):
            cold = i == first
            if torques[k, i] == 0.0:
                x, free = _middle_of_play(problem, crank_angles[i], x, contacts, cold)
                cold = False
                if free:
                    # What nothing presses stays as it was handed over: 0.
                    transmission_error[i], stiffness[i], loaded.max_contact_pressure[k, i] = x, 0.0, 0.0
                    continue
            x = _from_neighbours(crank_angles, torques[k], transmission_error, stiffness, first, i)
            x, stiffness[i] = equilibrium(problem, crank_angles[i], torques[k, i], x, contacts, cold)
            transmission_error[i] = x
            count, pressure = load_sharing(problem, contacts, loaded.pin_force[k, i], loaded.pin_pressure[k, i])
            loaded.contact_count[k, i], loaded.max_contact_pressure[k, i] = count, pressure
            write_contact_lines(problem, lines, k, i, crank_angles[i], x, contacts)


@compiled
def _middle_of_play(problem: Problem, crank_angle: float, x: float, contacts: Rows, cold: bool) -> tuple[float, bool]:
    """Middle of the play, and whether there is a free position; without one, x as it was."""
    low, high, _ = play(problem, crank_angle, x, contacts, cold)
    free = not math.isnan(low)
    return 0.5 * (low + high) if free else x, free


@compiled
def _from_neighbours(
    crank_angles: Array, torques: Array, transmission_error: Array, stiffness: Array, first: int, i: int
) -> float:
    """Transmission error to start an equilibrium from, by those of the crank angles before it."""
    x = _ahead(crank_angles, transmission_error, first, i)
    if i > first and crank_angles[i] == crank_angles[i - 1] and stiffness[i - 1] > 0.0:
        # 1.4 times as fast where the torque alone changes.
        x += min(max((torques[i] - torques[i - 1]) / stiffness[i - 1], -_FARTHEST), _FARTHEST)
    return x


@compiled
def _ahead(crank_angles: Array, transmission_error: Array, first: int, i: int) -> float:
    """Transmission error to start from: on the parabola through those of the last three crank angles if as near."""
    x = float(transmission_error[i - 1]) if i > first else 0.0
    if i > first + 1 and abs(crank_angles[i] - crank_angles[i - 1]) < 1.5 * abs(
        crank_angles[i - 1] - crank_angles[i - 2]
    ):
        step, last = crank_angles[i] - crank_angles[i - 1], crank_angles[i - 1] - crank_angles[i - 2]
        slope = (x - transmission_error[i - 2]) / last
        x += slope * step
        before = crank_angles[i - 2] - crank_angles[i - 3] if i > first + 2 else 0.0
        # Where the crank turned back, two of the three angles may be the same.
        if last * before > 0.0 and abs(last) < 1.5 * abs(before):
            x += (
                step
                * (step + last)
                * (slope - (transmission_error[i - 2] - transmission_error[i - 3]) / before)
                / (last + before)
            )
    return x


@compiled
def sweep_play(
    problem: Problem, crank_angles: Array, first: int, last: int, low: Array, high: Array, gap: Array
) -> None:
    """Solve the play at crank angles `first` to `last`; each angle starts from its neighbour's solution.

    Parameters
    ----------
    crank_angles
        Crank angles, shape (angles,), rad.
    low, high, gap
        Overwritten from `first` to `last`, shape (angles,): ends of the play (rad) and interference (m), as `play`.
    """
    _solve_play(problem, crank_angles, first, last, low, high, gap, contact_rows(problem), contact_rows(problem))


@compiled
def _solve_play(
    problem: Problem,
    crank_angles: Array,
    first: int,
    last: int,
    low: Array,
    high: Array,
    gap: Array,
    at_low: Rows,
    at_high: Rows,
) -> None:
    """Solve the play as `sweep_play`; rows at both ends are memory."""
    neighbouring = False
    for i in range(first, last):
        cold = i == first or math.isnan(low[i - 1])
        x = 0.0 if cold else 0.5 * (low[i - 1] + high[i - 1])
        if problem.deviations is None and not cold:
            low[i] = end_from_neighbour(problem, crank_angles[i], low[i - 1], at_low, not neighbouring, -1.0)
            high[i] = end_from_neighbour(problem, crank_angles[i], high[i - 1], at_high, not neighbouring, 1.0)
            # Without errors and modification the ends are the same but for rounding.
            neighbouring = low[i] < high[i] + 2.0 * ROTATION_STEP
            if neighbouring:
                if low[i] > high[i]:
                    low[i] = high[i] = 0.5 * (low[i] + high[i])
                gap[i] = 0.0
                continue
            cold = True
        low[i], high[i], gap[i] = play(problem, crank_angles[i], x, at_low, cold)


@compiled
def sweep_contacts(
    problem: Problem, crank_angles: Array, torque: float, transmission_error: Array, table: Rows
) -> None:
    """Solve crank angles at one torque and keep every contact row.

    Parameters
    ----------
    crank_angles, torque
        Crank angles (rad), shape (angles,); torque (N·m), not 0.
    transmission_error, table
        Overwritten: x (rad), shape (angles,); `contact_rows` of each angle, shape (angles, rows).
    """
    contacts = contact_rows(problem)
    for i in range(crank_angles.size):
        x, _ = equilibrium(
            problem, crank_angles[i], torque, _ahead(crank_angles, transmission_error, 0, i), contacts, i == 0
        )
        transmission_error[i] = x
        table[i] = contacts


@compiled
def sweep_crank_side(
    problem: Problem, crank_angles: Array, transmission_error: Array, crank_torque: Array, output_rate: Array
) -> None:
    """Write what `crank_side` returns at transmission errors (rad), shapes (angles,); 0 and NaN without contact."""
    contacts = contact_rows(problem)
    for i in range(crank_angles.size):
        place_contacts(problem, crank_angles[i], transmission_error[i], contacts, i == 0, CLEAR, BOUNDED)
        load(problem, contacts)
        crank_torque[i], output_rate[i] = crank_side(problem, crank_angles[i], transmission_error[i], contacts)


@compiled
def sweep_sensitivities(
    problem: Problem,
    crank_angles: Array,
    torque: Array,
    transmission_error: Array,
    each: Array,
    by_angle: Array,
    by_torque: Array,
) -> None:
    """Solve every crank angle at its torque, with the derivatives of the transmission error.

    Parameters
    ----------
    crank_angles, torque
        Crank angles (rad) and the torque at each (N·m, not 0), shape (angles,).
    transmission_error, each, by_angle, by_torque
        Overwritten: x (rad), shape (angles,); rows of `sensitivities`, shape (angles, displacements); the output
        angle's derivatives by crank angle (1) and torque (rad/(N·m)), shape (angles,).
    """
    contacts = contact_rows(problem)
    for i in range(crank_angles.size):
        x, _ = equilibrium(
            problem, crank_angles[i], torque[i], _ahead(crank_angles, transmission_error, 0, i), contacts, i == 0
        )
        transmission_error[i] = x
        stiffness, by_angle[i] = derivatives(problem, crank_angles[i], x, contacts, each[i])
        by_torque[i] = 1.0 / stiffness


@compiled
def sweep_flank_sensitivities(
    problem: Problem,
    crank_angles: Array,
    transmission_error: Array,
    profile_parameters: Array,
    waves: Array,
    out: Array,
) -> None:
    """Derivatives of solved transmission errors at constant torque by normal deviations that all teeth share.

    A flank that is higher by f at the contact takes f from the gap. Where f rises along the flank the arm grows by f'
    times the foot's rate, and the contact lies up the rise, where the curvature is another
    (docs/theory/identification.md).

    Parameters
    ----------
    crank_angles, transmission_error
        Crank angles and the solved transmission errors there, shape (angles,), rad.
    places, waves
        Profile parameters from one root to the next, shape (points,), rad, and deviations there, > 0 material added,
        linear between them, shape (waves, points), m for each unit.
    out
        Overwritten, shape (angles, waves): rad for each unit.
    """
    contacts = contact_rows(problem)
    pitch = 2.0 * math.pi / problem.teeth
    for i in range(crank_angles.size):
        place_contacts(problem, crank_angles[i], transmission_error[i], contacts, i == 0, math.inf, BOUNDED)
        load(problem, contacts)
        stiffness = 0.0
        for wave in range(waves.shape[0]):
            out[i, wave] = 0.0
        for row in range(contacts.shape[0]):
            contact = contacts[row]
            if contact.force <= 0.0:
                continue
            stiffness += rotational_stiffness(contact)
            along = contact.profile_parameter - math.floor(contact.profile_parameter / pitch) * pitch
            after = min(max(int(np.searchsorted(profile_parameters, along)), 1), profile_parameters.size - 1)
            width = profile_parameters[after] - profile_parameters[after - 1]
            share = (along - profile_parameters[after - 1]) / width
            local = local_frame(problem, crank_angles[i], transmission_error[i], contacts, row)
            stretch = 1.0 / (local.speed * local.foot)
            # Second derivative of the axis' distance from the flank along it.
            bend = local.speed / local.foot * (1.0 - problem.generating_radius * local.bend * stretch)
            upwards = problem.pin_radius[local.pin] / bend
            by_rise = contact.force_by_curvature * contact.curvature_rate * contact.arm * upwards
            by_rise += contact.force * contact.foot_rate
            for wave in range(waves.shape[0]):
                low, high = waves[wave, after - 1], waves[wave, after]
                height, rise = (1.0 - share) * low + share * high, (high - low) / width
                out[i, wave] -= contact.stiffness * contact.arm * height + by_rise * rise
        for wave in range(waves.shape[0]):
            out[i, wave] /= stiffness
