"""How two files, or the files of two folders, differ: volumes, meshes and values at vertices."""

from __future__ import annotations

import os
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from fnmatch import fnmatchcase
from functools import cached_property
from pathlib import Path
from typing import Any, Literal

import numpy as np

from beltrami_cli import formats
from beltrami_cli.config import Settings
from beltrami_cli.errors import BeltramiError, RefusedError, in_a_line
from beltrami_cli.grid import Canonical, Volume, require_same_grid
from beltrami_cli.inputs import Warnings, band_of, require_usable
from beltrami_cli.metrics import (
    Difference,
    Distance,
    NoValues,
    Tolerances,
    difference,
    distance_between,
    require_scales,
)
from beltrami_cli.surface import Mesh

REMEDY = "bring them onto one grid first, for example with denoise --resample"

Kind = Literal["volume", "mesh", "metric"]
WORDS: dict[Kind, str] = {"volume": "a volume", "mesh": "a mesh", "metric": "values at vertices"}


@dataclass(frozen=True, eq=False)
class Near:
    """Where volumes are looked at: near the zero level of the level set `psi`, called `name`, up to `reach` mm."""

    name: str
    psi: Volume
    reach: float

    @cached_property
    def mask(self) -> np.ndarray:
        """True at the voxels within reach; found at first use. Raises DataError where there is no zero level."""
        require_usable(self.psi.grid, self.name)
        axes = Canonical(self.psi.grid)
        # Wider than what is looked at: a band's own rim is where the nearest vertex, not the surface, is in reach.
        half_width = self.reach + 1.5 * float(self.psi.grid.used_spacing.max())
        band = band_of(self.psi.data, Settings(band=half_width), axes, Warnings(None))
        distance = axes.back(band.scatter(np.abs(band.distance), np.inf))
        return np.asarray(distance <= self.reach)


@dataclass(frozen=True)
class Terms:
    """How values are compared: volumes near a surface only; angles of this period; full scale for PSNR, data units.

    Raises RefusedError for a period or full scale that is not a finite number above 0.
    """

    near: Near | None = None
    period: float | None = None
    data_range: float | None = None

    def __post_init__(self) -> None:
        require_scales(self.period, self.data_range)


@dataclass(frozen=True)
class Comparison:
    """How B differs from the reference A.

    values: None where they could not be compared, and where neither has any. distance: of two meshes.
    not_compared: why the values of two meshes, of which at least one holds some, could not be compared.
    """

    values: Difference | None
    distance: Distance | None = None
    not_compared: str | None = None

    def is_judged(self, tolerances: Tolerances) -> bool:
        """True where any of the tolerances says something of what was compared here."""
        return tolerances.are_given if self.distance else tolerances.are_of_values

    def exceeds(self, tolerances: Tolerances) -> list[str]:
        """One line for each tolerance that is broken. Where any is of values, those not compared break it."""
        lines = [] if self.distance is None else self.distance.exceeds(tolerances)
        if self.values is not None:
            lines += self.values.exceeds(tolerances)
        if self.not_compared and tolerances.are_of_values:
            lines.append(f"values not compared: {self.not_compared}")
        return lines

    def as_dict(self) -> dict[str, Any]:
        """For JSON: the figures of the values; of meshes `distance`, and `values_not_compared` where it is so."""
        found: dict[str, Any] = {} if self.values is None else dict(self.values.as_dict())
        if self.distance is not None:
            found["distance"] = asdict(self.distance)
        if self.not_compared is not None:
            found["values_not_compared"] = self.not_compared
        return found


@dataclass(frozen=True)
class Pairing:
    """The files of two folders, by their paths relative to them, sorted.

    both, only_in_a, only_in_b: volumes, meshes and values at vertices. others: how many files are none of these.
    idle: patterns that no file matches.
    """

    both: list[str]
    only_in_a: list[str]
    only_in_b: list[str]
    others: int
    idle: list[str]

    @property
    def alone(self) -> tuple[list[str], list[str]]:
        """What is only in A, and only in B."""
        return self.only_in_a, self.only_in_b


def compare_files(a: Path, b: Path, terms: Terms) -> Comparison:
    """B against the reference A, two volumes, two meshes or two files of vertex data.

    Raises RefusedError where they are not of one kind, or of grids or sizes that differ; DataError where one cannot be
    read or no value is in both. Two meshes that have no value are compared by their places.
    """
    match common_kind(a, b):
        case "volume":
            return Comparison(_compare_volumes(a, b, terms))
        case "mesh":
            return _compare_meshes(a, b, terms)
        case _:
            return Comparison(_compare_metrics(a, b, terms))


