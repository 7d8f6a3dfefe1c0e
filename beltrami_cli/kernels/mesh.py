"""Vertex geometry of the zero level's mesh: adjacency, crossings, normals, curvature.

Positions are in millimetres along the voxel axes (index times spacing) unless called `ijk`.
"""

import numba as nb
import numpy as np

from beltrami_cli.kernels import BLOCK

# Psi counts as smooth at a crossing when its second differences along the edge stay below this share of its slope: the
# distance to a sphere of 4 voxels' radius reaches 0.25; a clamp, a mask or the ridge between two banks 0.5 and more.
SMOOTH = 0.3
# Least distance of a crossing from the ends of its grid edge, in voxels: far below what a level set resolves.
EDGE = 1e-4
# Coordinates nearer to a node than this are on it: half of what EDGE leaves, far above single precision.
ON_NODE = 5e-5


@nb.njit(cache=True)
def half_edges(cells, vertices):
    """Neighbour lists (CSR: start, ring) of a mesh with `vertices` vertices, from triangles or segments (C, 2 or 3)."""
    corners = cells.shape[1]
    degree = np.zeros(vertices + 1, np.int64)
    for c in range(len(cells)):
        for k in range(corners):
            degree[cells[c, k] + 1] += 2
    start = np.cumsum(degree)
    ring = np.empty(start[-1], np.int32)
    filled = np.zeros(vertices, np.int64)
    for c in range(len(cells)):
        for k in range(corners):
            a = cells[c, k]
            for other in (cells[c, (k + 1) % corners], cells[c, (k + corners - 1) % corners]):
                known = False
                for q in range(start[a], start[a] + filled[a]):
                    if ring[q] == other:
                        known = True
                        break
                if not known:
                    ring[start[a] + filled[a]] = other
                    filled[a] += 1
    packed = np.zeros(vertices + 1, np.int32)
    for v in range(vertices):
        packed[v + 1] = packed[v] + filled[v]
    out = np.empty(packed[-1], np.int32)
    for v in range(vertices):
        for k in range(filled[v]):
            out[packed[v] + k] = ring[start[v] + k]
    return packed, out


@nb.njit(cache=True)
def pieces(start, ring):
    """The number (V,) int32 of the connected piece of the mesh that each vertex is of."""
    piece, waiting = np.full(len(start) - 1, -1, np.int32), np.empty(len(start) - 1, np.int32)
    count = 0
    for seed in range(len(piece)):
        if piece[seed] >= 0:
            continue
        piece[seed], waiting[0], left = count, seed, 1
        while left:
            left -= 1
            v = waiting[left]
            for q in range(start[v], start[v + 1]):
                if piece[ring[q]] < 0:
                    piece[ring[q]], waiting[left] = count, ring[q]
                    left += 1
        count += 1
    return piece


@nb.njit(cache=True)
def face_normals(points, triangles):
    """Sum (V, 3) of the normals of the faces around each vertex, as long as twice their areas (mm^2)."""
    faces = np.zeros_like(points)
    for c in range(len(triangles)):
        a, b, d = triangles[c, 0], triangles[c, 1], triangles[c, 2]
        p0, p1, p2 = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
        q0, q1, q2 = points[d, 0] - points[a, 0], points[d, 1] - points[a, 1], points[d, 2] - points[a, 2]
        n0, n1, n2 = p1 * q2 - p2 * q1, p2 * q0 - p0 * q2, p0 * q1 - p1 * q0
        for v in (a, b, d):
            faces[v, 0] += n0
            faces[v, 1] += n1
            faces[v, 2] += n2
    return faces


@nb.njit(cache=True)
def segment_normals(points, segments):
    """Normals (V, 3), length-weighted, of a polyline in the plane of the first two axes: left of its direction."""
    out = np.zeros_like(points)
    for c in range(len(segments)):
        a, b = segments[c, 0], segments[c, 1]
        for v in (a, b):
            out[v, 0] -= points[b, 1] - points[a, 1]
            out[v, 1] += points[b, 0] - points[a, 0]
    return out


