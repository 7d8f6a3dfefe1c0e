"""Noisy maps on real cortex whose truth is known at the vertices of a mesh, and their scores.

Two surfaces of ../shared/data: polar angle on `retino_fsaverage`, a patch with a sharp border on `s1_individual`.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import nibabel as nib
import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra
from scipy.spatial import cKDTree

from beltrami_cli.formats import read_volume
from beltrami_cli.grid import Grid, Volume
from beltrami_cli.kinds import Kind
from beltrami_cli.metrics import difference, wrapped

DATA = Path(__file__).resolve().parents[2] / "shared" / "data"
DEGREES = Kind("circular", 360.0)

PAINTED = 4.0  # mm; data lie in the voxels this near to the surface, as in the given volumes
HOLES = {0.6: 45, 1.0: 10}  # by noise; so many that Workbench's best without the ribbon is about 10 degrees
HOLE_RADII = (2.5, 6.0)  # mm
OUTLIERS = 0.05  # share of the voxels whose angle is anything at all
STEP, STEP_NOISE = 100.0, 50.0  # height of the patch and standard deviation of the noise in a voxel
PATCH_RADII = 3 * (6.0, 8.0, 10.0, 12.0, 14.0)  # mm along the surface; together an eighth of it
FROM_BORDER, FROM_FACES = 6.0, 6.0  # mm and voxels; nearer vertices are not scored, the surface ends there


@dataclass(frozen=True, eq=False)
class Case:
    """Noisy data on a surface.

    levelset, surface: the files of Psi and of the mesh. volume: the noisy data, NaN where missing.
    truth: (V,) at the mesh's vertices, NaN where not scored. kind: scalar, or angles in degrees.
    """

    name: str
    levelset: Path
    surface: Path
    volume: Volume
    truth: np.ndarray
    kind: Kind

    @cached_property
    def mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """(V, 3) vertices in RAS mm and (C, 3) triangles."""
        return read_surface(self.surface)

    @property
    def unit(self) -> str:
        return "degrees" if self.kind.is_circular else "dB"

    def score(self, values: np.ndarray) -> float:
        """Mean absolute error in degrees, or PSNR in dB over the height of the step, of values (V,) at the vertices.

        A vertex without a value counts as wrong by a quarter turn, or by the step.
        """
        scored = np.isfinite(self.truth)
        if self.kind.is_circular:
            error = np.abs(wrapped(values[scored] - self.truth[scored], self.kind.period))
            return float(np.where(np.isfinite(error), error, self.kind.period / 4).mean())
        got = np.where(np.isfinite(values), values, STEP - self.truth)
        return difference(self.truth, got, data_range=STEP).psnr

    def better(self, score: float, other: float) -> bool:
        return score < other if self.kind.is_circular else score > other

    def score_mesh(self, surface: Path) -> float:
        """The score of a result's mesh NAME.surf.gii with its values in NAME.func.gii beside it."""
        values = nib.load(surface.with_name(surface.name.replace(".surf.gii", ".func.gii"))).darrays[0].data
        return self.score(self.at_own_vertices(*read_surface(surface), values))

    def at_own_vertices(self, vertices: np.ndarray, triangles: np.ndarray, values: np.ndarray) -> np.ndarray:
        """(V,) values of another mesh of the same surface at this one's vertices; angles as cos and sin."""
        corners, weights = barycentric(vertices, triangles, self.mesh[0])
        channels = self.kind.to_channels(values.astype(float))[:, corners]
        weights = np.where(np.isnan(channels[0]), 0, weights)
        with np.errstate(invalid="ignore"):
            mean = (np.nan_to_num(channels) * weights).sum(-1) / weights.sum(-1)
        return self.kind.to_values(mean)


def angle_cases(seed: int = 0) -> list[Case]:
    """Polar angle in degrees: the given volumes at noise 0.3 and 0.6, and ones made from the clean volume like them."""
    given = [angle_case(f"angle-{s}", retino(f"angle_noisy_voxel_s{s}")) for s in (0.3, 0.6)]
    clean = retino("angle_clean")
    made = [angle_case("angle-1.0", clean.with_data(with_noise(clean.data, 1.0, seed)))]
    for noise in HOLES:
        broken = with_holes(with_outliers(with_noise(clean.data, noise, seed), seed), clean.grid, HOLES[noise], seed)
        made.append(angle_case(f"angle-{noise}-holes", clean.with_data(broken)))
    return [*given, *made]


def angle_case(name: str, volume: Volume) -> Case:
    folder = DATA / "retino_fsaverage"
    return Case(name, folder / "psi.nii.gz", folder / "lh.crop.surf.gii", volume, angle_truth(), DEGREES)


def angle_truth() -> np.ndarray:
    """(V,) clean angle in degrees at the vertices, NaN outside the visual areas."""
    maps = nib.load(DATA / "retino_fsaverage" / "lh.crop.func.gii").darrays
    return next(m.data for m in maps if m.meta["Name"] == "angle_clean").astype(float)


def retino(name: str) -> Volume:
    return read_volume(DATA / "retino_fsaverage" / f"{name}.nii.gz")


def with_noise(angle: np.ndarray, noise: float, seed: int) -> np.ndarray:
    """arg(exp(i a) + s (n1 + i n2)) in every voxel, degrees."""
    random = np.random.default_rng(seed)
    n1, n2 = random.standard_normal((2, *angle.shape))
    turned = np.exp(1j * np.radians(angle)) + noise * (n1 + 1j * n2)
    return (np.degrees(np.angle(turned)) % 360).astype(np.float32)


