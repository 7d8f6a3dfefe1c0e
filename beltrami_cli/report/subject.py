"""What a picture is about: a surface, the maps on it side by side, and the record of how one came from another."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from beltrami_cli.grid import Grid
from beltrami_cli.surface import Mesh


@dataclass(frozen=True, eq=False)
class Map:
    """One map: what it is called, and its values.

    values: (V,), or (V, K) of K channels, at the vertices of the subject's mesh, NaN where missing; None without a
    mesh. volume: (nx, ny, nz) or (nx, ny, nz, K) real, on the subject's grid, NaN where missing; None where the data
    are at vertices. filled: (V,) bool, vertices whose value was filled in; None where none was.
    """

    title: str
    values: np.ndarray | None
    volume: np.ndarray | None = None
    filled: np.ndarray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "title", _printable(self.title))


@dataclass(frozen=True, eq=False)
class Subject:
    """What is to be shown.

    maps: at least one, of one shape. mesh: triangles, or a polyline for a curve in a plane; None for a flat run; its
    own values are not used. grid: of the maps' volumes, None without any; its axes are those of RAS as nearly as they
    can be: the first points right, the second to anterior, the third up (of a plane, the first two span it).
    period: of angles, which lie in [low, low + period); None for other data. compares: the first of two maps less the
    second is shown too, under the name `difference`. record: the sidecar of the run that led from one to the other.
    side: from where a surface is seen first, a name in `geometry.SIDES`, None for where most of the data are seen.
    colours: the name of a colour map in place of the default. has_anatomy: the grid's axes are known to be those of a
    head; rows_down: of a plane, the first axis runs down and the second to the right, as in pictures. notes: lines on
    what is shown.
    """

    title: str
    maps: tuple[Map, ...]
    mesh: Mesh | None = None
    grid: Grid | None = None
    period: float | None = None
    low: float = 0.0
    compares: bool = False
    difference: str = "difference"
    record: Mapping[str, Any] | None = None
    side: str | None = None
    colours: str | None = None
    has_anatomy: bool = True
    rows_down: bool = False
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        object.__setattr__(self, "title", _printable(self.title))
        object.__setattr__(self, "notes", tuple(map(_printable, self.notes)))

    @property
    def is_curve(self) -> bool:
        return self.mesh is not None and self.mesh.cells.shape[1] == 2

    @property
    def channels(self) -> int:
        """How many channels a map has, K; 1 of maps without a channel axis."""
        first = self.maps[0]
        if first.values is not None:
            return first.values.shape[1] if first.values.ndim == 2 else 1
        assert first.volume is not None
        return first.volume.shape[3] if first.volume.ndim == 4 else 1

    def channel(self, k: int) -> Subject:
        """The same with one channel of each map, values (V,) and volume (nx, ny, nz)."""

        def one(shown: Map) -> Map:
            values, volume = shown.values, shown.volume
            return replace(
                shown,
                values=values[:, k] if values is not None and values.ndim == 2 else values,
                volume=volume[..., k] if volume is not None and volume.ndim == 4 else volume,
            )

        return replace(self, maps=tuple(one(shown) for shown in self.maps))

    def differences(self) -> np.ndarray:
        """The first map less the last, (N,) finite values at vertices, or voxels where there is no mesh.

        Of one channel; for angles the shorter way round.
        """
        ends = self.maps[0], self.maps[-1]
        first, last = (shown.volume if shown.values is None else shown.values for shown in ends)
        difference = np.ravel(self.between(first, last))
        return difference[np.isfinite(difference)]

    def between(self, first: np.ndarray | None, last: np.ndarray | None) -> np.ndarray:
        """Values of one map less those of another, for angles the shorter way round."""
        assert first is not None and last is not None
        difference = np.asarray(first, float) - last
        if self.period is not None:
            difference = (difference + self.period / 2) % self.period - self.period / 2
        return difference

    def in_one_range(self) -> Subject:
        """The same with all angles in [low, low + period), so that equal ones are equal numbers."""
        if self.period is None:
            return self
        low, period = self.low, self.period

        def wrapped(values: np.ndarray | None) -> np.ndarray | None:
            return None if values is None else low + (values - low) % period

        maps = (replace(each, values=wrapped(each.values), volume=wrapped(each.volume)) for each in self.maps)
        return replace(self, maps=tuple(maps))


def _printable(text: str) -> str:
    """A title with what is no text spelt out, as names of files may have it."""
    return text.encode("utf-8", "backslashreplace").decode("utf-8")
