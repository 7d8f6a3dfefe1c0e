"""Panels that show a surface from a side."""

from __future__ import annotations

from typing import Any

import numpy as np

from beltrami_cli.report import geometry
from beltrami_cli.report.colours import FILLED, INNER
from beltrami_cli.report.geometry import View
from beltrami_cli.report.style import DIRECTIONS, FAINT, cased
from beltrami_cli.surface import Mesh

AMBIENT = 0.72  # brightness, of 1, where the surface turns away from the headlight at the camera: colours stay readable


def draw(
    axes: Any,
    mesh: Mesh,
    colours: np.ndarray,
    view: View,
    filled: np.ndarray | None = None,
    box: np.ndarray | None = None,
    plain_inside: bool = False,
) -> None:
    """The surface from one side, lit from the camera, in parallel projection; the nearest triangles last.

    colours: (V, 4), blending from vertex to vertex. filled: (V,) bool, places to be outlined. box: (2, 2) from and to,
    right and up in mm: the part to be shown; by default all. plain_inside: where the surface is cut open, its inner
    side has no data's colours, which would seem to lie on what is before it.
    """
    from matplotlib.collections import TriMesh
    from matplotlib.tri import Triangulation

    points, cells, lit = mesh.vertices_ras_mm @ view.camera.T, mesh.cells, colours.copy()
    if plain_inside:
        # Triangles that turn away get vertices of their own.
        away = geometry.area_vectors(mesh) @ view.camera[2] < 0
        cells = np.where(away[:, None], cells + len(points), cells)
        points, lit = np.concatenate([points, points]), np.concatenate([lit, np.broadcast_to((*INNER, 1), lit.shape)])
    facing = np.abs(geometry.vertex_normals(mesh) @ view.camera[2])
    lit[:, :3] *= np.resize(AMBIENT + (1 - AMBIENT) * facing, (len(points), 1))
    box = whole(mesh, view) if box is None else box
    corners = points[cells, :2]
    cells = cells[((corners.max(1) >= box[0]) & (corners.min(1) <= box[1])).all(1)]
    farthest_first = np.argsort(points[cells, 2].mean(1))
    painted = TriMesh(Triangulation(points[:, 0], points[:, 1], cells[farthest_first]))
    painted.set_facecolor(lit)
    # Its limits are known; matplotlib would look for them triangle by triangle, which takes longer than to paint.
    axes.add_collection(painted, autolim=False)
    if filled is not None and filled.any():
        _outline_filled(axes, mesh, filled, view)
    axes.set(xlim=box[:, 0], ylim=box[:, 1], aspect="equal")
    axes.set_axis_off()


def whole(mesh: Mesh, view: View) -> np.ndarray:
    """(2, 2) from and to, right and up in mm: the box around a surface seen from a side."""
    flat = mesh.vertices_ras_mm @ view.camera[:2].T
    low, high = flat.min(0), flat.max(0)
    return np.stack([low, high]) + np.outer((-0.01, 0.01), high - low)


def _outline_filled(axes: Any, mesh: Mesh, filled: np.ndarray, view: View) -> None:
    """The border of filled places where it faces the viewer."""
    segments, cells = geometry.filled_border_and_cells(mesh, filled)
    facing = geometry.area_vectors(mesh)[cells] @ view.camera[2] > 0
    cased(axes, segments[facing] @ view.camera[:2].T, colour=FILLED)


def directions(axes: Any, view: View) -> None:
    """Letters L, R, P, A, I, S at the sides of a view that look most nearly there."""
    places = {(0, 0): (-0.02, 0.5, "right"), (0, 1): (1.02, 0.5, "left")}
    places |= {(1, 0): (0.5, -0.02, "center"), (1, 1): (0.5, 1.02, "center")}
    for (row, end), (x, y, align) in places.items():
        axis = int(np.argmax(np.abs(view.camera[row])))
        positive = (view.camera[row, axis] > 0) == bool(end)
        axes.text(
            x,
            y,
            DIRECTIONS[axis][int(positive)],
            transform=axes.transAxes,
            ha=align,
            va=("top", "bottom")[end] if row else "center",
            color=FAINT,
            fontsize="small",
        )
