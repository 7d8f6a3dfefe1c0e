"""Surfaces read from every format: order and place of the vertices, frames, structures, and what is refused."""

from __future__ import annotations

from pathlib import Path

import meshio
import nibabel as nib
import numpy as np
import pytest
import trimesh
from nibabel import freesurfer, gifti
from twins import TWINS

from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.formats import is_surface, parse_structure, read_surface, surface_format, write_mesh
from beltrami_cli.formats.structures import structure_of_name
from beltrami_cli.grid import Grid
from beltrami_cli.surface import Mesh

# A pyramid in the world, faces counter-clockwise from outside, vertices in no particular order.
VERTICES = np.array([[10.0, -20, 30], [16.5, -20, 30], [10, -13, 30], [16.5, -13, 30], [12.25, -18, 41]])
FACES = np.array([[0, 2, 1], [1, 2, 3], [0, 1, 4], [1, 3, 4], [3, 2, 4], [2, 0, 4]], np.int32)
VOLUME_MM3 = 6.5 * 7 * 11 / 3

# As recon-all makes it: columns to the left, rows down, slices forward; and the twins.
CONFORMED = Grid((256, 256, 256), np.array([[-1.0, 0, 0, 132.5], [0, 0, 1, -147.4], [0, -1, 0, 114.2], [0, 0, 0, 1]]))
GRIDS = {"conformed": CONFORMED} | TWINS


def mgh_header(grid: Grid):
    return nib.MGHImage(np.zeros(grid.shape, np.uint8), grid.affine).header


def tkr(grid: Grid) -> tuple[np.ndarray, np.ndarray]:
    """The pyramid in the surface RAS of this volume, by nibabel's own matrices, outward there too."""
    matrix = mgh_header(grid).get_vox2ras_tkr() @ np.linalg.inv(grid.affine)
    cells = FACES if np.linalg.det(matrix) > 0 else FACES[:, ::-1]
    return nib.affines.apply_affine(matrix, VERTICES), cells


def volume_info(grid: Grid) -> dict:
    header = mgh_header(grid)
    x, y, z = header["Mdc"]
    return {
        "head": np.array([2, 0, 20], np.int32),
        "valid": "1  # volume info valid",
        "filename": "../mri/filled.mgz",
        "volume": np.array(grid.shape),
        "voxelsize": header["delta"],
        "xras": x,
        "yras": y,
        "zras": z,
        "cras": header["Pxyz_c"],
    }


def volume_geometry(grid: Grid) -> dict[str, str]:
    info = volume_info(grid)
    numbers = {f"VolGeom{name}": n for name, n in zip(("Width", "Height", "Depth"), grid.shape, strict=True)}
    numbers |= {f"VolGeom{axis}size": n for axis, n in zip("XYZ", info["voxelsize"], strict=True)}
    for axis, key in zip("XYZC", ("xras", "yras", "zras", "cras"), strict=True):
        numbers |= {f"VolGeom{axis}_{ras}": n for ras, n in zip("RAS", info[key], strict=True)}
    return {name: str(n) for name, n in numbers.items()}


def write_gifti(path: Path, points: np.ndarray, cells: np.ndarray, space=None, meta=None, **file_meta) -> Path:
    xform = gifti.GiftiCoordSystem(*space) if space else None
    arrays = [
        gifti.GiftiDataArray(
            points.astype(np.float32), "NIFTI_INTENT_POINTSET", coordsys=xform, meta=gifti.GiftiMetaData(meta or {})
        ),
        gifti.GiftiDataArray(cells.astype(np.int32), "NIFTI_INTENT_TRIANGLE"),
    ]
    gifti.GiftiImage(meta=gifti.GiftiMetaData(file_meta), darrays=arrays).to_filename(path)
    return path


