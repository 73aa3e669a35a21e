"""Friction of a turning drive over speed and load, from ramps of speed and runs at constant speeds.

The torque that drives the output, referred to it, is (N·m)

    T = o + s (C + S exp(-(w/w_s)²) + mu |M| + D t) + b w + J a

with the speed w of the output, its sign s, the acceleration a, Coulomb friction C, Stribeck friction S, friction mu per
torque M of the teeth, viscous friction b, the inertia J that is moved, and an offset o: the load, or the zero of the
sensor. The law is that of `cycloid_fmu.fmu.friction` at the output, where the teeth carry load and friction,
M = T - J a. D is a drift over the time t from the middle of a recording, as while it warms up. Figures are those
without load, where |M| is the friction itself: C, S and b over 1 - mu.

It is fitted to means over short stretches of time, whose speed is the slope of the angle over the time; so coarse ticks
of a clock or of an encoder hardly matter. The noise of the torque is correlated (ripple, drift): the uncertainty is
from the scatter of blocks of time, by leaving out one at a time.
"""

from __future__ import annotations

import dataclasses
import math
import os
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from cycloid_fmu import edge
from cycloid_fmu.fmu.friction_file import FORMAT as FRICTION_FILE
from cycloid_fmu.fmu.friction_file import LIMITS
from fitting.arguments import check_ratio, positive
from fitting.figures.figure import Definition, Figure, figure_json, half_interval_of_mean
from fitting.figures.metrics import FORMAT as FIGURES
from fitting.figures.starts import STARTS, Start, start_figures
from fitting.readers.recording import Recording
from fitting.readers.sources import Source, each_source, open_source
from fitting.transmission_error.survey import overview_of

Array = NDArray[np.float64]
Numbers = NDArray[np.intp]

FORMAT = "cycloid-friction-fit/1"
DEFINITIONS = {
    "coulomb": Definition(
        "N*m", "sliding friction without load, extrapolated to zero speed by the fitted line, mean of both directions"
    ),
    "coulomb_forward": Definition(
        "N*m", "torque extrapolated to zero speed from positive speeds; it contains the offset"
    ),
    "coulomb_backward": Definition(
        "N*m", "minus the torque extrapolated to zero speed from negative speeds; it contains the offset"
    ),
    "viscous": Definition("N*m*s/rad", "slope of the friction over the speed of the output"),
    "stribeck": Definition("N*m", "additional friction towards rest, S of S exp(-(w/w_s)^2)"),
    "stribeck_speed": Definition("rad/s", "speed w_s of the output at which it has fallen to 1/e"),
    "friction_per_load": Definition("1", "growth of the friction with the torque of the teeth, mu"),
    "offset": Definition("N*m", "mean torque of both directions: a load, or the zero of the sensor"),
    "inertia": Definition("kg*m^2", "torque over acceleration, referred to the output"),
}
FILE_NAMES = {
    "coulomb": "coulomb",
    "friction_per_load": "load_share",
    "stribeck": "stribeck",
    "stribeck_speed": "stribeck_speed",
    "viscous": "viscous",
}
"""{figure: its name in a friction file}."""
WITHOUT_LOAD = ("coulomb", "stribeck", "viscous")
"""Figures that are those without load, and 1 - `load_share` times as large in a friction file."""
STRETCHES = 1000  # most stretches of time of a recording
FEWEST_SAMPLES = 8  # of a stretch
FEWEST = 12  # stretches of a fit
BLOCKS = 32  # of all passes together, about
PASSES = 12  # from which their scatter counts too
SLOWEST = 0.02  # of the largest speed: lower limit of the fitted speeds, unless stated
_APART = 0.05  # of a term's column that the other terms must leave
_OTHER_LOAD = 0.25  # of the friction: offsets of recordings that differ by more are loads
_SURE = 1.5  # times its 95 % interval that a term must exceed where it was searched for
_ITERATIONS = 8  # in which the torque of the teeth and the friction in it agree
_TRIED = 25  # Stribeck speeds
_STRIBECK = 0.3  # of the largest speed: largest Stribeck speed; above, the term is no rise towards rest


@dataclass(frozen=True)
class Stretches:
    """Means over stretches of time of recordings, in the order of time, each of shape (stretches,).

    Attributes
    ----------
    time
        Middle, s.
    speed, acceleration
        Of the output, rad/s and rad/s².
    torque
        Torque that drives the output, N·m, > 0 towards positive angles; without the load where that is measured.
    load
        Torque that the output gives to its load, N·m; NaN if only the driving torque is measured.
    recording, run, block
        Numbers of the recording, of the pass (in one direction without a gap) and of the block of time.
    """

    time: Array
    speed: Array
    acceleration: Array
    torque: Array
    load: Array
    recording: Numbers
    run: Numbers
    block: Numbers

    def chosen(self, keep: NDArray[np.bool_] | Numbers) -> Stretches:
        """Return some of them."""
        return Stretches(*(getattr(self, f.name)[keep] for f in dataclasses.fields(self)))


