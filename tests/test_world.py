"""World space: one point has one value whichever format and orientation it was stored in, and doubts are told."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path

import nibabel as nib
import numpy as np
import pytest
import SimpleITK as sitk
from command import beltrami, done
from twins import SPACING_MM, TWINS

from beltrami_cli.formats import open_series, read_volume, write_volume
from beltrami_cli.grid import Grid, Volume

# --- the scene -----------------------------------------------------------------------------------------------------

SHAPE = (32, 28, 20)
STEPS_MM = np.array([1.0, 1.15, 1.6])
CENTRE_MM = np.array([4.3, -21.7, 33.1])
OBLIQUE = TWINS["oblique"].affine[:3, :3] / SPACING_MM


@dataclass(frozen=True)
class Twin:
    """The scene stored with its axes in another order and direction, or turned as a whole.

    order, flips: the scene's axes as they are stored, and those of them that run backwards. turn: of the world.
    """

    order: tuple[int, int, int] = (0, 1, 2)
    flips: tuple[int, ...] = ()
    turn: np.ndarray | None = None

    def stored(self, array: np.ndarray) -> Volume:
        data = np.flip(array.transpose(*self.order, *range(3, array.ndim)), self.flips)
        affine = GRID.affine[:, [*self.order, 3]]
        for axis in self.flips:
            affine[:, 3] += affine[:, axis] * (data.shape[axis] - 1)
            affine[:, axis] *= -1
        a, b, c = data.shape[:3]
        return Volume(np.ascontiguousarray(data), Grid((a, b, c), self.world @ affine))

    @property
    def world(self) -> np.ndarray:
        turned = np.eye(4)
        turned[:3, :3] = np.eye(3) if self.turn is None else self.turn
        return turned

    def moved(self, ras_mm: np.ndarray) -> np.ndarray:
        return ras_mm @ self.world[:3, :3].T


TWIN = {
    "RAS": Twin(),
    "LAS": Twin(flips=(0,)),
    "LPS": Twin(flips=(0, 1)),
    "PIR": Twin((1, 2, 0), (0, 1)),
    "oblique": Twin(turn=OBLIQUE),
    "oblique LSA": Twin((0, 2, 1), (0,), OBLIQUE),
}
FORMATS = (".nii.gz", ".mha", ".mgz")
STORAGE = [pytest.param(suffix, name, id=f"{name} {suffix}") for suffix in FORMATS for name in TWIN]
FEW = [*STORAGE[:: len(TWIN) + 1], STORAGE[-1]]  # every format, and orientations of each kind


def _grid() -> Grid:
    affine = np.diag([*STEPS_MM, 1.0])
    affine[:3, 3] = CENTRE_MM - STEPS_MM * (np.array(SHAPE) - 1) / 2 - [0.3, 0.1, 0.2]
    return Grid(SHAPE, affine)


GRID = _grid()
PLACES = GRID.to_world(np.indices(SHAPE).reshape(3, -1).T) - CENTRE_MM


def torus(x: np.ndarray) -> np.ndarray:
    return np.hypot(np.hypot(x[:, 0], x[:, 1]) - 8.5, x[:, 2]) - 4.5


def pattern(x: np.ndarray) -> np.ndarray:
    """Different along each axis, and no mirror image of itself."""
    return 40 + 25 * np.sin(0.3 * x[:, 0] + 0.1 * x[:, 1]) + 9 * np.cos(0.25 * x[:, 1] - 0.2 * x[:, 2]) + x[:, 2]


def over_grid(values: np.ndarray) -> np.ndarray:
    return values.reshape(SHAPE).astype(np.float32)


def noisy_map(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    values = pattern(PLACES) + 5 * rng.standard_normal(len(PLACES))
    values[np.linalg.norm(PLACES - [8.5, 0, 4.5], axis=1) < 3] = np.nan
    return over_grid(values)


@cache
def surface() -> tuple[np.ndarray, np.ndarray]:
    """Vertices (V, 3) in RAS mm and triangles of the torus: none on the grid, counter-clockwise from outside."""
    n, m = 60, 36
    u, v = np.meshgrid(2 * np.pi * np.arange(n) / n + 0.01, 2 * np.pi * np.arange(m) / m + 0.02, indexing="ij")
    ring = 8.5 + 4.5 * np.cos(v)
    points = np.stack([ring * np.cos(u), ring * np.sin(u), 4.5 * np.sin(v)], -1).reshape(-1, 3)
    i, j = np.indices((n, m)).reshape(2, -1)
    a, b, c, d = (i * m + j, (i + 1) % n * m + j, (i + 1) % n * m + (j + 1) % m, i * m + (j + 1) % m)
    return points + CENTRE_MM, np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)


def write_surface(path: Path, twin: Twin) -> Path:
    points, triangles = surface()
    arrays = [
        nib.gifti.GiftiDataArray(twin.moved(points).astype(np.float32), "NIFTI_INTENT_POINTSET"),
        nib.gifti.GiftiDataArray(triangles, "NIFTI_INTENT_TRIANGLE"),
    ]
    nib.save(nib.gifti.GiftiImage(darrays=arrays), path)
    return path


def stored(path: Path, twin: Twin, array: np.ndarray) -> Path:
    write_volume(path, twin.stored(array))
    return path


def at_vertices(path: Path) -> np.ndarray:
    """(V,) or (V, K) values of a .func.gii, read without the package."""
    values = np.stack([array.data for array in nib.load(path).darrays], -1)
    return values[:, 0] if values.shape[1] == 1 else values


def sampled(folder: Path, volume: Path, twin: Twin, *options: object) -> np.ndarray:
    mesh, out = write_surface(folder / "own.surf.gii", twin), folder / f"{volume.name.split('.')[0]}.func.gii"
    done("sample", volume, mesh, "-o", out, *options)
    return at_vertices(out)


def gap(a: np.ndarray, b: np.ndarray, full: float) -> float:
    """The largest difference as a share of the range; values must be missing at the same vertices."""
    assert np.array_equal(np.isnan(a), np.isnan(b))
    return float(np.nanmax(np.abs(a - b)) / full)


# --- the matrix of twins -------------------------------------------------------------------------------------------

DENOISE = ("--iterations", 5, "--beta", 0.1, "--no-mesh")


def denoised(folder: Path, suffix: str, twin: Twin) -> np.ndarray:
    psi = stored(folder / f"psi{suffix}", twin, over_grid(torus(PLACES)))
    data = stored(folder / f"data{suffix}", twin, noisy_map())
    done("denoise", psi, data, "-o", folder / f"out{suffix}", *DENOISE)
    return sampled(folder, folder / f"out{suffix}", twin)


@pytest.fixture(scope="module")
def denoised_ras(tmp_path_factory) -> np.ndarray:
    return denoised(tmp_path_factory.mktemp("ras"), ".nii.gz", TWIN["RAS"])


@pytest.mark.parametrize(("suffix", "name"), STORAGE)
def test_denoise_gives_one_result_whatever_the_storage(tmp_path, denoised_ras, suffix, name):
    got = denoised(tmp_path, suffix, TWIN[name])
    assert np.isfinite(got).all()
    assert gap(got, denoised_ras, np.ptp(denoised_ras)) <= 1e-4
    assert np.sqrt(np.mean((got - pattern(surface()[0] - CENTRE_MM)) ** 2)) < 3  # and it is the map, from noise of 5


def denoised_on_mesh(folder: Path, suffix: str, twin: Twin) -> tuple[np.ndarray, np.ndarray]:
    """At the vertices of a mesh in the level set's place: sampled from OUT, and as denoise writes them itself."""
    mesh, data = write_surface(folder / "own.surf.gii", twin), stored(folder / f"data{suffix}", twin, noisy_map())
    out, on = folder / f"out{suffix}", folder / "on.func.gii"
    done("denoise", mesh, data, "-o", out, "--on", f"{mesh}={on}", *DENOISE)
    return sampled(folder, out, twin), at_vertices(on)


