"""Overhead of a batch per job, and whether its memory stays flat: 200 small jobs, two at once.

    python benchmarks/batch.py [--count 200] [--jobs 2]

Overhead: wall time of the batch, less the start of the command and its processes (taken from a batch of two jobs), less
the jobs' own seconds (their sidecars' sum, shared by the jobs at once), per job.
"""

from __future__ import annotations

import argparse
import csv
import json
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import nibabel as nib
import numpy as np
import psutil

STUDY = """
[for_each]
data = "raw/{subject}.nii.gz"
[input]
levelset = "psi.nii.gz"
data = "{data}"
[output]
volume = "FOLDER/sub-{subject}/denoised.nii.gz"
[flow]
beta = 0.1
"""


def make_study(folder: Path, count: int, side: int) -> None:
    """A sphere in a cube of `side` voxels, and noise in `count` volumes."""
    x = np.indices((side,) * 3) - (side - 1) / 2 - 0.137
    psi = np.sqrt((x**2).sum(0)) - side / 3
    nib.save(nib.Nifti1Image(psi.astype(np.float32), np.eye(4)), folder / "psi.nii.gz")
    (folder / "raw").mkdir()
    rng = np.random.default_rng(0)
    for k in range(count):
        noise = (50 + 10 * rng.standard_normal(psi.shape)).astype(np.float32)
        nib.save(nib.Nifti1Image(noise, np.eye(4)), folder / "raw" / f"{k:04d}.nii.gz")


def run(folder: Path, name: str, jobs: int, part: str) -> tuple[float, list[dict[str, str]], list[float]]:
    """Seconds of wall time, rows of the summary, and MiB of all processes over time."""
    study = folder / f"{name}.toml"
    study.write_text(STUDY.replace("FOLDER", name))
    summary = folder / f"{name}.csv"
    command = [sys.executable, "-m", "beltrami_cli", "batch", str(study), "--jobs", str(jobs), "--part", part]
    started = time.perf_counter()
    process = subprocess.Popen([*command, "--summary", str(summary), "-q"])
    memory: list[float] = []
    watcher = threading.Thread(target=watch, args=(process.pid, memory), daemon=True)
    watcher.start()
    code = process.wait()
    wall = time.perf_counter() - started
    watcher.join()
    assert code == 0, "the batch failed"
    return wall, list(csv.DictReader(summary.open())), memory


def watch(pid: int, memory: list[float]) -> None:
    """Append the resident MiB of a process and its children every half second until it ends."""
    while True:
        try:
            parent = psutil.Process(pid)
            memory.append(sum(p.memory_info().rss for p in [parent, *parent.children(recursive=True)]) / 2**20)
        except psutil.Error:
            return
        time.sleep(0.5)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--side", type=int, default=24, help="voxels")
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        make_study(folder, options.count, options.side)
        few = f"1/{options.count // options.jobs}"
        start, first, _ = run(folder, "start", options.jobs, few)
        wall, rows, memory = run(folder, "whole", options.jobs, "1/1")
        own = sum(float(row["seconds"]) for row in rows)
        flow = sum(json.loads((folder / "whole" / f"sub-{k:04d}" / "denoised.json").read_text())["Seconds"]["flow"]
                   for k in range(options.count))  # fmt: skip
    more = len(rows) - len(first)
    print(f"{len(rows)} jobs, {options.jobs} at once: {wall:.1f} s, of which start {start:.1f} s ({len(first)} jobs)")
    print(f"wall per further job {(wall - start) / more:.3f} s; with the start {wall / len(rows):.3f} s")
    print(f"jobs' own seconds {own / len(rows):.3f} each, flow alone {flow / len(rows):.3f}")
    print(f"overhead per job, wall less flow: {(wall - flow) / len(rows):.3f} s (bound 0.15)")
    late = len(memory) // 2
    print(f"memory of all processes: {max(memory[late // 2:late]):.0f} MiB in the second quarter, "
          f"{max(memory[late:]):.0f} MiB in the second half")  # fmt: skip


if __name__ == "__main__":
    main()
