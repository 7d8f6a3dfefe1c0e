"""`beltrami batch`: every job once, in any state of what is there, and a table that tells what became of each."""

from __future__ import annotations

import contextlib
import csv
import errno
import io
import json
import os
import shutil
import signal
import sys
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, Future
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import ball, beltrami, contents, done, nifti, noisy, record, refused
from studies import Here, essence, write_study
from studies import batch as batch_in_processes

from beltrami_cli import batch, executors, pipeline, resume
from beltrami_cli.batch import Policy, Row
from beltrami_cli.cli import main
from beltrami_cli.cli.batch import _values
from beltrami_cli.cli.common import short
from beltrami_cli.executors import Workers
from beltrami_cli.formats import Stage
from beltrami_cli.study import Planned, read_study


def engine(config: Path, **policy: Any) -> list[Row]:
    return batch.run(read_study([config]), Here(), Policy(**policy))


def statuses(rows: list[Row]) -> list[str]:
    return [row.status for row in rows]


@pytest.fixture(scope="module")
def three_jobs(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("study")
    assert statuses(engine(write_study(folder, 3))) == ["done"] * 3
    return folder


@pytest.fixture
def three_done(three_jobs, tmp_path) -> Path:
    """The folder of a study whose three jobs are done."""
    return Path(shutil.copytree(three_jobs, tmp_path / "copy"))


@pytest.fixture
def here(monkeypatch):
    """The command does its jobs in this process."""
    monkeypatch.setattr(executors, "Processes", lambda *_: Here())


# What is said


def test_the_table_and_the_summary_say_what_the_records_say(tmp_path, here):
    config = write_study(tmp_path, 3)
    (tmp_path / "data-2.nii.gz").unlink()
    run = beltrami("batch", config, "--summary", tmp_path / "s.json")
    assert run.code == 1
    rows = json.loads((tmp_path / "s.json").read_text())
    assert [(row["job"], row["status"], row["tries"]) for row in rows] == [
        ("k=1", "done", 1),
        ("k=2", "failed", 0),
        ("k=3", "done", 1),
    ]
    for row in (rows[0], rows[2]):
        told = record(tmp_path / "out" / f"{row['job'][-1]}.json")
        assert row["config"] == str(config)
        assert row["output"] == told["Outputs"][0]
        assert row["seconds"] == pytest.approx(sum(told["Seconds"].values()), abs=2e-3)
        assert (row["noise_before"], row["noise_after"]) == (told["Noise"]["sd"][0], told["Noise"]["after"][0])
        assert (row["iterations"], row["stop_reason"]) == (told["Iterations"], told["StopReason"]) == (5, "iterations")
        assert (row["warnings"], row["reason"]) == (told["Warnings"], "")
    assert rows[1] == {
        **dict.fromkeys(("seconds", "noise_before", "noise_after", "iterations", "stop_reason")),
        "job": "k=2",
        "config": str(config),
        "output": str(tmp_path / "out" / "2.nii.gz"),
        "status": "failed",
        "warnings": [],
        "tries": 0,
        "reason": f"{tmp_path}/data-2.nii.gz: no such file; check the path",
    }
    head, *lines, sums = run.out.splitlines()
    assert head.split() == ["job", "status", "seconds", "noise", "before", "after", "stopped", "by"]
    assert lines.pop(2) == f"    {rows[1]['reason']}"
    for row, line in zip(rows, lines, strict=True):
        words = []
        if row["status"] == "done":
            words = [f"{row['seconds']:.1f}", *(f"{row[f'noise_{when}']:.4g}" for when in ("before", "after"))]
            words.append("iterations")
        assert line.split() == [row["job"], row["status"], *words]
    assert sums == "3 jobs: 2 done, 1 failed"
    said = run.err.splitlines()
    assert [line.split(":")[1] for line in said] == [f" {n}/3 k={k}" for n, k in ((1, 1), (2, 2), (3, 3))]
    assert said[1] == f"beltrami: 2/3 k=2: failed: {tmp_path}/data-2.nii.gz: no such file; check the path"


def test_the_summary_as_csv_holds_what_json_does(tmp_path):
    config = write_study(tmp_path, 2)
    shutil.copy(tmp_path / "data-1.nii.gz", tmp_path / "data-2.nii.gz")
    rows = engine(config)
    rows[1] = replace(rows[1], warnings=("one", "two, with a comma"), status="failed", reason='a "reason", with all')
    batch.write_summary(tmp_path / "s.csv", rows)
    with (tmp_path / "s.csv").open(newline="") as file:
        first, second = csv.DictReader(file)
    assert list(first) == list(Row.__dataclass_fields__)
    assert float(first["noise_before"]) == rows[0].noise_before
    assert (first["job"], first["iterations"], first["warnings"]) == ("k=1", "5", "")
    assert (second["warnings"], second["reason"]) == ("one | two, with a comma", 'a "reason", with all')
    assert not any(name.startswith(".") for name in contents(tmp_path))


def test_quiet_says_nothing_but_what_failed(tmp_path, here):
    config = write_study(tmp_path, 2)
    run = beltrami("batch", config, "-q")
    assert (run.code, run.out, run.err) == (0, "", "")
    run = beltrami("batch", config, "-q", "--dry-run", "--resume")
    assert (run.code, run.out, run.err) == (0, "", "")
    (tmp_path / "data-2.nii.gz").unlink()
    run = beltrami("batch", config, "-q", "--overwrite")
    assert (run.code, run.out) == (1, "")
    assert run.message == f"2/2 k=2: failed: {tmp_path}/data-2.nii.gz: no such file; check the path"


@pytest.mark.parametrize(
    "options, words",
    [
        (["--resume", "--overwrite"], "give one of them"),
        (["--jobs", 2, "--scheduler", "tcp://h:1"], "give one of them"),
        (["--part", "4/3"], "part: found '4/3'"),
        (["--memory", "much"], "memory: found 'much'"),
        (["--summary", "s.txt"], "ends in .csv or .json"),
        (["--summary", "s.txt", "--dry-run"], "ends in .csv or .json"),
        (["--summary", "old.csv/here/s.csv"], "old.csv: is no folder; choose another"),
        (["--summary", "study.toml"], "summary: found study.toml"),
        (["--summary", "old.csv"], "exists already; --resume goes on where it stopped, or give another name"),
        (["--summary", "old.csv", "--overwrite"], "is no summary of a batch, and stays"),
        (["--summary", "old.json", "--resume"], "is no summary of a batch, and stays"),
        (["--summary", "out", "--resume"], "ends in .csv or .json"),
        (["--summary", "folder.csv", "--resume"], "is no summary of a batch"),
        (["--summary", "out/../out/1.json", "--resume"], "is a file of the study"),
    ],
)
def test_what_cannot_be_meant_is_refused_before_anything_is_done(tmp_path, monkeypatch, options, words):
    config = write_study(tmp_path, 1)
    (tmp_path / "old.csv").write_text("job,status\nold,done\n")
    (tmp_path / "old.json").write_text('[{"job": "old", "status": "done"}, 1]')
    (tmp_path / "folder.csv").mkdir()
    monkeypatch.chdir(tmp_path)
    before = contents(tmp_path)
    assert words in refused("batch", config, *options)
    assert contents(tmp_path) == before


def test_a_summary_replaces_a_summary_and_its_folder_is_made(tmp_path, here):
    config = write_study(tmp_path, 2)
    for name in ("a/b/s.csv", "a/b/s.json"):
        summary = tmp_path / name
        beltrami("batch", config, "--overwrite", "--summary", summary)
        first = summary.read_text()
        assert "exists already" in refused("batch", config, "--summary", summary)
        assert beltrami("batch", config, "--resume", "--summary", summary).code == 0
        assert (first.count("skipped"), summary.read_text().count("skipped")) == (0, 2)
        assert beltrami("batch", config, "--part", "3/3", "--resume", "--summary", summary).code == 0
        assert "skipped" not in summary.read_text()
        assert beltrami("batch", config, "--resume", "--summary", summary).code == 0
        assert summary.read_text().count("skipped") == 2


def test_a_part_without_jobs_says_so(tmp_path, here):
    config = write_study(tmp_path, 2)
    for options in ((), ("--dry-run",)):
        run = beltrami("batch", config, "--part", "3/3", *options)
        assert (run.code, run.out, run.err) == (0, "no jobs in part 3/3 of 2 jobs\n", "")
    assert beltrami("batch", config, "--part", "2/2").out.endswith("\n1 job: 1 done\n")


def test_columns_without_a_value_are_left_out_and_skipped_jobs_tell_no_seconds(tmp_path, here):
    config = write_study(tmp_path, 2)
    for k in (1, 2):
        (tmp_path / f"data-{k}.nii.gz").rename(tmp_path / f"hidden-{k}.nii.gz")
    reasons = [f"{tmp_path}/data-{k}.nii.gz: no such file; check the path" for k in (1, 2)]
    run = beltrami("batch", config)
    assert run.out == (f"job  status\nk=1  failed\n    {reasons[0]}\nk=2  failed\n    {reasons[1]}\n2 jobs: 2 failed\n")
    for k in (1, 2):
        (tmp_path / f"hidden-{k}.nii.gz").rename(tmp_path / f"data-{k}.nii.gz")
    beltrami("batch", config)
    assert beltrami("batch", config, "--resume").err == "beltrami: 1/2 k=1: skipped\nbeltrami: 2/2 k=2: skipped\n"


def test_verbose_tells_the_warnings_of_each_job(tmp_path, here):
    data = noisy(seed=1)
    data[8, 8, 13] = np.inf
    config = write_study(tmp_path, 2)
    nifti(tmp_path / "data-1.nii.gz", data)
    run = beltrami("batch", config, "-v")
    assert run.code == 0
    (warning,) = record(tmp_path / "out" / "1.json")["Warnings"]
    assert run.err.splitlines()[1] == f"beltrami: k=1: warning: {warning}"
    assert "with warnings, see their records, or -v" in run.out
    assert "warning" not in beltrami("batch", config, "--overwrite").err


class Broken(io.StringIO):
    """A stream that takes so many lines before it fails."""

    def __init__(self, lines: int, number: int) -> None:
        super().__init__()
        self.lines, self.number = lines, number

    def write(self, text: str) -> int:
        if self.getvalue().count("\n") == self.lines:
            raise OSError(self.number, os.strerror(self.number))
        return super().write(text)


@pytest.mark.parametrize("number", [errno.EPIPE, errno.EIO, errno.ENOSPC])
def test_a_study_goes_on_where_nobody_hears_of_it(tmp_path, here, number):
    config, said = write_study(tmp_path, 3), Broken(1, number)
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.redirect_stderr(said):
        assert main(["batch", str(config)]) == 0
        sys.stderr.close()  # what stood in for the broken one
    assert said.getvalue().startswith("beltrami: 1/3 k=1: done")
    assert out.getvalue().endswith("3 jobs: 3 done\n")


def test_what_was_done_is_in_the_summary_where_the_table_cannot_be_told(tmp_path, here):
    config, summary = write_study(tmp_path, 2), tmp_path / "s.csv"
    with contextlib.redirect_stdout(Broken(1, errno.ENOSPC)), contextlib.redirect_stderr(io.StringIO()) as err:
        assert main(["batch", str(config), "--summary", str(summary)]) == 1
        sys.stdout.close()
    assert err.getvalue().splitlines()[2:] == [
        "beltrami: stdout: cannot be written to (No space left on device); check the disk"
    ]
    assert summary.read_text().count(",done,") == 2


def test_closed_streams_are_no_error(tmp_path, here, monkeypatch):
    monkeypatch.setattr(sys, "stdout", None)
    monkeypatch.setattr(sys, "stderr", None)
    assert main(["batch", str(write_study(tmp_path, 1))]) == 0
    sys.stdout.close()
    sys.stderr.close()


class Ended(BaseException):
    pass


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_stopped_it_tells_how_far_it_is(tmp_path, here, monkeypatch, capfd, number, code):
    config, summary, real = write_study(tmp_path, 4), tmp_path / "s" / "s.csv", pipeline.run
    (tmp_path / "data-2.nii.gz").unlink()

    def end(code: int) -> None:
        raise Ended(code)

    def run(job: Any, **options: Any) -> Any:
        if job.volume.name.startswith("3"):
            signal.raise_signal(number)
        return real(job, **options)

    monkeypatch.setattr(os, "_exit", end)
    monkeypatch.setattr(pipeline, "run", run)
    with pytest.raises(Ended) as ended:
        main(["batch", str(config), "--summary", str(summary)])
    out, err = capfd.readouterr()
    assert (ended.value.args, out) == ((code,), "")
    line = "beltrami: interrupted: 1 of 4 jobs done, 1 failed; the same command with --resume goes on\n"
    assert err.endswith("\n" * (1 + (number == signal.SIGINT)) + line)
    assert [row["job"] for row in csv.DictReader(summary.read_text().splitlines())] == ["k=1", "k=2"]
    monkeypatch.setattr(pipeline, "run", real)
    assert not any(name.startswith("out/.") for name in contents(tmp_path))
    assert beltrami("batch", config, "--resume", "--summary", summary).code == 1
    assert [row["status"] for row in csv.DictReader(summary.read_text().splitlines())] == [
        "skipped", "failed", "done", "done"
    ]  # fmt: skip


@pytest.mark.parametrize(
    "name, shown",
    [("subject=01 hemi=lh", "01 lh"), ("study: k=1", "study: 1"), ("torus", "torus"), ("d=a b=c x", "a c x")],
)
def test_what_runs_is_shown_by_its_values(name, shown):
    assert _values(name) == shown


def test_paths_are_told_as_seen_from_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    here = os.getcwd()
    assert short(f"{here}/a: not '{here}/b', /x{here}/c or {here}") == f"a: not 'b', /x{here}/c or {here}"
    gone = tmp_path / "gone"
    gone.mkdir()
    monkeypatch.chdir(gone)
    gone.rmdir()
    assert short(f"{gone}/a") == f"{gone}/a"


# Before it runs


def test_a_dry_run_tells_the_plan_and_makes_nothing(tmp_path, monkeypatch, here):
    config = write_study(tmp_path, 4)
    engine_rows = batch.run(read_study([config])[:2], Here(), Policy())
    assert statuses(engine_rows) == ["done", "done"]
    (tmp_path / "out" / "2.json").unlink()
    (tmp_path / "data-4.nii.gz").unlink()
    monkeypatch.chdir(tmp_path)
    before = contents(tmp_path)
    for options, plans, code in (
        ((), ["fail", "fail", "run", "fail"], 1),
        (("--resume",), ["skip", "run", "run", "fail"], 1),
        (("--resume", "--part", "1/2"), ["skip", "run"], 0),
        (("--overwrite", "--part", "1/2"), ["run", "run"], 0),
        (("--overwrite", "--part", "1/2", "--memory", "1M"), ["fail", "fail"], 1),
    ):
        run = beltrami("batch", config, "--dry-run", *options)
        assert (run.code, run.err) == (code, "")
        head, *lines, sums = [line for line in run.out.splitlines() if not line.startswith(" ")]
        assert head.split() == ["job", "plan", *(["memory"] if "run" in plans else []), "output"]
        assert [line.split()[1] for line in lines] == plans
        assert all(line.split()[3] == "MB" for line, plan in zip(lines, plans, strict=True) if plan == "run")
        assert f"{len(plans)} jobs: " in sums
        assert contents(tmp_path) == before
    assert "out/1.nii.gz" in run.out
    assert str(tmp_path) not in run.out


def block(folder: Path) -> None:
    (folder / "out").mkdir()
    (folder / "out" / "1.surf.gii").touch()


@pytest.mark.parametrize(
    "more, before, words",
    [
        ("[run]\nmemory = '1M'\n", lambda folder: None, "found a limit of 1.0 MB"),
        ("", lambda folder: (folder / "out").touch(), "out: is no folder"),
        ("", block, "out/1.surf.gii: exists already"),
    ],
)
def test_a_dry_run_says_what_is_certain_to_fail(tmp_path, here, more, before, words):
    config = write_study(tmp_path, 1, more=more)
    before(tmp_path)
    plan = beltrami("batch", config, "--dry-run")
    assert plan.code == 1
    assert words in plan.out
    run = beltrami("batch", config)
    assert run.code == 1


# What is there already


@pytest.mark.parametrize(
    "change, redone",
    [
        (lambda folder: None, []),
        (lambda folder: nifti(folder / "data-2.nii.gz", noisy(seed=7)), [2]),
        (lambda folder: nifti(folder / "psi.nii.gz", ball(radius=5.2)), [1, 2, 3]),
        (lambda folder: (folder / "out" / "3.json").unlink(), [3]),
        (lambda folder: (folder / "out" / "1.func.gii").unlink(), [1]),
        (lambda folder: (folder / "out" / "1.json").write_text("{"), [1]),
        (lambda folder: edit(folder / "study.toml", "iterations = 5", "iterations = 6"), [1, 2, 3]),
        (lambda folder: edit(folder / "study.toml", "threads = 1", "threads = 2"), []),
        (lambda folder: os.utime(folder / "data-1.nii.gz", (0, 0)), []),
    ],
)
def test_resume_redoes_what_has_changed_and_nothing_else(three_done, change, redone):
    config, out = three_done / "study.toml", three_done / "out"
    change(three_done)
    before = {k: (out / f"{k}.nii.gz").stat().st_ino for k in (1, 2, 3)}
    rows = engine(config, resume=True)
    assert statuses(rows) == ["done" if k in redone else "skipped" for k in (1, 2, 3)]
    assert [k for k in before if (out / f"{k}.nii.gz").stat().st_ino != before[k]] == redone
    for k, row in enumerate(rows, 1):  # a skipped job tells what its record says
        told = record(out / f"{k}.json")
        assert (row.noise_after, row.iterations) == (told["Noise"]["after"][0], told["Iterations"])
    assert statuses(engine(config, resume=True)) == ["skipped"] * 3


def edit(file: Path, old: str, new: str) -> None:
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))


