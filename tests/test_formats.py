"""Volumes: one world point holds one value in every format, headers survive, and odd files are refused in one line."""

from __future__ import annotations

import gzip
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from twins import SHAPE, TWINS, field, volume, voxels

from beltrami_cli.errors import BeltramiError, DataError, RefusedError
from beltrami_cli.formats import (
    mesh_format,
    read_grid,
    read_volume,
    require_writable,
    stem,
    volume_files,
    volume_format,
    write_volume,
)
from beltrami_cli.grid import Grid, Volume

PLACED = [".nii", ".nii.gz", ".hdr", ".mgz", ".mgh", ".mha", ".mhd"]
DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


def real(name: str) -> Path:
    path = DATA / name
    if not path.exists():
        pytest.skip(f"{name} is not here")
    return path


def one_line(error: BeltramiError) -> str:
    message = str(error)
    assert message
    assert "\n" not in message
    return message


# --- one world ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", PLACED)
@pytest.mark.parametrize("name", TWINS)
def test_a_world_point_holds_one_value(tmp_path, suffix, name):
    path = tmp_path / f"v{suffix}"
    write_volume(path, volume(TWINS[name]))
    back = read_volume(path)
    assert back.data.dtype == np.float32
    assert back.file_shape == SHAPE
    assert back.grid.matches(TWINS[name])
    assert read_grid(path).matches(back.grid)
    assert np.array_equal(back.data, volume(TWINS[name]).data)
    assert np.abs(back.data.ravel() - field(back.grid.to_world(voxels(back.grid)))).max() < 1e-3


def test_nifti_is_ras_to_nibabel(tmp_path):
    write_volume(tmp_path / "v.nii.gz", volume(TWINS["oblique"]))
    image = nib.load(tmp_path / "v.nii.gz")
    point = image.affine @ [1, 2, 3, 1]
    assert image.get_fdata()[1, 2, 3] == pytest.approx(field(point[:3]), abs=1e-3)
    assert np.allclose(image.get_qform(), image.get_sform(), atol=1e-5)
    assert (int(image.header["qform_code"]), int(image.header["sform_code"])) == (1, 1)
    assert image.header.get_xyzt_units() == ("mm", "unknown")


def test_metaimage_is_lps_to_itk(tmp_path):
    write_volume(tmp_path / "v.mha", volume(TWINS["oblique left-handed"]))
    image = sitk.ReadImage(str(tmp_path / "v.mha"))
    x, y, z = image.TransformIndexToPhysicalPoint((1, 2, 3))
    assert image.GetPixel(1, 2, 3) == pytest.approx(field(np.array([-x, -y, z])), abs=1e-3)


@pytest.mark.parametrize("suffix", [*PLACED, ".npy"])
def test_nan_and_infinity_stay(tmp_path, suffix):
    data = np.arange(24, dtype=np.float32).reshape(2, 3, 4)
    data[0, 0, 0], data[1, 2, 3], data[1, 0, 2] = np.nan, np.inf, -np.inf
    write_volume(tmp_path / f"v{suffix}", Volume(data, Grid.from_spacing(data.shape)))
    assert np.array_equal(read_volume(tmp_path / f"v{suffix}").data, data, equal_nan=True)


@pytest.mark.parametrize("suffix", [".nii.gz", ".mha", ".npy"])
def test_float64_is_kept_where_asked(tmp_path, suffix):
    data = np.full((2, 3, 4), 1 / 3)
    write_volume(tmp_path / f"v{suffix}", Volume(data, Grid.from_spacing(data.shape)), dtype=np.float64)
    assert read_volume(tmp_path / f"v{suffix}", dtype=np.float64).data[1, 2, 3] == 1 / 3


