"""Median seconds of starting up, beside `import torch`: importing qgs, and commands that answer.

Usage: python tools/bench_startup.py [REPETITIONS]

Unset PYTHONDONTWRITEBYTECODE, or every start compiles qgs anew.
"""

import statistics
import subprocess
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

from qgs_bench.run import in_turn

TINY = Path(__file__).parents[1] / "recipes" / "tiny"
QGS = str(Path(sys.executable).with_name("qgs"))
TOKENGS, LOCUS = (str(TINY / f"{name}.yaml") for name in ("tokengs", "locus"))
COMMANDS = (("--help",), ("list",), ("compose", LOCUS), ("diff", TOKENGS, LOCUS))


def run(command: Sequence[str]) -> None:
    """One run of `command`, in silence."""
    silent = subprocess.DEVNULL
    subprocess.run(command, check=True, stdout=silent, stderr=silent)


def main() -> None:
    repetitions = int(sys.argv[1]) if len(sys.argv) > 1 else 7
    commands = {
        "import torch": (sys.executable, "-c", "import torch"),
        "import torch, qgs": (sys.executable, "-c", "import torch, qgs"),
        "import torch, every public name of qgs": (
            sys.executable,
            "-c",
            "import torch, qgs; [getattr(qgs, name) for name in qgs.__all__]",
        ),
        **{" ".join(("qgs", *words)): (QGS, *words) for words in COMMANDS},
    }
    # The first round fills the file cache.
    columns = in_turn([partial(run, c) for c in commands.values()], repetitions, warmup=1)
    for name, values in zip(commands, columns, strict=True):
        print(f"{statistics.median(values):7.3f} s  {name}")


if __name__ == "__main__":
    main()
