"""Values brought onto another grid: by place in the world, with missing ones left out."""

from __future__ import annotations

import numpy as np
import pytest
from twins import TWINS, volume, voxels

from beltrami_cli.grid import Grid, Volume
from beltrami_cli.resample import at_points, resample


def linear(ras_mm):
    return ras_mm @ [3.0, -5.0, 7.0] + 2.0


def linear_volume(grid, dtype=np.float64):
    return Volume(linear(grid.to_world(voxels(grid))).reshape(grid.shape).astype(dtype), grid)


@pytest.mark.parametrize("source", TWINS)
@pytest.mark.parametrize("target", TWINS)
def test_linear_fields_are_exact_between_any_two_grids(source, target):
    got = resample(linear_volume(TWINS[source]), TWINS[target])
    expected = linear_volume(TWINS[target]).data
    inside = np.isfinite(got.data)
    index = TWINS[source].to_index(TWINS[target].to_world(voxels(TWINS[target])))
    last = np.array(TWINS[source].shape) - 1
    within = np.all((index >= -1e-6) & (index <= last + 1e-6), axis=1).reshape(got.data.shape)
    assert inside[within].all() and within.any()
    assert np.abs(got.data - expected)[within].max() < 1e-9
    assert got.grid is TWINS[target]


def test_own_grid_gives_the_same_values():
    given = volume(TWINS["oblique"])
    got = resample(given, TWINS["oblique"])
    assert np.allclose(got.data, given.data, rtol=1e-5)
    assert got.data.dtype == given.data.dtype == np.float32


def test_finer_grid_lies_between_the_voxels():
    coarse = Volume(np.arange(8.0).reshape(2, 2, 2), Grid.from_spacing((2, 2, 2), 2.0))
    fine = Grid((3, 3, 3), np.eye(4))
    expected = np.arange(0, 2.5, 0.5)[None, None, [0, 1, 2]] + np.array([0, 2, 4.0])[:, None, None]
    assert np.allclose(resample(coarse, fine).data, expected + np.array([0, 1, 2.0])[None, :, None])


def test_outside_is_missing():
    source = linear_volume(Grid.from_spacing((5, 5, 5)))
    affine = np.eye(4)
    affine[0, 3] = 3.0
    got = resample(source, Grid((5, 5, 5), affine)).data
    assert np.isfinite(got[:2]).all() and np.isnan(got[2:]).all()


@pytest.mark.parametrize("garbage", [np.nan, np.inf, -np.inf])
def test_missing_values_take_no_part(garbage):
    data = np.full((6, 6, 6), 5.0)
    data[2:4, 2:4, 2:4] = garbage
    affine = np.eye(4)
    affine[:3, 3] = 0.25
    got = resample(Volume(data, Grid.from_spacing((6, 6, 6))), Grid((5, 5, 5), affine)).data
    assert np.allclose(got[np.isfinite(got)], 5.0)
    assert np.isnan(got[2, 2, 2]) and np.isfinite(got[1, 1, 1])  # all, and one in 64, of the weight on the hole


def test_planes():
    image = Volume(np.arange(12.0).reshape(4, 3, 1), Grid.from_spacing((4, 3)))
    affine = np.eye(4)
    affine[0, 3] = 0.5
    got = resample(image, Grid((3, 3, 1), affine)).data
    assert np.allclose(got[:, :, 0], image.data[:3, :, 0] + 1.5)


def test_channels_and_complex_numbers_are_moved_one_by_one():
    source, target = linear_volume(TWINS["RAS"]), TWINS["oblique"]
    one, other = resample(source, target).data, resample(source.with_data(source.data**2), target).data
    several = resample(Volume(np.stack([source.data, source.data**2], -1), source.grid), target)
    assert several.data.shape == (*target.shape, 2)
    assert np.array_equal(several.data, np.stack([one, other], -1), equal_nan=True)
    waves = resample(source.with_data(source.data + 1j * source.data**2), target).data
    known = np.isfinite(one)
    assert np.array_equal(known, np.isfinite(waves))
    assert np.allclose(waves[known], (one + 1j * other)[known], rtol=1e-12)


