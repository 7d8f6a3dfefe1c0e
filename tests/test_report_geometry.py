"""What a surface is taken for, its sides, its coarser and inflated copies, and lines on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from beltrami_cli import phantoms
from beltrami_cli.formats import read_surface
from beltrami_cli.grid import Grid
from beltrami_cli.report import geometry
from beltrami_cli.report.geometry import THREE_QUARTER, area_vectors, best_view, camera, vertex_normals, views
from beltrami_cli.surface import Mesh, edge_counts


def sphere(count: int = 60, radius: float = 50.0, ripple: float = 0.0, waves: int = 10) -> Mesh:
    """A closed surface around the origin, facing outwards; with ripples, of that height in mm, folded like a cortex."""
    polar, turn = np.linspace(0, np.pi, count + 1)[1:-1], np.linspace(0, 2 * np.pi, 2 * count, endpoint=False)
    p, t = np.meshgrid(polar, turn, indexing="ij")
    r = radius + ripple * np.sin(waves * p) ** 2 * np.cos(waves * t)
    rings = np.stack([r * np.sin(p) * np.cos(t), r * np.sin(p) * np.sin(t), r * np.cos(p)], -1).reshape(-1, 3)
    k = np.arange(2 * count)
    after = (k + 1) % (2 * count)
    cells = [np.stack([a, b, c], 1) for row in range(count - 2) for a, b, c in _strip(row * 2 * count, k, after, count)]
    north, south = len(rings), len(rings) + 1
    last = (count - 2) * 2 * count
    cells += [np.stack([0 * k + north, k, after], 1), np.stack([0 * k + south, last + after, last + k], 1)]
    return Mesh(np.concatenate([rings, [[0, 0, radius], [0, 0, -radius]]]), np.concatenate(cells))


def _strip(start: int, k: np.ndarray, after: np.ndarray, count: int) -> list[tuple[np.ndarray, ...]]:
    below = start + 2 * count
    return [(start + k, below + k, start + after), (start + after, below + k, below + after)]


def patch(waves: float = 0.0, n: int = 60, size: float = 60.0) -> Mesh:
    """A sheet that faces up, with folds of 8 mm to either side; many more vertices than it needs where it is flat."""
    at = np.linspace(0, size, n)
    x, y = np.meshgrid(at, at, indexing="ij")
    z = 8 * np.sin(2 * np.pi * waves * x / size) * np.cos(2 * np.pi * waves * y / size)
    i, j = np.meshgrid(np.arange(n - 1), np.arange(n - 1), indexing="ij")
    a = (i * n + j).ravel()
    cells = np.concatenate([np.stack([a, a + n, a + n + 1], 1), np.stack([a, a + n + 1, a + 1], 1)])
    return Mesh(np.stack([x, y, z], -1).reshape(-1, 3), cells)


def area(mesh: Mesh) -> float:
    return float(np.linalg.norm(area_vectors(mesh), axis=1).sum())


# What a surface is


def test_folded_surfaces_are_cortices():
    assert geometry.is_cortex(sphere(ripple=8.0))
    assert not geometry.is_cortex(sphere())
    assert not geometry.is_cortex(patch())
    assert geometry.is_cortex(patch(3))


@pytest.mark.parametrize("kind", ["torus", "sphere", "portrait", "sulcus"])
def test_phantoms_are_no_cortices(kind):
    from skimage.measure import marching_cubes

    vertices, cells, *_ = marching_cubes(phantoms.make(kind).volumes()["levelset"].data, 0.0)
    assert not geometry.is_cortex(Mesh(vertices.astype(float), cells))


def test_the_structure_settles_what_it_is():
    for structure, side in (("CortexLeft", "left"), ("CortexRight", "right")):
        mesh = replace(sphere(20), structure=structure)
        assert geometry.is_cortex(mesh)
        assert geometry.hemisphere(mesh) == side
    assert not geometry.is_cortex(replace(patch(3), structure="CerebellumLeft"))


def test_a_curve_is_no_cortex():
    assert not geometry.is_cortex(Mesh(np.eye(3), np.array([[0, 1], [1, 2]])))


def test_a_real_cortex(shared_data):
    mesh = read_surface(shared_data / "s1_individual" / "lh.mid.crop.surf.gii")
    unnamed = replace(mesh, structure=None)
    assert geometry.is_cortex(unnamed)
    assert geometry.hemisphere(unnamed) == "left"


# From where it is seen


@pytest.mark.parametrize(("shift", "side", "out"), [(-35.0, "left", -1), (35.0, "right", 1)])
def test_the_sides_of_a_hemisphere(shift, side, out):
    mesh = moved(sphere(radius=30.0, ripple=8.0), [shift, 0, 0])
    assert geometry.hemisphere(mesh) == side
    found = {view.name: view.camera for view in views(mesh)}
    assert list(found) == ["lateral", "medial", "dorsal", "posterior"]
    assert np.allclose(found["lateral"], [[0, out, 0], [0, 0, 1], [out, 0, 0]])  # of the left, anterior on the left
    assert np.allclose(found["medial"][2], [-out, 0, 0])
    assert np.allclose(found["dorsal"], np.eye(3))
    assert np.allclose(found["posterior"], [[1, 0, 0], [0, 0, 1], [0, -1, 0]])  # left is left


def moved(mesh: Mesh, by: list[float]) -> Mesh:
    return replace(mesh, vertices_ras_mm=mesh.vertices_ras_mm + by)


@pytest.mark.parametrize(
    "mesh",
    [
        moved(sphere(radius=30.0, ripple=8.0), [45.0, 45, 45]),  # counted from a corner of the volume
        moved(sphere(radius=30.0, ripple=8.0), [-45.0, -45, 45]),  # the same in LPS
        moved(sphere(radius=30.0, ripple=8.0), [120.0, 0, 0]),  # in no head
        replace(
            moved(s := sphere(ripple=8.0), [60.0, 0, 0]),
            cells=s.cells[np.abs(s.vertices_ras_mm[s.cells, 2]).max(1) < 6],
        ),
    ],
    ids=["corner", "corner in LPS", "far out", "slab"],
)
def test_positions_that_tell_no_hemisphere(mesh):
    mesh = replace(mesh, structure="Cortex")
    assert geometry.hemisphere(mesh) is None
    assert [view.name for view in views(mesh)] == ["right", "front", "above", "three-quarter"]
    assert geometry.hemisphere(replace(mesh, structure="CortexRight")) == "right"


def test_which_side_is_the_inner_one():
    ball, sheet = sphere(20), patch()
    assert geometry.outwards(ball) > 0.99
    assert geometry.outwards(replace(ball, cells=ball.cells[:, ::-1])) < -0.99
    assert abs(geometry.outwards(sheet)) < 0.01
    assert geometry.is_open(sheet) and not geometry.is_open(ball)


def test_both_hemispheres_are_seen_from_the_left_and_the_right():
    found = {view.name: view.camera[2].tolist() for view in views(sphere(ripple=8.0))}
    assert list(found) == ["left", "right", "dorsal", "posterior"]
    assert found["left"] == [-1, 0, 0] and found["right"] == [1, 0, 0]


def test_the_sides_of_a_solid():
    found = {view.name: view.camera[2] for view in views(sphere(20))}
    assert list(found) == ["right", "front", "above", "three-quarter"]
    assert np.allclose(found["three-quarter"], THREE_QUARTER / np.linalg.norm(THREE_QUARTER))


def test_camera():
    assert np.allclose(camera(np.array([0.0, 0.0, 2.0])), np.eye(3))  # from above: left is left and anterior is up
    for towards in (*np.eye(3), *-np.eye(3), np.array([0.3, -0.5, 0.2])):
        frame = camera(towards)
        assert np.allclose(frame @ frame.T, np.eye(3))
        assert np.linalg.det(frame) == pytest.approx(1.0)
        assert np.allclose(frame[2], towards / np.linalg.norm(towards))


def test_the_best_view_faces_the_data():
    mesh = sphere(20)
    for axis, sign in ((0, 1), (1, -1), (2, 1)):
        known = sign * mesh.vertices_ras_mm[:, axis] > 30
        assert np.allclose(best_view(mesh, known).camera[2], sign * np.eye(3)[axis], atol=0.05)
    for closed in (np.ones(len(mesh.vertices_ras_mm), bool), np.zeros(len(mesh.vertices_ras_mm), bool)):
        assert best_view(mesh, closed).name == "three-quarter"


# Other forms


def test_a_simplified_surface_shows_its_own_vertices():
    mesh = sphere(60)
    coarse, source = geometry.simplified(mesh, 2000)
    assert 1500 < len(coarse.cells) <= 2001
    assert len(source) == len(coarse.vertices_ras_mm) and len(np.unique(source)) == len(source)
    apart = np.linalg.norm(mesh.vertices_ras_mm[source] - coarse.vertices_ras_mm, axis=1)
    assert apart.max() < 5 and np.median(apart) < 2  # mm; edges of the coarse one are 6 mm
    assert area(coarse) == pytest.approx(area(mesh), rel=0.01)


def test_no_vertex_is_taken_from_the_other_bank():
    # Two sheets 0.1 mm apart, of 1 mm triangles: the nearest vertex is as a rule one of the other.
    one = patch(n=61)
    count = len(one.vertices_ras_mm)
    two = one.vertices_ras_mm + np.array([0.02, 0.01, 0.1])
    mesh = Mesh(np.concatenate([one.vertices_ras_mm, two]), np.concatenate([one.cells, one.cells[:, ::-1] + count]))
    coarse, source = geometry.simplified(mesh, 1000)
    upper = np.isclose(coarse.vertices_ras_mm[:, 2], 0.1, atol=0.04)
    assert 100 < upper.sum() < len(upper) - 100
    assert np.array_equal(source >= count, upper)


def test_a_small_surface_only_loses_what_no_triangle_has():
    mesh = patch(n=5)
    more = Mesh(np.concatenate([[[np.nan] * 3], mesh.vertices_ras_mm]), mesh.cells + 1)
    same, source = geometry.simplified(more, 1000)
    assert np.array_equal(same.vertices_ras_mm, mesh.vertices_ras_mm)
    assert np.array_equal(same.cells, mesh.cells)
    assert source.tolist() == list(range(1, 26))


@pytest.mark.parametrize("mesh", [sphere(ripple=8.0), patch(3)], ids=["closed", "patch"])
def test_an_inflated_surface_has_no_folds_and_keeps_its_area(mesh):
    smooth = geometry.inflated(mesh)
    assert np.array_equal(smooth.cells, mesh.cells)
    assert area(smooth) == pytest.approx(area(mesh), rel=1e-6)
    assert np.allclose(smooth.vertices_ras_mm.mean(0), mesh.vertices_ras_mm.mean(0), atol=1)
    normals, around = area_vectors(smooth), vertex_normals(smooth)
    normals = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    assert (normals[:, None] * around[smooth.cells]).sum(-1).min() > 0.9  # nothing is folded over
    sulci = [np.mean(np.maximum(-geometry.curvature(one), 0)) for one in (mesh, smooth)]
    assert sulci[1] < 0.15 * sulci[0]
    if mesh.cells.size == patch().cells.size:  # it has not shrunk to nothing
        assert np.ptp(smooth.vertices_ras_mm, axis=0) == pytest.approx([87, 88, 4.3], rel=0.05)


def test_a_small_hole_leaves_no_spike():
    mesh = patch(3)
    inner = np.linalg.norm(mesh.vertices_ras_mm[:, :2] - [25, 25], axis=1) < 1.5
    pricked = replace(mesh, cells=mesh.cells[~inner[mesh.cells].any(1)])
    coarse, _ = geometry.simplified(pricked, 10**6)
    height = geometry.inflated(coarse).vertices_ras_mm[:, 2]
    assert len(coarse.cells) < len(mesh.cells)
    assert np.ptp(height) < 5  # mm, of 16


def test_curvature():
    mesh = sphere(60)
    assert np.median(geometry.curvature(mesh)) == pytest.approx(1 / 50, rel=0.02)
    folded = patch(1)
    found = geometry.curvature(folded)
    x, y, z = folded.vertices_ras_mm.T
    inside = (np.minimum(x, y) > 6) & (np.maximum(x, y) < 54)
    assert (found[inside & (z > 4)] > 0).all() and (found[inside & (z < -4)] < 0).all()
    border, counts = edge_counts(folded.cells)
    assert (found[np.unique(border[counts == 1])] == 0).all()


def test_normals():
    mesh = patch(n=3)
    assert np.allclose(area_vectors(mesh), [[0, 0, 450]] * 8)
    more = Mesh(np.concatenate([mesh.vertices_ras_mm, [[9.0, 9, 9]]]), mesh.cells)
    assert np.allclose(vertex_normals(more), [[0, 0, 1]] * 9 + [[0, 0, 0]])


# Lines


def test_the_border_of_filled_places():
    mesh = patch(n=241)  # 0.25 mm
    x, y, _ = mesh.vertices_ras_mm.T
    filled = (np.abs(x - 30) < 10.1) & (np.abs(y - 30) < 10.1)
    filled[3 * 241 + 3] = True  # a speck
    segments, cells = geometry.filled_border_and_cells(mesh, filled)
    assert np.array_equal(segments, geometry.filled_border(mesh, filled))
    assert np.allclose(np.abs(segments[..., :2] - 30).max(-1), 10.125)
    assert np.linalg.norm(np.diff(segments, axis=1)[:, 0], axis=1).sum() == pytest.approx(81, abs=0.5)
    assert all(filled[mesh.cells[cell]].any() and not filled[mesh.cells[cell]].all() for cell in cells)
    assert geometry.filled_border(mesh, np.zeros(len(x), bool)).shape == (0, 2, 3)
    assert geometry.is_filled(mesh, filled) and not geometry.is_filled(mesh, np.arange(len(x)) == 3 * 241 + 3)


def test_the_outline_in_a_slice_of_any_grid():
    mesh = sphere(60)
    affine = np.array([[0.0, 0, 2, -70], [0, 3, 0, -70], [1, 0, 0, -70], [0, 0, 0, 1]])  # axes S, A, R
    grid = Grid((140, 50, 70), affine)
    for axis, world in ((0, 2), (1, 1), (2, 0)):
        index = (20 + 70) / grid.spacing[axis]  # 20 mm from the middle
        segments, cells = geometry.outline(mesh, grid, axis, index)
        assert np.linalg.norm(segments - 70, axis=-1) == pytest.approx(np.sqrt(50**2 - 20**2), abs=0.2)
        assert (np.abs(mesh.vertices_ras_mm[mesh.cells[cells], world] - 20).min(1) < 3).all()
    assert geometry.outline(mesh, grid, 0, 1000)[0].shape == (0, 2, 2)


def test_the_outline_of_a_curve_is_the_curve():
    mesh = Mesh(np.array([[1.0, 2, 0], [3, 2, 0], [3, 5, 0]]), np.array([[0, 1], [1, 2]]))
    segments, cells = geometry.outline(mesh, Grid.from_spacing((8, 8)), 2, 0)
    assert segments.tolist() == [[[1, 2], [3, 2]], [[3, 2], [3, 5]]]
    assert cells.tolist() == [0, 1]


def test_the_sides_of_real_crops(shared_data):
    for name in ("s1_individual/lh.mid.crop", "retino_fsaverage/lh.crop", "retino_hcp7t_measured/lh.crop"):
        mesh = replace(read_surface(shared_data / f"{name}.surf.gii"), structure=None)
        assert geometry.hemisphere_by_position(mesh) == "left"
        assert views(mesh)[0].name == "lateral"
