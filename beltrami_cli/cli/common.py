"""What every subcommand shares: -q, -v, and how failures are told."""

from __future__ import annotations

import os
import re
import sys
import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Literal

import click

from beltrami_cli.errors import BeltramiError, DataError, in_a_line

# What commands that are running have to say where a signal ends them.
_LAST_WORDS: list[Callable[[], str]] = []


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
        _tell("".join(traceback.format_exception(error)).rstrip())
    if isinstance(error, BeltramiError):
        _tell(f"beltrami: {short(str(error))}")
        return error.exit_code
    if isinstance(error, MemoryError):
        _tell("beltrami: out of memory; use a smaller --band, or crop the volumes to the surface")
        return 1
    line = in_a_line(error) or "no message"
    _tell(f"beltrami: unexpected {type(error).__name__}: {line}; -v shows where (please report it)")
    return 1


def say(quiet: bool, line: str) -> None:
    """A line of result on stdout, unless quiet; raises DataError where it cannot be written."""
    if quiet:
        return
    try:
        click.echo(_printable(line))
    except BrokenPipeError:
        raise
    except OSError as error:
        silence("stdout")
        raise DataError(f"stdout: cannot be written to ({error.strerror}); check the disk") from error


def note(quiet: bool, line: str) -> None:
    """A line about the run on stderr, unless quiet."""
    if not quiet:
        _tell(f"beltrami: {line}")


def _tell(line: str) -> None:
    with unheard():
        click.echo(_printable(line), err=True)


def _printable(line: str) -> str:
    """The line with names that are no text, as files may have them, spelt out."""
    return line.encode("utf-8", "backslashreplace").decode("utf-8")


@contextmanager
def unheard() -> Iterator[None]:
    """For what is told on stderr: where that is broken nobody is told any more, and the work goes on."""
    try:
        yield
    except OSError:
        silence("stderr")


def silence(name: Literal["stdout", "stderr"]) -> None:
    """Say nothing more there: what a broken stream still holds would fail again when the process ends."""
    setattr(sys, name, open(os.devnull, "w", encoding="utf-8"))  # noqa: SIM115


@contextmanager
def at_stop(word: Callable[[], str]) -> Iterator[None]:
    """Where a signal ends the process in this block, `word` is called, and what it gives is told."""
    _LAST_WORDS.append(word)
    try:
        yield
    finally:
        _LAST_WORDS.remove(word)


def last_words() -> list[str]:
    return [word() for word in _LAST_WORDS]


def short(text: str) -> str:
    """Paths in the working folder as seen from there."""
    try:
        here = re.escape(os.getcwd() + os.sep)
    except OSError:  # it has been removed
        return text
    return re.sub(rf"""(?<![^\s"'(\[=:]){here}""", "", text)  # not from the middle of a longer path


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
