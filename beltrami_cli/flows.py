"""The flows U_t = a Div(c v), v = P grad U: which diffusivity c, which outer factor a, which differences.

One family covers them all; time is mm^2 and a c <= 1 for each, so one stability bound holds:

    flow       a   c                                     equation of the paper
    l2         1   1                                     4 (harmonic map, heat)
    beltrami   r   r = 1 / sqrt(1 + beta^2 |v|^2)        19 (curve), 20 (surface), with the step dt / beta
    l1         r   r with beta = 1 / eps                 7, times eps^2; the limit of Sec. 3.3
    tv         1   r with beta = 1 / eps                 gradient flow of 6, times eps
    phi        1   charbonnier r, perona-malik r^2,      5
                   geman-mcclure r^4, weickert 1 - exp(-3.31488 / (beta |v|)^8)

The paper steps by dt / beta and its flow carries a factor beta: they cancel, so a step is U += dt a Div(c v).

Several channels share c = c(sqrt(sum_k |v_k|^2)), but for `beltrami` and `l1` of a vector, whose channels the metric of
the surface that they span couples (see `kernels.metric`): dt is then divided by what that metric allows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from beltrami_cli.band import Band
from beltrami_cli.errors import NumericsError
from beltrami_cli.kernels import metric, steps

FLOWS = ("beltrami", "l2", "l1", "tv", "phi")
PHI_LAWS = {
    "charbonnier": steps.R,
    "perona-malik": steps.R2,
    "geman-mcclure": steps.R4,
    "weickert": steps.WEICKERT,
}
SCHEMES = {"symmetric": (steps.symmetric, metric.symmetric), "paper": (steps.paper, metric.paper)}

MOST_SUBSTEPS = 10_000  # parts of one step: beyond, minutes for each iteration
SLOPE_SAMPLES = 100_000  # entries: enough for a median to 1 %
DT_SHARE = 0.9  # the default dt as a share of the bound: at the bound itself the highest mode never decays


@dataclass(frozen=True)
class Flow:
    """A flow and its differences. `phi` names the diffusivity of the flow "phi" and is ignored by the others."""

    name: str = "beltrami"
    phi: str = "perona-malik"
    scheme: str = "symmetric"

    @property
    def law(self) -> int:
        """Diffusivity c as a kernel's law number."""
        if self.name == "phi":
            return PHI_LAWS[self.phi]
        return steps.ONE if self.name == "l2" else steps.R

    @property
    def has_beta(self) -> bool:
        """True where a person gives beta; `l1` and `tv` take eps in its place, `l2` nothing."""
        return self.name in ("beltrami", "phi")

    @property
    def has_outer_factor(self) -> bool:
        """True where a = r: such a flow does not keep the mean."""
        return self.name in ("beltrami", "l1")


def stability_bound(spacing: np.ndarray, shape: tuple[int, ...]) -> float:
    """Largest stable dt in mm^2: 1 / (2 sum 1/h_a^2) over the axes with more than one voxel."""
    h = np.asarray(spacing, float)[np.array(shape) > 1]
    return float(1 / (2 * (1 / h**2).sum()))


@dataclass(frozen=True, eq=False)
class Fidelity:
    """The term L w (U0 - U). target: (K, E) U0. rate: (E,) L w in 1/mm^2, 0 where the flow alone is to paint in."""

    target: np.ndarray
    rate: np.ndarray


