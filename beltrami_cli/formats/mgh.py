"""FreeSurfer's .mgz and .mgh. World is scanner RAS mm."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from beltrami_cli.formats import checks
from beltrami_cli.grid import Grid, Volume


@dataclass(frozen=True)
class MghHeader:
    """Template for writing: nibabel's own header (scan parameters included), and the grid it stands for."""

    header: Any
    grid: Grid


def read_grid(path: Path) -> Grid:
    """The grid alone. Raises as `read`."""
    return _open(path)[1].grid


def read(path: Path, dtype: DTypeLike) -> Volume:
    """The volume, in the file's (Fortran) memory order; raises DataError or RefusedError."""
    image, template = _open(path)
    with checks.reading(path, "MGH"):
        data = image.get_fdata(dtype=np.dtype(dtype), caching="unchanged")
    return Volume(data.reshape(template.grid.shape), template.grid, tuple(map(int, image.shape)), template)


def write(path: Path, volume: Volume) -> None:
    """Write float32, the only floating type of the format, always with three axes."""
    import nibabel as nib

    template = volume.header if isinstance(volume.header, MghHeader) else None
    with checks.writing(path):
        header = None if template is None else template.header.copy()
        if header is not None:
            header.set_data_dtype(np.float32)
        kept = template is not None and template.grid.matches(volume.grid)
        affine = template.header.get_affine() if template is not None and kept else volume.grid.affine
        nib.MGHImage(np.asarray(volume.data, np.float32), affine, header).to_filename(path)


def _open(path: Path) -> tuple[Any, MghHeader]:
    import nibabel as nib
    from nibabel.openers import ImageOpener

    # All at once: scan parameters stand behind the voxels, so that a reader of the file would decompress it twice.
    with checks.reading(path, "MGH"), ImageOpener(path) as file:
        image: Any = nib.MGHImage.from_bytes(file.read())
    shape = checks.spatial_shape(path, tuple(map(int, image.shape)))
    checks.require_real(path, image.get_data_dtype())
    affine = np.array(image.affine, float)
    checks.require_usable_affine(path, affine)
    return image, MghHeader(image.header, Grid(shape, affine))
