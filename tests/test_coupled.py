"""Channels coupled by the metric of the surface that they span: its PDE, what it leaves alone, how it divides steps."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from test_band import positions
from test_flows import oblique_plane, random_band, steps

from beltrami_cli import denoise, phantoms
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
    band, u, dt = edge_and_noise(slope=1000.0)
    step, after, divided = Stepper(Flow(), band, u.dtype, 2, coupled=True), u.copy(), np.empty_like(u)
    step(u, divided, 1.0, dt)
    assert step.substeps > 100 and in_range(divided, u)
    for _ in range(10):
        step._fluxes(after, 1.0)
        kernels.diverge(after, step.flux, band.backward, step.outer, True, dt, after)
    assert np.abs(after[1]).max() > 5 * np.abs(u[1]).max()


# Slopes of 1, 10 and 100 in one place are more than the paper's first-order differences keep apart.
MIXED = {"symmetric": 0.01, "paper": 0.2}


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("scales", [(1, 1), (1, 1, 1), (1, 1, 1, 1, 1), (1, 10, 100), (1, 10, 100, 10, 1)])
def test_noise_stays_in_range(scales, scheme):
    """Each channel in its own range, whatever noise the others have."""
    band, _, bound = random_band(name="sulcus")
    u = np.random.default_rng(5).normal(size=(len(scales), band.entries)) * np.array(scales)[:, None]
    share = MIXED[scheme] if max(scales) > 1 else 0.01
    for beta in (0.01, 0.3, 3.0):
        step, after, out = Stepper(Flow(scheme=scheme), band, u.dtype, len(u), coupled=True), u.copy(), np.empty_like(u)
        for _ in range(10 if scheme == "symmetric" else 2):
            step(after, out, beta, bound)
            after, out = out, after
            assert in_range(after, u, share)


def test_two_channels_of_steep_noise_need_few_substeps():
    """Where both are steep, T is of order 1, though sqrt(det A) is not."""
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
    """However many there are. (Without any, the flow is another discretisation: compared with the PDE below.)"""
    band, u, bound = random_band()
    among, _ = steps(Flow(scheme=scheme), band, np.stack([0 * u + 3, u, 0 * u - 1e4]), 0.7, bound, 10, coupled=True)
    beside, _ = steps(Flow(scheme=scheme), band, np.stack([u, 0 * u]), 0.7, bound, 10, coupled=True)
    assert np.all(among[0] == 3) and np.all(among[2] == -1e4)
    assert np.all(beside[1] == 0) and np.abs(among[1] - beside[0]).max() < 1e-12


@pytest.mark.parametrize("scheme", SCHEMES)
def test_equal_channels_flow_alike(scheme):
    """As one of them does, with slopes sqrt(2) as steep."""
    band, u, bound = random_band(name="sulcus")
    pair, _ = steps(Flow(scheme=scheme), band, np.stack([u, u]), 0.7, bound, 10, coupled=True)
    assert np.array_equal(pair[0], pair[1])
    beside, _ = steps(Flow(scheme=scheme), band, np.stack([u, 0 * u]), 0.7 * np.sqrt(2), bound, 10, coupled=True)
    assert np.abs(pair[0] - beside[0]).max() < 1e-9


@pytest.mark.parametrize("scheme", SCHEMES)
def test_turning_the_channels_into_one_another_turns_the_result(scheme):
    """A is the same for any orthogonal mix of the channels: none is preferred, nor a complex field's phase."""
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
    for beta in (0.0, 1e-5):
        got, _ = steps(Flow(scheme=scheme), band, u, beta, bound, 20, coupled=True)
        assert np.abs(got - heat).max() < 1e-5  # P P = P to single precision only, as which normals are stored


@pytest.mark.parametrize("flow", [Flow("l2"), Flow("tv"), Flow("phi")])
def test_flows_without_an_outer_factor_share_one_diffusivity(flow):
    band, u, bound = random_band()
    u = np.stack([u, 5 * u[::-1]])
    shared, coupled = (steps(flow, band, u, 0.3, bound, 10, coupled=c)[0] for c in (False, True))
    assert np.array_equal(shared, coupled)


# --- the PDE ----------------------------------------------------------------------------------------------------------


