"""The guide as a site; what needs no site is tested beside this file."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def test_the_site_is_built_without_a_warning(tmp_path: Path) -> None:
    for package in ("mkdocs", "material", "mkdocstrings"):
        pytest.importorskip(
            package,
            reason=f'{package} is not installed: `pip install "query-gaussians[docs]"`',
        )
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for page in ("recipes", "checks", "plugin", "api/contracts", "api/testing"):
        assert (tmp_path / page / "index.html").is_file()
