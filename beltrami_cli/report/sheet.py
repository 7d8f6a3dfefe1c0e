"""The static sheet: everything about a subject on one picture."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli.formats import checks
from beltrami_cli.report import geometry, graphs, key, slices, style, surfaces
from beltrami_cli.report.colours import MISSING_SULCUS, Scale, faded, scale_of, values_of
from beltrami_cli.report.geometry import View
from beltrami_cli.report.style import FAINT, unit
from beltrami_cli.report.subject import Map, Subject
from beltrami_cli.surface import Mesh

WIDTH, DPI = 12.0, 150  # inches and pixels per inch: 1,800 pixels across
TRIANGLES = 60_000  # one covers about two pixels of a view
KEY = 2.0  # inches
FIRST = 1.35  # how much larger the view is that sees most of the data
CLOSE_UP = 0.75  # share of the picture below which the data are shown from close by
MARGIN = 0.06  # around them, of their size

# A block of the sheet: its height in inches, and what draws it into a SubFigure.
Block = tuple[float, Callable[[Any], None]]


@dataclass(frozen=True, eq=False)
class Panel:
    """A side to look at, under a title. box: (2, 2) from and to, right and up in mm: the part that is shown."""

    title: str
    view: View
    box: np.ndarray


@dataclass(frozen=True, eq=False)
class Seen:
    """A surface made ready to be painted.

    folded, form: coarser copies, as it is and as it is shown first (inflated for a cortex). source: (V',) the vertex
    whose value each vertex shows. sulci: (V',) bool. known: (V',) bool, where the first map has data. views: the one
    first that is chosen, or else that sees most of the data.
    """

    folded: Mesh
    form: Mesh
    source: np.ndarray
    sulci: np.ndarray
    known: np.ndarray
    views: list[View]
    is_cortex: bool
    chosen: bool

    def colours(self, scale: Scale, shown: Map) -> np.ndarray:
        """(V', 4) colours of a map of the whole surface."""
        assert shown.values is not None
        values = shown.values[self.source]
        colours = faded(scale.rgba(values), self.filled(shown))
        colours[~np.isfinite(values) & self.sulci, :3] = MISSING_SULCUS
        return colours

    def filled(self, shown: Map) -> np.ndarray | None:
        """(V',) bool, where a map was filled in."""
        return None if shown.filled is None else shown.filled[self.source]

    def panels(self) -> list[Panel]:
        """Four sides, and before them the data from close by where they take a small part of what is seen."""
        shape = ", inflated" if self.is_cortex else ""
        close = self.close_up()
        sides = [Panel(view.name + shape, view, surfaces.whole(self.form, view)) for view in self.views]
        return ([close] if close is not None else []) + sides

    def close_up(self) -> Panel | None:
        """The data from the side to which most of them face; None where that is nearly all of the surface."""
        if self.chosen:
            return None
        view = geometry.best_view(self.form, self.known)
        facing = self.known & (geometry.vertex_normals(self.form) @ view.camera[2] > 0)
        if not facing.any():
            return None
        flat = self.form.vertices_ras_mm[facing] @ view.camera[:2].T
        box = np.percentile(flat, (0.1, 99.9), axis=0)
        margin = MARGIN * np.ptp(box, axis=0).max()
        box += [[-margin], [margin]]
        around = surfaces.whole(self.form, view)
        box = np.stack([np.maximum(box[0], around[0]), np.minimum(box[1], around[1])])
        is_small = np.ptp(box, axis=0).prod() < CLOSE_UP * np.ptp(around, axis=0).prod()
        return Panel(f"{view.name}, close by", view, box) if is_small else None


def draw(path: Path, subject: Subject) -> None:
    """Write a PNG; raises DataError where the file cannot be written."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    shown = subject.channel(0)
    scale = scale_of(shown)
    seen = None if shown.mesh is None or shown.is_curve else _seen(shown)
    blocks = _few(shown, scale, seen) if len(shown.maps) <= 2 else _many(shown, scale, seen)
    blocks = [_headline(subject, seen), *blocks]
    with rc_context(style.STYLE):
        figure = Figure(figsize=(WIDTH, sum(height for height, _ in blocks)), dpi=DPI, facecolor="white")
        parts = figure.subfigures(len(blocks), 1, height_ratios=[height for height, _ in blocks], squeeze=False)
        for part, (_, fill) in zip(parts[:, 0], blocks, strict=True):
            fill(part)
        with checks.writing(path):
            figure.savefig(path, format="png", dpi=DPI)


def _seen(subject: Subject) -> Seen:
    assert subject.mesh is not None
    folded, source = geometry.simplified(subject.mesh, TRIANGLES)
    is_cortex = geometry.is_cortex(folded)
    if is_cortex and folded.structure is None:
        folded = replace(folded, structure="Cortex")  # found once
    form = geometry.inflated(folded) if is_cortex else folded
    values = subject.maps[0].values
    assert values is not None
    known = np.isfinite(values[source])
    whole = known[folded.cells].all(1)
    area = geometry.area_vectors(form)[whole if whole.any() else slice(None)]
    views = sorted(geometry.views(folded), key=lambda view: -np.maximum(area @ view.camera[2], 0).sum())
    if subject.side is not None:
        views = [geometry.from_side(folded, subject.side), *(v for v in views if v.name != subject.side)][:4]
    sulci = geometry.curvature(folded) < 0 if is_cortex else np.zeros(len(source), bool)
    return Seen(folded, form, source, sulci, known, views, is_cortex, chosen=subject.side is not None)


def _few(subject: Subject, scale: Scale, seen: Seen | None) -> list[Block]:
    """A run, or one or two maps: from four sides, in slices, and in figures."""
    words = [_words(subject.record)] if subject.record else []
    if seen is None:
        line: list[Block] = [(3.4, lambda part: graphs.curve(part, subject))] if subject.is_curve else []
        beside_key = _beside(
            (
                WIDTH - KEY,
                slices.height(subject, WIDTH - KEY),
                lambda part: slices.draw(part, subject, scale),
            ),
            (KEY, 0.0, lambda part: _key(part, subject, scale)),
        )
        return [*line, beside_key, _graphs(subject), *words]
    left = 0.6 * WIDTH
    cut = (left, slices.height(subject, left), lambda part: slices.draw(part, subject, scale))
    if seen.is_cortex:
        below = [_beside(cut, (WIDTH - left, 0.0, lambda part: _folds(part, subject, scale, seen))), _graphs(subject)]
    else:
        below = [_beside(cut, (WIDTH - left, 0.0, lambda part: _fill_graphs(part, subject, columns=2)))]
    return [_views(subject, scale, seen), *below, *words]


def _beside(*parts: tuple[float, float, Callable[[Any], None]]) -> Block:
    """Blocks side by side: the width and the least height of each, in inches, and what fills it."""

    def fill(whole: Any) -> None:
        widths = [width for width, _, _ in parts]
        for part, (_, _, fill_part) in zip(whole.subfigures(1, len(parts), width_ratios=widths), parts, strict=True):
            fill_part(part)

    return max(2.5, *(height for _, height, _ in parts)), fill


def _views(subject: Subject, scale: Scale, seen: Seen) -> Block:
    """A row of views for each map, all at one size but the first, and the key beside them."""
    panels = seen.panels()
    sizes = np.array([np.ptp(panel.box, axis=0) for panel in panels])
    if len(panels) > 4:
        sizes[0] *= 2 * sizes[1:, 1].max() / sizes[0, 1]
    else:
        sizes[0] *= FIRST
    gap, left, right, between = 0.35, 0.6, 0.2, 0.3
    scaled = (WIDTH - KEY - left - right - gap * (len(panels) - 1)) / sizes[:, 0].sum()
    rows, row = len(subject.maps), min(sizes[:, 1].max() * scaled, 3.6)

    def fill(part: Any) -> None:
        left_part, right_part = part.subfigures(1, 2, width_ratios=[WIDTH - KEY, KEY])
        all_axes = style.grid_of_axes(
            left_part, rows, len(panels), left=left, right=right, top=0.5, bottom=0.2, gap=(gap, between),
            widths=sizes[:, 0],
        )  # fmt: skip
        for shown, line in zip(subject.maps, all_axes, strict=True):
            for panel, axes in zip(panels, line, strict=True):
                _paint(axes, shown, seen, scale, panel)
            line[0].annotate(
                shown.title, (0, 0.5), (10, 0), ("figure points", "axes fraction"), "offset points",
                rotation=90, va="center", fontsize=12, fontweight="bold",
            )  # fmt: skip
        for panel, axes in zip(panels, all_axes[0], strict=True):
            axes.set_title(panel.title, pad=15)
            surfaces.directions(axes, panel.view)
        _key(right_part, subject, scale)

    return rows * row + (rows - 1) * between + 0.7, fill


def _paint(axes: Any, shown: Map, seen: Seen, scale: Scale, panel: Panel) -> None:
    surfaces.draw(axes, seen.form, seen.colours(scale, shown), panel.view, seen.filled(shown), panel.box)


def _key(part: Any, subject: Subject, scale: Scale) -> None:
    missing = any(not np.isfinite(values_of(shown)).all() for shown in subject.maps)
    filled = any(shown.filled is not None and bool(shown.filled.any()) for shown in subject.maps)
    key.draw(part, scale, missing=missing, filled=filled)


def _folds(part: Any, subject: Subject, scale: Scale, seen: Seen) -> None:
    """The surface as it is, from the two sides that see most of the data."""
    rows = len(subject.maps)
    all_axes = style.grid_of_axes(part, rows, 2, left=0.1, top=0.45, bottom=0.2, gap=(0.4, 0.2))
    for shown, line in zip(subject.maps, all_axes, strict=True):
        for view, axes in zip(seen.views, line, strict=False):
            surfaces.draw(axes, seen.folded, seen.colours(scale, shown), view)
    for view, axes in zip(seen.views, all_axes[0], strict=False):
        axes.set_title(view.name + ", folded", pad=15)
        surfaces.directions(axes, view)


def _graphs(subject: Subject) -> Block:
    return 2.1, lambda part: _fill_graphs(part, subject)


def _fill_graphs(part: Any, subject: Subject, columns: int | None = None) -> None:
    """Histograms, then the courses over the iterations, in rows of so many; by default in one."""
    first = 2 if subject.compares else 1
    count = first + graphs.courses(subject.record)
    columns = columns or max(count, 3)
    rows = -(-count // columns)
    axes = style.grid_of_axes(part, rows, columns, left=0.35, gap=(0.5, 0.6)).ravel()
    graphs.draw_histograms(axes[:first], subject)
    graphs.draw_iterations(axes[first:count], subject.record or {})
    for spare in axes[count:]:
        spare.set_axis_off()


def _words(record: Mapping[str, Any]) -> Block:
    """Warnings in full, and a table of the parameters that were used."""
    used = [(name, _plain(value)) for name, value in (record.get("Parameters") or {}).items() if value is not None]
    warnings = [line for one in record.get("Warnings") or [] for line in textwrap.wrap(f"Warning: {one}", 150)]
    columns = 6
    rows = -(-len(used) // columns)
    line = 0.17
    height = line * (len(warnings) + rows) + 0.5

    def fill(part: Any) -> None:
        top = 1.0
        if warnings:
            part.text(0.025, top, "\n".join(warnings), va="top", fontsize=9, color=style.WARNING, linespacing=1.2)
            top -= (line * len(warnings) + 0.12) / height
        for k, (name, value) in enumerate(used):
            x = 0.025 + k // rows * 0.95 / columns
            y = top - line * (k % rows + 1) / height
            part.text(x, y, name, fontsize=7.5, color=FAINT)
            part.text(x + 0.075, y, value, fontsize=7.5)

    return height, fill


def _plain(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.4g}"
    if isinstance(value, list | tuple):
        return ":".join(_plain(one) for one in value)
    return str(value)


def _headline(subject: Subject, seen: Seen | None) -> Block:
    """The title, the figures that count, and small print."""
    small = [*subject.notes]
    if subject.channels > 1:
        small.append(f"channel 1 of {subject.channels} is shown")
    if seen is not None and seen.is_cortex:
        small.append("inflated: a smoothed copy of the surface; without data, gyri are light and sulci dark")
    if seen is not None and subject.mesh is not None and len(subject.mesh.cells) > len(seen.folded.cells):
        small.append(f"drawn with {len(seen.folded.cells):,} of {len(subject.mesh.cells):,} triangles")
    figures = headline(subject)
    lines = [(subject.title, {"fontsize": 14, "fontweight": "bold"})] if subject.title else []
    lines += [(figures, {"fontsize": 11})] if figures else []
    lines += [(line, {"fontsize": 7.5, "color": FAINT}) for line in textwrap.wrap("; ".join(small), 190)]
    height = 0.15 + 0.28 * len(lines)

    def fill(part: Any) -> None:
        for k, (line, look) in enumerate(lines):
            part.text(0.025, 1 - (0.3 + 0.27 * k) / height, line, **look)

    return height, fill


def headline(subject: Subject) -> str:
    """The figures that count, of a run: noise, what was removed, smoothness, iterations and time."""
    record, of = subject.record or {}, unit(subject.period)
    noise, smooth = record.get("Noise") or {}, record.get("Smoothness") or {}
    parts = []
    before, after = ((noise.get(name) or [None])[0] for name in ("sd", "after"))
    if before is not None and after is not None:
        parts.append(f"noise {before:.3g}{of} → {after:.3g}{of}")
    rms = (record.get("Removed") or {}).get("rms")
    if rms is not None:
        parts.append(f"removed {rms:.3g}{of} rms")
    if smooth.get("before_mm") is not None and smooth.get("after_mm") is not None:
        parts.append(f"smoothness {smooth['before_mm']:.1f} → {smooth['after_mm']:.1f} mm FWHM")
    if record.get("Iterations") is not None:
        reason = f" (stop: {record['StopReason']})" if record.get("StopReason") else ""
        parts.append(f"{record['Iterations']} iterations{reason}")
    if record.get("Seconds"):
        parts.append(f"{sum(record['Seconds'].values()):.1f} s")
    return "   ·   ".join(parts)


def _many(subject: Subject, scale: Scale, seen: Seen | None) -> list[Block]:
    """A figure as in a paper: a panel per map and one key."""
    if subject.is_curve:
        return [(4.0, lambda part: graphs.curve(part, subject))]
    rows = -(-len(subject.maps) // 4)
    columns = -(-len(subject.maps) // rows)
    if seen is None:
        return [(2.2 * len(subject.maps), lambda part: slices.draw(part, subject, scale))]
    best = seen.views[0] if seen.chosen else geometry.best_view(seen.form, seen.known)
    panel = seen.close_up() or Panel(best.name, best, surfaces.whole(seen.form, best))
    across, up = np.ptp(panel.box, axis=0)
    width = (WIDTH - KEY - 0.4 - 0.3 * (columns - 1)) / columns
    height = min(width * up / across, 4.0)

    def fill(part: Any) -> None:
        left, right = part.subfigures(1, 2, width_ratios=[WIDTH - KEY, KEY])
        all_axes = style.grid_of_axes(left, rows, columns, left=0.2, right=0.2, top=0.4, bottom=0.1, gap=(0.3, 0.4))
        for axes in all_axes.flat[len(subject.maps) :]:
            axes.set_axis_off()
        for shown, axes in zip(subject.maps, all_axes.flat, strict=False):
            _paint(axes, shown, seen, scale, panel)
            axes.set_title(shown.title, fontsize=10)
        _key(right, subject, scale)

    return [(rows * height + (rows - 1) * 0.4 + 0.5, fill)]
