"""The zero level as a mesh: where it is, which way it faces, its normals and curvatures; in the world too."""

from __future__ import annotations

import numpy as np
import pytest

from beltrami_cli.band import build_band
from beltrami_cli.errors import DataError
from beltrami_cli.grid import Grid
from beltrami_cli.levelset import crossing_box, zero_surface
from beltrami_cli.sampling import surface_mesh

OFF_GRID = 0.137


def ball(radius, spacing=(1.0, 1.0, 1.0), room=6.0):
    """Points (3, nx, ny, nz) in mm from a ball's centre, that centre (3,) in mm, and the distance to the surface."""
    spacing = np.array(spacing)
    count = np.ceil(2 * (radius + room) / spacing).astype(int)
    centre = (count - 1) / 2 * spacing - OFF_GRID
    x = np.indices(count) * spacing[:, None, None, None] - centre[:, None, None, None]
    return x, centre, np.sqrt((x**2).sum(0)) - radius


def volume_inside(points, triangles):
    a, b, c = (points[triangles[:, k]] for k in range(3))
    return (np.cross(a, b) * c).sum() / 6


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (1.0, 1.0, 2.0), (0.5, 1.0, 0.8)])
def test_sphere(spacing):
    radius = 12.0
    _, centre, distance = ball(radius, spacing)
    surface = zero_surface(distance, np.array(spacing))
    x = surface.points - centre
    length = np.linalg.norm(x, axis=1)
    assert np.abs(length - radius).max() < 1e-3 * max(spacing) ** 4  # linear crossings are off by up to h^2 / 8R = 0.01
    assert np.abs(surface.normals - x / length[:, None]).max() < 0.02
    assert np.abs(surface.curvature - 1 / radius).max() < 0.1 / radius
    assert np.abs((surface.direction * surface.normals).sum(1)).max() < 1e-6
    assert abs(volume_inside(surface.points, surface.cells) / (4 / 3 * np.pi * radius**3) - 1) < 0.02


def test_order_of_points_and_normals():
    """Crossings are refined to the cubic along their edge, normals are central differences: orders 3 and 2 at least."""
    errors = []
    for radius in (8.0, 16.0, 32.0):
        _, centre, distance = ball(radius, room=4)
        surface = zero_surface(distance, np.ones(3))
        x = surface.points - centre
        length = np.linalg.norm(x, axis=1)
        errors.append((np.abs(length - radius).mean(), np.abs(surface.normals - x / length[:, None]).mean()))
    orders = np.polyfit(np.log([8, 16, 32]), np.log(errors), 1)[0]
    assert orders[0] < -2.5 and orders[1] < -1.7


def test_torus_curvatures():
    n, ring_radius, tube = 56, 18.0, 7.0
    x, y, z = np.indices((n, n, 28)) - np.array([n / 2, n / 2, 14.0])[:, None, None, None] + 0.63
    ring = np.hypot(x, y) - ring_radius
    surface = zero_surface(np.hypot(ring, z) - tube, np.ones(3))
    px, py, pz = (surface.points - [n / 2, n / 2, 14.0] + 0.63).T
    along = np.hypot(px, py)
    expected = np.stack([np.full(len(along), 1 / tube), (along - ring_radius) / tube / along], 1)
    assert np.abs(surface.curvature - expected).max() < 0.015
    around_tube = np.stack([-pz * px / along, -pz * py / along, along - ring_radius], 1) / tube
    aligned = np.abs((surface.direction * around_tube).sum(1))
    assert aligned.min() > 0.98


def test_plane_is_exact():
    normal = np.array([1, 2, 3]) / np.sqrt(14)
    psi = np.tensordot(normal, np.indices((16, 15, 14)), 1) - 14.3
    surface = zero_surface(psi, np.ones(3))
    assert np.abs(surface.points @ normal - 14.3).max() < 1e-5
    assert np.abs(surface.normals - normal).max() < 1e-5
    assert np.abs(surface.curvature).max() < 1e-5


def test_mask_and_ridge_keep_the_mesh_they_have():
    """Where Psi is not smooth, neither a cubic nor central differences mean anything: the plain crossing stays."""
    _, centre, distance = ball(10.0)
    surface = zero_surface(np.where(distance < 0, -1.0, 1.0), np.ones(3))
    x = surface.points - centre
    assert np.abs(np.linalg.norm(x, axis=1) - 10).max() < 0.87  # half the diagonal of a voxel
    assert (surface.normals * x / np.linalg.norm(x, axis=1)[:, None]).sum(1).min() > 0.8
    slab = 0.6 - np.abs(np.arange(13) - 6.2)  # two planes 1.2 voxels apart: one node between them
    two = zero_surface(np.broadcast_to(slab[:, None, None], (13, 8, 8)), np.ones(3))
    assert len(np.unique(np.round(two.points[:, 0], 4))) == 2
    assert np.allclose(np.abs(two.normals), [1, 0, 0], atol=1e-6)
    assert np.all(np.sign(two.normals[:, 0]) == np.where(two.points[:, 0] < 6.2, 1, -1))


@pytest.mark.parametrize("sign", [1, -1])
def test_faces_and_normals_point_to_increasing_psi(sign):
    _, centre, distance = ball(8.0)
    surface = zero_surface(sign * distance, np.ones(3))
    assert sign * volume_inside(surface.points - centre, surface.cells) > 0.97 * 4 / 3 * np.pi * 512
    assert sign * ((surface.points - centre) * surface.normals).sum(1).min() > 0


