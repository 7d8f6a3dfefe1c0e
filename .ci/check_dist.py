"""Is what was built fit to be released? `python .ci/check_dist.py dist`, on Linux, macOS and Windows.

Looks into the sdist, installs the wheel into a fresh environment outside the checkout, and there runs the command, the
demo and a small part of the tests. Ends with exit code 1 where something is wrong.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
import tarfile
import tempfile
import venv
import zipfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
MOST_BYTES = 5_000_000
# What must be in an sdist, and what a checkout may hold beside it.
WANTED = ("README.md", "LICENSE", "CITATION.cff", "pyproject.toml", "beltrami_cli/__init__.py", "tests/conftest.py")
UNWANTED = (".venv/", "demo_out/", "docs/_build/", "configs/data/", "configs/output/", "dist/", "__pycache__/", "logs/")
KEPT = {"configs/data/.gitignore", "configs/output/.gitignore"}
# Of the tests: those of the phantoms, of whole runs from Python, and of files in every format.
TESTS = ("conftest.py", "command.py", "twins.py", "test_phantoms.py", "test_api.py", "test_grid.py", "test_formats.py")


def main(folder: Path) -> None:
    (sdist,), (wheel,) = folder.glob("*.tar.gz"), folder.glob("*.whl")
    check_names(sdist, wheel)
    with tempfile.TemporaryDirectory(prefix="beltrami-dist-", ignore_cleanup_errors=True) as scratch:
        check_installed(wheel, Path(scratch))
    print(f"check_dist: {sdist.name} and {wheel.name} are fit to be released")


def check_names(sdist: Path, wheel: Path) -> None:
    """The right files are in the archives, and no others."""
    with tarfile.open(sdist) as archive:
        names = {member.name.partition("/")[2] for member in archive.getmembers() if member.isfile()}
    missing = [name for name in WANTED if name not in names]
    strays = sorted(name for name in names - KEPT if any(part in name for part in UNWANTED))
    if missing or strays:
        sys.exit(f"check_dist: {sdist.name}: missing {missing}, not wanted {strays}")
    for path in (sdist, wheel):
        if path.stat().st_size > MOST_BYTES:
            sys.exit(f"check_dist: {path.name}: found {path.stat().st_size} bytes, expected {MOST_BYTES} at most")
    files = {str(path.relative_to(ROOT).as_posix()) for path in (ROOT / "beltrami_cli").rglob("*") if path.is_file()}
    wanted = {name for name in files if "__pycache__" not in name}
    packed = {name for name in zipfile.ZipFile(wheel).namelist() if ".dist-info/" not in name}
    if packed != wanted:
        sys.exit(f"check_dist: {wheel.name}: not the package's files: {sorted(packed ^ wanted)}")


def check_installed(wheel: Path, scratch: Path) -> None:
    """The wheel works where there is nothing else, not even the checkout."""
    home = scratch / "venv"
    venv.create(home, with_pip=True)
    programs = home / ("Scripts" if os.name == "nt" else "bin")
    python, beltrami = (programs / name for name in ("python", "beltrami"))

    def run(*command: object) -> str:
        # Neither a checkout on PYTHONPATH nor kernels compiled elsewhere.
        environment = {k: v for k, v in os.environ.items() if k not in ("PYTHONPATH", "NUMBA_CACHE_DIR")}
        done = subprocess.run(
            [str(word) for word in command], cwd=scratch, env=environment, text=True, stdout=subprocess.PIPE
        )
        if done.returncode:
            sys.exit(f"check_dist: exit code {done.returncode}: {' '.join(map(str, command))}\n{done.stdout}")
        return done.stdout

    pip = (python, "-m", "pip", "install", "--quiet", "--disable-pip-version-check")
    run(*pip, f"{wheel.resolve()}[report]")
    print(run(beltrami, "--version").strip())
    print(run(beltrami, "demo", "demo_out").strip())
    for name in ("denoised.nii.gz", "denoised.ply", "denoised.png", "denoised.json"):
        if not (scratch / "demo_out" / name).stat().st_size:
            sys.exit(f"check_dist: demo_out/{name} is empty")
    run(*pip, "pytest", "hypothesis")
    tests = scratch / "tests"
    tests.mkdir()
    for name in TESTS:
        shutil.copy(ROOT / "tests" / name, tests)
    where = run(python, "-c", "import beltrami_cli; print(beltrami_cli.__file__)").strip()
    if not Path(where).is_relative_to(home.resolve()):
        sys.exit(f"check_dist: the tests would test {where}, not the wheel")
    print(
        run(python, "-X", "utf8", "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", "tests")
        .strip()
        .splitlines()[-1]
    )


if __name__ == "__main__":
    main(Path(sys.argv[1]))
