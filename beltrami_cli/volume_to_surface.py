"""A volume's values at the vertices of a user's own surface: from files to a file."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli import formats
from beltrami_cli.config import Settings
from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.grid import Grid, Volume, extent
from beltrami_cli.inputs import Warnings, without
from beltrami_cli.kinds import kind_of
from beltrami_cli.record import provenance, sha256, sidecar_of, write_record
from beltrami_cli.resample import at_points
from beltrami_cli.surface import Mesh


@dataclass(frozen=True)
class Sampling:
    """What to sample onto what, and how; the fields are the options of `beltrami sample`.

    frame: of the surface's coordinates, "scanner" or "tkr", None for what the file says. structure: in GIFTI's names,
    None for the surface's own. spacing: mm, of an NPY volume.
    Raises RefusedError where kind, period and missing make no sense together, as `denoise` does.
    """

    volume: Path
    surface: Path
    output: Path
    kind: str = "scalar"
    period: float | None = None
    missing: float | None = None
    frame: str | None = None
    structure: str | None = None
    spacing: tuple[float, ...] | None = None
    overwrite: bool = False

    def __post_init__(self) -> None:
        checked = Settings(kind=self.kind, period=self.period, missing=self.missing)
        object.__setattr__(self, "missing", checked.missing)

    @property
    def sidecar(self) -> Path:
        return sidecar_of(self.output)

    @property
    def sources(self) -> dict[Path, str]:
        """Every file that is read, and what it is."""
        return {**dict.fromkeys(formats.input_files(self.volume), "volume"), self.surface: "surface"}


def sample(job: Sampling, *, notify: Callable[[str], None] | None = None) -> dict[str, Any]:
    """Write the volume's values at the surface's vertices, in their order, and a record of it; returns the record.

    Values are interpolated in world space as by `resample.at_points`: NaN where the volume has none. notify: called
    with each warning. Raises RefusedError where an output or an option is refused, DataError where a file cannot be
    read or the volume has no value at any vertex.
    """
    warnings = Warnings(notify)
    structure = None if job.structure is None else formats.parse_structure(job.structure)
    files = [*formats.overlay_files(job.output), job.sidecar]
    with formats.Stage(files, overwrite=job.overwrite, inputs=job.sources) as stage:
        volume = _read_volume(job, warnings)
        mesh = formats.read_surface(job.surface, frame=job.frame, like=volume.grid)
        near = _in_nearest_voxels(volume, mesh)
        if job.kind == "circular" and (doubt := kind_of(job.kind, near, job.period)[1]):
            warnings.add(doubt)
        values = at_points(volume, mesh.vertices_ras_mm, period=job.period)
        if np.iscomplexobj(values):
            values = np.stack([values.real, values.imag], -1)
        counts = _counted(job, values, len(near), volume.grid, mesh, warnings)
        structure = structure or mesh.structure
        formats.write_overlay(stage.path(job.output), values, structure=structure)
        record = _record(job, files, structure, volume.grid, counts, warnings)
        write_record(stage.path(job.sidecar), record)
        stage.commit()
    return record


def _read_volume(job: Sampling, warnings: Warnings) -> Volume:
    volume = formats.read_volume(job.volume, spacing=job.spacing, channels=job.kind == "vector")
    if 1 in volume.grid.shape:
        raise RefusedError(f"{job.volume}: is a plane; expected a volume around a surface")
    parts = 2 if np.iscomplexobj(volume.data) else 1
    formats.require_overlay_writable(job.output, parts * volume.channels)
    for note in volume.notes:
        warnings.add(note)
    return volume.with_data(without(volume.data, job.missing))


def _in_nearest_voxels(volume: Volume, mesh: Mesh) -> np.ndarray:
    """Values (N,) or (N, K) of the voxels that hold the vertices, of those N that lie in the volume."""
    index = np.rint(volume.grid.to_index(mesh.vertices_ras_mm)).astype(int)
    inside = np.all((index >= 0) & (index < volume.grid.shape), axis=1)
    return volume.data[tuple(index[inside].T)]


def _counted(
    job: Sampling, values: np.ndarray, inside: int, grid: Grid, mesh: Mesh, warnings: Warnings
) -> dict[str, int]:
    """How many vertices there are, have a value, and lie outside the volume; raises DataError where none has one."""
    total = len(values)
    found = int(np.isfinite(values.reshape(total, -1)).any(1).sum())
    where = f"vertices within {extent(mesh.vertices_ras_mm)}, voxels within {extent(grid.corners())} (RAS)"
    remedy = "are both of one space? --frame tkr or scanner says which coordinates those of the surface are"
    if found == 0:
        here = "none lies in the volume" if inside == 0 else f"the {inside} in the volume meet missing values only"
        raise DataError(
            f"{job.volume}: has no value at the {total} vertices of {job.surface}: {here}; {where}; {remedy}"
        )
    if inside < total:
        warnings.add(
            f"{total - inside} of {total} vertices of {job.surface} lie outside {job.volume}, and get no value: "
            f"{where}; {remedy}"
        )
    return {"vertices": total, "with_value": found, "outside_volume": total - inside}


def _record(
    job: Sampling, files: list[Path], structure: str | None, grid: Grid, counts: dict[str, int], warnings: Warnings
) -> dict[str, Any]:
    """The sidecar, with names as in that of `denoise`."""
    names = ("kind", "period", "missing", "frame", "spacing")
    parameters = {name: getattr(job, name) for name in names} | {"structure": structure}
    sources = [(path, sha256(path), role) for path, role in job.sources.items()]
    return {
        **provenance(sources, files, parameters, warnings.lines),
        "Grid": grid.as_record(),
        "Vertices": counts,
    }
