"""Accuracy of a joint with a compensator made from recordings of its drive, judged on independent drives.

`python studies/judged_joint.py DRIVES` prints the table of docs/compensation_accuracy.md. Drives are `second_drive`'s,
joints those of `joint_plant`: neither shares anything with the product's kernels. A drive is recorded on a bench with
real encoders' errors, `fitting.identify` finds its errors, and the controller of the joint has only these.
"""

import dataclasses
import functools
import itertools
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import second_drive
from benches_as_they_are import springs
from joint_plant import (
    ARCSEC,
    Friction,
    Joint,
    Profile,
    Sensors,
    Teeth,
    bent,
    level,
    moved,
    quintic,
    tabulated,
    torques,
)
from sampled_drives import SMALL, structured

import cycloid_fmu as cy
import fitting
from cycloid_fmu.compensation.compensator import Memory, step
from cycloid_fmu.drive import Drive
from cycloid_fmu.geometry.pair import read_pair
from fitting.estimation.identify import identify

ROOT = Path(__file__).parent.parent
RATED = 200.0  # N·m
IRON, STEEL = 10.5e-6, 12.3e-6  # 1/K: ring and housing of grey iron; discs, pins and cranks of bearing steel
RISE = 30.0  # K
SIZES = {"11/12": SMALL, "39/40": {}}
WINDUP = 20.0 * ARCSEC / RATED  # rad/(N·m), of all parts behind the teeth


def _arm(points, step):
    angle, speed, acceleration = quintic(np.radians(points), 1.6, 6.0, 0.2, step)
    picked = np.interp(np.arange(angle.size) * step, [1.0, 1.1, 4.0, 4.1, 5.0, 5.1], [0.0, 1.0, 1.0, 0.0, 0.0, 1.0])
    return Profile(step, angle, speed, acceleration, -(90.0 + 60.0 * picked) * np.cos(angle))


def robot(step=1e-3):
    """Moves of an arm, of many lengths, a load picked up and put down; 1.6 rad/s and 6 rad/s² at most.

    It passes the upright position (90°), where gravity changes its sign, twice.
    """
    return _arm([40.0, 65.0, 60.0, 125.0, 115.0, 130.0, 128.0, 55.0, 40.0, 42.0, 65.0, 40.0], step)


def upright(step=1e-3):
    """The same arm, passing the upright position four times."""
    return _arm([60.0, 110.0, 105.0, 125.0, 75.0, 80.0, 60.0, 62.0, 100.0, 120.0, 118.0, 70.0, 60.0], step)


def cyclic(step=4e-3, period=20.0, cycles=1.25):
    """A slow sine of the arm about the upright position."""
    at = 2.0 * np.pi / period
    time = np.arange(round(cycles * period / step)) * step
    way = np.radians(30.0)
    angle = np.pi / 2.0 - way * np.cos(at * time)
    return Profile(step, angle, way * at * np.sin(at * time), way * at**2 * np.cos(at * time), -90.0 * np.cos(angle))


PROFILES = {"robot": robot, "robot, often through upright": upright, "slow sine": cyclic}


@dataclasses.dataclass(frozen=True)
class Rig:
    """A bench and its absolute encoders.

    Attributes
    ----------
    noise, bits
        Of both encoders: noise, rad, and resolution, 2π/2^bits.
    run_out
        Amplitudes of orders 1, 2, 3 of the output, rad.
    late
        Delay of the output's clock, s.
    rate
        Time of a crank turn, s.
    torque
        Error of the torque sensor, share.
    """

    noise: float = 0.5 * ARCSEC
    bits: int = 21
    run_out: tuple[float, ...] = (20.0 * ARCSEC, 3.0 * ARCSEC, 1.0 * ARCSEC)
    late: float = 30e-6
    rate: float = 2.4
    torque: float = 0.002

    def shown(self, angle, generator):
        """An encoder's reading of angles, rad."""
        step = 2.0 * np.pi / 2**self.bits
        return step * np.round((angle + generator.normal(0.0, self.noise, np.shape(angle))) / step)

    def output(self, angle, generator):
        """The reading of the output's encoder, rad."""
        beside = sum(a * np.cos(k * angle + 0.7 * k) for k, a in enumerate(self.run_out, 1))
        return self.shown(angle + beside, generator)


