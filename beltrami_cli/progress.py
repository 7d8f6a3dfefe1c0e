"""What a person sees of the time loop while it runs, and the seconds that each phase took."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from beltrami_cli.evolve import Observer


@contextmanager
def iteration_bar(label: str, *, quiet: bool = False) -> Iterator[Observer | None]:
    """An observer that draws a bar on stderr; None, so that the loop calls nothing, where that is no terminal."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from tqdm import tqdm

    # Cleared at the end: the summary that follows says the same and stays.
    with tqdm(desc=label, unit="it", leave=False, file=sys.stderr) as bar:

        def observe(iteration: int, total: int, change: float) -> None:
            bar.total = total
            bar.update(iteration - bar.n)

        yield observe


class Phases:
    """A stopwatch: `with phases("read"): ...` adds the block's seconds of wall time to `phases.seconds["read"]`.

    tell: called with the name of each phase that begins.
    """

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self.tell: Callable[[str], None] = lambda phase: None

    @contextmanager
    def __call__(self, name: str) -> Iterator[None]:
        self.tell(name)
        start = time.perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start
