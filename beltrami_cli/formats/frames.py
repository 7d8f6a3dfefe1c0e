"""FreeSurfer's surface RAS ("tkr") against scanner RAS: which of the two a file's vertices are in, and the way over.

FreeSurfer keeps a surface in a frame of the volume that it was made from: the centre of that volume is the origin, and
its columns, rows and slices run to -x, -z and +y whatever their true directions are (Torig). With the volume's own
vox2ras (Norig), a point is at Norig inv(Torig) x in scanner RAS: for upright axes a shift by c_ras, else more than that
(https://surfer.nmr.mgh.harvard.edu/fswiki/CoordinateSystems).
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.grid import Grid
from beltrami_cli.surface import Mesh

# Columns: where FreeSurfer's surface RAS sends the directions of columns, rows and slices.
_TKR_AXES = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


@dataclass(frozen=True, eq=False)
class StoredSurface:
    """A surface as its file has it.

    vertices: (V, 3) float64 mm in the frame of the file. cells: (C, 3) int32.
    frame: what the file says of that frame, "scanner" or "tkr"; None where it says nothing.
    unsaid: what it is then taken for; None where it could as well be the other, once a volume is involved.
    tkr_to_scanner: (4, 4), from the volume geometry in the file; None where it has none.
    structure: as `Mesh.structure`.
    """

    vertices: np.ndarray
    cells: np.ndarray
    frame: str | None = None
    unsaid: str | None = "scanner"
    tkr_to_scanner: np.ndarray | None = None
    structure: str | None = None


def require_frame(frame: str | None) -> None:
    """Raise RefusedError unless `frame` is scanner, tkr or None."""
    if frame not in (None, "scanner", "tkr"):
        raise RefusedError(f"frame {frame}: expected scanner (RAS of the scanner) or tkr (FreeSurfer's surface RAS)")


def in_scanner_ras(path: Path, stored: StoredSurface, frame: str | None, like: Grid | None) -> Mesh:
    """The mesh in scanner RAS mm; arguments and errors as `surfaces.read_surface`."""
    matrix = _matrix(path, stored, frame, like)
    vertices, cells = stored.vertices, stored.cells
    if matrix is not None:
        vertices = vertices @ matrix[:3, :3].T + matrix[:3, 3]
        if np.linalg.det(matrix[:3, :3]) < 0:
            # A mirror image (the frame of a right-handed volume): the outside would be the clockwise side.
            cells = np.ascontiguousarray(cells[:, ::-1])
    return Mesh(vertices, cells, structure=stored.structure, placed=bool(frame or stored.frame or stored.unsaid))


def tkr_to_scanner(shape: np.ndarray, spacing: np.ndarray, directions: np.ndarray, centre: np.ndarray) -> np.ndarray:
    """(4, 4) from a surface file's volume geometry.

    shape, spacing: (3,) voxels and mm. directions: (3, 3), a column for each axis, in RAS. centre: (3,) c_ras, mm.
    """
    norig = np.eye(4)
    norig[:3, :3] = directions * spacing
    norig[:3, 3] = centre - norig[:3, :3] @ (shape / 2)
    return norig @ np.linalg.inv(_torig(shape, spacing))


def _torig(shape: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """(4, 4) from voxel indices to surface RAS."""
    torig = np.eye(4)
    torig[:3, :3] = _TKR_AXES * spacing
    torig[:3, 3] = -torig[:3, :3] @ (shape / 2)
    return torig


def _matrix(path: Path, stored: StoredSurface, frame: str | None, like: Grid | None) -> np.ndarray | None:
    """From the file's frame to the scanner's, None where they are one."""
    if frame == "tkr" and stored.frame == "scanner" and stored.tkr_to_scanner is None:
        raise RefusedError(
            f"{path}: says that its vertices are in scanner RAS or in a template's space; found --frame tkr; drop it"
        )
    frame = frame or stored.frame or stored.unsaid
    if frame == "tkr":
        if stored.tkr_to_scanner is not None:
            return _usable(path, stored.tkr_to_scanner)
        if like is None:
            raise RefusedError(
                f"{path}: --frame tkr needs the volume that the surface was made from, which the file does not "
                "describe; give that volume too, or drop --frame: without a volume the vertices stay where they are"
            )
        return like.affine @ np.linalg.inv(_torig(np.array(like.shape), like.spacing))
    if frame is None and like is not None:
        raise RefusedError(
            f"{path}: does not say where its vertices are in the volume (no valid volume info); give --frame tkr where "
            "they are in FreeSurfer's surface RAS of this volume, --frame scanner where they are in its world"
        )
    return None


def _usable(path: Path, matrix: np.ndarray) -> np.ndarray:
    if not np.isfinite(matrix).all() or abs(np.linalg.det(matrix[:3, :3])) < 1e-6:
        rows = "; ".join(" ".join(f"{v:.4g}" for v in row) for row in matrix[:3])
        raise DataError(f"{path}: its volume geometry places the vertices nowhere: [{rows}]; give --frame scanner")
    return matrix
