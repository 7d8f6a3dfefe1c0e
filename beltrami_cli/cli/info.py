"""beltrami info: what a volume, a surface or vertex data holds."""

from __future__ import annotations

from pathlib import Path

import click

from beltrami_cli.cli.common import Command, report_error, say


@click.command(cls=Command)
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="FILE...")
def info(files: tuple[Path, ...], quiet: bool, verbose: int) -> int:
    """Print what each FILE holds: a volume's grid, orientation, values and, for a level set, its zero level; a
    surface's vertices, place, border and structure; the maps of vertex data."""
    from beltrami_cli.errors import BeltramiError
    from beltrami_cli.inspection import describe

    code = 0
    for path in files:
        try:
            lines = describe(path)
        except BeltramiError as error:  # the other files still get their turn
            code = max(code, report_error(error, verbose=bool(verbose)))
            continue
        say(quiet, "\n  ".join([str(path), *lines]))
    return code
