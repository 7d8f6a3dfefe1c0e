"""Processes of this machine: a slot is never lost, and none costs anything before it is needed."""

from __future__ import annotations

import os
import signal
from concurrent.futures import ProcessPoolExecutor

import pytest

from beltrami_cli import executors
from beltrami_cli.executors import Processes, deaths

resource = pytest.importorskip("resource")


@pytest.fixture
def soft_limit():
    """Sets how many files this process may have open, for a test."""
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    yield lambda soft: resource.setrlimit(resource.RLIMIT_NOFILE, (soft, before[1]))
    resource.setrlimit(resource.RLIMIT_NOFILE, before)


def open_files() -> int:
    return len(os.listdir("/dev/fd"))


@pytest.mark.parametrize("place", ["_spawn_process", "__init__"])
def test_a_process_that_cannot_be_started_costs_no_slot(monkeypatch, place):
    real, calls = getattr(ProcessPoolExecutor, place), []

    def fails_twice(self, *args, **named):
        calls.append(self)
        if len(calls) <= 2:
            raise BlockingIOError(11, "Resource temporarily unavailable")
        return real(self, *args, **named)

    with Processes(1, 1) as processes:
        monkeypatch.setattr(ProcessPoolExecutor, place, fails_twice)
        for _ in range(2):
            with pytest.raises(BlockingIOError):
                processes.submit(os.getpid)
        assert processes.submit(os.getpid).result(60) != os.getpid()


def test_what_counts_as_a_lost_process():
    assert deaths(BlockingIOError(11, "Resource temporarily unavailable")) == 1
    assert deaths(OSError(24, "Too many open files")) == 1
    assert deaths(ValueError("of the job")) == 0


def test_processes_open_nothing_before_they_are_needed():
    Processes(1, 1).shutdown()  # what all share
    before = open_files()
    with Processes(500, 1) as processes:
        assert processes.slots() == 500
        assert open_files() <= before  # other things may have closed meanwhile


def test_the_limit_of_open_files_allows_all_processes(soft_limit):
    soft_limit(256)
    with Processes(60, 1) as processes:
        before = open_files()
        processes.submit(os.getpid).result(60)
        assert 0 < open_files() - before <= executors._FILES
        assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] >= before + 60 * executors._FILES
    soft_limit(256)
    Processes(2, 1).shutdown()
    assert resource.getrlimit(resource.RLIMIT_NOFILE)[0] == 256


@pytest.mark.parametrize(("hard", "soft"), [(1000, 1000), (resource.RLIM_INFINITY, 8 * 500 + 100)])
def test_the_hard_limit_of_open_files_stands(monkeypatch, hard, soft):
    given = []
    monkeypatch.setattr(resource, "getrlimit", lambda _: (256, hard))
    monkeypatch.setattr(resource, "setrlimit", lambda _, limits: given.append(limits))
    Processes(500, 1).shutdown()
    assert given == [(soft, hard)]


def test_a_worker_ignores_the_signals_that_its_batch_ignores():
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        with Processes(1, 1) as processes:
            assert processes.submit(signal.getsignal, signal.SIGINT).result(60) == signal.SIG_IGN
            assert processes.submit(signal.raise_signal, signal.SIGINT).result(60) is None
    finally:
        signal.signal(signal.SIGINT, before)
