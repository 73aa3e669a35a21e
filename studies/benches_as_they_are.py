"""Recordings of drives and benches with effects outside the model of rigid supports and quiet encoders.

`python studies/benches_as_they_are.py DRIVES` prints the table of docs/identify_coverage.md; effects may follow. Drives
are made by `second_drive`, which shares nothing with the product's kernels. What is done is kept in docs/generated
until code changes: the same command goes on where it was.
"""

import dataclasses
import hashlib
import json
import sys
import zlib
from pathlib import Path

import joblib
import numpy as np
import second_drive
from sampled_drives import ARCSEC, LOADS, SMALL, structured
from scipy import special

import fitting
from cycloid_fmu.drive import Drive
from cycloid_fmu.edge.commands import Bar
from cycloid_fmu.geometry.pair import read_pair
from cycloid_fmu.surfaces.surface import surface_of_pair
from fitting.estimation.identify import identify

ROOT = Path(__file__).parent.parent
NOISE, STEP = 0.5 * ARCSEC, 1e-2  # rad; s from one sample to the next
STIFF, CIRCLE = 1e9, 0.026  # N/m of turning arms and cranks' shafts, three of them, and m: radius of their circle


@dataclasses.dataclass(frozen=True)
class Effect:
    """Effects of a drive and its bench in addition to structured errors, scatter and noise.

    Attributes
    ----------
    causes
        Causes of which a verdict should name one, or one that is not separable from it; none where nothing is visible.
    scatter
        Of every pin's places and every tooth, m.
    ring, crank
        By how much the ring shifts at 200 N·m, in the plane, and discs against the throw of their crank, in its frame:
        along it with the size of the load, ahead of it with its sign, m.
    play
        By how much the ring shifts with the side of the load, in the plane, m.
    chain
        Further compliance, rad/(N·m).
    ripple
        Share of the load that comes and goes once a crank turn and the sensor does not see.
    drift, run_out, output, input, stage
        Of a zero over a recording, with a wave of a third of it; of orders 1, 2, 3 of the output; 64 times an output
        turn; 8 times a crank turn, in the input's angle; 0.37 times a crank turn: arcsec.
    late
        s, of the output's clock, at a speed that changes.
    bits, outliers, missing
        Of both encoders, share of samples 100″ off, whether three tenths of the turn are missing.
    discs, phase
        Number of discs, and displacement of the second one's teeth, m.
    form
        Largest deviation of a form that all flanks share, m.
    bearings
        Whether the disc and its cranks are on bearings, and whether the pair file states them.
    """

    causes: tuple[str, ...] = ()
    scatter: float = 0.3e-6
    ring: complex = 0.0
    crank: complex = 0.0
    play: complex = 0.0
    chain: float = 0.0
    ripple: float = 0.0
    drift: float = 0.0
    run_out: tuple[float, ...] = ()
    output: float = 0.0
    input: float = 0.0
    stage: float = 0.0
    late: float = 0.0
    bits: int = 0
    outliers: float = 0.0
    missing: bool = False
    discs: int = 1
    phase: float = 0.0
    form: float = 0.0
    bearings: bool = False
    stated: bool = False


