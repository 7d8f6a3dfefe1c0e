"""The contract of the command line: names, exit codes, one line per error, everything written or nothing."""

from __future__ import annotations

import fcntl
import gzip
import os
import pty
import re
import signal
import struct
import subprocess
import sys
import termios
import time
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from command import ball, beltrami, contents, done, load, nifti, noisy, npy, record, refused, seen

import beltrami_cli
from beltrami_cli.cli import beltrami as group

OPTIONS = {
    "denoise": "-o --mesh --no-mesh --flow --phi --beta --eps --scheme --iterations --time --fwhm --dt --extension "
    "--extend-every --band --spacing --resample --inside --outside --precision --config --threads --flat --overwrite "
    "--on --labels --between --map --frame --structure --memory --report",
    "batch": "--jobs --scheduler --resume --dry-run --summary --report --part --threads --memory --retries --overwrite",
    "view": "-o --levelset --compare --titles --side --colours --period --missing --map --labels --between --inside "
    "--spacing --resample --frame --overwrite",
    "levelset": "-o --labels --between --like --spacing --margin --frame --overwrite",
    "sample": "-o --kind --period --missing --frame --structure --spacing --overwrite",
    "mesh": "-o --spacing --resample --inside --overwrite",
    "phantom": "--size --noise --seed --format --overwrite",
    "compare": "--levelset --within --period --max-abs --max-rms --min-psnr --data-range --max-missing --max-distance "
    "--include --json",
    "info": "",
    "demo": "--overwrite",
}
CHOICES = {
    "denoise": "beltrami l2 l1 tv phi charbonnier perona-malik geman-mcclure weickert symmetric paper "
    "closest-point pde none negative positive nan zero keep float32 float64",
    "phantom": "torus sphere plane curve portrait sulcus cortex nii.gz mha npy",
}


def process(*arguments: object, **options: object) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "beltrami_cli", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, **options)


# Help


@pytest.mark.parametrize("command", OPTIONS)
def test_help_names_every_option(command):
    run = done(command, "--help")
    words = set(re.sub(r"[],|{}[]", " ", run.out).split())
    words |= {word.rstrip(".):;") for word in words}
    expected = {*OPTIONS[command].split(), *CHOICES.get(command, "").split(), "-q", "--quiet", "-v", "--verbose"}
    assert expected - words == set()


def test_help_of_the_group_names_commands_and_exit_codes():
    run = done("--help")
    assert set(group.commands) == set(OPTIONS)
    for word in (*OPTIONS, "Exit codes", "130", "143", "129", "_BELTRAMI_COMPLETE"):
        assert word in run.out


def test_no_arguments_show_the_help():
    run = beltrami()
    assert run.code == 2
    assert "Commands:" in run.out + run.err


def test_version():
    assert done("--version").out.split()[-1] == beltrami_cli.__version__


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_script(shell):
    script = Path(sys.executable).with_name("beltrami")
    if not script.exists():
        pytest.skip("the console script is not installed beside this Python")
    environment = {**os.environ, "_BELTRAMI_COMPLETE": f"{shell}_source"}
    run = subprocess.run([script], capture_output=True, text=True, env=environment, timeout=60)
    assert run.returncode == 0
    assert "_BELTRAMI_COMPLETE" in run.stdout


# What is written


def test_summary_is_three_lines(scene, tmp_path):
    levelset, data, out = scene
    run = done("denoise", levelset, data, "-o", out)
    first, second, third = run.out.splitlines()
    names = [tmp_path / f"out{suffix}" for suffix in (".nii.gz", ".surf.gii", ".func.gii", ".json")]
    assert first == f"wrote {', '.join(map(str, names))}"
    used = record(tmp_path / "out.json")
    assert f"noise removed {used['Removed']['rms']:.4g} rms" in second
    assert "20 iterations" in second
    assert "stopped by iterations" in second
    assert second.endswith(" s")
    assert third == f"chosen by held-out data: beltrami, beta {used['Choice']['beta']:.4g}, 20 iterations"
    assert 9 < used["Removed"]["rms"] < 11  # of noise 10
    assert all(name.exists() for name in names)


