"""From files to files: check, read, denoise, write everything or nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli import formats, kernels
from beltrami_cli.config import Job, Settings
from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.evolve import Observer
from beltrami_cli.extension import own_samples
from beltrami_cli.grid import Canonical, Grid, Volume, require_same_grid, with_channels
from beltrami_cli.inputs import (
    Warnings,
    band_of,
    grid_around,
    require_sense_on_mesh,
    require_usable,
    time_step,
    without,
)
from beltrami_cli.kinds import kind_of
from beltrami_cli.levelset import two_values
from beltrami_cli.progress import Phases
from beltrami_cli.record import sha256, sidecar, sidecar_of, write_record
from beltrami_cli.resample import resample
from beltrami_cli.sampling import surface_mesh
from beltrami_cli.solver import Gathered, Result, Solver
from beltrami_cli.sources import is_segmentation, read_source
from beltrami_cli.surface import Mesh

REMEDY = "--resample brings it onto the level set's grid"


def run(job: Job, *, observer: Observer | None = None, notify: Callable[[str], None] | None = None) -> Result:
    """Denoise files: read, check, denoise, write OUT, mesh and sidecar. Nothing is written unless everything is.

    notify: called with each warning as soon as it is known. Raises as `denoise`, and RefusedError, from
    the headers alone, where an output exists or cannot be written, or the grids differ. Frames of volumes that run
    independently stream through memory one at a time; the result then holds no data.
    """
    phases, warnings = Phases(), Warnings(notify)
    with phases("read"):
        scene = _survey(job)
    files = _Files(job, scene)
    sources = [file for path in job.all_inputs for file in formats.input_files(path)]
    with formats.Stage(files.all, overwrite=job.overwrite, inputs=sources) as stage:
        with phases("numba"):
            kernels.wake()
        with ThreadPoolExecutor(1) as pool:
            digests = pool.submit(lambda: [sha256(path) for path in sources])
            if scene.at_vertices:
                work = _denoise_vertices
            else:
                work = _denoise_series if job.settings.independent else _denoise_volume
            solved = work(job, scene, stage, phases, warnings, observer)
            hashes = digests.result()
        with phases("write"):
            for path in files.meshes:
                assert solved.mesh is not None
                shown = replace(solved.mesh, structure=scene.structure_of(solved.mesh))
                formats.write_mesh(stage.path(path), files.held_by(path, shown))
            for (_, path), mesh, values in zip(job.on, scene.on, solved.on, strict=True):
                formats.write_overlay(stage.path(path), values, structure=scene.structure_of(mesh))
        record = sidecar(job, sources, files.all, hashes, solved.record, tuple(warnings.lines), phases.seconds)
        write_record(stage.path(files.sidecar), record)
        stage.commit()
    return replace(solved, record=record, warnings=tuple(warnings.lines))


@dataclass(frozen=True, eq=False)
class _Scene:
    """What a job is about, before any volume is read.

    grid: to compute on. surface: LEVELSET, where it is a mesh. at_vertices: DATA are values at its vertices.
    on: the meshes that values are to be put on. structure: of what is written, where the job says it. header: of the
    volume whose grid that is, for OUT.
    """

    grid: Grid
    surface: Mesh | None
    at_vertices: bool
    on: tuple[Mesh, ...]
    structure: str | None
    header: Any = None

    @property
    def place(self) -> Volume:
        """A volume without values on the grid."""
        return Volume(np.broadcast_to(np.False_, self.grid.shape), self.grid, (), self.header)

    def structure_of(self, mesh: Mesh) -> str | None:
        return self.structure or mesh.structure


def _denoise_volume(
    job: Job, scene: _Scene, stage: formats.Stage, phases: Phases, warnings: Warnings, observer: Observer | None
) -> Result:
    """The result, its volumes written."""
    with phases("read"):
        source, trust = _read_levelset(job, scene, warnings), _read_trust(job, warnings)
        psi = source if isinstance(source, Volume) else None
        plane = _is_plane(job, scene.grid)
        data = _read(job, job.data, warnings, channels=job.settings.kind == "vector", plane=plane)
        place = psi or scene.place
        data = _onto(_that_counts(data, trust, job), place, job, f"DATA {job.data}", period=job.settings.period)
        if psi is not None and formats.volume_format(job.volume) != formats.volume_format(job.data):
            data = replace(data, header=psi.header)
    solver = _solver(job, scene, source, trust, psi or data, phases, warnings)
    solved = solver.denoise(data.data, observer)
    with phases("write"):
        formats.write_volume(stage.path(job.volume), data.with_data(solved.data), dtype=job.settings.precision)
        if job.filled is not None:
            formats.write_volume(stage.path(job.filled), data.with_data(solved.filled), dtype=np.uint8)
    return solved


def _denoise_series(
    job: Job, scene: _Scene, stage: formats.Stage, phases: Phases, warnings: Warnings, observer: Observer | None
) -> Result:
    """As `_denoise_volume`, frame by frame."""
    with phases("read"):
        source, trust = _read_levelset(job, scene, warnings), _read_trust(job, warnings)
        psi = source if isinstance(source, Volume) else None
        series = formats.open_series(
            job.data,
            spacing=_spacing_for(job.data, job.spacing),
            dtype=job.settings.precision,
            plane=_is_plane(job, scene.grid),
        )
        _pass_on(series, warnings)
    place = psi or scene.place
    like = replace(series, grid=place.grid)
    solver = _solver(job, scene, source, trust, place, phases, warnings)

    def frame(t: int) -> np.ndarray:
        with phases("read"):
            data = _that_counts(Volume(series.frame(t), series.grid), trust, job)
            return _onto(data, place, job, f"DATA {job.data}").data

    record: dict[str, Any] = {}
    gathered = Gathered()

    def denoised() -> Iterator[np.ndarray]:
        for result in solver.denoise_frames(series.count, frame, record, observer):
            gathered.add(result)
            yield result.data

    formats.write_series(stage.path(job.volume), like, denoised(), dtype=job.settings.precision)
    solved = gathered.result(np.empty(0), record)
    if job.filled is not None:
        as_stored = with_channels(series.file_shape, series.count, 1) if like.grid.shape == series.grid.shape else ()
        filled = Volume(solved.filled, like.grid, as_stored, like.header)
        formats.write_volume(stage.path(job.filled), filled, dtype=np.uint8)
    return solved


def _denoise_vertices(
    job: Job, scene: _Scene, stage: formats.Stage, phases: Phases, warnings: Warnings, observer: Observer | None
) -> Result:
    """The result, its values at vertices written."""
    assert scene.surface is not None
    count, dtype, several = len(scene.surface.vertices_ras_mm), job.settings.precision, job.settings.kind == "vector"
    with phases("read"):
        data = formats.read_overlay(job.data, count, dtype=dtype, channels=several, map=_map(job.map))
        if several and data.ndim == 1:
            data = data[:, None]
        weights, mask = (
            None if path is None else formats.read_overlay(path, count, dtype=dtype) for path in (job.weights, job.mask)
        )
    solver = Solver(
        scene.surface, scene.grid, job.settings, phases, warnings, weights, mask, at_vertices=True, on=scene.on
    )
    work = solver.denoise_series if job.settings.independent else solver.denoise
    solved = work(data, observer)
    with phases("write"):
        structure = scene.structure_of(scene.surface)
        names = formats.map_names(job.data, channels=several, map=_map(job.map))
        formats.write_overlay(stage.path(job.volume), solved.data, structure=structure, dtype=dtype, names=names)
        if job.filled is not None:
            formats.write_overlay(stage.path(job.filled), solved.filled.astype(np.float32), structure=structure)
    return solved


def _map(given: str | None) -> str | int | None:
    return int(given) if given is not None and given.isdecimal() else given


def _solver(
    job: Job,
    scene: _Scene,
    source: Volume | Mesh | None,
    trust: dict[str, Volume],
    place: Volume,
    phases: Phases,
    warnings: Warnings,
) -> Solver:
    """The solver on the grid of `place`, onto which weights and mask are brought."""
    with phases("read"):
        here = {name: _onto(volume, place, job, name).data for name, volume in trust.items()}
        weights, mask = here.get("weights"), here.get("mask")
    if mask is not None:
        mask = np.nan_to_num(mask) >= 0.5  # between voxels, where it was moved
    surface = source.data if isinstance(source, Volume) else source
    return Solver(surface, place.grid, job.settings, phases, warnings, weights, mask, on=scene.on)


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
    if is_segmentation(psi.data) and two_values(psi.data) is None:
        raise RefusedError(
            f"{levelset}: holds labels, no level set; expected one, or a mask: make it with beltrami levelset --labels"
        )
    axes = Canonical(psi.grid)
    band = band_of(psi.data, Settings(inside=inside), axes, Warnings(None))
    if data is None:
        return surface_mesh(band)[0]
    flat = 1 in psi.grid.shape
    several = period is None
    volume = formats.read_volume(data, spacing=_spacing_for(data, spacing), channels=several, plane=several and flat)
    if bring:
        volume = resample(volume, psi.grid, period=period)
    require_same_grid(psi.grid, f"LEVELSET {levelset}", volume.grid, f"DATA {data}", remedy=REMEDY)
    here = band.gather(axes.forth(volume.data))
    kind = kind_of("circular" if period else "vector", here, period)[0]
    own = own_samples(band, kind.to_channels(here))
    mesh, values = surface_mesh(band, own, turns=kind.turns)
    assert values is not None
    if not np.isfinite(values).any():
        raise DataError(f"DATA {data} has no value on the surface: found only NaN there; drop it for a bare mesh")
    return replace(mesh, values=kind.at_vertices(values))


class _Files:
    """Every file that a job writes, the sidecar last."""

    def __init__(self, job: Job, scene: _Scene) -> None:
        curve = 1 in scene.grid.shape
        meshes = job.mesh
        if meshes is None:
            beside = formats.mesh_beside(job.volume, curve=curve)
            meshes = () if job.settings.flat else (beside,)
        self.meshes = meshes
        # OUT holds the values of a .surf.gii beside it already.
        self.bare = {
            mesh for mesh in meshes if scene.at_vertices and (job.mesh is None or _values_are(job.volume, mesh))
        }
        written = [
            file for mesh in meshes for file in formats.mesh_files(mesh, values=mesh not in self.bare, curve=curve)
        ]
        files_of = formats.overlay_files if scene.at_vertices else formats.volume_files
        filled = [] if job.filled is None else files_of(job.filled)
        on = [file for _, path in job.on for file in formats.overlay_files(path)]
        for file in on:
            if file in written:
                raise RefusedError(
                    f"on: {file} is also where the values of the mesh beside OUT go; give another name, or --no-mesh"
                )
        self.sidecar = sidecar_of(job.volume)
        self.all = [*files_of(job.volume), *filled, *written, *on, self.sidecar]

    def held_by(self, path: Path, mesh: Mesh) -> Mesh:
        """The mesh as its file is to hold it."""
        return replace(mesh, values=None) if path in self.bare else mesh


def _values_are(out: Path, mesh: Path) -> bool:
    """True where `out` is the file that a mesh's values are written to."""
    return out in formats.mesh_files(mesh)


