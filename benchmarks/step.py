"""One step of each scheme against a triad a[i] = b[i] + s c[i] over 20 bytes per band voxel; float32, one thread."""

from __future__ import annotations

import time
from collections.abc import Callable

import numba
import numpy as np
from common import SHAPE, folded_surface

from beltrami_cli.band import build_band
from beltrami_cli.flows import Flow, Stepper
from beltrami_cli.grid import Grid

HALF_WIDTH = 3.0  # voxels
REPEATS = 40
BOUNDS = {"paper": 12.0, "symmetric": 30.0}  # times the triad


@numba.njit(fastmath=True)
def triad(a, b, s, c):
    for i in range(len(a)):
        a[i] = b[i] + s * c[i]


def main() -> None:
    numba.set_num_threads(1)
    psi, data = folded_surface()
    band = build_band(psi, Grid.from_spacing(SHAPE), HALF_WIDTH)
    voxels = len(band.primary)
    a, b, c = np.ones((3, 20 * voxels // 12), np.float32)
    u, out = band.gather(data)[None], np.empty((1, band.entries), np.float32)
    steppers = {scheme: Stepper(Flow(scheme=scheme), band, u.dtype) for scheme in BOUNDS}
    runs: dict[str, Callable[[], object]] = {"triad": lambda: triad(a, b, np.float32(0.5), c)}
    for scheme, step in steppers.items():
        runs[scheme] = lambda step=step: step(u, out, 0.02, 0.15)

    seconds = interleaved(runs)
    print(
        f"{voxels} voxels ({voxels / psi.size:.1%} of the volume), {band.entries} entries, {REPEATS} repeats, medians"
    )
    print(f"{'':10}  {'ms':>7}  {'ns per entry':>12}  {'times triad':>11}  {'bound':>5}")
    for name, taken in seconds.items():
        bound = f"{BOUNDS[name]:5.0f}" if name in BOUNDS else ""
        ratio = taken / seconds["triad"]
        print(f"{name:10}  {1e3 * taken:7.2f}  {1e9 * taken / band.entries:12.2f}  {ratio:11.1f}  {bound}")


def interleaved(runs: dict[str, Callable[[], object]]) -> dict[str, float]:
    """Median seconds of each, run in turns, for the machine's other load to fall on all alike; the first warms up."""
    taken: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(REPEATS + 1):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            taken[name].append(time.perf_counter() - start)
    return {name: float(np.median(times[1:])) for name, times in taken.items()}


if __name__ == "__main__":
    main()
