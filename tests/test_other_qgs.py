"""The climate model `qgs` of PyPI in the place of ours, or beside it."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
REMEDY = "`pip uninstall qgs`, then `pip install --force-reinstall --no-deps query-gaussians`"


def run(code: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Python's `code` where `folder` comes before every other place."""
    start = f"import sys; sys.path.insert(0, {str(folder)!r}); "
    return subprocess.run([sys.executable, "-c", start + code], capture_output=True, text=True)


@pytest.mark.parametrize("info", ["qgs-0.2.8.dist-info", "qgs-1.0.egg-info"])
def test_both_in_one_folder_are_told(tmp_path: Path, info: str) -> None:
    (tmp_path / "qgs").mkdir()
    shutil.copy(ROOT / "qgs/__init__.py", tmp_path / "qgs")
    assert run("import qgs; print(qgs.__file__)", tmp_path).returncode == 0
    (tmp_path / "qgs_locus-0.1.dist-info").mkdir()
    (tmp_path / "query_gaussians-0.1.dist-info").mkdir()
    assert run("import qgs", tmp_path).returncode == 0
    (tmp_path / info).mkdir()
    done = run("import qgs", tmp_path)
    assert "ImportError: PyPI's `qgs`, a climate model, is installed" in done.stderr
    assert REMEDY in done.stderr


def test_the_command_tells_that_it_found_another_package(tmp_path: Path) -> None:
    (tmp_path / "qgs").mkdir()
    (tmp_path / "qgs/__init__.py").write_text('"""Quasi-geostrophic spectral model."""\n')
    shutil.copy(ROOT / "query_gaussians.py", tmp_path)
    done = run("from query_gaussians import main; main()", tmp_path)
    assert done.returncode == 1
    assert f"{tmp_path}/qgs/__init__.py is not the one of query-gaussians" in done.stderr
    assert REMEDY in done.stderr
    assert "Traceback" not in done.stderr
