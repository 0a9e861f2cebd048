"""The memory that importing a file of a gigabyte takes."""

import subprocess
import sys
from pathlib import Path

import pytest

PUBLISHED = Path(__file__).parents[3] / "recipes/locus/dl3dv_4096_4views.yaml"
WRITE = """
import sys, torch
from safetensors.torch import save_file
from qgs.composer import resolve
from qgs_published.layouts import names_of
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
from pathlib import Path
from qgs.cli import main
try:
    main()
except SystemExit as stop:
    if stop.code:
        raise
(line,) = (x for x in Path("/proc/self/status").read_text().splitlines() if x.startswith("VmHWM"))
print(int(line.split()[1]) * 1024)
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads Linux's accounts")
@pytest.mark.parametrize("name", ["weights.safetensors", "weights.pt"])
def test_a_published_file_is_imported_without_copies(tmp_path: Path, name: str) -> None:
    file = tmp_path / name
    subprocess.run([sys.executable, "-c", WRITE, str(PUBLISHED), str(file)], check=True)
    out = str(tmp_path / "out.safetensors")
    words = ("import", str(file), "--recipe", str(PUBLISHED), "--out", out)
    command = [sys.executable, "-c", IMPORT, *words]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert (size := file.stat().st_size) > 0.9e9
    assert int(printed.splitlines()[-1]) < 2.5 * size
