"""From files to files: the same numbers whatever the format, in the right place in the world, and nothing invented."""

from __future__ import annotations

from pathlib import Path

import meshio
import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
import trimesh
from command import ball, beltrami, done, load, nifti, noisy, npy, record, refused, seen

from beltrami_cli import formats
from beltrami_cli.grid import Grid, Volume

AXES = np.linalg.qr(np.array([[0.8, -0.5, 0.3], [0.5, 0.8, 0.2], [-0.3, 0.1, 1.0]]))[0]
LEFT_HANDED = AXES * np.sign(np.linalg.det(AXES)) @ np.diag([-1.0, 1.0, 1.0])
SPACING_MM = np.array([0.8, 1.1, 1.4])
SHAPE = (36, 27, 22)
CENTRE_RAS_MM = np.array([-21.0, 34.0, 12.5])
RADIUS_MM = 9.0


def oblique_affine() -> np.ndarray:
    affine = np.eye(4)
    affine[:3, :3] = LEFT_HANDED * SPACING_MM
    affine[:3, 3] = CENTRE_RAS_MM - affine[:3, :3] @ ((np.array(SHAPE) - 1) / 2 + 0.137)
    return affine


def linear_field(ras_mm: np.ndarray) -> np.ndarray:
    return ras_mm @ np.array([2.0, -3.0, 1.0]) + 10.0


def oblique_sphere() -> tuple[np.ndarray, np.ndarray]:
    """(Psi in mm, a linear function of the world position) on the oblique, anisotropic, left-handed grid."""
    ijk = np.indices(SHAPE).reshape(3, -1).T
    ras = ijk @ oblique_affine()[:3, :3].T + oblique_affine()[:3, 3]
    psi = np.linalg.norm(ras - CENTRE_RAS_MM, axis=1) - RADIUS_MM
    return psi.reshape(SHAPE).astype(np.float32), linear_field(ras).reshape(SHAPE).astype(np.float32)


def itk(path: Path, array: np.ndarray, affine: np.ndarray) -> Path:
    """Write with SimpleITK alone: its world is LPS, its arrays are indexed backwards."""
    lps = np.diag([-1.0, -1.0, 1.0, 1.0]) @ affine
    spacing = np.linalg.norm(lps[:3, :3], axis=0)
    image = sitk.GetImageFromArray(array.T)
    image.SetSpacing(spacing.tolist())
    image.SetDirection((lps[:3, :3] / spacing).ravel().tolist())
    image.SetOrigin(lps[:3, 3].tolist())
    sitk.WriteImage(image, str(path))
    return path


def ply(path: Path) -> tuple[trimesh.Trimesh, np.ndarray]:
    mesh = trimesh.load(path, process=False)
    return mesh, np.asarray(mesh.metadata["_ply_raw"]["vertex"]["data"]["value"]).reshape(-1)


# World


@pytest.mark.parametrize("write, suffix", [(nifti, ".nii.gz"), (itk, ".mha")])
def test_mesh_of_an_oblique_left_handed_sphere_lies_in_the_world(tmp_path, write, suffix):
    psi, field = oblique_sphere()
    levelset = write(tmp_path / f"psi{suffix}", psi, oblique_affine())
    data = write(tmp_path / f"data{suffix}", field, oblique_affine())
    done("denoise", levelset, data, "-o", tmp_path / f"out{suffix}", "--mesh", tmp_path / "out.ply", "--fwhm", "0")
    done("mesh", levelset, data, "-o", tmp_path / "raw.ply")
    for name, tolerance in (("out.ply", 0.1), ("raw.ply", 0.02)):
        mesh, values = ply(tmp_path / name)
        radius = np.linalg.norm(mesh.vertices - CENTRE_RAS_MM, axis=1)
        assert np.abs(radius - RADIUS_MM).max() < 0.02
        assert mesh.is_watertight
        assert mesh.volume == pytest.approx(4 / 3 * np.pi * RADIUS_MM**3, rel=0.01)
        assert np.abs(values - linear_field(mesh.vertices)).max() < tolerance


