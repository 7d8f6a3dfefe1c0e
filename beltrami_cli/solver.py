"""From arrays to denoised arrays: check, build the band, extend, choose, evolve, sample the mesh."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numba
import numpy as np

from beltrami_cli.band import Band, build_band, flat_band
from beltrami_cli.config import Settings
from beltrami_cli.course import Course
from beltrami_cli.errors import DataError, NumericsError, RefusedError
from beltrami_cli.evolve import Observer, Schedule
from beltrami_cli.extension import Extended, own_samples
from beltrami_cli.flows import DT_SHARE, Flow, stability_bound, typical_slope
from beltrami_cli.geodesic import distance_along
from beltrami_cli.grid import Grid
from beltrami_cli.kinds import Kind, kind_of
from beltrami_cli.levelset import two_values
from beltrami_cli.noise import looks_correlated, noise_sd, smoothness_mm
from beltrami_cli.progress import Phases
from beltrami_cli.record import Plan, Ran, what_happened
from beltrami_cli.sampling import surface_mesh
from beltrami_cli.surface import Mesh
from beltrami_cli.tuning import LEAST_VOXELS, Choice, Family, can_hold_out, choose, decorrelated, discrepancy

# eps of the flows l1 and tv as a share of the data's typical slope: so small that nearly every slope counts as an edge.
EPS_SHARE = 0.1
# Parts of the surface without data are worth a warning above this share of the band: below it are lone voxels.
LONE_SHARE = 1e-3
CORRELATED = "the noise of neighbouring voxels looks correlated (interpolated, or painted from a mesh)"
# Weights below 0 by no more than this share of the largest are rounding and interpolation.
NEGATIVE_SHARE = 1e-3


@dataclass(frozen=True, eq=False)
class Result:
    """What a run gives.

    data: denoised values in the shape and kind of the input, NaN (or what `outside` says) beyond the band.
    mesh: the surface in RAS mm with the denoised value at every vertex, (V,) or (V, K); None for a flat run.
    filled: bool, in the shape of one channel: where a value was filled in.
    record: every parameter as used and what happened, as in the sidecar.
    warnings: lines for the user.
    """

    data: np.ndarray
    mesh: Mesh | None
    filled: np.ndarray
    record: dict[str, Any]
    warnings: tuple[str, ...]


class Solver:
    """The band, the weights and the settings that all frames of a run share.

    psi: (nx, ny, nz), None for a flat run. weights: of the same shape, 0 or more, or None; mask: likewise, which data
    count (not 0). Raises as `denoise`.
    """

    def __init__(
        self,
        psi: np.ndarray | None,
        grid: Grid,
        settings: Settings,
        phases: Phases,
        warnings: Warnings,
        weights: np.ndarray | None = None,
        mask: np.ndarray | None = None,
    ) -> None:
        require_usable(grid, "the grid")
        self.grid, self.settings, self.phases, self.warnings = grid, settings, phases, warnings
        numba.set_num_threads(min(settings.threads or _cpus(), numba.config.NUMBA_NUM_THREADS))
        iterations, dt, self.ends_by = settings.duration(time_step(grid, settings))
        self.iterations = iterations
        self.plane = PlaneLast(grid)
        trust = _trust(weights, mask, grid, settings, warnings)
        with phases("band"):
            self.band = band_of(psi, settings, self.plane, warnings)
            self.trust = self.band.gather(self.plane.forth(trust))
            self.course = Course(
                self.band, Kind(), dt, settings.scheme, settings.extension, settings.depth, settings.reextends_every,
                settings.fidelity or 0.0,
            )  # fmt: skip

    def denoise(self, data: np.ndarray, observer: Observer | None = None) -> Result:
        """Denoise data of shape grid.shape, or grid.shape + (K,) for a vector."""
        sample = self._sample(data, self.warnings)
        return self._run(data, sample, self._plan(sample), observer)

    def denoise_frames(
        self,
        count: int,
        frame: Callable[[int], np.ndarray],
        record: dict[str, Any],
        observer: Observer | None = None,
    ) -> Iterator[Result]:
        """Denoise `count` frames one after another, all with what is chosen on the middle one.

        frame: its number -> data of shape grid.shape. record: is given the middle one's record, with a list over all.
        """
        middle = count // 2
        plan = self._plan(self._sample(frame(middle), self.warnings))
        quiet, empty, noise = Warnings(None), [], []
        for t in range(count):
            data = frame(t)
            try:
                sample = self._sample(data, quiet)
                result = self._run(data, sample, plan if t == middle else replace(plan, choice=None), observer)
                noise.append(result.record["Noise"]["sd"][0])
            except DataError:
                empty.append(t)
                noise.append(None)
                result = self._nothing(data)
            if t == middle:
                record.update(result.record)
            yield result
        if empty:
            self.warnings.add(
                f"{len(empty)} of {count} frames have no valid data on the surface: {empty[:10]}; left missing"
            )
        record["Frames"] = {"count": count, "chosen_on": middle, "without_data": empty, "noise_sd": noise}

    def _sample(self, data: np.ndarray, warnings: Warnings) -> Sample:
        """The data as channels on the band; raises DataError where none are valid."""
        data = _finite_or_missing(data, self.settings.missing, warnings)
        name = "scalar" if self.settings.independent else self.settings.kind
        kind, doubt = kind_of(name, data, self.settings.period)
        if doubt:
            warnings.add(doubt)
        with self.phases("extend"):
            channels = kind.to_channels(self.band.gather(self.plane.forth(data)))
            own = own_samples(self.band, channels, every=self.settings.extension == "none")
            trust = np.where(np.isnan(own[0]), 0, self.trust).astype(own.dtype)
            own[:, trust == 0] = np.nan
            if kind != self.course.kind:  # else its re-extension is already prepared
                self.course = replace(self.course, kind=kind)
            start = self.course.start(own, trust)
        missing = np.isnan(start.values[0, self.band.primary]).mean()
        if missing > LONE_SHARE:
            share = f"{100 * missing:.1f} %"
            warnings.add(f"{share} of the band lies on parts of the surface without any data: left missing")
        return Sample(self.course, own, trust, start)

    def _plan(self, sample: Sample) -> Plan:
        """Which flow, and its schedule, by the settings and, where they say so, by the data."""
        settings, course, start = self.settings, sample.course, sample.start
        slope = typical_slope(self.band, start.values, start.known) * course.kind.unit
        noise = noise_sd(self.band, sample.own, course.kind)
        flow = Flow("beltrami" if settings.flow == "auto" else settings.flow, settings.phi_name, settings.scheme)
        if len(settings.beta.values) > 1:
            schedule = Schedule(settings.beta.over(self.iterations), course.dt, self.ends_by)
            return Plan(flow, schedule, slope, noise, None)
        fixed, steps, choice = self._fixed_beta(slope), self.iterations, None
        beta = fixed if fixed is not None else 1 / slope if slope else 0.0
        if not slope:  # constant data: nothing to choose, and nothing to flow
            steps = 0 if settings.stop is not None else steps
        elif self._chooses(fixed, sample):
            with self.phases("choose"):
                choice = choose(
                    course, sample.own, sample.trust, self._families(fixed, slope), slope, steps, settings.seed,
                    stop=settings.stop == "auto",
                )  # fmt: skip
            flow, beta, steps = choice.flow, choice.beta, choice.iterations
            self._doubt(choice, sample)
        if settings.stop == "decorrelation" and steps:
            with self.phases("choose"):
                steps = decorrelated(course, start, flow, beta, steps)
        return Plan(flow, Schedule(np.full(steps, beta), course.dt, self.ends_by), slope, noise, choice)

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
        why = None
        if self.settings.flow == "auto":
            return True
        if len(can_hold_out(self.band, sample.trust)) < LEAST_VOXELS:
            why = f"there are fewer than {LEAST_VOXELS} valid voxels beside the surface, too few to hold some out"
        elif looks_correlated(self.band, sample.own, sample.course.kind):
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
        if looks_correlated(self.band, sample.own, sample.course.kind):
            self.warnings.add(
                f"automatic choice: {CORRELATED}: held-out ones are predicted from their own copies, and too little is "
                f"smoothed; {way_out}"
            )
        elif self.settings.stop == "auto" and not choice.is_clear:
            self.warnings.add(
                "automatic choice: no run predicts the held-out voxels clearly better than the data as they are; "
                + way_out
            )
        if choice.at_end:
            self.warnings.add(f"the held-out error was still falling after {choice.iterations} iterations; {way_out}")

    def _run(self, data: np.ndarray, sample: Sample, plan: Plan, observer: Observer | None) -> Result:
        settings, band, course, start = self.settings, self.band, sample.course, sample.start
        stop = None
        if settings.stop == "discrepancy" and plan.schedule.iterations:
            sigma = settings.noise_sigma or float(np.sqrt(np.mean(plan.noise**2)))
            if not sigma > 0:
                raise DataError("stop discrepancy: the noise cannot be estimated from these data; give --noise-sigma S")
            if settings.noise_sigma is None and looks_correlated(band, sample.own, course.kind):
                self.warnings.add(f"stop discrepancy: {CORRELATED}, which hides its size; give it as --noise-sigma S")
            stop = discrepancy(course, sample.own, sample.trust, sigma)
        with self.phases("flow"):
            evolution, substeps = course.run(start, plan.flow, plan.schedule, observer, stop)
            values, excess = _within_range(evolution.values, start, course.kind)
            if settings.fill is not None and not start.known.all():
                far = distance_along(band, start.known, settings.fill) > settings.fill
                values[:, far & ~start.known] = np.nan
        if stop is not None and not evolution.iterations:
            self.warnings.add("stop discrepancy: the start values are as far from the data as the noise: nothing to do")
        with self.phases("mesh"):
            mesh = None
            if not settings.flat:
                mesh, at_vertices = surface_mesh(band, values, turns=course.kind.turns)
                assert at_vertices is not None
                mesh = replace(mesh, values=course.kind.at_vertices(at_vertices))
        out = self._volume(course.kind.to_values(values), data)
        filled = ~start.known & ~np.isnan(values[0])
        smoothness = smoothness_mm(band, sample.own, course.kind), smoothness_mm(band, values, course.kind)
        ran = Ran(course.kind, sample.own, sample.trust, start, evolution, substeps, values, excess, smoothness)
        return Result(
            out, mesh, self.plane.back(band.scatter(filled, 0.0)),
            what_happened(settings, self.grid, band, plan, ran), tuple(self.warnings.lines),
        )  # fmt: skip

    def _volume(self, values: np.ndarray, data: np.ndarray) -> np.ndarray:
        """The band's values (E, ...) as a volume in the shape of the data."""
        outside: dict[str, np.ndarray | float] = {"nan": np.nan, "zero": 0.0, "keep": self.plane.forth(data)}
        return self.plane.back(self.band.scatter(values, outside[self.settings.outside]))

    def _nothing(self, data: np.ndarray) -> Result:
        """The result for a frame without data: everything missing."""
        band = self.band
        out = self._volume(np.full(band.entries, np.nan, data.dtype), data)
        mesh = None
        if not self.settings.flat:
            mesh = surface_mesh(band)[0]
            mesh = replace(mesh, values=np.full(len(mesh.vertices_ras_mm), np.nan, data.dtype))
        return Result(out, mesh, np.zeros(self.grid.shape, bool), {}, ())


