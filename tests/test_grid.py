"""Grids: spacing, orientation, comparison, and the words of a refusal."""

from __future__ import annotations

import numpy as np
import pytest
from twins import SPACING_MM, TWINS, volume, voxels

from beltrami_cli.errors import RefusedError
from beltrami_cli.grid import Canonical, Grid, Volume, extent, require_same_grid


@pytest.mark.parametrize(
    ("shape", "spacing", "full_shape", "steps"),
    [
        ((4, 5, 6), 1.0, (4, 5, 6), (1, 1, 1)),
        ((4, 5, 6), 0.8, (4, 5, 6), (0.8, 0.8, 0.8)),
        ((4, 5, 6), (1.0, 2.0, 3.0), (4, 5, 6), (1, 2, 3)),
        ((4, 5), 0.5, (4, 5, 1), (0.5, 0.5, 0.5)),
        ((4, 5), (0.5, 0.25), (4, 5, 1), (0.5, 0.25, 1)),
        ((4, 5, 6, 1), 2.0, (4, 5, 6), (2, 2, 2)),
    ],
)
def test_from_spacing(shape, spacing, full_shape, steps):
    grid = Grid.from_spacing(shape, spacing)
    assert grid.shape == full_shape
    assert np.array_equal(grid.affine, np.diag([*steps, 1.0]))


@pytest.mark.parametrize("name", TWINS)
def test_world_and_index_are_inverse(name):
    grid = TWINS[name]
    ijk = voxels(grid)
    assert np.allclose(grid.to_index(grid.to_world(ijk)), ijk, atol=1e-10)
    assert np.allclose(grid.spacing, SPACING_MM)
    assert not grid.is_sheared()


def test_handedness():
    signs = {"RAS": 1, "LAS": -1, "LPS": 1, "PSR": -1, "oblique": 1, "oblique left-handed": -1}
    assert {name: grid.handedness for name, grid in TWINS.items()} == signs


def test_shear_is_noticed():
    affine = np.eye(4)
    affine[1, 2] = 0.0646  # a gantry tilt of 3.7 degrees
    assert Grid((3, 3, 3), affine).is_sheared()


def test_grids_match_within_the_rounding_of_a_header():
    grid = TWINS["oblique"]
    assert grid.matches(Grid(grid.shape, grid.affine.astype(np.float32).astype(float)))
    moved = grid.affine.copy()
    moved[0, 3] += 0.01
    assert not grid.matches(Grid(grid.shape, moved))
    turned = grid.affine.copy()
    turned[:3, 0] *= 1.001  # by the last voxel 0.004 mm off
    assert not grid.matches(Grid(grid.shape, turned))


def test_corners_and_how_far_apart_they_are():
    grid = TWINS["LAS"]
    corners = grid.corners()
    assert np.allclose(corners.min(0), grid.affine[:3, 3] - [4, 0, 0])
    assert np.allclose(np.ptp(corners, axis=0), (np.array(grid.shape) - 1) * SPACING_MM)
    moved = grid.affine.copy()
    moved[:3, 3] += [3.0, 0, -4.0]
    assert grid.apart(Grid(grid.shape, moved)) == pytest.approx(5)
    assert grid.apart(TWINS["LPS"]) == pytest.approx(6 * SPACING_MM[1])
    assert grid.apart(grid) == 0


def test_extent():
    assert extent(np.array([[1, -5.125, 0], [2.5, 11.66, 0]])) == "1..2.5 x -5.125..11.66 x 0..0 mm"


def test_refusal_prints_both_grids():
    with pytest.raises(RefusedError) as refusal:
        require_same_grid(TWINS["RAS"], "psi.nii", TWINS["LAS"], "data.nii", remedy="resample it")
    first, *grids = str(refusal.value).splitlines()
    assert "data.nii does not lie on the grid of psi.nii" in first
    assert "(resample it)" in first
    assert grids == [f"  psi.nii: {TWINS['RAS'].describe()}", f"  data.nii: {TWINS['LAS'].describe()}"]
    assert "5 x 7 x 6 voxels of 1 x 1.25 x 2 mm, affine [-1 0 0 13;" in grids[1]


def test_volume_keeps_its_file_shape_and_header():
    grid = Grid.from_spacing((2, 3))
    volume = Volume(np.zeros((2, 3, 1), np.float32), grid, (2, 3), header="template", notes=("in doubt",))
    other = volume.with_data(np.ones((2, 3, 1), np.float32))
    assert (other.file_shape, other.header, other.data.sum()) == ((2, 3), "template", 6)
    assert other.notes == ("in doubt",)
    assert Volume(np.zeros((2, 3, 1)), grid).file_shape == (2, 3, 1)
    with pytest.raises(ValueError, match=r"\(3, 2, 1\)"):
        Volume(np.zeros((3, 2, 1)), grid)


def test_two_spacings_are_for_a_plane():
    assert Grid.from_spacing((4, 5), (2.0, 3.0)).spacing.tolist() == [2, 3, 1]
    with pytest.raises(RefusedError, match="two numbers"):
        Grid.from_spacing((4, 5, 6), (2.0, 3.0))


# --- canonical axes ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", TWINS)
def test_canonical_axes_run_towards_r_a_s_and_back(name):
    given = volume(TWINS[name])
    canonical = Canonical(given.grid)
    axes = canonical.grid.affine[:3, :3] / canonical.grid.spacing
    assert (np.diag(axes) > 0.7).all()
    forth = canonical.forth(given.data)
    assert forth.shape == canonical.grid.shape
    index = np.random.default_rng(0).integers(0, forth.shape, (50, 3))
    there = np.rint(given.grid.to_index(canonical.grid.to_world(index))).astype(int)
    assert np.array_equal(forth[tuple(index.T)], given.data[tuple(there.T)])
    assert np.array_equal(canonical.back(forth), given.data)
    frames = np.stack([given.data, -given.data], -1)
    assert np.array_equal(canonical.forth(frames)[..., 1], -forth)
    assert np.array_equal(canonical.back(canonical.forth(frames)), frames)


def test_canonical_axes_of_a_canonical_grid_are_its_own():
    for name in ("RAS", "oblique"):
        canonical = Canonical(TWINS[name])
        assert np.array_equal(canonical.grid.affine, TWINS[name].affine)
        assert np.shares_memory(canonical.forth(data := np.zeros(TWINS[name].shape)), data)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("name", TWINS)
def test_the_missing_axis_of_a_plane_comes_last(name, axis):
    shape = tuple(1 if a == axis else n for a, n in enumerate((5, 7, 6)))
    grid = Grid(shape, TWINS[name].affine)
    canonical = Canonical(grid)
    assert canonical.grid.shape[2] == 1 and sorted(canonical.grid.shape) == sorted(shape)
    data = np.random.default_rng(1).random(shape)
    assert np.array_equal(canonical.back(canonical.forth(data)), data)
    index = voxels(canonical.grid)
    there = np.rint(grid.to_index(canonical.grid.to_world(index))).astype(int)
    assert np.array_equal(canonical.forth(data)[tuple(index.T)], data[tuple(there.T)])
