"""beltrami levelset: the signed distance to a surface, from a segmentation, a mesh or a level set."""

from __future__ import annotations

from pathlib import Path

import click

from beltrami_cli.cli.common import Command, announce_compilation, note, overwrite_option, say

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
@click.option(
    "--frame",
    type=click.Choice(["scanner", "tkr"]),
    help="The coordinates of a surface: scanner RAS, or FreeSurfer's surface RAS. Default: what its file says.",
)
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

    from beltrami_cli import formats, sources
    from beltrami_cli.config import parse_spacing
    from beltrami_cli.record import provenance, sha256, sidecar_of, write_record

    if margin is not None and not margin >= 0:
        raise click.UsageError(f"--margin: found {margin:g}; expected 0 mm or more")
    steps = parse_spacing(spacing) if spacing else None
    read = [path for path in (source, like) if path]
    files = [*formats.volume_files(output), sidecar_of(output)]
    inputs = [file for path in read for file in formats.input_files(path)]
    with formats.Stage(files, overwrite=bool(overwrite), inputs=inputs) as stage:
        announce_compilation(quiet)
        made = sources.read_levelset(
            source, labels=labels, between=between, frame=frame, like=like, spacing=steps, margin=margin
        )
        for line in made.notes:
            note(quiet, line)
        formats.write_volume(stage.path(output), made.volume)
        roles = {source: "source", like: "like"}
        used = {"labels": labels, "between": between, "spacing": steps, "margin": margin, "frame": frame}
        told = provenance([(path, sha256(path), roles.get(path)) for path in inputs], files, used, made.notes)
        write_record(stage.path(files[-1]), told)
        stage.commit()
    psi, step = made.volume, made.volume.grid.spacing
    if formats.volume_format(output) == "NPY" and not np.allclose(step, 1):
        note(quiet, f"{output}: keeps no voxel size; give --spacing {','.join(f'{h:.6g}' for h in step)} with it")
    say(quiet, f"wrote {', '.join(map(str, files))}")
    say(quiet, f"{psi.grid.describe()}: {(psi.data < 0).mean():.1%} of the voxels inside")
    return 0
