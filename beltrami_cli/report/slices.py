"""Panels that show slices through the volumes, with the outline of the surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from beltrami_cli.grid import Grid
from beltrami_cli.report import geometry
from beltrami_cli.report.colours import Scale, difference_scale, scale_of
from beltrami_cli.report.key import bar
from beltrami_cli.report.style import DIRECTIONS, FAINT, cased, grid_of_axes, points, unit
from beltrami_cli.report.subject import Map, Subject
from beltrami_cli.surface import Mesh

LETTERS = 0.35  # inches of a slice along an axis below which the ends of that axis are not named
NARROW = 0.3  # of the widest column, the narrowest
RIM = 0.1  # share of the slices at either end of a volume that say little: left out where any other cuts the data
AROUND = 4  # slices beyond a surface without a volume: room for the width of its outline
STRAIGHT = 0.999  # cosine above which an axis counts as one of the world's
SLICES = ("sagittal", "coronal", "axial")


@dataclass(frozen=True, eq=False)
class Cuts:
    """Where a subject is cut. index: of the slice for each axis. box: (2, 3) first and last voxel that are shown.

    rows_down: the first axis of a slice runs down and the second to the right, as in pictures, not right and up.
    """

    grid: Grid
    index: dict[int, int]
    box: np.ndarray
    rows_down: bool = False

    def across_and_up(self, axis: int) -> tuple[int, int]:
        """The grid's axes that a slice shows from left to right, and from bottom to top or, of a picture, down."""
        first, second = (k for k in range(3) if k != axis)
        return (second, first) if self.rows_down else (first, second)

    def size(self, axis: int) -> tuple[float, float]:
        """Width and height in mm of what is shown of a slice."""
        size = (self.box[1] - self.box[0] + 1) * self.grid.spacing
        across, up = self.across_and_up(axis)
        return float(size[across]), float(size[up])

    def title(self, axis: int) -> str:
        """Which slice it is, and where in mm; of an axis that lies obliquely, about where."""
        at = self.grid.to_world(np.where(np.arange(3) == axis, self.index[axis], self.box.mean(0))[None])[0, axis]
        along = self.grid.affine[:3, axis] / self.grid.spacing[axis]
        return f"{SLICES[axis]}, {'xyz'[axis]} {'=' if abs(along[axis]) > STRAIGHT else '≈'} {at:.0f} mm"

    def widths(self) -> list[float]:
        """Of the columns, in mm: a narrow slice still has its title above it."""
        across = [self.size(axis)[0] for axis in self.index]
        return [max(width, NARROW * max(across)) for width in across]

    @property
    def is_plane(self) -> bool:
        return len(self.index) == 1


def draw(figure: Any, subject: Subject, scale: Scale | None = None) -> None:
    """Three orthogonal slices with the surface's outline: a row per map, and one of their difference with its bar.

    Where most of the surface's data are, in mm, with the letters of RAS. A plane: one column per map. Without volumes
    the outline has the colours. subject: of one channel.
    """
    scale = scale or scale_of(subject)
    cuts = cuts_of(subject)
    maps: list[tuple[str, Map, Map | None, Scale]] = [(shown.title, shown, None, scale) for shown in subject.maps]
    if subject.compares:
        maps.append((subject.difference, subject.maps[0], subject.maps[-1], difference_scale(subject)))
    sizes = [cuts.size(axis) for axis in cuts.index]
    rows, columns = (1, len(maps)) if cuts.is_plane else (len(maps), len(sizes))
    widths = cuts.widths() * (columns if cuts.is_plane else 1)
    all_axes = grid_of_axes(
        figure, rows, columns, left=0.5, right=0.9, bottom=0.2, top=0.5, gap=(0.35, 0.2), widths=widths
    )
    places = [(one, cut) for one in maps for cut in cuts.index.items()]
    for (one, (axis, index)), axes in zip(places, all_axes.flat, strict=True):
        _slice(axes, subject, cuts, axis, index, *one[1:])
    size = points()
    pad = 8 + size  # room for the letter
    for (title, *_), axes in zip(maps, all_axes[0] if cuts.is_plane else all_axes[:, 0], strict=True):
        if cuts.is_plane:
            axes.set_title(title, pad=pad, fontsize=size)
        else:
            axes.annotate(
                title, (0, 0.5), (-16, 0), "axes fraction", "offset points", rotation=90, va="center", ha="right"
            )
    if not cuts.is_plane:
        for axis, axes in zip(cuts.index, all_axes[0], strict=True):
            axes.set_title(cuts.title(axis), pad=pad, fontsize=size)
    if subject.has_anatomy:
        for axes, (axis, _) in zip(all_axes[0], [cut for _, cut in places], strict=False):
            _letters(axes, cuts, axis)
    if subject.compares:
        last, inch = all_axes[-1, -1].get_position(original=True), figure.dpi / figure.bbox.width
        place = (last.x1 + 0.28 * inch, last.y0 + 0.1 * last.height, 0.12 * inch, 0.8 * last.height)
        bar(figure.add_axes(place), maps[-1][3], unit(subject.period))


