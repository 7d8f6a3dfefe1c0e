"""GIFTI: surfaces in .surf.gii, values at their vertices in .func.gii and .shape.gii, read and written by nibabel."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.formats import checks
from beltrami_cli.formats.frames import StoredSurface, tkr_to_scanner
from beltrami_cli.formats.structures import structure_of_text
from beltrami_cli.surface import Mesh

# Not the zlib-compressed variant: on 600,000 triangles it takes 0.5 s, ten times as long, to save 8 MB.
_ENCODING = "GIFTI_ENCODING_B64BIN"
_UNKNOWN, _SCANNER, _ALIGNED = 0, 1, 2  # NIFTI_XFORM_UNKNOWN, _SCANNER_ANAT, _ALIGNED_ANAT
_POINTSET, _TRIANGLE, _NODE_INDEX = 1008, 1009, 2002  # NIFTI_INTENT_...
_STRUCTURE = "AnatomicalStructurePrimary"


def values_file(path: Path) -> Path:
    """NAME.func.gii for NAME.surf.gii."""
    return path.with_name(path.name[: -len(".surf.gii")] + ".func.gii")


def holds_surface(path: Path) -> bool:
    """True where the file has an array of vertices, by the text of its tags."""
    try:
        return b"NIFTI_INTENT_POINTSET" in path.read_bytes()
    except OSError:
        return False


def read_surface(path: Path) -> StoredSurface:
    """The vertices as stored, and what the file says of their frame.

    A DataSpace other than UNKNOWN is one of the world (Connectome Workbench always writes TALAIRACH, whatever the
    world): as stored. Of UNKNOWN there are three cases:
    - with a matrix to SCANNER or ALIGNED, as mris_convert writes it since FreeSurfer 7.4: that matrix;
    - else with a complete volume geometry (VolGeomWidth ... VolGeomC_S) whose centre is not 0, as mris_convert wrote it
      before: tkr by that geometry. A matrix to TALAIRACH, which stands beside it, is talairach.xfm: it leads to a
      template's space and is not applied. fMRIPrep moves the vertices and removes, once zeroed, that centre;
    - else as stored.
    A file by mris_convert --to-scanner before FreeSurfer 7.4 cannot be told from one in tkr: `frame` is to say it.
    Of several coordinate systems nibabel keeps the last.

    Raises RefusedError where there are no vertices or triangles, DataError where the file cannot be read.
    """
    image = _load(path)
    points = image.get_arrays_from_intent(_POINTSET)
    triangles = image.get_arrays_from_intent(_TRIANGLE)
    if not points or not triangles:
        only_values = len(image.darrays) > len(points) + len(triangles)
        found = "values at vertices; give them as data, and their .surf.gii" if only_values else "neither"
        raise RefusedError(f"{path}: expected a surface, vertices and triangles; found {found}")
    vertices, cells = np.array(points[0].data, float), np.asarray(triangles[0].data)
    if vertices.shape[1:] != (3,) or cells.shape[1:] != (3,):
        raise DataError(
            f"{path}: expected three columns of vertices and triangles; found {vertices.shape}, {cells.shape}"
        )
    frame, matrix = _frame(points[0])
    structure = structure_of_text(points[0].meta.get(_STRUCTURE) or image.meta.get(_STRUCTURE))
    return StoredSurface(vertices, cells.astype(np.int32), frame, tkr_to_scanner=matrix, structure=structure)


def read_maps(path: Path, vertices: int | None = None) -> dict[str, np.ndarray]:
    """Every map of values, (N,) as stored, by its name in the file or `map 1`, `map 2` ... where it has none.

    Maps of some vertices only (NODE_INDEX) are spread over all `vertices`, or up to the last one, NaN elsewhere.
    Raises RefusedError where there is none, DataError where the file cannot be read.
    """
    image = _load(path)
    nodes = image.get_arrays_from_intent(_NODE_INDEX)
    maps: dict[str, np.ndarray] = {}
    for array in image.darrays:
        if array.intent in (_POINTSET, _TRIANGLE, _NODE_INDEX):
            continue
        # Vectors and, by some programs, series have a column for each value.
        for column in np.atleast_2d(np.asarray(array.data).T):
            name = array.meta.get("Name") or f"map {len(maps) + 1}"
            values = _spread(path, column, nodes[0].data, vertices) if nodes else column
            maps[name if name not in maps else f"{name} ({len(maps) + 1})"] = values
    if not maps:
        raise RefusedError(f"{path}: expected values at vertices; found a surface; give it in the level set's place")
    return maps


def read_structure(path: Path) -> str | None:
    """What the file, or the first of its arrays that does, says of its structure; raises DataError."""
    image = _load(path)
    said = (structure_of_text(part.meta.get(_STRUCTURE)) for part in (image, *image.darrays))
    return next(filter(None, said), None)


def write(path: Path, mesh: Mesh) -> None:
    """Write vertices as float32, in scanner RAS where known, and triangles; the values, if any, in `values_file`."""
    from nibabel import gifti

    code = _SCANNER if mesh.placed else _UNKNOWN
    space = gifti.GiftiCoordSystem(dataspace=code, xformspace=code, xform=np.eye(4))
    meta = {"GeometricType": "Anatomical"} | _structure_meta(mesh.structure)
    vertices = _array(mesh.vertices_ras_mm, "NIFTI_INTENT_POINTSET", np.float32, meta, coordsys=space)
    triangles = _array(mesh.cells, "NIFTI_INTENT_TRIANGLE", np.int32, {})
    _save(path, [vertices, triangles], mesh.structure)
    if mesh.values is not None:
        write_maps(values_file(path), mesh.named_values(), mesh.structure)


def write_maps(path: Path, maps: Mapping[str, np.ndarray], structure: str | None, *, series: bool = True) -> None:
    """Write maps by name as float32: SHAPE in .shape.gii, else NONE, or TIME_SERIES for the several of a `series`.

    TIME_SERIES is what makes nibabel and FreeSurfer read several maps as the one array (V, K) that they are here.
    """
    if path.name.lower().endswith(".shape.gii"):
        intent = "NIFTI_INTENT_SHAPE"
    else:
        intent = "NIFTI_INTENT_TIME_SERIES" if series and len(maps) > 1 else "NIFTI_INTENT_NONE"
    arrays = [_array(values, intent, np.float32, {"Name": name}) for name, values in maps.items()]
    _save(path, arrays, structure)


def _load(path: Path) -> Any:
    from nibabel import gifti

    with checks.reading(path, "GIFTI"):
        return gifti.GiftiImage.from_filename(path, mmap=False)


def _frame(points: Any) -> tuple[str | None, np.ndarray | None]:
    """The frame of the vertices and the way from tkr to scanner RAS, each None where the file does not tell it."""
    space, geometry = points.coordsys, _volume_geometry(points.meta)
    if space is not None and space.dataspace != _UNKNOWN:
        return "scanner", None if geometry is None else geometry[0]
    if space is not None and space.xformspace in (_SCANNER, _ALIGNED):
        return "tkr", np.array(space.xform, float)
    if geometry is None:
        return None, None
    matrix, centre = geometry
    return ("tkr" if centre.any() else "scanner"), matrix


def _volume_geometry(meta: Mapping[str, str]) -> tuple[np.ndarray, np.ndarray] | None:
    """tkr to scanner RAS (4, 4) and the centre c_ras (3,) from FreeSurfer's metadata; None where it is incomplete."""
    try:
        shape = np.array([float(meta[f"VolGeom{name}"]) for name in ("Width", "Height", "Depth")])
        spacing = np.array([float(meta[f"VolGeom{axis}size"]) for axis in "XYZ"])
        columns = np.array([[float(meta[f"VolGeom{axis}_{ras}"]) for axis in "XYZC"] for ras in "RAS"])
        return tkr_to_scanner(shape, spacing, columns[:, :3], columns[:, 3]), columns[:, 3]
    except (KeyError, ValueError, np.linalg.LinAlgError):
        return None


