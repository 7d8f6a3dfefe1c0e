"""Looking at files: how two volumes differ; what a volume, a surface or vertex data holds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beltrami_cli import formats
from beltrami_cli.config import Settings
from beltrami_cli.errors import BeltramiError, RefusedError
from beltrami_cli.grid import Canonical, Grid, Volume, extent, require_same_grid
from beltrami_cli.inputs import Warnings, band_of, require_usable
from beltrami_cli.levelset import crossing_box, two_values
from beltrami_cli.metrics import Difference, difference
from beltrami_cli.sources import is_segmentation
from beltrami_cli.surface import Mesh, edge_counts

REMEDY = "bring them onto one grid first, for example with denoise --resample"

# Of an overlay with many maps, as of a time series, and of many labels only the first are listed.
MOST_MAPS = 12
MOST_LABELS = 12

# mm: no brain is as small, but one in metres is.
SMALLEST_SURFACE = 1.0


def compare_volumes(
    a: Path,
    b: Path,
    *,
    levelset: Path | None = None,
    within: float | None = None,
    period: float | None = None,
    data_range: float | None = None,
) -> Difference:
    """B minus the reference A on one grid, near the surface of `levelset` where it is given (within mm of it).

    Several channels or frames are compared value by value, complex numbers as their real and imaginary part.
    Raises RefusedError where the grids differ, DataError where nothing can be compared.
    """
    psi = None if levelset is None else formats.read_volume(levelset)
    flat = psi is not None and 1 in psi.grid.shape
    first, second = (formats.read_volume(path, dtype=np.float64, channels=True, plane=flat) for path in (a, b))
    require_same_grid(first.grid, f"A {a}", second.grid, f"B {b}", remedy=REMEDY)
    mask = None
    if psi is not None:
        require_same_grid(first.grid, f"A {a}", psi.grid, f"PSI {levelset}", remedy=REMEDY)
        mask = _near_surface(psi, f"PSI {levelset}", within)
    x, y = _parts(first), _parts(second)
    if mask is not None and x.ndim == 4:
        mask = np.broadcast_to(mask[..., None], x.shape)
    return difference(x, y, mask=mask, period=period, data_range=data_range)


def _parts(volume: Volume) -> np.ndarray:
    """The values, complex ones as two channels."""
    data = volume.data
    return np.stack([data.real, data.imag], -1) if np.iscomplexobj(data) else data


def _near_surface(psi: Volume, name: str, within: float | None) -> np.ndarray:
    """True where a voxel lies within so many mm of the zero level of psi; None for half a voxel."""
    if within is not None and not 0 < within < np.inf:
        raise RefusedError(f"within: found {within:g}; expected a distance above 0 mm")
    require_usable(psi.grid, name)
    axes = Canonical(psi.grid)
    widest = float(psi.grid.used_spacing.max())
    reach = 0.5 * widest if within is None else within
    # Wider than what is looked at: a band's own rim is where the nearest vertex, not the surface, is in reach.
    band = band_of(psi.data, Settings(band=reach + 1.5 * widest), axes, Warnings(None))
    distance = axes.back(band.scatter(np.abs(band.distance), np.inf))
    return np.asarray(distance <= reach)


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
