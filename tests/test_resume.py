"""When a job counts as done: same inputs, parameters and version, all outputs there, the sidecar last."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from command import ball, contents, done, nifti, noisy, record

from beltrami_cli import resume
from beltrami_cli.config import make_job
from beltrami_cli.errors import RefusedError
from beltrami_cli.resume import finished


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    """A folder with a run in it."""
    folder = tmp_path_factory.mktemp("ran")
    psi, data = nifti(folder / "psi.nii.gz", ball()), nifti(folder / "data.nii.gz", noisy())
    done("denoise", psi, data, "-o", folder / "out.nii.gz", "--beta", 0.1, "--iterations", 2, "-q")
    return folder


@pytest.fixture
def job(ran, tmp_path):
    shutil.copytree(ran, tmp_path, dirs_exist_ok=True)
    files = {"levelset": tmp_path / "psi.nii.gz", "data": tmp_path / "data.nii.gz", "volume": tmp_path / "out.nii.gz"}
    return make_job({**files, "beta": 0.1, "iterations": 2})


def changed(job, **settings):
    return replace(job, settings=replace(job.settings, **settings))


def test_a_run_with_the_same_inputs_and_parameters_is_finished(job, tmp_path):
    assert finished(job) == record(tmp_path / "out.json")


def test_what_the_machine_gives_is_no_parameter(job):
    assert finished(changed(job, threads=1)) == finished(changed(job, threads=7)) == finished(job) is not None
    assert finished(replace(job, overwrite=True, memory=10**12)) is not None


@pytest.mark.parametrize(
    "other",
    [{"iterations": 3}, {"beta": "0.2"}, {"flow": "l2", "beta": "auto"}, {"seed": 1}, {"precision": "float64"}],
    ids=lambda other: next(iter(other)),
)
def test_another_parameter_is_another_run(job, other):
    assert finished(changed(job, **other)) is None


def test_another_output_is_another_run(job, tmp_path):
    assert finished(replace(job, mesh=())) is None
    assert finished(replace(job, mesh=(tmp_path / "out.ply",))) is None
    assert finished(replace(job, filled=tmp_path / "filled.nii.gz")) is None


def test_another_input_is_another_run(job):
    touched = job.data.read_bytes()
    job.data.write_bytes(touched)  # another time, the same content
    assert finished(job) is not None
    nifti(job.data, noisy(seed=1))
    assert finished(job) is None


def test_an_input_in_another_role_is_another_run(tmp_path):
    psi, data = nifti(tmp_path / "psi.nii.gz", ball()), nifti(tmp_path / "data.nii.gz", noisy())
    trust = nifti(tmp_path / "trust.nii.gz", np.ones((16, 16, 16), np.float32))
    given = {"levelset": psi, "data": data, "volume": tmp_path / "o.nii.gz", "beta": 0.1}
    done("denoise", psi, data, "-o", given["volume"], "--beta", 0.1, "--weights", trust, "-q")
    assert finished(make_job({**given, "weights": trust})) is not None
    assert finished(make_job({**given, "mask": trust})) is None


def test_a_missing_output_makes_it_unfinished(job, tmp_path):
    (tmp_path / "out.func.gii").unlink()
    assert finished(job) is None


def test_another_version_makes_it_unfinished(job, monkeypatch):
    monkeypatch.setattr(resume, "__version__", "0.0.1")
    assert finished(job) is None


def test_a_sidecar_that_is_none_makes_it_unfinished(job, tmp_path):
    sidecar = tmp_path / "out.json"
    whole = json.loads(sidecar.read_text())
    for text in ("", "[]", "{}", "null", sidecar.read_text()[:-30], json.dumps({**whole, "Outputs": []})):
        sidecar.write_text(text)
        assert finished(job) is None
    sidecar.unlink()
    assert finished(job) is None


def test_a_study_may_move(job, ran):
    assert job.volume.parent != ran
    assert record(job.volume.parent / "out.json")["Outputs"][0] == str(ran / "out.nii.gz")
    assert finished(job) is not None
    (job.volume.parent / "out.surf.gii").unlink()
    assert finished(job) is None


def run_in(folder, volume, mesh):
    """The job of such a study in the folder, done."""
    psi, data = nifti(folder / "psi.nii.gz", ball()), nifti(folder / "data.nii.gz", noisy())
    files = {"levelset": psi, "data": data, "volume": folder / volume, "mesh": (folder / mesh,)}
    done("denoise", psi, data, "-o", folder / volume, "--mesh", folder / mesh, "--iterations", 1, "--beta", 0.1, "-q")
    return make_job({**files, "beta": 0.1, "iterations": 1})


def test_outputs_behind_a_link_are_found_also_where_the_study_moved(tmp_path):
    study, disk = tmp_path / "study", tmp_path / "disk" / "big"
    for folder in (study / "mesh", disk):
        folder.mkdir(parents=True)
    (study / "out").symlink_to(disk)
    job = run_in(study, "out/o.nii.gz", "mesh/o.ply")
    assert finished(job) is not None

    moved = study.rename(tmp_path / "moved")
    there = {name: moved / getattr(job, name).relative_to(study) for name in ("levelset", "data", "volume")}
    job = replace(job, **there, mesh=(moved / "mesh" / "o.ply",))
    assert finished(job) is not None
    (moved / "mesh" / "o.ply").unlink()
    assert finished(job) is None


def test_up_from_a_link_is_up_from_where_it_leads(tmp_path):
    study, disk = tmp_path / "study", tmp_path / "disk"
    for folder in (study / "mesh", disk / "big", disk / "out"):
        folder.mkdir(parents=True)
    (study / "link").symlink_to(disk / "big")
    job = run_in(study, "link/../out/o.nii.gz", "mesh/../o.ply")
    written = record(disk / "out" / "o.json")
    assert written["Outputs"] == [str(disk / "out" / "o.nii.gz"), str(study / "o.ply"), str(disk / "out" / "o.json")]
    assert written["Request"]["mesh"] == ["../../study/o.ply"]
    assert finished(job) is not None
    # The same names without the link are other files.
    assert finished(replace(job, volume=study / "out" / "o.nii.gz")) is None


def test_places_on_two_drives(monkeypatch, job):
    def relpath(path, start):
        raise ValueError("path is on mount 'C:', start on mount 'D:'")

    monkeypatch.setattr("os.path.relpath", relpath)
    assert resume.request(job)["volume"] == job.volume.as_posix()
    assert resume.outputs_of({"Outputs": [str(job.volume), "/d/o.json"]}, job.volume) == [job.volume, Path("/d/o.json")]


def test_a_missing_input_is_told(job):
    job.data.unlink()
    with pytest.raises(RefusedError, match=r"data\.nii\.gz: no such file"):
        finished(job)


def test_looking_changes_nothing(job, tmp_path):
    before = contents(tmp_path)
    finished(job)
    assert contents(tmp_path) == before