@pytest.fixture(scope="module")
def on_mesh_ras(tmp_path_factory) -> tuple[np.ndarray, np.ndarray]:
    return denoised_on_mesh(tmp_path_factory.mktemp("mesh"), ".nii.gz", TWIN["RAS"])


@pytest.mark.parametrize(("suffix", "name"), FEW)
def test_a_mesh_as_level_set_gives_one_result_whatever_the_storage(tmp_path, on_mesh_ras, suffix, name):
    got = denoised_on_mesh(tmp_path, suffix, TWIN[name])
    for here, there in zip(got, on_mesh_ras, strict=True):
        assert np.isfinite(here).all() and gap(here, there, np.ptp(there)) <= 1e-4
    assert gap(*got, np.ptp(got[1])) < 0.02  # trilinear from OUT, and on the surface itself


def level_sets(folder: Path, suffix: str, twin: Twin) -> np.ndarray:
    """(2, nx, ny, nz) Psi in mm from the mesh and from a mask, with the scene's own axes."""
    inside = stored(folder / f"inside{suffix}", twin, over_grid(torus(PLACES) < 0))
    found = []
    for source in (write_surface(folder / "own.surf.gii", twin), inside):
        out = folder / f"psi_of_{source.name.split('.')[0]}{suffix}"
        done("levelset", source, "-o", out, "--like", inside)
        found.append(np.flip(read_volume(out).data, twin.flips).transpose(np.argsort(twin.order)))
    return np.stack(found)


