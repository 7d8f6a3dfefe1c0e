"""Phantoms: level sets that are distances, clean values constant along normals, noise of the stated size."""

import numpy as np
import pytest
from command import done, refused
from scipy.ndimage import map_coordinates

from beltrami_cli import phantoms
from beltrami_cli.errors import RefusedError
from beltrami_cli.formats import read_volume
from beltrami_cli.levelset import zero_surface
from beltrami_cli.surface import edge_counts, edges_of

DISTANCES = ["torus", "sphere", "plane", "curve", "portrait"]
ADDITIVE = [*DISTANCES, "sulcus"]


@pytest.mark.parametrize("name", ADDITIVE)
def test_arrays_share_a_grid_and_noise_has_its_size(name):
    phantom = phantoms.make(name, noise=7.0, seed=3)
    shape = phantom.clean.shape
    assert phantom.levelset.shape == phantom.noisy.shape == shape
    assert phantom.grid.shape == (*shape, 1)[:3]
    assert {a.dtype for a in (phantom.levelset, phantom.clean, phantom.noisy)} == {np.dtype("float32")}
    assert np.all(phantom.grid.spacing == 1.0)
    noise = (phantom.noisy - phantom.clean).astype(float)
    assert abs(noise.std() - 7.0) < 7.0 * 3 / np.sqrt(2 * noise.size)
    assert phantom.clean.min() >= 0 and phantom.clean.max() <= 255
    assert phantom.levelset.min() < 0 < phantom.levelset.max()


@pytest.mark.parametrize("name", phantoms.PHANTOMS)
def test_seed_decides_the_noise(name):
    first, again, other = (phantoms.make(name, size=24, seed=seed) for seed in (1, 1, 2))
    assert np.array_equal(first.noisy, again.noisy, equal_nan=True)
    assert not np.array_equal(first.noisy, other.noisy, equal_nan=True)
    assert np.array_equal(first.clean, other.clean, equal_nan=True)


@pytest.mark.parametrize("name", DISTANCES)
def test_level_set_is_a_signed_distance_negative_inside(name):
    psi = phantoms.make(name).levelset.astype(float)
    slope = np.sqrt(sum(d**2 for d in np.gradient(psi)))
    band = np.abs(psi) < 3
    # Central differences of an exact distance fall short by the curvature squared: at most 1 % at 8 voxels' radius.
    assert slope[band].min() > 0.985 and slope[band].max() < 1.001
    if name != "plane":
        assert psi[(0,) * psi.ndim] > 0


@pytest.mark.parametrize("name", ["torus", "sphere", "plane", "curve", "portrait"])
def test_clean_values_are_constant_along_normals(name):
    options = {"map": "smooth"} if name == "torus" else {}
    phantom = phantoms.make(name, **options)
    psi, clean = phantom.levelset.astype(float), phantom.clean.astype(float)
    x = np.argwhere(np.abs(psi) < 2.5).T
    normal = np.array(np.gradient(psi))[(slice(None), *x)]
    inner = np.all((x > 4) & (x < psi.shape[0] - 5), axis=0)
    at_surface = map_coordinates(clean, (x - psi[tuple(x)] * normal)[:, inner], order=1)
    gap = np.abs(at_surface - clean[tuple(x)][inner])
    # Voxels beside an edge of the data interpolate across it: half of all are compared.
    assert np.median(gap) < 1.0


def test_torus_has_the_stated_radii_and_surface():
    phantom = phantoms.torus()
    surface = np.count_nonzero(np.abs(phantom.levelset) < 0.5)
    assert abs(surface - 4 * np.pi**2 * 18 * 8) < 60
    centre = 31.5 - phantoms.OFF_GRID
    assert phantom.levelset[57, 40, 35] == pytest.approx(
        np.hypot(np.hypot(57 - centre, 40 - centre) - 18, 35 - centre) - 8, abs=1e-5
    )
    assert abs(np.count_nonzero(np.abs(phantoms.torus(95).levelset) < 0.5) - 12_500) < 100


