"""Peak memory of `qgs import` against the size of the file it reads.

    python tools/measure_import.py [--recipe recipes/locus/dl3dv_4096_4views.yaml] [--kind torch]

Writes random weights of the recipe's model under their published names (LocusGS at published size:
966 MB) into a temporary folder, imports them in a process of its own, and prints the peak resident
memory of that process, mapped file pages included. Exit code 1 above 2.5 times the file.
"""

import argparse
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

LIMIT = 2.5
PUBLISHED = "recipes/locus/dl3dv_4096_4views.yaml"

WRITE = """
import sys, torch
from safetensors.torch import save_file
from qgs.composer import resolve
from qgs.io.published import names_of
recipe = resolve(sys.argv[1])
names = names_of(recipe)
tensors = {theirs: torch.randn(names.shapes[ours]) for ours, theirs in names.published.items()}
tensors |= {name: torch.zeros(recipe.dims.width) for name in names.unused}
if sys.argv[2].endswith(".pt"):
    torch.save({"model": tensors}, sys.argv[2])
else:
    save_file(tensors, sys.argv[2])
"""

IMPORT = """
import resource, sys
from qgs.cli import main
sys.argv = ["qgs", "import", sys.argv[2], "--recipe", sys.argv[1], "--out", sys.argv[3]]
try:
    main()
except SystemExit as stop:
    if stop.code:
        raise
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
"""
# Linux tells ru_maxrss in KiB, and a process inherits its parent's: this one imports no torch.


def peak_of_import(recipe: str, kind: str, folder: Path) -> tuple[int, int]:
    """Bytes of the weight file, and peak resident bytes of the process that imports it."""
    weights = folder / ("weights.pt" if kind == "torch" else "weights.safetensors")
    subprocess.run([sys.executable, "-c", WRITE, recipe, str(weights)], check=True)
    command = [sys.executable, "-c", IMPORT, recipe, str(weights), str(folder / "out.safetensors")]
    told = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    return weights.stat().st_size, int(told.splitlines()[-1])


def main() -> int:
    """Measure, print, judge."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--recipe", default=PUBLISHED)
    parser.add_argument("--kind", choices=("safetensors", "torch"), default="safetensors")
    options = parser.parse_args()
    with TemporaryDirectory() as folder:
        size, peak = peak_of_import(options.recipe, options.kind, Path(folder))
    print(f"file {size / 1e6:,.0f} MB, peak {peak / 1e6:,.0f} MB: {peak / size:.2f} times the file")
    return int(peak > LIMIT * size)


if __name__ == "__main__":
    sys.exit(main())
