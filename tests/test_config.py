"""Settings, TOML files and what the command line overrides."""

from __future__ import annotations

import math
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from command import ball, beltrami, contents, done, nifti, noisy, record, refused

from beltrami_cli.config import (
    Beta,
    Job,
    Settings,
    fields_of,
    make_job,
    overlaid,
    parse_beta,
    parse_depth,
    parse_memory,
    parse_period,
    parse_spacing,
    read_config,
    read_tables,
)
from beltrami_cli.errors import RefusedError

FILES = """
[input]
levelset = "volumes/psi.nii.gz"
data = "volumes/data.nii.gz"
"""
OUTPUT = """
[output]
volume = "out.nii.gz"
"""


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    (tmp_path / "volumes").mkdir()
    nifti(tmp_path / "volumes" / "psi.nii.gz", ball())
    nifti(tmp_path / "volumes" / "data.nii.gz", noisy())
    return tmp_path


def config(folder: Path, *sections: str) -> Path:
    path = folder / "run.toml"
    path.write_text("\n".join(sections), encoding="utf-8")
    return path


# Beta


@pytest.mark.parametrize(
    "given, expected",
    [
        (0.5, [0.5] * 6),
        (0, [0] * 6),
        ("0.5", [0.5] * 6),
        (" 5e-1 ", [0.5] * 6),
        ("1:6", [1, 2, 3, 4, 5, 6]),
        ("6:1:linear", [6, 5, 4, 3, 2, 1]),
        ("1:32:geometric", [1, 2, 4, 8, 16, 32]),
        ("1,2,3", [1, 1, 2, 2, 3, 3]),
        ([1, 2.5], [1, 1, 1, 2.5, 2.5, 2.5]),
        ("1,2,3,4", [1, 1, 2, 3, 3, 4]),
        ({"start": 1, "stop": 6}, [1, 2, 3, 4, 5, 6]),
        ({"start": 1, "stop": 32, "law": "geometric"}, [1, 2, 4, 8, 16, 32]),
    ],
)
def test_beta_over_six_iterations(given, expected):
    beta = parse_beta(given)
    assert beta.over(6) == pytest.approx(expected)
    assert parse_beta(str(beta)).over(6) == pytest.approx(expected)
    assert len(beta.over(0)) == 0


def test_auto_beta():
    assert parse_beta("auto") == Beta() == Settings().beta
    assert parse_beta("auto").is_auto
    assert str(Beta()) == "auto"


@pytest.mark.parametrize(
    "given",
    [
        *["", "x", "1:", ":1", "1:2:3", "1:2:linear:2", "1;2", ",", "-1", "nan", "inf", "1,-2", "0:1:geometric"],
        *[None, True, object, [], ["x"], [1, False]],
        *[{}, {"start": 1}, {"start": True, "stop": 2}, {"start": 1, "stop": 2, "step": 1}],
    ],
    ids=str,
)
def test_beta_that_makes_no_sense(given):
    with pytest.raises(RefusedError, match="beta"):
        parse_beta(given)


# Settings


