"""info: what a volume, a surface or vertex data holds, in words."""

from __future__ import annotations

from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from command import ball, beltrami, done, nifti, noisy, npy, refused


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path]:
    """A level set and a volume of noise."""
    return nifti(tmp_path / "psi.nii.gz", ball()), nifti(tmp_path / "a.nii.gz", noisy())


def test_info(pair, tmp_path):
    levelset, a = pair
    affine = np.diag([-0.8, 1.0, 1.5, 1.0])
    affine[:3, 3] = 10, -20, 30
    holes = noisy((6, 7, 8))
    holes[0, 0, 0], holes[1, 0, 0] = np.nan, np.inf
    placed = nifti(tmp_path / "placed.nii", holes, affine)
    mask = npy(tmp_path / "mask.npy", (ball((9, 9), 3.0) < 0).astype(np.uint8))
    first, second, third, fourth = done("info", levelset, a, placed, mask).out.split(f"\n{tmp_path}")
    assert "16 x 16 x 16 voxels of 1 x 1 x 1 mm, axes towards RAS" in first
    assert "zero level within voxels 2..13 x 2..13 x 2..13" in first
    assert f"{100 * (ball() < 0).mean():.1f} % of the values are negative" in first
    assert "no zero level" in second
    assert "6 x 7 x 8 voxels of 0.8 x 1 x 1.5 mm, axes towards LAS" in third
    assert "first voxel at RAS 10, -20, 30 mm" in third
    assert "334 finite, 1 NaN, 1 infinite" in third
    assert "NPY, 9 x 9 voxels" in fourth
    assert "a mask of 0 and 1: a segmentation" in fourth


def test_info_tells_labels(tmp_path):
    rim = nifti(tmp_path / "rim.nii.gz", (np.clip(ball() + 2, 0, 3)).astype(np.uint8))
    assert "as a level set: 4 whole numbers (0, 1, 2, 3): a segmentation" in done("info", rim).out
    epi = nifti(tmp_path / "epi.nii.gz", noisy(mean=500).astype(np.int16))
    assert " ...): a segmentation" in done("info", epi).out


def test_info_goes_on_after_a_bad_file(pair, tmp_path):
    levelset, a = pair
    run = beltrami("info", levelset, tmp_path / "nothing.nii", a)
    assert run.code == 2
    assert "no such file" in run.message
    assert str(levelset) in run.out
    assert str(a) in run.out
    assert done("info", levelset, "-q").out == ""
    assert "FILE" in refused("info")


# --- several channels, complex numbers ---------------------------------------------------------------------------


def test_info_tells_channels_and_complex_numbers(tmp_path):
    frames = nifti(tmp_path / "f.nii.gz", np.stack([noisy(), noisy()], -1))
    waves = npy(tmp_path / "c.npy", np.full((4, 5, 6), 3 + 4j))
    out = done("info", frames, waves).out
    assert "16 x 16 x 16 voxels" in out
    assert "2 channels or frames" in out
    assert "complex numbers" in out
    assert "magnitude: 5 to 5, median 5" in out
    assert "level set" not in out


# --- surfaces, vertex data, doubts -------------------------------------------------------------------------------


