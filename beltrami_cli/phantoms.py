"""Surfaces with known data: a level set, the clean values and the noisy ones, made from formulas.

Psi is in voxels of 1 mm and negative inside. Clean values fill the whole volume, or a ribbon of the cortex: a voxel
holds the value at its nearest surface point, so that they are constant along normals. Noise is Gaussian, independent in
every voxel.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from beltrami_cli.errors import RefusedError
from beltrami_cli.grid import Grid, Volume

if TYPE_CHECKING:
    from beltrami_cli.levelset import ZeroSurface

# A symmetric place hides errors and puts zeros of Psi on voxels: the centre lies off every voxel and face (in voxels).
OFF_GRID = 0.137

# Below, the tube of the torus has a radius under 2 voxels; above, the formulas' float64 arrays take more than 10 GB.
SIZES = (16, 512)

# The cortex at size 72, in mm: the lobe's semi-axes; half-width and depth of a sulcus; half the ribbon's thickness.
LOBE = np.array([24.0, 29.0, 23.0])
SULCUS = (1.9, 8.5)
RIBBON = 4.0
# Radians of the folding pattern per radian around the lobe: sulci are about 9 mm apart.
FOLDING = 9.4
# Where V1, V2 and V3 end, in mm over the surface from the fundus of the calcarine sulcus.
BORDERS = (0.0, 11.0, 18.0, 25.0)
# Regions without data: (u, v, radius) in mm, as in `cortex`.
HOLES = ((-9.0, 5.0, 3.0), (1.0, -7.0, 3.5), (-3.0, 15.0, 3.0), (13.0, 4.0, 2.5), (-8.0, -16.0, 3.5), (5.0, 21.0, 2.5))


@dataclass(frozen=True, eq=False)
class Phantom:
    """A surface and the data on it, on one grid.

    levelset, clean, noisy: float32 arrays of one shape: (size, size, size), or (size, size) for the curve; colours have
        three channels on a further axis of clean and noisy.
    grid: voxels of 1 mm; its shape has a third axis of length 1 for the curve.
    """

    levelset: np.ndarray
    clean: np.ndarray
    noisy: np.ndarray
    grid: Grid

    def volumes(self) -> dict[str, Volume]:
        """`levelset`, `clean` and `noisy` as volumes that remember the arrays' own shape."""
        arrays = {"levelset": self.levelset, "clean": self.clean, "noisy": self.noisy}
        channels = {name: a.shape[self.levelset.ndim :] for name, a in arrays.items()}
        return {
            name: Volume(a.reshape(self.grid.shape + channels[name]), self.grid, a.shape) for name, a in arrays.items()
        }


def torus(size: int = 64, *, noise: float = 40.0, seed: int = 0, map: str = "mixed") -> Phantom:
    """Torus with radii 18 and 8 voxels at size 64 (5,700 voxels with |Psi| < 0.5; size 95 has the paper's 12,500).

    map: with theta around the axis and phi around the tube,
    `mixed`  90 + 50 cos 2phi where sin 2theta > 0, else 180 + 40 sin 3theta: smooth parts and borders;
    `pieces` 200 where sin 3theta sin 2phi > 0, else 60;
    `smooth` 128 + 60 sin 2theta + 40 cos 3phi;
    `angle`  degrees in 0..360, 2 theta + 40 sin phi, which wraps twice around the axis; so does its noise.
    """
    x, y, z = _centred(size, 3)
    ring = np.hypot(x, y) - 18 * size / 64
    psi = np.hypot(ring, z) - 8 * size / 64
    theta, phi = np.arctan2(y, x), np.arctan2(z, ring)
    if map == "mixed":
        clean = np.where(np.sin(2 * theta) > 0, 90 + 50 * np.cos(2 * phi), 180 + 40 * np.sin(3 * theta))
    elif map == "pieces":
        clean = np.where(np.sin(3 * theta) * np.sin(2 * phi) > 0, 200.0, 60.0)
    elif map == "smooth":
        clean = 128 + 60 * np.sin(2 * theta) + 40 * np.cos(3 * phi)
    elif map == "angle":
        clean = (np.rad2deg(2 * theta) + 40 * np.sin(phi)) % 360
    else:
        raise RefusedError(f"map of the torus: found {map!r}, expected mixed, pieces, smooth or angle")
    made = _phantom(psi, clean, noise, seed)
    return replace(made, noisy=made.noisy % np.float32(360)) if map == "angle" else made