def test_a_study_that_has_moved_is_not_done_again(three_jobs, three_done):
    whole = contents(three_jobs)
    assert contents(three_done) == whole
    (three_done / "out" / ".1.json.partial").mkdir()
    (three_done / "out" / ".1.json.partial" / "1.nii.gz").write_text("half")
    assert statuses(engine(three_done / "study.toml", resume=True)) == ["skipped"] * 3
    assert contents(three_done) == contents(three_jobs) == whole


def test_without_resume_what_is_there_stays_and_overwrite_replaces_it(tmp_path):
    config = write_study(tmp_path, 2)
    batch.run(read_study([config])[:1], Here(), Policy())
    before = contents(tmp_path / "out")
    rows = engine(config)
    assert statuses(rows) == ["failed", "done"]
    assert rows[0].reason.endswith("1.nii.gz: exists already; --resume skips what is done, --overwrite replaces it")
    after = contents(tmp_path / "out")
    assert {name: after[name] for name in before} == before
    first = (tmp_path / "out" / "1.nii.gz").stat().st_ino
    assert statuses(engine(config, overwrite=True)) == ["done", "done"]
    assert (tmp_path / "out" / "1.nii.gz").stat().st_ino != first
    assert contents(tmp_path / "out")["1.nii.gz"] == before["1.nii.gz"]


