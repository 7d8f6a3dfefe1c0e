"""Denoise data that lies on an implicitly given surface: the Beltrami flow over implicit manifolds."""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"
__all__ = ["Mesh", "Result", "__version__", "denoise"]

if TYPE_CHECKING:
    from beltrami_cli.api import denoise
    from beltrami_cli.solver import Result
    from beltrami_cli.surface import Mesh


def __getattr__(name: str) -> Any:
    """Import the numerics on first use, so that `import beltrami_cli` and `beltrami --help` stay light (PEP 562)."""
    if name in __all__:
        return getattr(import_module("beltrami_cli.api"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