@dataclass(frozen=True, eq=False)
class Sample:
    """Data on the band. own: (K, E) samples of weights trust (E,); start: the values that the flow starts from."""

    course: Course
    own: np.ndarray
    trust: np.ndarray
    start: Extended


def band_of(psi: np.ndarray | None, settings: Settings, plane: PlaneLast, warnings: Warnings) -> Band:
    """The band around the zero level of psi on the volume's own grid; the flat one where psi is None."""
    if psi is None:
        return flat_band(plane.grid)
    psi = _signed(plane.forth(psi), settings, warnings)
    return build_band(psi, plane.grid, settings.half_width(plane.grid.used_spacing))


def _signed(psi: np.ndarray, settings: Settings, warnings: Warnings) -> np.ndarray:
    """Psi with its negative side inside; a binary mask is centred on 0."""
    if mask := two_values(psi):
        low, high = mask
        warnings.add(
            f"the level set holds two values only ({low:g} and {high:g}): a mask, whose surface is a staircase of "
            "voxels, accurate to half a voxel; give a signed distance or another smooth function for a better one"
        )
        if low >= 0:  # a mask of something: what it marks is inside, whatever the sign
            return (low + high) / 2 - psi
    return -psi if settings.inside == "positive" else psi


def _trust(
    weights: np.ndarray | None, mask: np.ndarray | None, grid: Grid, settings: Settings, warnings: Warnings
) -> np.ndarray:
    """Weights over the grid, 0 to 1, 0 where the mask says that data do not count.

    Raises RefusedError for weights below 0, DataError for weights that are 0 everywhere or a mask that is empty.
    """
    trust = np.ones(grid.shape, settings.precision)
    if weights is not None:
        trust = np.where(np.isfinite(weights), weights, 0).astype(settings.precision)
        low, high = float(trust.min()), float(trust.max())
        if low < -NEGATIVE_SHARE * max(high, 0.0):
            raise RefusedError(
                f"weights: found values down to {low:g}; expected 0 or more (R^2, coherence, 1/variance)"
            )
        if high <= 0:
            raise DataError("weights: found 0 everywhere; expected some data that count")
        if low < 0:
            warnings.add(f"weights: values down to {low:g} taken as 0")
        trust = np.maximum(trust, 0) / high
    if mask is not None:
        counts = np.isfinite(mask) & (mask != 0)
        if not counts.any():
            raise DataError("mask: found 0 everywhere; expected other values where the data count")
        trust = np.where(counts, trust, 0)
    return trust


