"""From volumes to the denoised volume and mesh: read, check, extend, evolve, mesh, write."""

from __future__ import annotations

import hashlib
import json
import os
import sys
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numba
import numpy as np

from beltrami_cli import __version__, formats
from beltrami_cli.band import Band, build_band, flat_band
from beltrami_cli.config import Job, Settings, parse_beta
from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.evolve import Evolution, Observer, Schedule, evolve
from beltrami_cli.extension import Reextension, extend, own_samples
from beltrami_cli.flows import DT_SHARE, Flow, stability_bound, typical_slope
from beltrami_cli.grid import Grid, Volume, require_same_grid
from beltrami_cli.progress import Phases
from beltrami_cli.resample import resample
from beltrami_cli.surface import Mesh, surface_mesh

# eps of the flows l1 and tv as a share of the data's typical slope: small enough that nearly every slope counts as an edge.
EPS_SHARE = 0.1
# Parts of the surface without data are worth a warning above this share of the band: below it are lone voxels.
LONE_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class Result:
    """What a run gives.

    data: denoised values in the shape of the input, NaN (or what `outside` says) beyond the band.
    mesh: the surface in RAS mm with the denoised value at every vertex; None for a flat run.
    record: every parameter as used and what happened, as in the sidecar.
    warnings: lines for the user.
    """

    data: np.ndarray
    mesh: Mesh | None
    record: dict[str, Any]
    warnings: tuple[str, ...]


def denoise(
    levelset: np.ndarray | None,
    data: np.ndarray,
    *,
    affine: np.ndarray | None = None,
    spacing: float | Sequence[float] | None = None,
    observer: Observer | None = None,
    **options: Any,
) -> Result:
    """Denoise data that lie on the zero level of a level set.

    levelset: Psi, (nx, ny, nz), or (nx, ny) for a curve in a plane; negative inside; None with flat=True.
    data: values of the same shape, NaN where missing.
    affine: (4, 4), voxel indices to RAS mm; or spacing: mm, one number or one per axis (default 1).
    observer: called after every iteration with (iteration, iterations, root mean square change).
    options: the fields of `config.Settings`, such as flow="beltrami", beta=0.05, iterations=20.

    Raises RefusedError for options or shapes that make no sense, DataError where Psi has no zero level or the data no
    value on it, NumericsError where values leave the finite numbers (all of `beltrami_cli.errors`).

    The flow is Eq. 20 of "The Beltrami Flow over Implicit Manifolds" on a narrow band with one sheet per bank.
    """
    settings = _settings(options)
    values = np.asarray(data)
    if values.ndim not in (2, 3):
        raise RefusedError(f"data: found an array of shape {values.shape}; expected 2 or 3 axes")
    if affine is not None and spacing is not None:
        raise RefusedError("affine and spacing both place the voxels; give one of them")
    psi = None if levelset is None else np.asarray(levelset)
    if psi is not None and psi.shape != values.shape:
        raise RefusedError(f"levelset has shape {psi.shape} and data {values.shape}; expected one shape for both")
    if settings.flat != (psi is None):
        raise RefusedError("levelset: expected an array, or None together with flat=True")
    steps = spacing if spacing is None or np.isscalar(spacing) else tuple(spacing)  # type: ignore[arg-type]
    grid = Grid.from_spacing(values.shape, 1.0 if steps is None else steps)  # type: ignore[arg-type]
    if affine is not None:
        grid = Grid(grid.shape, np.asarray(affine, float))
    solved = _solve(
        None if psi is None else _as_float(psi, settings).reshape(grid.shape),
        _as_float(values, settings).reshape(grid.shape),
        grid, settings, Phases(), observer,
    )  # fmt: skip
    return replace(solved, data=solved.data.reshape(values.shape))


