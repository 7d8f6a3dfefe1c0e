"""Values carried off the surface: exact where they can be, the same whatever lies where there is no data."""

from __future__ import annotations

import numpy as np
import pytest
from test_band import band_of, positions
from test_levelset import ball

from beltrami_cli import denoise, phantoms
from beltrami_cli.errors import DataError
from beltrami_cli.extension import EXTENSIONS, Extended, Reextension, extend, fill, own_samples

NORMAL = np.array([1, 2, 3]) / np.sqrt(14)


def oblique_plane(size=24):
    """Psi of an oblique plane through the middle of a cube, in voxels."""
    return np.tensordot(NORMAL, np.indices((size,) * 3) - (size - 1) / 2 + 0.2, 1)


def extended(band, data, method="closest-point", weights=None, **options) -> Extended:
    """The extension of a volume (nx, ny, nz), or of channels (nx, ny, nz, K), with weights (nx, ny, nz) or 1 each."""
    own = own_samples(band, np.atleast_2d(band.gather(data).T).copy(), every=method == "none")
    trust = np.ones(band.entries) if weights is None else band.gather(weights)
    trust = np.where(np.isnan(own[0]), 0, trust).astype(own.dtype)
    own[:, trust == 0] = np.nan
    return extend(band, own, trust, method, **options)


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
    got = extended(band, np.tensordot(slope, x, 1))
    foot = positions(band) + band.closest_offset.T * h
    voxel_of_foot = foot / h
    whole = np.all((voxel_of_foot > 2) & (voxel_of_foot < np.array(band.grid.shape) - 3), axis=1)
    assert whole.sum() > 2000
    assert got.known[whole].all()
    assert np.abs(got.values[0] - foot @ slope)[whole].max() < 1e-4


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

    u = np.stack([data(positions(band)), -3 * data(positions(band))])
    out = np.empty_like(u)
    again(u, out)
    complete = again.origin >= 0
    assert complete[inner(band)].mean() > 0.95
    foot = positions(band) + band.closest_offset.T * h
    assert np.abs(out - np.outer([1, -3], data(foot)))[:, complete].max() < 3e-5
    assert np.array_equal(out[:, ~complete], u[:, ~complete])


@pytest.mark.parametrize("method", EXTENSIONS)
@pytest.mark.parametrize("name", ["sphere", "sulcus", "curve"])
def test_constants_stay(method, name):
    phantom = phantoms.make(name, size=32)
    band = band_of(phantom.levelset.reshape(phantom.grid.shape))
    missing = np.random.default_rng(0).random(phantom.grid.shape) < 0.3
    data = np.where(missing, np.nan, 7.25).astype(np.float32)
    assert np.abs(extended(band, data, method).values - 7.25).max() < 1e-5


def test_none_keeps_every_voxel():
    phantom = phantoms.sulcus(32, gap=1.5)
    band = band_of(phantom.levelset)
    kept = extended(band, phantom.noisy, "none").values[0]
    assert np.array_equal(band.scatter(kept, phantom.noisy), phantom.noisy)


def test_closest_point_halves_the_noise_variance():
    """Two samples half a voxel to either side of the surface, eight corners each."""
    _, _, distance = ball(12.0)
    band = band_of(distance)
    noise = np.random.default_rng(1).normal(size=distance.shape)
    values = extended(band, noise).values
    assert 0.3 < values.std() < 0.45  # of 1; one trilinear sample has 0.54 in the mean


def test_pde_approaches_closest_point_as_the_grid_is_refined():
    gaps = []
    for radius in (8.0, 16.0):
        x, _, distance = ball(radius)
        band = band_of(distance)
        data = 3 * (np.tensordot([1 / 3, 2 / 3, 2 / 3], x, 1) / (distance + radius)) ** 2 - 1
        exact = band.gather(data)[band.primary]  # constant along normals already
        by_pde, by_foot = (extended(band, data, method).values[0, band.primary] for method in ("pde", "closest-point"))
        assert np.abs(by_foot - exact).max() < 3 / radius**2  # of a range of 3
        gaps.append(np.abs(by_pde - by_foot).max())
    assert gaps[0] < 0.35 and gaps[1] < 0.35 * gaps[0]


