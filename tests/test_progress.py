"""The bar appears on a terminal only, and the stopwatch adds up."""

import io
import sys
import time

import pytest

from beltrami_cli.progress import Phases, iteration_bar


class Terminal(io.StringIO):
    def isatty(self):
        return True


def test_bar_counts_to_the_total_on_a_terminal(monkeypatch):
    monkeypatch.setattr(sys, "stderr", Terminal())
    with iteration_bar("flow") as observe:
        observe(1, 3, 0.5)
        time.sleep(0.15)  # tqdm draws at most every 0.1 s
        observe(3, 3, 0.1)
        assert "flow: 100%" in sys.stderr.getvalue() and "3/3" in sys.stderr.getvalue()


@pytest.mark.parametrize(("stream", "quiet"), [(io.StringIO(), False), (Terminal(), True)])
def test_nothing_is_drawn_elsewhere_or_when_quiet(monkeypatch, stream, quiet):
    monkeypatch.setattr(sys, "stderr", stream)
    with iteration_bar("flow", quiet=quiet) as observe:
        assert observe is None
    assert stream.getvalue() == ""


def test_phases_add_up_and_survive_an_error():
    phases = Phases()
    for _ in range(2):
        with phases("read"):
            time.sleep(0.01)
    with pytest.raises(KeyError), phases("flow"):
        raise KeyError
    assert list(phases.seconds) == ["read", "flow"]
    assert 0.02 <= phases.seconds["read"] < 1
