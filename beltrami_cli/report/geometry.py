"""The surface as a picture needs it: coarser, inflated, seen from a side, cut by a slice."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from beltrami_cli.grid import Grid
from beltrami_cli.surface import Mesh, edge_counts, edges_of

# Where a surface shows no side of its own it is seen from the right, the front and above (RAS), as a solid on a table.
THREE_QUARTER = np.array([0.45, -0.6, 0.66])
# From where a surface may be seen: towards the viewer, in RAS, of a left hemisphere.
SIDES = {
    **{name: np.array([-1.0, 0, 0]) for name in ("left", "lateral")},
    **{name: np.array([1.0, 0, 0]) for name in ("right", "medial")},
    **{name: np.array([0, 1.0, 0]) for name in ("front", "anterior")},
    **{name: np.array([0, -1.0, 0]) for name in ("back", "posterior")},
    **{name: np.array([0, 0, 1.0]) for name in ("above", "dorsal")},
    **{name: np.array([0, 0, -1.0]) for name in ("below", "ventral")},
    "three-quarter": THREE_QUARTER,
}
# Share of the area by which one side must prevail to be the one that is looked at; a closed surface has 0.
ONE_SIDED = 0.1

# Folds are smoothed out by the heat flow of this time in mm^2, in so many steps: folds of the human cortex, 60 mm from
# gyrus to gyrus along the surface, keep under 1 %. Never more than this share of the area: a lesser brain has lesser
# folds, and a patch must keep its form.
INFLATION, INFLATION_SHARE, INFLATION_STEPS = 600.0, 0.02, 4

# Where a cortex lies in a scanner, whose origin is somewhere in the head: nowhere farther than so many mm from it along
# x, y and z; a hemisphere reaches across the midline by less than so much; and it is thicker than a slab.
HEAD, ACROSS, SLAB = (90.0, 130.0, 110.0), 10.0, 20.0

# What counts as folded: half of the integral of |mean curvature| by the root of the area, of gyri and of sulci. Convex
# surfaces and tori have no sulci, two flat banks 0.3; patches of cortex of 10,000 to 40,000 mm^2 have 4 to 16.
FOLDED = 1.5
# Heat flow, as share of the area, that takes the steps of a grid away before curvature is looked at, not the folds.
STEPS_AWAY = 1e-4

# Share of the area below which a filled place is a speck: a dot of a few pixels, whose outline would hide it.
SPECK = 1e-4


@dataclass(frozen=True, eq=False)
class View:
    """A side to look at. camera: (3, 3) rows right, up and towards the viewer, unit vectors in RAS."""

    name: str
    camera: np.ndarray


# What a surface is, and from where it is seen


def is_cortex(mesh: Mesh) -> bool:
    """True for a surface that is called a cortex, or is folded like one: gyri and sulci in like measure."""
    if mesh.structure is not None:
        return mesh.structure.startswith("Cortex")
    if mesh.cells.shape[1] != 3 or not len(mesh.cells):
        return False
    coarse, _ = simplified(mesh, 60_000)
    area = _vertex_areas(coarse)
    bend = curvature(coarse) * area
    gyri, sulci = bend[bend > 0].sum(), -bend[bend < 0].sum()
    return bool(min(gyri, sulci) > FOLDED * np.sqrt(area.sum()))


def hemisphere(mesh: Mesh) -> str | None:
    """`left` or `right`: by its structure, else by its position; None where neither tells."""
    return _hemisphere_by_name(mesh) or hemisphere_by_position(mesh)


def _hemisphere_by_name(mesh: Mesh) -> str | None:
    named = (side.lower() for side in ("Left", "Right") if (mesh.structure or "").endswith(side))
    return next(named, None)


def hemisphere_by_position(mesh: Mesh) -> str | None:
    """`left` or `right` of x = 0, where the vertices lie as those of one hemisphere in a scanner do; else None.

    Not where the structure says it, not those of a slab, and none whose coordinates have one sign along each axis: as
    a rule they count from a corner.
    """
    if _hemisphere_by_name(mesh):
        return None
    low, high = _extent(mesh)
    if not _is_in_a_head(mesh) or (low * high >= 0).all():
        return None
    return "left" if high[0] < ACROSS else "right" if low[0] > -ACROSS else None


def _has_both_hemispheres(mesh: Mesh) -> bool:
    if _hemisphere_by_name(mesh):
        return False
    on_the_left = float((_used(mesh)[:, 0] < 0).mean())
    return 0.3 < on_the_left < 0.7 and _is_in_a_head(mesh)


def _is_in_a_head(mesh: Mesh) -> bool:
    """True where the coordinates can be those of a cortex in scanner RAS, and it is no slab."""
    low, high = _extent(mesh)
    points = _used(mesh) - _used(mesh).mean(0)
    along = points @ np.linalg.eigh(points.T @ points)[1]
    thinnest = np.ptp(np.percentile(along, (1, 99), axis=0), axis=0).min()
    return bool((np.maximum(-low, high) < HEAD).all() and thinnest > SLAB)


def _extent(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """(3,) and (3,) least and greatest coordinates, but for a few."""
    low, high = np.percentile(_used(mesh), (1, 99), axis=0)
    return low, high


def views(mesh: Mesh) -> list[View]:
    """Four: lateral, medial, dorsal, posterior of a hemisphere; right, front, above, three-quarter otherwise.

    A cortex of both hemispheres hides its medial sides: it is seen from the left and the right.
    """
    names = ("right", "front", "above", "three-quarter")
    if is_cortex(mesh):
        if _has_both_hemispheres(mesh):
            names = ("left", "right", "dorsal", "posterior")
        elif hemisphere(mesh) is not None:
            names = ("lateral", "medial", "dorsal", "posterior")
    return [from_side(mesh, name) for name in names]


def from_side(mesh: Mesh, name: str) -> View:
    """The view from a side, a name in `SIDES`. Of a surface of an unknown side, lateral is away from x = 0."""
    side = hemisphere(mesh) or ("left" if np.median(_used(mesh)[:, 0]) < 0 else "right")
    mirrored = name in ("lateral", "medial") and side == "right"
    return View(name, camera(-SIDES[name] if mirrored else SIDES[name]))


def best_view(mesh: Mesh, known: np.ndarray) -> View:
    """The side to which most of the area faces whose vertices are all known (V,), or of all where none is.

    A surface without such a side is seen from three quarters.
    """
    area = area_vectors(mesh)
    chosen = known[mesh.cells].all(1)
    area = area[chosen] if chosen.any() else area
    net, total = area.sum(0), np.linalg.norm(area, axis=1).sum()
    one_sided = np.linalg.norm(net) > ONE_SIDED * total
    return View("facing the data" if one_sided else "three-quarter", camera(net if one_sided else THREE_QUARTER))


def camera(towards: np.ndarray) -> np.ndarray:
    """(3, 3) rows: right, up and towards the viewer, unit vectors in RAS.

    towards: (3,) from the surface to the viewer, of any length. Superior is up or, from above and below, anterior.
    """
    towards = towards / np.linalg.norm(towards)
    upright = np.array([0.0, 0.0, 1.0]) if abs(towards[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(upright, towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


# Other forms of a surface


def simplified(mesh: Mesh, triangles: int) -> tuple[Mesh, np.ndarray]:
    """At most about so many triangles (Garland and Heckbert 1997), and (V',) the vertex whose value each one shows.

    That is the nearest of those that were drawn together into the new vertex along edges: never one across a sulcus.
    Vertices without a triangle are left out.
    """
    from fast_simplification import replay_simplification, simplify

    used = np.unique(mesh.cells)
    cells = np.searchsorted(used, mesh.cells).astype(np.int32)
    points = mesh.vertices_ras_mm[used]
    if len(cells) <= triangles:
        return replace(mesh, vertices_ras_mm=points, cells=cells, values=None), used
    collapses = simplify(points, cells, target_count=triangles, return_collapses=True)[2]
    new_points, new_cells, became = replay_simplification(points, cells, collapses)
    distance = np.linalg.norm(new_points[became] - points, axis=1)
    order = np.lexsort((distance, became))
    first = np.searchsorted(became[order], np.arange(len(new_points)))
    return replace(mesh, vertices_ras_mm=new_points, cells=new_cells, values=None), used[order[first]]


def inflated(mesh: Mesh) -> Mesh:
    """The same vertices and cells with the folds smoothed out, of the same area and about the same centre."""
    area = float(_vertex_areas(mesh).sum())
    smooth = _smoothed(mesh, min(INFLATION, INFLATION_SHARE * area), INFLATION_STEPS)
    centre = smooth.vertices_ras_mm.mean(0)
    larger = np.sqrt(area / _vertex_areas(smooth).sum())
    return replace(smooth, vertices_ras_mm=centre + larger * (smooth.vertices_ras_mm - centre))


def curvature(mesh: Mesh) -> np.ndarray:
    """(V,) mean curvature H in 1/mm, positive where the surface bulges outwards (a gyrus); 0 at its border.

    From Laplace(x) = -2 H n, after the steps of the grid that it came from were smoothed away.
    """
    smooth = _smoothed(mesh, STEPS_AWAY * float(_vertex_areas(mesh).sum()), 2)
    weights, area = _stiffness(smooth), _vertex_areas(smooth)
    points = smooth.vertices_ras_mm
    laplacian = weights @ points - weights.sum(1)[:, None] * points
    found = -(laplacian * vertex_normals(smooth)).sum(1) / np.where(area > 0, 2 * area, np.inf)
    found[np.unique(_border_edges(mesh))] = 0
    return np.asarray(found)


def _smoothed(mesh: Mesh, time: float, steps: int) -> Mesh:
    """The heat flow of the vertices' places for a time in mm^2, by implicit steps on the metric of the start.

    A border flows as a curve of its own and the rest follows it: free, it would be drawn in and bunch up. The rim of a
    hole that would close within the time flows with the rest: it would stay behind as a spike.
    """
    from scipy.sparse import coo_array, diags_array
    from scipy.sparse.linalg import splu

    count = len(mesh.vertices_ras_mm)
    edges = _long_borders(mesh, 2 * np.pi * np.sqrt(time))
    on_border = np.zeros(count, bool)
    on_border[edges] = True
    length = _lengths(mesh, edges)
    rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
    along = coo_array((np.tile(1 / np.maximum(length, 1e-9), 2), (rows, columns)), (count, count))
    across = diags_array((~on_border).astype(float)) @ _stiffness(mesh)
    weights = (along + across).tocsc()
    mass = np.where(on_border, np.bincount(rows, np.tile(length, 2), count) / 2, _vertex_areas(mesh))
    mass = np.where(mass > 0, mass, mass[mass > 0].min(initial=1.0))
    step = time / steps
    matrix = (diags_array(mass + step * weights.sum(1)) - step * weights).tocsc()
    # Its diagonal dominates: no need to pivot, which would take 100 times as long.
    factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    points = mesh.vertices_ras_mm
    for _ in range(steps):
        points = factors.solve(mass[:, None] * points)
    return replace(mesh, vertices_ras_mm=points)


def _long_borders(mesh: Mesh, least: float) -> np.ndarray:
    """(N, 2) edges of those borders that are longer than this in mm."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges, count = _border_edges(mesh), len(mesh.vertices_ras_mm)
    linked = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (count, count))
    border = connected_components(linked, directed=False)[1][edges[:, 0]]
    return edges[np.bincount(border, _lengths(mesh, edges), count)[border] > least]


