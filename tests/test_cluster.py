"""Batches on a Dask cluster: real schedulers and workers, each a process, that end, die and are refused."""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import pytest
from command import ball, nifti, noisy

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / "docs" / "examples"
# The command, with less patience for schedulers that do not answer.
PROGRAM = """
import sys
from beltrami_cli import cluster
from beltrami_cli.cli import main
cluster._ANSWER = 3
sys.exit(main())
"""
BELTRAMI = [sys.executable, "-c", PROGRAM]
STEPS = {"short": 20, "long": 8_000}  # the long one takes some seconds

pytestmark = pytest.mark.slow


class Cluster:
    """A Dask scheduler and its workers; every process ends with the test."""

    def __init__(self, folder: Path, ends: ExitStack, **settings: str) -> None:
        self.folder, self.ends = folder, ends
        self.file = folder / "scheduler.json"
        self.scheduler = self.start(
            "dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--dashboard-address", "127.0.0.1:0",
            "--scheduler-file", str(self.file), **settings,
        )  # fmt: skip
        until(self.file.exists)

    def worker(self, *options: str, **environment: str) -> subprocess.Popen[bytes]:
        nanny = () if "--nanny" in options else ("--no-nanny",)
        return self.start(
            "dask_worker", "--scheduler-file", str(self.file), "--no-dashboard", "--local-directory",
            str(self.folder / "dask"), *nanny, *options, **environment,
        )  # fmt: skip

    def start(self, module: str, *options: str, **environment: str) -> subprocess.Popen[bytes]:
        log = self.ends.enter_context((self.folder / f"{module}.log").open("ab"))
        process = subprocess.Popen(
            [sys.executable, "-m", f"distributed.cli.{module}", *options],
            stdout=log, stderr=log, cwd=self.folder, env={**os.environ, **environment}, start_new_session=True,
        )  # fmt: skip
        self.ends.callback(_end, process)
        return process


def _end(process: subprocess.Popen[bytes]) -> None:
    with suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


@contextmanager
def a_cluster(folder: Path, **settings: str) -> Iterator[Cluster]:
    with ExitStack() as ends:
        yield Cluster(folder, ends, **settings)


@pytest.fixture
def dask(tmp_path: Path) -> Iterator[Cluster]:
    with a_cluster(tmp_path) as cluster:
        yield cluster


@pytest.fixture
def study(tmp_path: Path) -> Path:
    return make_study(tmp_path, "short", 4)


def make_study(folder: Path, kind: str, count: int) -> Path:
    nifti(folder / "psi.nii.gz", ball())
    for k in range(count):
        nifti(folder / f"data{k}.nii.gz", noisy(seed=k))
    config = folder / f"{kind}.toml"
    config.write_text(
        f"""
        for_each.k = {list(range(count))}
        input = {{ levelset = "psi.nii.gz", data = "data{{k}}.nii.gz" }}
        output.volume = "out/{{k}}.nii.gz"
        time.iterations = {STEPS[kind]}
        flow.beta = 0.05
        """
    )
    return config


def start(*arguments: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*BELTRAMI, "batch", *map(str, arguments)], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def ended(process: subprocess.Popen[str], seconds: float = 60) -> tuple[int, str, str]:
    """Its exit code, stdout and stderr; on stderr are only lines of its own."""
    out, err = process.communicate(timeout=seconds)
    assert [line for line in err.splitlines() if line and not line.startswith("beltrami: ")] == []
    return process.returncode, out, err


def batch(*arguments: object, seconds: float = 60) -> tuple[int, str, str]:
    return ended(start(*arguments), seconds)


def until(holds: Callable[[], object], seconds: float = 30) -> None:
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end
        time.sleep(0.02)


def writers(folder: Path) -> dict[str, int]:
    """The processes that are writing in a folder, by the hidden folder that each holds."""
    found = {}
    for file in folder.glob(".*.partial/.running"):
        try:
            found[file.parent.name] = json.loads(file.read_text())["process"]
        except (OSError, ValueError):
            continue
    return found


