"""One of two training processes, of which the second sees a NaN in its second batch."""

from __future__ import annotations

import sys
from collections.abc import Generator
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from qgs.composer import resolve
from qgs.data.sampling import Batch
from qgs.data.stream import Share, training_batches
from qgs.engine import train, training


def spoiled(*arguments: Any, share: Share, **options: Any) -> Generator[Batch, None, None]:
    """`training_batches`, of which the second process's second batch has a bad pixel."""
    stream = training_batches(*arguments, share=share, **options)
    try:
        for number, batch in enumerate(stream):
            if share.rank == 1 and number == 1:
                images = batch.targets.images.clone()
                images[0, 0, 0, 0, 0] = torch.nan
                batch = replace(batch, targets=replace(batch.targets, images=images))
            yield batch
    finally:
        stream.close()


def main(recipe: str, run: str) -> None:
    """Train, and print what this process knows of it."""
    torch.set_num_threads(1)
    training.training_batches = spoiled
    result = train(resolve(Path(recipe)), run, device="cpu")
    total = sum(float(p.detach().double().abs().sum()) for p in result.model.parameters())
    print(f"{result.main} {result.steps} {total:.9f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
