"""Texts keep the style that CONTRIBUTING.md describes: first lines, sentences, words of pages.

ruff holds the rest of first lines: one line (D205), of a function with a verb in front (D401).
"""

import ast
import re
from pathlib import Path

import size
from guide_pages import DOCS

ROOT = DOCS.parent
README = ROOT / "README.md"
PAGES = [README, ROOT / "CONTRIBUTING.md", ROOT / "CHANGELOG.md", *sorted(DOCS.glob("*.md"))]
FRAGMENT = re.compile(
    r"(And|At|But|By|For|From|How|In|It|Its|Of|On|That|Their|There|These|They|This|Those|To|What"
    r"|When|Where|Whether|Which|Who|Whose|Why|With)\b"
)
CODE = re.compile(r"^```.*?^```$|<!--.*?-->", re.DOTALL | re.MULTILINE)
PARAGRAPH = re.compile(r"^(?![ |#>!<]|[*-] |\d+\.).+(?:\n(?![ |#>!<]|[*-] ).+)*", re.MULTILINE)
VERBS = {*(Path(__file__).parent / "verbs.txt").read_text().split()}


def words(text):
    return len(text.split())


def test_first_lines_stand_alone():
    """Docstrings and texts below fields begin with a verb or a noun, and end with a full stop."""
    wrong = []
    for name, source in size.sources().items():
        for node in ast.walk(ast.parse(source)):
            if size.is_docstring(node) and size.group_of(name) != "tests":
                summary = node.value.value.strip().partition("\n\n")[0]
                if FRAGMENT.match(summary) or summary[-1] not in ".:!?":
                    wrong.append(f"{name}:{node.lineno}: {summary}")
    assert not wrong, "\n".join(wrong)


def test_every_sentence_of_a_page_has_a_verb():
    """Known verbs stand in verbs.txt: add one that it lacks."""
    wrong = []
    for page in PAGES:
        for paragraph in PARAGRAPH.findall(CODE.sub("", page.read_text())):
            plain = re.sub(r"`[^`]*`|\]\([^)]*\)", "Code", paragraph)
            for sentence in re.findall(r"[A-Z].*?[.!?](?=\s+[A-Z\[]|$)", plain, re.DOTALL):
                found = re.findall(r"[a-z]+", sentence.lower())
                if not VERBS & {*found, *(word.removesuffix("s") for word in found)}:
                    wrong.append(f"{page.name}: {sentence}")
    assert not wrong, "\n".join(wrong)


def test_pages_are_short():
    readme = README.read_text()
    assert len(readme.splitlines()) <= 120
    assert words(readme) <= 900
    assert sum(words(page.read_text()) for page in PAGES) <= 20_000
