"""What comes in, as the numerics expect it: axes, signs, weights, missing values, the time step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from beltrami_cli.band import Band, build_band, flat_band
from beltrami_cli.config import Settings
from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.flows import DT_SHARE, stability_bound
from beltrami_cli.grid import Grid
from beltrami_cli.levelset import two_values

# Weights below 0 by no more than this share of the largest are rounding and interpolation.
NEGATIVE_SHARE = 1e-3


def require_usable(grid: Grid, name: str) -> None:
    """Raise RefusedError where the voxel axes are not orthogonal, or fewer than two have more than one voxel."""
    if len(grid.used_spacing) < 2:
        raise RefusedError(f"{name}: found {' x '.join(map(str, grid.shape))} voxels; expected a volume or a plane")
    if grid.is_sheared():
        raise RefusedError(
            f"{name}: its voxel axes are not orthogonal (a sheared affine); expected a rectangular grid: "
            "resample it onto one first"
        )


def time_step(grid: Grid, settings: Settings) -> float:
    """dt in mm^2 for this grid; raises RefusedError where the one asked for is over the bound."""
    bound = stability_bound(grid.spacing, grid.shape)
    if settings.dt is not None and settings.dt > bound * (1 + 1e-9):
        raise RefusedError(
            f"dt: found {settings.dt:g} mm^2, over the stability bound of {bound:.6g} mm^2 on voxels of "
            f"{' x '.join(f'{h:.4g}' for h in grid.spacing)} mm; give at most that, or auto"
        )
    return DT_SHARE * bound if settings.dt is None else settings.dt


class PlaneLast:
    """Brings a plane's missing axis to the end, where the band expects it, and back."""

    def __init__(self, grid: Grid) -> None:
        single = [axis for axis in range(3) if grid.shape[axis] == 1]
        self.axis = single[0] if single else 2
        order = [a for a in range(3) if a != self.axis] + [self.axis]
        a, b, c = (grid.shape[k] for k in order)
        self.grid = Grid((a, b, c), grid.affine[:, [*order, 3]])

    def forth(self, array: np.ndarray) -> np.ndarray:
        return np.moveaxis(array, self.axis, 2)

    def back(self, array: np.ndarray) -> np.ndarray:
        return np.moveaxis(array, 2, self.axis)


class Warnings:
    """Collects lines for the user, and tells each at once to whoever listens."""

    def __init__(self, notify: Callable[[str], None] | None) -> None:
        self.lines: list[str] = []
        self._notify = notify

    def add(self, line: str) -> None:
        self.lines.append(line)
        if self._notify:
            self._notify(line)


def band_of(psi: np.ndarray | None, settings: Settings, plane: PlaneLast, warnings: Warnings) -> Band:
    """The band around the zero level of psi on the volume's own grid; the flat one where psi is None."""
    if psi is None:
        return flat_band(plane.grid)
    psi = _signed(plane.forth(psi), settings, warnings)
    return build_band(psi, plane.grid, settings.half_width(plane.grid.used_spacing))


def _signed(psi: np.ndarray, settings: Settings, warnings: Warnings) -> np.ndarray:
    """Psi with its negative side inside; a binary mask is centred on 0."""
    if mask := two_values(psi):
        low, high = mask
        warnings.add(
            f"the level set holds two values only ({low:g} and {high:g}): a mask, whose surface is a staircase of "
            "voxels, accurate to half a voxel; give a signed distance or another smooth function for a better one"
        )
        if low >= 0:  # a mask of something: what it marks is inside, whatever the sign
            return (low + high) / 2 - psi
    return -psi if settings.inside == "positive" else psi


def trusted(
    weights: np.ndarray | None,
    mask: np.ndarray | None,
    shape: tuple[int, ...],
    settings: Settings,
    warnings: Warnings,
) -> np.ndarray:
    """Weights of this shape, 0 to 1, 0 where the mask says that data do not count.

    Raises RefusedError for weights below 0, DataError for weights that are 0 everywhere or a mask that is empty.
    """
    trust = np.ones(shape, settings.precision)
    if weights is not None:
        if np.isposinf(weights).any():
            raise RefusedError(
                f"weights: found {int(np.isposinf(weights).sum())} infinite values; expected finite ones: a "
                "variance of 0 is no certainty, put a lower bound on it"
            )
        trust = np.where(np.isfinite(weights), weights, 0).astype(settings.precision)
        low, high = float(trust.min()), float(trust.max())
        if low < -NEGATIVE_SHARE * max(high, 0.0):
            raise RefusedError(
                f"weights: found values down to {low:g}; expected 0 or more (R^2, coherence, 1/variance)"
            )
        if high <= 0:
            raise DataError("weights: found 0 everywhere; expected some data that count")
        if low < 0:
            warnings.add(f"weights: values down to {low:g} taken as 0")
        trust = np.maximum(trust, 0) / high
    if mask is not None:
        counts = np.isfinite(mask) & (mask != 0)
        if not counts.any():
            raise DataError("mask: found 0 everywhere; expected other values where the data count")
        trust = np.where(counts, trust, 0)
    return trust


def finite_or_missing(data: np.ndarray, warnings: Warnings) -> np.ndarray:
    """Data (E, ...) whose infinite values are NaN; raises DataError where nothing is left."""
    infinite = np.isinf(data)
    if not np.isfinite(data).any():
        found = "NaN and values that are infinite at this precision" if infinite.any() else "NaN"
        raise DataError(
            f"the data have no valid value on the surface: found only {found} (or what --missing, --mask or weights of "
            "0 exclude) beside the zero level, expected finite values there (do LEVELSET and DATA belong together?)"
        )
    if infinite.any():
        warnings.add(f"DATA has {int(infinite.sum())} infinite values beside the surface: taken as missing")
        data = np.where(infinite, data.dtype.type(np.nan), data)
    return data


def without(data: np.ndarray, missing: float | None) -> np.ndarray:
    """Data with NaN where they equal the value that means missing."""
    if missing is None:
        return data
    with np.errstate(over="ignore"):  # a value that this precision cannot hold is infinite in the data too
        return np.where(data == data.dtype.type(missing), data.dtype.type(np.nan), data)
