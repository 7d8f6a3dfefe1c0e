"""Options of the kinds of value, of missing data, of confidence and of choosing with the data: parsing and refusals."""

from __future__ import annotations

import math

import numpy as np
import pytest
from command import ball, beltrami, contents, done, nifti, noisy, refused, seen

from beltrami_cli import pipeline
from beltrami_cli.cli.denoise import summary
from beltrami_cli.config import Beta, Job, Settings

OPTIONS = (
    "--edge --kind --period --independent --weights --mask --missing --fill --filled --fidelity --depth --stop "
    "--noise-sigma --seed"
)
RECORD = {
    "Outputs": ["o.npy", "o.json"],
    "Removed": {"rms": 9.87654},
    "Seconds": {"flow": 1.25},
    "Iterations": 34,
    "StopReason": "auto",
    "Band": {"entries": 1, "voxels": 1, "half_width_mm": 4.0, "surface_vertices": 1, "filled_voxels": 0},
    "PerIteration": {"beta": []},
    "PeakMemoryMiB": 100.0,
}


class Caught(Exception):
    """Carries the job that the command would run."""


@pytest.fixture
def job_of(scene, monkeypatch):
    """The job that the options make, without a run of it."""

    def job(*options: object) -> Job:
        caught: list[Job] = []

        def catch(job: Job, **_: object) -> None:
            caught.append(job)
            raise Caught

        monkeypatch.setattr(pipeline, "run", catch)
        levelset, data, out = scene
        run = beltrami("denoise", levelset, data, "-o", out, *options)
        assert "Caught" in run.err, run.err
        return caught[0]

    return job


def test_help_names_the_options_under_headings():
    out = done("denoise", "--help").out
    assert [option for option in OPTIONS.split() if option not in out] == []
    headings = [line for line in out.splitlines() if line.endswith(":") and not line.startswith(" ")]
    assert headings == ["Files:", "Flow:", "How long:", "Values:", "Surface and band:", "Output and machine:"]
    words = set(out.replace("[", " ").replace("]", " ").replace("|", " ").split())
    assert {"auto", "scalar", "circular", "vector", "discrepancy", "decorrelation"} <= words
    assert "--period" in done("mesh", "--help").out


@pytest.mark.parametrize(
    "options, expected",
    [
        ("--flow auto --seed 3", Settings(flow="auto", seed=3)),
        ("--edge 8", Settings(edge=8.0)),
        ("--beta auto", Settings()),
        ("--beta 0.1:0.4", Settings(beta=Beta((0.1, 0.4), "linear"))),
        ("--kind circular --period 2pi", Settings(kind="circular", period=2 * math.pi)),
        ("--kind circular --period 360", Settings(kind="circular", period=360.0)),
        ("--kind vector --independent", Settings(kind="vector", independent=True)),
        ("--missing -1 --fill 0", Settings(missing=-1.0, fill=0.0)),
        ("--missing nan", Settings()),
        ("--fidelity 0.5", Settings(fidelity=0.5)),
        ("--depth=-2:2", Settings(depth=(-2.0, 2.0))),
        ("--depth -2:2", Settings(depth=(-2.0, 2.0))),
        ("--stop discrepancy --noise-sigma 10", Settings(stop="discrepancy", noise_sigma=10.0)),
        ("--stop decorrelation --flow l2", Settings(stop="decorrelation", flow="l2")),
    ],
)
def test_options_become_settings(job_of, options, expected):
    assert job_of(*options.split()).settings == expected


def test_files_become_inputs_and_outputs(job_of, scene, tmp_path):
    levelset, data, _ = scene
    names = [tmp_path / name for name in ("r2.nii.gz", "mask.nii.gz", "filled.nii.gz")]
    job = job_of("--weights", names[0], "--mask", names[1], "--filled", names[2])
    assert job.all_inputs == [levelset, data, *names[:2]]
    assert job.filled == names[2]


