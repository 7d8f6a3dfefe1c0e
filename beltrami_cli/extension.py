"""Extension of data off the surface: every entry of the band gets a value, constant along normals."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beltrami_cli.band import Band
from beltrami_cli.errors import DataError
from beltrami_cli.kernels import extend as kernels
from beltrami_cli.kernels import interpolate

EXTENSIONS = ("closest-point", "pde", "none")

# Trilinear weight that valid corners must hold for a sample to count: one corner's mean share.
LEAST_WEIGHT = 0.125
# Voxels to either side of the surface at which data are sampled: the two samples share no corner along the normal, and
# lie within the voxels that the surface passes through or beside.
HALF_STEP = 0.5
# Voxels between the samples of an average over depth: every voxel on the way is met by one or two of them.
DEPTH_STEP = 0.5
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

    values: (K, E), NaN only on a bank without any valid data. known: (E,) bool, False where a hole was filled.
    confidence: (E,) in 0..1, mean weight of the data that an entry's value comes from; 0 where it was filled.
    """

    values: np.ndarray
    known: np.ndarray
    confidence: np.ndarray


def extend(
    band: Band,
    own: np.ndarray,
    confidence: np.ndarray,
    method: str = "closest-point",
    *,
    depth: tuple[float, float] | None = None,
    turns: bool = False,
) -> Extended:
    """Carry data off the surface on every sheet.

    own: (K, E), the data at the entries that they belong to (`own_samples`), NaN where missing.
    confidence: (E,) their weights in 0..1, 0 where missing.
    method: "closest-point" (each entry takes the value of valid voxels at its closest surface point, see
    `at_closest_points`), "pde" (U_t + sign(Psi) grad U . grad Psi = 0, Sec. 2.1) or "none" (each voxel keeps its own
    value; sheets other than the nearest take the closest point's). Holes are then filled from the band around them.
    depth: (A, B) in mm along the normal, for "closest-point": data are averaged from A to B.
    turns: the channels are cos and sin of an angle, or a complex number; nothing may depend on where its phase is 0.
    Raises DataError where no entry is reached by valid data.
    """
    own = np.where(confidence > 0, own, np.nan)
    if band.surface is None:
        values, trust = own, confidence
    elif method == "pde":
        values, trust = transported(band, own, confidence)
    else:
        values, trust = at_closest_points(band, own, confidence, _depths(band, depth))
        if method == "none":
            values[:, band.primary], trust[band.primary] = own[:, band.primary], confidence[band.primary]
    return _filled(band, values, trust, turns=turns)


def from_vertices(
    band: Band,
    corners: np.ndarray,
    weights: np.ndarray,
    values: np.ndarray,
    trust: np.ndarray,
    *,
    turns: bool = False,
) -> Extended:
    """Start values from data (K, V) of weights `trust` (V,), 0 where missing, at the vertices of the band's mesh.

    Every entry takes the value at its closest point, linear over its triangle: vertices `corners` (E, 3) with weights
    (E, 3); those without data take no part. Holes are then filled. Raises DataError and `turns` as `extend`.
    """
    share = np.where(trust[corners] > 0, weights, 0)
    mass = (share * trust[corners]).sum(1)
    mass[share.sum(1) < LEAST_WEIGHT] = 0
    here = np.zeros((len(values), band.entries))
    for k in range(3):
        here += np.where(share[:, k] > 0, values[:, corners[:, k]], 0) * (share[:, k] * trust[corners[:, k]])
    with np.errstate(invalid="ignore", divide="ignore"):
        start = np.where(mass > 0, here / mass, np.nan)
    return _filled(band, start.astype(values.dtype), mass.astype(values.dtype), turns=turns)


def _filled(band: Band, values: np.ndarray, trust: np.ndarray, *, turns: bool) -> Extended:
    """The start from values (K, E) of confidence `trust` (E,), the unknown filled in place."""
    known = trust > 0
    if not known.any():
        raise DataError(
            "the data have no valid value on the surface: found only NaN (or weights of 0) beside the zero level, "
            "expected finite values there (do LEVELSET and DATA belong together?)"
        )
    if not known.all():
        fill(band, values, known, turns=turns)
    return Extended(values, known, trust)


def own_samples(band: Band, samples: np.ndarray, *, every: bool = False) -> np.ndarray:
    """(K, E) samples (K, E) at the entries that a voxel's data belong to; NaN at those of the banks behind the nearest.

    A voxel midway between two banks feeds neither (but the nearer one with `every`): which it shows is anyone's guess.
    """
    first = band.primary
    second = np.minimum(first + 1, band.entries - 1)
    shared = (band.voxel[second] == band.voxel[first]) & (second != first)
    near, far = band.distance[first], band.distance[second]
    contested = shared & (near * far > 0) & (np.abs(far) - np.abs(near) < MIDWAY * band.finest)
    own = np.full_like(samples, np.nan)
    own[:, first] = np.where(contested & (not every), np.nan, samples[:, first])
    return own


