"""The documentation as a whole: its links, its options, its pictures, and the site that is built of it."""

from __future__ import annotations

import re
import struct
import subprocess
import sys
from pathlib import Path

import click
import pytest
from command import done, record
from test_readme import PAGES, ROOT

from beltrami_cli.cli import beltrami as group
from beltrami_cli.config import KEYS

DOCS = ROOT / "docs"

# Options that the pages name of other programs: SLURM, Dask, Snakemake, mris_convert, the examples.
OF_OTHERS = {
    *("--array", "--cpus-per-task", "--mem", "--time", "--wrap"),
    *("--scheduler-file", "--nworkers", "--nthreads", "--memory-limit", "--lifetime", "--lifetime-stagger"),
    *("--cores", "--resources", "--to-scanner"),
    *("--workers", "--hours", "--local"),
    "--tool",
}


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    targets = re.findall(r"\]\(([^)#]+)(?:#[^)]*)?\)", text_of(page))
    local = [target for target in targets if "://" not in target]
    assert [target for target in local if not (page.parent / target).exists()] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_options_exist(page):
    known = {name for command in group.commands.values() for option in command.params for name in option.opts}
    known |= {"--help", "--version", *OF_OTHERS}
    assert set(re.findall(r"(?<![\w-])--[a-z][a-z-]*", text_of(page))) - known == set()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_pictures_are_told_in_words(page):
    pictures = re.findall(r"!\[(.*?)\]", text_of(page), re.DOTALL)
    assert all(len(words.split()) >= 3 for words in pictures)


def test_every_command_is_on_the_front_page_or_in_the_quick_starts():
    shown = " ".join(text_of(page) for page in PAGES)
    assert [name for name in group.commands if f"beltrami {name} " not in shown] == []


def test_every_key_of_a_config_is_told():
    rows = re.findall(r"^\| `\[(\w+)\]` \| (.*) \|$", text_of(DOCS / "formats.md"), re.MULTILINE)
    told = {section: set(re.findall(r"`(\w+)`", keys)) for section, keys in rows if section != "for_each"}
    assert told == {section: set(keys) for section, keys in KEYS.items()}


def test_every_key_of_a_record_is_told(scene):
    psi, data, out = scene
    done("denoise", psi, data, "-o", out)
    table = text_of(DOCS / "formats.md").split("## The record")[1].split("## ")[0]
    assert set(record(out.with_name("out.json"))) - set(re.findall(r"`(\w+)`", table)) == set()


def test_every_key_of_the_page_is_told():
    keys = re.findall(r'data-key="([^{"])"', text_of(ROOT / "beltrami_cli" / "report" / "page.html"))
    assert len(keys) > 4
    told = text_of(DOCS / "reports.md").split("## Keys")[1].split("## ")[0]
    assert [key for key in keys if f"`{key}`" not in told] == []


def test_pictures_of_beta_are_small_and_alike():
    files = sorted((DOCS / "images" / "beta").glob("*.png"))
    assert len(files) >= 5
    assert max(file.stat().st_size for file in files) < 60_000
    assert len({struct.unpack(">II", file.read_bytes()[16:24]) for file in files}) == 1  # a slider does not jump


@pytest.mark.slow
def test_figures_of_beta_are_those_of_its_script(tmp_path):
    script = DOCS / "examples" / "beta_pictures.py"
    ran = subprocess.run([sys.executable, str(script), str(tmp_path)], capture_output=True, text=True, cwd=ROOT)
    assert (ran.returncode, ran.stderr) == (0, "")
    errors = [float(error) for error in re.findall(r": ([\d.]+)", ran.stdout)]
    row = re.search(r"^\| error, grey levels \|(.*)$", text_of(DOCS / "beta.md"), re.MULTILINE)
    assert row and [float(cell.strip(" *")) for cell in row[1].strip("|").split("|")] == pytest.approx(errors, abs=0.11)
    made = {file.name for file in tmp_path.glob("*.png")}
    assert made == {file.name for file in (DOCS / "images" / "beta").glob("*.png")}


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("furo")
    pytest.importorskip("myst_parser")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", str(DOCS), str(folder)]
    built = subprocess.run(command, capture_output=True, text=True, cwd=ROOT)
    assert (built.returncode, built.stderr) == (0, "")
    return folder


@pytest.mark.slow
def test_site_loads_nothing_from_elsewhere(site):
    loaded = re.compile(r"""<(?:script|img|iframe|source|embed)\b[^>]*\bsrc\s*=\s*["']?(?:https?:)?//""")
    linked = re.compile(r"""<link\b[^>]*\bhref\s*=\s*["']?(?:https?:)?//""")
    styled = re.compile(r"""(?:url\(|@import)\s*["']?(?:https?:)?//""")
    pages = list(site.rglob("*.html"))
    assert len(pages) > 15
    assert [page.name for page in pages if loaded.search(text_of(page)) or linked.search(text_of(page))] == []
    assert [style.name for style in site.rglob("*.css") if styled.search(text_of(style))] == []


@pytest.mark.slow
def test_site_lists_every_option_of_every_command(site):
    page = re.sub(r"<[^>]+>", "", text_of(site / "commands.html"))
    options = {
        name for c in group.commands.values() for o in c.params if isinstance(o, click.Option) for name in o.opts
    }
    assert [name for name in sorted(options) if name not in page] == []


@pytest.mark.slow
def test_site_shows_formulas_as_mathematics(site):
    page = text_of(site / "method.html")
    assert page.count('display="block"') >= 8
    assert "$" not in re.sub(r"<[^>]+>", "", page.split("<article")[1].split("</article>")[0])