class Stepper:
    """u -> u_next on one band, with the scratch memory that a step needs.

    channels: K of the values (K, E). coupled: beltrami and l1 take the metric that the channels span together; else, as
    for the other flows, they share one diffusivity. unit: data units per unit of u, in which beta counts.
    """

    def __init__(
        self,
        flow: Flow,
        band: Band,
        dtype: np.dtype,
        channels: int = 1,
        *,
        coupled: bool = False,
        unit: float = 1.0,
        fidelity: Fidelity | None = None,
        most_substeps: int = MOST_SUBSTEPS,
    ) -> None:
        self.flow, self.band, self.unit, self.fidelity = flow, band, unit, fidelity
        self.most_substeps = most_substeps
        self.normal = np.ascontiguousarray(band.normal, dtype)
        self.spacing = band.grid.spacing.astype(dtype)
        self.flux, self.work = (np.empty((channels, 3, band.entries), dtype) for _ in range(2))
        self.outer = np.empty(band.entries, dtype)
        self.metric = coupled and channels > 1 and flow.has_outer_factor  # of one channel, the metric is r
        if self.metric:
            self.tangents = len(band.grid.used_spacing) - (band.surface is not None)
            self.tensor = np.empty((6, band.entries), dtype)
            self.largest = np.empty(band.entries, dtype)
        self.substeps = 0  # most that any step so far was divided into

    def __call__(self, u: np.ndarray, out: np.ndarray, beta: float, dt: float) -> tuple[float, float]:
        """Write u after one step of dt (mm^2) at beta (mm per data unit) into out, both (K, E).

        Returns (root mean square of the change, mean over entries of c |v|^2 / 2). Raises NumericsError where the
        channels' metric would divide the step into more than most_substeps.
        """
        source, left, taken, energy, squares = u, dt, 0, 0.0, 0.0
        while left > 0 or not taken:
            now, bound = self._fluxes(source, beta * self.unit)
            if not bound <= self.most_substeps:  # NaN, too
                raise NumericsError(
                    f"a step at beta {beta:.4g} would have to be divided into {bound:.4g}: the channels' slopes are "
                    "far above 1/beta; give a smaller --beta"
                )
            parts = max(1, math.ceil(left / dt * bound - 1e-6)) if dt else 1
            squares = steps.diverge(
                source, self.flux, self.band.backward, self.outer, self.flow.has_outer_factor, left / parts, out
            )
            energy = energy if taken else now
            source, left, taken = out, left * (1 - 1 / parts), taken + 1
        self.substeps = max(self.substeps, taken)
        if self.fidelity is not None:
            with np.errstate(divide="ignore", over="ignore"):
                share = (1 / (1 + 1 / (dt * self.fidelity.rate))).astype(u.dtype)
            out += share * (self.fidelity.target - out)
        if self.fidelity is not None or taken > 1:
            squares = float(((out - u).astype(float) ** 2).sum())
        return float(np.sqrt(squares / u.shape[1])), float(energy / u.shape[1])

    def _fluxes(self, u: np.ndarray, beta: float) -> tuple[float, float]:
        """(energy, by how much a step is to be divided); the fluxes are left in self.flux."""
        shared, coupled = SCHEMES[self.flow.scheme]
        place = (u, self.normal, self.band.forward, self.band.backward, self.spacing)
        if self.metric:
            return coupled(*place, beta, self.tangents, self.flux, self.work, self.tensor, self.outer, self.largest)
        return shared(*place, self.flow.law, beta, self.flux, self.work, self.outer), 1.0


def typical_slope(band: Band, u: np.ndarray, known: np.ndarray) -> float:
    """Median of |P grad u| over the entries where data were known, all channels together; 0 for constant data.

    u: (K, E), known: (E,) bool; per mm, in the units of u. With noisy data this is the slope of the noise. Where more
    than half is flat, as in a map of few patches, it is the mean. Of a large band a regular sample is looked at.
    """
    entries = np.flatnonzero(known)
    entries = entries[:: 1 + len(entries) // SLOPE_SAMPLES]
    differences = [u[:, band.forward[a][entries]].astype(float) - u[:, band.backward[a][entries]] for a in range(3)]
    gradient = np.stack(differences) / (2 * band.grid.spacing[:, None, None])
    normal = band.normal[:, None, entries]
    gradient -= (gradient * normal).sum(0) * normal
    slope = np.sqrt((gradient**2).sum((0, 1)))
    return float(np.median(slope) or slope.mean())
