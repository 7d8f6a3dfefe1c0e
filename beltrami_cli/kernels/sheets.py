"""Growing the band: entries (voxel, sheet), their geometry and their links.

Points are in millimetres along the voxel axes (index times spacing). A voxel is named by its flat C-order index in the
box; an entry by its place in the band's arrays.
"""

import numba as nb
import numpy as np

# Two vertices seen from one voxel are of one sheet when they are within 2 voxels and their normals within 70 degrees.
TWIN_VOXELS = 2.0
TWIN_COSINE = 0.34
# A vertex stands for a voxel only when the voxel lies along its normal: aside by no more than 1 voxel (the vertices'
# own spacing) or by this share of the distance (the bend of the normals in between).
ASIDE = 0.66
# Neighbouring entries are of one bank when their vertices are within 2.5 voxels and their normals are not opposed.
LINK_VOXELS = 2.5
LINK_COSINE = 0.0

# From a voxel to itself and to its six neighbours.
MOVES = np.array([[0, 0, 0], [1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]])


@nb.njit(cache=True, inline="always")
def squared_distance(points, v, x0, x1, x2):
    return (points[v, 0] - x0) ** 2 + (points[v, 1] - x1) ** 2 + (points[v, 2] - x2) ** 2


@nb.njit(cache=True, inline="always")
def squared_voxels(points, v, w, per_voxel):
    return (
        ((points[v, 0] - points[w, 0]) * per_voxel[0]) ** 2
        + ((points[v, 1] - points[w, 1]) * per_voxel[1]) ** 2
        + ((points[v, 2] - points[w, 2]) * per_voxel[2]) ** 2
    )


@nb.njit(cache=True, inline="always")
def cosine(normals, v, w):
    return normals[v, 0] * normals[w, 0] + normals[v, 1] * normals[w, 1] + normals[v, 2] * normals[w, 2]


@nb.njit(cache=True)
def descend(points, start, ring, v, x0, x1, x2):
    """The vertex reached from v by always stepping to the ring's nearest to x, and its squared distance (mm^2)."""
    best = squared_distance(points, v, x0, x1, x2)
    while True:
        nearest = v
        for q in range(start[v], start[v + 1]):
            w = ring[q]
            d = squared_distance(points, w, x0, x1, x2)
            if d < best:
                best = d
                nearest = w
        if nearest == v:
            return v, best
        v = nearest


@nb.njit(cache=True, inline="always")
def lies_along_normal(points, normals, v, d, x0, x1, x2, half_width, aside):
    """True where x, at squared distance d from v, is in v's normal tube: see ASIDE; `aside` is its floor, mm^2."""
    height = (x0 - points[v, 0]) * normals[v, 0] + (x1 - points[v, 1]) * normals[v, 1]
    height += (x2 - points[v, 2]) * normals[v, 2]
    return abs(height) <= half_width and d - height * height <= max(aside, ASIDE**2 * d)


@nb.njit(cache=True)
def entry_of_sheet(v, e, vertex, after, points, normals, piece, per_voxel):
    """Of a voxel's entries e, after[e], ... the one on the sheet of vertex v; -1 where there is none."""
    while e >= 0:
        w = vertex[e]
        near = piece[v] == piece[w] and squared_voxels(points, v, w, per_voxel) < TWIN_VOXELS**2
        if w == v or (near and cosine(normals, v, w) > TWIN_COSINE):
            return e
        e = after[e]
    return -1


