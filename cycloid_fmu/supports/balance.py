"""Balance of discs, cranks and carrier on their bearings, by Newton's method on all unknowns.

The unknowns q are deviations from the ideal position, in axes that do not rotate: the carrier's rotation x and the
shift of its centre, then the shift (u, v) of each disc's centre and its rotation y, then the shift of each crank's axis
from its position in the carrier. Forces and moments balance where the total energy minus the work of the torque is
stationary.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple

from cycloid_fmu import contact
from cycloid_fmu.contact import Array, Problem, Rows, compiled
from cycloid_fmu.contact.equilibrium import load
from cycloid_fmu.contact.local_frame import contact_stiffness, gap_gradient
from cycloid_fmu.contact.placement import BOUNDED, CLEAR, place_contacts
from cycloid_fmu.supports.elastic import add_ports, press, write_approaches
from cycloid_fmu.supports.joints import FIRST_DISC, Assembly, Work, derivatives, displacement, orient, reaction
from cycloid_fmu.supports.ports import Elastic, has_ports, reach_of, set_exact

NEIGHBOUR = 0.1  # rad: a solution farther away is no useful start
_NEARBY = 0.01  # rad: from a crank angle without a balance that is reached from ideal positions to one that has it
_EXACT = 1e-14  # m: a step within rounding
_LONGEST = 25e-6  # m: largest step
_REACH = 4e-6  # m: pins closer than this are solved at every step, the others after the discs have moved this far
HELD = 1e-3  # N/m: limits a rotation that nothing holds yet; it pulls to the start of the step
_ITERATIONS = 60
_JUMP = 1e-10  # m: steps that end this close show a jump of forces, as where a pin leaves one of two teeth at a root
_CHATTER = 1e-12  # m: steps shorter than this, `_CHATTERING` in turn, go to and fro across a jump of less than some mN
_CHATTERING = 20
_LAST_ITERATIONS = 600  # a drive loose in its clearances converges in small steps


class Load(NamedTuple):
    """Load on the carrier: a torque, and a spring from its rotation x to a held flange; and the centring springs.

    Attributes
    ----------
    torque
        Torque on the carrier, counter-clockwise positive, N·m.
    spring
        Stiffness of the spring, N·m/rad; 0 without a held flange.
    flange
        Rotation of the flange from its ideal angle, rad.
    centring
        Stiffness of a spring in each bearing, for parts that are free in their clearance, N/m.
    """

    torque: float
    spring: float
    flange: float
    centring: float


@compiled
def _place_discs(problem: Problem, assembly: Assembly, crank_angle: float, contacts: Rows, work: Work) -> None:
    """Place the discs according to the unknowns and solve the gaps that may close."""
    q, x = work.coordinates, work.coordinates[0]
    furthest = 0.0
    for disc in range(problem.shift_x.size):
        first = FIRST_DISC + 3 * disc
        problem.shift_x[disc], problem.shift_y[disc], problem.turn[disc] = q[first], q[first + 1], q[first + 2] - x
        pose = work.pose[disc]
        shifted = math.hypot(q[first] - pose[0], q[first + 1] - pose[1])
        furthest = max(furthest, shifted + assembly.rotation_scale * abs(problem.turn[disc] - pose[2]))
        pose[0], pose[1], pose[2] = q[first], q[first + 1], problem.turn[disc]
    cold = work.moved[0] == math.inf
    work.moved[0] += furthest
    reach = reach_of(work.ports)
    clear = _REACH + reach
    if not work.moved[0] < _REACH - CLEAR:
        clear, work.moved[0] = math.inf, 0.0
    place_contacts(problem, crank_angle, x, contacts, cold, clear, BOUNDED + reach)


@compiled
def _add_mesh(problem: Problem, crank_angle: float, contacts: Rows, work: Work) -> None:
    """Add the pins' forces on the discs and the derivatives of these forces."""
    for row in range(contacts.shape[0]):
        force = contacts[row].force
        if force <= 0.0:
            continue
        local = contact.local_frame(problem, crank_angle, work.coordinates[0], contacts, row)
        along = gap_gradient(local)
        stiffness = contact_stiffness(contacts[row], local, along)
        first = FIRST_DISC + 3 * local.disc
        for i in range(3):
            work.residual[first + i] -= force * along.gap[i]
            for j in range(3):
                work.jacobian[first + i, first + j] += stiffness[i][j]


