"""Very many samples through the recorder and its file: none lost, at constant memory."""

import resource
import time

import numpy as np

from drivers.encoder import Encoder, steady_time
from drivers.recorder.session import record_encoders
from drivers.recording_format import Channel, RecordingReader, Samples

NAMES = ("input_angle", "output_angle", "torque")


class Counter(Encoder):
    """An encoder that has its next 4096 samples whenever it is asked."""

    def __init__(self, name):
        self.channel = Channel(name, name, "counter", "rad", 1 << 22, 1, 0.0, "absolute", "node", "SYNC")
        self.counts = np.arange(4096)

    @classmethod
    def from_config(cls, name, config, wiring):
        return cls(name)

    def __enter__(self):
        return self

    def close(self):
        pass

    def events(self):
        return []

    def read(self, timeout):
        block, self.counts = self.counts, self.counts + len(self.counts)
        value = block * 1e-6
        return Samples.checked(self.channel.name, steady_time() + value, value, counts=block)


def peak():
    """Largest memory that this process ever used, MB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024


def soak(path, samples):
    """Record so many samples and read them back: (read, [(written, seconds, peak MB) at each tenth], seconds to read).

    Every sample's count is checked against its place, so that none is lost, doubled or moved.
    """
    table, begun = [], time.perf_counter()

    def progress(live):
        written = sum(live.samples.values())
        if written * 10 // samples > len(table) and len(table) < 10:
            table.append((written, time.perf_counter() - begun, peak()))

    encoders = [Counter(name) for name in NAMES]
    written = record_encoders(encoders, path, ratio=-39.0, samples=samples // len(NAMES), progress=progress).samples
    done, read = time.perf_counter(), dict.fromkeys(NAMES, 0)
    with RecordingReader(path) as reader:
        for block, _ in reader.batches():
            assert (block.counts == read[block.channel] + np.arange(len(block))).all()
            read[block.channel] += len(block)
        assert reader.problems == []
    assert read == written
    return sum(read.values()), table, time.perf_counter() - done
