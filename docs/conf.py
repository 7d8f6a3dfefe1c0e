"""The documentation as a site that opens offline: sphinx-build -W --keep-going -b html docs docs/_build/html"""

from __future__ import annotations

import html
import re
from typing import Any

import click
from docutils import nodes
from docutils.utils.math import MathError
from docutils.utils.math.latex2mathml import tex2mathml
from sphinx.util import logging

from beltrami_cli import __version__
from beltrami_cli.cli import beltrami

project = "beltrami"
author = "The beltrami_cli authors"
project_copyright = author
release = __version__

extensions = ["myst_parser", "sphinx.ext.autodoc"]
exclude_patterns = ["_build"]
myst_enable_extensions = ["dollarmath"]
myst_fence_as_directive = ["math"]  # ```math, which forges draw as well
myst_heading_anchors = 3

html_theme = "furo"
html_title = f"beltrami {release}"
html_static_path = ["_static"]
html_css_files = ["site.css"]
html_js_files = ["slider.js"]
html_show_sphinx = False
html_copy_source = False
html_math_renderer = "mathml"

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
python_maximum_signature_line_length = 80
nitpicky = True
# Names of other packages have no page here: the site is built, and read, without a network.
nitpick_ignore_regex = [(r"py:.*", r"(?!beltrami_cli\b).*")]

HELP_WIDTH = 88  # characters that the text column holds
ARGUMENT = r"[a-z]\w*(?: \([^)]*\))?"
ARGUMENTS = rf"{ARGUMENT}(?:, {ARGUMENT})*"


def _inline_math(writer: Any, node: nodes.math) -> None:
    writer.body.append(_mathml(node, as_block=False))
    raise nodes.SkipNode


def _displayed_math(writer: Any, node: nodes.math_block) -> None:
    writer.body.append(f'<div class="equation">{_mathml(node, as_block=True)}</div>\n')
    raise nodes.SkipNode


def _mathml(node: nodes.Element, *, as_block: bool) -> str:
    """Drawn by the browser itself: MathJax and KaTeX would be fetched from elsewhere."""
    text = node.astext()
    try:
        formula = tex2mathml(text, as_block=as_block)
    except MathError as error:
        logging.getLogger(__name__).warning("formula %r: %s", text, error, location=node)
        return html.escape(text)
    return formula.replace("<math ", f'<math aria-label="{html.escape(text)}" ', 1)


def _add_help(app: Any, page: str, source: list[str]) -> None:
    """Put what --help prints at the end of the page of commands, so that it is never out of date."""
    if page != "commands":
        return
    group = click.Context(beltrami, info_name="beltrami", max_content_width=HELP_WIDTH, terminal_width=HELP_WIDTH)
    for name, command in beltrami.commands.items():
        text = command.get_help(click.Context(command, group, name, max_content_width=HELP_WIDTH))
        source[0] += f"\n## {name}\n\n```text\n{text}\n```\n"


def _list_arguments(app: Any, what: str, name: str, item: Any, options: Any, lines: list[str]) -> None:
    """The docstrings' own `name, other (mm): meaning` as a list, and their mathematics as it stands."""
    paragraphs = "\n".join(lines).replace("*", r"\*").replace("|", r"\|").split("\n\n")
    lines.clear()
    for paragraph in paragraphs:
        text = " ".join(paragraph.split())
        parts = re.split(rf"(?:^|(?<=[.;]) )({ARGUMENTS}): ", text)
        lines += [parts[0], ""]
        lines += [f"- **{names}**: {meaning}" for names, meaning in zip(parts[1::2], parts[2::2], strict=True)]
        lines.append("")


def setup(app: Any) -> None:
    app.add_html_math_renderer("mathml", (_inline_math, None), (_displayed_math, None))
    app.connect("source-read", _add_help)
    app.connect("autodoc-process-docstring", _list_arguments)