def test_nifti_and_metaimage_give_one_mesh(tmp_path):
    psi, field = oblique_sphere()
    for write, suffix in ((nifti, ".nii.gz"), (itk, ".mha")):
        levelset = write(tmp_path / f"psi{suffix}", psi, oblique_affine())
        data = write(tmp_path / f"data{suffix}", field, oblique_affine())
        out = tmp_path / f"out{suffix}"
        mesh = tmp_path / f"{suffix}.ply"
        done("denoise", levelset, data, "-o", out, "--mesh", mesh, "--beta", "0.05", "--overwrite")
    (one, values), (other, other_values) = ply(tmp_path / ".nii.gz.ply"), ply(tmp_path / ".mha.ply")
    assert np.abs(one.vertices - other.vertices).max() < 1e-3
    assert np.array_equal(one.faces, other.faces)
    difference = np.abs(values - other_values)
    assert np.percentile(difference, 99) < 1e-4
    assert difference.max() < 0.02  # of 56: float32 in NIfTI's affine decides ties between links


def test_inside_positive_turns_the_faces_and_nothing_else(scene, tmp_path):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out, "--mesh", tmp_path / "m.ply")
    flipped = nifti(tmp_path / "flipped.nii.gz", -ball())
    done("denoise", flipped, data, "-o", tmp_path / "f.nii.gz", "--mesh", tmp_path / "f.ply", "--inside", "positive")
    done("mesh", levelset, "-o", tmp_path / "wrong.ply", "--inside", "positive")
    assert ply(tmp_path / "m.ply")[0].volume == pytest.approx(ply(tmp_path / "f.ply")[0].volume, rel=1e-6)
    assert trimesh.load(tmp_path / "wrong.ply", process=False).volume < 0
    assert np.array_equal(load(out), load(tmp_path / "f.nii.gz"), equal_nan=True)


# Formats


@pytest.mark.parametrize("suffix", [".nii", ".mgz", ".mha", ".npy"])
def test_every_format_gives_the_same_numbers(scene, tmp_path, suffix):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out, "--beta", "0.1")
    folder = tmp_path / "other"
    folder.mkdir()
    for name, array in (("psi", ball()), ("data", noisy())):
        formats.write_volume(folder / f"{name}{suffix}", Volume(array, Grid.from_spacing(array.shape)))
    other = folder / f"out{suffix}"
    done("denoise", folder / f"psi{suffix}", folder / f"data{suffix}", "-o", other, "--beta", "0.1")
    assert np.nanmax(np.abs(formats.read_volume(other).data - load(out))) < 1e-5 * np.ptp(noisy())
    assert np.array_equal(np.isnan(formats.read_volume(other).data), np.isnan(load(out)))


def test_formats_mix(scene, tmp_path):
    levelset, data, out = scene
    done("denoise", levelset, npy(tmp_path / "data.npy", noisy()), "-o", out)
    done("denoise", npy(tmp_path / "psi.npy", ball()), data, "-o", tmp_path / "other.npy")
    assert np.array_equal(load(out), load(tmp_path / "other.npy"), equal_nan=True)


@pytest.mark.parametrize("codes", [(2, 1), (0, 3), (4, 0)])
@pytest.mark.parametrize("affine", [np.diag([-1.0, 1.0, 1.0, 1.0]), oblique_affine()], ids=["LAS", "oblique"])
def test_header_survives(tmp_path, codes, affine):
    levelset = nifti(tmp_path / "psi.nii.gz", ball(), affine)
    image = nib.Nifti1Image(noisy(), None)
    sform, qform = codes
    image.set_sform(affine, sform)
    image.set_qform(affine, qform)
    image.header.set_xyzt_units("mm", "sec")
    image.header["descrip"] = b"run 7"
    nib.save(image, tmp_path / "data.nii.gz")
    grid = [] if sform or qform else ["--resample"]
    done("denoise", levelset, tmp_path / "data.nii.gz", "-o", tmp_path / "out.nii.gz", "--band", "4", *grid)
    out = nib.load(tmp_path / "out.nii.gz")
    assert (int(out.header["sform_code"]), int(out.header["qform_code"])) == codes
    assert np.allclose(out.affine, affine, atol=1e-5)
    assert out.header.get_xyzt_units() == ("mm", "sec")
    assert bytes(out.header["descrip"]).rstrip(b"\0") == b"run 7"
    assert out.get_data_dtype() == np.float32


