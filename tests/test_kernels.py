"""Every kernel against its plain NumPy twin, on small random bands with missing links."""

from __future__ import annotations

import numpy as np
import pytest
import reference

from beltrami_cli.kernels import extend, interpolate, mesh, sheets, steps

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


def take_step(kernel, u, normal, forward, backward, spacing, law, outer, beta, dt):
    out, work = np.empty_like(u), np.empty((7, len(u)), u.dtype)
    squares, energy = kernel(
        u, normal.astype(u.dtype), forward, backward, np.array(spacing, u.dtype), law, outer, beta, dt, work, out
    )
    return out, squares, energy


@pytest.mark.parametrize("precision", [np.float32, np.float64])
@pytest.mark.parametrize("spacing", SPACINGS)
@pytest.mark.parametrize("outer", [True, False])
@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("name", ["symmetric", "paper"])
def test_step(name, law, outer, spacing, precision):
    rng = np.random.default_rng(law)
    forward, backward, entry = random_links(rng)
    u, normal = rng.normal(size=entry.max() + 1), unit(rng.normal(size=(3, entry.max() + 1)))
    arguments = (normal, forward, backward, spacing, law, outer, 0.8, 0.1)
    got = take_step(getattr(steps, name), u.astype(precision), *arguments)
    for value, expected in zip(got, getattr(reference, name)(u, *arguments), strict=True):
        assert np.allclose(value, expected, rtol=ROUNDING[precision], atol=ROUNDING[precision])


@pytest.mark.parametrize("law", LAWS)
def test_mean_over_eight_choices_is_the_flux_form(law):
    rng = np.random.default_rng(10 + law)
    forward, backward, entry = random_links(rng)
    u, normal = rng.normal(size=entry.max() + 1), unit(rng.normal(size=(3, entry.max() + 1)))
    arguments = (u, normal, forward, backward, SPACINGS[1], law, True, 0.8, 0.1)
    assert np.allclose(reference.symmetric(*arguments)[0], reference.symmetric_by_fluxes(*arguments), atol=1e-13)


def diffusivity(law, slopes):
    """c at each beta |v|, from the energy c |v|^2 / 2 of two linked entries."""
    forward, backward = np.array([[1, 1], [0, 1], [0, 1]], np.int32), np.array([[0, 0], [0, 1], [0, 1]], np.int32)

    def energy(s):
        return take_step(
            steps.paper, np.array([0, s]), np.zeros((3, 2)), forward, backward, (1.0, 1.0, 1.0), law, False, 1.0, 0.1
        )[2]

    return np.array([2 * energy(s) / s**2 for s in slopes])


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
    u = rng.normal(size=entry.max() + 1)
    normal = unit(rng.normal(size=(3, entry.max() + 1)) * [[1], [1], [0]])
    arguments = (normal, forward, backward, (1.0, 1.5, 1.0), steps.R, True, 0.8, 0.1)
    got = take_step(steps.symmetric, u, *arguments)[0]
    assert np.allclose(got, reference.symmetric(u, *arguments)[0], atol=1e-13)
    other = take_step(steps.symmetric, u, *arguments[:3], (1.0, 1.5, 77.0), *arguments[4:])[0]
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
    got = np.full(len(start), np.nan, np.float32)
    interpolate.cubic(volume[entry >= 0].astype(np.float32), origin, offset, forward, nodes, got)
    return got, np.array([reference.cubic_at(volume, p) for p in (voxel + offset).T])


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
        got = np.empty(61)
        interpolate.cubic(np.repeat(u, 16), origin, offset, forward, (4, 4, 4), got)
        t = 1 + offset[0]
        if u.max() > 1:
            inside = (t < 1.9) | (t > 3)  # elsewhere the cubic's own turning point lies above its cell's nodes
            assert np.allclose(got[inside], expected(t)[inside], rtol=1e-6, atol=1e-5)
        assert got.min() >= u.min() and got.max() <= u.max()


@pytest.mark.parametrize("least", [0.0, 0.125, 0.5])
def test_linear(least):
    rng = np.random.default_rng(3)
    forward, backward, entry = random_links(rng)
    u = np.where(rng.random(entry.max() + 1) < 0.2, np.nan, rng.normal(size=entry.max() + 1)).astype(np.float32)
    start = rng.integers(0, len(u), 500).astype(np.int32)
    offset = rng.uniform(-2.5, 2.5, (3, 500)).astype(np.float32)
    offset[:, :50] = np.round(offset[:, :50])
    got = np.full(500, -99, np.float32)
    interpolate.linear(u, start, offset, forward, backward, least, got)
    for m in range(500):
        expected = reference.linear_at(u, start[m], offset[:, m].astype(float), forward, backward, least)
        assert got[m] == -99 if expected is None else abs(got[m] - expected) < 1e-5


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
    u = np.where(rng.random(count) < 0.9, np.nan, rng.normal(size=count)).astype(np.float32)
    expected = reference.flood(u, forward, backward)
    assert 0 < np.isnan(expected).sum() < np.isnan(u).sum()
    extend.flood(u, forward, backward)
    assert np.allclose(u, expected, atol=1e-6, equal_nan=True)


# --- geometry ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "cells", [[[0, 1, 2], [2, 1, 3], [3, 4, 2], [5, 4, 3]], [[0, 1], [1, 2], [2, 0], [3, 4], [4, 5]]]
)
def test_half_edges(cells):
    cells = np.array(cells, np.int32)
    start, ring = mesh.half_edges(cells, 6)
    expected = reference.neighbours(cells)
    assert [sorted(ring[start[v] : start[v + 1]].tolist()) for v in range(6)] == [sorted(s) for s in expected]


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
