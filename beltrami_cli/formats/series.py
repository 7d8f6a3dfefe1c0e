"""Time series: frames read and written one at a time, so that memory does not grow with their number."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from beltrami_cli.formats import checks
from beltrami_cli.grid import Grid, Volume, with_channels


@dataclass(frozen=True, eq=False)
class Series:
    """The values of a file as its header announces them, none of them in memory before it is asked for.

    count: number of channels or frames. file_shape, header, notes: as those of `Volume`, of the whole file.
    frame: reads frame t, an array of `grid.shape`; raises DataError where the file is damaged there. In a compressed
        file a step back costs reading it from its start again.
    is_complex: a voxel is one complex number.
    """

    grid: Grid
    count: int
    file_shape: tuple[int, ...]
    header: Any = field(repr=False)
    frame: Callable[[int], np.ndarray] = field(repr=False)
    is_complex: bool = False
    notes: tuple[str, ...] = ()

    def __iter__(self) -> Iterator[np.ndarray]:
        return (self.frame(t) for t in range(self.count))

    def shape_to_write(self) -> tuple[int, ...]:
        """The shape in a file: as it was, unless the grid has been replaced by another."""
        spatial = with_channels(self.file_shape, self.count, 1)
        if (*spatial, 1)[:3] == self.grid.shape:
            return self.file_shape
        return (*self.grid.shape, self.count) if self.count > 1 else self.grid.shape


def frames_of(read: Callable[[], Volume]) -> Callable[[int], np.ndarray]:
    """`Series.frame` for a format that is read whole, once, at the first frame."""
    whole = cache(read)

    def frame(t: int) -> np.ndarray:
        volume = whole()
        return volume.data[..., t] if volume.data.ndim == 4 else volume.data

    return frame


def frames_behind(
    path: Path, kind: str, proxy: Any, shape: tuple[int, int, int], count: int, dtype: np.dtype
) -> Callable[[int], np.ndarray]:
    """`Series.frame` for nibabel's array proxy, through a file that stays open: a .gz cannot seek."""
    from nibabel.arrayproxy import ArrayProxy

    spec = ((*shape, count), proxy.dtype, proxy.offset, proxy.slope, proxy.inter)
    frames = ArrayProxy(proxy.file_like, spec, mmap=False, keep_file_open=True)

    def frame(t: int) -> np.ndarray:
        with checks.reading(path, kind):
            return np.asarray(frames[..., t]).astype(dtype, copy=False)

    return frame


@contextmanager
def appending(path: Path) -> Iterator[Callable[[bytes], None]]:
    """A function that appends bytes to a new file, compressed where its suffix is .gz; raises DataError from it.

    What the caller does between two blocks is not taken for a failure to write.
    """
    from nibabel.openers import ImageOpener

    with checks.writing(path):
        file = ImageOpener(path, "wb")

    def append(block: bytes) -> None:
        with checks.writing(path):
            file.write(block)

    try:
        yield append
    finally:
        with checks.writing(path):
            file.close()


def append_frames(append: Callable[[bytes], None], series: Series, frames: Iterable[np.ndarray], dtype: Any) -> None:
    """Append the frames, arrays of `series.grid.shape`, one behind the other in Fortran order."""
    for frame in counted(series, frames):
        append(frame.astype(dtype, copy=False).tobytes("F"))


def counted(series: Series, frames: Iterable[np.ndarray]) -> Iterator[np.ndarray]:
    """The frames; raises ValueError where they are not as many as announced or not of the grid's shape."""
    done = 0
    for frame in frames:
        if frame.shape != series.grid.shape or done == series.count:
            raise ValueError(f"frame {done} of {series.count} has shape {frame.shape}, its grid {series.grid.shape}")
        done += 1
        yield frame
    if done != series.count:
        raise ValueError(f"{series.count} frames were announced, {done} given")
