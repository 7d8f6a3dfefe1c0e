"""The surface as a mesh in world space, with the values that lie on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangulated surface, or a polyline where the surface is a curve in a plane.

    vertices_ras_mm: (V, 3) float64 in RAS mm.
    cells: (C, 3) int32 triangles, counter-clockwise seen from outside; (C, 2) segments for a curve.
    values: (V,) data values, or (V, K) of K channels or frames, real, NaN where missing; None for geometry alone.
    structure: the part of the brain in GIFTI's names, as CortexLeft; None where unknown.
    """

    vertices_ras_mm: np.ndarray
    cells: np.ndarray
    values: np.ndarray | None = None
    structure: str | None = None

    def named_values(self) -> dict[str, np.ndarray]:
        """(V,) values by name: `value`, or `value 1`, `value 2` ... of several channels; empty for geometry alone."""
        if self.values is None:
            return {}
        if self.values.ndim == 1:
            return {"value": self.values}
        return {f"value {k + 1}": self.values[:, k] for k in range(self.values.shape[1])}
