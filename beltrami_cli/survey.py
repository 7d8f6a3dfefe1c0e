"""What a job on files is about: inputs that belong together, outputs that can be written, the grid to compute on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli import formats, report
from beltrami_cli.config import Job
from beltrami_cli.errors import RefusedError
from beltrami_cli.grid import Grid, Volume, require_same_grid
from beltrami_cli.inputs import Warnings, grid_around, require_sense_on_mesh, require_usable, time_step
from beltrami_cli.record import sidecar_of
from beltrami_cli.sources import is_segmentation
from beltrami_cli.surface import Mesh

REMEDY = "--resample brings it onto the level set's grid"


@dataclass(frozen=True, eq=False)
class Scene:
    """What a job is about, before its volumes are read.

    grid: to compute on. surface: LEVELSET, where it is a mesh. at_vertices: DATA are values at its vertices.
    on: the meshes that values are to be put on. structure: of what is written, where the job says it. header: of
    LEVELSET, where OUT is to be brought onto its grid.
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


def survey(job: Job) -> Scene:
    """What the job is about, from headers and surfaces; raises RefusedError where files will not do."""
    for path in job.all_inputs:
        formats.require_file(path)
    if job.report is not None:
        report.require(job.report)
    structure = None if job.structure is None else formats.parse_structure(job.structure)
    surface, at_vertices = None, False
    if formats.is_surface(job.data):
        raise RefusedError(f"DATA {job.data}: is a surface; expected data on one: are LEVELSET and DATA swapped?")
    if job.levelset is not None and formats.is_surface(job.levelset):
        at_vertices = formats.is_overlay(job.data)
        like = None if at_vertices else grid_of(job, job.data, channels=job.settings.kind == "vector")
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
    header = None
    if job.resample and surface is None and job.levelset is not None:
        header = formats.open_series(job.levelset, spacing=spacing_for(job.levelset, job.spacing)).header
    return Scene(grid, surface, at_vertices, on, structure, header)


class Files:
    """Every file that a job writes, the sidecar last."""

    def __init__(self, job: Job, scene: Scene) -> None:
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
        pictures = [] if job.report is None else [job.report]
        self.all = [*files_of(job.volume), *filled, *written, *on, *pictures, self.sidecar]

    def held_by(self, path: Path, mesh: Mesh) -> Mesh:
        """The mesh as its file is to hold it."""
        return replace(mesh, values=None) if path in self.bare else mesh


def _values_are(out: Path, mesh: Path) -> bool:
    """True where `out` is the file that a mesh's values are written to."""
    return out in formats.mesh_files(mesh)


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
            plane = channels and is_plane(job, grids["LEVELSET"][1] if "LEVELSET" in grids else None)
            grids[name] = path, grid_of(job, path, channels=channels, plane=plane)
    first, (where, grid) = next(iter(grids.items()))
    for name, (path, other) in grids.items():
        if not job.resample:
            require_same_grid(grid, f"{first} {where}", other, f"{name} {path}", remedy=REMEDY)
    require_usable(grid, str(where))
    layout = formats.read_layout(job.data, plane=is_plane(job, grid)) if several else (1, False)
    formats.require_writable(job.volume, grid, channels=layout[0], is_complex=layout[1])
    for _, file in job.on:
        formats.require_overlay_writable(file, layout[0])
    if job.filled is not None:
        formats.require_writable(job.filled, grid)
    return grid


def _has_a_grid_of_its_own(job: Job, several: bool) -> bool:
    """True for a segmentation on another grid than DATA, where neither is to be brought onto the other's."""
    if job.levelset is None:
        return False
    own = grid_of(job, job.levelset)
    labelled = bool(job.labels or job.between)
    if 1 in own.shape:
        if labelled:
            raise RefusedError(f"labels, between: are for volumes; found LEVELSET {job.levelset}, a plane; give a mask")
        return False
    if labelled or job.resample:
        return not job.resample
    data = grid_of(job, job.data, channels=several)
    return not own.matches(data) and is_segmentation(read(job, job.levelset, Warnings(None)).data)


def grid_of(job: Job, path: Path, *, channels: bool = False, plane: bool = False) -> Grid:
    return formats.read_grid(path, spacing=spacing_for(path, job.spacing), channels=channels, plane=plane)


def is_plane(job: Job, grid: Grid | None) -> bool:
    """True where DATA of three axes are a plane of channels: its level set, on `grid`, is one, or it is a picture."""
    return job.levelset is None or (grid is not None and 1 in grid.shape)


def spacing_for(path: Path, spacing: tuple[float, ...] | None) -> tuple[float, ...] | None:
    return spacing if formats.is_npy(path) else None


def read(job: Job, path: Path, warnings: Warnings, *, channels: bool = False, plane: bool = False) -> Volume:
    steps = spacing_for(path, job.spacing)
    volume = formats.read_volume(path, spacing=steps, dtype=job.settings.precision, channels=channels, plane=plane)
    pass_on(volume, warnings)
    return volume


def pass_on(source: Volume | formats.Series, warnings: Warnings) -> None:
    """What a reader had to say of its file."""
    for line in source.notes:
        if line not in warnings.lines:
            warnings.add(line)
