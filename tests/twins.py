"""Twin grids: the same block of the world, indexed along differently oriented axes."""

from __future__ import annotations

import numpy as np

from beltrami_cli.grid import Grid, Volume

SHAPE = (5, 7, 6)
SPACING_MM = (1.0, 1.25, 2.0)
_CENTRE_MM = np.array([11.0, -23.0, 37.0])


def _rotation(degrees: float, axis: int) -> np.ndarray:
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.eye(3)
    matrix[[first, first, second, second], [first, second, first, second]] = c, -s, s, c
    return matrix


def _grid(axes: np.ndarray) -> Grid:
    affine = np.eye(4)
    affine[:3, :3] = axes * SPACING_MM
    affine[:3, 3] = _CENTRE_MM - affine[:3, :3] @ ((np.array(SHAPE) - 1) / 2)
    return Grid(SHAPE, affine)


_OBLIQUE = _rotation(38.0, 0) @ _rotation(-17.0, 1) @ _rotation(8.0, 2)

TWINS = {
    "RAS": _grid(np.eye(3)),
    "LAS": _grid(np.diag([-1.0, 1.0, 1.0])),
    "LPS": _grid(np.diag([-1.0, -1.0, 1.0])),
    "PSR": _grid(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])),
    "oblique": _grid(_OBLIQUE),
    "oblique left-handed": _grid(_OBLIQUE @ np.diag([-1.0, 1.0, 1.0])),
}


def voxels(grid: Grid) -> np.ndarray:
    """(N, 3) indices of every voxel, in C order."""
    return np.indices(grid.shape).reshape(3, -1).T


def field(ras_mm: np.ndarray) -> np.ndarray:
    """A value for each point of the world, different along each axis."""
    x, y, z = np.asarray(ras_mm).T
    return 3.0 * x - 5.0 * y + 7.0 * z + 0.1 * x * y


def volume(grid: Grid) -> Volume:
    """`field` on the grid, float32."""
    return Volume(field(grid.to_world(voxels(grid))).reshape(grid.shape).astype(np.float32), grid)
