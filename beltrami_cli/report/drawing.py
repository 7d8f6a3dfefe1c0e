"""Pictures of a run for people: the surface, or the curve, before and after."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli.errors import RefusedError
from beltrami_cli.formats import checks
from beltrami_cli.surface import Mesh

DPI = 200  # a panel of 1,000 pixels across: every triangle of a usual cortex patch covers several
PANEL_INCHES = 5.5
PERCENTILES = (2.0, 98.0)  # a few outliers must not take the whole colour scale
MISSING = (0.62, 0.62, 0.62)  # grey: no colour of the map

# Where a surface shows no side of its own it is seen from the right, the front and above (RAS), as a solid on a table.
THREE_QUARTER = np.array([0.45, -0.6, 0.66])
# Share of the area by which one side must prevail to be the one that is looked at; a closed surface has 0.
ONE_SIDED = 0.1
AMBIENT = 0.5  # brightness, of 1, where the surface turns away from the headlight at the camera

# Red, green and blue as in the paper's figures, in shades that stay apart without full colour vision.
TRUTH, INPUT, DENOISED = "#d62718", "#7fc4a5", "#0b4fa8"


def draw_before_after(
    path: Path,
    mesh: Mesh,
    before: np.ndarray,
    after: np.ndarray,
    *,
    truth: np.ndarray | None = None,
    title_before: str = "input",
    title_after: str = "denoised",
    label: str = "value",
) -> None:
    """Write a PNG that shows values on the surface before and after, or along a curve, whatever the path's suffix.

    mesh: its `values` are not used. before, after, truth: (V,) values at its vertices, NaN where missing.
    A surface gets one panel each, lit from the camera, on one colour scale (2nd to 98th percentile of `after` where
    `before` is known), missing values grey; a curve gets one line each over the arc length.

    Raises RefusedError where matplotlib is missing, DataError where the file cannot be written.
    """
    panels = {title_before: before, title_after: after}
    if truth is not None:
        panels["truth"] = truth
    for title, values in panels.items():
        if np.shape(values) != (len(mesh.vertices_ras_mm),):
            raise ValueError(f"{title}: expected {len(mesh.vertices_ras_mm)} values, got shape {np.shape(values)}")
        panels[title] = np.where(np.isfinite(values), values, np.nan)
    figure = _new_figure()
    draw = _draw_curve if mesh.cells.shape[1] == 2 else _draw_surface
    draw(figure, mesh, panels, label)
    with checks.writing(path):
        figure.savefig(path, format="png", dpi=DPI)


def _new_figure() -> Any:
    """An empty figure that belongs to no window and no global state."""
    try:
        from matplotlib.figure import Figure
    except ImportError as error:
        raise RefusedError(
            "pictures need matplotlib, which is not installed; pip install 'beltrami_cli[report]'"
        ) from error
    return Figure(layout="constrained", facecolor="white")


# Surfaces


def _draw_surface(figure: Any, mesh: Mesh, panels: dict[str, np.ndarray], label: str) -> None:
    from matplotlib import colormaps
    from matplotlib.cm import ScalarMappable
    from matplotlib.colors import Normalize

    before, after, *_ = panels.values()
    scale = ScalarMappable(Normalize(*_colour_range(before, after)), colormaps["viridis"].with_extremes(bad=MISSING))
    points = mesh.vertices_ras_mm - mesh.vertices_ras_mm.mean(0)
    area = _area_vectors(points, mesh.cells)
    known = np.isfinite(before)[mesh.cells].all(1)
    camera = _camera(area[known] if known.any() else area)
    across, up, depth = camera @ points.T
    farthest_first = np.argsort(depth[mesh.cells].mean(1))
    light = AMBIENT + (1 - AMBIENT) * np.abs(_vertex_normals(area, mesh.cells, len(points)) @ camera[2])

    height = PANEL_INCHES * np.clip(np.ptp(up) / np.ptp(across), 0.4, 1.6)
    figure.set_size_inches(PANEL_INCHES * len(panels) + 1, height + 0.5)
    all_axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for axes, (title, values) in zip(all_axes, panels.items(), strict=True):
        colours = scale.to_rgba(np.ma.masked_invalid(values))
        colours[:, :3] *= light[:, None]
        _paint(axes, across, up, mesh.cells[farthest_first], colours)
        axes.set_title(title, fontsize=16)
    figure.colorbar(scale, ax=all_axes, label=label, shrink=0.8, aspect=30, extend="both")


def _colour_range(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Ends of the colour scale: set by the surface's known part after, else by all of it, else before, else (0, 1)."""
    for values in (after[np.isfinite(before)], after, before):
        finite = values[np.isfinite(values)]
        if finite.size:
            low, high = np.percentile(finite, PERCENTILES)
            if high > low:
                return float(low), float(high)
    return 0.0, 1.0


