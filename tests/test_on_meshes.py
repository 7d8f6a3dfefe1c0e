"""Values at the vertices of a mesh, and at those of other meshes: heat flow, geometry, missing data, banks, choice."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from test_cortex import finite_element_heat
from test_measured import cases  # noqa: F401

from beltrami_cli import Mesh, denoise
from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.grid import Grid
from beltrami_cli.levelset import refined
from beltrami_cli.surface import edges_of

RADIUS = 20.0
CENTRE = np.array([3.1, -7.2, 11.3])  # mm; on no grid
TURN = Rotation.from_euler("xyz", [0.2, 0.4, 0.7]).as_matrix()  # no two vertices are equally near to a voxel


def sphere(subdivisions: int, radius: float = RADIUS) -> tuple[Mesh, np.ndarray]:
    """A sphere around CENTRE and the unit vectors (V, 3) to its vertices. Median edges: 6, 3, 1.5 mm for 2, 3, 4."""
    ball = trimesh.creation.icosphere(subdivisions, radius=1.0)
    d = np.array(ball.vertices) @ TURN.T
    return Mesh(CENTRE + radius * d, np.array(ball.faces, np.int32)), d


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(m.vertices_ras_mm) for m in meshes)])
    cells = [m.cells + start for m, start in zip(meshes, starts, strict=False)]
    return Mesh(np.concatenate([m.vertices_ras_mm for m in meshes]), np.concatenate(cells).astype(np.int32))


def y20(d: np.ndarray) -> np.ndarray:
    return 1.5 * d[:, 2] ** 2 - 0.5


def pieces(d: np.ndarray) -> np.ndarray:
    """Two caps on a smooth map, 0 to about 160: borders of 100 and 60."""
    return 100.0 * (d[:, 0] > 0.4) + 60.0 * (d[:, 2] < -0.5) + 20 * d[:, 1]


def noisy(d: np.ndarray, sigma: float = 20.0, seed: int = 0) -> np.ndarray:
    return pieces(d) + sigma * np.random.default_rng(seed).normal(size=len(d))


def apart(a: np.ndarray, b: np.ndarray) -> float:
    return float(np.abs(a.astype(float) - b).max())


# --- heat flow: the analytic answer on a sphere -----------------------------------------------------------------------


def heat_error(mesh: Mesh, d: np.ndarray, spacing: float | None = None) -> tuple[float, float, float]:
    """Error of the heat flow of Y_20 to t = 0.1 R^2 in steps of 0.15 h^2, largest and rms; the band's spacing h."""
    h = spacing
    if h is None:
        edges = mesh.vertices_ras_mm[mesh.cells] - mesh.vertices_ras_mm[np.roll(mesh.cells, 1, 1)]
        h = float(np.median(np.linalg.norm(edges, axis=-1)))
    dt = 0.15 * h**2
    steps = round(0.1 * RADIUS**2 / dt)
    result = denoise(mesh, y20(d), flow="l2", dt=dt, iterations=steps, spacing=h, precision="float64")
    assert result.warnings == () and result.record["Grid"]["spacing_mm"][0] == pytest.approx(h)
    error = result.data - (1 - 6 * dt / RADIUS**2) ** steps * y20(d)
    return float(np.abs(error).max()), float(np.sqrt(np.mean(error**2))), h


@pytest.mark.parametrize("jitter", [0.0, 0.15])
def test_heat_flow_converges(jitter):
    """The grid as fine as the mesh; vertices moved along the sphere by that share of an edge."""
    found = []
    for subdivisions in (2, 3, 4):
        mesh, d = sphere(subdivisions)
        edge = 6.0 / 2 ** (subdivisions - 2)
        d = d + np.random.default_rng(0).normal(size=d.shape) * jitter * edge / RADIUS
        d /= np.linalg.norm(d, axis=1, keepdims=True)
        found.append(heat_error(Mesh(CENTRE + RADIUS * d, mesh.cells), d))
    largest, rms, spacing = np.array(found).T
    assert np.polyfit(np.log(spacing), np.log(rms), 1)[0] >= 1.6
    assert np.all(largest <= [0.035, 0.016, 0.004])


