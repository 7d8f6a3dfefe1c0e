"""Every kernel against its plain NumPy twin, on small random bands with missing links."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
import reference
import trimesh

from beltrami_cli.band import band_around
from beltrami_cli.grid import Grid
from beltrami_cli.kernels import extend, interpolate, mesh, metric, sheets, steps
from beltrami_cli.levelset import refined
from beltrami_cli.sampling import SurfacePoints
from beltrami_cli.surface import Mesh

LAWS = list(reference.DIFFUSIVITY)
SPACINGS = [(1.0, 1.0, 1.0), (0.7, 1.1, 2.3)]
# Steps of random data of order 1: a few hundred roundings of the type.
ROUNDING = {np.float32: 1e-5, np.float64: 1e-13}


def random_links(rng, shape=(6, 5, 4), absent=0.15, cut=0.1):
    """Voxels of a box without a share `absent` of them, linked to their neighbours but for a share `cut` of links.

    Returns forward (3, E), backward (3, E) and the entry of each voxel (-1 where absent).
    """
    present = rng.random(shape) > absent
    entry = np.where(present, np.cumsum(present).reshape(shape) - 1, -1)
    count = int(present.sum())
    forward = np.tile(np.arange(count, dtype=np.int32), (3, 1))
    backward = forward.copy()
    for axis in range(3):
        first, second = (np.moveaxis(entry, axis, 0)[part].ravel() for part in (slice(None, -1), slice(1, None)))
        kept = (first >= 0) & (second >= 0) & (rng.random(first.size) > cut)
        forward[axis, first[kept]] = second[kept]
        backward[axis, second[kept]] = first[kept]
    return forward, backward, entry


def unit(vectors):
    return vectors / np.linalg.norm(vectors, axis=0)


def metric_fluxes(name, u, normal, forward, backward, spacing, beta, tangents=2):
    """What a kernel of `metric` makes of u (K, E): flux, T (3, 3, E), outer factor a, largest (E,), energy, bound."""
    (channels, entries), dtype = u.shape, u.dtype
    flux, work = np.empty((2, channels, 3, entries), dtype)
    tensor, (a, largest) = np.empty((6, entries), dtype), np.empty((2, entries), dtype)
    place = u, normal.astype(dtype), forward, backward, np.array(spacing, dtype)
    energy, bound = getattr(metric, name)(*place, beta, tangents, flux, work, tensor, a, largest)
    return flux, tensor[[[0, 3, 4], [3, 1, 5], [4, 5, 2]]], a, largest, energy, bound


def take_step(name, u, normal, forward, backward, spacing, law, outer, beta, dt):
    """One step of u (K, E) by the kernels: channels share the diffusivity of a law, or where it is None their metric.

    Returns (u after it, sum of squared changes, energy), as the twins do.
    """
    (channels, entries), dtype = u.shape, u.dtype
    out = np.empty_like(u)
    if law is None:
        flux, _, a, _, energy, _ = metric_fluxes(name, u, normal, forward, backward, spacing, beta)
    else:
        (flux, work), a = np.empty((2, channels, 3, entries), dtype), np.empty(entries, dtype)
        place = u, normal.astype(dtype), forward, backward, np.array(spacing, dtype)
        energy = getattr(steps, name)(*place, law, beta, flux, work, a)
    return out, steps.diverge(u, flux, backward, a, outer, dt, out), energy


def random_values(rng, channels, entry):
    """u (K, E) of order 1, and unit normals (3, E)."""
    return rng.normal(size=(channels, entry.max() + 1)), unit(rng.normal(size=(3, entry.max() + 1)))


def coupling_of(law):
    return reference.by_metric if law is None else reference.shared(law)


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("channels", [1, 2, 3, 5])
@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("law", [*LAWS, None])
@pytest.mark.parametrize("name", ["symmetric", "paper"])
def test_step(name, law, spacing, channels, precision):
    rng = np.random.default_rng(channels)
    forward, backward, entry = random_links(rng)
    u, normal = random_values(rng, channels, entry)
    for outer in (True, False):
        place, rest = (normal, forward, backward, spacing), (outer, 0.8, 0.1)
        got = take_step(name, u.astype(precision), *place, law, *rest)
        expected = getattr(reference, name)(u, *place, coupling_of(law), *rest)
        for value, twin in zip(got, expected, strict=True):
            assert np.allclose(value, twin, rtol=ROUNDING[precision], atol=ROUNDING[precision])


@pytest.mark.parametrize("law", [*LAWS, None])
def test_mean_over_eight_choices_is_the_flux_form(law):
    rng = np.random.default_rng(10)
    forward, backward, entry = random_links(rng)
    u, normal = random_values(rng, 2, entry)
    arguments = (u, normal, forward, backward, SPACINGS[1], coupling_of(law), True, 0.8, 0.1)
    assert np.allclose(reference.symmetric(*arguments)[0], reference.symmetric_by_fluxes(*arguments), atol=1e-13)


# Where values live: (name, normals' shape is that of a surface, a curve in the plane z = 0, or none; tangents).
PLACES = {"surface": ((6, 5, 4), 2), "curve": ((13, 9, 1), 1), "picture": ((12, 9, 1), 2), "volume": ((6, 5, 4), 3)}


def random_place(name, channels, seed=11):
    """u (K, E), normals (3, E), forward, backward, and the tangents' number, of one of PLACES."""
    rng = np.random.default_rng(seed)
    shape, tangents = PLACES[name]
    forward, backward, entry = random_links(rng, shape)
    u, normal = random_values(rng, channels, entry)
    if name == "curve":
        normal = unit(normal * [[1], [1], [0]])
    elif name != "surface":
        normal = 0 * normal
    return u, normal, forward, backward, tangents