@nb.njit(cache=True)
def grow(shape, spacing, points, normals, start, ring, piece, half_width):
    """All entries of the band, in order of growth: a voxel's entries are head[x], after[head[x]], ... to -1.

    A voxel has an entry for every sheet of the surface that it lies along the normal of, within `half_width` (mm): the
    vertex is a local minimum of the distance over the mesh. Growth starts at the voxels beside the vertices (those
    that have faces) and passes each vertex on to the neighbours of its voxel, from where it descends to theirs.
    Returns voxel (E,), vertex (E,), squared distance (E,), after (E,), head (X,).
    """
    stride = (shape[1] * shape[2], shape[2], 1)
    head = np.full(shape[0] * shape[1] * shape[2], -1, np.int32)
    capacity = 16 * len(points) + 1024
    voxel, vertex, after = np.empty(capacity, np.int32), np.empty(capacity, np.int32), np.empty(capacity, np.int32)
    distance = np.empty(capacity)
    per_voxel, aside = 1 / spacing, np.max(spacing) ** 2
    reach = (half_width + 0.5 * np.max(spacing)) ** 2
    at = np.empty(3, np.int64)
    entries, seeds, grown = 0, 0, 0
    while seeds < 2 * len(points) or grown < entries:
        if seeds < 2 * len(points):  # the voxels at both ends of the grid edge that the vertex is on
            v, moves = seeds // 2, MOVES[:1]
            for a in range(3):
                i = points[v, a] / spacing[a]
                at[a] = int(np.floor(i + 1e-6)) if seeds % 2 == 0 else int(np.ceil(i - 1e-6))
            seeds += 1
            if start[v] == start[v + 1]:
                continue
        else:
            v, x, moves = vertex[grown], voxel[grown], MOVES[1:]
            at[0], at[1], at[2] = x // stride[0], x // stride[1] % shape[1], x % shape[2]
            grown += 1
        for move in range(len(moves)):
            i, j, k = at[0] + moves[move, 0], at[1] + moves[move, 1], at[2] + moves[move, 2]
            if i < 0 or j < 0 or k < 0 or i >= shape[0] or j >= shape[1] or k >= shape[2]:
                continue
            x = i * stride[0] + j * stride[1] + k
            x0, x1, x2 = i * spacing[0], j * spacing[1], k * spacing[2]
            e = entry_of_sheet(v, head[x], vertex, after, points, normals, piece, per_voxel)
            if e >= 0 and squared_distance(points, v, x0, x1, x2) >= distance[e]:
                continue  # the sheet is there already, by a vertex that v does not better
            w, d = descend(points, start, ring, v, x0, x1, x2)
            if d > reach or not lies_along_normal(points, normals, w, d, x0, x1, x2, half_width, aside):
                continue
            e = entry_of_sheet(w, head[x], vertex, after, points, normals, piece, per_voxel)
            if e >= 0:
                if d < distance[e]:
                    vertex[e], distance[e] = w, d
                continue
            if entries == capacity:
                capacity *= 2
                voxel, vertex, after = widen(voxel, capacity), widen(vertex, capacity), widen(after, capacity)
                distance = widen(distance, capacity)
            voxel[entries], vertex[entries], distance[entries], after[entries] = x, w, d, head[x]
            head[x] = entries
            entries += 1
    return voxel[:entries], vertex[:entries], distance[:entries], after[:entries], head


@nb.njit(cache=True)
def widen(old, capacity):
    new = np.empty(capacity, old.dtype)
    new[: len(old)] = old
    return new


@nb.njit(cache=True)
def arrange(voxel, vertex, distance, after, head):
    """Entries in order of their voxel, nearest sheet first, so that neighbours along the last axis lie side by side.

    Returns voxel (E,), vertex (E,), first (X + 1,): the entries of voxel x are first[x] .. first[x + 1] - 1.
    """
    new_voxel, new_vertex = np.empty_like(voxel), np.empty_like(vertex)
    first = np.empty(len(head) + 1, np.int32)
    taken = np.empty(64, np.int32)
    place = 0
    for x in range(len(head)):
        first[x] = place
        count = 0
        e = head[x]
        while e >= 0 and count < 64:
            k = count
            while k > 0 and distance[taken[k - 1]] > distance[e]:
                taken[k] = taken[k - 1]
                k -= 1
            taken[k] = e
            count += 1
            e = after[e]
        for k in range(count):
            new_voxel[place], new_vertex[place] = x, vertex[taken[k]]
            place += 1
    first[len(head)] = place
    return new_voxel[:place], new_vertex[:place], first