# What is done


def test_parts_make_up_the_whole(tmp_path, here):
    config = write_study(tmp_path, 3)
    engine(config)
    whole = essence(tmp_path / "out")
    shutil.rmtree(tmp_path / "out")
    done_by = [beltrami("batch", config, "--part", f"{k}/2").out.splitlines()[1:-1] for k in (1, 2)]
    assert [[line.split()[0] for line in lines] for lines in done_by] == [["k=1", "k=3"], ["k=2"]]
    assert essence(tmp_path / "out") == whole


def test_a_job_gives_what_denoise_gives(tmp_path):
    config = write_study(tmp_path, 1)
    edit(config, "[for_each]\nk = [1]\n", "")
    config.write_text(config.read_text().replace("{k}", "1"))
    assert statuses(engine(config)) == ["done"]
    ours = essence(tmp_path / "out")
    done("denoise", "--config", config, "--overwrite", "-q")
    assert essence(tmp_path / "out") == ours


def test_series_and_values_at_vertices_are_jobs_too(tmp_path):
    chance = np.random.default_rng(0)
    nifti(tmp_path / "psi.nii.gz", ball())
    nifti(tmp_path / "frames.nii.gz", (50 + 10 * chance.standard_normal((16, 16, 16, 3))).astype(np.float32))
    done("mesh", tmp_path / "psi.nii.gz", nifti(tmp_path / "data.nii.gz", noisy()), "-o", tmp_path / "m.surf.gii", "-q")
    common = "[time]\niterations = 3\n[flow]\nbeta = 0.1\n[input]\nlevelset = "
    (tmp_path / "frames.toml").write_text(
        common + '"psi.nii.gz"\ndata = "frames.nii.gz"\n[output]\nvolume = "frames/o.nii.gz"\n'
        '[values]\nkind = "vector"\nindependent = true\n'
    )
    (tmp_path / "vertices.toml").write_text(
        common + '"m.surf.gii"\ndata = "m.func.gii"\n[output]\nvolume = "vertices/o.func.gii"\n'
    )
    study = read_study([tmp_path / "frames.toml", tmp_path / "vertices.toml"])
    rows = batch.run(study, Here(), Policy())
    assert [(row.job, row.status, row.iterations) for row in rows] == [("frames", "done", 3), ("vertices", "done", 3)]
    assert 5 < rows[0].noise_before < 15
    assert rows[0].noise_after < rows[0].noise_before
    before = contents(tmp_path)
    assert statuses(batch.run(study, Here(), Policy(resume=True))) == ["skipped", "skipped"]
    assert contents(tmp_path) == before


