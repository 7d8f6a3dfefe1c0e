"""Draw the pictures of the page "What beta means": python docs/examples/beta_pictures.py docs/images/beta

Prints what is left of the noise for each of them. Needs: pip install 'beltrami_cli[report]'
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

from beltrami_cli import Mesh, denoise, phantoms
from beltrami_cli.report import colours, geometry, surfaces

BETAS = (0, 0.01, 0.03, 0.1, 0.3, 1)  # mm per grey level
ITERATIONS = 20
INCHES, DPI, COLOURS = (4.2, 2.9), 150, 100  # 630 x 435 pixels of 100 colours: under 60 kB each


def draw(path: Path, mesh: Mesh) -> None:
    """The mesh with its values, seen from three quarters."""
    figure = Figure(INCHES, DPI, facecolor="white")
    axes = figure.add_axes((0, 0, 1, 1))
    shades = colours.Scale(0.0, 255.0).rgba(mesh.values)
    surfaces.draw(axes, mesh, shades, geometry.from_side(mesh, "three-quarter"))
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    Image.fromarray(np.asarray(canvas.buffer_rgba())[..., :3]).quantize(COLOURS).save(path, optimize=True)


def main(folder: Path) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    made = phantoms.make("torus", size=64, noise=40.0, seed=1).volumes()
    psi, clean, noisy = (made[part].data for part in ("levelset", "clean", "noisy"))
    runs = {"clean": clean, "noisy": noisy}
    surface = {name: denoise(psi, data, flow="l2", iterations=0).mesh for name, data in runs.items()}
    near = np.abs(psi) < 0.5
    print(f"noisy: {np.sqrt(np.mean((noisy - clean)[near] ** 2)):.1f} grey levels of error")
    for beta in BETAS:
        result = denoise(psi, noisy, beta=beta, iterations=ITERATIONS)
        surface[f"beta_{beta}"] = result.mesh
        print(f"beta {beta}: {np.sqrt(np.mean((result.data - clean)[near] ** 2)):.1f}")
    for name, mesh in surface.items():
        draw(folder / f"{name}.png", mesh)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
