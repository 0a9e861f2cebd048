"""Composing a model on the meta device, as `qgs check` does, is a matter of milliseconds."""

import subprocess
import sys

CODE = """
import sys, qgs
for name in ("mvsplat", "depthsplat", "landmark", "gslrm", "globalsplat"):
    qgs.compose(f"tiny/{name}.yaml", device="meta")
print("torch._dynamo" in sys.modules, "sympy" in sys.modules)
"""


def test_no_constructor_needs_torchs_compiler() -> None:
    """Its import takes seconds; initialisers on the meta device are what asks for it."""
    found = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["False", "False"]