def test_torus_maps_take_the_values_of_their_formulas():
    centre = 31.5 - phantoms.OFF_GRID
    x, y, z = 50 - centre, 45 - centre, 36 - centre
    theta, phi = np.arctan2(y, x), np.arctan2(z, np.hypot(x, y) - 18)
    mixed, pieces, smooth = (float(phantoms.torus(map=m).clean[50, 45, 36]) for m in ("mixed", "pieces", "smooth"))
    assert np.sin(2 * theta) > 0 and mixed == pytest.approx(90 + 50 * np.cos(2 * phi), abs=1e-4)
    assert pieces == (200 if np.sin(3 * theta) * np.sin(2 * phi) > 0 else 60)
    assert smooth == pytest.approx(128 + 60 * np.sin(2 * theta) + 40 * np.cos(3 * phi), abs=1e-4)
    assert set(np.unique(phantoms.torus(map="pieces").clean)) == {60, 200}


def test_sphere_pattern_is_a_harmonic_about_its_axis():
    phantom = phantoms.sphere()
    # A harmonic has mean 0 over the sphere; a thick shell evens out where the voxels happen to lie.
    assert phantom.clean[np.abs(phantom.levelset) < 4].mean() == pytest.approx(85, abs=0.5)
    centre = 23.5 - phantoms.OFF_GRID
    pole = np.round(centre + 16 * np.array([1, 2, 2]) / 3).astype(int)
    assert abs(phantom.levelset[tuple(pole)]) < 1 and phantom.clean[tuple(pole)] > 250


def test_curve_jumps_where_it_says():
    phantom = phantoms.curve(noise=0)
    assert phantom.clean.shape == (128, 128)
    assert np.array_equal(phantom.clean, phantom.noisy)
    x = np.indices((128, 128)) - (63.5 - phantoms.OFF_GRID)
    # On the curve, where it is farthest from the centre, at t = 0 and 2 pi/3.
    for t, value in ((0.0, 128.0), (2 * np.pi / 3, 128 + 45 * np.sin(4 * np.pi / 3) + 60)):
        point = 0.3 * 128 * 1.18 * np.array([np.cos(t), np.sin(t)])
        nearest = np.unravel_index(np.hypot(*(x - point[:, None, None])).argmin(), (128, 128))
        assert abs(phantom.levelset[nearest]) < 0.75
        assert phantom.clean[nearest] == pytest.approx(value, abs=3.0)


def test_portrait_at_140_has_the_voxels_of_the_paper():
    phantom = phantoms.portrait(32)
    assert 140**3 == 2_744_000
    front, back = phantom.clean[:, -1, :], phantom.clean[:, 0, :]
    # The mirror image on the back: one picture, seen through (the centre's offset moves it a little).
    assert np.corrcoef(front[4:-4, 4:-4].ravel(), back[4:-4, 4:-4].ravel())[0, 1] > 0.95
    assert phantom.clean[np.abs(phantom.levelset) < 0.5].std() > 40


@pytest.mark.parametrize("gap", [1.5, 3.0])
@pytest.mark.parametrize("direction", [(0.9, -0.5, 0.4), (1, 1, 1)])
def test_sulcus_has_two_banks_at_the_gap(gap, direction):
    phantom = phantoms.sulcus(gap=gap, direction=direction)
    x = np.indices((48, 48, 48)) - 23.5
    axis = np.array(direction) / np.linalg.norm(direction)
    s = np.tensordot(axis, x, 1) + 1.4 * np.sin(x[1] / 6.5 + 0.3) * np.cos(x[2] / 7.5)
    assert np.allclose(phantom.levelset, gap / 2 - np.abs(s), atol=1e-5)
    assert np.all(phantom.clean[s > 0] == 100) and np.all(phantom.clean[s < 0] == 0)
    assert np.count_nonzero(phantom.levelset > 0) == pytest.approx(gap * 48**2 / axis.max(), rel=0.35)


@pytest.fixture(scope="module")
def cortex():
    return phantoms.cortex()


def turn(a, b):
    """Degrees from b to a, the shorter way round."""
    return (a.astype(float) - b + 180) % 360 - 180