def run(job: Job, *, observer: Observer | None = None, notify: Callable[[str], None] | None = None) -> Result:
    """Denoise files: read, check, denoise, write OUT, mesh and sidecar. Nothing is written unless everything is.

    notify: called with each warning as soon as it is known. Raises as `denoise`, and RefusedError before anything is
    read where an output exists or cannot be written, or the grids differ.
    """
    phases = Phases()
    grid = _check_grids(job)
    files = _Files(job, curve=1 in grid.shape)
    formats.require_writable(job.volume, grid)
    with formats.Stage(files.all, overwrite=job.overwrite, inputs=job.inputs) as stage:
        with phases("read"), ThreadPoolExecutor(1) as pool:
            digests = pool.submit(lambda: [_sha256(path) for path in job.inputs])
            volume, psi = _read(job)
            hashes = digests.result()
        solved = _solve(
            None if psi is None else psi.data, volume.data, volume.grid, job.settings, phases, observer, notify
        )
        with phases("write"):
            formats.write_volume(stage.path(job.volume), volume.with_data(solved.data), dtype=job.settings.precision)
            for path in files.meshes:
                assert solved.mesh is not None
                formats.write_mesh(stage.path(path), solved.mesh)
        record = _sidecar(job, files, hashes, solved, phases)
        stage.path(files.sidecar).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
        stage.commit()
    return replace(solved, record=record)


def run_mesh(
    levelset: Path,
    data: Path | None,
    output: Path,
    *,
    spacing: tuple[float, ...] | None = None,
    bring: bool = False,
    inside: str = "negative",
    overwrite: bool = False,
) -> list[Path]:
    """Write the surface of a level set, with the data as they are at its vertices (NaN where missing).

    bring: resample the data onto the level set's grid. Returns the files written; raises as `run`.
    """
    sources = [path for path in (levelset, data) if path is not None]
    grids = [formats.read_grid(path, spacing=_spacing_for(path, spacing)) for path in sources]
    if data is not None and not bring:
        require_same_grid(grids[0], f"LEVELSET {levelset}", grids[1], f"DATA {data}")
    _require_usable(grids[0], str(levelset))
    files = formats.mesh_files(output, values=data is not None, curve=1 in grids[0].shape)
    with formats.Stage(files, overwrite=overwrite, inputs=sources) as stage:
        psi = formats.read_volume(levelset, spacing=_spacing_for(levelset, spacing))
        plane, settings = _PlaneLast(psi.grid), Settings(inside=inside)
        band = _band(psi.data, settings, plane, _Warnings(None))
        values = None
        if data is not None:
            volume = formats.read_volume(data, spacing=_spacing_for(data, spacing))
            if bring:
                volume = resample(volume, psi.grid)
            values = own_samples(band, band.gather(plane.forth(volume.data)))
        formats.write_mesh(stage.path(output), surface_mesh(band, values))
        stage.commit()
    return files


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
        require_same_grid(grid, f"LEVELSET {job.levelset}", grids[job.data], f"DATA {job.data}")
    _require_usable(grid, str(job.inputs[0]))
    _schedule_dt(grid, job.settings)
    if not job.settings.flat:
        job.settings.half_width(grid.spacing[np.array(grid.shape) > 1])
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
    elif formats.volume_format(job.volume) != formats.volume_format(job.data):
        data = replace(data, header=psi.header)
    return data, psi


def _require_usable(grid: Grid, name: str) -> None:
    if grid.is_sheared():
        raise RefusedError(
            f"{name}: its voxel axes are not orthogonal (a sheared affine); expected a rectangular grid: "
            "resample it onto one first"
        )


def _schedule_dt(grid: Grid, settings: Settings) -> float:
    """dt in mm^2 for this grid; raises RefusedError where the one asked for is over the bound."""
    bound = stability_bound(grid.spacing, grid.shape)
    if settings.dt is not None and settings.dt > bound * (1 + 1e-9):
        raise RefusedError(
            f"dt: found {settings.dt:g} mm^2, over the stability bound of {bound:.6g} mm^2 on voxels of "
            f"{' x '.join(f'{h:.4g}' for h in grid.spacing)} mm; give at most that, or auto"
        )
    return DT_SHARE * bound if settings.dt is None else settings.dt


