"""Heat flow against exact solutions, with its order; noise removed from known maps; limits that leave only a little."""

from __future__ import annotations

import numpy as np
import pytest
from reference import cubic_at
from test_extension import extended

from beltrami_cli import denoise, phantoms
from beltrami_cli.band import build_band
from beltrami_cli.extension import Reextension
from beltrami_cli.flows import DT_SHARE, Flow, Stepper, stability_bound

OFF_GRID = 0.137
AXIS = np.array([1, 2, 2]) / 3
RADII = (8.0, 16.0, 24.0)
BOUNDS = (7e-3, 2.2e-3, 1.2e-3)  # Linf at those radii in voxels, for data of range 3
# The data fill the volume and are constant along normals, so that they need no extension; the flow re-extends as usual.
FILLED = {"extension": "none", "extend_every": 5}


def sphere_error(radius, psi=lambda d, radius: d, spacing=(1.0, 1.0, 1.0), dt=0.15, **options):
    """Linf of the heat flow of a spherical harmonic of degree 2 to t = 0.1 R^2, at 4000 points of the sphere."""
    h = np.array(spacing)
    count = np.ceil((2 * radius + 14 * h.max()) / h).astype(int)
    centre = (count - 1) / 2 * h - OFF_GRID
    x = np.indices(count) * h[:, None, None, None] - centre[:, None, None, None]
    length = np.sqrt((x**2).sum(0))
    data = 3 * (np.tensordot(AXIS, x, 1) / length) ** 2 - 1
    steps = round(0.1 * radius**2 / dt)
    result = denoise(
        psi(length - radius, radius), data, spacing=spacing, flow="l2", dt=dt, iterations=steps, **{**FILLED, **options}
    )
    assert result.record["Iterations"] == steps
    points = np.random.default_rng(7).normal(size=(4000, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    values = result.data.astype(float)
    got = np.array([cubic_at(values, p) for p in (points * radius + centre) / h])
    exact = (3 * (points @ AXIS) ** 2 - 1) * (1 - 6 * dt / radius**2) ** steps  # the same Euler steps in time
    return np.abs(got - exact).max()  # NaN where the band has no cubic there


def order(errors, radii=RADII):
    return -np.polyfit(np.log(radii), np.log(errors), 1)[0]


@pytest.mark.slow
@pytest.mark.parametrize(
    "options", [{"precision": "float32"}, {"precision": "float64"}, {"extension": "closest-point"}]
)
def test_heat_on_a_sphere_is_of_second_order(options):
    errors = np.array([sphere_error(r, **options) for r in RADII])
    assert np.all(errors <= BOUNDS)
    assert order(errors) >= 1.7


@pytest.mark.parametrize(
    ("psi", "inside"),
    [
        (lambda d, radius: (d + radius) ** 2 - radius**2, "negative"),
        (lambda d, radius: 0.01 * d, "negative"),
        (lambda d, radius: np.clip(d, -3, 3), "negative"),
        (lambda d, radius: np.where(np.abs(d) < 3, d, np.nan), "negative"),
        (lambda d, radius: np.where(np.abs(d) < 3, d, np.inf * d), "negative"),
        (lambda d, radius: -d, "positive"),
    ],
    ids=["not a distance", "scaled", "clamped", "NaN", "inf", "positive inside"],
)
def test_any_psi_with_that_zero_set_will_do(psi, inside):
    for radius, bound in zip(RADII[:2], BOUNDS, strict=False):
        assert sphere_error(radius, psi, inside=inside) <= bound


@pytest.mark.slow
def test_anisotropic_voxels():
    """At most 4 times the error on cubes of the finest spacing, with the dt that the bound allows."""
    dt = DT_SHARE * stability_bound(np.array([1.0, 1.0, 2.0]), (9, 9, 9))
    assert dt == pytest.approx(0.2)
    errors = np.array([sphere_error(r, spacing=(1.0, 1.0, 2.0), dt=dt) for r in RADII])
    assert np.all(errors <= 4 * np.array(BOUNDS))
    assert np.all(errors <= 4 * np.array([sphere_error(r) for r in RADII]))
    assert order(errors) >= 1.7


@pytest.mark.slow
def test_paper_scheme_is_of_first_order():
    errors = np.array([sphere_error(r, scheme="paper") for r in RADII])
    assert np.all(errors <= [2e-2, 1e-2, 7e-3])
    assert order(errors) >= 0.9


def circle_error(radius, **options):
    """Linf of the heat flow of cos 3 theta to t = 0.04 R^2 at 4000 points of a circle in a plane."""
    count = int(2 * radius) + 14
    centre = (count - 1) / 2 - OFF_GRID
    x = np.indices((count, count)) - centre
    dt, data = 0.225, np.cos(3 * np.arctan2(x[1], x[0]))
    steps = round(0.04 * radius**2 / dt)
    values = denoise(np.hypot(*x) - radius, data, flow="l2", iterations=steps, **{**FILLED, **options}).data
    assert values.shape == (count, count)
    angle = np.linspace(0, 2 * np.pi, 4000)
    points = radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], 1) + [centre, centre, 0]
    got = np.array([cubic_at(values[:, :, None].astype(float), p) for p in points])
    return np.abs(got - np.cos(3 * angle) * (1 - 9 * dt / radius**2) ** steps).max()


@pytest.mark.parametrize("options", [{}, {"extension": "closest-point"}])
def test_heat_on_a_circle_is_of_second_order(options):
    errors = np.array([circle_error(r, **options) for r in RADII])
    assert np.all(errors <= [7e-3, 2e-3, 1e-3])
    assert order(errors) >= 1.7


# --- noise removed ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize(("name", "decibels"), [("mixed", 28.8), ("pieces", 24.6), ("smooth", 29.6)])
def test_noisy_torus(name, decibels):
    """PSNR (peak 255) on |Psi| < 0.5 at the best iteration count, noise sigma 40, beta 0.05."""
    phantom = phantoms.torus(map=name, noise=40)
    band = build_band(phantom.levelset, phantom.grid, 4.0)
    step, again = Stepper(Flow(), band, np.float32), Reextension(band)
    dt = DT_SHARE * stability_bound(phantom.grid.spacing, phantom.grid.shape)
    near = np.abs(phantom.levelset) < 0.5
    u = extended(band, phantom.noisy).values
    out, quality = np.empty_like(u), []
    for k in range(1, 61):
        step(u, out, 0.05, dt)
        u, out = out, u
        if k % 5 == 0:
            again(u, out)
            u, out = out, u
        rms = np.sqrt(np.mean((band.scatter(u[0], np.nan)[near] - phantom.clean[near]) ** 2))
        quality.append(20 * np.log10(255 / rms))
    best = int(np.argmax(quality))
    assert quality[best] >= decibels
    assert 5 < best < 59  # neither the start nor the end of what was tried
    same = denoise(phantom.levelset, phantom.noisy, beta=0.05, iterations=best + 1).data
    assert np.abs(same - band_values(band, phantom, best + 1, dt))[near].max() < 1e-3


def band_values(band, phantom, iterations, dt):
    """The first `iterations` steps by hand, as a volume."""
    step, again = Stepper(Flow(), band, np.float32), Reextension(band)
    u = extended(band, phantom.noisy).values
    out = np.empty_like(u)
    for k in range(1, iterations + 1):
        step(u, out, 0.05, dt)
        u, out = out, u
        if k % 5 == 0:
            again(u, out)
            u, out = out, u
    return band.scatter(u[0], np.nan)