def sphere(size: int = 48, *, noise: float = 40.0, seed: int = 0) -> Phantom:
    """Sphere of radius size/3 with 85 + 85 (3 cos^2 - 1), 0 to 255, cos measured from the axis (1, 2, 2)/3.

    The pattern is a spherical harmonic of degree 2: heat flow scales its second term by exp(-6 t / R^2).
    """
    x = _centred(size, 3)
    radius = np.sqrt((x**2).sum(0))
    cosine = np.tensordot(np.array([1, 2, 2]) / 3, x, 1) / radius
    return _phantom(radius - size / 3, 255 * cosine**2, noise, seed)


def plane(size: int = 48, *, noise: float = 40.0, seed: int = 0) -> Phantom:
    """Oblique plane with normal (1, 2, 3): values ramp by 70 over `size` voxels, with an edge of 110 along the ramp."""
    x = _centred(size, 3)
    psi, along, across = (
        np.tensordot(np.array(axis) / np.linalg.norm(axis), x, 1) for axis in ((1, 2, 3), (3, 0, -1), (1, -5, 3))
    )
    return _phantom(psi, 70 + 70 * along / size + np.where(across > 0, 110.0, 0.0), noise, seed)


def curve(size: int = 128, *, noise: float = 15.0, seed: int = 0) -> Phantom:
    """Closed curve r(t) = 0.3 size (1 + 0.18 cos 3t) in a plane, with 128 + 45 sin 2t, raised by 60 on 0.8 < t < 2.2
    and lowered by 60 on 4 < t < 5: four jumps. The arrays have two axes."""
    x = _centred(size, 2)
    t = _nearest_parameter(x, 0.3 * size)
    inside = np.hypot(*x) < np.hypot(*_trefoil(np.arctan2(x[1], x[0]), 0.3 * size)[0])
    distance = np.hypot(*(x - _trefoil(t, 0.3 * size)[0]))
    jumps = np.where((t > 0.8) & (t < 2.2), 60.0, 0.0) - np.where((t > 4) & (t < 5), 60.0, 0.0)
    return _phantom(np.where(inside, -distance, distance), 128 + 45 * np.sin(2 * t) + jumps, noise, seed)


def portrait(size: int = 64, *, noise: float = 40.0, seed: int = 0, map: str = "grey") -> Phantom:
    """A portrait (Eileen Collins, by NASA, in the public domain) on an ellipsoid; size 140 has 2,744,000 voxels.

    The picture, 0 to 255, is projected along the second axis onto the front, its mirror image onto the back.
    map: `grey`, or `rgb` for three channels.
    """
    if map not in ("grey", "rgb"):
        raise RefusedError(f"map of the portrait: found {map!r}, expected grey or rgb")
    from scipy.ndimage import map_coordinates
    from skimage import data
    from skimage.color import rgb2gray
    from skimage.transform import resize

    axes = np.array([0.36, 0.30, 0.42]) * size
    x = _centred(size, 3)
    nearest = _nearest_on_ellipsoid(x, axes)
    outside = np.tensordot(1 / axes**2, x**2, 1) > 1
    distance = np.sqrt(((x - nearest) ** 2).sum(0))

    head = data.astronaut()[0:256, 104:324]
    channels = np.moveaxis(head / 255, -1, 0) if map == "rgb" else rgb2gray(head)[None]
    # One pixel per voxel where the surface faces the viewer: finer detail would only alias.
    rows, columns = (2 * round(float(a)) for a in axes[[2, 0]])
    row = (1 - nearest[2] / axes[2]) / 2 * (rows - 1)
    column = (1 - nearest[0] / axes[0]) / 2 * (columns - 1)  # seen from the front, +x (right) is on the left
    pictures = [255 * resize(channel, (rows, columns), anti_aliasing=True) for channel in channels]
    painted = [map_coordinates(picture, [row, column], order=1, mode="nearest") for picture in pictures]
    clean = np.stack(painted, -1) if map == "rgb" else painted[0]
    return _phantom(np.where(outside, distance, -distance), clean, noise, seed)