@pytest.mark.parametrize(
    "options",
    [
        {"iterations": 2.5},
        {"iterations": True},
        {"iterations": -1},
        {"iterations": "3"},
        {"extend_every": 1.5},
        {"threads": 0},
        {"threads": False},
        {"time": True},
        {"time": -1.0},
        {"time": float("inf")},
        {"fwhm": "2"},
        {"dt": 0.0},
        {"band": -1},
        {"eps": 0.0, "flow": "l1"},
        {"flow": "heat"},
        {"flow": None},
        {"phi": "huber"},
        {"scheme": "upwind"},
        {"extension": ["none"]},
        {"inside": 1},
        {"outside": "blank"},
        {"precision": 32},
        {"iterations": 3, "time": 1.0},
        {"flow": "l2", "beta": 0.1},
        {"flow": "tv", "beta": 0.1},
        {"eps": 1.0},
        {"phi": "weickert"},
        {"flat": True, "band": 4.0},
        {"edge": 0.0},
        {"edge": float("nan")},
        {"edge": 10.0, "beta": 0.2},
        {"edge": 10.0, "flow": "l2"},
        {"edge": 10.0, "flow": "tv"},
        {"edge": 10.0, "flow": "auto"},
        {"beta": 0.1, "flow": "auto"},
        {"eps": 1.0, "flow": "auto"},
        {"phi": "weickert", "flow": "auto"},
        {"fidelity": -1.0},
        {"fidelity": True},
        {"kind": "angle"},
        {"kind": None},
        {"period": 360},
        {"period": 360, "kind": "vector"},
        {"period": -1, "kind": "circular"},
        {"independent": True},
        {"independent": True, "kind": "circular", "period": 360},
        {"independent": "yes", "kind": "vector"},
        {"independent": 1, "kind": "vector"},
        {"missing": "none"},
        {"missing": float("inf")},
        {"missing": True},
        {"fill": -1.0},
        {"fill": "2"},
        {"depth": (2.0, -2.0)},
        {"depth": 2.0},
        {"depth": (-1.0, 1.0), "flat": True},
        {"depth": (-1.0, 1.0), "extension": "pde"},
        {"depth": (-1.0, 1.0), "extension": "none"},
        {"stop": "soon"},
        {"iterations": 3, "stop": "auto"},
        {"fwhm": 3.0, "stop": "discrepancy"},
        {"stop": "decorrelation"},
        {"stop": "decorrelation", "flow": "l1"},
        {"stop": "decorrelation", "flow": "auto"},
        {"stop": "decorrelation", "flow": "l2", "fidelity": 0.1},
        {"beta": "0.1:0.4", "stop": "auto"},
        {"beta": "0.1,0.4", "stop": "discrepancy"},
        {"noise_sigma": 3.0},
        {"noise_sigma": 3.0, "stop": "auto"},
        {"noise_sigma": 0.0, "stop": "discrepancy"},
        {"seed": -1},
        {"seed": None},
        {"seed": 1.5},
        {"seed": True},
    ],
    ids=str,
)
def test_settings_that_make_no_sense(options):
    with pytest.raises(RefusedError) as refusal:
        Settings(**options)
    assert "\n" not in str(refusal.value)
    assert next(iter(options)) in str(refusal.value)


def test_defaults_are_the_designs():
    settings = Settings()
    assert (settings.flow, settings.scheme, settings.extension) == ("beltrami", "symmetric", "closest-point")
    assert (settings.outside, settings.inside, settings.precision) == ("nan", "negative", "float32")
    assert settings.reextends_every == 5
    assert settings.half_width(np.array([0.8, 0.8, 1.5])) == 6.0
    assert settings.duration(0.15) == (20, 0.15, "iterations")
    assert (settings.kind, settings.independent, settings.seed) == ("scalar", False, 0)
    free = (settings.depth, settings.fill, settings.fidelity, settings.stop, settings.missing, settings.edge)
    assert free == (None,) * 6
    assert Settings(extension="none").reextends_every == 0
    assert Settings(extension="none", extend_every=3).reextends_every == 3


def test_edge_is_the_twin_of_beta():
    settings = Settings(edge=8.0)
    assert settings.beta == Beta((0.125,)) == Settings(beta=0.125).beta
    assert (asdict(settings)["edge"], asdict(settings)["beta"]["values"]) == (8.0, (0.125,))
    assert replace(settings, iterations=3).beta.over(3) == pytest.approx([0.125] * 3)
    assert Settings(flow="phi", edge=4).beta == Beta((0.25,))


