"""The index page of a batch: a row for each job, with links to what it left."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.parse import quote

from beltrami_cli import formats
from beltrami_cli.formats import checks
from beltrami_cli.report.page import fill

FIGURES = ("noise_before", "noise_after", "iterations", "stop_reason", "seconds")
# What needs a look comes first.
ORDER = ("failed", "busy", "open", "done", "skipped")

COLUMNS = ("Job", "Status", "Noise before", "Noise after", "Iterations", "Stopped by", "Seconds", "Warnings", "Failure")


@dataclass(frozen=True)
class Cell:
    """Of one figure: as it is read, and as it is sorted."""

    text: str
    key: str


@dataclass(frozen=True)
class Line:
    """One job as the page has it; addresses relative to the page, None where there is nothing."""

    name: str
    status: str
    figures: Sequence[Cell]
    warnings: Sequence[str]
    reason: str
    report: str | None
    thumbnail: str | None
    sidecar: str | None


def write(
    path: Path, rows: Sequence[Mapping[str, Any]], pages: Mapping[str, Path | None], *, folder: Path | None = None
) -> None:
    """Write the index page (HTML) of a batch. Raises DataError where the file cannot be written.

    rows: what became of each job, each as `dataclasses.asdict` of a batch's Row; keys may be missing. pages: by a job's
    name its report, a .html or .png file; None, or no such key, where it has none. Links lead to files that are there
    only, relative to the folder in which the page will be (None: that of its path), so that the study can move.
    """
    lines = [_line(folder or path.parent, row, pages.get(str(row.get("job")))) for row in rows]
    text = fill("index.html", columns=COLUMNS, lines=lines, counts=_counts(lines), title=f"{len(lines):,} jobs")
    with checks.writing(path):
        path.write_text(text, encoding="utf-8", errors="backslashreplace")


def _line(folder: Path, row: Mapping[str, Any], report: Path | None) -> Line:
    link = _link(folder, report)
    return Line(
        name=str(row.get("job") or ""),
        status=str(row.get("status") or ""),
        figures=[_cell(row.get(key)) for key in FIGURES],
        warnings=[str(line) for line in row.get("warnings") or ()],
        reason=str(row.get("reason") or ""),
        report=link,
        thumbnail=link if report is not None and report.suffix.lower() == ".png" else None,
        sidecar=_link(folder, _sidecar(Path(row["output"]))) if row.get("output") else None,
    )


def _sidecar(output: Path) -> Path:
    stem = formats.stem(output)
    return stem.with_name(stem.name + ".json")


def _link(folder: Path, target: Path | None) -> str | None:
    """The address of a file seen from a folder; None where there is no such file."""
    if target is None or not target.is_file():
        return None
    try:
        relative = os.path.relpath(target, folder)
    except ValueError:  # on another drive of Windows
        return target.absolute().as_uri()
    return quote(os.fsencode(Path(relative).as_posix()))


def _cell(value: Any) -> Cell:
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        return Cell(f"{value:.3g}" if isinstance(value, float) and abs(value) < 1000 else f"{value:,.0f}", repr(value))
    return Cell(str(value or ""), str(value or ""))


def _counts(lines: Sequence[Line]) -> list[tuple[str, int]]:
    found = Counter(line.status for line in lines)
    known = [status for status in ORDER if status in found]
    return [(status, found[status]) for status in [*known, *sorted(set(found) - set(ORDER))]]
