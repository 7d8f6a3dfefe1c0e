"""Panels with axes of numbers: values along a curve, histograms, courses over the iterations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from beltrami_cli.report.colours import values_of
from beltrami_cli.report.style import DENOISED, FAINT, INPUT, LINES, TRUTH, grid_of_axes, unit
from beltrami_cli.report.subject import Subject
from beltrami_cli.surface import Mesh

BINS = 90


def curve(figure: Any, subject: Subject, label: str = "value") -> None:
    """Of a curve: one line for each map over the arc length, the roughest behind."""
    assert subject.mesh is not None
    (axes,) = grid_of_axes(figure, 1, 1, top=0.35)[0]
    vertices, arc = along(subject.mesh)
    colours = (INPUT, DENOISED) if subject.compares else LINES
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
    if subject.period is not None:
        low, high = subject.low, subject.low + subject.period
    else:
        everything = np.concatenate(values)
        low, high = np.percentile(everything, (0.2, 99.8)) if everything.size else (0.0, 1.0)
    bins = np.linspace(low, high if high > low else low + 1, BINS + 1)
    colours = (INPUT, DENOISED) if subject.compares else LINES
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
    if subject.compares:
        _histogram_of_differences(all_axes[1], subject)


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
