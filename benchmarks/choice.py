"""The automatic choice against exhaustive search on torus maps whose truth is known, and what choosing costs; minutes.

PSNR in dB over 255 on the voxels with |Psi| < 0.5. loss: to the best that the search found of the same flow (of all
for the flow "auto"). tried/of: iterations that the choice took over those of the run that it chose. time: seconds of
the call over those of one with what it chose. steps: iterations that the best constant beta of Beltrami took.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numba
import numpy as np

from beltrami_cli import denoise
from beltrami_cli.band import build_band
from beltrami_cli.config import DEFAULT_BAND
from beltrami_cli.course import Course
from beltrami_cli.evolve import Schedule
from beltrami_cli.extension import own_samples
from beltrami_cli.flows import DT_SHARE, Flow, stability_bound, typical_slope
from beltrami_cli.kinds import Kind
from beltrami_cli.metrics import difference
from beltrami_cli.observed import AtVoxels
from beltrami_cli.phantoms import Phantom, torus

MAPS, SIGMAS = ("smooth", "pieces", "mixed"), (10, 20, 40)
FLOWS = {"L2": Flow("l2"), "TV": Flow("tv"), "P-M": Flow("phi", "perona-malik"), "Beltr": Flow("beltrami")}
# beta times the typical slope of the data, in steps of sqrt 2; for TV 1/eps, whose limit at large values is meant.
USUAL, FLAT, STEEP = 2.0 ** np.arange(-4, 4.1, 0.5), np.zeros(1), 2.0 ** np.arange(-4, 8.1, 0.5)
STEEPNESS = {"L2": FLAT, "TV": STEEP, "P-M": USUAL, "Beltr": USUAL}
MOST = 3000  # iterations; three times as many as the tool may choose
PAST = (1.6, 30)  # a curve has passed its best when it has gone on for this share of it, and so many more
AUTOMATIC = {"Beltr": {"flow": "beltrami"}, "P-M": {"flow": "phi", "phi": "perona-malik"}, "auto": {"flow": "auto"}}
SCHEDULE, STRETCHES = "0.05:0.5:geometric", (10, 20)  # mm per data unit; iterations
REPEATS = 3


@dataclass(frozen=True)
class Best:
    """The highest point of all curves of one flow. steepness: beta times the slope; steps: iterations done there."""

    db: float
    steepness: float
    steps: int


@dataclass(frozen=True)
class Chosen:
    """What stop="auto" gave. tried, steps: iterations of its search and of the run that it chose. time: see above."""

    db: float
    flow: str
    tried: int
    steps: int
    time: float


@dataclass(frozen=True)
class Case:
    """One noisy map."""

    map: str
    sigma: int

    @cached_property
    def phantom(self) -> Phantom:
        return torus(64, noise=self.sigma, map=self.map)

    def psnr(self, volume: np.ndarray) -> float:
        near = np.abs(self.phantom.levelset) < 0.5
        return difference(self.phantom.clean, volume, mask=near, data_range=255.0).psnr

    def denoised(self, **options: Any) -> tuple[np.ndarray, dict[str, Any]]:
        """A volume and its record."""
        result = denoise(self.phantom.levelset, self.phantom.noisy, threads=1, **options)
        return result.data, result.record

    def search(self) -> dict[str, Best]:
        """The best of each flow over all betas and iterations."""
        phantom, grid = self.phantom, self.phantom.grid
        band = build_band(phantom.levelset, grid, DEFAULT_BAND)
        course = Course(band, Kind(), DT_SHARE * stability_bound(grid.spacing, grid.shape))
        own = own_samples(band, band.gather(phantom.noisy.astype(np.float32))[None])
        start = AtVoxels(band, course.kind, own, np.isfinite(own[0]).astype(np.float32)).start()
        slope = typical_slope(band, start.values, start.known)
        near = band.primary[np.abs(band.gather(phantom.levelset)[band.primary]) < 0.5]
        clean = band.gather(phantom.clean)[near]

        def best(flow: Flow, steepness: float) -> Best:
            curve: list[float] = []

            def watch(k: int, u: np.ndarray) -> str | None:
                curve.append(difference(clean, u[0, near], data_range=255.0).psnr)
                return "passed" if k > PAST[0] * int(np.argmax(curve)) + PAST[1] else None

            course.run(start, flow, Schedule(np.full(MOST, steepness / slope), course.dt), stop=watch)
            return Best(max(curve), steepness, int(np.argmax(curve)))

        return {
            name: max((best(flow, steepness) for steepness in STEEPNESS[name]), key=lambda found: found.db)
            for name, flow in FLOWS.items()
        }

    def automatic(self, **options: str) -> Chosen:
        """What the tool chooses; its calls, and those with what it chose, take turns."""
        seconds: list[tuple[float, float]] = []
        for _ in range(REPEATS):
            start = time.perf_counter()
            data, record = self.denoised(stop="auto", **options)
            between = time.perf_counter()
            used = {name: record["Parameters"][name] for name in ("flow", "phi", "beta", "eps", "iterations")}
            self.denoised(**{name: value for name, value in used.items() if value is not None})
            seconds.append((between - start, time.perf_counter() - between))
        whole, one = np.median(seconds, axis=0)
        tried = sum(row["iterations_tried"] for row in record["Choice"]["table"])
        name = next(name for name, flow in FLOWS.items() if flow.name == used["flow"])
        return Chosen(self.psnr(data), name, tried, used["iterations"], whole / one)


@dataclass(frozen=True)
class Row:
    """A case and its results. scheduled: dB of SCHEDULE at each of `STRETCHES`."""

    case: Case
    best: dict[str, Best]
    chosen: dict[str, Chosen]
    scheduled: list[float]

    def loss(self, name: str) -> float:
        """dB."""
        best = self.best[name].db if name in self.best else max(best.db for best in self.best.values())
        return best - self.chosen[name].db

    @property
    def cells(self) -> list[list[str]]:
        case, own = self.case, self.best["Beltr"]
        groups = [[case.map, f"{case.sigma}", f"{case.psnr(case.phantom.noisy):.2f}"]]
        groups.append([*(f"{best.db:.2f}" for best in self.best.values()), f"{own.steps}"])
        for name, c in self.chosen.items():
            groups.append([f"{c.db:.2f}", f"{self.loss(name):.2f}", f"{c.tried}/{c.steps}", f"{c.time:.1f}"])
        groups[-1].append(self.chosen["auto"].flow)
        return [*groups, [f"{db:.2f}" for db in self.scheduled]]


def main() -> None:
    numba.set_num_threads(1)
    titles = ["", "best by search", *(f"chosen: {name}" for name in AUTOMATIC), "schedule"]
    judged = ["dB", "loss", "tried/of", "time"]
    names = [
        ["map", "sigma", "noisy"],
        [*FLOWS, "steps"],
        judged,
        judged,
        [*judged, "flow"],
        [f"{n}" for n in STRETCHES],
    ]
    print(" |".join(f"{title:^{len(line([group]))}}" for title, group in zip(titles, names, strict=True)))
    print(line(names), flush=True)
    rows = []
    for case in (Case(map_, sigma) for map_ in MAPS for sigma in SIGMAS):
        chosen = {name: case.automatic(**options) for name, options in AUTOMATIC.items()}
        scheduled = [case.psnr(case.denoised(beta=SCHEDULE, iterations=n)[0]) for n in STRETCHES]
        rows.append(Row(case, case.search(), chosen, scheduled))
        print(line(rows[-1].cells), flush=True)
    summarise(rows)


def line(groups: list[list[str]]) -> str:
    return " |".join("".join(f"{cell:>{9 if '/' in cell else 7}}" for cell in group) for group in groups)


def summarise(rows: list[Row]) -> None:
    """The figures that are to hold, over all cases or over those with jumps and much noise."""
    print()
    for name in AUTOMATIC:
        loss, times = (
            [f(row) for row in rows] for f in (lambda r, n=name: r.loss(n), lambda r, n=name: r.chosen[n].time)
        )
        print(
            f"chosen {name}: loss at most {max(loss):.2f} dB, median {np.median(loss):.2f}; "
            f"time at most {max(times):.1f}, median {np.median(times):.1f}"
        )
    edges = [row for row in rows if row.case.map != "smooth" and row.case.sigma >= 20]
    for rival in ("L2", "TV"):
        gain = min(row.chosen["Beltr"].db - row.best[rival].db for row in edges)
        print(f"chosen Beltr above the best {rival} on maps with jumps, sigma 20 and 40: {gain:.2f} dB at least")
    for i, steps in enumerate(STRETCHES):
        loss = [row.best["Beltr"].db - row.scheduled[i] for row in rows]
        print(f"{SCHEDULE} at {steps}: loss at most {max(loss):.2f} dB, median {np.median(loss):.2f}")
    for row in rows:
        for name, best in row.best.items():
            if best.steps == MOST or best.steepness == STEEPNESS[name][-1] > 0:
                print(f"{row.case.map} {row.case.sigma}: the best {name} lies at the end of what was searched")


if __name__ == "__main__":
    main()
