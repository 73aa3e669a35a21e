"""Few large batches in place of the many small ones of a recorder, once a recording is closed."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable, Iterator

from cycloid_fmu import edge
from drivers.recording_format.reader import RecordingReader
from drivers.recording_format.schema import COLUMNS, Event, Samples, joined
from drivers.recording_format.writer import RecordingWriter

JOINED_SAMPLES = 1 << 15  # of all channels, joined at a time: so many may be lost to damage of a closed file
LARGE = 1 << 11  # samples in a usual batch from which on joining brings little


def joined_batches(
    batches: Iterable[tuple[Samples, tuple[Event, ...]]], *, fill: bool = False
) -> Iterator[tuple[Samples, tuple[Event, ...]]]:
    """Yield the samples of each channel in large batches, and all events in their order.

    Samples of a channel keep their order; batches that lack different columns are not joined, or with `fill` as
    `schema.joined` fills them. Memory is that of `JOINED_SAMPLES`.
    """
    waiting: dict[str, list[Samples]] = {}
    events: list[Event] = []
    gathered = 0
    empty: Samples | None = None  # a batch of events alone

    def taken() -> Iterator[tuple[Samples, tuple[Event, ...]]]:
        new_events = tuple(events)
        for channel, blocks in waiting.items():
            yield joined(channel, blocks, fill=fill), new_events
            new_events = ()
        if new_events and empty is not None:
            yield empty, new_events
        waiting.clear()
        events.clear()

    for samples, new_events in batches:
        blocks = waiting.get(samples.channel, [])
        differs = not fill and blocks and len(samples) and _columns(blocks[0]) != _columns(samples)
        if gathered >= JOINED_SAMPLES or differs:
            yield from taken()
            gathered = 0
        if len(samples):
            waiting.setdefault(samples.channel, []).append(samples)
            gathered += len(samples)
        else:
            empty = samples
        events += new_events
    yield from taken()


def _columns(samples: Samples) -> frozenset[str]:
    return frozenset(name for name in COLUMNS if getattr(samples, name) is not None)


def join_batches(path: str | os.PathLike[str]) -> bool:
    """Replace a closed recording by one with the same samples and events in large batches; return whether it did.

    Each old checksum is verified, each new batch has a number and a checksum, and the new file replaces the old one
    only when it is on disk: a kill at any byte leaves the old one. A recording that is damaged or was not closed is
    left as it is, and so is one that cannot be replaced, because the disk is full or another program holds it open.
    """
    with contextlib.suppress(_DamagedError, OSError, edge.InputError), RecordingReader(path) as reader:
        with edge.written_whole(path) as temporary:
            with RecordingWriter(temporary, reader.header) as writer:
                for samples, events in joined_batches(reader.batches()):
                    writer.write(samples, events)
            if reader.problems:
                raise _DamagedError
        return True
    return False


class _DamagedError(Exception):
    """The recording is to stay as it is."""
