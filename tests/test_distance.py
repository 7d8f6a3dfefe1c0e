"""The signed distance to meshes: exact near them, on any grid, whatever state the mesh is in."""

import numpy as np
import pytest

from beltrami_cli.band import build_band
from beltrami_cli.distance import HALF_WIDTH, own_grid, signed_distance
from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.grid import Grid
from beltrami_cli.repair import HOLE_SHARE, areas, repaired
from beltrami_cli.surface import Mesh

GRID = Grid.from_spacing((40, 40, 40))
CENTRE = np.array([19.637, 19.2, 19.9])


def sphere(radius: float = 12.0, centre: np.ndarray = CENTRE, *, finer: int = 4) -> Mesh:
    """finer 4: 2,562 vertices, whose triangles lie up to 0.0012 of the radius within the sphere; 5: a quarter of it."""
    import trimesh

    made = trimesh.creation.icosphere(subdivisions=finer)
    return Mesh(np.array(made.vertices) * radius + centre, np.array(made.faces, np.int32))


def torus(centre: np.ndarray, around: int = 240, across: int = 110, radii: tuple[float, float] = (18, 8)) -> Mesh:
    i, j = np.indices((around, across))
    u, v = 2 * np.pi * i / around, 2 * np.pi * j / across
    ring = radii[0] + radii[1] * np.cos(v)
    points = np.stack([ring * np.cos(u), ring * np.sin(u), radii[1] * np.sin(v)], -1).reshape(-1, 3)
    a, b, c, d = (((i + p) % around * across + (j + q) % across).ravel() for p, q in ((0, 0), (1, 0), (1, 1), (0, 1)))
    return Mesh(points + centre, np.r_[np.c_[a, b, c], np.c_[a, c, d]].astype(np.int32))


def plate(x: float, half: float = 8.0, centre: np.ndarray = CENTRE) -> Mesh:
    """A square across the first axis, facing its positive end."""
    n = np.linspace(-half, half, 17)
    y, z = (g.ravel() for g in np.meshgrid(n, n, indexing="ij"))
    i, j = (g.ravel() for g in np.indices((16, 16)))
    a, b, c, d = i * 17 + j, (i + 1) * 17 + j, (i + 1) * 17 + j + 1, i * 17 + j + 1
    points = np.c_[np.full(y.size, x), y + centre[1], z + centre[2]]
    return Mesh(points, np.r_[np.c_[a, b, c], np.c_[a, c, d]].astype(np.int32))


def psi_of(mesh: Mesh, grid: Grid = GRID, half_width: float | None = None) -> np.ndarray:
    return signed_distance(repaired(mesh), grid, half_width)


def turned(mesh: Mesh) -> Mesh:
    return Mesh(mesh.vertices_ras_mm, mesh.cells[:, ::-1])


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(m.vertices_ras_mm) for m in meshes)])
    cells = [m.cells + start for m, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([m.vertices_ras_mm for m in meshes]), np.concatenate(cells).astype(np.int32))


def without(mesh: Mesh, gone: np.ndarray) -> Mesh:
    return Mesh(mesh.vertices_ras_mm, mesh.cells[~gone])


def heights(mesh: Mesh) -> np.ndarray:
    """(C,) of the triangles' middles along the last axis, from the centre."""
    return mesh.vertices_ras_mm[mesh.cells].mean(1)[:, 2] - CENTRE[2]


def centres(grid: Grid) -> np.ndarray:
    return grid.to_world(np.stack(np.indices(grid.shape), -1).reshape(-1, 3).astype(float)).reshape(*grid.shape, 3)


def to_sphere(grid: Grid = GRID, radius: float = 12.0, centre: np.ndarray = CENTRE) -> np.ndarray:
    return np.linalg.norm(centres(grid) - centre, axis=-1) - radius


def crossings(psi: np.ndarray) -> int:
    """Links between voxels of different signs."""
    negative, known = psi < 0, np.isfinite(psi)
    return sum(
        int(np.sum((np.diff(negative, axis=k)) & (known.take(range(1, n), k) & known.take(range(n - 1), k))))
        for k, n in enumerate(psi.shape)
    )