def _survey(job: Job) -> _Scene:
    """What the job is about, from headers and surfaces; raises RefusedError where files will not do."""
    for path in job.all_inputs:
        formats.require_file(path)
    structure = None if job.structure is None else formats.parse_structure(job.structure)
    surface, at_vertices = None, False
    if formats.is_surface(job.data):
        raise RefusedError(f"DATA {job.data}: is a surface; expected data on one: are LEVELSET and DATA swapped?")
    if job.levelset is not None and formats.is_surface(job.levelset):
        at_vertices = formats.is_overlay(job.data)
        like = None if at_vertices else _grid_of(job, job.data, channels=job.settings.kind == "vector")
        surface = formats.read_surface(job.levelset, frame=job.frame, like=like)
        _require_sense(job, at_vertices)
    elif formats.is_overlay(job.data):
        found = "no surface (flat)" if job.levelset is None else f"LEVELSET {job.levelset}, which is none"
        raise RefusedError(
            f"DATA {job.data}: values at the vertices of a surface; found {found}: give the surface as LEVELSET, or "
            "DATA as a volume"
        )
    if job.map is not None and not at_vertices:
        raise RefusedError(f"map: is for values at vertices; found DATA {job.data}, a volume; drop --map")
    if job.frame is not None and surface is None and not job.on:
        raise RefusedError("frame: is for surfaces; found none among LEVELSET and --on; drop --frame")
    if at_vertices:
        assert surface is not None
        spacing = None if job.spacing is None else job.spacing[0]
        grid = grid_around(surface, job.settings, spacing)
        if structure is None:
            _require_one_hemisphere(job, surface.structure)
    else:
        if job.volume.name.lower().endswith((".func.gii", ".shape.gii")):
            raise RefusedError(
                f"{job.volume}: holds values at vertices; found DATA {job.data}, a volume; give OUT as a volume, and "
                "the values at a surface's vertices with --on SURFACE=FILE"
            )
        grid = _check_grids(job, surface)
    job.settings.duration(time_step(grid, job.settings))
    if not job.settings.flat:
        job.settings.half_width(grid.used_spacing)
    like = None if at_vertices else grid
    on = tuple(formats.read_surface(path, frame=job.frame, like=like, frame_where_unsaid=True) for path, _ in job.on)
    _require_room(job, at_vertices)
    header = None
    if job.resample and surface is None and job.levelset is not None:
        header = formats.open_series(job.levelset, spacing=_spacing_for(job.levelset, job.spacing)).header
    return _Scene(grid, surface, at_vertices, on, structure, header)


