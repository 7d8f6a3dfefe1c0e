"""The time loop: schedules, records, a named stop reason. Knows no physics and no progress bar."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from beltrami_cli.errors import NumericsError

# u (E,), out (E,), beta, dt -> (root mean square change, energy)
Step = Callable[[np.ndarray, np.ndarray, float, float], tuple[float, float]]
# u (E,), out (E,)
Extend = Callable[[np.ndarray, np.ndarray], None]
# iteration from 1, iterations in all, root mean square change of the last step
Observer = Callable[[int, int, float], None]


@dataclass(frozen=True, eq=False)
class Schedule:
    """What each iteration runs with: beta (K,) in mm per data unit and one dt in mm^2; `ends_by` is the stop reason."""

    beta: np.ndarray
    dt: float
    ends_by: str = "iterations"

    @property
    def iterations(self) -> int:
        return len(self.beta)


@dataclass(frozen=True, eq=False)
class Evolution:
    """Where the loop ended. values: (E,). change, energy: (K,), one per iteration done."""

    values: np.ndarray
    change: np.ndarray
    energy: np.ndarray
    stop_reason: str


def evolve(
    u0: np.ndarray,
    step: Step,
    schedule: Schedule,
    extend: Extend | None = None,
    extend_every: int = 5,
    observer: Observer | None = None,
) -> Evolution:
    """Run `step` over the schedule from u0 (E,), re-extending after every `extend_every` steps (0: never).

    Raises NumericsError at the first iteration whose values are no longer finite.
    """
    u, out = u0.copy(), np.empty_like(u0)
    change, energy = np.empty(schedule.iterations), np.empty(schedule.iterations)
    for k, beta in enumerate(schedule.beta):
        change[k], energy[k] = step(u, out, float(beta), schedule.dt)
        u, out = out, u
        if not (np.isfinite(change[k]) and np.isfinite(energy[k])):
            raise NumericsError(
                f"the flow left the finite numbers at iteration {k + 1}: change {change[k]}, energy {energy[k]}; "
                "expected finite values (is DATA scaled beyond float32? try --precision float64)"
            )
        if extend is not None and extend_every and (k + 1) % extend_every == 0:
            extend(u, out)
            u, out = out, u
        if observer is not None:
            observer(k + 1, schedule.iterations, float(change[k]))
    return Evolution(u, change, energy, schedule.ends_by)
