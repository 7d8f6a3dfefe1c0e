"""Pictures of maps on surfaces for people: a sheet (PNG), and a page that opens in any browser (HTML)."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from beltrami_cli.errors import RefusedError
from beltrami_cli.report.subject import Subject

# What draws each kind of file: the packages of the extra [report].
NEEDS = {
    ".png": ("matplotlib", "colorcet", "fast_simplification"),
    ".html": ("matplotlib", "colorcet", "fast_simplification", "plotly", "jinja2"),
}


def require(path: Path) -> None:
    """Raise RefusedError unless the path's suffix is .png or .html and what draws it is installed."""
    needed = NEEDS.get(path.suffix.lower())
    if needed is None:
        raise RefusedError(f"{path}: found the suffix {path.suffix or 'none'!r}; expected {' or '.join(NEEDS)}")
    missing = [name for name in needed if find_spec(name) is None]
    if missing:
        raise RefusedError(
            f"{path}: pictures need {', '.join(missing)}, not installed; pip install 'beltrami_cli[report]'"
        )


def write(path: Path, subject: Subject) -> None:
    """Write what is to be shown as a sheet (.png) or a page (.html), by the path's suffix.

    Raises as `require`, and DataError where the file cannot be written.
    """
    require(path)
    if path.suffix.lower() == ".png":
        from beltrami_cli.report.sheet import draw

        draw(path, subject)
    else:
        from beltrami_cli.report.page import write as write_page

        write_page(path, subject)
