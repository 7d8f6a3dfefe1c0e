"""Surfaces read from files, known by suffix or content, with their vertices carried to scanner RAS mm."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.formats import checks, freesurfer, gifti, plain_mesh
from beltrami_cli.formats.frames import StoredSurface, in_scanner_ras, require_frame
from beltrami_cli.formats.structures import structure_of_name
from beltrami_cli.grid import Grid
from beltrami_cli.surface import Mesh

_SUFFIXES = {".gii": "GIFTI", ".ply": "PLY", ".obj": "OBJ", ".stl": "STL", ".vtk": "VTK"}


def is_surface(path: Path) -> bool:
    """True for a file to be read by `read_surface`: by suffix, .gii and FreeSurfer's by content; reads a few bytes."""
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix == ".gii":
        return path.name.lower().endswith(".surf.gii") or gifti.holds_surface(path)
    return suffix in _SUFFIXES or freesurfer.magic(path) in (freesurfer.TRIANGLES, freesurfer.QUADS)


def surface_format(path: Path) -> str:
    """GIFTI, PLY, OBJ, STL or VTK, by suffix, or FreeSurfer, by content.

    Raises RefusedError for another file and for one that is not there.
    """
    path = Path(path)
    checks.require_file(path)
    kind = _SUFFIXES.get(path.suffix.lower())
    if kind is not None:
        return kind
    match freesurfer.magic(path):
        case freesurfer.TRIANGLES | freesurfer.QUADS:
            return "FreeSurfer"
        case freesurfer.MORPH:
            found = "FreeSurfer values, as of thickness or curvature; give them as data, with lh.white or alike"
        case _ if path.suffix.lower() in (".asc", ".srf"):
            found = "an ASCII surface; convert it: mris_convert IN OUT.surf.gii"
        case _:
            found = "none of these; check the path"
    raise RefusedError(
        f"{path}: expected a surface ({' '.join(_SUFFIXES)}, or FreeSurfer's lh.white and alike); found {found}"
    )


def read_surface(
    path: Path, *, frame: str | None = None, like: Grid | None = None, frame_where_unsaid: bool = False
) -> Mesh:
    """Read a surface as a mesh in scanner RAS mm, its vertices in the order of the file.

    frame: `scanner`, the vertices are taken as stored; `tkr`, they are in FreeSurfer's surface RAS, of the volume that
        the file describes, else of `like`; None, what the file says:
        FreeSurfer's footer: tkr by its volume geometry where that is valid, scanner where it is marked as such;
            one that says neither is taken as stored without `like`, and refused with it.
        GIFTI: the coordinate system and volume geometry, see `gifti.read_surface`.
        PLY, OBJ, STL, VTK, which say nothing: scanner.
    frame_where_unsaid: what the file says goes before `frame`: for one option that is for several files.
    like: grid of the volume that the surface is used with. As the measure of tkr it has to be the volume that the
        surface was made from (orig.mgz, voxels in that order), not one turned to other axes.

    `Mesh.structure` is what the file says, else what its name says (lh., hemi-L, .L.).

    Raises RefusedError where the file is no surface, its frame is needed and unknown, or `tkr` is asked for against
    what the file says (scanner RAS or a template's space, and no volume geometry); DataError where it cannot be read,
    has no triangles, coordinates that are not finite, or triangles of vertices that are not there.
    """
    path = Path(path)
    require_frame(frame)
    kind = surface_format(path)
    match kind:
        case "GIFTI":
            stored = gifti.read_surface(path)
        case "FreeSurfer":
            stored = freesurfer.read_surface(path)
        case _:
            stored = plain_mesh.read_surface(path, kind)
    _require_sound(path, stored)
    if frame_where_unsaid:
        frame = stored.frame or frame
    mesh = in_scanner_ras(path, stored, frame, like)
    return mesh if mesh.structure is not None else replace(mesh, structure=structure_of_name(path))


def _require_sound(path: Path, stored: StoredSurface) -> None:
    vertices, cells = stored.vertices, stored.cells
    if not len(cells):
        raise DataError(f"{path}: {len(vertices)} vertices and no triangles; expected a surface of triangles")
    lost = int(np.count_nonzero(((cells < 0) | (cells >= len(vertices))).any(axis=1)))
    if lost:
        raise DataError(
            f"{path}: {lost} of {len(cells)} triangles name vertices that are not there (0 to {len(vertices) - 1} are)"
            "; expected a complete surface: export it again"
        )
    broken = int(np.count_nonzero(~np.isfinite(vertices).all(axis=1)))
    if broken:
        raise DataError(
            f"{path}: {broken} of {len(vertices)} vertices have coordinates that are not finite; expected mm; export "
            "the surface again"
        )
