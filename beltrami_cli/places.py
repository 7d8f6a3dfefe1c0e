"""Where data come from and results go to: the voxels of a volume, or the vertices of a mesh."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from beltrami_cli.band import Band
from beltrami_cli.extension import Extended, own_samples
from beltrami_cli.grid import Canonical
from beltrami_cli.kinds import Kind
from beltrami_cli.observed import AtVertices, AtVoxels, Observed, VertexBand


@dataclass(frozen=True, eq=False)
class Voxels:
    """The voxels of the band's grid, its axes brought to those of the band by `axes`.

    extension, depth, fill, outside: see `config.Settings`.
    """

    band: Band
    axes: Canonical
    extension: str
    depth: tuple[float, float] | None
    fill: float | None
    outside: str

    def take(self, volume: np.ndarray) -> np.ndarray:
        """(E, ...) values of a volume at the entries' voxels."""
        return self.band.gather(self.axes.forth(volume))

    def observe(self, here: np.ndarray, kind: Kind, trust: np.ndarray) -> Observed:
        """What was taken, `here` (E, ...) of weights `trust` (E,), as channels of the entries that it belongs to."""
        own = own_samples(self.band, kind.to_channels(here), every=self.extension == "none")
        return AtVoxels(self.band, kind, *_trusted(own, trust), self.extension, self.depth, self.fill)

    def give(self, values: np.ndarray, at: list[np.ndarray], kind: Kind, given: np.ndarray) -> np.ndarray:
        """The band's values (K, E) as a volume in the shape and kind of the `given` one; `at` is for `Vertices`."""
        out = kind.to_values(values)
        nan = complex(np.nan, np.nan) if np.iscomplexobj(out) else np.nan
        outside: dict[str, np.ndarray | complex] = {"nan": nan, "zero": 0.0, "keep": self.axes.forth(given)}
        return self.axes.back(self.band.scatter(out, outside[self.outside]))

    def filled(self, values: np.ndarray, at: list[np.ndarray], start: Extended, observed: Observed) -> np.ndarray:
        """bool volume: where there is a value (K, E), though the data around gave none."""
        return self.axes.back(self.band.scatter(~start.known & ~np.isnan(values[0]), 0.0))


@dataclass(frozen=True, eq=False)
class Vertices:
    """The vertices of the mesh that the band is around. fill: mm, see `config.Settings`."""

    on: VertexBand
    fill: float | None

    def take(self, values: np.ndarray) -> np.ndarray:
        """The values (V, ...) themselves."""
        return values.copy()

    def observe(self, here: np.ndarray, kind: Kind, trust: np.ndarray) -> Observed:
        """Values `here` (V, ...) of weights `trust` (V,) as channels."""
        trust = np.where(self.on.reached, trust, 0)
        return AtVertices(self.on, *self._faces, kind, *_trusted(kind.to_channels(here).copy(), trust), self.fill)

    @cached_property
    def _faces(self) -> tuple[np.ndarray, np.ndarray]:
        return self.on.on_faces()

    def give(self, values: np.ndarray, at: list[np.ndarray], kind: Kind, given: np.ndarray) -> np.ndarray:
        """(V, ...) the values at the vertices, the first of `at` (K, V), in the kind of the `given` ones."""
        return kind.to_values(at[0])

    def filled(self, values: np.ndarray, at: list[np.ndarray], start: Extended, observed: Observed) -> np.ndarray:
        """(V,) bool: vertices that have a value now and had none, or none that counts."""
        return (observed.trust == 0) & ~np.isnan(at[0][0])


def _trusted(values: np.ndarray, trust: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Values (K, N), NaN where not trusted, and weights (N,), 0 where missing."""
    trust = np.where(np.isnan(values[0]), 0, trust).astype(values.dtype)
    values[:, trust == 0] = np.nan
    return values, trust
