"""The guide's pages as text."""

import re

from guide import ROOT, filled

DOCS = ROOT / "docs"
BLOCK = re.compile(r'^```(\w+)(?: title="([^"]*)")?\n(.*?)^```$', re.DOTALL | re.MULTILINE)


def text_of(page):
    """A page as it is in the repository."""
    return (DOCS / page).read_text()


def all_pages():
    """Path below docs/ to text of every page, with the parts that are written from the code."""
    return {str(path.relative_to(DOCS)): filled(path.read_text()) for path in DOCS.rglob("*.md")}


def blocks(page, kind):
    """Title, or position, to text of the blocks of one kind."""
    found = BLOCK.findall(text_of(page))
    return {t or str(i): text for i, (k, t, text) in enumerate(found) if k == kind}
