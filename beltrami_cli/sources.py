"""Whatever a surface is given as: a level-set volume, a segmentation or a mesh; and the level set of any of them."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike

from beltrami_cli import formats
from beltrami_cli.distance import HALF_WIDTH, MARGIN, own_grid, signed_distance
from beltrami_cli.errors import DataError, RefusedError
from beltrami_cli.grid import Canonical, Grid, Volume
from beltrami_cli.inputs import Warnings, require_usable
from beltrami_cli.levelset import crossing_box, facing, sampled, two_values, zero_surface
from beltrami_cli.record import provenance, sha256, sidecar_of, write_record
from beltrami_cli.repair import repaired
from beltrami_cli.segmentation import Labels, surface_of_labels
from beltrami_cli.surface import Mesh


@dataclass(frozen=True)
class LevelSet:
    """A signed distance in mm, lines for the user about it; for a record the options as used, and what SOURCE was."""

    volume: Volume
    notes: tuple[str, ...]
    used: dict[str, Any]
    surface: dict[str, Any]


def read_source(
    path: Path,
    *,
    labels: str | None = None,
    between: str | None = None,
    frame: str | None = None,
    like: Grid | None = None,
    spacing: tuple[float, ...] | None = None,
    dtype: DTypeLike = np.float32,
    notify: Callable[[str], None] | None = None,
    beyond: float = 0.0,
) -> Volume | Mesh:
    """A level-set volume as it is; the surface of a segmentation, or of a surface file, as a mesh in RAS mm.

    labels: which voxels of a segmentation are inside, as "2,41" or "5-255". between: the surface then lies midway
        between two boundaries, "INNER,OUTER", each of them one label or several as in "2+41,0".
    A volume is a segmentation where either is given, where it holds two values, one of them 0 or more (inside is what
    it marks: the higher one, or that below 0), or where it holds non-negative whole numbers only.
    frame, like: see `formats.read_surface`. spacing, dtype: see `formats.read_volume`.
    notify: told what the reader has to say of a segmentation's file; a level set has it in its notes.
    beyond: mm by which a segmentation is continued beyond the faces of its volume, as its outermost voxels are.

    Raises RefusedError as `formats.read_volume` and `formats.read_surface` do; where labels are not wanted, not given
    (the message names those that are there) or absent; DataError where the content cannot be used.
    """
    path = Path(path)
    if labels is not None and between is not None:
        raise RefusedError("--labels and --between both say where the surface is; give one of them")
    wanted = None if labels is None else parse_labels(labels)
    sides = None if between is None else parse_between(between)
    if formats.is_surface(path):
        if wanted or sides:
            raise RefusedError(f"{path}: is a surface, which has no labels; drop --labels and --between")
        return formats.read_surface(path, frame=frame, like=like)
    if frame is not None:
        raise RefusedError(f"{path}: --frame is for surface files; found a volume, whose header says where it is")
    volume = formats.read_volume(path, spacing=spacing, dtype=dtype)
    if not (wanted or sides or is_segmentation(volume.data)):
        return volume
    if notify:
        for line in volume.notes:
            notify(line)
    return _surface_in(path, _continued(volume, beyond, "edge"), wanted, sides)


def read_levelset(
    path: Path,
    *,
    labels: str | None = None,
    between: str | None = None,
    frame: str | None = None,
    like: Path | None = None,
    spacing: tuple[float, ...] | None = None,
    margin: float | None = None,
) -> LevelSet:
    """The signed distance to the surface that `path` holds, see `distance.signed_distance`.

    On the grid of `like`; else on that of the volume itself; else on one around the surface (`distance.own_grid`) of
    cubic voxels of `spacing` mm and with a `margin` in mm. spacing is otherwise that of the .npy files among the two.
    A level-set volume is measured anew. Raises as `read_source`, and for options without a use.
    """
    giver = like or (None if formats.is_surface(path) else path)
    place = None if giver is None else _place(giver, spacing)
    _check_options(path, like, giver, spacing, margin)
    notes = list(place.notes if place else ())
    # As far as the level set reaches, so that the surface does not end where the volume does.
    beyond = 0.0 if like or not place else MARGIN * float(place.grid.spacing.max())
    source = read_source(
        path,
        labels=labels,
        between=between,
        frame=frame,
        like=place.grid if place else None,
        spacing=spacing if formats.is_npy(path) else None,
        notify=notes.append,
        beyond=beyond,
    )
    if isinstance(source, Volume):
        was, mesh = "level set", surface_of(_continued(source, beyond, "reflect", reflect_type="odd"))
        notes += source.notes
    else:
        was, mesh = "surface" if formats.is_surface(path) else "segmentation", source
    surface = repaired(mesh, as_faced=was != "surface")  # one made from a volume faces as it is meant to
    if place is None:
        grid = own_grid(surface, spacing[0] if spacing else None, margin)
        spacing = (float(grid.spacing[0]),)
        margin = MARGIN * spacing[0] if margin is None else margin
    else:
        grid = place.grid
    half_width = HALF_WIDTH * float(grid.spacing.max())
    psi = signed_distance(surface, grid, half_width)
    if np.isnan(psi).any():
        notes.append(f"{path}: the surface has a border: its level set is NaN beyond it, and far from the surface")
    used = {"labels": labels, "between": between, "frame": frame, "spacing": spacing, "margin": margin}
    return LevelSet(
        Volume(psi, grid, (), place.header if place else None),
        tuple(dict.fromkeys(notes)),
        {**used, "half_width": half_width},
        {"made_of": was, "vertices": len(mesh.vertices_ras_mm), "closed": surface.is_closed},
    )


def write_levelset(
    path: Path,
    output: Path,
    *,
    labels: str | None = None,
    between: str | None = None,
    frame: str | None = None,
    like: Path | None = None,
    spacing: tuple[float, ...] | None = None,
    margin: float | None = None,
    overwrite: bool = False,
    notify: Callable[[str], None] | None = None,
) -> dict[str, Any]:
    """Write what `read_levelset` gives, and a record beside it; returns the record.

    notify: called with each warning. Raises as `read_levelset`, and RefusedError where an output is refused.
    """
    files = [*formats.volume_files(output), sidecar_of(output)]
    roles = {path: "source"} | ({like: "like"} if like else {})
    inputs = [file for given in roles for file in formats.input_files(given)]
    with formats.Stage(files, overwrite=overwrite, inputs=inputs) as stage:
        found = read_levelset(
            path, labels=labels, between=between, frame=frame, like=like, spacing=spacing, margin=margin
        )
        warnings = Warnings(notify)
        for line in found.notes:
            warnings.add(line)
        if formats.is_npy(output) and not np.allclose(found.volume.grid.spacing, 1):
            steps = ",".join(f"{h:.6g}" for h in found.volume.grid.spacing)
            warnings.add(f"{output}: keeps no voxel size; give --spacing {steps} with it")
        formats.write_volume(stage.path(output), found.volume)
        read = [(file, sha256(file), roles.get(file)) for file in inputs]
        record = provenance(read, files, found.used, warnings.lines) | _described(found)
        write_record(stage.path(files[-1]), record)
        stage.commit()
    return record


def _described(found: LevelSet) -> dict[str, Any]:
    psi, grid = found.volume.data, found.volume.grid
    return {
        "Surface": found.surface,
        "Grid": grid.as_record(),
        "Voxels": {
            "inside": int((psi < 0).sum()),
            "outside": int((psi >= 0).sum()),
            "unknown": int(np.isnan(psi).sum()),
        },
    }


def _place(path: Path, spacing: tuple[float, ...] | None) -> formats.Series:
    """Grid, header and notes of the volume whose grid the level set is to have, of any number of frames."""
    if formats.is_surface(path):
        raise RefusedError(f"--like {path}: is a surface; expected a volume, for its grid")
    place = formats.open_series(path, spacing=spacing if formats.is_npy(path) else None)
    require_usable(place.grid, str(path))
    if 1 in place.grid.shape:
        raise RefusedError(f"{path}: is a plane; expected a volume around a surface")
    return place


def _check_options(
    path: Path, like: Path | None, giver: Path | None, spacing: tuple[float, ...] | None, margin: float | None
) -> None:
    """Raise RefusedError for options without a use or a sense."""
    if margin is not None and not margin >= 0:
        raise RefusedError(f"--margin: found {margin:g}; expected 0 mm or more")
    if margin is not None and giver:
        raise RefusedError(f"--margin is for a grid around a surface; the level set has that of {giver}; drop it")
    if spacing and giver and not any(formats.is_npy(file) for file in (path, like) if file):
        raise RefusedError(
            f"--spacing is for a grid around a surface, and for .npy files; the level set has the grid of {giver}; "
            "drop it"
        )
    if spacing and not giver and len(spacing) > 1:
        raise RefusedError(f"--spacing: found {spacing}; expected one number: a grid around a surface has cubes")


def surface_of(volume: Volume) -> Mesh:
    """The zero level of a level-set volume as a mesh in RAS mm, facing increasing Psi; DataError where it has none."""
    canonical = Canonical(volume.grid)
    psi, grid = canonical.forth(volume.data), canonical.grid
    box = crossing_box(psi, (1, 1, 1))
    surface = zero_surface(psi[box], grid.spacing)
    ijk = surface.points / grid.spacing + [part.start for part in box]
    return Mesh(grid.to_world(ijk), facing(surface.cells, grid))


def is_segmentation(data: np.ndarray) -> bool:
    """True where data, NaN aside, are a mask or labels and no level set, see `read_source`; a constant is neither."""
    if values := two_values(data):
        return bool(values[1] >= 0)
    some = sampled(data)
    if (some < 0).any() or (some != np.rint(some)).any():
        return False
    finite = data[np.isfinite(data)]
    return bool(finite.size and finite.min() >= 0 and np.ptp(finite) > 0 and np.all(finite == np.rint(finite)))


def parse_labels(given: str, separator: str = ",") -> Labels:
    """Labels from "2,41" or "5-255"; raises RefusedError for anything else."""
    pairs = []
    for part in given.split(separator):
        match = re.fullmatch(r"\s*(\d+)(?:-(\d+))?\s*", part)
        if not match or int(match[2] or match[1]) < int(match[1]):
            raise RefusedError(f"labels: found {given!r}; expected whole numbers or ranges of them, as 2,41 or 5-255")
        pairs.append((int(match[1]), int(match[2] or match[1])))
    return tuple(pairs)


def parse_between(given: str) -> tuple[Labels, Labels]:
    """The labels of two regions from "INNER,OUTER", joined by + in each; raises RefusedError for anything else."""
    parts = given.split(",")
    if len(parts) != 2:
        raise RefusedError(f"between: found {given!r}; expected INNER,OUTER, each of them labels joined by +: 2+41,0")
    return parse_labels(parts[0], "+"), parse_labels(parts[1], "+")


def _surface_in(path: Path, volume: Volume, wanted: Labels | None, sides: tuple[Labels, Labels] | None) -> Mesh:
    """The surface of a segmentation; raises as `surface_of_labels`, and RefusedError where it holds no labels."""
    data = volume.data
    found = np.unique(data[np.isfinite(data)])
    if two_values(found) is None and not np.array_equal(found, np.rint(found)):
        raise RefusedError(
            f"{path}: holds values from {found[0]:.4g} to {found[-1]:.4g} that are no whole numbers: no labels, but a "
            "level set or an image; drop --labels and --between, or give the segmentation"
        )
    marked_negative = not (wanted or sides) and found[0] < 0
    try:
        return surface_of_labels(-data if marked_negative else data, volume.grid, labels_inside=wanted, between=sides)
    except (DataError, RefusedError) as error:
        raise type(error)(f"{path}: {error}") from None


def _continued(volume: Volume, mm: float, mode: Any, **options: Any) -> Volume:
    """The volume with voxels around it, `mm` wide, filled as `np.pad` does."""
    if not mm:
        return volume
    voxels = np.ceil(mm / volume.grid.spacing).astype(int)
    data = np.pad(volume.data, [(n, n) for n in voxels], mode, **options)
    affine = volume.grid.affine.copy()
    affine[:3, 3] -= affine[:3, :3] @ voxels
    a, b, c = data.shape
    return replace(volume, data=data, grid=Grid((a, b, c), affine), file_shape=())
