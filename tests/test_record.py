"""The sidecar: what was used and what happened, to the digit, and only where the run completed."""

from __future__ import annotations

import hashlib
import json
import os
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest
from command import ball, done, load, nifti, noisy, record, seen

import beltrami_cli
from beltrami_cli.record import OF_FILES

PARAMETERS = {
    "flow", "phi", "beta", "edge", "eps", "scheme", "flat", "fidelity", "dt", "iterations", "time", "fwhm", "stop",
    "noise_sigma", "seed", "kind", "period", "independent", "missing", "fill", "extension", "extend_every", "depth",
    "band", "inside", "outside", "precision", "threads",
}  # fmt: skip


def test_provenance(scene, tmp_path):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out)
    used = record(tmp_path / "out.json")
    assert used["GeneratedBy"] == [{"Name": "beltrami_cli", "Version": beltrami_cli.__version__}]
    assert used["Sources"] == [
        {"Path": str(path), "SHA256": hashlib.sha256(path.read_bytes()).hexdigest(), "Role": role}
        for path, role in ((levelset, "levelset"), (data, "data"))
    ]
    assert used["Outputs"] == [str(tmp_path / f"out{s}") for s in (".nii.gz", ".surf.gii", ".func.gii", ".json")]
    assert timedelta(0) <= datetime.now(UTC) - datetime.fromisoformat(used["Created"]) < timedelta(minutes=1)


def test_parameters_as_used(scene, tmp_path):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out)
    written = record(tmp_path / "out.json")
    used = written["Parameters"]
    assert set(used) == PARAMETERS | set(OF_FILES)
    assert used["beta"] == written["PerIteration"]["beta"][0]
    expected = {
        "flow": "beltrami", "phi": None, "eps": None, "scheme": "symmetric", "flat": False, "dt": 0.15,
        "time": None, "fwhm": None, "stop": None, "extension": "closest-point", "extend_every": 5, "band": 4.0,
        "inside": "negative", "outside": "nan", "precision": "float32", "kind": "scalar", "fidelity": None, "seed": 0,
    }  # fmt: skip
    assert {name: used[name] for name in expected} == expected
    assert 1 <= used["threads"] <= (os.cpu_count() or 1)


def test_default_iterations_are_a_parameter_as_used(scene, tmp_path):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out)
    assert record(tmp_path / "out.json")["Parameters"]["iterations"] == 20


def test_automatic_choices_are_recorded(scene, tmp_path):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out, "--flow", "l1")
    used = record(tmp_path / "out.json")
    slope = used["TypicalSlope"]
    assert 2 < slope < 6  # noise of 10, averaged over two voxels
    assert used["Parameters"]["eps"] == pytest.approx(0.1 * slope)
    assert used["PerIteration"]["beta"] == pytest.approx([10 / slope] * 20)
    done("denoise", levelset, data, "-o", out, "--overwrite", "--flow", "phi", "--threads", "1")
    used = record(tmp_path / "out.json")["Parameters"]
    assert (used["phi"], used["threads"]) == ("perona-malik", 1)


def test_table_of_the_choice(scene, tmp_path):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out, "--seed", "5")
    written = record(tmp_path / "out.json")
    choice, slope = written["Choice"], written["TypicalSlope"]
    best = min(choice["table"], key=lambda row: row["error"])
    assert {name: choice[name] for name in ("flow", "phi", "beta", "iterations")} == {
        name: best[name] for name in ("flow", "phi", "beta", "iterations")
    }
    assert written["Parameters"]["beta"] == best["beta"]
    assert written["PerIteration"]["beta"] == [best["beta"]] * 20
    steps = np.log2([row["beta"] * slope for row in choice["table"]])
    assert steps[0] == pytest.approx(0) and steps * 2 == pytest.approx(np.round(steps * 2), abs=1e-9)
    near = np.count_nonzero((np.abs(ball()) >= 1) & (np.abs(ball()) < 2))
    assert choice["held_out_voxels"] == pytest.approx(0.5 * near, rel=0.01)
    for row in choice["table"]:
        assert row["error"] == pytest.approx(10, rel=0.15) and row["error"] < row["error_at_start"]  # noise of 10
        assert row["iterations"] == row["iterations_tried"] == 20


@pytest.mark.parametrize("options", [("--beta", "0.1"), ("--flow", "l2"), ("--iterations", "0"), ("--edge", "10")])
def test_no_choice_where_nothing_is_left_to_choose(scene, tmp_path, options):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out, *options)
    written = record(tmp_path / "out.json")
    assert written["Choice"] is None and "choose" not in written["Seconds"]
    if options[0] == "--edge":
        assert (written["Parameters"]["edge"], written["Parameters"]["beta"]) == (10.0, 0.1)


def test_noise_smoothness_and_values(scene, tmp_path):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out, "--beta", "0.1")
    written = record(tmp_path / "out.json")
    assert written["Noise"]["sd"] == [pytest.approx(10, rel=0.1)]
    before, after = (written["Smoothness"][name] for name in ("before_mm", "after_mm"))
    assert 0 <= before < 1 and 2.5 < after < 8  # heat flow of 3 mm^2 alone would make it 5.8
    assert written["Values"] == {"channels": 1, "range": None}
    turns = ("--kind", "circular", "--period", "100", "--beta", "0.1", "--overwrite")
    done("denoise", levelset, data, "-o", out, *turns)
    assert record(tmp_path / "out.json")["Values"] == {"channels": 2, "range": [0.0, 100.0]}
    below = nifti(tmp_path / "below.nii.gz", noisy() - 50)
    done("denoise", levelset, below, "-o", out, *turns)
    assert record(tmp_path / "out.json")["Values"] == {"channels": 2, "range": [-50.0, 50.0]}


