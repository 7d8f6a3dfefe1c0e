"""Numba functions on flat arrays and floats; compiled on first use and cached on disk."""

from pathlib import Path

import numba as nb
import numpy as np

# Entries worked on at a time: their arrays stay in a core's cache, and sums over blocks of one size do not depend on
# the number of threads.
BLOCK = 2048
# What LLVM may assume: sums reordered, products fused, but NaN and infinity kept, for they mean "missing" here.
FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}


@nb.njit(cache=True)
def total(parts):
    """The sum in order of place: numba's own, inside a parallel function, depends on the number of threads."""
    s = 0.0
    for part in parts:
        s += part
    return s


def wake() -> None:
    """Call a kernel, so that numba loads what it needs for any (0.2 s of its imports)."""
    total(np.zeros(1))


def are_cached() -> bool:
    """False before the first-ever band, when compiling takes about half a minute."""
    from beltrami_cli.kernels import sheets

    return any(Path(sheets.grow.stats.cache_path).glob("sheets.grow-*.nbi"))