@pytest.mark.parametrize("spacing", [1.5, 5.0])
def test_heat_flow_on_a_grid_unlike_the_mesh(spacing):
    """Edges of 3 mm, refined once for voxels of 1.5 mm; in voxels of 5 mm some hold several vertices."""
    assert heat_error(*sphere(3), spacing)[0] <= 0.012


def test_refined():
    mesh, d = sphere(2)
    grid = Grid.from_spacing((60, 60, 60))
    fine = refined(mesh, grid)
    ends = fine.surface.points[edges_of(fine.surface.cells)]
    assert np.linalg.norm(ends[:, 0] - ends[:, 1], axis=1).max() <= 1.25
    # Still closed: with as many faces as Euler's formula asks for.
    assert np.allclose(fine.surface.points[: len(d)], mesh.vertices_ras_mm)
    assert len(fine.surface.cells) == 2 * len(fine.surface.points) - 4
    linear = np.stack([mesh.vertices_ras_mm @ [1, 2, 3], mesh.vertices_ras_mm @ [0, -1, 0.5]])
    values, trust = fine.carry(linear, np.ones(len(d)))
    assert np.allclose(values[0], fine.surface.points @ [1, 2, 3]) and (trust == 1).all()
    linear[:, 0] = np.nan
    values, trust = fine.carry(linear, np.where(np.arange(len(d)) == 0, 0.0, 1.0))
    assert np.isnan(values[0]).sum() == 1 and ((trust == 0) == np.isnan(values[0])).all()


# --- the mesh: order, sense and place say nothing ---------------------------------------------------------------------

RUN = {"beta": 0.05, "iterations": 20, "precision": "float64"}


@pytest.fixture(scope="module")
def run():
    """A sphere, its unit vectors, noisy data, and what becomes of them."""
    mesh, d = sphere(3)
    return mesh, d, noisy(d), denoise(mesh, noisy(d), **RUN)


def test_result_is_at_the_vertices_given(run):
    mesh, _, data, result = run
    assert np.array_equal(result.data, result.mesh.values) and result.data.dtype == np.float64
    assert np.array_equal(result.mesh.vertices_ras_mm, mesh.vertices_ras_mm)
    assert np.array_equal(result.mesh.cells, mesh.cells)
    assert result.filled.shape == data.shape and not result.filled.any()


def test_order_of_vertices_and_triangles(run):
    """A vertex keeps its value to 1e-4 of the range: which of two equally near ones a voxel takes is by their order."""
    mesh, d, data, result = run
    order = np.random.default_rng(1).permutation(len(d))
    cells = np.argsort(order)[mesh.cells].astype(np.int32)[::-1]
    permuted = denoise(Mesh(mesh.vertices_ras_mm[order], cells), data[order], **RUN)
    assert apart(permuted.data, result.data[order]) <= 1e-4 * np.ptp(data)


def test_inside_out(run):
    mesh, _, data, result = run
    for cells in (mesh.cells[:, ::-1].copy(), np.roll(mesh.cells, 1, 1)):
        assert apart(denoise(Mesh(mesh.vertices_ras_mm, cells), data, **RUN).data, result.data) <= 1e-9


def test_place_in_space(run):
    """The grid moves with the mesh, but does not turn: white noise, whose detail is a voxel's, shows that."""
    mesh, d, data, result = run
    moved = Mesh(mesh.vertices_ras_mm + np.array([100.3, -20, 7]), mesh.cells)
    assert apart(denoise(moved, data, **RUN).data, result.data) <= 1e-4 * np.ptp(data)
    smooth = 100 * d[:, 2] * d[:, 0]
    expected = denoise(mesh, smooth, **RUN).data
    for seed in range(3):
        turned = Mesh(mesh.vertices_ras_mm @ Rotation.random(random_state=seed).as_matrix().T, mesh.cells)
        assert apart(denoise(turned, smooth, **RUN).data, expected) <= 3e-3 * np.ptp(smooth)
        assert apart(denoise(turned, data, **RUN).data, result.data) <= 0.02 * np.ptp(data)
    mirrored = Mesh(mesh.vertices_ras_mm * [-1, 1, 1], mesh.cells)
    assert apart(denoise(mirrored, smooth, **RUN).data, expected) <= 3e-3 * np.ptp(smooth)