def outputs(folder: Path) -> dict[str, str]:
    """Every file in a folder, hidden ones too, with a digest; of records only what does not differ from run to run."""
    found = {}
    for path in sorted(path for path in folder.rglob("*") if path.is_file()):
        content = path.read_bytes()
        if path.suffix == ".json":
            record = json.loads(content)
            record["Parameters"].pop("threads")
            content = json.dumps({n: record[n] for n in ("Parameters", "Request", "PerIteration", "Sources")}).encode()
        found[str(path.relative_to(folder))] = hashlib.sha256(content).hexdigest()
    return found


def expected(study: Path) -> dict[str, str]:
    """The outputs of an undisturbed batch on this machine; they are removed."""
    assert batch(study, "--jobs", 2)[0] == 0
    found = outputs(study.parent / "out")
    shutil.rmtree(study.parent / "out")
    return found


def table(text: str) -> list[tuple[str, str]]:
    """Job and status of each line of the final table."""
    return re.findall(r"^(k=\d+) +(done|skipped|failed)", text, re.MULTILINE)


def summary(path: Path) -> list[dict[str, object]]:
    return [{**row, "seconds": None} for row in json.loads(path.read_text())]


def test_workers_give_the_bytes_of_processes(tmp_path, study, dask):
    here, there = tmp_path / "here.json", tmp_path / "there.json"
    code, out, _ = batch(study, "--jobs", 2, "--summary", here)
    assert code == 0
    bytes_here = outputs(tmp_path / "out")
    shutil.rmtree(tmp_path / "out")
    dask.worker("--nthreads", "1", "--nworkers", "2", "--nanny")
    code, again, _ = batch(study, "--scheduler", dask.file, "--summary", there)
    assert (code, table(again)) == (0, table(out)) and len(table(out)) == 4
    assert outputs(tmp_path / "out") == bytes_here
    assert summary(here) == summary(there)
    address = json.loads(dask.file.read_text())["address"]
    code, out, _ = batch(study, "--scheduler", address, "--resume")
    assert (code, out.count("skipped")) == (0, 5)
    (tmp_path / "data2.nii.gz").unlink()
    code, out, _ = batch(study, "--scheduler", address, "--resume")
    assert code == 1
    assert [status for _, status in table(out)] == ["skipped", "skipped", "failed", "skipped"]


def test_batch_waits_for_workers_and_each_does_one_job_with_all_its_threads(tmp_path, study, dask):
    running = start(study, "--scheduler", dask.file)
    time.sleep(3)
    assert running.poll() is None
    dask.worker("--nthreads", "4", NUMBA_NUM_THREADS="4")
    code, out, _ = ended(running)
    assert code == 0, out
    used = [json.loads(path.read_text())["Parameters"]["threads"] for path in (tmp_path / "out").glob("*.json")]
    assert used == [4] * 4


def test_job_of_a_killed_worker_is_done_by_another(tmp_path, dask):
    study = make_study(tmp_path, "long", 2)
    whole = expected(study)
    first, _ = (dask.worker("--nthreads", "1") for _ in range(2))
    running = start(study, "--scheduler", dask.file)
    until(lambda: first.pid in writers(tmp_path / "out").values())
    first.kill()
    code, out, _ = ended(running)
    assert (code, out.count("done")) == (0, 3)
    assert outputs(tmp_path / "out") == whole
    assert len(whole) == 8


def test_job_whose_workers_die_again_and_again_is_reported(tmp_path):
    study = make_study(tmp_path, "long", 2)
    with a_cluster(tmp_path, DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="1") as dask:
        dask.worker("--nthreads", "1", "--nworkers", "2", "--nanny")
        running = start(study, "--scheduler", dask.file, "--retries", 2)
        killed = set()
        while running.poll() is None:
            pid = writers(tmp_path / "out").get(".0.json.partial")
            if pid is not None and pid not in killed:
                with suppress(ProcessLookupError):
                    os.kill(pid, signal.SIGKILL)
                    killed.add(pid)
            time.sleep(0.05)
        code, out, _ = ended(running)
    # Two starts by Dask make one round; after two rounds there are more than 2 retries.
    assert len(killed) == 4
    assert (code, table(out)) == (1, [("k=0", "failed"), ("k=1", "done")])
    assert "its process died, 4 times of 4 (the last time on worker tcp://127.0.0.1:" in out