def driving_torque(recording: Recording, ratio: float | None) -> tuple[Array, Array]:
    """Return the torque that drives the output, of two torques what remains of it as friction, and the load, N·m.

    With torques on both shafts, their power balance T_b + i T_a = F s gives the friction, and T_b is the load. A single
    torque drives; a load is then its offset.

    Parameters
    ----------
    recording
        The recording; its torques are those of the environment on the shafts.
    ratio
        Signed ratio input/output; needed for a torque on the input.

    Raises
    ------
    edge.InputError
        If there is no torque, or only one on the input without a ratio.
    """
    torque, given = recording.torque, recording.input_torque
    known = not np.isnan(torque).all()
    if given is None:
        if not known:
            raise edge.InputError(f"{recording.source}: no torque is mapped; friction needs the torque that drives.")
        return torque, np.full(torque.size, np.nan)
    if ratio is None:
        raise edge.InputError(
            f"{recording.source}: the torque on the input is referred to the output by the ratio: {edge.RATIO}."
        )
    if not known:
        return ratio * given, np.full(torque.size, np.nan)
    return torque + ratio * given, -torque


def stretches_of(time: Array, angle: Array, torque: Array, load: Array, number: int = 0) -> Stretches:
    """Return means over stretches of time of one recording; the speed is the slope of the angle in each.

    Parameters
    ----------
    time, angle, torque, load
        Shape (samples,): s, output angle (rad), and as in `Stretches`.
    number
        Number of the recording.
    """
    size = max(FEWEST_SAMPLES, math.ceil(time.size / STRETCHES))
    whole = time.size // size * size
    t, phi, driving, loads = (v[:whole].reshape(-1, size) for v in (time, angle, torque, load))
    away = t - t.mean(axis=1, keepdims=True)
    spread = (away * away).sum(axis=1)
    speed = np.divide((away * phi).sum(axis=1), spread, out=np.zeros(spread.size), where=spread > 0.0)
    lasting = t[:, -1] - t[:, 0]
    keep = (spread > 0.0) & (lasting <= 3.0 * float(np.median(lasting))) if lasting.size else spread > 0.0
    count = int(np.count_nonzero(keep))
    zeros = np.zeros(count, np.intp)
    return Stretches(
        t.mean(axis=1)[keep],
        speed[keep],
        np.zeros(count),
        driving.mean(axis=1)[keep],
        loads.mean(axis=1)[keep],
        np.full(count, number, np.intp),
        zeros,
        zeros,
    )


def joined(parts: Sequence[Stretches]) -> Stretches:
    """Return the stretches of several recordings as one."""
    return Stretches(*(np.concatenate([getattr(p, f.name) for p in parts]) for f in dataclasses.fields(Stretches)))