@pytest.mark.parametrize(
    "out, mesh",
    [
        ("o.nii", ["o.surf.gii", "o.func.gii"]),
        ("o.nii.gz", ["o.surf.gii", "o.func.gii"]),
        ("o.mgz", ["o.surf.gii", "o.func.gii"]),
        ("o.mha", ["o.ply"]),
        ("o.npy", ["o.ply"]),
        ("sub-1.run-2.nii.gz", ["sub-1.run-2.surf.gii", "sub-1.run-2.func.gii"]),
    ],
)
def test_mesh_and_sidecar_stand_beside_out(scene, tmp_path, out, mesh):
    levelset, data, _ = scene
    folder = tmp_path / "results"
    folder.mkdir()
    done("denoise", levelset, data, "-o", folder / out)
    stem = mesh[0].removesuffix(".surf.gii").removesuffix(".ply")
    assert set(contents(folder)) == {out, *mesh, f"{stem}.json"}


def test_meshes_that_are_named_replace_the_default(scene, tmp_path):
    levelset, data, _ = scene
    folder = tmp_path / "results"
    folder.mkdir()
    names = ["a.ply", "b.surf.gii", "c.stl", "d.obj", "e.glb", "f.vtk"]
    done("denoise", levelset, data, "-o", folder / "o.nii.gz", *(f"--mesh={folder / name}" for name in names))
    assert set(contents(folder)) == {*names, "b.func.gii", "o.nii.gz", "o.json"}
    written = ["o.nii.gz", *names[:2], "b.func.gii", *names[2:], "o.json"]
    assert record(folder / "o.json")["Outputs"] == [str(folder / name) for name in written]


def test_no_mesh(scene, tmp_path):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out, "--no-mesh")
    assert set(contents(tmp_path)) == {"psi.nii.gz", "data.nii.gz", "out.nii.gz", "out.json"}


def test_quiet_is_silent_and_verbose_says_more(scene):
    levelset, data, out = scene
    run = done("denoise", levelset, data, "-o", out, "-q")
    assert run.out == ""
    run = beltrami("denoise", levelset, data, "-o", out, "-v", "--overwrite")
    assert run.code == 0
    assert len(run.out.splitlines()) == 3
    assert "486 vertices" in run.err
    assert "peak memory" in run.err


def test_warnings_are_silent_under_quiet_and_stay_in_the_sidecar(scene, tmp_path):
    levelset, data, out = scene
    weights = nifti(tmp_path / "weights.nii.gz", np.where(ball() < 0, 1, -1e-4).astype(np.float32))
    assert done("denoise", levelset, data, "-o", out, "--weights", weights, "--quiet").out == ""
    assert "taken as 0" in record(tmp_path / "out.json")["Warnings"][0]


def test_progress_bar_on_a_terminal_only(scene):
    levelset, data, out = scene
    plain = process("denoise", levelset, data, "-o", out)
    assert (plain.returncode, plain.stderr) == (0, "")
    parent, child = pty.openpty()
    fcntl.ioctl(child, termios.TIOCSWINSZ, struct.pack("HHHH", 24, 80, 0, 0))  # else it has no columns to draw in
    command = [sys.executable, "-m", "beltrami_cli", "denoise", levelset, data, "-o", out, "--overwrite"]
    run = subprocess.Popen(command, stderr=child, stdout=subprocess.DEVNULL)
    os.close(child)
    assert "flow:" in read_terminal(parent)
    assert run.wait(60) == 0


def read_terminal(descriptor: int) -> str:
    seen = b""
    try:
        while chunk := os.read(descriptor, 4096):
            seen += chunk
    except OSError:  # how Linux says that the other end was closed
        pass
    os.close(descriptor)
    return seen.decode()


def test_inputs_never_change_and_overwrite_replaces(scene, tmp_path):
    levelset, data, out = scene
    before = contents(tmp_path)
    done("denoise", levelset, data, "-o", out, "--beta", "0.05")
    after = contents(tmp_path)
    assert before.items() <= after.items()
    assert "exists already" in refused("denoise", levelset, data, "-o", out)
    assert contents(tmp_path) == after
    done("denoise", levelset, data, "-o", out, "--beta", "0.5", "--overwrite")
    assert before.items() <= contents(tmp_path).items()
    assert contents(tmp_path)["out.nii.gz"] != after["out.nii.gz"]
    (tmp_path / "out.nii.gz").unlink()
    assert "out.surf.gii" in refused("denoise", levelset, data, "-o", out)


