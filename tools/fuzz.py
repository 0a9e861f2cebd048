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

import argparse
import random
import sys
import tempfile
from importlib import import_module
from pathlib import Path

import torch
from fuzzing.cases import fuzz


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    kinds = ("recipes", "checkpoints", "data", "kill-training", "kill-study")
    parser.add_argument("kind", choices=kinds)
    parser.add_argument("--count", type=int, default=100, help="number of cases or kills")
    parser.add_argument("--seed", type=int, default=0, help="random seed of all cases")
    parser.add_argument("--only", type=int, help="number of a single case to use and show")
    options = parser.parse_args()
    torch.set_num_threads(1)
    module, _, killed = options.kind.partition("-")
    # Photos in all formats are written by what the tests have.
    sys.path.append(str(Path(__file__).parents[1] / "tests"))
    kind = import_module(f"fuzzing.{module}")
    with tempfile.TemporaryDirectory() as folder:
        scratch = Path(folder)
        if killed:
            random.seed(options.seed)
            return getattr(kind, killed)(scratch, options.count)
        return fuzz(kind, scratch, options.seed, options.count, options.only)


if __name__ == "__main__":
    sys.exit(main())
