"""Noise and smoothness told from samples, against noise of known strength and width."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.ndimage import gaussian_filter, zoom
from scipy.spatial import cKDTree
from test_band import band_of
from test_levelset import ball

from beltrami_cli import phantoms
from beltrami_cli.band import flat_band
from beltrami_cli.evolve import Schedule, evolve
from beltrami_cli.extension import Reextension, extend, own_samples
from beltrami_cli.flows import Flow, Stepper
from beltrami_cli.grid import Grid
from beltrami_cli.kernels.mesh import half_edges
from beltrami_cli.kinds import Kind
from beltrami_cli.noise import (
    looks_correlated,
    looks_correlated_on_mesh,
    noise_sd,
    noise_sd_on_mesh,
    smoothness_mm,
    smoothness_on_mesh,
)
from beltrami_cli.surface import edges_of

DEGREES = Kind("circular", period=360.0)
RADIUS = 14.0


def samples_of(band, volume, kind=Kind()):  # noqa: B008
    """(K, E) own samples of a volume, as a run has them."""
    return own_samples(band, np.stack([band.gather(channel) for channel in kind.to_channels(volume)]))


@pytest.fixture(scope="module")
def scene():
    """A ball's band, unit vectors (3, ...) from its centre, the distance and white noise of unit variance."""
    x, _, distance = ball(RADIUS)
    return band_of(distance), x / (distance + RADIUS), distance, np.random.default_rng(0).normal(size=distance.shape)


def smooth(d):
    return 100 * (d[0] * d[1] + d[2])


def azimuth(d):
    return np.rad2deg(np.arctan2(d[1], d[0]))


def extended(band, samples):
    """(1, E) the closest-point extension of samples (1, E)."""
    return extend(band, samples, np.ones(band.entries, samples.dtype)).values


# --- strength ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("sigma", [1.0, 5.0, 20.0])
def test_white_noise_on_a_smooth_map(scene, sigma):
    band, d, _, noise = scene
    found = noise_sd(band, samples_of(band, smooth(d) + sigma * noise), Kind())
    assert found.shape == (1,) and found[0] == pytest.approx(sigma, rel=0.04)


def test_anisotropic_voxels():
    spacing = (0.8, 0.8, 1.28)
    x, _, distance = ball(RADIUS, spacing)
    band = band_of(distance, spacing)
    data = 5 * x[0] + np.random.default_rng(1).normal(size=distance.shape)
    assert noise_sd(band, samples_of(band, data), Kind())[0] == pytest.approx(1, rel=0.04)


def test_half_the_voxels_missing(scene):
    band, d, _, noise = scene
    missing = np.random.default_rng(3).random(noise.shape) < 0.5
    data = np.where(missing, np.nan, smooth(d) + 5 * noise)
    assert noise_sd(band, samples_of(band, data), Kind())[0] == pytest.approx(5, rel=0.06)


@pytest.mark.parametrize(("low", "high"), [(0.0, 9.0), (-9.0, 0.0), (-0.6, 0.6)])
def test_data_on_one_side_or_in_a_thin_sheet(scene, low, high):
    band, d, distance, noise = scene
    data = np.where((distance > low) & (distance < high), smooth(d) + 5 * noise, np.nan)
    assert noise_sd(band, samples_of(band, data), Kind())[0] == pytest.approx(5, rel=0.05)


@pytest.mark.parametrize("height", [4.0, 20.0, 100.0])
def test_borders_are_not_noise(scene, height):
    band, d, _, noise = scene
    data = noise + height * (np.sin(3 * np.arctan2(d[1], d[0])) > 0)
    assert noise_sd(band, samples_of(band, data), Kind())[0] == pytest.approx(1, rel=0.06)


def test_outliers_are_not_noise(scene):
    """5 % of the voxels, ten times as noisy: plainly, the standard deviation would be 2.4."""
    band, _, _, noise = scene
    random = np.random.default_rng(2)
    data = noise * np.where(random.random(noise.shape) < 0.05, 10, 1)
    assert noise_sd(band, samples_of(band, data), Kind())[0] == pytest.approx(1, rel=0.12)


