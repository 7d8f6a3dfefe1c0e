"""Meshes in general formats, vertices in RAS mm: .ply and .vtk (numbers, triangles or lines), .obj, .stl, .glb."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from beltrami_cli.formats import checks, colours
from beltrami_cli.surface import Mesh


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