def central_slopes(u, normal, forward, backward, spacing):
    """v (K, 3, E) at the central differences, and P (3, 3, E)."""
    d = reference.difference_matrices(forward, backward, spacing).mean(0)
    return reference.tangential(normal, d, u), reference.projection(normal)


@pytest.mark.parametrize("channels", [1, 2, 3, 5])
@pytest.mark.parametrize("place", PLACES)
def test_one_tensor_is_the_metric_in_gram_form(place, channels):
    """V M^-1 = A^-1 V: T v_k = sum_l C_kl v_l, of the kernel and of its twin."""
    u, normal, forward, backward, tangents = random_place(place, channels)
    v, p = central_slopes(u, normal, forward, backward, SPACINGS[1])
    expected = reference.gram_fluxes(v, 0.8)
    _, tensor, a, *_ = metric_fluxes("symmetric", u, normal, forward, backward, SPACINGS[1], 0.8, tangents)
    for t, outer in ((tensor, a), reference.by_metric(v, p, 0.8)):
        assert np.abs(np.einsum("abm,kbm->kam", t, v) - expected).max() < 1e-12 * np.abs(expected).max()
        gram = np.eye(channels) + 0.64 * np.einsum("kam,lam->mkl", v, v)
        assert np.allclose(outer, np.linalg.det(gram) ** -0.5, rtol=1e-12)


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("channels", [2, 3, 5])
@pytest.mark.parametrize("place", ["curve", "picture", "volume"])
@pytest.mark.parametrize("name", ["symmetric", "paper"])
def test_step_by_the_metric_off_surfaces(name, place, channels, precision):
    u, normal, forward, backward, _ = random_place(place, channels)
    rest = (normal, forward, backward, SPACINGS[1])
    got = take_step(name, u.astype(precision), *rest, None, True, 0.8, 0.1)
    expected = getattr(reference, name)(u, *rest, reference.by_metric, True, 0.8, 0.1)
    for value, twin in zip(got, expected, strict=True):
        assert np.allclose(value, twin, rtol=ROUNDING[precision], atol=ROUNDING[precision])