def test_cortex_is_one_folded_sphere_at_a_signed_distance(cortex):
    psi = cortex.levelset
    surface = zero_surface(psi, np.ones(3))
    edges = len(edges_of(surface.cells))
    assert (edge_counts(surface.cells)[1] == 2).all()
    assert len(surface.points) - edges + len(surface.cells) == 2 and len(np.unique(surface.piece)) == 1
    corners = surface.points[surface.cells]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum() / 2
    # The lobe's ellipsoid has 8,000 mm^2.
    assert 13_000 < area < 20_000
    slope = np.sqrt(sum(d**2 for d in np.gradient(psi.astype(float))))
    assert np.median(np.abs(slope - 1)[np.abs(psi) < 3]) < 0.02
    assert np.abs(psi).max() == 6
    low, high = cortex.grid.affine[:3, 3], cortex.grid.affine[:3, 3] + 71
    assert high[0] < 0 and high[1] < 0 and low[2] < 0 < high[2]


def test_cortex_has_sulci_of_a_few_voxels(cortex):
    """What a ball of 4 voxels cannot enter from outside lies within the sulci."""
    from scipy.ndimage import binary_closing, distance_transform_edt

    inside = cortex.levelset < 0
    x = np.indices((9, 9, 9)) - 4
    closed = binary_closing(np.pad(inside, 8), (x**2).sum(0) <= 16)[8:-8, 8:-8, 8:-8]
    within = closed & ~inside
    assert within.sum() > 0.15 * inside.sum()
    depth = distance_transform_edt(closed)[within]
    assert 6 < depth.max() < 12
    # From the middle of a sulcus it is half its width to the nearest wall.
    assert 1.0 < np.percentile(cortex.levelset[within], 90) < 2.5


def test_cortex_map_is_that_of_a_left_hemisphere(cortex):
    clean = cortex.clean
    known = np.isfinite(clean)
    assert np.abs(turn(clean[known], 0)).max() <= 90 and clean[known].min() >= 0 and clean[known].max() < 360
    assert np.all(np.abs(cortex.levelset[known]) < 4)
    # Over 2,000 mm^2 of surface; the upper field lies mostly below the lower one.
    assert np.count_nonzero(known & (np.abs(cortex.levelset) < 0.5)) > 2000
    first = known.copy()
    first[np.argwhere(known)[:, 0].mean().astype(int) :] = False  # the cluster nearer to the pole
    z = np.argwhere(first)[:, 2]
    assert z[clean[first] > 180].mean() > z[clean[first] < 180].mean() + 8


def test_cortex_fields_mirror_each_other_and_jump_at_one_border(cortex):
    folded = np.rad2deg(np.arccos(np.cos(np.deg2rad(phantoms._polar_angle(0.0, np.linspace(0, 25, 26))))))
    assert np.abs(folded[[0, 11, 18, 25]] - [0, 90, 0, 90]).max() < 1e-9
    assert phantoms._polar_angle(0.0, -5.5) == 45 and phantoms._polar_angle(0.0, 5.5) == -45
    assert phantoms._polar_angle(16.0, -5.5) == -45
    near = np.abs(cortex.levelset) < 0.5
    steps = np.abs(turn(cortex.clean[1:], cortex.clean[:-1]))[near[1:] & near[:-1]]
    steps = steps[np.isfinite(steps)]
    # A map with a border, not a patchwork: slopes of about 10 degrees per mm but for a few percent.
    assert np.median(steps) < 8 and 0.01 < np.mean(steps > 60) < 0.06


def test_cortex_clean_values_are_constant_along_normals(cortex):
    psi, clean = cortex.levelset.astype(float), cortex.clean
    x = np.argwhere((np.abs(psi) < 2) & np.isfinite(clean)).T
    normal = np.array(np.gradient(psi))[(slice(None), *x)]
    foot = np.round(x - psi[tuple(x)] * normal / np.linalg.norm(normal, axis=0)).astype(int)
    gap = np.abs(turn(clean[tuple(foot)], clean[tuple(x)]))
    # The voxel nearest to the foot is up to 0.9 mm away, in a map of about 10 degrees per mm.
    assert np.nanmedian(gap) < 4 and np.nanpercentile(gap, 90) < 12


