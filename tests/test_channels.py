"""Channels, frames, colours, complex numbers and masks: through every format and back, whole and frame by frame."""

from __future__ import annotations

import tracemalloc
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from twins import TWINS

from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.formats import (
    Series,
    open_series,
    read_grid,
    read_layout,
    read_volume,
    require_writable,
    write_series,
    write_volume,
)
from beltrami_cli.grid import Grid, Volume

VOLUMES = [".nii", ".nii.gz", ".hdr", ".mgz", ".mha", ".mhd", ".npy"]
GRID = Grid.from_spacing((3, 4, 5), 2.0)
FRAMES = np.arange(3 * 4 * 5 * 6, dtype=np.float32).reshape(3, 4, 5, 6)
WAVES = (FRAMES[..., 0] + 1j * FRAMES[..., 1]).astype(np.complex64)
RGB = [("R", "u1"), ("G", "u1"), ("B", "u1")]


def fmri(path: Path, data: np.ndarray = FRAMES) -> Path:
    """Frames of 2.2 s with a description."""
    image = nib.Nifti1Image(data, TWINS["oblique"].affine)
    image.header.set_xyzt_units("mm", "sec")
    image.header["pixdim"][4] = 2.2
    image.header["descrip"] = b"resting"
    image.header["cal_max"] = 3
    image.to_filename(path)
    return path


# --- channels and frames -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", VOLUMES)
def test_channels_come_back_from_every_format(tmp_path, suffix):
    path = tmp_path / f"v{suffix}"
    write_volume(path, Volume(FRAMES, GRID))
    with pytest.raises(RefusedError, match="--kind vector"):
        read_volume(path)
    back = read_volume(path, channels=True)
    assert (back.data.dtype, back.file_shape, back.channels) == (np.float32, (3, 4, 5, 6), 6)
    assert np.array_equal(back.data, FRAMES)
    assert read_layout(path) == (6, False)
    assert read_grid(path, channels=True).matches(back.grid)


@pytest.mark.parametrize("suffix", VOLUMES)
def test_channels_of_a_plane_come_back(tmp_path, suffix):
    path, picture = tmp_path / f"v{suffix}", FRAMES[:, :, :1]
    write_volume(path, Volume(picture, Grid.from_spacing((3, 4, 1)), (3, 4, 6)))
    back = read_volume(path, channels=True, plane=True)
    assert back.grid.shape == (3, 4, 1)
    assert np.array_equal(back.data, picture)


def test_three_axes_of_npy_are_a_volume_or_a_plane_of_channels(tmp_path):
    np.save(tmp_path / "a.npy", FRAMES[..., 0])
    assert read_volume(tmp_path / "a.npy", channels=True).data.shape == (3, 4, 5)
    assert read_volume(tmp_path / "a.npy", plane=True).data.shape == (3, 4, 5)
    assert read_volume(tmp_path / "a.npy", channels=True, plane=True).data.shape == (3, 4, 1, 5)
    assert read_layout(tmp_path / "a.npy", plane=True) == (5, False)
    np.save(tmp_path / "slice.npy", FRAMES[:1, ..., 0])
    assert read_volume(tmp_path / "slice.npy", channels=True, plane=True).data.shape == (1, 4, 5)


def test_fifth_axis_of_a_nifti_vector(tmp_path):
    fmri(tmp_path / "v.nii.gz", FRAMES[:, :, :, None])
    back = read_volume(tmp_path / "v.nii.gz", channels=True)
    assert np.array_equal(back.data, FRAMES)
    write_volume(tmp_path / "w.nii.gz", back)
    assert nib.load(tmp_path / "w.nii.gz").shape == (3, 4, 5, 1, 6)
    fmri(tmp_path / "two.nii.gz", FRAMES.reshape(3, 4, 5, 2, 3))
    with pytest.raises(RefusedError, match="found 2, of lengths 2 and 3"):
        read_volume(tmp_path / "two.nii.gz", channels=True)