def test_two_runs_are_alike(scene, tmp_path):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out)
    done("denoise", levelset, data, "-o", tmp_path / "again.nii.gz", "--threads", "1")
    assert np.array_equal(load(out), load(tmp_path / "again.nii.gz"), equal_nan=True)


def test_names_with_spaces_and_letters_of_all_kinds(tmp_path):
    folder = tmp_path / "dossier à part"
    folder.mkdir()
    levelset = nifti(folder / "ψ 1.nii.gz", ball())
    data = nifti(folder / "données 日本.nii.gz", noisy())
    done("denoise", levelset, data, "-o", folder / "résultat.mha", "--mesh", folder / "maillage 1.ply", "-q")
    assert {"résultat.mha", "maillage 1.ply", "résultat.json"} <= set(contents(folder))


def test_links_are_followed_and_kept(scene, tmp_path):
    levelset, data, out = scene
    (tmp_path / "link.nii.gz").symlink_to(data)
    done("denoise", levelset, tmp_path / "link.nii.gz", "-o", out)
    assert "is an input" in refused("denoise", levelset, data, "-o", tmp_path / "link.nii.gz", "--overwrite")
    (tmp_path / "dangling.nii.gz").symlink_to(tmp_path / "nothing.nii.gz")
    message = refused("denoise", levelset, tmp_path / "dangling.nii.gz", "-o", out, "--overwrite")
    assert "a link to a file that is not there" in message


# Options


@pytest.mark.parametrize(
    "given, expected",
    [
        ("--beta 0.05", [0.05] * 4),
        ("--beta 0", [0.0] * 4),
        ("--beta 0.1:0.4", [0.1, 0.2, 0.3, 0.4]),
        ("--beta 0.1:0.4:linear", [0.1, 0.2, 0.3, 0.4]),
        ("--beta 0.1:0.8:geometric", [0.1, 0.2, 0.4, 0.8]),
        ("--beta 0.1,0.3", [0.1, 0.1, 0.3, 0.3]),
        ("--flow l2", [0.0] * 4),
        ("--flow l1 --eps 4", [0.25] * 4),
        ("--flow tv --eps 0.5", [2.0] * 4),
        ("--flow phi --phi weickert --beta 0.2", [0.2] * 4),
    ],
)
def test_beta_of_every_iteration(scene, tmp_path, given, expected):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out, "--iterations", "4", *given.split())
    each = record(tmp_path / "out.json")["PerIteration"]
    assert each["beta"] == pytest.approx(expected)
    assert each["dt"] == [0.15] * 4
    assert each["dt_over_beta"] == [pytest.approx(0.15 / beta) if beta else None for beta in expected]


@pytest.mark.parametrize(
    "given, iterations, dt, reason",
    [
        ("", 20, 0.15, "iterations"),
        ("--iterations 7", 7, 0.15, "iterations"),
        ("--dt 0.1 --iterations 3", 3, 0.1, "iterations"),
        ("--dt auto", 20, 0.15, "iterations"),
        ("--time 1.5", 10, 0.15, "time"),
        ("--time 1.6", 11, 1.6 / 11, "time"),
        ("--time 1 --dt 0.1", 10, 0.1, "time"),
        ("--fwhm 2", 3, 4 / (16 * np.log(2)) / 3, "fwhm"),
        ("--time 0", 0, 0.15, "time"),
    ],
)
def test_how_long(scene, tmp_path, given, iterations, dt, reason):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out, *given.split())
    used = record(tmp_path / "out.json")
    assert (used["Iterations"], used["StopReason"]) == (iterations, reason)
    assert used["PerIteration"]["dt"] == pytest.approx([dt] * iterations)
    assert used["TimeMm2"] == pytest.approx(dt * iterations)


