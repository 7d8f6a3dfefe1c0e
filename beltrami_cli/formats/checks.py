"""What every format has to refuse, and the guard that turns a library's failure into one line."""

from __future__ import annotations

import errno
import logging
import os
import shutil
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

from beltrami_cli.errors import BeltramiError, DataError, RefusedError

# Bytes that a file system gives at a time: a disk with less is full.
_A_PAGE = 4096
# Vertices per hemisphere of the usual cortical meshes, whose data is often stored in volume files.
_SURFACE_SIZES = {642, 2562, 10242, 40962, 163842, 32492, 59292}


@contextmanager
def reading(path: Path, kind: str) -> Iterator[None]:
    """Run a library's reader: its warnings and log lines stay silent, whatever it raises becomes a DataError."""
    with _quietly():
        try:
            yield
        except BeltramiError:
            raise
        except Exception as error:
            raise DataError(
                f"{path}: cannot be read as {kind} ({_reason(error, 'damaged, cut short or of another kind')}); "
                "expected a complete file of that format: check that it was copied or downloaded whole"
            ) from error


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Run a library's writer: as `reading`, with a line that says that the file could not be written."""
    with _quietly():
        try:
            yield
        except BeltramiError:
            raise
        except Exception as error:
            reason = _reason(error, "the folder or the disk refuses it")
            if _is_full(path.parent):  # which not every library says
                reason = os.strerror(errno.ENOSPC)
            raise DataError(f"{path.name}: cannot be written ({reason}); check the disk and its quota") from error


def require_file(path: Path) -> None:
    """Raise RefusedError unless `path` is a file that can be opened."""
    if path.is_symlink() and not path.exists():
        raise RefusedError(
            f"{path}: a link to a file that is not there; fetch its content first (datalad get, git annex)"
        )
    if not path.exists():
        raise RefusedError(f"{path}: no such file; check the path")
    if not path.is_file():
        raise RefusedError(f"{path}: is a {'folder' if path.is_dir() else 'device'}; expected a file")
    try:
        path.open("rb").close()
    except OSError as error:
        raise RefusedError(f"{path}: cannot be opened ({error.strerror}); check its permissions") from error


def layout(
    path: Path, axes: tuple[int, ...], *, per_voxel: int = 1, channels: bool = False
) -> tuple[tuple[int, int, int], int]:
    """The three spatial axes of an array as stored, a plane given one slice, and the number of values at each voxel.

    axes: the array's shape; behind the third, axes of length 1 do not count, and one other holds channels or frames.
    per_voxel: numbers that each element is made of (vector and coloured pixels).
    Raises RefusedError for several values at a voxel without `channels`, for two axes of them, for a single line of
    values and for an empty array.
    """
    found = f"{len(axes)}-D ({' x '.join(map(str, axes))})"
    if len(axes) < 2:
        raise RefusedError(f"{path}: expected a volume of 2 or 3 axes; found {found}")
    if 0 in axes:
        raise RefusedError(f"{path}: expected values; found an empty array, {found}")
    several = [n for n in (*axes[3:], per_voxel) if n > 1]
    if len(several) > 1:
        raise RefusedError(
            f"{path}: expected one axis of channels or frames behind x, y, z; found {len(several)}, of lengths "
            f"{' and '.join(map(str, several))}; extract one frame"
        )
    if several and not channels:
        raise RefusedError(
            f"{path}: expected one number per voxel; found {_several(axes, per_voxel)}; extract one, or, as data that "
            "denoise or sample takes, keep all with --kind vector"
        )
    nx, ny, nz = (*axes, 1)[:3]
    if is_row(axes):
        on_mesh = nx * ny * nz in _SURFACE_SIZES
        guess = f", {nx * ny * nz} values as on a cortical mesh" if on_mesh else ""
        raise RefusedError(
            f"{path}: expected a volume or a plane; found {found}{guess}: data of a surface or a time course, "
            "not of voxels; give the volume instead, or, with data of a surface, that surface in the level set's place"
        )
    return (nx, ny, nz), (several or [1])[0]


