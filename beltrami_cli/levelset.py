"""The surface that a band grows around, from any level-set volume or from a mesh: with normals and curvatures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from beltrami_cli.errors import DataError
from beltrami_cli.grid import Grid
from beltrami_cli.kernels import mesh as kernels
from beltrami_cli.surface import Mesh

# Sizes given to marching cubes lie between FLOOR and 1 + FLOOR, and THIN_WEIGHT times that where the phase is thin: no
# crossing then comes so near a node that single precision would lose the edge which it is on.
FLOOR = np.float32(0.1)
THIN_WEIGHT = np.float32(12)
# Least squares for curvature: rings smaller than this, in voxels, say little about it.
RING_VOXELS = 0.1
# Edges of a mesh that are longer than this, in voxels of the smallest spacing, are split: a band has its entries from
# the vertices that a voxel lies along the normal of, aside by no more than 1 voxel.
LONGEST_EDGE = 1.25
MOST_TRIANGLES = 20_000_000  # of a refined mesh: gigabytes of band, and no data that would need them


@dataclass(frozen=True, eq=False)
class ZeroSurface:
    """The zero level of Psi as a mesh, or a mesh in its place.

    points: (V, 3) float64, mm along the voxel axes (index times spacing).
    cells: (C, 3) int32 triangles, or (C, 2) segments where the grid is a plane; counter-clockwise in index space seen
        from the side of increasing Psi.
    normals: (V, 3) unit vectors along the voxel axes, towards increasing Psi.
    curvature, direction: (V, 2) principal curvatures, 1/mm, and (V, 3) direction of the first.
    start, ring: neighbours of each vertex, (V + 1,) and (N,) int32.
    """

    points: np.ndarray
    cells: np.ndarray
    normals: np.ndarray
    curvature: np.ndarray
    direction: np.ndarray
    start: np.ndarray
    ring: np.ndarray
    piece: np.ndarray


def crossing_box(psi: np.ndarray, margin: tuple[int, ...]) -> tuple[slice, ...]:
    """The part of the volume that holds every sign change of psi, widened by `margin` voxels per axis.

    Raises DataError where psi has no zero level.
    """
    negative, finite = psi < 0, np.isfinite(psi)
    low, high = np.full(3, np.iinfo(int).max), np.full(3, -1)
    for axis in range(3):
        a = tuple(slice(None, -1) if k == axis else slice(None) for k in range(3))
        b = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        crossing = (negative[a] != negative[b]) & finite[a] & finite[b]
        for k in range(3):
            where = np.flatnonzero(crossing.any(tuple(m for m in range(3) if m != k)))
            if len(where):
                low[k] = min(low[k], where[0])
                high[k] = max(high[k], where[-1] + (k == axis))
    if high[0] < 0:
        values = psi[finite]
        found = f"values from {values.min():.6g} to {values.max():.6g}" if values.size else "no finite value"
        raise DataError(
            f"the level set has no zero level: found {found}, expected both signs "
            "(Psi < 0 inside, > 0 outside; are LEVELSET and DATA swapped?)"
        )
    return tuple(
        slice(max(0, int(low[k]) - margin[k]), min(psi.shape[k], int(high[k]) + 1 + margin[k])) for k in range(3)
    )


def sampled(data: np.ndarray) -> np.ndarray:
    """Finite ones of some 4096 values of a volume, evenly spread: enough to tell most level sets from labels."""
    some = data.ravel("K")[:: 1 + data.size // 4096]
    return some[np.isfinite(some)]


def two_values(psi: np.ndarray) -> tuple[float, float] | None:
    """The two values of a mask, the lower first; None where the finite values are fewer or more than two."""
    if len(np.unique(sampled(psi))) > 2:
        return None
    finite = psi[np.isfinite(psi)]
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 0.0)
    return (low, high) if low < high and np.all((finite == low) | (finite == high)) else None


def zero_surface(psi: np.ndarray, spacing: np.ndarray) -> ZeroSurface:
    """Marching cubes (marching squares in a plane, the last axis having length 1) at Psi = 0.

    psi: (nx, ny, nz), NaN or inf where unknown. spacing: (3,) mm. Raises DataError where nothing is crossed.
    """
    psi = np.ascontiguousarray(psi, np.float32)
    ijk, cells = (contour if psi.shape[2] == 1 else isosurface)(thin_first(psi), np.isfinite(psi))
    if not len(cells):
        raise DataError("the level set has no zero level among its finite values")
    start, ring = kernels.half_edges(cells, len(ijk))
    ijk = kernels.linear_crossings(psi, ijk, start, ring)
    points = ijk * spacing
    raw = kernels.segment_normals(points, cells) if cells.shape[1] == 2 else kernels.face_normals(points, cells)
    mesh_normals = kernels.ring_mean(raw, start, ring)
    ijk, normals = kernels.refine_crossings(psi, ijk, spacing, mesh_normals)
    points = ijk * spacing
    return _curved(points, cells, normals, start, ring, spacing[: 3 if psi.shape[2] > 1 else 2].min())


@dataclass(frozen=True, eq=False)
class Refined:
    """A mesh made fine enough for a grid: edges that are too long are split in the middle, some times over.

    surface: its first vertices are those of the mesh it was made from. edges: for every time, the (M, 2) vertices
    between which the new ones lie.
    """

    surface: ZeroSurface
    edges: tuple[np.ndarray, ...]

    def carry(self, values: np.ndarray, trust: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Values (K, V) of weights `trust` (V,), 0 where missing, at all vertices: new ones have the ends' mean."""
        for ends in self.edges:
            weight = trust[ends]
            mass = weight.sum(1)
            with np.errstate(invalid="ignore"):
                middle = (np.where(weight > 0, values[:, ends], 0) * weight).sum(-1) / mass
            values = np.concatenate([values, middle.astype(values.dtype)], 1)
            trust = np.concatenate([trust, (mass / 2).astype(trust.dtype)])
        return values, trust


