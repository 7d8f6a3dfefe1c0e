"""Interpolation on one sheet: every stencil is reached by walking along links, so no value of another bank enters.

A query is a start entry and an offset from its voxel, in voxels; a stencil spans 4 nodes along an axis that has links
(the local cubic) and 1 along the missing axis of a plane.
"""

import numba as nb
import numpy as np

from beltrami_cli.kernels import BLOCK, FAST


@nb.njit(cache=True)
def walk(e, s0, s1, s2, forward, backward):
    """The entry s0, s1, s2 voxels away along links, axis by axis in whatever order they allow; -1 where they end."""
    while s0 != 0 or s1 != 0 or s2 != 0:
        before = e
        if s0 != 0:
            o = forward[0, e] if s0 > 0 else backward[0, e]
            if o != e:
                e = o
                s0 += -1 if s0 > 0 else 1
        if s1 != 0:
            o = forward[1, e] if s1 > 0 else backward[1, e]
            if o != e:
                e = o
                s1 += -1 if s1 > 0 else 1
        if s2 != 0:
            o = forward[2, e] if s2 > 0 else backward[2, e]
            if o != e:
                e = o
                s2 += -1 if s2 > 0 else 1
        if e == before:
            return -1
    return e


@nb.njit(cache=True)
def stencil_origin(corner, forward, backward, nodes):
    """The lowest entry of the stencil around a cell's low corner, or -1 unless links reach all its nodes."""
    x = corner
    for a in range(3):
        if nodes[a] == 4:
            if backward[a, x] == x:
                return -1
            x = backward[a, x]
    origin = x
    for a in range(nodes[0]):
        if a > 0:
            if forward[0, x] == x:
                return -1
            x = forward[0, x]
        y = x
        for b in range(nodes[1]):
            if b > 0:
                if forward[1, y] == y:
                    return -1
                y = forward[1, y]
            z = y
            for _ in range(1, nodes[2]):
                if forward[2, z] == z:
                    return -1
                z = forward[2, z]
    return origin


@nb.njit(cache=True, parallel=True)
def stencil_origins(start, offset, forward, backward, nodes):
    """For each query (start (Q,), offset (3, Q) in voxels) the origin (Q,) of its stencil, -1 where incomplete."""
    out = np.empty(len(start), np.int32)
    for m in nb.prange(len(start)):
        s0, s1, s2 = int(np.floor(offset[0, m])), int(np.floor(offset[1, m])), int(np.floor(offset[2, m]))
        corner = walk(start[m], s0, s1, s2, forward, backward)
        out[m] = -1 if corner < 0 else stencil_origin(corner, forward, backward, nodes)
    return out


@nb.njit(cache=True, inline="always")
def cubic_weights(t, nodes, w):
    """Lagrange weights at t in [0, 1] of the nodes -1, 0, 1, 2 (of the one node where an axis has one)."""
    if nodes == 1:
        w[0] = 1
        return
    w[0] = -t * (t - 1) * (t - 2) / 6
    w[1] = (t + 1) * (t - 1) * (t - 2) / 2
    w[2] = -(t + 1) * t * (t - 2) / 2
    w[3] = (t + 1) * t * (t - 1) / 6


@nb.njit(cache=True, fastmath=FAST)
def cubic_sum(u, x, w0, w1, w2, nodes, f0, f1, f2):
    """The weighted sum of u (E,) over the stencil whose origin is x, and the least and the most of the cell's nodes."""
    total, low, high = u[x] * 0, u.dtype.type(np.inf), u.dtype.type(-np.inf)
    for a in range(nodes[0]):
        y = x
        for b in range(nodes[1]):
            if nodes[2] == 1:
                row, least, most = u[y], u[y], u[y]
            else:
                z1 = f2[y]
                z2 = f2[z1]
                row = w2[0] * u[y] + w2[1] * u[z1] + w2[2] * u[z2] + w2[3] * u[f2[z2]]
                least, most = min(u[z1], u[z2]), max(u[z1], u[z2])
            if (nodes[0] == 1 or a == 1 or a == 2) and (nodes[1] == 1 or b == 1 or b == 2):
                low, high = min(low, least), max(high, most)
            total += w0[a] * w1[b] * row
            y = f1[y]
        x = f0[x]
    return total, low, high


