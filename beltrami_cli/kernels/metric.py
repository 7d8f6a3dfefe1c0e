"""Fluxes of the Beltrami flow of several channels, coupled by the metric of the surface that they span together.

With V = [v_1 ... v_K] the channels' tangential gradients and M = I_K + beta^2 V^T V their metric in Gram form, the flux
of channel k is sum_l C_kl v_l, C = sqrt(det M) M^-1, and the outer factor a = 1 / sqrt(det M). As V M^-1 = A^-1 V with
the 3 x 3 matrix A = I + beta^2 V V^T, of the same determinant, that is T v_k with one tensor T = sqrt(det A) P A^-1 P
for all channels: none can push another out of its range. Of S = beta^2 V V^T: det A = 1 + tr S + tr adj S + det S, and
adj A = (1 + tr S) I - S + adj S.

Arrays as in `steps`; tensor: (6, E) T as 00, 11, 22, 01, 02, 12; outer: (E,) a; largest: (E,) its largest eigenvalue,
which can exceed 1, and with it what a step may be; tangents: dimensions of the tangent space, 1 for a curve, 2 for a
surface or a picture, 3 for a volume. A scheme returns the sum over entries of sum_k v_k^T T v_k / 2 and the largest
max(a_i, a_j) (largest_i + largest_j) / 2 over the faces i|j, by which dt is to be divided.
"""

import numba as nb
import numpy as np

from beltrami_cli.kernels import BLOCK, total


@nb.njit(cache=True)
def couple(v, b2, normal, m, tangents, tensor, outer, largest):
    """Write T, a and T's largest eigenvalue at entry m from its gradients v (K, 3) at beta^2 = b2."""
    s00, s11, s22, s01, s02, s12 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(len(v)):
        s00 += b2 * v[k, 0] * v[k, 0]
        s11 += b2 * v[k, 1] * v[k, 1]
        s22 += b2 * v[k, 2] * v[k, 2]
        s01 += b2 * v[k, 0] * v[k, 1]
        s02 += b2 * v[k, 0] * v[k, 2]
        s12 += b2 * v[k, 1] * v[k, 2]
    trace = s00 + s11 + s22
    a00, a11, a22 = s11 * s22 - s12 * s12, s00 * s22 - s02 * s02, s00 * s11 - s01 * s01
    a01, a02, a12 = s02 * s12 - s01 * s22, s01 * s12 - s02 * s11, s01 * s02 - s00 * s12
    second = a00 + a11 + a22
    # det A by its pivots, none below 1: the sum above would lose det S in the rounding of (tr S)^3.
    first = 1 + s00
    middle = max(1 + s11 - s01 * s01 / first, 1.0)
    across = s12 - s01 * s02 / first
    size = np.sqrt(first * middle * max(1 + s22 - s02 * s02 / first - across * across / middle, 1.0))
    n0, n1, n2 = float(normal[0, m]), float(normal[1, m]), float(normal[2, m])
    # On a surface adj S lies along the normal, which P removes; without one P = I.
    rest = 0.0 if n0 * n0 + n1 * n1 + n2 * n2 > 0 else 1.0
    tensor[0, m] = ((1 + trace) * (1 - n0 * n0) - s00 + rest * a00) / size
    tensor[1, m] = ((1 + trace) * (1 - n1 * n1) - s11 + rest * a11) / size
    tensor[2, m] = ((1 + trace) * (1 - n2 * n2) - s22 + rest * a22) / size
    tensor[3, m] = (-(1 + trace) * n0 * n1 - s01 + rest * a01) / size
    tensor[4, m] = (-(1 + trace) * n0 * n2 - s02 + rest * a02) / size
    tensor[5, m] = (-(1 + trace) * n1 * n2 - s12 + rest * a12) / size
    outer[m] = 1 / size
    if tangents == 1:
        largest[m] = 1 / size
    elif tangents == 2:
        largest[m] = (1 + (trace + np.sqrt(max(trace**2 - 4 * second, 0.0))) / 2) / size
    else:
        largest[m] = (1 + trace + second) / size


@nb.njit(cache=True, inline="always")
def dot(tensor, m, x):
    """T x at entry m."""
    t01, t02, t12 = tensor[3, m], tensor[4, m], tensor[5, m]
    return (
        tensor[0, m] * x[0] + t01 * x[1] + t02 * x[2],
        t01 * x[0] + tensor[1, m] * x[1] + t12 * x[2],
        t02 * x[0] + t12 * x[1] + tensor[2, m] * x[2],
    )


