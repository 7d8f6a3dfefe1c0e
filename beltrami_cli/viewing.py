"""Pictures of maps as they are: any volumes on a level set, values at vertices, or meshes that hold values."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from beltrami_cli import formats, report
from beltrami_cli.config import Beta, Job, Settings, parse_period
from beltrami_cli.errors import RefusedError
from beltrami_cli.grid import Canonical, Volume, require_same_grid
from beltrami_cli.inputs import Warnings, without
from beltrami_cli.pipeline import in_space, map_of, parts, read_data, read_levelset, solver_on
from beltrami_cli.progress import Phases
from beltrami_cli.report.colours import require_map
from beltrami_cli.report.geometry import SIDES
from beltrami_cli.report.subject import Map, Subject
from beltrami_cli.solver import Solver
from beltrami_cli.surface import Mesh
from beltrami_cli.survey import REMEDY, Scene, survey

# A job names an output. This one's is never written; its format holds any number of channels.
_NOWHERE = Path("view.nii.gz")


@dataclass(frozen=True)
class View:
    """What to look at: maps side by side on one surface.

    files: volumes on one grid, values at the vertices of `levelset`, which then is a mesh, or, without `levelset`,
    meshes that hold values on the same triangles; volumes without `levelset` are shown as slices alone. titles: of the
    maps, in their order; none for the names of the files. compare: there are two maps, and their difference is shown.
    period: of angles. side: from where the surface is seen, a name in `report.geometry.SIDES`. colours: the name of a
    colour map. Everything else as in `config.Job` and `config.Settings`.

    Raises RefusedError where the numbers of files and titles do not fit.
    """

    files: tuple[Path, ...]
    output: Path
    levelset: Path | None = None
    titles: tuple[str, ...] = ()
    compare: bool = False
    side: str | None = None
    colours: str | None = None
    period: float | None = None
    missing: float | None = None
    inside: str = "negative"
    labels: str | None = None
    between: str | None = None
    map: str | None = None
    frame: str | None = None
    spacing: tuple[float, ...] | None = None
    resample: bool = False
    overwrite: bool = False

    def __post_init__(self) -> None:
        if not self.files:
            raise RefusedError("VOLUME is missing: beltrami view VOLUME --levelset PSI -o FILE.html")
        if self.compare and len(self.files) != 2:
            raise RefusedError(f"compare: found {len(self.files)} files; expected two: --compare A B")
        if self.titles and len(self.titles) != len(self.files):
            raise RefusedError(f"titles: found {len(self.titles)}; expected {len(self.files)}, one for each file")
        if self.side not in (None, *SIDES):
            raise RefusedError(f"side: found {self.side!r}; expected one of {', '.join(SIDES)}")
        if self.period is not None:
            object.__setattr__(self, "period", parse_period(self.period))

    @property
    def names(self) -> tuple[str, ...]:
        """The title of each map: where files of several folders have one name, with the folder's."""
        if self.titles:
            return self.titles
        short = [formats.stem(file).name for file in self.files]
        if len(set(short)) == len(short):
            return tuple(short)
        return tuple(f"{file.absolute().parent.name}/{name}" for file, name in zip(self.files, short, strict=True))


def look(view: View, *, notify: Callable[[str], None] | None = None) -> Subject:
    """Write the picture, and give what it shows.

    notify: called with each warning. Raises as `denoise` does for its inputs, and RefusedError for an output that
    exists or is neither .html nor .png.
    """
    report.require(view.output)
    if view.colours is not None:
        require_map(view.colours)
    inputs = [*view.files, *([view.levelset] if view.levelset else [])]
    for path in inputs:
        formats.require_file(path)
    with formats.Stage([view.output], overwrite=view.overwrite, inputs=inputs) as stage:
        warnings = Warnings(notify)
        subject = _meshes(view) if _are_meshes(view) else _maps(view, warnings)
        report.write(stage.path(view.output), subject)
        stage.commit()
    return subject


def _are_meshes(view: View) -> bool:
    return view.levelset is None and all(formats.is_surface(file) for file in view.files)


def _meshes(view: View) -> Subject:
    """Meshes with the values that they hold."""
    for name in ("labels", "between", "spacing"):
        if getattr(view, name) is not None:
            raise RefusedError(f"{name}: is for volumes; found meshes alone; drop it")
    first: Mesh | None = None
    maps = []
    for file, title in zip(view.files, view.names, strict=True):
        curve = formats.read_curve(file)
        mesh = formats.read_surface(file, frame=view.frame) if curve is None else curve
        first = first or mesh
        if mesh.cells.shape != first.cells.shape or not np.array_equal(mesh.cells, first.cells):
            raise RefusedError(
                f"{file}: {len(mesh.cells)} cells; expected those of {view.files[0]}, {len(first.cells)} in the same "
                "order: maps are shown side by side on one surface"
            )
        columns = list(formats.read_values(file).values())
        values = np.stack(columns, -1) if columns else np.full((len(mesh.vertices_ras_mm), 1), np.nan)
        maps.append(Map(title, without(values, view.missing)))
    _require_as_many([each.values for each in maps if each.values is not None], axes=1)
    return _subject(view, maps, first)