def test_big_endian_int16_with_slope(scene, tmp_path):
    levelset, _, out = scene
    stored = np.round(noisy() / 0.01 - 1000).astype(">i2")
    header = nib.Nifti1Header(endianness=">")
    header.set_data_dtype(">i2")
    header.set_slope_inter(0.01, 10.0)
    image = nib.Nifti1Image(stored, np.eye(4), header)
    image.header.set_slope_inter(0.01, 10.0)
    image.to_filename(tmp_path / "int16.nii")
    raw = bytearray((tmp_path / "int16.nii").read_bytes())
    assert raw[:4] == b"\0\0\x01\x5c"  # 348, big-endian
    assert np.allclose(nib.load(tmp_path / "int16.nii").get_fdata(), noisy(), atol=0.006)
    done("denoise", levelset, tmp_path / "int16.nii", "-o", out)
    done("denoise", levelset, nifti(tmp_path / "float.nii", noisy()), "-o", tmp_path / "float_out.nii")
    assert np.nanmax(np.abs(load(out) - load(tmp_path / "float_out.nii"))) < 0.01


@pytest.mark.parametrize("dtype", [np.uint8, np.int32, np.float64])
def test_types_of_data(scene, tmp_path, dtype):
    levelset, _, out = scene
    array = np.clip(noisy(), 0, 255).astype(dtype)
    done("denoise", levelset, npy(tmp_path / "data.npy", array), "-o", out)
    # The mean error of noise 10 over some 300 voxels at the surface; whole numbers are rounded down.
    assert abs(seen(out).mean() - 49.5) < 1.0


@pytest.mark.parametrize("extra", [(1,), (1, 1)])
def test_trailing_axes_of_length_one_stay(scene, tmp_path, extra):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out)
    long = nifti(tmp_path / "long.nii.gz", noisy().reshape(16, 16, 16, *extra))
    done("denoise", levelset, long, "-o", tmp_path / "long_out.nii.gz")
    assert load(tmp_path / "long_out.nii.gz").shape == (16, 16, 16, *extra)
    assert np.array_equal(load(tmp_path / "long_out.nii.gz").reshape(16, 16, 16), load(out), equal_nan=True)


def test_resample_brings_data_onto_the_level_sets_grid(scene, tmp_path):
    levelset, _, out = scene
    fine = np.diag([0.5, 0.5, 0.5, 1.0])
    fine[:3, 3] = -2.0
    ras = np.indices((44, 44, 44)).reshape(3, -1).T * 0.5 - 2.0
    data = nifti(tmp_path / "fine.nii.gz", linear_field(ras).reshape(44, 44, 44).astype(np.float32), fine)
    assert "--resample" in refused_grids("denoise", levelset, data, "-o", out)
    done("denoise", levelset, data, "-o", out, "--resample", "--iterations", "0", "--extension", "none")
    image, values = nib.load(out), load(out)
    assert np.array_equal(image.affine, np.eye(4))
    near = np.argwhere(np.isfinite(values))
    assert np.abs(values[tuple(near.T)] - linear_field(near)).max() < 1e-3
    assert record(tmp_path / "out.json")["Parameters"]["resample"] is True


def refused_grids(*arguments: object) -> str:
    run = beltrami(*arguments)
    assert run.code == 2
    assert len(run.err.splitlines()) == 3
    assert "LEVELSET" in run.err.splitlines()[1]
    assert "DATA" in run.err.splitlines()[2]
    return run.message


def test_shift_under_a_thousandth_of_a_voxel_is_one_grid_and_above_is_not(scene, tmp_path):
    levelset, _, out = scene
    for shift, code in ((5e-4, 0), (5e-3, 2)):
        affine = np.eye(4)
        affine[1, 3] = shift
        data = nifti(tmp_path / f"{shift}.nii.gz", noisy(), affine)
        assert beltrami("denoise", levelset, data, "-o", out, "--no-mesh").code == code


# Planes


def test_curve_in_a_numpy_plane(tmp_path):
    levelset, data = npy(tmp_path / "psi.npy", ball((40, 40), 12.0)), npy(tmp_path / "data.npy", noisy((40, 40)))
    done("denoise", levelset, data, "-o", tmp_path / "out.npy", "--time", "20")
    out = load(tmp_path / "out.npy")
    assert (out.shape, out.dtype) == ((40, 40), np.float32)
    assert np.nanstd(out) < 4.0  # from 10
    text = (tmp_path / "out.ply").read_bytes().split(b"end_header")[0].decode()
    vertices, edges = (int(text.split(f"element {name} ")[1].split()[0]) for name in ("vertex", "edge"))
    assert vertices == edges > 70  # closed, and longer than its circumference in voxels
    assert "property float value" in text