def _finite_or_missing(data: np.ndarray, missing: float | None, warnings: Warnings) -> np.ndarray:
    """Data whose infinite values, and those equal to `missing`, are NaN; raises DataError where nothing is left."""
    data = without(data, missing)
    infinite = np.isinf(data)
    if not np.isfinite(data).any():
        found = "NaN and values that are infinite at this precision" if infinite.any() else "NaN"
        found += "" if missing is None else f" and the missing value {missing:g}"
        raise DataError(f"DATA has no valid value: found only {found}; expected finite values on the surface")
    if infinite.any():
        warnings.add(f"DATA has {int(infinite.sum())} infinite values: taken as missing")
        data = np.where(infinite, data.dtype.type(np.nan), data)
    return data


def without(data: np.ndarray, missing: float | None) -> np.ndarray:
    """Data with NaN where they equal the value that means missing."""
    if missing is None:
        return data
    return np.where(data == data.dtype.type(missing), data.dtype.type(np.nan), data)


def _within_range(values: np.ndarray, start: Extended, kind: Kind) -> tuple[np.ndarray, float]:
    """Values (K, E), NaN where missing, kept within each channel's range in the data, and by how much they had left it.

    No flow leaves the range; differences do, a little, beside the band's ragged rim. Raises NumericsError where it was
    more than the range's own width: no error of differences, but a runaway. Complex numbers keep to the largest length.
    """
    if kind.turns:
        size, largest = np.hypot(*values), float(np.hypot(*start.values[:, start.known]).max())
        excess = max(float(np.nanmax(size)) - largest, 0.0)
        if not excess <= largest:
            raise NumericsError("the flow ran away from the data's range; try a smaller --dt or --scheme symmetric")
        return values * np.minimum(1, largest / np.maximum(size, 1e-30)), 0.0 if kind.is_circular else excess
    most = 0.0
    for channel, first in zip(values, start.values[:, start.known].astype(float), strict=True):
        low, high = first.min(), first.max()
        excess = max(low - float(np.nanmin(channel)), float(np.nanmax(channel)) - high, 0.0)
        rounding = 1e-3 * max(abs(low), abs(high))  # of thousands of steps on nearly constant data
        if not excess <= high - low + rounding:
            raise NumericsError(
                f"the flow ran away: found values {excess:.6g} beyond the data's own {low:.6g} to {high:.6g}; "
                "try a smaller --dt or --scheme symmetric"
            )
        np.clip(channel, low, high, out=channel)
        most = max(most, excess)
    return values, most


