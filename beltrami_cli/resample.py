"""Bringing a volume onto another grid."""

from __future__ import annotations

import numpy as np

from beltrami_cli.grid import Grid, Volume

# A voxel counts as seen by the source when at least this share of its trilinear weight fell on finite values.
LEAST_SEEN = 0.5


def resample(volume: Volume, grid: Grid, *, period: float | None = None) -> Volume:
    """The volume's values on `grid` by trilinear interpolation in world space; NaN outside it and beside its NaN.

    Missing values take no part: weights are normalised over the finite ones. Channels are interpolated one by one.
    period: the values are angles of this period; their mean direction is taken, in -P/2 .. P/2 where some value is
    negative, else in 0 .. P (P itself left out).
    """
    data = volume.data
    if period is None:
        return Volume(_each_channel(data, volume.grid, grid).astype(data.dtype, copy=False), grid)
    finite = np.isfinite(data)
    turn = 2 * np.pi / period
    directions = np.exp(1j * turn * np.where(finite, data, 0)).astype(np.result_type(data, np.complex64))
    mean = _each_channel(np.where(finite, directions, np.nan), volume.grid, grid)
    low = -period / 2 if (data[finite] < 0).any() else 0.0
    angles = ((np.angle(mean) / turn - low) % period + low).astype(data.dtype)
    # Rounding may reach the end that is not in the range.
    return Volume(np.where(angles >= low + period, angles.dtype.type(low), angles), grid)


def _each_channel(data: np.ndarray, source: Grid, grid: Grid) -> np.ndarray:
    """Trilinear interpolation of (nx, ny, nz) or (nx, ny, nz, K), real or complex."""
    to_source = np.linalg.inv(source.affine) @ grid.affine
    if data.ndim == 3:
        return _trilinear(data, to_source, grid.shape)
    return np.stack([_trilinear(data[..., k], to_source, grid.shape) for k in range(data.shape[3])], -1)


def _trilinear(data: np.ndarray, to_source: np.ndarray, shape: tuple[int, int, int]) -> np.ndarray:
    """data at the voxels of another grid; to_source: from their indices to those of data."""
    from scipy.ndimage import affine_transform

    finite = np.isfinite(data)

    def at_grid(values: np.ndarray) -> np.ndarray:
        return affine_transform(
            values, to_source[:3, :3], to_source[:3, 3], output_shape=shape, order=1, mode="grid-constant"
        )

    seen = at_grid(finite.astype(data.real.dtype))
    total = at_grid(np.where(finite, data, 0))
    return np.where(seen >= LEAST_SEEN, total / np.where(seen > 0, seen, 1), np.nan)
