"""NIfTI-1 and NIfTI-2: .nii, .nii.gz, .hdr/.img pairs. World is RAS; units are converted to and from mm."""

from __future__ import annotations

import io
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from beltrami_cli.errors import RefusedError
from beltrami_cli.formats import checks
from beltrami_cli.formats.series import Series, append_frames, appending, frames_behind, frames_of
from beltrami_cli.grid import Grid, Volume

_SCANNER = 1  # NIFTI_XFORM_SCANNER_ANAT
_MM_PER_UNIT = {"unknown": 1.0, "mm": 1.0, "meter": 1e3, "micron": 1e-3}
_SPACES = {1: "scanner", 2: "aligned with another scan", 3: "Talairach", 4: "MNI", 5: "other template"}

# sform and qform place the voxels alike up to this share of a voxel edge: a quaternion of float32, close to half a
# turn, does not hold them better.
_FORMS_TOLERANCE = 0.1


@dataclass(frozen=True)
class NiftiHeader:
    """Template for writing: nibabel's own header, and the grid that its affine stands for."""

    header: Any
    grid: Grid

    @property
    def mm_per_unit(self) -> float:
        return _MM_PER_UNIT[_units(self.header)[0]]


def read(path: Path, dtype: DTypeLike, *, channels: bool = False) -> Volume:
    """The volume, scaled by slope and intercept, in the file's (Fortran) memory order; raises as `open_series`.

    RGB24 and RGBA32 voxels become channels, without the transparency.
    """
    image, template, count, file_shape = _open(path, channels)
    dtype = checks.number_type(dtype, image.get_data_dtype())
    with checks.reading(path, "NIfTI"):
        data = np.asanyarray(image.dataobj) if _is_coloured(image) else np.asanyarray(image.dataobj, dtype)
        if _is_coloured(image):
            data = np.stack([data[name] for name in "RGB"], -1).astype(dtype)
    shape = (*template.grid.shape, count) if count > 1 else template.grid.shape
    return Volume(data.reshape(shape, order="A"), template.grid, file_shape, template, _notes(path, template))


def open_series(path: Path, dtype: DTypeLike, *, channels: bool = True) -> Series:
    """The frames, one in memory at a time (colours are read whole); opening it reads the header alone.

    Raises DataError where the content cannot be read, RefusedError where it is no single real volume: with `channels`,
    where it is neither real channels or frames nor a single complex volume.
    """
    image, template, count, file_shape = _open(path, channels)
    dtype = checks.number_type(dtype, image.get_data_dtype())
    if _is_coloured(image):
        frame = frames_of(lambda: read(path, dtype, channels=True))
    else:
        frame = frames_behind(path, "NIfTI", image.dataobj, template.grid.shape, count, dtype)
    return Series(template.grid, count, file_shape, template, frame, dtype.kind == "c", _notes(path, template))


def files(path: Path) -> list[Path]:
    """What `write` makes: one file, or both of a pair, the image before the header that announces it."""
    if path.suffix.lower() not in (".hdr", ".img"):
        return [path]
    return [path.with_suffix(part.upper() if path.suffix.isupper() else part) for part in (".img", ".hdr")]


def write(path: Path, volume: Volume, dtype: DTypeLike) -> None:
    """Write with slope 1 and intercept 0; header, units and both transforms are the template's where there is one."""
    data = np.asarray(volume.data, checks.number_type(dtype, volume.data.dtype))
    data = data.reshape(checks.with_three_axes(volume.file_shape, volume.channels))
    with checks.writing(path):
        image = _image(path, data, volume.grid, volume.header)
        _forget_stale_range(image.header, data)
        image.to_filename(path)


def write_series(path: Path, series: Series, frames: Iterable[np.ndarray], dtype: DTypeLike) -> None:
    """As `write`, of frames that come one at a time."""
    shape = checks.with_three_axes(series.shape_to_write(), series.count)
    with checks.writing(path):
        # Announces all the frames, and holds none of them.
        header = _image(path, np.broadcast_to(np.zeros((), dtype), shape), series.grid, series.header).header
        header.set_slope_inter(1, 0)
        header["cal_min"] = header["cal_max"] = 0  # the range to come is not known yet
        start = io.BytesIO()
        header.write_to(start)
    voxels, *announcement = files(path)
    for part in announcement:
        with appending(part) as append:
            append(start.getvalue())
    with appending(voxels) as append:
        if not announcement:
            append(start.getvalue().ljust(header.get_data_offset(), b"\0"))
        append_frames(append, series, frames, header.get_data_dtype())


