"""What the colours mean: a bar, or a wheel for angles, and what stands for no data."""

from __future__ import annotations

from typing import Any

import numpy as np

from beltrami_cli.report.colours import FILLED, MISSING, Scale
from beltrami_cli.report.style import FAINT, INK, points, unit

# Polar angles in degrees, 0 at the right horizontal meridian, are by far the most common angles of this period.
VISUAL_FIELD = 360
NOTE, TALLEST = 0.42, 1.15  # inches: of a line on what grey or an outline means; of a wheel, and of a bar at least
QUADRANTS = ((1, 1, "upper\nright"), (-1, 1, "upper\nleft"), (-1, -1, "lower\nleft"), (1, -1, "lower\nright"))


def height(scale: Scale | None, notes: int) -> float:
    """How many inches high `draw` is to be at least."""
    return (0.35 if scale is None else sum(_margins(scale)) + TALLEST) + NOTE * notes


def _margins(scale: Scale) -> tuple[float, float]:
    """Above and below the bar or the wheel, in inches."""
    return (0.35, 0.5) if scale.period else (0.1, 0.25)


def draw(figure: Any, scale: Scale | None, *, label: str = "", missing: bool = False, filled: bool = False) -> None:
    """What the colours mean: a bar, or a wheel for angles, neither without a scale; what grey and the outline mean."""
    width, height = figure.bbox.width / figure.dpi, figure.bbox.height / figure.dpi
    notes = [("no data", True)] * missing + [("filled in: paler,\nno data before", False)] * filled

    def axes_at(x: float, y: float, w: float, h: float) -> Any:
        return figure.add_axes((x / width, y / height, w / width, h / height))

    if scale is None:
        first = (height + NOTE * len(notes)) / 2
    else:
        above, below = _margins(scale)
        above += 0.2 if label else 0.0
        left_over = height - above - below - NOTE * len(notes)
        tall = min(TALLEST, left_over, width - 0.9) if scale.period else min(2.2, left_over)
        wide, left = (tall, (width - tall) / 2) if scale.period else (0.22, 0.35)
        first = NOTE * len(notes) + (left_over - tall) / 2
        axes = axes_at(left, first + below, wide, tall)
        (_wheel if scale.period else bar)(axes, scale)
        axes.set_title(label, pad=30 if scale.period else 8)
    for k, (text, is_missing) in enumerate(notes):
        swatch = axes_at(0.25, first - NOTE * (k + 1) + 0.12, 0.24, 0.2)
        swatch.set(xticks=[], yticks=[], facecolor=MISSING if is_missing else "white")
        swatch.spines[:].set(visible=True, color=MISSING if is_missing else FILLED, linewidth=1.2)
        swatch.annotate(
            text, (1, 0.5), (5, 0), "axes fraction", "offset points", va="center", fontsize=points("legend.fontsize")
        )


def bar(axes: Any, scale: Scale, of: str = "") -> None:
    axes.imshow(scale.table()[:, None], origin="lower", aspect="auto", extent=(0, 1, scale.low, scale.high))
    axes.set_xticks([])
    axes.yaxis.tick_right()
    axes.yaxis.set_major_formatter(lambda value, _: f"{value:.10g}{of}")  # also of large values that differ little
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
    if period == VISUAL_FIELD:
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
