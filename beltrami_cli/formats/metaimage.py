"""MetaImage: .mha (one compressed file) and .mhd (text header beside a .raw). World is LPS mm; here it becomes RAS."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from beltrami_cli.errors import RefusedError
from beltrami_cli.formats import checks
from beltrami_cli.formats.series import Series, frames_of
from beltrami_cli.grid import Grid, Volume, with_channels

_LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class MetaHeader:
    """Template for writing: the entries of the header that say more than the grid does.

    frame_step, frame_origin: of the fourth axis, where frames stand on one and are not the channels of vector pixels.
    """

    entries: dict[str, str]
    frame_step: float | None = None
    frame_origin: float = 0.0


def read(path: Path, dtype: DTypeLike, *, channels: bool = False) -> Volume:
    """The volume, in the file's (Fortran) memory order; frames and the channels of vector pixels on the last axis.

    Raises DataError where the content cannot be read, RefusedError where it is no single real volume.
    """
    import SimpleITK as sitk

    reader = _open(path)
    grid, count, file_shape = _look(path, reader, channels)
    with checks.reading(path, "MetaImage"), checks.native_stderr_muted():
        image = reader.Execute()
        data = sitk.GetArrayFromImage(image).astype(dtype, copy=False)
    data = np.moveaxis(data.T, 0, -1) if image.GetNumberOfComponentsPerPixel() > 1 else data.T
    data = data.reshape((*grid.shape, count) if count > 1 else grid.shape, order="A")
    return Volume(data, grid, file_shape, _header(reader))


def open_series(path: Path, dtype: DTypeLike, *, channels: bool = True) -> Series:
    """The frames; opening it reads the header alone, the first frame reads the whole file. Raises as `read`."""
    reader = _open(path)
    grid, count, file_shape = _look(path, reader, channels)
    return Series(grid, count, file_shape, _header(reader), frames_of(lambda: read(path, dtype, channels=channels)))


def files(path: Path) -> list[Path]:
    """What `write` makes: for .mhd the voxels before the header that announces them. Raises RefusedError for .MHA."""
    if path.suffix not in (".mha", ".mhd"):
        # ITK would write another file than the one that is named.
        raise RefusedError(f"{path}: MetaImage is written in lower case only; expected the suffix .mha or .mhd")
    return [path.with_suffix(".raw"), path] if path.suffix == ".mhd" else [path]


def require_writable(path: Path, grid: Grid, *, is_complex: bool = False) -> None:
    """Raise RefusedError for a sheared grid, as the format's directions are orthogonal, and for complex numbers."""
    if grid.is_sheared():
        raise RefusedError(f"{path}: MetaImage cannot hold a sheared grid; found {grid.describe()}; write NIfTI")
    if is_complex:
        raise RefusedError(f"{path}: MetaImage cannot hold complex numbers; write NIfTI or NPY")


def write(path: Path, volume: Volume, dtype: DTypeLike) -> None:
    """Write .mha compressed, .mhd with plain raw voxels beside it; channels as vector pixels, or frames as they were.

    Raises RefusedError as `require_writable`.
    """
    import SimpleITK as sitk

    require_writable(path, volume.grid, is_complex=np.iscomplexobj(volume.data))
    header = volume.header if isinstance(volume.header, MetaHeader) else MetaHeader({})
    vectors = volume.channels > 1 and header.frame_step is None
    shape = _axes_to_write(volume) if vectors or volume.channels == 1 else volume.grid.shape
    if volume.channels > 1:
        shape = (*shape, volume.channels)
    data = np.asarray(volume.data, dtype).reshape(shape)
    array = np.moveaxis(data, -1, 0).T if vectors else data.T
    with checks.writing(path), checks.native_stderr_muted():
        image = sitk.GetImageFromArray(array, isVector=vectors)
        direction, spacing, origin = _to_lps(volume.grid, image.GetDimension())
        if len(spacing) == 4 and header.frame_step is not None:
            spacing[3], origin[3] = header.frame_step, header.frame_origin
        image.SetDirection(direction.ravel().tolist())
        image.SetSpacing(spacing.tolist())
        image.SetOrigin(origin.tolist())
        for key, value in header.entries.items():
            image.SetMetaData(key, value)
        sitk.WriteImage(image, os.fspath(path), useCompression=path.suffix == ".mha")


