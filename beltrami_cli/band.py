"""The narrow band: compact unknowns near the surface, one sheet per bank."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from beltrami_cli.errors import DataError
from beltrami_cli.grid import Grid, extent
from beltrami_cli.kernels import sheets
from beltrami_cli.levelset import ZeroSurface, crossing_box, zero_surface


@dataclass(frozen=True, eq=False)
class Band:
    """Entries (voxel, sheet): one per voxel where the surface is alone, one per bank in a thin sulcus or gyral blade.

    grid: the whole volume's grid; box: the part of it that the band lies in.
    surface: the mesh in mm along the voxel axes, from the first voxel of the box; None for a flat band.
    voxel: (E,) int32, flat index in the box; entries are in its order, nearest sheet first.
    first: (X + 1,) int32, entries of the box's voxel x are first[x] .. first[x + 1] - 1; the first one is primary.
    vertex: (E,) int32, the surface's vertex that the entry belongs to.
    normal: (3, E) float32, unit, along the voxel axes, at the closest point. distance: (E,) float32, signed, mm.
    forward, backward: (3, E) uint32, linked entries one voxel on along each axis; the entry itself where there is none.
    """

    grid: Grid
    box: tuple[slice, ...]
    half_width: float
    surface: ZeroSurface | None
    voxel: np.ndarray
    first: np.ndarray
    vertex: np.ndarray
    normal: np.ndarray
    distance: np.ndarray
    forward: np.ndarray
    backward: np.ndarray

    @property
    def entries(self) -> int:
        return len(self.voxel)

    @property
    def box_shape(self) -> tuple[int, ...]:
        return tuple(s.stop - s.start for s in self.box)

    @cached_property
    def primary(self) -> np.ndarray:
        """(B,) int64: the entry of each band voxel's nearest sheet; what a volume shows."""
        starts = self.first[:-1]
        return starts[starts < self.first[1:]].astype(np.int64)

    @property
    def finest(self) -> float:
        """The smallest voxel edge, mm, of the axes that have more than one voxel."""
        return float(self.grid.used_spacing.min())

    @property
    def nodes(self) -> tuple[int, int, int]:
        """Stencil nodes along each axis: 4 for the cubic, 1 along the missing axis of a plane."""
        a, b, c = (4 if n > 1 else 1 for n in self.grid.shape)
        return a, b, c

    def gather(self, volume: np.ndarray) -> np.ndarray:
        """Values (E, ...) of a volume (nx, ny, nz, ...) at every entry's voxel, shared by its sheets."""
        box = np.ascontiguousarray(volume[self.box])
        return box.reshape(-1, *box.shape[3:])[self.voxel]

    def scatter(self, values: np.ndarray, outside: np.ndarray | complex) -> np.ndarray:
        """A volume (nx, ny, nz, ...): primary entries' values (E, ...) in the band, `outside` elsewhere."""
        out = np.empty(self.grid.shape + values.shape[1:], values.dtype)
        out[...] = outside
        box = np.ascontiguousarray(out[self.box])
        box.reshape(-1, *values.shape[1:])[self.voxel[self.primary]] = values[self.primary]
        out[self.box] = box
        return out

    @cached_property
    def closest_offset(self) -> np.ndarray:
        """(3, E) float32: from each entry's voxel to its closest surface point, in voxels."""
        spacing = self.grid.spacing.astype(np.float32)
        return -self.distance * self.normal / spacing[:, None]


def build_band(psi: np.ndarray, grid: Grid, half_width: float) -> Band:
    """The band of `half_width` mm around the zero level of psi (nx, ny, nz), any function with that zero set.

    Raises DataError where psi has no zero level.
    """
    box = crossing_box(psi, _margin(grid, half_width))
    return _around(zero_surface(psi[box], grid.spacing), grid, box, half_width)


