"""Make the pictures of docs/gallery.md anew, by the commands that stand there: `python .ci/gallery.py`.

They go to docs/images/gallery without transparency, packed tightly: all pictures together stay under 3 MB.
"""

from __future__ import annotations

import os
import re
import shlex
import shutil
import tempfile
from pathlib import Path

from PIL import Image

from beltrami_cli.cli import main

ROOT = Path(__file__).resolve().parents[1]
PICTURES = ROOT / "docs" / "images" / "gallery"


def commands(page: Path) -> list[list[str]]:
    """The arguments of the lines that start with `beltrami ` in blocks fenced as bash, continued lines joined."""
    blocks = re.findall(r"^```bash\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    return [shlex.split(line)[1:] for line in lines if line.startswith("beltrami ")]


def make(folder: Path) -> None:
    shutil.copytree(ROOT / "configs", folder / "configs", ignore=shutil.ignore_patterns("data", "output"))
    shutil.copytree(ROOT / "sample_data", folder / "sample_data")
    os.chdir(folder)
    for command in commands(ROOT / "docs" / "gallery.md"):
        if code := main([*command, "--quiet"]):
            raise SystemExit(code)
    PICTURES.mkdir(parents=True, exist_ok=True)
    for picture in sorted(folder.glob("*.png")):
        Image.open(picture).convert("RGB").save(PICTURES / picture.name, optimize=True)
        print(f"docs/images/gallery/{picture.name}: {(PICTURES / picture.name).stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as scratch:
        make(Path(scratch))
        os.chdir(ROOT)
