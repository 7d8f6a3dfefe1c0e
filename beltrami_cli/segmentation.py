"""From a segmentation to a smooth surface that keeps every voxel centre on its side.

The boundary of a mask crosses the grid edges between a voxel inside and one outside; where along the edge, the mask
does not say. The surface here is the one whose curvature varies least among all that cross the same edges: each vertex
has one degree of freedom, its place along its edge. No voxel centre changes sides, no bank of a thin sulcus touches the
next, and the surface stays within half a voxel of the staircase. With H the mean curvature and H* its average over the
mesh nearby, sum (H - H*)^2 becomes small: 0 for planes, cylinders and spheres, so that nothing shrinks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.grid import Canonical, Grid
from beltrami_cli.kernels import fairing
from beltrami_cli.kernels import mesh as kernels
from beltrami_cli.levelset import contour, crossing_box, facing, isosurface, thin_first, two_values, zero_surface
from beltrami_cli.surface import Mesh

# Labels as pairs (first, last): "5-255" is one pair, "2,41" two.
Labels = tuple[tuple[int, int], ...]
# Times that normals, curvatures and their average are taken anew, and steps towards the minimum in between: enough to
# round off terraces up to about 15 voxels wide; four times as many reach twice as far.
ROUNDS, STEPS = 8, 80
# The staircase's own normals are averaged over so many rings before the first round: about a terrace.
FIRST_RINGS = 6
# Rings that the average H* is taken over, one after the other (about 4 voxels): more keeps spheres, fewer planes.
AVERAGE_RINGS = 10
# Least share of a grid edge between a vertex and the voxel centres at its ends: triangles keep an area, banks a gap.
MARGIN = 0.02
# The same beside a voxel between two of the other side, as in a sulcus one voxel wide: its banks keep half of it.
THIN_MARGIN = 0.25
MOST_LISTED = 40  # labels in a message
# Weight of the pull to the middle of the edge, 1/voxel^4: it only decides what curvature leaves open, as a flat face.
PULL = 1e-4
# An edge along the surface says nothing of its height: its vertex moves along it by 1/SLOPE of a height at most.
SLOPE = 0.02
# Distances are exact so many voxels on both sides of the mid surface: the cubic that places it reaches 2.
NEAR = 2.5
# Two directions are opposed when their cosine is below this (120 degrees): a fundus or a corner has less.
OPPOSED = -0.5
# Below this (60 degrees) they still lead on from outer voxels to where banks touch, as at the mouth of a sulcus.
SPREAD = 0.5
# Fewer voxels than these are a dent of the inner boundary, whose sides are opposed too.
LEAST_MEETING = 12
# Psi, in voxels, at the least, where two banks touch: enough to be on the outer side.
KEPT_APART = 0.05


def surface_of_labels(
    labels: np.ndarray,
    grid: Grid,
    *,
    labels_inside: Labels | None,
    between: tuple[Labels, Labels] | None,
) -> Mesh:
    """The surface that a segmentation describes, in RAS mm, facing outwards.

    labels: (nx, ny, nz), NaN where unknown. labels_inside: the labels of the voxels inside; of a segmentation with two
    values the higher one, if None. between: the labels of the inner region and of the outer one, for the surface half
    way between the two (`mid_surface`); voxels with 0 are then unknown, unless 0 is named. Loose voxels and holes are
    kept: they become small closed surfaces. Raises RefusedError where a label is absent, on both sides, or not named;
    DataError where the labels have no boundary.
    """
    known = ~np.isnan(labels)
    if between is not None:
        inner, outer = (_present(labels, side) for side in between)
        if both := sorted(set(inner) & set(outer)):
            raise RefusedError(f"the inner and the outer labels share {_listed(both)}; expected each on one side")
        if 0 not in (*inner, *outer):
            known &= labels != 0
            _require_thickness(known)
        return mid_surface(np.isin(labels, inner), np.isin(labels, outer), grid, known)
    if labels_inside is not None:
        return smooth_surface(np.isin(labels, _present(labels, labels_inside)), grid, known)
    values = two_values(labels)
    if values is None:
        raise RefusedError(
            f"holds the labels {_listed(np.unique(labels[known]))}; --labels says which are inside (as in 2,41 or "
            "5-255), or --between INNER,OUTER between which of them the surface is"
        )
    return smooth_surface(labels == values[1], grid, known)


def _present(labels: np.ndarray, wanted: Labels) -> tuple[int, ...]:
    """Labels wanted, of ranges those that are there; raises RefusedError where one, or all of a range, are not."""
    found = np.unique(labels[~np.isnan(labels)])
    present: list[int] = []
    for first, last in wanted:
        there = found[(found >= first) & (found <= last)]
        if not len(there):
            name = f"{first}" if first == last else f"{first}-{last}"
            raise RefusedError(f"has no label {name}; found {_listed(found)}")
        present += there.astype(int).tolist()
    return tuple(present)


def _listed(labels: Sequence[float] | np.ndarray) -> str:
    names = ", ".join(f"{label:g}" for label in labels[:MOST_LISTED])
    return names if len(labels) <= MOST_LISTED else f"{names} ... {labels[-1]:g} ({len(labels)} values)"


def _require_thickness(known: np.ndarray) -> None:
    """Raise RefusedError where the voxels known are one slice of a volume."""
    for axis, length in enumerate(known.shape):
        if length > 1 and np.count_nonzero(known.any(tuple(k for k in range(3) if k != axis))) == 1:
            raise RefusedError(
                f"its labels fill one slice across axis {axis + 1}, and a surface needs two or more (0 counts as "
                "unknown); label the slices beside it as well, or name 0 as a side if it is one"
            )


def smooth_surface(inside: np.ndarray, grid: Grid, known: np.ndarray | None = None) -> Mesh:
    """The boundary of a mask without its staircase, in RAS mm, facing outwards.

    inside: (nx, ny, nz) bool. known: (nx, ny, nz) bool, where `inside` counts; everywhere if None. The surface is open
    at the border of what is known and at the faces of the volume. A plane (the last axis of length 1) gives a polyline.
    Thin structures stay whole: where two banks could be joined or kept apart, as across a diagonal, the thinner side
    wins. Raises DataError where no voxel inside lies beside one outside.
    """
    # Marching cubes and the fairing go by the order of the voxels: how the mask is stored must not show.
    canonical = Canonical(grid)
    inside, grid = canonical.forth(inside), canonical.grid
    known = None if known is None else canonical.forth(known)
    stairs = _staircase(inside, known, grid)
    # World lengths and angles in a frame whose third axis stays a plane's normal; units of the finest voxel.
    axes = np.linalg.cholesky(grid.affine[:3, :3].T @ grid.affine[:3, :3]).T / grid.used_spacing.min()
    ijk = stairs.place(_fair(stairs, axes))
    return Mesh(grid.to_world(ijk), facing(stairs.cells, grid))


def mid_surface(inner: np.ndarray, outer: np.ndarray, grid: Grid, known: np.ndarray | None = None) -> Mesh:
    """The surface at equal distance from the boundaries of two regions, in RAS mm, facing the outer one.

    inner, outer: (nx, ny, nz) bool, white matter and what lies beyond the pial surface; the tissue is what lies
    between. known: see `smooth_surface`. It is the zero level of (distance to inner - distance to outer) / 2, both to
    the smooth surfaces. Where two banks of a sulcus touch, with no outer voxel between, the places as far from the
    white of one as from that of the other count as outer, if they go on from outer voxels: the banks stay apart while
    the white is three voxels apart or more; under that, they are one. Raises DataError where one of the regions has no
    boundary.
    """
    # Marching cubes and the fairing go by the order of the voxels: how the mask is stored must not show.
    canonical = Canonical(grid)
    inner, outer, grid = canonical.forth(inner), canonical.forth(outer), canonical.grid
    known = None if known is None else canonical.forth(known)
    known = np.ones(inner.shape, bool) if known is None else known
    ends = [(part.start, part.stop) for region in (inner, outer) for part in _box(region, known)]
    low, high = np.min([ends[:3], ends[3:]], 0)[:, 0], np.max([ends[:3], ends[3:]], 0)[:, 1]
    box = tuple(slice(a, b) for a, b in zip(low, high, strict=True))
    surfaces = [smooth_surface(region, grid, known) for region in (inner, outer)]
    inner, outer, known = inner[box], outer[box], known[box]
    psi = _equidistance(inner, outer, known, grid, low, surfaces)
    surface = zero_surface(np.where(known, psi, np.nan), grid.spacing)
    return Mesh(grid.to_world(surface.points / grid.spacing + low), facing(surface.cells, grid))


def _equidistance(
    inner: np.ndarray, outer: np.ndarray, known: np.ndarray, grid: Grid, low: np.ndarray, surfaces: list[Mesh]
) -> np.ndarray:
    """(distance to inner - distance to outer) / 2 in mm: exact near its zero level, from voxel to voxel elsewhere."""
    spacing = grid.spacing
    to_inner, to_outer = _voxel_distance(inner, spacing), _voxel_distance(outer, spacing)
    apart, between = _meeting(inner, outer, known, to_outer, spacing)
    psi = (to_inner - np.minimum(to_outer, _voxel_distance(apart, spacing) if apart.any() else np.inf)) / 2
    near = np.nonzero(known & (np.abs(psi) < NEAR * spacing.max()))
    ijk = np.stack(near, 1)
    exact = [_distance(grid.to_world(ijk + low), surface) for surface in surfaces]
    beyond = np.where(outer[near], -exact[1], exact[1])
    if len(between):
        from scipy.spatial import KDTree

        beyond = np.minimum(beyond, KDTree(between * spacing).query(ijk * spacing, workers=-1)[0])
    psi[near] = (np.where(inner[near], -exact[0], exact[0]) - beyond) / 2
    psi[apart] = np.maximum(psi[apart], KEPT_APART * spacing.min())
    return np.asarray(psi)


def _voxel_distance(region: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Signed distance in mm to the nearest voxel centre of the other side, negative inside."""
    from scipy.ndimage import distance_transform_edt

    return np.asarray(
        distance_transform_edt(~region, sampling=spacing) - distance_transform_edt(region, sampling=spacing)
    )


