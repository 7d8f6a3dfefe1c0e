"""Choosing with the data: what is held out, the search over beta, how near to the best it comes, and when it warns."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from command import ball, noisy
from scipy.ndimage import gaussian_filter

from beltrami_cli import Result, denoise
from beltrami_cli.band import Band, build_band
from beltrami_cli.config import STOPS
from beltrami_cli.course import Course
from beltrami_cli.errors import DataError
from beltrami_cli.evolve import Schedule
from beltrami_cli.extension import own_samples
from beltrami_cli.flows import Flow, typical_slope
from beltrami_cli.grid import Grid
from beltrami_cli.kinds import Kind
from beltrami_cli.observed import NEAR_SHARE, SHELL_SHARE, AtVoxels
from beltrami_cli.phantoms import Phantom, torus
from beltrami_cli.tuning import LAST_STEP, LEAST_HELD, SEARCH_RANGE, hold_out, search

DT = 0.15  # mm^2, the default on voxels of 1 mm
CASES = [(map_, sigma) for map_ in ("smooth", "pieces", "mixed") for sigma in (10.0, 20.0, 40.0)]
WITH_EDGES = [(map_, sigma) for map_ in ("pieces", "mixed") for sigma in (20.0, 40.0)]
SHARES = 2.0 ** np.arange(-4, 3)  # beta times the data's slope
# On these maps the best betas lie within, or so far below that the flow is that of l2.
FINE_SHARES = 2.0 ** np.array([-4, -1, -0.5, 0, 0.5, 1, 1.5])


@cache
def scene(map_: str, sigma: float) -> Phantom:
    return torus(64, map=map_, noise=sigma)


@cache
def automatic(map_: str, sigma: float, flow: str = "beltrami") -> Result:
    made = scene(map_, sigma)
    return denoise(made.levelset, made.noisy, flow=flow, stop="auto")


def psnr(error: np.ndarray) -> float:
    return float(20 * np.log10(255 / np.sqrt(np.mean(error.astype(float) ** 2))))


def quality(made: Phantom, data: np.ndarray) -> float:
    """PSNR in dB on the voxels that the surface passes through."""
    near = np.abs(made.levelset) < 0.5
    return psnr(data[near] - made.clean[near])


class Bench:
    """Runs of flows on a phantom's whole data, scored after every iteration as `quality` does."""

    def __init__(self, made: Phantom) -> None:
        self.band = build_band(made.levelset, made.grid, 4.0)
        own = own_samples(self.band, self.band.gather(made.noisy)[None])
        self.course = Course(self.band, Kind(), DT)
        self.start = AtVoxels(self.band, Kind(), own, (~np.isnan(own[0])).astype(own.dtype)).start()
        self.slope = typical_slope(self.band, self.start.values, self.start.known)
        primary = self.band.primary
        self.near = primary[np.abs(self.band.gather(made.levelset)[primary]) < 0.5]
        self.clean = self.band.gather(made.clean)[self.near]

    def curve(self, flow: Flow, beta: float, most: int, *, to_end: bool = False) -> list[float]:
        """dB after 0, 1 ... iterations, until well past the best or to the end."""
        found: list[float] = []

        def watch(k: int, u: np.ndarray) -> str | None:
            found.append(psnr(u[0, self.near] - self.clean))
            return "past" if not to_end and k > 1.5 * np.argmax(found) + 10 else None

        self.course.run(self.start, flow, Schedule(np.full(most, beta), DT), stop=watch)
        return found

    def best(self, flow: Flow, betas: np.ndarray, most: int = 200) -> float:
        return max(max(self.curve(flow, beta, most)) for beta in betas)


@cache
def bench(map_: str, sigma: float) -> Bench:
    return Bench(scene(map_, sigma))


def trusting(band: Band, trust: np.ndarray) -> AtVoxels:
    return AtVoxels(band, Kind(), np.where(trust > 0, 1.0, np.nan)[None], trust)


# --- what is held out -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def band() -> Band:
    psi = ball((24, 24, 24), 8.0)
    return build_band(psi, Grid.from_spacing(psi.shape), 4.0)