def sulcus(
    size: int = 48,
    *,
    noise: float = 5.0,
    seed: int = 0,
    gap: float = 2.0,
    direction: tuple[float, float, float] = (0.9, -0.5, 0.4),
) -> Phantom:
    """Two wavy banks of tissue (Psi < 0) at means 0 and 100, facing each other across a gap (Psi > 0).

    gap: width between the banks in voxels. direction: from the bank at 0 to the bank at 100.
    With s = direction . x + 1.4 sin(y/6.5 + 0.3) cos(z/7.5), Psi = gap/2 - |s|: near a distance, not exactly one.
    """
    if not gap > 0:
        raise RefusedError(f"gap of the sulcus: found {gap:g}, expected a width above 0 voxels")
    x = _centred(size, 3, off_grid=0.0)
    axis = np.array(direction) / np.linalg.norm(direction)
    s = np.tensordot(axis, x, 1) + 1.4 * np.sin(x[1] / 6.5 + 0.3) * np.cos(x[2] / 7.5)
    return _phantom(gap / 2 - np.abs(s), np.where(s > 0, 100.0, 0.0), noise, seed)


def cortex(size: int = 72, *, noise: float = 0.6, seed: int = 0) -> Phantom:
    """A folded lobe, sulci 3 to 4 mm wide and 8 deep at size 72, with polar angle in degrees, 0..360, of three areas.

    0 is the right horizontal meridian, 90 the upper vertical one, 270 the lower, as in a left hemisphere. Let v be the
    distance over the surface from the fundus of the calcarine sulcus (above it v > 0) and u the place along it, in mm.
    The angle is a for v < 0 and 360 - a for v > 0, where a rises from 0 to 90 up to |v| = 11 (V1), falls to 0 up to 18
    (V2), and rises to 90 up to 25 (V3): at the borders fields mirror each other. Past u = 7 + 2 sin(v/3) lies a second
    cluster, where upper and lower field change places: a border with jumps of 0 to 180 degrees. Values are NaN where
    |v| > 25 or |u| > 17, and farther than 4 mm from the surface.

    noise: s of arg(exp(i a) + s (n1 + i n2)) with n1 and n2 normal; 32 degrees in the mean at 0.6. Noisy data have
    six holes 5 to 7 mm wide. Psi is the exact distance to its own mesh, up to 6 mm. The grid lies where an occipital
    lobe does: left of x = 0 and behind y = 0 in RAS mm. Under a size of 56 sulci are too narrow for the voxels.
    """
    from beltrami_cli.distance import signed_distance
    from beltrami_cli.levelset import zero_surface
    from beltrami_cli.repair import repaired
    from beltrami_cli.surface import Mesh

    _require_noise(noise, seed)
    x, mm = _centred(size, 3), size / 72
    grid = Grid.from_spacing((size,) * 3)
    surface = zero_surface(_lobe(x, mm), grid.spacing)
    psi = signed_distance(repaired(Mesh(surface.points, surface.cells)), grid)

    ribbon = np.abs(psi) < RIBBON * mm
    u, v = _at_feet(surface, _places(surface, -x[:, 0, 0, 0], mm), np.argwhere(ribbon)).T
    clean, noisy = np.full((2, *psi.shape), np.nan)
    clean[ribbon] = np.where((np.abs(v) < BORDERS[-1]) & (np.abs(u) < 17), _polar_angle(u, v), np.nan)
    parts = np.random.default_rng(seed).standard_normal((2, len(u)))
    wave = np.exp(1j * np.deg2rad(clean[ribbon])) + noise * (parts[0] + 1j * parts[1])
    in_hole = np.any([np.hypot(u - a, v - b) < radius for a, b, radius in HOLES], axis=0)
    noisy[ribbon] = np.where(in_hole, np.nan, np.rad2deg(np.angle(wave)))
    behind_left = Grid(grid.shape, np.array([[1.0, 0, 0, -size], [0, 1, 0, -size], [0, 0, 1, -size / 2], [0, 0, 0, 1]]))
    return Phantom(psi, _turned(clean), _turned(noisy), behind_left)


PHANTOMS: dict[str, Callable[..., Phantom]] = {
    "torus": torus,
    "sphere": sphere,
    "plane": plane,
    "curve": curve,
    "portrait": portrait,
    "sulcus": sulcus,
    "cortex": cortex,
}


