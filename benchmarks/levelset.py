"""Level sets from meshes: seconds for a folded surface of 60,000 vertices, and errors on spheres.

With the volumes of ../shared/data also the agreement with level sets that were made of the same surfaces elsewhere.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
from trimesh.creation import icosphere

from beltrami_cli.band import build_band
from beltrami_cli.distance import HALF_WIDTH, signed_distance
from beltrami_cli.formats import read_surface, read_volume
from beltrami_cli.grid import Grid
from beltrami_cli.repair import repaired
from beltrami_cli.surface import Mesh

SHARED = Path(__file__).resolve().parents[2] / "shared" / "data"
REAL = {"retino_fsaverage": "lh.crop", "s1_individual": "lh.mid.crop", "retino_hcp7t_measured": "lh.crop"}
REPEATS = 3
BAND = 4  # voxels, of a flow


def folded(vertices: int = 60_000) -> Mesh:
    """A sphere of about 38 mm with folds 9 mm deep, in rows of triangles with a small hole at each pole."""
    around, across = round(np.sqrt(2 * vertices)), round(np.sqrt(vertices / 2))
    i, j = np.indices((around, across))
    u, v = 2 * np.pi * i / around, np.pi * (j + 0.5) / across
    ray = np.stack([np.sin(v) * np.cos(u), np.sin(v) * np.sin(u), np.cos(v)], -1).reshape(-1, 3)
    radius = 38 * (1 + 0.25 * np.sin(18 * ray[:, :1]) * np.sin(11 * ray[:, 1:2]) * np.sin(10 * ray[:, 2:] + 0.4))
    here, there = i[:, :-1] * across + j[:, :-1], (i[:, :-1] + 1) % around * across + j[:, :-1]
    a, b, c, d = (x.ravel() for x in (here, here + 1, there + 1, there))
    return Mesh(radius * ray + 49.6, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32))


def sphere_error(radius: float) -> float:
    """Greatest error in voxels within the band, of an icosphere of 41,000 vertices."""
    made, centre = icosphere(subdivisions=6), np.array([radius + 8.137, radius + 8.4, radius + 7.9])
    mesh = Mesh(np.array(made.vertices) * radius + centre, np.array(made.faces, np.int32))
    side = int(2 * radius + 17)
    grid = Grid.from_spacing((side, side, side))
    psi = signed_distance(repaired(mesh), grid)
    true = np.linalg.norm(np.stack(np.indices(grid.shape), -1) - centre, axis=-1) - radius
    return float(np.abs(psi - np.clip(true, -HALF_WIDTH, HALF_WIDTH)).max())


def agreement(name: str, surface: str) -> None:
    given = read_volume(SHARED / name / "psi.nii.gz")
    mesh = read_surface(SHARED / name / f"{surface}.surf.gii")
    start = time.perf_counter()
    psi = signed_distance(repaired(mesh), given.grid)
    seconds = time.perf_counter() - start
    h = given.grid.spacing.max()
    band = np.isfinite(psi) & (np.abs(given.data) < BAND * h)
    error = np.abs(psi - given.data)[band]
    # Given ones are distances to the whole hemisphere: nearer where what is near has been cut off.
    cut_off = (np.abs(psi) - np.abs(given.data))[band] > 0.05
    signs = ((psi < 0) != (given.data < 0))[band] & ~cut_off
    apart = np.abs(given.data[band][signs]).max(initial=0)
    entries = build_band(psi, given.grid, BAND * h).entries
    parts = " ".join(f"{x:.4f}" for x in np.percentile(error[~cut_off], [50, 95, 99, 100]))
    print(f"{name:22} {len(mesh.vertices_ras_mm):6} vertices, {seconds:5.2f} s; {band.sum()} voxels in the band")
    print(f"    nearer to what the crop lacks: {cut_off.mean():.2%}; the others, mm: 50, 95, 99, 100 % {parts}")
    print(f"    other signs: {signs.mean():.4%}, at most {apart:.4f} mm from the surface; {entries} entries of a band")


def main() -> None:
    mesh, grid = folded(), Grid.from_spacing((100, 100, 100))
    seconds = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        signed_distance(repaired(mesh), grid)
        seconds.append(time.perf_counter() - start)
    print(f"folded surface, {len(mesh.vertices_ras_mm)} vertices onto 100^3: {min(seconds):.2f} s")
    for radius in (8.0, 20.0, 40.0):
        print(f"sphere of {radius:g} voxels: at most {sphere_error(radius):.4f} voxel off within {HALF_WIDTH:g}")
    for name, surface in REAL.items():
        if SHARED.is_dir():
            agreement(name, surface)


if __name__ == "__main__":
    main()
