"""NumPy's .npy: bare values, never unpickled. They have no place in the world but the spacing that the user gives."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from beltrami_cli.errors import DataError
from beltrami_cli.formats import checks
from beltrami_cli.grid import Grid, Volume


def read_grid(path: Path, spacing: float | tuple[float, ...]) -> Grid:
    """The grid alone; no value is read. Raises as `read`."""
    array = _open(path)
    return Grid.from_spacing(checks.spatial_shape(path, array.shape), spacing)


def read(path: Path, spacing: float | tuple[float, ...], dtype: DTypeLike) -> Volume:
    """The array with voxels of `spacing` mm; raises DataError or RefusedError."""
    array = _open(path)
    grid = Grid.from_spacing(checks.spatial_shape(path, array.shape), spacing)
    with checks.reading(path, "NPY"):
        data = np.array(array, dtype)
    return Volume(data.reshape(grid.shape), grid, array.shape)


def write(path: Path, volume: Volume, dtype: DTypeLike) -> None:
    """Write in C order, which readers in other languages take for granted."""
    with checks.writing(path), path.open("wb") as file:
        np.save(file, np.ascontiguousarray(volume.data, dtype).reshape(volume.file_shape), allow_pickle=False)


def _open(path: Path) -> np.ndarray:
    """The array, still on disk; its header has been checked."""
    shape, dtype = _header(path)
    if dtype.hasobject:
        raise DataError(
            f"{path}: holds pickled Python objects, which are never unpickled; expected an array of numbers"
        )
    checks.spatial_shape(path, shape)
    checks.require_real(path, dtype)
    with checks.reading(path, "NPY"):
        return np.lib.format.open_memmap(path, mode="r")


def _header(path: Path) -> tuple[tuple[int, ...], np.dtype]:
    with checks.reading(path, "NPY"), path.open("rb") as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        return shape, dtype
