"""Vertex data: read from every format, chosen among maps, refused where it does not fit, and written back."""

from __future__ import annotations

from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from nibabel import freesurfer, gifti

from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.formats import (
    is_overlay,
    is_surface,
    overlay_files,
    overlay_format,
    overlay_structure,
    read_maps,
    read_overlay,
    read_volume,
    require_overlay_writable,
    stem,
    write_mesh,
    write_overlay,
)
from beltrami_cli.surface import Mesh

COUNT = 30
VALUES = np.random.default_rng(1).normal(10, 3, COUNT).astype(np.float32)
VALUES[4] = np.nan
SEVERAL = np.stack([VALUES, 2 * VALUES, -VALUES], -1)

ONE_MAP = ["o.func.gii", "o.shape.gii", "o.mgz", "o.mgh", "lh.o", "rh.o.fwhm5", "o.curv"]
SEVERAL_MAPS = ["o.func.gii", "o.shape.gii", "o.mgz", "o.mgh"]


def maps(path: Path, arrays: dict[str, np.ndarray], intent: str = "NIFTI_INTENT_NONE", **options) -> Path:
    darrays = [
        gifti.GiftiDataArray(values, intent, meta=gifti.GiftiMetaData({"Name": name} if name else {}), **options)
        for name, values in arrays.items()
    ]
    gifti.GiftiImage(darrays=darrays).to_filename(path)
    return path


# --- there and back -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ONE_MAP)
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_one_map_comes_back(tmp_path, name, dtype):
    path = tmp_path / name
    assert overlay_files(path) == [path]
    write_overlay(path, VALUES.astype(dtype), dtype=dtype)
    assert list(tmp_path.iterdir()) == [path]
    assert is_overlay(path)
    assert not is_surface(path)
    back = read_overlay(path, COUNT, dtype=dtype)
    assert back.dtype == dtype
    assert np.array_equal(back, VALUES, equal_nan=True)
    # As channels, one map is still a plain list of values.
    assert read_overlay(path, COUNT, channels=True).shape == (COUNT,)


@pytest.mark.parametrize("name", SEVERAL_MAPS)
def test_several_maps_come_back(tmp_path, name):
    path = tmp_path / name
    write_overlay(path, SEVERAL)
    assert np.array_equal(read_overlay(path, COUNT, channels=True), SEVERAL, equal_nan=True)
    assert np.array_equal(read_overlay(path, COUNT, map=2), SEVERAL[:, 1], equal_nan=True)
    with pytest.raises(RefusedError, match=r"found 3 maps: (value|frame) 1, .* 3; keep one in .*--map.* --kind vector"):
        read_overlay(path, COUNT)


@pytest.mark.parametrize("name", ONE_MAP)
def test_the_same_bytes_each_time(tmp_path, name):
    first, second = tmp_path / "a" / name, tmp_path / "b" / name
    for path in (first, second):
        path.parent.mkdir()
        write_overlay(path, VALUES, structure="CortexLeft")
    assert first.read_bytes() == second.read_bytes()
    write_mesh(tmp_path / "a.surf.gii", Mesh(np.eye(3), np.array([[0, 1, 2]], np.int32)))
    write_mesh(tmp_path / "b.surf.gii", Mesh(np.eye(3), np.array([[0, 1, 2]], np.int32)))
    assert (tmp_path / "a.surf.gii").read_bytes() == (tmp_path / "b.surf.gii").read_bytes()


def test_what_other_programs_find_in_gifti(tmp_path):
    for name, values, intents in (
        ("o.shape.gii", VALUES, [2005]),  # NIFTI_INTENT_SHAPE
        ("s.shape.gii", SEVERAL, [2005] * 3),
        ("o.func.gii", VALUES, [0]),  # NIFTI_INTENT_NONE
        ("s.func.gii", SEVERAL, [2001] * 3),  # NIFTI_INTENT_TIME_SERIES
    ):
        write_overlay(tmp_path / name, values, structure="CortexRight")
        image = nib.load(tmp_path / name)
        assert [array.intent for array in image.darrays] == intents
        assert {str(array.data.dtype) for array in image.darrays} == {"float32"}
        assert image.meta["AnatomicalStructurePrimary"] == "CortexRight"
    assert image.agg_data().shape == (COUNT, 3)
    write_overlay(tmp_path / "o.func.gii", VALUES)
    assert "AnatomicalStructurePrimary" not in nib.load(tmp_path / "o.func.gii").meta