@pytest.mark.parametrize("name", ["symmetric", "paper"])
def test_without_a_slope_the_metric_is_the_identity(name):
    u, normal, forward, backward, _ = random_place("surface", 2)
    place = u, normal, forward, backward, SPACINGS[1]
    heat, coupled = (take_step(name, *place, law, True, 0.0, 0.1) for law in (steps.ONE, None))
    assert np.abs(heat[0] - coupled[0]).max() < 1e-14
    assert coupled[1:] == pytest.approx(heat[1:], rel=1e-12)


@pytest.mark.parametrize("scale", [1.0, 1e3])
def test_metric_of_one_channel_is_the_shared_diffusivity(scale):
    """T v = r v. The symmetric scheme applies T to differences that are not v, and is another discretisation."""
    u, normal, forward, backward, _ = random_place("surface", 1)
    arguments = (scale * u, normal, forward, backward, SPACINGS[1])
    shared, coupled = (take_step("paper", *arguments, law, True, 0.8, 0.1) for law in (steps.R, None))
    assert np.abs(coupled[0] - shared[0]).max() < 1e-12 * scale
    assert coupled[1:] == pytest.approx(shared[1:], rel=1e-9)


@pytest.mark.parametrize("scales", [(1, 1e4), (5, 5, 1e4), (1e4, 1e4), (1, 1e3, 1e3), (1, 1, 1e3, 1e4, 1e4)])
@pytest.mark.parametrize("place", PLACES)
def test_metric_at_slopes_far_above_the_edge(place, scales):
    """Its smallest numbers come out of the largest ones: compared with what V's singular values give."""
    u, normal, forward, backward, tangents = random_place(place, len(scales))
    u *= np.array(scales)[:, None]
    v, p = central_slopes(u, normal, forward, backward, SPACINGS[1])
    _, tensor, a, *_ = metric_fluxes("symmetric", u, normal, forward, backward, SPACINGS[1], 0.8, tangents)
    left, singular, _ = np.linalg.svd(np.moveaxis(v, -1, 0).swapaxes(1, 2))
    s = np.pad(singular, [(0, 0), (0, 3 - singular.shape[1])]) * 0.8
    size = np.sqrt((1 + s**2).prod(1))
    exact = np.einsum("abm,mbk,mk,mck,cdm->adm", p, left, size[:, None] / (1 + s**2), left, p)
    assert np.allclose(a, 1 / size, rtol=1e-6)
    assert np.all(np.abs(tensor - exact).max((0, 1)) < 1e-6 * np.abs(exact).max((0, 1)))


@pytest.mark.parametrize("place", PLACES)
@pytest.mark.parametrize("channels", [2, 3, 5])
def test_largest_eigenvalue_of_the_metric(channels, place):
    """Never below that of T between tangents; on a surface, a picture and a curve it is that."""
    u, normal, forward, backward, tangents = random_place(place, channels)
    u[0] *= 30
    _, tensor, _, largest, *_ = metric_fluxes("symmetric", u, normal, forward, backward, SPACINGS[1], 0.8, tangents)
    if PLACES[place][0][2] == 1:
        tensor[2] = tensor[:, 2] = 0  # across the plane there is no link
    eigenvalues = np.linalg.eigvalsh(np.moveaxis(tensor, -1, 0))
    assert np.all(eigenvalues[:, -1] <= largest * (1 + 1e-9))
    assert np.all(largest <= eigenvalues[:, -1] * (1 + 1e-9 if tangents < 3 else 3))
    assert np.all(eigenvalues[:, 3 - tangents] > 0)


@pytest.mark.parametrize("name", ["symmetric", "paper"])
@pytest.mark.parametrize("channels", [2, 3, 5])
@pytest.mark.parametrize("place", PLACES)
def test_metric_bounds_the_step(place, channels, name):
    """At least the largest a_i lambda_max(T_i + T_j) / 2 over the faces; dt times the fastest decay is <= 2."""
    u, normal, forward, backward, tangents = random_place(place, channels)
    u[0] *= 30
    rest = (forward, backward, SPACINGS[1])
    _, tensor, a, _, _, bound = metric_fluxes(name, u, normal, *rest, 1.0, tangents)
    if PLACES[place][0][2] == 1:
        tensor[2] = tensor[:, 2] = 0
    assert reference.largest_over_faces(tensor, a, forward) <= bound * (1 + 1e-12)
    assert bound > 1.5 if tangents > 1 else bound <= 1
    axes = np.array(SPACINGS[1])[np.array(PLACES[place][0]) > 1]
    dt = 1 / (2 * (1 / axes**2).sum()) / max(1, bound)
    assert 0.02 < dt * reference.fastest_decay(name, tensor, a, *rest) <= 2


