"""Automatic choice of the flow, its beta and when to stop, by data that the flow has not seen; stopping rules.

Some of the data near the surface are held out, the rest is extended, and the flow runs over a path of beta. After every
iteration its values at the held-out places are compared with their data: with noise that is independent from place to
place, the mean squared error there is the noise's variance plus the squared error against
what lies below the noise, so both have their least value together. Iterations are then repeated on all data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from beltrami_cli.course import Course
from beltrami_cli.errors import DataError, NumericsError
from beltrami_cli.evolve import Schedule, Stop
from beltrami_cli.extension import Extended
from beltrami_cli.flows import Flow
from beltrami_cli.kinds import Kind
from beltrami_cli.observed import Observed

LEAST_HELD = 30  # places, below which an error says nothing
# A curve of error over iterations has passed its least value when it has gone on for a third as long again, and 6 more:
# longer than from one re-extension to the next.
PATIENCE = (1.33, 6)
# A run whose error is above the least so far is given up when it has taken half as long again as that, and 10 more.
RIVAL = (1.5, 10)
# Steps of the search over log2 beta: a factor of 4 until the least error lies between two larger ones, then 2 and 1.4.
FIRST_STEP, LAST_STEP = 2.0, 0.5
SEARCH_RANGE = 8.0  # |log2 (beta times the typical slope)|: beyond, a flow is l2, or stands still
MOST_SUBSTEPS = 64  # parts of a step that a run of the path may take: an edge of 100 times 1 / beta takes half
CLEAR = 3.0  # standard errors by which the chosen run must beat the start for the choice to mean something


@dataclass(frozen=True)
class Curve:
    """One run of the path. errors: (n + 1,) mean squared error at the held-out places after 0..n iterations."""

    flow: Flow
    beta: float
    errors: np.ndarray
    iterations: int
    gain: float

    @property
    def error(self) -> float:
        return float(self.errors[self.iterations])


@dataclass(frozen=True)
class Choice:
    """The run of least error, and all that were tried.

    gain: by how many standard errors it beats the start values. at_end: its error was still falling.
    """

    flow: Flow
    beta: float
    iterations: int
    gain: float
    at_end: bool
    held_out: int
    curves: tuple[Curve, ...] = field(repr=False)

    @property
    def errors(self) -> np.ndarray:
        """(n + 1,) root mean square error of the run of least error after 0..n iterations, data units."""
        return np.sqrt(min(self.curves, key=lambda c: c.error).errors)

    @property
    def is_clear(self) -> bool:
        return self.gain >= CLEAR

    def table(self) -> list[dict[str, float | int | str | None]]:
        """Each run's flow, beta (mm per data unit), best iteration and root mean square error there (data units).

        An error of None is that of a run that could not be made.
        """
        return [
            {
                "flow": c.flow.name,
                "phi": c.flow.phi if c.flow.name == "phi" else None,
                "beta": c.beta if c.flow.has_beta else None,
                "iterations": c.iterations,
                "error": float(np.sqrt(c.error)) if np.isfinite(c.error) else None,
                "error_at_start": float(np.sqrt(c.errors[0])) if np.isfinite(c.error) else None,
                "iterations_tried": len(c.errors) - 1,
            }
            for c in self.curves
        ]


def hold_out(observed: Observed, seed: int) -> np.ndarray:
    """Places (H,) whose data are held out; raises DataError where too few hold data."""
    valid, count = observed.can_hold_out()
    if count < LEAST_HELD:
        raise DataError(
            f"automatic choice: found {len(valid)} valid {observed.noun} beside the surface, of which to hold out "
            f"{count}; expected at least {LEAST_HELD}; give --beta and --iterations"
        )
    return np.sort(np.random.default_rng(seed).choice(valid, count, replace=False))


@dataclass(frozen=True)
class Family:
    """A flow to try. beta: mm per data unit, or None to search for it."""

    flow: Flow
    beta: float | None


def choose(
    course: Course,
    observed: Observed,
    families: list[Family],
    slope: float,
    iterations: int,
    seed: int,
    *,
    stop: bool,
) -> Choice:
    """The run of least held-out error over `families`, their betas and, with `stop`, iterations up to `iterations`.

    slope: typical slope of the data (data units per mm), where the search over beta starts. Without `stop`, runs are
    compared at their last iteration.
    Raises DataError where too few places hold data, NumericsError where no run stays within the finite numbers.
    """
    held = hold_out(observed, seed)
    start, seen, truth = observed.without(held).start(), observed.seen(held), observed.values[:, held]
    weight = observed.trust[held] / observed.trust[held].sum(dtype=float)

    def curve(flow: Flow, beta: float) -> Curve:
        rival = min(curves, key=lambda c: c.error, default=None)
        watch = _Watch(course.kind, seen, truth, weight, rival, to_end=not stop)
        try:
            course.run(
                start, flow, Schedule(np.full(iterations, beta), course.dt), stop=watch, most_substeps=MOST_SUBSTEPS
            )
        except NumericsError as error:  # channels so steep for this beta that a step would take minutes
            failures.append(error)
            watch.errors, watch.least = [np.inf], 0
        curves.append(Curve(flow, beta, np.array(watch.errors), watch.least, watch.gain))
        return curves[-1]

    curves: list[Curve] = []
    failures: list[NumericsError] = []
    for family in families:
        if family.beta is not None:
            curve(family.flow, family.beta)
        else:
            search(lambda x, flow=family.flow: curve(flow, 2.0**x / slope).error)  # type: ignore[misc]
    best = min(curves, key=lambda c: c.error)
    if best.error == np.inf:
        raise failures[0]
    return Choice(
        best.flow, best.beta, best.iterations, best.gain,
        stop and best.iterations == iterations, len(held), tuple(curves),
    )  # fmt: skip


class _Watch:
    """Follows the error at the held-out places and says when nothing more is to come (never, with to_end).

    seen: gives the band's values there, of which `truth` (K, H) are the data of weights `weight` (H,).
    """

    def __init__(
        self,
        kind: Kind,
        seen: Callable[[np.ndarray], np.ndarray],
        truth: np.ndarray,
        weight: np.ndarray,
        rival: Curve | None,
        *,
        to_end: bool,
    ) -> None:
        self.kind, self.seen, self.truth, self.weight, self.to_end = kind, seen, truth, weight, to_end
        self.longest = (np.inf, 0.0) if rival is None else (RIVAL[0] * rival.iterations + RIVAL[1], rival.error)
        self.errors: list[float] = []
        self.least = 0
        self.first = self.best = np.empty(0)

    def __call__(self, k: int, u: np.ndarray) -> str | None:
        each = self.kind.errors(self.seen(u), self.truth)
        self.errors.append(float((self.weight * each).sum()))  # not @: BLAS sums in an order of its threads
        if k == 0:
            self.first = self.best = each
        elif self.to_end or self.errors[k] < self.errors[self.least]:
            self.least, self.best = k, each
        passed = k > PATIENCE[0] * self.least + PATIENCE[1]
        beaten = k > self.longest[0] and self.errors[k] > self.longest[1]
        return "passed" if not self.to_end and (passed or beaten) else None

    @property
    def gain(self) -> float:
        """How much less the error is than at the start, in standard errors of that difference."""
        fall = (self.first - self.best) * self.weight * len(self.weight)
        spread = float(fall.std()) / np.sqrt(len(self.weight))
        return float(fall.mean()) / spread if spread > 0 else 0.0


def search(error: Callable[[float], float]) -> None:
    """Evaluate `error` at values of x = log2 (beta times slope) that close in on the least."""
    tried: dict[float, float] = {}

    def at(x: float) -> float:
        if abs(x) > SEARCH_RANGE:
            return np.inf
        if x not in tried:
            tried[x] = error(x)
        return tried[x]

    x, step = 0.0, FIRST_STEP
    while step >= LAST_STEP:
        nearest = min((x, x - step, x + step), key=at)
        if nearest == x:
            step /= 2
        x = nearest


def discrepancy(observed: Observed, sigma: float) -> Stop:
    """Stops where the flow's values have left the data by the noise's standard deviation sigma (data units).

    Morozov's principle. Raises DataError where there are no valid data on the surface.
    """
    near = _near(observed, "discrepancy")
    data, seen, kind = observed.values[:, near], observed.seen(near), observed.kind
    return lambda k, u: "discrepancy" if kind.spread(data, seen(u)) >= sigma else None


def decorrelated(course: Course, observed: Observed, start: Extended, flow: Flow, beta: float, iterations: int) -> int:
    """The iteration at which what was removed from the data is least correlated with what is left (Mrazek, Navara).

    From the data, not the start values, which are averages already. Raises as `discrepancy`.
    """
    near = _near(observed, "decorrelation")
    data, seen = observed.values[:, near].astype(float), observed.seen(near)
    found: list[float] = [np.inf]  # at the start nothing is removed

    def watch(k: int, u: np.ndarray) -> str | None:
        if k:
            left = seen(u).astype(float)
            removed = data - left
            left, removed = (x - x.mean(1, keepdims=True) for x in (left, removed))
            size = np.sqrt((left**2).sum() * (removed**2).sum())
            found.append(abs(float((left * removed).sum())) / size if size > 0 else 0.0)
        return "passed" if k > PATIENCE[0] * int(np.argmin(found)) + PATIENCE[1] else None

    course.run(start, flow, Schedule(np.full(iterations, beta), course.dt), stop=watch)
    return int(np.argmin(found))


def _near(observed: Observed, rule: str) -> np.ndarray:
    near = observed.near()
    if not len(near):
        raise DataError(f"stop {rule}: found no valid {observed.noun} on the surface; give --iterations")
    return near
