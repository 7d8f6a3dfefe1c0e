"""beltrami batch: many jobs from configs, here or on a cluster."""

from __future__ import annotations

import re
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import click

from beltrami_cli.cli.common import (
    Command,
    announce_compilation,
    at_stop,
    note,
    overwrite_option,
    say,
    short,
    unheard,
)

if TYPE_CHECKING:
    from beltrami_cli.batch import Policy, Row, Running
    from beltrami_cli.executors import Workers
    from beltrami_cli.study import Planned

FILE = click.Path(path_type=Path)

# Jobs whose phase is shown beside the bar: more do not fit a line, and each is a look at the disk.
MOST_SHOWN = 3


@click.command(cls=Command)
@click.argument("configs", nargs=-1, required=True, type=FILE, metavar="CONFIG...")
@click.option("--jobs", type=click.IntRange(1), metavar="N", help="Jobs at once on this machine. Default: 1.")
@click.option(
    "--scheduler", metavar="ADDRESS", help="Run on a Dask cluster: its scheduler's address, or its .json file."
)
@click.option("--resume", is_flag=True, help="Skip jobs that are done already; redo the others.")
@click.option("--dry-run", is_flag=True, help="Print what would be run, and run nothing.")
@click.option(
    "--summary", type=FILE, metavar="FILE", help="Write what became of the jobs as .csv or .json; one for each part."
)
@click.option(
    "--report", type=FILE, metavar="FILE.html", help="The same as a page, with links to the jobs' own reports."
)
@click.option("--part", metavar="K/N", help="Only every N-th job from the K-th: for a scheduler's array of jobs.")
@click.option("--threads", type=click.IntRange(1), help="Of each job. Default: the CPUs shared by the jobs at once.")
@click.option(
    "--memory",
    metavar="LIMIT",
    help="Start jobs only while they are estimated to need less together: 8G, 500M. Default: what is free.",
)
@click.option(
    "--retries",
    type=click.IntRange(0),
    default=2,
    show_default=True,
    help="How often a job is started again whose process died.",
)
@overwrite_option
def batch(
    configs: tuple[Path, ...],
    jobs: int | None,
    scheduler: str | None,
    resume: bool,
    dry_run: bool,
    summary: Path | None,
    report: Path | None,
    part: str | None,
    threads: int | None,
    memory: str | None,
    retries: int,
    overwrite: bool | None,
    quiet: bool,
    verbose: int,
) -> int:
    """Run the jobs of TOML configs: each as denoise --config would, one's failure not stopping the others.

    A config with [for_each] makes many: every {NAME} in its texts is replaced.

    \b
        [for_each]
        subject = ["01", "02"]
        [input]
        levelset = "sub-{subject}/psi.nii.gz"
        data = "sub-{subject}/angle.nii.gz"
        [output]
        volume = "out/sub-{subject}_angle.nii.gz"

    \b
        beltrami batch study.toml --dry-run
        beltrami batch study.toml --jobs 4 --resume --summary study.csv

    Folders of outputs are made. A line tells of each job as it ends, on a terminal a bar with what runs; with -v the
    warnings of each job too. Exit code 1 where a job failed: its reason stands in the table. A batch that is stopped,
    by Ctrl-C too, leaves nothing half-written; the same command with --resume goes on.
    """
    from beltrami_cli import study as studies
    from beltrami_cli.batch import Policy, require_summary, run, write_summary
    from beltrami_cli.config import parse_memory
    from beltrami_cli.memory import available

    if resume and overwrite:
        raise click.UsageError("--resume keeps what is done and --overwrite replaces it; give one of them")
    if scheduler is not None and jobs is not None:
        raise click.UsageError("--jobs is for this machine and --scheduler for a cluster; give one of them")
    limit = None if memory is None else parse_memory(memory)
    policy = Policy(resume, bool(overwrite), retries, limit, available())
    whole = studies.read_study(configs)
    study = whole if part is None else studies.part(whole, part)
    for option, path, suffixes in (("summary", summary, (".csv", ".json")), ("report", report, (".html",))):
        if path is not None and path.suffix.lower() not in suffixes:
            raise click.UsageError(f"--{option}: found {path}; expected a name that ends in {' or '.join(suffixes)}")
    summaries = [path for path in (summary, report) if path is not None]
    for path in summaries:
        require_summary(path, whole, policy)
    if not study:
        say(quiet, f"no jobs in part {part} of {_jobs(len(whole))}")
    if dry_run:
        return _tell_plan(study, policy, quiet)
    announce_compilation(quiet)
    at_once = min(jobs or 1, max(len(study), 1))
    study = _with_threads(study, threads, None if scheduler else at_once)
    known: dict[str, Row | None] = {planned.name: None for planned in study}
    with at_stop(partial(_stopped, known, summaries, study, bool(overwrite))):
        with (
            _workers(scheduler, at_once, study, quiet) as workers,
            _Progress(known, quiet, bool(verbose)) as progress,
        ):
            rows = run(study, workers, policy, settled=progress.settled, watch=progress.watch, notify=progress.notify)
        try:
            for path in summaries:
                write_summary(path, rows, study)
        finally:
            _tell_rows(rows, quiet)
    return 1 if any(row.status == "failed" for row in rows) else 0


