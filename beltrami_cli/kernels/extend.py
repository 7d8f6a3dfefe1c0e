"""Carrying values over the band: the transport equation of Sec. 2.1, and filling of unknown entries."""

import numba as nb
import numpy as np


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
    """Fill NaN entries of u in place, ring by ring, each with the mean of its linked entries of the rings before.

    Entries of a bank without any known value stay NaN.
    """
    unknown = np.flatnonzero(np.isnan(u)).astype(np.int32)
    left = len(unknown)
    values = np.empty(left, u.dtype)
    while True:
        kept = 0
        for k in range(left):
            m = unknown[k]
            total, count = 0.0, 0
            for a in range(3):
                for e in (forward[a, m], backward[a, m]):
                    if not np.isnan(u[e]):
                        total += u[e]
                        count += 1
            values[k] = total / count if count else np.nan
        for k in range(left):
            m = unknown[k]
            if np.isnan(values[k]):
                unknown[kept] = m
                kept += 1
            else:
                u[m] = values[k]
        if kept == left:
            return
        left = kept


@nb.njit(cache=True, parallel=True)
def minus_laplacian(u, free, forward, backward, spacing, out):
    """-Laplacian of u (per mm^2) over links at the free entries, 0 at the others, into out (E,)."""
    for m in nb.prange(len(u)):
        total = 0.0
        if free[m]:
            for a in range(3):
                total += (2 * u[m] - u[forward[a, m]] - u[backward[a, m]]) / spacing[a] ** 2
        out[m] = total
