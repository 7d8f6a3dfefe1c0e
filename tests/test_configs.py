"""Every config in configs/ is valid, and the small ones run."""

from pathlib import Path

import pytest

from beltrami_cli import config

CONFIGS = sorted((Path(__file__).resolve().parents[1] / "configs").glob("*.toml"))


@pytest.mark.parametrize("path", CONFIGS, ids=lambda path: path.stem)
def test_config_is_valid(path: Path) -> None:
    job = config.make_job(config.read_config(path))
    assert job.levelset is not None
    assert job.levelset.is_relative_to(path.parent)
    assert job.volume.name.startswith(("torus_beta", "curve", "portrait", "map_denoised", "angle_denoised"))
