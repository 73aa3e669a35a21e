"""Lives of drives: errors known as after a fit, worn from date to date, measured in place with a coarse encoder.

The drive is one of `second_drive`. Its joint has an absolute encoder of few bits with errors of its own, a torque
signal with a scale error of a few per cent, and unknown friction. `python studies/lived_drives.py DRIVES` prints the
table of docs/recalibrate.md.
"""

import dataclasses
import sys

import numpy as np
import second_drive
from benches_as_they_are import on_bearings

import fitting
from cycloid_fmu.drive import Drive
from cycloid_fmu.geometry.pair import Pair, read_pair
from cycloid_fmu.surfaces.structured import structured_value, with_structured
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.model.observations import errors_of, scatter_names, scatter_parts, with_scatter
from fitting.recalibration.drift import DRIFT, REFERENCE_TURNS, drift_of
from fitting.recalibration.recalibrate import recalibrate

ARCSEC = np.pi / 648000
BITS, KNOWN_TO = 17, 0.3e-6  # bits of the output encoder; standard deviation of each error and pin after the fit, m
TURNS = REFERENCE_TURNS  # crank turns between two dates
LOADS = (0.03, 0.6)  # of the rated torque
HELD = ("misalignment_xz", "misalignment_yz", "isometric", "offset", "pin_radial_1_cos", "pin_radial_1_sin")


def small():
    """A pair of 11 teeth whose flanks have an isometric clearance of 20 µm."""
    return Pair(
        gear_teeth=11,
        pin_circle_radius=50e-3,
        pin_radius=5e-3,
        eccentricity=2.5e-3,
        face_width=10e-3,
        rated_torque=200.0,
        modification={"isometric": "20 um"},
    )


def fitted(pair, generator):
    """A drive after a fit, and the true drive: the surface with its covariance, and values and scatter."""
    names = [n for n in errors_of(pair) if n not in HELD]
    parts = scatter_parts(pair)
    made_so = dict(zip(names, generator.normal(0.0, 1e-6, len(names)), strict=True))
    known = with_structured(surface_of_pair(pair), made_so)
    size = np.concatenate([np.full(len(names), KNOWN_TO), np.full(len(scatter_names(pair)), KNOWN_TO)])
    scatter = generator.normal(0.0, 0.5e-6, len(scatter_names(pair)))
    scatter[parts["pin_radius_deviation"]] *= 0.2
    size[len(names) :][parts["pin_radius_deviation"]] *= 0.3
    surface = with_scatter(known, scatter).replace(
        covariance_of=(*names, *scatter_names(pair)), covariance=np.diag(size**2)
    )
    off = generator.normal(0.0, size)
    values = {n: structured_value(known, n) + d for n, d in zip(names, off, strict=False)}
    return Drive(pair, surface), values, scatter + off[len(names) :]


def on_cranks(drive, stiffness):
    """The same drive after a fit, on three cranks with bearings of a stated stiffness, N/m."""
    pair, surface = on_bearings(drive.pair, drive.surface, stiffness)
    before = drive.surface.covariance_of
    names = [n for n in before if not n.startswith("misalignment")]
    every = [n for n in names if "_at_" not in n] + scatter_names(pair)
    covariance = np.zeros((len(every), len(every)))
    at, of = [every.index(n) for n in names], [before.index(n) for n in names]
    covariance[np.ix_(at, at)] = drive.surface.covariance[np.ix_(of, of)]
    return Drive(pair, surface.replace(covariance_of=tuple(every), covariance=covariance))


def behind(stage, body, ideal, torque):
    """Deviation of the output behind a first stage, rad (docs/theory/reducer.md), by fixed-point iteration."""
    share = 1.0 / (1.0 + stage.crank_share / body.teeth)
    turned = -(1.0 - share) / stage.crank_share * torque / stage.crank_stiffness
    turned = turned - 0.5 * stage.crank_play * np.sign(torque)
    found = np.zeros_like(ideal)
    for _ in range(3):
        theta = ideal + stage.crank_share * found + turned
        x = second_drive.transmission_error(body, theta, share * torque)
        found = share * (x + 0.5 * stage.bearing_play * np.sign(torque) - turned / body.teeth)
    return found


def made(pair, values, scatter, **more):
    """The independent generator's body of these errors, m."""
    each = {n: scatter[p] for n, p in scatter_parts(pair).items()}
    each["pin_radius"] = each.pop("pin_radius_deviation")
    return second_drive.body(
        second_drive.sizes_of(pair),
        values,
        each,
        isometric=pair.modification.isometric,
        offset=pair.modification.offset,
        **more,
    )


def worn(pair, values, scatter, generator, turns=TURNS, drift=DRIFT, monotone=False):
    """The drive after a number of crank turns: thinner flanks, and the usual random drift of all other errors."""
    size = drift_of(pair, [*values], turns, drift)
    walk = generator.normal(0.0, size)
    found = {n: v + w for (n, v), w in zip(values.items(), walk, strict=False)}
    if monotone:
        # Wear only removes material.
        found["pin_radius"] = values["pin_radius"] - abs(walk[list(values).index("pin_radius")])
    return found, scatter + walk[len(values) :]


