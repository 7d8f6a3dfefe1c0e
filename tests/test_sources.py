"""What a surface may be given as: told apart, labels picked, and measured."""

from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from command import ball, nifti, npy

from beltrami_cli import formats, sources
from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.grid import Grid, Volume
from beltrami_cli.sources import parse_between, parse_labels, read_levelset, read_source
from beltrami_cli.surface import Mesh

SHAPE = (22, 22, 22)
MIDDLE = (np.array(SHAPE) - 1) / 2 + 0.137


def distances(mesh: Mesh, centre: np.ndarray = MIDDLE) -> np.ndarray:
    return np.linalg.norm(mesh.vertices_ras_mm - centre, axis=1)


def faces_outwards(mesh: Mesh, centre: np.ndarray = MIDDLE) -> bool:
    a, b, c = (mesh.vertices_ras_mm[mesh.cells[:, k]] for k in range(3))
    return bool((np.einsum("ij,ij->i", np.cross(b - a, c - a), (a + b + c) / 3 - centre) > 0).all())


def shells(inner: float = 5.0, outer: float = 8.0) -> np.ndarray:
    """Labels 2 within, 3 between, 0 outside, 1 far outside, as floats."""
    psi = ball(SHAPE, 0.0)
    return np.select([psi < inner, psi < outer, psi > 11], [2.0, 3.0, 1.0], 0.0).astype(np.float32)


def icosphere(path: Path, radius: float = 6.0) -> Path:
    import trimesh

    trimesh.creation.icosphere(subdivisions=4, radius=radius).apply_translation(MIDDLE).export(path)
    return path


# What is what


def test_a_level_set_is_read_as_it_is(tmp_path):
    psi = ball(SHAPE)
    volume = read_source(nifti(tmp_path / "psi.nii.gz", psi))
    assert isinstance(volume, Volume)
    assert np.array_equal(volume.data, psi)


@pytest.mark.parametrize(("low", "high"), [(0, 1), (0, 255), (0, 0.5), (3, 4), (1, -1), (0, -1)])
def test_a_mask_is_a_segmentation(tmp_path, low, high):
    """Inside is what it marks: the higher value, or the one below 0."""
    mask = np.where(ball(SHAPE, 6.0) < 0, high, low).astype(np.float32)
    mesh = read_source(nifti(tmp_path / "mask.nii.gz", mask))
    assert isinstance(mesh, Mesh)
    assert np.abs(distances(mesh) - 6).max() < 0.5
    assert faces_outwards(mesh)


def test_a_surface_file_is_read_as_a_mesh(tmp_path):
    mesh = read_source(icosphere(tmp_path / "s.ply"))
    assert isinstance(mesh, Mesh)
    assert distances(mesh) == pytest.approx(np.full(2562, 6.0), abs=1e-5)


def test_an_image_of_real_numbers_is_no_segmentation(tmp_path):
    image = np.random.default_rng(0).random(SHAPE).astype(np.float32)
    assert isinstance(read_source(nifti(tmp_path / "image.nii.gz", image)), Volume)
    constant = read_source(nifti(tmp_path / "constant.nii.gz", np.ones(SHAPE, np.int16)))
    assert isinstance(constant, Volume)


# Labels


def test_labels_without_a_word_on_them_are_refused_by_name(tmp_path):
    path = nifti(tmp_path / "rim.nii.gz", shells().astype(np.int16))
    with pytest.raises(RefusedError, match=r"rim.nii.gz: holds the labels 0, 1, 2, 3; --labels .*--between"):
        read_source(path)


def test_many_labels_are_not_all_named(tmp_path):
    data = np.arange(22**3).reshape(SHAPE) % 300
    path = nifti(tmp_path / "t1.nii.gz", data.astype(np.int16))
    with pytest.raises(RefusedError, match=r"0, 1, 2, .* 39 \.\.\. 299 \(300 values\)"):
        read_source(path)


@pytest.mark.parametrize(("labels", "radius"), [("2", 5), ("2,3", 8), ("2-3", 8), ("2-200", 8), (" 2 , 3 ", 8)])
def test_labels_inside(tmp_path, labels, radius):
    mesh = read_source(nifti(tmp_path / "rim.nii.gz", shells()), labels=labels)
    assert isinstance(mesh, Mesh)
    assert np.abs(distances(mesh) - radius).max() < 0.5
    assert faces_outwards(mesh)