def test_scheduler_that_dies_ends_the_batch_and_resume_does_the_rest(tmp_path, dask):
    study = make_study(tmp_path, "long", 2)
    whole = expected(study)
    dask.worker("--nthreads", "1")
    running = start(study, "--scheduler", dask.file)
    until(lambda: (tmp_path / "out" / "0.json").exists() and writers(tmp_path / "out"))
    _end(dask.scheduler)
    then = time.monotonic()
    code, out, err = ended(running)
    assert time.monotonic() - then < 25
    assert (code, table(out)) == (1, [("k=0", "done"), ("k=1", "failed")])
    assert err.count("is gone; start it again, with workers, and use --resume for the rest") == 1
    code, out, _ = batch(study, "--resume", "--jobs", 2)
    assert code == 0
    assert outputs(tmp_path / "out") == whole


def test_worker_that_is_told_to_end_in_mid_job(tmp_path, dask):
    study = make_study(tmp_path, "long", 2)
    whole = expected(study)
    dask.worker("--nthreads", "1", "--lifetime", "6s")
    running = start(study, "--scheduler", dask.file, "--retries", 0)
    until(lambda: writers(tmp_path / "out"))
    dask.worker("--nthreads", "1")
    code, out, _ = ended(running)
    assert (code, out.count("done")) == (0, 3), out
    assert outputs(tmp_path / "out") == whole


def test_interrupted_batch_leaves_nothing_half_written(tmp_path, dask):
    study = make_study(tmp_path, "long", 2)
    dask.worker("--nthreads", "1")
    running = start(study, "--scheduler", dask.file)
    until(lambda: writers(tmp_path / "out"))
    running.send_signal(signal.SIGINT)
    _, err = running.communicate(timeout=10)
    said = "\nbeltrami: interrupted: 0 of 2 jobs done; the same command with --resume goes on\n"
    assert (running.returncode, err) == (130, said)
    until(lambda: not writers(tmp_path / "out"))
    assert {path.name.split(".")[0] for path in (tmp_path / "out").iterdir()} == {"0"}  # ended, and whole
    assert (tmp_path / "out" / "0.json").exists()


def test_address_where_no_scheduler_answers_is_refused(tmp_path, study):
    (tmp_path / "empty.json").write_text("{}")
    with socket.socket() as closed, socket.socket() as other:
        for one in (closed, other):
            one.bind(("127.0.0.1", 0))
        other.listen()
        silent = [f"tcp://127.0.0.1:{one.getsockname()[1]}" for one in (closed, other)]
        no_address = ["nowhere", "http://127.0.0.1:80", tmp_path / "missing.json", tmp_path / "empty.json"]
        started = [(address, start(study, "--scheduler", address)) for address in (*silent, *no_address)]
        for address, process in started:
            code, out, err = ended(process, 25)
            assert (code, out, err.count("\n")) == (2, "", 1)
            assert str(address) in err
            assert ("none answers there" if address in silent else "expected") in err


def test_what_a_worker_cannot_do_is_said(tmp_path, study, dask):
    small = dask.worker("--nthreads", "1", "--memory-limit", "100MB", DASK_DISTRIBUTED__WORKER__MEMORY__PAUSE="False")
    code, out, _ = batch(study, "--scheduler", dask.file)
    assert (code, out.count("failed")) == (1, 5)
    assert out.count("found a limit of 95 MB") == 4
    assert out.count("on worker tcp://127.0.0.1:") == 4 and small.poll() is None
    _end(small)

    old = tmp_path / "old.py"
    old.write_text("import beltrami_cli\nbeltrami_cli.__version__ = '0.0.1'\n")
    dask.worker("--nthreads", "1", "--preload", str(old))
    code, out, _ = batch(study, "--scheduler", dask.file)
    assert (code, out.count("has beltrami_cli 0.0.1; expected")) == (1, 4)