def test_zeros_on_voxels_make_no_degenerate_faces():
    x = np.indices((13, 13, 13)) - 6.0
    surface = zero_surface(np.abs(x).max(0) - 3, np.ones(3))
    corners = surface.points[surface.cells]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    assert area.min() > 0
    assert np.isfinite(surface.normals).all() and np.isfinite(surface.curvature).all()
    assert np.allclose(np.linalg.norm(surface.normals, axis=1), 1)


@pytest.mark.parametrize("garbage", [np.nan, np.inf, -np.inf])
def test_unknown_psi_off_the_surface_changes_nothing(garbage):
    _, _, distance = ball(8.0)
    whole = zero_surface(distance, np.ones(3))
    part = zero_surface(np.where(np.abs(distance) < 3, distance, garbage), np.ones(3))
    assert len(part.points) == len(whole.points)
    order, part_order = (np.lexsort(np.round(s.points, 4).T) for s in (whole, part))
    assert np.allclose(part.points[part_order], whole.points[order], atol=1e-5)
    assert np.allclose(part.normals[part_order], whole.normals[order], atol=1e-5)


def test_unknown_psi_across_the_surface_leaves_a_border():
    _, centre, distance = ball(8.0)
    upper = np.indices(distance.shape)[2] > centre[2]
    surface = zero_surface(np.where(upper, distance, np.nan), np.ones(3))
    assert surface.points[:, 2].min() > centre[2] - 1e-6
    assert 0.4 < len(surface.points) / len(zero_surface(distance, np.ones(3)).points) < 0.5


def test_circle_in_a_plane():
    x = np.indices((30, 28)) - np.array([14.2, 13.7])[:, None, None]
    distance = np.hypot(*x)[:, :, None] - 9.0
    surface = zero_surface(distance, np.ones(3))
    at = surface.points - [14.2, 13.7, 0]
    assert surface.cells.shape == (len(at), 2)
    assert np.abs(np.linalg.norm(at, axis=1) - 9).max() < 2e-4  # linear crossings are off by up to h^2 / 8R = 0.014
    assert np.abs(surface.normals - at / np.linalg.norm(at, axis=1)[:, None]).max() < 0.01
    assert np.abs(surface.curvature[:, 0] - 1 / 9).max() < 0.01
    (x0, y0), (x1, y1) = (at[surface.cells[:, k], :2].T for k in range(2))
    turned = (x0 * y1 - y0 * x1).sum() / 2  # increasing Psi on the left: clockwise in index space
    assert abs(turned / (np.pi * 81) + 1) < 0.02


def test_open_curve_faces_increasing_psi():
    psi = (np.indices((12, 10, 1))[0] - 5.3) * -1.0
    surface = zero_surface(psi, np.ones(3))
    assert np.allclose(surface.points[:, 0], 5.3, atol=1e-6)
    assert np.allclose(surface.normals, [-1, 0, 0], atol=1e-6)


@pytest.mark.parametrize("psi", [np.ones((5, 5, 5)), -np.ones((5, 5, 1)), np.full((5, 5, 5), np.nan)])
def test_no_zero_level_is_an_error(psi):
    with pytest.raises(DataError, match="no zero level"):
        crossing_box(psi, (2, 2, 2))


def test_crossing_box_holds_the_margin_and_stays_in_the_volume():
    psi = np.ones((20, 30, 40))
    psi[7, 9:12, 1] = -1
    assert crossing_box(psi, (3, 2, 5)) == (slice(3, 12), slice(6, 15), slice(0, 8))


def test_sphere_in_the_world():
    """Oblique, anisotropic and left-handed: vertices on the sphere in RAS mm, triangles facing outwards."""
    turn = np.linalg.qr(np.random.default_rng(38).normal(size=(3, 3)))[0]
    axes = turn * [0.8, 0.8, 1.28]
    if np.linalg.det(axes) > 0:
        axes[:, 0] *= -1
    affine = np.eye(4)
    shape, radius, centre = (40, 42, 26), 11.0, np.array([31.0, -17.0, 54.0])
    affine[:3, :3] = axes
    affine[:3, 3] = centre - axes @ ((np.array(shape) - 1) / 2 + 0.2)
    grid = Grid(shape, affine)
    assert grid.handedness == -1
    x = grid.to_world(np.indices(shape).reshape(3, -1).T) - centre
    psi = np.linalg.norm(x, axis=1).reshape(shape) - radius
    data = (x @ [1.0, 2.0, 2.0] / 3).reshape(shape)
    band = build_band(psi, grid, 4 * 1.28)
    found, values = surface_mesh(band, np.stack([band.gather(data), -2 * band.gather(data)]))
    at = found.vertices_ras_mm - centre
    assert np.abs(np.linalg.norm(at, axis=1) - radius).max() < 0.1
    assert abs(volume_inside(at, found.cells) / (4 / 3 * np.pi * radius**3) - 1) < 0.02
    assert np.abs(values - np.outer([1, -2], at @ [1.0, 2.0, 2.0] / 3)).max() < 1e-3
    assert found.values is None and surface_mesh(band)[1] is None


@pytest.mark.parametrize("axes", [2, 3])
def test_rounded_psi_with_zeros_of_both_signs(axes):
    x = np.indices((20,) * axes) - 9.3
    psi = np.round(np.sqrt((x**2).sum(0)) - 6).reshape((20, 20, -1) if axes == 3 else (20, 20, 1))
    assert (np.signbit(psi) & (psi == 0)).any() and (~np.signbit(psi) & (psi == 0)).any()
    surface = zero_surface(psi, np.ones(3))
    radius = np.linalg.norm(surface.points[:, :axes] - 9.3, axis=1)
    assert np.abs(radius - 6).max() < 1.0
