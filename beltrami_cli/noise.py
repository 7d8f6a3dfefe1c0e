"""Noise on a surface, from differences between neighbours: how strong, how smooth, whether it is correlated.

Neighbours are linked voxels of a band, or vertices of a mesh (the functions `..._on_mesh`). A slope along the surface
cancels in the differences, and the scale is robust, so that borders and outliers do not count as noise. Nothing here is
random.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np

from beltrami_cli.band import Band
from beltrami_cli.kernels import mesh as meshes
from beltrami_cli.kinds import Kind

# Entries looked at: enough for a standard deviation to 1 %, in some tenths of a second.
ENTRIES = 100_000
# Fewer differences than this tell their standard deviation to no better than 10 %.
LEAST_DIFFERENCES = 100
# Differences beyond this many standard deviations are borders and outliers, not noise.
CUT = 3.0
# Medians of |x|, of a normal x of unit variance and of one that is cut at CUT.
MEDIAN, CUT_MEDIAN = 0.67449, 0.67237
# Links whose cosine to the normal is below the first run along the surface (of three axes one always does), and those
# above the second along the normal.
TANGENTIAL, NORMAL = 0.6, 0.8
# Noise between neighbours as a share of that between voxels 2 apart: 1 for white noise, 0.86, 0.42 and 0.24 for a FWHM
# of 1, 1.5 and 2 voxels, under 0.2 where values come from a grid or a mesh twice as coarse; borders leave 0.6.
CORRELATED = 1 / 3
# Noise as a share of what the values vary by at 2 voxels, below which the map itself hides the noise's correlation.
LEAST_NOISE = 0.5
# Differences below this share of the values are rounding, of single precision.
ROUNDING = 1e-6


def noise_sd(band: Band, samples: np.ndarray, kind: Kind, most: int = ENTRIES) -> np.ndarray:
    """Standard deviation of the noise on the surface in data units, (K,) for vectors, else (1,); NaN where unknown.

    samples: (K, E) channels as they came, before extension (`extension.own_samples`), NaN where there are none. most:
    entries to look at.
    The noise of each voxel is taken as independent of its neighbours' (see `looks_correlated`). It is half the robust
    standard deviation of w = x_00 - x_10 - x_01 + x_11 over the corners of a voxel face, in which slopes and borders
    along the axes cancel. For angles w is wrapped, and the result is the circular standard deviation sqrt(-2 ln R),
    R = |mean of exp(i noise)|: the characteristic function of w is R^4. Up to about 75 degrees of 360 can be told.
    """
    entries, axes = _near(band, samples, most), _axes(band)
    values = np.arctan2(samples[1:2], samples[0:1]) if kind.is_circular else samples
    faces = [np.empty((len(values), 0))]
    for a, b in combinations(axes, 2):
        up, side = _walk(band, entries, a, 1), _walk(band, entries, b, 1)
        across = _walk(band, up, b, 1)
        faces.append((_at(values, entries) - _at(values, up)) - (_at(values, side) - _at(values, across)))
    return _sd_of_crosses(np.concatenate(faces, axis=1), kind)


def noise_sd_on_mesh(cells: np.ndarray, samples: np.ndarray, kind: Kind) -> np.ndarray:
    """As `noise_sd`, of samples (K, V) at the vertices of triangles (C, 3).

    From w = x_a + x_b - x_c - x_d, where ab is the edge that the triangles abc and bad share.
    """
    edge = np.sort(cells[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
    opposite = cells[:, [2, 0, 1]].reshape(-1)
    order = np.lexsort(edge.T)
    edge, opposite = edge[order], opposite[order]
    pair = np.flatnonzero((edge[1:] == edge[:-1]).all(1))
    pair = pair[:: 1 + len(pair) // ENTRIES]
    a, b, c, d = edge[pair, 0], edge[pair, 1], opposite[pair], opposite[pair + 1]
    values = np.arctan2(samples[1:2], samples[0:1]) if kind.is_circular else samples
    x = values.astype(float)
    return _sd_of_crosses((x[:, a] - x[:, c]) + (x[:, b] - x[:, d]), kind)


def _sd_of_crosses(w: np.ndarray, kind: Kind) -> np.ndarray:
    """Half the robust standard deviation of w (K, N), each of two samples less two others, in data units."""
    if kind.is_circular:
        w = (w + np.pi) % (2 * np.pi) - np.pi
    return np.array([kind.unit * _robust_sd(channel, wraps=kind.is_circular) / 2 for channel in w])


def smoothness_mm(band: Band, values: np.ndarray, kind: Kind) -> float:
    """Full width at half maximum, mm along the surface, of the Gaussian that would make white noise as smooth.

    values: (K, E) channels, NaN where there are none. Forman et al. 1995: FWHM = d sqrt(-2 ln 2 / ln(1 - D / 2V)) with
    V the variance of the values and D that of differences at d mm along the surface; all channels together, angles as
    unit vectors. It is the smoothness of the values with what they show, not of their noise alone: 0 for white noise,
    NaN where neighbours do not differ and where too few values are linked.
    """
    entries = _near(band, values)
    near, far, squares = [], [], []
    for axis in _axes(band):
        obliquity = np.abs(band.normal[axis, entries])
        tangential = obliquity <= TANGENTIAL
        start = entries[tangential]
        near.append(_at(values, start))
        far.append(_at(values, _walk(band, start, axis, 1)))
        squares.append(band.grid.spacing[axis] ** 2 * (1 - obliquity[tangential].astype(float) ** 2))
    return _fwhm(np.concatenate(near, axis=1), np.concatenate(far, axis=1), np.concatenate(squares), kind)


def smoothness_on_mesh(points: np.ndarray, edges: np.ndarray, values: np.ndarray, kind: Kind) -> float:
    """As `smoothness_mm`, of values (K, V) at vertices (V, 3), mm, over the edges (N, 2) of a mesh."""
    a, b = edges.T
    x = values.astype(float)
    return _fwhm(x[:, a], x[:, b], ((points[a] - points[b]) ** 2).sum(1), kind)


def _fwhm(a: np.ndarray, b: np.ndarray, d2: np.ndarray, kind: Kind) -> float:
    """The width of Forman et al. from values (K, N) at both ends of links whose squared lengths are d2 (N,), mm^2."""
    linked = ~(np.isnan(a) | np.isnan(b)).any(0)
    a, b, d2 = a[:, linked], b[:, linked], d2[linked]
    if kind.is_circular:
        a, b = (x / np.maximum(np.hypot(x[0], x[1]), 1e-30) for x in (a, b))
    if d2.size < LEAST_DIFFERENCES:
        return np.nan
    both = np.concatenate([a, b], axis=1)
    variance, difference = float(both.var(axis=1).sum()), float(((a - b) ** 2).sum(0).mean())
    rounding = ROUNDING**2 * float((both**2).sum(0).mean())
    if min(variance, difference) <= rounding:
        return np.nan
    correlation = max(1 - difference / (2 * variance), 0.0)
    return float(np.sqrt(-2 * np.log(2) * d2.mean() / np.log(correlation))) if correlation > 0 else 0.0


def looks_correlated(band: Band, samples: np.ndarray, kind: Kind) -> bool:
    """True where the noise of neighbouring voxels is alike, as after interpolation or painting from a coarser mesh.

    samples: (K, E) channels as they came, as for `noise_sd`. Held-out voxels would then be predicted from their own
    copies. False where it cannot be told.

    D_m is the robust variance of second differences along the surface over links of m voxels. White noise N adds the
    same to each, a smooth map S m^4: from m = 2 and 3 follow S and N. Correlated noise is what D_1 - S, or the second
    differences along the normal, fall short of N; see CORRELATED.
    """
    one, two, three = (_second_differences(band, samples, kind, m, 0, TANGENTIAL) ** 2 for m in (1, 2, 3))
    along_normal = _second_differences(band, samples, kind, 1, NORMAL, 1) ** 2
    return _is_correlated(one, two, three, along_normal)


def looks_correlated_on_mesh(
    points: np.ndarray, start: np.ndarray, ring: np.ndarray, samples: np.ndarray, kind: Kind
) -> bool:
    """As `looks_correlated`, of samples (K, V) at the vertices (V, 3) of a mesh with neighbours start, ring."""
    walks = meshes.straight_walks(points, start, ring, 3)
    here = np.flatnonzero(~np.isnan(samples[0]))
    here = here[:: 1 + len(here) // ENTRIES]
    forth, back = walks[here, 0], walks[here, 1]
    scale = _at(samples, here).std(axis=1) if len(here) else np.zeros(len(samples))
    one, two, three = (_spread_of_bends(samples, here, forth[:, m], back[:, m], scale, kind) ** 2 for m in range(3))
    return _is_correlated(one, two, three, np.nan)


def _is_correlated(one: float, two: float, three: float, along_normal: float) -> bool:
    """Whether the variances of second differences over 1, 2 and 3 links, and along the normal, say so."""
    of_map = max(three - two, 0.0) / (3**4 - 2**4)
    noise = two - 2**4 * of_map
    nearest = np.fmin(one - of_map, along_normal)
    return bool(noise > LEAST_NOISE * two and nearest < CORRELATED * noise)


def _second_differences(band: Band, samples: np.ndarray, kind: Kind, voxels: int, least: float, most: float) -> float:
    """Robust sd of second differences over `voxels` links along axes whose cosine to the normal is least to most.

    Channels are scaled to unit variance; for angles it is the component across the middle one, sin(a_+ - a) +
    sin(a_- - a), which stays bounded under any noise.
    """
    entries = _near(band, samples)
    if entries.size < LEAST_DIFFERENCES:
        return np.nan
    middles, forth, back = [], [], []
    for axis in _axes(band):
        obliquity = np.abs(band.normal[axis, entries])
        middle = entries[(obliquity >= least) & (obliquity <= most)]
        middles.append(middle)
        forth.append(_walk(band, middle, axis, voxels))
        back.append(_walk(band, middle, axis, -voxels))
    scale = _at(samples, entries).std(axis=1)
    middle, there, behind = (np.concatenate(part) for part in (middles, forth, back))
    return _spread_of_bends(samples, middle, there, behind, scale, kind)


def _spread_of_bends(
    samples: np.ndarray, middle: np.ndarray, forth: np.ndarray, back: np.ndarray, scale: np.ndarray, kind: Kind
) -> float:
    """Robust sd of x_forth + x_back - 2 x_middle, places (N,) in samples (K, M), -1 for none, each channel over scale.

    For angles the component across the middle one.
    """
    here, sides = _at(samples, middle), _at(samples, forth) + _at(samples, back)
    if kind.is_circular:
        w = (here[0] * sides[1] - here[1] * sides[0])[None]
    else:
        w = sides - 2 * here
        w = w[scale > 0] / scale[scale > 0, None]
    size = np.abs(w[~np.isnan(w)])
    return float(np.median(size)) / MEDIAN if size.size >= LEAST_DIFFERENCES else np.nan


def _robust_sd(x: np.ndarray, *, wraps: bool = False) -> float:
    """Standard deviation of normal x (N,), NaN ignored, whatever else lies beyond CUT of it; NaN where x is too few.

    From the median of |x| below CUT standard deviations, found again until both agree. x that wraps at pi, once it is
    too wide to be cut, has the wrapped normal's.
    """
    size = np.abs(x[~np.isnan(x)])
    if size.size < LEAST_DIFFERENCES:
        return np.nan
    if 2 * np.count_nonzero(size) > size.size:
        size = size[size > 0]  # exact zeros are copies of one value, as after painting from a coarser mesh
    median = float(np.median(size))
    sd = median / MEDIAN
    if wraps and CUT * sd > np.pi:
        return _wrapped_sd(median)
    for _ in range(20):
        sd = float(np.median(size[size <= CUT * sd])) / CUT_MEDIAN
    return sd


def _wrapped_sd(median: float) -> float:
    """Standard deviation, radians, of the normal distribution whose |x| wrapped at pi has this median; NaN beyond 3."""
    sd = np.linspace(3.0, 0.5, 1000)  # above, the wrapped distribution is uniform to 1 %
    n = np.arange(1, 12)[:, None]
    below = median / np.pi + 2 / np.pi * (np.exp(-(n**2) * sd**2 / 2) / n * np.sin(n * median)).sum(0)
    return float(np.interp(0.5, below, sd, left=np.nan, right=sd[-1]))


def _near(band: Band, values: np.ndarray, most: int = ENTRIES) -> np.ndarray:
    """Entries within a voxel of the surface that have a value, a regular sample of them where they are many."""
    within = np.abs(band.distance) <= band.grid.used_spacing.max()
    entries = np.flatnonzero(within & ~np.isnan(values[0]))
    return entries[:: 1 + len(entries) // most]


def _axes(band: Band) -> list[int]:
    return [axis for axis in range(3) if band.grid.shape[axis] > 1]


def _walk(band: Band, entries: np.ndarray, axis: int, links: int) -> np.ndarray:
    """Entries (N,) that many links on along the axis; -1 where a link is missing, or from -1."""
    table = band.forward[axis] if links > 0 else band.backward[axis]
    for _ in range(abs(links)):
        following = table[entries].astype(np.int64)
        entries = np.where((following == entries) | (entries < 0), -1, following)
    return entries


def _at(values: np.ndarray, entries: np.ndarray) -> np.ndarray:
    """(K, N) float64 values at entries, NaN at -1."""
    return np.where(entries < 0, np.nan, values[:, entries].astype(float))