EFFECTS = {
    "none": Effect(),
    "2 µm of scatter": Effect(scatter=2e-6),
    "outliers, 1 % of 100″": Effect(outliers=0.01),
    "three tenths of the turn missing": Effect(missing=True),
    "17-bit encoders": Effect(bits=17),
    "two discs": Effect(discs=2),
    "two discs, 8 µm of phase between them": Effect(discs=2, phase=8e-6),
    "ring shifts 4 µm with the load": Effect(("support_give",), ring=4e-6 + 2e-6j),
    "ring shifts 2 µm with the side of the load": Effect(("support_play",), play=2e-6 - 1e-6j),
    "crank bearing gives 3 µm radially, 8 µm tangentially at 250 N·m": Effect(
        ("support_give", "compliance"), crank=2.4e-6 - 6.4e-6j
    ),
    "soft crank, 1 µm at 200 N·m": Effect(("support_give",), crank=1e-6),
    "soft chain, 20″ at 200 N·m": Effect(("compliance",), chain=20.0 * ARCSEC / 200.0),
    "disc and cranks on bearings": Effect(("support_give", "support_play", "compliance"), bearings=True),
    "the same, its bearings stated": Effect(bearings=True, stated=True),
    "zero drifts 12″ and a 4″ wave": Effect(("drift",), drift=12.0),
    "run-out 60″, orders 2 and 3": Effect(("run_out",), run_out=(60.0, 8.0, 4.0)),
    "output subdivision 1″": Effect(("orders",), output=1.0),
    "input subdivision 25″": Effect(("orders",), input=25.0),
    "first stage 3″ at no whole order": Effect(("orders",), stage=3.0),
    "torque ripple 10 % that the sensor does not see": Effect(("torque_ripple",), ripple=0.1),
    "speed ripple and an output clock 30 µs late": Effect(("clock_lag",), late=30e-6),
    "flank form 1 µm": Effect(("flank_form",), form=1e-6),
    "flank form 3 µm": Effect(("flank_form",), form=3e-6),
    "a realistic mixture": Effect(
        ("support_give", "compliance", "drift", "run_out", "orders", "flank_form"),
        scatter=1e-6,
        crank=0.5e-6 - 1e-6j,
        drift=3.0,
        run_out=(20.0, 3.0, 1.0),
        output=0.3,
        bits=20,
        outliers=0.002,
        form=0.5e-6,
    ),
}

NOTHING = [name for name, effect in EFFECTS.items() if not effect.causes]


def small():
    """The pair of 11/12 that the studies are made with."""
    return read_pair(ROOT / "examples" / "drive-39-40.toml").replace(**SMALL)


def on_bearings(pair, surface, stiffness=STIFF):
    """The same drive and errors on three cranks in bearings of this stiffness, N/m."""
    supports = {
        "kind": "cranks",
        "count": 3,
        "circle_radius": CIRCLE,
        "first_angle": 0.3,
        "turning_arm": {"stiffness": stiffness},
        "crank_shaft": {"stiffness": stiffness},
        "main": {"stiffness": 3.0 * stiffness},
    }
    floating = pair.replace(supports=supports)
    own = surface_of_pair(floating)
    there = {n: e for n, e in surface.errors.items() if n in own.errors and not n.startswith("misalignment")}
    return floating, own.replace(**there)


def springs(stiffness=STIFF):
    """The effect of bearings of `on_bearings` on one disc: a spring at its centre, and a compliance of the output."""
    return {
        "bearing": 1.0 / (2.0 / (3.0 * stiffness) + 1.0 / (3.0 * stiffness)),
        "windup": 2.0 / (3.0 * stiffness * CIRCLE**2),
    }


def random_body(effect, pair, generator):
    """A drive with structured errors within half their tolerance, scatter beyond, and its errors."""
    values, draw = structured(pair, generator), generator.normal
    scatter = {n: draw(0.0, effect.scatter, pair.pins) for n in ("pin_radial", "pin_tangential")}
    scatter["tooth_cumulative_pitch"] = draw(0.0, effect.scatter, (effect.discs, pair.gear_teeth))
    scatter["tooth_cumulative_pitch"][1:] += effect.phase
    waves = draw(size=4)
    along = np.cos(np.pi * np.linspace(0.0, 1.0, 200)[:, None] * np.arange(1, 5)) @ waves
    form = waves * effect.form / np.abs(along).max()
    held = springs() if effect.bearings else {}
    m = pair.modification
    made = second_drive.body(
        second_drive.sizes_of(pair),
        values,
        scatter,
        isometric=m.isometric,
        offset=m.offset,
        discs=effect.discs,
        form=form if effect.form else (),
        **held,
    )
    return made, {**values, **{f"profile_deviation_{k}": one for k, one in enumerate(made.form, 1)}}


