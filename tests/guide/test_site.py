"""Every reference of the guide leads somewhere, and the site is built where its tools are."""

import re
import subprocess
import sys
from importlib import import_module
from pathlib import PurePosixPath
from pkgutil import resolve_name
from posixpath import normpath

import pytest
import qgs_dev
from guide import written
from guide_pages import DOCS, all_pages, text_of

import qgs

PAGES = all_pages()
CODE = re.compile(r"^```.*?^```$|^(?:    .*\n)+|`[^`\n]+`", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\((?!https?:)([^)\s]+)\)")
TO_CODE = re.compile(r"\[([^]]+)\]\[([a-z_]+(?:\.\w+)+)\]")
DOCUMENTED = re.compile(r"^::: ([\w.]+)", re.MULTILINE)
EVERY_DOCUMENTED = [name for page in PAGES.values() for name in DOCUMENTED.findall(page)]


def anchors(page):
    """What headings of a page can be linked to as."""
    page = re.sub(r"^```.*?^```$", "", page, flags=re.DOTALL | re.MULTILINE)
    found = set()
    for heading in re.findall(r"^#+ (.*)$", page, re.MULTILINE):
        own = re.search(r"\{ #([\w-]+) \}", heading)
        plain = re.sub(r"[^\w\s-]", "", heading).strip().lower()
        found.add(own[1] if own else re.sub(r"[\s-]+", "-", plain))
    return found


def test_links_lead_to_pages_and_headings():
    for path, page in PAGES.items():
        for target in LINK.findall(CODE.sub("", page)):
            to, _, anchor = target.partition("#")
            place = normpath(PurePosixPath(path).parent / to) if to else path
            assert (DOCS / place).is_file(), f"{path} links to {target}"
            assert anchor in anchors(PAGES.get(place, "")) | {""}, f"{path} links to {target}"


def exists(name):
    try:
        return resolve_name(name) is not None
    except (ImportError, AttributeError):
        return False


def test_references_to_code_are_right_and_documented():
    for page in PAGES.values():
        for label, name in TO_CODE.findall(page):
            assert exists(name), name
            assert any(f"{name}.".startswith(f"{whole}.") for whole in EVERY_DOCUMENTED), name
            assert f".{name}".endswith(f".{label.strip('`')}"), f"{label} leads to {name}"


def test_what_a_page_documents_exists_and_is_documented_once():
    assert sorted(EVERY_DOCUMENTED) == sorted(filter(exists, set(EVERY_DOCUMENTED)))


def test_pages_are_in_the_navigation():
    site = (DOCS.parent / "mkdocs.yml").read_text()
    assert sorted(re.findall(r": ([\w/]+\.md)$", site, re.MULTILINE)) == sorted(PAGES)


def test_public_names_are_documented():
    page = PAGES["api/qgs.md"] + PAGES["api/types.md"] + PAGES["api/contracts.md"]
    types = vars(import_module("qgs.types"))
    missing = [n for n in qgs.__all__ if n not in types and f"qgs.{n}" not in page]
    assert missing == ["CONTRACT_VERSION", "Plugin"]  # both are on the page of contracts
    page = PAGES["api/testing.md"]
    documented = {name.rpartition(".")[2] for name in DOCUMENTED.findall(page)}
    assert documented | set(re.findall(r"^## (\w+)$", page, re.MULTILINE)) == set(qgs_dev.__all__)


def test_the_site_is_built_without_a_warning(tmp_path):
    for package in ("mkdocs", "material", "mkdocstrings"):
        reason = f'{package} is not installed: `pip install "query-gaussians[docs]"`'
        pytest.importorskip(package, reason=reason)
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    subprocess.run(command, cwd=DOCS.parent, check=True)
    assert (tmp_path / "api/checks/index.html").is_file()


def test_pages_are_readable_in_the_repository():
    """They are as `python tools/guide.py` writes them."""
    for path in PAGES:
        text = text_of(path)
        plain = re.sub("<!--.*?-->", "", CODE.sub("code", text), flags=re.DOTALL)
        assert written(text, (DOCS / path).parent) == text, f"{path}: run python tools/guide.py"
        # what mkdocs would fill; a heading with nothing below it but one of its level or a higher
        for pattern in (r"^:::|^!!!|\{%|\{\{", r"^(#+) [^\n]*\s+(?!\1#)#{1,6} "):
            assert not re.search(pattern, f"{plain}\n# ", re.MULTILINE), path