def test_curve_mesh_is_a_polyline_with_values(tmp_path):
    x = np.indices((40, 40))
    levelset = npy(tmp_path / "psi.npy", ball((40, 40), 12.0))
    data = npy(tmp_path / "data.npy", (2.0 * x[0] - x[1]).astype(np.float32))
    out, mesh = tmp_path / "out.npy", tmp_path / "m.vtk"
    done("denoise", levelset, data, "-o", out, "--mesh", mesh, "--mesh", tmp_path / "m.obj", "--time", "0")
    curve = meshio.read(mesh)
    points, (lines,) = curve.points, (cells.data for cells in curve.cells)
    assert lines.shape == (len(points), 2)
    assert np.abs(np.hypot(*(points[:, :2] - 19.637).T) - 12).max() < 0.01
    assert np.abs(curve.point_data["value"].reshape(-1) - (2 * points[:, 0] - points[:, 1])).max() < 0.1
    assert (tmp_path / "m.obj").read_text().count("\nl ") == len(lines)
    for suffix in ("stl", "glb", "surf.gii"):
        message = refused("denoise", levelset, data, "-o", out, "--mesh", tmp_path / f"m.{suffix}", "--overwrite")
        assert "lines of a curve" in message


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_slice_along_any_axis(tmp_path, axis):
    psi, values = ball((30, 26), 8.0), noisy((30, 26))
    done("denoise", npy(tmp_path / "psi.npy", psi), npy(tmp_path / "data.npy", values), "-o", tmp_path / "plane.npy")
    slices = [nifti(tmp_path / f"{n}.nii.gz", np.expand_dims(a, axis)) for n, a in (("psi", psi), ("data", values))]
    done("denoise", *slices, "-o", tmp_path / "out.nii.gz", "--mesh", tmp_path / "m.vtk")
    out = load(tmp_path / "out.nii.gz")
    assert out.shape == np.expand_dims(psi, axis).shape
    assert np.nanmax(np.abs(out.squeeze(axis) - load(tmp_path / "plane.npy"))) < 1e-4
    points = np.delete(meshio.read(tmp_path / "m.vtk").points, axis, 1)
    centre = (np.array(psi.shape) - 1) / 2 + 0.137
    assert np.abs(np.linalg.norm(points - centre, axis=1) - 8).max() < 0.02


def test_picture_as_data(tmp_path):
    grey = np.clip(noisy((32, 24)), 0, 255).astype(np.uint8)
    sitk.WriteImage(sitk.GetImageFromArray(grey), str(tmp_path / "data.png"))
    levelset = npy(tmp_path / "psi.npy", ball((32, 24), 8.0))
    done("denoise", levelset, tmp_path / "data.png", "-o", tmp_path / "out.npy")
    done("denoise", levelset, npy(tmp_path / "data.npy", grey), "-o", tmp_path / "same.npy")
    assert np.array_equal(load(tmp_path / "out.npy"), load(tmp_path / "same.npy"), equal_nan=True)
    done("denoise", "--flat", tmp_path / "data.png", "-o", tmp_path / "flat.npy")
    assert load(tmp_path / "flat.npy").shape == (32, 24)
    assert "read only" in refused("denoise", "--flat", tmp_path / "data.png", "-o", tmp_path / "o.png")


@pytest.mark.parametrize("shape", [(24, 20), (12, 10, 9)])
def test_flat_is_the_flow_of_the_whole_array(tmp_path, shape):
    data = npy(tmp_path / "data.npy", noisy(shape))
    run = done("denoise", "--flat", data, "-o", tmp_path / "out.npy", "--flow", "l2")
    out = load(tmp_path / "out.npy")
    assert out.shape == shape
    assert out.mean() == pytest.approx(noisy(shape).mean(), rel=1e-6)  # heat is kept
    assert out.std() < 0.4 * noisy(shape).std()
    assert run.out.splitlines()[0] == f"wrote {tmp_path / 'out.npy'}, {tmp_path / 'out.json'}"
    done("denoise", "--flat", data, "-o", tmp_path / "same.npy", "--iterations", "0")
    assert np.array_equal(load(tmp_path / "same.npy"), noisy(shape))


# Values


@pytest.mark.parametrize("option", ["--iterations", "--time", "--fwhm"])
def test_no_time_gives_the_extended_data(scene, option):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out, option, "0", "--extension", "none")
    band = np.isfinite(load(out))
    assert band.sum() > 2000
    assert np.array_equal(load(out)[band], noisy()[band])