@nb.njit(cache=True, parallel=True)
def symmetric(u, normal, forward, backward, spacing, beta, tangents, flux, work, tensor, outer, largest):
    """The symmetric scheme of `steps.symmetric` with T in place of c P; its arguments, and (energy, bound)."""
    channels, entries = u.shape
    blocks = (entries + BLOCK - 1) // BLOCK
    energies, bounds = np.zeros(blocks), np.zeros(blocks)
    b2 = float(beta) ** 2
    inverse = 1 / spacing.astype(np.float64)
    for block in nb.prange(blocks):
        ahead, behind = np.empty((channels, 3)), np.empty((channels, 3))
        g, v = np.empty((channels, 3)), np.empty((channels, 3))
        energy = 0.0
        for m in range(block * BLOCK, min(entries, (block + 1) * BLOCK)):
            for k in range(channels):
                along = 0.0
                for a in range(3):
                    ahead[k, a] = (u[k, forward[a, m]] - u[k, m]) * inverse[a]
                    behind[k, a] = (u[k, m] - u[k, backward[a, m]]) * inverse[a]
                    g[k, a] = 0.5 * (ahead[k, a] + behind[k, a])
                    along += normal[a, m] * g[k, a]
                for a in range(3):
                    v[k, a] = g[k, a] - along * normal[a, m]
            couple(v, b2, normal, m, tangents, tensor, outer, largest)
            for k in range(channels):
                whole = dot(tensor, m, g[k])
                for a in range(3):
                    cross = whole[a] - tensor[a, m] * g[k, a]
                    work[k, a, m] = 0.5 * cross * inverse[a]
                    energy += 0.5 * tensor[a, m] * (ahead[k, a] ** 2 + behind[k, a] ** 2) + cross * g[k, a]
        energies[block] = energy
    for block in nb.prange(blocks):
        bound = 0.0
        for m in range(block * BLOCK, min(entries, (block + 1) * BLOCK)):
            for a in range(3):
                e = forward[a, m]
                if e == m:
                    for k in range(channels):
                        flux[k, a, m] = 0
                    continue
                bound = max(bound, max(outer[m], outer[e]) * (largest[m] + largest[e]) / 2)
                across = 0.5 * (tensor[a, m] + tensor[a, e]) * inverse[a] ** 2
                for k in range(channels):
                    flux[k, a, m] = across * (u[k, e] - u[k, m]) + work[k, a, m] + work[k, a, e]
        bounds[block] = bound
    return 0.5 * total(energies), bounds.max()


@nb.njit(cache=True, parallel=True)
def paper(u, normal, forward, backward, spacing, beta, tangents, flux, work, tensor, outer, largest):
    """The scheme of `steps.paper` with T in place of c P; arguments and result as for `symmetric`."""
    channels, entries = u.shape
    blocks = (entries + BLOCK - 1) // BLOCK
    energies, bounds = np.zeros(blocks), np.zeros(blocks)
    b2 = float(beta) ** 2
    inverse = 1 / spacing.astype(np.float64)
    for block in nb.prange(blocks):
        v = np.empty((channels, 3))
        energy = 0.0
        for m in range(block * BLOCK, min(entries, (block + 1) * BLOCK)):
            for k in range(channels):
                along = 0.0
                for a in range(3):
                    v[k, a] = (u[k, forward[a, m]] - u[k, m]) * inverse[a]
                    along += normal[a, m] * v[k, a]
                for a in range(3):
                    v[k, a] -= along * normal[a, m]
            couple(v, b2, normal, m, tangents, tensor, outer, largest)
            for k in range(channels):
                whole = dot(tensor, m, v[k])
                for a in range(3):
                    energy += whole[a] * v[k, a]
                    flux[k, a, m] = whole[a] * inverse[a] if forward[a, m] != m else 0
        energies[block] = energy
    for block in nb.prange(blocks):
        bound = 0.0
        for m in range(block * BLOCK, min(entries, (block + 1) * BLOCK)):
            for a in range(3):
                e = forward[a, m]
                bound = max(bound, max(outer[m], outer[e]) * (largest[m] + largest[e]) / 2)
        bounds[block] = bound
    return 0.5 * total(energies), bounds.max()