def assert_the_pyramid(mesh: Mesh, tolerance_mm: float = 1e-4) -> None:
    assert (mesh.vertices_ras_mm.dtype, mesh.cells.dtype) == (np.float64, np.int32)
    assert np.abs(mesh.vertices_ras_mm - VERTICES).max() < tolerance_mm
    assert trimesh.Trimesh(mesh.vertices_ras_mm, mesh.cells).volume == pytest.approx(VOLUME_MM3, rel=1e-4)


# --- every format ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["lh.white.surf.gii", "m.ply", "m.obj", "m.vtk", "m.PLY"])
def test_our_own_files_come_back(tmp_path, name):
    path = tmp_path / name
    write_mesh(path, Mesh(VERTICES, FACES))
    assert is_surface(path)
    mesh = read_surface(path)
    assert_the_pyramid(mesh)
    assert np.array_equal(mesh.cells, FACES)
    assert mesh.values is None


def test_the_corners_of_stl_are_merged(tmp_path):
    path = tmp_path / "m.stl"
    write_mesh(path, Mesh(VERTICES, FACES))
    assert surface_format(path) == "STL"
    mesh = read_surface(path)
    assert mesh.vertices_ras_mm.shape == VERTICES.shape
    assert np.allclose(np.sort(mesh.vertices_ras_mm, axis=0), np.sort(VERTICES, axis=0))
    assert np.allclose(mesh.vertices_ras_mm[mesh.cells], VERTICES[FACES])


def test_obj_of_other_programs(tmp_path):
    # Texture coordinates, normals, materials, groups, quads, counts from the end, a vertex of no face, colours.
    lines = ["mtllib a.mtl", *(f"v {x} {y} {z} 0.5 0.5 0.5" for x, y, z in VERTICES), "v 1 2 3", "vt 0 0", "vt 1 1"]
    lines += ["vn 0 0 1", "g base", "usemtl a", "f 1/1/1 3/2/1 4/1/1 2/2/1", "g side", "usemtl b", "f 1//1 2//1 5//1"]
    lines += ["f 2/2 4/1 5/1", "f -3 -4 -2", "f 3 \\", "1 5"]
    (tmp_path / "a.obj").write_text("\n".join(lines))
    mesh = read_surface(tmp_path / "a.obj")
    assert np.array_equal(mesh.vertices_ras_mm, [*VERTICES, [1, 2, 3]])
    expected = [[0, 2, 3], [0, 3, 1], [0, 1, 4], [1, 3, 4], [3, 2, 4], [2, 0, 4]]
    assert mesh.cells.tolist() == expected


def test_quads_of_ply_and_vtk(tmp_path):
    rows = [" ".join(map(str, row)) for row in VERTICES.tolist()]
    head = "ply\nformat ascii 1.0\nelement vertex 5\nproperty double x\nproperty double y\nproperty double z\n"
    body = ["element face 5", "property list uchar int vertex_indices", "end_header", *rows, "4 0 2 3 1"]
    (tmp_path / "q.ply").write_text(head + "\n".join([*body, *(f"3 {a} {b} {c}" for a, b, c in FACES[2:]), ""]))
    assert_the_pyramid(read_surface(tmp_path / "q.ply"))
    cells = [("quad", np.array([[0, 2, 3, 1]])), ("triangle", FACES[2:])]
    meshio.vtk.write(tmp_path / "q.vtk", meshio.Mesh(VERTICES, cells), "4.2", binary=False)
    assert_the_pyramid(read_surface(tmp_path / "q.vtk"))


# --- FreeSurfer ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS)
def test_freesurfer_surface_ras_is_carried_to_the_scanner(tmp_path, grid):
    path = tmp_path / "lh.white"
    freesurfer.write_geometry(path, *tkr(grid), volume_info=volume_info(grid))
    assert is_surface(path)
    assert surface_format(path) == "FreeSurfer"
    # Whatever volume it is used with, the file's own geometry counts.
    for like in (None, TWINS["LPS"]):
        mesh = read_surface(path, like=like)
        assert_the_pyramid(mesh, 1e-3)
        assert mesh.structure == "CortexLeft"
    assert np.allclose(read_surface(path, frame="scanner").vertices_ras_mm, tkr(grid)[0], atol=1e-4)


