"""Values carried off the surface: exact where they can be, the same whatever lies where there is no data."""

from __future__ import annotations

import numpy as np
import pytest
from test_band import band_of, positions
from test_levelset import ball

from beltrami_cli import denoise, phantoms
from beltrami_cli.errors import DataError
from beltrami_cli.extension import EXTENSIONS, Reextension, extend

NORMAL = np.array([1, 2, 3]) / np.sqrt(14)


def oblique_plane(size=24):
    """Psi of an oblique plane through the middle of a cube, in voxels."""
    return np.tensordot(NORMAL, np.indices((size,) * 3) - (size - 1) / 2 + 0.2, 1)


def inner(band, margin=6):
    """(E,) bool: entries at least `margin` voxels from the volume's faces."""
    x = positions(band) / band.grid.spacing
    return np.all((x >= margin) & (x <= np.array(band.grid.shape) - 1 - margin), axis=1)


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (1.0, 0.7, 1.6)])
def test_closest_point_is_exact_for_data_linear_in_space(spacing):
    """Linear along the surface and in depth: every entry gets the value at its foot on the plane."""
    h = np.array(spacing)
    x = np.indices((26, 30, 20)) * h[:, None, None, None]
    psi = np.tensordot(NORMAL, x, 1) - np.tensordot(NORMAL, h * [12.7, 14.6, 9.8], 1)
    slope = np.array([0.7, -1.3, 0.4])
    band = band_of(psi, spacing)
    extended = extend(band, band.gather(np.tensordot(slope, x, 1)))
    foot = positions(band) + band.closest_offset.T * h
    voxel_of_foot = foot / h
    whole = np.all((voxel_of_foot > 2) & (voxel_of_foot < np.array(band.grid.shape) - 3), axis=1)
    assert whole.sum() > 2000
    assert extended.known[whole].all()
    assert np.abs(extended.values - foot @ slope)[whole].max() < 1e-4


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (1.0, 0.7, 1.6)])
def test_reextension_is_exact_for_cubics_on_a_plane(spacing):
    h = np.array(spacing)
    x = np.indices((26, 30, 20)) * h[:, None, None, None]
    psi = np.tensordot(NORMAL, x, 1) - np.tensordot(NORMAL, h * [12.7, 14.6, 9.8], 1)
    band = band_of(psi, spacing)
    again = Reextension(band)
    along = np.cross(NORMAL, [1.0, 0, 0])

    def data(points):
        t = points @ along / 10
        return t + t**2 / 9 - t**3 / 20  # monotone, so that no cell's own nodes bound it

    u = data(positions(band))
    out = np.empty_like(u)
    again(u, out)
    complete = again.origin >= 0
    assert complete[inner(band)].mean() > 0.95
    foot = positions(band) + band.closest_offset.T * h
    assert np.abs(out - data(foot))[complete].max() < 1e-5
    assert np.array_equal(out[~complete], u[~complete])


@pytest.mark.parametrize("method", EXTENSIONS)
@pytest.mark.parametrize("name", ["sphere", "sulcus", "curve"])
def test_constants_stay(method, name):
    phantom = phantoms.make(name, size=32)
    band = band_of(phantom.levelset.reshape(phantom.grid.shape))
    missing = np.random.default_rng(0).random(phantom.grid.shape) < 0.3
    samples = band.gather(np.where(missing, np.nan, 7.25).astype(np.float32))
    assert np.abs(extend(band, samples, method).values - 7.25).max() < 1e-5


def test_none_keeps_every_voxel():
    phantom = phantoms.sulcus(32, gap=1.5)
    band = band_of(phantom.levelset)
    extended = extend(band, band.gather(phantom.noisy), "none")
    assert np.array_equal(band.scatter(extended.values, phantom.noisy), phantom.noisy)


def test_closest_point_halves_the_noise_variance():
    """Two samples half a voxel to either side of the surface, eight corners each."""
    _, _, distance = ball(12.0)
    band = band_of(distance)
    noise = np.random.default_rng(1).normal(size=distance.shape)
    values = extend(band, band.gather(noise)).values
    assert 0.3 < values.std() < 0.45  # of 1; one trilinear sample has 0.54 in the mean


def test_pde_approaches_closest_point_as_the_grid_is_refined():
    gaps = []
    for radius in (8.0, 16.0):
        x, _, distance = ball(radius)
        band = band_of(distance)
        data = band.gather(3 * (np.tensordot([1 / 3, 2 / 3, 2 / 3], x, 1) / (distance + radius)) ** 2 - 1)
        exact = data[band.primary]  # constant along normals already
        by_pde, by_foot = (extend(band, data, method).values[band.primary] for method in ("pde", "closest-point"))
        assert np.abs(by_foot - exact).max() < 3 / radius**2  # of a range of 3
        gaps.append(np.abs(by_pde - by_foot).max())
    assert gaps[0] < 0.35 and gaps[1] < 0.35 * gaps[0]


