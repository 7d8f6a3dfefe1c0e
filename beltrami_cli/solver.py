"""From arrays to denoised arrays: check, build the band, extend, evolve, sample the mesh."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numba
import numpy as np

from beltrami_cli.band import Band, build_band, flat_band
from beltrami_cli.config import Settings, parse_spacing
from beltrami_cli.errors import DataError, NumericsError, RefusedError
from beltrami_cli.evolve import Observer, Schedule, evolve
from beltrami_cli.extension import Extended, Reextension, extend
from beltrami_cli.flows import DT_SHARE, Flow, stability_bound, typical_slope
from beltrami_cli.grid import Grid
from beltrami_cli.levelset import two_values
from beltrami_cli.progress import Phases
from beltrami_cli.record import what_happened
from beltrami_cli.sampling import surface_mesh
from beltrami_cli.surface import Mesh

# eps of the flows l1 and tv as a share of the data's typical slope: so small that nearly every slope counts as an edge.
EPS_SHARE = 0.1
# Parts of the surface without data are worth a warning above this share of the band: below it are lone voxels.
LONE_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class Result:
    """What a run gives.

    data: denoised values in the shape of the input, NaN (or what `outside` says) beyond the band.
    mesh: the surface in RAS mm with the denoised value at every vertex; None for a flat run.
    record: every parameter as used and what happened, as in the sidecar.
    warnings: lines for the user.
    """

    data: np.ndarray
    mesh: Mesh | None
    record: dict[str, Any]
    warnings: tuple[str, ...]


def denoise(
    levelset: np.ndarray | None,
    data: np.ndarray,
    *,
    affine: np.ndarray | None = None,
    spacing: float | Sequence[float] | None = None,
    observer: Observer | None = None,
    **options: Any,
) -> Result:
    """Denoise data that lie on the zero level of a level set.

    levelset: Psi, (nx, ny, nz), or (nx, ny) for a curve in a plane; negative inside; None with flat=True.
    data: values of the same shape, NaN where missing.
    affine: (4, 4), voxel indices to RAS mm; or spacing: mm, one number or one per axis (default 1).
    observer: called after every iteration with (iteration, iterations, root mean square change).
    options: the fields of `config.Settings`, such as flow="beltrami", beta=0.05, iterations=20.

    Raises RefusedError for options or shapes that make no sense, DataError where Psi has no zero level or the data no
    value on it, NumericsError where values leave the finite numbers (all of `beltrami_cli.errors`).

    The flow is Eq. 20 of "The Beltrami Flow over Implicit Manifolds" on a narrow band with one sheet per bank.
    """
    for name in options.keys() - {field.name for field in fields(Settings)}:
        raise RefusedError(f"unknown option {name!r}; the options are the fields of config.Settings")
    settings = Settings(**options)
    if isinstance(data, np.ma.MaskedArray):
        data = np.ma.filled(data.astype(float), np.nan)
    values = np.asarray(data)
    if values.ndim not in (2, 3):
        raise RefusedError(f"data: found an array of shape {values.shape}; expected 2 or 3 axes")
    if affine is not None and spacing is not None:
        raise RefusedError("affine and spacing both place the voxels; give one of them")
    psi = None if levelset is None else np.asarray(levelset)
    if psi is not None and psi.shape != values.shape:
        raise RefusedError(f"levelset has shape {psi.shape} and data {values.shape}; expected one shape for both")
    if settings.flat != (psi is None):
        raise RefusedError("levelset: expected an array, or None together with flat=True")
    grid = _grid(values.shape, affine, spacing)
    threads = numba.get_num_threads()
    try:
        solved = solve(
            None if psi is None else _as_float(psi, settings).reshape(grid.shape),
            _as_float(values, settings).reshape(grid.shape),
            grid, settings, Phases(), observer,
        )  # fmt: skip
    finally:
        numba.set_num_threads(threads)  # the caller's own choice
    return replace(solved, data=solved.data.reshape(values.shape))


def _grid(shape: tuple[int, ...], affine: np.ndarray | None, spacing: float | Sequence[float] | None) -> Grid:
    """The grid of an array; raises RefusedError where affine or spacing cannot place voxels."""
    if affine is None:
        steps = (1.0,) if spacing is None else parse_spacing(np.asarray(spacing).tolist())
        return Grid.from_spacing(shape, steps[0] if len(steps) == 1 else steps)
    matrix = np.asarray(affine)
    usable = matrix.shape == (4, 4) and matrix.dtype.kind in "fiu" and np.isfinite(matrix).all()
    if not usable or np.linalg.det(matrix[:3, :3]) == 0:
        raise RefusedError(f"affine: found {matrix.tolist()}; expected an invertible 4 x 4 matrix, voxels to RAS mm")
    return Grid(Grid.from_spacing(shape).shape, matrix.astype(float))


def solve(
    psi: np.ndarray | None,
    data: np.ndarray,
    grid: Grid,
    settings: Settings,
    phases: Phases,
    observer: Observer | None = None,
    notify: Callable[[str], None] | None = None,
) -> Result:
    """Denoise arrays of shape grid.shape; data in that shape come back."""
    warnings = Warnings(notify)
    require_usable(grid, "the grid")
    numba.set_num_threads(min(settings.threads or _cpus(), numba.config.NUMBA_NUM_THREADS))
    dt = time_step(grid, settings)
    data = _finite_or_missing(data, warnings)
    plane = PlaneLast(grid)
    with phases("band"):
        band = band_of(psi, settings, plane, warnings)
        samples = band.gather(plane.forth(data))
    with phases("extend"):
        start = extend(band, samples, settings.extension)
        missing = np.isnan(start.values[band.primary]).mean()
        if missing > LONE_SHARE:
            share = f"{100 * missing:.1f} %"
            warnings.add(f"{share} of the band lies on parts of the surface without any data: left missing")
        u0 = np.where(np.isnan(start.values), 0, start.values)  # linked to nothing but one another
    flow = Flow(settings.flow, settings.phi_name, settings.scheme)
    slope = typical_slope(band, u0, start.known)
    with phases("flow"):
        schedule = _schedule(settings, dt, slope)
        every = settings.reextends_every
        evolution = evolve(
            u0, flow.stepper(band, u0.dtype), schedule, Reextension(band) if every else None, every, observer
        )
        values, excess = _within_range(np.where(np.isnan(start.values), np.nan, evolution.values), start)
    with phases("mesh"):
        mesh = None if settings.flat else surface_mesh(band, values)
    outside: dict[str, np.ndarray | float] = {"nan": np.nan, "zero": 0.0, "keep": plane.forth(data)}
    out = plane.back(band.scatter(values, outside[settings.outside]))
    record = what_happened(settings, grid, band, schedule, evolution, slope, samples, values, start.known, excess)
    return Result(out, mesh, record, tuple(warnings.lines))


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


def _finite_or_missing(data: np.ndarray, warnings: Warnings) -> np.ndarray:
    """Data whose infinite values are missing too; raises DataError where nothing is left."""
    infinite = np.isinf(data)
    if not np.isfinite(data).any():
        found = "NaN and values that are infinite at this precision" if infinite.any() else "NaN"
        raise DataError(f"DATA has no valid value: found only {found}; expected finite values on the surface")
    if infinite.any():
        warnings.add(f"DATA has {int(infinite.sum())} infinite values: taken as missing")
        data = np.where(infinite, np.nan, data)
    return data


def _within_range(values: np.ndarray, start: Extended) -> tuple[np.ndarray, float]:
    """Values (E,), NaN where missing, kept within the data's range, and by how much they had left it (data units).

    No flow leaves the range; differences do, a little, beside the band's ragged rim. Raises NumericsError where it was
    more than the range's own width: no error of differences, but a runaway.
    """
    data = start.values[start.known].astype(float)
    low, high = data.min(), data.max()
    excess = max(low - float(np.nanmin(values)), float(np.nanmax(values)) - high, 0.0)
    rounding = 1e-3 * max(abs(low), abs(high))  # of thousands of steps on nearly constant data
    if not excess <= high - low + rounding:
        raise NumericsError(
            f"the flow ran away: found values {excess:.6g} beyond the data's own {low:.6g} to {high:.6g}; "
            "try a smaller --dt or --scheme symmetric"
        )
    return np.clip(values, low, high).astype(values.dtype), excess


def _schedule(settings: Settings, dt: float, slope: float) -> Schedule:
    iterations, dt, ends_by = settings.duration(dt)
    if settings.flow == "l2":
        return Schedule(np.zeros(iterations), dt, ends_by)
    if settings.flow in ("l1", "tv"):
        eps = settings.eps if settings.eps is not None else EPS_SHARE * slope
        return Schedule(np.full(iterations, 1 / eps if eps else 0.0), dt, ends_by)
    if settings.beta.is_auto:
        return Schedule(np.full(iterations, 1 / slope if slope else 0.0), dt, ends_by)
    return Schedule(settings.beta.over(iterations), dt, ends_by)


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


def _as_float(array: np.ndarray, settings: Settings) -> np.ndarray:
    if array.dtype.kind not in "fiub":
        raise RefusedError(f"found values of type {array.dtype}; expected real numbers")
    with np.errstate(over="ignore"):  # what is too large becomes infinite, and is reported as that
        return array.astype(settings.precision)


def require_usable(grid: Grid, name: str) -> None:
    """Raise RefusedError where the voxel axes are not orthogonal."""
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


def _cpus() -> int:
    """CPUs that this process may use: a scheduler or container may grant fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