def test_no_time_with_closest_points_is_constant_along_normals(scene, tmp_path):
    levelset, _, out = scene
    x = np.indices((16, 16, 16)) - 7.637
    cosine = (x[0] / np.sqrt((x**2).sum(0))).astype(np.float32)
    data = nifti(tmp_path / "cosine.nii.gz", 100 * cosine)
    done("denoise", levelset, data, "-o", out, "--iterations", "0")
    band = np.isfinite(load(out)) & (np.abs(ball()) < 3)
    assert np.abs(load(out) - 100 * cosine)[band].max() < 3.0


@pytest.mark.parametrize("extension", ["closest-point", "pde", "none"])
@pytest.mark.parametrize("flow", ["beltrami", "l2", "l1", "tv", "phi"])
def test_values_stay_within_the_inputs_range(scene, flow, extension):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out, "--flow", flow, "--extension", extension, "--iterations", "30")
    low, high = noisy().min(), noisy().max()
    margin = 0.01 * (high - low)
    assert low - margin <= seen(out).min() < seen(out).max() <= high + margin
    assert seen(out).std() < (9.0 if extension == "none" else 5.0)  # from 10, and l1 is slow at the steepest slopes


@pytest.mark.parametrize(
    "options",
    [
        "--flow l2",
        "--beta 0.05",
        "--beta 1",
        "--flow l1",
        "--flow tv",
        "--flow phi --beta 0.05",
        "--flow phi --phi weickert --beta 0.05",
        "--flow l2 --scheme paper",
        "--beta 0.05 --scheme paper",
    ],
)
def test_sharp_data_stay_within_the_inputs_range(tmp_path, options):
    """Halves of 0 and 100 on a torus so thin that the band fills it."""
    done("phantom", "torus", tmp_path, "--size", "32")
    half = np.where(np.indices((32, 32, 32))[0] > 16, 100, 0).astype(np.float32)
    data = nifti(tmp_path / "half.nii.gz", half)
    arguments = ("--iterations", "40", "--mesh", tmp_path / "m.ply", *options.split())
    done("denoise", tmp_path / "levelset.nii.gz", data, "-o", tmp_path / "out.nii.gz", *arguments)
    for values in (seen(tmp_path / "out.nii.gz"), ply(tmp_path / "m.ply")[1]):
        assert -1 <= values.min() < 10
        assert 90 < values.max() <= 101


@pytest.mark.parametrize("value", [7.0, 0.0, -1e6])
@pytest.mark.parametrize("flow", ["beltrami", "l1", "tv", "phi"])
def test_constant_data_stay(scene, tmp_path, value, flow):
    levelset, _, out = scene
    flat = nifti(tmp_path / "flat.nii.gz", np.full((16, 16, 16), value, np.float32))
    done("denoise", levelset, flat, "-o", out, "--flow", flow)
    assert np.abs(seen(out) - value).max() <= 1e-6 * abs(value)


@pytest.mark.parametrize("factor", [1e-15, 1e-6, 1e6, 1e15])
def test_units_of_the_data_do_not_matter(scene, tmp_path, factor):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out)
    scaled = nifti(tmp_path / "scaled.nii.gz", (noisy() * np.float32(factor)).astype(np.float32))
    done("denoise", levelset, scaled, "-o", tmp_path / "scaled_out.nii.gz")
    assert np.nanmax(np.abs(load(tmp_path / "scaled_out.nii.gz") / factor - load(out))) < 1e-3


@pytest.mark.parametrize("millimetres", [1e-3, 1e3])
def test_units_of_length_do_not_matter(scene, tmp_path, millimetres):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out, "--no-mesh")
    affine = np.diag([millimetres, millimetres, millimetres, 1.0])
    far = [nifti(tmp_path / f"{n}_scaled.nii.gz", a, affine) for n, a in (("psi", ball()), ("data", noisy()))]
    done("denoise", *far, "-o", tmp_path / "scaled_out.nii.gz")
    assert np.nanmax(np.abs(load(tmp_path / "scaled_out.nii.gz") - load(out))) < 1e-2


def test_values_beyond_the_precision_are_one_line(scene, tmp_path):
    levelset, _, out = scene
    huge = nifti(tmp_path / "huge.nii.gz", noisy() * np.float32(1e30))
    assert "--precision float64" in refused("denoise", levelset, huge, "-o", out, code=1)
    done("denoise", levelset, huge, "-o", out, "--precision", "float64")
    assert seen(out).mean() == pytest.approx(49e30, rel=0.02)


