"""The parts of the guide that are written from the code, and the hook of mkdocs that adds them.

A page has `<!-- from the code: NAME -->` on a line of its own where the part NAME belongs.
"""

import re
import sys
from collections.abc import Collection
from itertools import groupby
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).parent))

import qgs_plugintools
from guide_reference import reference
from qgs_plugintools import CHECKS

from qgs.composer.slots import SLOTS

PART = re.compile(r"^<!-- from the code: (.*) -->$", re.MULTILINE)

FIRST = ("Case", "parametrize_with_checks", "check_plugin")
"""Names that a plugin's author needs; the others follow in the order of the alphabet."""


def filled(page: str) -> str:
    """`page` with the parts that are written from the code."""
    parts = {"recipe reference": reference, "checks": check_list, "qgs_plugintools": testing_names}
    return PART.sub(lambda found: parts[found[1]](), page)


def on_page_markdown(markdown: str, **_: Any) -> str:
    """Called by mkdocs for each page."""
    return filled(markdown)


def check_list() -> str:
    """Tables of all checks by subject, Markdown."""
    parts: list[str] = []
    for module, checks in groupby(CHECKS.values(), key=lambda check: check.function.__module__):
        summary = (sys.modules[module].__doc__ or "").strip().split("\n\n")[0]
        parts += [f"### {module.rpartition('.')[2].capitalize()}", "", summary, ""]
        parts += ["| check | tier | slots | contract |", "|---|---|---|---|"]
        for check in checks:
            slots = _slots_in_words(check.slots)
            parts.append(f"| `{check.name}` | {check.tier} | {slots} | {check.contract} |")
        parts.append("")
    return "\n".join(parts)


def _slots_in_words(slots: Collection[str]) -> str:
    named = [f"`{slot}`" for slot in SLOTS if slot in slots]
    others = [f"`{slot}`" for slot in SLOTS if slot not in slots]
    if len(others) < len(named):
        return f"all but {', '.join(others)}" if others else "all"
    return ", ".join(named)


def testing_names() -> str:
    """A section for each public name of `qgs_plugintools`, for mkdocstrings to fill in."""
    options = (
        "{members: false, show_root_heading: true, show_root_toc_entry: true, heading_level: 2}"
    )
    parts: list[str] = []
    for name in [*FIRST, *sorted(set(qgs_plugintools.__all__) - {*FIRST, "CHECKS"})]:
        home = getattr(qgs_plugintools, name).__module__
        if home.startswith("qgs_plugintools."):
            parts.append(f"::: {home}.{name}\n    options: {options}\n")
        else:
            parts.append(f"## {name}\n\n[`{home}.{name}`][{home}.{name}], among the contracts.\n")
    return "\n".join(parts)
