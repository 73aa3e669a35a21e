"""The content of a bench file, and a proposed mapping for the user to check; it is never used automatically."""

from __future__ import annotations

import dataclasses
import json
import os
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from fitting.readers.first_samples import FirstSamples, first_samples
from fitting.readers.formats import BenchFile, measures, open_bench_file, unit_text
from fitting.readers.mapping import ANGLES, BESIDE, CHANNELS, FORMAT, OPTIONAL
from fitting.readers.proposal import ErrorRun, error_runs, name_patterns, stated_unit
from fitting.samples.cleaning import Cleaning

Array = NDArray[np.float64]

_NAMES = {
    "time": r"time|zeit|^t(_|$)|tick|stamp|\bsec|temps|horodat",
    "input_angle": r"input|(?<![a-z])in(?![a-z])|mot(o|eu)r|crank|antrieb|eingang|\ban\b|entr(é|e)e|drive|sun|enc\w*1"
    r"|phi_?1|servo",
    "output_angle": r"output|(?<![a-z])out(?![a-z])|abtrieb|ausgang|\bab\b|sortie|load|flange|enc\w*2|phi_?2",
    "torque": r"torque|moment|couple|\bmd\b|\bnm\b|trq",
    "temperature": r"temp|°c",
    "speed": r"speed|drehzahl|rpm|veloc|vitesse|^n$",
}
_COMMANDED = r"control(?!ler)|command|cmd|set[ _-]?(point|value|torque|pos|speed|angle)|(?<![a-z])set(?![a-z])"
_COMMANDED += r"|soll|target|demand|desired|vorgabe|consigne|(?<![a-z])ref$|^(position|velocity|torque)_error$"
_ANGLE_NAMES = r"angle|winkel|pos|phi|enc|theta|rot|count|cnt|ink"
_UNITS = {"time": "s", "torque": "N*m", "input_torque": "N*m", "temperature": "degC", "speed": "rpm"}
_ABSENT = {
    "input_angle": '  (omit this table if a shaft was locked, and write locked = "input" or "output" at the top)',
    "torque": '  (value = "50 N*m" states a constant one; without this table the load is unknown)',
}
_COUNTS = ("counts", "count", "cnt", "cts", "inc", "inkr", "ink", "incr", "ticks", "lsb")
_FEWEST = 20  # samples that show a ratio
_APART = 0.02  # largest rms of the output about a straight line over the input, relative to its range


def is_commanded(look: FirstSamples) -> bool:
    """Return whether a channel's name is that of a commanded value or a controller's error, which is no measurement."""
    return bool(re.search(_COMMANDED, look.channel.name, re.IGNORECASE))


def _rises(values: Array) -> bool:
    """Return whether values never fall and are not constant, as times; those of a coarse clock repeat."""
    finite = values[np.isfinite(values)]
    return finite.size > 1 and bool((np.diff(finite) >= 0.0).all()) and finite[-1] > finite[0]


def _named(looks: Sequence[FirstSamples], role: str) -> list[FirstSamples]:
    return [look for look in looks if re.search(_NAMES[role], look.channel.name, re.IGNORECASE)]