def test_precision_is_that_of_computation_and_output(scene, tmp_path):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out)
    done("denoise", levelset, data, "-o", tmp_path / "double.nii.gz", "--precision", "float64")
    single, double = load(out), load(tmp_path / "double.nii.gz")
    assert (single.dtype, double.dtype) == (np.float32, np.float64)
    assert 0 < np.nanmax(np.abs(single - double)) < 1e-3


def test_outside_the_band(scene, tmp_path):
    levelset, data, out = scene
    results = {}
    for outside in ("nan", "zero", "keep"):
        done("denoise", levelset, data, "-o", out, "--outside", outside, "--band", "2", "--overwrite")
        results[outside] = load(out)
    band = np.isfinite(results["nan"])
    assert 0.2 < band.mean() < 0.5
    assert (np.abs(ball())[band] <= 2.5).all()
    assert (results["zero"][~band] == 0).all()
    assert np.array_equal(results["keep"][~band], noisy()[~band])
    for values in results.values():
        assert np.array_equal(values[band], results["nan"][band])


def test_longer_and_wider(scene, tmp_path):
    """More time smooths more; a wider band, other threads and a given default change nothing much."""
    levelset, data, out = scene
    spread = []
    for time in ("0", "1", "4", "16"):
        done("denoise", levelset, data, "-o", out, "--time", time, "--flow", "l2", "--overwrite")
        spread.append(seen(out).std())
    assert spread[0] > 1.5 * spread[1] > 1.5**2 * spread[2] > 1.5**3 * spread[3]
    done("denoise", levelset, data, "-o", out, "--overwrite")
    plain = load(out)
    for options in (["--threads", "1"], ["--dt", "auto"], ["--beta", "auto"], ["--band", "4"], ["--extend-every", "5"]):
        done("denoise", levelset, data, "-o", out, "--overwrite", *options)
        assert np.array_equal(load(out), plain, equal_nan=True), options
    done("denoise", levelset, data, "-o", out, "--overwrite", "--band", "100")
    near = np.abs(ball()) < 0.5
    assert np.abs(load(out) - plain)[near].max() < 0.05


def test_spacing_of_bare_arrays(tmp_path):
    levelset, data = npy(tmp_path / "psi.npy", 2 * ball()), npy(tmp_path / "data.npy", noisy())
    done("denoise", levelset, data, "-o", tmp_path / "out.npy", "--spacing", "2")
    used = record(tmp_path / "out.json")
    assert used["Grid"]["spacing_mm"] == [2.0, 2.0, 2.0]
    assert used["Parameters"]["band"] == 8.0
    mesh, _ = ply(tmp_path / "out.ply")
    assert np.abs(np.linalg.norm(mesh.vertices - 2 * 7.637, axis=1) - 10).max() < 0.05
    done("denoise", levelset, data, "-o", tmp_path / "o2.npy", "--spacing", "1,2,3")
    assert record(tmp_path / "o2.json")["Grid"]["spacing_mm"] == [1.0, 2.0, 3.0]


def test_fwhm_is_the_gaussian_that_l2_equals(tmp_path):
    """A bump of 4 mm on a wide plane, smoothed by 3 mm, is one of 5 mm."""
    x = np.indices((41, 41, 7)) - np.array([20.0, 20.0, 3.0]).reshape(3, 1, 1, 1)
    bump = 100 * np.exp(-4 * np.log(2) * (x[0] ** 2 + x[1] ** 2) / 4.0**2)
    levelset = nifti(tmp_path / "psi.nii.gz", (x[2] + 0.13).astype(np.float32))
    data = nifti(tmp_path / "data.nii.gz", bump.astype(np.float32))
    done("denoise", levelset, data, "-o", tmp_path / "out.nii.gz", "--flow", "l2", "--fwhm", "3")
    expected = 100 * 16 / 25 * np.exp(-4 * np.log(2) * x[0] ** 2 / 25)
    assert np.abs(load(tmp_path / "out.nii.gz")[:, 20, 3] - expected[:, 20, 3]).max() < 0.5


# Missing data


