"""A page that shows a subject in any browser: one file that opens offline.

Markup, behaviour and looks are in page.html, page.js and page.css; what they show is put together here.
"""

from __future__ import annotations

import base64
import io
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli.formats import checks
from beltrami_cli.report import colours, geometry, graphs, key, slices, style, words
from beltrami_cli.report.colours import Scale
from beltrami_cli.report.subject import Subject
from beltrami_cli.surface import Mesh

# A browser turns this many fluently without a graphics card; a hemisphere of 327,680 still shows every gyrus.
TRIANGLES = 120_000
# Browsers keep 16 WebGL scenes at most; 4 maps, folded and inflated, need 8.
MAPS = 4
# Each channel has its own slices and histograms, about a second and 0.5 MB.
CHANNELS = 6
# Bytes of the page that values at vertices may take, beside plotly.js (5 MB) and the pictures.
VALUE_BYTES = 5_000_000
# Outlines stand off the surface by this share of its length, or the surface would hide half of them.
STAND_OFF = 0.004
# Drawings are as wide as the text, 840 to 1,150 pixels: of so many inches, the smallest letters, of 6.7 points, are
# at least 11 pixels high. Narrower windows scroll them.
INCHES = 7.0
COURSES = 3  # side by side in that width
KEY = 1.4  # inches of it beside slices
RASTER_DPI = 200


@dataclass(frozen=True)
class Picture:
    """A drawing of the page: its address (data:), what it shows in words, and of which channel (None: of all)."""

    heading: str
    source: str
    alt: str
    channel: int | None = None


def write(path: Path, subject: Subject) -> None:
    """Write a page (HTML) that shows a subject, whatever the path's suffix.

    It needs no network. A surface turns in 3-D, each map beside the next (the first `MAPS`), with at most `TRIANGLES`
    triangles; a curve and flat data are drawn. Of many channels the first are shown, `CHANNELS` at most.

    Raises DataError where the file cannot be written.
    """
    text = page(subject)
    with checks.writing(path):
        path.write_text(text, encoding="utf-8", errors="backslashreplace")


def page(subject: Subject) -> str:
    """The page as text."""
    record = subject.record or {}
    has_scene = subject.mesh is not None and not subject.is_curve and len(subject.mesh.cells) > 0
    channels = _channels_shown(subject)
    scene, notes = _scene(subject, channels) if has_scene else (None, [])
    if channels < subject.channels:
        notes.append(f"Shown: the first {channels} of {subject.channels:,} channels.")
    if not any(colours.has_values(subject.channel(k)) for k in range(channels)):
        notes.append("No values.")
    if record.get("Iterations") == 0:
        notes.append(words.NOTHING if subject.maps[0].volume is None else words.EXTENSION_ALONE)
    return fill(
        "page.html",
        title=subject.title,
        name=subject.title or ", ".join(shown.title for shown in subject.maps if shown.title) or "Maps",
        facts=words.facts(record, subject.period),
        warnings=[str(line) for line in record.get("Warnings") or ()],
        notes=[*subject.notes, *notes],
        channels=channels,
        scene=scene,
        plotly=_plotly() if has_scene else None,
        pictures=list(_pictures(subject, channels)),
        tables=list(words.tables(record)),
        version=words.version(record),
    )