def _require_sense(job: Job, at_vertices: bool) -> None:
    """Raise RefusedError for what a surface as LEVELSET, or data at its vertices, leave no room for."""
    require_sense_on_mesh(job.settings, at_vertices)
    if job.labels or job.between:
        raise RefusedError(f"labels, between: are for a segmentation; found {job.levelset}, a surface; drop them")
    if at_vertices and job.resample:
        raise RefusedError("resample: is for volumes; found data at the vertices of a surface; drop it")
    if at_vertices and job.spacing is not None and len(job.spacing) > 1:
        raise RefusedError(f"spacing: found {job.spacing}; expected one number: the band around a surface has cubes")


def _require_one_hemisphere(job: Job, structure: str | None) -> None:
    """Raise RefusedError where values at vertices are of another part of the brain than the surface."""
    for path in (job.data, job.weights, job.mask):
        found = None if path is None else formats.overlay_structure(path)
        if found and structure and found != structure:
            raise RefusedError(
                f"{path}: is of {found}; found LEVELSET {job.levelset} of {structure}: give both of one, or --structure"
            )


def _require_room(job: Job, at_vertices: bool) -> None:
    """Raise RefusedError where files of values at vertices cannot hold as many channels as DATA has."""
    channels = 1
    if job.settings.kind == "vector":
        channels = len(formats.read_maps(job.data)) if at_vertices else formats.read_layout(job.data)[0]
    for path in ([job.volume] if at_vertices else []) + [file for _, file in job.on]:
        formats.require_overlay_writable(path, channels)
    if at_vertices and job.filled is not None:
        formats.require_overlay_writable(job.filled, 1)