# --- shapes ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("file_shape", [(4, 5), (4, 5, 1), (4, 5, 6, 1), (4, 5, 6, 1, 1)])
@pytest.mark.parametrize("suffix", [".nii.gz", ".mha", ".npy"])
def test_planes_and_trailing_axes_come_back(tmp_path, suffix, file_shape):
    values = np.arange(np.prod(file_shape), dtype=np.float32)
    shape = (*file_shape, 1)[:3]
    write_volume(tmp_path / f"a{suffix}", Volume(values.reshape(shape), Grid.from_spacing(shape), file_shape))
    first = read_volume(tmp_path / f"a{suffix}")
    assert (first.data.shape, first.file_shape) == (shape, file_shape)
    write_volume(tmp_path / f"b{suffix}", first.with_data(first.data + 1))
    second = read_volume(tmp_path / f"b{suffix}")
    assert second.file_shape == file_shape
    assert np.array_equal(second.data.reshape(-1), values + 1)


@pytest.mark.parametrize("shape", [(7,), (), (1, 7), (7, 1, 1), (0, 5), (4, 5, 0)])
def test_lines_and_empty_arrays_are_refused(tmp_path, shape):
    np.save(tmp_path / "a.npy", np.zeros(shape))
    with pytest.raises(RefusedError) as refusal:
        read_volume(tmp_path / "a.npy")
    assert f"{len(shape)}-D" in one_line(refusal.value)


@pytest.mark.parametrize("suffix", [".nii", ".mgz", ".mha", ".npy"])
def test_several_frames_are_refused_before_reading(tmp_path, suffix):
    data = np.zeros((3, 4, 5, 2), np.float32)
    path = tmp_path / f"frames{suffix}"
    if suffix == ".npy":
        np.save(path, data)
    elif suffix == ".mha":
        sitk.WriteImage(sitk.GetImageFromArray(data.T, isVector=False), str(path))
    else:
        (nib.MGHImage if suffix == ".mgz" else nib.Nifti1Image)(data, np.eye(4)).to_filename(path)
    for read in (read_grid, read_volume):
        with pytest.raises(RefusedError) as refusal:
            read(path)
        assert "several frames or channels, 4-D (x, y, z, 2)" in one_line(refusal.value)


@pytest.mark.parametrize("dtype", [np.bool_, np.uint8, np.int16, np.int64, ">i4", np.float16, np.float64])
def test_npy_of_any_real_type(tmp_path, dtype):
    np.save(tmp_path / "a.npy", np.asfortranarray(np.arange(24).reshape(2, 3, 4) % 2).astype(dtype))
    back = read_volume(tmp_path / "a.npy", spacing=(1, 2, 3))
    assert back.data.dtype == np.float32
    assert np.array_equal(back.data, np.arange(24).reshape(2, 3, 4) % 2)
    assert np.array_equal(back.grid.affine, np.diag([1.0, 2.0, 3.0, 1.0]))


@pytest.mark.parametrize("spacing", [0, -1, float("nan"), (1, 2, 3, 4), (1, 0, 1), ()])
def test_useless_spacing_is_refused(tmp_path, spacing):
    np.save(tmp_path / "a.npy", np.zeros((2, 3, 4)))
    with pytest.raises(RefusedError, match="positive number of mm"):
        read_volume(tmp_path / "a.npy", spacing=spacing)


def test_spacing_belongs_to_npy(tmp_path):
    write_volume(tmp_path / "v.nii", volume(TWINS["RAS"]))
    with pytest.raises(RefusedError, match=r"--spacing is for \.npy only"):
        read_grid(tmp_path / "v.nii", spacing=2.0)


