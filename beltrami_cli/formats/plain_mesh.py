"""Meshes in general formats: .ply and .vtk (numbers, triangles or lines), .obj, .stl, .glb.

None of them says what frame its vertices are in: they are taken, and written, as scanner RAS mm.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np

from beltrami_cli.formats import checks, colours
from beltrami_cli.formats.frames import StoredSurface
from beltrami_cli.surface import Mesh


def read_surface(path: Path, kind: str) -> StoredSurface:
    """Triangles of a file of `kind` PLY, OBJ, STL or VTK, polygons cut into triangles; raises DataError as `checks`.

    Vertices keep their order; the corners of an STL file, which has no vertices of its own, are merged where equal.
    """
    with checks.reading(path, kind):
        match kind:
            case "OBJ":
                vertices, cells = _read_obj(path)
            case "VTK":
                vertices, cells = _read_vtk(path)
            case _:
                vertices, cells = _read_with_trimesh(path, kind)
    return StoredSurface(vertices, cells)


def write_ply(path: Path, mesh: Mesh) -> None:
    """Binary PLY with colours and the float property `value` (or `value_1` ...) at the vertices: faces or edges."""
    if mesh.cells.shape[1] == 3:
        write_with_trimesh(path, mesh)
    else:
        _write_ply_edges(path, mesh)


def write_with_trimesh(path: Path, mesh: Mesh) -> None:
    """Triangles, vertices and faces in the order given.

    .ply, binary, with RGBA and the float property `value` (or `value_1` ...) at the vertices; .obj and .glb with the
    values as colours; .stl with the geometry alone.
    """
    import trimesh

    kind = path.suffix.lower().lstrip(".")
    colour, numbers = None, None
    if mesh.values is not None:
        colour = colours.rgb(mesh.values)
        numbers = _numbers(mesh) if kind == "ply" else None
    with checks.writing(path):
        trimesh.Trimesh(
            mesh.vertices_ras_mm, mesh.cells, vertex_colors=colour, vertex_attributes=numbers, process=False
        ).export(path, file_type=kind)


def write_vtk(path: Path, mesh: Mesh) -> None:
    """Legacy binary VTK, float32: triangles or lines, and the array `value` (or `value_1` ...) at the points."""
    import meshio

    cell_type = "triangle" if mesh.cells.shape[1] == 3 else "line"
    content = meshio.Mesh(mesh.vertices_ras_mm.astype(np.float32), [(cell_type, mesh.cells)], _numbers(mesh))
    with checks.writing(path):
        content.write(path, file_format="vtk42")  # unlike version 5, every reader of VTK knows it


def write_obj_lines(path: Path, mesh: Mesh) -> None:
    """A curve as OBJ line elements, with the values as RGB at the vertices: by hand, no library writes them."""
    vertices = [f"v {x:.8g} {y:.8g} {z:.8g}" for x, y, z in mesh.vertices_ras_mm]
    if mesh.values is not None:
        tints = colours.rgb(mesh.values) / 255
        vertices = [f"{line} {r:.4f} {g:.4f} {b:.4f}" for line, (r, g, b) in zip(vertices, tints, strict=True)]
    lines = [f"l {a} {b}" for a, b in mesh.cells + 1]
    with checks.writing(path):
        path.write_text("\n".join(["# vertices in RAS mm", *vertices, *lines, ""]), encoding="ascii", newline="\n")


def _read_with_trimesh(path: Path, kind: str) -> tuple[np.ndarray, np.ndarray]:
    import trimesh

    mesh = trimesh.load(path, file_type=kind.lower(), process=False)
    if kind == "STL":
        mesh.merge_vertices()
    # A file without faces comes as a cloud of points.
    cells = getattr(mesh, "faces", np.empty((0, 3)))
    return np.array(mesh.vertices, float), np.array(cells, np.int32)


def _read_vtk(path: Path) -> tuple[np.ndarray, np.ndarray]:
    import meshio

    content = meshio.vtk.read(path)  # not meshio.read, which prints and exits on what it does not know
    quads = content.cells_dict.get("quad", np.empty((0, 4)))
    triangles = content.cells_dict.get("triangle", np.empty((0, 3)))
    return np.array(content.points, float), np.concatenate([triangles, quads[:, :3], quads[:, [0, 2, 3]]]).astype(
        np.int32
    )


def _read_obj(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """By hand: trimesh repeats vertices that have several texture coordinates or materials, which changes their order.

    Lines `v x y z ...` and `f a/b/c ...`, whose first numbers count vertices from 1, or from -1 backwards.
    """
    vertices: list[list[str]] = []
    cells: list[tuple[int, int, int]] = []
    for line in path.read_text(encoding="utf-8", errors="replace").replace("\\\n", " ").splitlines():
        kind, *fields = line.split() or [""]
        if kind == "v":
            vertices.append(fields[:3])
        elif kind == "f":
            numbers = (int(field.split("/", 1)[0]) for field in fields)
            first, *others = (n - 1 if n > 0 else len(vertices) + n for n in numbers)
            cells += [(first, a, b) for a, b in pairwise(others)]
    return np.array(vertices, float).reshape(-1, 3), np.array(cells, np.int32).reshape(-1, 3)


def _numbers(mesh: Mesh) -> dict[str, np.ndarray]:
    """float32 values by names without spaces, which neither PLY nor VTK can hold."""
    return {name.replace(" ", "_"): column.astype(np.float32) for name, column in mesh.named_values().items()}


def _write_ply_edges(path: Path, mesh: Mesh) -> None:
    """By hand: trimesh writes a path's edges without colours and values, meshio as faces of two corners."""
    table: list[tuple[str, str, str, np.ndarray]] = [
        (axis, "float", "<f4", mesh.vertices_ras_mm[:, k]) for k, axis in enumerate("xyz")
    ]
    if mesh.values is not None:
        tints = colours.rgb(mesh.values)
        table += [(name, "uchar", "u1", tints[:, k]) for k, name in enumerate(("red", "green", "blue"))]
        table += [(name, "float", "<f4", column) for name, column in _numbers(mesh).items()]
    vertices = np.empty(len(mesh.vertices_ras_mm), [(name, code) for name, _, code, _ in table])
    for name, _, _, column in table:
        vertices[name] = column
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment vertices in RAS mm",
        f"element vertex {len(vertices)}",
        *(f"property {kind} {name}" for name, kind, _, _ in table),
        f"element edge {len(mesh.cells)}",
        "property int vertex1",
        "property int vertex2",
        "end_header\n",
    ]
    with checks.writing(path):
        path.write_bytes("\n".join(header).encode() + vertices.tobytes() + mesh.cells.astype("<i4").tobytes())
