"""beltrami levelset: the signed distance to a surface, from a segmentation, a mesh or a level set."""

from __future__ import annotations

from pathlib import Path

import click

from beltrami_cli.cli.common import Command, announce_compilation, frame_option, note, overwrite_option, say, short

FILE = click.Path(path_type=Path)


@click.command(cls=Command)
@click.argument("source", type=FILE)
@click.option("-o", "--output", type=FILE, required=True, metavar="PSI", help=".nii.gz .nii .mha .mhd .mgz .npy")
@click.option("--labels", metavar="L1,L2..", help="Which labels of a segmentation are inside: 2,41 or a range, 5-255.")
@click.option(
    "--between",
    metavar="INNER,OUTER",
    help="The surface midway between two labels, or several joined by +: 2,1 or 2+41,0.",
)
@click.option("--like", type=FILE, metavar="VOL", help="Write on the grid of this volume.")
@click.option(
    "--spacing",
    metavar="H",
    help="Voxel size in mm of the grid around a surface (default: its median edge, or half the distance between "
    "opposite banks); S or SX,SY,SZ: of .npy files (default: 1).",
)
@click.option("--margin", type=float, metavar="MM", help="Of the grid around a surface, beyond it. Default: 7 voxels.")
@frame_option
@overwrite_option
def levelset(
    source: Path,
    output: Path,
    labels: str | None,
    between: str | None,
    like: Path | None,
    spacing: str | None,
    margin: float | None,
    frame: str | None,
    overwrite: bool | None,
    quiet: bool,
    verbose: int,
) -> int:
    """Write the signed distance in mm to the surface of SOURCE, negative inside: exact near it, constant far away.

    Beside PSI goes a JSON record.

    SOURCE is a segmentation (a mask, or labels with --labels or --between; the surface is smooth, not a staircase), a
    surface (.surf.gii .ply .obj .stl .vtk, FreeSurfer's lh.white), or a level set to be measured anew. PSI lies on the
    grid of SOURCE, or around it if that is a surface; beyond the border of an open surface it is NaN.

    \b
        beltrami levelset ribbon.mgz -o psi.nii.gz --labels 2,41
        beltrami levelset wm.mgz -o psi.nii.gz --labels 5-255
        beltrami levelset rim.nii.gz -o mid.nii.gz --between 2,1
        beltrami levelset lh.white -o psi.nii.gz --like bold.nii.gz
    """
    import numpy as np

    from beltrami_cli import sources
    from beltrami_cli.config import parse_spacing
    from beltrami_cli.grid import Grid

    announce_compilation(quiet)
    record = sources.write_levelset(
        source,
        output,
        labels=labels,
        between=between,
        frame=frame,
        like=like,
        spacing=parse_spacing(spacing) if spacing else None,
        margin=margin,
        overwrite=bool(overwrite),
        notify=lambda line: note(quiet, f"warning: {line}"),
    )
    grid = Grid(tuple(record["Grid"]["shape"]), np.array(record["Grid"]["affine_ras_mm"]))
    inside = record["Voxels"]["inside"] / sum(record["Voxels"].values())
    say(quiet, f"wrote {short(', '.join(record['Outputs']))}")
    say(quiet, f"{grid.describe()}: {inside:.1%} of the voxels inside")
    return 0