def test_cortex_noise_is_that_of_a_complex_signal(cortex):
    error = turn(cortex.noisy, cortex.clean)
    error = error[np.isfinite(error)]
    n = np.random.default_rng(5).standard_normal((2, 200_000))
    expected = np.abs(np.rad2deg(np.arctan2(0.6 * n[0], 1 + 0.6 * n[1]))).mean()
    assert abs(np.abs(error).mean() - expected) < 0.8 and abs(error.mean()) < 1
    quiet = phantoms.cortex(24, noise=0.0)
    there = np.isfinite(quiet.noisy)
    assert np.abs(turn(quiet.noisy[there], quiet.clean[there])).max() < 1e-3


def test_cortex_has_holes_in_the_noisy_map_only(cortex):
    from scipy.ndimage import label

    missing = np.isfinite(cortex.clean) & np.isnan(cortex.noisy)
    assert not np.any(np.isnan(cortex.clean) & np.isfinite(cortex.noisy))
    assert 0.05 < missing.sum() / np.isfinite(cortex.clean).sum() < 0.15
    parts = label(missing, np.ones((3, 3, 3)))[0]
    sizes = np.bincount(parts.ravel())[1:]
    assert np.count_nonzero(sizes > 60) in (5, 6, 7), sizes


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: phantoms.make("cube"), "found 'cube', expected one of torus, sphere"),
        (lambda: phantoms.make("torus", map="plaid"), "found 'plaid', expected mixed"),
        (lambda: phantoms.make("sphere", size=3), "found 3, expected 16 to 512"),
        (lambda: phantoms.make("sphere", size=4096), "found 4096, expected 16 to 512"),
        (lambda: phantoms.make("plane", size=16, noise=-1), "found -1"),
        (lambda: phantoms.make("plane", size=16, noise=float("nan")), "found nan"),
        (lambda: phantoms.make("plane", size=16, seed=-1), "found -1"),
        (lambda: phantoms.cortex(24, noise=-1), "found -1"),
        (lambda: phantoms.cortex(8), "found 8, expected 16 to 512"),
        (lambda: phantoms.sulcus(gap=0), "found 0, expected a width"),
    ],
)
def test_values_out_of_range_are_refused(call, message):
    with pytest.raises(RefusedError, match=message):
        call()


def test_volumes_remember_the_shape_of_the_arrays():
    volumes = phantoms.curve(32).volumes()
    assert list(volumes) == ["levelset", "clean", "noisy"]
    assert all(v.data.shape == (32, 32, 1) and v.file_shape == (32, 32) for v in volumes.values())


def test_portrait_in_colours():
    grey, rgb = phantoms.portrait(24, noise=10), phantoms.portrait(24, noise=10, map="rgb")
    assert np.array_equal(grey.levelset, rgb.levelset)
    assert rgb.clean.shape == rgb.noisy.shape == (24, 24, 24, 3)
    # Luminance by the weights of the sRGB primaries is how the grey picture was made.
    assert np.abs(rgb.clean @ [0.2125, 0.7154, 0.0721] - grey.clean).max() < 0.01
    assert np.std(rgb.noisy - rgb.clean, axis=(0, 1, 2)) == pytest.approx([10] * 3, rel=0.03)
    assert [v.channels for v in rgb.volumes().values()] == [1, 3, 3]
    with pytest.raises(RefusedError, match="expected grey or rgb"):
        phantoms.portrait(24, map="mixed")


def test_command_writes_colours(tmp_path):
    done("phantom", "portrait", tmp_path, "--size", "16", "--map", "rgb")
    assert read_volume(tmp_path / "noisy.nii.gz", channels=True).data.shape == (16, 16, 16, 3)
    assert "belongs to the phantom torus" in refused("phantom", "portrait", tmp_path / "x", "--map", "pieces")


def test_command_writes_the_cortex_where_it_lies(tmp_path):
    done("phantom", "cortex", tmp_path, "--size", "24", "--noise", "0.3")
    noisy = read_volume(tmp_path / "noisy.nii.gz")
    assert noisy.grid.affine[:3, 3].tolist() == [-24, -24, -12]
    assert np.nanmax(noisy.data) < 360 and 100 < np.isfinite(noisy.data).sum() < 3000