def _solve(
    psi: np.ndarray | None,
    data: np.ndarray,
    grid: Grid,
    settings: Settings,
    phases: Phases,
    observer: Observer | None = None,
    notify: Callable[[str], None] | None = None,
) -> Result:
    """Denoise arrays of shape grid.shape; data in that shape come back."""
    warnings = _Warnings(notify)
    _require_usable(grid, "the grid")
    numba.set_num_threads(min(settings.threads or _cpus(), numba.config.NUMBA_NUM_THREADS))
    dt = _schedule_dt(grid, settings)
    data = _finite_or_missing(data, warnings)
    plane = _PlaneLast(grid)
    with phases("band"):
        band = _band(psi, settings, plane, warnings)
        samples = band.gather(plane.forth(data))
    with phases("extend"):
        start = extend(band, samples, settings.extension)
        missing = np.isnan(start.values[band.primary]).mean()
        if missing > LONE_SHARE:
            warnings.add(f"{100 * missing:.1f} % of the band lies on parts of the surface without any data: left missing")
        u0 = np.where(np.isnan(start.values), 0, start.values)  # linked to nothing but one another
    flow = Flow(settings.flow, settings.phi_name, settings.scheme)
    slope = typical_slope(band, u0, start.known)
    with phases("flow"):
        schedule = _schedule(settings, dt, slope)
        every = settings.reextends_every
        evolution = evolve(
            u0, flow.stepper(band, u0.dtype), schedule, Reextension(band) if every else None, every, observer
        )
        values = np.where(np.isnan(start.values), np.nan, evolution.values)
    with phases("mesh"):
        mesh = None if settings.flat else surface_mesh(band, values)
    outside = {"nan": np.nan, "zero": 0.0, "keep": plane.forth(data)}[settings.outside]
    out = plane.back(band.scatter(values, outside))
    record = _record(settings, grid, band, schedule, evolution, slope, samples, values, start.known)
    return Result(out, mesh, record, tuple(warnings.lines))


def _band(psi: np.ndarray | None, settings: Settings, plane: _PlaneLast, warnings: _Warnings) -> Band:
    if psi is None:
        return flat_band(plane.grid)
    psi = _signed(plane.forth(psi), settings, warnings)
    return build_band(psi, plane.grid, settings.half_width(plane.grid.spacing[np.array(plane.grid.shape) > 1]))


def _signed(psi: np.ndarray, settings: Settings, warnings: _Warnings) -> np.ndarray:
    """Psi with its negative side inside; a binary mask is centred on 0."""
    finite = psi[np.isfinite(psi)]
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 0.0)
    if low < high and np.all((finite == low) | (finite == high)):
        warnings.add(
            f"the level set holds two values only ({low:g} and {high:g}): a mask, whose surface is a staircase of voxels, "
            "accurate to half a voxel; give a signed distance or another smooth function for an accurate one"
        )
        if low >= 0:  # a mask of something: what it marks is inside
            psi = (low + high) / 2 - psi
    return -psi if settings.inside == "positive" else psi


def _finite_or_missing(data: np.ndarray, warnings: _Warnings) -> np.ndarray:
    """Data whose infinite values are missing too; raises DataError where nothing is left."""
    infinite = np.isinf(data)
    if infinite.any():
        warnings.add(f"DATA has {int(infinite.sum())} infinite values: taken as missing")
        data = np.where(infinite, np.nan, data)
    if np.isnan(data).all():
        raise DataError("DATA has no valid value: found only NaN; expected finite values on the surface")
    return data


def _schedule(settings: Settings, dt: float, slope: float) -> Schedule:
    iterations, dt, ends_by = settings.duration(dt)
    if settings.flow == "l2":
        return Schedule(np.zeros(iterations), dt, ends_by)
    if settings.flow in ("l1", "tv"):
        eps = settings.eps if settings.eps is not None else EPS_SHARE * slope
        return Schedule(np.full(iterations, 1 / eps if eps else 0.0), dt, ends_by)
    if settings.beta.is_auto:
        return Schedule(np.full(iterations, 1 / slope if slope else 0.0), dt, ends_by)
    return Schedule(settings.beta.over(iterations), dt, ends_by)


class _PlaneLast:
    """Brings a plane's missing axis to the end, where the band expects it, and back."""

    def __init__(self, grid: Grid) -> None:
        single = [axis for axis in range(3) if grid.shape[axis] == 1]
        self.axis = single[0] if single else 2
        order = [a for a in range(3) if a != self.axis] + [self.axis]
        a, b, c = (grid.shape[k] for k in order)
        self.grid = Grid((a, b, c), grid.affine[:, [*order, 3]])

    def forth(self, array: np.ndarray) -> np.ndarray:
        return np.moveaxis(array, self.axis, 2)

    def back(self, array: np.ndarray) -> np.ndarray:
        return np.moveaxis(array, 2, self.axis)