def rotation(degrees: float) -> np.ndarray:
    """About an axis that is none of the grid's."""
    from scipy.spatial.transform import Rotation

    return Rotation.from_rotvec(np.deg2rad(degrees) * np.array([1, 2, 2]) / 3).as_matrix()


GRIDS = {
    "RAS": np.diag([1.0, 1, 1]),
    "LAS": np.diag([-1.0, 1, 1]),
    "LPS": np.diag([-1.0, -1, 1]),
    "oblique": rotation(38),
    "anisotropic": np.diag([0.8, 1.3, 1]),
    "oblique, anisotropic, left-handed": rotation(-25) @ np.diag([-0.8, 1, 1.3]),
}


@pytest.mark.parametrize("axes", GRIDS.values(), ids=GRIDS)
def test_sphere_on_any_grid(axes):
    affine = np.eye(4)
    affine[:3, :3] = axes
    affine[:3, 3] = CENTRE - axes @ np.full(3, 19.6)
    grid = Grid((40, 40, 40), affine)
    psi = psi_of(sphere(finer=5), grid)
    width = HALF_WIDTH * grid.spacing.max()
    assert psi.dtype == np.float32
    assert np.abs(psi - np.clip(to_sphere(grid), -width, width)).max() <= 0.01 * grid.spacing.min()


def test_torus():
    centre = np.array([33.637, 33.2, 16.6])
    grid = Grid.from_spacing((68, 68, 34))
    x = centres(grid) - centre
    true = np.hypot(np.hypot(x[..., 0], x[..., 1]) - 18, x[..., 2]) - 8
    assert np.abs(psi_of(torus(centre), grid) - np.clip(true, -6, 6)).max() <= 0.01


def test_half_width():
    psi = psi_of(sphere(finer=5), GRID, 2.5)
    assert np.abs(psi - np.clip(to_sphere(), -2.5, 2.5)).max() <= 0.01


# Closed surfaces in a sorry state


@pytest.fixture(scope="module")
def whole() -> np.ndarray:
    return psi_of(sphere())


def some(mesh: Mesh, share: float, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).random(len(mesh.cells)) < share


def test_facing_inwards_makes_no_difference(whole):
    mesh = sphere()
    assert np.array_equal(psi_of(turned(mesh)), whole)


def test_a_piece_that_faces_inwards_makes_no_difference():
    """Alone or with what lies within it."""
    aside = np.array([9.0, 0, 0])
    one, other, within = sphere(6, CENTRE - aside), sphere(7, CENTRE + aside), sphere(3, CENTRE + aside)
    assert np.array_equal(psi_of(joined(one, turned(other))), psi_of(joined(one, other)))
    hollow = joined(other, turned(within))
    assert np.array_equal(psi_of(joined(one, turned(hollow))), psi_of(joined(one, hollow)))
    for x in (0, 3):  # overlapping, touching
        near = sphere(6, CENTRE + np.array([x, 0, 0]))
        assert np.array_equal(psi_of(joined(turned(one), near)), psi_of(joined(one, near)))


def test_the_way_that_a_surface_faces_may_be_meant(whole):
    shell = joined(sphere(), turned(sphere(6)))
    inwards = repaired(turned(shell), as_faced=True)
    assert np.array_equal(signed_distance(inwards, GRID), -psi_of(shell))
    assert np.array_equal(signed_distance(repaired(sphere(), as_faced=True), GRID), whole)


def test_flipped_triangles_make_no_difference(whole):
    mesh = sphere()
    cells = mesh.cells.copy()
    flipped = some(mesh, 0.1)
    cells[flipped] = cells[flipped, ::-1]
    assert np.abs(psi_of(Mesh(mesh.vertices_ras_mm, cells)) - whole).max() < 1e-5


def test_one_percent_of_the_triangles_missing(whole):
    mesh = sphere()
    psi = psi_of(without(mesh, some(mesh, 0.01)))
    assert np.array_equal(psi < 0, whole < 0)
    assert np.abs(psi - whole).max() <= 0.01