# --- headers -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("version", [nib.Nifti1Image, nib.Nifti2Image])
@pytest.mark.parametrize("out", ["out.nii.gz", "out.hdr"])
def test_nifti_header_survives(tmp_path, version, out):
    grid = TWINS["oblique"]
    image = version((volume(grid).data * 10).astype(np.int16), None)
    image.set_sform(grid.affine, code=4)
    image.set_qform(TWINS["RAS"].affine, code=1)
    header = image.header
    header.set_slope_inter(0.1, 5.0)
    header.set_xyzt_units("mm", "sec")
    header.set_intent("t test", (12.0,), name="contrast")
    header["descrip"] = b"a map"
    header["cal_min"], header["cal_max"] = -1e4, 1e4
    header.extensions.append(nib.nifti1.Nifti1Extension("comment", b"by hand"))
    image.to_filename(tmp_path / "in.nii")

    before = read_volume(tmp_path / "in.nii")
    assert np.abs(before.data - (np.asarray(volume(grid).data) + 5)).max() < 0.11
    write_volume(tmp_path / out, before.with_data(before.data / 2))

    stored = nib.load(tmp_path / out)
    assert np.array_equal(stored.header.get_sform(), image.header.get_sform())
    assert np.array_equal(stored.header.get_qform(), image.header.get_qform())
    assert (int(stored.header["sform_code"]), int(stored.header["qform_code"])) == (4, 1)
    assert stored.header.get_xyzt_units() == ("mm", "sec")
    assert stored.header.get_intent() == ("t test", (12.0,), "contrast")
    assert stored.header["descrip"].item() == b"a map"
    assert float(stored.header["cal_max"]) == 1e4
    assert stored.header.extensions[0].get_content() == b"by hand"
    assert stored.get_data_dtype() == np.float32
    assert (stored.dataobj.slope, stored.dataobj.inter) == (1.0, 0.0)
    assert int(stored.header["sizeof_hdr"]) == int(image.header["sizeof_hdr"])
    assert np.array_equal(stored.get_fdata(dtype=np.float32), before.data / 2)


def test_stale_display_range_is_unset(tmp_path):
    image = nib.Nifti1Image(np.linspace(0, 1, 24, dtype=np.float32).reshape(2, 3, 4), np.eye(4))
    image.header["cal_min"], image.header["cal_max"] = 0, 1
    image.to_filename(tmp_path / "in.nii")
    back = read_volume(tmp_path / "in.nii")
    write_volume(tmp_path / "out.nii", back.with_data(back.data * 10))
    header = nib.load(tmp_path / "out.nii").header
    assert (float(header["cal_min"]), float(header["cal_max"])) == (0, 0)


@pytest.mark.parametrize(("unit", "mm"), [("meter", 1000.0), ("micron", 0.001), ("unknown", 1.0)])
def test_units_of_nifti_become_mm_and_go_back(tmp_path, unit, mm):
    image = nib.Nifti1Image(np.zeros((2, 3, 4), np.float32), np.diag([0.5, 1.0, 2.0, 1.0]))
    image.header.set_xyzt_units(unit, "sec")
    image.to_filename(tmp_path / "in.nii")
    back = read_volume(tmp_path / "in.nii")
    assert np.allclose(back.grid.spacing, np.array([0.5, 1.0, 2.0]) * mm)

    write_volume(tmp_path / "out.nii", back)
    shifted = back.grid.affine.copy()
    shifted[0, 3] += 7 * mm
    write_volume(tmp_path / "moved.nii", Volume(back.data, Grid(back.grid.shape, shifted), header=back.header))
    for name, x in (("out.nii", 0.0), ("moved.nii", 7.0)):
        stored = nib.load(tmp_path / name)
        assert stored.header.get_xyzt_units() == ("mm" if unit == "unknown" else unit, "sec")
        assert np.allclose(stored.header.get_zooms(), [0.5, 1.0, 2.0])
        assert stored.affine[0, 3] == pytest.approx(x)


def test_a_header_gives_way_to_another_grid(tmp_path):
    write_volume(tmp_path / "in.nii", volume(TWINS["RAS"]))
    template = read_volume(tmp_path / "in.nii").header
    larger = Grid((4, 4, 4), TWINS["oblique"].affine)
    write_volume(tmp_path / "out.nii", Volume(np.ones((4, 4, 4)), larger, header=template))
    stored = nib.load(tmp_path / "out.nii")
    assert np.allclose(stored.get_sform(), larger.affine, atol=1e-5)
    assert np.allclose(stored.get_qform(), larger.affine, atol=1e-5)


def test_shear_goes_into_the_sform_alone(tmp_path):
    affine = np.diag([0.5, 0.5, 2.0, 1.0])
    affine[1, 2] = 0.15
    sheared = Volume(np.zeros((2, 3, 4)), Grid((2, 3, 4), affine))
    write_volume(tmp_path / "v.nii", sheared)
    stored = nib.load(tmp_path / "v.nii")
    assert int(stored.header["qform_code"]) == 0
    assert np.allclose(stored.affine, affine)
    assert np.allclose(stored.header.get_zooms(), sheared.grid.spacing)
    for check in (
        lambda: require_writable(tmp_path / "v.mha", sheared.grid),
        lambda: write_volume(tmp_path / "v.mha", sheared),
    ):
        with pytest.raises(RefusedError) as refusal:
            check()
        assert "sheared" in one_line(refusal.value)
    assert not (tmp_path / "v.mha").exists()


