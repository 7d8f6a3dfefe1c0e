"""Pictures, by their colours and their words: what hides what, what is grey, the order of a curve, sheets."""

from __future__ import annotations

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread

from beltrami_cli import report
from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.grid import Grid
from beltrami_cli.report import graphs, key, sheet, slices, style, surfaces
from beltrami_cli.report.colours import FILLED, INNER, MISSING, Scale
from beltrami_cli.report.geometry import View
from beltrami_cli.report.style import DENOISED, INPUT, TRUTH
from beltrami_cli.report.subject import Map, Subject
from beltrami_cli.surface import Mesh

# A square in the plane z = 0, facing up; seen face on, its colours are not dimmed.
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
TWO = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
ABOVE = View("above", np.eye(3))
VIRIDIS = colormaps["viridis"]

RECORD = {
    "Parameters": {"flow": "beltrami", "beta": 0.1, "phi": None, "depth": [-2.0, 2.0]},
    "Iterations": 2,
    "StopReason": "iterations",
    "Noise": {"sd": [2.0], "after": [0.5]},
    "Smoothness": {"before_mm": 1.0, "after_mm": 4.0},
    "Removed": {"rms": 1.5},
    "Choice": {"iterations": 2, "errors": [3.0, 2.0, 1.0, 1.5]},
    "PerIteration": {
        "beta": [0.1, 0.2],
        "dt_over_beta": [1.5, 0.75],
        "change_rms": [1.0, 0.01],
        "noise_sd": [{"iteration": 0, "sd": [2.0]}, {"iteration": 2, "sd": [0.5]}],
    },
    "Warnings": ["the first", "the second"],
    "Seconds": {"read": 1.0, "flow": 2.0, "report": 4.0},
}


def squares(*heights: float) -> Mesh:
    """Parallel squares at these z."""
    vertices = np.concatenate([SQUARE + np.array([0, 0, z]) for z in heights])
    return Mesh(vertices, np.concatenate([TWO + 4 * k for k in range(len(heights))]))


def loop(n: int = 60) -> Mesh:
    turn = np.linspace(0, 2 * np.pi, n, endpoint=False)
    vertices = np.stack([8 + 5 * np.cos(turn), 8 + 5 * np.sin(turn), 0 * turn], 1)
    return Mesh(vertices, np.stack([np.arange(n), (np.arange(n) + 1) % n], 1))


def box(n: int = 12) -> Mesh:
    from skimage.measure import marching_cubes

    ball = np.linalg.norm(np.stack(np.meshgrid(*[np.arange(n) - (n - 1) / 2] * 3)), axis=0) - n / 3
    vertices, cells, *_ = marching_cubes(ball, 0.0)
    return Mesh(vertices.astype(float), cells)


def bowl() -> Mesh:
    """A folded hemisphere of 45 mm left of x = 0, cut open in front."""
    from skimage.measure import marching_cubes

    at = np.stack(np.meshgrid(*[np.arange(50) - 24.5] * 3, indexing="ij")) * 2
    polar, turn = np.arccos(np.clip(at[2] / np.linalg.norm(at, axis=0), -1, 1)), np.arctan2(at[1], at[0])
    ball = np.linalg.norm(at, axis=0) - 38 - 6 * np.sin(8 * polar) ** 2 * np.cos(8 * turn)
    vertices, cells, *_ = marching_cubes(ball, 0.0)
    vertices = (vertices - 24.5) * 2
    cells = cells[vertices[cells, 1].max(1) < 20]
    return Mesh(vertices - np.array([46.0, 0, 0]), cells)


def run_on(mesh: Mesh | None, grid: Grid | None = None, **changes: object) -> Subject:
    """A run whose input is twice as rough as its output, on a mesh, a grid or both; the first fifth is filled in."""
    rng = np.random.default_rng(0)
    values = None if mesh is None else rng.normal(5, 1, len(mesh.vertices_ras_mm))
    volume = None if grid is None else rng.normal(5, 1, grid.shape)
    filled = None if values is None else np.arange(len(values)) < len(values) / 5
    before = Map("before", None if values is None else np.where(filled, np.nan, values), volume)
    after = Map("after", None if values is None else values / 2, None if volume is None else volume / 2, filled)
    return replace(
        Subject("a run", (before, after), mesh, grid, compares=True, difference="removed", record=RECORD), **changes
    )


def saved(tmp_path, figure: Figure) -> np.ndarray:
    """(rows, columns, 3) pixels from 0 to 1."""
    figure.savefig(tmp_path / "figure.png", dpi=100)
    return imread(tmp_path / "figure.png")[..., :3]