def test_held_out_are_a_share_of_the_voxels_1_to_2_voxels_from_the_surface(band):
    held = hold_out(trusting(band, np.ones(band.entries)), 0)
    shell = np.flatnonzero((np.abs(band.distance) >= 1) & (np.abs(band.distance) < 2))
    assert len(held) == round(SHELL_SHARE * len(shell)) > 400
    assert np.all(np.diff(held) > 0) and np.isin(held, shell).all()
    sides = (band.distance[held] > 0).mean()
    assert sides == pytest.approx((band.distance[shell] > 0).mean(), abs=0.05)


def test_held_out_by_seed(band):
    trust = np.ones(band.entries)
    first, again, other = (hold_out(trusting(band, trust), seed) for seed in (0, 0, 1))
    assert np.array_equal(first, again)
    assert len(np.intersect1d(first, other)) == pytest.approx(SHELL_SHARE * len(first), rel=0.3)


def test_held_out_hold_data(band):
    trust = np.random.default_rng(0).random(band.entries).astype(np.float32)
    trust[trust < 0.6] = 0
    assert np.all(trust[hold_out(trusting(band, trust), 0)] > 0)


def test_held_out_beside_the_surface_where_data_end_there(band):
    trust = (np.abs(band.distance) < 1.05).astype(float)
    held = hold_out(trusting(band, trust), 0)
    inner = np.abs(band.distance) < 1
    assert np.abs(band.distance[held]).max() < 1 and len(held) == round(NEAR_SHARE * inner.sum())


def test_shell_counts_in_the_largest_voxels():
    psi = ball((24, 24, 24), 8.0)
    wide = build_band(psi, Grid.from_spacing(psi.shape, (0.5, 1.0, 1.0)), 4.0)
    held = np.abs(wide.distance[hold_out(trusting(wide, np.ones(wide.entries)), 0)])
    assert 1 <= held.min() < 1.1 and 1.9 < held.max() < 2


def test_too_few_to_hold_out(band):
    few = np.zeros(band.entries)
    few[np.flatnonzero((np.abs(band.distance) > 1.2) & (np.abs(band.distance) < 1.8))[: 2 * LEAST_HELD - 4]] = 1
    with pytest.raises(DataError, match=r"56 valid voxels.*hold out 28.*at least 30.*--beta and --iterations"):
        hold_out(trusting(band, few), 0)


# --- the search -------------------------------------------------------------------------------------------------------


def tried(error) -> list[float]:
    asked: list[float] = []
    search(lambda x: asked.append(x) or error(x))
    return asked


@pytest.mark.parametrize("least", [0.0, 0.3, -1.2, 2.6, -3.9, 5.1, 7.7])
def test_search_finds_the_least_of_a_parabola(least):
    asked = tried(lambda x: (x - least) ** 2)
    best = min(asked, key=lambda x: abs(x - least))
    assert abs(best - least) <= LAST_STEP / 2
    assert len(asked) == len(set(asked)) <= 11
    assert {best - LAST_STEP, best + LAST_STEP} <= {*asked, SEARCH_RANGE + LAST_STEP}


@pytest.mark.parametrize("slope", [1.0, -1.0])
def test_search_ends_at_the_end_of_its_range(slope):
    asked = tried(lambda x: slope * x)
    assert min(asked, key=lambda x: slope * x) == -slope * SEARCH_RANGE
    assert max(map(abs, asked)) == SEARCH_RANGE and len(asked) <= 9


def test_search_stays_where_all_is_alike():
    assert tried(lambda x: 1.0) == [0.0, -2.0, 2.0, -1.0, 1.0, -0.5, 0.5]


# --- automatic against exhaustive -------------------------------------------------------------------------------------


@pytest.mark.parametrize("case", [("pieces", 40.0), ("smooth", 20.0)])
def test_within_half_a_decibel_of_the_best(case):
    made, oracle = scene(*case), bench(*case)
    best = oracle.best(Flow(), SHARES / oracle.slope)
    assert best - 0.5 < quality(made, automatic(*case).data) < best + 0.5
    assert best > quality(made, made.noisy) + 8


@pytest.mark.slow
def test_losses_of_all_nine():
    losses = []
    for case in CASES:
        best = bench(*case).best(Flow(), FINE_SHARES / bench(*case).slope)
        losses.append(best - quality(scene(*case), automatic(*case).data))
    assert max(losses) < 0.5 and np.median(losses) < 0.15, losses


@pytest.mark.parametrize("case", CASES)
def test_costs_at_most_12_runs(case):
    """Runs of what is chosen, or of the default's 20 iterations where that is over after some."""
    choice = automatic(*case).record["Choice"]
    steps = sum(row["iterations_tried"] for row in choice["table"])
    assert steps <= 12 * (choice["iterations"] if choice["iterations"] > 10 else 20)


