"""Masks and labels to smooth surfaces: accuracy against formulas, sides kept, banks apart, open ends, refusals."""

import igl
import numpy as np
import pytest
from scipy.optimize import lsq_linear
from scipy.spatial import Delaunay
from twins import TWINS, voxels

from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.grid import Grid
from beltrami_cli.kernels import fairing
from beltrami_cli.kernels import mesh as kernels
from beltrami_cli.segmentation import mid_surface, smooth_surface, surface_of_labels
from beltrami_cli.surface import Mesh

OFF_GRID = ((0.3, 0.17, 0.41), (0.0, 0.5, 0.25), (0.37, -0.21, 0.08))
WITHIN = 3  # voxels from the surface


def positions(grid: Grid, centre=(0.0, 0.0, 0.0)) -> np.ndarray:
    """(3, nx, ny, nz) mm along the voxel axes from the middle of the grid, moved by `centre`."""
    middle = (np.array(grid.shape) - 1) / 2 * grid.spacing + centre
    return np.indices(grid.shape) * grid.spacing.reshape(3, 1, 1, 1) - middle.reshape(3, 1, 1, 1)


def sphere(radius: float, centre, spacing=(1.0, 1.0, 1.0)) -> tuple[np.ndarray, Grid]:
    grid = Grid.from_spacing(tuple(int(2 * radius / h) + 13 for h in spacing), spacing)
    return np.sqrt((positions(grid, centre) ** 2).sum(0)) - radius, grid


def torus(ring: float, tube: float, axis) -> tuple[np.ndarray, Grid]:
    grid = Grid.from_spacing((int(2 * (ring + tube)) + 11,) * 3)
    x = positions(grid, (0.13, 0.2, 0.3))
    z = np.tensordot(np.array(axis) / np.linalg.norm(axis), x, 1)
    return np.hypot(np.sqrt((x**2).sum(0) - z**2) - ring, z) - tube, grid


def plane(normal, size: int = 56) -> tuple[np.ndarray, Grid]:
    grid = Grid.from_spacing((size,) * 3)
    return np.tensordot(np.array(normal) / np.linalg.norm(normal), positions(grid), 1) + 0.13, grid


def distance(mesh: Mesh, ras_mm: np.ndarray) -> np.ndarray:
    return np.sqrt(igl.point_mesh_squared_distance(ras_mm, mesh.vertices_ras_mm, mesh.cells.astype(np.int64))[0])


def volume_inside(mesh: Mesh) -> float:
    """mm^3, positive where a closed mesh faces outwards."""
    a, b, c = (mesh.vertices_ras_mm[mesh.cells[:, k]] for k in range(3))
    return float((np.cross(a, b) * c).sum() / 6)