@pytest.mark.parametrize(
    "options, words",
    [
        ({"edge": 8.0, "beta": 0.2}, ["beta and edge", "give one"]),
        ({"edge": 8.0, "flow": "l1"}, ["edge", "l1", "eps"]),
        ({"edge": 8.0, "flow": "l2"}, ["edge", "l2", "--flow beltrami"]),
        ({"flow": "auto", "eps": 1.0}, ["eps", "auto", "name the flow"]),
        ({"kind": "circular"}, ["period", "missing", "--period 360"]),
        ({"period": "2pi"}, ["period", "scalar", "--kind circular"]),
        ({"independent": True}, ["independent", "scalar", "--kind vector"]),
        ({"stop": "decorrelation"}, ["decorrelation", "beltrami", "l2, tv and phi"]),
        ({"stop": "decorrelation", "flow": "tv", "fidelity": 1.0}, ["decorrelation", "--fidelity"]),
        ({"stop": "auto", "time": 1.0}, ["time and stop", "give one"]),
        ({"stop": "auto", "beta": "1:2:geometric"}, ["1.0:2.0:geometric", "auto", "--iterations"]),
        ({"noise_sigma": 1.0}, ["noise_sigma", "none", "--stop discrepancy"]),
        ({"depth": "-1:1", "flat": True}, ["depth", "flat"]),
        ({"depth": "-1:1", "extension": "pde"}, ["depth", "closest-point", "pde"]),
    ],
    ids=str,
)
def test_refusals_say_what_to_do(options, words):
    with pytest.raises(RefusedError) as refusal:
        Settings(**options)
    assert [word for word in words if word not in str(refusal.value)] == []


@pytest.mark.parametrize(
    "options",
    [
        {"flow": "auto"},
        {"flow": "auto", "stop": "auto", "kind": "circular", "period": 360.0},
        {"flow": "auto", "iterations": 10},
        {"flow": "l1", "stop": "auto"},
        {"flow": "tv", "stop": "decorrelation", "eps": 2.0},
        {"flow": "phi", "stop": "decorrelation", "beta": 0.1, "fidelity": 0.0},
        {"stop": "discrepancy", "noise_sigma": 10},
        {"stop": "discrepancy", "edge": 10.0, "fidelity": 0.5},
        {"beta": "0.1:0.4:geometric", "fwhm": 3.0},
        {"kind": "vector", "independent": True, "missing": -1},
        {"flat": True, "fill": 2.0, "fidelity": 0.1, "stop": "auto", "kind": "vector"},
        {"depth": [-2, 2], "fill": 0, "seed": 7},
        {"depth": (0.5, 0.5), "band": 3.0},
    ],
    ids=str,
)
def test_settings_make_themselves_again(options):
    settings = Settings(**options)
    assert Settings(**{f.name: getattr(settings, f.name) for f in fields(settings)}) == settings
    assert replace(settings) == settings


def test_missing_nan_is_what_nan_always_is():
    assert Settings(missing=math.nan) == Settings()
    assert Settings(missing=-999).missing == -999


@pytest.mark.parametrize(
    "given, expected",
    [(360, 360.0), ("360", 360.0), ("24", 24.0), (" 1e2 ", 100.0), ("2pi", 2 * math.pi), ("pi", math.pi),
     ("0.5 pi", math.pi / 2), (6.5, 6.5)],
)  # fmt: skip
def test_period(given, expected):
    assert parse_period(given) == expected == Settings(kind="circular", period=given).period


@pytest.mark.parametrize(
    "given", ["", "x", "0", "-1", "nan", "inf", "-2pi", "2pix", "nanpi", "1,2", [], [1, 2], True, None, {}], ids=str
)
def test_period_that_makes_no_sense(given):
    with pytest.raises(RefusedError, match="period"):
        parse_period(given)


@pytest.mark.parametrize(
    "given, expected",
    [
        ("-2:2", (-2.0, 2.0)),
        ("0:1.5", (0.0, 1.5)),
        ([-1, 3], (-1.0, 3.0)),
        ((-3.0, -1.0), (-3.0, -1.0)),
        ("1:1", (1, 1)),
    ],
)
def test_depth(given, expected):
    assert parse_depth(given) == expected == Settings(depth=given).depth


@pytest.mark.parametrize(
    "given", ["", "2", ":", "1:", "2:1", "1:2:3", "nan:1", "-inf:1", "a:b", 2, [1], [1, 2, 3], [True, 2], {}], ids=str
)
def test_depth_that_makes_no_sense(given):
    with pytest.raises(RefusedError, match="depth"):
        parse_depth(given)