@pytest.mark.slow
@pytest.mark.parametrize("case", WITH_EDGES)
def test_beats_the_best_l2_and_tv_beside_edges(case):
    found, oracle = quality(scene(*case), automatic(*case).data), bench(*case)
    assert found > oracle.best(Flow("l2"), np.zeros(1)) + 2.5
    assert found > oracle.best(Flow("tv"), np.array([10.0, 30.0]) / oracle.slope) + 0.3


@pytest.mark.parametrize("kind", ["circular", "vector", "weighted"])
def test_values_of_every_kind_are_judged_alike(kind):
    made, random = torus(32, map="mixed", noise=0.0), np.random.default_rng(0)
    clean, options = made.clean, {}
    noise = 25 * random.standard_normal((*clean.shape, 2))
    if kind == "vector":
        clean, options = np.stack([clean, 200 - 0.5 * clean], -1), {"kind": "vector"}
    else:
        noise = noise[..., 0]
    if kind == "circular":
        options = {"kind": "circular", "period": 360.0}
    if kind == "weighted":
        poor = random.random(clean.shape) < 0.3
        noise[poor] *= 4
        options = {"weights": np.where(poor, 1 / 16, 1)}

    def error(result: Result) -> float:
        off = (result.data - clean)[np.abs(made.levelset) < 0.5]
        return float(np.sqrt(np.mean(((off + 180) % 360 - 180) ** 2)))

    result = denoise(made.levelset, clean + noise, stop="auto", **options)
    assert "correlated" not in " ".join(result.warnings)
    best = min(
        error(denoise(made.levelset, clean + noise, beta=beta, iterations=count, **options))
        for beta in (0.02, 0.05, 0.1)
        for count in (5, 10, 20)
    )
    assert error(result) < 1.06 * best  # half a decibel


def test_every_flow_competes():
    record = automatic("pieces", 40.0, "auto").record
    choice = record["Choice"]
    table = choice["table"]
    assert {(row["flow"], row["phi"]) for row in table} == {
        ("l2", None), ("beltrami", None), ("tv", None), ("phi", "perona-malik"),
    }  # fmt: skip
    least = min(table, key=lambda row: row["error"])
    assert all(choice[name] == least[name] for name in ("flow", "phi", "beta", "iterations"))
    assert (record["Parameters"]["flow"], record["Iterations"]) == (choice["flow"], choice["iterations"])
    found = quality(scene("pieces", 40.0), automatic("pieces", 40.0, "auto").data)
    assert found > quality(scene("pieces", 40.0), automatic("pieces", 40.0).data) - 0.3


def test_given_beta_and_flow_are_not_searched():
    made = scene("pieces", 40.0)
    for flow, options in (("l2", {}), ("tv", {"eps": 5.0}), ("phi", {"beta": 0.1}), ("beltrami", {"edge": 10.0})):
        (row,) = denoise(made.levelset, made.noisy, flow=flow, stop="auto", **options).record["Choice"]["table"]
        assert row["flow"] == flow
        assert row["beta"] == (0.1 if flow in ("phi", "beltrami") else None)


def test_seed_decides():
    made = torus(24, map="pieces")
    first, again, other = (denoise(made.levelset, made.noisy, stop="auto", seed=seed) for seed in (0, 0, 1))
    assert first.data.tobytes() == again.data.tobytes() and first.record["Choice"] == again.record["Choice"]
    assert other.record["Choice"]["table"] != first.record["Choice"]["table"]


def test_beta_alone_is_chosen_for_the_iterations_given():
    made, oracle = scene("pieces", 40.0), bench("pieces", 40.0)
    for count in (10, 30):
        result = denoise(made.levelset, made.noisy, iterations=count)
        assert result.record["Iterations"] == count
        assert {row["iterations_tried"] for row in result.record["Choice"]["table"]} == {count}
        best = max(oracle.curve(Flow(), beta, count, to_end=True)[-1] for beta in SHARES / oracle.slope)
        assert quality(made, result.data) > best - 0.3


