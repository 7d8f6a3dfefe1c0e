"""Every command that the documentation shows runs, in order, where the sample data are."""

from __future__ import annotations

import re
import shlex
import shutil
from collections.abc import Iterator
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
import trimesh
from command import ball, beltrami, nifti, noisy
from nibabel.freesurfer import write_geometry, write_morph_data

ROOT = Path(__file__).resolve().parents[1]
GALLERY = ROOT / "docs" / "gallery.md"  # whose commands run where their results are looked at, in test_configs.py
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]

# The only lines that do not run: of other programs, and of a scheduler that is not there.
NOT_RUN = (
    *(
        "make ",
        "pip install ",
        "python3 -m venv ",
        "freeview ",
        "wb_view ",
        "sbatch ",
        "dask ",
        "python slurm_dask.py ",
    ),
    "beltrami batch study.toml --resume --scheduler scheduler.json",
)


def blocks(page: Path) -> Iterator[tuple[str, str]]:
    """Language and text of each fenced block, in order."""
    yield from re.findall(r"^```(\w+)\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def lines(block: str) -> list[str]:
    """The commands of a block of shell, continued lines joined."""
    return [line for line in block.replace("\\\n", " ").splitlines() if line.strip() and not line.startswith("#")]


# What a page's commands name and cannot make themselves


def freesurfer_subject(folder: Path) -> None:
    """A ball of white matter of 10 mm, grey matter of 2.5 mm around it, and noisy maps on both."""
    centre, side = np.array([-30.0, 5.0, 10.0]), 40
    affine = np.array([[-1.0, 0, 0, 0], [0, 0, 1.0, 0], [0, -1.0, 0, 0], [0, 0, 0, 1.0]])  # as conformed volumes lie
    affine[:3, 3] = centre - affine[:3, :3] @ np.full(3, side / 2)
    x, y, z = (
        np.moveaxis(nib.affines.apply_affine(affine, np.indices((side,) * 3).T).T, 0, 0) - centre[:, None, None, None]
    )
    radius, random = np.sqrt(x**2 + y**2 + z**2), np.random.default_rng(0)
    geometry = {
        "head": np.array([2, 0, 20], np.int32), "valid": "1  # volume info valid", "filename": "T1.mgz",
        "volume": np.full(3, side), "voxelsize": np.ones(3), "cras": centre,
        "xras": np.array([-1.0, 0, 0]), "yras": np.array([0, 0, -1.0]), "zras": np.array([0, 1.0, 0]),
    }  # fmt: skip
    for name in ("surf", "mri", "func"):
        (folder / name).mkdir()
    sphere = trimesh.creation.icosphere(subdivisions=4)
    for name, size in (("white", 10.0), ("pial", 12.5)):
        write_geometry(folder / "surf" / f"lh.{name}", size * sphere.vertices, sphere.faces, volume_info=geometry)
    thickness = np.where(sphere.vertices[:, 0] > 0, 2.0, 3.0) + random.normal(0, 0.3, len(sphere.vertices))
    write_morph_data(folder / "surf" / "lh.thickness", thickness)
    overlay = thickness.astype(np.float32)[:, None, None]
    nib.save(nib.MGHImage(overlay, np.eye(4)), folder / "surf" / "lh.thickness.mgz")
    ribbon = np.select([radius < 10, radius < 12.5, x > 17], [2, 3, 41], 0)
    ribbon[-1, -1, -1] = 42
    nib.save(nib.MGHImage(ribbon.astype(np.int32), affine), folder / "mri" / "ribbon.mgz")
    nib.save(nib.MGHImage(np.where(radius < 10, 110, 0).astype(np.uint8), affine), folder / "mri" / "wm.mgz")
    angle = (np.degrees(np.arctan2(y, x)) + random.normal(0, 30, radius.shape)) % 360
    nifti(folder / "func" / "angle.nii.gz", angle.astype(np.float32), affine)


def volumes(folder: Path) -> None:
    """A mask, labels and a LayNii rim of one ball, and a map."""
    psi = ball((32,) * 3, 9)
    nifti(folder / "mask.nii.gz", (psi < 0).astype(np.uint8))
    nifti(folder / "aseg.nii.gz", np.select([psi < -3, psi < 0], [2, 3], 0).astype(np.int16))
    nifti(folder / "rim.nii.gz", np.select([psi < -3, psi < 0, psi < 2], [2, 3, 1], 0).astype(np.int16))
    nifti(folder / "map.nii.gz", noisy((32,) * 3))


def study(folder: Path) -> None:
    """study.toml as the page on batches has it, and its subjects."""
    text = next(text for language, text in blocks(ROOT / "docs" / "batch.md") if text.startswith("# study.toml"))
    (folder / "study.toml").write_text(text)
    for subject in ("01", "02"):
        shutil.copytree(ROOT / "sample_data" / "torus", folder / "study" / f"sub-{subject}")


STAND_INS = {
    "README.md": (freesurfer_subject, study),
    "freesurfer.md": (freesurfer_subject,),
    "volumes.md": (volumes,),
    "cluster.md": (study,),
}


def test_readme_shows_the_main_commands():
    shown = {line.split()[1] for _, block in blocks(ROOT / "README.md") for line in lines(block) if "beltrami " in line}
    assert {"denoise", "view", "batch", "compare", "levelset", "info", "demo"} <= shown


@pytest.mark.parametrize("page", [page for page in PAGES if page != GALLERY], ids=lambda page: page.name)
def test_commands_run(page, tmp_path, monkeypatch):
    for name in ("sample_data", "configs", "tests/golden"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("data", "output"))
    for stand_in in STAND_INS.get(page.name, ()):
        stand_in(tmp_path)
    monkeypatch.chdir(tmp_path)
    for language, block in blocks(page):
        if name := re.match(r"# (\S+\.toml)\n", block):
            Path(name[1]).write_text(block)
        if language not in ("bash", "console", "sh"):
            continue
        for line in lines(block):
            if line.startswith(NOT_RUN):
                continue
            program, *arguments = shlex.split(line, comments=True)
            assert program == "beltrami", f"{line}\nneither runs nor is among those that do not"
            run = beltrami(*arguments)
            assert run.code == 0, f"{line}\n{run.err}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_runs(page):
    names = {"levelset": ball(), "data": noisy(), "r2": np.ones((16, 16, 16)), "affine": np.eye(4)}
    for language, block in blocks(page):
        if language == "python":
            exec(compile(block, page.name, "exec"), names)
