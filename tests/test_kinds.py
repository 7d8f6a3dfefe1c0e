"""Kinds of value: to channels and back, differences of angles, errors that are least at the truth, doubtful periods."""

from __future__ import annotations

import numpy as np
import pytest

from beltrami_cli.errors import DataError
from beltrami_cli.kinds import Kind, kind_of

PERIODS = [360.0, 2 * np.pi, 24.0, 1.0]


def circular(period=360.0, low=0.0):
    return Kind("circular", period, low)


# --- channels and back ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("dtype", "rounding"), [(np.float32, 3e-7), (np.float64, 1e-15)])
@pytest.mark.parametrize("share", [0.0, -0.5])
@pytest.mark.parametrize("period", PERIODS)
def test_angles_return_in_their_own_range(period, share, dtype, rounding):
    kind = circular(period, share * period)
    angles = (kind.low + period * np.linspace(0, 1, 1001)[:-1]).astype(dtype)
    channels = kind.to_channels(angles)
    assert channels.shape == (2, 1000) and channels.dtype == dtype
    assert np.allclose((channels**2).sum(0), 1, atol=1e-6)
    back = kind.to_values(3 * channels)  # of whatever length
    assert back.dtype == dtype
    assert np.all((back >= kind.low) & (back < kind.low + period))
    assert np.abs(kind.differences(kind.to_channels(back), channels)).max() < 4 * rounding * period


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("share", [0.0, -0.5])
@pytest.mark.parametrize("period", PERIODS)
def test_no_rounding_reaches_the_end_that_is_not_in_the_range(period, share, dtype):
    kind = circular(period, share * period)
    low, end = dtype(kind.low), dtype(kind.low) + dtype(period)
    near = np.array(
        [np.nextafter(end, low), end, np.nextafter(low, -end), low, low - dtype(1e-30), end * dtype(1 - 1e-7)]
    )
    for angles in (kind.wrapped(near), kind.to_values(kind.to_channels(near)), kind.wrapped(near - 7 * dtype(period))):
        assert np.all((angles >= low) & (angles < end))
    assert kind.wrapped(near)[1] == low
    assert np.abs(kind.differences(kind.to_channels(near), kind.to_channels(kind.wrapped(near)))).max() < 1e-6 * period


def test_wrapped():
    assert circular().wrapped(np.array([-10.0, 370.0, 725.0, 0.0, np.nan])) == pytest.approx(
        [350, 10, 5, 0, np.nan], nan_ok=True
    )
    assert circular(low=-180.0).wrapped(np.array([190.0, -190.0, 180.0, -180.0])).tolist() == [-170, 170, -180, -180]


def test_scalars_are_one_channel():
    data = np.arange(6.0, dtype=np.float32).reshape(2, 3)
    channels = Kind().to_channels(data)
    assert channels.shape == (1, 2, 3) and np.array_equal(Kind().to_values(channels), data)


@pytest.mark.parametrize(
    "layout", [np.ascontiguousarray, np.asfortranarray, lambda x: np.moveaxis(np.moveaxis(x, -1, 0).copy(), 0, -1)]
)
def test_vectors_have_their_channels_last(layout):
    data = layout(np.random.default_rng(0).normal(size=(4, 3, 2, 5)).astype(np.float32))
    data[1, 2, 0, 3] = np.nan
    kept = data.copy()
    channels = Kind("vector").to_channels(data)
    assert channels.shape == (5, 4, 3, 2) and channels.flags.c_contiguous
    assert np.isnan(channels[:, 1, 2, 0]).all() and np.isnan(channels).sum() == 5
    assert np.array_equal(data, kept, equal_nan=True)  # the caller's own
    whole = ~np.isnan(data).any(-1)
    back = Kind("vector").to_values(channels)
    assert back.flags.c_contiguous and np.array_equal(back[whole], data[whole])


@pytest.mark.parametrize("dtype", [np.complex64, np.complex128])
def test_complex_numbers_are_two_channels(dtype):
    data = np.array([1 + 2j, -3j, complex(np.nan, 1), complex(1, np.nan), 4], dtype)
    kind = Kind("vector", is_complex=True)
    channels = kind.to_channels(data)
    assert channels.shape == (2, 5) and channels.dtype == data.real.dtype
    assert np.isnan(channels[:, 2:4]).all()
    back = kind.to_values(channels)
    assert back.dtype == dtype and np.array_equal(back[[0, 1, 4]], data[[0, 1, 4]])


def test_missing_angles_are_missing_in_both_channels():
    assert np.isnan(circular().to_channels(np.array([np.nan, np.nan]))).all()
    assert np.isnan(circular().to_values(np.full((2, 3), np.nan))).all()


