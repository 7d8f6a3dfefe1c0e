"""The band's values at points of its surface: vertices of its own mesh, and of any other mesh of that surface."""

from __future__ import annotations

import numpy as np

from beltrami_cli.band import Band
from beltrami_cli.kernels import interpolate
from beltrami_cli.kernels import mesh as meshes
from beltrami_cli.kernels.sheets import entries_at_points
from beltrami_cli.levelset import ZeroSurface, facing
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
            band.voxel,
            band.vertex,
            band.first,
            band.normal,
            band.box_shape,
            band.grid.spacing,
            band.surface.points,
            band.surface.normals,
            band.surface.piece,
            ijk,
            own,
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
        out[:, there[self.start] == 0] = np.nan
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
    mesh.require_triangles()
    surface = band.surface
    assert surface is not None
    ijk = band.grid.to_index(mesh.vertices_ras_mm) - [part.start for part in band.box]
    points = ijk * band.grid.spacing
    normals = meshes.face_normals(points, facing(mesh.cells, band.grid))
    own = _own_vertices(surface, points, normals, band.half_width + 0.5 * float(band.grid.spacing.max()))
    found = SurfacePoints(band, ijk, own)
    found.start[own < 0] = found.origin[own < 0] = -1
    return found


def _own_vertices(surface: ZeroSurface, points: np.ndarray, normals: np.ndarray, reach: float) -> np.ndarray:
    """(N,) the surface's vertex nearest to each point (N, 3) within `reach` mm that faces as it does; -1 for none.

    Where the mesh faces the other way as a whole its normals are turned: those of its vertices that see one bank only
    say so. A lone vertex (a normal of 0) has the nearest.
    """
    from scipy.spatial import cKDTree

    tree = cKDTree(surface.points)
    gap, near = tree.query(points, k=min(NEAREST, len(surface.points)), distance_upper_bound=reach)
    gap, near = gap.reshape(len(points), -1), near.reshape(len(points), -1)
    there = np.isfinite(gap)
    facing_them = (surface.normals[np.where(there, near, 0)] * normals[:, None]).sum(-1)
    side = np.where(there, np.sign(facing_them), 0).sum(1)
    alone = there[:, 0] & (np.abs(side) == there.sum(1))
    if side[alone].sum() < 0:
        normals = -normals
    own = np.where(there[:, 0], near[:, 0], -1)
    opposed = (surface.normals[own] * normals).sum(1) < 0
    asked, among = np.flatnonzero((own >= 0) & opposed), NEAREST
    own[asked] = -1
    while len(asked):
        gap, near = tree.query(points[asked], k=min(among, len(surface.points)), distance_upper_bound=reach)
        there = np.isfinite(gap).reshape(len(asked), -1)
        near = near.reshape(len(asked), -1)
        alike = there & ((surface.normals[np.where(there, near, 0)] * normals[asked, None]).sum(-1) >= 0)
        found = alike.any(1)
        own[asked[found]] = near[found, alike[found].argmax(1)]
        asked = asked[~found & there[:, -1]] if among < len(surface.points) else asked[:0]
        among *= 4
    return own


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
