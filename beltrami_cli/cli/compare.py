"""beltrami compare: figures of how two files or folders differ, and a verdict against tolerances."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

from beltrami_cli.cli.common import Command, announce_compilation, note, say

if TYPE_CHECKING:
    from beltrami_cli.comparison import Comparison, Pairing, Terms
    from beltrami_cli.metrics import Distance, Tolerances

FILE = click.Path(path_type=Path)
EPILOG = """Without a tolerance the figures are printed and nothing is judged. Exit codes: 0 all tolerances hold; 1 one
is broken, or a file cannot be read or is in one folder only; 2 refused before starting, as for files of two kinds."""


@click.command(cls=Command, epilog=EPILOG)
@click.argument("a", type=FILE)
@click.argument("b", type=FILE)
@click.option(
    "--levelset", type=FILE, metavar="PSI", help="Compare volumes only near the surface of this level set ..."
)
@click.option("--within", type=float, metavar="MM", help="... within this distance. Default: half a voxel.")
@click.option("--period", metavar="P", help="Values are angles of this period (360, 2pi, 24); differences wrap.")
@click.option("--max-abs", type=float, metavar="X", help="Tolerance: the largest difference.")
@click.option("--max-rms", type=float, metavar="X", help="Tolerance: the root mean square difference.")
@click.option("--min-psnr", type=float, metavar="X", help="Tolerance: peak signal to noise in dB, over --data-range.")
@click.option("--data-range", type=float, metavar="R", help="Full scale for PSNR. Default: A's range, or --period.")
@click.option("--max-missing", type=int, metavar="N", help="Tolerance: how many values may be in only one of A and B.")
@click.option(
    "--max-distance",
    type=float,
    metavar="MM",
    help="Tolerance: how far meshes may be apart. Default, where another tolerance is given: 0.001.",
)
@click.option(
    "--include",
    multiple=True,
    metavar="PATTERN",
    help="Of folders, only files like this: '*angle*', 'sub-01/*.nii.gz'. May be repeated.",
)
@click.option("--json", "as_json", is_flag=True, help="Print the figures as JSON.")
def compare(
    a: Path,
    b: Path,
    levelset: Path | None,
    within: float | None,
    period: str | None,
    max_abs: float | None,
    max_rms: float | None,
    min_psnr: float | None,
    data_range: float | None,
    max_missing: int | None,
    max_distance: float | None,
    include: tuple[str, ...],
    as_json: bool,
    quiet: bool,
    verbose: int,
) -> int:
    """Compare B with the reference A: two volumes, two meshes, two files of values at vertices, or two folders.

    Values are compared where both have one. Of meshes, places are too: how far vertices moved or, where the triangles
    differ, how far the surfaces are apart. Of folders, files of the same relative path are compared, and those that
    only one folder has are listed.
    """
    from beltrami_cli.comparison import Terms, near_surface
    from beltrami_cli.config import parse_period
    from beltrami_cli.metrics import Tolerances

    tolerances = Tolerances(max_abs, max_rms, min_psnr, max_missing, max_distance)
    if within is not None and levelset is None:
        raise click.UsageError("--within needs --levelset, the surface to be near to")
    folders = _are_folders(a, b)
    if include and not folders:
        raise click.UsageError("--include is for folders; found two files")
    if not folders:
        _require_meaning(a, b, levelset, max_distance)
    if levelset is not None:
        announce_compilation(quiet)
    near = None if levelset is None else near_surface(levelset, within)
    terms = Terms(near, parse_period(period) if period else None, data_range)
    if folders:
        return _compare_folders(a, b, include, terms, tolerances, as_json, quiet)
    return _compare_files(a, b, terms, tolerances, as_json, quiet)


def _are_folders(a: Path, b: Path) -> bool:
    from beltrami_cli.errors import RefusedError
    from beltrami_cli.formats import require_file

    if a.is_dir() and b.is_dir():
        return True
    for path, other in ((a, b), (b, a)):
        if not os.path.lexists(path):
            raise RefusedError(f"{path}: no such file or folder; check the path")
        if path.is_dir() and other.exists():
            raise RefusedError(f"{path} is a folder, {other} is none; expected two files or two folders")
        if not path.is_dir():
            require_file(path)
    return False


def _require_meaning(a: Path, b: Path, levelset: Path | None, max_distance: float | None) -> None:
    """Raise RefusedError where two files are not of one kind, or an option says nothing of theirs."""
    from beltrami_cli.comparison import WORDS, common_kind
    from beltrami_cli.errors import RefusedError

    kind = common_kind(a, b)
    if levelset is not None and kind != "volume":
        raise RefusedError(f"--levelset is for volumes; found {WORDS[kind]} in {a}; drop it")
    if max_distance is not None and kind != "mesh":
        raise RefusedError(f"--max-distance is for meshes; found {WORDS[kind]} in {a}; drop it")


def _compare_files(a: Path, b: Path, terms: Terms, tolerances: Tolerances, as_json: bool, quiet: bool) -> int:
    from beltrami_cli.comparison import compare_files

    found = compare_files(a, b, terms)
    broken = found.exceeds(tolerances)
    if as_json:
        say(quiet, json.dumps({**found.as_dict(), "broken": broken}, indent=2, allow_nan=False))
    else:
        for line in _figures(found):
            say(quiet, line)
    if lost := _unjudged(found, tolerances):
        note(quiet, f"warning: {lost} values of A are missing in B: no tolerance looks at them; --max-missing does")
    for line in broken:
        click.echo(f"beltrami: out of tolerance: {line}", err=True)
    return 1 if broken else 0


def _unjudged(found: Comparison, tolerances: Tolerances) -> int:
    """How many values of A are missing in B that no tolerance says anything of, where some are given."""
    if found.values is None or tolerances.max_missing is not None or not tolerances.are_of_values:
        return 0
    return found.values.only_in_a


def _figures(found: Comparison) -> list[str]:
    lines = [] if found.distance is None else [_geometry(found.distance)]
    if (values := found.values) is None:
        return [
            *lines,
            f"values    {f'not compared: {found.not_compared}' if found.not_compared else 'neither has any'}",
        ]
    return [
        *lines,
        f"compared  {values.compared} values ({values.only_in_a} only in A, {values.only_in_b} only in B)",
        f"B - A     max {values.max_abs:.6g}, rms {values.rms:.6g}, mean {values.mean:.6g}",
        f"psnr      {values.psnr:.2f} dB over a range of {values.data_range:.6g}",
        f"correlation {values.correlation:.6f}",
    ]


def _geometry(distance: Distance) -> str:
    what = "vertices moved" if distance.same_triangles else "other triangles, surfaces apart"
    return f"geometry  {what}: max {distance.max_mm:.6g} mm, rms {distance.rms_mm:.6g} mm"


def _compare_folders(
    a: Path, b: Path, include: tuple[str, ...], terms: Terms, tolerances: Tolerances, as_json: bool, quiet: bool
) -> int:
    """A row for each pair as soon as it is compared, or JSON in the end; with `quiet` the problems alone, on stderr."""
    from beltrami_cli.comparison import compare_each, pair_folders

    pairing = pair_folders(a, b, include)
    for pattern in pairing.idle:
        note(quiet, f"warning: no file is like --include {pattern}")
    table = not (quiet or as_json)
    width = max(map(len, pairing.both), default=0)
    if table and pairing.both:
        _tell(_row(width, "file", ["compared", "max", "rms", "psnr", "mm"], "verdict"))
    entries: dict[str, dict[str, Any]] = {}
    problems = []
    for name, found in compare_each(a, b, pairing.both, terms):
        entries[name] = {"error": found} if isinstance(found, str) else _entry(found, tolerances)
        problem = _problem(found, tolerances)
        if problem:
            problems.append(f"{name}: {problem}")
        if table:
            _tell(_row(width, name, _cells(found), problem or _fine(found, tolerances)))
    alone = [f"only in {side}: {x}" for side, names in zip("AB", pairing.alone, strict=True) for x in names]
    is_broken = bool(problems or alone or not pairing.both)
    if as_json:
        say(quiet, json.dumps(_report(entries, pairing, is_broken), indent=2, allow_nan=False))
    for line in [*alone, *_remarks(pairing, tolerances)] if table else []:
        _tell(line)
    for line in [*problems, *alone] if quiet else []:
        _tell(f"beltrami: {line}", err=True)
    if is_broken:
        _tell(f"beltrami: {_summary(a, b, pairing, entries)}", err=True)
    return 1 if is_broken else 0


def _entry(found: Comparison, tolerances: Tolerances) -> dict[str, Any]:
    return {**found.as_dict(), "broken": found.exceeds(tolerances)}


def _report(entries: dict[str, dict[str, Any]], pairing: Pairing, is_broken: bool) -> dict[str, Any]:
    return {
        "files": entries,
        "only_in_a": pairing.only_in_a,
        "only_in_b": pairing.only_in_b,
        "not_compared": pairing.others,
        "broken": is_broken,
    }


def _problem(found: Comparison | str, tolerances: Tolerances) -> str | None:
    if isinstance(found, str):
        return f"failed: {found}"
    broken = found.exceeds(tolerances)
    return f"out of tolerance: {'; '.join(broken)}" if broken else None


def _fine(found: Comparison | str, tolerances: Tolerances) -> str:
    """The verdict on a pair without a problem, with what its tolerances do not look at."""
    if isinstance(found, str) or not found.is_judged(tolerances):
        return "not judged"
    if found.not_compared:
        return f"ok (values not compared: {found.not_compared})"
    lost = _unjudged(found, tolerances)
    return f"ok ({lost} values of A are missing in B)" if lost else "ok"


def _cells(found: Comparison | str) -> list[str]:
    """What stands in the row of a pair between its name and its verdict."""
    values, distance = (None, None) if isinstance(found, str) else (found.values, found.distance)
    cells = ["-"] * 4
    if values is not None:
        cells = [str(values.compared), f"{values.max_abs:.6g}", f"{values.rms:.6g}", f"{values.psnr:.2f}"]
    return [*cells, "-" if distance is None else f"{distance.max_mm:.3g}"]


def _row(width: int, name: str, cells: list[str], verdict: str) -> str:
    columns = "".join(f"  {cell:>{size}}" for cell, size in zip(cells, (10, 11, 11, 7, 8), strict=True))
    return f"{name:<{width}}{columns}  {verdict}"


def _remarks(pairing: Pairing, tolerances: Tolerances) -> list[str]:
    lines = []
    if pairing.others:
        lines.append(f"other files, not looked at (no volumes, meshes or values at vertices): {pairing.others}")
    if pairing.both and not tolerances.are_given:
        lines.append("no tolerance is given: nothing was judged")
    return lines


def _summary(a: Path, b: Path, pairing: Pairing, entries: dict[str, dict[str, Any]]) -> str:
    alone = f"{len(pairing.only_in_a)} only in A, {len(pairing.only_in_b)} only in B"
    if not pairing.both:
        return f"nothing to compare: no volume, mesh or values at vertices are in both {a} and {b}; {alone}"
    failed = sum("error" in entry for entry in entries.values())
    broken = sum(bool(entry.get("broken")) for entry in entries.values())
    return f"{len(entries)} pairs: {broken} out of tolerance, {failed} failed; {alone}"


def _tell(line: str, *, err: bool = False) -> None:
    """Print what has names of files in it, which may hold bytes that a terminal cannot show."""
    click.echo(click.format_filename(line), err=err)
