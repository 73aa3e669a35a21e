"""The bench recording for evaluation: one table of SI values on one clock, validated.

Recordings are read block by block and may be larger than memory. Times increase, angles are unwrapped, and samples that
are missing or left out are marked and counted, never filled in silently.
"""

from __future__ import annotations

import dataclasses
import functools
import hashlib
import itertools
import math
import os
from collections.abc import Iterator, Mapping
from concurrent import futures
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cycloid_fmu import edge
from drivers.recording_format import Limits
from fitting.readers.formats import BenchFile, Piece, open_bench_file, pieces_of
from fitting.readers.mapping import (
    ANGLES,
    CHANNELS,
    REFERRED,
    ChannelMapping,
    FileMapping,
    chosen_mapping,
    constants_of,
    own_names,
    scales_of,
)
from fitting.samples.block import Block
from fitting.samples.cleaning import Cleaning
from fitting.samples.one_clock import OneClock

Array = NDArray[np.float64]
Bytes = NDArray[np.uint8]


@dataclass(frozen=True, kw_only=True)
class Recording(Block):
    """A recording: a block with all samples, and its source.

    Attributes
    ----------
    source, checksum
        Name and SHA-256 of the file.
    ratio
        Signed ratio input/output of the drive, if the recording states it.
    pair
        Name or fingerprint of the gear pair, if the recording states it.
    common_zero
        Whether the output encoder's zero is the same in every recording of the bench (an absolute encoder).
    known_index
        Whether crank angle 0 is the crank at pin 0 (an absolute or indexed input encoder).
    notes
        Notes, one sentence each, such as on samples left out or interpolated.
    alignment, torque_alignment
        Half width of the 95 % interval of the time difference, s, at the recording's ends, between the clocks of the
        two angles and of output angle and torque; 0 if they have one clock or none is known to differ.
    limits
        Limits of the encoders, as far as stated.
    speed
        Speed of the run, rad/s, of the shaft to which the bench's speed refers, if stated.
    timed
        Whether the times are seconds; otherwise they count samples.
    has_input_angle
        Whether the input angle is measured or stated; otherwise it is zero, and only the output angle is known.
    locked
        "input" or "output": the shaft that is stated to be locked; "" if it is not stated.
    pulley
        Signed ratio of the output's encoder to the output, where a belt or gears drive it; the output angle is already
        referred to the output.
    """

    source: str
    checksum: str
    ratio: float | None = None
    pair: str = ""
    common_zero: bool = False
    known_index: bool = False
    notes: tuple[str, ...] = ()
    alignment: float = 0.0
    torque_alignment: float = 0.0
    limits: Limits = dataclasses.field(default_factory=Limits)
    speed: float | None = None
    timed: bool = True
    has_input_angle: bool = True
    locked: str = ""
    pulley: float = 1.0

    def blocks(self) -> Iterator[Block]:
        """Yield the recording as one block."""
        yield self

    def recording(self, columns: Mapping[str, NDArray[Any]]) -> Recording:
        """Return this recording with other columns of a block."""
        return dataclasses.replace(self, **columns)  # type: ignore[arg-type]


def open_with_mapping(
    path: str | os.PathLike[str], mapping: FileMapping | Mapping[str, FileMapping] | None
) -> tuple[BenchFile, FileMapping]:
    """Return an open bench file and its mapping; parameters as in `RecordingStream`.

    Raises
    ------
    edge.InputError
        If the file can't be read, or no mapping or several suit it.
    """
    if mapping is None:
        file = open_bench_file(path)
        return file, own_names(file)
    if isinstance(mapping, FileMapping):
        return open_bench_file(path, mapping.dbc), mapping
    opened: dict[str | None, BenchFile] = {}  # a CAN log has the channels of its DBC
    for dbc in dict.fromkeys(candidate.dbc for candidate in mapping.values()):
        try:
            opened[dbc] = open_bench_file(path, dbc)
        except edge.InputError as problem:
            refused = problem
    if not opened:
        raise refused
    return chosen_mapping(
        {name: (opened[candidate.dbc], candidate) for name, candidate in mapping.items() if candidate.dbc in opened}
    )


