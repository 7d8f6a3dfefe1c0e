"""Plain NumPy twins of the kernels: dense, slow and short, so that they can be checked by reading."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise, product

import numpy as np

from beltrami_cli.kernels import steps

# c as a function of the slope in units of the edge, s = beta |v|.
DIFFUSIVITY = {
    steps.ONE: lambda s: np.ones_like(s),
    steps.R: lambda s: (1 + s**2) ** -0.5,
    steps.R2: lambda s: (1 + s**2) ** -1.0,
    steps.R4: lambda s: (1 + s**2) ** -2.0,
    steps.WEICKERT: lambda s: 1 - np.exp(-3.31488 / np.maximum(s, 1e-3) ** 8),
}


# --- one step of a flow ---------------------------------------------------------------------------------------------


def difference_matrices(forward, backward, spacing):
    """(2, 3, E, E): forward and backward differences along each axis, per mm; a row of 0 where the link is missing."""
    entries = forward.shape[1]
    d = np.zeros((2, 3, entries, entries))
    for a in range(3):
        for m in range(entries):
            for side, (low, high) in enumerate([(m, forward[a, m]), (backward[a, m], m)]):
                d[side, a, m, high] += 1 / spacing[a]
                d[side, a, m, low] -= 1 / spacing[a]
    return d


def projection(normal):
    """(3, 3, E): P = I - n n^T."""
    return np.eye(3)[:, :, None] - normal[:, None] * normal[None]


def tangential(normal, d, u):
    """(K, 3, E): v = P g of every channel, the differences g = d u by the matrices d (3, E, E)."""
    return np.einsum("abm,bmi,ki->kam", projection(normal), d, u, optimize=True)


# A coupling is a function of v (K, 3, E), P (3, 3, E) and beta that gives T (3, 3, E), by which channel k has the flux
# T v_k, and the outer factor a (E,).


def shared(law):
    """One diffusivity in all directions: T = c P at s = beta sqrt(sum_k |v_k|^2), a = c."""

    def coupling(v, p, beta):
        c = DIFFUSIVITY[law](beta * np.sqrt((v**2).sum((0, 1))))
        return c * p, c

    return coupling


def by_metric(v, p, beta):
    """T = sqrt(det A) P A^-1 P and a = 1 / sqrt(det A), with A = I + beta^2 V V^T, V the matrix [v_1 ... v_K]."""
    matrix = np.eye(3) + beta**2 * np.einsum("kam,kbm->mab", v, v)
    size = np.sqrt(np.linalg.det(matrix))
    inverse = np.moveaxis(np.linalg.inv(matrix), 0, -1)
    return size * np.einsum("abm,bcm,cdm->adm", p, inverse, p), 1 / size


def gram_fluxes(v, beta):
    """(K, 3, E) sum_l C_kl v_l with C = sqrt(det M) M^-1, M = I + beta^2 V^T V."""
    m = np.eye(len(v)) + beta**2 * np.einsum("kam,lam->mkl", v, v)
    c = np.sqrt(np.linalg.det(m))[:, None, None] * np.linalg.inv(m)
    return np.einsum("mkl,lam->kam", c, v)


def symmetric(u, normal, forward, backward, spacing, coupling, outer, beta, dt):
    """One step of u (K, E): minus the exact gradient of the mean of sum_k g_k^T T g_k / 2 over the 8 choices of g.

    T is taken at the central differences, and held fixed. Returns (u after the step, sum of squared changes, energy).
    """
    d = difference_matrices(forward, backward, spacing)
    t, a = coupling(tangential(normal, d.mean(0), u), projection(normal), beta)
    rate, energy = np.zeros(u.shape), 0.0
    for sides in product((0, 1), repeat=3):
        g = np.stack([d[side, a] for a, side in enumerate(sides)])
        slope = np.einsum("ami,ki->kam", g, u)
        flux = np.einsum("abm,kbm->kam", t, slope)
        rate -= np.einsum("ami,kam->ki", g, flux) / 8
        energy += (flux * slope).sum() / 16
    change = dt * (a if outer else 1) * rate
    return u + change, (change**2).sum(), energy


def symmetric_by_fluxes(u, normal, forward, backward, spacing, coupling, outer, beta, dt):
    """The same step written as a finite-volume scheme: fluxes through the faces between linked entries."""
    own = np.arange(u.shape[1])
    p = projection(normal)
    h = np.asarray(spacing)[:, None]
    g = (u[:, forward] - u[:, backward]) / (2 * h)  # a missing link adds 0 to either side
    t, outer_factor = coupling(np.einsum("abm,kbm->kam", p, g), p, beta)
    rate = np.zeros(u.shape)
    for a in range(3):
        q = sum(t[a, b] * g[:, b] for b in range(3) if b != a)
        f = forward[a]
        flux = (t[a, a] + t[a, a, f]) * (u[:, f] - u) / 2 / h[a] + (q + q[:, f]) / 2
        flux[:, f == own] = 0
        rate += flux / h[a] - np.where(backward[a] == own, 0, flux[:, backward[a]]) / h[a]
    return u + dt * (outer_factor if outer else 1) * rate


def paper(u, normal, forward, backward, spacing, coupling, outer, beta, dt):
    """Sec. 4.1 with |N| = 1: forward gradient and its adjoint, the backward divergence. Returns as `symmetric`."""
    d = difference_matrices(forward, backward, spacing)[0]
    v = tangential(normal, d, u)
    t, a = coupling(v, projection(normal), beta)
    flux = np.einsum("abm,kbm->kam", t, v)
    change = -dt * (a if outer else 1) * np.einsum("ami,kam->ki", d, flux)
    return u + change, (change**2).sum(), (flux * v).sum() / 2


def largest_over_faces(tensor, outer, forward):
    """The most, over the faces i|j and both their sides, of a_i lambda_max(T_i + T_j) / 2."""
    t, own = np.moveaxis(tensor, -1, 0), np.arange(len(outer))
    return max(
        float((np.maximum(outer, outer[f]) * np.linalg.eigvalsh(t + t[f])[:, -1] / 2)[f != own].max(initial=0))
        for f in forward
    )


def fastest_decay(name, tensor, outer, forward, backward, spacing):
    """The largest eigenvalue, per mm^2, of what a scheme multiplies u by while a and T (3, 3, E) stay fixed."""
    d = difference_matrices(forward, backward, spacing)
    choices = list(product((0, 1), repeat=3)) if name == "symmetric" else [(0, 0, 0)]
    rate = np.zeros((len(outer), len(outer)))
    for sides in choices:
        g = np.stack([d[side, a] for a, side in enumerate(sides)])
        rate += np.einsum("ami,abm,bmj->ij", g, tensor, g, optimize=True) / len(choices)
    root = np.sqrt(outer)
    return float(np.linalg.eigvalsh(root[:, None] * rate * root)[-1])


# --- interpolation on a sheet ---------------------------------------------------------------------------------------


def walk(e, moves, forward, backward):
    """The entry `moves` (3,) voxels away, one link at a time in turn along each axis that still has one; else None."""
    left = list(moves)
    while any(left):
        stuck = True
        for a in range(3):
            table = forward if left[a] > 0 else backward
            if left[a] and table[a, e] != e:
                e = table[a, e]
                left[a] -= int(np.sign(left[a]))
                stuck = False
        if stuck:
            return None
    return e


def lagrange(t):
    """(4,) weights at t of the cubic through the nodes -1, 0, 1, 2."""
    x = np.arange(-1.0, 3.0)
    return np.array([np.prod([(t - x[j]) / (x[i] - x[j]) for j in range(4) if j != i]) for i in range(4)])


def cubic_at(volume, ijk):
    """Local cubic of a dense volume at a point ijk (3,) in voxels, within the range of the eight nodes around it.

    NaN where one of the 64 nodes is outside or NaN. An axis of length 1 takes no part.
    """
    value, cell = cubic_and_cell(volume, ijk)
    return np.clip(value, cell.min(), cell.max())


def cubic_vector_at(volumes, ijk):
    """(K,) local cubics of the volumes (K, nx, ny, nz): as a vector no longer than the longest of the eight nodes."""
    values, cells = zip(*(cubic_and_cell(volume, ijk) for volume in volumes), strict=True)
    most = np.sqrt((np.stack(cells) ** 2).sum(0)).max()
    return np.array(values) * min(1, most / max(np.linalg.norm(values), 1e-300))


def cubic_and_cell(volume, ijk):
    """The cubic itself, and the values of the nodes around."""
    low = np.floor(ijk).astype(int)
    nodes = [np.arange(x - 1, x + 3) if n > 1 else np.array([0]) for x, n in zip(low, volume.shape, strict=True)]
    if any(x[0] < 0 or x[-1] >= n for x, n in zip(nodes, volume.shape, strict=True)):
        return np.nan, np.array([np.nan])
    weights = [lagrange(t) if n > 1 else np.ones(1) for t, n in zip(ijk - low, volume.shape, strict=True)]
    block = volume[np.ix_(*nodes)]
    cell = block[tuple(slice(1, 3) if n > 1 else slice(None) for n in volume.shape)]
    return np.einsum("ijk,i,j,k", block, *weights), cell


def linear_at(u, confidence, e, offset, forward, backward, least):
    """Sums of confidence times u (K, E), and of confidence, over the corners of the cell at `offset` (3,) from entry e.

    Trilinear weights of the corners that are reached and have confidence; zeros where these weights are too few.
    """
    low = np.floor(offset).astype(int)
    total, mass, weight = np.zeros(len(u)), 0.0, 0.0
    for corner in product((0, 1), repeat=3):
        w = np.prod([t if k else 1 - t for t, k in zip(offset - low, corner, strict=True)])
        reached = walk(e, low + corner, forward, backward)
        if w > 0 and reached is not None and confidence[reached] > 0:
            total += w * confidence[reached] * u[:, reached]
            mass += w * confidence[reached]
            weight += w
    return (total, mass) if weight > least else (np.zeros(len(u)), 0.0)


# --- extension ------------------------------------------------------------------------------------------------------


def transport(u, normal, distance, forward, backward, spacing, width, dt):
    """One upwind step of U_t + s grad U . n = 0 with s = d / sqrt(d^2 + width^2)."""
    out = u.copy()
    for m in range(len(u)):
        speed = distance[m] / np.hypot(distance[m], width) * normal[:, m] / spacing
        upwind = [(backward if s > 0 else forward)[a, m] for a, s in enumerate(speed)]
        known = [(abs(s), u[e]) for s, e in zip(speed, upwind, strict=True) if e != m and not np.isnan(u[e])]
        if not np.isnan(u[m]):
            out[m] -= dt * sum(s * (u[m] - value) for s, value in known)
        elif sum(s for s, _ in known) > np.abs(speed).sum() / 2:
            out[m] = sum(s * value for s, value in known) / sum(s for s, _ in known)
    return out


def flood(u, forward, backward):
    """Ring by ring: every unknown entry of u (E,) with a known neighbour takes the mean of its known neighbours."""
    u = u.copy()
    while True:
        around = np.concatenate([u[forward], u[backward]])
        count = (~np.isnan(around)).sum(0)
        new = np.isnan(u) & (count > 0)
        if not new.any():
            return u
        u[new] = np.nansum(around, 0)[new] / count[new]


def harmonic(u, free, forward, backward, spacing):
    """u (K, E) with the entries `free` (F,) such that the 7-point Laplacian over links vanishes there."""
    ahead, behind = difference_matrices(forward, backward, spacing)
    laplacian = sum((a - b) / h for a, b, h in zip(ahead, behind, spacing, strict=True))[free]
    out, fixed = u.copy(), np.setdiff1d(np.arange(u.shape[1]), free)
    out[:, free] = np.linalg.solve(laplacian[:, free], -laplacian[:, fixed] @ u[:, fixed].T).T
    return out


# --- geometry -------------------------------------------------------------------------------------------------------


def neighbours(cells) -> list[set[int]]:
    """Vertices joined to each vertex by an edge of a triangle or segment."""
    around: list[set[int]] = [set() for _ in range(cells.max() + 1)]
    for cell in cells.tolist():
        for a, b in pairwise([*cell, cell[0]]):
            around[a].add(b)
            around[b].add(a)
    return around


def closest_on_quadric(x, k1, k2):
    """Closest point to x (3,) on z = -(k1 x^2 + k2 y^2) / 2, by Newton's method from the foot on the plane z = 0."""
    k, s = np.array([k1, k2]), np.array(x[:2], float)
    for _ in range(50):
        gap = x[2] + (k * s**2).sum() / 2
        gradient = s - x[:2] + gap * k * s
        hessian = np.diag(1 + gap * k) + np.outer(k * s, k * s)
        s = s - np.linalg.solve(hessian, gradient)
    return np.array([*s, -(k * s**2).sum() / 2])


