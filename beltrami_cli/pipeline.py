"""From files to files: check, read, denoise, write everything or nothing."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli import formats, kernels, report
from beltrami_cli.config import Job, Settings
from beltrami_cli.errors import BusyError, DataError, RefusedError
from beltrami_cli.evolve import Observer
from beltrami_cli.extension import own_samples
from beltrami_cli.grid import Canonical, Grid, Volume, require_same_grid, with_channels
from beltrami_cli.inputs import Warnings, band_of, require_usable, without
from beltrami_cli.kinds import kind_of
from beltrami_cli.levelset import two_values
from beltrami_cli.memory import needed, require_within
from beltrami_cli.progress import Phases
from beltrami_cli.record import sha256, sidecar, sources_of, write_record
from beltrami_cli.report.subject import Map, Subject
from beltrami_cli.resample import resample
from beltrami_cli.sampling import surface_mesh
from beltrami_cli.solver import Gathered, Result, Solver
from beltrami_cli.sources import is_segmentation, read_source
from beltrami_cli.surface import Mesh
from beltrami_cli.survey import REMEDY, Files, Scene, is_plane, pass_on, read, spacing_for, survey


def run(
    job: Job,
    *,
    observer: Observer | None = None,
    notify: Callable[[str], None] | None = None,
    unless: Callable[[], object] = lambda: None,
) -> Result:
    """Denoise files: read, check, denoise, write OUT, mesh and sidecar. Nothing is written unless everything is.

    notify: called with each warning as soon as it is known. unless: asked once no other run can write the outputs;
    where it says yes, BusyError is raised, for another run has just made them. Raises as `denoise`, and RefusedError,
    from the headers alone, where an output exists or cannot be written, or the grids differ. Frames of volumes that run
    independently stream through memory one at a time; the result then holds no data.
    """
    phases, warnings = Phases(), Warnings(notify)
    with phases("read"):
        scene = survey(job)
    files = Files(job, scene)
    if job.memory is not None:
        require_within(needed(job, scene), job.memory)
    sources = sources_of(job)
    inputs = [path for path, _ in sources]
    with formats.Stage(files.all, overwrite=job.overwrite, inputs=inputs) as stage:
        if unless():
            raise BusyError(f"{job.volume}: another run has just written it; nothing was done")
        phases.tell = stage.tell
        with phases("numba"):
            kernels.wake()
        with ThreadPoolExecutor(1) as pool:
            digests = pool.submit(lambda: [sha256(path) for path in inputs])
            if scene.at_vertices:
                work = _denoise_vertices
            else:
                work = _denoise_series if job.settings.independent else _denoise_volume
            solved, maps = work(job, scene, stage, phases, warnings, observer)
            hashes = digests.result()
        with phases("write"):
            for path in files.meshes:
                assert solved.mesh is not None
                shown = replace(solved.mesh, structure=scene.structure_of(solved.mesh))
                formats.write_mesh(stage.path(path), files.held_by(path, shown))
            for (_, path), mesh, values in zip(job.on, scene.on, solved.on, strict=True):
                formats.write_overlay(stage.path(path), values, structure=scene.structure_of(mesh))
        told = (job, sources, files.all, hashes, solved.record, tuple(warnings.lines), phases.seconds)
        if job.report is not None:
            with phases("report"):
                report.write(stage.path(job.report), _subject(job, scene, solved.mesh, maps, sidecar(*told)))
        record = sidecar(*told)
        write_record(stage.path(files.sidecar), record)
        stage.commit()
    return replace(solved, record=record, warnings=tuple(warnings.lines))


def _denoise_volume(
    job: Job, scene: Scene, stage: formats.Stage, phases: Phases, warnings: Warnings, observer: Observer | None
) -> tuple[Result, tuple[Map, ...]]:
    """The result, its volumes written, and what a picture is to show."""
    with phases("read"):
        source, trust = read_levelset(job, scene, warnings), _read_trust(job, warnings)
        data = read_data(job, scene, source, warnings, trust)
        if isinstance(source, Volume) and formats.volume_format(job.volume) != formats.volume_format(job.data):
            data = replace(data, header=source.header)
    solver = solver_on(source if isinstance(source, Volume) else data, job, scene, source, trust, phases, warnings)
    solved = solver.denoise(data.data, observer)
    with phases("write"):
        formats.write_volume(stage.path(job.volume), data.with_data(solved.data), dtype=job.settings.precision)
        if job.filled is not None:
            formats.write_volume(stage.path(job.filled), data.with_data(solved.filled), dtype=np.uint8)
    return solved, _maps(job, solver, data.data, solved.data, solved.mesh)


def _denoise_series(
    job: Job, scene: Scene, stage: formats.Stage, phases: Phases, warnings: Warnings, observer: Observer | None
) -> tuple[Result, tuple[Map, ...]]:
    """As `_denoise_volume`, frame by frame."""
    with phases("read"):
        source, trust = read_levelset(job, scene, warnings), _read_trust(job, warnings)
        psi = source if isinstance(source, Volume) else None
        series = formats.open_series(
            job.data,
            spacing=spacing_for(job.data, job.spacing),
            dtype=job.settings.precision,
            plane=is_plane(job, scene.grid),
        )
        pass_on(series, warnings)
    place = psi or scene.place
    like = replace(series, grid=place.grid)
    solver = solver_on(place, job, scene, source, trust, phases, warnings)

    def frame(t: int) -> np.ndarray:
        with phases("read"):
            data = _that_counts(Volume(series.frame(t), series.grid), trust, job)
            return _onto(data, place, job, f"DATA {job.data}").data

    record: dict[str, Any] = {}
    gathered = Gathered()
    shown: tuple[Map, ...] = ()

    def denoised() -> Iterator[np.ndarray]:
        nonlocal shown
        for t, result in enumerate(solver.denoise_frames(series.count, frame, record, observer)):
            gathered.add(result)
            if job.report is not None and t == record["Frames"]["chosen_on"]:
                shown = _maps(job, solver, frame(t), result.data, result.mesh)
            yield result.data

    formats.write_series(stage.path(job.volume), like, denoised(), dtype=job.settings.precision)
    solved = gathered.result(np.empty(0), record)
    if job.filled is not None:
        as_stored = with_channels(series.file_shape, series.count, 1) if like.grid.shape == series.grid.shape else ()
        filled = Volume(solved.filled, like.grid, as_stored, like.header)
        formats.write_volume(stage.path(job.filled), filled, dtype=np.uint8)
    return solved, shown


def _denoise_vertices(
    job: Job, scene: Scene, stage: formats.Stage, phases: Phases, warnings: Warnings, observer: Observer | None
) -> tuple[Result, tuple[Map, ...]]:
    """The result, its values at vertices written, and what a picture is to show."""
    assert scene.surface is not None
    count, dtype, several = len(scene.surface.vertices_ras_mm), job.settings.precision, job.settings.kind == "vector"
    with phases("read"):
        data, names = formats.read_named_overlay(job.data, count, dtype=dtype, channels=several, map=map_of(job))
        if several and data.ndim == 1:
            data = data[:, None]
        for path in (job.volume, *(file for _, file in job.on)):
            formats.require_overlay_writable(path, data.shape[1] if several else 1)
        weights, mask = (
            None if path is None else formats.read_overlay(path, count, dtype=dtype) for path in (job.weights, job.mask)
        )
    solver = Solver(
        scene.surface,
        scene.grid,
        job.settings,
        phases,
        warnings,
        weights,
        mask,
        at_vertices=True,
        on=scene.on,
        looks=job.report is not None,
    )
    work = solver.denoise_series if job.settings.independent else solver.denoise
    solved = work(data, observer)
    with phases("write"):
        structure = scene.structure_of(scene.surface)
        formats.write_overlay(stage.path(job.volume), solved.data, structure=structure, dtype=dtype, names=names)
        if job.filled is not None:
            formats.write_overlay(stage.path(job.filled), solved.filled.astype(np.float32), structure=structure)
    if not job.settings.independent:
        return solved, _maps(job, solver, data, None, solved.mesh)
    t = solved.record["Frames"]["chosen_on"]
    assert solved.mesh is not None and solved.mesh.values is not None
    return solved, _maps(job, solver, data[:, t], None, replace(solved.mesh, values=solved.mesh.values[:, t]))


def _maps(job: Job, solver: Solver, given: np.ndarray, out: np.ndarray | None, mesh: Mesh | None) -> tuple[Map, ...]:
    """Input and output as a picture shows them; none where no picture is asked for.

    given: what was denoised; out: what it became, where that is a volume. mesh: with the values of the output.
    """
    if job.report is None:
        return ()
    before, after = solver.at_mesh(given), None if mesh is None else mesh.values
    filled = None
    if before is not None and after is not None:
        filled = np.isnan(_first(before)) & ~np.isnan(_first(after))
    if out is None:
        return Map("input", before), Map("denoised", after, filled=filled)
    forth = Canonical(solver.grid).forth
    known = without(given, job.settings.missing)
    return Map("input", before, forth(parts(known))), Map("denoised", after, forth(parts(out)), filled)


def _first(values: np.ndarray) -> np.ndarray:
    """(V,) the first channel of values (V,) or (V, K)."""
    return values[:, 0] if values.ndim == 2 else values


def parts(volume: np.ndarray) -> np.ndarray:
    """Complex numbers as real and imaginary part on a last axis."""
    return np.stack([volume.real, volume.imag], -1) if np.iscomplexobj(volume) else volume


def _subject(job: Job, scene: Scene, mesh: Mesh | None, maps: tuple[Map, ...], record: dict[str, Any]) -> Subject:
    """What the picture of a run is about."""
    notes, frames, wrapped = [], record.get("Frames"), record["Values"]["range"]
    if frames is not None:
        notes.append(f"frame {frames['chosen_on'] + 1} of {frames['count']}: the one that parameters are chosen on")
    if job.settings.depth is not None:
        notes.append("input: as it is at the surface, before the average over depth")
    subject = Subject(
        title=job.data.name,
        maps=maps,
        mesh=None if mesh is None else replace(mesh, structure=scene.structure_of(mesh)),
        period=job.settings.period,
        low=0.0 if wrapped is None else wrapped[0],
        compares=True,
        difference="removed",
        record=record,
        notes=tuple(notes),
    ).in_one_range()
    return subject if maps[0].volume is None else in_space(subject, scene.grid, job.data)


def in_space(subject: Subject, grid: Grid, data: Path) -> Subject:
    """A subject with volumes, on this grid before its axes were brought to those of RAS, as a file has them."""
    kind = formats.volume_format(data)
    return replace(subject, grid=Canonical(grid).grid, has_anatomy=kind not in ("NPY", "PNG"), rows_down=kind == "PNG")


def map_of(job: Job) -> str | int | None:
    """Which of several maps of DATA at vertices is meant: its name, or its number from 1."""
    return int(job.map) if job.map is not None and job.map.isdecimal() else job.map


def read_data(
    job: Job, scene: Scene, source: Volume | Mesh | None, warnings: Warnings, trust: Mapping[str, Volume]
) -> Volume:
    """DATA, a volume, on the grid to compute on. source, trust: LEVELSET, weights and mask, as they were read."""
    plane = is_plane(job, scene.grid)
    data = read(job, job.data, warnings, channels=job.settings.kind == "vector", plane=plane)
    place = source if isinstance(source, Volume) else scene.place
    return _onto(_that_counts(data, trust, job), place, job, f"DATA {job.data}", period=job.settings.period)


def solver_on(
    place: Volume,
    job: Job,
    scene: Scene,
    source: Volume | Mesh | None,
    trust: Mapping[str, Volume],
    phases: Phases,
    warnings: Warnings,
) -> Solver:
    """The solver on the grid of `place`, onto which weights and mask are brought. source: LEVELSET as it was read."""
    with phases("read"):
        here = {name: _onto(volume, place, job, name).data for name, volume in trust.items()}
        weights, mask = here.get("weights"), here.get("mask")
    if mask is not None:
        mask = np.nan_to_num(mask) >= 0.5  # between voxels, where it was moved
    surface = source.data if isinstance(source, Volume) else source
    looks = job.report is not None
    return Solver(surface, place.grid, job.settings, phases, warnings, weights, mask, on=scene.on, looks=looks)


def mesh_of(
    levelset: Path,
    data: Path | None = None,
    *,
    spacing: tuple[float, ...] | None = None,
    bring: bool = False,
    inside: str = "negative",
    period: float | None = None,
) -> Mesh:
    """The surface of a level set in RAS mm, with the data as they are at its vertices (NaN where missing).

    bring: resample the data onto the level set's grid. period: of data that are angles. Raises as `run`.
    """
    psi = formats.read_volume(levelset, spacing=spacing_for(levelset, spacing))
    require_usable(psi.grid, str(levelset))
    if is_segmentation(psi.data) and two_values(psi.data) is None:
        raise RefusedError(
            f"{levelset}: holds labels, no level set; expected one, or a mask: make it with beltrami levelset --labels"
        )
    axes = Canonical(psi.grid)
    band = band_of(psi.data, Settings(inside=inside), axes, Warnings(None))
    if data is None:
        return surface_mesh(band)[0]
    flat = 1 in psi.grid.shape
    several = period is None
    volume = formats.read_volume(data, spacing=spacing_for(data, spacing), channels=several, plane=several and flat)
    if bring:
        volume = resample(volume, psi.grid, period=period)
    require_same_grid(psi.grid, f"LEVELSET {levelset}", volume.grid, f"DATA {data}", remedy=REMEDY)
    here = band.gather(axes.forth(volume.data))
    kind = kind_of("circular" if period else "vector", here, period)[0]
    own = own_samples(band, kind.to_channels(here))
    mesh, values = surface_mesh(band, own, turns=kind.turns)
    assert values is not None
    if not np.isfinite(values).any():
        raise DataError(f"DATA {data} has no value on the surface: found only NaN there; drop it for a bare mesh")
    return replace(mesh, values=kind.at_vertices(values))


def read_levelset(job: Job, scene: Scene, warnings: Warnings) -> Volume | Mesh | None:
    """LEVELSET as a level set or, where it is a surface or a segmentation, as a mesh; None for a flat run."""
    if job.levelset is None or scene.surface is not None:
        return scene.surface
    if 1 in scene.grid.shape:
        return read(job, job.levelset, warnings)
    source = read_source(
        job.levelset,
        labels=job.labels,
        between=job.between,
        spacing=spacing_for(job.levelset, job.spacing),
        dtype=job.settings.precision,
        notify=warnings.add,
    )
    if isinstance(source, Volume):
        pass_on(source, warnings)
    elif job.settings.inside == "positive":
        volume = read(job, job.levelset, warnings)
        mask = two_values(volume.data)
        if mask is None or mask[0] >= 0 or not volume.grid.matches(scene.grid):
            raise RefusedError(f"inside: is for a level set; found LEVELSET {job.levelset}, a segmentation; drop it")
        return volume
    return source


def _read_trust(job: Job, warnings: Warnings) -> dict[str, Volume]:
    """What says how much data count: "weights" as they are, "mask" as 1 where it is not 0; those there are."""
    trust = {}
    if job.weights is not None:
        trust["weights"] = read(job, job.weights, warnings)
    if job.mask is not None:
        mask = read(job, job.mask, warnings)
        trust["mask"] = mask.with_data((np.nan_to_num(mask.data) != 0).astype(mask.data.dtype))
    return trust


def _that_counts(data: Volume, trust: Mapping[str, Volume], job: Job) -> Volume:
    """Data that are to be resampled, NaN where missing, and where a mask or weights on their own grid exclude them."""
    if not job.resample:
        return data
    values = without(data.data, job.settings.missing).copy()
    for other in trust.values():
        if other.grid.matches(data.grid):
            values[~(other.data > 0)] = np.nan
    return replace(data, data=values)


def _onto(volume: Volume, place: Volume | None, job: Job, name: str, *, period: float | None = None) -> Volume:
    """The volume on the grid of another; missing values are not mixed with others on the way."""
    if place is None or not job.resample or volume.grid.matches(place.grid):
        return volume
    moved = resample(volume, place.grid, period=period)
    if not np.isfinite(moved.data).any():
        raise DataError(
            f"{name}: has no value on the grid of {job.levelset}: found no overlap in world space, "
            "expected volumes of one head in one space"
        )
    if moved.channels > 1:  # what the header says of frames goes with them
        return Volume(moved.data, place.grid, (), volume.header)
    return Volume(moved.data, place.grid, place.file_shape, place.header)