def test_processes_have_their_threads_and_one_failure_does_not_stop_the_others(tmp_path):
    config = write_study(tmp_path, 3, more="")
    (tmp_path / "data-2.nii.gz").write_bytes(b"no volume")
    out, _ = batch_in_processes(config, "--jobs", 2, "--threads", 1, code=1)
    assert "3 jobs: 2 done, 1 failed" in out
    assert "data-2.nii.gz: cannot be read as NIfTI" in out
    assert [record(tmp_path / "out" / f"{k}.json")["Parameters"]["threads"] for k in (1, 3)] == [1, 1]


@pytest.mark.parametrize(
    "options, more, expected",
    [(("--jobs", 2), "", 2), (("--threads", 3), "", 3), ((), "[run]\nthreads = 1\n", 1), ((), "", 4)],
)
def test_jobs_share_the_cpus_unless_told_how_many_threads(tmp_path, monkeypatch, options, more, expected):
    given = []

    class Fake(Here):
        def submit(self, fn: Callable[..., Row], planned: Planned, *rest: Any) -> Future[Row]:
            given.append(planned.job.settings.threads)
            return ended(Row(planned.name, "", "", "done"))

    monkeypatch.setattr("beltrami_cli.solver.cpus", lambda: 4)
    monkeypatch.setattr(executors, "Processes", lambda count, threads: given.append(threads) or Fake())
    assert beltrami("batch", write_study(tmp_path, 2, more=more), *options).code == 0
    assert given == [expected] * 3


