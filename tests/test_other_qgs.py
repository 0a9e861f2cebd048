"""PyPI's climate model `qgs`, installed into our folder."""

import shutil
import subprocess
import sys
from pathlib import Path

INIT = Path(__file__).parents[1] / "qgs/__init__.py"


def test_the_climate_model_in_our_folder_is_refused(tmp_path: Path) -> None:
    (tmp_path / "qgs").mkdir()
    shutil.copy(INIT, tmp_path / "qgs")
    (tmp_path / "query_gaussians-0.1.dist-info").mkdir()

    def imported() -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-c", "import qgs"]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)

    assert imported().returncode == 0
    (tmp_path / "qgs-0.2.8.dist-info").mkdir()
    assert "ImportError" in imported().stderr
