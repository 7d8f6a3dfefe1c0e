"""The command on surfaces: meshes and segmentations as LEVELSET, values at vertices, on the user's own surface."""

from __future__ import annotations

from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from command import ball, beltrami, done, load, nifti, record, refused
from nibabel.freesurfer import read_morph_data, write_geometry, write_morph_data
from scipy.spatial.transform import Rotation

from beltrami_cli import Mesh, denoise
from beltrami_cli.formats import write_mesh, write_overlay

L2 = ("--flow", "l2", "--iterations", 10)
SHAPE, RADIUS, CENTRE = (24, 24, 24), 8.0, 11.6
C_RAS = np.array([3.0, -7.0, 11.0])


def icosphere(radius: float = RADIUS, centre: float = CENTRE, splits: int = 3) -> Mesh:
    """Turned, so that no two vertices are equally near to a voxel: rounding in a file would choose between them."""
    trimesh = pytest.importorskip("trimesh")
    made = trimesh.creation.icosphere(subdivisions=splits, radius=radius)
    turn = Rotation.from_euler("xyz", [0.3, 0.5, 0.7]).as_matrix()
    return Mesh(np.array(made.vertices) @ turn.T + centre, np.array(made.faces, np.int32))


MESH = icosphere()
HEIGHT = ((MESH.vertices_ras_mm[:, 2] - CENTRE) / RADIUS).astype(np.float32)
NOISY = (10 * HEIGHT + np.random.default_rng(0).normal(size=len(HEIGHT))).astype(np.float32)
VOLUME = np.random.default_rng(1).normal(10 * (np.indices(SHAPE)[2] - CENTRE) / RADIUS).astype(np.float32)


def values(path: Path) -> np.ndarray:
    """(V,) or (V, K) of a GIFTI file."""
    return np.stack([array.data for array in nib.load(path).darrays], -1).squeeze()


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """lh.surf.gii and FreeSurfer's lh.white of it, lh.map.func.gii and lh.map, data.nii.gz and psi.nii.gz."""
    write_mesh(tmp_path / "lh.surf.gii", MESH)
    write_overlay(tmp_path / "lh.map.func.gii", NOISY)
    geometry = {
        "head": np.array([2, 0, 20], np.int32), "valid": "1  # volume info valid", "filename": "x.mgz",
        "volume": np.array([256, 256, 256]), "voxelsize": np.ones(3), "cras": C_RAS,
        "xras": np.array([-1.0, 0, 0]), "yras": np.array([0, 0, -1.0]), "zras": np.array([0, 1.0, 0]),
    }  # fmt: skip
    write_geometry(tmp_path / "lh.white", MESH.vertices_ras_mm - C_RAS, MESH.cells, volume_info=geometry)
    write_geometry(tmp_path / "lh.plain", MESH.vertices_ras_mm - C_RAS, MESH.cells)
    write_morph_data(tmp_path / "lh.map", NOISY)
    nib.save(nib.MGHImage(NOISY[:, None, None], np.eye(4)), tmp_path / "lh.map.mgz")
    nifti(tmp_path / "data.nii.gz", VOLUME)
    nifti(tmp_path / "psi.nii.gz", ball(SHAPE, RADIUS, (CENTRE,) * 3))
    monkeypatch.chdir(tmp_path)
    return tmp_path


# Mesh in, mesh out


def test_mesh_in_mesh_out(folder):
    run = done("denoise", "lh.surf.gii", "lh.map.func.gii", "-o", "o.func.gii", *L2)
    assert run.out.startswith("wrote o.func.gii, o.surf.gii, o.func.json\n")
    out, expected = values(Path("o.func.gii")), denoise(MESH, NOISY, flow="l2", iterations=10).data
    assert np.abs(out - expected).max() < 1e-4 * np.ptp(NOISY)
    error, before = (np.sqrt(np.mean((x - 10 * HEIGHT) ** 2)) for x in (out, NOISY))
    assert error < 0.5 * before
    vertices, triangles = (array.data for array in nib.load("o.surf.gii").darrays)
    assert np.allclose(vertices, MESH.vertices_ras_mm, atol=1e-5) and np.array_equal(triangles, MESH.cells)
    written = record(Path("o.func.json"))
    assert [source["Role"] for source in written["Sources"]] == ["levelset", "data"]
    assert written["Removed"]["vertices"] == len(HEIGHT)
    edge = np.linalg.norm(MESH.vertices_ras_mm[MESH.cells[:, 0]] - MESH.vertices_ras_mm[MESH.cells[:, 1]], axis=1)
    assert written["Grid"]["spacing_mm"] == pytest.approx([np.median(edge) / 1.5] * 3, rel=0.05)


