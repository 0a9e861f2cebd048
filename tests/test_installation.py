"""All distributions by one line; another `qgs` is refused; no environment is deleted but ours."""

import shutil
import subprocess
import sys
import tomllib

from size import ROOT
from tables import names_in


def project(folder):
    return tomllib.loads((ROOT / folder / "pyproject.toml").read_text())["project"]


def test_all_distributions_are_named_where_everything_is_installed():
    folders = {path.parent.name for path in ROOT.glob("plugins/*/pyproject.toml")}
    lines = (ROOT / "plugins/all.txt").read_text().splitlines()
    assert {f"-e plugins/{folder}" for folder in folders} <= {*lines}
    everything = project(".")["optional-dependencies"]["all"]
    released = {name.split(">")[0] for name in everything if name.startswith("query-")}
    assert released == {project(f"plugins/{folder}")["name"] for folder in folders}
    assert released == {f"query-gaussians-{folder}" for folder in folders}


def test_the_climate_model_in_our_folder_is_refused(tmp_path):
    (tmp_path / "qgs").mkdir()
    for name in ("__init__.py", "version.py"):
        shutil.copy(ROOT / "qgs" / name, tmp_path / "qgs")
    told = []
    for other in ("query_gaussians-0.1.dist-info", "qgs-0.2.8.dist-info"):
        (tmp_path / other).mkdir()
        command = [sys.executable, "-c", "import qgs"]
        told.append(subprocess.run(command, cwd=tmp_path, capture_output=True, text=True).stderr)
    assert not told[0]
    assert "ImportError" in told[1]


FAKE_PYTHON = '#!/bin/sh\nif [ "$2" = venv ]; then mkdir -p "$3/bin"; fi\n'


def make_environment(directory):
    """Source the script with a Python that only makes folders, and make `directory`."""
    python = directory.parent / "python"
    python.write_text(FAKE_PYTHON)
    python.chmod(0o755)
    script = f"""
set -euo pipefail
source "{ROOT}/tools/environment.sh"
find_python() {{ echo "{python}"; }}
make_environment "{directory}"
"""
    return subprocess.run(["bash", "-c", script], capture_output=True, text=True)


def test_its_own_environment_is_made_again_and_that_of_someone_else_never_deleted(tmp_path):
    venv = tmp_path / ".venv"
    venv.mkdir()
    (venv / "left-over").touch()
    refused = make_environment(venv)
    assert refused.returncode == 1
    assert "move" in refused.stderr
    assert names_in(venv) == {"left-over"}
    (venv / ".qgs-made").touch()
    assert make_environment(venv).returncode == 0
    assert names_in(venv) == {".qgs-made", "bin"}
