"""Vertex data: a value, or one of each map, for every vertex of a surface, in the order of its vertices."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.formats import checks, freesurfer, gifti
from beltrami_cli.formats.structures import structure_of_name
from beltrami_cli.surface import Mesh

_GIFTI_METRICS = (".func.gii", ".shape.gii")
_NUMBERED = re.compile(r"(map|frame|value)( \d+)?")  # what maps are called that nobody named
_SUFFIXES = {".gii": "GIFTI", ".mgz": "MGH", ".mgh": "MGH", ".nii": "NIfTI", ".nii.gz": "NIfTI"}


def is_overlay(path: Path, vertices: int | None = None) -> bool:
    """True for a file to be read by `read_overlay`; reads a header at most.

    GIFTI by suffix, or where it holds no surface; .mgz, .mgh and .nii(.gz) whose voxels are one row, or, folded, as
    many as the usual cortical meshes or `vertices` have, and CIFTI; FreeSurfer's values by their first bytes.
    """
    path = Path(path)
    if path.name.lower().endswith((*_GIFTI_METRICS, ".label.gii")):
        return True
    if not path.is_file():
        return False
    match _suffix_format(path):
        case "GIFTI":
            return not path.name.lower().endswith(".surf.gii") and not gifti.holds_surface(path)
        case None:
            is_old = freesurfer.is_name(path) and freesurfer.is_old_morph(path)
            return is_old or freesurfer.magic(path) == freesurfer.MORPH
        case kind:
            return _is_row(path, kind, vertices)


def overlay_format(path: Path) -> str:
    """GIFTI, MGH or NIfTI, by suffix, or FreeSurfer: by name (lh.NAME, rh.NAME, NAME.curv) or by content.

    Raises RefusedError for another file.
    """
    path = Path(path)
    kind = _suffix_format(path)
    if kind is not None:
        return kind
    if freesurfer.is_name(path) or freesurfer.magic(path) == freesurfer.MORPH:
        return "FreeSurfer"
    raise RefusedError(
        f"{path}: not a file of vertex data; expected {' '.join(_GIFTI_METRICS)} .mgz .mgh, or FreeSurfer's lh.NAME, "
        "rh.NAME or NAME.curv"
    )


def overlay_files(path: Path) -> list[Path]:
    """Every file that `write_overlay` makes for this path; raises RefusedError where the format is not written."""
    path = Path(path)
    kind = overlay_format(path)
    if kind == "NIfTI" or (kind == "GIFTI" and not path.name.lower().endswith(_GIFTI_METRICS)):
        raise RefusedError(
            f"{path}: vertex data is not written so; expected {' '.join(_GIFTI_METRICS)} .mgz or lh.NAME"
        )
    return [path]


def require_overlay_writable(path: Path, channels: int) -> None:
    """Raise RefusedError where so many values per vertex cannot be written to this path: before anything is computed.

    FreeSurfer's own format holds one, the others any number.
    """
    path = Path(path)
    overlay_files(path)
    if channels > 1 and overlay_format(path) == "FreeSurfer":
        raise RefusedError(
            f"{path}: FreeSurfer's format holds one value per vertex; found {channels}; write .mgz or .func.gii"
        )


def overlay_structure(path: Path) -> str | None:
    """Of which structure a file's values are, as `Mesh.structure`: by what GIFTI says, else by its name (lh., hemi-L).

    Raises RefusedError where the file is no vertex data, DataError where it cannot be read.
    """
    path = Path(path)
    kind = overlay_format(path)
    checks.require_file(path)
    return (gifti.read_structure(path) if kind == "GIFTI" else None) or structure_of_name(path)


def read_maps(path: Path, vertices: int | None = None) -> dict[str, np.ndarray]:
    """Every map or frame of a file, (N,) as stored, by name (`map 1`, `frame 1` ... where it has none).

    vertices: of the surface, where it is known: rows of other files are then known by their number of values.
    Raises RefusedError where the file is no vertex data, DataError where it cannot be read.
    """
    path = Path(path)
    kind = overlay_format(path)
    checks.require_file(path)
    match kind:
        case "GIFTI":
            return gifti.read_maps(path, vertices)
        case "FreeSurfer":
            return {"map 1": freesurfer.read_morph(path)}
        case _:
            return _read_voxels(path, kind, vertices)


def read_overlay(
    path: Path, vertices: int, *, dtype: DTypeLike = np.float32, channels: bool = False, map: str | int | None = None
) -> np.ndarray:
    """Values (V,) at the `vertices` of a surface, or (V, K) of several maps or frames; NaN stays NaN.

    channels: accept several maps, all of them, as channels. map: the one to take, by its name or its number from 1.

    Raises RefusedError where the file is no vertex data, has several maps and neither is given, has no such map, or
    another number of values than the surface has vertices; DataError where it cannot be read.
    """
    return read_named_overlay(path, vertices, dtype=dtype, channels=channels, map=map)[0]


def read_named_overlay(
    path: Path, vertices: int, *, dtype: DTypeLike = np.float32, channels: bool = False, map: str | int | None = None
) -> tuple[np.ndarray, list[str] | None]:
    """As `read_overlay`, with the names that the maps have in GIFTI, None where they have none of their own."""
    path = Path(path)
    maps = read_maps(path, vertices)
    chosen = _chosen(path, maps, channels, map)
    for name in chosen:
        _require_fit(path, maps[name], vertices)
    columns = [maps[name].astype(dtype) for name in chosen]
    unnamed = overlay_format(path) != "GIFTI" or any(_NUMBERED.fullmatch(name) for name in chosen)
    return columns[0] if len(columns) == 1 else np.stack(columns, -1), None if unnamed else chosen


def write_overlay(
    path: Path,
    values: np.ndarray,
    *,
    structure: str | None = None,
    dtype: DTypeLike = np.float32,
    names: Sequence[str] | None = None,
) -> None:
    """Write values (V,), or (V, K) as K maps or frames.

    names: of the maps, for GIFTI; by default those of a mesh's values, several of which are the frames of a series.
    structure: for GIFTI, as `Mesh.structure`. dtype: uint8 for a mask in MGH; else everything is stored as float32.
    NaN is kept in every format. Raises RefusedError as `require_overlay_writable`, DataError where writing fails.
    """
    path = Path(path)
    require_overlay_writable(path, values.shape[1] if values.ndim > 1 else 1)
    match overlay_format(path):
        case "GIFTI":
            no_geometry = Mesh(np.empty((0, 3)), np.empty((0, 3), np.int32), values)
            maps = no_geometry.named_values()
            if names is not None:
                maps = dict(zip(names, maps.values(), strict=True))
            gifti.write_maps(path, maps, structure, series=names is None)
        case "MGH":
            _write_mgh(path, values, np.uint8 if np.dtype(dtype) == np.uint8 else np.float32)
        case _:
            freesurfer.write_morph(path, values.reshape(-1))


def _suffix_format(path: Path) -> str | None:
    return next((kind for suffix, kind in _SUFFIXES.items() if path.name.lower().endswith(suffix)), None)


@contextmanager
def _opened(path: Path, kind: str) -> Iterator[Any]:
    """nibabel's image, its file open; raises DataError where it, or what is done with it, cannot be read."""
    import nibabel as nib
    from nibabel.openers import ImageOpener

    with checks.reading(path, kind):
        if kind == "NIfTI":
            yield nib.load(path, mmap=False)
        else:
            # Opened here: nibabel would leave a file open that is cut short in its header.
            with ImageOpener(path) as file:
                yield nib.MGHImage.from_file_map({"image": nib.FileHolder(fileobj=file)})


