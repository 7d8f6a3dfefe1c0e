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
from beltrami_cli.inputs import Warnings, grid_around, require_sense_on_mesh
from beltrami_cli.progress import Phases
from beltrami_cli.solver import Result, Solver
from beltrami_cli.surface import Mesh


def denoise(
    levelset: np.ndarray | Mesh | None,
    data: np.ndarray,
    *,
    weights: np.ndarray | None = None,
    mask: np.ndarray | None = None,
    affine: np.ndarray | None = None,
    spacing: float | Sequence[float] | None = None,
    on: Sequence[Mesh] = (),
    observer: Observer | None = None,
    **options: Any,
) -> Result:
    """Denoise data that lie on the zero level of a level set, or on a mesh.

    levelset: Psi, (nx, ny, nz), or (nx, ny) for a curve in a plane; negative inside; a mask, not 0 inside; a Mesh in
        RAS mm; None with flat=True.
    data: values of the same shape, NaN where missing; with kind="vector" complex, or of shape (..., K). On a Mesh of V
        vertices of shape (V,) or (V, K), or a volume around it.
    weights: confidence of the data, of the shape of one channel, 0 or more (R^2, coherence). mask: alike, which data
        count (not 0).
    affine: (4, 4), voxel indices to RAS mm; or spacing: mm, one number or one per axis (default 1); for values at
        vertices, spacing alone: that of the band's voxels (default: 2/3 of the mesh's median edge).
    on: other meshes of the surface, in RAS mm, whose vertices get values too, `Result.on`.
    observer: called after every iteration with (iteration, iterations, root mean square change).
    options: the fields of `config.Settings`, such as flow="beltrami", beta=0.05, iterations=20.

    Raises RefusedError for options or shapes that make no sense, DataError where Psi has no zero level or the data no
    value on it, NumericsError where values leave the finite numbers (all of `beltrami_cli.errors`).

    The flow is Eq. 20 of "The Beltrami Flow over Implicit Manifolds" on a narrow band with one sheet per bank.
    """
    for name in options.keys() - {field.name for field in fields(Settings)}:
        raise RefusedError(f"unknown option {name!r}; the options are the fields of config.Settings")
    settings = Settings(**options)
    if isinstance(levelset, list | tuple) or (levelset is not None and hasattr(levelset, "__array__")):
        levelset = np.asanyarray(levelset)
    if settings.flat != (levelset is None) or not isinstance(levelset, np.ndarray | Mesh | None):
        raise RefusedError(
            f"levelset: found {type(levelset).__name__}; expected an array or a Mesh, or None together with flat=True"
        )
    if isinstance(on, Mesh) or not all(isinstance(mesh, Mesh) for mesh in on) or (on and settings.flat):
        raise RefusedError("on: expected a list of Mesh, and a surface, which flat has not")
    values, mesh = _filled_with_nan(data), levelset if isinstance(levelset, Mesh) else None
    psi = _filled_with_nan(levelset) if isinstance(levelset, np.ndarray) else None
    at_vertices = mesh is not None and values.ndim < 3
    if mesh is not None:
        require_sense_on_mesh(settings, at_vertices)
    shape = _shape(values, len(mesh.vertices_ras_mm) if mesh else None, psi, settings)
    if affine is not None and spacing is not None:
        raise RefusedError("affine and spacing both place the voxels; give one of them")
    if affine is not None and at_vertices:
        raise RefusedError("affine: places voxels; found values at the vertices of a mesh; drop it")
    if mesh is not None and at_vertices:
        grid, full = grid_around(mesh, settings, _one(spacing)), shape
    else:
        grid = _grid(shape, affine, spacing)
        full = grid.shape
    channels = values.shape[len(shape) :]

    def on_grid(array: np.ndarray | None, name: str, complex_too: bool = False) -> np.ndarray | None:
        if array is None:
            return None
        if array.shape[: len(shape)] != shape or (array.ndim > len(shape) and array is not values):
            raise RefusedError(f"{name}: found the shape {array.shape}; expected {shape}, as DATA has")
        return _as_float(array, settings, complex_too).reshape(full + array.shape[len(shape) :])

    placed = on_grid(values, "data", settings.kind == "vector")
    assert placed is not None
    threads = numba.get_num_threads()
    warnings = Warnings(None)
    try:
        solver = Solver(
            mesh or on_grid(psi, "levelset"), grid, settings, Phases(), warnings,
            on_grid(None if weights is None else _filled_with_nan(weights), "weights"),
            on_grid(None if mask is None else _filled_with_nan(mask), "mask"),
            at_vertices=at_vertices, on=on,
        )  # fmt: skip
        work = solver.denoise_series if settings.independent else solver.denoise
        solved = work(placed, observer)
    finally:
        numba.set_num_threads(threads)  # the caller's own choice
    return replace(
        solved,
        data=solved.data.reshape(shape + channels),
        filled=solved.filled.reshape(shape),
        warnings=tuple(warnings.lines),
    )


def _filled_with_nan(array: np.ndarray) -> np.ndarray:
    """A masked array's masked values as NaN; others as they are."""
    if isinstance(array, np.ma.MaskedArray):
        return np.ma.filled(array.astype(complex if array.dtype.kind == "c" else float), np.nan)
    return np.asarray(array)


def _one(spacing: float | Sequence[float] | None) -> float | None:
    """The spacing of the band around a mesh, whose voxels are cubes."""
    if spacing is None:
        return None
    steps = parse_spacing(np.asarray(spacing).tolist())
    if len(steps) > 1:
        raise RefusedError(f"spacing: found {spacing}; expected one number: the band around a mesh has cubes")
    return steps[0]


def _shape(values: np.ndarray, vertices: int | None, psi: np.ndarray | None, settings: Settings) -> tuple[int, ...]:
    """The shape of one channel; raises RefusedError where levelset and data do not go together."""
    vector = settings.kind == "vector" and not np.iscomplexobj(values)
    shape = values.shape
    if vertices is not None and values.ndim < 3:
        if shape[:1] != (vertices,) or (values.ndim == 2) != vector:
            wanted = f"({vertices}, K) with kind='vector'" if vector else f"({vertices},), or (V, K) with kind='vector'"
            raise RefusedError(f"data: found the shape {shape}; expected {wanted}: the mesh has {vertices} vertices")
        shape = shape[:1]
    elif psi is not None:
        shape = psi.shape
        fits = values.shape == shape or (vector and values.shape[:-1] == shape)
        if not fits:
            more = " (several channels need kind='vector')" if values.shape[:-1] == shape else ""
            raise RefusedError(
                f"levelset has shape {psi.shape} and data {values.shape}; expected one shape for both{more}"
            )
    elif vector and values.ndim > 2:
        shape = values.shape[:-1]
    axes = (2, 3) if vertices is None else (1,) if values.ndim < 3 else (3,)
    if len(shape) not in axes:
        more = " (several channels need kind='vector')" if values.ndim == 4 else ""
        wanted = " or ".join(map(str, axes))
        raise RefusedError(f"data: found an array of shape {values.shape}; expected {wanted} axes{more}")
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