def test_what_other_programs_find_in_freesurfers_formats(tmp_path):
    write_overlay(tmp_path / "lh.o", VALUES)
    assert np.array_equal(freesurfer.read_morph_data(tmp_path / "lh.o"), VALUES, equal_nan=True)
    write_overlay(tmp_path / "o.mgz", SEVERAL)
    image = nib.load(tmp_path / "o.mgz")
    assert (image.shape, image.get_data_dtype()) == ((COUNT, 1, 1, 3), np.dtype(">f4"))
    write_overlay(tmp_path / "mask.mgz", (VALUES > 10).astype(np.uint8), dtype=np.uint8)
    assert nib.load(tmp_path / "mask.mgz").get_data_dtype() == np.uint8


def test_freesurfers_format_holds_one_map(tmp_path):
    with pytest.raises(RefusedError, match=r"one value per vertex; found 3; write \.mgz or \.func\.gii"):
        write_overlay(tmp_path / "lh.o", SEVERAL)
    assert list(tmp_path.iterdir()) == []
    with pytest.raises(RefusedError, match=r"lh\.o: .* found 2; write"):
        require_overlay_writable(tmp_path / "lh.o", 2)
    require_overlay_writable(tmp_path / "lh.o", 1)
    require_overlay_writable(tmp_path / "o.mgz", 2)
    with pytest.raises(RefusedError, match="not written so"):
        require_overlay_writable(tmp_path / "o.nii.gz", 1)


def test_of_which_structure_values_are(tmp_path):
    for name, structure, expected in (
        ("lh.o.func.gii", "CortexRight", "CortexRight"),
        ("lh.o.func.gii", None, "CortexLeft"),
        ("o_hemi-R.shape.gii", None, "CortexRight"),
        ("o.func.gii", None, None),
        ("lh.o", None, "CortexLeft"),
        ("rh.o.mgz", None, "CortexRight"),
    ):
        write_overlay(tmp_path / name, VALUES, structure=structure)
        assert overlay_structure(tmp_path / name) == expected
    path = maps(tmp_path / "a.func.gii", {"a": VALUES, "b": VALUES})
    image = nib.load(path)
    image.darrays[1].meta["AnatomicalStructurePrimary"] = "CORTEX_RIGHT"  # of an array
    image.to_filename(path)
    assert overlay_structure(path) == "CortexRight"
    with pytest.raises(RefusedError, match="no such file"):
        overlay_structure(tmp_path / "absent.func.gii")


@pytest.mark.parametrize("name", ["o.nii.gz", "o.surf.gii", "o.gii", "o.label.gii"])
def test_formats_that_are_not_written(name):
    with pytest.raises(RefusedError, match=r"not written so; expected \.func\.gii \.shape\.gii \.mgz or lh\.NAME"):
        overlay_files(Path(name))


@pytest.mark.parametrize(
    "name", ["o.txt", "o", "lh.o.txt", "lh.aparc.annot", "lh.o.npy", "lh.o.mha", "lh.cortex.label"]
)
def test_files_of_no_format(name):
    with pytest.raises(RefusedError, match=r"not a file of vertex data; expected \.func\.gii"):
        overlay_format(Path(name))
    assert not is_overlay(Path(name))


@pytest.mark.parametrize(
    ("path", "expected"),
    [
        ("o/lh.map", "o/lh.map"),
        ("rh.thickness.fwhm5", "rh.thickness.fwhm5"),
        ("lh.curv", "lh.curv"),
        ("o.curv", "o"),
        ("lh.o.func.gii", "lh.o.func"),
        ("o.shape.gii", "o.shape"),
        ("lh.o.nii.gz", "lh.o"),
        ("lh.o.mgz", "lh.o"),
        ("lh.o.ply", "lh.o"),
    ],
)
def test_stems(path, expected):
    assert stem(Path(path)) == Path(expected)


# --- GIFTI of other programs --------------------------------------------------------------------------------------


def test_one_map_of_many(tmp_path):
    path = maps(tmp_path / "lh.crop.func.gii", {"angle": VALUES, "ecc": 2 * VALUES, "2": 3 * VALUES, "": 4 * VALUES})
    for choice, factor in (("angle", 1), ("ecc", 2), (1, 1), ("1", 1), ("2", 3), (2, 2), (4, 4), ("map 4", 4)):
        assert np.array_equal(read_overlay(path, COUNT, map=choice), factor * VALUES, equal_nan=True), choice
    for choice in ("eccentricity", 5, 0, "-1", "1.5"):
        with pytest.raises(RefusedError, match=f"has no map {choice}; found angle, ecc, 2, map 4; give one of these"):
            read_overlay(path, COUNT, map=choice)
    with pytest.raises(RefusedError, match=r"found 4 maps: angle, ecc, 2, map 4"):
        read_overlay(path, COUNT)
    assert list(read_maps(path)) == ["angle", "ecc", "2", "map 4"]