@pytest.mark.parametrize(
    "options, expected",
    [
        ({"depth": (-1.0, 1.0)}, 6.0),  # four voxels hold it
        ({"depth": (-4.0, 5.0)}, 7.25),  # the farther end, and 1.5 voxels
        ({"depth": (-8.0, -2.0)}, 10.25),
        ({"depth": (-4.0, 5.0), "band": 5.0}, 5.0),
        ({"band": 2.25}, 2.25),
    ],
)
def test_band_holds_the_depth(options, expected):
    assert Settings(**options).half_width(np.array([0.8, 0.8, 1.5])) == expected


def test_band_that_is_too_thin():
    with pytest.raises(RefusedError, match=r"band: .* 4\.9 mm; expected at least 5 mm to hold the depth -4:5"):
        Settings(depth=(-4.0, 5.0), band=4.9).half_width(np.array([1.0]))
    with pytest.raises(RefusedError, match=r"band: .* at least 1\.5 voxels"):
        Settings(band=1.4).half_width(np.array([1.0]))


@pytest.mark.parametrize("stop", ["auto", "discrepancy", "decorrelation"])
def test_where_the_data_end_the_run(stop):
    ends_by = "iterations" if stop == "discrepancy" else stop  # the rule itself says so where it stops a run
    assert Settings(stop=stop, flow="l2").duration(0.15) == (1000, 0.15, ends_by)
    assert math.sqrt(16 * math.log(2) * 1000 * 0.15) == pytest.approx(40.8, abs=0.1)  # FWHM in voxels, as it says


@pytest.mark.parametrize("total, iterations", [(0.0, 0), (0.15, 1), (0.1500001, 2), (1.5, 10), (0.01, 1)])
def test_a_given_time_is_met_exactly(total, iterations):
    count, dt, reason = Settings(time=total).duration(0.15)
    assert (count, reason) == (iterations, "time")
    assert dt <= 0.15 * (1 + 1e-9)
    assert count * dt == pytest.approx(total)


@pytest.mark.parametrize(
    "given, expected",
    [
        *[("8G", 8 * 10**9), ("8GB", 8 * 10**9), ("8GiB", 8 * 2**30), ("8Gi", 8 * 2**30), ("500M", 5 * 10**8)],
        *[("1.5 GB", 15 * 10**8), (" .5kib ", 512), ("2 t", 2 * 10**12), ("1TiB", 2**40), ("0.1K", 100)],
        *[(4096, 4096), (np.int64(7), 7), ("4096", 4096), ("4096B", 4096), ("1.25M", 1_250_000), ("9.K", 9000)],
    ],
)
def test_memory(given, expected):
    assert parse_memory(given) == expected
    job = Job(Path("d.npy"), Path("o.npy"), Path("p.npy"), memory=given)
    assert (job.memory, type(job.memory)) == (expected, int)


@pytest.mark.parametrize(
    "given",
    [
        *["", "G", "8X", "8iB", "-8G", "0", "0G", "0.0001K", "1e9", "8 G B", "8GG", "nan", "inf", "1.2.3G", "٣G"],
        *[0, -1, 1.5, True, None, [8], {}, math.nan],
    ],
    ids=str,
)
def test_memory_that_makes_no_sense(given):
    with pytest.raises(RefusedError, match=r"memory: found .*; expected an amount above 0: 8G, 500M"):
        parse_memory(given)


def test_spacing():
    assert parse_spacing("2") == (2.0,)
    assert parse_spacing("1,2,3") == parse_spacing([1, 2, 3]) == (1.0, 2.0, 3.0)
    for wrong in ("", "x", "0", "-1", "nan", "1,2,3,4", [], True, None):
        with pytest.raises(RefusedError, match="spacing"):
            parse_spacing(wrong)


# Files


def test_config_alone(folder):
    path = config(folder, FILES, OUTPUT, "[flow]\nbeta = 0.1", "[time]\niterations = 3", "[band]\nhalf_width = 3")
    done("denoise", "--config", path)
    used = record(folder / "out.json")
    assert (used["Parameters"]["beta"], used["Parameters"]["band"], used["Iterations"]) == (0.1, 3.0, 3)
    assert (folder / "out.surf.gii").exists()