def test_a_hole_of_one_percent_is_closed_with_a_flat_fan(whole):
    mesh = sphere()
    high = heights(mesh) > 12 * (1 - 2 * 0.01)
    psi = psi_of(without(mesh, high))
    changed = (psi < 0) != (whole < 0)
    assert not np.isnan(psi).any()
    assert np.abs(whole[changed]).max(initial=0) <= 0.3  # mm, the height of that cap
    assert np.abs(psi - whole).max() <= 0.3


def test_a_mesh_of_loose_triangles_is_joined(whole):
    mesh = sphere()
    soup = mesh.vertices_ras_mm[mesh.cells].reshape(-1, 3)
    psi = psi_of(Mesh(soup, np.arange(len(soup), dtype=np.int32).reshape(-1, 3)))
    assert np.abs(psi - whole).max() < 1e-5


def test_what_is_no_part_of_a_surface_is_left_out(whole):
    mesh = sphere()
    vertices = np.r_[mesh.vertices_ras_mm, [[1, 2, 3], [np.nan, 4, 5], [2, 2, 2], [2.5, 2, 2], [2, 2.5, 2]]]
    last = len(mesh.vertices_ras_mm)
    extra = [mesh.cells[7], mesh.cells[8, [0, 2, 1]], [5, 5, 9], [0, 1, last + 1], [last + 2, last + 3, last + 4]]
    psi = psi_of(Mesh(vertices, np.r_[mesh.cells, extra].astype(np.int32)))
    assert np.abs(psi - whole).max() < 1e-5


def test_needles_make_no_difference(whole):
    mesh = sphere()
    a, b, c = mesh.cells[100]
    middle = len(mesh.vertices_ras_mm)
    vertices = np.r_[mesh.vertices_ras_mm, (mesh.vertices_ras_mm[[a]] + mesh.vertices_ras_mm[[b]]) / 2]
    split = [[a, middle, c], [middle, b, c], [a, b, middle]]  # the last one has no area
    cells = np.r_[np.delete(mesh.cells, 100, 0), split].astype(np.int32)
    assert np.abs(psi_of(Mesh(vertices, cells)) - whole).max() < 1e-5


def test_of_overlapping_parts_the_union_counts():
    apart = np.array([5.0, 0, 0])
    psi = psi_of(joined(*(sphere(9, CENTRE + side * apart, finer=5) for side in (-1, 1))))
    left, right = to_sphere(radius=9, centre=CENTRE - apart), to_sphere(radius=9, centre=CENTRE + apart)
    union = np.minimum(left, right)
    assert np.abs(union[(psi < 0) != (union < 0)]).max(initial=0) <= 0.01
    assert np.abs(psi - np.clip(union, -6, 6))[union > 0].max() <= 0.01
    # In the middle the nearest part of the union's surface is the seam: a circle of radius sqrt(81 - 25).
    x = centres(GRID) - CENTRE
    to_seam = np.hypot(x[..., 0], np.linalg.norm(x[..., 1:], axis=-1) - np.sqrt(56))
    lens = (left < 0) & (right < 0)
    # Triangles on the seam are kept whole: they reach up to their own size into the other part.
    assert np.abs(-psi - np.minimum(to_seam, 6))[lens].max() <= 0.4


def test_a_part_within_another_does_not_count_a_cavity_does():
    outer, inner = sphere(12, finer=5), sphere(6)
    whole = psi_of(outer)
    assert np.abs(psi_of(joined(outer, inner)) - whole).max() < 1e-5
    hollow = psi_of(joined(outer, turned(inner)))
    shell = np.maximum(to_sphere(radius=12), -to_sphere(radius=6))
    assert np.abs(hollow - np.clip(shell, -6, 6)).max() <= 0.01


# Open surfaces


