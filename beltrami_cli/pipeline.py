"""From files to files: check, read, denoise, write everything or nothing."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli import formats, kernels
from beltrami_cli.config import Job, Settings
from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.evolve import Observer
from beltrami_cli.extension import own_samples
from beltrami_cli.grid import Grid, Volume, require_same_grid, with_channels
from beltrami_cli.inputs import PlaneLast, Warnings, band_of, require_usable, time_step, without
from beltrami_cli.kinds import kind_of
from beltrami_cli.progress import Phases
from beltrami_cli.record import sidecar
from beltrami_cli.resample import resample
from beltrami_cli.sampling import surface_mesh
from beltrami_cli.solver import Result, Solver
from beltrami_cli.surface import Mesh

REMEDY = "--resample brings it onto the level set's grid"


def run(job: Job, *, observer: Observer | None = None, notify: Callable[[str], None] | None = None) -> Result:
    """Denoise files: read, check, denoise, write OUT, mesh and sidecar. Nothing is written unless everything is.

    notify: called with each warning as soon as it is known. Raises as `denoise`, and RefusedError, from
    the headers alone, where an output exists or cannot be written, or the grids differ. Frames that run independently
    stream through memory one at a time; the result then holds no data.
    """
    phases, warnings = Phases(), Warnings(notify)
    grid = _check_grids(job)
    files = _Files(job, curve=1 in grid.shape)
    plane = _is_plane(job, grid)
    sources = [file for path in job.all_inputs for file in formats.input_files(path)]
    with formats.Stage(files.all, overwrite=job.overwrite, inputs=sources) as stage:
        with phases("numba"):
            kernels.wake()
        with ThreadPoolExecutor(1) as pool:
            digests = pool.submit(lambda: [_sha256(path) for path in sources])
            work = _denoise_series if job.settings.independent else _denoise_volume
            solved, like = work(job, plane, stage, phases, warnings, observer)
            hashes = digests.result()
        with phases("write"):
            if job.filled is not None:
                formats.write_volume(stage.path(job.filled), like.with_data(solved.filled), dtype=np.uint8)
            for path in files.meshes:
                assert solved.mesh is not None
                formats.write_mesh(stage.path(path), solved.mesh)
        record = sidecar(job, sources, files.all, hashes, solved.record, tuple(warnings.lines), phases.seconds)
        stage.path(files.sidecar).write_text(json.dumps(record, indent=2, allow_nan=False) + "\n", encoding="utf-8")
        stage.commit()
    return replace(solved, record=record, warnings=tuple(warnings.lines))


def _denoise_volume(
    job: Job, plane: bool, stage: formats.Stage, phases: Phases, warnings: Warnings, observer: Observer | None
) -> tuple[Result, Volume]:
    """The result, its volume written, and a volume of the grid and header that outputs are to have."""
    with phases("read"):
        psi, trust = _read_levelset(job), _read_trust(job)
        data = _read(job, job.data, channels=job.settings.kind == "vector", plane=plane)
        data = _onto(_that_counts(data, trust, job), psi, job, f"DATA {job.data}", period=job.settings.period)
        if psi is not None and formats.volume_format(job.volume) != formats.volume_format(job.data):
            data = replace(data, header=psi.header)
    solver = _solver(job, psi, trust, data.grid, phases, warnings)
    solved = solver.denoise(data.data, observer)
    with phases("write"):
        formats.write_volume(stage.path(job.volume), data.with_data(solved.data), dtype=job.settings.precision)
    return solved, data


def _denoise_series(
    job: Job, plane: bool, stage: formats.Stage, phases: Phases, warnings: Warnings, observer: Observer | None
) -> tuple[Result, Volume]:
    """As `_denoise_volume`, frame by frame."""
    with phases("read"):
        psi, trust = _read_levelset(job), _read_trust(job)
        series = formats.open_series(
            job.data, spacing=_spacing_for(job.data, job.spacing), dtype=job.settings.precision, plane=plane
        )
    like = series if psi is None else replace(series, grid=psi.grid)
    solver = _solver(job, psi, trust, like.grid, phases, warnings)

    def frame(t: int) -> np.ndarray:
        with phases("read"):
            data = _that_counts(Volume(series.frame(t), series.grid), trust, job)
            return _onto(data, psi, job, f"DATA {job.data}").data

    record: dict[str, Any] = {}
    at_vertices: list[np.ndarray] = []
    filled = np.zeros(like.grid.shape, bool)
    meshes: list[Mesh] = []

    def denoised() -> Iterator[np.ndarray]:
        for result in solver.denoise_frames(series.count, frame, record, observer):
            if result.mesh is not None and result.mesh.values is not None:
                at_vertices.append(result.mesh.values)
                meshes[:] = [result.mesh]
            np.logical_or(filled, result.filled, out=filled)
            yield result.data

    formats.write_series(stage.path(job.volume), like, denoised(), dtype=job.settings.precision)
    mesh = replace(meshes[0], values=np.stack(at_vertices, -1)) if meshes else None
    as_stored = with_channels(series.file_shape, series.count, 1) if like.grid.shape == series.grid.shape else ()
    return Result(np.empty(0), mesh, filled, record, ()), Volume(filled, like.grid, as_stored, like.header)


def _solver(
    job: Job, psi: Volume | None, trust: dict[str, Volume], grid: Grid, phases: Phases, warnings: Warnings
) -> Solver:
    with phases("read"):
        here = {name: _onto(volume, psi, job, name).data for name, volume in trust.items()}
        weights, mask = here.get("weights"), here.get("mask")
    if mask is not None:
        mask = np.nan_to_num(mask) >= 0.5  # between voxels, where it was moved
    return Solver(None if psi is None else psi.data, grid, job.settings, phases, warnings, weights, mask)


def mesh_of(
    levelset: Path,
    data: Path | None = None,
    *,
    spacing: tuple[float, ...] | None = None,
    bring: bool = False,
    inside: str = "negative",
    period: float | None = None,
) -> Mesh:
    """The surface of a level set in RAS mm, with the data as they are at its vertices (NaN where missing).

    bring: resample the data onto the level set's grid. period: of data that are angles. Raises as `run`.
    """
    psi = formats.read_volume(levelset, spacing=_spacing_for(levelset, spacing))
    require_usable(psi.grid, str(levelset))
    plane = PlaneLast(psi.grid)
    band = band_of(psi.data, Settings(inside=inside), plane, Warnings(None))
    if data is None:
        return surface_mesh(band)[0]
    flat = 1 in psi.grid.shape
    several = period is None
    volume = formats.read_volume(data, spacing=_spacing_for(data, spacing), channels=several, plane=several and flat)
    if bring:
        volume = resample(volume, psi.grid, period=period)
    require_same_grid(psi.grid, f"LEVELSET {levelset}", volume.grid, f"DATA {data}", remedy=REMEDY)
    here = band.gather(plane.forth(volume.data))
    kind = kind_of("circular" if period else "vector", here, period)[0]
    own = own_samples(band, kind.to_channels(here))
    mesh, values = surface_mesh(band, own, turns=kind.turns)
    assert values is not None
    if not np.isfinite(values).any():
        raise DataError(f"DATA {data} has no value on the surface: found only NaN there; drop it for a bare mesh")
    return replace(mesh, values=kind.at_vertices(values))


class _Files:
    """Every file that a job writes, the sidecar last."""

    def __init__(self, job: Job, curve: bool) -> None:
        meshes = job.mesh
        if meshes is None:
            meshes = () if job.settings.flat else (formats.mesh_beside(job.volume, curve=curve),)
        self.meshes = meshes
        written = [file for mesh in meshes for file in formats.mesh_files(mesh, curve=curve)]
        filled = [] if job.filled is None else formats.volume_files(job.filled)
        stem = formats.stem(job.volume)
        self.sidecar = stem.with_name(stem.name + ".json")
        self.all = [*formats.volume_files(job.volume), *filled, *written, self.sidecar]


def _check_grids(job: Job) -> Grid:
    """The grid to compute on, from headers alone; raises RefusedError where it or the outputs' formats will not do."""
    if job.spacing is not None and not any(formats.volume_format(path) == "NPY" for path in job.all_inputs):
        raise RefusedError("spacing: is for .npy inputs only; found none among LEVELSET and DATA; drop --spacing")
    several = job.settings.kind == "vector"
    grids: dict[str, tuple[Path, Grid]] = {}
    for name, path in zip(
        ("LEVELSET", "DATA", "weights", "mask"), (job.levelset, job.data, job.weights, job.mask), strict=True
    ):
        if path is not None:
            channels = several and name == "DATA"
            plane = channels and _is_plane(job, grids["LEVELSET"][1] if "LEVELSET" in grids else None)
            steps = _spacing_for(path, job.spacing)
            grids[name] = path, formats.read_grid(path, spacing=steps, channels=channels, plane=plane)
    first, (where, grid) = next(iter(grids.items()))
    for name, (path, other) in grids.items():
        if not job.resample:
            require_same_grid(grid, f"{first} {where}", other, f"{name} {path}", remedy=REMEDY)
    require_usable(grid, str(where))
    job.settings.duration(time_step(grid, job.settings))
    if not job.settings.flat:
        job.settings.half_width(grid.used_spacing)
    layout = formats.read_layout(job.data, plane=_is_plane(job, grid)) if several else (1, False)
    formats.require_writable(job.volume, grid, channels=layout[0], is_complex=layout[1])
    if job.filled is not None:
        formats.require_writable(job.filled, grid)
    return grid


