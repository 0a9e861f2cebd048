"""Chance, the same each time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch


@contextmanager
def drawn_from(seed: int) -> Iterator[None]:
    """What is drawn from torch's global generator comes from `seed`; nothing of it stays."""
    with torch.random.fork_rng(devices=()):
        torch.default_generator.manual_seed(seed)
        yield


def draws(module: Any, *inputs: Any) -> bool:
    """Whether a forward pass draws from torch's global generator, as dropout in training does."""
    with drawn_from(0), torch.no_grad():
        before = torch.get_rng_state()
        module(*inputs)
        return not torch.equal(before, torch.get_rng_state())