def share(pixels: np.ndarray, colour: object) -> float:
    """Share of pixels that have this colour, within two steps of 255."""
    return float((np.abs(pixels - np.array(colour)[:3]).max(-1) < 2.5 / 255).mean())


def words(subject: Subject, tmp_path, monkeypatch) -> str:
    """All that is written on the sheet of a subject."""
    from matplotlib.text import Text

    found = []
    savefig = Figure.savefig

    def noted(figure: Figure, *args: object, **options: object) -> None:
        savefig(figure, *args, **options)
        found.extend(text.get_text() for text in figure.findobj(Text) if text.get_visible())

    monkeypatch.setattr(Figure, "savefig", noted)
    sheet.draw(tmp_path / "sheet.png", subject)
    return "\n".join(text for text in found if text)


# Surfaces


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearer_surface_hides_the_farther(tmp_path, order):
    mesh = squares(0.0, 1.0)
    mesh = replace(mesh, cells=mesh.cells[::order])
    figure = Figure(figsize=(2, 2))
    colours = Scale(0, 1).rgba(np.repeat([0.0, 1.0], 4))
    surfaces.draw(figure.add_axes((0, 0, 1, 1)), mesh, colours, ABOVE)
    pixels = saved(tmp_path, figure)
    assert share(pixels, VIRIDIS(1.0)) > 0.9
    assert share(pixels, VIRIDIS(0.0)) == 0


def test_sides_turn_darker_and_a_box_shows_a_part(tmp_path):
    mesh = squares(0.0)
    slanted = View("slanted", np.array([[1.0, 0, 0], [0, 0.5, 0.75**0.5], [0, -(0.75**0.5), 0.5]]))
    for view, light in ((ABOVE, 1.0), (slanted, surfaces.AMBIENT + (1 - surfaces.AMBIENT) / 2)):
        figure = Figure(figsize=(2, 2))
        colours = np.full((4, 4), [1.0, 0, 0, 1])
        surfaces.draw(figure.add_axes((0, 0, 1, 1)), mesh, colours, view, box=np.array([[0.0, 0], [0.4, 0.4]]))
        assert share(saved(tmp_path, figure), (light, 0, 0)) > 0.9


def test_filled_places_are_outlined(tmp_path):
    n = 41
    x, y = np.meshgrid(np.arange(n), np.arange(n), indexing="ij")
    k = (x[:-1, :-1] * n + y[:-1, :-1]).ravel()
    cells = np.concatenate([np.stack([k, k + n, k + n + 1], 1), np.stack([k, k + n + 1, k + 1], 1)])
    mesh = Mesh(np.stack([x, y, 0 * x], -1).reshape(-1, 3).astype(float), cells)
    filled = ((np.abs(x - 20) < 8) & (np.abs(y - 20) < 8)).ravel()
    colours = np.full((n * n, 4), [1.0, 0, 0, 1])
    figure = Figure(figsize=(4, 4))
    axes = figure.add_axes((0, 0, 1, 1))
    surfaces.draw(axes, mesh, colours, ABOVE, filled)
    pixels = saved(tmp_path, figure)
    rows, columns = np.nonzero(np.abs(pixels - to_rgb(FILLED)).max(-1) < 0.1)
    # 15.5 of 40 mm of 400 pixels.
    assert np.ptp(rows) == pytest.approx(155, abs=8) and np.ptp(columns) == pytest.approx(155, abs=8)
    assert share(pixels[190:210, 190:210], (1, 0, 0)) == 1


def test_the_letters_of_a_view():
    axes = Figure().add_subplot()
    surfaces.directions(axes, View("lateral", np.array([[0.0, -1, 0], [0, 0, 1], [-1, 0, 0]])))
    at = {text.get_text(): text.get_position() for text in axes.texts}
    assert at["A"][0] < 0 and at["P"][0] > 1  # anterior is on the left
    assert at["S"][1] > 1 and at["I"][1] < 0


# Curves


def test_the_order_along_curves():
    # A loop 0-1-2-3 and an open part 4-5-6, segments in any order.
    vertices = np.concatenate([SQUARE, [[5.0, 0, 0], [5, 2, 0], [5, 2, 3]]])
    cells = np.array([[5, 6], [2, 3], [0, 1], [3, 0], [4, 5], [1, 2]], np.int32)
    order, arc = graphs.along(Mesh(vertices, cells))
    assert order.tolist() == [4, 5, 6, -1, 0, 1, 2, 3, 0]
    assert arc.tolist() == [0, 2, 5, 5, 5, 6, 7, 8, 9]


