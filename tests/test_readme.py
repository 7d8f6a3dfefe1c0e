"""Every command that the documentation shows as one to type runs, in order, where the sample data are."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest
from command import ball, beltrami, noisy

ROOT = Path(__file__).resolve().parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
ELSEWHERE = "../shared/data"  # volumes that are not part of the project


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)


def commands(page: Path) -> list[str]:
    """Lines that start with `beltrami ` in blocks fenced as bash, continued lines joined."""
    lines = "\n".join(blocks(page, "bash")).replace("\\\n", " ").splitlines()
    return [line for line in lines if line.startswith("beltrami ") and ELSEWHERE not in line]


def test_readme_shows_the_main_commands():
    shown = {command.split()[1] for command in commands(ROOT / "README.md")}
    assert {"denoise", "mesh", "compare", "info"} <= shown


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_commands_run(page, tmp_path, monkeypatch):
    for name in ("sample_data", "configs", "tests/golden"):
        shutil.copytree(ROOT / name, tmp_path / name, ignore=shutil.ignore_patterns("data", "output"))
    monkeypatch.chdir(tmp_path)
    for block in blocks(page, "toml"):
        if name := re.match(r"# (\S+\.toml)\n", block):
            Path(name[1]).write_text(block)
    for command in commands(page):
        run = beltrami(*shlex.split(command, comments=True)[1:])
        assert run.code == 0, f"{command}\n{run.err}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_python_runs(page):
    names = {"levelset": ball(), "data": noisy(), "r2": np.ones((16, 16, 16)), "affine": np.eye(4)}
    for block in blocks(page, "python"):
        exec(compile(block, page.name, "exec"), names)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    targets = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", page.read_text(encoding="utf-8"))
    local = [target for target in targets if "://" not in target]
    assert [target for target in local if not (page.parent / target).exists()] == []
