"""One course of a flow on one band: from start values, through the time loop, to where it ended."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from beltrami_cli.band import Band
from beltrami_cli.evolve import Evolution, Observer, Schedule, Stop, evolve
from beltrami_cli.extension import Extended, Reextension
from beltrami_cli.flows import MOST_SUBSTEPS, Fidelity, Flow, Stepper
from beltrami_cli.kinds import Kind


@dataclass(frozen=True, eq=False)
class Course:
    """What every flow on the same band and kind of value shares.

    dt: mm^2. extend_every: steps between re-extensions, 0 for never. fidelity: L in 1/mm^2.
    """

    band: Band
    kind: Kind
    dt: float
    extend_every: int = 5
    fidelity: float = 0.0

    @cached_property
    def reextension(self) -> Reextension | None:
        return Reextension(self.band, turns=self.kind.turns) if self.extend_every else None

    def run(
        self,
        start: Extended,
        flow: Flow,
        schedule: Schedule,
        observer: Observer | None = None,
        stop: Stop | None = None,
        most_substeps: int = MOST_SUBSTEPS,
    ) -> tuple[Evolution, int]:
        """Where `flow` leads from the start values, NaN where those are, and the most substeps that a step took."""
        u0 = start.values
        lost = np.isnan(u0[0])
        if lost.any():
            u0 = np.where(lost, 0, u0)  # linked to nothing but one another
        pull = Fidelity(u0, self.fidelity * start.confidence.astype(float)) if self.fidelity else None
        stepper = Stepper(
            flow, self.band, u0.dtype, len(u0),
            coupled=self.kind.name == "vector", unit=self.kind.unit, fidelity=pull,
            most_substeps=most_substeps,
        )  # fmt: skip
        evolution = evolve(u0, stepper, schedule, self.reextension, self.extend_every, observer, stop)
        evolution.values[:, lost] = np.nan
        return evolution, stepper.substeps
