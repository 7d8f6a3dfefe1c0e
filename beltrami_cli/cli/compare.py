"""beltrami compare: figures of how two volumes differ, and a verdict against tolerances."""

from __future__ import annotations

import json
from pathlib import Path

import click

from beltrami_cli.cli.common import Command, announce_compilation, note, say

FILE = click.Path(path_type=Path)


@click.command(cls=Command)
@click.argument("a", type=FILE)
@click.argument("b", type=FILE)
@click.option("--levelset", type=FILE, metavar="PSI", help="Compare only near the surface of this level set ...")
@click.option("--within", type=float, metavar="MM", help="... within this distance. Default: half a voxel.")
@click.option("--period", metavar="P", help="Values are angles of this period (360, 2pi, 24); differences wrap.")
@click.option("--max-abs", type=float, metavar="X", help="Tolerance: the largest difference.")
@click.option("--max-rms", type=float, metavar="X", help="Tolerance: the root mean square difference.")
@click.option("--min-psnr", type=float, metavar="X", help="Tolerance: peak signal to noise in dB, over --data-range.")
@click.option("--data-range", type=float, metavar="R", help="Full scale for PSNR. Default: A's range, or --period.")
@click.option("--json", "as_json", is_flag=True, help="Print the figures as JSON.")
def compare(
    a: Path,
    b: Path,
    levelset: Path | None,
    within: float | None,
    period: str | None,
    max_abs: float | None,
    max_rms: float | None,
    min_psnr: float | None,
    data_range: float | None,
    as_json: bool,
    quiet: bool,
    verbose: int,
) -> int:
    """Compare volume B with the reference A where both have values; exit 1 where a tolerance is broken."""
    from beltrami_cli.config import parse_period
    from beltrami_cli.inspection import compare_volumes

    if within is not None and levelset is None:
        raise click.UsageError("--within needs --levelset, the surface to be near to")
    if levelset is not None:
        announce_compilation(quiet)
    found = compare_volumes(
        a, b, levelset=levelset, within=within, period=parse_period(period) if period else None, data_range=data_range
    )
    broken = found.exceeds(max_abs=max_abs, max_rms=max_rms, min_psnr=min_psnr)
    if as_json:
        say(quiet, json.dumps({**found.as_dict(), "broken": broken}, indent=2))
    else:
        say(quiet, f"compared  {found.compared} values ({found.only_in_a} only in A, {found.only_in_b} only in B)")
        say(quiet, f"B - A     max {found.max_abs:.6g}, rms {found.rms:.6g}, mean {found.mean:.6g}")
        say(quiet, f"psnr      {found.psnr:.2f} dB over a range of {found.data_range:.6g}")
        say(quiet, f"correlation {found.correlation:.6f}")
    judged = any(limit is not None for limit in (max_abs, max_rms, min_psnr))
    if judged and found.only_in_a:
        note(quiet, f"warning: {found.only_in_a} values of A are missing in B: no tolerance looks at them")
    for line in broken:
        click.echo(f"beltrami: out of tolerance: {line}", err=True)
    return 1 if broken else 0
