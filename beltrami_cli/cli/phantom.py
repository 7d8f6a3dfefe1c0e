"""beltrami phantom: surfaces with known data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click

from beltrami_cli.cli.common import Command, overwrite_option, say
from beltrami_cli.errors import RefusedError

NAMES = ("torus", "sphere", "plane", "curve", "portrait", "sulcus", "cortex")
MAPS = {"torus": ("mixed", "pieces", "smooth", "angle"), "portrait": ("grey", "rgb")}


@click.command(cls=Command)
@click.argument("name", type=click.Choice(NAMES))
@click.argument("outdir", type=click.Path(path_type=Path, file_okay=False))
@click.option("--size", type=int, metavar="N", help="Voxels along each axis; the default depends on the phantom.")
@click.option(
    "--noise",
    type=float,
    metavar="SIGMA",
    help="Standard deviation per voxel (cortex: of both parts of a wave of height 1); the default depends likewise.",
)
@click.option("--seed", type=int, default=0, show_default=True, help="Of the noise.")
@click.option("--format", "suffix", type=click.Choice(["nii.gz", "mha", "npy"]), default="nii.gz", show_default=True)
@click.option(
    "--map",
    "painting",
    type=click.Choice([map for maps in MAPS.values() for map in maps]),
    help="Data on the torus (mixed, pieces, smooth, angle) or the portrait (grey, rgb).",
)
@click.option("--gap", type=float, metavar="VOXELS", help="Between the banks of the sulcus.")
@overwrite_option
def phantom(
    name: str,
    outdir: Path,
    size: int | None,
    noise: float | None,
    seed: int,
    suffix: str,
    painting: str | None,
    gap: float | None,
    overwrite: bool | None,
    quiet: bool,
    verbose: int,
) -> int:
    """Write a surface with known data to OUTDIR: levelset, clean and noisy volumes."""
    from beltrami_cli import formats, phantoms

    options: dict[str, Any] = {"map": painting, "gap": gap}
    options = {key: value for key, value in options.items() if value is not None}
    if painting is not None and painting not in MAPS.get(name, ()):
        owner = next(owner for owner, maps in MAPS.items() if painting in maps)
        raise RefusedError(f"--map {painting} belongs to the phantom {owner}; found {name}; drop it")
    if gap is not None and name != "sulcus":
        raise RefusedError(f"--gap belongs to the phantom sulcus; found {name}; drop it")
    made = phantoms.make(name, size=size, noise=noise, seed=seed, **options)
    try:
        outdir.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RefusedError(f"{outdir}: cannot be made ({error.strerror}); choose another OUTDIR") from error
    volumes = {outdir / f"{part}.{suffix}": volume for part, volume in made.volumes().items()}
    with formats.Stage(volumes, overwrite=bool(overwrite)) as stage:
        for path, volume in volumes.items():
            formats.write_volume(stage.path(path), volume)
        stage.commit()
    say(quiet, f"wrote {', '.join(map(str, volumes))}")
    if name == "cortex" or painting == "angle":
        say(quiet, "the values are angles: --kind circular --period 360 of denoise, --period 360 of view and compare")
    return 0
