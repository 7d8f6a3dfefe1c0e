"""Pictures of runs: what they are told, that they belong to the run's outputs, and what they leave alone."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import ball, contents, done, load, nifti, noisy, npy, record, refused

from beltrami_cli import pipeline, report
from beltrami_cli.config import Job
from beltrami_cli.report.subject import Subject
from beltrami_cli.resume import finished
from beltrami_cli.study import read_study

LIBRARIES = {"matplotlib", "plotly", "colorcet", "jinja2", "fast_simplification"}
FEW = ("--beta", "0.1", "--iterations", "3")


def only(subjects: list[Subject]) -> Subject:
    (subject,) = subjects
    return subject


def test_a_report_is_told_of_input_and_output(scene, shown):
    psi, data, out = scene
    done("denoise", psi, data, "-o", out, "--report", out.with_name("r.png"), "--stop", "auto")
    subject, told = only(shown), record(out.with_name("out.json"))
    assert subject.compares
    assert (subject.title, [each.title for each in subject.maps]) == ("data.nii.gz", ["input", "denoised"])
    assert subject.grid is not None
    assert np.allclose(subject.maps[0].volume, load(data))
    assert np.allclose(subject.maps[1].volume, load(out), equal_nan=True)
    before, after = (each.values for each in subject.maps)
    assert before.shape == after.shape == (len(subject.mesh.vertices_ras_mm),)
    assert before.std() > 5 > after.std()
    assert subject.record["Parameters"] == told["Parameters"]
    assert str(out.with_name("r.png").absolute()) in told["Outputs"]
    assert told["Seconds"].keys() >= {"report", "write"}
    errors = told["Choice"]["errors"]
    assert np.argmin(errors) == told["Choice"]["iterations"] == told["Iterations"]
    assert min(row["error"] for row in told["Choice"]["table"]) == pytest.approx(min(errors), rel=1e-5)


def test_the_noise_is_followed_only_for_a_report(scene, shown):
    psi, data, out = scene
    done("denoise", psi, data, "-o", out, "--beta", "0.1", "--iterations", "40", "--report", out.with_name("r.html"))
    each = record(out.with_name("out.json"))["PerIteration"]
    looks = [look["iteration"] for look in each["noise_sd"]]
    assert looks == [*range(17), *range(18, 33, 2), 36, 40]
    sd = [look["sd"][0] for look in each["noise_sd"]]
    assert sd[0] > 3 * sd[-1]
    first = load(out)
    done("denoise", psi, data, "-o", out, "--beta", "0.1", "--iterations", "40", "--overwrite")
    assert "noise_sd" not in record(out.with_name("out.json"))["PerIteration"]
    assert np.array_equal(load(out), first, equal_nan=True)


def test_missing_and_filled_places(tmp_path, shown):
    data = noisy()
    data[:, :, :8] = -1
    psi, given = nifti(tmp_path / "psi.nii.gz", ball()), nifti(tmp_path / "data.nii.gz", data)
    done(
        "denoise",
        psi,
        given,
        "-o",
        tmp_path / "o.nii.gz",
        "--missing=-1",
        "--fill",
        "2",
        *FEW,
        "--report",
        tmp_path / "r.png",
    )
    subject = only(shown)
    before, after = subject.maps
    low = subject.mesh.vertices_ras_mm[:, 2] < 6
    assert np.isnan(before.values[low]).all()
    assert np.isnan(after.values[subject.mesh.vertices_ras_mm[:, 2] < 4]).all()
    assert np.array_equal(after.filled, np.isnan(before.values) & ~np.isnan(after.values))
    assert 0 < after.filled.sum() < low.sum()
    assert np.isnan(before.volume[:, :, :8]).all()


def test_angles(tmp_path, shown):
    psi = nifti(tmp_path / "psi.nii.gz", ball())
    angle = nifti(tmp_path / "a.nii.gz", ((noisy(sigma=40, mean=0) + 180) % 360 - 180).astype(np.float32))
    out = ("-o", tmp_path / "o.nii.gz", "--report", tmp_path / "r.png")
    done("denoise", psi, angle, *out, "--kind", "circular", "--period", "360", *FEW)
    subject = only(shown)
    assert (subject.period, subject.low) == (360, -180)
    assert np.abs(subject.differences()).max() <= 180


def test_channels_complex_and_frames(tmp_path, shown):
    psi = nifti(tmp_path / "psi.nii.gz", ball())
    several = np.stack([noisy(seed=k, mean=20 * k) for k in range(3)], -1)
    color = nifti(tmp_path / "c.nii.gz", several)
    done("denoise", psi, color, "-o", tmp_path / "o.nii.gz", "--kind", "vector", *FEW, "--report", tmp_path / "r.png")
    assert shown[0].channels == 3
    assert shown[0].channel(2).maps[1].values.mean() == pytest.approx(40, abs=2)
    frames = ("-o", tmp_path / "f.nii.gz", "--independent", "--report", tmp_path / "f.png")
    done("denoise", psi, color, *frames, "--kind", "vector", *FEW)
    assert shown[1].channels == 1
    assert shown[1].maps[1].values.mean() == pytest.approx(20, abs=2)
    assert np.allclose(shown[1].maps[0].volume, several[..., 1])
    assert np.allclose(shown[1].maps[1].volume, load(tmp_path / "f.nii.gz")[..., 1], equal_nan=True)
    assert shown[1].notes == ("frame 2 of 3: the one that parameters are chosen on",)
    wave = nifti(tmp_path / "w.nii.gz", several[..., 0] + 1j * several[..., 1])
    done("denoise", psi, wave, "-o", tmp_path / "w_o.nii.gz", "--kind", "vector", *FEW, "--report", tmp_path / "w.png")
    assert shown[2].channels == 2
    assert np.allclose(shown[2].maps[0].volume, several[..., :2])


def test_values_at_vertices(tmp_path, shown):
    psi, data = nifti(tmp_path / "psi.nii.gz", ball()), nifti(tmp_path / "data.nii.gz", noisy())
    done("mesh", psi, data, "-o", tmp_path / "m.surf.gii")
    args = (tmp_path / "m.surf.gii", tmp_path / "m.func.gii", "-o", tmp_path / "o.func.gii")
    done("denoise", *args, *FEW, "--report", tmp_path / "r.png")
    subject = only(shown)
    assert subject.grid is None
    assert subject.maps[0].volume is None
    assert np.allclose(subject.maps[0].values, load_map(tmp_path / "m.func.gii"))
    assert np.allclose(subject.maps[1].values, load_map(tmp_path / "o.func.gii"))


def load_map(path: Path) -> np.ndarray:
    import nibabel as nib

    return nib.load(path).darrays[0].data


def test_a_curve_and_a_flat_run(tmp_path, shown):
    plane = (24, 24)
    psi, data = npy(tmp_path / "psi.npy", ball(plane, 8)), npy(tmp_path / "data.npy", noisy(plane))
    done("denoise", psi, data, "-o", tmp_path / "o.npy", *FEW, "--report", tmp_path / "r.png")
    done("denoise", "--flat", data, "-o", tmp_path / "f.npy", *FEW, "--report", tmp_path / "f.png")
    curve, flat = shown
    assert curve.is_curve
    assert curve.maps[0].volume.shape == flat.maps[0].volume.shape == (24, 24, 1)
    assert flat.mesh is None
    assert flat.maps[1].values is None
    assert len(flat.differences()) == 24 * 24


def test_axes_are_those_of_the_head(tmp_path, shown):
    # Stored as PIR: the first axis runs to posterior, the second down, the third to the right.
    affine = np.array([[0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1.0]])
    psi, data = nifti(tmp_path / "psi.nii.gz", ball(), affine), nifti(tmp_path / "d.nii.gz", noisy(), affine)
    done("denoise", psi, data, "-o", tmp_path / "o.nii.gz", *FEW, "--report", tmp_path / "r.png")
    subject = only(shown)
    assert np.allclose(subject.grid.affine[:3, :3], np.eye(3))
    assert np.allclose(subject.maps[0].volume, load(tmp_path / "d.nii.gz").transpose(2, 0, 1)[:, ::-1, ::-1])


def test_from_a_config_and_resumed(scene, shown):
    folder = scene[2].parent
    config, picture = folder / "study.toml", folder / "pages" / "r.png"
    picture.parent.mkdir()

    def job(more: str) -> Job:
        config.write_text(
            '[input]\nlevelset = "psi.nii.gz"\ndata = "data.nii.gz"\n'
            f'[output]\nvolume = "out.nii.gz"\n{more}\n[flow]\nbeta = 0.1\n[time]\niterations = 2\n'
        )
        (planned,) = read_study([config])
        return planned.job

    plain = job("")
    pipeline.run(plain)
    assert finished(plain)
    pictured = job('report = "pages/r.png"')
    assert finished(pictured) is None  # a picture is asked for that is not there
    pipeline.run(replace(pictured, overwrite=True))
    assert picture.read_text() == "drawn"
    assert record(folder / "out.json")["Request"]["report"] == "pages/r.png"
    assert finished(pictured)
    picture.unlink()
    assert finished(pictured) is None


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("r.pdf", "r.pdf: pictures are written as .png or .html; give it one of these suffixes"),
        ("r", "pictures are written as .png or .html"),
        ("data.nii.gz", "pictures are written as .png or .html"),
        ("nowhere/r.png", "nowhere"),
    ],
)
def test_refused_before_anything_is_done(scene, name, message):
    psi, data, out = scene
    before = contents(out.parent)
    assert message in refused("denoise", psi, data, "-o", out, "--report", out.parent / name)
    assert contents(out.parent) == before


def test_an_old_report_stays(scene, shown):
    psi, data, out = scene
    picture = out.with_name("r.png")
    picture.write_text("mine")
    assert "exists already" in refused("denoise", psi, data, "-o", out, "--report", picture)
    assert picture.read_text() == "mine"
    assert not out.exists()


def test_what_is_missing_is_told(scene, monkeypatch):
    psi, data, out = scene
    real = report.find_spec
    monkeypatch.setattr(report, "find_spec", lambda name: None if name == "plotly" else real(name))
    line = refused("denoise", psi, data, "-o", out, "--report", out.with_name("r.html"))
    assert line.endswith("pictures need plotly, not installed: pip install 'beltrami_cli[report]'")
    assert report.missing(Path("r.png")) == []


def test_a_picture_that_fails_leaves_nothing(scene, monkeypatch):
    psi, data, out = scene
    before = contents(out.parent)

    def fail(path: Path, subject: Subject) -> None:
        path.write_text("half")
        raise MemoryError

    monkeypatch.setattr(report, "write", fail)
    assert "out of memory" in refused("denoise", psi, data, "-o", out, "--report", out.with_name("r.png"), code=1)
    assert contents(out.parent) == before


def test_without_a_report_no_library_of_pictures_is_loaded(scene):
    psi, data, out = scene
    script = (
        "import sys, json; from beltrami_cli.cli import main;"
        "code = main(sys.argv[1:]); print(json.dumps([code, sorted(m.split('.')[0] for m in sys.modules)]))"
    )
    run = subprocess.run(
        [sys.executable, "-c", script, "denoise", psi, data, "-o", out, "-q", *FEW], capture_output=True, text=True
    )
    code, modules = json.loads(run.stdout)
    assert code == 0
    assert set(modules) & LIBRARIES == set()


@pytest.mark.parametrize("suffix", [".png", ".html"])
def test_both_kinds_are_drawn(scene, suffix):
    psi, data, out = scene
    picture = out.with_name(f"r{suffix}")
    done("denoise", psi, data, "-o", out, *FEW, "--report", picture)
    start = {".png": b"\x89PNG", ".html": b"<!DOCTYPE html>"}[suffix]
    assert picture.read_bytes()[: len(start)].upper() == start.upper()
    assert contents(out.parent).keys() >= {"out.nii.gz", "out.surf.gii", "out.func.gii", "out.json", picture.name}