def height(subject: Subject, width: float) -> float:
    """How many inches high `draw` is to be for its width in inches."""
    cuts, maps = cuts_of(subject), len(subject.maps) + subject.compares
    sizes = [cuts.size(axis) for axis in cuts.index]
    columns, rows = (maps, 1) if cuts.is_plane else (len(sizes), maps)
    across = sum(cuts.widths()) * (maps if cuts.is_plane else 1)
    scaled = (width - 1.4 - 0.35 * (columns - 1)) / across
    return 0.7 + rows * min(scaled * max(h for _, h in sizes), 3.0) + 0.2 * (rows - 1)


def cuts_of(subject: Subject) -> Cuts:
    """Where `draw` cuts: of a plane, its missing axis only; else three slices of what the last map knows."""
    grid = subject.grid or _grid_around(subject.mesh)
    box = np.array([[0, 0, 0], grid.shape]) - [[0], [1]]
    volume = subject.maps[-1].volume
    shape = np.array(grid.shape)
    if (shape == 1).any():
        return Cuts(grid, {int(np.argmin(shape)): 0}, box, subject.rows_down)
    if volume is not None:
        known = np.isfinite(volume)
        if known.any():
            along = [np.flatnonzero(known.any(tuple(k for k in range(3) if k != axis))) for axis in range(3)]
            box = np.array([[places[0] for places in along], [places[-1] for places in along]])
    if subject.mesh is not None:
        at = grid.to_index(subject.mesh.vertices_ras_mm[np.unique(subject.mesh.cells)])
        box[0] = np.maximum(box[0], np.floor(at.min(0)) - 4)
        box[1] = np.maximum(np.minimum(box[1], np.ceil(at.max(0)) + 4), box[0])
    return Cuts(grid, _where_to_cut(subject, grid), box)