def test_the_roughest_line_is_at_the_back():
    mesh = loop()
    rough, smooth = np.random.default_rng(0).normal(0, 1, 60), np.cos(np.arange(60) / 9)
    figure = Figure()
    graphs.curve(
        figure, Subject("c", tuple(Map(*m) for m in (("true", smooth), ("noisy", rough), ("flat", 0 * rough))), mesh)
    )
    (axes,) = figure.axes
    lines = {line.get_label(): line for line in axes.get_lines()}
    assert lines["noisy"].get_zorder() < lines["true"].get_zorder() < lines["flat"].get_zorder()
    assert [lines[name].get_color() for name in ("true", "noisy", "flat")] == [TRUTH, INPUT, DENOISED]
    assert [text.get_text() for text in axes.get_legend().get_texts()] == ["true", "noisy", "flat"]


def test_a_curve_of_angles_is_not_joined_across_the_wrap():
    angles = (350 + np.arange(60)) % 360.0
    figure = Figure()
    one = Map("a", angles)
    graphs.curve(figure, Subject("c", (one, one), loop(), period=360.0, compares=True, difference="removed"))
    for line in figure.axes[0].get_lines():
        drawn = np.asarray(line.get_ydata())
        assert np.nanmax(np.abs(np.diff(drawn))) < 180
        assert np.isnan(drawn).sum() == 2  # at 360, and where the loop closes from 49 to 350
    assert [line.get_color() for line in figure.axes[0].get_lines()] == [INPUT, DENOISED]


# Slices


def test_slices_show_values_where_they_are(tmp_path):
    grid = Grid((10, 20, 30), np.diag([2.0, 1, 1, 1]))
    volume = np.full(grid.shape, np.nan)
    volume[5, 10:, :] = 1.0
    figure = Figure(figsize=(9, 4))
    subject = Subject("s", (Map("a", None, volume),), None, grid)
    slices.draw(figure, subject, Scale(0, 1))
    sagittal, coronal, axial = figure.axes
    assert [axes.get_title() for axes in figure.axes] == [
        "sagittal, x = 10 mm",
        "coronal, y = 10 mm",
        "axial, z = 15 mm",
    ]
    assert sagittal.get_xlim() == (9.5, 19.5) and sagittal.get_ylim() == (-0.5, 29.5)  # cut to what is known
    assert axial.get_xlim() == (9.0, 11.0)
    assert {text.get_text() for text in sagittal.texts} == {"a", "P", "A", "I", "S"}
    assert {text.get_text() for text in coronal.texts} == {"I", "S"}  # a single voxel wide
    assert share(saved(tmp_path, figure), VIRIDIS(1.0)) > 0.1


def test_slices_of_a_run_show_what_was_removed(tmp_path):
    subject = run_on(box(), Grid.from_spacing((12, 12, 12)))
    figure = Figure(figsize=(8, 8))
    slices.draw(figure, subject)
    names = [text.get_text() for axes in figure.axes for text in axes.texts]
    assert [name for name in names if len(name) > 1] == ["before", "after", "removed"]
    assert len(figure.axes[0].collections) == 2  # the outline and its casing
    assert slices.height(subject, 8.0) > slices.height(replace(subject, compares=False), 8.0)


def test_slices_cut_where_the_data_are():
    mesh = box(30)
    grid = Grid.from_spacing((30, 30, 30))
    values = np.where(mesh.vertices_ras_mm[:, 0] > 20, 1.0, np.nan)
    cuts = slices.cuts_of(Subject("s", (Map("a", values, np.ones(grid.shape)),), mesh, grid))
    assert cuts.index[0] > 20 and abs(cuts.index[1] - 14.5) < 2
    assert (cuts.box[0] <= 2).all() and (cuts.box[1] >= 27).all()


