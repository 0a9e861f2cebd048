"""What starting up may import."""

import subprocess
import sys

STAGES = """
import sys
import qgs
def held():
    print(*{name.partition(".")[0] for name in sys.modules})
held()
import qgs.cli
sys.argv = ["qgs", "--help"]
try:
    qgs.cli.main()
except SystemExit as stop:
    assert not stop.code
print()
held()
qgs.Views, qgs.Cameras, qgs.Gaussians
held()
import qgs.tokengs, qgs.renderers
held()
for name in ("mvsplat", "depthsplat", "landmark", "gslrm", "globalsplat"):
    qgs.compose(f"tiny/{name}.yaml", device="meta")
held()
"""
HEAVY = {"accelerate", "gsplat", "matplotlib", "numba", "pydantic", "scipy"}


def test_libraries_wait_until_they_are_needed():
    """One process, as far as `import qgs`, the help, containers, components, models on meta.

    Initialisers on the meta device might ask for torch's compiler, whose import takes seconds.
    """
    shown = subprocess.check_output([sys.executable, "-c", STAGES], text=True)
    package, *_, helped, containers, components, composed = (
        set(line.split()) for line in shown.splitlines()
    )
    assert package & (HEAVY | {"torch", "typer", "yaml"}) == set()
    assert helped & (HEAVY | {"torch", "numpy"}) == set()
    assert "torch" in containers
    assert containers & HEAVY == set()
    assert components & {"numba", "gsplat"} == set()
    assert "sympy" not in composed
