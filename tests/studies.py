"""Small studies on disk, `beltrami batch` on them as a process, and what it left behind."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import psutil
from command import ball, nifti, noisy

from beltrami_cli.executors import Workers

# What a sidecar says of the machine and the hour, not of the result.
PASSING = ("Created", "Seconds", "PeakMemoryMiB")


class Here(Workers):
    """Runs each job in this process, at once."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        return future


def write_study(
    folder: Path,
    count: int,
    *,
    volume: str = "out/{k}.nii.gz",
    size: int = 16,
    iterations: int = 5,
    more: str = "[run]\nthreads = 1\n",
) -> Path:
    """A config of `count` jobs, k = 1, 2 ...: one ball of `size` voxels, noise of its own for each job.

    volume: of the output. more: sections of the config.
    """
    folder.mkdir(parents=True, exist_ok=True)
    nifti(folder / "psi.nii.gz", ball((size,) * 3, size / 3))
    for k in range(1, count + 1):
        nifti(folder / f"data-{k}.nii.gz", noisy((size,) * 3, seed=k))
    config = folder / "study.toml"
    config.write_text(
        f"[for_each]\nk = {list(range(1, count + 1))}\n"
        '[input]\nlevelset = "psi.nii.gz"\ndata = "data-{k}.nii.gz"\n'
        f'[output]\nvolume = "{volume}"\n'
        f"[flow]\nbeta = 0.1\n[time]\niterations = {iterations}\n{more}"
    )
    return config


def start(*arguments: object, **options: Any) -> subprocess.Popen[str]:
    """The command in a session of its own, whose number is its process id."""
    command = [sys.executable, "-m", "beltrami_cli", *map(str, arguments)]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | options
    return subprocess.Popen(command, text=True, start_new_session=True, **pipes)


def finish(process: subprocess.Popen[str], code: int = 0, timeout: float = 120) -> tuple[str, str]:
    """What the process said, on stdout and stderr, once it has ended with this exit code."""
    out, err = process.communicate(timeout=timeout)
    assert process.returncode == code, (process.returncode, out, err)
    return out, err


def batch(*arguments: object, code: int = 0) -> tuple[str, str]:
    """`beltrami batch` in a process of its own, to its end with this exit code; stdout and stderr."""
    return finish(start("batch", *arguments), code)


def members(session: int) -> list[int]:
    """The living processes of a session."""
    alive = []
    for process in psutil.process_iter(["status"]):
        with suppress(OSError, psutil.Error):
            if os.getsid(process.pid) == session and process.info["status"] != psutil.STATUS_ZOMBIE:
                alive.append(process.pid)
    return alive


def wait_for(condition: Callable[[], Any], seconds: float = 60) -> Any:
    """What the condition gives once that is true; fails where it does not come true within `seconds`."""
    end = time.monotonic() + seconds
    while not (found := condition()):
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.002)
    return found


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[Path]:
    """A disk of its own at `folder`; pytest skips where it cannot be had."""
    import pytest

    folder.mkdir(exist_ok=True)
    try:
        subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={size}", "tmpfs", str(folder)], check=True, capture_output=True
        )
    except (OSError, subprocess.CalledProcessError):
        pytest.skip("a small disk cannot be mounted here")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


def essence(folder: Path) -> dict[str, str]:
    """Every path in a folder, hidden ones too, with a digest of what it holds, of sidecars without what passes."""
    return {
        str(path.relative_to(folder)): "" if path.is_dir() else digest(path.name, path.read_bytes())
        for path in folder.rglob("*")
    }


def digest(name: str, content: bytes) -> str:
    if name.endswith(".json"):
        record = {key: value for key, value in json.loads(content).items() if key not in PASSING}
        content = json.dumps(record, sort_keys=True).encode()
    return hashlib.sha256(content).hexdigest()
