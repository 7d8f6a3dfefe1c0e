"""Panels with axes of numbers: values along a curve, histograms, courses over the iterations."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from beltrami_cli.report.colours import values_of
from beltrami_cli.report.style import DENOISED, FAINT, INPUT, LINES, TRUTH, grid_of_axes, legend_above, points, unit
from beltrami_cli.report.subject import Subject
from beltrami_cli.surface import Mesh

BINS = 90


@dataclass(frozen=True, eq=False)
class Course:
    """Values y over iterations x. chosen: the iteration that was. level: a value to compare with, and its name."""

    title: str
    x: np.ndarray
    y: np.ndarray
    chosen: int | None = None
    level: tuple[float, str] | None = None


def _colours(subject: Subject) -> tuple[str, ...]:
    """Of the lines of its maps: two are an input and what became of it, and the first of more is the truth."""
    return {1: (DENOISED,), 2: (INPUT, DENOISED)}.get(len(subject.maps), LINES)


def curve(figure: Any, subject: Subject, label: str = "value") -> None:
    """Of a curve: one line for each map over the arc length, the roughest behind."""
    assert subject.mesh is not None
    letters = points() / 8
    (axes,) = grid_of_axes(figure, 1, 1, left=0.5 * letters, bottom=0.4 * letters, top=0.1)[0]
    vertices, arc = along(subject.mesh)
    colours = _colours(subject)
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
    drawn = dict(zip(order.tolist(), axes.get_lines(), strict=True))
    legend_above(axes, [drawn[k] for k in range(len(lines))])


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


def histograms(figure: Any, subject: Subject) -> None:
    """The values of all maps where the first is known; of two that are compared also their difference, with its rms.

    subject: of one channel.
    """
    all_axes = grid_of_axes(figure, 1, 2 if subject.compares else 1, gap=(0.35, 0))[0]
    draw_histograms(all_axes, subject)


def draw_histograms(all_axes: np.ndarray, subject: Subject) -> None:
    """The same on axes that are there, (1,), or (2,) with a difference."""
    values = [values_of(shown) for shown in subject.maps]
    known = np.isfinite(values[0])
    values = [np.asarray(v[known & np.isfinite(v)], float) for v in values]
    axes, colours = all_axes[0], _colours(subject)
    if subject.period is None:
        everything = np.concatenate(values)
        low, high = np.percentile(everything, (0.2, 99.8)) if everything.size else (0.0, 1.0)
    else:
        low, high = _around_the_mean(axes, values[-1], subject.low, subject.period)
        values = [low + (v - low) % subject.period for v in values]
    bins = np.linspace(low, high if high > low else low + 1, BINS + 1)
    handles = []
    for k, (shown, v) in enumerate(zip(subject.maps, values, strict=True)):
        form = "stepfilled" if k == 0 and len(values) == 2 else "step"
        drawn = axes.hist(v, bins, color=colours[k % len(colours)], label=shown.title, histtype=form, linewidth=1.2)
        handles.append(drawn[2][0])
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.margins(x=0)
    title = f"values ({int(known.sum()):,} {_places(subject)})"
    if len(handles) > 1:
        legend_above(axes, handles, title)
    else:
        axes.set_title(title)
    if subject.compares:
        _histogram_of_differences(all_axes[1], subject)


def _around_the_mean(axes: Any, angles: np.ndarray, low: float, period: float) -> tuple[float, float]:
    """A range about the circular mean of angles, so that none of their lobes is cut, and ticks in their own range."""
    turn = 2 * np.pi / period
    mean = float(np.angle(np.exp(1j * turn * angles).sum())) / turn
    start = mean - period / 2
    quarters = low + period * np.arange(4) / 4
    axes.set_xticks(start + (quarters - start) % period, [f"{angle:.3g}{unit(period)}" for angle in quarters])
    return start, start + period


def _histogram_of_differences(axes: Any, subject: Subject) -> None:
    found = subject.differences()
    rms = float(np.sqrt(np.mean(found**2))) if found.size else 0.0
    most = float(np.percentile(np.abs(found), 99.5)) if found.size else 0.0
    axes.hist(found, np.linspace(-most, most, BINS + 1) if most > 0 else 3, color=FAINT)
    axes.set_title(f"{subject.difference} ({_places(subject)}): rms {rms:.3g}{unit(subject.period)}")
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.margins(x=0)


def _places(subject: Subject) -> str:
    return "voxels" if subject.maps[0].values is None else "vertices"


def draw_iterations(all_axes: np.ndarray, record: Mapping[str, Any]) -> None:
    """Each course that the record holds over the iterations (change, noise, held-out error, beta) on axes of its own.

    all_axes: as many as `courses` counts.
    """
    for axes, course in zip(all_axes, _courses(record), strict=False):
        x, y = course.x, course.y
        axes.plot(x, y, color=DENOISED, linewidth=1.4, marker="o", markersize=3 if len(x) < 40 else 0)
        finite = np.append(y[np.isfinite(y)], course.level[0] if course.level else [])
        if finite.min() > 0 and finite.max() > 20 * finite.min():
            _to_log(axes, finite)
        elif np.ptp(finite) == 0:
            axes.set_ylim(*sorted((0, 2 * float(finite[0]) or 1.0)))
        if course.level is not None:
            axes.axhline(course.level[0], color=FAINT, linewidth=1, linestyle="--")
            axes.annotate(
                course.level[1], (1, course.level[0]), (-2, -2), ("axes fraction", "data"), "offset points",
                ha="right", va="top", color=FAINT, fontsize="small",
            )  # fmt: skip
        if course.chosen is not None:
            axes.axvline(course.chosen, color=TRUTH, linewidth=1, linestyle="--")
            is_right = course.chosen > (x[0] + x[-1]) / 2
            axes.annotate(
                f"chosen: {course.chosen}", (course.chosen, 0.97), (-3 if is_right else 3, 0),
                ("data", "axes fraction"), "offset points",
                ha="right" if is_right else "left", va="top", color=TRUTH, fontsize="small",
            )  # fmt: skip
        axes.set_title(course.title)
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
    """How many axes `draw_iterations` fills."""
    return len(_courses(record))


def _courses(record: Mapping[str, Any] | None) -> list[Course]:
    """Of whatever a record holds, any of whose keys may be missing; a single value is no course."""
    record = record or {}
    steps, sd = record.get("PerIteration") or {}, record.get("Noise") or {}
    found = []

    def add(title: str, values: Any, x: Any = None, first: int = 1, **more: Any) -> None:
        y = np.array([np.nan if value is None else value for value in values or []], float)
        if np.isfinite(y).sum() > 1:
            found.append(Course(title, np.arange(first, first + len(y)) if x is None else np.asarray(x), y, **more))

    add("change, rms", steps.get("change_rms"))
    before, after = ((sd.get(name) or [None])[0] for name in ("sd", "after"))
    if noise := steps.get("noise_sd"):
        # Carried to the surface and averaged over depth, values are less noisy from the start than the data are.
        of = unit((record.get("Parameters") or {}).get("period"))
        level = None if before is None else (before, f"data: {before:.3g}{of}")
        x = [one["iteration"] for one in noise]
        add("noise on the surface, sd", [(one.get("sd") or [None])[0] for one in noise], x, level=level)
    elif record.get("Iterations"):
        add("noise, sd", [before, after], [0, record["Iterations"]])
    choice = record.get("Choice") or {}
    add("held-out error, rms", choice.get("errors"), first=0, chosen=choice.get("iterations"))
    add("beta (mm per unit)", steps.get("beta"))
    if len(set(steps.get("beta") or [])) > 1:
        add("dt / beta", steps.get("dt_over_beta"))
    return found