@nb.njit(cache=True, parallel=True)
def closest_points(voxel, vertex, shape, spacing, points, normals, curvature, direction):
    """Unit normal (3, E) at each entry's closest surface point, and the signed distance to it (E,), mm.

    The surface around vertex v is taken as the quadric of its principal curvatures: for x = v + a + h n with a
    tangent, the closest point lies at t_i = a_i / (1 + d k_i) along the principal directions, and
    d = h + sum k_i t_i^2 (1 + d k_i) / 2.
    """
    entries = len(voxel)
    normal, distance = np.empty((3, entries), np.float32), np.empty(entries, np.float32)
    for e in nb.prange(entries):
        v, x = vertex[e], voxel[e]
        r0 = x // (shape[1] * shape[2]) * spacing[0] - points[v, 0]
        r1 = x // shape[2] % shape[1] * spacing[1] - points[v, 1]
        r2 = x % shape[2] * spacing[2] - points[v, 2]
        n0, n1, n2 = normals[v, 0], normals[v, 1], normals[v, 2]
        p0, p1, p2 = direction[v, 0], direction[v, 1], direction[v, 2]
        q0, q1, q2 = n1 * p2 - n2 * p1, n2 * p0 - n0 * p2, n0 * p1 - n1 * p0
        height = r0 * n0 + r1 * n1 + r2 * n2
        a, b = r0 * p0 + r1 * p1 + r2 * p2, r0 * q0 + r1 * q1 + r2 * q2
        k1, k2 = curvature[v, 0], curvature[v, 1]
        d, s, t = height, 0.0, 0.0
        for _ in range(2):
            w1, w2 = max(1 + d * k1, 0.3), max(1 + d * k2, 0.3)
            s, t = a / w1, b / w2
            d = height + 0.5 * (k1 * s * s * w1 + k2 * t * t * w2)
        m0, m1, m2 = n0 + k1 * s * p0 + k2 * t * q0, n1 + k1 * s * p1 + k2 * t * q1, n2 + k1 * s * p2 + k2 * t * q2
        size = np.sqrt(m0 * m0 + m1 * m1 + m2 * m2)
        normal[0, e], normal[1, e], normal[2, e] = m0 / size, m1 / size, m2 / size
        distance[e] = d
    return normal, distance


@nb.njit(cache=True, parallel=True)
def best_matches(voxel, vertex, first, normal, shape, spacing, points, piece, axis, move):
    """For each entry the entry of its neighbour along the axis that has the nearest vertex; itself where none has."""
    stride = (shape[1] * shape[2], shape[2], 1)
    out = np.empty(len(voxel), np.int32)
    per_voxel = 1 / spacing
    for e in nb.prange(len(voxel)):
        out[e] = e
        i = voxel[e] // stride[axis] % shape[axis] + move
        if i < 0 or i >= shape[axis]:
            continue
        y = voxel[e] + move * stride[axis]
        best = LINK_VOXELS**2
        for o in range(first[y], first[y + 1]):
            facing = normal[0, e] * normal[0, o] + normal[1, e] * normal[1, o] + normal[2, e] * normal[2, o]
            apart = squared_voxels(points, vertex[e], vertex[o], per_voxel)
            if piece[vertex[e]] == piece[vertex[o]] and facing > LINK_COSINE and apart < best:
                best = apart
                out[e] = o
    return out


@nb.njit(cache=True, parallel=True)
def mutual_links(forward, backward):
    """Keep in place only the links that both entries chose; the rest point to the entry itself."""
    kept_forward, kept_backward = np.empty_like(forward), np.empty_like(backward)
    for e in nb.prange(len(forward)):
        kept_forward[e] = forward[e] if backward[forward[e]] == e else e
        kept_backward[e] = backward[e] if forward[backward[e]] == e else e
    return kept_forward, kept_backward


@nb.njit(cache=True, parallel=True)
def entries_at_points(voxel, vertex, first, normal, shape, spacing, points, normals, piece, ijk, own):
    """For points (N, 3) in voxels the entry of their own sheet beside them (N,), -1 where none, and the offset (3, N).

    own: (N,) the mesh vertex of each point's sheet. Of the entries in the eight voxels around, the one whose vertex is
    nearest to it.
    """
    start, offset = np.full(len(ijk), -1, np.int32), np.zeros((3, len(ijk)), np.float32)
    per_voxel = 1 / spacing
    for n in nb.prange(len(ijk)):
        best = LINK_VOXELS**2
        for corner in range(8):
            i = int(np.floor(ijk[n, 0])) + (corner >> 2)
            j = int(np.floor(ijk[n, 1])) + (corner >> 1 & 1)
            k = int(np.floor(ijk[n, 2])) + (corner & 1)
            if i < 0 or j < 0 or k < 0 or i >= shape[0] or j >= shape[1] or k >= shape[2]:
                continue
            x = (i * shape[1] + j) * shape[2] + k
            for e in range(first[x], first[x + 1]):
                v = own[n]
                facing = normal[0, e] * normals[v, 0] + normal[1, e] * normals[v, 1] + normal[2, e] * normals[v, 2]
                apart = squared_voxels(points, vertex[e], v, per_voxel)
                if piece[v] == piece[vertex[e]] and facing > LINK_COSINE and apart < best:
                    best = apart
                    start[n] = e
                    offset[0, n], offset[1, n], offset[2, n] = ijk[n, 0] - i, ijk[n, 1] - j, ijk[n, 2] - k
    return start, offset