@compiled
def _add_joints(assembly: Assembly, crank_angle: float, centring: float, work: Work) -> None:
    """Add the joints' forces on their two bodies and the derivatives of these forces."""
    residual, jacobian, by, index = work.residual, work.jacobian, work.by, work.indices
    orient(assembly, crank_angle, work)
    for number in range(assembly.joints.size):
        if has_ports(assembly.elastic, number):
            continue
        joint = assembly.joints[number]
        d = displacement(assembly, joint, work)
        acting = reaction(assembly, joint, d, centring)
        if acting.stiffness == 0.0:
            continue
        unknowns = derivatives(assembly, joint, d, work)
        nx, ny, force, across = d.normal_x, d.normal_y, acting.force, acting.across
        kxx = acting.stiffness * nx * nx + across * ny * ny
        kyy = acting.stiffness * ny * ny + across * nx * nx
        kxy = (acting.stiffness - across) * nx * ny
        for i in range(unknowns):
            bx, by_ = by[0, i], by[1, i]
            row = index[i]
            residual[row] += force * (nx * bx + ny * by_)
            kx, ky = kxx * bx + kxy * by_, kxy * bx + kyy * by_
            for j in range(unknowns):
                jacobian[row, index[j]] += kx * by[0, j] + ky * by[1, j]
        # The lever arms rotate as well.
        turn = assembly.bodies[joint.outer].rotation
        if turn >= 0:
            jacobian[turn, turn] -= force * (nx * d.outer_x + ny * d.outer_y)
        turn = assembly.bodies[joint.seat].rotation
        if turn >= 0:
            jacobian[turn, turn] += force * (nx * d.inner_x + ny * d.inner_y)


@compiled
def _add_forces(
    problem: Problem,
    assembly: Assembly,
    elastic: Elastic | None,
    crank_angle: float,
    centring: float,
    contacts: Rows,
    work: Work,
    ports: Any,
) -> None:
    """Add the forces of pins and joints on the bodies, and the derivatives of these forces."""
    if elastic is None:
        load(problem, contacts)
        _add_mesh(problem, crank_angle, contacts, work)
        _add_joints(assembly, crank_angle, centring, work)
    else:
        orient(assembly, crank_angle, work)
        write_approaches(problem, assembly, elastic, crank_angle, contacts, work, ports)
        _, reach = press(problem, assembly, elastic, ports, contacts)
        if reach > ports.reach[0]:
            # Pins farther away may be pressed as well.
            ports.reach[0], work.moved[0] = 1.5 * reach, 1.0
            _place_discs(problem, assembly, crank_angle, contacts, work)
            write_approaches(problem, assembly, elastic, crank_angle, contacts, work, ports)
            press(problem, assembly, elastic, ports, contacts)
        add_ports(problem, assembly, elastic, crank_angle, centring, contacts, work, ports)
        _add_joints(assembly, crank_angle, centring, work)


@compiled
def assemble(
    problem: Problem, assembly: Assembly, crank_angle: float, pull: Load, contacts: Rows, work: Work, more: Any
) -> None:
    """Write the residual of the balance at `work.coordinates`, and its derivatives; `more` is None."""
    _place_discs(problem, assembly, crank_angle, contacts, work)
    for i in range(work.residual.size):
        work.residual[i] = 0.0
        for j in range(work.residual.size):
            work.jacobian[i, j] = 0.0
    _add_forces(problem, assembly, assembly.elastic, crank_angle, pull.centring, contacts, work, work.ports)
    work.residual[0] += pull.spring * (work.coordinates[0] - pull.flange) - pull.torque
    work.jacobian[0, 0] += pull.spring