# The engine


def ended(outcome: Row | BaseException | None) -> Future[Any]:
    """A future that has come to a row, an error, or was cancelled."""
    future: Future[Any] = Future()
    if isinstance(outcome, Row):
        future.set_result(outcome)
    elif outcome is None:
        future.cancel()
        future.set_running_or_notify_cancel()
    else:
        future.set_exception(outcome)
    return future


class Scripted(Workers):
    """Gives each job's next outcome, else that it is done; `asked` keeps (job, look, overwrite) as they come."""

    def __init__(self, **outcomes: list[Row | BaseException | str | None]) -> None:
        self.outcomes, self.asked = outcomes, []

    def submit(self, fn: Callable[..., Row], planned: Planned, look: bool, only_look: bool, *rest: Any) -> Future[Row]:
        if only_look:
            return ended(Row(planned.name, "", "", "open"))
        self.asked.append((planned.name, look, planned.job.overwrite))
        left = self.outcomes.get(planned.name.replace("=", ""), [])
        outcome = left.pop(0) if left else "done"
        if isinstance(outcome, str):
            outcome = Row(planned.name, "", "", outcome, reason="another run is writing it" * (outcome == "busy"))
        return ended(outcome)


class KilledWorker(Exception):
    """As Dask raises it."""

    allowed_failures = 1


