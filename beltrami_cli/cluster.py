"""The workers of a Dask scheduler as an executor, and what a job can know of the worker that it runs in."""

from __future__ import annotations

import json
import logging
import math
import re
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from beltrami_cli.errors import RefusedError, in_a_line
from beltrami_cli.executors import Workers

# Seconds to wait for a scheduler to answer: it does so at once, or its address is wrong.
_ANSWER = 10
# Seconds without any worker after which that is worth a word.
_LONELY = 5
# Of a Dask worker's memory: where it takes more, its nanny ends it.
_USABLE = 0.95


class Cluster(Workers):
    """The workers of a Dask scheduler.

    address: of the scheduler, for messages. notify: called with a line while no worker is there.
    """

    one_machine = False

    def __init__(self, client: Any, address: str, notify: Callable[[str], None]) -> None:
        self._client, self._address, self._notify = client, address, notify
        self._dask = client.get_executor(pure=False)
        self._alone_since: float | None = None

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """As Executor.submit; where the connection is lost, the future is cancelled."""
        return self._dask.submit(fn, *args, **kwargs)

    def slots(self) -> int:
        """One for each worker; raises ConnectionError where the scheduler is gone.

        Not more: where a worker dies, Dask blames all the jobs that wait there too.
        """
        count = self._count()
        now = time.monotonic()
        if count:
            self._alone_since = None
        elif self._alone_since is None:
            self._alone_since = now + _LONELY
        elif now > self._alone_since:
            self._notify(f"waiting for workers at {self._address}")
            self._alone_since = math.inf
        return count

    def _count(self) -> int:
        end = time.monotonic() + _ANSWER
        while self._client.status in ("running", "connecting") and time.monotonic() < end:
            if self._client.status == "running":
                with suppress(OSError, ValueError, AttributeError):  # a client that is losing its connection
                    return len(self._client.nthreads(callback_timeout=_ANSWER))
            time.sleep(0.1)
        raise ConnectionError(
            f"the scheduler at {self._address} is gone; start it again, with workers, and use --resume for the rest"
        )


@contextmanager
def cluster(address: str, notify: Callable[[str], None] = lambda line: None) -> Iterator[Cluster]:
    """The workers of a Dask scheduler, by its address or the .json file that it wrote.

    notify: called with a line while no worker is there. Raises RefusedError where Dask is not installed or no
    scheduler answers.
    """
    try:
        from distributed import Client
    except ImportError:
        raise RefusedError(
            "scheduler: needs Dask, which is not installed; install it: pip install 'beltrami_cli[cluster]'"
        ) from None
    # What it has to tell of workers and connections is told here in a line, or stands in their own logs.
    for name in ("distributed", "distributed.client", "tornado.application"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    where = _address_in(Path(address)) if address.endswith(".json") else address
    # Checked here: Dask's client that cannot parse its address says much, and takes 20 s to end.
    if not re.fullmatch(r"((tcp|tls|ucx|wss?)://)?[^/\s]+:\d+", where):
        raise RefusedError(f"scheduler: found {where!r}; expected an address as tcp://HOST:8786, or a .json file")
    try:
        client = _within(_ANSWER + 1, lambda: Client(where, timeout=_ANSWER, set_as_default=False))
    except (OSError, ValueError, ImportError) as error:
        reason = in_a_line(error) or type(error).__name__
        raise RefusedError(
            f"scheduler: {where}: none answers there ({reason}); start it, or check the address"
        ) from None
    with client:
        yield Cluster(client, where, notify)


def _address_in(file: Path) -> str:
    """What a scheduler's file says of where it is; raises RefusedError where it does not."""
    try:
        return str(json.loads(file.read_text(encoding="utf-8"))["address"])
    except FileNotFoundError:
        raise RefusedError(f"scheduler: {file}: no such file; expected the one that dask scheduler wrote") from None
    except (OSError, ValueError, LookupError, TypeError):
        raise RefusedError(f"scheduler: {file}: cannot be read; expected the file that dask scheduler wrote") from None


def _within(seconds: float, make: Callable[[], Any]) -> Any:
    """What `make` returns or raises; TimeoutError after so long: Dask waits for ever for what is no Dask."""
    made: Future[Any] = Future()

    def work() -> None:
        try:
            made.set_result(make())
        except BaseException as error:
            made.set_exception(error)

    threading.Thread(target=work, daemon=True).start()
    try:
        return made.result(seconds)
    except TimeoutError:
        raise TimeoutError(f"no answer within {seconds:.0f} s") from None


def own_threads() -> int | None:
    """Threads that this process may use for a job, as a Dask worker's; None where nothing says so."""
    worker = _dask_worker()
    return None if worker is None else int(worker.state.nthreads)


def own_memory() -> int | None:
    """Bytes that a Dask worker in this process may take; None where there is none, or no limit."""
    worker = _dask_worker()
    limit = None if worker is None else worker.memory_manager.memory_limit
    return None if limit is None else int(_USABLE * limit)


def own_place() -> str:
    """What a message from a Dask worker in this process starts with, for its files may be others; else empty."""
    worker = _dask_worker()
    return "" if worker is None else f"on worker {worker.address}: "


def _dask_worker() -> Any:
    if "distributed" not in sys.modules:
        return None
    from distributed import get_worker

    try:
        return get_worker()
    except ValueError:  # not in a worker
        return None