SHAPE = (52, 53, 51)


@pytest.mark.parametrize("flips", [(0,), (0, 1), (2, 1), (0, 1, 2)])
def test_a_volume_around_a_mesh_however_it_is_stored(flips):
    mesh, _ = sphere(3)
    affine = np.eye(4)
    affine[:3, 3] = CENTRE - np.array(SHAPE) / 2
    ras = np.moveaxis(np.indices(SHAPE), 0, -1) + affine[:3, 3]
    data = 50 * np.sin(ras[..., 0] / 6) * np.cos(ras[..., 1] / 5) + ras[..., 2]
    data += 5 * np.random.default_rng(2).normal(size=SHAPE)
    other = affine.copy()
    for axis in flips:
        other[:3, 3] += other[:3, axis] * (SHAPE[axis] - 1)
        other[:3, axis] *= -1
    options = {"beta": 0.05, "iterations": 10, "on": [Mesh(mesh.vertices_ras_mm + 0.3, mesh.cells)]}
    one = denoise(mesh, data, affine=affine, **options)
    two = denoise(mesh, np.flip(data, flips), affine=other, **options)
    back = np.flip(two.data, flips)
    assert np.array_equal(np.isnan(back), np.isnan(one.data)) and np.isfinite(one.data).sum() > 30000
    assert np.nanmax(np.abs(back - one.data)) <= 1e-4 * np.ptp(data)
    assert apart(two.mesh.values, one.mesh.values) <= 1e-4 * np.ptp(data)
    assert apart(two.on[0], one.on[0]) <= 1e-4 * np.ptp(data)


# --- values -----------------------------------------------------------------------------------------------------------

FLOWS = ("beltrami", "l2", "l1", "tv", "phi", "auto")


@pytest.mark.parametrize("flow", FLOWS)
@pytest.mark.parametrize("value", [7.3, 359.9, (1.0, -2.0, 3e4), 3 - 4j])
def test_constants_stay(flow, value):
    mesh, d = sphere(1)
    options = {"kind": "circular", "period": 360} if value == 359.9 else {}
    options |= {} if isinstance(value, float) else {"kind": "vector"}
    data = np.full((len(d), *np.shape(value)), value)
    result = denoise(mesh, data, flow=flow, iterations=20, **options)
    assert np.abs(result.data - data).max() <= 1e-6 * np.abs(data).max() and result.warnings == ()


@pytest.mark.parametrize("flow", FLOWS[:-1])
def test_no_value_leaves_the_range(flow):
    mesh, d = sphere(2)
    data = np.random.default_rng(3).standard_cauchy(len(d)).astype(np.float32)
    steepness = {} if flow in ("l2", "l1", "tv") else {"beta": 1.0}
    result = denoise(mesh, data, flow=flow, iterations=50, **steepness)
    assert data.min() <= result.data.min() and result.data.max() <= data.max()


def test_before_the_first_iteration():
    """What goes onto the band and comes back is blurred by the triangles: by h^2, as after heat flow for h^2 / 10."""
    errors = []
    for subdivisions in (3, 4):
        mesh, d = sphere(subdivisions)
        errors.append(apart(denoise(mesh, y20(d), flow="l2", iterations=0).data, y20(d)))
    assert errors[0] <= 0.025 and errors[1] <= 0.5 * errors[0]


def test_turning_all_angles_commutes():
    mesh, d = sphere(2)
    rng = np.random.default_rng(4)
    angles = (np.degrees(np.arctan2(d[:, 1], d[:, 0])) + 40 * rng.normal(size=len(d))) % 360
    options = {"kind": "circular", "period": 360, "beta": 0.05, "iterations": 20, "precision": "float64"}
    first = denoise(mesh, angles, **options).data
    assert first.min() >= 0 and first.max() < 360
    for turn in (90, 77.7):
        second = denoise(mesh, (angles + turn) % 360, **options).data
        assert np.abs((second - first - turn + 180) % 360 - 180).max() <= 1e-9