@pytest.fixture(scope="module")
def level_sets_ras(tmp_path_factory) -> np.ndarray:
    return level_sets(tmp_path_factory.mktemp("psi"), ".nii.gz", TWIN["RAS"])


@pytest.mark.parametrize(("suffix", "name"), FEW)
def test_levelset_gives_one_result_whatever_the_storage(tmp_path, level_sets_ras, suffix, name):
    got, truth = level_sets(tmp_path, suffix, TWIN[name]), over_grid(torus(PLACES))
    near = np.abs(truth) < 2
    assert np.abs(got - level_sets_ras)[:, near].max() <= 1e-4 * np.ptp(truth[near])
    of_mesh, of_mask = np.abs(got - truth)[:, near]
    assert of_mesh.max() < 0.1 and np.percentile(of_mask, 95) < 0.35 * STEPS_MM.max()


@pytest.mark.parametrize(("suffix", "name"), STORAGE)
def test_sample_gives_one_result_whatever_the_storage(tmp_path, suffix, name):
    twin, clean = TWIN[name], over_grid(pattern(PLACES))
    got = sampled(tmp_path, stored(tmp_path / f"clean{suffix}", twin, clean), twin)
    truth = pattern(surface()[0] - CENTRE_MM)
    assert gap(got, truth, np.ptp(truth)) < 0.01  # of trilinear interpolation
    first = sampled(tmp_path, stored(tmp_path / "first.nii.gz", TWIN["RAS"], noisy_map()), TWIN["RAS"])
    other = sampled(tmp_path, stored(tmp_path / f"other{suffix}", twin, noisy_map()), twin)
    assert gap(other, first, np.nanmax(first) - np.nanmin(first)) <= 1e-5
    assert 0.01 < np.isnan(first).mean() < 0.1


@pytest.mark.parametrize(("suffix", "name"), FEW)
def test_kinds_of_value_have_one_result_whatever_the_storage(tmp_path, suffix, name):
    twin = TWIN[name]
    angle = 360 * (pattern(PLACES) / 50 % 1)
    frames = np.stack([noisy_map(0), noisy_map(1), over_grid(angle)], -1)

    def both(folder: Path, suffix: str, twin: Twin) -> tuple[np.ndarray, np.ndarray]:
        folder.mkdir()
        turning = stored(folder / f"angle{suffix}", twin, over_grid(angle))
        several = stored(folder / f"several{suffix}", twin, frames)
        return (
            sampled(folder, turning, twin, "--kind", "circular", "--period", 360),
            sampled(folder, several, twin, "--kind", "vector"),
        )

    turned, parts = both(tmp_path / "twin", suffix, twin)
    first_turned, first_parts = both(tmp_path / "ras", ".nii.gz", TWIN["RAS"])
    off = (turned - first_turned + 180) % 360 - 180
    assert np.abs(off).max() <= 1e-5 * 360
    truth = 360 * (pattern(surface()[0] - CENTRE_MM) / 50 % 1)
    assert np.abs((turned - truth + 180) % 360 - 180).max() < 8
    assert parts.shape == (len(truth), 3)
    assert gap(parts, first_parts, 360) <= 1e-5