def diffusivity(law, slopes):
    """c at each beta |v|: pairs of linked entries, the second of each at the slope."""
    first, count = 2 * np.arange(len(slopes)), 2 * len(slopes)
    forward, backward = np.tile(np.arange(count, dtype=np.int32), (2, 3, 1))
    forward[0, first], backward[0, first + 1] = first + 1, first
    u, c = np.zeros((1, count)), np.empty(count)
    u[0, first + 1] = slopes
    steps.paper(u, np.zeros((3, count)), forward, backward, np.ones(3), law, 1.0, *np.empty((2, 1, 3, count)), c)
    return c[first]


@pytest.mark.parametrize("law", LAWS)
def test_diffusivity_starts_at_1_and_falls(law):
    slopes = np.array([1e-3, 0.1, 0.5, 1.0, 3.0, 100.0])
    values = diffusivity(law, slopes)
    assert np.allclose(values, reference.DIFFUSIVITY[law](slopes), rtol=1e-12)
    assert values[0] == pytest.approx(1, abs=1e-5) and np.all(np.diff(values) <= 0)


def test_weickert_flux_is_largest_at_the_edge_slope():
    slopes = np.linspace(0.5, 2, 1501)
    assert abs(slopes[(slopes * diffusivity(steps.WEICKERT, slopes)).argmax()] - 1) < 0.002


def test_a_single_plane_of_voxels_has_no_differences_across_it():
    rng = np.random.default_rng(4)
    forward, backward, entry = random_links(rng, shape=(9, 8, 1))
    u, normal = random_values(rng, 2, entry)
    normal = unit(normal * [[1], [1], [0]])
    for law in (steps.R, None):
        got, other = (
            take_step("symmetric", u, normal, forward, backward, (1.0, 1.5, h), law, True, 0.8, 0.1)[0]
            for h in (1.0, 77.0)
        )
        twin = reference.symmetric(u, normal, forward, backward, (1.0, 1.5, 1.0), coupling_of(law), True, 0.8, 0.1)
        assert np.allclose(got, twin[0], atol=1e-13)
        assert np.array_equal(got, other)


# --- interpolation ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("shape", [(9, 8, 7), (12, 11, 1)])
def test_cubic_on_a_whole_box_reaches_far_queries(shape):
    rng = np.random.default_rng(0)
    forward, backward, entry = random_links(rng, shape, absent=0, cut=0)
    volume = rng.normal(size=shape)
    start = rng.integers(0, volume.size, 300).astype(np.int32)
    at = rng.uniform(0, 1, (3, 300)) * (np.array(shape) - 1)[:, None]
    got, expected = interpolated(volume, entry, start, at, forward, backward)
    assert 0.2 < np.isnan(expected).mean() < 0.95
    assert np.allclose(got, expected, atol=1e-5, equal_nan=True)


def test_cubic_needs_every_node_of_its_stencil():
    rng = np.random.default_rng(1)
    forward, backward, entry = random_links(rng, (9, 9, 9), absent=0.005, cut=0)
    volume = np.where(entry >= 0, rng.normal(size=entry.shape), np.nan)
    start = rng.choice(entry[entry >= 0], 400).astype(np.int32)
    at = np.argwhere(entry >= 0)[start].T + rng.uniform(-1, 1, (3, 400))
    got, expected = interpolated(volume, entry, start, at, forward, backward)
    assert 0.2 < np.isnan(expected).mean() < 0.95
    assert np.allclose(got, expected, atol=1e-5, equal_nan=True)