def _slice(
    axes: Any,
    subject: Subject,
    cuts: Cuts,
    axis: int,
    index: int,
    shown: Map,
    less: Map | None,
    scale: Scale,
) -> None:
    """One slice of a map, or of the difference to another."""
    from matplotlib.collections import LineCollection

    mesh, volume, values = subject.mesh, shown.volume, shown.values
    both = np.array(cuts.across_and_up(axis))
    spacing, (low, high) = cuts.grid.spacing[both], cuts.box[:, both]
    (left, bottom), (right, top) = (low - 0.5) * spacing, (high + 0.5) * spacing
    if volume is not None:
        cut = volume.take(index, axis)
        if less is not None and less.volume is not None:
            cut = subject.between(cut, less.volume.take(index, axis))
        cut = (cut.T if cuts.rows_down else cut)[low[0] : high[0] + 1, low[1] : high[1] + 1].T
        colours = scale.rgba(cut.reshape(-1)).reshape(*cut.shape, 4)
        axes.imshow(colours, origin="lower", extent=(left, right, bottom, top), interpolation="nearest")
    if mesh is not None:
        segments, cells = geometry.outline(mesh, cuts.grid, axis, index)
        segments = segments[..., ::-1] if cuts.rows_down else segments
        if volume is None and values is not None:
            at = mesh.cells[cells, 0]
            between = (
                values[at] if less is None or less.values is None else subject.between(values[at], less.values[at])
            )
            axes.add_collection(
                LineCollection(list(segments), colors="black", linewidths=3.2, capstyle="round"), autolim=False
            )
            axes.add_collection(
                LineCollection(list(segments), colors=scale.rgba(between), linewidths=2.4, capstyle="round"),
                autolim=False,
            )
        else:
            cased(axes, segments, 0.5)
    upwards = (top, bottom) if cuts.rows_down else (bottom, top)
    axes.set(xlim=(left, right), ylim=upwards, aspect="equal", xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def _letters(axes: Any, cuts: Cuts, axis: int) -> None:
    """Where L, R, P, A, I, S are beside a slice."""
    first, second = (_ends(cuts.grid, shown) for shown in cuts.across_and_up(axis))
    size = np.ptp([axes.get_xlim(), axes.get_ylim()], axis=1)  # mm
    cell, figure = axes.get_position(original=True), axes.figure
    inches = np.array([cell.width * figure.bbox.width, cell.height * figure.bbox.height]) / figure.dpi
    is_short = size * (inches / size).min() < LETTERS
    for (x, y), letter in zip(((-0.03, 0.5), (1.03, 0.5), (0.5, -0.03), (0.5, 1.03)), first + second, strict=True):
        if is_short[int(x == 0.5)]:
            continue
        align = {"ha": "right" if x < 0 else "left" if x > 1 else "center"}
        align["va"] = "top" if y < 0 else "bottom" if y > 1 else "center"
        axes.text(x, y, letter, transform=axes.transAxes, color=FAINT, fontsize="small", **align)


def _ends(grid: Grid, axis: int) -> tuple[str, str]:
    """The letters at the two ends of a grid's axis: those of the axis of RAS that it is nearest to."""
    along = grid.affine[:3, axis]
    nearest = int(np.argmax(np.abs(along)))
    low, high = DIRECTIONS[nearest]
    return (low, high) if along[nearest] > 0 else (high, low)


def _where_to_cut(subject: Subject, grid: Grid) -> dict[int, int]:
    """The index of the slice for each axis: the nearest to the middle of the data on the surface that cuts much."""
    shape = grid.shape
    middle = {axis: shape[axis] // 2 for axis in range(3)}
    if subject.mesh is None:
        return middle
    values = subject.maps[0].values
    known = np.isfinite(values) if values is not None else np.ones(len(subject.mesh.vertices_ras_mm), bool)
    used = np.zeros(len(known), bool)
    used[subject.mesh.cells] = True
    at = np.rint(grid.to_index(subject.mesh.vertices_ras_mm[known & used if (known & used).any() else used]))
    for axis in range(3):
        inside = np.clip(at[:, axis], 0, shape[axis] - 1).astype(int)
        counts = np.bincount(inside, minlength=shape[axis])
        rim = max(1, round(shape[axis] * RIM))
        if counts[rim:-rim].any():
            counts[:rim] = counts[-rim:] = 0
        many = np.flatnonzero(counts >= counts.max() / 2)
        middle[axis] = int(many[np.argmin(np.abs(many - np.median(inside)))])
    return middle


def _grid_around(mesh: Mesh | None) -> Grid:
    """A grid to cut a surface by that has no volume: 200 slices across it."""
    assert mesh is not None
    used = mesh.vertices_ras_mm[np.unique(mesh.cells)]
    low, size = used.min(0), np.ptp(used, axis=0)
    spacing = max(float(size.max()) / 200, 1e-9)
    affine = np.diag([spacing] * 3 + [1.0])
    affine[:3, 3] = low - AROUND * spacing
    a, b, c = (int(n) for n in np.ceil(size / spacing) + 1 + 2 * AROUND)
    return Grid((a, b, c), affine)