def _stopped(
    known: Mapping[str, Row | None], summaries: Sequence[Path], study: Sequence[Planned], overwrite: bool
) -> str:
    """How far a batch is that a signal ends now; the summaries of what is settled are written."""
    from beltrami_cli.batch import write_summary

    rows = [row for row in known.values() if row is not None]
    for path in summaries:
        with suppress(Exception):
            write_summary(path, rows, study)
    failed = sum(row.status == "failed" for row in rows)
    told = f"{len(rows) - failed} of {_jobs(len(known))} done" + (f", {failed} failed" if failed else "")
    return f"{told}; the same command with --resume{' in place of --overwrite' if overwrite else ''} goes on"


def _with_threads(study: Sequence[Planned], threads: int | None, at_once: int | None) -> list[Planned]:
    """The study with threads for each job, where its config says none: of this machine's CPUs a fair share.

    at_once: jobs; None on a cluster, where each worker knows its own.
    """
    from beltrami_cli.solver import cpus

    share = threads if at_once is None else threads or max(1, cpus() // at_once)
    return [
        replace(planned, job=replace(planned.job, settings=replace(planned.job.settings, threads=share)))
        if threads or planned.job.settings.threads is None
        else planned
        for planned in study
    ]


def _workers(
    scheduler: str | None, at_once: int, study: Sequence[Planned], quiet: bool
) -> AbstractContextManager[Workers]:
    if scheduler is not None:
        from beltrami_cli.cluster import cluster

        return cluster(scheduler, lambda line: note(quiet, line))
    from beltrami_cli.executors import Processes
    from beltrami_cli.solver import cpus

    most = max((planned.job.settings.threads or 1 for planned in study), default=1)
    return Processes(at_once, min(most, cpus()))


class _Progress:
    """What is seen of a batch while it runs: on a terminal a bar with what runs, else a line for each job.

    known: what became of each job by its name, None until it is settled.
    """

    def __init__(self, known: dict[str, Row | None], quiet: bool, verbose: bool) -> None:
        self.known, self.quiet, self.verbose, self.bar = known, quiet, verbose, None
        self.on_terminal = not quiet and sys.stderr.isatty()

    def __enter__(self) -> _Progress:
        if self.on_terminal:
            from tqdm import tqdm

            # A short bar: what runs needs the room.
            line = "{n_fmt}/{total_fmt} jobs |{bar:10}| {elapsed}<{remaining}{postfix}"
            self.bar = tqdm(total=len(self.known), bar_format=line, leave=False, file=sys.stderr, dynamic_ncols=True)
        return self

    def __exit__(self, *_: object) -> None:
        if self.bar is not None:
            with unheard():
                self.bar.close()

    def settled(self, row: Row) -> None:
        self.known[row.job] = row
        past = sum(row is not None for row in self.known.values())
        lines = [f"{past}/{len(self.known)} {row.job}: {_outcome(row)}"]
        if self.verbose:
            lines += [f"{row.job}: warning: {short(warning)}" for warning in row.warnings]
        if self.bar is not None:
            with unheard():
                self.bar.update()
        # A bar has counted those that are done already.
        if row.status == "failed" or (not self.quiet and (self.bar is None or self.verbose)):
            for line in lines:
                self._tell(line)

    def notify(self, line: str) -> None:
        if not self.quiet:
            self._tell(line)

    def watch(self, running: list[Running]) -> None:
        if self.bar is None:
            return
        shown = [f"{_values(one.planned.name)}: {one.phase or 'starting'}" for one in running[:MOST_SHOWN]]
        more = f" and {len(running) - len(shown)} more" if len(running) > len(shown) else ""
        with unheard():
            self.bar.set_postfix_str("; ".join(shown) + more)

    def _tell(self, line: str) -> None:
        if self.bar is None:
            note(False, line)
        else:
            with unheard():
                self.bar.write(f"beltrami: {line}", file=sys.stderr)


def _values(name: str) -> str:
    """The name of a job without the names in it: "01 lh" of "subject=01 hemi=lh"."""
    return re.sub(r"(^| )\w+=", r"\1", name)


def _outcome(row: Row) -> str:
    if row.status == "failed":
        return f"failed: {short(row.reason)}"
    return f"done, {row.seconds:.1f} s" if row.status == "done" and row.seconds is not None else row.status


def _tell_plan(study: Sequence[Planned], policy: Policy, quiet: bool) -> int:
    """Print the jobs as they would be run; exit code 1 where one would fail."""
    from beltrami_cli.batch import foresee
    from beltrami_cli.memory import told

    plans = [foresee(planned, policy) for planned in study]
    cells = [("job", "plan", "memory", "output")]
    for planned, plan in zip(study, plans, strict=True):
        memory = "" if plan.memory is None else told(plan.memory)
        cells.append((planned.name, plan.what, memory, short(str(planned.job.volume))))
    _tell_table(cells, [plan.reason for plan in plans], quiet)
    counts = Counter(plan.what for plan in plans)
    _tell_sums(len(study), [f"{number} to {what}" for what, number in counts.items()], quiet)
    return 1 if counts["fail"] else 0


def _tell_rows(rows: Sequence[Row], quiet: bool) -> None:
    """Print the final table and its sums."""
    cells: list[tuple[str, ...]] = [("job", "status", "seconds", "noise before", "after", "stopped by")]
    for row in rows:
        seconds = "" if row.seconds is None else f"{row.seconds:.1f}"
        noise = tuple("" if sd is None else f"{sd:.4g}" for sd in (row.noise_before, row.noise_after))
        cells.append((row.job, row.status, seconds, *noise, row.stop_reason or ""))
    _tell_table(cells, [row.reason for row in rows], quiet)
    counts = Counter(row.status for row in rows)
    warned = sum(bool(row.warnings) for row in rows)
    told = [f"{number} {status}" for status, number in sorted(counts.items())]
    _tell_sums(len(rows), told, quiet, f"; {warned} with warnings, see their records, or -v" if warned else "")


def _tell_table(cells: Sequence[tuple[str, ...]], reasons: Sequence[str], quiet: bool) -> None:
    """Print rows below their head in aligned columns, those that are not empty, and each one's reason below it."""
    widths = [max(map(len, column)) if any(column[1:]) else 0 for column in zip(*cells, strict=True)]
    for row, reason in zip(cells, ["", *reasons], strict=True):
        shown = [cell.ljust(width) for cell, width in zip(row, widths, strict=True) if width]
        if shown:
            say(quiet, "  ".join(shown).rstrip())
        if reason:
            say(quiet, f"    {short(reason)}")


def _tell_sums(count: int, parts: Sequence[str], quiet: bool, more: str = "") -> None:
    if count:
        say(quiet, f"{_jobs(count)}: {', '.join(parts)}{more}")


def _jobs(count: int) -> str:
    return "1 job" if count == 1 else f"{count} jobs"