def interpolated(volume, entry, start, at, forward, backward):
    """Kernel's and twin's cubic at points `at` (3, Q) in voxels, reached from the entries `start` (Q,)."""
    voxel = np.argwhere(entry >= 0)[start].T
    offset = (at - voxel).astype(np.float32)
    nodes = tuple(4 if n > 1 else 1 for n in entry.shape)
    origin = interpolate.stencil_origins(start, offset, forward, backward, nodes)
    got = np.full((1, len(start)), np.nan, np.float32)
    u = volume[entry >= 0].astype(np.float32)[None]
    interpolate.cubic(u, np.empty(0, np.float32), origin, offset, forward, nodes, got)
    return got[0], np.array([reference.cubic_at(volume, p) for p in (voxel + offset).T])


@pytest.mark.parametrize("shape", [(9, 8, 7), (12, 11, 1)])
def test_cubic_of_channels(shape):
    """Each clamped by itself, or all as one vector by its length; a NaN in one channel keeps what was there in all."""
    rng = np.random.default_rng(7)
    forward, backward, entry = random_links(rng, shape, absent=0, cut=0)
    volumes = rng.normal(size=(3, *shape)) + 0.5
    volumes[1].flat[rng.choice(volumes[1].size, 2)] = np.nan
    start = rng.integers(0, entry.size, 300).astype(np.int32)
    offset = rng.uniform(-1, 1, (3, 300)) * (np.array(shape) > 1)[:, None]
    at = np.argwhere(entry >= 0)[start] + offset.T
    nodes = tuple(4 if n > 1 else 1 for n in shape)
    origin = interpolate.stencil_origins(start, offset, forward, backward, nodes)
    u = volumes.reshape(3, -1)
    for size, twin in [
        (np.empty(0), lambda p: [reference.cubic_at(volume, p) for volume in volumes]),
        (np.sqrt((u**2).sum(0)), lambda p: reference.cubic_vector_at(volumes, p)),
    ]:
        got, expected = np.full((3, 300), -99.0), np.array([twin(p) for p in at]).T
        interpolate.cubic(u, size, origin, offset, forward, nodes, got)
        missing = np.isnan(expected).any(0)
        assert 30 < missing.sum() < 290
        assert np.all(got[:, missing] == -99)
        assert np.allclose(got[:, ~missing], expected[:, ~missing], atol=1e-12)


def test_cubic_is_exact_for_cubics_and_stays_within_its_cell():
    forward, backward, entry = random_links(np.random.default_rng(2), (10, 4, 4), absent=0, cut=0)
    x = np.arange(10.0)
    offset = np.zeros((3, 61), np.float32)
    offset[0] = np.linspace(0, 6, 61)
    start = np.full(61, entry[1, 1, 1], np.int32)
    origin = interpolate.stencil_origins(start, offset, forward, backward, (4, 4, 4))
    for u, expected in [
        (x * (x - 4.3) * (x - 11), lambda t: t * (t - 4.3) * (t - 11)),
        (np.where(x > 4, 1.0, 0.0), lambda t: np.clip(t - 4, 0, 1)),  # the unclamped cubic overshoots by 0.07
    ]:
        got = np.empty((1, 61))
        interpolate.cubic(np.repeat(u, 16)[None], np.empty(0), origin, offset, forward, (4, 4, 4), got)
        t = 1 + offset[0]
        if u.max() > 1:
            inside = (t < 1.9) | (t > 3)  # elsewhere the cubic's own turning point lies above its cell's nodes
            assert np.allclose(got[0, inside], expected(t)[inside], rtol=1e-6, atol=1e-5)
        assert got.min() >= u.min() and got.max() <= u.max()


