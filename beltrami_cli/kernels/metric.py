"""Fluxes of the Beltrami flow of several channels, coupled by the metric of the surface that they span together.

With V = [v_1 ... v_K] the channels' tangential gradients, M = I_K + beta^2 V^T V is the metric in Gram form; flux_k =
sum_l C_kl v_l with C = sqrt(det M) M^-1, and the outer factor is a = 1 / sqrt(det M). For one channel C = a = r. M enters
through the 3 x 3 matrix A = I_3 + beta^2 V V^T: det M = det A and M^-1 = I_K - beta^2 V^T A^-1 V, so K may be large.

Arrays as in `steps`; tensor: (K, K, E) C; outer: (E,) a. An eigenvalue of C can exceed 1, up to sqrt(det M), and with it
what a step may be: each scheme returns the sum over entries of sum_kl C_kl v_k^T v_l / 2 and the largest
a_i (lambda_max(C_i) + lambda_max(C_j)) / 2 over the faces i|j, by which dt is to be divided.
"""

import numba as nb
import numpy as np

from beltrami_cli.kernels import BLOCK, total


@nb.njit(cache=True)
def couple(v, b2, m, tensor, outer, largest):
    """Write C, a and lambda_max(C) of entry m from its gradients v (K, 3) at beta^2 = b2."""
    channels = len(v)
    a00, a01, a02, a11, a12, a22 = 1.0, 0.0, 0.0, 1.0, 0.0, 1.0
    for k in range(channels):
        a00 += b2 * v[k, 0] * v[k, 0]
        a01 += b2 * v[k, 0] * v[k, 1]
        a02 += b2 * v[k, 0] * v[k, 2]
        a11 += b2 * v[k, 1] * v[k, 1]
        a12 += b2 * v[k, 1] * v[k, 2]
        a22 += b2 * v[k, 2] * v[k, 2]
    c00, c01, c02 = a11 * a22 - a12 * a12, a02 * a12 - a01 * a22, a01 * a12 - a02 * a11
    c11, c12, c22 = a00 * a22 - a02 * a02, a01 * a02 - a00 * a12, a00 * a11 - a01 * a01
    determinant = max(a00 * c00 + a01 * c01 + a02 * c02, 1.0)
    size = np.sqrt(determinant)
    share = b2 / determinant
    for k in range(channels):
        x = share * (c00 * v[k, 0] + c01 * v[k, 1] + c02 * v[k, 2])
        y = share * (c01 * v[k, 0] + c11 * v[k, 1] + c12 * v[k, 2])
        z = share * (c02 * v[k, 0] + c12 * v[k, 1] + c22 * v[k, 2])
        for j in range(k + 1):
            inner = x * v[j, 0] + y * v[j, 1] + z * v[j, 2]
            tensor[k, j, m] = tensor[j, k, m] = size * ((1.0 if j == k else 0.0) - inner)
    outer[m] = 1 / size
    largest[m] = size if channels > 1 else 1 / size


@nb.njit(cache=True, parallel=True)
def symmetric(u, normal, forward, backward, spacing, beta, flux, work, tensor, outer, largest):
    """The symmetric scheme of `steps.symmetric` with C in place of c; its arguments, and (energy, bound)."""
    channels, entries = u.shape
    blocks = (entries + BLOCK - 1) // BLOCK
    energies, bounds = np.zeros(blocks), np.zeros(blocks)
    b2 = float(beta) ** 2
    inverse = 1 / spacing.astype(np.float64)
    for block in nb.prange(blocks):
        ahead, behind = np.empty((channels, 3)), np.empty((channels, 3))
        v, cross, mixed = np.empty((channels, 3)), np.empty((channels, 3)), np.empty((channels, 3))
        energy = 0.0
        for m in range(block * BLOCK, min(entries, (block + 1) * BLOCK)):
            for k in range(channels):
                along = 0.0
                for a in range(3):
                    ahead[k, a] = (u[k, forward[a, m]] - u[k, m]) * inverse[a]
                    behind[k, a] = (u[k, m] - u[k, backward[a, m]]) * inverse[a]
                    v[k, a] = 0.5 * (ahead[k, a] + behind[k, a])
                    along += normal[a, m] * v[k, a]
                for a in range(3):
                    central = v[k, a]
                    v[k, a] = central - along * normal[a, m]
                    cross[k, a] = v[k, a] - (1 - normal[a, m] ** 2) * central
            couple(v, b2, m, tensor, outer, largest)
            for k in range(channels):
                for a in range(3):
                    mixed[k, a] = 0.0
                    for j in range(channels):
                        mixed[k, a] += tensor[k, j, m] * cross[j, a]
                    work[k, a, m] = 0.5 * mixed[k, a] * inverse[a]
                    for j in range(channels):
                        square = 0.5 * (ahead[k, a] * ahead[j, a] + behind[k, a] * behind[j, a])
                        energy += tensor[k, j, m] * (1 - normal[a, m] ** 2) * square
                    energy += 0.5 * mixed[k, a] * (ahead[k, a] + behind[k, a])
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
                here, there = 1 - normal[a, m] ** 2, 1 - normal[a, e] ** 2
                for k in range(channels):
                    s = 0.0
                    for j in range(channels):
                        s += (tensor[k, j, m] * here + tensor[k, j, e] * there) * (u[j, e] - u[j, m])
                    flux[k, a, m] = 0.5 * s * inverse[a] ** 2 + work[k, a, m] + work[k, a, e]
        bounds[block] = bound
    return 0.5 * total(energies), bounds.max()


@nb.njit(cache=True, parallel=True)
def paper(u, normal, forward, backward, spacing, beta, flux, work, tensor, outer, largest):
    """The scheme of `steps.paper` with C in place of c; arguments and result as for `symmetric`."""
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
            couple(v, b2, m, tensor, outer, largest)
            for k in range(channels):
                for a in range(3):
                    s = 0.0
                    for j in range(channels):
                        s += tensor[k, j, m] * v[j, a]
                    energy += s * v[k, a]
                    flux[k, a, m] = s * inverse[a] if forward[a, m] != m else 0
        energies[block] = energy
    for block in nb.prange(blocks):
        bound = 0.0
        for m in range(block * BLOCK, min(entries, (block + 1) * BLOCK)):
            for a in range(3):
                e = forward[a, m]
                bound = max(bound, max(outer[m], outer[e]) * (largest[m] + largest[e]) / 2)
        bounds[block] = bound
    return 0.5 * total(energies), bounds.max()
