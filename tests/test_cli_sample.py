"""sample: a volume's values at the vertices of a user's own surface, from files to a file."""

from __future__ import annotations

import hashlib
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
from command import beltrami, contents, done, load, nifti, npy, record, refused

from beltrami_cli import __version__

AFFINE = np.array([[-1.5, 0, 0, 20], [0, 1.5, 0, -30], [0, 0, 1.5, 10], [0, 0, 0, 1.0]])
SHAPE = (16, 15, 14)


def value(ras_mm: np.ndarray) -> np.ndarray:
    """Trilinear interpolation is exact for it."""
    return ras_mm @ [1.0, -2.0, 0.5] + 100


def places() -> np.ndarray:
    return np.indices(SHAPE).reshape(3, -1).T @ AFFINE[:3, :3].T + AFFINE[:3, 3]


def field() -> np.ndarray:
    return value(places()).reshape(SHAPE).astype(np.float32)


def ball_of_points(radius: float = 7.0) -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) and triangles of an octahedron refined twice, around the middle of the volume."""
    points = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
    cells = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])
    for _ in range(2):
        ends = np.sort(cells[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), 1)
        edges, number = np.unique(ends, axis=0, return_inverse=True)
        ab, bc, ca = len(points) + number.reshape(-1, 3).T
        a, b, c = cells.T
        cells = np.concatenate([np.stack(t, 1) for t in ((a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca))])
        points = np.concatenate([points, points[edges].mean(1)])
        points /= np.linalg.norm(points, axis=1, keepdims=True)
    return radius * points + places().mean(0), cells


def surface(path: Path, points: np.ndarray | None = None, structure: str | None = None) -> Path:
    vertices, cells = ball_of_points()
    arrays = [
        nib.gifti.GiftiDataArray((vertices if points is None else points).astype(np.float32), "NIFTI_INTENT_POINTSET"),
        nib.gifti.GiftiDataArray(cells.astype(np.int32), "NIFTI_INTENT_TRIANGLE"),
    ]
    if structure:
        arrays[0].meta["AnatomicalStructurePrimary"] = structure
    nib.save(nib.gifti.GiftiImage(darrays=arrays), path)
    return path


@pytest.fixture
def case(tmp_path: Path) -> tuple[Path, Path, Path]:
    """VOLUME, SURFACE and FILE."""
    return nifti(tmp_path / "v.nii.gz", field(), AFFINE), surface(tmp_path / "own.surf.gii"), tmp_path / "o.func.gii"


def maps(path: Path) -> np.ndarray:
    """(V, K) values of a GIFTI file."""
    return np.stack([array.data for array in nib.load(path).darrays], -1)


def test_values_come_in_the_order_of_the_vertices(case):
    volume, mesh, out = case
    run = done("sample", volume, mesh, "-o", out)
    vertices = nib.load(mesh).darrays[0].data
    got = maps(out)
    assert got.shape == (66, 1)
    assert np.abs(got[:, 0] - value(vertices)).max() < 1e-3
    sidecar = out.parent / "o.func.json"
    assert run.out.splitlines() == [
        f"wrote {out}, {sidecar}",
        "66 of 66 vertices have a value, 0 lie outside the volume",
    ]
    assert sorted(p.name for p in out.parent.iterdir()) == ["o.func.gii", "o.func.json", "own.surf.gii", "v.nii.gz"]


@pytest.mark.parametrize("name", ["o.shape.gii", "o.mgz", "lh.o", "o.func.gii"])
def test_formats_of_the_output(case, name):
    volume, mesh, out = case
    out = out.with_name(name)
    done("sample", volume, mesh, "-o", out)
    expected = value(nib.load(mesh).darrays[0].data)
    got = nib.freesurfer.read_morph_data(out) if name == "lh.o" else maps(out)[:, 0] if ".gii" in name else load(out)
    assert np.abs(np.ravel(got) - expected).max() < 1e-3
    assert (out.parent / {"lh.o": "lh.o.json", "o.mgz": "o.json"}.get(name, name.replace(".gii", ".json"))).is_file()


def test_the_record(case):
    volume, mesh, out = case
    done("sample", volume, mesh, "-o", out, "--missing", -1, "--structure", "right")
    found = record(out.with_name("o.func.json"))
    assert found["GeneratedBy"] == [{"Name": "beltrami_cli", "Version": __version__}]
    assert found["Sources"] == [
        {"Path": str(path), "SHA256": hashlib.sha256(path.read_bytes()).hexdigest(), "Role": role}
        for path, role in ((volume, "volume"), (mesh, "surface"))
    ]
    assert found["Outputs"] == [str(out), str(out.with_name("o.func.json"))]
    assert found["Parameters"] == {
        "kind": "scalar", "period": None, "missing": -1, "frame": None, "structure": "CortexRight", "spacing": None,
    }  # fmt: skip
    assert found["Vertices"] == {"vertices": 66, "with_value": 66, "outside_volume": 0}
    assert found["Grid"]["shape"] == list(SHAPE) and found["Warnings"] == []


@pytest.mark.parametrize(
    ("name", "stored", "option", "expected"),
    [
        ("own.surf.gii", None, None, None),
        ("own.surf.gii", "CortexLeft", None, "CortexLeft"),
        ("lh.mid.surf.gii", None, None, "CortexLeft"),
        ("own.surf.gii", "CortexLeft", "Cerebellum", "Cerebellum"),
    ],
)
def test_the_structure_is_kept_or_named(case, name, stored, option, expected):
    volume, _, out = case
    mesh = surface(out.with_name(name), structure=stored)
    done("sample", volume, mesh, "-o", out, *(["--structure", option] if option else []))
    image = nib.load(out)
    assert image.meta.get("AnatomicalStructurePrimary") == expected
    assert record(out.with_name("o.func.json"))["Parameters"]["structure"] == expected


# --- missing values ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hole", [np.nan, np.inf, -99.0])
def test_missing_stays_missing_and_takes_no_part(case, hole):
    volume, mesh, out = case
    data, lost = field(), places()[:, 2].reshape(SHAPE) < places()[:, 2].mean()
    data[lost] = hole
    nifti(volume, data, AFFINE)
    run = done("sample", volume, mesh, "-o", out, *(["--missing", hole] if hole == -99 else []))
    vertices = nib.load(mesh).darrays[0].data
    got = maps(out)[:, 0]
    depth = (vertices[:, 2] - places()[~lost.ravel(), 2].min()) / 1.5  # voxels above the lowest with a value
    assert np.isfinite(got[depth > -0.49]).all() and np.isnan(got[depth < -0.51]).all()
    inside = depth >= 0
    assert np.abs(got - value(vertices))[inside].max() < 1e-3
    assert f"{np.isfinite(got).sum()} of 66 vertices have a value, 0 lie outside" in run.out


def test_vertices_outside_are_told(case):
    volume, _, out = case
    points = ball_of_points()[0] + np.array([8.0, 0, 0])
    mesh = surface(out.with_name("moved.surf.gii"), points)
    run = beltrami("sample", volume, mesh, "-o", out)
    index = np.linalg.solve(AFFINE[:3, :3], (points - AFFINE[:3, 3]).T).T
    outside = int(((index < -0.5) | (index > np.array(SHAPE) - 0.5)).any(1).sum())
    assert 0 < outside < 66 and run.code == 0
    assert f"warning: {outside} of 66 vertices of {mesh} lie outside {volume}" in run.message
    assert f"{outside} lie outside the volume" in run.out
    assert np.isnan(maps(out)).sum() == outside
    found = record(out.with_name("o.func.json"))
    assert found["Vertices"]["outside_volume"] == outside and len(found["Warnings"]) == 1
    assert "warning" not in beltrami("sample", volume, mesh, "-o", out, "--overwrite", "-q").err


def test_no_value_at_all_is_an_error(case):
    volume, mesh, out = case
    before = contents(out.parent)
    far = surface(out.with_name("far.surf.gii"), ball_of_points()[0] + [0, 300, 0])
    message = refused("sample", volume, far, "-o", out, code=1)
    assert message.startswith(f"{volume}: has no value at the 66 vertices of {far}: none lies in the volume; ")
    assert "vertices within 1.75..15.75 x 273.5..287.5 x 12.75..26.75 mm" in message
    assert "voxels within -2.5..20 x -30..-9 x 10..29.5 mm (RAS)" in message
    assert "--frame tkr" in message
    far.unlink()
    nifti(volume, np.full(SHAPE, np.nan, np.float32), AFFINE)
    assert "the 66 in the volume meet missing values only" in refused("sample", volume, mesh, "-o", out, code=1)
    assert sorted(contents(out.parent)) == sorted(before)


# --- kinds ---------------------------------------------------------------------------------------------------------


def test_angles_turn_through_the_wrap(case):
    volume, mesh, out = case
    nifti(volume, field() * 20 % 360, AFFINE)
    done("sample", volume, mesh, "-o", out, "--kind", "circular", "--period", "360")
    got = maps(out)[:, 0]
    off = (got - value(nib.load(mesh).darrays[0].data) * 20 + 180) % 360 - 180
    # The chord between directions up to 60 degrees apart is not the arc.
    assert np.abs(off).max() < 3 and (got >= 0).all() and (got < 360).all()
    nifti(volume, (field() * 20 + 180) % 360 - 180, AFFINE)
    done("sample", volume, mesh, "-o", out, "--kind", "circular", "--period", "360", "--overwrite")
    signed = maps(out)[:, 0]
    assert (signed >= -180).all() and (signed < 180).all()
    assert np.abs((signed - got + 180) % 360 - 180).max() < 1e-3


def test_a_period_in_another_unit_is_doubted(case):
    volume, mesh, out = case
    nifti(volume, np.radians(field() % 360), AFFINE)
    run = beltrami("sample", volume, mesh, "-o", out, "--kind", "circular", "--period", "360")
    assert run.code == 0 and "is --period in their unit?" in run.message


def test_channels_frames_and_complex_numbers(case):
    volume, mesh, out = case
    expected = value(nib.load(mesh).darrays[0].data)
    nifti(volume, np.stack([field(), -field(), 2 * field()], -1), AFFINE)
    done("sample", volume, mesh, "-o", out, "--kind", "vector")
    assert np.abs(maps(out) - expected[:, None] * [1, -1, 2]).max() < 3e-3
    done("sample", volume, mesh, "-o", out.with_name("o.mgz"), "--kind", "vector")
    assert np.abs(load(out.with_name("o.mgz"))[:, 0, 0] - expected[:, None] * [1, -1, 2]).max() < 3e-3
    nifti(volume, (field() + 1j * field() ** 0).astype(np.complex64), AFFINE)
    done("sample", volume, mesh, "-o", out, "--kind", "vector", "--overwrite")
    assert np.abs(maps(out) - np.stack([expected, np.ones(66)], -1)).max() < 1e-3
    assert "one value per vertex" in refused("sample", volume, mesh, "-o", out.with_name("lh.o"), "--kind", "vector")


def test_numpy_arrays_have_the_spacing_that_is_given(case):
    _, _, out = case
    grid = np.indices(SHAPE).astype(np.float32)
    volume = npy(out.with_name("v.npy"), grid[0] + 10 * grid[1])
    mesh = surface(out.with_name("at.surf.gii"), ball_of_points()[0] - places().mean(0) + [10.5, 10.0, 9.75])
    done("sample", volume, mesh, "-o", out, "--spacing", "1.5")
    x, y, _ = nib.load(mesh).darrays[0].data.T / 1.5
    assert np.abs(maps(out)[:, 0] - x - 10 * y).max() < 1e-4


# --- FreeSurfer's own space ----------------------------------------------------------------------------------------


def tkr(points: np.ndarray) -> np.ndarray:
    """Scanner RAS to FreeSurfer's surface RAS of the volume: its middle at 0, columns, rows, slices to -x, -z, y."""
    index = np.linalg.solve(AFFINE[:3, :3], (points - AFFINE[:3, 3]).T).T - np.array(SHAPE) / 2
    return 1.5 * np.stack([-index[:, 0], index[:, 2], -index[:, 1]], -1)


