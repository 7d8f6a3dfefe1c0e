"""Grey PNG pictures, read only: a plane of pixels of spacing 1, axes (rows, columns) as pictures are in NumPy."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from beltrami_cli.errors import RefusedError
from beltrami_cli.formats import checks
from beltrami_cli.grid import Grid, Volume


def read_grid(path: Path) -> Grid:
    """The grid alone. Raises as `read`."""
    return read(path, np.float32).grid


def read(path: Path, dtype: DTypeLike) -> Volume:
    """The picture, 8 or 16 bit, as (rows, columns, 1) values.

    Raises DataError where the content cannot be read, RefusedError for colours or transparency.
    """
    import SimpleITK as sitk

    with checks.reading(path, "PNG"), checks.native_stderr_muted():
        image = sitk.ReadImage(os.fspath(path), imageIO="PNGImageIO")
    channels = image.GetNumberOfComponentsPerPixel()
    if channels != 1:
        raise RefusedError(
            f"{path}: expected a grey picture; found {channels} channels (colours); convert it to grey first"
        )
    data = sitk.GetArrayFromImage(image).astype(dtype)
    grid = Grid.from_spacing(checks.spatial_shape(path, data.shape), 1.0)
    return Volume(data.reshape(grid.shape), grid, data.shape)