def test_channels():
    mesh, d = sphere(2)
    channels = np.random.default_rng(5).normal(size=(len(d), 3))
    options = {"beta": 0.3, "iterations": 10}
    apiece = [denoise(mesh, channel, **options) for channel in channels.T]
    series = denoise(mesh, channels, kind="vector", independent=True, **options)
    coupled = denoise(mesh, channels, kind="vector", **options)
    assert np.array_equal(series.data, np.stack([one.data for one in apiece], -1))
    assert np.array_equal(series.mesh.values, series.data) and series.filled.shape == (len(d),)
    assert np.array_equal(coupled.mesh.values, coupled.data)
    assert 1e-3 < apart(coupled.data, series.data) < 0.1  # the channels of a vector see each other's edges
    alone = denoise(mesh, channels[:, :1], kind="vector", **options)
    assert alone.data.shape == (len(d), 1) and apart(alone.data[:, 0], apiece[0].data) <= 1e-6


def test_complex_values_are_vectors_of_two_whatever_their_phase():
    mesh, d = sphere(2)
    values = np.random.default_rng(6).normal(size=(len(d), 2)) @ [1, 1j]
    options = {"kind": "vector", "beta": 0.3, "iterations": 10, "precision": "float64"}
    first, second = (denoise(mesh, values * turn, **options) for turn in (1, np.exp(0.7j)))
    assert first.data.dtype == np.complex128 and first.mesh.values.shape == (len(d), 2)
    assert np.abs(second.data - first.data * np.exp(0.7j)).max() <= 1e-12
    with pytest.raises(RefusedError, match="complex data need kind='vector'"):
        denoise(mesh, values)


# --- missing data -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def holed():
    """A sphere with a smooth map, a cap of which is missing; mm along the sphere to the nearest vertex that is not."""
    mesh, d = sphere(4)
    hole = d[:, 0] > 0.8
    along = RADIUS * np.arccos(np.clip(d @ d[~hole].T, -1, 1).max(1))
    return mesh, d, 100 * d[:, 2], hole, along


def test_missing_vertices_are_filled(holed):
    mesh, _, data, hole, _ = holed
    result = denoise(mesh, np.where(hole, np.nan, data), beta=0.01, iterations=5)
    assert np.array_equal(result.filled, hole) and np.isfinite(result.data).all() and result.warnings == ()
    assert np.abs(result.data - data)[hole].max() <= 3


def test_ways_to_say_missing(holed):
    mesh, _, data, hole, _ = holed
    options = {"beta": 0.01, "iterations": 5}
    expected = denoise(mesh, np.where(hole, np.nan, data), **options)
    for given in (
        denoise(mesh, np.where(hole, 1e6, data), weights=np.where(hole, 0, 3.0), **options),
        denoise(mesh, np.where(hole, 1e6, data), mask=~hole, **options),
        denoise(mesh, np.where(hole, -999, data), missing=-999, **options),
        denoise(mesh, np.ma.masked_array(data, hole), **options),
    ):
        assert np.array_equal(given.data, expected.data) and np.array_equal(given.filled, hole)


@pytest.mark.parametrize(("fill", "spacing"), [(0.0, None), (4.0, None), (8.0, None), (0.0, 0.8)])
def test_fill_ends_at_its_distance(holed, fill, spacing):
    """To a tenth and a quarter of an edge, by which ways over edges are longer than over the sphere."""
    mesh, _, data, hole, along = holed
    result = denoise(mesh, np.where(hole, np.nan, data), beta=0.01, iterations=5, fill=fill, spacing=spacing)
    assert np.isfinite(result.data[~hole]).all()
    assert np.array_equal(result.filled, hole & np.isfinite(result.data))
    assert result.filled[hole & (along <= 0.9 * fill - 0.4)].all()
    assert not result.filled[along > 1.1 * fill + 0.4].any()
    assert np.array_equal(np.isnan(result.mesh.values), np.isnan(result.data))


def test_weights_say_who_is_heard():
    mesh, d = sphere(3)
    rng = np.random.default_rng(7)
    poor = rng.random(len(d)) < 0.5
    truth = 100 * d[:, 2]
    data = truth + np.where(poor, 50, 5) * rng.normal(size=len(d))
    plain, weighted = (
        denoise(mesh, data, flow="l2", iterations=4, weights=weights) for weights in (None, np.where(poor, 0.01, 1))
    )
    assert np.std(weighted.data - truth) < 0.5 * np.std(plain.data - truth)


