"""Colours that are even to the eye, and that stay apart without full colour vision."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beltrami_cli.errors import RefusedError
from beltrami_cli.report.subject import Map, Subject

PERCENTILES = (2.0, 98.0)  # a few outliers must not take the whole colour scale

# Greys that no map contains: viridis comes near the middle ones for eyes without red or green cones. Without data,
# sulci are a little darker than gyri.
MISSING = (0.74, 0.74, 0.74)
MISSING_SULCUS = (0.64, 0.64, 0.64)
# Of the inner side of a surface that is cut open.
INNER = (0.88, 0.88, 0.88)
# Around places that were filled in: no colour of a map. Inside, so much of their colour gives way to grey.
FILLED = "#d6006c"
FADING = 0.45


@dataclass(frozen=True)
class Scale:
    """Which value has which colour.

    low, high: data units, the values of the map's ends; what lies beyond them has the end's colour. period: of angles,
    which wrap round from high to low. differences: low = -high, and 0 is pale. map: the name of a colour map in
    matplotlib, or in colorcet where it begins with cet_; None for the default.
    """

    low: float
    high: float
    period: bool = False
    differences: bool = False
    map: str | None = None

    @property
    def name(self) -> str:
        """The map's name."""
        if self.map is not None:
            return self.map
        if self.period:
            return "cet_CET_CBC1"
        return "cet_CET_CBD1" if self.differences else "viridis"

    def table(self) -> np.ndarray:
        """(256, 3) uint8 colours from low to high. An angle has the same one whatever the range of angles."""
        colours = _map_of(self.name)
        return np.roll(colours, -round(256 * self.low / (self.high - self.low)), axis=0) if self.period else colours

    def rgba(self, values: np.ndarray) -> np.ndarray:
        """(N, 4) colours of values (N,), from 0 to 1; MISSING where they are not finite."""
        values = np.asarray(values, float)
        known = np.isfinite(values)
        # Halves, whose differences are finite whatever the values.
        low, high = self.low / 2, self.high / 2
        share = (np.where(known, values / 2, low) - low) / (high - low)
        steps = np.floor((share % 1 if self.period else np.clip(share, 0, 1)) * 256)
        colours = np.ones((len(values), 4))
        colours[:, :3] = np.where(
            known[:, None], self.table()[np.minimum(steps, 255).astype(int)] / 255, np.array(MISSING)
        )
        return colours


def faded(colours: np.ndarray, filled: np.ndarray | None) -> np.ndarray:
    """Colours (N, 4), those of filled places (N,) paler: they follow from others, and are not data."""
    if filled is None:
        return colours
    out = colours.copy()
    out[filled, :3] = FADING * np.array(MISSING) + (1 - FADING) * out[filled, :3]
    return out


def require_map(name: str) -> None:
    """Raise RefusedError unless there is a colour map of that name."""
    try:
        _map_of(name)
    except (AttributeError, KeyError, ValueError):
        raise RefusedError(
            f"colours: found {name!r}; expected the name of a colour map of matplotlib (gray, cividis ...), or "
            "cet_NAME of colorcet"
        ) from None


def _map_of(name: str) -> np.ndarray:
    """(256, 3) uint8; raises KeyError or AttributeError where there is none of that name."""
    import colorcet
    from matplotlib import colormaps
    from matplotlib.colors import ListedColormap

    found = ListedColormap(getattr(colorcet, name[4:])) if name.startswith("cet_") else colormaps[name]
    return np.asarray(found(np.linspace(0, 1, 256), bytes=True)[:, :3])


def values_of(shown: Map) -> np.ndarray:
    """(N,) the values of a map of one channel at the vertices or, where it has none there, of all voxels."""
    values = shown.volume if shown.values is None else shown.values
    assert values is not None
    return np.ravel(values)


def has_values(subject: Subject) -> bool:
    """True where a map of a subject, of one channel, has any value."""
    return any(bool(np.isfinite(values_of(shown)).any()) for shown in subject.maps)


def scale_of(subject: Subject) -> Scale:
    """One scale for all maps of a subject with one channel.

    Angles: the whole period. Else 2nd to 98th percentile of the last map where the first is known, so that neither
    noise nor what was filled in flattens the result; else of all of the last, else of the first, else (0, 1).
    """
    if subject.period is not None:
        return Scale(subject.low, subject.low + subject.period, period=True, map=subject.colours)
    first, last = values_of(subject.maps[0]), values_of(subject.maps[-1])
    for values in (last[np.isfinite(first)], last, first):
        finite = values[np.isfinite(values)]
        if finite.size:
            low, high = np.percentile(finite, PERCENTILES)
            if high > low:
                return Scale(float(low), float(high), map=subject.colours)
    return Scale(*_around(first, last), map=subject.colours)


def _around(*maps: np.ndarray) -> tuple[float, float]:
    """A range around the one value of constant maps; 0 to 1 where there is none."""
    for values in maps:
        finite = values[np.isfinite(values)]
        if finite.size:
            middle = float(finite[0])
            half = abs(middle) / 2 or 1.0
            return middle - half, middle + half
    return 0.0, 1.0


def difference_scale(subject: Subject) -> Scale:
    """The scale of how two maps differ, even about 0, to the 98th percentile of its size."""
    size = np.abs(subject.differences())
    most = float(np.percentile(size, PERCENTILES[1])) if size.size else 0.0
    return Scale(-most, most, differences=True) if most > 0 else Scale(-1.0, 1.0, differences=True)
