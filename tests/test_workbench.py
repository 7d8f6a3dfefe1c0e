"""Connectome Workbench opens and smooths what is written, and what it writes is read where it is in the world."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
import trimesh
from nibabel import gifti

from beltrami_cli.formats import read_overlay, read_surface, write_mesh, write_overlay
from beltrami_cli.surface import Mesh

pytestmark = pytest.mark.skipif(shutil.which("wb_command") is None, reason="Connectome Workbench is not installed")

BALL = trimesh.creation.icosphere(3, radius=20.0)
VERTICES = np.array(BALL.vertices) + np.array([-30.0, -70.0, 12.0])
CELLS = np.array(BALL.faces, np.int32)
ANGLE = (np.degrees(np.arctan2(VERTICES[:, 1] + 70, VERTICES[:, 0] + 30)) % 360).astype(np.float32)
HOLED = np.where(VERTICES[:, 2] > 28, np.nan, np.cos(VERTICES[:, 0] / 4)).astype(np.float32)


def workbench(*arguments: object) -> str:
    """What it prints; a complaint of any kind fails the test."""
    command = ["wb_command", *map(str, arguments)]
    run = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert (run.returncode, run.stderr) == (0, "")
    assert not any(word in run.stdout.lower() for word in ("warning", "error"))
    return run.stdout


def facts(path: Path) -> dict[str, str]:
    """The lines `Name: value` of -file-information."""
    lines = (line.partition(":") for line in workbench("-file-information", path).splitlines())
    return {name.strip(): value.strip() for name, _, value in lines if value}


@pytest.mark.parametrize(("values", "maps"), [(HOLED, 1), (np.stack([ANGLE, HOLED, -ANGLE], -1), 3)])
def test_mesh_and_values(tmp_path, values, maps):
    surface, metric = write_mesh(tmp_path / "m.surf.gii", Mesh(VERTICES, CELLS, values, "CortexLeft"))
    found = facts(surface)
    assert (found["Type"], found["Structure"]) == ("Surface", "CortexLeft")
    assert (found["Number of Vertices"], found["Number of Triangles"]) == (str(len(VERTICES)), str(len(CELLS)))
    assert found["Normal Vectors Correct"] == "true"
    assert found["Surface Type (Primary)"] == "Anatomical"
    assert float(found["Z-maximum"]) == pytest.approx(32, abs=1e-3)

    found = facts(metric)
    assert (found["Type"], found["Structure"]) == ("Metric", "CortexLeft")
    assert (found["Number of Vertices"], found["Number of Maps"]) == (str(len(VERTICES)), str(maps))

    workbench("-metric-smoothing", surface, metric, 2, tmp_path / "smooth.func.gii")
    smooth = read_overlay(tmp_path / "smooth.func.gii", len(VERTICES), channels=True)
    assert smooth.shape == values.shape
    # Its smoothing spreads NaN to the neighbours, and no further.
    low = VERTICES[:, 2] < 20
    assert np.isfinite(smooth[low]).all()


@pytest.mark.parametrize("name", ["o.shape.gii", "o.func.gii"])
def test_values_alone(tmp_path, name):
    write_mesh(tmp_path / "m.surf.gii", Mesh(VERTICES, CELLS, structure="CortexRight"))
    write_overlay(tmp_path / name, ANGLE, structure="CortexRight")
    found = facts(tmp_path / name)
    assert (found["Type"], found["Structure"], found["Number of Maps"]) == ("Metric", "CortexRight", "1")
    workbench("-metric-smoothing", tmp_path / "m.surf.gii", tmp_path / name, 2, tmp_path / "s.func.gii")
    assert np.isfinite(read_overlay(tmp_path / "s.func.gii", len(VERTICES))).all()


def test_a_surface_that_workbench_moved_into_the_world(tmp_path):
    # The way of the HCP pipelines: mris_convert, then c_ras added; the geometry of the first step stays in the file.
    centre = np.array([3.5, -12.25, 8.0])
    directions = zip(("X", "Y", "Z"), ((-1, 0, 0), (0, 0, -1), (0, 1, 0)), strict=True)
    meta = {f"VolGeom{name}": "256" for name in ("Width", "Height", "Depth")}
    meta |= {f"VolGeom{axis}size": "1" for axis in "XYZ"}
    meta |= {f"VolGeom{axis}_{ras}": str(n) for axis, row in directions for ras, n in zip("RAS", row, strict=True)}
    meta |= {f"VolGeomC_{ras}": str(n) for ras, n in zip("RAS", centre, strict=True)}
    arrays = [
        gifti.GiftiDataArray(
            (VERTICES - centre).astype(np.float32), "NIFTI_INTENT_POINTSET", meta=gifti.GiftiMetaData(meta)
        ),
        gifti.GiftiDataArray(CELLS, "NIFTI_INTENT_TRIANGLE"),
    ]
    gifti.GiftiImage(darrays=arrays).to_filename(tmp_path / "tkr.surf.gii")
    assert np.allclose(read_surface(tmp_path / "tkr.surf.gii").vertices_ras_mm, VERTICES, atol=1e-4)

    shift = np.eye(4)
    shift[:3, 3] = centre
    np.savetxt(tmp_path / "c_ras.mat", shift)
    moved = tmp_path / "world.surf.gii"
    workbench("-surface-apply-affine", tmp_path / "tkr.surf.gii", tmp_path / "c_ras.mat", moved)
    assert nib.load(moved).darrays[0].meta["VolGeomC_R"] == "3.5"
    assert np.allclose(read_surface(moved).vertices_ras_mm, VERTICES, atol=1e-4)