# --- differences and errors -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("period", PERIODS)
def test_differences_of_angles_take_the_short_way(period):
    kind, a, b = circular(period), np.array([0.99, 0.01, 0.6, 0.1, 0.25]), np.array([0.01, 0.99, 0.1, 0.1, 0.5])
    channels = [length * kind.to_channels(period * x) for x, length in ((a, 0.3), (b, 2.0))]
    got = kind.differences(*channels)
    assert got.shape == (1, 5) and got.dtype == float
    assert np.delete(got[0], 2) == pytest.approx(period * np.array([-0.02, 0.02, 0, -0.25]), abs=1e-12 * period)
    assert abs(got[0, 2]) == pytest.approx(period / 2)  # either way


def test_differences_of_other_kinds():
    a, b = np.random.default_rng(1).normal(size=(2, 3, 7)).astype(np.float32)
    for kind in (Kind(), Kind("vector")):
        got = kind.differences(a, b)
        assert got.dtype == float and np.array_equal(got, a.astype(float) - b)


def test_errors_are_squares_in_data_units():
    a, b = np.array([[3.0, 0.0], [4.0, 1.0]]), np.array([[0.0, 0.0], [0.0, -1.0]])
    assert Kind("vector").errors(a, b).tolist() == [25, 4]
    kind = circular(360.0)
    small = kind.errors(0.2 * kind.to_channels(np.array([359.5, 180.0])), kind.to_channels(np.array([0.5, 0.0])))
    assert small[0] == pytest.approx(1, rel=1e-4)  # of 1 degree
    assert small[1] == pytest.approx(2 * (360 / np.pi / 2) ** 2 * 2)  # the most there is
    assert np.isfinite(kind.errors(np.zeros((2, 1)), kind.to_channels(np.zeros(1)))).all()


@pytest.mark.parametrize("spread", [0.1, 0.6, 1.2])
def test_mean_error_of_angles_is_least_at_the_truth(spread):
    """However wide the noise, and though it wraps: neither the seam nor the noise's width draws the minimum aside."""
    kind, truth = circular(360.0), 3.0  # degrees, beside the seam
    noise = np.degrees(np.random.default_rng(2).normal(0, spread, 20_000))
    data = kind.to_channels(kind.wrapped(truth + np.concatenate([noise, -noise])))
    tried = np.arange(-90.0, 91.0) + truth
    mean = [kind.errors(kind.to_channels(np.array([x])), data).mean() for x in tried]
    assert tried[int(np.argmin(mean))] == truth
    # Above its least value by the error of x itself, times the mean cosine of the noise: what ranks two fits.
    for off in (20, 60):
        own = 2 * kind.unit**2 * (1 - np.cos(np.radians(off))) * np.cos(np.radians(noise)).mean()
        assert mean[90 + off] - mean[90] == pytest.approx(own, rel=1e-6)


@pytest.mark.parametrize("kind", [Kind(), Kind("vector")])
def test_mean_error_is_that_of_the_fit_and_of_the_noise(kind):
    noise = np.random.default_rng(3).normal(size=(2, 20_000))
    data = 5 + np.concatenate([noise, -noise], 1)
    mean = [kind.errors(np.full((2, 1), x), data).mean() for x in (5.0, 5.5)]
    assert mean[1] - mean[0] == pytest.approx(2 * 0.25, rel=1e-9)


# --- which kind -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("low", "high", "start", "warns"),
    [
        (0.0, 359.9, 0.0, None),
        (-180.0, 180.0, -180.0, None),
        (-170.0, 20.0, -180.0, None),
        (0.0, 360.0, 0.0, None),
        (0.0, 361.0, 0.0, "more than one period"),
        (0.0, 30_000.0, 0.0, "more than one period"),
        (0.0, 6.28, 0.0, "in their unit"),
        (10.0, 10.0, 0.0, None),
    ],
)
def test_range_of_angles_is_found(low, high, start, warns):
    data = np.append(np.linspace(low, high, 50), [np.nan, np.inf])
    kind, warning = kind_of("circular", data, 360.0)
    assert (kind.name, kind.period, kind.low) == ("circular", 360.0, start)
    assert kind.is_circular and kind.unit == pytest.approx(57.29578)
    assert warning is None if warns is None else warns in warning


def test_angles_of_another_unit_are_an_error():
    with pytest.raises(DataError, match="is --period in the unit"):
        kind_of("circular", np.linspace(0, 360, 50), 1.0)


def test_other_kinds_have_no_range():
    assert kind_of("scalar", np.array([np.nan, 1e9]), None) == (Kind(), None)
    assert kind_of("vector", np.ones((3, 2)), None) == (Kind("vector"), None)
    assert kind_of("vector", np.ones(3, complex), None) == (Kind("vector", is_complex=True), None)
    assert Kind("vector").unit == 1 and not Kind("vector").is_circular
    assert kind_of("circular", np.full(3, np.nan), 360.0) == (circular(), None)
