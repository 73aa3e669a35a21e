"""Every writer on a disk that takes no more: one sentence with the file's name, status 1, and no part of a file."""

import contextlib
import errno
import os
import resource
import shlex
import shutil
import signal
import subprocess

import pytest
from common import BENCH, EXAMPLES
from test_damaged_files import table

from drivers.recording_format import RecordingWriter
from tests.drivers.test_recording_format import HEADER, NAMES, block, write

SIZE, LEFT = 64 << 10, 8 << 10  # bytes of the disk, and those that it takes before it is full


@contextlib.contextmanager
def small_disk(folder):
    """A file system of its own; False where nobody may mount one."""
    mount = shutil.which("mount")
    made = mount and subprocess.run([mount, "-t", "tmpfs", "-o", f"size={SIZE}", "tmpfs", folder], capture_output=True)
    try:
        yield bool(made and made.returncode == 0)
    finally:
        if made and made.returncode == 0:
            subprocess.run(["umount", "-l", folder], check=True)


@contextlib.contextmanager
def largest_file(size):
    """No file of this process may be larger: write() fails as on a full disk, with another number."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)


@pytest.fixture
def full(request, tmp_path):
    """A folder on a disk that is nearly full, and a context in which files are limited."""
    folder = tmp_path / "full"
    folder.mkdir()
    if request.param == "file size limit":
        yield folder, largest_file(LEFT)
        return
    with small_disk(folder) as mounted:
        if mounted:
            (folder / "other").write_bytes(bytes(SIZE - LEFT))
        yield folder, contextlib.nullcontext() if mounted else largest_file(LEFT)


PAIR = "drive-39-40.toml"
EXPORT = "cycloid-bench export long.arrows -o"
ANALYZE = f"cycloid-fmu analyze {PAIR} --torque '20 N*m' --angles 90"
STUDY = f"cycloid-fmu tolerance {PAIR} --tolerances tolerances.toml --torque '20 N*m' --samples 4 --angles 20 -o"
RUNS = "30Nm-forward.csv 30Nm-backward.csv 100Nm-forward.csv 100Nm-backward.csv --pair pair.toml"
QUICK = (
    f"{EXPORT} OUT/run.nc",
    f"{EXPORT} OUT/run.parquet",
    "cycloid-bench repair long.arrows -o OUT/run.arrows",
    f"{ANALYZE} -o OUT/a.nc",
)
OTHERS = (
    f"{EXPORT} OUT/run.csv",
    f"{EXPORT} OUT/run.mf4",
    f"{ANALYZE} --plot OUT/a.png",
    f"{ANALYZE} --plot OUT/a.pdf",
    f"cycloid-fmu surface nominal {PAIR} -o OUT/s.nc",
    f"cycloid-fmu build {PAIR} -o OUT/d.fmu",
    "cycloid-fmu simulate drive.fmu --torque '20 N*m' --turns 1 -o OUT/r.csv",
    f"{STUDY} OUT/t.nc",
    "cycloid-fit inspect run.csv -o OUT/map.toml",
    f"cycloid-fit curve {RUNS} -o OUT/c.nc",
    f"cycloid-fit metrics {RUNS} -o OUT/m.json",
    f"cycloid-fit report {RUNS} -o OUT/r.html",
    f"cycloid-fit report {RUNS} -o OUT/r.pdf",
    f"cycloid-fit identify {RUNS} -o OUT/fit.json",
    f"cycloid-fit identify {RUNS} --surface OUT/s.nc",
    f"cycloid-fit identify {RUNS} --report OUT/fit.html",
)
CASES = [
    *((line, kind) for line in QUICK for kind in ("full disk", "file size limit")),
    *(pytest.param(line, "full disk", marks=pytest.mark.slow(5)) for line in OTHERS),
]


@pytest.fixture
def given(tmp_path):
    """The folder with the input of the commands."""
    for path in (*EXAMPLES.glob("*.toml"), *BENCH.iterdir()):
        shutil.copy(path, tmp_path)
    table(tmp_path)
    write(tmp_path / "long.arrows", [block(n, 1000 * i, 1000) for i in range(12) for n in NAMES])
    return tmp_path


@pytest.mark.parametrize(("line", "full"), CASES, indirect=["full"])
def test_a_disk_that_takes_no_more_is_one_sentence(given, full, command, line):
    (given / "there").mkdir()
    if "drive.fmu" in line:
        assert command("cycloid-fmu", "build", "drive-39-40.toml", "-o", "drive.fmu").returncode == 0
    # First with free space, so that compilers have filled their caches.
    done = command(*shlex.split(line.replace("OUT", "there")))
    assert done.returncode == 0, done.stderr
    (made,) = (given / "there").iterdir()
    folder, holding = full
    before = set(folder.iterdir())
    with holding:
        done = command(*shlex.split(line.replace("OUT", str(folder))))
    if made.stat().st_size <= LEFT:
        assert done.returncode == 0, done.stderr
        return
    said = done.stderr.splitlines()
    assert done.returncode == 1, done.stderr
    assert said[-1] in {f"{folder / made.name}: {os.strerror(number)}." for number in (errno.ENOSPC, errno.EFBIG)}
    assert not [line for line in said if "Traceback" in line or "Exception" in line]
    assert set(folder.iterdir()) - before <= {folder / "t.nc.checkpoint"}, "what is done is kept beside a study"


def test_a_recording_whose_header_the_disk_does_not_take_is_none(tmp_path):
    with largest_file(100), pytest.raises(OSError, match=r"run\.arrows") as failed:
        RecordingWriter(tmp_path / "run.arrows", HEADER)
    assert failed.value.errno == errno.EFBIG
    assert list(tmp_path.iterdir()) == []