def test_holes_are_filled_from_around_them(scene, tmp_path):
    levelset, _, out = scene
    ramp = (10.0 * np.indices((16, 16, 16))[0]).astype(np.float32)
    holes = np.random.default_rng(1).random(ramp.shape) < 0.3
    data = nifti(tmp_path / "holes.nii.gz", np.where(holes, np.nan, ramp))
    done("denoise", levelset, data, "-o", out, "--flow", "l2", "--iterations", "2")
    near = np.abs(ball()) < 0.5
    assert np.isfinite(load(out)[near]).all()
    assert np.abs(load(out) - ramp)[near].max() < 12.0  # one voxel's step is 10
    assert ramp.min() <= seen(out).min() <= seen(out).max() <= ramp.max()


def test_infinite_data_are_missing_data(scene, tmp_path):
    levelset, _, out = scene
    holes = np.random.default_rng(1).random((16, 16, 16)) < 0.05
    done("denoise", levelset, nifti(tmp_path / "nan.nii.gz", np.where(holes, np.nan, noisy())), "-o", out)
    infinite = nifti(tmp_path / "inf.nii.gz", np.where(holes, np.inf, noisy()))
    run = beltrami("denoise", levelset, infinite, "-o", tmp_path / "inf_out.nii.gz")
    assert run.code == 0
    in_band = np.isfinite(load(out)) & holes
    assert f"{in_band.sum()} infinite values beside the surface" in run.message
    assert np.array_equal(load(out), load(tmp_path / "inf_out.nii.gz"), equal_nan=True)
    assert record(tmp_path / "inf_out.json")["Warnings"] == [run.message.removeprefix("warning: ")]


@pytest.mark.parametrize("extension", ["closest-point", "pde", "none"])
def test_a_surface_without_data_stays_missing(tmp_path, extension):
    shape = (30, 16, 16)
    psi = np.minimum(ball(shape, 4.0, (7.1, 7.6, 7.4)), ball(shape, 4.0, (22.3, 7.6, 7.4)))
    values = noisy(shape)
    values[15:] = np.nan
    data = nifti(tmp_path / "data.nii.gz", values)
    arguments = ("-o", tmp_path / "out.nii.gz", "--mesh", tmp_path / "m.ply", "--extension", extension)
    run = beltrami("denoise", nifti(tmp_path / "psi.nii.gz", psi), data, *arguments)
    assert run.code == 0
    assert "without any data" in run.message
    out = load(tmp_path / "out.nii.gz")
    assert np.isnan(out[15:]).all()
    assert np.isfinite(out[:15][np.abs(psi[:15]) < 2]).all()
    mesh, at_vertices = ply(tmp_path / "m.ply")
    assert np.array_equal(np.isnan(at_vertices), mesh.vertices[:, 0] > 15)
    band = record(tmp_path / "out.json")["Band"]
    assert band["missing_voxels"] == pytest.approx(band["voxels"] / 2, rel=0.01)


def test_one_valid_voxel_fills_its_surface(scene, tmp_path):
    levelset, _, out = scene
    values = np.full((16, 16, 16), np.nan, np.float32)
    values[tuple(np.argwhere(np.abs(ball()) < 0.3)[0])] = 5.0
    done("denoise", levelset, nifti(tmp_path / "one.nii.gz", values), "-o", out)
    assert (seen(out) == 5.0).all()


# Level sets


@pytest.mark.parametrize(
    "shape_of",
    [
        lambda psi: 1e-6 * psi,
        lambda psi: 1e6 * psi,
        lambda psi: np.clip(psi, -1.5, 1.5),
        lambda psi: np.where(psi < -4, -np.inf, psi),
        lambda psi: np.where(np.abs(psi) > 3, np.nan, psi),
        lambda psi: np.where(np.abs(psi) > 2, np.inf * np.sign(psi), psi),
        lambda psi: np.pad(psi[1:, :, :-1], ((1, 0), (0, 0), (0, 1)), constant_values=np.nan),
    ],
    ids=["tiny", "huge", "clamped", "inf inside", "nan off the band", "inf off the band", "nan faces"],
)
def test_any_function_with_the_zero_set_will_do(scene, tmp_path, shape_of):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out)
    other = nifti(tmp_path / "other.nii.gz", shape_of(ball()).astype(np.float32))
    done("denoise", other, data, "-o", tmp_path / "other_out.nii.gz", "--mesh", tmp_path / "m.ply")
    near = np.abs(ball()) < 1
    assert np.abs(load(tmp_path / "other_out.nii.gz") - load(out))[near].max() < 0.5
    mesh, values = ply(tmp_path / "m.ply")
    assert np.isfinite(values).all()
    assert np.abs(np.linalg.norm(mesh.vertices - 7.637, axis=1) - 5).max() < 0.05


