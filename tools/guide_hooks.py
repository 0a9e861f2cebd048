"""Hooks of mkdocs: pages that are written from the code when the guide is built."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

from guide_checks import check_list, testing_page
from guide_reference import reference


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are no files of the repository."""
    from mkdocs.structure.files import File  # pyright: ignore[reportMissingImports]

    pages = {"recipes.md": reference, "checks.md": check_list, "api/testing.md": testing_page}
    for path, written in pages.items():
        files.append(File.generated(config, path, content=written()))
    return files