def recorded(effect, made, load, generator, phases, each=24.37, turns=2):
    """A run of a body with an effect on its bench, at so many samples a crank turn; `phases` are the bench's own."""
    ratio, share = -made.teeth, load / 200.0
    at = np.arange(round(turns * made.teeth * each)) * STEP
    speed, (begin, own) = 2.0 * np.pi / each / STEP, generator.uniform(0.0, 2.0 * np.pi, 2)

    def crank(at):
        ripple = 0.15 * np.sin(speed * at + own) + 0.3 * np.sin(3.0 * speed * at / made.teeth)
        return np.sign(load) * (begin + speed * at + ripple * (effect.late != 0.0))

    seen, theta = crank(at), crank(at - effect.late)
    moved = made.moved(axis=effect.ring * share + effect.play * np.sign(load), windup=effect.chain)
    shift = effect.crank.real * abs(share) + 1j * effect.crank.imag * share
    torque = load * (1.0 + effect.ripple * np.cos(theta + phases[0]))
    error = second_drive.transmission_error(moved, theta, torque, shift)
    output, gone = theta / ratio, at / at[-1]
    beside = effect.drift * (gone + np.sin(1.7 * np.pi * gone + own) / 3.0)
    beside += sum(a * np.cos(k * output + phases[k]) for k, a in enumerate(effect.run_out, 1))
    beside += effect.output * np.cos(64.0 * output + phases[4]) + effect.stage * np.cos(0.37 * theta + own)
    seen = seen + ARCSEC * effect.input * np.cos(8.0 * theta + phases[5])
    off = 100.0 * generator.choice([-1.0, 1.0], at.size) * (generator.uniform(size=at.size) < effect.outliers)
    shown = output + error + ARCSEC * (beside + off) + generator.normal(0.0, NOISE, at.size)
    if effect.bits:
        step = 2.0 * np.pi / 2**effect.bits
        seen, shown = step * np.round(seen / step), step * np.round(shown / step)
    # A floating disc may have an angle without a balance.
    there = np.isfinite(shown)
    if effect.missing:
        place = np.mod(output / (2.0 * np.pi), 1.0)
        there &= ~((place > 0.2) & (place < 0.4) | (place > 0.6) & (place < 0.7))
    return fitting.Run(
        input_angle=seen[there],
        output_angle=shown[there],
        torque=load,
        time=at[there],
        common_zero=True,
        known_index=True,
        name=f"{load:g} N·m",
    )


def identified(name, pair, seed, *, each=24.37, turns=2, loads=LOADS):
    """The identification of a random drive with an effect, and its errors."""
    effect, generator = EFFECTS[name], np.random.default_rng([zlib.crc32(name.encode()), seed])
    pair = pair.replace(discs=effect.discs)
    made, values = random_body(effect, pair, generator)
    phases = generator.uniform(0.0, 2.0 * np.pi, 6)
    runs = [recorded(effect, made, load, generator, phases, each, turns) for load in loads]
    stated = on_bearings(pair, surface_of_pair(pair))[0] if effect.stated else pair
    return identify(runs, Drive(stated)), values


def scores(found, values):
    """How far each fitted error is from the truth, so that 1.96 is the end of its interval: {name: score}.

    An interval is that of Student's t where few pins and teeth determine the scatter: a score is that of a normal
    distribution which is as unlikely. Where the result states several sets of errors for the curves, the set counts
    that is nearest.
    """
    fitted = [p for p in found.parameters if p.held is None]
    low, high = np.array([p.interval for p in fitted]).T
    error = np.array([p.standard_error for p in fitted])
    degrees = special.stdtridf(0.975, np.maximum(0.5 * (high - low) / error, 1.96 + 1e-4))
    sets = [{p.name: p.value for p in fitted}, *found.other_descriptions]
    every = [np.array([one[p.name] - values.get(p.name, 0.0) for p in fitted]) / error for one in sets]
    nearest = min(every, key=lambda one: float(np.sum(one**2)))
    chance = np.maximum(special.stdtr(degrees, -np.abs(nearest)), 1e-300)
    return dict(zip((p.name for p in fitted), (-np.sign(nearest) * special.ndtri(chance)).tolist(), strict=True))


def names(verdict):
    """All that a verdict names as likely."""
    return {cause for misfit in verdict.misfits for cause in (misfit.cause, *misfit.alike)}


def outcome(name, seed):
    """The result of one drive of 11/12, as the table counts it: plain values."""
    found, values = identified(name, small(), seed)
    verdict = found.verdict
    away = {} if verdict.state == "not explained" else scores(found, values)
    return {
        "effect": name,
        "seed": seed,
        "state": verdict.state,
        "causes": sorted(names(verdict)),
        "away": away,
        "sentence": verdict.sentence,
    }