def _check_grids(job: Job, surface: Mesh | None) -> Grid:
    """The grid to compute on, from headers alone; raises RefusedError where it or the outputs' formats will not do."""
    if job.spacing is not None and not any(formats.is_npy(path) for path in job.all_inputs):
        raise RefusedError("spacing: is for .npy inputs only; found none among LEVELSET and DATA; drop --spacing")
    several = job.settings.kind == "vector"
    grids: dict[str, tuple[Path, Grid]] = {}
    on_its_grid = surface is None and not _has_a_grid_of_its_own(job, several)
    levelset = job.levelset if on_its_grid else None
    for name, path in zip(
        ("LEVELSET", "DATA", "weights", "mask"), (levelset, job.data, job.weights, job.mask), strict=True
    ):
        if path is not None:
            channels = several and name == "DATA"
            plane = channels and _is_plane(job, grids["LEVELSET"][1] if "LEVELSET" in grids else None)
            grids[name] = path, _grid_of(job, path, channels=channels, plane=plane)
    first, (where, grid) = next(iter(grids.items()))
    for name, (path, other) in grids.items():
        if not job.resample:
            require_same_grid(grid, f"{first} {where}", other, f"{name} {path}", remedy=REMEDY)
    require_usable(grid, str(where))
    layout = formats.read_layout(job.data, plane=_is_plane(job, grid)) if several else (1, False)
    formats.require_writable(job.volume, grid, channels=layout[0], is_complex=layout[1])
    if job.filled is not None:
        formats.require_writable(job.filled, grid)
    return grid


