"""Surfaces whose curvature varies little: vertices move along their normals, each between two bounds.

A mesh is given by the rings of its vertices (`start`, `ring`: CSR, symmetric). Lengths in any one unit.
"""

import numba as nb
import numpy as np

from beltrami_cli.kernels import BLOCK

# Least half sum of squares of a ring, in units squared, that a curvature is taken from.
LEAST_RING = 0.01
# Added to a ring's second moments, relative to their sum: a ring on a line, as a polyline's, determines one tilt only.
RIDGE = 1e-4


@nb.njit(cache=True)
def reverse_entries(start, ring):
    """(N,) for each entry of `ring`, where vertex v has w, the entry where w has v."""
    out = np.empty(len(ring), np.int32)
    for v in range(len(start) - 1):
        for q in range(start[v], start[v + 1]):
            w = ring[q]
            for p in range(start[w], start[w + 1]):
                if ring[p] == v:
                    out[q] = p
                    break
    return out


@nb.njit(cache=True)
def solve_symmetric(m, b):
    """x (3,) with M x = b, for M positive definite as its six numbers xx, xy, xz, yy, yz, zz."""
    a, d, e, f, g, h = m[0], m[1], m[2], m[3], m[4], m[5]
    c0, c1, c2 = f * h - g * g, e * g - d * h, d * g - e * f
    det = a * c0 + d * c1 + e * c2
    return (
        (c0 * b[0] + c1 * b[1] + c2 * b[2]) / det,
        (c1 * b[0] + (a * h - e * e) * b[1] + (d * e - a * g) * b[2]) / det,
        (c2 * b[0] + (d * e - a * g) * b[1] + (a * f - d * d) * b[2]) / det,
    )


@nb.njit(cache=True)
def parts(points, v, w, n0, n1, n2):
    """From vertex v to w: the height along the normal n, and the three components along the tangent plane."""
    t0, t1, t2 = points[w, 0] - points[v, 0], points[w, 1] - points[v, 1], points[w, 2] - points[v, 2]
    h = t0 * n0 + t1 * n1 + t2 * n2
    return h, t0 - h * n0, t1 - h * n1, t2 - h * n2


@nb.njit(cache=True, parallel=True)
def mean_curvatures(points, normals, start, ring, across):
    """Mean curvature H (V,), the weights (N,) of what it changes by, sum w_j (u_j - u_i), for heights u (V,); where it
    counts (V,).

    With t and h the parts of x_j - x_i along the tangent plane and the normal, H = sum w h with w = c (1 - a . t). The
    tilt a makes sum w t = 0, so that a tilt of the normal is no curvature however uneven the ring, and c makes
    sum w t^2 = 2. Entries `across` (N,) a border are left out: there, H is the curvature along it. Where the ring is
    too small, or no such weights are, H and w are 0 and do not count.
    """
    curvature, weight, counted = np.zeros(len(points)), np.zeros(len(ring)), np.zeros(len(points), np.bool_)
    for block in nb.prange((len(points) + BLOCK - 1) // BLOCK):
        moments, mean = np.empty(6), np.empty(3)
        for v in range(block * BLOCK, min(len(points), (block + 1) * BLOCK)):
            n0, n1, n2 = normals[v, 0], normals[v, 1], normals[v, 2]
            moments[:] = 0
            mean[:] = 0
            for q in range(start[v], start[v + 1]):
                if across[q]:
                    continue
                h, t0, t1, t2 = parts(points, v, ring[q], n0, n1, n2)
                moments[0] += t0 * t0
                moments[1] += t0 * t1
                moments[2] += t0 * t2
                moments[3] += t1 * t1
                moments[4] += t1 * t2
                moments[5] += t2 * t2
                mean[0] += t0
                mean[1] += t1
                mean[2] += t2
            size = moments[0] + moments[3] + moments[5]
            moments[0] += size * (n0 * n0 + RIDGE)
            moments[1] += size * n0 * n1
            moments[2] += size * n0 * n2
            moments[3] += size * (n1 * n1 + RIDGE)
            moments[4] += size * n1 * n2
            moments[5] += size * (n2 * n2 + RIDGE)
            a0, a1, a2 = solve_symmetric(moments, mean)
            bend, spread = 0.0, 0.0
            for q in range(start[v], start[v + 1]):
                if across[q]:
                    continue
                h, t0, t1, t2 = parts(points, v, ring[q], n0, n1, n2)
                weight[q] = 1 - (a0 * t0 + a1 * t1 + a2 * t2)
                bend += weight[q] * h
                spread += weight[q] * (t0 * t0 + t1 * t1 + t2 * t2)
            counted[v] = spread > 2 * LEAST_RING
            scale = 2 / spread if counted[v] else 0.0
            for q in range(start[v], start[v + 1]):
                weight[q] *= scale
            curvature[v] = scale * bend
    return curvature, weight, counted


@nb.njit(cache=True)
def ring_average(values, counted, start, ring, rounds):
    """(V,) values averaged over each vertex and its ring, so many times, those not counted left out."""
    for _ in range(rounds):
        out = np.zeros_like(values)
        for v in range(len(values)):
            total, number = 0.0, 0
            if counted[v]:
                total, number = values[v], 1
            for q in range(start[v], start[v + 1]):
                if counted[ring[q]]:
                    total += values[ring[q]]
                    number += 1
            out[v] = total / max(number, 1)
        values = out
    return values


@nb.njit(cache=True)
def fair_heights(constant, weight, start, ring, back, low, high, middle, pull, steps):
    """u (V,) between low and high with the least |A u + constant|^2 + pull |u - middle|^2, A u = sum w_j (u_j - u_i).

    Accelerated projected gradients (Nesterov), restarted where they overshoot (O'Donoghue and Candes 2015). The step of
    each unknown is the row sum of |A^T| |A|, which majorises A^T A. In one thread: threads would meet at every step.
    """
    count = len(constant)
    transposed = weight[back]
    total, size, bound = np.zeros(count, weight.dtype), np.zeros(count), np.zeros(count, weight.dtype)
    for v in range(count):
        for q in range(start[v], start[v + 1]):
            total[v] += weight[q]
            size[v] += abs(weight[q])
        size[v] += abs(total[v])
    for v in range(count):
        bound[v] = pull + abs(total[v]) * size[v]
        for q in range(start[v], start[v + 1]):
            bound[v] += abs(transposed[q]) * size[ring[q]]
    u = np.minimum(np.maximum(weight.dtype.type(0), low), high)
    ahead, residual = u.copy(), np.empty_like(u)
    pace = 1.0
    for _ in range(steps):
        for v in range(count):
            r = constant[v] - total[v] * ahead[v]
            for q in range(start[v], start[v + 1]):
                r += weight[q] * ahead[ring[q]]
            residual[v] = r
        following = (1 + np.sqrt(1 + 4 * pace**2)) / 2
        momentum = (pace - 1) / following
        overshoot = 0.0
        for v in range(count):
            slope = pull * (ahead[v] - middle[v]) - total[v] * residual[v]
            for q in range(start[v], start[v + 1]):
                slope += transposed[q] * residual[ring[q]]
            moved = min(max(ahead[v] - slope / bound[v], low[v]), high[v])
            overshoot += bound[v] * (ahead[v] - moved) * (moved - u[v])
            ahead[v] = moved + momentum * (moved - u[v])
            u[v] = moved
        pace = 1.0 if overshoot > 0 else following
    return u
