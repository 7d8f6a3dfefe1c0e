"""Every config in configs/ is valid, and those of the figures show what they are said to show."""

import shlex
import shutil
from contextlib import chdir
from pathlib import Path

import numpy as np
import pytest
from command import beltrami, load
from test_readme import GALLERY, blocks, lines

from beltrami_cli.study import read_study

FOLDER = Path(__file__).resolve().parents[1] / "configs"
CONFIGS = sorted(FOLDER.glob("*.toml"))
JOBS = {"regression": 8, "torus": 5, "portrait": 4, "phantom_cortex": 4}
OUTPUTS = ("torus_", "sulcus_", "cortex_", "curve", "portrait", "map_denoised", "angle_denoised")


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_config_is_valid(path: Path) -> None:
    study = read_study([path])
    assert len(study) == JOBS.get(path.stem, 1)
    for job in (planned.job for planned in study):
        assert job.levelset is not None
        assert job.levelset.is_relative_to(path.parent)
        assert job.volume.name.startswith(OUTPUTS)


@pytest.fixture(scope="module")
def configs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of configs with the data and outputs of all commands of the gallery, its pictures beside it."""
    folder = tmp_path_factory.mktemp("gallery")
    for name in ("sample_data", "configs"):
        shutil.copytree(FOLDER.parent / name, folder / name, ignore=shutil.ignore_patterns("data", "output"))
    with chdir(folder):
        for _, block in blocks(GALLERY):
            for line in lines(block):
                program, *arguments = shlex.split(line)
                assert program == "beltrami"
                run = beltrami(*arguments)
                assert run.code == 0, f"{line}\n{run.err}"
    return folder / "configs"


def test_gallery_has_a_picture_for_each_figure(configs: Path) -> None:
    pictures = {path.name for path in configs.parent.glob("*.png")}
    assert pictures == {"sample.png", "curve.png", "torus.png", "portrait.png", "cortex.png"}


def test_cortex_figure_fills_holes_and_keeps_the_border(configs: Path) -> None:
    """Fig. 6: L2 washes the border out, L1 leaves the noise, 0.1 to 0.5 lie between."""
    psi, clean, noisy = (
        load(configs / "data" / "cortex" / f"{part}.nii.gz") for part in ("levelset", "clean", "noisy")
    )
    surface = (np.abs(psi) < 0.5) & np.isfinite(clean)

    def turn(a: np.ndarray, b: np.ndarray) -> np.ndarray:
        return np.abs((a - b + 180) % 360 - 180)

    at_border = np.zeros_like(surface)
    for axis in range(3):
        for step in (-1, 1):
            at_border |= turn(clean, np.roll(clean, step, axis)) > 60
    at_border &= surface
    assert surface.sum() > 2000 and at_border.sum() > 80
    error = {}
    for name in ("beta0", "beta0.1", "beta0.3", "beta0.5", "l1"):
        off = turn(load(configs / "output" / f"cortex_{name}.nii.gz"), clean)
        assert np.isfinite(off[surface]).all()  # no hole is left
        error[name] = off[surface].mean(), off[at_border].mean()
    before = np.nanmean(turn(noisy, clean)[surface])
    assert before > 30
    assert error["beta0.1"][0] < 9.5 and error["beta0.1"][0] < 0.75 * error["beta0"][0]
    assert error["beta0.1"][0] < error["beta0.3"][0] < error["beta0.5"][0] < error["l1"][0] < 0.55 * before
    assert all(error[name][1] < 0.6 * error["beta0"][1] for name in ("beta0.1", "beta0.3", "beta0.5", "l1"))


def test_torus_figure_is_best_between_the_limits(configs: Path) -> None:
    """Fig. 4: too small a beta smooths borders away, too large a one leaves the noise."""
    data = configs / "data" / "torus"
    near = np.abs(load(data / "levelset.nii.gz")) < 0.5
    clean = load(data / "clean.nii.gz")[near]
    error = [
        float(np.sqrt(np.mean((load(configs / "output" / f"torus_beta{beta}.nii.gz")[near] - clean) ** 2)))
        for beta in ("0", "0.01", "0.05", "0.1", "0.5")
    ]
    assert min(error) < 0.7 * error[0] and min(error) < 0.7 * error[-1]
    assert int(np.argmin(error)) in (2, 3)
