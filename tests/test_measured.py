"""Real cortex: the accuracy that is promised where the truth is known, and measured maps where it is not."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from types import ModuleType

import nibabel as nib
import numpy as np
import pytest

from beltrami_cli import denoise
from beltrami_cli.formats import read_volume
from beltrami_cli.surface import Mesh

pytestmark = pytest.mark.slow

BENCHMARKS = Path(__file__).resolve().parents[1] / "benchmarks"
WORKBENCH_PATCH = 19.8  # dB, the best of its geodesic Gaussians over a sweep of widths
DEGREES = {"kind": "circular", "period": 360}


@pytest.fixture
def cases(shared_data: Path, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import cortex_cases

    return cortex_cases


@cache
def angle_cases(cases: ModuleType) -> dict:
    return {case.name: case for case in cases.angle_cases()}


def score(case) -> float:
    psi = read_volume(case.levelset)
    options = DEGREES if case.kind.is_circular else {}
    result = denoise(psi.data, case.volume.data, affine=psi.grid.affine, depth=(-2, 2), stop="auto", **options)
    assert result.warnings == () and result.mesh is not None
    return case.score(case.at_own_vertices(result.mesh.vertices_ras_mm, result.mesh.cells, result.mesh.values))


@pytest.mark.parametrize(
    "name, degrees", [("angle-0.3", 3.5), ("angle-0.6", 5.6), ("angle-1.0", 7.2), ("angle-1.0-holes", 7.2)]
)
def test_angles_of_known_truth(cases, name, degrees):
    assert score(angle_cases(cases)[name]) <= degrees


def test_patch_with_a_sharp_border(cases):
    assert score(cases.patch_case()) >= WORKBENCH_PATCH + 1


# --- measured maps: agreement, not accuracy ---------------------------------------------------------------------------


def at_vertices(cases: ModuleType, mesh: Mesh, vertices: np.ndarray) -> np.ndarray:
    """(V,) degrees of a result's mesh at other vertices of the same surface, NaN where a corner has none."""
    corners, weights = cases.barycentric(mesh.vertices_ras_mm, mesh.cells, vertices)
    assert mesh.values is not None
    turned = (np.exp(1j * np.radians(mesh.values.astype(float)))[corners] * weights).sum(-1)
    return np.degrees(np.angle(turned)) % 360


@pytest.mark.parametrize("person, fall", [("strong", 2.5), ("middle", 2.5), ("weak", 1.5)])
def test_measured_angles_move_toward_the_mean_of_20_people(cases, shared_data, person, fall):
    folder = shared_data / "retino_hcp7t_measured"
    psi, angle, r2 = (read_volume(folder / f"{name}.nii.gz") for name in ("psi", f"{person}_angle", f"{person}_r2"))
    result = denoise(psi.data, angle.data, weights=r2.data, affine=psi.grid.affine, **DEGREES)
    vertices, _ = cases.read_surface(folder / "lh.crop.surf.gii")
    maps = {m.meta["Name"]: m.data for m in nib.load(folder / "lh.crop.func.gii").darrays}
    before, after = maps[f"{person}_angle"], at_vertices(cases, result.mesh, vertices)
    assert not (np.isfinite(before) & np.isnan(after)).any()
    areas = np.isin(maps["benson_varea"], (1, 2, 3)) & np.isfinite(before) & np.isfinite(maps["groupmean20_angle"])
    distances = [
        np.median(np.abs((values - maps["groupmean20_angle"] + 180) % 360 - 180)[areas]) for values in (before, after)
    ]
    assert areas.sum() > 1000 and distances[1] < distances[0] - fall, distances


@pytest.mark.parametrize("options", [{}, {"depth": (-1, 1), "stop": "auto"}])
def test_bold_and_vaso_as_coupled_channels(shared_data, options):
    folder = shared_data / "laynii_lo"
    psi, *maps = (read_volume(folder / f"{n}.nii.gz") for n in ("derived_psi_midlayer", "lo_BOLD_act", "lo_VASO_act"))
    data = np.stack([volume.data for volume in maps], -1)
    result = denoise(psi.data, data, affine=psi.grid.affine, kind="vector", **options)
    seen = np.isfinite(result.data)
    assert np.array_equal(seen[..., 0], seen[..., 1]) and seen[..., 0].sum() > 1000
    assert np.isfinite(result.mesh.values).all() and result.mesh.values.shape[1] == 2
    for k in range(2):
        values, given = result.data[seen[..., k], k], data[np.isfinite(data[..., k]), k]
        assert given.min() <= values.min() and values.max() <= given.max()
        assert values.std() < data[seen[..., k], k].std()