@pytest.mark.parametrize("surface", ["lh.surf.gii", "lh.white", "lh.plain"])
@pytest.mark.parametrize("data", ["lh.map.func.gii", "lh.map", "lh.map.mgz"])
def test_the_result_is_the_same_from_every_format(folder, surface, data):
    done("denoise", surface, data, "-o", "o.func.gii", *L2)
    expected = denoise(MESH, NOISY, flow="l2", iterations=10).data
    assert np.abs(values(Path("o.func.gii")) - expected).max() < 1e-4 * np.ptp(NOISY)


@pytest.mark.parametrize(
    "out, files",
    [
        ("o.func.gii", ["o.func.gii", "o.surf.gii", "o.func.json"]),
        ("o.shape.gii", ["o.shape.gii", "o.surf.gii", "o.shape.json"]),
        ("o.mgz", ["o.mgz", "o.surf.gii", "o.json"]),
        ("lh.o", ["lh.o", "lh.o.surf.gii", "lh.o.json"]),
        ("o.curv", ["o.curv", "o.surf.gii", "o.json"]),
    ],
)
def test_what_is_written_for_an_output_at_vertices(folder, out, files):
    before = {path.name for path in folder.iterdir()}
    done("denoise", "lh.surf.gii", "lh.map.func.gii", "-o", out, *L2)
    assert {path.name for path in folder.iterdir()} - before == set(files)
    if out == "lh.o":
        expected = denoise(MESH, NOISY, flow="l2", iterations=10).data
        assert np.abs(read_morph_data(out) - expected).max() < 1e-4 * np.ptp(NOISY)


def test_meshes_that_are_named_hold_the_values(folder):
    done("denoise", "lh.surf.gii", "lh.map", "-o", "o.mgz", "--mesh", "m.surf.gii", "--mesh", "m.ply", *L2)
    expected = load(Path("o.mgz"))[:, 0, 0]
    assert np.array_equal(values(Path("m.func.gii")), expected)
    trimesh = pytest.importorskip("trimesh")
    found = trimesh.load("m.ply", process=False).metadata["_ply_raw"]["vertex"]["data"]["value"]
    assert np.array_equal(np.ravel(found), expected)
    done("denoise", "lh.surf.gii", "lh.map", "-o", "p.func.gii", "--mesh", "p.surf.gii", *L2)
    assert np.array_equal(values(Path("p.func.gii")), expected)


def test_one_map_of_several(folder):
    write_overlay(folder / "two.func.gii", np.stack([NOISY + 5, NOISY], -1))
    message = refused("denoise", "lh.surf.gii", "two.func.gii", "-o", "o.func.gii", *L2)
    assert "two.func.gii" in message and "--map" in message
    done("denoise", "lh.surf.gii", "two.func.gii", "-o", "o.func.gii", "--map", "2", *L2)
    one = values(Path("o.func.gii"))
    assert np.abs(one - denoise(MESH, NOISY, flow="l2", iterations=10).data).max() < 1e-4 * np.ptp(NOISY)
    done("denoise", "lh.surf.gii", "two.func.gii", "-o", "s.func.gii", "--kind", "vector", "--independent", *L2)
    assert np.allclose(values(Path("s.func.gii")), np.stack([one + 5, one], -1), atol=1e-3)
    assert nib.load("s.func.gii").darrays[0].intent == nib.nifti1.intent_codes["NIFTI_INTENT_TIME_SERIES"]


def test_holes_weights_and_mask_at_vertices(folder):
    hole = HEIGHT > 0.8
    write_overlay(folder / "hole.func.gii", np.where(hole, np.nan, NOISY).astype(np.float32))
    write_overlay(folder / "mask.func.gii", (~hole).astype(np.float32))
    wrong = np.where(hole, 1e3, NOISY).astype(np.float32)
    write_overlay(folder / "wrong.func.gii", wrong)
    results = {}
    for name, data, *options in (
        ("hole", "hole.func.gii"),
        ("mask", "wrong.func.gii", "--mask", "mask.func.gii"),
        ("weights", "wrong.func.gii", "--weights", "mask.func.gii"),
        ("missing", "wrong.func.gii", "--missing", 1000),
    ):
        done(
            "denoise", "lh.surf.gii", data, "-o", f"{name}.o.func.gii", "--filled", f"{name}.f.func.gii", *options, *L2
        )
        results[name] = values(Path(f"{name}.o.func.gii"))
        assert np.array_equal(values(Path(f"{name}.f.func.gii")) > 0, hole)
    assert all(np.allclose(found, results["hole"], atol=1e-5) for found in results.values())
    assert np.abs(results["hole"] - 10 * HEIGHT)[hole].max() < 3


