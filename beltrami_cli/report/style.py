"""What all panels share: type sizes, colours of lines, units, and axes of a size in inches."""

from __future__ import annotations

from collections.abc import Sequence
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
}

DIRECTIONS = (("L", "R"), ("P", "A"), ("I", "S"))  # the ends of the axes of RAS


def unit(period: float | None) -> str:
    """The sign of the unit of angles; empty where unknown."""
    if period is None:
        return ""
    return "°" if period == 360 else " rad" if abs(period - 2 * np.pi) < 1e-3 else ""


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
