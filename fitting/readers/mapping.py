"""Roles of the channels of a bench file: the mapping file, and the mapping of files with our channel names."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import pydantic

from cycloid_fmu import edge
from fitting.readers.formats import BenchFile, measures, stem_of, unit_text

COLUMNS = {"time": "s", "input_angle": "rad", "output_angle": "rad", "torque": "N*m"}
OPTIONAL = {"temperature": "K", "input_torque": "N*m", "group": "1"}
ANGLES = ("input_angle", "output_angle")
BESIDE = {"transmission_error": "rad", "speed": "rad/s"}  # allowed in a file, but no column of a block
CHANNELS = (*ANGLES, "torque", *OPTIONAL, *BESIDE)
SI = {**COLUMNS, **OPTIONAL, **BESIDE}
CONSTANTS = ("torque", "speed", "temperature")
REFERRED = ("output_angle", "torque")
FORMAT = "cycloid-mapping/1"
_TURN = 2.0 * np.pi
_CONSTANT = "N*m/A"  # unit of a torque constant


class ChannelMapping(edge.Config):
    """`[input_angle]` and other roles: the channel in the file and the meaning of its numbers.

    Attributes
    ----------
    column
        The channel's name in the file.
    file_name
        In place of a column, for torque, speed and temperature: pattern in the file's name, with {} for the number that
        applies to the whole recording, such as "_{}Nm".
    value
        In place of a column, for torque, speed and temperature: the value of the whole recording, such as "50 N*m".
    unit
        Unit of the numbers; required if the file states none, and overrides that of the file.
    counts_per_turn
        In place of a unit: the numbers are counts of an angle, with this many per turn, which need not be whole.
    direction
        -1 if the numbers decrease while the quantity increases.
    rollover
        Value at which an angle rolls over, rad or text such as "360 deg"; by default an angle that stays within one
        turn and jumps back is assumed to roll over at one turn.
    zero_reference
        "absolute" if the zero is the same in every recording and, for the crank, at pin 0.
    delay
        Delay of the time stamps after the event, s or text such as "1.2 ms", from a filter or another clock.
    drift
        Relative drift of the clock of the time stamps, from the first sample on, > 0: fast; 100e-6 is 100 ppm.
    side
        Of `output_angle` and `torque`: the shaft on which it is measured. Values of the motor are referred to the
        output by the ratio: its angle over the ratio, its torque times the ratio.
    constant
        Of `torque` measured as a current: torque of the motor for each ampere, such as "0.1 N*m/A".
    """

    column: str | None = None
    file_name: str | None = None
    value: str | None = None
    unit: str | None = None
    counts_per_turn: float | None = None
    direction: Literal[1, -1] = 1
    rollover: edge.Angle | None = None
    zero_reference: Literal["absolute", "incremental"] | None = None
    delay: edge.Seconds = 0.0
    drift: Annotated[float, pydantic.Field(gt=-0.01, lt=0.01)] = 0.0
    side: Literal["output", "motor"] = "output"
    constant: str | None = None


class PulleyMapping(edge.Config):
    """`[pulley]`: the encoder of the output angle is driven by the output through a belt or gears.

    Attributes
    ----------
    ratio
        Signed ratio of the encoder's rotation to the output's, < 0 if they turn in opposite directions. The output
        angle is the encoder's angle over this ratio.
    """

    ratio: float


class TimeMapping(edge.Config):
    """`[time]`: the channel with the time, a channel that counts ticks, or samples at a constant rate.

    Attributes
    ----------
    column
        The channel's name in the file.
    unit
        Unit of the numbers; required if the file states none.
    rate
        With a column, in place of a unit: its ticks per second. Without: samples per second.
    """

    column: str | None = None
    unit: str | None = None
    rate: float | None = None


class _OneRun(edge.Config):
    """The channels of one run in a table."""

    input_angle: ChannelMapping | None = None
    output_angle: ChannelMapping | None = None
    transmission_error: ChannelMapping | None = None
    torque: ChannelMapping | None = None
    speed: ChannelMapping | None = None
    temperature: ChannelMapping | None = None
    input_torque: ChannelMapping | None = None
    group: ChannelMapping | None = None
    last_row_first: bool = False


class RunMapping(_OneRun):
    """`[[runs]]`: one of several runs side by side in a table; its channels override those of the file.

    Attributes
    ----------
    name
        Name of the run in messages and reports, such as "forward".
    last_row_first
        Whether the run's last sample is in the first row, such as when both directions share a column of angles.
    input_angle, output_angle, transmission_error, torque, speed, temperature, input_torque, group
        As in `FileMapping`.
    """

    name: Annotated[str, pydantic.Field(min_length=1, max_length=80)]


class FileMapping(_OneRun):
    """A mapping file, `cycloid-mapping/1`.

    Attributes
    ----------
    ratio
        Ratio input/output of the drive: -gear_teeth with a fixed ring, +pins with a fixed carrier.
    locked
        The shaft that is locked in the recording: its angle, if there is one, is no motion of the drive.
    dbc
        DBC of a CAN log, relative to the mapping file.
    time
        Omitted if the file's channels have their own times, or if the times are unknown: samples are then counted.
    pulley
        Omitted if the encoder of the output angle is on the output itself.
    input_angle
        Omitted if the input was locked and not measured.
    output_angle
        The channel.
    torque
        Omitted if the torque is unknown: there are then no loops, and a run has no load.
    transmission_error
        In place of the input angle, which is then (output angle - transmission error) times the ratio: its zero is
        where these two are equal.
    speed
        Optional: speed of the run, of the shaft to which the bench's speed refers.
    temperature, input_torque
        Optional. The input torque gives the no-load starting torque.
    group
        Optional: a number of the position, size or repetition of loops, the same in all samples of a group.
    runs
        Several runs in one table, each a separate recording.
    last_row_first
        Whether the last sample is in the first row.
    """

    ratio: float | None = None
    locked: Literal["input", "output"] | None = None
    dbc: str | None = None
    time: TimeMapping | None = None
    pulley: PulleyMapping | None = None
    runs: tuple[RunMapping, ...] = ()

    def each(self) -> Iterator[tuple[str, FileMapping]]:
        """Yield name and mapping of every run in a table; a table with a single run yields one without a name."""
        if not self.runs:
            yield "", self
        for run in self.runs:
            own = {n: channel for n in CHANNELS if (channel := getattr(run, n)) is not None}
            yield run.name, self.model_copy(update={**own, "last_row_first": run.last_row_first, "runs": ()})


def read_mapping(path: str | os.PathLike[str]) -> FileMapping:
    """Read a mapping file; the path of its DBC is relative to it.

    Raises
    ------
    edge.InputError
        If the file is invalid; one sentence for each problem.

    Examples
    --------
    >>> import fitting, pathlib
    >>> _ = pathlib.Path("map.toml").write_text('''
    ... format = "cycloid-mapping/1"
    ... ratio = -39
    ... time = {rate = 1000}
    ... input_angle = {column = "Motor", unit = "deg"}
    ... output_angle = {column = "Flange", unit = "deg", direction = -1}
    ... torque = {column = "Md", unit = "N*m"}
    ... ''')
    >>> fitting.read_mapping("map.toml").output_angle.direction
    -1
    """
    source = str(path)
    table = edge.toml_table(edge.read_text(path), FORMAT, source)
    mapping = edge.validated(FileMapping, table, source)
    names = [run.name for run in mapping.runs]
    if len(set(names)) < len(names):
        raise edge.InputError(f"{source}: [[runs]] name: {edge.listed(names)}; each run needs its own name.")
    for name, of_run in mapping.each():
        _check_channels(of_run, f"{source}: [[runs]] {name}" if name else source)
    if mapping.time is not None:
        if mapping.time.column is None and mapping.time.rate is None:
            raise edge.InputError(f"{source}: [time] needs a column, or a rate (samples per second).")
        if mapping.time.rate is not None and mapping.time.unit is not None:
            raise edge.InputError(
                f"{source}: [time] rate and unit: give one of the two; the rate is in ticks per second."
            )
        if mapping.time.rate is not None and not 0.0 < mapping.time.rate < math.inf:
            raise edge.InputError(f"{source}: [time] rate = {mapping.time.rate}: it must be above zero.")
    if mapping.pulley is not None and not (math.isfinite(mapping.pulley.ratio) and mapping.pulley.ratio):
        raise edge.InputError(
            f"{source}: [pulley] ratio = {mapping.pulley.ratio}: give the signed ratio of the encoder's rotation to "
            "the output's, such as -3.2."
        )
    if mapping.dbc is not None:
        mapping = mapping.model_copy(update={"dbc": str(Path(path).parent / mapping.dbc)})
    return mapping


def columns_of(mapping: FileMapping) -> set[str]:
    """Return the columns that a mapping needs, those of its runs included."""
    parts = [mapping.time, *(getattr(of_run, n) for _, of_run in mapping.each() for n in CHANNELS)]
    return {part.column for part in parts if part is not None and part.column is not None}


def chosen_mapping(given: Mapping[str, tuple[BenchFile, FileMapping]]) -> tuple[BenchFile, FileMapping]:
    """Return the mapping whose columns a file has, and the file; if there is none, that of our names.

    Of two mappings that suit, the one with all columns of the other and more is taken.

    Parameters
    ----------
    given
        {name of a mapping: the file, opened with the mapping's DBC, and the mapping}.

    Raises
    ------
    edge.InputError
        If no mapping suits the file, or several do.
    """
    held = {name: {c.name for c in file.channels} for name, (file, _) in given.items()}
    needed = {name: columns_of(mapping) for name, (_, mapping) in given.items()}
    suited = [name for name in given if needed[name] <= held[name]]
    # A mapping of a run suits where that of a loop of the same rig does, and maps more.
    suited = [name for name in suited if not any(needed[name] < needed[other] for other in suited)]
    file, only = next(iter(given.values()))
    if len(suited) > 1:
        raise edge.InputError(
            f"{file.source}: several mappings suit its columns, {edge.listed(suited)}; give only one of them with "
            "this file."
        )
    if suited:
        return given[suited[0]]
    if all({*COLUMNS} - {"time"} <= columns for columns in held.values()):
        return file, own_names(file)
    if len(given) > 1:
        lacking = "; ".join(f"{name} needs {edge.listed(sorted(needed[name] - held[name]))}" for name in given)
        raise edge.InputError(f"{file.source}: no mapping suits its columns: {lacking}.")
    return file, only  # `scales_of` names the column that is missing


def _check_channels(mapping: FileMapping, source: str) -> None:
    """Refuse invalid channels of one run."""
    if mapping.output_angle is None:
        raise edge.InputError(f"{source}: output_angle is missing; a recording needs it.")
    if mapping.last_row_first and mapping.time is not None and mapping.time.column is not None:
        raise edge.InputError(
            f"{source}: last_row_first: the [time] column determines the first sample; remove one of the two."
        )
    if mapping.transmission_error is not None and mapping.input_angle is not None:
        raise edge.InputError(
            f"{source}: [input_angle] and [transmission_error]: give one of the two; the other follows from it."
        )
    for name in CHANNELS:
        channel = getattr(mapping, name)
        if channel is None:
            continue
        given = [key for key in ("column", "file_name", "value") if getattr(channel, key) is not None]
        allowed = ("column", "file_name", "value") if name in CONSTANTS else ("column",)
        if len(given) != 1:
            raise edge.InputError(f"{source}: [{name}] needs {'one of ' if allowed[1:] else ''}{', '.join(allowed)}.")
        if given[0] not in allowed:
            raise edge.InputError(
                f"{source}: [{name}] {given[0]}: only {', '.join(CONSTANTS)} can be constant in a recording."
            )
        if channel.value is not None:
            if channel.unit is not None:
                raise edge.InputError(f"{source}: [{name}] value has its own unit; remove unit.")
            _quantity(channel.value, SI[name], f"{source}: [{name}] value")
        if channel.file_name is not None:
            if channel.file_name.count("{}") != 1:
                raise edge.InputError(
                    f"{source}: [{name}] file_name = {edge.shown(channel.file_name)}: write the part of the file's "
                    'name that states it with {} for the number, such as "_{}Nm"; a - before {} is not its sign.'
                )
            if not channel.unit:
                raise edge.InputError(f"{source}: [{name}] unit: state the unit of the number in the file's name.")
        if channel.side == "motor" and name not in REFERRED:
            raise edge.InputError(f"{source}: [{name}] side: only {' and '.join(REFERRED)} are referred to the output.")
        if channel.constant is not None:
            if name != "torque":
                raise edge.InputError(f"{source}: [{name}] constant: only a torque is measured as a current.")
            if not _quantity(channel.constant, _CONSTANT, f"{source}: [{name}] constant"):
                raise edge.InputError(
                    f"{source}: [{name}] constant = {edge.shown(channel.constant)}: it must not be 0."
                )
        if channel.counts_per_turn is not None and name not in ANGLES:
            raise edge.InputError(f"{source}: [{name}] counts_per_turn: this is for angles; give the unit.")
        if channel.counts_per_turn is not None and (
            channel.unit is not None or not 1.0 <= channel.counts_per_turn < math.inf
        ):
            raise edge.InputError(
                f"{source}: [{name}] counts_per_turn = {channel.counts_per_turn:g}: give a number of at least 1 and no "
                "unit."
            )


def _quantity(text: str, si: str, where: str) -> float:
    """Return a stated quantity, SI; `where` names it in messages."""
    try:
        return edge.parse_quantity(text, si)
    except ValueError as problem:
        raise edge.InputError(f"{where} = {edge.shown(text)}: {problem}.") from None


def own_names(file: BenchFile) -> FileMapping:
    """Return the mapping of a file whose channels have our names.

    Raises
    ------
    edge.InputError
        If a channel is missing or has no unit.
    """
    channels = {c.name: c for c in file.channels}
    wanted = [n for n in COLUMNS if n != "time" or not file.timed]
    for name in wanted:
        if name not in channels:
            _refuse_left_out(file, name)
            where = f'no column "{name} [{COLUMNS[name]}]" in the header' if not file.timed else f"no {name} channel"
            held = edge.listed(list(channels)[:8]) or "no channels"
            raise edge.InputError(
                f"{file.source}: there is {where} (it has {held}); run cycloid-fit inspect on it to get a mapping."
            )
        if not channels[name].unit:
            raise edge.InputError(
                f'{file.source}: the column "{name}" has no unit; write "{name} [{COLUMNS[name]}]", or name it in a '
                "mapping."
            )
    # A table with our names has the crank's zero at pin 0; a file with its own times states its zero reference.
    index = "absolute" if not file.timed else None
    return FileMapping(
        time=None if file.timed else TimeMapping(column="time"),
        input_angle=ChannelMapping(column="input_angle", zero_reference=index),
        output_angle=ChannelMapping(column="output_angle"),
        torque=ChannelMapping(column="torque"),
        **{name: ChannelMapping(column=name) for name in OPTIONAL if name in channels},
    )


def _refuse_left_out(file: BenchFile, channel: str) -> None:
    """Raise the reason why the file's reader left a channel out, if it did."""
    if channel in file.texts:
        raise edge.InputError(f"{file.source}: the column {edge.shown(channel)} holds text, not numbers.")
    for problem in file.problems:
        if f'"{channel}" is left out' in problem:
            raise edge.InputError(problem)


def _affine(unit: str, si: str) -> tuple[float, float]:
    """Return scale and offset that convert a unit to SI; only temperatures may have an offset."""
    if si != "K":
        scale = edge.unit_scale(unit, si)
        if not measures(unit, si):
            raise ValueError(f"the unit {edge.shown(unit)} is no angle; state counts_per_turn, or a unit such as deg")
        return scale, 0.0
    try:
        zero, unit_step = (edge.units().Quantity(x, edge.parse_unit(unit)).to("K").magnitude for x in (0.0, 1.0))
    except Exception:
        raise ValueError(f'the unit "{unit}" is not a temperature; use degC or K') from None
    return float(unit_step - zero), float(zero)


def scales_of(file: BenchFile, mapping: FileMapping) -> dict[str, tuple[str, float, float]]:
    """Return {role: (channel, scale, offset)} of a mapping; numbers times scale plus offset are SI values.

    Raises
    ------
    edge.InputError
        If the file lacks a channel or its unit.
    """
    channels = {c.name: c for c in file.channels}
    scales: dict[str, tuple[str, float, float]] = {}
    roles: dict[str, ChannelMapping | TimeMapping | None] = {n: getattr(mapping, n) for n in CHANNELS}
    if not file.timed and mapping.time is not None and mapping.time.column is not None:
        roles["time"] = mapping.time
    for role, channel in roles.items():
        if channel is None or channel.column is None:
            continue
        if channel.column not in channels:
            _refuse_left_out(file, channel.column)
            held, wanted = edge.listed(channels), edge.shown(channel.column)
            raise edge.InputError(f"{file.source}: there is no column {wanted} for {role}; it has {held}.")
        si, constant = SI[role], 1.0
        if isinstance(channel, ChannelMapping) and channel.constant is not None:
            si, constant = "A", _quantity(channel.constant, _CONSTANT, f"{file.source}: [{role}] constant")
        if isinstance(channel, ChannelMapping) and channel.counts_per_turn is not None:
            scale, offset = _TURN / channel.counts_per_turn, 0.0
        elif isinstance(channel, TimeMapping) and channel.rate is not None:
            scale, offset = 1.0 / channel.rate, 0.0
        else:
            unit = channel.unit or channels[channel.column].unit or ("1" if role == "group" else "")
            if not unit:
                raise edge.InputError(
                    f'{file.source}: the column "{channel.column}" for {role} has no unit; give it in the mapping.'
                )
            try:
                scale, offset = _affine(unit_text(unit), si)
            except ValueError as problem:
                raise edge.InputError(f"{file.source}: the column {channel.column}: {problem}.") from None
        sign = constant * channel.direction if isinstance(channel, ChannelMapping) else 1.0
        scales[role] = (channel.column, sign * scale, sign * offset)
    return scales


_NUMBER = r"([+\-−]?(?:\d+(?:[.,]\d+)?|[.,]\d+))(?![\d])"


def constants_of(path: str | os.PathLike[str], mapping: FileMapping) -> dict[str, float]:
    """Return the values that a mapping states for a whole recording or finds in its name: {role: value, SI}.

    A number in the name may have a sign, including a typographic minus, and a decimal comma.

    Parameters
    ----------
    path
        The file; its ending is ignored.
    mapping
        Mapping of one run.

    Raises
    ------
    edge.InputError
        If the name does not match a pattern, or matches with different numbers.

    Examples
    --------
    >>> torque = ChannelMapping(file_name="_{}kNm", unit="kN*m")
    >>> constants_of("RV160N_-0,5kNm_10rpm.csv", FileMapping(torque=torque))
    {'torque': -500.0}
    """
    name = stem_of(path)
    constants = {}
    for role in CONSTANTS:
        channel = getattr(mapping, role)
        if channel is not None and channel.value is not None:
            constants[role] = channel.direction * _quantity(channel.value, SI[role], f"[{role}] value")
        if channel is None or channel.file_name is None:
            continue
        before, after = channel.file_name.split("{}")
        # Match whole numbers, and a pattern that begins with a letter only at the start of a word: T= not in ROT=.
        start = r"(?<![\d.,])" if not before else r"(?<![^\W\d_])" if before[0].isalpha() else ""
        end = r"(?![^\W\d_])" if after and after[-1].isalpha() else ""
        pattern = start + re.escape(before) + _NUMBER + re.escape(after) + end
        numbers = {float(m[1].replace(",", ".").replace("−", "-")) for m in re.finditer(pattern, name)}
        if len(numbers) != 1:
            many = f"in several ways ({', '.join(f'{n:g}' for n in sorted(numbers))})" if numbers else "nowhere"
            raise edge.InputError(
                f"{path}: its name matches [{role}] file_name = {edge.shown(channel.file_name)} {many}; it must state "
                "one number there."
            )
        try:
            scale, offset = _affine(unit_text(channel.unit or ""), SI[role])
        except ValueError as problem:
            raise edge.InputError(f"{path}: [{role}] in its name: {problem}.") from None
        constants[role] = channel.direction * (numbers.pop() * scale + offset)
    return constants
