"""Values of every kind, holes, masks, weights, fidelity and depth: what `denoise` makes of them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from command import ball, noisy

from beltrami_cli import denoise
from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.phantoms import sphere, torus

SHAPE = (24, 24, 24)
RADIUS = 7.0
PSI = ball(SHAPE, RADIUS)
NEAR = np.abs(PSI) < 0.5
X = np.indices(SHAPE) - ((24 - 1) / 2 + 0.137)
DIRECTION = X / np.sqrt((X**2).sum(0))
WAVE = (100 + 60 * DIRECTION[0] * DIRECTION[1] + 30 * DIRECTION[2]).astype(np.float32)
NOISE = noisy(SHAPE, 0.0, 10.0)
AZIMUTH = np.degrees(np.arctan2(DIRECTION[1], DIRECTION[0])) % 360
HOLE = DIRECTION[0] > 0.8


def angular(a: np.ndarray, b: np.ndarray, period: float = 360.0) -> np.ndarray:
    return np.abs((np.asarray(a, float) - b + period / 2) % period - period / 2)


def angles(noise: float = 25.0, seed: int = 0) -> np.ndarray:
    return (AZIMUTH + noise * np.random.default_rng(seed).standard_normal(SHAPE)) % 360


def same(a: np.ndarray, b: np.ndarray) -> bool:
    return np.array_equal(a, b, equal_nan=True)


def with_hole(data: np.ndarray, hole: np.ndarray = HOLE) -> np.ndarray:
    out = data.copy()
    out[hole] = np.nan
    return out


# --- circular ---------------------------------------------------------------------------------------------------------

TURNS: list[dict[str, Any]] = [
    {},
    {"beta": 0.05, "extend_every": 2},
    {"beta": 0.05, "depth": (-2, 1)},
    {"stop": "auto"},
    {"beta": 0.02, "fidelity": 0.5, "scheme": "paper"},
    {"beta": 0.02, "extension": "pde"},
    {"flow": "tv", "eps": 5.0},
]


@pytest.mark.parametrize("options", TURNS, ids=str)
@pytest.mark.parametrize("turn", [90.0, 123.4])
def test_turning_all_angles_turns_the_result(options, turn):
    data, weights = with_hole(angles()), 0.2 + np.random.default_rng(1).random(SHAPE)
    first, other = (
        denoise(PSI, (data + by) % 360, weights=weights, kind="circular", period=360, precision="float64", **options)
        for by in (0.0, turn)
    )
    found = angular(other.data, first.data + turn)
    assert np.array_equal(np.isnan(first.data), np.isnan(other.data))
    assert np.nanmax(found) < 1e-6
    assert np.nanmax(angular(other.mesh.values, first.mesh.values + turn)) < 1e-6
    assert first.record["Noise"]["sd"] == pytest.approx(other.record["Noise"]["sd"])


@pytest.mark.parametrize("period, unit", [(360, 1.0), (2 * np.pi, np.pi / 180), ("2pi", np.pi / 180), (24, 24 / 360)])
def test_periods(period, unit):
    data = angles().astype(np.float32)
    degrees, other = (
        denoise(PSI, data * u, kind="circular", period=p, beta=0.05 / u) for u, p in ((1, 360), (unit, period))
    )
    assert np.nanmax(angular(other.data / unit, degrees.data)) < 0.01
    assert other.record["Values"]["range"] == pytest.approx([0, 360 * unit])
    assert other.record["Removed"]["rms"] == pytest.approx(degrees.record["Removed"]["rms"] * unit, rel=1e-3)


@pytest.mark.parametrize("low", [0.0, -180.0])
def test_range_is_the_inputs_own(low):
    data = ((angles() - low) % 360 + low).astype(np.float32)
    result = denoise(PSI, with_hole(data), kind="circular", period=360, beta=0.02)
    assert result.record["Values"] == {"channels": 2, "range": [low, low + 360]}
    for values in (result.data[np.isfinite(result.data)], result.mesh.values):
        assert low <= values.min() < low + 15 and low + 345 < values.max() < low + 360
    near = NEAR & ~HOLE & (np.hypot(*DIRECTION[:2]) > 0.5)
    assert np.median(angular(result.data[near], AZIMUTH[near])) < 0.3 * np.median(angular(data[near], AZIMUTH[near]))


def test_no_mean_of_both_ends_of_the_range():
    """Noise around 0, in 0..360, is taken neither for angles around 180 nor for a border."""
    data = (noisy(SHAPE, 0.0, 20.0) % 360).astype(np.float32)
    result = denoise(PSI, data, kind="circular", period=360, beta=0.001)
    assert angular(result.data[NEAR], 0).max() < 15
    assert angular(result.mesh.values, 0).max() < 15
    assert result.record["Noise"]["sd"] == [pytest.approx(20, rel=0.1)]


def test_more_than_a_period_is_said():
    result = denoise(PSI, 3 * AZIMUTH, kind="circular", period=360, beta=0.02)
    assert "more than one period of 360" in result.warnings[0]
    with pytest.raises(DataError, match="is --period in the unit of DATA"):
        denoise(PSI, 1e3 * AZIMUTH, kind="circular", period=360, beta=0.02)


# --- vectors ----------------------------------------------------------------------------------------------------------

OPTIONS: list[dict[str, Any]] = [
    {"beta": 0.1},
    {"flow": "l1"},
    {"stop": "auto"},
    {"beta": 0.1, "depth": (-1, 2), "fidelity": 0.1},
]


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_one_channel_is_a_scalar(options):
    data = with_hole(WAVE + NOISE)
    scalar = denoise(PSI, data, **options)
    vector = denoise(PSI, data[..., None], kind="vector", **options)
    assert vector.data.shape == (*SHAPE, 1)
    assert same(vector.data[..., 0], scalar.data)
    assert same(np.squeeze(vector.mesh.values), scalar.mesh.values)


COMPLEX = ((WAVE + NOISE) + 1j * (WAVE[::-1] - NOISE[::-1])).astype(np.complex64)


@pytest.mark.parametrize("options", [*OPTIONS, {"flow": "l2"}], ids=str)
def test_complex_data_are_two_channels(options):
    """But for overshoot, which is cut in length where the data are complex, and in each channel where they are not."""
    pair = np.stack([COMPLEX.real, COMPLEX.imag], -1)
    one, two = (denoise(PSI, d, kind="vector", extend_every=0, **options) for d in (COMPLEX, pair))
    assert one.data.shape == SHAPE and one.data.dtype == np.complex64
    seen = ~np.isnan(one.data)
    assert np.array_equal(seen, ~np.isnan(two.data).any(-1)) and seen[NEAR].all()
    off = np.abs(one.data[seen] - (two.data[seen, 0] + 1j * two.data[seen, 1]))
    assert (off == 0).mean() > 0.99 and off.max() < 1
    assert one.mesh.values.shape[1] == 2 and np.abs(one.mesh.values - two.mesh.values).max() < 3
    assert one.record["Values"]["channels"] == two.record["Values"]["channels"] == 2


@pytest.mark.parametrize("options", OPTIONS, ids=str)
def test_phase_of_complex_data_turns_with_the_result(options):
    turn = np.exp(1j * np.radians(123.4))
    first, other = (
        denoise(PSI, with_hole(COMPLEX).astype(np.complex128) * by, kind="vector", precision="float64", **options)
        for by in (1, turn)
    )
    assert np.nanmax(np.abs(other.data - first.data * turn)) < 1e-6 * np.nanmax(np.abs(first.data))


def test_frames_apart_are_scalar_runs():
    frames = np.stack([WAVE + NOISE, with_hole(100 - WAVE), 0.01 * NOISE], -1)
    apart = denoise(PSI, frames, kind="vector", independent=True, beta=0.1)
    assert apart.data.shape == frames.shape and apart.mesh.values.shape[1] == 3
    for t in range(3):
        alone = denoise(PSI, frames[..., t], beta=0.1)
        assert same(apart.data[..., t], alone.data) and same(apart.mesh.values[:, t], alone.mesh.values)
    assert apart.record["Frames"]["count"] == 3 and len(apart.record["Frames"]["noise_sd"]) == 3
    together = denoise(PSI, frames, kind="vector", beta=0.1)
    assert not np.allclose(together.data[NEAR], apart.data[NEAR], atol=1)


@pytest.mark.parametrize("empty", [0, 1, 2])
def test_a_frame_without_data_stays_missing(empty):
    frames = np.stack([WAVE + NOISE, WAVE - NOISE, 50 + NOISE], -1)
    frames[..., empty] = np.nan
    result = denoise(PSI, frames, kind="vector", independent=True, beta=0.1)
    assert np.isnan(result.data[..., empty]).all() and np.isnan(result.mesh.values[:, empty]).all()
    for t in {0, 1, 2} - {empty}:
        assert same(result.data[..., t], denoise(PSI, frames[..., t], beta=0.1).data)
    assert result.record["Frames"]["without_data"] == [empty]
    assert any("in 1 of 3 frames: no valid data" in line for line in result.warnings)


def test_a_voxel_missing_in_one_channel_is_missing_in_all():
    whole = np.stack([WAVE + NOISE, WAVE - NOISE], -1)
    one, both = whole.copy(), whole.copy()
    one[HOLE, 1] = np.nan
    both[HOLE] = np.nan
    first, other = (denoise(PSI, d, kind="vector", beta=0.1) for d in (one, both))
    assert same(first.data, other.data) and np.array_equal(first.filled, other.filled)


def test_an_edge_in_one_channel_is_shared():
    """A border that noise hides in one channel outlasts the flow where another channel shows it."""
    side = X[2] > 0
    weak, strong = (np.where(side, height, 0.0) + NOISE for height in (20.0, 200.0))
    alone = denoise(PSI, weak, beta=0.1, iterations=40).data
    shared = denoise(PSI, np.stack([weak, strong], -1), kind="vector", beta=0.1, iterations=40).data

    def jump(values: np.ndarray) -> float:
        above, below = (values[(np.abs(PSI) < 1) & (X[2] > low) & (X[2] < low + 1)].mean() for low in (0, -1))
        return float(above - below)

    assert jump(alone) < 10 < 15 < jump(shared[..., 0])


@pytest.mark.parametrize("mode, value", [("keep", None), ("zero", 0.0), ("nan", np.nan)])
@pytest.mark.parametrize("shape", ["real", "complex", "frames"])
def test_outside_the_band(mode, value, shape):
    data = np.stack([WAVE + NOISE, WAVE - NOISE], -1)
    data = data[..., 0] + 1j * data[..., 1] if shape == "complex" else data
    result = denoise(PSI, data, kind="vector", independent=shape == "frames", beta=0.1, band=2.0, outside=mode)
    far = np.abs(PSI) > 2.1
    expected = data[far].astype(result.data.dtype) if mode == "keep" else np.full_like(result.data[far], value)
    assert same(result.data[far], expected)
    assert not np.allclose(result.data[NEAR], data[NEAR])


# --- missing data -----------------------------------------------------------------------------------------------------


def test_three_ways_to_say_missing():
    data = WAVE + NOISE
    expected = denoise(PSI, with_hole(data), beta=0.1)
    by_value = denoise(PSI, np.where(HOLE, -1, data), missing=-1, beta=0.1)
    by_mask = denoise(PSI, data, mask=~HOLE, beta=0.1)
    by_weights = denoise(PSI, data, weights=(~HOLE).astype(float), beta=0.1)
    for result in (by_value, by_mask, by_weights):
        assert same(result.data, expected.data)
        assert np.array_equal(result.filled, expected.filled)


def test_nan_in_a_mask_does_not_count():
    data = WAVE + NOISE
    mask = np.where(HOLE, np.nan, 3.0)
    assert same(denoise(PSI, data, mask=mask, beta=0.1).data, denoise(PSI, with_hole(data), beta=0.1).data)


@pytest.mark.parametrize("name", ["mask", "weights"])
def test_nothing_counts(name):
    with pytest.raises(DataError, match=f"{name}: found 0 everywhere"):
        denoise(PSI, WAVE, **{name: np.zeros(SHAPE)})


def test_missing_everywhere():
    with pytest.raises(DataError, match="found only NaN"):
        denoise(PSI, np.full(SHAPE, 7.0), missing=7)


def test_filled_is_where_no_data_were_and_is_counted():
    result = denoise(PSI, with_hole(WAVE + NOISE), beta=0.1)
    deep = DIRECTION[0] > 0.9
    assert result.filled.dtype == bool and result.filled.shape == SHAPE
    assert result.filled[deep & NEAR].all() and not result.filled[(DIRECTION[0] < 0.7) & NEAR].any()
    assert np.isfinite(result.data[result.filled]).all()
    assert result.record["Band"]["filled_voxels"] == result.filled.sum()
    assert result.record["Band"]["missing_voxels"] == 0
    assert np.abs(result.data - WAVE)[deep & NEAR].max() < 20


@pytest.mark.parametrize("kind", ["scalar", "circular", "vector"])
def test_fill_ends_so_many_millimetres_from_data(kind):
    data = {"scalar": WAVE + NOISE, "circular": angles(), "vector": np.stack([WAVE, NOISE], -1)}[kind]
    options = {"kind": kind, "beta": 0.1} | ({"period": 360} if kind == "circular" else {})
    hole = DIRECTION[0] > 0.3  # its middle is 9 mm from the rim
    runs = {fill: denoise(PSI, with_hole(data, hole), fill=fill, **options) for fill in (None, 0, 3.0)}
    whole = runs[None]
    assert not np.isnan(whole.data[NEAR]).any()
    into = RADIUS * (np.arccos(0.3) - np.arccos(DIRECTION[0]))  # mm along the surface from the rim into the hole
    for fill in (0, 3.0):
        found = runs[fill]
        lost = np.isnan(found.data.reshape(*SHAPE, -1)).all(-1)
        assert same(found.data[~lost], whole.data[~lost])
        assert lost[NEAR & (into > fill + 1.5)].all() and not lost[NEAR & (into < fill - 1.5)].any()
        assert not (found.filled & lost).any() and np.array_equal(found.filled, whole.filled & ~lost)
        band = found.record["Band"]
        assert band["filled_voxels"] == found.filled.sum()
        assert band["filled_voxels"] + band["missing_voxels"] == whole.record["Band"]["filled_voxels"]
        at_vertices = np.isnan(found.mesh.values.reshape(len(found.mesh.vertices_ras_mm), -1)).all(-1)
        assert at_vertices.mean() == pytest.approx({0: 0.31, 3.0: 0.14}[fill], abs=0.03)
    assert into[runs[0].filled].max() < 1 < 2 < into[runs[3.0].filled].max() < 4


@pytest.mark.parametrize("noise", [0.0, 10.0])
@pytest.mark.parametrize("name", ["linear", "harmonic", "oblique"])
def test_half_the_surface_missing_leaves_no_rim(name, noise):
    """Along and across the rim, and within the hole, neighbours differ by no more than among the data; all in range."""
    made = sphere(36)
    x = np.indices(made.levelset.shape) - ((36 - 1) / 2 - 0.137)
    d = x / np.sqrt((x**2).sum(0))
    clean = {"linear": d[0], "harmonic": 1.5 * d[0] ** 2 - 0.5, "oblique": (d[0] + d[2]) / 2}[name]
    hole = d[2] > 0
    data = np.where(hole, np.nan, 100 * clean + noise * noisy(hole.shape, 0.0, 1.0))
    result = denoise(made.levelset, data, beta=0.02)
    near = np.abs(made.levelset) < 1
    assert np.nanmin(data) <= result.data[near].min() and result.data[near].max() <= np.nanmax(data)
    assert result.filled[near & (d[2] > 0.1)].all() and not result.filled[near & (d[2] < -0.1)].any()
    for axis in range(3):
        first, second = (np.take(d[2], range(k, 35 + k), axis) for k in (0, 1))
        both = np.all([np.take(near, range(k, 35 + k), axis) for k in (0, 1)], axis=0)
        jump = np.abs(np.diff(result.data.astype(float), axis=axis))
        among_data = jump[both & (np.maximum(first, second) < -0.1)].max()
        at_rim, within = both & (np.minimum(np.abs(first), np.abs(second)) < 0.1), both & (first > 0.1) & (second > 0.1)
        assert jump[at_rim].max() <= 1.5 * among_data
        assert jump[within].max() <= 1.5 * among_data


# --- constants --------------------------------------------------------------------------------------------------------

CONSTANTS: dict[str, tuple[Any, dict[str, Any]]] = {
    "scalar": (np.float32(7.7), {}),
    "end of the turn": (np.float32(359.9), {"kind": "circular", "period": 360}),
    "below 0": (np.float32(-179.9), {"kind": "circular", "period": 360}),
    "complex": (np.complex64(3 - 4j), {"kind": "vector"}),
    "colour": (np.array([255, 0, 17.5], np.float32), {"kind": "vector"}),
    "frames": (np.array([255, 0, 17.5], np.float32), {"kind": "vector", "independent": True}),
}
WAYS: dict[str, dict[str, Any]] = {
    "default": {},
    "given": {"beta": 0.3},
    "pde": {"beta": 0.3, "extension": "pde"},
    "depth": {"beta": 0.3, "depth": (-2, 2)},
    "fidelity": {"beta": 0.3, "fidelity": 3.0},
    "automatic": {"flow": "auto"},
}


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", CONSTANTS)
def test_constants_stay(name, way):
    value, options = CONSTANTS[name]
    psi = ball()
    data = np.broadcast_to(value, (*psi.shape, *np.shape(value))).copy()
    data[np.indices(psi.shape)[0] > 10] = np.nan
    weights = np.random.default_rng(0).random(psi.shape)
    result = denoise(psi, data, weights=weights, **options, **WAYS[way])
    seen = result.data[np.abs(psi) < 2]
    off = angular(seen, value) if "period" in options else np.abs(seen - value)
    assert off.max() <= 3e-6 * np.abs(value).max() * (20 if "period" in options else 1)


# --- weights, fidelity, depth -----------------------------------------------------------------------------------------


def test_weights_below_0():
    weights = np.ones(SHAPE)
    weights[NEAR] = -1.1e-3
    with pytest.raises(RefusedError, match=r"weights: found values down to -0.0011; expected 0 or more"):
        denoise(PSI, WAVE, weights=weights)
    weights[NEAR] = -0.9e-3
    result = denoise(PSI, WAVE, weights=weights, beta=0.1)
    assert result.warnings[0] == "weights: values down to -0.0009 taken as 0"
    assert same(result.data, denoise(PSI, WAVE, weights=np.maximum(weights, 0), beta=0.1).data)


def test_scale_of_the_weights_does_not_matter():
    weights = np.random.default_rng(0).random(SHAPE)
    first, other = (denoise(PSI, WAVE + NOISE, weights=w, beta=0.1, fidelity=0.2) for w in (weights, 64 * weights))
    assert same(first.data, other.data)


def test_nan_as_weight_is_none():
    weights = np.random.default_rng(0).random(SHAPE)
    first, other = (denoise(PSI, WAVE + NOISE, weights=np.where(HOLE, w, weights), beta=0.1) for w in (np.nan, 0.0))
    assert same(first.data, other.data) and first.filled.any()


def test_weights_count():
    """Half of the voxels are worthless: told by weights of 1/variance, they do little harm."""
    random = np.random.default_rng(3)
    poor = random.random(SHAPE) < 0.5
    data = WAVE + np.where(poor, 60, 6) * random.standard_normal(SHAPE)
    blind, told = (denoise(PSI, data, weights=w, flow="l2", iterations=4) for w in (None, np.where(poor, 0.01, 1.0)))
    errors = [np.sqrt(np.mean((r.data - WAVE)[NEAR] ** 2)) for r in (blind, told)]
    assert errors[1] < 0.6 * errors[0]


def test_fidelity():
    data = WAVE + NOISE
    options: dict[str, Any] = {"beta": 0.02, "extend_every": 0}
    start = denoise(PSI, data, iterations=0)
    free, none, some, much = (denoise(PSI, data, fidelity=f, **options) for f in (None, 0, 0.5, 1e9))
    assert same(free.data, none.data)
    assert np.nanmax(np.abs(much.data - start.data)) < 1e-3
    moved = [np.sqrt(np.mean((r.data - start.data)[NEAR] ** 2)) for r in (free, some, much)]
    assert moved[0] > 1.3 * moved[1] > 100 * moved[2]


def test_fidelity_makes_long_runs_end():
    """Where the pull and the flow balance nothing moves any more, but for what the last re-extension smooths."""
    first, longer = (denoise(PSI, WAVE + NOISE, beta=0.02, fidelity=1.0, iterations=n) for n in (100, 200))
    assert np.nanmax(np.abs(first.data - longer.data)) < 0.01
    pulled = denoise(PSI, WAVE + NOISE, beta=0.02, fidelity=1e9, iterations=100)
    start = denoise(PSI, WAVE + NOISE, iterations=0)
    assert np.sqrt(np.mean((pulled.data - start.data)[NEAR] ** 2)) < 1.5  # of noise of 10


def test_fidelity_leaves_holes_to_the_flow():
    result, start = (
        denoise(PSI, with_hole(WAVE + NOISE), flow="l2", fidelity=1e9, iterations=count, extend_every=0)
        for count in (60, 0)
    )
    moved = np.abs(result.data - start.data)
    assert moved[NEAR & ~start.filled].max() < 1e-3 < 0.1 < moved[NEAR & (DIRECTION[0] > 0.9)].max()


def test_depth_averages_noise():
    errors = []
    for depth in (None, (-1, 1), (-3, 3)):
        result = denoise(PSI, WAVE + NOISE, depth=depth, iterations=0)
        errors.append(float(np.sqrt(np.mean((result.data - WAVE)[NEAR] ** 2))))
    assert errors[0] > 1.15 * errors[1] > 1.15**2 * errors[2] and errors[2] < 4


@pytest.mark.parametrize("sign, depth", [(1, (0, 2)), (-1, (-2, 0))])
def test_depth_of_data_painted_on_one_side(sign, depth):
    painted = np.where((sign * PSI > -0.5) & (sign * PSI < 3.5), WAVE + NOISE, np.nan)
    near = NEAR & (sign * PSI > 0)
    shallow, deep = (denoise(PSI, painted, depth=d, iterations=0) for d in ((0, 0), depth))
    errors = [float(np.sqrt(np.mean((r.data - WAVE)[near] ** 2))) for r in (shallow, deep)]
    assert errors[1] < 0.75 * errors[0]
    assert np.isfinite(deep.data[NEAR]).all() and not deep.filled[NEAR].any()


def test_depth_by_millimetres():
    wide, fine = (
        denoise(PSI * s, WAVE + NOISE, spacing=s, depth=(-2 * s, 1 * s), iterations=0).data for s in (1.0, 0.5)
    )
    assert np.nanmax(np.abs(wide - fine)) < 1e-3


def test_edge_is_the_inverse_of_beta():
    by_edge, by_beta = denoise(PSI, WAVE + NOISE, edge=8.0), denoise(PSI, WAVE + NOISE, beta=0.125)
    assert same(by_edge.data, by_beta.data)
    assert by_edge.record["Parameters"]["edge"] == 8.0 and by_beta.record["Parameters"]["edge"] is None


# --- colours ----------------------------------------------------------------------------------------------------------


def test_colours_keep_common_edges():
    """With one diffusivity for all, every colour gains by what the others show, the one of low contrast most."""
    made = torus(32, map="pieces", noise=0.0)
    near = np.abs(made.levelset) < 0.5
    clean = np.stack([made.clean, 0.3 * made.clean, 255 - made.clean], -1)
    data = clean + 30 * np.random.default_rng(0).standard_normal(clean.shape)
    runs = (denoise(made.levelset, data, kind="vector", independent=i, flow="phi", stop="auto") for i in (True, False))
    apart, together = (np.sqrt(np.mean((r.data - clean)[near] ** 2, axis=0)) for r in runs)
    assert (together / apart).max() < 0.97 and together[1] / apart[1] < 0.9


# --- shapes -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "data, options, word",
    [
        (WAVE[1:], {}, "one shape"),
        (WAVE[..., None], {}, "kind='vector'"),
        (WAVE + 1j, {}, "kind='vector'"),
        (WAVE + 1j, {"kind": "circular", "period": 360}, "kind='vector'"),
        (np.stack([WAVE] * 2, 0), {"kind": "vector"}, "one shape"),
        (np.zeros((*SHAPE, 2, 2)), {"kind": "vector"}, "one shape"),
        (WAVE, {"kind": "vector", "independent": True}, "several frames"),
        (WAVE + 1j, {"kind": "vector", "independent": True}, "several frames"),
        (WAVE, {"weights": np.ones(SHAPE[1:])}, "weights: found the shape"),
        (WAVE, {"weights": np.ones((*SHAPE, 2))}, "weights: found the shape"),
        (WAVE, {"weights": np.ones(SHAPE) * 1j}, "real numbers"),
        (WAVE, {"mask": np.ones((24, 24, 23))}, "mask: found the shape"),
        (WAVE, {"mask": "mask.nii"}, "mask: found"),
    ],
)
def test_shapes_that_do_not_fit(data, options, word):
    with pytest.raises(RefusedError, match=word) as caught:
        denoise(PSI, data, **options)
    assert len(str(caught.value).splitlines()) == 1


# --- what must not count ----------------------------------------------------------------------------------------------


def test_angles_outside_the_mask_decide_neither_range_nor_period():
    angle = np.where(NEAR, 180 + 100 * DIRECTION[0] + NOISE, -99999.0)
    result = denoise(PSI, angle, mask=NEAR, kind="circular", period=360, beta=0.05)
    assert result.record["Values"]["range"] == [0, 360] and result.warnings == ()
    assert np.nanmin(result.data) >= 0 and np.nanmax(result.data) < 360


def test_infinite_weights_are_refused():
    with pytest.raises(RefusedError, match="infinite values; expected finite ones"):
        denoise(PSI, WAVE, weights=np.where(DIRECTION[0] > 0, np.inf, 1.0))


def test_every_frame_has_its_own_noise():
    random = np.random.default_rng(3)
    frames = np.stack([WAVE + sd * random.standard_normal(SHAPE) for sd in (2, 20, 5)], -1)
    result = denoise(PSI, frames, kind="vector", independent=True, stop="discrepancy", beta=0.02)
    found = result.record["Frames"]
    assert found["noise_sd"] == pytest.approx([2, 20, 5], rel=0.2)
    assert found["removed_rms"] == pytest.approx(found["noise_sd"], rel=0.25)
    assert found["iterations"][1] > found["iterations"][0]


def test_a_constant_frame_chooses_nothing_for_the_others():
    frames = np.stack([WAVE + NOISE, 0 * WAVE, WAVE - NOISE], -1)
    result = denoise(PSI, frames, kind="vector", independent=True, stop="auto")
    assert result.record["Frames"]["chosen_on"] == 2 and result.record["Iterations"] > 0


def test_discrepancy_that_is_never_reached_is_told():
    result = denoise(PSI, WAVE + NOISE, flow="l2", stop="discrepancy", noise_sigma=1e6)
    assert result.record["StopReason"] == "iterations" and result.record["Iterations"] == 1000
    assert "less is removed than the noise" in result.warnings[0]


def test_gross_outliers_in_a_channel_do_not_stall_the_choice():
    random = np.random.default_rng(0)
    data = np.stack([WAVE + NOISE, WAVE - NOISE], -1)
    data[random.random(SHAPE) < 0.02] = 5000
    result = denoise(PSI, data, kind="vector", stop="auto")
    tried = sum(row["iterations_tried"] for row in result.record["Choice"]["table"])
    assert result.record["PerIteration"]["most_substeps"] <= 64 and tried < 20_000
    assert np.isfinite(result.data[NEAR]).all()


def test_a_constant_frame_does_not_stop_a_series_under_discrepancy():
    frames = np.stack([WAVE + NOISE, WAVE - NOISE, 0 * WAVE], -1)
    result = denoise(PSI, frames, kind="vector", independent=True, stop="discrepancy", beta=0.02)
    assert result.record["Frames"]["iterations"][2] == 0 and (result.data[NEAR][:, 2] == 0).all()
    assert result.record["Frames"]["iterations"][0] > 0