@pytest.mark.parametrize("low, high, inside", [(0, 1, "negative"), (0, 255, "negative"), (-1, 1, "negative")])
def test_a_mask_gets_a_smooth_surface(scene, tmp_path, low, high, inside):
    _, data, out = scene
    marked = np.where(ball() < 0, high, low) if low >= 0 else np.where(ball() < 0, low, high)
    mask = nifti(tmp_path / "mask.nii.gz", marked.astype(np.int16))
    done("denoise", mask, data, "-o", out, "--mesh", tmp_path / "m.ply", "--inside", inside)
    near = np.abs(ball()) < 0.5
    assert abs(load(out)[near].mean() - 49.4) < 10 / np.sqrt(near.sum()) * 3
    assert load(out)[near].std() < 4
    mesh, _ = ply(tmp_path / "m.ply")
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 5**3, rel=0.05)
    radius = np.linalg.norm(mesh.vertices - 7.637, axis=1)
    assert abs(radius.mean() - 5) < 0.1 and radius.std() < 0.15  # of the staircase's own vertices 0.25


@pytest.mark.parametrize("shape", [(3, 3, 3), (4, 4, 4), (3, 3, 2), (2, 8, 8)])
def test_tiny_volumes(tmp_path, shape):
    levelset = nifti(tmp_path / "psi.nii.gz", ball(shape, max(shape) / 3))
    data = nifti(tmp_path / "data.nii.gz", noisy(shape))
    run = beltrami("denoise", levelset, data, "-o", tmp_path / "out.nii.gz")
    assert (run.code, len(run.err.splitlines())) == (0, 1)
    assert "beta auto: there are too few valid voxels beside the surface" in run.err
    assert noisy(shape).min() <= seen(tmp_path / "out.nii.gz").min() <= seen(tmp_path / "out.nii.gz").max()
    assert seen(tmp_path / "out.nii.gz").max() <= noisy(shape).max()


def test_surface_cut_by_the_volumes_face(tmp_path):
    levelset = nifti(tmp_path / "psi.nii.gz", ball(centre=(1.2, 7.6, 8.1)))
    data = nifti(tmp_path / "data.nii.gz", noisy())
    done("denoise", levelset, data, "-o", tmp_path / "out.nii.gz", "--mesh", tmp_path / "m.ply", "--flow", "l2")
    near = np.abs(ball(centre=(1.2, 7.6, 8.1))) < 1
    assert np.isfinite(load(tmp_path / "out.nii.gz")[near]).all()
    assert load(tmp_path / "out.nii.gz")[near].std() < 3
    mesh, values = ply(tmp_path / "m.ply")
    assert np.isfinite(values).all()
    assert not mesh.is_watertight


def test_what_a_mask_marks_is_inside_whatever_the_sign():
    from beltrami_cli import denoise

    x = np.indices((20, 20, 20)) - 9.3
    mask = ((x**2).sum(0) < 36).astype(float)
    for inside in ("negative", "positive"):
        mesh = denoise(mask, x[0], inside=inside, iterations=0).mesh
        corners = mesh.vertices_ras_mm[mesh.cells]
        volume = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6
        assert volume == pytest.approx(mask.sum(), rel=0.1)


def test_voxels_of_an_input_pair_are_never_replaced_and_are_hashed(tmp_path):
    done("phantom", "torus", tmp_path, "--size", "20", "--format", "mha")
    import SimpleITK as sitk

    for part in ("levelset", "noisy"):
        sitk.WriteImage(sitk.ReadImage(str(tmp_path / f"{part}.mha")), str(tmp_path / f"{part}.mhd"))
    other = tmp_path / "other.mhd"
    other.write_text((tmp_path / "noisy.mhd").read_text().replace("noisy.raw", "out.raw"))
    (tmp_path / "noisy.raw").rename(tmp_path / "out.raw")
    arguments = ("denoise", tmp_path / "levelset.mhd", other, "--no-mesh")
    assert "is an input" in refused(*arguments, "-o", tmp_path / "out.mhd", "--overwrite")
    done(*arguments, "-o", tmp_path / "fine.mhd")
    sources = [Path(source["Path"]).name for source in record(tmp_path / "fine.json")["Sources"]]
    assert sources == ["levelset.mhd", "levelset.raw", "other.mhd", "out.raw"]