def test_lone_vertices_get_no_value():
    mesh, d = sphere(3)
    lone = np.concatenate([mesh.vertices_ras_mm, [CENTRE, CENTRE + RADIUS * np.eye(3)[2]]])
    for theirs in (1e6, np.nan):
        result = denoise(Mesh(lone, mesh.cells), np.r_[100 * d[:, 2], theirs, theirs], beta=0.01, iterations=5)
        assert np.flatnonzero(np.isnan(result.data)).tolist() == [len(d), len(d) + 1]
        assert np.nanmax(result.data) <= 100 and not result.filled.any()
        assert len(result.warnings) == 1 and "2 of 644 vertices belong to no triangle" in result.warnings[0]


# --- banks and borders ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("facing", ["alike", "opposed"])
@pytest.mark.parametrize(("gap", "spacing"), [(0.3, None), (0.05, None), (0.3, 3.0)])
def test_nothing_leaks_between_sheets(facing, gap, spacing):
    """Two spheres 0.3 and 0.05 voxels apart, one mesh, unlike triangles: 400 steps."""
    (inner, d), (outer, _) = sphere(3), sphere(3, RADIUS + gap * (spacing or 3.0))
    turn = Rotation.random(random_state=1).as_matrix()
    outer = Mesh((outer.vertices_ras_mm - CENTRE) @ turn.T + CENTRE, outer.cells)
    inner = Mesh(inner.vertices_ras_mm, inner.cells if facing == "alike" else inner.cells[:, ::-1])
    data = np.repeat([0.0, 100.0], len(d))
    result = denoise(joined(inner, outer), data, flow="l2", iterations=400, spacing=spacing)
    assert np.array_equal(result.data, data)


def half_sphere() -> tuple[Mesh, np.ndarray]:
    mesh, d = sphere(4)
    kept = mesh.cells[(d[mesh.cells][:, :, 2] > 0).all(1)]
    used, cells = np.unique(kept, return_inverse=True)
    return Mesh(mesh.vertices_ras_mm[used], cells.reshape(-1, 3).astype(np.int32)), d[used]


@pytest.mark.parametrize(("time", "least"), [(3.0, 0.998), (8.0, 0.994), (30.0, 0.98)])
def test_open_patch_is_that_of_finite_elements(time, least):
    """No flux through the border: as by finite elements, and the mean stays. Noise falls to a tenth of the start."""
    lapy = pytest.importorskip("lapy")
    mesh, d = half_sphere()
    heat = finite_element_heat(mesh.vertices_ras_mm, mesh.cells)
    area = lapy.Solver(lapy.TriaMesh(mesh.vertices_ras_mm, mesh.cells), lump=True).mass.diagonal()
    noise = heat(np.random.default_rng(8).normal(size=len(d)), 4.0)
    for start, alike, most in ((noise, least, 0.4), (1.0 * (d[:, 0] > 0), 0.9998, 0.15), (d[:, 2], 0.998, 0.25)):
        start = start / start.std()
        result, expected = denoise(mesh, start, flow="l2", time=time).data, heat(start, time)
        assert np.corrcoef(result, expected)[0, 1] >= alike and apart(result, expected) <= most
        assert abs(area @ (result - start)) / area.sum() <= 0.08


@pytest.mark.slow
@pytest.mark.parametrize(("time", "least"), [(3.0, 0.998), (8.0, 0.997)])
def test_heat_flow_on_a_cortex_is_that_of_finite_elements(shared_data: Path, time, least):
    """White noise smoothed to 2 mm^2, everywhere on the patch, its border included."""
    from beltrami_cli.formats import read_surface

    mesh = read_surface(shared_data / "s1_individual" / "lh.mid.crop.surf.gii")
    heat = finite_element_heat(mesh.vertices_ras_mm, mesh.cells)
    start = heat(np.random.default_rng(0).normal(size=len(mesh.vertices_ras_mm)), 2.0)
    start = (start - start.mean()) / start.std()
    result, expected = denoise(mesh, start, flow="l2", time=time), heat(start, time)
    there = np.isfinite(result.data)
    assert (~there).sum() == 5  # vertices of no triangle
    assert np.corrcoef(result.data[there], expected[there])[0, 1] >= least
    assert apart(result.data[there], expected[there]) <= 0.6  # standard deviations of the start


