"""beltrami info: what a volume holds and whether it can be a level set."""

from __future__ import annotations

from pathlib import Path

import click

from beltrami_cli.cli.common import Command, report_error, say


@click.command(cls=Command)
@click.argument("files", nargs=-1, required=True, type=click.Path(path_type=Path), metavar="FILE...")
def info(files: tuple[Path, ...], quiet: bool, verbose: int) -> int:
    """Print grid, orientation, values and, for a level set, its surface, of each FILE."""
    from beltrami_cli.errors import BeltramiError
    from beltrami_cli.inspection import describe_volume

    code = 0
    for path in files:
        try:
            lines = describe_volume(path)
        except BeltramiError as error:  # the other files still get their turn
            code = max(code, report_error(error, verbose=bool(verbose)))
            continue
        say(quiet, "\n  ".join([str(path), *lines]))
    return code
