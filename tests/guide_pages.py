"""The guide's pages as text."""

from __future__ import annotations

import re
from pathlib import Path

import guide_checks
import guide_reference

DOCS = Path(__file__).parents[1] / "docs"
BLOCK = re.compile(r'^```(\w+)(?: title="([^"]*)")?\n(.*?)^```$', re.DOTALL | re.MULTILINE)

GENERATED = {
    "recipes.md": guide_reference.reference,
    "checks.md": guide_checks.check_list,
    "api/testing.md": guide_checks.testing_page,
}
"""Pages that are written when the site is built."""


def text_of(page: str) -> str:
    """A page that is a file of the repository."""
    return (DOCS / page).read_text(encoding="utf-8")


def all_pages() -> dict[str, str]:
    """Path below docs/ to text of every page, generated ones too."""
    files = {str(path.relative_to(DOCS)): path.read_text("utf-8") for path in DOCS.rglob("*.md")}
    return files | {path: written() for path, written in GENERATED.items()}


def blocks(page: str, kind: str) -> dict[str, str]:
    """Title, or position, to text of the blocks of one kind."""
    found = BLOCK.findall(text_of(page))
    return {t or str(i): text for i, (k, t, text) in enumerate(found) if k == kind}
