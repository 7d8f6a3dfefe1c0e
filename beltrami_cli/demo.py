"""The main job on a small surface, ending in a picture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli import formats, phantoms, report
from beltrami_cli.config import Beta, Job, Settings
from beltrami_cli.errors import RefusedError
from beltrami_cli.evolve import Observer
from beltrami_cli.pipeline import run

PEAK = 255.0  # full scale of the phantoms' data, for PSNR
ITERATIONS = 12
BETA = Beta((0.1,))  # mm per data unit: slopes over 10 units per mm stay; the torus's borders are of 100 units and more


@dataclass(frozen=True)
class Demo:
    """psnr_*: dB over the surface's voxels. picture: None where what draws it is not installed."""

    record: dict[str, Any]
    mesh: Path
    picture: Path | None
    psnr_before: float
    psnr_after: float


def run_demo(
    outdir: Path, source: Path | None = None, *, overwrite: bool = False, observer: Observer | None = None
) -> Demo:
    """Denoise the phantom in `source` (by default a torus made in outdir) into outdir.

    Raises RefusedError where outdir cannot be made, `source` holds no phantom, or outputs exist.
    """
    given = _phantom_files(source) if source else None
    try:
        outdir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RefusedError(f"{outdir}: cannot be made ({error.strerror}); choose another OUTDIR") from error
    out, mesh, picture, sidecar = (outdir / f"denoised{suffix}" for suffix in (".nii.gz", ".ply", ".png", ".json"))
    formats.Stage([out, mesh, picture, sidecar], overwrite=overwrite)  # refuses before anything is made
    levelset, clean, noisy = given or _make_torus(outdir, overwrite)
    shown = None if report.missing(picture) else picture
    settings = Settings(beta=BETA, iterations=ITERATIONS)
    job = Job(noisy, out, levelset, (mesh,), report=shown, overwrite=overwrite, settings=settings)
    result = run(job, observer=observer)
    psi, truth, data = (formats.read_volume(path).data for path in (levelset, clean, noisy))
    near = (np.abs(psi) < 0.5) & np.isfinite(result.data)
    return Demo(
        result.record,
        mesh,
        shown,
        *(float(20 * np.log10(PEAK / np.sqrt(np.mean((v - truth)[near] ** 2)))) for v in (data, result.data)),
    )


def _phantom_files(source: Path) -> tuple[Path, Path, Path]:
    for suffix in ("nii.gz", "mha", "npy"):
        if (source / f"levelset.{suffix}").exists():
            return tuple(source / f"{part}.{suffix}" for part in ("levelset", "clean", "noisy"))  # type: ignore[return-value]
    raise RefusedError(
        f"{source}: holds no levelset.nii.gz, .mha or .npy; make it with: beltrami phantom torus {source}"
    )


def _make_torus(outdir: Path, overwrite: bool) -> tuple[Path, Path, Path]:
    files = {part: outdir / f"{part}.nii.gz" for part in ("levelset", "clean", "noisy")}
    with formats.Stage(files.values(), overwrite=overwrite) as stage:
        for part, volume in phantoms.make("torus").volumes().items():
            formats.write_volume(stage.path(files[part]), volume)
        stage.commit()
    return files["levelset"], files["clean"], files["noisy"]