@pytest.mark.parametrize(
    ("first", "second", "middle"), [(350, 20, 5), (10, 50, 30), (-170, 150, 170), (-170, 170, -180)]
)
def test_angles_turn_through_the_wrap(first, second, middle):
    angles = np.full((2, 3, 3), np.float32(first))
    angles[1] = second
    half = Grid((1, 3, 3), np.array([[1, 0, 0, 0.5], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]]))
    moved = resample(Volume(angles, Grid.from_spacing(angles.shape)), half, period=360.0)
    assert moved.data.dtype == np.float32
    off = (moved.data - middle + 180) % 360 - 180
    assert np.abs(off).max() < 1e-4
    low = -180 if first < 0 else 0
    assert (low <= moved.data).all() and (moved.data < low + 360).all()


def test_missing_angles_take_no_part():
    angles = np.array([[[350.0, np.nan, 20.0]]])
    grid = Grid.from_spacing(angles.shape)
    moved = resample(Volume(angles, grid), grid, period=360.0).data
    assert np.allclose(moved, angles, equal_nan=True)


# --- at points -----------------------------------------------------------------------------------------------------


def scattered(grid, count=500, beyond=0.0, seed=0):
    """Points (count, 3) in RAS mm, within the outermost voxel centres and so many voxels beyond them."""
    share = np.random.default_rng(seed).random((count, 3))
    return grid.to_world(-beyond + share * (np.array(grid.shape) - 1 + 2 * beyond))


@pytest.mark.parametrize("name", TWINS)
def test_linear_fields_are_exact_at_points(name):
    points = scattered(TWINS[name])
    got = at_points(linear_volume(TWINS[name]), points)
    assert got.shape == (500,)
    assert np.abs(got - linear(points)).max() < 1e-9
    assert at_points(volume(TWINS[name]), points).dtype == np.float32


def test_points_have_the_values_of_a_grid_through_them():
    source, target = TWINS["PSR"], TWINS["oblique"]
    data = np.random.default_rng(1).normal(size=(*source.shape, 2))
    data[np.random.default_rng(2).random(data.shape) < 0.3] = np.nan
    given = Volume(data, source)
    got = at_points(given, target.to_world(voxels(target))).reshape(*target.shape, 2)
    assert np.allclose(got, resample(given, target).data, atol=1e-9, equal_nan=True)
    assert 0.1 < np.isnan(got).mean() < 0.9


def test_points_outside_have_no_value():
    grid = TWINS["oblique left-handed"]
    points = scattered(grid, 2000, beyond=2.0)
    index = grid.to_index(points)
    past = np.maximum(-index, index - (np.array(grid.shape) - 1)).max(1)
    got = at_points(linear_volume(grid), points)
    assert np.isnan(got[past > 0.5]).all() and np.isfinite(got[past <= 0]).all()
    assert np.isnan(at_points(linear_volume(grid), points + 1e4)).all()


def test_midway_to_a_missing_voxel_has_its_value():
    """By the rule, not by how the weights were rounded: from either side, in either precision."""
    for dtype in (np.float32, np.float64):
        data = np.array([[[np.nan, 5.0, 5.0, np.nan]]], dtype).repeat(2, 0).repeat(2, 1)
        affine = np.diag([0.7, 0.7, 0.7, 1.0])
        affine[:3, 3] = 17.3
        points = Grid(data.shape, affine).to_world(np.array([[0.3, 0.7, 0.5], [0.3, 0.7, 2.5], [0.3, 0.7, 0.49]]))
        assert np.allclose(at_points(Volume(data, Grid(data.shape, affine)), points), [5, 5, np.nan], equal_nan=True)


def test_angles_at_points_turn_through_the_wrap():
    angles = np.array([350.0, 20.0, np.nan, 90.0]).reshape(4, 1, 1)
    given = Volume(angles, Grid(angles.shape, np.eye(4)))
    at = np.array([[0.5, 0, 0], [0, 0, 0], [1.4, 0, 0], [2, 0, 0], [2.6, 0, 0]])
    got = at_points(given, at, period=360.0)
    assert np.allclose(got, [5, 350, 20, np.nan, 90], equal_nan=True)
    signed = given.with_data(np.where(angles > 180, angles - 360, angles))
    assert np.allclose(at_points(signed, at, period=360.0)[:2], [5, -10])


def test_channels_and_complex_numbers_at_points():
    source = linear_volume(TWINS["LAS"])
    points = scattered(source.grid)
    one, other = linear(points), at_points(source.with_data(source.data**2), points)
    several = at_points(Volume(np.stack([source.data, source.data**2], -1), source.grid), points)
    assert np.allclose(several, np.stack([one, other], -1), rtol=1e-12)
    waves = at_points(source.with_data(source.data + 1j * source.data**2), points)
    assert np.allclose(waves, one + 1j * other, rtol=1e-12)