def _paint(axes: Any, across: np.ndarray, up: np.ndarray, triangles: np.ndarray, colours: np.ndarray) -> None:
    """Triangles over one another in the order given, colours (V, 4) blending from vertex to vertex."""
    from matplotlib.collections import TriMesh
    from matplotlib.tri import Triangulation

    painted = TriMesh(Triangulation(across, up, triangles))
    painted.set_facecolor(colours)
    axes.add_collection(painted)
    axes.autoscale_view()
    axes.set_aspect("equal")
    axes.set_axis_off()


def _camera(area: np.ndarray) -> np.ndarray:
    """(3, 3) rows: right, up and towards the viewer, unit vectors in RAS. area: (C, 3) area vectors of what counts.

    Looks at the side to which most of the area faces, with superior (or, from above and below, anterior) up.
    """
    net, total = area.sum(0), np.linalg.norm(area, axis=1).sum()
    towards = net if np.linalg.norm(net) > ONE_SIDED * total else THREE_QUARTER
    towards = towards / np.linalg.norm(towards)
    upright = np.array([0.0, 0.0, 1.0]) if abs(towards[2]) < 0.9 else np.array([0.0, 1.0, 0.0])
    right = np.cross(upright, towards)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(towards, right), towards])


def _area_vectors(points: np.ndarray, triangles: np.ndarray) -> np.ndarray:
    """(C, 3) normals of triangles, as long as the area in mm^2."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return np.cross(b - a, c - a) / 2


def _vertex_normals(area: np.ndarray, triangles: np.ndarray, count: int) -> np.ndarray:
    """(count, 3) unit normals, the mean of the triangles around each vertex by area; 0 at a vertex without any."""
    corners = triangles.reshape(-1)
    sums = [np.bincount(corners, np.repeat(area[:, axis], 3), count) for axis in range(3)]
    normals = np.stack(sums, 1)
    return normals / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)


# Curves


def _draw_curve(figure: Any, mesh: Mesh, panels: dict[str, np.ndarray], label: str) -> None:
    figure.set_size_inches(10, 4.5)
    axes = figure.subplots()
    vertices, arc = _along(mesh)
    before, after, *truth = panels.items()
    lines = [(before, INPUT, 1.0)] + [(true, TRUTH, 1.6) for true in truth] + [(after, DENOISED, 1.6)]
    for (title, values), colour, width in lines:
        axes.plot(arc, np.where(vertices < 0, np.nan, values[vertices]), color=colour, linewidth=width, label=title)
    axes.set_xlabel("arc length (mm)")
    axes.set_ylabel(label)
    axes.margins(x=0)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(lines), frameon=False)


def _along(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices in the order of the polyline, its parts one after another with -1 between, and their arc length in mm.

    A closed part ends with the vertex it began with.
    """
    following = dict(mesh.cells.tolist())
    heads = [v for v in following if v not in set(following.values())]
    order: list[int] = []
    while following:
        vertex = heads.pop(0) if heads else min(following)
        order.append(vertex)
        while vertex in following:
            vertex = following.pop(vertex)
            order.append(vertex)
        order.append(-1)
    vertices = np.array(order[:-1])
    length = np.linalg.norm(np.diff(mesh.vertices_ras_mm[vertices], axis=0), axis=1)
    length[(vertices[1:] < 0) | (vertices[:-1] < 0)] = 0
    return vertices, np.concatenate([[0.0], np.cumsum(length)])
