"""The surface as a mesh in world space, with the values that lie on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beltrami_cli.band import Band
from beltrami_cli.kernels import interpolate
from beltrami_cli.kernels.sheets import entries_at_vertices


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangulated surface, or a polyline where the surface is a curve in a plane.

    vertices_ras_mm: (V, 3) float64 in RAS mm.
    cells: (C, 3) int32 triangles, counter-clockwise seen from outside; (C, 2) segments for a curve.
    values: (V,) data values, NaN where missing; None for geometry alone.
    """

    vertices_ras_mm: np.ndarray
    cells: np.ndarray
    values: np.ndarray | None = None


def surface_mesh(band: Band, values: np.ndarray | None = None) -> Mesh:
    """The band's surface in world space, facing outwards (increasing Psi), with `values` (E,) sampled on its own sheets.

    Vertices get the local cubic of the entries around them, the trilinear mean where its stencil is incomplete, NaN
    where no entry is near.
    """
    surface = band.surface
    if surface is None:
        raise ValueError("a flat band has no surface")
    low = np.array([part.start for part in band.box])
    ijk = surface.points / band.grid.spacing
    cells = surface.cells if band.grid.handedness > 0 else np.ascontiguousarray(surface.cells[:, ::-1])
    at_vertices = None if values is None else sample_at_vertices(band, ijk, values)
    return Mesh(band.grid.to_world(ijk + low), cells, at_vertices)


def sample_at_vertices(band: Band, ijk: np.ndarray, values: np.ndarray) -> np.ndarray:
    """(V,) `values` (E,) at the surface's vertices, `ijk` (V, 3) in voxels of the box."""
    assert band.surface is not None
    shape = band.box_shape
    start, offset = entries_at_vertices(
        band.voxel, band.vertex, band.first, shape, band.grid.spacing, band.surface.points, ijk
    )
    out = np.full(len(ijk), np.nan, values.dtype)
    found = start >= 0
    reached, start, offset = out[found], start[found], np.ascontiguousarray(offset[:, found])
    interpolate.linear(values, start, offset, band.forward, band.backward, 0.0, reached)
    origin = interpolate.stencil_origins(start, offset, band.forward, band.backward, band.nodes)
    interpolate.cubic(values, origin, offset, band.forward, band.nodes, reached)
    out[found] = reached
    return out
