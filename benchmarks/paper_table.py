"""Time and memory of the paper's three examples, 20 iterations each, beside the paper's own figures."""

from __future__ import annotations

import numpy as np
from common import folded_surface, run_command

from beltrami_cli.phantoms import portrait, torus

ITERATIONS = "20"


def main() -> None:
    solids = {"torus": torus(95), "portrait 140^3": portrait(140)}
    cases = {name: (solid.levelset, solid.noisy) for name, solid in solids.items()}
    cases["cortex-like 97x222x143"] = folded_surface()
    paper = ("under 2 s", "3.5 min, 260 MB", "under 10 min")
    run_command(*cases["torus"], "--beta", "0.05", "--iterations", "1")  # compiles, if this is the first run ever

    print(f"{'':24}{'surface voxels':>15}{'entries':>10}{'flow s':>8}{'whole s':>9}{'MiB':>7}  the paper's")
    for (name, (psi, data)), theirs in zip(cases.items(), paper, strict=True):
        seconds, record = run_command(psi, data, "--beta", "0.05", "--iterations", ITERATIONS)
        surface, entries = int((np.abs(psi) < 0.5).sum()), record["Band"]["entries"]
        flow, memory = record["Seconds"]["flow"], record["PeakMemoryMiB"]
        print(f"{name:24}{surface:15}{entries:10}{flow:8.2f}{seconds:9.2f}{memory:7.0f}  {theirs}")


if __name__ == "__main__":
    main()