def resumed(task, wanted, kept, what):
    """Results of a task for some arguments, those in the file `kept` first, the others as they are computed."""
    lines = kept.read_text(encoding="utf-8").splitlines() if kept.exists() else []
    every = {tuple(given): found for given, found in map(json.loads, lines)}
    left = [given for given in wanted if given not in every]

    def one(given):
        return given, task(*given)

    kept.parent.mkdir(parents=True, exist_ok=True)
    with Bar(what, len(wanted)) as bar, kept.open("a", encoding="utf-8") as file:
        bar.advance(len(wanted) - len(left))
        parallel = joblib.Parallel(n_jobs=-1, return_as="generator_unordered", batch_size=1)
        for given, found in parallel(joblib.delayed(one)(given) for given in left):
            file.write(json.dumps([given, found]) + "\n")
            file.flush()
            every[given] = found
            bar.advance()
    return [every[given] for given in wanted]


def is_right(one):
    """Whether a verdict is right: nothing named where nothing is visible, or a right cause."""
    causes = EFFECTS[one["effect"]].causes
    return bool(set(causes) & set(one["causes"])) if causes else one["state"] == "explained"


def table(every, effects):
    """Lines of the table of docs/identify_coverage.md."""
    yield (
        "| effect outside the model | explained | but for its cause | but for another "
        "| not explained, its cause named | not explained | intervals that contain the truth "
        "| farthest, standard errors |"
    )
    yield "| --- | --- | --- | --- | --- | --- | --- | --- |"
    kinds = [
        ("explained", None),
        ("explained but for", True),
        ("explained but for", False),
        ("not explained", True),
        ("not explained", False),
    ]
    for effect in effects:
        of = [one for one in every if one["effect"] == effect]
        named = [bool(set(EFFECTS[effect].causes) & set(one["causes"])) for one in of]
        states = [(one["state"], right) for one, right in zip(of, named, strict=True)]
        counts = [sum(state == kind and right in (None, by) for state, by in states) for kind, right in kinds]
        yield f"| {effect} | {' | '.join(map(str, counts))} | {_coverage(of)} | {_farthest(of)} |"
    quiet = [one for one in every if one["effect"] in NOTHING]
    alarms = sum(one["state"] != "explained" for one in quiet)
    silent = [one for one in every if one["state"] == "explained"]
    yield ""
    yield f"All stated intervals: {_coverage(every)}, farthest {_farthest(every)} standard errors."
    yield (
        f'Intervals of drives with the verdict "explained": {_coverage(silent)}, '
        f"farthest {_farthest(silent)} standard errors."
    )
    yield f"Right verdicts: {sum(map(is_right, every))} of {len(every)}."
    share = alarms / max(len(quiet), 1)
    yield f"False alarms where the model includes everything: {alarms} of {len(quiet)}, {share:.1%}."


def _away(every):
    return np.abs(np.array([z for one in every for z in one["away"].values()]))


def _coverage(every):
    away = _away(every)
    inside = np.count_nonzero(away < 1.96)
    return f"{inside} of {away.size}, {inside / away.size:.1%}" if away.size else "–"


def _farthest(every):
    away = _away(every)
    return f"{away.max():.1f}" if away.size else "–"


def kept_file(study, *modules):
    """Folder in which a study of some modules of tests keeps its results, until these or the product change."""
    files = [file for room in ("fitting", "cycloid_fmu") for file in sorted((ROOT / room).rglob("*.py"))]
    files += [Path(__file__).with_name(f"{name}.py") for name in ("second_drive", "sampled_drives", *modules)]
    mark = hashlib.sha256(b"".join(file.read_bytes() for file in files)).hexdigest()[:12]
    return ROOT / "docs" / "generated" / f"{study}-{mark}.jsonl"


if __name__ == "__main__":
    sys.stdout.reconfigure(encoding="utf-8")  # type: ignore[union-attr]
    chosen = sys.argv[2:] or list(EFFECTS)
    wanted = [(name, seed) for seed in range(int(sys.argv[1])) for name in chosen]
    kept = kept_file("benches", "benches_as_they_are")
    for line in table(resumed(outcome, wanted, kept, "drives"), chosen):
        print(line, flush=True)