def test_half_a_sphere_ends_at_its_rim(whole):
    mesh = sphere()
    psi = psi_of(without(mesh, heights(mesh) > 0))
    known = np.isfinite(psi)
    assert np.abs(psi - whole)[known].max() < 0.01
    half = repaired(without(mesh, heights(mesh) > 0))
    rim_z = half.vertices[half.border][..., 2]
    z = centres(GRID)[..., 2]
    assert not known[z > rim_z.max()].any()
    assert known[(z < rim_z.min() - 1) & (np.abs(whole) < 5.9)].all()
    band = build_band(psi, GRID, 4.0)
    assert band.surface is not None
    low = band.box[2].start
    top = band.surface.points[:, 2].max() + low
    assert rim_z.max() - 1 <= top <= rim_z.max()
    points = band.surface.points + [part.start for part in band.box]
    assert np.abs(np.linalg.norm(points - CENTRE, axis=1) - 12).max() <= 0.03  # no cap


def test_a_large_hole_stays_open_and_a_small_one_is_closed():
    mesh = sphere()
    for share, closes in ((0.9 * HOLE_SHARE, True), (1.5 * HOLE_SHARE, False), (0.05, False)):
        holed = repaired(without(mesh, heights(mesh) > 12 * (1 - 2 * share)))
        assert holed.is_closed == closes
    psi = psi_of(without(mesh, heights(mesh) > 12 * 0.9))
    d = to_sphere()
    cosine = (centres(GRID)[..., 2] - CENTRE[2]) / (d + 12)
    assert np.isnan(psi[(cosine > 0.93) & (np.abs(d) < 3)]).all()
    assert np.isfinite(psi[(cosine < 0.87) & (np.abs(d) < 5.9)]).all()


def test_a_small_hole_in_a_patch_is_closed():
    mesh = plate(CENTRE[0])
    holed = without(mesh, np.arange(len(mesh.cells)) == 136)
    assert np.array_equal(psi_of(holed), psi_of(mesh), equal_nan=True)


def test_an_open_surface_has_the_sign_of_its_triangles():
    mesh = plate(CENTRE[0])
    psi = psi_of(mesh)
    known = np.isfinite(psi)
    assert np.abs(psi - (centres(GRID)[..., 0] - CENTRE[0]))[known].max() < 1e-5
    assert np.array_equal(psi_of(turned(mesh)), -psi, equal_nan=True)


def test_sides_that_meet_across_what_was_cut_off_make_no_surface():
    """Between two plates that face the same way one's outside meets the other's inside."""
    psi = psi_of(joined(plate(CENTRE[0] - 4), plate(CENTRE[0] + 4)))
    x = centres(GRID)[..., 0] - CENTRE[0]
    one = crossings(psi_of(plate(CENTRE[0])))
    assert 0.9 * 2 * one <= crossings(psi) <= 2 * one
    assert np.isnan(psi[np.abs(x) < 0.5]).all()


def test_a_surface_across_the_whole_volume_has_two_sides_everywhere():
    psi = psi_of(plate(CENTRE[0], half=60))
    assert np.abs(psi - np.clip(centres(GRID)[..., 0] - CENTRE[0], -6, 6)).max() < 1e-5


# Where the grid is elsewhere


def test_partly_outside_of_the_grid(whole):
    part = Grid((14, 40, 40), GRID.affine)
    assert np.array_equal(psi_of(sphere(), part), whole[:14])


def test_outside_of_the_grid_says_where_both_are():
    with pytest.raises(DataError, match=r"runs between no two voxels") as caught:
        psi_of(sphere(centre=CENTRE + np.array([500, 0, 0])))
    assert "found it within 507.6..531.6 x 7.2..31.2 x 7.9..31.9 mm" in str(caught.value)
    assert "the voxels within 0..39 x 0..39 x 0..39 mm (RAS)" in str(caught.value)


def test_too_small_for_the_voxels():
    said = r"found voxels of 1 x 1 x 1 mm around a surface of 0.1 x 0.1 x 0.1 mm; .*--spacing"
    with pytest.raises(DataError, match=said):
        psi_of(sphere(0.05, np.array([19.5, 19.5, 19.5])))


