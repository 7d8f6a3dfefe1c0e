"""Channels coupled by the metric of the surface that they span: what it leaves alone, and how it divides steps."""

from __future__ import annotations

import numpy as np
import pytest
from test_band import positions
from test_flows import random_band, steps

from beltrami_cli.errors import NumericsError
from beltrami_cli.flows import SCHEMES, Flow, Stepper
from beltrami_cli.kernels import steps as kernels


def edge_and_noise(name="sphere", slope=100.0):
    """A band, (2, E) an edge of that height in one channel and noise of 1 in the other, and the default dt in mm^2."""
    band, noise, bound = random_band(name=name)
    x = positions(band)[:, 0]
    return band, np.stack([np.where(x > np.median(x), slope, 0.0), noise]), 0.9 * bound


def in_range(after, before, share=0.01):
    margin = share * np.ptp(before, axis=1)
    return np.all(after.min(1) >= before.min(1) - margin) and np.all(after.max(1) <= before.max(1) + margin)


# --- a step is divided as the metric asks -----------------------------------------------------------------------------


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("name", ["sphere", "sulcus"])
def test_an_edge_in_one_channel_does_not_blow_up_the_other(name, scheme):
    band, u, dt = edge_and_noise(name)
    step, after, out = Stepper(Flow(scheme=scheme), band, u.dtype, 2, coupled=True), u.copy(), np.empty_like(u)
    for _ in range(50):
        step(after, out, 1.0, dt)
        after, out = out, after
        assert in_range(after, u, {"symmetric": 0.01, "paper": 0.1}[scheme])
    assert 1 < step.substeps < 200
    assert after[1].std() < 0.2 < u[1].std()
    assert np.ptp(after[0]) > 99


def test_undivided_such_a_step_does():
    band, u, dt = edge_and_noise()
    step, after = Stepper(Flow(), band, u.dtype, 2, coupled=True), u.copy()
    for _ in range(50):
        step._fluxes(after, 1.0)
        kernels.diverge(after, step.flux, band.backward, step.outer, True, dt, after)
    assert np.abs(after[1]).max() > 10 * np.abs(u[1]).max() and np.ptp(after[0]) > 200


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("channels", [2, 3, 5])
def test_noise_stays_in_range(channels, scheme):
    band, _, bound = random_band(name="sulcus")
    u = np.random.default_rng(5).normal(size=(channels, band.entries))
    for beta in (0.01, 0.3, 3.0):
        assert in_range(steps(Flow(scheme=scheme), band, u, beta, bound, 10, coupled=True)[0], u)


def test_two_channels_of_steep_noise_need_few_substeps():
    """Where both are steep, C is of order 1, though sqrt(det M) is not."""
    band, u, bound = random_band()
    step = Stepper(Flow(), band, u.dtype, 2, coupled=True)
    step(np.stack([u, np.roll(u, 7)]), np.empty((2, band.entries)), 100.0, bound)
    assert step.substeps < 20


def test_a_divided_step_reports_what_it_did_in_all():
    band, u, dt = edge_and_noise(slope=10.0)
    step, whole = Stepper(Flow(), band, u.dtype, 2, coupled=True), np.empty_like(u)
    change, energy = step(u, whole, 0.3, dt)
    assert step.substeps > 1
    assert change == pytest.approx(np.sqrt(((whole - u) ** 2).sum() / band.entries), rel=1e-12)
    fine, energies = steps(Flow(), band, u, 0.3, dt / 50, 50, coupled=True)
    assert energy == energies[0]
    assert np.abs(fine - whole).max() < 0.2 * np.abs(whole - u).max()


def test_too_many_substeps_are_an_error():
    band, u, dt = edge_and_noise(slope=1e5)
    step = Stepper(Flow(), band, u.dtype, 2, coupled=True)
    with pytest.raises(NumericsError, match="smaller --beta"):
        step(u, np.empty_like(u), 10.0, dt)