@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS)
@pytest.mark.parametrize("suffix", ["", ".ply"])
def test_frame_tkr_by_the_volume(tmp_path, grid, suffix):
    path = tmp_path / f"rh.white{suffix}"
    points, cells = tkr(grid)
    if suffix:
        write_mesh(path, Mesh(points, cells))
    else:
        freesurfer.write_geometry(path, points, cells)
    assert_the_pyramid(read_surface(path, frame="tkr", like=grid), 1e-3)
    with pytest.raises(RefusedError, match=r"--frame tkr needs the volume .* give that volume too, or drop --frame"):
        read_surface(path, frame="tkr")


def test_freesurfer_without_volume_info(tmp_path):
    path = tmp_path / "lh.white"
    for info in ({}, volume_info(CONFORMED) | {"valid": "0  # volume info invalid"}):
        freesurfer.write_geometry(path, VERTICES, FACES, volume_info=info)
        assert_the_pyramid(read_surface(path))
        assert_the_pyramid(read_surface(path, frame="scanner", like=CONFORMED))
        with pytest.raises(RefusedError, match=r"no valid volume info.*--frame tkr .*--frame scanner"):
            read_surface(path, like=CONFORMED)


def test_freesurfer_in_scanner_ras_already(tmp_path):
    path = tmp_path / "lh.white"
    freesurfer.write_geometry(path, VERTICES, FACES, volume_info=volume_info(CONFORMED))
    content = path.read_bytes()
    tag = bytes([0, 0, 0, 2, 0, 0, 0, 0, 0, 0, 0, 20])
    path.write_bytes(content.replace(tag, tag[:7] + b"\1" + tag[8:]))
    assert path.read_bytes() != content
    assert_the_pyramid(read_surface(path, like=CONFORMED))
    # It may be marked wrongly: what the user says counts.
    moved = read_surface(path, frame="tkr").vertices_ras_mm - VERTICES
    assert np.allclose(moved, volume_info(CONFORMED)["cras"], atol=1e-4)


def test_freesurfer_geometry_that_places_nothing(tmp_path):
    path = tmp_path / "lh.white"
    info = volume_info(CONFORMED) | {"xras": np.zeros(3)}
    freesurfer.write_geometry(path, VERTICES, FACES, volume_info=info)
    with pytest.raises(DataError, match=r"places the vertices nowhere.*--frame scanner"):
        read_surface(path)
    assert_the_pyramid(read_surface(path, frame="scanner"))


# --- GIFTI --------------------------------------------------------------------------------------------------------

UNKNOWN, SCANNER, TALAIRACH = 0, 1, 3
TALAIRACH_XFM = np.array([[1.1, 0.02, 0, 3], [0, 1.2, 0.1, -9], [0, -0.1, 1.15, 4], [0, 0, 0, 1]])


def scanner_matrix(grid: Grid) -> np.ndarray:
    return grid.affine @ np.linalg.inv(mgh_header(grid).get_vox2ras_tkr())


@pytest.mark.parametrize("grid", GRIDS.values(), ids=GRIDS)
def test_gifti_in_surface_ras(tmp_path, grid):
    points, cells = tkr(grid)
    geometry, matrix = volume_geometry(grid), scanner_matrix(grid)
    for space, meta in (
        ((UNKNOWN, SCANNER, matrix), {}),  # mris_convert since 7.4, its geometry removed by another program
        ((UNKNOWN, SCANNER, matrix), geometry),  # ... and kept
        ((UNKNOWN, TALAIRACH, TALAIRACH_XFM), geometry),  # mris_convert before
        (None, geometry),  # ... where there was no talairach.xfm
    ):
        path = write_gifti(tmp_path / "lh.white.surf.gii", points, cells, space, meta)
        assert_the_pyramid(read_surface(path), 1e-3)
        assert_the_pyramid(read_surface(path, frame="tkr", like=TWINS["RAS"]), 1e-3)
        assert np.allclose(read_surface(path, frame="scanner").vertices_ras_mm, points, atol=1e-4)