@pytest.mark.parametrize("name", ["curve", "plane", "sulcus", "torus"])
@pytest.mark.parametrize("sigma", [5.0, 40.0])
def test_phantoms(name, sigma):
    phantom = phantoms.make(name, noise=sigma)
    band = band_of(phantom.levelset.reshape(phantom.grid.shape))
    samples = samples_of(band, phantom.noisy.reshape(phantom.grid.shape))
    assert noise_sd(band, samples, Kind())[0] == pytest.approx(sigma, rel=0.06)


def test_flat_band_and_channels():
    random = np.random.default_rng(4)
    band = flat_band(Grid.from_spacing((96, 80)))
    channels = np.stack([random.normal(scale=s, size=band.entries) for s in (1.0, 30.0)])
    assert noise_sd(band, channels, Kind("vector")) == pytest.approx([1, 30], rel=0.05)


@pytest.mark.parametrize("sigma", [1.0, 5.0, 15.0, 25.0, 35.0, 45.0, 60.0, 70.0])
@pytest.mark.parametrize("turns", [0, 1])
def test_angles_with_wrapped_normal_noise(scene, sigma, turns):
    band, d, _, noise = scene
    data = (turns * azimuth(d) + sigma * noise) % 360
    found = noise_sd(band, samples_of(band, data, DEGREES), DEGREES)
    assert found.shape == (1,) and found[0] == pytest.approx(sigma, rel=0.06)


@pytest.mark.parametrize("s", [0.02, 0.1, 0.3, 0.6, 1.0])
def test_angles_of_noisy_complex_values(scene, s):
    """arg(exp(i a) + s (n1 + i n2)): tails heavier than a normal's, of circular sd 1 to 62 degrees."""
    band, d, _, noise = scene
    turned = 1 + s * (noise + 1j * np.random.default_rng(5).normal(size=noise.shape))
    true = np.rad2deg(np.sqrt(-2 * np.log(np.cos(np.angle(turned)).mean())))
    data = (azimuth(d) + np.rad2deg(np.angle(turned))) % 360
    assert noise_sd(band, samples_of(band, data, DEGREES), DEGREES)[0] == pytest.approx(true, rel=0.06)


def test_unit_of_the_period(scene):
    band, d, _, noise = scene
    clock = Kind("circular", period=24.0, low=-12.0)
    data = (azimuth(d) + 20 * noise) / 15
    assert noise_sd(band, samples_of(band, data, clock), clock)[0] == pytest.approx(20 / 15, rel=0.05)


def test_noise_free_and_untold(scene):
    band, d, distance, noise = scene
    assert noise_sd(band, samples_of(band, np.full(noise.shape, 3.3)), Kind())[0] == 0
    assert noise_sd(band, samples_of(band, np.where(d[0] > 0, 7.0, 1e3)), Kind())[0] == 0
    assert noise_sd(band, samples_of(band, smooth(d)), Kind())[0] < 0.3  # of 300: the map's own bend
    few = np.where(np.random.default_rng(6).random(noise.shape) < 0.05, noise, np.nan)
    assert np.isnan(noise_sd(band, samples_of(band, few), Kind())[0])
    assert np.isnan(noise_sd(band, samples_of(band, np.where(distance > 2, noise, np.nan)), Kind())[0])
    any_angle = np.random.default_rng(7).uniform(0, 360, noise.shape)
    found = noise_sd(band, samples_of(band, any_angle, DEGREES), DEGREES)[0]
    assert np.isnan(found) or found > 80


def test_noise_painted_from_a_coarser_mesh_is_not_nothing(scene):
    """Over a third of the differences are exactly 0, between copies; the rest are noise."""
    band, d, _, _ = scene
    painted, _ = from_sites(d, 2.0)
    assert 0.5 < noise_sd(band, samples_of(band, painted), Kind())[0] < 1.1


# --- width ------------------------------------------------------------------------------------------------------------


def flowed(band, u0, time):
    """(1, E) u0 after heat flow for that time, mm^2, constant along normals."""
    steps = round(time / 0.15)
    step = Stepper(Flow("l2"), band, u0.dtype)
    extend = None if band.surface is None else Reextension(band)
    return evolve(u0, step, Schedule(np.zeros(steps), time / steps), extend, 5).values


