"""`from beltrami_cli import denoise`: arrays in, arrays out, the same numbers as the command."""

from __future__ import annotations

import json

import numba
import numpy as np
import pytest
from command import ball, done, load, nifti, noisy, npy, record

import beltrami_cli
from beltrami_cli import Result, denoise
from beltrami_cli.errors import BeltramiError, DataError, RefusedError


def test_same_numbers_as_the_command(tmp_path):
    affine = np.diag([-0.75, 1.25, 1.0, 1.0])  # held exactly by float32, as NIfTI keeps it
    volumes = [nifti(tmp_path / f"{n}.nii.gz", a, affine) for n, a in (("psi", ball()), ("data", noisy()))]
    done("denoise", *volumes, "-o", tmp_path / "o.nii.gz", "--beta", "0.1", "--flow", "beltrami", "--fwhm", "2")
    result = denoise(ball(), noisy(), affine=affine, beta=0.1, fwhm=2)
    assert np.nanmax(np.abs(result.data - load(tmp_path / "o.nii.gz"))) < 1e-5 * np.ptp(noisy())
    written = record(tmp_path / "o.json")
    for name in ("Parameters", "Band", "Iterations", "StopReason"):
        of_arrays = json.loads(json.dumps(result.record[name]))
        assert {**written[name], **of_arrays} == written[name] if name == "Parameters" else of_arrays == written[name]


def test_result():
    result = denoise(ball(), noisy())
    assert isinstance(result, Result)
    assert (result.data.shape, result.data.dtype) == ((16, 16, 16), np.float32)
    assert result.warnings == ()
    mesh = result.mesh
    assert mesh is not None and mesh.values is not None
    assert mesh.vertices_ras_mm.shape == (486, 3)
    assert mesh.cells.shape[1] == 3
    assert mesh.values.shape == (486,)
    assert np.abs(np.linalg.norm(mesh.vertices_ras_mm - 7.637, axis=1) - 5).max() < 0.02
    json.dumps(result.record, allow_nan=False)


def test_plane_and_flat():
    result = denoise(ball((40, 40), 12.0), noisy((40, 40)), spacing=(2.0, 2.0))
    assert result.data.shape == (40, 40)
    assert result.mesh is not None
    assert result.mesh.cells.shape[1] == 2
    flat = denoise(None, noisy((40, 40)), flat=True)
    assert flat.mesh is None
    assert np.isfinite(flat.data).all()
    assert flat.data.std() < 0.3 * noisy((40, 40)).std()


@pytest.mark.parametrize(
    "twin",
    [
        lambda array: array.tolist(),
        np.asfortranarray,
        lambda array: array.astype(np.float64),
        lambda array: np.repeat(array, 2, axis=2)[:, :, ::2],
        lambda array: array.byteswap().view(array.dtype.newbyteorder()),
    ],
    ids=["list", "Fortran", "double", "strided", "byte order"],
)
def test_layout_does_not_matter(twin):
    assert np.array_equal(denoise(twin(ball()), twin(noisy())).data, denoise(ball(), noisy()).data, equal_nan=True)


def test_inputs_are_not_touched():
    psi, data = ball(), noisy()
    data[3] = np.nan
    copies = psi.copy(), data.copy()
    psi.flags.writeable = data.flags.writeable = False
    denoise(psi, data, outside="keep", precision="float32")
    denoise(None, data, flat=True)
    assert np.array_equal(psi, copies[0])
    assert np.array_equal(data, copies[1], equal_nan=True)


def test_observer_sees_every_iteration():
    told = []
    result = denoise(ball(), noisy(), iterations=7, observer=lambda *call: told.append(call))
    assert [call[:2] for call in told] == [(k, 7) for k in range(1, 8)]
    assert result.record["PerIteration"]["change_rms"] == pytest.approx([call[2] for call in told], rel=1e-5)


def test_warnings_are_handed_back():
    (line,) = denoise(ball((32, 32), 10.0) < 0, noisy((32, 32)), beta=0.1).warnings
    assert "two values only" in line


def test_spacing_is_an_affine_on_the_diagonal():
    affine = np.diag([1.0, 1.2, 1.5, 1.0])
    by_affine, by_spacing = denoise(ball(), noisy(), affine=affine), denoise(ball(), noisy(), spacing=(1.0, 1.2, 1.5))
    assert np.array_equal(by_affine.data, by_spacing.data, equal_nan=True)
    assert by_affine.record["Grid"] == by_spacing.record["Grid"]