def test_pde_brings_surface_values_to_the_rim():
    """Data that vary in depth: after transport the depth is gone."""
    x, _, distance = ball(12.0, room=8)
    band = band_of(distance)
    around = x[2] / (distance + 12)
    carried = extended(band, around + 0.5 * distance, "pde").values[0]
    assert np.abs(carried - band.gather(around)).max() < 0.25  # from 2 at the rim


# --- missing data -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("method", EXTENSIONS)
def test_holes_are_filled_within_the_range_of_their_rim(method):
    x, _, distance = ball(10.0)
    data = np.where(x[2] > 5, np.nan, x[0]).astype(np.float32)
    band = band_of(distance)
    got = extended(band, data, method)
    values = got.values[0]
    assert np.isfinite(values[band.primary]).all()
    hole = ~got.known & np.isfinite(values)
    assert 0.15 < hole.mean() < 0.35
    assert np.all(got.confidence[hole] == 0) and np.all(got.confidence[got.known] > 0)
    rim = np.nanmax(np.abs(data[(np.abs(distance) < 5) & (x[2] > 2)]))
    assert np.abs(values[hole]).max() <= rim
    # Harmonic, and odd in x as its rim is: a ramp, not a plateau.
    assert np.corrcoef(values[hole], band.gather(x[0])[hole])[0, 1] > 0.97


@pytest.mark.parametrize("method", EXTENSIONS)
def test_a_hole_changes_only_what_it_touches(method):
    """Beyond the reach of the extension from the hole's rim values are those of the whole data, bit for bit."""
    x, _, distance = ball(10.0)
    data = np.random.default_rng(2).normal(size=distance.shape).astype(np.float32)
    hole = x[2] > 5
    band = band_of(distance)
    whole = extended(band, data, method).values[0]
    holed = extended(band, np.where(hole, np.nan, data), method).values[0]
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
        extended(band, np.full(distance.shape, np.nan, np.float32))
    with pytest.raises(DataError, match="weights of 0"):
        extended(band, distance, weights=np.zeros(distance.shape))


def test_a_bank_is_fed_by_its_own_voxels_only():
    """Voxels beyond the middle of the gap show the other bank: they do not enter, though both bands hold them."""
    phantom = phantoms.sulcus(36, gap=2.0, noise=0)
    band = band_of(phantom.levelset)
    on_far_bank = phantom.clean[tuple(np.round(band.surface.points + [s.start for s in band.box]).astype(int).T)] > 50
    values = extended(band, phantom.clean).values[0]
    # At the volume's faces the surface ends, and what is nearest there need not be the own bank.
    expected = np.where(on_far_bank[band.vertex], 100, 0)
    assert np.array_equal(values[inner(band)], expected[inner(band)])


@pytest.mark.parametrize("turns", [False, True])
def test_channels_are_filled_together_as_they_would_be_alone(turns):
    """Both ways solve Laplace's equation to the tolerance; lengths up to 1 bound nothing here, nor do the ranges."""
    x, _, distance = ball(8.0)
    band = band_of(distance)
    known = band.gather(x[2]) < 4
    own = np.where(known, 0.6 * band.gather(np.moveaxis(x[:2], 0, -1)).T / 12, np.nan)
    together, alone = own.copy(), own.copy()
    fill(band, together, known, turns=turns)
    for k in range(2):
        fill(band, alone[k : k + 1], known)
    assert np.isfinite(together).all() and np.array_equal(together[:, known], own[:, known])
    assert np.abs(together - alone).max() < 5e-3 * np.ptp(own[:, known])


