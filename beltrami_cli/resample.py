"""Bringing a volume onto another grid."""

from __future__ import annotations

import numpy as np

from beltrami_cli.grid import Grid, Volume

# A voxel counts as seen by the source when at least this share of its trilinear weight fell on finite values.
LEAST_SEEN = 0.5


def resample(volume: Volume, grid: Grid) -> Volume:
    """The volume's values on `grid` by trilinear interpolation in world space; NaN outside it and beside its NaN.

    Missing values take no part: weights are normalised over the finite ones.
    """
    from scipy.ndimage import affine_transform

    to_source = np.linalg.inv(volume.grid.affine) @ grid.affine
    finite = np.isfinite(volume.data)

    def at_grid(values: np.ndarray) -> np.ndarray:
        return affine_transform(
            values, to_source[:3, :3], to_source[:3, 3], output_shape=grid.shape, order=1, mode="grid-constant"
        )

    seen = at_grid(finite.astype(volume.data.dtype))
    total = at_grid(np.where(finite, volume.data, 0))
    data = np.where(seen >= LEAST_SEEN, total / np.where(seen > 0, seen, 1), np.nan).astype(volume.data.dtype)
    return Volume(data, grid)