def closest_on_triangle(p, corners):
    """Weights (3,) of the corners (3, 3) for the point of a triangle nearest to p, and its squared distance.

    The nearest of: the foot on the plane where it lies within, the feet on the edges, the corners.
    """
    found = list(np.eye(3))
    for i, j in ((0, 1), (1, 2), (2, 0)):
        edge = corners[j] - corners[i]
        if (edge**2).sum() > 0:
            t = np.clip((p - corners[i]) @ edge / (edge @ edge), 0, 1)
            found.append((1 - t) * np.eye(3)[i] + t * np.eye(3)[j])
    sides = np.stack([corners[1] - corners[0], corners[2] - corners[0]], 1)
    if np.linalg.matrix_rank(sides) == 2:
        v, w = np.linalg.lstsq(sides, p - corners[0], rcond=None)[0]
        if min(v, w, 1 - v - w) >= 0:
            found.append(np.array([1 - v - w, v, w]))
    apart = [((p - weights @ corners) ** 2).sum() for weights in found]
    return found[int(np.argmin(apart))], min(apart)


def straight_on(points, around, before, here):
    """Of the neighbours `around` one vertex, the one least off the direction from `before` to it, ahead; else -1."""
    way = points[here] - points[before]
    to = {w: points[w] - points[here] for w in around[here] if np.linalg.norm(points[w] - points[here]) > 0}
    cosine = {w: way @ step / np.linalg.norm(step) for w, step in to.items()}
    best = max(cosine, key=cosine.__getitem__, default=-1)
    return best if best >= 0 and cosine[best] > 0 else -1


def entry_at_point(band, ijk, own):
    """The entry, of those in the 8 voxels around ijk (3,), whose vertex is nearest to `own` on the same side; or -1."""
    surface, at = band.surface, np.stack(np.unravel_index(band.voxel, band.box_shape), 1)
    near = np.all((at == np.floor(ijk)) | (at == np.floor(ijk) + 1), axis=1)
    near &= band.normal.T @ surface.normals[own] > 0
    if not near.any():
        return -1
    apart = np.linalg.norm((surface.points[band.vertex] - surface.points[own]) / band.grid.spacing, axis=1)
    e = int(np.where(near, apart, np.inf).argmin())
    return e if apart[e] < 2.5 else -1


def opposite_links(band) -> Iterator[np.ndarray]:
    """For each axis (E,) bool: whether every link forward is one backward too, and the other way round."""
    own = np.arange(band.entries)
    for a in range(3):
        f, b = band.forward[a], band.backward[a]
        yield ((f == own) | (band.backward[a, f] == own)) & ((b == own) | (band.forward[a, b] == own))