def compare_each(a: Path, b: Path, names: Sequence[str], terms: Terms) -> Iterator[tuple[str, Comparison | str]]:
    """The files of these names in the folders A and B, one after another; a line instead where that is impossible.

    Of `terms`, the surface to be near to is for the volumes alone. Where neither has a value there is nothing to judge.
    """
    for name in names:
        yield name, _compared_or_reason(a / name, b / name, terms)


def _compared_or_reason(a: Path, b: Path, terms: Terms) -> Comparison | str:
    try:
        return compare_files(a, b, terms)
    except NoValues:  # an empty map is as good as its reference
        return Comparison(None)
    except BeltramiError as error:
        return str(error).splitlines()[0]
    except MemoryError:
        return "out of memory"
    except Exception as error:  # a defect of ours is to cost one file, not the table
        line = in_a_line(error) or "no message"
        return f"unexpected {type(error).__name__}: {line}; compare these two files with -v to see where"


def common_kind(a: Path, b: Path) -> Kind:
    """What both files are; raises RefusedError where one is missing or nothing that is compared, or they differ."""
    kinds: list[Kind] = []
    for path in (a, b):
        formats.require_file(path)
        kind = kind_of(path)
        if kind is None:
            raise RefusedError(
                f"{path}: cannot be compared; expected a volume, a mesh that can be read (not .glb) or values at "
                "vertices; check the path"
            )
        kinds.append(kind)
    first, second = kinds
    if first != second:
        raise RefusedError(f"A {a} is {WORDS[first]}, B {b} is {WORDS[second]}; expected two of one kind")
    return first


def kind_of(path: Path) -> Kind | None:
    """What a file is by its suffix or its first bytes; None where it is nothing that can be compared."""
    if formats.is_surface(path):
        return "mesh"
    if formats.is_overlay(path):
        return "metric"
    return "volume" if _has_suffix_of_volume(path) else None


def near_surface(levelset: Path, within: float | None = None) -> Near:
    """Within so many mm of the zero level of a level set; None for half a voxel.

    Raises RefusedError for a distance that is not above 0, and as `formats.read_volume`.
    """
    if within is not None and not 0 < within < np.inf:
        raise RefusedError(f"within: found {within:g}; expected a distance above 0 mm")
    psi = formats.read_volume(levelset)
    return Near(f"PSI {levelset}", psi, 0.5 * float(psi.grid.used_spacing.max()) if within is None else within)


def pair_folders(a: Path, b: Path, include: Sequence[str] = ()) -> Pairing:
    """What of two folders, and the folders in them, belongs together by relative path; hidden ones are left out.

    include: patterns as of a shell, of which a file has to match one: by its name, or, where the pattern has a slash,
        by its relative path. Pictures are other files, and so are the voxels that a header beside them stands for.
    Raises RefusedError where a folder cannot be listed.
    """
    listed = [_files_in(folder) for folder in (a, b)]
    idle = [pattern for pattern in include if not any(_matches(name, [pattern]) for name in listed[0] | listed[1])]
    if include:
        listed = [{name for name in names if _matches(name, include)} for names in listed]
    in_a, in_b = (names - _voxels_of(folder, names) for folder, names in zip((a, b), listed, strict=True))
    names = {name for folder, found in ((a, in_a), (b, in_b)) for name in found if _is_comparable(folder / name)}
    return Pairing(
        sorted(names & in_a & in_b), sorted(names - in_b), sorted(names - in_a), len((in_a | in_b) - names), idle
    )


def _compare_volumes(a: Path, b: Path, terms: Terms) -> Difference:
    """Several channels or frames value by value, complex numbers as their real and imaginary part."""
    near = terms.near
    flat = near is not None and 1 in near.psi.grid.shape
    first, second = (formats.read_volume(path, dtype=np.float64, channels=True, plane=flat) for path in (a, b))
    require_same_grid(first.grid, f"A {a}", second.grid, f"B {b}", remedy=REMEDY)
    _require_same_numbers(first, f"A {a}", second, f"B {b}")
    x, y = _parts(first), _parts(second)
    mask = None
    if near is not None:
        require_same_grid(first.grid, f"A {a}", near.psi.grid, near.name, remedy=REMEDY)
        mask = near.mask if x.ndim == 3 else np.broadcast_to(near.mask[..., None], x.shape)
    return difference(x, y, mask=mask, period=terms.period, data_range=terms.data_range)


