"""A grid in world space (`Grid`) and values on it (`Volume`)."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from itertools import permutations
from typing import Any

import numpy as np

from beltrami_cli.errors import RefusedError

# Two grids are one when no corner is displaced by more than this share of the smallest voxel edge:
# well under what a difference could resolve, well above float32 rounding in stored headers.
CORNER_TOLERANCE = 1e-3

# Axes count as orthogonal up to this cosine between them (0.06 degrees: rounding in stored quaternions).
SHEAR_TOLERANCE = 1e-3

# Around a surface: 1 GB as float32, or a hemisphere at 0.2 mm.
MOST_VOXELS = 2**28


@dataclass(frozen=True, eq=False)
class Grid:
    """A regular voxel grid.

    shape: voxels along the three array axes (a plane has one axis of length 1).
    affine: (4, 4) float64, from voxel indices (i, j, k, 1) at voxel centres to RAS millimetres.
    """

    shape: tuple[int, int, int]
    affine: np.ndarray

    @staticmethod
    def from_spacing(shape: tuple[int, ...], spacing: float | tuple[float, ...] = 1.0) -> Grid:
        """Axis-aligned grid with its first voxel at the origin.

        shape: one to three axes; the missing ones get length 1.
        spacing: mm, one for all axes or one for each (two for a plane). Raises RefusedError for two on three axes.
        """
        nx, ny, nz = (*map(int, shape), 1, 1)[:3]
        if isinstance(spacing, tuple) and len(spacing) == 2 and nz > 1:
            raise RefusedError(
                f"spacing: found two numbers for three axes of {nx} x {ny} x {nz}; expected one or three"
            )
        edges = np.ones(3)
        edges[: len(spacing) if isinstance(spacing, tuple) else 3] = spacing
        return Grid((nx, ny, nz), np.diag([*edges, 1.0]))

    @staticmethod
    def around(ras_mm: np.ndarray, spacing: float, margin: float) -> Grid:
        """Cubic voxels along R, A and S around points (N, 3), with a margin in mm on every side.

        Raises RefusedError for more than MOST_VOXELS of them.
        """
        low, high = ras_mm.min(0) - margin, ras_mm.max(0) + margin
        counts = np.ceil((high - low) / spacing) + 1
        if counts.prod() > MOST_VOXELS:
            size = " x ".join(f"{x:.4g}" for x in np.ptp(ras_mm, axis=0))
            raise RefusedError(
                f"spacing: found voxels of {spacing:.4g} mm around a surface of {size} mm: {counts.prod():.3g}; "
                f"expected at most {MOST_VOXELS:.3g}: give a larger --spacing (is the surface in mm?)"
            )
        a, b, c = map(int, counts)
        affine = np.diag([spacing, spacing, spacing, 1.0])
        affine[:3, 3] = (low + high - spacing * (counts - 1)) / 2
        return Grid((a, b, c), affine)

    @property
    def spacing(self) -> np.ndarray:
        """(3,) voxel edge lengths in mm."""
        return np.asarray(np.linalg.norm(self.affine[:3, :3], axis=0))

    @property
    def used_spacing(self) -> np.ndarray:
        """(n,) voxel edge lengths in mm of the axes that have more than one voxel: two of them in a plane."""
        return self.spacing[np.array(self.shape) > 1]

    @property
    def handedness(self) -> int:
        """+1 where the index axes form a right-handed frame in RAS, -1 where left-handed."""
        return 1 if np.linalg.det(self.affine[:3, :3]) > 0 else -1

    def is_sheared(self) -> bool:
        """True where the voxel axes are not orthogonal: differences along them would then not be a gradient."""
        axes = self.affine[:3, :3] / self.spacing
        return bool(np.abs(axes.T @ axes - np.eye(3)).max() > SHEAR_TOLERANCE)

    def to_world(self, ijk: np.ndarray) -> np.ndarray:
        """Points (N, 3) in voxel indices to RAS mm."""
        return np.asarray(ijk @ self.affine[:3, :3].T + self.affine[:3, 3])

    def to_index(self, ras_mm: np.ndarray) -> np.ndarray:
        """Points (N, 3) in RAS mm to voxel indices."""
        return np.linalg.solve(self.affine[:3, :3], (ras_mm - self.affine[:3, 3]).T).T

    def matches(self, other: Grid) -> bool:
        """Same shape, and every corner at the same place within `CORNER_TOLERANCE`."""
        return self.shape == other.shape and self.apart(other) <= CORNER_TOLERANCE * self.spacing.min()

    def apart(self, other: Grid) -> float:
        """How far a corner of this grid is in mm, at most, from the same corner of another of the same shape."""
        return float(np.linalg.norm(self.corners() - other.corners(), axis=1).max())

    def corners(self) -> np.ndarray:
        """(8, 3) centres of the outermost voxels in RAS mm."""
        ends = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)])
        return self.to_world(ends * (np.array(self.shape) - 1))

    def as_record(self) -> dict[str, Any]:
        """JSON-ready, for the records beside outputs."""
        return {
            "shape": list(self.shape),
            "spacing_mm": self.spacing.tolist(),
            "affine_ras_mm": self.affine.tolist(),
        }

    def describe(self) -> str:
        """One line: shape, spacing, orientation matrix and origin, for messages."""
        steps = " x ".join(f"{s:.4g}" for s in self.spacing)
        rows = "; ".join(" ".join(f"{v:.5g}" for v in row) for row in self.affine[:3])
        return f"{' x '.join(map(str, self.shape))} voxels of {steps} mm, affine [{rows}]"


class Canonical:
    """Brings voxel axes into one order and direction, and back: towards R, A, S, a plane's missing axis last.

    How a volume is stored must not show in what is computed from it: which way marching cubes halves a quad, which of
    two equals comes first and where seeded draws fall all go by the order of the voxels.

    grid: the same voxels with their axes in that order.
    """

    def __init__(self, grid: Grid) -> None:
        axes = grid.affine[:3, :3] / grid.spacing
        # The world axis that each voxel axis is nearest to, no two the same one.
        world = max(permutations(range(3)), key=lambda nearest: sum(abs(axes[w, v]) for v, w in enumerate(nearest)))
        self._order = sorted(range(3), key=lambda v: (grid.shape[v] == 1, world[v]))
        self._flips = tuple(k for k, v in enumerate(self._order) if axes[world[v], v] < 0)
        a, b, c = (grid.shape[v] for v in self._order)
        affine = grid.affine[:, [*self._order, 3]]
        for k in self._flips:
            affine[:, 3] += affine[:, k] * ((a, b, c)[k] - 1)
            affine[:, k] *= -1
        self.grid = Grid((a, b, c), affine)

    def forth(self, array: np.ndarray) -> np.ndarray:
        """A view of values (nx, ny, nz, ...) on the grid as given, with their axes as those of `self.grid`."""
        return np.flip(array.transpose(*self._order, *range(3, array.ndim)), self._flips)

    def back(self, array: np.ndarray) -> np.ndarray:
        """The reverse of `forth`."""
        return np.flip(array, self._flips).transpose(*np.argsort(self._order), *range(3, array.ndim))


def extent(ras_mm: np.ndarray) -> str:
    """The box around points (N, 3) in RAS mm, for messages: `-5.1..11.7 x 0..3.25 x 1..2 mm`."""
    ends = zip(ras_mm.min(0), ras_mm.max(0), strict=True)
    return " x ".join(f"{low:.4g}..{high:.4g}" for low, high in ends) + " mm"


def require_same_grid(first: Grid, first_name: str, second: Grid, second_name: str, *, remedy: str) -> None:
    """Raise RefusedError, with the remedy and both grids printed below it, unless the two grids match."""
    if not first.matches(second):
        raise RefusedError(
            f"grids differ: {second_name} does not lie on the grid of {first_name}; "
            f"expected one grid for both ({remedy})\n"
            f"  {first_name}: {first.describe()}\n  {second_name}: {second.describe()}"
        )


@dataclass(frozen=True, eq=False)
class Volume:
    """Values on a grid.

    data: array of shape `grid.shape`, or `grid.shape + (K,)` for K channels or frames; floating, or complex of shape
        `grid.shape`; NaN where there is no value.
    file_shape: the array shape in the file it came from, or should have in a file: planes and trailing axes of length 1
        kept, channels last.
    header: what its file format needs to write a volume like this one; opaque outside `formats`.
    notes: lines for the user on what the file leaves in doubt, as where its voxels lie.
    """

    data: np.ndarray
    grid: Grid
    file_shape: tuple[int, ...] = ()
    header: Any = field(default=None, repr=False)
    notes: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if self.data.shape[:3] != self.grid.shape or self.data.ndim > 4:
            raise ValueError(f"data has shape {self.data.shape}, its grid {self.grid.shape}")
        if not self.file_shape:
            object.__setattr__(self, "file_shape", self.data.shape)
        if math.prod(self.file_shape) != self.data.size:
            raise ValueError(f"data has shape {self.data.shape}, {self.file_shape} in a file")

    @property
    def channels(self) -> int:
        """How many values, real or complex, a voxel has: K."""
        return self.data.shape[3] if self.data.ndim == 4 else 1

    def with_data(self, data: np.ndarray) -> Volume:
        """The same grid, header and notes around other values on it, also where they have more or fewer channels."""
        count = data.shape[3] if data.ndim == 4 else 1
        return Volume(data, self.grid, with_channels(self.file_shape, self.channels, count), self.header, self.notes)


def with_channels(file_shape: tuple[int, ...], found: int, wanted: int) -> tuple[int, ...]:
    """The file shape of `wanted` channels like that of `found` channels: planes stay planes."""
    if wanted == found:
        return file_shape
    # Of three axes, the last holds channels where there are any: a picture of (nx, ny, K).
    spatial = file_shape[:2] if found > 1 and len(file_shape) == 3 else file_shape[:3]
    return (*spatial, wanted) if wanted > 1 else spatial