def _maps(view: View, warnings: Warnings) -> Subject:
    """Volumes or values at vertices, on the surface of the level set, if any."""
    jobs = [_job(view, file) for file in view.files]
    scenes = [survey(job) for job in jobs]
    if len({scene.at_vertices for scene in scenes}) > 1:
        raise RefusedError("VOLUME: found volumes and values at vertices; expected files of one kind")
    if not scenes[0].at_vertices:
        return _volumes(view, list(zip(jobs, scenes, strict=True)), warnings)
    surface = scenes[0].surface
    assert surface is not None
    maps = []
    for job, title in zip(jobs, view.names, strict=True):
        values = formats.read_overlay(job.data, len(surface.vertices_ras_mm), channels=True, map=map_of(job))
        which = "" if view.map is None or view.titles else f": {view.map}"
        maps.append(Map(title + which, without(values, view.missing)))
    _require_as_many([each.values for each in maps if each.values is not None], axes=1)
    return _subject(view, maps, replace(surface, structure=scenes[0].structure_of(surface)))


def _volumes(view: View, jobs: Sequence[tuple[Job, Scene]], warnings: Warnings) -> Subject:
    """Volumes on one grid; the surface's own values are those of the voxels beside it."""
    first, scene = jobs[0]
    source = read_levelset(first, scene, warnings)
    given = [read_data(job, seen, source, warnings, {}) for job, seen in jobs]
    place = source if isinstance(source, Volume) else given[0]
    for job, data in zip(jobs, given, strict=True):
        require_same_grid(given[0].grid, f"VOLUME {first.data}", data.grid, f"VOLUME {job[0].data}", remedy=REMEDY)
    _require_as_many([data.data for data in given], axes=3)
    solver = solver_on(place, first, scene, source, {}, Phases(), warnings)
    axes = Canonical(place.grid)
    maps = []
    for title, data in zip(view.names, given, strict=True):
        shown = axes.forth(parts(without(data.data, view.missing)))
        maps.append(Map(title, _at_mesh(solver, data.data), shown))
    mesh = None if first.levelset is None else solver.shown[0][0]
    return in_space(_subject(view, maps, mesh), place.grid, first.data)


def _at_mesh(solver: Solver, data: np.ndarray) -> np.ndarray | None:
    """Values of a volume at the vertices, of several channels each on its own: what one lacks the others may have."""
    if not solver.settings.independent or solver.settings.flat:
        return solver.at_mesh(data)
    frames = [solver.at_mesh(data[..., k]) for k in range(data.shape[-1])]
    return np.stack([frame for frame in frames if frame is not None], -1)


def _job(view: View, file: Path) -> Job:
    """What denoise would be asked, so that the same files are read in the same way."""
    count, is_complex = (1, False) if formats.is_overlay(file) else _layout(view, file)
    several = count > 1 or is_complex
    settings = Settings(
        flat=view.levelset is None,
        kind="circular" if view.period else "vector" if several else "scalar",
        period=view.period,
        independent=several and not is_complex,
        missing=view.missing,
        inside=view.inside,
        beta=Beta((0.0,)),
    )
    same = ("levelset", "labels", "between", "map", "frame", "spacing", "resample")
    return Job(data=file, volume=_NOWHERE, mesh=(), settings=settings, **{name: getattr(view, name) for name in same})


def _layout(view: View, file: Path) -> tuple[int, bool]:
    """How many channels or frames a volume has, and whether they are complex; of angles it is to have one."""
    if view.period is not None or formats.is_surface(file):
        return 1, False
    return formats.read_layout(file, plane=view.levelset is None or _is_plane(view.levelset))


def _is_plane(levelset: Path) -> bool:
    return not formats.is_surface(levelset) and 1 in formats.read_grid(levelset).shape


def _require_as_many(arrays: Sequence[np.ndarray], axes: int) -> None:
    """Raise RefusedError unless all have as many channels, of one kind, behind the first `axes` axes."""
    found = [(*(array.shape[axes:] or (1,)), "complex" if np.iscomplexobj(array) else "real") for array in arrays]
    if len(set(found)) > 1:
        told = ", ".join(f"{count} {kind}" for count, kind in found)
        raise RefusedError(f"channels or frames differ: found {told}; expected as many in each file")


def _subject(view: View, maps: Sequence[Map], mesh: Mesh | None) -> Subject:
    """Angles run from 0 or, where some are negative, from minus half a period, as `kinds.kind_of` has it."""
    low = 0.0
    if view.period is not None:
        values = [m.volume if m.values is None else m.values for m in maps]
        low = -view.period / 2 if any(np.nanmin(v, initial=0.0) < 0 for v in values if v is not None) else 0.0
    return Subject(
        title=" and ".join(view.names) if len(maps) < 3 else "",
        maps=tuple(maps),
        mesh=mesh,
        period=view.period,
        low=low,
        compares=view.compare,
        difference=" − ".join(view.names) if view.compare else "",
        side=view.side,
        colours=view.colours,
    ).in_one_range()
