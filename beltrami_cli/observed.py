"""Data where they were measured: at the voxels of a band, or at the vertices of a mesh.

A flow runs on the band's entries. What says where it starts from, what it is compared with, which data may be held out,
and how noisy they are, is here.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol

import numpy as np

from beltrami_cli.band import Band, band_around
from beltrami_cli.extension import Extended, extend, from_vertices
from beltrami_cli.geodesic import distance_along, distance_over
from beltrami_cli.grid import Grid
from beltrami_cli.kernels import mesh as kernels
from beltrami_cli.kinds import Kind
from beltrami_cli.levelset import Refined, facing, refined
from beltrami_cli.noise import (
    ENTRIES,
    looks_correlated,
    looks_correlated_on_mesh,
    noise_sd,
    noise_sd_on_mesh,
    smoothness_mm,
    smoothness_on_mesh,
)
from beltrami_cli.sampling import SurfacePoints
from beltrami_cli.surface import Mesh, edges_of

# Half of the valid voxels 1 to 2 voxels from the surface are held out. Nearer ones make the start values, which would
# miss them: where one is held out the flow has a gap to fill, and longer runs win that are too long for all data. Where
# the shell's own voxels enter the start (averages over depth), or data end before it, a smaller share has to do.
SHELL = (1.0, 2.0)
SHELL_SHARE, NEAR_SHARE = 0.5, 0.15
FLAT_SHARE = 0.05  # without a surface every voxel is its own start value: few and far between
VERTEX_SHARE = 0.15  # every vertex makes start values too


class Observed(Protocol):
    """Data (K, N) at N places, as channels; NaN in all of them where there are none.

    trust: (N,) weights in 0..1, 0 where missing. noun: what the places are.
    """

    @property
    def kind(self) -> Kind: ...
    @property
    def values(self) -> np.ndarray: ...
    @property
    def trust(self) -> np.ndarray: ...
    @property
    def noun(self) -> str: ...

    def start(self) -> Extended:
        """The values on the band from which a flow starts; raises DataError where there are none."""

    def without(self, held: np.ndarray) -> Observed:
        """The data but those at places `held` (H,)."""

    def seen(self, which: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        """What gives the values (K, n) of a band's (K, E) at the places `which` (n,)."""

    def beyond(self, start: Extended) -> np.ndarray:
        """(E,) bool: entries that are to stay missing, farther than `fill` mm along the surface from valid data."""

    def near(self) -> np.ndarray:
        """Valid places (n,) on the surface, where input and output show the same."""

    def can_hold_out(self) -> tuple[np.ndarray, int]:
        """Places (n,) whose data may be held out, and how many of them to hold out."""

    def noise_sd(self, u: np.ndarray | None = None) -> np.ndarray:
        """As `noise.noise_sd`, of the data, or, where there are data, of the band's values u (K, E) in their place."""

    def smoothness_mm(self, u: np.ndarray | None = None) -> float:
        """As `noise.smoothness_mm`, of the data, or of the band's values u (K, E) in their place."""

    def looks_correlated(self) -> bool:
        """As `noise.looks_correlated`."""


