"""The sheeted band: which voxels, which bank, closest points, links; and the way between volumes and entries."""

from __future__ import annotations

import numpy as np
import pytest
import reference
from test_levelset import ball

from beltrami_cli import phantoms
from beltrami_cli.band import Band, build_band, flat_band
from beltrami_cli.errors import DataError
from beltrami_cli.grid import Grid


def band_of(psi, spacing=(1.0, 1.0, 1.0), half_width=None) -> Band:
    return build_band(psi, Grid.from_spacing(psi.shape, tuple(spacing)), half_width or 4 * max(spacing))


def positions(band: Band) -> np.ndarray:
    """(E, 3) mm of each entry's voxel from the first voxel of the whole grid."""
    low = np.array([part.start for part in band.box])
    return (np.stack(np.unravel_index(band.voxel, band.box_shape), 1) + low) * band.grid.spacing


def surface_points(band: Band) -> np.ndarray:
    """(V, 3) mm of the surface's vertices from the first voxel of the whole grid."""
    return band.surface.points + np.array([part.start for part in band.box]) * band.grid.spacing


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (1.0, 1.0, 2.0), (0.6, 0.9, 0.7)])
def test_alone_a_surface_has_one_entry_per_voxel_of_the_band(spacing):
    radius, width = 14.0, 4 * max(spacing)
    _, centre, distance = ball(radius, spacing, room=width + 3)
    band = band_of(distance, spacing)
    # On anisotropic voxels two vertices of one bank, over 2 voxels apart, may here and there pass for two banks.
    assert band.entries - len(band.primary) <= (0 if len(set(spacing)) == 1 else 1.5e-3 * band.entries)
    mine = band.scatter(np.ones(band.entries, np.float32), 0.0) > 0
    # The rim is decided by the distance along the vertex's normal: right to the vertices' own accuracy.
    assert np.all(mine[np.abs(distance) < width - 0.05 * max(spacing)])
    assert not np.any(mine[np.abs(distance) > width + 0.05 * max(spacing)])
    at = positions(band) - centre
    length = np.linalg.norm(at, axis=1)
    assert np.abs(band.distance - (length - radius)).max() < 0.01 * max(spacing)
    assert np.abs(band.normal.T - at / length[:, None]).max() < 0.02
    foot = at + band.closest_offset.T * spacing
    assert np.abs(np.linalg.norm(foot, axis=1) - radius).max() < 0.01 * max(spacing)


@pytest.mark.parametrize(
    ("psi", "within"),
    [
        (lambda d: d, 0.01),
        (lambda d: (d + 12) ** 2 - 144, 0.01),
        (lambda d: 0.01 * d, 0.01),
        (lambda d: np.clip(d, -3, 3), 0.01),
        (np.tanh, 0.08),  # its slope changes within a voxel as much as a cubic can follow
    ],
)
def test_distance_does_not_depend_on_which_psi_has_the_zero_set(psi, within):
    _, centre, distance = ball(12.0)
    band = band_of(psi(distance))
    length = np.linalg.norm(positions(band) - centre, axis=1)
    assert np.abs(band.distance - (length - 12)).max() < within


def test_mask_is_right_to_half_a_voxel():
    radius = 12.0
    _, centre, distance = ball(radius)
    band = band_of(np.where(distance < 0, -1.0, 1.0))
    length = np.linalg.norm(positions(band) - centre, axis=1)
    near = np.abs(length - radius) < 2
    assert np.sqrt(np.mean((band.distance - (length - radius))[near] ** 2)) < 0.35


@pytest.mark.parametrize("shape", ["sphere", "torus", "sulcus"])
def test_primary_entry_belongs_to_the_nearest_vertex(shape):
    psi = {
        "sphere": lambda: ball(9.0)[2],
        "torus": lambda: phantoms.torus(40).levelset,
        "sulcus": lambda: phantoms.sulcus(32, gap=1.5).levelset,
    }[shape]()
    band = band_of(psi)
    voxels = np.random.default_rng(0).choice(band.primary, 3000, replace=False)
    apart = np.linalg.norm(positions(band)[voxels, None] - surface_points(band)[None], axis=2)
    own = apart[np.arange(len(voxels)), band.vertex[voxels]]
    # Growth passes vertices on from voxel to voxel; within half a voxel two of one bank are as good as one another.
    assert (own - apart.min(1) < 1e-6).mean() > 0.97
    assert (own - apart.min(1)).max() < 0.5


@pytest.mark.parametrize("gap", [1.5, 2.0, 3.0, 4.0])
def test_each_bank_of_a_sulcus_keeps_its_own_band(gap):
    """Both banks see every voxel between them and are linked to themselves only."""
    phantom = phantoms.sulcus(36, gap=gap)
    band = band_of(phantom.levelset)
    bank = bank_of_vertices(band, phantom)[band.vertex]
    for table in (band.forward, band.backward):
        assert all(np.array_equal(bank[table[a]], bank) for a in range(3))
    s = signed_height(phantom, gap)
    x = np.round(positions(band)).astype(int)
    inner = np.all((x >= 5) & (x < 31), axis=1)
    for side in (0, 1):
        reach = np.abs(np.where(side, 1, -1) * s - gap / 2) < 3
        seen = np.zeros(s.shape, bool)
        seen[tuple(x[bank == side].T)] = True
        core = np.zeros(s.shape, bool)
        core[5:31, 5:31, 5:31] = True
        assert (seen | ~reach)[core].mean() > 0.999
    # Primary entries show the bank that is nearer.
    primary = band.primary[inner[band.primary] & (np.abs(s[tuple(x[band.primary].T)]) > 0.2)]
    assert np.array_equal(bank[primary], s[tuple(x[primary].T)] > 0)


