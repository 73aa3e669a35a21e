"""Wear of an error-free pair by boundary elements: a second computation without Hertz's pressure and without averages.

At each crank angle of one pin pitch all pins share the load over half planes: pressures p >= 0 on equal elements of the
flank, gaps that the elastic displacement closes, and the torque. Archard's law removes k_0 p per metre of sliding from
flank and pin, step by step. It shares the formula of the flank with the package, and no solver. SI units.
"""

import numpy as np
from scipy.linalg import toeplitz
from scipy.special import xlogy

_ANGLES, _REACH = 20, 1.0e-3  # crank angles of a pitch; farthest element from a contact's middle, m


class Mesh:
    """Gaps of all pins at the crank angles of one pitch, gear out, on a rigid crank.

    Parameters
    ----------
    pair
        A pair without errors, one disc, contact law as printed.
    elements
        Of a tooth's flanks from root to root, of equal arc; a pin's half has as many.
    """

    def __init__(self, pair, elements):
        self.teeth, self.width, self.pin_radius = pair.gear_teeth, pair.face_width, pair.pin_radius
        self.circle, throw, pins = pair.pin_circle_radius, pair.eccentricity, pair.pins
        made = self.circle + pair.modification.offset, self.pin_radius + pair.modification.isometric, throw
        points, length, bend = _flank(made, self.teeth, elements)
        self.element, self.elements = length / elements, elements
        self.pin_element = np.pi * self.pin_radius / elements
        self.give = [(1.0 - m.poissons_ratio**2) / m.youngs_modulus for m in (pair.material.gear, pair.material.pin)]
        both = sum(self.give)
        # Displacement of an element's middle by unit pressure on another, less the far constant of the approach.
        edge = (np.arange(4000) + 0.5) * self.element
        edges = np.concatenate([[-edge[0]], edge])
        primitive = xlogy(edges, np.abs(edges)) - edges
        self.influence = -2.0 * both / np.pi * np.diff(primitive)
        turns = np.exp(2j * np.pi * np.arange(self.teeth) / self.teeth)
        self.contacts = []
        for theta in (np.arange(_ANGLES) + 0.5) / _ANGLES * 2.0 * np.pi / pins:
            found = []
            centre, gear = throw * np.exp(1j * theta), np.exp(-1j * theta / self.teeth)
            for axis in self.circle * np.exp(2j * np.pi * np.arange(pins) / pins):
                seen = (axis - centre) / gear
                distance = np.abs(seen - points[None, :] * turns[:, None])
                tooth, nearest = np.unravel_index(distance.argmin(), distance.shape)
                reach = int(_REACH / self.element)
                if not reach < nearest < elements - reach:
                    continue
                part = np.arange(nearest - reach, nearest + reach + 1)
                away = points[part] * turns[tooth] - seen  # from the pin's axis to the flank, in the gear's frame
                normal = -away / np.abs(away)
                # A rotation of the gear by x moves the flank by i x times its place.
                lever = (np.conj(1j * (seen + away)) * normal).real
                inwards = -axis / abs(axis)
                place = np.angle(away * gear / inwards) / np.pi * elements + 0.5 * elements - 0.5
                # Flank and pin as bodies that turn with gear and ring, the crank held, per radian of the ring.
                at = axis + away * gear
                slip = 1j * at - (1.0 + 1.0 / self.teeth) * 1j * (at - centre)
                sliding = np.abs((np.conj(1j * normal * gear) * slip).real)
                constant = self.give[0] * np.log(2.0 / abs(bend[nearest])) + self.give[1] * np.log(
                    2.0 * self.pin_radius
                )
                constant = 2.0 / np.pi * (constant - both)
                found.append((part, np.abs(away) - self.pin_radius, lever, place, sliding, constant))
            self.contacts.append(found)

    def pressures(self, contacts, gear, pin, torque, active):
        """Pressures on the elements of each contact of one crank angle, Pa; begins with `active`, and updates it."""
        gaps = []
        for part, gap, _, place, _, _ in contacts:
            low = np.floor(place).astype(int)
            share = place - low
            gaps.append(gap + gear[part] + (1.0 - share) * pin[low] + share * pin[low + 1])
        count = len(gaps[0])
        block = toeplitz(self.influence[:count])
        for _ in range(200):
            fixed, turning = [], []
            for (_, _, lever, _, _, constant), gap, on in zip(contacts, gaps, active, strict=True):
                matrix = block[np.ix_(on, on)] + constant * self.element
                both = (
                    np.linalg.solve(matrix, np.stack([-gap[on], lever[on]], axis=1)) if on.any() else np.zeros((0, 2))
                )
                fixed.append(both[:, 0])
                turning.append(both[:, 1])
            area = self.element * self.width
            arms = [c[2][on] for c, on in zip(contacts, active, strict=True)]
            carried = sum(a @ p for a, p in zip(arms, fixed, strict=True)) * area
            slope = sum(a @ p for a, p in zip(arms, turning, strict=True)) * area
            rotation = (torque - carried) / slope
            changed, found = 0, []
            for (_, _, lever, _, _, constant), gap, on, p0, p1 in zip(
                contacts, gaps, active, fixed, turning, strict=True
            ):
                pressure = np.zeros(count)
                pressure[on] = p0 + p1 * rotation
                open_by = block @ pressure + constant * self.element * pressure.sum() + gap - lever * rotation
                following = np.where(on, pressure > 0.0, open_by < 0.0)
                changed += int((following != on).sum())
                on[:] = following
                found.append(pressure)
            if changed == 0:
                return found
        raise ValueError("the areas of contact did not settle")

    def wear(self, torque, dose, steps):
        """Depth of each element of a tooth and of a pin, m, and the volumes that Archard's law states, m³.

        Parameters
        ----------
        torque
            N·m on the output.
        dose, steps
            Wear coefficient times crank turns, m²/N, in so many equal steps.
        """
        gear, pin, volume = np.zeros(self.elements), np.zeros(self.elements), 0.0
        passing = 2.0 * np.pi / (self.teeth + 1) / _ANGLES
        # The flanks of the other side come away from their pins.
        sides = [[c for c in contacts if torque * c[2][c[1].argmin()] > 0.0] for contacts in self.contacts]
        active = [[c[1] < c[1].min() + 5e-6 for c in contacts] for contacts in sides]
        for _ in range(steps):
            lost_gear, lost_pin = np.zeros_like(gear), np.zeros_like(pin)
            for contacts, on in zip(sides, active, strict=True):
                pressures = self.pressures(contacts, gear, pin, torque, on)
                for (part, _, _, place, sliding, _), pressure in zip(contacts, pressures, strict=True):
                    depth = dose / steps * pressure * sliding * passing
                    lost_gear[part] += depth * (self.teeth + 1) / self.teeth
                    low = np.floor(place).astype(int)
                    share, arc = place - low, depth * self.element / self.pin_element
                    np.add.at(lost_pin, low, (1.0 - share) * arc)
                    np.add.at(lost_pin, low + 1, share * arc)
                    volume += depth.sum() * self.element * self.width * (self.teeth + 1)
            gear, pin = gear + lost_gear, pin + lost_pin
        return gear, pin, volume


def _flank(made, teeth, elements):
    """Middles of equal arcs of a tooth's flanks from root to root, whole length (m), and curvature there (1/m)."""
    circle, radius, throw = made
    s = np.linspace(0.0, 2.0 * np.pi, 200001)
    path = (circle - throw * np.exp(1j * s)) * np.exp(1j * s / teeth)
    first = np.gradient(path, s, edge_order=2)
    second = np.gradient(first, s, edge_order=2)
    speed = np.abs(first)
    kappa = (np.conj(first) * second).imag / speed**3
    points = path + radius * 1j * first / speed  # inside the path of the generating pin's centre
    arc = np.concatenate([[0.0], np.cumsum(np.abs(np.diff(points)))])
    middle = (np.arange(elements) + 0.5) / elements * arc[-1]

    def at(values):
        return np.interp(middle, arc, values)

    return at(points.real) + 1j * at(points.imag), arc[-1], at(kappa / (1.0 - radius * kappa))