def _depths(band: Band, depth: tuple[float, float] | None) -> np.ndarray:
    """mm along the normal at which data are sampled."""
    if depth is None:
        return np.array([-HALF_STEP, HALF_STEP]) * band.finest
    low, high = depth
    return np.linspace(low, high, 1 + math.ceil((high - low) / (DEPTH_STEP * band.finest) - 1e-6))


def at_closest_points(
    band: Band, own: np.ndarray, confidence: np.ndarray, depths: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """(K, E) values at each entry's closest point, the mean of trilinear samples `depths` (D,) mm along its normal.

    Weighted by confidence (E,), whose mean is returned too: 0, and a value of NaN, where valid corners are too few. Two
    samples half a voxel to either side are exact for values linear in depth, with less noise than one at the point.
    """
    start = np.arange(band.entries, dtype=np.int32)
    total, mass = np.zeros(own.shape), np.zeros(band.entries)
    along = band.normal / band.grid.spacing.astype(np.float32)[:, None]
    for depth in depths:
        offset = band.closest_offset + np.float32(depth) * along
        interpolate.linear(own, confidence, start, offset, band.forward, band.backward, LEAST_WEIGHT, total, mass)
    with np.errstate(invalid="ignore"):
        return (total / mass).astype(own.dtype), (mass / len(depths)).astype(own.dtype)


def transported(band: Band, own: np.ndarray, confidence: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(K, E) solution of the initial value problem of Sec. 2.1, run for twice the time that a front takes to the rim.

    Confidence (E,), and values times it, are carried alike; returns (values, confidence).
    """
    spacing = band.grid.spacing
    # mm at unit speed: the upwind scheme's own bound, with a margin
    dt = 0.9 / np.sqrt((1 / band.grid.used_spacing**2).sum())
    carried = []
    for quantity in (*(confidence * own), np.where(confidence > 0, confidence, np.nan)):
        u, out = quantity.astype(own.dtype), np.empty_like(own[0])
        for _ in range(int(np.ceil(2 * band.half_width / dt))):
            kernels.transport(u, band.normal, band.distance, band.forward, band.backward, spacing, band.finest, dt, out)
            u, out = out, u
        carried.append(u)
    *values, trust = carried
    return np.stack(values) / trust, np.nan_to_num(trust)


def fill(band: Band, values: np.ndarray, known: np.ndarray, *, turns: bool = False) -> None:
    """Fill unknown entries of values (K, E) in place with the function harmonic in the band that meets the known ones.

    Conjugate gradients on the Laplacian over the band's links, started from a ring-by-ring flood; no value leaves the
    range of the known ones (with `turns`, no vector of channels their length). Banks without any known value stay NaN.
    """
    kernels.flood(values, band.forward, band.backward)
    free = np.flatnonzero(~known & ~np.isnan(values[0])).astype(np.int32)
    u = np.nan_to_num(values.astype(np.float64), nan=0.0)
    kernels.relax(u, free, band.forward, band.backward, band.grid.spacing, FILL_TOLERANCE, FILL_ITERATIONS)
    inside = u[:, free]
    if turns:
        longest = np.sqrt((values[:, known].astype(float) ** 2).sum(0).max())
        inside *= np.minimum(1, longest / np.maximum(np.sqrt((inside**2).sum(0)), 1e-30))
    else:
        inside = np.clip(inside, values[:, known].min(1, keepdims=True), values[:, known].max(1, keepdims=True))
    values[:, free] = inside


class Reextension:
    """Makes values constant along normals again: the local cubic at each entry's closest point, on its own sheet.

    turns: the channels are cos and sin, or a complex number, whose overshoot is cut in length, not in each channel.
    """

    def __init__(self, band: Band, *, turns: bool = False) -> None:
        self.band, self.turns = band, turns
        start = np.arange(band.entries, dtype=np.int32)
        self.origin = interpolate.stencil_origins(start, band.closest_offset, band.forward, band.backward, band.nodes)

    def __call__(self, u: np.ndarray, out: np.ndarray) -> None:
        """Write the re-extended u into out, both (K, E); an entry whose stencil is incomplete keeps its value."""
        out[:] = u
        band = self.band
        size = np.sqrt((u**2).sum(0)) if self.turns else np.empty(0, u.dtype)
        interpolate.cubic(u, size, self.origin, band.closest_offset, band.forward, band.nodes, out)
