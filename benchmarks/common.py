"""What the benchmarks share: a folded surface of a hemisphere's size, and one run of the command with its record."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter

BELTRAMI = Path(sys.executable).with_name("beltrami")
# Linux counts the peak memory of the process that starts a program as the program's own: a small one has to start it.
STARTER = [sys.executable, "-S", "-c", "import subprocess, sys; sys.exit(subprocess.call(sys.argv[1:]))"]

SHAPE = (97, 222, 143)  # voxels of 1 mm, as the paper's cortex
SIGMA = 8.4  # voxels; with it the band of half-width 3 voxels fills 30 % of the volume
CLAMP = 5.0  # mm; beyond it the level set says no more than the side


def folded_surface() -> tuple[np.ndarray, np.ndarray]:
    """Level set and noisy data, float32 of `SHAPE`.

    The level set is a smooth random function over its own slope, so a distance near the surface, clamped beyond 5 mm.
    The data are a smooth map with edges, about 0..255, and Gaussian noise of 40 in every voxel.
    """
    random = np.random.default_rng(0)
    f = gaussian_filter(random.standard_normal(SHAPE), SIGMA)
    slope = np.sqrt(sum(g**2 for g in np.gradient(f)))
    psi = f / np.maximum(slope, np.abs(f) / CLAMP)
    smooth = gaussian_filter(random.standard_normal(SHAPE), 2 * SIGMA)
    clean = 98 + 40 * smooth / smooth.std() + 60 * (np.roll(smooth, 40, 1) > 0)
    return psi.astype(np.float32), (clean + 40 * random.standard_normal(SHAPE)).astype(np.float32)


def run_command(psi: np.ndarray, data: np.ndarray, *options: str) -> tuple[float, dict[str, Any]]:
    """Seconds of wall time of `beltrami denoise` on NPY files of these arrays, and its record (the sidecar)."""
    with tempfile.TemporaryDirectory() as name:
        np.save(Path(name, "psi.npy"), psi)
        np.save(Path(name, "data.npy"), data)
        command = [BELTRAMI, "denoise", "psi.npy", "data.npy", "-o", "out.npy", "-q", *options]
        start = time.perf_counter()
        subprocess.run([*STARTER, *command], cwd=name, check=True)
        seconds = time.perf_counter() - start
        return seconds, json.loads(Path(name, "out.json").read_text())
