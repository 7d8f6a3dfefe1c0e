"""Meshes in general formats, vertices in RAS mm: .ply and .vtk (numbers, triangles or lines), .obj, .stl, .glb."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli.formats import checks, colours
from beltrami_cli.surface import Mesh


def write_ply(path: Path, mesh: Mesh) -> None:
    """Binary PLY: vertices with RGB and a float property `value`; faces, or edges for a curve."""
    vertex_fields: list[Any] = [("xyz", "<f4", 3)]
    properties = ["property float x", "property float y", "property float z"]
    if mesh.values is not None:
        vertex_fields += [("rgb", "u1", 3), ("value", "<f4")]
        properties += ["property uchar red", "property uchar green", "property uchar blue", "property float value"]
    vertices = np.empty(len(mesh.vertices_ras_mm), vertex_fields)
    vertices["xyz"] = mesh.vertices_ras_mm
    if mesh.values is not None:
        vertices["rgb"], vertices["value"] = colours.rgb(mesh.values), mesh.values

    corners = mesh.cells.shape[1]
    if corners == 3:
        cells = np.empty(len(mesh.cells), [("count", "u1"), ("corners", "<i4", 3)])
        cells["count"], cells["corners"] = 3, mesh.cells
        element = [f"element face {len(cells)}", "property list uchar int vertex_indices"]
    else:
        cells = mesh.cells.astype("<i4")
        element = [f"element edge {len(cells)}", "property int vertex1", "property int vertex2"]
    lines = ["ply", "format binary_little_endian 1.0", "comment vertices in RAS mm", f"element vertex {len(vertices)}"]
    header = "\n".join([*lines, *properties, *element, "end_header\n"])
    _write_bytes(path, header.encode(), vertices.tobytes(), cells.tobytes())


def write_vtk(path: Path, mesh: Mesh) -> None:
    """Legacy binary VTK poly data, big-endian as that demands: triangles or lines, and the values at the points."""
    count, corners = mesh.cells.shape
    cells = np.column_stack([np.full(count, corners), mesh.cells])
    parts = [
        b"# vtk DataFile Version 3.0\nvertices in RAS mm\nBINARY\nDATASET POLYDATA\n",
        f"POINTS {len(mesh.vertices_ras_mm)} float\n".encode(),
        mesh.vertices_ras_mm.astype(">f4").tobytes(),
        f"\n{'POLYGONS' if corners == 3 else 'LINES'} {count} {cells.size}\n".encode(),
        cells.astype(">i4").tobytes(),
    ]
    if mesh.values is not None:
        parts += [
            f"\nPOINT_DATA {len(mesh.values)}\nSCALARS value float 1\nLOOKUP_TABLE default\n".encode(),
            mesh.values.astype(">f4").tobytes(),
        ]
    _write_bytes(path, *parts, b"\n")


def write_with_trimesh(path: Path, mesh: Mesh) -> None:
    """.obj and .glb with the values as RGB at the vertices, .stl with the geometry alone; vertex order as given."""
    import trimesh

    with checks.writing(path):
        rgb = None if mesh.values is None else colours.rgb(mesh.values)
        surface = trimesh.Trimesh(mesh.vertices_ras_mm, mesh.cells, vertex_colors=rgb, process=False)
        surface.export(path, file_type=path.suffix.lower().lstrip("."))


def write_obj_lines(path: Path, mesh: Mesh) -> None:
    """A curve as OBJ line elements, with the values as RGB at the vertices."""
    vertices = [f"v {x:.8g} {y:.8g} {z:.8g}" for x, y, z in mesh.vertices_ras_mm]
    if mesh.values is not None:
        tints = colours.rgb(mesh.values) / 255
        vertices = [f"{line} {r:.4f} {g:.4f} {b:.4f}" for line, (r, g, b) in zip(vertices, tints, strict=True)]
    lines = [f"l {a} {b}" for a, b in mesh.cells + 1]
    _write_bytes(path, "\n".join(["# vertices in RAS mm", *vertices, *lines, ""]).encode())


def _write_bytes(path: Path, *parts: bytes) -> None:
    with checks.writing(path), path.open("wb") as file:
        for part in parts:
            file.write(part)
