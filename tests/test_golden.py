"""Results stay what they were: summary figures of tiny runs against stored ones (see regenerate_golden.py)."""

from __future__ import annotations

import json

import pytest
from regenerate_golden import GOLDEN, PHANTOMS, RUNS, summary

STORED = json.loads(GOLDEN.read_text())


def test_every_run_is_stored():
    assert {name: set(runs) for name, runs in STORED.items()} == {name: set(RUNS) for name in PHANTOMS}


@pytest.mark.parametrize("run", RUNS)
@pytest.mark.parametrize("name", PHANTOMS)
def test_figures_stay(name, run):
    assert summary(name, run) == pytest.approx(STORED[name][run], rel=1e-4, abs=1e-6)
