"""Colours of values on a mesh, for viewers that know no scalars."""

from __future__ import annotations

import numpy as np

# Viridis at 16 equal steps, RGB 0..255: perceptually uniform, and readable without colour vision.
_VIRIDIS = np.array(
    [
        (68, 1, 84), (72, 26, 108), (71, 47, 125), (65, 68, 135), (57, 86, 140), (49, 104, 142),
        (42, 120, 142), (35, 136, 142), (31, 152, 139), (34, 168, 132), (53, 183, 121), (84, 197, 104),
        (122, 209, 81), (165, 219, 54), (210, 226, 27), (253, 231, 37),
    ]
)  # fmt: skip
_MISSING = 128  # mid grey: no colour of the map

# A few outliers must not take the whole scale.
_PERCENTILES = (2.0, 98.0)


def rgb(values: np.ndarray) -> np.ndarray:
    """(V, 3) uint8 colours of values (V,) or (V, K); grey where they are not finite.

    Three channels whose means lie from 1 to 255 are colours already; what noise has driven out of 0 to 255 is clipped.
    Of other channels the magnitude is shown. A single value runs through the map from its 2nd to its 98th percentile.
    """
    if values.ndim == 1:
        return _mapped(values)
    known = np.isfinite(values).all(1)
    means = values[known].mean(0, dtype=float) if known.any() else np.zeros(values.shape[1])
    if len(means) == 3 and means.min() >= 1 and means.max() <= 255:
        colours = np.full(values.shape, _MISSING, np.uint8)
        colours[known] = np.rint(np.clip(values[known], 0, 255))
        return colours
    return _mapped(np.linalg.norm(values, axis=1))


def _mapped(values: np.ndarray) -> np.ndarray:
    colours = np.full((len(values), 3), _MISSING, np.uint8)
    finite = np.isfinite(values)
    if not finite.any():
        return colours
    low, high = np.percentile(values[finite], _PERCENTILES)
    position = (values[finite] - low) / (high - low) if high > low else np.full(finite.sum(), 0.5)
    steps = np.linspace(0.0, 1.0, len(_VIRIDIS))
    for channel in range(3):
        colours[finite, channel] = np.rint(np.interp(position, steps, _VIRIDIS[:, channel]))
    return colours