# --- noise and choice -------------------------------------------------------------------------------------------------


def psnr(values: np.ndarray, d: np.ndarray) -> float:
    return float(10 * np.log10(100**2 / np.mean((values - pieces(d)) ** 2)))


@pytest.mark.parametrize("sigma", [20.0, 40.0])
def test_automatic_choice(sigma):
    """Against the best of all betas and iterations."""
    mesh, d = sphere(4)
    data = noisy(d, sigma)
    result = denoise(mesh, data, stop="auto")
    assert result.warnings == ()
    assert result.record["Noise"]["sd"][0] == pytest.approx(sigma, rel=0.07)
    curves = [searched(mesh, d, data, beta) for beta in (0.04, 0.08, 0.16, 0.32)]
    # Of a map with details of a few edges: what is held out there cannot be told from its neighbours.
    assert psnr(result.data, d) >= max(map(max, curves)) - 1.0


def searched(mesh: Mesh, d: np.ndarray, data: np.ndarray, beta: float) -> list[float]:
    """PSNR after 2, 4, 8 ... 64 iterations."""
    return [psnr(denoise(mesh, data, beta=beta, iterations=2**k).data, d) for k in range(1, 7)]


def test_beta_is_chosen_for_the_iterations_given():
    mesh, d = sphere(4)
    data = noisy(d, 40)
    result = denoise(mesh, data, iterations=20)
    best = max(psnr(denoise(mesh, data, beta=beta, iterations=20).data, d) for beta in (0.02, 0.04, 0.08, 0.16, 0.32))
    assert psnr(result.data, d) >= best - 0.5


def test_noise_from_a_coarser_mesh_is_doubted():
    mesh, d = sphere(4)
    coarse, _ = sphere(3)
    values = 40 * np.random.default_rng(9).normal(size=len(coarse.vertices_ras_mm))
    apiece, near = nearest_two(coarse.vertices_ras_mm, mesh.vertices_ras_mm)
    data = pieces(d) + np.where(apiece < 1e-3, values[near[:, 0]], values[near].mean(1))
    result = denoise(mesh, data, iterations=5)
    assert len(result.warnings) == 1 and "looks correlated" in result.warnings[0]


