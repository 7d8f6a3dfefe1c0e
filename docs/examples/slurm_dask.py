"""Run a study on a SLURM cluster: workers as jobs of SLURM, and `beltrami batch` on them.

python slurm_dask.py study.toml --workers 20 --hours 4 --resume --summary study.csv

Start it where it may run for as long as the study: on a login node inside tmux or screen, or in a small job of its own.
What it does not know itself goes to `beltrami batch`. Needs: pip install 'beltrami_cli[cluster]' dask-jobqueue
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
from contextlib import suppress
from typing import Any


def slurm(hours: float, cores: int, memory: str) -> Any:
    """Workers that SLURM starts: each one process, which does one job of the study at a time with all its cores."""
    from dask_jobqueue import SLURMCluster

    minutes = round(60 * hours)
    return SLURMCluster(
        cores=cores,
        processes=1,
        memory=memory,
        walltime=f"{minutes // 60:02d}:{minutes % 60:02d}:00",
        # Before SLURM ends them at the walltime workers end by themselves, not all at once, and are replaced. A job
        # of the study that runs then is started again elsewhere.
        worker_extra_args=["--lifetime", f"{minutes - 10}m", "--lifetime-stagger", "4m"],
        local_directory="/tmp",
        log_directory="slurm_logs",
        # Compiled kernels are kept beside the package, or where this names a folder that can be written to.
        # job_script_prologue=["export NUMBA_CACHE_DIR=$HOME/.cache/numba"],
    )


def local(cores: int, workers: int) -> Any:
    """Workers on this machine, to try the script without SLURM."""
    from distributed import LocalCluster

    return LocalCluster(
        n_workers=workers,
        threads_per_worker=cores,
        processes=True,
        dashboard_address=None,
        local_directory=tempfile.gettempdir(),
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0], allow_abbrev=False)
    parser.add_argument("config")
    parser.add_argument("--workers", type=int, default=4, help="that many at once")
    parser.add_argument("--hours", type=float, default=4, help="walltime of each worker, at least 0.5")
    parser.add_argument("--cores", type=int, default=4, help="of each worker")
    parser.add_argument("--memory", default="16GB", help="of each worker")
    parser.add_argument("--local", action="store_true", help="workers on this machine instead of SLURM")
    given, options = parser.parse_known_args()
    with local(given.cores, given.workers) if given.local else slurm(given.hours, given.cores, given.memory) as cluster:
        batch = ["-m", "beltrami_cli", "batch", given.config, "--scheduler", cluster.scheduler_address, *options]
        running = subprocess.Popen([sys.executable, *batch])
        while running.poll() is None:
            cluster.scale(given.workers)  # again and again: those that ended are replaced
            with suppress(subprocess.TimeoutExpired):
                running.wait(30)
        return running.returncode


if __name__ == "__main__":
    sys.exit(main())
