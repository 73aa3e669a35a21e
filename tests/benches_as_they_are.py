"""Recordings of drives and benches that do what the model of rigid supports and quiet encoders does not hold.

`python tests/benches_as_they_are.py DRIVES` prints the table of docs/identify.md; effects may follow.
"""

import contextlib
import sys
from pathlib import Path

import numpy as np
from sampled_drives import ARCSEC, LOADS, SMALL, distances, random_drive

import fitting
from cycloid_fmu import edge
from cycloid_fmu.contact.transmission import solve
from cycloid_fmu.drive import Drive
from cycloid_fmu.geometry.pair import Pair, read_pair
from cycloid_fmu.supports.transmission import solve as solve_on_bearings
from cycloid_fmu.surfaces.structured import structured_value, with_structured
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation.identify import identify

NOISE, STEP = 0.5 * ARCSEC, 1e-2  # rad; s from one sample to the next
# What the verdict should name, among what it can't tell from it; None where nothing is to be seen.
EFFECTS = {
    "none": None,
    "ring shifts 4 µm with the load": "support_give",
    "crank bearing gives 3 µm radially, 8 µm tangentially at 250 N·m": "support_give",
    "soft crank, 1 µm at 200 N·m": "support_give",
    "speed ripple and an output clock 30 µs late": "clock_lag",
    "zero drifts 12″ and a 4″ wave": "drift",
    "run-out 60″, orders 2 and 3": "run_out",
    "output subdivision 1″": "orders",
    "first stage 3″ at no whole order": "orders",
    "torque ripple 10 % that the sensor does not see": "torque_ripple",
    "17-bit encoders": None,
    "three tenths of the turn missing": None,
    "discs and cranks on bearings": "support_give",
    "the same, its bearings stated": None,
    "two discs, 8 µm of phase between them": None,
}


def on_bearings(pair, surface, stiffness=1e9):
    """The same drive and errors on three cranks in bearings of this stiffness, N/m."""
    keys = ("gear_teeth", "pins", "pin_circle_radius", "pin_radius", "eccentricity", "face_width", "rated_torque")
    supports = {
        "kind": "cranks", "count": 3, "circle_radius": 0.026, "first_angle": 0.3,
        "turning_arm": {"stiffness": stiffness}, "crank_shaft": {"stiffness": stiffness},
        "main": {"stiffness": 3.0 * stiffness},
    }  # fmt: skip
    floating = Pair(**{k: getattr(pair, k) for k in keys}, supports=supports)
    own = surface_of_pair(floating)
    there = {n: e for n, e in surface.errors.items() if n in own.errors and not n.startswith("misalignment")}
    return floating, own.replace(**there)


