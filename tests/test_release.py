"""What a release is made of: pictures that stay small, the citation, the workflows, the packages, the container."""

from __future__ import annotations

import importlib.util
import io
import os
import re
import shlex
import shutil
import subprocess
import sys
import tarfile
import tomllib
import zipfile
from pathlib import Path
from types import ModuleType

import pytest

import beltrami_cli

ROOT = Path(__file__).resolve().parents[1]
RECIPE = ROOT / "docs" / "examples" / "beltrami.def"
MOST_BYTES_OF_PICTURES = 3_000_000


def script(name: str) -> ModuleType:
    """A program of .ci as a module."""
    spec = importlib.util.spec_from_file_location(name, ROOT / ".ci" / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


# Pictures


def test_pictures_stay_small():
    folders = ("docs", "sample_data", "configs", "benchmarks", "tests", "beltrami_cli")
    files = [path for folder in folders for path in (ROOT / folder).rglob("*") if path.is_file()]
    here = [path for path in files if not {"_build", "output", "data"} & set(path.relative_to(ROOT).parts[:-1])]
    pictures = [path for path in here if path.suffix in (".png", ".jpg", ".jpeg", ".gif", ".svg", ".webp")]
    assert len(pictures) > 4
    assert sum(path.stat().st_size for path in pictures) < MOST_BYTES_OF_PICTURES


def test_gallery_shows_what_its_commands_make():
    page = ROOT / "docs" / "gallery.md"
    commands = script("gallery").commands(page)
    made = {command[command.index("-o") + 1] for command in commands if command[0] == "view"}
    shown = set(re.findall(r"\]\(images/gallery/(\S+)\)", page.read_text(encoding="utf-8")))
    assert shown == made == {path.name for path in (ROOT / "docs" / "images" / "gallery").iterdir()}
    assert [command[0] for command in commands].count("view") == 5


@pytest.mark.parametrize("name", ["curve", "torus", "portrait", "phantom_cortex"])
def test_configs_of_figures_say_how_to_make_them(name):
    """The commands at the head of a config work as they stand in the gallery: the same inputs, outputs and surface."""
    text = (ROOT / "configs" / f"{name}.toml").read_text()
    head = text[: text.index("[input]")].replace("\\\n#", " ")
    lines = [shlex.split(line)[1:] for line in re.findall(r"^#   (beltrami .*)$", head, re.MULTILINE)]
    assert [line[0] for line in lines] == ["phantom", "batch", "view"]
    gallery = script("gallery").commands(ROOT / "docs" / "gallery.md")
    view = lines[2]
    (shown,) = [command for command in gallery if command[0] == "view" and command[-1] == view[-1]]
    files = {word for word in view if "/" in word}
    assert files and files <= set(shown)


# The citation


def test_citation_names_this_version_and_the_paper():
    text = (ROOT / "CITATION.cff").read_text()
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    top = dict(re.findall(r"^([a-z-]+): (.+)$", text, re.MULTILINE))
    assert top["cff-version"] == "1.2.0" and top["type"] == "software" and "message" in top
    assert top["title"] == project["name"]
    assert top["version"] == beltrami_cli.__version__
    assert top["license"] == project["license"]
    assert "  - name: " + project["authors"][0]["name"] in text
    for word in ("title: The Beltrami Flow over Implicit Manifolds", "Sochen", "Deriche", "Lopez-Perez", "year: 2003"):
        assert word in text


# The workflows


def test_workflows_run_what_runs_here():
    ci, release = ((ROOT / ".github" / "workflows" / f"{name}.yml").read_text() for name in ("ci", "release"))
    for text in (ci, release):
        uses = re.findall(r"uses: (\S+)", text)
        assert uses and all(re.fullmatch(r"[\w-]+/[\w-]+@v\d+", each) for each in uses)
        assert '"3.11", "3.x"' in text and "permissions:\n  contents: read" in text
    assert ".ci/run" in ci and "macos-latest, windows-latest" in ci
    assert "ubuntu-latest, macos-latest, windows-latest" in release
    for command in ("python -m build", "twine check --strict", ".ci/check_dist.py dist"):
        assert command in release
        assert command in (ROOT / "Makefile").read_text()
    assert all(
        f"\nmake {target}\n" in (ROOT / ".ci" / "run").read_text() for target in ("test", "lint", "docs", "dist")
    )


# The packages


def packed(folder: Path, *strays: str) -> tuple[Path, Path]:
    """An sdist and a wheel as they should be, with further files in the sdist."""
    check = script("check_dist")
    sdist, wheel = folder / "x.tar.gz", folder / "x.whl"
    with tarfile.open(sdist, "w:gz") as archive:
        for name in (*check.WANTED, *strays):
            archive.addfile(tarfile.TarInfo(f"beltrami_cli-1/{name}"), io.BytesIO())
    with zipfile.ZipFile(wheel, "w") as archive:
        for path in (ROOT / "beltrami_cli").rglob("*"):
            if path.is_file() and "__pycache__" not in path.parts:
                archive.writestr(path.relative_to(ROOT).as_posix(), "")
    return sdist, wheel


def test_packages_hold_what_they_should(tmp_path):
    script("check_dist").check_names(*packed(tmp_path))


@pytest.mark.parametrize("stray", ["demo_out/denoised.png", "docs/_build/html/index.html", "configs/output/torus.ply"])
def test_strays_are_found(tmp_path, stray):
    with pytest.raises(SystemExit, match=stray):
        script("check_dist").check_names(*packed(tmp_path, stray))


def test_tests_of_a_wheel_are_there():
    assert all((ROOT / "tests" / name).is_file() for name in script("check_dist").TESTS)


# The container


def sections() -> dict[str, str]:
    parts = re.split(r"^%(\w+)\n", RECIPE.read_text(), flags=re.MULTILINE)
    return {"header": parts[0], **dict(zip(parts[1::2], parts[2::2], strict=True))}


@pytest.mark.skipif(shutil.which("sh") is None, reason="no sh")
def test_recipe_has_its_sections_and_they_are_shell():
    found = sections()
    assert set(found) == {"header", "files", "post", "environment", "runscript", "test", "labels", "help"}
    assert found["header"].startswith("Bootstrap: docker\nFrom: python:3.")
    for name in ("post", "environment", "runscript", "test"):
        subprocess.run(["sh", "-n"], input=found[name], text=True, check=True)
    assert "beltrami demo" in found["test"] and 'exec beltrami "$@"' in found["runscript"]


@pytest.fixture
def container(tmp_path):
    """The recipe's wrapper around a command that tells which folder of kernels it is given: `run(TMPDIR) -> folder`."""
    if not sys.platform.startswith("linux"):
        pytest.skip("the container is a Linux one")
    wrapper = re.search(r"<<'WRAPPER'\n(.*?)^WRAPPER$", sections()["post"], re.MULTILINE | re.DOTALL)
    assert wrapper is not None
    kernels, inner, outer = tmp_path / "kernels", tmp_path / "inner", tmp_path / "beltrami"
    (kernels / "sub").mkdir(parents=True)
    (kernels / "sub" / "sheets.nbi").write_text("compiled")
    kernels.chmod(0o555)
    inner.write_text('#!/bin/sh\necho "${NUMBA_CACHE_DIR:-none}" "$@"\n')
    text = wrapper[1].replace("/opt/kernels", str(kernels)).replace("/opt/beltrami/bin/beltrami", str(inner))
    outer.write_text(text)
    for path in (inner, outer):
        path.chmod(0o755)

    def run(temporary: Path, **environment: str) -> str:
        given = {"PATH": os.environ["PATH"], "TMPDIR": str(temporary), **environment}
        done = subprocess.run([outer, "a b"], env=given, capture_output=True, text=True, check=True)
        folder, rest = done.stdout.split(maxsplit=1)
        assert (rest.strip(), done.stderr) == ("a b", "")
        return folder

    (tmp_path / "tmp").mkdir()
    return run


def test_container_gives_every_user_a_copy_of_the_kernels(container, tmp_path):
    folder = Path(container(tmp_path / "tmp"))
    assert folder == tmp_path / "tmp" / f"beltrami-kernels-{os.getuid()}"
    assert (folder / "sub" / "sheets.nbi").read_text() == "compiled"
    (folder / "new").write_text("what another CPU needs")
    assert Path(container(tmp_path / "tmp")) == folder and (folder / "new").exists()
    assert [path.name for path in (tmp_path / "tmp").iterdir()] == [folder.name]


def test_container_runs_no_code_of_others(container, tmp_path):
    link = tmp_path / "tmp" / f"beltrami-kernels-{os.getuid()}"
    (tmp_path / "elsewhere").mkdir()
    link.symlink_to(tmp_path / "elsewhere")
    assert container(tmp_path / "tmp") == "none"


def test_container_without_a_temporary_folder_or_with_a_cache_of_ones_own(container, tmp_path):
    assert container(tmp_path / "nowhere") == "none"
    assert container(tmp_path / "tmp", NUMBA_CACHE_DIR="mine") == "mine"