def test_a_nifti_header_keeps_its_frames(tmp_path):
    before = read_volume(fmri(tmp_path / "v.nii.gz"), channels=True)
    write_volume(tmp_path / "w.nii.gz", before)
    write_volume(tmp_path / "m.nii.gz", before.with_data(before.data[..., 0] > 3), dtype=np.uint8)
    after, mask = nib.load(tmp_path / "w.nii.gz"), nib.load(tmp_path / "m.nii.gz")
    assert after.header.get_zooms()[3] == np.float32(2.2)
    assert after.header.get_xyzt_units() == ("mm", "sec")
    assert after.header["descrip"].tobytes().startswith(b"resting")
    assert np.array_equal(after.affine, nib.load(tmp_path / "v.nii.gz").affine)
    assert (mask.shape, mask.get_data_dtype()) == ((3, 4, 5), np.uint8)


def test_frames_under_the_header_of_a_single_volume(tmp_path):
    image = nib.Nifti1Image(FRAMES[..., 0], TWINS["oblique"].affine)
    image.header.set_intent("z score")
    image.header["pixdim"][4] = 0
    image.to_filename(tmp_path / "psi.nii")
    write_volume(tmp_path / "v.nii", read_volume(tmp_path / "psi.nii").with_data(FRAMES))
    header = nib.load(tmp_path / "v.nii").header
    assert (header.get_zooms()[3], header.get_intent()[0]) == (1, "none")
    assert np.array_equal(header.get_sform(), image.header.get_sform())


def test_frames_of_metaimage_stay_frames(tmp_path):
    image = sitk.GetImageFromArray(FRAMES.T, isVector=False)
    image.SetSpacing((2, 2, 2, 1.5))
    sitk.WriteImage(image, str(tmp_path / "v.mha"))
    before = read_volume(tmp_path / "v.mha", channels=True)
    assert np.array_equal(before.data, FRAMES)
    write_volume(tmp_path / "w.mha", before)
    after = sitk.ReadImage(str(tmp_path / "w.mha"))
    assert (after.GetSize(), after.GetSpacing()) == ((3, 4, 5, 6), (2, 2, 2, 1.5))
    assert np.array_equal(read_volume(tmp_path / "w.mha", channels=True).data, FRAMES)


def test_vector_pixels_of_metaimage(tmp_path):
    write_volume(tmp_path / "v.mha", Volume(FRAMES, GRID))
    image = sitk.ReadImage(str(tmp_path / "v.mha"))
    assert (image.GetSize(), image.GetNumberOfComponentsPerPixel()) == ((3, 4, 5), 6)
    assert image.GetPixel(1, 2, 3) == tuple(FRAMES[1, 2, 3])


# --- colours -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("fields", [RGB, [*RGB, ("A", "u1")]])
def test_nifti_colours_are_channels_without_transparency(tmp_path, fields):
    colours = np.zeros((3, 4, 5), fields)
    for k, (name, _) in enumerate(fields):
        colours[name] = FRAMES[..., k] % 256
    nib.Nifti1Image(colours, np.eye(4)).to_filename(tmp_path / "v.nii")
    back = read_volume(tmp_path / "v.nii", channels=True)
    assert np.array_equal(back.data, FRAMES[..., :3] % 256)
    assert read_layout(tmp_path / "v.nii") == (3, False)
    assert np.array_equal(open_series(tmp_path / "v.nii").frame(1), FRAMES[..., 1] % 256)
    write_volume(tmp_path / "w.nii", back)
    after = nib.load(tmp_path / "w.nii")
    assert (after.shape, after.get_data_dtype()) == ((3, 4, 5, 3), np.float32)


@pytest.mark.parametrize("stored", [3, 4])
def test_coloured_png(tmp_path, stored):
    picture = (np.arange(4 * 5 * stored) * 2).reshape(4, 5, stored).astype(np.uint8)
    sitk.WriteImage(sitk.GetImageFromArray(picture, isVector=True), str(tmp_path / "p.png"))
    back = read_volume(tmp_path / "p.png", channels=True)
    assert (back.data.shape, back.file_shape) == ((4, 5, 1, 3), (4, 5, 3))
    assert np.array_equal(back.data[:, :, 0], picture[..., :3])
    assert read_layout(tmp_path / "p.png") == (3, False)