class _Warnings:
    def __init__(self, notify: Callable[[str], None] | None) -> None:
        self.lines: list[str] = []
        self._notify = notify

    def add(self, line: str) -> None:
        self.lines.append(line)
        if self._notify:
            self._notify(line)


def _record(
    settings: Settings,
    grid: Grid,
    band: Band,
    schedule: Schedule,
    evolution: Evolution,
    slope: float,
    samples: np.ndarray,
    values: np.ndarray,
    known: np.ndarray,
) -> dict[str, Any]:
    """What was used and what happened, JSON-ready; lengths mm, dt mm^2, beta mm per data unit."""
    primary = band.primary
    near = primary[np.abs(band.distance[primary]) <= 0.5 * grid.spacing.max()]
    removed = (samples[near] - values[near]).astype(float)
    removed = removed[np.isfinite(removed)]
    used = {**asdict(settings), "beta": str(settings.beta), "band": band.half_width, "dt": schedule.dt}
    used["extend_every"] = settings.reextends_every
    used["threads"] = numba.get_num_threads()
    used["phi"] = settings.phi_name if settings.flow == "phi" else None
    return {
        "Parameters": used,
        "Grid": {"shape": list(grid.shape), "spacing_mm": grid.spacing.tolist(), "affine_ras_mm": grid.affine.tolist()},
        "Band": {
            "voxels": len(primary),
            "entries": band.entries,
            "half_width_mm": band.half_width,
            "surface_vertices": 0 if band.surface is None else len(band.surface.points),
            "filled_voxels": int((~known[primary] & ~np.isnan(values[primary])).sum()),
            "missing_voxels": int(np.isnan(values[primary]).sum()),
        },
        "Iterations": schedule.iterations,
        "StopReason": evolution.stop_reason,
        "TimeMm2": schedule.dt * schedule.iterations,
        "TypicalSlope": slope,
        "Removed": {
            "rms": float(np.sqrt(np.mean(removed**2))) if removed.size else None,
            "voxels": int(removed.size),
            "meaning": "input minus output at valid voxels within half a voxel of the surface",
        },
        "PerIteration": {
            "beta": schedule.beta.tolist(),
            "dt": [schedule.dt] * schedule.iterations,
            "dt_over_beta": [schedule.dt / beta if beta else None for beta in schedule.beta.tolist()],
            "change_rms": evolution.change.tolist(),
            "energy": evolution.energy.tolist(),
        },
    }


def _sidecar(job: Job, files: _Files, hashes: list[str], solved: Result, phases: Phases) -> dict[str, Any]:
    """The record of a run on files, with names as in BIDS derivatives."""
    return {
        "GeneratedBy": [{"Name": "beltrami_cli", "Version": __version__}],
        "Sources": [
            {"Path": os.fspath(path), "SHA256": digest} for path, digest in zip(job.inputs, hashes, strict=True)
        ],
        "Outputs": [file.name for file in files.all],
        "Created": datetime.now(UTC).isoformat(timespec="seconds"),
        **solved.record,
        "Files": {"resample": job.resample, "spacing": job.spacing},
        "Warnings": list(solved.warnings),
        "Seconds": {name: round(seconds, 3) for name, seconds in phases.seconds.items()},
        "PeakMemoryMiB": _peak_memory_mib(),
    }


def _settings(options: dict[str, Any]) -> Settings:
    try:
        return Settings(**{**options, "beta": parse_beta(options.get("beta", "auto"))})
    except TypeError as error:
        raise RefusedError(f"unknown option: {str(error).rsplit(' ', 1)[-1]}; see beltrami_cli.config.Settings") from None


def _as_float(array: np.ndarray, settings: Settings) -> np.ndarray:
    if array.dtype.kind not in "fiub":
        raise RefusedError(f"found values of type {array.dtype}; expected real numbers")
    return array.astype(settings.precision)


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _cpus() -> int:
    """CPUs that this process may use: a scheduler or container may grant fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _peak_memory_mib() -> float | None:
    """Largest resident set of this process so far; None where the system does not say (Windows)."""
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10), 1)
