"""From hours at kilohertz to figures, against the bare minimum in pandas and NumPy: read, unwrap, bin.

A recording of two hours at 4 kHz, 28.8 million samples of four channels, as Parquet (`CYCLOID_HOURS` scales it). Both
run in separate processes, one after the other, on the same file; `extra_info` has seconds, the ratio, and the
largest memory of each. It has the same for a tenth of it as our recorder writes it, a batch for each channel and
twentieth of a second, against Arrow and NumPy without checksums; `CYCLOID_RECORDED` scales this tenth.
"""

import json
import os
import subprocess
import sys

import numpy as np
import pyarrow as pa
import pytest
from pyarrow import parquet

from drivers.recording_format import Channel, Header, RecordingWriter, Samples

HOURS = float(os.environ.get("CYCLOID_HOURS", "2"))
RECORDED = float(os.environ.get("CYCLOID_RECORDED", "0.1")) * HOURS
ARCSEC = np.pi / 648000

BARE = """
import sys, numpy as np, pandas as pd
table = pd.read_parquet(sys.argv[1])
turn = 2 * np.pi * 39
angle = np.unwrap(table["input_angle [rad]"].to_numpy())
error = np.unwrap(table["output_angle [rad]"].to_numpy()) + angle / 39
number = (np.mod(angle, turn) / turn * 32768).astype(np.int64)
count = np.bincount(number, minlength=32768)
mean = np.bincount(number, error, 32768) / count
print(np.ptp(mean), table["torque [N*m]"].mean())
"""
BARE_RECORDED = """
import sys, numpy as np, pyarrow as pa
with pa.OSFile(sys.argv[1]) as file, pa.ipc.open_stream(file) as stream:
    table = stream.read_all()
channel = np.concatenate([one.indices.to_numpy() for one in table.column("channel").chunks])
angle, output, torque = (table.column("value").to_numpy()[channel == number] for number in range(3))
turn = 2 * np.pi * 39
number = (np.mod(angle, turn) / turn * 32768).astype(np.int64)
mean = np.bincount(number, output + angle / 39, 32768) / np.bincount(number, minlength=32768)
print(np.ptp(mean), torque.mean())
"""
OURS = """
import sys
from fitting.cli import main
sys.argv = ["cycloid-fit", "metrics", sys.argv[1], "--ratio", "-39", "--json"]
main()
"""
MEASURED = """
import json, resource, subprocess, sys, time
begin = time.perf_counter()
run = subprocess.run([sys.executable, "-c", *sys.argv[1:]], capture_output=True, text=True)
used = resource.getrusage(resource.RUSAGE_CHILDREN)
print(json.dumps({"seconds": time.perf_counter() - begin, "processor": used.ru_utime + used.ru_stime,
                  "megabytes": used.ru_maxrss / 1024, "out": run.stdout, "err": run.stderr, "status": run.returncode}))
"""


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """One crank turn a second, the angles rolling over at a turn, known orders 39 and 40, an arcsecond of noise."""
    path = tmp_path_factory.mktemp("long") / "run.parquet"
    rng = np.random.default_rng(0)
    samples, step = int(HOURS * 3600 * 4000), 1 << 20
    names = ("time [s]", "input_angle [rad]", "output_angle [rad]", "torque [N*m]")
    schema = pa.schema([pa.field(n, pa.float64()) for n in names])
    with parquet.ParquetWriter(path, schema) as writer:
        for begin in range(0, samples, step):
            time = np.arange(begin, min(begin + step, samples)) / 4000.0
            angle = 2 * np.pi * time
            error = ARCSEC * (20 * np.cos(angle) + 9 * np.sin(40 * angle / 39) + rng.normal(0, 1, time.size))
            columns = (time, angle % (2 * np.pi), (error - angle / 39) % (2 * np.pi), rng.normal(100, 0.1, time.size))
            writer.write_table(pa.table(list(columns), schema))
    return path


def measured(code, path):
    run = subprocess.run([sys.executable, "-c", MEASURED, code, str(path)], capture_output=True, text=True, check=True)
    found = json.loads(run.stdout)
    assert found["status"] == 0, found["err"]
    return found


def test_two_hours_to_figures(benchmark, recording):
    recording.read_bytes()  # the file is in the system's memory for both
    pairs = []
    benchmark.pedantic(lambda: pairs.append((measured(OURS, recording), measured(BARE, recording))), rounds=3)
    ratios = [ours["seconds"] / bare["seconds"] for ours, bare in pairs]
    ours, bare = pairs[int(np.argsort(ratios)[1])]
    found = json.loads(ours["out"])["angular_transmission_error"]
    turn = np.linspace(0, 2 * np.pi, 1 << 18)
    truth = np.ptp(20 * np.cos(39 * turn) + 9 * np.sin(40 * turn)) * ARCSEC
    assert abs(found["value"] - truth) < 1.5 * found["uncertainty"]
    benchmark.extra_info.update(
        {
            "seconds": round(ours["seconds"], 1),
            "megabytes": round(ours["megabytes"]),
            "bare minimum, seconds": round(bare["seconds"], 1),
            "bare minimum, megabytes": round(bare["megabytes"]),
            "times the bare minimum": round(float(np.median(ratios)), 2),
        }
    )
    print(benchmark.extra_info)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    """The same drive as the recorder writes it: four channels, two of them angles with counts."""
    path = tmp_path_factory.mktemp("recorded") / "run.arrows"
    units = {"input_angle": "rad", "output_angle": "rad", "torque": "N*m", "temperature": "K"}
    counts = 1 << 22
    channels = tuple(
        Channel(n, "other" if n == "temperature" else n, "canopen", unit, None, 1, 0.0, "absolute", "", "")
        for n, unit in units.items()
    )
    noise = np.random.default_rng(0).normal(0, 1, 200)
    with RecordingWriter(path, Header(channels, {}, -39.0, "", "2026-01-01T00:00:00+00:00")) as writer:
        for begin in range(0, int(RECORDED * 3600 * 4000), 200):
            time = np.arange(begin, begin + 200) / 4000.0
            angle = 2 * np.pi * time
            error = ARCSEC * (20 * np.cos(angle) + 9 * np.sin(40 * angle / 39) + noise)
            for name, value in zip(units, (angle, error - angle / 39, 100 + 0.1 * noise, 300 + 0 * time), strict=True):
                ticks = np.rint(value * counts / (2 * np.pi)) if units[name] == "rad" else None
                writer.write(Samples.checked(name, time, value, counts=ticks))
    return path


def test_our_recorder_s_file_to_figures(benchmark, recorded):
    recorded.read_bytes()
    pairs = []
    benchmark.pedantic(lambda: pairs.append((measured(OURS, recorded), measured(BARE_RECORDED, recorded))), rounds=3)
    ours = min((one for one, _ in pairs), key=lambda one: one["processor"])
    benchmark.extra_info.update(
        {
            "hours": RECORDED,
            "processor seconds": round(ours["processor"], 1),
            "seconds": round(ours["seconds"], 1),
            "megabytes": round(ours["megabytes"]),
            "bare minimum, megabytes": round(pairs[0][1]["megabytes"]),
            "times the bare minimum's processor seconds": round(
                float(np.median([one["processor"] / bare["processor"] for one, bare in pairs])), 2
            ),
            "file, megabytes": round(recorded.stat().st_size / 1e6),
        }
    )
    print(benchmark.extra_info)
