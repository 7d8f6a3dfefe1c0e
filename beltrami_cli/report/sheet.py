"""The static sheet: everything about a subject on one picture."""

from __future__ import annotations

import io
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli.formats import checks
from beltrami_cli.report import geometry, graphs, key, slices, style, surfaces, words
from beltrami_cli.report.colours import MISSING_SULCUS, Scale, faded, has_values, scale_of, values_of
from beltrami_cli.report.geometry import View
from beltrami_cli.report.style import FAINT
from beltrami_cli.report.subject import Map, Subject
from beltrami_cli.surface import Mesh

WIDTH, DPI = 12.0, 150  # inches and pixels per inch: 1,800 pixels across
COMPACT, COMPACT_KEY = 8.0, (1.35, 2.0)  # inches: a figure of many maps; its key with no more than a bar, and with more
TRIANGLES = 60_000  # one covers about two pixels of a view
KEY = 2.0  # inches
FIRST = 1.35  # how much larger the view is that sees most of the data
CLOSE_UP = 0.75  # share of the picture below which the data are shown from close by
MARGIN = 0.06  # around them, of their size
# By `geometry.outwards`: from here on a cortex has an inner side, which is seen where it is cut open. Crops of
# hemispheres have 0.6 to 0.7; the ribbons of a slab 0.2, and of them both sides are looked at.
OUTWARDS = 0.5

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
    whose value each vertex shows. sulci: (V',) bool. known: (V',) bool, where the first map has data; painted:
    or the last. views: the one first that is chosen, or else that sees most of the data. plain_inside: as
    `surfaces.draw` has it. position: the hemisphere that it is taken for by its position.
    """

    folded: Mesh
    form: Mesh
    source: np.ndarray
    sulci: np.ndarray
    known: np.ndarray
    painted: np.ndarray
    views: list[View]
    is_cortex: bool
    chosen: bool
    plain_inside: bool
    position: str | None

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
        facing = self.painted & (geometry.vertex_normals(self.form) @ view.camera[2] > 0)
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
    is_compact = len(shown.maps) > 2
    width = COMPACT if is_compact else WIDTH
    blocks = _many(shown, scale, seen) if is_compact else _few(shown, scale, seen)
    blocks = [_headline(subject, seen, is_compact), *blocks]
    with rc_context(style.COMPACT if is_compact else style.STYLE):
        figure = Figure(figsize=(width, sum(height for height, _ in blocks)), dpi=DPI, facecolor="white")
        parts = figure.subfigures(len(blocks), 1, height_ratios=[height for height, _ in blocks], squeeze=False)
        for part, (_, fill) in zip(parts[:, 0], blocks, strict=True):
            fill(part)
        drawn = io.BytesIO()
        figure.savefig(drawn, format="png", dpi=DPI)
    with checks.writing(path):
        path.write_bytes(drawn.getvalue())


def _seen(subject: Subject) -> Seen:
    assert subject.mesh is not None
    folded, source = geometry.simplified(subject.mesh, TRIANGLES)
    is_cortex = geometry.is_cortex(folded)
    if is_cortex and folded.structure is None:
        folded = replace(folded, structure="Cortex")  # found once
    form = geometry.inflated(folded) if is_cortex else folded
    outwards = geometry.outwards(form) if is_cortex else 0.0
    if outwards < -OUTWARDS:
        folded, form = (replace(one, cells=one.cells[:, ::-1]) for one in (folded, form))
    known, last = (np.isfinite(values_of(shown)[source]) for shown in (subject.maps[0], subject.maps[-1]))
    whole = known[folded.cells].all(1)
    area = geometry.area_vectors(form)[whole if whole.any() else slice(None)]
    views = sorted(geometry.views(folded), key=lambda view: -np.maximum(area @ view.camera[2], 0).sum())
    if subject.side is not None:
        views = [geometry.from_side(folded, subject.side), *(v for v in views if v.name != subject.side)][:4]
    sulci = geometry.curvature(folded) < 0 if is_cortex else np.zeros(len(source), bool)
    named = {view.name for view in (views if len(subject.maps) <= 2 else views[: subject.side is not None])}
    by_position = named & {"lateral", "medial"}
    return Seen(
        folded, form, source, sulci, known, known | last, views, is_cortex,
        chosen=subject.side is not None, plain_inside=abs(outwards) > OUTWARDS and geometry.is_open(folded),
        position=geometry.hemisphere_by_position(folded) if by_position else None,
    )  # fmt: skip


def _few(subject: Subject, scale: Scale, seen: Seen | None) -> list[Block]:
    """A run, or one or two maps: from four sides, in slices, and in figures."""
    told = [_words(subject.record)] if subject.record else []
    figures = [_graphs(subject)] if _count(subject) else []
    if seen is None:
        line: list[Block] = [(3.4, lambda part: graphs.curve(part, subject))] if subject.is_curve else []
        beside_key = _beside(
            (
                WIDTH - KEY,
                slices.height(subject, WIDTH - KEY),
                lambda part: slices.draw(part, subject, scale),
            ),
            (KEY, 0.0, lambda part: _key(part, subject, scale, seen)),
        )
        return [*line, beside_key, *figures, *told]
    left = 0.6 * WIDTH
    cut = (left, slices.height(subject, left), lambda part: slices.draw(part, subject, scale))
    if seen.is_cortex:
        below = [_beside(cut, (WIDTH - left, 0.0, lambda part: _folds(part, subject, scale, seen))), *figures]
    else:
        below = [_beside(cut, (WIDTH - left, 0.0, lambda part: _fill_graphs(part, subject, columns=2)))]
    return [_views(subject, scale, seen), *below, *told]


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
        _key(right_part, subject, scale, seen)

    return rows * row + (rows - 1) * between + 0.7, fill


def _paint(axes: Any, shown: Map, seen: Seen, scale: Scale, panel: Panel) -> None:
    colours, filled = seen.colours(scale, shown), seen.filled(shown)
    surfaces.draw(axes, seen.form, colours, panel.view, filled, panel.box, seen.plain_inside)


def _key(part: Any, subject: Subject, scale: Scale, seen: Seen | None) -> None:
    key.draw(
        part, scale if has_values(subject) else None, missing=_is_missing(subject), filled=_is_filled(subject, seen)
    )


def _is_missing(subject: Subject) -> bool:
    return any(not np.isfinite(values_of(shown)).all() for shown in subject.maps)


def _is_filled(subject: Subject, seen: Seen | None) -> bool:
    """True where the sheet shows what was filled in."""
    if seen is None:
        return False
    all_filled = (seen.filled(shown) for shown in subject.maps)
    return any(filled is not None and geometry.is_filled(seen.folded, filled) for filled in all_filled)


def _folds(part: Any, subject: Subject, scale: Scale, seen: Seen) -> None:
    """The surface as it is, from the two sides that see most of the data."""
    rows = len(subject.maps)
    all_axes = style.grid_of_axes(part, rows, 2, left=0.1, top=0.45, bottom=0.2, gap=(0.4, 0.2))
    for shown, line in zip(subject.maps, all_axes, strict=True):
        for view, axes in zip(seen.views, line, strict=False):
            surfaces.draw(axes, seen.folded, seen.colours(scale, shown), view, plain_inside=seen.plain_inside)
    for view, axes in zip(seen.views, all_axes[0], strict=False):
        axes.set_title(view.name + ", folded", pad=15)
        surfaces.directions(axes, view)


def _graphs(subject: Subject) -> Block:
    return 2.1, lambda part: _fill_graphs(part, subject)


def _count(subject: Subject) -> int:
    """How many graphs there are of a run, or of one or two maps."""
    return _histograms(subject) + graphs.courses(subject.record)


def _histograms(subject: Subject) -> int:
    return 1 + subject.compares if has_values(subject) else 0


def _fill_graphs(part: Any, subject: Subject, columns: int | None = None) -> None:
    """Histograms, then the courses over the iterations, in rows of so many; by default in one."""
    first, count = _histograms(subject), _count(subject)
    if count == 0:
        return
    columns = columns or max(count, 3)
    rows = -(-count // columns)
    axes = style.grid_of_axes(part, rows, columns, left=0.35, gap=(0.5, 0.6)).ravel()
    if first:
        graphs.draw_histograms(axes[:first], subject)
    graphs.draw_iterations(axes[first:count], subject.record or {})
    for spare in axes[count:]:
        spare.set_axis_off()


def _words(record: Mapping[str, Any]) -> Block:
    """Warnings in full, and a table of the parameters that were used."""
    parameters = dict(record.get("Parameters") or {})
    if (beta := words.chosen_beta(record)) is not None:
        parameters["beta"] = beta
    used = [(name, _plain(value)) for name, value in parameters.items() if value is not None]
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


def _headline(subject: Subject, seen: Seen | None, is_compact: bool) -> Block:
    """The title, the figures that count, and small print."""
    figures, small = _figures(subject), "; ".join(_small_print(subject, seen))
    size, letters, line = (10, 105, 0.2) if is_compact else (7.5, 215, 0.16)  # points, a line, inches
    lines: list[tuple[str, float, dict[str, Any]]] = []
    lines += [(subject.title, 0.28, {"fontsize": 14, "fontweight": "bold"})] if subject.title else []
    lines += [(line_of, 0.26, {"fontsize": 11}) for line_of in figures]
    for k, text in enumerate(textwrap.wrap(small, letters)):
        lines.append((text, line if k else 0.24, {"fontsize": size, "color": FAINT}))
    height = 0.2 + sum(down for _, down, _ in lines)

    def fill(part: Any) -> None:
        y = 0.02
        for text, down, look in lines:
            y += down
            part.text(0.025, 1 - y / height, text, **look)

    return height, fill


def _figures(subject: Subject) -> list[str]:
    """The figures that count, of a run, in lines."""
    found = words.facts(subject.record or {}, subject.period)
    kept = (f"{name[0].lower()}{name[1:]} {value}".replace(" ", "\N{NO-BREAK SPACE}") for name, value in found)
    return [line.strip(" ·") for line in textwrap.wrap("  ·  ".join(kept), 130)]


def _small_print(subject: Subject, seen: Seen | None) -> list[str]:
    """What is to be known of what is shown."""
    small, record = [*subject.notes], subject.record or {}
    if not has_values(subject.channel(0)):
        small.append("no values")
    if record.get("Iterations") == 0:
        small.append(words.NOTHING if subject.maps[0].volume is None else words.EXTENSION_ALONE)
    if subject.channels > 1:
        small.append(f"channel 1 of {subject.channels} is shown")
    if seen is None or subject.mesh is None:
        return small
    if seen.position is not None:
        small.append(f"taken for a {seen.position} hemisphere, by its position")
    if seen.is_cortex:
        grey = "; the inner side, where it is cut open, is pale" if seen.plain_inside else ""
        small.append(f"inflated: a smoothed copy of the surface; without data, gyri are light and sulci dark{grey}")
    if len(subject.mesh.cells) > len(seen.folded.cells):
        small.append(f"drawn with {len(seen.folded.cells):,} of {len(subject.mesh.cells):,} triangles")
    return small


def _many(subject: Subject, scale: Scale, seen: Seen | None) -> list[Block]:
    """A figure as in a paper: a panel per map and one key, in the place that they leave free or else beside them."""
    if subject.is_curve:
        return [(4.0, lambda part: graphs.curve(part, subject))]
    rows = -(-len(subject.maps) // 4)
    columns = -(-len(subject.maps) // rows)
    if seen is None:
        beside = COMPACT_KEY[scale.period]
        cut = (
            COMPACT - beside,
            slices.height(subject, COMPACT - beside),
            lambda part: slices.draw(part, subject, scale),
        )
        return [_beside(cut, (beside, key.height(scale, 1), lambda part: _key(part, subject, scale, seen)))]
    best = seen.views[0] if seen.chosen else geometry.best_view(seen.form, seen.known)
    panel = seen.close_up() or Panel(best.name, best, surfaces.whole(seen.form, best))
    across, up = np.ptp(panel.box, axis=0)
    free = rows * columns - len(subject.maps)
    beside = 0.0 if free else COMPACT_KEY[scale.period or _is_filled(subject, seen)]
    left, gap = COMPACT - beside, 0.15
    width = (left - 0.4 - gap * (columns - 1)) / columns
    height = min(width * up / across, 4.0)

    def fill(part: Any) -> None:
        if free:
            panels, place = part, part.add_subfigure(part.add_gridspec(rows, columns)[-1, -free:])
        else:
            panels, place = part.subfigures(1, 2, width_ratios=[left, beside])
        all_axes = style.grid_of_axes(panels, rows, columns, left=0.2, right=0.2, top=0.4, bottom=0.1, gap=(gap, 0.4))
        for axes in all_axes.flat[len(subject.maps) :]:
            axes.set_axis_off()
        for shown, axes in zip(subject.maps, all_axes.flat, strict=False):
            _paint(axes, shown, seen, scale, panel)
        style.set_titles(all_axes.flat, [shown.title for shown in subject.maps], width)
        _key(place, subject, scale, seen)

    of_key = key.height(scale, _is_missing(subject) + _is_filled(subject, seen)) * (rows if free else 1)
    return [(max(rows * height + (rows - 1) * 0.4 + 0.5, of_key), fill)]
