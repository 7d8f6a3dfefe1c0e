"""Nothing is lost and nothing is half-written: batches that are killed, meet each other, or run out of disk."""

from __future__ import annotations

import json
import os
import random
import re
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import suppress
from itertools import count
from pathlib import Path

import numpy as np
import pytest
from command import ball, contents, nifti, record
from studies import Here, batch, digest, essence, finish, members, small_disk, start, wait_for, write_study

from beltrami_cli import formats, kernels
from beltrami_cli.batch import Policy, Row, run
from beltrami_cli.errors import DataError
from beltrami_cli.formats.staging import who_writes
from beltrami_cli.grid import Grid, Volume
from beltrami_cli.record import write_record
from beltrami_cli.study import Planned, read_study
from beltrami_cli.surface import Mesh

KILLS = 12


def is_hidden(name: str) -> bool:
    return any(part.startswith(".") for part in Path(name).parts)


class Observer(threading.Thread):
    """Looks at a folder of outputs all the time: what stands under a final name has to be whole and as expected.

    expected: digests by name, as `essence` gives them. wrong: what was not so. seen: how many files were looked at.
    """

    def __init__(self, folder: Path, expected: dict[str, str]) -> None:
        super().__init__(daemon=True)
        self.folder, self.expected = folder, expected
        self.wrong: list[str] = []
        self.seen: set[tuple[str, int, int]] = set()
        self.over = threading.Event()

    def run(self) -> None:
        while not self.over.wait(0.003):
            with suppress(FileNotFoundError):  # the folder is made anew
                for entry in os.scandir(self.folder):
                    with suppress(FileNotFoundError):
                        self.look(entry)

    def look(self, entry: os.DirEntry[str]) -> None:
        if entry.name.startswith("."):
            return
        state = entry.stat()
        key = entry.name, state.st_ino, state.st_mtime_ns
        if key in self.seen:
            return
        content = Path(entry.path).read_bytes()
        try:
            if digest(entry.name, content) != self.expected[entry.name]:
                self.wrong.append(f"{entry.name}: other bytes")
            told = json.loads(content)["Outputs"] if entry.name.endswith(".json") else []
        except ValueError:
            self.wrong.append(f"{entry.name}: half a record")
            return
        missing = [output for output in told if not os.path.exists(output)]
        # This look may be overtaken by a folder that is emptied, which takes the records away first.
        if missing and os.path.exists(entry.path):
            self.wrong.append(f"{entry.name}: without {missing}")
        self.seen.add(key)

    def end(self) -> None:
        self.over.set()
        self.join()
        assert self.wrong == []


def begun(process: subprocess.Popen[str], out: Path, pattern: str) -> None:
    """Wait until there are more paths of this pattern than now, or the process has ended."""
    before = len(list(out.glob(pattern)))
    wait_for(lambda: len(list(out.glob(pattern))) > before or process.poll() is not None)


def empty(out: Path) -> None:
    """Take all outputs away, records first."""
    for path in sorted(out.iterdir(), key=lambda path: path.suffix != ".json"):
        path.unlink()


