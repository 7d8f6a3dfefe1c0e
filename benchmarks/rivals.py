"""Connectome Workbench's best geodesic Gaussian, over ways to sample and widths, on the noisy cortex; --tool: ours too.

python benchmarks/rivals.py [--tool] [--seed N] [CASE ...]; needs wb_command and the real volumes of ../shared/data.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import nibabel as nib
import numpy as np
from common import BELTRAMI
from cortex_cases import DATA, Case, angle_cases, patch_case

from beltrami_cli.formats import write_volume

SIGMAS = (0.0, 0.5, 0.75, 1.0, 1.25, 1.5, 1.75, 2.0, 2.5, 3.0, 4.0, 6.0, 8.0)  # mm
PAST = 2  # times the best width of every sampling: beyond it scores only fall, and a wide Gaussian takes minutes
SINGLE = {name: (f"-{name}",) for name in ("trilinear", "enclosing", "cubic")}
RIBBONS = {f"ribbon {depth} mm": depth for depth in (1, 2)}  # to either side of the surface
# What is smoothed: data at the scored vertices alone, all data, or all with holes filled from the nearest vertex first.
TREATMENTS = ("region", "fix-zeros", "filled")
LEAST_WEIGHT = 0.1  # share of the weights on valid voxels from which a sample counts as data
REACH = 20  # mm, within which a vertex without a value takes the nearest one's; holes are smaller

TOOL = ("--beta", "auto", "--stop", "auto")
RUNS = {"tool": TOOL, "tool, depth": (*TOOL, "--depth=-2:2")}


@dataclass(frozen=True)
class Found:
    """The best of a sweep: its score, sigma in mm, and how missing values were treated."""

    score: float
    sigma: float
    treatment: str


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--tool", action="store_true", help="run beltrami denoise on each case as well")
    parser.add_argument("--seed", type=int, default=0, help="of the noise and holes of the cases made here")
    parser.add_argument("case", nargs="*", help="names of cases (default: all)")
    given = parser.parse_args()
    if not DATA.is_dir():
        sys.exit(f"the real volumes are not here: expected the folder {DATA}")
    if shutil.which("wb_command") is None:
        sys.exit("wb_command is not on the PATH: install Connectome Workbench")
    for case in [*angle_cases(given.seed), patch_case(given.seed)]:
        if not given.case or case.name in given.case:
            report(case, with_tool=given.tool)


def report(case: Case, *, with_tool: bool) -> None:
    better = "lower" if case.kind.is_circular else "higher"
    print(f"{case.name}: {case.unit}, {better} is better, at {np.isfinite(case.truth).sum()} vertices", flush=True)
    with tempfile.TemporaryDirectory() as name:
        bench = Workbench(case, Path(name))
        for sampling, found in bench.best().items():
            seconds = bench.seconds(sampling, found)
            how = f"sigma {found.sigma:.2f} mm, {found.treatment}"
            print(f"  Workbench, {sampling:12} {found.score:7.2f} in {seconds:5.1f} s: {how}", flush=True)
        if with_tool:
            write_volume(Path(name, "data.nii.gz"), case.volume)
            for label, options in RUNS.items():
                start = time.perf_counter()
                score = tool(case, Path(name), options)
                print(
                    f"  {label:23} {score:7.2f} in {time.perf_counter() - start:5.1f} s: {' '.join(options)}",
                    flush=True,
                )


def tool(case: Case, folder: Path, options: tuple[str, ...]) -> float:
    """The score of `beltrami denoise` with these options on folder/data.nii.gz."""
    kind = ("--kind", "circular", "--period", f"{case.kind.period:g}") if case.kind.is_circular else ()
    files = (case.levelset, folder / "data.nii.gz", "-o", folder / "out.nii.gz", "--mesh", folder / "out.surf.gii")
    subprocess.run([BELTRAMI, "denoise", *files, *kind, *options, "--overwrite", "-q"], check=True)
    return case.score_mesh(folder / "out.surf.gii")


class Workbench:
    """Workbench's mapping and smoothing of one case, on files in a folder. Maps are (columns, V) arrays."""

    def __init__(self, case: Case, folder: Path) -> None:
        self.case = case
        self.folder = folder
        ribbons = {name: ("-ribbon-constrained", *self.shifted(depth)) for name, depth in RIBBONS.items()}
        self.samplings: dict[str, tuple[str | Path, ...]] = {**SINGLE, **ribbons}
        valid = np.isfinite(case.volume.data)
        channels = np.where(valid, case.kind.to_channels(case.volume.data), 0)
        stacked = np.stack([*channels, valid], -1).astype(np.float32)
        nib.save(nib.Nifti1Image(stacked, case.volume.grid.affine), folder / "volume.nii.gz")
        write_maps(folder / "region.func.gii", np.isfinite(case.truth)[None])
        self.maps: dict[str, np.ndarray] = {}
        self.mapping_seconds: dict[str, float] = {}
        for name in self.samplings:
            start = time.perf_counter()
            self.maps[name] = self.mapped(name)
            self.mapping_seconds[name] = time.perf_counter() - start

    def best(self) -> dict[str, Found]:
        """The best score of each sampling over all widths and treatments of missing values."""
        columns = np.concatenate([self.maps[name] for name in self.samplings])
        found: dict[str, Found] = {}
        for sigma in SIGMAS:
            if found and sigma > max(1.0, PAST * max(best.sigma for best in found.values())):
                break
            for treatment in TREATMENTS:
                maps = np.split(self.smoothed(columns, sigma, treatment), len(self.samplings))
                for name, own in zip(self.samplings, maps, strict=True):
                    score = self.case.score(self.case.kind.to_values(own))
                    if name not in found or self.case.better(score, found[name].score):
                        found[name] = Found(score, sigma, treatment)
        return found

    def seconds(self, sampling: str, found: Found) -> float:
        """Of wall time that this one result takes, from the volume on."""
        start = time.perf_counter()
        self.smoothed(self.maps[sampling], found.sigma, found.treatment)
        return self.mapping_seconds[sampling] + time.perf_counter() - start

    def mapped(self, sampling: str) -> np.ndarray:
        """(K, V) channels at the vertices: means over valid voxels, 0 where there are none."""
        out = self.folder / "mapped.func.gii"
        volume, method = self.folder / "volume.nii.gz", self.samplings[sampling]
        run("-volume-to-surface-mapping", volume, self.case.surface, out, *method)
        *channels, weight = read_maps(out)
        return np.where(weight > LEAST_WEIGHT, np.stack(channels) / np.maximum(weight, LEAST_WEIGHT), 0)

    def shifted(self, depth: float) -> tuple[Path, Path]:
        """Files of the surface moved by `depth` mm inwards and outwards along its normals."""
        vertices, triangles = self.case.mesh
        a, b, c = vertices[triangles].swapaxes(0, 1)
        normals = np.zeros_like(vertices)
        for corner in triangles.T:
            np.add.at(normals, corner, np.cross(b - a, c - a))
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        files = self.folder / f"inner{depth}.surf.gii", self.folder / f"outer{depth}.surf.gii"
        for file, offset in zip(files, (-depth, depth), strict=True):
            image = nib.load(self.case.surface)
            image.darrays[0].data = (vertices + offset * normals).astype(np.float32)
            nib.save(image, file)
        return files

    def smoothed(self, maps: np.ndarray, sigma: float, treatment: str) -> np.ndarray:
        """Maps, 0 where there are no data, smoothed by a Gaussian of `sigma` mm; what is 0 then is filled."""
        match treatment:
            case "region":
                region = self.folder / "region.func.gii"
                smooth = self.smooth(maps * read_maps(region), sigma, "-fix-zeros", "-roi", region)
            case "fix-zeros":
                smooth = self.smooth(maps, sigma, "-fix-zeros")
            case _:
                smooth = self.smooth(self.filled(maps), sigma, "-fix-zeros")
        return self.filled(smooth)

    def smooth(self, maps: np.ndarray, sigma: float, *options: str | Path) -> np.ndarray:
        if sigma == 0:
            return maps
        source, out = self.folder / "rough.func.gii", self.folder / "smooth.func.gii"
        write_maps(source, maps)
        run("-metric-smoothing", self.case.surface, source, f"{sigma}", out, *options)
        return read_maps(out)

    def filled(self, maps: np.ndarray) -> np.ndarray:
        """Maps where a vertex of value 0 has the value of the nearest that has one."""
        if maps.all():
            return maps
        source, out = self.folder / "holes.func.gii", self.folder / "filled.func.gii"
        write_maps(source, maps)
        run("-metric-dilate", source, self.case.surface, f"{REACH}", out, "-nearest")
        return read_maps(out)


def run(*arguments: str | Path) -> None:
    subprocess.run(["wb_command", *arguments], check=True)


def read_maps(path: Path) -> np.ndarray:
    return np.stack([array.data for array in nib.load(path).darrays]).astype(float)


def write_maps(path: Path, maps: np.ndarray) -> None:
    arrays = [
        nib.gifti.GiftiDataArray(values.astype(np.float32), "NIFTI_INTENT_NONE", datatype="NIFTI_TYPE_FLOAT32")
        for values in maps
    ]
    nib.save(nib.GiftiImage(darrays=arrays), path)


if __name__ == "__main__":
    main()
