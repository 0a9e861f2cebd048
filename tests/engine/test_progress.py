"""What a person reads while a model trains."""

from __future__ import annotations

import io
import re

import pytest
from rich.console import Console

from qgs.engine import tracking as progress
from qgs.engine.tracking import TrainingProgress


def shown(monkeypatch: pytest.MonkeyPatch, *steps: tuple[int, int, float, float]) -> list[str]:
    """The lines for (step, images, seconds, used), each shown."""
    monkeypatch.setattr(progress, "_LOG_SECONDS", 0.0)
    told = io.StringIO()
    console = Console(width=200, file=told)
    with TrainingProgress(console) as bar:
        for step, images, seconds, used in steps:
            assert bar.update(step, 0.1, 20.0, images, seconds, used)
    return [line for line in told.getvalue().splitlines() if line]


def left(line: str) -> str:
    found = re.search(r"(\S+) left", line)
    assert found
    return found[1]


def test_the_first_step_has_no_speed_yet(monkeypatch: pytest.MonkeyPatch) -> None:
    (line,) = shown(monkeypatch, (1, 8, 0.0, 0.01))
    assert left(line) == "?"
    assert "0 images/s" in line


def test_time_left_is_what_the_rest_takes_at_this_speed(monkeypatch: pytest.MonkeyPatch) -> None:
    *_, line = shown(monkeypatch, (1, 8, 0.0, 0.01), (26, 208, 100.0, 0.26))
    assert left(line) == "0:04:56", "0.74 of the budget, 100 s for each 0.25"
    assert "2 images/s" in line


def test_a_resumed_run_counts_from_where_it_resumed(monkeypatch: pytest.MonkeyPatch) -> None:
    slow_before = 10_000.0
    first, second = (501, 4008, slow_before, 0.501), (601, 4808, slow_before + 10, 0.601)
    *_, line = shown(monkeypatch, first, second)
    assert left(line) == "0:00:40"
    assert "80 images/s" in line