def _axes_to_write(volume: Volume) -> tuple[int, ...]:
    """The shape without channels: of a plane two axes, unless it lies elsewhere than at z = 0, which only three say."""
    axes = with_channels(volume.file_shape, volume.channels, 1)
    at_zero = np.allclose(volume.grid.affine[2, [0, 1, 3]], 0)
    return axes if len(axes) > 2 or at_zero else volume.grid.shape


def _open(path: Path) -> Any:
    """A reader that knows the header and has not touched the voxels."""
    import SimpleITK as sitk

    reader = sitk.ImageFileReader()
    reader.SetImageIO("MetaImageIO")
    reader.SetFileName(os.fspath(path))
    with checks.reading(path, "MetaImage"), checks.native_stderr_muted():
        reader.ReadImageInformation()
    _require_voxels(path)
    return reader


def _header(reader: Any) -> MetaHeader:
    entries = {key: reader.GetMetaData(key) for key in reader.GetMetaDataKeys() if not key.startswith("ITK_")}
    if len(reader.GetSize()) < 4:
        return MetaHeader(entries)
    return MetaHeader(entries, reader.GetSpacing()[3], reader.GetOrigin()[3])


def input_files(path: Path) -> list[Path]:
    """The header's own file, and the file of voxels that it names, where it names one."""
    with path.open("rb") as file:
        # Long enough for any header seen; the entry stands last in it.
        entry = re.search(rb"^ElementDataFile\s*=\s*(.+?)\s*$", file.read(65536), re.MULTILINE)
    name = entry.group(1).decode(errors="replace") if entry else "LOCAL"
    return [path] if name.upper().startswith(("LOCAL", "LIST")) or "%" in name else [path, path.parent / name]


def _require_voxels(path: Path) -> None:
    for part in input_files(path):
        if not part.exists():
            raise RefusedError(f"{path}: half of a pair; expected {part.name} beside it; fetch that file too")


def _look(path: Path, reader: Any, channels: bool) -> tuple[Grid, int, tuple[int, ...]]:
    """The grid, the number of channels or frames, and the shape with vector pixels on a last axis."""
    size, components = tuple(map(int, reader.GetSize())), reader.GetNumberOfComponents()
    shape, count = checks.layout(path, size, per_voxel=components, channels=channels)
    return _grid(path, reader, shape), count, (*size, components) if components > 1 else size


def _grid(path: Path, reader: Any, shape: tuple[int, int, int]) -> Grid:
    axes = len(reader.GetSize())
    used = min(axes, 3)
    lps = np.eye(4)
    direction = np.reshape(reader.GetDirection(), (axes, axes))
    lps[:used, :used] = (direction * reader.GetSpacing())[:used, :used]
    lps[:used, 3] = reader.GetOrigin()[:used]
    affine = _LPS_TO_RAS @ lps
    checks.require_usable_affine(path, affine)
    return Grid(shape, affine)


def _to_lps(grid: Grid, axes: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Direction (axes, axes), spacing (axes,) and origin (axes,) of an image with that many axes."""
    affine = _LPS_TO_RAS @ grid.affine
    used = min(axes, 3)
    direction, spacing, origin = np.eye(axes), np.ones(axes), np.zeros(axes)
    direction[:used, :used] = (affine[:3, :3] / grid.spacing)[:used, :used]
    spacing[:used] = grid.spacing[:used]
    origin[:used] = affine[:used, 3]
    return direction, spacing, origin
