"""One explicit step of U_t = a Div(c v), v = P grad U, on the compact band; scalar values.

Arrays run over the band's E entries: u (E,), normal (3, E), forward and backward (3, E) neighbour entries, a missing
link pointing to the entry itself. Loops are cut where a gather or a choice of law would keep one from vectorising, and
run block by block, so that what one loop leaves the next finds in the cache. Indices are unsigned, for numba tests
every signed one for being negative.
"""

import numba as nb
import numpy as np

from beltrami_cli.kernels import BLOCK, FAST, total

# Laws of the diffusivity c as a function of b = beta^2 |v|^2, with r = 1 / sqrt(1 + b).
ONE, R, R2, R4, WEICKERT = 0, 1, 2, 3, 4
WEICKERT_CONSTANT = 3.31488  # makes the flux c |v| rise up to |v| = 1 / beta and fall beyond


@nb.njit(cache=True, fastmath=FAST)
def diffuse(law, b2, c, form, w0, w1, w2, low, high):
    """Turn c[low:high] from |v|^2 into the diffusivity at beta^2 = b2, in (0, 1], and scale w by it.

    Returns the sum of c form. One loop for each law, so that each vectorises.
    """
    one = c.dtype.type(1)
    form_sum = one * 0
    if law == R:  # by far the most used, so in one pass
        for m in range(low, high):
            d = one / np.sqrt(one + b2 * c[m])
            c[m] = d
            form_sum += d * form[m]
            w0[m] *= d
            w1[m] *= d
            w2[m] *= d
        return form_sum
    if law == ONE:
        for m in range(low, high):
            c[m] = one
    elif law == R2:
        for m in range(low, high):
            c[m] = one / (one + b2 * c[m])
    elif law == R4:
        for m in range(low, high):
            c[m] = one / ((one + b2 * c[m]) * (one + b2 * c[m]))
    else:
        for m in range(low, high):
            b4 = (b2 * c[m]) * (b2 * c[m]) * (b2 * c[m]) * (b2 * c[m])
            c[m] = one - np.exp(-c.dtype.type(WEICKERT_CONSTANT) / b4) if b4 > 1e-30 else one
    for m in range(low, high):
        form_sum += c[m] * form[m]
        w0[m] *= c[m]
        w1[m] *= c[m]
        w2[m] *= c[m]
    return form_sum


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
    energies = np.zeros(blocks)
    one, half = u.dtype.type(1), u.dtype.type(0.5)
    zero = u.dtype.type(0)
    i0, i1, i2 = one / spacing[0], one / spacing[1], one / spacing[2]
    h0, h1, h2 = half * i0 * i0, half * i1 * i1, half * i2 * i2
    n0, n1, n2 = normal[0], normal[1], normal[2]
    f0, f1, f2 = forward[0], forward[1], forward[2]
    r0, r1, r2 = backward[0], backward[1], backward[2]
    w0, w1, w2, q0, q1, q2, c = work[0], work[1], work[2], work[3], work[4], work[5], work[6]
    for block in nb.prange(blocks):
        low, high = np.uint64(block * BLOCK), np.uint64(min(entries, (block + 1) * BLOCK))
        for m in range(low, high):
            x0, x1, x2 = (u[f0[m]] - u[m]) * i0, (u[f1[m]] - u[m]) * i1, (u[f2[m]] - u[m]) * i2
            y0, y1, y2 = (u[m] - u[r0[m]]) * i0, (u[m] - u[r1[m]]) * i1, (u[m] - u[r2[m]]) * i2
            g0, g1, g2 = half * (x0 + y0), half * (x1 + y1), half * (x2 + y2)
            s = n0[m] * g0 + n1[m] * g1 + n2[m] * g2
            v0, v1, v2 = g0 - s * n0[m], g1 - s * n1[m], g2 - s * n2[m]
            e0, e1, e2 = one - n0[m] * n0[m], one - n1[m] * n1[m], one - n2[m] * n2[m]
            k0, k1, k2 = v0 - e0 * g0, v1 - e1 * g1, v2 - e2 * g2
            c[m] = v0 * v0 + v1 * v1 + v2 * v2
            q0[m], q1[m], q2[m] = half * k0 * i0, half * k1 * i1, half * k2 * i2
            form = half * (e0 * (x0 * x0 + y0 * y0) + e1 * (x1 * x1 + y1 * y1) + e2 * (x2 * x2 + y2 * y2))
            out[m] = form + k0 * g0 + k1 * g1 + k2 * g2
        energies[block] = diffuse(law, u.dtype.type(beta) ** 2, c, out, q0, q1, q2, low, high)
    for block in nb.prange(blocks):
        for m in range(np.uint64(block * BLOCK), np.uint64(min(entries, (block + 1) * BLOCK))):
            a, b, d = f0[m], f1[m], f2[m]
            p0 = c[m] * (one - n0[m] * n0[m]) + c[a] * (one - n0[a] * n0[a])
            p1 = c[m] * (one - n1[m] * n1[m]) + c[b] * (one - n1[b] * n1[b])
            p2 = c[m] * (one - n2[m] * n2[m]) + c[d] * (one - n2[d] * n2[d])
            w0[m] = h0 * p0 * (u[a] - u[m]) + q0[m] + q0[a] if a != m else zero
            w1[m] = h1 * p1 * (u[b] - u[m]) + q1[m] + q1[b] if b != m else zero
            w2[m] = h2 * p2 * (u[d] - u[m]) + q2[m] + q2[d] if d != m else zero
    return diverge(u, w0, w1, w2, r0, r1, r2, c, outer, u.dtype.type(dt), out), 0.5 * total(energies)


