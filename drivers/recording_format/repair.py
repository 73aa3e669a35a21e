"""Recovery of truncated or damaged recordings."""

from __future__ import annotations

import contextlib
import dataclasses
import os
from collections.abc import Mapping

import numpy as np

from cycloid_fmu import edge
from drivers.recording_format.export import Progress, batches
from drivers.recording_format.joining import joined_batches
from drivers.recording_format.reader import RecordingReader
from drivers.recording_format.schema import GAP, Header
from drivers.recording_format.writer import RecordingWriter, check_new


@dataclasses.dataclass
class HeldChannel:
    """Recovered content of a channel: number of samples, of samples after a gap, and first and last `time_host`, s."""

    samples: int = 0
    gaps: int = 0
    first: float = np.inf
    last: float = -np.inf


@dataclasses.dataclass(frozen=True)
class Repaired:
    """The intact content of a recording.

    Header, content by channel name, numbers of batches and events, and one sentence for each problem, none if the file
    is complete.
    """

    header: Header
    channels: Mapping[str, HeldChannel]
    batches: int
    events: int
    problems: tuple[str, ...]


def repair(
    recording: str | os.PathLike[str], output: str | os.PathLike[str] | None = None, *, progress: Progress | None = None
) -> Repaired:
    """Read the intact content of a truncated or damaged recording, and optionally write it to a new file.

    The new file has the samples of each channel in large batches, see `joining`.

    Parameters
    ----------
    recording
        The `.arrows` file; it is not changed.
    output
        File for the recovered recording, never left partial; None: only read.
    progress
        Called with the number of bytes read since the previous call.

    Raises
    ------
    edge.InputError
        If the recording can't be read at all, or the output exists or can't be created.
    OSError
        If the disk is full; it names the file, which is removed.

    Examples
    --------
    >>> import drivers
    >>> with drivers.simulate_bench(ratio=-39, torque=20.0, turns=1, bus="virtual") as bench:
    ...     done = bench.record("whole.arrows")
    >>> kept = drivers.repair("whole.arrows")
    >>> kept.channels["torque"].samples, kept.problems
    (96, ())
    """
    if output is not None:
        check_new(edge.output_path(output, "output", (".arrows",)))
    with contextlib.ExitStack() as stack:
        reader = stack.enter_context(RecordingReader(recording))
        channels = {c.name: HeldChannel() for c in reader.header.channels}
        # The new header gets a correct checksum, so it must state that the old one was damaged.
        damage = {"damaged header": " ".join(reader.problems)} if reader.problems else {}
        header = dataclasses.replace(reader.header, conditions={**reader.header.conditions, **damage})
        writer = None
        if output is not None:
            temporary = stack.enter_context(edge.written_whole(output))
            writer = stack.enter_context(RecordingWriter(temporary, header))
        count = 0
        for samples, events in joined_batches(batches(reader, progress or (lambda _: None))):
            count += len(events)
            if len(samples):
                channel = channels[samples.channel]
                channel.samples += len(samples)
                channel.gaps += int(np.count_nonzero(samples.status & GAP))
                channel.first = min(channel.first, float(samples.time_host.min()))
                channel.last = max(channel.last, float(samples.time_host.max()))
            if writer is not None:
                writer.write(samples, events)
        return Repaired(reader.header, channels, reader.complete, count, tuple(reader.problems))
