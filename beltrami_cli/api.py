"""The Python API on arrays: `from beltrami_cli import denoise`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace
from typing import Any

import numba
import numpy as np

from beltrami_cli.config import Settings, parse_spacing
from beltrami_cli.errors import RefusedError
from beltrami_cli.evolve import Observer
from beltrami_cli.grid import Grid
from beltrami_cli.inputs import Warnings
from beltrami_cli.progress import Phases
from beltrami_cli.solver import Result, Solver


def denoise(
    levelset: np.ndarray | None,
    data: np.ndarray,
    *,
    weights: np.ndarray | None = None,
    mask: np.ndarray | None = None,
    affine: np.ndarray | None = None,
    spacing: float | Sequence[float] | None = None,
    observer: Observer | None = None,
    **options: Any,
) -> Result:
    """Denoise data that lie on the zero level of a level set.

    levelset: Psi, (nx, ny, nz), or (nx, ny) for a curve in a plane; negative inside; None with flat=True.
    data: values of the same shape, NaN where missing; with kind="vector" complex, or of shape (..., K).
    weights: confidence of the data, of Psi's shape, 0 or more (R^2, coherence). mask: alike, which data count (not 0).
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
    values, psi = _filled_with_nan(data), None if levelset is None else _filled_with_nan(levelset)
    if settings.flat != (psi is None):
        raise RefusedError("levelset: expected an array, or None together with flat=True")
    shape = _shape(values, psi, settings)
    if affine is not None and spacing is not None:
        raise RefusedError("affine and spacing both place the voxels; give one of them")
    grid = _grid(shape, affine, spacing)
    channels = values.shape[len(shape) :]

    def on_grid(array: np.ndarray | None, name: str, complex_too: bool = False) -> np.ndarray | None:
        if array is None:
            return None
        if array.shape[: len(shape)] != shape or (array.ndim > len(shape) and array is not values):
            raise RefusedError(f"{name}: found the shape {array.shape}; expected {shape}, as DATA has")
        return _as_float(array, settings, complex_too).reshape(grid.shape + array.shape[len(shape) :])

    placed = on_grid(values, "data", settings.kind == "vector")
    assert placed is not None
    threads = numba.get_num_threads()
    warnings = Warnings(None)
    try:
        solver = Solver(
            on_grid(psi, "levelset"), grid, settings, Phases(), warnings,
            on_grid(None if weights is None else _filled_with_nan(weights), "weights"),
            on_grid(None if mask is None else _filled_with_nan(mask), "mask"),
        )  # fmt: skip
        solved = _frames(solver, placed) if settings.independent else solver.denoise(placed, observer)
    finally:
        numba.set_num_threads(threads)  # the caller's own choice
    return replace(
        solved,
        data=solved.data.reshape(shape + channels),
        filled=solved.filled.reshape(shape),
        warnings=tuple(warnings.lines),
    )


def _frames(solver: Solver, data: np.ndarray) -> Result:
    """Every frame of data (nx, ny, nz, K) on its own."""
    record: dict[str, Any] = {}
    results = list(solver.denoise_frames(data.shape[3], lambda t: data[..., t], record))
    meshes = [result.mesh for result in results if result.mesh is not None]
    mesh = None
    if meshes:
        mesh = replace(meshes[0], values=np.stack([m.values for m in meshes if m.values is not None], -1))
    filled = np.logical_or.reduce([r.filled for r in results])
    return Result(np.stack([r.data for r in results], -1), mesh, filled, record, ())


def _filled_with_nan(array: np.ndarray) -> np.ndarray:
    """A masked array's masked values as NaN; others as they are."""
    if isinstance(array, np.ma.MaskedArray):
        return np.ma.filled(array.astype(complex if array.dtype.kind == "c" else float), np.nan)
    return np.asarray(array)


def _shape(values: np.ndarray, psi: np.ndarray | None, settings: Settings) -> tuple[int, ...]:
    """The shape of one channel; raises RefusedError where levelset and data do not go together."""
    vector = settings.kind == "vector" and not np.iscomplexobj(values)
    shape = values.shape
    if psi is not None:
        shape = psi.shape
        fits = values.shape == shape or (vector and values.shape[:-1] == shape)
        if not fits:
            more = " (several channels need kind='vector')" if values.shape[:-1] == shape else ""
            raise RefusedError(
                f"levelset has shape {psi.shape} and data {values.shape}; expected one shape for both{more}"
            )
    elif vector and values.ndim > 2:
        shape = values.shape[:-1]
    if len(shape) not in (2, 3):
        raise RefusedError(f"data: found an array of shape {values.shape}; expected 2 or 3 axes")
    if settings.independent and values.shape == shape:
        raise RefusedError(f"independent: found data of shape {values.shape}; expected several frames, (..., K)")
    return shape


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


def _as_float(array: np.ndarray, settings: Settings, complex_too: bool) -> np.ndarray:
    if array.dtype.kind not in ("fiubc" if complex_too else "fiub"):
        more = "; complex data need kind='vector'" if array.dtype.kind == "c" else ""
        raise RefusedError(f"found values of type {array.dtype}; expected real numbers{more}")
    dtype = np.dtype(settings.precision)
    with np.errstate(over="ignore"):  # what is too large becomes infinite, and is reported as that
        return array.astype(np.result_type(dtype, np.complex64) if array.dtype.kind == "c" else dtype)