@compiled
def solve_linear(matrix: Array, right: Array) -> bool:
    """Solve matrix · x = right in place by pivoted elimination, x in `right`; return False if singular."""
    n = right.size
    for k in range(n):
        best = k
        for i in range(k + 1, n):
            if abs(matrix[i, k]) > abs(matrix[best, k]):
                best = i
        if matrix[best, k] == 0.0:
            return False
        if best != k:
            for j in range(k, n):
                matrix[k, j], matrix[best, j] = matrix[best, j], matrix[k, j]
            right[k], right[best] = right[best], right[k]
        for i in range(k + 1, n):
            if matrix[i, k] != 0.0:
                factor = matrix[i, k] / matrix[k, k]
                for j in range(k + 1, n):
                    matrix[i, j] -= factor * matrix[k, j]
                right[i] -= factor * right[k]
    for k in range(n - 1, -1, -1):
        value = right[k]
        for j in range(k + 1, n):
            value -= matrix[k, j] * right[j]
        right[k] = value / matrix[k, k]
    return True


@compiled
def longest_of(problem: Problem, assembly: Assembly, step: Array, power: float) -> float:
    """Longest displacement of a step, m (power 1), or largest force of a residual, N (-1)."""
    scale = assembly.rotation_scale**power
    longest = 0.0
    for i in range(step.size):
        longest = max(longest, abs(step[i]) * (scale if _is_rotation(problem, i) else 1.0))
    return longest


@compiled
def _is_rotation(problem: Problem, i: int) -> bool:
    last = FIRST_DISC + 3 * problem.shift_x.size
    return i == 0 or (FIRST_DISC <= i < last and (i - FIRST_DISC) % 3 == 2)


@compiled
def hold(problem: Problem, assembly: Assembly, work: Work, held: float) -> None:
    """Write the derivatives with springs (N/m) on rotations and, above `HELD`, on all unknowns."""
    for i in range(work.step.size):
        for j in range(work.step.size):
            work.matrix[i, j] = work.jacobian[i, j]
        if _is_rotation(problem, i):
            work.matrix[i, i] += held * assembly.rotation_scale * assembly.rotation_scale
        elif held > HELD:
            work.matrix[i, i] += held


@compiled
def solve_transposed(problem: Problem, assembly: Assembly, work: Work, right: Array, held: float) -> bool:
    """Solve with the transposed derivatives of the balance, `held` as in `hold`; return False if singular."""
    hold(problem, assembly, work, held)
    for i in range(right.size):
        for j in range(i):
            work.matrix[i, j], work.matrix[j, i] = work.matrix[j, i], work.matrix[i, j]
    return solve_linear(work.matrix, right)


@compiled
def torsional_stiffness(problem: Problem, assembly: Assembly, work: Work) -> float:
    """Torsional stiffness dT/dx = 1/(H⁻¹)_xx at the balance, N·m/rad; NaN if the carrier is free."""
    hold(problem, assembly, work, HELD)
    for i in range(work.step.size):
        work.step[i] = 1.0 if i == 0 else 0.0
    return 1.0 / work.step[0] if solve_linear(work.matrix, work.step) else math.nan


@compiled
def _direction(problem: Problem, assembly: Assembly, work: Work) -> float:
    """Write Newton's step, limited if it is no descent or too long; return the fraction to take, 0 for none."""
    step, matrix, n = work.step, work.matrix, work.step.size
    held = HELD
    while held < 1e12:
        for i in range(n):
            step[i] = -work.residual[i]
        hold(problem, assembly, work, held)
        if solve_linear(matrix, step):
            downhill = 0.0
            for i in range(n):
                downhill += step[i] * work.residual[i]
            longest = longest_of(problem, assembly, step, 1.0)
            if downhill < 0.0 and longest < 1e3 * _LONGEST:
                return min(1.0, _LONGEST / longest)
        held *= 1e3
    return 0.0


@compiled
def _between(work: Work, share: float, now: float, low: float, high: float) -> float:
    """Return the fraction of a step at which the work should vanish: by Newton's method, or between the known ends.

    Closing contacts increase the slope of the work along the step, so Newton's method approaches the closing from
    beyond and rarely overshoots.
    """
    step, slope = work.step, 0.0
    for i in range(step.size):
        for j in range(step.size):
            slope += step[i] * work.jacobian[i, j] * step[j]
    crossing = share - now / slope if slope > 0.0 else low
    if low < crossing < high:
        return crossing
    return low + (0.1 if low == 0.0 else 0.5) * (high - low)


_Settle = Callable[[Problem, Assembly, float, Load, Rows, Work, Any, bool], int]


