"""What comes in, as the numerics expect it: axes, signs, weights, missing values, the time step."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from beltrami_cli.band import Band, band_around, build_band, flat_band
from beltrami_cli.config import Settings
from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.flows import DT_SHARE, stability_bound
from beltrami_cli.grid import Canonical, Grid
from beltrami_cli.levelset import refined, two_values
from beltrami_cli.segmentation import smooth_surface
from beltrami_cli.surface import Mesh, edges_of

# Weights below 0 by no more than this share of the largest are rounding and interpolation.
NEGATIVE_SHARE = 1e-3
# Of a band around a mesh. It keeps a map with borders to 25 to 28 dB with 1 voxel per edge, to 30 to 33 dB with 1.5;
# the time grows with the square.
VOXELS_PER_EDGE = 1.5


def require_usable(grid: Grid, name: str) -> None:
    """Raise RefusedError where the voxel axes are not orthogonal, or fewer than two have more than one voxel."""
    if len(grid.used_spacing) < 2:
        raise RefusedError(f"{name}: found {' x '.join(map(str, grid.shape))} voxels; expected a volume or a plane")
    if grid.is_sheared():
        raise RefusedError(
            f"{name}: its voxel axes are not orthogonal (a sheared affine); expected a rectangular grid: "
            "resample it onto one first"
        )


def require_sense_on_mesh(settings: Settings, at_vertices: bool) -> None:
    """Raise RefusedError for settings that a mesh as level set, or data at its vertices, leave no room for."""
    if settings.inside == "positive":
        raise RefusedError("inside: is for a level set; the triangles of a surface say where outside is; drop it")
    if not at_vertices:
        return
    if settings.depth is not None:
        raise RefusedError("depth: averages a volume along the normal; found data at vertices; drop it")
    if settings.extension != "closest-point":
        raise RefusedError(
            f"extension: found {settings.extension}, which is for volumes; data at vertices need closest-point; drop it"
        )
    if settings.outside != "nan":
        raise RefusedError("outside: is for volumes; found data at the vertices of a surface; drop it")


def time_step(grid: Grid, settings: Settings) -> float:
    """dt in mm^2 for this grid; raises RefusedError where the one asked for is over the bound."""
    bound = stability_bound(grid.spacing, grid.shape)
    if settings.dt is not None and settings.dt > bound * (1 + 1e-9):
        raise RefusedError(
            f"dt: found {settings.dt:g} mm^2, over the stability bound of {bound:.6g} mm^2 on voxels of "
            f"{' x '.join(f'{h:.4g}' for h in grid.spacing)} mm; give at most that, or auto"
        )
    return DT_SHARE * bound if settings.dt is None else settings.dt


def grid_around(mesh: Mesh, settings: Settings, spacing: float | None = None) -> Grid:
    """A grid of cubes that holds the band around a mesh, axes as those of RAS.

    spacing: mm; by default the mesh's median edge over VOXELS_PER_EDGE.
    Raises RefusedError as `Grid.around`, DataError where the mesh has no edge.
    """
    mesh.require_triangles()
    ras_mm, ends = mesh.vertices_ras_mm[np.unique(mesh.cells)], edges_of(mesh.cells)
    lengths = np.linalg.norm(np.subtract(*np.moveaxis(mesh.vertices_ras_mm[ends], 1, 0)), axis=1)
    lengths = lengths[lengths > 0]
    if not len(lengths):
        raise DataError("the surface has no triangle of any area: is it a mesh at all?")
    h = float(np.median(lengths)) / VOXELS_PER_EDGE if spacing is None else spacing
    return Grid.around(ras_mm, h, settings.half_width(np.full(3, h)) + h)


class Warnings:
    """Collects lines for the user, and tells each at once to whoever listens."""

    def __init__(self, notify: Callable[[str], None] | None) -> None:
        self.lines: list[str] = []
        self._notify = notify

    def add(self, line: str) -> None:
        self.lines.append(line)
        if self._notify:
            self._notify(line)


def band_of(psi: np.ndarray | None, settings: Settings, axes: Canonical, warnings: Warnings) -> Band:
    """The band around the zero level of psi on the volume's own grid; the flat one where psi is None.

    Of a mask, the surface is the smooth one of `segmentation.smooth_surface`; in a plane the mask's own staircase.
    """
    if psi is None:
        return flat_band(axes.grid)
    psi, half_width = axes.forth(psi), settings.half_width(axes.grid.used_spacing)
    mask = two_values(psi)
    sign = -1 if settings.inside == "positive" else 1
    if mask and mask[0] >= 0:  # a mask of something: what it marks is inside, whatever the sign
        psi, sign = (mask[0] + mask[1]) / 2 - psi, 1
    if not mask:
        return build_band(sign * psi, axes.grid, half_width)
    if 1 not in psi.shape:
        mesh = smooth_surface(sign * psi < 0, axes.grid, np.isfinite(psi))
        return band_around(refined(mesh, axes.grid).surface, axes.grid, half_width)
    warnings.add(
        f"the level set holds two values only ({mask[0]:g} and {mask[1]:g}): a mask, whose outline is a staircase of "
        "pixels, accurate to half of one; give a signed distance or another smooth function for a better one"
    )
    return build_band(sign * psi, axes.grid, half_width)


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
