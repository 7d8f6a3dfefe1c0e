"""Numba functions on flat arrays and floats; compiled on first use and cached on disk."""

import os
from pathlib import Path

import numba as nb
import numpy as np

from beltrami_cli.errors import RefusedError

# How often GNU's OpenMP, where numba uses it, looks for the next loop before its threads sleep: about 10 microseconds.
# Its own 300,000 make a small run take up to 100 times as long where other programs want the CPUs too; with this an
# idle machine is as fast as before. Read when the first parallel kernel runs.
if "OMP_WAIT_POLICY" not in os.environ:
    os.environ.setdefault("GOMP_SPINCOUNT", "3000")

# Entries worked on at a time: their arrays stay in a core's cache, and sums over blocks of one size do not depend on
# the number of threads.
BLOCK = 2048
# What LLVM may assume: sums reordered, products fused, but NaN and infinity kept, for they mean "missing" here.
FAST = {"reassoc", "contract", "arcp", "nsz", "afn"}


try:

    @nb.njit(cache=True)
    def total(parts):
        """The sum in order of place: numba's own, inside a parallel function, depends on the number of threads."""
        s = 0.0
        for part in parts:
            s += part
        return s

except RuntimeError as error:  # of the first kernel that numba meets
    raise RefusedError(
        f"compiled kernels can be kept nowhere ({error}); set NUMBA_CACHE_DIR to a folder that can be written to"
    ) from error


def wake() -> None:
    """Call a kernel, so that numba loads what it needs for any (0.2 s of its imports)."""
    total(np.zeros(1))


def are_cached() -> bool:
    """False before the first-ever band, when compiling takes about half a minute."""
    from beltrami_cli.kernels import sheets

    return any(Path(sheets.grow.stats.cache_path).glob("sheets.grow-*.nbi"))
