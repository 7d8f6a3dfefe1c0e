"""What every subcommand shares: -q, -v, and how failures are told."""

from __future__ import annotations

import os
import traceback
from typing import Any

import click

from beltrami_cli.errors import BeltramiError


class Command(click.Command):
    """A subcommand with -q and -v whose failures become one line on stderr and an exit code."""

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self.params += [
            click.Option(["-q", "--quiet"], is_flag=True, help="Print nothing but errors."),
            click.Option(["-v", "--verbose"], count=True, help="Say more; on an error, show where it arose."),
        ]

    def invoke(self, ctx: click.Context) -> Any:
        """Run the command; its return value is the exit code (None: 0)."""
        try:
            return super().invoke(ctx)
        except (click.ClickException, BrokenPipeError):  # click ends quietly when the reader of a pipe has left
            raise
        except Exception as error:
            return report_error(error, verbose=bool(ctx.params.get("verbose")))


def report_error(error: Exception, *, verbose: bool) -> int:
    """Print the error as one line (the whole traceback too, if verbose) and return its exit code."""
    if verbose:
        click.echo("".join(traceback.format_exception(error)).rstrip(), err=True)
    if isinstance(error, BeltramiError):
        click.echo(f"beltrami: {error}", err=True)
        return error.exit_code
    if isinstance(error, MemoryError):
        click.echo("beltrami: out of memory; use a smaller --band, or crop the volumes to the surface", err=True)
        return 1
    line = " ".join(str(error).split()) or "no message"
    click.echo(f"beltrami: unexpected {type(error).__name__}: {line}; -v shows where (please report it)", err=True)
    return 1


def say(quiet: bool, line: str) -> None:
    """A line of result on stdout, unless quiet."""
    if not quiet:
        click.echo(line)


def note(quiet: bool, line: str) -> None:
    """A line about the run on stderr, unless quiet."""
    if not quiet:
        click.echo(f"beltrami: {line}", err=True)


def short(text: str) -> str:
    """Paths in the working folder as seen from there."""
    return text.replace(os.getcwd() + os.sep, "")


def announce_compilation(quiet: bool) -> None:
    """Say so before the first-ever run, which compiles the kernels."""
    from beltrami_cli.kernels import are_cached

    if not are_cached():
        note(quiet, "compiling the numerical kernels: this first time only, up to a minute")


def overwrite_option(command: Any) -> Any:
    return click.option("--overwrite", is_flag=True, default=None, help="Replace outputs that exist.")(command)


def frame_option(command: Any) -> Any:
    return click.option(
        "--frame",
        type=click.Choice(["scanner", "tkr"]),
        help="The coordinates of surfaces: scanner RAS, or FreeSurfer's surface RAS. Default: what the file says.",
    )(command)
