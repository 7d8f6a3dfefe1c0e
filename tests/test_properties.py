"""What must hold for any data: symmetries of the grid and of the values, and freedom from what lies elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from beltrami_cli import denoise, phantoms

few = settings(max_examples=6)
seeds = st.integers(0, 2**31)
flows = st.sampled_from([
    {"beta": 0.05}, {"beta": 0.0}, {"flow": "l2"}, {"flow": "tv", "eps": 2.0}, {"flow": "l1", "eps": 5.0},
    {"flow": "phi", "phi": "weickert", "beta": 0.02}, {"flow": "phi", "phi": "geman-mcclure", "beta": 0.1},
])  # fmt: skip
schemes = st.sampled_from(["symmetric", "paper"])

BALL = phantoms.sphere(24, noise=0)
FOLD = phantoms.sulcus(24, gap=2.0, noise=0)


def random_data(seed, shape=(24, 24, 24)):
    return np.random.default_rng(seed).normal(100, 30, shape).astype(np.float32)


def run(data, psi=BALL.levelset, **options):
    return denoise(psi, data, **{"iterations": 12, **options}).data


@few
@given(seed=seeds, flow=flows, axes=st.permutations([0, 1, 2]), flips=st.sets(st.integers(0, 2)))
def test_flips_and_axis_permutations_commute(seed, flow, axes, flips):
    def turned(array):
        return np.ascontiguousarray(np.flip(array.transpose(axes), tuple(flips)))

    data = random_data(seed)
    first, second = turned(run(data, **flow)), run(turned(data), turned(BALL.levelset), **flow)
    # Nearest vertices that tie, and the triangulation's diagonals, may fall out differently.
    gap = np.abs(first - second)[np.abs(turned(BALL.levelset)) < 3]
    assert np.median(gap) < 1e-3
    assert gap.max() < 1.0


@few
@given(seed=seeds, flow=flows, scheme=schemes, constant=st.floats(-1000, 1000))
def test_a_constant_added_is_added(seed, flow, scheme, constant):
    data = random_data(seed)
    for psi in (BALL.levelset, FOLD.levelset):
        first = run(data, psi, scheme=scheme, **flow)
        second = run(data + np.float32(constant), psi, scheme=scheme, **flow) - np.float32(constant)
        assert np.nanmax(np.abs(first - second)) < 0.02


@few
@given(seed=seeds, scheme=schemes, scale=st.floats(0.01, 100), beta=st.floats(0, 1))
def test_data_and_slopes_scale_together(seed, scheme, scale, beta):
    data = random_data(seed)
    first = run(data, beta=beta, scheme=scheme)
    second = run(data * np.float32(scale), beta=beta / scale, scheme=scheme) / scale
    assert np.nanmax(np.abs(first - second)) < 0.02


@few
@given(seed=seeds, scheme=schemes, size=st.floats(0.3, 4), beta=st.floats(0, 0.2))
def test_space_and_time_scale_together(seed, scheme, size, beta):
    """Voxels `size` times as large, with beta (mm per unit) as much larger: the default dt follows."""
    data = random_data(seed)
    first = run(data, beta=beta, scheme=scheme)
    second = run(data, BALL.levelset * np.float32(size), beta=beta * size, scheme=scheme, spacing=size)
    assert np.nanmax(np.abs(first - second)[np.abs(BALL.levelset) < 3]) < 0.5
    assert np.nanmedian(np.abs(first - second)) < 1e-3


@few
@given(value=st.floats(-1e6, 1e6), flow=flows, scheme=schemes)
def test_constants_are_fixed(value, flow, scheme):
    got = run(np.full((24, 24, 24), value), FOLD.levelset, scheme=scheme, **flow)
    assert np.nanmax(np.abs(got - np.float32(value))) <= 1e-6 * abs(value)
    assert np.isfinite(got[np.abs(FOLD.levelset) < 3]).any()


@few
@given(seed=seeds, flow=flows, scheme=schemes, missing=st.floats(0, 0.5))
def test_values_stay_in_the_range_of_the_data(seed, flow, scheme, missing):
    data = random_data(seed)
    data[np.random.default_rng(seed + 1).random(data.shape) < missing] = np.nan
    got = run(data, FOLD.levelset, scheme=scheme, **flow)
    margin = 0.01 * (np.nanmax(data) - np.nanmin(data))
    assert np.nanmin(got) >= np.nanmin(data) - margin and np.nanmax(got) <= np.nanmax(data) + margin


@settings(max_examples=3)
@given(seed=seeds, flow=flows, before=st.integers(0, 9), after=st.integers(0, 9))
def test_empty_space_around_changes_nothing(seed, flow, before, after):
    """The band is clear of the faces: padding moves it within a larger volume, no more."""
    psi, data = phantoms.sphere(36, noise=0).levelset, random_data(seed, (36, 36, 36))
    wide = [(before, after), (after, 0), (0, before)]
    padded = run(np.pad(data, wide, constant_values=np.nan), np.pad(psi, wide, constant_values=9.0), **flow)
    back = padded[tuple(slice(a, n - b) for (a, b), n in zip(wide, padded.shape, strict=True))]
    assert np.array_equal(run(data, psi, **flow), back, equal_nan=True)


@pytest.mark.parametrize("scheme", ["symmetric", "paper"])
def test_widening_the_band_changes_little_at_the_surface(scheme):
    """Of a range of 255: the rim's missing neighbours are felt by 0.3 at most after 40 steps, by 0.02 in the median."""
    phantom = phantoms.sphere(48, noise=20)
    near = np.abs(phantom.levelset) < 0.5
    four, six = (
        run(phantom.noisy, phantom.levelset, beta=0.02, iterations=40, band=width, scheme=scheme)[near]
        for width in (4.0, 6.0)
    )
    gap = np.abs(four - six)
    assert gap.max() < 3 and np.median(gap) < 0.3


def test_the_number_of_threads_changes_nothing():
    psi = phantoms.torus(40).levelset
    data = random_data(3, (40, 40, 40))
    data[10:14] = np.nan
    one, two = (denoise(psi, data, beta=0.05, iterations=15, threads=n) for n in (1, 2))
    assert np.array_equal(one.data, two.data, equal_nan=True)
    assert np.array_equal(one.mesh.values, two.mesh.values, equal_nan=True)
    assert one.record["PerIteration"] == two.record["PerIteration"]


@pytest.mark.parametrize("dtype", [np.float64, np.float32, np.int16, np.uint8])
def test_any_real_type_of_data_will_do(dtype):
    data = np.round(random_data(1)).clip(0, 255).astype(dtype)
    assert np.array_equal(run(data, beta=0.05), run(data.astype(np.float32), beta=0.05), equal_nan=True)
    assert run(data).dtype == np.float32


def test_inputs_are_left_as_they_are():
    psi, data = BALL.levelset.copy(), random_data(2)
    data[12] = np.nan
    kept = data.copy()
    run(data, psi)
    assert np.array_equal(data, kept, equal_nan=True) and np.array_equal(psi, BALL.levelset)