def settling(assembled: Callable[..., Any]) -> _Settle:
    """Return the kernel that solves a balance.

    Parameters
    ----------
    assembled
        Kernel such as `assemble`: it writes the residual and its derivatives, and may add forces that store no energy.
    """

    @compiled
    def balance(
        problem: Problem,
        assembly: Assembly,
        crank_angle: float,
        pull: Load,
        contacts: Rows,
        work: Work,
        more: Any,
        iterations: int,
    ) -> int:
        """Solve the balance from `work.coordinates`, which is overwritten; return the number of steps, 0 without one.

        If the work along a step has changed its sign at the end, the step is shortened until the work is at most half
        as large, with either sign: energies are convex for small rotations. Otherwise a contact that closes within the
        step would be missed, and the next step would overshoot too.
        """
        assembled(problem, assembly, crank_angle, pull, contacts, work, more)
        q, short = work.coordinates, 0
        for iteration in range(iterations):
            unbalanced = longest_of(problem, assembly, work.residual, -1.0)
            if unbalanced < assembly.balanced:
                return iteration + 1
            share = _direction(problem, assembly, work)
            if share == 0.0:
                return 0
            step, longest = work.step, longest_of(problem, assembly, work.step, 1.0)
            short = short + 1 if longest < _CHATTER else 0
            if longest < _EXACT or short > _CHATTERING:
                return iteration + 1
            downhill = 0.0
            for i in range(step.size):
                work.before[i] = q[i]
                downhill += step[i] * work.residual[i]
            low, high, met = 0.0, math.inf, True
            for _ in range(36 if iterations == _LAST_ITERATIONS else 12):
                for i in range(step.size):
                    q[i] = work.before[i] + share * step[i]
                assembled(problem, assembly, crank_angle, pull, contacts, work, more)
                now = 0.0
                for i in range(step.size):
                    now += step[i] * work.residual[i]
                if now > -0.5 * downhill:
                    high = share
                elif now < 0.5 * downhill and high < math.inf:
                    low = share
                else:
                    met = False
                    break
                share = _between(work, share, now, low, high)
            if met and iterations == _LAST_ITERATIONS:
                # Steps may alternate for ever between the two sides of a jump.
                for i in range(step.size):
                    work.before[i], work.jump[i] = q[i] - work.jump[i], q[i]
                if longest_of(problem, assembly, work.before, 1.0) < _JUMP:
                    return iteration + 1
        return 0

    @compiled
    def settle(
        problem: Problem,
        assembly: Assembly,
        crank_angle: float,
        pull: Load,
        contacts: Rows,
        work: Work,
        more: Any,
        cold: bool,
    ) -> int:
        """Solve the balance from `work.coordinates` or, if `cold` or without success, from ideal positions.

        Return the number of steps, 0 without a balance.
        """
        total = taken = 0
        set_exact(work.ports, 0.0)
        # Stages: 0 from the given positions, 1 from ideal ones, 2 from these with centring springs that soften. All of
        # them fail within 1e-5 rad of a symmetric position of a drive that jams; there stage 3 is stage 2 at a crank
        # angle nearby, and stage 4 starts from its balance.
        for stage in range(1 if cold else 0, 5):
            angle = crank_angle + _NEARBY if stage == 3 else crank_angle
            if 0 < stage < 4:
                for i in range(work.coordinates.size):
                    work.coordinates[i] = 0.0
                work.moved[0] = math.inf
            spring, taken = 1e8 if stage in (2, 3) else pull.centring, 0
            while True:
                most = _LAST_ITERATIONS if stage >= 2 and spring == pull.centring else _ITERATIONS
                stage_pull = Load(pull.torque, pull.spring, pull.flange, spring)
                taken = balance(problem, assembly, angle, stage_pull, contacts, work, more, most)
                total += taken if taken > 0 else most
                if spring == pull.centring:
                    break
                spring = max(0.1 * spring, pull.centring)
            if (taken > 0) != (stage == 3):
                break
        if set_exact(work.ports, 1.0) and taken > 0:
            assembled(problem, assembly, crank_angle, pull, contacts, work, more)
        return total if taken > 0 else 0

    return settle


settle = settling(assemble)