def test_command_line_displaces_what_a_config_says(job_of, tmp_path):
    config = tmp_path / "run.toml"
    config.write_text(
        "[flow]\nedge = 5\n[time]\nstop = 'discrepancy'\nnoise_sigma = 3\n"
        "[values]\nkind = 'circular'\nperiod = 360\n[band]\ndepth = '-1:1'",
        encoding="utf-8",
    )
    assert job_of("--config", config).settings.noise_sigma == 3
    settings = job_of("--config", config, "--beta", "0.1", "--fwhm", "3", "--kind", "scalar", "--depth=0:1").settings
    assert settings == Settings(beta=0.1, fwhm=3.0, depth=(0.0, 1.0))


@pytest.mark.parametrize(
    "options, words",
    [
        ("--edge 0", ["edge", "above 0"]),
        ("--edge 5 --beta 0.1", ["beta and edge"]),
        ("--edge 5 --flow tv", ["edge", "eps"]),
        ("--edge 5 --flow l2", ["edge", "l2"]),
        ("--flow auto --beta 0.1", ["beta", "auto"]),
        ("--flow auto --eps 1", ["eps", "auto"]),
        ("--kind polar", ["'polar'", "circular"]),
        ("--kind circular", ["period", "--period 360"]),
        ("--period 360", ["period", "--kind circular"]),
        ("--kind circular --period turn", ["period", "'turn'", "2pi"]),
        ("--independent", ["independent", "--kind vector"]),
        ("--missing none", ["--missing", "'none'"]),
        ("--missing inf", ["missing", "inf"]),
        ("--fill -1", ["fill", "-1"]),
        ("--fidelity -1", ["fidelity", "-1"]),
        ("--depth 2", ["depth", "'2'", "A:B"]),
        ("--depth=2:-2", ["depth", "'2:-2'"]),
        ("--depth=-2:2 --extension pde", ["depth", "closest-point", "pde"]),
        ("--depth=-3:2 --band 2.5", ["band", "2.5 mm", "3 mm", "-3:2"]),
        ("--stop never", ["--stop", "'never'"]),
        ("--stop auto --iterations 5", ["iterations and stop"]),
        ("--stop auto --beta 0.1:0.4", ["beta", "schedule"]),
        ("--stop decorrelation", ["decorrelation", "beltrami"]),
        ("--stop decorrelation --flow tv --fidelity 1", ["decorrelation", "--fidelity"]),
        ("--noise-sigma 3", ["noise_sigma", "--stop discrepancy"]),
        ("--stop discrepancy --noise-sigma 0", ["noise_sigma", "above 0"]),
        ("--seed -1", ["seed", "-1"]),
    ],
)
def test_refused_before_starting(scene, tmp_path, options, words):
    levelset, data, out = scene
    before = contents(tmp_path)
    message = refused("denoise", levelset, data, "-o", out, *options.split())
    assert [word for word in words if word not in message] == []
    assert contents(tmp_path) == before


def test_flat_has_no_depth(scene):
    _, data, out = scene
    assert "flat" in refused("denoise", "--flat", data, "-o", out, "--depth=-1:1")


@pytest.mark.parametrize(
    "options, words", [(["--period", "turn"], ["period", "'turn'"]), (["--period", "-1"], ["period", "'-1'"])]
)
def test_mesh_refuses_a_period_that_makes_no_sense(scene, tmp_path, options, words):
    levelset, data, _ = scene
    before = contents(tmp_path)
    message = refused("mesh", levelset, data, "-o", tmp_path / "m.ply", *options)
    assert [word for word in words if word not in message] == []
    assert "LEVELSET alone" in refused("mesh", levelset, "-o", tmp_path / "m.ply", "--period", "360")
    assert contents(tmp_path) == before


