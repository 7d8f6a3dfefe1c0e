"""The demo: a picture where matplotlib is there, and the same numbers where it is not."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from command import beltrami, contents, done, load, record, refused

from beltrami_cli import report

FILES = {"denoised.nii.gz", "denoised.ply", "denoised.json"}


@pytest.fixture
def phantom(tmp_path: Path) -> Path:
    done("phantom", "torus", tmp_path / "torus", "--size", "32", "-q")
    return tmp_path / "torus"


@pytest.fixture
def no_matplotlib(monkeypatch):
    real = importlib.util.find_spec
    monkeypatch.setattr(report, "find_spec", lambda name: None if name == "matplotlib" else real(name))


def decibels(line: str) -> tuple[float, float]:
    words = line.split()
    return float(words[4]), float(words[7])


def test_with_a_picture(phantom, tmp_path):
    pytest.importorskip("matplotlib")
    folder = tmp_path / "out"
    wrote, did, psnr, look = done("demo", folder, "--from", phantom).out.splitlines()
    assert set(contents(folder)) == {*FILES, "denoised.png"}
    assert (folder / "denoised.png").read_bytes().startswith(b"\x89PNG")
    assert str(folder / "denoised.ply") in wrote
    assert "12 iterations" in did
    before, after = decibels(psnr)
    assert before == pytest.approx(16.1, abs=0.3)  # 20 log10(255 / 40)
    assert after > before + 7
    assert look == f"look at {folder / 'denoised.png'}"
    near = np.abs(load(phantom / "levelset.nii.gz")) < 0.5
    error = (load(folder / "denoised.nii.gz") - load(phantom / "clean.nii.gz"))[near]
    assert after == pytest.approx(20 * np.log10(255 / np.sqrt(np.mean(error**2))), abs=0.06)
    assert record(folder / "denoised.json")["Parameters"]["beta"] == 0.1


def test_without_matplotlib(phantom, tmp_path, no_matplotlib):
    folder = tmp_path / "out"
    run = beltrami("demo", folder, "--from", phantom)
    assert run.code == 0
    assert "pip install" in run.message
    assert set(contents(folder)) == FILES
    assert run.out.splitlines()[-1] == f"look at {folder / 'denoised.ply'}"


def test_makes_its_own_torus(tmp_path, no_matplotlib):
    run = beltrami("demo", tmp_path / "out", "-q")
    assert (run.code, run.out, run.err) == (0, "", "")
    assert set(contents(tmp_path / "out")) == {*FILES, "levelset.nii.gz", "clean.nii.gz", "noisy.nii.gz"}
    assert load(tmp_path / "out" / "noisy.nii.gz").shape == (64, 64, 64)


def test_refuses(phantom, tmp_path, no_matplotlib):
    folder = tmp_path / "out"
    assert "holds no levelset" in refused("demo", folder, "--from", tmp_path / "nothing")
    assert not folder.exists()
    done("demo", folder, "--from", phantom, "-q")
    before = contents(tmp_path)
    assert "exists already" in refused("demo", folder, "--from", phantom)
    assert contents(tmp_path) == before
    done("demo", folder, "--from", phantom, "--overwrite", "-q")
    assert "is a file" in refused("demo", folder / "denoised.json")