def test_pde_brings_surface_values_to_the_rim():
    """Data that vary in depth: after transport the depth is gone."""
    x, _, distance = ball(12.0, room=8)
    band = band_of(distance)
    around = x[2] / (distance + 12)
    carried = extend(band, band.gather(around + 0.5 * distance), "pde").values
    assert np.abs(carried - band.gather(around)).max() < 0.25  # from 2 at the rim


# --- missing data -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", EXTENSIONS)
def test_holes_are_filled_within_the_range_of_their_rim(method):
    x, _, distance = ball(10.0)
    data = np.where(x[2] > 5, np.nan, x[0]).astype(np.float32)
    band = band_of(distance)
    extended = extend(band, band.gather(data), method)
    assert np.isfinite(extended.values[band.primary]).all()
    hole = ~extended.known & np.isfinite(extended.values)
    assert 0.15 < hole.mean() < 0.35
    rim = np.nanmax(np.abs(data[(np.abs(distance) < 5) & (x[2] > 2)]))
    assert np.abs(extended.values[hole]).max() <= rim
    # Harmonic, and odd in x as its rim is: a ramp, not a plateau.
    assert np.corrcoef(extended.values[hole], band.gather(x[0])[hole])[0, 1] > 0.97


@pytest.mark.parametrize("method", EXTENSIONS)
def test_a_hole_changes_only_what_it_touches(method):
    """Beyond the reach of the extension from the hole's rim values are those of the whole data, bit for bit."""
    x, _, distance = ball(10.0)
    data = np.random.default_rng(2).normal(size=distance.shape).astype(np.float32)
    hole = x[2] > 5
    band = band_of(distance)
    whole = extend(band, band.gather(data), method).values
    holed = extend(band, band.gather(np.where(hole, np.nan, data)), method).values
    foot_z = band.gather(x[2]) + band.closest_offset[2]
    reach = 8 if method == "pde" else 2  # transport runs for twice the band's half-width
    away = (foot_z < 5 - reach) & (band.gather(x[2]) <= 5)
    assert away.mean() > 0.3
    assert np.array_equal(whole[away], holed[away], equal_nan=True)


@pytest.mark.parametrize("method", EXTENSIONS)
def test_what_stands_for_missing_changes_nothing(method):
    x, _, distance = ball(10.0)
    data = np.random.default_rng(3).normal(size=distance.shape)
    hole = (x[2] > 5) | (np.random.default_rng(4).random(distance.shape) < 0.2)
    results = [
        denoise(distance, np.where(hole, garbage, data), extension=method, beta=0.1, iterations=12).data
        for garbage in (np.nan, np.inf, -np.inf)
    ]
    assert np.isfinite(results[0][np.abs(distance) < 3.9]).all()
    assert all(np.array_equal(results[0], other, equal_nan=True) for other in results[1:])


def test_data_beyond_the_band_change_nothing():
    _, _, distance = ball(10.0, room=9)
    data = np.random.default_rng(5).normal(size=distance.shape)
    far = np.abs(distance) > 4.2
    plain, garbage = (
        denoise(distance, np.where(far, value, data), beta=0.1, iterations=6).data for value in (data, 1e30)
    )
    assert np.array_equal(plain, garbage, equal_nan=True)


def test_a_bank_without_data_stays_missing():
    """Nothing crosses from one surface to another: the left ball has no data, the right one is whole."""
    x = np.indices((52, 24, 24)) - 11.6
    left = np.sqrt((x**2).sum(0)) - 6
    x[0] -= 28
    right = np.sqrt((x**2).sum(0)) - 6
    psi = np.minimum(left, right)
    data = np.where(left < right, np.nan, 3.0)
    result = denoise(psi, data, beta=0.1, iterations=7)
    assert np.isnan(result.data[left < right]).all()
    assert np.abs(result.data[np.abs(right) < 3.9] - 3).max() < 1e-5
    assert any("missing" in line for line in result.warnings)


def test_no_data_on_the_surface_is_an_error():
    _, _, distance = ball(8.0)
    band = band_of(distance)
    with pytest.raises(DataError, match="no valid value"):
        extend(band, np.full(band.entries, np.nan, np.float32))


def test_a_bank_is_fed_by_its_own_voxels_only():
    """Voxels beyond the middle of the gap show the other bank: they do not enter, though both bands hold them."""
    phantom = phantoms.sulcus(36, gap=2.0, noise=0)
    band = band_of(phantom.levelset)
    on_far_bank = phantom.clean[tuple(np.round(band.surface.points + [s.start for s in band.box]).astype(int).T)] > 50
    extended = extend(band, band.gather(phantom.clean))
    # At the volume's faces the surface ends, and what is nearest there need not be the own bank.
    expected = np.where(on_far_bank[band.vertex], 100, 0)
    assert np.array_equal(extended.values[inner(band)], expected[inner(band)])