# A mesh or a segmentation and a volume


def test_a_surface_with_a_volume(folder):
    done("denoise", "lh.white", "data.nii.gz", "-o", "o.nii.gz", *L2)
    done("denoise", "psi.nii.gz", "data.nii.gz", "-o", "p.nii.gz", *L2)
    got, expected = load(Path("o.nii.gz")), load(Path("p.nii.gz"))
    near = np.abs(ball(SHAPE, RADIUS, (CENTRE,) * 3)) < 2
    assert np.isfinite(got[near]).all() and np.abs(got - expected)[near].max() < 0.3  # of a range of 24
    vertices, triangles = (array.data for array in nib.load("o.surf.gii").darrays)
    assert np.allclose(vertices, MESH.vertices_ras_mm, atol=1e-4) and np.array_equal(triangles, MESH.cells)
    assert nib.load("o.surf.gii").meta["AnatomicalStructurePrimary"] == "CortexLeft"


@pytest.mark.parametrize(
    "levelset, options",
    [("mask", ()), ("labels", ("--labels", "2,41")), ("labels", ("--labels", "1-50")), ("rim", ("--between", "2,1"))],
)
def test_segmentations_on_grids_of_their_own(folder, levelset, options):
    """On a grid twice as fine as that of the data, whose surface is a sphere of 8 mm."""
    fine = np.eye(4) * [0.5, 0.5, 0.5, 1]
    r = np.sqrt(((0.5 * np.indices((48, 48, 48)) - CENTRE) ** 2).sum(0))
    images = {
        "mask": r < RADIUS,
        "labels": np.where(r < RADIUS, np.where(np.indices(r.shape)[0] > 24, 2, 41), 77 * (r > 11)),
        "rim": np.select([r < RADIUS - 2, r > RADIUS + 2], [2, 1], 3),
    }
    nifti(folder / "seg.nii.gz", images[levelset].astype(np.uint8), fine)
    done("denoise", "seg.nii.gz", "data.nii.gz", "-o", "o.nii.gz", *options, *L2)
    vertices = nib.load("o.surf.gii").darrays[0].data
    radius = np.linalg.norm(vertices - CENTRE, axis=1)
    assert np.abs(radius - RADIUS).max() < 0.3 and abs(radius.mean() - RADIUS) < 0.05
    done("denoise", "psi.nii.gz", "data.nii.gz", "-o", "p.nii.gz", *L2)
    near = np.abs(ball(SHAPE, RADIUS, (CENTRE,) * 3)) < 1
    assert np.abs(load(Path("o.nii.gz")) - load(Path("p.nii.gz")))[near].mean() < 0.1