def test_grey_png_with_transparency_is_refused(tmp_path):
    picture = sitk.GetImageFromArray(np.zeros((4, 5, 2), np.uint8), isVector=True)
    sitk.WriteImage(picture, str(tmp_path / "p.png"))
    with pytest.raises(RefusedError, match="grey with transparency"):
        read_volume(tmp_path / "p.png", channels=True)


# --- complex numbers and masks -----------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".hdr", ".npy"])
@pytest.mark.parametrize(("real", "kept"), [(np.float32, np.complex64), (np.float64, np.complex128)])
def test_complex_numbers_come_back(tmp_path, suffix, real, kept):
    path = tmp_path / f"v{suffix}"
    write_volume(path, Volume(WAVES, GRID), dtype=real)
    back = read_volume(path, dtype=real, channels=True)
    assert (back.data.dtype, back.data.shape, read_layout(path)) == (kept, (3, 4, 5), (1, True))
    assert np.array_equal(back.data, WAVES)
    for refused in (read_volume, open_series):
        with pytest.raises(RefusedError, match="complex"):
            refused(path)


def test_complex_numbers_that_cannot_be(tmp_path):
    for name in ("v.mha", "v.mgz"):
        with pytest.raises(RefusedError, match="cannot hold complex numbers; write NIfTI or NPY"):
            require_writable(tmp_path / name, GRID, is_complex=True)
        with pytest.raises(RefusedError, match="complex"):
            write_volume(tmp_path / name, Volume(WAVES, GRID))
    require_writable(tmp_path / "v.nii.gz", GRID, channels=6)
    require_writable(tmp_path / "v.npy", GRID, is_complex=True)
    np.save(tmp_path / "a.npy", FRAMES * 1j)
    with pytest.raises(RefusedError, match="one complex number per voxel; found 6"):
        read_volume(tmp_path / "a.npy", channels=True)


@pytest.mark.parametrize("suffix", VOLUMES)
def test_masks_are_bytes(tmp_path, suffix):
    path = tmp_path / f"v{suffix}"
    mask = FRAMES[..., 0] % 2 > 0
    write_volume(path, Volume(mask, GRID), dtype=np.uint8)
    assert np.array_equal(read_volume(path).data, mask)
    if suffix == ".npy":
        assert np.load(path).dtype == np.uint8
    elif suffix in (".mha", ".mhd"):
        assert sitk.ReadImage(str(path)).GetPixelID() == sitk.sitkUInt8
    else:
        assert nib.load(path).get_data_dtype() == np.uint8


# --- frame by frame ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("source", VOLUMES)
@pytest.mark.parametrize("target", VOLUMES)
def test_a_series_passes_frame_by_frame(tmp_path, source, target):
    write_volume(tmp_path / f"a{source}", Volume(FRAMES, GRID))
    series = open_series(tmp_path / f"a{source}")
    assert (series.count, series.file_shape, len(list(series))) == (6, (3, 4, 5, 6), 6)
    assert np.array_equal(series.frame(4), FRAMES[..., 4])
    assert np.array_equal(series.frame(1), FRAMES[..., 1])
    write_series(tmp_path / f"b{target}", series, (frame + 1 for frame in series))
    back = read_volume(tmp_path / f"b{target}", channels=True, spacing=2.0 if target == ".npy" else None)
    assert np.array_equal(back.data, FRAMES + 1)
    assert back.grid.matches(GRID) or source == ".npy"


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".hdr"])
@pytest.mark.parametrize("stored", [np.float32, np.int16, ">f4"])
def test_a_nifti_series_keeps_its_header(tmp_path, suffix, stored):
    data = np.asarray(FRAMES, stored)
    image = nib.Nifti2Image(data, TWINS["oblique"].affine)
    image.header.set_xyzt_units("mm", "sec")
    image.header["pixdim"][4] = 2.2
    image.header.set_slope_inter(0.5, 3)
    image.header["cal_max"] = 3
    image.header.extensions.append(nib.nifti1.Nifti1Extension("comment", b"a longer remark on these frames"))
    image.to_filename(tmp_path / "a.nii.gz")
    series = open_series(tmp_path / "a.nii.gz")
    whole = read_volume(tmp_path / "a.nii.gz", channels=True).data
    path = tmp_path / f"b{suffix}"
    write_series(path, series, series, dtype=np.float64)
    after = nib.load(path)
    assert np.allclose(after.get_fdata(), whole, rtol=1e-6)
    assert (after.shape, after.get_data_dtype().kind, after.header["sizeof_hdr"]) == ((3, 4, 5, 6), "f", 540)
    assert after.header.get_zooms()[3] == pytest.approx(2.2)
    assert np.array_equal(after.affine, image.affine)
    assert (len(after.header.extensions), float(after.header["cal_max"])) == (1, 0)


