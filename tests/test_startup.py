"""What starting up may import."""

import subprocess
import sys

HEAVY = {"accelerate", "gsplat", "matplotlib", "numba", "pydantic", "scipy"}


def imported_by(code: str) -> set[str]:
    """Top-level packages that a fresh interpreter holds after running `code`."""
    report = "import sys; print(*{name.partition('.')[0] for name in sys.modules})"
    result = subprocess.run(
        [sys.executable, "-c", f"{code}\n{report}"], capture_output=True, text=True, check=True
    )
    return set(result.stdout.splitlines()[-1].split())


def test_import_qgs_needs_no_library() -> None:
    assert imported_by("import qgs") & (HEAVY | {"torch", "typer", "yaml"}) == set()


def test_containers_need_torch_alone() -> None:
    imported = imported_by("import qgs; qgs.Views, qgs.Cameras, qgs.Gaussians")
    assert "torch" in imported
    assert imported & HEAVY == set()


def test_optional_libraries_wait_until_they_render() -> None:
    imported = imported_by("import qgs.components, qgs.renderers")
    assert imported & {"numba", "gsplat"} == set()


def test_help_needs_no_torch() -> None:
    code = """
import sys
import qgs.cli
sys.argv = ["qgs", "--help"]
try:
    qgs.cli.main()
except SystemExit as stop:
    assert stop.code in (0, None), stop.code
"""
    assert imported_by(code) & (HEAVY | {"torch"}) == set()