def test_labels_are_asked_for(folder):
    nifti(folder / "seg.nii.gz", (np.indices(SHAPE)[0] // 8).astype(np.uint8))
    message = refused("denoise", "seg.nii.gz", "data.nii.gz", "-o", "o.nii.gz")
    assert "0, 1, 2" in message and "--labels" in message and "--between" in message
    message = refused("denoise", "seg.nii.gz", "data.nii.gz", "-o", "o.nii.gz", "--labels", "7")
    assert "no label 7" in message and "0, 1, 2" in message


# On the user's own surface


def test_values_on_other_surfaces(folder):
    write_mesh(folder / "outer.surf.gii", icosphere(RADIUS + 1, splits=2))
    arguments = ("--on", "lh.white=on.func.gii", "--on", "outer.surf.gii=rh.outer")
    done("denoise", "psi.nii.gz", "data.nii.gz", "-o", "o.nii.gz", *arguments, *L2)
    on = values(Path("on.func.gii"))
    done("denoise", "lh.white", "data.nii.gz", "-o", "w.nii.gz", *L2)
    assert np.abs(on - values(Path("w.func.gii"))).max() < 0.3
    outer = read_morph_data("rh.outer")
    assert len(outer) == 162 and np.isfinite(outer).all()
    assert np.abs(outer - on[:162]).max() < 0.3  # icospheres start alike; values are constant along normals
    assert [source.get("Role") for source in record(Path("o.json"))["Sources"]] == ["levelset", "data", "on", "on"]


def test_angles_and_channels_on_a_surface(folder):
    angle = np.degrees(np.arctan2(*(np.indices(SHAPE)[:2] - CENTRE))) % 360
    nifti(folder / "angle.nii.gz", angle.astype(np.float32))
    arguments = ("--on", "lh.white=on.func.gii", "--kind", "circular", "--period", 360)
    done("denoise", "psi.nii.gz", "angle.nii.gz", "-o", "o.nii.gz", *arguments, *L2)
    side = MESH.vertices_ras_mm - CENTRE
    true = np.degrees(np.arctan2(side[:, 0], side[:, 1])) % 360
    away = np.hypot(side[:, 0], side[:, 1]) > 4
    assert np.abs((values(Path("on.func.gii")) - true + 180) % 360 - 180)[away].max() < 3
    nifti(folder / "two.nii.gz", np.stack([VOLUME, VOLUME + 5], -1))
    for options in ((), ("--independent",)):
        arguments = ("--on", "lh.white=two.func.gii", "--kind", "vector", *options, "--overwrite")
        done("denoise", "psi.nii.gz", "two.nii.gz", "-o", "t.nii.gz", *arguments, *L2)
        first, second = values(Path("two.func.gii")).T
        assert np.allclose(first + 5, second, atol=1e-3) and np.ptp(first) > 5


def test_vertices_beyond_the_band_are_told(folder):
    write_mesh(folder / "far.surf.gii", icosphere(RADIUS, centre=CENTRE + 5))
    run = beltrami("denoise", "psi.nii.gz", "data.nii.gz", "-o", "o.nii.gz", "--on", "far.surf.gii=far.func.gii", *L2)
    lost = int(np.isnan(values(Path("far.func.gii"))).sum())
    assert run.code == 0 and 50 < lost < 600 and f"{lost} of 642 vertices" in run.err
    write_mesh(folder / "off.surf.gii", icosphere(RADIUS, centre=CENTRE + 100))
    message = refused(
        "denoise", "psi.nii.gz", "data.nii.gz", "-o", "q.nii.gz", "--on", "off.surf.gii=off.func.gii", *L2, code=1
    )
    assert "none of the 642 vertices" in message and "--frame" in message
    message = refused("denoise", "off.surf.gii", "data.nii.gz", "-o", "q.nii.gz", *L2, code=1)
    assert "outside of the volume" in message and "--frame" in message


def test_coordinates_that_the_file_does_not_tell(folder):
    message = refused("denoise", "lh.plain", "data.nii.gz", "-o", "o.nii.gz", *L2)
    assert "--frame tkr" in message and "--frame scanner" in message
    conformed = np.array([[-1.0, 0, 0, 12], [0, 0, 1, -12], [0, -1, 0, 12], [0, 0, 0, 1]])
    conformed[:3, 3] += C_RAS  # its centre at c_ras: FreeSurfer's coordinates are those of the world less that
    nifti(folder / "c.nii.gz", np.zeros(SHAPE, np.float32) + VOLUME, conformed)
    arguments = ("--frame", "tkr", "--on", "lh.plain=on.func.gii")
    write_geometry("lh.plain", MESH.vertices_ras_mm - CENTRE, MESH.cells)  # in the middle of that volume
    done("denoise", "lh.plain", "c.nii.gz", "-o", "o.nii.gz", *arguments, *L2)
    placed = nib.load("o.surf.gii").darrays[0].data
    assert np.allclose(placed, MESH.vertices_ras_mm - CENTRE + C_RAS, atol=1e-4)


# Refusals


@pytest.mark.parametrize(
    "arguments, words",
    [
        (("psi.nii.gz", "lh.map.func.gii", "-o", "o.nii.gz"), ("lh.map.func.gii", "vertices")),
        (("lh.map.func.gii", "lh.surf.gii", "-o", "o.func.gii"), ("lh.surf.gii", "swapped")),
        (("psi.nii.gz", "data.nii.gz", "-o", "o.func.gii"), ("o.func.gii", "--on")),
        (("lh.surf.gii", "lh.map", "-o", "o.nii.gz"), ("o.nii.gz", ".func.gii")),
        (("lh.surf.gii", "lh.map", "-o", "o.func.gii", "--depth", "0:1"), ("depth", "vertices")),
        (("lh.surf.gii", "lh.map", "-o", "o.func.gii", "--outside", "zero"), ("outside",)),
        (("lh.surf.gii", "lh.map", "-o", "o.func.gii", "--resample"), ("resample",)),
        (("lh.surf.gii", "lh.map", "-o", "o.func.gii", "--extension", "pde"), ("extension",)),
        (("lh.surf.gii", "lh.map", "-o", "o.func.gii", "--inside", "positive"), ("inside",)),
        (("lh.surf.gii", "lh.map", "-o", "o.func.gii", "--labels", "2"), ("labels", "lh.surf.gii")),
        (("lh.surf.gii", "lh.map", "-o", "o.func.gii", "--spacing", "1,2,1"), ("spacing", "cubes")),
        (("lh.surf.gii", "lh.map", "-o", "o.func.gii", "--spacing", "1e-4"), ("spacing", "larger")),
        (("lh.surf.gii", "lh.map", "-o", "o.func.gii", "--weights", "data.nii.gz"), ("data.nii.gz", "642")),
        (("lh.surf.gii", "lh.map", "-o", "o.func.gii", "--on", "lh.white"), ("SURFACE=FILE",)),
        (("lh.surf.gii", "lh.map", "-o", "o.func.gii", "--on", "lh.white=o.func.gii"), ("o.func.gii", "two outputs")),
        (("psi.nii.gz", "data.nii.gz", "-o", "o.nii.gz", "--on", "lh.white=o.func.gii"), ("o.func.gii", "--no-mesh")),
        (("lh.surf.gii", "lh.map", "-o", "o.func.gii", "--on", "lh.gone=p.func.gii"), ("lh.gone", "no such file")),
        (("lh.surf.gii", "lh.map", "-o", "lh.map"), ("lh.map", "input")),
        (("lh.surf.gii", "data.nii.gz", "-o", "o.nii.gz", "--map", "2"), ("map", "volume")),
        (("lh.surf.gii", "lh.map", "-o", "o.func.gii", "--structure", "Spleen"), ("Spleen", "CortexLeft")),
        (("--flat", "lh.map.func.gii", "-o", "o.func.gii"), ("lh.map.func.gii", "flat")),
    ],
)  # fmt: skip
def test_refusals(folder, arguments, words):
    before = {path.name for path in folder.iterdir()}
    message = refused("denoise", *arguments)
    assert all(word in message for word in words), message
    assert {path.name for path in folder.iterdir()} == before


def test_a_config_of_surfaces(folder):
    (folder / "c.toml").write_text(
        '[input]\nlevelset = "lh.surf.gii"\ndata = "lh.map.func.gii"\nmap = 1\n'
        '[output]\nvolume = "c.func.gii"\non = ["lh.white=c.on.func.gii"]\nstructure = "right"\n'
        '[flow]\nname = "l2"\n[time]\niterations = 10\n'
    )
    done("denoise", "--config", "c.toml")
    done("denoise", "lh.surf.gii", "lh.map.func.gii", "-o", "o.func.gii", *L2)
    assert np.array_equal(values(Path("c.func.gii")), values(Path("o.func.gii")))
    assert np.allclose(values(Path("c.on.func.gii")), values(Path("o.func.gii")), atol=1e-3)
    assert nib.load("c.surf.gii").meta["AnatomicalStructurePrimary"] == "CortexRight"


def test_a_space_that_is_not_told_is_not_claimed(folder):
    for surface, space in (("lh.plain", 0), ("lh.white", 1)):
        done("denoise", surface, "lh.map", "-o", f"{surface}.func.gii", *L2)
        written = nib.load(f"{surface}.surf.gii").darrays[0]
        assert written.coordsys.dataspace == space
    assert np.allclose(nib.load("lh.plain.surf.gii").darrays[0].data, MESH.vertices_ras_mm - C_RAS, atol=1e-4)


def test_hemispheres_are_not_mixed(folder):
    write_overlay(folder / "right.func.gii", NOISY, structure="CortexRight")
    message = refused("denoise", "lh.surf.gii", "right.func.gii", "-o", "o.func.gii", *L2)
    assert "CortexRight" in message and "CortexLeft" in message
    done("denoise", "lh.surf.gii", "right.func.gii", "-o", "o.func.gii", "--structure", "right", *L2)


def test_channels_that_a_format_cannot_hold_are_refused_before_the_run(folder):
    write_overlay(folder / "two.func.gii", np.stack([NOISY, NOISY], -1))
    message = refused("denoise", "lh.surf.gii", "two.func.gii", "-o", "lh.o", "--kind", "vector")
    assert message.startswith("lh.o: ") and ".func.gii" in message
    nifti(folder / "two.nii.gz", np.stack([VOLUME, VOLUME], -1))
    message = refused(
        "denoise", "psi.nii.gz", "two.nii.gz", "-o", "o.nii.gz", "--kind", "vector", "--on", "lh.white=lh.o"
    )
    assert message.startswith("lh.o: ")


def test_one_map_as_a_series(folder):
    done("denoise", "lh.surf.gii", "lh.map", "-o", "s.func.gii", "--kind", "vector", "--independent", *L2)
    done("denoise", "lh.surf.gii", "lh.map", "-o", "o.func.gii", *L2)
    assert np.array_equal(values(Path("s.func.gii")), values(Path("o.func.gii")))


def test_planes_and_labels(folder):
    plane = nifti(folder / "plane.nii.gz", (ball((32, 32), 10) < 0).astype(np.uint8)[..., None])
    data = nifti(folder / "flat.nii.gz", np.random.default_rng(0).normal(size=(32, 32, 1)).astype(np.float32))
    message = refused("denoise", plane, data, "-o", "o.nii.gz", "--labels", 1)
    assert "plane" in message and "labels" in message
    message = refused("denoise", "lh.surf.gii", data, "-o", "o.nii.gz")
    assert "plane" in message


def test_headers_survive_resampling_onto_a_segmentation(folder):
    mask = nib.Nifti1Image((ball(SHAPE, RADIUS, (CENTRE,) * 3) < 0).astype(np.uint8), np.eye(4))
    mask.header["descrip"] = b"mine"
    mask.set_sform(np.eye(4), code=4)
    nib.save(mask, "mask.nii.gz")
    shifted = np.eye(4)
    shifted[:3, 3] = 0.3
    nifti(folder / "shifted.nii.gz", VOLUME, shifted)
    done("denoise", "mask.nii.gz", "shifted.nii.gz", "-o", "o.nii.gz", "--resample", *L2)
    out = nib.load("o.nii.gz")
    assert int(out.header["sform_code"]) == 4 and out.header["descrip"].tobytes().startswith(b"mine")
    assert np.allclose(out.affine, np.eye(4))


def test_a_surface_that_faces_inwards_is_turned_for_depth(folder):
    write_mesh(folder / "lh.in.surf.gii", Mesh(MESH.vertices_ras_mm, MESH.cells[:, ::-1]))
    radius = np.sqrt(((np.indices(SHAPE) - CENTRE) ** 2).sum(0))
    nifti(folder / "radius.nii.gz", radius.astype(np.float32))
    run = beltrami("denoise", "lh.in.surf.gii", "radius.nii.gz", "-o", "o.nii.gz", "--depth", "0:2", *L2)
    assert run.code == 0 and "face inwards" in run.err
    assert np.abs(values(Path("o.func.gii")) - RADIUS - 1).max() < 0.1


def test_surfaces_of_another_unit_are_told(folder):
    write_mesh(folder / "metres.surf.gii", Mesh(MESH.vertices_ras_mm / 1000 + 10, MESH.cells))
    message = refused("denoise", "metres.surf.gii", "data.nii.gz", "-o", "o.nii.gz", *L2, code=1)
    assert "metres" in message
    run = beltrami("denoise", "lh.surf.gii", "lh.map", "-o", "o.func.gii", "--spacing", "5", *L2)
    assert run.code == 0 and "spacing: voxels of 5 mm" in run.err


def test_the_mesh_of_labels(folder):
    nifti(folder / "seg.nii.gz", (np.indices(SHAPE)[0] // 8).astype(np.uint8))
    assert "beltrami levelset --labels" in refused("mesh", "seg.nii.gz", "-o", "m.ply")
    done("mesh", nifti(folder / "mask.nii.gz", (ball(SHAPE, 6.0) < 0).astype(np.uint8)), "-o", "m.ply")


def test_maps_keep_their_names(folder):
    write_overlay(folder / "lh.two.func.gii", np.stack([NOISY, NOISY], -1), names=["angle", "ecc"])
    done("denoise", "lh.surf.gii", "lh.two.func.gii", "-o", "o.func.gii", "--kind", "vector", *L2)
    done("denoise", "lh.surf.gii", "lh.two.func.gii", "-o", "e.func.gii", "--map", "ecc", *L2)
    for name, names in (("o", ["angle", "ecc"]), ("e", ["ecc"])):
        arrays = nib.load(f"{name}.func.gii").darrays
        assert [array.meta["Name"] for array in arrays] == names
        assert {array.intent for array in arrays} == {nib.nifti1.intent_codes["NIFTI_INTENT_NONE"]}
