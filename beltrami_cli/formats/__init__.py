"""The one door to files: volumes, surfaces and vertex data, each format by its suffix or its content.

The only place that knows RAS from LPS, units from millimetres and one header from another.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from beltrami_cli.errors import RefusedError
from beltrami_cli.formats import checks, freesurfer, gifti, metaimage, mgh, nifti, npy, plain_mesh, png
from beltrami_cli.formats.checks import require_file, writing
from beltrami_cli.formats.overlays import (
    is_overlay,
    overlay_files,
    overlay_format,
    overlay_structure,
    read_maps,
    read_named_overlay,
    read_overlay,
    require_overlay_writable,
    write_overlay,
)
from beltrami_cli.formats.plain_mesh import read_curve, read_values
from beltrami_cli.formats.series import Series, counted
from beltrami_cli.formats.staging import Stage, is_unfinished, who_writes
from beltrami_cli.formats.structures import STRUCTURES, parse_structure, structure_of_name
from beltrami_cli.formats.surfaces import is_surface, read_surface, surface_format
from beltrami_cli.grid import Grid, Volume
from beltrami_cli.surface import Mesh

__all__ = [
    "STRUCTURES",
    "Series",
    "Stage",
    "input_files",
    "is_npy",
    "is_overlay",
    "is_surface",
    "is_unfinished",
    "mesh_beside",
    "mesh_files",
    "mesh_format",
    "open_series",
    "overlay_files",
    "overlay_format",
    "overlay_structure",
    "parse_structure",
    "read_curve",
    "read_grid",
    "read_layout",
    "read_maps",
    "read_named_overlay",
    "read_overlay",
    "read_surface",
    "read_values",
    "read_volume",
    "require_file",
    "require_overlay_writable",
    "require_writable",
    "stem",
    "structure_of_name",
    "surface_format",
    "volume_files",
    "volume_format",
    "who_writes",
    "write_mesh",
    "write_overlay",
    "write_series",
    "write_volume",
    "writing",
]

_VOLUMES = {
    ".nii": "NIfTI",
    ".nii.gz": "NIfTI",
    ".hdr": "NIfTI",
    ".img": "NIfTI",
    ".mha": "MetaImage",
    ".mhd": "MetaImage",
    ".npy": "NPY",
    ".mgz": "MGH",
    ".mgh": "MGH",
    ".png": "PNG",
}
_MODULES = {"NIfTI": nifti, "MetaImage": metaimage, "NPY": npy, "MGH": mgh, "PNG": png}
_MESHES = {".surf.gii": "GIFTI", ".ply": "PLY", ".obj": "OBJ", ".stl": "STL", ".glb": "GLB", ".vtk": "VTK"}


def volume_format(path: Path) -> str:
    """NIfTI, MetaImage, NPY, MGH or PNG, by suffix; raises RefusedError, with the known ones, for another suffix."""
    return _by_suffix(Path(path), _VOLUMES, "volume")


def mesh_format(path: Path) -> str:
    """GIFTI, PLY, OBJ, STL, GLB or VTK, by suffix; raises RefusedError, with the known ones, for another suffix."""
    return _by_suffix(Path(path), _MESHES, "mesh")


def is_npy(path: Path) -> bool:
    """True for the one format that does not hold its spacing."""
    return Path(path).suffix.lower() == ".npy"


def stem(path: Path) -> Path:
    """The path without its format suffix: o.nii.gz -> o, o.func.gii -> o.func, lh.map (FreeSurfer's) -> lh.map.

    Raises RefusedError where nothing is left but dots, which name folders.
    """
    path = Path(path)
    if freesurfer.is_name(path) and path.name[:3].lower() in ("lh.", "rh."):
        return path
    suffix = ".nii.gz" if path.name.lower().endswith(".nii.gz") else path.suffix
    name = path.name[: len(path.name) - len(suffix)]
    if not name.strip("."):
        raise RefusedError(f"{path}: no name of a file; expected one with more than dots before its suffix")
    return path.with_name(name)


def read_grid(
    path: Path, *, spacing: float | Sequence[float] | None = None, channels: bool = False, plane: bool = False
) -> Grid:
    """The grid of a volume from its header alone; arguments and errors as `read_volume`."""
    return _look(path, spacing, np.float32, channels, plane).grid


def read_layout(path: Path, *, plane: bool = False) -> tuple[int, bool]:
    """How many channels or frames a file has, and whether its numbers are complex, from its header alone.

    Raises as `read_volume` with `channels`.
    """
    found = _look(path, None, np.float32, True, plane)
    return found.count, found.is_complex


def read_volume(
    path: Path,
    *,
    spacing: float | Sequence[float] | None = None,
    dtype: DTypeLike = np.float32,
    channels: bool = False,
    plane: bool = False,
) -> Volume:
    """Read a volume as `dtype` (float32 or float64), indexed (i, j, k) alike whatever the format, on a RAS mm grid.

    Trailing axes of length 1 are dropped and a plane gets one slice; `Volume.file_shape` keeps the shape as stored.
    NaN and infinite values stay as they are. The array has the file's memory order.

    spacing: mm per voxel, one number or one per axis, for NPY, which holds none (default 1).
    channels: accept several values per voxel - a fourth axis, a NIfTI vector's fifth, vector pixels, colours (without
        their transparency) - on a last axis of the data, and complex numbers, as complex64 for float32 and complex128
        for float64.
    plane: with `channels`, an NPY array of three axes is a plane (nx, ny, K); else it is a volume.

    Raises RefusedError for an unknown suffix, a missing file, several values or complex ones without `channels`,
    several complex ones, or `spacing` where the format has its own; DataError where the content cannot be read.
    """
    path = Path(path)
    module, options = _reader(path, spacing, channels, plane)
    return module.read(path, dtype=dtype, **options)


def open_series(
    path: Path, *, spacing: float | Sequence[float] | None = None, dtype: DTypeLike = np.float32, plane: bool = False
) -> Series:
    """The frames or channels of a file, read as `dtype` one at a time; a single volume is a series of one.

    NIfTI and MGH stay open and NPY is mapped, so that one frame is in memory (of NPY in C order, where a frame touches
    every page, what the system keeps of the file); MetaImage, PNG and coloured NIfTI are read whole at the first frame.
    Arguments and errors as `read_volume` with `channels`; complex numbers are refused.
    """
    found = _look(path, spacing, dtype, True, plane)
    if found.is_complex:
        raise RefusedError(
            f"{path}: expected real values; found a complex volume, whose real and imaginary part belong together; "
            "extract magnitude or phase, or, as data to denoise, drop --independent"
        )
    return found


def input_files(path: Path) -> list[Path]:
    """Every file that is read for this path: both of a pair of header and voxels; a surface or vertex data alone.

    Raises RefusedError where it is missing or none of these.
    """
    path = Path(path)
    if is_surface(path) or is_overlay(path):
        return [path]
    match _readable_format(path):
        case "NIfTI":
            return nifti.files(path)
        case "MetaImage":
            return metaimage.input_files(path)
        case _:
            return [path]


def volume_files(path: Path) -> list[Path]:
    """Every file that `write_volume` makes for this path; raises RefusedError where the format is not written."""
    path = Path(path)
    match volume_format(path):
        case "NIfTI":
            return nifti.files(path)
        case "MetaImage":
            return metaimage.files(path)
        case "PNG":
            raise RefusedError(f"{path}: PNG pictures are read only, they hold no real numbers; write .npy or .nii.gz")
        case _:
            return [path]


def require_writable(path: Path, grid: Grid, *, channels: int = 1, is_complex: bool = False) -> None:
    """Raise RefusedError where such a volume on this grid cannot be written to this path: before anything is computed.

    channels: values per voxel, which every written format can hold. is_complex: NIfTI and NPY alone hold such.
    """
    path = Path(path)
    volume_files(path)
    match volume_format(path):
        case "MetaImage":
            metaimage.require_writable(path, grid, is_complex=is_complex)
        case "MGH" if is_complex:
            raise RefusedError(f"{path}: MGH cannot hold complex numbers; write NIfTI or NPY")
    if is_complex and channels > 1:
        raise RefusedError(f"{path}: cannot hold {channels} complex numbers per voxel; expected one")


def write_volume(path: Path, volume: Volume, *, dtype: DTypeLike = np.float32) -> None:
    """Write `volume.data` as `dtype` in the shape `volume.file_shape`, channels or frames on the last axis.

    dtype: float32, float64 (MGH: float32 all the same) or, for masks, uint8; complex data keep its precision. In
    MetaImage channels are vector pixels, unless the volume came from frames of that format.
    The header is that of the file which the volume came from where the format is the same, else a fresh one. Makes
    `volume_files(path)`, replacing what is there. Raises RefusedError as `require_writable`, DataError where the
    file cannot be written.
    """
    path = Path(path)
    require_writable(path, volume.grid, channels=volume.channels, is_complex=np.iscomplexobj(volume.data))
    match volume_format(path):
        case "NIfTI":
            nifti.write(path, volume, dtype)
        case "MetaImage":
            metaimage.write(path, volume, dtype)
        case "MGH":
            mgh.write(path, volume, dtype)
        case _:
            npy.write(path, volume, dtype)


def write_series(path: Path, series: Series, frames: Iterable[np.ndarray], *, dtype: DTypeLike = np.float32) -> None:
    """Write `series.count` frames of shape `series.grid.shape` as they come, with the series' header.

    NIfTI and NPY (there in Fortran order) are written frame by frame; MGH and MetaImage gather all of them first.
    Otherwise as `write_volume`. Raises ValueError where frames are missing or too many.
    """
    path = Path(path)
    require_writable(path, series.grid, channels=series.count)
    match volume_format(path):
        case "NIfTI":
            nifti.write_series(path, series, frames, dtype)
        case "NPY":
            npy.write_series(path, series, frames, dtype)
        case _:
            gathered = np.stack([frame.astype(dtype) for frame in counted(series, frames)], -1)
            data = gathered if series.count > 1 else gathered[..., 0]
            write_volume(path, Volume(data, series.grid, series.shape_to_write(), series.header), dtype=dtype)


def mesh_beside(path: Path, *, curve: bool = False) -> Path:
    """The mesh that goes with an output where none is named: .ply for MetaImage, NPY and a curve, .surf.gii else.

    For vertex data too: o.func.gii -> o.surf.gii, lh.map -> lh.map.surf.gii.
    """
    name = stem(path).name.removesuffix(".func").removesuffix(".shape")
    plain = curve or Path(path).suffix.lower() in (".mha", ".mhd", ".npy")
    return Path(path).with_name(name + (".ply" if plain else ".surf.gii"))


def mesh_files(path: Path, *, values: bool = True, curve: bool = False) -> list[Path]:
    """Every file that `write_mesh` makes for this path: .surf.gii has its values in .func.gii beside it.

    Raises RefusedError for an unknown suffix, and for a curve in a format that holds no lines (GIFTI, STL, GLB).
    """
    path = Path(path)
    kind = mesh_format(path)
    if curve and kind in ("GIFTI", "STL", "GLB"):
        raise RefusedError(f"{path}: {kind} holds triangles, not the lines of a curve; write .ply, .vtk or .obj")
    if kind == "GIFTI" and values:
        return [path, gifti.values_file(path)]
    return [path]


def write_mesh(path: Path, mesh: Mesh) -> list[Path]:
    """Write the mesh in RAS mm, vertices and faces in the order given, and return the files made.

    Values are numbers in PLY, VTK and GIFTI (`value`; `value_1`, in GIFTI `value 1`, and so on for several channels)
    and colours in PLY, OBJ and GLB (`colours.rgb`: true ones, or of the value or magnitude); STL holds the shape alone.
    Raises RefusedError as `mesh_files`, DataError where a file cannot be written.
    """
    path = Path(path)
    curve = mesh.cells.shape[1] == 2
    written = mesh_files(path, values=mesh.values is not None, curve=curve)
    match mesh_format(path):
        case "GIFTI":
            gifti.write(path, mesh)
        case "PLY":
            plain_mesh.write_ply(path, mesh)
        case "VTK":
            plain_mesh.write_vtk(path, mesh)
        case "OBJ" if curve:
            plain_mesh.write_obj_lines(path, mesh)
        case _:
            plain_mesh.write_with_trimesh(path, mesh)
    return written


def _by_suffix(path: Path, known: dict[str, str], what: str) -> str:
    for suffix, kind in known.items():
        if path.name.lower().endswith(suffix) and len(path.name) > len(suffix):
            return kind
    raise RefusedError(f"{path}: not the suffix of a {what}; expected one of {' '.join(known)}")


def _readable_format(path: Path) -> str:
    """As `volume_format`; raises RefusedError, saying what it is, for what cannot be read as a volume."""
    checks.require_file(path)
    try:
        return volume_format(path)
    except RefusedError:
        if is_surface(path):
            raise RefusedError(f"{path}: is a surface; expected a volume: are the arguments swapped?") from None
        if is_overlay(path):
            raise RefusedError(f"{path}: holds values at vertices; expected a volume") from None
        raise


def _require_readable(path: Path, spacing: float | Sequence[float] | None) -> str:
    kind = _readable_format(path)
    if spacing is not None and kind != "NPY":
        raise RefusedError(f"{path}: {kind} has its own spacing; --spacing is for .npy only")
    return kind


def _reader(
    path: Path, spacing: float | Sequence[float] | None, channels: bool, plane: bool
) -> tuple[Any, dict[str, Any]]:
    """The module of a readable file's format, and what its `read` and `open_series` are to be told."""
    kind = _require_readable(path, spacing)
    options: dict[str, Any] = {"channels": channels}
    if kind == "NPY":
        options |= {"spacing": _steps(spacing), "plane": plane}
    return _MODULES[kind], options


def _look(path: Path, spacing: float | Sequence[float] | None, dtype: DTypeLike, channels: bool, plane: bool) -> Series:
    """What the header says, with values to be read on demand."""
    path = Path(path)
    module, options = _reader(path, spacing, channels, plane)
    return module.open_series(path, dtype=dtype, **options)


def _steps(spacing: float | Sequence[float] | None) -> float | tuple[float, ...]:
    if spacing is None:
        return 1.0
    steps = np.atleast_1d(np.asarray(spacing, float))
    if len(steps) not in (1, 2, 3) or not (np.isfinite(steps) & (steps > 0)).all():
        raise RefusedError(f"spacing {spacing}: expected one positive number of mm, or one for each axis")
    return float(steps[0]) if len(steps) == 1 else tuple(map(float, steps))
