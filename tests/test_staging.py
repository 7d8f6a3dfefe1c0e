"""Outputs appear whole or not at all, in order, and never in place of an input."""

from __future__ import annotations

import errno
import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from beltrami_cli.errors import BusyError, DataError, RefusedError
from beltrami_cli.formats import Stage, staging
from beltrami_cli.formats.staging import who_writes


def everything_in(folder: Path) -> set[str]:
    return {str(path.relative_to(folder)) for path in folder.rglob("*")}


def test_files_appear_together_at_commit(tmp_path):
    (tmp_path / "meshes").mkdir()
    finals = [tmp_path / "o.nii.gz", tmp_path / "meshes" / "o.ply", tmp_path / "o.json"]
    with Stage(finals) as stage:
        for final in finals:
            assert stage.path(final).name == final.name
            assert stage.path(final).parent.parent == final.parent
            stage.path(final).write_text(final.name)
        assert not any(final.exists() for final in finals)
        stage.commit()
    assert everything_in(tmp_path) == {"meshes", "o.nii.gz", "meshes/o.ply", "o.json"}
    assert [final.read_text() for final in finals] == ["o.nii.gz", "o.ply", "o.json"]


@pytest.mark.parametrize("interruption", [ValueError, KeyboardInterrupt, SystemExit])
def test_leaving_without_commit_leaves_nothing(tmp_path, interruption):
    def interrupted() -> None:
        with Stage([tmp_path / "a", tmp_path / "b"]) as stage:
            stage.path(tmp_path / "a").write_text("half")
            raise interruption

    with pytest.raises(interruption):
        interrupted()
    with Stage([tmp_path / "a"]) as stage:
        stage.path(tmp_path / "a").write_text("whole, but never committed")
    assert everything_in(tmp_path) == set()


def test_a_killed_run_leaves_no_output_and_the_next_one_clears_up(tmp_path):
    final = tmp_path / "o.nii.gz"
    program = (
        "import os, signal, sys; from pathlib import Path; from beltrami_cli.formats import Stage\n"
        "final = Path(sys.argv[1])\n"
        "with Stage([final]) as stage:\n"
        "    stage.path(final).write_text('half'); os.kill(os.getpid(), signal.SIGKILL)\n"
    )
    killed = subprocess.run([sys.executable, "-c", program, str(final)], check=False)
    assert killed.returncode == -9
    left = {f".o.nii.gz.partial/{name}" for name in ("o.nii.gz", ".lock", ".running")}
    assert everything_in(tmp_path) == {".o.nii.gz.partial", *left}

    with Stage([final]) as stage:
        assert not stage.path(final).exists()
        stage.path(final).write_text("whole")
        stage.commit()
    assert everything_in(tmp_path) == {"o.nii.gz"}


def writing_elsewhere(*finals: Path, first: str = "") -> subprocess.Popen[str]:
    """A process that has entered a stage for these files, and stays in it until it is killed. first: lines it runs."""
    program = first + (
        "import sys, time; from pathlib import Path; from beltrami_cli.formats import Stage\n"
        "with Stage([Path(p) for p in sys.argv[1:]]) as stage:\n"
        "    stage.path(Path(sys.argv[1])).write_text('half'); stage.tell('flow')\n"
        "    print('in', flush=True); time.sleep(60)\n"
    )
    other = subprocess.Popen([sys.executable, "-c", program, *map(str, finals)], stdout=subprocess.PIPE, text=True)
    assert other.stdout is not None
    assert other.stdout.readline() == "in\n"
    return other


def test_two_runs_never_write_the_same_outputs_at_once(tmp_path):
    (tmp_path / "meshes").mkdir()
    volume, mesh, mark = tmp_path / "o.npy", tmp_path / "meshes" / "o.ply", tmp_path / "o.json"
    with writing_elsewhere(volume, mesh, mark) as other:
        assert who_writes(mark) == {"process": other.pid, "host": socket.gethostname(), "phase": "flow"}
        before = everything_in(tmp_path)
        for finals in ([volume, mesh, mark], [tmp_path / "o.mha", mark], [tmp_path / "p.npy", mesh]):
            with pytest.raises(BusyError, match=rf"another run is writing it \(process {other.pid} on "), Stage(finals):
                pass
            Stage(finals).sweep()
            assert everything_in(tmp_path) == before
        other.kill()
    with Stage([volume, mesh, mark]) as stage:
        for final in (volume, mesh, mark):
            stage.path(final).write_text("whole")
        stage.commit()
    assert everything_in(tmp_path) == {"meshes", "o.npy", "meshes/o.ply", "o.json"}
    assert who_writes(mark) is None


def test_one_process_cannot_enter_twice(tmp_path):
    with Stage([tmp_path / "o"]) as first:
        first.path(tmp_path / "o").write_text("first")
        with pytest.raises(BusyError), Stage([tmp_path / "o"]):
            pass
        first.commit()
    assert everything_in(tmp_path) == {"o"}