LOADS = (15.0, 50.0, 120.0, 200.0)


def recordings(made, friction, generator, rig=Rig(), loads=LOADS, each=24.37, turns=2, loops=0):
    """Recordings of a drive on the bench: both directions at loads of both signs, and loops with the crank locked."""
    ratio, runs = -made.teeth, []
    size = round(turns * made.teeth * each)
    time = np.arange(size) * rig.rate / each
    for load in (sign * one for one in loads for sign in (1.0, -1.0)):
        for way in (1.0, -1.0):
            theta = generator.uniform(0.0, 2.0 * np.pi) + way * 2.0 * np.pi * time / rig.rate
            speed = way * 2.0 * np.pi / rig.rate / ratio
            torque = load - friction.steady(speed, load)
            angle = theta / ratio + second_drive.transmission_error(made, theta, torque) - speed * rig.late
            runs.append(
                fitting.Run(
                    input_angle=rig.shown(theta, generator),
                    output_angle=rig.output(angle, generator),
                    time=time,
                    torque=load * (1.0 + rig.torque),
                    temperature=293.15,
                    common_zero=True,
                    known_index=True,
                    name=f"{load:g} N·m, {'forward' if way > 0.0 else 'backward'}",
                )
            )
    swing = np.concatenate([np.linspace(0.0, 1.0, 60), np.linspace(1.0, -1.0, 120), np.linspace(-1.0, 0.0, 60)])
    for theta in generator.uniform(0.0, 2.0 * np.pi, loops):
        joint = Joint(tabulated(made, theta, theta, 1.2 * RATED), ratio, friction.at(0.0))
        load = RATED * np.concatenate([swing, swing, swing])
        angle = joint.locked(theta, load)
        runs.append(
            fitting.Run(
                input_angle=rig.shown(np.full(load.size, theta), generator),
                output_angle=rig.output(angle, generator),
                time=0.1 * np.arange(load.size),
                torque=load * (1.0 + rig.torque),
                temperature=293.15,
                common_zero=True,
                known_index=True,
                name=f"loop at {theta:.2f} rad",
            )
        )
    return runs


def as_made(pair, generator, *, scatter=1e-6, form=0.0, bearing=None):
    """A drive within its tolerances: structured errors, scatter of every pin and tooth, and a form of all flanks."""
    draw = generator.normal
    values = structured(pair, generator)
    each = {name: draw(0.0, scatter, pair.pins) for name in ("pin_radial", "pin_tangential")}
    each["tooth_cumulative_pitch"] = draw(0.0, scatter, (pair.discs, pair.gear_teeth))
    waves = draw(size=4) * form / 2.0
    m = pair.modification
    return second_drive.body(
        second_drive.sizes_of(pair),
        values,
        each,
        isometric=m.isometric,
        offset=m.offset,
        discs=pair.discs,
        form=waves if form else (),
        bearing=bearing,
        windup=WINDUP,
    )


def warm(made, rise, ring=None):
    """A drive whose discs, pins and cranks are warmer by `rise` kelvin than 20 °C, its ring by `ring` or the same."""
    inside, outside = 1.0 + STEEL * rise, 1.0 + IRON * (rise if ring is None else ring)
    seat = made.pins / np.abs(made.pins)
    return dataclasses.replace(
        made,
        cut=tuple(one * inside for one in made.cut),
        pin_radius=made.pin_radius * inside,
        pins=made.pins + np.abs(made.pins).mean() * (outside - 1.0) * seat,
        throw=made.throw * inside,
    )


def worn(made, flanks=10e-6, pins=5e-6):
    """A drive whose flanks and pins have lost these depths, m."""
    big, small, throw = made.cut
    return dataclasses.replace(made, cut=(big, small + flanks, throw), pin_radius=made.pin_radius - pins)


