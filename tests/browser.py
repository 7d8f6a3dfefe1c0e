"""Small subjects for pages, and a browser without a window to open them in."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli.report.subject import Map, Subject
from beltrami_cli.surface import Mesh

# Draws 3-D on the processor, where there is no graphics card.
SOFTWARE_GL = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]


def sphere(subdivisions: int = 3, radius: float = 20.0, structure: str | None = None) -> Mesh:
    """An icosphere; 1,280 triangles for three subdivisions."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions, radius)
    return Mesh(np.asarray(ball.vertices), np.asarray(ball.faces, np.int32), structure=structure)


def angles(mesh: Mesh, title: str = "angles", noise: float = 40.0, **changes: Any) -> Subject:
    """The longitude on a surface about 0 with noise, and without; a cap of it missing before and filled after."""
    x, y, z = mesh.vertices_ras_mm.T
    clean = np.degrees(np.arctan2(y, x)) % 360
    before = (clean + noise * np.random.default_rng(0).standard_normal(len(x))) % 360
    cap = x > 0.8 * x.max()
    before[cap | (z < 0.8 * z.min())] = np.nan
    after = np.where(z < 0.8 * z.min(), np.nan, clean)
    maps = (Map("before", before), Map("after", after, None, cap & np.isfinite(after)))
    subject = {
        "title": title,
        "maps": maps,
        "mesh": mesh,
        "period": 360.0,
        "compares": True,
        "difference": "removed",
        "record": RECORD,
    }
    return Subject(**{**subject, **changes})


RECORD: dict[str, Any] = {
    "GeneratedBy": [{"Name": "beltrami_cli", "Version": "0.0"}],
    "Sources": [{"Path": "/study/<map> & 'more'.nii.gz", "SHA256": "ab" * 32, "Role": "data"}],
    "Outputs": ["/study/out.nii.gz"],
    "Created": "2026-01-02T03:04:05+00:00",
    "Parameters": {"flow": "beltrami", "phi": None, "beta": 0.0251, "depth": [-2.0, 2.0], "flat": False},
    "Warnings": ["the noise of neighbours <looks> correlated"],
    "Noise": {"sd": [39.914, None], "after": [0.5932, None], "meaning": "robust standard deviation"},
    "Smoothness": {"before_mm": 1.02, "after_mm": 11.83},
    "Removed": {"rms": 40.5, "voxels": 12211},
    "Iterations": 3,
    "StopReason": "auto",
    "Choice": {
        "flow": "beltrami",
        "beta": 0.0251,
        "iterations": 3,
        "table": [{"flow": "beltrami", "beta": 0.0251, "error": 38.6}, {"flow": "l2", "error": 41.25}],
        "errors": [50.0, 45.0, 42.0, 38.6],
    },
    "PerIteration": {
        "beta": [0.0251] * 3,
        "change_rms": [0.05, 0.02, 0.01],
        "noise_sd": [{"iteration": 0, "sd": [39.9]}, {"iteration": 3, "sd": [0.6]}],
    },
    "Seconds": {"read": 0.3, "flow": 1.25},
}


@dataclass
class Log:
    """What a browser did beside showing the page."""

    errors: list[str] = field(default_factory=list)
    requests: list[str] = field(default_factory=list)


def is_there() -> bool:
    """True where playwright and Chromium are installed."""
    try:
        import playwright.sync_api  # noqa: F401
    except ImportError:
        return False
    return shutil.which("chromium") is not None


@contextmanager
def browser() -> Iterator[Any]:
    """Chromium without a window."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as player:
        chromium = player.chromium.launch(executable_path=shutil.which("chromium"), args=SOFTWARE_GL)
        yield chromium
        chromium.close()


def open_page(chromium: Any, file: Path, width: int = 820, height: int = 900) -> tuple[Any, Log]:
    """A file in a window that has no network, its surface drawn where it has one."""
    window = chromium.new_context(offline=True, viewport={"width": width, "height": height}).new_page()
    log = Log()
    window.on("console", lambda line: log.errors.append(line.text) if line.type == "error" else None)
    window.on("pageerror", lambda error: log.errors.append(str(error)))
    window.on("request", lambda request: log.requests.append(request.url))
    window.goto(file.as_uri())
    if window.locator("#panes").count():
        window.wait_for_selector("#panes[data-ready]")
    return window, log


def pixels(png: bytes) -> np.ndarray:
    """(height, width, 3) colours of a screenshot."""
    import io

    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB"), int)
