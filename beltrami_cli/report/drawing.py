"""Panels of pictures on matplotlib figures: surfaces, curves, slices, histograms, courses over time, the key."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from beltrami_cli.grid import Grid
from beltrami_cli.report import geometry
from beltrami_cli.report.colours import MISSING, Scale, removed_scale, scale_of, values_of
from beltrami_cli.report.geometry import View
from beltrami_cli.report.subject import Subject
from beltrami_cli.surface import Mesh

# Red, green and blue as in the paper's figures, in shades that stay apart without full colour vision; then others.
TRUTH, INPUT, DENOISED = "#d62718", "#7fc4a5", "#0b4fa8"
LINES = (TRUTH, INPUT, DENOISED, "#e69f00", "#000000", "#cc79a7")
INK, FAINT, WARNING = "#222222", "#5f5f5f", "#a13d00"

# For matplotlib.rc_context. Lengths in points; of the sheet's 150 dots per inch, 8 points are 17 pixels.
STYLE = {
    "font.size": 8,
    "axes.titlesize": 8,
    "axes.labelsize": 8,
    "xtick.labelsize": 7,
    "ytick.labelsize": 7,
    "legend.fontsize": 7,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.linewidth": 0.6,
    "axes.edgecolor": FAINT,
    "xtick.color": FAINT,
    "ytick.color": FAINT,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.titlecolor": INK,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "svg.fonttype": "none",
}

AMBIENT = 0.72  # brightness, of 1, where the surface turns away from the headlight at the camera: colours stay readable
BINS = 90
DIRECTIONS = (("L", "R"), ("P", "A"), ("I", "S"))  # the ends of the axes of RAS
QUADRANTS = ((1, 1, "upper\nright"), (-1, 1, "upper\nleft"), (-1, -1, "lower\nleft"), (1, -1, "lower\nright"))
SLICES = ("sagittal", "coronal", "axial")


# Surfaces and lines on them


def surface(
    axes: Any,
    mesh: Mesh,
    colours: np.ndarray,
    view: View,
    filled: np.ndarray | None = None,
    box: np.ndarray | None = None,
) -> None:
    """The surface from one side, lit from the camera, in parallel projection; the nearest triangles last.

    colours: (V, 4), blending from vertex to vertex. filled: (V,) bool, places to be outlined. box: (2, 2) from and to,
    right and up in mm: the part to be shown; by default all.
    """
    from matplotlib.collections import TriMesh
    from matplotlib.tri import Triangulation

    across, up, depth = view.camera @ mesh.vertices_ras_mm.T
    facing = np.abs(geometry.vertex_normals(mesh) @ view.camera[2])
    lit = colours.copy()
    lit[:, :3] *= (AMBIENT + (1 - AMBIENT) * facing)[:, None]
    box = whole(mesh, view) if box is None else box
    corners = np.stack([across, up], -1)[mesh.cells]
    cells = mesh.cells[((corners.max(1) >= box[0]) & (corners.min(1) <= box[1])).all(1)]
    farthest_first = np.argsort(depth[cells].mean(1))
    painted = TriMesh(Triangulation(across, up, cells[farthest_first]))
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
    _cased(axes, segments[facing] @ view.camera[:2].T)


def _cased(axes: Any, segments: np.ndarray, width: float = 0.7) -> None:
    """Black lines in a white casing, to be seen on any colour."""
    from matplotlib.collections import LineCollection

    for colour, points in (("white", width + 0.9), ("black", width)):
        axes.add_collection(
            LineCollection(list(segments), colors=colour, linewidths=points, capstyle="round"), autolim=False
        )


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


# Curves


def curve(figure: Any, subject: Subject, label: str = "value") -> None:
    """Of a curve: one line for each map over the arc length, the roughest behind."""
    assert subject.mesh is not None
    (axes,) = grid_of_axes(figure, 1, 1, top=0.35)[0]
    vertices, arc = along(subject.mesh)
    colours = (INPUT, DENOISED) if subject.is_run else LINES
    lines = []
    for k, shown in enumerate(subject.maps):
        assert shown.values is not None
        values = np.where((vertices < 0) | ~np.isfinite(shown.values[vertices]), np.nan, shown.values[vertices])
        steps = np.abs(np.diff(values))
        if subject.period is not None:
            values[1:][steps > subject.period / 2] = np.nan
        lines.append((float(np.nansum(steps**2)), values, colours[k % len(colours)], shown.title))
    order = np.argsort([-rough for rough, *_ in lines])
    for place, k in enumerate(order):
        _, values, colour, title = lines[k]
        axes.plot(arc, values, color=colour, linewidth=1.1 if place == 0 else 1.6, label=title, zorder=2 + place)
    axes.set_xlabel("arc length (mm)")
    axes.set_ylabel(label)
    axes.margins(x=0)
    axes.grid(alpha=0.25)
    handles = {handle.get_label(): handle for handle in axes.get_lines()}
    axes.legend(
        handles=[handles[title] for *_, title in lines],
        loc="lower right",
        bbox_to_anchor=(1.0, 1.0),
        ncols=len(lines),
        frameon=False,
        fontsize="medium",
    )


def along(mesh: Mesh) -> tuple[np.ndarray, np.ndarray]:
    """Vertices in the order of the polyline, its parts one after another with -1 between, and their arc length in mm.

    A closed part ends with the vertex it began with.
    """
    following = dict(mesh.cells.tolist())
    ends = set(following.values())
    heads = [v for v in following if v not in ends]
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


# Slices


@dataclass(frozen=True, eq=False)
class Cuts:
    """Where a subject is cut. index: of the slice for each axis. box: (2, 3) first and last voxel that are shown."""

    grid: Grid
    index: dict[int, int]
    box: np.ndarray

    def size(self, axis: int) -> tuple[float, float]:
        """Width and height in mm of what is shown of a slice."""
        size = (self.box[1] - self.box[0] + 1) * self.grid.spacing
        first, second = np.delete(size, axis)
        return float(first), float(second)

    @property
    def is_plane(self) -> bool:
        return len(self.index) == 1


def slices(figure: Any, subject: Subject, scale: Scale | None = None) -> None:
    """Three orthogonal slices with the surface's outline: a row per map, and one of what a run removed with its bar.

    Where most of the surface's data are, in mm, with the letters of RAS. A plane: one column per map. Without volumes
    the outline has the colours. subject: of one channel.
    """
    scale = scale or scale_of(subject)
    cuts = cuts_of(subject)
    maps = [(shown.title, shown.volume, shown.values, scale) for shown in subject.maps]
    if subject.is_run:
        maps.append(("removed", *_removed(subject), removed_scale(subject)))
    sizes = [cuts.size(axis) for axis in cuts.index]
    rows, columns = (1, len(maps)) if cuts.is_plane else (len(maps), len(sizes))
    widths = [width for width, _ in sizes] * (columns if cuts.is_plane else 1)
    all_axes = grid_of_axes(
        figure, rows, columns, left=0.5, right=0.9, bottom=0.2, top=0.45, gap=(0.35, 0.2), widths=widths
    )
    places = [(one, cut) for one in maps for cut in cuts.index.items()]
    for (one, (axis, index)), axes in zip(places, all_axes.flat, strict=True):
        _slice(axes, subject.mesh, cuts, axis, index, *one[1:])
    for (title, *_), axes in zip(maps, all_axes[0] if cuts.is_plane else all_axes[:, 0], strict=True):
        if cuts.is_plane:
            axes.set_title(title, pad=14)
        else:
            axes.annotate(
                title, (0, 0.5), (-16, 0), "axes fraction", "offset points", rotation=90, va="center", ha="right"
            )
    if not cuts.is_plane:
        for (axis, index), axes in zip(cuts.index.items(), all_axes[0], strict=True):
            at = cuts.grid.to_world(np.where(np.arange(3) == axis, index, cuts.box.mean(0))[None])[0, axis]
            axes.set_title(f"{SLICES[axis]}, {'xyz'[axis]} = {at:.0f} mm", pad=14)
    for axes, (axis, _) in zip(all_axes[0], [cut for _, cut in places], strict=False):
        _letters(axes, axis)
    if subject.is_run:
        _bar(all_axes[-1, -1].inset_axes((1.12, 0.1, 0.06, 0.8)), maps[-1][3], unit(subject.period))


def slices_height(subject: Subject, width: float) -> float:
    """How many inches high `slices` is to be for its width in inches."""
    cuts, maps = cuts_of(subject), len(subject.maps) + subject.is_run
    sizes = [cuts.size(axis) for axis in cuts.index]
    columns, rows = (maps, 1) if cuts.is_plane else (len(sizes), maps)
    across = sum(w for w, _ in sizes) * (maps if cuts.is_plane else 1)
    scaled = (width - 1.4 - 0.35 * (columns - 1)) / across
    return 0.65 + rows * min(scaled * max(h for _, h in sizes), 3.0) + 0.2 * (rows - 1)


def cuts_of(subject: Subject) -> Cuts:
    """Where `slices` cuts: of a plane, its missing axis only; else three slices of what the last map knows."""
    grid = subject.grid or _grid_around(subject.mesh)
    box = np.array([[0, 0, 0], grid.shape]) - [[0], [1]]
    volume = subject.maps[-1].volume
    shape = np.array(grid.shape)
    if (shape == 1).any():
        return Cuts(grid, {int(np.argmin(shape)): 0}, box)
    if volume is not None:
        known = np.argwhere(np.isfinite(volume))
        if len(known):
            box = np.stack([known.min(0), known.max(0)])
    if subject.mesh is not None:
        at = grid.to_index(subject.mesh.vertices_ras_mm[np.unique(subject.mesh.cells)])
        box[0] = np.maximum(box[0], np.floor(at.min(0)) - 4)
        box[1] = np.maximum(np.minimum(box[1], np.ceil(at.max(0)) + 4), box[0])
    return Cuts(grid, _where_to_cut(subject, grid), box)


def _slice(
    axes: Any,
    mesh: Mesh | None,
    cuts: Cuts,
    axis: int,
    index: int,
    volume: np.ndarray | None,
    values: np.ndarray | None,
    scale: Scale,
) -> None:
    """One slice, its first axis to the right and its second up."""
    from matplotlib.collections import LineCollection

    spacing = np.delete(cuts.grid.spacing, axis)
    low, high = (np.delete(end, axis) for end in cuts.box)
    (left, bottom), (right, top) = (low - 0.5) * spacing, (high + 0.5) * spacing
    if volume is not None:
        cut = volume.take(index, axis)[low[0] : high[0] + 1, low[1] : high[1] + 1].T
        colours = scale.rgba(cut.reshape(-1)).reshape(*cut.shape, 4)
        axes.imshow(colours, origin="lower", extent=(left, right, bottom, top), interpolation="nearest")
    if mesh is not None:
        segments, cells = geometry.outline(mesh, cuts.grid, axis, index)
        if volume is None and values is not None:
            shown = scale.rgba(values[mesh.cells[cells, 0]])
            axes.add_collection(
                LineCollection(list(segments), colors="black", linewidths=3.2, capstyle="round"), autolim=False
            )
            axes.add_collection(
                LineCollection(list(segments), colors=shown, linewidths=2.4, capstyle="round"), autolim=False
            )
        else:
            _cased(axes, segments, 0.5)
    axes.set(xlim=(left, right), ylim=(bottom, top), aspect="equal", xticks=[], yticks=[])
    axes.spines[:].set_visible(False)


def _letters(axes: Any, axis: int) -> None:
    """Where L, R, P, A, I, S are beside a slice."""
    first, second = (DIRECTIONS[k] for k in range(3) if k != axis)
    for (x, y), letter in zip(((-0.03, 0.5), (1.03, 0.5), (0.5, -0.03), (0.5, 1.03)), first + second, strict=True):
        align = {"ha": "right" if x < 0 else "left" if x > 1 else "center"}
        align["va"] = "top" if y < 0 else "bottom" if y > 1 else "center"
        axes.text(x, y, letter, transform=axes.transAxes, color=FAINT, fontsize="small", **align)


def _removed(subject: Subject) -> tuple[np.ndarray | None, np.ndarray | None]:
    """What a run removed: on the grid, and at the vertices; None where there are none."""
    first, last = subject.maps[0], subject.maps[-1]

    def between(before: np.ndarray | None, after: np.ndarray | None) -> np.ndarray | None:
        if before is None or after is None:
            return None
        difference = np.asarray(before, float) - after
        if subject.period is not None:
            difference = (difference + subject.period / 2) % subject.period - subject.period / 2
        return difference

    return between(first.volume, last.volume), between(first.values, last.values)


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
    affine[:3, 3] = low - spacing
    a, b, c = (int(n) for n in np.ceil(size / spacing) + 3)
    return Grid((a, b, c), affine)


# Histograms


def histograms(figure: Any, subject: Subject) -> None:
    """The values of all maps where the first is known; of a run, also what was removed, with its rms.

    subject: of one channel.
    """
    all_axes = grid_of_axes(figure, 1, 2 if subject.is_run else 1, gap=(0.35, 0))[0]
    draw_histograms(all_axes, subject)


def draw_histograms(all_axes: np.ndarray, subject: Subject) -> None:
    """The same on axes that are there, (1,), or (2,) for a run."""
    values = [values_of(shown) for shown in subject.maps]
    known = np.isfinite(values[0])
    values = [np.asarray(v[known & np.isfinite(v)], float) for v in values]
    if subject.period is not None:
        low, high = subject.low, subject.low + subject.period
    else:
        everything = np.concatenate(values)
        low, high = np.percentile(everything, (0.2, 99.8)) if everything.size else (0.0, 1.0)
    bins = np.linspace(low, high if high > low else low + 1, BINS + 1)
    colours = (INPUT, DENOISED) if subject.is_run else LINES
    axes = all_axes[0]
    for k, (shown, v) in enumerate(zip(subject.maps, values, strict=True)):
        colour = colours[k % len(colours)]
        is_first = k == 0 and len(values) > 1
        axes.hist(
            v, bins, color=colour, label=shown.title, histtype="stepfilled" if is_first else "step", linewidth=1.2
        )
    axes.set_title(f"values ({int(known.sum()):,} {_places(subject)})")
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.margins(x=0)
    if subject.period is not None:
        quarters = subject.low + subject.period * np.arange(5) / 4
        axes.set_xticks(quarters, [f"{angle:.3g}{unit(subject.period)}" for angle in quarters])
    axes.legend(frameon=False, loc="best")
    if subject.is_run:
        _histogram_of_removed(all_axes[1], subject)


def _histogram_of_removed(axes: Any, subject: Subject) -> None:
    removed = subject.removed()
    rms = float(np.sqrt(np.mean(removed**2))) if removed.size else 0.0
    most = float(np.percentile(np.abs(removed), 99.5)) if removed.size else 0.0
    axes.hist(removed, np.linspace(-most, most, BINS + 1) if most > 0 else 3, color=FAINT)
    axes.set_title(f"removed ({_places(subject)}): rms {rms:.3g}{unit(subject.period)}")
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.margins(x=0)


def _places(subject: Subject) -> str:
    return "voxels" if subject.maps[0].values is None else "vertices"


# Over the iterations


def has_iterations(record: Mapping[str, Any] | None) -> bool:
    """True where `iterations` has something to draw."""
    return bool(_courses(record))


def iterations(figure: Any, record: Mapping[str, Any], period: float | None = None) -> None:
    """One axes for each course that the record holds over the iterations: change, noise, held-out error, beta."""
    count = len(_courses(record))
    if count:
        draw_iterations(grid_of_axes(figure, 1, count, gap=(0.5, 0))[0], record)


def draw_iterations(all_axes: np.ndarray, record: Mapping[str, Any]) -> None:
    """The same on axes that are there, as many as `courses` counts."""
    for axes, (title, x, y, chosen) in zip(all_axes, _courses(record), strict=False):
        axes.plot(x, y, color=DENOISED, linewidth=1.4, marker="o", markersize=3 if len(x) < 40 else 0)
        positive = y[np.isfinite(y) & (y > 0)]
        if positive.size == np.isfinite(y).sum() and positive.size and positive.max() > 20 * positive.min():
            _to_log(axes, positive)
        if chosen is not None:
            axes.axvline(chosen, color=TRUTH, linewidth=1, linestyle="--")
            axes.annotate(
                f"chosen: {chosen}", (chosen, 0.97), (3, 0), ("data", "axes fraction"), "offset points",
                va="top", color=TRUTH, fontsize="small",
            )  # fmt: skip
        if np.ptp(y[np.isfinite(y)]) == 0:
            axes.set_ylim(*sorted((0, 2 * float(np.nanmax(y)) or 1.0)))
        axes.set_title(title)
        axes.set_xlabel("iteration", labelpad=1)
        axes.xaxis.get_major_locator().set_params(integer=True)
        axes.grid(alpha=0.25)


def _to_log(axes: Any, values: np.ndarray) -> None:
    """A logarithmic scale with plain numbers, few of them."""
    from matplotlib.ticker import LogLocator, NullFormatter, StrMethodFormatter

    axes.set_yscale("log")
    narrow = values.max() < 300 * values.min()
    axes.yaxis.set_major_locator(LogLocator(subs=(1, 3) if narrow else (1,)))
    axes.yaxis.set_major_formatter(StrMethodFormatter("{x:g}"))
    axes.yaxis.set_minor_formatter(NullFormatter())


def courses(record: Mapping[str, Any] | None) -> int:
    """How many axes `iterations` draws."""
    return len(_courses(record))


def _courses(record: Mapping[str, Any] | None) -> list[tuple[str, np.ndarray, np.ndarray, int | None]]:
    """Title, iterations, values and the chosen iteration of whatever a record holds; any of its keys may be missing."""
    record = record or {}
    steps = record.get("PerIteration") or {}
    found = []

    def add(title: str, values: Any, x: Any = None, chosen: int | None = None, first: int = 1) -> None:
        y = np.array([np.nan if value is None else value for value in values or []], float)
        if np.isfinite(y).any():
            found.append((title, np.arange(first, first + len(y)) if x is None else np.asarray(x), y, chosen))

    add("change, rms", steps.get("change_rms"))
    noise = steps.get("noise_sd")
    if noise:
        add("noise, sd", [(one.get("sd") or [None])[0] for one in noise], [one["iteration"] for one in noise])
    elif record.get("Noise") and record.get("Iterations"):
        ends = [(record["Noise"].get(name) or [None])[0] for name in ("sd", "after")]
        add("noise, sd", ends, [0, record["Iterations"]])
    choice = record.get("Choice") or {}
    add("held-out error, rms", choice.get("errors"), chosen=choice.get("iterations"), first=0)
    add("beta (mm per unit)", steps.get("beta"))
    if len(set(steps.get("beta") or [])) > 1:
        add("dt / beta", steps.get("dt_over_beta"))
    return found


# The key


def key(figure: Any, scale: Scale, *, label: str = "", missing: bool = False, filled: bool = False) -> None:
    """What the colours mean: a bar, or a wheel for angles; what grey means; what the outline means."""
    width, height = figure.bbox.width / figure.dpi, figure.bbox.height / figure.dpi
    notes = [("no data", True)] * missing + [("filled in: no data\nbefore the run", False)] * filled
    above, below = (0.35, 0.5) if scale.period else (0.1, 0.25)
    above += 0.2 if label else 0.0
    left_over = height - above - below - 0.42 * len(notes)
    tall = min(1.15, left_over, width - 0.9) if scale.period else min(2.2, left_over)
    wide, left = (tall, (width - tall) / 2) if scale.period else (0.22, 0.35)
    base = below + 0.42 * len(notes) + (left_over - tall) / 2

    def axes_at(x: float, y: float, w: float, h: float) -> Any:
        return figure.add_axes((x / width, y / height, w / width, h / height))

    axes = axes_at(left, base, wide, tall)
    (_wheel if scale.period else _bar)(axes, scale)
    axes.set_title(label, pad=30 if scale.period else 8)
    for k, (text, is_missing) in enumerate(notes):
        swatch = axes_at(0.25, base - below - 0.42 * (k + 1) + 0.12, 0.24, 0.2)
        swatch.set(xticks=[], yticks=[], facecolor=MISSING if is_missing else "white")
        swatch.spines[:].set(visible=True, color=MISSING if is_missing else "black", linewidth=1.2)
        swatch.annotate(text, (1, 0.5), (5, 0), "axes fraction", "offset points", va="center", fontsize="small")


def _bar(axes: Any, scale: Scale, of: str = "") -> None:
    axes.imshow(scale.table()[:, None], origin="lower", aspect="auto", extent=(0, 1, scale.low, scale.high))
    axes.set_xticks([])
    axes.yaxis.tick_right()
    axes.yaxis.set_major_formatter(f"{{x:g}}{of}")
    axes.spines[:].set_visible(False)


def _wheel(axes: Any, scale: Scale) -> None:
    """Angles as they point: 0 to the right, counter-clockwise."""
    period = scale.high - scale.low
    x = np.linspace(-1, 1, 400)
    radius, turn = np.hypot(x, x[:, None]), np.arctan2(x[:, None], x) / (2 * np.pi)
    values = scale.low + (turn * period - scale.low) % period
    picture = scale.rgba(values.reshape(-1)).reshape(400, 400, 4)
    picture[..., 3] = np.clip((1 - radius) * 200, 0, 1) * np.clip((radius - 0.45) * 200, 0, 1)
    axes.imshow(picture, origin="lower", extent=(-1, 1, -1, 1))
    axes.set_axis_off()
    ring = np.exp(2j * np.pi * np.linspace(0, 1, 200))
    for r in (0.45, 1):
        axes.plot(r * ring.real, r * ring.imag, color=FAINT, linewidth=0.5)
    axes.plot([-0.4, 0.4], [0, 0], color=FAINT, linewidth=0.6)
    axes.plot([0, 0], [-0.4, 0.4], color=FAINT, linewidth=0.6)
    for quarter, (right, up) in enumerate(((1, 0), (0, 1), (-1, 0), (0, -1))):
        value = scale.low + (quarter * period / 4 - scale.low) % period
        _text_away(axes, 1.08 * right, 1.08 * up, f"{value:.3g}{unit(period)}", INK)
    if period == 360:
        for right, up, name in QUADRANTS:
            _text_away(axes, 0.82 * right, 0.82 * up, name, FAINT)
    axes.set(xlim=(-1.02, 1.02), ylim=(-1.02, 1.02))


def _text_away(axes: Any, x: float, y: float, text: str, colour: str) -> None:
    """Text that begins at a place and leads away from the middle."""
    align = {
        "ha": ("right", "center", "left")[int(np.sign(x)) + 1],
        "va": ("top", "center", "bottom")[int(np.sign(y)) + 1],
    }
    axes.text(x, y, text, color=colour, **align)


def unit(period: float | None) -> str:
    """The sign of the unit of angles; empty where unknown."""
    if period is None:
        return ""
    return "°" if period == 360 else " rad" if abs(period - 2 * np.pi) < 1e-3 else ""


# Axes


def grid_of_axes(
    figure: Any,
    rows: int,
    columns: int,
    *,
    left: float = 0.5,
    right: float = 0.15,
    bottom: float = 0.4,
    top: float = 0.3,
    gap: tuple[float, float] = (0.3, 0.3),
    widths: Sequence[float] | np.ndarray | None = None,
) -> np.ndarray:
    """(rows, columns) axes in a Figure or SubFigure; margins and gaps in inches."""
    width, height = figure.bbox.width / figure.dpi, figure.bbox.height / figure.dpi
    across = (width - left - right - gap[0] * (columns - 1)) / columns
    up = (height - top - bottom - gap[1] * (rows - 1)) / rows
    layout = figure.add_gridspec(
        rows,
        columns,
        left=left / width,
        right=1 - right / width,
        bottom=bottom / height,
        top=1 - top / height,
        wspace=gap[0] / across,
        hspace=gap[1] / up,
        width_ratios=widths,
    )
    return layout.subplots(squeeze=False)