def nearest_two(points: np.ndarray, queries: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    from scipy.spatial import cKDTree

    distance, near = cKDTree(points).query(queries, k=2)
    return distance[:, 0], near


# --- other meshes of the surface --------------------------------------------------------------------------------------


def test_on_the_same_mesh(run):
    mesh, _, data, result = run
    again = denoise(mesh, data, on=[mesh], **RUN)
    assert np.array_equal(again.on[0], again.mesh.values) and np.array_equal(again.data, result.data)


@pytest.mark.parametrize("off", [1.0, -1.0])
def test_on_a_mesh_beside_the_surface(off):
    """Values are constant along normals, so 1 mm off (a third of a voxel) they are those of the surface."""
    mesh, d = sphere(3)
    data = 100 * d[:, 2] * d[:, 0] + 50 * d[:, 1]
    result = denoise(mesh, data, beta=0.02, iterations=8, on=[sphere(3, RADIUS + off)[0]])
    assert apart(result.on[0], result.data) <= 0.01 * np.ptp(data) and result.warnings == ()


def test_on_a_finer_mesh_and_in_its_order():
    """The heat flow of x z, which decays as Y_20 does."""
    mesh, d = sphere(4)
    fine, at = sphere(5)
    order = np.random.default_rng(10).permutation(len(at))
    shuffled = Mesh(fine.vertices_ras_mm[order], np.argsort(order)[fine.cells].astype(np.int32))
    dt = 0.1
    result = denoise(mesh, d[:, 2] * d[:, 0], flow="l2", dt=dt, iterations=120, on=[fine, shuffled])
    assert apart(result.on[0], (1 - 6 * dt / RADIUS**2) ** 120 * at[:, 2] * at[:, 0]) <= 0.004
    assert np.array_equal(result.on[1], result.on[0][order])


def test_on_kinds():
    mesh, d = sphere(2)
    angles = np.degrees(np.arctan2(d[:, 1], d[:, 0]))
    on = denoise(mesh, angles, kind="circular", period=360, iterations=2, beta=0.0, on=[mesh]).on[0]
    assert on.min() >= -180 and on.max() < 180
    options = {"kind": "vector", "iterations": 2, "beta": 1.0, "on": [mesh]}
    assert denoise(mesh, d, **options).on[0].shape == denoise(mesh, d, independent=True, **options).on[0].shape
    assert denoise(mesh, d[:, 0] + 1j * d[:, 1], **options).on[0].shape == (162, 2)


def test_on_a_mesh_that_is_partly_elsewhere():
    mesh, d = sphere(3)
    moved = Mesh(mesh.vertices_ras_mm + np.array([14, 0, 0]), mesh.cells)
    result = denoise(mesh, 100 * d[:, 2], flow="l2", iterations=2, on=[moved])
    off = np.abs(np.linalg.norm(moved.vertices_ras_mm - CENTRE, axis=1) - RADIUS)
    width = result.record["Band"]["half_width_mm"]
    lost = np.isnan(result.on[0])
    assert lost[off > width + 3].all() and not lost[off < width - 1].any() and lost.sum() > 10
    assert result.warnings == (f"on: {lost.sum()} of 642 vertices lie beyond the band: they get no value",)


def test_on_a_mesh_that_is_elsewhere():
    mesh, d = sphere(2)
    with pytest.raises(DataError, match="none of the 162 vertices lies within"):
        denoise(mesh, d[:, 2], iterations=2, beta=1.0, on=[Mesh(mesh.vertices_ras_mm + 200, mesh.cells)])


def sheet(height: float, up: bool, shift: float = 0.0) -> Mesh:
    """A square of 31 x 31 vertices 1 mm apart, facing up or down."""
    x, y = (a.ravel() + shift for a in np.mgrid[:31, :31].astype(float))
    i = np.arange(31 * 31).reshape(31, 31)
    a, b, c, d = (part.ravel() for part in (i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]))
    cells = np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)
    return Mesh(np.stack([x, y, np.full_like(x, height)], 1), cells if up else cells[:, ::-1])


@pytest.mark.parametrize("thick", [0.3, 1.0, 2.0])
@pytest.mark.parametrize("outward", [2.0, 1.0, 0.0, -0.1])
def test_on_a_slab_every_vertex_takes_its_own_bank(thick, outward):
    """Wherever it is nearer to its own, be the other one only 0.1 mm farther."""
    slab = joined(sheet(0, up=False), sheet(thick, up=True))
    others = joined(sheet(-outward, up=False, shift=0.37), sheet(thick + outward, up=True, shift=0.37))
    data = np.repeat([0.0, 100.0], 31 * 31)
    result = denoise(slab, data, flow="l2", iterations=20, on=[others])
    assert np.array_equal(result.on[0], data) and np.array_equal(result.data, data)


@pytest.mark.parametrize("outward", [1.2, 0.0, -1.2])
def test_on_a_mesh_that_faces_the_other_way(outward):
    """As a whole, and where the level set has the other sign: what it sees is the same."""
    mesh, d = sphere(3)
    other = Mesh(CENTRE + (RADIUS + outward) * d, mesh.cells)
    data = 100 * d[:, 2]
    first, second = (
        denoise(mesh, data, flow="l2", iterations=5, on=[Mesh(other.vertices_ras_mm, cells)]).on[0]
        for cells in (other.cells, other.cells[:, ::-1])
    )
    assert np.isfinite(first).all() and np.array_equal(first, second)


# --- what makes no sense ----------------------------------------------------------------------------------------------

BALL, AT = sphere(1)
COUNT = len(AT)


def ball_with(vertex: float | None = None, cells: np.ndarray | None = None) -> Mesh:
    ras_mm = BALL.vertices_ras_mm.copy()
    if vertex is not None:
        ras_mm[3, 1] = vertex
    return Mesh(ras_mm, BALL.cells if cells is None else cells)


