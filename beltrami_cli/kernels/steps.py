"""One explicit step of U_t = a Div(c v), v = P grad U, on the compact band; channels share one diffusivity c.

Arrays run over the band's E entries: u (K, E), normal (3, E), forward and backward (3, E) neighbour entries, a missing
link pointing to the entry itself. A scheme writes the fluxes c v per mm through each entry's forward faces, (K, 3, E),
and `diverge` makes the step of them. Loops are cut where a gather or a choice of law would keep one from vectorising,
and run block by block, so that what one loop leaves the next finds in the cache. Channels are taken out of (K, E)
arrays before a parallel loop begins, for only of what enters it whole is it known to overlap with nothing. Indices are
unsigned, for numba tests every signed one for being negative.
"""

import numba as nb
import numpy as np

from beltrami_cli.kernels import BLOCK, FAST, total

# Laws of the diffusivity c as a function of b = beta^2 |v|^2, |v|^2 summed over channels, with r = 1 / sqrt(1 + b).
ONE, R, R2, R4, WEICKERT = 0, 1, 2, 3, 4
WEICKERT_CONSTANT = 3.31488  # makes the flux c |v| rise up to |v| = 1 / beta and fall beyond


@nb.njit(cache=True, fastmath=FAST)
def diffuse(law, b2, c, form, low, high):
    """Turn c[low:high] from |v|^2 into the diffusivity at beta^2 = b2, in (0, 1]; returns the sum of c form.

    One loop for each law, so that each vectorises.
    """
    one = c.dtype.type(1)
    if law == ONE:
        for m in range(low, high):
            c[m] = one
    elif law == R:
        for m in range(low, high):
            c[m] = one / np.sqrt(one + b2 * c[m])
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
    form_sum = one * 0
    for m in range(low, high):
        form_sum += c[m] * form[m]
    return form_sum


@nb.njit(cache=True, parallel=True, fastmath=FAST)
def symmetric(u, normal, forward, backward, spacing, law, beta, flux, work, c):
    """Fluxes of the symmetric finite-volume scheme, second order with re-extension.

    Average of the quadratic form c v^T v over all forward/backward choices, c from the central tangential gradient. Per
    node P = I - n n^T, q_a = c sum_{b != a} P_ab g_b; flux through the face i|j along a: (c_i P_aa,i + c_j P_aa,j)/2
    (u_j - u_i)/h_a + (q_a,i + q_a,j)/2. beta in mm per data unit, spacing (3,) mm. flux: (K, 3, E), per mm of h_a;
    c: (E,), the diffusivity; work: (K, 3, E) scratch. Returns the sum over entries of c v^T v / 2.
    """
    channels, entries = u.shape
    blocks = (entries + BLOCK - 1) // BLOCK
    energies = np.zeros(blocks)
    one, half = u.dtype.type(1), u.dtype.type(0.5)
    zero = u.dtype.type(0)
    i0, i1, i2 = one / spacing[0], one / spacing[1], one / spacing[2]
    h0, h1, h2 = half * i0 * i0, half * i1 * i1, half * i2 * i2
    n0, n1, n2 = normal[0], normal[1], normal[2]
    f0, f1, f2 = forward[0], forward[1], forward[2]
    r0, r1, r2 = backward[0], backward[1], backward[2]
    form = flux[0, 0]  # free until the fluxes are known
    for k in range(channels):
        v, q0, q1, q2 = u[k], work[k, 0], work[k, 1], work[k, 2]
        for block in nb.prange(blocks):
            low, high = np.uint64(block * BLOCK), np.uint64(min(entries, (block + 1) * BLOCK))
            if k == 0:
                for m in range(low, high):
                    c[m] = zero
                    form[m] = zero
            for m in range(low, high):
                x0, x1, x2 = (v[f0[m]] - v[m]) * i0, (v[f1[m]] - v[m]) * i1, (v[f2[m]] - v[m]) * i2
                y0, y1, y2 = (v[m] - v[r0[m]]) * i0, (v[m] - v[r1[m]]) * i1, (v[m] - v[r2[m]]) * i2
                g0, g1, g2 = half * (x0 + y0), half * (x1 + y1), half * (x2 + y2)
                s = n0[m] * g0 + n1[m] * g1 + n2[m] * g2
                v0, v1, v2 = g0 - s * n0[m], g1 - s * n1[m], g2 - s * n2[m]
                e0, e1, e2 = one - n0[m] * n0[m], one - n1[m] * n1[m], one - n2[m] * n2[m]
                k0, k1, k2 = v0 - e0 * g0, v1 - e1 * g1, v2 - e2 * g2
                c[m] += v0 * v0 + v1 * v1 + v2 * v2
                q0[m], q1[m], q2[m] = half * k0 * i0, half * k1 * i1, half * k2 * i2
                square = half * (e0 * (x0 * x0 + y0 * y0) + e1 * (x1 * x1 + y1 * y1) + e2 * (x2 * x2 + y2 * y2))
                form[m] += square + k0 * g0 + k1 * g1 + k2 * g2
            if k == channels - 1:
                energies[block] = diffuse(law, u.dtype.type(beta) ** 2, c, form, low, high)
    for k in range(channels):
        v, q0, q1, q2 = u[k], work[k, 0], work[k, 1], work[k, 2]
        w0, w1, w2 = flux[k, 0], flux[k, 1], flux[k, 2]
        for block in nb.prange(blocks):
            for m in range(np.uint64(block * BLOCK), np.uint64(min(entries, (block + 1) * BLOCK))):
                a, b, d = f0[m], f1[m], f2[m]
                p0 = c[m] * (one - n0[m] * n0[m]) + c[a] * (one - n0[a] * n0[a])
                p1 = c[m] * (one - n1[m] * n1[m]) + c[b] * (one - n1[b] * n1[b])
                p2 = c[m] * (one - n2[m] * n2[m]) + c[d] * (one - n2[d] * n2[d])
                w0[m] = h0 * p0 * (v[a] - v[m]) + c[m] * q0[m] + c[a] * q0[a] if a != m else zero
                w1[m] = h1 * p1 * (v[b] - v[m]) + c[m] * q1[m] + c[b] * q1[b] if b != m else zero
                w2[m] = h2 * p2 * (v[d] - v[m]) + c[m] * q2[m] + c[d] * q2[d] if d != m else zero
    return 0.5 * total(energies)


