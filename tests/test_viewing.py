"""beltrami view: which maps it shows on which surface, and what it refuses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from command import ball, beltrami, contents, done, load, nifti, noisy, npy, refused

from beltrami_cli.report.subject import Subject


@pytest.fixture
def files(tmp_path) -> dict[str, Path]:
    psi, a, b = ball(), noisy(), noisy(seed=1, mean=70)
    made = {name: nifti(tmp_path / f"{name}.nii.gz", v) for name, v in {"psi": psi, "a": a, "b": b}.items()}
    done("mesh", made["psi"], made["a"], "-o", tmp_path / "m.surf.gii")
    done("mesh", made["psi"], made["b"], "-o", tmp_path / "n.ply")
    done("mesh", made["psi"], made["a"], "-o", tmp_path / "m.ply")
    mesh = {"mesh": tmp_path / "m.surf.gii", "metric": tmp_path / "m.func.gii"}
    return {**made, **mesh, "ply": tmp_path / "m.ply", "other": tmp_path / "n.ply", "out": tmp_path / "o.png"}


def titles(subject: Subject) -> list[str]:
    return [each.title for each in subject.maps]


def test_volumes_on_a_level_set(files, shown):
    run = done("view", files["a"], files["b"], "--levelset", files["psi"], "-o", files["out"])
    assert run.out == f"wrote {files['out']}\n"
    (subject,) = shown
    assert titles(subject) == ["a", "b"]
    assert not subject.compares
    assert np.allclose(subject.maps[0].volume, load(files["a"]))
    assert subject.maps[0].values.mean() == pytest.approx(50, abs=1.5)
    assert subject.maps[1].values.mean() == pytest.approx(70, abs=1.5)
    again = refused("view", files["a"], "--levelset", files["psi"], "-o", files["out"])
    assert "exists already" in again
    done("view", files["a"], "--levelset", files["psi"], "-o", files["out"], "--overwrite")


def test_what_is_shown_is_what_a_mesh_of_it_holds(files, shown):
    done("view", files["a"], "--levelset", files["psi"], "-o", files["out"])
    done("view", files["ply"], "-o", files["out"], "--overwrite")
    on_psi, on_mesh = (subject.maps[0].values for subject in shown)
    assert np.allclose(on_psi, on_mesh[:, 0], atol=1e-4)


def test_compare_shows_the_difference(files, shown):
    done("view", "--compare", files["a"], files["b"], "--levelset", files["psi"], "-o", files["out"])
    (subject,) = shown
    assert subject.compares
    assert titles(subject) == ["a", "b"]
    assert subject.differences().mean() == pytest.approx(-20, abs=2)


def test_values_at_vertices_and_meshes(files, shown):
    done("view", files["metric"], "--levelset", files["mesh"], "-o", files["out"])
    done("view", "--compare", files["ply"], files["other"], "-o", files["out"], "--overwrite")
    done("view", files["mesh"], "-o", files["out"], "--overwrite")
    done("view", files["a"], "--levelset", files["mesh"], "-o", files["out"], "--overwrite")
    metric, meshes, bare, volume = shown
    assert metric.grid is None
    assert metric.maps[0].values.mean() == pytest.approx(50, abs=1.5)
    assert meshes.differences().mean() == pytest.approx(-20, abs=2)
    assert bare.maps[0].values.shape[1] == 1
    assert volume.grid is not None
    assert len(volume.maps[0].values) == len(metric.maps[0].values)


def test_titles(files, shown, tmp_path):
    (tmp_path / "s").mkdir()
    twin = nifti(tmp_path / "s" / "a.nii.gz", noisy())
    common = ("--levelset", files["psi"], "-o", files["out"], "--overwrite")
    done("view", files["a"], files["b"], *common, "--titles", "noisy, beta 0.1")
    done("view", files["a"], twin, *common)
    assert titles(shown[0]) == ["noisy", "beta 0.1"]
    assert titles(shown[1]) == [f"{tmp_path.name}/a", "s/a"]
    assert "titles: found 1; expected 2" in refused("view", files["a"], twin, *common, "--titles", "noisy")


def test_angles_channels_and_slices_alone(files, shown, tmp_path):
    out = ("-o", files["out"], "--overwrite")
    signed = nifti(tmp_path / "signed.nii.gz", noisy(mean=0))
    done("view", signed, "--levelset", files["psi"], "--period", "360", *out)
    assert (shown[0].period, shown[0].low) == (360, -180)
    several = nifti(tmp_path / "several.nii.gz", np.stack([noisy(), noisy(mean=9)], -1))
    done("view", several, "--levelset", files["psi"], *out)
    assert shown[1].channels == 2
    done("view", files["a"], *out)
    assert shown[2].mesh is None
    plane = (24, 24)
    psi, data = npy(tmp_path / "psi.npy", ball(plane, 8)), npy(tmp_path / "data.npy", noisy(plane))
    done("view", data, "--levelset", psi, *out)
    assert shown[3].is_curve
    assert refused("view", files["a"], several, "--levelset", files["psi"], *out).startswith("channels or frames")


def test_missing_values(files, shown, tmp_path):
    holes = noisy()
    holes[:8] = -1
    given = nifti(tmp_path / "holes.nii.gz", holes)
    done("view", given, "--levelset", files["psi"], "--missing=-1", "-o", files["out"])
    (subject,) = shown
    left = subject.mesh.vertices_ras_mm[:, 0] < 6
    assert np.isnan(subject.maps[0].values[left]).all()
    assert np.isnan(subject.maps[0].volume[:8]).all()


def test_refuses(files, tmp_path):
    out = ("-o", files["out"])
    before = contents(tmp_path)
    psi = ("--levelset", files["psi"])
    assert "VOLUME is missing" in refused("view", *psi, *out)
    assert "compare: found 3 files" in refused("view", "--compare", files["a"], files["a"], files["b"], *psi, *out)
    assert "compare: found 1 files" in refused("view", "--compare", files["a"], *psi, *out)
    assert "nothing.nii.gz" in refused("view", tmp_path / "nothing.nii.gz", *psi, *out)
    assert "pictures are written as" in refused("view", files["a"], *psi, "-o", tmp_path / "o.jpg")
    assert "swapped" in refused("view", files["mesh"], *psi, *out)
    assert "one kind" in refused("view", files["a"], files["metric"], "--levelset", files["mesh"], *out)
    small = nifti(tmp_path / "small.nii.gz", noisy((8, 8, 8)))
    assert "grids differ" in beltrami("view", files["a"], small, *psi, *out).err
    assert "grids differ" in beltrami("view", files["a"], small, *out).err
    small.unlink()
    done("mesh", nifti(tmp_path / "p.nii.gz", ball(radius=4)), "-o", tmp_path / "p.ply")
    assert "same order" in refused("view", files["ply"], tmp_path / "p.ply", *out)
    for name in ("p.nii.gz", "p.ply"):
        (tmp_path / name).unlink()
    assert contents(tmp_path) == before


def test_sides_and_colours(files, shown):
    common = ("view", files["a"], "--levelset", files["psi"], "-o", files["out"], "--overwrite")
    done(*common, "--side", "front", "--colours", "gray")
    assert (shown[0].side, shown[0].colours) == ("front", "gray")
    assert "expected the name of a colour map" in refused(*common, "--colours", "jett")
    assert "expected the name of a colour map" in refused(*common, "--colours", "cet_nothing")
    assert "'--side'" in refused(*common, "--side", "up")


def test_the_sides_of_the_command_are_those_of_pictures():
    from beltrami_cli.cli.view import SIDES
    from beltrami_cli.report import geometry

    assert set(SIDES) == set(geometry.SIDES)


def test_vertices_in_a_tight_sulcus_are_no_specks(tmp_path, shown):
    # Banks 1.2 voxels apart: many vertices have no voxel of their own.
    done("phantom", "sulcus", tmp_path / "s", "--size", "32", "--gap", "1.2", "-q")
    given = (tmp_path / "s" / "clean.nii.gz", "--levelset", tmp_path / "s" / "levelset.nii.gz")
    done("view", *given, "-o", tmp_path / "o.png")
    values = shown[0].maps[0].values
    assert np.isfinite(values).mean() > 0.98
    assert set(np.round(values[np.isfinite(values)])) == {0.0, 100.0}


def test_frames_lack_values_each_on_its_own(files, shown, tmp_path):
    frames = np.stack([noisy(), noisy(seed=1)], -1)
    frames[:8, ..., 0] = np.nan
    series = nifti(tmp_path / "series.nii.gz", frames)
    done("view", series, "--levelset", files["psi"], "-o", files["out"])
    values = shown[0].maps[0].values
    left = shown[0].mesh.vertices_ras_mm[:, 0] < 6
    assert np.isnan(values[left, 0]).all()
    assert np.isfinite(values[:, 1]).all()


def test_equal_angles_of_two_files_are_equal_numbers(files, shown, tmp_path):
    angle = noisy(mean=0, sigma=60) % 360
    signed = (angle + 180) % 360 - 180
    a, b = (nifti(tmp_path / f"{name}.nii.gz", v) for name, v in (("turn", angle), ("half", signed)))
    done("view", "--compare", a, b, "--levelset", files["psi"], "--period", "360", "-o", files["out"])
    first, second = shown[0].maps
    assert shown[0].low == -180
    assert np.allclose(first.volume, second.volume, atol=1e-3)
    assert np.abs(shown[0].differences()).max() < 1e-3


def test_the_map_that_is_shown_is_named(files, shown, tmp_path):
    done("denoise", files["mesh"], files["metric"], "-o", tmp_path / "o.func.gii", "--iterations", "1", "--no-mesh")
    common = ("--levelset", files["mesh"], "-o", files["out"], "--overwrite")
    done("view", tmp_path / "o.func.gii", *common, "--map", "1")
    done("view", tmp_path / "o.func.gii", *common, "--map", "1", "--titles", "mine")
    assert [subject.maps[0].title for subject in shown] == ["o.func: 1", "mine"]


def test_a_picture_is_known_to_be_no_head(files, shown, tmp_path):
    from PIL import Image

    Image.fromarray((noisy((20, 30)) * 2).clip(0, 255).astype(np.uint8)).save(tmp_path / "photo.png")
    done("view", tmp_path / "photo.png", "-o", files["out"])
    plane = npy(tmp_path / "plane.npy", noisy((20, 30)))
    done("view", plane, "-o", files["out"], "--overwrite")
    done("view", files["a"], "-o", files["out"], "--overwrite")
    assert [(subject.has_anatomy, subject.rows_down) for subject in shown] == [
        (False, True),
        (False, False),
        (True, False),
    ]
