"""Meshes in general formats: .ply and .vtk (numbers, triangles or lines), .obj, .stl, .glb.

None of them says what frame its vertices are in: they are taken, and written, as scanner RAS mm.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli.errors import DataError
from beltrami_cli.formats import checks, colours
from beltrami_cli.formats.frames import StoredSurface
from beltrami_cli.surface import Mesh

# What PLY files hold at vertices that are no values: places, normals, colours, places in a texture.
_NO_VALUES = {"x", "y", "z", "nx", "ny", "nz", "red", "green", "blue", "alpha", "s", "t", "u", "v"} | {
    "texture_u",
    "texture_v",
}


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


def read_values(path: Path) -> dict[str, np.ndarray]:
    """(V,) numbers at the vertices of a .ply or .vtk file by name, as stored; none of a file of another kind.

    Raises DataError as `checks`, and where there are not as many as vertices.
    """
    match path.suffix.lower():
        case ".ply":
            with checks.reading(path, "PLY"):
                columns = _read_ply(path).get("vertex", {})
            values = {name: column for name, column in columns.items() if name.lower() not in _NO_VALUES}
            vertices = len(columns.get("x", ()))
        case ".vtk":
            with checks.reading(path, "VTK"):
                content = _load_vtk(path)
                arrays = {name: np.asarray(array) for name, array in content.point_data.items()}
            values = {name: array.reshape(-1) for name, array in arrays.items() if array.shape[1:] in ((), (1,))}
            vertices = len(content.points)
        case _:
            return {}
    for name, column in values.items():
        if len(column) != vertices or column.dtype.kind not in "fiub":
            raise DataError(
                f"{path}: {name} is {len(column)} of type {column.dtype} for {vertices} vertices; expected a number "
                "for each vertex: export the mesh again"
            )
    return values


def read_curve(path: Path) -> Mesh | None:
    """The curve of a .ply or .vtk file that has lines and no triangles, as `write_ply` and `write_vtk` make it.

    None for any other file. Raises DataError as `checks`, and for lines between vertices that are not there or lie
    at no finite place.
    """
    match path.suffix.lower():
        case ".ply":
            with checks.reading(path, "PLY"):
                found = _read_ply(path)
                if "face" in found or "edge" not in found:
                    return None
                vertices = np.stack([found["vertex"][axis] for axis in "xyz"], -1).astype(float)
                lines = np.stack([found["edge"][end] for end in ("vertex1", "vertex2")], -1).astype(np.int32)
        case ".vtk":
            with checks.reading(path, "VTK"):
                content = _load_vtk(path)
                if set(content.cells_dict) != {"line"}:
                    return None
                vertices, lines = np.array(content.points, float), content.cells_dict["line"].astype(np.int32)
        case _:
            return None
    if not ((lines >= 0) & (lines < len(vertices))).all() or not np.isfinite(vertices).all():
        raise DataError(
            f"{path}: a curve whose lines name vertices that are not there or lie at no finite place; expected a "
            "complete curve: export it again"
        )
    return Mesh(vertices, lines)


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

    if kind == "STL":
        _require_whole_stl(path)
    mesh = trimesh.load(path, file_type=kind.lower(), process=False)
    if kind == "STL":
        mesh.merge_vertices()
    # A file without faces comes as a cloud of points.
    cells = getattr(mesh, "faces", np.empty((0, 3)))
    return np.array(mesh.vertices, float), np.array(cells, np.int32)


def _require_whole_stl(path: Path) -> None:
    """Raise ValueError unless it has as many bytes as its header says, 50 for each triangle, or ends as text does.

    trimesh takes bytes of any other number for text, and reads of text the solids that are complete.
    """
    with path.open("rb") as file:
        head = file.read(84)
        size = file.seek(0, 2)
        file.seek(max(0, size - 1024))  # a last line is shorter
        last = file.read().strip().rpartition(b"\n")[2]
    is_whole_binary = len(head) == 84 and size == 84 + 50 * int.from_bytes(head[80:], "little")
    if not is_whole_binary and not last.strip().lower().startswith(b"endsolid"):
        raise ValueError("cut short or damaged")


def _read_ply(path: Path) -> dict[str, dict[str, np.ndarray]]:
    """(N,) columns of each kind of element that is there, as `vertex` and `edge`, by the name of the property."""
    import trimesh

    raw = trimesh.load(path, file_type="ply", process=False).metadata["_ply_raw"]
    return {
        kind: {
            name: np.asarray(element["data"][name]).reshape(-1)
            for name, dtype in element["properties"].items()
            if "$LIST" not in dtype and kind != "face"
        }
        for kind, element in raw.items()
        if element["length"]
    }


def _load_vtk(path: Path) -> Any:
    import meshio

    return meshio.vtk.read(path)  # not meshio.read, which prints and exits on what it does not know


def _read_vtk(path: Path) -> tuple[np.ndarray, np.ndarray]:
    content = _load_vtk(path)
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
