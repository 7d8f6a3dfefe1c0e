"""The estimate of a run's peak memory over what runs, each in a process of its own, took: for many kinds of job.

Words select the cases whose names hold one of them. To measure the constants of beltrami_cli/memory.py anew, compare
cases that differ in one thing only: size, half-width, channels, precision, format.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import nibabel as nib
import numpy as np
from common import BELTRAMI, folded_surface

from beltrami_cli import memory
from beltrami_cli.config import make_job, read_config
from beltrami_cli.phantoms import portrait, torus

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "data"
TOLERATED = (0.9, 1.7)
VECTOR, FRAMES = {"kind": "vector"}, {"kind": "vector", "independent": True}
FEW = {"time": {"iterations": 5}, "flow": {"beta": 0.02}}

Tables = dict[str, dict[str, Any]]
Case = tuple[str, Tables]


def main() -> None:
    words = sys.argv[1:]
    ratios = []
    print(f"{'case':40}{'voxels':>10}{'entries':>9}{'vertices':>9}{'estimate':>10}{'peak, MiB':>10}{'ratio':>7}")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for case, tables in cases(folder):
            if words and not any(word in case for word in words):
                continue
            estimate, record = measured(folder, tables)
            ratios.append(estimate / record["PeakMemoryMiB"])
            band, voxels = record["Band"], np.prod(record["Grid"]["shape"])
            print(
                f"{case:40}{voxels:10}{band['entries']:9}{band['surface_vertices']:9}{estimate:10.0f}"
                f"{record['PeakMemoryMiB']:10.0f}{ratios[-1]:7.2f}"
                f"{'' if TOLERATED[0] <= ratios[-1] <= TOLERATED[1] else '  out of bounds'}",
                flush=True,
            )
    print(f"estimate over peak: {min(ratios):.2f} to {max(ratios):.2f}; to be {TOLERATED[0]} to {TOLERATED[1]}")


def measured(folder: Path, tables: Tables) -> tuple[float, dict[str, Any]]:
    """The estimate in MiB, and the record of the run."""
    tables = {**tables, "output": {"volume": "out.nii.gz", "overwrite": True, **tables.get("output", {})}}
    config = folder / "case.toml"
    config.write_text("\n".join(f"[{name}]\n{_lines(table)}" for name, table in tables.items()))
    estimate = memory.needed(make_job(read_config(config))) / 2**20
    run(folder, "denoise", "--config", config)
    return estimate, json.loads(next(folder.glob("out*.json")).read_text())


def run(folder: Path, *arguments: object) -> None:
    for old in folder.glob("out*"):
        old.unlink()
    subprocess.run([str(BELTRAMI), *map(str, arguments), "-q"], cwd=folder, check=True, stderr=subprocess.DEVNULL)


def _lines(table: dict[str, Any]) -> str:
    return "\n".join(f"{key} = {json.dumps(value)}" for key, value in table.items())


def cases(folder: Path) -> Iterator[Case]:
    yield from scalar(folder)
    yield from channels(folder)
    yield from as_they_come(folder)
    yield from planes_and_flat(folder)
    yield from meshes(folder)
    yield from segmentations(folder)
    yield from reports(folder)
    if SHARED.is_dir():
        yield from cortices(folder)


def scalar(folder: Path) -> Iterator[Case]:
    sample = ROOT / "sample_data" / "torus"
    yield "sample torus", {"input": {"levelset": f"{sample}/levelset.nii.gz", "data": f"{sample}/noisy.nii.gz"}}
    for size in (40, 64, 96, 128, 160, 224):
        phantom = torus(size)
        files = written(folder, f"{size}.nii.gz", psi=phantom.levelset, data=phantom.noisy)
        yield f"torus {size}", {"input": files, **FEW}
        if size == 64:
            yield "torus 64, flow auto, stop auto", {"input": files, "flow": {"name": "auto"}, "time": {"stop": "auto"}}
        if size not in (96, 160):
            continue
        yield f"torus {size}, beta auto", {"input": files}
        yield f"torus {size}, float64", {"input": files, **FEW, "output": {"precision": "float64"}}
        yield f"torus {size}, discrepancy", {"input": files, "time": {"stop": "discrepancy"}}
        yield f"torus {size}, fidelity", {"input": files, **FEW, "flow": {"beta": 0.02, "fidelity": 0.1}}
        yield f"torus {size}, depth, half-width 8", {"input": files, **FEW, "band": {"depth": [-6, 6], "half_width": 8}}
        yield f"torus {size}, pde", {"input": files, **FEW, "band": {"extension": "pde"}}
        trust = written(folder, f"trust{size}.nii.gz", weights=np.abs(phantom.noisy), mask=phantom.noisy > 0)
        yield f"torus {size}, weights and mask", {"input": {**files, **trust}, **FEW}
        yield f"torus {size}, circular", {"input": files, **FEW, "values": {"kind": "circular", "period": 360}}
        for suffix in ("npy", "mha", "mgz"):
            out = {"volume": f"out.{suffix}"}
            if suffix == "npy":
                np.save(folder / "psi.npy", phantom.levelset)
                np.save(folder / "data.npy", phantom.noisy)
                yield f"torus {size}, {suffix}", {
                    "input": {"levelset": "psi.npy", "data": "data.npy"}, "output": out, **FEW
                }  # fmt: skip
            else:
                yield f"torus {size}, to {suffix}", {"input": files, "output": out, **FEW}
    around = ((48, 48),) * 3
    padded = np.pad(torus(96).levelset, around, mode="edge"), np.pad(torus(96).noisy, around)
    files = written(folder, "padded.nii.gz", **dict(zip(("psi", "data"), padded, strict=True)))
    yield "torus 96 in 192", {"input": files, **FEW}
    x = np.indices((192,) * 3, np.float32) - 95.5
    ball = np.sqrt((x**2).sum(0)) - 92
    files = written(folder, "ball.nii.gz", psi=ball, data=x[0])
    yield "ball that fills 192", {"input": files, **FEW}
    files = written(folder, "folded.nii.gz", **dict(zip(("psi", "data"), folded_surface(), strict=True)))
    yield "folded surface", {"input": files, **FEW}
    yield "folded surface, beta auto", {"input": files}
    yield "folded surface, float64", {"input": files, **FEW, "output": {"precision": "float64"}}


def reports(folder: Path) -> Iterator[Case]:
    """Runs that draw a picture at their end."""
    for name, (psi, data) in {
        "torus 64": (torus(64).levelset, torus(64).noisy),
        "torus 160": (torus(160).levelset, torus(160).noisy),
        "folded surface": folded_surface(),
    }.items():
        files = written(folder, "shown.nii.gz", psi=psi, data=data)
        for suffix in ("png", "html"):
            yield f"{name}, report {suffix}", {"input": files, **FEW, "output": {"report": f"out.{suffix}"}}


def channels(folder: Path) -> Iterator[Case]:
    for size, count in ((64, 3), (64, 20), (96, 20), (128, 3), (128, 20), (160, 20)):
        phantom = torus(size)
        frames = phantom.noisy[..., None] + np.arange(count, dtype=np.float32)
        files = written(folder, "channels.nii.gz", psi=phantom.levelset, data=frames)
        yield f"torus {size}, vector of {count}", {"input": files, **FEW, "values": VECTOR}
        yield f"torus {size}, {count} frames", {"input": files, **FEW, "values": FRAMES}
        if count == 3 and size == 64:
            yield f"torus {size}, vector of {count}, beta auto", {"input": files, "values": VECTOR}
        if size == 128 and count == 20:
            yield f"torus {size}, vector of {count}, l2", {"input": files, "flow": {"name": "l2"}, "values": VECTOR}
            for suffix in ("mha", "mgz", "npy"):
                yield f"torus {size}, {count} frames to {suffix}", {
                    "input": files, **FEW, "values": FRAMES, "output": {"volume": f"out.{suffix}"}
                }  # fmt: skip


def as_they_come(folder: Path) -> Iterator[Case]:
    """Data stored in other types, and on other grids."""
    phantom, coarse = torus(96), np.diag([1.5, 1.5, 1.5, 1.0])
    files = written(folder, "96.nii.gz", psi=phantom.levelset, data=phantom.noisy)
    frames = phantom.noisy[..., None] + np.arange(20)
    nib.save(nib.Nifti1Image(frames, np.eye(4)), folder / "float64.nii.gz")
    yield "torus 96, vector of 20 stored as float64", {
        "input": {**files, "data": "float64.nii.gz"}, **FEW, "values": VECTOR
    }  # fmt: skip
    scaled = nib.Nifti1Image(frames, np.eye(4))
    scaled.set_data_dtype(np.int16)
    nib.save(scaled, folder / "int16.nii.gz")
    yield "torus 96, vector of 20 stored as int16", {
        "input": {**files, "data": "int16.nii.gz"}, **FEW, "values": VECTOR
    }  # fmt: skip
    nib.save(nib.Nifti1Image((phantom.noisy + 1j).astype(np.complex64), np.eye(4)), folder / "complex.nii.gz")
    yield "torus 96, complex", {"input": {**files, "data": "complex.nii.gz"}, **FEW, "values": VECTOR}
    other = written(folder, "coarse.nii.gz", affine=coarse, data=torus(64).noisy)
    yield "torus 96, resampled", {"input": {**files, **other, "resample": True}, **FEW}
    frames = torus(64).noisy[..., None] + np.arange(20)
    other = written(folder, "frames.nii.gz", affine=coarse, data=frames)
    yield "torus 96, vector of 20, resampled", {"input": {**files, **other, "resample": True}, **FEW, "values": VECTOR}
    yield "torus 96, 20 frames, resampled", {"input": {**files, **other, "resample": True}, **FEW, "values": FRAMES}
    mask = written(folder, "mask_of_96.nii.gz", psi=phantom.levelset < 0)
    other = written(folder, "coarse.nii.gz", affine=coarse, data=torus(64).noisy)
    yield "mask of 96 on a grid of its own", {"input": {**mask, **other}, **FEW}


def planes_and_flat(folder: Path) -> Iterator[Case]:
    sample = ROOT / "sample_data" / "curve"
    yield "sample curve", {
        "input": {"levelset": f"{sample}/levelset.npy", "data": f"{sample}/noisy.npy"}, "output": {"volume": "out.npy"}
    }  # fmt: skip
    noise = np.random.default_rng(0).normal(50, 10, (2000, 1500)).astype(np.float32)
    np.save(folder / "image.npy", noise)
    flat = {**FEW, "flow": {"beta": 0.02, "flat": True}}
    yield "flat 2000 x 1500", {"input": {"data": "image.npy"}, "output": {"volume": "out.npy"}, **flat}
    for size in (64, 128, 192, 256):
        volume = np.random.default_rng(0).normal(50, 10, (size,) * 3)
        data = written(folder, "flat.nii.gz", data=volume)
        yield f"flat {size}^3", {"input": data, **flat}
        if size == 64:
            yield f"flat {size}^3, beta auto", {"input": data, "flow": {"flat": True}}


def meshes(folder: Path) -> Iterator[Case]:
    for size in (64, 128):
        phantom = torus(size)
        files = written(folder, f"mesh{size}.nii.gz", psi=phantom.levelset, data=phantom.noisy)
        run(folder, "mesh", files["levelset"], "-o", f"{size}.surf.gii", "--overwrite")
        run(folder, "sample", files["data"], f"{size}.surf.gii", "-o", f"{size}.func.gii", "--overwrite")
        yield f"mesh of torus {size}, volume", {"input": {**files, "levelset": f"{size}.surf.gii"}, **FEW}
        on_it = {"levelset": f"{size}.surf.gii", "data": f"{size}.func.gii"}
        out = {"volume": "out.func.gii"}
        yield f"mesh of torus {size}, vertices", {"input": on_it, "output": out, **FEW}
        yield f"mesh of torus {size}, vertices, beta auto", {"input": on_it, "output": out}
        sheet = nib.load(folder / f"{size}.func.gii")
        sheet.darrays = sheet.darrays * 20
        nib.save(sheet, folder / f"{size}.20.func.gii")
        for kind, values in (("a vector of", VECTOR), ("frames:", FRAMES)):
            yield f"mesh of torus {size}, vertices, {kind} 20", {
                "input": {**on_it, "data": f"{size}.20.func.gii"}, "output": out, **FEW, "values": values
            }  # fmt: skip
        on = {"on": [f"{size}.surf.gii=out.{k}.func.gii" for k in range(4)], "mesh": False}
        yield f"torus {size}, on 4 surfaces", {"input": files, "output": on, **FEW}


def segmentations(folder: Path) -> Iterator[Case]:
    for size in (64, 128, 192):
        phantom = portrait(size)
        files = written(folder, "mask.nii.gz", psi=phantom.levelset < 0, data=phantom.noisy)
        yield f"mask {size}", {"input": files, **FEW}
    labels = 1 + (np.abs(phantom.levelset) < 4) * 1 + (phantom.levelset >= 4) * 2
    files = written(folder, "labels.nii.gz", psi=labels, data=phantom.noisy)
    yield f"labels {size}, between", {"input": {**files, "between": "1,3"}, **FEW}


def cortices(folder: Path) -> Iterator[Case]:
    s1, retino, lo = (SHARED / name for name in ("s1_individual", "retino_fsaverage", "laynii_lo"))
    files = {"levelset": f"{s1}/psi.nii.gz", "data": f"{s1}/epi_intensity.nii.gz"}
    yield "s1", {"input": files, **FEW}
    yield "s1, beta auto", {"input": files}
    yield "s1, mesh, volume", {"input": {**files, "levelset": f"{s1}/lh.mid.crop.surf.gii"}, **FEW}
    on_it = {"levelset": f"{s1}/lh.mid.crop.surf.gii", "data": f"{s1}/lh.crop.func.gii"}
    yield "s1, mesh, vertices", {"input": {**on_it, "map": "1"}, "output": {"volume": "out.func.gii"}, **FEW}
    files = {"levelset": f"{retino}/psi.nii.gz", "data": f"{retino}/angle_noisy_voxel_s0.6.nii.gz"}
    circular = {"kind": "circular", "period": 360}
    yield "retino", {"input": files, "values": circular, **FEW}
    yield "retino, stop auto", {"input": files, "values": circular, "time": {"stop": "auto"}}
    files = {"levelset": f"{lo}/derived_psi_midlayer.nii.gz", "data": f"{lo}/lo_BOLD_act.nii.gz"}
    yield "laynii, thin slab", {"input": files, **FEW}
    rim = SHARED / "laynii_ding2016" / "Ding2016_occip_rim.nii.gz"
    shape = nib.load(rim).shape
    data = np.random.default_rng(0).normal(50, 10, shape)
    files = written(folder, "rim.nii.gz", affine=nib.load(rim).affine, data=data)
    yield "laynii rim, between", {"input": {**files, "levelset": str(rim), "between": "2,1"}, **FEW}
    yield "laynii rim, labels", {"input": {**files, "levelset": str(rim), "labels": "2"}, **FEW}


def written(folder: Path, name: str, affine: np.ndarray | None = None, **arrays: np.ndarray) -> dict[str, str]:
    """The arrays as float32 NIfTI files; returns the table [input] that names them."""
    for role, array in arrays.items():
        image = nib.Nifti1Image(array.astype(np.float32), np.eye(4) if affine is None else affine)
        nib.save(image, folder / f"{role}.{name}")
    return {{"psi": "levelset"}.get(role, role): f"{role}.{name}" for role in arrays}


if __name__ == "__main__":
    main()
