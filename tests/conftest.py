"""Fixtures and settings that all tests share."""

from pathlib import Path

import pytest
from command import ball, nifti, noisy
from hypothesis import settings

from beltrami_cli import report
from beltrami_cli.report.subject import Subject

# The same examples in every run, and no deadline: the first example of a kernel pays for its compilation.
settings.register_profile("deterministic", derandomize=True, deadline=None)
settings.load_profile("deterministic")


@pytest.fixture(autouse=True)
def one_thread(monkeypatch) -> None:
    """Runs in this process take one thread each, unless told otherwise: other tests are on the other cores."""
    monkeypatch.setattr("beltrami_cli.solver.cpus", lambda: 1)


SHARED_DATA = Path(__file__).resolve().parents[2] / "shared" / "data"


@pytest.fixture
def shared_data() -> Path:
    """Folder of real volumes that are not part of the project; the test is skipped where it is absent."""
    if not SHARED_DATA.is_dir():
        pytest.skip("the real volumes are not here")
    return SHARED_DATA


@pytest.fixture
def scene(tmp_path: Path) -> tuple[Path, Path, Path]:
    """LEVELSET, DATA and OUT: a ball of 5 voxels with noise of 10 around 50."""
    return (
        nifti(tmp_path / "psi.nii.gz", ball()),
        nifti(tmp_path / "data.nii.gz", noisy()),
        tmp_path / "out.nii.gz",
    )


@pytest.fixture
def shown(monkeypatch) -> list[Subject]:
    """The subjects of the pictures, which are not drawn."""
    subjects: list[Subject] = []

    def keep(path: Path, subject: Subject) -> None:
        subjects.append(subject)
        path.write_text("drawn")

    monkeypatch.setattr(report, "write", keep)
    return subjects
