"""What tools/environment.sh does to a folder in its way, and how tools/test runs pytest."""

import os
import shutil
import subprocess
from pathlib import Path

import pytest

ENVIRONMENT = Path(__file__).parents[1] / "tools" / "environment.sh"
FAKE_PYTHON = '#!/bin/sh\nif [ "$2" = venv ]; then mkdir -p "$3/bin"; fi\n'


def make_environment(directory: Path) -> subprocess.CompletedProcess[str]:
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


def test_an_environment_of_someone_else_is_never_deleted(tmp_path: Path) -> None:
    venv = tmp_path / ".venv"
    venv.mkdir()
    (venv / "notes.txt").write_text("mine")
    result = make_environment(venv)
    assert result.returncode == 1
    assert "move" in result.stderr
    assert [path.name for path in venv.iterdir()] == ["notes.txt"]


def test_an_environment_of_its_own_is_made_again(tmp_path: Path) -> None:
    venv = tmp_path / ".venv"
    venv.mkdir()
    (venv / ".qgs-made").touch()
    (venv / "left-over").touch()
    result = make_environment(venv)
    assert result.returncode == 0, result.stderr
    assert {path.name for path in venv.iterdir()} == {".qgs-made", "bin"}


def test_a_first_environment_is_stamped(tmp_path: Path) -> None:
    result = make_environment(tmp_path / ".venv")
    assert result.returncode == 0, result.stderr
    assert (tmp_path / ".venv" / ".qgs-made").is_file()


@pytest.mark.parametrize(
    ("arguments", "processes"),
    [("", True), ("tests/golden -x", True), ("tests/test_a.py -x", False), ("-m slow", False)],
)
def test_files_and_markers_are_run_in_one_process(
    tmp_path: Path, arguments: str, processes: bool
) -> None:
    shutil.copy(ENVIRONMENT.with_name("test"), tmp_path)
    (tmp_path / "environment.sh").write_text(f"root={tmp_path}\nuse_environment() {{ :; }}\n")
    (tmp_path / "python").write_text('#!/bin/sh\necho "${OMP_NUM_THREADS-all}" "$@"\n')
    (tmp_path / "python").chmod(0o755)
    variables = {"PATH": f"{tmp_path}{os.pathsep}{os.environ['PATH']}"}
    command = ["bash", str(tmp_path / "test"), *arguments.split()]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=variables)
    first = (
        "1 -m pytest -n auto --maxprocesses 8 --dist worksteal" if processes else "all -m pytest"
    )
    assert done.stdout == f"{first} {arguments}".rstrip() + "\n"


def test_plugins_alone_are_installed(tmp_path: Path) -> None:
    """Beside them lies what Python compiled there."""
    for name in ("locus", "__pycache__"):
        (tmp_path / "plugins" / name).mkdir(parents=True)
    pip = tmp_path / "venv/bin/python"
    pip.parent.mkdir(parents=True)
    pip.write_text('#!/bin/sh\necho "$@"\n')
    pip.chmod(0o755)
    script = f'source "{ENVIRONMENT}"; root="{tmp_path}"; install "{tmp_path}/venv" cpu'
    result = subprocess.run(["bash", "-c", script], capture_output=True, text=True)
    assert result.returncode == 0, result.stderr
    assert f"--editable {tmp_path}[cpu] --editable {tmp_path}/plugins/locus/\n" in result.stdout
