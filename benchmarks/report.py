"""What a picture costs: `beltrami denoise` with --report, .png and .html, over the same without, and its size.

A closed folded surface of some 60,000 vertices, made here, with scalar data and a chosen beta; a second one of about
250,000 triangles. Peak memory is that of the whole command.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
import time
from pathlib import Path

import nibabel as nib
import numpy as np
from common import BELTRAMI, STARTER
from scipy.ndimage import gaussian_filter

REPEATS = 3
# Voxels of 1 mm along each axis, by how many vertices come of it.
SIZES = {"60,000 vertices": 124, "125,000 vertices": 178}


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for what, across in SIZES.items():
            write_volumes(folder, across)
            plain = seconds(folder)
            told = record(folder)
            triangles = told["Band"]["surface_vertices"] * 2
            print(f"{what} (about {triangles:,} triangles): denoise {plain:.2f} s, {told['PeakMemoryMiB']:.0f} MiB")
            for suffix in (".png", ".html"):
                took = seconds(folder, "--report", f"report{suffix}")
                told = record(folder)
                size = (folder / f"report{suffix}").stat().st_size / 1e6
                print(
                    f"  --report {suffix}: {took:.2f} s, {took - plain:.2f} s more (bound {plain + 5:.1f}), "
                    f"of which drawing {told['Seconds']['report']:.2f}; {told['PeakMemoryMiB']:.0f} MiB; {size:.1f} MB"
                )


def write_volumes(folder: Path, size: int) -> None:
    """A ball whose radius is folded by a smooth random function, and noisy data on it."""
    random = np.random.default_rng(0)
    x = np.indices((size,) * 3) - (size - 1) / 2 + 0.137
    folds = gaussian_filter(random.standard_normal(x.shape[1:]), size / 24)
    psi = np.sqrt((x**2).sum(0)) - 0.36 * size + 0.055 * size * folds / folds.std()
    smooth = gaussian_filter(random.standard_normal(x.shape[1:]), size / 8)
    data = 128 + 50 * smooth / smooth.std() + 30 * random.standard_normal(x.shape[1:])
    for name, array in (("psi", psi), ("data", data)):
        nib.save(nib.Nifti1Image(array.astype(np.float32), np.eye(4)), folder / f"{name}.nii.gz")


def seconds(folder: Path, *options: str) -> float:
    """The median wall time of the command."""
    command = [BELTRAMI, "denoise", "psi.nii.gz", "data.nii.gz", "-o", "out.nii.gz", "--overwrite", "-q", *options]
    taken = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        subprocess.run([*STARTER, *command], cwd=folder, check=True)
        taken.append(time.perf_counter() - start)
    return float(np.median(taken))


def record(folder: Path) -> dict:
    return json.loads((folder / "out.json").read_text())


if __name__ == "__main__":
    main()
