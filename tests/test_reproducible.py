"""The same inputs and parameters give the same bytes: on any number of threads, in any process, after any other run."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
import pytest
from command import done

# What may differ in a sidecar: when, how fast and on how many threads a run was made.
OF_THE_RUN = {"Created", "Seconds", "PeakMemoryMiB", "threads"}

# Runs in a process of its own every command of a JSON object, each in a folder of its name.
DRIVER = """
import json, os, pathlib, sys
from beltrami_cli.cli import main
start = pathlib.Path.cwd()
for name, command in json.load(sys.stdin).items():
    pathlib.Path(name).mkdir()
    os.chdir(name)
    assert main(command) == 0, name
    os.chdir(start)
"""

# Commands by name, run in out/NAME; T and N are the level set and the data of a torus.
T, N = "../../torus/levelset.nii.gz", "../../torus/noisy.nii.gz"
ANGLE = ("../../angle/levelset.nii.gz", "../../angle/noisy.nii.gz")
RGB = ("../../rgb/levelset.nii.gz", "../../rgb/noisy.nii.gz")
MESHES = [part for kind in ("ply", "surf.gii", "vtk", "obj", "stl", "glb") for part in ("--mesh", f"o.{kind}")]
FLOWS: dict[str, list[str]] = {
    "beltrami": ["denoise", T, N, "-o", "o.nii.gz", *MESHES],
    "paper": ["denoise", T, N, "-o", "o.nii.gz", "--scheme", "paper", "--beta", "0.05", "--stop", "discrepancy"],
    "all": ["denoise", T, N, "-o", "o.nii.gz", "--flow", "auto", "--stop", "auto"],
    "l1": ["denoise", T, N, "-o", "o.nii.gz", "--flow", "l1", "--no-mesh"],
    "tv": ["denoise", T, N, "-o", "o.nii.gz", "--flow", "tv", "--stop", "decorrelation", "--precision", "float64"],
    "phi": ["denoise", T, N, "-o", "o.nii.gz", "--flow", "phi", "--phi", "weickert", "--beta", "0.02:0.1:geometric"],
    "circular": ["denoise", *ANGLE, "-o", "o.nii.gz", "--kind", "circular", "--period", "360"],
    "vector": ["denoise", *RGB, "-o", "o.nii.gz", "--kind", "vector", "--beta", "0.02"],
    "series": ["denoise", *RGB, "-o", "o.nii.gz", "--kind", "vector", "--independent"],
    "holes": [
        "denoise", T, "../../holes.nii.gz", "-o", "o.nii.gz", "--filled", "filled.nii.gz", "--fill", "3",
        "--weights", "../../weights.nii.gz", "--mask", "../../weights.nii.gz", "--depth=-1.5:1.5", "--fidelity", "0.1",
    ],
    "pde": ["denoise", T, "../../holes.nii.gz", "-o", "o.nii.gz", "--extension", "pde", "--beta", "0.05"],
    "none": ["denoise", T, "../../holes.nii.gz", "-o", "o.nii.gz", "--extension", "none", "--beta", "0.05"],
    "curve": ["denoise", "../../curve/levelset.npy", "../../curve/noisy.npy", "-o", "o.npy"],
    "banks": ["denoise", "../../sulcus/levelset.mha", "../../sulcus/noisy.mha", "-o", "o.mha"],
    "flat": ["denoise", "--flat", N, "-o", "o.mgz", "--beta", "0.05"],
    # So many places are held out that BLAS would sum over them on several threads.
    "large": ["denoise", "../../large/levelset.npy", "../../large/noisy.npy", "-o", "o.npy", "--no-mesh"],
}  # fmt: skip
SURFACES: dict[str, list[str]] = {
    "between": ["denoise", "../../rim.nii.gz", N, "-o", "o.nii.gz", "--between", "2,1", "--beta", "0.05"],
    "mesh": ["denoise", "../../lh.surf.gii", N, "-o", "o.nii.gz", "--on", "../../lh.surf.gii=on.mgz", "--beta", "0.05"],
    "vertices": ["denoise", "../../lh.surf.gii", "../../lh.func.gii", "-o", "o.func.gii"],
    "freesurfer": ["denoise", "../../lh.surf.gii", "../../lh.func.gii", "-o", "lh.out", "--flow", "l2"],
    "of_labels": ["levelset", "../../rim.nii.gz", "-o", "psi.mha", "--labels", "2"],
    "of_mesh": ["levelset", "../../lh.surf.gii", "-o", "psi.nii.gz"],
    "sample": ["sample", "../../angle/noisy.nii.gz", "../../lh.surf.gii", "-o", "o.func.gii"],
    "bare_mesh": ["mesh", T, N, "-o", "o.glb"],
    "phantom": ["phantom", "portrait", ".", "--map", "rgb", "--size", "24"],
}
CASES = FLOWS | SURFACES


@pytest.fixture(scope="module")
def inputs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("inputs")
    for name, *options in (
        ("torus", "--size", 40),
        ("curve", "--size", 96, "--format", "npy"),
        ("sulcus", "--size", 32, "--format", "mha"),
    ):
        done("phantom", name, folder / name, *options, "-q")
    done("phantom", "torus", folder / "angle", "--map", "angle", "--size", 40, "-q")
    done("phantom", "portrait", folder / "rgb", "--map", "rgb", "--size", 24, "-q")
    done("phantom", "torus", folder / "large", "--size", 96, "--format", "npy", "-q")
    torus, noisy = nib.load(folder / "torus" / "levelset.nii.gz"), nib.load(folder / "torus" / "noisy.nii.gz")
    psi, data = torus.get_fdata(), noisy.get_fdata().astype(np.float32)

    def save(name: str, values: np.ndarray) -> None:
        nib.save(nib.Nifti1Image(values, torus.affine), folder / name)

    save("rim.nii.gz", np.where(psi < -2, 2, np.where(psi < 1.5, 3, 1)).astype(np.int16))
    save("weights.nii.gz", np.random.default_rng(1).random(psi.shape).astype(np.float32))
    x = np.indices(psi.shape) - np.array([28, 20, 20]).reshape(3, 1, 1, 1)
    save("holes.nii.gz", np.where((x**2).sum(0) < 40, np.nan, data))
    done("mesh", folder / "torus" / "levelset.nii.gz", folder / "torus" / "noisy.nii.gz", "-o", folder / "lh.surf.gii")
    return folder


def ran(folder: Path, cases: Mapping[str, list[str]], threads: int, **environment: object) -> dict[str, str]:
    """Digests of what the cases leave when run, one after another, in a process of their own in a new folder."""
    folder.mkdir()
    told = {name: on_threads(case, threads) for name, case in cases.items()}
    set_to = {"NUMBA_NUM_THREADS": 4, "OPENBLAS_NUM_THREADS": threads, "OMP_NUM_THREADS": threads, **environment}
    run = subprocess.run(
        [sys.executable, "-c", DRIVER],
        input=json.dumps(told),
        env={**os.environ, **{name: str(value) for name, value in set_to.items()}},
        cwd=folder,
        capture_output=True,
        text=True,
    )
    assert (run.returncode, run.stderr) == (0, "")
    return digests(folder, cases)


def on_threads(case: list[str], threads: int) -> list[str]:
    """The command told how many threads to use, where it has an option for it, and to be quiet."""
    return [*case, "-q", *(["--threads", str(threads)] if case[0] == "denoise" else [])]


def digests(folder: Path, names: Iterable[str]) -> dict[str, str]:
    """SHA-256 of every file in these folders within; of a sidecar, of what is not about the run itself."""
    files = sorted(path for name in names for path in (folder / name).rglob("*") if path.is_file())
    return {str(path.relative_to(folder)): hashlib.sha256(lasting(path, folder)).hexdigest() for path in files}


def lasting(path: Path, folder: Path) -> bytes:
    """What a file holds; of a sidecar without what is about the run itself, as the folder that it was made in."""
    if path.suffix != ".json":
        return path.read_bytes()
    record = without_the_run(json.loads(path.read_text()))
    return json.dumps(record).replace(str(folder), "FOLDER").encode()


def without_the_run(record: Any) -> Any:
    if isinstance(record, dict):
        return {name: without_the_run(value) for name, value in record.items() if name not in OF_THE_RUN}
    return [without_the_run(value) for value in record] if isinstance(record, list) else record


def different(first: dict[str, str], second: dict[str, str]) -> list[str]:
    return sorted(name for name in first.keys() | second.keys() if first.get(name) != second.get(name))


@pytest.mark.slow
def test_threads_hashes_and_the_order_of_runs_leave_no_trace(inputs):
    one = ran(inputs / "one", CASES, 1, PYTHONHASHSEED=1)
    assert len(one) > 2.5 * len(CASES)
    two = ran(inputs / "two", dict(reversed(FLOWS.items())), 2, PYTHONHASHSEED=2)
    assert different({name: digest for name, digest in one.items() if name.split("/")[0] in FLOWS}, two) == []
    four = ran(inputs / "four", dict(sorted(CASES.items())), 4, PYTHONHASHSEED=3)
    assert different(one, four) == []


@pytest.mark.parametrize("layer", ["workqueue", "omp"])
def test_layers_of_threads_agree(inputs, layer):
    """numba takes the first layer that it finds on a machine."""
    few = {name: FLOWS[name] for name in ("beltrami", "holes")}
    if not (inputs / "default").exists():
        ran(inputs / "default", few, 2)
    try:
        found = ran(inputs / layer, few, 3, NUMBA_THREADING_LAYER=layer)
    except AssertionError as error:
        if "No threading layer" in str(error):
            pytest.skip(f"numba has no {layer} here")
        raise
    assert different(digests(inputs / "default", few), found) == []


def test_a_run_is_the_same_after_others_and_at_another_time(inputs, monkeypatch):
    """One process: each case twice, others and more than a second, in which file formats count time, between them."""
    names = ("beltrami", "series", "holes", "flat", "banks", "vertices", "freesurfer", "of_labels")
    found = []
    for turn, order, threads in (("once", names, 1), ("again", names[::-1], 2)):
        began = time.monotonic()
        for name in order:
            folder = inputs / turn / name
            folder.mkdir(parents=True)
            monkeypatch.chdir(folder)
            done(*on_threads(CASES[name], threads))
        found.append(digests(inputs / turn, names))
        time.sleep(max(0.0, 1.1 - (time.monotonic() - began)))
    assert different(*found) == []


@pytest.mark.slow
def test_a_real_cortex(shared_data, tmp_path):
    """beta chosen by the data, on folds whose banks touch."""
    psi, angle = (shared_data / "retino_fsaverage" / name for name in ("psi.nii.gz", "angle_noisy_voxel_s0.6.nii.gz"))
    cases = {"angle": ["denoise", str(psi), str(angle), "-o", "o.nii.gz", "--kind", "circular", "--period", "360"]}
    assert different(ran(tmp_path / "one", cases, 1), ran(tmp_path / "two", cases, 2)) == []