def _is_cifti(image: Any) -> bool:
    import nibabel as nib

    return isinstance(image, nib.Cifti2Image)


def _is_row(path: Path, kind: str, vertices: int | None) -> bool:
    try:
        with _opened(path, kind) as image:
            return _is_cifti(image) or checks.is_row(tuple(map(int, image.shape)), vertices)
    except DataError:
        return False


def _read_voxels(path: Path, kind: str, vertices: int | None) -> dict[str, np.ndarray]:
    """The rows of a volume file, (N,) for each frame; folded rows run along the first axis first, as FreeSurfer's."""
    with _opened(path, kind) as image:
        if _is_cifti(image):
            raise RefusedError(
                f"{path}: CIFTI, data of both hemispheres and of voxels; expected that of one surface; take it out: "
                "wb_command -cifti-separate IN COLUMN -metric CORTEX_LEFT OUT.func.gii"
            )
        shape = (*map(int, image.shape), 1, 1)[: max(3, len(image.shape))]
        frames = math.prod(shape[3:])
        if math.prod(shape[:3]) != vertices and not checks.is_row(shape):
            raise RefusedError(
                f"{path}: expected a row of {vertices or 'any number of'} values, one for each vertex; found a volume "
                f"of {' x '.join(map(str, shape))} voxels; bring it onto the surface first: beltrami sample"
            )
        checks.require_numbers(path, image.get_data_dtype(), frames)
        data = np.asanyarray(image.dataobj).reshape((-1, frames), order="F")
    return {f"frame {t + 1}": data[:, t] for t in range(frames)}


def _write_mgh(path: Path, values: np.ndarray, dtype: type[np.generic]) -> None:
    import nibabel as nib

    frames = values.shape[1:] if values.shape[1:] != (1,) else ()
    with checks.writing(path):
        nib.MGHImage(values.reshape((len(values), 1, 1, *frames)).astype(dtype), None).to_filename(path)


def _chosen(path: Path, maps: dict[str, np.ndarray], channels: bool, wanted: str | int | None) -> list[str]:
    """Names of the maps to take; raises RefusedError where the choice is missing or impossible."""
    names = list(maps)
    listing = ", ".join(names[:8]) + (f" ... ({len(names)} in all)" if len(names) > 8 else "")
    if wanted is None:
        if len(names) > 1 and not channels:
            raise RefusedError(
                f"{path}: expected one value per vertex; found {len(names)} maps: {listing}; keep one in the file, "
                "or, as data to denoise, choose one by name or number with --map, or take all with --kind vector"
            )
        return names
    if wanted in maps:
        return [str(wanted)]
    number = int(wanted) if str(wanted).isdecimal() else 0
    if not 1 <= number <= len(names):
        raise RefusedError(f"{path}: has no map {wanted}; found {listing}; give one of these, or a number from 1")
    return [names[number - 1]]


def _require_fit(path: Path, values: np.ndarray, vertices: int) -> None:
    checks.require_numbers(path, values.dtype, 1)
    if len(values) != vertices:
        raise RefusedError(
            f"{path}: {len(values)} values for {vertices} vertices; expected one value for each vertex of the surface; "
            "give data and surface of one subject, hemisphere and resolution"
        )
