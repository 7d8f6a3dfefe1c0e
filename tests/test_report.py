"""Pictures: what is drawn, by its colours; where the camera stands; the order of a curve."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from matplotlib import colormaps
from matplotlib.colors import to_rgb
from matplotlib.image import imread

from beltrami_cli.errors import RefusedError
from beltrami_cli.report.drawing import (
    DENOISED,
    INPUT,
    MISSING,
    THREE_QUARTER,
    TRUTH,
    _along,
    _area_vectors,
    _camera,
    _colour_range,
    _vertex_normals,
    draw_before_after,
)
from beltrami_cli.surface import Mesh

# A square in the plane z = 0, facing up; seen face on, its colours are not dimmed.
SQUARE = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
TWO = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
VIRIDIS = colormaps["viridis"]


def share(path, colour) -> float:
    """Share of the picture's coloured pixels that have this colour, within one step of 255."""
    pixels = imread(path)[..., :3].reshape(-1, 3)
    coloured = pixels[np.ptp(pixels, axis=1) > 0.1]
    where = pixels if np.ptp(colour[:3]) == 0 else coloured
    return float((np.abs(where - colour[:3]).max(1) < 1.5 / 255).mean())


def squares(*heights: float) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of parallel squares at these z."""
    vertices = np.concatenate([SQUARE + np.array([0, 0, z]) for z in heights])
    return vertices, np.concatenate([TWO + 4 * k for k in range(len(heights))])


@pytest.mark.parametrize("order", [1, -1])
def test_the_nearer_surface_hides_the_farther(tmp_path, order):
    vertices, cells = squares(0.0, 1.0)
    values = np.repeat([0.0, 1.0], 4)
    draw_before_after(tmp_path / "a.png", Mesh(vertices, cells[::order]), values, values)
    assert share(tmp_path / "a.png", VIRIDIS(1.0)) > 0.8  # the rest is the colour bar
    assert share(tmp_path / "a.png", VIRIDIS(0.0)) < 0.05


def test_both_panels_share_one_scale_and_missing_is_grey(tmp_path):
    vertices, cells = squares(0.0)
    mesh = Mesh(np.concatenate([vertices, vertices + np.array([2, 0, 0])]), np.concatenate([cells, cells + 4]))
    after = np.repeat([0.0, 1.0], 4)
    before = np.repeat([np.nan, 5.0], 4)  # over the scale, so drawn as its upper end
    before[:2] = np.inf
    draw_before_after(tmp_path / "a.png", mesh, before, after)
    assert share(tmp_path / "a.png", np.array(MISSING)) > 0.08
    assert _colour_range(np.full(8, np.nan), after) == (0.0, 1.0)
    # Two squares of value 1 or more, and one of 0 that `after` alone knows.
    assert share(tmp_path / "a.png", VIRIDIS(1.0)) > 0.5
    assert 0.2 < share(tmp_path / "a.png", VIRIDIS(0.0)) < 0.45


def test_a_surface_without_any_value_is_drawn_grey(tmp_path):
    vertices, cells = squares(0.0)
    nothing = np.full(4, np.nan)
    draw_before_after(tmp_path / "a.png", Mesh(vertices, cells), nothing, nothing)
    assert share(tmp_path / "a.png", np.array(MISSING)) > 0.5


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ([0.0, 100.0], [2.0, 4.0], (2.04, 3.96)),  # noise in the input does not flatten the result
        ([np.nan, 1.0, 9.0], [50.0, 2.0, 4.0], (2.04, 3.96)),  # nor does what was filled in
        ([1.0, 2.0], [3.0, 3.0], (1.02, 1.98)),
        ([7.0, 7.0], [7.0, 7.0], (0.0, 1.0)),
        ([np.nan], [np.nan], (0.0, 1.0)),
    ],
)
def test_colour_range(before, after, expected):
    assert _colour_range(np.array(before), np.array(after)) == pytest.approx(expected)


def test_camera():
    up = _camera(np.array([[0.0, 0.0, 2.0]]))
    assert np.allclose(up, np.eye(3))  # from above: left is left and anterior is up
    for towards in (*np.eye(3), *-np.eye(3), [0.3, -0.5, 0.2]):
        frame = _camera(np.atleast_2d(towards))
        assert np.allclose(frame @ frame.T, np.eye(3))
        assert np.linalg.det(frame) == pytest.approx(1.0)
        assert np.allclose(frame[2], towards / np.linalg.norm(towards))
    assert np.allclose(_camera(np.array([[0.0, 0, 1], [0, 0, -1]]))[2], THREE_QUARTER / np.linalg.norm(THREE_QUARTER))


def test_normals():
    vertices, cells = squares(0.0)
    area = _area_vectors(vertices, cells)
    assert np.allclose(area, [[0, 0, 0.5]] * 2)
    assert np.allclose(_vertex_normals(area, cells, 5), [[0, 0, 1]] * 4 + [[0, 0, 0]])


def test_the_order_along_curves():
    # A loop 0-1-2-3 and an open part 4-5-6, segments in any order.
    vertices = np.concatenate([SQUARE, [[5.0, 0, 0], [5, 2, 0], [5, 2, 3]]])
    cells = np.array([[5, 6], [2, 3], [0, 1], [3, 0], [4, 5], [1, 2]], np.int32)
    order, arc = _along(Mesh(vertices, cells))
    assert order.tolist() == [4, 5, 6, -1, 0, 1, 2, 3, 0]
    assert arc.tolist() == [0, 2, 5, 5, 5, 6, 7, 8, 9]


def test_curve(tmp_path):
    turn = np.linspace(0, 2 * np.pi, 60, endpoint=False)
    loop = np.stack([np.cos(turn), np.sin(turn), 0 * turn], 1)
    mesh = Mesh(loop, np.stack([np.arange(60), (np.arange(60) + 1) % 60], 1))
    clean = 10 * np.cos(3 * turn)
    draw_before_after(tmp_path / "c.png", mesh, clean + 20, clean, truth=clean - 20)
    pixels = imread(tmp_path / "c.png")[200:, :, :3]  # below the legend
    rows = [
        np.median(np.nonzero(np.abs(pixels - to_rgb(colour)).max(-1) < 0.02)[0]) for colour in (TRUTH, DENOISED, INPUT)
    ]
    assert rows[0] > rows[1] > rows[2]  # as the values do; row 0 is the top


def test_values_that_do_not_belong_to_the_mesh(tmp_path):
    vertices, cells = squares(0.0)
    with pytest.raises(ValueError, match="input: expected 4 values"):
        draw_before_after(tmp_path / "a.png", Mesh(vertices, cells), np.zeros(3), np.zeros(4))


def test_missing_matplotlib_says_what_to_install(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib.figure", None)
    vertices, cells = squares(0.0)
    with pytest.raises(RefusedError, match=r"pip install 'beltrami_cli\[report\]'"):
        draw_before_after(tmp_path / "a.png", Mesh(vertices, cells), np.zeros(4), np.zeros(4))
    assert list(tmp_path.iterdir()) == []


def test_no_global_state_of_matplotlib_is_touched(tmp_path):
    script = (
        "import sys, numpy as np; from pathlib import Path; from beltrami_cli.report.drawing import draw_before_after;"
        "from beltrami_cli.surface import Mesh; assert 'matplotlib' not in sys.modules;"
        "draw_before_after(Path(sys.argv[1]), Mesh(np.eye(3), np.array([[0, 1, 2]])), np.arange(3.), np.arange(3.));"
        "assert 'matplotlib.pyplot' not in sys.modules"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", script, tmp_path / "a.png"], check=True)
