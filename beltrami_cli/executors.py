"""Where jobs run: processes of this machine or workers of a Dask cluster, both as `concurrent.futures.Executor`.

Either way a process does one job at a time, with a known number of threads: numba's default threading layer ends a
process in which two Python threads enter parallel kernels.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from beltrami_cli.errors import RefusedError

# How many threads a library starts, read when it is loaded: numba, libigl, and what stands behind NumPy and SciPy.
_THREADS = ("NUMBA_NUM_THREADS", "IGL_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# Seconds to wait for a scheduler to answer: it does so at once, or its address is wrong.
_ANSWER = 10

# Held by the job that this process does: a Dask worker of several threads would start several.
alone = threading.Lock()


class Processes(Executor):
    """So many processes of this machine, started when first needed; each does one job at a time.

    Each is a pool of its own: where one is killed its job alone ends, with BrokenProcessPool, and another takes its
    place. threads: that each may use. Processes end with the one that started them, even where that one is killed.
    """

    def __init__(self, count: int, threads: int) -> None:
        self._threads = threads
        self._idle: SimpleQueue[ProcessPoolExecutor] = SimpleQueue()
        for _ in range(count):
            self._idle.put(self._fresh())

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """As Executor.submit; waits while every process is at work."""
        pool = self._idle.get()
        with _environment({name: str(self._threads) for name in _THREADS}):
            try:
                future = pool.submit(fn, *args, **kwargs)
            except BrokenExecutor:  # killed while it was idle
                pool = self._fresh()
                future = pool.submit(fn, *args, **kwargs)
        future.add_done_callback(lambda done: self._idle.put(self._fresh() if _is_broken(done) else pool))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        while not self._idle.empty():
            self._idle.get().shutdown(wait, cancel_futures=cancel_futures)

    def _fresh(self) -> ProcessPoolExecutor:
        # Started anew, not forked: a fork would take over threads' locks without the threads.
        return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=_become_worker)


@contextmanager
def cluster(address: str) -> Iterator[Executor]:
    """The workers of a Dask scheduler, by its address or the .json file that it wrote.

    Raises RefusedError where Dask is not installed or no scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError:
        raise RefusedError(
            "scheduler: needs Dask, which is not installed; install it: pip install 'beltrami_cli[cluster]'"
        ) from None
    where = {"scheduler_file": address} if address.endswith(".json") else {"address": address}
    if "scheduler_file" in where and not Path(address).is_file():
        raise RefusedError(f"scheduler: {address}: no such file; expected the one that dask-scheduler wrote")
    try:
        client = Client(**where, timeout=_ANSWER, set_as_default=False)
    except (OSError, ValueError, TimeoutError) as error:
        reason = " ".join(str(error).split()) or type(error).__name__
        raise RefusedError(
            f"scheduler: {address}: none answers there ({reason}); expected an address as tcp://HOST:8786"
        ) from None
    with client, client.get_executor(pure=False) as executor:
        yield executor


def own_threads() -> int | None:
    """Threads that this process may use for a job, as a Dask worker's; None where nothing says so."""
    worker = _dask_worker()
    return None if worker is None else int(worker.state.nthreads)


def own_memory() -> int | None:
    """Bytes that a Dask worker in this process may take; None where there is none, or no limit."""
    worker = _dask_worker()
    return None if worker is None else worker.memory_manager.memory_limit


def _dask_worker() -> Any:
    if "distributed" not in sys.modules:
        return None
    from distributed import get_worker

    try:
        return get_worker()
    except ValueError:  # not in a worker
        return None


def _become_worker() -> None:
    """End with the process that started this one: on its signals, and when it is gone."""
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: _end())
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        _end()


def _end() -> None:
    staging = sys.modules.get("beltrami_cli.formats.staging")
    if staging is not None:
        staging.abandon()
    os._exit(1)


def _is_broken(done: Future[Any]) -> bool:
    return not done.cancelled() and isinstance(done.exception(), BrokenExecutor)


@contextmanager
def _environment(variables: dict[str, str]) -> Iterator[None]:
    """The variables in this process's environment, for processes that are started meanwhile."""
    before = {name: os.environ.get(name) for name in variables}
    os.environ.update(variables)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
