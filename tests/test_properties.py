"""What must hold for any data: symmetries of the grid and of the values, and freedom from what lies elsewhere."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from test_band import band_of

from beltrami_cli import denoise, phantoms
from beltrami_cli.extension import EXTENSIONS, Reextension, extend, own_samples
from beltrami_cli.flows import FLOWS, SCHEMES, Flow, Stepper
from beltrami_cli.sampling import surface_mesh

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


# --- angles: nothing may depend on where 0 is -------------------------------------------------------------------------


def course(own, known, flow, method, turns):
    """Channels (2, E) at the band's entries and at its mesh's vertices after 30 steps, from samples with a hole."""
    start = extend(BAND, np.where(known, own, np.nan), known.astype(own.dtype), method, turns=turns)
    step, again = Stepper(flow, BAND, own.dtype, 2), Reextension(BAND, turns=turns)
    u, out = start.values.copy(), np.empty_like(own)
    for k in range(30):
        step(u, out, 0.5, 0.15)
        u, out = out, u
        if k % 5 == 4:
            again(u, out)
            u, out = out, u
    at_vertices = surface_mesh(BAND, u, turns=turns)[1]
    assert at_vertices is not None and np.isfinite(at_vertices).all()
    return u, at_vertices


def off_by(flow, method, dtype, turns=True, by=1.234):
    """The most that turning the angles first and turning the results differ by: channels, degrees at the vertices."""
    rng = np.random.default_rng(12)
    angle = rng.normal(0.1 * BAND.gather(np.indices(BAND.grid.shape)[0]), 0.8)
    known = BAND.gather(np.indices(BAND.grid.shape)[2]) < 15
    turn = np.array([[np.cos(by), -np.sin(by)], [np.sin(by), np.cos(by)]])
    (first, at_first), (second, at_second) = (
        course(np.stack([np.cos(a), np.sin(a)]).astype(dtype), known, flow, method, turns) for a in (angle, angle + by)
    )
    x, y = (at[0].astype(complex) + 1j * at[1] for at in (at_first, at_second))
    return np.abs(turn @ first - second).max(), np.degrees(np.abs(np.angle(y / x * np.exp(-1j * by)))).max()


BAND = band_of(BALL.levelset)


@pytest.mark.parametrize(("dtype", "channels", "degrees"), [(np.float64, 1e-12, 1e-9), (np.float32, 2e-6, 2e-3)])
@pytest.mark.parametrize("method", EXTENSIONS)
@pytest.mark.parametrize("name", FLOWS)
def test_turned_angles_give_turned_results(name, method, dtype, channels, degrees):
    for scheme in SCHEMES:
        apart, turned = off_by(Flow(name, scheme=scheme), method, dtype)
        assert apart < channels and turned < degrees


def test_bounds_of_each_channel_would_not_turn():
    apart, turned = off_by(Flow(), "closest-point", np.float64, turns=False)
    assert apart > 1e-5 and turned > 1e-3


@few
@given(
    seed=seeds, flow=flows, scheme=schemes, extension=st.sampled_from(EXTENSIONS),
    period=st.sampled_from([360.0, 2 * np.pi, 24.0]), by=st.floats(0, 1), depth=st.sampled_from([None, (-1.0, 1.5)]),
)  # fmt: skip
def test_turned_angles_give_turned_volumes(seed, flow, scheme, extension, period, by, depth):
    rng = np.random.default_rng(seed)
    data = rng.uniform(0, period, (24, 24, 24)) / 2 + rng.uniform(0, period) / 2
    data[rng.random(data.shape) < 0.2] = np.nan
    options = {"kind": "circular", "period": period, "precision": "float64", "scheme": scheme, "extension": extension}
    if extension == "closest-point":
        options["depth"] = depth
    turned = (data + by * period) % period
    first, second = (run(d, FOLD.levelset, **options, **flow) for d in (data, turned))
    assert np.nanmin(second) >= 0 and np.nanmax(second) < period
    gap = (second - first - by * period + period / 2) % period - period / 2
    assert np.array_equal(np.isnan(first), np.isnan(second))
    assert np.nanmax(np.abs(gap)) < 1e-6 * period


@pytest.mark.parametrize("options", [{"kind": "circular", "period": 360.0}, {"kind": "vector"}])
def test_constants_are_fixed_whatever_the_kind(options):
    values = (
        np.full((24, 24, 24), 359.9) if options["kind"] == "circular" else np.tile([3.0, -1e4, 0.0], (24, 24, 24, 1))
    )
    got = run(values, FOLD.levelset, beta=0.05, **options)
    apart = np.abs(got - values)
    assert np.nanmax(apart / np.maximum(np.abs(values), 1)) < 1e-5 and np.isfinite(got).any()


# --- channels: coupled, and yet each on its own scale -----------------------------------------------------------------


@few
@given(seed=seeds, beta=st.floats(0.001, 3), scales=st.sampled_from([(1, 1), (1, 10, 100), (0.1, 1, 10, 1, 0.1)]))
def test_coupled_channels_stay_in_their_ranges(seed, beta, scales):
    data = np.random.default_rng(seed).normal(5, scales, (24, 24, 24, len(scales)))
    got = run(data, FOLD.levelset, kind="vector", beta=beta, iterations=5)
    margin = 0.01 * np.ptp(data, axis=(0, 1, 2))
    assert np.all(np.nanmin(got, (0, 1, 2)) >= data.min((0, 1, 2)) - margin)
    assert np.all(np.nanmax(got, (0, 1, 2)) <= data.max((0, 1, 2)) + margin)


@few
@given(seed=seeds, scheme=schemes, beta=st.floats(0, 3), by=st.floats(0, 2 * np.pi))
def test_a_complex_field_turned_gives_the_result_turned(seed, scheme, beta, by):
    """Without re-extension, which keeps the real and the imaginary part in a range each."""
    rng = np.random.default_rng(seed)
    field = rng.normal(3, 1, FOLD.levelset.shape) + 1j * rng.normal(0, 1, FOLD.levelset.shape)
    options = {"kind": "vector", "beta": beta, "scheme": scheme, "extend_every": 0, "precision": "float64"}
    first, second = (run(x, FOLD.levelset, **options) for x in (field, field * np.exp(1j * by)))
    assert np.nanmax(np.abs(first * np.exp(1j * by) - second)) < 1e-10
    assert np.nanstd(first) > 0.05


def test_without_extension_every_voxel_keeps_its_own():
    """Those midway between two banks too, which feed neither where data are carried to the surface."""
    psi, data = phantoms.sulcus(24, gap=1.5, noise=0).levelset, random_data(4)
    band = band_of(psi)
    own, every = (own_samples(band, band.gather(data)[None], every=every)[0, band.primary] for every in (False, True))
    assert np.isnan(own).sum() > 100 and np.array_equal(every, band.gather(data)[band.primary])
    kept = run(data, psi, extension="none", iterations=0)
    assert np.array_equal(kept[np.abs(psi) < 3], data[np.abs(psi) < 3])
