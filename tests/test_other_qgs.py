"""The climate model `qgs` of PyPI in the place of ours, or beside it; our own former name."""

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
REMEDY = "Run `pip uninstall qgs`, then install query-gaussians again from where it came"
COMMAND = "from query_gaussians import main; main()"


def run(code: str, *folders: Path) -> subprocess.CompletedProcess[str]:
    """Python's `code` where `folders` come before every other place."""
    start = f"import sys; sys.path[:0] = {list(map(str, folders))!r}; "
    return subprocess.run([sys.executable, "-c", start + code], capture_output=True, text=True)


@pytest.fixture
def ours(tmp_path: Path) -> Path:
    """A folder with our package and command, and metadata of our distributions."""
    folder = tmp_path / "ours"
    for name in ("qgs", "qgs_locus-0.1.dist-info", "query_gaussians-0.1.dist-info"):
        (folder / name).mkdir(parents=True)
    shutil.copy(ROOT / "qgs/__init__.py", folder / "qgs")
    shutil.copy(ROOT / "query_gaussians.py", folder)
    return folder


@pytest.mark.parametrize("info", ["qgs-0.2.8.dist-info", "qgs-1.0.egg-info"])
@pytest.mark.parametrize("place", ["ours", "site"], ids=["a wheel", "editable"])
def test_the_climate_model_beside_ours_is_told(
    ours: Path, tmp_path: Path, info: str, place: str
) -> None:
    assert run("import qgs", ours, tmp_path / "site").returncode == 0
    (tmp_path / place / info).mkdir(parents=True)
    told = f"the distribution `qgs` (a climate model; {tmp_path / place / info}) is installed"
    for code, start in (("import qgs", "ImportError: "), (COMMAND, "error: ")):
        done = run(code, ours, tmp_path / "site")
        assert done.returncode == 1
        assert start + told in done.stderr
        assert REMEDY in done.stderr
    assert "Traceback" not in done.stderr


def test_our_former_name_is_told_where_it_put_files(ours: Path, tmp_path: Path) -> None:
    former = tmp_path / "site/qgs-0.1.0.dist-info"
    former.mkdir(parents=True)
    (former / "METADATA").write_text("Name: qgs\nSummary: Query-based 3D Gaussian splatting\n")
    assert run("import qgs", ours, tmp_path / "site").returncode == 0, "it was `pip install -e`"
    shutil.copytree(former, ours / former.name)
    done = run("import qgs", ours)
    assert "`qgs` (query-gaussians under its former name; " in done.stderr
    assert REMEDY in done.stderr


def test_the_command_tells_that_it_found_another_package(tmp_path: Path) -> None:
    (tmp_path / "qgs").mkdir()
    (tmp_path / "qgs/__init__.py").write_text('"""Quasi-geostrophic spectral model."""\n')
    shutil.copy(ROOT / "query_gaussians.py", tmp_path)
    done = run(COMMAND, tmp_path)
    assert done.returncode == 1
    assert f"{tmp_path}/qgs/__init__.py is not the one of query-gaussians" in done.stderr
    assert REMEDY in done.stderr
    assert "Traceback" not in done.stderr
