"""The surface of a band as a mesh in world space, with the band's values sampled at its vertices."""

from __future__ import annotations

import numpy as np

from beltrami_cli.band import Band
from beltrami_cli.kernels import interpolate
from beltrami_cli.kernels.sheets import entries_at_vertices
from beltrami_cli.surface import Mesh


def surface_mesh(band: Band, values: np.ndarray | None = None) -> Mesh:
    """The band's surface in world space, facing outwards (increasing Psi), with `values` (E,) sampled on its sheets.

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