# --- where a header leaves it in doubt -----------------------------------------------------------------------------


def two_forms(path: Path, sform: np.ndarray, qform: np.ndarray, codes: tuple[int, int] = (4, 1)) -> Path:
    image = nib.Nifti1Image(np.zeros((4, 5, 6), np.float32), None)
    image.header.set_qform(qform, codes[1])
    image.header.set_sform(sform, codes[0])
    image.header.set_xyzt_units("mm")
    # Not by nib.save, which would make the two agree.
    image.update_header = lambda: None
    path.write_bytes(image.header.binaryblock + b"\0" * 4 + np.zeros((4, 5, 6), np.float32).tobytes())
    return path


def test_forms_that_disagree_are_told_and_the_sform_is_used(tmp_path):
    sform, qform = np.diag([2.0, 2, 3, 1]), np.diag([-2.0, 2, 3, 1])
    qform[:3, 3] = 1, 2, 3
    path = two_forms(tmp_path / "v.nii", sform, qform)
    volume = read_volume(path)
    assert np.allclose(volume.grid.affine, sform)
    (line,) = volume.notes
    apart = np.linalg.norm([-2.0 * 3 * 2 + 1, 2, 3])  # at the far end of the flipped axis
    assert line == (
        f"{path}: sform (code 4, MNI) and qform (code 1, scanner) place its voxels up to {apart:.3g} mm apart: the "
        "sform is used"
    )
    assert open_series(path).notes == volume.notes
    assert volume.with_data(volume.data + 1).notes == volume.notes


@pytest.mark.parametrize("codes", [(1, 0), (0, 1)])
def test_one_form_alone_is_used_without_a_word(tmp_path, codes):
    sform, qform = np.diag([2.0, 2, 3, 1]), np.diag([-2.0, 2, 3, 1])
    volume = read_volume(two_forms(tmp_path / "v.nii", sform, qform, codes))
    assert np.allclose(volume.grid.affine, sform if codes[0] else qform)
    assert volume.notes == ()


