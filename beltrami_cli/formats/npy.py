"""NumPy's .npy: bare values, never unpickled. They have no place in the world but the spacing that the user gives."""

from __future__ import annotations

import io
from collections.abc import Iterable
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from beltrami_cli.errors import DataError
from beltrami_cli.formats import checks
from beltrami_cli.formats.series import Series, append_frames, appending
from beltrami_cli.grid import Grid, Volume


def read(
    path: Path, spacing: float | tuple[float, ...], dtype: DTypeLike, *, channels: bool = False, plane: bool = False
) -> Volume:
    """The array with voxels of `spacing` mm; raises DataError or RefusedError. plane: as in `formats.read_volume`."""
    array, shape, count = _open(path, channels, plane)
    with checks.reading(path, "NPY"):
        data = np.array(array, checks.number_type(dtype, array.dtype))
    grid = Grid.from_spacing(shape, spacing)
    return Volume(data.reshape((*shape, count) if count > 1 else shape, order="A"), grid, array.shape)


def open_series(
    path: Path, spacing: float | tuple[float, ...], dtype: DTypeLike, *, channels: bool = True, plane: bool = False
) -> Series:
    """The frames of the array, mapped; opening it reads the header alone. Raises as `read`."""
    array, shape, count = _open(path, channels, plane)
    asked = checks.number_type(dtype, array.dtype)
    frames = array.reshape(*shape, count, order="A")

    def frame(t: int) -> np.ndarray:
        with checks.reading(path, "NPY"):
            return np.array(frames[..., t], asked)

    return Series(Grid.from_spacing(shape, spacing), count, array.shape, None, frame, asked.kind == "c")


def write(path: Path, volume: Volume, dtype: DTypeLike) -> None:
    """Write in C order, which readers in other languages take for granted."""
    data = np.ascontiguousarray(volume.data, checks.number_type(dtype, volume.data.dtype))
    with checks.writing(path), path.open("wb") as file:
        np.save(file, data.reshape(volume.file_shape), allow_pickle=False)


def write_series(path: Path, series: Series, frames: Iterable[np.ndarray], dtype: DTypeLike) -> None:
    """Write in Fortran order, in which a frame is one piece: in C order each would touch every page of the file."""
    start = io.BytesIO()
    entries = {"descr": np.dtype(dtype).str, "fortran_order": True, "shape": series.shape_to_write()}
    np.lib.format.write_array_header_1_0(start, entries)
    with appending(path) as append:
        append(start.getvalue())
        append_frames(append, series, frames, dtype)


def _open(path: Path, channels: bool, plane: bool) -> tuple[np.ndarray, tuple[int, int, int], int]:
    """The array, still on disk, its grid's shape and its number of channels; its header has been checked."""
    axes, dtype = _header(path)
    if dtype.hasobject:
        raise DataError(
            f"{path}: holds pickled Python objects, which are never unpickled; expected an array of numbers"
        )
    # Three axes of which one has length 1 are a plane as a volume holds it.
    picture = channels and plane and len(axes) == 3 and 1 not in axes
    shape, count = checks.layout(
        path, axes[:2] if picture else axes, per_voxel=axes[2] if picture else 1, channels=channels
    )
    checks.require_numbers(path, dtype, count, channels=channels)
    with checks.reading(path, "NPY"):
        return np.lib.format.open_memmap(path, mode="r"), shape, count


def _header(path: Path) -> tuple[tuple[int, ...], np.dtype]:
    with checks.reading(path, "NPY"), path.open("rb") as file:
        version = np.lib.format.read_magic(file)
        read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = read(file)
        return shape, dtype