def test_what_another_run_finished_meanwhile_is_not_replaced(tmp_path):
    late = Stage([tmp_path / "o"])
    with Stage([tmp_path / "o"]) as first:
        first.path(tmp_path / "o").write_text("first")
        first.commit()
    with pytest.raises(RefusedError, match="exists already"), late:
        pass
    assert (tmp_path / "o").read_text() == "first"
    assert everything_in(tmp_path) == {"o"}


def test_what_a_killed_run_left_is_swept(tmp_path):
    with writing_elsewhere(tmp_path / "o") as other:
        other.kill()
    assert ".o.partial" in everything_in(tmp_path)
    Stage([tmp_path / "o"]).sweep()
    assert everything_in(tmp_path) == set()


def test_a_run_killed_between_two_names_leaves_nothing_in_the_way(tmp_path):
    finals = [tmp_path / "o.npy", tmp_path / "o.json"]
    program = (
        "import os, signal, sys; from pathlib import Path; from beltrami_cli.formats import Stage\n"
        "finals, replace = [Path(p) for p in sys.argv[1:]], os.replace\n"
        "with Stage(finals) as stage:\n"
        "    for final in finals: stage.path(final).write_text('killed')\n"
        "    os.replace = lambda a, b: os.kill(os.getpid(), signal.SIGKILL) if b == finals[1] else replace(a, b)\n"
        "    stage.commit()\n"
    )
    assert subprocess.run([sys.executable, "-c", program, *map(str, finals)], check=False).returncode == -9
    assert {"o.npy", ".o.json.partial/o.json"} < everything_in(tmp_path)
    with Stage(finals) as stage:
        for final in finals:
            stage.path(final).write_text("whole")
        stage.commit()
    assert everything_in(tmp_path) == {"o.npy", "o.json"}
    assert [final.read_text() for final in finals] == ["whole", "whole"]


def test_many_runs_at_once_enter_one_by_one(tmp_path):
    program = (
        "import sys; from pathlib import Path; from beltrami_cli.errors import BusyError\n"
        "from beltrami_cli.formats import Stage\n"
        "final, entered = Path(sys.argv[1]), 0\n"
        "while entered < 50:\n"
        "    try:\n"
        "        with Stage([final], overwrite=True) as stage:\n"
        "            inside = stage.path(final)\n"
        "            assert not inside.exists()\n"
        "            inside.write_text(sys.argv[2]); assert inside.read_text() == sys.argv[2]\n"
        "            stage.commit(); entered += 1\n"
        "    except BusyError: pass\n"
    )
    runs = [subprocess.Popen([sys.executable, "-c", program, str(tmp_path / "o"), str(k)]) for k in range(4)]
    assert [run.wait(60) for run in runs] == [0] * 4
    assert everything_in(tmp_path) == {"o"}


@pytest.fixture
def flock_fails(monkeypatch):
    """Lets every lock of a file end with an error of this number, here."""
    fcntl = pytest.importorskip("fcntl")

    def fails(number: int) -> None:
        def flock(*_: object) -> None:
            raise OSError(number, os.strerror(number))

        monkeypatch.setattr(fcntl, "flock", flock)

    return fails


@pytest.mark.parametrize("code", ["ENOLCK", "ENOTSUP", "EOPNOTSUPP", "ENOSYS"])
def test_where_there_are_no_locks_a_file_stands_for_one(tmp_path, flock_fails, code):
    flock_fails(getattr(errno, code))
    final = tmp_path / "o"
    with Stage([final]) as first:
        first.path(final).write_text("first")
        with pytest.raises(BusyError, match=rf"another run is writing it \(process {os.getpid()} on "), Stage([final]):
            pass
        first.commit()
    assert everything_in(tmp_path) == {"o"}


def test_what_a_killed_run_left_is_taken_over_where_there_are_no_locks(tmp_path, flock_fails):
    flock_fails(errno.ENOLCK)
    no_locks = (
        "import errno, fcntl\ndef flock(*_): raise OSError(errno.ENOLCK, 'No locks available')\nfcntl.flock = flock\n"
    )
    with writing_elsewhere(tmp_path / "o", first=no_locks) as other:
        with pytest.raises(BusyError, match=f"process {other.pid} on "), Stage([tmp_path / "o"]):
            pass
        other.kill()
    with Stage([tmp_path / "o"]) as stage:
        assert not stage.path(tmp_path / "o").exists()
    assert everything_in(tmp_path) == set()


def test_a_lock_that_fails_leaves_nothing(tmp_path, flock_fails):
    flock_fails(errno.EIO)
    with pytest.raises(RefusedError, match=r"cannot be written to \(Input/output error\)"), Stage([tmp_path / "o"]):
        pass
    assert everything_in(tmp_path) == set()


