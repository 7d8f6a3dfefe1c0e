"""The surface as a mesh in world space, with the values that lie on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beltrami_cli.errors import DataError, RefusedError


def edge_counts(cells: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 2) edges of triangles (C, 3), each once, its smaller vertex first, in order; how many triangles have each."""
    ends = np.sort(cells[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1).astype(np.int64)
    count = int(ends.max(initial=0)) + 1
    codes, triangles = np.unique(ends[:, 0] * count + ends[:, 1], return_counts=True)
    return np.stack(np.divmod(codes, count), 1), triangles


def edges_of(cells: np.ndarray) -> np.ndarray:
    """(N, 2) edges of triangles (C, 3), as `edge_counts` has them."""
    return edge_counts(cells)[0]


def volumes(vertices: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """(C,) mm^3 below each triangle: the sum is what a closed surface holds, negative where it faces inwards."""
    a, b, c = (vertices[cells[:, k]] - vertices.mean(0) for k in range(3))
    return np.asarray((np.cross(a, b) * c).sum(1) / 6)


def faces_inwards(mesh: Mesh) -> bool:
    """True for a closed surface of triangles whose corners run clockwise seen from outside."""
    is_closed = 2 * len(edges_of(mesh.cells)) == 3 * len(mesh.cells)
    return is_closed and float(volumes(mesh.vertices_ras_mm, mesh.cells).sum()) < 0


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangulated surface, or a polyline where the surface is a curve in a plane.

    vertices_ras_mm: (V, 3) float64 in RAS mm.
    cells: (C, 3) int32 triangles, counter-clockwise seen from outside; (C, 2) segments for a curve.
    values: (V,) data values, or (V, K) of K channels or frames, real, NaN where missing; None for geometry alone.
    structure: the part of the brain in GIFTI's names, as CortexLeft; None where unknown.
    placed: False where the vertices are as a file had them that does not say in which space.
    """

    vertices_ras_mm: np.ndarray
    cells: np.ndarray
    values: np.ndarray | None = None
    structure: str | None = None
    placed: bool = True

    def __post_init__(self) -> None:
        """Raises RefusedError for arrays of other shapes, and for cells that name vertices which are not there."""
        vertices, cells = np.asarray(self.vertices_ras_mm, float), np.asarray(self.cells)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or cells.ndim != 2 or cells.shape[1] not in (2, 3):
            raise RefusedError(
                f"mesh: found vertices of shape {vertices.shape} and cells of shape {cells.shape}; "
                "expected (V, 3) and (C, 3), or (C, 2) for a curve"
            )
        if cells.dtype.kind not in "iu" or (cells.size and not 0 <= cells.min() <= cells.max() < len(vertices)):
            raise RefusedError(
                f"mesh: its cells name vertices that are not there; expected whole numbers below {len(vertices)}"
            )
        object.__setattr__(self, "vertices_ras_mm", vertices)
        object.__setattr__(self, "cells", np.ascontiguousarray(cells, np.int32))

    def require_triangles(self) -> None:
        """Raise DataError unless the cells are triangles between vertices at finite places."""
        if self.cells.shape[1] != 3 or not len(self.cells):
            raise DataError("the surface has no triangles; expected a triangulated surface")
        if not np.isfinite(self.vertices_ras_mm[self.cells]).all():
            raise DataError("the surface has triangles whose vertices lie at no finite place; repair or remove them")

    def named_values(self) -> dict[str, np.ndarray]:
        """(V,) values by name: `value`, or `value 1`, `value 2` ... of several channels; empty for geometry alone."""
        if self.values is None:
            return {}
        if self.values.ndim == 1:
            return {"value": self.values}
        return {f"value {k + 1}": self.values[:, k] for k in range(self.values.shape[1])}
