"""From a mesh to the level set whose zero it is: the exact signed distance to its triangles, near them.

Distances, winding numbers and pseudonormals are libigl's (of which only the part under MPL-2 is used).
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from beltrami_cli.errors import DataError
from beltrami_cli.grid import Grid, extent
from beltrami_cli.repair import Repaired, edges

# Half-width, in voxels of the largest spacing: the band of 4 of a flow, and 2 for the stencils at its edge.
HALF_WIDTH = 6.0
# Around a surface, in voxels: one more than that.
MARGIN = HALF_WIDTH + 1
# A closest point is on an edge where its barycentric coordinate says so up to rounding.
ON_EDGE = 1e-6
# Shares of an edge: how far beside a triangle its two sides are; how much longer than allowed rounding makes a link.
BESIDE, ROUNDING = 1e-4, 1e-4
# A grid of its own has so many voxels between opposite banks, which then do not leak, but for the nearest few percent.
VOXELS_BETWEEN_BANKS, NEAREST_BANKS = 2.0, 5
BANKS_SAMPLE = 4000  # triangles that are asked how far the bank across is
AT_ONCE = 2_000_000  # voxels asked in one call: 0.3 GB


def signed_distance(surface: Repaired, grid: Grid, half_width: float | None = None) -> np.ndarray:
    """Psi, float32 of `grid.shape`, mm in the world: negative inside, exact within `half_width` mm of the triangles.

    half_width: default `HALF_WIDTH` voxels of the largest spacing.

    A surface is closed where its only borders are those of small holes, see `repair.repaired`. Inside is where its
    winding number is over 1/2 (Jacobson et al. 2013; Barill et al. 2018), so that self-intersections do no harm and of
    parts that overlap the union counts; where the surface is meant inside out, the reverse. Farther away Psi is
    half_width.

    Else it is open. The sign is that of the angle-weighted pseudonormal at the closest point (Baerentzen and Aanaes
    2005), triangles being counter-clockwise seen from outside. Psi is NaN where the closest point lies on the border,
    so that the zero level ends where the surface does; where the two sides meet away from the surface, as they may
    across what was cut off; and farther away, but where everything around is on one side.

    Raises DataError where no two voxels have the surface between them.
    """
    width = HALF_WIDTH * float(grid.used_spacing.max()) if half_width is None else half_width
    ask = _Closed(surface) if surface.is_closed else _Open(surface)
    psi = np.full(grid.shape, np.nan, np.float32)
    for box, points in _boxes(grid, surface.vertices, width):
        psi[box] = ask.distance(points, width).reshape(psi[box].shape)
    if not surface.is_closed:
        _forget_false_crossings(psi, grid.spacing)
    if not (np.any(psi < 0) and np.any(psi >= 0)):
        raise DataError(_no_crossing(surface.vertices, grid))
    _extend_sides(psi, width)
    return -psi if surface.inside_out else psi


def own_grid(surface: Repaired, spacing: float | None = None, margin: float | None = None) -> Grid:
    """A grid around the surface of cubic voxels, its axes along RAS.

    spacing: mm; by default the median edge, for finer voxels would say no more than a mesh does, or less where that
        takes `VOXELS_BETWEEN_BANKS` voxels between opposite banks.
    margin: mm beyond the vertices on every side; by default `MARGIN` voxels.

    Raises RefusedError as `Grid.around`.
    """
    step = _resolution(surface) if spacing is None else spacing
    around = MARGIN * step if margin is None else margin
    return Grid.around(surface.vertices[np.unique(surface.cells)], step, around)


class _Closed:
    """Distances to a closed surface."""

    def __init__(self, surface: Repaired) -> None:
        self.surface = surface
        self.skin = surface.cells[self._is_skin()]

    def distance(self, points: np.ndarray, width: float) -> np.ndarray:
        """(N,) mm at points (N, 3), NaN beyond `width`."""
        import igl

        kind = igl.SIGNED_DISTANCE_TYPE_UNSIGNED
        distance = igl.signed_distance(points, self.surface.vertices, self.skin, kind, -width, width)[0]
        near = np.isfinite(distance)
        distance[near] *= np.where(self._winding_number(points[near]) > 0.5, -1, 1)
        return distance

    def _winding_number(self, points: np.ndarray) -> np.ndarray:
        import igl

        return np.asarray(igl.fast_winding_number(self.surface.vertices, self.surface.cells, points))

    def _is_skin(self) -> np.ndarray:
        """(C,) bool: triangles with the inside on one side only, not within an overlap.

        On a triangle's outer side the winding number is 1 less than on its inner side.
        """
        a, b, c = (self.surface.vertices[self.surface.cells[:, k]] for k in range(3))
        normal = np.cross(b - a, c - a)
        size = np.linalg.norm(normal, axis=1, keepdims=True)
        beside = BESIDE * normal / np.sqrt(size)
        skin = np.zeros(len(a), bool)
        # Where the middle lies in an overlap, a corner may still stick out of it.
        for weights in ((1 / 3, 1 / 3, 1 / 3), (0.98, 0.01, 0.01), (0.01, 0.98, 0.01), (0.01, 0.01, 0.98)):
            rest = np.flatnonzero(~skin)
            points = (weights[0] * a + weights[1] * b + weights[2] * c + beside)[rest]
            if len(rest):
                skin[rest] = np.abs(self._winding_number(points)) < 0.5
        return skin


class _Open:
    """Distances to a surface that ends somewhere."""

    def __init__(self, surface: Repaired) -> None:
        self.surface = surface
        code = np.array([len(surface.vertices), 1])
        is_border = np.isin(edges(surface.cells) @ code, surface.border @ code)
        self.edge_is_border = is_border.T  # (C, 3), opposite of each corner
        self.vertex_is_border = np.zeros(len(surface.vertices), bool)
        self.vertex_is_border[surface.border] = True
        self.touches_border = self.vertex_is_border[surface.cells].any(1)

    def distance(self, points: np.ndarray, width: float) -> np.ndarray:
        """(N,) mm at points (N, 3), NaN beyond `width` and beyond the border."""
        import igl

        kind = igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL
        vertices, cells = self.surface.vertices, self.surface.cells
        distance, triangle, closest, _ = igl.signed_distance(points, vertices, cells, kind, -width, width)
        rest = np.flatnonzero(np.isfinite(distance))
        rest = rest[self.touches_border[triangle[rest]]]
        distance[rest[self._on_border(triangle[rest], closest[rest])]] = np.nan
        return distance

    def _on_border(self, triangle: np.ndarray, closest: np.ndarray) -> np.ndarray:
        """(N,) bool of points (N, 3) in triangles (N,)."""
        import igl

        corners = self.surface.cells[triangle]
        a, b, c = (np.ascontiguousarray(self.surface.vertices[corners[:, k]]) for k in range(3))
        weight = igl.barycentric_coordinates(np.ascontiguousarray(closest), a, b, c)
        on_edge = self.edge_is_border[triangle] & (weight < ON_EDGE)
        at_vertex = self.vertex_is_border[corners] & (weight > 1 - ON_EDGE)
        return np.asarray((on_edge | at_vertex).any(1))


def _boxes(grid: Grid, vertices: np.ndarray, width: float) -> Iterator[tuple[tuple[slice, ...], np.ndarray]]:
    """Boxes of voxels that may be within `width` of the vertices' hull, and their centres (N, 3) in RAS mm."""
    ijk = grid.to_index(vertices)
    reach = width / grid.spacing
    low = np.maximum(np.ceil(ijk.min(0) - reach), 0).astype(int)
    high = np.minimum(np.floor(ijk.max(0) + reach) + 1, grid.shape).astype(int)
    if (high <= low).any():
        return
    thick = max(1, AT_ONCE // int(np.prod((high - low)[1:])))
    for start in range(low[0], high[0], thick):
        box = (slice(start, min(start + thick, high[0])), slice(low[1], high[1]), slice(low[2], high[2]))
        centres = np.mgrid[box].reshape(3, -1).T.astype(np.float64)
        yield box, np.ascontiguousarray(grid.to_world(centres))


def _forget_false_crossings(psi: np.ndarray, spacing: np.ndarray) -> None:
    """NaN where psi changes its sign between two voxels farther from the surface than from each other."""
    wrong = np.zeros(psi.shape, bool)
    for here, there, step in _links(spacing):
        a, b = psi[here], psi[there]
        false = ((a < 0) != (b < 0)) & (np.abs(a) + np.abs(b) > (1 + ROUNDING) * step)
        wrong[here] |= false
        wrong[there] |= false
    psi[wrong] = np.nan


def _extend_sides(psi: np.ndarray, width: float) -> None:
    """`width` with the sign of what is around it in every region without values, but where both signs are."""
    from scipy.ndimage import label

    region, count = label(np.isnan(psi))
    sides = np.zeros((2, count + 1), bool)
    for links in _links(np.ones(3)):
        for here, there in (links[:2], links[1::-1]):
            beside = (region[here] > 0) & (region[there] == 0)
            for side, negative in enumerate((False, True)):
                sides[side, region[here][beside & ((psi[there] < 0) == negative)]] = True
    fill = np.where(sides.sum(0) == 1, np.where(sides[1], -width, width), np.nan).astype(np.float32)
    empty = region > 0
    psi[empty] = fill[region[empty]]


def _links(spacing: np.ndarray) -> Iterator[tuple[tuple[slice, ...], tuple[slice, ...], float]]:
    """For each axis the two halves of a volume's links, as slices, and their length."""
    for axis in range(3):
        here = tuple(slice(None, -1) if k == axis else slice(None) for k in range(3))
        there = tuple(slice(1, None) if k == axis else slice(None) for k in range(3))
        yield here, there, float(spacing[axis])


def _no_crossing(vertices: np.ndarray, grid: Grid) -> str:
    corners = grid.corners()
    if np.all((vertices >= corners.min(0)) & (vertices <= corners.max(0))):
        steps, size = (" x ".join(f"{x:.4g}" for x in mm) for mm in (grid.spacing, np.ptp(vertices, axis=0)))
        return (
            f"the surface runs between no two voxels: found voxels of {steps} mm around a surface of {size} mm; "
            "expected smaller ones: give --spacing, or --like with a finer volume"
        )
    return (
        f"the surface runs between no two voxels of the volume: found it within {extent(vertices)}, the voxels within "
        f"{extent(corners)} (RAS); expected one space for both (--frame says which the surface is in)"
    )


def _resolution(surface: Repaired) -> float:
    """Voxel size in mm that suits the mesh."""
    vertices, cells = surface.vertices, surface.cells
    ends = vertices[edges(cells)]
    edge = float(np.median(np.linalg.norm(ends[:, :, 0] - ends[:, :, 1], axis=-1)))
    banks = np.percentile(_to_bank_across(surface, BESIDE * edge), NEAREST_BANKS, method="lower")
    return float(f"{min(edge, float(banks) / VOXELS_BETWEEN_BANKS):.3g}")


def _to_bank_across(surface: Repaired, beside: float) -> np.ndarray:
    """(N,) mm from triangles, along their normals to both sides, to the next triangle; infinite where none is met."""
    import igl

    vertices, cells = surface.vertices, surface.cells
    some = cells[np.linspace(0, len(cells) - 1, min(BANKS_SAMPLE, len(cells))).astype(int)]
    a, b, c = (vertices[some[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    tree = igl.AABB()
    tree.init(vertices, cells)
    gaps = []
    for way in (normal, -normal):
        start = (a + b + c) / 3 + beside * way
        hit, distance, _ = tree.intersect_ray_first(vertices, cells, start, way)
        gaps.append(np.where(hit >= 0, distance, np.inf))
    return np.concatenate(gaps)
