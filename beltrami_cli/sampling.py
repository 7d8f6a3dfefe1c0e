"""The band's values at points of its surface: vertices of its own mesh, and of any other mesh of that surface."""

from __future__ import annotations

import numpy as np

from beltrami_cli.band import Band
from beltrami_cli.kernels import interpolate
from beltrami_cli.kernels import mesh as meshes
from beltrami_cli.kernels.sheets import entries_at_points
from beltrami_cli.levelset import facing
from beltrami_cli.surface import Mesh

# Of the surface's vertices nearest to a point, so many are asked whether they face the same way as it does: a bank that
# lies nearer than one's own has few more before one's own turns up.
NEAREST = 16


class SurfacePoints:
    """Points (N, 3), in voxels of the band's box, on the sheets of the surface's vertices own (N,)."""

    def __init__(self, band: Band, ijk: np.ndarray, own: np.ndarray) -> None:
        assert band.surface is not None
        self.band = band
        self.start, self.offset = entries_at_points(
            band.voxel, band.vertex, band.first, band.box_shape, band.grid.spacing, band.surface.points, ijk, own
        )
        self.origin = np.full(len(ijk), -1, np.int32)
        found = self.start >= 0
        self.origin[found] = interpolate.stencil_origins(
            self.start[found], np.ascontiguousarray(self.offset[:, found]), band.forward, band.backward, band.nodes
        )

    def some(self, which: np.ndarray) -> SurfacePoints:
        """These points of them, by number."""
        part = object.__new__(SurfacePoints)
        part.band, part.start, part.origin = self.band, self.start[which], self.origin[which]
        part.offset = np.ascontiguousarray(self.offset[:, which])
        return part

    def __call__(self, values: np.ndarray, *, turns: bool = False) -> np.ndarray:
        """(K, N) of the band's values (K, E), NaN where missing.

        The local cubic of the entries around a point, the trilinear mean where its stencil is incomplete, NaN where no
        entry is near. turns: see `Reextension`.
        """
        band = self.band
        total, mass = np.zeros((len(values), len(self.start))), np.zeros(len(self.start))
        there = (~np.isnan(values[0])).astype(values.dtype)
        interpolate.linear(values, there, self.start, self.offset, band.forward, band.backward, 0.0, total, mass)
        with np.errstate(invalid="ignore"):
            out = (total / mass).astype(values.dtype)
        size = np.sqrt((values**2).sum(0)) if turns else np.empty(0, values.dtype)
        interpolate.cubic(values, size, self.origin, self.offset, band.forward, band.nodes, out)
        return out


def own_vertices(band: Band) -> SurfacePoints:
    """The vertices of the band's own surface."""
    assert band.surface is not None
    points = band.surface.points
    return SurfacePoints(band, points / band.grid.spacing, np.arange(len(points)))


def vertices_of(band: Band, mesh: Mesh) -> SurfacePoints:
    """The vertices of another mesh of the same surface, or of one beside it within the band, in RAS mm.

    A vertex belongs to the sheet of the surface's nearest vertex whose normal is not opposed to its own, so that one in
    a sulcus does not take the value of the bank across; none where that is farther than the band is wide.
    """
    from scipy.spatial import cKDTree

    surface = band.surface
    assert surface is not None
    ijk = band.grid.to_index(mesh.vertices_ras_mm) - [part.start for part in band.box]
    points = ijk * band.grid.spacing
    apart, near = cKDTree(surface.points).query(points, k=min(NEAREST, len(surface.points)))
    apart, near = apart.reshape(len(points), -1), near.reshape(len(points), -1)
    normals = meshes.face_normals(points, facing(mesh.cells, band.grid))
    alike = (surface.normals[near] * normals[:, None]).sum(-1) >= 0
    best = np.where(alike.any(1), alike.argmax(1), 0)  # a lone vertex has no normal: the nearest one
    row = np.arange(len(points))
    reach = band.half_width + 0.5 * float(band.grid.spacing.max())
    own = near[row, best]
    found = SurfacePoints(band, ijk, own)
    found.start[apart[row, best] > reach] = -1
    found.origin[found.start < 0] = -1
    return found


def surface_mesh(
    band: Band, values: np.ndarray | None = None, *, turns: bool = False
) -> tuple[Mesh, np.ndarray | None]:
    """The band's surface in world space, facing outwards (increasing Psi), and `values` (K, E) at its vertices, (K, V).

    turns: see `Reextension`. Raises ValueError for a flat band.
    """
    surface = band.surface
    if surface is None:
        raise ValueError("a flat band has no surface")
    low = np.array([part.start for part in band.box])
    ijk = surface.points / band.grid.spacing
    mesh = Mesh(band.grid.to_world(ijk + low), facing(surface.cells, band.grid))
    return mesh, None if values is None else own_vertices(band)(values, turns=turns)