@nb.njit(cache=True)
def ring_mean(normals, start, ring):
    """Unit vectors: each normal, scaled to length 1, averaged with its ring's."""
    unit = np.empty_like(normals)
    for v in range(len(normals)):
        size = np.sqrt(normals[v, 0] ** 2 + normals[v, 1] ** 2 + normals[v, 2] ** 2) + 1e-30
        for k in range(3):
            unit[v, k] = normals[v, k] / size
    out = np.empty_like(normals)
    for v in range(len(normals)):
        s0, s1, s2 = unit[v, 0], unit[v, 1], unit[v, 2]
        for q in range(start[v], start[v + 1]):
            w = ring[q]
            s0 += unit[w, 0]
            s1 += unit[w, 1]
            s2 += unit[w, 2]
        size = np.sqrt(s0 * s0 + s1 * s1 + s2 * s2) + 1e-30
        out[v, 0], out[v, 1], out[v, 2] = s0 / size, s1 / size, s2 / size
    return out


@nb.njit(cache=True)
def cubic_root(p0, p1, p2, p3, t):
    """Zero in [0, 1] of the cubic through p0..p3 at -1, 0, 1, 2, by Newton from t; t itself where it leaves [0, 1]."""
    c1 = -p0 / 3 - p1 / 2 + p2 - p3 / 6
    c2 = (p0 + p2) / 2 - p1
    c3 = (p3 - p0) / 6 + (p1 - p2) / 2
    root = t
    for _ in range(4):
        slope = c1 + root * (2 * c2 + root * 3 * c3)
        if slope == 0.0:
            return t
        root -= (p1 + root * (c1 + root * (c2 + root * c3))) / slope
    return root if 0.0 <= root <= 1.0 else t


@nb.njit(cache=True)
def edge_of(ijk, low):
    """Axis of the grid edge that a vertex lies on, its lower node in low (3,); -1 for one in the middle of a cell."""
    axis, across = -1, 0
    for a in range(3):
        low[a] = int(np.round(ijk[a]))
        if abs(ijk[a] - low[a]) > ON_NODE:
            axis = a
            across += 1
    if across != 1:
        return -1
    low[axis] = int(np.floor(ijk[axis]))
    return axis


@nb.njit(cache=True)
def linear_crossings(psi, ijk, start, ring):
    """Vertices (V, 3) of marching cubes, moved to the zero of Psi's straight line along the grid edge they lie on.

    Kept off the nodes by EDGE, lest triangles lose their area where Psi is exactly 0 at a node. The few vertices in the
    middle of a cell go to the mean of their ring.
    """
    points = np.empty_like(ijk)
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for v in range(len(ijk)):
        axis = edge_of(ijk[v], low)
        if axis < 0:
            points[v] = np.nan
            continue
        high[:] = low
        high[axis] += 1
        before, after = psi[low[0], low[1], low[2]], psi[high[0], high[1], high[2]]
        for a in range(3):
            points[v, a] = low[a]
        points[v, axis] += min(max(before / (before - after), EDGE), 1 - EDGE)
    for v in range(len(ijk)):
        if np.isnan(points[v, 0]):
            for a in range(3):
                points[v, a] = np.mean(points[ring[start[v] : start[v + 1]], a])
    return points


@nb.njit(cache=True)
def gradient_on_edge(psi, low, axis, line, t, spacing, gradient):
    """Gradient of Psi (per mm) at t along the edge from node `low`, into gradient (3,); False where a neighbour lacks.

    Along the edge from the cubic through `line` (4,), across it from central differences at its two ends.
    """
    at = np.empty(3, np.int64)
    for a in range(3):
        if a == axis:
            c1 = -line[0] / 3 - line[1] / 2 + line[2] - line[3] / 6
            c2, c3 = (line[0] + line[2]) / 2 - line[1], (line[3] - line[0]) / 6 + (line[1] - line[2]) / 2
            gradient[a] = (c1 + t * (2 * c2 + 3 * t * c3)) / spacing[a]
            continue
        gradient[a] = 0.0
        if psi.shape[a] == 1:
            continue
        if low[a] < 1 or low[a] + 1 >= psi.shape[a]:
            return False
        for k in range(2):
            at[:] = low
            at[axis] += k
            at[a] += 1
            up = psi[at[0], at[1], at[2]]
            at[a] -= 2
            gradient[a] += (t if k == 1 else 1 - t) * (up - psi[at[0], at[1], at[2]]) / (2 * spacing[a])
    return True


