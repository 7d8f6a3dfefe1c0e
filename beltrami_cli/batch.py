"""Many jobs: each on its own, as many at once as processes and memory allow, none twice, none lost."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import CancelledError, Future
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import Any, Literal

from beltrami_cli import __version__, cluster, formats, report
from beltrami_cli.config import Job
from beltrami_cli.errors import BeltramiError, BusyError, RefusedError, in_a_line
from beltrami_cli.executors import Workers, alone, deaths
from beltrami_cli.memory import needed, require_within
from beltrami_cli.record import forget_peak_memory, sidecar_of
from beltrami_cli.resume import finished, outputs_of
from beltrami_cli.study import Planned, files_of
from beltrami_cli.survey import Files, survey

# open: looked at, and not done yet. busy: another run is writing its outputs.
Status = Literal["done", "skipped", "failed", "open", "busy"]

# Seconds between two looks at what runs, for those who watch.
_LOOK = 0.5
# Seconds between two tries of a job whose outputs another run is writing.
_TRY_AGAIN = 2.0


@dataclass(frozen=True)
class Row:
    """What became of a job.

    seconds: of the run, as its sidecar says. noise_before, noise_after: standard deviation in data units, of several
    channels the root of their mean square; None where unknown. tries: how often it was started. reason: why it failed.
    """

    job: str
    config: str
    output: str
    status: Status
    seconds: float | None = None
    noise_before: float | None = None
    noise_after: float | None = None
    iterations: int | None = None
    stop_reason: str | None = None
    warnings: tuple[str, ...] = ()
    tries: int = 0
    reason: str = ""


@dataclass(frozen=True)
class Policy:
    """How a batch deals with what is there and with what goes wrong.

    resume: jobs that are done already are skipped, others replace what is there. overwrite: all replace what is there.
    retries: how often a job is started anew whose process died. memory: bytes that all jobs at once may be estimated
    to need; None for as much as `spare`, where a job that is alone may need more. spare: bytes that are free.
    """

    resume: bool = False
    overwrite: bool = False
    retries: int = 2
    memory: int | None = None
    spare: int | None = None


@dataclass(frozen=True)
class Running:
    """A job that is running now, or waits for another run that writes its outputs."""

    planned: Planned
    waits: bool = False

    @property
    def phase(self) -> str:
        if self.waits:
            return "waits for another run"
        return (formats.who_writes(sidecar_of(self.planned.job.volume)) or {}).get("phase", "")


def run(
    study: Sequence[Planned],
    executor: Workers,
    policy: Policy,
    *,
    settled: Callable[[Row], None] = lambda row: None,
    watch: Callable[[list[Running]], None] = lambda running: None,
    notify: Callable[[str], None] = lambda line: None,
) -> list[Row]:
    """What became of every job of the study, in its order; no job's failure stops another.

    settled: called with each row once it is final. watch: called about twice a second with what is running.
    notify: called with a line where a job has to wait for another run.
    """
    return _Batch(study, executor, policy, settled, watch, notify).run()


class _Batch:
    def __init__(
        self,
        study: Sequence[Planned],
        executor: Workers,
        policy: Policy,
        settled: Callable[[Row], None],
        watch: Callable[[list[Running]], None],
        notify: Callable[[str], None],
    ) -> None:
        self.study, self.executor, self.policy = study, executor, policy
        self.settled, self.watch, self.notify = settled, watch, notify
        self.waiting = deque(range(len(study)))
        self.busy: deque[tuple[float, int]] = deque()  # when to try again, and which job
        self.running: dict[Future[Row], int] = {}
        self.done: SimpleQueue[Future[Row]] = SimpleQueue()
        self.told_busy: set[int] = set()
        self.looked: set[int] = set()  # found open
        self.marks: dict[int, tuple[int, int] | None] = {}  # of records when jobs were first started
        self.taken: dict[int, int] = {}  # bytes by job
        self.tries = [0] * len(study)
        self.rows: list[Row | None] = [None] * len(study)

    def run(self) -> list[Row]:
        while self.waiting or self.running or self.busy:
            try:
                self._start()
            except ConnectionError as error:
                self._give_up(str(error))
            with suppress(Empty):
                self._take(self.done.get(timeout=_LOOK))
                while True:
                    self._take(self.done.get_nowait())
            waiting = [Running(self.study[k], waits=True) for _, k in self.busy]
            self.watch([*(Running(self.study[k]) for k in self.running.values()), *waiting])
        return [row for row in self.rows if row is not None]

    def _start(self) -> None:
        """Start jobs while there is room for them, those that wait for another run last."""
        now = time.monotonic()
        while len(self.running) < self.executor.slots():
            if self.waiting:
                k = self.waiting[0]
            elif self.busy and self.busy[0][0] <= now:
                k = self.busy[0][1]
            else:
                return
            # With others' memory in mind only jobs are started that are known to be open.
            looks = self.policy.resume and self.executor.one_machine and k not in self.looked
            try:
                if not looks and not self._has_room(k):
                    return
                if k not in self.marks:
                    _require_free(self.study[k].job, self.policy)
            except Exception as error:
                self._pop()
                self._fail(k, _reason(error))
                continue
            self._pop()
            self._submit(k, looks)

    def _give_up(self, reason: str) -> None:
        """Nothing more can be started."""
        for k in (*self.waiting, *(k for _, k in self.busy)):
            self._fail(k, reason)
        self.waiting.clear()
        self.busy.clear()

    def _pop(self) -> None:
        if self.waiting:
            self.waiting.popleft()
        else:
            self.busy.popleft()

    def _submit(self, k: int, only_look: bool) -> None:
        policy, job = self.policy, self.study[k].job
        replaces = policy.overwrite or job.overwrite
        mark = _mark(job)
        # A second try finds what the first one finished.
        look = policy.resume or not replaces or mark != self.marks.setdefault(k, mark)
        job = replace(job, overwrite=replaces or policy.resume)
        limit = None if self.executor.one_machine else policy.memory
        self.tries[k] += 1
        asked = replace(self.study[k], job=job), look, only_look, limit, __version__
        try:
            future = self.executor.submit(perform, *asked)
        except Exception as error:  # the executor itself is lost
            future = Future()
            future.set_exception(error)
        self.running[future] = k
        future.add_done_callback(self.done.put)

    def _has_room(self, k: int) -> bool:
        """True where the job fits beside those that run; raises RefusedError where it never will, and as `needed`."""
        if not self.executor.one_machine:
            return True  # every worker looks for itself
        if k not in self.taken:
            self.taken[k] = needed(self.study[k].job)
        if self.policy.memory is not None:
            require_within(self.taken[k], self.policy.memory)
        limit = self.policy.memory if self.policy.memory is not None else self.policy.spare
        others = sum(self.taken.get(other, 0) for other in self.running.values())
        return not self.running or limit is None or others + self.taken[k] <= limit

    def _take(self, future: Future[Row]) -> None:
        """What a job came to: settled, or to be tried again."""
        k = self.running.pop(future)
        error = CancelledError("the connection was lost") if future.cancelled() else future.exception()
        if error is not None:
            lost = deaths(error)
            self.tries[k] += max(lost - 1, 0)
            if lost and self.tries[k] <= self.policy.retries:
                self.waiting.append(k)
            else:
                self._fail(k, _lost(self.tries[k], error) if lost else _not_understood(error))
            return
        row = future.result()
        # A worker that is told to end does so after its job, which Dask has given to another meanwhile.
        if row.status == "busy" and (self.policy.resume or not self.executor.one_machine):
            self.tries[k] -= 1
            self.busy.append((time.monotonic() + _TRY_AGAIN, k))
            if k not in self.told_busy:
                self.told_busy.add(k)
                self.notify(f"{row.job}: waits: {row.reason}")
        elif row.status == "open":
            self.tries[k] -= 1
            self.looked.add(k)
            self.waiting.appendleft(k)
        elif row.status == "busy":
            reason = f"{row.reason}; with --resume the batch waits for it, and skips what it did"
            self._settle(k, replace(row, status="failed", reason=reason))
        elif row.status == "skipped" and not self.policy.resume:
            self._settle(k, replace(row, status="done"))
        else:
            self._settle(k, row)

    def _settle(self, k: int, row: Row) -> None:
        self.rows[k] = row = replace(row, tries=0 if row.status == "skipped" else self.tries[k])
        self.settled(row)

    def _fail(self, k: int, reason: str) -> None:
        self._settle(k, Row(*_names(self.study[k]), "failed", reason=reason))


@dataclass(frozen=True)
class Plan:
    """What a batch would do with a job: "run", "skip" or "fail", why it would fail, and the memory it would need."""

    what: str
    reason: str = ""
    memory: int | None = None


def foresee(planned: Planned, policy: Policy) -> Plan:
    """What a batch with this policy would do with a job, from headers, and with `resume` from the inputs' hashes."""
    try:
        if policy.resume and finished(planned.job) is not None:
            return Plan("skip")
        scene = survey(planned.job)
        size = needed(planned.job, scene)
        for limit in (policy.memory, planned.job.memory):
            if limit is not None:
                require_within(size, limit)
        _require_free(planned.job, policy)
        _require_writable(planned.job, Files(planned.job, scene).all, policy)
    except Exception as error:
        return Plan("fail", _reason(error))
    return Plan("run", "", size)


