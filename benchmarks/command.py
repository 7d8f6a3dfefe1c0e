"""The whole command on a 97 x 222 x 143 NIfTI pair against a bare nibabel script; `beltrami --help` against numpy.

The timed runs give beta: to find it, the tool makes several. What that costs is told apart.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import nibabel as nib
import numpy as np
from common import BELTRAMI, folded_surface

REPEATS = 5
BARE = """
import sys
import nibabel as nib
import numpy as np
psi, data = (nib.load(name) for name in sys.argv[1:3])
psi.get_fdata(dtype=np.float32)
nib.save(nib.Nifti1Image(data.get_fdata(dtype=np.float32), data.affine), sys.argv[3])
"""
FILES = ["psi.nii.gz", "data.nii.gz", "-o", "out.nii.gz", "--mesh", "out.surf.gii"]
DENOISE = [BELTRAMI, "denoise", *FILES, "--overwrite", "-q"]
ONE = [*DENOISE, "--beta", "0.05", "--iterations", "20"]
AUTO = [*DENOISE, "--beta", "auto", "--stop", "auto"]


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file, array in zip(("psi.nii.gz", "data.nii.gz"), folded_surface(), strict=True):
            nib.save(nib.Nifti1Image(array, np.eye(4)), folder / file)
        bare = [sys.executable, "-c", BARE, "psi.nii.gz", "data.nii.gz", "copy.nii.gz"]
        compare(folder, {"nibabel script": bare, "beltrami denoise": ONE}, bound=5.0)
        tell_phases(folder)
        compare(folder, {"nibabel script": bare, "beltrami denoise --band 3": [*ONE, "--band", "3"]}, bound=5.0)
        tell_phases(folder)
        chosen = what_auto_chooses(folder)
        pair = {"what auto chose": chosen, "beltrami denoise --beta auto --stop auto": AUTO}
        compare(folder, pair, bound=12.0, repeats=1)
        tell_phases(folder)
        numpy = [sys.executable, "-c", "import numpy"]
        compare(folder, {"import numpy": numpy, "beltrami --help": [BELTRAMI, "--help"]}, bound=2.5)


def what_auto_chooses(folder: Path) -> list:
    """The command of the one run that the automatic choice ends in."""
    subprocess.run(AUTO, cwd=folder, check=True, stdout=subprocess.DEVNULL)
    record = json.loads((folder / "out.json").read_text())
    choice = record["Choice"]
    tried = sum(row["iterations_tried"] for row in choice["table"])
    print(f"auto tried {len(choice['table'])} betas, {tried} iterations, and chose one of {choice['iterations']}")
    return [*DENOISE, "--beta", f"{choice['beta']!r}", "--iterations", f"{choice['iterations']}"]


def compare(folder: Path, commands: dict[str, list], bound: float, repeats: int = REPEATS) -> None:
    """Print the median seconds of both, run in turns after a first of each to warm up, and their ratio."""
    taken: dict[str, list[float]] = {name: [] for name in commands}
    for _ in range(repeats + 1):
        for name, command in commands.items():
            start = time.perf_counter()
            subprocess.run(command, cwd=folder, check=True, stdout=subprocess.DEVNULL)
            taken[name].append(time.perf_counter() - start)
    (base, reference), (name, own) = ((name, np.median(times[1:])) for name, times in taken.items())
    print(f"{base} {reference:.3f} s, {name} {own:.3f} s: {own / reference:.2f} times (bound {bound:g})")


def tell_phases(folder: Path) -> None:
    record = json.loads((folder / "out.json").read_text())
    phases = ", ".join(f"{name} {seconds:.2f}" for name, seconds in record["Seconds"].items())
    band = record["Band"]
    print(f"  {band['voxels'] / np.prod(record['Grid']['shape']):.1%} of the volume in the band; seconds: {phases}")


if __name__ == "__main__":
    main()
