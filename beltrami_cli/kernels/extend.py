"""Carrying values over the band: the transport equation of Sec. 2.1, and filling of unknown entries."""

import numba as nb
import numpy as np

from beltrami_cli.kernels import BLOCK, total


@nb.njit(cache=True, parallel=True)
def transport(u, normal, distance, forward, backward, spacing, width, dt, out):
    """One upwind step dt (mm) of U_t + sign(Psi) grad U . grad Psi = 0 into out (E,); NaN is unknown and is never read.

    sign(d) = d / sqrt(d^2 + width^2). An unknown entry takes the mean of its known upwind neighbours.
    """
    for m in nb.prange(len(u)):
        speed = distance[m] / np.sqrt(distance[m] ** 2 + width**2)
        pull, weight, whole = 0.0, 0.0, 0.0
        for a in range(3):
            along = speed * normal[a, m] / spacing[a]
            e = backward[a, m] if along > 0 else forward[a, m]
            whole += abs(along)
            if e != m and not np.isnan(u[e]):
                pull += abs(along) * u[e]
                weight += abs(along)
        out[m] = u[m]
        if np.isnan(u[m]):
            if weight > 0.5 * whole:
                out[m] = pull / weight
        else:
            out[m] = u[m] - dt * (weight * u[m] - pull)


@nb.njit(cache=True)
def flood(u, forward, backward):
    """Fill NaN entries of u (K, E) in place, ring by ring, each with the mean of its linked entries of earlier rings.

    Entries of a bank without any known value stay NaN.
    """
    channels = len(u)
    unknown = np.flatnonzero(np.isnan(u[0])).astype(np.int32)
    left = len(unknown)
    values = np.empty((channels, left), u.dtype)
    while True:
        kept = 0
        for k in range(left):
            m = unknown[k]
            for c in range(channels):
                total, count = 0.0, 0
                for a in range(3):
                    for e in (forward[a, m], backward[a, m]):
                        if not np.isnan(u[c, e]):
                            total += u[c, e]
                            count += 1
                values[c, k] = total / count if count else np.nan
        for k in range(left):
            m = unknown[k]
            if np.isnan(values[0, k]):
                unknown[kept] = m
                kept += 1
            else:
                u[:, m] = values[:, k]
        if kept == left:
            return
        left = kept


@nb.njit(cache=True, parallel=True)
def relax(u, free, forward, backward, spacing, tolerance, iterations):
    """Make u (K, E) float64 harmonic over links at the `free` entries (F,), the others fixed, in place.

    Conjugate gradients on the 7-point Laplacian of all channels as one system, so that turning two channels into each
    other turns the result; from u as it stands, until the residual has fallen by `tolerance` or after `iterations`.
    Sums run over blocks of fixed size, whatever the number of threads.
    """
    channels = len(u)
    blocks = (len(free) + BLOCK - 1) // BLOCK
    residual, direction, image = np.zeros(u.shape), np.zeros(u.shape), np.zeros(u.shape)
    part = np.zeros(blocks)
    w = (1 / spacing[0] ** 2, 1 / spacing[1] ** 2, 1 / spacing[2] ** 2)
    for block in nb.prange(blocks):
        share = 0.0
        for k in range(block * BLOCK, min(len(free), (block + 1) * BLOCK)):
            m = free[k]
            for c in range(channels):
                pull = 0.0
                for a in range(3):
                    pull += w[a] * (u[c, forward[a, m]] + u[c, backward[a, m]] - 2 * u[c, m])
                residual[c, m] = direction[c, m] = pull
                share += pull * pull
        part[block] = share
    size = total(part)
    target = tolerance * tolerance * size
    for _ in range(iterations):
        if size <= target:
            return
        for block in nb.prange(blocks):
            share = 0.0
            for k in range(block * BLOCK, min(len(free), (block + 1) * BLOCK)):
                m = free[k]
                for c in range(channels):
                    bend = 0.0
                    for a in range(3):
                        bend += w[a] * (
                            2 * direction[c, m] - direction[c, forward[a, m]] - direction[c, backward[a, m]]
                        )
                    image[c, m] = bend
                    share += bend * direction[c, m]
            part[block] = share
        stride = size / total(part)
        for block in nb.prange(blocks):
            share = 0.0
            for k in range(block * BLOCK, min(len(free), (block + 1) * BLOCK)):
                m = free[k]
                for c in range(channels):
                    u[c, m] += stride * direction[c, m]
                    residual[c, m] -= stride * image[c, m]
                    share += residual[c, m] * residual[c, m]
            part[block] = share
        turn = total(part) / size
        size *= turn
        for k in nb.prange(len(free)):
            for c in range(channels):
                direction[c, free[k]] = residual[c, free[k]] + turn * direction[c, free[k]]
