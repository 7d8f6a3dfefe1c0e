"""Colours that the colour-blind can tell apart, and scales that noise does not flatten."""

from __future__ import annotations

import numpy as np
import pytest
from skimage.color import deltaE_ciede2000, rgb2lab

from beltrami_cli.report.colours import MISSING, MISSING_SULCUS, Scale, difference_scale, scale_of
from beltrami_cli.report.subject import Map, Subject

SEQUENTIAL, ANGLES, DIFFERENCES = Scale(0, 1), Scale(0, 360, period=True), Scale(-1, 1, differences=True)

# What is seen without one kind of cone, in linear RGB: Machado, Oliveira and Fernandes 2009, severity 1.
VISION = {
    "full": np.eye(3),
    "protan": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deutan": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritan": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}


def seen(rgb: np.ndarray, vision: np.ndarray) -> np.ndarray:
    """(N, 3) CIELAB of sRGB colours from 0 to 1 as they look with this vision."""
    linear = np.where(rgb <= 0.04045, rgb / 12.92, ((rgb + 0.055) / 1.055) ** 2.4)
    linear = np.clip(linear @ vision.T, 0, 1)
    return rgb2lab(np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055))


@pytest.mark.parametrize("vision", VISION)
def test_angles_a_quarter_turn_apart_look_different(vision):
    lab = seen(ANGLES.table() / 255, VISION[vision])
    assert deltaE_ciede2000(lab, np.roll(lab, 64, 0)).min() > 25


@pytest.mark.parametrize("vision", VISION)
def test_more_of_a_value_is_always_lighter(vision):
    lightness = seen(SEQUENTIAL.table() / 255, VISION[vision])[:, 0]
    assert np.diff(lightness).min() > -0.1  # of 100: what 8 bits leave
    assert np.diff(lightness[::8]).min() > 1


@pytest.mark.parametrize("vision", VISION)
def test_the_ends_of_differences_look_different(vision):
    lab = seen(DIFFERENCES.table() / 255, VISION[vision])
    assert deltaE_ciede2000(lab[0], lab[-1]) > 35
    assert lab[128, 0] == pytest.approx(lab[:, 0].max(), abs=1)  # 0 is pale


@pytest.mark.parametrize("scale", [SEQUENTIAL, ANGLES, DIFFERENCES], ids=lambda scale: scale.name)
@pytest.mark.parametrize("vision", VISION)
def test_missing_is_no_colour_of_the_map(scale, vision):
    lab = seen(scale.table() / 255, VISION[vision])
    for grey in (MISSING, MISSING_SULCUS):
        assert deltaE_ciede2000(lab, seen(np.array([grey]), VISION[vision])).min() > 5


def test_rgba():
    found = SEQUENTIAL.rgba(np.array([-5.0, 0.0, 1.0, 9.0, np.nan, np.inf]))
    assert found.shape == (6, 4) and (found[:, 3] == 1).all()
    assert np.array_equal(found[0], found[1]) and np.array_equal(found[2], found[3])
    assert found[1, :3] * 255 == pytest.approx([68, 1, 84])  # of viridis
    assert found[2, :3] * 255 == pytest.approx([253, 231, 37], abs=1)
    assert np.array_equal(found[4:, :3], [MISSING, MISSING])


def test_an_angle_has_one_colour_whatever_its_range():
    angles = np.array([0.0, 90.0, 180.0, 270.0])
    expected = ANGLES.rgba(angles)
    assert np.array_equal(ANGLES.rgba(angles + 360), expected)
    assert np.array_equal(Scale(-180, 180, period=True).rgba(angles - 360), expected)
    assert np.array_equal(Scale(0, 24, period=True).rgba(angles / 15), expected)


@pytest.mark.parametrize(
    ("before", "after", "expected"),
    [
        ([0.0, 100.0], [2.0, 4.0], (2.04, 3.96)),  # noise in the input does not flatten the result
        ([np.nan, 1.0, 9.0], [50.0, 2.0, 4.0], (2.04, 3.96)),  # nor does what was filled in
        ([1.0, 2.0], [3.0, 3.0], (1.02, 1.98)),
        ([7.0, 7.0], [7.0, 7.0], (3.5, 10.5)),
        ([np.nan], [np.nan], (0.0, 1.0)),
    ],
)
def test_the_scale_of_maps(before, after, expected):
    for shape in ({"values": np.array(before)}, {"values": None, "volume": np.array(before)[:, None, None]}):
        first = Map("a", **shape)
        last = Map("b", *(None if v is None else np.reshape(after, v.shape) for v in (first.values, first.volume)))
        scale = scale_of(Subject("s", (first, last)))
        assert (scale.low, scale.high) == pytest.approx(expected)
        assert not scale.period


def test_the_scale_of_angles_is_the_whole_period():
    one = Map("a", np.array([10.0, 20.0]))
    assert scale_of(Subject("s", (one,), period=24.0, low=-12.0)) == Scale(-12.0, 12.0, period=True)


def test_the_scale_of_what_was_removed_is_even_about_0():
    before, after = Map("a", np.array([0.0, 3.0, 350.0, np.nan])), Map("b", np.array([0.0, 0.0, 10.0, 1.0]))
    scale = difference_scale(Subject("s", (before, after), period=360.0, compares=True, difference="removed"))
    assert scale.differences and scale.low == -scale.high
    assert scale.high == pytest.approx(np.percentile([0, 3, 20], 98))
    assert difference_scale(Subject("s", (before, before), compares=True, difference="removed")).high == 1.0