def in_passes(stretches: Stretches, speeds: tuple[float, float]) -> Stretches:
    """Return the stretches within a range of speeds (rad/s), with their passes, blocks and accelerations.

    The first and the last stretch of a pass are left out, as the motion may begin, reverse or end in them.
    """
    within = np.flatnonzero((np.abs(stretches.speed) >= speeds[0]) & (np.abs(stretches.speed) <= speeds[1]))
    if not within.size:
        return stretches.chosen(within)
    sign, recording = np.sign(stretches.speed[within]), stretches.recording[within]
    new = (np.diff(within) > 3) | (np.diff(sign) != 0.0) | (np.diff(recording) != 0)  # noise at the limits is no gap
    groups = [part[1:-1] if part.size > 6 else part for part in np.split(within, np.flatnonzero(new) + 1)]
    groups = [part for part in groups if part.size > 2]
    total = sum(part.size for part in groups)
    members, runs, blocks, accelerations = [], [], [], []
    first = 0
    for number, part in enumerate(groups):
        count = min(max(1, round(BLOCKS * part.size / total)), part.size // 2)
        of = np.arange(part.size) * count // part.size
        a = np.empty(part.size)
        for k in range(count):
            t, w = stretches.time[part[of == k]], stretches.speed[part[of == k]]
            a[of == k] = np.polyfit(t - t.mean(), w, 1)[0] if t.size > 1 else 0.0
        members.append(part)
        runs.append(np.full(part.size, number, np.intp))
        blocks.append(first + of)
        accelerations.append(a)
        first += count
    if not members:
        return stretches.chosen(within[:0])
    return dataclasses.replace(
        stretches.chosen(np.concatenate(members)),
        run=np.concatenate(runs),
        block=np.concatenate(blocks),
        acceleration=np.concatenate(accelerations),
    )


@dataclass(frozen=True)
class Scatter:
    """Estimates without each of some parts of the data.

    Attributes
    ----------
    without
        Shape (parts, columns).
    factor
        Factor of the variance because neighbouring parts are correlated.
    degrees
        Degrees of freedom.
    """

    without: Array
    factor: float
    degrees: float

    def half_width(self, vector: Array) -> float:
        """Return half the width of the 95 % interval of a weighted sum of estimates."""
        each = self.without @ vector
        count = each.size
        variance = (count - 1.0) / count * float(((each - each.mean()) ** 2).sum()) * self.factor
        return math.sqrt(variance) * float(stdtrit(self.degrees, 0.975))


@dataclass(frozen=True)
class Fit:
    """Least squares over columns of a model.

    Attributes
    ----------
    names
        Names of the columns.
    values
        Estimates, shape (columns,).
    scatters
        Estimates without each block, and without each pass if there are enough.
    residual
        Shape (stretches,), N·m.
    """

    names: tuple[str, ...]
    values: Array
    scatters: tuple[Scatter, ...]
    residual: Array

    def linear(self, weights: Mapping[str, float]) -> tuple[float, float]:
        """Return a weighted sum of estimates and half the width of its 95 % interval."""
        vector = np.array([weights.get(name, 0.0) for name in self.names])
        return float(self.values @ vector), max(scatter.half_width(vector) for scatter in self.scatters)

    @property
    def blocks(self) -> int:
        """Number of blocks."""
        return int(self.scatters[0].without.shape[0])

    @property
    def degrees(self) -> float:
        """Least degrees of freedom."""
        return min(scatter.degrees for scatter in self.scatters)


def fit_columns(columns: Mapping[str, Array], stretches: Stretches) -> Fit:
    """Return the fit of the torque by columns of shape (stretches,), with the scatter of blocks and passes.

    Variances are those of leaving out one block at a time (delete-a-group jackknife, Kott, J. Off. Stat. 17 (2001)
    521), times (1 + r)/(1 - r) with the correlation r ≥ 0 of the mean residuals of neighbouring blocks of a pass, at
    most the number of blocks of a pass. With `PASSES` passes or more, the same with passes counts if it is larger.
    """
    x, y = np.column_stack(list(columns.values())), stretches.torque
    scale = np.sqrt((x * x).mean(axis=0))
    x = x / scale
    values = np.linalg.lstsq(x, y, rcond=1e-9)[0]
    residual = y - x @ values
    terms = x.shape[1]
    block, passes = (np.unique(labels, return_inverse=True)[1] for labels in (stretches.block, stretches.run))

    def without(part: Numbers) -> Array:
        count = int(part.max()) + 1
        normal, right = np.zeros((count, terms, terms)), np.zeros((count, terms))
        np.add.at(normal, part, x[:, :, None] * x[:, None, :])
        np.add.at(right, part, x * y[:, None])
        total, whole = normal.sum(axis=0), right.sum(axis=0)
        each = [np.linalg.lstsq(total - a, whole - b, rcond=1e-12)[0] for a, b in zip(normal, right, strict=True)]
        return np.asarray(each / scale, float)

    count, runs = int(block.max()) + 1, int(passes.max()) + 1
    means = np.bincount(block, residual) / np.bincount(block)
    run = np.zeros(count, np.intp)
    run[block] = passes
    same = run[1:] == run[:-1]
    alike = 0.0
    if same.any():
        power = float((means * means).mean())
        alike = float((means[1:] * means[:-1])[same].mean()) / power if power > 0.0 else 0.0
    # Fitted terms take their share of it. A negative one, as of ripple, does not count: passes go over it again.
    alike = min(max(alike, 0.0) + terms / count, 0.8)
    factor = min((1.0 + alike) / (1.0 - alike), max(count / runs, 1.0))  # at most, all blocks of a pass are alike
    scatters = [Scatter(without(block), factor, max(count / factor - terms, 2.0))]
    if runs >= PASSES:
        scatters.append(Scatter(without(passes), 1.0, max(runs - terms, 2.0)))
    return Fit(tuple(columns), values / scale, tuple(scatters), residual)


def separate(column: Array, others: Iterable[Array]) -> bool:
    """Return whether a column differs from all combinations of others by more than 5 % of its size."""
    size = float(np.linalg.norm(column))
    given = list(others)
    if size == 0.0:
        return False
    if not given:
        return True
    base = np.column_stack(given)
    base = base / np.linalg.norm(base, axis=0)
    rest = column - base @ np.linalg.lstsq(base, column, rcond=1e-9)[0]
    return float(np.linalg.norm(rest)) > _APART * size


def stribeck_columns(speed: Array, at: float) -> tuple[Array, Array]:
    """Return the Stribeck term's columns: of the torque, and its derivative by the Stribeck speed (for 1 N·m)."""
    share = np.exp(-((speed / at) ** 2))
    return np.sign(speed) * share, np.sign(speed) * share * 2.0 * speed**2 / at**3


@dataclass(frozen=True)
class FrictionFit:
    """Friction of a drive from its recordings, referred to the output.

    Attributes
    ----------
    figures
        Figures by name (`DEFINITIONS`, and starting torques), SI; terms that the data do not resolve are missing, for
        reasons in `notes`.
    speeds
        The range of speeds that was fitted, rad/s.
    loads
        {recording: torque on the output, N·m}, where there are several loads.
    stretches
        The means over time that were fitted.
    fitted, removed
        Fitted torque without those of the inertia and of a drift, and these two by name, N·m, of each stretch; NaN
        where a stretch was left out.
    notes
        Omissions and their reasons, one sentence each.
    data
        {recording: SHA-256}.
    coefficients
        Those of the drive's [losses] that the recordings tell apart (`fitting.figures.coefficients`); none without a
        drive.

    Examples
    --------
    >>> import numpy as np, fitting
    >>> time = np.linspace(0.0, 100.0, 20001)
    >>> angle = 50.0 * np.sin(0.02 * np.pi * time)
    >>> speed = np.pi * np.cos(0.02 * np.pi * time)
    >>> run = fitting.Run(input_angle=0.0, output_angle=angle, torque=3.0 * np.sign(speed) + 0.2 * speed, time=time)
    >>> found = fitting.friction(run).figures
    >>> round(found["coulomb"].value, 3), round(found["viscous"].value, 3)
    (3.0, 0.2)
    """

    figures: dict[str, Figure]
    speeds: tuple[float, float]
    loads: dict[str, float]
    stretches: Stretches
    fitted: Array
    removed: dict[str, Array]
    notes: tuple[str, ...]
    data: dict[str, str] = field(default_factory=dict)
    coefficients: dict[str, Figure] = field(default_factory=dict)

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the fit, `cycloid-friction-fit/1` (`.json`), or the friction file of an FMU (`.toml`).

        Raises
        ------
        edge.InputError
            If the ending is another one, or the friction file needs a term that is missing.
        """
        target = edge.output_path(path, "path", (".json", ".toml"))
        text = friction_toml(self) if target.suffix.lower() == ".toml" else edge.json_text(friction_json(self))
        with edge.written_whole(target) as temporary:
            temporary.write_text(text, encoding="utf-8")


def friction_json(friction_fit: FrictionFit) -> dict[str, Any]:
    """Return the fit as the content of a `cycloid-friction-fit/1` file, SI."""
    coefficients = {name: figure_json(figure) for name, figure in friction_fit.coefficients.items()}
    return {
        "format": FORMAT,
        **{name: figure_json(figure) for name, figure in friction_fit.figures.items()},
        "speeds": list(friction_fit.speeds),
        "loads": friction_fit.loads,
        **({"coefficients": coefficients} if coefficients else {}),
        "data": friction_fit.data,
        "notes": list(friction_fit.notes),
    }


def friction_toml(friction_fit: FrictionFit) -> str:
    """Return the friction file `cycloid-friction/1` with this friction at the output.

    Its law is of the torque of the teeth, which without load is the friction itself. So the other values are those of
    the fit times 1 - `load_share`.

    Raises
    ------
    edge.InputError
        If Coulomb friction is missing, or a value is outside the file's limits.
    """
    if "coulomb" not in friction_fit.figures:
        raise edge.NoDataError("A friction file needs coulomb, the mean of both directions; record both.")
    low, high = friction_fit.speeds
    lines = [f'format = "{FRICTION_FILE}"', "", f"[friction.output]  # measured from {low:.4g} to {high:.4g} rad/s"]
    grown = friction_fit.figures.get("friction_per_load")
    for name, key in FILE_NAMES.items():
        if name not in friction_fit.figures:
            continue
        value, (unit, least, most, _) = friction_fit.figures[name].value, LIMITS[key]
        if grown is not None and name in WITHOUT_LOAD:
            value *= max(1.0 - grown.value, 0.0)
        if not least <= value <= (math.inf if most is None else most):
            raise edge.InputError(f"{name} = {value:.4g}: a friction file takes {least:g} to {most}.")
        number = f"{value:.6g}"
        lines.append(f"{key} = {number}" if unit == "1" else f'{key} = "{number} {DEFINITIONS[name].unit}"')
    return "\n".join([*lines, ""])


def _offset_columns(stretches: Stretches, loads: bool) -> dict[str, Array]:
    """Return the columns of the offset: one, or one of each recording."""
    if not loads:
        return {"offset": np.ones(stretches.speed.size)}
    return {f"offset {k}": (stretches.recording == k).astype(float) for k in np.unique(stretches.recording)}


def _mean_torques(stretches: Stretches) -> dict[int, tuple[float, float]]:
    """Return the offset and the friction, N·m, of each recording with both directions, by its number."""
    torques = {}
    for k in np.unique(stretches.recording):
        part = stretches.chosen(stretches.recording == k)
        sign = np.sign(part.speed)
        if np.unique(sign).size == 2:
            offset, friction = np.linalg.lstsq(np.column_stack([np.ones(sign.size), sign]), part.torque, rcond=None)[0]
            torques[int(k)] = float(offset), float(friction)
    return torques


@dataclass
class _Model:
    """Columns of the model for some stretches, chosen term by term."""

    stretches: Stretches
    columns: dict[str, Array] = field(default_factory=dict)

    def add(self, name: str, column: Array) -> bool:
        """Add a column if the others leave enough of it."""
        if not separate(column, self.columns.values()):
            return False
        self.columns[name] = column
        return True

    def fit(self) -> Fit:
        return fit_columns(self.columns, self.stretches)


def _add_growth(model: _Model, measured: bool) -> list[str]:
    """Add the growth of the friction with the torque of the teeth, which contains it, or return why there is none."""
    part, name = model.stretches, "friction_per_load"
    load = part.load if measured else np.zeros(part.speed.size)
    for _ in range(_ITERATIONS):
        fit = model.fit()
        carried = load + part.torque - fit.residual
        if "inertia" in fit.names:
            carried = carried - fit.values[fit.names.index("inertia")] * part.acceleration
        model.columns.pop(name, None)
        if not model.add(name, np.sign(part.speed) * np.abs(carried)):
            return []
    value, uncertainty = model.fit().linear({name: 1.0})
    if value > uncertainty:
        return []
    del model.columns[name]
    return [f"Growth of the friction with the load is not resolved: {value:.2g} ± {uncertainty:.2g}."]


def _stribeck(model: _Model) -> tuple[float, Fit] | None:
    """Return the Stribeck speed (rad/s) and the fit with this term; None if the data do not resolve it."""
    speed = np.abs(model.stretches.speed)
    tried = np.geomspace(
        max(1.2 * float(speed.min()), 1e-3 * float(speed.max())), _STRIBECK * float(speed.max()), _TRIED
    )
    best: tuple[float, float] | None = None
    signed = model.stretches.speed
    base = list(model.columns.values())

    def power(at: float) -> float:
        x = np.column_stack([*base, stribeck_columns(signed, at)[0]])
        x = x / np.linalg.norm(x, axis=0)
        rest = model.stretches.torque - x @ np.linalg.lstsq(x, model.stretches.torque, rcond=1e-9)[0]
        return float(rest @ rest)

    for at in tried:
        if separate(stribeck_columns(signed, at)[0], base):
            best = min((power(at), float(at)), best or (math.inf, math.nan))
    if best is None:
        return None
    at = best[1]
    for step in np.geomspace(1.15, 1.01, 12):
        at = min((at / step, at, at * step), key=power)
    column, derivative = stribeck_columns(signed, at)
    fit = fit_columns({**model.columns, "stribeck": column, "stribeck_speed": derivative}, model.stretches)
    value, uncertainty = fit.linear({"stribeck": 1.0})
    if not value > _SURE * uncertainty:
        return None
    if at > _STRIBECK * float(speed.max()) or fit.linear({"coulomb": 1.0})[0] <= 0.0:
        return None
    return (at, fit) if fit.linear({"stribeck_speed": 1.0 / value})[1] < at else None


def fit_friction(
    stretches: Stretches, sources: Sequence[str], speeds: tuple[float, float]
) -> tuple[dict[str, Figure], dict[str, float], Array, dict[str, Array], list[str]]:
    """Return figures, loads, fitted torque, torques of inertia and drift (all over the stretches), and notes.

    Parameters
    ----------
    stretches
        From `in_passes`.
    sources
        Names of the recordings.
    speeds
        The range of speeds, rad/s, which the figures state.

    Raises
    ------
    edge.NoDataError
        If the torque opposes the motion: it is then not what drives.
    """
    measured = bool(np.isfinite(stretches.load).all())
    both = _mean_torques(stretches)
    loads, apart, notes = _loads_of(stretches, sources, both, measured)
    used = np.isin(stretches.recording, [*both]) if apart else np.ones(stretches.speed.size, bool)
    every, stretches = stretches, stretches.chosen(used)
    renumbered = np.unique(stretches.block, return_inverse=True)[1]
    stretches = dataclasses.replace(stretches, block=renumbered)
    sign = np.sign(stretches.speed)
    model = _Model(stretches, {"coulomb": sign})
    two_ways = len(set(sign)) == 2
    if two_ways:
        model.columns.update(_offset_columns(stretches, apart))
    turning, remarks = _add_running_terms(model)
    notes += _add_drift(model)
    if len({round(v, 9) for v in loads.values()}) > 1:
        notes += _add_growth(model, measured)
    stribeck = _stribeck(model) if turning else None
    fit = model.fit() if stribeck is None else stribeck[1]
    if turning and stribeck is None:
        notes += _notes_on_the_line(model)
    if "viscous" in fit.names:
        value, uncertainty = fit.linear({"viscous": 1.0})
        if value < 0.0 and stribeck is None:
            del model.columns["viscous"]
            fit = model.fit()
            notes.append(f"Viscous friction is not resolved: {value:.2g} ± {uncertainty:.2g} N·m·s/rad.")
            remarks.append("the mean friction over these speeds, as it does not grow with them")
        elif value < uncertainty:
            notes.append("The interval of viscous friction contains zero.")

    if apart:
        loads = {sources[k]: float(fit.values[fit.names.index(f"offset {k}")]) for k in both}
    sums = _sums(fit, two_ways, sign, apart)
    spread = _of_recordings(stretches, fit.names, sums, apart or measured, both)
    at = math.nan if stribeck is None else stribeck[0]
    figures = _figures_of(fit, sums, spread, at, len(both), speeds, "; ".join(remarks))
    first = next(iter(figures))
    if not figures[first].value > 0.0:
        raise edge.NoDataError(
            f"{edge.listed(sources)}: the torque opposes the motion ({first} = {figures[first].value:.3g} N·m), so "
            "it is not the one that drives. If the sensor counts the other way, state direction = -1 for the torque in "
            "the mapping; if it measures a load, map the torque of the input too."
        )
    if "inertia" in figures and not figures["inertia"].value > figures["inertia"].uncertainty:
        del figures["inertia"]
    if not two_ways:
        notes.append(
            f"{edge.listed(sources)}: only one direction was recorded; coulomb, the mean of both, needs the other too."
        )
    names: tuple[str, ...] = ("inertia", "drift")
    removed = {name: np.full(every.speed.size, np.nan) for name in names if name in fit.names}
    fitted = np.full(every.speed.size, np.nan)
    fitted[used] = stretches.torque - fit.residual
    for name, torque in removed.items():
        torque[used] = fit.values[fit.names.index(name)] * model.columns[name]
        fitted[used] -= torque[used]
    return figures, loads, fitted, removed, notes


def _loads_of(
    stretches: Stretches, sources: Sequence[str], both: Mapping[int, tuple[float, float]], measured: bool
) -> tuple[dict[str, float], bool, list[str]]:
    """Return the load of each recording (N·m), whether it is the mean of both directions, and notes.

    `both`: offset and friction of each recording with both directions, of `_mean_torques`.
    """
    if measured:
        numbers = np.unique(stretches.recording)
        return {sources[k]: float(stretches.load[stretches.recording == k].mean()) for k in numbers}, False, []
    if len(both) < 2:
        return {}, False, []
    offsets, frictions = np.array([*both.values()]).T
    if not float(np.ptp(offsets)) > _OTHER_LOAD * float(np.abs(frictions).mean()):
        return {}, False, []
    notes = []
    single = [sources[k] for k in np.unique(stretches.recording) if k not in both]
    if single:
        notes.append(f"{edge.listed(single)}: left out; under a load, friction needs both directions in one recording.")
    return {sources[k]: offset for k, (offset, _) in both.items()}, True, notes


def _add_running_terms(model: _Model) -> tuple[bool, list[str]]:
    """Add viscous friction and inertia where they separate; return whether the former does, and remarks."""
    stretches, remarks = model.stretches, []
    sign, speed = np.sign(stretches.speed), stretches.speed
    turning = model.add("viscous", speed)
    if not turning:
        remarks.append("the friction at this speed, as the speeds hardly differ; viscous friction is part of it")
    if not model.add("inertia", stretches.acceleration):
        pushed = float((sign * stretches.acceleration).mean())
        moved = abs(pushed) * float(np.ptp(stretches.time[stretches.run == stretches.run[0]]))
        if moved > 0.1 * float(np.abs(speed).mean()):
            remarks.append(
                f"with the torque of the inertia, {pushed:.2g} N·m for each kg·m² at the output, as the speed only "
                f"{'rises' if pushed > 0.0 else 'falls'}; record ramps up and down"
            )
    return turning, remarks


def _add_drift(model: _Model) -> list[str]:
    """Add a drift of the friction over each recording; return a note if it is significant."""
    stretches = model.stretches
    middle = np.bincount(stretches.recording, stretches.time) / np.maximum(np.bincount(stretches.recording), 1)
    if not model.add("drift", np.sign(stretches.speed) * (stretches.time - middle[stretches.recording])):
        return []
    value, uncertainty = model.fit().linear({"drift": 1.0})
    if abs(value) <= _SURE * uncertainty:
        return []
    return [
        f"The friction drifts by {value * 60.0:.2g} N·m a minute, as while it warms up; it is that of the middle of "
        "each recording."
    ]


def _notes_on_the_line(model: _Model) -> list[str]:
    """Return notes on a friction without a Stribeck term: that it has none, and whether it is a straight line."""
    notes = ["No Stribeck term is resolved: friction does not rise significantly towards the lowest speeds."]
    speed = model.stretches.speed
    bend = speed * np.abs(speed)
    if separate(bend, model.columns.values()):
        value, uncertainty = fit_columns({**model.columns, "bend": bend}, model.stretches).linear({"bend": 1.0})
        if abs(value) > _SURE * uncertainty:
            notes.append(
                "The friction is no straight line over these speeds: its slope "
                f"{'rises' if value > 0.0 else 'falls'} with the speed. Fit a narrower range."
            )
    return notes


def _figures_of(
    fit: Fit,
    sums: Mapping[str, Mapping[str, float]],
    spread: Mapping[str, float],
    stribeck_speed: float,
    recordings: int,
    speeds: tuple[float, float],
    remark: str,
) -> dict[str, Figure]:
    """Return the figures of a fit; those without load do not have the growth with their own torque."""
    figures = {}
    growth = fit.linear({"friction_per_load": 1.0})[0]
    for name, weights in sums.items():
        value, uncertainty = fit.linear(weights)
        if name == "stribeck_speed":  # its column is the derivative for 1 N·m
            value, uncertainty = stribeck_speed, uncertainty / abs(fit.linear({"stribeck": 1.0})[0])
        elif growth and name in WITHOUT_LOAD:
            value /= 1.0 - growth
            _, uncertainty = fit.linear({name: 1.0 / (1.0 - growth), "friction_per_load": value / (1.0 - growth)})
        degrees = fit.degrees
        if spread.get(name, 0.0) > uncertainty:
            uncertainty, degrees = spread[name], float(recordings - 1)
        figures[name] = Figure(
            value,
            uncertainty,
            *DEFINITIONS[name],
            speeds,
            "rad/s",
            fit.blocks,
            "blocks",
            degrees=degrees,
            remark=remark if name.startswith("coulomb") else "",
        )
    return figures


def _sums(fit: Fit, two_ways: bool, sign: Array, apart: bool) -> dict[str, dict[str, float]]:
    """Return {figure: its weighted sum of estimates}."""
    sums: dict[str, dict[str, float]] = {}
    if not two_ways:
        sums["coulomb_forward" if sign[0] > 0.0 else "coulomb_backward"] = {"coulomb": 1.0}
    else:
        sums["coulomb"] = {"coulomb": 1.0}
        if not apart:
            sums["coulomb_forward"] = {"coulomb": 1.0, "offset": 1.0}
            sums["coulomb_backward"] = {"coulomb": 1.0, "offset": -1.0}
            sums["offset"] = {"offset": 1.0}
    for name in ("viscous", "stribeck", "stribeck_speed", "friction_per_load", "inertia"):
        if name in fit.names:
            sums[name] = {name: 1.0}
    return sums


def _of_recordings(
    stretches: Stretches,
    names: Sequence[str],
    sums: Mapping[str, Mapping[str, float]],
    loaded: bool,
    both: Collection[int],
) -> dict[str, float]:
    """Return half widths of 95 % intervals from the scatter of three or more recordings that show all terms alone."""
    if loaded or len(both) < 3 or "stribeck" in names:
        return {}
    alone = []
    for k in both:
        part = stretches.chosen(stretches.recording == k)
        part = dataclasses.replace(part, block=np.unique(part.block, return_inverse=True)[1])
        sign = np.sign(part.speed)
        model = _Model(part, {"coulomb": sign, "offset": np.ones(sign.size)})
        given = {"viscous": part.speed, "inertia": part.acceleration}
        if all(model.add(name, given[name]) for name in names if name in given):
            alone.append(model.fit())
    if len(alone) < 3:
        return {}
    return {name: half_interval_of_mean([fit.linear(weights)[0] for fit in alone]) for name, weights in sums.items()}


def _growth_of(loop: str | os.PathLike[str]) -> Figure:
    """Return the growth of the friction with the torque of the teeth from the loops in a figures file.

    Loaded at the output, the teeth carry the spring's torque M. Driven by the motor they carry the friction too,
    F = c + s (|M| + F), so s = mu/(1 + mu).
    """
    figure, by_motor = loop_growth(loop)
    share = 1.0 + figure.value
    if not by_motor:
        return figure
    return dataclasses.replace(figure, value=figure.value / share, uncertainty=figure.uncertainty / share**2)


def loop_growth(loop: str | os.PathLike[str]) -> tuple[Figure, bool]:
    """Return mu of F = F_0 + mu |M| over the spring's torque M from the loops in a figures file.

    Parameters
    ----------
    loop
        Figures of `cycloid-fit metrics`.

    Returns
    -------
    figure, by_motor
        The figure, and whether the motor drove the loops, with the output locked.

    Raises
    ------
    edge.InputError
        If the file can't be read or has no such figure.
    """
    content = edge.json_table(loop, FIGURES, "figures of cycloid-fit metrics")
    free = content.get("friction_free")
    growth = free.get("friction_per_load") if isinstance(free, dict) else None
    value = growth.get("value") if isinstance(growth, dict) else None
    if not isinstance(growth, dict) or not isinstance(value, int | float) or not math.isfinite(value):
        raise edge.InputError(
            f"{loop}: friction_free.friction_per_load is missing; figures of loops in both directions have it."
        )
    uncertainty = growth.get("uncertainty")
    half = math.nan if uncertainty is None else float(uncertainty)
    locked = content.get("locked")
    by_motor = isinstance(locked, dict) and set(locked.values()) == {"output"}
    text = str(growth.get("definition", DEFINITIONS["friction_per_load"].text))
    figure = Figure(float(value), half, "1", text, None, "", float(growth.get("passes", 1)), "passes")
    return figure, by_motor


def _range_of(speeds: Sequence[float | str] | None) -> tuple[float, float] | None:
    """Return the stated range of speeds, rad/s."""
    if speeds is None:
        return None
    limits = [positive(speed, "rad/s", "speeds", zero=True) for speed in speeds]
    if len(limits) != 2 or not limits[0] < limits[1]:
        raise edge.ArgumentError(
            "speeds", "give two speeds of the output, ascending, such as 0.1 rev/s, 1 rev/s", speeds
        )
    return limits[0], limits[1]


def friction(
    recordings: Source | Iterable[Source],
    *,
    ratio: float | None = None,
    speeds: Sequence[float | str] | None = None,
    loop: str | os.PathLike[str] | None = None,
    progress: Callable[[str], None] = lambda step: None,
) -> FrictionFit:
    """Return the friction of a drive over speed and load, referred to the output, from recordings in which it turns.

    Ramps of the speed up and down or runs at constant speeds, in both directions; at several loads also its growth
    with the load. With torques on both shafts the friction is their difference. A single torque is the one that drives,
    referred to the output if it is that of the input; a constant load is then found as the mean of both directions.

    Parameters
    ----------
    recordings
        Recordings from `fitting.read_recordings`, or `fitting.Run`, or one of them.
    ratio
        Signed ratio input/output; needed for a torque on the input. Default: that stated by the recordings.
    speeds
        Range of speeds of the output that is fitted: two of rad/s, or texts with a unit. Default: from 2 % of the
        largest speed on.
    loop
        File of figures from `fitting.metrics` of loops; its friction per load is used if the recordings resolve none.
    progress
        Called with the number of the recording being read, as text.

    Raises
    ------
    edge.InputError
        If an argument or a recording is invalid; `edge.NoDataError` if no friction follows from the recordings.

    Examples
    --------
    >>> import numpy as np, fitting
    >>> time = np.linspace(0.0, 60.0, 6001)
    >>> speed = 4.0 * np.sin(np.pi * time / 30.0)
    >>> angle = 120.0 / np.pi * (1.0 - np.cos(np.pi * time / 30.0))
    >>> run = fitting.Run(input_angle=0.0, output_angle=angle, torque=2.0 * np.sign(speed) + 0.1 * speed, time=time)
    >>> found = fitting.friction(run, speeds=("0.1 rev/s", "0.6 rev/s"))
    >>> found.write("friction.toml")
    >>> round(found.figures["viscous"].value, 3)
    0.1
    """
    check_ratio(ratio)
    limits = _range_of(speeds)
    growth = None if loop is None else _growth_of(loop)
    given: list[Source] = each_source(recordings)
    if not given:
        raise edge.InputError("recordings: there are none.")
    notes: list[str] = []
    parts, sources, data = list[Stretches](), list[str](), dict[str, str]()
    started: dict[str, list[Start]] = {name: [] for name in STARTS}
    for number, source in enumerate(given):
        progress(f"recording {number + 1} of {len(given)}")
        stream = open_source(source, ratio)
        if isinstance(stream, Recording) and not np.ptp(stream.input_angle):
            stream = dataclasses.replace(stream, has_input_angle=False)  # a locked input turns no output
        overview = overview_of(stream, ratio)
        recording = overview.recording
        notes += [*stream.notes, *overview.notes]
        if not recording.timed:
            raise edge.InputError(f"{recording.source}: no time is mapped; friction over speed needs times.")
        own = ratio if ratio is not None else recording.ratio
        torque, load = driving_torque(recording, own)
        parts.append(stretches_of(recording.time, recording.output_angle, torque, load, number))
        sources.append(recording.source)
        data[recording.source] = recording.checksum
        if recording.has_input_angle and np.ptp(recording.input_angle) > 0.0:
            for name, starts_by in STARTS.items():
                started[name] += starts_by(recording, own)[0]
    every = joined(parts)
    if limits is None:
        fastest = float(np.percentile(np.abs(every.speed), 99.0)) if every.speed.size else 0.0
        limits = SLOWEST * fastest, min(1.05 * fastest, float(np.abs(every.speed).max(initial=0.0)))
    stretches = in_passes(every, limits) if limits[1] > 0.0 else every.chosen(np.zeros(0, np.intp))
    figures = start_figures(started)
    if stretches.speed.size < FEWEST:
        low, high = limits
        turns = f"turns at {low:.3g} to {high:.3g} rad/s too briefly" if high > 0.0 else "does not turn"
        notes.append(
            f"{edge.listed(sources)}: the output {turns} for a fit of friction over speed "
            f"({stretches.speed.size} stretches of {FEWEST_SAMPLES} samples or more; {FEWEST} are needed)."
        )
        if not figures:
            raise edge.NoDataError(" ".join(notes))
        nothing = stretches.chosen(np.zeros(0, np.intp))
        return FrictionFit(figures, limits, {}, nothing, np.zeros(0), {}, tuple(dict.fromkeys(notes)), data)
    running, loads, fitted, removed, added = fit_friction(stretches, sources, limits)
    figures = running | figures
    if growth is not None and "friction_per_load" not in figures:
        figures["friction_per_load"] = growth
        added = [note for note in added if not note.startswith("Growth")]
        added.append(f"{loop}: friction_per_load is that of the loops in this file.")
    return FrictionFit(figures, limits, loads, stretches, fitted, removed, tuple(dict.fromkeys([*notes, *added])), data)