def test_gifti_in_the_world(tmp_path):
    geometry, matrix = volume_geometry(CONFORMED), scanner_matrix(CONFORMED)
    centred = geometry | {f"VolGeomC_{ras}": "0.000000" for ras in "RAS"}
    sizes_only = {name: value for name, value in geometry.items() if "_" not in name}
    for space, meta in (
        ((SCANNER, UNKNOWN, np.linalg.inv(matrix)), geometry),  # mris_convert --to-scanner since 7.4
        ((TALAIRACH, TALAIRACH, np.eye(4)), geometry),  # what Connectome Workbench makes of any file
        ((UNKNOWN, TALAIRACH, TALAIRACH_XFM), centred),  # fMRIPrep up to 21
        ((UNKNOWN, TALAIRACH, TALAIRACH_XFM), sizes_only),  # fMRIPrep since 22
        ((UNKNOWN, UNKNOWN, np.eye(4)), {}),
        (None, {}),
    ):
        path = write_gifti(tmp_path / "m.surf.gii", VERTICES, FACES, space, meta)
        assert_the_pyramid(read_surface(path))
        assert_the_pyramid(read_surface(path, like=CONFORMED))


def test_gifti_of_any_suffix_that_holds_a_surface(tmp_path):
    path = write_gifti(tmp_path / "lh.pial.gii", VERTICES, FACES)
    assert is_surface(path)
    assert_the_pyramid(read_surface(path))


@pytest.mark.parametrize(
    ("space", "with_geometry"), [((SCANNER, UNKNOWN, np.eye(4)), False), ((TALAIRACH, TALAIRACH, np.eye(4)), True)]
)
def test_frame_tkr_against_what_the_file_says(tmp_path, space, with_geometry):
    meta = volume_geometry(CONFORMED) if with_geometry else {}
    path = write_gifti(tmp_path / "m.surf.gii", VERTICES, FACES, space, meta)
    if with_geometry:  # Workbench writes TALAIRACH whatever the space is: the user knows better
        moved = read_surface(path, frame="tkr", like=CONFORMED).vertices_ras_mm - VERTICES
        assert np.allclose(moved, volume_info(CONFORMED)["cras"], atol=1e-3)
    else:
        for like in (None, CONFORMED):
            with pytest.raises(RefusedError, match=r"m\.surf\.gii: says .* scanner RAS .* found --frame tkr; drop it"):
                read_surface(path, frame="tkr", like=like)
    assert_the_pyramid(read_surface(path, frame="scanner", like=CONFORMED))
    assert_the_pyramid(read_surface(path, frame="tkr", like=CONFORMED, frame_where_unsaid=True))


def test_one_frame_for_several_files(tmp_path):
    points, cells = tkr(CONFORMED)
    path = tmp_path / "lh.white"
    freesurfer.write_geometry(path, points, cells)  # says nothing
    assert_the_pyramid(read_surface(path, frame="tkr", like=CONFORMED, frame_where_unsaid=True), 1e-3)
    freesurfer.write_geometry(path, points, cells, volume_info=volume_info(CONFORMED))
    assert_the_pyramid(read_surface(path, frame="scanner", like=CONFORMED, frame_where_unsaid=True), 1e-3)
    write_mesh(tmp_path / "m.ply", Mesh(points, cells))  # neither does PLY, nor GIFTI of an unknown space
    unknown = write_gifti(tmp_path / "m.surf.gii", points, cells)
    for path in (tmp_path / "m.ply", unknown):
        assert_the_pyramid(read_surface(path, frame="tkr", like=CONFORMED, frame_where_unsaid=True), 1e-3)
        assert_the_pyramid(read_surface(path, frame="tkr", like=CONFORMED), 1e-3)


