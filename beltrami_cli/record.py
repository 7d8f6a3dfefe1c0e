"""What a run leaves behind in words: every parameter as used, and what happened (the JSON sidecar)."""

from __future__ import annotations

import hashlib
import json
import math
import os
import sys
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numba
import numpy as np

from beltrami_cli import __version__, formats
from beltrami_cli.band import Band
from beltrami_cli.config import Job, Settings
from beltrami_cli.evolve import Evolution
from beltrami_cli.extension import Extended
from beltrami_cli.grid import Grid
from beltrami_cli.kinds import Kind
from beltrami_cli.observed import Observed
from beltrami_cli.planning import Plan
from beltrami_cli.tuning import Choice

# Parameters that say how files are read and written, not how values are denoised.
OF_FILES = ("resample", "spacing", "labels", "between", "map", "frame", "structure")

# Of sums in single precision, which has 7.
DIGITS = 6


@dataclass(frozen=True, eq=False)
class Ran:
    """One run on one set of data. values: (K, E) as they came out.

    excess: by how much values had left the range of the data (data units). smoothness: FWHM before and after, mm.
    noise: pairs of an iteration and the noise that was left then, where anybody looked.
    """

    kind: Kind
    observed: Observed
    start: Extended
    evolution: Evolution
    substeps: int
    values: np.ndarray
    excess: float
    smoothness: tuple[float, float]
    noise: list[tuple[int, np.ndarray]] = field(default_factory=list)


def what_happened(settings: Settings, grid: Grid, band: Band, plan: Plan, ran: Ran) -> dict[str, Any]:
    """What was used and what happened, JSON-ready; lengths mm, dt mm^2, beta mm per data unit."""
    primary, schedule, evolution = band.primary, plan.schedule, ran.evolution
    missing = np.isnan(ran.values[0, primary])
    near = ran.observed.near()
    given, left = ran.observed.values[:, near], ran.observed.seen(near)(ran.values)
    there = ~np.isnan(left[0])
    beta = schedule.beta[: evolution.iterations]
    return {
        "Parameters": _used(settings, band, plan, evolution),
        "Grid": grid.as_record(),
        "Band": {
            "voxels": len(primary),
            "entries": band.entries,
            "half_width_mm": band.half_width,
            "surface_vertices": 0 if band.surface is None else len(band.surface.points),
            "filled_voxels": int((~ran.start.known[primary] & ~missing).sum()),
            "missing_voxels": int(missing.sum()),
        },
        "Values": {
            "channels": len(ran.values),
            "range": [ran.kind.low, ran.kind.low + ran.kind.period] if ran.kind.is_circular else None,
        },
        "Iterations": evolution.iterations,
        "StopReason": evolution.stop_reason,
        "TimeMm2": schedule.dt * evolution.iterations,
        "TypicalSlope": plan.slope,
        "Noise": {
            "sd": [_number(sd) for sd in plan.noise],
            "after": [_number(sd) for sd in ran.observed.noise_sd(ran.values)],
            "meaning": f"robust standard deviation over {ran.observed.noun} on the surface, data units, per channel, "
            "before (sd) and after",
        },
        "Smoothness": {
            "before_mm": _number(ran.smoothness[0]),
            "after_mm": _number(ran.smoothness[1]),
            "meaning": "FWHM along the surface of what the values show, map and noise (Forman et al. 1995)",
        },
        "Removed": {
            "rms": _number(ran.kind.spread(given[:, there], left[:, there])),
            ran.observed.noun: int(there.sum()),
            "meaning": f"input minus output at valid {ran.observed.noun} on the surface (voxels: within half of one)",
        },
        "ClippedExcess": ran.excess,
        "Choice": None if plan.choice is None else _chosen(plan.choice, ran.observed.noun),
        "PerIteration": {
            "beta": beta.tolist(),
            "dt": [schedule.dt] * len(beta),
            "dt_over_beta": [schedule.dt / b if b else None for b in beta.tolist()],
            "change_rms": _rounded(evolution.change),
            "energy": _rounded(evolution.energy),
            "most_substeps": ran.substeps,
            **({"noise_sd": _looks(ran.noise)} if ran.noise else {}),
        },
    }


def over_frames(records: list[dict[str, Any]]) -> dict[str, list[Any]]:
    """What differs from frame to frame of a series; None for a frame without data, whose record is empty."""
    return {
        "without_data": [t for t, r in enumerate(records) if not r],
        "noise_sd": [r["Noise"]["sd"][0] if r else None for r in records],
        "removed_rms": [r["Removed"]["rms"] if r else None for r in records],
        "iterations": [r["Iterations"] if r else None for r in records],
        "filled_voxels": [r["Band"]["filled_voxels"] if r else None for r in records],
        "missing_voxels": [r["Band"]["missing_voxels"] if r else None for r in records],
    }


def _used(settings: Settings, band: Band, plan: Plan, evolution: Evolution) -> dict[str, Any]:
    """Every parameter as used, defaults and choices included."""
    flow, schedule = plan.flow, plan.schedule
    one = len(set(schedule.beta.tolist())) == 1
    return {
        **asdict(settings),
        "flow": flow.name,
        "phi": flow.phi if flow.name == "phi" else None,
        "beta": (float(schedule.beta[0]) if one else str(settings.beta)) if flow.has_beta else None,
        "eps": 1 / schedule.beta[0] if flow.name in ("l1", "tv") and schedule.beta.any() else None,
        "band": band.half_width,
        "dt": schedule.dt,
        "extend_every": settings.reextends_every,
        "iterations": evolution.iterations,
        "threads": numba.get_num_threads(),
    }


