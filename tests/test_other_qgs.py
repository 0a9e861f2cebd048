"""PyPI's climate model `qgs`, installed into our folder."""

import shutil
import subprocess
import sys
from pathlib import Path


def test_the_climate_model_in_our_folder_is_refused(tmp_path):
    (tmp_path / "qgs").mkdir()
    for name in ("__init__.py", "version.py"):
        shutil.copy(Path(__file__).parents[1] / "qgs" / name, tmp_path / "qgs")
    told = []
    for other in ("query_gaussians-0.1.dist-info", "qgs-0.2.8.dist-info"):
        (tmp_path / other).mkdir()
        command = [sys.executable, "-c", "import qgs"]
        told.append(subprocess.run(command, cwd=tmp_path, capture_output=True, text=True).stderr)
    assert not told[0]
    assert "ImportError" in told[1]
