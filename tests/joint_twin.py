"""The run-time of a cycloid joint in Python, for comparison with the library: the same steps, written once more."""

import math

ELEMENTS, PRESLIDING_TIME = 5, 2e-3
SHARE = 2.0 / (ELEMENTS * (ELEMENTS + 1.0))
LAW = ("coulomb", "stribeck", "stribeck_speed", "viscous", "presliding_angle")


def clipped(value, least, most):
    return least if value < least else most if value > most else value


class Flange:
    """Friction at one flange, with the strains of its elements."""

    def __init__(self, law, losses, rated):
        self.law, self.losses, self.strain = law, losses, [0.0] * ELEMENTS
        low, high = self.yields(rated, 0.0)
        self.stiffness = 2.0 * max(low, high) / (law["presliding_angle"] * (ELEMENTS + 1))

    def yields(self, load, speed):
        """Friction that slides towards negative and towards positive angles."""
        law = self.law
        torque = law["coulomb"] + law["load_share"] * abs(load)
        if law["stribeck"] > 0.0:
            share = speed / law["stribeck_speed"]
            torque += law["stribeck"] * math.exp(-min(share * share, 700.0))
        return torque + self.lost(-load), torque + self.lost(load)

    def lost(self, asked):
        """Loss of the motor's mesh while the teeth ask for this torque in the direction of motion."""
        if self.losses is None or self.losses == (1.0, 1.0):
            return 0.0
        driving, back = self.losses
        return asked / driving - asked if asked >= 0.0 else back * asked - asked

    def slide(self, way, time, low, high):
        """Mean torque over a displacement, its slope, and the strains after it."""
        k, damping = self.stiffness, self.stiffness * PRESLIDING_TIME / time
        total, slope, following = 0.0, 0.0, []
        for i, strain in enumerate(self.strain, 1):
            least, most = -i * (SHARE * low / k), i * (SHARE * high / k)
            start = clipped(strain, least, most)
            end = start + way
            if least <= end <= most:
                stuck, mean, change = way, k * (start + 0.5 * way), 0.5 * k
            else:
                end = most if way > 0.0 else least
                stuck = end - start
                change = stuck / way
                change *= 0.5 * k * change
                mean = k * end - change * way
            damped = damping * stuck
            room = i * (SHARE * (high if way > 0.0 else -low)) - mean
            if abs(damped) >= abs(room):
                damped, change = room, 0.0
            elif stuck == way:
                change += damping
            total += mean + damped
            slope += change
            following.append(end)
        return total, slope, following

    def way(self, inertia, torque, drag, speed, load, time):
        """Way of an inertia in a time, and the mean torque of friction; the strains move."""
        viscous = self.law["viscous"]
        slope = 2.0 * inertia / (time * time) + (drag + viscous) / time
        wanted = torque + 2.0 * inertia * speed / time
        if self.stiffness == 0.0:
            way = wanted / slope
            return way, viscous * way / time
        (low, high), way, least = self.yields(load, speed), speed * time, 1e-6
        for _ in range(50):
            total, steep, following = self.slide(way, time, low, high)
            new = way - (slope * way + total - wanted) / (slope + steep)
            if abs(new - way) <= 1e-13 * (abs(way) + abs(wanted) / slope):
                break
            if new * way < 0.0:
                new *= least
                least *= 1e-6
            way = new
        self.strain = following
        return way, total + viscous * way / time


class Twin:
    """As `JointDrive`, of the values by dotted name."""

    def __init__(self, values, h, motor_angle):
        self.values, self.h, self.angle, self.speed = values, h, motor_angle, 0.0
        self.ratio, self.inertia, rated = values["ratio"], values["rotor_inertia"], values["rated_torque"]
        laws = [{name: values[f"friction.{side}.{name}"] or 0.0 for name in LAW} for side in ("motor", "output")]
        laws[0]["load_share"], laws[1]["load_share"] = 0.0, values["friction.output.load_share"]
        losses = values["friction.motor.efficiency_driving"], values["friction.motor.efficiency_back_driving"]
        self.flanges = Flange(laws[0], losses, rated / self.ratio), Flange(laws[1], None, rated)
        self.points = self.rows("stiffness", ("torque", "windup"))
        self.error = self.rows("te_orders", ("order", "amplitude", "phase"))
        self.loose = self.rows("play_orders", ("order", "amplitude", "phase"))
        steps = zip(self.points, self.points[1:], strict=False)
        self.stiffest = max((high[0] - low[0]) / (high[1] - low[1]) for low, high in steps)

    def rows(self, name, members):
        found = []
        while f"{name}.{len(found)}.{members[0]}" in self.values:
            found.append([self.values[f"{name}.{len(found)}.{member}"] for member in members])
        return found

    def waves(self, rows, angle):
        phases = [order * angle / self.ratio + phase for order, _, phase in rows]
        value = sum(row[1] * math.sin(phase) for row, phase in zip(rows, phases, strict=True))
        rate = sum(row[1] * row[0] / self.ratio * math.cos(p) for row, p in zip(rows, phases, strict=True))
        return value, rate

    def elastic(self, windup):
        k = next((k for k in range(1, len(self.points) - 1) if windup <= self.points[k][1]), len(self.points) - 1)
        (low, start), (high, end) = self.points[k - 1 : k + 1]
        return low + (windup - start) * (high - low) / (end - start)

    def teeth(self, angle, speed, arm, arm_speed):
        """Torque of the teeth on the rotor, and against the arm."""
        (error, error_rate), (loose, loose_rate) = (self.waves(rows, angle) for rows in (self.error, self.loose))
        deviation = arm - angle / self.ratio - error
        gap, lever = max(0.5 * (self.values["play"] + loose), 0.0), 1.0 / self.ratio + error_rate
        windup = abs(deviation) - gap
        if windup <= 0.0:
            return 0.0, 0.0
        torque = self.elastic(windup)
        damped = clipped(self.values["mesh_damping"] * (arm_speed - speed * lever), -torque, torque)
        against = (-torque if deviation < 0.0 else torque) + damped
        return against * lever + (0.5 * torque * loose_rate if gap > 0.0 else 0.0), against

    def step(self, command, phi, w, inertia, force, slope):
        motor, output = self.flanges
        own, kp, kd, wanted, wanted_speed = command
        teeth = self.stiffest * (1.0 / (self.inertia * self.ratio**2) + 1.0 / inertia)
        held = ELEMENTS * (motor.stiffness / self.inertia + output.stiffness / inertia)
        parts = math.ceil(self.h / min(0.3 / math.sqrt(teeth + held), 1.0 / 3000.0))
        time, impulse = self.h / parts, 0.0
        for i in range(parts):
            middle = self.angle + 0.5 * time * self.speed
            rotor, against = self.teeth(middle, self.speed, phi + 0.5 * time * w, w)
            asked = own + kp * (wanted - middle) + kd * wanted_speed
            other = force + slope * (i + 0.5) * time
            way, _ = motor.way(self.inertia, asked + rotor, kd, self.speed, -rotor, time)
            arm_way, friction = output.way(inertia, other - against, 0.0, w, against, time)
            impulse -= time * (against + friction)
            self.angle += way
            phi += arm_way
            self.speed = 2.0 * way / time - self.speed
            w = 2.0 * arm_way / time - w
        return impulse / self.h, phi