def _has_a_grid_of_its_own(job: Job, several: bool) -> bool:
    """True for a segmentation on another grid than DATA, where neither is to be brought onto the other's."""
    if job.levelset is None:
        return False
    own = _grid_of(job, job.levelset)
    labelled = bool(job.labels or job.between)
    if 1 in own.shape:
        if labelled:
            raise RefusedError(f"labels, between: are for volumes; found LEVELSET {job.levelset}, a plane; give a mask")
        return False
    if labelled or job.resample:
        return not job.resample
    data = _grid_of(job, job.data, channels=several)
    return not own.matches(data) and is_segmentation(_read(job, job.levelset, Warnings(None)).data)


def _grid_of(job: Job, path: Path, *, channels: bool = False, plane: bool = False) -> Grid:
    return formats.read_grid(path, spacing=_spacing_for(path, job.spacing), channels=channels, plane=plane)


def _is_plane(job: Job, grid: Grid | None) -> bool:
    """True where DATA of three axes are a plane of channels: its level set, on `grid`, is one, or it is a picture."""
    return job.levelset is None or (grid is not None and 1 in grid.shape)


def _spacing_for(path: Path, spacing: tuple[float, ...] | None) -> tuple[float, ...] | None:
    return spacing if formats.is_npy(path) else None


def _read(job: Job, path: Path, warnings: Warnings, *, channels: bool = False, plane: bool = False) -> Volume:
    steps = _spacing_for(path, job.spacing)
    volume = formats.read_volume(path, spacing=steps, dtype=job.settings.precision, channels=channels, plane=plane)
    _pass_on(volume, warnings)
    return volume


def _pass_on(source: Volume | formats.Series, warnings: Warnings) -> None:
    """What a reader had to say of its file."""
    for line in source.notes:
        if line not in warnings.lines:
            warnings.add(line)


def _read_levelset(job: Job, scene: _Scene, warnings: Warnings) -> Volume | Mesh | None:
    if job.levelset is None or scene.surface is not None:
        return scene.surface
    if 1 in scene.grid.shape:
        return _read(job, job.levelset, warnings)
    source = read_source(
        job.levelset,
        labels=job.labels,
        between=job.between,
        spacing=_spacing_for(job.levelset, job.spacing),
        dtype=job.settings.precision,
        notify=warnings.add,
    )
    if isinstance(source, Volume):
        _pass_on(source, warnings)
    elif job.settings.inside == "positive":
        volume = _read(job, job.levelset, warnings)
        mask = two_values(volume.data)
        if mask is None or mask[0] >= 0 or not volume.grid.matches(scene.grid):
            raise RefusedError(f"inside: is for a level set; found LEVELSET {job.levelset}, a segmentation; drop it")
        return volume
    return source


def _read_trust(job: Job, warnings: Warnings) -> dict[str, Volume]:
    """What says how much data count: "weights" as they are, "mask" as 1 where it is not 0; those there are."""
    trust = {}
    if job.weights is not None:
        trust["weights"] = _read(job, job.weights, warnings)
    if job.mask is not None:
        mask = _read(job, job.mask, warnings)
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


def _onto(volume: Volume, place: Volume | None, job: Job, name: str, *, period: float | None = None) -> Volume:
    """The volume on the grid of another; missing values are not mixed with others on the way."""
    if place is None or not job.resample or volume.grid.matches(place.grid):
        return volume
    moved = resample(volume, place.grid, period=period)
    if not np.isfinite(moved.data).any():
        raise DataError(
            f"{name}: has no value on the grid of {job.levelset}: found no overlap in world space, "
            "expected volumes of one head in one space"
        )
    if moved.channels > 1:  # what the header says of frames goes with them
        return Volume(moved.data, place.grid, (), volume.header)
    return Volume(moved.data, place.grid, place.file_shape, place.header)