def make(name: str, *, size: int | None = None, noise: float | None = None, seed: int = 0, **options: Any) -> Phantom:
    """The phantom of that name; None leaves its own default, `options` are its own keywords (map, gap, direction).

    Raises RefusedError for an unknown name or a value out of range.
    """
    if name not in PHANTOMS:
        raise RefusedError(f"phantom: found {name!r}, expected one of {', '.join(PHANTOMS)}")
    if size is not None:
        options["size"] = size
    if noise is not None:
        options["noise"] = noise
    return PHANTOMS[name](seed=seed, **options)


def _centred(size: int, dimensions: int, *, off_grid: float = OFF_GRID) -> np.ndarray:
    """(dimensions, size, ...) coordinates in voxels from a centre that is off the grid's own by -off_grid."""
    if not SIZES[0] <= size <= SIZES[1]:
        raise RefusedError(f"size of the phantom: found {size}, expected {SIZES[0]} to {SIZES[1]} voxels")
    return np.indices((size,) * dimensions) - ((size - 1) / 2 - off_grid)


def _phantom(psi: np.ndarray, clean: np.ndarray, noise: float, seed: int) -> Phantom:
    """float32 arrays on a grid of 1 mm; `noise` is the standard deviation in data units."""
    _require_noise(noise, seed)
    noisy = clean + noise * np.random.default_rng(seed).standard_normal(clean.shape)
    single = np.float32
    return Phantom(psi.astype(single), clean.astype(single), noisy.astype(single), Grid.from_spacing(psi.shape))


def _require_noise(noise: float, seed: int) -> None:
    if not 0 <= noise < np.inf:
        raise RefusedError(f"noise of the phantom: found {noise:g}, expected a finite standard deviation of at least 0")
    if seed < 0:
        raise RefusedError(f"seed of the phantom: found {seed}, expected a whole number of at least 0")


