"""Real cortex: heat flow against finite elements on the surface's own mesh; noisy maps that must stay sane."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from beltrami_cli import denoise
from beltrami_cli.band import Band, build_band
from beltrami_cli.evolve import Schedule, evolve
from beltrami_cli.extension import Reextension
from beltrami_cli.flows import Flow, Stepper
from beltrami_cli.formats import read_volume
from beltrami_cli.grid import Grid
from beltrami_cli.kernels import interpolate

pytestmark = pytest.mark.slow


def finite_element_heat(vertices, triangles):
    """A function (u (V,), t) -> u after heat flow for t mm^2: linear elements, lumped mass, 20 implicit steps."""
    lapy = pytest.importorskip("lapy")
    from scipy.sparse import diags
    from scipy.sparse.linalg import splu

    fem = lapy.Solver(lapy.TriaMesh(vertices, triangles), lump=True)
    area = fem.mass.diagonal()
    mass = diags(np.where(area > 0, area, 1e-6)).tocsc()  # a lone vertex has none

    def heat(u, t):
        step = splu((mass + t / 20 * fem.stiffness).tocsc())
        for _ in range(20):
            u = step.solve(mass @ u)
        return u

    return heat


def away_from_border(vertices, triangles, ijk, shape):
    """(V,) bool: over 6 mm from the mesh's border and 6 voxels from the volume's faces."""
    edges, times = np.unique(
        np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1),
        axis=0, return_counts=True,
    )  # fmt: skip
    border = cKDTree(vertices[np.unique(edges[times == 1])])
    return (border.query(vertices)[0] > 6) & np.all((ijk > 6) & (ijk < np.array(shape) - 7), axis=1)


def at_points(band: Band, u: np.ndarray, ijk: np.ndarray) -> np.ndarray:
    """(N,) u (1, E) at points of the surface in voxels of the whole grid: local cubic on the nearest vertex's sheet.

    Starts from that vertex's own nearest entry; trilinear where the cubic's stencil is incomplete.
    """
    h = band.grid.spacing
    q = ijk - [part.start for part in band.box]
    own = cKDTree(band.surface.points).query(q * h)[1]
    x = np.clip(np.round(band.surface.points[own] / h).astype(int), 0, np.array(band.box_shape) - 1)
    voxel = np.ravel_multi_index(tuple(x.T), band.box_shape)
    start = np.empty(len(q), np.int32)
    for k, v in enumerate(voxel):
        entries = np.arange(band.first[v], band.first[v + 1])
        apart = band.surface.points[band.vertex[entries]] - band.surface.points[own[k]]
        start[k] = entries[(apart**2).sum(1).argmin()]
    at = np.stack(np.unravel_index(band.voxel[start], band.box_shape), 1)
    offset = np.ascontiguousarray((q - at).T.astype(np.float32))
    total, mass = np.zeros((1, len(q))), np.zeros(len(q))
    there = np.ones(band.entries, u.dtype)
    interpolate.linear(u, there, start, offset, band.forward, band.backward, 0.1, total, mass)
    out = (total / mass).astype(u.dtype)
    origin = interpolate.stencil_origins(start, offset, band.forward, band.backward, band.nodes)
    interpolate.cubic(u, np.empty(0, u.dtype), origin, offset, band.forward, band.nodes, out)
    return out[0]


def test_heat_flow_is_that_of_finite_elements(shared_data: Path):
    """White noise smoothed to 2 mm^2 on the mesh, painted on the band, flowed with l2, sampled at the vertices."""
    nib = pytest.importorskip("nibabel")
    folder = shared_data / "s1_individual"
    psi = read_volume(folder / "psi.nii.gz")
    vertices, triangles = (array.data for array in nib.load(folder / "lh.mid.crop.surf.gii").darrays)
    vertices = vertices.astype(float)
    heat = finite_element_heat(vertices, triangles)
    start = heat(np.random.default_rng(0).normal(size=len(vertices)), 2.0)
    start = (start - start.mean()) / start.std()

    grid = Grid(psi.grid.shape, psi.grid.affine)
    ijk = grid.to_index(vertices)
    inner = away_from_border(vertices, triangles, ijk, grid.shape)
    h = float(grid.spacing.max())
    band = build_band(psi.data, grid, 4 * h)
    low = np.array([part.start for part in band.box])
    foot = np.stack(np.unravel_index(band.voxel, band.box_shape), 1) + low + band.closest_offset.T
    apart, nearest = cKDTree(ijk).query(foot, k=3)
    weight = 1 / (apart + 0.05)
    u = ((start[nearest] * weight).sum(1) / weight.sum(1)).astype(np.float32)[None]

    flow, dt, done = Stepper(Flow("l2"), band, u.dtype), 0.15 * h**2, 0
    for t, least in ((3.0, 0.998), (8.0, 0.997)):
        steps = round(t / dt)
        u = evolve(u, flow, Schedule(np.zeros(steps - done), dt), Reextension(band), 5).values
        done = steps
        got, expected = at_points(band, u, ijk)[inner], heat(start, t)[inner]
        assert np.corrcoef(got, expected)[0, 1] >= least
        assert np.abs(got - expected).max() <= 0.5  # standard deviations of the start


@pytest.mark.parametrize(
    ("folder", "name"),
    [("retino_fsaverage", "ecc_noisy_voxel_lognormal0.35"), ("s1_individual", "epi")],
)
def test_noisy_maps_stay_finite_and_in_range(shared_data: Path, folder, name):
    psi, data = (read_volume(find(shared_data / folder, key)) for key in ("psi", name))
    low, high = np.nanmin(data.data), np.nanmax(data.data)
    margin = 0.01 * (high - low)
    for beta in (0.0, 0.05, 0.5):
        result = denoise(psi.data, data.data, affine=psi.grid.affine, beta=beta, iterations=200)
        on_band = np.isfinite(result.data)
        assert on_band.sum() > 0.99 * result.record["Band"]["voxels"]
        assert result.data[on_band].min() >= low - margin and result.data[on_band].max() <= high + margin
        assert np.isfinite(result.mesh.values).mean() > 0.99
        assert np.isfinite(result.record["PerIteration"]["change_rms"]).all()


def test_a_slab_of_three_oblique_slices_runs(shared_data: Path):
    folder = shared_data / "laynii_lo"
    psi = read_volume(find(folder, "derived_psi_midlayer"))
    data = read_volume(find(folder, "BOLD"))
    result = denoise(psi.data, data.data, affine=psi.grid.affine, beta=0.01)
    valid = data.data[np.isfinite(data.data)]
    on_band = np.isfinite(result.data)
    assert on_band.sum() > 5000
    assert valid.min() <= result.data[on_band].min() and result.data[on_band].max() <= valid.max()
    before, after = (np.std(np.diff(d, axis=0)[on_band[1:] & on_band[:-1]]) for d in (data.data, result.data))
    assert after < 0.7 * before


def find(folder: Path, name: str) -> Path:
    """The one NIfTI volume in the folder whose name holds `name`."""
    found = sorted(path for path in folder.glob("*.nii*") if name.lower() in path.name.lower())
    assert found, f"no volume called {name} in {folder}"
    return found[0]
