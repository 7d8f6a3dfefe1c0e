"""The package as a whole: what it depends on, how it starts, and what its start must not load."""

import ast
import importlib
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import beltrami_cli

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
HEAVY = {
    "SimpleITK",
    "colorcet",
    "distributed",
    "fast_simplification",
    "igl",
    "jinja2",
    "matplotlib",
    "meshio",
    "nibabel",
    "numba",
    "plotly",
    "scipy",
    "skimage",
    "tqdm",
    "trimesh",
}


def run(*arguments: str) -> str:
    return subprocess.run([sys.executable, *arguments], check=True, capture_output=True, text=True).stdout


def imported_packages(folder: str) -> set[str]:
    names = set()
    for file in (ROOT / folder).rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text())):
            if isinstance(node, ast.Import):
                names |= {alias.name.split(".")[0] for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                names.add(node.module.split(".")[0])
    own = {"beltrami_cli"} | {file.stem for file in (ROOT / folder).glob("*.py")}
    distributions = {
        "skimage": "scikit-image",
        "igl": "libigl",
        "dask_jobqueue": "dask-jobqueue",
        "fast_simplification": "fast-simplification",
        "PIL": "matplotlib",  # which depends on it
        "markupsafe": "jinja2",  # likewise
    }
    return {distributions.get(name, name) for name in names - set(sys.stdlib_module_names) - own}


def names_of(requirements: list[str]) -> set[str]:
    return {requirement.split(">=")[0] for requirement in requirements}


def test_dependencies_are_what_the_package_imports():
    extras = PROJECT["optional-dependencies"]
    optional = names_of([*extras["report"], *extras["cluster"]])
    assert imported_packages("beltrami_cli") - optional == names_of(PROJECT["dependencies"])


def test_tests_import_nothing_undeclared():
    extras = PROJECT["optional-dependencies"]
    declared = names_of([*PROJECT["dependencies"], *extras["report"], *extras["cluster"], *extras["dev"]])
    assert imported_packages("tests") - {file.stem for file in (ROOT / "benchmarks").glob("*.py")} <= declared


def test_console_script_and_module_are_one_command():
    module, function = PROJECT["scripts"]["beltrami"].split(":")
    assert callable(getattr(importlib.import_module(module), function))
    assert beltrami_cli.__version__ in run("-m", "beltrami_cli", "--version")


@pytest.mark.parametrize("module", ["beltrami_cli", "beltrami_cli.cli", "beltrami_cli.formats"])
def test_start_loads_no_heavy_package(module):
    loaded = set(run("-c", f"import {module}, sys; print(*sys.modules)").split())
    assert module in loaded
    assert loaded & HEAVY == set()


def test_every_module_says_what_it_is_about():
    files = [f for f in (ROOT / "beltrami_cli").rglob("*.py") if f.read_text().strip()]
    assert [f.name for f in files if not ast.get_docstring(ast.parse(f.read_text()))] == []