def _require_same_numbers(first: Volume, first_name: str, second: Volume, second_name: str) -> None:
    kinds = ["complex" if np.iscomplexobj(volume.data) else "real" for volume in (first, second)]
    if kinds[0] != kinds[1]:
        raise RefusedError(
            f"{first_name} is {kinds[0]}, {second_name} is {kinds[1]}; expected two of one kind: extract the same part "
            "of both"
        )
    if first.channels != second.channels:
        raise RefusedError(
            f"channels or frames differ: {first_name} has {first.channels}, {second_name} {second.channels}; expected "
            "as many in both: extract those that correspond"
        )


def _parts(volume: Volume) -> np.ndarray:
    """The values, complex ones as two channels."""
    data = volume.data
    return np.stack([data.real, data.imag], -1) if np.iscomplexobj(data) else data


def _compare_metrics(a: Path, b: Path, terms: Terms) -> Difference:
    """Every map by its order; raises RefusedError where one has other maps or vertices."""
    first, second = (list(formats.read_maps(path).values()) for path in (a, b))
    if list(map(len, first)) != list(map(len, second)):
        found = (f"{len(maps)} x {max(map(len, maps))}" for maps in (first, second))
        raise RefusedError(
            f"sizes differ: A {a} and B {b} hold {' and '.join(found)} maps x values; expected as many maps of as many "
            "vertices in both"
        )
    return difference(np.concatenate(first), np.concatenate(second), period=terms.period, data_range=terms.data_range)


def _compare_meshes(a: Path, b: Path, terms: Terms) -> Comparison:
    """The geometry, and, with the same triangles, the values of every name."""
    first, second = _read_mesh(a), _read_mesh(b)
    distance = distance_between(first, second)
    values = [formats.read_values(path) for path in (a, b)]
    if not any(values):
        return Comparison(None, distance)
    if reason := _why_not(values[0], values[1], distance):
        return Comparison(None, distance, reason)
    x, y = (np.concatenate([columns[name] for name in values[0]]) for columns in values)
    try:
        return Comparison(difference(x, y, period=terms.period, data_range=terms.data_range), distance)
    except NoValues:
        return Comparison(None, distance)


def _read_mesh(path: Path) -> Mesh:
    curve = formats.read_curve(path)
    return formats.read_surface(path) if curve is None else curve


def _why_not(a: dict[str, np.ndarray], b: dict[str, np.ndarray], distance: Distance) -> str | None:
    if not (a and b):
        return f"only {'A' if a else 'B'} holds any"
    if a.keys() != b.keys():
        return f"A holds {', '.join(a)}, B {', '.join(b)}"
    return None if distance.same_triangles else "the triangles differ"


def _files_in(folder: Path) -> set[str]:
    """Relative paths, with slashes, of all files that are not hidden; links that lead nowhere are among them."""

    def refuse(error: OSError) -> None:
        raise RefusedError(f"{error.filename}: cannot be listed ({error.strerror}); check its permissions")

    found = set()
    for root, folders, names in os.walk(folder, onerror=refuse, followlinks=True):
        here = Path(root)
        # A link to a folder that it lies in leads round and round.
        folders[:] = [n for n in folders if n[0] != "." and not here.resolve().is_relative_to((here / n).resolve())]
        paths = [here / name for name in names if name[0] != "."]
        found |= {path.relative_to(folder).as_posix() for path in paths if path.is_file() or not path.exists()}
    return found


def _matches(name: str, patterns: Sequence[str]) -> bool:
    return any(fnmatchcase(name if "/" in pattern else name.rpartition("/")[2], pattern) for pattern in patterns)


def _voxels_of(folder: Path, names: set[str]) -> set[str]:
    """The names of files that hold the voxels of a header among them (.img of .hdr, .raw of .mhd)."""
    found: set[str] = set()
    for name in names:
        path = folder / name
        if path.suffix.lower() in (".hdr", ".mhd") and path.is_file():
            parts = [part for part in formats.input_files(path) if part != path]
            found |= {Path(os.path.relpath(part, folder)).as_posix() for part in parts}
    return found


def _is_comparable(path: Path) -> bool:
    if _has_suffix_of_volume(path):
        return path.suffix.lower() != ".png"
    return formats.is_surface(path) or formats.is_overlay(path)


def _has_suffix_of_volume(path: Path) -> bool:
    try:
        formats.volume_format(path)
    except RefusedError:
        return False
    return True
