"""The surface of a band as a mesh in world space, with the band's values sampled at its vertices."""

from __future__ import annotations

import numpy as np

from beltrami_cli.band import Band
from beltrami_cli.kernels import interpolate
from beltrami_cli.kernels.sheets import entries_at_vertices
from beltrami_cli.surface import Mesh


def surface_mesh(
    band: Band, values: np.ndarray | None = None, *, turns: bool = False
) -> tuple[Mesh, np.ndarray | None]:
    """The band's surface in world space, facing outwards (increasing Psi), and `values` (K, E) at its vertices, (K, V).

    Vertices get the local cubic of the entries around them, the trilinear mean where its stencil is incomplete, NaN
    where no entry is near. turns: see `Reextension`.
    """
    surface = band.surface
    if surface is None:
        raise ValueError("a flat band has no surface")
    low = np.array([part.start for part in band.box])
    ijk = surface.points / band.grid.spacing
    cells = surface.cells if band.grid.handedness > 0 else np.ascontiguousarray(surface.cells[:, ::-1])
    at_vertices = None if values is None else sample_at_vertices(band, ijk, values, turns=turns)
    return Mesh(band.grid.to_world(ijk + low), cells), at_vertices


def sample_at_vertices(band: Band, ijk: np.ndarray, values: np.ndarray, *, turns: bool = False) -> np.ndarray:
    """(K, V) `values` (K, E), NaN where missing, at the surface's vertices, `ijk` (V, 3) in voxels of the box."""
    assert band.surface is not None
    shape = band.box_shape
    start, offset = entries_at_vertices(
        band.voxel, band.vertex, band.first, shape, band.grid.spacing, band.surface.points, ijk
    )
    total, mass = np.zeros((len(values), len(ijk))), np.zeros(len(ijk))
    there = (~np.isnan(values[0])).astype(values.dtype)
    interpolate.linear(values, there, start, offset, band.forward, band.backward, 0.0, total, mass)
    with np.errstate(invalid="ignore"):
        out = (total / mass).astype(values.dtype)
    origin = np.full(len(ijk), -1, np.int32)
    found = start >= 0
    origin[found] = interpolate.stencil_origins(
        start[found], np.ascontiguousarray(offset[:, found]), band.forward, band.backward, band.nodes
    )
    size = np.sqrt((values**2).sum(0)) if turns else np.empty(0, values.dtype)
    interpolate.cubic(values, size, origin, offset, band.forward, band.nodes, out)
    return out