# --- structures ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "structure"),
    [
        ("lh.pial", "CortexLeft"),
        ("rh.white.surf.gii", "CortexRight"),
        ("sub-01_hemi-R_space-T1w_white.surf.gii", "CortexRight"),
        ("hemi-L.surf.gii", "CortexLeft"),
        ("100307.L.midthickness.32k_fs_LR.surf.gii", "CortexLeft"),
        ("100307.R.white.surf.gii", "CortexRight"),
        ("white.surf.gii", None),
        ("lhotse.surf.gii", None),
        ("fs_LR.surf.gii", None),
        ("shape.l.ply", None),
    ],
)
def test_structure_of_a_name(name, structure):
    assert structure_of_name(Path("some/lh.folder") / name) == structure


def test_structure_of_a_gifti_file(tmp_path):
    for meta, file_meta, expected in (
        ({"AnatomicalStructurePrimary": "CortexRight"}, {}, "CortexRight"),
        ({}, {"AnatomicalStructurePrimary": "CEREBELLUM"}, "Cerebellum"),
        ({"AnatomicalStructurePrimary": "Unknown"}, {}, "CortexLeft"),  # as lh. says
    ):
        path = write_gifti(tmp_path / "lh.m.surf.gii", VERTICES, FACES, None, meta, **file_meta)
        assert read_surface(path).structure == expected


def test_a_structure_as_people_type_it():
    for text in ("CortexLeft", "CORTEX_LEFT", "cortex left", "left", "lh", "L", "hemi-L"):
        assert parse_structure(text) == "CortexLeft"
    assert [parse_structure(t) for t in ("R", "right", "cerebellum", "THALAMUS_LEFT")] == [
        "CortexRight",
        "CortexRight",
        "Cerebellum",
        "ThalamusLeft",
    ]
    for text in ("", "leftt", "cortexes"):
        with pytest.raises(RefusedError, match=r"no such part of the brain; expected CortexLeft"):
            parse_structure(text)


# --- what is no surface -------------------------------------------------------------------------------------------


def write_surface(path: Path, vertices: np.ndarray, cells: np.ndarray) -> None:
    if path.suffix == ".gii":
        write_gifti(path, vertices, cells)
    elif path.suffix == ".white":
        freesurfer.write_geometry(path, vertices, cells)
    else:
        trimesh.Trimesh(vertices, cells, process=False, validate=False).export(path)


@pytest.mark.parametrize("name", ["m.surf.gii", "lh.white", "m.ply", "m.obj"])
def test_broken_meshes(tmp_path, name):
    path = tmp_path / name
    write_surface(path, VERTICES, np.where(FACES == 4, 9, FACES) if path.suffix != ".obj" else FACES)
    if path.suffix == ".obj":
        path.write_text(path.read_text().replace(" 5", " 10"))
    with pytest.raises(DataError, match=r"4 of 6 triangles name vertices that are not there \(0 to 4 are\)"):
        read_surface(path)

    broken = VERTICES.copy()
    broken[1, 2] = np.nan
    write_surface(path, broken, FACES)
    with pytest.raises(DataError, match=r"1 of 5 vertices have coordinates that are not finite"):
        read_surface(path)


