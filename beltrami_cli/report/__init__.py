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

# What the index page of a batch is known by.
INDEX = '<meta name="generator" content="beltrami batch">'


def missing(path: Path) -> list[str]:
    """The packages that drawing this file needs and that are not installed.

    Raises RefusedError unless the path's suffix is .png or .html.
    """
    needed = NEEDS.get(path.suffix.lower())
    if needed is None:
        raise RefusedError(f"{path}: pictures are written as {' or '.join(NEEDS)}; give it one of these suffixes")
    return [name for name in needed if find_spec(name) is None]


def require(path: Path) -> None:
    """Raise RefusedError unless the path's suffix is .png or .html and what draws it is installed."""
    if lacking := missing(path):
        raise RefusedError(
            f"{path}: pictures need {', '.join(lacking)}, not installed: pip install 'beltrami_cli[report]'"
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