def test_paths_are_relative_to_the_file_and_the_command_lines_to_where_it_runs(folder, monkeypatch):
    elsewhere = folder / "elsewhere"
    elsewhere.mkdir()
    monkeypatch.chdir(elsewhere)
    done("denoise", "--config", config(folder, FILES, OUTPUT), "--mesh", "here.ply")
    assert set(contents(elsewhere)) == {"here.ply"}
    assert (folder / "out.nii.gz").exists()
    done("denoise", "--config", folder / "run.toml", "-o", "o.npy")
    assert set(contents(elsewhere)) == {"here.ply", "o.npy", "o.ply", "o.json"}


def test_command_line_wins(folder):
    path = config(folder, FILES, OUTPUT, "[flow]\nbeta = 0.1\nscheme = 'paper'", "[time]\niterations = 3")
    done("denoise", "--config", path, "--time", "0.3", "--beta", "0.2:0.4", "--no-mesh", "--outside", "zero")
    used = record(folder / "out.json")
    assert used["PerIteration"]["beta"] == pytest.approx([0.2, 0.4])
    assert used["StopReason"] == "time"
    assert (used["Parameters"]["scheme"], used["Parameters"]["outside"]) == ("paper", "zero")
    assert not (folder / "out.surf.gii").exists()
    other = nifti(folder / "other.nii.gz", noisy(seed=1))
    done("denoise", other, "--config", path, "--overwrite")
    assert record(folder / "out.json")["Sources"][1]["Path"] == str(other)


@pytest.mark.parametrize(
    "text, files",
    [
        ("mesh = false", set()),
        ("mesh = []", set()),
        ('mesh = "m.ply"', {"m.ply"}),
        ('mesh = ["m.ply", "n.surf.gii"]', {"m.ply", "n.surf.gii", "n.func.gii"}),
    ],
)
def test_meshes_of_a_config(folder, text, files):
    before = set(contents(folder))
    done("denoise", "--config", config(folder, FILES, OUTPUT, text))
    assert set(contents(folder)) == {*before, *files, "run.toml", "out.nii.gz", "out.json"}


def test_every_key_is_read(folder):
    path = config(
        folder,
        '[input]\nlevelset = "a.npy"\ndata = "b.npy"\nspacing = [1, 2, 3]\nresample = true\ninside = "positive"',
        '[output]\nvolume = "o.npy"\nmesh = "m.ply"\noutside = "keep"\noverwrite = true\nprecision = "float64"',
        '[flow]\nname = "phi"\nphi = "weickert"\nscheme = "paper"\ndt = 0.05',
        'beta = {start = 0.1, stop = 0.4, law = "geometric"}',
        "[time]\nfwhm = 2.5",
        '[band]\nhalf_width = 9\nextension = "pde"\nextend_every = 2',
        "[run]\nthreads = 1",
        "[values]\nkind = 'vector'\nindependent = true",
    )
    job = make_job(read_config(path))
    assert (job.levelset, job.data, job.volume) == (folder / "a.npy", folder / "b.npy", folder / "o.npy")
    assert (job.spacing, job.resample, job.overwrite, job.mesh) == ((1.0, 2.0, 3.0), True, True, (folder / "m.ply",))
    assert job.settings == Settings(
        flow="phi", phi="weickert", beta=Beta((0.1, 0.4), "geometric"), scheme="paper", dt=0.05, fwhm=2.5, band=9,
        extension="pde", extend_every=2, inside="positive", outside="keep", precision="float64", threads=1,
        kind="vector", independent=True,
    )  # fmt: skip


def test_every_key_of_values_is_read(folder):
    path = config(
        folder,
        FILES + 'weights = "r2.mgz"\nmask = "../mask.npy"\nmissing = -1\nfill = 6',
        OUTPUT + 'filled = "filled.nii.gz"',
        '[flow]\nname = "phi"\nedge = 10\nfidelity = 0.25',
        '[time]\nstop = "discrepancy"\nnoise_sigma = 12.5\nseed = 3',
        "[band]\ndepth = [-2, 2]",
        '[values]\nkind = "circular"\nperiod = "2pi"',
    )
    job = make_job(read_config(path))
    assert (job.weights, job.mask) == (folder / "r2.mgz", folder / "../mask.npy")
    assert job.filled == folder / "filled.nii.gz"
    assert job.inputs == [folder / "volumes/psi.nii.gz", folder / "volumes/data.nii.gz"]
    assert job.all_inputs == [*job.inputs, job.weights, job.mask]
    assert job.settings == Settings(
        flow="phi", beta=0.1, edge=10, fidelity=0.25, stop="discrepancy", noise_sigma=12.5, seed=3,
        depth=(-2.0, 2.0), kind="circular", period=2 * math.pi, missing=-1, fill=6,
    )  # fmt: skip
    text = path.read_text().replace("[-2, 2]", '"-2:2"').replace('"2pi"', str(2 * math.pi))
    path.write_text(text, encoding="utf-8")
    assert make_job(read_config(path)) == job


