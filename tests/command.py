"""The command run in this process, small scenes on disk for it, and what it left behind."""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np

from beltrami_cli.cli import main


@dataclass(frozen=True)
class Run:
    code: int
    out: str
    err: str

    @property
    def message(self) -> str:
        """The one line that says what went wrong, without the usage line before it and the two grids after it."""
        lines = [line for line in self.err.splitlines() if not line.startswith(("Usage:", "  "))]
        assert len(lines) == 1, self.err
        return lines[0].removeprefix("beltrami: ")


def beltrami(*arguments: object) -> Run:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        code = main([str(argument) for argument in arguments])
    return Run(code, out.getvalue(), err.getvalue())


def done(*arguments: object) -> Run:
    """A run that must succeed without a word on stderr."""
    run = beltrami(*arguments)
    assert (run.code, run.err) == (0, "")
    return run


def refused(*arguments: object, code: int = 2) -> str:
    """The message of a run that must fail with this exit code and say nothing on stdout."""
    run = beltrami(*arguments)
    assert (run.code, run.out) == (code, "")
    assert "Traceback" not in run.err
    return run.message


def contents(folder: Path) -> dict[str, str]:
    """Every path in a folder, hidden ones too, with a digest of what it holds."""
    return {
        str(path.relative_to(folder)): "" if path.is_dir() else hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
    }


def ball(
    shape: tuple[int, ...] = (16, 16, 16), radius: float = 5.0, centre: Iterable[float] | None = None
) -> np.ndarray:
    """Signed distance to a sphere (a circle in two axes), in voxels, float32; its centre lies off the grid."""
    middle = [(n - 1) / 2 + 0.137 for n in shape] if centre is None else list(centre)
    x = np.indices(shape) - np.array(middle).reshape(-1, *[1] * len(shape))
    return (np.sqrt((x**2).sum(0)) - radius).astype(np.float32)


def noisy(shape: tuple[int, ...] = (16, 16, 16), mean: float = 50.0, sigma: float = 10.0, seed: int = 0) -> np.ndarray:
    return (mean + sigma * np.random.default_rng(seed).standard_normal(shape)).astype(np.float32)


def nifti(path: Path, array: np.ndarray, affine: np.ndarray | None = None) -> Path:
    nib.save(nib.Nifti1Image(array, np.eye(4) if affine is None else affine), path)
    return path


def npy(path: Path, array: np.ndarray) -> Path:
    np.save(path, array)
    return path


def load(path: Path) -> np.ndarray:
    """The values of a volume, read without the package."""
    return np.load(path) if path.suffix == ".npy" else np.asanyarray(nib.load(path).dataobj)


def record(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text())


def seen(path: Path) -> np.ndarray:
    """The finite values of a volume."""
    values = load(path)
    return values[np.isfinite(values)]
