"""beltrami sample: a volume's values at the vertices of one's own surface."""

from __future__ import annotations

from pathlib import Path

import click

from beltrami_cli.cli.common import Command, frame_option, note, overwrite_option, say, short

FILE = click.Path(path_type=Path)


@click.command(cls=Command)
@click.argument("volume", type=FILE)
@click.argument("surface", type=FILE)
@click.option(
    "-o", "--output", type=FILE, required=True, metavar="FILE", help=".func.gii .shape.gii .mgz, or a FreeSurfer map."
)
@click.option(
    "--kind",
    type=click.Choice(["scalar", "circular", "vector"]),
    default="scalar",
    show_default=True,
    help="circular: angles, which wrap. vector: every channel or frame of VOLUME, a map of FILE each.",
)
@click.option("--period", metavar="P", help="Of circular data, in their unit: 360, 2pi, 24 ...")
@click.option("--missing", type=float, metavar="VALUE", help="A value of VOLUME that means none, as NaN always does.")
@frame_option
@click.option("--structure", metavar="NAME", help="CortexLeft, CortexRight ... Default: what SURFACE or its name says.")
@click.option("--spacing", metavar="S|SX,SY,SZ", help="Voxel size in mm of an .npy VOLUME. Default: 1.")
@overwrite_option
def sample(
    volume: Path,
    surface: Path,
    output: Path,
    kind: str,
    period: str | None,
    missing: float | None,
    frame: str | None,
    structure: str | None,
    spacing: str | None,
    overwrite: bool | None,
    quiet: bool,
    verbose: int,
) -> int:
    """Write the values of VOLUME at the vertices of SURFACE, in their order, and a JSON record beside FILE.

    Trilinear, in world space. A vertex outside VOLUME, or most of whose neighbours are missing, gets NaN.

    \b
        beltrami sample denoised.nii.gz lh.midthickness.surf.gii -o lh.denoised.func.gii
    """
    from beltrami_cli import volume_to_surface
    from beltrami_cli.config import parse_period, parse_spacing

    job = volume_to_surface.Sampling(
        volume=volume,
        surface=surface,
        output=output,
        kind=kind,
        period=None if period is None else parse_period(period),
        missing=missing,
        frame=frame,
        structure=structure,
        spacing=None if spacing is None else parse_spacing(spacing),
        overwrite=bool(overwrite),
    )
    record = volume_to_surface.sample(job, notify=lambda line: note(quiet, f"warning: {line}"))
    counts = record["Vertices"]
    say(quiet, f"wrote {short(', '.join(record['Outputs']))}")
    say(
        quiet,
        f"{counts['with_value']} of {counts['vertices']} vertices have a value, "
        f"{counts['outside_volume']} lie outside the volume",
    )
    return 0
