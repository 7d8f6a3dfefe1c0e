"""Noisy polar angle at the vertices of a real cortex: on the mesh, through volumes, and Workbench's best Gaussian.

python benchmarks/onmesh.py; needs the real volumes of ../shared/data, and wb_command for the rival.
"""

from __future__ import annotations

import shutil
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
from cortex_cases import DATA, DEGREES, PAINTED, Case, angle_case, angle_truth, retino
from rivals import SIGMAS, read_maps, run, write_maps
from scipy.spatial import cKDTree

from beltrami_cli import denoise
from beltrami_cli.formats import read_surface, read_volume
from beltrami_cli.grid import Volume

AUTO = {"stop": "auto"}
GIVEN = {"beta": 0.035, "time": 1.44}  # mm per degree, mm^2: about the best for both ways
THROUGH_DEPTH = {"stop": "auto", "depth": (-2, 2)}
ANGLE = {"kind": "circular", "period": DEGREES.period}


def vertex_case() -> Case:
    """Noise of 0.6 at the vertices, the same in every voxel nearest to one: `painted_volume`."""
    return angle_case("vertices-0.6", painted_volume())


def at_vertices() -> np.ndarray:
    """(V,) noisy angle in degrees, NaN outside the visual areas."""
    maps = nib.load(DATA / "retino_fsaverage" / "lh.crop.func.gii").darrays
    return next(m.data for m in maps if m.meta["Name"] == "angle_noisy_s06").astype(float)


def painted_volume() -> Volume:
    """The vertex data in every voxel within `PAINTED` mm of the nearest vertex."""
    folder = DATA / "retino_fsaverage"
    psi, mesh = read_volume(folder / "psi.nii.gz"), read_surface(folder / "lh.crop.surf.gii")
    voxels = np.argwhere(np.ones(psi.grid.shape, bool))
    apart, nearest = cKDTree(mesh.vertices_ras_mm).query(psi.grid.to_world(voxels), distance_upper_bound=PAINTED)
    near = np.isfinite(apart)
    data = np.full(psi.grid.shape, np.nan, np.float32)
    data[tuple(voxels[near].T)] = at_vertices()[nearest[near]]
    return psi.with_data(data)


def on_mesh(case: Case, **options: Any) -> np.ndarray:
    """(V,) degrees from the data at the vertices."""
    return denoise(read_surface(case.surface), at_vertices(), **ANGLE, **options).data


def painted(case: Case, **options: Any) -> np.ndarray:
    """(V,) degrees from the painted volume and Psi, sampled at the vertices."""
    psi = read_volume(case.levelset)
    result = denoise(
        psi.data, case.volume.data, affine=psi.grid.affine, on=[read_surface(case.surface)], **ANGLE, **options
    )
    return result.on[0]


def around_mesh(case: Case, **options: Any) -> np.ndarray:
    """(V,) degrees from a volume, the mesh in the place of Psi."""
    volume = case.volume
    result = denoise(read_surface(case.surface), volume.data, affine=volume.grid.affine, **ANGLE, **options)
    assert result.mesh is not None and result.mesh.values is not None
    return result.mesh.values


def smoothed_by_workbench(case: Case) -> tuple[float, float]:
    """The least score of -metric-smoothing of the cos and sin maps over `SIGMAS`, and its sigma in mm."""
    data, found = at_vertices(), (np.inf, 0.0)
    there = np.isfinite(data)
    with tempfile.TemporaryDirectory() as name:
        rough, region, smooth = (Path(name, f"{part}.func.gii") for part in ("rough", "region", "smooth"))
        write_maps(rough, np.where(there, DEGREES.to_channels(data), 0))
        write_maps(region, there[None])
        for sigma in SIGMAS[1:]:
            run("-metric-smoothing", case.surface, rough, f"{sigma}", smooth, "-roi", region)
            found = min(found, (case.score(DEGREES.to_values(read_maps(smooth))), sigma))
    return found


def main() -> None:
    if not DATA.is_dir():
        sys.exit(f"the real volumes are not here: expected the folder {DATA}")
    case = vertex_case()
    scored = int(np.isfinite(angle_truth()).sum())
    print(f"noise at the vertices: mean error in degrees at {scored} of them, {case.score(at_vertices()):.2f} before")
    report("vertex data on the mesh", case, on_mesh, AUTO)
    report("vertex data on the mesh", case, on_mesh, GIVEN)
    report("painted, Psi, sampled", case, painted, GIVEN)
    if shutil.which("wb_command"):
        score, sigma = smoothed_by_workbench(case)
        print(f"  {'Workbench':26} {score:6.2f}           best sigma, {sigma:g} mm")
    case = angle_case("voxels-0.6", retino("angle_noisy_voxel_s0.6"))
    print("noise in every voxel, averaged over depth")
    report("the mesh as LEVELSET", case, around_mesh, THROUGH_DEPTH)
    report("Psi as LEVELSET", case, painted, THROUGH_DEPTH)


def report(label: str, case: Case, way: Any, options: dict[str, Any]) -> None:
    start = time.perf_counter()
    score = case.score(way(case, **options))
    told = " ".join(f"{name}={value}" for name, value in options.items())
    print(f"  {label:26} {score:6.2f} in {time.perf_counter() - start:4.1f} s: {told}", flush=True)


if __name__ == "__main__":
    main()
