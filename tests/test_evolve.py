"""The time loop without any physics: order of calls, schedules, records, the stop reason, values that blow up."""

from __future__ import annotations

import numpy as np
import pytest

from beltrami_cli import denoise, phantoms
from beltrami_cli.config import parse_beta
from beltrami_cli.errors import NumericsError
from beltrami_cli.evolve import Schedule, evolve


def recorder(log):
    """A step that adds 1 and an extension that adds 100, each noted in `log`."""

    def step(u, out, beta, dt):
        log.append((beta, dt))
        out[:] = u + 1
        return 1.0, float(u.sum())

    def extend(u, out):
        log.append("extend")
        out[:] = u + 100

    return step, extend


def test_runs_the_schedule_and_says_why_it_stopped():
    log = []
    step, _ = recorder(log)
    start = np.zeros((1, 3))
    evolution = evolve(start, step, Schedule(np.array([0.1, 0.2, 0.4]), 0.15, "fwhm"))
    assert log == [(0.1, 0.15), (0.2, 0.15), (0.4, 0.15)]
    assert np.array_equal(evolution.values, [[3, 3, 3]]) and np.array_equal(start, [[0, 0, 0]])
    assert evolution.stop_reason == "fwhm"
    assert evolution.change.tolist() == [1, 1, 1]
    assert evolution.energy.tolist() == [0, 3, 6]


@pytest.mark.parametrize(("every", "extensions"), [(0, 0), (1, 7), (3, 2), (7, 1), (8, 0)])
def test_extends_after_every_so_many_steps(every, extensions):
    log = []
    evolution = evolve(np.zeros((1, 2)), *reordered(recorder(log), 7), every)
    assert log.count("extend") == extensions
    assert evolution.values[0, 0] == 7 + 100 * extensions
    if extensions:
        assert log.index("extend") == every


def reordered(functions, iterations):
    step, extend = functions
    return step, Schedule(np.zeros(iterations), 0.1), extend


def test_no_iterations_leave_the_start():
    step, _ = recorder([])
    evolution = evolve(np.arange(4.0)[None], step, Schedule(np.zeros(0), 0.15))
    assert np.array_equal(evolution.values, [np.arange(4)]) and evolution.stop_reason == "iterations"
    assert len(evolution.change) == len(evolution.energy) == 0


def test_observer_sees_every_iteration():
    step, _ = recorder([])
    seen = []
    evolve(np.zeros((1, 1)), step, Schedule(np.zeros(3), 0.1), observer=lambda *what: seen.append(what))
    assert seen == [(1, 3, 1.0), (2, 3, 1.0), (3, 3, 1.0)]


def test_a_stop_ends_the_run_and_names_why():
    """Asked before the first step and after each, with the values as re-extended."""
    log, asked = [], []

    def stop(done, u):
        asked.append((done, float(u[0, 0])))
        return "cold" if done == 3 else None

    evolution = evolve(np.zeros((1, 2)), *reordered(recorder(log), 7), 2, stop=stop)
    assert asked == [(0, 0.0), (1, 1.0), (2, 102.0), (3, 103.0)]
    assert evolution.stop_reason == "cold" and evolution.iterations == len(evolution.energy) == 3
    assert np.all(evolution.values == 103) and len(log) == 4


def test_a_stop_before_the_first_step_leaves_the_start():
    log = []
    step, _ = recorder(log)
    evolution = evolve(np.ones((2, 3)), step, Schedule(np.zeros(5), 0.1), stop=lambda done, u: "enough")
    assert evolution.stop_reason == "enough" and evolution.iterations == 0 and log == []
    assert np.array_equal(evolution.values, np.ones((2, 3)))


def test_a_stop_that_never_comes_leaves_the_schedule_its_reason():
    step, _ = recorder([])
    evolution = evolve(np.zeros((1, 1)), step, Schedule(np.zeros(4), 0.1, "time"), stop=lambda done, u: None)
    assert evolution.stop_reason == "time" and evolution.iterations == 4


