"""Summary figures of tiny runs, and the script that stores them: python tests/regenerate_golden.py

Run it where a change of the results is meant, look at the difference, and say in the changelog why it is right.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path

import numpy as np

from beltrami_cli import denoise
from beltrami_cli.phantoms import Phantom, make

GOLDEN = Path(__file__).with_name("golden") / "summaries.json"

PERIOD = 128.0
RUNS: dict[str, dict[str, object]] = {
    "beltrami": {"beta": 0.05},
    "beltrami paper": {"beta": 0.05, "scheme": "paper"},
    "beltrami geometric": {"beta": "0.2:0.02:geometric"},
    "l2": {"flow": "l2"},
    "l2 paper": {"flow": "l2", "scheme": "paper"},
    "l1": {"flow": "l1", "eps": 10.0},
    "tv": {"flow": "tv", "eps": 10.0},
    "tv paper": {"flow": "tv", "eps": 10.0, "scheme": "paper"},
    "charbonnier": {"flow": "phi", "phi": "charbonnier", "beta": 0.05},
    "perona-malik": {"flow": "phi", "phi": "perona-malik", "beta": 0.05},
    "geman-mcclure": {"flow": "phi", "phi": "geman-mcclure", "beta": 0.05},
    "weickert": {"flow": "phi", "phi": "weickert", "beta": 0.05},
    "pde": {"beta": 0.05, "extension": "pde"},
    "none": {"beta": 0.05, "extension": "none"},
    "never re-extended": {"beta": 0.05, "extend_every": 0},
    "anisotropic": {"beta": 0.05, "spacing": (1.0, 1.3, 1.7)},
    "circular": {"beta": 0.05, "kind": "circular", "period": PERIOD},
    "vector": {"beta": 0.05, "kind": "vector"},
    "weighted": {"beta": 0.05, "fidelity": 0.2},
    "depth": {"beta": 0.05, "depth": (-1.0, 2.0)},
}
PHANTOMS = {"torus": 24, "sulcus": 20, "curve": 40}
DIGITS = 7  # float32 has no more


@cache
def phantom(name: str) -> Phantom:
    return make(name, size=PHANTOMS[name], noise=20.0, seed=1)


def data_of(made: Phantom, run: str) -> np.ndarray:
    data = made.noisy.copy()
    if run == "circular":
        data %= PERIOD
    data[: len(data) // 3, : len(data) // 3] = np.nan
    return np.stack([data, np.flip(data, -1)], -1) if run == "vector" else data


def summary(phantom_name: str, run: str) -> dict[str, float]:
    """Figures of one run of 10 iterations on a phantom with a hole in its data."""
    made = phantom(phantom_name)
    options = dict(RUNS[run])
    spacing = options.pop("spacing", (1.0, 1.0, 1.0))
    if run == "weighted":
        options["weights"] = 50 + made.clean
    result = denoise(
        made.levelset,
        data_of(made, run),
        spacing=spacing[: made.levelset.ndim],  # type: ignore[index]
        iterations=10,
        **options,  # type: ignore[arg-type]
    )
    near = (np.abs(made.levelset) < 0.5) & np.isfinite(result.data.reshape(*made.levelset.shape, -1)).all(-1)
    mesh, each = result.mesh, result.record["PerIteration"]
    assert mesh is not None and mesh.values is not None
    values, at_vertices = (x.astype(float) for x in (result.data[near], mesh.values))
    if run == "circular":  # a rounding error may turn 0 into a whole period
        values, at_vertices = (np.sin(2 * np.pi * x / PERIOD) for x in (values, at_vertices))
    figures = {
        "voxels": float(near.sum()),
        "mean": values.mean(),
        "std": values.std(),
        "min": values.min(),
        "max": values.max(),
        "mesh mean": np.nanmean(at_vertices),
        "mesh std": np.nanstd(at_vertices),
        "vertices": float(len(mesh.vertices_ras_mm)),
        "change": each["change_rms"][-1],
        "energy": each["energy"][-1],
    }
    return {name: float(f"{value:.{DIGITS}g}") for name, value in figures.items()}


def main() -> None:
    summaries = {name: {run: summary(name, run) for run in RUNS} for name in PHANTOMS}
    GOLDEN.parent.mkdir(exist_ok=True)
    GOLDEN.write_text(json.dumps(summaries, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
