"""One explicit step of U_t = a Div(c v), v = P grad U, on the compact band; scalar values.

Arrays run over the band's E entries: u (E,), normal (3, E), forward and backward (3, E) neighbour entries, a missing
link pointing to the entry itself. Work is cut in blocks of fixed size, so sums do not depend on the number of threads.
"""

import numba as nb
import numpy as np

from beltrami_cli.kernels import BLOCK, FAST

# Laws of the diffusivity c as a function of b = beta^2 |v|^2, with r = 1 / sqrt(1 + b).
ONE, R, R2, R4, WEICKERT = 0, 1, 2, 3, 4
WEICKERT_CONSTANT = 3.31488  # makes the flux c |v| rise up to |v| = 1 / beta and fall beyond


@nb.njit(cache=True, inline="always", fastmath=FAST)
def diffusivity(law, b):
    """c(b) for one of the laws above; b = beta^2 |v|^2, dimensionless; in (0, 1]."""
    if law == 0:
        return b * 0 + 1
    if law == 1:
        return 1 / np.sqrt(1 + b)
    if law == 2:
        return 1 / (1 + b)
    if law == 3:
        return 1 / ((1 + b) * (1 + b))
    b4 = b * b * b * b
    return 1 - np.exp(-WEICKERT_CONSTANT / b4) if b4 > 1e-30 else b * 0 + 1


@nb.njit(cache=True, parallel=True, fastmath=FAST)
def symmetric(u, normal, forward, backward, spacing, law, outer, beta, dt, work, out):
    """The symmetric finite-volume scheme: out = u + dt a Div(c v), second order with re-extension.

    Average of the quadratic form c v^T v over all forward/backward choices, c from the central tangential gradient. Per
    node P = I - n n^T, q_a = c sum_{b != a} P_ab g_b; flux through the face i|j along a: (c_i P_aa,i + c_j P_aa,j)/2
    (u_j - u_i)/h_a + (q_a,i + q_a,j)/2. beta in mm per data unit, dt in mm^2, spacing (3,) mm, outer: a = c or 1.
    work: (7, E) scratch. Returns (sum of squared changes, sum of c v^T v / 2).
    """
    entries = len(u)
    blocks = (entries + BLOCK - 1) // BLOCK
    changes, energies = np.zeros(blocks), np.zeros(blocks)
    one = u.dtype.type(1)
    half = u.dtype.type(0.5)
    i0, i1, i2 = one / spacing[0], one / spacing[1], one / spacing[2]
    b2 = u.dtype.type(beta) ** 2
    step = u.dtype.type(dt)
    n0, n1, n2 = normal[0], normal[1], normal[2]
    f0, f1, f2 = forward[0], forward[1], forward[2]
    r0, r1, r2 = backward[0], backward[1], backward[2]
    p0, p1, p2, q0, q1, q2, c = work[0], work[1], work[2], work[3], work[4], work[5], work[6]
    for block in nb.prange(blocks):
        energy = u.dtype.type(0)
        for m in range(block * BLOCK, min(entries, (block + 1) * BLOCK)):
            x0, x1, x2 = (u[f0[m]] - u[m]) * i0, (u[f1[m]] - u[m]) * i1, (u[f2[m]] - u[m]) * i2
            y0, y1, y2 = (u[m] - u[r0[m]]) * i0, (u[m] - u[r1[m]]) * i1, (u[m] - u[r2[m]]) * i2
            g0, g1, g2 = half * (x0 + y0), half * (x1 + y1), half * (x2 + y2)
            s = n0[m] * g0 + n1[m] * g1 + n2[m] * g2
            v0, v1, v2 = g0 - s * n0[m], g1 - s * n1[m], g2 - s * n2[m]
            d = diffusivity(law, b2 * (v0 * v0 + v1 * v1 + v2 * v2))
            e0, e1, e2 = one - n0[m] * n0[m], one - n1[m] * n1[m], one - n2[m] * n2[m]
            k0, k1, k2 = v0 - e0 * g0, v1 - e1 * g1, v2 - e2 * g2
            c[m] = d
            p0[m], p1[m], p2[m] = half * d * e0 * i0 * i0, half * d * e1 * i1 * i1, half * d * e2 * i2 * i2
            q0[m], q1[m], q2[m] = half * d * k0 * i0, half * d * k1 * i1, half * d * k2 * i2
            energy += d * (
                half * (e0 * (x0 * x0 + y0 * y0) + e1 * (x1 * x1 + y1 * y1) + e2 * (x2 * x2 + y2 * y2))
                + k0 * g0
                + k1 * g1
                + k2 * g2
            )
        energies[block] = energy
    for block in nb.prange(blocks):
        change = u.dtype.type(0)
        for m in range(block * BLOCK, min(entries, (block + 1) * BLOCK)):
            a0, a1, a2, z0, z1, z2 = f0[m], f1[m], f2[m], r0[m], r1[m], r2[m]
            s = (p0[m] + p0[a0]) * (u[a0] - u[m]) + (q0[m] + q0[a0] if a0 != m else one * 0)
            s += (p0[m] + p0[z0]) * (u[z0] - u[m]) - (q0[m] + q0[z0] if z0 != m else one * 0)
            s += (p1[m] + p1[a1]) * (u[a1] - u[m]) + (q1[m] + q1[a1] if a1 != m else one * 0)
            s += (p1[m] + p1[z1]) * (u[z1] - u[m]) - (q1[m] + q1[z1] if z1 != m else one * 0)
            s += (p2[m] + p2[a2]) * (u[a2] - u[m]) + (q2[m] + q2[a2] if a2 != m else one * 0)
            s += (p2[m] + p2[z2]) * (u[z2] - u[m]) - (q2[m] + q2[z2] if z2 != m else one * 0)
            s *= step * (c[m] if outer else one)
            out[m] = u[m] + s
            change += s * s
        changes[block] = change
    return changes.sum(), 0.5 * energies.sum()