@dataclasses.dataclass(frozen=True)
class Case:
    """Difference of a joint from the recorded one.

    Attributes
    ----------
    change
        Returns the changed body of the recorded one.
    rise
        Temperature of its friction above 20 °C, K.
    told
        Reading of the temperature sensor above 20 °C, K.
    index
        Crank angle minus that assumed by the controller, rad, from the pitch of the pins.
    other
        Whether it is another drive with the same tolerances.
    signals
        The load signal of the controller: its gain, offset and noise (N·m) and its delay in samples.
    made
        Properties of the drive that no pair file states, arguments of `as_made`: it is recorded with them.
    """

    change: Callable[[second_drive.Body], second_drive.Body] = lambda made: made
    rise: float = 0.0
    told: float = 0.0
    index: Callable[[float], float] = lambda pitch: 0.0
    other: bool = False
    signals: tuple[float, float, float, int] = (0.03, 0.01 * RATED, 0.2, 1)
    made: tuple[tuple[str, float], ...] = ()


CASES = {
    "as recorded": Case(),
    "as recorded, load known to 0.5 % and 0.2 % of the rated one": Case(signals=(0.005, 0.002 * RATED, 0.2, 0)),
    "as recorded, load known": Case(signals=(0.0, 0.0, 0.0, 0)),
    "flanks with a form of 1 µm": Case(made=(("form", 1e-6),)),
    "disc on springs that no file states": Case(made=(("bearing", springs()["bearing"]),)),
    "index wrong by four crank turns": Case(index=lambda pitch: 8.0 * np.pi),
    "index wrong by five pins": Case(index=lambda pitch: 5.0 * pitch),
    "warm by 30 K, temperature known": Case(lambda made: warm(made, RISE), RISE, RISE),
    "warm by 30 K, temperature not known": Case(lambda made: warm(made, RISE), RISE),
    "warm by 30 K, temperature known, ring 5 K cooler": Case(lambda made: warm(made, RISE, RISE - 5.0), RISE, RISE),
    "worn by 15 µm": Case(worn),
    "another drive": Case(other=True),
}


def joint_of(made, profiles, case=Case(), friction=Friction(), index=0.0, **how):
    """The joint behind a body in a case, its teeth tabulated over all that the profiles need."""
    ratio, made = -made.teeth, case.change(made)
    ends = np.concatenate([[one.angle.min() - 0.01, one.angle.max() + 0.01] for one in profiles]) * ratio + index
    teeth = tabulated(made, ends.min(), ends.max(), 1.2 * RATED)
    return Joint(teeth, ratio, friction.at(case.rise), index, **how)


class Perfect:
    """The inverse of the joint itself, with all true values: its remaining error is the judge's own."""

    def __init__(self, joint, profile):
        whole, bristle, torque = profile.whole_load(joint.inertia), 0.0, None
        motor = joint.ratio * profile.angle[0]
        torque, self.motor, self.at = whole[0], [], 0
        before = motor / joint.ratio + float(joint.teeth.at(motor + joint.index, torque))
        for angle, speed, load in zip(profile.angle[1:], profile.speed[1:], whole[1:], strict=True):
            high = level(joint.friction, abs(speed), abs(torque))
            bristle = bent(bristle, angle - before, high, joint.friction[5])
            torque = load - bristle - joint.friction[4] * (angle - before) / profile.step
            for _ in range(4):
                motor = joint.ratio * (angle - float(joint.teeth.at(motor + joint.index, torque)))
            self.motor.append(motor)
            before = angle

    def __call__(self, *told):
        self.at += 1
        return self.motor[self.at - 1]


