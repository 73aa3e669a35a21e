"""Many drives on a dask cluster of up to a hundred workers, which wait in place of computing.

Scheduler, client and workers share one process here, so the efficiency of a cluster is higher. `CYCLOID_DRIVES` scales
it, else 20,000; docs/development/scale.md has the figures. Efficiency is the workers' time in drives over that of all
workers until the last drive is on disk.
"""

import dataclasses
import os
import time

import numpy as np
import pytest

from cycloid_fmu.studies.checkpoint import Checkpoint
from cycloid_fmu.studies.machines import complete
from cycloid_fmu.studies.tolerance import TOGETHER

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

    drives: int
    columns: tuple[str, ...] = tuple("abcdefghi")

    def identity(self):
        return {"drives": self.drives}


def wait(numbers):
    time.sleep(numbers.size * EACH)
    return numbers, np.sin(numbers[:, None] * np.arange(1.0, 10.0)), ()


@pytest.mark.parametrize("workers", [2, 10, 100])
def test_efficiency_of_a_cluster(benchmark, tmp_path, workers):
    """With two and ten workers a fiftieth and a tenth of the drives."""
    import dask
    from distributed import LocalCluster

    study, told = Waited(DRIVES * workers // 100), []
    kept = Checkpoint(tmp_path / "c", study)
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
            where = cluster.scheduler_address
            complete(kept, wait, lambda n: (n,), together=TOGETHER, workers=1, scheduler=where, progress=told.append)

        begun, used = time.perf_counter(), time.process_time()
        benchmark.pedantic(run, rounds=1)
        took, used = time.perf_counter() - begun, time.process_time() - used
    benchmark.extra_info["efficiency"] = round(study.drives * EACH / (workers * took), 3)
    benchmark.extra_info["drives, parts, s"] = [study.drives, len(told), round(took, 1)]
    benchmark.extra_info["processor ms a part"] = round(1e3 * used / len(told), 2)
    begun = time.perf_counter()
    again = Checkpoint(tmp_path / "c", study)
    benchmark.extra_info["s to read what is kept, bytes a drive"] = [
        round(time.perf_counter() - begun, 2),
        round((tmp_path / "c").stat().st_size / study.drives),
    ]
    assert again.done.all()
    assert (again.values == kept.values).all()
