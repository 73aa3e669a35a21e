"""Export and repair: files contain what was recorded, and memory does not grow with the recording."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import xarray as xr

from cycloid_fmu import edge
from drivers.recording_format import GAP, Event, RecordingWriter, Samples, read_recording
from drivers.recording_format.export import export
from drivers.recording_format.repair import repair
from tests.drivers.test_recording_format import HEADER, NAMES, block, write

ROOT = Path(__file__).parents[2]


@pytest.fixture
def recording(tmp_path):
    """Three channels, the torque slower than the angles, one with its own clock, and an event."""
    path = tmp_path / "run.arrows"
    with RecordingWriter(path, HEADER) as writer:
        for first in range(0, 1000, 50):
            time = np.arange(first, first + 50) / 100
            angles = {"input_angle": time * 7, "output_angle": -time * 7 / 39}
            for name, value in angles.items():
                counts = np.arange(first, first + 50)
                status = (counts == 300) * GAP
                writer.write(Samples.checked(name, time, value, counts=counts, time_device=time * 1.001, status=status))
            writer.write(Samples.checked("torque", time[::5] + 1e-3, 20 + time[::5]), [Event(time[0], "torque", "µ")])
    return path


def exported(recording, path):
    done = export(recording, path)
    assert done.rows > 0
    assert done.problems == ()
    return read_recording(recording)


def test_netcdf_holds_every_sample(tmp_path, recording):
    read = exported(recording, tmp_path / "run.nc")
    for name in NAMES:
        with xr.open_dataset(tmp_path / "run.nc", group=name, engine="h5netcdf", decode_times=False) as data:
            for column in ("time_host", "value", "status"):
                np.testing.assert_array_equal(data[column].values, getattr(read.samples[name], column))
            assert data.attrs["identity"] == "node 1"
            assert data["time_host"].attrs["units"] == "s"
    with xr.open_dataset(tmp_path / "run.nc", engine="h5netcdf") as data:
        assert data.attrs["format"] == "cycloid-recording/1"
        assert len(json.loads(data.attrs["events"])) == len(read.events) == 20


def test_parquet_holds_every_sample(tmp_path, recording):
    import pyarrow.parquet as pq

    read = exported(recording, tmp_path / "run.parquet")
    table = pq.read_table(tmp_path / "run.parquet")
    assert table.schema.metadata[b"format"] == b"cycloid-recording/1"
    for name in NAMES:
        rows = table.filter(np.array(table["channel"].to_pylist()) == name)
        np.testing.assert_array_equal(rows["value"].to_numpy(), read.samples[name].value)
        np.testing.assert_array_equal(rows["status"].to_numpy(), read.samples[name].status)
    assert len(json.loads(pq.read_metadata(tmp_path / "run.parquet").metadata[b"events"])) == 20


def test_mdf4_holds_every_sample(tmp_path, recording):
    asammdf = pytest.importorskip("asammdf")
    read = exported(recording, tmp_path / "run.mf4")
    with asammdf.MDF(tmp_path / "run.mf4") as data:
        for name in NAMES:
            signal = data.get(name)
            np.testing.assert_array_equal(signal.samples, read.samples[name].value)
            np.testing.assert_array_equal(signal.timestamps, read.samples[name].time_host)
            assert signal.unit == "rad"
        np.testing.assert_array_equal(data.get("input_angle.counts").samples, read.samples["input_angle"].counts)


def test_csv_pairs_the_angles_and_interpolates_the_torque(tmp_path, recording, monkeypatch):
    from drivers.recording_format import export as module

    exported(recording, tmp_path / "whole.csv")
    monkeypatch.setattr(module, "_CHUNK", 100)  # the table must not depend on the pieces
    exported(recording, tmp_path / "run.csv")
    assert (tmp_path / "run.csv").read_text() == (tmp_path / "whole.csv").read_text()
    time, angle, output, torque = np.loadtxt(tmp_path / "run.csv", delimiter=",", skiprows=1).T
    np.testing.assert_allclose(time, np.arange(1000) / 100, atol=1e-12)
    np.testing.assert_allclose(angle, time * 7)
    np.testing.assert_allclose(output, -time * 7 / 39)
    inside = ~np.isnan(torque)
    assert np.flatnonzero(~inside).tolist() == [0, 996, 997, 998, 999]
    np.testing.assert_allclose(torque[inside], 20 + time[inside] - 1e-3, atol=1e-9)


def test_csv_of_angles_without_common_times_is_refused(tmp_path):
    path = tmp_path / "run.arrows"
    with RecordingWriter(path, HEADER) as writer:
        for i, name in enumerate(NAMES):
            writer.write(Samples.checked(name, np.arange(5) + 0.1 * i, np.arange(5.0)))
    with pytest.raises(edge.InputError, match="have no time in common"):
        export(path, tmp_path / "run.csv")
    assert not (tmp_path / "run.csv").exists()


MEMORY = """
import resource, sys
import h5netcdf, pyarrow.parquet, asammdf, numpy
from drivers.recording_format.export import export
for name in sys.argv[2:]:
    export(sys.argv[1], name)
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024)
"""


@pytest.mark.slow(20)
def test_memory_does_not_grow_with_the_recording(tmp_path):
    pytest.importorskip("asammdf")
    peaks = {}
    for batches in (10, 100):
        path = tmp_path / f"{batches}.arrows"
        with RecordingWriter(path, HEADER) as writer:
            for i in range(batches):
                for name in NAMES:
                    writer.write(block(name, 20_000 * i, 20_000))
        names = [str(tmp_path / f"{batches}.{end}") for end in ("csv", "parquet", "nc", "mf4")]
        run = subprocess.run(
            [sys.executable, "-c", MEMORY, path, *names], cwd=ROOT, capture_output=True, text=True, check=True
        )
        peaks[batches] = [int(line) for line in run.stdout.split()]
    # 6 million samples, 200 MB, need hardly more memory than a tenth of them.
    assert max(peaks[100]) < max(peaks[10]) + 25, peaks


def test_repair_reports_the_content_of_a_truncated_file(tmp_path):
    path = write(tmp_path / "run.arrows", [block(n, 10 * i, 10) for i in range(5) for n in NAMES])
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    held = repair(path, tmp_path / "whole.arrows")
    assert "is truncated or damaged after" in held.problems[0]
    before, after = read_recording(path), read_recording(tmp_path / "whole.arrows")
    assert after.problems == ()
    for name in NAMES:
        np.testing.assert_array_equal(after.samples[name].value, before.samples[name].value)
        assert held.channels[name].samples == len(after.samples[name])
        assert held.channels[name].last == after.samples[name].time_host[-1]


@pytest.mark.parametrize("where", ["length", "flatbuffer", "marker"])
def test_reading_continues_after_damage(tmp_path, where):
    path = write(tmp_path / "run.arrows", [block("torque", 10 * i, 10) for i in range(5)])
    ends = [
        len(write(tmp_path / f"{n}.arrows", [block("torque", 10 * i, 10) for i in range(n)]).read_bytes()) - 8
        for n in (2, 3)
    ]
    data = bytearray(path.read_bytes())
    at = {"marker": 0, "length": 4, "flatbuffer": 40}[where]
    data[ends[0] + at : ends[0] + at + 4] = b"\x13\x57\x9b\x7f"
    path.write_bytes(data)
    recording = read_recording(path)
    samples = recording.samples["torque"]
    assert samples.counts.tolist() == [*range(20), *range(30, 50)]
    assert np.flatnonzero(samples.status & GAP).tolist() == [20]
    assert recording.problems
    assert repair(path).channels["torque"].gaps == 1


def test_the_commands(command, recording):
    done = command("cycloid-bench", "export", recording, "-o", "run.parquet")
    assert (done.returncode, done.stdout) == (0, "run.parquet: 2200 rows\n"), done.stderr
    data = recording.read_bytes()
    recording.write_bytes(data[:-300])
    done = command("cycloid-bench", "repair", recording, "-o", "whole.arrows")
    assert done.returncode == 1
    assert "is truncated or damaged after 59 complete batches" in done.stderr
    assert "59 intact batches, 19 events" in done.stdout
    assert "input_angle: 1000 samples, from 0.000000 s to 9.990000 s, 1 of them after a gap" in done.stdout
