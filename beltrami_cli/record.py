"""What a run leaves behind in words: every parameter as used, and what happened (the JSON sidecar)."""

from __future__ import annotations

import os
import sys
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numba
import numpy as np

from beltrami_cli import __version__
from beltrami_cli.band import Band
from beltrami_cli.config import Job, Settings
from beltrami_cli.evolve import Evolution, Schedule
from beltrami_cli.grid import Grid


def what_happened(
    settings: Settings,
    grid: Grid,
    band: Band,
    schedule: Schedule,
    evolution: Evolution,
    slope: float,
    samples: np.ndarray,
    values: np.ndarray,
    known: np.ndarray,
    excess: float,
) -> dict[str, Any]:
    """What was used and what happened, JSON-ready; lengths mm, dt mm^2, beta mm per data unit."""
    primary = band.primary
    near = primary[np.abs(band.distance[primary]) <= 0.5 * grid.spacing.max()]
    removed = (samples[near] - values[near]).astype(float)
    removed = removed[np.isfinite(removed)]
    used = {**asdict(settings), "band": band.half_width, "dt": schedule.dt}
    used["beta"] = _beta_used(settings, schedule)
    used["extend_every"] = settings.reextends_every
    used["iterations"] = schedule.iterations
    used["threads"] = numba.get_num_threads()
    used["eps"] = 1 / schedule.beta[0] if settings.flow in ("l1", "tv") and schedule.beta.any() else None
    used["phi"] = settings.phi_name if settings.flow == "phi" else None
    return {
        "Parameters": used,
        "Grid": {"shape": list(grid.shape), "spacing_mm": grid.spacing.tolist(), "affine_ras_mm": grid.affine.tolist()},
        "Band": {
            "voxels": len(primary),
            "entries": band.entries,
            "half_width_mm": band.half_width,
            "surface_vertices": 0 if band.surface is None else len(band.surface.points),
            "filled_voxels": int((~known[primary] & ~np.isnan(values[primary])).sum()),
            "missing_voxels": int(np.isnan(values[primary]).sum()),
        },
        "Iterations": schedule.iterations,
        "StopReason": evolution.stop_reason,
        "TimeMm2": schedule.dt * schedule.iterations,
        "TypicalSlope": slope,
        "Removed": {
            "rms": float(np.sqrt(np.mean(removed**2))) if removed.size else None,
            "voxels": int(removed.size),
            "meaning": "input minus output at valid voxels within half a voxel of the surface",
        },
        "ClippedExcess": excess,
        "PerIteration": {
            "beta": schedule.beta.tolist(),
            "dt": [schedule.dt] * schedule.iterations,
            "dt_over_beta": [schedule.dt / beta if beta else None for beta in schedule.beta.tolist()],
            "change_rms": evolution.change.tolist(),
            "energy": evolution.energy.tolist(),
        },
    }


def _beta_used(settings: Settings, schedule: Schedule) -> float | str | None:
    """The number where beta was one, the schedule where it changed, None for a flow that has none."""
    if settings.flow in ("l2", "l1", "tv"):
        return None
    if len(set(schedule.beta.tolist())) == 1:
        return float(schedule.beta[0])
    return str(settings.beta)


def sidecar(
    job: Job,
    sources: list[Path],
    files: list[Path],
    hashes: list[str],
    happened: dict[str, Any],
    warnings: tuple[str, ...],
    seconds: dict[str, float],
) -> dict[str, Any]:
    """The record of a run on files, with names as in BIDS derivatives."""
    return {
        "GeneratedBy": [{"Name": "beltrami_cli", "Version": __version__}],
        "Sources": [{"Path": os.fspath(path), "SHA256": digest} for path, digest in zip(sources, hashes, strict=True)],
        "Outputs": [os.fspath(file) for file in files],
        "Created": datetime.now(UTC).isoformat(timespec="seconds"),
        **happened,
        "Parameters": {**happened["Parameters"], "resample": job.resample, "spacing": job.spacing},
        "Warnings": list(warnings),
        "Seconds": {name: round(spent, 3) for name, spent in seconds.items()},
        "PeakMemoryMiB": _peak_memory_mib(),
    }


def _peak_memory_mib() -> float | None:
    """Largest resident set of this process so far; None where the system does not say (Windows)."""
    status = Path("/proc/self/status")
    if status.exists():  # Linux, where ru_maxrss counts the peak of the process that started this one too
        for line in status.read_text().splitlines():
            if line.startswith("VmHWM:"):
                return round(int(line.split()[1]) / 2**10, 1)
    try:
        import resource
    except ImportError:
        return None
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return round(peak / (2**20 if sys.platform == "darwin" else 2**10), 1)