def with_outliers(angle: np.ndarray, seed: int) -> np.ndarray:
    random = np.random.default_rng([seed, 1])
    struck = random.random(angle.shape) < OUTLIERS
    return np.where(struck & np.isfinite(angle), random.uniform(0, 360, angle.shape), angle).astype(np.float32)


def with_holes(angle: np.ndarray, grid: Grid, holes: int, seed: int) -> np.ndarray:
    """Without the voxels in balls around scored vertices, radii uniform in `HOLE_RADII`."""
    random = np.random.default_rng([seed, 2])
    vertices, _ = read_surface(DATA / "retino_fsaverage" / "lh.crop.surf.gii")
    centres = random.choice(vertices[np.isfinite(angle_truth())], holes, replace=False)
    voxels = np.argwhere(np.isfinite(angle))
    inside = cKDTree(grid.to_world(voxels)).query_ball_point(centres, random.uniform(*HOLE_RADII, holes))
    out = angle.copy()
    out[tuple(voxels[np.unique(np.concatenate(inside)).astype(int)].T)] = np.nan
    return out


def patch_case(seed: int = 0) -> Case:
    """Discs of 100 on 0 on a cortex with tight sulci, painted by nearest vertex, with noise of 50 in every voxel."""
    folder = DATA / "s1_individual"
    psi, surface = read_volume(folder / "psi.nii.gz"), folder / "lh.mid.crop.surf.gii"
    vertices, triangles = read_surface(surface)
    inner = away_from_ends(vertices, triangles, psi.grid)
    truth = np.where(geodesic_discs(vertices, triangles, inner, seed), STEP, 0.0)

    near = np.argwhere(np.abs(psi.data) < PAINTED + 1)  # Psi is a distance; the mesh's is what counts
    apart, nearest = cKDTree(vertices).query(psi.grid.to_world(near))
    noise = STEP_NOISE * np.random.default_rng(seed).standard_normal(len(near))
    data = np.full(psi.grid.shape, np.nan, np.float32)
    data[tuple(near.T)] = np.where(apart < PAINTED, truth[nearest] + noise, np.nan)
    scored = np.where(inner, truth, np.nan)
    return Case("patch", folder / "psi.nii.gz", surface, psi.with_data(data), scored, Kind())


def geodesic_discs(vertices: np.ndarray, triangles: np.ndarray, inner: np.ndarray, seed: int) -> np.ndarray:
    """(V,) bool: within one of `PATCH_RADII` along the mesh's edges of centres drawn among the inner vertices."""
    edges = np.unique(edges_of(triangles), axis=0)
    lengths = np.linalg.norm(vertices[edges[:, 0]] - vertices[edges[:, 1]], axis=1)
    graph = coo_matrix((lengths, edges.T), (len(vertices), len(vertices))).tocsr()
    centres = np.random.default_rng([seed, 1]).choice(np.flatnonzero(inner), len(PATCH_RADII), replace=False)
    along = dijkstra(graph, directed=False, indices=centres, limit=max(PATCH_RADII))
    return np.asarray((along <= np.array(PATCH_RADII)[:, None]).any(0))


def away_from_ends(vertices: np.ndarray, triangles: np.ndarray, grid: Grid) -> np.ndarray:
    """(V,) bool: `FROM_BORDER` mm from the border of the mesh and `FROM_FACES` voxels from the volume's faces."""
    edges, times = np.unique(edges_of(triangles), axis=0, return_counts=True)
    border = cKDTree(vertices[np.unique(edges[times == 1])])
    ijk = grid.to_index(vertices)
    inside = np.all((ijk > FROM_FACES) & (ijk < np.array(grid.shape) - 1 - FROM_FACES), axis=1)
    return inside & (border.query(vertices)[0] > FROM_BORDER)


def edges_of(triangles: np.ndarray) -> np.ndarray:
    """(3 C, 2) edges of all triangles, the smaller vertex first; an edge within the surface comes twice."""
    return np.sort(np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]]), axis=1)


def read_surface(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """(V, 3) float64 vertices in RAS mm and (C, 3) triangles of a .surf.gii."""
    vertices, triangles = (array.data for array in nib.load(path).darrays)
    return vertices.astype(float), triangles


def barycentric(vertices: np.ndarray, triangles: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(N, 3) corners and weights of the points' projections on the nearest of the triangles around each.

    Candidates are the 12 triangles with the nearest centres; beyond a triangle's edge the weights are cut off at 0.
    """
    _, near = cKDTree(vertices[triangles].mean(1)).query(points, k=12)
    a, b, c = np.moveaxis(vertices[triangles[near]], 2, 0)  # (N, 12, 3) each
    p, e, f = points[:, None] - a, b - a, c - a
    ee, ef, ff, pe, pf = ((x * y).sum(-1) for x, y in ((e, e), (e, f), (f, f), (p, e), (p, f)))
    area = np.maximum(ee * ff - ef**2, 1e-12)  # mm^4; marching cubes leaves slivers
    second, third = (ff * pe - ef * pf) / area, (ee * pf - ef * pe) / area
    weights = np.maximum(np.stack([1 - second - third, second, third], -1), 0)
    weights /= weights.sum(-1, keepdims=True)
    apart = np.linalg.norm(p - weights[..., 1:2] * e - weights[..., 2:3] * f, axis=-1)
    row, best = np.arange(len(points)), apart.argmin(1)
    return triangles[near[row, best]], weights[row, best]
