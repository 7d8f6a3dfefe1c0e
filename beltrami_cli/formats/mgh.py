"""FreeSurfer's .mgz and .mgh. World is scanner RAS mm."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from beltrami_cli.formats import checks
from beltrami_cli.formats.series import Series, frames_behind
from beltrami_cli.grid import Grid, Volume


@dataclass(frozen=True)
class MghHeader:
    """Template for writing: nibabel's own header (scan parameters included), and the grid it stands for."""

    header: Any
    grid: Grid


def read(path: Path, dtype: DTypeLike, *, channels: bool = False) -> Volume:
    """The volume, in the file's (Fortran) memory order; raises DataError or RefusedError."""
    from nibabel.openers import ImageOpener

    # All at once: scan parameters stand behind the voxels, so that a reader of the file would decompress it twice.
    with checks.reading(path, "MGH"), ImageOpener(path) as file:
        image = _images().from_bytes(file.read())
    template, count = _checked(path, image, channels)
    with checks.reading(path, "MGH"):
        data = image.get_fdata(dtype=np.dtype(dtype), caching="unchanged")
    shape = (*template.grid.shape, count) if count > 1 else template.grid.shape
    return Volume(data.reshape(shape, order="A"), template.grid, tuple(map(int, image.shape)), template)


def open_series(path: Path, dtype: DTypeLike, *, channels: bool = True) -> Series:
    """The frames, one in memory at a time. Raises as `read`."""
    with checks.reading(path, "MGH"):
        image = _images().from_filename(path, mmap=False)
    template, count = _checked(path, image, channels)
    frame = frames_behind(path, "MGH", image.dataobj, template.grid.shape, count, np.dtype(dtype))
    return Series(template.grid, count, tuple(map(int, image.shape)), template, frame)


def write(path: Path, volume: Volume, dtype: DTypeLike) -> None:
    """Write float32, the only floating type of the format, or uint8; always with three axes, and frames behind."""
    template = volume.header if isinstance(volume.header, MghHeader) else None
    stored = np.dtype(np.uint8 if np.dtype(dtype) == np.uint8 else np.float32)
    with checks.writing(path):
        header = None if template is None else template.header.copy()
        if header is not None:
            header.set_data_dtype(stored)
        kept = template is not None and template.grid.matches(volume.grid)
        affine = template.header.get_affine() if template is not None and kept else volume.grid.affine
        _images()(np.asarray(volume.data, stored), affine, header).to_filename(path)


def _images() -> Any:
    import nibabel as nib

    return nib.MGHImage


def _checked(path: Path, image: Any, channels: bool) -> tuple[MghHeader, int]:
    """The template and the number of frames."""
    shape, count = checks.layout(path, tuple(map(int, image.shape)), channels=channels)
    checks.require_numbers(path, image.get_data_dtype(), count)
    affine = np.array(image.affine, float)
    checks.require_usable_affine(path, affine)
    return MghHeader(image.header, Grid(shape, affine)), count
