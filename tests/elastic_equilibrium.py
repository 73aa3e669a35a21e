"""Slow reference solver of a drive on its bearings with elastic bodies, in plain NumPy.

The balance e + C f(e) = a(q), Aᵀ f = T x̂ of all ports. Only the influence matrices C are those of `cycloid_fmu.bodies`:
gaps, laws, kinematics and iteration are written anew, so that a compiled solution can be held against it. Frames and
unknowns are those of docs/theory/supports.md, q = (x, X, Y, (u, v, y) of each disc, (s, t) of each crank). SI units.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cycloid_fmu.geometry.profile import flank_curvature, flank_normals, flank_points, flank_speed

SECTORS = 48
_ROLLER = 8.06e4 / 2.0 ** (10.0 / 9.0)  # N/mm^(10/9), of 1 mm


class Solution(NamedTuple):
    """A balance: forces are magnitudes, N."""

    x: float
    stiffness: float
    pin_force: np.ndarray
    turning_arm_force: np.ndarray
    crank_bearing_force: np.ndarray
    main_bearing_force: float
    output_roller_force: np.ndarray
    disc_shift: np.ndarray
    crank_torque: float
    compliance: dict


def unit(angle):
    return np.array([np.cos(angle), np.sin(angle)])


def turn(angle):
    return np.array([[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]])


def roller_stiffness(bearing):
    """Of one roller between two raceways, N/m^(10/9)."""
    return _ROLLER * (bearing.roller_length * 1e3) ** (8.0 / 9.0) * 1e3 ** (10.0 / 9.0)


def radial_law(bearing, r):
    """Force and stiffness of a bearing over its radial displacement, by quadrature over its rollers."""
    if bearing.stiffness is not None:
        inside = np.maximum(r - 0.5 * bearing.clearance, 0.0)
        return bearing.stiffness * inside, bearing.stiffness * (inside > 0.0)
    psi = np.linspace(-math.pi, math.pi, 20001)[:-1]
    pressed = np.maximum(np.multiply.outer(r, np.cos(psi)) - 0.5 * bearing.clearance, 0.0)
    scale = bearing.rollers * roller_stiffness(bearing)
    force = scale * (pressed ** (10.0 / 9.0) * np.cos(psi)).mean(axis=-1)
    return force, scale * 10.0 / 9.0 * (pressed ** (1.0 / 9.0) * np.cos(psi) ** 2).mean(axis=-1)


class Drive:
    """A drive with elastic discs at one crank angle.

    Parameters
    ----------
    pair, matrices
        The pair, with its errors of single pins, and the influence matrices of its bodies.
    theta
        Crank angle, rad.
    half_shell
        Diametral clearance of half-shell seats, m; None for the pair's seats.
    """

    def __init__(self, pair, matrices, theta, half_shell=None):
        self.pair, self.matrices, self.theta, self.half_shell = pair, matrices, theta, half_shell
        self.cranks = pair.supports.kind == "cranks"
        self.arms = pair.supports.cranks
        self.sectors = pair.supports.turning_arm.rollers is not None
        self.crank_angle = theta + 2.0 * math.pi * np.arange(pair.discs) / pair.discs
        self.gamma = -theta / pair.gear_teeth
        angle = pair.supports.first_angle + 2.0 * math.pi * np.arange(pair.supports.count) / pair.supports.count
        self.places = pair.supports.circle_radius * unit(angle).T
        self.unknowns = 3 + 3 * pair.discs + 2 * self.arms
        at = 2.0 * math.pi * np.arange(pair.pins) / pair.pins
        radial, tangential = (
            np.array(pair.errors.get(n, np.zeros(pair.pins))) for n in ("pin_radial", "pin_tangential")
        )
        self.pins = ((pair.pin_circle_radius + radial) * unit(at) + tangential * unit(at + 0.5 * math.pi)).T
        per_arm = SECTORS if self.sectors else 2
        rollers = 0 if self.cranks else pair.supports.count
        self.sizes = {
            "pin": pair.discs * pair.pins,
            "arm": pair.discs * self.arms * per_arm,
            "roller": pair.discs * rollers,
            "shaft": 2 * self.arms,
            "main": 2,
        }
        ends = np.cumsum([0, *self.sizes.values()])
        self.of = {name: slice(a, b) for name, a, b in zip(self.sizes, ends, ends[1:], strict=False)}
        self.count = int(ends[-1])
        self.normals = self.ideal_normals()
        self.parts = self.assembled()
        self.influence = sum(self.parts.values())

    def ideal_normals(self):
        """Unit normals out of the gear at the pins' ideal places, in axes at rest, shape (discs, pins, 2)."""
        true = self.pair.replace(isometric=0.0, offset=0.0)
        normals = []
        for angle in self.crank_angle:
            turned = angle / self.pair.gear_teeth
            n = np.array(flank_normals(true, 2.0 * math.pi * np.arange(self.pair.pins) / self.pair.pins + turned))
            normals.append((turn(-turned) @ n).T)
        return np.array(normals)

    def assembled(self):
        """C between all ports, by body."""
        pair, m = self.pair, self.matrices
        names = ("disc", "pin", "ring", "crank", "output_pin", "carrier")
        c = {name: np.zeros((self.count, self.count)) for name in names}
        per_arm = self.sizes["arm"] // pair.discs // self.arms
        rollers = self.sizes["roller"] // pair.discs
        pins = np.arange(self.sizes["pin"]).reshape(pair.discs, pair.pins)
        arms = self.of["arm"].start + np.arange(self.sizes["arm"]).reshape(pair.discs, self.arms, per_arm)
        roller = self.of["roller"].start + np.arange(self.sizes["roller"]).reshape(pair.discs, rollers)
        shafts = self.of["shaft"].start + np.arange(2 * self.arms)
        for j, disc in enumerate(m.discs):
            ports = np.concatenate([pins[j], arms[j].ravel(), roller[j]])
            c["disc"][np.ix_(ports, ports)] += disc.at(self.theta, "sector" if self.sectors else "bore")
        along = unit(2.0 * math.pi * np.arange(SECTORS) / SECTORS).T if self.sectors else np.eye(2)
        for j in range(pair.discs):
            for k in range(pair.discs):
                cosine = (self.normals[j] * self.normals[k]).sum(axis=1)
                if m.pin is not None:
                    c["pin"][pins[j], pins[k]] += m.pin[j, k] * cosine
                if m.crank is not None:
                    for arm in range(self.arms):
                        c["crank"][np.ix_(arms[j, arm], arms[k, arm])] += m.crank[j, k] * along @ along.T
                if m.output_pin is not None:
                    cosine = math.cos(self.crank_angle[j] - self.crank_angle[k])
                    c["output_pin"][roller[j], roller[k]] += m.output_pin[j, k] * cosine
                if m.ring is not None:
                    blocks = m.ring.reshape(pair.pins, 2, pair.pins, 2)
                    between = np.einsum("ia,ialb,lb->il", self.normals[j], blocks, self.normals[k])
                    c["ring"][np.ix_(pins[j], pins[k])] += between
        if m.carrier is not None:
            turned = np.kron(np.eye(self.arms), turn(self.gamma))
            c["carrier"][np.ix_(shafts, shafts)] += turned @ m.carrier @ turned.T
        return c

    # --- rigid approaches and their derivatives by q ---

    def approaches(self, q):
        """a, A = da/dq, and the flank's curvature at each pin."""
        pair = self.pair
        a, by_q = np.zeros(self.count), np.zeros((self.count, self.unknowns))
        curvature = np.zeros(self.sizes["pin"])
        x, main, shafts = q[0], q[1:3], q[3 + 3 * pair.discs :].reshape(-1, 2)
        for j, angle in enumerate(self.crank_angle):
            u, y, first = q[3 + 3 * j : 5 + 3 * j], q[5 + 3 * j], 3 + 3 * j
            rows = slice(j * pair.pins, (j + 1) * pair.pins)
            gap, normal, arm, curvature[rows] = self.gaps(angle, u, y)
            a[rows] = -gap - 0.5 * (pair.supports.pin_seat.clearance if self.half_shell is None else self.half_shell)
            by_q[rows, first : first + 2], by_q[rows, first + 2] = normal, arm
            self.arm_rows(j, u, y, x, main, shafts, a, by_q)
            if not self.cranks:
                self.roller_rows(j, u, y, x, main, a, by_q)
        where = self.of["shaft"]
        a[where] = shafts.ravel()
        by_q[where, 3 + 3 * pair.discs :] = np.eye(2 * self.arms)
        a[self.of["main"]], by_q[self.of["main"], 1:3] = main, np.eye(2)
        return a, by_q, curvature

    def gaps(self, angle, u, y):
        """Gap of each pin to a disc's flank, the normal, the normal's moment arm and the curvature there."""
        pair, turned = self.pair, -angle / self.pair.gear_teeth + y
        centre = pair.eccentricity * unit(angle) + u
        pins = (self.pins - centre) @ turn(turned)
        alpha = 2.0 * math.pi * np.arange(pair.pins) / pair.pins + angle / pair.gear_teeth
        for _ in range(12):
            point, normal = np.array(flank_points(pair, alpha)).T, np.array(flank_normals(pair, alpha)).T
            away = pins - point
            tangent = np.column_stack([-normal[:, 1], normal[:, 0]])
            along, off = (away * tangent).sum(axis=1), (away * normal).sum(axis=1)
            alpha = alpha + along / (flank_speed(pair, alpha) * (1.0 + flank_curvature(pair, alpha) * off))
        arm = point[:, 0] * normal[:, 1] - point[:, 1] * normal[:, 0]
        return off - pair.pin_radius, normal @ turn(turned).T, arm, flank_curvature(pair, alpha)

    def arm_rows(self, j, u, y, x, main, shafts, a, by_q):
        per_arm = self.sizes["arm"] // self.pair.discs // self.arms
        for k in range(self.arms):
            first = self.of["arm"].start + (j * self.arms + k) * per_arm
            rows = slice(first, first + per_arm)
            place = self.places[k] if self.cranks else np.zeros(2)
            d = u - shafts[k] + (turn(self.gamma + y) - turn(self.gamma)) @ place
            by = np.zeros((2, self.unknowns))
            by[:, 3 + 3 * j : 5 + 3 * j] = np.eye(2)
            by[:, 5 + 3 * j] = turn(self.gamma + y + 0.5 * math.pi) @ place
            by[:, 3 + 3 * self.pair.discs + 2 * k :][:, :2] = -np.eye(2)
            if self.cranks:
                d = d - main - (turn(self.gamma + x) - turn(self.gamma)) @ place
                by[:, 0] = -turn(self.gamma + x + 0.5 * math.pi) @ place
                by[:, 1:3] = -np.eye(2)
            if self.sectors:
                along = (turn(self.gamma) @ unit(2.0 * math.pi * np.arange(SECTORS) / SECTORS)).T
                a[rows] = -along @ d - 0.5 * self.pair.supports.turning_arm.clearance
            else:
                along = turn(-self.gamma)
                a[rows] = -along @ d
            by_q[rows] = -along @ by

    def roller_rows(self, j, u, y, x, main, a, by_q):
        roller = self.pair.supports.output_roller
        reach = self.pair.eccentricity + 0.5 * roller.clearance
        for i, place in enumerate(self.places):
            row = self.of["roller"].start + j * len(self.places) + i
            away = self.pair.eccentricity * unit(self.crank_angle[j]) + u - main
            away = away + (turn(self.gamma + y) - turn(self.gamma + x)) @ place
            direction = away / np.hypot(*away)
            a[row] = np.hypot(*away) - reach
            by_q[row, 3 + 3 * j : 5 + 3 * j], by_q[row, 1:3] = direction, -direction
            by_q[row, 5 + 3 * j] = direction @ turn(self.gamma + y + 0.5 * math.pi) @ place
            by_q[row, 0] = -direction @ turn(self.gamma + x + 0.5 * math.pi) @ place

    # --- laws ---

    def forces(self, e, curvature):
        """f(e) and its derivative, a matrix of blocks."""
        supports = self.pair.supports
        f, by_e = np.zeros(self.count), np.zeros((self.count, self.count))
        pins = np.arange(self.sizes["pin"])
        f[pins], by_e[pins, pins] = self.contact(e[pins], curvature)
        rows = np.arange(self.count)[self.of["arm"]]
        if self.sectors:
            scale = supports.turning_arm.rollers / SECTORS * roller_stiffness(supports.turning_arm)
            pressed = np.maximum(e[rows], 0.0)
            f[rows] = scale * pressed ** (10.0 / 9.0)
            by_e[rows, rows] = scale * 10.0 / 9.0 * pressed ** (1.0 / 9.0)
        else:
            self.radial(supports.turning_arm, rows, e, f, by_e)
        rows = np.arange(self.count)[self.of["roller"]]
        if rows.size:
            stiffness = supports.output_roller.stiffness
            f[rows], by_e[rows, rows] = stiffness * np.maximum(e[rows], 0.0), stiffness * (e[rows] > 0.0)
        self.radial(supports.crank_shaft, np.arange(self.count)[self.of["shaft"]], e, f, by_e)
        self.radial(supports.main, np.arange(self.count)[self.of["main"]], e, f, by_e)
        return f, by_e

    @staticmethod
    def radial(bearing, rows, e, f, by_e):
        for pair in rows.reshape(-1, 2):
            r = max(float(np.hypot(*e[pair])), 1e-15)
            direction = e[pair] / r
            force, slope = radial_law(bearing, np.array(r))
            outer = np.outer(direction, direction)
            f[pair] = force * direction
            by_e[np.ix_(pair, pair)] = slope * outer + force / r * (np.eye(2) - outer)

    def contact(self, approach, curvature):
        """Hertz' law, with the gear's constant length of an elastic disc, and the seat, by bisection."""
        pair = self.pair
        gear, pin, width = pair.material.gear.compliance, pair.material.pin.compliance, pair.face_width
        if self.matrices.discs:
            log_radius = 0.25 * self.matrices.discs[0].matrix.patch_half_width * math.exp(0.75)
        else:
            log_radius = np.minimum(1.0 / np.maximum(np.abs(curvature), 1e-9), pair.pin_circle_radius)
        equivalent = 1.0 / np.abs(1.0 / pair.pin_radius + curvature)

        def deflection(force):
            half = np.sqrt(4.0 * force * equivalent * (gear + pin) / (math.pi * width))
            law = gear * (np.log(4.0 * log_radius / half) - 0.5) + pin * (np.log(4.0 * pair.pin_radius / half) - 0.5)
            return 2.0 * force / (math.pi * width) * law + self.seat(force)

        low, high = np.full(approach.size, 1e-12), np.full(approach.size, 1e5)
        for _ in range(120):
            middle = np.sqrt(low * high)
            above = deflection(middle) > approach
            low, high = np.where(above, low, middle), np.where(above, middle, high)
        force = np.sqrt(low * high)
        slope = 2e-5 * force / (deflection(force * (1.0 + 1e-5)) - deflection(force * (1.0 - 1e-5)))
        pressed = approach > 0.0
        return np.where(pressed, force, 0.0), np.where(pressed, slope, 0.0)

    def seat(self, force):
        pair = self.pair
        if self.half_shell is not None:
            modulus = 0.5 / pair.material.pin.compliance
            s = self.half_shell * modulus * pair.face_width / force
            return force / (pair.face_width * modulus) * (0.08 + np.log(s + 1.42) / math.pi)
        stiffness = pair.supports.pin_seat.stiffness_per_width
        return 0.0 if stiffness is None else force / (stiffness * pair.face_width)

    # --- the balance ---

    def solve(self, torque, start=None):
        """Newton's method on q and e together, with steps that are cut where the residual grows."""
        q = np.zeros(self.unknowns) if start is None else start.copy()
        if start is None:
            q[0] = math.copysign(2e-4, torque)
            q[5 : 3 + 3 * self.pair.discs : 3] = q[0]
        target = np.zeros(self.unknowns)
        target[0] = torque
        e = self.approaches(q)[0]
        spring = 1e8
        for step in range(200):
            a, by_q, curvature = self.approaches(q)
            f, by_e = self.forces(e, curvature)
            matrix = np.eye(self.count) + self.influence @ by_e
            first = e + self.influence @ f - a
            second = by_q.T @ f - target
            inner = np.linalg.solve(matrix, np.column_stack([by_q, first]))
            hessian = by_q.T @ by_e @ inner[:, :-1] + np.diag(self.centring(spring))
            move = np.linalg.solve(hessian, -second + by_q.T @ by_e @ inner[:, -1])
            lengths = np.abs(move) * np.where(self.centring(1.0) > 1.0, self.centring(1.0), 1.0)
            factor = min(1.0, 2e-5 / lengths.max())
            e = e + factor * (inner[:, :-1] @ move - inner[:, -1])
            q = q + factor * move
            if step > 5 and factor == 1.0 and np.abs(move).max() < 1e-13 and spring <= 10.0:
                break
            spring = max(10.0, spring * 0.1) if factor == 1.0 else spring
        else:
            raise ArithmeticError("no balance")
        return q, e

    def centring(self, spring):
        """Stiffness of a vanishing spring on each unknown, N/m, or N·m/rad for rotations."""
        springs = np.full(self.unknowns, spring)
        turns = [0, *range(5, 3 + 3 * self.pair.discs, 3)]
        springs[turns] *= self.pair.pin_circle_radius**2
        return springs

    def solution(self, torque, start=None):
        """The balance at a torque, with its figures."""
        q, e = self.solve(torque, start)
        _, by_q, curvature = self.approaches(q)
        f, by_e = self.forces(e, curvature)
        tangent = by_e @ np.linalg.inv(np.eye(self.count) + self.influence @ by_e)
        hessian = by_q.T @ tangent @ by_q + self.geometric(q, f)
        first = np.linalg.solve(hessian, np.eye(self.unknowns)[0])
        force = tangent @ by_q @ first
        strain = (np.eye(self.count) - self.influence @ tangent) @ by_q @ first
        law = {name: float(force[where] @ strain[where]) for name, where in self.of.items()}
        pair = self.pair
        per_arm = f[self.of["arm"]].reshape(pair.discs, self.arms, -1)
        along = unit(2.0 * math.pi * np.arange(SECTORS) / SECTORS).T if self.sectors else np.eye(2)
        shares = {
            **{name: float(force @ part @ force) for name, part in self.parts.items()},
            "mesh": law["pin"],
            "turning_arm": law["arm"],
            "output_roller": law["roller"],
            "crank_shaft": law["shaft"],
            "main": law["main"],
        }
        return Solution(
            x=float(q[0]),
            stiffness=float(1.0 / first[0]),
            pin_force=f[self.of["pin"]].reshape(pair.discs, pair.pins),
            turning_arm_force=np.linalg.norm(per_arm @ along, axis=-1),
            crank_bearing_force=np.linalg.norm(f[self.of["shaft"]].reshape(-1, 2), axis=-1),
            main_bearing_force=float(np.hypot(*f[self.of["main"]])),
            output_roller_force=f[self.of["roller"]].reshape(pair.discs, -1),
            disc_shift=q[3 : 3 + 3 * pair.discs].reshape(-1, 3)[:, :2],
            crank_torque=self.crank_torque(torque, q, f),
            compliance=shares,
        )

    def geometric(self, q, f):
        """Σ f ∂²a/∂q², by differences of A."""
        step, rows = 1e-7, []
        for n in range(self.unknowns):
            there = q + step * np.eye(self.unknowns)[n]
            back = q - step * np.eye(self.unknowns)[n]
            rows.append((self.approaches(there)[1] - self.approaches(back)[1]).T @ f / (2.0 * step))
        return np.array(rows)

    def crank_torque(self, torque, q, f):
        """T/z_c + fᵀ ∂a/∂θ - ½ fᵀ dC/dθ f."""
        step, values = 1e-4, []
        for way in (step, -step):
            there = Drive(self.pair, self.matrices, self.theta + way, self.half_shell)
            values.append(f @ there.approaches(q)[0] - 0.5 * f @ there.influence @ f)
        return torque / self.pair.gear_teeth + float(values[0] - values[1]) / (2.0 * step)