def test_slices_at_the_ends_of_a_volume_are_left_out():
    mesh = box(30)
    grid = Grid.from_spacing((30, 30, 30))
    x = mesh.vertices_ras_mm[:, 0]
    thick = replace(mesh, vertices_ras_mm=(mesh.vertices_ras_mm - 14.5) * 1.4 + 14.5)  # from 0.5 to 28.5
    many = slices.cuts_of(Subject("s", (Map("a", np.where(x > 22.5, 1.0, np.nan)),), thick, grid)).index
    assert 24 <= many[0] < 27
    moved = replace(thick, vertices_ras_mm=thick.vertices_ras_mm + np.array([20.0, 0, 0]))
    only = slices.cuts_of(Subject("s", (Map("a", np.where(x < 8, 1.0, np.nan)),), moved, grid)).index
    assert only[0] < 27


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_slices_of_a_thin_slab_keep_their_letters_apart(axis):
    shape = [60, 60, 60]
    shape[axis] = 2
    volume = np.random.default_rng(0).normal(size=shape)
    subject = Subject("s", (Map("a", None, volume), Map("b", None, volume)), None, Grid.from_spacing(tuple(shape)))
    subject = replace(subject, compares=True)
    figure = Figure(figsize=(10, slices.height(subject, 10)))
    slices.draw(figure, subject)
    figure.draw_without_rendering()
    texts = [text for axes in figure.axes for text in (axes.title, *axes.texts) if text.get_text()]
    boxes = [text.get_window_extent().padded(-1) for text in texts]
    for k, one in enumerate(boxes):
        assert not any(one.overlaps(other) for other in boxes[:k]), texts[k].get_text()
    assert not {text.get_text() for axes in figure.axes[:3] for text in axes.texts} & set(("LR", "PA", "IS")[axis])
    assert figure.axes[-1].get_window_extent().height > 50  # the bar of the difference


def test_without_a_volume_the_outline_has_the_colours(tmp_path):
    mesh = box(30)
    subject = Subject("s", (Map("a", np.ones(len(mesh.vertices_ras_mm))),), mesh)
    figure = Figure(figsize=(9, 4))
    slices.draw(figure, subject, Scale(0, 1))
    assert share(saved(tmp_path, figure), VIRIDIS(1.0)) > 0.002
    assert share(saved(tmp_path, figure), MISSING) < 0.001


# Histograms, courses, the key


def test_histograms_count_what_both_maps_have():
    figure = Figure(figsize=(6, 2))
    before, after = Map("before", np.array([1.0, 2, np.nan, 4])), Map("after", np.array([1.0, 2, 3, 1]))
    graphs.histograms(figure, Subject("s", (before, after), compares=True, difference="removed"))
    values, removed = figure.axes
    assert values.get_title() == "values (3 vertices)"
    assert removed.get_title() == "removed (vertices): rms 1.73"


@pytest.mark.parametrize(("count", "expected"), [(1, [DENOISED]), (2, [INPUT, DENOISED]), (3, style.LINES[:3])])
def test_the_colours_and_the_legend_of_histograms(count, expected):
    figure = Figure(figsize=(3, 2))
    maps = tuple(Map(f"a name of some length {k}.nii.gz", np.arange(9.0)) for k in range(count))
    graphs.histograms(figure, Subject("s", maps))
    (axes,) = figure.axes
    blocks = [patch for patch in axes.patches if patch.get_fill()]
    assert [
        to_rgb(patch.get_edgecolor() if not patch.get_fill() else patch.get_facecolor()) for patch in axes.patches
    ] == [to_rgb(colour) for colour in expected]
    assert len(blocks) == (count == 2)
    if count > 1:
        figure.draw_without_rendering()
        legend = axes.get_legend().get_window_extent()
        assert legend.y0 >= axes.get_window_extent().y1
        assert axes.title.get_window_extent().y0 >= legend.y1 - 1
        assert legend.x1 < figure.bbox.width and legend.y1 < figure.bbox.height


def test_a_lobe_of_angles_around_0_is_not_split():
    angles = np.random.default_rng(0).normal(10, 20, 2000) % 360
    figure = Figure(figsize=(3, 2))
    graphs.histograms(figure, Subject("s", (Map("a", angles),), period=360.0))
    (axes,) = figure.axes
    assert axes.get_xlim() == pytest.approx((-170, 190), abs=2)
    drawn = axes.patches[0].get_xy()
    full = drawn[drawn[:, 1] > 0, 0]
    assert full.min() > -90 and full.max() < 110
    labels = [label.get_text() for label in axes.get_xticklabels()]
    assert labels == ["0°", "90°", "180°", "270°"]
    assert axes.get_xticks() == pytest.approx([0, 90, 180, -90])


def over_iterations(figure: Figure, record: dict) -> None:
    graphs.draw_iterations(style.grid_of_axes(figure, 1, graphs.courses(record))[0], record)