def fill(template: str, **values: Any) -> str:
    """A template of this folder with values in their places, everything escaped."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined
    from markupsafe import Markup

    folder = Path(__file__).parent
    environment = Environment(
        loader=FileSystemLoader(folder),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.globals["own"] = lambda name: Markup((folder / name).read_text(encoding="utf-8"))
    return environment.get_template(template).render(**values)


def _plotly() -> Any:
    from markupsafe import Markup
    from plotly.offline import get_plotlyjs

    return Markup(get_plotlyjs())


def _channels_shown(subject: Subject) -> int:
    vertices = 0 if subject.mesh is None else min(len(subject.mesh.vertices_ras_mm), TRIANGLES // 2)
    bytes_each = max(1, vertices * 4 * 4 // 3 * len(subject.maps[:MAPS]))
    return min(subject.channels, CHANNELS, max(1, VALUE_BYTES // bytes_each))


# The surface in 3-D


def _scene(subject: Subject, channels: int) -> tuple[dict[str, Any], list[str]]:
    """What page.js draws, JSON-ready, and what a reader has to know about it."""
    whole = subject.mesh
    assert whole is not None
    # In any case: vertices without a triangle, which may lie anywhere, are left out.
    mesh, source = geometry.simplified(whole, TRIANGLES)
    notes = []
    if len(mesh.cells) < len(whole.cells):
        notes.append(
            f"3-D: shown with {len(mesh.cells):,} of {len(whole.cells):,} triangles; "
            "values as at the nearest original vertex."
        )
    maps = subject.maps[:MAPS]
    if len(maps) < len(subject.maps):
        notes.append(f"3-D: the first {len(maps)} of {len(subject.maps)} maps.")
    filled = np.zeros(len(source), bool)
    for shown in maps:
        if shown.filled is not None:
            filled |= shown.filled[source]
    is_cortex = geometry.is_cortex(whole)
    if is_cortex and whole.structure is None:
        whole = replace(whole, structure="Cortex")  # found once
    position = geometry.hemisphere_by_position(whole) if is_cortex else None
    if position is not None:
        notes.append(f"3-D: taken for a {position} hemisphere, by its position.")
    # The inflated one first: folds hide data in their sulci.
    forms = {"inflated": geometry.inflated(mesh), "folded": mesh} if is_cortex else {"surface": mesh}
    of_channels = [subject.channel(k) for k in range(channels)]
    scales = [colours.scale_of(one) for one in of_channels]
    first = np.isfinite(_values(of_channels[0], 0))
    best = geometry.best_view(whole, first) if subject.side is None else geometry.from_side(whole, subject.side)
    scene = {
        "triangles": _packed(mesh.cells, np.uint32),
        "forms": [_form(name, form, filled) for name, form in forms.items()],
        "sulcus": _packed(geometry.curvature(mesh) < 0, np.uint8) if is_cortex else None,
        "maps": [
            {
                "title": shown.title,
                "values": [_packed(_values(one, m)[source], np.float32) for one in of_channels],
                "filled": None if shown.filled is None else _packed(shown.filled[source], np.uint8),
            }
            for m, shown in enumerate(maps)
        ],
        "scales": [
            {"low": scale.low, "high": scale.high, "cyclic": scale.period} if colours.has_values(one) else None
            for scale, one in zip(scales, of_channels, strict=True)
        ],
        "unit": style.unit(subject.period),
        "isVisualField": subject.period == key.VISUAL_FIELD,
        "colours": _packed(scales[0].table(), np.uint8),
        "greys": [colours.MISSING, colours.MISSING_SULCUS],
        "fading": colours.FADING,
        "outline": colours.FILLED,
        "views": [_view(view) for view in geometry.views(whole)],
        "best": _view(best),
    }
    return scene, notes


def _view(view: geometry.View) -> dict[str, Any]:
    return {"name": view.name, "camera": view.camera.tolist()}


def _values(subject: Subject, m: int) -> np.ndarray:
    """(V,) of map m of a subject with one channel."""
    values = subject.maps[m].values
    assert values is not None
    return values


def _form(name: str, mesh: Mesh, filled: np.ndarray) -> dict[str, Any]:
    """A surface in a box whose longest edge is 1: positions in steps of 1/65535, and outlines of filled places."""
    points = mesh.vertices_ras_mm
    low, high = points.min(0), points.max(0)
    longest = float((high - low).max()) or 1.0
    borders = geometry.filled_border(mesh, filled) if filled.any() else np.zeros((0, 2, 3))
    middle = (low + high) / 2
    return {
        "name": name,
        "positions": _packed(np.rint((points - low) / longest * 65535), np.uint16),
        "half": ((high - low) / longest / 2).tolist(),
        "borders": _packed((_lifted(borders, mesh, STAND_OFF * longest) - middle) / longest, np.float32),
    }


def _lifted(segments: np.ndarray, mesh: Mesh, height: float) -> np.ndarray:
    """Segments (S, 2, 3) moved off the surface, along the normal of the nearest vertex."""
    from scipy.spatial import cKDTree

    if not len(segments):
        return segments
    _, nearest = cKDTree(mesh.vertices_ras_mm).query(segments.reshape(-1, 3))
    return segments + height * geometry.vertex_normals(mesh)[nearest].reshape(segments.shape)


def _packed(array: np.ndarray, kind: type[np.generic]) -> str:
    """An array's bytes, little-endian, in base64: what a typed array of JavaScript takes."""
    values = np.ascontiguousarray(array, np.dtype(kind).newbyteorder("<"))
    return base64.b64encode(values.tobytes()).decode("ascii")


# Drawings


def _pictures(subject: Subject, channels: int) -> Iterator[Picture]:
    titles = ", ".join(shown.title for shown in subject.maps)
    for k in range(channels):
        one = subject.channel(k)
        if not colours.has_values(one):
            continue
        of = k if channels > 1 else None
        scale = colours.scale_of(one)
        if subject.is_curve:
            alt = f"Values along the curve over the arc length: {titles}."
            yield Picture("Along the curve", _drawn(graphs.curve, 3.0, one), alt, of)
        if one.maps[0].volume is not None:
            alt = f"Slices through the volumes with the surface's outline: {titles}."
            yield Picture("Slices", _drawn(_slices, max(2.0, slices.height(one, INCHES - KEY)), one, scale), alt, of)
        what = f"How often each value occurs: {titles}" + (f"; and {subject.difference}." if subject.compares else ".")
        yield Picture("Histograms", _drawn(graphs.histograms, 2.2, one), what, of)
    if count := graphs.courses(subject.record):
        alt = "Over the iterations: change, and where known noise, beta and held-out error."
        rows = -(-count // COURSES)
        drawn = _drawn(_courses, 2.2 * rows, subject.record, count, rows)
        yield Picture("Over the iterations", drawn, alt)


def _slices(figure: Any, subject: Subject, scale: Scale) -> None:
    """Slices, and beside them what their colours mean."""
    left, right = figure.subfigures(1, 2, width_ratios=[INCHES - KEY, KEY])
    slices.draw(left, subject, scale)
    key.draw(right, scale)


def _courses(figure: Any, record: Mapping[str, Any], count: int, rows: int) -> None:
    """So many courses over the iterations in rows."""
    axes = style.grid_of_axes(figure, rows, -(-count // rows), gap=(0.5, 0.75)).ravel()
    graphs.draw_iterations(axes[:count], record)
    for spare in axes[count:]:
        spare.set_axis_off()


def _drawn(draw: Callable[..., None], height: float, *what: Any) -> str:
    """A drawing as the address of an SVG; height in inches."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    # A fixed salt and no date: the same subject makes the same bytes.
    with rc_context({**style.STYLE, "svg.fonttype": "path", "svg.hashsalt": "beltrami"}):
        figure = Figure(figsize=(INCHES, height), facecolor="white")
        draw(figure, *what)
        file = io.BytesIO()
        figure.savefig(file, format="svg", dpi=RASTER_DPI, metadata={"Date": None})
    return "data:image/svg+xml;base64," + base64.b64encode(file.getvalue()).decode("ascii")