# --- the other rules --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["scalar", "circular", "vector"])
@pytest.mark.parametrize("given", [18.0, None])
def test_discrepancy_removes_the_noise_and_no_more(given, kind):
    made = scene("smooth", 20.0)
    data = made.noisy if kind != "vector" else np.stack([made.noisy, made.clean + (made.noisy - made.clean)[::-1]], -1)
    options = {"kind": kind} | ({"period": 512.0} if kind == "circular" else {})
    result = denoise(made.levelset, data, stop="discrepancy", noise_sigma=given, beta=0.02, **options)
    sigma = given or np.sqrt(np.mean(np.square(result.record["Noise"]["sd"])))
    assert sigma == pytest.approx(given or 20, rel=0.05)
    count = result.record["Iterations"]
    assert result.record["StopReason"] == "discrepancy" and count > 1
    before = denoise(made.levelset, data, iterations=count - 1, beta=0.02, **options)
    assert before.record["Removed"]["rms"] < sigma <= result.record["Removed"]["rms"]


def test_discrepancy_with_nothing_to_remove():
    made = scene("smooth", 20.0)
    result = denoise(made.levelset, made.noisy, stop="discrepancy", noise_sigma=1.0)
    assert result.record["Iterations"] == 0
    assert "as far from the data as the noise" in result.warnings[-1]


@pytest.mark.parametrize("flow", ["l2", "tv", "phi"])
def test_decorrelation_stops_near_the_best_time(flow):
    made, oracle = scene("smooth", 40.0), bench("smooth", 40.0)
    result = denoise(made.levelset, made.noisy, flow=flow, stop="decorrelation")
    assert result.record["StopReason"] == "decorrelation" and result.record["Choice"] is None
    beta = result.record["PerIteration"]["beta"][0]
    best = oracle.best(Flow(flow), np.array([beta]))
    assert quality(made, result.data) > best - 2


# --- where held-out data are a poor judge -----------------------------------------------------------------------------


@pytest.fixture(scope="module")
def correlated() -> np.ndarray:
    made = scene("smooth", 20.0)
    noise = gaussian_filter(np.random.default_rng(0).standard_normal(made.clean.shape), 1.5)
    return (made.clean + 20 * noise / noise.std()).astype(np.float32)


def test_correlated_noise_leaves_beta_to_the_slope(correlated):
    result = denoise(scene("smooth", 20.0).levelset, correlated)
    assert result.record["Choice"] is None
    assert result.record["Parameters"]["beta"] == pytest.approx(1 / result.record["TypicalSlope"])
    (line,) = result.warnings
    assert "correlated" in line and "1 / the data's median slope" in line and "--edge" in line


@pytest.mark.parametrize("options", [{"stop": "auto"}, {"flow": "auto"}])
def test_correlated_noise_is_warned_of_where_the_data_must_choose(correlated, options):
    result = denoise(scene("smooth", 20.0).levelset, correlated, **options)
    assert result.record["Choice"] is not None
    assert "correlated" in result.warnings[0] and "--stop discrepancy with --noise-sigma S" in result.warnings[0]


def test_white_noise_is_not_warned_of():
    for case in CASES:
        assert automatic(*case).warnings == ()


def test_discrepancy_warns_of_an_estimate_from_correlated_noise(correlated):
    levelset = scene("smooth", 20.0).levelset
    (line,) = denoise(levelset, correlated, stop="discrepancy").warnings[:1]
    assert "correlated" in line and "--noise-sigma S" in line
    assert denoise(levelset, correlated, stop="discrepancy", noise_sigma=15.0).warnings == ()


def test_too_few_voxels():
    psi, data = ball(), noisy()
    few = np.full_like(data, np.nan)
    kept = np.flatnonzero(np.abs(psi) < 0.5)[::5]
    few.flat[kept] = data.flat[kept]
    result = denoise(psi, few)
    assert result.record["Choice"] is None and "too few valid voxels" in result.warnings[0]
    with pytest.raises(DataError, match="automatic choice: found"):
        denoise(psi, few, stop="auto")


@pytest.mark.parametrize("options", [{}, *({"stop": stop} for stop in STOPS[:2]), {"flow": "auto"}, {"flow": "phi"}])
@pytest.mark.parametrize("value", [0.0, 7.0, -1e6])
def test_constant_data_have_nothing_to_choose(value, options):
    psi = ball()
    result = denoise(psi, np.full(psi.shape, value, np.float32), **options)
    seen = np.isfinite(result.data)
    assert seen.any() and np.all(result.data[seen] == value)
    assert result.warnings == () and result.record["Choice"] is None
