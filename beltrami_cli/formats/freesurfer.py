"""FreeSurfer's own surface files, known by their first bytes: geometry (lh.white) and values (lh.thickness)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.formats import checks
from beltrami_cli.formats.frames import StoredSurface, tkr_to_scanner

TRIANGLES, QUADS, MORPH = b"\xff\xff\xfe", b"\xff\xff\xfd", b"\xff\xff\xff"

# Tags behind the triangles: whether the vertices are in scanner RAS, and the volume's geometry as lines of text.
_TAG_REAL_RAS, _TAG_GEOMETRY = 2, 20

# With these suffixes a name that begins with lh. or rh. is not one of FreeSurfer's own binary files.
_FOREIGN = re.compile(
    r"\.(annot|asc|csv|gii|glb|gz|hdr|html|img|json|label|mgh|mgz|mha|mhd|nii|npy|npz|obj|ply|png|srf|stl|toml|txt|vtk|w)$",
    re.IGNORECASE,
)


def magic(path: Path) -> bytes:
    """The first three bytes, none where the file cannot be read."""
    try:
        with Path(path).open("rb") as file:
            return file.read(3)
    except OSError:
        return b""


def is_name(path: Path) -> bool:
    """True for a name as FreeSurfer gives to files without a suffix: lh.NAME, rh.NAME, and NAME.curv."""
    name = Path(path).name.lower()
    return (name.startswith(("lh.", "rh.")) and not _FOREIGN.search(name)) or name.endswith(".curv")


def is_old_morph(path: Path) -> bool:
    """True for values of the format before 2002, known by its size alone: 3 + 3 bytes of counts, 2 for each vertex."""
    first = magic(path)
    return len(first) == 3 and Path(path).stat().st_size == 6 + 2 * int.from_bytes(first, "big") > 6


def read_surface(path: Path) -> StoredSurface:
    """Triangles, with the frame as the footer tells it; raises RefusedError for quadrangles, DataError as `checks`."""
    if magic(path) == QUADS:
        raise RefusedError(f"{path}: a surface of quadrangles; expected triangles; convert it: mris_convert IN OUT")
    with checks.reading(path, "a FreeSurfer surface"):
        content = path.read_bytes()
        stamp_end = content.index(b"\n", 3) + 1
        start = content.index(b"\n", stamp_end) + 1
        vertex_count, cell_count = map(int, np.frombuffer(content, ">i4", 2, start))
        vertices = np.frombuffer(content, ">f4", 3 * vertex_count, start + 8).reshape(-1, 3)
        start += 8 + vertices.nbytes
        cells = np.frombuffer(content, ">i4", 3 * cell_count, start).reshape(-1, 3)
        frame, matrix = _footer(content[start + cells.nbytes :])
    return StoredSurface(vertices.astype(float), cells.astype(np.int32), frame, unsaid=None, tkr_to_scanner=matrix)


def read_morph(path: Path) -> np.ndarray:
    """(V,) float32 values; raises RefusedError for the old format and for several values at a vertex."""
    if magic(path) != MORPH:
        raise RefusedError(
            f"{path}: values in FreeSurfer's format before 2002; expected the present one; convert them: mri_convert "
            "or mris_convert -c"
        )
    with checks.reading(path, "FreeSurfer values"):
        content = path.read_bytes()
        count, _, per_vertex = map(int, np.frombuffer(content, ">i4", 3, 3))
        if per_vertex != 1:
            raise RefusedError(f"{path}: expected one value per vertex; found {per_vertex}; save them as .mgz")
        if len(content) < 15 + 4 * count or count < 0:
            raise DataError(
                f"{path}: {count} values announced, {(len(content) - 15) // 4} found; expected a complete file of "
                "values: check that it was copied whole (a surface of quadrangles begins alike: mris_convert it)"
            )
        return np.frombuffer(content, ">f4", count, 15).astype(np.float32)


def write_morph(path: Path, values: np.ndarray) -> None:
    """Write (V,) values as float32; NaN stays NaN, for which FreeSurfer's own tools have no meaning."""
    from nibabel import freesurfer

    with checks.writing(path):
        freesurfer.write_morph_data(path, values.astype(np.float32))


def _footer(tail: bytes) -> tuple[str | None, np.ndarray | None]:
    """What the tags behind the triangles say: the frame, and the way from tkr to scanner RAS."""
    tags = [int(tag) for tag in np.frombuffer(tail[: len(tail) // 4 * 4][:12], ">i4")]
    real_ras, skipped = False, 4
    if len(tags) == 3 and tags[0] == _TAG_REAL_RAS:
        real_ras, tags, skipped = tags[1] == 1, tags[2:], 12
    matrix = _geometry(tail[skipped:]) if tags and tags[0] == _TAG_GEOMETRY else None
    if real_ras:
        return "scanner", matrix
    return (None, None) if matrix is None else ("tkr", matrix)


def _geometry(text: bytes) -> np.ndarray | None:
    """tkr to scanner RAS from lines as `volume = 256 256 256`; None where they are invalid or incomplete."""
    lines = text.split(b"\n", 8)[:8]
    fields = {key.strip().decode(): value for key, _, value in (line.partition(b"=") for line in lines)}
    if not fields.get("valid", b"").strip().startswith(b"1"):
        return None
    try:
        volume, size, x, y, z, centre = (
            np.array(fields[name].split(), float) for name in ("volume", "voxelsize", "xras", "yras", "zras", "cras")
        )
        return tkr_to_scanner(volume, size, np.stack([x, y, z], -1), centre)
    except (KeyError, ValueError, np.linalg.LinAlgError):
        return None