class Known:
    """The exact model of a drive, inverted: its error is due to the signals and common to all controllers.

    Parameters
    ----------
    teeth
        At the temperature signal.
    friction
        N·m at the output, and the angle over which the bristles bend, rad.
    doubt
        Standard uncertainty of the load, N·m: the deviation is averaged over it, so that neither flank is assumed where
        either may be in contact.
    outer
        Share of the deviation by an output encoder that is added at each sample.
    """

    def __init__(self, teeth, ratio, friction, presliding=15.0 * ARCSEC, doubt=0.0, outer=0.005, zero=0.0):
        self.teeth, self.ratio, self.friction, self.presliding, self.outer = teeth, ratio, friction, presliding, outer
        self.bristle, self.before, self.missed, self.zero = 0.0, None, 0.0, zero
        share = np.linspace(-2.0, 2.0, 9) if doubt else np.zeros(1)
        self.spread, weight = doubt * share, np.exp(-0.5 * share**2)
        self.weight = weight / weight.sum()

    def __call__(self, angle, speed, load, kelvin, motor, output):
        way = 0.0 if self.before is None else angle - self.before
        if not np.isnan(output) and self.before is not None:
            self.missed += self.outer * (self.before - output)
        self.before = angle
        self.bristle = bent(self.bristle, way, self.friction, self.friction / self.presliding)
        torque = load - self.bristle + self.spread
        motor = self.ratio * angle
        for _ in range(3):
            motor = self.ratio * (angle - self.zero + self.missed - float(self.teeth.at(motor, torque) @ self.weight))
        return motor


def plain(ratio):
    """A controller that compensates nothing."""
    return lambda angle, *told: ratio * angle


@dataclasses.dataclass(frozen=True, eq=False)
class Found:
    """Knowledge of a drive after its recording.

    Attributes
    ----------
    drive
        As identified, with the stated expansion of its materials.
    windup
        Compliance outside the drive, rad/(N·m), from the part of the curves that the drive does not explain.
    friction
        N·m at the output.
    zero
        Of the output's encoder, rad: it can't be separated from the common part of all pins and teeth, so a joint has
        the zero of the bench.
    """

    drive: Drive
    windup: float
    friction: float
    zero: float
    identification: fitting.Identification

    @functools.cached_property
    def compensator(self):
        """The compensator of the product, for 0 to 70 °C."""
        return self.drive.compensator(
            friction=cy.Friction(coulomb=self.friction),
            series_compliance=self.windup,
            temperatures=(273.15, 343.15),
            largest_torque=1.2 * RATED,
            torque_accuracy=0.01 * RATED,
            residual="2 arcsec",
        )

    def teeth(self, profiles, kelvin=0.0, each=360):
        """The teeth of the exact model at the temperature signal, above 20 °C."""
        ends = np.concatenate([[one.angle.min() - 0.01, one.angle.max() + 0.01] for one in profiles]) * self.drive.ratio
        step = 2.0 * np.pi / each
        first = ends.min() - 3.0 * step
        theta = first + step * np.arange(int(np.ceil((ends.max() - first) / step)) + 4)
        loads = torques(1.2 * RATED)
        at = {body: 293.15 + kelvin for body in ("ring", "pins", "discs", "crank", "carrier")}
        error = self.drive.replace(temperature=at).analyze(loads, crank_angle=theta).transmission_error.values
        beyond = np.maximum.accumulate(error + self.windup * loads[:, None], axis=0)
        return Teeth(first, step, np.sign(loads) * np.sqrt(np.abs(loads)), np.ascontiguousarray(beyond.T))


def found_of(pair, made, generator, friction=Friction(), **rig):
    """Record a drive and identify it."""
    runs = recordings(made, friction, generator, **rig)
    expansion = {"ring": IRON, "pins": STEEL, "discs": STEEL, "carrier": STEEL, "crank": STEEL}
    result = identify(runs, Drive(pair.replace(expansion=expansion)), held_out=False)
    rubs = result.bench["friction_torque"]
    loads, left = [], []
    for curve, fitted in zip(result.curves, result.fitted_curves, strict=True):
        torque = curve.torque - curve.direction * np.sign(curve.ratio) * rubs
        error = result.drive.analyze(torque, crank_angle=curve.input_angle).transmission_error.values[0]
        loads.append(torque)
        left.append(np.mean(fitted - error))
    return Found(result.drive, float(np.polyfit(loads, left, 1)[0]), rubs, result.bench["output_angle_offset"], result)