def test_missing_nan_and_auto_of_a_config(folder):
    path = config(
        folder, FILES + "missing = nan", OUTPUT, "[flow]\nname = 'auto'\nbeta = 'auto'", "[time]\nstop = 'auto'"
    )
    assert make_job(read_config(path)).settings == Settings(flow="auto", stop="auto")


def test_inputs_without_weights_and_mask():
    assert Job(Path("d.npy"), Path("o.npy"), Path("p.npy")).all_inputs == [Path("p.npy"), Path("d.npy")]
    flat = Job(Path("d.npy"), Path("o.npy"), mask=Path("m.npy"), settings=Settings(flat=True))
    assert flat.all_inputs == [Path("d.npy"), Path("m.npy")]


@pytest.mark.parametrize(
    "text, words",
    [
        ("[flow]\nbetta = 1", ["'betta'", "[flow]", "'beta'"]),
        ("[flwo]\nbeta = 1", ["[flwo]", "'flow'"]),
        ("[band]\nextend-every = 1", ["'extend-every'", "'extend_every'"]),
        ("[band]\nzzz = 1", ["'zzz'", "half_width, extension, extend_every, depth"]),
        ("[other]\nx = 1", ["[other]", "input, output, flow, time, band, values, run"]),
        ("[[flow]]\nbeta = 1", ["'flow'", "section [flow]"]),
        ("[for_each]\nsubject = ['01']", ["[for_each]", "one run", "beltrami batch", "run.toml"]),
        ("[foreach]\nsubject = ['01']", ["[foreach]", "'for_each'"]),
        ("[run]\nmemory = '8 apples'", ["memory", "'8 apples'", "8G"]),
        ("[run]\nmemory = -1", ["memory", "-1"]),
        ("[flow]\nbeta = 'x'", ["beta", "'x'"]),
        ("[flow]\nbeta = true", ["beta", "True"]),
        ("[flow]\nname = 3", ["flow", "3"]),
        ("[flow]\ndt = 'fast'", ["dt", "'fast'"]),
        ("[flow]\ndt = 1.0", ["dt", "0.166667"]),
        ("[time]\niterations = 2.5", ["iterations", "2.5"]),
        ("[time]\niterations = true", ["iterations", "True"]),
        ("[time]\niterations = 3\ntime = 1", ["iterations and time"]),
        ("[run]\nthreads = 0", ["threads", "0"]),
        ("[band]\nhalf_width = '3 mm'", ["band", "'3 mm'"]),
        ("[band]\nhalf_width = 1", ["band", "1.5"]),
        ("[flow]\nflat = 'yes'", ["flat", "true or false"]),
        ("[flow]\nflat = true", ["LEVELSET is omitted"]),
        ("[values]\nkind = 'polar'", ["kind", "'polar'", "scalar, circular, vector"]),
        ("[values]\nkinds = 'vector'", ["'kinds'", "'kind'"]),
        ("[values]\nkind = 'circular'", ["period", "--period 360"]),
        ("[values]\nkind = 'circular'\nperiod = true", ["period", "True"]),
        ("[values]\nkind = 'circular'\nperiod = [1, 2]", ["period", "[1, 2]"]),
        ("[values]\nkind = 'vector'\nindependent = 'yes'", ["independent", "true or false"]),
        ("[band]\ndepth = 2", ["depth", "A:B"]),
        ("[band]\ndepth = '2:-2'", ["depth", "'2:-2'"]),
        ("[band]\ndepth = [-2, 2]\nhalf_width = 1.75", ["band", "1.75", "-2:2"]),
        ("[time]\nstop = 'auto'\nfwhm = 3", ["fwhm and stop"]),
        ("[time]\nseed = 1.5", ["seed", "1.5"]),
        ("[flow]\nedge = 'steep'", ["edge", "'steep'"]),
        ("[flow]\nedge = 5\nbeta = 0.1", ["beta and edge"]),
        ("[flow]\nname = 'auto'\nbeta = 0.1", ["beta", "auto"]),
        ("flow 3", ["not a valid TOML"]),
        ("[input.more]\nx = 1", ["'more'", "[input]"]),
    ],
)
def test_config_that_cannot_be(folder, text, words):
    path = config(folder, FILES, OUTPUT, text)
    before = contents(folder)
    message = refused("denoise", "--config", path)
    assert [word for word in words if word not in message] == []
    assert contents(folder) == before