@pytest.mark.parametrize("degrees", [0, 0.02, 0.3, 30, 179.5, 179.99, 180])
@pytest.mark.parametrize("axis", [0, 1, 2])
def test_rounding_of_the_quaternion_is_no_disagreement(tmp_path, degrees, axis):
    """Close to half a turn its first part, computed from the others, loses half of its digits."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    first, second = (axis + 1) % 3, (axis + 2) % 3
    affine = np.eye(4)
    affine[[first, first, second, second], [first, second, first, second]] = c, -s, s, c
    affine[:3, :3] *= 0.8
    affine[:3, 3] = -90, -126, -72
    image = nib.Nifti1Image(np.zeros((192, 224, 8), np.uint8), affine)
    image.set_qform(affine, 1)
    nib.save(image, tmp_path / "v.nii.gz")
    assert read_volume(tmp_path / "v.nii.gz").notes == ()


def test_forms_in_other_units_are_compared_in_mm(tmp_path):
    path = two_forms(tmp_path / "v.nii", np.diag([0.002, 0.002, 0.003, 1]), np.diag([0.002, 0.002, 0.003, 1]))
    content = bytearray(path.read_bytes())
    content[123] = 1  # metres
    path.write_bytes(content)
    volume = read_volume(path)
    assert volume.notes == () and np.allclose(volume.grid.spacing, [2, 2, 3])


def test_a_volume_without_forms_is_told(tmp_path):
    volume = read_volume(two_forms(tmp_path / "v.nii", np.eye(4), np.diag([2.0, 2, 3, 1]), (0, 0)))
    (line,) = volume.notes
    assert "sform and qform are both unset" in line and "LAS" in line
    assert np.allclose(volume.grid.affine, [[-2, 0, 0, 3], [0, 2, 0, -4], [0, 0, 3, -7.5], [0, 0, 0, 1]])


def test_a_qform_that_is_no_rotation_gives_way_to_the_sform(tmp_path):
    path = two_forms(tmp_path / "v.nii", np.diag([2.0, 2, 3, 1]), np.diag([2.0, 2, 3, 1]))
    content = bytearray(path.read_bytes())
    content[256:268] = np.array([2.0, 2, 2], "<f4").tobytes()  # quatern_b, c, d of more than unit length
    path.write_bytes(content)
    volume = read_volume(path)
    assert np.allclose(volume.grid.affine, np.diag([2.0, 2, 3, 1])) and volume.notes == ()


def test_sample_tells_of_forms_that_disagree(tmp_path):
    twin = TWIN["RAS"]
    path = stored(tmp_path / "v.nii", twin, noisy_map())
    content = bytearray(path.read_bytes())
    content[268:280] = np.array([1, 2, 3], "<f4").tobytes()  # qoffset_x, y, z
    path.write_bytes(content)
    mesh = write_surface(tmp_path / "own.surf.gii", twin)
    run = beltrami("sample", path, mesh, "-o", tmp_path / "o.func.gii")
    assert run.code == 0
    assert run.err.startswith(f"beltrami: warning: {path}: sform (code 1, scanner) and qform (code 1, scanner) place")


# --- MetaImage -----------------------------------------------------------------------------------------------------


def test_a_plane_of_metaimage_is_turned_in_lps(tmp_path):
    image = sitk.GetImageFromArray(np.arange(20, dtype=np.float32).reshape(5, 4))
    image.SetSpacing([0.5, 2.0])
    image.SetOrigin([1.0, 2.0])
    image.SetDirection([0.8, -0.6, 0.6, 0.8])
    sitk.WriteImage(image, str(tmp_path / "v.mha"))
    volume = read_volume(tmp_path / "v.mha")
    assert volume.file_shape == (4, 5)
    for i, j in [(0, 0), (3, 0), (1, 4)]:
        x, y = image.TransformIndexToPhysicalPoint((i, j))
        assert np.allclose(volume.grid.to_world(np.array([[i, j, 0.0]])), [[-x, -y, 0]], atol=1e-6)
        assert volume.data[i, j, 0] == image.GetPixel(i, j)


def test_oblique_metaimage_of_anisotropic_voxels(tmp_path):
    image = sitk.GetImageFromArray(np.zeros((4, 5, 6), np.float32))
    image.SetSpacing([0.5, 2.0, 1.25])
    image.SetOrigin([-7.0, 11.0, 3.0])
    image.SetDirection((OBLIQUE @ np.diag([1.0, -1, 1])).ravel().tolist())
    sitk.WriteImage(image, str(tmp_path / "v.mha"))
    grid = read_volume(tmp_path / "v.mha").grid
    x, y, z = image.TransformIndexToPhysicalPoint((5, 3, 2))
    assert np.allclose(grid.to_world(np.array([[5, 3, 2.0]])), [[-x, -y, z]], atol=1e-5)
    assert np.allclose(grid.spacing, [0.5, 2, 1.25])
    assert grid.handedness == -1


@pytest.mark.parametrize("channels", [1, 3])
def test_a_plane_away_from_z_0_keeps_its_place(tmp_path, channels):
    """Two axes cannot say where it is: it is written with three."""
    affine = np.array([[2.0, 0, 0, 5], [0, 0, 1, -30], [0, 3, 0, 7], [0, 0, 0, 1]])  # coronal
    values = np.arange(20.0 * channels).reshape((4, 5, 1, channels)[: 3 if channels == 1 else 4])
    file_shape = (4, 5) if channels == 1 else (4, 5, channels)
    write_volume(tmp_path / "v.mha", Volume(values, Grid((4, 5, 1), affine), file_shape))
    back = read_volume(tmp_path / "v.mha", channels=True)
    assert np.allclose(back.grid.affine, affine)
    assert np.array_equal(back.data, values.astype(np.float32))