@pytest.mark.parametrize(
    "levelset, data, options, error, word",
    [
        (ball(), noisy()[1:], {}, RefusedError, "one shape"),
        (ball()[0, 0], noisy()[0, 0], {}, RefusedError, "2 or 3 axes"),
        (ball()[..., None], noisy()[..., None], {}, RefusedError, "2 or 3 axes"),
        (None, noisy(), {}, RefusedError, "flat=True"),
        (ball(), noisy(), {"flat": True}, RefusedError, "None"),
        (ball(), noisy() + 1j, {}, RefusedError, "real numbers"),
        (ball(), noisy().astype(str), {}, RefusedError, "real numbers"),
        (ball(), noisy(), {"betta": 1}, RefusedError, "'betta'"),
        (ball(), noisy(), {"beta": "much"}, RefusedError, "'much'"),
        (ball(), noisy(), {"dt": 1.0}, RefusedError, "0.166667"),
        (ball(), noisy(), {"affine": np.eye(4), "spacing": 1.0}, RefusedError, "one of them"),
        (ball(), noisy(), {"affine": np.eye(4) + np.eye(4, k=1) * 0.3}, RefusedError, "not orthogonal"),
        (ball() + 99, noisy(), {}, DataError, "no zero level"),
        (ball(), np.full((16, 16, 16), np.nan), {}, DataError, "no valid value"),
    ],
)
def test_errors(levelset, data, options, error, word):
    with pytest.raises(error, match=word):
        denoise(levelset, data, **options)


PLACES = [
    {"spacing": 0.0}, {"spacing": -1.0}, {"spacing": np.nan}, {"spacing": (1.0, 2.0, 3.0, 4.0)}, {"spacing": "wide"},
    {"affine": np.eye(3)}, {"affine": np.zeros((4, 4))}, {"affine": np.full((4, 4), np.nan)},
]  # fmt: skip


@pytest.mark.parametrize("place", PLACES, ids=lambda place: f"{place}".replace("\n", ""))
def test_places_that_cannot_be(place):
    with pytest.raises(BeltramiError):
        denoise(ball(), noisy(), **place)


def test_masked_values_are_missing():
    values = noisy()
    hidden = values > 60
    masked = np.ma.masked_array(np.where(hidden, 1e6, values), hidden)
    expected = denoise(ball(), np.where(hidden, np.nan, values))
    assert np.array_equal(denoise(ball(), masked).data, expected.data, equal_nan=True)


@pytest.mark.parametrize("options", [{}, {"independent": True}])
@pytest.mark.parametrize("levelset", [ball((40, 40), 12.0), ball(), None], ids=["plane", "volume", "flat"])
def test_shapes_of_channels(levelset, options):
    shape = (40, 40) if levelset is None else levelset.shape
    data = np.stack([noisy(shape), noisy(shape, seed=1), noisy(shape, seed=2)], -1)
    result = denoise(levelset, data, kind="vector", flat=levelset is None, beta=0.1, **options)
    assert result.data.shape == data.shape and result.filled.shape == shape
    if levelset is not None:
        assert result.mesh is not None and result.mesh.values is not None
        assert result.mesh.values.shape == (len(result.mesh.vertices_ras_mm), 3)
    json.dumps(result.record, allow_nan=False)


@pytest.mark.parametrize("shape, radius", [((16, 16, 16), 5.0), ((40, 40), 12.0)])
def test_weights_and_masks_of_any_layout(shape, radius):
    psi, data, weights = ball(shape, radius), noisy(shape), np.abs(noisy(shape, 0, 1, seed=1))
    mask = noisy(shape, seed=2) > 40
    expected = denoise(psi, data, weights=weights, mask=mask, beta=0.1)
    assert expected.filled.shape == shape
    hidden = np.ma.masked_array(np.where(mask, weights, 99), ~mask)
    for options in (
        {"weights": weights.tolist(), "mask": mask.astype(np.uint8)},
        {"weights": np.asfortranarray(weights, np.float64), "mask": np.where(mask, 7.0, np.nan)},
        {"weights": np.where(mask, weights, np.nan)},
        {"weights": hidden},
    ):
        assert np.array_equal(denoise(psi, data, beta=0.1, **options).data, expected.data, equal_nan=True)


def test_weights_are_not_touched():
    weights, mask = np.abs(noisy()), noisy() > 40
    weights[3] = -1e-5
    copies = weights.copy(), mask.copy()
    weights.flags.writeable = mask.flags.writeable = False
    denoise(ball(), noisy(), weights=weights, mask=mask, beta=0.1)
    assert np.array_equal(weights, copies[0]) and np.array_equal(mask, copies[1])


def test_threads_stay_the_callers_own():
    before = numba.get_num_threads()
    denoise(ball(), noisy(), threads=1, beta=0.1)
    with pytest.raises(DataError):
        denoise(ball(), noisy(), threads=1, mask=np.zeros(ball().shape))
    assert numba.get_num_threads() == before


def test_package_names():
    assert set(beltrami_cli.__all__) == {"Mesh", "Result", "__version__", "denoise"}
    with pytest.raises(AttributeError, match="no attribute 'smooth'"):
        beltrami_cli.smooth  # noqa: B018


def test_command_and_array_agree_on_bare_arrays(tmp_path):
    psi, data = npy(tmp_path / "psi.npy", ball()), npy(tmp_path / "data.npy", noisy())
    options = ("--precision", "float64", "--scheme", "paper", "--iterations", "5")
    done("denoise", psi, data, "-o", tmp_path / "o.npy", *options)
    result = denoise(ball(), noisy(), precision="float64", scheme="paper", iterations=5)
    assert np.array_equal(load(tmp_path / "o.npy"), result.data, equal_nan=True)
