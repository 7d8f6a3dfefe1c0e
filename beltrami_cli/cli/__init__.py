"""The console command `beltrami`: one thin file per subcommand; heavy packages are imported inside them."""

from __future__ import annotations

import os
import signal
import sys
from typing import Any

import click

from beltrami_cli import __version__
from beltrami_cli.cli.batch import batch
from beltrami_cli.cli.common import last_words, report_error, silence
from beltrami_cli.cli.compare import compare
from beltrami_cli.cli.demo import demo
from beltrami_cli.cli.denoise import denoise
from beltrami_cli.cli.info import info
from beltrami_cli.cli.levelset import levelset
from beltrami_cli.cli.mesh import mesh
from beltrami_cli.cli.phantom import phantom
from beltrami_cli.cli.sample import sample
from beltrami_cli.cli.view import view

# What ends a run, and the exit code that it gives.
STOPPED: dict[int, int] = {signal.SIGINT: 130, signal.SIGTERM: 143}
if hasattr(signal, "SIGHUP"):  # a terminal that is closed, or a connection that is lost
    STOPPED[signal.SIGHUP] = 129

EPILOG = """Exit codes: 0 done; 1 the data or the numerics failed, or a comparison is out of tolerance; 2 usage, or
refused before starting; 130 on Ctrl-C; 143 on SIGTERM; 129 when the terminal is lost.

Shell completion: eval "$(_BELTRAMI_COMPLETE=bash_source beltrami)" (or zsh_source, fish_source)."""


@click.group(epilog=EPILOG, context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 110})
@click.version_option(__version__, prog_name="beltrami")
def beltrami() -> None:
    """Denoise data that lie on a surface - a level set, a segmentation or a mesh -, above all maps on the cortex."""


for command in (denoise, batch, levelset, mesh, sample, view, phantom, compare, info, demo):
    beltrami.add_command(command)


def main(args: list[str] | None = None) -> int:
    """Run the command line and return its exit code; every failure is one line on stderr."""
    for name in ("stdout", "stderr"):
        if getattr(sys, name) is None:  # closed by who started this
            silence(name)
    # A shell that starts a command in the background may have told it to ignore Ctrl-C, and nohup a lost terminal.
    heeded = [number for number in STOPPED if signal.getsignal(number) is not signal.SIG_IGN]
    before = {number: signal.signal(number, _stop) for number in heeded}
    try:
        return _run(args)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _run(args: list[str] | None) -> int:
    try:
        code = beltrami.main(args, prog_name="beltrami", standalone_mode=False)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        return error.exit_code
    except click.ClickException as error:
        if isinstance(error, click.UsageError) and error.ctx is not None:
            click.echo(error.ctx.get_usage(), err=True)
        click.echo(f"beltrami: {error.format_message()}", err=True)
        return error.exit_code
    except Exception as error:
        # Only what a command could not report itself, before its options were read.
        return report_error(error, verbose=False)
    return code if isinstance(code, int) else 0


def _stop(number: int, _frame: Any) -> None:
    """End the process here and now: an exception that meets a compiled function on its way out can crash it."""
    for other in STOPPED:  # a second one would come between two steps of this one's end
        signal.signal(other, signal.SIG_IGN)
    try:
        staging = sys.modules.get("beltrami_cli.formats.staging")  # else nothing is being written
        if staging is not None:
            staging.abandon()
        words = last_words()
        if words or number == signal.SIGINT:
            # Not on the line of the terminal's ^C, or of a bar.
            start = "\n" if number == signal.SIGINT or os.isatty(2) else ""
            os.write(2, f"{start}beltrami: {': '.join(['interrupted', *words])}\n".encode())
    finally:
        os._exit(STOPPED[number])
