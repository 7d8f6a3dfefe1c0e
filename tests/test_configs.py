"""Every config in configs/ is valid, and the small ones run."""

from pathlib import Path

import pytest

from beltrami_cli.study import read_study

CONFIGS = sorted((Path(__file__).resolve().parents[1] / "configs").glob("*.toml"))
OUTPUTS = ("torus_", "sulcus_", "curve", "portrait", "map_denoised", "angle_denoised")


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_config_is_valid(path: Path) -> None:
    study = read_study([path])
    assert len(study) == (8 if path.stem == "regression" else 1)
    for job in (planned.job for planned in study):
        assert job.levelset is not None
        assert job.levelset.is_relative_to(path.parent)
        assert job.volume.name.startswith(OUTPUTS)
