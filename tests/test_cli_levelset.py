"""beltrami levelset: what it writes, what it says, what it refuses."""

import nibabel as nib
import numpy as np
import pytest
from command import ball, beltrami, contents, done, load, nifti, record, refused

from beltrami_cli import formats

SHAPE = (22, 20, 18)
MIDDLE = np.array([10.6, 9.7, 8.4])
RADIUS = 5.5


def sphere(path):
    import trimesh

    made = trimesh.creation.icosphere(subdivisions=4, radius=RADIUS)
    made.apply_translation(MIDDLE).export(path)
    return path


def true_on(path) -> np.ndarray:
    """The sphere's signed distance at the voxels of a file, in the file's order."""
    grid = formats.read_grid(path)
    x = grid.to_world(np.stack(np.indices(grid.shape), -1).reshape(-1, 3).astype(float))
    return (np.linalg.norm(x - MIDDLE, axis=1) - RADIUS).reshape(grid.shape)


@pytest.fixture
def mesh(tmp_path):
    return sphere(tmp_path / "s.ply")


@pytest.fixture
def rim(tmp_path):
    psi = ball(SHAPE, 0.0, MIDDLE)
    return nifti(tmp_path / "rim.nii.gz", np.select([psi < 3, psi < 6], [2, 3], 0).astype(np.int16))


def test_mesh_on_a_grid_of_its_own(tmp_path, mesh):
    run = done("levelset", mesh, "-o", tmp_path / "psi.nii.gz", "--spacing", "0.8", "--margin", "4")
    psi = load(tmp_path / "psi.nii.gz")
    assert psi.dtype == np.float32
    assert np.abs(psi - np.clip(true_on(tmp_path / "psi.nii.gz"), -4.8, 4.8)).max() < 0.01
    wrote, grid = run.out.splitlines()
    assert wrote == f"wrote {tmp_path / 'psi.nii.gz'}, {tmp_path / 'psi.json'}"
    told = record(tmp_path / "psi.json")
    assert [source["Role"] for source in told["Sources"]] == ["source"]
    assert set(told["Parameters"]) == {"labels", "between", "spacing", "margin", "frame", "half_width"}
    assert [told["Parameters"][name] for name in ("spacing", "margin")] == [[pytest.approx(0.8)], 4]
    assert told["Parameters"]["half_width"] == pytest.approx(4.8)
    assert told["Surface"] == {"made_of": "surface", "vertices": 2562, "closed": True}
    assert told["Grid"]["shape"] == list(psi.shape)
    assert told["Voxels"] == {"inside": (psi < 0).sum(), "outside": (psi >= 0).sum(), "unknown": 0}
    n = " x ".join(map(str, psi.shape))
    assert grid.startswith(f"{n} voxels of 0.8 x 0.8 x 0.8 mm, affine [")
    assert grid.endswith(f": {(psi < 0).mean():.1%} of the voxels inside")


def test_segmentation_on_its_own_grid(tmp_path, rim):
    affine = np.array([[0, -1.1, 0, 9], [0.9, 0, 0, -7], [0, 0, 1, 3], [0, 0, 0, 1.0]])
    turned = nifti(tmp_path / "turned.nii.gz", load(rim), affine)
    done("levelset", turned, "-o", tmp_path / "psi.nii.gz", "--labels", "2,3")
    assert np.array_equal(nib.load(tmp_path / "psi.nii.gz").affine, nib.load(turned).affine)
    assert np.array_equal(load(tmp_path / "psi.nii.gz") < 0, load(rim) >= 2)
    assert record(tmp_path / "psi.json")["Surface"]["made_of"] == "segmentation"
    done("levelset", rim, "-o", tmp_path / "mid.nii.gz", "--between", "2,0")
    mid = load(tmp_path / "mid.nii.gz")
    true = ball(SHAPE, 4.5, MIDDLE)
    assert np.median(np.abs(mid - true)[np.abs(true) < 2]) < 0.15


AXES = {"RAS": np.diag([1, 1, 1]), "LAS": np.diag([-1, 1, 1]), "LPS": np.diag([-1, -1, 1]), "oblique": None}


@pytest.mark.parametrize("axes", AXES.values(), ids=AXES)
@pytest.mark.parametrize("suffix", ["nii.gz", "mha", "mgz"])
def test_one_point_of_the_world_has_one_value_in_every_format(tmp_path, mesh, suffix, axes):
    from scipy.spatial.transform import Rotation

    turn = Rotation.from_euler("xyz", [20, -30, 10], degrees=True).as_matrix() if axes is None else axes
    affine = np.eye(4)
    affine[:3, :3] = turn @ np.diag([1, 0.9, 1.2])
    affine[:3, 3] = MIDDLE - affine[:3, :3] @ ((np.array(SHAPE) - 1) / 2)
    like = nifti(tmp_path / "like.nii.gz", np.zeros(SHAPE, np.float32), affine)
    out = tmp_path / f"psi.{suffix}"
    done("levelset", mesh, "-o", out, "--like", like)
    read = formats.read_volume(out)
    assert read.grid.matches(formats.read_grid(like))
    assert np.abs(read.data - np.clip(true_on(like), -7.2, 7.2)).max() < 0.01