@pytest.mark.parametrize("least", [0.0, 0.125, 0.5])
def test_linear(least):
    rng = np.random.default_rng(3)
    forward, backward, entry = random_links(rng)
    u = rng.normal(size=(2, entry.max() + 1)).astype(np.float32)
    confidence = rng.uniform(0.1, 1, u.shape[1]).astype(np.float32)
    missing = rng.random(u.shape[1]) < 0.2
    u[:, missing], confidence[missing] = np.nan, 0
    start = rng.integers(-1, u.shape[1], 500).astype(np.int32)
    offset = rng.uniform(-2.5, 2.5, (3, 500)).astype(np.float32)
    offset[:, :50] = np.round(offset[:, :50])
    total, mass = np.full((2, 500), 7.0), np.full(500, 3.0)
    interpolate.linear(u, confidence, start, offset, forward, backward, least, total, mass)
    place = forward, backward, least
    for m in range(500):
        expected = np.zeros(2), 0.0
        if start[m] >= 0:
            expected = reference.linear_at(u.astype(float), confidence, start[m], offset[:, m].astype(float), *place)
        assert np.abs(total[:, m] - 7 - expected[0]).max() < 1e-5 and abs(mass[m] - 3 - expected[1]) < 1e-5
    assert 0.1 < (mass == 3).mean() < 0.9


# --- extension --------------------------------------------------------------------------------------------------------


def test_transport():
    rng = np.random.default_rng(5)
    forward, backward, entry = random_links(rng)
    count = entry.max() + 1
    u = np.where(rng.random(count) < 0.3, np.nan, rng.normal(size=count)).astype(np.float32)
    normal = unit(rng.normal(size=(3, count))).astype(np.float32)
    distance, spacing = rng.normal(size=count).astype(np.float32), np.array(SPACINGS[1])
    out = np.empty_like(u)
    extend.transport(u, normal, distance, forward, backward, spacing, 0.7, 0.2, out)
    expected = reference.transport(u, normal, distance, forward, backward, spacing, 0.7, 0.2)
    assert 0 < np.isnan(expected).sum() < np.isnan(u).sum()
    assert np.allclose(out, expected, atol=1e-6, equal_nan=True)


def test_flood():
    rng = np.random.default_rng(6)
    forward, backward, entry = random_links(rng, (8, 7, 6), absent=0.5, cut=0.2)  # falls into several pieces
    count = entry.max() + 1
    u = rng.normal(size=(2, count)).astype(np.float32)
    u[:, rng.random(count) < 0.9] = np.nan
    expected = np.stack([reference.flood(channel, forward, backward) for channel in u])
    assert 0 < np.isnan(expected).sum() < np.isnan(u).sum()
    extend.flood(u, forward, backward)
    assert np.allclose(u, expected, atol=1e-6, equal_nan=True)


@pytest.mark.parametrize("channels", [1, 3])
def test_relax(channels):
    """Harmonic to the tolerance asked for; the fixed entries, of whatever value, stay as they are."""
    rng = np.random.default_rng(9)
    forward, backward, entry = random_links(rng, (7, 6, 5), absent=0.05, cut=0.03)
    u = rng.normal(size=(channels, entry.max() + 1))
    free = np.flatnonzero(rng.random(u.shape[1]) < 0.6).astype(np.int32)
    expected = reference.harmonic(u, free, forward, backward, SPACINGS[1])
    start = u.copy()
    extend.relax(u, free, forward, backward, np.array(SPACINGS[1]), 1e-12, 500)
    assert np.abs(u - expected).max() < 1e-9 < np.abs(start - expected).max()
    assert np.array_equal(np.delete(u, free, 1), np.delete(start, free, 1))


# --- geometry ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "cells", [[[0, 1, 2], [2, 1, 3], [3, 4, 2], [5, 4, 3]], [[0, 1], [1, 2], [2, 0], [3, 4], [4, 5]]]
)
def test_half_edges(cells):
    cells = np.array(cells, np.int32)
    start, ring = mesh.half_edges(cells, 6)
    expected = reference.neighbours(cells)
    assert [sorted(ring[start[v] : start[v + 1]].tolist()) for v in range(6)] == [sorted(s) for s in expected]