# The examples of docs/cluster.md


def with_commands(**variables: str) -> dict[str, str]:
    """The environment with `beltrami` on PATH."""
    return {**os.environ, "PATH": f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}", **variables}


def test_dask_example_runs_with_workers_of_this_machine(tmp_path, study):
    whole = expected(study)
    command = [sys.executable, EXAMPLES / "slurm_dask.py", study, "--local", "--workers", "2", "--cores", "1"]
    for options in ([], ["--resume"]):
        run = subprocess.run([*command, *options], capture_output=True, text=True, timeout=60)
        assert run.returncode == 0, run.stderr
        assert outputs(tmp_path / "out") == whole
    assert run.stdout.count("skipped") == 5


def test_dask_example_asks_slurm_for_what_it_says(tmp_path):
    """In a process of its own: the scheduler that SLURM's workers are to find runs in it."""
    code = """if True:
        import slurm_dask
        with slurm_dask.slurm(1.5, 6, "20GB") as cluster:
            print(cluster.job_script())
    """
    here = {**os.environ, "PYTHONPATH": str(EXAMPLES)}  # logs are kept in the working folder
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=tmp_path, env=here, timeout=60
    )
    script = run.stdout
    assert re.search(r"^#SBATCH -n 1$", script, re.MULTILINE), run.stderr
    assert re.search(r"^#SBATCH --cpus-per-task=6$", script, re.MULTILINE)
    assert re.search(r"^#SBATCH --mem=19G$", script, re.MULTILINE)  # 20e9 bytes
    assert re.search(r"^#SBATCH -t 01:30:00$", script, re.MULTILINE)
    assert re.search(r"dask_worker tcp://\S+ .*--nthreads 6 .*--lifetime 80m --lifetime-stagger 4m", script)
    assert "--nworkers" not in script  # one process


def test_array_example_does_every_job_once(tmp_path, study):
    whole = expected(study)
    done = []
    for task in (1, 2, 3):
        environment = with_commands(SLURM_ARRAY_TASK_ID=str(task), SLURM_ARRAY_TASK_COUNT="3", SLURM_CPUS_PER_TASK="1")
        run = subprocess.run(
            ["bash", EXAMPLES / "slurm_array.sh", study], env=environment, capture_output=True, text=True, timeout=60
        )
        assert run.returncode == 0, run.stderr
        done += table(run.stdout)
    assert sorted(done) == [(f"k={k}", "done") for k in range(4)]
    assert outputs(tmp_path / "out") == whole


@pytest.mark.skipif(shutil.which("snakemake") is None, reason="snakemake is not installed")
def test_snakemake_example_runs(tmp_path):
    shutil.copy(EXAMPLES / "Snakefile", tmp_path)
    for subject in ("01", "02"):
        folder = tmp_path / f"sub-{subject}"
        folder.mkdir()
        for hemi in ("lh", "rh"):
            nifti(folder / f"sub-{subject}_hemi-{hemi}_levelset.nii.gz", ball())
            nifti(folder / f"sub-{subject}_hemi-{hemi}_angle.nii.gz", noisy())

    def snakemake() -> str:
        run = subprocess.run(
            ["snakemake", "--cores", "2", "--resources", "mem_mb=16000"],
            cwd=tmp_path, env=with_commands(XDG_CACHE_HOME=str(tmp_path / "cache")),
            capture_output=True, text=True, timeout=120,
        )  # fmt: skip
        assert run.returncode == 0, run.stderr
        return run.stderr

    snakemake()
    made = sorted(path.name for path in tmp_path.glob("derivatives/*/*"))
    assert len(made) == 16
    record = json.loads((tmp_path / "derivatives/sub-01/sub-01_hemi-lh_desc-denoised.json").read_text())
    assert (record["Parameters"]["period"], record["Parameters"]["threads"]) == (360, 2)
    assert "Nothing to be done" in snakemake()