def test_the_list_of_maps_stays_short(tmp_path):
    path = maps(tmp_path / "o.func.gii", {f"t{t}": VALUES for t in range(200)})
    with pytest.raises(RefusedError, match=r"found 200 maps: t0, .*, t7 \.\.\. \(200 in all\); keep"):
        read_overlay(path, COUNT)


def test_maps_of_one_name(tmp_path):
    arrays = [gifti.GiftiDataArray(k * VALUES, meta=gifti.GiftiMetaData({"Name": "z"})) for k in (1, 2)]
    gifti.GiftiImage(darrays=arrays).to_filename(tmp_path / "o.func.gii")
    assert np.array_equal(read_overlay(tmp_path / "o.func.gii", COUNT, map="z"), VALUES, equal_nan=True)
    assert np.array_equal(read_overlay(tmp_path / "o.func.gii", COUNT, map=2), 2 * VALUES, equal_nan=True)


def test_labels_are_numbers(tmp_path):
    path = maps(tmp_path / "o.label.gii", {"areas": np.arange(COUNT, dtype=np.int32)}, "NIFTI_INTENT_LABEL")
    assert is_overlay(path)
    assert read_overlay(path, COUNT).tolist() == list(range(COUNT))


def test_columns_and_encodings(tmp_path):
    series = maps(tmp_path / "a.func.gii", {"": SEVERAL}, "NIFTI_INTENT_TIME_SERIES", encoding="GIFTI_ENCODING_B64GZ")
    assert np.array_equal(read_overlay(series, COUNT, channels=True), SEVERAL, equal_nan=True)
    column = maps(tmp_path / "b.func.gii", {"": VALUES[:, None]}, encoding="GIFTI_ENCODING_ASCII", endian="big")
    assert np.allclose(read_overlay(column, COUNT), VALUES, equal_nan=True, atol=1e-5)


def test_values_of_some_vertices_only(tmp_path):
    def write(nodes):
        arrays = [
            gifti.GiftiDataArray(np.array(nodes, np.int32), "NIFTI_INTENT_NODE_INDEX"),
            gifti.GiftiDataArray(np.array([1.5, 2.5, 3.5], np.float32), "NIFTI_INTENT_NONE"),
        ]
        gifti.GiftiImage(darrays=arrays).to_filename(tmp_path / "o.func.gii")
        return tmp_path / "o.func.gii"

    assert read_maps(write([7, 0, 29]))["map 1"].shape == (30,)
    values = read_overlay(write([7, 0, 29]), COUNT)
    assert values[[7, 0, 29]].tolist() == [1.5, 2.5, 3.5]
    assert np.isnan(values).sum() == COUNT - 3
    for nodes in ([7, 0, 30], [7, 0]):
        with pytest.raises(RefusedError, match=r"3 values for a list of . vertices.*below 30"):
            read_overlay(write(nodes), COUNT)


def test_a_surface_is_no_data(tmp_path):
    write_mesh(tmp_path / "m.surf.gii", Mesh(np.eye(3), np.array([[0, 1, 2]], np.int32)))
    with pytest.raises(RefusedError, match=r"expected values at vertices; found a surface; give it in the level set"):
        read_overlay(tmp_path / "m.surf.gii", 3)
    assert not is_overlay(tmp_path / "m.surf.gii")
    bare = maps(tmp_path / "o.gii", {"a": VALUES})
    assert (is_overlay(bare), is_surface(bare)) == (True, False)
    (tmp_path / "m.surf.gii").rename(tmp_path / "m.gii")
    assert (is_overlay(tmp_path / "m.gii"), is_surface(tmp_path / "m.gii")) == (False, True)