@pytest.mark.parametrize("between", ["2,0", "2,0+1", "2,0-1"])
def test_between_two_boundaries(tmp_path, between):
    mesh = read_source(nifti(tmp_path / "rim.nii.gz", shells()), between=between)
    assert isinstance(mesh, Mesh)
    assert np.median(distances(mesh)) == pytest.approx(6.5, abs=0.15)
    assert faces_outwards(mesh)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"labels": "7"}, "rim.nii.gz: has no label 7; found 0, 1, 2, 3"),
        ({"labels": "0-3"}, "rim.nii.gz: the segmentation has no boundary"),
        ({"labels": "2,10-20"}, "has no label 10-20; found 0, 1, 2, 3"),
        ({"between": "2,9"}, "has no label 9"),
        ({"between": "2+3,3"}, "share 3"),
        ({"labels": "2", "between": "2,0"}, "give one of them"),
        ({"labels": "2", "frame": "tkr"}, "--frame is for surface files"),
    ],
)
def test_labels_that_cannot_be(tmp_path, options, said):
    path = nifti(tmp_path / "rim.nii.gz", shells())
    with pytest.raises((RefusedError, DataError)) as caught:
        read_source(path, **options)
    assert said in str(caught.value)


@pytest.mark.parametrize("options", [{"labels": "1"}, {"between": "2,1"}])
def test_labels_are_for_segmentations(tmp_path, options):
    with pytest.raises(RefusedError, match=r"no whole numbers.*drop --labels"):
        read_source(nifti(tmp_path / "psi.nii.gz", ball(SHAPE)), **options)
    with pytest.raises(RefusedError, match=r"is a surface, which has no labels"):
        read_source(icosphere(tmp_path / "s.ply"), **options)


def test_parse_labels():
    assert parse_labels("2,41") == ((2, 2), (41, 41))
    assert parse_labels("5-255") == ((5, 255),)
    assert parse_between("2+41,0") == (((2, 2), (41, 41)), ((0, 0),))
    for wrong in ("", "a", "2,", "2;3", "-3", "5-2", "1.5", "2 3"):
        with pytest.raises(RefusedError, match="whole numbers or ranges"):
            parse_labels(wrong)
    for wrong in ("2", "2,1,0", "2,"):
        with pytest.raises(RefusedError):
            parse_between(wrong)


def test_unknown_voxels_bound_the_surface(tmp_path):
    labels = shells()
    labels[:, :, 14:] = np.nan
    mesh = read_source(nifti(tmp_path / "rim.nii.gz", labels), labels="2,3")
    assert isinstance(mesh, Mesh)
    assert 12 <= mesh.vertices_ras_mm[:, 2].max() <= 13


def test_notes_on_a_file_are_told(tmp_path):
    mask = (ball(SHAPE) < 0).astype(np.uint8)
    image = nib.Nifti1Image(mask, np.eye(4))
    image.set_sform(np.eye(4), 0)
    image.set_qform(np.eye(4), 0)
    nib.save(image, tmp_path / "mask.nii.gz")
    told: list[str] = []
    read_source(tmp_path / "mask.nii.gz", notify=told.append)
    assert len(told) == 1
    assert "sform and qform are both unset" in told[0]
    assert any("sform and qform" in line for line in read_levelset(tmp_path / "mask.nii.gz").notes)


# The level set of each


def made(path: Path, **options) -> np.ndarray:
    return read_levelset(path, **options).volume.data


def test_of_a_mask(tmp_path):
    mask = ball(SHAPE, 6.0) < 0
    psi = made(nifti(tmp_path / "mask.nii.gz", mask.astype(np.uint8)))
    assert np.array_equal(psi < 0, mask)
    near = np.abs(psi) < 3
    assert np.percentile(np.abs(psi - ball(SHAPE, 6.0))[near], 95) <= 0.35
    assert not np.isnan(psi).any()


@pytest.mark.parametrize("shape", [SHAPE, (22, 22, 3)])
def test_which_side_is_inside_is_kept(tmp_path, shape):
    """Of labels and of a level set, whole or cut off by their volume."""
    part = (slice(None), slice(None), slice(9, 9 + shape[2]) if shape[2] == 3 else slice(None))
    rim = nifti(tmp_path / "rim.nii.gz", shells()[part].astype(np.int16))
    ball_inside = made(rim, labels="2,3")
    assert np.array_equal(made(rim, labels="0,1"), -ball_inside)
    assert np.array_equal(made(rim, between="0+1,2"), -made(rim, between="2,0+1"))
    psi = ball(SHAPE, 6.0)[part]
    one, other = (made(nifti(tmp_path / f"{sign}.nii.gz", (sign * psi).astype(np.float32))) for sign in (1, -1))
    assert np.array_equal(other > 0, psi < 0)
    assert np.abs(one + other).max() < 0.05


