"""The figures of a comparison, and the tolerances that judge them."""

import json
import math
import tracemalloc

import numpy as np
import pytest

from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.metrics import NoValues, Tolerances, difference, distance_between, wrapped
from beltrami_cli.surface import Mesh

RNG = np.random.default_rng(5)
A = RNG.normal(100, 20, (6, 5, 4))


def test_figures_of_known_differences():
    b = A + np.where(np.arange(A.size).reshape(A.shape) % 2, 3.0, -1.0)
    d = difference(A, b)
    assert (d.compared, d.only_in_a, d.only_in_b) == (A.size, 0, 0)
    assert d.max_abs == pytest.approx(3) and d.mean == pytest.approx(1) and d.rms == pytest.approx(math.sqrt(5))
    assert d.data_range == np.ptp(A)
    assert d.psnr == pytest.approx(10 * math.log10(np.ptp(A) ** 2 / 5))
    assert d.correlation == pytest.approx(np.corrcoef(A.ravel(), b.ravel())[0, 1])
    assert difference(A, b, data_range=255).psnr == pytest.approx(10 * math.log10(255**2 / 5))


def test_equal_arrays_have_infinite_psnr_and_null_in_json():
    d = difference(A, A)
    assert (d.max_abs, d.rms, d.mean, d.psnr) == (0, 0, 0, math.inf)
    assert d.correlation == pytest.approx(1)
    assert json.loads(json.dumps(d.as_dict(), allow_nan=False))["psnr"] is None
    assert d.exceeds(Tolerances(max_abs=0, max_rms=0, min_psnr=100, max_missing=0)) == []


def test_missing_values_are_counted_not_compared():
    a, b = A.copy(), A + 1
    a[0, 0, :2] = np.nan
    b[1, :3, 0] = np.nan
    b[0, 0, 0] = np.inf
    d = difference(a, b)
    assert (d.compared, d.only_in_a, d.only_in_b) == (A.size - 5, 3, 2)
    assert d.max_abs == pytest.approx(1) and d.mean == pytest.approx(1)


def test_infinite_values_that_differ_are_in_only_one():
    inf, nan = np.inf, np.nan
    #             both  alike            only in A                        only in B
    a = np.array([1.0, inf, -inf, nan, inf, -inf, inf, 2.0, 2.0, nan, nan, inf])
    b = np.array([1.5, inf, -inf, nan, -inf, inf, nan, -inf, nan, inf, 3.0, 3.0])
    d = difference(a, b)
    assert (d.compared, d.only_in_a, d.only_in_b, d.max_abs) == (1, 5, 3, 0.5)
    assert d.exceeds(Tolerances(max_missing=0)) != []
    d = difference(a, b, mask=np.arange(12) < 5)
    assert (d.compared, d.only_in_a, d.only_in_b) == (1, 1, 0)


def test_mask_limits_what_is_looked_at():
    b = A.copy()
    b[0] += 50
    b[1, 0, 0] = np.nan
    mask = np.zeros(A.shape, np.uint8)
    mask[1:3] = 2
    d = difference(A, b, mask=mask)
    assert (d.compared, d.only_in_a, d.max_abs) == (2 * 20 - 1, 1, 0)


def test_angles_differ_the_short_way_round():
    a, b = np.array([359.0, 10.0, 90.0, 200.0]), np.array([2.0, 350.0, 95.0, 200.0])
    d = difference(a, b, period=360)
    assert d.max_abs == pytest.approx(20) and d.mean == pytest.approx((3 - 20 + 5) / 4) and d.data_range == 360
    assert d.correlation == pytest.approx(0.96, abs=0.01)
    assert difference(a, b + 720, period=360).rms == pytest.approx(d.rms)
    assert difference(a, a + 360, period=360).rms < 1e-12
    assert np.allclose(wrapped(np.array([-0.6, 0.4, 0.5, 1.2]), 1.0), [0.4, 0.4, -0.5, 0.2])


def test_angles_all_around_the_circle_correlate_with_themselves():
    angles = np.linspace(0, 360, 720, endpoint=False)
    turned = (angles + 3 * np.random.default_rng(0).standard_normal(720)) % 360
    assert difference(angles, turned, period=360).correlation > 0.99
    assert difference(angles, -angles % 360, period=360).correlation < -0.99


def test_constant_data_have_no_correlation():
    d = difference(np.full(5, 2.0), np.arange(5.0))
    assert math.isnan(d.correlation) and d.as_dict()["correlation"] is None
    assert d.psnr == -math.inf and d.exceeds(Tolerances(min_psnr=0)) != []
    assert math.isnan(difference(np.full(5, 2.0), np.full(5, 3.0), period=360).correlation)


def test_each_broken_tolerance_has_its_line():
    d = difference(A, A + 2, data_range=200)
    assert d.psnr == pytest.approx(40)
    assert d.exceeds(Tolerances()) == [] and d.exceeds(Tolerances(max_abs=2.001, max_rms=2.001, min_psnr=39.9)) == []
    lines = d.exceeds(Tolerances(max_abs=1.5, max_rms=1, min_psnr=45))
    assert lines == ["largest difference 2 is over 1.5", "rms difference 2 is over 1", "PSNR 40.00 dB is under 45 dB"]