def test_no_transform_stays_no_transform(tmp_path):
    image = nib.Nifti1Image(np.zeros((3, 4, 5), np.uint8), None)
    image.header.set_zooms((2.0, 3.0, 4.0))
    image.to_filename(tmp_path / "in.nii")
    back = read_volume(tmp_path / "in.nii")
    write_volume(tmp_path / "out.nii", back)
    header = nib.load(tmp_path / "out.nii").header
    assert (int(header["sform_code"]), int(header["qform_code"])) == (0, 0)
    assert header.get_zooms() == (2.0, 3.0, 4.0)
    assert read_grid(tmp_path / "out.nii").matches(back.grid)


def test_mgh_scan_parameters_survive(tmp_path):
    image = nib.MGHImage(volume(TWINS["oblique"]).data.astype(np.int32), TWINS["oblique"].affine)
    image.header["tr"], image.header["te"] = 2300.0, 2.98
    image.to_filename(tmp_path / "in.mgz")
    back = read_volume(tmp_path / "in.mgz")
    write_volume(tmp_path / "out.mgz", back.with_data(back.data + 0.5), dtype=np.float64)
    stored = nib.load(tmp_path / "out.mgz")
    assert (float(stored.header["tr"]), stored.header["te"]) == (2300.0, np.float32(2.98))
    assert stored.get_data_dtype() == np.dtype(">f4")
    assert np.array_equal(stored.affine, nib.load(tmp_path / "in.mgz").affine)
    assert np.array_equal(stored.get_fdata(), back.data + 0.5)


def test_metaimage_entries_survive(tmp_path):
    image = sitk.GetImageFromArray(np.arange(24, dtype=np.int16).reshape(4, 3, 2))
    image.SetMetaData("Patient", "phantom 7")
    sitk.WriteImage(image, str(tmp_path / "in.mha"))
    back = read_volume(tmp_path / "in.mha")
    assert back.data[1, 2, 3] == 23
    write_volume(tmp_path / "out.mhd", back)
    stored = sitk.ReadImage(str(tmp_path / "out.mhd"))
    assert stored.GetMetaData("Patient") == "phantom 7"
    assert "ElementDataFile = out.raw" in (tmp_path / "out.mhd").read_text()
    assert (tmp_path / "out.raw").stat().st_size == 24 * 4


@pytest.mark.parametrize("source", PLACED)
@pytest.mark.parametrize("target", [".nii.gz", ".mgz", ".mha", ".npy"])
def test_a_foreign_header_is_ignored(tmp_path, source, target):
    write_volume(tmp_path / f"in{source}", volume(TWINS["oblique"]))
    write_volume(tmp_path / f"out{target}", read_volume(tmp_path / f"in{source}"))
    back = read_volume(tmp_path / f"out{target}")
    assert np.array_equal(back.data, volume(TWINS["oblique"]).data)
    assert target == ".npy" or back.grid.matches(TWINS["oblique"])


# --- names -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("a/o.nii.gz", "a/o"),
        ("o.NII.GZ", "o"),
        ("sub-01.run-2.nii", "sub-01.run-2"),
        ("o.mha", "o"),
        ("o.func.gii", "o.func"),
        ("o.surf.gii", "o.surf"),
        ("o.npy", "o"),
    ],
)
def test_stem(name, expected):
    assert stem(Path(name)) == Path(expected)


@pytest.mark.parametrize("name", [".", "..", "..nii", "..nii.gz", "a/...nii.gz", "a/..npy", ""])
def test_a_name_of_dots_has_no_stem(name):
    with pytest.raises(RefusedError, match="no name of a file"):
        stem(Path(name))