@pytest.mark.parametrize(
    "first, second",
    [
        ("--flow beltrami --beta 0.1", "--flow l2"),
        ("--flow beltrami", "--flow l1"),
        ("--flow l1", "--flow tv"),
        ("--flow phi --beta 0.1", "--flow phi --phi charbonnier --beta 0.1"),
        ("--flow phi --phi geman-mcclure --edge 10", "--flow phi --phi weickert --edge 10"),
        ("--scheme symmetric", "--scheme paper"),
        ("--beta 0.01", "--beta 1"),
        ("--flow l1 --eps 1", "--flow l1 --eps 10"),
        ("--extension none", "--extension pde"),
        ("--extension closest-point", "--extension none"),
        ("--extend-every 1", "--extend-every 0"),
        ("--band 1.5", "--band 4"),
    ],
)
def test_options_make_a_difference(scene, tmp_path, first, second):
    levelset, data, out = scene
    results = []
    for given in (first, second):
        done("denoise", levelset, data, "-o", out, "--overwrite", *given.split())
        results.append(load(out))
    near = np.abs(ball()) < 0.5
    assert np.abs(results[0] - results[1])[near].max() > 1e-3


@pytest.mark.parametrize(
    "first, second",
    [
        ("--beta 0", "--flow l2"),
        ("--flow beltrami --beta 0.25", "--flow l1 --eps 4"),
        ("--flow tv --eps 4", "--flow phi --phi charbonnier --beta 0.25"),
        ("--flow phi", "--flow phi --phi perona-malik"),
    ],
)
def test_options_that_mean_the_same(scene, tmp_path, first, second):
    levelset, data, _ = scene
    for number, given in enumerate((first, second)):
        done("denoise", levelset, data, "-o", tmp_path / f"{number}.npy", *given.split())
    assert np.nanmax(np.abs(load(tmp_path / "0.npy") - load(tmp_path / "1.npy"))) < 1e-4


@pytest.mark.parametrize(
    "given, word",
    [
        ("--beta -1", "found '-1'"),
        ("--beta x", "found 'x'"),
        ("--beta 1:", "found '1:'"),
        ("--beta nan", "found 'nan'"),
        ("--beta 0:1:geometric", "above 0"),
        ("--beta 1:2:cubic", "'cubic'"),
        ("--beta=", "found ''"),
        ("--flow l2 --beta 1", "l2"),
        ("--flow l1 --beta 1", "eps"),
        ("--eps 2", "l1 and tv"),
        ("--flow l1 --eps 0", "above 0"),
        ("--phi weickert", "--flow phi"),
        ("--flow phi --phi huber", "charbonnier"),
        ("--flow heat", "'beltrami'"),
        ("--scheme upwind", "'symmetric'"),
        ("--iterations -1", "found -1"),
        ("--iterations 2.5", "integer"),
        ("--time -1", "found -1"),
        ("--fwhm nan", "found nan"),
        ("--time 1e300", "iterations"),
        ("--fwhm 1e200", "iterations"),
        ("--iterations 99999999999999999999", "at most 1e+07"),
        ("--dt 1e-300 --time 1", "iterations"),
        ("--time 1 --iterations 3", "give one of them"),
        ("--time 1 --fwhm 2", "give one of them"),
        ("--dt 0.2", "0.166667"),
        ("--dt 0", "above 0"),
        ("--dt fast", "'fast'"),
        ("--threads 0", "1 or more"),
        ("--band 1", "1.5 mm"),
        ("--band 0", "above 0"),
        ("--extend-every -1", "found -1"),
        ("--extension linear", "'closest-point'"),
        ("--outside blank", "'nan'"),
        ("--inside up", "'negative'"),
        ("--precision float16", "'float32'"),
        ("--spacing 2", ".npy"),
        ("--spacing wide", "'wide'"),
        ("--flat", "LEVELSET is omitted"),
        ("--no-mesh --mesh m.ply", "contradict"),
        ("--mesh m.gii", ".surf.gii"),
        ("--mesh nowhere/m.ply", "does not exist"),
        ("--mesh a.ply --mesh ./a.ply", "two outputs"),
        ("--sigma 3", "--sigma"),
        ("--beta", "--beta"),
        ("extra.nii.gz", "expected two files"),
    ],
)
def test_refused_before_starting(scene, tmp_path, given, word):
    levelset, data, out = scene
    before = contents(tmp_path)
    assert word in refused("denoise", levelset, data, "-o", out, *given.split())
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    "out, word",
    [
        ("disk", ".nii.gz"),
        ("o.xyz", ".nii.gz"),
        ("o.png", "read only"),
        ("o.MHA", "lower case"),
        ("nowhere/o.nii.gz", "does not exist"),
        ("data.nii.gz", "is an input"),
        ("./psi.nii.gz", "is an input"),
        ("folder.npy", "is a folder"),
        (".nii.gz", "not the suffix"),
    ],
)
def test_outputs_that_cannot_be(scene, tmp_path, out, word):
    levelset, data, _ = scene
    (tmp_path / "folder.npy").mkdir()
    before = contents(tmp_path)
    assert word in refused("denoise", levelset, data, "-o", tmp_path / out, "--overwrite")
    assert contents(tmp_path) == before