@nb.njit(cache=True, parallel=True, fastmath=FAST)
def paper(u, normal, forward, backward, spacing, law, outer, beta, dt, work, out):
    """The paper's scheme (Sec. 4.1) with |N| = 1: forward gradient, backward divergence; first order.

    Arguments and result as for `symmetric`.
    """
    entries = len(u)
    blocks = (entries + BLOCK - 1) // BLOCK
    changes, energies = np.zeros(blocks), np.zeros(blocks)
    one = u.dtype.type(1)
    i0, i1, i2 = one / spacing[0], one / spacing[1], one / spacing[2]
    b2 = u.dtype.type(beta) ** 2
    step = u.dtype.type(dt)
    n0, n1, n2 = normal[0], normal[1], normal[2]
    f0, f1, f2 = forward[0], forward[1], forward[2]
    r0, r1, r2 = backward[0], backward[1], backward[2]
    w0, w1, w2, c = work[0], work[1], work[2], work[6]
    for block in nb.prange(blocks):
        energy = u.dtype.type(0)
        for m in range(block * BLOCK, min(entries, (block + 1) * BLOCK)):
            g0, g1, g2 = (u[f0[m]] - u[m]) * i0, (u[f1[m]] - u[m]) * i1, (u[f2[m]] - u[m]) * i2
            s = n0[m] * g0 + n1[m] * g1 + n2[m] * g2
            v0, v1, v2 = g0 - s * n0[m], g1 - s * n1[m], g2 - s * n2[m]
            t = v0 * v0 + v1 * v1 + v2 * v2
            d = diffusivity(law, b2 * t)
            c[m] = d
            w0[m] = d * v0 * i0 if f0[m] != m else one * 0
            w1[m] = d * v1 * i1 if f1[m] != m else one * 0
            w2[m] = d * v2 * i2 if f2[m] != m else one * 0
            energy += d * t
        energies[block] = energy
    for block in nb.prange(blocks):
        change = u.dtype.type(0)
        for m in range(block * BLOCK, min(entries, (block + 1) * BLOCK)):
            s = w0[m] + w1[m] + w2[m]
            s -= w0[r0[m]] if r0[m] != m else one * 0
            s -= w1[r1[m]] if r1[m] != m else one * 0
            s -= w2[r2[m]] if r2[m] != m else one * 0
            s *= step * (c[m] if outer else one)
            out[m] = u[m] + s
            change += s * s
        changes[block] = change
    return changes.sum(), 0.5 * energies.sum()