@pytest.mark.parametrize("time", [3.0, 6.0])
def test_width_of_white_noise_after_heat_flow(time):
    """FWHM^2 = 16 ln 2 t, and what the first extension adds: about 1 voxel."""
    _, _, distance = ball(24.0)
    band = band_of(distance)
    noise = np.random.default_rng(8).normal(size=distance.shape)
    u0 = extended(band, samples_of(band, noise))
    start = smoothness_mm(band, u0, Kind())
    assert 0.7 < start < 1.3
    found = smoothness_mm(band, flowed(band, u0, time), Kind())
    assert found == pytest.approx(np.sqrt(16 * np.log(2) * time + start**2), rel=0.06)


@pytest.mark.parametrize("spacing", [(1.0, 1.0), (0.8, 1.3)])
def test_width_on_a_plane(spacing):
    band = flat_band(Grid.from_spacing((160, 160), spacing))
    u0 = np.random.default_rng(9).normal(size=(1, band.entries))
    assert smoothness_mm(band, u0, Kind()) < 0.6
    found = smoothness_mm(band, flowed(band, u0, 5.0), Kind())
    assert found == pytest.approx(np.sqrt(16 * np.log(2) * 5), rel=0.06)


def test_width_of_own_samples(scene):
    band, _, _, noise = scene
    assert smoothness_mm(band, samples_of(band, noise), Kind()) < 0.6
    for fwhm in (2.0, 4.0):
        blurred = gaussian_filter(noise, fwhm / 2.3548, truncate=6)
        assert smoothness_mm(band, samples_of(band, blurred), Kind()) == pytest.approx(fwhm, rel=0.12)


def test_width_of_angles_is_that_of_their_direction(scene):
    """The length of (cos, sin) after averaging says nothing; nor does a turn of all angles."""
    band, d, _, noise = scene
    angles = azimuth(d) + 20 * gaussian_filter(noise, 1.0)
    u = samples_of(band, angles, DEGREES)
    width = smoothness_mm(band, u, DEGREES)
    shorter = u * np.random.default_rng(10).uniform(0.1, 1, band.entries)
    assert smoothness_mm(band, shorter, DEGREES) == pytest.approx(width, rel=1e-6)
    assert smoothness_mm(band, samples_of(band, angles + 77, DEGREES), DEGREES) == pytest.approx(width, rel=1e-6)


def test_width_that_cannot_be_told(scene):
    band, _, distance, noise = scene
    for data in (np.full(noise.shape, 1e6 / 3, np.float32), np.where(distance > 2, noise, np.nan)):
        assert np.isnan(smoothness_mm(band, samples_of(band, data), Kind()))
    assert np.isnan(smoothness_mm(band, samples_of(band, np.full(noise.shape, 10.0), DEGREES), DEGREES))


# --- correlation ------------------------------------------------------------------------------------------------------


def from_sites(d, apart):
    """Noise (...) and a smooth map (...) that every voxel takes from the nearest of sites `apart` voxels apart."""
    i = np.arange(round(4 * np.pi * RADIUS**2 / apart**2))
    z = 1 - (2 * i + 1) / len(i)
    turn = np.pi * (1 + np.sqrt(5)) * i
    sites = np.c_[np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z]
    nearest = cKDTree(sites).query(d.reshape(3, -1).T)[1].reshape(d.shape[1:])
    return np.random.default_rng(11).normal(size=len(i))[nearest], smooth(sites.T)[nearest]


@pytest.mark.parametrize("sigma", [0.0, 1.0, 5.0, 20.0, 100.0])
def test_white_noise_is_not_correlated(scene, sigma):
    band, d, _, noise = scene
    pieces = 60.0 * (np.sin(3 * np.arctan2(d[1], d[0])) > 0)
    for data in (smooth(d), pieces, np.zeros_like(noise)):
        assert not looks_correlated(band, samples_of(band, data + sigma * noise), Kind())
    angles = samples_of(band, azimuth(d) + sigma * noise, DEGREES)
    assert not looks_correlated(band, angles, DEGREES)