@pytest.mark.skipif(os.geteuid() == 0, reason="nothing is read-only to root")
def test_read_only_folder(scene, tmp_path):
    levelset, data, _ = scene
    folder = tmp_path / "locked"
    folder.mkdir(mode=0o500)
    assert "cannot be written to" in refused("denoise", levelset, data, "-o", folder / "o.nii.gz")


@pytest.mark.parametrize(
    "arguments, word",
    [
        ([], "DATA is missing"),
        (["psi"], "OUT"),
        (["psi", "data"], "OUT"),
        (["psi", "-o", "out"], "LEVELSET is missing"),
        (["--flat", "-o", "out"], "DATA is missing"),
        (["--flat", "data", "-o", "out", "--mesh", "m.ply"], "no mesh"),
        (["--flat", "data", "-o", "out", "--extension", "pde"], "no band"),
        (["--flat", "data", "-o", "out", "--band", "3"], "no band"),
        (["--flat", "data", "-o", "out", "--resample"], "no level set"),
        (["--flat", "psi", "data", "-o", "out"], "LEVELSET is omitted"),
    ],
)
def test_impossible_calls(scene, tmp_path, arguments, word):
    named = dict(zip(("psi", "data", "out"), scene, strict=True))
    before = contents(tmp_path)
    assert word in refused("denoise", *(named.get(argument, argument) for argument in arguments))
    assert contents(tmp_path) == before


# Inputs that cannot be used