@pytest.mark.parametrize(
    "line, words",
    [
        ("frame = 'foo'", "frame: found 'foo'; expected scanner or tkr"),
        ("frame = 1", "frame: found 1; expected scanner or tkr"),
        ("map = true", "map: found True; expected a text or a whole number"),
        ("map = ['ecc']", "map: found ['ecc']; expected a text"),
        ("labels = [2.5]", "labels: found 2.5; expected a text"),
        ("between = [[1], 2]", "between: found [1]; expected a text"),
    ],
)
def test_input_section_that_cannot_be(folder, line, words):
    path = config(folder, FILES + line, OUTPUT)
    assert f"{path}: [input] {words}" in refused("denoise", "--config", path)


def test_blanks_around_the_sign_of_on(folder):
    path = config(folder, FILES, OUTPUT, "on = 'a.surf.gii = b.func.gii'")
    assert make_job(read_config(path)).on == ((folder / "a.surf.gii", folder / "b.func.gii"),)


@pytest.mark.parametrize(
    "text, word",
    [
        ("volume = 3", "name of a file"),
        ("volume = ''", "name of a file"),
        ("volume = 'o.npy'\nmesh = 3", "name of a file"),
        ("volume = 'o.npy'\nmesh = true", "name of a file"),
        ("volume = 'o.npy'\nmesh = ['m.ply', 3]", "name of a file"),
        ("volume = 'o.npy'\nfilled = true", "name of a file"),
        ("volume = 'o.npy'\noverwrite = 1", "true or false"),
        ("volume = 'o.npy'\nstructure = 4", "[output] structure: found 4; expected a name, as CortexLeft"),
        ("volume = 'o.npy'\noutside = ['nan']", "outside"),
        ("mesh = false", "OUT"),
    ],
)
def test_output_section_that_cannot_be(folder, text, word):
    assert word in refused("denoise", "--config", config(folder, FILES, "[output]", text))


def test_memory_of_a_config_and_of_the_command_line(folder):
    path = config(folder, FILES, OUTPUT, "[time]\niterations = 1", "[run]\nmemory = '64GiB'")
    assert make_job(read_config(path)).memory == 2**36
    done("denoise", "--config", path, "--no-mesh")
    assert "memory" not in record(folder / "out.json")["Parameters"]
    assert "memory: found 'much'" in refused("denoise", "--config", path, "--memory", "much", "--overwrite")


@pytest.mark.parametrize(
    "line, words",
    [
        ('data = "a\\u0000b.npy"', "[input] data: found 'a\\x00b.npy'; expected the name of a file"),
        ('data = "d.npy"\n[output]\nvolume = "o.npy"\non = "s.ply=a\\u0000b.func.gii"', "on: found 's.ply=a\\x00b"),
    ],
)
def test_no_name_of_a_file(folder, line, words):
    assert words in refused("denoise", "--config", config(folder, "[input]", line))


def test_fields_of_tables_that_were_read_before(folder):
    path = config(folder, FILES, OUTPUT, "[for_each]\nn = [1]")
    tables = read_tables(path)
    assert tables.pop("for_each") == {"n": [1]}
    assert fields_of(path, tables)["data"] == folder / "volumes/data.nii.gz"


