"""Fuzz tests: give qgs randomly damaged recipes, checkpoints and data, and check the outcome.

    python tools/fuzz.py recipes --count 2000
    python tools/fuzz.py checkpoints --count 500
    python tools/fuzz.py data --count 100 [--seed 0] [--only 17]
    python tools/fuzz.py kill-training --count 12
    python tools/fuzz.py kill-study --count 12

A case must succeed, or be refused with an error of qgs, within limits of time and memory. For
kill-training and kill-study, processes are killed COUNT times, and no results may be lost. The exit
code is 1 if something is wrong.
"""

import random
import sys
from importlib import import_module
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Literal

import torch
import typer
from fuzzing.cases import fuzz

Kind = Literal["recipes", "checkpoints", "data", "kill-training", "kill-study"]


def main(kind: Kind, count: int = 100, seed: int = 0, only: int | None = None) -> None:
    """Give qgs COUNT random damaged cases, or kill it COUNT times; exit with 1 if one is wrong.

    --seed: random seed of all cases. --only: number of a single case to use and show.
    """
    torch.set_num_threads(1)
    name, _, killed = kind.partition("-")
    # Photos in all formats are written by what the tests have.
    sys.path.append(str(Path(__file__).parents[1] / "tests"))
    module = import_module(f"fuzzing.{name}")
    with TemporaryDirectory() as folder:
        scratch = Path(folder)
        if killed:
            random.seed(seed)
            sys.exit(getattr(module, killed)(scratch, count))
        sys.exit(fuzz(module, scratch, seed, count, only))


if __name__ == "__main__":
    typer.run(main)