def _image(path: Path, data: np.ndarray, grid: Grid, template: Any) -> Any:
    """nibabel's image of these voxels, placed, with the template's header where it is one of NIfTI."""
    import nibabel as nib

    template = template if isinstance(template, NiftiHeader) else None
    pair, version_2 = len(files(path)) == 2, template is not None and template.header["sizeof_hdr"] == 540
    image_class: Any = {
        (False, False): nib.Nifti1Image,
        (False, True): nib.Nifti2Image,
        (True, False): nib.Nifti1Pair,
        (True, True): nib.Nifti2Pair,
    }[pair, version_2]
    image = image_class(data, None, None if template is None else template.header, dtype=data.dtype)
    if template is not None and template.header.get_data_shape()[3:] != data.shape[3:]:
        # A mask of frames, colours on an axis: the template's step from frame to frame and its meaning are not theirs.
        image.header["pixdim"][4:] = 1
        image.header.set_intent("none")
    _place(image, grid, template)
    return image


def _open(path: Path, channels: bool) -> tuple[Any, NiftiHeader, int, tuple[int, ...]]:
    """nibabel's image, the template, the number of values at a voxel, and the shape with all of them on an axis."""
    import nibabel as nib

    for part in files(path):
        if not part.exists():
            raise RefusedError(f"{path}: half of a pair; expected {part.name} beside it; fetch that file too")
    with checks.reading(path, "NIfTI"):
        # Not mapped: a file that is cut short must fail here, in one line, and not at the first touch of a page.
        image: Any = nib.load(path, mmap=False)
    _require_nifti_volume(path, image)
    file_shape = tuple(map(int, image.shape))
    coloured = _is_coloured(image)
    shape, count = checks.layout(path, file_shape, per_voxel=3 if coloured else 1, channels=channels)
    if coloured:
        file_shape = (*file_shape, 3)
    else:
        checks.require_numbers(path, image.get_data_dtype(), count, channels=channels)
    affine = np.array(image.affine, float)
    affine[:3] *= _MM_PER_UNIT[_units(image.header)[0]]
    checks.require_usable_affine(path, affine)
    return image, NiftiHeader(image.header, Grid(shape, affine)), count, file_shape


def _notes(path: Path, template: NiftiHeader) -> tuple[str, ...]:
    """What the header leaves in doubt about where the voxels lie: its two transforms disagree, or both are unset."""
    from nibabel.spatialimages import HeaderDataError

    header = template.header
    sform, qform = int(header["sform_code"]), int(header["qform_code"])
    if sform == qform == 0:
        return (
            f"{path}: sform and qform are both unset, so that left, right and position are unknown: taken as axes "
            "towards LAS with the origin in the middle, as nibabel does",
        )
    if sform == 0 or qform == 0:
        return ()
    try:
        affine = np.array(header.get_qform(), float)
    except (HeaderDataError, ValueError):  # no rotation; the sform says enough
        return ()
    affine[:3] *= template.mm_per_unit
    apart = template.grid.apart(Grid(template.grid.shape, affine))
    if not apart > _FORMS_TOLERANCE * template.grid.spacing.min():
        return ()
    return (
        f"{path}: sform ({_space(sform)}) and qform ({_space(qform)}) place its voxels up to {apart:.3g} mm apart: the "
        "sform is used",
    )


def _space(code: int) -> str:
    return f"code {code}, {_SPACES.get(code, 'unknown')}"


def _is_coloured(image: Any) -> bool:
    return {"R", "G", "B"} <= set(image.get_data_dtype().names or ())


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
    if np.iscomplexobj(data):
        finite = np.abs(finite)
    if finite.size and not (low <= finite.min() and finite.max() <= high):
        header["cal_min"] = header["cal_max"] = 0