@pytest.mark.parametrize(
    ("name", "files"),
    [
        ("a/o.nii.gz", ["a/o.nii.gz"]),
        ("o.hdr", ["o.img", "o.hdr"]),
        ("o.img", ["o.img", "o.hdr"]),
        ("o.mhd", ["o.raw", "o.mhd"]),
        ("o.mha", ["o.mha"]),
        ("o.npy", ["o.npy"]),
    ],
)
def test_files_of_a_volume(tmp_path, name, files):
    assert volume_files(Path(name)) == [Path(file) for file in files]
    (tmp_path / "a").mkdir()
    write_volume(tmp_path / name, volume(TWINS["RAS"]))
    assert {file for file in tmp_path.rglob("*") if file.is_file()} == {tmp_path / file for file in files}


def test_unknown_suffixes_are_refused_with_the_known_ones():
    with pytest.raises(RefusedError, match=r"x\.mnc: .* \.nii \.nii\.gz \.hdr \.img \.mha"):
        volume_format(Path("x.mnc"))
    with pytest.raises(RefusedError, match=r"x\.gii: .* \.surf\.gii \.ply"):
        mesh_format(Path("x.gii"))
    with pytest.raises(RefusedError, match="read only"):
        volume_files(Path("x.png"))
    assert (volume_format(Path("X.NII.GZ")), mesh_format(Path("lh.surf.gii"))) == ("NIfTI", "GIFTI")


def test_writing_needs_no_lower_case(tmp_path):
    for name in ("V.NII.GZ", "V.NPY", "V.MGZ"):
        write_volume(tmp_path / name, volume(TWINS["RAS"]))
        assert np.array_equal(read_volume(tmp_path / name).data, volume(TWINS["RAS"]).data)
    with pytest.raises(RefusedError, match="lower case"):
        volume_files(tmp_path / "V.MHA")


# --- pictures ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_grey_png(tmp_path, dtype):
    picture = (np.arange(20).reshape(4, 5) * 12).astype(dtype)
    sitk.WriteImage(sitk.GetImageFromArray(picture), str(tmp_path / "p.png"))
    back = read_volume(tmp_path / "p.png")
    assert back.file_shape == (4, 5)
    assert np.array_equal(back.data[:, :, 0], picture)
    assert np.array_equal(back.grid.affine, np.eye(4))


def test_coloured_png_is_refused(tmp_path):
    sitk.WriteImage(sitk.GetImageFromArray(np.zeros((4, 5, 3), np.uint8), isVector=True), str(tmp_path / "p.png"))
    with pytest.raises(RefusedError, match="found 3 channels"):
        read_volume(tmp_path / "p.png")


# --- bad files ---------------------------------------------------------------------------------------------------


