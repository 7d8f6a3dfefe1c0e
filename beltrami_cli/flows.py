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
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from beltrami_cli.band import Band
from beltrami_cli.kernels import steps

FLOWS = ("beltrami", "l2", "l1", "tv", "phi")
PHI_LAWS = {
    "charbonnier": steps.R,
    "perona-malik": steps.R2,
    "geman-mcclure": steps.R4,
    "weickert": steps.WEICKERT,
}
SCHEMES = {"symmetric": steps.symmetric, "paper": steps.paper}

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
    def has_outer_factor(self) -> bool:
        """True where a = r: such a flow does not keep the mean."""
        return self.name in ("beltrami", "l1")

    def stepper(self, band: Band, dtype: np.dtype) -> Stepper:
        return Stepper(self, band, dtype)


def stability_bound(spacing: np.ndarray, shape: tuple[int, ...]) -> float:
    """Largest stable dt in mm^2: 1 / (2 sum 1/h_a^2) over the axes with more than one voxel."""
    h = np.asarray(spacing, float)[np.array(shape) > 1]
    return float(1 / (2 * (1 / h**2).sum()))


class Stepper:
    """u -> u_next on one band, with the scratch memory that a step needs."""

    def __init__(self, flow: Flow, band: Band, dtype: np.dtype) -> None:
        self.flow, self.band = flow, band
        self.normal = np.ascontiguousarray(band.normal, dtype)
        self.spacing = band.grid.spacing.astype(dtype)
        self.work = np.empty((7, band.entries), dtype)

    def __call__(self, u: np.ndarray, out: np.ndarray, beta: float, dt: float) -> tuple[float, float]:
        """Write u after one step of dt (mm^2) at beta (mm per data unit) into out, both (E,).

        Returns (root mean square of the change, mean over entries of c |v|^2 / 2).
        """
        kernel = SCHEMES[self.flow.scheme]
        band, flow = self.band, self.flow
        squares, energy = kernel(
            u, self.normal, band.forward, band.backward, self.spacing,
            flow.law, flow.has_outer_factor, beta, dt, self.work, out,
        )  # fmt: skip
        return float(np.sqrt(squares / len(u))), float(energy / len(u))


def typical_slope(band: Band, u: np.ndarray, known: np.ndarray) -> float:
    """Median of |P grad u| (data units per mm) over the entries where data were known; 0 for constant data.

    u: (E,), known: (E,) bool. With noisy data this is the slope of the noise: what lies above it is an edge. Of a large
    band a regular sample is looked at.
    """
    entries = np.flatnonzero(known)
    entries = entries[:: 1 + len(entries) // SLOPE_SAMPLES]
    steps = [u[band.forward[a][entries]].astype(float) - u[band.backward[a][entries]] for a in range(3)]
    gradient = np.stack(steps) / (2 * band.grid.spacing[:, None])
    normal = band.normal[:, entries]
    gradient -= (gradient * normal).sum(0) * normal
    return float(np.median(np.sqrt((gradient**2).sum(0))))