@nb.njit(cache=True, parallel=True, fastmath=FAST)
def paper(u, normal, forward, backward, spacing, law, beta, flux, work, c):
    """Fluxes of the paper's scheme (Sec. 4.1) with |N| = 1: forward gradient, backward divergence; first order.

    Arguments and result as for `symmetric`.
    """
    channels, entries = u.shape
    blocks = (entries + BLOCK - 1) // BLOCK
    energies = np.zeros(blocks)
    one, zero = u.dtype.type(1), u.dtype.type(0)
    i0, i1, i2 = one / spacing[0], one / spacing[1], one / spacing[2]
    n0, n1, n2 = normal[0], normal[1], normal[2]
    f0, f1, f2 = forward[0], forward[1], forward[2]
    form = work[0, 0]
    for k in range(channels):
        v, w0, w1, w2 = u[k], flux[k, 0], flux[k, 1], flux[k, 2]
        for block in nb.prange(blocks):
            low, high = np.uint64(block * BLOCK), np.uint64(min(entries, (block + 1) * BLOCK))
            if k == 0:
                for m in range(low, high):
                    form[m] = zero
            for m in range(low, high):
                g0, g1, g2 = (v[f0[m]] - v[m]) * i0, (v[f1[m]] - v[m]) * i1, (v[f2[m]] - v[m]) * i2
                s = n0[m] * g0 + n1[m] * g1 + n2[m] * g2
                v0, v1, v2 = g0 - s * n0[m], g1 - s * n1[m], g2 - s * n2[m]
                form[m] += v0 * v0 + v1 * v1 + v2 * v2
                w0[m] = v0 * i0 if f0[m] != m else zero
                w1[m] = v1 * i1 if f1[m] != m else zero
                w2[m] = v2 * i2 if f2[m] != m else zero
            if k == channels - 1:
                for m in range(low, high):
                    c[m] = form[m]
                energies[block] = diffuse(law, u.dtype.type(beta) ** 2, c, form, low, high)
    for k in range(channels):
        w0, w1, w2 = flux[k, 0], flux[k, 1], flux[k, 2]
        for block in nb.prange(blocks):
            for m in range(np.uint64(block * BLOCK), np.uint64(min(entries, (block + 1) * BLOCK))):
                w0[m] *= c[m]
                w1[m] *= c[m]
                w2[m] *= c[m]
    return 0.5 * total(energies)


@nb.njit(cache=True, parallel=True, fastmath=FAST)
def diverge(u, flux, backward, a, outer, dt, out):
    """out = u + dt a Div(flux), all (K, E); a: (E,), counted as 1 unless outer; dt in mm^2. out may be u.

    Returns the sum of squared changes.
    """
    channels, entries = u.shape
    blocks = (entries + BLOCK - 1) // BLOCK
    changes = np.zeros(blocks)
    one, zero, step = u.dtype.type(1), u.dtype.type(0), u.dtype.type(dt)
    r0, r1, r2 = backward[0], backward[1], backward[2]
    for k in range(channels):
        v, o, w0, w1, w2 = u[k], out[k], flux[k, 0], flux[k, 1], flux[k, 2]
        for block in nb.prange(blocks):
            change = zero
            for m in range(np.uint64(block * BLOCK), np.uint64(min(entries, (block + 1) * BLOCK))):
                s = w0[m] + w1[m] + w2[m]
                s -= w0[r0[m]] if r0[m] != m else zero
                s -= w1[r1[m]] if r1[m] != m else zero
                s -= w2[r2[m]] if r2[m] != m else zero
                s *= step * (a[m] if outer else one)
                o[m] = v[m] + s
                change += s * s
            changes[block] += change
    return total(changes)
