"""Where jobs run, as `concurrent.futures.Executor`: here processes of this machine, in `cluster` Dask's workers.

Either way a process does one job at a time, with a known number of threads: numba's default threading layer ends a
process in which two Python threads enter parallel kernels.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future, ProcessPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from queue import SimpleQueue
from typing import Any

# How many threads a library starts, read when it is loaded: numba, libigl, and what stands behind NumPy and SciPy.
_THREADS = ("NUMBA_NUM_THREADS", "IGL_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
# File descriptors that a process costs the one that started it, as measured, and those that one has open otherwise.
_FILES, _OWN_FILES = 8, 100
# Seconds in which a worker whose batch is gone leaves compiled code, where signals wait.
_LAST_CALL = 2
# Signals that end a worker.
_ENDING = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

# Held by the job that this process does: a Dask worker of several threads would start several.
alone = threading.Lock()


class Workers(Executor):
    """An executor whose workers do one job at a time each.

    one_machine: whether its jobs share the memory of this machine.
    """

    one_machine = True

    def slots(self) -> int:
        """How many jobs can run at once now."""
        return 1


class Processes(Workers):
    """So many processes of this machine, started when first needed; each does one job at a time.

    Each is a pool of its own: where one is killed its job alone ends, with BrokenProcessPool, and another takes its
    place. threads: that each may use. Processes end with the one that started them, even where that one is killed.
    """

    def __init__(self, count: int, threads: int) -> None:
        self._count, self._threads = count, threads
        if os.name == "posix":
            # It clears up behind this process where that is stopped at once, and would print warnings that it had to.
            with _environment({"PYTHONWARNINGS": "ignore:resource_tracker"}):
                resource_tracker.ensure_running()
            _allow_files(count * _FILES + _OWN_FILES)
        self._idle: SimpleQueue[ProcessPoolExecutor | None] = SimpleQueue()  # None: to be made when it is needed
        for _ in range(count):
            self._idle.put(None)

    def slots(self) -> int:
        return self._count

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """As Executor.submit; waits while every process is at work. Raises OSError where none can be started."""
        pool = self._idle.get()
        try:
            with _environment({name: str(self._threads) for name in _THREADS}), _signals_held():
                pool = pool or _fresh()
                try:
                    future = pool.submit(fn, *args, **kwargs)
                except BrokenExecutor:  # killed while it was idle
                    pool = _fresh()
                    future = pool.submit(fn, *args, **kwargs)
        except BaseException:
            self._idle.put(None)
            raise
        future.add_done_callback(lambda done: self._idle.put(None if _is_broken(done) else pool))
        return future

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        while not self._idle.empty():
            pool = self._idle.get()
            if pool is not None:
                pool.shutdown(wait, cancel_futures=cancel_futures)


def deaths(error: BaseException) -> int:
    """How many processes were lost at a job that ended with this error; 0 where the error is one of its own."""
    if isinstance(error, BrokenExecutor | CancelledError | OSError):  # the last: it could not be started
        return 1
    # Dask's KilledWorker: its scheduler starts a job again where a worker died, so many times, before it gives up.
    return 1 + error.allowed_failures if hasattr(error, "allowed_failures") else 0


def _fresh() -> ProcessPoolExecutor:
    # Started anew, not forked: a fork would take over threads' locks without the threads.
    return ProcessPoolExecutor(1, multiprocessing.get_context("spawn"), initializer=_become_worker)


def _allow_files(count: int) -> None:
    """Let this process have so many files open, as far as the system lets it: a POSIX one."""
    import resource

    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY:
        count = min(count, hard)
    if soft != resource.RLIM_INFINITY and soft < count:
        with suppress(ValueError, OSError):  # macOS has a limit beside the hard one
            resource.setrlimit(resource.RLIMIT_NOFILE, (count, hard))


def _become_worker() -> None:
    """End with the process that started this one: on its signals, but for those it ignores, and when it is gone."""
    for number in _ENDING:
        if signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, _end_on_signal)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, _ENDING)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        if hasattr(signal, "pthread_kill"):
            # From the main thread, if it can be had: it would go on writing beside this one, whose locks are given up.
            signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGTERM)
            time.sleep(_LAST_CALL)
        _end()


def _end_on_signal(*_: Any) -> None:
    for number in _ENDING:  # another one would come between two steps of this one's end
        signal.signal(number, signal.SIG_IGN)
    _end()


def _end() -> None:
    staging = sys.modules.get("beltrami_cli.formats.staging")
    if staging is not None:
        staging.abandon()
    os._exit(1)


def _is_broken(done: Future[Any]) -> bool:
    return not done.cancelled() and isinstance(done.exception(), BrokenExecutor)


@contextmanager
def _signals_held() -> Iterator[None]:
    """Signals that end a process wait; in one that is started meanwhile until it is a worker, which ends in silence."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, _ENDING)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


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