def _spread(path: Path, values: np.ndarray, nodes: np.ndarray, vertices: int | None) -> np.ndarray:
    nodes = np.asarray(nodes).reshape(-1)
    vertices = int(nodes.max(initial=-1)) + 1 if vertices is None else vertices
    if len(nodes) != len(values) or not ((nodes >= 0) & (nodes < vertices)).all():
        raise RefusedError(
            f"{path}: {len(values)} values for a list of {len(nodes)} vertices, up to number {nodes.max(initial=0)}; "
            f"expected numbers below {vertices}, the vertices of the surface; give the data of this surface"
        )
    whole = np.full(vertices, np.nan, np.result_type(values.dtype, np.float32))
    whole[nodes] = values
    return whole


def _structure_meta(structure: str | None) -> dict[str, str]:
    return {} if structure is None else {_STRUCTURE: structure}


def _array(values: np.ndarray, intent: str, dtype: type[np.generic], meta: Mapping[str, str], **options: Any) -> Any:
    from nibabel import gifti

    kind = "NIFTI_TYPE_FLOAT32" if dtype is np.float32 else "NIFTI_TYPE_INT32"
    options["meta"] = gifti.GiftiMetaData(meta)
    return gifti.GiftiDataArray(values.astype(dtype), intent, datatype=kind, encoding=_ENCODING, **options)


def _save(path: Path, arrays: list[Any], structure: str | None) -> None:
    from nibabel import gifti

    with checks.writing(path):
        meta = gifti.GiftiMetaData(_structure_meta(structure))
        gifti.GiftiImage(meta=meta, darrays=arrays).to_filename(path)
