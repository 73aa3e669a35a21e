"""Reader of the recordings that `cycloid-bench record` writes."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from cycloid_fmu import edge
from drivers.recording_format import Alignment, RecordingReader, Samples, joined, limits_of, read_clocks
from fitting.readers.formats import BenchFile, Piece, RawChannel

_GATHERED = 1 << 13  # samples of a channel joined to a piece


class RecorderFile(BenchFile):
    """A recording of `cycloid-bench record`, with its channels' clocks converted to the host's."""

    def __init__(self, source: str, dbc: object = None) -> None:
        with RecordingReader(source) as reader:
            header = reader.header
        channels = [RawChannel(c.name, c.unit, c.zero_reference) for c in header.channels]
        limits = limits_of(header)
        super().__init__(source, tuple(channels), timed=True, ratio=header.ratio, pair=header.pair, limits=limits)

    def pieces(self, names: Sequence[str]) -> Iterator[Piece]:
        """Yield pieces of these channels in the order of time."""
        known = read_clocks(self.source, names)
        # Of a channel's clocks between restarts, the least certain one determines the uncertainty of its time.
        self.clocks = {n: max(c.values(), key=lambda clock: clock.uncertainty) for n, c in known.items()}
        alignments = {n: Alignment(known.get(n, {})) for n in names}
        silent = set(names)
        waiting: dict[str, list[Samples]] = {n: [] for n in names}

        gathered = dict.fromkeys(names, 0)

        def piece(name: str) -> Piece:
            samples = joined(name, waiting[name])
            waiting[name].clear()
            gathered[name] = 0
            return Piece(alignments[name].time(samples), {name: samples.value}, samples.status)

        with RecordingReader(self.source) as reader:
            for samples, _ in reader.batches():
                if samples.channel in waiting and len(samples):
                    silent.discard(samples.channel)
                    waiting[samples.channel].append(samples)
                    # A recording that was not closed has batches of 50 ms.
                    gathered[samples.channel] += len(samples)
                    if gathered[samples.channel] >= _GATHERED:
                        yield piece(samples.channel)
            for name in names:
                if waiting[name]:
                    yield piece(name)
            self.problems = list(reader.problems)
        if silent:
            sentence = " ".join([*self.problems, f"{self.source}: the {min(silent)} channel has no samples."])
            raise edge.InputError(sentence)