# --- rows of voxels -----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".nii", ".nii.gz", ".mgz"])
@pytest.mark.parametrize("shape", [(COUNT, 1, 1), (1, COUNT, 1), (1, 1, COUNT), (15, 1, 2), (15, 2, 1)])
def test_rows_of_voxels(tmp_path, suffix, shape):
    path = tmp_path / f"o{suffix}"
    image = nib.MGHImage if suffix == ".mgz" else nib.Nifti1Image
    image(VALUES.reshape(shape, order="F"), np.eye(4)).to_filename(path)
    assert np.array_equal(read_overlay(path, COUNT), VALUES, equal_nan=True)
    assert is_overlay(path, COUNT)
    assert is_overlay(path) == (COUNT in shape)

    image(SEVERAL.reshape((*shape, 3), order="F"), np.eye(4)).to_filename(path)
    assert np.array_equal(read_overlay(path, COUNT, channels=True), SEVERAL, equal_nan=True)
    assert np.array_equal(read_overlay(path, COUNT, map="frame 3"), SEVERAL[:, 2], equal_nan=True)


def test_scaled_integers(tmp_path):
    image = nib.Nifti1Image(np.arange(COUNT, dtype=np.int16).reshape(COUNT, 1, 1), np.eye(4))
    image.header.set_slope_inter(0.5, 3)
    image.to_filename(tmp_path / "o.nii")
    assert read_overlay(tmp_path / "o.nii", COUNT).tolist() == (3 + 0.5 * np.arange(COUNT)).tolist()


def test_a_volume_is_no_row(tmp_path):
    path = tmp_path / "v.nii.gz"
    nib.Nifti1Image(np.zeros((4, 5, 6), np.float32), np.eye(4)).to_filename(path)
    assert not is_overlay(path)
    with pytest.raises(RefusedError, match=r"a row of 30 values.*a volume of 4 x 5 x 6 voxels.*beltrami sample"):
        read_overlay(path, COUNT)
    # And a row is no volume.
    nib.Nifti1Image(np.zeros((COUNT, 1, 1), np.float32), np.eye(4)).to_filename(path)
    with pytest.raises(RefusedError, match=r"that surface in the level set's place"):
        read_volume(path)


def test_complex_rows(tmp_path):
    nib.Nifti1Image(np.zeros((COUNT, 1, 1), np.complex64), np.eye(4)).to_filename(tmp_path / "o.nii")
    with pytest.raises(RefusedError, match=r"expected real values; found complex ones"):
        read_overlay(tmp_path / "o.nii", COUNT)


# --- what does not fit --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ONE_MAP)
def test_another_number_of_vertices(tmp_path, name):
    write_overlay(tmp_path / name, VALUES)
    with pytest.raises(RefusedError, match=r"30 values for 642 vertices; expected one value for each vertex"):
        read_overlay(tmp_path / name, 642)


@pytest.mark.parametrize("name", ONE_MAP)
def test_files_cut_short(tmp_path, name):
    path = tmp_path / name
    write_overlay(path, VALUES)
    whole = path.read_bytes()
    for length in (len(whole) // 2, 10):
        path.write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"complete file") as caught:
            read_overlay(path, COUNT)
        assert "\n" not in str(caught.value)
    path.unlink()
    with pytest.raises(RefusedError, match=r"no such file"):
        read_overlay(path, COUNT)


def test_freesurfers_old_format(tmp_path):
    path = tmp_path / "lh.thickness"
    path.write_bytes(COUNT.to_bytes(3, "big") + (56).to_bytes(3, "big") + np.arange(COUNT, dtype=">i2").tobytes())
    assert is_overlay(path)
    with pytest.raises(RefusedError, match=r"FreeSurfer's format before 2002.*convert"):
        read_overlay(path, COUNT)


def test_several_values_in_freesurfers_format(tmp_path):
    path = tmp_path / "lh.o"
    write_overlay(path, VALUES)
    content = bytearray(path.read_bytes())
    content[14] = 2
    path.write_bytes(content)
    with pytest.raises(RefusedError, match=r"one value per vertex; found 2"):
        read_overlay(path, COUNT)


def test_the_real_ones(shared_data):
    path = shared_data / "retino_fsaverage" / "lh.crop.func.gii"
    angle = read_overlay(path, 22311, map="angle_clean")
    assert np.isnan(angle).sum() == 4979
    assert np.nanmax(angle) == pytest.approx(359.991, abs=1e-3)
    row = shared_data / "odd_real" / "surface_data_as_nifti_163842x1x1.nii.gz"
    assert is_overlay(row)
    assert read_overlay(row, 163842).shape == (163842,)
    cifti = shared_data / "odd_real" / "cifti2_not_a_volume.dconn.nii"
    assert is_overlay(cifti)
    with pytest.raises(RefusedError, match=r"CIFTI.*wb_command -cifti-separate"):
        read_overlay(cifti, 10)
