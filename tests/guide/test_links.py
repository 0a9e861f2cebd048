"""Every reference of the guide leads somewhere; without the tool that builds the site."""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import PurePosixPath
from posixpath import normpath

import pytest
from guide_pages import DOCS, GENERATED, all_pages

import qgs

PAGES = all_pages()
CODE = re.compile(r"^```.*?^```$|^(?:    .*\n)+|`[^`\n]+`", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\((?!https?:)([^)\s]+)\)")
TO_CODE = re.compile(r"\[([^]]+)\]\[([a-z_]+(?:\.\w+)+)\]")
DOCUMENTED = re.compile(r"^::: ([\w.]+)", re.MULTILINE)


def anchors(page: str) -> set[str]:
    """What headings of a page can be linked to as."""
    found = set()
    for heading in re.findall(
        r"^#+ (.*)$", re.sub(r"^```.*?^```$", "", page, flags=re.S | re.M), re.M
    ):
        own = re.search(r"\{ #([\w-]+) \}", heading)
        plain = re.sub(r"[^\w\s-]", "", heading).strip().lower()
        found.add(own[1] if own else re.sub(r"[\s-]+", "-", plain))
    return found


@pytest.mark.parametrize("path", PAGES)
def test_links_lead_to_pages_and_headings(path: str) -> None:
    for target in LINK.findall(CODE.sub("", PAGES[path])):
        page, _, anchor = target.partition("#")
        place = normpath(PurePosixPath(path).parent / page) if page else path
        assert place in PAGES, f"{path} links to {target}"
        assert not anchor or anchor in anchors(PAGES[place]), f"{path} links to {target}"


@pytest.mark.parametrize("path", PAGES)
def test_references_to_code_are_right_and_documented(path: str) -> None:
    documented = [name for page in PAGES.values() for name in DOCUMENTED.findall(page)]
    for label, name in TO_CODE.findall(PAGES[path]):
        assert _found(name), f"{path} refers to {name}"
        assert any(f"{name}.".startswith(f"{known}.") for known in documented), f"{name} in {path}"
        assert f".{name}".endswith(f".{label.strip('`')}"), f"{label} in {path} leads to {name}"


@pytest.mark.parametrize("path", PAGES)
def test_what_a_page_documents_exists(path: str) -> None:
    for name in DOCUMENTED.findall(PAGES[path]):
        assert _found(name), f"{path} documents {name}"


def _found(name: str) -> bool:
    parts = name.split(".")
    for split in range(len(parts), 0, -1):
        try:
            thing = import_module(".".join(parts[:split]))
        except ModuleNotFoundError:
            continue
        for part in parts[split:]:
            thing = getattr(thing, part, None)
        return thing is not None
    return False


def test_pages_are_in_the_navigation() -> None:
    site = (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8")
    listed = re.findall(r": ([\w/]+\.md)$", site, re.MULTILINE)
    assert sorted(listed) == sorted(PAGES)
    assert not [page for page in GENERATED if (DOCS / page).exists()]


def test_public_names_are_documented() -> None:
    page = PAGES["api/qgs.md"] + PAGES["api/types.md"] + PAGES["api/contracts.md"]
    types = vars(import_module("qgs.types"))
    missing = [n for n in qgs.__all__ if n not in types and f"qgs.{n}" not in page]
    assert missing == ["CONTRACT_VERSION", "Plugin"], "both are on the page of contracts"