@dataclass(frozen=True)
class Inspection:
    """The content of a bench file, and a proposed mapping.

    Attributes
    ----------
    file
        The open file.
    looks
        The first samples of its channels.
    roles
        {role: channel proposed for it}.
    dbc
        The DBC used to open it, or None.
    runs
        Runs that a table of output angles and transmission errors seems to contain; empty for other files.
    """

    file: BenchFile
    looks: tuple[FirstSamples, ...]
    roles: dict[str, FirstSamples]
    dbc: Path | None = None
    runs: tuple[ErrorRun, ...] = ()

    @property
    def ratio(self) -> float | None:
        """Signed ratio input/output that the file states or its two angles have, as `ratio_of`; None if unknown."""
        return self.file.ratio if self.file.ratio is not None else ratio_of(self.roles)

    @property
    def text(self) -> str:
        """The proposed mapping file, with a comment wherever a value was inferred or is missing."""
        return _mapping_text(self, None if self.dbc is None else str(self.dbc.resolve()))

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the proposed mapping file, with the DBC relative to it; never a partial file."""
        folder = Path(path).resolve().parent
        dbc = None if self.dbc is None else os.path.relpath(self.dbc.resolve(), folder)
        with edge.written_whole(path) as temporary:
            temporary.write_text(_mapping_text(self, dbc), encoding="utf-8")


def inspect(path: str | os.PathLike[str], dbc: str | os.PathLike[str] | None = None) -> Inspection:
    """Return the content of a bench file and propose the roles of its channels, for the user to check.

    Parameters
    ----------
    path
        A file of any supported format.
    dbc
        The DBC of a CAN log.

    Raises
    ------
    edge.InputError
        If the file can't be read or has no samples.

    Examples
    --------
    >>> import fitting, pathlib
    >>> rows = ["t [s];Motor [deg];Flange [deg];Md [Nm]", "0;0;0;5", "1;39;1;5", ""]
    >>> _ = pathlib.Path("strange.csv").write_text(chr(10).join(rows))
    >>> {role: look.channel.name for role, look in fitting.inspect("strange.csv").roles.items()}
    {'time': 't', 'torque': 'Md', 'input_angle': 'Motor', 'output_angle': 'Flange'}
    """
    file = open_bench_file(path, dbc)
    looks = first_samples(file)
    if not looks:
        raise edge.InputError(" ".join([*file.problems, f"{path}: it has no numeric channel with samples."]))
    runs = error_runs([look for look in looks if not is_commanded(look)])
    taken = [look for run in runs for look in (run.output_angle, run.transmission_error)]
    roles = roles_of(file, [look for look in looks if look not in taken] if runs else looks)
    if runs:  # further angles belong to none of these runs
        roles = {role: look for role, look in roles.items() if not role.endswith("angle")}
    if file.timed or "time" in roles:  # the time determines the first sample
        runs = [dataclasses.replace(run, last_row_first=False) for run in runs]
    if len(runs) == 1:
        roles |= {"output_angle": runs[0].output_angle, "transmission_error": runs[0].transmission_error}
    return Inspection(file, tuple(looks), roles, None if dbc is None else Path(dbc), tuple(runs))


def inspection_json(inspection: Inspection) -> dict[str, Any]:
    """Return the content of a file as JSON data for scripts."""
    channels = {}
    for look in inspection.looks:
        low, high = look.extremes
        channels[look.channel.name] = {"unit": look.channel.unit, "samples": look.values.size, "min": low, "max": high}
    roles = {role: look.channel.name for role, look in inspection.roles.items()}
    names = ("output_angle", "transmission_error")
    runs = {run.name: {name: getattr(run, name).channel.name for name in names} for run in inspection.runs}
    return {
        "channels": channels,
        "text": list(inspection.file.texts),
        "proposed": roles,
        "ratio": inspection.ratio,
        "runs": runs,
        "problems": inspection.file.problems,
    }


def roles_of(file: BenchFile, looks: Sequence[FirstSamples]) -> dict[str, FirstSamples]:
    """Propose the roles of channels by names and units; of two angles the input is the one with more travel.

    Commanded values are not proposed: a figure from them would be that of the controller's wishes.
    """
    free = [look for look in looks if np.isfinite(look.values).any() and not is_commanded(look)]
    roles: dict[str, FirstSamples] = {}

    def choose(role: str, candidates: Sequence[FirstSamples]) -> None:
        named = _named(candidates, role) or list(candidates)
        if named:
            roles[role] = named[0]
            free.remove(named[0])

    if not file.timed:
        rising = [look for look in free if _rises(look.values)]
        timed = [look for look in rising if measures(look.channel.unit, "s")] or _named(rising, "time")
        choose("time", timed)
    torques = [o for o in free if measures(o.channel.unit, "N*m")]
    torques = torques or _named([o for o in free if not measures(o.channel.unit, "rad")], "torque")
    driving = _named(torques, "input_angle")  # of several torques, one with the input's name is the input torque
    if driving and len(torques) > len(driving):
        roles["input_torque"] = driving[0]
        free.remove(driving[0])
        torques = [o for o in torques if o not in driving]
    choose("torque", torques)
    hot = [o for o in free if measures(o.channel.unit, "K")]
    choose("temperature", hot)
    # A speed is recognised only by its unit.
    choose("speed", [o for o in free if measures(o.channel.unit, "rad/s")])
    angles = [o for o in free if measures(o.channel.unit, "rad") or o.channel.unit.lower() in _COUNTS]
    if len(angles) < 2:
        unknown = [o for o in free if not o.channel.unit]
        angles += [o for o in unknown if re.search(_ANGLE_NAMES, o.channel.name, re.IGNORECASE) and o not in angles]
    ins, outs = _named(angles, "input_angle"), _named(angles, "output_angle")
    ins, outs = [o for o in ins if o not in outs] or ins, [o for o in outs if o not in ins] or outs
    if any(re.search(r"enc[a-z]*_?0", o.channel.name, re.IGNORECASE) for o in angles):
        ins, outs = [], []  # numbered from 0, the numbers tell no shaft
    scales = [_angle_unit(o)[1] for o in angles]  # the travels are compared as angles where all units are known
    turned = {
        o.channel.name: o.travel * (1.0 if None in scales else s or 1.0) for o, s in zip(angles, scales, strict=True)
    }
    by_travel = sorted(angles, key=lambda o: -turned[o.channel.name])
    if len(angles) >= 2:
        output = outs[0] if outs else next(o for o in reversed(by_travel) if o not in ins[:1])
        given = ins[0] if ins and ins[0] is not output else next(o for o in by_travel if o is not output)
        roles["input_angle"], roles["output_angle"] = given, output
    elif angles:
        roles["output_angle"] = angles[0]
    return roles


def ratio_of(roles: Mapping[str, FirstSamples]) -> float | None:
    """Return the signed ratio of the input's to the output's rotation in a file; None if it does not show one.

    It is a whole number if the rotation agrees with one; a drive with a first stage or a pulley before an encoder has
    another.

    Parameters
    ----------
    roles
        {role: channel}; both angles must have their unit and common samples, and the input more than a turn.
    """
    angles = {role: roles.get(role) for role in ANGLES}
    columns: dict[str, Array] = {}
    for role, look in angles.items():
        if look is None or (scale := _angle_unit(look)[1]) is None:
            return None
        columns[role] = look.values * scale
    if len({values.size for values in columns.values()}) > 1:
        return None
    columns["time"] = np.arange(float(columns["input_angle"].size))
    try:
        block = Cleaning(dict.fromkeys(ANGLES), "").add(columns, None)
    except edge.InputError:  # an angle that is not in its stated unit
        return None
    if block.time.size < _FEWEST or np.ptp(block.input_angle) < 2.0 * np.pi:
        return None
    given, driven = (angle - angle.mean() for angle in (block.input_angle, block.output_angle))
    slope = float(given @ driven) / float(given @ given)
    residual = float(np.std(driven - slope * given)) / float(np.ptp(driven) or 1.0)
    if residual > _APART or slope == 0.0:
        return None
    ratio, whole = 1.0 / slope, round(1.0 / slope)
    return float(whole) if abs(ratio - whole) < max(3.0 * residual, 1e-4) * abs(ratio) else float(f"{ratio:.6g}")


def _ratio_line(ratio: float | None, stated: bool) -> str:
    if ratio is None:
        return f"# ratio = …                  # input over output: {edge.RATIO}; or --ratio, --pair"
    if stated:
        return f"ratio = {ratio:g}"
    kind = (
        edge.RATIO if ratio == round(ratio) else "not whole: is there a first stage, or a [pulley] before the encoder?"
    )
    return f"ratio = {ratio:g}                # from the two angles; {kind}"


def _mapping_text(inspection: Inspection, dbc: str | None) -> str:
    file, roles, runs = inspection.file, inspection.roles, inspection.runs
    named = {role: name_pattern for role, name_pattern in name_patterns(file.source).items() if role not in roles}
    lines = [f'format = "{FORMAT}"', _ratio_line(inspection.ratio, file.ratio is not None)]
    if dbc is not None:
        lines.append(f"dbc = {_quoted(dbc)}")
    if "time" in roles:
        lines += ["", "[time]", *_channel_lines(roles["time"], "time")]
    elif not file.timed and not runs:
        lines += ["", "# no channel looks like a time: samples are counted, and speeds are unknown", "# [time]"]
        lines.append('# column = "…"              # or rate = …, samples per second, if it is known')
    for role in CHANNELS:
        if role in roles:
            lines += ["", f"[{role}]", *_channel_lines(roles[role], role)]
        elif role in named:
            pattern, unit, comment = named[role]
            lines += ["", f"[{role}]", f"file_name = {_quoted(pattern)}" + (f"   # {comment}" if comment else "")]
            lines += [f"unit = {_quoted(unit)}"] if unit else ['unit = ""']
        elif runs and role.endswith("angle"):
            continue
        elif role not in OPTIONAL and role not in BESIDE:
            lines += ["", f"# no channel looks like {role}{_ABSENT.get(role, '')}", f"# [{role}]"]
            commands = edge.listed(o.channel.name for o in _named(inspection.looks, role) if is_commanded(o))
            lines.append('# column = "…"' + (f"              # not a command, such as {commands}" if commands else ""))
    for run in runs if len(runs) > 1 else ():
        lines += ["", "[[runs]]", f"name = {_quoted(run.name)}"]
        if run.last_row_first:
            lines.append(
                "last_row_first = true      # its angles increase like those of forward: rows in reverse order"
            )
        for role, look in (("output_angle", run.output_angle), ("transmission_error", run.transmission_error)):
            lines += [f"[runs.{role}]", *_channel_lines(look, role)]
    if len(runs) > 1 and "torque" not in roles:
        lines.append("# If the load's sign follows the motion, add a [runs.torque] with direction = -1 to one run.")
    return "\n".join(lines) + "\n"


def _quoted(text: str) -> str:
    # JSON strings are valid in TOML, except that TOML requires DEL to be escaped.
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007F")


def _channel_lines(look: FirstSamples, role: str) -> list[str]:
    lines = [f"column = {_quoted(look.channel.name)}"]
    if role.endswith("angle"):
        return [*lines, _angle_unit(look)[0]]
    if look.channel.unit:
        return [*lines, f"unit = {_quoted(unit_text(look.channel.unit))}"]
    if stated := stated_unit(look):
        return [*lines, f"unit = {_quoted(stated)}               # from its name"]
    such = f'"{_UNITS.get(role, "rad")}"'
    if role == "time" and _are_whole(look.values):
        such += "; or instead rate = …, ticks per second"
    return [*lines, f'unit = ""                   # not stated in the file; such as {such}']


def _are_whole(values: Array) -> bool:
    """Return whether all values that there are are whole numbers."""
    finite = values[np.isfinite(values)]
    return bool((finite == np.round(finite)).all())


def _angle_unit(look: FirstSamples) -> tuple[str, float | None]:
    """Return the line of a mapping with the unit of an angle, and one of these units in rad; None if it is unknown."""
    if measures(stated := stated_unit(look), "rad"):
        comment = "" if look.channel.unit else "               # from its name"
        return f"unit = {_quoted(stated)}{comment}", edge.unit_scale(stated, "rad")
    finite = look.values[np.isfinite(look.values)]
    low, high = float(finite.min()), float(finite.max())
    whole = _are_whole(finite)
    jumps = finite.size > 1 and np.abs(np.diff(finite)).max() > 0.5 * (high - low) > 0.0
    if jumps and 350.0 < high - low <= 360.0 and not whole:
        return 'unit = "deg"                # it rolls over within 360', np.radians(1.0)
    if jumps and 6.0 < high - low <= 2.0 * np.pi + 1e-9:
        return 'unit = "rad"                # it rolls over within 2 pi', 1.0
    if whole and jumps:
        counts = 1 << int(np.ceil(np.log2(high - low + 1.0)))
        return f"counts_per_turn = {counts}     # whole numbers that roll over within {counts}", 2.0 * np.pi / counts
    if whole:
        return "counts_per_turn = 0         # integers: how many per turn? (or their unit)", None
    return 'unit = ""                   # not stated in the file; such as "deg", "rad" or "rev"', None