def recorded(effect, pair, surface, load, generator, each, turns):
    """A run of the drive with an effect, at so many samples a crank turn."""
    time = np.arange(round(turns * abs(pair.ratio) * each)) * STEP
    speed, begin, phase = 2.0 * np.pi / each / STEP, *generator.uniform(0.0, 2.0 * np.pi, 2)
    ahead, late = 0.0, 0.0
    if effect.startswith("ring"):
        surface = _moved(pair, surface, centre_distance_x=4e-6 * load / 200.0, centre_distance_y=2e-6 * load / 200.0)
    if effect.startswith("crank bearing"):
        surface, ahead = _moved(pair, surface, eccentricity=3e-6 * abs(load) / 250.0), 8e-6 * load / 250.0
    if effect.startswith("soft"):
        surface = _moved(pair, surface, eccentricity=1e-6 * abs(load) / 200.0)
    if effect.startswith("speed"):
        late = 30e-6

    def crank(at):
        ripple = 0.15 * np.sin(speed * at + phase) + 0.3 * np.sin(3.0 * speed * at / abs(pair.ratio))
        return np.sign(load) * (begin + speed * at + ripple * effect.startswith("speed"))

    seen, angle = crank(time), crank(time - late)
    if effect.startswith("two discs"):
        pitch = np.array(surface.tooth_cumulative_pitch)
        pitch[1] += 8e-6
        surface = surface.replace(tooth_cumulative_pitch=pitch)
    if effect.startswith(("discs", "the same")):
        error = solve_on_bearings(*on_bearings(pair, surface), load, angle, with_play=False).transmission_error[0]
    else:
        turned = angle + ahead / pair.eccentricity
        error = solve(pair, surface, load, turned, with_play=False).transmission_error[0]
    output, share = angle / pair.ratio, time / time[-1]
    beside = {
        "zero": 12.0 * share + 4.0 * np.sin(1.7 * np.pi * share + phase),
        "run-out": 60.0 * np.cos(output + 1.0) + 8.0 * np.cos(2.0 * output) + 4.0 * np.sin(3.0 * output),
        "output": np.cos(64.0 * output + 1.0),
        "first": 3.0 * np.cos(0.37 * angle + phase),
        "torque": 0.1 * 0.02 * load * np.cos(angle + 1.0),
    }.get(effect.split()[0], 0.0)
    shown = output + error + ARCSEC * beside + generator.normal(0.0, NOISE, time.size)
    if effect.startswith("17-bit"):
        shown = np.round(shown / (2.0 * np.pi) * 2**17) / 2**17 * 2.0 * np.pi
    there = np.ones(time.size, bool)
    if effect.startswith("three tenths"):
        place = np.mod(output / (2.0 * np.pi), 1.0)
        there = ~((place > 0.2) & (place < 0.4) | (place > 0.6) & (place < 0.7))
    return fitting.Run(
        input_angle=seen[there], output_angle=shown[there], torque=load, time=time[there], common_zero=True,
        known_index=True, name=f"{load:g} N·m",
    )  # fmt: skip


def _moved(pair, surface, **by):
    return with_structured(pair, surface, {n: structured_value(pair, surface, n) + v for n, v in by.items()})


def identified(effect, pair, seed, *, each=24.37, turns=2, loads=LOADS):
    """What is identified of a random drive with an effect, and its errors."""
    pair = pair.replace(discs=2) if effect.startswith("two discs") else pair
    for again in range(10):
        generator = np.random.default_rng([8, seed, again][: 3 if again else 2])
        surface, values = random_drive(pair, generator, 0.3e-6)
        # A drive on bearings may have an angle at which its balance is not found.
        with contextlib.suppress(edge.InputError):
            runs = [recorded(effect, pair, surface, load, generator, each, turns) for load in loads]
            break
    stated = on_bearings(pair, surface_of_pair(pair))[0] if effect.startswith("the same") else pair
    return identify(runs, Drive(stated)), values


def names(verdict):
    """All that a verdict names as likely."""
    return {cause for misfit in verdict.misfits for cause in (misfit.cause, *misfit.alike)}


def table(drives, pair, effects=tuple(EFFECTS)):
    """Lines of the table of docs/identify.md."""
    yield "| what the model does not hold | explained | but for its cause | not explained | intervals that hold |"
    yield "| --- | --- | --- | --- | --- |"
    for effect in effects:
        cause = EFFECTS[effect]
        found = [identified(effect, pair, seed) for seed in range(drives)]
        states = [one.verdict.state for one, _ in found]
        right = sum(s == "explained but for" and cause in names(one.verdict)
                    for s, (one, _) in zip(states, found, strict=True))  # fmt: skip
        stated = [distances(one, values) for one, values in found if one.verdict.state != "not explained"]
        far = np.abs(np.array([z for one in stated for z in one.values()]))
        inside = f"{np.count_nonzero(far < 1.0)} of {far.size}" if far.size else "–"
        yield f"| {effect} | {states.count('explained')} | {right} | {states.count('not explained')} | {inside} |"


if __name__ == "__main__":
    nominal = read_pair(Path(__file__).parent.parent / "examples" / "drive-39-40.toml").replace(**SMALL)
    for line in table(int(sys.argv[1]), nominal, sys.argv[2:] or tuple(EFFECTS)):
        print(line, flush=True)