def refined(mesh: Mesh, grid: Grid) -> Refined:
    """The mesh for a band on this grid: points in mm along the voxel axes from the grid's first voxel.

    Raises DataError where the mesh has no triangle of any area, vertices that are not finite, triangles that share no
    vertices, or edges so long for the voxels that it cannot be refined.
    """
    mesh.require_triangles()
    spacing = grid.spacing
    points = grid.to_index(mesh.vertices_ras_mm) * spacing
    cells = np.ascontiguousarray(facing(mesh.cells, grid), np.int32)
    splits: list[np.ndarray] = []
    while True:
        ends = np.sort(cells[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
        length = np.linalg.norm(points[ends[:, 0]] - points[ends[:, 1]], axis=1)
        if not length.max() > 0:
            raise DataError("the surface has no triangle of any area: is it a mesh at all?")
        longer = length > LONGEST_EDGE * spacing.min()
        if not longer.any():
            break
        if len(cells) + longer.sum() > MOST_TRIANGLES:
            raise DataError(
                f"the surface's edges are up to {length.max():.4g} mm long on voxels of {spacing.min():.4g} mm, after "
                f"{len(splits)} refinements to {len(cells)} triangles; expected a finer mesh or coarser voxels (are "
                "both in mm?)"
            )
        points, cells, edges = _split(points, cells, ends, longer)
        splits.append(edges)
    start, ring = kernels.half_edges(cells, len(points))
    normals = kernels.ring_mean(kernels.face_normals(points, cells), start, ring)
    surface = _curved(points, cells, normals, start, ring, spacing.min())
    if len(mesh.cells) > 1 and len(np.unique(surface.piece[cells[:, 0]])) > len(mesh.cells) / 2:
        raise DataError(
            f"the surface's {len(mesh.cells)} triangles share no vertices; expected neighbours that do: merge vertices "
            "at one place first"
        )
    return Refined(replace(surface, piece=_sewn(surface.points, surface.piece)), tuple(splits))


def _sewn(points: np.ndarray, piece: np.ndarray) -> np.ndarray:
    """The pieces' numbers (V,), one for all that have a vertex at one place: along a seam vertices stand twice."""
    if not piece.any():
        return piece
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    place = np.unique(points, axis=0, return_inverse=True)[1].reshape(-1)
    order = np.argsort(place, kind="stable")
    same = place[order][1:] == place[order][:-1]
    one, other = piece[order[1:][same]], piece[order[:-1][same]]
    count = int(piece.max()) + 1
    graph = coo_array((np.ones(len(one), bool), (one, other)), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1][piece], np.int32)


def _split(
    points: np.ndarray, cells: np.ndarray, ends: np.ndarray, longer: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Points, cells and the edges that were split; ends: (3 C, 2) of the edges 01, 12, 20 of every triangle, sorted.

    longer: (3 C,) which of them to split. Both triangles at an edge agree on it, so that the mesh stays closed.
    """
    code = ends[:, 0].astype(np.int64) * len(points) + ends[:, 1]
    new, number = np.unique(code[longer], return_inverse=True)
    edges = np.stack(np.divmod(new, len(points)), 1)
    numbers = np.full(len(ends), -1)
    numbers[longer] = len(points) + number
    middle = numbers.reshape(-1, 3)
    count = (middle >= 0).sum(1)
    # Turned so that of one split edge it comes first, and of two the whole edge last.
    only, whole = (middle >= 0).argmax(1), (middle < 0).argmax(1)
    first = np.where(count == 1, only, np.where(count == 2, (whole + 1) % 3, 0))
    turn = (first[:, None] + np.arange(3)) % 3
    (a, b, c), (ab, bc, ca) = (np.take_along_axis(x, turn, 1).T for x in (cells, middle))
    parts = {
        0: [(a, b, c)],
        1: [(a, ab, c), (ab, b, c)],
        2: [(ab, b, bc), (a, ab, bc), (a, bc, c)],
        3: [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
    }
    finer = [np.stack(corners, 1)[count == n] for n, triangles in parts.items() for corners in triangles]
    return (
        np.concatenate([points, points[edges].mean(1)]),
        np.ascontiguousarray(np.concatenate(finer), np.int32),
        edges,
    )


def facing(cells: np.ndarray, grid: Grid) -> np.ndarray:
    """Cells whose corners run the other way round where the grid's index axes are left-handed.

    Counter-clockwise in the world is clockwise there, and the reverse.
    """
    return cells if grid.handedness > 0 else np.ascontiguousarray(cells[:, ::-1])


def _curved(
    points: np.ndarray, cells: np.ndarray, normals: np.ndarray, start: np.ndarray, ring: np.ndarray, voxel: float
) -> ZeroSurface:
    curvature, direction = kernels.principal_curvatures(
        points, normals, start, ring, 1 / voxel, (RING_VOXELS * voxel) ** 2
    )
    return ZeroSurface(points, cells, normals, curvature, direction, start, ring, kernels.pieces(start, ring))


def thin_first(psi: np.ndarray) -> np.ndarray:
    """Psi's signs with sizes that say what is connected to what, not where the surface is.

    Where two corners of a cell's face are inside and the other two outside, marching cubes connects the pair of the
    larger values. In a sulcus or a blade about one voxel thick the samples do not tell which pair that is, and the
    wrong one pierces it. Voxels between two of the other sign are therefore made to win.
    """
    negative = psi < 0
    thin = np.zeros(psi.shape, bool)
    for axis in range(3):
        before, here, after = (
            tuple(part if k == axis else slice(None) for k in range(3))
            for part in (slice(None, -2), slice(1, -1), slice(2, None))
        )
        thin[here] |= (negative[before] == negative[after]) & (negative[before] != negative[here])
    size = np.abs(psi, where=np.isfinite(psi), out=np.ones_like(psi))
    size = FLOOR + np.sqrt(np.sqrt(size / size.max()))
    size = np.where(thin, THIN_WEIGHT * size, size)
    return np.where(negative, -size, size)


def isosurface(psi: np.ndarray, finite: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) in voxel indices and triangles (C, 3), facing increasing psi."""
    from skimage.measure import marching_cubes

    mask = None
    if not finite.all():
        # The mask is asked at a cell's high corner only; a cell counts where all its corners are finite.
        mask = np.zeros_like(finite)
        corners = [finite[i : i - 1 or None, j : j - 1 or None, k : k - 1 or None] for i, j, k in np.ndindex(2, 2, 2)]
        mask[1:, 1:, 1:] = np.logical_and.reduce(corners)
        psi = np.where(finite, psi, 1)
    try:
        ijk, cells, _, _ = marching_cubes(psi, 0.0, mask=mask)
    except (ValueError, RuntimeError):  # no cell is crossed among the finite values
        return np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    return ijk.astype(np.float64), cells.astype(np.int32)


def contour(psi: np.ndarray, finite: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) in voxel indices and segments (C, 2) with increasing psi on their left."""
    from skimage.measure import find_contours

    points, segments, count = [], [], 0
    for line in find_contours(psi[:, :, 0], 0.0, positive_orientation="high", mask=finite[:, :, 0]):
        closed = len(line) > 2 and bool((line[0] == line[-1]).all())
        line = line[:-1] if closed else line
        index = np.arange(len(line))
        following = np.roll(index, -1) if closed else index[1:]
        segments.append(count + np.stack([index[: len(following)], following], 1))
        points.append(np.c_[line, np.zeros(len(line))])
        count += len(line)
    if not points:
        return np.zeros((0, 3)), np.zeros((0, 2), np.int32)
    return np.concatenate(points), np.concatenate(segments).astype(np.int32)
