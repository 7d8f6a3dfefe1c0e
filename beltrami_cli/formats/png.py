"""PNG pictures, read only: a plane of pixels of spacing 1, axes (rows, columns) as pictures are in NumPy."""

from __future__ import annotations

import os
from pathlib import Path

from numpy.typing import DTypeLike

from beltrami_cli.errors import RefusedError
from beltrami_cli.formats import checks
from beltrami_cli.formats.series import Series, frames_of
from beltrami_cli.grid import Grid, Volume

# Byte of the header that tells the kind of pixels, and the one kind that ITK cannot read.
_COLOUR_TYPE, _GREY_WITH_ALPHA = 25, b"\x04"


def read(path: Path, dtype: DTypeLike, *, channels: bool = False) -> Volume:
    """The picture, 8 or 16 bit, as (rows, columns, 1) values, or with `channels` (rows, columns, 1, 3) for colours.

    Transparency is dropped. Raises DataError where the content cannot be read, RefusedError for colours or
    transparency without `channels`.
    """
    import SimpleITK as sitk

    if _pixel_kind(path) == _GREY_WITH_ALPHA:
        raise RefusedError(
            f"{path}: expected a grey or coloured picture; found grey with transparency; save it without"
        )
    reader = sitk.ImageFileReader()
    reader.SetImageIO("PNGImageIO")
    reader.SetFileName(os.fspath(path))
    with checks.reading(path, "PNG"), checks.native_stderr_muted():
        reader.ReadImageInformation()
    found = reader.GetNumberOfComponents()
    if found != 1 and not channels:
        raise RefusedError(
            f"{path}: expected a grey picture; found {found} channels (colours); convert it to grey first, or, as data "
            "to denoise, give --kind vector"
        )
    with checks.reading(path, "PNG"), checks.native_stderr_muted():
        image = reader.Execute()
    data = sitk.GetArrayFromImage(image).astype(dtype)
    opaque = min(found, 3)
    shape, count = checks.layout(path, data.shape[:2], per_voxel=opaque, channels=channels)
    data = data[..., :opaque] if found > 1 else data
    file_shape = (*shape[:2], count) if count > 1 else shape[:2]
    return Volume(data.reshape((*shape, count) if count > 1 else shape), Grid.from_spacing(shape, 1.0), file_shape)


def open_series(path: Path, dtype: DTypeLike, *, channels: bool = True) -> Series:
    """The colours one by one; the whole picture is read. Raises as `read`."""
    picture = read(path, dtype, channels=channels)
    return Series(picture.grid, picture.channels, picture.file_shape, None, frames_of(lambda: picture))


def _pixel_kind(path: Path) -> bytes:
    with path.open("rb") as file:
        file.seek(_COLOUR_TYPE)
        return file.read(1)