def _chosen(choice: Choice, places: str) -> dict[str, Any]:
    return {
        "flow": choice.flow.name,
        "phi": choice.flow.phi if choice.flow.name == "phi" else None,
        "beta": choice.beta if choice.flow.has_beta else None,
        "iterations": choice.iterations,
        f"held_out_{places}": choice.held_out,
        "errors": _rounded(choice.errors),
        "gain_standard_errors": choice.gain,
        "meaning": f"error: root mean square at the held-out {places}, data units; errors: of the chosen run after 0, "
        "1 ... iterations; each row of the table at its best iteration",
        "table": choice.table(),
    }


def _looks(noise: list[tuple[int, np.ndarray]]) -> list[dict[str, Any]]:
    """The noise that was left after some of the iterations, per channel, data units."""
    return [{"iteration": k, "sd": [_number(each) for each in sd]} for k, sd in noise]


def _rounded(sums: np.ndarray) -> list[float]:
    """Sums over the band to the digits that hold: the last ones of single precision depend on the compiled code."""
    return [float(f"{value:.{DIGITS}g}") for value in sums]


def _number(value: float) -> float | None:
    """For JSON, which has no NaN and no infinity."""
    return float(value) if math.isfinite(value) else None


def sources_of(job: Job) -> list[tuple[Path, str | None]]:
    """Every file that a job reads, and what it is to the run; None for the second file of a pair.

    Raises RefusedError where one is missing.
    """
    named = [("levelset", job.levelset), ("data", job.data), ("weights", job.weights), ("mask", job.mask)]
    named += [("on", surface) for surface, _ in job.on]
    return [
        (file, role if file == path else None)
        for role, path in named
        if path is not None
        for file in formats.input_files(path)
    ]


def sidecar(
    job: Job,
    sources: list[tuple[Path, str | None]],
    files: list[Path],
    hashes: list[str],
    happened: dict[str, Any],
    warnings: tuple[str, ...],
    seconds: dict[str, float],
) -> dict[str, Any]:
    """The record of a run on files."""
    read = [(path, digest, role) for (path, role), digest in zip(sources, hashes, strict=True)]
    parameters = {**happened["Parameters"], **{name: getattr(job, name) for name in OF_FILES}}
    return {
        **provenance(read, files, parameters, warnings),
        "Request": request(job),
        **{name: value for name, value in happened.items() if name != "Parameters"},
        "Seconds": {name: round(spent, 3) for name, spent in seconds.items()},
        "PeakMemoryMiB": _peak_memory_mib(),
    }


def request(job: Job) -> dict[str, Any]:
    """What was asked of a run, apart from the content of its inputs: with that, all that its outputs follow from.

    JSON-ready; files by their place relative to the sidecar, so that a study can move. What a machine has to give,
    threads and memory, is left out: outputs do not depend on it.
    """
    folder = plain(sidecar_of(job.volume)).parent

    def place(path: Path | None) -> str | None:
        return None if path is None else seen_from(folder, plain(path)).as_posix()

    settings = {name: value for name, value in asdict(job.settings).items() if name != "threads"}
    asked = {
        **settings,
        "beta": str(job.settings.beta),
        **{name: getattr(job, name) for name in OF_FILES},
        "volume": place(job.volume),
        "mesh": None if job.mesh is None else [place(path) for path in job.mesh],
        "filled": place(job.filled),
        "on": [place(path) for _, path in job.on],
        # Left out where there is none: no run of before there were reports is done again for want of one.
        **({} if job.report is None else {"report": place(job.report)}),
    }
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asked.items()}


def provenance(
    sources: Iterable[tuple[Path, str, str | None]],
    outputs: Iterable[Path],
    parameters: Mapping[str, Any],
    warnings: Iterable[str],
) -> dict[str, Any]:
    """What every sidecar says, with names as in BIDS derivatives.

    sources: files, their SHA-256, and what each was to the run; None for the second file of a pair.
    """
    return {
        "GeneratedBy": [{"Name": "beltrami_cli", "Version": __version__}],
        "Sources": [
            {"Path": str(plain(path)), "SHA256": digest} | ({"Role": role} if role else {})
            for path, digest, role in sources
        ],
        "Outputs": [str(plain(file)) for file in outputs],
        "Created": datetime.now(UTC).isoformat(timespec="seconds"),
        "Parameters": dict(parameters),
        "Warnings": list(warnings),
    }


def plain(path: Path) -> Path:
    """The absolute path without `..`; links stay, but where `..` follows one: that leads to where the link points."""
    here, *steps = path.absolute().parts
    found = Path(here)
    for step in steps:
        if step != "..":
            found /= step
        else:
            found = (found.resolve() if found.is_symlink() else found).parent
    return found


def seen_from(folder: Path, path: Path) -> Path:
    """A plain path relative to a plain folder, so that both can move; absolute on another drive (of Windows)."""
    try:
        return Path(os.path.relpath(path, folder))
    except ValueError:
        return path


def sidecar_of(output: Path) -> Path:
    """Where the record of an output goes: o.nii.gz -> o.json, o.func.gii -> o.func.json."""
    stem = formats.stem(output)
    return stem.with_name(stem.name + ".json")


def write_record(path: Path, record: Mapping[str, Any]) -> None:
    """Write a sidecar: JSON without NaN and infinity; raises DataError where the file cannot be written."""
    with formats.writing(path):
        path.write_text(json.dumps(record, indent=2, allow_nan=False) + "\n", encoding="utf-8")


def sha256(path: Path) -> str:
    """The hexadecimal digest of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def forget_peak_memory() -> None:
    """Start `PeakMemoryMiB` anew, for a process that does one run after another; only Linux can."""
    with suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5")


def _peak_memory_mib() -> float | None:
    """Largest resident set of this process, so far or since `forget_peak_memory`; None where unknown (Windows)."""
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
