"""Time series: frames read and written one at a time, so that memory does not grow with their number."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli.formats import checks
from beltrami_cli.grid import Grid, Volume


@dataclass(frozen=True, eq=False)
class Series:
    """The frames of a file, none of them in memory before it is asked for.

    count: number of frames. file_shape, header: as those of `Volume`, of the whole file.
    frame: reads frame t, an array of `grid.shape`; raises DataError where the file is damaged there. In a compressed
        file a step back costs reading it from its start again.
    """

    grid: Grid
    count: int
    file_shape: tuple[int, ...]
    header: Any = field(repr=False)
    frame: Callable[[int], np.ndarray] = field(repr=False)

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self.frame(t) for t in range(self.count))


def of_volume(volume: Volume) -> Series:
    """The channels of a volume that is in memory already."""
    frames = volume.data.reshape(*volume.grid.shape, volume.channels)
    return Series(volume.grid, volume.channels, volume.file_shape, volume.header, lambda t: frames[..., t])


def of_proxy(path: Path, kind: str, proxy: Any, dtype: np.dtype, volume: Series) -> Series:
    """The frames behind nibabel's array proxy, through a file that stays open, as a .gz cannot seek."""
    from nibabel.arrayproxy import ArrayProxy

    spec = ((*volume.grid.shape, volume.count), proxy.dtype, proxy.offset, proxy.slope, proxy.inter)
    frames = ArrayProxy(proxy.file_like, spec, mmap=False, keep_file_open=True)