# --- weights ----------------------------------------------------------------------------------------------------------


def flat_plane(size=24, at=11.5):
    """A band around the plane x = `at`, and the x of every voxel."""
    x = np.indices((size,) * 3)[0].astype(float)
    return band_of(x - at), x


@pytest.mark.parametrize("method", EXTENSIONS)
def test_a_value_of_weight_0_has_no_influence(method):
    _, _, distance = ball(9.0)
    data = np.random.default_rng(5).normal(size=distance.shape)
    weights = np.random.default_rng(6).uniform(0, 1, distance.shape)
    doubtful = np.random.default_rng(7).random(distance.shape) < 0.3
    weights[doubtful] = 0
    first, second = (
        denoise(distance, d, weights=w, extension=method, beta=0.1, iterations=7, fidelity=0.5).data
        for d, w in ((np.where(doubtful, 1e6, data), weights), (np.where(doubtful, np.nan, data), 5 * weights))
    )
    assert np.nanmax(np.abs(first - second)) < 1e-5 and np.nanmax(np.abs(first)) < 5


def test_weights_weigh():
    """The two samples half a voxel aside are voxels here: 0 of weight 1 and 10 of weight 3."""
    band, x = flat_plane()
    got = extended(band, np.where(x < 11.5, 0.0, 10.0), weights=np.where(x < 11.5, 0.25, 0.75))
    assert np.allclose(got.values[0], 7.5, atol=1e-5)
    assert np.allclose(got.confidence, 0.5, atol=1e-6)


def test_corners_are_weighed_by_trust_and_nearness():
    """Rows of voxels of weight 1/3 and 1 along y: between two of them each counts by trilinear weight times its own."""
    y = np.indices((24, 25, 24))[1]
    band = band_of(np.indices(y.shape)[0] - 11.5 + 1e-3 * (y - 12.0))
    own = np.where(y % 2, 1.0, 5.0)
    weights = np.where(y % 2, 1.0, 1 / 3)
    foot = positions(band)[:, 1] + band.closest_offset[1]
    share = np.abs((foot + 1) % 2 - 1)  # of the odd voxel, linear between 0 and 1
    expected = (share * 1 + (1 - share) * 5 / 3) / (share + (1 - share) / 3)
    assert np.abs(extended(band, own, weights=weights).values[0] - expected)[inner(band)].max() < 0.02


@pytest.mark.parametrize("method", EXTENSIONS)
def test_constant_weights_are_none(method):
    x, _, distance = ball(9.0)
    data = np.where(x[2] > 4, np.nan, np.random.default_rng(8).normal(size=distance.shape))
    band = band_of(distance)
    plain, weighed = (extended(band, data, method, w) for w in (None, np.full(distance.shape, 0.37)))
    assert np.allclose(plain.values, weighed.values, atol=1e-6, equal_nan=True)
    assert np.array_equal(plain.known, weighed.known)
    assert np.allclose(0.37 * plain.confidence, weighed.confidence, atol=1e-7)
    assert plain.confidence.max() <= 1 + 1e-6


@pytest.mark.parametrize("method", ["closest-point", "pde"])
def test_doubted_values_hardly_count(method):
    _, _, distance = ball(9.0)
    wrong = np.random.default_rng(9).random(distance.shape) < 0.2
    data, weights = np.where(wrong, 100.0, 1.0), np.where(wrong, 1e-3, 1.0)
    band = band_of(distance)
    trusted, weighed = (extended(band, data, method, w).values[0][band.primary] for w in (None, weights))
    assert np.mean(weighed - 1) < 0.05 * np.mean(trusted - 1)
    confidence = extended(band, data, method, weights).confidence
    assert 0.6 < confidence.mean() < 0.9