def _whole(suffix: str, folder: Path) -> Path:
    path = folder / f"whole{suffix}"
    if suffix == ".png":
        noise = np.random.default_rng(0).integers(0, 255, (40, 50), np.uint8)
        sitk.WriteImage(sitk.GetImageFromArray(noise), str(path))
    else:
        noise = np.random.default_rng(0).normal(size=(10, 11, 12)).astype(np.float32)
        write_volume(path, Volume(noise, Grid.from_spacing(noise.shape)))
    return path


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".mgz", ".mgh", ".mha", ".npy", ".png"])
@pytest.mark.parametrize("damage", ["truncated", "text", "empty", "head only"])
def test_damaged_files_fail_in_one_line(tmp_path, capfd, suffix, damage):
    content = _whole(suffix, tmp_path).read_bytes()
    damaged = {
        "truncated": content[: len(content) * 3 // 4],
        "text": b"version https://git-lfs.github.com/spec/v1\noid sha256:0\nsize 12\n" * 20,
        "empty": b"",
        "head only": content[:20],
    }[damage]
    path = tmp_path / f"bad{suffix}"
    path.write_bytes(damaged)
    with pytest.raises(DataError) as failure:
        read_volume(path)
    assert f"{path}: cannot be read as" in one_line(failure.value)
    assert capfd.readouterr() == ("", "")


def test_missing_files_are_refused(tmp_path):
    for name in ("gone.nii", "gone.npy", "gone.mha"):
        with pytest.raises(RefusedError, match="no such file"):
            read_volume(tmp_path / name)
    (tmp_path / "folder.nii").mkdir()
    with pytest.raises(RefusedError, match=r"folder\.nii: is a folder; expected a file"):
        read_volume(tmp_path / "folder.nii")
    (tmp_path / "link.nii").symlink_to(tmp_path / "gone.nii")
    with pytest.raises(RefusedError, match="a link to a file that is not there"):
        read_volume(tmp_path / "link.nii")


@pytest.mark.parametrize(
    ("whole", "gone", "left"),
    [
        ("v.hdr", "v.img", "v.hdr"),
        ("v.img", "v.hdr", "v.img"),
        ("V.HDR", "V.IMG", "V.HDR"),
        ("v.mhd", "v.raw", "v.mhd"),
    ],
)
def test_half_of_a_pair_is_refused(tmp_path, capfd, whole, gone, left):
    write_volume(tmp_path / whole, volume(TWINS["RAS"]))
    (tmp_path / gone).unlink()
    with pytest.raises(RefusedError) as refusal:
        read_volume(tmp_path / left)
    assert f"half of a pair; expected {gone} beside it" in one_line(refusal.value)
    assert capfd.readouterr() == ("", "")


def test_vertices_folded_into_a_volume_are_refused(tmp_path):
    nib.MGHImage(np.zeros((27307, 1, 6), np.float32), np.eye(4)).to_filename(tmp_path / "thickness.mgz")
    with pytest.raises(RefusedError, match="163842 values as on a cortical mesh"):
        read_volume(tmp_path / "thickness.mgz")


def test_writing_where_nothing_can_be_written_fails_in_one_line(tmp_path, capfd):
    for suffix in (*PLACED, ".npy"):
        with pytest.raises(DataError) as failure:
            write_volume(tmp_path / "gone" / f"v{suffix}", volume(TWINS["RAS"]))
        assert f"v{suffix}: cannot be written" in one_line(failure.value)
    assert capfd.readouterr() == ("", "")


def test_pickles_are_never_opened(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[{"a": 1}, None]], object), allow_pickle=True)
    with pytest.raises(DataError, match="never unpickled"):
        read_volume(tmp_path / "a.npy")


@pytest.mark.parametrize("dtype", [np.complex64, "U3", [("R", "u1"), ("G", "u1"), ("B", "u1")], "M8[s]"])
def test_other_than_real_numbers_are_refused(tmp_path, dtype):
    np.save(tmp_path / "a.npy", np.zeros((3, 4, 5), dtype))
    with pytest.raises(RefusedError):
        read_volume(tmp_path / "a.npy")


def test_coloured_and_complex_volumes_are_refused(tmp_path):
    rgb = np.zeros((3, 4, 5), [("R", "u1"), ("G", "u1"), ("B", "u1")])
    nib.Nifti1Image(rgb, np.eye(4)).to_filename(tmp_path / "rgb.nii")
    nib.Nifti1Image(np.zeros((3, 4, 5), np.complex64), np.eye(4)).to_filename(tmp_path / "complex.nii")
    sitk.WriteImage(
        sitk.GetImageFromArray(np.zeros((3, 4, 5, 3), np.float32), isVector=True), str(tmp_path / "rgb.mha")
    )
    for name, words in (("rgb.nii", "vector or RGB"), ("complex.nii", "complex"), ("rgb.mha", "3 channels")):
        with pytest.raises(RefusedError, match=words):
            read_volume(tmp_path / name)


def test_a_useless_affine_fails_in_one_line(tmp_path):
    image = nib.Nifti1Image(np.zeros((3, 4, 5), np.float32), None)
    for flat in (np.diag([1.0, 0.0, 1.0, 1.0]), np.diag([np.nan, 1.0, 1.0, 1.0])):
        image.header.set_sform(flat, code=1)
        image.to_filename(tmp_path / "flat.nii")
        with pytest.raises(DataError, match="places the voxels nowhere"):
            read_volume(tmp_path / "flat.nii")


def test_a_nifti_that_lies_about_its_size(tmp_path):
    write_volume(tmp_path / "v.nii", volume(TWINS["RAS"]))
    content = bytearray((tmp_path / "v.nii").read_bytes())
    content[42:48] = np.array([16000, 16000, 16000], "<i2").tobytes()
    (tmp_path / "v.nii").write_bytes(content)
    (tmp_path / "v.nii.gz").write_bytes(gzip.compress(content))
    for name in ("v.nii", "v.nii.gz"):
        with pytest.raises(DataError) as failure:
            read_volume(tmp_path / name)
        one_line(failure.value)


