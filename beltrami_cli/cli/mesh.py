"""beltrami mesh: the surface of a level set as a mesh, with values."""

from __future__ import annotations

from pathlib import Path

import click

from beltrami_cli.cli.common import Command, announce_compilation, overwrite_option, say

FILE = click.Path(path_type=Path)


@click.command(cls=Command)
@click.argument("levelset", type=FILE)
@click.argument("data", type=FILE, required=False)
@click.option("-o", "--output", type=FILE, required=True, metavar="FILE", help=".surf.gii .ply .obj .stl .glb .vtk")
@click.option("--spacing", metavar="S|SX,SY,SZ", help="Voxel size in mm of .npy inputs. Default: 1.")
@click.option("--resample", is_flag=True, help="Bring DATA onto LEVELSET's grid (trilinear).")
@click.option("--period", metavar="P", help="DATA are angles of this period: 360, 2pi, 24 ...")
@click.option("--inside", type=click.Choice(["negative", "positive"]), default="negative", show_default=True)
@overwrite_option
def mesh(
    levelset: Path,
    data: Path | None,
    output: Path,
    spacing: str | None,
    resample: bool,
    period: str | None,
    inside: str,
    overwrite: bool | None,
    quiet: bool,
    verbose: int,
) -> int:
    """Write the surface where LEVELSET is zero as a mesh in RAS mm, with the values of DATA at its vertices.

    A vertex beside which DATA has no value gets NaN. GIFTI writes the values to .func.gii beside the .surf.gii.
    """
    from beltrami_cli import formats
    from beltrami_cli.config import parse_period, parse_spacing
    from beltrami_cli.pipeline import mesh_of

    if spacing and "NPY" not in [formats.volume_format(path) for path in (levelset, data) if path]:
        raise click.UsageError("--spacing is for .npy inputs only; found none among LEVELSET and DATA; drop it")
    if period and data is None:
        raise click.UsageError("--period is for DATA; found LEVELSET alone; add DATA or drop it")
    turn = parse_period(period) if period else None
    curve = 1 in formats.read_grid(levelset).shape
    files = formats.mesh_files(output, values=data is not None, curve=curve)
    with formats.Stage(files, overwrite=bool(overwrite), inputs=[p for p in (levelset, data) if p]) as stage:
        announce_compilation(quiet)
        steps = parse_spacing(spacing) if spacing else None
        surface = mesh_of(levelset, data, spacing=steps, bring=resample, inside=inside, period=turn)
        formats.write_mesh(stage.path(output), surface)
        stage.commit()
    say(quiet, f"wrote {', '.join(map(str, files))}")
    return 0