def euler_number(mesh: Mesh) -> int:
    sides = np.sort(np.concatenate([mesh.cells[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]), 1)
    return len(mesh.vertices_ras_mm) - len(np.unique(sides, axis=0)) + len(mesh.cells)


def kept_sides(mesh: Mesh, inside: np.ndarray, grid: Grid) -> float:
    """Share of voxel centres that lie on their own side of a closed surface."""
    winding = igl.fast_winding_number(
        mesh.vertices_ras_mm, mesh.cells.astype(np.int64), grid.to_world(voxels(grid)).astype(float)
    )
    return float(((winding > 0.5) == inside.ravel()).mean())


def errors(true: np.ndarray, grid: Grid, margin: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Psi's errors in voxels and the normals' in degrees, near the surface of the mask true < 0, off the faces."""
    finest = grid.spacing.min()
    mesh = smooth_surface(true < 0, grid)
    near = np.abs(true) < (WITHIN + 2) * finest
    psi = np.full(true.shape, np.nan)
    psi[near] = distance(mesh, grid.to_world(np.argwhere(near))) * np.where(true[near] < 0, -1, 1)
    found, wanted = (np.stack(np.gradient(f, *grid.spacing)) for f in (psi, true))
    counted = np.zeros(true.shape, bool)
    counted[(slice(margin, -margin or None),) * 3] = True
    counted &= (np.abs(true) < WITHIN * finest) & np.isfinite(found).all(0)
    cosine = (found * wanted).sum(0) / np.linalg.norm(found, axis=0) / np.linalg.norm(wanted, axis=0)
    return (psi - true)[counted] / finest, np.rad2deg(np.arccos(np.clip(cosine[counted], -1, 1)))


# At the centre of a tube of 4 voxels, 1 voxel from the axis, normals turn four times as fast as on its surface.
SHAPES = {
    **{f"sphere {radius} {at}": (sphere, (radius, at), (1, 2)) for radius in (8, 20) for at in OFF_GRID},
    "sphere on the grid": (sphere, (8, (0, 0, 0)), (1, 2)),
    "anisotropic": (sphere, (16, OFF_GRID[0], (0.8, 0.8, 1.28)), (1, 2)),
    "slices": (sphere, (20, OFF_GRID[0], (1.0, 1.0, 3.0)), (1, 3)),
    "torus": (torus, (18, 8, (0.2, 0.3, 1)), (1.5, 4)),
    "torus along the grid": (torus, (18, 8, (0, 0, 1)), (1.5, 6)),
    "thin torus": (torus, (12, 4, (0.2, 0.3, 1)), (3, 6)),
    "steep plane": (plane, ((1, 2, 3),), (0.1, 0.2)),
    "gentle plane": (plane, ((0, 0.3, 1),), (0.5, 1)),
    "terraces of ten voxels": (plane, ((0.1, 0.05, 1),), (0.5, 1)),
}


@pytest.mark.parametrize("name", SHAPES)
def test_accuracy_near_the_surface(name):
    shape, settings, (median, high) = SHAPES[name]
    off, angle = errors(*shape(*settings), margin=8 if shape is plane else 0)
    assert np.percentile(np.abs(off), 95) <= 0.25 and abs(off.mean()) < 0.05
    assert np.median(angle) <= median and np.percentile(angle, 95) <= high


@pytest.mark.parametrize("centre", OFF_GRID[:2])
def test_accuracy_on_a_large_sphere(centre):
    off, angle = errors(*sphere(40, centre))
    assert np.percentile(np.abs(off), 95) <= 0.06 and abs(off.mean()) < 0.015
    assert np.median(angle) <= 0.5 and np.percentile(angle, 95) <= 1.3


def test_a_flat_face_lies_half_way():
    inside = np.zeros((12, 12, 12), bool)
    inside[:, :, :5] = True
    mesh = smooth_surface(inside, Grid.from_spacing(inside.shape, (1.0, 1.0, 2.0)))
    np.testing.assert_allclose(mesh.vertices_ras_mm[:, 2], 2 * 4.5, atol=1e-9)


@pytest.mark.parametrize("name", TWINS)
def test_one_surface_for_every_storage(name):
    grid = TWINS[name]
    # The axes go one way or the other; the middle of the grid is one place of the world.
    shape, fine = (21, 25, 23), np.diag([0.25, 0.25, 0.25, 1.0])
    centre = grid.to_world(np.array([(np.array(grid.shape) - 1) / 2]))[0]
    affine = grid.affine @ fine
    affine[:3, 3] = centre - affine[:3, :3] @ ((np.array(shape) - 1) / 2)
    fine_grid = Grid(shape, affine)
    away = np.linalg.norm(fine_grid.to_world(voxels(fine_grid)) - centre - 0.03, axis=1).reshape(shape)
    mesh = smooth_surface(away < 2, fine_grid)
    radius = np.linalg.norm(mesh.vertices_ras_mm - centre - 0.03, axis=1)
    assert np.abs(radius - 2).max() < 0.08 and euler_number(mesh) == 2
    assert volume_inside(mesh) == pytest.approx(4 / 3 * np.pi * 8, rel=0.03)
    assert mesh.cells.dtype == np.int32 and mesh.values is None


def test_sheared_axes():
    grid = Grid((30, 30, 30), np.array([[1, 0.4, 0, 0], [0, 1, 0.2, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    centre = grid.to_world(np.array([[14.3, 14.6, 14.1]]))[0]
    inside = (np.linalg.norm(grid.to_world(voxels(grid)) - centre, axis=1) < 8).reshape(grid.shape)
    radius = np.linalg.norm(smooth_surface(inside, grid).vertices_ras_mm - centre, axis=1)
    assert np.abs(radius - 8).max() < 0.2


SHEET = np.array([0.2, 0.31, 1]) / np.linalg.norm([0.2, 0.31, 1])


@pytest.mark.parametrize("thickness", [1.2, 2.0])
@pytest.mark.parametrize("sulcus", [False, True])
def test_thin_blades_and_sulci(thickness, sulcus):
    grid = Grid.from_spacing((35, 35, 35))
    x = positions(grid)
    sheet = np.abs(np.tensordot(SHEET, x, 1)) < thickness / 2
    mesh = smooth_surface(sheet != sulcus, grid)
    # Two discs, open at the faces of the volume: nothing torn, nothing bridged.
    assert euler_number(mesh) == 2
    height = (mesh.vertices_ras_mm - 17) @ SHEET
    inner = np.abs(mesh.vertices_ras_mm - 17).max(1) < 14
    assert np.abs(np.abs(height[inner]) - thickness / 2).max() < 0.1
    ball = (x**2).sum(0) < 14**2
    inside = ball & (sheet != sulcus)
    assert kept_sides(smooth_surface(inside, grid), inside, grid) == 1


def test_a_slot_of_one_voxel_stays_open_by_half_of_it():
    inside = np.zeros((30, 30, 30), bool)
    inside[4:26, 4:26, 4:26] = True
    inside[15, 4:26, 8:26] = False
    grid = Grid.from_spacing(inside.shape)
    mesh = smooth_surface(inside, grid)
    x = mesh.vertices_ras_mm
    banks = x[(np.abs(x[:, 0] - 15) < 1) & (x[:, 2] > 8) & (x[:, 2] < 24.5) & (x[:, 1] > 5) & (x[:, 1] < 24), 0]
    assert kept_sides(mesh, inside, grid) == 1 and euler_number(mesh) == 2
    assert banks[banks > 15].min() - banks[banks < 15].max() >= 0.5 - 1e-9


def test_noise_is_kept_and_every_voxel_keeps_its_side():
    rng = np.random.default_rng(3)
    true, grid = sphere(8, OFF_GRID[0])
    inside = (true < 0) ^ (rng.random(true.shape) < 0.02)
    inside[[0, -1]] = inside[:, [0, -1]] = inside[:, :, [0, -1]] = False
    mesh = smooth_surface(inside, grid)
    assert kept_sides(mesh, inside, grid) == 1 and np.isfinite(mesh.vertices_ras_mm).all()
    loose = np.zeros((9, 9, 9), bool)
    loose[4, 4, 4] = True
    alone = smooth_surface(loose, Grid.from_spacing(loose.shape))
    assert len(alone.vertices_ras_mm) == 6 and volume_inside(alone) > 0


def test_open_at_the_faces_of_the_volume():
    true, grid = sphere(14, OFF_GRID[0])
    half = Grid((20, *grid.shape[1:]), grid.affine)
    mesh = smooth_surface((true < 0)[:20], half)
    radius = np.linalg.norm(mesh.vertices_ras_mm - 20 - np.array(OFF_GRID[0]), axis=1)
    assert euler_number(mesh) == 1 and mesh.vertices_ras_mm[:, 0].max() == 19
    assert np.abs(radius - 14).max() < 0.25


def test_open_at_the_border_of_what_is_known():
    true, grid = sphere(14, OFF_GRID[0])
    for normal in ((1.0, 0.0, 0.0), (0.7, 0.5, 0.2)):
        height = np.tensordot(np.array(normal) / np.linalg.norm(normal), positions(grid), 1)
        known = height < 3.3
        mesh = smooth_surface((true < 0) & known, grid, known)
        x = mesh.vertices_ras_mm - 20
        high, radius = x @ normal / np.linalg.norm(normal), np.linalg.norm(x - OFF_GRID[0], axis=1)
        assert 2 < high.max() < 3.3 and euler_number(mesh) == 1  # a cap is missing, and no wall stands there
        assert np.abs(radius - 14)[high < 1].max() < 0.25 and np.abs(radius - 14).max() < 1
    # A rim one voxel thick has unknown corners in most of its cells, and no hole.
    rim = (true >= -1.8) & (true < 1.8)
    mesh = smooth_surface(true < 0, grid, rim)
    assert euler_number(mesh) == 2 and volume_inside(mesh) == pytest.approx(4 / 3 * np.pi * 14**3, rel=0.01)


def test_a_plane_gives_a_polyline():
    grid = Grid.from_spacing((40, 44, 1), (1.0, 0.8, 1.0))
    true = np.sqrt((positions(grid, (0.2, 0.3, 0.0))[:2] ** 2).sum(0)) - 12
    mesh = smooth_surface(true < 0, grid)
    radius = np.linalg.norm(mesh.vertices_ras_mm - [19.7, 17.5, 0], axis=1)
    a, b = (mesh.vertices_ras_mm[mesh.cells[:, k]] for k in range(2))
    assert mesh.cells.shape[1] == 2 and np.abs(radius - 12).max() < 0.15
    area = float((a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]).sum() / 2)
    assert abs(area) == pytest.approx(np.pi * 144, rel=0.01) and area < 0  # increasing Psi on the left


@pytest.mark.parametrize("step", [1.0, -0.7])
def test_the_mid_surface_of_concentric_spheres(step):
    affine = np.diag([step, 0.7, 0.7, 1.0]) if step < 0 else np.eye(4)
    true = sphere(18, OFF_GRID[0])[0] + 18
    grid = Grid(true.shape, affine)
    mesh = mid_surface(true < 12, true > 18, grid)
    radius = np.linalg.norm(grid.to_index(mesh.vertices_ras_mm) - 24 - OFF_GRID[0], axis=1)
    assert np.abs(radius - 15).max() < 0.15 and volume_inside(mesh) > 0 and euler_number(mesh) == 2


def fused_sulcus(width: int) -> tuple[np.ndarray, np.ndarray, Grid]:
    """White with a tilted slot, grey to the top of it: inner, outer. The banks touch below the mouth."""
    grid = Grid.from_spacing((40, 24, 40))
    x, _, z = np.indices(grid.shape)
    slot = np.abs(x - slot_middle(z)) < width / 2
    inner = (z < 28) & (~slot | (z < 8))
    return inner, z > 28 + width / 2, grid


def slot_middle(z: np.ndarray) -> np.ndarray:
    return np.asarray(19.7 + 0.3 * (z - 20))


@pytest.mark.parametrize("width", [4, 5, 6, 8])
def test_banks_that_touch_stay_apart(width):
    inner, outer, grid = fused_sulcus(width)
    x = mid_surface(inner, outer, grid).vertices_ras_mm
    deep = x[(x[:, 2] > 13) & (x[:, 2] < 22) & (x[:, 1] > 5) & (x[:, 1] < 19)]
    offset = deep[:, 0] - slot_middle(deep[:, 2])
    assert (offset > 0).sum() > 100 and (offset < 0).sum() > 100
    assert np.abs(np.abs(offset) - width / 4).max() < 0.3
    # A dent of the white is no sulcus: its own middle does not go on from outer voxels, and nothing is left in it.
    dented = inner.copy()
    dented[4:6, 10:12, 20:28] = False
    x = mid_surface(dented, outer, grid).vertices_ras_mm
    assert not len(x[(x[:, 0] < 7) & (x[:, 2] < 26)])


def test_labels():
    true, grid = sphere(6, OFF_GRID[0])
    labels = np.select([true < -2, true < 1, true < 4], [2, 3, 1], 0).astype(np.int16)
    white = surface_of_labels(labels, grid, labels_inside=((2, 2),), between=None)
    both = surface_of_labels(labels, grid, labels_inside=((2, 3),), between=None)
    middle = surface_of_labels(labels, grid, labels_inside=None, between=(((2, 2),), ((1, 1),)))
    named = surface_of_labels(labels, grid, labels_inside=None, between=(((2, 2),), ((0, 1),)))
    mask = surface_of_labels((labels == 2) * 7, grid, labels_inside=None, between=None)
    sizes = [np.cbrt(volume_inside(m) * 3 / 4 / np.pi) for m in (white, both, middle, named, mask)]
    np.testing.assert_allclose(sizes, [4, 7, 5.5, 5.5, 4], atol=0.12)
    holes = np.where(true > 5, np.nan, labels)
    np.testing.assert_array_equal(
        surface_of_labels(holes, grid, labels_inside=((2, 2),), between=None).vertices_ras_mm, white.vertices_ras_mm
    )


def test_refusals():
    labels = np.zeros((5, 5, 5), np.int16)
    labels[2:4, 2:4, 2:4], labels[0] = 3, 41
    grid = Grid.from_spacing(labels.shape)
    with pytest.raises(RefusedError, match="has no label 2; found 0, 3, 41"):
        surface_of_labels(labels, grid, labels_inside=((2, 2), (3, 3)), between=None)
    with pytest.raises(RefusedError, match="has no label 8"):
        surface_of_labels(labels, grid, labels_inside=None, between=(((3, 3),), ((0, 0), (8, 8))))
    with pytest.raises(RefusedError, match="share 3; expected each on one side"):
        surface_of_labels(labels, grid, labels_inside=None, between=(((3, 3),), ((0, 3),)))
    with pytest.raises(RefusedError, match="holds the labels 0, 3, 41; --labels says"):
        surface_of_labels(labels, grid, labels_inside=None, between=None)
    thin = np.zeros((5, 5, 3), np.int16)
    thin[:, :, 1], thin[:2, :, 1] = 1, 2
    with pytest.raises(RefusedError, match="fill one slice across axis 3"):
        surface_of_labels(thin, grid, labels_inside=None, between=(((2, 2),), ((1, 1),)))
    with pytest.raises(DataError, match="no boundary: found 125 voxels inside and 0 outside"):
        smooth_surface(np.ones((5, 5, 5), bool), grid)
    with pytest.raises(DataError, match="no boundary"):
        smooth_surface(labels == 3, grid, (labels == 3) | (labels == 41))


def test_curvatures_of_a_sphere_and_of_a_plane():
    true, grid = sphere(9, OFF_GRID[1])
    mesh = smooth_surface(true < 0, grid)
    x = mesh.vertices_ras_mm - 9 - 6 - np.array(OFF_GRID[1])
    x *= 9 / np.linalg.norm(x, axis=1, keepdims=True)
    rings = kernels.half_edges(mesh.cells, len(x))
    none = np.zeros(len(rings[1]), bool)
    curvature, weight, counted = fairing.mean_curvatures(x, x / 9, *rings, none)
    np.testing.assert_allclose(curvature[counted], -1 / 9, rtol=2e-2)
    assert counted.mean() > 0.95
    # In a plane, however uneven its triangles, there is none, and a tilt makes none.
    rng = np.random.default_rng(1)
    flat = np.c_[rng.random((200, 2)) * 20, np.zeros(200)]
    rings = kernels.half_edges(Delaunay(flat[:, :2]).simplices.astype(np.int32), 200)
    row = np.repeat(np.arange(200), np.diff(rings[0]))
    bent, weight, counted = fairing.mean_curvatures(
        flat, np.tile([0.0, 0.0, 1.0], (200, 1)), *rings, np.zeros(len(row), bool)
    )
    tilt = 3 + flat @ [1.0, 2.0, 0.0]
    change = np.bincount(row, weight * (tilt[rings[1]] - tilt[row]), minlength=200)
    deep = (np.abs(flat[:, :2] - 10) < 7).all(1)
    assert np.abs(bent).max() == 0 and np.abs(change[deep]).max() < 0.01 and counted[deep].all()


def test_heights_are_the_bounded_least_squares():
    true, grid = sphere(3, OFF_GRID[0])
    mesh = smooth_surface(true < 0, grid)
    count = len(mesh.vertices_ras_mm)
    start, ring = kernels.half_edges(mesh.cells, count)
    rng = np.random.default_rng(0)
    weight, constant = rng.uniform(0.5, 1.5, len(ring)), rng.normal(size=count)
    low, high, middle = -rng.uniform(0, 0.2, count), rng.uniform(0, 0.2, count), np.zeros(count)
    operator = np.zeros((count, count))
    row = np.repeat(np.arange(count), np.diff(start))
    operator[row, ring] = weight
    operator -= np.diag(operator.sum(1))
    wanted = lsq_linear(np.vstack([operator, 0.1 * np.eye(count)]), np.r_[-constant, middle], (low, high)).x
    back = fairing.reverse_entries(start, ring)
    np.testing.assert_array_equal(ring[back], row)
    found = fairing.fair_heights(constant, weight, start, ring, back, low, high, middle, 0.01, 3000)
    np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_the_average_leaves_out_what_does_not_count():
    start, ring = kernels.half_edges(np.array([[0, 1, 2], [0, 2, 3]], np.int32), 4)
    counted = np.array([True, True, False, True])
    found = fairing.ring_average(np.array([1.0, 3.0, 100.0, 5.0]), counted, start, ring, 1)
    np.testing.assert_allclose(found, [3, 2, 3, 3])


def test_the_real_rim(shared_data):
    import nibabel

    image = nibabel.load(shared_data / "laynii_ding2016" / "Ding2016_occip_rim.nii.gz")
    part = (slice(40, 84), slice(20, 64), slice(10, 54))
    labels = np.asarray(image.dataobj)[part]
    grid = Grid(labels.shape, np.asarray(image.affine, float))
    mesh = surface_of_labels(labels, grid, labels_inside=None, between=(((2, 2),), ((1, 1),)))
    white, outer = (surface_of_labels(labels, grid, labels_inside=((k, k),), between=None) for k in (2, 1))
    away = np.abs(distance(white, mesh.vertices_ras_mm) - distance(outer, mesh.vertices_ras_mm))
    assert np.percentile(away, 95) < 0.03
