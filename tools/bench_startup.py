"""Median seconds of starting up, beside `import torch`: importing qgs, and commands that answer.

Usage: python tools/bench_startup.py [REPETITIONS]

Unset PYTHONDONTWRITEBYTECODE, or every start compiles qgs anew.
"""

import statistics
import subprocess
import sys
import time
from pathlib import Path

TINY = Path(__file__).parents[1] / "recipes" / "tiny"
QGS = str(Path(sys.executable).with_name("qgs"))
TOKENGS, LOCUS = (str(TINY / f"{name}.yaml") for name in ("tokengs", "locus"))
COMMANDS = (("--help",), ("list",), ("compose", LOCUS), ("diff", TOKENGS, LOCUS))


def seconds(*command: str) -> float:
    """Wall time of one run of `command`."""
    start = time.perf_counter()
    silent = subprocess.DEVNULL
    subprocess.run(command, check=True, stdout=silent, stderr=silent)
    return time.perf_counter() - start


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
    times: dict[str, list[float]] = {name: [] for name in commands}
    for repetition in range(repetitions + 1):
        for name, command in commands.items():
            elapsed = seconds(*command)
            if repetition:  # the first round fills the file cache
                times[name].append(elapsed)
    for name, values in times.items():
        print(f"{statistics.median(values):7.3f} s  {name}")


if __name__ == "__main__":
    main()