def band_around(surface: ZeroSurface, grid: Grid, half_width: float) -> Band:
    """The band of `half_width` mm around a mesh, its points in mm along the voxel axes from the grid's first voxel.

    Banks stay apart however near they lie, for what is connected to what is the mesh's own word; where an open surface
    ends, the band does. Raises DataError where the grid holds none of the surface.
    """
    ijk = surface.points / grid.spacing
    inside = np.all((ijk >= 0) & (ijk <= np.array(grid.shape) - 1), axis=1)
    if not inside.any():
        raise DataError(
            f"the surface lies outside of the volume: vertices lie within {extent(grid.to_world(ijk))}, voxels in "
            f"{extent(grid.corners())} (RAS); expected one space (--frame says which the surface is in)"
        )
    margin, held = _margin(grid, half_width), ijk[inside]
    if np.ptp(held, axis=0).max() < 1:
        raise DataError(
            f"the surface measures {np.ptp(surface.points, axis=0).max():.4g} mm in the volume, less than a voxel of "
            f"{grid.spacing.max():.4g} mm; expected many voxels: is it in metres?"
        )
    box = tuple(
        slice(max(0, int(a) - m), min(n, int(np.ceil(b)) + 1 + m))
        for a, b, m, n in zip(held.min(0), held.max(0), margin, grid.shape, strict=True)
    )
    low = np.array([part.start for part in box]) * grid.spacing
    return _around(replace(surface, points=surface.points - low), grid, box, half_width)


def _margin(grid: Grid, half_width: float) -> tuple[int, ...]:
    """Voxels by which the band may reach beyond the surface's own, per axis."""
    return tuple(
        int(np.ceil(half_width / h)) + 1 if n > 1 else 0 for h, n in zip(grid.spacing, grid.shape, strict=True)
    )


def _around(surface: ZeroSurface, grid: Grid, box: tuple[slice, ...], half_width: float) -> Band:
    """The band in a box of the grid; the surface's points count from the box's first voxel."""
    spacing, s = grid.spacing, surface
    shape = tuple(part.stop - part.start for part in box)
    # Single precision tells near from far as well, and half the bytes come through the cache.
    points, normals = s.points.astype(np.float32), s.normals.astype(np.float32)
    grown = sheets.grow(shape, spacing, points, normals, s.start, s.ring, s.piece, half_width)
    voxel, vertex, first = sheets.arrange(*grown)
    normal, distance = sheets.closest_points(
        voxel, vertex, shape, spacing, s.points, s.normals, s.curvature, s.direction
    )
    normal[np.array(shape) == 1] = 0  # in a plane, exactly: a closest point 1e-19 below it would lie in no cell
    forward, backward = np.empty((3, len(voxel)), np.int32), np.empty((3, len(voxel)), np.int32)
    for axis in range(3):
        up, down = (
            sheets.best_matches(voxel, vertex, first, normal, shape, spacing, s.points, s.piece, axis, move)
            for move in (1, -1)
        )
        forward[axis], backward[axis] = sheets.mutual_links(up, down)
    links = forward.view(np.uint32), backward.view(np.uint32)
    return Band(grid, box, half_width, surface, voxel, first, vertex, normal, distance, *links)


def flat_band(grid: Grid) -> Band:
    """Every voxel an entry, linked to its neighbours, and no normal: P = I, the flows of Eqs. 10-11."""
    count = int(np.prod(grid.shape))
    ids = np.arange(count, dtype=np.uint32).reshape(grid.shape)
    forward, backward = np.empty((3, count), np.uint32), np.empty((3, count), np.uint32)
    for axis in range(3):
        rows = np.arange(grid.shape[axis])
        forward[axis] = ids.take(np.minimum(rows + 1, rows[-1]), axis).reshape(-1)
        backward[axis] = ids.take(np.maximum(rows - 1, 0), axis).reshape(-1)
    return Band(
        grid=grid,
        box=tuple(slice(0, n) for n in grid.shape),
        half_width=0.0,
        surface=None,
        voxel=np.arange(count, dtype=np.int32),
        first=np.arange(count + 1, dtype=np.int32),
        vertex=np.zeros(count, np.int32),
        normal=np.zeros((3, count), np.float32),
        distance=np.zeros(count, np.float32),
        forward=forward,
        backward=backward,
    )
