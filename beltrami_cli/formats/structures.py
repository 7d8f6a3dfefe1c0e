"""Parts of the brain by the names that GIFTI files and Connectome Workbench use, as CortexLeft."""

from __future__ import annotations

import re
from pathlib import Path

from beltrami_cli.errors import RefusedError

_PAIRED = (
    "Accumbens",
    "Amygdala",
    "Caudate",
    "CerebellarWhiteMatter",
    "Cerebellum",
    "CerebralWhiteMatter",
    "Cortex",
    "DiencephalonVentral",
    "Hippocampus",
    "HippocampusDentate",
    "Pallidum",
    "Putamen",
    "Thalamus",
)
_SINGLE = (
    "All",
    "AllGreyMatter",
    "AllWhiteMatter",
    "BrainStem",
    "Cerebellum",
    "Cortex",
    "Other",
    "OtherGreyMatter",
    "OtherWhiteMatter",
)

STRUCTURES = (*(f"{name}{side}" for name in _PAIRED for side in ("Left", "Right")), *_SINGLE)

_BY_KEY = {name.lower(): name for name in STRUCTURES}
_BY_KEY |= dict.fromkeys(("l", "lh", "left", "hemil"), "CortexLeft")
_BY_KEY |= dict.fromkeys(("r", "rh", "right", "hemir"), "CortexRight")

# FreeSurfer's lh.white, fMRIPrep's sub-01_hemi-L_white.surf.gii, HCP's 100307.L.white.surf.gii.
_HEMISPHERE = re.compile(r"^([lr])h\.|(?:^|_)hemi-([lrLR])(?=[_.])|\.([LR])\.")


def parse_structure(text: str) -> str:
    """GIFTI's name for CortexLeft, CORTEX_LEFT, left, lh or L, and so on for every one of `STRUCTURES`.

    Raises RefusedError for another text.
    """
    found = _BY_KEY.get(re.sub(r"[\s_-]", "", text).lower())
    if found is None:
        raise RefusedError(
            f"structure {text}: no such part of the brain; expected CortexLeft (left, lh, L), CortexRight (right, rh, "
            "R), Cortex, Cerebellum or another name of Connectome Workbench"
        )
    return found


def structure_of_name(path: Path) -> str | None:
    """CortexLeft or CortexRight where the file's name says so (lh., hemi-L, .L.), else None."""
    match = _HEMISPHERE.search(Path(path).name)
    if match is None:
        return None
    return parse_structure(next(filter(None, match.groups())))


def structure_of_text(text: str | None) -> str | None:
    """GIFTI's name for what a file says of its structure, None where that is no known one."""
    try:
        return parse_structure(text or "")
    except RefusedError:
        return None