# --- depth ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("depth", "middle"), [((-2.0, 2.0), 0.0), ((-1.3, 1.3), 0.0), ((0.0, 2.0), 1.0), ((1.0, 1.0), 1.0)]
)
@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (1.0, 0.7, 1.6)])
def test_depth_is_exact_for_data_linear_in_space(spacing, depth, middle):
    """The mean over the depths is the value at their middle."""
    h = np.array(spacing)
    x = np.indices((30, 40, 20)) * h[:, None, None, None]
    psi = np.tensordot(NORMAL, x, 1) - np.tensordot(NORMAL, h * [14.7, 19.6, 9.8], 1)
    slope = np.array([0.7, -1.3, 0.4])
    band = band_of(psi, spacing)
    values = extended(band, np.tensordot(slope, x, 1), depth=depth).values[0]
    foot = positions(band) + band.closest_offset.T * h
    whole = np.all((foot / h > 6) & (foot / h < np.array(band.grid.shape) - 7), axis=1)
    assert whole.sum() > 300
    assert np.abs(values - (foot + middle * NORMAL) @ slope)[whole].max() < 1e-4


@pytest.mark.parametrize("depth", [(-2.0, 2.0), (0.0, 3.0), (-1.0, 1.25)])
def test_depth_averages_noise_away(depth):
    """Variance of the mean of the samples, each a hat between its two voxels: 0.13 for 4 mm against 0.5 without."""
    band, x = flat_plane(40, at=19.5)
    noise = np.random.default_rng(10).normal(size=x.shape)
    at = 19.5 + np.linspace(*depth, 1 + int(np.ceil((depth[1] - depth[0]) / 0.5)))
    hats = np.maximum(1 - np.abs(np.arange(40) - at[:, None]), 0).mean(0)
    values = extended(band, noise, depth=depth).values[0]
    here = np.round(positions(band)[:, 0]) == 20
    assert values[here].var() == pytest.approx((hats**2).sum(), rel=0.1)
    assert extended(band, noise).values[0][here].var() == pytest.approx(0.5, rel=0.1)


def test_depth_reaches_data_on_one_side():
    """Data from 2 to 4 voxels outside only: too far for the surface itself, not for its depths."""
    x, _, distance = ball(10.0, room=8)
    data = np.where((distance > 2) & (distance < 4), np.tensordot([0.3, 0.5, -0.2], x, 1) / (distance + 10), np.nan)
    band = band_of(distance)
    with pytest.raises(DataError, match="no valid value"):
        extended(band, data)
    deep = extended(band, data, depth=(0.0, 4.0))
    assert deep.known.mean() > 0.99
    exact = band.gather(np.tensordot([0.3, 0.5, -0.2], x, 1) / (distance + 10))
    assert np.abs(deep.values[0] - exact)[deep.known].max() < 0.05  # of a range of 1.2
    assert 0.4 < deep.confidence.mean() < 0.7  # about half the samples hold nothing


@pytest.mark.parametrize("gap", [1.5, 2.0, 4.0])
def test_depth_stays_on_its_own_bank(gap):
    """Three millimetres to either side reach through the gap into the other bank's tissue."""
    phantom = phantoms.sulcus(36, gap=gap, noise=0)
    band = band_of(phantom.levelset)
    values = extended(band, phantom.clean, depth=(-3.0, 3.0)).values[0]
    on_far_bank = phantom.clean[tuple(np.round(band.surface.points + [s.start for s in band.box]).astype(int).T)] > 50
    expected = np.where(on_far_bank[band.vertex], 100, 0)
    assert np.abs(values - expected)[inner(band)].max() < 1e-4


def test_depth_beyond_the_band_takes_what_there_is():
    band, x = flat_plane()
    inside, beyond = (extended(band, x, depth=(-d, d)) for d in (3.0, 9.0))
    assert np.abs(beyond.values[0] - 11.5).max() < 1e-4 and np.abs(inside.values[0] - 11.5).max() < 1e-4
    assert beyond.confidence.max() < 0.6 < inside.confidence.min()