def _distance(points_ras_mm: np.ndarray, mesh: Mesh) -> np.ndarray:
    """Distances (N,) in mm to a mesh."""
    import igl

    squared = igl.point_mesh_squared_distance(points_ras_mm, mesh.vertices_ras_mm, mesh.cells.astype(np.int64))[0]
    return np.sqrt(squared)


def _meeting(
    inner: np.ndarray, outer: np.ndarray, known: np.ndarray, to_outer: np.ndarray, spacing: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Where banks touch in a sulcus: voxels (nx, ny, nz), and points (P, 3) in voxels, as far from one as the other.

    Two neighbours of the tissue whose nearest inner voxels lie in opposed directions have such a point between them.
    """
    from scipy.ndimage import binary_propagation, distance_transform_edt, label

    distance, feet = distance_transform_edt(~inner, sampling=spacing, return_indices=True)
    away = (np.indices(inner.shape) - feet) * spacing.reshape(3, 1, 1, 1) / np.maximum(distance, 1e-30)
    tissue = known & ~inner & ~outer
    met, path, points = np.zeros(inner.shape, bool), outer & known, []
    for axis in range(3):
        a = tuple(slice(None, -1) if k == axis else slice(None) for k in range(3))
        b = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        cosine = np.where(tissue[a] & tissue[b], (away[:, *a] * away[:, *b]).sum(0), 1)
        opposed = cosine < OPPOSED
        for voxels, there in ((met, opposed), (path, cosine < SPREAD)):
            voxels[a] |= there
            voxels[b] |= there
        rise, fall = away[axis][a][opposed], away[axis][b][opposed]
        gap = (distance[b] - distance[a])[opposed] / spacing[axis]
        at = np.argwhere(opposed).astype(float)
        at[:, axis] += np.clip((gap - fall) / np.where(rise > fall, rise - fall, np.inf), 0, 1)
        points.append(at)
    # A dent of the inner boundary has opposed sides too, but is no sulcus: it does not go on from outer voxels.
    joined = met & binary_propagation(outer & known, mask=path, structure=np.ones((3, 3, 3)))
    joined &= to_outer > distance / 2  # nearer, the outer voxels themselves keep the banks apart
    parts, _ = label(joined, np.ones((3, 3, 3)))
    joined &= np.bincount(parts.ravel())[parts] >= LEAST_MEETING
    at = np.concatenate(points)
    nearest = tuple(np.round(at).astype(int).T)
    return joined, at[joined[nearest]]


@dataclass(frozen=True, eq=False)
class _Staircase:
    """The boundary of a mask as marching cubes gives it, not yet placed along the grid edges that it crosses.

    low: (V, 3) float64, the voxel at the lower end of each vertex's edge. axis: (V,) that the edge runs along; -1 for
    the few vertices in the middle of a cell, which follow their ring. least, most: (V,) shares of the edge that it may
    lie between. cells, start, ring: see `ZeroSurface`, in index space.
    """

    low: np.ndarray
    axis: np.ndarray
    least: np.ndarray
    most: np.ndarray
    cells: np.ndarray
    start: np.ndarray
    ring: np.ndarray

    @cached_property
    def on_edge(self) -> np.ndarray:
        """(V,) bool."""
        return self.axis >= 0

    @cached_property
    def across(self) -> np.ndarray:
        """(N,) bool: entries of `ring` from a vertex of the border into the surface; false for a polyline."""
        count, corners = len(self.low), self.cells.shape[1]
        if corners == 2:
            return np.zeros(len(self.ring), bool)
        # Each directed side of a triangle is met by its reverse, but at the border.
        a, b = (c.ravel().astype(np.int64) for c in (self.cells, np.roll(self.cells, -1, 1)))
        sides = np.setxor1d(a * count + b, b * count + a)
        row = np.repeat(np.arange(count), np.diff(self.start))
        return np.isin(row, sides // count) & ~np.isin(row * count + self.ring, sides)

    def place(self, share: np.ndarray) -> np.ndarray:
        """(V, 3) voxel indices of the vertices at `share` (V,) of their edges."""
        ijk = self.low.copy()
        rows = np.flatnonzero(self.on_edge)
        ijk[rows, self.axis[rows]] += share[rows]
        if len(rows) < len(ijk):
            for v in np.flatnonzero(~self.on_edge):
                ring = self.ring[self.start[v] : self.start[v + 1]]
                ijk[v] = ijk[ring[self.on_edge[ring]]].mean(0)
        return ijk


def _staircase(inside: np.ndarray, known: np.ndarray | None, grid: Grid) -> _Staircase:
    """Marching cubes or squares of a mask; thin structures win where cells are ambiguous."""
    known = np.ones(inside.shape, bool) if known is None else known
    box = _box(inside, known)
    inside, known = inside[box], known[box]
    psi = np.where(_spread(inside, known, grid.spacing), np.float32(-1), np.float32(1))
    ijk, cells = (contour if psi.shape[2] == 1 else isosurface)(thin_first(psi), np.ones(psi.shape, bool))
    low, axis = _edges(ijk)
    high = low.astype(int)
    high[axis >= 0, axis[axis >= 0]] += 1
    crossed = known[tuple(low.astype(int).T)] & known[tuple(high.T)]
    middle = axis < 0
    if middle.any():
        start, ring = kernels.half_edges(cells, len(ijk))
        crossed[middle] = np.logical_and.reduceat(crossed[ring] | middle[ring], start[:-1])[middle]
    cells = cells[crossed[cells].all(1)]
    if not len(cells):
        raise DataError("the segmentation has no boundary among the voxels known; expected a face of one cell at least")
    corners = cells.shape[1]
    used, cells = np.unique(cells, return_inverse=True)
    cells = cells.reshape(-1, corners).astype(np.int32)
    start, ring = kernels.half_edges(cells, len(used))
    least, most = _margins(psi, low[used].astype(int), axis[used])
    return _Staircase(low[used] + [part.start for part in box], axis[used], least, most, cells, start, ring)


def _margins(psi: np.ndarray, low: np.ndarray, axis: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The shares (V,) of its edge that a vertex may lie between: farther from a voxel between two of the other sign."""
    steps = np.eye(3, dtype=int)[axis]
    before, here, there, after = (
        psi[tuple(np.clip(low + k * steps, 0, np.array(psi.shape) - 1).T)] for k in (-1, 0, 1, 2)
    )
    return np.where(before == there, THIN_MARGIN, MARGIN), 1 - np.where(after == here, THIN_MARGIN, MARGIN)


def _box(inside: np.ndarray, known: np.ndarray) -> tuple[slice, ...]:
    """The part of the volume that holds every grid edge from a known voxel inside to a known one outside."""
    try:
        return crossing_box(
            np.where(known, np.where(inside, np.float32(-1), np.float32(1)), np.float32(np.nan)), (1, 1, 1)
        )
    except DataError:
        raise DataError(
            f"the segmentation has no boundary: found {np.count_nonzero(inside & known)} voxels inside and "
            f"{np.count_nonzero(~inside & known)} outside; expected some of each, side by side"
        ) from None


def _spread(inside: np.ndarray, known: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """`inside`, with each unknown voxel like the nearest known one: cells there are cut, not lost."""
    from scipy.ndimage import distance_transform_edt

    if known.all():
        return inside
    nearest = distance_transform_edt(~known, sampling=spacing, return_distances=False, return_indices=True)
    return np.asarray(inside[tuple(nearest)])


def _edges(ijk: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Lower end (V, 3) and axis (V,) of the grid edge that each vertex lies on; axis -1 in the middle of a cell."""
    low = np.round(ijk)
    off = np.abs(ijk - low) > kernels.ON_NODE
    axis = np.where(off.sum(1) == 1, off.argmax(1), -1)
    low[off] = np.floor(ijk[off])
    return low, axis


def _fair(stairs: _Staircase, axes: np.ndarray) -> np.ndarray:
    """(V,) where along its edge each vertex lies on the surface whose curvature varies least.

    axes: (3, 3) columns are the grid's axes, in finest voxels.
    """
    share = np.full(len(stairs.low), 0.5)
    edge = np.where(stairs.on_edge[:, None], axes.T[stairs.axis], 0)
    mesh = stairs.start, stairs.ring
    back = fairing.reverse_entries(*mesh)
    for number in range(ROUNDS):
        points = stairs.place(share) @ axes.T
        normals = _normals(points, stairs, FIRST_RINGS if number == 0 else 1)
        curvature, weight, counted = fairing.mean_curvatures(points, normals, *mesh, stairs.across)
        if number:  # the staircase's own curvature says nothing
            curvature -= counted * fairing.ring_average(curvature, counted, *mesh, AVERAGE_RINGS)
        climb = (normals * edge).sum(1)
        climb = np.where(np.abs(climb) < SLOPE, np.copysign(SLOPE, climb), climb)
        low, high = np.sort([climb * (stairs.least - share), climb * (stairs.most - share)], axis=0)
        heights = fairing.fair_heights(curvature, weight, *mesh, back, low, high, climb * (0.5 - share), PULL, STEPS)
        share = np.clip(share + heights / climb, stairs.least, stairs.most)
    return share


def _normals(points: np.ndarray, stairs: _Staircase, rings: int) -> np.ndarray:
    """(V, 3) unit normals of the faces, averaged over so many rings."""
    of_cells = kernels.segment_normals if stairs.cells.shape[1] == 2 else kernels.face_normals
    normals = of_cells(points, stairs.cells)
    for _ in range(rings):
        normals = kernels.ring_mean(normals, stairs.start, stairs.ring)
    return np.asarray(normals)
