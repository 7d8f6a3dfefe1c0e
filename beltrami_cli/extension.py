"""Extension of data off the surface: every entry of the band gets a value, constant along normals."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beltrami_cli.band import Band
from beltrami_cli.errors import DataError
from beltrami_cli.kernels import extend as kernels
from beltrami_cli.kernels import interpolate

EXTENSIONS = ("closest-point", "pde", "none")

# Trilinear weight that valid corners must hold for a value to count as known: one corner's mean share.
LEAST_WEIGHT = 0.125
# Voxels to either side of the surface at which data are sampled: the two samples share no corner along the normal, and
# lie within the voxels that the surface passes through or beside.
HALF_STEP = 0.5
# A voxel on one side of two banks belongs to the nearer one where it is nearer by this many voxels: less is within the
# accuracy of a level set between two banks.
MIDWAY = 0.5
# Filling is a start for the flow: relative residual at which it stops, and the most iterations, each of which carries
# the rim's values one voxel further in.
FILL_TOLERANCE = 1e-3
FILL_ITERATIONS = 100


@dataclass(frozen=True, eq=False)
class Extended:
    """Start values on the band.

    values: (E,), NaN only on a bank without any valid data. known: (E,) bool, False where a hole was filled.
    """

    values: np.ndarray
    known: np.ndarray


def extend(band: Band, samples: np.ndarray, method: str = "closest-point") -> Extended:
    """Carry data off the surface on every sheet.

    samples: (E,), a volume's values at the entries (`Band.gather`), NaN where missing; only primary entries count.
    method: "closest-point" (each entry takes the value of valid voxels at its closest surface point, see
    `at_closest_points`), "pde" (U_t + sign(Psi) grad U . grad Psi = 0, Sec. 2.1) or "none" (each voxel keeps its own
    value; sheets other than the nearest take the closest point's). Holes are then filled from the band around them.
    Raises DataError where no entry is reached by valid data.
    """
    if band.surface is None:
        values = samples.copy()
    elif method == "pde":
        values = transported(band, own_samples(band, samples))
    else:
        values = at_closest_points(band, own_samples(band, samples))
        if method == "none":
            values[band.primary] = samples[band.primary]
    known = ~np.isnan(values)
    if not known.any():
        raise DataError(
            "the data have no valid value on the surface: found only NaN beside the zero level, expected finite values "
            "there (do LEVELSET and DATA belong together?)"
        )
    if not known.all():
        fill(band, values, known)
    return Extended(values, known)


def own_samples(band: Band, samples: np.ndarray) -> np.ndarray:
    """(E,) samples at the entries that a voxel's data belong to; NaN at those of the banks behind the nearest.

    A voxel midway between two banks feeds neither: which of them it shows is anyone's guess.
    """
    first = band.primary
    second = np.minimum(first + 1, band.entries - 1)
    shared = (band.voxel[second] == band.voxel[first]) & (second != first)
    near, far = band.distance[first], band.distance[second]
    contested = shared & (near * far > 0) & (np.abs(far) - np.abs(near) < MIDWAY * band.finest)
    own = np.full_like(samples, np.nan)
    own[first] = np.where(contested, np.nan, samples[first])
    return own


def at_closest_points(band: Band, own: np.ndarray) -> np.ndarray:
    """(E,) values of `own` (E,) at each entry's closest point; NaN where valid corners are too few.

    The mean of two trilinear samples HALF_STEP voxels on either side along the normal: exact for values linear in
    depth, and with less noise than one sample at the point itself.
    """
    start = np.arange(band.entries, dtype=np.int32)
    aside = (HALF_STEP * band.finest * band.normal / band.grid.spacing[:, None]).astype(np.float32)
    above, below = np.full_like(own, np.nan), np.full_like(own, np.nan)
    for out, offset in ((above, band.closest_offset + aside), (below, band.closest_offset - aside)):
        interpolate.linear(own, start, offset, band.forward, band.backward, LEAST_WEIGHT, out)
    lone = np.where(np.isnan(above), below, above)
    mean = (above + below) / 2
    return np.where(np.isnan(mean), lone, mean)


def transported(band: Band, own: np.ndarray) -> np.ndarray:
    """(E,) solution of the initial value problem of Sec. 2.1, run for twice the time that a front takes to the rim."""
    spacing = band.grid.spacing
    # mm at unit speed: the upwind scheme's own bound, with a margin
    dt = 0.9 / np.sqrt((1 / band.grid.used_spacing**2).sum())
    u, out = own.copy(), np.empty_like(own)
    for _ in range(int(np.ceil(2 * band.half_width / dt))):
        kernels.transport(u, band.normal, band.distance, band.forward, band.backward, spacing, band.finest, dt, out)
        u, out = out, u
    return u


def fill(band: Band, values: np.ndarray, known: np.ndarray) -> None:
    """Fill unknown entries in place with the harmonic function in the band that meets the known ones at the hole's rim.

    Conjugate gradients on the Laplacian over the band's links, started from a ring-by-ring flood; no value leaves the
    range of the known ones. Banks without any known value stay NaN.
    """
    kernels.flood(values, band.forward, band.backward)
    free = np.flatnonzero(~known & ~np.isnan(values)).astype(np.int32)
    u = np.nan_to_num(values.astype(np.float64), nan=0.0)
    kernels.relax(u, free, band.forward, band.backward, band.grid.spacing, FILL_TOLERANCE, FILL_ITERATIONS)
    values[free] = np.clip(u[free], values[known].min(), values[known].max())


class Reextension:
    """Makes values constant along normals again: the local cubic at each entry's closest point, on its own sheet."""

    def __init__(self, band: Band) -> None:
        self.band = band
        start = np.arange(band.entries, dtype=np.int32)
        self.origin = interpolate.stencil_origins(start, band.closest_offset, band.forward, band.backward, band.nodes)

    def __call__(self, u: np.ndarray, out: np.ndarray) -> None:
        """Write the re-extended u into out, both (E,); an entry whose stencil is incomplete keeps its value."""
        out[:] = u
        interpolate.cubic(u, self.origin, self.band.closest_offset, self.band.forward, self.band.nodes, out)
