"""A volume's values elsewhere in the world: on another grid, or at points."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from beltrami_cli.grid import Grid, Volume
from beltrami_cli.kinds import Kind

# A place counts as seen by the source when at least this share of its trilinear weight fell on finite values; the
# margin leaves a place midway between a value and none to the rule, whichever way the weights were rounded.
LEAST_SEEN = 0.5
_ROUNDING = 1e-6

# Values at given voxel indices of an array (nx, ny, nz), real or complex; 0 beyond its voxels.
_Interpolator = Callable[[np.ndarray], np.ndarray]


def resample(volume: Volume, grid: Grid, *, period: float | None = None) -> Volume:
    """The volume's values on `grid` by trilinear interpolation in world space; NaN outside it and beside its NaN.

    Missing values take no part: weights are normalised over the finite ones. Channels are interpolated one by one.
    period: the values are angles of this period; their mean direction is taken, in -P/2 .. P/2 where the values are,
    some of them negative, else in 0 .. P (the upper end itself left out).
    """
    from scipy.ndimage import affine_transform

    to_source = np.linalg.inv(volume.grid.affine) @ grid.affine

    def interpolate(values: np.ndarray) -> np.ndarray:
        return affine_transform(
            values, to_source[:3, :3], to_source[:3, 3], output_shape=grid.shape, order=1, mode="grid-constant"
        )

    return Volume(_values(volume.data, interpolate, period), grid)


def at_points(volume: Volume, ras_mm: np.ndarray, *, period: float | None = None) -> np.ndarray:
    """The volume's values (V,), or (V, K) of K channels, at points (V, 3) in RAS mm, as `resample` takes them.

    NaN outside the volume: farther than half a voxel beyond the outermost voxel centres.
    """
    from scipy.ndimage import map_coordinates

    index = volume.grid.to_index(ras_mm).T

    def interpolate(values: np.ndarray) -> np.ndarray:
        return map_coordinates(values, index, order=1, mode="grid-constant")

    return _values(volume.data, interpolate, period)


def _values(data: np.ndarray, interpolate: _Interpolator, period: float | None) -> np.ndarray:
    """Data (nx, ny, nz) or (nx, ny, nz, K) interpolated, of the same type; angles by their mean direction."""
    if period is None:
        return _each_channel(data, interpolate).astype(data.dtype, copy=False)
    angles = data[np.isfinite(data)]
    signed = angles.size and angles.min() < 0 and angles.max() <= period / 2 * (1 + 1e-6)
    kind = Kind("circular", period, -period / 2 if signed else 0.0)
    directions = kind.to_channels(np.where(np.isfinite(data), data, np.nan))
    return kind.to_values(np.stack([_each_channel(part, interpolate) for part in directions]).astype(data.dtype))


def _each_channel(data: np.ndarray, interpolate: _Interpolator) -> np.ndarray:
    if data.ndim == 3:
        return _over_finite(data, interpolate)
    return np.stack([_over_finite(data[..., k], interpolate) for k in range(data.shape[3])], -1)


def _over_finite(data: np.ndarray, interpolate: _Interpolator) -> np.ndarray:
    finite = np.isfinite(data)
    seen = interpolate(finite.astype(data.real.dtype))
    total = interpolate(np.where(finite, data, 0))
    return np.where(seen >= LEAST_SEEN - _ROUNDING, total / np.where(seen > 0, seen, 1), np.nan)