def test_courses_over_the_iterations():
    figure = Figure(figsize=(10, 2))
    assert graphs.courses(RECORD) == 5
    over_iterations(figure, RECORD)
    at = {axes.get_title(): axes for axes in figure.axes}
    assert list(at) == [
        "change, rms",
        "noise on the surface, sd",
        "held-out error, rms",
        "beta (mm per unit)",
        "dt / beta",
    ]
    assert at["change, rms"].get_yscale() == "log" and at["beta (mm per unit)"].get_yscale() == "linear"
    assert at["change, rms"].get_lines()[0].get_xdata().tolist() == [1, 2]
    noise, level = at["noise on the surface, sd"].get_lines()
    assert noise.get_xdata().tolist() == [0, 2] and level.get_ydata() == [2.0, 2.0]
    assert at["noise on the surface, sd"].texts[0].get_text() == "data: 2"
    assert at["held-out error, rms"].get_lines()[0].get_xdata().tolist() == [0, 1, 2, 3]
    (chosen,) = at["held-out error, rms"].texts
    assert chosen.get_text() == "chosen: 2" and chosen.get_ha() == "right" and chosen.xyann[0] < 0


def test_the_noise_of_the_data_is_drawn_on_one_scale_with_what_is_left():
    noise = [{"iteration": k, "sd": [sd]} for k, sd in enumerate((7.0, 1.0, 0.6))]
    figure = Figure(figsize=(3, 2))
    record = {"Noise": {"sd": [39.9], "after": [0.6]}, "PerIteration": {"noise_sd": noise}}
    over_iterations(figure, record | {"Parameters": {"period": 360.0}})
    (axes,) = figure.axes
    assert axes.get_yscale() == "log" and axes.get_ylim()[1] > 39.9  # 7 to 0.6 alone would be linear
    assert axes.texts[0].get_text() == "data: 39.9°"


@pytest.mark.parametrize(
    ("record", "expected"),
    [
        (None, 0),
        ({}, 0),
        ({"PerIteration": None, "Noise": None, "Choice": None, "Iterations": 0}, 0),
        ({"Noise": {"sd": [None], "after": [None]}, "Iterations": 3}, 0),
        ({"Noise": {"sd": [2.0], "after": [1.0]}, "Iterations": 3}, 1),
        ({"PerIteration": {"beta": [0.1], "change_rms": [], "noise_sd": [{"iteration": 0, "sd": [None]}]}}, 0),
        ({"PerIteration": {"beta": [0.1, 0.1], "noise_sd": [{"iteration": 0, "sd": [7.0]}]}}, 1),
    ],
)
def test_courses_of_records_that_lack_something(record, expected):
    assert graphs.courses(record) == expected
    assert bool(graphs.courses(record)) == bool(expected)


@pytest.mark.parametrize(
    ("low", "period", "labels"),
    [
        (0.0, 360.0, ["0°", "90°", "180°", "270°", "upper\nright", "upper\nleft", "lower\nleft", "lower\nright"]),
        (-12.0, 24.0, ["0", "6", "-12", "-6"]),
        (0.0, 2 * np.pi, ["0 rad", "1.57 rad", "3.14 rad", "4.71 rad"]),
    ],
)
def test_the_wheel(tmp_path, low, period, labels):
    figure = Figure(figsize=(2, 3))
    scale = Scale(low, low + period, period=True)
    key.draw(figure, scale)
    (axes,) = figure.axes
    assert [text.get_text() for text in axes.texts] == labels
    picture = axes.get_images()[0].get_array()
    for value, place in ((0, (200, 340)), (period / 4, (340, 200)), (period / 2, (200, 60)), (-period / 4, (60, 200))):
        assert np.allclose(picture[place][:3], scale.rgba(np.array([value]))[0, :3], atol=0.03)


def test_the_key_says_what_grey_and_outlines_mean():
    figure = Figure(figsize=(2, 4))
    key.draw(figure, Scale(0, 1), label="map", missing=True, filled=True)
    bar, *swatches = figure.axes
    assert bar.get_title() == "map"
    assert [axes.texts[0].get_text() for axes in swatches] == ["no data", "filled in: paler,\nno data before"]
    assert swatches[0].get_facecolor()[:3] == MISSING


def test_the_key_without_any_value():
    figure = Figure(figsize=(2, 2))
    key.draw(figure, None, missing=True)
    assert [axes.texts[0].get_text() for axes in figure.axes] == ["no data"]


# The sheet

