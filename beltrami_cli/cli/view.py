"""beltrami view: a picture of maps on a surface."""

from __future__ import annotations

from pathlib import Path

import click

from beltrami_cli.cli.common import Command, announce_compilation, frame_option, note, overwrite_option, say

FILE = click.Path(path_type=Path)

SIDES = (
    *("lateral", "medial", "dorsal", "ventral", "anterior", "posterior"),
    *("left", "right", "front", "back", "above", "below", "three-quarter"),
)


@click.command(cls=Command)
@click.argument("volumes", nargs=-1, type=FILE, metavar="VOLUME...")
@click.option(
    "--levelset", type=FILE, metavar="PSI", help="The surface: a level set, a segmentation or a mesh. Without: slices."
)
@click.option("--compare", type=FILE, metavar="A", help="Show A beside VOLUME, and how they differ: --compare A B.")
@click.option(
    "-o", "--output", type=FILE, required=True, metavar="FILE", help=".html: a page for any browser. .png: a sheet."
)
@click.option("--titles", metavar="T1,T2..", help="Of the maps, in their order. Default: the names of the files.")
@click.option(
    "--side",
    type=click.Choice(SIDES),
    metavar="SIDE",
    help=f"From where the surface is seen first: {', '.join(SIDES)}. Default: where most of the data are seen.",
)
@click.option("--colours", metavar="NAME", help="A colour map of matplotlib or colorcet (cet_NAME): gray, cividis ...")
@click.option("--period", metavar="P", help="The values are angles of this period: 360, 2pi, 24 ...")
@click.option("--missing", type=float, metavar="VALUE", help="A value that means none, as NaN always does.")
@click.option("--map", metavar="NAME|N", help="Which map of values at vertices, where a file has several.")
@click.option("--labels", metavar="L1,L2..", help="PSI is a segmentation: these labels are inside.")
@click.option("--between", metavar="INNER,OUTER", help="The same, and the surface runs midway between the two labels.")
@click.option("--inside", type=click.Choice(["negative", "positive"]), default="negative", show_default=True)
@click.option("--spacing", metavar="S|SX,SY,SZ", help="Voxel size in mm of .npy inputs. Default: 1.")
@click.option("--resample", is_flag=True, help="Bring every VOLUME onto PSI's grid (trilinear).")
@frame_option
@overwrite_option
def view(
    volumes: tuple[Path, ...],
    levelset: Path | None,
    compare: Path | None,
    output: Path,
    titles: str | None,
    side: str | None,
    colours: str | None,
    period: str | None,
    missing: float | None,
    map: str | None,
    labels: str | None,
    between: str | None,
    inside: str,
    spacing: str | None,
    resample: bool,
    frame: str | None,
    overwrite: bool | None,
    quiet: bool,
    verbose: int,
) -> int:
    """Draw maps side by side on the surface where PSI is zero.

    VOLUME is any volume on PSI's grid or, where PSI is a mesh, values at its vertices. Meshes that hold values need no
    PSI. One or two maps are shown from four sides, with slices and histograms; more, from one side each.

    \b
        beltrami view denoised.nii.gz --levelset psi.nii.gz -o map.html
        beltrami view --compare noisy.nii.gz denoised.nii.gz --levelset psi.nii.gz -o both.png
        beltrami view angle.func.gii --levelset lh.inflated --period 360 -o angle.png
    """
    from beltrami_cli import viewing
    from beltrami_cli.config import parse_period, parse_spacing

    announce_compilation(quiet)
    asked = viewing.View(
        files=volumes if compare is None else (compare, *volumes),
        output=output,
        levelset=levelset,
        titles=() if titles is None else tuple(title.strip() for title in titles.split(",")),
        compare=compare is not None,
        side=side,
        colours=colours,
        period=None if period is None else parse_period(period),
        missing=missing,
        inside=inside,
        labels=labels,
        between=between,
        map=map,
        frame=frame,
        spacing=None if spacing is None else parse_spacing(spacing),
        resample=resample,
        overwrite=bool(overwrite),
    )
    viewing.look(asked, notify=lambda line: note(quiet, f"warning: {line}"))
    say(quiet, f"wrote {output}")
    return 0
