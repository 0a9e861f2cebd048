"""Docstrings of this repository as Markdown: `name: meaning` becomes a list.

A docstring explains parameters and fields as `name, other: meaning. third: meaning.`, in paragraphs
that begin with one; indented lines go on with the one before.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator

SENTENCE = re.compile(r"(?<=[.:]) (?=Raises? [A-Z])")
"""Where what is raised begins behind the last meaning."""


def entries(text: str, names: Collection[str]) -> Iterator[tuple[str, str]]:
    """The parts of one line of `text`: listed names and meaning; no names for what is no entry."""
    lead, *parts = _pattern(names).split(text)
    if lead.strip():
        yield "", lead.strip()
    for listed, meaning in zip(parts[::2], parts[1::2], strict=True):
        yield listed, " ".join(meaning.split())


def with_lists(text: str, names: Collection[str]) -> str:
    """`text` with a list for every paragraph that explains `names`."""
    if not names:
        return text
    starts = _pattern(names).match
    paragraphs = text.split("\n\n")
    return "\n\n".join(_listed(p, names) if starts(p) else p for p in paragraphs)


def joined(text: str) -> str:
    """One line for every entry, or run of entries, of `text`."""
    return re.sub(r"(?<=[^.\n])\n|\n +", " ", text)


def _listed(paragraph: str, names: Collection[str]) -> str:
    blocks: list[str] = []
    for line in joined(paragraph).splitlines():
        for listed, meaning in entries(line, names):
            meaning, *raised = SENTENCE.split(meaning)
            if not listed:
                blocks.append(f"\n{meaning}")
            else:
                words = ", ".join(f"`{name}`" for name in listed.split(", "))
                blocks.append(f"- {words}: {meaning}")
            blocks += [f"\n{sentence}" for sentence in raised]
    return "\n".join(blocks).strip()


def _pattern(names: Collection[str]) -> re.Pattern[str]:
    known = "|".join(map(re.escape, names))
    return re.compile(rf"(?:^|(?<=\. ))((?:{known})(?:, (?:{known}))*): ")