@dataclasses.dataclass(frozen=True)
class Judged:
    """Error of the output with compensation, and without, rad.

    Attributes
    ----------
    rms, peak
        Root mean square and largest over the profile.
    seated
        Root mean square while one flank is loaded: more than 5 % of the rated torque for 50 ms before and after.
    band, gain, holds
        Reported by the controller, NaN if it reports none: share of the samples with an error within two of its
        standard deviations, its last gain, and the share of the time with a report that the model holds.
    """

    rms: float
    peak: float
    seated: float
    plain_rms: float
    plain_peak: float
    plain_seated: float
    band: float = np.nan
    gain: float = np.nan
    holds: float = np.nan

    @property
    def left(self):
        """Share of the rms error that is left."""
        return self.rms / self.plain_rms

    def __str__(self):
        def change(name):
            before, after = (getattr(self, one) / ARCSEC for one in (f"plain_{name}", name))
            return f"{before:.1f}″ -> {after:.2f}″ ({100.0 * (after / before - 1.0):+.1f} %)"

        return f"rms {change('rms')}, largest {change('peak')}, while one flank carries {change('seated')}"


def is_seated(profile, inertia, share=0.05, around=0.05):
    """Samples of a profile at which one flank is loaded."""
    loose = np.abs(profile.whole_load(inertia)) < share * RATED
    return ~(np.convolve(loose, np.ones(2 * round(around / profile.step) + 1), "same") > 0.5)


def judged(joint, profile, controller, sensors=Sensors(), told=0.0, **how):
    """Errors of a joint on a profile with and without a controller; the first 0.1 s are not counted.

    Parameters
    ----------
    controller
        As `joint_plant.moved` calls it.
    told
        Reading of the temperature sensor above 20 °C, K.
    """
    counted = np.arange(profile.angle.size) * profile.step >= 0.1
    seated, every = counted & is_seated(profile, joint.inertia), list[float]()
    own: tuple[float, ...] = ()
    for one in (controller, plain(joint.ratio)):
        error = moved(joint, profile, one, sensors, 293.15 + told, **how).error
        rms, carried = (np.sqrt(np.mean(error[of] ** 2)) for of in (counted, seated))
        every += [float(rms), float(np.abs(error[counted]).max()), float(carried)]
        if said := getattr(one, "said", None):
            bands, gains, held = np.array(said, float).T
            inside = np.abs(error[1:]) < 2.0 * bands
            own = float(inside[counted[1:]].mean()), float(gains[-1]), float(held[counted[1:]].mean())
    return Judged(*every, *own)


def exact_model(found, profiles, told):
    """A controller of the exact model at the temperature signal, newly made."""
    teeth = found.teeth(profiles, told)
    return lambda: Known(teeth, found.drive.ratio, found.friction, doubt=2.0, zero=found.zero)


class Remembering:
    """The product's compensator with a new memory; its reported band, gain and verdict are kept."""

    def __init__(self, compensator, zero=0.0, probability=1.0):
        self.compensator, self.zero, self.memory, self.said = compensator, zero, Memory(0.0, probability), []

    def __call__(self, angle, speed, load, kelvin, motor, output):
        command = step(self.compensator, self.memory, angle - self.zero, speed, load, kelvin, motor, output - self.zero)
        self.said.append((command.band, command.gain, command.holds))
        return command.motor_angle


def compensator(found, profiles, told):
    """The product's compensator, newly made, with windup and friction as found."""
    return lambda: Remembering(found.compensator, found.zero)


def without_index(found, profiles, told):
    """The same, with an index of probability 0."""
    return lambda: Remembering(found.compensator, found.zero, 0.0)


CONTROLLERS = {"exact model": exact_model, "compensator": compensator, "no index stated": without_index}


