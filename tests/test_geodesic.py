"""Distance along the surface: right against formulas, and never across a gap."""

from __future__ import annotations

import numpy as np
import pytest
from test_band import band_of, bank_of_vertices, positions
from test_levelset import ball

from beltrami_cli import phantoms
from beltrami_cli.band import flat_band
from beltrami_cli.geodesic import distance_along, paths
from beltrami_cli.grid import Grid


def angle_from(points, pole):
    """(N,) radians at a ball's centre between points (N, 3) and the pole."""
    cosine = points @ pole / (np.linalg.norm(points, axis=1) * np.linalg.norm(pole))
    return np.arccos(np.clip(cosine, -1, 1))


@pytest.mark.parametrize(
    ("radius", "spacing"), [(4.0, (1.0, 1.0, 1.0)), (16.0, (1.0, 1.0, 1.0)), (14.0, (0.8, 0.8, 1.28))]
)
def test_paths_over_the_mesh_against_great_circles(radius, spacing):
    from scipy.sparse.csgraph import dijkstra

    _, centre, distance = ball(radius, spacing)
    band = band_of(distance, spacing)
    points = band.surface.points + np.array([part.start for part in band.box]) * spacing - centre
    along = dijkstra(paths(band.surface, np.arange(len(points))), indices=7)
    exact = radius * angle_from(points, points[7])
    far = exact > 3 * max(spacing)
    ratio = along[far] / exact[far]
    assert 0.995 < ratio.mean() < 1.01
    assert ratio.min() > 0.985 and ratio.max() < (1.03 if len(set(spacing)) == 1 else 1.06)


@pytest.mark.parametrize("pole", [(0, 0, 1.0), (1.0, 2.0, 3.0)])
def test_sphere(pole):
    """From a cap of 30 degrees: an entry stands where its vertex does, half a voxel aside."""
    radius = 16.0
    _, centre, distance = ball(radius)
    band = band_of(distance)
    angle = angle_from(positions(band) - centre, pole)
    cap = np.pi / 6
    along = distance_along(band, angle < cap)
    assert along.dtype == np.float32 and np.all(along[angle < cap] == 0)
    error = along - radius * (angle - cap)
    outside = angle > cap + 0.1
    assert abs(error[outside].mean()) < 0.25
    assert np.sqrt(np.mean(error[outside] ** 2)) < 0.4
    assert (np.abs(error[outside]) > 1).mean() < 0.01
    assert np.abs(error[outside & (np.abs(band.distance) < 1)]).max() < 1.3


def test_limit():
    _, centre, distance = ball(10.0)
    band = band_of(distance)
    known = angle_from(positions(band) - centre, (0, 1.0, 0)) < 0.5
    whole, part = distance_along(band, known), distance_along(band, known, 6.0)
    assert np.isfinite(whole).all() and whole.max() > 20
    assert np.array_equal(part, np.where(whole <= 6, whole, np.inf))


def test_all_known_and_none():
    _, _, distance = ball(6.0)
    band = band_of(distance)
    assert np.all(distance_along(band, np.ones(band.entries, bool)) == 0)
    assert np.all(np.isinf(distance_along(band, np.zeros(band.entries, bool))))


def test_circle_in_a_plane():
    radius, centre = 12.0, np.array([19.2, 18.7, 0])
    x = np.indices((40, 38, 1)) - centre[:, None, None, None]
    band = band_of(np.sqrt((x**2).sum(0)) - radius)
    angle = angle_from(positions(band) - centre, (1.0, 0, 0))
    along = distance_along(band, angle < 0.5)
    error = (along - radius * (angle - 0.5))[angle > 0.6]
    assert np.abs(error).max() < 1.5 and np.sqrt(np.mean(error**2)) < 0.5


@pytest.mark.parametrize("gap", [1.5, 3.0])
def test_no_way_across_a_gap(gap):
    """Two banks that never meet, one of them known: the other is out of reach."""
    phantom = phantoms.sulcus(32, gap=gap)
    band = band_of(phantom.levelset)
    known_bank = bank_of_vertices(band, phantom)[band.vertex]
    along = distance_along(band, known_bank)
    assert np.all(along[known_bank] == 0)
    assert np.all(np.isinf(along[~known_bank]))


def test_around_the_fundus():
    """A slot 2 voxels wide with a round bottom: from bank to bank it is all the way down and up, not 2 voxels."""
    _, y, z = np.indices((20, 32, 40)) - np.array([0, 16.2, 16.7])[:, None, None, None]
    band = band_of(np.hypot(np.minimum(z, 0), y) - 1.0, half_width=3.0)
    at = positions(band)
    side, height = (at - band.distance[:, None] * band.normal.T - [0, 16.2, 16.7])[:, 1:].T
    inner = (at[:, 0] > 4) & (at[:, 0] < 15)
    along = distance_along(band, (side < 0) & (height > 5))
    for high in (5, 10, 15):
        there = inner & (side > 0) & (np.abs(height - high) < 1)
        assert there.sum() > 50
        assert abs(along[there].mean() - (5 + np.pi + high)) < 0.8


def test_flat():
    band = flat_band(Grid.from_spacing((20, 30), (0.5, 2.0)))
    known = np.zeros((20, 30), bool)
    known[3, 4] = True
    i, j = np.indices((20, 30))
    exact = np.hypot((i - 3) * 0.5, (j - 4) * 2.0)
    along = distance_along(band, known.reshape(-1), 7.0).reshape(20, 30)
    assert np.allclose(along[exact <= 7], exact[exact <= 7], rtol=1e-6)
    assert np.all(np.isinf(along[exact > 7]))
