"""One of several training processes; started by test_distributed.py."""

import sys
from collections.abc import Generator
from pathlib import Path
from typing import Any

import torch

from qgs.composer import resolve
from qgs.data.samples import Batch
from qgs.data.stream import SampleError, SampleStream, Share, training_batches
from qgs.engine import training
from qgs.engine.training import train


def spoiled(*arguments: Any, share: Share, **options: Any) -> Generator[Batch, None, None]:
    """`training_batches`, of which the second process's second batch has a bad pixel."""
    stream = training_batches(*arguments, share=share, **options)
    try:
        for number, batch in enumerate(stream):
            if share.rank == 1 and number == 1:
                batch.targets.images[0, 0, 0, 0, 0] = torch.nan
            yield batch
    finally:
        stream.close()


def without(bad: int) -> None:
    """Make sample number `bad`, which takes the place of none, one that cannot be made."""
    made = SampleStream._made

    def failing(stream: SampleStream, number: int, attempt: int) -> Any:
        if number == bad and not attempt:
            raise SampleError(f"scene 'x', frame {bad} (a.png): cannot be read")
        return made(stream, number, attempt)

    SampleStream._made = failing


def main(recipe: str, run: str, spoil: str = "") -> None:
    """Train, and print what this process knows of it."""
    torch.set_num_threads(1)
    if spoil.isdecimal():
        without(int(spoil))
    elif spoil:
        training.training_batches = spoiled
    try:
        result = train(resolve(Path(recipe)), run, device="cpu", resume=True)
    except (
        SampleError
    ) as error:  # told by both, though a launcher ends the others of one that fails
        print(f"refused: {error}; {error.__notes__ if hasattr(error, '__notes__') else ''}")
        return
    for reason, times in result.left_out.items():
        print(f"left out: {times} times {reason}")
    total = sum(float(p.detach().double().abs().sum()) for p in result.model.parameters())
    print(f"{result.main} {result.steps} {total:.6f}")


if __name__ == "__main__":
    main(*sys.argv[1:])