def test_surfaces_in_tkr_are_carried_to_the_volume(case):
    volume, _, out = case
    points, cells = ball_of_points()
    mesh = out.with_name("lh.mid")
    nib.freesurfer.write_geometry(mesh, tkr(points).astype(np.float32), cells, create_stamp="made by hand")
    assert "--frame tkr" in refused("sample", volume, mesh, "-o", out)
    done("sample", volume, mesh, "-o", out, "--frame", "tkr")
    assert np.abs(maps(out)[:, 0] - value(points)).max() < 1e-3
    # Taken for scanner RAS it lies elsewhere.
    assert "--frame tkr" in refused("sample", volume, mesh, "-o", out, "--frame", "scanner", "--overwrite", code=1)


# --- refusals ------------------------------------------------------------------------------------------------------


def test_refusals_leave_no_trace(case):
    volume, mesh, out = case
    several = nifti(out.with_name("several.nii.gz"), np.stack([field(), field()], -1), AFFINE)
    plane = npy(out.with_name("plane.npy"), field()[:, :, 0])
    text = out.with_name("v.txt")
    text.write_text("1 2 3")
    metric = out.with_name("d.func.gii")
    nib.save(nib.gifti.GiftiImage(darrays=[nib.gifti.GiftiDataArray(np.zeros(66, np.float32))]), metric)
    before = contents(out.parent)
    for options, words in (
        ([plane, mesh, "-o", out], "plane.npy: is a plane; expected a volume"),
        ([several, mesh, "-o", out.with_name("lh.o"), "--kind", "vector"], f"{out.with_name('lh.o')}: FreeSurfer's"),
        ([several, mesh, "-o", out], "--kind vector"),
        ([volume, mesh, "-o", out, "--kind", "circular"], "period: missing"),
        ([volume, mesh, "-o", out, "--period", "360"], "belongs to the kind circular"),
        ([volume, mesh, "-o", out, "--missing", "inf"], "missing"),
        ([volume, mesh, "-o", out, "--structure", "nose"], "structure nose"),
        ([volume, mesh, "-o", out, "--frame", "moon"], "frame"),
        ([volume, mesh, "-o", out, "--spacing", "2"], "--spacing is for .npy only"),
        ([volume, mesh, "-o", out.with_name("o.txt")], "not a file of vertex data"),
        ([volume, mesh, "-o", out.with_name("o.nii.gz")], "vertex data is not written so"),
        ([volume, mesh, "-o", out.with_name("no") / "o.func.gii"], "does not exist"),
        ([volume, mesh, "-o", mesh], "own.surf.gii"),
        ([volume.with_name("no.nii"), mesh, "-o", out], "no such file"),
        ([volume, mesh.with_name("no.surf.gii"), "-o", out], "no such file"),
        ([volume, volume, "-o", out], "expected a surface"),
        ([mesh, volume, "-o", out], "own.surf.gii: is a surface; expected a volume: are the arguments swapped?"),
        ([metric, mesh, "-o", out], "d.func.gii: holds values at vertices; expected a volume"),
        ([out.parent, mesh, "-o", out], "is a folder; expected a file"),
        ([volume.with_name("no"), mesh, "-o", out], "no such file"),
        ([text, mesh, "-o", out], "not the suffix of a volume"),
        ([volume, mesh], "-o"),
    ):
        assert words in refused("sample", *options), options
        assert contents(out.parent) == before


def test_existing_outputs_need_overwrite(case):
    volume, mesh, out = case
    out.with_name("o.func.json").write_text("mine")
    before = contents(out.parent)
    assert "o.func.json: exists already" in refused("sample", volume, mesh, "-o", out)
    assert contents(out.parent) == before
    done("sample", volume, mesh, "-o", out, "--overwrite", "-q")
    assert record(out.with_name("o.func.json"))["Vertices"]["vertices"] == 66


def test_a_damaged_volume_is_told(case):
    volume, mesh, out = case
    volume.write_bytes(volume.read_bytes()[:200])
    assert "cannot be read as NIfTI" in refused("sample", volume, mesh, "-o", out, code=1)
    assert not out.exists()
