"""What all panels share: type sizes, colours of lines, units, and axes of a size in inches."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

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
    "text.parse_math": False,  # names of files may hold $
}

# Of a figure that is 8 inches wide: a web page shows it at 736 pixels, 61 % of its 150 dots per inch.
COMPACT = (
    STYLE
    | {"font.size": 11, "axes.titlesize": 13, "axes.labelsize": 11, "legend.fontsize": 11}
    | {
        "xtick.labelsize": 11,
        "ytick.labelsize": 11,
    }
)

DIRECTIONS = (("L", "R"), ("P", "A"), ("I", "S"))  # the ends of the axes of RAS


def unit(period: float | None) -> str:
    """The sign of the unit of angles; empty where unknown."""
    if period is None:
        return ""
    return "°" if period == 360 else " rad" if abs(period - 2 * np.pi) < 1e-3 else ""


LEAST = 8.0  # points, of a title
HANDLE = 0.3  # inches, of a line in a legend with the space around it


def cased(axes: Any, segments: np.ndarray, width: float = 0.7, colour: str = "black") -> None:
    """Lines in a white casing, to be seen on any colour."""
    from matplotlib.collections import LineCollection

    for each, points in (("white", width + 0.9), (colour, width)):
        axes.add_collection(
            LineCollection(list(segments), colors=each, linewidths=points, capstyle="round"), autolim=False
        )


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


def legend_above(axes: Any, handles: Sequence[Any], title: str = "") -> None:
    """A legend between the title and axes that give way to it, in as few rows as the names need."""
    size = points("legend.fontsize")
    box, figure = axes.get_position(), axes.figure
    across, up = box.width * figure.bbox.width / figure.dpi, figure.bbox.height / figure.dpi
    # matplotlib leaves out what begins with _.
    names = [fitted(re.sub("^_", " _", str(handle.get_label())), across - HANDLE, size) for handle in handles]
    widths = [_width(name, size) + HANDLE for name in names]
    columns = len(names)
    while columns > 1 and sum(max(widths[k::columns]) for k in range(columns)) > across:
        columns -= 1
    rows = -(-len(names) // columns)
    line = 1.5 * size / 72  # inches
    axes.set_position((box.x0, box.y0, box.width, box.height - rows * line / up))
    axes.legend(
        _by_rows(handles, columns), _by_rows(names, columns), loc="lower left", bbox_to_anchor=(0.0, 1.0),
        ncols=columns, frameon=False, borderpad=0, borderaxespad=0.2, labelspacing=0.3, handlelength=1.4,
        handletextpad=0.4, columnspacing=1.0,
    )  # fmt: skip
    axes.set_title(title, pad=rows * line * 72 + 6)


def _by_rows(items: Sequence[Any], columns: int) -> list[Any]:
    """In the order that a legend, which fills its columns one by one, shows row by row."""
    return [item for k in range(columns) for item in items[k::columns]]


def _width(text: str, size: float) -> float:
    """About how wide, in inches; size in points."""
    return 0.56 * size / 72 * len(text)


def fitted(text: str, width: float, size: float) -> str:
    """Text cut in its middle to about a width in inches."""
    most = max(6, int(width / _width("x", size)))
    return text if len(text) <= most else f"{text[: most // 2]}\u2026{text[-(most - most // 2 - 1) :]}"


def set_titles(all_axes: Iterable[Any], titles: Sequence[str], width: float) -> None:
    """Titles in letters of one size that fit into a width in inches; what is too long even for the least is cut."""
    most = points("axes.titlesize")
    size = min(most, *(most * width / _width(title or "x", most) for title in titles))
    size = max(size, LEAST)
    for axes, title in zip(all_axes, titles, strict=False):
        axes.set_title(fitted(title, 1.05 * width, size), fontsize=size)


def points(name: str = "font.size") -> float:
    """A type size among matplotlib's parameters, in points."""
    from matplotlib import rcParams
    from matplotlib.font_manager import FontProperties

    return float(FontProperties(size=rcParams[name]).get_size_in_points())
