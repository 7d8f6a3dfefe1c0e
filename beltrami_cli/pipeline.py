"""From files to files: check, read, denoise, write everything or nothing."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np

from beltrami_cli import formats, kernels
from beltrami_cli.config import Job, Settings
from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.evolve import Observer
from beltrami_cli.extension import own_samples
from beltrami_cli.grid import Grid, Volume, require_same_grid
from beltrami_cli.progress import Phases
from beltrami_cli.record import sidecar
from beltrami_cli.resample import resample
from beltrami_cli.sampling import surface_mesh
from beltrami_cli.solver import PlaneLast, Result, Warnings, band_of, require_usable, solve, time_step
from beltrami_cli.surface import Mesh

REMEDY = "--resample brings DATA onto the level set's grid"


def run(job: Job, *, observer: Observer | None = None, notify: Callable[[str], None] | None = None) -> Result:
    """Denoise files: read, check, denoise, write OUT, mesh and sidecar. Nothing is written unless everything is.

    notify: called with each warning as soon as it is known. Raises as `denoise`, and RefusedError, from
    the headers alone, where an output exists or cannot be written, or the grids differ.
    """
    phases = Phases()
    grid = _check_grids(job)
    files = _Files(job, curve=1 in grid.shape)
    formats.require_writable(job.volume, grid)
    sources = [file for path in job.inputs for file in formats.input_files(path)]
    with formats.Stage(files.all, overwrite=job.overwrite, inputs=sources) as stage:
        with phases("numba"):
            kernels.wake()
        with phases("read"), ThreadPoolExecutor(1) as pool:
            digests = pool.submit(lambda: [_sha256(path) for path in sources])
            volume, psi = _read(job)
            hashes = digests.result()
        solved = solve(
            None if psi is None else psi.data, volume.data, volume.grid, job.settings, phases, observer, notify
        )
        with phases("write"):
            formats.write_volume(stage.path(job.volume), volume.with_data(solved.data), dtype=job.settings.precision)
            for path in files.meshes:
                assert solved.mesh is not None
                formats.write_mesh(stage.path(path), solved.mesh)
        record = sidecar(job, sources, files.all, hashes, solved.record, solved.warnings, phases.seconds)
        stage.path(files.sidecar).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
        stage.commit()
    return replace(solved, record=record)


def mesh_of(
    levelset: Path,
    data: Path | None = None,
    *,
    spacing: tuple[float, ...] | None = None,
    bring: bool = False,
    inside: str = "negative",
) -> Mesh:
    """The surface of a level set in RAS mm, with the data as they are at its vertices (NaN where missing).

    bring: resample the data onto the level set's grid. Raises as `run`.
    """
    psi = formats.read_volume(levelset, spacing=_spacing_for(levelset, spacing))
    require_usable(psi.grid, str(levelset))
    plane = PlaneLast(psi.grid)
    band = band_of(psi.data, Settings(inside=inside), plane, Warnings(None))
    if data is None:
        return surface_mesh(band)
    volume = formats.read_volume(data, spacing=_spacing_for(data, spacing))
    if bring:
        volume = resample(volume, psi.grid)
    require_same_grid(psi.grid, f"LEVELSET {levelset}", volume.grid, f"DATA {data}", remedy=REMEDY)
    mesh = surface_mesh(band, own_samples(band, band.gather(plane.forth(volume.data))))
    if mesh.values is not None and not np.isfinite(mesh.values).any():
        raise DataError(f"DATA {data} has no value on the surface: found only NaN there; drop it for a bare mesh")
    return mesh


class _Files:
    """Every file that a job writes, the sidecar last."""

    def __init__(self, job: Job, curve: bool) -> None:
        meshes = job.mesh
        if meshes is None:
            meshes = () if job.settings.flat else (formats.mesh_beside(job.volume, curve=curve),)
        self.meshes = meshes
        written = [file for mesh in meshes for file in formats.mesh_files(mesh, curve=curve)]
        stem = formats.stem(job.volume)
        self.sidecar = stem.with_name(stem.name + ".json")
        self.all = [*formats.volume_files(job.volume), *written, self.sidecar]


def _check_grids(job: Job) -> Grid:
    """The grid to compute on, from headers alone; raises RefusedError where it will not do."""
    spacing = job.spacing
    grids = {path: formats.read_grid(path, spacing=_spacing_for(path, spacing)) for path in job.inputs}
    if spacing is not None and not any(formats.volume_format(path) == "NPY" for path in job.inputs):
        raise RefusedError("spacing: is for .npy inputs only; found none among LEVELSET and DATA; drop --spacing")
    grid = grids[job.inputs[0]]
    if job.levelset is not None and not job.resample:
        require_same_grid(grid, f"LEVELSET {job.levelset}", grids[job.data], f"DATA {job.data}", remedy=REMEDY)
    require_usable(grid, str(job.inputs[0]))
    job.settings.duration(time_step(grid, job.settings))
    if not job.settings.flat:
        job.settings.half_width(grid.used_spacing)
    return grid


def _spacing_for(path: Path, spacing: tuple[float, ...] | None) -> tuple[float, ...] | None:
    return spacing if formats.volume_format(path) == "NPY" else None


def _read(job: Job) -> tuple[Volume, Volume | None]:
    """DATA on the grid to compute on, with the header that OUT is to have, and LEVELSET."""

    def read(path: Path) -> Volume:
        return formats.read_volume(path, spacing=_spacing_for(path, job.spacing), dtype=job.settings.precision)

    data = read(job.data)
    if job.levelset is None:
        return data, None
    psi = read(job.levelset)
    if job.resample and not data.grid.matches(psi.grid):
        data = replace(resample(data, psi.grid), file_shape=psi.file_shape, header=psi.header)
        if not np.isfinite(data.data).any():
            raise DataError(
                f"{job.data}: has no value on the grid of {job.levelset}: found no overlap in world space, "
                "expected volumes of one head in one space"
            )
    elif formats.volume_format(job.volume) != formats.volume_format(job.data):
        data = replace(data, header=psi.header)
    return data, psi


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
