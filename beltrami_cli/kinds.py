"""Kinds of value - scalar, circular, vector - as channels that a flow can carry, and back."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beltrami_cli.errors import DataError

KINDS = ("scalar", "circular", "vector")


@dataclass(frozen=True)
class Kind:
    """What the data are.

    name: "scalar", "circular" or "vector". period: P of circular data, data units. low: where their range starts, 0 or
    -P/2. is_complex: vector data of one complex number per voxel, whose channels are real and imaginary part.
    """

    name: str = "scalar"
    period: float = 0.0
    low: float = 0.0
    is_complex: bool = False

    @property
    def is_circular(self) -> bool:
        return self.name == "circular"

    @property
    def turns(self) -> bool:
        """True for channels that are parts of a complex number: what is done to them must not depend on its phase."""
        return self.is_circular or self.is_complex

    @property
    def unit(self) -> float:
        """Data units per unit of the channels: P / 2 pi for angles, whose channels are cos and sin; else 1."""
        return self.period / (2 * np.pi) if self.is_circular else 1.0

    def to_channels(self, data: np.ndarray) -> np.ndarray:
        """(K, ...) channels of data (...), (..., K) for a vector; a value missing in one channel is so in all."""
        if self.is_circular:
            angle = data / self.unit
            return np.stack([np.cos(angle), np.sin(angle)]).astype(data.dtype)
        if self.is_complex:
            channels = np.stack([data.real, data.imag])
        elif self.name == "vector":
            channels = np.moveaxis(data, -1, 0).copy()
        else:
            return data[None]
        missing = np.isnan(channels).any(0)
        if missing.any():
            channels[:, missing] = np.nan
        return channels

    def to_values(self, channels: np.ndarray) -> np.ndarray:
        """Data as they came from channels (K, ...): angles in [low, low + P), vectors (..., K)."""
        if self.is_circular:
            return self.wrapped(np.arctan2(channels[1], channels[0]) * channels.dtype.type(self.unit))
        if self.is_complex:
            return channels[0] + channels.dtype.type(1) * 1j * channels[1]
        if self.name == "vector":
            return np.ascontiguousarray(np.moveaxis(channels, 0, -1))
        return channels[0]

    def at_vertices(self, channels: np.ndarray) -> np.ndarray:
        """Values of a mesh, real: (V,), or (V, K) for a vector; complex ones as real and imaginary part."""
        values = self.to_values(channels)
        return np.stack([values.real, values.imag], -1) if self.is_complex else values

    def wrapped(self, angles: np.ndarray) -> np.ndarray:
        """Angles brought to [low, low + P), in their own precision."""
        low, period = (angles.dtype.type(x) for x in (self.low, self.period))
        out = (angles - low) % period + low
        return np.where(out >= low + period, low, out)  # rounding may reach the end that is not in the range

    def differences(self, a: np.ndarray, b: np.ndarray) -> np.ndarray:
        """(K', ...) a - b of channels (K, ...) in data units, as float64: one wrapped difference for angles."""
        x, y = a.astype(float), b.astype(float)
        if not self.is_circular:
            return x - y
        turned = np.arctan2(x[1] * y[0] - x[0] * y[1], x[0] * y[0] + x[1] * y[1])
        return turned[None] * self.unit

    def spread(self, a: np.ndarray, b: np.ndarray) -> float:
        """Root mean square of a - b, channels (K, N), in data units; for angles sqrt(-2 ln mean cos)."""
        d = self.differences(a, b)
        if not d.size:
            return np.nan
        if not self.is_circular:
            return float(np.sqrt(np.mean(d**2)))
        return float(self.unit * np.sqrt(0.0 - 2 * np.log(max(float(np.mean(np.cos(d / self.unit))), 1e-12))))

    def errors(self, u: np.ndarray, data: np.ndarray) -> np.ndarray:
        """(...) squared error of channels u against data (K, ...): |u - data|^2, in data units.

        For angles P^2 / (2 pi^2) (1 - cos of the difference), which is its square where it is small. Either way its
        mean over independent noise of zero mean is lowest where u is what lies below the noise.
        """
        x, y = u.astype(float), data.astype(float)
        if not self.is_circular:
            return ((x - y) ** 2).sum(0)
        size = np.maximum(np.hypot(x[0], x[1]), 1e-30)
        return 2 * self.unit**2 * (1 - (x * y).sum(0) / size)


def kind_of(name: str, data: np.ndarray, period: float | None) -> tuple[Kind, str | None]:
    """The kind of these data (E,) or (E, K), and a warning where an angle's period hardly fits them.

    A vector of one channel is a scalar. Raises DataError where an angle's values span many periods.
    """
    if name != "circular":
        single = data.ndim == 1 and not np.iscomplexobj(data)
        return Kind("scalar" if single else name, is_complex=np.iscomplexobj(data)), None
    assert period is not None
    finite = data[np.isfinite(data)]
    low, high = (float(finite.min()), float(finite.max())) if finite.size else (0.0, 0.0)
    signed = low < 0 and high <= period / 2 * (1 + 1e-6)
    kind = Kind(name, period, -period / 2 if signed else 0.0)
    warning = None
    if high - low > period * (1 + 1e-3):
        warning = f"DATA run from {low:g} to {high:g}, more than one period of {period:g}: taken as wrapped angles"
        if high - low > 100 * period:
            raise DataError(
                f"DATA run from {low:g} to {high:g}, {(high - low) / period:.0f} periods of {period:g}; "
                "expected angles of that period: is --period in the unit of DATA?"
            )
    elif 0 < high - low < 0.05 * period:
        warning = f"DATA run from {low:g} to {high:g} only, of a period of {period:g}: is --period in their unit?"
    return kind, warning