def test_faces_around():
    rng = np.random.default_rng(12)
    cells = np.array([rng.choice(9, 3, replace=False) for _ in range(14)], np.int32)  # of 10 vertices, one without
    start, face = mesh.faces_around(cells, 10)
    assert [face[start[v] : start[v + 1]].tolist() for v in range(10)] == [
        np.flatnonzero((cells == v).any(1)).tolist() for v in range(10)
    ]


TRIANGLES = {
    "acute": [[0, 0, 0], [1, 0, 0], [0.4, 0.9, 0]],
    "obtuse": [[0, 0, 0], [4, 0.3, 1], [1, 0.2, 0.1]],
    "needle": [[0, 0, 0], [1, 0, 0], [0.5, 1e-9, 0]],
    "on a line": [[0, 0, 0], [1, 0, 0], [2, 0, 0]],
    "on a line, back": [[0, 0, 0], [2, 0, 0], [1, 0, 0]],
    "two in one": [[0, 0, 0], [0, 0, 0], [1, 1, 0]],
    "a point": [[1, 1, 1], [1, 1, 1], [1, 1, 1]],
}


@pytest.mark.parametrize("corners", TRIANGLES.values(), ids=TRIANGLES.keys())
def test_barycentric(corners):
    """Every region of the plane: inside, beyond each edge and each corner; triangles without area too."""
    rng, corners, weights = np.random.default_rng(13), np.array(corners, float), np.empty(3)
    for p in np.concatenate([rng.normal(size=(200, 3), scale=2), corners, corners.mean(0)[None]]):
        squared = mesh.barycentric(p, *corners, weights)
        expected, apart = reference.closest_on_triangle(p, corners)
        assert weights.min() >= -1e-12 and weights.sum() == pytest.approx(1, abs=1e-12)
        assert squared == pytest.approx(apart, abs=1e-9)
        assert ((p - weights @ corners) ** 2).sum() == pytest.approx(apart, abs=1e-9)
        if np.linalg.norm(np.cross(corners[1] - corners[0], corners[2] - corners[0])) > 1e-3:
            assert np.allclose(weights, expected, atol=1e-9)


def bumpy(seed=14, n=7):
    """Points (n n + 1, 3) of a rough sheet in disorder, one of no face, and its triangles."""
    rng = np.random.default_rng(seed)
    x, y = (a.ravel().astype(float) for a in np.mgrid[:n, :n])
    points = np.stack([x, y, np.sin(x) * np.cos(y)], 1) + rng.normal(scale=0.2, size=(n * n, 3))
    i = np.arange(n * n).reshape(n, n)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    cells = rng.permutation(np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32))
    return np.concatenate([points, [[0, 0, 9.0]]]), cells


def test_nearest_on_faces():
    rng, (points, cells) = np.random.default_rng(15), bumpy()
    vertex = rng.integers(0, len(points), 60)
    queries = points[vertex] + rng.normal(scale=0.7, size=(60, 3))
    corners, weights = mesh.nearest_on_faces(
        queries, vertex, points, cells, *mesh.faces_around(cells, len(points))
    )  # fmt: skip
    assert (weights[vertex == len(points) - 1] == 0).all()
    for query, v, corner, weight in zip(queries, vertex, corners, weights, strict=True):
        around = cells[(cells == v).any(1)].tolist()
        if around:
            nearest = min(reference.closest_on_triangle(query, points[cell])[1] for cell in around)
            assert sorted(corner) in map(sorted, around)
            assert ((query - weight @ points[corner]) ** 2).sum() == pytest.approx(nearest, abs=1e-12)


def test_straight_walks():
    points, cells = bumpy()
    start, ring = mesh.half_edges(cells, len(points))
    walks, around = mesh.straight_walks(points, start, ring, 3), reference.neighbours(cells)
    for v in range(len(points) - 1):
        forth = [ring[start[v]]]
        back = [reference.straight_on(points, around, forth[0], v)]
        for way in (forth, back):
            while len(way) < 3:
                before = [v, *way][-2]
                way.append(-1 if way[-1] < 0 else reference.straight_on(points, around, before, way[-1]))
        assert walks[v].tolist() == [forth, back]
    assert (walks[-1] == -1).all()