@pytest.fixture
def study(tmp_path) -> list[Planned]:
    return read_study([write_study(tmp_path, 3)])


@pytest.mark.parametrize("death", [BrokenExecutor("ended abruptly"), None, KilledWorker()])
def test_a_job_whose_process_died_is_tried_again_elsewhere(study, death):
    executor = Scripted(k2=[death])
    settled: list[Row] = []
    rows = batch.run(study, executor, Policy(overwrite=True, retries=2), settled=settled.append)
    assert [row.job for row in rows] == ["k=1", "k=2", "k=3"]
    assert statuses(rows) == ["done"] * 3
    assert rows[1].tries == (3 if isinstance(death, KilledWorker) else 2)
    assert sorted(settled, key=lambda row: row.job) == rows
    # Nothing was finished before the process died, so there is nothing that the second try should look at.
    assert sorted(executor.asked) == [
        ("k=1", False, True),
        ("k=2", False, True),
        ("k=2", False, True),
        ("k=3", False, True),
    ]


@pytest.mark.parametrize("death, starts", [(BrokenExecutor("ended abruptly"), 3), (None, 3), (KilledWorker(), 2)])
def test_a_job_that_always_dies_is_given_up(study, death, starts):
    executor = Scripted(k1=[death] * 9)
    rows = batch.run(study, executor, Policy(retries=2))
    assert statuses(rows) == ["failed", "done", "done"]
    assert rows[0].reason.startswith(f"its process died, {rows[0].tries} times of {rows[0].tries}")
    assert [name for name, *_ in executor.asked].count("k=1") == starts
    assert "\n" not in rows[0].reason


def test_no_retries_none_done(study):
    rows = batch.run(study, Scripted(k1=[BrokenExecutor()]), Policy(retries=0))
    assert [(row.status, row.tries) for row in rows] == [("failed", 1), ("done", 1), ("done", 1)]


def test_an_executor_that_takes_no_more_jobs_fails_them_one_by_one(study):
    class Lost(Workers):
        def submit(self, *_: Any) -> Future[Any]:
            raise BrokenExecutor("the pool is gone")

    rows = batch.run(study, Lost(), Policy(retries=1))
    assert [(row.status, row.tries) for row in rows] == [("failed", 2)] * 3


