"""Which flow is to run, with which beta and for how long: as the settings say, or as the data do."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from beltrami_cli.config import Settings
from beltrami_cli.course import Course
from beltrami_cli.evolve import Schedule
from beltrami_cli.extension import Extended
from beltrami_cli.flows import Flow, typical_slope
from beltrami_cli.inputs import Warnings
from beltrami_cli.observed import Observed
from beltrami_cli.progress import Phases
from beltrami_cli.tuning import LEAST_HELD, Choice, Family, choose, decorrelated

# eps of the flows l1 and tv as a share of the data's typical slope: so small that nearly every slope counts as an edge.
EPS_SHARE = 0.1
CORRELATED = "the noise of neighbours looks correlated (interpolated, or painted from a mesh)"


@dataclass(frozen=True, eq=False)
class Sample:
    """Data, and the values on the band that the flow starts from."""

    course: Course
    observed: Observed
    start: Extended

    @cached_property
    def noise(self) -> np.ndarray:
        """Standard deviations, (K,) or (1,), as `noise.noise_sd` finds them."""
        return self.observed.noise_sd()

    @cached_property
    def looks_correlated(self) -> bool:
        """True where the noise of neighbours is alike, see `noise.looks_correlated`."""
        return self.observed.looks_correlated()


@dataclass(frozen=True, eq=False)
class Plan:
    """What is to run: chosen once, for all frames of a series alike.

    slope: typical slope of the data; noise: (K,) standard deviations or (1,), data units; choice: None where beta and
    duration were given.
    """

    flow: Flow
    schedule: Schedule
    slope: float
    noise: np.ndarray
    choice: Choice | None


@dataclass(frozen=True, eq=False)
class Planner:
    """Plans by the settings and the data.

    iterations: how many, or the most that a stopping rule may take; ends_by: what ends the run.
    """

    settings: Settings
    iterations: int
    ends_by: str
    phases: Phases
    warnings: Warnings

    def plan(self, sample: Sample) -> Plan:
        """Which flow, and its schedule, by the settings and, where they say so, by the data; raises as `denoise`."""
        settings, course, start = self.settings, sample.course, sample.start
        slope = typical_slope(sample.course.band, start.values, start.known) * course.kind.unit
        flow = Flow("beltrami" if settings.flow == "auto" else settings.flow, settings.phi_name, settings.scheme)
        if len(settings.beta.values) > 1:
            schedule = Schedule(settings.beta.over(self.iterations), course.dt, self.ends_by)
            return Plan(flow, schedule, slope, sample.noise, None)
        fixed, steps, choice = self._fixed_beta(slope), self.iterations, None
        beta = fixed if fixed is not None else 1 / slope if slope else 0.0
        if not slope:  # constant data: nothing to choose, and nothing to flow
            steps = 0 if settings.stop is not None else steps
        elif self._chooses(fixed, sample):
            with self.phases("choose"):
                choice = choose(
                    course, sample.observed, self._families(fixed, slope), slope, steps, settings.seed,
                    stop=settings.stop == "auto",
                )  # fmt: skip
            flow, beta, steps = choice.flow, choice.beta, choice.iterations
            self._doubt(choice, sample)
        if settings.stop == "decorrelation" and steps:
            with self.phases("choose"):
                steps = decorrelated(course, sample.observed, start, flow, beta, self.iterations)
            if steps == self.iterations:
                self.warnings.add(f"stop decorrelation: the correlation was still falling after {steps} iterations")
        return Plan(flow, Schedule(np.full(steps, beta), course.dt, self.ends_by), slope, sample.noise, choice)

    def _fixed_beta(self, slope: float) -> float | None:
        """beta in mm per data unit where it is given, None where it is to be chosen."""
        settings = self.settings
        if settings.flow == "l2":
            return 0.0
        if settings.flow in ("l1", "tv"):
            return self._beta_of_eps(slope)
        return None if settings.beta.is_auto else settings.beta.values[0]

    def _beta_of_eps(self, slope: float) -> float:
        eps = self.settings.eps if self.settings.eps is not None else EPS_SHARE * slope
        return 1 / eps if eps else 0.0

    def _chooses(self, beta: float | None, sample: Sample) -> bool:
        """True where held-out data are to choose; another stopping rule, or too poor data, leave beta to the slope."""
        stop = self.settings.stop
        if stop == "auto":
            return True
        if beta is not None or stop is not None or not self.iterations:
            return False
        if self.settings.flow == "auto":
            return True
        why = None
        if sample.observed.can_hold_out()[1] < LEAST_HELD:
            why = f"there are too few valid {sample.observed.noun} beside the surface to hold some out"
        elif sample.looks_correlated:
            why = f"{CORRELATED}, so that held-out ones would be predicted from their own copies"
        if why:
            self.warnings.add(f"beta auto: {why}: beta is 1 / the data's median slope; give --beta or --edge")
        return why is None

    def _families(self, beta: float | None, slope: float) -> list[Family]:
        """The flows to try: the one that was named, or all."""
        settings = self.settings
        if settings.flow != "auto":
            return [Family(Flow(settings.flow, settings.phi_name, settings.scheme), beta)]
        return [
            Family(Flow("l2", scheme=settings.scheme), 0.0),
            Family(Flow("beltrami", scheme=settings.scheme), None),
            Family(Flow("tv", scheme=settings.scheme), self._beta_of_eps(slope)),
            Family(Flow("phi", "perona-malik", settings.scheme), None),
        ]

    def _doubt(self, choice: Choice, sample: Sample) -> None:
        """Warn where held-out data are a poor judge."""
        way_out = "look at the result, or use --stop discrepancy with --noise-sigma S"
        if sample.looks_correlated:
            self.warnings.add(
                f"automatic choice: {CORRELATED}: held-out ones are predicted from their own copies, and too little is "
                f"smoothed; {way_out}"
            )
        elif self.settings.stop == "auto" and not choice.is_clear and not self.settings.flat:
            self.warnings.add(
                f"automatic choice: no run predicts the held-out {sample.observed.noun} clearly better than the data "
                f"as they are; {way_out}"
            )
        if choice.at_end:
            self.warnings.add(f"the held-out error was still falling after {choice.iterations} iterations; {way_out}")