@pytest.mark.parametrize("stands_there", ["file", "link", "pipe"])
def test_what_stands_in_the_way_of_the_hidden_folder_is_told(tmp_path, stands_there):
    hidden = tmp_path / ".o.partial"
    match stands_there:
        case "file":
            hidden.touch()
        case "link":
            hidden.symlink_to("nowhere")
        case "pipe":
            os.mkfifo(hidden)
    with pytest.raises(RefusedError, match=r"\.o\.partial: cannot be made; remove what"), Stage([tmp_path / "o"]):
        pass
    assert everything_in(tmp_path) == {".o.partial"}


def test_a_process_that_ends_between_two_steps_leaves_no_hidden_folder(tmp_path, monkeypatch):
    def ends(folder: Path) -> None:
        assert folder.is_dir()
        staging.abandon()
        assert everything_in(tmp_path) == set()
        raise KeyboardInterrupt

    with Stage([tmp_path / "o"]):
        (lock,) = staging._OPEN.values()
        monkeypatch.setattr(lock, "release", staging.abandon)
    assert everything_in(tmp_path) == set()
    assert not staging._OPEN
    assert not staging._MADE
    monkeypatch.setattr(staging, "_locked", ends)
    with pytest.raises(KeyboardInterrupt), Stage([tmp_path / "o"]):
        pass


def test_an_existing_output_needs_overwrite(tmp_path):
    final, mark = tmp_path / "o.npy", tmp_path / "o.json"
    mark.write_text("old")
    with pytest.raises(RefusedError, match=r"o\.json: exists already; .*--overwrite"):
        Stage([final, mark])
    with Stage([final, mark], overwrite=True) as stage:
        stage.path(final).write_text("new")
        stage.path(mark).write_text("new")
        assert mark.read_text() == "old"
        stage.commit()
    assert (final.read_text(), mark.read_text()) == ("new", "new")


def test_the_mark_of_completion_never_stands_beside_new_files_of_an_unfinished_run(tmp_path, monkeypatch):
    final, mark = tmp_path / "o.npy", tmp_path / "o.json"
    final.write_text("old")
    mark.write_text("old")

    def fail(source: Path, target: Path) -> None:
        raise OSError(28, "No space left on device")

    def run() -> None:
        with Stage([final, mark], overwrite=True) as stage:
            stage.path(final).write_text("new")
            stage.path(mark).write_text("new")
            monkeypatch.setattr("os.replace", fail)
            stage.commit()

    with pytest.raises(DataError, match=r"o\.npy: cannot be put in place \(No space left on device\)"):
        run()
    assert everything_in(tmp_path) == {"o.npy"}


def test_nothing_is_put_in_place_while_one_is_missing(tmp_path):
    def run() -> None:
        with Stage([tmp_path / "a", tmp_path / "b"]) as stage:
            stage.path(tmp_path / "a").write_text("a")
            stage.commit()

    with pytest.raises(DataError, match="announced but not written"):
        run()
    assert everything_in(tmp_path) == set()


def test_refusals_come_before_anything_is_made(tmp_path):
    (tmp_path / "folder").mkdir()
    (tmp_path / "input").write_text("data")
    (tmp_path / "link").symlink_to(tmp_path / "input")
    refusals = [
        (([tmp_path / "gone" / "o.npy"],), {}, "does not exist"),
        (([tmp_path / "folder"],), {"overwrite": True}, "is a folder"),
        (([tmp_path / "o", tmp_path / "folder" / ".." / "o"],), {}, "named for two outputs"),
        (([tmp_path / "input"],), {"overwrite": True, "inputs": [tmp_path / "input"]}, "is an input"),
        (([tmp_path / "link"],), {"overwrite": True, "inputs": [tmp_path / "input"]}, "is an input"),
    ]
    before = everything_in(tmp_path)
    for arguments, options, words in refusals:
        with pytest.raises(RefusedError, match=words) as refusal:
            Stage(*arguments, **options)
        assert "\n" not in str(refusal.value)
    assert everything_in(tmp_path) == before
    assert (tmp_path / "input").read_text() == "data"


def test_one_folder_under_two_spellings(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    finals = [Path("o.npy"), tmp_path / "o.json"]
    with Stage(finals) as stage:
        for final in finals:
            stage.path(final).write_text("x")
        stage.commit()
    assert everything_in(tmp_path) == {"o.npy", "o.json"}


def test_runs_that_share_a_mesh_folder_do_not_meet(tmp_path):
    for name in ("s1", "s2", "meshes"):
        (tmp_path / name).mkdir()
    outputs = [[tmp_path / f"s{k}" / "o.npy", tmp_path / "meshes" / f"{k}.ply"] for k in (1, 2)]
    with Stage(outputs[0]) as first:
        for final in outputs[0]:
            first.path(final).write_text("first")
        with Stage(outputs[1]) as second:
            for final in outputs[1]:
                second.path(final).write_text("second")
            second.commit()
        first.commit()
    assert [path.read_text() for path in outputs[0] + outputs[1]] == ["first", "first", "second", "second"]
    assert sorted(path.name for path in (tmp_path / "meshes").iterdir()) == ["1.ply", "2.ply"]