@pytest.mark.slow
def test_killed_at_any_moment_and_resumed_it_ends_with_the_same_bytes(tmp_path):
    chance, out = random.Random(20), tmp_path / "out"
    config = write_study(tmp_path, 16, size=36, iterations=60)
    run(read_study([config]), Here(), Policy())
    expected = essence(out)
    assert not any(map(is_hidden, expected))
    empty(out)
    observer = Observer(out, expected)
    observer.start()
    killed, left_behind, phases = 0, 0, set[str | None]()
    while killed < KILLS:
        process = start("batch", config, "--jobs", 2, "--resume", stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        moment = killed % 4  # while it starts, while the first jobs start, and twice when jobs are running
        if moment:
            begun(process, out, ".*.partial" if moment == 1 else "*.json")
        time.sleep(chance.uniform(0, 1.2 if moment < 2 else 0.5))
        if process.poll() is None:
            (os.killpg if killed % 3 == 0 else os.kill)(process.pid, signal.SIGKILL)
            killed += 1
            left_behind += any(out.glob(".*.partial"))
            phases |= {(who_writes(out / f"{k}.json") or {}).get("phase") for k in range(1, 17)}
        else:
            assert process.returncode == 0
            assert essence(out) == expected
            empty(out)
        process.wait()
        if killed % 2:  # else the next one meets processes of this one
            wait_for(lambda session=process.pid: not members(session), 10)
    batch(config, "--jobs", 2, "--resume")
    observer.end()
    assert essence(out) == expected
    assert left_behind > KILLS / 4
    assert len(phases) > 3
    assert {name for name, *_ in observer.seen} == set(expected)


def kill_at_every_name(config: str) -> None:
    """Kill runs in this process just before the k-th final name is given or taken away, for every k, and resume each.

    Overwrites what stands there. Prints for each k what `essence` gives before and after the resumption.
    """
    kernels.wake()
    study = read_study([Path(config)])
    folder = study[0].job.volume.parent
    shutil.copytree(folder, folder.with_name("before"))
    for k in range(100):
        code = in_a_fork(lambda k=k: killed_at_name(k, study, folder))
        if code == 0:
            return
        assert code == -signal.SIGKILL
        between = essence(folder)
        assert in_a_fork(lambda: {row.status for row in run(study, Here(), Policy(resume=True))} == {"done"}) == 0
        print(json.dumps([between, essence(folder)]))
        shutil.rmtree(folder)
        shutil.copytree(folder.with_name("before"), folder)


def killed_at_name(k: int, study: list[Planned], folder: Path) -> bool:
    names = count()

    def look(event: str, arguments: tuple[object, ...]) -> None:
        name = {"os.rename": arguments[1:2], "os.remove": arguments[:1]}.get(event, ())
        if any(Path(str(path)).parent == folder for path in name) and next(names) == k:
            os.kill(os.getpid(), signal.SIGKILL)

    sys.addaudithook(look)
    return {row.status for row in run(study, Here(), Policy(overwrite=True))} == {"done"}


def in_a_fork(action: Callable[[], bool]) -> int:
    """The exit code of a copy of this process that did this: 0 where it gave true. No kernel has run in it before."""
    if child := os.fork():
        return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    code = 3
    try:
        code = 0 if action() else 2
    finally:
        os._exit(code)


@pytest.mark.slow
def test_killed_between_any_two_names_it_resumes_to_the_same_bytes(tmp_path):
    out = tmp_path / "out"
    config = write_study(tmp_path, 1, iterations=3, volume='out/{k}.nii.gz"\nfilled = "out/{k}-filled.nii.gz')
    run(read_study([config]), Here(), Policy())
    old = essence(out)
    config.write_text(config.read_text().replace("iterations = 3", "iterations = 4"))
    program = f"from test_batch_kills import kill_at_every_name; kill_at_every_name({str(config)!r})"
    driver = subprocess.run([sys.executable, "-c", program], cwd=Path(__file__).parent, capture_output=True, text=True)
    assert (driver.returncode, driver.stderr) == (0, "")
    run(read_study([config]), Here(), Policy(overwrite=True))
    new = essence(out)
    assert {name for name in old if old[name] != new[name]} == {"1.json", "1.nii.gz", "1.func.gii"}
    states = [json.loads(line) for line in driver.stdout.splitlines()]
    assert len(states) == 6  # the record goes, then five files come
    for between, after in states:
        assert after == new
        final = {name: state for name, state in between.items() if not is_hidden(name)}
        if "1.json" in final:  # a record stands only beside all of the files that it tells of
            assert final == old
        assert all(state in (old[name], new[name]) for name, state in final.items())


class Killer(threading.Thread):
    """Kills the process that does a job whenever one has begun to, at most so many times each; jobs by k."""

    def __init__(self, folder: Path, times: dict[int, float]) -> None:
        super().__init__(daemon=True)
        self.folder, self.times = folder, times
        self.killed: list[int] = []
        self.over = threading.Event()

    def run(self) -> None:
        while not self.over.wait(0.002):
            for k in self.times:
                who = who_writes(self.folder / f"{k}.json")
                if who and who["process"] not in self.killed and self.times[k]:
                    with suppress(ProcessLookupError):
                        os.kill(who["process"], signal.SIGKILL)
                    self.killed.append(who["process"])
                    self.times[k] -= 1


@pytest.mark.slow
def test_a_job_whose_process_dies_is_tried_again_and_reported_where_it_always_dies(tmp_path):
    config = write_study(tmp_path, 5, size=24)
    killer = Killer(tmp_path / "out", {2: 1, 4: float("inf")})
    killer.start()
    summary = tmp_path / "summary.json"
    out, err = batch(config, "--jobs", 2, "--retries", 1, "--summary", summary, code=1)
    killer.over.set()
    rows = {row["job"]: row for row in json.loads(summary.read_text())}
    assert {job: (row["status"], row["tries"]) for job, row in rows.items()} == {
        "k=1": ("done", 1),
        "k=2": ("done", 2),
        "k=3": ("done", 1),
        "k=4": ("failed", 2),
        "k=5": ("done", 1),
    }
    assert rows["k=4"]["reason"].startswith("its process died, 2 times of 2")
    assert "5 jobs: 4 done, 1 failed" in out
    assert err.count("\n") == 5
    assert err.count("failed: its process died") == 1
    assert len(killer.killed) == 3
    batch(config, "--resume")
    assert sum(name.endswith(".json") for name in contents(tmp_path / "out")) == 5
    assert not any(map(is_hidden, contents(tmp_path / "out")))


@pytest.mark.slow
def test_stopped_it_ends_at_once_with_its_workers_and_leaves_nothing_half_done(tmp_path):
    config, out = write_study(tmp_path, 12, size=36, iterations=60), tmp_path / "out"
    for pattern, number, code, line in (
        (".*.partial/.running", signal.SIGINT, 130, "\n"),
        ("*.json", signal.SIGINT, 130, "\n"),
        ("*.json", signal.SIGTERM, 143, ""),
        ("*.json", signal.SIGHUP, 129, ""),
    ):
        process = start("batch", config, "--jobs", 2, "--resume", "--summary", tmp_path / "s.json")
        begun(process, out, pattern)
        # Ctrl-C reaches all processes of a terminal, a scheduler's signal the first alone.
        (os.killpg if number == signal.SIGINT else os.kill)(process.pid, number)
        _, err = finish(process, code, timeout=5)
        said = re.sub(r"beltrami: \d+/12 .*: (done, .* s|skipped)\n", "", err)
        told = err.count("\n") - said.count("\n")
        settled = len(json.loads((tmp_path / "s.json").read_text()))
        assert settled - told in (0, 1)  # the signal may come between a job's end and its line
        assert (
            said == f"{line}beltrami: interrupted: {settled} of 12 jobs done; the same command with --resume goes on\n"
        )
        wait_for(lambda session=process.pid: not members(session), 5)
        assert not any(map(is_hidden, contents(out)))
    batch(config, "--jobs", 2, "--resume")
    assert sum(name.endswith(".json") for name in contents(out)) == 12


def fill(disk: Path, left: int) -> None:
    """Leave so many pages of 4 kB on a small disk."""
    ballast = disk / "ballast"
    ballast.unlink(missing_ok=True)
    size = shutil.disk_usage(disk).free - 4096 * left
    with ballast.open("wb") as file:
        file.write(b"\0" * size)
    assert shutil.disk_usage(disk).free == 4096 * left


# nibabel and trimesh leave a file open that they cannot write to its end.
LEFT_OPEN = pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")

WRITTEN = [".nii", ".nii.gz", ".mha", ".mhd", ".mgz", ".npy", ".hdr"]
MESHES = [".surf.gii", ".ply", ".obj", ".stl", ".glb", ".vtk"]


def scene() -> tuple[Volume, Mesh]:
    chance = np.random.default_rng(0)
    grid = Grid((12, 12, 40), np.eye(4))
    vertices, cells = chance.random((300, 3)), chance.integers(0, 300, (500, 3), np.int32)
    return Volume(chance.random(grid.shape, np.float32), grid), Mesh(vertices, cells, chance.random(300))


@LEFT_OPEN
@pytest.mark.parametrize("suffix", WRITTEN + MESHES)
def test_whatever_is_left_on_the_disk_a_format_is_written_whole_or_not_at_all(tmp_path, suffix):
    volume, mesh = scene()

    def write(folder: Path) -> None:
        file = folder / f"o{suffix}"
        files = formats.volume_files(file) if suffix in WRITTEN else formats.mesh_files(file)
        with formats.Stage([*files, folder / "o.json"], overwrite=True) as stage:
            if suffix in WRITTEN:
                formats.write_volume(stage.path(file), volume)
            else:
                formats.write_mesh(stage.path(file), mesh)
            write_record(stage.path(folder / "o.json"), {"words": "x" * 5000})
            stage.commit()

    (tmp_path / "whole").mkdir()
    write(tmp_path / "whole")
    whole = contents(tmp_path / "whole")
    pages = sum(-(-path.stat().st_size // 4096) for path in (tmp_path / "whole").iterdir())
    with small_disk(tmp_path / "disk", "400k") as disk:
        (disk / "out").mkdir()
        for left in range(pages + 2):
            fill(disk, left)
            if left < pages:
                with pytest.raises(DataError, match="No space left on device"):
                    write(disk / "out")
                assert contents(disk / "out") == {}
        write(disk / "out")
        assert contents(disk / "out") == whole


FORMATS = ["{k}.nii.gz", "{k}.mha", "{k}.mgz", "{k}.npy"]


@LEFT_OPEN
@pytest.mark.parametrize("name", FORMATS)
def test_what_a_full_disk_does_not_hold_is_told_and_done_once_there_is_room(tmp_path, name):
    with small_disk(tmp_path / "disk", "2m") as disk:
        study = read_study([write_study(tmp_path, 3, volume=f"disk/out/{name}")])
        out = disk / "out"
        whole = run(study, Here(), Policy())
        expected, taken = essence(out), pages(out)
        assert {row.status for row in whole} == {"done"}

        fill(disk, taken // 6)  # half a job
        redone = run(study, Here(), Policy(overwrite=True))
        assert {row.status for row in redone} == {"failed"}
        assert essence(out) == expected

        shutil.rmtree(out)
        out.mkdir()
        fill(disk, taken // 2)  # a job and a half
        rows = run(study, Here(), Policy())
        assert [row.status for row in rows] == ["done", "failed", "failed"]
        for row in (*rows[1:], *redone):
            assert "cannot be written" in row.reason
            assert "\n" not in row.reason
        assert essence(out) == {name: state for name, state in expected.items() if name.startswith("1")}

        (disk / "ballast").unlink()
        assert [row.status for row in run(study, Here(), Policy(resume=True))] == ["skipped", "done", "done"]
        assert essence(out) == expected


def pages(folder: Path) -> int:
    return sum(-(-path.stat().st_size // 4096) for path in folder.iterdir())


@pytest.mark.slow
def test_a_summary_that_finds_no_room_is_told_behind_the_table(tmp_path):
    with small_disk(tmp_path / "disk", "1m") as disk:
        config, summary = write_study(tmp_path, 2), disk / "study.csv"
        summary.write_text(old := ",".join(Row.__dataclass_fields__) + "\n")
        fill(disk, 0)
        out, err = batch(config, "--overwrite", "--summary", summary, code=1)
        assert "2 jobs: 2 done" in out
        assert err.splitlines()[-1] == (
            "beltrami: study.csv: cannot be written (No space left on device); check the disk and its quota"
        )
        assert set(contents(disk)) == {"ballast", "study.csv"}
        assert summary.read_text() == old


def test_a_folder_that_cannot_be_used_is_told_and_the_others_are_done(tmp_path):
    with small_disk(tmp_path / "locked", "1m") as disk:
        config = write_study(tmp_path, 5, volume="{where}/{k}.nii.gz")
        text = config.read_text()
        nifti(tmp_path / "data-4.nii.gz", ball()).write_bytes(b"\x1f\x8b cut short")
        whole = (tmp_path / "data-5.nii.gz").read_bytes()
        (tmp_path / "data-5.nii.gz").write_bytes(whole[: len(whole) // 2])
        (tmp_path / "data-3.nii.gz").unlink()
        (tmp_path / "file").write_text("a file")
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        study = []
        for where in ("out", "locked", "locked/new", "file", "file/new"):
            config.write_text(text.replace("{where}", where))
            study += read_study([config])[: 5 if where == "out" else 1]
        rows = run(study, Here(), Policy())
        assert [row.status for row in rows] == ["done", "done"] + ["failed"] * 7
        reasons = [row.reason for row in rows[2:]]
        for reason, words in zip(
            reasons,
            (
                rf"{tmp_path}/data-3\.nii\.gz: no such file; check the path",
                rf"{tmp_path}/data-4\.nii\.gz: cannot be read as NIfTI",
                rf"{tmp_path}/data-5\.nii\.gz: cannot be read as NIfTI",
                rf"{disk}(/1\.nii\.gz)?: .*cannot be written to",
                rf"{disk}/new: cannot be made \(Read-only file system\)",
                rf"{tmp_path}/file: (is a file|cannot be made)",
                rf"{tmp_path}/file(/new)?: (is a file|cannot be made)",
            ),
            strict=True,
        ):
            assert re.match(words, reason), reason
            assert "\n" not in reason
        assert not any(map(is_hidden, contents(tmp_path)))
        assert {name for name in contents(tmp_path / "out") if name.endswith(".json")} == {"1.json", "2.json"}
        assert contents(disk) == {}


def test_what_is_done_on_a_disk_that_is_locked_since_is_skipped(tmp_path):
    with small_disk(tmp_path / "disk", "2m") as disk:
        study = read_study([write_study(tmp_path, 2, volume="disk/{k}.nii.gz")])
        assert [row.status for row in run(study, Here(), Policy())] == ["done", "done"]
        subprocess.run(["mount", "-o", "remount,ro", str(disk)], check=True)
        assert [row.status for row in run(study, Here(), Policy(resume=True))] == ["skipped", "skipped"]


@pytest.mark.slow
@pytest.mark.parametrize("resume", [True, False])
def test_two_batches_on_the_same_outputs_share_the_work(tmp_path, resume):
    config, out = write_study(tmp_path, 6, size=36, iterations=60), tmp_path / "out"
    run(read_study([config]), Here(), Policy())
    expected = essence(out)
    shutil.rmtree(out)
    observer = Observer(out, expected)
    observer.start()
    options = ["--resume"] if resume else []
    both = [start("batch", config, "--jobs", jobs, "--summary", tmp_path / f"{jobs}.json", *options) for jobs in (1, 2)]
    for process in both:
        process.communicate(timeout=60)
    observer.end()
    assert essence(out) == expected
    rows = [json.loads((tmp_path / f"{jobs}.json").read_text()) for jobs in (1, 2)]
    for process, ours in zip(both, rows, strict=True):
        assert process.returncode == int(any(row["status"] == "failed" for row in ours))
    for one, other in zip(*rows, strict=True):
        assert "done" in (one["status"], other["status"])
        assert not resume or {one["status"], other["status"]} == {"done", "skipped"}
        for row in (one, other):
            assert row["status"] in ({"done", "skipped"} if resume else {"done", "failed"})
            if row["status"] == "failed":
                assert re.search("another run is writing it|exists already", row["reason"])


@pytest.mark.slow
def test_two_runs_on_one_output_one_is_refused(tmp_path):
    write_study(tmp_path, 1, size=40)
    arguments = ["denoise", tmp_path / "psi.nii.gz", tmp_path / "data-1.nii.gz", "-o", tmp_path / "o.nii.gz"]
    both = [start(*arguments, "--beta", 0.1, "--iterations", 300, "--threads", 1) for _ in range(2)]
    said = [process.communicate(timeout=60)[1] for process in both]
    assert sorted(process.returncode for process in both) == [0, 2]
    refused = said[[process.returncode for process in both].index(2)]
    assert re.fullmatch(r"beltrami: .*: (another run is writing it \(process \d+ on .*|exists already.*)\n", refused)
    assert record(tmp_path / "o.json")["Iterations"] == 300
    assert not any(map(is_hidden, contents(tmp_path)))