@dataclass(frozen=True, eq=False)
class AtVoxels:
    """Data at the entries that voxels belong to (`extension.own_samples`): values (K, E), trust (E,).

    extension, depth: see `extension.extend`. fill: mm, see `config.Settings`.
    """

    band: Band
    kind: Kind
    values: np.ndarray
    trust: np.ndarray
    extension: str = "closest-point"
    depth: tuple[float, float] | None = None
    fill: float | None = None
    noun = "voxels"

    def start(self) -> Extended:
        return extend(self.band, self.values, self.trust, self.extension, depth=self.depth, turns=self.kind.turns)

    def without(self, held: np.ndarray) -> AtVoxels:
        values, trust = _emptied(self, held)
        return replace(self, values=values, trust=trust)

    def seen(self, which: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        return lambda u: u[:, which]

    def beyond(self, start: Extended) -> np.ndarray:
        if self.fill is None or start.known.all():
            return np.zeros(self.band.entries, bool)
        return (distance_along(self.band, start.known, self.fill) > self.fill) & ~start.known

    def near(self) -> np.ndarray:
        """Those within half a voxel of the surface."""
        close = np.abs(self.band.distance) <= 0.5 * self.band.grid.used_spacing.max()
        return np.flatnonzero((self.trust > 0) & close)

    def can_hold_out(self) -> tuple[np.ndarray, int]:
        band, trust = self.band, self.trust
        if band.surface is None:
            valid = np.flatnonzero(trust > 0)
            return valid, round(FLAT_SHARE * len(valid))
        voxels = np.abs(band.distance) / band.grid.used_spacing.max()
        inner = np.flatnonzero((trust > 0) & (voxels < SHELL[0]))
        shell = np.flatnonzero((trust > 0) & (voxels >= SHELL[0]) & (voxels < SHELL[1]))
        valid = shell if len(shell) > len(inner) / 2 else inner
        share = SHELL_SHARE if valid is shell and self.depth is None else NEAR_SHARE
        return valid, round(share * len(valid))

    def noise_sd(self, u: np.ndarray | None = None) -> np.ndarray:
        if u is None:
            return noise_sd(self.band, self.values, self.kind)
        # What is left is told, and nothing chosen by it: 2 % will do, in a quarter of the time.
        return noise_sd(self.band, np.where(np.isnan(self.values), np.nan, u), self.kind, ENTRIES // 4)

    def smoothness_mm(self, u: np.ndarray | None = None) -> float:
        return smoothness_mm(self.band, self.values if u is None else u, self.kind)

    def looks_correlated(self) -> bool:
        return looks_correlated(self.band, self.values, self.kind)


class VertexBand:
    """The band around a mesh (V vertices, RAS mm), and where on the mesh every entry's closest point is.

    Raises DataError where the mesh cannot carry a band on this grid, or lies outside of it.
    """

    def __init__(self, mesh: Mesh, grid: Grid, half_width: float) -> None:
        self.mesh = mesh
        self.refined: Refined = refined(mesh, grid)
        self.band = band_around(self.refined.surface, grid, half_width)
        surface = self.band.surface
        assert surface is not None
        count = len(mesh.vertices_ras_mm)
        self.cells = facing(mesh.cells, grid)
        self.points = surface.points[:count]
        self.vertices = SurfacePoints(self.band, self.points / grid.spacing, np.arange(count))
        used = np.zeros(count, bool)
        used[mesh.cells] = True
        self.vertices.start[~used] = self.vertices.origin[~used] = -1

    @property
    def reached(self) -> np.ndarray:
        """(V,) bool: the vertices that lie in the grid and belong to a triangle."""
        return self.vertices.start >= 0

    @cached_property
    def edges(self) -> np.ndarray:
        """(N, 2) of the mesh."""
        return edges_of(self.mesh.cells)

    @property
    def edge_lengths(self) -> np.ndarray:
        """(N,) mm."""
        return np.linalg.norm(np.subtract(*np.moveaxis(self.points[self.edges], 1, 0)), axis=1)

    def on_faces(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices (E, 3) of the refined mesh and their weights (E, 3) at every entry's closest point."""
        band, surface = self.band, self.refined.surface
        here = np.stack(np.unravel_index(band.voxel, band.box_shape), 1) + band.closest_offset.T
        assert band.surface is not None
        around = kernels.faces_around(surface.cells, len(surface.points))
        return kernels.nearest_on_faces(
            here * band.grid.spacing, band.vertex, band.surface.points, surface.cells, *around
        )


@dataclass(frozen=True, eq=False)
class AtVertices:
    """Data at the vertices of the mesh that a band is around: values (K, V), trust (V,).

    corners, weights: of `VertexBand.on_faces`. fill: mm, see `config.Settings`.
    """

    on: VertexBand
    corners: np.ndarray
    weights: np.ndarray
    kind: Kind
    values: np.ndarray
    trust: np.ndarray
    fill: float | None = None
    noun = "vertices"

    def start(self) -> Extended:
        values, trust = self.on.refined.carry(self.values, self.trust)
        return from_vertices(self.on.band, self.corners, self.weights, values, trust, turns=self.kind.turns)

    def without(self, held: np.ndarray) -> AtVertices:
        values, trust = _emptied(self, held)
        return replace(self, values=values, trust=trust)

    def seen(self, which: np.ndarray) -> Callable[[np.ndarray], np.ndarray]:
        points, turns = self.on.vertices.some(which), self.kind.turns
        return lambda u: points(u, turns=turns)

    @cached_property
    def too_far(self) -> np.ndarray:
        """(V',) bool: vertices of the refined mesh, those of the mesh first, that `fill` leaves without a value."""
        valid = self.trust > 0
        for ends in self.on.refined.edges:
            valid = np.concatenate([valid, valid[ends].all(1)])
        if self.fill is None:
            return np.zeros(len(valid), bool)
        return distance_over(self.on.refined.surface, np.flatnonzero(valid), self.fill) > self.fill

    def beyond(self, start: Extended) -> np.ndarray:
        # An entry with one corner within reach is part of what that vertex shows.
        return self.too_far[self.corners].all(1)

    def near(self) -> np.ndarray:
        return np.flatnonzero(self.trust > 0)

    def can_hold_out(self) -> tuple[np.ndarray, int]:
        valid = self.near()
        return valid, round(VERTEX_SHARE * len(valid))

    def noise_sd(self, u: np.ndarray | None = None) -> np.ndarray:
        values = self.values
        if u is not None:
            values = np.where(np.isnan(values), np.nan, self.on.vertices(u, turns=self.kind.turns))
        return noise_sd_on_mesh(self.on.cells, values, self.kind)

    def smoothness_mm(self, u: np.ndarray | None = None) -> float:
        values = self.values if u is None else self.on.vertices(u, turns=self.kind.turns)
        return smoothness_on_mesh(self.on.points, self.on.edges, values, self.kind)

    def looks_correlated(self) -> bool:
        start, ring = kernels.half_edges(self.on.cells, len(self.on.points))
        return looks_correlated_on_mesh(self.on.points, start, ring, self.values, self.kind)


def _emptied(observed: Observed, held: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values and trust without those at places `held`."""
    values, trust = observed.values.copy(), observed.trust.copy()
    values[:, held], trust[held] = np.nan, 0
    return values, trust