def signed_height(phantom, gap):
    """s of the phantom's Psi = gap/2 - |s|: negative beside the bank at 0, positive beside the bank at 100."""
    return np.where(phantom.clean > 50, 1, -1) * (gap / 2 - phantom.levelset)


def bank_of_vertices(band, phantom):
    """(V,) bool: whether each vertex lies on the bank at 100."""
    return phantom.clean[tuple(np.round(surface_points(band)).astype(int).T)] > 50


def test_closest_points_do_not_cross_the_gap():
    gap = 2.0
    phantom = phantoms.sulcus(36, gap=gap)
    band = band_of(phantom.levelset)
    bank = bank_of_vertices(band, phantom)[band.vertex]
    s = signed_height(phantom, gap)
    foot = positions(band) + band.closest_offset.T
    inner = np.all((foot > 5) & (foot < 30), axis=1)
    from scipy.ndimage import map_coordinates

    height = map_coordinates(s, foot[inner].T, order=1)
    assert np.abs(height - np.where(bank[inner], 1, -1) * gap / 2).max() < 0.45


@pytest.mark.parametrize("name", ["torus", "sulcus", "sphere"])
def test_links_are_mutual_and_lead_to_the_next_voxel(name):
    band = band_of(phantoms.make(name, size=32).levelset)
    assert all(ok.all() for ok in reference.opposite_links(band))
    x, own = np.round(positions(band)).astype(int), np.arange(band.entries)
    for a in range(3):
        for table, move in ((band.forward[a], 1), (band.backward[a], -1)):
            linked = table != own
            assert np.all(x[table[linked]] - x[linked] == move * np.eye(3, dtype=int)[a])


@pytest.mark.parametrize("radius", [8.0, 10.0, 16.0])
def test_a_surface_alone_is_linked_throughout(radius):
    """All but a few in 10,000 links, far from the surface, where a voxel's vertex is not the very nearest."""
    _, _, distance = ball(radius)
    band = band_of(distance)
    entry = np.full(distance.shape, -1)
    entry[tuple(np.round(positions(band)).astype(int)[band.primary].T)] = band.primary
    for a in range(3):
        following = np.roll(entry, -1, axis=a)
        both = (entry >= 0) & (following >= 0)
        missing = band.forward[a, entry[both]] != following[both]
        assert missing.mean() <= 2e-4
        assert np.all(np.abs(band.distance[entry[both][missing]]) > 2)


def test_entries_lie_in_the_order_of_their_voxels():
    band = band_of(phantoms.sulcus(32, gap=1.5).levelset)
    assert np.all(np.diff(band.voxel) >= 0)
    assert np.array_equal(np.repeat(np.arange(len(band.first) - 1), np.diff(band.first)), band.voxel)
    nearest = np.linalg.norm(positions(band) - surface_points(band)[band.vertex], axis=1)
    same_voxel = np.diff(band.voxel) == 0
    assert same_voxel.any() and np.all(np.diff(nearest)[same_voxel] >= -1e-9)


def test_gather_and_scatter():
    phantom = phantoms.sulcus(32, gap=2.0)
    band = band_of(phantom.levelset)
    volume = np.arange(32.0**3).reshape(32, 32, 32)
    entries = band.gather(volume)
    x = np.round(positions(band)).astype(int)
    assert np.array_equal(entries, volume[tuple(x.T)])
    back = band.scatter(entries, -1.0)
    inside = back >= 0
    assert np.array_equal(back[inside], volume[inside]) and inside.sum() == len(band.primary) < band.entries
    assert np.array_equal(band.scatter(entries, volume + 0.5)[~inside], volume[~inside] + 0.5)
    pair = np.stack([volume, -volume], -1)
    assert np.array_equal(band.gather(pair), np.stack([entries, -entries], 1))
    assert np.array_equal(band.scatter(band.gather(pair), pair + 0.5)[inside], pair[inside])
    assert np.array_equal(band.scatter(band.gather(pair), pair + 0.5)[~inside], pair[~inside] + 0.5)


@pytest.mark.parametrize("garbage", [np.nan, np.inf])
def test_unknown_psi_far_away_changes_nothing(garbage):
    _, _, distance = ball(9.0)
    whole, part = band_of(distance), band_of(np.where(np.abs(distance) < 3, distance, garbage))
    assert np.array_equal(whole.voxel, part.voxel) and whole.box == part.box
    assert np.abs(whole.distance - part.distance).max() < 1e-3
    assert np.array_equal(whole.forward, part.forward)


def test_circle_in_a_plane():
    x = np.indices((40, 38, 1)) - np.array([19.2, 18.7, 0])[:, None, None, None]
    length = np.sqrt((x**2).sum(0))
    band = band_of(length - 12.0)
    at = positions(band) - [19.2, 18.7, 0]
    assert np.abs(band.distance - (np.linalg.norm(at, axis=1) - 12)).max() < 0.01
    assert np.all(band.normal[2] == 0)  # not -1e-19, whose floor is -1
    assert band.nodes == (4, 4, 1)
    own = np.arange(band.entries)
    assert np.array_equal(band.forward[2], own) and np.array_equal(band.backward[2], own)


def test_flat_band_is_the_whole_grid():
    band = flat_band(Grid.from_spacing((4, 3, 1)))
    ids = np.arange(12).reshape(4, 3)
    assert band.entries == 12 and np.all(band.normal == 0)
    assert np.array_equal(band.forward[0].reshape(4, 3), ids[[1, 2, 3, 3]])
    assert np.array_equal(band.backward[1].reshape(4, 3), ids[:, [0, 0, 1]])
    assert np.array_equal(band.forward[2], np.arange(12))


def test_no_zero_level():
    with pytest.raises(DataError, match="no zero level"):
        band_of(np.ones((6, 6, 6)))