def cut_short(path: Path) -> Path:
    content = path.read_bytes()
    path.write_bytes(content[: len(content) // 2])
    return path


def text(path: Path) -> Path:
    path.write_text("not a volume\n")
    return path


def empty(path: Path) -> Path:
    path.write_bytes(b"")
    return path


def zipped(path: Path) -> Path:
    path.write_bytes(gzip.compress(b"x"))
    return path


def sheared() -> np.ndarray:
    affine = np.eye(4)
    affine[0, 1] = 0.3
    return affine


NAN = np.full((16, 16, 16), np.nan, np.float32)
AWAY = np.where(np.abs(ball()) < 3, NAN, noisy())  # data that do not reach the surface

UNUSABLE = {
    "missing": (2, "no such file", lambda folder: folder / "nothing.nii.gz"),
    "a folder": (2, "is a folder", lambda folder: folder),
    "no suffix": (2, "not the suffix", lambda folder: text(folder / "disk")),
    "truncated": (1, "copied or downloaded whole", lambda f: cut_short(nifti(f / "cut.nii.gz", noisy()))),
    "truncated plain": (1, "copied or downloaded whole", lambda f: cut_short(nifti(f / "cut.nii", noisy()))),
    "text": (1, "cannot be read as NIfTI", lambda folder: text(folder / "text.nii")),
    "empty": (1, "cannot be read as NIfTI", lambda folder: empty(folder / "empty.nii.gz")),
    "text mha": (1, "cannot be read as MetaImage", lambda folder: text(folder / "text.mha")),
    "text npy": (1, "cannot be read as NPY", lambda folder: text(folder / "text.npy")),
    "text mgz": (1, "cannot be read as MGH", lambda folder: text(folder / "text.mgz")),
    "gzip of nothing": (1, "cannot be read as NIfTI", lambda folder: zipped(folder / "g.nii.gz")),
    "all NaN": (1, "no valid value", lambda folder: nifti(folder / "nan.nii.gz", NAN)),
    "NaN near": (1, "no valid value on the surface", lambda folder: nifti(folder / "near.nii.gz", AWAY)),
    "frames": (2, "several frames", lambda folder: nifti(folder / "frames.nii.gz", noisy((16, 16, 16, 3)))),
    "vector": (2, "several frames", lambda folder: nifti(folder / "vector.nii.gz", noisy((16, 16, 16, 1, 3)))),
    "complex": (2, "complex", lambda folder: nifti(folder / "complex.nii.gz", noisy().astype(np.complex64))),
    "pickled": (1, "never unpickled", lambda folder: npy(folder / "object.npy", np.array([{}, None]))),
    "a line": (2, "1-D", lambda folder: npy(folder / "line.npy", np.zeros(7))),
}


@pytest.mark.parametrize("case", UNUSABLE)
def test_unusable_data(scene, tmp_path, case):
    levelset, _, out = scene
    code, word, make = UNUSABLE[case]
    data = make(tmp_path)
    before = contents(tmp_path)
    assert word in refused("denoise", levelset, data, "-o", out, code=code)
    assert contents(tmp_path) == before


@pytest.mark.parametrize(
    "psi, code, word",
    [
        (ball() + 100, 1, "found values from"),
        (np.abs(ball()), 1, "no zero level"),
        (np.zeros((16, 16, 16), np.float32), 1, "found values from 0 to 0"),
        (NAN, 1, "no finite value"),
        ((ball() < 0).astype(np.int16) + (ball() < -2), 2, "labels 0, 1, 2"),
    ],
    ids=["positive", "unsigned", "zero", "NaN", "labels"],
)
def test_unusable_level_sets(scene, tmp_path, psi, code, word):
    _, data, out = scene
    levelset = nifti(tmp_path / "bad.nii.gz", psi.astype(np.float32))
    before = contents(tmp_path)
    assert word in refused("denoise", levelset, data, "-o", out, code=code)
    assert contents(tmp_path) == before


def test_swapped_arguments(scene, tmp_path):
    levelset, data, out = scene
    assert "are LEVELSET and DATA swapped?" in refused("denoise", data, levelset, "-o", out, code=1)
    assert not out.exists()


def test_sheared_affine(tmp_path):
    volumes = [nifti(tmp_path / f"{n}.nii.gz", a, sheared()) for n, a in (("psi", ball()), ("data", noisy()))]
    assert "not orthogonal" in refused("denoise", *volumes, "-o", tmp_path / "out.nii.gz")
    assert "not orthogonal" in refused("mesh", volumes[0], "-o", tmp_path / "m.ply")


def test_grids_that_differ_are_both_printed(scene, tmp_path):
    levelset, _, out = scene
    before = contents(tmp_path)
    data = nifti(tmp_path / "narrow.nii.gz", noisy((15, 16, 16)), np.diag([2.0, 1.0, 1.0, 1.0]))
    run = beltrami("denoise", levelset, data, "-o", out)
    assert run.code == 2
    message, first, second = run.err.splitlines()
    assert "--resample" in message
    assert "16 x 16 x 16 voxels of 1 x 1 x 1 mm" in first
    assert "15 x 16 x 16 voxels of 2 x 1 x 1 mm" in second
    assert set(contents(tmp_path)) == {*before, "narrow.nii.gz"}


def test_resampling_from_elsewhere_leaves_nothing(scene, tmp_path):
    levelset, _, out = scene
    affine = np.eye(4)
    affine[0, 3] = 500
    far = nifti(tmp_path / "far.nii.gz", noisy(), affine)
    refused("denoise", levelset, far, "-o", out, "--resample", code=1)
    assert not out.exists()


def test_traceback_only_when_asked_for(scene, tmp_path):
    levelset, _, out = scene
    bad = text(tmp_path / "text.nii")
    refused("denoise", levelset, bad, "-o", out, code=1)
    run = beltrami("denoise", levelset, bad, "-o", out, "-v")
    assert run.code == 1
    assert run.err.startswith("Traceback")
    assert run.err.splitlines()[-1].startswith(f"beltrami: {bad}: cannot be read")


def test_a_bug_is_one_line_too(scene, monkeypatch):
    levelset, data, out = scene
    monkeypatch.setattr("beltrami_cli.pipeline.run", lambda *_, **__: 1 / 0)
    assert refused("denoise", levelset, data, "-o", out, code=1).startswith("unexpected ZeroDivisionError: division by")

    def exhausted(*_: object, **__: object) -> None:
        raise MemoryError

    monkeypatch.setattr("beltrami_cli.pipeline.run", exhausted)
    assert "out of memory" in refused("denoise", levelset, data, "-o", out, code=1)


# Processes


def test_process_without_a_word_too_many(scene, tmp_path):
    levelset, data, out = scene
    run = process("denoise", levelset, data, "-o", out, "--beta", "0.1")
    assert (run.returncode, run.stderr, len(run.stdout.splitlines())) == (0, "", 2)
    run = process("denoise", levelset, tmp_path / "nothing.nii.gz", "-o", out)
    assert (run.returncode, run.stdout, len(run.stderr.splitlines())) == (2, "", 1)


@pytest.mark.parametrize("number, code", [(signal.SIGINT, 130), (signal.SIGTERM, 143), (signal.SIGHUP, 129)])
def test_interrupted_in_mid_run_leaves_nothing(scene, tmp_path, number, code):
    levelset, data, out = scene
    before = contents(tmp_path)
    command = [sys.executable, "-m", "beltrami_cli", "denoise", levelset, data, "-o", out, "--iterations", "10000000"]
    run = subprocess.Popen(command, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    deadline = time.monotonic() + 60
    while not (tmp_path / ".out.json.partial").exists():
        assert run.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.02)
    time.sleep(0.5)
    run.send_signal(number)
    out, err = run.communicate(timeout=60)
    assert run.returncode == code
    assert out == ""
    assert "Traceback" not in err
    assert len(err.split("\n")) <= 3  # an empty line after the terminal's ^C, and the message
    assert contents(tmp_path) == before


def test_a_reader_that_leaves_early_is_no_error(scene):
    levelset, *_ = scene
    command = f'"{sys.executable}" -m beltrami_cli info "{levelset}" | true'
    run = subprocess.run(["bash", "-c", command], capture_output=True, text=True, timeout=60)
    assert run.stderr == ""


# mesh


@pytest.mark.parametrize("suffix", ["surf.gii", "ply", "obj", "stl", "glb", "vtk"])
def test_mesh_in_every_format(scene, tmp_path, suffix):
    levelset, data, _ = scene
    bare, full = tmp_path / f"bare.{suffix}", tmp_path / f"full.{suffix}"
    assert done("mesh", levelset, "-o", bare).out == f"wrote {bare}\n"
    run = done("mesh", levelset, data, "-o", full)
    beside = f", {tmp_path / 'full.func.gii'}" if suffix == "surf.gii" else ""
    assert run.out == f"wrote {full}{beside}\n"
    assert (tmp_path / "full.func.gii").exists() == (suffix == "surf.gii")
    assert not (tmp_path / "bare.func.gii").exists()
    assert (full.stat().st_size > bare.stat().st_size) == (suffix not in ("surf.gii", "stl"))


def test_mesh_holds_the_data_as_they_are(scene, tmp_path):
    levelset, _, _ = scene
    x = np.indices((16, 16, 16))
    ramp = nifti(tmp_path / "ramp.nii.gz", (3.0 * x[0] - x[2]).astype(np.float32))
    done("mesh", levelset, ramp, "-o", tmp_path / "m.surf.gii", "-q")
    points = nib.load(tmp_path / "m.surf.gii").darrays[0].data
    values = nib.load(tmp_path / "m.func.gii").darrays[0].data
    assert np.abs(values - (3 * points[:, 0] - points[:, 2])).max() < 0.01


def test_mesh_is_refused_like_denoise(scene, tmp_path):
    levelset, data, _ = scene
    mesh = tmp_path / "m.ply"
    narrow = nifti(tmp_path / "narrow.nii.gz", noisy((15, 16, 16)))
    bare = npy(tmp_path / "psi.npy", ball())
    before = contents(tmp_path)
    assert "no zero level" in refused("mesh", data, "-o", mesh, code=1)
    assert "grids differ" in refused("mesh", levelset, narrow, "-o", mesh)
    assert "no such file" in refused("mesh", tmp_path / "nothing.nii", "-o", mesh)
    assert ".surf.gii" in refused("mesh", levelset, "-o", tmp_path / "m.gii")
    assert "'wide'" in refused("mesh", bare, "-o", mesh, "--spacing", "wide")
    assert ".npy inputs only" in refused("mesh", levelset, "-o", mesh, "--spacing", "2")
    assert "-o" in refused("mesh", levelset)
    assert contents(tmp_path) == before
    done("mesh", levelset, narrow, "-o", mesh, "--resample")
    assert "exists already" in refused("mesh", levelset, "-o", mesh)
    done("mesh", levelset, "-o", mesh, "--overwrite")


def test_mesh_of_data_that_do_not_reach_the_surface(scene, tmp_path):
    levelset, *_ = scene
    away = nifti(tmp_path / "away.nii.gz", AWAY)
    assert "no value on the surface" in refused("mesh", levelset, away, "-o", tmp_path / "m.ply", code=1)
    assert not (tmp_path / "m.ply").exists()


def test_mesh_of_a_curve(tmp_path):
    plane = npy(tmp_path / "psi.npy", ball((40, 40), 12.0))
    done("mesh", plane, npy(tmp_path / "data.npy", noisy((40, 40))), "-o", tmp_path / "m.ply")
    assert b"element edge" in (tmp_path / "m.ply").read_bytes()
    assert "lines of a curve" in refused("mesh", plane, "-o", tmp_path / "m.stl")


# phantom


@pytest.mark.parametrize("name", CHOICES["phantom"].split()[:6])
@pytest.mark.parametrize("suffix", ["nii.gz", "mha", "npy"])
def test_phantoms(tmp_path, name, suffix):
    folder = tmp_path / name
    done("phantom", name, folder, "--size", "20", "--format", suffix, "--noise", "12", "-q")
    assert set(contents(folder)) == {f"{part}.{suffix}" for part in ("levelset", "clean", "noisy")}
    if suffix == "npy":
        psi, clean, noise = (load(folder / f"{part}.npy") for part in ("levelset", "clean", "noisy"))
        assert psi.shape == ((20, 20) if name == "curve" else (20, 20, 20))
        assert psi.min() < 0 < psi.max()
        assert (noise - clean).std() == pytest.approx(12, rel=0.1)


def test_phantom_noise_follows_the_seed(tmp_path):
    for name, seed in (("a", 3), ("b", 3), ("c", 4)):
        done("phantom", "torus", tmp_path / name, "--size", "20", "--seed", seed, "--format", "npy")
    a, b, c = (load(tmp_path / name / "noisy.npy") for name in "abc")
    assert np.array_equal(a, b)
    assert np.abs(a - c).max() > 40
    assert np.array_equal(load(tmp_path / "a" / "clean.npy"), load(tmp_path / "c" / "clean.npy"))


@pytest.mark.parametrize(
    "arguments, word",
    [
        ("cube x", "'torus'"),
        ("torus x --size 3", "16 to 512"),
        ("torus x --noise -1", "at least 0"),
        ("torus x --noise nan", "found nan"),
        ("torus x --seed -1", "at least 0"),
        ("torus x --format mgz", "'npy'"),
        ("torus x --gap 2", "sulcus"),
        ("sphere x --map pieces", "torus"),
        ("sulcus x --gap 0", "above 0"),
        ("torus", "OUTDIR"),
    ],
)
def test_phantoms_that_cannot_be(tmp_path, monkeypatch, arguments, word):
    monkeypatch.chdir(tmp_path)
    assert word in refused("phantom", *arguments.split())
    assert contents(tmp_path) == {}


def test_phantom_does_not_overwrite_unasked(tmp_path):
    done("phantom", "sphere", tmp_path, "--size", "20")
    before = contents(tmp_path)
    assert "exists already" in refused("phantom", "sphere", tmp_path, "--size", "24")
    assert contents(tmp_path) == before
    done("phantom", "sphere", tmp_path, "--size", "24", "--overwrite")
    assert load(tmp_path / "clean.nii.gz").shape == (24, 24, 24)
    assert seen(tmp_path / "clean.nii.gz").max() <= 255