@pytest.mark.parametrize(
    ("vertices", "cells", "said"),
    [
        (np.eye(3), np.zeros((0, 3), np.int32), "no triangle between three distinct"),
        (np.eye(3), np.array([[0, 1], [1, 2]]), "no triangles"),
        (np.full((3, 3), np.nan), np.array([[0, 1, 2]]), "no triangle between three distinct"),
        (np.array([[0.0, 0, 0], [1, 1, 1], [2, 2, 2]]), np.array([[0, 1, 2]]), "no triangle with an area"),
    ],
)
def test_no_surface_at_all(vertices, cells, said):
    with pytest.raises(DataError, match=said):
        psi_of(Mesh(vertices, cells))


# A grid of its own


def test_own_grid_has_the_median_edge_and_room_for_the_band():
    mesh = sphere()
    grid = own_grid(repaired(mesh))
    ends = mesh.vertices_ras_mm[mesh.cells[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)]
    edge = np.median(np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1))
    assert grid.spacing == pytest.approx(np.full(3, edge), rel=5e-3)
    assert np.array_equal(grid.affine[:3, :3], np.diag(grid.spacing))
    corners = grid.corners()
    assert corners.min(0) == pytest.approx(CENTRE - 12 - 7 * edge, abs=edge)
    assert corners.max(0) == pytest.approx(CENTRE + 12 + 7 * edge, abs=edge)
    psi = psi_of(mesh, grid)
    assert psi.max() == pytest.approx(HALF_WIDTH * grid.spacing[0])
    assert (psi[0] > 0).all()


def test_own_grid_puts_two_voxels_between_near_banks():
    near = joined(sphere(12, finer=3), turned(sphere(11, finer=3)))
    assert own_grid(repaired(near)).spacing == pytest.approx(np.full(3, 0.5), rel=0.05)


def test_own_grid_as_asked():
    grid = own_grid(repaired(sphere()), 0.7, 3.0)
    assert grid.spacing == pytest.approx(np.full(3, 0.7))
    assert grid.shape == (44, 44, 44)
    assert grid.corners().mean(0) == pytest.approx(CENTRE, abs=1e-3)


def test_own_grid_of_too_many_voxels_is_refused():
    with pytest.raises(RefusedError, match=r"voxels of 0.001 mm.*--spacing"):
        own_grid(repaired(sphere()), 0.001)


# Flows and real surfaces


def test_a_band_is_built_on_it():
    grid = own_grid(repaired(sphere()), 1.0)
    band = build_band(psi_of(sphere(), grid), grid, 4.0)
    area = areas(sphere().vertices_ras_mm, sphere().cells).sum()
    assert band.entries == pytest.approx(8 * area, rel=0.05)


REAL = {"retino_fsaverage": "lh.crop", "s1_individual": "lh.mid.crop"}


@pytest.mark.parametrize("name", REAL)
def test_real_surfaces_agree_with_given_level_sets(shared_data, name):
    """Given ones are distances to whole hemispheres: only what was cut off may be nearer than the crop."""
    import nibabel as nib

    surface = nib.load(shared_data / name / f"{REAL[name]}.surf.gii")
    points, cells = (array.data for array in surface.darrays)
    image = nib.load(shared_data / name / "psi.nii.gz")
    given, grid = image.get_fdata(), Grid(image.shape, image.affine)
    psi = psi_of(Mesh(points.astype(float), cells), grid)
    band = np.isfinite(psi) & (np.abs(given) < 4 * grid.spacing.max())
    off = band & (np.abs(psi - given) > 0.05)
    assert band.sum() > 100_000
    assert off.sum() < 0.007 * band.sum()
    assert (np.abs(psi) > np.abs(given))[off].all()
    assert np.percentile(np.abs(psi - given)[band & ~off], 99) < 0.02
    wrong = band & ~off & ((psi < 0) != (given < 0))
    assert np.abs(given[wrong]).max(initial=0) < 0.002  # on the surface itself, up to rounding