def plane_rates(slopes_p, slopes_q, q, beta):
    """(K, E) a Div(T v_k) on a plane, for constant slopes along p and functions of q along q, by M in Gram form."""

    def along_q(q):
        v = np.stack([[np.full(q.shape, p), f(q)] for p, f in zip(slopes_p, slopes_q, strict=True)])
        gram = np.eye(len(v)) + beta**2 * np.einsum("kae,lae->ekl", v, v)
        size = np.sqrt(np.linalg.det(gram))
        return size * np.einsum("ekl,le->ke", np.linalg.inv(gram), v[:, 1]), size

    step = 1e-4  # mm: of a wave of 12 mm, differences to 1e-8
    return (along_q(q + step)[0] - along_q(q - step)[0]) / (2 * step) / along_q(q)[1]


def errors_on_a_plane(scheme, wavelength, beside):
    """Worst error, of the largest rate, of each channel in one step at beta 0.3 of u = 2p + sin(kq)/k and others."""
    band, p, q, core = oblique_plane()
    k, beta, dt = 2 * np.pi / wavelength, 0.3, 1e-3
    channels = [(2 * p + np.sin(k * q) / k, 2.0, lambda q: np.cos(k * q))]
    if beside == "constant":
        channels.append((0 * q + 5, 0.0, lambda q: 0 * q))
    else:
        channels.append((-p + 0.7 * q + np.cos(k * q) / k, -1.0, lambda q: 0.7 - np.sin(k * q)))
        channels.append((0.5 * p + 1.5 * np.sin(2 * k * q) / k, 0.5, lambda q: 3 * np.cos(2 * k * q)))
    u, slopes_p, slopes_q = zip(*channels, strict=True)
    stepped, _ = steps(Flow(scheme=scheme), band, np.stack(u), beta, dt, coupled=True)
    exact = plane_rates(slopes_p, slopes_q, q[core], beta)
    moving = np.abs(exact).max(1) > 0
    off = np.abs((stepped - u)[:, core] / dt - exact)
    assert np.all(off[~moving] == 0)
    return off[moving].max(1) / np.abs(exact[moving]).max(1)


@pytest.mark.parametrize(("scheme", "beside", "within"), [
    ("symmetric", "constant", [0.006]), ("paper", "constant", [0.014]),
    ("symmetric", "steep", [0.08, 0.11, 0.07]), ("paper", "steep", [0.14, 0.12, 0.09]),
])  # fmt: skip
def test_rates_are_those_of_the_pde(scheme, beside, within):
    """Waves of 12.5 and of 25 voxels: the errors of the symmetric scheme fall by about 4."""
    coarse, fine = (errors_on_a_plane(scheme, wavelength, beside) for wavelength in (12.5, 25.0))
    assert np.all(fine < within)
    if scheme == "symmetric":
        assert np.all(fine < coarse * (0.3 if beside == "constant" else 0.4))


# --- edges in common --------------------------------------------------------------------------------------------------


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


def test_colours_keep_their_edges_in_common():
    """The portrait, each way at its best (beta, iterations): coupled, colours are truer and their edges agree more."""
    portrait = phantoms.portrait(40, map="rgb", noise=40.0)
    near = np.abs(portrait.levelset) < 0.5

    def edges(data):
        """Slopes of each colour at the surface, (3, N); off it, values are constant along the normal."""
        return [np.sqrt(sum(g[near] ** 2 for g in np.gradient(np.nan_to_num(data[..., k])))) for k in range(3)]

    def best(independent):
        def quality(data):
            agreement = np.mean([np.corrcoef(a, b)[0, 1] for a, b in combinations(edges(data), 2)])
            return 10 * np.log10(255**2 / np.mean((data - portrait.clean)[near] ** 2)), agreement

        options = {"kind": "vector", "independent": independent}
        tries = [{"beta": b, "iterations": n} for b in (0.04, 0.08) for n in (5, 10, 15)]
        return max(quality(denoise(portrait.levelset, portrait.noisy, **options, **t).data) for t in tries)

    (coupled, agreement), (apart, own_agreement) = best(False), best(True)
    assert coupled > apart + 0.5  # dB
    assert agreement > own_agreement + 0.01