def test_a_stop_comes_after_the_observer():
    seen = []
    step, _ = recorder([])
    evolve(
        np.zeros((1, 1)), step, Schedule(np.zeros(2), 0.1),
        observer=lambda k, n, moved: seen.append(("observer", k)), stop=lambda done, u: seen.append(("stop", done)),
    )  # fmt: skip
    assert seen == [("stop", 0), ("observer", 1), ("stop", 1), ("observer", 2), ("stop", 2)]


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_values_that_blow_up_are_an_error_at_that_iteration(bad):
    def step(u, out, beta, dt):
        out[:] = u
        return (bad if beta == 3 else 0.0), 0.0

    with pytest.raises(NumericsError, match="iteration 4"):
        evolve(np.zeros((1, 1)), step, Schedule(np.arange(6.0), 0.1))


@pytest.mark.parametrize("options", [{"flow": "l2"}, {"beta": 1.0}])
def test_data_beyond_float32_are_an_error(options):
    """Differences of 1e30 square to more than float32 holds: with l2 the change overflows, else the energy."""
    phantom = phantoms.sphere(20, noise=1)
    with pytest.raises(NumericsError, match="float64"):
        denoise(phantom.levelset, phantom.noisy * np.float32(1e30), iterations=3, **options)
    big = denoise(phantom.levelset, phantom.noisy * 1e30, iterations=3, precision="float64", **options)
    assert np.isfinite(big.record["PerIteration"]["energy"]).all()


@pytest.mark.parametrize(
    ("given", "expected"),
    [
        (0.05, [0.05] * 6),
        ("0.1,0.4,0.2", [0.1, 0.1, 0.4, 0.4, 0.2, 0.2]),
        ([0.1, 0.2, 0.3, 0.4], [0.1, 0.1, 0.2, 0.3, 0.3, 0.4]),
        ("0:1", [0, 0.2, 0.4, 0.6, 0.8, 1]),
        ("1:32:geometric", [1, 2, 4, 8, 16, 32]),
        ({"start": 32, "stop": 1, "law": "geometric"}, [32, 16, 8, 4, 2, 1]),
    ],
)
def test_beta_over_the_iterations(given, expected):
    assert np.allclose(parse_beta(given).over(6), expected)
    phantom = phantoms.curve(48)
    record = denoise(phantom.levelset, phantom.noisy, beta=given, iterations=6).record["PerIteration"]
    assert np.allclose(record["beta"], expected)
    assert record["dt_over_beta"] == [pytest.approx(0.225 / b) if b else None for b in expected]


@pytest.mark.parametrize(
    ("duration", "iterations", "time", "reason"),
    [
        ({}, 20, 20 * 0.15, "iterations"),
        ({"iterations": 7}, 7, 7 * 0.15, "iterations"),
        ({"time": 1.0}, 7, 1.0, "time"),  # 6 steps of 0.15 fall short of it
        ({"time": 0.9}, 6, 0.9, "time"),
        ({"fwhm": 4.0}, 10, 16 / (16 * np.log(2)), "fwhm"),
        ({"time": 0.0}, 0, 0.0, "time"),
    ],
)
def test_how_long_it_runs(duration, iterations, time, reason):
    phantom = phantoms.sphere(20)
    record = denoise(phantom.levelset, phantom.noisy, flow="l2", **duration).record
    assert record["Iterations"] == len(record["PerIteration"]["change_rms"]) == iterations
    assert record["StopReason"] == reason
    assert record["TimeMm2"] == pytest.approx(time)


def test_fwhm_is_that_of_a_gaussian():
    """Heat flow for a FWHM of 6 mm turns a peak into a Gaussian of variance 36 / (8 ln 2)."""
    image = np.zeros((61, 61))
    image[30, 30] = 1000.0
    got = denoise(None, image, flat=True, flow="l2", fwhm=6.0, precision="float64").data
    x = np.arange(61) - 30
    assert (got.sum(1) * x**2).sum() / got.sum() == pytest.approx(36 / (8 * np.log(2)), rel=1e-6)


def test_every_record_is_of_the_run():
    phantom = phantoms.torus(24)
    record = denoise(phantom.levelset, phantom.noisy, flow="l2", iterations=9).record["PerIteration"]
    assert np.all(np.diff(record["energy"][:5]) < 0)
    assert np.all(np.diff(record["change_rms"][:5]) < 0)
    assert all(len(record[name]) == 9 for name in ("beta", "dt", "dt_over_beta", "change_rms", "energy"))