def test_what_happened(scene, tmp_path):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out, "--beta", "0.1:0.2", "--iterations", "8", "--extend-every", "0")
    used = record(tmp_path / "out.json")
    assert used["Grid"] == {"shape": [16] * 3, "spacing_mm": [1.0] * 3, "affine_ras_mm": np.eye(4).tolist()}
    assert (used["Iterations"], used["StopReason"], used["TimeMm2"]) == (8, "iterations", pytest.approx(1.2))
    each = used["PerIteration"]
    assert each.pop("most_substeps") == 1
    assert {len(values) for values in each.values()} == {8}
    assert each["dt_over_beta"] == pytest.approx(np.array(each["dt"]) / each["beta"])
    assert each["change_rms"] == sorted(each["change_rms"], reverse=True)
    assert each["energy"] == sorted(each["energy"], reverse=True)
    band = used["Band"]
    assert band["half_width_mm"] == 4.0
    assert band["voxels"] == band["entries"] == seen(out).size
    assert (band["filled_voxels"], band["missing_voxels"], band["surface_vertices"]) == (0, 0, 486)


def test_energy_and_change_of_one_step(scene, tmp_path):
    """change_rms is that of the band's values, from volumes before and after one step."""
    levelset, data, _ = scene
    for count in ("0", "1"):
        done("denoise", levelset, data, "-o", tmp_path / f"{count}.nii.gz", "--iterations", count, "--flow", "l2")
    step = seen(tmp_path / "1.nii.gz") - seen(tmp_path / "0.nii.gz")
    change = record(tmp_path / "1.json")["PerIteration"]["change_rms"]
    assert change == [pytest.approx(np.sqrt(np.mean(step**2)), rel=1e-4)]


def test_noise_removed_is_that_beside_the_surface(scene, tmp_path):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out)
    removed = record(tmp_path / "out.json")["Removed"]
    near = np.abs(ball()) <= 0.5
    expected = np.sqrt(np.mean((noisy() - load(out))[near] ** 2))
    assert removed["rms"] == pytest.approx(expected, rel=0.02)
    assert removed["voxels"] == pytest.approx(near.sum(), rel=0.02)


def test_holes_are_counted(scene, tmp_path):
    levelset, _, out = scene
    holes = noisy()
    holes[8:] = np.nan
    done("denoise", levelset, nifti(tmp_path / "holes.nii.gz", holes), "-o", out, "--beta", "0.1")
    band = record(tmp_path / "out.json")["Band"]
    assert band["filled_voxels"] == pytest.approx(band["voxels"] / 2, rel=0.15)
    assert band["missing_voxels"] == 0


def test_seconds_and_memory(scene, tmp_path):
    levelset, data, out = scene
    run = done("denoise", levelset, data, "-o", out)
    used = record(tmp_path / "out.json")
    assert set(used["Seconds"]) == {"numba", "read", "band", "extend", "choose", "flow", "mesh", "write"}
    assert all(0 <= seconds < 120 for seconds in used["Seconds"].values())
    assert run.out.splitlines()[1].endswith(f"{sum(used['Seconds'].values()):.1f} s")
    assert used["PeakMemoryMiB"] is None or 30 < used["PeakMemoryMiB"] < 8000


def test_json_is_strict(scene, tmp_path):
    """No NaN or Infinity, which JSON does not know, even where nothing could be measured."""

    def refuse(word: str) -> None:
        raise AssertionError(word)

    levelset, _, out = scene
    lone = np.full((16, 16, 16), np.nan, np.float32)
    lone[tuple(np.argwhere((ball() > 0.6) & (ball() < 0.8))[0])] = 3.0
    done("denoise", levelset, nifti(tmp_path / "lone.nii.gz", lone), "-o", out)
    json.loads((tmp_path / "out.json").read_text(), parse_constant=refuse)


def test_sidecar_is_written_last_and_removed_first(scene, tmp_path, monkeypatch):
    levelset, data, out = scene
    done("denoise", levelset, data, "-o", out)
    order = []
    replace = os.replace

    def watched(source: Path, target: Path) -> None:
        order.append((Path(target).name, (tmp_path / "out.json").exists()))
        replace(source, target)

    monkeypatch.setattr(os, "replace", watched)
    done("denoise", levelset, data, "-o", out, "--overwrite")
    assert order == [(f"out{s}", False) for s in (".nii.gz", ".surf.gii", ".func.gii", ".json")]


@pytest.mark.parametrize("name, sidecar", [("o.nii.gz", "o.json"), ("o.run.mgz", "o.run.json"), ("o.npy", "o.json")])
def test_name(scene, tmp_path, name, sidecar):
    levelset, data, _ = scene
    done("denoise", levelset, data, "-o", tmp_path / name, "--no-mesh")
    assert record(tmp_path / sidecar)["Outputs"] == [str(tmp_path / name), str(tmp_path / sidecar)]


def test_files(tmp_path):
    psi, data = (tmp_path / f"{name}.npy" for name in ("psi", "data"))
    np.save(psi, ball((24, 24), 8.0))
    np.save(data, noisy((24, 24)))
    done("denoise", psi, data, "-o", tmp_path / "o.npy", "--spacing", "1,2", "--beta", "0.1")
    used = record(tmp_path / "o.json")["Parameters"]
    assert (used["resample"], used["spacing"]) == (False, [1.0, 2.0])