class RecordingStream:
    """A recording in a file, read block by block.

    Parameters
    ----------
    path
        The file; see `fitting.readers.formats.open_bench_file` for the kinds.
    mapping
        Roles of the channels, or several mappings by name, of which the one whose columns the file has is used; None
        if the channels have our names: time, input_angle, output_angle, torque.
    ratio
        Signed ratio input/output of the drive; by default that of the mapping or the file. A measured transmission
        error requires one.
    run
        Name of the run in a table to which the mapping applies, or "".

    Attributes
    ----------
    source, ratio, pair, common_zero, known_index, limits, timed, has_input_angle, locked, pulley
        As in `Recording`; the source is the file's name, followed by a comma and the run's name if there is one.
    notes, alignment, torque_alignment, speed
        As in `Recording`; complete when all blocks have been read.

    Raises
    ------
    edge.InputError
        If the file can't be read, or a channel or its unit is missing.
    """

    def __init__(
        self,
        path: str | os.PathLike[str],
        mapping: FileMapping | Mapping[str, FileMapping] | None = None,
        ratio: float | None = None,
        run: str = "",
    ) -> None:
        self._path = str(path)
        self.source = f"{path}, {run}" if run else self._path
        self._file, self._mapping = open_with_mapping(path, mapping)
        given = mapping.values() if isinstance(mapping, Mapping) else [self._mapping]
        self._by_names = all(self._mapping is not candidate for candidate in given)
        self._scales = scales_of(self._file, self._mapping)
        self.timed = self._file.timed or self._mapping.time is not None
        self.pulley = 1.0 if self._mapping.pulley is None else self._mapping.pulley.ratio
        if self._file.timed and self._mapping.last_row_first:
            raise edge.InputError(f"{self.source}: last_row_first: the file's own times determine the first sample.")
        self.has_input_angle = self._mapping.input_angle is not None or self._mapping.transmission_error is not None
        self.locked = self._mapping.locked or ""
        self._constants = constants_of(path, self._mapping)
        own = self._mapping.ratio if self._mapping.ratio is not None else self._file.ratio
        self.ratio = own if ratio is None else ratio
        if self.ratio is None and self._mapping.transmission_error is not None:
            raise edge.InputError(
                f"{self.source}: it contains a transmission error, whose input angle follows only with the ratio of "
                f"the drive. Give the drive, or its ratio: {edge.RATIO}."
            )
        self._pulley = self.pulley
        self._referred = self._refer_to_output()
        self.pair = self._file.pair
        self.common_zero = self._zero_reference("output_angle") == "absolute"
        self.known_index = self._zero_reference("input_angle") == "absolute"
        self.limits = self._limits()
        self.notes: list[str] = []
        self.alignment = self.torque_alignment = 0.0
        self.speed: float | None = self._constants.pop("speed", None)

    def _refer_to_output(self) -> list[str]:
        """Convert what is measured on the motor to the output, and return its roles.

        The motor's angle is one behind the drive's ratio. Where the input angle is measured as well, the torque on the
        output is that of the environment, which holds against the motor.

        Raises
        ------
        edge.InputError
            If the ratio is unknown.
        """
        roles = [role for role in REFERRED if (m := getattr(self._mapping, role)) is not None and m.side == "motor"]
        if roles and self.ratio is None:
            raise edge.InputError(
                f'{self.source}: [{roles[0]}] side = "motor" needs the ratio of the drive: {edge.RATIO}; state ratio '
                "in the mapping, or give --ratio or --pair."
            )
        if "output_angle" in roles:
            self._pulley *= self.ratio or 1.0
        if "torque" in roles:
            by = -(self.ratio or 1.0) if self.has_input_angle else self.ratio or 1.0
            if "torque" in self._scales:
                column, scale, offset = self._scales["torque"]
                self._scales["torque"] = column, scale * by, offset * by
            else:
                self._constants["torque"] *= by
        return roles

    def _limits(self) -> Limits:
        """Return the limits of the encoders; counts per turn in the mapping override those of the file."""
        shown = {
            f"{role.removesuffix('_angle')}_resolution": 2.0 * math.pi / channel.counts_per_turn
            for role in ANGLES
            if (channel := getattr(self._mapping, role)) is not None and channel.counts_per_turn
        }
        limits = dataclasses.replace(self._file.limits, **shown)
        return dataclasses.replace(
            limits,
            output_resolution=limits.output_resolution / abs(self._pulley),
            output_speed=None if limits.output_speed is None else limits.output_speed / abs(self._pulley),
        )

    @functools.cached_property
    def checksum(self) -> str:
        """SHA-256 of the file."""
        with Path(self._path).open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def _zero_reference(self, name: str) -> str:
        channel: ChannelMapping | None = getattr(self._mapping, name)
        if channel is None:
            return "incremental"
        if channel.zero_reference is not None:
            return channel.zero_reference
        if name == "output_angle" and self._pulley != 1.0:  # the encoder's zero occurs several times in an output turn
            return "incremental"
        return next(c.zero_reference for c in self._file.channels if c.name == channel.column)

    def blocks(self) -> Iterator[Block]:
        """Yield the recording's blocks in the order of time.

        Raises
        ------
        edge.InputError
            If a value of the file is not a number, or it ends before the first sample.
        """
        return _read_ahead(self._blocks())

    def _blocks(self) -> Iterator[Block]:
        clocks = {n: (m.delay, m.drift) for n in CHANNELS if (m := getattr(self._mapping, n)) is not None}
        clocks = {n: clock for n, clock in clocks.items() if n in self._scales}
        rate = 1.0 if not self.timed else None if self._mapping.time is None else self._mapping.time.rate
        merge = OneClock(self._scales, rate, clocks)
        rollover = {n: m.rollover for n in ANGLES if (m := getattr(self._mapping, n))}
        cleaning = Cleaning(rollover, self.source, self.ratio, pulley=self._pulley, timed=self.timed)
        names = list(dict.fromkeys(column for column, _, _ in self._scales.values()))
        samples = 0
        pieces = pieces_of(self._file, names)
        merged = (merge.add(piece) for piece in (_backwards(pieces) if self._mapping.last_row_first else pieces))
        speed = np.zeros(2)

        def cleaned() -> Iterator[Block | None]:
            for table, status in itertools.chain(itertools.chain.from_iterable(merged), merge.finish()):
                if (shown := table.pop("speed", None)) is not None:
                    speed[:] += np.nansum(np.abs(shown)), np.count_nonzero(np.isfinite(shown))
                table |= {role: np.full(table["time"].size, value) for role, value in self._constants.items()}
                yield cleaning.add(table, status)
            yield cleaning.finish()

        for block in cleaned():
            if block is not None and block.time.size:
                samples += block.time.size
                yield block
        notes = [*self._clock_notes(), *merge.notes(), *cleaning.notes()]
        self.notes = [*self._file.problems, *(f"{self.source}: {n}" for n in notes)]
        if speed[1]:
            self.speed = float(speed[0] / speed[1])
        if self._by_names:
            self.notes.append(f"{self.source}: no mapping has its columns; they are taken by their names.")
        if not self.timed:
            self.notes.append(f"{self.source}: no time is mapped; times count samples, and speeds are unknown.")
        if "torque" not in self._scales and "torque" not in self._constants:
            self.notes.append(f"{self.source}: no torque is mapped; the load is unknown.")
        if self._referred:
            self.notes.append(
                f"{self.source}: {edge.listed(self._referred)} measured on the motor, referred to the output by the "
                f"ratio {self.ratio:g}."
            )
        if self.pulley != 1.0:
            self.notes.append(
                f"{self.source}: the output angle is that of an encoder behind a pulley of ratio {self.pulley:g}; "
                f"errors of pulley and encoder, at multiples of order {abs(self.pulley):g} of the output, are in the "
                "transmission error too."
            )
        if samples < 2:
            raise edge.InputError(
                " ".join(
                    [*self.notes, f"{self.source}: the recording has {samples or 'no'} samples; a curve needs more."]
                )
            )

    def read(self) -> Recording:
        """Return the whole recording in memory.

        Raises
        ------
        edge.InputError
            As `blocks`.
        """
        blocks = list(self.blocks())
        names = [f.name for f in dataclasses.fields(Block) if getattr(blocks[0], f.name) is not None]
        return self.recording({n: np.concatenate([getattr(b, n) for b in blocks]) for n in names})

    def recording(self, columns: Mapping[str, NDArray[Any]]) -> Recording:
        """Return columns of a block as a recording from this file; call it when all blocks have been read."""
        names = {f.name for f in dataclasses.fields(Recording)} - {f.name for f in dataclasses.fields(Block)}
        about: dict[str, Any] = {name: getattr(self, name) for name in names}
        return Recording(**{**columns, **about, "notes": tuple(self.notes)})

    def _clock_notes(self) -> list[str]:
        """Return notes on channels converted to the host's clock; set `alignment` and `torque_alignment`."""
        clocks = {role: c for role, (name, _, _) in self._scales.items() if (c := self._file.clocks.get(name))}

        def apart(roles: tuple[str, ...]) -> float:
            own = {clocks.get(role) for role in roles if role in self._scales}
            return math.hypot(*(clock.uncertainty for clock in own if clock is not None)) if len(own) > 1 else 0.0

        self.alignment, self.torque_alignment = apart(ANGLES), apart(("output_angle", "torque"))
        return [
            f"{role} has its own clock, which runs {-clock.drift * 1e6:+.3g} ppm fast; its times were converted to the "
            f"host's clock to ± {clock.uncertainty * 1e6:.2g} µs (95 %)."
            for role, clock in clocks.items()
        ]


def _read_ahead(blocks: Iterator[Block]) -> Iterator[Block]:
    """Yield blocks; a thread reads the next one meanwhile, as Arrow and NumPy use one processor each."""
    with futures.ThreadPoolExecutor(1) as reader:
        coming = reader.submit(next, blocks, None)
        while (block := coming.result()) is not None:
            coming = reader.submit(next, blocks, None)
            yield block


def _backwards(pieces: Iterator[Piece]) -> Iterator[Piece]:
    """Yield a table's rows in reverse order, as one piece; the times then count from the last row."""
    held = list(pieces)
    if held:
        values = {n: np.concatenate([p.values[n] for p in held])[::-1] for n in held[0].values}
        yield Piece(None, values)