@pytest.mark.parametrize("given, expected", [([], None), (["--period", "2pi"], 2 * math.pi)])
def test_mesh_passes_its_period_on(scene, tmp_path, monkeypatch, given, expected):
    periods: list[float | None] = []

    def catch(*_: object, period: float | None, **__: object) -> None:
        periods.append(period)
        raise Caught

    monkeypatch.setattr(pipeline, "mesh_of", catch)
    beltrami("mesh", *scene[:2], "-o", tmp_path / "m.ply", *given)
    assert periods == [expected]


# What is said


def test_summary_of_a_record_without_estimates():
    assert summary(RECORD) == ["wrote o.npy, o.json", "noise removed 9.877 rms, 34 iterations, stopped by auto, 1.2 s"]


@pytest.mark.parametrize(
    "sd, told",
    [
        ([10.123456], "rms of 10.12 estimated, "),
        ([1.0, 2.0], "rms of 1 and 2 estimated, "),
        ([1.0, 4.0, 2.0, 3.0], "rms of 1 to 4 estimated, "),
        ([None], "rms, "),
        (None, "rms, "),
    ],
)
def test_summary_tells_the_noise(sd, told):
    assert f"noise removed 9.877 {told}" in summary({**RECORD, "Noise": {"sd": sd}})[1]


@pytest.mark.parametrize(
    "before, after, told",
    [
        (1.234, 5.678, "smoothness 1.23 to 5.68 mm FWHM, 34"),
        (None, 5.678, "smoothness 5.68 mm FWHM, 34"),
        (1.2, None, None),
    ],
)
def test_summary_tells_the_smoothness(before, after, told):
    line = summary({**RECORD, "Smoothness": {"before_mm": before, "after_mm": after}})[1]
    assert told in line if told else "smoothness" not in line


def test_summary_tells_the_choice():
    chosen = {"flow": "beltrami", "beta": 0.12345, "iterations": 34}
    assert summary({**RECORD, "Choice": chosen})[2] == "chosen by held-out data: beltrami, beta 0.1235, 34 iterations"
    assert len(summary({**RECORD, "Choice": None})) == 2


def test_verbose_prints_the_table_of_the_choice(scene, monkeypatch):
    table = [
        {"flow": "l2", "phi": None, "beta": None, "iterations": 7, "error": 12.345678},
        {"flow": "phi", "phi": "perona-malik", "beta": 0.5, "iterations": 9, "error": 11.0},
    ]
    record = {**RECORD, "Choice": {**table[1], "table": table}}
    monkeypatch.setattr(pipeline, "run", lambda *_, **__: pipeline.Result(np.zeros(1), None, np.zeros(1), record, ()))
    levelset, data, out = scene
    run = beltrami("denoise", levelset, data, "-o", out, "-v")
    assert run.code == 0, run.err
    assert "held out: l2, 7 iterations: error 12.346\n" in run.err
    assert "held out: perona-malik, beta 0.5, 9 iterations: error 11\n" in run.err
    assert run.out.splitlines()[2] == "chosen by held-out data: perona-malik, beta 0.5, 9 iterations"


def test_what_the_mask_excludes_is_not_mixed_in_by_resampling(tmp_path):
    moved = np.eye(4)
    moved[:3, 3] = 0.6
    counts = np.abs(ball()) < 3
    levelset = nifti(tmp_path / "psi.nii.gz", ball())
    data = nifti(tmp_path / "data.nii.gz", np.where(counts, noisy(), 1e5).astype(np.float32), moved)
    mask = nifti(tmp_path / "mask.nii.gz", np.where(counts, -3, 0).astype(np.float32), moved)
    out = tmp_path / "out.nii.gz"
    done("denoise", levelset, data, "-o", out, "--mask", mask, "--resample", "--beta", "0.05")
    assert seen(out).max() < 100


def test_angles_of_several_channels_make_no_mesh(scene, tmp_path):
    levelset, _, _ = scene
    data = nifti(tmp_path / "four.nii.gz", np.stack([noisy(), noisy()], -1))
    assert "one number per voxel" in refused("mesh", levelset, data, "-o", tmp_path / "m.ply", "--period", "360")