@pytest.mark.parametrize(("source", "target"), [("a.nii.gz", "b.nii.gz"), ("a.mgz", "b.npy"), ("a.nii", "b.hdr")])
def test_memory_does_not_grow_with_the_frames(tmp_path, source, target):
    frames = np.random.default_rng(0).integers(0, 1000, (32, 32, 20, 60)).astype(np.float32)
    write_volume(tmp_path / source, Volume(frames, Grid.from_spacing((32, 32, 20))))
    write_series(tmp_path / f"first_{target}", open_series(tmp_path / source), open_series(tmp_path / source))
    tracemalloc.start()
    series = open_series(tmp_path / source)
    write_series(tmp_path / target, series, series)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 8 * frames[..., 0].nbytes
    assert np.array_equal(read_volume(tmp_path / target, channels=True).data, frames)


def test_a_series_on_another_grid(tmp_path):
    series = open_series(fmri(tmp_path / "a.nii.gz"))
    other = Grid.from_spacing((5, 4, 3), 1.5)
    moved = Series(other, series.count, series.file_shape, series.header, series.frame)
    write_series(tmp_path / "b.nii", moved, (frame.T for frame in series))
    after = nib.load(tmp_path / "b.nii")
    assert (after.shape, after.header.get_zooms()) == ((5, 4, 3, 6), pytest.approx((1.5, 1.5, 1.5, 2.2)))
    assert np.array_equal(after.get_fdata()[..., 2], FRAMES[..., 2].T)


def test_a_volume_is_a_series_of_one(tmp_path):
    write_volume(tmp_path / "a.nii", Volume(FRAMES[..., 0], GRID))
    for target in ("b.nii.gz", "b.npy", "b.mha"):
        series = open_series(tmp_path / "a.nii")
        assert series.count == 1
        write_series(tmp_path / target, series, series)
        assert read_volume(tmp_path / target).file_shape == (3, 4, 5)


def test_frames_that_are_not_as_announced(tmp_path):
    write_volume(tmp_path / "a.npy", Volume(FRAMES, GRID))
    series = open_series(tmp_path / "a.npy")
    for frames in ([FRAMES[..., 0]] * 5, [FRAMES[..., 0]] * 7, [FRAMES[0]]):
        for target in ("b.nii.gz", "b.npy", "b.mha"):
            with pytest.raises(ValueError, match="frame"):
                write_series(tmp_path / target, series, frames)


def test_a_series_cut_short_fails_in_one_line(tmp_path):
    for name in ("a.nii", "a.nii.gz"):
        path = tmp_path / name
        write_volume(path, Volume(np.random.default_rng(0).normal(size=(9, 9, 9, 6)), Grid.from_spacing((9, 9, 9))))
        path.write_bytes(path.read_bytes()[:9000])
        with pytest.raises(DataError, match="cannot be read as NIfTI"):
            list(open_series(path))


def test_an_error_in_a_frame_is_not_one_of_writing(tmp_path):
    write_volume(tmp_path / "a.nii", Volume(FRAMES, GRID))
    series = open_series(tmp_path / "a.nii")
    for target in ("b.nii.gz", "b.npy"):
        with pytest.raises(ZeroDivisionError):
            write_series(tmp_path / target, series, (frame * (1 / (t - 2)) for t, frame in enumerate(series)))
    with pytest.raises(DataError, match="cannot be written"):
        write_series(tmp_path / "gone" / "b.nii", series, series)
