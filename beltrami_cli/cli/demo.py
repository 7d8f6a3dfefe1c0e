"""beltrami demo: the main job on a small surface, with a picture."""

from __future__ import annotations

from pathlib import Path

import click

from beltrami_cli.cli.common import Command, announce_compilation, note, overwrite_option, say
from beltrami_cli.cli.denoise import summary


@click.command(cls=Command)
@click.argument("outdir", type=click.Path(path_type=Path, file_okay=False), default="beltrami_demo")
@click.option(
    "--from",
    "source",
    type=click.Path(path_type=Path, file_okay=False),
    help="A folder with levelset, clean and noisy volumes, as phantom writes it. Default: a torus made on the spot.",
)
@overwrite_option
def demo(outdir: Path, source: Path | None, overwrite: bool | None, quiet: bool, verbose: int) -> int:
    """Denoise a noisy map on a torus into OUTDIR: volume, mesh and picture."""
    from beltrami_cli.demo import run_demo
    from beltrami_cli.progress import iteration_bar

    announce_compilation(quiet)
    with iteration_bar("flow", quiet=quiet) as observer:
        shown = run_demo(outdir, source, overwrite=bool(overwrite), observer=observer)
    for line in summary(shown.record):
        say(quiet, line)
    say(quiet, f"PSNR on the surface: {shown.psnr_before:.1f} dB noisy, {shown.psnr_after:.1f} dB denoised")
    if shown.picture is None:
        note(quiet, "for a picture as well: pip install 'beltrami_cli[report]'")
    say(quiet, f"look at {shown.picture or shown.mesh}")
    return 0