@pytest.mark.parametrize(
    ("data", "options", "says"),
    [
        (AT[:-1, 2], {}, r"found the shape \(41,\); expected \(42,\)"),
        (AT, {}, r"or \(V, K\) with kind='vector'"),
        (AT[:, :1], {}, r"or \(V, K\) with kind='vector'"),
        (AT[:, 2], {"kind": "vector"}, r"expected \(42, K\)"),
        (AT[:, 2], {"kind": "vector", "independent": True}, r"expected \(42, K\)"),
        (AT[:, 2], {"affine": np.eye(4)}, "affine: .* drop it"),
        (AT[:, 2], {"spacing": (1, 1, 2)}, "spacing: .* one number"),
        (AT[:, 2], {"spacing": 1e-3}, "spacing: .* at most"),
        (AT[:, 2], {"weights": np.ones(41)}, r"weights: found the shape \(41,\)"),
        (AT[:, 2], {"mask": np.ones((42, 1))}, r"mask: found the shape \(42, 1\)"),
        (AT[:, 2], {"flat": True}, "levelset"),
        (AT[:, 2], {"depth": (-2, 2)}, "depth"),
        (AT[:, 2], {"extension": "pde"}, "extension"),
        (AT[:, 2], {"on": BALL}, "on: .* list"),
        (np.zeros((40, 40)), {}, r"expected \(42,\)"),
        (np.zeros((40, 40, 1)), {}, "plane|volume"),
        (np.zeros((9, 9, 9, 2)), {}, "kind='vector'|axes"),
    ],
)
def test_refused(data, options, says):
    with pytest.raises(RefusedError, match=says):
        denoise(BALL, data, **{"beta": 1.0, "iterations": 1, **options})


@pytest.mark.parametrize(
    "mesh",
    [
        ball_with(np.nan),
        ball_with(np.inf),
        ball_with(cells=BALL.cells[:, :2]),
        ball_with(cells=BALL.cells[:0]),
        Mesh(np.zeros_like(BALL.vertices_ras_mm), BALL.cells),
    ],
    ids=["nan", "inf", "segments", "no triangles", "a point"],
)
def test_no_mesh(mesh):
    """As LEVELSET, and as a mesh to give values to."""
    with pytest.raises((DataError, RefusedError), match=r"triangle|vertex|vertices"):
        denoise(mesh, AT[:, 2], beta=1.0, iterations=1)
    if len(mesh.cells) and mesh.vertices_ras_mm.any():
        with pytest.raises((DataError, RefusedError), match=r"triangle|vertex|vertices"):
            denoise(BALL, AT[:, 2], beta=1.0, iterations=1, on=[mesh])


@pytest.mark.parametrize("cells", [BALL.cells + 5, BALL.cells - 5, BALL.cells + 0.5, BALL.cells[:, :1]])
def test_cells_that_name_no_vertices(cells):
    with pytest.raises(RefusedError, match=r"vertices|\(C, 3\)"):
        ball_with(cells=cells)


@pytest.mark.parametrize("levelset", ["lh.white", trimesh.creation.icosphere(1)])
def test_no_level_set(levelset):
    for data in (AT[:, 2], np.zeros((9, 9, 9))):
        with pytest.raises(RefusedError, match=r"levelset: .*expected an array or a Mesh"):
            denoise(levelset, data, beta=1.0, iterations=1)


# --- a real map whose truth is known ----------------------------------------------------------------------------------


@pytest.mark.slow
def test_vertex_data_are_as_good_as_volumes(cases: ModuleType, shared_data: Path, monkeypatch):  # noqa: F811
    """Polar angle, noise at the vertices: through the mesh, and painted into a volume and back, within 0.3 degrees."""
    import onmesh

    case = onmesh.vertex_case()
    at_vertices, through_volume = (case.score(way(case, **onmesh.GIVEN)) for way in (onmesh.on_mesh, onmesh.painted))
    assert at_vertices <= through_volume + 0.3
    assert at_vertices <= 6.6
    assert case.score(onmesh.on_mesh(case, stop="auto")) <= 6.6