def _lengths(mesh: Mesh, edges: np.ndarray) -> np.ndarray:
    """(N,) mm."""
    return np.linalg.norm(mesh.vertices_ras_mm[edges[:, 1]] - mesh.vertices_ras_mm[edges[:, 0]], axis=1)


def _stiffness(mesh: Mesh) -> Any:
    """(V, V) sparse cotangent weights between neighbours, kept within 0.01 to 10: a sliver's have no bounds."""
    import igl
    from scipy.sparse import coo_array

    found = coo_array(igl.cotmatrix(mesh.vertices_ras_mm, mesh.cells.astype(np.int64)))
    rows, columns = found.coords
    apart = rows != columns
    weights = np.clip(np.nan_to_num(found.data[apart], nan=0.01), 0.01, 10.0)
    return coo_array((weights, (rows[apart], columns[apart])), found.shape).tocsr()


def _border_edges(mesh: Mesh) -> np.ndarray:
    """(N, 2) edges with one triangle."""
    edges, triangles = edge_counts(mesh.cells)
    return edges[triangles == 1]


# Areas and normals


def area_vectors(mesh: Mesh) -> np.ndarray:
    """(C, 3) normals of triangles, as long as their area in mm^2."""
    a, b, c = (mesh.vertices_ras_mm[mesh.cells[:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


def vertex_normals(mesh: Mesh) -> np.ndarray:
    """(V, 3) unit normals, the mean of the triangles around each vertex by area; 0 at a vertex without any."""
    corners, area = mesh.cells.reshape(-1), area_vectors(mesh)
    sums = [np.bincount(corners, np.repeat(area[:, axis], 3), len(mesh.vertices_ras_mm)) for axis in range(3)]
    normals = np.stack(sums, 1)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


def is_open(mesh: Mesh) -> bool:
    """True for a surface with a border."""
    return bool(len(_border_edges(mesh)))


def outwards(mesh: Mesh) -> float:
    """How much the triangles face away from the middle: 1 of a ball, -1 of one inside out, 0 of a flat patch."""
    areas = area_vectors(mesh)
    away = mesh.vertices_ras_mm[mesh.cells].mean(1) - _used(mesh).mean(0)
    most = (np.linalg.norm(areas, axis=1) * np.linalg.norm(away, axis=1)).sum()
    return float((areas * away).sum() / max(most, 1e-30))


def _vertex_areas(mesh: Mesh) -> np.ndarray:
    """(V,) a third of the area of the triangles around each vertex, mm^2."""
    area = np.linalg.norm(area_vectors(mesh), axis=1)
    return np.bincount(mesh.cells.reshape(-1), np.repeat(area, 3), len(mesh.vertices_ras_mm)) / 3


def _used(mesh: Mesh) -> np.ndarray:
    """The vertices that cells have."""
    return mesh.vertices_ras_mm[np.unique(mesh.cells)]


# Lines on a surface


def is_filled(mesh: Mesh, filled: np.ndarray) -> bool:
    """True where more of the surface was filled, (V,) bool, than a speck."""
    area = _vertex_areas(mesh)
    return bool(area[filled].sum() > SPECK * area.sum())


def filled_border(mesh: Mesh, filled: np.ndarray) -> np.ndarray:
    """(S, 2, 3) segments in RAS mm around places that were filled, (V,) bool; specks are left out."""
    return filled_border_and_cells(mesh, filled)[0]


def filled_border_and_cells(mesh: Mesh, filled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The same, and (S,) the triangle of each: one with both kinds of corner, cut half way from its odd one."""
    filled = _without_specks(mesh, filled)
    corners = filled[mesh.cells]
    (mixed,) = np.nonzero(corners.any(1) & ~corners.all(1))
    cells, corners = mesh.cells[mixed], corners[mixed]
    odd = np.argmax(corners == (corners.sum(1) == 1)[:, None], axis=1)
    alone, b, c = (mesh.vertices_ras_mm[np.take_along_axis(cells, (odd[:, None] + k) % 3, 1)[:, 0]] for k in range(3))
    return np.stack([alone + b, alone + c], 1) / 2, mixed


def _without_specks(mesh: Mesh, filled: np.ndarray) -> np.ndarray:
    """The same places (V,) without those that are smaller than SPECK of the area."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    edges, area = edges_of(mesh.cells), _vertex_areas(mesh)
    edges = edges[filled[edges].all(1)]
    linked = coo_array((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (len(filled), len(filled)))
    place = connected_components(linked, directed=False)[1]
    return filled & (np.bincount(place, area)[place] > SPECK * area.sum())


def outline(mesh: Mesh, grid: Grid, axis: int, index: float) -> tuple[np.ndarray, np.ndarray]:
    """Where a slice of a volume cuts the surface, and (S,) the triangle of each segment.

    axis, index: of the slice, at the centre of its voxels. (S, 2, 2) ends of segments along the two other axes, in mm
    from the centre of the first voxel. Of a curve in a plane: all of its segments.
    """
    from trimesh import Trimesh
    from trimesh.intersections import mesh_plane

    points = grid.to_index(mesh.vertices_ras_mm) * grid.spacing
    if mesh.cells.shape[1] == 2:
        return np.delete(points, axis, 1)[mesh.cells], np.arange(len(mesh.cells))
    normal = np.eye(3)[axis]
    cut, cell = mesh_plane(
        Trimesh(points, mesh.cells, process=False), normal, normal * index * grid.spacing, return_faces=True
    )
    return np.delete(np.asarray(cut).reshape(-1, 2, 3), axis, 2), np.asarray(cell, int)
