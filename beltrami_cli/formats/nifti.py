"""NIfTI-1 and NIfTI-2: .nii, .nii.gz, .hdr/.img pairs. World is RAS; units are converted to and from mm."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from beltrami_cli.errors import RefusedError
from beltrami_cli.formats import checks
from beltrami_cli.grid import Grid, Volume

_SCANNER = 1  # NIFTI_XFORM_SCANNER_ANAT
_MM_PER_UNIT = {"unknown": 1.0, "mm": 1.0, "meter": 1e3, "micron": 1e-3}


@dataclass(frozen=True)
class NiftiHeader:
    """Template for writing: nibabel's own header, and the grid that its affine stands for."""

    header: Any
    grid: Grid

    @property
    def mm_per_unit(self) -> float:
        return _MM_PER_UNIT[_units(self.header)[0]]


def read_grid(path: Path) -> Grid:
    """The grid alone; no voxel is read. Raises as `read`."""
    return _open(path)[1].grid


def read(path: Path, dtype: DTypeLike) -> Volume:
    """The volume, scaled by slope and intercept, in the file's (Fortran) memory order.

    Raises DataError where the content cannot be read, RefusedError where it is no single real volume.
    """
    image, template = _open(path)
    with checks.reading(path, "NIfTI"):
        data = image.get_fdata(dtype=np.dtype(dtype), caching="unchanged")
    return Volume(data.reshape(template.grid.shape), template.grid, tuple(map(int, image.shape)), template)


def files(path: Path) -> list[Path]:
    """What `write` makes: one file, or both of a pair, the image before the header that announces it."""
    if path.suffix.lower() not in (".hdr", ".img"):
        return [path]
    return [path.with_suffix(part.upper() if path.suffix.isupper() else part) for part in (".img", ".hdr")]


def write(path: Path, volume: Volume, dtype: DTypeLike) -> None:
    """Write with slope 1 and intercept 0; header, units and both transforms are the template's where there is one."""
    import nibabel as nib

    data = np.asarray(volume.data, dtype).reshape(volume.file_shape)
    template = volume.header if isinstance(volume.header, NiftiHeader) else None
    pair, version_2 = len(files(path)) == 2, template is not None and template.header["sizeof_hdr"] == 540
    image_class: Any = {
        (False, False): nib.Nifti1Image,
        (False, True): nib.Nifti2Image,
        (True, False): nib.Nifti1Pair,
        (True, True): nib.Nifti2Pair,
    }[pair, version_2]
    with checks.writing(path):
        image = image_class(data, None, None if template is None else template.header, dtype=data.dtype)
        _place(image, volume.grid, template)
        _forget_stale_range(image.header, data)
        image.to_filename(path)


def _open(path: Path) -> tuple[Any, NiftiHeader]:
    import nibabel as nib

    for part in files(path):
        if not part.exists():
            raise RefusedError(f"{path}: half of a pair; expected {part.name} beside it; fetch that file too")
    with checks.reading(path, "NIfTI"):
        # Not mapped: a file that is cut short must fail here, in one line, and not at the first touch of a page.
        image: Any = nib.load(path, mmap=False)
    _require_nifti_volume(path, image)
    file_shape = tuple(map(int, image.shape))
    shape = checks.spatial_shape(path, file_shape)
    checks.require_real(path, image.get_data_dtype())
    affine = np.array(image.affine, float)
    affine[:3] *= _MM_PER_UNIT[_units(image.header)[0]]
    checks.require_usable_affine(path, affine)
    return image, NiftiHeader(image.header, Grid(shape, affine))


def _require_nifti_volume(path: Path, image: Any) -> None:
    import nibabel as nib

    if isinstance(image, nib.Cifti2Image):
        raise RefusedError(f"{path}: expected a volume; found CIFTI (grayordinates); extract its volume part")
    if not isinstance(image, nib.Nifti1Pair):
        raise RefusedError(
            f"{path}: expected NIfTI; found {type(image).__name__}, of uncertain orientation; convert it to NIfTI"
        )


def _units(header: Any) -> tuple[str, str]:
    """Units of space and of time; unknown where the code is none of the standard's."""
    try:
        space, time = header.get_xyzt_units()
    except KeyError:
        return "unknown", "unknown"
    return space, time


def _place(image: Any, grid: Grid, template: NiftiHeader | None) -> None:
    """Transforms and units; those of the template stay bit for bit where the grid is still its own."""
    header = image.header
    space, time = _units(header)
    if space == "unknown":
        header.set_xyzt_units("mm", time)
    if template is not None and template.grid.matches(grid):
        return
    affine = grid.affine.copy()
    affine[:3] /= 1.0 if template is None else template.mm_per_unit
    world = int(header["sform_code"]) or int(header["qform_code"]) or _SCANNER
    image.set_sform(affine, code=world)
    # A quaternion cannot hold shear: only the sform then says where the voxels are.
    image.set_qform(affine, code=0 if grid.is_sheared() else world)


def _forget_stale_range(header: Any, data: np.ndarray) -> None:
    """Unset a display range that would clip these values: viewers then choose their own."""
    low, high = float(header["cal_min"]), float(header["cal_max"])
    if low == high == 0:
        return
    finite = data[np.isfinite(data)]
    if finite.size and not (low <= finite.min() and finite.max() <= high):
        header["cal_min"] = header["cal_max"] = 0
