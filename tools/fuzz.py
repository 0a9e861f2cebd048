"""Give qgs what users and strangers give, damaged at random, and see how each case ends.

    python tools/fuzz.py recipes --count 2000
    python tools/fuzz.py checkpoints --count 500
    python tools/fuzz.py data --count 100 [--seed 0] [--only 17]
    python tools/fuzz.py kill-training --count 12
    python tools/fuzz.py kill-study --count 12

A case must end in success or in one of our errors, within limits of time and memory. A training
and a study are killed `count` times, and nothing may be lost. Exit status 1 if something is wrong.
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
    parser.add_argument("--count", type=int, default=100, help="how many cases or kills")
    parser.add_argument("--seed", type=int, default=0, help="a case depends on it and its number")
    parser.add_argument("--only", type=int, help="number of the one case to show and use")
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
