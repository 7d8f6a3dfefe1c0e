"""How much memory a run will take at its peak, told from its files before it starts, and how much there is.

The constants were measured with benchmarks/memory.py, which tells how far estimates lie from what runs took.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

from beltrami_cli import formats
from beltrami_cli.config import Job
from beltrami_cli.errors import RefusedError
from beltrami_cli.grid import Grid
from beltrami_cli.levelset import crossing_box
from beltrami_cli.segmentation import Labels
from beltrami_cli.sources import is_segmentation, parse_between, parse_labels
from beltrami_cli.surface import Mesh
from beltrami_cli.survey import Scene, grid_of, is_plane, spacing_for, survey

# Bytes of a run on next to nothing: interpreter, libraries, compiled kernels. SimpleITK, for MetaImage, on top of it.
START, METAIMAGE = 200_000_000, 125_000_000
# Bytes per entry of the band and per vertex of its surface, for what places and links them: with the half-width only
# the entries grow.
ENTRY, VERTEX = 50, 280
# Numbers per entry and channel, for samples, start, states, fluxes and scratch of a flow: from 3 and 20 channels. As
# much again stays with the process after arrays are freed, up to a bound: the allocator gives only large ones back.
STATES, MOST_KEPT = 14, 180_000_000
# Numbers per voxel and channel while a volume is put together and written, the data still there: from 20 channels.
COPIES = 3
# Bytes for a picture of the run: its libraries and pages, per triangle that is drawn, up to so many, and per vertex of
# the surface while it is made coarser.
PICTURE, DRAWN, MOST_DRAWN, COARSER = 130_000_000, 1200, 60_000, 1000
# Bytes per voxel of the part of a level set that holds the surface, while that is found, and per voxel of the grid.
LEVELSET, VOXEL = 24, 4
# Bytes per voxel of a segmentation, where two boundaries make its surface, and per vertex of the staircase in it.
LABEL, BETWEEN, STAIR = 12, 46, 200
# Bytes per entry for the place on the mesh that its value at vertices comes from.
ON_FACES = 60
# Vertices of a surface in a volume, per face of a voxel of its area: 3/2 over all directions, 4/pi of a curve. A little
# less errs on the high side.
CROSSINGS, CROSSINGS_OF_CURVE = 1.4, 1.2
REFINED = 2.3  # vertices per face of a voxel of a mesh's area, once its edges are split to suit the voxels
SHEETS = 1.5  # entries per voxel where the band fills the volume: tight cortex has 1.45


@dataclass(frozen=True)
class _Surface:
    """area: mm^2 (mm times the slice of a plane). vertices: of its mesh. making: bytes while that is found.

    is_mesh: given as a mesh, or made one of a segmentation, before it meets the grid.
    """

    area: float
    vertices: int
    making: float
    is_mesh: bool


def needed(job: Job, scene: Scene | None = None) -> int:
    """Bytes of resident memory that `pipeline.run(job)` is estimated to take at its peak, in a process of its own.

    scene: what `survey` found, where that is known already. A level-set volume is read, to tell how large its surface
    is; the rest is told by headers and meshes. Kernels are taken as compiled: a first run, which compiles, may take
    0.27 GB more. Raises as `survey`, and DataError where LEVELSET cannot be read or has no zero level.
    """
    scene = survey(job) if scene is None else scene
    size, count = np.dtype(job.settings.precision).itemsize, _channels(job, scene)
    at_once = 1 if job.settings.independent else count
    surface = _surface(job, scene)
    places = sum(len(mesh.vertices_ras_mm) for mesh in scene.on) + surface.vertices
    in_band = 2 if job.settings.kind == "circular" else at_once
    entries = _entries(job, scene, surface)
    states = entries * STATES * size * in_band
    flow = entries * (ENTRY + (ON_FACES if scene.at_vertices else 0)) + states + min(states, MOST_KEPT)
    held, data, writing = _volumes(job, scene, size, count, at_once)
    picture = 0.0
    if job.report is not None:
        picture = PICTURE + DRAWN * min(2 * surface.vertices, MOST_DRAWN) + COARSER * surface.vertices
    peak = max(surface.making + data, data + flow, writing, data + picture)
    start = START + (METAIMAGE if any(_is_metaimage(path) for path in (job.volume, *job.all_inputs)) else 0)
    return int(start + held + places * (VERTEX + 2 * size * count) + peak)


def _volumes(job: Job, scene: Scene, size: int, count: int, at_once: int) -> tuple[float, float, float]:
    """Bytes of what is held throughout but the data; of the data; and of them and the result while it is written."""
    if scene.at_vertices:
        assert scene.surface is not None
        data = float(size * count * len(scene.surface.vertices_ras_mm))
        return 0.0, data, COPIES * data
    voxels = math.prod(scene.grid.shape)
    own_grid = grid_of(job, job.data, channels=job.settings.kind == "vector", plane=is_plane(job, scene.grid))
    others = [path for path in (job.weights, job.mask) if path is not None]
    held = voxels * (VOXEL + size * (len(others) + (job.levelset is not None and scene.surface is None)))
    data = float(voxels * size * at_once)
    if job.resample:  # the data as they came, twice: without what is missing
        held += 2 * math.prod(own_grid.shape) * size * at_once
    gathered = job.settings.independent and formats.volume_format(job.volume) in ("MGH", "MetaImage")
    if job.settings.independent:
        data *= COPIES  # a frame, its result and the copy that is written
    return float(held), data, COPIES * voxels * size * (count if gathered else at_once)


def _channels(job: Job, scene: Scene) -> int:
    """Real numbers at each voxel or vertex of the data."""
    if job.settings.kind != "vector":
        return 1
    if scene.at_vertices:
        assert scene.surface is not None
        values = formats.read_overlay(job.data, len(scene.surface.vertices_ras_mm), channels=True)
        return values.shape[1] if values.ndim == 2 else 1
    count, is_complex = formats.read_layout(job.data, plane=is_plane(job, scene.grid))
    return 2 * count if is_complex else count


def _entries(job: Job, scene: Scene, surface: _Surface) -> float:
    """Entries of the band."""
    grid, voxels = scene.grid, math.prod(scene.grid.shape)
    if job.levelset is None:
        return voxels
    width = 2 * job.settings.half_width(grid.used_spacing)
    return min(width * surface.area / float(np.prod(grid.spacing)), SHEETS * voxels)


def _surface(job: Job, scene: Scene) -> _Surface:
    """What is known of the surface before anything is computed on the grid of the scene."""
    if job.levelset is None:
        return _Surface(0.0, 0, 0.0, False)
    found = _in_volume(job, job.levelset) if scene.surface is None else _in_mesh(scene.surface, scene.grid)
    if not found.is_mesh:
        return found
    refined = REFINED * found.area / float(scene.grid.spacing.min()) ** 2
    return replace(found, vertices=max(found.vertices, int(refined)))


def _in_mesh(mesh: Mesh, grid: Grid) -> _Surface:
    """The part of a mesh that lies in the grid."""
    mesh.require_triangles()
    a, b, c = (mesh.vertices_ras_mm[mesh.cells[:, k]] for k in range(3))
    ijk = grid.to_index((a + b + c) / 3)
    inside = np.all((ijk >= 0) & (ijk <= np.array(grid.shape) - 1), axis=1)
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)[inside].sum() / 2
    return _Surface(float(area), len(mesh.vertices_ras_mm), 0.0, True)


def _in_volume(job: Job, path: Path) -> _Surface:
    """The surface of a level set or a segmentation."""
    found = path.stat()
    which = (found.st_mtime_ns, found.st_size)
    return _of_volume(path, which, spacing_for(path, job.spacing), job.labels, job.between)


@cache  # the jobs of a study often share a surface
def _of_volume(
    path: Path, which: tuple[int, int], spacing: tuple[float, ...] | None, labels: str | None, between: str | None
) -> _Surface:
    """The surface from the faces between voxels of different sides. which: tells a file from what replaces it."""
    series = formats.open_series(path, spacing=spacing)
    data, steps = series.frame(0), series.grid.spacing
    labelled = bool(labels or between) or (1 not in data.shape and is_segmentation(data))
    sides = _sides(labels, between, data) if labelled else [data < 0]
    known = np.isfinite(data)
    faces = np.array([[_crossings(side, known, axis) for axis in range(3)] for side in sides])
    areas = faces * (np.prod(steps) / steps)
    share = CROSSINGS_OF_CURVE if 1 in data.shape else CROSSINGS
    area = np.maximum(areas.sum(1) / share, areas.max(1)).mean()
    if labelled:
        making = (LABEL if len(sides) == 1 else BETWEEN) * data.size + STAIR * faces.sum()
    else:
        making = LEVELSET * data[crossing_box(data, (1, 1, 1))].size
    return _Surface(float(area), int(faces.sum(1).max()), float(making), labelled)


def _sides(labels: str | None, between: str | None, data: np.ndarray) -> list[np.ndarray]:
    """Masks of the voxels whose boundaries make the surface of a segmentation."""
    if between is not None:
        return [_marked(data, side) for side in parse_between(between)]
    if labels is not None:
        return [_marked(data, parse_labels(labels))]
    return [data == np.nanmax(data)]


def _marked(data: np.ndarray, labels: Labels) -> np.ndarray:
    return np.logical_or.reduce([(data >= first) & (data <= last) for first, last in labels])


def _crossings(side: np.ndarray, known: np.ndarray, axis: int) -> int:
    """How many voxels have a neighbour along the axis that is on the other side, both of them known."""
    side, known = np.moveaxis(side, axis, 0), np.moveaxis(known, axis, 0)
    return int(np.count_nonzero((side[1:] != side[:-1]) & known[1:] & known[:-1]))


def _is_metaimage(path: Path) -> bool:
    return path.suffix.lower() in (".mha", ".mhd")


def require_within(size: int, limit: int) -> None:
    """Raise RefusedError where a run that needs so many bytes is over a limit."""
    if size > limit:
        raise RefusedError(
            f"memory: needs about {told(size)}; found a limit of {told(limit)}: give more (--memory), or crop the "
            "volumes to the surface"
        )


def available(root: Path = Path("/")) -> int:
    """Bytes that this process may still take.

    The least of what the system has to give, what every control group that the process is in leaves of its limit (as
    SLURM and containers set them), and what is left of its address space (`ulimit -v`). root: where the system's
    `proc` and `sys/fs/cgroup` are.
    """
    import psutil

    left = [psutil.virtual_memory().available, *_left_by_groups(root), *_left_of_address_space()]
    return max(0, int(min(left)))


def told(size: int) -> str:
    """Bytes as people read them, in powers of 1000 and two digits or more: 950 B, 1.2 GB, 34 MB."""
    if size < 1000:
        return f"{size} B"
    value, units = float(size), iter(("kB", "MB", "GB", "TB"))
    unit = "B"
    while value >= 999.5 and (larger := next(units, None)):
        value, unit = value / 1000, larger
    return f"{value:.1f} {unit}" if value < 9.95 else f"{value:.0f} {unit}"


def _left_by_groups(root: Path) -> list[int]:
    """What each control group that holds this process, and each group around it, leaves of its limit, where it has one.

    Of what a group uses, pages of files that the system would drop first are free to be taken.
    """
    try:
        lines = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return []  # no Linux
    left: list[int] = []
    for line in lines:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            top, names = root / "sys/fs/cgroup", ("memory.max", "memory.current", "inactive_file")
        elif "memory" in controllers.split(","):
            top = root / "sys/fs/cgroup/memory"
            names = ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        else:
            continue
        # In a container the path may be the host's: then only its end, the top, is there.
        group = top / path.lstrip("/")
        for folder in (group, *group.parents):
            left += _left_by(folder, *names)
            if folder == top:
                break
    return left


def _left_by(group: Path, limit: str, usage: str, droppable: str) -> list[int]:
    """What one group leaves of its limit: one number, or none where it has no limit."""
    try:
        most = (group / limit).read_text().strip()
        used = int((group / usage).read_text())
        stat = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
        return [] if most == "max" else [int(most) - used + int(stat.get(droppable, 0))]
    except (OSError, ValueError):
        return []


def _left_of_address_space() -> list[int]:
    """What a limit on the address space leaves: one number, or none where there is no limit."""
    import psutil

    try:
        import resource
    except ImportError:  # Windows
        return []
    most = resource.getrlimit(resource.RLIMIT_AS)[0]
    return [] if most == resource.RLIM_INFINITY else [most - psutil.Process().memory_info().vms]
