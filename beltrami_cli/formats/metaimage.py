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
from beltrami_cli.grid import Grid, Volume

_LPS_TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True)
class MetaHeader:
    """Template for writing: the entries of the header that say more than the grid does."""

    entries: dict[str, str]


def read_grid(path: Path) -> Grid:
    """The grid alone; no voxel is read. Raises as `read`."""
    return _grid(path, _open(path))


def read(path: Path, dtype: DTypeLike) -> Volume:
    """The volume, in the file's (Fortran) memory order.

    Raises DataError where the content cannot be read, RefusedError where it is no single real volume.
    """
    import SimpleITK as sitk

    reader = _open(path)
    grid = _grid(path, reader)
    with checks.reading(path, "MetaImage"), checks.native_stderr_muted():
        image = reader.Execute()
        data = sitk.GetArrayFromImage(image).T.astype(dtype, copy=False)
    entries = {key: image.GetMetaData(key) for key in image.GetMetaDataKeys() if not key.startswith("ITK_")}
    return Volume(data.reshape(grid.shape), grid, data.shape, MetaHeader(entries))


def files(path: Path) -> list[Path]:
    """What `write` makes: for .mhd the voxels before the header that announces them. Raises RefusedError for .MHA."""
    if path.suffix not in (".mha", ".mhd"):
        # ITK would write another file than the one that is named.
        raise RefusedError(f"{path}: MetaImage is written in lower case only; expected the suffix .mha or .mhd")
    return [path.with_suffix(".raw"), path] if path.suffix == ".mhd" else [path]


def require_writable(path: Path, grid: Grid) -> None:
    """Raise RefusedError where the grid is sheared: the format's directions are orthogonal."""
    if grid.is_sheared():
        raise RefusedError(f"{path}: MetaImage cannot hold a sheared grid; found {grid.describe()}; write NIfTI")


def write(path: Path, volume: Volume, dtype: DTypeLike) -> None:
    """Write .mha compressed, .mhd with plain raw voxels beside it; raises RefusedError for a sheared grid."""
    import SimpleITK as sitk

    require_writable(path, volume.grid)
    data = np.asarray(volume.data, dtype).reshape(volume.file_shape)
    with checks.writing(path), checks.native_stderr_muted():
        image = sitk.GetImageFromArray(data.T, isVector=False)
        direction, spacing, origin = _to_lps(volume.grid, data.ndim)
        image.SetDirection(direction.ravel().tolist())
        image.SetSpacing(spacing.tolist())
        image.SetOrigin(origin.tolist())
        if isinstance(volume.header, MetaHeader):
            for key, value in volume.header.entries.items():
                image.SetMetaData(key, value)
        sitk.WriteImage(image, os.fspath(path), useCompression=path.suffix == ".mha")


def _open(path: Path) -> Any:
    """A reader that knows the header and has not touched the voxels."""
    import SimpleITK as sitk

    reader = sitk.ImageFileReader()
    reader.SetImageIO("MetaImageIO")
    reader.SetFileName(os.fspath(path))
    with checks.reading(path, "MetaImage"), checks.native_stderr_muted():
        reader.ReadImageInformation()
    _require_voxels(path)
    channels = reader.GetNumberOfComponents()
    if channels != 1:
        raise RefusedError(f"{path}: expected one number per voxel; found {channels} channels; extract one channel")
    return reader


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


def _grid(path: Path, reader: Any) -> Grid:
    shape = checks.spatial_shape(path, reader.GetSize())
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