def is_row(axes: tuple[int, ...], vertices: int | None = None) -> bool:
    """True where the first three axes of an array hold values of a surface or a time course: a row, or a folded one.

    Long rows of vertices are also stored folded (fsaverage as 27307 x 1 x 6): known by the number of values, which is
    that of a usual cortical mesh or `vertices`.
    """
    nx, ny, nz = (*axes, 1, 1)[:3]
    folded = nx * ny * nz in (*_SURFACE_SIZES, vertices) and len(axes) > 2 and 1 in (nx, ny, nz)
    return sorted((nx, ny, nz))[1] == 1 or folded


def _several(axes: tuple[int, ...], per_voxel: int) -> str:
    if per_voxel > 1:
        return f"{per_voxel} channels in each (vector or RGB pixels)"
    return f"several frames or channels, {len(axes)}-D ({', '.join(('x', 'y', 'z', *map(str, axes[3:])))})"


def require_numbers(path: Path, dtype: np.dtype, count: int, *, channels: bool = False) -> None:
    """Raise RefusedError unless voxels of this type are real numbers, or, with `channels`, one complex number each."""
    if dtype.kind == "c" and not channels:
        raise RefusedError(
            f"{path}: expected real values; found complex ones ({dtype}); extract magnitude or phase, or, as data that "
            "denoise or sample takes, keep real and imaginary part with --kind vector"
        )
    if dtype.kind == "c" and count > 1:
        raise RefusedError(
            f"{path}: expected one complex number per voxel; found {count} of them ({dtype}); extract one frame, or "
            "store real and imaginary parts as channels"
        )
    if dtype.kind not in "fiubc":
        raise RefusedError(f"{path}: expected numbers; found values of type {dtype}; convert them")


def with_three_axes(file_shape: tuple[int, ...], channels: int) -> tuple[int, ...]:
    """The shape in a format where channels never stand on the third axis: a picture (nx, ny, K) gets one slice."""
    return (*file_shape[:2], 1, channels) if channels > 1 and len(file_shape) == 3 else file_shape


def number_type(asked: DTypeLike, found: np.dtype) -> np.dtype:
    """`asked`, or its complex twin (float32 -> complex64) where values of type `found` are complex."""
    return np.result_type(asked, np.complex64) if found.kind == "c" else np.dtype(asked)


def require_usable_affine(path: Path, affine: np.ndarray) -> None:
    """Raise DataError unless `affine` maps voxels to distinct, finite points."""
    if not np.isfinite(affine).all() or abs(np.linalg.det(affine[:3, :3])) < 1e-12 * np.abs(affine[:3, :3]).max() ** 3:
        rows = "; ".join(" ".join(f"{v:.4g}" for v in row) for row in affine[:3])
        raise DataError(f"{path}: its header places the voxels nowhere: affine [{rows}]; repair the header")


@contextmanager
def native_stderr_muted() -> Iterator[None]:
    """Silence C and C++ code, which prints its complaints to the process's stderr beside the error that it raises."""
    try:
        saved = os.dup(2)
    except OSError:
        yield
        return
    try:
        with open(os.devnull, "wb") as nowhere:
            os.dup2(nowhere.fileno(), 2)
        yield
    finally:
        os.dup2(saved, 2)
        os.close(saved)


@contextmanager
def _quietly() -> Iterator[None]:
    log = logging.getLogger("nibabel.global")
    was_disabled, log.disabled = log.disabled, True
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        log.disabled = was_disabled


def _is_full(folder: Path) -> bool:
    try:
        return shutil.disk_usage(folder).free < _A_PAGE
    except OSError:
        return False


def _reason(error: Exception, otherwise: str) -> str:
    """The library's own words, or `otherwise` where they mean nothing to a user."""
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return otherwise if not lines or isinstance(error, LookupError) or "ITK" in str(error) else lines[0]