def sheet(n: int = 5, step: float = 2.0) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (n^2, 3) and triangles of a square of 2 (n - 1)^2 triangles at z = 3 mm."""
    i, j = np.indices((n, n)).reshape(2, -1)
    a = (i * n + j).reshape(n, n)[:-1, :-1].ravel()
    cells = np.concatenate([np.stack([a, a + n, a + 1], 1), np.stack([a + 1, a + n, a + n + 1], 1)])
    return np.stack([step * i, step * j - 10, 0 * i + 3.0], -1), cells.astype(np.int32)


def gifti(path: Path, *arrays: tuple[np.ndarray, str], **names: str) -> Path:
    parts = [nib.gifti.GiftiDataArray(data, f"NIFTI_INTENT_{intent}") for data, intent in arrays]
    for part, name in zip(parts, names.values(), strict=False):
        part.meta["Name"] = name
    nib.save(nib.gifti.GiftiImage(darrays=parts), path)
    return path


def surface(path: Path, points: np.ndarray, cells: np.ndarray) -> Path:
    return gifti(path, (points.astype(np.float32), "POINTSET"), (cells, "TRIANGLE"))


def test_info_on_surfaces(tmp_path):
    points, cells = sheet()
    opened = surface(tmp_path / "rh.mid.surf.gii", points, cells)
    out = done("info", opened).out.splitlines()
    assert out == [
        str(opened),
        "  GIFTI surface, 25 vertices, 32 triangles, edges of 2 mm (median)",
        "  within 0..8 x -10..-2 x 3..3 mm (RAS); coordinates: scanner RAS",
        "  open: 16 border edges",
        "  structure: CortexRight",
    ]
    corners = np.array([[0, 0, 0], [3, 0, 0], [0, 3, 0], [0, 0, 3], [9, 9, 9.0]])
    closed = surface(tmp_path / "t.surf.gii", corners, np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.int32))
    out = done("info", closed).out
    assert "closed: no border edges" in out and "structure: not told" in out
    assert "1 vertex of no triangle" in out
    assert "in doubt: a surface of less than 1 mm" not in out
    small = surface(tmp_path / "m.surf.gii", corners[:3] / 1000, np.array([[0, 2, 1]], np.int32))
    out = done("info", small).out
    assert "5 vertices" not in out and "3 vertices, 1 triangle, edges" in out
    assert "in doubt: a surface of less than 1 mm; expected coordinates in mm: are they in metres?" in out
    fin = np.array([[0, 2, 1], [0, 1, 3], [1, 0, 4]], np.int32)
    assert "1 edge shared by more than two triangles" in done("info", surface(tmp_path / "f.gii", corners, fin)).out


def test_info_tells_the_space_of_a_surface(tmp_path):
    points, cells = sheet()
    volume = {
        "head": [2, 0, 20], "valid": "1  # volume info valid", "filename": "../mri/filled-pretess255.mgz",
        "volume": np.array([256, 256, 256]), "voxelsize": np.array([1.0, 1, 1]), "xras": np.array([-1.0, 0, 0]),
        "yras": np.array([0.0, 0, -1]), "zras": np.array([0.0, 1, 0]), "cras": np.array([5.0, -17, 19]),
    }  # fmt: skip
    known, unknown = tmp_path / "lh.white", tmp_path / "lh.pial"
    nib.freesurfer.write_geometry(known, points, cells, create_stamp="", volume_info=volume)
    nib.freesurfer.write_geometry(unknown, points, cells, create_stamp="")
    out = done("info", known).out
    assert "FreeSurfer surface" in out and "structure: CortexLeft" in out
    assert "within 5..13 x -27..-19 x 22..22 mm (RAS); coordinates: FreeSurfer's surface RAS (tkr), carried" in out
    out = done("info", unknown).out
    assert "within 0..8 x -10..-2 x 3..3 mm (RAS); coordinates: as stored, of a space that the file does not" in out


def test_info_on_vertex_data(tmp_path):
    values = np.arange(25, dtype=np.float32)
    holes = values.copy()
    holes[:5], holes[5] = np.nan, np.inf
    metric = gifti(tmp_path / "m.func.gii", (values, "SHAPE"), (holes, "SHAPE"), a="angle", b="depth")
    assert done("info", metric).out.splitlines() == [
        str(metric),
        "  GIFTI vertex data, 25 vertices, 2 maps",
        "  structure: not told",
        "  angle: range 0 to 24, median 12, 0 NaN, 0 infinite",
        "  depth: range 6 to 24, median 15, 5 NaN, 1 infinite",
    ]
    nib.freesurfer.write_morph_data(tmp_path / "lh.thickness", values)
    nothing = np.full((25, 1, 1), np.nan, np.float32)
    nib.save(nib.MGHImage(nothing, None), tmp_path / "e.mgz")
    out = done("info", tmp_path / "lh.thickness", tmp_path / "e.mgz").out
    assert "FreeSurfer vertex data, 25 vertices, 1 map\n  structure: CortexLeft\n  map 1: range 0 to 24" in out
    assert (
        "MGH vertex data, 25 vertices, 1 map\n  structure: not told\n  frame 1: no finite value, 25 NaN, 0 infinite"
        in out
    )
    series = gifti(tmp_path / "s.func.gii", *[(values, "TIME_SERIES")] * 30)
    assert done("info", series).out.splitlines()[-1] == "  ... and 18 more"
    assert len(done("info", series).out.splitlines()) == 16
    some = gifti(tmp_path / "p.func.gii", (np.array([3, 17], np.int32), "NODE_INDEX"), (values[:2], "SHAPE"))
    assert "range 0 to 1, median 0.5, 16 NaN" in done("info", some).out


def test_info_goes_on_after_a_bad_surface(tmp_path):
    broken = tmp_path / "b.surf.gii"
    broken.write_text("<GIFTI NIFTI_INTENT_POINTSET")
    fine = surface(tmp_path / "t.surf.gii", *sheet())
    run = beltrami("info", broken, tmp_path / "no.func.gii", tmp_path / "no.ply", fine)
    assert run.code == 2 and len(run.err.splitlines()) == 3
    assert "cannot be read as GIFTI" in run.err and run.err.count("no such file") == 2
    assert str(fine) in run.out


def test_info_tells_what_a_header_leaves_in_doubt(tmp_path):
    path = nifti(tmp_path / "v.nii", noisy((6, 7, 8)))
    content = bytearray(path.read_bytes())
    content[252:256] = b"\0\0\0\0"  # qform_code, sform_code
    path.write_bytes(content)
    assert "  in doubt: sform and qform are both unset" in done("info", path).out