@nb.njit(cache=True, parallel=True, fastmath=FAST)
def cubic(u, size, origin, offset, forward, nodes, out):
    """Local cubic of u (K, E) at each query, into out (K, Q).

    Every channel stays within the range of the cell's own nodes; or, where size (E,) holds |u| (else it is empty), the
    vector of all channels within their greatest length, which is the same however two channels are turned into each
    other. `origin` and `offset` as for `stencil_origins`. Where the stencil is incomplete (-1) or holds a NaN, out
    keeps its value.
    """
    f0, f1, f2 = forward[0], forward[1], forward[2]
    channels, queries = len(u), len(origin)
    by_length = len(size) > 0
    for chunk in nb.prange((queries + BLOCK - 1) // BLOCK):
        w0, w1, w2 = np.empty(4, u.dtype), np.empty(4, u.dtype), np.empty(4, u.dtype)
        values = np.empty(channels, u.dtype)
        for m in range(chunk * BLOCK, min(queries, (chunk + 1) * BLOCK)):
            if origin[m] < 0:
                continue
            x = np.uint32(origin[m])
            cubic_weights(offset[0, m] - np.floor(offset[0, m]), nodes[0], w0)
            cubic_weights(offset[1, m] - np.floor(offset[1, m]), nodes[1], w1)
            cubic_weights(offset[2, m] - np.floor(offset[2, m]), nodes[2], w2)
            squares = u.dtype.type(0)
            for k in range(channels):
                total, low, high = cubic_sum(u[k], x, w0, w1, w2, nodes, f0, f1, f2)
                values[k] = total if by_length or np.isnan(total) else min(max(total, low), high)
                squares += values[k] * values[k]
            if np.isnan(squares):
                continue
            if by_length:
                most = cubic_sum(size, x, w0, w1, w2, nodes, f0, f1, f2)[2]
                if squares > most * most:
                    values *= most / np.sqrt(squares)
            for k in range(channels):
                out[k, m] = values[k]


@nb.njit(cache=True, parallel=True)
def linear(u, confidence, start, offset, forward, backward, least, total, mass):
    """Add the trilinear sums of confidence (E,) times u (K, E) to total (K, Q), and of confidence to mass (Q,).

    At each query, over the cell's corners that links reach and whose confidence is above 0; where their trilinear
    weights sum to no more than `least`, nothing is added.
    """
    channels = len(u)
    for chunk in nb.prange((len(start) + BLOCK - 1) // BLOCK):
        sums = np.empty(channels)
        for m in range(chunk * BLOCK, min(len(start), (chunk + 1) * BLOCK)):
            if start[m] < 0:
                continue
            s0, s1, s2 = int(np.floor(offset[0, m])), int(np.floor(offset[1, m])), int(np.floor(offset[2, m]))
            t0, t1, t2 = offset[0, m] - s0, offset[1, m] - s1, offset[2, m] - s2
            weight, trust = 0.0, 0.0
            sums[:] = 0
            for corner in range(8):
                a, b, c = corner >> 2, corner >> 1 & 1, corner & 1
                w = (t0 if a else 1 - t0) * (t1 if b else 1 - t1) * (t2 if c else 1 - t2)
                if w == 0.0:
                    continue
                e = walk(start[m], s0 + a, s1 + b, s2 + c, forward, backward)
                if e >= 0 and confidence[e] > 0:
                    weight += w
                    trust += w * confidence[e]
                    for k in range(channels):
                        sums[k] += w * confidence[e] * u[k, e]
            if weight > least:
                mass[m] += trust
                for k in range(channels):
                    total[k, m] += sums[k]