def test_a_busy_job_is_waited_for_with_resume_and_failed_without(study, monkeypatch):
    monkeypatch.setattr(batch, "_TRY_AGAIN", 0.02)
    monkeypatch.setattr(batch, "_LOOK", 0.02)
    executor = Scripted(k1=["busy", "busy", "skipped"])
    told: list[str] = []
    rows = batch.run(study, executor, Policy(resume=True), notify=told.append)
    assert told == ["k=1: waits: another run is writing it"]
    assert [(row.status, row.tries) for row in rows] == [("skipped", 0), ("done", 1), ("done", 1)]
    assert [name for name, *_ in executor.asked] == ["k=1", "k=2", "k=3", "k=1", "k=1"]
    rows = batch.run(study, Scripted(k1=["busy"]), Policy())
    assert statuses(rows) == ["failed", "done", "done"]
    assert rows[0].reason.startswith("another run is writing it; with --resume the batch waits")


def test_a_job_that_another_run_holds_is_busy(tmp_path, study, monkeypatch):
    (tmp_path / "out").mkdir()
    with Stage([tmp_path / "out" / "1.nii.gz", tmp_path / "out" / "1.json"]):
        rows = batch.run(study, Here(), Policy())
    assert statuses(rows) == ["failed", "done", "done"]
    assert "another run is writing it" in rows[0].reason
    assert not any(name.startswith(".") for name in contents(tmp_path / "out"))


class Held(Workers):
    """Keeps jobs running until `let_go`; `running` are their names."""

    def __init__(self, count: int = 3) -> None:
        self.count = count
        self.running: dict[str, Future[Row]] = {}
        self.together: list[tuple[str, ...]] = []
        self.looks = 0

    def slots(self) -> int:
        return self.count

    def submit(self, fn: Callable[..., Row], planned: Planned, *rest: Any) -> Future[Row]:
        self.running[planned.name] = Future()
        self.together.append(tuple(self.running))
        return self.running[planned.name]

    def let_go(self, *_: object) -> None:
        """End the job that has run longest, if any runs; at every other look, so that another has started before."""
        self.looks += 1
        for name in list(self.running)[: self.looks % 2]:
            self.running.pop(name).set_result(Row(name, "", "", "done"))


@pytest.mark.parametrize(
    "sizes, count, limits, together",
    [
        ((4, 4, 4), 3, {}, [("k=1",), ("k=1", "k=2"), ("k=1", "k=2", "k=3")]),
        ((4, 4, 4), 3, {"memory": 9}, [("k=1",), ("k=1", "k=2"), ("k=2", "k=3")]),
        ((4, 6, 4), 3, {"memory": 9}, [("k=1",), ("k=2",), ("k=3",)]),
        ((4, 6, 4), 3, {"spare": 9}, [("k=1",), ("k=2",), ("k=3",)]),
        ((4, 4, 4), 2, {}, [("k=1",), ("k=1", "k=2"), ("k=2", "k=3")]),
        ((4, 99, 4), 3, {"spare": 9}, [("k=1",), ("k=2",), ("k=3",)]),
        ((4, 99, 4), 3, {"memory": 9}, [("k=1",), ("k=1", "k=3")]),
    ],
)
def test_jobs_run_together_while_they_fit(study, monkeypatch, sizes, count, limits, together):
    by_output = {planned.job.volume: size for planned, size in zip(study, sizes, strict=True)}
    monkeypatch.setattr(batch, "needed", lambda job: by_output[job.volume])
    monkeypatch.setattr(batch, "_LOOK", 0.02)
    executor = Held(count)
    rows = batch.run(study, executor, Policy(**limits), watch=executor.let_go)
    assert executor.together == together
    for row, size in zip(rows, sizes, strict=True):
        fits = size <= limits.get("memory", size)
        assert row.status == ("done" if fits else "failed")
        assert fits or row.reason.startswith("memory: needs about 99 B; found a limit of 9 B")


def test_a_watcher_sees_what_runs(study, monkeypatch):
    monkeypatch.setattr(batch, "needed", lambda job: 1)
    monkeypatch.setattr(batch, "_LOOK", 0.02)
    executor, seen = Held(2), []

    def watch(running: list[batch.Running]) -> None:
        seen.append([(one.planned.name, one.phase) for one in running])
        executor.let_go()

    batch.run(study, executor, Policy(), watch=watch)
    assert seen[0] == [("k=1", ""), ("k=2", "")]
    assert seen[-1] == []