def test_unreadable_config(folder):
    assert "cannot be read" in refused("denoise", "--config", folder / "nothing.toml")
    assert "cannot be read" in refused("denoise", "--config", folder)
    (folder / "binary.toml").write_bytes(b"\xff\xfe\0")
    assert "not a valid TOML" in refused("denoise", "--config", folder / "binary.toml")


def test_config_names_its_file_where_a_section_is_wrong(folder):
    path = config(folder, FILES, OUTPUT, "[flow]\nbetta = 1")
    assert str(path) in refused("denoise", "--config", path)


@pytest.mark.parametrize(
    "base, over, expected",
    [
        ({"iterations": 3}, {"time": 1.0}, {"time": 1.0}),
        ({"fwhm": 3}, {"iterations": 5}, {"iterations": 5}),
        ({"fwhm": 3, "beta": 1}, {"beta": 2}, {"fwhm": 3, "beta": 2}),
        ({"iterations": 3}, {}, {"iterations": 3}),
    ],
)
def test_overlaid(base: dict[str, Any], over: dict[str, Any], expected: dict[str, Any]):
    assert overlaid(base, over) == expected


def test_flat_config(folder):
    path = config(folder, '[input]\ndata = "volumes/data.nii.gz"', OUTPUT, "[flow]\nflat = true")
    assert beltrami("denoise", "--config", path, "-q").code == 0
    assert record(folder / "out.json")["Parameters"]["flat"] is True


@pytest.mark.parametrize(
    ("base", "over", "expected"),
    [
        ({"beta": 0.1}, {"flow": "l2"}, {"flow": "l2"}),
        ({"flow": "l1", "eps": 2}, {"flow": "tv"}, {"flow": "tv", "eps": 2}),
        ({"beta": 0.1}, {"flow": "beltrami"}, {"flow": "beltrami", "beta": 0.1}),
        ({"levelset": "p", "band": 3, "beta": 1}, {"flat": True}, {"flat": True, "beta": 1}),
        ({"depth": (-1, 1), "fill": 3}, {"flat": True}, {"flat": True, "fill": 3}),
        ({"beta": 0.1}, {"edge": 5}, {"edge": 5}),
        ({"edge": 5, "phi": "weickert"}, {"beta": 0.1}, {"beta": 0.1, "phi": "weickert"}),
        ({"edge": 5, "flow": "phi"}, {"flow": "tv"}, {"flow": "tv"}),
        ({"edge": 5, "phi": "weickert"}, {"flow": "beltrami"}, {"edge": 5, "flow": "beltrami"}),
        ({"edge": 5, "eps": 1, "phi": "weickert", "fidelity": 1}, {"flow": "auto"}, {"flow": "auto", "fidelity": 1}),
        ({"iterations": 5}, {"stop": "auto"}, {"stop": "auto"}),
        ({"stop": "discrepancy", "noise_sigma": 2, "seed": 1}, {"fwhm": 3}, {"fwhm": 3, "seed": 1}),
        ({"stop": "discrepancy", "noise_sigma": 2}, {"stop": "auto"}, {"stop": "auto"}),
        (
            {"stop": "discrepancy", "noise_sigma": 2},
            {"stop": "discrepancy"},
            {"stop": "discrepancy", "noise_sigma": 2},
        ),
        ({"stop": "discrepancy"}, {"noise_sigma": 2}, {"stop": "discrepancy", "noise_sigma": 2}),
        ({"kind": "circular", "period": 360}, {"kind": "vector"}, {"kind": "vector"}),
        ({"kind": "circular", "period": 360}, {"kind": "circular"}, {"kind": "circular", "period": 360}),
        ({"kind": "vector", "independent": True}, {"kind": "scalar"}, {"kind": "scalar"}),
        ({"kind": "circular", "period": 360}, {"period": 24}, {"kind": "circular", "period": 24}),
    ],
)
def test_what_an_override_displaces_goes_with_it(base, over, expected):
    assert overlaid(base, over) == expected


def test_discrepancy_cannot_choose_the_flow():
    with pytest.raises(RefusedError, match="cannot tell which flow is best"):
        Settings(flow="auto", stop="discrepancy")
