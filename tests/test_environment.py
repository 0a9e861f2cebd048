"""tools/environment.sh deletes no environment but its own."""

import subprocess
from pathlib import Path

ENVIRONMENT = Path(__file__).parents[1] / "tools" / "environment.sh"
FAKE_PYTHON = '#!/bin/sh\nif [ "$2" = venv ]; then mkdir -p "$3/bin"; fi\n'


def make_environment(directory):
    """Source the script with a Python that only makes folders, and make `directory`."""
    python = directory.parent / "python"
    python.write_text(FAKE_PYTHON)
    python.chmod(0o755)
    script = f"""
set -euo pipefail
source "{ENVIRONMENT}"
find_python() {{ echo "{python}"; }}
make_environment "{directory}"
"""
    return subprocess.run(["bash", "-c", script], capture_output=True, text=True)


def test_an_environment_of_someone_else_is_never_deleted(tmp_path):
    venv = tmp_path / ".venv"
    venv.mkdir()
    (venv / "notes.txt").write_text("mine")
    result = make_environment(venv)
    assert result.returncode == 1
    assert "move" in result.stderr
    assert [path.name for path in venv.iterdir()] == ["notes.txt"]


def test_an_environment_of_its_own_is_made_again(tmp_path):
    venv = tmp_path / ".venv"
    venv.mkdir()
    (venv / ".qgs-made").touch()
    (venv / "left-over").touch()
    result = make_environment(venv)
    assert result.returncode == 0, result.stderr
    assert {path.name for path in venv.iterdir()} == {".qgs-made", "bin"}