def _is_plane(job: Job, grid: Grid | None) -> bool:
    """True where DATA of three axes are a plane of channels: its level set, on `grid`, is one, or it is a picture."""
    return job.levelset is None or (grid is not None and 1 in grid.shape)


def _spacing_for(path: Path, spacing: tuple[float, ...] | None) -> tuple[float, ...] | None:
    return spacing if formats.volume_format(path) == "NPY" else None


def _read(job: Job, path: Path, *, channels: bool = False, plane: bool = False) -> Volume:
    steps = _spacing_for(path, job.spacing)
    return formats.read_volume(path, spacing=steps, dtype=job.settings.precision, channels=channels, plane=plane)


def _read_levelset(job: Job) -> Volume | None:
    return None if job.levelset is None else _read(job, job.levelset)


def _read_trust(job: Job) -> dict[str, Volume]:
    """What says how much data count: "weights" as they are, "mask" as 1 where it is not 0; those there are."""
    trust = {}
    if job.weights is not None:
        trust["weights"] = _read(job, job.weights)
    if job.mask is not None:
        mask = _read(job, job.mask)
        trust["mask"] = mask.with_data((np.nan_to_num(mask.data) != 0).astype(mask.data.dtype))
    return trust


def _that_counts(data: Volume, trust: dict[str, Volume], job: Job) -> Volume:
    """Data that are to be resampled, NaN where missing, and where a mask or weights on their own grid exclude them."""
    if not job.resample:
        return data
    values = without(data.data, job.settings.missing).copy()
    for other in trust.values():
        if other.grid.matches(data.grid):
            values[~(other.data > 0)] = np.nan
    return replace(data, data=values)


def _onto(volume: Volume, psi: Volume | None, job: Job, name: str, *, period: float | None = None) -> Volume:
    """The volume on the level set's grid; missing values are not mixed with others on the way."""
    if psi is None or not job.resample or volume.grid.matches(psi.grid):
        return volume
    moved = resample(volume, psi.grid, period=period)
    if not np.isfinite(moved.data).any():
        raise DataError(
            f"{name}: has no value on the grid of {job.levelset}: found no overlap in world space, "
            "expected volumes of one head in one space"
        )
    if moved.channels > 1:  # what the header says of frames goes with them
        return Volume(moved.data, psi.grid, (), volume.header)
    return Volume(moved.data, psi.grid, psi.file_shape, psi.header)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