def perform(planned: Planned, look: bool, only_look: bool, limit: int | None, version: str) -> Row:
    """Do a job in this process, and say what became of it; never raises.

    look: skip it where it is done already. only_look: do no more; where it is not done it is "open". limit: bytes that
    it may be estimated to need. version: of the program that asks; another here is refused.
    """
    names = _names(planned)
    warnings: list[str] = []
    try:
        with alone:
            if version != __version__:
                raise RefusedError(f"worker: has beltrami_cli {__version__}; expected {version}: install the same")
            record = finished(planned.job) if look else None
            if record is not None:
                _sweep(planned.job, record)
                return Row(*names, "skipped", **_figures(record))
            if only_look:
                return Row(*names, "open")
            return Row(*names, "done", **_figures(_run(planned.job, look, limit, warnings)))
    except BusyError as error:
        return Row(*names, "busy", reason=str(error))
    except Exception as error:
        return Row(*names, "failed", warnings=tuple(warnings), reason=_reason(error))


def _reason(error: Exception) -> str:
    """Why a job failed, in a line."""
    if isinstance(error, BeltramiError):
        return cluster.own_place() + str(error)
    if isinstance(error, MemoryError):
        return "out of memory; use a smaller --band, crop the volumes to the surface, or run fewer jobs at once"
    return f"unexpected {type(error).__name__}: {_line(error)} (please report it)"


