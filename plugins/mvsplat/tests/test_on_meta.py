"""Composing a model on the meta device, as `qgs check` does, is a matter of milliseconds."""

from test_startup import imported_by

CODE = """
import sys, qgs
for name in ("mvsplat", "depthsplat", "landmark", "gslrm", "globalsplat"):
    qgs.compose(f"tiny/{name}.yaml", device="meta")
assert "torch._dynamo" not in sys.modules
"""


def test_no_constructor_needs_torchs_compiler() -> None:
    """Its import takes seconds; initialisers on the meta device are what asks for it."""
    assert "sympy" not in imported_by(CODE)