@dataclasses.dataclass(frozen=True)
class Joint:
    """Constant properties of a joint.

    Errors of the encoder (rad: cosine and sine of orders 1 to 4), relative error of the torque's scale, and friction at
    the output without load relative to the rated torque.
    """

    encoder: np.ndarray
    scale: float
    friction: float

    @classmethod
    def drawn(cls, generator):
        """A joint with usual errors."""
        return cls(
            generator.normal(0.0, [[1.5e-4]] + [[5e-5]] * 3, (4, 2)),
            generator.normal(1.0, 0.04),
            0.01 * abs(generator.normal()),
        )


def recorded(pair, body, joint, load, generator, *, each=73.37, turns=1.0, bits=BITS, noise=0.3 * ARCSEC, stage=None):
    """A run over an output turn at a torque that the joint reports as `load`, N·m; of the sun with a first stage."""
    count = round(turns * pair.gear_teeth * each)
    # Samples at irregular times, so that quantisation errors are not those of a regular grid.
    place = np.arange(count) + generator.uniform(-0.5, 0.5, count)
    angle = generator.uniform(0.0, 2.0 * np.pi) + place * 2.0 * np.pi / each
    angle *= -np.sign(load) * np.sign(pair.ratio)
    friction = (joint.friction * pair.rated_torque * np.sign(load) + 0.005 * load) * generator.normal(1.0, 0.2)
    torque = joint.scale * load + friction
    if stage is None:
        output = angle / pair.ratio + second_drive.transmission_error(body, angle, torque)
    else:
        error = behind(stage, body, angle, torque)
        angle = angle * stage.ratio(pair.gear_teeth) / pair.ratio
        output = angle / stage.ratio(pair.gear_teeth) + error
    orders = np.arange(1, 5)[:, None]
    err = joint.encoder[:, 0] @ np.cos(orders * output) + joint.encoder[:, 1] @ np.sin(orders * output)
    step = 2.0 * np.pi / 2**bits
    output = np.round((output + err + generator.normal(0.0, noise, count)) / step) * step
    return fitting.Run(
        input_angle=angle, output_angle=output, torque=load, common_zero=True, known_index=True, name=f"{load:g} N·m"
    )


def visit(pair, body, joint, generator, loads=LOADS, **more):
    """The recordings of a date: a turn in each direction at every load."""
    return [
        recorded(pair, body, joint, way * share * pair.rated_torque, generator, **more)
        for share in loads
        for way in (1.0, -1.0)
    ]


def backlash(pair, body, torque=1e-2, stage=None):
    """The mean play over an output turn, rad, or for a torque above zero the mean lost motion."""
    # Steps that do not alias any order of pins or teeth: 24 per crank turn have an error of 0.8″ with 12 pins.
    count = 24 * pair.gear_teeth + 1
    angle = np.arange(count) * 2.0 * np.pi * pair.gear_teeth / count
    turned = [
        second_drive.transmission_error(body, angle, t) if stage is None else behind(stage, body, angle, t)
        for t in (torque, -torque)
    ]
    return float(np.mean(turned[0] - turned[1]))


def life(pair, seed, dates, *, form=0.0, drift=DRIFT, monotone=False, **more):
    """A life: the recalibrations at its dates, and the true backlash and lost motion at each, shape (dates, 2).

    `form` is the drift of each of four orders of the flank form relative to the uniform wear.
    """
    generator = np.random.default_rng([28, seed])
    drive, values, scatter = fitted(pair, generator)
    joint = Joint.drawn(generator)
    now, found, true, shape = drive, [], [], np.zeros(4)
    for _ in range(dates):
        values, scatter = worn(pair, values, scatter, generator, drift=drift, monotone=monotone)
        shape = shape + generator.normal(0.0, form * drift, 4) if form else shape
        body = made(pair, values, scatter, form=shape if form else ())
        now = recalibrate(now, visit(pair, body, joint, generator, **more), crank_turns=TURNS, bits=BITS)
        found.append(now)
        true.append([backlash(pair, body), backlash(pair, body, 0.03 * pair.rated_torque)])
    return found, np.array(true)


def off(found, true):
    """Errors of the figures in standard errors, shape (dates, 2)."""
    names = ("backlash", "lost_motion")
    value = np.array([[f.figures[n].value for n in names] for f in found])
    error = np.array([[f.figures[n].standard_error for n in names] for f in found])
    return (value - true) / error


def table(drives, pair, dates=5, **more):
    """Result lines of drives over their lives."""
    every, alarms, widths = [], 0, []
    for seed in range(drives):
        found, true = life(pair, seed, dates, **more)
        every.append(off(found, true))
        alarms += sum(bool(one.alarm) for one in found)
        widths.append([1.96 * one.figures["backlash"].standard_error / ARCSEC for one in found])
        print(seed, np.round(every[-1][:, 0], 1).tolist(), *(one.alarm for one in found), file=sys.stderr, flush=True)
    away = np.concatenate(every)
    inside, spread = np.mean(np.abs(away) < 1.96, axis=0), np.sqrt((away**2).mean(axis=0))
    yield f"{drives} drives, {dates} dates: inside {inside}, rms distance {spread} standard errors"
    yield f"alarms {alarms} of {drives * dates}; half widths of the backlash [arcsec] {np.mean(widths, axis=0)}"


if __name__ == "__main__":
    nominal = small() if len(sys.argv) < 3 else read_pair(sys.argv[2])
    for line in table(int(sys.argv[1]), nominal, form=float(sys.argv[3]) if len(sys.argv) > 3 else 0.0):
        print(line, flush=True)
