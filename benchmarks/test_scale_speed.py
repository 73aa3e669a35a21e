"""A million drives on a cluster of a hundred workers: dask's own scheduler, workers that wait in place of computing.

Scheduler, client and workers share one process here, so the efficiency of a cluster is higher. `CYCLOID_DRIVES` scales
it, else 20,000; docs/development/scale.md has the figures of all. Efficiency is the workers' time in
drives over that of all workers until the last drive is on disk.
"""

import dataclasses
import os
import resource
import time

import numpy as np
import pytest

from cycloid_fmu.studies.checkpoint import Checkpoint
from cycloid_fmu.studies.machines import Solved, complete

DRIVES = int(float(os.environ.get("CYCLOID_DRIVES", "2e4")))
# The machine's state that a worker watches each half second: a hundred would watch this one, all from one thread.
ALONE = {
    "distributed.admin.system-monitor.interval": "1h",
    "distributed.admin.system-monitor.disk": False,
    "distributed.worker.profile.enabled": False,
}
EACH = 7e-3  # s: a drive at 360 crank angles under two loads


@dataclasses.dataclass(frozen=True)
class Waited:
    """A study whose drives wait."""

    drives: int = DRIVES
    columns: tuple[str, ...] = tuple("abcdefghi")

    def identity(self):
        return {"drives": self.drives}


def figures(first, points):
    return np.sin((first + np.arange(len(points)))[:, None] * np.arange(1.0, 10.0))


def wait(study, first, points):
    time.sleep(len(points) * EACH)
    return Solved(first, figures(first, points))


def points(first, last):
    return np.empty((last - first, 14))


def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024


class StoppedError(Exception):
    pass


@pytest.mark.parametrize("workers", [1, 10, 100])
def test_efficiency_of_a_cluster(benchmark, tmp_path, workers):
    """With one and ten workers a hundredth and a tenth of the drives; half-way it is stopped and resumed."""
    import dask
    from distributed import LocalCluster

    study = Waited(DRIVES * workers // 100)
    told = []

    def progress(drives):
        told.append(drives)
        if stop and sum(told) > study.drives // 2:
            raise StoppedError

    with (
        dask.config.set(ALONE),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            processes=False,
            memory_limit=None,
            dashboard_address=None,
            silence_logs=40,
        ) as cluster,
    ):

        def run():
            kept = Checkpoint(tmp_path / "c", study)
            complete(study, points, kept, wait, workers=1, scheduler=cluster.scheduler_address, progress=progress)
            return kept

        memory, begun, used = peak(), time.perf_counter(), time.process_time()
        stop = False
        kept = benchmark.pedantic(run, rounds=1)
        took, used, memory = time.perf_counter() - begun, time.process_time() - used, peak() - memory
        benchmark.extra_info["efficiency"] = round(study.drives * EACH / (workers * took), 3)
        benchmark.extra_info["drives, tasks, s"] = [study.drives, len(told), round(took, 1)]
        benchmark.extra_info["processor ms a task"] = round(1e3 * used / len(told), 2)
        benchmark.extra_info["peak MB beyond the start"] = round(memory)
        whole = np.array(kept.values)
        assert kept.done.all()
        assert (whole == figures(0, np.empty((study.drives, 0)))).all()
        kept.path.unlink()
        stop = True
        told.clear()
        with pytest.raises(StoppedError):
            run()
        stop = False
        told.clear()
        kept = run()
        benchmark.extra_info["drives kept when stopped"] = told[0]
        assert study.drives // 2 < told[0] < study.drives
        assert (kept.values == whole).all()