def test_codes_of_the_grid_survive(tmp_path, mesh):
    like = nib.Nifti1Image(np.zeros(SHAPE, np.int16), np.eye(4))
    like.set_sform(np.eye(4), 4)
    like.set_qform(np.eye(4), 4)
    nib.save(like, tmp_path / "like.nii.gz")
    done("levelset", mesh, "-o", tmp_path / "psi.nii.gz", "--like", tmp_path / "like.nii.gz")
    header = nib.load(tmp_path / "psi.nii.gz").header
    assert (int(header["sform_code"]), int(header["qform_code"])) == (4, 4)
    assert header.get_data_dtype() == np.float32


def test_npy_keeps_no_voxel_size(tmp_path, mesh):
    run = beltrami("levelset", mesh, "-o", tmp_path / "psi.npy", "--spacing", "0.8")
    assert run.code == 0
    said = f"{tmp_path / 'psi.npy'}: keeps no voxel size; give --spacing 0.8,0.8,0.8 with it"
    assert run.err == f"beltrami: warning: {said}\n"
    assert record(tmp_path / "psi.json")["Warnings"] == [said]


def test_an_open_surface_is_told(tmp_path, mesh):
    import trimesh

    half = trimesh.load(mesh)
    half.update_faces(half.triangles_center[:, 2] < MIDDLE[2])
    half.export(tmp_path / "half.stl")
    run = beltrami("levelset", tmp_path / "half.stl", "-o", tmp_path / "psi.nii.gz")
    assert run.code == 0
    assert run.err.startswith(f"beltrami: warning: {tmp_path / 'half.stl'}: the surface has a border")
    step = record(tmp_path / "psi.json")["Grid"]["spacing_mm"][0]
    used = record(tmp_path / "psi.json")["Parameters"]
    assert (used["spacing"], used["margin"]) == ([step], pytest.approx(7 * step))
    assert done("levelset", tmp_path / "half.stl", "-o", tmp_path / "psi.nii.gz", "--overwrite", "-q").out == ""


def test_flows_take_it(tmp_path, mesh):
    """What is written is a level set: denoising on it and on the mesh's own surface agree."""
    psi = tmp_path / "psi.nii.gz"
    done("levelset", mesh, "-o", psi, "--spacing", "1")
    done("mesh", psi, "-o", tmp_path / "back.ply")
    points = formats.read_surface(tmp_path / "back.ply").vertices_ras_mm
    assert np.abs(np.linalg.norm(points - MIDDLE, axis=1) - RADIUS).max() < 0.02


@pytest.mark.parametrize(
    ("options", "said", "code"),
    [
        (["--labels", "2"], "is a surface, which has no labels", 2),
        (["--spacing", "1,1,2"], "expected one number", 2),
        (["--spacing", "0.001"], "give a larger --spacing", 2),
        (["--spacing", "-1"], "spacing", 2),
        (["--margin", "-1"], "expected 0 mm or more", 2),
        (["--like", "absent.nii.gz"], "no such file", 2),
        (["--spacing", "30", "--margin", "30"], "found voxels of 30 x 30 x 30 mm around a surface of 11 x 11 x 11", 1),
        (["--like", "far.nii.gz"], "the surface runs between no two voxels", 1),
        (["--like", "s.ply"], "expected", 2),
    ],
)
def test_refusals_on_a_mesh(tmp_path, monkeypatch, mesh, options, said, code):
    monkeypatch.chdir(tmp_path)
    far = np.eye(4)
    far[:3, 3] = 1000
    nifti(tmp_path / "far.nii.gz", np.zeros(SHAPE, np.float32), far)
    before = contents(tmp_path)
    assert said in refused("levelset", mesh, "-o", tmp_path / "psi.nii.gz", *options, code=code)
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ([], "holds the labels 0, 2, 3; --labels says which are inside"),
        (["--labels", "4"], "has no label 4; found 0, 2, 3"),
        (["--labels", "x"], "expected whole numbers or ranges"),
        (["--between", "2"], "expected INNER,OUTER"),
        (["--labels", "2", "--between", "2,0"], "give one of them"),
        (["--labels", "2", "--frame", "tkr"], "--frame is for surface files"),
        (["--labels", "2", "--margin", "3"], "--margin is for a grid around a surface"),
        (["--labels", "2", "--spacing", "1"], "--spacing is for a grid around a surface"),
    ],
)
def test_refusals_on_a_segmentation(tmp_path, rim, options, said):
    assert said in refused("levelset", rim, "-o", tmp_path / "psi.nii.gz", *options)
    assert not (tmp_path / "psi.nii.gz").exists()


def test_outputs_are_not_replaced_unasked(tmp_path, mesh, rim):
    assert "exists already" in refused("levelset", mesh, "-o", rim)
    assert "is an input" in refused("levelset", rim, "-o", rim, "--labels", "2", "--overwrite")
    assert "read only" in refused("levelset", mesh, "-o", tmp_path / "psi.png")
    assert "not the suffix" in refused("levelset", mesh, "-o", tmp_path / "psi.ply")