@pytest.mark.parametrize("bad", [np.inf, np.nan, 1e100])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_values_beyond_the_finite_are_no_crash(scheme, bad):
    """Either the step cannot be divided, or its change is not finite, which the time loop reports."""
    band, u, dt = edge_and_noise()
    u[0, 500] = bad
    try:
        change, energy = Stepper(Flow(scheme=scheme), band, u.dtype, 2, coupled=True)(u, np.empty_like(u), 1.0, dt)
    except NumericsError:
        return
    assert not (np.isfinite(change) and np.isfinite(energy))


# --- what the metric leaves alone -------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("flow", [Flow(), Flow("l1"), Flow(scheme="paper")])
def test_one_channel_is_scalar(flow, dtype):
    band, u, bound = random_band(name="sulcus", dtype=dtype)
    for beta in (0.1, 3.0, 1000.0):
        shared, energy = steps(flow, band, 20 * u, beta, bound, 20)
        coupled, own_energy = steps(flow, band, 20 * u, beta, bound, 20, coupled=True)
        assert np.abs(coupled - shared).max() < 20 * {np.float32: 2e-5, np.float64: 1e-11}[dtype]
        assert np.allclose(energy, own_energy, rtol=1e-4 if dtype == np.float32 else 1e-9)


@pytest.mark.parametrize("scheme", SCHEMES)
def test_constant_channels_take_no_part(scheme):
    band, u, bound = random_band()
    alone, _ = steps(Flow(scheme=scheme), band, u, 0.7, bound, 10)
    among, _ = steps(Flow(scheme=scheme), band, np.stack([0 * u + 3, u, 0 * u - 1e4]), 0.7, bound, 10, coupled=True)
    assert np.all(among[0] == 3) and np.all(among[2] == -1e4)
    # The metric cannot know that they are constant: it divides the step.
    assert np.abs(among[1] - alone).max() < 0.1


@pytest.mark.parametrize("scheme", SCHEMES)
def test_turning_the_channels_into_one_another_turns_the_result(scheme):
    """M goes with the channels under any orthogonal Q, and C with it: no channel is preferred."""
    band, _, bound = random_band(name="sulcus")
    rng = np.random.default_rng(6)
    u = rng.normal(size=(3, band.entries)) * [[1], [3], [10]]
    q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    first, second = (steps(Flow(scheme=scheme), band, x, 0.5, bound, 5, coupled=True)[0] for x in (u, q @ u))
    assert np.abs(q @ first - second).max() < 1e-9


@pytest.mark.parametrize("scheme", SCHEMES)
def test_tends_to_l2_as_beta_tends_to_0(scheme):
    band, u, bound = random_band()
    u = np.stack([u, 5 * u[::-1]])
    heat, _ = steps(Flow("l2", scheme=scheme), band, u, 0.0, bound, 20)
    for beta, within in ((0.0, 1e-12), (1e-5, 1e-7)):
        got, _ = steps(Flow(scheme=scheme), band, u, beta, bound, 20, coupled=True)
        assert np.abs(got - heat).max() < within


@pytest.mark.parametrize("flow", [Flow("l2"), Flow("tv"), Flow("phi")])
def test_flows_without_an_outer_factor_share_one_diffusivity(flow):
    band, u, bound = random_band()
    u = np.stack([u, 5 * u[::-1]])
    shared, coupled = (steps(flow, band, u, 0.3, bound, 10, coupled=c)[0] for c in (False, True))
    assert np.array_equal(shared, coupled)


def test_an_edge_in_one_channel_keeps_the_same_edge_in_the_other():
    """A step of 10 under noise of 5 outlasts the flow where another channel has a step of 100 in the same place."""
    band, noise, bound = random_band(name="sulcus")
    y = positions(band)[:, 1]
    across = y - np.median(y) - 0.5
    weak, strong = np.where(across > 0, 10.0, 0.0) + 5 * noise, np.where(across > 0, 100.0, 0.0)
    alone, _ = steps(Flow(), band, weak, 0.1, 0.9 * bound, 20)
    together, _ = steps(Flow(), band, np.stack([weak, strong]), 0.1, 0.9 * bound, 20, coupled=True)

    def jump(u):
        return u[(across > 0) & (across < 1)].mean() - u[(across < 0) & (across > -1)].mean()

    assert jump(alone) < 3 and jump(together[0]) > 7
    away = across < -5
    assert together[0, away].std() < 1.1 * alone[away].std() < 0.7  # of 5