@nb.njit(cache=True, parallel=True)
def refine_crossings(psi, ijk, spacing, mesh_normals):
    """Crossings (V, 3) moved to the zero of the cubic along their grid edge, and normals from differences of Psi.

    Both only where Psi is smooth there; elsewhere the linear crossing and the mesh's own normal stay.
    """
    points, normals = ijk.copy(), mesh_normals.copy()
    for block in nb.prange((len(ijk) + BLOCK - 1) // BLOCK):
        low, at, gradient, line = np.empty(3, np.int64), np.empty(3, np.int64), np.empty(3), np.empty(4)
        for v in range(block * BLOCK, min(len(ijk), (block + 1) * BLOCK)):
            axis = edge_of(ijk[v], low)
            if axis < 0 or low[axis] < 1 or low[axis] + 2 >= psi.shape[axis]:
                continue
            at[:] = low
            for k in range(4):
                at[axis] = low[axis] - 1 + k
                line[k] = psi[at[0], at[1], at[2]]
            t = cubic_root(line[0], line[1], line[2], line[3], ijk[v, axis] - low[axis])
            if not gradient_on_edge(psi, low, axis, line, t, spacing, gradient):
                continue
            size = np.sqrt(gradient[0] ** 2 + gradient[1] ** 2 + gradient[2] ** 2)
            along = 0.0
            for a in range(3):
                along += gradient[a] * mesh_normals[v, a]
            bend = max(abs(line[0] - 2 * line[1] + line[2]), abs(line[1] - 2 * line[2] + line[3]))
            if bend <= SMOOTH * size * spacing[axis] and along > 0.9 * size:
                points[v, axis] = low[axis] + min(max(t, EDGE), 1 - EDGE)
                for a in range(3):
                    normals[v, a] = gradient[a] / size
    return points, normals


@nb.njit(cache=True, parallel=True)
def principal_curvatures(points, normals, start, ring, limit, ridge):
    """Principal curvatures (V, 2), 1/mm, and the first's direction (V, 3): least squares of dn = S dx over two rings.

    Positive where the surface bends away from its normal (a sphere's outward normal: 1/R). Clamped to +-limit (1/mm);
    `ridge` (mm^2) damps the fit where the ring is too small to tell.
    """
    curvature, direction = np.zeros((len(points), 2)), np.zeros((len(points), 3))
    for v in nb.prange(len(points)):
        n = normals[v]
        thin = 0
        for k in range(1, 3):
            if abs(n[k]) < abs(n[thin]):
                thin = k
        e1 = -n[thin] * n
        e1[thin] += 1.0
        e1 /= np.sqrt((e1**2).sum())
        e2 = np.cross(n, e1)
        xx = xy = yy = xp = cross = yq = 0.0
        for q in range(start[v], start[v + 1]):
            for o in range(start[ring[q]], start[ring[q] + 1]):
                w = ring[o]
                d0, d1, d2 = points[w, 0] - points[v, 0], points[w, 1] - points[v, 1], points[w, 2] - points[v, 2]
                m0, m1, m2 = normals[w, 0] - n[0], normals[w, 1] - n[1], normals[w, 2] - n[2]
                x, y = d0 * e1[0] + d1 * e1[1] + d2 * e1[2], d0 * e2[0] + d1 * e2[1] + d2 * e2[2]
                p, r = m0 * e1[0] + m1 * e1[1] + m2 * e1[2], m0 * e2[0] + m1 * e2[1] + m2 * e2[2]
                xx += x * x
                xy += x * y
                yy += y * y
                xp += x * p
                cross += y * p + x * r
                yq += y * r
        # Normal equations of [x y 0; 0 x y] [a b c] = [p q]; the corners are 0, so b comes first.
        xx, yy = xx + ridge, yy + ridge
        b = (cross - xy * (xp / xx + yq / yy)) / (xx + yy - ridge - xy * xy * (1 / xx + 1 / yy))
        a, c = (xp - xy * b) / xx, (yq - xy * b) / yy
        mean, spread = (a + c) / 2, np.sqrt(((a - c) / 2) ** 2 + b * b)
        angle = 0.5 * np.arctan2(2 * b, a - c)
        curvature[v, 0] = min(max(mean + spread, -limit), limit)
        curvature[v, 1] = min(max(mean - spread, -limit), limit)
        direction[v] = np.cos(angle) * e1 + np.sin(angle) * e2
    return curvature, direction


@nb.njit(cache=True)
def faces_around(cells, vertices):
    """The triangles (C, 3) around each of so many vertices: CSR (start, face)."""
    start = np.zeros(vertices + 1, np.int64)
    for c in range(len(cells)):
        for k in range(3):
            start[cells[c, k] + 1] += 1
    start = np.cumsum(start)
    face, filled = np.empty(start[-1], np.int32), start[:-1].copy()
    for c in range(len(cells)):
        for k in range(3):
            v = cells[c, k]
            face[filled[v]] = c
            filled[v] += 1
    return start, face


@nb.njit(cache=True)
def along_segment(p, a, b):
    """Where on the segment from a (0) to b (1) the point nearest to p is, and its squared distance."""
    dot, size, apart = 0.0, 0.0, 0.0
    for k in range(3):
        dot += (p[k] - a[k]) * (b[k] - a[k])
        size += (b[k] - a[k]) ** 2
    t = min(max(dot / size, 0.0), 1.0) if size > 0 else 0.0
    for k in range(3):
        apart += (p[k] - a[k] - t * (b[k] - a[k])) ** 2
    return t, apart


@nb.njit(cache=True)
def barycentric(p, a, b, c, w):
    """Weights w (3,) of the corners for the point of triangle abc nearest to p; returns its squared distance."""
    bb = bc = cc = pb = pc = 0.0
    for k in range(3):
        x, y, z = b[k] - a[k], c[k] - a[k], p[k] - a[k]
        bb, bc, cc, pb, pc = bb + x * x, bc + x * y, cc + y * y, pb + x * z, pc + y * z
    area = bb * cc - bc * bc
    if area > 1e-12 * bb * cc:  # else a line, or a point
        v, t = (cc * pb - bc * pc) / area, (bb * pc - bc * pb) / area
        if v >= 0 and t >= 0 and v + t <= 1:
            w[0], w[1], w[2] = 1 - v - t, v, t
            apart = 0.0
            for k in range(3):
                apart += (p[k] - a[k] - v * (b[k] - a[k]) - t * (c[k] - a[k])) ** 2
            return apart
    best = np.inf
    corners = (a, b, c)
    for k in range(3):
        t, apart = along_segment(p, corners[k], corners[(k + 1) % 3])
        if apart < best:
            best = apart
            w[k], w[(k + 1) % 3], w[(k + 2) % 3] = 1 - t, t, 0.0
    return best


@nb.njit(cache=True, parallel=True)
def nearest_on_faces(queries, vertex, points, cells, start, face):
    """For each query (Q, 3) the corners (Q, 3) and weights (Q, 3) of the nearest point of the faces around `vertex`.

    vertex: (Q,) the mesh vertex that the query belongs to; start, face: of `faces_around`. Weights of 0 where it has
    no face.
    """
    corners, weights = np.zeros((len(queries), 3), np.int32), np.zeros((len(queries), 3))
    for q in nb.prange(len(queries)):
        best = np.inf
        w = np.empty(3)
        for f in range(start[vertex[q]], start[vertex[q] + 1]):
            i, j, k = cells[face[f], 0], cells[face[f], 1], cells[face[f], 2]
            apart = barycentric(queries[q], points[i], points[j], points[k], w)
            if apart < best:
                best = apart
                corners[q, 0], corners[q, 1], corners[q, 2] = i, j, k
                weights[q] = w
    return corners, weights


@nb.njit(cache=True)
def onward(points, start, ring, before, here):
    """The neighbour of `here` that best keeps the direction from `before`; -1 where all lie behind."""
    following, best = -1, 0.0
    for q in range(start[here], start[here + 1]):
        w = ring[q]
        dot, size = 0.0, 0.0
        for k in range(3):
            dot += (points[w, k] - points[here, k]) * (points[here, k] - points[before, k])
            size += (points[w, k] - points[here, k]) ** 2
        if size > 0 and dot / np.sqrt(size) > best:
            following, best = w, dot / np.sqrt(size)
    return following


@nb.njit(cache=True)
def straight_walks(points, start, ring, steps):
    """Vertices met on the straightest way over the mesh from each vertex: (V, 2, steps), forth and back; -1 at an end.

    Forth to the ring's first, back to the one most opposite to it, and on to the one that keeps the direction best.
    """
    out = np.full((len(points), 2, steps), -1, np.int64)
    for v in range(len(points)):
        if start[v] == start[v + 1]:
            continue
        out[v, 0, 0] = ring[start[v]]
        out[v, 1, 0] = onward(points, start, ring, ring[start[v]], v)
        for side in range(2):
            for step in range(1, steps):
                if out[v, side, step - 1] < 0:
                    break
                before = out[v, side, step - 2] if step > 1 else v
                out[v, side, step] = onward(points, start, ring, before, out[v, side, step - 1])
    return out