@pytest.mark.parametrize("map", ["smooth", "pieces", "mixed"])
@pytest.mark.parametrize("sigma", [0.0, 1.0, 10.0, 40.0])
def test_white_noise_on_a_torus_is_not_correlated(map, sigma):
    phantom = phantoms.torus(noise=sigma, map=map)
    band = band_of(phantom.levelset)
    assert not looks_correlated(band, samples_of(band, phantom.noisy), Kind())


@pytest.mark.parametrize("sigma", [5.0, 20.0])
def test_correlated_noise(scene, sigma):
    band, d, _, noise = scene
    blurred = gaussian_filter(noise, 2 / 2.3548)
    coarse = np.random.default_rng(12).normal(size=np.array(noise.shape) // 2 + 1)
    upsampled = zoom(coarse, 2, order=1)[tuple(slice(0, n) for n in noise.shape)]
    painted, painted_map = from_sites(d, 2.0)
    for data in (blurred, upsampled, painted):
        assert looks_correlated(band, samples_of(band, smooth(d) + sigma * data / data.std()), Kind())
        angles = samples_of(band, azimuth(d) + sigma * data / data.std(), DEGREES)
        assert looks_correlated(band, angles, DEGREES)
    assert looks_correlated(band, samples_of(band, painted_map + sigma * painted), Kind())


def test_copies_along_normals_are_correlated(scene):
    """White along the surface, the same at every depth."""
    band, d, _, _ = scene
    assert looks_correlated(band, samples_of(band, smooth(d) + 10 * from_sites(d, 1.0)[0]), Kind())


def test_channels_of_unlike_units(scene):
    band, d, _, noise = scene
    kind = Kind("vector")
    white = np.stack([noise, np.random.default_rng(13).normal(size=noise.shape)], -1)
    blurred = 15 * gaussian_filter(white, (1, 1, 1, 0))
    for data, expected in ((white, False), (blurred, True)):
        units = np.stack([smooth(d) + 10 * data[..., 0], data[..., 1] / 1e6], -1)
        assert looks_correlated(band, samples_of(band, units, kind), kind) == expected
    with_constant = np.stack([noise, np.ones_like(noise)], -1)
    assert not looks_correlated(band, samples_of(band, with_constant, kind), kind)


def test_too_few_samples_say_nothing(scene):
    band, _, distance, noise = scene
    few = np.where(distance > 2, noise, np.nan)
    assert not looks_correlated(band, samples_of(band, few), Kind())
    flat = flat_band(Grid.from_spacing((96, 80)))
    u = np.random.default_rng(14).normal(size=(96, 80, 1))
    assert not looks_correlated(flat, samples_of(flat, u), Kind())
    assert looks_correlated(flat, samples_of(flat, gaussian_filter(u, (1, 1, 0))), Kind())


# --- at the vertices of a mesh ----------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def mesh_scene():
    """A sphere's triangles, vertices (V, 3) mm, unit vectors (3, V) from its centre, white noise of unit variance."""
    sphere = trimesh.creation.icosphere(5)
    d = np.array(sphere.vertices)
    return np.array(sphere.faces, np.int32), RADIUS * d, d.T, np.random.default_rng(15).normal(size=len(d))


def correlated_on_mesh(cells, points, samples, kind=Kind()):  # noqa: B008
    return looks_correlated_on_mesh(points, *half_edges(cells, len(points)), samples, kind)


@pytest.mark.parametrize("sigma", [1.0, 5.0, 20.0])
def test_noise_at_vertices(mesh_scene, sigma):
    cells, _, d, noise = mesh_scene
    borders = 60 * (np.sin(3 * np.arctan2(d[1], d[0])) > 0)
    for data in (smooth(d), smooth(d) + borders):
        found = noise_sd_on_mesh(cells, (data + sigma * noise)[None], Kind())
        assert found.shape == (1,) and found[0] == pytest.approx(sigma, rel=0.05)
    missing = np.where(np.random.default_rng(16).random(len(noise)) < 0.3, np.nan, smooth(d) + sigma * noise)
    assert noise_sd_on_mesh(cells, missing[None], Kind())[0] == pytest.approx(sigma, rel=0.06)


@pytest.mark.parametrize("sigma", [5.0, 25.0, 60.0])
def test_noise_of_angles_at_vertices(mesh_scene, sigma):
    cells, _, d, noise = mesh_scene
    data = DEGREES.to_channels((azimuth(d) + sigma * noise) % 360)
    assert noise_sd_on_mesh(cells, data, DEGREES)[0] == pytest.approx(sigma, rel=0.06)


def test_noise_at_vertices_channels_and_untold(mesh_scene):
    cells, _, d, noise = mesh_scene
    channels = np.stack([noise, 30 * noise[::-1], np.full_like(noise, 7.0)])
    assert noise_sd_on_mesh(cells, channels, Kind("vector")) == pytest.approx([1, 30, 0], rel=0.05)
    assert noise_sd_on_mesh(cells, smooth(d)[None], Kind())[0] < 0.1
    assert np.isnan(noise_sd_on_mesh(cells[:50], noise[None], Kind())[0])
    assert np.isnan(noise_sd_on_mesh(cells, np.full((1, len(noise)), np.nan), Kind())[0])


def test_width_at_vertices(mesh_scene):
    """Of white noise none, and of white noise under a Gaussian kernel the kernel's."""
    cells, points, _, noise = mesh_scene
    assert smoothness_on_mesh(points, edges_of(cells), noise[None], Kind()) < 0.35  # edges are 0.5 mm
    apart, near = cKDTree(points).query(points, k=60)
    for fwhm in (1.0, 1.6):
        weights = np.exp(-4 * np.log(2) * apart**2 / fwhm**2)  # a Gaussian kernel of that width
        blurred = (weights * noise[near]).sum(1) / weights.sum(1)
        assert smoothness_on_mesh(points, edges_of(cells), blurred[None], Kind()) == pytest.approx(fwhm, rel=0.1)
    assert np.isnan(smoothness_on_mesh(points, edges_of(cells), np.full((1, len(points)), 4.2), Kind()))
    assert np.isnan(smoothness_on_mesh(points, edges_of(cells[:20]), noise[None], Kind()))


@pytest.mark.parametrize("sigma", [0.0, 1.0, 5.0, 20.0, 100.0])
def test_white_noise_at_vertices_is_not_correlated(mesh_scene, sigma):
    cells, points, d, noise = mesh_scene
    pieces = 60.0 * (np.sin(3 * np.arctan2(d[1], d[0])) > 0)
    for data in (smooth(d), pieces, np.zeros_like(noise)):
        assert not correlated_on_mesh(cells, points, (data + sigma * noise)[None])
    angles = DEGREES.to_channels(azimuth(d) + sigma * noise)
    assert not correlated_on_mesh(cells, points, angles, DEGREES)


@pytest.mark.parametrize("sigma", [5.0, 20.0])
def test_correlated_noise_at_vertices(mesh_scene, sigma):
    """Interpolated from a mesh of half as many vertices along a line, or blurred by two edges."""
    cells, points, d, noise = mesh_scene
    coarse = np.array(trimesh.creation.icosphere(4).vertices)
    apart, near = cKDTree(coarse).query(d.T, k=2)
    interpolated = np.where(apart[:, 0] < 1e-6, noise[near[:, 0]], noise[near].mean(1))
    apart, near = cKDTree(points).query(points, k=40)
    weights = np.exp(-4 * np.log(2) * (apart / 1.0) ** 2)
    blurred = (weights * noise[near]).sum(1)
    for data in (interpolated, blurred):
        assert correlated_on_mesh(cells, points, (smooth(d) + sigma * data / data.std())[None])
        angles = DEGREES.to_channels(azimuth(d) + sigma * data / data.std())
        assert correlated_on_mesh(cells, points, angles, DEGREES)


def test_too_few_vertices_say_nothing(mesh_scene):
    cells, points, _, noise = mesh_scene
    few = np.where(np.arange(len(noise)) < 60, noise, np.nan)
    for samples in (few, np.full_like(noise, np.nan)):
        assert not correlated_on_mesh(cells, points, samples[None])