# --- files from the wild -----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "shape", "low", "high", "spacing"),
    [
        ("bigendian_float32_RAS.nii", (21, 26, 22), 0.0, 21199.936, (4, 4, 4)),
        ("bigendian_int16_LAS.nii", (33, 41, 25), -610.0, 30393.0, (2, 2, 2)),
        ("fmri_tstat_oblique.nii.gz", (64, 64, 36), -13.264401, 8.655761, (3, 3, 3.6)),
        ("mgz_256_uint8_freesurfer_wm.mgz", (256, 256, 256), 0.0, 250.0, (1, 1, 1)),
        ("no_qform_no_sform_bigendian.nii.gz", (64, 64, 10), 0.0, 63.0, (3, 3, 3)),
        ("pair_ras.hdr", (62, 41, 34), 0.0, 255.0, (2.385, 2.39, 2.366)),
        ("pair_ras.img", (62, 41, 34), 0.0, 255.0, (2.385, 2.39, 2.366)),
        ("sheared_affine_ct_uint8_slope.nii.gz", (306, 422, 54), -1024.0, 789.0, (0.4824, 0.4824, 2.371)),
        ("uint8_anisotropic_1x3x2.nii.gz", (4, 5, 7), 0.0, 255.0, (1, 3, 2)),
    ],
)
def test_odd_but_readable(tmp_path, name, shape, low, high, spacing):
    before = read_volume(real(f"odd_real/{name}"))
    assert before.data.shape == shape
    assert before.data.dtype == np.float32
    assert before.data.dtype.isnative
    assert np.allclose([before.data.min(), before.data.max()], [low, high], rtol=1e-6)
    assert np.allclose(before.grid.spacing, spacing, rtol=1e-3)
    assert before.grid.is_sheared() == name.startswith("sheared")

    out = tmp_path / f"out{''.join(Path(name).suffixes)}"
    write_volume(out, before)
    after = read_volume(out)
    assert np.array_equal(after.data, before.data)
    assert np.array_equal(after.grid.affine, before.grid.affine)


@pytest.mark.parametrize(
    ("name", "words"),
    [
        ("cifti2_not_a_volume.dconn.nii", "CIFTI"),
        ("complex64.nii.gz", "complex"),
        ("header_only_no_img_nifti1.hdr", "header_only_no_img_nifti1.img"),
        ("int16_sclslope_4d_LAS.nii", r"4-D \(x, y, z, 20\)"),
        ("mgz_tiny_4d_oblique.mgz", r"4-D \(x, y, z, 2\)"),
        ("minc2_unsupported.mnc", "not the suffix of a volume"),
        ("nifti2_oblique_4d.nii.gz", "several frames"),
        ("oblique_int16_4d.nii.gz", "several frames"),
        ("surface_data_as_nifti_163842x1x1.nii.gz", "163842 values as on a cortical mesh"),
    ],
)
def test_odd_and_refused(capfd, name, words):
    path = real(f"odd_real/{name}")
    for read in (read_grid, read_volume):
        with pytest.raises(RefusedError, match=words) as refusal:
            read(path)
        one_line(refusal.value)
    assert capfd.readouterr() == ("", "")


def test_real_metaimage(tmp_path):
    before = read_volume(real("mha_real/niivue_mha.mha"))
    assert before.data.shape == (64, 64, 37)
    assert (before.data.min(), before.data.max()) == (0, 6690)
    assert np.allclose(before.grid.affine[:3, :3], np.diag([-3.4375, 3.4375, 3.8]))
    assert np.allclose(before.grid.affine[:3, 3], [108.281, -82.3795, -47.8356])
    write_volume(tmp_path / "out.nii.gz", before)
    write_volume(tmp_path / "out.mha", before)
    for name in ("out.nii.gz", "out.mha"):
        after = read_volume(tmp_path / name)
        assert np.array_equal(after.data, before.data)
        assert after.grid.matches(before.grid)
