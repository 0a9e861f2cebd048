"""One of several training processes; started by test_distributed.py."""

from __future__ import annotations

import sys
from pathlib import Path

import torch

from qgs.composer import resolve
from qgs.engine import train


def main(recipe: str, run: str) -> None:
    """Train, and print what this process knows of it."""
    torch.set_num_threads(1)
    result = train(resolve(Path(recipe)), run, device="cpu", resume=True)
    total = sum(float(p.detach().double().abs().sum()) for p in result.model.parameters())
    print(f"{result.main} {result.steps} {total:.6f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