def _trefoil(t: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    """Points (2, ...) of the curve r(t) = radius (1 + 0.18 cos 3t), and their derivatives by t."""
    r, dr = radius * (1 + 0.18 * np.cos(3 * t)), -0.54 * radius * np.sin(3 * t)
    c, s = np.cos(t), np.sin(t)
    return np.stack([r * c, r * s]), np.stack([dr * c - r * s, dr * s + r * c])


def _nearest_parameter(x: np.ndarray, radius: float) -> np.ndarray:
    """t in [0, 2 pi) of the curve's point nearest to each x (2, ...)."""
    from scipy.spatial import cKDTree

    samples = np.linspace(0, 2 * np.pi, 8192, endpoint=False)
    t = samples[cKDTree(_trefoil(samples, radius)[0].T).query(x.reshape(2, -1).T)[1]].reshape(x.shape[1:])
    # One Gauss-Newton step along the tangent: the samples' spacing enters the distance squared, below float32.
    point, tangent = _trefoil(t, radius)
    t += ((x - point) * tangent).sum(0) / (tangent**2).sum(0)
    return t % (2 * np.pi)


def _nearest_on_ellipsoid(x: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """The point of the ellipsoid with semi-axes `axes` (3,) nearest to each x (3, ...), all in voxels.

    It is axes^2 x / (t + axes^2) with t the root of sum (axes x / (t + axes^2))^2 = 1: a convex function of t, so that
    Newton's steps climb to the root from the left, where one term alone is 1.
    """
    a = axes.reshape(3, *[1] * (x.ndim - 1))
    t = (a * np.abs(x) - a**2).max(0)
    for _ in range(12):
        share = (a * x / (t + a**2)) ** 2
        t += (share.sum(0) - 1) / (2 * (share / (t + a**2)).sum(0))
    return a**2 * x / (t + a**2)


def _lobe(x: np.ndarray, mm: float) -> np.ndarray:
    """(n, n, n) in voxels: a function whose zero is a folded ellipsoid, |x| less the radius in that direction.

    The radius is an ellipsoid's, lowered by depth * exp(-(s/width)^4) at s mm from the middle of a sulcus: the zero set
    of a random wave, and the calcarine sulcus in a clearing of it. A little blur rounds what voxels cannot show.
    """
    from scipy.ndimage import gaussian_filter

    radius = np.sqrt((x**2).sum(0))
    direction = x / radius
    width, depth = SULCUS
    u, s, front = _along_calcarine(direction)
    clearing = front * np.exp(-((s / 7) ** 4) - (u / 20) ** 6)
    folds = np.exp(-((LOBE.mean() * _wave_zero(direction) / width) ** 4)) * (1 - clearing)
    calcarine = front * np.exp(-((s / width) ** 4) - (u / 18) ** 6)
    lowered = 1 / np.sqrt(np.tensordot(1 / LOBE**2, direction**2, 1)) - depth * (folds + calcarine)
    return gaussian_filter(np.clip(radius / mm - lowered, -3, 3), 0.7 * mm).astype(np.float32)


def _along_calcarine(direction: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of directions (3, ...), in mm on a sphere of the lobe's size: u along the sulcus, s across it (it winds), and
    whether they are on its half."""
    centre = np.array([3, -6, 1]) / np.sqrt(46)
    along = np.array([2, 1, 0]) / np.sqrt(5)
    u, s = (LOBE.mean() * np.tensordot(axis, direction, 1) for axis in (along, np.cross(centre, along)))
    return u, s + 2.5 * np.sin(u / 6), np.tensordot(centre, direction, 1) > 0


def _wave_zero(direction: np.ndarray) -> np.ndarray:
    """Of directions (3, ...): about how far, in radians, the zero of a wave is, f / |grad f|.

    f is the sum of 30 plane waves from all sides: those of a Fibonacci lattice, of phases without an order.
    """
    k = np.arange(30) + 0.5
    z, turn = 1 - k / 15, np.pi * (1 + np.sqrt(5)) * k
    f, slope = np.zeros(direction.shape[1:]), np.zeros(direction.shape)
    for j, axis in enumerate(np.stack([np.sqrt(1 - z**2) * np.cos(turn), np.sqrt(1 - z**2) * np.sin(turn), z], 1)):
        phase = FOLDING * np.tensordot(axis, direction, 1) + 2.4 * j**2
        f += np.cos(phase)
        slope -= FOLDING * np.multiply.outer(axis, np.sin(phase))
    slope -= (slope * direction).sum(0) * direction
    # The second term keeps the quotient small where the wave has its crests, without a slope.
    return f / np.sqrt((slope**2).sum(0) + 0.3 * (FOLDING * f) ** 2)


def _places(surface: ZeroSurface, centre: np.ndarray, mm: float) -> np.ndarray:
    """(V, 2) u and v of `cortex`, in mm, at the vertices; `centre` (3,) of the lobe, in voxels."""
    from beltrami_cli.geodesic import distance_over

    rays = (surface.points - centre).T
    u, s, front = _along_calcarine(rays / np.sqrt((rays**2).sum(0)))
    fundus = np.flatnonzero((np.abs(s) < 0.6 / mm) & (np.abs(u) < 19) & front)  # a chain of vertices, one voxel apart
    v = np.sign(s) * distance_over(surface, fundus, np.inf) / mm
    return np.stack([np.where(front, u, np.inf), v], 1)


def _at_feet(surface: ZeroSurface, values: np.ndarray, voxels: np.ndarray) -> np.ndarray:
    """(N, K) values (V, K) of the vertices, at the surface points nearest to voxels (N, 3)."""
    from scipy.spatial import cKDTree

    tree = cKDTree(surface.points)
    nearest = tree.query(voxels)[1]
    normal = surface.normals[nearest]
    feet = voxels - ((voxels - surface.points[nearest]) * normal).sum(1, keepdims=True) * normal
    off, near = tree.query(feet, 4)
    weights = 1 / (off**2 + 1e-6)
    return np.asarray((values[near] * (weights / weights.sum(1, keepdims=True))[:, :, None]).sum(1))


def _polar_angle(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Degrees, -90..90, at the places u and v in mm: see `cortex`."""
    folded = np.interp(np.abs(v), BORDERS, (0, 90, 0, 90))
    return np.where(v < 0, folded, -folded) * np.where(u < 7 + 2 * np.sin(v / 3), 1, -1)


def _turned(angle: np.ndarray) -> np.ndarray:
    """float32 degrees in [0, 360)."""
    single = (angle % 360).astype(np.float32)
    return np.where(single == 360, np.float32(0), single)