def _sweep(job: Job, record: dict[str, Any]) -> None:
    """Remove what killed runs left of a job that is done."""
    with suppress(RefusedError):  # of a study that is done and locked nothing can be removed
        formats.Stage(outputs_of(record, sidecar_of(job.volume)), overwrite=True).sweep()


def _run(job: Job, look: bool, limit: int | None, warnings: list[str]) -> dict[str, Any]:
    """Run a job; its record."""
    from beltrami_cli import pipeline

    limits = [size for size in (limit, cluster.own_memory()) if size is not None]
    if limits:
        require_within(needed(job), min(limits))
    if job.settings.threads is None:
        job = replace(job, settings=replace(job.settings, threads=cluster.own_threads()))
    _make_folders(job)
    forget_peak_memory()
    unless = (lambda: finished(job)) if look else (lambda: None)
    return pipeline.run(job, notify=warnings.append, unless=unless).record


def _make_folders(job: Job) -> None:
    """Make the folders of the outputs, once the inputs are there."""
    for path in job.all_inputs:
        formats.require_file(path)
    outputs = (job.volume, *(job.mesh or ()), job.filled, job.report, *(file for _, file in job.on))
    for folder in {output.parent for output in outputs if output is not None}:
        _make_folder(folder)


def _make_folder(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise RefusedError(
            f"{folder}: cannot be made ({error.strerror}); choose another folder for the output"
        ) from error


def _require_writable(job: Job, files: Iterable[Path], policy: Policy) -> None:
    """Raise RefusedError where a file of the job could not be written, its folder being made where there is none."""
    there = []
    for file in files:
        if file.parent.is_dir():
            there.append(file)
        else:
            _require_can_be_made(file.parent)
    formats.Stage(there, overwrite=policy.resume or policy.overwrite or job.overwrite, inputs=job.all_inputs)


def _require_can_be_made(folder: Path) -> None:
    """Raise RefusedError unless what there is of a folder's path is a folder that can be written to."""
    there = next(each for each in (folder, *folder.parents) if os.path.lexists(each))
    if not there.is_dir() or not os.access(there, os.W_OK | os.X_OK):
        what = "cannot be written to" if there.is_dir() else "is no folder"
        raise RefusedError(f"{there}: {what}; choose another folder for the output")


def _require_free(job: Job, policy: Policy) -> None:
    if policy.resume or policy.overwrite or job.overwrite:
        return
    sidecar = sidecar_of(job.volume)
    if formats.is_unfinished(sidecar):
        return
    for final in (job.volume, sidecar):
        if final.exists():
            raise RefusedError(f"{final}: exists already; --resume skips what is done, --overwrite replaces it")


def _mark(job: Job) -> tuple[int, int] | None:
    """What tells one record of a job from another; None where there is none."""
    try:
        found = sidecar_of(job.volume).stat()
    except OSError:
        return None
    return found.st_mtime_ns, found.st_ino


def _names(planned: Planned) -> tuple[str, str, str]:
    return planned.name, str(planned.config), str(planned.job.volume)


def _figures(record: dict[str, Any]) -> dict[str, Any]:
    """Of a record, what a row tells."""
    noise = record["Noise"]
    return {
        "seconds": round(sum(record["Seconds"].values()), 3),
        "noise_before": _mean(noise.get("sd")),
        "noise_after": _mean(noise.get("after")),
        "iterations": record["Iterations"],
        "stop_reason": record["StopReason"],
        "warnings": tuple(record["Warnings"]),
    }


def _mean(per_channel: Iterable[float | None] | None) -> float | None:
    """The root of the mean square of the known ones."""
    known = [sd for sd in per_channel or () if sd is not None]
    return math.sqrt(sum(sd * sd for sd in known) / len(known)) if known else None


def _not_understood(error: BaseException) -> str:
    return (
        f"worker: cannot take the job ({type(error).__name__}: {_line(error)}); expected the same Python, beltrami_cli "
        "and Dask there, at the scheduler and here"
    )


def _lost(tries: int, error: BaseException) -> str:
    times = "once" if tries == 1 else f"{tries} times of {tries}"
    last = getattr(error, "last_worker", None)  # of Dask's KilledWorker, whose own text is a paragraph
    why = _line(error) if last is None else f"the last time on worker {last.address}, see its log"
    return (
        f"its process died, {times} ({why}): out of memory, or killed? Give it more memory, or run fewer jobs at once"
    )


def _line(error: BaseException) -> str:
    return in_a_line(error) or type(error).__name__


def write_summary(path: Path, rows: Sequence[Row], study: Sequence[Planned] = ()) -> None:
    """Write rows as .csv or .json, or as a page (.html) with links to the reports of the study's jobs.

    Replaces what is there; makes its folder. Raises RefusedError where it cannot.
    """
    kind = _summary_format(path)
    _make_folder(path.parent)
    with formats.Stage([path], overwrite=True) as stage:
        if kind == "html":
            from beltrami_cli.report import index

            pages = {planned.name: planned.job.report for planned in study}
            index.write(stage.path(path), [asdict(row) for row in rows], pages, folder=path.absolute().parent)
        else:
            text = _as_csv(rows) if kind == "csv" else _as_json(rows)
            with formats.writing(path):
                stage.path(path).write_text(text, encoding="utf-8", errors="backslashreplace", newline="")
        stage.commit()


def require_summary(path: Path, study: Sequence[Planned], policy: Policy) -> None:
    """Raise RefusedError where a summary cannot be written, or would replace what is no summary."""
    if _summary_format(path) == "html":
        report.require(path)
    if os.path.realpath(path) in files_of(study):
        raise RefusedError(f"{path}: is a file of the study, which the summary would replace; give another name")
    if os.path.lexists(path):
        if not (policy.resume or policy.overwrite):
            raise RefusedError(f"{path}: exists already; --resume goes on where it stopped, or give another name")
        if not _is_summary(path):
            raise RefusedError(f"{path}: is no summary of a batch, and stays; give another name")
    _require_can_be_made(path.absolute().parent)


def _is_summary(path: Path) -> bool:
    """True where a file looks as `write_summary` of this or another version writes it."""
    try:
        text = path.read_text(encoding="utf-8")
        if _summary_format(path) == "csv":
            return text.startswith("job,config,output,status,")
        if _summary_format(path) == "html":
            return report.INDEX in text
        rows = json.loads(text)
        return isinstance(rows, list) and all(isinstance(row, dict) and {"job", "status"} <= row.keys() for row in rows)
    except (OSError, ValueError):
        return False


def _summary_format(path: Path) -> str:
    """csv, json or html; raises RefusedError for another suffix."""
    suffix = path.suffix.lower()
    if suffix not in (".csv", ".json", ".html"):
        raise RefusedError(f"summary: found {path}; expected a name that ends in .csv, .json or .html")
    return suffix[1:]


def _as_json(rows: Sequence[Row]) -> str:
    return json.dumps([asdict(row) for row in rows], indent=2, allow_nan=False) + "\n"


def _as_csv(rows: Sequence[Row]) -> str:
    text = io.StringIO()
    writer = csv.DictWriter(text, list(Row.__dataclass_fields__), lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({**asdict(row), "warnings": " | ".join(row.warnings)})
    return text.getvalue()