class PlaneLast:
    """Brings a plane's missing axis to the end, where the band expects it, and back."""

    def __init__(self, grid: Grid) -> None:
        single = [axis for axis in range(3) if grid.shape[axis] == 1]
        self.axis = single[0] if single else 2
        order = [a for a in range(3) if a != self.axis] + [self.axis]
        a, b, c = (grid.shape[k] for k in order)
        self.grid = Grid((a, b, c), grid.affine[:, [*order, 3]])

    def forth(self, array: np.ndarray) -> np.ndarray:
        return np.moveaxis(array, self.axis, 2)

    def back(self, array: np.ndarray) -> np.ndarray:
        return np.moveaxis(array, 2, self.axis)


class Warnings:
    """Collects lines for the user, and tells each at once to whoever listens."""

    def __init__(self, notify: Callable[[str], None] | None) -> None:
        self.lines: list[str] = []
        self._notify = notify

    def add(self, line: str) -> None:
        self.lines.append(line)
        if self._notify:
            self._notify(line)


def require_usable(grid: Grid, name: str) -> None:
    """Raise RefusedError where the voxel axes are not orthogonal."""
    if grid.is_sheared():
        raise RefusedError(
            f"{name}: its voxel axes are not orthogonal (a sheared affine); expected a rectangular grid: "
            "resample it onto one first"
        )


def time_step(grid: Grid, settings: Settings) -> float:
    """dt in mm^2 for this grid; raises RefusedError where the one asked for is over the bound."""
    bound = stability_bound(grid.spacing, grid.shape)
    if settings.dt is not None and settings.dt > bound * (1 + 1e-9):
        raise RefusedError(
            f"dt: found {settings.dt:g} mm^2, over the stability bound of {bound:.6g} mm^2 on voxels of "
            f"{' x '.join(f'{h:.4g}' for h in grid.spacing)} mm; give at most that, or auto"
        )
    return DT_SHARE * bound if settings.dt is None else settings.dt


def _cpus() -> int:
    """CPUs that this process may use: a scheduler or container may grant fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