def drive_of(size, seed, **how):
    """The nominal pair of a size, a drive as made, another of the same tolerances, and a generator for its bench."""
    pair = read_pair(ROOT / "examples" / "drive-39-40.toml").replace(**size, rated_torque=RATED)
    generator = np.random.default_rng([seed, pair.pins])
    return pair, as_made(pair, generator, **how), as_made(pair, generator, **how), generator


def outcomes(size, seed, cases=tuple(CASES), profiles=tuple(PROFILES), controllers=tuple(CONTROLLERS), **how):
    """Results of one drive in all cases: rows of (profile, case, controller, whether there is an encoder, Judged).

    The controllers know only the result of the identification from the drive's recordings.
    """
    rows, motions = [], {name: PROFILES[name]() for name in profiles}
    for how_made in dict.fromkeys(CASES[name].made for name in cases):
        pair, made, other, generator = drive_of(size, seed, **dict(how_made))
        found = found_of(pair, made, generator)
        fresh = functools.cache(lambda name, told, found=found: CONTROLLERS[name](found, list(motions.values()), told))
        for name in (name for name in cases if CASES[name].made == how_made):
            case = CASES[name]
            index = case.index(2.0 * np.pi / pair.pins)
            joint = joint_of(other if case.other else made, list(motions.values()), case, index=index)
            for motion, controller, encoder in itertools.product(motions, controllers, (False, True)):
                sensors = Sensors(*case.signals, encoder=encoder)
                one = fresh(controller, case.told + sensors.warm)()
                outcome = judged(joint, motions[motion], one, sensors, case.told, **how)
                rows.append((motion, name, controller, encoder, outcome))
    return rows


def table(every):
    """Lines of the table of docs/compensation_accuracy.md: root mean square of all drives, and the smallest gain."""
    yield (
        "| profile | case | controller | output encoder | uncompensated, rms | compensated, rms | reduction | smallest "
        "| while one flank carries | largest error | within two bands | gain at the end | model holds |"
    )
    yield f"|{' --- |' * 13}"
    for key in sorted(dict.fromkeys(row[:4] for row in every), key=lambda key: list(PROFILES).index(key[0])):
        of = [row[4] for row in every if row[:4] == key]
        rms = {
            name: np.sqrt(np.mean([getattr(one, name) ** 2 for one in of])) / ARCSEC
            for name in ("rms", "plain_rms", "seated", "plain_seated")
        }
        peak, before = (max(getattr(one, name) for one in of) / ARCSEC for name in ("peak", "plain_peak"))
        motion, case, controller, encoder = key
        own = [np.mean([getattr(one, name) for one in of]) for name in ("band", "gain", "holds")]
        said = "– | – | –" if np.isnan(own[0]) else f"{own[0]:.0%} | {own[1]:.2f} | {own[2]:.0%}"
        yield (
            f"| {motion} | {case} | {controller} | {'yes' if encoder else 'no'} | {rms['plain_rms']:.1f}″ | "
            f"{rms['rms']:.1f}″ | {100.0 * (1.0 - rms['rms'] / rms['plain_rms']):.1f} % | "
            f"{100.0 * (1.0 - max(one.left for one in of)):.1f} % | "
            f"{rms['plain_seated']:.1f}″ → {rms['seated']:.1f}″ | {before:.0f}″ → {peak:.0f}″ | {said} |"
        )


if __name__ == "__main__":
    import joblib

    from cycloid_fmu.edge.commands import Bar

    sys.stdout.reconfigure(encoding="utf-8")  # type: ignore[union-attr]
    every, drives = dict[str, list](), [(size, seed) for size in SIZES for seed in range(int(sys.argv[1]))]
    with Bar("drives", len(drives)) as bar:
        parallel = joblib.Parallel(n_jobs=-1, return_as="generator")
        for (size, _), rows in zip(
            drives, parallel(joblib.delayed(outcomes)(SIZES[size], seed) for size, seed in drives), strict=True
        ):
            every.setdefault(size, []).extend(rows)
            bar.advance()
    for size, rows in every.items():
        print(f"\n{size}, {sys.argv[1]} drives\n")
        for line in table(rows):
            print(line)
