"""Every reference of the guide leads somewhere, and the site is built where its tools are."""

import re
import subprocess
import sys
from importlib import import_module
from pathlib import PurePosixPath
from pkgutil import resolve_name
from posixpath import normpath

import pytest
import qgs_plugintools
from guide_hooks import written
from guide_pages import DOCS, all_pages, text_of

import qgs

PAGES = all_pages()
CODE = re.compile(r"^```.*?^```$|^(?:    .*\n)+|`[^`\n]+`", re.DOTALL | re.MULTILINE)
LINK = re.compile(r"\]\((?!https?:)([^)\s]+)\)")
TO_CODE = re.compile(r"\[([^]]+)\]\[([a-z_]+(?:\.\w+)+)\]")
DOCUMENTED = re.compile(r"^::: ([\w.]+)", re.MULTILINE)
EVERY_DOCUMENTED = [name for page in PAGES.values() for name in DOCUMENTED.findall(page)]


def anchors(page: str) -> set[str]:
    """What headings of a page can be linked to as."""
    page = re.sub(r"^```.*?^```$", "", page, flags=re.DOTALL | re.MULTILINE)
    found = set()
    for heading in re.findall(r"^#+ (.*)$", page, re.MULTILINE):
        own = re.search(r"\{ #([\w-]+) \}", heading)
        plain = re.sub(r"[^\w\s-]", "", heading).strip().lower()
        found.add(own[1] if own else re.sub(r"[\s-]+", "-", plain))
    return found


@pytest.mark.parametrize("path", PAGES)
def test_links_lead_to_pages_and_headings(path: str) -> None:
    for target in LINK.findall(CODE.sub("", PAGES[path])):
        page, _, anchor = target.partition("#")
        place = normpath(PurePosixPath(path).parent / page) if page else path
        if place not in PAGES:
            assert (DOCS / place).is_file(), f"{path} links to {target}"
        assert not anchor or anchor in anchors(PAGES[place]), f"{path} links to {target}"


@pytest.mark.parametrize("path", PAGES)
def test_references_to_code_are_right_and_documented(path: str) -> None:
    for label, name in TO_CODE.findall(PAGES[path]):
        assert exists(name), f"{path} refers to {name}"
        known = (f"{name}.".startswith(f"{documented}.") for documented in EVERY_DOCUMENTED)
        assert any(known), f"{name} in {path}"
        assert f".{name}".endswith(f".{label.strip('`')}"), f"{label} in {path} leads to {name}"


@pytest.mark.parametrize("name", EVERY_DOCUMENTED)
def test_what_a_page_documents_exists_and_is_documented_once(name: str) -> None:
    assert exists(name)
    assert EVERY_DOCUMENTED.count(name) == 1


def exists(name: str) -> bool:
    try:
        return resolve_name(name) is not None
    except (ImportError, AttributeError):
        return False


def test_pages_are_in_the_navigation() -> None:
    site = (DOCS.parent / "mkdocs.yml").read_text(encoding="utf-8")
    assert sorted(re.findall(r": ([\w/]+\.md)$", site, re.MULTILINE)) == sorted(PAGES)


def test_public_names_are_documented() -> None:
    page = PAGES["api/qgs.md"] + PAGES["api/types.md"] + PAGES["api/contracts.md"]
    types = vars(import_module("qgs.types"))
    missing = [n for n in qgs.__all__ if n not in types and f"qgs.{n}" not in page]
    assert missing == ["CONTRACT_VERSION", "Plugin"], "both are on the page of contracts"


def test_every_public_name_of_the_suite_is_documented() -> None:
    page = PAGES["api/testing.md"]
    documented = {name.rpartition(".")[2] for name in DOCUMENTED.findall(page)}
    headings = set(re.findall(r"^## (\w+)$", page, re.MULTILINE))
    assert documented | headings == set(qgs_plugintools.__all__)


def test_the_site_is_built_without_a_warning(tmp_path) -> None:
    for package in ("mkdocs", "material", "mkdocstrings"):
        reason = f'{package} is not installed: `pip install "query-gaussians[docs]"`'
        pytest.importorskip(package, reason=reason)
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=DOCS.parent, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    for page in ("recipes", "api/checks", "plugin", "api/contracts", "api/testing"):
        assert (tmp_path / page / "index.html").is_file()


@pytest.mark.parametrize("path", PAGES)
def test_pages_are_readable_in_the_repository(path: str) -> None:
    """They are as `python tools/guide_hooks.py` writes them, and links lead to files."""
    text = text_of(path)
    assert written(text, (DOCS / path).parent) == text, "run python tools/guide_hooks.py"
    plain = re.sub("<!--.*?-->", "", CODE.sub("code", text), flags=re.DOTALL)
    assert not re.search(r"^:::|^!!!|\{%|\{\{", plain, re.MULTILINE)
    ends = rf"{plain}\n# "
    # a heading with nothing below it, or only a heading of its own level or a higher one
    assert not re.search(r"^(#+) [^\n]*\s+(?!\1#)#{1,6} ", ends, re.MULTILINE)
    for target in LINK.findall(plain):
        file = (DOCS / path).parent / target.partition("#")[0]
        assert file.exists(), f"{path} links to {target}"
