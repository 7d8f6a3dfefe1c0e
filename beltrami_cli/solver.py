"""From arrays to denoised arrays: check, build the band, extend, choose, evolve, sample the mesh."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numba
import numpy as np

from beltrami_cli.config import Settings
from beltrami_cli.course import Course
from beltrami_cli.errors import DataError, NumericsError, RefusedError
from beltrami_cli.evolve import Observer, Stop
from beltrami_cli.extension import Extended
from beltrami_cli.grid import Canonical, Grid
from beltrami_cli.inputs import (
    Warnings,
    band_of,
    finite_or_missing,
    require_usable,
    time_step,
    trusted,
    without,
)
from beltrami_cli.kinds import Kind, kind_of
from beltrami_cli.observed import AtVertices, Observed, VertexBand
from beltrami_cli.places import Vertices, Voxels
from beltrami_cli.planning import CORRELATED, Plan, Planner, Sample
from beltrami_cli.progress import Phases
from beltrami_cli.record import Ran, over_frames, what_happened
from beltrami_cli.sampling import SurfacePoints, own_vertices, surface_mesh, vertices_of
from beltrami_cli.surface import Mesh, edges_of, faces_inwards
from beltrami_cli.tuning import discrepancy

# Parts of the surface without data are worth a warning above this share of the band: below it are lone voxels.
LONE_SHARE = 1e-3
SPECK = 3  # edges: parts of a surface without a voxel of their own are hardly wider, and holes worth the name are


@dataclass(frozen=True, eq=False)
class Result:
    """What a run gives.

    data: denoised values in the shape and kind of the input, NaN (or what `outside` says) beyond the band.
    mesh: the surface in RAS mm with the denoised value at every vertex, (V,) or (V, K); None for a flat run. Where the
        surface was given as a mesh, its own vertices and triangles, in their order.
    filled: bool, in the shape of one channel: where a value was filled in.
    record: every parameter as used and what happened, as in the sidecar.
    warnings: lines for the user.
    on: values, (V,) or (V, K), at the vertices of other meshes of the surface, NaN where they lie beside the band.
    """

    data: np.ndarray
    mesh: Mesh | None
    filled: np.ndarray
    record: dict[str, Any]
    warnings: tuple[str, ...]
    on: tuple[np.ndarray, ...] = ()


class Gathered:
    """Results of frames, one after another, as one: frames on a last axis; filled is what was filled in any."""

    def __init__(self) -> None:
        self.mesh: Mesh | None = None
        self.shown: list[list[np.ndarray]] = []
        self.filled = np.zeros((), bool)

    def add(self, result: Result) -> None:
        self.mesh = result.mesh
        at_mesh = [] if result.mesh is None or result.mesh.values is None else [result.mesh.values]
        self.shown.append([*at_mesh, *result.on])
        self.filled = self.filled | result.filled

    def result(self, data: np.ndarray, record: dict[str, Any]) -> Result:
        values = [np.stack(frames, -1) for frames in zip(*self.shown, strict=True)]
        mesh = None if self.mesh is None else replace(self.mesh, values=values.pop(0))
        return Result(data, mesh, self.filled, record, (), tuple(values))


class Solver:
    """The band, the weights and the settings that all frames of a run share.

    surface: Psi, (nx, ny, nz), or a mesh in RAS mm; None for a flat run. at_vertices: the data lie at the vertices of
    the mesh, not in the voxels of the grid. weights: of the shape of one channel of the data, 0 or more, or None;
    mask: likewise, which data count (not 0). on: other meshes of the surface whose vertices are to get values. looks:
    the record tells of the noise that is left as the flow goes on. Raises as `denoise`.
    """

    def __init__(
        self,
        surface: np.ndarray | Mesh | None,
        grid: Grid,
        settings: Settings,
        phases: Phases,
        warnings: Warnings,
        weights: np.ndarray | None = None,
        mask: np.ndarray | None = None,
        *,
        at_vertices: bool = False,
        on: Sequence[Mesh] = (),
        looks: bool = False,
    ) -> None:
        require_usable(grid, "the grid")
        self.grid, self.settings, self.phases, self.warnings = grid, settings, phases, warnings
        self.looks = looks
        numba.set_num_threads(min(settings.threads or cpus(), numba.config.NUMBA_NUM_THREADS))
        iterations, dt, ends_by = settings.duration(time_step(grid, settings))
        self.planner = Planner(settings, iterations, ends_by, phases, warnings)
        self.places: Voxels | Vertices
        shape: tuple[int, ...] = grid.shape
        axes = Canonical(grid)
        with phases("band"):
            self.shown: list[tuple[Mesh, SurfacePoints]] = []
            if isinstance(surface, Mesh):
                if 1 in grid.shape:
                    raise RefusedError("data: found a plane; expected a volume around the surface, which is a mesh")
                if settings.depth is not None and faces_inwards(surface):
                    warnings.add("LEVELSET: the triangles of a closed surface face inwards: turned, for --depth")
                    surface = replace(surface, cells=surface.cells[:, ::-1])
                of_mesh = VertexBand(surface, axes.grid, settings.half_width(grid.used_spacing))
                self.band = of_mesh.band
                self.shown.append((surface, of_mesh.vertices))
            else:
                self.band = band_of(surface, settings, axes, warnings)
                if surface is not None:
                    self.shown.append((surface_mesh(self.band)[0], own_vertices(self.band)))
            if at_vertices:
                assert isinstance(surface, Mesh)
                self.places, shape = Vertices(of_mesh, settings.fill), (len(surface.vertices_ras_mm),)
            else:
                self.places = Voxels(
                    self.band, axes, settings.extension, settings.depth, settings.fill, settings.outside
                )
            if isinstance(surface, Mesh):
                self._tell_lost(of_mesh)
            self.trust = self.places.take(trusted(weights, mask, shape, settings, warnings))
            self.shown += [(mesh, self._found(mesh)) for mesh in on]
            self.course = Course(self.band, Kind(), dt, settings.reextends_every, settings.fidelity or 0.0)

    def _tell_lost(self, of_mesh: VertexBand) -> None:
        alone = np.setdiff1d(np.arange(len(of_mesh.points)), of_mesh.mesh.cells)
        if len(alone):
            self.warnings.add(
                f"{len(alone)} of {len(of_mesh.points)} vertices belong to no triangle: they get no value"
            )
        outside = int((~of_mesh.reached).sum()) - len(alone)
        if outside > 0:
            self.warnings.add(
                f"{outside} of {len(of_mesh.points)} vertices lie outside of the volume: they get no value"
            )
        edge, widest = float(np.median(of_mesh.edge_lengths)), float(self.grid.spacing.max())
        if isinstance(self.places, Vertices) and widest > 2 * edge:
            self.warnings.add(
                f"spacing: voxels of {widest:.4g} mm are wide for edges of {edge:.4g} mm: what is finer is lost"
            )

    def _found(self, mesh: Mesh) -> SurfacePoints:
        """Where the vertices of another mesh are on the band; raises DataError where none is."""
        points = vertices_of(self.band, mesh)
        lost = int((points.start < 0).sum())
        if lost == len(points.start):
            raise DataError(
                f"on: none of the {lost} vertices lies within {self.band.half_width:g} mm of the surface; expected a "
                "mesh of the same surface in the same space (--frame says which it is in)"
            )
        if lost:
            self.warnings.add(f"on: {lost} of {len(points.start)} vertices lie beyond the band: they get no value")
        return points

    def denoise(self, data: np.ndarray, observer: Observer | None = None) -> Result:
        """Denoise data of shape grid.shape or (V,), or with (K,) behind for a vector."""
        sample = self._sample(data, self.warnings)
        return self._run(data, sample, self.planner.plan(sample), self.warnings, observer, self.looks)

    def at_mesh(self, data: np.ndarray) -> np.ndarray | None:
        """The values of the data themselves, as `Result.mesh` has those of the result; None for a flat run.

        data: as `denoise` takes them. NaN where a value is missing or does not count.
        """
        if self.settings.flat:
            return None
        observed = self._observed(data, Warnings(None))
        channels, kind = observed.values, observed.kind
        if not isinstance(observed, AtVertices):
            mesh, points = self.shown[0]
            channels = _without_specks(mesh, points(channels, turns=kind.turns))
        return kind.at_vertices(channels)

    def denoise_series(self, data: np.ndarray, observer: Observer | None = None) -> Result:
        """Denoise every frame of data, one channel's shape + (K,), on its own."""
        record: dict[str, Any] = {}
        gathered, frames = Gathered(), []
        for result in self.denoise_frames(data.shape[-1], lambda t: data[..., t], record, observer):
            gathered.add(result)
            frames.append(result.data)
        return gathered.result(np.stack(frames, -1), record)

    def denoise_frames(
        self,
        count: int,
        frame: Callable[[int], np.ndarray],
        record: dict[str, Any],
        observer: Observer | None = None,
    ) -> Iterator[Result]:
        """Denoise `count` frames one after another, all with what is chosen on the middle one (that holds data).

        frame: its number -> data of one channel's shape. record: is given the middle one's, with lists over all; that
        one's number, `Frames.chosen_on`, before the first result.
        """
        chosen_on, sample = self._first_sample(count, frame)
        record["Frames"] = {"count": count, "chosen_on": chosen_on}
        plan = self.planner.plan(sample)
        records: list[dict[str, Any]] = []
        heard: Counter[str] = Counter()
        for t in range(count):
            data, quiet = frame(t), Warnings(None)
            try:
                sample = self._sample(data, quiet)
            except DataError:
                quiet.add("no valid data on the surface: left missing")
                records.append({})
                result = self._nothing(data)
            else:
                noise = np.where(
                    np.isnan(sample.noise), plan.noise, sample.noise
                )  # too few voxels to tell: as where it was chosen
                choice, looks = (plan.choice, self.looks) if t == chosen_on else (None, False)
                result = self._run(data, sample, replace(plan, noise=noise, choice=choice), quiet, observer, looks)
                records.append(result.record)
            heard.update(quiet.lines)
            yield result
        for line, frames in heard.items():
            self.warnings.add(f"in {frames} of {count} frames: {line}")
        record.update(records[chosen_on])
        record["Frames"] = {"count": count, "chosen_on": chosen_on, **over_frames(records)}

    def _first_sample(self, count: int, frame: Callable[[int], np.ndarray]) -> tuple[int, Sample]:
        """The frame to choose on: from the middle on the first with data that are not constant, or with any.

        Raises DataError where none has data.
        """
        constant: tuple[int, Sample] | None = None
        reason: DataError | None = None
        for t in [*range(count // 2, count), *range(count // 2)]:
            try:
                sample = self._sample(frame(t), Warnings(None))
            except DataError as error:
                reason = error
                continue
            if np.nanmin(sample.observed.values) < np.nanmax(sample.observed.values):
                return t, sample
            constant = constant or (t, sample)
        if constant is None:
            assert reason is not None
            raise reason
        return constant

    def _sample(self, data: np.ndarray, warnings: Warnings) -> Sample:
        """The data as channels on the band; raises DataError where none are valid."""
        with self.phases("extend"):
            observed = self._observed(data, warnings)
            if observed.kind != self.course.kind:  # else its re-extension is already prepared
                self.course = replace(self.course, kind=observed.kind)
            start = observed.start()
        missing = np.isnan(start.values[0, self.band.primary]).mean()
        if missing > LONE_SHARE:
            share = f"{100 * missing:.1f} %"
            warnings.add(f"{share} of the band lies on parts of the surface without any data: left missing")
        return Sample(self.course, observed, start)

    def _observed(self, data: np.ndarray, warnings: Warnings) -> Observed:
        """The data that count, as channels where they were measured."""
        here = without(self.places.take(data), self.settings.missing)
        here[self.trust == 0] = np.nan
        here = finite_or_missing(here, warnings)
        name = "scalar" if self.settings.independent else self.settings.kind
        kind, doubt = kind_of(name, here, self.settings.period)
        if doubt:
            warnings.add(doubt)
        return self.places.observe(here, kind, self.trust)

    def _run(
        self,
        data: np.ndarray,
        sample: Sample,
        plan: Plan,
        warnings: Warnings,
        observer: Observer | None,
        looks: bool,
    ) -> Result:
        settings, band, course, start = self.settings, self.band, sample.course, sample.start
        stop = None
        if settings.stop == "discrepancy" and plan.schedule.iterations:
            sigma = settings.noise_sigma or float(np.sqrt(np.mean(plan.noise**2)))
            if not sigma >= 0:
                raise DataError("stop discrepancy: the noise cannot be estimated from these data; give --noise-sigma S")
            if settings.noise_sigma is None and sample.looks_correlated:
                warnings.add(f"stop discrepancy: {CORRELATED}, which hides its size; give it as --noise-sigma S")
            stop = discrepancy(sample.observed, sigma)
        watch = _NoiseWatch(sample.observed, stop) if looks else None
        with self.phases("flow"):
            evolution, substeps = course.run(start, plan.flow, plan.schedule, observer, watch or stop)
            values, excess = _within_range(evolution.values, start, course.kind)
            values[:, sample.observed.beyond(start)] = np.nan
        if stop is not None and not evolution.iterations:
            warnings.add("stop discrepancy: the start values are as far from the data as the noise: nothing to do")
        if stop is not None and evolution.stop_reason != "discrepancy":
            warnings.add(
                f"stop discrepancy: after {evolution.iterations} iterations less is removed than the noise: "
                "is --noise-sigma in the unit of DATA?"
            )
        with self.phases("mesh"):
            at = [points(values, turns=course.kind.turns) for _, points in self.shown]
            if isinstance(sample.observed, AtVertices):
                at[0][:, sample.observed.too_far[: at[0].shape[1]]] = np.nan
        smoothness = sample.observed.smoothness_mm(), sample.observed.smoothness_mm(values)
        noise = watch.seen if watch else []
        ran = Ran(course.kind, sample.observed, start, evolution, substeps, values, excess, smoothness, noise)
        return self._result(
            self.places.give(values, at, course.kind, data),
            [course.kind.at_vertices(channels) for channels in at],
            self.places.filled(values, at, start, sample.observed),
            what_happened(settings, self.grid, band, plan, ran),
        )

    def _result(self, data: np.ndarray, shown: list[np.ndarray], filled: np.ndarray, record: dict[str, Any]) -> Result:
        mesh, on = None, shown
        if not self.settings.flat:
            mesh, on = replace(self.shown[0][0], values=shown[0]), shown[1:]
        return Result(data, mesh, filled, record, tuple(self.warnings.lines), tuple(on))

    def _nothing(self, data: np.ndarray) -> Result:
        """The result for a frame without data: everything missing."""
        values = np.full((1, self.band.entries), np.nan, data.dtype)
        at = [np.full((1, len(mesh.vertices_ras_mm)), np.nan, data.dtype) for mesh, _ in self.shown]
        out = self.places.give(values, at, Kind(), data)
        return self._result(out, [channels[0] for channels in at], np.zeros(data.shape, bool), {})


def _without_specks(mesh: Mesh, channels: np.ndarray) -> np.ndarray:
    """Channels (K, V), a vertex that lacks a value taking the mean of its neighbours, where most of them have one.

    In a tight sulcus the voxels around a vertex may all belong to the other bank.
    """
    edges = edges_of(mesh.cells) if mesh.cells.shape[1] == 3 else mesh.cells
    ends, others, count = edges.ravel(), edges[:, ::-1].ravel(), channels.shape[1]
    neighbours = np.bincount(ends, minlength=count)
    for _ in range(SPECK):
        lost = np.isnan(channels[0])
        known = np.bincount(ends, ~lost[others], minlength=count)
        specks = lost & (2 * known > neighbours)
        for channel in channels:
            sums = np.bincount(ends, np.where(lost, 0, channel)[others], count)
            channel[specks] = sums[specks] / known[specks]
    return channels


class _NoiseWatch:
    """Looks at the noise that is left after each of the first iterations, then after fewer and fewer of them.

    seen: pairs of how many iterations were done, and standard deviations as `noise.noise_sd` finds them.
    """

    def __init__(self, observed: Observed, stop: Stop | None) -> None:
        self.observed, self.stop = observed, stop
        self.seen: list[tuple[int, np.ndarray]] = []

    def __call__(self, k: int, u: np.ndarray) -> str | None:
        # All up to 16, then 8 in each doubling: a curve, at little cost however long the run.
        if k % (1 << (k // 16).bit_length()) == 0:
            self.seen.append((k, self.observed.noise_sd(u)))
        return self.stop(k, u) if self.stop is not None else None


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


def cpus() -> int:
    """CPUs that this process may use: a scheduler or container may grant fewer than the machine has."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1