def test_values_in_one_of_both_are_judged_together():
    a, b = A.copy(), A.copy()
    a[0, 0, :2], b[1, :3, 0] = np.nan, np.inf
    d = difference(a, b)
    assert d.exceeds(Tolerances(max_missing=5)) == []
    assert d.exceeds(Tolerances(max_missing=4)) == ["5 values are in only one (3 in A, 2 in B), over 4"]


@pytest.mark.parametrize(
    "limits", [{"max_abs": -1}, {"max_rms": math.nan}, {"max_missing": -1}, {"min_psnr": math.nan}]
)
def test_tolerances_that_mean_nothing_are_refused(limits):
    with pytest.raises(RefusedError, match="tolerance m"):
        Tolerances(**limits)
    assert not Tolerances().are_given and not Tolerances(max_distance=0).are_of_values


TRIANGLES = np.array([[0, 1, 2], [1, 3, 2]], np.int32)
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], float)


def test_vertices_that_moved():
    moved = SQUARE.copy()
    moved[3] += 3, 0, 4
    d = distance_between(Mesh(SQUARE, TRIANGLES), Mesh(moved, TRIANGLES))
    assert (d.max_mm, d.rms_mm, d.same_triangles) == (5, 2.5, True)
    assert d.exceeds(Tolerances()) == [] and d.exceeds(Tolerances(max_distance=5)) == []
    assert d.exceeds(Tolerances(max_distance=4)) == ["vertices moved by up to 5 mm, over 4 mm"]
    assert d.exceeds(Tolerances(max_rms=9)) == ["vertices moved by up to 5 mm, over 0.001 mm"]


def test_surfaces_of_other_triangles():
    """The other diagonal and a fifth vertex in the middle change nothing; one that sticks out does, in one way only."""
    fan = np.array([[0, 1, 4], [1, 3, 4], [3, 2, 4], [2, 0, 4]], np.int32)
    for height in (0.0, 0.25):
        other = Mesh(np.vstack([SQUARE, [0.5, 0.5, height], [9, 9, 9]]), fan)  # the last is of no triangle
        for pair in ((Mesh(SQUARE, TRIANGLES), other), (other, Mesh(SQUARE, TRIANGLES))):
            d = distance_between(*pair)
            assert (d.max_mm, d.rms_mm, d.same_triangles) == (height, pytest.approx(height / 3), False)
    assert "surfaces, of other triangles, are apart by up to 0.25 mm" in d.exceeds(Tolerances(max_distance=0.2))[0]


def test_curves():
    lines = np.array([[0, 1], [1, 2]], np.int32)
    bent, straight = Mesh(SQUARE[:3], lines), Mesh(SQUARE[:2], lines[:1])
    assert distance_between(bent, Mesh(SQUARE[:3] + np.array([0, 0, 2]), lines)).rms_mm == 2
    assert distance_between(bent, straight).max_mm == 1


def test_integers_and_huge_values_do_not_overflow():
    assert difference(np.array([0, 255], np.uint8), np.array([255, 0], np.uint8)).max_abs == 255
    assert difference(np.array([0.0, 1e200]), np.array([1e200, 0.0])).exceeds(Tolerances(max_rms=1)) != []


@pytest.mark.parametrize("options", [{"period": 0}, {"period": -1}, {"data_range": float("nan")}, {"data_range": 0}])
def test_scales_that_are_not_positive_are_refused(options):
    with pytest.raises(RefusedError, match="expected a finite number above 0"):
        difference(A, A, **options)


def test_shapes_that_differ_are_refused():
    with pytest.raises(RefusedError, match=r"\(6, 5, 4\), \(6, 5\)"):
        difference(A, A[..., 0])
    with pytest.raises(RefusedError, match="shapes differ"):
        difference(A, A, mask=np.ones((6, 5)))


def test_no_voxel_in_common_is_an_error():
    nothing = np.full(A.shape, np.nan)
    with pytest.raises(DataError, match="120 have a finite value in A and 0 in B") as caught:
        difference(A, nothing)
    assert not isinstance(caught.value, NoValues)
    for a, b in ((nothing, nothing), (nothing - np.inf, nothing), (A * 0 + np.inf, A * 0 + np.inf)):
        with pytest.raises(NoValues, match="nothing to compare: of 120 places looked at, 0 have a finite value in A"):
            difference(a, b)
    for a, b, options in (
        (nothing, np.full(A.shape, np.inf), {}),  # is only in B
        (A, A, {"mask": np.zeros(A.shape)}),  # nothing is looked at
    ):
        with pytest.raises(DataError) as caught:
            difference(a, b, **options)
        assert not isinstance(caught.value, NoValues)


def test_what_is_compared_is_left_as_it_was():
    a, b = A.copy(), A + 1
    for options in ({}, {"period": 360.0}):
        difference(a, b, **options)
    assert np.array_equal(a, A) and np.array_equal(b, A + 1)


@pytest.mark.parametrize("period, most", [(None, 31), (360.0, 62)])
def test_memory(period, most):
    """Bytes beside A and B for each value: three of float64, of angles seven, and those of masks."""
    a = np.random.default_rng(0).normal(100, 5, 200_000)
    b = a + 1
    tracemalloc.start()
    try:
        difference(a, b, period=period)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak / a.size < most
