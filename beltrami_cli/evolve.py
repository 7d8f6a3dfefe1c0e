"""The time loop: schedules, records, a named stop reason. Knows no physics and no progress bar."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from beltrami_cli.errors import NumericsError

# u (K, E), out (K, E), beta, dt -> (root mean square change, energy)
Step = Callable[[np.ndarray, np.ndarray, float, float], tuple[float, float]]
# u (K, E), out (K, E)
Extend = Callable[[np.ndarray, np.ndarray], None]
# iteration from 1, iterations in all, root mean square change of the last step
Observer = Callable[[int, int, float], None]
# iterations done, u (K, E) -> why to stop here, or None to go on
Stop = Callable[[int, np.ndarray], str | None]


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
    """Where the loop ended. values: (K, E). change, energy: (N,), one per iteration done."""

    values: np.ndarray
    change: np.ndarray
    energy: np.ndarray
    stop_reason: str

    @property
    def iterations(self) -> int:
        return len(self.change)


def evolve(
    u0: np.ndarray,
    step: Step,
    schedule: Schedule,
    extend: Extend | None = None,
    extend_every: int = 5,
    observer: Observer | None = None,
    stop: Stop | None = None,
) -> Evolution:
    """Run `step` over the schedule from u0 (K, E), re-extending after every `extend_every` steps (0: never).

    stop: asked before the first iteration and after each, may end the run before the schedule does.
    Raises NumericsError at the first iteration whose values are no longer finite.
    """
    u, out = u0.copy(), np.empty_like(u0)
    change, energy = [], []
    reason = stop(0, u) if stop is not None else None
    for k, beta in enumerate(schedule.beta if reason is None else ()):
        moved, held = step(u, out, float(beta), schedule.dt)
        u, out = out, u
        if not (np.isfinite(moved) and np.isfinite(held)):
            raise NumericsError(
                f"the flow left the finite numbers at iteration {k + 1}: change {moved}, energy {held}; "
                "expected finite values (is DATA scaled beyond float32? try --precision float64)"
            )
        change.append(moved)
        energy.append(held)
        if extend is not None and extend_every and (k + 1) % extend_every == 0:
            extend(u, out)
            u, out = out, u
        if observer is not None:
            observer(k + 1, schedule.iterations, moved)
        if stop is not None and (reason := stop(k + 1, u)) is not None:
            break
    return Evolution(u, np.array(change), np.array(energy), reason or schedule.ends_by)
