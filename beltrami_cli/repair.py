"""Meshes as files have them, made fit for distances: usable triangles, facing one way, small holes closed over."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass

import numpy as np

from beltrami_cli.errors import DataError
from beltrami_cli.surface import Mesh, volumes

# A hole is a defect, and closed, where the fan over its rim has at most this share of the area of the piece that it is
# in. The medial wall cut out of a hemisphere has 5 % or more; the fan over the border of a patch, about its area.
HOLE_SHARE = 0.02
# Pieces with a border that make up no more than this share of a surface which is closed but for them are debris.
DEBRIS_SHARE = 0.01


@dataclass(frozen=True, eq=False)
class Repaired:
    """A surface of triangles with an area, all facing one way where that can be.

    vertices: (V, 3) float64, mm. cells: (C, 3) int64. border: (B, 2) int64, the directed edges where an open surface
    ends; none where it is closed, and then it faces outwards. inside_out: what is meant to be inside is what lies
    beyond it.
    """

    vertices: np.ndarray
    cells: np.ndarray
    border: np.ndarray
    inside_out: bool = False

    @property
    def is_closed(self) -> bool:
        return not len(self.border)


def repaired(mesh: Mesh, *, as_faced: bool = False) -> Repaired:
    """The mesh without what has no place in a surface, triangles turned that face against their neighbours.

    Coinciding vertices become one, triangles of vertices that are not finite, of less than three vertices, or there
    twice are left out. Holes are closed with a fan around the middle of their rim where `HOLE_SHARE` calls them small.
    as_faced: the way that a closed surface faces is meant, as one's from a volume; else it is turned to face outwards,
    piece by piece. Raises DataError where no triangle with an area is left.
    """
    vertices, cells = _usable(mesh)
    cells = _facing_one_way(vertices, cells)
    vertices, cells = _closed_over(vertices, cells)
    cells = _without_debris(vertices, cells)
    border = _border(vertices, cells)
    inside_out = False
    if not len(border) and not as_faced:
        cells = _facing_outwards(vertices, cells)
    elif not len(border) and volumes(vertices, cells).sum() < 0:
        cells, inside_out = cells[:, ::-1], True
    # Only now: triangles without area tell what is connected to what.
    cells = cells[areas(vertices, cells) > 0]
    if not len(cells):
        raise DataError("the surface has no triangle with an area; expected a surface in three dimensions")
    return Repaired(vertices, np.ascontiguousarray(cells), border, inside_out)


def areas(vertices: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """(C,) areas of triangles, mm^2."""
    a, b, c = (vertices[cells[:, k]] for k in range(3))
    return np.asarray(np.linalg.norm(np.cross(b - a, c - a), axis=1) / 2)


def edges(cells: np.ndarray) -> np.ndarray:
    """(3, C, 2) directed edges of triangles, each opposite of the corner of its number."""
    return np.stack([cells[:, [1, 2]], cells[:, [2, 0]], cells[:, [0, 1]]])


def _usable(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Distinct vertices, and triangles of three of them, each once."""
    vertices = np.asarray(mesh.vertices_ras_mm, np.float64)
    cells = np.asarray(mesh.cells, np.int64)
    if cells.ndim != 2 or cells.shape[1] != 3:
        raise DataError("the surface has no triangles (a curve or bare points); expected a triangulated surface")
    finite = np.all(np.isfinite(vertices), axis=1)
    cells = cells[finite[cells].all(1)]
    used, cells = np.unique(cells, return_inverse=True)
    vertices, same = np.unique(vertices[used] + 0.0, axis=0, return_inverse=True)  # + 0.0: -0.0 is 0.0
    cells = same.reshape(-1)[cells.reshape(-1, 3)]
    a, b, c = cells.T
    cells = cells[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(_codes(np.sort(cells, 1), len(vertices)), return_index=True)
    if not len(first):
        raise DataError("the surface has no triangle between three distinct, finite vertices; expected a mesh")
    return vertices, cells[np.sort(first)]


def _facing_one_way(vertices: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Triangles turned where neighbours disagree: in every piece, the side that has the larger area stays."""
    directed = edges(cells).reshape(-1, 2)
    if len(np.unique(_codes(directed, len(vertices)))) == len(directed):
        return cells
    import igl

    turned, piece = igl.bfs_orient(cells)
    area = areas(vertices, cells) * np.where((turned != cells).any(1), -1, 1)
    wrong = np.bincount(piece, area)[piece] < 0
    turned[wrong] = turned[wrong, ::-1]
    return turned


def _facing_outwards(vertices: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Closed pieces that face inwards turned, each with all that lies within it: cavities stay cavities."""
    import igl

    piece = igl.facet_components(cells)[1]
    volume = np.bincount(piece, volumes(vertices, cells))
    if (volume >= 0).all():
        return cells
    parts = np.split(np.argsort(piece, kind="stable"), np.cumsum(np.bincount(piece))[:-1])
    low, high = (np.array([end(vertices[cells[part, 0]], 0) for part in parts]) for end in (np.min, np.max))
    cells, left = cells.copy(), np.ones(len(parts), bool)
    for outer in np.argsort(-np.abs(volume)):
        if not left[outer]:
            continue
        left[outer] = False
        inner = np.flatnonzero(left & np.all((low > low[outer]) & (high < high[outer]), axis=1))
        if len(inner):
            points = np.concatenate([vertices[cells[parts[k], 0]] for k in inner])
            around = np.abs(igl.fast_winding_number(vertices, cells[parts[outer]], points)) > 0.5
            inner = np.setdiff1d(inner, np.repeat(inner, [len(parts[k]) for k in inner])[~around])
            left[inner] = False
        if volume[outer] < 0:
            turned = np.concatenate([parts[k] for k in (outer, *inner)])
            cells[turned] = cells[turned, ::-1]
    return cells


def _border(vertices: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """(B, 2) directed edges that are not met by their reverse: the boundary of the triangles as a chain."""
    directed = edges(cells).reshape(-1, 2)
    rising = directed[:, 0] < directed[:, 1]
    pair, first, number = np.unique(_codes(np.sort(directed, 1), len(vertices)), return_index=True, return_inverse=True)
    excess = np.bincount(number, np.where(rising, 1, -1), len(pair)).astype(np.int64)
    ends = np.sort(directed[first], 1)
    return np.repeat(np.where(excess[:, None] > 0, ends, ends[:, ::-1]), np.abs(excess), axis=0)


def _codes(rows: np.ndarray, count: int) -> np.ndarray:
    """(N,) one number for each row (N, 2) or (N, 3) of numbers below `count`: sorted a hundred times faster."""
    codes = rows[:, 0]
    for column in rows.T[1:]:
        codes = np.unique(codes, return_inverse=True)[1] * count + column  # counted anew, or a third would overflow
    return codes


def _loops(border: np.ndarray) -> list[np.ndarray]:
    """Simple cycles of directed edges: as many edges leave a vertex as arrive, for a boundary has none itself."""
    following: dict[int, list[int]] = defaultdict(list)
    for a, b in border.tolist():
        following[a].append(b)
    loops = []
    for start in list(following):
        while following[start]:
            path, place = [start], {start: 0}
            while following[path[-1]]:
                vertex = following[path[-1]].pop()
                if vertex in place:  # two holes may meet in a vertex: a cycle ends where it comes back to itself
                    loops.append(np.array(path[place[vertex] :]))
                    for passed in path[place[vertex] + 1 :]:
                        del place[passed]
                    del path[place[vertex] + 1 :]
                else:
                    place[vertex] = len(path)
                    path.append(vertex)
    return loops


def _closed_over(vertices: np.ndarray, cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and cells with fans over the small holes."""
    piece = _pieces(len(vertices), cells)
    piece_area = np.bincount(piece[cells[:, 0]], areas(vertices, cells), len(vertices))
    middles: list[np.ndarray] = []
    fans: list[np.ndarray] = []
    for loop in _loops(_border(vertices, cells)):
        rim = vertices[loop]
        middle = rim.mean(0)
        fan = np.linalg.norm(np.cross(rim - middle, np.roll(rim, -1, 0) - middle), axis=1).sum() / 2
        if fan > HOLE_SHARE * piece_area[piece[loop[0]]]:
            continue
        centre = np.full(len(loop), len(vertices) + len(middles))
        fans.append(np.stack([np.roll(loop, -1), loop, centre], 1))
        middles.append(middle)
    if not fans:
        return vertices, cells
    return np.concatenate([vertices, np.array(middles)]), np.concatenate([cells, *fans])


def _without_debris(vertices: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Cells without the pieces that have a border, where they are next to nothing."""
    border = _border(vertices, cells)
    if not len(border):
        return cells
    piece = _pieces(len(vertices), cells)
    is_open = np.isin(piece[cells[:, 0]], piece[border])
    area = areas(vertices, cells)
    return cells[~is_open] if area[is_open].sum() <= DEBRIS_SHARE * area.sum() else cells


def _pieces(count: int, cells: np.ndarray) -> np.ndarray:
    """(V,) the number of the connected piece that each vertex belongs to."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    ends = edges(cells).reshape(-1, 2).T
    graph = coo_array((np.ones(ends.shape[1], np.int8), (ends[0], ends[1])), shape=(count, count))
    return np.asarray(connected_components(graph, directed=False)[1])
