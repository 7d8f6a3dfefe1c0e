"""compare: figures and verdicts that scripts rely on, of files and of folders."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
from command import Run, ball, beltrami, contents, done, nifti, noisy, npy, refused

from beltrami_cli import comparison, formats
from beltrami_cli.errors import RefusedError
from beltrami_cli.surface import Mesh


@pytest.fixture
def pair(tmp_path: Path) -> tuple[Path, Path, Path]:
    """LEVELSET, A, and B: A and 2 more within 3 voxels of the surface, 9 more elsewhere."""
    far = np.abs(ball()) > 3
    return (
        nifti(tmp_path / "psi.nii.gz", ball()),
        nifti(tmp_path / "a.nii.gz", noisy()),
        nifti(tmp_path / "b.nii.gz", noisy() + np.where(far, 9, 2).astype(np.float32)),
    )


def figures(*arguments: object) -> dict[str, float]:
    return json.loads(beltrami("compare", *arguments, "--json").out)


def test_equal_files(pair):
    _, a, _ = pair
    run = done("compare", a, a, "--max-abs", "0", "--max-rms", "0", "--min-psnr", "200")
    assert "max 0, rms 0, mean 0" in run.out
    found = figures(a, a)
    assert (found["compared"], found["max_abs"], found["psnr"], found["broken"]) == (4096, 0.0, None, [])


def test_figures(pair):
    _, a, b = pair
    near = (np.abs(ball()) <= 3).mean()
    found = figures(a, b)
    assert found["max_abs"] == pytest.approx(9, abs=1e-5)
    assert found["mean"] == pytest.approx(2 * near + 9 * (1 - near), abs=1e-5)
    assert found["rms"] == pytest.approx(np.sqrt(4 * near + 81 * (1 - near)), abs=1e-5)
    assert found["data_range"] == pytest.approx(np.ptp(noisy()))
    assert found["psnr"] == pytest.approx(20 * np.log10(np.ptp(noisy()) / found["rms"]))


@pytest.mark.parametrize(
    "tolerance, code",
    [
        (["--max-abs", "8.9"], 1),
        (["--max-abs", "9.1"], 0),
        (["--max-rms", "1"], 1),
        (["--max-rms", "9"], 0),
        (["--min-psnr", "60"], 1),
        (["--min-psnr", "60", "--data-range", "100000"], 0),
        (["--max-abs", "1", "--max-rms", "9"], 1),
    ],
)
def test_tolerances(pair, tolerance, code):
    _, a, b = pair
    run = beltrami("compare", a, b, *tolerance)
    assert run.code == code
    assert run.err.count("out of tolerance") == code
    quiet = beltrami("compare", a, b, *tolerance, "-q")
    assert (quiet.code, quiet.out) == (code, "")


@pytest.mark.parametrize("within", [0.3, 0.5, 1.0, 2.0, 2.9])
def test_near_the_surface_only(pair, within):
    levelset, a, b = pair
    found = figures(a, b, "--levelset", levelset, "--within", within)
    assert found["compared"] == (np.abs(ball()) <= within).sum()
    assert found["max_abs"] == pytest.approx(2, abs=1e-5)
    assert figures(a, b, "--levelset", levelset)["compared"] == (np.abs(ball()) <= 0.5).sum()


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_near_a_curve_in_a_slice(tmp_path, axis):
    plane, values = ball((30, 24), 8.0), noisy((30, 24))
    levelset, a = (
        nifti(tmp_path / f"{name}.nii.gz", np.expand_dims(array, axis))
        for name, array in (("psi", plane), ("a", values))
    )
    assert figures(a, a, "--levelset", levelset, "--within", "1.5")["compared"] == (np.abs(plane) <= 1.5).sum()
    assert figures(a, a, "--levelset", levelset)["compared"] == (np.abs(plane) <= 0.5).sum()


def test_near_a_mask(pair, tmp_path):
    _, a, b = pair
    mask = nifti(tmp_path / "mask.nii.gz", (ball() < 0).astype(np.uint8))
    compared = figures(a, b, "--levelset", mask, "--within", "1")["compared"]
    assert compared == pytest.approx((np.abs(ball()) <= 1).sum(), rel=0.2)


def test_angles_wrap(tmp_path):
    a, b = npy(tmp_path / "a.npy", np.full((8, 8), 359.0)), npy(tmp_path / "b.npy", np.full((8, 8), 1.0))
    assert figures(a, b)["mean"] == -358
    assert figures(a, b, "--period", "360")["mean"] == 2
    assert beltrami("compare", a, b, "--period", "360", "--max-abs", "2").code == 0


def test_missing_values_are_counted(tmp_path):
    values = noisy((8, 8))
    fewer, others = values.copy(), values.copy()
    fewer[0], others[:, 0] = np.nan, np.nan
    found = figures(npy(tmp_path / "a.npy", fewer), npy(tmp_path / "b.npy", others))
    assert (found["compared"], found["only_in_a"], found["only_in_b"]) == (49, 7, 7)


def test_compare_refuses(pair, tmp_path):
    levelset, a, b = pair
    before = contents(tmp_path)
    assert "--levelset" in refused("compare", a, b, "--within", "1")
    assert "above 0" in refused("compare", a, b, "--levelset", levelset, "--within", "0")
    assert "above 0" in refused("compare", a, b, "--period", "0")
    assert "no such file" in refused("compare", a, tmp_path / "nothing.nii.gz")
    assert "no zero level" in refused("compare", a, b, "--levelset", a, code=1)
    assert contents(tmp_path) == before
    narrow = nifti(tmp_path / "narrow.nii.gz", noisy((15, 16, 16)))
    run = beltrami("compare", a, narrow)
    assert (run.code, len(run.err.splitlines())) == (2, 3)
    assert "grids differ" in refused("compare", a, b, "--levelset", narrow)
    nothing = nifti(tmp_path / "nan.nii.gz", np.full((16, 16, 16), np.nan, np.float32))
    assert "nothing to compare" in refused("compare", a, nothing, code=1)


# Several channels, complex numbers


def test_channels_are_compared_value_by_value(tmp_path):
    data = np.stack([noisy(), 2 * noisy(), 3 * noisy()], -1)
    shifted = data.copy()
    shifted[..., 1] += np.float32(2)
    shifted[0, 0, 0, 2] = np.nan
    a, b = nifti(tmp_path / "a.nii.gz", data), nifti(tmp_path / "b.nii.gz", shifted)
    found = figures(a, b)
    assert (found["compared"], found["only_in_a"]) == (data.size - 1, 1)
    assert found["rms"] == pytest.approx(2 / np.sqrt(3), rel=1e-3)
    near = figures(a, b, "--levelset", nifti(tmp_path / "psi.nii.gz", ball()), "--within", "1")
    assert near["compared"] == 3 * (np.abs(ball()) <= 1).sum()
    one = nifti(tmp_path / "one.nii.gz", noisy())
    assert f"channels or frames differ: A {a} has 3, B {one} 1" in refused("compare", a, one)


def test_complex_numbers_are_compared_by_their_parts(tmp_path):
    waves = (noisy() + 1j).astype(np.complex64)
    a, b = npy(tmp_path / "a.npy", waves), npy(tmp_path / "b.npy", waves + 3j)
    found = figures(a, b)
    assert found["compared"] == 2 * waves.size
    assert (found["max_abs"], found["mean"]) == (pytest.approx(3), pytest.approx(1.5))
    real = npy(tmp_path / "real.npy", noisy())
    assert f"A {a} is complex, B {real} is real" in refused("compare", a, real)
    assert f"A {real} is real, B {a} is complex" in refused("compare", real, a)


# Values at vertices


def metric(path: Path, *maps: np.ndarray) -> Path:
    formats.write_overlay(path, np.stack(maps, -1) if len(maps) > 1 else maps[0])
    return path


@pytest.mark.parametrize("name", ["m.func.gii", "m.shape.gii", "m.mgz", "lh.m"])
def test_metrics(tmp_path, name):
    values = noisy((25,))
    shifted = values + np.float32(2)
    shifted[:5] = np.nan
    a, b = metric(tmp_path / name, values), metric(tmp_path / f"lh.b{name.removeprefix('lh')}", shifted)
    found = figures(a, b)
    assert (found["compared"], found["only_in_a"], found["only_in_b"]) == (20, 5, 0)
    assert (found["max_abs"], found["mean"]) == (pytest.approx(2, abs=1e-5), pytest.approx(2, abs=1e-5))
    assert "distance" not in found


def test_every_map_is_compared_by_its_order(tmp_path):
    one, two = np.full(25, 359, np.float32), np.full(25, 10, np.float32)
    a = metric(tmp_path / "a.func.gii", one, two)
    b = metric(tmp_path / "b.mgz", one - 357, two)  # 2
    assert figures(a, b)["rms"] == pytest.approx(357 / np.sqrt(2))
    found = figures(a, b, "--period", "360")
    assert (found["compared"], found["max_abs"], found["mean"]) == (50, pytest.approx(3), pytest.approx(1.5))


def test_metrics_of_other_sizes_are_refused(tmp_path):
    a = metric(tmp_path / "a.func.gii", noisy((25,)))
    fewer, more = metric(tmp_path / "b.func.gii", noisy((24,))), metric(tmp_path / "c.mgz", noisy((25,)), noisy((25,)))
    assert "hold 1 x 25 and 1 x 24 maps x values" in refused("compare", a, fewer)
    assert "hold 1 x 25 and 2 x 25 maps x values" in refused("compare", a, more)
    nothing = metric(tmp_path / "n.func.gii", np.full(25, np.nan, np.float32))
    assert "nothing to compare" in refused("compare", a, nothing, code=1)


# Meshes


def sheet(n: int = 6, values: np.ndarray | None = None, at: float = 0.0, other_diagonal: bool = False) -> Mesh:
    """n x n vertices 2 mm apart at the height `at`."""
    i, j = np.indices((n, n)).reshape(2, -1)
    a = (i * n + j).reshape(n, n)[:-1, :-1].ravel()
    b, c, d = a + n, a + 1, a + n + 1
    halves = [(a, b, d), (a, d, c)] if other_diagonal else [(a, b, c), (c, b, d)]
    cells = np.concatenate([np.stack(half, 1) for half in halves]).astype(np.int32)
    return Mesh(np.stack([2.0 * i, 2.0 * j, 0 * i + at], -1), cells, values)


def curve(values: np.ndarray, at: float = 0.0) -> Mesh:
    ends = np.arange(len(values) - 1, dtype=np.int32)
    x = np.arange(len(values), dtype=float)
    points = np.stack([x, 0 * x, 0 * x + at], -1)
    return Mesh(points, np.stack([ends, ends + 1], 1), values)


def mesh(path: Path, content: Mesh) -> Path:
    formats.write_mesh(path, content)
    return path


VALUES = noisy((36,))


@pytest.mark.parametrize("suffix", [".ply", ".vtk"])
@pytest.mark.parametrize("make", [lambda values, at: sheet(6, values, at), curve], ids=["surface", "curve"])
def test_meshes_that_hold_values(tmp_path, suffix, make):
    holes = VALUES + np.float32(3)
    holes[:2] = np.nan
    a, b = mesh(tmp_path / f"a{suffix}", make(VALUES, 0.0)), mesh(tmp_path / f"b{suffix}", make(holes, 0.5))
    found = figures(a, b)
    assert (found["compared"], found["only_in_a"]) == (34, 2)
    assert (found["max_abs"], found["mean"]) == (pytest.approx(3, abs=1e-5), pytest.approx(3, abs=1e-5))
    assert found["distance"] == {"max_mm": 0.5, "rms_mm": 0.5, "same_triangles": True}
    out = done("compare", a, b).out
    assert out.startswith("geometry  vertices moved: max 0.5 mm, rms 0.5 mm\ncompared  34 values (2 only in A, 0")
    assert beltrami("compare", a, b, "--max-abs", "3.1", "--max-distance", "0.5").code == 0
    assert "vertices moved by up to 0.5 mm, over 0.001 mm" in beltrami("compare", a, b, "--max-abs", "3.1").err
    assert beltrami("compare", a, b, "--max-abs", "2.9", "--max-distance", "0.5").code == 1
    assert beltrami("compare", a, b, "--max-distance", "0.5").code == 0


def test_channels_at_vertices(tmp_path):
    several = np.stack([VALUES, 2 * VALUES], -1)
    a, b = mesh(tmp_path / "a.ply", sheet(6, several)), mesh(tmp_path / "b.vtk", sheet(6, several + np.array([0, 2])))
    found = figures(a, b)
    assert (found["compared"], found["mean"]) == (72, pytest.approx(1, abs=1e-5))
    one = mesh(tmp_path / "one.ply", sheet(6, VALUES))
    assert figures(a, one)["values_not_compared"] == "A holds value_1, value_2, B value"


@pytest.mark.parametrize("suffix", [".surf.gii", ".obj", ".stl", ".ply", ".vtk"])
def test_geometry_alone(tmp_path, suffix):
    a, b = mesh(tmp_path / f"a{suffix}", sheet()), mesh(tmp_path / f"b{suffix}", sheet(at=0.002))
    assert figures(a, b) == {
        "distance": {"max_mm": pytest.approx(0.002), "rms_mm": pytest.approx(0.002), "same_triangles": True},
        "broken": [],
    }
    assert "values    neither has any" in done("compare", a, b).out
    done("compare", a, a, "--max-abs", "0")
    assert beltrami("compare", a, b, "--max-abs", "0").code == 1
    assert beltrami("compare", a, b, "--max-distance", "0.003").code == 0


def test_other_triangles(tmp_path):
    a = mesh(tmp_path / "a.ply", sheet(6, VALUES))
    turned = mesh(tmp_path / "b.ply", sheet(6, VALUES, other_diagonal=True))
    finer = mesh(tmp_path / "c.surf.gii", sheet(11))  # sticks out by 10 mm along both axes
    found = figures(a, turned)
    assert found["distance"] == {"max_mm": 0, "rms_mm": 0, "same_triangles": False}
    assert found["values_not_compared"] == "the triangles differ" and "compared" not in found
    run = beltrami("compare", a, turned, "--max-rms", "100")
    assert (run.code, run.message) == (1, "out of tolerance: values not compared: the triangles differ")
    assert beltrami("compare", a, turned, "--max-distance", "0").code == 0
    found = figures(a, finer)
    assert found["distance"]["max_mm"] == pytest.approx(np.hypot(10, 10))
    assert found["distance"] == figures(finer, a)["distance"]
    assert found["values_not_compared"] == "only A holds any"
    assert "other triangles, surfaces apart: max 14.1421 mm" in done("compare", a, finer).out


def test_values_of_an_ascii_file_by_another_program(tmp_path):
    lines = ["ply", "format ascii 1.0", "element vertex 3", *(f"property float {name}" for name in "xyz")]
    lines += ["property uchar red", "property float quality", "element face 1"]
    lines += ["property list uchar int vertex_indices", "end_header"]
    paths = []
    for name, red in (("a.ply", 7), ("b.ply", 9)):
        paths.append(tmp_path / name)
        paths[-1].write_text(
            "\n".join([*lines, f"0 0 0 {red} 1", f"1 0 0 {red} nan", f"0 1 0 {red} {red}", "3 0 1 2\n"])
        )
    found = figures(*paths)
    assert (found["compared"], found["max_abs"], found["distance"]["max_mm"]) == (2, 2, 0)


# What is refused


def test_files_of_two_kinds_are_refused(pair, tmp_path):
    levelset, a, _ = pair
    surface, values = mesh(tmp_path / "s.ply", sheet(6, VALUES)), metric(tmp_path / "m.func.gii", VALUES)
    assert f"A {a} is a volume, B {surface} is a mesh; expected two of one kind" in refused("compare", a, surface)
    assert "is a mesh, B" in refused("compare", surface, a)
    assert "is values at vertices" in refused("compare", surface, values)
    assert "--levelset is for volumes" in refused("compare", values, values, "--levelset", levelset)
    assert "--levelset is for volumes" in refused("compare", surface, surface, "--levelset", levelset, "--within", "1")
    assert "--max-distance is for meshes" in refused("compare", a, a, "--max-distance", "1")
    assert "--include is for folders" in refused("compare", a, a, "--include", "*")
    glb = mesh(tmp_path / "s.glb", sheet(6, VALUES))
    assert "s.glb: cannot be compared" in refused("compare", glb, glb)
    assert "is a folder" in refused("compare", a, tmp_path)
    assert "is a folder" in refused("compare", tmp_path, a)
    assert "nothing: no such file or folder" in refused("compare", tmp_path, tmp_path / "nothing")
    assert "max-abs: found -1; expected 0 or more" in refused("compare", a, a, "--max-abs", "-1")


@pytest.mark.parametrize("name", ["s.ply", "s.vtk", "s.surf.gii", "c.ply", "c.vtk"])
def test_files_cut_short(tmp_path, name):
    whole = mesh(tmp_path / name, curve(VALUES) if name[0] == "c" else sheet(6, VALUES))
    cut = tmp_path / f"cut_{name}"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 2 // 3])
    assert f"cut_{name}" in refused("compare", whole, cut, code=1)


def test_a_curve_of_vertices_that_are_not_there(tmp_path):
    path = mesh(tmp_path / "c.ply", curve(VALUES))
    path.write_bytes(path.read_bytes()[:-4] + (99).to_bytes(4, "little"))
    assert "not there" in refused("compare", path, path, code=1)


def test_missing_values_are_judged_where_it_is_asked(tmp_path):
    values = noisy((8, 8))
    fewer, others = values.copy(), values.copy()
    fewer[0], others[:, 0] = np.nan, np.nan
    a, b = npy(tmp_path / "a.npy", fewer), npy(tmp_path / "b.npy", others)
    run = beltrami("compare", a, b, "--max-abs", "0")
    assert run.code == 0 and "warning: 7 values of A are missing in B" in run.message
    done("compare", a, b, "--max-abs", "0", "--max-missing", "14")
    run = beltrami("compare", a, b, "--max-missing", "13")
    assert (run.code, run.message) == (1, "out of tolerance: 14 values are in only one (7 in A, 7 in B), over 13")


def test_infinite_values_are_judged_as_missing_ones(tmp_path):
    values = noisy((8, 8))
    other = values.copy()
    values[0, 0], other[0, 0] = np.inf, -np.inf
    a, b = npy(tmp_path / "a.npy", values), npy(tmp_path / "b.npy", other)
    done("compare", a, a, "--max-abs", "0", "--max-missing", "0")
    run = beltrami("compare", a, b, "--max-abs", "0", "--max-missing", "0")
    assert (run.code, run.message) == (1, "out of tolerance: 1 values are in only one (1 in A, 0 in B), over 0")


def test_meshes_without_any_value_have_places(tmp_path):
    nothing = np.full(36, np.nan, np.float32)
    a, b = mesh(tmp_path / "a.ply", sheet(6, nothing)), mesh(tmp_path / "b.ply", sheet(6, nothing, at=2.0))
    assert "values    neither has any" in done("compare", a, b).out
    assert beltrami("compare", a, a, "--max-abs", "0").code == 0
    assert "vertices moved by up to 2 mm" in beltrami("compare", a, b, "--max-abs", "0").err
    assert "nothing to compare" in refused("compare", a, mesh(tmp_path / "c.ply", sheet(6, VALUES)), code=1)


# Folders


@pytest.fixture
def folders(tmp_path: Path) -> tuple[Path, Path]:
    """Two folders of the same small volumes, meshes, vertex data and other files."""
    a, b = tmp_path / "A", tmp_path / "B"
    (a / "sub-01" / ".hidden").mkdir(parents=True)
    nifti(a / "angle.nii.gz", noisy((6, 6, 6)))
    nifti(a / "sub-01" / "angle.nii.gz", noisy((6, 6, 6)))
    npy(a / "sub-01" / "map.npy", noisy((6, 6)))
    mesh(a / "sub-01" / "map.ply", sheet(6, VALUES))
    mesh(a / "sub-01" / "map.surf.gii", sheet(6, VALUES))  # and .func.gii
    mesh(a / "sub-01" / "map.glb", sheet())
    (a / "sub-01" / "map.json").write_text("{}")
    (a / "sub-01" / ".DS_Store").write_text("")
    npy(a / "sub-01" / ".hidden" / "map.npy", noisy((6, 6)))
    shutil.copytree(a, b)
    return a, b


NAMES = ["angle.nii.gz", *(f"sub-01/{name}" for name in ("angle.nii.gz", *(f"map.{s}" for s in ("func.gii", "npy"))))]
NAMES += ["sub-01/map.ply", "sub-01/map.surf.gii"]


def of_folders(*arguments: object) -> tuple[Run, dict]:
    run = beltrami("compare", *arguments, "--json")
    return run, json.loads(run.out)


def test_equal_folders(folders):
    run, found = of_folders(*folders, "--max-abs", "0", "--max-missing", "0")
    assert (run.code, run.err, list(found["files"])) == (0, "", NAMES)
    assert all(entry["broken"] == [] for entry in found["files"].values())
    assert (found["only_in_a"], found["only_in_b"], found["not_compared"], found["broken"]) == ([], [], 2, False)
    assert found["files"]["sub-01/map.npy"] == figures(*(folder / "sub-01" / "map.npy" for folder in folders))
    assert found["files"]["sub-01/map.ply"]["distance"]["max_mm"] == 0


def test_table_of_folders(folders):
    a, b = folders
    npy(b / "sub-01" / "map.npy", noisy((6, 6)) + np.float32(2))
    head, *rows, others, unjudged = done("compare", a, b).out.splitlines()
    assert head.split() == ["file", "compared", "max", "rms", "psnr", "mm", "verdict"]
    assert [row.split()[0] for row in rows] == NAMES
    assert {row.index("not judged") for row in rows} == {head.index("verdict")}
    assert rows[3].split()[1:4] == ["36", "2", "2"] and rows[4].split()[1:6] == ["36", "0", "0", "inf", "0"]
    assert rows[5].split()[1:6] == ["-", "-", "-", "-", "0"]
    assert others.endswith("not looked at (no volumes, meshes or values at vertices): 2")
    assert unjudged == "no tolerance is given: nothing was judged"
    run = beltrami("compare", a, b, "--max-abs", "1")
    assert run.code == 1 and run.message == "6 pairs: 1 out of tolerance, 0 failed; 0 only in A, 0 only in B"
    verdicts = [row[head.index("verdict") :] for row in run.out.splitlines()[1:-1]]
    assert verdicts == ["ok", "ok", "ok", "out of tolerance: largest difference 2 is over 1", "ok", "ok"]
    only = beltrami("compare", a, b, "--max-distance", "1").out.splitlines()
    assert [row.split()[-1] for row in only[1:-1]] == ["judged"] * 4 + ["ok"] * 2


def test_what_one_folder_lacks_is_a_failure(folders):
    a, b = folders
    (b / "angle.nii.gz").unlink()
    (a / "sub-01" / "map.ply").unlink()
    run, found = of_folders(a, b)
    assert (run.code, found["only_in_a"], found["only_in_b"]) == (1, ["angle.nii.gz"], ["sub-01/map.ply"])
    assert found["broken"] is True and len(found["files"]) == 4
    out = beltrami("compare", a, b).out
    assert "\nonly in A: angle.nii.gz\nonly in B: sub-01/map.ply\n" in out
    quiet = beltrami("compare", a, b, "-q")
    assert (quiet.code, quiet.out) == (1, "") and "only in A: angle.nii.gz" in quiet.err


def test_a_pair_that_fails_does_not_stop_the_others(folders):
    a, b = folders
    nifti(b / "angle.nii.gz", noisy((6, 6, 7)))
    (b / "sub-01" / "map.npy").write_bytes(b"\x93NUMPY")
    (b / "sub-01" / "map.ply").unlink()
    (b / "sub-01" / "map.ply").symlink_to("nowhere.ply")
    npy(a / "nothing.npy", noisy((4, 4)))
    npy(b / "nothing.npy", np.full((4, 4), np.nan))
    run, found = of_folders(a, b, "--max-abs", "0")
    errors = {name: entry["error"] for name, entry in found["files"].items() if "error" in entry}
    assert run.code == 1 and len(found["files"]) == 7 and found["broken"] is True
    assert list(errors) == ["angle.nii.gz", "nothing.npy", "sub-01/map.npy", "sub-01/map.ply"]
    assert "grids differ" in errors["angle.nii.gz"] and "nothing to compare" in errors["nothing.npy"]
    assert "cannot be read" in errors["sub-01/map.npy"] and "a link to a file" in errors["sub-01/map.ply"]
    assert not any("\n" in error for error in errors.values())
    run = beltrami("compare", a, b, "-q")
    assert run.out == "" and len(run.err.splitlines()) == 5 and "angle.nii.gz: failed: grids differ" in run.err


def test_a_pair_without_any_value_is_no_failure(folders):
    for folder in folders:
        npy(folder / "empty.npy", np.full((4, 4), np.nan))
        metric(folder / "lh.empty.func.gii", np.full(25, np.nan, np.float32))
    names = ["--include", "*empty*"]
    run, found = of_folders(*folders, "--max-abs", "0", "--max-missing", "0", *names)
    assert (run.code, found["broken"]) == (0, False)
    assert found["files"] == {"empty.npy": {"broken": []}, "lh.empty.func.gii": {"broken": []}}
    _, *rows = done("compare", *folders, "--max-abs", "0", *names).out.splitlines()
    assert [row.split()[1:] for row in rows] == [["-"] * 5 + ["ok"]] * 2
    assert done("compare", *folders, *names).out.count("not judged") == 2
    empty = folders[0] / "empty.npy"
    assert "nothing to compare" in refused("compare", empty, empty, code=1)


def test_scales_that_mean_nothing_are_refused_before_the_first_pair(folders):
    assert "data range of the comparison: found -1" in refused("compare", *folders, "--data-range", "-1")
    assert "period" in refused("compare", *folders, "--period", "-360")
    with pytest.raises(RefusedError, match="period of the comparison: found 0"):
        comparison.Terms(period=0)


def test_a_defect_costs_one_file(folders, monkeypatch):
    def broken(a: Path, b: Path, terms: comparison.Terms) -> comparison.Comparison:
        raise (MemoryError if a.name == "map.ply" else ZeroDivisionError)("some\nwords")

    monkeypatch.setattr(comparison, "compare_files", broken)
    run, found = of_folders(*folders, "--include", "map.[pn]*")
    assert run.code == 1
    assert [entry["error"][:40] for entry in found["files"].values()] == [
        "unexpected ZeroDivisionError: some words",
        "out of memory",
    ]


def test_nothing_in_common_is_an_error(folders, tmp_path):
    a, _ = folders
    (tmp_path / "empty").mkdir()
    for pair in ((a, tmp_path / "empty"), (tmp_path / "empty", tmp_path / "empty")):
        run, found = of_folders(*pair)
        assert run.code == 1 and "nothing to compare" in run.message
        assert (found["files"], found["broken"]) == ({}, True)
    run, found = of_folders(a, a, "--include", "*.tif")
    assert run.code == 1 and "no file is like --include *.tif" in run.err and found["not_compared"] == 0
    run, found = of_folders(a, a, "--include", "*.json")
    assert run.code == 1 and found["not_compared"] == 1


def test_patterns(folders):
    def names(*patterns: str) -> list[str]:
        return list(of_folders(*folders, *(word for p in patterns for word in ("--include", p)))[1]["files"])

    assert names("*angle*") == ["angle.nii.gz", "sub-01/angle.nii.gz"]
    assert names("sub-*/angle*") == ["sub-01/angle.nii.gz"]
    assert names("*.ply", "*.npy") == ["sub-01/map.npy", "sub-01/map.ply"]
    run, found = of_folders(*folders, "--include", "*.ply", "--include", "*.plyy")
    assert run.code == 0 and "like --include *.plyy" in run.message and len(found["files"]) == 1


def test_headers_and_their_voxels_are_one_file(tmp_path):
    a, b = tmp_path / "A", tmp_path / "B"
    a.mkdir()
    volume = formats.read_volume(npy(tmp_path / "v.npy", noisy((5, 6, 7))))
    formats.write_volume(a / "pair.hdr", volume)
    formats.write_volume(a / "pair.mhd", volume)
    formats.write_volume(a / "UPPER.HDR", volume)
    shutil.copytree(a, b)
    run, found = of_folders(a, b, "--max-abs", "0")
    assert (run.code, list(found["files"])) == (0, ["UPPER.HDR", "pair.hdr", "pair.mhd"])
    assert found["not_compared"] == 0
    (b / "pair.img").unlink()
    run, found = of_folders(a, b)
    assert run.code == 1 and "half of a pair" in found["files"]["pair.hdr"]["error"]


def test_pictures_in_folders_are_other_files(tmp_path):
    skimage_io = pytest.importorskip("skimage.io")
    for name in ("A", "B"):
        (tmp_path / name).mkdir()
        skimage_io.imsave(tmp_path / name / "p.png", np.eye(9, dtype=np.uint8), check_contrast=False)
        npy(tmp_path / name / "v.npy", noisy((4, 4)))
    run, found = of_folders(tmp_path / "A", tmp_path / "B")
    assert (run.code, list(found["files"]), found["not_compared"]) == (0, ["v.npy"], 1)
    assert figures(tmp_path / "A" / "p.png", tmp_path / "B" / "p.png")["compared"] == 81


def test_the_surface_to_be_near_to_is_for_volumes(pair, tmp_path):
    levelset, a, b = pair
    for name, volume in (("A", a), ("B", b)):
        (tmp_path / name).mkdir()
        shutil.copy(volume, tmp_path / name / "v.nii.gz")
        mesh(tmp_path / name / "s.ply", sheet(6, VALUES))
        npy(tmp_path / name / "w.npy", noisy((4, 4)))
    run, found = of_folders(tmp_path / "A", tmp_path / "B", "--levelset", levelset, "--within", "2")
    assert found["files"]["v.nii.gz"] == figures(a, b, "--levelset", levelset, "--within", "2")
    assert found["files"]["s.ply"]["compared"] == 36
    assert run.code == 1 and "PSI" in found["files"]["w.npy"]["error"]


def test_links_that_lead_round_and_pipes_do_not_hold_it_up(folders):
    a, b = folders
    (a / "sub-01" / "again").symlink_to(a, target_is_directory=True)
    (b / "sub-01" / "again").symlink_to(b, target_is_directory=True)
    (a / "sub-02").symlink_to(a / "sub-01", target_is_directory=True)
    (b / "sub-02").symlink_to(b / "sub-01", target_is_directory=True)
    os.mkfifo(a / "lh.pipe")
    run, found = of_folders(a, b)
    assert run.code == 0 and len([name for name in found["files"] if name.startswith("sub-02/")]) == 5


def test_names_of_any_bytes(folders):
    a, b = folders
    odd = os.fsdecode(b"m\xff.npy")
    try:
        npy(a / odd, noisy((4, 4)))
    except OSError:
        pytest.skip("this disk takes no such names")
    run = beltrami("compare", a, b)
    assert run.code == 1 and "only in A: m" in run.out
    assert "only in A: m" in beltrami("compare", a, b, "-q").err
    (b / odd).write_bytes(b"")
    assert "cannot be read" in beltrami("compare", a, b).out
    shutil.copy(a / odd, b / odd)
    assert "\nm" in done("compare", a, b).out
    assert odd in of_folders(a, b)[1]["files"]


def test_folders_are_left_as_they_were(folders, tmp_path):
    before = contents(tmp_path)
    beltrami("compare", *folders, "--max-abs", "0")
    assert contents(tmp_path) == before


def test_a_folder_that_cannot_be_listed_is_refused(folders, monkeypatch):
    a, b = folders
    scan = os.scandir

    def guarded(path: str) -> object:
        if str(path).endswith("sub-01"):
            raise PermissionError(13, "Permission denied", str(path))
        return scan(path)

    monkeypatch.setattr(os, "scandir", guarded)
    assert "sub-01: cannot be listed (Permission denied)" in refused("compare", a, b)