@pytest.mark.parametrize("name", ["m.surf.gii", "lh.white", "m.ply", "m.stl", "m.vtk"])
def test_files_cut_short(tmp_path, name):
    path = tmp_path / name
    if path.suffix == ".white":
        freesurfer.write_geometry(path, VERTICES, FACES)
    else:
        write_mesh(path, Mesh(VERTICES, FACES))
    whole = path.read_bytes()
    for length in (len(whole) // 2, 40):
        path.write_bytes(whole[:length])
        with pytest.raises(DataError, match=r"cannot be read as|no triangles") as caught:
            read_surface(path)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize("kind", ["stl", "stl_ascii"])
def test_stl_cut_short_or_damaged(tmp_path, kind):
    pyramid = trimesh.Trimesh(2.1 * VERTICES, FACES, process=False)  # some bytes are no text
    whole = pyramid.export(file_type=kind)
    whole = whole if isinstance(whole, bytes) else whole.encode()
    path = tmp_path / "m.stl"
    path.write_bytes(whole)
    assert len(read_surface(path).cells) == len(FACES)
    for broken in (whole[:-9], whole[: len(whole) // 2], whole[:90], whole[:40], whole + whole[:90], b""):
        path.write_bytes(broken)
        with pytest.raises(DataError, match=r"m\.stl: cannot be read as STL \(cut short or damaged\); expected"):
            read_surface(path)


@pytest.mark.parametrize("name", ["m.surf.gii", "m.ply", "m.obj", "m.stl", "m.vtk"])
def test_files_of_another_kind(tmp_path, name):
    (tmp_path / name).write_bytes(b"not what the suffix says\n\0\xff" * 9)
    with pytest.raises(DataError) as caught:
        read_surface(tmp_path / name)
    assert "\n" not in str(caught.value)
    assert name in str(caught.value)


def test_points_without_triangles(tmp_path):
    (tmp_path / "p.obj").write_text("v 0 0 0\nv 1 0 0\n")
    axes = [f"property float {axis}" for axis in "xyz"]
    lines = ["ply", "format ascii 1.0", "element vertex 1", *axes, "end_header", "1 2 3", ""]
    (tmp_path / "p.ply").write_text("\n".join(lines))
    for name in ("p.obj", "p.ply"):
        with pytest.raises(DataError, match=r"vertices and no triangles"):
            read_surface(tmp_path / name)


def test_what_is_given_instead_of_a_surface(tmp_path):
    values = gifti.GiftiDataArray(np.zeros(5, np.float32), "NIFTI_INTENT_SHAPE")
    for name in ("x.surf.gii", "x.func.gii"):
        gifti.GiftiImage(darrays=[values]).to_filename(tmp_path / name)
        with pytest.raises(RefusedError, match=r"expected a surface.*found values at vertices; give them as data"):
            read_surface(tmp_path / name)
    assert not is_surface(tmp_path / "x.func.gii")

    freesurfer.write_morph_data(tmp_path / "lh.thickness", np.zeros(5))
    nib.Nifti1Image(np.zeros((3, 3, 3), np.uint8), np.eye(4)).to_filename(tmp_path / "v.nii.gz")
    (tmp_path / "lh.pial.asc").write_text("#!ascii version of lh.pial\n")
    (tmp_path / "lh.orig").write_bytes(b"\xff\xff\xfd" + bytes(60))
    for name, found in (
        ("lh.thickness", "found FreeSurfer values.*give them as data"),
        ("v.nii.gz", r"expected a surface \(\.gii \.ply .* lh\.white and alike\); found none of these"),
        ("lh.pial.asc", "mris_convert IN OUT.surf.gii"),
        ("lh.orig", "a surface of quadrangles.*mris_convert"),
        ("absent.surf.gii", "no such file"),
    ):
        with pytest.raises(RefusedError, match=found):
            read_surface(tmp_path / name)
    assert [is_surface(tmp_path / n) for n in ("lh.thickness", "v.nii.gz", "lh.pial.asc", "absent")] == [False] * 4

    with pytest.raises(RefusedError, match=r"frame lps: expected scanner .* or tkr"):
        read_surface(tmp_path / "x.surf.gii", frame="lps")


def test_the_real_ones(shared_data):
    sizes = {"retino_fsaverage/lh.crop": (22311, 44057), "s1_individual/lh.mid.crop": (59465, 118135)}
    for name, (vertices, cells) in sizes.items():
        mesh = read_surface(shared_data / f"{name}.surf.gii", like=CONFORMED)
        assert (len(mesh.vertices_ras_mm), len(mesh.cells)) == (vertices, cells)
        assert mesh.structure == "CortexLeft"
