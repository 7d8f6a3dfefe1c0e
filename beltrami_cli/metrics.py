"""How far two arrays or two meshes differ: the figures that `beltrami compare` prints, and the tolerances on them."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass

import numpy as np

from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.surface import Mesh

# Length of the mean of unit vectors below which their mean direction is left to chance and outliers.
SPREAD = 0.1

# mm between meshes that are one, where values are judged: float32 keeps the coordinates of a head to 1e-5 mm, text of
# four decimals to 1e-4, and no value on a cortex changes over a thousandth of a voxel.
SAME_PLACE = 1e-3


class NoValues(DataError):
    """Neither array has a value at any of the places that are looked at."""


@dataclass(frozen=True)
class Tolerances:
    """How far B may be from A; None is no tolerance.

    max_abs, max_rms: of the differences, in data units. min_psnr: dB. max_missing: how many values may be in only one
    of both. max_distance: mm between meshes; where only others are given, `SAME_PLACE`.
    Raises RefusedError for what is not a number, and, but for min_psnr, for one below 0.
    """

    max_abs: float | None = None
    max_rms: float | None = None
    min_psnr: float | None = None
    max_missing: int | None = None
    max_distance: float | None = None

    def __post_init__(self) -> None:
        for name, limit in asdict(self).items():
            if limit is not None and not limit >= (-math.inf if name == "min_psnr" else 0):
                expected = "a number of dB" if name == "min_psnr" else "0 or more"
                raise RefusedError(f"tolerance {name.replace('_', '-')}: found {limit:g}; expected {expected}")

    @property
    def are_of_values(self) -> bool:
        return any(limit is not None for limit in (self.max_abs, self.max_rms, self.min_psnr, self.max_missing))

    @property
    def are_given(self) -> bool:
        return self.are_of_values or self.max_distance is not None


@dataclass(frozen=True)
class Difference:
    """B minus A over the values that are finite in both, in data units; of several channels each is a value.

    compared: values that are finite in both. only_in_a, only_in_b: those that are in only one; infinity in A against
    -infinity or none in B is only in A, and infinity in both is neither compared nor missing.
    data_range: what psnr counts as the full scale. psnr: 20 log10(data_range / rms) in dB, inf where A equals B.
    correlation: Pearson's, or the circular coefficient for angles; NaN where A or B is constant.
    """

    compared: int
    only_in_a: int
    only_in_b: int
    max_abs: float
    rms: float
    mean: float
    data_range: float
    psnr: float
    correlation: float

    def exceeds(self, tolerances: Tolerances) -> list[str]:
        """One line for each tolerance that is broken; an empty list where all hold."""
        t, missing = tolerances, self.only_in_a + self.only_in_b
        lines = []
        if t.max_abs is not None and not self.max_abs <= t.max_abs:
            lines.append(f"largest difference {self.max_abs:.6g} is over {t.max_abs:g}")
        if t.max_rms is not None and not self.rms <= t.max_rms:
            lines.append(f"rms difference {self.rms:.6g} is over {t.max_rms:g}")
        if t.min_psnr is not None and not self.psnr >= t.min_psnr:
            lines.append(f"PSNR {self.psnr:.2f} dB is under {t.min_psnr:g} dB")
        if t.max_missing is not None and missing > t.max_missing:
            lines.append(
                f"{missing} values are in only one ({self.only_in_a} in A, {self.only_in_b} in B), over {t.max_missing}"
            )
        return lines

    def as_dict(self) -> dict[str, int | float | None]:
        """The fields by name, for JSON: what is not a finite number there (psnr of equal arrays) is None."""
        return {name: value if math.isfinite(value) else None for name, value in asdict(self).items()}


@dataclass(frozen=True)
class Distance:
    """Between two meshes: how far vertices moved where both have the same triangles, else between the surfaces."""

    max_mm: float
    rms_mm: float
    same_triangles: bool

    def exceeds(self, tolerances: Tolerances) -> list[str]:
        """One line where the largest is over the tolerance, `SAME_PLACE` where only others are given; else none."""
        if not tolerances.are_given:
            return []
        limit = SAME_PLACE if tolerances.max_distance is None else tolerances.max_distance
        if self.max_mm <= limit:
            return []
        what = "vertices moved by up to" if self.same_triangles else "surfaces, of other triangles, are apart by up to"
        return [f"{what} {self.max_mm:.6g} mm, over {limit:g} mm"]


def distance_between(a: Mesh, b: Mesh) -> Distance:
    """From each vertex to its like with the same triangles (or lines), else from each to the other's triangles.

    These are taken both ways, from all vertices that are on triangles: their largest is the Hausdorff distance as far
    as vertices see it.
    """
    if a.vertices_ras_mm.shape == b.vertices_ras_mm.shape and np.array_equal(a.cells, b.cells):
        squared, same = ((b.vertices_ras_mm - a.vertices_ras_mm) ** 2).sum(1), True
    else:
        squared, same = np.concatenate([_squared_to(a, b), _squared_to(b, a)]), False
    return Distance(float(np.sqrt(squared.max())), float(np.sqrt(squared.mean())), same)


def _squared_to(a: Mesh, b: Mesh) -> np.ndarray:
    """(N,) mm^2 from the vertices of a's cells to the nearest point on b's."""
    import igl

    points = a.vertices_ras_mm[np.unique(a.cells)]
    return np.asarray(igl.point_mesh_squared_distance(points, b.vertices_ras_mm, b.cells.astype(np.int64))[0])


def difference(
    a: np.ndarray,
    b: np.ndarray,
    *,
    mask: np.ndarray | None = None,
    period: float | None = None,
    data_range: float | None = None,
) -> Difference:
    """Compare B with the reference A, arrays of one shape; NaN and infinite values count as missing.

    Figures are of float64: whole numbers above 2^53 (9e15) are rounded to it and may then be equal.
    mask: of the same shape; only where it is true (not zero) is looked at.
    period: the values are angles of this period, and differences are wrapped to -period/2 .. period/2.
    data_range: full scale for PSNR in data units; by default A's range over the compared voxels, or the period.
    Raises RefusedError for shapes that differ or a period or range that is not positive, DataError where no voxel
    has a value in both, of the kind NoValues where none has one in either.
    """
    require_scales(period, data_range)
    if a.shape != b.shape or (mask is not None and mask.shape != a.shape):
        shapes = [array.shape for array in (a, b, mask) if array is not None]
        raise RefusedError(
            f"shapes differ: found {', '.join(map(str, shapes))}, expected one shape for all that is compared"
        )
    looked_at = np.ones(a.shape, bool) if mask is None else mask != 0
    in_a, in_b = np.isfinite(a) & looked_at, np.isfinite(b) & looked_at
    both = in_a & in_b
    only_in_a, only_in_b = _in_only_one(a, b, looked_at & ~both)
    if not both.any():
        kind = DataError if only_in_a or only_in_b or not looked_at.any() else NoValues
        raise kind(
            f"nothing to compare: of {looked_at.sum()} places looked at, {in_a.sum()} have a finite value in A and "
            f"{in_b.sum()} in B, none in both"
        )
    x, y = a[both].astype(float, copy=False), b[both].astype(float, copy=False)
    with np.errstate(over="ignore", invalid="ignore"):  # near 1e308 a figure may be inf, which breaks any tolerance
        max_abs, mean, rms = _sizes(x, y, period)
        scale = data_range or period or float(x.max() - x.min())
        return Difference(
            compared=x.size,
            only_in_a=only_in_a,
            only_in_b=only_in_b,
            max_abs=max_abs,
            rms=rms,
            mean=mean,
            data_range=scale,
            psnr=_psnr(scale, rms),
            correlation=_correlation(x, y) if period is None else _circular_correlation(x, y, period),
        )


def require_scales(period: float | None, data_range: float | None) -> None:
    """Raise RefusedError for a period or a full scale of a comparison that is not a finite number above 0."""
    for name, size in (("period", period), ("data range", data_range)):
        if size is not None and not 0 < size < math.inf:
            raise RefusedError(f"{name} of the comparison: found {size:g}, expected a finite number above 0")


def wrapped(d: np.ndarray, period: float) -> np.ndarray:
    """Differences of angles (data units) brought to -period/2 <= d < period/2."""
    turned = d + period / 2
    turned %= period
    turned -= period / 2
    return turned


def _in_only_one(a: np.ndarray, b: np.ndarray, places: np.ndarray) -> tuple[int, int]:
    """How many values are only in A and only in B, at places where at most one of them is finite."""
    p, q = a[places], b[places]
    differ = (p != q) & ~(np.isnan(p) & np.isnan(q))
    in_b = differ & (np.isfinite(q) | np.isnan(p))
    return int(differ.sum() - in_b.sum()), int(in_b.sum())


def _sizes(x: np.ndarray, y: np.ndarray, period: float | None) -> tuple[float, float, float]:
    """The largest size, the mean and the root mean square of y - x; in place, since they fill the memory."""
    d = y - x if period is None else wrapped(y - x, period)
    mean = float(d.mean())
    np.abs(d, out=d)
    largest = float(d.max())
    np.square(d, out=d)
    return largest, mean, float(np.sqrt(d.mean()))


def _psnr(data_range: float, rms: float) -> float:
    """dB; inf for rms = 0, -inf for a range of 0 or rms = inf."""
    if rms == 0:
        return math.inf
    if data_range == 0 or rms == math.inf:
        return -math.inf
    return 20 * math.log10(data_range / rms)


def _correlation(x: np.ndarray, y: np.ndarray) -> float:
    """Pearson's coefficient; NaN where x or y is constant. Takes their means off them in place."""
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        return math.nan
    x -= x.mean()
    y -= y.mean()
    return _normalised_product(x, y)


def _circular_correlation(x: np.ndarray, y: np.ndarray, period: float) -> float:
    """The coefficient of Jammalamadaka and SenGupta: Pearson's with sines of deviations from the mean direction.

    Where the angles are spread over the circle that direction means nothing, and what is left is how far x - y agree
    more than x + y: their form for uniform angles.
    """
    if np.ptp(x) == 0 or np.ptp(y) == 0:
        return math.nan
    turn = 2 * np.pi / period
    means = [np.exp(1j * turn * t).mean() for t in (x, y)]
    if min(map(abs, means)) < SPREAD:
        return float(abs(np.exp(1j * turn * (x - y)).mean()) - abs(np.exp(1j * turn * (x + y)).mean()))
    p, q = (np.sin(turn * t - np.angle(mean)) for t, mean in zip((x, y), means, strict=True))
    return _normalised_product(p, q)


def _normalised_product(p: np.ndarray, q: np.ndarray) -> float:
    # Sums, not @, which BLAS adds up in an order of its threads.
    size = math.sqrt(float((p * p).sum()) * float((q * q).sum()))
    return float((p * q).sum()) / size if size > 0 else math.nan
