"""Cost follows the surface, not the volume: the same torus in a volume padded with empty space to 8 times its size."""

from __future__ import annotations

import numpy as np
from common import run_command

from beltrami_cli.phantoms import torus

SIZE = 128
REPEATS = 5


def main() -> None:
    phantom = torus(SIZE)
    psi, data = phantom.levelset, phantom.noisy
    around = (SIZE // 2, SIZE // 2)
    volumes = {
        "as it is": (psi, data),
        "padded": (np.pad(psi, around, constant_values=psi.max()), np.pad(data, around, constant_values=np.nan)),
    }
    run_command(psi, data, "--beta", "0.05", "--iterations", "1")  # compiles, if this is the first run ever
    records: dict[str, list] = {name: [] for name in volumes}
    for _ in range(REPEATS):
        for name, pair in volumes.items():
            records[name].append(run_command(*pair, "--beta", "0.05", "--iterations", "20")[1])

    phases = list(records["padded"][0]["Seconds"])
    print(f"{'seconds':10}" + "".join(f"{phase:>9}" for phase in phases) + f"{'MiB':>9}{'entries':>10}{'voxels':>12}")
    for name, runs in records.items():
        seconds = [np.median([run["Seconds"][phase] for run in runs]) for phase in phases]
        memory = np.median([run["PeakMemoryMiB"] for run in runs])
        cells = "".join(f"{value:9.3f}" for value in seconds)
        print(f"{name:10}{cells}{memory:9.0f}{runs[0]['Band']['entries']:10}{volumes[name][0].size:12}")


if __name__ == "__main__":
    main()
