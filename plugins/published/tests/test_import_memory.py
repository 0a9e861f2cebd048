"""The memory that importing a file of a gigabyte takes."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from qgs_published.layouts import names_of
from safetensors.torch import save_file

from qgs.composer import resolve

PUBLISHED = Path(__file__).parents[3] / "recipes/locus/dl3dv_4096_4views.yaml"
IMPORT = """
from qgs.cli import app
from qgs_bench.memory import resident_bytes
app(standalone_mode=False)
print(resident_bytes("VmHWM"))
"""


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="reads Linux's accounts")
@pytest.mark.parametrize("name", ["weights.safetensors", "weights.pt"])
def test_a_published_file_is_imported_without_copies(tmp_path: Path, name: str) -> None:
    recipe, file, out = resolve(PUBLISHED), tmp_path / name, tmp_path / "out.safetensors"
    names = names_of(recipe)
    tensors = {theirs: torch.randn(names.shapes[ours]) for ours, theirs in names.published.items()}
    tensors |= {name: torch.zeros(recipe.dims.width) for name in names.unused}
    torch.save({"model": tensors}, file) if name.endswith(".pt") else save_file(tensors, file)
    words = ("import", str(file), "--recipe", str(PUBLISHED), "--out", str(out))
    command = [sys.executable, "-c", IMPORT, *words]
    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    assert (size := file.stat().st_size) > 0.9e9
    assert int(printed.splitlines()[-1]) < 2.5 * size
