"""Meshes: vertices, faces, values and colours as other programs read them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import meshio
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


def test_gifti_names_the_structure(tmp_path):
    written = write_mesh(tmp_path / "o.surf.gii", replace(SURFACE, structure="CortexRight"))
    surface, values = (nib.load(path) for path in written)
    assert surface.meta["AnatomicalStructurePrimary"] == values.meta["AnatomicalStructurePrimary"] == "CortexRight"
    about = dict(surface.darrays[0].meta)
    assert about == {"AnatomicalStructurePrimary": "CortexRight", "GeometricType": "Anatomical"}
    surface, values = (nib.load(path) for path in write_mesh(tmp_path / "o.surf.gii", SURFACE))
    assert (dict(surface.meta), dict(values.meta)) == ({}, {})


def test_gifti_without_values_is_one_file(tmp_path):
    written = write_mesh(tmp_path / "lh.surf.gii", Mesh(VERTICES, FACES))
    assert written == mesh_files(tmp_path / "lh.surf.gii", values=False) == [tmp_path / "lh.surf.gii"]
    assert list(tmp_path.iterdir()) == written


def test_ply(tmp_path):
    path = tmp_path / "m.ply"
    assert write_mesh(path, SURFACE) == [path]
    assert path.read_bytes().startswith(b"ply\nformat binary_little_endian 1.0\n")

    mesh = trimesh.load(path, process=False)
    assert np.array_equal(mesh.vertices, VERTICES)
    assert np.array_equal(mesh.faces, FACES)
    assert np.array_equal(mesh.visual.vertex_colors[:, :3], rgb(VALUES))
    assert mesh.volume == pytest.approx(2.5 * 3 * 4 / 6)  # positive: the faces look outward

    twin = meshio.read(path)
    assert np.array_equal(twin.points, VERTICES)
    assert np.array_equal(twin.cells_dict["triangle"], FACES)
    assert twin.point_data["value"].dtype == np.float32
    assert np.array_equal(twin.point_data["value"], VALUES, equal_nan=True)


def test_ply_of_a_bare_shape(tmp_path):
    write_mesh(tmp_path / "bare.ply", Mesh(VERTICES, FACES))
    bare = meshio.read(tmp_path / "bare.ply")
    assert np.array_equal(bare.points, VERTICES)
    assert bare.point_data == {}


def test_ply_of_a_curve(tmp_path):
    write_mesh(tmp_path / "curve.ply", CURVE)
    header, body = (tmp_path / "curve.ply").read_bytes().split(b"end_header\n", 1)
    assert b"element edge 3\nproperty int vertex1\nproperty int vertex2\n" in header
    edges = np.frombuffer(body[-CURVE.cells.nbytes :], "<i4").reshape(-1, 2)
    assert np.array_equal(edges, CURVE.cells)

    points = trimesh.load(tmp_path / "curve.ply", process=False)
    assert np.array_equal(points.vertices, VERTICES)
    vertices = points.metadata["_ply_raw"]["vertex"]["data"]
    assert np.array_equal(vertices["value"].reshape(-1), VALUES, equal_nan=True)
    assert np.array_equal(np.column_stack([vertices[c] for c in ("red", "green", "blue")]), rgb(VALUES))


@pytest.mark.parametrize(("mesh", "cell_type"), [(SURFACE, "triangle"), (CURVE, "line")])
def test_vtk(tmp_path, mesh, cell_type):
    write_mesh(tmp_path / "m.vtk", mesh)
    assert (tmp_path / "m.vtk").read_bytes().splitlines()[2] == b"BINARY"
    read = meshio.read(tmp_path / "m.vtk")
    assert read.points.dtype.itemsize == read.point_data["value"].dtype.itemsize == 4
    assert np.array_equal(read.points, VERTICES)
    assert np.array_equal(read.cells_dict[cell_type], mesh.cells)
    assert np.array_equal(read.point_data["value"], VALUES, equal_nan=True)


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


# --- several values at a vertex ----------------------------------------------------------------------------------

SEVERAL = np.stack([VALUES, VALUES * 2, VALUES - 5], -1)


def test_gifti_of_several_values(tmp_path):
    _, path = write_mesh(tmp_path / "lh.surf.gii", Mesh(VERTICES, FACES, SEVERAL))
    maps = nib.load(path).darrays
    assert [one.meta["Name"] for one in maps] == ["value 1", "value 2", "value 3"]
    assert all(np.array_equal(one.data, SEVERAL[:, k], equal_nan=True) for k, one in enumerate(maps))


@pytest.mark.parametrize("suffix", [".ply", ".vtk"])
@pytest.mark.parametrize("cells", [FACES, CURVE.cells])
def test_numbers_of_several_values(tmp_path, suffix, cells):
    path = tmp_path / f"m{suffix}"
    write_mesh(path, Mesh(VERTICES, cells, SEVERAL))
    if suffix == ".ply" and len(cells[0]) == 2:
        header = path.read_bytes().split(b"end_header")[0]
        assert all(f"property float value_{k}".encode() in header for k in (1, 2, 3))
        return
    found = meshio.read(path).point_data
    assert all(np.array_equal(found[f"value_{k + 1}"], SEVERAL[:, k], equal_nan=True) for k in range(3))


def test_colours_of_several_values():
    grey = [128, 128, 128]
    true = np.array([[-0.4, 127.6, 270], [np.nan, 0, 0], [3, 2, 3]])
    assert rgb(true).tolist() == [[0, 128, 255], grey, [3, 2, 3]]
    signed = true - 200
    assert np.array_equal(rgb(signed), rgb(np.linalg.norm(signed, axis=1)))
    assert np.array_equal(rgb(SEVERAL[:, :2]), rgb(np.sqrt(5) * VALUES))
    assert rgb(np.full((2, 3), np.nan)).tolist() == [grey, grey]
    assert not np.array_equal(rgb(true / 255), np.rint(true / 255))  # a field of small numbers is no picture
