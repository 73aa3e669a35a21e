"""Cost of an hour of four channels at 50 kHz: recorder and file against plain pyarrow with the same columns.

A hundredth of the hour, or the share that CYCLOID_HOUR states, in blocks of 50 ms, each passed to the operating
system when written and synced to disk once per second of samples, as in a run of 36 s; stated for the whole hour.
Processor seconds are those of this process; memory is the largest increase.
"""

import os
import resource
import statistics
import time

import numpy as np
import pyarrow as pa
from soak import peak

from drivers.encoder import Encoder
from drivers.recorder.session import record_encoders
from drivers.recording_format import Channel, RecordingReader, Samples

RATE, CHANNELS, BLOCK = 50_000, 4, 2_500
SHARE = float(os.environ.get("CYCLOID_HOUR", "0.01"))
PAIRS = int(os.environ.get("CYCLOID_PAIRS", "5"))
BLOCKS = round(3600 * SHARE * RATE / BLOCK)
NAMES = ("input_angle", "output_angle", "torque", "temperature")
FIELDS = {"time_host": "f8", "time_device": "f8", "counts": "i8", "value": "f8", "status": "u1"}


class Ready(Encoder):
    """An encoder whose next 50 ms of samples are there whenever it is asked; a real device costs more."""

    def __init__(self, name, begun):
        self.channel = Channel(name, name, "ready", "rad", 1 << 25, 1, 0.0, "absolute", "node", "host clock: none")
        self.begun, self.block = begun, 0

    @classmethod
    def from_config(cls, name, config, wiring):
        return cls(name, 0.0)

    def __enter__(self):
        return self

    def close(self):
        pass

    def events(self):
        return []

    def read(self, timeout):
        if self.block == BLOCKS:
            return None
        columns = columns_of(self.block)
        self.block += 1
        columns["time_host"] += self.begun
        return Samples(self.channel.name, **columns)


def columns_of(block):
    """Samples of a block: 3,000 rpm at 25 bits a turn, whose lowest ones are noise."""
    number = np.arange(block * BLOCK, (block + 1) * BLOCK)
    time_device = number / RATE
    counts = number * 33_554 + (number * 48_271 % 509)
    value = counts * (2 * np.pi / (1 << 25))
    return {
        "time_host": time_device + 2e-4,
        "time_device": time_device,
        "counts": counts,
        "value": value,
        "status": np.zeros(BLOCK, np.uint8),
    }


def used():
    """Processor seconds of this process, those in the kernel included."""
    spent = resource.getrusage(resource.RUSAGE_SELF)
    return spent.ru_utime + spent.ru_stime


def timed(run, *arguments):
    """Seconds and processor seconds."""
    begun, before = time.perf_counter(), used()
    run(*arguments)
    return time.perf_counter() - begun, used() - before


def record(path):
    encoders = [Ready(name, time.time()) for name in NAMES]
    done = record_encoders(encoders, path, ratio=-39.0, samples=BLOCKS * BLOCK)
    assert set(done.samples.values()) == {BLOCKS * BLOCK}


def write_plainly(path):
    """The same columns, blocks and syncs, without header, sequence, checksums, events, clocks and supervision."""
    index = pa.dictionary(pa.int16(), pa.string())
    kinds = {name: pa.from_numpy_dtype(np.dtype(kind)) for name, kind in FIELDS.items()}
    schema = pa.schema([("channel", index), *kinds.items()])
    with open(path, "wb") as file, pa.ipc.new_stream(file, schema) as stream:
        for block in range(BLOCKS):
            for place in range(CHANNELS):
                columns = columns_of(block)
                channel = pa.DictionaryArray.from_arrays(pa.array(np.full(BLOCK, place, np.int16)), pa.array(NAMES))
                arrays = [channel, *(pa.array(columns[name], kind) for name, kind in kinds.items())]
                stream.write_batch(pa.RecordBatch.from_arrays(arrays, schema=schema))
                file.flush()
            if block % (RATE // BLOCK) == 0:
                os.fsync(file.fileno())


def read_back(path):
    got = 0
    with RecordingReader(path) as reader:
        for samples, _ in reader.batches():
            got += len(samples) if samples.value[-1:].size else 0
    assert got == CHANNELS * BLOCKS * BLOCK


def read_plainly(path):
    with open(path, "rb") as file, pa.ipc.open_stream(file) as stream:
        got = 0
        for batch in stream:
            columns = [batch.column(name).to_numpy(zero_copy_only=False) for name in FIELDS]
            got += len(columns[0])
    assert got == CHANNELS * BLOCKS * BLOCK


def test_an_hour_of_four_channels_at_50_khz(benchmark, tmp_path):
    ours, plain = tmp_path / "hour.arrows", tmp_path / "plain.arrows"
    rounds = []
    before = peak()

    def pair():
        for path in (ours, plain):
            path.unlink(missing_ok=True)
        steps = [(record, ours), (read_back, ours), (write_plainly, plain), (read_plainly, plain)]
        order = steps if len(rounds) % 2 else steps[2:] + steps[:2]
        took = {run.__name__: timed(run, path) for run, path in order}
        rounds.append([took[run.__name__] for run, _ in steps])

    benchmark.pedantic(pair, rounds=PAIRS)
    recorded, read, written, read_plain = ([r[i] for r in rounds] for i in range(4))

    def hour(steps, which=1):
        return round(statistics.median(s[which] for s in steps) / SHARE)

    def times(steps, baseline):
        return round(statistics.median(a[1] / b[1] for a, b in zip(steps, baseline, strict=True)), 2)

    benchmark.extra_info.update(
        {
            "samples of the hour, million": round(3600 * RATE * CHANNELS / 1e6),
            "share of it that ran": SHARE,
            "recording, processor s of the hour": hour(recorded),
            "s at full speed": hour(recorded, 0),
            "times plain pyarrow": times(recorded, written),
            "GB": round(ours.stat().st_size / SHARE / 1e9, 2),
            "times plain pyarrow's bytes": round(ours.stat().st_size / plain.stat().st_size, 3),
            "MB/s at 50 kHz": round(ours.stat().st_size / (3600 * SHARE) / 1e6, 1),
            "reading back, processor s": hour(read),
            "times plain pyarrow's reading": times(read, read_plain),
            "memory above before, MB": peak() - before,
        }
    )
    print(benchmark.extra_info)