PLANE, SPACE = Grid.from_spacing((16, 16)), Grid.from_spacing((12, 12, 12))
KINDS = {
    "surface": lambda: run_on(box(), SPACE),
    "angles on a cortex, at vertices": lambda: run_on(replace(box(), structure="CortexLeft"), period=10.0),
    "curve": lambda: run_on(loop(), PLANE),
    "flat": lambda: run_on(None, SPACE),
    "flat plane": lambda: run_on(None, PLANE),
    "one map": lambda: replace(run_on(box(), SPACE, compares=False, record=None), maps=run_on(box(), SPACE).maps[:1]),
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_sheet_of_every_kind(kind, tmp_path):
    report.write(tmp_path / "sheet.PNG", KINDS[kind]())
    pixels = imread(tmp_path / "sheet.PNG")
    assert pixels.shape[1] == 1800
    assert 600 < pixels.shape[0] < 3200
    assert 0.05 < (pixels[..., :3].min(-1) < 0.9).mean() < 0.8


@pytest.mark.parametrize(
    "record", [None, {}, {"Noise": {"sd": [None], "after": [1.0]}, "Smoothness": {}, "Iterations": 0}]
)
def test_a_sheet_of_a_record_that_lacks_something(record, tmp_path):
    sheet.draw(tmp_path / "sheet.png", run_on(loop(), PLANE, record=record))
    assert (tmp_path / "sheet.png").stat().st_size > 10_000


def test_a_sheet_without_any_value(tmp_path):
    mesh = box()
    nothing = Map("nothing", np.full(len(mesh.vertices_ras_mm), np.nan))
    sheet.draw(tmp_path / "sheet.png", Subject("s", (nothing, nothing), mesh, compares=True, difference="removed"))
    assert share(imread(tmp_path / "sheet.png")[..., :3], MISSING) > 0.01


def test_without_any_value_there_is_nothing_to_count(tmp_path, monkeypatch):
    mesh = box()
    bare = Map("nothing", np.full(len(mesh.vertices_ras_mm), np.nan))
    text = words(Subject("s", (bare,), mesh), tmp_path, monkeypatch).split("\n")
    assert "no values" in text and "no data" in text
    assert not any(line.startswith("values") for line in text)


def test_a_run_that_changed_nothing(tmp_path, monkeypatch):
    record = RECORD | {
        "Parameters": {"beta": "auto", "stop": "auto"},
        "Iterations": 0,
        "Choice": {"beta": 0.125, "iterations": 0, "errors": [1.0, 2.0]},
        "PerIteration": {"beta": [], "change_rms": [], "noise_sd": [{"iteration": 0, "sd": [2.0]}]},
    }
    text = words(run_on(box(), record=record), tmp_path, monkeypatch)
    assert "iterations\xa00" in text and "The flow changed nothing" in text
    assert text.split("\n").count("auto") == 1 and "0.125" in text  # stop: auto
    assert "noise on the surface" not in text and "held-out error, rms" in text


@pytest.mark.parametrize("count", [0, 20])
def test_the_key_speaks_of_filled_places_where_some_are_seen(count, tmp_path, monkeypatch):
    mesh = box(30)
    first, last = run_on(mesh).maps
    filled = np.arange(len(mesh.vertices_ras_mm)) < count
    subject = replace(run_on(mesh), maps=(first, replace(last, filled=filled)))
    assert ("filled in" in words(subject, tmp_path, monkeypatch)) == (count > 0)


def test_the_inner_side_of_a_surface_that_is_cut_open_has_no_data(tmp_path):
    colours = np.full((4, 4), [1.0, 0, 0, 1])
    for view, red in ((ABOVE, True), (View("below", np.diag([-1.0, 1, -1])), False)):
        figure = Figure(figsize=(2, 2))
        surfaces.draw(figure.add_axes((0, 0, 1, 1)), squares(0.0), colours, view, plain_inside=True)
        assert share(saved(tmp_path, figure), (1, 0, 0) if red else INNER) > 0.9


def test_a_side_taken_from_the_position_is_said(tmp_path, monkeypatch):
    half = bowl()
    assert "taken for a left hemisphere, by its position" in words(run_on(half), tmp_path, monkeypatch)
    named = replace(half, structure="CortexLeft")
    text = words(run_on(named), tmp_path, monkeypatch)
    assert "lateral, inflated" in text and "by its position" not in text


def test_close_by_what_was_filled_in_is_shown_too():
    mesh = box(30)
    along = mesh.vertices_ras_mm @ [1.0, 1, 0]
    values = np.where(along > 42, 1.0, np.nan)
    one = Map("before", values)
    grown = Map("after", np.where(along > 40.5, 1.0, np.nan), None, (along > 40.5) & (along <= 42))
    narrow, wide = (sheet._seen(Subject("s", maps, mesh)).close_up() for maps in ((one, one), (one, grown)))
    assert (wide.box[0] < narrow.box[0]).any() and (wide.box[1] > narrow.box[1]).any()


def test_the_words_of_a_run(tmp_path, monkeypatch):
    text = words(run_on(replace(box(), structure="CortexLeft"), SPACE, notes=("a note",)), tmp_path, monkeypatch)
    plain = text.replace("\xa0", " ").replace("\n", " ")
    assert "noise 2 → 0.5  ·  removed (rms, voxels) 1.5  ·  smoothness (FWHM) 1 → 4 mm" in plain
    assert "iterations 2  ·  stopped by iterations" in plain and "denoised in 3.0 s" in plain
    assert "Warning: the first\nWarning: the second" in text
    for expected in (
        "a note",
        "lateral, inflated",
        "medial, inflated",
        "dorsal, inflated",
        "posterior, inflated",
        "-2:2",
    ):
        assert expected in text
    assert "phi" not in text.split("\n")  # it was not used


def test_the_first_channel_is_shown_and_that_is_said(tmp_path, monkeypatch):
    one = run_on(box())
    maps = tuple(replace(m, values=np.stack([m.values, 100 * m.values, m.values], 1)) for m in one.maps)
    text = words(replace(one, maps=maps), tmp_path, monkeypatch)
    assert "channel 1 of 3 is shown" in text
    assert "removed (vertices): rms 2.5" in text  # not of the others


def test_many_maps_are_a_figure_of_panels(tmp_path, monkeypatch):
    mesh = box()
    values = mesh.vertices_ras_mm[:, 0]
    maps = tuple(Map(f"beta {k}", values + k) for k in range(5))
    text = words(Subject("a figure", maps, mesh), tmp_path, monkeypatch)
    assert [line for line in text.split("\n") if line.startswith("beta")] == [f"beta {k}" for k in range(5)]
    assert "values" not in text and "lateral" not in text
    assert imread(tmp_path / "sheet.png").shape[1] == 1200
    sheet.draw(
        tmp_path / "flat.png",
        Subject("f", tuple(Map(str(k), None, np.ones(SPACE.shape)) for k in range(3)), None, SPACE),
    )
    sheet.draw(tmp_path / "curve.png", Subject("c", tuple(Map(str(k), np.ones(60)) for k in range(3)), loop()))


def test_a_large_surface_is_simplified_and_that_is_said(tmp_path, monkeypatch):
    monkeypatch.setattr(sheet, "TRIANGLES", 500)
    mesh = box(30)
    text = words(run_on(mesh), tmp_path, monkeypatch)
    assert f"drawn with 500 of {len(mesh.cells):,} triangles" in text


def test_small_data_are_shown_from_close_by(tmp_path, monkeypatch):
    mesh = box(30)
    values = np.where(mesh.vertices_ras_mm @ [1.0, 1, 0] > 40, 1.0, np.nan)
    text = words(Subject("s", (Map("a", values),), mesh), tmp_path, monkeypatch)
    assert "facing the data, close by" in text
    assert "close by" not in words(run_on(mesh), tmp_path, monkeypatch)


def test_a_sheet_that_cannot_be_written(tmp_path):
    with pytest.raises(DataError, match=r"sheet\.png"):
        sheet.draw(tmp_path / "none" / "sheet.png", run_on(loop(), PLANE))


def test_what_is_missing_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(report, "find_spec", lambda name: None if name == "colorcet" else name)
    with pytest.raises(RefusedError, match=r"colorcet.*pip install 'beltrami_cli\[report\]'"):
        report.write(tmp_path / "a.png", run_on(loop(), PLANE))
    assert list(tmp_path.iterdir()) == []


def test_no_global_state_of_matplotlib_is_touched(tmp_path):
    script = (
        "import sys, numpy as np; from pathlib import Path; from beltrami_cli.report import sheet;"
        "from beltrami_cli.report.subject import Map, Subject; from beltrami_cli.surface import Mesh;"
        "assert 'matplotlib' not in sys.modules; import matplotlib; was = matplotlib.rcParams.copy();"
        "one = Map('a', np.arange(3.));"
        "sheet.draw(Path(sys.argv[1]), Subject('s', (one,), Mesh(np.eye(3), np.array([[0, 1, 2]]))));"
        "assert 'matplotlib.pyplot' not in sys.modules and matplotlib.rcParams.copy() == was"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", script, tmp_path / "a.png"], check=True)


def test_shades_of_lines_stay_apart():
    assert len({to_rgb(colour) for colour in style.LINES}) == len(style.LINES) >= 6


# What slices say of space


def letters_of(affine: np.ndarray, shape: tuple[int, int, int], **changes: object) -> list[list[str]]:
    """The letters beside each slice of the first row: left, right, below, above."""
    grid = Grid(shape, affine)
    figure = Figure(figsize=(9, 3))
    volume = np.random.default_rng(0).normal(size=shape)
    slices.draw(figure, replace(Subject("s", (Map("map", None, volume),), None, grid), **changes))
    return [[text.get_text() for text in axes.texts if len(text.get_text()) == 1] for axes in figure.axes]


def test_the_letters_of_slices_and_of_planes():
    assert letters_of(np.eye(4), (20, 20, 20)) == [["P", "A", "I", "S"], ["L", "R", "I", "S"], ["L", "R", "P", "A"]]
    # A coronal plane, whose third axis runs to posterior, and a sagittal one.
    coronal, sagittal = np.eye(4)[[0, 2, 1, 3]], np.eye(4)[[2, 0, 1, 3]]
    assert letters_of(coronal, (20, 20, 1)) == [["L", "R", "I", "S"]]
    assert letters_of(sagittal, (20, 20, 1)) == [["P", "A", "I", "S"]]
    assert letters_of(np.eye(4), (20, 20, 1), has_anatomy=False) == [[]]


@pytest.mark.parametrize("rows_down", [True, False])
def test_a_picture_stands_upright(tmp_path, rows_down):
    values = np.zeros((30, 20, 1))
    values[:10] = 1.0  # the first rows of a picture
    subject = Subject("s", (Map("a", None, values),), None, Grid((30, 20, 1), np.eye(4)), rows_down=rows_down)
    figure = Figure(figsize=(4, 4))
    slices.draw(figure, subject, Scale(0.0, 1.0))
    rows, columns = np.nonzero((np.abs(saved(tmp_path, figure) - Scale(0, 1).rgba([1.0])[0, :3]) < 0.02).all(-1))
    others = np.nonzero((np.abs(saved(tmp_path, figure) - Scale(0, 1).rgba([0.0])[0, :3]) < 0.02).all(-1))
    if rows_down:
        assert rows.max() <= others[0].min() and np.ptp(columns) == pytest.approx(2 * np.ptp(rows), rel=0.1)
    else:
        assert columns.max() <= others[1].min()


def test_an_oblique_slice_says_about_where_it_is():
    turned = np.eye(4)
    turned[:2, :2] = [[0.9, -0.436], [0.436, 0.9]]
    cuts = slices.cuts_of(Subject("s", (Map("a", None, np.ones((20, 20, 20))),), None, Grid((20, 20, 20), turned)))
    assert "≈" in cuts.title(0) and "=" in cuts.title(2)


def test_names_of_files_are_no_mathematics(tmp_path):
    mesh = box()
    values = np.arange(float(len(mesh.vertices_ras_mm)))
    maps = tuple(Map(name, values) for name in ("$a^{$", "_under", "bad\udcff"))
    for count in (2, 3):
        sheet.draw(tmp_path / f"{count}.png", Subject("$x_{", maps[-count:], mesh))
        assert (tmp_path / f"{count}.png").stat().st_size > 10_000


def test_a_failure_of_drawing_is_not_told_as_a_full_disk(tmp_path, monkeypatch):
    def fail(*_: object, **__: object) -> None:
        raise ValueError("cannot draw")

    monkeypatch.setattr(Figure, "savefig", fail)
    with pytest.raises(ValueError, match="cannot draw"):
        sheet.draw(tmp_path / "s.png", run_on(box()))
    assert not (tmp_path / "s.png").exists()


def test_labels_of_the_bar_tell_large_values_apart():
    figure = Figure(figsize=(2, 4))
    key.draw(figure, Scale(15_000.0, 15_030.0))
    figure.canvas.draw()
    labels = [tick.get_text() for tick in figure.axes[0].get_yticklabels() if tick.get_text()]
    assert len(set(labels)) == len(labels) > 3


def test_colours_of_values_near_the_ends_of_floats():
    colours = Scale(-1.5e308, 1.5e308).rgba(np.array([-1.5e308, 0.0, 1.5e308, np.nan]))
    assert np.allclose(colours[[0, 2], :3], Scale(0, 1).rgba(np.array([0.0, 1.0]))[:, :3])
