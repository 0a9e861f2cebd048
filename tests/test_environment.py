"""tools/environment.sh deletes no environment but its own."""

import subprocess
from pathlib import Path

ENVIRONMENT = Path(__file__).parents[1] / "tools/environment.sh"
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


def test_its_own_environment_is_made_again_and_that_of_someone_else_never_deleted(tmp_path):
    venv = tmp_path / ".venv"
    venv.mkdir()
    (venv / "left-over").touch()
    refused = make_environment(venv)
    assert refused.returncode == 1
    assert "move" in refused.stderr
    assert [path.name for path in venv.iterdir()] == ["left-over"]
    (venv / ".qgs-made").touch()
    assert make_environment(venv).returncode == 0
    assert {path.name for path in venv.iterdir()} == {".qgs-made", "bin"}
