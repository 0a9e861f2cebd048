"""Hooks of mkdocs: pages that are written from the code when the guide is built."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from guide_checks import check_list
from guide_reference import reference


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are no files of the repository."""
    from mkdocs.structure.files import File  # pyright: ignore[reportMissingImports]

    files.append(File.generated(config, "recipes.md", content=reference()))
    files.append(File.generated(config, "checks.md", content=check_list()))
    return files
