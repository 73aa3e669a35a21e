"""What a torn or damaged recording still holds."""

from __future__ import annotations

import dataclasses
import os

import numpy as np

from drivers.recording_format.export import Progress
from drivers.recording_format.reader import RecordingReader
from drivers.recording_format.schema import (
    GAP,
    Header,
)
from drivers.recording_format.writer import RecordingWriter


@dataclasses.dataclass
class HeldChannel:
    """What a recording holds of a channel: samples, how many follow a gap, first and last `time_host` in s."""

    samples: int = 0
    gaps: int = 0
    first: float = np.inf
    last: float = -np.inf


@dataclasses.dataclass
class Held:
    """What a recording holds that can be trusted."""

    header: Header
    channels: dict[str, HeldChannel]
    events: int = 0


def repaired(reader: RecordingReader, output: str | os.PathLike[str] | None, progress: Progress) -> Held:
    """Read all that can be trusted of a recording, and write it as a whole one.

    Parameters
    ----------
    reader
        The recording, nothing of it read yet; its `problems` say afterwards what is wrong.
    output
        New recording, or None.
    progress
        Called after each batch.

    Raises
    ------
    edge.InputError
        If the output exists or can't be created.
    """
    held = Held(reader.header, {c.name: HeldChannel() for c in reader.header.channels})
    # What is written has a checksum that is right: that the header was damaged must stand in it.
    said = {"damaged header": " ".join(reader.problems)} if reader.problems else {}
    header = dataclasses.replace(reader.header, conditions={**reader.header.conditions, **said})
    writer = RecordingWriter(output, header) if output is not None else None
    try:
        for samples, events in reader.batches():
            progress()
            held.events += len(events)
            if len(samples):
                channel = held.channels[samples.channel]
                channel.samples += len(samples)
                channel.gaps += int(np.count_nonzero(samples.status & GAP))
                channel.first = min(channel.first, float(samples.time_host.min()))
                channel.last = max(channel.last, float(samples.time_host.max()))
            if writer is not None:
                writer.write(samples, events)
    finally:
        if writer is not None:
            writer.close()
    return held
