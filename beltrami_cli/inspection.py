"""Looking at files: what a volume, a surface or vertex data holds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beltrami_cli import formats
from beltrami_cli.errors import BeltramiError, RefusedError
from beltrami_cli.grid import Grid, extent
from beltrami_cli.levelset import crossing_box, two_values
from beltrami_cli.sources import is_segmentation
from beltrami_cli.surface import Mesh, edge_counts

# Of an overlay with many maps, as of a time series, and of many labels only the first are listed.
MOST_MAPS = 12
MOST_LABELS = 12

# mm: no brain is as small, but one in metres is.
SMALLEST_SURFACE = 1.0


def describe(path: Path) -> list[str]:
    """Lines on what a file holds: a surface, vertex data or a volume; raises as their readers."""
    if formats.is_surface(path):
        return describe_surface(path)
    if formats.is_overlay(path):
        return describe_overlay(path)
    return describe_volume(path)


def describe_surface(path: Path) -> list[str]:
    """Lines on format, size, place, border and structure of a surface; raises as `formats.read_surface`."""
    mesh = formats.read_surface(path)
    points, cells = mesh.vertices_ras_mm, mesh.cells
    edges, triangles = edge_counts(cells)
    length = np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)
    border, shared = int((triangles == 1).sum()), int((triangles > 2).sum())
    lines = [
        f"{formats.surface_format(path)} surface, {len(points)} vertices, {_count(len(cells), 'triangle')}, "
        f"edges of {np.median(length):.3g} mm (median)",
        f"within {extent(points)} (RAS); coordinates: {_frame(path, mesh)}",
        f"open: {_count(border, 'border edge')}" if border else "closed: no border edges",
        f"structure: {mesh.structure or 'not told'}",
    ]
    if np.ptp(points, axis=0).max() < SMALLEST_SURFACE:
        lines.append("in doubt: a surface of less than 1 mm; expected coordinates in mm: are they in metres?")
    if shared:
        lines.append(f"{_count(shared, 'edge')} shared by more than two triangles: expected a surface without branches")
    if lost := len(points) - len(np.unique(cells)):
        lines.append(f"{_count(lost, 'vertex', 'vertices')} of no triangle")
    return lines


def _count(number: int, one: str, several: str = "") -> str:
    return f"{number} {one if number == 1 else several or one + 's'}"


def _frame(path: Path, mesh: Mesh) -> str:
    """Of which space the vertices are as stored, in words."""
    if not np.array_equal(formats.read_surface(path, frame="scanner").vertices_ras_mm, mesh.vertices_ras_mm):
        return "FreeSurfer's surface RAS (tkr), carried to scanner RAS by the file's own volume geometry"
    try:
        formats.read_surface(path, like=Grid.from_spacing((2, 2, 2)))
    except RefusedError:
        return "as stored, of a space that the file does not tell: with a volume, --frame is to say which"
    return "scanner RAS"


def describe_overlay(path: Path) -> list[str]:
    """Lines on format, structure and the values of each map of vertex data; raises as `formats.read_maps`."""
    maps = formats.read_maps(path)
    vertices = len(next(iter(maps.values())))
    lines = [
        f"{formats.overlay_format(path)} vertex data, {vertices} vertices, {_count(len(maps), 'map')}",
        f"structure: {formats.overlay_structure(path) or 'not told'}",
    ]
    lines += [f"{name}: {_spread_of(values)}" for name, values in list(maps.items())[:MOST_MAPS]]
    if len(maps) > MOST_MAPS:
        lines.append(f"... and {len(maps) - MOST_MAPS} more")
    return lines


def _spread_of(values: np.ndarray) -> str:
    finite = values[np.isfinite(values)]
    missing = f"{np.isnan(values).sum()} NaN, {np.isinf(values).sum()} infinite"
    if not finite.size:
        return f"no finite value, {missing}"
    return f"range {finite.min():.6g} to {finite.max():.6g}, median {np.median(finite):.6g}, {missing}"


def describe_volume(path: Path) -> list[str]:
    """Lines on format, grid, orientation, values and surface of a volume; raises as `formats.read_volume`.

    Only a volume of one real value per voxel is looked at as a level set.
    """
    volume = formats.read_volume(path, channels=True)
    grid, values = volume.grid, volume.data
    finite = values[np.isfinite(values)]
    shape = " x ".join(map(str, grid.shape if volume.channels > 1 else volume.file_shape))
    lines = [
        f"{formats.volume_format(path)}, {shape} voxels of {' x '.join(f'{h:.4g}' for h in grid.spacing)} mm, "
        f"axes towards {_orientation(grid.affine)}{', sheared' if grid.is_sheared() else ''}",
        f"first voxel at RAS {', '.join(f'{x:.4g}' for x in grid.affine[:3, 3])} mm",
        f"values: {finite.size} finite, {int(np.isnan(values).sum())} NaN, {int(np.isinf(values).sum())} infinite",
    ]
    lines += [f"in doubt: {note.removeprefix(f'{path}: ')}" for note in volume.notes]
    if volume.channels > 1:
        lines.append(f"{volume.channels} channels or frames: for denoise --kind vector")
    if np.iscomplexobj(values):
        lines.append("complex numbers, real and imaginary part: for denoise --kind vector")
        finite = np.abs(finite)
    if finite.size:
        low, middle, high = finite.min(), np.median(finite), finite.max()
        what = "magnitude" if np.iscomplexobj(values) else "range"
        lines.append(f"{what}: {low:.6g} to {high:.6g}, median {middle:.6g}")
    if finite.size and volume.channels == 1 and not np.iscomplexobj(values):
        lines.append(f"as a level set: {_as_levelset(values, finite)}")
    return lines


def _as_levelset(values: np.ndarray, finite: np.ndarray) -> str:
    if mask := two_values(values):
        return f"a mask of {mask[0]:g} and {mask[1]:g}: a segmentation, whose surface is made smooth"
    if is_segmentation(finite):
        labels = np.unique(finite)
        some = ", ".join(f"{label:g}" for label in labels[:MOST_LABELS]) + (" ..." if len(labels) > MOST_LABELS else "")
        return f"{len(labels)} whole numbers ({some}): a segmentation, of which --labels or --between take some"
    try:
        box = crossing_box(values, (0, 0, 0))
    except BeltramiError:
        return "no zero level (expected values of both signs)"
    extent = " x ".join(f"{part.start}..{part.stop - 1}" for part in box)
    return f"zero level within voxels {extent}; {100 * np.mean(finite < 0):.1f} % of the values are negative (inside)"


def _orientation(affine: np.ndarray) -> str:
    from nibabel.orientations import aff2axcodes

    return "".join(str(code) for code in aff2axcodes(affine))