def test_of_a_mask_that_its_volume_cuts_off(tmp_path):
    """The surface goes on beyond the faces of the volume: both sides are known up to them."""
    mask = np.broadcast_to(ball((22, 22), 6.0)[:, :, None] < 0, (22, 22, 3))
    psi = made(nifti(tmp_path / "slab.nii.gz", mask.astype(np.uint8)))
    assert np.array_equal(psi < 0, mask)
    assert np.isfinite(psi).all()
    assert np.abs(psi - psi[:, :, [1]]).max() < 0.05


def test_of_a_level_set_that_is_no_distance(tmp_path):
    true = ball(SHAPE, 6.0)
    steep = (3 * true + 0.2 * true**2).astype(np.float32)
    psi = made(nifti(tmp_path / "psi.nii.gz", steep))
    assert np.array_equal(psi < 0, true < 0)
    assert np.abs(psi - np.clip(true, -6, 6))[np.abs(true) < 5].max() < 0.08


def test_of_a_level_set_that_its_volume_cuts_off(tmp_path):
    true = ball(SHAPE, 6.0)[:, :, 9:12]
    psi = made(nifti(tmp_path / "psi.nii.gz", (2 * true).astype(np.float32)))
    assert np.array_equal(psi < 0, true < 0)
    assert np.isfinite(psi).all()
    assert np.abs(psi - true)[np.abs(true) < 3].max() < 0.15


def test_of_a_mesh_on_the_grid_of_a_volume(tmp_path):
    affine = np.array([[-0.9, 0, 0, 21.0], [0, 1.1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]])
    frames = nifti(tmp_path / "bold.nii.gz", np.zeros((*SHAPE, 3), np.float32), affine)
    like = formats.read_grid(frames, channels=True)
    found = read_levelset(icosphere(tmp_path / "s.ply"), like=frames)
    assert found.volume.grid.matches(like)
    x = like.to_world(np.stack(np.indices(SHAPE), -1).reshape(-1, 3).astype(float))
    true = np.linalg.norm(x - MIDDLE, axis=1) - 6
    assert np.abs(found.volume.data.ravel() - np.clip(true, -6.6, 6.6)).max() < 0.02
    assert found.notes == ()


def test_of_an_open_mesh(tmp_path):
    import trimesh

    half = trimesh.creation.icosphere(subdivisions=4, radius=6.0)
    half.update_faces(half.triangles_center[:, 2] < 0)
    half.apply_translation(MIDDLE).export(tmp_path / "half.ply")
    found = read_levelset(tmp_path / "half.ply")
    assert "has a border" in found.notes[0]
    assert np.isnan(found.volume.data).any()


def test_spacing_is_for_grids_that_have_none(tmp_path):
    mask = (ball(SHAPE, 6.0) < 0).astype(np.uint8)
    assert read_levelset(npy(tmp_path / "mask.npy", mask), spacing=(0.5,)).volume.grid.spacing == pytest.approx(0.5)
    assert read_levelset(icosphere(tmp_path / "s.ply"), spacing=(0.5,)).volume.grid.spacing == pytest.approx(0.5)
    nii = nifti(tmp_path / "mask.nii.gz", mask)
    for path, options, said in [
        (nii, {"spacing": (1.0,)}, "has the grid of"),
        (nii, {"margin": 3.0}, "--margin is for a grid around a surface"),
        (tmp_path / "s.ply", {"spacing": (1.0, 1.0, 2.0)}, "expected one number"),
        (tmp_path / "s.ply", {"like": nii, "margin": 3.0}, "--margin is for a grid around a surface"),
        (tmp_path / "s.ply", {"like": tmp_path / "s.ply"}, "is a surface; expected a volume"),
        (npy(tmp_path / "flat.npy", mask[:, :, 11]), {}, "is a plane"),
    ]:
        with pytest.raises(RefusedError) as caught:
            read_levelset(path, **options)
        assert said in str(caught.value)


def test_what_holds_no_surface(tmp_path):
    with pytest.raises(DataError, match="no zero level"):
        read_levelset(nifti(tmp_path / "image.nii.gz", np.full(SHAPE, 0.3, np.float32)))
    with pytest.raises(RefusedError, match="no such file"):
        read_levelset(tmp_path / "absent.nii.gz")


def test_surface_of_a_level_set_lies_in_the_world():
    affine = np.array([[0, 0, 1.2, -4], [-1.0, 0, 0, 30], [0, 0.8, 0, 7], [0, 0, 0, 1]])
    grid = Grid(SHAPE, affine)
    x = grid.to_world(np.stack(np.indices(SHAPE), -1).reshape(-1, 3).astype(float))
    centre = x.mean(0)
    psi = (np.linalg.norm(x - centre, axis=1) - 6).reshape(SHAPE).astype(np.float32)
    mesh = sources.surface_of(Volume(psi, grid))
    assert np.abs(distances(mesh, centre) - 6).max() < 0.02
    assert faces_outwards(mesh, centre)