@nb.njit(cache=True, parallel=True, fastmath=FAST)
def paper(u, normal, forward, backward, spacing, law, outer, beta, dt, work, out):
    """The paper's scheme (Sec. 4.1) with |N| = 1: forward gradient, backward divergence; first order.

    Arguments and result as for `symmetric`.
    """
    entries = len(u)
    blocks = (entries + BLOCK - 1) // BLOCK
    energies = np.zeros(blocks)
    one, zero = u.dtype.type(1), u.dtype.type(0)
    i0, i1, i2 = one / spacing[0], one / spacing[1], one / spacing[2]
    n0, n1, n2 = normal[0], normal[1], normal[2]
    f0, f1, f2 = forward[0], forward[1], forward[2]
    w0, w1, w2, c = work[0], work[1], work[2], work[6]
    for block in nb.prange(blocks):
        low, high = np.uint64(block * BLOCK), np.uint64(min(entries, (block + 1) * BLOCK))
        for m in range(low, high):
            g0, g1, g2 = (u[f0[m]] - u[m]) * i0, (u[f1[m]] - u[m]) * i1, (u[f2[m]] - u[m]) * i2
            s = n0[m] * g0 + n1[m] * g1 + n2[m] * g2
            v0, v1, v2 = g0 - s * n0[m], g1 - s * n1[m], g2 - s * n2[m]
            c[m] = out[m] = v0 * v0 + v1 * v1 + v2 * v2
            w0[m] = v0 * i0 if f0[m] != m else zero
            w1[m] = v1 * i1 if f1[m] != m else zero
            w2[m] = v2 * i2 if f2[m] != m else zero
        energies[block] = diffuse(law, u.dtype.type(beta) ** 2, c, out, w0, w1, w2, low, high)
    change = diverge(u, w0, w1, w2, backward[0], backward[1], backward[2], c, outer, u.dtype.type(dt), out)
    return change, 0.5 * total(energies)


@nb.njit(cache=True, parallel=True, fastmath=FAST)
def diverge(u, w0, w1, w2, r0, r1, r2, c, outer, dt, out):
    """out = u + dt a Div(w) for fluxes w (per mm) through each entry's forward faces; the sum of squared changes."""
    entries = len(u)
    blocks = (entries + BLOCK - 1) // BLOCK
    changes = np.zeros(blocks)
    one, zero = u.dtype.type(1), u.dtype.type(0)
    for block in nb.prange(blocks):
        change = zero
        for m in range(np.uint64(block * BLOCK), np.uint64(min(entries, (block + 1) * BLOCK))):
            s = w0[m] + w1[m] + w2[m]
            s -= w0[r0[m]] if r0[m] != m else zero
            s -= w1[r1[m]] if r1[m] != m else zero
            s -= w2[r2[m]] if r2[m] != m else zero
            s *= dt * (c[m] if outer else one)
            out[m] = u[m] + s
            change += s * s
        changes[block] = change
    return total(changes)