def test_an_unexpected_error_is_one_line_of_its_job(tmp_path, study, monkeypatch):
    def fail(job: object, **_: object) -> None:
        raise ZeroDivisionError("one\ntwo")

    monkeypatch.setattr("beltrami_cli.pipeline.run", fail)
    rows = batch.run(study[:1], Here(), Policy())
    assert rows[0].reason == "unexpected ZeroDivisionError: one two (please report it)"
    monkeypatch.setattr(resume, "__version__", "0.0.1")
    assert batch.perform(study[0], True, False, None, "0.0.1").reason.startswith("worker: has beltrami_cli ")
    assert contents(tmp_path / "out") == {}


def test_what_another_run_has_just_finished_is_not_done_again(tmp_path, study, monkeypatch):
    """The other run ends between the look at what is there and the lock."""
    assert statuses(batch.run(study[:1], Here(), Policy())) == ["done"]
    before = contents(tmp_path / "out")
    first = iter([True])
    monkeypatch.setattr(batch, "_TRY_AGAIN", 0.02)
    monkeypatch.setattr(batch, "finished", lambda job: None if next(first, False) else resume.finished(job))
    rows = batch.run(study[:1], Here(), Policy(resume=True))
    assert [(row.status, row.tries) for row in rows] == [("skipped", 0)]
    assert contents(tmp_path / "out") == before


class Dies(Here):
    """The process of the first job dies, before it or, with `late`, just after it."""

    def __init__(self, late: bool) -> None:
        self.late, self.alive = late, False

    def submit(self, *asked: Any) -> Future[Any]:
        if self.alive:
            return super().submit(*asked)
        self.alive = True
        if self.late:
            super().submit(*asked)
        return ended(BrokenExecutor("killed"))


@pytest.mark.parametrize("late", [False, True])
def test_a_second_try_takes_what_the_first_one_finished_and_not_what_was_there_before(tmp_path, study, late):
    batch.run(study[:1], Here(), Policy())
    good = contents(tmp_path / "out")
    (tmp_path / "out" / "1.nii.gz").write_bytes(b"damaged by hand")
    rows = batch.run(study[:1], Dies(late), Policy(overwrite=True))
    assert [(row.status, row.tries) for row in rows] == [("done", 2)]
    assert contents(tmp_path / "out")["1.nii.gz"] == good["1.nii.gz"]


@pytest.mark.parametrize("error", [MemoryError(), ValueError("odd")])
def test_an_estimate_that_fails_fails_its_job_alone(study, monkeypatch, error):
    def estimate(job: object) -> int:
        if job == study[1].job:
            raise error
        return 1

    monkeypatch.setattr(batch, "needed", estimate)
    rows = batch.run(study, Here(), Policy())
    assert statuses(rows) == ["done", "failed", "done"]
    assert rows[1].reason.startswith(("out of memory", "unexpected ValueError: odd"))
    assert batch.foresee(study[1], Policy()).what == "fail"


def test_what_is_done_is_skipped_whatever_memory_it_would_need(study):
    batch.run(study, Here(), Policy())
    assert statuses(batch.run(study, Here(), Policy(resume=True, memory=1000))) == ["skipped"] * 3


def test_a_record_without_figures_is_no_record(tmp_path, study):
    batch.run(study[:1], Here(), Policy())
    sidecar = tmp_path / "out" / "1.json"
    record = json.loads(sidecar.read_text())
    del record["Seconds"]
    sidecar.write_text(json.dumps(record))
    assert statuses(batch.run(study[:1], Here(), Policy(resume=True))) == ["done"]
    assert "Seconds" in json.loads(sidecar.read_text())


@pytest.mark.skipif(sys.platform != "linux", reason="names that are no text")
def test_files_whose_names_are_no_text(tmp_path, monkeypatch):
    write_study(tmp_path, 1)
    (tmp_path / "data-1.nii.gz").rename(os.fsdecode(bytes(tmp_path) + b"/sub-\xff.nii.gz"))
    config = tmp_path / "odd.toml"
    config.write_text(
        '[for_each]\ndata = "sub-{s}.nii.gz"\n[input]\nlevelset = "psi.nii.gz"\ndata = "{data}"\n'
        '[output]\nvolume = "out/{s}.nii.gz"\n[flow]\nbeta = 0.1\n[time]\niterations = 1\n'
    )
    monkeypatch.setattr(executors, "Processes", lambda *_: Here())
    run = beltrami("batch", config, "--summary", tmp_path / "odd.csv")
    assert (run.code, run.out.count("done")) == (0, 2)
    assert "s=\\udcff" in run.out and "s=\\udcff" in (tmp_path / "odd.csv").read_text()
