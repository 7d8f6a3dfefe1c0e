"""Meshes: vertices, faces, values and colours as other programs read them."""

from __future__ import annotations

from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
import trimesh

from beltrami_cli.errors import RefusedError
from beltrami_cli.formats import mesh_beside, mesh_files, write_mesh
from beltrami_cli.formats.colours import rgb
from beltrami_cli.surface import Mesh

# A tetrahedron away from the origin, faces counter-clockwise from outside.
VERTICES = np.array([[10.0, -20.0, 30.0], [12.5, -20.0, 30.0], [10.0, -17.0, 30.0], [10.0, -20.0, 34.0]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.int32)
VALUES = np.array([0.0, 1.5, np.nan, 3.0], np.float32)
SURFACE = Mesh(VERTICES, FACES, VALUES)
CURVE = Mesh(VERTICES, np.array([[0, 1], [1, 2], [2, 3]], np.int32), VALUES)


def read_ply(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and cells of a binary PLY, by its own header."""
    header, body = path.read_bytes().split(b"end_header\n", 1)
    codes = {"float": "<f4", "uchar": "u1", "int": "<i4"}
    tables: list[tuple[int, list[tuple[str, str]]]] = []
    for words in (line.split() for line in header.decode().splitlines()):
        if words[0] == "element":
            tables.append((int(words[2]), []))
        elif words[:2] == ["property", "list"]:
            tables[-1][1].extend([("count", "u1"), ("a", "<i4"), ("b", "<i4"), ("c", "<i4")])
        elif words[0] == "property":
            tables[-1][1].append((words[2], codes[words[1]]))
    (vertex_count, vertex_fields), (cell_count, cell_fields) = tables
    vertices = np.frombuffer(body, vertex_fields, vertex_count)
    cells = np.frombuffer(body, cell_fields, cell_count, vertices.nbytes)
    assert len(body) == vertices.nbytes + cells.nbytes
    return vertices, cells


def test_gifti(tmp_path):
    written = write_mesh(tmp_path / "lh.surf.gii", SURFACE)
    assert written == mesh_files(tmp_path / "lh.surf.gii") == [tmp_path / "lh.surf.gii", tmp_path / "lh.func.gii"]

    surface, values = (nib.load(path) for path in written)
    points, triangles = surface.darrays
    assert points.data.dtype == np.float32
    assert np.array_equal(points.data, VERTICES)
    assert triangles.data.dtype == np.int32
    assert np.array_equal(triangles.data, FACES)
    assert (points.intent, triangles.intent) == (1008, 1009)  # NIFTI_INTENT_POINTSET, NIFTI_INTENT_TRIANGLE
    assert (points.coordsys.dataspace, points.coordsys.xformspace) == (1, 1)  # NIFTI_XFORM_SCANNER_ANAT
    assert np.array_equal(points.coordsys.xform, np.eye(4))
    assert np.array_equal(values.darrays[0].data, VALUES, equal_nan=True)
    assert values.darrays[0].data.dtype == np.float32
    assert values.darrays[0].meta["Name"] == "value"


def test_gifti_without_values_is_one_file(tmp_path):
    written = write_mesh(tmp_path / "lh.surf.gii", Mesh(VERTICES, FACES))
    assert written == mesh_files(tmp_path / "lh.surf.gii", values=False) == [tmp_path / "lh.surf.gii"]
    assert list(tmp_path.iterdir()) == written


def test_ply(tmp_path):
    path = tmp_path / "m.ply"
    assert write_mesh(path, SURFACE) == [path]
    vertices, faces = read_ply(path)
    assert np.array_equal(np.column_stack([vertices[axis] for axis in "xyz"]), VERTICES)
    assert np.array_equal(vertices["value"], VALUES, equal_nan=True)
    colours = np.column_stack([vertices[name] for name in ("red", "green", "blue")])
    assert np.array_equal(colours, rgb(VALUES))
    assert np.array_equal(np.column_stack([faces[corner] for corner in "abc"]), FACES)

    mesh = trimesh.load(path, process=False)
    assert np.array_equal(mesh.vertices, VERTICES)
    assert np.array_equal(mesh.faces, FACES)
    assert np.array_equal(mesh.visual.vertex_colors[:, :3], rgb(VALUES))
    assert mesh.volume == pytest.approx(2.5 * 3 * 4 / 6)  # positive: the faces look outward


def test_ply_of_a_curve_and_of_a_bare_shape(tmp_path):
    write_mesh(tmp_path / "curve.ply", CURVE)
    vertices, edges = read_ply(tmp_path / "curve.ply")
    assert np.array_equal(vertices["value"], VALUES, equal_nan=True)
    assert np.array_equal(np.column_stack([edges["vertex1"], edges["vertex2"]]), CURVE.cells)
    write_mesh(tmp_path / "bare.ply", Mesh(VERTICES, FACES))
    assert read_ply(tmp_path / "bare.ply")[0].dtype.names == ("x", "y", "z")


@pytest.mark.parametrize(("mesh", "section"), [(SURFACE, "POLYGONS 4 16"), (CURVE, "LINES 3 9")])
def test_vtk(tmp_path, mesh, section):
    write_mesh(tmp_path / "m.vtk", mesh)
    content = (tmp_path / "m.vtk").read_bytes()
    assert content.startswith(b"# vtk DataFile Version 3.0\n")
    assert content.splitlines()[2:4] == [b"BINARY", b"DATASET POLYDATA"]

    def after(title: str, dtype: str, count: int) -> np.ndarray:
        return np.frombuffer(content, dtype, count, content.index(title.encode() + b"\n") + len(title) + 1)

    assert np.array_equal(after("POINTS 4 float", ">f4", 12).reshape(4, 3), VERTICES)
    corners = mesh.cells.shape[1]
    cells = after(section, ">i4", len(mesh.cells) * (corners + 1)).reshape(-1, corners + 1)
    assert (cells[:, 0] == corners).all()
    assert np.array_equal(cells[:, 1:], mesh.cells)
    assert b"POINT_DATA 4\nSCALARS value float 1\n" in content
    assert np.array_equal(after("LOOKUP_TABLE default", ">f4", 4), VALUES, equal_nan=True)


@pytest.mark.parametrize("suffix", [".obj", ".glb"])
def test_obj_and_glb_hold_colours(tmp_path, suffix):
    write_mesh(tmp_path / f"m{suffix}", SURFACE)
    mesh = trimesh.load(tmp_path / f"m{suffix}", process=False, force="mesh", maintain_order=True)
    assert np.allclose(mesh.vertices, VERTICES, atol=1e-5)
    assert np.array_equal(mesh.faces, FACES)
    assert np.abs(mesh.visual.vertex_colors[:, :3].astype(int) - rgb(VALUES)).max() <= 1


def test_stl_holds_the_shape(tmp_path):
    write_mesh(tmp_path / "m.stl", SURFACE)
    mesh = trimesh.load(tmp_path / "m.stl", process=False)
    assert np.allclose(mesh.triangles, VERTICES[FACES], atol=1e-5)


def test_obj_of_a_curve(tmp_path):
    write_mesh(tmp_path / "m.obj", CURVE)
    lines = (tmp_path / "m.obj").read_text().splitlines()
    assert [line for line in lines if line[0] == "l"] == ["l 1 2", "l 2 3", "l 3 4"]
    assert lines[2] == "v 12.5 -20 30 " + " ".join(f"{c / 255:.4f}" for c in rgb(VALUES)[1])


@pytest.mark.parametrize("name", ["m.surf.gii", "m.stl", "m.glb"])
def test_a_curve_is_refused_where_there_are_no_lines(tmp_path, name):
    for refused in (lambda: mesh_files(tmp_path / name, curve=True), lambda: write_mesh(tmp_path / name, CURVE)):
        with pytest.raises(RefusedError, match=r"not the lines of a curve; write \.ply, \.vtk or \.obj"):
            refused()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("volume", "surface", "curve"),
    [
        ("a/o.nii.gz", "a/o.surf.gii", "a/o.ply"),
        ("o.mgz", "o.surf.gii", "o.ply"),
        ("o.mha", "o.ply", "o.ply"),
        ("o.npy", "o.ply", "o.ply"),
    ],
)
def test_the_mesh_beside_a_volume(volume, surface, curve):
    assert mesh_beside(Path(volume)) == Path(surface)
    assert mesh_beside(Path(volume), curve=True) == Path(curve)


def test_colours():
    values = np.r_[np.linspace(0.0, 100.0, 101), np.nan, np.inf]
    colours = rgb(values)
    assert colours.dtype == np.uint8
    assert colours[0].tolist() == colours[2].tolist() == [68, 1, 84]  # both ends of viridis, at the 2nd ...
    assert colours[98].tolist() == colours[100].tolist() == [253, 231, 37]  # ... and the 98th percentile
    assert colours[101:].tolist() == [[128, 128, 128]] * 2
    assert (np.diff(colours[2:99].astype(float) @ [0.2126, 0.7152, 0.0722]) > 0).all()  # ever lighter
    assert rgb(np.full(3, 7.0)).tolist() == [colours[50].tolist()] * 3
    assert rgb(np.full(2, np.nan)).tolist() == [[128, 128, 128]] * 2