@pytest.mark.parametrize("gap", [None, 0.4])
def test_entries_at_points(gap):
    """Beside one bank, or between two that face each other 0.4 voxels apart: one's own entry, never the other's."""
    ball = trimesh.creation.icosphere(2, radius=5.0)
    shells = [(1.0, 1)] if gap is None else [(1.0, -1), (1 + gap / 5, 1)]
    vertices = np.concatenate([np.array(ball.vertices) * size for size, _ in shells]) + 10
    cells = np.concatenate([np.array(ball.faces)[:, ::way] + k * 162 for k, (_, way) in enumerate(shells)])
    grid = Grid.from_spacing((21, 21, 21))
    band = band_around(refined(Mesh(vertices, cells), grid).surface, grid, 3.0)
    rng = np.random.default_rng(16)
    own = rng.integers(0, len(vertices), 150)
    ijk = band.surface.points[own] + rng.normal(scale=[[0.5], [1.0], [3.0]] * 50, size=(150, 3))
    found = SurfacePoints(band, ijk, own)
    expected = [reference.entry_at_point(band, x, v) for x, v in zip(ijk, own, strict=True)]
    assert {-1} < set(expected)
    nearest = band.surface.points[band.vertex[found.start]]
    asked = band.surface.points[band.vertex[expected]]
    assert np.array_equal(found.start < 0, np.array(expected) < 0)
    there = found.start >= 0
    assert np.allclose(*(np.linalg.norm(x - band.surface.points[own], axis=1)[there] for x in (nearest, asked)))
    at = np.stack(np.unravel_index(band.voxel[found.start], band.box_shape), 1)
    assert np.allclose((at + found.offset.T)[there], ijk[there], atol=1e-5)


@pytest.mark.parametrize("curvatures", [(0.1, 0.1), (0.15, -0.1), (0.2, 0.0), (-0.12, -0.05)])
def test_closest_points_on_a_quadric(curvatures):
    """The step is closed-form, so it is right to third order: a tenth of what the tangent plane is off by."""
    k1, k2 = curvatures
    shape, spacing = (3, 3, 9), np.array([1.0, 1.0, 1.0])
    frame = np.linalg.qr(np.random.default_rng(8).normal(size=(3, 3)))[0]
    frame[2] = np.cross(frame[0], frame[1])
    vertex = np.array([1.13, 0.91, 4.2])
    voxel = np.arange(81, dtype=np.int32)
    x = np.stack(np.unravel_index(voxel, shape), 1) - vertex
    x_own = x @ frame.T
    near = (np.abs(x_own[:, 2]) < 3.5) & (np.hypot(x_own[:, 0], x_own[:, 1]) < 1)
    normal, distance = sheets.closest_points(
        voxel, np.zeros(81, np.int32), shape, spacing, vertex[None], frame[2:], np.array([[k1, k2]]), frame[:1]
    )
    assert near.sum() > 10
    for e in np.flatnonzero(near):
        foot = reference.closest_on_quadric(x_own[e], k1, k2)
        outward = np.array([k1 * foot[0], k2 * foot[1], 1.0])
        outward /= np.linalg.norm(outward)
        assert abs(distance[e] - (x_own[e] - foot) @ outward) < 0.02
        assert np.linalg.norm(frame @ normal[:, e] - outward) < 0.03


def test_nowhere_to_keep_compiled_kernels_is_told():
    script = (
        "from numba.core import caching; caching.CacheImpl._locator_classes.clear();"
        "from beltrami_cli.cli import main; raise SystemExit(main(['denoise', '--flat', 'a.npy', '-o', 'b.npy']))"
    )
    run = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert run.returncode == 2
    assert run.stderr.startswith("beltrami: compiled kernels can be kept nowhere")
    assert run.stderr.rstrip().endswith("set NUMBA_CACHE_DIR to a folder that can be written to")
